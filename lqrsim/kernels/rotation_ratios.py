"""Ratios of a rotation vector's angle that are smooth at zero, and their derivatives; see `rotations.py`.

They are functions of s, the squared angle. Near zero they are series, such as sin x / x = sum (-s)^k / (2k + 1)!; the
coefficients of `cotangent_ratio` are |Bernoulli(2k + 2)| / (2k + 2)!. For s below 1/4 the first omitted term is less
than 1e-16 of the sum, 3e-15 for first derivatives, and 2e-12 for second ones.
"""

from math import cos, sin, sqrt


def sine_ratio(s: float) -> float:
    """sin x / x."""
    if s > 0.25:
        angle = sqrt(s)
        return sin(angle) / angle
    return 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110 * (1 - s / 156 * (1 - s / 210))))))


def cosine_ratio(s: float) -> float:
    """(1 - cos x) / x^2."""
    if s > 0.25:
        return (1 - cos(sqrt(s))) / s
    return 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90 * (1 - s / 132 * (1 - s / 182))))))


def cubic_ratio(s: float) -> float:
    """(x - sin x) / x^3."""
    if s > 0.25:
        return (1 - sine_ratio(s)) / s
    return 1 / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110 * (1 - s / 156 * (1 - s / 210))))))


def cotangent_ratio(s: float) -> float:
    """(1 - x/2 cot(x/2)) / x^2."""
    if s > 0.25:
        return (1 - sine_ratio(s) / (2 * cosine_ratio(s))) / s
    tail = 1 / 47900160 + s * (691 / 1307674368000 + s * (1 / 74724249600 + s * 3617 / 10670622842880000))
    return 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s * tail)))


def sine_ratio_d1(s: float) -> float:
    if s > 0.25:
        return (cos(sqrt(s)) - sine_ratio(s)) / (2 * s)
    return -1 / 6 * (1 - s / 10 * (1 - s / 28 * (1 - s / 54 * (1 - s / 88 * (1 - s / 130 * (1 - s / 180))))))


def cosine_ratio_d1(s: float) -> float:
    if s > 0.25:
        return (sine_ratio(s) - 2 * cosine_ratio(s)) / (2 * s)
    return (
        -1 / 24 * (1 - s / 15 * (1 - s / (112 / 3) * (1 - s / (135 / 2) * (1 - s / (528 / 5) * (1 - s / (455 / 3))))))
    )


def cotangent_ratio_d1(s: float) -> float:
    if s > 0.25:
        return (-_half_cotangent_d1(s) - cotangent_ratio(s)) / s
    tail = 4 / 47900160 + s * (5 * 691 / 1307674368000 + s * (6 / 74724249600 + s * 7 * 3617 / 10670622842880000))
    return 1 / 720 + s * (2 / 30240 + s * (3 / 1209600 + s * tail))


def sine_ratio_d2(s: float) -> float:
    if s > 0.25:
        return (-0.5 * sine_ratio(s) - 3 * sine_ratio_d1(s)) / (2 * s)
    return 1 / 60 * (1 - s / 14 * (1 - s / 36 * (1 - s / 66 * (1 - s / 104 * (1 - s / 150)))))


def cosine_ratio_d2(s: float) -> float:
    if s > 0.25:
        return (sine_ratio_d1(s) - 4 * cosine_ratio_d1(s)) / (2 * s)
    return 1 / 360 * (1 - s / (56 / 3) * (1 - s / 45 * (1 - s / (396 / 5) * (1 - s / (364 / 3)))))


def cotangent_ratio_d2(s: float) -> float:
    if s > 0.25:
        a, a1, a2 = sine_ratio(s), sine_ratio_d1(s), sine_ratio_d2(s)
        b, b1, b2 = cosine_ratio(s), cosine_ratio_d1(s), cosine_ratio_d2(s)
        curve = (a2 * b - a * b2) / (2 * b * b) - b1 * (a1 * b - a * b1) / (b * b * b)
        return (-curve - 2 * cotangent_ratio_d1(s)) / s
    tail = 12 / 47900160 + s * (20 * 691 / 1307674368000 + s * (30 / 74724249600 + s * 42 * 3617 / 10670622842880000))
    return 2 / 30240 + s * (6 / 1209600 + s * tail)


def _half_cotangent_d1(s: float) -> float:
    """The derivative in s of |r|/2 cot(|r|/2) = sine_ratio / (2 cosine_ratio)."""
    a, b = sine_ratio(s), cosine_ratio(s)
    return (sine_ratio_d1(s) * b - a * cosine_ratio_d1(s)) / (2 * b * b)

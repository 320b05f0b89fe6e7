"""Rotation vectors: the functions of them that are smooth at zero, for dynamics and costs written in SymPy, and the
maps to and from the quaternions that MuJoCo's free and ball joints have.

A rotation vector r turns by |r| radians about its axis. What the formulas need of the angle are three ratios that are
analytic in s = |r|^2, although written with |r| they read 0/0 at the identity:

    sine_ratio(s)      = sin|r| / |r|
    cosine_ratio(s)    = (1 - cos|r|) / |r|^2
    cotangent_ratio(s) = (1 - |r|/2 cot(|r|/2)) / |r|^2

Each is a SymPy function whose derivative in s is `<name>_d1`, and of that `<name>_d2`. Compiled cores evaluate them by
the functions of the same names below, with a power series near zero. Rotation vectors of length 2 pi are singular.
"""

from collections.abc import Sequence
from functools import cache
from math import cos, sin, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_items, excerpt, vectors_of

Vector = Sequence[Any] | npt.NDArray[Any]

RATIOS = ("sine_ratio", "cosine_ratio", "cotangent_ratio")


def rotate(r: Vector, v: Vector) -> list[Any]:
    """The vector `exp([r]) v`: v turned by the rotation vector r; three expressions of SymPy, or three numbers."""
    r, v = _three("r", r), _three("v", v)
    sine, cosine, _ = (_ratio(name, _dot(r, r)) for name in RATIOS)
    once = _cross(r, v)
    twice = _cross(r, once)
    return [v[i] + sine * once[i] + cosine * twice[i] for i in range(3)]


def vector_rate(r: Vector, w: Vector) -> list[Any]:
    """The rate of the rotation vector r of a body that turns with w rad/s, in body axes.

    Three expressions of SymPy, or three numbers if r and w are numbers.

    Paper: Sec. VI-B, `rdot = w + 1/2 [r] w + (1 - 1/2 |r| / tan(1/2 |r|)) [r]^2 w / |r|^2`.
    """
    r, w = _three("r", r), _three("w", w)
    cotangent = _ratio("cotangent_ratio", _dot(r, r))
    once = _cross(r, w)
    twice = _cross(r, once)
    return [w[i] + once[i] / 2 + cotangent * twice[i] for i in range(3)]


def quaternion(rotation_vector: npt.ArrayLike) -> Array:
    """Unit quaternions (..., 4), scalar first as MuJoCo has them, of rotation vectors (..., 3).

    Raises:
      InputError: not numbers of that shape.
    """
    rotation = vectors_of("rotation_vector", rotation_vector, 3)
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    # np.sinc(t) is sin(pi t) / (pi t), and 1 at 0: here sin(angle / 2) / angle.
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * rotation], axis=-1)


def rotation_vector(quaternion: npt.ArrayLike) -> Array:
    """Rotation vectors (..., 3) of at most half a turn, of quaternions (..., 4), scalar first, of any length and sign.

    Raises:
      InputError: not numbers of that shape.
    """
    rows = vectors_of("quaternion", quaternion, 4)
    # q and -q are one rotation: the one with scalar part >= 0 is its half turn or less.
    scalar, x, y, z = (rows[..., i] for i in range(4))
    sine = np.sqrt(x * x + y * y + z * z)
    # atan2 is exact at both ends, unlike acos near no turn and asin near half a turn.
    angle = 2 * np.arctan2(sine, np.abs(scalar))
    # Without a turn the ratio is 2 / scalar, whatever the length; there the division is by zero.
    small = np.asarray(sine < 1e-12)
    limit = np.asarray(2.0 / np.abs(scalar)) if small.any() else None
    ratio = angle / sine if limit is None else np.divide(angle, sine, out=limit, where=~small)
    return np.copysign(ratio, scalar)[..., None] * rows[..., 1:]


def _three(field: str, vector: Vector) -> tuple[Any, ...]:
    """The vector's three entries: numbers, arrays of them, or expressions. Raises InputError for anything else."""
    found = check_items(field, vector, object, "three expressions or numbers", at_most=3)
    if len(found) != 3 or any(isinstance(one, str) for one in found):
        raise InputError(f"{field}: got {excerpt(vector)}, want three expressions or numbers")
    if all(_numeric(one) for one in found):
        return found
    import sympy

    try:
        expressions = [sympy.sympify(one, strict=True) for one in found]
    except Exception:  # SympifyError, or whatever an object raises when it is asked
        expressions = [None]
    if not all(isinstance(one, sympy.Expr) for one in expressions):
        raise InputError(f"{field}: got {excerpt(vector)}, want three expressions or numbers")
    return tuple(expressions)


def _numeric(one: object) -> bool:
    """Whether it is a number of Python or NumPy, or an array of them."""
    if isinstance(one, np.ndarray | np.generic):
        return one.dtype.kind in "iuf"
    return isinstance(one, float | int) and not isinstance(one, bool)


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _ratio(name: str, s: Any) -> Any:
    """That ratio at s: a number at a number, numbers at an array of them, and SymPy's function of the rest."""
    if isinstance(s, float | int | np.number):
        return _NUMERIC[name](float(s))
    if isinstance(s, np.ndarray) and s.dtype != object:
        return np.vectorize(_NUMERIC[name], otypes=[np.float64])(s)
    return _symbolic(name)(s)


@cache
def _symbolic(name: str) -> Any:
    """The SymPy function of that name; differentiating it gives the next order."""
    import sympy

    def fdiff(self: Any, argindex: int = 1) -> Any:
        base, _, order = name.partition("_d")
        if order == "2":
            raise NotImplementedError(f"{base}: third derivatives are not provided")
        return _symbolic(f"{base}_d{int(order or 0) + 1}")(self.args[0])

    return type(name, (sympy.Function,), {"fdiff": fdiff, "nargs": 1, "is_real": True})


# The numba subset from here on. Series: sin x / x = sum (-s)^k / (2k + 1)!, and so on; the last one's coefficients
# are |Bernoulli(2k + 2)| / (2k + 2)!. Below s = 1/4 the first dropped term is under 1e-16 relative.


def sine_ratio(s: float) -> float:
    if s > 0.25:
        angle = sqrt(s)
        return sin(angle) / angle
    return 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110 * (1 - s / 156 * (1 - s / 210))))))


def cosine_ratio(s: float) -> float:
    if s > 0.25:
        return (1 - cos(sqrt(s))) / s
    return 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90 * (1 - s / 132 * (1 - s / 182))))))


def cotangent_ratio(s: float) -> float:
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
    """Derivative in s of |r|/2 cot(|r|/2) = sine_ratio / (2 cosine_ratio)."""
    a, b = sine_ratio(s), cosine_ratio(s)
    return (sine_ratio_d1(s) * b - a * cosine_ratio_d1(s)) / (2 * b * b)


_NUMERIC = {"sine_ratio": sine_ratio, "cosine_ratio": cosine_ratio, "cotangent_ratio": cotangent_ratio}

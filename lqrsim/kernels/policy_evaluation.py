"""Feedback laws of many measured states at once, in the numba subset. `AffinePolicy` has the same in NumPy.

A system's `turn(x, nominal)`, which takes its angles and rotation vectors to the nearest representative, is written by
`solvers/compiled.py` from the two functions here.
"""

from math import floor, pi, sqrt

N, M = 3, 2  # states and controls; each compiled core has its own


def turn(x, nominal) -> None:
    """Takes a state to its representative nearest to the nominal; each system's is written for it."""
    raise NotImplementedError


# The numba subset.


def apply_law(count, near, gain, offset, nominal, low, high, out) -> None:
    """Controls (count, M) within the limits, of states (count, N), which become those nearest to the nominal (N,)."""
    for k in range(count):
        x = near[k]
        turn(x, nominal)
        for j in range(M):
            total = offset[j]
            for i in range(N):
                total += gain[j, i] * x[i]
            if total < low[j]:
                total = low[j]
            elif total > high[j]:
                total = high[j]
            out[k, j] = total


def turn_all(steps, count, states, nominal) -> None:
    """Takes each of the states (steps count, N) to its representative nearest to its step's nominal (steps, N)."""
    for t in range(steps):
        for k in range(count):
            turn(states[t * count + k], nominal[t])


def nearest_angle(x, nominal, i: int) -> None:
    """Takes whole turns out of what an angle differs by."""
    x[i] -= 2.0 * pi * floor((x[i] - nominal[i]) / (2.0 * pi) + 0.5)


def nearest_rotation(x, nominal, first: int) -> None:
    """Of the vectors (angle + 2 pi k) axis, which are one rotation, the nearest to the nominal; see coordinates.py."""
    a, b, c = x[first], x[first + 1], x[first + 2]
    u, v, w = nominal[first], nominal[first + 1], nominal[first + 2]
    angle, distance = sqrt(a * a + b * b + c * c), sqrt(u * u + v * v + w * w)
    if angle < 1e-12:  # the identity has every axis
        scale = 1.0 / distance if distance > 0.0 else 0.0
        a, b, c = u * scale, v * scale, w * scale
    else:
        a, b, c = a / angle, b / angle, c / angle
    turns = floor((a * u + b * v + c * w - angle) / (2.0 * pi) + 0.5)
    if turns != 0:
        turned = angle + 2.0 * pi * turns
        x[first], x[first + 1], x[first + 2] = turned * a, turned * b, turned * c

"""Feedback laws of many measured states at once. The kernels' subset. `AffinePolicy` has the same in NumPy."""

from math import floor, pi, sqrt

from lqrsim.kernels.declarations import outline
from lqrsim.kernels.linear_algebra import affine, within


def apply_policy(count, near, law, nominal, turning, limits, out) -> None:
    """Controls (count, M) within the limits, of states (count, N), which become those nearest to the nominal (N,)."""
    for k in range(count):
        apply_one(near[k], law, nominal, turning, limits, out[k])


@outline
def apply_one(x, law, nominal, turning, limits, u) -> None:
    """One of these."""
    to_nearest(x, nominal, turning)
    affine(law.gain, law.offset, x, u)
    within(u, limits)


def all_to_nearest(steps, count, states, nominal, turning) -> None:
    """Takes each of the states (steps count, N) to its representative nearest to its step's nominal (steps, N)."""
    for t in range(steps):
        for k in range(count):
            to_nearest(states[t * count + k], nominal[t], turning)


@outline
def to_nearest(x, nominal, turning) -> None:
    """Takes a state to its representative nearest to the nominal: its angles and its rotation vectors."""
    for k in range(turning.angle_count):
        nearest_angle(x, nominal, int(turning.angles[k]))
    for k in range(turning.rotation_count):
        nearest_rotation(x, nominal, int(turning.rotations[k]))


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

"""Feedback policies at many measured states. `AffinePolicy` does the same in NumPy."""

from math import floor, pi, sqrt

from lqrsim.kernels.control_limits import limited_control
from lqrsim.kernels.declarations import outline, stack


def apply_policy(count, states, policy, nominal, angular, limits, out):
    """Write the controls (count, M), within their limits, at states (count, N).

    The states are overwritten by their representatives nearest to the nominal (N,).
    """
    for k in range(count):
        apply_one(states[k], policy, nominal, angular, limits, out[k])


@outline
def apply_one(x, policy, nominal, angular, limits, u):
    """Write the control (M,) at one state (N,)."""
    to_nearest(x, nominal, angular)
    limited_control(policy.gain, policy.offset, x, limits, u)


def all_to_nearest(steps, count, states, nominal, angular):
    """Replace states (steps count, N) by their representatives nearest to the nominal of their step, (steps, N)."""
    for t in range(steps):
        for k in range(count):
            to_nearest(states[t * count + k], nominal[t], angular)


@outline
def to_nearest(x, nominal, angular):
    """Replace a state by its representative nearest to the nominal: its angles and its rotation vectors."""
    for k in range(angular.angle_count):  # to within half a turn
        i = int(angular.angles[k])
        x[i] -= 2.0 * pi * floor((x[i] - nominal[i]) / (2.0 * pi) + 0.5)
    for k in range(angular.rotation_count):
        nearest_rotation(x, nominal, int(angular.rotations[k, 0]), int(angular.rotations[k, 1]))


def nearest_rotation(x, nominal, first, turn):
    """Replace the rotation vector at x[first] by the nearest to the nominal among (angle + 2 pi k) axis, which are all
    the same rotation; without its entry `turn`, 0 to 2, if that is an angle. See coordinates.py.
    """
    axis, reference, square, length, along = stack(3), stack(3), 0.0, 0.0, 0.0
    for i in range(3):
        axis[i], reference[i] = 0.0, 0.0
        if i != turn:
            axis[i], reference[i] = x[first + i], nominal[first + i]
        square += axis[i] * axis[i]
        length += reference[i] * reference[i]
    angle, distance = sqrt(square), sqrt(length)
    for i in range(3):
        if angle < 1e-12:  # the identity has every axis
            axis[i] = reference[i] / distance if distance > 0.0 else 0.0
        else:
            axis[i] /= angle
        along += axis[i] * reference[i]
    turns = floor((along - angle) / (2.0 * pi) + 0.5)
    if turns != 0:
        for i in range(3):
            if i != turn:
                x[first + i] = (angle + 2.0 * pi * turns) * axis[i]

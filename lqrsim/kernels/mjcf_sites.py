"""Errors of the position and orientation of a site of an MJCF. Written in the kernels' subset.

`data` has the address that `mjcf_dynamics.py` calls p, the site's body, its position and axes (3 x 3) in the body's
axes, and the desired position and axes. The rows are three for the position, in world axes; or three for the rotation
vector from the desired axes to the site's; or both.
"""

from math import atan2, sqrt

from lqrsim.kernels.declarations import N, at, call, int32, stack, store
from lqrsim.kernels.linear_algebra import clear
from lqrsim.kernels.mjcf_distances import turn_to_states
from lqrsim.kernels.mjcf_dynamics import (
    COMPOS,
    DATA,
    FLAGS,
    JAC,
    KINEMATICS,
    MODEL,
    NV,
    QPOS,
    SLOT,
    SLOTS,
    XMAT,
    XPOS,
    take_slot,
    write_positions,
)
from lqrsim.kernels.rotation_ratios import cotangent_ratio

PLACED = 1  # whether there are rows of the position
TURNED = 1  # whether there are rows of the orientation
BODY, OFFSET, AXES, WANTED, WANTED_AXES = 1, 2, 5, 14, 17  # layout of data


def errors(x, data, out):
    """Write the rows."""
    p = at(data[0])
    slot = take_slot(p)
    one, point = at(p[SLOTS] + 8 * SLOT * slot), stack(3)
    write_positions(x, p, at(one[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(one[DATA]))
    write_errors(one, data, out, point)
    store(p[FLAGS], slot, 0)


def errors_jacobian(x, data, out, slopes):
    """Write the rows and their derivatives in the states (any, N), which are zero on entry."""
    p = at(data[0])
    slot, nv, body = take_slot(p), int(p[NV]), int(data[BODY])
    one, point, moves, turns = at(p[SLOTS] + 8 * SLOT * slot), stack(3), stack(3 * N), stack(3 * N)
    write_positions(x, p, at(one[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(one[DATA]))
    call(p[COMPOS], at(p[MODEL]), at(one[DATA]))
    write_errors(one, data, out, point)
    call(p[JAC], at(p[MODEL]), at(one[DATA]), moves, turns, point, int32(body))
    if PLACED:
        for i in range(3):
            for j in range(nv):
                slopes[i, j] = moves[nv * i + j]
    if TURNED:
        inverse, first = stack(3, 3), 3 * PLACED
        write_inverse(out, first, inverse)
        for j in range(nv):
            for i in range(3):
                total = 0.0
                for k in range(3):
                    for m in range(3):
                        total += inverse[i, k] * data[WANTED_AXES + 3 * m + k] * turns[nv * m + j]
                slopes[first + i, j] = total
    for row in range(3 * PLACED + 3 * TURNED):
        turn_to_states(x, p, slopes[row])
    store(p[FLAGS], slot, 0)


def write_errors(one, data, out, point):
    """Write the rows, and the position of the site, for an MjData with computed positions."""
    body = int(data[BODY])
    origins, axes = at(one[XPOS]), at(one[XMAT])
    for i in range(3):
        point[i] = origins[3 * body + i]
        for j in range(3):
            point[i] += axes[9 * body + 3 * i + j] * data[OFFSET + j]
        if PLACED:
            out[i] = point[i] - data[WANTED + i]
    if TURNED:
        turned, own, first = stack(3, 3), stack(3, 3), 3 * PLACED
        clear(own, 3, 3)
        clear(turned, 3, 3)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    own[i, j] += axes[9 * body + 3 * i + k] * data[AXES + 3 * k + j]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    turned[i, j] += data[WANTED_AXES + 3 * k + i] * own[k, j]
        out[first] = 0.5 * (turned[2, 1] - turned[1, 2])
        out[first + 1] = 0.5 * (turned[0, 2] - turned[2, 0])
        out[first + 2] = 0.5 * (turned[1, 0] - turned[0, 1])
        square = 0.0
        for i in range(3):
            square += out[first + i] * out[first + i]
        sine, cosine = sqrt(square), 0.5 * (turned[0, 0] + turned[1, 1] + turned[2, 2] - 1)
        ratio = atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
        for i in range(3):
            out[first + i] *= ratio


def write_inverse(out, first, inverse):
    """Write the matrix from an angular velocity in the wanted axes to the rate of the rotation vector."""
    a, b, c = out[first], out[first + 1], out[first + 2]
    square = a * a + b * b + c * c
    ratio = cotangent_ratio(square)
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = (
        1 + ratio * (a * a - square),
        1 + ratio * (b * b - square),
        1 + ratio * (c * c - square),
    )
    inverse[0, 1], inverse[1, 0] = ratio * a * b + 0.5 * c, ratio * a * b - 0.5 * c
    inverse[0, 2], inverse[2, 0] = ratio * a * c - 0.5 * b, ratio * a * c + 0.5 * b
    inverse[1, 2], inverse[2, 1] = ratio * b * c + 0.5 * a, ratio * b * c - 0.5 * a

"""Distances between a robot's geoms and others, by MuJoCo's `mj_geomDistance`; and the centres of a robot's balls.

For distances `data` has the address that `mjcf_dynamics.py` calls p, the numbers of rows and of pairs of geoms, the
largest distance of interest, and for each pair: its row, the robot's geom and its body, the other geom, which is an
obstacle's or on another body of the robot, the sum of the radii of their bounding spheres, whether the other is a
plane, and its body if that moves, else 0. A row is the least distance of its pairs. Pairs whose bounding spheres are
farther apart than the least distance so far are skipped.

For balls, points fixed to bodies, it has that address, their number, and for each the number of its body and its place
in the body's axes; `differences.py` has the derivatives.
"""

from math import sqrt

from lqrsim.kernels.declarations import N, at, call, call_for_value, int32, outline, stack, store
from lqrsim.kernels.linear_algebra import copy, copy_part
from lqrsim.kernels.mjcf_dynamics import (
    AXIS,
    BALL,
    COMPOS,
    DATA,
    DISTANCE,
    DISTANCE_MODEL,
    FLAGS,
    FREE,
    GEOM_XMAT,
    GEOM_XPOS,
    JAC,
    JOINTS,
    KINEMATICS,
    MODEL,
    NV,
    QPOS,
    SLOT,
    SLOTS,
    TABLE,
    XMAT,
    XPOS,
    claim_slot,
    write_positions,
)
from lqrsim.kernels.rotation_ratios import cosine_ratio, cubic_ratio, sine_ratio

ROWS = 1  # number of rows
LARGEST, PAIRS, PAIR = 3, 4, 7  # indices of the largest distance and the pairs in data, and count of numbers per pair
TOUCHING = 1e-12  # m; the segment between two geoms that touch has no direction


def residual(x, data, out):
    """Write the least distance of each row, in metres; at most the largest distance of interest."""
    which, segments, nowhere = stack(ROWS), stack(ROWS, 6), stack(1)
    find(x, nowhere, -1, data, 0, out, which, segments)


def residual_jacobian(x, data, out, slopes):
    """Write the distances and their derivatives in the states (any, N), which are zero on entry."""
    which, segments = stack(ROWS), stack(ROWS, 6)
    find_with_slopes(x, data, 0, out, slopes, which, segments)


def distances_of(count, states, each, displaced, data, out, which, segments):
    """Write the distances, row by row, at states (count, N).

    For `each` consecutive states obstacles have the same displacements, three numbers per row.
    """
    rows = int(data[1])
    for i in range(count):
        find(states[i], displaced, 3 * rows * (i // each), data, rows * i, out, which, segments)


def slopes_of(count, states, data, out, slopes, which, segments):
    """Write the distances and their derivatives (any, N), which are zero on entry, at states (count, N)."""
    rows = int(data[1])
    for i in range(count):
        find_with_slopes(states[i], data, rows * i, out, slopes, which, segments)


def places(x, data, out):
    """Write the coordinates of the balls, ball by ball."""
    p = at(data[0])
    slot = claim_slot(p)
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    move_bodies(x, p, addresses)
    origins, axes = at(addresses[XPOS]), at(addresses[XMAT])
    for k in range(int(data[1])):
        body = int(data[2 + 4 * k])
        for i in range(3):
            place = origins[3 * body + i]
            for j in range(3):
                place += axes[9 * body + 3 * i + j] * data[3 + 4 * k + j]
            out[3 * k + i] = place
    store(p[FLAGS], slot, 0)


def move_bodies(x, p, addresses):
    """Move the bodies of an MjData to the positions of a state."""
    write_positions(x, p, at(addresses[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(addresses[DATA]))


@outline
def find(x, displaced, offset, data, first, out, which, segments):
    """Write the least distance of each row to out from `first` on, its pair, or -1, and the segment between the two."""
    p = at(data[0])
    slot = claim_slot(p)
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    move_bodies(x, p, addresses)
    find_with_data(p, addresses, data, displaced, offset, first, out, which, segments)
    store(p[FLAGS], slot, 0)


def find_with_slopes(x, data, first, out, slopes, which, segments):
    """The same, and the derivatives: the speed of the nearest point, against the direction to the other's.

    If the other moves too, it is the difference of both speeds.
    """
    p = at(data[0])
    slot, nv = claim_slot(p), int(p[NV])
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    moves, others, normal, there, nowhere = stack(3 * N), stack(3 * N), stack(3), stack(3), stack(1)
    move_bodies(x, p, addresses)
    call(p[COMPOS], at(p[MODEL]), at(addresses[DATA]))
    find_with_data(p, addresses, data, nowhere, -1, first, out, which, segments)
    for row in range(int(data[1])):
        if which[row] >= 0:
            pair = PAIRS + PAIR * int(which[row])
            write_normal(addresses, int(data[pair + 1]), int(data[pair + 3]), out[first + row], segments[row], normal)
            call(p[JAC], at(p[MODEL]), at(addresses[DATA]), moves, 0, segments[row], int32(int(data[pair + 2])))
            if data[pair + 6] > 0:
                copy_part(segments[row], 3, there, 0, 3)
                call(p[JAC], at(p[MODEL]), at(addresses[DATA]), others, 0, there, int32(int(data[pair + 6])))
                for j in range(3 * nv):
                    moves[j] -= others[j]
            for j in range(nv):
                for i in range(3):
                    slopes[first + row, j] -= normal[i] * moves[nv * i + j]
            turn_to_states(x, p, slopes[first + row])
    store(p[FLAGS], slot, 0)


def find_with_data(p, addresses, data, displaced, offset, first, out, which, segments):
    """As `find`, of an MjData that has its positions.

    If `offset` is not negative, obstacles are displaced by the three numbers from displaced[offset + 3 row] on.
    """
    middles, axes, segment = at(addresses[GEOM_XPOS]), at(addresses[GEOM_XMAT]), stack(6)
    for row in range(int(data[1])):
        out[first + row], which[row] = data[LARGEST], -1.0
    for k in range(int(data[2])):
        pair = PAIRS + PAIR * k
        row, own, other = int(data[pair]), 3 * int(data[pair + 1]), 3 * int(data[pair + 3])
        before_x, before_y, before_z = middles[other], middles[other + 1], middles[other + 2]
        if offset >= 0:
            for i in range(3):
                middles[other + i] += displaced[offset + 3 * row + i]
        x, y, z = middles[own] - middles[other], middles[own + 1] - middles[other + 1], middles[own + 2]
        z -= middles[other + 2]
        if data[pair + 5] == 1:
            apart = axes[3 * other + 2] * x + axes[3 * other + 5] * y + axes[3 * other + 8] * z
        else:
            apart = sqrt(x * x + y * y + z * z)
        least = out[first + row]
        if not apart - data[pair + 4] >= least:
            distance = call_for_value(
                p[DISTANCE], at(p[DISTANCE_MODEL]), at(addresses[DATA]), int32(own // 3), int32(other // 3),
                least, segment,
            )  # fmt: skip
            if not distance >= least:
                out[first + row], which[row] = distance, float(k)
                copy(segment, 6, segments[row])
        middles[other], middles[other + 1], middles[other + 2] = before_x, before_y, before_z


def write_normal(addresses, own, other, distance, segment, normal):
    """Write the direction from the robot's nearest point to the obstacle's; if both coincide, from centre to centre."""
    length = 0.0
    for i in range(3):
        normal[i] = segment[3 + i] - segment[i]
        length += normal[i] * normal[i]
    sign = 1.0 if distance >= 0 else -1.0
    if length < TOUCHING * TOUCHING:
        middles = at(addresses[GEOM_XPOS])
        sign, length = 1.0, 0.0
        for i in range(3):
            normal[i] = middles[3 * other + i] - middles[3 * own + i]
            length += normal[i] * normal[i]
    scale = sign / sqrt(length) if length > 0 else 0.0
    for i in range(3):
        normal[i] *= scale


def turn_to_states(x, p, slope):
    """Convert a derivative in angular velocities, in place, to a derivative in the states' rotations.

    A tilt t that changes by dt turns the body by dt - cosine t x dt + cubic t x (t x dt), in its own axes; a turn about
    an axis n that changes by ds, by n - sine t x n + cosine t x (t x n) times ds. Without an axis all is tilt.
    """
    tilt, once, twice = stack(3), stack(3), stack(3)
    for k in range(int(p[JOINTS])):
        kind, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 2])
        if kind <= BALL:
            d = d + 3 if kind == FREE else d
            for i in range(3):
                tilt[i] = (1.0 - p[AXIS + i]) * x[d + i]
            square = tilt[0] * tilt[0] + tilt[1] * tilt[1] + tilt[2] * tilt[2]
            cross(tilt, slope[d], slope[d + 1], slope[d + 2], once)
            cross(tilt, once[0], once[1], once[2], twice)
            for i in range(3):
                if p[AXIS + i] == 1:
                    slope[d + i] += sine_ratio(square) * once[i] + cosine_ratio(square) * twice[i]
                else:
                    slope[d + i] += cosine_ratio(square) * once[i] + cubic_ratio(square) * twice[i]


def cross(tilt, a, b, c, out):
    """Write tilt x (a, b, c)."""
    out[0] = tilt[1] * c - tilt[2] * b
    out[1] = tilt[2] * a - tilt[0] * c
    out[2] = tilt[0] * b - tilt[1] * a

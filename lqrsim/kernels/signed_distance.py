"""The formulas of signed distances of points to primitives, and their derivatives. Written in the kernels' subset.

An obstacle is ROW numbers of a flat table, which begin at index `row`.
"""

from math import inf, sqrt

from lqrsim.kernels.declarations import inline, stack

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 1, 2, 3, 4  # kinds of obstacles, as in `KINDS` of `world.py`


@inline
def signed_distance(data, row: int, x: float, y: float, z: float) -> float:
    """The signed distance of a point to an obstacle; negative inside."""
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    c = data[row + 6] * dx + data[row + 9] * dy + data[row + 12] * dz
    if kind == PLANE:
        return c
    radius, half = data[row + 13], data[row + 14]
    if kind == SPHERE:
        return sqrt(dx * dx + dy * dy + dz * dz) - radius
    a = data[row + 4] * dx + data[row + 7] * dy + data[row + 10] * dz
    b = data[row + 5] * dx + data[row + 8] * dy + data[row + 11] * dz
    if kind == CAPSULE:
        c -= min(max(c, -half), half)
        return sqrt(a * a + b * b + c * c) - radius
    if kind == CYLINDER:
        side, end = sqrt(a * a + b * b) - radius, abs(c) - half
        return sqrt(side * side + end * end) if side > 0 and end > 0 else max(side, end)
    a, b, c = abs(a) - data[row + 13], abs(b) - data[row + 14], abs(c) - data[row + 15]
    inside = max(a, b, c)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return sqrt(a * a + b * b + c * c) if inside > 0 else inside


@inline
def signed_distance_derivatives(data, row: int, x: float, y: float, z: float, gradient, hessian) -> float:
    """The signed distance; write its gradient (3,) and Hessian (3, 3).

    With `v` the vector from the nearest point of the centre or axis and `q` its length, the gradient is `v / q` and the
    Hessian `(F - gradient gradient') / q`, where F projects on the directions in which the obstacle is curved there. On
    an axis or at a centre, where both do not exist, they are set to zero.
    """
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    nx, ny, nz = data[row + 6], data[row + 9], data[row + 12]  # the axis, or a plane's normal
    along = nx * dx + ny * dy + nz * dz
    if kind == BOX:
        return box_derivatives(data, row, dx, dy, dz, gradient, hessian)
    if kind == PLANE:
        return flat_derivatives(along, 1.0, nx, ny, nz, gradient, hessian)
    radius, half = data[row + 13], data[row + 14]
    # The nearest point of the axis is at `shift`; a side is flat along the axis.
    shift, flat = 0.0, 0.0
    if kind == CAPSULE:
        shift = min(max(along, -half), half)
        flat = 1.0 if abs(along) < half else 0.0
    elif kind == CYLINDER:
        shift, flat = along, 1.0
    vx, vy, vz = dx - shift * nx, dy - shift * ny, dz - shift * nz
    length = sqrt(vx * vx + vy * vy + vz * vz)
    if kind == CYLINDER:
        side, end = length - radius, abs(along) - half
        sign = 1.0 if along > 0 else -1.0
        if side > 0 and end > 0:
            gradient[0], gradient[1], gradient[2] = vx, vy, vz
            return rim_derivatives(data, row, side, end * sign, gradient, hessian)
        if end > side:
            return flat_derivatives(end, sign, nx, ny, nz, gradient, hessian)
    inverse = 1 / length if length >= 1e-12 else 0.0
    gradient[0], gradient[1], gradient[2] = inverse * vx, inverse * vy, inverse * vz
    for i in range(3):
        for j in range(3):
            round_there = (1.0 if i == j else 0.0) - flat * data[row + 6 + 3 * i] * data[row + 6 + 3 * j]
            hessian[i, j] = inverse * (round_there - gradient[i] * gradient[j])
    return length - radius


def flat_derivatives(distance: float, sign: float, nx: float, ny: float, nz: float, gradient, hessian) -> float:
    """Write the derivatives of the distance to a face with the normal `sign n`; return the distance."""
    gradient[0], gradient[1], gradient[2] = sign * nx, sign * ny, sign * nz
    for i in range(3):
        for j in range(3):
            hessian[i, j] = 0.0
    return distance


def rim_derivatives(data, row: int, side: float, end: float, gradient, hessian) -> float:
    """Write the derivatives of the distance to the rim of a cylinder; return the distance.

    Args:
      side: distance beyond the side. end: signed distance beyond the end, along the axis.
      gradient: (3,) the vector from the axis; overwritten.
    """
    vx, vy, vz = gradient[0], gradient[1], gradient[2]
    radial = sqrt(vx * vx + vy * vy + vz * vz)
    distance = sqrt(side * side + end * end)
    outward = stack(3)
    outward[0], outward[1], outward[2] = vx / radial, vy / radial, vz / radial
    for i in range(3):
        gradient[i] = (side * outward[i] + end * data[row + 6 + 3 * i]) / distance
    for i in range(3):
        for j in range(3):
            across = outward[i] * outward[j] + data[row + 6 + 3 * i] * data[row + 6 + 3 * j]
            around = (1.0 if i == j else 0.0) - across
            hessian[i, j] = (across - gradient[i] * gradient[j] + around * side / radial) / distance
    return distance


def box_derivatives(data, row: int, dx: float, dy: float, dz: float, gradient, hessian) -> float:
    """As `signed_distance_derivatives`, for a box, at (dx, dy, dz) from its centre."""
    beyond, sign = stack(3), stack(3)
    deepest, face = -inf, 0
    for k in range(3):
        local = data[row + 4 + k] * dx + data[row + 7 + k] * dy + data[row + 10 + k] * dz
        beyond[k] = abs(local) - data[row + 13 + k]
        sign[k] = 1.0 if local > 0 else -1.0
        if beyond[k] > deepest:
            deepest, face = beyond[k], k
    if not deepest > 0:
        axis = row + 4 + face
        return flat_derivatives(deepest, sign[face], data[axis], data[axis + 3], data[axis + 6], gradient, hessian)
    distance = 0.0
    for k in range(3):
        beyond[k] = max(beyond[k], 0.0)
        distance += beyond[k] * beyond[k]
    distance = sqrt(distance)
    for i in range(3):
        gradient[i] = 0.0
        for k in range(3):
            gradient[i] += data[row + 4 + 3 * i + k] * sign[k] * beyond[k] / distance
    for i in range(3):
        for j in range(3):
            total = -gradient[i] * gradient[j]
            for k in range(3):
                if beyond[k] > 0:
                    total += data[row + 4 + 3 * i + k] * data[row + 4 + 3 * j + k]
            hessian[i, j] = total / distance
    return distance

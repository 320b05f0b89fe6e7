"""The distance to each primitive, and the one place where it is written down. The kernels' subset.

Scalars, flat arrays, no allocation. `row` is where an obstacle's numbers start in a table flattened.
"""

from math import inf, sqrt

from lqrsim.kernels.declarations import ROW, inline, outline, stack


@inline
def signed_distance(data, row: int, x: float, y: float, z: float) -> float:
    """Signed distance of (x, y, z) to the obstacle whose `ROW` numbers start at `data[row]`; negative inside."""
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    c = data[row + 6] * dx + data[row + 9] * dy + data[row + 12] * dz
    if kind == 0:
        return c
    radius, half = data[row + 13], data[row + 14]
    if kind == 1:
        return sqrt(dx * dx + dy * dy + dz * dz) - radius
    a = data[row + 4] * dx + data[row + 7] * dy + data[row + 10] * dz
    b = data[row + 5] * dx + data[row + 8] * dy + data[row + 11] * dz
    if kind == 2:
        c -= min(max(c, -half), half)
        return sqrt(a * a + b * b + c * c) - radius
    if kind == 3:
        side, end = sqrt(a * a + b * b) - radius, abs(c) - half
        return sqrt(side * side + end * end) if side > 0 and end > 0 else max(side, end)
    a, b, c = abs(a) - data[row + 13], abs(b) - data[row + 14], abs(c) - data[row + 15]
    inside = max(a, b, c)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return sqrt(a * a + b * b + c * c) if inside > 0 else inside


@inline
def signed_distance_derivatives(data, row: int, x: float, y: float, z: float, gradient, hessian) -> float:
    """Signed distance as above; writes its gradient (3,) and Hessian (3, 3).

    With `v` the vector from the nearest point (or axis) and `q` its length, the gradient is `v / q` and the Hessian
    `(F - gradient gradient') / q`, where F projects on the directions in which the obstacle is round there. On an axis
    or in a centre, where neither exists, both are zero.
    """
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    nx, ny, nz = data[row + 6], data[row + 9], data[row + 12]  # the axis; a plane's normal
    along = nx * dx + ny * dy + nz * dz
    if kind == 4:
        return box_derivatives(data, row, dx, dy, dz, gradient, hessian)
    if kind == 0:
        return flat_derivatives(along, 1.0, nx, ny, nz, gradient, hessian)
    radius, half = data[row + 13], data[row + 14]
    # What is round in all directions has a centre, nearest on the axis at `shift`; a side is flat along the axis.
    shift, flat = 0.0, 0.0
    if kind == 2:
        shift = min(max(along, -half), half)
        flat = 1.0 if abs(along) < half else 0.0
    elif kind == 3:
        shift, flat = along, 1.0
    vx, vy, vz = dx - shift * nx, dy - shift * ny, dz - shift * nz
    length = sqrt(vx * vx + vy * vy + vz * vz)
    if kind == 3:
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
    """A face with the normal `sign n`, at that distance."""
    gradient[0], gradient[1], gradient[2] = sign * nx, sign * ny, sign * nz
    for i in range(3):
        for j in range(3):
            hessian[i, j] = 0.0
    return distance


def rim_derivatives(data, row: int, side: float, end: float, gradient, hessian) -> float:
    """The rim of a cylinder, from `side` beyond its side, `end` (signed) along its axis, `gradient` from its axis.

    Round in the radial and the axial direction; along the rim it turns with the side.
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
    """A box, from `d` from its centre: as `signed_distance_derivatives`."""
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


def nearest(obstacles, count, data, points, out):
    """Write the distance to the nearest of the obstacles, of `count` points (any, 3)."""
    nowhere = stack(3)
    for i in range(count):
        out[i] = nearest_to(obstacles, data, points[i], nowhere, 0)


def nearest_displaced(obstacles, count, each, data, points, displaced, out):
    """The same with obstacles that are elsewhere, by displaced[trial], where each trial has `each` of the points."""
    for i in range(count):
        out[i] = nearest_to(obstacles, data, points[i], displaced[i // each], 1)


@outline
def nearest_to(obstacles, data, point, displaced, moved):
    """The distance of one point (3,) to the nearest; where they have moved, by displaced (3 obstacles,)."""
    least = inf
    for k in range(obstacles):
        x, y, z = point[0], point[1], point[2]
        if moved == 1:
            x, y, z = x - displaced[3 * k], y - displaced[3 * k + 1], z - displaced[3 * k + 2]
        distance = signed_distance(data, ROW * k, x, y, z)
        if not distance >= least:  # NaN, too: nowhere is not far away
            least = distance
    return least


def each_with_normal(obstacles, count, data, points, distances, normals):
    """Write the distance to each obstacle of `count` points (any, 3), and which way it grows: (any,), (any, 3)."""
    for i in range(count):
        for k in range(obstacles):
            at = i * obstacles + k
            distances[at] = distance_with_normal(data, ROW * k, points[i], normals[at])


@outline
def distance_with_normal(data, row, point, normal):
    """That of one point (3,) to one obstacle."""
    curve = stack(3, 3)
    return signed_distance_derivatives(data, row, point[0], point[1], point[2], normal, curve)

"""All formulas of signed distances to obstacles, and their derivatives. Written in the kernels' subset.

An obstacle is ROW numbers of a flat table, which begin at index `row`.
"""

from math import inf, sqrt

from lqrsim.kernels.declarations import ROW, inline, outline, stack


@inline
def signed_distance(data, row: int, x: float, y: float, z: float) -> float:
    """The signed distance of a point to an obstacle; negative inside."""
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
    """The signed distance; write its gradient (3,) and Hessian (3, 3).

    With `v` the vector from the nearest point of the centre or axis and `q` its length, the gradient is `v / q` and the
    Hessian `(F - gradient gradient') / q`, where F projects on the directions in which the obstacle is curved there. On
    an axis or at a centre, where both do not exist, they are set to zero.
    """
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    nx, ny, nz = data[row + 6], data[row + 9], data[row + 12]  # the axis, or a plane's normal
    along = nx * dx + ny * dy + nz * dz
    if kind == 4:
        return box_derivatives(data, row, dx, dy, dz, gradient, hessian)
    if kind == 0:
        return flat_derivatives(along, 1.0, nx, ny, nz, gradient, hessian)
    radius, half = data[row + 13], data[row + 14]
    # The nearest point of the axis is at `shift`; a side is flat along the axis.
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


# Convex polygons in the plane: of a robot, and the outlines of obstacles. Three coordinates each, the third of which is
# not used, in order round the polygon. Two corners are a segment, one is a point.


@outline
def hull_distance(data, row, corners, first, count, pulls) -> float:
    """The signed distance of a convex polygon, corners from `first` on, to an obstacle; negative if they overlap.

    Apart, it is the distance of the nearest points; for an overlap, the shortest move that ends it. Write the
    derivatives in the polygon's corners to pulls (3 count,).
    """
    least, which = overlap(data, row, corners, first, count, pulls), -1
    if not least < 0:
        least = inf
        for k in range(distances_of_hull(data, row, count)):
            distance = distance_of_corner(data, row, corners, first, count, k, pulls)
            if distance < least:
                least, which = distance, k
        distance_of_corner(data, row, corners, first, count, which, pulls)
    return least


def distances_of_hull(data, row, count):
    """The number of distances of which the least counts: of the corners of both; of a round obstacle, its centre."""
    if data[row] == 4:
        return count + 4
    return count if data[row] == 0 else 1


def distance_of_corner(data, row, corners, first, count, which, pulls):
    """The distance of one of the polygon's corners to an obstacle or, after these, of the obstacle's to the polygon."""
    others, at = stack(12), stack(4)
    for k in range(3 * count):
        pulls[k] = 0.0
    if data[row] == 0:
        distance = 0.0
        for i in range(3):
            pulls[3 * which + i] = data[row + 6 + 3 * i]
            distance += data[row + 6 + 3 * i] * (corners[3 * (first + which) + i] - data[row + 1 + i])
        return distance
    sides = write_outline(data, row, others)
    if data[row] == 4 and which < count:
        place = 3 * (first + which)
        distance = point_distance(others, 0, sides, corners[place], corners[place + 1], at)
        pulls[3 * which], pulls[3 * which + 1] = at[NORMAL], at[NORMAL + 1]
        return distance
    place = 3 * (which - count) if data[row] == 4 else 0
    distance = point_distance(corners, first, count, others[place], others[place + 1], at)
    pull_side(int(at[SIDE]), count, at[SHARE], -at[NORMAL], -at[NORMAL + 1], pulls)
    return distance if data[row] == 4 else distance - data[row + 13]


# What `point_distance` and `overlap` find: the side, the nearest point as a share of the way along it, and the normal.
SIDE, SHARE, NORMAL = 0, 1, 2


def point_distance(polygon, first, count, x, y, at):
    """The signed distance of a point to a polygon; what it found is written to `at` (4,), the normal towards it."""
    gap, sign, least = -inf, orientation(polygon, first, count), inf
    for k in range(count):
        here, there = 3 * (first + k), 3 * (first + (k + 1) % count)
        ex, ey = polygon[there] - polygon[here], polygon[there + 1] - polygon[here + 1]
        dx, dy, length = x - polygon[here], y - polygon[here + 1], sqrt(ex * ex + ey * ey)
        share, beyond, nx, ny = 0.0, 0.0, 0.0, 0.0
        if length > 0:
            nx, ny, share = sign * ey / length, -sign * ex / length, (dx * ex + dy * ey) / (length * length)
            beyond = nx * dx + ny * dy
            if count > 2:
                gap = max(gap, beyond)
        if 0 < share < 1:  # the direction of a difference would be lost where the point is on the side
            near = abs(beyond)
            if beyond < 0 and count == 2:
                nx, ny = -nx, -ny
        else:
            share = 0.0 if share <= 0 else 1.0
            dx, dy = dx - share * ex, dy - share * ey
            near = sqrt(dx * dx + dy * dy)
            if near > 0:
                nx, ny = dx / near, dy / near
        if near < least:
            least, at[SIDE], at[SHARE], at[NORMAL], at[NORMAL + 1] = near, float(k), share, nx, ny
    return -least if count > 2 and gap <= 0 else least


def overlap(data, row, corners, first, count, pulls):
    """The depth, below 0, by which a polygon and a box overlap, and its derivatives; else the gap along a normal."""
    others, own, its = stack(12), stack(5), stack(5)
    if data[row] != 4 or count < 2:
        return inf
    write_outline(data, row, others)
    gap = beyond_sides(corners, first, count, others, 0, 4, own)
    behind = beyond_sides(others, 0, 4, corners, first, count, its)
    for k in range(3 * count):
        pulls[k] = 0.0
    if behind > gap:
        corner = int(its[CORNER])
        pulls[3 * corner], pulls[3 * corner + 1] = its[NORMAL], its[NORMAL + 1]
        return behind
    pull_side(int(own[SIDE]), count, own[SHARE], -own[NORMAL], -own[NORMAL + 1], pulls)
    return gap


CORNER = 4  # what `beyond_sides` finds besides: the corner of the other polygon


def beyond_sides(polygon, first, count, others, begin, size, at):
    """The largest gap between a polygon and the corners of another one along the normal of one of its sides."""
    gap, sign = -inf, orientation(polygon, first, count)
    for k in range(count):
        here, there = 3 * (first + k), 3 * (first + (k + 1) % count)
        ex, ey = polygon[there] - polygon[here], polygon[there + 1] - polygon[here + 1]
        length = sqrt(ex * ex + ey * ey)
        if length > 0:
            nx, ny, least, corner = sign * ey / length, -sign * ex / length, inf, 0
            for i in range(size):
                place = 3 * (begin + i)
                along = nx * (others[place] - polygon[here]) + ny * (others[place + 1] - polygon[here + 1])
                if along < least:
                    least, corner = along, i
            if least > gap:
                gap, place = least, 3 * (begin + corner)
                dx, dy = others[place] - polygon[here], others[place + 1] - polygon[here + 1]
                at[SIDE], at[SHARE], at[NORMAL], at[NORMAL + 1] = float(k), (dx * ex + dy * ey) / length**2, nx, ny
                at[CORNER] = float(corner)
    return gap


def orientation(polygon, first, count):
    """1 if a polygon's corners are counterclockwise, or it has no area; else -1."""
    area, x, y = 0.0, polygon[3 * first], polygon[3 * first + 1]
    for k in range(1, count - 1):
        here, there = 3 * (first + k), 3 * (first + k + 1)
        area += (polygon[here] - x) * (polygon[there + 1] - y) - (polygon[there] - x) * (polygon[here + 1] - y)
    return 1.0 if area >= 0 else -1.0


def write_outline(data, row, corners):
    """Write the corners (12,) of a box on the plane, or the centre of another obstacle; return their number."""
    for i in range(3):
        corners[i] = data[row + 1 + i]
    if data[row] != 4:
        return 1
    one, two = 0, 1  # the axes in the plane
    for axis in range(2):
        if abs(data[row + 10 + axis]) > 0.5:  # it stands on this one
            one, two = 1 - axis, 2
    for k in range(4):
        a, b = 1.0 if k == 1 or k == 2 else -1.0, 1.0 if k >= 2 else -1.0
        for i in range(2):
            along = a * data[row + 13 + one] * data[row + 4 + 3 * i + one]
            corners[3 * k + i] = data[row + 1 + i] + along + b * data[row + 13 + two] * data[row + 4 + 3 * i + two]
        corners[3 * k + 2] = 0.0
    return 4


def pull_side(side, count, share, x, y, pulls):
    """Write the derivatives of a distance that depends on a point of a side, in the corners at its ends."""
    after = (side + 1) % count
    pulls[3 * side], pulls[3 * side + 1] = (1 - share) * x, (1 - share) * y
    pulls[3 * after] += share * x
    pulls[3 * after + 1] += share * y


def hull_distances(obstacles, count, each, data, parts, size, corners, displaced, out, pulls):
    """Write the distances (count parts obstacles,) of robots of convex polygons, and their derivatives in the corners.

    Args:
      each: robots per trial. parts: the first corner of each polygon, and the end of the last.
      size: number of the polygons. corners: (count, 3 B). displaced: as in `nearest`.
      pulls: (count parts obstacles, at least 3 for each corner of a polygon).
    """
    for i in range(count):
        for part in range(size):
            for k in range(obstacles):
                at, moved = (i * size + part) * obstacles + k, obstacles * (i // each) + k
                first, end = int(parts[part]), int(parts[part + 1])
                out[at] = hull_distance_displaced(data, k, corners[i], first, end, displaced[moved], pulls[at])


@outline
def hull_distance_displaced(data, number, corners, first, end, displaced, pulls):
    """The distance of one polygon to one obstacle that is displaced by (3,)."""
    obstacle = stack(ROW)
    for i in range(ROW):
        obstacle[i] = data[ROW * number + i]
    for i in range(3):
        obstacle[1 + i] += displaced[i]
    return hull_distance(obstacle, 0, corners, first, end - first, pulls)


def nearest(obstacles, count, each, data, points, displaced, out):
    """Write the distances (count,) of points (count, 3) to the nearest of the obstacles.

    Args:
      each: points per trial. displaced: (trials obstacles, 3) displacements of the obstacles, trial by trial.
    """
    for i in range(count):
        out[i] = nearest_to(obstacles, data, points[i], displaced, obstacles * (i // each))


@outline
def nearest_to(obstacles, data, point, displaced, first):
    """The distance of one point (3,) to the nearest obstacle. Obstacles are displaced by the rows from `first` on."""
    least = inf
    for k in range(obstacles):
        x, y = point[0] - displaced[first + k, 0], point[1] - displaced[first + k, 1]
        z = point[2] - displaced[first + k, 2]
        distance = signed_distance(data, ROW * k, x, y, z)
        if not distance >= least:  # a NaN stays
            least = distance
    return least


def each_with_normal(obstacles, count, data, points, distances, normals):
    """Write the distances (count obstacles,) of points (count, 3) to all obstacles, and their gradients (any, 3)."""
    for i in range(count):
        for k in range(obstacles):
            at = i * obstacles + k
            distances[at] = distance_with_normal(data, ROW * k, points[i], normals[at])


@outline
def distance_with_normal(data, row, point, normal):
    """The distance of one point (3,) to one obstacle; write its gradient (3,)."""
    curve = stack(3, 3)
    return signed_distance_derivatives(data, row, point[0], point[1], point[2], normal, curve)

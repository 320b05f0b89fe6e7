"""Signed distances to obstacles: of points, of convex hulls, and of robots at many states at once.

An obstacle is ROW numbers of a flat table, which begin at index `row`. Of a point and a primitive the distance is a
formula. Of a hull, in space or in a plane, let M be the set of all differences of a point of the robot and a point of
the obstacle. The signed distance is that of the origin to M: apart, the length of M's shortest vector, by the method of
Gilbert, Johnson and Keerthi; for an overlap, the depth below M's nearest face, by an expanding polytope within M. That
is the shortest move that ends the overlap. Both methods evaluate only *supports* of M, its farthest points in a
direction.

An infinite obstacle makes M a prism without ends, whose faces are edges of its projection. In a plane all are infinite.
"""

from math import copysign, inf, isnan, nan, sqrt

from lqrsim.kernels.declarations import ROW, compact, inline, outline, places, places_jacobian, stack, zeros

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 1, 2, 3, 4  # kinds of obstacles, as in `KINDS` of `world.py`
MESH = 5  # kind of an obstacle that is the convex hull of corners; its row has their number and where they begin
MOST_CORNERS = 64  # of one hull of a robot; distances take time in proportion to its corners
STEPS = 60  # largest number of supports; corners need fewer, the rim of a cylinder some 20
POINTS, FACES = 64, 256  # largest numbers of points and of faces of the polytope within M
ROUNDING = 1e-14  # error of a distance, relative to the size of M
TOUCHING = 1e-12  # distance, relative to the size of M, below which robot and obstacle touch
SHORT = 1e-6  # length, relative to the size of M, below which a difference has lost its direction
CORNER = 3  # index in a point of M, after its coordinates: the number of the robot's corner


# Of points.


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
        if k == 0 or beyond[k] > deepest:  # a NaN stays
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


# Of hulls.


@outline
def hull_distance(data, row, corners, first, count, gradient) -> float:
    """The signed distance, NaN if a corner is; write its derivatives in the robot's corners to gradient (3 count,).

    Args:
      corners: the robot's corners, from the one numbered `first` on, in any order.
    """
    simplex, weights, normal, axis, curve = zeros(4, 4), zeros(4), stack(3), zeros(3), stack(3, 3)
    for k in range(3 * count):
        gradient[k] = 0.0
    for k in range(3 * count):
        if isnan(corners[3 * first + k]):
            return nan
    if count == 1 and data[row] != MESH:
        x, y, z = corners[3 * first], corners[3 * first + 1], corners[3 * first + 2]
        return signed_distance_derivatives(data, row, x, y, z, gradient, curve)
    if data[row] == PLANE:
        return distance_to_plane(data, row, corners, first, count, gradient)
    write_axis(data, row, axis)
    distance = shortest(data, row, corners, first, count, axis, simplex, weights, normal)
    if not distance > 0:
        distance = nearest_face(data, row, corners, first, count, axis, simplex, weights, normal)
    for k in range(4):
        corner = 3 * int(simplex[k, CORNER])
        for i in range(3):
            gradient[corner + i] += weights[k] * normal[i]
    return distance - rounding_radius(data, row)


def distance_to_plane(data, row, corners, first, count, gradient):
    """The distance of the lowest corner."""
    least, lowest = inf, 0
    for k in range(count):
        distance = 0.0
        for i in range(3):
            distance += data[row + 6 + 3 * i] * (corners[3 * (first + k) + i] - data[row + 1 + i])
        if distance < least:
            least, lowest = distance, k
    for i in range(3):
        gradient[3 * lowest + i] = data[row + 6 + 3 * i]
    return least


def shortest(data, row, corners, first, count, axis, simplex, weights, normal):
    """The length of M's shortest vector, or 0 for an overlap; write its direction.

    Write the points of M of which the vector is a mean, at most 4, and their weights; the other weights are 0.
    """
    v, size, square, square_extent = stack(3), 0, inf, 0.0
    for i in range(3):
        v[i] = corners[3 * first + i] - data[row + 1 + i]
    for _ in range(STEPS):
        write_support(data, row, corners, first, count, axis, -v[0], -v[1], -v[2], simplex[size])
        square_extent = max(square_extent, dot(simplex[size], simplex[size]))
        if square < inf and square - dot(v, simplex[size]) <= ROUNDING * sqrt(square * square_extent):
            break
        left = reduce(simplex, size, square, weights, v)
        if left == 0:
            break
        size, square = left, dot(v, v)
        if size == 4 or square <= TOUCHING * TOUCHING * square_extent:  # the origin is in M, to rounding
            return 0.0
    prism = dot(axis, axis) > 0
    if square <= SHORT * SHORT * square_extent and size == (2 if prism else 3):
        write_normal(simplex, prism, axis, normal)
        scale = copysign(1.0, dot(normal, v))
    else:
        scale = 1 / sqrt(square)
        normal[0], normal[1], normal[2] = v[0], v[1], v[2]
    for i in range(3):
        normal[i] *= scale
    return dot(normal, v)


def reduce(simplex, size, square, weights, v):
    """Reduce a simplex, with a point added at `size`, to the face with the point nearest to the origin.

    Write that point to v, and its weights; return the number of points. Return 0 if no face is nearer than before;
    `square` is the squared distance so far.
    """
    which, trial, nearest = stack(4), stack(4), stack(3)
    best, kept, faces = square, 0, 1 if size == 0 else 2 if size == 1 else 4 if size == 2 else 8
    for face in range(faces):  # the new point, with any of the others
        number = write_face(face, size, which)
        if weigh(simplex, number, which, trial) and least_of(trial, number) >= 0:
            write_mean(simplex, number, which, trial, nearest)
            if dot(nearest, nearest) < best:
                best, kept = dot(nearest, nearest), face + 1
                v[0], v[1], v[2] = nearest[0], nearest[1], nearest[2]
    if kept == 0:
        return 0
    number = write_face(kept - 1, size, which)
    weigh(simplex, number, which, trial)
    for k in range(4):  # the new point, the first of the face, goes last
        weights[k] = 0.0
    for k in range(number):
        source = int(which[(k + 1) % number])
        weights[k] = trial[(k + 1) % number]
        for i in range(4):
            simplex[k, i] = simplex[source, i]
    return number


def write_face(face, size, which):
    """Write the indices of a face's points: the new point `size`, then each point k < size whose bit is set in `face`.

    Return how many.
    """
    which[0], number, bits = float(size), 1, face
    for k in range(size):
        if bits % 2 == 1:
            which[number] = float(k)
            number += 1
        bits = bits // 2
    return number


def weigh(points, number, which, weights):
    """Write the weights of points by which their mean is, of all points of the affine hull, nearest to the origin.

    Return whether they exist.
    """
    sides, origin, across = stack(3, 3), points[int(which[0])], stack(3)
    for k in range(number - 1):
        for i in range(3):
            sides[k, i] = points[int(which[k + 1]), i] - origin[i]
    if number == 2:
        size = dot(sides[0], sides[0])
        weights[1] = -dot(origin, sides[0]) / size if size > 0 else -1.0
    elif number > 2:
        if number == 3:
            cross(sides[0], sides[1], sides[2])
        cross(sides[1], sides[2], across)
        size = dot(sides[0], across)
        if size == 0:
            return False
        weights[1] = -dot(origin, across) / size
        cross(sides[2], sides[0], across)
        weights[2] = -dot(origin, across) / size
        cross(sides[0], sides[1], across)
        weights[number - 1] = -dot(origin, across) / size if number == 4 else weights[2]
    weights[0] = 1.0
    for k in range(1, number):
        weights[0] -= weights[k]
    return True


def write_mean(points, number, which, weights, mean):
    """Write the mean of points by their weights."""
    for i in range(3):
        mean[i] = 0.0
        for k in range(number):
            mean[i] += weights[k] * points[int(which[k]), i]


def least_of(weights, number):
    """The least of some weights."""
    least = weights[0]
    for k in range(1, number):
        least = min(least, weights[k])
    return least


@compact
def nearest_face(data, row, corners, first, count, axis, simplex, weights, normal):
    """The depth of the origin in M, below 0; write the direction out of it, from the obstacle to the robot.

    Write the points of the nearest face, and their weights. If M is flat, the depth is 0, and both stay.
    """
    points, faces, normals, depths = stack(POINTS, 4), stack(FACES, 3), stack(FACES, 3), stack(FACES)
    extent, total, size, face, prism = 0.0, 0, 4, 0, dot(axis, axis) > 0
    extent = write_seed(data, row, corners, first, count, axis, points, normal)
    if extent == 0:
        return 0.0
    if prism:  # the third point of each face is the direction of the axis
        points[3, 0], points[3, 1], points[3, 2], points[3, CORNER] = axis[0], axis[1], axis[2], 0.0
    for k in range(3 if prism else 4):
        one, two = ((k + 1) % 3, 3) if prism else ((k + 1 + k % 2) % 4, (k + 2 - k % 2) % 4)
        total = add_face(points, k, one, two, prism, faces, normals, depths, total)
    within = ROUNDING * extent
    while True:
        for k in range(total):
            if k == 0 or depths[k] < depths[face]:
                face = k
        if size == POINTS or 2 * total > FACES:
            break
        x, y, z = normals[face, 0], normals[face, 1], normals[face, 2]
        write_support(data, row, corners, first, count, axis, x, y, z, points[size])
        if dot(normals[face], points[size]) <= depths[face] + within:
            break
        total = add_point(points, size, face, prism, within, faces, normals, depths, total)
        size, face = size + 1, 0
    return -choose_face(points, face, within, prism, faces, normals, depths, total, simplex, weights, normal)


@compact
def add_face(points, i, j, k, prism, faces, normals, depths, total):
    """Add a face, its normal by the right hand, and the origin's depth below it; return the number of faces."""
    one, two, normal = stack(3), stack(3), normals[total]
    for m in range(3):
        one[m] = points[j, m] - points[i, m]
        two[m] = points[k, m] - (0.0 if prism else points[i, m])
    cross(one, two, normal)
    length = sqrt(dot(normal, normal))
    for m in range(3):
        normal[m] = normal[m] / length if length > 0 else 0.0
    faces[total, 0], faces[total, 1], faces[total, 2] = float(i), float(j), float(k)
    depths[total] = dot(normal, points[i]) if length > 0 else inf
    return total + 1


@compact
def add_point(points, new, face, prism, within, faces, normals, depths, total):
    """Add a point beyond a face: it replaces the faces that it sees. Return the number of faces."""
    visible, count = stack(FACES), total
    for k in range(total):
        visible[k] = 1.0 if k == face or dot(normals[k], points[new]) > depths[k] - within else 0.0
    for k in range(total):
        if visible[k] == 1:
            for side in range(1 if prism else 0, 3):
                one, two = faces[k, side], faces[k, (side + 1) % 3]
                if not has_side(faces, visible, total, two, one) and count < FACES:
                    if prism and one == 3:
                        count = add_face(points, int(two), new, 3, prism, faces, normals, depths, count)
                    elif prism:
                        count = add_face(points, new, int(one), 3, prism, faces, normals, depths, count)
                    else:
                        count = add_face(points, int(one), int(two), new, prism, faces, normals, depths, count)
    left = 0
    for k in range(count):
        if k >= total or visible[k] == 0:
            for i in range(3):
                faces[left, i], normals[left, i] = faces[k, i], normals[k, i]
            depths[left] = depths[k]
            left += 1
    return left


@compact
def has_side(faces, visible, total, one, two):
    """Whether a visible face has the side from a point to another."""
    for k in range(total):
        if visible[k] == 1:
            for side in range(3):
                if faces[k, side] == one and faces[k, (side + 1) % 3] == two:
                    return True
    return False


@compact
def choose_face(points, face, within, prism, faces, normals, depths, total, simplex, weights, normal):
    """Of the faces of a flat side write the one that contains the origin's projection; return the depth."""
    trial, number, best = stack(4), 2 if prism else 3, -inf
    for k in range(total):
        alike = dot(normals[k], normals[face]) > 1 - TOUCHING and depths[k] <= depths[face] + within
        if alike and weigh(points, number, faces[k], trial) and least_of(trial, number) > best:
            best = least_of(trial, number)
            for i in range(3):
                weights[i] = trial[i] if i < number else 0.0
                normal[i] = -normals[k, i]
                for m in range(4):
                    simplex[i, m] = points[int(faces[k, i]), m]
    weights[3] = 0.0
    return max(depths[face], 0.0)


@compact
def write_seed(data, row, corners, first, count, axis, points, normal):
    """Write four points of M that are in no plane, and return its size; of a prism three, in no line.

    Return 0 if M is flat, and write the normal.
    """
    basis, off, trial, known, extent = zeros(4, 3), stack(3), stack(4), 1 if dot(axis, axis) > 0 else 0, 0.0
    for i in range(3):
        basis[0, i] = axis[i]
    write_support(data, row, corners, first, count, axis, 1.0, 0.5, 0.25, points[0])
    for k in range(1, 4 - known):
        widest = -1.0
        for side in range(6):
            for i in range(3):
                off[i] = (1.0 if side < 3 else -1.0) if i == side % 3 else 0.0
            length = orthogonalize(basis, known + k - 1, off)
            if length > 0.5:  # of three directions, one is this far from those before
                write_support(data, row, corners, first, count, axis, off[0], off[1], off[2], trial)
                if widest < 0:
                    normal[0], normal[1], normal[2] = off[0] / length, off[1] / length, off[2] / length
                    widest = 0.0
                for i in range(3):
                    off[i] = trial[i] - points[0, i]
                length = orthogonalize(basis, known + k - 1, off)
                if length > widest:
                    widest = length
                    for i in range(4):
                        points[k, i] = trial[i]
                    for i in range(3):
                        basis[known + k - 1, i] = off[i] / length
        extent = max(extent, widest)
        if widest <= TOUCHING * extent:
            return 0.0
    cross(basis[known], basis[known + 1], off)
    if (dot(off, basis[0]) if known == 1 else -dot(off, basis[2])) < 0:
        for i in range(4):
            points[1, i], points[2, i] = points[2, i], points[1, i]
    return extent


@compact
def orthogonalize(basis, known, vector):
    """Remove the parts of a vector along the first directions of a basis; return the length of what is left."""
    for k in range(known):
        part = dot(basis[k], vector)
        for i in range(3):
            vector[i] -= part * basis[k, i]
    return sqrt(dot(vector, vector))


def write_normal(points, prism, axis, normal):
    """Write the unit normal of three points, or of two of a prism's."""
    one, two = stack(3), stack(3)
    for i in range(3):
        one[i] = points[1, i] - points[0, i]
        two[i] = axis[i] if prism else points[2, i] - points[0, i]
    cross(one, two, normal)
    length = sqrt(dot(normal, normal))
    for i in range(3):
        normal[i] = normal[i] / length if length > 0 else 0.0


def write_support(data, row, corners, first, count, axis, x, y, z, point):
    """Write M's farthest point in a direction, and the number of the robot's corner."""
    farthest, corner = -inf, 0
    for k in range(count):
        at = 3 * (first + k)
        along = x * corners[at] + y * corners[at + 1] + z * corners[at + 2]
        if along > farthest:
            farthest, corner = along, k
    write_obstacle_support(data, row, -x, -y, -z, point)
    for i in range(3):
        point[i] = corners[3 * (first + corner) + i] - point[i]
    along = dot(axis, point)
    for i in range(3):
        point[i] -= along * axis[i]
    point[CORNER] = float(corner)


def write_obstacle_support(data, row, x, y, z, point):
    """Write the obstacle's farthest point in a direction, without what `rounding_radius` adds and what is infinite."""
    kind, half, local = data[row], data[row + 14], zeros(3)
    a = data[row + 4] * x + data[row + 7] * y + data[row + 10] * z
    b = data[row + 5] * x + data[row + 8] * y + data[row + 11] * z
    c = data[row + 6] * x + data[row + 9] * y + data[row + 12] * z
    if (kind == CAPSULE or kind == CYLINDER) and half < inf:
        local[2] = copysign(half, c)
        across = sqrt(a * a + b * b)
        if kind == CYLINDER and across > 0:
            local[0], local[1] = a / across * data[row + 13], b / across * data[row + 13]
    elif kind == BOX:
        local[0] = copysign(data[row + 13], a) if data[row + 13] < inf else 0.0
        local[1] = copysign(data[row + 14], b) if data[row + 14] < inf else 0.0
        local[2] = copysign(data[row + 15], c) if data[row + 15] < inf else 0.0
    elif kind == MESH:
        farthest, corner, at = -inf, 0, row + int(data[row + 13])
        for k in range(int(half)):
            along = a * data[at + 3 * k] + b * data[at + 3 * k + 1] + c * data[at + 3 * k + 2]
            if along > farthest:
                farthest, corner = along, at + 3 * k
        local[0], local[1], local[2] = data[corner], data[corner + 1], data[corner + 2]
    for i in range(3):
        turn = row + 4 + 3 * i
        point[i] = data[row + 1 + i] + data[turn] * local[0] + data[turn + 1] * local[1] + data[turn + 2] * local[2]


def rounding_radius(data, row):
    """The radius by which an obstacle goes beyond its supports."""
    kind = data[row]
    endless = kind == CYLINDER and data[row + 14] == inf
    return data[row + 13] if kind == SPHERE or kind == CAPSULE or endless else 0.0


def write_axis(data, row, axis):
    """Write the direction in which an obstacle is infinite, to an array of zeros."""
    for k in range(3):
        long = data[row + 14] == inf and k == 2 and (data[row] == CAPSULE or data[row] == CYLINDER)
        if long or (data[row + 13 + k] == inf and data[row] >= BOX):
            for i in range(3):
                axis[i] = data[row + 4 + 3 * i + k]


def dot(a, b):
    """The product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b, out):
    """Write a x b."""
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


# Of robots to all obstacles, and the centres of their balls.


def hull_distances(obstacles, count, per_displacement, data, parts, hull_count, corners, displaced, out, slopes):
    """Write the distances (count hulls obstacles,) of robots made of hulls, and their derivatives in the corners.

    Args:
      per_displacement: number of consecutive robots for which the obstacles are displaced alike.
      parts: index of each hull's first corner, then the number B of corners. hull_count: number of hulls.
      corners: (count, 3 B). displaced: (trials obstacles, 3) displacements of the obstacles, trial by trial.
      slopes: (count hulls obstacles, at least 3 for each corner of a hull).
    """
    for i in range(count):
        for part in range(hull_count):
            for k in range(obstacles):
                at, shift = (i * hull_count + part) * obstacles + k, obstacles * (i // per_displacement) + k
                first, end = int(parts[part]), int(parts[part + 1])
                out[at] = hull_distance_displaced(data, ROW * k, corners[i], first, end, displaced[shift], slopes[at])


@outline
def hull_distance_displaced(data, row, corners, first, end, displaced, gradient):
    """The distance of one hull to one obstacle that is displaced by (3,)."""
    relative = stack(3 * MOST_CORNERS)
    for k in range(end - first):
        for i in range(3):
            relative[3 * k + i] = corners[3 * (first + k) + i] - displaced[i]
    return hull_distance(data, row, relative, 0, end - first, gradient)


def nearest(obstacles, count, per_displacement, data, points, displaced, out):
    """Write the distances (count,) of points (count, 3) to the nearest of the obstacles.

    Args:
      per_displacement: number of consecutive points for which the obstacles are displaced alike.
      displaced: (trials obstacles, 3) displacements of the obstacles, trial by trial.
    """
    for i in range(count):
        out[i] = nearest_to(obstacles, data, points[i], displaced, obstacles * (i // per_displacement))


@outline
def nearest_to(obstacles, data, point, displaced, first):
    """The distance of one point (3,) to the nearest obstacle. Obstacles are displaced by the rows from `first` on."""
    least, relative, corner_slopes = inf, stack(3), stack(3)
    for k in range(obstacles):
        for i in range(3):
            relative[i] = point[i] - displaced[first + k, i]
        if data[ROW * k] == MESH:
            distance = hull_distance(data, ROW * k, relative, 0, 1, corner_slopes)
        else:
            distance = signed_distance(data, ROW * k, relative[0], relative[1], relative[2])
        if distance < least or isnan(distance):
            least = distance
    return least


def write_centres(count, states, data, out):
    """Write the centres (count, 3 balls) at states (count, N)."""
    for i in range(count):
        centres_at(states[i], data, out[i])


def write_centres_and_jacobians(count, states, data, out, slopes):
    """Write the centres, and their Jacobians (count, 3 balls, N) into arrays of zeros."""
    for i in range(count):
        jacobian_at(states[i], data, out[i], slopes[i])


@outline
def centres_at(x, data, out):
    """Write the centres at one state."""
    places(x, data, out)


@outline
def jacobian_at(x, data, out, slopes):
    """Write the centres and their Jacobian at one state."""
    places_jacobian(x, data, out, slopes)

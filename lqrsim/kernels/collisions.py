"""The centres of robots' balls, and distances of robots to all obstacles, at many states at once."""

from math import inf, isnan

from lqrsim.kernels.declarations import ROW, outline, places, places_jacobian, stack
from lqrsim.kernels.hull_distance import MESH, hull_distance
from lqrsim.kernels.signed_distance import signed_distance

MOST_CORNERS = 64  # of one hull of a robot; distances take time in proportion to its corners


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
                at, moved = (i * hull_count + part) * obstacles + k, obstacles * (i // per_displacement) + k
                first, end = int(parts[part]), int(parts[part + 1])
                out[at] = hull_distance_displaced(data, ROW * k, corners[i], first, end, displaced[moved], slopes[at])


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

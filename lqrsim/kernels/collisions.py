"""The centres of robots' balls, and distances of robots to all obstacles, at many states at once."""

from math import inf, isnan

from lqrsim.kernels.declarations import ROW, outline, places, places_jacobian, stack
from lqrsim.kernels.hull_distance import MESH, hull_distance
from lqrsim.kernels.signed_distance import signed_distance

MOST_CORNERS = 64  # of one hull of a robot; distances take time in proportion to its corners


def hull_distances(obstacles, count, each, data, parts, size, corners, displaced, out, slopes):
    """Write the distances (count parts obstacles,) of robots made of hulls, and their derivatives in the corners.

    Args:
      each: robots per trial. parts: each hull's first corner, and then the number B of all. size: that of hulls.
      corners: (count, 3 B). displaced: (trials obstacles, 3) displacements of the obstacles, trial by trial.
      slopes: (count parts obstacles, at least 3 for each corner of a hull).
    """
    for i in range(count):
        for part in range(size):
            for k in range(obstacles):
                at, moved = (i * size + part) * obstacles + k, obstacles * (i // each) + k
                first, end = int(parts[part]), int(parts[part + 1])
                out[at] = hull_distance_displaced(data, ROW * k, corners[i], first, end, displaced[moved], slopes[at])


@outline
def hull_distance_displaced(data, row, corners, first, end, displaced, gradient):
    """The distance of one hull to one obstacle that is displaced by (3,)."""
    there = stack(3 * MOST_CORNERS)
    for k in range(end - first):
        for i in range(3):
            there[3 * k + i] = corners[3 * (first + k) + i] - displaced[i]
    return hull_distance(data, row, there, 0, end - first, gradient)


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
    least, there, corner_slopes = inf, stack(3), stack(3)
    for k in range(obstacles):
        for i in range(3):
            there[i] = point[i] - displaced[first + k, i]
        if data[ROW * k] == MESH:
            distance = hull_distance(data, ROW * k, there, 0, 1, corner_slopes)
        else:
            distance = signed_distance(data, ROW * k, there[0], there[1], there[2])
        if distance < least or isnan(distance):
            least = distance
    return least


def centres_of(count, states, data, out):
    """Write the centres (count, 3 balls) at states (count, N)."""
    for i in range(count):
        centres_at(states[i], data, out[i])


def jacobians_of(count, states, data, out, slopes):
    """Write the centres, and their Jacobians (count, 3 balls, N), which the caller has set to zero."""
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

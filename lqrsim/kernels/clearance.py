"""The distance to each obstacle, less what there must be of it. The kernels' subset.

`data` has for how many steps there are least distances, of which the last hold from there on, and for how many
obstacles, of which one holds for all; how many obstacles there are, and at how many steps they are told, of which the
last holds from there on; then the least distances, a step after the other, and for each step the ROW numbers of each
obstacle.
"""

from lqrsim.kernels.declarations import ROW, stack
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AXES = (0, 1, 2)  # which states are the position; two of them in a plane, whose third coordinate is 0


def value(x, u, t, row, data):
    """What the obstacle of that row leaves to spare."""
    steps, each = int(data[0]), int(data[1])
    least = data[4 + min(t, steps - 1) * each + row % each]
    at = 4 + steps * each + ROW * (int(data[2]) * min(t, int(data[3]) - 1) + row)
    return signed_distance(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0) - least


def slope(x, u, t, row, data, gradient):
    """Add its gradient."""
    normal, curve = stack(3), stack(3, 3)
    at = 4 + int(data[0]) * int(data[1]) + ROW * (int(data[2]) * min(t, int(data[3]) - 1) + row)
    signed_distance_derivatives(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0, normal, curve)
    for i in range(len(AXES)):
        gradient[AXES[i]] += normal[i]

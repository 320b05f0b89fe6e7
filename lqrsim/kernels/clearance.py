"""The distance to each obstacle, less what there must be of it. The numba subset; see `declarations.py`.

`data` has for how many steps there are least distances, of which the last hold from there on, and for how many
obstacles, of which one holds for all; then these, a step after the other, and the ROW numbers of each obstacle.
"""

from lqrsim.kernels.declarations import ROW, stack
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AXES = (0, 1, 2)  # which states are the position; two of them in a plane, whose third coordinate is 0


def value(x, u, t, row, data):
    """What the obstacle of that row leaves to spare."""
    steps, each = int(data[0]), int(data[1])
    at, least = 2 + steps * each + ROW * row, data[2 + min(t, steps - 1) * each + row % each]
    return signed_distance(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0) - least


def slope(x, u, t, row, data, gradient):
    """Add its gradient."""
    normal, curve = stack(3), stack(3, 3)
    at = 2 + int(data[0]) * int(data[1]) + ROW * row
    signed_distance_derivatives(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0, normal, curve)
    for i in range(len(AXES)):
        gradient[AXES[i]] += normal[i]

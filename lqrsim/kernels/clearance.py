"""The distance to each obstacle, less what there must be of it. The numba subset; see `declarations.py`.

`data` has the least distance, then the ROW numbers of each obstacle.
"""

from lqrsim.kernels.declarations import ROW, stack
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AXES = (0, 1, 2)  # which states are the position; two of them in a plane, whose third coordinate is 0


def value(x, u, t, row, data):
    """What the obstacle of that row leaves to spare."""
    return signed_distance(data, 1 + ROW * row, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0) - data[0]


def slope(x, u, t, row, data, gradient):
    """Add its gradient."""
    normal, curve = stack(3), stack(3, 3)
    signed_distance_derivatives(
        data, 1 + ROW * row, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0, normal, curve
    )
    for i in range(len(AXES)):
        gradient[AXES[i]] += normal[i]

"""`weight * sum over obstacles of exp(-sharpness * (distance - radius))`. The kernels' subset.

`data` has the radius, the sharpness, the weight, how many obstacles there are and at how many steps they are told, of
which the last holds from there on; and for each of these the ROW numbers of each obstacle. The obstacles are taken by
blocks, whose exponentials are worked out together.
"""

from lqrsim.kernels.declarations import ROW, stack
from lqrsim.kernels.exponential import exponential
from lqrsim.kernels.linear_algebra import clear
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AXES = (0, 1, 2)  # which states are the position; two of them in a plane, whose third coordinate is 0
BLOCK = 8


def value(x, u, t, data):
    """The cost; none at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        costs, count = stack(BLOCK), int(data[3])
        first = 5 + ROW * count * min(t, int(data[4]) - 1)
        for block in range(0, count, BLOCK):
            size = min(BLOCK, count - block)
            for i in range(BLOCK):
                costs[i] = 0.0
            for i in range(size):
                at = first + ROW * (block + i)
                distance = signed_distance(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0)
                costs[i] = -data[1] * (distance - data[0])
            for i in range(BLOCK):
                costs[i] = exponential(costs[i])
            for i in range(size):
                total += costs[i]
    return data[2] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost."""
    total = 0.0
    if t > 0:
        slope, curve, slopes, curves = stack(BLOCK, 3), stack(BLOCK, 3, 3), stack(3), stack(3, 3)
        costs, count = stack(BLOCK), int(data[3])
        clear(curves, 3, 3)
        for j in range(3):
            slopes[j] = 0.0
        first = 5 + ROW * count * min(t, int(data[4]) - 1)
        for block in range(0, count, BLOCK):
            size = min(BLOCK, count - block)
            for i in range(BLOCK):
                costs[i] = 0.0
            for i in range(size):
                at = first + ROW * (block + i)
                distance = signed_distance_derivatives(
                    data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0, slope[i], curve[i]
                )
                costs[i] = -data[1] * (distance - data[0])
            for i in range(BLOCK):
                costs[i] = exponential(costs[i])
            for i in range(size):
                cost = data[2] * costs[i]
                total += cost
                for j in range(3):
                    slopes[j] -= cost * slope[i, j]
                    for k in range(3):
                        curves[j, k] += cost * (data[1] * slope[i, j] * slope[i, k] - curve[i, j, k])
        for j in range(len(AXES)):
            gradient[AXES[j]] += data[1] * slopes[j]
            for k in range(len(AXES)):
                hessian[AXES[j], AXES[k]] += data[1] * curves[j, k]
    return total

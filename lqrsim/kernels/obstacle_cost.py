"""`weight * sum over obstacles of exp(-sharpness * (distance - radius))`. The kernels' subset.

`data` has the radius, the sharpness, the weight, how many obstacles there are and at how many steps they are told, of
which the last holds from there on; and for each of these the ROW numbers of each obstacle.
"""

from math import exp

from lqrsim.kernels.declarations import ROW, stack
from lqrsim.kernels.linear_algebra import clear
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AXES = (0, 1, 2)  # which states are the position; two of them in a plane, whose third coordinate is 0


def value(x, u, t, data):
    """The cost; none at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        first = 5 + ROW * int(data[3]) * min(t, int(data[4]) - 1)
        for i in range(int(data[3])):
            at = first + ROW * i
            distance = signed_distance(data, at, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0)
            total += exp(-data[1] * (distance - data[0]))
    return data[2] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost."""
    total = 0.0
    if t > 0:
        slope, curve, slopes, curves = stack(3), stack(3, 3), stack(3), stack(3, 3)
        clear(curves, 3, 3)
        for j in range(3):
            slopes[j] = 0.0
        first = 5 + ROW * int(data[3]) * min(t, int(data[4]) - 1)
        for i in range(int(data[3])):
            distance = signed_distance_derivatives(
                data, first + ROW * i, x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0, slope, curve
            )
            cost = data[2] * exp(-data[1] * (distance - data[0]))
            total += cost
            for j in range(3):
                slopes[j] -= cost * slope[j]
                for k in range(3):
                    curves[j, k] += cost * (data[1] * slope[j] * slope[k] - curve[j, k])
        for j in range(len(AXES)):
            gradient[AXES[j]] += data[1] * slopes[j]
            for k in range(len(AXES)):
                hessian[AXES[j], AXES[k]] += data[1] * curves[j, k]
    return total

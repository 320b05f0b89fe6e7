"""A cost that is a user's own function, called at its address. The kernels' subset.

`data` has the addresses of the function and of its derivatives, then the parameters. Where no derivatives are given,
`cost_differences.py` has them.
"""

from math import nan

from lqrsim.kernels.declarations import W, call, stack
from lqrsim.kernels.linear_algebra import clear


def value(x, u, t, data):
    """The cost; NaN where the function does not write one."""
    out = stack(1)
    out[0] = nan
    call(data[0], x, u, data, out)
    return out[0]


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian, made symmetric, and the gradient, and return the cost."""
    slope, curve = stack(W), stack(W, W)
    clear(curve, W, W)
    for i in range(W):
        slope[i] = 0.0
    call(data[1], x, u, data, slope, curve)
    for i in range(W):
        gradient[i] += slope[i]
        for j in range(W):
            hessian[i, j] += 0.5 * (curve[i, j] + curve[j, i])
    return value(x, u, t, data)

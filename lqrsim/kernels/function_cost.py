"""A cost that is a user's own function, called at its address. The numba subset; see `declarations.py`.

`data` has the addresses of the function and of its derivatives, then the parameters. Where no derivatives are given,
`cost_differences.py` has them.
"""

from math import nan

from lqrsim.kernels.declarations import W, invoke, invoke_writing, stack
from lqrsim.kernels.linear_algebra import clear


def value(x, u, t, data):
    """The cost; NaN where the function does not write one."""
    out = stack(1)
    out[0] = nan
    invoke(data[0], x, u, data, out)
    return out[0]


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian, made symmetric, and the gradient, and return the cost."""
    slope, curve = stack(W), stack(W, W)
    clear(curve, W, W)
    for i in range(W):
        slope[i] = 0.0
    invoke_writing(data[1], x, u, data, slope, curve)
    for i in range(W):
        gradient[i] += slope[i]
        for j in range(W):
            hessian[i, j] += 0.5 * (curve[i, j] + curve[j, i])
    return value(x, u, t, data)

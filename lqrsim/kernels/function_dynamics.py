"""Dynamics that are a user's own functions, called at their addresses. The kernels' subset.

`p` has the addresses of f and of its Jacobian, then the parameters. Where no Jacobian is given,
`finite_differences.py` has it.
"""

from math import nan

from lqrsim.kernels.declarations import M, N, call
from lqrsim.kernels.linear_algebra import clear


def rate(x, u, p, out):
    """Write f (N,); NaN where the function does not."""
    for i in range(N):
        out[i] = nan
    call(p[0], x, u, p, out)


def rate_jacobian(x, u, p, out, fx, fu):
    """Write f (N,), df/dx (N, N) and df/du (N, M)."""
    rate(x, u, p, out)
    clear(fx, N, N)
    clear(fu, N, M)
    call(p[1], x, u, p, fx, fu)

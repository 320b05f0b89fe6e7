"""Derivatives by central differences, for functions that come without. The kernels' subset.

The step is the cube root of the machine's precision: the error of the formula and that of rounding are both some 1e-10
of the function's size then.
"""

from lqrsim.kernels.declarations import M, N, rate, stack


def rate_jacobian(x, u, p, out, fx, fu):
    """Write f (N,), df/dx (N, N) and df/du (N, M)."""
    z, v, ahead, behind = stack(N), stack(M), stack(N), stack(N)
    for i in range(N):
        z[i] = x[i]
    for i in range(M):
        v[i] = u[i]
    rate(x, u, p, out)
    for j in range(N):
        h = 6e-6 * max(1.0, abs(x[j]))
        z[j] = x[j] + h
        rate(z, u, p, ahead)
        z[j] = x[j] - h
        rate(z, u, p, behind)
        z[j] = x[j]
        for i in range(N):
            fx[i, j] = (ahead[i] - behind[i]) / (2 * h)
    for j in range(M):
        h = 6e-6 * max(1.0, abs(u[j]))
        v[j] = u[j] + h
        rate(x, v, p, ahead)
        v[j] = u[j] - h
        rate(x, v, p, behind)
        v[j] = u[j]
        for i in range(N):
            fu[i, j] = (ahead[i] - behind[i]) / (2 * h)

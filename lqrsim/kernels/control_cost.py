"""`1/2 (u - about)' weight (u - about)`, of the control. The numba subset; see `declarations.py`.

`data` has about (M,), then weight (M, M), row by row.
"""

from lqrsim.kernels.declarations import M, N


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    for i in range(M):
        slope = 0.0
        for j in range(M):
            slope += data[M + M * i + j] * (u[j] - data[j])
        total += 0.5 * slope * (u[i] - data[i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, in which the states come first, and return the cost."""
    total = 0.0
    for i in range(M):
        slope = 0.0
        for j in range(M):
            weight = data[M + M * i + j]
            slope += weight * (u[j] - data[j])
            hessian[N + i, N + j] += weight
        gradient[N + i] += slope
        total += 0.5 * slope * (u[i] - data[i])
    return total

"""`1/2 (x - about)' weight (x - about)`, of the state. The numba subset; see `declarations.py`.

`data` has about (N,), then weight (N, N), row by row.
"""

from lqrsim.kernels.declarations import N


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    for i in range(N):
        slope = 0.0
        for j in range(N):
            slope += data[N + N * i + j] * (x[j] - data[j])
        total += 0.5 * slope * (x[i] - data[i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost."""
    total = 0.0
    for i in range(N):
        slope = 0.0
        for j in range(N):
            weight = data[N + N * i + j]
            slope += weight * (x[j] - data[j])
            hessian[i, j] += weight
        gradient[i] += slope
        total += 0.5 * slope * (x[i] - data[i])
    return total

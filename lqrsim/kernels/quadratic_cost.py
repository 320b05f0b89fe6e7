"""`1/2 (z - about)' weight (z - about)`, z the state or the control. Written in the kernels' subset.

`data` has `about` (size,), then `weight` (size, size), row by row.
"""

from lqrsim.kernels.declarations import M, N

CONTROL = False  # whether z is the control


def value(x, u, t, data):
    """The cost."""
    z, size = (u, M) if CONTROL else (x, N)
    total = 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            slope += data[size + size * i + j] * (z[j] - data[j])
        total += 0.5 * slope * (z[i] - data[i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    z, size, first = (u, M, N) if CONTROL else (x, N, 0)
    total = 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            weight = data[size + size * i + j]
            slope += weight * (z[j] - data[j])
            hessian[first + i, first + j] += weight
        gradient[first + i] += slope
        total += 0.5 * slope * (z[i] - data[i])
    return total

"""`1/2 (z - about_t)' weight_t (z - about_t)`, z the state or the control. Written in the kernels' subset.

`data` has the numbers of rows of `about` and of `weight`, then `about` (size,) for each row, then `weight` (size, size)
for each row. A single row, or the last one, holds from its step on.
"""

from lqrsim.kernels.declarations import M, N

CONTROL = False  # whether z is the control
ABOUTS, WEIGHTS, ROWS = 0, 1, 2


def value(x, u, t, data):
    """The cost."""
    z, size = (u, M) if CONTROL else (x, N)
    about, weight, total = about_at(t, size, data), weight_at(t, size, data), 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            slope += data[weight + size * i + j] * (z[j] - data[about + j])
        total += 0.5 * slope * (z[i] - data[about + i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    z, size, first = (u, M, N) if CONTROL else (x, N, 0)
    about, weight, total = about_at(t, size, data), weight_at(t, size, data), 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            entry = data[weight + size * i + j]
            slope += entry * (z[j] - data[about + j])
            hessian[first + i, first + j] += entry
        gradient[first + i] += slope
        total += 0.5 * slope * (z[i] - data[about + i])
    return total


def about_at(t, size, data):
    """The index at which the reference of a step begins."""
    return ROWS + size * min(t, int(data[ABOUTS]) - 1)


def weight_at(t, size, data):
    """The index at which the weight of a step begins."""
    return ROWS + size * int(data[ABOUTS]) + size * size * min(t, int(data[WEIGHTS]) - 1)

"""The sum of a loss of each row of a residual, which depends on the states.

`places` and `places_jacobian` are the residual here. `data` begins with its data.
"""

from lqrsim.kernels.declarations import N, loss, places, places_jacobian, stack
from lqrsim.kernels.linear_algebra import clear

ROWS = 1  # number of rows
MOVED = 1  # number of states, from the first on, that the residual depends on
FIRST_STEP = 0  # the first step at which it acts: 1 for what cannot change at a given start


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    if t >= FIRST_STEP:
        residual = stack(ROWS)
        places(x, data, residual)
        for row in range(ROWS):
            cost, _, _ = loss(residual[row], row, data)
            total += cost
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The residual's own curvature is left out."""
    total = 0.0
    if t >= FIRST_STEP:
        residual, moves = stack(ROWS), stack(ROWS, N)
        clear(moves, ROWS, N)
        places_jacobian(x, data, residual, moves)
        for row in range(ROWS):
            cost, slope, curvature = loss(residual[row], row, data)
            total += cost
            if slope != 0 or curvature != 0:
                for i in range(MOVED):
                    gradient[i] += slope * moves[row, i]
                    for j in range(MOVED):
                        hessian[i, j] += curvature * moves[row, i] * moves[row, j]
    return total

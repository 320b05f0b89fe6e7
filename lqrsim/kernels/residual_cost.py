"""`1/2 sum of weight * error^2` for errors from a model. Written in the kernels' subset.

`data` has the data of the errors, and from AT on a weight for each error. `places` and `places_jacobian` are the errors
here.
"""

from lqrsim.kernels.declarations import N, places, places_jacobian, stack
from lqrsim.kernels.linear_algebra import clear

AT = 0
ROWS = 1  # number of errors
MOVED = 1  # number of states, from the first on, that the errors depend on


def value(x, u, t, data):
    """The cost."""
    errors, total = stack(ROWS), 0.0
    places(x, data, errors)
    for row in range(ROWS):
        total += 0.5 * data[AT + row] * errors[row] * errors[row]
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The errors' own curvature is left out."""
    errors, moves, total = stack(ROWS), stack(ROWS, N), 0.0
    clear(moves, ROWS, N)
    places_jacobian(x, data, errors, moves)
    for row in range(ROWS):
        weight = data[AT + row]
        total += 0.5 * weight * errors[row] * errors[row]
        for i in range(MOVED):
            gradient[i] += weight * errors[row] * moves[row, i]
            for j in range(MOVED):
                hessian[i, j] += weight * moves[row, i] * moves[row, j]
    return total

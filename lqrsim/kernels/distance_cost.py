"""The cost of obstacles at distances from a model. Written in the kernels' subset.

The cost is `weight * sum of exp(-sharpness * distance)` for distances below a cutoff D, and 0 beyond it. The tangent at
D is subtracted, so that neither the cost nor its slope jumps there. `data` has the data of the distances, and from AT
on the numbers below. `places` and `places_jacobian` are the distances here.
"""

from lqrsim.kernels.declarations import N, places, places_jacobian, stack
from lqrsim.kernels.exponential import exponential
from lqrsim.kernels.linear_algebra import clear

AT = 0
SHARPNESS, WEIGHT, FARTHEST = 0, 1, 2  # from there on; the last is D
ROWS = 1  # number of distances
MOVED = 1  # number of states, from the first on, that the distances depend on


def value(x, u, t, data):
    """The cost; zero at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        distances = stack(ROWS)
        sharpness, least = data[AT + SHARPNESS], exponential(-data[AT + SHARPNESS] * data[AT + FARTHEST])
        places(x, data, distances)
        for row in range(ROWS):
            beyond = data[AT + FARTHEST] - distances[row]
            total += exponential(-sharpness * distances[row]) - least * (1 + sharpness * beyond)
    return data[AT + WEIGHT] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The distances' own curvature is left out."""
    total = 0.0
    if t > 0:
        distances, moves = stack(ROWS), stack(ROWS, N)
        sharpness, weight = data[AT + SHARPNESS], data[AT + WEIGHT]
        least = exponential(-sharpness * data[AT + FARTHEST])
        clear(moves, ROWS, N)
        places_jacobian(x, data, distances, moves)
        for row in range(ROWS):
            beyond, cost = data[AT + FARTHEST] - distances[row], exponential(-sharpness * distances[row])
            total += cost - least * (1 + sharpness * beyond)
            if beyond > 0:
                force, stiffness = weight * sharpness * (cost - least), weight * sharpness * sharpness * cost
                for i in range(MOVED):
                    gradient[i] -= force * moves[row, i]
                    for j in range(MOVED):
                        hessian[i, j] += stiffness * moves[row, i] * moves[row, j]
    return data[AT + WEIGHT] * total

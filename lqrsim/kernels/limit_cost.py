"""`1/2 sum of weight * depth^2`, where depth is how far a state is past its bound. Written in the kernels' subset.

`data` has the number of bounds, and for each bound: the index of the state, 1 for a lower bound or -1 for an upper one,
the bound, and the weight.
"""


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    for row in range(int(data[0])):
        depth = data[4 * row + 2] * (data[4 * row + 3] - x[int(data[4 * row + 1])])
        if depth > 0:
            total += 0.5 * data[4 * row + 4] * depth * depth
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    total = 0.0
    for row in range(int(data[0])):
        state, sign, weight = int(data[4 * row + 1]), data[4 * row + 2], data[4 * row + 4]
        depth = sign * (data[4 * row + 3] - x[state])
        if depth > 0:
            hessian[state, state] += weight
            gradient[state] -= sign * weight * depth
            total += 0.5 * weight * depth * depth
    return total

"""Distances from a model, minus margins. Written in the kernels' subset.

`data` has the data of the distances, and from AT on the numbers below, and the margins, step by step; the last ones
hold from their step on.
"""

from lqrsim.kernels.declarations import N

AT = 0
# From there on: numbers of steps with margins, and of margins at a step; then the number of each row's obstacle.
STEPS, EACH, OBSTACLES = 0, 1, 2
ROWS = 1  # number of distances


def value(at, u, t, row, data):
    """The row's distance minus its margin, given all distances."""
    steps, each, obstacle = int(data[AT + STEPS]), int(data[AT + EACH]), int(data[AT + OBSTACLES + row])
    return at[row] - data[AT + OBSTACLES + ROWS + min(t, steps - 1) * each + obstacle % each]


def slope(at, moves, t, row, data, gradient):
    """Add its gradient, given all distances and their derivatives in the states."""
    for i in range(N):
        gradient[i] += moves[row, i]

"""Distances from a model, minus margins. Written in the kernels' subset.

`data` begins with the data of the distances. From AT on it has the number of steps with margins (the last margins hold
for all later steps), the number of margins per step, the number of each row's obstacle, and the margins, step by step.
"""

from lqrsim.kernels.declarations import N

AT = 0
ROWS = 1  # number of distances


def value(at, u, t, row, data):
    """The row's distance minus its margin, given all distances."""
    steps, each = int(data[AT]), int(data[AT + 1])
    return at[row] - data[AT + 2 + ROWS + min(t, steps - 1) * each + int(data[AT + 2 + row]) % each]


def slope(at, moves, t, row, data, gradient):
    """Add its gradient, given all distances and their derivatives in the states."""
    for i in range(N):
        gradient[i] += moves[row, i]

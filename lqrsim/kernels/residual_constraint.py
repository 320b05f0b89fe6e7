"""Rows of a residual, minus numbers for each step.

`data` has the data of the residual, and from AT on the numbers below, and the table of what is subtracted, step by
step; the last ones hold from their step on.
"""

from lqrsim.kernels.declarations import N

AT = 0
# From there on: numbers of steps in the table, and of columns; then the column of each row.
STEPS, EACH, COLUMNS = 0, 1, 2
ROWS = 1  # number of rows


def value(at, u, t, row, data):
    """The row minus its number, given the whole residual."""
    steps, each, column = int(data[AT + STEPS]), int(data[AT + EACH]), int(data[AT + COLUMNS + row])
    return at[row] - data[AT + COLUMNS + ROWS + min(t, steps - 1) * each + column]


def slope(at, moves, t, row, data, gradient):
    """Add its gradient, given the whole residual and its derivatives in the states."""
    for i in range(N):
        gradient[i] += moves[row, i]

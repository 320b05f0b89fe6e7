"""Constraint values: the distance of a state to a bound, positive on the feasible side. Written in the kernels' subset.

For each row, `data` has the index of the state, 1 for a lower or -1 for an upper bound, the bound, and the last step at
which it holds.
"""

from math import inf


def value(x, u, t, row, data):
    """The distance; infinite after the last step."""
    if t > data[4 * row + 3]:
        return inf
    return data[4 * row + 1] * (x[int(data[4 * row])] - data[4 * row + 2])


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    gradient[int(data[4 * row])] += data[4 * row + 1]

"""Constraint values: the distance of a state to a bound, positive on the feasible side. Written in the kernels' subset.

`data` has the number of knots K with a bound of their own, and then for each row the index of the state, 1 for a lower
or -1 for an upper bound, the last step at which it holds, and K bounds, infinite at knots without one. The last bound
holds from its knot on.
"""

from math import inf

INDEX, SIGN, LAST, BOUNDS = 0, 1, 2, 3


def value(x, u, t, row, data):
    """The distance; infinite after the last step, and where there is no bound."""
    first = row_at(row, data)
    if t > data[first + LAST]:
        return inf
    return data[first + SIGN] * (x[int(data[first + INDEX])] - data[first + BOUNDS + min(t, int(data[0]) - 1)])


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    first = row_at(row, data)
    gradient[int(data[first + INDEX])] += data[first + SIGN]


def row_at(row, data):
    """The index at which the numbers of a row begin."""
    return 1 + row * (BOUNDS + int(data[0]))

"""How far a state is from a number, to the side where it may be. The kernels' subset.

`data` has of each row which state it is, 1 where the number is its least and -1 where it is its most, the number, and
the last step at which that holds.
"""

from math import inf


def value(x, u, t, row, data):
    """How far it is; infinite after the last step."""
    if t > data[4 * row + 3]:
        return inf
    return data[4 * row + 1] * (x[int(data[4 * row])] - data[4 * row + 2])


def slope(x, u, t, row, data, gradient):
    """Add its gradient."""
    gradient[int(data[4 * row])] += data[4 * row + 1]

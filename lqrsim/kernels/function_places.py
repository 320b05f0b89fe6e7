"""Places of balls that are a user's own function, called at its address. The kernels' subset.

`data` has the addresses of the function and of its Jacobian, then the parameters. Where no Jacobian is given,
`place_differences.py` has it.
"""

from math import nan

from lqrsim.kernels.declarations import N, call, stack
from lqrsim.kernels.linear_algebra import clear

BALLS = 1  # how many there are
SIZE = 3  # coordinates that the function returns of each ball: without the third they are in a plane
GIVEN = 3  # coordinates that it returns of all balls


def places(x, data, out):
    """Write the coordinates, ball by ball; NaN where the function does not."""
    given = stack(GIVEN)
    for i in range(GIVEN):
        given[i] = nan
    call(data[0], x, x, data, given)
    for k in range(BALLS):
        out[3 * k + 2] = 0.0
        for i in range(SIZE):
            out[3 * k + i] = given[SIZE * k + i]


def places_jacobian(x, data, out, slopes):
    """Write the coordinates, and their derivatives in the states, which are zeros when they come."""
    given = stack(GIVEN, N)
    clear(given, GIVEN, N)
    places(x, data, out)
    call(data[1], x, x, data, given)
    for k in range(BALLS):
        for i in range(SIZE):
            for j in range(N):
                slopes[3 * k + i, j] = given[SIZE * k + i, j]

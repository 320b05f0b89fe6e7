"""Noise that is a user's own function, called at its address. The kernels' subset; see `noise.py`.

`data` has the address of the function, the parameters, then the strength.
"""

from math import nan

from lqrsim.kernels.declarations import N, call, stack

SIZE = 1  # columns of M
STRENGTH = 1  # where the strength is


def noise_values(x, u, data, out):
    """Write M (N, SIZE); NaN where the function does not."""
    given = stack(N, SIZE)
    for i in range(N):
        for k in range(SIZE):
            given[i, k] = nan
    call(data[0], x, u, data, given)
    for i in range(N):
        for k in range(SIZE):
            out[i, k] = data[STRENGTH] * given[i, k]

"""Noise that is a user's own function, called at its address. The numba subset; see `noise.py`.

`data` has the address of the function, the strength, then the parameters.
"""

from math import nan

from lqrsim.kernels.declarations import N, invoke, stack

SIZE = 1  # columns of M


def noise_values(x, u, data, out):
    """Write M (N, SIZE); NaN where the function does not."""
    given = stack(N, SIZE)
    for i in range(N):
        for k in range(SIZE):
            given[i, k] = nan
    invoke(data[0], x, u, data, given)
    for i in range(N):
        for k in range(SIZE):
            out[i, k] = data[1] * given[i, k]

"""Derivatives of noise by central differences, where there are none.

The kernels' subset; see `finite_differences.py`.
"""

from lqrsim.kernels.declarations import M, N, noise_values, stack

SIZE = 1  # columns of M
ACTIVE = (0,)  # entries of (x, u) that it depends on
ACTIVE_COUNT = 1  # how many these are


def noise_slopes(x, u, data, out, slopes):
    """Write M (N, SIZE), and its derivatives, column by column, in the active entries."""
    z, v, above, below = stack(N), stack(M), stack(N, SIZE), stack(N, SIZE)
    for i in range(N):
        z[i] = x[i]
    for i in range(M):
        v[i] = u[i]
    noise_values(x, u, data, out)
    for a in range(ACTIVE_COUNT):
        j = ACTIVE[a]
        at = x[j] if j < N else u[j - N]
        h = 6e-6 * max(1.0, abs(at))
        if j < N:
            z[j] = at + h
        else:
            v[j - N] = at + h
        noise_values(z, v, data, above)
        if j < N:
            z[j] = at - h
        else:
            v[j - N] = at - h
        noise_values(z, v, data, below)
        if j < N:
            z[j] = at
        else:
            v[j - N] = at
        for k in range(SIZE):
            for i in range(N):
                slopes[k, i, a] = (above[i, k] - below[i, k]) / (2 * h)

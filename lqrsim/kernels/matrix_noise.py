"""Noise whose matrix is always the same. The kernels' subset; see `noise.py`.

`data` has the matrix, row by row, then the strength.
"""

COUNT = 1  # rows
SIZE = 1  # columns


def noise_values(x, u, data, out):
    """Write the matrix."""
    for i in range(COUNT):
        for k in range(SIZE):
            out[i, k] = data[COUNT * SIZE] * data[SIZE * i + k]


def noise_slopes(x, u, data, out, slopes):
    """The same: it has no slopes."""
    noise_values(x, u, data, out)

"""The matrices of noise at many states and controls. The numba subset; see `declarations.py`."""

from lqrsim.kernels.declarations import noise_values


def matrices_of(count, states, controls, data, out):
    """Write those rows of M (count, ...) that `noise.py` takes, at states (count, N) and controls (count, M)."""
    for i in range(count):
        noise_values(states[i], controls[i], data, out[i])

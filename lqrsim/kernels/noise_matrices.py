"""The matrices of noise at many states and controls. The kernels' subset."""

from lqrsim.kernels.declarations import noise_values, outline


def matrices_of(count, states, controls, data, out):
    """Write those rows of M (count, ...) that `noise.py` takes, at states (count, N) and controls (count, M)."""
    for i in range(count):
        matrix_of_one(states[i], controls[i], data, out[i])


@outline
def matrix_of_one(x, u, data, out):
    """That at one state and control."""
    noise_values(x, u, data, out)

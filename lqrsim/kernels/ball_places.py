"""Where the balls of a robot are, at many states. The numba subset; see `declarations.py`."""

from lqrsim.kernels.declarations import places


def places_of(count, states, data, out):
    """Write the coordinates (count, ...), ball by ball, at states (count, N)."""
    for i in range(count):
        places(states[i], data, out[i])

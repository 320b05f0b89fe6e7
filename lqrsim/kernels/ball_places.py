"""Where the balls of a robot are, at many states. The numba subset; see `declarations.py`."""

from lqrsim.kernels.declarations import places, places_jacobian


def places_of(count, states, data, out):
    """Write the coordinates (count, ...), ball by ball, at states (count, N)."""
    for i in range(count):
        places(states[i], data, out[i])


def slopes_of(count, states, data, out, slopes):
    """The same, and the derivatives in the states (count, ..., N), which are zeros when they come."""
    for i in range(count):
        places_jacobian(states[i], data, out[i], slopes[i])

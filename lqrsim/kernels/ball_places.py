"""Where the balls of a robot are, at many states. The kernels' subset."""

from lqrsim.kernels.declarations import outline, places, places_jacobian


def places_of(count, states, data, out):
    """Write the coordinates (count, ...), ball by ball, at states (count, N)."""
    for i in range(count):
        places_of_one(states[i], data, out[i])


def slopes_of(count, states, data, out, slopes):
    """The same, and the derivatives in the states (count, ..., N), which are zeros when they come."""
    for i in range(count):
        slopes_of_one(states[i], data, out[i], slopes[i])


@outline
def places_of_one(x, data, out):
    """Those at one state."""
    places(x, data, out)


@outline
def slopes_of_one(x, data, out, slopes):
    """Those at one state."""
    places_jacobian(x, data, out, slopes)

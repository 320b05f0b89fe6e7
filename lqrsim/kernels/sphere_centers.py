"""The centres of a robot's balls at many states."""

from lqrsim.kernels.declarations import outline, places, places_jacobian


def centres_of(count, states, data, out):
    """Write the centres (count, 3 balls) at states (count, N)."""
    for i in range(count):
        centres_at(states[i], data, out[i])


def jacobians_of(count, states, data, out, slopes):
    """Write the centres, and their Jacobians (count, 3 balls, N), which the caller has set to zero."""
    for i in range(count):
        jacobian_at(states[i], data, out[i], slopes[i])


@outline
def centres_at(x, data, out):
    """Write the centres at one state."""
    places(x, data, out)


@outline
def jacobian_at(x, data, out, slopes):
    """Write the centres and their Jacobian at one state."""
    places_jacobian(x, data, out, slopes)

"""Derivatives of places by central differences, where there are none.

The kernels' subset; see `finite_differences.py`.
"""

from lqrsim.kernels.declarations import N, places, stack

PLACES = 3  # coordinates of all balls
AXES = (0,)  # the states that they depend on


def places_jacobian(x, data, out, slopes):
    """Write the coordinates, and their derivatives in the states, which are zeros when they come."""
    z, ahead, behind = stack(N), stack(PLACES), stack(PLACES)
    for i in range(N):
        z[i] = x[i]
    places(x, data, out)
    for a in range(len(AXES)):
        j = AXES[a]
        h = 6e-6 * max(1.0, abs(x[j]))
        z[j] = x[j] + h
        places(z, data, ahead)
        z[j] = x[j] - h
        places(z, data, behind)
        z[j] = x[j]
        for i in range(PLACES):
            slopes[i, j] = (ahead[i] - behind[i]) / (2 * h)

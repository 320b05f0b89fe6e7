"""A constraint whose rows share numbers, such as the places of balls: they are worked out once a step.

The constraint's own functions get these and their derivatives in place of the state and the control. The kernels'
subset.
"""

from lqrsim.kernels.augmented_lagrangian import augment as augment_places
from lqrsim.kernels.augmented_lagrangian import augmentation as augmentation_places
from lqrsim.kernels.augmented_lagrangian import constraint_values as values_of_places
from lqrsim.kernels.declarations import N, places, places_jacobian, stack
from lqrsim.kernels.declarations import constraint_slope as slope_of_places
from lqrsim.kernels.linear_algebra import clear

PLACES = 3  # how many numbers they share


def augment(x, u, t, data, multipliers, hessian, gradient):
    """Add the quadratic model at (x, u) to hessian (W, W) and gradient (W,), and return the value."""
    total = 0.0
    if multipliers[0] > 0 and t >= multipliers[2]:
        at, moves = stack(PLACES), stack(PLACES, N)
        clear(moves, PLACES, N)
        places_jacobian(x, data, at, moves)
        total = augment_places(at, moves, t, data, multipliers, hessian, gradient)
    return total


def augmentation(x, u, t, data, multipliers):
    """The value alone."""
    total = 0.0
    if multipliers[0] > 0 and t >= multipliers[2]:
        at = stack(PLACES)
        places(x, data, at)
        total = augmentation_places(at, u, t, data, multipliers)
    return total


def constraint_values(x, u, t, acts, data, multipliers, values):
    """Write the constraint's numbers at a step."""
    at = stack(PLACES)
    places(x, data, at)
    values_of_places(at, u, t, acts, data, multipliers, values)


def add_slope(x, u, t, row, data, gradient):
    """Add the gradient (W,) of one of them."""
    at, moves = stack(PLACES), stack(PLACES, N)
    clear(moves, PLACES, N)
    places_jacobian(x, data, at, moves)
    slope_of_places(at, moves, t, row, data, gradient)

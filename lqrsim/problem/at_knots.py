"""A constraint at some knots, with numbers of its own at each: the term and its kernel."""

from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels.declarations import constraint_slope, constraint_value, stack
from lqrsim.problem.constraints import ConstraintTerm


def at_knots(term: ConstraintTerm, knots: NDArray[np.intp], numbers: Array) -> ConstraintTerm:
    """An inequality without functions at knots (K,) alone, with its data (K, P) at each."""
    kernel = source_of(__name__, COUNT=numbers.shape[1])
    filled = {"constraint_value": (term.code, "value"), "constraint_slope": (term.code, "slope")}
    data = np.concatenate([[len(knots)], knots, numbers.ravel()])
    return replace(term, source=kernel.filled(**filled), data=data)


# The kernel. `data` has the number of knots, the knots, and for each its COUNT numbers.
COUNT = 0


def value(x, u, t, row, data):
    """The constraint; infinite at other knots."""
    numbers = stack(COUNT + 1)
    return constraint_value(x, u, t, row, numbers) if read_numbers(t, data, numbers) else inf


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    numbers = stack(COUNT + 1)
    if read_numbers(t, data, numbers):
        constraint_slope(x, u, t, row, numbers, gradient)


def read_numbers(t, data, numbers):
    """Write the numbers of a knot; return whether it has some."""
    knots = int(data[0])
    for k in range(knots):
        if int(data[1 + k]) == t:
            for i in range(COUNT):
                numbers[i] = data[1 + knots + k * COUNT + i]
            return True
    return False

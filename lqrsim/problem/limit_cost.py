"""A soft limit of states: class and kernel."""

from collections.abc import Mapping
from typing import Self

import numpy as np

from lqrsim.annotations import NonNegative, checked
from lqrsim.codegen.sources import source_of
from lqrsim.errors import check_name, check_number
from lqrsim.problem.costs import Cost, CostTerm
from lqrsim.problem.dynamics import Dynamics


class LimitCost(Cost):
    """`1/2 weight depth^2` for each state that is past a bound by some depth: a soft limit.

    Args:
      low, high: name of a state -> its bound.
      weight: weight of the square of each depth.
    """

    @checked
    def __init__(
        self, low: Mapping[str, float] | None = None, high: Mapping[str, float] | None = None, *, weight: NonNegative
    ) -> None:
        self.weight = weight
        self.bounds = [
            (name, sign, check_number(f"LimitCost: bound of {name}", bound))
            for sign, bounds in ((1.0, low), (-1.0, high))
            for name, bound in (bounds or {}).items()
        ]

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self

    def bind(self, dynamics: Dynamics) -> CostTerm:
        names = dynamics.state_coordinates.names
        rows = [
            [names.index(check_name("LimitCost: state", name, names)), sign, bound, self.weight]
            for name, sign, bound in self.bounds
        ]
        numbers = np.array([len(rows), *np.ravel(rows)], dtype=np.float64)
        return CostTerm(source_of(__name__), numbers, exact_hessian=False)


# The kernel. `data` has the number of bounds, and for each bound: the index of the state, 1 for a lower bound or -1 for
# an upper one, the bound, and the weight.


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    for row in range(int(data[0])):
        depth = data[4 * row + 2] * (data[4 * row + 3] - x[int(data[4 * row + 1])])
        if depth > 0:
            total += 0.5 * data[4 * row + 4] * depth * depth
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    total = 0.0
    for row in range(int(data[0])):
        state, sign, weight = int(data[4 * row + 1]), data[4 * row + 2], data[4 * row + 4]
        depth = sign * (data[4 * row + 3] - x[state])
        if depth > 0:
            hessian[state, state] += weight
            gradient[state] -= sign * weight * depth
            total += 0.5 * weight * depth * depth
    return total

"""A constraint at times within control periods, besides the knots: class and kernel.

`smooth` states it for a problem with `between_knots=True`. The state there is the dynamics' from the state and the
control of the period, so that such a row is one of both, as any other.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import Self

import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels.declarations import (
    M,
    N,
    W,
    constraint_slope,
    constraint_value,
    places,
    places_jacobian,
    stack,
    zeros,
)
from lqrsim.kernels.runge_kutta import advance, step_jacobian
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics

TIMES = 8  # at equal distances, the last at the end of the period: between them is a 64th of what is between knots


class WithinPeriods(Constraint):
    """An inequality at `TIMES` times within some control periods; for dynamics that are a formula.

    A constraint with other numbers at each knot holds within a period as far as it holds at both ends.

    Attributes:
      acts: (K, rows) 1 for the periods in which a row acts, else 0.
      spares: (rows,) by how much more than 0 the rows are to be there.
    """

    def __init__(self, constraint: Constraint, acts: Array, spares: Array) -> None:
        self.constraint, self.acts, self.spares = constraint, acts, spares

    @property
    def by_knot(self) -> bool:
        return True

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        return type(self)(self.constraint, select(self.acts), self.spares)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return type(self)(self.constraint.with_added_state(dynamics), self.acts, self.spares)

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.arange(len(self.acts) + 1.0), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        term = self.constraint._bind_at(dynamics, times, goals)
        numbers = [times[1] - times[0], *self.acts.shape, *dynamics.data, *self.spares, *self.acts.ravel()]
        kernel = source_of(
            __name__, AT=len(term.functions) + len(term.data), PARAMETERS=len(dynamics.data), SHARED=term.shared,
            BOTH=int(self.constraint.by_knot and not term.uses_control),
        )  # fmt: skip
        filled = {"constraint_value": (term.code, "value"), "constraint_slope": (term.code, "slope")}
        filled |= {name: (dynamics.step_source, name) for name in ("advance", "step_jacobian")}
        if term.shared:
            filled |= {name: (term.code, name) for name in ("places", "places_jacobian")}
        return replace(
            term, source=kernel.filled(**filled), data=np.concatenate([term.data, numbers]), rows=TIMES * term.rows,
            describe=lambda row: f"{term.describe(row % term.rows)}, between the knots", names=TIMES * term.names,
            ranges=None if term.ranges is None else np.tile(term.ranges, TIMES),
            uses_control=True, shared=0, convex=False, linear=False,
        )  # fmt: skip


# The kernel. From AT on, `data` has the numbers below, the parameters of the dynamics, the spares, and which rows act
# in each period. There is a row for each of the constraint's at the first time, and so on.
AT = 0
# From there on: the length of a period, the number of periods, and of the constraint's rows.
LENGTH, PERIODS, ROWS, OTHERS = 0, 1, 2, 3
PARAMETERS = 0  # their number
SHARED = 0  # number of values that the constraint's rows share
BOTH = 0  # whether the constraint has other numbers at the end of the period


def value(x, u, t, row, data):
    """The constraint within the period, minus what is spared; infinite where it does not act."""
    rows = int(data[AT + ROWS])
    own = row % rows
    if not acting(t, own, data):
        return inf
    z, p = stack(N), stack(PARAMETERS + 1)
    read_parameters(data, p)
    advance(x, u, p, (row // rows + 1) * data[AT + LENGTH] / TIMES, z)
    return value_at_state(z, u, holding(z, u, t, own, data), own, data) - data[AT + OTHERS + PARAMETERS + own]


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    rows = int(data[AT + ROWS])
    own = row % rows
    if acting(t, own, data):
        z, p, jacobian, there = stack(N), stack(PARAMETERS + 1), zeros(N, W), zeros(W)
        read_parameters(data, p)
        step_jacobian(x, u, p, (row // rows + 1) * data[AT + LENGTH] / TIMES, z, jacobian)
        slope_at_state(z, u, holding(z, u, t, own, data), own, data, there)
        for i in range(N):
            for j in range(W):
                gradient[j] += there[i] * jacobian[i, j]
        for i in range(M):
            gradient[N + i] += there[N + i]


def acting(t, own, data):
    """Whether a row of the constraint acts in a period; none does after the last."""
    rows = int(data[AT + ROWS])
    first = AT + OTHERS + PARAMETERS + rows
    return t < int(data[AT + PERIODS]) and data[first + t * rows + own] > 0


def holding(z, u, t, row, data):
    """The end of a period at which a constraint asks for less."""
    if not BOTH:
        return t
    return t + 1 if value_at_state(z, u, t + 1, row, data) > value_at_state(z, u, t, row, data) else t


def value_at_state(z, u, t, row, data):
    """The constraint at a state."""
    if not SHARED:
        return constraint_value(z, u, t, row, data)
    shared = stack(SHARED)
    places(z, data, shared)
    return constraint_value(shared, u, t, row, data)


def slope_at_state(z, u, t, row, data, gradient):
    """Add its gradient (W,) at a state."""
    if SHARED:
        shared, moves = stack(SHARED), zeros(SHARED, N)
        places_jacobian(z, data, shared, moves)
        constraint_slope(shared, moves, t, row, data, gradient)
    else:
        constraint_slope(z, u, t, row, data, gradient)


def read_parameters(data, p):
    """Write the parameters of the dynamics."""
    for i in range(PARAMETERS):
        p[i] = data[AT + OTHERS + i]

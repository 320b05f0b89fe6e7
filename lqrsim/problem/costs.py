"""Costs; `+` composes them. Their structure is source text, their numbers are data.

To add a kind of cost, subclass `Cost` in a file of its own, with its kernel, and write `bind`; or state it as a formula
with `SymbolicCost`.
"""

import abc
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Self, TypeVar

import numpy as np

from lqrsim.annotations import Index, checked
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import Term
from lqrsim.errors import Array, InputError, brief, check_count, check_kind
from lqrsim.kernels.declarations import N, loss, places, places_jacobian, stack
from lqrsim.kernels.linear_algebra import clear
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.solution_parts import Horizon, left_after

if TYPE_CHECKING:
    from lqrsim.problem.obstacles import KeepsClear
    from lqrsim.problem.quadratic_cost import ControlCost, QuadraticCost


@dataclass(frozen=True, eq=False)
class Residual(Term):
    """Numbers that depend on the states, for one system, such as distances or errors.

    `CostTerm.of_residual` adds a loss of each, and `ConstraintTerm.of_residual` says which values are feasible.

    The source defines `residual(x, data, out)`, which writes one number per row, and `residual_jacobian(x, data, out,
    slopes)`, which writes them, and their nonzero derivatives in the states (rows, N) to an array of zeros.

    Attributes:
      parts: the name of each row.
      leading_states: number of states, from the first one on, that the numbers depend on.
    """

    parts: tuple[str, ...]
    leading_states: int

    @property
    def rows(self) -> int:
        return len(self.parts)

    def filling(self, kernel: Source) -> Source:
        """A kernel of costs or constraints whose open function `places` is filled with the residual."""
        return kernel.filled(places=(self.code, "residual"), places_jacobian=(self.code, "residual_jacobian"))


@checked
@dataclass(frozen=True, eq=False)
class CostTerm(Term):
    """A cost term, for one system.

    The source defines `value(x, u, t, data)` and `derivatives(x, u, t, data, hessian, gradient)`, both returning the
    cost; the latter *adds* the Hessian (n+m, n+m) and gradient (n+m,) at the point, states before controls.

    Attributes:
      nonconvex_in: indices of the entries of (x, u) in which the Hessian may be indefinite: None for a convex term. The
        sum of all such terms is projected to the nearest positive-semidefinite matrix.
      uses_control: whether the term depends on u (only stage costs may).
      factor: index in `data` of a number that the whole term is proportional to, if the number may be reduced in the
        first iterations; see `InitialPrior`. Else None.
      exact_hessian: whether the Hessian is complete. If a part is left out on purpose, `check_derivatives` does not
        compare the Hessian with differences.
    """

    nonconvex_in: tuple[Index, ...] | None = None
    uses_control: bool = False
    factor: int | None = None
    exact_hessian: bool = True

    @property
    def _defines(self) -> Mapping[str, int]:
        return {"value": 4, "derivatives": 6}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.factor is not None:
            check_count("CostTerm: factor", self.factor, at_least=0, at_most=len(self.data) - 1)

    @classmethod
    def of_residual(
        cls, residual: Residual, loss: Source, numbers: Array, *, first: int = 0, factor: int | None = None,
        nonconvex_in: tuple[int, ...] | None = None,
    ) -> Self:  # fmt: skip
        """The sum of a loss of each row of a residual, whose second derivatives are left out.

        Args:
          loss: defines `loss(r, row, data)`, which returns the loss of a row and its first two derivatives in r.
          numbers: what the loss reads; in its `data` they begin at `residual.numbers`. `factor` is an index in them.
          first: the first step at which it acts.
        """
        sizes = {"ROWS": max(1, residual.rows), "LEADING_STATES": residual.leading_states, "FIRST_STEP": first}
        return cls(
            residual.filling(source_of(__name__, **sizes).filled(loss=loss)), np.concatenate([residual.data, numbers]),
            nonconvex_in=nonconvex_in or None, factor=None if factor is None else len(residual.data) + factor,
            functions=residual.functions, exact_hessian=False,
        )  # fmt: skip


_BoundTerm = TypeVar("_BoundTerm", bound=Term)


class ProblemPart(abc.ABC, Generic[_BoundTerm]):
    """A cost or a constraint, which can be bound to any system that it fits.

    All that others ask of one is a method here, in `Cost` or in `Constraint`, with the answer of most; a kind with
    another answer overrides it.
    """

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics) -> _BoundTerm:
        """Bind the term to a system."""

    @property
    def by_knot(self) -> bool:
        """Whether it has other numbers at each knot; initial and final costs may not."""
        return False

    @property
    def moving(self) -> bool:
        """Whether it changes with time."""
        return self.by_knot

    @property
    def kept_clear(self) -> "KeepsClear | None":
        """The obstacles that it keeps the robot clear of, with the robot's shape; None for others."""
        return None

    def off_place(self, dynamics: Dynamics, states: Array) -> dict[str, Array]:
        """How far parts, such as a gripper's site, are off their places, at states (K, n): name -> (K,) in m or rad."""
        return {}

    def with_added_state(self, dynamics: Dynamics) -> Self:
        """The same for a system with one more state, the last, of which it is independent: for a free duration, and for
        each control with a `control_rate`. `dynamics` are those without that state.
        """
        got = f"a {type(self).__name__} beside one of them, which cannot have one more state"
        raise InputError(f"duration and control_rate: got {got}, want none")

    @checked
    def ahead(self, steps: Index, *, horizon: Horizon = "shrinking") -> Self:
        """The same for a plan that begins `steps` steps later: unchanged, unless it has numbers for each knot.

        The rest of a plan, with a "shrinking" horizon, is without the first rows; a plan of the same length, with a
        "moving" one, repeats the last row.
        """
        if not self.by_knot:
            return self
        filled = horizon == "moving"
        return self._at_other_knots(lambda rows: left_after(min(steps, len(rows) - 1), rows, filled=filled))

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        """The same with each array of rows for knots as `select` leaves it; for what has such rows."""
        raise InputError(f"{type(self).__name__}: got rows for knots, but no method ahead, want both")

    def _stated(self) -> Mapping[str, object]:
        """The arguments that it was made from, by name."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __repr__(self) -> str:
        parts = [
            f"{name}={self._brief(name, value)}"
            for name, value in self._stated().items()
            if not (value is None or value is False or (isinstance(value, Mapping) and not value))
        ]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _brief(self, name: str, value: object) -> str:
        """An argument as it is printed."""
        return brief(value)

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> _BoundTerm:
        """Bind the term to a system, for a problem.

        Args:
          times: (T+1,) in s, of the knots. goals: the final values that constraints require of states, by index.
        """
        return self.bind(dynamics)


class Cost(ProblemPart[CostTerm]):
    """One term of a cost."""

    _want = "a cost such as QuadraticCost(...) or a sum of costs"
    _must_be_clear = True  # whether a new problem refuses a start at which it is zero, if that is inside an obstacle

    @property
    def name(self) -> str:
        return type(self).__name__

    @property
    def state_reference(self) -> "QuadraticCost | None":
        """What it is near the states that it draws to, as a problem's start and goal; None if it draws to none."""
        return None

    @property
    def control_reference(self) -> "ControlCost | None":
        """What it is near the controls that it draws to, as solvers start from; None for a cost that draws to none."""
        return None

    @property
    def contact_curvature(self) -> float:
        """Its second derivative in the distance to an obstacle at contact, in 1/m^2, which weighs paths; or 0."""
        return 0.0

    def times(self, factor: float) -> "Cost":
        """The cost times a number. Costs with a reference or obstacles have it: the search changes their weights."""
        raise InputError(f"{self.name}: got no method times, want it to return the cost times a number")

    def moved_to(self, state: Array, dynamics: Dynamics) -> "Cost":
        """The cost about another state (n,). Costs with a state reference have it: a viewer moves goals."""
        raise InputError(f"{self.name}: got no method moved_to, want it to return the cost about a state")

    def _in(self, dynamics: Dynamics) -> "Cost":
        """This cost with numbers by name in the order of a system. Raises InputError if it does not fit the system."""
        return self

    def __add__(self, other: "Cost") -> "CostSum":
        return CostSum((*terms_of(self), *terms_of(other)))

    def __radd__(self, other: object) -> "Cost":
        """`sum(costs)` begins with 0."""
        return self if type(other) is int and other == 0 else NotImplemented


class CostSum(Cost):
    """The result of `+`: the terms, in order."""

    def __init__(self, terms: tuple[Cost, ...]) -> None:
        self.terms = terms

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms))

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> "CostSum":
        return CostSum(tuple(term.ahead(steps, horizon=horizon) for term in self.terms))

    def with_added_state(self, dynamics: Dynamics) -> "CostSum":
        return CostSum(tuple(term.with_added_state(dynamics) for term in self.terms))

    def bind(self, dynamics: Dynamics) -> CostTerm:
        raise InputError("cost: got a sum of costs, want a single term: bind the `terms` one by one")


def terms_of(cost: Cost, field: str = "cost") -> tuple[Cost, ...]:
    """The terms of a sum; a single cost is its own."""
    if isinstance(cost, CostSum):
        return cost.terms
    check_kind(field, cost, Cost, Cost._want)
    return (cost,)


def in_system(cost: Cost, dynamics: Dynamics, field: str = "cost") -> Cost:
    """The cost with numbers by name in the order of a system; the same object if it has no numbers by name."""
    terms = terms_of(cost, field)
    ordered = tuple(term._in(dynamics) for term in terms)
    for term in ordered:
        if field in ("initial", "final_cost") and term.by_knot:
            raise InputError(f"{field}: got a {term.name} with a row for each knot, want one row, such as rows[-1]")
    return cost if all(map(operator.is_, terms, ordered)) else CostSum(ordered)


def weighing_obstacles(cost: Cost, times: float) -> CostSum:
    """The cost with the weights of its obstacles multiplied."""
    return CostSum(tuple(term if term.kept_clear is None else term.times(times) for term in terms_of(cost)))


# The kernels of residuals. `places` and `places_jacobian` are the residual, with whose data `data` begins. Of a
# constraint it has, from AT on, the numbers below, and the table of what is subtracted from the rows, step by step; the
# last ones hold from their step on.
ROWS = 1  # number of rows
LEADING_STATES = 1  # number of states, from the first on, that the residual depends on
FIRST_STEP = 0  # the first step at which a cost acts: 1 for what cannot change at a given start
AT = 0
# From there on: numbers of steps in the table, and of columns; then the column of each row.
STEPS, EACH, COLUMNS = 0, 1, 2


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    if t >= FIRST_STEP:
        residual = stack(ROWS)
        places(x, data, residual)
        for row in range(ROWS):
            cost, _, _ = loss(residual[row], row, data)
            total += cost
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The residual's own curvature is left out."""
    total = 0.0
    if t >= FIRST_STEP:
        residual, moves = stack(ROWS), stack(ROWS, N)
        clear(moves, ROWS, N)
        places_jacobian(x, data, residual, moves)
        for row in range(ROWS):
            cost, slope, curvature = loss(residual[row], row, data)
            total += cost
            if slope != 0 or curvature != 0:
                for i in range(LEADING_STATES):
                    gradient[i] += slope * moves[row, i]
                    for j in range(LEADING_STATES):
                        hessian[i, j] += curvature * moves[row, i] * moves[row, j]
    return total


def row_value(at, u, t, row, data):
    """The row minus its number, given the whole residual."""
    steps, each, column = int(data[AT + STEPS]), int(data[AT + EACH]), int(data[AT + COLUMNS + row])
    return at[row] - data[AT + COLUMNS + ROWS + min(t, steps - 1) * each + column]


def row_slope(at, jacobian, t, row, data, gradient):
    """Add its gradient, given the whole residual and its derivatives in the states."""
    for i in range(N):
        gradient[i] += jacobian[row, i]

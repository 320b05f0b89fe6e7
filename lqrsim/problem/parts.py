"""The costs and constraints of a problem, and the terms that they become for one system.

The structure of a term is source text, its numbers are data. `+` composes costs. Constraints are numbers that must be
nonnegative, or zero, besides the limits of the controls.

To add a kind, state it as a formula with `SymbolicCost` or `SymbolicConstraint`; or subclass `Cost` or `Constraint` in
a file of its own, with its kernel, and write `bind`. The `HuberDistance` of docs/stating_a_system.md is one to copy.
"""

import abc
import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Generic, NoReturn, Self, TypeVar

import numpy as np

from lqrsim.annotations import Index, NonNegative, Want, checked
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import Term
from lqrsim.errors import Array, InputError, brief, check_count, check_kind
from lqrsim.kernels.declarations import N, W, loss, shared_jacobian, shared_values, stack, zeros
from lqrsim.kernels.linear_algebra import clear
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.solution_parts import Horizon, Trajectory, left_after

if TYPE_CHECKING:
    from lqrsim.problem.obstacles import KeepsClear
    from lqrsim.problem.quadratic_cost import ControlCost, QuadraticCost

EQUALITY_TOLERANCE = 1e-6  # tolerance of equalities, unless `constraint_tolerance` is smaller
STEPS = ("all", "final")  # the steps at which a constraint can act
Side = float | Array  # a bound, or one for each knot, (K,)


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
        """A kernel of costs or constraints whose open function `shared_values` is filled with the residual."""
        return kernel.filled(shared_values=(self.code, "residual"), shared_jacobian=(self.code, "residual_jacobian"))


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

    @checked
    def scaled(self, factor: NonNegative) -> Self:
        """The term times a number, which is the last in its data: another number compiles nothing."""
        kernels = source_of(__name__, FACTOR=self.numbers)
        kernels = kernels.filled(unscaled=(self.code, "value"), unscaled_derivatives=(self.code, "derivatives"))
        source = kernels.filled(value=(kernels, "scaled_value"), derivatives=(kernels, "scaled_derivatives"))
        return replace(self, source=source, data=np.append(self.data, factor))


@checked
@dataclass(frozen=True, eq=False)
class ConstraintTerm(Term):
    """A constraint, for one system: `rows` numbers at each step, or at the last alone if it is `final_only`, that must
    be nonnegative, or zero if it is an `equality`.

    The source defines `value(x, u, t, row, data)`, which returns one of the numbers, and `slope(x, u, t, row, data,
    gradient)`, which *adds* its gradient (n+m,), states before controls.

    Attributes:
      describe: the name of a row for messages.
      names: a name of each row for `Problem.violations`, without numbers that may change; rows of one name count as
        one. By default rows have their indices.
      uses_control: whether the entries depend on u; if so, they do not act at the last knot.
      shared: number of values that all rows share, such as the centres of balls, computed once per step. Above 0, the
        source must define `shared_values(x, data, out)` and `shared_jacobian(x, data, out, slopes)`, as the `residual`
        of a Residual, and `value` and `slope` get these values (shared,) and their derivatives (shared, n) in place of
        x and u.
      convex: whether the states that satisfy an inequality form a convex set: there is then no way round.
      ranges: (rows,) the distance between the two bounds of a value that has both, infinite for others: the most that
        counts as a typical change.
      linear: whether the values are linear in state and control, so that no solver looks for their curvature.
      yields: whether the robot keeps an inequality by itself, as one that clips forces. A re-plan may then violate it,
        at a price: after a push, no plan may satisfy it.
    """

    rows: Index
    describe: Annotated[Callable[[int], str], Want("a function of a row")]
    uses_control: bool = False
    equality: bool = False
    final_only: bool = False
    shared: Index = 0
    convex: bool = False
    ranges: Array | None = None
    linear: bool = False
    yields: bool = False
    names: Annotated[tuple[str, ...], Want("a tuple with a name of each row")] = ()

    @property
    def _defines(self) -> Mapping[str, int]:
        of_all = {"shared_values": 3, "shared_jacobian": 4} if self.shared else {}
        return {"value": 5, "slope": 6, **of_all}

    @property
    def digested(self) -> list[str | Array]:
        kind = self.equality, self.final_only
        return [*super().digested, *([repr(kind)] if any(kind) else [])]

    def __post_init__(self) -> None:
        if (count := len(self.names)) not in (0, self.rows):
            raise InputError(f"ConstraintTerm: names: got {count}, want none, or one for each of {self.rows} rows")
        if self.uses_control and self.final_only:
            raise InputError("ConstraintTerm: final_only: got True with uses_control, want one of the two")
        super().__post_init__()

    @classmethod
    def of_residual(
        cls, residual: Residual, least: Array, columns: Sequence[int], describe: Callable[[int], str], *,
        equality: bool = False, final_only: bool = False,
    ) -> Self:  # fmt: skip
        """The constraint that each row of a residual is at least some number, or with `equality` is that number.

        Args:
          least: the numbers, (K, L): of K steps, the last of which holds from its step on.
          columns: the index of each row's number among L.
        """
        shared = max(1, residual.rows)
        rows = source_of(__name__, AT=residual.numbers, ROWS=shared)
        return cls(
            residual.filling(rows.filled(value=(rows, "row_value"), slope=(rows, "row_slope"))),
            np.concatenate([residual.data, least.shape, columns, least.ravel()]), residual.rows, describe,
            equality=equality, final_only=final_only, shared=shared, functions=residual.functions, names=residual.parts,
        )  # fmt: skip


_BoundTerm = TypeVar("_BoundTerm", bound=Term)


class ProblemPart(abc.ABC, Generic[_BoundTerm]):
    """A cost or a constraint, which can be bound to any system that it fits.

    A kind writes `bind`. The rest are answers that most kinds share; a kind with another answer overrides it.
    """

    _same_with_added_state = False

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics) -> _BoundTerm:
        """Bind the term to a system."""

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> _BoundTerm:
        """Bind the term to a system, for a problem.

        Args:
          times: (T+1,) in s, of the knots. goals: the final values that constraints require of states, by index.
        """
        return self.bind(dynamics)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        """The same for a system with one more state, the last, of which it is independent: for a free duration, and for
        each control with a `control_rate`. `dynamics` are those without that state.
        """
        if self._same_with_added_state:
            return self
        got = f"a {type(self).__name__} beside one of them, which cannot have one more state"
        raise InputError(f"duration and control_rate: got {got}, want none")

    @property
    def by_knot(self) -> bool:
        """Whether it has other numbers at each knot; initial and final costs may not."""
        return False

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

    def __repr__(self) -> str:
        parts = [
            f"{name}={self._brief(name, value)}"
            for name, value in self._stated().items()
            if not (value is None or value is False or (isinstance(value, Mapping) and not value))
        ]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _stated(self) -> Mapping[str, object]:
        """The arguments that it was made from, by name."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def _brief(self, name: str, value: object) -> str:
        """An argument as it is printed."""
        return brief(value)


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

    @checked
    def scaled(self, factor: NonNegative) -> "Cost":
        """The cost times a number. Costs with a reference or obstacles have their own: the search changes weights."""
        if self.state_reference is not None or self.control_reference is not None or self.kept_clear is not None:
            raise InputError(f"{self.name}: got no method scaled, want it to return the cost times a number")
        return _ScaledCost(self, factor)

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


class _OfCosts(Cost):
    """A cost that is made of others, its `terms`, which are asked what it is."""

    terms: tuple[Cost, ...]

    @abc.abstractmethod
    def _of(self, terms: Iterable[Cost]) -> Self:
        """The same of other terms."""

    @property
    def by_knot(self) -> bool:
        return any(term.by_knot for term in self.terms)

    @property
    def moving(self) -> bool:
        return any(term.moving for term in self.terms)

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> Self:
        return self._of(term.ahead(steps, horizon=horizon) for term in self.terms)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self._of(term.with_added_state(dynamics) for term in self.terms)

    def _in(self, dynamics: Dynamics) -> Self:
        ordered = [term._in(dynamics) for term in self.terms]
        return self if all(map(operator.is_, self.terms, ordered)) else self._of(ordered)


class CostSum(_OfCosts):
    """The result of `+`: the terms, in order. It is bound term by term, and what differs by term is asked of each."""

    def __init__(self, terms: Iterable[Cost]) -> None:
        self.terms = tuple(terms)

    def _of(self, terms: Iterable[Cost]) -> "CostSum":
        return CostSum(terms)

    def _refused(self) -> NoReturn:
        raise InputError("cost: got a sum of costs, want a single term: bind the `terms` one by one")

    kept_clear = state_reference = property(_refused)  # pyright: ignore[reportIncompatibleMethodOverride]
    control_reference = contact_curvature = property(_refused)  # pyright: ignore[reportIncompatibleMethodOverride]

    def bind(self, dynamics: Dynamics) -> CostTerm:
        self._refused()

    def scaled(self, factor: float) -> "CostSum":
        return CostSum(term.scaled(factor) for term in self.terms)

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms))


class _ScaledCost(_OfCosts):
    """A cost times a number, for kinds that have no weight to change."""

    def __init__(self, cost: Cost, factor: float) -> None:
        self.terms, self._cost, self.factor = (cost,), cost, factor

    def _of(self, terms: Iterable[Cost]) -> "_ScaledCost":
        (cost,) = terms
        return _ScaledCost(cost, self.factor)

    @property
    def name(self) -> str:
        return self._cost.name

    def off_place(self, dynamics: Dynamics, states: Array) -> dict[str, Array]:
        return self._cost.off_place(dynamics, states)

    def bind(self, dynamics: Dynamics) -> CostTerm:
        return self._cost.bind(dynamics).scaled(self.factor)

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> CostTerm:
        return self._cost._bind_at(dynamics, times, goals).scaled(self.factor)

    def __repr__(self) -> str:
        return f"{self.factor:g} * {self._cost!r}"


def terms_of(cost: Cost) -> tuple[Cost, ...]:
    """The terms of a sum; a single cost is its own."""
    if isinstance(cost, CostSum):
        return cost.terms
    return (check_kind("cost", cost, Cost, Cost._want),)


def weighing_obstacles(cost: Cost, factor: float) -> CostSum:
    """The cost with the weights of its obstacles multiplied."""
    return CostSum(term if term.kept_clear is None else term.scaled(factor) for term in terms_of(cost))


class Constraint(ProblemPart[ConstraintTerm]):
    """Numbers that must be nonnegative, or zero, at each step or at the last; `bind` makes them for a system."""

    # The largest violation, in its unit, of a plan along which it is refined; 0 if `_refined` returns no other.
    _rough: float = 0.0

    def final_states(self, dynamics: Dynamics) -> Mapping[int, float]:
        """The final values that it requires of states, by their indices."""
        return {}

    def _turning_states(self, dynamics: Dynamics) -> Set[int]:
        """The indices of the states whose final value it requires only up to whole turns."""
        return frozenset()

    def state_bounds(self, dynamics: Dynamics) -> Mapping[int, tuple[Side, Side]]:
        """The low and the high bound, each a number or (K,) for K knots, of each state that it bounds, by its index."""
        return {}

    def _refined(self, dynamics: Dynamics, plan: Trajectory) -> "Constraint | None":
        """What `smooth` solves again with, a few times, if a plan misses it within its periods; else None."""
        return None


def goals_of(constraints: Sequence[Constraint], dynamics: Dynamics) -> dict[int, float]:
    """The final values that all constraints require, by the index of the state. None may contradict another."""
    goals: dict[int, float] = {}
    for constraint in constraints:
        for i, number in constraint.final_states(dynamics).items():
            if goals.setdefault(i, number) != number:
                name = dynamics.state_coordinates.names[i]
                raise InputError(f"constraints: got goals of {goals[i]:g} and {number:g} for {name}, want one goal")
    return goals


def terms_for(
    dynamics: Dynamics, times: Array, parts: Iterable[ProblemPart[Any]], kind: type[_BoundTerm],
    goals: Mapping[int, float] = MappingProxyType({}),
) -> tuple[_BoundTerm, ...]:  # fmt: skip
    """The terms of costs or constraints; see `ProblemPart._bind_at`. Raises InputError if `bind` returns no such."""
    pairs = [(f"{type(part).__name__}.bind", part._bind_at(dynamics, times, goals)) for part in parts]
    return tuple(check_kind(field, term, kind, f"a {kind.__name__}") for field, term in pairs)


def check_bounds(constraints: Iterable[Constraint], dynamics: Dynamics, knots: int) -> None:
    """Raises InputError if a bound does not have a number for each knot, or those of a state leave nothing between."""
    names = dynamics.state_coordinates.names
    all_bounds = [constraint.state_bounds(dynamics) for constraint in constraints]
    for i, sides in (item for bounds in all_bounds for item in bounds.items()):
        for side in sides:
            if isinstance(side, np.ndarray) and len(side) != knots:
                want = f"one, or one for each of {knots} knots"
                raise InputError(f"StateBounds: {names[i]}: got {len(side)} numbers, want {want}")
    for i in {i for bounds in all_bounds for i in bounds}:
        lows, highs = zip(*(bounds[i] for bounds in all_bounds if i in bounds), strict=True)
        sides = functools.reduce(np.maximum, lows), functools.reduce(np.minimum, highs)
        low, high = (np.broadcast_to(side, knots) for side in sides)
        if crossed := np.flatnonzero(~(low < high)).tolist():
            t, where = crossed[0], "" if len(crossed) == knots else f" at knot {crossed[0]}"
            got = f"{names[i]} of at least {low[t]:g} and at most {high[t]:g}{where}"
            raise InputError(f"constraints: got {got}, want bounds with room between them")


def names_of(constraint: Constraint, term: ConstraintTerm) -> list[str]:
    """A name of each row of a constraint that does not change with its numbers, such as "StateBounds: x low"."""
    kind = type(constraint).__name__
    if term.names:
        return [f"{kind}: {name}" for name in term.names]
    return [kind] if term.rows == 1 else [f"{kind}[{row}]" for row in range(term.rows)]


def violation_of(term: ConstraintTerm, values: Array) -> float:
    """The largest violation of a constraint, given its values: 0 if it is satisfied, infinite if a value is NaN."""
    missed = float((np.abs(values) if term.equality else -values).max(initial=0.0))
    return missed if not np.isnan(missed) else np.inf


def allowed_violation(term: ConstraintTerm, tolerance: float, *, spared: bool = True) -> float:
    """The largest violation that counts as none. If `tolerance` is a margin, inequalities may not be violated."""
    if term.equality:
        return min(tolerance, EQUALITY_TOLERANCE)
    return 0.0 if spared else tolerance


# The kernels of residuals. The shared values are the residual, with whose data `data` begins. Of a constraint it has,
# from AT on, the numbers below, and the table of what is subtracted from the rows, step by step; the last ones hold
# from their step on.
ROWS = 1  # number of rows
LEADING_STATES = 1  # number of states, from the first on, that the residual depends on
FIRST_STEP = 0  # the first step at which a cost acts: 1 for what cannot change at a given start
AT = 0
# From there on: numbers of steps in the table, and of columns; then the column of each row.
TABLE_ROWS, EACH, COLUMNS = 0, 1, 2


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    if t >= FIRST_STEP:
        residual = stack(ROWS)
        shared_values(x, data, residual)
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
        shared_jacobian(x, data, residual, moves)
        for row in range(ROWS):
            cost, slope, curvature = loss(residual[row], row, data)
            total += cost
            if slope != 0 or curvature != 0:
                for i in range(LEADING_STATES):
                    gradient[i] += slope * moves[row, i]
                    for j in range(LEADING_STATES):
                        hessian[i, j] += curvature * moves[row, i] * moves[row, j]
    return total


def row_value(residual, u, t, row, data):
    """The row minus its number, given the whole residual."""
    steps, each, column = int(data[AT + TABLE_ROWS]), int(data[AT + EACH]), int(data[AT + COLUMNS + row])
    return residual[row] - data[AT + COLUMNS + ROWS + min(t, steps - 1) * each + column]


def row_slope(residual, jacobian, t, row, data, gradient):
    """Add its gradient, given the whole residual and its derivatives in the states."""
    for i in range(N):
        gradient[i] += jacobian[row, i]


# The kernels of a cost times a number, which `data` has at FACTOR; the cost itself is filled in.
FACTOR = 0
unscaled: Any = None
unscaled_derivatives: Any = None


def scaled_value(x, u, t, data):
    """The cost."""
    return data[FACTOR] * unscaled(x, u, t, data)


def scaled_derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    curve, slope = zeros(W, W), zeros(W)
    total = unscaled_derivatives(x, u, t, data, curve, slope)
    for i in range(W):
        gradient[i] += data[FACTOR] * slope[i]
        for j in range(W):
            hessian[i, j] += data[FACTOR] * curve[i, j]
    return data[FACTOR] * total

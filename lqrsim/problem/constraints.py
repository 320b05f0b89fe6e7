"""Constraints on a plan besides the limits of the controls: numbers that must be nonnegative, or zero.

To add a kind, state it as a formula with `SymbolicConstraint`, or subclass `Constraint` and write `bind`.
"""

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.codegen import symbolic
from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import Term
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_count,
    check_flag,
    check_function,
    check_items,
    check_kind,
    check_name,
    check_number,
    excerpt,
    keep,
    numbers_of,
)
from lqrsim.kernels import state_bound
from lqrsim.problem.costs import OfFormula, ProblemPart, bound_at, rows_ahead
from lqrsim.problem.dynamics import Dynamics

EQUALITY_TOLERANCE = 1e-6  # tolerance of equalities, unless `constraint_tolerance` is smaller
STEPS = ("all", "final")  # the steps at which a constraint can act
Side = float | Array  # a bound, or one for each knot, (K,)
Bounds = tuple[npt.ArrayLike, npt.ArrayLike]  # low and high, as given
_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class ConstraintTerm(Term):
    """A constraint, made for one system: numbers at each step that must be nonnegative, or zero.

    The source defines `value(x, u, t, row, data)`, which returns one of the numbers, and `slope(x, u, t, row, data,
    gradient)`, which *adds* its gradient (n+m,), states before controls.

    Attributes:
      rows: number of entries at a step.
      describe: returns the name of a row for messages.
      uses_control: whether the entries depend on u; if so, they do not act at the last step, which has no control.
      equality: whether the entries must be zero.
      final_only: whether the entries act only at the last step.
      shared: number of values that all rows share, such as the centres of balls; they are computed once per step. If it
        is not 0, the source must define `places` and `places_jacobian`, as in `SphereCenters`. Then `value` and `slope`
        get these values (shared,) and their derivatives (shared, n) in place of x and u.
      convex: whether the states that satisfy an inequality form a convex set: there is then no way round.
    """

    rows: int
    describe: Callable[[int], str]
    uses_control: bool = False
    equality: bool = False
    final_only: bool = False
    shared: int = 0
    convex: bool = False

    @property
    def _defines(self) -> Mapping[str, int]:
        of_all = {"places": 3, "places_jacobian": 4} if self.shared else {}
        return {"value": 5, "slope": 6, **of_all}

    def __post_init__(self) -> None:
        keep(self, rows=check_count("ConstraintTerm: rows", self.rows, at_least=0))
        check_function("ConstraintTerm: describe", self.describe, "a function of a row", optional=False)
        for name in ("uses_control", "equality", "final_only", "convex"):
            keep(self, **{name: check_flag(f"ConstraintTerm: {name}", getattr(self, name))})
        if self.uses_control and self.final_only:
            raise InputError("ConstraintTerm: final_only: got True with uses_control, want one of the two")
        keep(self, shared=check_count("ConstraintTerm: shared", self.shared, at_least=0))
        super().__post_init__()


class Constraint(ProblemPart[ConstraintTerm]):
    """A constraint."""

    def final_states(self, dynamics: Dynamics) -> Mapping[int, float]:
        """The final values that it requires of states, by their indices.

        Args:
          dynamics: dynamics of the system.

        Raises:
          InputError: it does not fit the system.
        """
        return {}

    def state_bounds(self, dynamics: Dynamics) -> Mapping[int, tuple[Side, Side]]:
        """The low and the high bound, each a number or (K,) for K knots, of each state that it bounds, by its index.

        Args:
          dynamics: dynamics of the system.

        Raises:
          InputError: it does not fit the system.
        """
        return {}

    def _bind_beside(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        """As `bound_at`, beside constraints that require final values of states, by their indices."""
        return bound_at(self, dynamics, times)


class SymbolicConstraint(OfFormula, Constraint):
    """A constraint stated as a formula: `f(x, u) >= 0`, or `f(x, u) = 0` with `equality`.

        def slower_than_2(x, u, p):  # a planar speed, in m/s
            return p.speed**2 - x.vx**2 - x.vy**2

        ls.SymbolicConstraint(slower_than_2, parameters={"speed": 2.0})

    A constraint that depends on the control acts at all steps that have a control, so not at the last knot. A
    constraint on the state alone acts at the last knot, too. It does not act at a start that is given exactly, because
    that cannot change.

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`; returns one expression, or a list of them, that
        must be nonnegative. Either all of them depend on u, or none does. All are solved to the same tolerance, so
        choose units in which values of about 1 matter.
      parameters: name -> value, as in `Dynamics`.
      equality: whether the expressions must be zero, within 1e-6, or `constraint_tolerance` if that is smaller.
      at: "all" steps, or only the "final" step, at which the expressions must not depend on u.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        parameters: Mapping[str, float] | None = None,
        equality: bool = False,
        at: str = "all",
    ) -> None:
        self._set_formula(function, parameters, "one of SymPy symbols")
        self.equality = check_flag("SymbolicConstraint: equality", equality)
        self.at = check_name("SymbolicConstraint: at", at, STEPS)

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        names = dynamics.state_coordinates.names, dynamics.control_coordinates.names
        details = ("constraint", *names, tuple(self.parameters))
        made = symbolic.kept(
            self.function, details, lambda: self._trace(*names), source=str, rows=int, with_control=list
        )
        with_control, rows = made["with_control"], made["rows"]
        if self.at == "final" and with_control:
            raise InputError(
                f"{self.name}: got an entry that depends on u, want none at the final step, which has no u"
            )
        if 0 < len(with_control) < rows:
            raise InputError(
                f"{self.name}: got {rows} entries of which {len(with_control)} depend on u, want all of them or none:"
                " state the others as another SymbolicConstraint"
            )
        kind = "zero" if self.equality else "not negative"
        return ConstraintTerm(
            source=made["source"],
            data=self._data,
            rows=rows,
            describe=lambda row: f"that {self.name}{f'[{row}]' if rows > 1 else ''} is {kind}",
            uses_control=bool(with_control),
            equality=self.equality,
            final_only=self.at == "final",
        )

    def _trace(self, states: Sequence[str], controls: Sequence[str]) -> dict[str, Any]:
        traced, x, u = symbolic.trace(self.function, states, controls, list(self.parameters))
        if not traced:
            raise InputError(f"{self.name}: got no entries, want at least one: each must be nonnegative, or zero")
        parts, choices = [], {"value": [], "slope": []}
        for row, entry in enumerate(traced):
            if not entry.free_symbols & {*x, *u}:
                raise InputError(f"{self.name}: got {entry} as entry {row}, want it to depend on x or u")
            slopes = {f"gradient[{i}]+": entry.diff(symbol) for i, symbol in enumerate([*x, *u])}
            slopes = {target: slope for target, slope in slopes.items() if slope != 0}
            value, slope = f"value_{row}(x, u, data)", f"slope_{row}(x, u, data, gradient)"
            parts.append(_written(value, {"entry": entry}, self.name, returns="entry"))
            parts.append(_written(slope, slopes, self.name))
            choices["value"].append(f"    if row == {row}:\n        return {value}")
            choices["slope"].append(f"    if row == {row}:\n        {slope}")
        value = "\n".join(["def value(x, u, t, row, data):", *choices["value"], "    return 0.0"])
        slope = "\n".join(["def slope(x, u, t, row, data, gradient):", *choices["slope"]])
        return {
            "source": "\n\n".join([*parts, value, slope]) + "\n",
            "rows": len(traced),
            "with_control": [row for row, entry in enumerate(traced) if entry.free_symbols & set(u)],
        }


class GoalState(Constraint):
    """The final state equals a goal: `x_T = goal`. A final cost only draws the state to it.

        ls.GoalState(x=1.0, velocity=0.0)

    Args:
      goal: (n,) the state, in the states' units; or a dictionary of name or unit: number, for some of the states, such
        as {"m/s": 0} for all velocities. Angles count whole turns, as for a QuadraticCost.
      **named: name of a state -> number, in place of a dictionary.

    Raises:
      InputError: no goal, a number that is not finite, or a state that is named twice.
    """

    def __init__(self, goal: npt.ArrayLike | Mapping[str, float] | None = None, /, **named: float) -> None:
        self.goal: Array | dict[str, float]
        if goal is None or named or isinstance(goal, Mapping):
            self.goal = by_name("GoalState", goal, named, "a number", check_number)
        else:
            self.goal = check_array("GoalState: goal", goal, (None,))

    def final_states(self, dynamics: Dynamics) -> Mapping[int, float]:
        names, goal = dynamics.state_coordinates.names, self.goal
        if isinstance(goal, dict):
            return dynamics.state_coordinates._by_name("GoalState: states", goal, check_number)
        if len(goal) != len(names):
            each = f"one for each of {', '.join(names)}"
            raise InputError(f"GoalState: goal: got {len(goal)} numbers, want {len(names)}, {each}")
        return dict(enumerate(goal.tolist()))

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        names, units = dynamics.state_coordinates.names, dynamics.state_coordinates.units
        rows = list(self.final_states(dynamics).items())
        described = [f"the goal of {_quantity(number, units[i])} for {names[i]}" for i, number in rows]
        data = _bound_data([(i, 1.0, np.inf, np.array([number])) for i, number in rows])
        return ConstraintTerm(
            source_of(state_bound), data, len(rows), described.__getitem__, equality=True, final_only=True
        )

    def with_added_state(self, dynamics: Dynamics) -> "GoalState":
        names = dynamics.state_coordinates.names  # numbers by unit would also apply to the added state
        return GoalState({names[i]: number for i, number in self.final_states(dynamics).items()})


class StateBounds(Constraint):
    """Bounds on states, `low <= x_t <= high`, at each step except a start that is given exactly.

        ls.StateBounds(height=(0.1, 2.0), velocity=(-np.inf, 1.5))
        ls.StateBounds(height=(lows, 2.0))  # a lower bound for each knot

    At the end, the bounds do not act on a state that a GoalState fixes. A goal may therefore lie on a bound.

    Either bound may have one number for each of the T+1 knots; where it is infinite, it does not act. A waypoint, or a
    gate that is open for a while, is such a bound. Numbers belong to knots, also with a free duration. When a
    `Replanner` plans again, they move with time as a reference does, see `QuadraticCost`.

    Args:
      bounds: a dictionary of name or unit of a state: (low, high), in its unit, each a number or (T+1,) numbers. An
        infinite number means no bound. A name takes precedence over a unit.
      **named: name of a state -> (low, high), in place of a dictionary.

    Raises:
      InputError: no bounds, no finite bound for a state, low not below high, or a state that is named twice.
    """

    def __init__(self, bounds: Mapping[str, Bounds] | None = None, /, **named: Bounds) -> None:
        self.bounds = by_name("StateBounds", bounds, named, "(low, high)", _bound)

    @property
    def by_knot(self) -> bool:
        return any(isinstance(side, np.ndarray) for sides in self.bounds.values() for side in sides)

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> Self:
        super().ahead(steps, horizon=horizon)
        if not self.by_knot:
            return self
        other = copy.copy(self)
        other.bounds = {
            name: (_ahead(low, steps, horizon), _ahead(high, steps, horizon))
            for name, (low, high) in self.bounds.items()
        }
        return other

    def state_bounds(self, dynamics: Dynamics) -> Mapping[int, tuple[Side, Side]]:
        def sides(field: str, given: object) -> tuple[Side, Side]:
            return given  # pyright: ignore[reportReturnType]

        return dynamics.state_coordinates._by_name("StateBounds: states", self.bounds, sides)

    def with_added_state(self, dynamics: Dynamics) -> "StateBounds":
        names = dynamics.state_coordinates.names  # as for a GoalState
        return StateBounds({names[i]: sides for i, sides in self.state_bounds(dynamics).items()})

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_beside(dynamics, np.zeros(1), {})

    def _bind_beside(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        """Raises InputError if a goal is outside the bounds."""
        names, units = dynamics.state_coordinates.names, dynamics.state_coordinates.units
        rows, described = [], []
        for side, sign, word in ((0, 1.0, "at least"), (1, -1.0, "at most")):
            for i, sides in self.state_bounds(dynamics).items():
                name, numbers = names[i], np.atleast_1d(sides[side])
                acts = np.isfinite(numbers)
                if not (acts.any() or isinstance(sides[side], np.ndarray)):
                    continue
                wanted = f"{name} of {word} {_quantities(numbers[acts] if acts.any() else numbers, units[i])}"
                if i in goals and sign * (goals[i] - numbers[-1]) < 0:
                    goal = _quantity(goals[i], units[i])
                    raise InputError(f"constraints: got a goal of {goal} for {name}, want {wanted}")
                rows.append((i, sign, len(times) - 2 if i in goals else np.inf, numbers))
                described.append(wanted)
        return ConstraintTerm(source_of(state_bound), _bound_data(rows), len(rows), described.__getitem__, convex=True)


def goals_of(constraints: Sequence[Constraint], dynamics: Dynamics) -> dict[int, float]:
    """The final values that all constraints require, by the index of the state. Raises InputError if two of them
    contradict each other.
    """
    goals: dict[int, float] = {}
    for constraint in constraints:
        for i, number in constraint.final_states(dynamics).items():
            if goals.setdefault(i, number) != number:
                name = dynamics.state_coordinates.names[i]
                raise InputError(f"constraints: got goals of {goals[i]:g} and {number:g} for {name}, want one goal")
    return goals


def bind_all(constraints: Sequence[Constraint], dynamics: Dynamics, times: Array) -> tuple[ConstraintTerm, ...]:
    """The constraints for a system and the times (T+1,) in s of the knots.

    Raises:
      InputError: the constraints do not fit the system, or each other.
    """
    goals, terms = goals_of(constraints, dynamics), []
    _check_bounds([one.state_bounds(dynamics) for one in constraints], dynamics, len(times))
    for constraint in constraints:
        term = constraint._bind_beside(dynamics, times, goals)
        terms.append(check_kind(f"{type(constraint).__name__}.bind", term, ConstraintTerm, "a ConstraintTerm"))
    return tuple(terms)


def _check_bounds(found: Sequence[Mapping[int, tuple[Side, Side]]], dynamics: Dynamics, knots: int) -> None:
    """Raises InputError if a bound does not have a number for each knot, or those of a state leave nothing between."""
    names = dynamics.state_coordinates.names
    for i, sides in (item for one in found for item in one.items()):
        for side in sides:
            if isinstance(side, np.ndarray) and len(side) != knots:
                want = f"one, or one for each of {knots} knots"
                raise InputError(f"StateBounds: {names[i]}: got {len(side)} numbers, want {want}")
    for i in {i for one in found for i in one}:
        lows, highs = zip(*(one[i] for one in found if i in one), strict=True)
        low, high = (np.broadcast_to(side, knots) for side in (_greatest(lows), -_greatest([-one for one in highs])))
        if crossed := np.flatnonzero(~(low < high)).tolist():
            t, each = crossed[0], "" if len(crossed) == knots else f" at knot {crossed[0]}"
            raise InputError(
                f"constraints: got {names[i]} of at least {low[t]:g} and at most {high[t]:g}{each}, want bounds with"
                " room between them"
            )


def _greatest(sides: Sequence[Side]) -> Side:
    """The greatest number, at each knot."""
    return functools.reduce(np.maximum, sides)


def violation_of(term: ConstraintTerm, values: Array) -> float:
    """The largest violation of a constraint, given its values: 0 if it is satisfied, infinite if a value is NaN."""
    missed = float((np.abs(values) if term.equality else -values).max(initial=0.0))
    return missed if not np.isnan(missed) else np.inf


def allowed_violation(term: ConstraintTerm, tolerance: float, *, spared: bool = True) -> float:
    """The largest violation that counts as none. If `tolerance` is a margin, inequalities may not be violated."""
    if term.equality:
        return min(tolerance, EQUALITY_TOLERANCE)
    return 0.0 if spared else tolerance


def _written(signature: str, assignments: Mapping[str, Any], of: str, returns: str | None = None) -> str:
    name, arguments = signature.removesuffix(")").split("(")
    return symbolic.write_function(name, arguments, "data", assignments, of=of, returns=returns)


def by_name(
    who: str, given: object, named: Mapping[str, Any], each: str, check: Callable[[str, Any], _Value]
) -> dict[str, _Value]:
    """The values given for states by name, in a dictionary or by keyword. Raises InputError."""
    want = f"{each} by name of a state, as {who}(x=...) or {who}({{'x': ...}})"
    check_kind(who, given, (Mapping, type(None)), want)
    stated = dict(given or {})  # pyright: ignore[reportCallIssue, reportArgumentType]
    check_items(who, tuple(stated), str, want)
    for name in stated.keys() & named.keys():
        raise InputError(f"{who}: got {excerpt(name)} twice, want each state once")
    if not stated and not named:
        raise InputError(f"{who}: got nothing, want {want}")
    return {name: check(f"{who}: {excerpt(name)}", value) for name, value in {**stated, **named}.items()}


def _bound(field: str, given: object) -> tuple[Side, Side]:
    """(low, high), each a number or numbers (K,), at least one of them finite."""
    want = "(low, high), each a number or one for each knot; infinite for no bound"
    sides = check_items(field, given, object, want)
    if len(sides) != 2:
        raise InputError(f"{field}: got {len(sides)} items, want {want}")
    low, high = (_side(f"{field}: {name}", side) for name, side in zip(("low", "high"), sides, strict=True))
    if isinstance(low, np.ndarray) and isinstance(high, np.ndarray) and len(low) != len(high):
        raise InputError(f"{field}: got {len(low)} and {len(high)} numbers, want one for each knot in both")
    lows, highs = np.broadcast_arrays(np.atleast_1d(low), np.atleast_1d(high))
    wrong = np.flatnonzero(~(lows < highs)).tolist()
    if wrong or not (np.isfinite(lows).any() or np.isfinite(highs).any()):
        at = wrong[0] if wrong else 0
        knot = f" at knot {at}" if wrong and len(lows) > 1 else ""
        raise InputError(
            f"{field}: got {lows[at]:g} to {highs[at]:g}{knot}, want low below high, and one of them finite"
        )
    return low, high


def _side(field: str, given: object) -> Side:
    """A bound, or one for each knot. Raises InputError for anything else."""
    numbers = numbers_of(field, given, "a number, or one for each knot")
    numbers = check_array(field, numbers, (None,) if numbers.ndim else (), infinite=True)
    if not numbers.size:
        raise InputError(f"{field}: got no numbers, want one, or one for each knot")
    return numbers if numbers.ndim else numbers.item()


def _ahead(side: Side, steps: int, horizon: str) -> Side:
    return rows_ahead(side, steps, horizon) if isinstance(side, np.ndarray) else side


def _bound_data(rows: Sequence[tuple[int, float, float, Array]]) -> Array:
    """The numbers for `state_bound.py`: of each row the state, the sign, the last step, and one bound or K of them."""
    knots = max(len(bounds) for *_, bounds in rows)
    table = [[i, sign, last, *np.broadcast_to(bounds, knots)] for i, sign, last, bounds in rows]
    return np.concatenate([[knots], np.ravel(table)])


def _quantity(number: float, unit: str) -> str:
    return f"{number:g} {unit}".rstrip()


def _quantities(numbers: Array, unit: str) -> str:
    """The least and the greatest number, or the one that all are."""
    low, high = numbers.min(), numbers.max()
    return _quantity(low, unit) if low == high else f"{low:g} to {_quantity(high, unit)}"

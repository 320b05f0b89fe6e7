"""Constraints on a plan besides the limits of the controls: numbers that must be nonnegative, or zero.

To add a kind, state it as a formula with `SymbolicConstraint`; or subclass `Constraint` in a file of its own, with its
kernel, and write `bind`.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Index, Want, checked
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import Term, address_of
from lqrsim.errors import Array, InputError, check_items, check_kind, excerpt
from lqrsim.problem import costs
from lqrsim.problem.costs import CostTerm, ProblemPart, Residual
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.solution_parts import Trajectory

EQUALITY_TOLERANCE = 1e-6  # tolerance of equalities, unless `constraint_tolerance` is smaller
STEPS = ("all", "final")  # the steps at which a constraint can act
Side = float | Array  # a bound, or one for each knot, (K,)
_Value = TypeVar("_Value")


@checked
@dataclass(frozen=True, eq=False)
class ConstraintTerm(Term):
    """A constraint, made for one system: numbers at each step that must be nonnegative, or zero.

    The source defines `value(x, u, t, row, data)`, which returns one of the numbers, and `slope(x, u, t, row, data,
    gradient)`, which *adds* its gradient (n+m,), states before controls.

    Attributes:
      describe: the name of a row for messages.
      names: a name of each row for `Problem.violations`, without numbers that may change; rows of one name count as
        one. By default rows have their indices.
      uses_control: whether the entries depend on u; if so, they do not act at the last knot.
      shared: number of values that all rows share, such as the centres of balls, computed once per step. Above 0, the
        source must define `places` and `places_jacobian`, as in `SphereCenters`, and `value` and `slope` get these
        values (shared,) and their derivatives (shared, n) in place of x and u.
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
        of_all = {"places": 3, "places_jacobian": 4} if self.shared else {}
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
        rows = source_of(costs, AT=residual.numbers, ROWS=shared)
        return cls(
            residual.filling(rows.filled(value=(rows, "row_value"), slope=(rows, "row_slope"))),
            np.concatenate([residual.data, least.shape, columns, least.ravel()]), residual.rows, describe,
            equality=equality, final_only=final_only, shared=shared, functions=residual.functions, names=residual.parts,
        )  # fmt: skip


class Constraint(ProblemPart[ConstraintTerm]):
    """A constraint."""

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


def bind_all(constraints: Sequence[Constraint], dynamics: Dynamics, times: Array) -> tuple[ConstraintTerm, ...]:
    """The constraints for a system and the times (T+1,) in s of the knots."""
    goals, terms = goals_of(constraints, dynamics), []
    _check_bounds([constraint.state_bounds(dynamics) for constraint in constraints], dynamics, len(times))
    for constraint in constraints:
        term = constraint._bind_at(dynamics, times, goals)
        terms.append(check_kind(f"{type(constraint).__name__}.bind", term, ConstraintTerm, "a ConstraintTerm"))
    return tuple(terms)


def _check_bounds(all_bounds: Sequence[Mapping[int, tuple[Side, Side]]], dynamics: Dynamics, knots: int) -> None:
    """Raises InputError if a bound does not have a number for each knot, or those of a state leave nothing between."""
    names = dynamics.state_coordinates.names
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


class PlainTerm:
    """A cost or constraint term in plain Python, at points z = (x, u): for checks of derivatives, and of runs."""

    def __init__(self, term: CostTerm | ConstraintTerm, states: int, controls: int) -> None:
        self.shared = term.shared if isinstance(term, ConstraintTerm) else 0
        self.states, self.size = states, states + controls
        named = term.functions[0].parameters if term.functions else ()
        parameters = dict(zip(named, term.data.tolist(), strict=False))
        wanted = [name for name in ("derivatives", "value", "slope", "places_jacobian") if term.code.has(name)]
        sizes, calls = {"N": states, "M": controls}, [function.plain_call(parameters) for function in term.functions]
        self._functions = plain_functions(term.code, sizes, wanted, calls)
        places = [address_of(function) if function.is_memory else float(i) for i, function in enumerate(term.functions)]
        self._data = np.concatenate([places, term.data])

    def cost(self, z: Array) -> tuple[float, Array, Array]:
        """The cost, its gradient (n+m,) and its Hessian (n+m, n+m), before any projection."""
        x, u = z[: self.states], z[self.states :]
        gradient, hessian = np.zeros(self.size), np.zeros((self.size, self.size))
        return float(self._functions["derivatives"](x, u, 1, self._data, hessian, gradient)), gradient, hessian

    def value(self, z: Array, row: int, knot: int = 1) -> float:
        """One row of the constraint at a knot."""
        return float(self._functions["value"](*self._point(z), knot, row, self._data))

    def slope(self, z: Array, row: int) -> Array:
        """The gradient (n+m,) of one row of the constraint."""
        gradient = np.zeros(self.size)
        self._functions["slope"](*self._point(z), 1, row, self._data, gradient)
        return gradient

    def _point(self, z: Array) -> tuple[Array, Array]:
        """State and control; or, in their place, the values that all rows share and their derivatives."""
        x, u = z[: self.states], z[self.states :]
        if not self.shared:
            return x, u
        at, moves = np.zeros(self.shared), np.zeros((self.shared, self.states))
        self._functions["places_jacobian"](x, self._data, at, moves)
        return at, moves


def violated(
    term: ConstraintTerm, states: Array, controls: Array, counts: npt.NDArray[np.bool_], tolerance: float
) -> Iterator[tuple[Array, npt.NDArray[np.intp]]]:
    """The largest violation (K,) of each run and its knot (K,), zeros for a run without one, row by row.

    Args:
      states: (K, T+1, n). controls: (K, T, m). counts: (K, T+1), whether a knot counts.
    """
    steps, (n, m) = controls.shape[1], (states.shape[2], controls.shape[2])
    plain = PlainTerm(term, n, m)
    knots = range(steps) if term.uses_control else range(steps if term.final_only else 1, steps + 1)
    for row in range(term.rows):
        largest, when = np.zeros(len(states)), np.zeros(len(states), dtype=np.intp)
        for k, knot in zip(*np.nonzero(counts[:, knots.start : knots.stop]), strict=True):
            t = int(knot) + knots.start
            value = plain.value(np.concatenate([states[k, t], controls[k, min(t, steps - 1)]]), row, t)
            missed = abs(value) if term.equality else -value
            if missed > max(tolerance, largest[k]):
                largest[k], when[k] = missed, t
        yield largest, when


def by_name(
    who: str, values: object, named: Mapping[str, Any], each: str, check: Callable[[str, Any], _Value]
) -> dict[str, _Value]:
    """The values given for states by name, in a dictionary or by keyword."""
    want = f"{each} by name of a state, as {who}(x=...) or {who}({{'x': ...}})"
    check_kind(who, values, (Mapping, type(None)), want)
    stated = dict(values or {})  # pyright: ignore[reportCallIssue, reportArgumentType]
    check_items(who, tuple(stated), str, want)
    for name in stated.keys() & named.keys():
        raise InputError(f"{who}: got {excerpt(name)} twice, want each state once")
    if not stated and not named:
        raise InputError(f"{who}: got nothing, want {want}")
    return {name: check(f"{who}: {excerpt(name)}", value) for name, value in {**stated, **named}.items()}

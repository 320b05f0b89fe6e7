"""Bounds and goals of states, and soft limits: classes and kernels."""

import copy
from collections.abc import Callable, Mapping, Sequence, Set
from math import floor, inf
from typing import Any, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import NonNegative, checked
from lqrsim.codegen.sources import source_of
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_items,
    check_kind,
    check_name,
    check_number,
    excerpt,
    numbers_of,
)
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import Constraint, ConstraintTerm, Cost, CostTerm, Side

Bounds = tuple[npt.ArrayLike, npt.ArrayLike]  # low and high, as given
_Value = TypeVar("_Value")


class GoalState(Constraint):
    """The final state equals a goal: `x_T = goal`. A final cost only draws the state to it.

        ls.GoalState(x=1.0, velocity=0.0)

    Args:
      goal: (n,) the state, in the states' units; or a dictionary of name or unit: number, for some of the states, such
        as {"m/s": 0} for all velocities.
      count_turns: whether 2 pi and 0 are different goals. By default, the states that the dynamics declare as angles
        reach their goals up to whole turns, and a search over starts may choose any of them. A QuadraticCost about a
        goal counts them.
    """

    @checked
    def __init__(
        self, goal: npt.ArrayLike | Mapping[str, float] | None = None, /, *, count_turns: bool = False, **named: float
    ) -> None:
        self.count_turns = count_turns
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
            per_state = f"one for each of {', '.join(names)}"
            raise InputError(f"GoalState: goal: got {len(goal)} numbers, want {len(names)}, {per_state}")
        return dict(enumerate(goal.tolist()))

    def _turning_states(self, dynamics: Dynamics) -> Set[int]:
        angles = () if self.count_turns else dynamics.state_coordinates.angles
        return self.final_states(dynamics).keys() & angles

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        names, units = dynamics.state_coordinates.names, dynamics.state_coordinates.units
        turning = self._turning_states(dynamics)
        rows = list(self.final_states(dynamics).items())
        described = [f"the goal of {_quantity(number, units[i])} for {names[i]}" for i, number in rows]
        table = [(i, 1.0, np.inf, 2 * np.pi if i in turning else 0.0, np.array([number])) for i, number in rows]
        return ConstraintTerm(
            source_of(__name__), _bound_data(table), len(rows), described.__getitem__, equality=True, final_only=True,
            names=tuple(names[i] for i, _ in rows),
        )  # fmt: skip

    def with_added_state(self, dynamics: Dynamics) -> "GoalState":
        names = dynamics.state_coordinates.names  # numbers by unit would also apply to the added state
        goal = {names[i]: number for i, number in self.final_states(dynamics).items()}
        return GoalState(goal, count_turns=self.count_turns)


class StateBounds(Constraint):
    """Bounds on states, `low <= x_t <= high`, at each step except a start that is given exactly.

        ls.StateBounds(height=(0.1, 2.0), velocity=(-np.inf, 1.5))
        ls.StateBounds(height=(lows, 2.0))  # a lower bound for each knot

    At the end, the bounds do not act on a state that a GoalState fixes. A goal may therefore lie on a bound.

    Either bound may have one number for each of the T+1 knots, such as that of a waypoint, or of a gate that is open
    for a while. Numbers of knots move with time as the rows of a `QuadraticCost` do.

    Args:
      bounds: a dictionary of name or unit of a state: (low, high), in its unit, each a number or (T+1,) numbers. An
        infinite number means no bound. A name takes precedence over a unit.
    """

    def __init__(self, bounds: Mapping[str, Bounds] | None = None, /, **named: Bounds) -> None:
        self.bounds = by_name("StateBounds", bounds, named, "(low, high)", _bound)

    @property
    def by_knot(self) -> bool:
        return any(isinstance(side, np.ndarray) for sides in self.bounds.values() for side in sides)

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        def later(side: Side) -> Side:
            return select(side) if isinstance(side, np.ndarray) else side

        other = copy.copy(self)
        other.bounds = {name: (later(low), later(high)) for name, (low, high) in self.bounds.items()}
        return other

    def state_bounds(self, dynamics: Dynamics) -> Mapping[int, tuple[Side, Side]]:
        space = dynamics.state_coordinates
        return space._by_name("StateBounds: states", self.bounds, lambda _, sides: cast(tuple[Side, Side], sides))

    def with_added_state(self, dynamics: Dynamics) -> "StateBounds":
        names = dynamics.state_coordinates.names  # as for a GoalState
        return StateBounds({names[i]: sides for i, sides in self.state_bounds(dynamics).items()})

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.zeros(1), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        names, units = dynamics.state_coordinates.names, dynamics.state_coordinates.units
        rows, described, named = [], [], []
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
                rows.append((i, sign, len(times) - 2 if i in goals else np.inf, 0.0, numbers))
                described.append(wanted)
                named.append(f"{name} {('low', 'high')[side]}")
        kernel, data, describe = source_of(__name__), _bound_data(rows), described.__getitem__
        return ConstraintTerm(kernel, data, len(rows), describe, convex=True, names=tuple(named))


class LimitCost(Cost):
    """`1/2 weight depth^2` for each state, by name, that is past a bound by some depth: a soft limit."""

    _same_with_added_state = True

    @checked
    def __init__(
        self, low: Mapping[str, float] | None = None, high: Mapping[str, float] | None = None, *, weight: NonNegative
    ) -> None:
        self.weight = weight
        bounds = [(1.0, *item) for item in (low or {}).items()] + [(-1.0, *item) for item in (high or {}).items()]
        self.bounds = [(name, sign, check_number(f"LimitCost: bound of {name}", bound)) for sign, name, bound in bounds]

    def bind(self, dynamics: Dynamics) -> CostTerm:
        names = dynamics.state_coordinates.names
        rows = [
            [names.index(check_name("LimitCost: state", name, names)), sign, bound, self.weight]
            for name, sign, bound in self.bounds
        ]
        numbers = np.array([len(rows), *np.ravel(rows)], dtype=np.float64)
        kernels = source_of(__name__)
        soft = kernels.filled(value=(kernels, "soft"), derivatives=(kernels, "soft_derivatives"))
        return CostTerm(soft, numbers, exact_hessian=False)


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


def _bound(field: str, bound: object) -> tuple[Side, Side]:
    """(low, high), each a number or numbers (K,), at least one of them finite."""
    want = "(low, high), each a number or one for each knot; infinite for no bound"
    sides = check_items(field, bound, object, want)
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
        got = f"{lows[at]:g} to {highs[at]:g}{knot}"
        raise InputError(f"{field}: got {got}, want low below high, and one of them finite")
    return low, high


def _side(field: str, bound: object) -> Side:
    """A bound, or one for each knot."""
    numbers = numbers_of(field, bound, "a number, or one for each knot")
    numbers = check_array(field, numbers, (None,) if numbers.ndim else (), infinite=True)
    if not numbers.size:
        raise InputError(f"{field}: got no numbers, want one, or one for each knot")
    return numbers if numbers.ndim else numbers.item()


def _bound_data(rows: Sequence[tuple[int, float, float, float, Array]]) -> Array:
    """The numbers of the kernel: of each row the state, the sign, the last step, the period, and one bound or K."""
    knots = max(len(bounds) for *_, bounds in rows)
    table = [[*numbers, *np.broadcast_to(bounds, knots)] for *numbers, bounds in rows]
    return np.concatenate([[knots], np.ravel(table)])


def _quantity(number: float, unit: str) -> str:
    return f"{number:g} {unit}".rstrip()


def _quantities(numbers: Array, unit: str) -> str:
    """The least and the greatest number, or the common value."""
    low, high = numbers.min(), numbers.max()
    return _quantity(low, unit) if low == high else f"{low:g} to {_quantity(high, unit)}"


# The kernel of GoalState and StateBounds: the distance of a state to a bound, positive on the feasible side. `data` has
# the number of knots K with a bound of their own, and then for each row the index of the state, 1 for a lower or -1 for
# an upper bound, the last step at which it holds, the period by which the distance is wrapped, 0 for none, and K
# bounds, infinite at knots without one. The last bound holds from its knot on.
INDEX, SIGN, LAST, PERIOD, BOUNDS = 0, 1, 2, 3, 4


def value(x, u, t, row, data):
    """The distance; infinite after the last step, and where there is no bound."""
    first = row_at(row, data)
    if t > data[first + LAST]:
        return inf
    distance = x[int(data[first + INDEX])] - data[first + BOUNDS + min(t, int(data[0]) - 1)]
    period = data[first + PERIOD]
    if period > 0:
        distance -= period * floor(distance / period + 0.5)
    return data[first + SIGN] * distance


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    first = row_at(row, data)
    gradient[int(data[first + INDEX])] += data[first + SIGN]


def row_at(row, data):
    """The index at which the numbers of a row begin."""
    return 1 + row * (BOUNDS + int(data[0]))


# The kernel of a LimitCost. `data` has the number of bounds, and for each bound: the index of the state, 1 for a lower
# bound or -1 for an upper one, the bound, and the weight.


def soft(x, u, t, data):
    """The cost."""
    total = 0.0
    for row in range(int(data[0])):
        depth = data[4 * row + 2] * (data[4 * row + 3] - x[int(data[4 * row + 1])])
        if depth > 0:
            total += 0.5 * data[4 * row + 4] * depth * depth
    return total


def soft_derivatives(x, u, t, data, hessian, gradient):
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

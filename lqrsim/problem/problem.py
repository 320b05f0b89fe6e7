"""The optimal control problem of Eqs. (1)-(2), in discrete time."""

import copy
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Count, Finite, NonNegative, Positive, Want, checked
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.user_functions import address_of
from lqrsim.errors import (
    Array,
    InputError,
    brief,
    check_array,
    check_count,
    check_kind,
    check_memory,
    check_name,
    check_number,
    keep,
    renamed,
    shaped,
)
from lqrsim.problem.control_rate import ControlRate, RateLimits
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.noise import Noise, NoiseTerm
from lqrsim.problem.obstacles import KeepsClear
from lqrsim.problem.parts import (
    EQUALITY_TOLERANCE,
    Constraint,
    ConstraintTerm,
    Cost,
    CostSum,
    CostTerm,
    check_bounds,
    goals_of,
    names_of,
    terms_for,
    terms_of,
)
from lqrsim.problem.quadratic_cost import QuadraticCost, about_state, references_of
from lqrsim.problem.state_bounds import by_name
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, Limits, PerEntry
from lqrsim.results.pickles import OneVersion
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory

ACCURATE = 1e-11  # smallest accuracy of steps; errors below are rounding
SHORTEST = 1e-3  # of a free duration whose least has passed, relative to the longest that is left
Constraints = Annotated[
    Sequence[Constraint],
    Want("a list of constraints, such as [Clearance(...)] or, for a function, [SymbolicConstraint(function)]"),
]


@dataclass(frozen=True, init=False, eq=False)
class FixedState:
    """An initial state that is given exactly, in place of an initial cost.

        ls.FixedState(x=1.0, heading=np.pi)

    Args:
      state: (n,) in the states' units, or a dictionary of name or unit: number; states without a number are 0. The
        numbers may be by name until a Problem has the state.
    """

    state: PerEntry
    _must_be_clear: ClassVar[bool] = True  # as of an initial cost

    def __init__(self, state: PerEntry | None = None, /, **named: float) -> None:
        if not named and (state is None or (isinstance(state, Mapping) and not state)):
            want = "one at least, as FixedState(x=0.0), or one per state, as FixedState([0.0, 0.0])"
            raise InputError(f"FixedState: got no numbers, want {want}")
        if state is None or named or isinstance(state, Mapping):
            numbers = by_name("FixedState", state, named, "a number", check_number)
        else:
            numbers = check_array("FixedState: state", state, (None,))
            if not len(numbers):
                raise InputError("FixedState: state: got no numbers, want one per state")
        keep(self, state=numbers)

    def __repr__(self) -> str:
        return f"FixedState({brief(self.state)})"

    @property
    def numbers(self) -> Array:
        """The state (n,). Numbers by name are in no order before a Problem has it."""
        if isinstance(self.state, Mapping):
            raise InputError("FixedState: got numbers by name, want the state from a Problem: problem.initial")
        return np.asarray(self.state)

    @property
    def _cost(self) -> QuadraticCost:
        """A zero cost, with which fixed and soft starts share compiled code."""
        return QuadraticCost(np.zeros(len(self.numbers)), about=self.numbers)

    def _extended(self, numbers: npt.ArrayLike) -> "FixedState":
        other = FixedState(np.append(self.numbers, numbers))
        keep(other, _must_be_clear=self._must_be_clear)
        return other

    def _in(self, dynamics: Dynamics) -> "FixedState":
        """The state with numbers by name in the order of a system. Raises InputError if it does not fit."""
        space = dynamics.state_coordinates
        if isinstance(self.state, Mapping):
            return FixedState(space._numbers("FixedState", self.state))
        check_array("initial: FixedState", self.state, (len(space),))
        return self


def _anywhere(start: Any) -> Any:
    """A start that may be inside an obstacle."""
    start = copy.copy(start)
    keep(start, _must_be_clear=False)
    return start


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Problem(OneVersion):
    """Minimise `c_0(x_0) + sum_t c(x_t, u_t, t) + c_T(x_T)` subject to `x_{t+1} = g(x_t, u_t)`.

    Attributes:
      dynamics: g is their Runge-Kutta step over `dt` seconds, the control period, with the control held.
      steps: T, the number of control periods.
      initial: c_0, the cost of starting elsewhere than desired (the paper's soft start); or `FixedState(x)`.
      stage_cost: c, per step: it is *not* multiplied by dt. A QuadraticCost or ControlCost may follow a reference.
      final_cost: c_T.
      control_limits: (lowest, highest) control, each a number or (m,), or a dictionary of name or unit of a control:
        (lowest, highest); by default the actuators' range. Infinite limits mean that the plan has none. Plan and policy
        respect these limits exactly; the policy also respects those of the actuators.
      control_rate: the cost and the limits of the rates of controls, see `ControlRate`; None for neither. A plan keeps
        the limits, and the cost of a solution includes that of rates; costs of runs do not. The policy is a function of
        the state alone; `lq.rate_feedback` makes the best feedback, which also depends on the last command. Feedback
        adds to the rates of the plan: a `Replanner` clips its commands to the limits, other controllers do not, and
        `violations` says by how much they exceed them.
      constraints: conditions on the plan at the knots: `SymbolicConstraint`, `GoalState`, `StateBounds`, `Clearance`.
      begin: time in s of the first knot. The positions of moving obstacles are those at time 0.
      noise: process noise: x_{t+1} = g(x_t, u_t) + M(x_t, u_t) w_t. The cost is then an expectation, to second order
        about the plan. None for a problem without noise.
      risk: theta, in 1/cost: with noise, minimise (1/theta) log E exp(theta cost) in place of E cost. Above 0 it is
        risk-averse, below 0 risk-seeking; 0 is the expectation.
      duration: (shortest, longest) in s, for a free final time. A solve begins with `dt` and `steps`; the solution has
        as many steps, and its own dt. The stage cost still counts once per step. None for steps * dt.
      time_weight: cost per second of a free duration. The cost of a solution does not include it.
      segments: knots that divide a plan into segments, such as those of waypoints. With a free duration, that of each
        segment is free, too: whatever has numbers by knot moves with these knots. The steps of a solution are equally
        long; `with_duration_of` has its knots. The steps of each segment last as those of a plan between the shortest
        and the longest duration.
      accuracy: largest error of a plan's steps, as `BetweenKnots.step_error`: `smooth` then takes as many Runge-Kutta
        steps in a period as that needs. By default it takes one.
      between_knots: whether inequalities are to hold between the knots, too; by default they hold at the knots. The
        dynamics must be a formula, and obstacles stand still. Re-plans keep them at the knots.
      constraint_terms, noise_term: constraints and noise, bound to the dynamics.
      control_coordinates: names, units and limits of the controls, as used for planning.
      applied_coordinates: the same, with limits narrowed to the actuators', as a policy respects them.
    """

    _prefix = ""
    _want = "a Problem, such as scenario.problem"

    dynamics: Dynamics
    dt: Positive
    steps: Count
    initial: Cost | FixedState
    stage_cost: Cost
    final_cost: Cost
    control_limits: Limits | None = None
    constraints: Constraints = ()
    begin: Finite = 0.0
    noise: Noise | None = None
    risk: Finite = 0.0
    duration: tuple[float, float] | None = None
    time_weight: NonNegative = 0.0
    segments: Annotated[Sequence[int], Want("knots, which are whole numbers")] = ()
    control_rate: ControlRate | None = None
    accuracy: Annotated[float, Bounds(at_least=ACCURATE)] | None = None
    between_knots: bool = False
    _terms: dict[str, tuple[CostTerm, ...]] = field(init=False, repr=False, compare=False)
    constraint_terms: tuple[ConstraintTerm, ...] = field(init=False, repr=False, compare=False)
    noise_term: NoiseTerm | None = field(init=False, repr=False, compare=False)
    control_coordinates: Coordinates = field(init=False, repr=False, compare=False)
    applied_coordinates: Coordinates = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.dynamics.check_period(self.dt)
        check_memory("steps", self.steps, self.bytes_per_step)
        keep(self, _terms={}, noise_term=None if self.noise is None else self.noise.bind(self.dynamics))
        parts = "stage_cost", "final_cost", "initial", "constraints"
        keep(self, **self._bound(**{name: getattr(self, name) for name in parts}))
        self._checked_parts()
        if self.risk and self.noise is None:
            raise InputError(f"risk: got {self.risk:g} for a problem without noise, want noise=Noise(...), or 0")
        if self.control_rate is not None:
            others = {"noise": self.noise, "a free duration": self.duration, "accuracy": self.accuracy}
            for feature, stated in (others | {"between_knots": self.between_knots or None}).items():
                if stated is not None:
                    raise InputError(f"control_rate: got {self.control_rate!r} with {feature}, want one of the two")
            keep(self, control_rate=self.control_rate._in(self.dynamics))
        limited = controls = self.dynamics.control_coordinates
        if self.control_limits is not None:
            limited = controls.limited(self.control_limits)
            sides = zip(limited.names, limited.low, limited.high, controls.low, controls.high, strict=True)
            for name, low, high, lowest, highest in sides:
                if not max(low, lowest) < min(high, highest):
                    want = f"a range that overlaps the actuator's, {lowest:g} to {highest:g}"
                    raise InputError(f"control_limits: got {low:g} to {high:g} for {name}, want {want}")
            keep(self, control_limits=(limited.low, limited.high))
        keep(self, control_coordinates=limited, applied_coordinates=limited.within(controls))
        start = self.start if self.initial._must_be_clear else None
        terms = [cost.kept_clear for cost in self.obstacle_costs]
        if start is not None and (collision := self._inside(terms, start, self.begin)) is not None:
            where, advice = collision
            raise InputError(f"initial: got a start {where}, want it clear{advice}")

    @property
    def times(self) -> Array:
        """The times of the knots, (T+1,) in s."""
        return self.begin + self.dt * np.arange(self.steps + 1)

    @property
    def moving(self) -> bool:
        """Whether the problem depends on the time at which it begins, as with obstacles that move or a reference."""
        return any(part.moving or part.by_knot for part in (self.stage_cost, *self.constraints))

    def _bound(self, constraints: Sequence[Constraint] | None = None, **costs: Cost | FixedState) -> dict[str, Any]:
        """Fields with these parts, whose numbers by name are in the order of the system, and with the terms there."""
        fields: dict[str, Any] = {"_terms": self._terms.copy()}
        for name, stated in costs.items():
            fields[name] = cost = check_kind(name, stated, (Cost, FixedState), Cost._want)._in(self.dynamics)
            parts = terms_of(cost._cost if name == "initial" and isinstance(cost, FixedState) else cost)
            for part in parts if name != "stage_cost" else ():
                if part.by_knot:
                    raise InputError(
                        f"{name}: got a {part.name} with a row for each knot, want one row, such as rows[-1]"
                    )
            fields["_terms"][name] = terms_for(self.dynamics, self.times, parts, CostTerm)
        if constraints is not None:
            fields["constraints"] = tuple(constraints)
            check_bounds(constraints, self.dynamics, self.steps + 1)
            goals = goals_of(constraints, self.dynamics)
            fields["constraint_terms"] = terms_for(self.dynamics, self.times, constraints, ConstraintTerm, goals)
        return fields

    def from_state(self, state: npt.ArrayLike, *, after: int = 0, previous: npt.ArrayLike | None = None) -> "Problem":
        """The rest of the problem after some steps, from a state (n,) that is given exactly.

        Unlike a new problem, this one may begin inside an obstacle; the plan then leads out of it. A free duration is
        shorter by these steps.

        Args:
          previous: (m,) the last command, from which a `control_rate` counts; by default the problem's own, and after
            some steps none.
        """
        after = check_count("after", after, at_least=0, at_most=self.steps - 1)
        here = check_array("state", state, (len(self.dynamics.state_coordinates),))
        start = _anywhere(FixedState(here))
        if isinstance(self.initial, FixedState):  # four times as fast as a new cost
            term = about_state(self._terms["initial"][0], here)
        else:
            term = start._cost.bind(self.dynamics)
        rate = self.control_rate
        if rate is None and previous is not None:
            raise InputError("previous: got a command for a problem without control_rate, want None")
        if rate is not None and (after or previous is not None):
            size = (len(self.dynamics.control_coordinates),)
            rate = replace(rate, previous=None if previous is None else check_array("previous", previous, size))
        other = self._with(initial=start, control_rate=rate, _terms=self._terms | {"initial": (term,)})
        if not after:
            return other
        segments = tuple(knot - after for knot in self.segments if knot > after + 1)  # each has two steps at least
        constraints, stage_cost = tuple(part.ahead(after) for part in self.constraints), self.stage_cost.ahead(after)
        rest = {"steps": self.steps - after, "begin": self.begin + after * self.dt, "segments": segments}
        if self.duration is not None:
            low, high = (seconds - after * self.dt for seconds in self.duration)
            rest["duration"] = max(low, SHORTEST * high), high
        return other._with(**rest, constraints=constraints, stage_cost=stage_cost)._bound_anew()

    def with_costs(self, *, stage_cost: Cost | None = None, final_cost: Cost | None = None) -> "Problem":
        """The problem with other costs, None for the present ones. It may begin inside an obstacle if this one does."""
        stated: dict[str, Any] = {"stage_cost": stage_cost, "final_cost": final_cost}
        changed = {name: cost for name, cost in stated.items() if cost is not None}
        return self._with(**self._bound(**changed))._checked_parts()

    def _refined(self, plan: Trajectory) -> "Problem | None":
        """The problem with constraints as they are to be along a plan that misses some within its periods, or None."""
        refined = [constraint._refined(self.dynamics, plan) for constraint in self.constraints]
        if not any(refined):
            return None
        return self.with_constraints([new or old for new, old in zip(refined, self.constraints, strict=True)])

    @checked
    def with_constraints(self, constraints: Constraints) -> "Problem":
        """The problem with other constraints. It may begin inside an obstacle if this one does; see `from_state`."""
        return self._with(**self._bound(constraints))._checked_parts()

    @checked
    def later(self, seconds: Finite) -> "Problem":
        """The same problem with a later beginning: moving obstacles are at their positions at that time, also where the
        robot starts; costs and constraints with a row for each knot begin with a later one and repeat the last.

        Args:
          seconds: the delay in seconds; with such costs or constraints, a multiple of dt.
        """
        begin = self.begin + seconds
        if not np.isfinite(begin):  # the sum of two finite numbers
            raise InputError(f"seconds: got {seconds:g} after begin, {self.begin:g}, want a finite sum")
        other = self._with(begin=begin, initial=_anywhere(self.initial))
        if any(part.by_knot for part in (self.stage_cost, *self.constraints)):
            steps = round(seconds / self.dt)
            if steps < 0 or abs(seconds - steps * self.dt) > 1e-6 * self.dt:
                want = f"a multiple of dt, {self.dt:g} s, not negative: a cost or a constraint has a row for each knot"
                raise InputError(f"seconds: got {seconds:g}, want {want}")
            later = tuple(constraint.ahead(steps, horizon="moving") for constraint in self.constraints)
            other = other._with(stage_cost=self.stage_cost.ahead(steps, horizon="moving"), constraints=later)
        return other._bound_anew() if self.moving else other

    @checked
    def with_duration_of(self, plan: Solution) -> "Problem":
        """The problem with the duration of a plan: of fixed steps, and with its segments where they are in the plan."""
        knots = plan.options.get("segments", self.segments)
        if plan.trajectory.steps != self.steps or not isinstance(knots, Sequence) or len(knots) != len(self.segments):
            got = f"{plan.trajectory.steps} steps, segments at {brief(knots)}"
            want = f"a solution of the problem: {self.steps} steps, segments at {brief(self.segments)} before the solve"
            raise InputError(f"plan: got {got}, want {want}")
        moved = self if tuple(knots) == self.segments else self._with_segments(knots)
        return moved._of_duration(plan.trajectory.horizon)

    settled = renamed("settled", "with_duration_of")

    def _of_duration(self, seconds: float) -> "Problem":
        return replace(self, dt=seconds / self.steps, duration=None, time_weight=0.0)

    def _with_segments(self, knots: Sequence[int]) -> "Problem":
        """The problem with its segments at other knots, where their rows move along; those between are the nearest."""
        old, new = (np.array([0, *interior, self.steps]) for interior in (self.segments, knots))
        rows = np.rint(np.interp(np.arange(self.steps + 1), new, old)).astype(int)
        segment = np.clip(np.searchsorted(new, np.arange(self.steps + 1), side="right") - 1, 0, len(knots))
        inside = ~np.isin(np.arange(self.steps + 1), new)
        rows[inside] = np.clip(rows, old[segment] + 1, old[segment + 1] - 1)[inside]

        def select(table: Array) -> Array:
            return table[np.minimum(rows, len(table) - 1)]

        def at_knots(part: Any) -> Any:
            return part._at_other_knots(select) if part.by_knot else part

        return replace(
            self, segments=tuple(knots), constraints=[at_knots(constraint) for constraint in self.constraints],
            stage_cost=CostSum(map(at_knots, terms_of(self.stage_cost))),
        )  # fmt: skip

    def _bound_anew(self) -> "Problem":
        """The same problem, bound anew wherever it depends on the steps or on the time at which it begins."""
        costs, terms = terms_of(self.stage_cost), list(self._terms["stage_cost"])
        for i in (i for i, cost in enumerate(costs) if cost.moving):
            (terms[i],) = terms_for(self.dynamics, self.times, costs[i : i + 1], CostTerm)
        fields = self._bound(self.constraints)
        fields["_terms"]["stage_cost"] = tuple(terms)
        return self._with(**fields)

    def _checked_parts(self) -> "Problem":
        """The same problem, whose costs or constraints must go with the rest."""
        for name in ("initial", "final_cost"):
            if any(term.uses_control for term in self._terms[name]):
                raise InputError(f"{name}: got a cost that depends on the control, want one of the state alone")
        self._check_duration()
        formula = not self.dynamics.discrete and self.dynamics.level == "symbolic"
        if self.accuracy is not None and (self.dynamics.discrete or self.dynamics.level == "jax"):
            raise InputError(f"accuracy: got {self.accuracy:g} with dynamics whose steps have no parts, want None")
        if self.between_knots and not formula:
            raise InputError("between_knots: got True with dynamics that are not a formula, want False")
        if self.between_knots and any(term.world.moving for term in self.kept_clear):
            raise InputError("between_knots: got True with obstacles that move, want False")
        return self

    def _with(self, **changed: Any) -> "Problem":
        """The problem with other parts. Nothing is checked: this runs at every solve of a re-planning robot."""
        other = copy.copy(self)
        keep(other, **changed)
        return other

    @property
    def bytes_per_step(self) -> int:
        """The least memory in bytes of a solver for a step, from one start: value functions, laws and trajectories."""
        n, m = len(self.dynamics.state_coordinates), len(self.dynamics.control_coordinates)
        return 8 * (3 * n * n + 3 * m * n + 10 * n + 7 * m)

    @property
    def start(self) -> Array | None:
        """The state (n,) that the initial cost or FixedState specifies; None if neither does."""
        if isinstance(self.initial, FixedState):
            return self.initial.numbers
        reference = self._only_reference(self.initial)
        return None if reference is None else reference.about

    @property
    def _start_or_zero(self) -> Array:
        """A copy of the start, (n,), at which a solve without one begins at zero."""
        return np.zeros(len(self.dynamics.state_coordinates)) if self.start is None else self.start.copy()

    @property
    def goal(self) -> Array | None:
        """The state (n,) that the final cost and GoalStates specify; None if none of them does."""
        reference = self._only_reference(self.final_cost)
        goal = self._with_goal_states(np.nan if reference is None else reference.about)
        return None if np.isnan(goal).any() else goal

    @property
    def weighed_goal(self) -> Array | None:
        """The goal, with NaN for states that have neither a weight nor a GoalState; None if all of it is NaN."""
        reference = self._only_reference(self.final_cost)
        weighed = np.nan if reference is None else np.where(reference.weight.any(axis=1), reference.about, np.nan)
        goal = self._with_goal_states(weighed)
        return None if np.isnan(goal).all() else goal

    def _only_reference(self, cost: Cost) -> QuadraticCost | None:
        """The reference of the only term of a cost that has one; None if none has, or several."""
        references = references_of(cost, self.dynamics)
        return references[0][1] if len(references) == 1 else None

    def _with_goal_states(self, numbers: float | Array) -> Array:
        """These numbers as a state (n,), with those of GoalStates in their place."""
        goal = np.full(len(self.dynamics.state_coordinates), numbers)
        for i, number in goals_of(self.constraints, self.dynamics).items():
            goal[i] = number
        return goal

    @property
    def nominal_control(self) -> Array:
        """u*, (m,), at which the sum of the ControlCosts is least, or its mean over steps; zeros if there is none."""
        controls = self.nominal_controls
        return controls if controls.ndim == 1 else controls.mean(axis=0)

    @property
    def nominal_controls(self) -> Array:
        """u*, (m,); or (T, m) if the control cost has one for each step."""
        costs = [reference for cost in terms_of(self.stage_cost) if (reference := cost.control_reference) is not None]
        if not costs:
            return np.zeros(len(self.dynamics.control_coordinates))
        if len(costs) == 1:
            about = costs[0].about
            return about if about.ndim == 1 else about[: self.steps]
        weights = [cost.weight if cost.weight.ndim == 2 else cost.weight[: self.steps] for cost in costs]
        abouts = [cost.about if cost.about.ndim == 1 else cost.about[: self.steps] for cost in costs]
        weighted = sum(weight @ about[..., None] for weight, about in zip(weights, abouts, strict=True))
        return np.linalg.solve(sum(weights), weighted)[..., 0]

    @property
    def obstacle_costs(self) -> tuple[Any, ...]:
        """The stage costs that keep the robot clear of obstacles: each an `ObstacleCost`, or of a user's own kind."""
        return tuple(cost for cost in terms_of(self.stage_cost) if cost.kept_clear is not None)

    @property
    def kept_clear(self) -> tuple[KeepsClear, ...]:
        """The costs and constraints that keep the robot clear of obstacles."""
        parts = *terms_of(self.stage_cost), *self.constraints
        return tuple(term for part in parts if (term := part.kept_clear) is not None)

    def terms(self, which: str) -> tuple[CostTerm, ...]:
        """The bound terms of "initial", "stage_cost" or "final_cost"."""
        return self._terms[check_name("which", which, self._terms)]

    def driven_by(self, noise: Noise | None, risk: float | None) -> "Problem":
        """The same problem under other noise or with another risk, in units of 1/cost; None keeps the problem's own."""
        changed = {name: value for name, value in (("noise", noise), ("risk", risk)) if value is not None}
        return replace(self, **changed) if changed else self

    def __str__(self) -> str:
        lines = self.parts | {"constraints": "\n               ".join(map(repr, self.constraints))}
        return "\n".join(f"{name + ':':14s} {text}" for name, text in lines.items() if text)

    @property
    def parts(self) -> dict[str, str]:
        """What is asked for, by part, as `print(problem)` says it; empty for what is not."""
        space, controls = self.dynamics.state_coordinates, self.control_coordinates
        low, high = (self.steps * self.dt,) * 2 if self.duration is None else self.duration
        seconds = f"{low:g} s" if low == high else f"{low:g} to {high:g} s"
        sides = zip(controls.names, controls.low, controls.high, strict=True)
        limited = [f"{name} {low:g} to {high:g}" for name, low, high in sides if np.isfinite([low, high]).any()]
        return {
            "dynamics": f"{self.dynamics.name}; {self.steps} steps of {self.dt:.6g} s, {seconds} in all",
            "states": ", ".join(space.labels), "controls": ", ".join(controls.labels), "limits": ", ".join(limited),
            "start": repr(self.initial), "stage cost": repr(self.stage_cost), "final cost": repr(self.final_cost),
            "control rate": "" if self.control_rate is None else repr(self.control_rate),
            "constraints": "; ".join(map(repr, self.constraints)),
            "noise": "" if self.noise is None else f"{self.noise!r}, risk {self.risk:g}",
            "cost of time": f"{self.time_weight:g} a second" if self.time_weight else "",
            "segments": f"end at knots {', '.join(map(str, self.segments))}" if self.segments else "",
        }  # fmt: skip

    @property
    def digest(self) -> str:
        """Hash of everything that defines the problem: structure and numbers."""
        space = self.dynamics.state_coordinates
        parts: list[str | Array] = [self.dynamics.step_source.digest, f" {self.dt!r} {self.steps}"]
        parts += [repr(self.dynamics.parameters), repr((self.control_coordinates.low, self.control_coordinates.high))]
        # What wraps, where the robot is, and what actuators can do: starts, errors and policies depend on them.
        parts += [f"{space.rules} {space.position} {space.plane} {space.offset}"]
        parts += [self.dynamics.control_coordinates.rules]
        if self.dynamics.model_digest:
            parts.append(self.dynamics.model_digest)
        functions = [*self.dynamics.functions]
        if isinstance(self.initial, FixedState):
            parts.append(self.initial.numbers)
        for name, terms in (*self._terms.items(), ("constraints", self.constraint_terms)):
            parts.append(f"{name} {len(terms)}")  # the same terms may be of another part
            for term in terms:
                parts += term.digested
                functions += term.functions
        if self.noise_term is not None:
            parts += [*self.noise_term.digested, repr(self.risk)]
            functions += self.noise_term.functions
        if self.duration is not None:
            parts.append(repr((self.duration, self.time_weight, *((self.segments,) if self.segments else ()))))
        if (rate := self.control_rate) is not None:
            parts.append(repr([None if entry is None else np.asarray(entry).tolist() for entry in vars(rate).values()]))
        if self.accuracy is not None or self.between_knots:
            parts.append(repr((self.accuracy, self.between_knots)))
        return sha256(*parts, "\n".join(function.identity for function in functions))[:16]

    def _check_duration(self) -> None:
        knots = self.segments
        if any(late - early < 2 for early, late in itertools.pairwise((0, *knots, self.steps)) if knots):
            want = f"knots in order, with 2 steps in each segment of the {self.steps} at least"
            raise InputError(f"segments: got {brief(self.segments)}, want {want}")
        if self.segments and self.duration is not None and (self.accuracy is not None or self.between_knots):
            want = "one of the two; those for problem.with_duration_of(solution)"
            raise InputError(f"segments: got {brief(self.segments)} with accuracy or between_knots, want {want}")
        if self.duration is None:
            if self.time_weight:
                raise InputError(f"time_weight: got {self.time_weight:g} without a duration, want duration=(low, high)")
            return
        low, high = check_array("duration", self.duration, (2,)).tolist()
        stated = self.steps * self.dt
        spare = 1e-9 * stated  # rounding: 3 * 0.1 is more than 0.3
        if not 0 < low < high or not low - spare <= stated <= high + spare:
            want = f"two times above 0 with steps * dt, {stated:g} s, between"
            raise InputError(f"duration: got {low:g} to {high:g} s, want {want}")
        keep(self, duration=(low, high))
        others = {
            "dynamics that are not a formula of rates": self.dynamics.discrete or self.dynamics.level != "symbolic",
            "noise": self.noise is not None, "obstacles that move": any(term.world.moving for term in self.kept_clear),
        }  # fmt: skip
        if why := next((why for why, stated in others.items() if stated), ""):
            raise InputError(f"duration: got {low:g} to {high:g} s with {why}, want None, or a problem without them")

    @checked
    def site_errors(self, states: Annotated[Array, "K n"]) -> dict[str, Array]:
        """How far sites are from where SiteCosts of the final cost and SiteConstraints want them.

        Neither the goal line of a Solution nor a run's outcome counts this.

            problem.site_errors(rollout.states[:, -1])  # of the last state of each trial

        Returns:
          Name of the site -> (K,), its distance from the position in metres; with " turned", its angle from the
          orientation in rad. NaN for states that are not finite. " (2)" follows the name for a second place, and so on.
        """
        states, errors = shaped("states", states, (None, len(self.dynamics.state_coordinates))), dict[str, Array]()
        for part in (*terms_of(self.final_cost), *self.constraints):
            for name, error in part.off_place(self.dynamics, states).items():
                errors[_numbered(name, errors)] = error
        return errors

    @checked
    def violations(self, rollout: Rollout) -> dict[str, Array]:
        """By how much K runs of a plan violate each constraint, other than clearances, which a `Rollout` has itself.

        A run's outcome does not count them: a run that reached its goal may have violated any of them.

        Returns:
          Name -> (K, 2): the largest violation of each trial, in the constraint's unit, and its time in seconds; zeros
          for a trial that violates it by at most 1e-6. Names do not depend on the runs or on the constraints' numbers:
          "StateBounds: x low", "GoalState: x", "ControlRate: torque high" of the commands, "SymbolicConstraint: NAME",
          its `name` or that of its function (of a lambda its expressions), with "[0]" for the first of several entries.
          " (2)" follows a name that an earlier constraint has, and so on.
        """
        sizes = len(self.dynamics.state_coordinates), len(self.dynamics.control_coordinates), self.steps
        rollout_sizes = rollout.states.shape[2], rollout.applied.shape[2], rollout.plan.steps
        if rollout_sizes != sizes:
            got, want = ("{} states, {} controls, {} steps".format(*counts) for counts in (rollout_sizes, sizes))
            raise InputError(f"rollout: got {got}, want the problem's: {want}")
        worsts: dict[str, Array] = {}
        stated, pairs = [], zip(self.constraints, self.constraint_terms, strict=True)
        for constraint, term in pairs:
            if constraint.kept_clear is None:
                stated.append((rollout.states, rollout.applied, term, names_of(constraint, term)))
        if self.control_rate is not None and self.control_rate.limits is not None:
            last = np.pad(rollout.commanded, [(0, 0), (1, 0), (0, 0)])  # of the first step the term knows it itself
            term = RateLimits(self.control_rate, self.dt).bind(self.dynamics)
            wide = np.concatenate([rollout.states, last], axis=2)
            stated.append((wide, rollout.commanded, term, [f"ControlRate: {name}" for name in term.names]))
        for states, controls, term, names in stated:
            of_term: dict[str, Array] = {}
            rows = _violated(term, states, controls, rollout.counts)
            for name, (by, knots) in zip(names, rows, strict=True):
                worst = np.stack([by, rollout.times[knots]], axis=1)
                before = of_term.get(name, worst)
                of_term[name] = np.where(by[:, None] > before[:, :1], worst, before)
            for name, worst in of_term.items():
                worsts[_numbered(name, worsts)] = worst
        return worsts

    @property
    def goal_inside(self) -> str:
        """The position of a goal that is inside an obstacle of a cost or a Clearance, as text; else empty."""
        goal, end = self.weighed_goal, self.begin + self.steps * self.dt
        collision = None if goal is None else self._inside(self.kept_clear, goal, end)
        return "" if collision is None else collision[0]

    def _inside(self, terms: Sequence[KeepsClear], state: Array, time: float) -> tuple[str, str] | None:
        """The place and the remedy if a state, which may have NaNs, is inside an obstacle; else None."""
        collisions = (term.in_world(self.dynamics, time).inside(state) for term in terms)
        return next((collision for collision in collisions if collision is not None), None)


class PlainTerm:
    """A cost or constraint term in plain Python, at points z = (x, u): for checks of derivatives, and of runs."""

    def __init__(self, term: CostTerm | ConstraintTerm, states: int, controls: int) -> None:
        self.shared = term.shared if isinstance(term, ConstraintTerm) else 0
        self.states, self.size = states, states + controls
        named = term.functions[0].parameters if term.functions else ()
        parameters = dict(zip(named, term.data.tolist(), strict=False))
        wanted = [name for name in ("derivatives", "value", "slope", "shared_jacobian") if term.code.has(name)]
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
        self._functions["shared_jacobian"](x, self._data, at, moves)
        return at, moves


def _violated(
    term: ConstraintTerm, states: Array, controls: Array, counts: npt.NDArray[np.bool_]
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
            if missed > max(EQUALITY_TOLERANCE, largest[k]):
                largest[k], when[k] = missed, t
        yield largest, when


def _numbered(name: str, taken: Collection[str]) -> str:
    """The name; if it is taken, with " (2)" after it, and so on."""
    numbered = (f"{name} ({number})" for number in itertools.count(2))
    return next(each for each in itertools.chain([name], numbered) if each not in taken)

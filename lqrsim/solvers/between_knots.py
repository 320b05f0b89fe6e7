"""What a plan does between its knots, and plans that are right there, too.

`Problem(accuracy=, between_knots=True)` is solved in rounds. Each looks at the last plan in continuous time, takes more
Runge-Kutta steps in a period where these are not accurate enough, and adds rows within the periods in which an
inequality is violated. Where it is still violated between these, they get a margin. The next plan begins from the last.

The state within a period is the dynamics' from the state and the control of the period, so that a row there is one of
both, as any other; its kernel is below.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import Self

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels.declarations import (
    FIRST,
    M,
    N,
    W,
    constraint_slope,
    constraint_value,
    shared_jacobian,
    shared_values,
    stack,
    zeros,
)
from lqrsim.kernels.records import Motion
from lqrsim.kernels.runge_kutta import advance, step_jacobian
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import Constraint, ConstraintTerm, names_of
from lqrsim.problem.problem import ACCURATE, Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import BetweenKnots, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import Stop
from lqrsim.solvers.settings import MISSED, SmootherSettings

GRID = 16  # parts of a period at whose ends inequalities are evaluated; a parabola leads to the worst time between
MOST = 1024  # largest number of Runge-Kutta steps in a period, for exact motion and for plans
ORDER = 4  # of Runge-Kutta steps: twice as many have a sixteenth of the error
KNOWN = 1e-3  # share of an error to which it is to be known
ROUNDS = 12  # plans after the first; most need two or three
MAX_FAILURES = 3  # failed plans after the first, in total, after each of which another is tried; the next is the last
MARGIN_FACTOR = 1.2  # margin added at the times of a period, relative to the violation between them
TIMES = 8  # rows in a period, at equal distances, the last at its end: a 64th of a violation between knots is left
ROUNDING = 1e-9  # violation that is not mentioned


def plan_errors(problem: Problem, plan: Trajectory) -> tuple[BetweenKnots, list[Array]]:
    """What a plan does between its knots, with a problem's inequalities; the problem's dt is the plan's.

    Also for each constraint the largest violation in each period, (T, rows), not above 0 for what is not violated, or
    does not act between the knots.
    """
    motion = Motion(in_c_order(plan.states), in_c_order(plan.controls))
    worst, times = _violations(problem, motion)
    violations: dict[str, tuple[float, float]] = {}
    pairs = zip(problem.constraints, problem.constraint_terms, strict=True)
    for k, (constraint, term) in enumerate(pairs):
        for row, name in enumerate(names_of(constraint, term)):
            t = int(np.argmax(worst[k][:, row]))
            violation = float(worst[k][t, row]), problem.dt * (t + float(times[k][t, row]))
            if violation[0] > max(ROUNDING, violations.get(name, (0.0, 0.0))[0]):
                violations[name] = violation
    return BetweenKnots(*_errors(problem, motion), violations), worst


def between_knots(problem: Problem, plan: Trajectory) -> BetweenKnots:
    """What a plan for a problem does between its knots; its duration is the plan's."""
    stated = replace(problem, dt=plan.dt, duration=None, time_weight=0.0, accuracy=None, between_knots=False)
    return plan_errors(stated, plan)[0]


def _within(problem: Problem, plan: Motion, parts: int, *, again: bool = True) -> Array:
    """The states (T, parts, n) at the ends of equal parts of each period; see `kernels/model_functions.py`."""
    steps, n = len(plan.controls), plan.states.shape[1]
    states, model = np.empty((steps * parts, n)), compiled.compile_problem(problem)
    with problem.dynamics.quiet():
        compiled.costs_module(problem).states_within(steps, parts, again, plan, model, states)
    return states.reshape(steps, parts, n)


def _errors(problem: Problem, plan: Motion) -> tuple[float, float]:
    """The largest error of a step, and that of the end: parts are halved until it is known to a thousandth."""
    if problem.dynamics.discrete:
        return 0.0, 0.0
    sizes = np.maximum(np.abs(plan.states).max(axis=0), 1.0)
    parts, exact, changed, error = 1, plan.states[1:], np.inf, 0.0
    while parts < MOST and not changed <= max(ACCURATE, KNOWN * error):
        parts, last = 2 * parts, exact
        exact = _within(problem, plan, parts)[:, -1]
        changed, error = ((np.abs(exact - ends) / sizes).max() for ends in (last, plan.states[1:]))
    end = _within(problem, plan, parts, again=False)[-1, -1]
    return float(error), float((np.abs(end - plan.states[-1]) / sizes).max())


def _violations(problem: Problem, plan: Motion) -> tuple[list[Array], list[Array]]:
    """The largest violation of each constraint's rows in each period, and after which part of it, (T, rows) each.

    A start that violates a row, and so cannot be helped, leaves out the first period.
    """
    terms = problem.constraint_terms
    within = []
    for constraint, term in zip(problem.constraints, terms, strict=True):
        obstacles = constraint.kept_clear
        # A constraint with moving obstacles, or one that changes with time otherwise than by knot, is known at the
        # knots only, so it is not checked between them.
        moving = obstacles is not None and obstacles.world.moving
        moving = moving or (constraint.moving and not constraint.by_knot)
        within.append(not (term.equality or term.final_only or moving))
    if not any(within):
        none: list[Array] = [np.zeros((problem.steps, term.rows)) for term in terms]
        return none, none
    states = _within(problem, plan, problem.dynamics._parts_of(problem.dt, GRID))
    states = np.concatenate([plan.states[:-1, None], states], axis=1)
    values = _values(problem, states, plan.controls)
    worst, times = [], []
    for checked, rows in zip(within, values, strict=True):
        missed, time = _deepest(-rows)
        missed[0, rows[0, 0] < -MISSED] = 0.0
        worst.append(missed if checked else np.zeros_like(missed))
        times.append(time)
    return worst, times


def _values(problem: Problem, states: Array, controls: Array) -> list[Array]:
    """Each constraint's rows (T, parts+1, rows) at states (T, parts+1, n), under the controls of their periods.

    Numbers that a constraint has for each knot are those at the end of the period at which it asks for less.
    """
    steps, terms = problem.steps, problem.constraint_terms
    acting = [compiled.ConstraintMultipliers(problem, term) for term in terms]
    for multipliers in acting:
        multipliers.array[FIRST] = 0.0  # a fixed start cannot change, but what follows can
    constraints = compiled.compile_problem(problem, multipliers=acting).stage.constraints
    results: list[Array] = [np.empty((steps, states.shape[1], term.rows)) for term in terms]
    for j in range(states.shape[1]):
        at_begins, at_ends = (
            np.concatenate(pair) for pair in ((states[:, j], states[-1:, j]), (states[:1, j], states[:, j]))
        )
        for at, first in ((at_begins, 0), (at_ends, 1)):
            values = tuple(np.empty_like(multipliers.values) for multipliers in acting)
            compiled.costs_module(problem).evaluate_constraints(steps, at, controls, constraints, values)
            for result, flat, constraint, term in zip(results, values, problem.constraints, terms, strict=True):
                rows = flat.reshape(steps + 1, -1)[first : first + steps]
                if not first:
                    result[:, j] = rows
                elif constraint.by_knot and not term.uses_control:
                    result[:, j] = np.maximum(result[:, j], rows)
    return results


def _deepest(missed: Array) -> tuple[Array, Array]:
    """The largest of violations (T, parts+1, rows) in each period, and where it is, (T, rows), by parabolas."""
    parts = missed.shape[1] - 1
    before, here, after = missed[:, :-2], missed[:, 1:-1], missed[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        bend, tilt = before - 2 * here + after, (after - before) / 2
        shift = -tilt / bend
        peaks = np.where((bend < 0) & (np.abs(shift) <= 1), here + tilt * shift / 2, -np.inf)
    ends = np.broadcast_to(np.arange(1, parts + 1)[None, :, None], missed[:, 1:].shape)
    times = np.concatenate([ends, ends[:, :-1] + shift], axis=1)
    violations = np.concatenate([missed[:, 1:], peaks], axis=1)
    at = violations.argmax(axis=1)[:, None]
    return np.take_along_axis(violations, at, axis=1)[:, 0], np.take_along_axis(times, at, axis=1)[:, 0] / parts


def solve_between_knots(
    problem: Problem, settings: SmootherSettings, solve: Callable[..., Solution], stop: Stop
) -> Solution:
    """Solve a problem in rounds until its plan is as it is to be between the knots.

    `solve` solves a problem that is to be right at its knots, within the time of `stop`. With a free duration, its
    search goes on from the plan `begin` from the second round on.
    """
    at_knots, tolerance = replace(problem, accuracy=None, between_knots=False), settings.method(problem).violation
    accuracy = problem.accuracy or np.inf
    rows = [
        WithinPeriods(constraint, np.zeros((problem.steps, term.rows)), np.zeros(term.rows))
        for constraint, term in zip(problem.constraints, problem.constraint_terms, strict=True)
    ]

    def stated(dt: float) -> Problem:
        """The problem with rows within its periods beside the constraints that are asked."""
        within = [added for added in rows if added.acts.any()]
        return replace(at_knots, dt=dt).with_constraints([*problem.constraints, *within])

    def again(last: Solution) -> Solution:
        begun = {} if problem.duration is None else {"begin": last}
        return solve(stated(last.trajectory.dt), replace(settings, start=last, starts=None), **begun)

    solution, rounds, failures = solve(at_knots, settings), 0, 0
    iterations, ended = solution.iterations, {}
    while solution.success or (rounds and failures < MAX_FAILURES and not stop.due):
        if not solution.success:
            failures += 1
            if solution.violation <= tolerance and failures % 2:  # it is only not at its best
                solution = again(solution)
            else:  # another way than the last plan's
                rows = [added.everywhere() for added in rows]
                solution = solve(stated(problem.dt), settings)
            rounds, iterations = rounds + 1, (*iterations, *solution.iterations)
            continue
        at_knots = replace(at_knots, dt=solution.trajectory.dt)
        errors, worst = plan_errors(at_knots, solution.trajectory)
        coarse = errors.step_error > accuracy
        missed = problem.between_knots and any((violations > tolerance).any() for violations in worst)
        if not (coarse or missed):
            break
        if rounds >= ROUNDS or stop.due:
            status, remedy = Status.STALLED, "use twice as many steps"
            if coarse:
                times = math.ceil((2 * errors.step_error / accuracy) ** (1 / ORDER))
                remedy = f"use {times} times as many steps, or a larger accuracy than {accuracy:g}"
            if stop.due:
                status, remedy = Status.TIME_LIMIT, "raise time_limit"
            wrong = errors._faults(tolerance, accuracy)
            detail = f"after {rounds + 1} plans, {'; '.join(wrong.values())}"
            ended = {"status": status, "remedy": remedy, "detail": detail}
            break
        if coarse:
            # As many Runge-Kutta steps in a period as make errors half of what is allowed.
            finer = 2 ** max(math.ceil(math.log2(2 * errors.step_error / accuracy) / ORDER), 1)
            substeps = min(at_knots.dynamics.substeps * finer, MOST)
            at_knots = replace(at_knots, dynamics=at_knots.dynamics.with_substeps(substeps))
        if missed:
            rows = [added.against(violations, tolerance) for added, violations in zip(rows, worst, strict=True)]
        solution = again(solution)
        rounds, iterations = rounds + 1, (*iterations, *solution.iterations)
    ordinary = replace(problem, dt=solution.trajectory.dt, duration=None, time_weight=0.0)
    substeps = at_knots.dynamics.substeps
    return replace(
        solution, iterations=iterations, multipliers=solution.multipliers[: len(problem.constraints)],
        options=dict(solution.options) | ({"substeps": substeps} if substeps > problem.dynamics.substeps else {}),
        problem_digest=ordinary.digest, **ended,
    )  # fmt: skip


class WithinPeriods(Constraint):
    """An inequality at `TIMES` times within some control periods; for dynamics that are a formula.

    A constraint with other numbers at each knot holds within a period as far as it holds at both ends.

    Attributes:
      acts: (K, rows) 1 for the periods in which a row acts, else 0.
      margins: (rows,) the least value of each row there.
    """

    def __init__(self, constraint: Constraint, acts: Array, margins: Array) -> None:
        self.constraint, self.acts, self.margins = constraint, acts, margins

    def everywhere(self) -> Self:
        """With the rows that act in some period acting in all."""
        return self._at_other_knots(lambda acts: np.where(acts.any(axis=0), 1.0, acts))

    def against(self, worst: Array, tolerance: float) -> Self:
        """With rows in the periods where violations (T, rows) are, and beside them, since a plan may turn up there.

        Where such rows act already, they get a margin for what is violated between them.
        """
        missed = worst > tolerance
        near = missed.copy()
        near[1:] |= missed[:-1]
        near[:-1] |= missed[1:]
        again = np.where(missed & (self.acts > 0), worst, 0.0).max(axis=0)
        margins = np.maximum(self.margins, 0.5 * tolerance) + MARGIN_FACTOR * again
        return type(self)(self.constraint, np.maximum(self.acts, near), margins)

    @property
    def by_knot(self) -> bool:
        return True

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        return type(self)(self.constraint, select(self.acts), self.margins)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return type(self)(self.constraint.with_added_state(dynamics), self.acts, self.margins)

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.arange(len(self.acts) + 1.0), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        term = self.constraint._bind_at(dynamics, times, goals)
        numbers = [times[1] - times[0], *self.acts.shape, *dynamics.data, *self.margins, *self.acts.ravel()]
        kernel = source_of(
            __name__, AT=len(term.functions) + len(term.data), PARAMETERS=len(dynamics.data), SHARED=term.shared,
            BOTH=int(self.constraint.by_knot and not term.uses_control),
        )  # fmt: skip
        filled = {"constraint_value": (term.code, "value"), "constraint_slope": (term.code, "slope")}
        filled |= {name: (dynamics.step_source, name) for name in ("advance", "step_jacobian")}
        if term.shared:
            filled |= {name: (term.code, name) for name in ("shared_values", "shared_jacobian")}
        return replace(
            term, source=kernel.filled(**filled), data=np.concatenate([term.data, numbers]), rows=TIMES * term.rows,
            describe=lambda row: f"{term.describe(row % term.rows)}, between the knots", names=TIMES * term.names,
            ranges=None if term.ranges is None else np.tile(term.ranges, TIMES),
            uses_control=True, shared=0, convex=False, linear=False,
        )  # fmt: skip


# The kernel of WithinPeriods. From AT on, `data` has the numbers below, the parameters of the dynamics, the margins,
# and which rows act in each period. There is a row for each of the constraint's at the first time, and so on.
AT = 0
# From there on: the length of a period, the number of periods, and of the constraint's rows.
LENGTH, PERIODS, ROWS, OTHERS = 0, 1, 2, 3
PARAMETERS = 0  # their number
SHARED = 0  # number of values that the constraint's rows share
BOTH = 0  # whether the constraint has other numbers at the end of the period


def value(x, u, t, row, data):
    """The constraint within the period, minus its margin; infinite where it does not act."""
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
    shared_values(z, data, shared)
    return constraint_value(shared, u, t, row, data)


def slope_at_state(z, u, t, row, data, gradient):
    """Add its gradient (W,) at a state."""
    if SHARED:
        shared, moves = stack(SHARED), zeros(SHARED, N)
        shared_jacobian(z, data, shared, moves)
        constraint_slope(shared, moves, t, row, data, gradient)
    else:
        constraint_slope(z, u, t, row, data, gradient)


def read_parameters(data, p):
    """Write the parameters of the dynamics."""
    for i in range(PARAMETERS):
        p[i] = data[AT + OTHERS + i]

"""A free final time: the duration is an additional state, constant along the plan, with a free initial value.

The number of steps is fixed and their length varies: the dynamics are scaled by duration / stated duration, so that a
Runge-Kutta step over `dt` becomes a step over `share * dt`. The interior point finds states, controls and duration at
once. With the duration found, the problem is an ordinary one, and the plan is already at its optimum.

Where segments of the plan have free durations, too, that state may jump between them. The steps of the plan that is
found last differently, segment by segment. As many equal steps take its place, with the ends of the segments at the
nearest knots, and the duration of the whole is found from there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.formulas import SymbolicConstraint, SymbolicCost
from lqrsim.problem.last_command import unused
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.solvers.budget import Budget, Callback, Laps, Stop
from lqrsim.solvers.initial_guess import InitialGuess
from lqrsim.solvers.interior_point import Found, InteriorPoint, Measures
from lqrsim.solvers.settings import SmootherSettings
from lqrsim.solvers.stages import Stages

# The added state, and the parameter to which it is relative; with underscores after them if the system has such names.
STATE, STATED = "duration", "stated_duration"
MOST = 300  # largest number of iterations
# Number of shorter durations that are tried, factor between them, and number of iterations for each.
SHORTENED, SHORTER, TRIES = 3, 0.9, 150
# Tolerance of the search for durations of segments: their ends go to whole knots, one in some hundred.
ROUGH = 1e-4
FELL = 1e-3  # relative decrease of cost, with the cost of time, for which a search that failed goes on


def solve_for_duration(
    problem: Problem, settings: SmootherSettings, solve: Callable[[Problem, SmootherSettings], Solution], *,
    attentive: bool, callback: Callback | None, stop: Stop, begin: Solution | None = None,
) -> Solution:  # fmt: skip
    """Solve for the stated duration, then find the best duration near it, and finish the plan with that duration.

    A plan `begin` takes the place of the first solve. With a weight on time, and no start from the caller, shorter
    durations are also tried, because they may lead to another route. A search for the best duration that ends elsewhere
    goes on from a plan of the duration at which it ended, as long as such plans become cheaper. `solve` is for problems
    with a fixed duration, within the time of `stop`; for `attentive` see `Budget`.
    """
    budget, total = Budget(settings.max_iterations, stop, callback=callback), 0
    log = budget.log

    def solved(fixed: Problem, options: SmootherSettings) -> Solution:
        nonlocal total
        solution = solve(fixed, options)
        if fixed.segments:
            solution = replace(solution, options=dict(solution.options) | {"segments": fixed.segments})
        total += max(len(solution.iterations), sum(one.iterations for one in solution.candidates))
        return solution

    assert problem.duration is not None
    first = begin = begin or solved(settled(problem, problem.steps * problem.dt), settings)
    shorter = SHORTENED if problem.time_weight > 0 and settings.start is None else 0
    best, fixed = None, [first]
    while not budget.over:
        with stop.reporting("smooth", attentive):
            ordinary, found = find_duration(
                problem, begin.trajectory, tolerance=settings.final(problem),
                violation=settings.violation_tolerance(problem), most=budget.left, budget=budget, price=settings.price,
            )  # fmt: skip
        if found.solved and (best is None or found.measures.cost < best[1].measures.cost):
            best = ordinary, found
            if not shorter or stop.due:
                break
            shorter -= 1
            less = max(SHORTER * ordinary.steps * ordinary.dt, problem.duration[0])
            tries = replace(settings, max_iterations=min(TRIES, settings.max_iterations))
            begin = solved(settled(problem, less), tries)
            if not begin.success:
                break
        elif best is None and np.isfinite(found.plan.states).all() and not stop.due:
            # The search may only have ended far from the constraints: go on from a plan of that duration.
            start = Trajectory(found.plan.states, found.plan.controls, ordinary.dt)
            begin = solved(ordinary, replace(settings, start=start, starts=None))
            least = min(_rank_with_time(one, problem, settings.price) for one in fixed)
            fixed.append(begin)
            missed, cost = _rank_with_time(begin, problem, settings.price)
            if not begin.success or not (missed, cost + FELL * abs(cost)) < least:
                break
        else:
            break
    if best is not None:
        ordinary, found = best
        m, n = first.trajectory.controls.shape[1], first.trajectory.states.shape[1]
        guess = InitialGuess(
            np.zeros((ordinary.steps, m, n)), found.plan.controls, f"a plan of {ordinary.steps * ordinary.dt:.6g} s",
            found=found, log=tuple(log),
        )  # fmt: skip
        chosen = solved(ordinary, replace(settings, start=guess, starts=None))  # its log begins with the search's
        return stop.finish(_described(chosen, problem, total))
    chosen = min(fixed, key=lambda one: _rank_with_time(one, problem, settings.price))
    status, remedy = Status.STALLED, "state another dt" if chosen.success else "state a dt that allows enough time"
    if stop.due:
        status, remedy = Status.TIME_LIMIT, "raise time_limit"
    elif not budget.left or chosen.status is Status.MAX_ITERATIONS:
        status, remedy = Status.MAX_ITERATIONS, "raise max_iterations"
    detail = f"the best duration was not found, this is {chosen.trajectory.horizon:g} s; {chosen.detail}"
    iterations = (*first.iterations, *log, *(chosen.iterations if chosen is not first else ()))
    chosen = replace(
        chosen, status=status, detail=detail.removesuffix("; "), iterations=iterations,
        remedy=f"{remedy}; or begin with start=solution of a fixed duration (duration=None, time_weight=0)",
    )  # fmt: skip
    return stop.finish(_described(chosen, problem, total + len(log)))


def _described(solution: Solution, problem: Problem, total: int) -> Solution:
    """The solution with the free duration among its options, in words, and with the iterations of all solves."""
    assert problem.duration is not None
    low, high = problem.duration
    price = f", at a price of {problem.time_weight:g} a second" if problem.time_weight else ""
    effort = f"{total} iterations in all solves" if total > len(solution.iterations) else ""
    return replace(
        solution,
        options=dict(solution.options) | {"duration": f"{low:g} to {high:g} s{price}"},
        detail="; ".join(part for part in (solution.detail, effort) if part),
    )


def _rank_with_time(solution: Solution, problem: Problem, price: float) -> tuple[float, float]:
    """Sort key, best first: the violation of a failed plan, then the cost with the prices of time and violations."""
    missed, plan = 0.0 if solution.success else solution.violation, solution.trajectory
    paid = 0.0
    if np.isfinite(price):
        stages = Stages(problem.settled(solution))
        paid = _paid(stages, Motion(in_c_order(plan.states), in_c_order(plan.controls)), price)
    return missed, solution.cost + problem.time_weight * plan.horizon + paid


def _paid(stages: Stages, plan: Motion, price: float | Array) -> float:
    """The price of all violations of a plan, at a price of each row (R,)."""
    prices = stages.of_each(np.where(np.isfinite(price) & (stages.owners >= 0), price, 0.0))
    numbers = stages.values(plan)[stages.live]
    missed = np.where(stages.of_each(stages.equality), np.abs(numbers), np.maximum(-numbers, 0.0))
    return float((prices * missed).sum())


def find_duration(
    problem: Problem, begin: Trajectory, *, tolerance: float, violation: float, most: int, budget: Budget,
    price: float,
) -> tuple[Problem, Found]:  # fmt: skip
    """Find the best duration near a plan's duration. Return the problem with it, and the optimum or the last plan.

    `violation` is the tolerance of the constraints, `most` the number of iterations, up to `MOST`; they join the log of
    the budget, which may end the search earlier. `price` is that of violations, which the cost of the result includes.
    """
    assert problem.duration is not None
    low, high = problem.duration
    if problem.segments:
        problem, begin = _with_found_segments(problem, begin, violation, most, budget, price)
        most = budget.left
    n = len(problem.dynamics.state_coordinates)
    stages, prices, found = _searched(problem, begin, (), tolerance, violation, most, budget, price)
    cost = found.measures.cost + _paid(stages, found.plan, prices)
    duration = float(np.clip(found.plan.states[0, n], low, high))
    # Remove everything that belongs to the duration.
    rows = found.sizes.rows[stages.owners != len(problem.constraint_terms)]
    found = replace(
        found, plan=Motion(in_c_order(found.plan.states[:, :n]), found.plan.controls),
        gain=in_c_order(found.gain[:, :, :n]), multipliers=found.multipliers[:-1],
        measures=found.measures._replace(cost=cost),
        sizes=found.sizes._replace(rows=rows),
    )  # fmt: skip
    return settled(problem, duration), found


def _searched(
    problem: Problem, begin: Trajectory, segments: Sequence[int], tolerance: float, violation: float, most: int,
    budget: Budget, price: float,
) -> tuple[Stages, Array, Found]:  # fmt: skip
    """The optimum near a plan with its duration as a state, which jumps where segments end; and the price of rows."""
    n = len(problem.dynamics.state_coordinates)
    with budget.stop.not_counting():  # compiling
        stages = Stages(with_duration(problem, by_segment=bool(segments)))
    stages.free[n] = 1.0
    stages.jump(segments)
    laps = Laps(budget)

    def watch(measures: Measures, seconds: float) -> bool:
        measures.record(laps, seconds=seconds)
        return budget.stop.due

    states = np.column_stack([begin.states, np.full(len(begin.states), begin.horizon)])
    plan = Motion(in_c_order(states), in_c_order(begin.controls))
    # The bounds of the duration hold at any price.
    prices = np.where(stages.owners == len(problem.constraint_terms), np.inf, price)
    found = InteriorPoint(stages, plan, price=prices).run(
        tolerance=tolerance, violation=violation, most=min(MOST, most), watch=watch, hurried=budget.hurried
    )
    return stages, prices, found


def _with_found_segments(
    problem: Problem, begin: Trajectory, violation: float, most: int, budget: Budget, price: float
) -> tuple[Problem, Trajectory]:
    """The problem with its segments at the knots where they end in time, and a plan with these, in equal steps.

    Both stay as they are if no durations of the segments are found.
    """
    _, _, found = _searched(problem, begin, problem.segments, ROUGH, violation, most, budget, price)
    if not found.solved:
        return problem, begin
    steps, old = problem.steps, np.array([0, *problem.segments, problem.steps])
    ends = np.cumsum([0.0, *found.plan.states[:-1, -1] / steps])  # times of the knots
    new = np.rint(ends[old] / ends[-1] * steps).astype(int)
    for k in range(1, len(new)):
        new[k] = max(new[k], new[k - 1] + 2)  # `Problem` wants two steps in a segment
    new[-1] = steps
    for k in range(len(new) - 2, 0, -1):
        new[k] = min(new[k], new[k + 1] - 2)
    knots = np.arange(steps + 1)
    at = np.interp(knots, new, old)

    def there(table: Array) -> Array:
        return np.column_stack([np.interp(at, knots, column) for column in table.T])

    # Means of controls, not samples: what they drive, such as rates of rotation, then ends where the states are.
    driven = np.vstack([np.zeros(found.plan.controls.shape[1]), np.cumsum(found.plan.controls, axis=0)])
    states, controls = there(found.plan.states[:, :-1]), np.diff(there(driven), axis=0) / np.diff(at)[:, None]
    return problem._with_segments(new[1:-1].tolist()), Trajectory(states, controls, float(ends[-1]) / steps)


def settled(problem: Problem, duration: float) -> Problem:
    """The problem with a fixed duration, in seconds."""
    return problem._of_duration(duration)


def with_duration(problem: Problem, *, by_segment: bool = False) -> Problem:
    """The problem with its duration as the last state; or with that of a plan of steps as long as the segment's.

    Raises:
      InputError: a part of the problem cannot be stated with one more state.
    """
    assert problem.duration is not None
    dynamics, n = problem.dynamics, len(problem.dynamics.state_coordinates)
    stated, (low, high) = problem.steps * problem.dt, problem.duration
    initial = problem.initial
    if isinstance(initial, FixedState):
        initial = FixedState(np.append(initial.numbers, stated))
    else:
        initial = initial.with_added_state(dynamics)
    weight = problem.time_weight / (problem.steps if by_segment else 1)
    priced = SymbolicCost(lambda x, u, p: p.weight * x[n], parameters={"weight": weight}, convex=True)
    bounds = SymbolicConstraint(
        lambda x, u, p: [x[n] - p.low, p.high - x[n]], parameters={"low": low, "high": high},
        at="all" if by_segment else "final",
    )  # fmt: skip
    stage_cost, final_cost = (one.with_added_state(dynamics) for one in (problem.stage_cost, problem.final_cost))
    return Problem(
        dynamics=_scaled(dynamics, stated), dt=problem.dt, steps=problem.steps, initial=initial,
        stage_cost=stage_cost + priced if by_segment else stage_cost,
        final_cost=final_cost if by_segment else final_cost + priced, control_limits=problem.control_limits,
        constraints=(*(one.with_added_state(dynamics) for one in problem.constraints), bounds), begin=problem.begin,
    )  # fmt: skip


def _scaled(dynamics: Dynamics, stated: float) -> Dynamics:
    """The dynamics with the duration as last state; at the stated duration they are unchanged."""
    space, controls, n = dynamics.state_coordinates, dynamics.control_coordinates, len(dynamics.state_coordinates)
    names = space.names
    state, parameter = unused(STATE, names), unused(STATED, (*dynamics.parameters, *dynamics.disturbances))

    def f(x: Any, u: Any, p: Any) -> list[Any]:
        share = x[n] / getattr(p, parameter)
        return [*(share * rate for rate in dynamics.f(x[:n], u, p)), 0]

    return Dynamics(
        f, states=dict(zip(names, space.units, strict=True)) | {state: "s"},
        controls=dict(zip(controls.names, controls.units, strict=True)),
        parameters=dict(dynamics.parameters) | {parameter: stated},
        disturbances={name: one for name, one in dynamics.disturbances.items() if name not in dynamics.parameters},
        position=tuple(names[i] for i in space.position), plane=space.plane, offset=space.offset,
        angles=tuple(names[i] for i in space.angles),
        rotation_vectors=tuple(names[i : i + 3] for i in space.rotation_vectors),
        control_limits=(controls.low, controls.high),
    ).with_substeps(dynamics.substeps)  # fmt: skip

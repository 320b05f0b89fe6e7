"""Constraints: from the optimum without them to one that keeps them, by the method of multipliers.

The smoother minimises the augmented Lagrangian, roughly; then the multipliers are updated, and where what is missed has
not halved, the penalty grows (see `multipliers.py`); and again. Were they updated after every iteration, plans that
slide along an obstacle would swing to and fro, for the model leaves out how an obstacle curves. Where undamped
iterations do not settle, the safeguard's minimise each augmented Lagrangian.
"""

import dataclasses

import numpy as np

from lqrsim.kernels import declarations
from lqrsim.kernels.records import LOG
from lqrsim.problem.costs import CostSum, ObstacleCost, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.solvers.attempt import Attempt, AttemptResult
from lqrsim.solvers.common import Callback
from lqrsim.solvers.initial_guess import InitialGuess
from lqrsim.solvers.multipliers import LARGEST, AugmentedLagrangian

STUCK = 3  # how often the penalty grows to no avail at all before that is given up
ITERATIONS, ROUNDS = 100, 30  # undamped iterations in all; rounds of damped ones
ROUGH, ROUGH_GAP, PATIENCE = 1e-3, 3e-3, 15  # what is settled well enough to update the multipliers, and when anyway
ROUGHEST_GAP = 3e-2  # and of damped iterations, which come to their minimum slowly
STALE, CLOSER = 40, 0.9  # undamped iterations that come no closer, before these are given up; what counts as closer


def finish(attempt: Attempt, *, each: bool, callback: Callback | None = None) -> AttemptResult:
    """Run an attempt at a problem with constraints to its end, the method, its safeguard, and these; certified."""
    tried: tuple[Iteration, ...] = ()
    if attempt.initial_guess.multipliers and attempt.run_opening_pass():
        found = satisfy(attempt, None, each=each, callback=callback)
        if found.success or attempt.stop.due or not attempt.iterations_left(found.iterations):
            return attempt.certified(found)
        # What is known of another problem does not help here.
        tried = found.iterations
        attempt = _again(attempt, attempt.problem, dataclasses.replace(attempt.initial_guess, multipliers=()), tried)
    found = attempt.finish(each=each, callback=callback)
    attempt, found = _with_constraints(attempt, found, each=each, callback=callback)
    return attempt.certified(dataclasses.replace(found, iterations=(*tried, *found.iterations)))


def _again(attempt: Attempt, problem: Problem, initial_guess: InitialGuess, done: tuple[Iteration, ...]) -> Attempt:
    """Another attempt, with what is left of the iterations."""
    settings = dataclasses.replace(attempt.settings, max_iterations=max(attempt.iterations_left(done), 1))
    return Attempt(problem, settings, initial_guess, attempt.work.start, attempt.stop)


def _with_constraints(
    attempt: Attempt, found: AttemptResult, *, each: bool, callback: Callback | None
) -> tuple[Attempt, AttemptResult]:
    """Go on from what was found without the constraints; also which attempt has the answer in its memory."""
    if attempt.stop.due or not attempt.iterations_left(found.iterations):
        if found.success and not attempt.work.keeps(attempt.work.constraint_values(found.states, found.controls)):
            status = Status.TIME_LIMIT if attempt.stop.due else Status.MAX_ITERATIONS
            found = dataclasses.replace(found, status=status, detail="before the constraints could be met")
        return attempt, found
    if found.success:
        return attempt, satisfy(attempt, found, each=each, callback=callback)
    return _first_feasible(attempt, found, each=each, callback=callback)


def satisfy(
    attempt: Attempt, found: AttemptResult | None, *, each: bool, callback: Callback | None = None
) -> AttemptResult:
    """Go on from what was found without the constraints, or, without it, from the multipliers of another solution."""
    lagrangian = AugmentedLagrangian(attempt)
    if found is None:
        attempt.roll_out()
        lagrangian.evaluate(attempt.work.states, attempt.work.controls)
    else:
        lagrangian.evaluate(found.states, found.controls)
        if lagrangian.kept:
            return found
        lagrangian.start()
        # These will be overwritten.
        found = dataclasses.replace(found, states=found.states.copy(), controls=found.controls.copy())
    before = found.iterations if found is not None else ()
    undamped = _undamped(attempt, lagrangian, before, each=each, callback=callback)
    if (
        undamped.success
        or not attempt.settings.safeguard
        or attempt.stop.due
        or not attempt.iterations_left(undamped.iterations)
    ):
        return undamped
    return _damped(attempt, lagrangian, found, undamped, each=each, callback=callback)


def _first_feasible(
    attempt: Attempt, found: AttemptResult, *, each: bool, callback: Callback | None
) -> tuple[Attempt, AttemptResult]:
    """Where not even the problem without the constraints is solved: deep within obstacles, they cost beyond numbers.

    Without these costs there is a plan that keeps the constraints, from where they can come in, or there is none.
    """
    problem = attempt.problem
    if not (attempt.settings.safeguard and any(cost.weight for cost in problem.obstacle_costs)):
        return attempt, found

    def without_cost(iteration: Iteration) -> Iteration:
        return dataclasses.replace(iteration, cost=np.nan, improvement=np.nan)

    def told(iteration: Iteration) -> None:
        if callback is not None:
            callback(without_cost(iteration))

    costs = [cost.weighing(0.0) if isinstance(cost, ObstacleCost) else cost for cost in terms_of(problem.stage_cost)]
    plain = problem.with_costs(stage_cost=CostSum(tuple(costs)))
    without = _again(attempt, plain, dataclasses.replace(attempt.initial_guess, prior=None), found.iterations)
    kept = without.finish(each=each, callback=told)
    if kept.success and not attempt.stop.due and without.iterations_left(kept.iterations):
        kept = satisfy(without, kept, each=each, callback=told)
    before = (*found.iterations, *(without_cost(iteration) for iteration in kept.iterations))
    if not kept.success or attempt.stop.due or not attempt.iterations_left(before):
        # Of the plan, only what the constraints say is known: its certificate tells the cost.
        status = Status.TIME_LIMIT if attempt.stop.due else Status.MAX_ITERATIONS if kept.success else kept.status
        return attempt, dataclasses.replace(kept, status=status, iterations=before, final=not kept.success, values={})
    initial_guess = dataclasses.replace(
        attempt.initial_guess, gain=kept.law[0].copy(), offset=kept.law[1].copy(), trajectory=None, prior=None,
        cost_to_go=kept.values.get("cost_to_go"), multipliers=kept.multipliers,
    )  # fmt: skip
    attempt = _again(attempt, problem, initial_guess, before)
    again = satisfy(attempt, None, each=each, callback=callback) if kept.multipliers else None
    if again is None:
        again = attempt.finish(each=each, callback=callback)
        if again.success and not attempt.stop.due and attempt.iterations_left(again.iterations):
            again = satisfy(attempt, again, each=each, callback=callback)
    return attempt, dataclasses.replace(again, iterations=(*before, *again.iterations))


def _undamped(
    attempt: Attempt,
    lagrangian: AugmentedLagrangian,
    before: tuple[Iteration, ...],
    *,
    each: bool,
    callback: Callback | None,
) -> AttemptResult:
    work = attempt.work
    work.memory["plan_cost"] = -np.inf  # of lower cost is not better now
    log = np.zeros(min(ITERATIONS, max(attempt.iterations_left(before), 1)), LOG)
    done: tuple[Iteration, ...] = ()
    since, stale, nearest = 0, 0, np.inf
    while True:
        termination = attempt.run_on(log, len(done) + 1, done=done, each=each, callback=callback)
        done, since = termination.iterations, since + 1
        stopped = termination.pass_failed or termination.outcome in (declarations.CYCLING, declarations.TIMED_OUT)
        if stopped or not np.isfinite(done[-1].cost):
            break
        lagrangian.evaluate(work.states, work.controls)
        settled = termination.outcome in (declarations.CONVERGED, declarations.COST_CONVERGED)
        if len(done) == len(log) or (settled and lagrangian.solved):
            break
        # From the optimum without constraints they soon settle, or cycle: then damped ones are far quicker.
        last, limits = done[-1], attempt.settings
        off = max(last.gap / limits.gap_tolerance, last.violation / limits.missed(attempt.problem))
        stale = 0 if off < CLOSER * nearest else stale + 1
        nearest = min(off, nearest)
        if stale == STALE and before and limits.safeguard:
            break
        rough = abs(done[-1].improvement) < ROUGH and done[-1].gap < ROUGH_GAP
        if settled or rough or since == PATIENCE:
            since = 0
            lagrangian.update()
    found = attempt.result(dataclasses.replace(termination, iterations=before + done))
    detail = found.detail or ("" if found.success else f"with constraints; {lagrangian.worst()}")
    if found.success and not lagrangian.solved:
        found = dataclasses.replace(found, status=Status.MAX_ITERATIONS)
        detail = f"{len(done)} iterations with constraints: {lagrangian.worst()}"
    return dataclasses.replace(found, detail=detail, multipliers=lagrangian.multipliers())


def _damped(
    attempt: Attempt,
    lagrangian: AugmentedLagrangian,
    found: AttemptResult | None,
    undamped: AttemptResult,
    *,
    each: bool,
    callback: Callback | None,
) -> AttemptResult:
    """The safeguard: from the plan without constraints or the last one with them, whichever is the better beginning."""
    work = attempt.work
    plans = [(work.states, work.controls, undamped.cost)]
    plans += [(found.states, found.controls, found.cost)] if found is not None else []
    plans = [plan for plan in plans if np.isfinite(plan[2])]
    if not plans:
        return undamped
    lagrangian.evaluate(*plans[-1][:2])
    lagrangian.start()
    merits = []
    for *plan, cost in plans:
        lagrangian.evaluate(*plan)
        merits.append(cost + lagrangian.added())
    states, controls, cost = plans[int(np.argmin(merits))]
    work.plan[0][:], work.plan[1][:] = states, controls
    work.memory["plan_cost"] = cost
    why = "the undamped method failed with the constraints"
    return _rounds(attempt, lagrangian, undamped.iterations, why, each=each, callback=callback)


def refine(attempt: Attempt, *, each: bool, callback: Callback | None = None) -> AttemptResult:
    """Run an attempt to its end by steps that lower the cost alone, from where its first policy leads; certified.

    So it stays on the way round that it begins with, which undamped iterations would leave.
    """
    attempt.roll_out()
    cost = float(attempt.work.memory["plan_cost"])
    optimality = attempt.linearize_about_plan() if np.isfinite(cost) else np.nan
    if not np.isfinite(optimality):
        return attempt.certified(attempt.finish(each=each, callback=callback))
    if not attempt.problem.constraints:
        attempt.work.memory["merit"] = cost
        damped = attempt.run_damped(before=(), each=each, callback=callback)
        found = attempt.damped_result(damped, damped.status, damped.detail(attempt.problem.steps))
        return attempt.certified(found)
    lagrangian = AugmentedLagrangian(attempt)
    lagrangian.evaluate(*attempt.work.plan)
    lagrangian.start()
    return attempt.certified(_rounds(attempt, lagrangian, (), "", each=each, callback=callback))


def _rounds(
    attempt: Attempt,
    lagrangian: AugmentedLagrangian,
    iterations: tuple[Iteration, ...],
    why: str,
    *,
    each: bool,
    callback: Callback | None,
) -> AttemptResult:
    """Damped iterations from the plan in the memory, and updated multipliers, until the constraints are met or cannot
    be.
    """
    work = attempt.work
    lagrangian.evaluate(*work.plan)
    rounds, rough = 0, True
    while True:
        rounds += 1
        work.memory["merit"] = work.memory["plan_cost"] + lagrangian.added()
        # Until the multipliers are about right, there is no point in a minimum to all its digits.
        limits = (ROUGH, ROUGHEST_GAP) if rough else (0.0, 0.0)
        termination = attempt.run_damped(before=iterations, least=limits, each=each, callback=callback)
        iterations = termination.iterations
        lagrangian.evaluate(*work.plan)
        if termination.success and lagrangian.solved:
            if not rough:
                found = attempt.damped_result(termination, termination.status, why)
                return dataclasses.replace(found, multipliers=lagrangian.multipliers())
            if attempt.iterations_left(iterations) and not attempt.stop.due:
                rough = False
                continue
        if rounds == ROUNDS or lagrangian.grown > LARGEST or lagrangian.stuck == STUCK:
            break
        if attempt.stop.due or not attempt.iterations_left(iterations):
            break
        lagrangian.update()
        rough = rough and lagrangian.stuck == 0 and not lagrangian.nearly
    status, detail = Status.MAX_ITERATIONS, f"{why}; {lagrangian.worst()}".removeprefix("; ")
    if not lagrangian.kept and not lagrangian.nearly and (lagrangian.stuck == STUCK or lagrangian.grown > LARGEST):
        status, detail = Status.INFEASIBLE, lagrangian.worst()
    if attempt.stop.due:
        status = Status.TIME_LIMIT
    found = attempt.damped_result(termination, status, detail)
    return dataclasses.replace(found, multipliers=lagrangian.multipliers())

"""Constraints: from the optimum without them to one that keeps them, by the method of multipliers.

The smoother minimises the augmented Lagrangian (see `augmented_lagrangian.py`), roughly; then the multipliers are
renewed, and where what is missed has not halved, the penalty grows; and again. Were they renewed after every iteration,
plans that slide along an obstacle would swing to and fro, for the model leaves out how an obstacle curves. Where
undamped iterations do not settle, the safeguard's minimise each augmented Lagrangian.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import interface
from lqrsim.kernels.records import LOG
from lqrsim.problem.costs import CostSum, ObstacleCost, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.results.records import Iteration, Multipliers, Status
from lqrsim.results.value_functions import Moments
from lqrsim.solvers.attempt import Attempt, Found
from lqrsim.solvers.common import Callback
from lqrsim.solvers.initial_guess import Start

PENALTY = 8.0  # at first, relative to what it costs to change what is constrained
GROWTH = 5.0  # of the penalty
LARGEST, STUCK = 1e4, 3  # how far it grows before that is given up, and how often to no avail at all
ITERATIONS, ROUNDS = 100, 30  # undamped iterations in all; rounds of damped ones
ROUGH, ROUGH_GAP, PATIENCE = 1e-3, 3e-3, 15  # what is settled well enough to renew the multipliers, and when anyway
ROUGHEST_GAP = 3e-2  # and of damped iterations, which come to their minimum slowly


def finish(attempt: Attempt, *, each: bool, callback: Callback | None = None) -> Found:
    """Run an attempt to its end, the method, its safeguard where that fails, and then the constraints; certified."""
    tried: tuple[Iteration, ...] = ()
    if attempt.begin.multipliers and attempt.opened():
        found = _satisfy(attempt, None, each=each, callback=callback)
        if found.success or attempt.stop.due or not attempt.left(found.iterations):
            return attempt.certified(found)
        # What is known of another problem does not help here.
        tried = found.iterations
        attempt = _again(attempt, attempt.problem, dataclasses.replace(attempt.begin, multipliers=()), tried)
    found = attempt.finish(each=each, callback=callback)
    if attempt.problem.constraints:
        attempt, found = _with_constraints(attempt, found, each=each, callback=callback)
    return attempt.certified(dataclasses.replace(found, iterations=(*tried, *found.iterations)))


def _again(attempt: Attempt, problem: Problem, begin: Start, done: tuple[Iteration, ...]) -> Attempt:
    """Another attempt, with what is left of the iterations."""
    settings = dataclasses.replace(attempt.settings, max_iterations=max(attempt.left(done), 1))
    return Attempt(problem, settings, begin, attempt.work.start, attempt.stop)


def _with_constraints(
    attempt: Attempt, found: Found, *, each: bool, callback: Callback | None
) -> tuple[Attempt, Found]:
    """Go on from what was found without the constraints; also which attempt has the answer in its memory."""
    if attempt.stop.due or not attempt.left(found.iterations):
        if found.success and attempt.work.violation(attempt.work.constraint_values(found.states, found.controls)) > 0:
            status = Status.TIME_LIMIT if attempt.stop.due else Status.MAX_ITERATIONS
            found = dataclasses.replace(found, status=status, detail="before the constraints could be met")
        return attempt, found
    if found.success:
        return attempt, _satisfy(attempt, found, each=each, callback=callback)
    return _first_feasible(attempt, found, each=each, callback=callback)


def _satisfy(attempt: Attempt, found: Found | None, *, each: bool, callback: Callback | None = None) -> Found:
    """Go on from what was found without the constraints, or, without it, from the multipliers of another solution."""
    lagrangian = _Lagrangian(attempt)
    if found is None:
        attempt.roll_out()
        lagrangian.look(attempt.work.states, attempt.work.controls)
    else:
        lagrangian.look(found.states, found.controls)
        if lagrangian.violation == 0:
            return found
        lagrangian.begin()
        # These will be overwritten.
        found = dataclasses.replace(found, states=found.states.copy(), controls=found.controls.copy())
    before = found.iterations if found is not None else ()
    undamped = _undamped(attempt, lagrangian, before, each=each, callback=callback)
    if undamped.success or not attempt.settings.safeguard or attempt.stop.due or not attempt.left(undamped.iterations):
        return undamped
    return _damped(attempt, lagrangian, found, undamped, each=each, callback=callback)


def _first_feasible(attempt: Attempt, found: Found, *, each: bool, callback: Callback | None) -> tuple[Attempt, Found]:
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

    costs = [
        ObstacleCost(cost.world, radius=cost.radius, sharpness=cost.sharpness, weight=0.0)
        if isinstance(cost, ObstacleCost)
        else cost
        for cost in terms_of(problem.stage_cost)
    ]
    plain = dataclasses.replace(problem, stage_cost=CostSum(tuple(costs)))
    without = _again(attempt, plain, dataclasses.replace(attempt.begin, prior=None), found.iterations)
    kept = without.finish(each=each, callback=told)
    if kept.success and not attempt.stop.due and without.left(kept.iterations):
        kept = _satisfy(without, kept, each=each, callback=told)
    before = (*found.iterations, *(without_cost(iteration) for iteration in kept.iterations))
    if not kept.success or attempt.stop.due or not attempt.left(before):
        # Of the plan, only what the constraints say is known: its certificate tells the cost.
        status = Status.TIME_LIMIT if attempt.stop.due else Status.MAX_ITERATIONS if kept.success else kept.status
        return attempt, dataclasses.replace(kept, status=status, iterations=before, final=not kept.success, values={})
    begin = dataclasses.replace(
        attempt.begin, gain=kept.law[0].copy(), offset=kept.law[1].copy(), trajectory=None, prior=None,
        cost_to_go=kept.values.get("cost_to_go"), multipliers=kept.multipliers,
    )  # fmt: skip
    attempt = _again(attempt, problem, begin, before)
    again = _satisfy(attempt, None, each=each, callback=callback) if kept.multipliers else None
    if again is None:
        again = attempt.finish(each=each, callback=callback)
        if again.success and not attempt.stop.due and attempt.left(again.iterations):
            again = _satisfy(attempt, again, each=each, callback=callback)
    return attempt, dataclasses.replace(again, iterations=(*before, *again.iterations))


def _undamped(
    attempt: Attempt,
    lagrangian: "_Lagrangian",
    before: tuple[Iteration, ...],
    *,
    each: bool,
    callback: Callback | None,
) -> Found:
    work, settings = attempt.work, attempt.settings
    work.memory["plan_cost"] = -np.inf  # of lower cost is not better now
    log = np.zeros(min(ITERATIONS, max(attempt.left(before), 1)), LOG)
    done: tuple[Iteration, ...] = ()
    since = 0
    while True:
        ending = attempt.run_on(log, len(done) + 1, done=done, each=each, callback=callback)
        done, since = ending.iterations, since + 1
        stopped = ending.pass_failed or ending.outcome in (interface.CYCLING, interface.TIMED_OUT)
        if stopped or not np.isfinite(done[-1].cost):
            break
        lagrangian.look(work.states, work.controls)
        settled = ending.outcome in (interface.CONVERGED, interface.COST_CONVERGED)
        if len(done) == len(log) or (settled and lagrangian.missed <= settings.constraint_tolerance):
            break
        rough = abs(done[-1].improvement) < ROUGH and done[-1].gap < ROUGH_GAP
        if settled or rough or since == PATIENCE:
            since = 0
            lagrangian.renew()
    found = attempt.found(dataclasses.replace(ending, iterations=before + done))
    detail = found.detail or ("" if found.success else f"with constraints, {lagrangian.worst()}")
    if found.success and lagrangian.missed > settings.constraint_tolerance:
        found = dataclasses.replace(found, status=Status.MAX_ITERATIONS)
        detail = f"{len(done)} iterations with constraints: {lagrangian.worst()}"
    return dataclasses.replace(found, detail=detail, multipliers=lagrangian.multipliers())


def _damped(
    attempt: Attempt,
    lagrangian: "_Lagrangian",
    found: Found | None,
    undamped: Found,
    *,
    each: bool,
    callback: Callback | None,
) -> Found:
    """The safeguard: from the plan without constraints or the last one with them, whichever is the better beginning."""
    work = attempt.work
    plans = [(work.states, work.controls, undamped.cost)]
    plans += [(found.states, found.controls, found.cost)] if found is not None else []
    plans = [plan for plan in plans if np.isfinite(plan[2])]
    if not plans:
        return undamped
    lagrangian.look(*plans[-1][:2])
    lagrangian.begin()
    merits = []
    for *plan, cost in plans:
        lagrangian.look(*plan)
        merits.append(cost + lagrangian.added())
    states, controls, cost = plans[int(np.argmin(merits))]
    work.plan[0][:], work.plan[1][:] = states, controls
    work.memory["plan_cost"] = cost
    why = "the undamped method failed with the constraints"
    return _rounds(attempt, lagrangian, undamped.iterations, why, each=each, callback=callback)


def refine(attempt: Attempt, *, each: bool, callback: Callback | None = None) -> Found:
    """Run an attempt to its end by steps that lower the cost alone, from where its first policy leads; certified.

    So it stays on the way round that it begins with, which undamped iterations would leave.
    """
    attempt.roll_out()
    cost = float(attempt.work.memory["plan_cost"])
    optimality = attempt.look_back() if np.isfinite(cost) else np.nan
    if not np.isfinite(optimality):
        return attempt.certified(attempt.finish(each=each, callback=callback))
    if not attempt.problem.constraints:
        attempt.work.memory["merit"] = cost
        damped = attempt.damp(before=(), each=each, callback=callback)
        found = attempt.found_damped(damped, damped.status, damped.detail(attempt.problem.steps))
        return attempt.certified(found)
    lagrangian = _Lagrangian(attempt)
    lagrangian.look(*attempt.work.plan)
    lagrangian.begin()
    return attempt.certified(_rounds(attempt, lagrangian, (), "", each=each, callback=callback))


def _rounds(
    attempt: Attempt,
    lagrangian: "_Lagrangian",
    iterations: tuple[Iteration, ...],
    why: str,
    *,
    each: bool,
    callback: Callback | None,
) -> Found:
    """Damped iterations from the plan in the memory, and renewed multipliers, until the constraints are met or can not
    be.
    """
    work, tolerance = attempt.work, attempt.settings.constraint_tolerance
    lagrangian.look(*work.plan)
    rounds, rough = 0, True
    while True:
        rounds += 1
        work.memory["merit"] = work.memory["plan_cost"] + lagrangian.added()
        # Until the multipliers are about right, there is no point in a minimum to all its digits.
        limits = (ROUGH, ROUGHEST_GAP) if rough else (0.0, 0.0)
        ending = attempt.damp(before=iterations, least=limits, each=each, callback=callback)
        iterations = ending.iterations
        lagrangian.look(*work.plan)
        if ending.success and lagrangian.missed <= tolerance:
            if not rough:
                found = attempt.found_damped(ending, ending.status, why)
                return dataclasses.replace(found, multipliers=lagrangian.multipliers())
            if attempt.left(iterations) and not attempt.stop.due:
                rough = False
                continue
        if rounds == ROUNDS or lagrangian.grown > LARGEST or lagrangian.stuck == STUCK:
            break
        if attempt.stop.due or not attempt.left(iterations):
            break
        lagrangian.renew()
        rough = rough and lagrangian.stuck == 0
    status, detail = Status.MAX_ITERATIONS, f"{why}; {lagrangian.worst()}".removeprefix("; ")
    if lagrangian.violation == 0:
        detail = f"{why}; the plan keeps the constraints, but there are better ones".removeprefix("; ")
    elif lagrangian.stuck == STUCK or lagrangian.grown > LARGEST:
        status, detail = Status.INFEASIBLE, lagrangian.worst()
    if attempt.stop.due:
        status = Status.TIME_LIMIT
    found = attempt.found_damped(ending, status, detail)
    return dataclasses.replace(found, multipliers=lagrangian.multipliers())


def _press(array: Array, values: Array) -> Array:
    """max(0, lambda - mu d): what the inequalities press with; 0 where they do not act."""
    acting = np.where(np.isinf(values), 0.0, values)
    return np.where(np.isinf(values), 0.0, np.maximum(array[interface.HEADER :] - array[0] * acting, 0.0))


def _missed(array: Array, values: Array) -> float:
    """By how much a constraint is missed, or its multipliers are off, at most."""
    press = array[interface.HEADER :] / array[0] if array[0] > 0 else 0.0
    return float(np.abs(np.minimum(values, press)).max(initial=0.0))


class _Lagrangian:
    """The multipliers of all constraints, in the memory that the compiled loops read.

    Attributes:
      violation: by how much the worst constraint is missed by the plan that was looked at last.
      missed: by how much what is aimed at is, which is to keep them with the tolerance to spare; and where that is
        kept, by how much its multiplier is still off: `|min(d, lambda / mu)|`.
      grown: by how much the penalty has grown. stuck: how often in a row that did not help.
    """

    def __init__(self, attempt: Attempt) -> None:
        self._problem, self._work = attempt.problem, attempt.work
        self._tolerance = attempt.settings.constraint_tolerance
        self.violation, self.missed, self.grown, self.stuck = 0.0, np.inf, 1.0, 0
        self._last = np.inf
        self._first = [array[0] for array in self._work.multipliers]  # zero, but for those of another solution

    def look(self, states: Array, controls: Array) -> None:
        """Evaluate the constraints of a plan."""
        self._plan = states, controls
        stated = self._work.constraint_values(states, controls)
        self.violation = self._work.violation(stated)
        self._values = [values.ravel() - self._tolerance for values in stated]
        self.missed = max(self._each(_missed))

    def begin(self) -> None:
        """No multipliers, and a penalty for each constraint that fits what it costs to change it."""
        self.grown, self.stuck, self._last = 1.0, 0, np.inf
        for which, (array, values) in enumerate(zip(self._work.multipliers, self._values, strict=True)):
            array[interface.HEADER :] = 0.0
            if not self._first[which] > 0:
                # Only now: once there is a penalty, it is what the passes say of curvature.
                self._first[which] = PENALTY * self._curvature(which, int(values.argmin())) if len(values) else 1.0
            array[0] = self._first[which]

    def renew(self) -> None:
        """Take what the constraints press with for the multipliers; let the penalty grow if that helps too little."""
        for array, values in zip(self._work.multipliers, self._values, strict=True):
            array[interface.HEADER :] = _press(array, values)
        missed = max(-values.min(initial=np.inf) for values in self._values)
        self.stuck = self.stuck + 1 if missed > 0.9 * self._last else 0
        if missed > max(0.5 * self._last, self._tolerance):
            self.grown *= GROWTH
            for array in self._work.multipliers:
                array[0] *= GROWTH
        self._last = missed

    def added(self) -> float:
        """What the augmented Lagrangian adds to the cost of the plan."""

        def one(array: Array, values: Array) -> float:
            force = _press(array, values)
            return float((force @ force - array[interface.HEADER :] @ array[interface.HEADER :]) / (2 * array[0]))

        return sum(self._each(one))

    def multipliers(self) -> tuple[Multipliers, ...]:
        """As a solution has them: with the last look taken into account."""

        def one(array: Array, values: Array) -> Multipliers:
            return Multipliers(_press(array, values).reshape(self._problem.steps + 1, -1), float(array[0]))

        return tuple(self._each(one))

    def worst(self) -> str:
        """Which constraint is missed most, by how much and when."""
        least = [values.min(initial=np.inf) + self._tolerance for values in self._values]
        which = int(np.argmin(least))
        inequalities = self._problem.inequalities[which]
        step, row = divmod(int(self._values[which].argmin()), inequalities.rows)
        missed, time = -least[which], step * self._problem.dt
        return f"{inequalities.says(row)} is missed by {missed:.2g} at {time:.2f} s (step {step})"

    def _each(self, function: Callable[[Array, Array], "float | Multipliers"]) -> list:
        return [function(*pair) for pair in zip(self._work.multipliers, self._values, strict=True)]

    def _curvature(self, which: int, index: int) -> float:
        """What it costs to change one of a constraint's numbers: twice the total cost of a change by 1 unit.

        `1 / n' (S + Sbar)^-1 n` of its slope n: the curvature of the total cost, the rest of the trajectory giving way.
        """
        states, controls = self._plan
        n, steps = states.shape[1], len(controls)
        step, row = divmod(index, self._problem.inequalities[which].rows)
        slope = self._work.constraint_slope(which, row, states[step], controls[min(step, steps - 1)], step)
        values = self._work.value_functions()
        go, come = values["cost_to_go"], values["cost_to_come"]
        try:
            if isinstance(come, Moments):
                given = np.linalg.solve(np.eye(n) + come.covariance[step] @ go.hessian[step], come.covariance[step])
            else:
                given = np.linalg.inv(go.hessian[step] + come.hessian[step])
        except np.linalg.LinAlgError:
            return 1.0
        spread = np.zeros((len(slope), len(slope)))
        gain = self._work.arrays.policy.gain[min(step, steps - 1)]
        spread[:n, :n], spread[n:, n:] = given, gain @ given @ gain.T
        spread[:n, n:], spread[n:, :n] = given @ gain.T, gain @ given
        bend = float(slope @ spread @ slope)
        return 1 / bend if bend > 0 else 1.0

"""Constraints by the method of multipliers: from the optimum without constraints to an optimum that keeps them.

The smoother minimises the augmented Lagrangian approximately. Then the multipliers are updated, and the penalty grows
where the violation has not halved. Both steps are repeated. With an update after every iteration, plans that slide
along an obstacle would oscillate, since the model leaves out the curvature of obstacles. If undamped iterations do not
settle, the damped ones of the safeguard minimise each augmented Lagrangian.

The method serves problems that the interior point does not take: noise with constraints, and `finish=None`. It is also
one of the attempts of `finish.py`, among obstacles and with the dynamics of an MJCF. The compiled part is in
`kernels/augmented_lagrangian.py`.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import LOG, Motion
from lqrsim.problem.parts import allowed_violation, violation_of, weighing_obstacles
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Moments, Multipliers, Status, joined
from lqrsim.solvers.certify import certified
from lqrsim.solvers.compiled import ConstraintMultipliers
from lqrsim.solvers.engine import RunResult, SolveRun, copied
from lqrsim.solvers.settings import InitialGuess

INITIAL = 8.0  # initial penalty, relative to the cost of changing the constraint's value
GROWTH, LARGEST = 5.0, 1e4  # factor by which the penalty grows, and largest total factor
STUCK = 3  # number of times in a row that the penalty may grow without effect
ITERATIONS, ROUNDS = 100, 30  # total number of undamped iterations; rounds of damped iterations
# Tolerances at which the multipliers are updated, and the number of iterations after which they are updated anyway.
ROUGH, ROUGH_GAP, PATIENCE = 1e-3, 3e-3, 15
ROUGHEST_GAP = 3e-2  # the same gap for damped iterations, which approach their minimum slowly
STALE, CLOSER = 40, 0.9  # number of undamped iterations without progress that ends them; factor that counts as progress
REFINED = 5  # damped iterations from a plan of the search before Newton's method continues


def by_multipliers(run: SolveRun) -> RunResult:
    """The certified result of a full run: smoothing, its safeguard, and these iterations."""
    if run.initial_guess.multipliers and run.run_opening_pass():
        result = meet_constraints(run, None)
        if result.success or run.budget.over:
            return certified(run, result)
        # Multipliers of another problem do not help here.
        run = _again(run, run.problem, replace(run.initial_guess, multipliers=()))
    result = run.run_to_end()
    if run.budget.over:
        if result.success and not run.work.keeps(result.plan):
            status = Status.TIME_LIMIT if run.budget.stop.due else Status.MAX_ITERATIONS
            result = replace(result, status=status, detail="before the constraints could be met")
    elif result.success:
        result = meet_constraints(run, result)
    else:
        run, result = _first_feasible(run, result)
    return certified(run, result)


def _again(run: SolveRun, problem: Problem, initial_guess: InitialGuess) -> SolveRun:
    return SolveRun(problem, run.settings, initial_guess, run.work.start, run.budget)


def meet_constraints(run: SolveRun, unconstrained: RunResult | None, *, stale: int = STALE) -> RunResult:
    """Continue from the result without the constraints or, without one, from another solution's multipliers.

    After `stale` undamped iterations without progress damped iterations follow.
    """
    lagrangian = AugmentedLagrangian(run)
    if unconstrained is None:
        run.roll_out()
        lagrangian.evaluate(run.work.last)
        run.weigh_noise(run.work.last)
    else:
        lagrangian.evaluate(unconstrained.plan)
        if lagrangian.kept:
            return unconstrained
        lagrangian.begin()
        run.weigh_noise(unconstrained.plan)
        unconstrained = replace(unconstrained, plan=copied(unconstrained))  # the arrays will be overwritten
    undamped = _undamped(run, lagrangian, known=unconstrained is None, patience=stale)
    if undamped.success or not run.settings.safeguard or run.budget.over:
        return undamped
    return _damped(run, lagrangian, unconstrained, undamped)


def _first_feasible(run: SolveRun, result: RunResult) -> tuple[SolveRun, RunResult]:
    """Find a plan that keeps the constraints without the cost of obstacles, then add that cost; the run that has it.

    This helps if not even the problem without the constraints is solved, because deep inside obstacles their cost
    overflows.
    """
    problem, budget = run.problem, run.budget
    if not (run.settings.safeguard and any(cost.contact_curvature for cost in problem.obstacle_costs)):
        return run, result
    plain = problem.with_costs(stage_cost=weighing_obstacles(problem.stage_cost, 0.0))
    without = _again(run, plain, replace(run.initial_guess, prior=None))
    with budget.without_costs():
        first = without.run_to_end()
        if first.success and not budget.over:
            first = meet_constraints(without, first)
    if not first.success or budget.over:
        # Only the constraint values of the plan are known. The certificate provides the cost.
        status = Status.TIME_LIMIT if budget.stop.due else Status.MAX_ITERATIONS if first.success else first.status
        return run, replace(first, status=status, decisive=not first.success, values={})
    initial_guess = replace(
        run.initial_guess, gain=first.policy.gain.copy(), offset=first.policy.offset.copy(), trajectory=None,
        prior=None, cost_to_go=first.values.get("cost_to_go"), multipliers=first.multipliers,
    )  # fmt: skip
    run = _again(run, problem, initial_guess)
    if first.multipliers:
        return run, meet_constraints(run, None)
    result = run.run_to_end()
    return run, meet_constraints(run, result) if result.success and not budget.over else result


def _undamped(run: SolveRun, lagrangian: "AugmentedLagrangian", *, known: bool, patience: int) -> RunResult:
    """Undamped iterations, with updates of the multipliers, until `patience` iterations make no progress.

    The multipliers may be `known` from another solution at first.
    """
    work, log, gap_tolerance = run.work, run.budget.log, run.settings.gap_tolerance
    rows = np.zeros(min(ITERATIONS, max(run.budget.left, 1)), LOG)
    done, since, stale, nearest = 0, 0, 0, np.inf
    while True:
        begin = len(log)
        ending = run.smooth_with_constraints(rows, done, done + 1)
        done, since = done + len(log) - begin, since + 1
        stopped = ending.pass_failed or ending.outcome in (declarations.CYCLING, declarations.TIMED_OUT)
        if stopped or len(log) == begin or not np.isfinite(log[-1].cost):
            break
        last = log[-1]
        lagrangian.evaluate(work.last)
        settled = ending.outcome in (declarations.CONVERGED, declarations.COST_CONVERGED)
        if done == len(rows) or (settled and lagrangian.solved):
            break
        # From the optimum without constraints they soon settle or cycle. If they cycle, damped iterations are much
        # faster.
        off = max(last.gap / gap_tolerance, last.violation / run.method.violation)
        stale = 0 if off < CLOSER * nearest else stale + 1
        nearest = min(off, nearest)
        if stale == patience and not known and run.settings.safeguard:
            break
        rough = abs(last.improvement) < ROUGH and last.gap < ROUGH_GAP
        if settled or rough or since == PATIENCE:
            since = 0
            lagrangian.update()
            run.weigh_noise(work.last)
    result = run.result(ending)
    detail = result.detail or ("" if result.success else f"with constraints; {lagrangian.worst()}")
    if result.success and not lagrangian.solved:
        result = replace(result, status=Status.MAX_ITERATIONS)
        detail = f"{done} iterations with constraints: {lagrangian.worst()}"
    return replace(result, detail=detail, multipliers=lagrangian.multipliers())


def _damped(
    run: SolveRun, lagrangian: "AugmentedLagrangian", unconstrained: RunResult | None, undamped: RunResult
) -> RunResult:
    """The safeguard: from the plan without constraints, or the last plan with constraints, whichever is better."""
    work = run.work
    plans = [(work.last, undamped.cost)]
    plans += [(unconstrained.plan, unconstrained.cost)] if unconstrained is not None else []
    plans = [(plan, cost) for plan, cost in plans if np.isfinite(cost)]
    if not plans:
        return undamped
    lagrangian.evaluate(plans[-1][0])
    lagrangian.begin()
    merits = []
    for plan, cost in plans:
        lagrangian.evaluate(plan)
        merits.append(cost + lagrangian.added())
    plan, cost = plans[int(np.argmin(merits))]
    work.set_best(plan, cost)
    return _rounds(run, lagrangian, "the undamped method failed with the constraints")


def damped_to_end(run: SolveRun) -> RunResult:
    """Run to the end, only by steps that lower the cost, from the rollout of the first policy; certified.

    The plan thus stays in its homotopy class, which undamped iterations would leave.
    """
    run.roll_out()
    optimality = run.linearize_about_plan() if np.isfinite(run.work.cost) else np.nan
    if not np.isfinite(optimality):
        return certified(run, run.run_to_end())
    if not run.problem.constraints:
        if not run.method.exact:
            damped = run.damped()
        else:
            with run.budget.limited(REFINED):
                damped = run.damped()
            if not run.budget.over:
                return certified(run, run.newton(patient=True))
        return certified(run, run.damped_result(damped, damped.status, damped.detail(run.problem.steps)))
    lagrangian = AugmentedLagrangian(run)
    lagrangian.evaluate(run.work.best)
    lagrangian.begin()
    return certified(run, _rounds(run, lagrangian, ""))


def _rounds(run: SolveRun, lagrangian: "AugmentedLagrangian", why: str) -> RunResult:
    """Damped iterations from the plan in the memory and updates of the multipliers, until the constraints are met."""
    work, budget = run.work, run.budget
    lagrangian.evaluate(work.best)
    rounds, rough = 0, True
    while True:
        rounds += 1
        run.weigh_noise(work.best)
        # Until the multipliers are approximately right, an accurate minimum is not worth its time.
        ending = run.damped(added=lagrangian.added(), least=(ROUGH, ROUGHEST_GAP) if rough else (0.0, 0.0))
        lagrangian.evaluate(work.best)
        if ending.success and lagrangian.solved:
            if not rough:
                result = run.damped_result(ending, ending.status, why)
                return replace(result, multipliers=lagrangian.multipliers())
            if not budget.over:
                rough = False
                continue
        if rounds == ROUNDS or lagrangian.grown > LARGEST or lagrangian.stuck == STUCK or budget.over:
            break
        lagrangian.update()
        rough = rough and lagrangian.stuck == 0 and not lagrangian.nearly
    status, detail = Status.MAX_ITERATIONS, joined(why, lagrangian.worst())
    missed = not lagrangian.kept and not lagrangian.nearly
    stuck = missed and (lagrangian.stuck == STUCK or lagrangian.grown > LARGEST)
    if stuck:
        status, detail = Status.STALLED, lagrangian.worst()
    if budget.stop.due:
        status = Status.TIME_LIMIT
    result = run.damped_result(ending, status, detail)
    return replace(result, multipliers=lagrangian.multipliers(), stuck=stuck and not budget.stop.due)


def _forces(multipliers: ConstraintMultipliers, values: Array) -> Array:
    """The new multipliers: lambda - mu d, at most the price in size, not below 0 for inequalities; 0 if inactive."""
    acting = np.where(np.isinf(values), 0.0, values)
    least = -multipliers.price if multipliers.term.equality else 0.0
    forces = np.clip(multipliers.values - multipliers.penalty * acting, least, multipliers.price)
    return np.where(np.isinf(values), 0.0, forces)


def _missed(multipliers: ConstraintMultipliers, values: Array) -> float:
    """The largest violation of a constraint, or error of an inequality's multipliers."""
    if multipliers.term.equality:
        return float(np.abs(values).max(initial=0.0))
    forces = multipliers.values / multipliers.penalty if multipliers.penalty > 0 else 0.0
    return float(np.abs(np.minimum(values, forces)).max(initial=0.0))


class AugmentedLagrangian:
    """The multipliers of all constraints, in the memory that the compiled loops read.

    Inequalities and equalities each have a tolerance, and their penalties grow on their own.

    Attributes:
      kept: whether the last evaluated plan satisfies the constraints.
      solved: whether it meets the aims: inequalities hold with the tolerance as a margin; if the margin is larger, the
        error of the multiplier is within the tolerance, `|min(d, lambda / mu)|`; equalities hold, `|d|`.
      nearly: whether it would meet them if equalities had the tolerance of inequalities.
      grown: factor by which a penalty has grown. stuck: number of times in a row that this did not help.
    """

    def __init__(self, run: SolveRun) -> None:
        self._problem, self._work, self._constraints = run.problem, run.work, run.work.multipliers
        self._allowed = tolerance = run.method.violation
        # The tolerances of inequalities and of equalities, if there are any.
        terms = run.problem.constraint_terms
        self._tolerance = {term.equality: allowed_violation(term, tolerance) or tolerance for term in terms}
        self.kept = self.solved = self.nearly = False
        self._restart()
        # Zero, except for multipliers of another solution.
        self._initial = [multipliers.penalty for multipliers in self._constraints]

    def _restart(self) -> None:
        self._grown, self._missed = dict.fromkeys(self._tolerance, 1.0), dict.fromkeys(self._tolerance, np.inf)
        self.stuck = 0

    @property
    def grown(self) -> float:
        return max(self._grown.values())

    def evaluate(self, plan: Motion) -> None:
        self._plan, stated = plan, self._work.constraint_values(plan)
        self.kept, self._values, excess = self._work.keeps(plan), list[Array](), [0.0]
        for multipliers, values in zip(self._constraints, stated, strict=True):
            self._values.append(values.ravel() - multipliers.margin)
            excess.append(violation_of(multipliers.term, values) - multipliers.term.equality * self._allowed)
        self.nearly = not self.kept and max(excess) <= 0
        self.solved = all(
            _missed(multipliers, values) <= self._tolerance[multipliers.term.equality]
            for multipliers, values in self._each()
        )

    def begin(self) -> None:
        """Begin with zero multipliers, and with penalties that fit the cost of changing each constraint."""
        self._restart()
        for which, (multipliers, values) in enumerate(self._each()):
            multipliers.values[...] = 0.0
            if not self._initial[which] > 0:
                # This comes last: once a penalty is set, the curvature of the passes contains it.
                self._initial[which] = INITIAL * self._stiffness(which) if len(values) else 1.0
            multipliers.penalty = self._initial[which]

    def update(self, growth: float = GROWTH) -> None:
        """Set the multipliers to the forces. Increase the penalties of constraints for which this helps too little."""
        missed = dict.fromkeys(self._tolerance, -np.inf)
        for multipliers, values in self._each():
            multipliers.values[...] = _forces(multipliers, values)
            short = np.abs(values).max(initial=0.0) if multipliers.term.equality else -values.min(initial=np.inf)
            missed[multipliers.term.equality] = max(missed[multipliers.term.equality], short)
        worst = max(missed, key=lambda equality: missed[equality])
        # Equalities that nearly hold can be met: they need a better inner minimum, not a larger penalty.
        near = {equality: equality and short <= self._allowed for equality, short in missed.items()}
        self.stuck = self.stuck + 1 if missed[worst] > 0.9 * self._missed[worst] and not near[worst] else 0
        for equality, tolerance in self._tolerance.items():
            more = growth * self._grown[equality] <= LARGEST or not near[equality]
            if more and missed[equality] > max(0.5 * self._missed[equality], tolerance):
                self._grown[equality] *= growth
                for multipliers in self._constraints:
                    multipliers.penalty *= growth if multipliers.term.equality == equality else 1.0
        self._missed = missed

    def added(self) -> float:
        """The augmented Lagrangian's terms in the cost of the plan."""
        added = 0.0
        for multipliers, values in self._each():
            known, penalty, forces = multipliers.values, multipliers.penalty, _forces(multipliers, values)
            acting = np.where(np.isinf(values), 0.0, values)
            added += float((forces @ (2 * (known - penalty * acting) - forces) - known @ known) / (2 * penalty))
        return added

    def multipliers(self) -> tuple[Multipliers, ...]:
        """The multipliers for a solution, updated for the last plan."""
        rows = self._problem.steps + 1, -1
        return tuple(
            Multipliers(_forces(multipliers, values).reshape(rows), multipliers.penalty)
            for multipliers, values in self._each()
        )

    def worst(self) -> str:
        """A text that names the worst violated constraint, its violation and its time."""
        missed = [
            (np.abs(values) if multipliers.term.equality else -(values + multipliers.margin)).max(initial=-np.inf)
            for multipliers, values in self._each()
        ]
        excess = [
            violation - allowed_violation(multipliers.term, self._allowed)
            for violation, multipliers in zip(missed, self._constraints, strict=True)
        ]
        if self.kept and (not self._work.priced or not max(excess, default=0.0) > 0):
            return "the plan keeps the constraints, but there are better ones"
        which = int(np.argmax(excess))
        term, (step, row) = self._constraints[which].term, self._worst_of(which)
        time = step * self._problem.dt
        return f"{term.describe(row)} is missed by {missed[which]:.2g} at {time:.2f} s (step {step})"

    def _each(self) -> Iterator[tuple[ConstraintMultipliers, Array]]:
        """For each constraint, its multipliers, and its values relative to the target."""
        return zip(self._constraints, self._values, strict=True)

    def _worst_of(self, which: int) -> tuple[int, int]:
        """Step and row of a constraint's worst violation: the first of several equal; for an equality, the last."""
        values, term = self._values[which], self._constraints[which].term
        worst = len(values) - 1 - int(np.abs(values[::-1]).argmax()) if term.equality else int(values.argmin())
        return divmod(worst, term.rows)

    def _stiffness(self, which: int) -> float:
        """The cost of changing the worst violation of a constraint; of an equality, the largest of all its rows there.

        That is twice the total cost of a change by 1 unit, `1 / n' (S + Sbar)^-1 n` for the entry's slope n: the
        curvature of the total cost if the rest of the trajectory adapts.
        """
        term, (step, worst) = self._constraints[which].term, self._worst_of(which)
        states, controls = self._plan
        n, control = states.shape[1], min(step, len(controls) - 1)
        values = self._work.value_functions()
        go, come = values["cost_to_go"], values["cost_to_come"]
        try:
            if isinstance(come, Moments):
                covariance = np.linalg.solve(
                    np.eye(n) + come.covariance[step] @ go.hessian[step], come.covariance[step]
                )
            else:
                covariance = np.linalg.inv(go.hessian[step] + come.hessian[step])
        except np.linalg.LinAlgError:
            return 1.0
        gain = self._work.arrays.policy.gain[control]
        joint = np.block([[covariance, covariance @ gain.T], [gain @ covariance, gain @ covariance @ gain.T]])
        costs = []
        for row in range(term.rows) if term.equality else (worst,):
            slope = self._work.constraint_slope(which, row, states[step], controls[control], step)
            response = float(slope @ joint @ slope)
            costs.append(1 / response if response > 0 else 1.0)
        return max(costs)

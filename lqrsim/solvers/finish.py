"""From one start to the end: the methods that finish a run, and the order in which they are tried.

`finish` certifies each result. Without constraints, that is what `SolveRun.run_to_end` leads to by smoothing and
Newton's method; the interior point comes before if controls stay at their limits, and after if all else fails. With
constraints, the interior point begins from one plan after another (`ConstrainedRun`). If none of them leads to an
optimum, the plan that violates the constraints least is the answer. It is INFEASIBLE if two starts lead to plans whose
violation is stationary and equally large. With the augmented Lagrangian (`augmented_lagrangian.py`), the evidence is a
violation that does not fall while the penalty grows.

A plan of the interior point that converges is a minimum of the augmented Lagrangian with the multipliers found.
Newton's method on that function finishes the plan. This puts controls exactly at their limits, and gives a policy and
value functions. Any other plan is rolled out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.active_set import AT_LIMIT, FIRMNESS
from lqrsim.kernels.interior_point import FLAT_BEFORE_END, FLAT_COST
from lqrsim.kernels.records import Motion, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Multipliers, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian, by_multipliers, damped_to_end, meet_constraints
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.certify import certified
from lqrsim.solvers.engine import RunResult, SolveRun, copied
from lqrsim.solvers.stages import NAME, STRONG, WEAK, Barrier, InteriorPoint, InteriorResult, Measures, Sizes, restore

OPENING = 6  # iterations of smoothing before constraints, or limits that controls press against, act
MOST = 300  # largest number of iterations from one plan
FAINT = 1e-9  # factor by which penalties are smaller where a plan ends inside: its certificate is that of multipliers
# What is said where the cost no longer changes, and the gradient does not vanish.
KINKED = (
    "the derivatives of the dynamics jump along the plan, as by dry friction, at a contact, at a joint's limit or in a"
    f" medium at rest, where no gradient vanishes; the cost has not changed by {FLAT_COST:g} of itself in"
    f" {FLAT_BEFORE_END} iterations, but plans beside it may cost less"
)
UNSETTLED = (
    "no gradient vanishes along the plan, as where a flat side of the robot lies along an obstacle and the derivatives"
    f" of a distance jump; from two plans the search ended at costs within {FLAT_COST:g} of each other, but plans"
    " beside them may cost less"
)
# Distance from the plan at which derivatives are compared, relative to sizes of states and controls; and the difference
# that is a jump, relative to the largest derivative: along arms without dry friction it is 1e-5 to 1e-4.
BESIDE, JUMP = 1e-4, 3e-3
UPDATES = 5  # largest number of updates of the multipliers, if Newton's last steps violate constraints

EVIDENT = 100.0  # a violation above this many tolerances may be evidence that the constraints are infeasible
# Iterations of the augmented Lagrangian: from the plan of smoothing; undamped iterations without progress among these;
# and damped iterations from a plan of the search, which creep along a wall's corner to optima that cost less.
AUGMENTED, STALE, REFINED = 50, 25, 100
DEEP = 0.03  # largest violation by the plan of smoothing with which the interior point begins, relative to a row's size
# Iterations in which stationarity has no new least value that end an interior point without second derivatives. In 12
# problems of arms among posts, runs that converged soon had at most 2 in a row; others took 50 to 100 or failed.
TROUBLED = 4
GUIDED = 60  # iterations of smoothing before constraints act, with an ObstacleCost
RESTORED = 150  # iterations of a descent at one price
PRICES = (1e2, 1e4)  # prices of violating a constraint by its typical size, relative to the cost
STARTS, ALIKE = 2, 0.05  # starts that must lead to equal violations, and relative difference up to which they are equal
STATIONARY = 5e-3  # largest remaining gradient, relative to the gradients that cancel
NEAR_LIMIT = 1e-4  # distance from a limit, relative to the range, that a barrier may leave
NAMED = 3  # largest number of constraints that a message names in addition to the most violated constraint


@dataclass(eq=False)
class Known:
    """Results that the runs of one search share."""

    evidence: list[RunResult] = field(default_factory=list)  # plans whose violation is stationary
    from_start: bool = False  # whether the start itself was tried
    rows: Array | None = None  # (R,) typical sizes of the constraint rows, in which violations are measured


def finish(run: SolveRun, known: Known) -> RunResult:
    """Run from one start to the end; certified. `known` has the results of other runs of the same problem."""
    if run.initial_guess.interior is not None or run.method.interior:
        return ConstrainedRun(run, known).run_to_end()
    if not run.problem.constraints:
        space = run.problem.control_coordinates
        limited = np.isfinite([space.low, space.high]).any() and run.method.exact and run.problem.noise_term is None
        return certified(run, _within_limits(run) if limited else run.run_to_end())
    result = by_multipliers(run)
    # It begins with the optimum without the constraints, which is often the same from all starts, so they count as one.
    if result.stuck and not known.evidence:
        known.evidence.append(replace(result, missed=result.violation))
    return result


def refine(run: SolveRun, known: Known) -> RunResult:
    """Run to the end from the rollout of the first policy, on the same side of the obstacles; certified."""
    if run.method.interior:
        return ConstrainedRun(run, known, stay=True).run_to_end()
    result = damped_to_end(run)
    if not result.stuck:
        return result
    result = replace(result, missed=result.violation)
    known.evidence.append(result)
    return replace(result, status=Status.INFEASIBLE) if result in _alike(known.evidence) else result


def from_states(run: SolveRun, known: Known) -> RunResult:
    """The certified result of the interior point from the trajectory of a start, whatever its rollout does."""
    assert run.initial_guess.trajectory is not None
    point = InteriorRun(run)
    result = point.run_from(copied(run.initial_guess.trajectory), STRONG)
    return certified(run, point.initial_rollout() if result is None else result)


def from_beside(run: SolveRun, known: Known, plan: Trajectory, saddle: RunResult) -> RunResult | None:
    """The certified result from a plan beside a saddle, which costs less; None if it leads back there."""
    point = InteriorRun(run)
    if run.problem.constraints:
        for barrier in WEAK, STRONG:
            result = point.run_from(copied(plan), barrier)
            if result is not None and result.success:
                return certified(run, result)
        return None
    policy = compiled.policy_about(plan.states, plan.controls, saddle.policy.gain)
    beside = point.result(compiled.rollout(run.problem, *policy, plan.states[0].copy()))
    if not beside.cost < saddle.cost:
        return None
    run.work.set_best(beside.plan, beside.cost)
    return certified(run, run.newton(patient=True))


def _within_limits(run: SolveRun) -> RunResult:
    """Smoothing and Newton's method. The interior point if controls stay at their limits, or all else fails."""
    budget, space, point = run.budget, run.problem.control_coordinates, InteriorRun(run)
    run.smooth(OPENING)
    controls = run.work.best.controls
    pressed = ((controls <= space.low) | (controls >= space.high)).any()
    if run.ending.outcome == declarations.RUNNING and pressed and np.isfinite(run.cost):
        run.set_aside()
        result = point.run_from(copied(run.work.best), STRONG)
        if result is not None and result.success:
            return result
        run.resume()
    result = run.run_to_end()
    if result.success or budget.stop.due or budget.left < 2:
        return result
    result = result.kept()
    other = point.run_from(copied(run.work.best if np.isfinite(result.cost) else point.initial_rollout()), STRONG)
    if other is None or other.success or not other.cost < result.cost:
        return other if other is not None and other.success else result
    other = other.kept()
    if budget.over:
        return replace(other, status=result.status, detail=result.detail)
    run.work.set_best(other.plan, other.cost)
    return run.newton(detail=result.detail, patient=True)


class InteriorRun:
    """The interior point for the problem of a run."""

    idle = False  # without second derivatives, whether the last plan did not press against any constraint
    _flat: RunResult | None = None  # the last result where the cost no longer changed

    def __init__(self, run: SolveRun) -> None:
        self._run, self._problem, self._budget, self._allowed = run, run.problem, run.budget, run.method.violation
        self._curved = run.method.curved

    def run_from(
        self, plan: Motion, barrier: Barrier, *, multipliers: tuple[Array, ...] = (), stale: int | None = None
    ) -> RunResult | None:
        """The result from a plan, or None; `stale` iterations without a new least stationarity end it."""
        budget, run, result = self._budget, self._run, None
        if budget.left < 2 or budget.stop.due:
            return None
        least, since = np.inf, 0

        def over(measures: Measures, _: float) -> bool:
            nonlocal least, since
            since = 0 if measures.stationarity < least else since + 1
            least = min(least, measures.stationarity)
            return budget.stop.due or since == stale

        with budget.stop.heeding():
            point = InteriorPoint(run.stages, plan, barrier, price=run.method.price, multipliers=multipliers)
            result = point.run(
                tolerance=run.method.tolerance, violation=self._allowed, most=min(MOST, budget.left - 1),
                near=barrier is WEAK, laps=Laps(budget), over=over, hurried=budget.hurried,
            )  # fmt: skip
        return None if result is None else self.result_from(result)

    def result_from(self, interior: InteriorResult) -> RunResult | None:
        """Make a result from a plan: by Newton's method if converged, else by a rollout. None if it is not finite."""
        if not np.isfinite(interior.plan.states).all():
            return None
        self.idle = not self._curved and self._is_idle(interior)
        if interior.solved and (result := self._polished(interior)) is not None and result.success:
            return result
        return self._rolled_out(interior)

    def _rolled_out(self, interior: InteriorResult) -> RunResult:
        """The result from a plan that has not converged, or whose cost no longer changes."""
        # The rollout with gains about the plan, or without gains if this violates the constraints less.
        plan, gain = interior.plan, interior.gain
        policies = [compiled.policy_about(*plan, gains) for gains in (gain, np.zeros_like(gain))]
        candidates = (self.result(self._run.work.roll_out(policy, plan.states[0]), policy) for policy in policies)
        result = min(candidates, key=lambda result: (not np.isfinite(result.cost), result.violation, result.cost))
        if not interior.flat or result.violation > self._allowed:
            return result
        detail = KINKED if self._jumps(interior) else ""
        if self._flat is not None and abs(self._flat.cost - result.cost) <= FLAT_COST * abs(result.cost):
            result, detail = min(self._flat, result, key=lambda flat: flat.cost), detail or UNSETTLED
        self._flat = result.kept()
        if detail:
            interior.measures._replace(cost=result.cost, gap=0.0, violation=result.violation).record(Laps(self._budget))
            result = replace(result, status=Status.COST_CONVERGED, detail=detail)
        return result

    def _is_idle(self, interior: InteriorResult) -> bool:
        """Whether the multipliers of all constraints are remnants of the barrier."""
        stages = self._run.stages
        acting = stages.live & (stages.owners >= 0)
        force = stages.of_constraints(interior.multipliers)
        sizes = np.broadcast_to(interior.sizes.rows**2 / interior.scale, force.shape)  # infinite far from all obstacles
        force = np.multiply(force, sizes, out=np.zeros(force.shape), where=force != 0)
        return bool((~stages.equality & (force < stages.values(interior.plan)))[acting].all())

    def _jumps(self, interior: InteriorResult) -> bool:
        """Whether derivatives of the dynamics differ beside the plan by more than they do where they are smooth."""
        dynamics, dt, draws = self._problem.dynamics, self._problem.dt, np.random.default_rng(0)

        def perturbed(numbers: Array, size: Array) -> Array:
            return numbers + BESIDE * size * draws.choice([-1.0, 1.0], len(numbers))

        for x, u in zip(interior.plan.states[:-1], interior.plan.controls, strict=True):
            here = np.hstack(dynamics.linearize(x, u, dt)[:2])
            beside = perturbed(x, interior.sizes.states), perturbed(u, interior.sizes.controls)
            if np.abs(np.hstack(dynamics.linearize(*beside, dt)[:2]) - here).max() > JUMP * np.abs(here).max():
                return True
        return False

    def initial_rollout(self) -> RunResult:
        """The rollout of the initial policy."""
        policy = Policy(self._run.initial_guess.gain, self._run.initial_guess.offset)
        return self.result(self._run.work.roll_out(policy, self._run.work.start), policy)

    def result(self, plan: Motion, policy: Policy | None = None) -> RunResult:
        """The result for a plan that has not converged; without a policy, its controls are applied without feedback."""
        if policy is None:
            policy = Policy(np.zeros((*plan.controls.shape, plan.states.shape[1])), plan.controls)
        cost, _ = self._run.stages.trial(plan)
        work = self._run.work
        violation = work.violation_of(plan) if np.isfinite(plan.states).all() else np.inf
        cost = cost if np.isfinite(cost) else np.inf
        return RunResult(status=Status.MAX_ITERATIONS, plan=plan, policy=policy, cost=cost, violation=violation)

    def without_multipliers(self) -> None:
        for multipliers in self._run.work.multipliers:
            multipliers.penalty, multipliers.values[...] = 0.0, 0.0

    def _polished(self, interior: InteriorResult) -> RunResult | None:
        """Finish a converged plan by Newton's method; None if its rollout is not finite."""
        work = self._run.work
        policy = compiled.policy_about(interior.plan.states, *self._at_limits(interior))
        plan = work.roll_out(policy, interior.plan.states[0])
        if not np.isfinite(plan.states).all():
            return None
        self._set_multipliers(interior, work.constraint_values(plan), FIRMNESS)
        work.set_best(plan, cost := self._run.stages.trial(plan)[0])
        lagrangian = AugmentedLagrangian(self._run)
        lagrangian.evaluate(work.best)
        with self._budget.joined_with_last(NAME):
            result = None
            for updates in range(1 + UPDATES if self._curved else 0):
                if updates:
                    lagrangian.update(growth=1.0)
                result = self._run.newton(added=lagrangian.added(), least=interior.scale)
                lagrangian.evaluate(result.plan)
                if lagrangian.kept or not result.success:
                    break
            # Newton's method may fail where no other plan takes as little time.
            if result is None or not (result.success and lagrangian.kept):
                work.set_best(plan, cost)
                result = self._ended_inside(lagrangian, interior)
        detail = ""
        if self._run.settings.elastic is not None and result.violation > self._allowed:
            detail = f"elastic: {lagrangian.worst()}"
        result = replace(result, detail=detail, multipliers=self._pressing(lagrangian, interior, result))
        if result.success and lagrangian.kept:
            return result
        self.without_multipliers()
        return replace(result, status=Status.MAX_ITERATIONS)

    def _ended_inside(self, lagrangian: AugmentedLagrangian, interior: InteriorResult) -> RunResult:
        """The plan in memory as it is: without second derivatives, the interior point ends inside the constraints.

        Penalties give the policy its gains across rows that press. The certificate is that of the multipliers alone.
        """
        work, laps = self._run.work, Laps(self._budget)
        result = self._run.about_plan(Status.CONVERGED)
        self._set_multipliers(interior, work.constraint_values(work.best), FAINT * FIRMNESS)
        lagrangian.evaluate(work.best)
        interior.measures._replace(cost=work.cost, gap=0.0, violation=result.violation).record(laps)
        return result

    def _at_limits(self, interior: InteriorResult) -> tuple[Array, Array]:
        """Controls and gains of a converged plan, with controls that press against a limit moved to the limit."""
        controls, gain = interior.plan.controls.copy(), interior.gain.copy()
        for side, sign in ((self._run.stages.low, -1.0), (self._run.stages.high, 1.0)):
            distance = np.abs(side - controls) / interior.sizes.controls
            force = sign * interior.pressing * interior.sizes.controls / interior.scale
            pressed = (distance < AT_LIMIT) & (force > distance)
            controls = np.where(pressed, side, controls)
            gain[pressed] = 0.0
        return controls, gain

    def _set_multipliers(self, interior: InteriorResult, values: list[Array], firmness: float) -> None:
        """Choose multipliers with which the augmented Lagrangian has the interior point's forces at these values."""
        triples = zip(self._run.work.multipliers, interior.multipliers, values, strict=True)
        for k, (record, known, numbers) in enumerate(triples):
            size = interior.sizes.rows[self._run.stages.owners == k]
            record.penalty = firmness * interior.scale / max(float(np.median(size**2)), 1e-300) if len(size) else 1.0
            force = known + record.penalty * np.where(np.isfinite(numbers), numbers - record.margin, 0.0)
            presses = known > record.penalty * (numbers - record.margin)  # other forces are remnants of the barrier
            acts = np.isfinite(numbers) & (record.term.equality | presses)
            record.values[...] = np.where(acts, force, 0.0).ravel()

    def _pressing(
        self, lagrangian: AugmentedLagrangian, interior: InteriorResult, result: RunResult
    ) -> tuple[Multipliers, ...]:
        """The multipliers; zero for rows whose margin exceeds their force, which is a remnant of the barrier."""
        values = self._run.work.constraint_values(result.plan)
        multipliers = []
        for k, updated in enumerate(lagrangian.multipliers()):
            size = interior.sizes.rows[self._run.stages.owners == k]
            idle = updated.values * size / interior.scale < values[k] / size
            idle &= not self._problem.constraint_terms[k].equality
            multipliers.append(replace(updated, values=np.where(idle, 0.0, updated.values)))
        return tuple(multipliers)


class ConstrainedRun(InteriorRun):
    """Tries plans, with `stay` only from the rollout of the first policy, until the interior point converges."""

    def __init__(self, run: SolveRun, known: Known, *, stay: bool = False) -> None:
        super().__init__(run)
        self._known, self._guess, self._stay = known, run.initial_guess, stay
        self._budget.log[:0] = run.initial_guess.log
        self._best: RunResult | None = None
        self._smoothed: Motion | None = None  # the plan of smoothing without the constraints, once it is known
        # With an ObstacleCost, smoothing chooses the side on which obstacles are passed.
        self._guided = any(cost.contact_curvature for cost in run.problem.obstacle_costs)
        self._elastic = run.settings.elastic is not None
        if run.settings.penalty is None:
            self.without_multipliers()
        self._initial = self.initial_rollout()
        self._keeps_start = self._guess.trajectory is not None or bool(self._guess.gain.any()) or stay
        feasible = (self._keeps_start or run.settings.start is not None) and self._initial.violation <= self._allowed
        self._given = self._initial if feasible else None  # the answer must not be worse
        self._untried = stay or not known.from_start  # the runs of a search have the same start

    def run_to_end(self) -> RunResult:
        """Make the attempts in turn, until one converges to a plan that is no worse than a given one."""
        for result in self._attempts():
            self._remember(result)
            if result is not None and result.success:
                if not self._worse(result):
                    break
                self._best = None  # the given plan is better
            if self._budget.over:
                break
        return self._answer()

    def _attempts(self) -> Iterator[RunResult | None]:
        """The results of the attempts, each of which is made when it is asked for; None if it has none."""
        run, budget, start, hard = self._run, self._budget, self._initial, not self._elastic
        from_start, multipliers = self._untried, tuple(record.values for record in self._guess.multipliers)
        if self._guess.interior is not None:  # of the search for a free duration: it is only finished
            yield self.result_from(self._guess.interior)
        if budget.over:
            return
        if any(values.any() for values in multipliers):  # the plan of another solution, with its multipliers
            yield self.run_from(copied(start), WEAK, multipliers=multipliers)
        if self._stay and self._guided:
            with budget.limited(REFINED):
                result = damped_to_end(run)
            yield self._after_multipliers(result)
        if self._keeps_start:  # a trajectory or a policy that the caller gave
            yield self._from_given()
        if not self._stay:
            yield self._from_valley()
        # Where the cost has kinks, as where a flat side of the robot lies along an obstacle, the interior point's
        # measures do not vanish.
        if not (self._converged or self._curved) and self.idle:
            yield self._from_best_without_constraints()
        if self._smoothed is not None and hard:
            if self._guided:
                yield self._from_multipliers()
            yield self._at_a_price(self._smoothed)
        if self._untried:
            yield self._from_start()
        if from_start and hard:
            self._known.from_start = True
            yield self._at_a_price(copied(start))
        if hard and not (self._converged or self._curved):
            self.without_multipliers()
            result = by_multipliers(run)
            yield result if result.success else None
        if not self._converged:
            yield self._from_best_without_constraints()

    @property
    def _converged(self) -> bool:
        return self._best is not None and self._best.success

    def _from_given(self) -> RunResult | None:
        # A sketch of a path is not near the answer, even if standing still keeps the constraints.
        begin = self._guess.trajectory or self._initial
        near = self._initial.violation <= self._allowed and np.allclose(begin.states, self._initial.states)
        self._untried &= near or not np.array_equal(begin.states, self._initial.states)
        return self.run_from(copied(begin), WEAK if near else STRONG)

    def _from_best_without_constraints(self) -> RunResult | None:
        """From the best plan, by Newton's method without the constraints: they may not act at the optimum.

        Then the tolerance is that of the problem without them.
        """
        best, run = self._best, self._run
        if best is None or not best.violation <= self._allowed or not np.isfinite(best.cost):
            return None
        best = best.kept()
        self.without_multipliers()
        run.work.set_best(best.plan, best.cost)
        method, alone = run.method, run.settings.method(self._problem.with_constraints([]))
        run.method = method._replace(tolerance=alone.tolerance)
        result = run.newton(detail=best.detail, patient=True)
        if not result.success or result.violation > 0:
            run.method = method
            return None
        return replace(result, multipliers=())

    def _from_valley(self) -> RunResult | None:
        run = self._run
        run.smooth(GUIDED if self._guided else OPENING)
        ending = run.checked_ending()
        converged = ending.success or ending.outcome == declarations.IN_VALLEY
        plan = run.work.arrays.last if converged else run.work.best  # the plan of least cost so far
        if ending is not run.ending or not np.isfinite(run.work.cost):
            return None
        self._smoothed = copied(plan)
        if self._budget.stop.due:
            return None
        if ending.success and not self._budget.log[-1].violation:
            return run.result(ending)
        if ending.outcome != declarations.IN_VALLEY or (not self._guided and self._budget.log[-1].violation):
            # If the augmented Lagrangian method follows, it does better than an interior point that lacks curvature.
            return self.run_from(self._smoothed, STRONG, stale=TROUBLED if self._guided and not self._curved else None)
        # If the optimum without constraints keeps them, it is the answer; with an ObstacleCost it is next to the
        # answer.
        run.set_aside()
        result = run.newton()
        if result.success and result.violation == 0:
            return result
        bottom = copied(result) if result.success else self._smoothed
        run.resume()
        if self._budget.stop.due:
            return None
        if not self._guided:
            return self.run_from(bottom, STRONG)
        stages = run.stages
        sizes, numbers = stages.sizes(bottom).rows, stages.values(bottom)
        missed = np.where(stages.equality, np.abs(numbers), -numbers) / sizes
        if (missed[stages.live & (stages.owners >= 0)] > DEEP).any():
            return None  # deep in an obstacle, the interior point stalls, but the augmented Lagrangian method moves out
        return self.run_from(bottom, WEAK)

    def _from_start(self) -> RunResult | None:
        self._untried = False
        return self.run_from(copied(self._initial), STRONG)

    def _from_multipliers(self) -> RunResult | None:
        """From the plan of the augmented Lagrangian, which stays near the local optimum that smoothing has chosen.

        If that plan costs more than the start, the method has diverged.
        """
        run = self._run
        with self._budget.limited(AUGMENTED):
            result = meet_constraints(run, run.result(run.ending), stale=STALE)
        if result.success and not self._curved:
            return certified(run, result)
        return self._after_multipliers(result, most=self._initial.cost)

    def _after_multipliers(self, result: RunResult, *, most: float = np.inf) -> RunResult | None:
        """The interior point from the last plan of the method of multipliers, unless it costs more than `most`."""
        plan = copied(result)
        self.without_multipliers()
        usable = np.isfinite(result.cost) and result.cost <= most and np.isfinite(plan.states).all()
        if self._budget.stop.due or not usable:
            return None
        return self.run_from(plan, WEAK)

    def _at_a_price(self, plan: Motion) -> RunResult | None:
        """From the plan of a descent in which constraints may be violated at a price.

        If the descent makes no progress at one price, a start that keeps the constraints, such as standing still, is
        tried before the next price.
        """
        run, budget = self._run, self._budget

        def is_stationary(plan: Motion, shares: list[Array], sizes: Sizes) -> bool:
            """Whether the violation of a plan is; if so, the plan is kept as evidence."""
            result = self.result(plan)
            new = _evidence(run, result, shares, sizes) if result.violation > EVIDENT * self._allowed else None
            self._known.evidence += [] if new is None else [new]
            return new is not None

        for price in PRICES:
            sizes, priced = run.stages.sizes(plan), None
            if self._known.rows is None:
                self._known.rows = sizes.rows
            sizes = sizes._replace(rows=self._known.rows)
            if budget.left < 2 or budget.stop.due:
                return None
            with budget.stop.heeding():
                priced = restore(
                    run.stages, plan, sizes, price=price, most=min(RESTORED, budget.left - 1), laps=Laps(budget),
                    over=lambda: budget.stop.due, hurried=budget.hurried,
                    stationary=partial(is_stationary, sizes=sizes),
                )  # fmt: skip
            if priced is None:
                return None
            plan = priced.plan
            self._remember(self.result(plan))
            if priced.violation_stationary:
                return None
            if priced.nearly_feasible or price == PRICES[-1]:
                result = self.run_from(plan, STRONG)
            elif self._untried and self._initial.violation <= self._allowed:
                result = self._from_start()
            else:
                continue
            if result is not None and result.success:
                return result
            self._remember(result)
        return None

    def _remember(self, result: RunResult | None) -> None:
        if result is not None and (self._best is None or result.rank < self._best.rank):
            self._best = result.kept()

    def _worse(self, result: RunResult) -> bool:
        """Whether a plan costs more than the given one, which keeps the constraints, by more than rounding."""
        return self._given is not None and result.costs_more(self._given, self._run.work)

    def _answer(self) -> RunResult:
        """The best result, certified."""
        run = self._run
        best = self._initial if self._best is None else self._best
        priced = self._elastic and best.success
        if self._given is not None and not priced and (best.violation > self._allowed or self._worse(best)):
            best = self._given
        if not best.success and self._problem.constraints:
            best = self._failed(best)
        return best if best.certificate is not None else certified(run, best)

    def _failed(self, best: RunResult) -> RunResult:
        """The best plan of a failure, or the one that proves it, with what it misses in words."""
        lagrangian = AugmentedLagrangian(self._run)
        lagrangian.evaluate(best.plan)
        status = Status.STALLED if self._budget.left > 1 else Status.MAX_ITERATIONS
        detail = lagrangian.worst()
        if best.violation > self._allowed and (same := _alike(self._known.evidence)):
            best = same[0]
            lagrangian.evaluate(best.plan)
            detail = lagrangian.worst()
            status = Status.INFEASIBLE
            others = [name for name in best.against if not detail.startswith(name.rsplit(" at ", 1)[0])][:NAMED]
            best = replace(best, against=tuple(others))
            detail += f"; against it stand {', '.join(others)}" if others else ""
        return replace(best, status=Status.TIME_LIMIT if self._budget.stop.due else status, detail=detail)


def _alike(cases: Sequence[RunResult]) -> list[RunResult]:
    """The evidence with equally small violations, the least first; empty unless it is from `STARTS` starts."""
    least = sorted(cases, key=lambda case: case.missed)
    same = [case for case in least if case.missed <= (1 + ALIKE) * least[0].missed]
    return same if len(same) >= STARTS else []


def _evidence(run: SolveRun, plan: RunResult, shares: list[Array], sizes: Sizes) -> RunResult | None:
    """A plan for the problem of a run with what it is evidence of, or None.

    The total violation, each row relative to its size, has a gradient in the controls. It is recomputed here from the
    problem's own functions, on a code path that the solvers do not use. Rows that are just satisfied balance the
    gradient with multipliers from 0 to 1, the `shares` (T+1, rows) that the restoration finds. Controls at their limits
    balance it by themselves. If the sum is zero, no plan nearby violates the constraints less.
    """
    problem = run.problem
    missed, slopes, alone, holding = _violation_slopes(run, plan, shares, sizes)
    if not missed > 0:
        return None
    left, size, pull, pressed = _balance(problem, plan, slopes, alone, sizes)
    if not left <= STATIONARY * size:
        return None
    if size > 0:
        forces = zip(problem.dynamics.control_coordinates.names, pressed.tolist(), strict=True)
        holding += [(force / size, f"the limits of {name}") for name, force in forces if force > 1e-2 * min(pull, size)]
    return replace(plan, missed=missed, against=tuple(name for _, name in sorted(holding, reverse=True)))


def _violation_slopes(
    run: SolveRun, plan: RunResult, shares: list[Array], sizes: Sizes
) -> tuple[float, Array, Array, list[tuple[float, str]]]:
    """The total violation, relative to the rows' sizes; its slopes (T+1, n+m) of all rows with their multipliers and of
    the violated rows alone; and the rows in words, each with its fraction.
    """
    problem, work, states, controls = run.problem, run.work, plan.states, plan.controls
    allowed = run.method.violation
    steps, joint = len(controls), states.shape[1] + controls.shape[1]
    slopes, alone, missed = np.zeros((steps + 1, joint)), np.zeros((steps + 1, joint)), 0.0
    holding: list[tuple[float, str]] = []
    for k, (term, numbers) in enumerate(zip(problem.constraint_terms, work.constraint_values(plan.plan), strict=True)):
        rows = sizes.rows[run.stages.owners == k]
        short = np.where(np.isfinite(numbers), np.abs(numbers) if term.equality else -numbers, 0.0)
        weights = np.where(short > allowed, 1.0, np.abs(shares[k])) * (np.sign(shares[k]) if term.equality else 1.0)
        weights[np.where(np.isfinite(numbers), numbers, np.inf) > 1e-2 * rows] *= term.equality
        for t, row in np.argwhere(np.abs(weights) > 1e-6):
            weight = weights[t, row] / rows[row]
            slope = weight * work.constraint_slope(k, int(row), states[t], controls[min(t, steps - 1)], int(t))
            slopes[t] -= slope
            if short[t, row] > allowed:
                alone[t] -= slope
                missed += float(short[t, row] / rows[row])
        for row in range(term.rows):
            excess = float(short[:, row].max())
            weight_of_row = 1 + excess / rows[row] if excess > allowed else float(np.abs(weights[:, row]).sum())
            if weight_of_row > 1e-2:
                t = int((short if excess > allowed else np.abs(weights))[:, row].argmax())
                shortfall = f", missed by {excess:.2g}" if excess > allowed else ""
                holding.append((weight_of_row, f"{term.describe(row)} at {t * problem.dt:.2f} s{shortfall}"))
    return missed, slopes, alone, holding


def _balance(
    problem: Problem, plan: RunResult, slopes: Array, alone: Array, sizes: Sizes
) -> tuple[float, float, float, Array]:
    """The largest remaining gradient in a control, the size of the cancelling ones, and (m,) the limits' part.

    The third number is the largest gradient of the violated rows alone. The size is above it by orders of magnitude if
    they depend on controls through states of other magnitudes only.
    """
    states, controls = plan.states, plan.controls
    steps, (n, m) = len(controls), (states.shape[1], controls.shape[1])
    space, state_size, control_size = problem.control_coordinates, sizes.states, sizes.controls
    low = controls <= space.low + NEAR_LIMIT * control_size
    high = controls >= space.high - NEAR_LIMIT * control_size
    total, size, pull, pressed = 0.0, 0.0, 0.0, np.zeros(m)
    costate, costate_alone = slopes[steps, :n], alone[steps, :n]
    for t in range(steps - 1, -1, -1):
        A, B, _ = problem.dynamics.linearize(states[t], controls[t], problem.dt)
        slope, of_missed = slopes[t, n:] + B.T @ costate, alone[t, n:] + B.T @ costate_alone
        free = ~((low[t] & (slope > 0)) | (high[t] & (slope < 0)))
        total = max(total, float((np.abs(slope) * control_size * free).max()))
        pressed = np.maximum(pressed, np.abs(slope) * control_size * ~free)
        reach = np.linalg.norm(B / state_size[:, None], axis=0) * control_size
        force = max(np.linalg.norm(costate * state_size), np.linalg.norm(costate_alone * state_size))
        pull = max(pull, float((np.abs(of_missed) * control_size).max()))
        size = max(size, pull, float(force * reach.max()))
        costate, costate_alone = slopes[t, :n] + A.T @ costate, alone[t, :n] + A.T @ costate_alone
    return total, size, pull, pressed

"""The interior point as part of a run: from a plan to a result with a policy, within the run's budget.

A plan that converges is a minimum of the augmented Lagrangian with the multipliers found. Newton's method on that
function finishes the plan. This puts controls exactly at their limits, and gives a policy and value functions. Any
other plan is rolled out.
"""

from dataclasses import replace

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.active_set import AT_LIMIT, FIRMNESS
from lqrsim.kernels.interior_point import FLAT_BEFORE_END, FLAT_COST
from lqrsim.kernels.records import Motion, Policy
from lqrsim.results.solution_parts import Multipliers, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.interior_point import NAME, WEAK, Barrier, InteriorPoint, InteriorResult, Measures
from lqrsim.solvers.settings import has_curvature

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


class InteriorRun:
    """The interior point for the problem of a run, and the tolerance of its constraints."""

    idle = False  # whether the last plan did not press against any constraint
    _flat: RunResult | None = None  # the last result where the cost no longer changed

    def __init__(self, run: SolveRun) -> None:
        self._run, self._problem, self._budget = run, run.problem, run.budget
        self.allowed = run.settings.violation_tolerance(run.problem)

    def run_from(
        self, plan: Motion, barrier: Barrier, *, multipliers: tuple[Array, ...] = (), stale: int | None = None
    ) -> RunResult | None:
        """The result from a plan, or None; `stale` iterations without a new least stationarity end it."""
        budget, run, result = self._budget, self._run, None
        if budget.left < 2 or budget.stop.due:
            return None
        laps, least, since = Laps(budget), np.inf, 0

        def watch(measures: Measures, seconds: float) -> bool:
            nonlocal least, since
            measures.record(laps, seconds=seconds)
            since = 0 if measures.stationarity < least else since + 1
            least = min(least, measures.stationarity)
            return budget.stop.due or since == stale

        with budget.stop.heeding():
            point = InteriorPoint(run.stages, plan, barrier, price=run.settings.price, multipliers=multipliers)
            result = point.run(
                tolerance=run.final, violation=self.allowed, most=min(MOST, budget.left - 1), near=barrier is WEAK,
                watch=watch, hurried=budget.hurried,
            )  # fmt: skip
        return None if result is None else self.finish(result)

    def finish(self, interior: InteriorResult) -> RunResult | None:
        """Make a result from a plan: by Newton's method if converged, else by a rollout. None if it is not finite."""
        if not np.isfinite(interior.plan.states).all():
            return None
        self.idle = self._is_idle(interior)
        if interior.solved and (result := self._polished(interior)) is not None and result.success:
            return result
        result = self._rolled_out(interior.plan, interior.gain)
        if not interior.flat or result.violation > self.allowed:
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

    def start(self) -> RunResult:
        """The rollout of the initial policy."""
        guess, start = self._run.initial_guess, self._run.work.start
        law = Policy(guess.gain, guess.offset)
        return self.result(self._run.work.roll_out(law, start), law)

    def result(self, plan: Motion, law: Policy | None = None) -> RunResult:
        """The result for a plan that has not converged; without a law, its controls are applied without feedback."""
        if law is None:
            law = Policy(np.zeros((*plan.controls.shape, plan.states.shape[1])), plan.controls)
        cost, _ = self._run.stages.trial(plan)
        work = self._run.work
        violation = work.violation(work.constraint_values(plan)) if np.isfinite(plan.states).all() else np.inf
        cost = cost if np.isfinite(cost) else np.inf
        return RunResult(status=Status.MAX_ITERATIONS, plan=plan, law=law, cost=cost, violation=violation)

    def without_multipliers(self) -> None:
        for multipliers in self._run.work.multipliers:
            multipliers.penalty, multipliers.values[...] = 0.0, 0.0

    def _rolled_out(self, plan: Motion, gain: Array) -> RunResult:
        """The rollout of a plan with gains about it, or without gains if this violates the constraints less."""
        laws = [compiled.law_about(*plan, gains) for gains in (gain.copy(), np.zeros_like(gain))]
        candidates = (self.result(self._run.work.roll_out(law, plan.states[0]), law) for law in laws)
        return min(candidates, key=lambda result: (not np.isfinite(result.cost), result.violation, result.cost))

    def _polished(self, interior: InteriorResult) -> RunResult | None:
        """Finish a converged plan by Newton's method; None if its rollout is not finite."""
        work = self._run.work
        law = compiled.law_about(interior.plan.states, *self._at_limits(interior))
        plan = work.roll_out(law, interior.plan.states[0])
        if not np.isfinite(plan.states).all():
            return None
        self._set_multipliers(interior, work.constraint_values(plan), FIRMNESS)
        work.set_best(plan, cost := self._run.stages.trial(plan)[0])
        lagrangian = AugmentedLagrangian(self._run)
        lagrangian.evaluate(work.best)
        with self._budget.joined_with_last(NAME):
            result = None
            for updates in range(1 + UPDATES if has_curvature(self._problem) else 0):
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
        if self._run.settings.elastic is not None and result.violation > self.allowed:
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


def copied(plan: RunResult | Trajectory | Motion) -> Motion:
    """A copy of the states and controls of a plan."""
    return Motion(plan.states.copy(), plan.controls.copy())

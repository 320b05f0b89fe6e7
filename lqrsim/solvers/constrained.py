"""The ways to a plan that keeps the constraints, tried in turn; the interior point finishes each.

    the plan of another solution, with its multipliers;
    a trajectory or a policy that the caller gave;
    the plan of smoothing without the constraints, after a few iterations;
    what the augmented Lagrangian makes of that plan, if there is an ObstacleCost;
    the same, after a descent in which constraints may be violated at a price;
    the start itself;
    the same, after such a descent.

If none of these converges, the plan that violates the constraints least is the answer. It is INFEASIBLE if two starts
lead to plans whose violation is stationary and equally large.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Motion
from lqrsim.results.solution_parts import Iteration, Multipliers, Status, Trajectory
from lqrsim.solvers import augmented_lagrangian, compiled
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.infeasibility import Evidence, alike, evidence
from lqrsim.solvers.interior_point import INTERIOR, Found, InteriorPoint, Measures, Sizes, Stages, iteration_of
from lqrsim.solvers.restoration import Restored, restore

FAR = 100.0  # times the tolerance: a larger violation may be evidence that the constraints are infeasible
# Iterations of the augmented Lagrangian: from the plan of smoothing; of these, undamped ones that come no closer; and
# damped ones from a plan of the search, which creep along a wall's corner to optima that cost less.
AUGMENTED, STALE, REFINED = 50, 25, 100
DEEP = 0.03  # part of a row's typical size by which the plan of smoothing may miss it for the interior point
OPENING, GUIDED = 6, 60  # iterations of smoothing before constraints act; the same with an ObstacleCost
MOST, RESTORED = 300, 150  # iterations of the interior point from one plan, and of a descent at one price
RESTORATION = "restoration"  # name of the descent in the log
PRICES = (1e2, 1e4)  # of violating a constraint by its typical size, relative to the cost
SLOW, PATIENCE = 1e-2, 3  # change of cost, and number of times in a row, that end the descent of a feasible plan
PENALTY = 8.0  # of the augmented Lagrangian that makes the policy keep the constraints, in the same unit
UPDATES = 5  # of multipliers, if Newton's steps at the end violate constraints
ROUNDING = 1e-9  # relative difference of costs below which two plans are equally good
AT_LIMIT = 1e-9  # distance from its limit, relative to its range, at which a pressing control is put there


@dataclass
class Known:
    """Results that the runs of one search share.

    Attributes:
      evidence: plans whose violation is stationary. from_start: whether the start itself was tried.
      rows: (R,) typical sizes of the constraint rows, in which violations are measured.
    """

    evidence: list[Evidence] = field(default_factory=list)
    from_start: bool = False
    rows: Array | None = None


class Barrier(NamedTuple):
    """How the interior point begins: barrier parameter, least slacks, and whether the plan may be near the optimum."""

    parameter: float
    room: float
    near: bool


MUCH, LITTLE = Barrier(1.0, 0.06, near=False), Barrier(0.01, 0.01, near=True)


class Ladder:
    """Tries one way to a plan that keeps the constraints after another."""

    def __init__(self, run: SolveRun, known: Known) -> None:
        self._run, self._problem, self._budget = run, run.problem, run.budget
        self._allowed = run.settings.violation_tolerance(run.problem)
        clock = time.perf_counter()
        self._stages = Stages(run.problem)
        run.budget.stop.deadline += time.perf_counter() - clock  # compiling does not count
        self._budget.log[:0] = run.initial_guess.log
        self._best: RunResult | None = None
        self._given: RunResult | None = None
        self._smoothed: Motion | None = None
        self._untried: RunResult | None = None  # the start, until the interior point has begun there
        # With an ObstacleCost, smoothing has chosen the side on which obstacles are passed.
        self._guided = any(cost.weight for cost in run.problem.obstacle_costs)
        self._known = known
        if run.settings.penalty is None:
            self._without_multipliers()

    def _without_multipliers(self) -> None:
        """Set multipliers and penalties to zero."""
        for array in self._run.work.multipliers:
            array[0], array[declarations.HEADER :] = 0.0, 0.0

    def climb(self, *, stay: bool = False) -> RunResult:
        """Try the rungs in turn; with `stay`, only those that begin from the rollout of the first policy."""
        guess = self._run.initial_guess
        start = self.start()
        given = guess.trajectory is not None or guess.gain.any() or stay
        if (given or self._run.settings.start is not None) and start.violation <= self._allowed:
            self._given = start  # the answer is no worse
        rungs: list[Callable[[], RunResult | None]] = []
        retried = False  # whether the start itself would be tried twice
        if guess.found is not None:
            rungs.append(lambda: self._finished(guess.found))
        if guess.multipliers and any(one.values.any() for one in guess.multipliers):
            values = tuple(one.values for one in guess.multipliers)
            rungs.append(lambda: self._interior(_plan(start), LITTLE, multipliers=values))
        if stay and self._guided:
            rungs.append(self._refined)
        if given:
            # A sketch of a path is not near the answer, even where standing still keeps the constraints.
            begin = guess.trajectory or start
            kept = start.violation <= self._allowed and np.allclose(begin.states, start.states)
            rungs.append(lambda: self._interior(_plan(begin), LITTLE if kept else MUCH))
            retried = not kept and np.array_equal(begin.states, start.states)
        if not stay:
            rungs += [self._from_valley, lambda: self._augmented(start), lambda: self._at_a_price(self._smoothed)]
        if stay or not self._known.from_start:  # the runs of a search have the same start
            self._untried = None if retried else start
            rungs += [self._from_itself, lambda: self._from_start(start)]
        for rung in rungs:
            found = rung()
            if found is not None and found.success:
                if not self._worse(found):
                    break
                self._best = None  # the given plan is better
            if self._budget.over:
                break
        return self._answer(start)

    def from_plan(self, plan: Motion | RunResult) -> RunResult | None:
        """Try the interior point from a plan. None if it fails: smoothing can then go on."""
        checkpoint, begin = self._run.checkpoint(), len(self._budget.log)
        found = self._interior(_plan(plan), MUCH)
        if found is not None and found.success:
            return found
        self._run.go_on(checkpoint, self._budget.log[begin:])
        return None

    def _from_valley(self) -> RunResult | None:
        """From the plan of smoothing without the constraints."""
        run = self._run
        run.smooth(GUIDED if self._guided else OPENING)
        ending = run.checked_ending()
        settled = ending.success or ending.outcome == declarations.IN_VALLEY
        plan = run.work.arrays.rollout if settled else run.work.plan  # the plan of least cost so far
        if ending is not run.ending or not np.isfinite(run.work.memory["plan_cost"]):
            return None
        self._smoothed = _plan(plan)
        if self._budget.stop.due:
            return None
        if ending.outcome != declarations.IN_VALLEY or (not self._guided and self._budget.log[-1].violation):
            return self._interior(self._smoothed, MUCH)
        # If the bottom of the valley keeps the constraints, it is the answer; with an ObstacleCost it is next to it.
        checkpoint = run.checkpoint()
        found = run.newton()
        if found.success and found.violation == 0:
            return self._remember(found)
        bottom = _plan(found) if found.success else self._smoothed
        run.go_on(checkpoint)
        if self._budget.stop.due or (self._guided and self._cuts(bottom)):
            return None  # far into an obstacle, the interior point stalls: the augmented Lagrangian leaves it
        return self._interior(bottom, LITTLE if self._guided else MUCH)

    def _cuts(self, plan: Motion) -> bool:
        """Whether a plan misses a constraint by more than `DEEP` of the row's typical size."""
        stages = self._stages
        sizes, numbers = stages.sizes(plan).rows, stages.values(plan)
        missed = np.where(stages.equality, np.abs(numbers), -numbers) / sizes
        return bool((missed[stages.live & (stages.owners >= 0)] > DEEP).any())

    def _from_itself(self) -> RunResult | None:
        """From the start, once."""
        start, self._untried = self._untried, None
        return None if start is None else self._interior(_plan(start), MUCH)

    def _from_start(self, start: RunResult) -> RunResult | None:
        self._known.from_start = True
        return self._at_a_price(_plan(start))

    def _refined(self) -> RunResult | None:
        """From the plan of damped iterations on the augmented Lagrangian."""
        with self._budget.limited(REFINED):
            found = augmented_lagrangian.refine(self._run)
        return self._after_multipliers(found)

    def _augmented(self, start: RunResult) -> RunResult | None:
        """From the plan of the augmented Lagrangian, which stays in the valley that smoothing has chosen.

        Where it costs more than the start, it has diverged.
        """
        run = self._run
        if self._smoothed is None or run.settings.elastic is not None or not self._guided:
            return None
        with self._budget.limited(AUGMENTED):
            found = augmented_lagrangian.satisfy(run, run.result(run.ending), stale=STALE)
        return self._after_multipliers(found, most=start.cost)

    def _after_multipliers(self, found: RunResult, *, most: float = np.inf) -> RunResult | None:
        """The interior point from the last plan of the method of multipliers, unless it costs more than `most`."""
        plan = _plan(found)
        self._without_multipliers()
        usable = np.isfinite(found.cost) and found.cost <= most and np.isfinite(plan.states).all()
        if self._budget.stop.due or not usable:
            return None
        return self._interior(plan, LITTLE)

    def _at_a_price(self, plan: Motion | None) -> RunResult | None:
        """From the plan of a descent in which constraints may be violated at a price.

        Where it comes nowhere at one price, a start that keeps the constraints, such as standing still, is tried before
        the next.
        """
        if plan is None or self._run.settings.elastic is not None:
            return None
        for price in PRICES:
            priced = self._restore(plan, price)
            if priced is None:
                return None
            plan = priced.plan
            self._remember(self._result(plan.states, plan.controls, self._without_gains(plan)))
            if priced.settled:
                return None
            if priced.near or price == PRICES[-1]:
                found = self._interior(plan, MUCH)
            elif self._untried is not None and self._untried.violation <= self._allowed:
                found = self._from_itself()
            else:
                continue
            if found is not None and found.success:
                return found
        return None

    def _restore(self, plan: Motion, price: float) -> Restored | None:
        """Run the descent; its iterations go to the log."""
        budget, left = self._budget, self._budget.left - 1
        before, clock, slow = np.inf, time.perf_counter(), 0

        def watch(cost: float, violation: float, promised: float) -> bool:
            nonlocal before, clock, slow
            now = time.perf_counter()
            improvement = (before - cost) / max(abs(cost), 1e-300)
            budget.record(Iteration(cost, improvement, 0.0, promised, 0.0, violation, now - clock, RESTORATION))
            slow = slow + 1 if violation <= self._allowed and abs(improvement) < SLOW else 0
            before, clock = cost, now
            return budget.stop.due or slow == PATIENCE

        sizes = self._stages.sizes(plan)
        if self._known.rows is None:
            self._known.rows = sizes.rows
        sizes = sizes._replace(rows=self._known.rows)
        if left < 1 or budget.stop.due:
            return None
        try:
            with np.errstate(all="ignore"):
                return restore(
                    self._stages, plan, sizes, price=price, most=min(RESTORED, left), watch=watch,
                    stationary=lambda plan, shares: self._look_for_evidence(plan, shares, sizes),
                )  # fmt: skip
        except BaseException as error:  # Ctrl-C: raised again when there is a solution
            budget.stop.error = error
            return None

    def _look_for_evidence(self, plan: Motion, shares: list[Array], sizes: Sizes) -> bool:
        """Whether the violation of a plan is stationary; if so, that is kept as evidence."""
        there = self._result(plan.states, plan.controls, self._without_gains(plan))
        if not there.violation > FAR * self._allowed:
            return False
        rows = [sizes.rows[self._stages.owners == k] for k in range(len(shares))]
        found = evidence(
            self._problem, self._run.work, there, shares=shares, sizes=rows, allowed=self._allowed,
            control_size=sizes.controls, state_size=sizes.states,
        )  # fmt: skip
        if found is not None:
            self._known.evidence.append(found)
        return found is not None

    def _interior(self, plan: Motion, barrier: Barrier, *, multipliers: tuple[Array, ...] = ()) -> RunResult | None:
        """Run the interior point from a plan, and finish its result."""
        return self._finished(self._interior_point(plan, barrier, multipliers=multipliers))

    def _finished(self, found: Found | None) -> RunResult | None:
        """Finish a result of the interior point: with Newton's method if it converged, else as a rollout."""
        if found is None or not np.isfinite(found.plan.states).all():
            return None
        if found.solved and (result := self._polished(found)) is not None and result.success:
            return self._remember(result)
        return self._remember(self._rolled_out(found.plan, found.gain))

    def _interior_point(self, plan: Motion, barrier: Barrier, *, multipliers: tuple[Array, ...] = ()) -> Found | None:
        """Run the interior point; its iterations go to the log. None if it was interrupted."""
        budget, left = self._budget, self._budget.left - 1
        if left < 1 or budget.stop.due:
            return None
        before, clock = np.inf, time.perf_counter()

        def watch(measures: Measures) -> bool:
            nonlocal before, clock
            now = time.perf_counter()
            budget.record(iteration_of(measures, before, now - clock))
            before, clock = measures.cost, now
            return budget.stop.due

        try:
            with np.errstate(all="ignore"):
                point = InteriorPoint(
                    self._problem, plan, barrier=barrier.parameter, room=barrier.room, price=self._run.settings.price,
                    multipliers=multipliers, stages=self._stages,
                )  # fmt: skip
                return point.run(
                    tolerance=self._run.final, violation=self._allowed, most=min(MOST, left),
                    near=barrier.near, watch=watch,
                )  # fmt: skip
        except BaseException as error:  # Ctrl-C: raised again when there is a solution
            budget.stop.error = error
            return None

    def start(self) -> RunResult:
        """The rollout of the initial policy."""
        work = self._run.work
        guess = self._run.initial_guess
        states, controls = compiled.rollout(self._problem, guess.gain, guess.offset, work.start.copy())
        return self._result(states, controls, (guess.gain, guess.offset))

    def _without_gains(self, plan: Motion) -> tuple[Array, Array]:
        return np.zeros((*plan.controls.shape, plan.states.shape[1])), plan.controls

    def _rolled_out(self, plan: Motion, gain: Array) -> RunResult:
        """The rollout of a plan with gains about it; without gains if that violates the constraints less."""
        candidates = []
        for gains in (gain, np.zeros_like(gain)):
            offset = plan.controls - np.einsum("tij,tj->ti", gains, plan.states[:-1])
            states, controls = compiled.rollout(self._problem, gains, offset, plan.states[0].copy())
            candidates.append(self._result(states, controls, (gains.copy(), offset)))
        return min(candidates, key=lambda one: (not np.isfinite(one.cost), one.violation, one.cost))

    def _result(self, states: Array, controls: Array, law: tuple[Array, Array]) -> RunResult:
        """The result for a plan that has not converged."""
        cost, _ = self._stages.trial(Motion(in_c_order(states), in_c_order(controls)))
        work = self._run.work
        violation = work.violation(work.constraint_values(states, controls)) if np.isfinite(states).all() else np.inf
        return RunResult(
            status=Status.MAX_ITERATIONS, detail="", states=states, controls=controls, law=law,
            cost=cost if np.isfinite(cost) else np.inf, violation=violation, gap=np.nan,
        )  # fmt: skip

    def _polished(self, found: Found) -> RunResult | None:
        """Finish a converged plan: put controls at their limits there, and compute the policy by Newton's method.

        It minimises the augmented Lagrangian with these multipliers, whose minimum the plan is.
        """
        work, stages = self._run.work, self._stages
        low, high = stages.low, stages.high
        controls, gain = found.plan.controls.copy(), found.gain.copy()
        for side, sign in ((low, -1.0), (high, 1.0)):
            room = np.abs(side - controls) / found.control_size
            force = sign * found.pressing * found.control_size / found.scale
            there = (room < AT_LIMIT) & (force > room)
            controls = np.where(there, side, controls)
            gain[there] = 0.0
        offset = controls - np.einsum("tij,tj->ti", gain, found.plan.states[:-1])
        states, controls = compiled.rollout(self._problem, gain, offset, found.plan.states[0].copy())
        if not np.isfinite(states).all():
            return None
        values = work.constraint_values(states, controls)
        for k, (term, numbers) in enumerate(zip(self._problem.constraint_terms, values, strict=True)):
            array, size = work.multipliers[k], found.row_size[stages.owners == k]
            array[0] = PENALTY * found.scale / max(float(np.median(size**2)), 1e-300) if len(size) else 1.0
            # Chosen so that the forces of the augmented Lagrangian at this plan are the multipliers found.
            force = found.multipliers[k] + array[0] * np.where(np.isfinite(numbers), numbers - array[3], 0.0)
            presses = found.multipliers[k] > array[0] * (numbers - array[3])  # others are left over from the barrier
            acts = np.isfinite(numbers) & (term.equality | presses)
            array[declarations.HEADER :] = np.where(acts, force, 0.0).ravel()
        work.plan.states[...], work.plan.controls[...] = states, controls
        work.memory["plan_cost"] = self._stages.trial(Motion(in_c_order(states), in_c_order(controls)))[0]
        lagrangian = AugmentedLagrangian(self._run)
        lagrangian.evaluate(*work.plan)
        with self._budget.joined_with_last(INTERIOR):
            result = self._newton(lagrangian)
            for _ in range(UPDATES):
                if lagrangian.kept or not result.success:
                    break
                lagrangian.update(growth=1.0)
                result = self._newton(lagrangian)
        detail = ""
        if self._run.settings.elastic is not None and result.violation > 0:
            detail = f"elastic: {lagrangian.worst()}"
        result = replace(result, detail=detail, multipliers=self._pressing(lagrangian, found, result))
        if result.success and lagrangian.kept:
            return result
        self._without_multipliers()
        return replace(result, status=Status.MAX_ITERATIONS)

    def _pressing(self, lagrangian: AugmentedLagrangian, found: Found, result: RunResult) -> tuple[Multipliers, ...]:
        """The multipliers; zero for rows whose margin is larger than their force, which is only left by the barrier."""
        values = self._run.work.constraint_values(result.states, result.controls)
        multipliers = []
        for k, one in enumerate(lagrangian.multipliers()):
            size = found.row_size[self._stages.owners == k]
            idle = one.values * size / found.scale < values[k] / size
            idle &= not self._problem.constraint_terms[k].equality
            multipliers.append(replace(one, values=np.where(idle, 0.0, one.values)))
        return tuple(multipliers)

    def _newton(self, lagrangian: AugmentedLagrangian) -> RunResult:
        """Run Newton's method from the plan in memory, with these multipliers."""
        result = self._run.newton(added=lagrangian.added())
        lagrangian.evaluate(result.states, result.controls)
        return result

    def _remember(self, found: RunResult) -> RunResult:
        """Copy a result if it is the best so far."""
        if self._best is None or found.rank < self._best.rank:
            law = found.law[0].copy(), found.law[1].copy()
            self._best = replace(found, states=found.states.copy(), controls=found.controls.copy(), law=law)
        return found

    def _worse(self, found: RunResult) -> bool:
        """Whether a plan costs more than the given one, which keeps the constraints."""
        return self._given is not None and found.cost > self._given.cost + ROUNDING * abs(self._given.cost)

    def _answer(self, start: RunResult) -> RunResult:
        """The best result, certified."""
        run, stop = self._run, self._budget.stop
        best = start if self._best is None else self._best
        priced = run.settings.elastic is not None and best.success
        if self._given is not None and not priced and (best.violation > self._allowed or self._worse(best)):
            best = self._given
        if not best.success and self._problem.constraints:
            lagrangian = AugmentedLagrangian(run)
            lagrangian.evaluate(best.states, best.controls)
            status = Status.STALLED if self._budget.left > 1 else Status.MAX_ITERATIONS
            detail = lagrangian.worst()
            if best.violation > self._allowed and (same := alike(self._known.evidence)):
                best = same[0].plan
                lagrangian.evaluate(best.states, best.controls)
                detail = lagrangian.worst()
                status = Status.INFEASIBLE
                best = replace(best, against=same[0].beside(detail))
                detail += f"; against it stand {', '.join(best.against)}" if best.against else ""
            best = replace(best, status=Status.TIME_LIMIT if stop.due else status, detail=detail)
        return run.certified(best)


def _plan(of: RunResult | Trajectory | Motion) -> Motion:
    return Motion(of.states.copy(), of.controls.copy())

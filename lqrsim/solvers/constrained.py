"""The plans from which a plan that keeps the constraints is sought, in turn; the interior point finishes each.

    the optimum of the search for a free duration, which is only finished;
    the plan of another solution, with its multipliers;
    for a start that is to be kept to, with an ObstacleCost: that start, after damped iterations on the augmented
      Lagrangian;
    a trajectory or a policy that the caller gave;
    unless the start is to be kept to:
      the plan of smoothing without the constraints, after a few iterations;
      that plan, after the augmented Lagrangian, if there is an ObstacleCost;
      the plan of smoothing, after a descent in which constraints may be violated at a price;
    the start itself;
    the start, after such a descent.

If none of these converges, the plan that violates the constraints least is the answer. It is INFEASIBLE if two starts
lead to plans whose violation is stationary and equally large.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Motion
from lqrsim.results.solution_parts import Status
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian, damped_from_rollout, meet_constraints
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.infeasibility import Evidence, alike, evidence
from lqrsim.solvers.interior_run import LITTLE, MUCH, OPENING, Barrier, InteriorRun, copied
from lqrsim.solvers.restoration import Restored, restore
from lqrsim.solvers.stages import Sizes, Stages

FAR = 100.0  # a violation above this many tolerances may be evidence that the constraints are infeasible
# Iterations of the augmented Lagrangian: from the plan of smoothing; undamped iterations without progress among these;
# and damped iterations from a plan of the search, which creep along a wall's corner to optima that cost less.
AUGMENTED, STALE, REFINED = 50, 25, 100
DEEP = 0.03  # largest violation by the plan of smoothing with which the interior point begins, relative to a row's size
GUIDED = 60  # iterations of smoothing before constraints act, with an ObstacleCost
RESTORED = 150  # iterations of a descent at one price
RESTORATION = "restoration"  # name of the descent in the log
PRICES = (1e2, 1e4)  # prices of violating a constraint by its typical size, relative to the cost
SLOW, PATIENCE = 1e-2, 3  # change of cost, and number of times in a row, that end the descent of a feasible plan


@dataclass(eq=False)
class Known:
    """Results that the runs of one search share.

    Attributes:
      evidence: plans whose violation is stationary. from_start: whether the start itself was tried.
      rows: (R,) typical sizes of the constraint rows, in which violations are measured.
    """

    evidence: list[Evidence] = field(default_factory=list)
    from_start: bool = False
    rows: Array | None = None


class Ladder:
    """Tries one start after another for a plan that keeps the constraints. `stages` is as for `InteriorRun`."""

    def __init__(self, run: SolveRun, known: Known, stages: Stages | None = None) -> None:
        self._run, self._problem, self._budget, self._known = run, run.problem, run.budget, known
        self._point = InteriorRun(run, stages)
        self._allowed, self._stages = self._point.allowed, self._point.stages
        self._budget.log[:0] = run.initial_guess.log
        self._best: RunResult | None = None
        self._given: RunResult | None = None
        self._smoothed: Motion | None = None
        self._untried: RunResult | None = None  # the start, until the interior point has begun there
        # With an ObstacleCost, smoothing has chosen the side on which obstacles are passed.
        self._guided = any(cost.contact_curvature for cost in run.problem.obstacle_costs)
        if run.settings.penalty is None:
            self._point.without_multipliers()

    def climb(self, *, stay: bool = False) -> RunResult:
        """Try the rungs in turn; with `stay`, only rungs that begin from the rollout of the first policy."""
        guess = self._run.initial_guess
        start = self._point.start()
        given = guess.trajectory is not None or guess.gain.any() or stay
        if (given or self._run.settings.start is not None) and start.violation <= self._allowed:
            self._given = start  # the answer must not be worse
        rungs: list[Callable[[], RunResult | None]] = []
        retried = False  # whether the start itself would be tried twice
        if (found := guess.found) is not None:
            rungs.append(lambda: self._remember(self._point.finish(found)))
        if guess.multipliers and any(one.values.any() for one in guess.multipliers):
            values = tuple(one.values for one in guess.multipliers)
            rungs.append(lambda: self._interior(copied(start), LITTLE, multipliers=values))
        if stay and self._guided:
            rungs.append(self._refined)
        if given:
            # A sketch of a path is not near the answer, even if standing still keeps the constraints.
            begin = guess.trajectory or start
            kept = start.violation <= self._allowed and np.allclose(begin.states, start.states)
            rungs.append(lambda: self._interior(copied(begin), LITTLE if kept else MUCH))
            retried = not kept and np.array_equal(begin.states, start.states)
        if not stay:
            rungs += [self._from_valley, lambda: self._augmented(start), lambda: self._at_a_price(self._smoothed)]
        if stay or not self._known.from_start:  # the runs of a search have the same start
            self._untried = None if retried else start
            rungs += [self._from_itself, lambda: self._from_start(start)]
        for rung in rungs:
            result = rung()
            if result is not None and result.success:
                if not self._worse(result):
                    break
                self._best = None  # the given plan is better
            if self._budget.over:
                break
        if not self._budget.over and (self._best is None or not self._best.success):
            self._free()
        return self._answer(start)

    def _free(self) -> None:
        """From the best plan, by Newton's method without the constraints: they may not act at the optimum."""
        best = self._best
        if best is None or not best.violation <= self._allowed or not np.isfinite(best.cost):
            return
        best = best.kept()
        self._point.without_multipliers()
        self._run.work.take(best.states, best.controls, best.cost)
        found = self._run.newton(detail=best.detail, patient=True)
        if found.success and found.violation == 0:
            self._remember(replace(found, multipliers=()))

    def _from_valley(self) -> RunResult | None:
        """From the plan of smoothing without the constraints."""
        run = self._run
        run.smooth(GUIDED if self._guided else OPENING)
        ending = run.checked_ending()
        settled = ending.success or ending.outcome == declarations.IN_VALLEY
        plan = run.work.arrays.last if settled else run.work.best  # the plan of least cost so far
        if ending is not run.ending or not np.isfinite(run.work.cost):
            return None
        self._smoothed = copied(plan)
        if self._budget.stop.due:
            return None
        if ending.outcome != declarations.IN_VALLEY or (not self._guided and self._budget.log[-1].violation):
            return self._interior(self._smoothed, MUCH)
        # If the optimum without constraints keeps them, it is the answer; with an ObstacleCost it is next to the
        # answer.
        checkpoint = run.checkpoint()
        found = run.newton()
        if found.success and found.violation == 0:
            return self._remember(found)
        bottom = copied(found) if found.success else self._smoothed
        run.go_on(checkpoint)
        if self._budget.stop.due or (self._guided and self._cuts(bottom)):
            return None  # deep in an obstacle, the interior point stalls, but the augmented Lagrangian method moves out
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
        return None if start is None else self._interior(copied(start), MUCH)

    def _from_start(self, start: RunResult) -> RunResult | None:
        self._known.from_start = True
        return self._at_a_price(copied(start))

    def _refined(self) -> RunResult | None:
        """From the plan of damped iterations on the augmented Lagrangian."""
        with self._budget.limited(REFINED):
            found = damped_from_rollout(self._run)
        return self._after_multipliers(found)

    def _augmented(self, start: RunResult) -> RunResult | None:
        """From the plan of the augmented Lagrangian, which stays near the local optimum that smoothing has chosen.

        If that plan costs more than the start, the method has diverged.
        """
        run = self._run
        if self._smoothed is None or run.settings.elastic is not None or not self._guided:
            return None
        with self._budget.limited(AUGMENTED):
            found = meet_constraints(run, run.result(run.ending), stale=STALE)
        return self._after_multipliers(found, most=start.cost)

    def _after_multipliers(self, found: RunResult, *, most: float = np.inf) -> RunResult | None:
        """The interior point from the last plan of the method of multipliers, unless it costs more than `most`."""
        plan = copied(found)
        self._point.without_multipliers()
        usable = np.isfinite(found.cost) and found.cost <= most and np.isfinite(plan.states).all()
        if self._budget.stop.due or not usable:
            return None
        return self._interior(plan, LITTLE)

    def _at_a_price(self, plan: Motion | None) -> RunResult | None:
        """From the plan of a descent in which constraints may be violated at a price.

        If the descent makes no progress at one price, a start that keeps the constraints, such as standing still, is
        tried before the next price.
        """
        if plan is None or self._run.settings.elastic is not None:
            return None
        for price in PRICES:
            priced = self._restore(plan, price)
            if priced is None:
                return None
            plan = priced.plan
            self._remember(self._point.result(*plan))
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
        budget, laps, slow, restored = self._budget, Laps(self._budget), 0, None

        def watch(cost: float, violation: float, promised: float) -> bool:
            nonlocal slow
            laps.record(RESTORATION, cost, optimality=promised, violation=violation)
            settled = violation <= self._allowed and abs(budget.log[-1].improvement) < SLOW
            slow = slow + 1 if settled else 0
            return budget.stop.due or slow == PATIENCE

        sizes = self._stages.sizes(plan)
        if self._known.rows is None:
            self._known.rows = sizes.rows
        sizes = sizes._replace(rows=self._known.rows)
        if budget.left < 2 or budget.stop.due:
            return None
        with budget.stop.heeding(), np.errstate(all="ignore"):
            restored = restore(
                self._stages, plan, sizes, price=price, most=min(RESTORED, budget.left - 1), watch=watch,
                stationary=lambda plan, shares: self._look_for_evidence(plan, shares, sizes),
            )  # fmt: skip
        return restored

    def _look_for_evidence(self, plan: Motion, shares: list[Array], sizes: Sizes) -> bool:
        """Whether the violation of a plan is stationary; if so, the plan is kept as evidence."""
        there = self._point.result(*plan)
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
        """The result of the interior point from a plan."""
        return self._remember(self._point.solve(plan, barrier, multipliers=multipliers))

    def _remember(self, found: RunResult | None) -> RunResult | None:
        """Keep a result if it is the best so far."""
        if found is not None and (self._best is None or found.rank < self._best.rank):
            self._best = found.kept()
        return found

    def _worse(self, found: RunResult) -> bool:
        """Whether a plan costs more than the given one, which keeps the constraints, by more than rounding."""
        return self._given is not None and self._run.costs_more(found, self._given)

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

"""The plans from which a plan that keeps the constraints is sought, in turn; the interior point finishes each.

`ATTEMPTS` says which, when, and in which order. If none of them converges, the plan that violates the constraints least
is the answer. It is INFEASIBLE if two starts lead to plans whose violation is stationary and equally large.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Motion
from lqrsim.results.solution_parts import Status
from lqrsim.solvers.augmented_lagrangian import (
    AugmentedLagrangian,
    by_multipliers,
    damped_from_rollout,
    meet_constraints,
)
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.infeasibility import Evidence, alike, evidence
from lqrsim.solvers.interior_run import LITTLE, MUCH, OPENING, Barrier, InteriorRun, copied
from lqrsim.solvers.restoration import Restored, restore
from lqrsim.solvers.settings import has_curvature
from lqrsim.solvers.stages import Sizes

FAR = 100.0  # a violation above this many tolerances may be evidence that the constraints are infeasible
# Iterations of the augmented Lagrangian: from the plan of smoothing; undamped iterations without progress among these;
# and damped iterations from a plan of the search, which creep along a wall's corner to optima that cost less.
AUGMENTED, STALE, REFINED = 50, 25, 100
DEEP = 0.03  # largest violation by the plan of smoothing with which the interior point begins, relative to a row's size
# Iterations in which stationarity has no new least value that end an interior point without second derivatives. In 12
# problems of arms among posts, runs that converged soon had at most 2 in a row; others took 50 to 100 or failed.
TROUBLED = 4
GUIDED = 60  # iterations of smoothing before constraints act, with an ObstacleCost
RESTORED = 150  # iterations of a descent at one price
RESTORATION = "restoration"  # name of the descent in the log
PRICES = (1e2, 1e4)  # prices of violating a constraint by its typical size, relative to the cost


@dataclass(eq=False)
class Known:
    """Results that the runs of one search share."""

    evidence: list[Evidence] = field(default_factory=list)  # plans whose violation is stationary
    from_start: bool = False  # whether the start itself was tried
    rows: Array | None = None  # (R,) typical sizes of the constraint rows, in which violations are measured


class Ladder:
    """Tries one start after another for a plan that keeps the constraints; `ATTEMPTS` says which each method tries.

    Attributes:
      guess, start: the start, and the rollout of its policy. stay: whether only plans from that rollout are tried.
      given: whether the start is to be kept to. guided: whether there is an ObstacleCost, with which smoothing chooses
        the side on which obstacles are passed. elastic: whether violations have a price. curved: whether the dynamics
        have second derivatives.
      smoothed: the plan of smoothing without the constraints, once it is known.
      untried: whether the interior point has not yet begun from the start itself.
      converged: whether an attempt has.
    """

    def __init__(self, run: SolveRun, known: Known, *, stay: bool = False) -> None:
        self._run, self._problem, self._budget, self._known = run, run.problem, run.budget, known
        self._point, self._stages, self.guess, self.stay = InteriorRun(run), run.stages, run.initial_guess, stay
        self._allowed = self._point.allowed
        self._budget.log[:0] = run.initial_guess.log
        self._best: RunResult | None = None
        self.smoothed: Motion | None = None
        self.curved = has_curvature(run.problem)
        self.guided = any(cost.contact_curvature for cost in run.problem.obstacle_costs)
        self.elastic = run.settings.elastic is not None
        self.given = self.guess.trajectory is not None or bool(self.guess.gain.any()) or stay
        if run.settings.penalty is None:
            self._point.without_multipliers()
        self.start = self._point.start()
        feasible = (self.given or run.settings.start is not None) and self.start.violation <= self._allowed
        self._given = self.start if feasible else None  # the answer must not be worse
        self.untried = self.may_start = stay or not known.from_start  # the runs of a search have the same start

    @property
    def converged(self) -> bool:
        return self._best is not None and self._best.success

    @property
    def idle(self) -> bool:
        """Whether the interior point ended where the constraints do not act."""
        return self._point.idle

    def climb(self) -> RunResult:
        """Make the attempts in turn, until one converges to a plan that is no worse than a given one."""
        for attempt in ATTEMPTS:
            result = attempt.make(self) if attempt.when(self) else None
            if result is not None and result.success:
                if not self._worse(result):
                    break
                self._best = None  # the given plan is better
            if self._budget.over:
                break
        return self._answer()

    def finish_interior(self) -> RunResult | None:
        assert self.guess.interior is not None
        return self._remember(self._point.finish(self.guess.interior))

    def from_neighbour(self) -> RunResult | None:
        known = tuple(multipliers.values for multipliers in self.guess.multipliers)
        return self._interior(copied(self.start), LITTLE, multipliers=known)

    def from_given(self) -> RunResult | None:
        # A sketch of a path is not near the answer, even if standing still keeps the constraints.
        begin = self.guess.trajectory or self.start
        near = self.start.violation <= self._allowed and np.allclose(begin.states, self.start.states)
        self.untried &= near or not np.array_equal(begin.states, self.start.states)
        return self._interior(copied(begin), LITTLE if near else MUCH)

    def from_best_without_constraints(self) -> RunResult | None:
        """From the best plan, by Newton's method without the constraints: they may not act at the optimum.

        Then the tolerance is that of the problem without them.
        """
        best, run = self._best, self._run
        if best is None or not best.violation <= self._allowed or not np.isfinite(best.cost):
            return None
        best = best.kept()
        self._point.without_multipliers()
        run.work.set_best(*best.plan, best.cost)
        tolerance, run.final = run.final, run.settings.final(self._problem.with_constraints([]))
        result = run.newton(detail=best.detail, patient=True)
        if not result.success or result.violation > 0:
            run.final = tolerance
            return None
        return self._remember(replace(result, multipliers=()))

    def from_valley(self) -> RunResult | None:
        run = self._run
        run.smooth(GUIDED if self.guided else OPENING)
        ending = run.checked_ending()
        converged = ending.success or ending.outcome == declarations.IN_VALLEY
        plan = run.work.arrays.last if converged else run.work.best  # the plan of least cost so far
        if ending is not run.ending or not np.isfinite(run.work.cost):
            return None
        self.smoothed = copied(plan)
        if self._budget.stop.due:
            return None
        if ending.success and not self._budget.log[-1].violation:
            return self._remember(run.result(ending))
        if ending.outcome != declarations.IN_VALLEY or (not self.guided and self._budget.log[-1].violation):
            # If the augmented Lagrangian method follows, it does better than an interior point that lacks curvature.
            return self._interior(self.smoothed, MUCH, stale=TROUBLED if self.guided and not self.curved else None)
        # If the optimum without constraints keeps them, it is the answer; with an ObstacleCost it is next to the
        # answer.
        checkpoint = run.checkpoint()
        result = run.newton()
        if result.success and result.violation == 0:
            return self._remember(result)
        bottom = copied(result) if result.success else self.smoothed
        run.go_on(checkpoint)
        if self._budget.stop.due or (self.guided and self._cuts(bottom)):
            return None  # deep in an obstacle, the interior point stalls, but the augmented Lagrangian method moves out
        return self._interior(bottom, LITTLE if self.guided else MUCH)

    def _cuts(self, plan: Motion) -> bool:
        """Whether a plan misses a constraint by more than `DEEP` of the row's typical size."""
        stages = self._stages
        sizes, numbers = stages.sizes(plan).rows, stages.values(plan)
        missed = np.where(stages.equality, np.abs(numbers), -numbers) / sizes
        return bool((missed[stages.live & (stages.owners >= 0)] > DEEP).any())

    def from_start(self) -> RunResult | None:
        self.untried = False
        return self._interior(copied(self.start), MUCH)

    def from_start_at_a_price(self) -> RunResult | None:
        self._known.from_start = True
        return self._at_a_price(copied(self.start))

    def from_damped(self) -> RunResult | None:
        with self._budget.limited(REFINED):
            result = damped_from_rollout(self._run)
        return self._after_multipliers(result)

    def from_multipliers(self) -> RunResult | None:
        """From the plan of the augmented Lagrangian, which stays near the local optimum that smoothing has chosen.

        If that plan costs more than the start, the method has diverged.
        """
        run = self._run
        with self._budget.limited(AUGMENTED):
            result = meet_constraints(run, run.result(run.ending), stale=STALE)
        if result.success and not self.curved:
            return self._remember(run.certified(result))
        return self._after_multipliers(result, most=self.start.cost)

    def by_multipliers(self) -> RunResult | None:
        self._point.without_multipliers()
        result = by_multipliers(self._run)
        return self._remember(result if result.success else None)

    def from_smoothed_at_a_price(self) -> RunResult | None:
        assert self.smoothed is not None
        return self._at_a_price(self.smoothed)

    def _after_multipliers(self, result: RunResult, *, most: float = np.inf) -> RunResult | None:
        """The interior point from the last plan of the method of multipliers, unless it costs more than `most`."""
        plan = copied(result)
        self._point.without_multipliers()
        usable = np.isfinite(result.cost) and result.cost <= most and np.isfinite(plan.states).all()
        if self._budget.stop.due or not usable:
            return None
        return self._interior(plan, LITTLE)

    def _at_a_price(self, plan: Motion) -> RunResult | None:
        """From the plan of a descent in which constraints may be violated at a price.

        If the descent makes no progress at one price, a start that keeps the constraints, such as standing still, is
        tried before the next price.
        """
        for price in PRICES:
            priced = self._restore(plan, price)
            if priced is None:
                return None
            plan = priced.plan
            self._remember(self._point.result(*plan))
            if priced.stationary:
                return None
            if priced.near or price == PRICES[-1]:
                result = self._interior(plan, MUCH)
            elif self.untried and self.start.violation <= self._allowed:
                result = self.from_start()
            else:
                continue
            if result is not None and result.success:
                return result
        return None

    def _restore(self, plan: Motion, price: float) -> Restored | None:
        """Run the descent; its iterations go to the log."""
        budget, laps, restored = self._budget, Laps(self._budget), None

        def watch(cost: float, violation: float, promised: float, seconds: float) -> bool:
            laps.record(RESTORATION, cost, optimality=promised, violation=violation, seconds=seconds)
            return budget.stop.due

        sizes = self._stages.sizes(plan)
        if self._known.rows is None:
            self._known.rows = sizes.rows
        sizes = sizes._replace(rows=self._known.rows)
        if budget.left < 2 or budget.stop.due:
            return None
        with budget.stop.heeding():
            restored = restore(
                self._stages, plan, sizes, price=price, most=min(RESTORED, budget.left - 1), watch=watch,
                stationary=lambda plan, shares: self._keep_evidence(plan, shares, sizes), hurried=budget.hurried,
            )  # fmt: skip
        return restored

    def _keep_evidence(self, plan: Motion, shares: list[Array], sizes: Sizes) -> bool:
        """Whether the violation of a plan is stationary; if so, the plan is kept as evidence."""
        result = self._point.result(*plan)
        if not result.violation > FAR * self._allowed:
            return False
        rows = [sizes.rows[self._stages.owners == k] for k in range(len(shares))]
        new_evidence = evidence(
            self._problem, self._run.work, result, shares=shares, sizes=rows, allowed=self._allowed,
            control_size=sizes.controls, state_size=sizes.states,
        )  # fmt: skip
        if new_evidence is not None:
            self._known.evidence.append(new_evidence)
        return new_evidence is not None

    def _interior(
        self, plan: Motion, barrier: Barrier, *, multipliers: tuple[Array, ...] = (), stale: int | None = None
    ) -> RunResult | None:
        """The result of the interior point from a plan."""
        return self._remember(self._point.solve(plan, barrier, multipliers=multipliers, stale=stale))

    def _remember(self, result: RunResult | None) -> RunResult | None:
        """Keep a result if it is the best so far."""
        if result is not None and (self._best is None or result.rank < self._best.rank):
            self._best = result.kept()
        return result

    def _worse(self, result: RunResult) -> bool:
        """Whether a plan costs more than the given one, which keeps the constraints, by more than rounding."""
        return self._given is not None and self._run.costs_more(result, self._given)

    def _answer(self) -> RunResult:
        """The best result, certified."""
        run, stop = self._run, self._budget.stop
        best = self.start if self._best is None else self._best
        priced = self.elastic and best.success
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
        return best if best.certificate is not None else run.certified(best)


class Attempt(NamedTuple):
    """One of the attempts to keep the constraints."""

    words: str  # the plan from which the interior point begins
    when: Callable[[Ladder], bool]
    make: Callable[[Ladder], RunResult | None]


ATTEMPTS = (
    Attempt(
        "the optimum of the search for a free duration, which is only finished",
        lambda tried: tried.guess.interior is not None,
        Ladder.finish_interior,
    ),
    Attempt(
        "the plan of another solution, with its multipliers",
        lambda tried: any(multipliers.values.any() for multipliers in tried.guess.multipliers),
        Ladder.from_neighbour,
    ),
    Attempt(
        "the start, after damped iterations on the augmented Lagrangian",
        lambda tried: tried.stay and tried.guided,
        Ladder.from_damped,
    ),
    Attempt("a trajectory or a policy that the caller gave", lambda tried: tried.given, Ladder.from_given),
    Attempt(
        "the plan of smoothing without the constraints, after a few iterations",
        lambda tried: not tried.stay,
        Ladder.from_valley,
    ),
    # Where the cost has kinks, as where a flat side of the robot lies along an obstacle, the interior point's measures
    # do not vanish.
    Attempt(
        "the best plan so far, if no constraint acts there, by Newton's method without the constraints",
        lambda tried: not (tried.converged or tried.curved) and tried.idle,
        Ladder.from_best_without_constraints,
    ),
    Attempt(
        "that plan, after the augmented Lagrangian",
        lambda tried: tried.smoothed is not None and tried.guided and not tried.elastic,
        Ladder.from_multipliers,
    ),
    Attempt(
        "that plan, after a descent in which constraints may be violated at a price",
        lambda tried: tried.smoothed is not None and not tried.elastic,
        Ladder.from_smoothed_at_a_price,
    ),
    Attempt("the start itself", lambda tried: tried.untried, Ladder.from_start),
    Attempt(
        "the start, after such a descent",
        lambda tried: tried.may_start and not tried.elastic,
        Ladder.from_start_at_a_price,
    ),
    Attempt(
        "the plan of smoothing, by the augmented Lagrangian alone",
        lambda tried: not (tried.converged or tried.curved or tried.elastic),
        Ladder.by_multipliers,
    ),
    Attempt(
        "the best plan so far, by Newton's method without the constraints",
        lambda tried: not tried.converged,
        Ladder.from_best_without_constraints,
    ),
)

"""Re-plans in which constraints give way that the robot keeps by itself: limits of forces, which MuJoCo clips.

After a push, no plan may keep them. A stiff servo whose target is held for a period cannot keep its force within its
limits from any velocity: at 450 N m s/rad and 87 N m, 0.2 rad/s are too much. The robot then clips the force, and the
deviation ends within some physics steps. So a violation has a price, and the next plans bring the forces back.

The plan hardly moves from one solve to the next, and derivatives by MuJoCo take most of the time of an iteration. So
those about the first plan serve for all steps that need not be shortened, and are computed anew at the end.
"""

import time

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.constraints import allowed_violation, violation_of
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Status
from lqrsim.solvers import compiled
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.interior_point import InteriorPoint, Measures
from lqrsim.solvers.stages import Sizes

# Price of a violation by a row's typical size, relative to the typical cost of a change. Multipliers along a Panda's
# plans are at most half of it, so that limits hold where they can. With a hundred times this price, two in five solves
# of two links after hard pushes did not converge.
PRICE = 0.01
OLDEST = 20  # steps for which derivatives may serve; most solves take fewer
# The first barrier parameter, and the least first slack relative to a row's size: many rows begin violated. Re-plans of
# a Panda then take 8 iterations in the median and 11 in 95 %, and 12 and 19 with those of `MUCH`.
BARRIER, ROOM = 10.0, 0.5


def can_yield(problem: Problem) -> bool:
    """Whether a problem has constraints that may give way."""
    return any(term.yields for term in problem.constraint_terms)


class Yielding:
    """A solve from one plan, by the interior point.

    Args:
      run: a run of the problem.
      plan: states and controls to start from, with the first state of the solve.
      closing: duration of the work after the last iteration, in s.

    Attributes:
      ended: time at which the last iteration ended, on the clock of `time.perf_counter`.
    """

    def __init__(self, run: SolveRun, plan: Motion, closing: float = 0.0) -> None:
        self._run, self._plan, self._closing = run, plan, closing
        terms, owners = run.problem.constraint_terms, run.stages.owners
        self._yields = (owners >= 0) & np.array([term.yields for term in terms])[owners]
        self._allowed = run.settings.violation_tolerance(run.problem)
        self.ended, self._late = time.perf_counter(), False

    def find(self, before: Motion, cost: float) -> RunResult | None:
        """The plan found, carried out with feedback; None if it is worse than the plan `before` of this cost."""
        run, budget, clock = self._run, self._run.budget, time.perf_counter()
        for function in functions_of(run.problem):
            function.forget()
        with np.errstate(all="ignore"):
            point = InteriorPoint(run.stages, self._plan, barrier=BARRIER, room=ROOM, price=self._price, oldest=OLDEST)
            self.ended = time.perf_counter()
            looking, laps = self.ended - clock, Laps(budget)

            def watch(measures: Measures, seconds: float) -> bool:
                measures.record(laps, seconds=seconds)
                self.ended = time.perf_counter()
                # The next iteration may compute the derivatives anew.
                self._late = self.ended + looking + seconds + self._closing >= budget.stop.deadline
                return self._late

            self._late = self.ended + looking + self._closing >= budget.stop.deadline
            if self._late or not budget.left:
                return None
            found = point.run(tolerance=run.final, violation=self._allowed, most=budget.left, watch=watch)
            law = compiled.law_about(*found.plan, found.gain.copy())
            plan = run.work.roll_out(*law, self._plan.states[0])
            reached = run.stages.trial(plan)[0]
            rank = self._rank(plan, reached)
            solved = found.solved and rank[1] == 0
            if not solved and rank > self._rank(before, cost):
                return None
        return self._result(plan, law, reached, Status.CONVERGED if solved else self.unsolved)

    @property
    def unsolved(self) -> Status:
        """The status of a solve that has not converged."""
        return Status.TIME_LIMIT if self._late else Status.MAX_ITERATIONS

    def _price(self, sizes: Sizes) -> Array:
        self._prices = np.where(self._yields, PRICE * sizes.cost / sizes.rows, np.inf)
        return self._prices

    def _missed(self, plan: Motion) -> float:
        """The largest violation of the constraints that do not give way, beyond what is allowed."""
        values = self._run.work.constraint_values(*plan)
        pairs = zip(self._run.problem.constraint_terms, values, strict=True)
        hard = ((one, number) for one, number in pairs if not one.yields)
        return max([0.0, *(violation_of(one, number) - allowed_violation(one, self._allowed) for one, number in hard)])

    def _rank(self, plan: Motion, cost: float) -> tuple[bool, float, float]:
        """Sort key, best first: violation of what does not give way, then the cost with the prices of violations."""
        values, stages = self._run.stages.values(plan), self._run.stages
        short = np.where(stages.live & self._yields, np.maximum(-values, 0.0), 0.0)
        paid = float((short * np.where(self._yields, self._prices, 0.0)).sum())
        return not np.isfinite(plan.states).all(), self._missed(plan), cost + paid

    def _result(self, plan: Motion, law: tuple[Array, Array], cost: float, status: Status) -> RunResult:
        work = self._run.work
        violation, detail = work.violation(work.constraint_values(*plan)), ""
        if violation > self._allowed:
            lagrangian = AugmentedLagrangian(self._run)
            lagrangian.evaluate(*plan)
            detail = f"elastic: {lagrangian.worst()}"
        return RunResult(
            status=status, detail=detail, states=plan.states, controls=plan.controls, law=law,
            cost=cost, violation=violation, gap=np.nan,
        )  # fmt: skip

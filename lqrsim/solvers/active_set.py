"""Newton steps with an active set, to a nearby constrained optimum, such as after a small change of the problem.

Each step solves the quadratic problem of second-order models about the plan, with linearised dynamics and constraints;
gaps between the steps of the plan close on the way. Most active rows are known from the last solve, and are fixed at
zero. Pivoting finds the others: rows with a multiplier of the wrong sign are released, and violated rows are fixed. Of
neighbouring steps only the worst row is fixed, because fixing it usually satisfies them all. If the number of wrong
rows does not decrease, rows change one at a time, which terminates for convex models.

Second-order models have a minimum only if the right rows are fixed. If the known rows are not enough, convex models
choose the rows first. The step itself uses the largest fraction of the second-order terms with which a minimum exists.
"""

import time
from collections.abc import Callable

import numpy as np

from lqrsim.errors import Array
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.kernels.interior_point import AT_LIMIT, REGULARISATION
from lqrsim.kernels.records import Limits, Motion, RowWork
from lqrsim.kernels.stages import AIM, INEQUALITY, KIND, MIXES, SIZE
from lqrsim.solvers.interior_point import Measures
from lqrsim.solvers.settings import INSIDE
from lqrsim.solvers.stages import FIRMNESS, Stages

STEPS = 12  # largest number of steps: a solve that needs more does not converge
PIVOTS, FEW = 15, 4  # largest number of pivots of a convex problem, and of a problem that may be nonconvex
PATIENCE = 3  # pivots without fewer wrong rows before rows change one at a time
SHARES = (0.0, 0.3)  # fractions of the convex models in a step, tried in turn


class ActiveSet:
    """Steps from one plan.

    Args:
      stages: stages of the problem.
      plan: states (T+1, n) and controls (T, m), not necessarily feasible; the first state is the start.
      multipliers: multipliers of the constraints, (T+1, rows) each, or none.
      violation: tolerance of equalities; a fraction of it is the margin of inequalities.

    Attributes:
      plan: the current plan. measures: its measures. force, held: (T+1, R) the rows' multipliers, and 1 for rows fixed
        at zero, else 0. sizes: typical sizes. hopeless: whether the plan is stationary but violates rows that no
        multiplier corrects. looking: seconds spent on the models of a plan.
    """

    def __init__(self, stages: Stages, plan: Motion, multipliers: tuple[Array, ...], violation: float) -> None:
        self.stages, self.plan, self._violation = stages, Motion(*map(in_c_order, plan)), violation
        plan = self.plan
        self.hopeless = False
        limit, table = stages.owners == -1, stages.about.rows.table
        self.held, self.force = stages.held, stages.force
        self.held[...], self.force[...] = 0.0, stages.of_constraints(multipliers)
        self._equality = stages.equality
        table[:, AIM] = np.where(table[:, KIND] == INEQUALITY, INSIDE * violation, 0.0)
        self._work = RowWork(*(np.zeros(stages.live.size) for _ in range(4)))
        self._gaps, self._costates = np.empty((stages.steps, stages.n)), np.zeros((stages.steps + 1, stages.n))
        clock = time.perf_counter()
        cost = stages.call("begin_active_set", stages.about, plan, self._costates)
        self.looking = time.perf_counter() - clock
        self.sizes = stages.sizes_of(plan, stages.models.hessian)
        begun = self._equality | (self.force > 0) | (limit & (stages.numbers <= AT_LIMIT * self.sizes.rows))
        self.held[...] = begun & stages.live
        self._measure(cost)

    def run(self, tolerance: float, watch: Callable[[Measures], bool], late: Callable[[float], bool]) -> bool:
        """Take steps until the measures are within tolerance; return whether they are.

        Args:
          tolerance: tolerance of stationarity, gaps and complementarity.
          watch: called with the measures after each step; True ends it.
          late: called before a piece of work with its expected duration in seconds; True abandons the step.
        """
        self._late = late
        ended = False
        for _ in range(STEPS):
            before = self.measures
            if self._within(tolerance) or ended or not self._step():
                break
            ended = watch(self.measures) or not np.isfinite(self.measures.cost)
            # If everything else is within tolerance, a remaining violation cannot be removed.
            idle = max(before.stationarity, before.gap) < tolerance
            self.hopeless = idle and self.measures.violation > 0.5 * before.violation > self._violation
            ended = ended or self.hopeless
        return self._within(tolerance)

    def carried_out(self) -> tuple[Motion, Array, float, list[Array]]:
        """The rollout of the plan with gains (T, m, n) about it; the gains; its cost; the constraints' values.

        The gains come from a step with a penalty on the active rows, and zero at limits.
        """
        stages = self.stages
        for share in MIXES:
            if self._solve(share, price=FIRMNESS * REGULARISATION)[0]:
                break
        else:
            stages.about.policy.gain[...] = 0.0
        out = Motion(np.empty_like(self.plan.states), np.empty_like(self.plan.controls))
        limits = Limits(*(np.tile(side, (stages.steps, 1)) for side in (stages.low, stages.high)))
        plan = Motion(self.plan.states, self.plan.controls.copy())
        cost = stages.call("rollout_of_active_set", stages.about, plan, limits, out)
        values = [one.reshape(stages.steps + 1, -1) for one in stages.about.values]
        return out, stages.about.policy.gain.copy(), cost, values

    def multipliers(self) -> list[tuple[Array, float]]:
        """Multipliers (T+1, rows) and penalty of each constraint."""
        owners = self.stages.owners
        sizes = [self.sizes.rows[owners == k] for k in range(len(self.stages.problem.constraint_terms))]
        prices = [FIRMNESS * self._scale / float(np.median(size**2)) if len(size) else 1.0 for size in sizes]
        return [(self.force[:, owners == k].copy(), price) for k, price in enumerate(prices)]

    def _measure(self, cost: float) -> None:
        """Compute the measures of the plan about which the models are made."""
        self._scale = max(abs(cost), 1e-6 * self.sizes.cost) if np.isfinite(cost) else np.nan
        stages = self.stages
        steepest, missed, unequal, gap, product = stages.call(
            "measure", stages.about, self.plan, stages.about.rows.numbers, self._gaps
        )
        self._kept = missed <= 0 and unequal <= self._violation
        self.measures = Measures(
            cost=cost, stationarity=steepest / self._scale, violation=max(missed, unequal, 0.0), gap=gap,
            complementarity=product / self._scale,
        )  # fmt: skip

    def _within(self, tolerance: float) -> bool:
        found = self.measures
        # The rollout of the plan must not use up the margin of the constraints.
        return self._kept and max(found.stationarity, found.gap / INSIDE, found.complementarity) < tolerance

    def _step(self) -> bool:
        """Take a step; return False if there is none."""
        before = self.held.copy()
        if (self._pivoted(0.0, 0) != 0 and not self._from_convex()) or self._due():
            self.held[...] = before
            return False
        stages, pressing = self.stages, self._work.pressing.reshape(self.force.shape)
        self.force[...] = np.where(self._equality, pressing, np.maximum(pressing, 0.0))
        changes, self._costates = stages.about.changes, stages.about.to_go.gradient.copy()
        self.plan = Motion(self.plan.states + changes.states, self.plan.controls + changes.controls)
        clock = time.perf_counter()
        cost = stages.call("look_at_rows", stages.about, self.plan, self._costates)
        self._measure(cost)
        self.looking = time.perf_counter() - clock
        return True

    def _due(self) -> bool:
        """Whether a pivot and new models would end too late, with the time of another such pair as a margin."""
        return self._late(2 * self.looking)

    def _from_convex(self) -> bool:
        """Find a step with the active rows of the convex models, or almost these; return whether it exists."""
        if self._pivoted(1.0, PIVOTS) is None:
            return False
        convex = self.held.copy()
        for share in (*SHARES, 1.0):
            self.held[...] = convex
            wrong = self._pivoted(share, FEW if share < 1 else 0)
            if self._due():
                return False
            if wrong is not None and (share == 1 or not wrong):
                return True
        return False

    def _pivoted(self, share: float, most: int) -> int | None:
        """Solve the quadratic problem by at most `most` pivots from the fixed rows.

        The change of the plan is in `stages`.

        Returns:
          The number of wrong rows; None if there is no minimum.
        """
        fewest, patience = self.held.size + 1, PATIENCE
        for pivot in range(most + 1):
            if pivot > 0 and self._due():
                return None
            solved, wrong = self._solve(share)
            if not solved:
                return None
            if wrong == 0 or pivot == most:
                return wrong
            fewest, patience = (wrong, PATIENCE) if wrong < fewest else (fewest, patience - 1)
            self.stages.call("update_active_set", self.stages.about, int(patience > 0), self._work)
        return None

    def _solve(self, share: float, price: float = 1.0) -> tuple[bool, int]:
        """Solve the problem with the fixed rows; return whether there is a minimum, and the number of wrong rows."""
        failed, wrong = self.stages.call(
            "pivot", self.stages.about, self.plan, self._gaps, float(share), float(self._scale),
            float(self._scale / REGULARISATION), float(price), self._work,
        )  # fmt: skip
        return failed == -1, wrong

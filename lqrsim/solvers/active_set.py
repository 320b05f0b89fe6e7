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
from lqrsim.kernels.records import Motion
from lqrsim.kernels.stages import AIM, CONTROL, EQUALITY, INEQUALITY, KIND, LIMIT, SIZE
from lqrsim.solvers.interior_point import AT_LIMIT, REGULARISATION, Measures
from lqrsim.solvers.settings import INSIDE
from lqrsim.solvers.stages import FIRMNESS, MIXES, Stages

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
        self.stages, self.plan, self._violation = stages, plan, violation
        self.hopeless = False
        shape, limit, rows = stages.live.shape, stages.owners == -1, stages.active
        live, self.held, numbers, self.force, self._pressing = (one.reshape(shape) for one in rows[2:-1])
        live[...], self.held[...], self.force[...] = stages.live, 0.0, stages.of_constraints(multipliers)
        self._equality = stages.equality
        kind = np.where(self._equality, EQUALITY, np.where(limit, LIMIT, INEQUALITY))
        rows.table[:, KIND], rows.table[:, SIZE] = kind, 1.0
        rows.table[:, AIM] = np.where(kind == INEQUALITY, INSIDE * violation, 0.0)
        for row, (sign, i, side) in zip(np.flatnonzero(limit), stages.limits, strict=True):
            rows.table[row, CONTROL:] = i, sign, side
        self._gaps, self._costates = np.empty((stages.steps, stages.n)), np.zeros((stages.steps + 1, stages.n))
        clock = time.perf_counter()
        cost = stages.look(plan, self._costates, own=True)
        self.looking = time.perf_counter() - clock
        self._convex, stages.live[...] = False, live > 0
        self.sizes = stages.sizes_of(plan, stages.models.hessian)
        rows.table[:, SIZE] = self.sizes.rows
        begun = self._equality | (self.force > 0) | (limit & (numbers <= AT_LIMIT * self.sizes.rows))
        self.held[...] = begun & (live > 0)
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
            stages.policy.gain[...] = 0.0
        gain = stages.policy.gain.copy()
        plan, cost, values = stages.carry_out(Motion(self.plan.states, self.plan.controls.copy()), gain)
        return plan, gain, cost, values

    def multipliers(self) -> list[tuple[Array, float]]:
        """Multipliers (T+1, rows) and penalty of each constraint."""
        owners = self.stages.owners
        sizes = [self.sizes.rows[owners == k] for k in range(len(self.stages.problem.constraint_terms))]
        prices = [FIRMNESS * self._scale / float(np.median(size**2)) if len(size) else 1.0 for size in sizes]
        return [(self.force[:, owners == k].copy(), price) for k, price in enumerate(prices)]

    def _measure(self, cost: float) -> None:
        """Compute the measures of the plan about which the models are made."""
        self._scale = max(abs(cost), 1e-6 * self.sizes.cost) if np.isfinite(cost) else np.nan
        steepest, missed, unequal, gap, product = self.stages.measure(self.plan, self._gaps, self.sizes)
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
        stages = self.stages
        self.force[...] = np.where(self._equality, self._pressing, np.maximum(self._pressing, 0.0))
        self._costates = stages.to_go.gradient.copy()
        self.plan = Motion(self.plan.states + stages.changes.states, self.plan.controls + stages.changes.controls)
        clock = time.perf_counter()
        cost = stages.look(self.plan, self._costates)
        self._convex = False
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
            self.stages.change(worst=patience > 0)
        return None

    def _solve(self, share: float, price: float = 1.0) -> tuple[bool, int]:
        """Solve the problem with the fixed rows; return whether there is a minimum, and the number of wrong rows."""
        if share > 0 and not self._convex:
            self.stages.convexify(self.plan)
            self._convex = True
        weight = self._scale / REGULARISATION
        return self.stages.pivot(self._gaps, share=share, scale=self._scale, weight=weight, price=price)

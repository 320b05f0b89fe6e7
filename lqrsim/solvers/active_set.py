"""Newton steps with constraints to an optimum that is near, as that of a problem that was solved a moment ago.

Each step goes to the optimum of the quadratic problem that models of second order make about the plan, with linearised
dynamics and constraints; gaps between the steps of the plan are closed on the way. The interior point would find it
from inside; here the rows that press are known but for a few, and are held at zero. Pivoting finds the others: rows
that pull are let go and rows that are missed are held, of neighbouring steps only the worst, for what holds one holds
them all. Where that does not bring fewer wrong ones, they change one at a time, which ends if the models are convex.

Models of second order have a minimum only where the right rows are held. So which these are is first asked of convex
models, where those that pressed before do not do; the step itself is of second order as far as that has a minimum.
"""

import time
from collections.abc import Callable

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.active_set import AIM, CONTROL, EQUALITY, INEQUALITY, KIND, LIMIT, SIZE
from lqrsim.kernels.records import Motion
from lqrsim.solvers.interior_point import AT_LIMIT, MIXES, REGULARISATION, Measures, Stages
from lqrsim.solvers.settings import INSIDE

STEPS = 12  # at most: what takes more does not get there
PIVOTS, FEW = 15, 4  # of the rows in a convex problem, at most; and in one that need not be
PATIENCE = 3  # pivots that do not bring fewer wrong rows, before they change one at a time
SHARES = (0.0, 0.3)  # of the convex models in those of a step, tried in turn
PENALTY = 8.0  # that holds the policy to the constraints, in cost for a change by a row's size


class ActiveSet:
    """The steps from one plan.

    Args:
      stages: of the problem.
      plan: states (T+1, n) and controls (T, m) to begin with, which need not be a motion; the first state is the start.
      multipliers: of the constraints, (T+1, rows) each, or none.
      violation: by how much equalities may be missed; a share of that is what inequalities are to have to spare.

    Attributes:
      plan: where the steps have come to. measures: of that. force, held: (T+1, R) the rows' multipliers, and 1 for
        those that are held at zero, else 0. sizes: by how much things change. hopeless: whether it is an optimum but
        for rows that no multiplier brings to be kept. looking: how long models of a plan took, in s.
    """

    def __init__(self, stages: Stages, plan: Motion, multipliers: tuple[Array, ...], violation: float) -> None:
        self.stages, self.plan, self._violation = stages, plan, violation
        self.hopeless = False
        shape, limit, rows = stages.live.shape, stages.owners == -1, stages.active
        live, self.held, numbers, self.force, self._pressing = (one.reshape(shape) for one in rows[2:-1])
        live[...], self.held[...], self.force[...] = stages.live, 0.0, 0.0
        for k, one in enumerate(multipliers):
            self.force[:, stages.owners == k] = one
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
        """Go on until the measures are within tolerance; whether they are.

        Args:
          tolerance: of stationarity, gaps and complementarity.
          watch: called with the measures after each step; True ends it.
          late: called with so many seconds before what takes about that long, in a step; True ends it where the plan
            was before that step.
        """
        self._late = late
        ended = False
        for _ in range(STEPS):
            before = self.measures
            if self._within(tolerance) or ended or not self._step():
                break
            ended = watch(self.measures) or not np.isfinite(self.measures.cost)
            # Where all else is right, what is still missed cannot be kept.
            idle = max(before.stationarity, before.gap) < tolerance
            self.hopeless = idle and self.measures.violation > 0.5 * before.violation > self._violation
            ended = ended or self.hopeless
        return self._within(tolerance)

    def carried_out(self) -> tuple[Motion, Array, float, list[Array]]:
        """The motion that the plan comes to with gains about it (T, m, n); these; its cost; the constraints' numbers.

        The gains are those of a step with a price on missing the rows that press, and zero at limits.
        """
        stages = self.stages
        for share in MIXES:
            if self._solve(share, price=PENALTY * REGULARISATION)[0]:
                break
        else:
            stages.gain[...] = 0.0
        gain = stages.gain.copy()
        plan, cost, values = stages.carry_out(Motion(self.plan.states, self.plan.controls.copy()), gain)
        return plan, gain, cost, values

    def multipliers(self) -> list[tuple[Array, float]]:
        """Of each constraint the multipliers (T+1, rows), and the price that the policy has."""
        owners = self.stages.owners
        sizes = [self.sizes.rows[owners == k] for k in range(len(self.stages.problem.constraint_terms))]
        prices = [PENALTY * self._scale / float(np.median(size**2)) if len(size) else 1.0 for size in sizes]
        return [(self.force[:, owners == k].copy(), price) for k, price in enumerate(prices)]

    def _measure(self, cost: float) -> None:
        """Work out the measures of a plan about which the models are."""
        self._scale = max(abs(cost), 1e-6 * self.sizes.cost) if np.isfinite(cost) else np.nan
        steepest, missed, unequal, gap, product = self.stages.measure(self.plan, self._gaps, self.sizes)
        self._kept = missed <= 0 and unequal <= self._violation
        self.measures = Measures(
            cost=cost, stationarity=steepest / self._scale, violation=max(missed, unequal, 0.0), gap=gap,
            complementarity=product / self._scale,
        )  # fmt: skip

    def _within(self, tolerance: float) -> bool:
        found = self.measures
        # What leads from the plan to a motion must not take constraints beyond what they have to spare.
        return self._kept and max(found.stationarity, found.gap / INSIDE, found.complementarity) < tolerance

    def _step(self) -> bool:
        """One step; False where there is none."""
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
        """Whether a pivot and models of a plan would be there too late, with as much to spare as the models take."""
        return self._late(2 * self.looking)

    def _from_convex(self) -> bool:
        """A step with the rows that press in the convex models, or some others; whether there is one."""
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
        """Solve the quadratic problem by so many pivots at most, from the rows that are held.

        The change of the plan is in `stages`.

        Returns:
          How many of the rows are wrong; None without a minimum.
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
        """Solve it with the rows that are held; whether there is a minimum, and how many rows are wrong."""
        if share > 0 and not self._convex:
            self.stages.convexify(self.plan)
            self._convex = True
        weight = self._scale / REGULARISATION
        return self.stages.pivot(self._gaps, share=share, scale=self._scale, weight=weight, price=price)

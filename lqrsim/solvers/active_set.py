"""The active set of `kernels/active_set.py` from one plan, in pieces short enough for a deadline."""

import time
from collections.abc import Callable

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.active_set import BEGIN, FIRMNESS, PIVOT, PREPARE, ROLL_OUT, TAKE
from lqrsim.kernels.declarations import CONVERGED, RUNNING
from lqrsim.kernels.records import Motion
from lqrsim.solvers.interior_point import Measures
from lqrsim.solvers.settings import INSIDE
from lqrsim.solvers.stages import Stages

STEPS = 12  # largest number of steps: a solve that needs more does not converge


class ActiveSet:
    """Steps from one plan.

    Args:
      plan: states (T+1, n) and controls (T, m), not necessarily feasible; the first state is the start.
      multipliers: multipliers of the constraints, (T+1, rows) each, or none.
      violation: tolerance of equalities; a fraction of it is the margin of inequalities.

    Attributes:
      plan: the current plan, which steps overwrite. held: (T+1, R) 1 for rows held at their targets, else 0.
      hopeless: whether the plan is stationary but violates rows that no multiplier corrects.
      model_seconds: spent on the models of a plan.
    """

    def __init__(self, stages: Stages, plan: Motion, multipliers: tuple[Array, ...], violation: float) -> None:
        self._stages, self._violation, self.hopeless = stages, float(violation), False
        self._arrays, self._memory = stages.active_set
        self.plan, self.held, self._force = self._arrays.plan, stages.held, stages.force
        self.plan.states[...], self.plan.controls[...] = plan
        stages.state(price=np.inf, margin=INSIDE * violation)
        self._force[...] = stages.of_constraints(multipliers)
        clock = time.perf_counter()
        self._call(BEGIN)
        self.model_seconds = time.perf_counter() - clock

    @property
    def measures(self) -> Measures:
        """The measures of the plan."""
        return Measures.of(self._memory)

    def run(self, tolerance: float, watch: Callable[[Measures], bool], late: Callable[[float], bool]) -> bool:
        """Take steps until the measures are within tolerance; return whether they are.

        Args:
          tolerance: tolerance of stationarity, gaps and complementarity.
          watch: called with the measures after each step; True ends it.
          late: called before a piece of work with its expected duration in seconds; True abandons the step.
        """
        ended = False
        for _ in range(STEPS):
            before = self.measures
            if self._within(tolerance) or ended or not self._step(late):
                break
            ended = watch(self.measures) or not np.isfinite(self.measures.cost)
            # If everything else is within tolerance, a remaining violation cannot be removed.
            idle = max(before.stationarity, before.gap) < tolerance
            self.hopeless = idle and self.measures.violation > 0.5 * before.violation > self._violation
            ended = ended or self.hopeless
        return self._within(tolerance)

    def _within(self, tolerance: float) -> bool:
        measures = self.measures
        # The rollout of the plan must not use up the margin of the constraints.
        feasible = self._memory["kept"][0] > 0
        return feasible and max(measures.stationarity, measures.gap / INSIDE, measures.complementarity) < tolerance

    def _step(self, late: Callable[[float], bool]) -> bool:
        """Take a step; return False if there is none, or no time for it: twice that of the models is needed."""
        before = self.held.copy()
        self._call(PREPARE)
        outcome = RUNNING
        while outcome == RUNNING:
            outcome = self._call(PIVOT)
            if late(2 * self.model_seconds):
                self.held[...] = before
                return False
        if outcome == CONVERGED:
            self._call(TAKE)
        return outcome == CONVERGED

    def carried_out(self) -> tuple[Motion, Array, float, list[Array]]:
        """The rollout of the plan with gains (T, m, n) about it; the gains; its cost; the constraints' values."""
        about, steps = self._stages.about, self._stages.steps
        self._call(ROLL_OUT)
        values = [rows.reshape(steps + 1, -1) for rows in about.values]
        return Motion(*map(np.copy, self._arrays.out)), about.policy.gain.copy(), self.measures.cost, values

    def multipliers(self) -> list[tuple[Array, float]]:
        """Multipliers (T+1, rows) and penalty of each constraint."""
        owners, scale = self._stages.owners, float(self._memory["scale"][0])
        multipliers = []
        for k in range(len(self._stages.problem.constraint_terms)):
            sizes = self._stages.row_sizes[owners == k]
            price = FIRMNESS * scale / float(np.median(sizes**2)) if len(sizes) else 1.0
            multipliers.append((self._force[:, owners == k].copy(), price))
        return multipliers

    def _call(self, task: int) -> int:
        return self._stages.call("active_set", task, self._violation, self._stages.about, self._arrays, self._memory)

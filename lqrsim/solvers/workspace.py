"""The arrays of one solve, and what can be read from them."""

import contextlib
from functools import partial
from typing import Any

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations, records
from lqrsim.kernels.records import (
    CERTIFICATE,
    MEMORY,
    CostModel,
    CostToCome,
    CostToGo,
    Motion,
    Policy,
    Prior,
    SmootherGains,
)
from lqrsim.problem.constraints import allowed_violation, violation_of
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.value_functions import Moments, Quadratic
from lqrsim.solvers import compiled
from lqrsim.solvers.common import INSIDE, SmootherSettings
from lqrsim.solvers.initial_guess import InitialGuess


class Workspace:
    """What the iterations read and write.

    Attributes:
      arrays: what is in `records.SmootherArrays`. model: the problem's numbers.
      memory: what one iteration of the safeguard leaves to the next, a row of `MEMORY`; memory_rows: (1,) that row.
      multipliers: of each constraint, as `augmented_lagrangian.py` has them; changes act at once.
      core: the compiled iterations. fixed: whether the start is given exactly. dual: which form it is.
    """

    def __init__(self, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array) -> None:
        n, steps, zeros = len(start), problem.steps, np.zeros
        m = initial_guess.offset.shape[1]
        self.dual = settings.form == "dual"
        self.core, self._costs = compiled.core(problem, settings.form), compiled.costs_module(problem)
        self.no_prior = Prior(zeros(n), zeros((steps + 1, n)))
        self.memory_rows = zeros(1, MEMORY)
        self.memory = self.memory_rows[0]
        kept = steps if self.dual else 1  # the primal form finds its way back without

        def plan() -> Motion:
            return Motion(zeros((steps + 1, n)), zeros((steps, m)))

        def policy() -> Policy:
            return Policy(zeros((steps, m, n)), zeros((steps, m)))

        self.multipliers: list[Array] = []
        self.arrays = records.SmootherArrays(
            start=zeros(n), x_hat=zeros(n), x_hats=zeros((steps + 1, n)), policy=policy(),
            to_go=CostToGo(zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)),
            to_come=CostToCome(zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)),
            smoothing=SmootherGains(zeros((kept, n, n)), zeros((kept, n)), zeros((steps, m, n)), zeros((steps, m))),
            homotopy_scaled=None, prior=self.no_prior, guess=plan(), plan=plan(), rollout=plan(), kept=policy(),
            certificate=zeros(1, CERTIFICATE),
        )  # fmt: skip
        self.begin(problem, settings, initial_guess, start)

    def begin(self, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array) -> None:
        """Begin a solve; after another one, of a problem of the same size with as many steps."""
        self._problem, self._tolerance, steps = problem, settings.missed(problem), problem.steps
        self._exact, self.priced = settings.newton(problem), np.isfinite(settings.price)
        self.fixed = isinstance(problem.initial, FixedState)
        self.prior, self.prior_iterations = self.no_prior, 0
        if initial_guess.prior is not None:
            about = np.broadcast_to(initial_guess.prior.about, (steps + 1, len(start))).copy()
            self.prior = Prior(initial_guess.prior.weight.copy(), about)
            self.prior_iterations = initial_guess.prior.iterations
        spare = INSIDE * self._tolerance if self._exact else self._tolerance
        multipliers = [compiled.no_multipliers(problem, one, spare, settings.price) for one in problem.constraint_terms]
        for array, known in zip(multipliers, initial_guess.multipliers, strict=False):
            array[0], array[declarations.HEADER :] = known.penalty, known.values.ravel()
        self.multipliers = multipliers
        self.model = compiled.arguments(problem, multipliers=multipliers, second_order=settings.newton(problem))
        arrays = self.arrays = self.arrays._replace(homotopy_scaled=self.model.stage, prior=self.prior)
        # All else is written before it is read.
        self.memory_rows[...] = 0.0
        arrays.start[...] = arrays.x_hat[...] = start
        arrays.policy.gain[...], arrays.policy.offset[...] = initial_guess.gain, initial_guess.offset
        value = initial_guess.cost_to_go
        known = (0.0, 0.0, 0.0) if value is None else (value.hessian, value.gradient, value.constant)
        for array, given in zip(arrays.to_go, known, strict=True):
            array[...] = given
        # Without a trajectory to begin with: the start, and the controls with which the dynamics can run backwards.
        plan = initial_guess.trajectory
        for array in (arrays.guess, arrays.plan):
            array.states[...] = start if plan is None else plan.states
            array.controls[...] = initial_guess.offset if plan is None else plan.controls

    @property
    def start(self) -> Array:
        """Where it begins, (n,)."""
        return self.arrays.start

    @property
    def plan(self) -> Motion:
        """The best so far."""
        return self.arrays.plan

    @property
    def states(self) -> Array:
        """Where the last policy led, (T+1, n)."""
        return self.arrays.rollout.states

    @property
    def controls(self) -> Array:
        """Those of that, (T, m)."""
        return self.arrays.rollout.controls

    def value_functions(self) -> dict[str, Any]:
        """Cost-to-go, cost-to-come and inverse law of the last passes, as `assemble` takes them."""
        to_go, to_come = Quadratic(*self.arrays.to_go), self.arrays.to_come
        inverse = self.arrays.smoothing.control_gain, self.arrays.smoothing.control
        if not self.dual:
            return {"cost_to_go": to_go, "cost_to_come": Quadratic(*to_come), "inverse_law": inverse}
        covariance, mean, _ = to_come
        law = None
        if not self.fixed:  # or the first covariances are singular
            # u = gain costate + offset, where the costate at a state of arrival x is -covariance^-1 (x - mean).
            with contextlib.suppress(np.linalg.LinAlgError):
                gain = -np.linalg.solve(covariance[1:], np.swapaxes(inverse[0], 1, 2))
                gain = np.ascontiguousarray(np.swapaxes(gain, 1, 2))
                law = gain, inverse[1] - np.einsum("tij,tj->ti", gain, mean[1:])
        return {"cost_to_go": to_go, "cost_to_come": Moments(*to_come), "inverse_law": law}

    def homotopy_scaled(self, share: float) -> CostModel:
        """The stage cost with that share of what the homotopy scales; see `CostTerm.factor`."""
        if share == 1:
            return self.model.stage
        data = list(self.model.stage.data)
        for i, term in enumerate(compiled.cost_terms(self._problem, "stage_cost")):
            if term.factor is not None:
                data[i] = data[i].copy()
                data[i][len(term.functions) + term.factor] *= share
        return self.model.stage._replace(data=tuple(data))

    def constraint_values(self, states: Array, controls: Array) -> list[Array]:
        """Of each constraint (T+1, rows): not to be negative, or zero; where it does not act, infinite or zero."""
        values = [np.empty(len(multipliers) - declarations.HEADER) for multipliers in self.multipliers]
        if values:
            constraints = self.model.stage.constraints
            self._costs.evaluate_constraints(self._problem.steps, states, controls, constraints, tuple(values))
        return [one.reshape(self._problem.steps + 1, -1) for one in values]

    def constraint_slope(self, which: int, row: int, x: Array, u: Array, step: int) -> Array:
        """Gradient (n+m,) of one of a constraint's numbers."""
        slope = np.zeros(len(x) + len(u))
        self._costs.slope_of_constraint(which, row, x, u, step, self.model.stage.constraints, slope)
        return slope

    def violation(self, values: list[Array]) -> float:
        """By how much the worst constraint is missed, given their values; 0 where none is, infinite if one is NaN."""
        terms = self._problem.constraint_terms
        return max((violation_of(term, one) for term, one in zip(terms, values, strict=True)), default=0.0)

    def keeps(self, values: list[Array]) -> bool:
        """Whether values are those of a plan that keeps all constraints, within what they may be missed by.

        Those that have a price may be missed by anything.
        """
        pairs = zip(self._problem.constraint_terms, values, strict=True)
        allowed = partial(allowed_violation, tolerance=self._tolerance, spared=not self._exact)
        return self.priced or all(violation_of(term, one) <= allowed(term) for term, one in pairs)

"""The memory of one solve, and what can be read from it."""

import contextlib
from typing import Any

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import interface
from lqrsim.problem.constraints import allowed_violation, violation_of
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.value_functions import Moments, Quadratic
from lqrsim.solvers import compiled
from lqrsim.solvers.common import SmootherSettings, model
from lqrsim.solvers.initial_guess import Start


class Workspace:
    """What the loops read and write; see `kernels/iterations.py` and `damped_iterations.py` for what each is.

    Attributes:
      multipliers: of each constraint, as `kernels/augmented_lagrangian.py` has them; changes act at once.
      core: the compiled loops.
    """

    def __init__(self, problem: Problem, settings: SmootherSettings, begin: Start, start: Array) -> None:
        n, steps, zeros = len(start), problem.steps, np.zeros
        m = begin.offset.shape[1]
        self.dual = settings.form == "dual"
        self.fixed = isinstance(problem.initial, FixedState)
        self.start = start
        self.x_hat, self.x_hats = self.start.copy(), zeros((steps + 1, n))
        self.law = begin.gain.copy(), begin.offset.copy()
        self.go = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
        if begin.cost_to_go is not None:
            value = begin.cost_to_go
            self.go = value.hessian.copy(), value.gradient.copy(), np.array(value.constant)
        self.come = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
        kept = steps if self.dual else 1  # the primal form finds its way back without
        self.back = zeros((kept, n, n)), zeros((kept, n)), zeros((steps, m, n)), zeros((steps, m))
        self.no_prior = zeros(n), zeros((steps + 1, n))
        self.prior = (*self.no_prior, 0)
        if begin.prior is not None:
            about = np.broadcast_to(begin.prior.about, (steps + 1, n)).copy()
            self.prior = begin.prior.weight.copy(), about, begin.prior.iterations
        # Without a trajectory to begin with: the start, and the controls with which the dynamics can run backwards.
        self.guess = np.tile(self.start, (steps + 1, 1)), begin.offset.copy()
        if begin.trajectory is not None:
            self.guess = begin.trajectory.states.copy(), begin.trajectory.controls.copy()
        self.plan = self.guess[0].copy(), self.guess[1].copy()
        self.states, self.controls = zeros((steps + 1, n)), zeros((steps, m))
        self.kept = zeros((steps, m, n)), zeros((steps, m))
        self.memory = zeros(interface.MEMORY)
        spare = settings.constraint_tolerance
        self.multipliers = [compiled.no_multipliers(problem, one, spare) for one in problem.constraint_terms]
        for array, known in zip(self.multipliers, begin.multipliers, strict=False):
            array[0], array[interface.HEADER :] = known.penalty, known.values.ravel()
        self.core = compiled.core(problem, settings.form)
        self.model = model(problem, self.multipliers)
        self._problem, self._tolerance = problem, settings.constraint_tolerance

    @property
    def passes(self) -> tuple[Any, ...]:
        """The part that all loops have."""
        return (
            self.start, self.x_hat, self.x_hats, *self.law, *self.go, *self.come, *self.back, *self.model
        )  # fmt: skip

    def value_functions(self) -> dict[str, Any]:
        """Cost-to-go, cost-to-come and inverse law of the last passes, as `assemble` takes them."""
        if not self.dual:
            inverse = self.back[2], self.back[3]
            return {"cost_to_go": Quadratic(*self.go), "cost_to_come": Quadratic(*self.come), "inverse_law": inverse}
        covariance, mean, _ = self.come
        inverse = None
        if not self.fixed:  # or the first covariances are singular
            # u = gain costate + offset, where the costate at a state of arrival x is -covariance^-1 (x - mean).
            with contextlib.suppress(np.linalg.LinAlgError):
                gain = -np.linalg.solve(covariance[1:], np.swapaxes(self.back[2], 1, 2))
                gain = np.ascontiguousarray(np.swapaxes(gain, 1, 2))
                inverse = gain, self.back[3] - np.einsum("tij,tj->ti", gain, mean[1:])
        return {"cost_to_go": Quadratic(*self.go), "cost_to_come": Moments(*self.come), "inverse_law": inverse}

    def eased(self, share: float) -> Any:
        """The stage cost with that share of what may be eased; see `Term.factor`."""
        stage = list(self.model[3])
        for i, term in enumerate(self._problem.terms("stage_cost")):
            if share != 1 and term.factor is not None:
                stage[i] = stage[i].copy()
                stage[i][len(term.functions) + term.factor] *= share
        return tuple(stage)

    def constraint_values(self, states: Array, controls: Array) -> list[Array]:
        """Of each constraint (T+1, rows): not to be negative, or zero; where it does not act, infinite or zero."""
        values = [np.empty(len(multipliers) - interface.HEADER) for multipliers in self.multipliers]
        if values:
            self.core.evaluate_constraints(self._problem.steps, states, controls, self.model[3], tuple(values))
        return [one.reshape(self._problem.steps + 1, -1) for one in values]

    def constraint_slope(self, which: int, row: int, x: Array, u: Array, step: int) -> Array:
        """Gradient (n+m,) of one of a constraint's numbers."""
        slope = np.zeros(len(x) + len(u))
        self.core.slope_of_constraint(which, row, x, u, step, self.model[3], slope)
        return slope

    def violation(self, values: list[Array]) -> float:
        """By how much the worst constraint is missed, given their values; 0 where none is, infinite if one is NaN."""
        terms = self._problem.constraint_terms
        return max((violation_of(term, one) for term, one in zip(terms, values, strict=True)), default=0.0)

    def keeps(self, values: list[Array]) -> bool:
        """Whether values are those of a plan that keeps all constraints, the equalities within their tolerance."""
        pairs = zip(self._problem.constraint_terms, values, strict=True)
        return all(violation_of(term, one) <= allowed_violation(term, self._tolerance) for term, one in pairs)

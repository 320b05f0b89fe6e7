"""A problem as a function of its controls alone, in plain NumPy, solved by SciPy's SLSQP.

Nothing of the package's solvers is used; formulas are evaluated by `oracle.kkt`, derivatives are complex steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from oracle import constraints, kkt
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array

TINY = 1e-30


@dataclass(frozen=True)
class Conditions:
    """Residuals of the first-order conditions; all but the violation are relative, and 0 is best.

    Attributes:
      slope: what is left of the slope of the Lagrangian in controls that are inside their limits, and in a soft start.
      pressing: the same of controls at a limit, where it points inwards.
      sign: how far multipliers of inequalities are below zero.
      spare: the largest product of a multiplier and what its constraint has to spare, relative to the cost.
      violation: of the worst constraint, in its unit.
    """

    slope: float
    pressing: float
    sign: float
    spare: float
    violation: float


class Shooting:
    """The cost and the constraints of a problem at z: the controls, and with a soft start the first state."""

    def __init__(self, problem: ls.Problem) -> None:
        dynamics = problem.dynamics
        self.problem, self.steps = problem, problem.steps
        self.n, self.m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        self.free = 0 if isinstance(problem.initial, ls.FixedState) else self.n
        self.size = self.free + self.steps * self.m
        self.kept = constraints.of(problem)
        space = problem.control_coordinates
        self.low, self.high = (
            np.concatenate([np.full(self.free, sign * np.inf), np.tile(side, self.steps)])
            for sign, side in ((-1, space.low), (1, space.high))
        )

    def pack(self, plan: ls.Trajectory) -> Array:
        return np.concatenate([plan.states[0][: self.free], plan.controls.ravel()])

    def points(self, z: Any) -> Any:
        """States and controls (..., T+1, n+m) at z (..., size); the last control is zero."""
        problem, shape = self.problem, z.shape[:-1]
        controls = z[..., self.free :].reshape(*shape, self.steps, self.m)
        x = z[..., : self.free] if self.free else np.broadcast_to(np.asarray(problem.start), (*shape, self.n))
        rate, numbers, states = kkt.rate_of(problem, None), kkt.numbers_of(problem), [x]
        for t in range(self.steps):
            states.append(kkt.step(rate, states[-1], controls[..., t, :], numbers, problem.dt))
        controls = np.concatenate([controls, 0 * controls[..., :1, :]], axis=-2)
        return np.concatenate([np.stack(states, axis=-2), controls], axis=-1)

    def cost(self, z: Any) -> Any:
        return self.parts(z).sum(axis=-1)

    def parts(self, z: Any) -> Any:
        """Each term of the cost, (..., k)."""
        problem, points = self.problem, self.points(z)
        parts = self._sums(problem.stage_cost, points[..., :-1, :], 0)
        parts += self._sums(problem.final_cost, points[..., -1:, : self.n], -1)
        parts += self._sums(problem.initial, points[..., :1, : self.n], 0) if self.free else []
        return np.stack(parts, axis=-1)

    def _sums(self, cost: Any, points: Any, first: int) -> list[Any]:
        terms = kkt.functions_of(self.problem, cost, self.n, points.shape[-1], first)
        return [function(points[..., skip:, place]).sum(axis=-1) for function, place, skip, _ in terms]

    def rows(self, z: Any, equality: bool) -> Any:
        """All equalities or all inequalities (..., k), at the steps where they apply."""
        points = self.points(z)
        chosen = [one.function(points)[..., one.acts] for one in self.kept if one.equality == equality]
        return np.concatenate([np.zeros((*z.shape[:-1], 0)), *chosen], axis=-1)

    def slope(self, function: Callable[[Any], Any], z: Array) -> Array:
        """The derivatives (..., size) of a function at z."""
        return np.moveaxis(function(z + 1j * TINY * np.eye(len(z))).imag, 0, -1) / TINY

    def conditions(self, solution: ls.Solution) -> Conditions:
        """Residuals of a solution's first-order conditions with its own multipliers."""
        z = self.pack(solution.trajectory)
        left = self.slope(self.cost, z)
        size = np.abs(self.slope(self.parts, z)).sum(axis=0)
        sign, spare, violation = 0.0, 0.0, 0.0
        for k, one in enumerate(self.kept):
            values = one.function(self.points(z))[one.acts]
            violation = max(violation, float((np.abs(values) if one.equality else -values).max(initial=0.0)))
            if not solution.multipliers:
                continue
            acts: Any = one.acts
            force = solution.multipliers[k].values[acts]
            assert not solution.multipliers[k].values[~acts].any()  # none where nothing acts
            slopes = self.slope(lambda z, one=one: one.function(self.points(z))[..., one.acts], z)
            left = left - force @ slopes
            size = size + np.abs(force) @ np.abs(slopes)
            if not one.equality:
                sign = max(sign, float(-force.min(initial=0.0)))
                spare = max(spare, float(np.abs(force * values).max(initial=0.0)))
        at_low, at_high = z <= self.low, z >= self.high
        left = left / size.max()
        inwards = np.where(at_low, -left, np.where(at_high, left, 0.0))
        return Conditions(
            slope=float(np.abs(left[~(at_low | at_high)]).max(initial=0.0)), pressing=float(inwards.max()),
            sign=sign, spare=spare / max(abs(solution.cost), 1e-12), violation=violation,
        )  # fmt: skip

    def least(self, z: Array, *, price: float | None = None, cost: float = 1.0) -> tuple[Array, float]:
        """The optimum that SLSQP finds from z and its value: the cost, with `price` also that of missed constraints.

        With a price there are slack variables; `cost` weighs the cost beside it.
        """
        k = self.size
        counts = [self.rows(z, equality).shape[-1] for equality in (True, False)]
        slacks = 0 if price is None else 2 * counts[0] + counts[1]

        def held(equality: bool) -> dict[str, Any]:
            first = k if equality else k + 2 * counts[0]
            count = counts[0] if equality else counts[1]
            spread = np.zeros((count, slacks))
            if slacks:
                spread[:, first - k : first - k + count] = np.eye(count)
                if equality:
                    spread[:, count : 2 * count] = -np.eye(count)
            return {
                "type": "eq" if equality else "ineq",
                "fun": lambda z: self.rows(z[:k], equality) + spread @ z[k:],
                "jac": lambda z: np.hstack([self.slope(lambda y: self.rows(y, equality), z[:k]), spread]),
            }

        def value(z: Array) -> float:
            return float(cost * self.cost(z[:k])) + (price or 0.0) * float(z[k:].sum())

        def gradient(z: Array) -> Array:
            return np.concatenate([cost * self.slope(self.cost, z[:k]), np.full(slacks, price or 0.0)])

        first = np.zeros(slacks)
        if slacks:
            equal, other = self.rows(z, True), self.rows(z, False)
            first = np.concatenate([np.maximum(-equal, 0), np.maximum(equal, 0), np.maximum(-other, 0)])
        bounds = [*zip(self.low, self.high, strict=True), *[(0.0, np.inf)] * slacks]
        found = minimize(
            value, np.concatenate([np.clip(z, self.low, self.high), first]), jac=gradient, method="SLSQP",
            bounds=bounds, constraints=[held(kind) for kind, count in zip((True, False), counts, strict=True) if count],
            options={"maxiter": 500, "ftol": 1e-14},
        )  # fmt: skip
        return found.x[:k], float(found.fun)

"""Restoration: descent on an exact penalty, to a plan that violates the constraints least.

A violation costs its size times a price, smoothed by a logarithmic barrier with a decreasing parameter. A separate
barrier keeps controls within their limits. Steps are Newton steps by the Riccati recursion, and are rolled out in
closed loop. Every plan therefore satisfies the dynamics, and each has a lower merit than the previous iterate. Far
from a solution this is more reliable than the interior point, whose states need not satisfy the dynamics. Near a
solution it is slower.

Far from feasibility the penalty is linear in the constraint. It has no curvature, so the minimum of a quadratic model
may be anywhere. Two things are added: the curvature of the parabola that touches the penalty from above, and weights on
changes of controls. Both are reduced after full steps and increased after short steps.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Limits, Motion, Policy
from lqrsim.solvers.stages import Sizes, Stages, joined

FIRST, LEAST, FALL = 1e-1, 1e-6, 0.2  # first and least barrier parameter, relative to the price; factor
SETTLED = 0.1  # predicted decrease per row, relative to the parameter, below which the parameter falls
LAST = 1e-6  # predicted decrease over all rows at the end: multipliers are accurate to its square root
ARMIJO, SHORTEST = 1e-4, 1e-6
INSIDE = 0.01  # fraction of the distance to a limit that a step leaves
EDGE = 0.01  # distance from the limits at the beginning, relative to the range
WEIGHTS = (1e-6, 1e-4, 1e-2, 1.0, 1e2)  # weights on changes of controls, relative to cost and price
DAMPING, LIGHT, HEAVY = 0.1, 1e-3, 1e6  # weight at a damping of 1; bounds of the damping
LONG, SHORT, TIMES = 0.4, 0.2, 4.0  # fractions above or below which the damping falls or grows; factor
WIDE = 1e3  # factor by which a multiplier may differ from the multiplier that the barrier implies
# The descent ends when the violation (relative to the rows' sizes) is below CLOSE and the change of cost below SLOW,
# PATIENCE times in a row.
CLOSE, SLOW, PATIENCE = 1e-4, 1e-2, 2
LEVEL, FINER = 1e-4, 0.1  # negligible predicted decrease, relative to the merit; factor by which it falls


@dataclass(frozen=True)
class Restored:
    """A trajectory; whether its violation is stationary (`settled`), and whether it is nearly feasible (`near`)."""

    plan: Motion
    settled: bool
    near: bool


class Penalty:
    """The cost of violated rows (K,), smoothed by a barrier. Control limits have no price, but their own barrier.

    Attributes:
      size, equality, limit: for each row. highest: the price per unit. lowest: the least multiplier.
    """

    def __init__(self, stages: Stages, sizes: Sizes, price: float) -> None:
        self.size, self.equality = stages.of_each(sizes.rows), stages.of_each(stages.equality)
        self.limit = stages.of_each(stages.owners == -1)
        self.highest = price * sizes.cost / self.size
        self.lowest = np.where(self.equality, -self.highest, 0.0)

    def merit(self, numbers: Array, cost: float, parameter: float) -> float:
        """Cost plus penalties of rows with these values, at a barrier parameter."""
        slack, excess = self._slacks(numbers, parameter)
        paid = self.highest * (excess + np.where(self.equality, slack, 0.0))
        paid = paid - parameter * (np.log(slack) + np.log(excess))
        with np.errstate(all="ignore"):
            inside = np.where(self.limit, -parameter * np.log(np.where(self.limit, numbers, 1.0)), 0.0)
        total = cost + float(np.where(self.limit, inside, paid).sum())
        return total if np.isfinite(total) else np.inf

    def model(self, numbers: Array, dual: Array | None, parameter: float, damping: float) -> tuple[Array, Array, Array]:
        """Forces (K,) and curvatures of the penalties, and the multipliers; unknown multipliers are the forces."""
        slack, excess = self._slacks(numbers, parameter)
        room = np.where(self.limit, numbers, slack)
        force = self.lowest + parameter / room
        dual = force if dual is None else dual
        low = np.clip(dual - self.lowest, parameter / room / WIDE, parameter / room * WIDE)
        high = np.clip(self.highest - dual, parameter / excess / WIDE, parameter / excess * WIDE)
        own = np.where(self.limit, low / room, 1 / (room / low + excess / high))
        chord = parameter / (slack * np.where(self.equality, 2 * excess, slack + excess))
        curvature = np.where(self.limit, own, own + min(damping, 1.0) * np.maximum(chord - own, 0.0))
        return force, curvature, dual

    def missed(self, numbers: Array) -> Array:
        """Violations of all rows except limits; negative for inequalities that hold."""
        return np.where(self.limit, 0.0, np.where(self.equality, np.abs(numbers), -numbers))

    def shares(self, multipliers: Array) -> Array:
        """Multipliers relative to the price, from -1 to 1; 0 for limits."""
        return np.where(self.limit, 0.0, np.clip(multipliers, self.lowest, self.highest) / self.highest)

    def _slacks(self, numbers: Array, parameter: float) -> tuple[Array, Array]:
        """The two slacks of each row, whose difference is its value, that minimise price and barrier."""
        steep = np.where(self.equality, 2 * self.highest, self.highest)
        root = np.hypot(steep * numbers, 2 * parameter)
        rest = 4 * parameter**2 / (root + steep * np.abs(numbers))  # root - steep |numbers|, without cancelling
        small = (2 * parameter + rest) / (2 * steep)
        large = (2 * parameter + root + steep * np.abs(numbers)) / (2 * steep)
        return np.where(numbers > 0, large, small), np.where(numbers > 0, small, large)


def restore(
    stages: Stages, plan: Motion, sizes: Sizes, *, price: float, most: int,
    watch: Callable[[float, float, float], bool], stationary: Callable[[Motion, list[Array]], bool],
) -> Restored | None:  # fmt: skip
    """Descend from a feasible trajectory: states (T+1, n), controls (T, m).

    Args:
      price: price of violating a constraint by its typical size, in units of the typical cost. most: largest number of
        iterations.
      watch: called after each iteration with cost, violation and relative predicted decrease; True ends the descent.
      stationary: called once the predicted decrease is negligible; returns whether the violation of a trajectory is
        stationary. It gets each constraint's multipliers relative to the price, (T+1, rows), from -1 to 1. True ends
        the descent.
    """
    live, penalty = stages.live, Penalty(stages, sizes, price)
    count = max(len(penalty.size), 1)
    edge = EDGE * np.where(np.isfinite(stages.high - stages.low), stages.high - stages.low, 0.0)
    begun = Motion(plan.states, in_c_order(np.clip(plan.controls, stages.low + edge, stages.high - edge)))
    still = Policy(np.zeros((stages.steps, stages.m, stages.n)), np.zeros((stages.steps, stages.m)))
    plan = stages.follow(begun, 0.0, still, _limits(stages, begun.controls))
    parameter, least = FIRST * price * sizes.cost / count, LEAST * price * sizes.cost / count
    diagonal, none = np.arange(stages.n, stages.n + stages.m), np.zeros((stages.steps, stages.n))
    settled, near, damping, close, level, dual, before = False, False, 1.0, 0, LEVEL, None, np.inf
    force, costates = np.zeros(len(penalty.size)), np.zeros((stages.steps + 1, stages.n))
    for _ in range(most):
        cost, numbers = stages.trial(plan)[0], stages.values(plan)[live]
        if not np.isfinite(cost) or not np.isfinite(numbers).all():
            return None
        stages.linearize(plan, costates, stages.spread(force), 0.0)
        while True:
            force, curvature, dual = penalty.model(numbers, dual, parameter, damping)
            gradient, barrier = stages.models.gradient - stages.pull(force), stages.curvature(curvature)
            barrier[:, diagonal, diagonal] += damping * DAMPING * price * sizes.cost / sizes.controls**2 / stages.steps
            weights = (weight * price * sizes.cost / sizes.controls**2 / stages.steps for weight in WEIGHTS)
            if not any(stages.direction(hessian, gradient, none) for hessian in stages.hessians(barrier, weights)):
                return None
            slope = float((gradient * joined(stages.changes)).sum())
            if -slope > SETTLED * parameter * len(penalty.size) or parameter <= least:
                break
            parameter = max(FALL * parameter, least)
        costates = stages.to_go.gradient.copy()
        now = penalty.merit(numbers, cost, parameter)
        part, taken, limits = 1.0, None, _limits(stages, plan.controls)
        while part > SHORTEST:
            tried = stages.follow(plan, part, stages.policy, limits)
            if np.isfinite(tried.states).all():
                value = penalty.merit(stages.values(tried)[live], stages.trial(tried)[0], parameter)
                if value <= now + ARMIJO * part * slope + 1e-13 * abs(now):
                    taken = tried
                    break
            part /= 2
        aim = force - curvature * stages.moved()  # the multipliers after the whole step
        dual = dual + part * (aim - dual)
        if part > LONG:
            damping /= TIMES
        elif part < SHORT:
            damping = min(max(TIMES * damping, LIGHT), HEAVY)
        missed = penalty.missed(numbers)
        near = float((missed / penalty.size).max(initial=0.0)) < CLOSE
        close = close + 1 if near and abs(before - cost) < SLOW * abs(cost) else 0
        before = cost
        promised = -0.5 * slope / max(abs(now), 1e-300)
        if watch(cost, float(missed.max(initial=0.0)), promised) or close == PATIENCE:
            break
        if not near and 2 * promised < level and damping < 1:
            shares = stages.spread(penalty.shares(aim))
            terms = range(len(stages.problem.constraint_terms))
            settled = stationary(plan, [shares[:, stages.owners == k] for k in terms])
            if settled:
                break
            level *= FINER
        if taken is None or (parameter <= least and -slope < LAST * parameter):
            break
        plan = taken
    return Restored(plan, settled, near)


def _limits(stages: Stages, controls: Array) -> Limits:
    """Bounds of the controls in one step."""
    low = np.where(np.isfinite(stages.low), stages.low + INSIDE * (controls - stages.low), -np.inf)
    high = np.where(np.isfinite(stages.high), stages.high - INSIDE * (stages.high - controls), np.inf)
    return Limits(in_c_order(low), in_c_order(high))

"""From a motion to one that misses constraints least: descent at a price.

Each constraint that is missed costs its size times a price, smoothed by a logarithmic barrier whose parameter falls;
limits of controls are kept by a barrier of their own. Steps are those of Newton's method in the Riccati recursion, and
are followed in closed loop, so that every plan is a motion, and each costs less than the one before. It comes closer
from afar than the interior point, which lets states part from the dynamics, and finishes slowly, which that does not.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Limits, Motion
from lqrsim.solvers.interior_point import MIXES, Sizes, Stages

FIRST, LEAST, FALL = 1e-1, 1e-6, 0.2  # of the barrier's parameter, relative to the price; and what it falls by
SETTLED = 0.1  # of the parameter, a promised decrease for each row below which it falls
LAST = 1e-6  # the same of all rows at the end: shares are right to its root
ARMIJO, SHORTEST = 1e-4, 1e-6
INSIDE = 0.01  # of the way to a limit, what is left by a step
EDGE = 0.01  # of the range, how far inside of the limits controls begin
WEIGHTS = (1e-6, 1e-4, 1e-2, 1.0, 1e2)  # on changes of controls, relative to cost and price


@dataclass(frozen=True)
class Restored:
    """What it came to: a motion; of each constraint the share of its price that it pays (T+1, rows), from -1 to 1.

    `settled` is whether the parameter of the barrier fell all the way.
    """

    plan: Motion
    shares: list[Array]
    settled: bool


def restore(
    stages: Stages, plan: Motion, sizes: Sizes, *, price: float, most: int,
    watch: Callable[[float, float, float], bool],
) -> Restored | None:  # fmt: skip
    """Go down from a motion (states (T+1, n), controls (T, m)).

    Args:
      price: of missing a constraint by its size, in units of the typical cost. most: iterations.
      watch: called with cost, violation and promised decrease, relative to the merit, after each; True ends it.
    """
    live = stages.live
    size = np.broadcast_to(sizes.rows, live.shape)[live]
    equality = np.broadcast_to(stages.equality, live.shape)[live]
    limit = np.broadcast_to(stages.owners == -1, live.shape)[live]
    highest = price * sizes.cost / size
    edge = EDGE * np.where(np.isfinite(stages.high - stages.low), stages.high - stages.low, 0.0)
    controls = np.clip(plan.controls, stages.low + edge, stages.high - edge)
    begun = Motion(plan.states, in_c_order(controls))
    still = np.zeros((stages.steps, stages.m, stages.n)), np.zeros((stages.steps, stages.m))
    plan = stages.follow(begun, 0.0, still, _limits(stages, begun.controls))
    parameter = FIRST * price * sizes.cost / max(len(size), 1)
    least = LEAST * price * sizes.cost / max(len(size), 1)

    def merit(numbers: Array, cost: float) -> float:
        slack, excess = _slacks(numbers, highest, equality, parameter)
        paid = highest * (excess + np.where(equality, slack, 0.0)) - parameter * (np.log(slack) + np.log(excess))
        with np.errstate(all="ignore"):
            inside = np.where(limit, -parameter * np.log(np.where(limit, numbers, 1.0)), 0.0)
        total = cost + float(np.where(limit, inside, paid).sum())
        return total if np.isfinite(total) else np.inf

    settled = False
    force = np.zeros(len(size))
    costates = np.zeros((stages.steps + 1, stages.n))
    for _ in range(most):
        cost, _arrived = stages.trial(plan)
        numbers = stages.values(plan)[live]
        if not np.isfinite(cost) or not np.isfinite(numbers).all():
            return None
        stages.linearize(plan, costates, stages.spread(force), 0.0)
        while True:
            slack, excess = _slacks(numbers, highest, equality, parameter)
            room = np.where(limit, numbers, slack)
            lowest = np.where(equality, -highest, 0.0)
            force = lowest + parameter / room
            curvature = np.where(limit, parameter / room**2, 1 / (slack**2 / parameter + excess**2 / parameter))
            gradient = stages.models.gradient - stages.pull(force)
            barrier = stages.curvature(curvature)
            if not _direction(stages, barrier, gradient, sizes, price):
                return None
            joined = stages.joined()
            slope = float((gradient * joined).sum())
            if -slope > SETTLED * parameter * len(size) or parameter <= least:
                break
            parameter = max(FALL * parameter, least)
        costates = stages.to_go.gradient.copy()
        now = merit(numbers, cost)
        part, taken = 1.0, None
        policy = stages.gain, stages.offset
        limits = _limits(stages, plan.controls)
        while part > SHORTEST:
            tried = stages.follow(plan, part, policy, limits)
            if np.isfinite(tried.states).all():
                value = merit(stages.values(tried)[live], stages.trial(tried)[0])
                if value <= now + ARMIJO * part * slope + 1e-13 * abs(now):
                    taken = tried
                    break
            part /= 2
        missed = float(np.where(limit, 0.0, np.where(equality, np.abs(numbers), -numbers)).max(initial=0.0))
        promised = -0.5 * slope / max(abs(now), 1e-300)
        if watch(cost, missed, promised):
            break
        if parameter <= least and (taken is None or -slope < LAST * parameter):
            settled = -slope < len(size) * parameter
            break
        if taken is None:
            break
        plan = taken
    shares = stages.spread(np.where(limit, 0.0, force / highest))
    count = len(stages.problem.constraint_terms)
    return Restored(plan, [shares[:, stages.owners == k].copy() for k in range(count)], settled)


def _slacks(numbers: Array, highest: Array, equality: Array, parameter: float) -> tuple[Array, Array]:
    """Both slacks of rows, whose difference is the number, where price and barrier together are least."""
    steep = np.where(equality, 2 * highest, highest)
    root = np.hypot(steep * numbers, 2 * parameter)
    rest = 4 * parameter**2 / (root + steep * np.abs(numbers))  # root - steep |numbers|, without cancelling
    small, large = (2 * parameter + rest) / (2 * steep), (2 * parameter + root + steep * np.abs(numbers)) / (2 * steep)
    return np.where(numbers > 0, large, small), np.where(numbers > 0, small, large)


def _direction(stages: Stages, barrier: Array, gradient: Array, sizes: Sizes, price: float) -> bool:
    """Find a step downhill: with as much of the second order as has a minimum."""
    models, none = stages.models, np.zeros((stages.steps, stages.n))
    for mix in MIXES:
        if stages.direction((1 - mix) * models.hessian + mix * models.convex + barrier, gradient, none):
            return True
    diagonal = np.arange(stages.n, stages.n + stages.m)
    for weight in WEIGHTS:
        heavier = models.convex + barrier
        heavier[:, diagonal, diagonal] += weight * price * sizes.cost / sizes.controls**2 / stages.steps
        if stages.direction(heavier, gradient, none):
            return True
    return False


def _limits(stages: Stages, controls: Array) -> Limits:
    """What controls may come to in one step."""
    low = np.where(np.isfinite(stages.low), stages.low + INSIDE * (controls - stages.low), -np.inf)
    high = np.where(np.isfinite(stages.high), stages.high - INSIDE * (stages.high - controls), np.inf)
    return Limits(in_c_order(low), in_c_order(high))

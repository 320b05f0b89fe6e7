"""From a motion to one that misses constraints least: descent at a price.

Each constraint that is missed costs its size times a price, smoothed by a logarithmic barrier whose parameter falls;
limits of controls are kept by a barrier of their own. Steps are those of Newton's method in the Riccati recursion, and
are followed in closed loop, so that every plan is a motion, and each costs less than the one before. It comes closer
from afar than the interior point, which lets states part from the dynamics, and finishes slowly, which that does not.

Far from where it is kept, a constraint's price is straight: it has no curvature, and a step to the minimum of the model
goes anywhere. So curvature is added, that of the parabola which touches the price and is nowhere below it, and changes
of controls are weighed; less of both where steps are taken in full, more where they are not.
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
DAMPING, LIGHT, HEAVY = 0.1, 1e-3, 1e6  # the same where the damping is 1; how small it may grow from, and how large be
LONG, SHORT, TIMES = 0.4, 0.2, 4.0  # parts of a step with which the damping falls or grows, and by what
WIDE = 1e3  # times what the barrier's parameter says of a multiplier, what it may be
# What may be missed, relative to the rows' sizes, and a change of cost, so often in a row that this is the end.
CLOSE, SLOW, PATIENCE = 1e-4, 1e-2, 2
LEVEL, FINER = 1e-4, 0.1  # of the merit, a promised decrease that is next to nothing; and by what that falls


@dataclass(frozen=True)
class Restored:
    """A motion. `settled`: whether what it misses is stationary. `near`: whether it misses next to nothing."""

    plan: Motion
    settled: bool
    near: bool


def restore(
    stages: Stages, plan: Motion, sizes: Sizes, *, price: float, most: int,
    watch: Callable[[float, float, float], bool], stationary: Callable[[Motion, list[Array]], bool],
) -> Restored | None:  # fmt: skip
    """Go down from a motion (states (T+1, n), controls (T, m)).

    Args:
      price: of missing a constraint by its size, in units of the typical cost. most: iterations.
      watch: called with cost, violation and promised decrease, relative to the merit, after each; True ends it.
      stationary: asked, where there is next to nothing to gain, whether what a motion misses is stationary; given of
        each constraint the share of its price that it pays (T+1, rows), from -1 to 1. True ends it.
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

    diagonal = np.arange(stages.n, stages.n + stages.m)
    lowest = np.where(equality, -highest, 0.0)
    settled, near, damping, close, level, dual, before = False, False, 1.0, 0, LEVEL, None, np.inf
    count = len(stages.problem.constraint_terms)
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
            force = lowest + parameter / room
            dual = force if dual is None else dual
            low = np.clip(dual - lowest, parameter / room / WIDE, parameter / room * WIDE)
            high = np.clip(highest - dual, parameter / excess / WIDE, parameter / excess * WIDE)
            own = np.where(limit, low / room, 1 / (room / low + excess / high))
            chord = parameter / (slack * np.where(equality, 2 * excess, slack + excess))
            curvature = np.where(limit, own, own + min(damping, 1.0) * np.maximum(chord - own, 0.0))
            gradient = stages.models.gradient - stages.pull(force)
            barrier = stages.curvature(curvature)
            barrier[:, diagonal, diagonal] += damping * DAMPING * price * sizes.cost / sizes.controls**2 / stages.steps
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
        moved = np.matmul(stages.slopes, joined[:, :, None])[:, :, 0][live]
        aim = force - curvature * moved  # what multipliers come to, with the whole step
        dual = dual + part * (aim - dual)
        if part > LONG:
            damping /= TIMES
        elif part < SHORT:
            damping = min(max(TIMES * damping, LIGHT), HEAVY)
        short = np.where(limit, 0.0, np.where(equality, np.abs(numbers), -numbers))
        missed, near = float(short.max(initial=0.0)), float((short / size).max(initial=0.0)) < CLOSE
        close = close + 1 if near and abs(before - cost) < SLOW * abs(cost) else 0
        before = cost
        promised = -0.5 * slope / max(abs(now), 1e-300)
        if watch(cost, missed, promised) or close == PATIENCE:
            break
        if not near and 2 * promised < level and damping < 1:
            shares = stages.spread(np.where(limit, 0.0, np.clip(aim, lowest, highest) / highest))
            settled = stationary(plan, [shares[:, stages.owners == k] for k in range(count)])
            if settled:
                break
            level *= FINER
        if taken is None or (parameter <= least and -slope < LAST * parameter):
            break
        plan = taken
    return Restored(plan, settled, near)


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

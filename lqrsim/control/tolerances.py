"""Which tolerances a tracking law should have, if nobody says: those under which the robot is least likely to fail.

To fail is to collide, or to end farther from the plan's end than the goal's radius, as the linear model predicts it.
All tolerances follow from one number, the time in which a deviation is to be gone: a state may be off by as much as
random controls of the tolerated effort move it in that time. So it does not matter what the units are, and no part of
the state is held much more tightly than the controls can hold it. Weights that are searched for one by one can have
better predictions, but then the linear model is what they are made for.

What the linear model does not have is what happens when the controls are at their limits for much of the time, so that
is held against a law, too.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lqrsim.control.collision_chance import Surroundings, collision_chance
from lqrsim.control.kalman import KalmanFilter
from lqrsim.control.loop_moments import limited
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking_laws import Weights, tracking_laws
from lqrsim.errors import Array

PERIODS = (4, 6, 8, 10, 12, 14, 17, 20, 24, 29, 35, 42)  # that a deviation may take to be gone
# What a tube of twice the width of the narrowest counts for as a chance of failing: little, so that it decides where
# the plan is clear of everything, or collides whatever the law.
NARROW = 0.02
# What the square of the share of commands beyond the limits adds to the chance of failing. A choice of ours: small
# where few commands are limited, and near 1 where half of them are, for then the linear model says little.
FRAGILE = 3.0


@dataclass(frozen=True)
class Prediction:
    """What is predicted of a law: the chance of failing, the tube's mean width, the share of commands beyond limits."""

    chance: float
    width: float
    saturation: float


@dataclass(frozen=True)
class Choice:
    """Tolerances, with what is predicted under them.

    Attributes:
      tolerate: of each state, (n,). settle: the time in s that they are of. weights: for the law. predicted: of it.
    """

    tolerate: Array
    settle: float
    weights: Weights
    predicted: Prediction


def choose_tolerances(
    model: PlanModel, predicted: Callable[[Weights], list[Prediction]], effort: Array, at_end: float
) -> Choice:
    """The tolerances for a law about a plan.

    Args:
      predicted: predicts for each of C weights what their law leads to.
      effort: what may be added to each control, (m,).
      at_end: as in `track`.
    """
    longest = max(model.plan.steps // 2, PERIODS[0])
    reach, units = reach_of(model, effort, PERIODS[-1]), model.dynamics.state_coordinates.units
    tried = {periods: unit_means(units, reach[periods]) for periods in PERIODS if periods <= longest}
    each = [Weights.of(tuple(one.tolist()), effort, model.dynamics, at_end=at_end) for one in tried.values()]
    all_weights = Weights(np.array([one.state for one in each]), each[0].control, np.array([one.end for one in each]))
    found = [
        Choice(tolerate, periods * model.plan.dt, weights, prediction)
        for (periods, tolerate), weights, prediction in zip(tried.items(), each, predicted(all_weights), strict=True)
    ]
    # What is a thousandth of the plan's extent is narrow enough.
    extent = float(np.ptp(model.plan.states, axis=0).max()) or 1.0
    narrowest = max(min(one.predicted.width for one in found), 1e-3 * extent)

    def worth(one: Choice) -> float:
        told = one.predicted
        return told.chance + FRAGILE * told.saturation**2 + NARROW * max(told.width / narrowest, 1.0)

    return min(reversed(found), key=worth)  # of equals the gentlest


def reach_of(model: PlanModel, effort: Array, periods: int) -> dict[int, Array]:
    """How far random controls of that effort move each state in so many periods -> (n,), rms over the plan."""
    n, steps = model.n, model.plan.steps
    A, B = model.jacobian[:, :, :n], model.jacobian[:, :, n:]
    moved, total, reach = B * effort, np.zeros(n), dict[int, Array]()
    for k in range(1, periods + 1):
        if len(moved):
            total = total + (moved**2).sum(axis=2).mean(axis=0)
        reach[k] = np.sqrt(np.maximum(total, 1e-24))
        moved = A[k:] @ moved[: max(steps - k, 0)]
    return reach


def unit_means(units: tuple[str, ...], numbers: Array) -> Array:
    """The same for all states of a unit: the rms of theirs."""
    squares = {unit: [number**2 for number, own in zip(numbers, units, strict=True) if own == unit] for unit in units}
    return np.array([np.sqrt(np.mean(squares[unit])) for unit in units])


def prediction_of(
    model: PlanModel, mean: Array, covariance: Array, across: Array, saturation: float, surroundings: Surroundings,
    radius: float | None,
) -> Prediction:  # fmt: skip
    """Of the moments of the deviation of the states, as `collision_chance` takes them.

    Args:
      radius: of the goal, in metres; None without one.
    """
    plan = model.plan.states
    place = list(model.dynamics.state_coordinates.position)
    collide = collision_chance(plan + mean, covariance, across, surroundings)[1]
    miss, scale = 0.0, np.maximum(np.ptp(plan, axis=0), 1.0)
    if place:
        scale = np.ones(len(place))
        if radius is not None:
            widest = float(np.sqrt(max(np.linalg.eigvalsh(covariance[-1][place][:, place])[-1], 0.0)))
            miss = 2 * float(ndtr(-radius / max(widest, 1e-12)))
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, place or list(range(plan.shape[1]))] / scale**2
    return Prediction(collide + miss, float(np.sqrt(variances.sum(axis=1).mean())), saturation)


def with_filter(
    model: PlanModel, kalman: KalmanFilter, weights: Weights, limits: tuple[Array, Array], surroundings: Surroundings,
    radius: float | None,
) -> list[Prediction]:  # fmt: skip
    """Predictions for the laws of C weights that follow a filter's estimates.

    The filter is taken to be right about the noise: then its error is independent of what it estimates, and there is
    less to compute than in `loop_moments.py`.
    """
    n, own, steps, count = model.n, model.n + model.lagging, model.plan.steps, len(weights.state)
    gain, offset = tracking_laws(model, weights)
    learned = kalman.gain @ kalman.innovation @ kalman.gain.transpose(0, 2, 1)
    unlearned = model.F[:, :n] @ kalman.corrected[:-1, :, :n]
    # Covariance and mean of the estimate's deviation from the plan.
    estimate, mean = np.zeros((count, model.size, model.size)), np.zeros((count, model.size))
    covariance, across = np.empty((count, steps + 1, n, n)), np.empty((count, steps, n, n))
    means, beyond = np.empty((count, steps + 1, n)), np.zeros((count, model.m))
    for t in range(steps + 1):
        covariance[:, t], means[:, t] = estimate[:, :n, :n] + kalman.predicted[t, :n, :n], mean[:, :n]
        estimate += learned[t]
        if t == steps:
            break
        law, F, G = gain[:, t], model.F[t], model.G[t, :own]
        response = law @ estimate
        std = np.sqrt(np.maximum((response * law).sum(axis=2), 0.0))
        planned = model.plan.controls[t]
        slope, level, left = limited(planned + offset[:, t] + (law @ mean[:, :, None])[:, :, 0], std, *limits)
        beyond += (1 - slope) / steps
        # M estimate M' of M = F + G slope law. Of G only the rows of the state and the actuators are not zero.
        law = slope[:, :, None] * law
        moved = F @ estimate
        moved[:, :own] += G @ (slope[:, :, None] * response)
        # The true state is the estimate and its error, of which the control moves the first alone.
        across[:, t] = moved[:, :n, :n] + unlearned[t]
        estimate = moved @ F.T
        estimate[:, :, :own] += moved @ law.transpose(0, 2, 1) @ G.T
        estimate[:, :own, :own] += (G * left[:, None, :]) @ G.T
        mean = mean @ F.T + model.c[t]
        mean[:, :own] += (level - planned) @ G.T
    saturation = beyond.mean(axis=1).tolist()
    return [
        prediction_of(model, means[i], covariance[i], across[i], saturation[i], surroundings, radius)
        for i in range(count)
    ]

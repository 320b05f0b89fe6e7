"""Mean and covariance of a closed loop about its plan, by the recursion of LQG-MP.

The true state and the estimate are jointly Gaussian. Their deviation from the plan is X = (y, r). Commands move
y = (e, a, zhat), with zhat before the measurement of the same knot; for a law without an estimate, y = (e, a). Nothing
moves r = (d, v), the unknowns and the noise of the measurement, whose covariance is therefore the same for all laws.

Control limits enter by statistical linearisation: for u normal with mean mu and std sigma, the limited control has the
mean slope P(low < u < high), and the rest of its variance is noise.
For lost commands the moments of the mixture are exact; the distribution itself is not Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.control.plan_model import PlanModel
from lqrsim.errors import Array

ROOT = np.sqrt(2 * np.pi)


class LoopMoments(NamedTuple):
    """Moments of the first N entries of y about the plan, of one loop; for several loops, these are the first axes.

    Attributes:
      mean: mean of y, (T+1, N).
      covariance: covariance of y, (T+1, N, N).
      across: covariance of y with y at the previous knot, (T, N, N).
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: fraction of the commands that are beyond the limits, (T, m).
    """

    mean: Array
    covariance: Array
    across: Array
    command: Array
    saturation: Array


class ClosedLoop(NamedTuple):
    """Loops y' = F X + G (u - planned) + c + w under commands K X + offset, of which u is what the limits leave.

    Time is the first axis of the arrays. The axes after it, (...), are of loops that are computed together; an axis of
    length 1 is broadcast.

    Attributes:
      F: (T, ..., Y, X). G: (T, ..., Y, m). c: (T, ..., Y).
      noise: covariance of the first S entries of y with the first entries of X: at the start, and then of w, (T+1, ...,
        S, S or X).
      given: covariance of r, (T+1, ..., R, R). transition: r' is this times r, and noise, (R, R).
      gain: K, (T, ..., m, X). offset: (T, ..., m). planned: (T, m).
      low, high: limits of the controls, (m,).
      lost: number of lost commands for each that arrives. With losses, the last m of the S entries are a.
      reached: nominal actuators' states, (T+1, ..., m); used with losses only.
    """

    F: Array
    G: Array
    c: Array
    noise: Array
    given: Array
    transition: Array
    gain: Array
    offset: Array
    planned: Array
    low: Array
    high: Array
    lost: float
    reached: Array

    def moments(self, count: int) -> LoopMoments:
        """The moments of the first entries of y."""
        (steps, *_, m, width), own, (rows, columns) = self.gain.shape, self.F.shape[-2], self.noise.shape[-2:]
        many = np.broadcast_shapes(self.F.shape[1:-2], self.gain.shape[1:-2])
        mean, covariance = np.empty((steps + 1, *many, count)), np.empty((steps + 1, *many, count, count))
        across, std, saturation = np.empty((steps, *many, count, count)), *np.empty((2, steps, *many, m))
        x, P, ahead = np.zeros((*many, own)), np.empty((*many, width, width)), np.zeros((*many, own, width))
        whole = np.zeros(P.shape)  # X' = whole X, and noise
        whole[..., own:, own:] = self.transition
        each, actuators = np.arange(m), np.arange(rows - m, rows)
        for t in range(steps + 1):
            ahead[..., :rows, :columns] += self.noise[t]
            P[..., :own, :], P[..., own:, :own] = ahead, ahead[..., own:].swapaxes(-1, -2)
            P[..., own:, own:] = self.given[t]
            mean[t], covariance[t] = x[..., :count], P[..., :count, :count]
            if t == steps:
                break
            F, G, K, planned = self.F[t], self.G[t], self.gain[t], self.planned[t]
            std[t] = np.sqrt(np.maximum(np.vecdot(K @ P, K), 0.0))
            centre = self.offset[t] + (K[..., :own] @ x[..., None])[..., 0]
            slope, level, left = limited(centre, std[t], self.low, self.high)
            saturation[t] = 1 - slope
            law = slope[..., None] * K
            np.add(F, G @ law, out=whole[..., :own, :])
            moved = whole[..., :own, :] @ P
            across[t] = moved[..., :count, :count]
            ahead = moved @ whole.swapaxes(-1, -2)
            ahead[..., :own] += (G * left[..., None, :]) @ G.swapaxes(-1, -2)
            if self.lost:
                # A command u that arrives moves the true system by G (u - a) / s further than a lost one, after which a
                # stays in force, for a share s that arrives. The variance of that is s (1 - s) times its mean square.
                law[..., each, actuators] -= 1.0
                apart, onto = level - self.reached[t] - x[..., actuators], G[..., :rows, :]
                square = law @ P @ law.swapaxes(-1, -2) + apart[..., :, None] * apart[..., None, :]
                square[..., each, each] += left
                ahead[..., :rows, :rows] += self.lost * (onto @ square @ onto.swapaxes(-1, -2))
            x = (F[..., :own] @ x[..., None] + G @ (level - planned)[..., None])[..., 0] + self.c[t]
        return LoopMoments(*(np.moveaxis(one, 0, len(many)) for one in (mean, covariance, across, std, saturation)))


@dataclass
class LinearLoop:
    """A closed loop about a plan.

    Attributes:
      model: model of the true system.
      gain, offset: of a law, (T, m, Z or n) and (T, m), in deviations from the plan; or of C laws, (C, T, m, Z or n).
      filter_gain: of a Kalman filter, (T+1, Z, Y); None for a law of the measured states.
      low, high: limits of the controls, (m,).
      assumed: the model that the filter assumes, by which Z is that of its estimates; by default that of the true
        system.
    """

    model: PlanModel
    gain: Array
    offset: Array
    filter_gain: Array | None
    low: Array
    high: Array
    assumed: PlanModel | None = None

    def moments(self, count: int | None = None) -> LoopMoments:
        """The moments of the first entries of y, or of all, from the start to the plan's end."""
        loop = self.in_systems([self.model])
        found = loop.moments(loop.F.shape[-2] if count is None else count)
        return LoopMoments(*(one[0, 0] if self.gain.ndim == 3 else one[0] for one in found))

    def in_systems(self, models: Sequence[PlanModel]) -> ClosedLoop:
        """The loops in several true systems, by the first of the loops' axes. The second is of the laws.

        The systems differ in no sizes, and in neither sensors nor losses.
        """
        first, steps, m = models[0], self.model.plan.steps, self.model.m
        n, stated, unknown = first.n, first.n + first.lagging, len(first.transition)
        gain = self.gain.reshape(-1, *self.gain.shape[-3:]).swapaxes(0, 1)[:, None]
        offset = self.offset.reshape(-1, steps, m).swapaxes(0, 1)[:, None]
        own = stated if self.filter_gain is None else stated + gain.shape[-1]
        d, v = slice(own, own + unknown), slice(own + unknown, None)
        F, K = (
            np.zeros((steps, len(models), 1, own, own + unknown + n)),
            np.zeros((*gain.shape[:-1], own + unknown + n)),
        )
        G, c = np.empty((*F.shape[:-1], m)), np.empty(F.shape[:-1])
        if self.filter_gain is None:
            K[..., :n], K[..., v] = gain, gain * first.shown_std
        else:
            # The corrected estimate, which F and K act on. With losses, all measurements count less.
            assumed, received = self.assumed or first, 1 - first.uncertainty.loss
            seen = received * (self.filter_gain @ first.H)[:-1, None, None]
            noise = np.sqrt(received) * (self.filter_gain @ first.measurement_root)[:-1, None, None]
            for after, on in ((gain, K), (assumed.F[:, None, None], F[..., stated:, :])):
                on[..., stated:own], on[..., v] = after, after @ noise
                on[..., :n] = after @ seen
                on[..., stated : stated + n] -= on[..., :n]
            G[..., stated:, :], c[..., stated:] = assumed.G[:, None, None], assumed.c[:, None, None]
        noise = np.empty((steps + 1, len(models), 1, stated, stated))
        given = np.zeros((steps + 1, len(models), 1, unknown + n, unknown + n))
        transition = np.zeros((unknown + n, unknown + n))
        given[..., unknown:, unknown:], transition[:unknown, :unknown] = np.eye(n), first.transition
        for i, one in enumerate(models):
            F[:, i, 0, :stated, :stated], F[:, i, 0, :stated, d] = (
                one.F[:, :stated, :stated],
                one.F[:, :stated, stated:],
            )
            G[:, i, 0, :stated], c[:, i, 0, :stated] = one.G[:, :stated], one.c[:, :stated]
            start = one.start_root @ one.start_root.T
            noise[0, i, 0], noise[1:, i, 0] = start[:stated, :stated], one.process_noise[:, :stated, :stated]
            given[:, i, 0, :unknown, :unknown] = given_covariance(
                start[stated:, stated:], one.transition, one.process_noise[:, stated:, stated:]
            )
        lost, reached = first.uncertainty.command_loss, np.stack([one.reached[:, None] for one in models], axis=1)
        return ClosedLoop(
            F, G, c, noise, given, transition, K, first.plan.controls[:, None, None] + offset, first.plan.controls,
            self.low, self.high, lost / (1 - lost) if lost < 1 else 0.0, reached,
        )  # fmt: skip


def given_covariance(start: Array, transition: Array, noise: Array) -> Array:
    """Covariance of the unknowns at each knot, (T+1, D, D), from that of their noise, (T, D, D)."""
    found = np.empty((len(noise) + 1, *start.shape))
    found[0] = start
    for t in range(len(noise)):
        found[t + 1] = transition @ found[t] @ transition.T + noise[t]
    return found


def limited(centre: Array, std: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Mean slope, mean and remaining variance of a clipped normal number, elementwise (..., m)."""
    sigma = np.maximum(std, 1e-12)
    beyond = np.array([low - centre, centre - high]) / sigma  # how far the centre is beyond the limits
    beyond = np.maximum(beyond, -40.0)  # as without a limit
    clipped = ndtr(beyond)
    # The mean by which a standard normal number is beyond each limit.
    excess = beyond * clipped + np.exp(-0.5 * beyond * beyond) / ROOT
    slope, first = (1 - clipped[0]) - clipped[1], excess[0] - excess[1]
    beyond *= excess
    second = slope + beyond[0] + beyond[1]
    variance = np.maximum(second - first * first - slope * slope, 0.0) * (sigma * sigma)
    return slope, centre + sigma * first, variance

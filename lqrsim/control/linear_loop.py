"""Mean and covariance of a closed loop about its plan, by the recursion of LQG-MP.

The true state and the estimate are jointly Gaussian: X = (z, zhat), with zhat before the measurement of the same knot.
For a law without an estimate X = z. Control limits enter by statistical linearisation: for u normal with mean mu and
std sigma, the limited control has the mean slope P(low < u < high), and the rest of its variance is noise.
For lost commands the moments of the mixture are exact; the distribution itself is not Gaussian.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.control.plan_model import PlanModel, Step
from lqrsim.errors import Array


class LoopMoments(NamedTuple):
    """Moments of X about its plan.

    Attributes:
      mean: mean of X, (T+1, X).
      covariance: covariance of X, (T+1, X, X).
      across: covariance of the states' deviation with their deviation at the previous knot, (T, n, n).
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: fraction of the commands that are beyond the limits, (T, m).
    """

    mean: Array
    covariance: Array
    across: Array
    command: Array
    saturation: Array


@dataclass
class LinearLoop:
    """The matrices of a closed loop about a plan.

    Attributes:
      model: model of the true system. gain, offset: the law's, (T, m, Z or n) and (T, m), in deviations from the plan.
      filter_gain: K, (T+1, Z, Y); None for a law of the measured states.
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

    @property
    def _assumed(self) -> PlanModel:
        return self.assumed or self.model

    def moments(self) -> LoopMoments:
        """Prediction from the start to the plan's end, for C laws at once with gain (C, T, m, Z)."""
        model, steps, n, size = self.model, self.model.plan.steps, self.model.n, self.model.size
        estimates = self.filter_gain is not None
        width, many = size + self._assumed.size if estimates else size, self.gain.shape[:-3]
        mean, covariance = np.zeros((*many, steps + 1, width)), np.zeros((*many, steps + 1, width, width))
        across, std = np.empty((*many, steps, n, n)), np.empty((*many, steps, model.m))
        saturation = np.empty((*many, steps, model.m))
        covariance[..., 0, :size, :size] = model.start_root @ model.start_root.T
        for t in range(steps):
            seen, noise = self._seen(t)
            gain, planned, P = self.gain[..., t, :, :], model.plan.controls[t], covariance[..., t, :, :]
            law = gain @ seen  # as a function of X
            response = law @ P
            spread = (response * law).sum(axis=-1) + (gain @ noise * gain).sum(axis=-1)
            std[..., t, :] = np.sqrt(np.maximum(spread, 0.0))
            answer = (law @ mean[..., t, :, None])[..., 0]
            slope, level, left = limited(planned + self.offset[..., t, :] + answer, std[..., t, :], self.low, self.high)
            saturation[..., t, :] = 1 - slope
            ways = []
            for step in model.steps_of_commands:
                free, onto, drift = self._without_control(step, t, seen)
                moved = free @ P + onto @ (slope[..., None] * response)
                to_noise = onto @ (slope[..., None] * gain)
                if estimates:
                    to_noise[..., size:, :] += self._assumed.F[t]
                ahead = moved @ free.T + moved @ np.swapaxes(slope[..., None] * law, -1, -2) @ onto.T
                ahead += to_noise @ noise @ np.swapaxes(to_noise, -1, -2) + (onto * left[..., None, :]) @ onto.T
                means = mean[..., t, :] @ free.T + (level - planned) @ onto.T + drift
                ways.append((step.share, means, ahead, moved[..., :n, :n]))
            mean[..., t + 1, :] = sum(share * means for share, means, _, _ in ways)
            across[..., t, :, :] = sum(share * moved for share, _, _, moved in ways)
            total = np.zeros_like(P)
            for share, means, ahead, _ in ways:
                apart = means - mean[..., t + 1, :]
                total += share * (ahead + apart[..., :, None] * apart[..., None, :])
            total[..., :size, :size] += model.process_noise[t]
            covariance[..., t + 1, :, :] = 0.5 * (total + np.swapaxes(total, -1, -2))
        return LoopMoments(mean, covariance, across, std, saturation)

    def _without_control(self, step: Step, t: int, seen: Array) -> tuple[Array, Array, Array]:
        """Transition of X without control deviations, the input matrix of these, and the drift: (X, X), (X, m), (X,).

        The rows of the estimates are means over commands, because the filter is not told which commands are lost.
        """
        F, G, c = step.F[t], step.G[t], step.c[t]
        if self.filter_gain is None:
            return F, G, c
        assumed = self._assumed
        own = assumed.F[t] @ seen
        free = np.vstack([F @ np.eye(len(F), seen.shape[1]), own])
        return free, np.vstack([G, assumed.G[t]]), np.concatenate([c, assumed.c[t]])

    def _seen(self, t: int) -> tuple[Array, Array]:
        """Input of the law as a matrix times X, and the covariance of its noise."""
        model, n, size = self.model, self.model.n, self.model.size
        if self.filter_gain is None:
            return np.eye(n, size), np.diag(model.shown_std**2)
        received = 1 - model.uncertainty.loss
        K = received * self.filter_gain[t]
        guess = self._assumed.size
        seen = np.zeros((guess, size + guess))
        seen[:, size:] = np.eye(guess)
        seen[:, :n] += K @ model.H[t]
        seen[:, size : size + n] -= K @ model.H[t]
        noise = K @ model.measurement_root[t]
        return seen, noise @ noise.T / max(received, 1e-12)


def limited(centre: Array, std: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Mean slope, mean and remaining variance of a clipped normal number, elementwise (..., m)."""
    sigma = np.maximum(std, 1e-12)
    a, b = (low - centre) / sigma, (high - centre) / sigma
    inside = ndtr(b) - ndtr(a)
    below, above = ndtr(a), ndtr(-b)
    density_a, density_b = (np.exp(-0.5 * np.minimum(x * x, 1500.0)) / np.sqrt(2 * np.pi) for x in (a, b))
    a, b = np.where(np.isfinite(a), a, 0.0), np.where(np.isfinite(b), b, 0.0)
    # Moments of min(max(x, a), b) of a standard normal x; a side without a limit contributes nothing.
    first = density_a - density_b + a * below + b * above
    second = inside + a * density_a - b * density_b + a * a * below + b * b * above
    variance = np.maximum(second - first * first - inside * inside, 0.0) * sigma * sigma
    return inside, centre + sigma * first, variance

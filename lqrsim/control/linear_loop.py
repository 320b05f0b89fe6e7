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

from lqrsim.control.plan_model import PlanModel
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
        model, steps, n, m, size = self.model, self.model.plan.steps, self.model.n, self.model.m, self.model.size
        first = 0 if self.filter_gain is None else size  # of the numbers on which the law acts
        acts, width = slice(first, first + self.gain.shape[-1]), size if first == 0 else size + self._assumed.size
        halves = [(slice(0, size), model)] + ([(slice(size, width), self._assumed)] if first else [])
        many = self.gain.shape[:-3]
        mean, covariance = np.zeros((*many, steps + 1, width)), np.zeros((*many, steps + 1, width, width))
        across, std = np.empty((*many, steps, n, n)), np.empty((*many, steps, m))
        saturation = np.empty((*many, steps, m))
        covariance[..., 0, :size, :size] = model.start_root @ model.start_root.T
        # A command u that arrives moves the true system by G (u - a) further than a lost one, after which a stays in
        # force. The variance of that choice is s (1 - s) G E[(u - a) (u - a)'] G' for a share s that arrives.
        arrives = model.steps_of_commands[0]
        lossy = arrives.share * (1 - arrives.share)
        for t in range(steps):
            x, P = self._corrected(t, mean[..., t, :], covariance[..., t, :, :])
            gain, planned = self.gain[..., t, :, :], model.plan.controls[t]
            response = gain @ P[..., acts, :]
            shown = 0.0 if first else gain**2 @ model.shown_std**2
            std[..., t, :] = np.sqrt(np.maximum((response[..., acts] * gain).sum(axis=-1) + shown, 0.0))
            answer = (gain @ x[..., acts, None])[..., 0]
            slope, level, left = limited(planned + self.offset[..., t, :] + answer, std[..., t, :], self.low, self.high)
            saturation[..., t, :] = 1 - slope
            law, response = slope[..., None] * gain, slope[..., None] * response
            noise = left[..., None] * np.eye(m)  # of the commands
            if not first:
                noise = noise + (law * model.shown_std**2) @ np.swapaxes(law, -1, -2)
            # M P M', of which M has the rows F + G law of the true system and of the filter.
            moved, ahead, onto = np.empty_like(P), np.empty_like(P), np.empty((width, m))
            for own, one in halves:
                moved[..., own, :] = one.F[t] @ P[..., own, :] + one.G[t] @ response
                mean[..., t + 1, own] = x[..., own] @ one.F[t].T + (level - planned) @ one.G[t].T + one.c[t]
                onto[own] = one.G[t]
            pushed = moved[..., acts] @ np.swapaxes(law, -1, -2) + onto @ noise
            for own, one in halves:
                ahead[..., own] = moved[..., own] @ one.F[t].T + pushed @ one.G[t].T
            across[..., t, :, :] = moved[..., :n, :n]
            ahead[..., :size, :size] += model.process_noise[t]
            if lossy:
                force = slice(n, n + m)
                apart, between = level - model.reached[t] - x[..., force], response - P[..., force, :]
                square = between[..., acts] @ np.swapaxes(law, -1, -2) - between[..., force] + noise
                square += apart[..., :, None] * apart[..., None, :]
                ahead[..., :size, :size] += lossy * (arrives.G[t] @ square @ arrives.G[t].T)
            covariance[..., t + 1, :, :] = 0.5 * (ahead + np.swapaxes(ahead, -1, -2))
        return LoopMoments(mean, covariance, across, std, saturation)

    def _corrected(self, t: int, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Mean (X,) and covariance (X, X) after a measurement. For losses, all measurements count less."""
        if self.filter_gain is None:
            return mean, covariance
        model, n, size = self.model, self.model.n, self.model.size
        received = 1 - model.uncertainty.loss
        K, H, x, P = received * self.filter_gain[t], model.H[t], mean.copy(), covariance.copy()
        x[..., size:] += (x[..., :n] - x[..., size : size + n]) @ H.T @ K.T
        P[..., size:, :] += K @ (H @ (P[..., :n, :] - P[..., size : size + n, :]))
        P[..., size:] += (P[..., :n] - P[..., size : size + n]) @ H.T @ K.T
        noise = K @ model.measurement_root[t]
        P[..., size:, size:] += noise @ noise.T / max(received, 1e-12)
        return x, P


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

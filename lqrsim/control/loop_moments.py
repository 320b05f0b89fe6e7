"""Mean and covariance of a closed loop about its plan, by its linear model: LQG-MP's recursion.

The true state and the estimate are jointly Gaussian: X = (z, zhat), zhat before the measurement of the same knot; for a
law that estimates nothing X = z. The limits of the controls are in it by statistical linearisation: of u normal with
mean mu and std sigma the limited one has the slope P(low < u < high) on average, and what is left of its variance is
noise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.control.plan_model import PlanModel
from lqrsim.errors import Array


class Moments(NamedTuple):
    """Of a closed loop about its plan, X as above.

    Attributes:
      mean: of X, (T+1, X).
      covariance: of X, (T+1, X, X).
      across: of the deviation of the states with that of the knot before, (T, n, n).
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: share of the commands that are beyond the limits, (T, m).
    """

    mean: Array
    covariance: Array
    across: Array
    command: Array
    saturation: Array


@dataclass
class Loop:
    """A closed loop about a plan, as matrices.

    Attributes:
      model: what really happens. gain, offset: of the law, (T, m, Z or n) and (T, m), in deviations from the plan.
      filter_gain: K, (T+1, Z, Y); None for a law of the states that are shown.
      low, high: limits of the controls, (m,).
    """

    model: PlanModel
    gain: Array
    offset: Array
    filter_gain: Array | None
    low: Array
    high: Array

    def moments(self) -> Moments:
        """What is predicted of it, from the start to the plan's end."""
        model, steps, n, size = self.model, self.model.plan.steps, self.model.n, self.model.size
        estimates = self.filter_gain is not None
        width = 2 * size if estimates else size
        mean, covariance = np.zeros((steps + 1, width)), np.zeros((steps + 1, width, width))
        across, std = np.empty((steps, n, n)), np.empty((steps, model.m))
        saturation = np.empty((steps, model.m))
        covariance[0, :size, :size] = model.start_root @ model.start_root.T
        for t in range(steps):
            seen, noise = self._seen(t)
            law = self.gain[t] @ seen  # of X
            spread = law @ covariance[t] @ law.T + self.gain[t] @ noise @ self.gain[t].T
            std[t] = np.sqrt(np.maximum(spread.diagonal(), 0.0))
            centre = model.plan.controls[t] + self.offset[t] + law @ mean[t]
            slope, level, left = limited(centre, std[t], self.low, self.high)
            saturation[t] = 1 - slope
            F, G = model.F[t], model.G[t]
            onto = np.concatenate([G, G]) if estimates else G
            M = np.zeros((width, width))
            M[:size, :size] = F
            if estimates:
                M[size:] = F @ seen
            M += onto @ (slope[:, None] * law)
            to_noise = onto @ (slope[:, None] * self.gain[t])
            if estimates:
                to_noise[size:] += F
            fresh = to_noise @ noise @ to_noise.T + (onto * left) @ onto.T
            fresh[:size, :size] += model.process_noise[t]
            moved = M @ covariance[t]
            across[t] = moved[:n, :n]
            covariance[t + 1] = moved @ M.T + fresh
            covariance[t + 1] = 0.5 * (covariance[t + 1] + covariance[t + 1].T)
            mean[t + 1] = M @ mean[t] + onto @ (level - model.plan.controls[t] - slope * (law @ mean[t]))
            mean[t + 1, :size] += model.c[t]
            if estimates:
                mean[t + 1, size:] += model.c[t]
        return Moments(mean, covariance, across, std, saturation)

    def _seen(self, t: int) -> tuple[Array, Array]:
        """What the law is told, as a matrix times X, and the covariance of the noise on that."""
        model, n, size = self.model, self.model.n, self.model.size
        if self.filter_gain is None:
            return np.eye(n, size), np.diag(model.shown_std**2)
        received = 1 - model.uncertainty.loss
        K = received * self.filter_gain[t]
        seen = np.zeros((size, 2 * size))
        seen[:, size:] = np.eye(size)
        seen[:, :n] += K @ model.H[t]
        seen[:, size : size + n] -= K @ model.H[t]
        noise = K @ model.measurement_root[t]
        return seen, noise @ noise.T / max(received, 1e-12)


def limited(centre: Array, std: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Of a normal number that is cut off: mean slope, mean, and variance beyond that of the slope; all (m,)."""
    sigma = np.maximum(std, 1e-12)
    a, b = (low - centre) / sigma, (high - centre) / sigma
    inside = ndtr(b) - ndtr(a)
    below, above = ndtr(a), ndtr(-b)
    density_a, density_b = (np.exp(-0.5 * np.minimum(x * x, 1500.0)) / np.sqrt(2 * np.pi) for x in (a, b))
    a, b = np.where(np.isfinite(a), a, 0.0), np.where(np.isfinite(b), b, 0.0)
    # Moments of min(max(x, a), b) of a standard normal x; a side without a limit has no share.
    first = density_a - density_b + a * below + b * above
    second = inside + a * density_a - b * density_b + a * a * below + b * b * above
    variance = np.maximum(second - first * first - inside * inside, 0.0) * sigma * sigma
    return inside, centre + sigma * first, variance

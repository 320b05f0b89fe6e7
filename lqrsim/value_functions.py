"""Value functions: quadratics of the state, by their coefficients or by their moments. NumPy only."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array


@dataclass(frozen=True)
class Quadratic:
    """A quadratic function of the state, or one a knot: `1/2 x'Hx + x'g + const`.

    Paper: Eqs. (8), (14), (20).

    Attributes:
      hessian: (T+1, n, n), symmetric; S, Sbar. A single function has no leading axis, here and below.
      gradient: (T+1, n), the slope at the origin; bold s, bold sbar.
      constant: (T+1,), or a number; s, sbar.
    """

    hessian: Array
    gradient: Array
    constant: Array | float

    def __add__(self, other: "Quadratic") -> "Quadratic":
        return Quadratic(self.hessian + other.hessian, self.gradient + other.gradient, self.constant + other.constant)

    def __call__(self, states: npt.ArrayLike) -> Array:
        """The values (T+1,) at states (T+1, n), one a knot."""
        x = np.asarray(states, dtype=np.float64)
        curved = 0.5 * np.einsum("...i,...ij,...j->...", x, self.hessian, x)
        return curved + np.einsum("...i,...i->...", x, self.gradient) + self.constant

    def minimizer(self) -> Array:
        """The states (T+1, n) of least value. Paper: Eq. (21). Raises LinAlgError where a Hessian is singular."""
        return -np.linalg.solve(self.hessian, self.gradient[..., None])[..., 0]

    def minimum(self) -> Array:
        """The least value at each knot, (T+1,)."""
        return self(self.minimizer())


@dataclass(frozen=True)
class Moments:
    """Quadratic functions of the state by moments, one a knot: `1/2 (x - mean)' covariance^-1 (x - mean) + const`.

    What the dual form has for the cost-to-come: a state that can not be reached at all has no covariance in that
    direction, and costs infinitely much. For the terms see Kalman smoothing, to which LQR smoothing is dual.

    Attributes:
      covariance: (T+1, n, n), symmetric, positive semidefinite; zero at 0 after a fixed start. Sbar^-1.
      mean: (T+1, n), where the least cost is; -Sbar^-1 sbar.
      constant: (T+1,), the least cost.
    """

    covariance: Array
    mean: Array
    constant: Array

    def quadratic(self) -> Quadratic:
        """The same functions by their coefficients. Raises LinAlgError where a covariance is singular."""
        hessian = np.linalg.inv(self.covariance)
        hessian = 0.5 * (hessian + np.swapaxes(hessian, -1, -2))
        gradient = -np.einsum("...ij,...j->...i", hessian, self.mean)
        return Quadratic(hessian, gradient, self.constant - 0.5 * np.einsum("...i,...i->...", gradient, self.mean))

    def minimizer(self) -> Array:
        """The states (T+1, n) of least value: the means."""
        return self.mean

    def minimum(self) -> Array:
        """The least value at each knot, (T+1,)."""
        return self.constant


@dataclass(frozen=True)
class TotalCost:
    """Cost-to-go plus cost-to-come: the least cost of a trajectory through a state, at each knot. Paper: Eq. (20)."""

    cost_to_go: Quadratic
    cost_to_come: Quadratic | Moments

    def minimizer(self) -> Array:
        """The states (T+1, n) of least total cost; x_hat. Paper: Eq. (21). Raises LinAlgError where there is none."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimizer()
        moved = np.einsum("...ij,...j->...i", self.cost_to_come.covariance, self.costate())
        return self.cost_to_come.mean - moved

    def costate(self) -> Array:
        """The slopes (T+1, n) of the cost-to-go at the minimisers: what a unit more of each state would cost."""
        go = self.cost_to_go
        if isinstance(self.cost_to_come, Quadratic):
            return np.einsum("...ij,...j->...i", go.hessian, self.minimizer()) + go.gradient
        covariance, mean = self.cost_to_come.covariance, self.cost_to_come.mean
        slope = np.einsum("...ij,...j->...i", go.hessian, mean) + go.gradient
        return np.linalg.solve(np.eye(mean.shape[-1]) + go.hessian @ covariance, slope[..., None])[..., 0]

    def covariance(self) -> Array:
        """The inverses (T+1, n, n) of the Hessians: zero in a direction in which no state can be reached.

        As of a normal distribution, at k standard deviations the total cost is `k^2/2` above its least.
        """
        come, curvature = self.cost_to_come, self.cost_to_go.hessian
        covariance = come.covariance if isinstance(come, Moments) else np.linalg.inv(come.hessian)
        return covariance @ np.linalg.inv(np.eye(covariance.shape[-1]) + curvature @ covariance)

    def minimum(self) -> Array:
        """The least total cost at each knot, (T+1,): for a linear-quadratic problem the same number at all."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimum()
        costate, covariance = self.costate(), self.cost_to_come.covariance
        come = 0.5 * np.einsum("...i,...ij,...j->...", costate, covariance, costate) + self.cost_to_come.constant
        return come + self.cost_to_go(self.minimizer())

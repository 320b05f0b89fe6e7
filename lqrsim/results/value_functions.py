"""Value functions: quadratics of the state, in coefficients or in moments. NumPy only."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked, repr_of
from lqrsim.errors import Array, InputError, check_shape, vectors_of


@contextlib.contextmanager
def _invertible(what: str) -> Iterator[None]:
    """A block in which a singular matrix raises InputError."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise InputError(f"{what}: got a singular matrix ({error}), want an invertible one") from None


@checked
@dataclass(frozen=True, eq=False)
class Quadratic:
    """A quadratic function of the state, or one for each knot: `1/2 x'Hx + x'g + const`.

    Paper: Eqs. (8), (14), (20).

    Attributes:
      hessian: (T+1, n, n), symmetric; S, Sbar. A single function has no leading axis, here and below.
      gradient: (T+1, n), at the origin; bold s, bold sbar.
      constant: (T+1,), or a number; s, sbar.
    """

    hessian: Annotated[Array, "... n n"]
    gradient: Annotated[Array, "... n"]
    constant: Annotated[Array | float, "..."]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not self.gradient.shape[-1]:
            raise InputError("Quadratic: got no state, want at least one")

    @checked
    def __add__(self, other: "Quadratic") -> "Quadratic":
        if other.hessian.shape != self.hessian.shape:
            raise InputError(f"other: got a hessian of shape {other.hessian.shape}, want {self.hessian.shape}")
        return Quadratic(self.hessian + other.hessian, self.gradient + other.gradient, self.constant + other.constant)

    def __call__(self, states: npt.ArrayLike) -> Array:
        """The values at these states (T+1, n), one for each knot."""
        x = vectors_of("states", states, self.gradient.shape[-1])
        try:
            np.broadcast_shapes(x.shape, self.gradient.shape)
        except ValueError:
            raise InputError(f"states: got shape {x.shape}, want one that goes with {self.gradient.shape}") from None
        curved = 0.5 * np.einsum("...i,...ij,...j->...", x, self.hessian, x)
        return curved + np.einsum("...i,...i->...", x, self.gradient) + self.constant

    def minimizer(self) -> Array:
        """The minimising states (T+1, n). Paper: Eq. (21). Raises InputError for a singular Hessian."""
        with _invertible("hessian"):
            return -np.linalg.solve(self.hessian, self.gradient[..., None])[..., 0]

    def minimum(self) -> Array:
        """The minimum at each knot, (T+1,)."""
        return self(self.minimizer())


@checked
@dataclass(frozen=True, eq=False)
class Moments:
    """Quadratic functions of the state by moments, for each knot: `1/2 (x - mean)' covariance^-1 (x - mean) + const`.

    It is the dual form's cost-to-come. In a direction in which no state can be reached, the covariance is zero and the
    cost infinite. The terms come from Kalman smoothing, to which LQR smoothing is dual.

    Attributes:
      covariance: (T+1, n, n), symmetric, positive semidefinite; zero at 0 after a fixed start. Sbar^-1.
      mean: (T+1, n), the states of least cost; -Sbar^-1 sbar.
      constant: (T+1,), the least cost.
    """

    covariance: Annotated[Array, "... n n"]
    mean: Annotated[Array, "... n"]
    constant: Annotated[Array | float, "..."]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not self.mean.shape[-1]:
            raise InputError("Moments: got no state, want at least one")

    def quadratic(self) -> Quadratic:
        """The same functions in coefficients. Raises InputError for a singular covariance."""
        with _invertible("covariance"):
            hessian = np.linalg.inv(self.covariance)
        hessian = 0.5 * (hessian + np.swapaxes(hessian, -1, -2))
        gradient = -np.einsum("...ij,...j->...i", hessian, self.mean)
        return Quadratic(hessian, gradient, self.constant - 0.5 * np.einsum("...i,...i->...", gradient, self.mean))

    def minimizer(self) -> Array:
        """The minimising states (T+1, n): the means."""
        return self.mean

    def minimum(self) -> Array:
        """The minimum at each knot, (T+1,)."""
        return np.asarray(self.constant)


@checked
@dataclass(frozen=True, eq=False)
class TotalCost:
    """Cost-to-go plus cost-to-come: the least cost of a trajectory through a state, for each knot. Paper: Eq. (20)."""

    cost_to_go: Quadratic
    cost_to_come: Quadratic | Moments

    __repr__ = repr_of

    def __post_init__(self) -> None:
        come = self.cost_to_come.gradient if isinstance(self.cost_to_come, Quadratic) else self.cost_to_come.mean
        check_shape("TotalCost: cost_to_come", come, self.cost_to_go.gradient.shape)

    def minimizer(self) -> Array:
        """The states (T+1, n) of least total cost; x_hat. Paper: Eq. (21). Raises InputError if there is no minimum."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimizer()
        moved = np.einsum("...ij,...j->...i", self.cost_to_come.covariance, self.costate())
        return self.cost_to_come.mean - moved

    def costate(self) -> Array:
        """The gradients (T+1, n) of the cost-to-go at the minimisers."""
        go = self.cost_to_go
        if isinstance(self.cost_to_come, Quadratic):
            return np.einsum("...ij,...j->...i", go.hessian, self.minimizer()) + go.gradient
        covariance, mean = self.cost_to_come.covariance, self.cost_to_come.mean
        slope = np.einsum("...ij,...j->...i", go.hessian, mean) + go.gradient
        with _invertible("covariance"):
            return np.linalg.solve(np.eye(mean.shape[-1]) + go.hessian @ covariance, slope[..., None])[..., 0]

    def covariance(self) -> Array:
        """The inverses (T+1, n, n) of the Hessians, zero in a direction in which no state can be reached.

        As covariances of a normal distribution: at k standard deviations the total cost is `k^2/2` above its least.
        """
        come, curvature = self.cost_to_come, self.cost_to_go.hessian
        with _invertible("hessian"):
            if isinstance(come, Quadratic):
                return np.linalg.inv(come.hessian + curvature)
            return come.covariance @ np.linalg.inv(np.eye(curvature.shape[-1]) + curvature @ come.covariance)

    def minimum(self) -> Array:
        """The least total cost at each knot, (T+1,); the same at all knots for a linear-quadratic problem."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimum()
        costate, covariance = self.costate(), self.cost_to_come.covariance
        come = 0.5 * np.einsum("...i,...ij,...j->...", costate, covariance, costate) + self.cost_to_come.constant
        return come + self.cost_to_go(self.minimizer())

"""The result of a solve in continuous time: policy and value functions as functions of time."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_kind, excerpt, real
from lqrsim.results.fields import Bounds, check_fields
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.results.value_functions import Quadratic
from lqrsim.solvers.riccati_ode import Pass


@dataclass(frozen=True, kw_only=True, eq=False)
class ContinuousSolution:
    """A policy and the value functions as functions of time, in seconds from 0 to the horizon.

    An array of times may be given in place of a time. The axes of the times then come first in the result.

    Attributes:
      status: how the solve ended; only CONVERGED is success.
      detail: the pass, the time and the reason if the solve failed.
      horizon: the paper's l, in seconds.
      iterations: the log of the iterations; empty for a linear-quadratic problem, which needs none.
    """

    status: Status
    detail: str
    horizon: Annotated[float, Bounds(above=0.0)]
    iterations: tuple[Iteration, ...] = ()
    _backward: Pass | None = field(repr=False, compare=False)
    _forward: Pass | None = field(repr=False, compare=False)

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("_backward", "_forward"):
            check_kind(f"ContinuousSolution: {name}", getattr(self, name), (Pass, type(None)), "a Pass or None")

    @property
    def success(self) -> bool:
        """True for CONVERGED."""
        return self.status is Status.CONVERGED

    @property
    def cost(self) -> float:
        """True cost of the rollout from x_hat(0), or the least cost of a linear-quadratic problem; NaN if not found."""
        if self.iterations or not self.success:
            return self.iterations[-1].cost if self.iterations else float("nan")
        return float(self.total_cost(0.0).minimum())

    def policy(self, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        """The control (..., m) to apply in the states (..., n) at time t, without saturation. Paper: Eq. (13).

        Args:
          x: states (..., n).
          t: seconds, from 0 to the horizon.

        Returns:
          Controls (..., m).
        """
        return self._law("policy", self._backward, x, t)

    def inverse_policy(self, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        """The control (..., m) that led to the states (..., n) at time t at least cost. Paper: Eq. (19).

        Args:
          x: states of arrival (..., n).
          t: seconds, from 0 to the horizon.

        Returns:
          Controls (..., m).
        """
        return self._law("inverse_policy", self._forward, x, t)

    def cost_to_go(self, t: npt.ArrayLike) -> Quadratic:
        """v: the least cost from time t on, as a function of the state at t. Paper: Eqs. (8)-(11).

        Args:
          t: seconds, from 0 to the horizon.

        Returns:
          The quadratic at each time.
        """
        return self._value("cost_to_go", self._backward, t)

    def cost_to_come(self, t: npt.ArrayLike) -> Quadratic:
        """vbar: the least cost up to time t, as a function of the state at t. Paper: Eqs. (14)-(17).

        Args:
          t: seconds, from 0 to the horizon.

        Returns:
          The quadratic at each time.
        """
        return self._value("cost_to_come", self._forward, t)

    def total_cost(self, t: npt.ArrayLike) -> Quadratic:
        """vhat: the least cost of visiting a state at time t. Paper: Eq. (20).

        Args:
          t: seconds, from 0 to the horizon.

        Returns:
          The quadratic at each time.
        """
        return self.cost_to_go(t) + self.cost_to_come(t)

    def x_hat(self, t: npt.ArrayLike) -> Array:
        """The state (..., n) of least total cost at time t. Paper: Eq. (21).

        Args:
          t: seconds, from 0 to the horizon.

        Returns:
          States (..., n).
        """
        return self.total_cost(t).minimizer()

    def u_hat(self, t: npt.ArrayLike) -> Array:
        """The policy's control (..., m) there; at convergence also the inverse policy's. Paper: Eq. (22).

        Args:
          t: seconds, from 0 to the horizon.

        Returns:
          Controls (..., m).
        """
        return self.policy(self.x_hat(t), t)

    def summary(self) -> str:
        """The status with its remedy, and the results, in a few lines."""
        lines = [f"{self.status.name} after {len(self.iterations)} iterations: {self.status.meaning}"]
        if not self.iterations and self.success:
            lines = [f"{self.status.name}: a linear-quadratic problem is solved by one pass each way"]
        if self.detail:
            lines.append(f"  detail:    {self.detail}")
        if self.status.remedy:
            lines.append(f"  remedy:    {self.status.remedy}")
        line = f"  cost:      {self.cost:.9g}"
        if self.iterations:
            line += f"   gap: {self.iterations[-1].gap:.1e}   optimality: {self.iterations[-1].optimality:.1e}"
        return "\n".join([*lines, line])

    def __str__(self) -> str:
        rows = [iteration.row(number) for number, iteration in enumerate(self.iterations, start=1)]
        return "\n".join([*([Iteration.HEADER, *rows] if rows else []), self.summary()])

    def _at(self, what: str, found: Pass | None, t: npt.ArrayLike) -> tuple[Pass, Array]:
        if found is None:
            raise InputError(f"{what}: got a solution that is {self.status.value} before a pass ended, want a success")
        times, slack = real("t", t), 1e-9 * self.horizon  # rounding may put a time slightly outside
        outside = ~((times >= -slack) & (times <= self.horizon + slack))
        if outside.any():
            raise InputError(f"t: got {times[outside].flat[0]:g}, want seconds from 0 to {self.horizon:g}")
        return found, np.clip(times, 0.0, self.horizon)

    def _value(self, what: str, found: Pass | None, t: npt.ArrayLike) -> Quadratic:
        found, times = self._at(what, found, t)
        value, _ = found.at(times)
        return Quadratic(value[..., :-1, :-1], value[..., :-1, -1], 0.5 * value[..., -1, -1])

    def _law(self, what: str, found: Pass | None, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        found, times = self._at(what, found, t)
        states, want = real("x", x), f"(..., {found.states}), one state or one for each of the times"
        if states.shape[-1:] != (found.states,) or (times.ndim and states.shape[:-1] not in ((), times.shape)):
            raise InputError(f"x: got shape {states.shape}, want {want}")
        if not np.isfinite(states).all():
            raise InputError(f"x: got {excerpt(states)}, want finite numbers")
        _, law = found.at(times)
        return np.einsum("...ij,...j->...i", law[..., :-1], states) + law[..., -1]

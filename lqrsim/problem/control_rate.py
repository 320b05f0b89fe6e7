"""Costs and limits of the rates of controls: class and kernels.

A rate joins two controls. A solver that looks at one step at a time needs the last command as a state; the cost and the
constraint here are for such dynamics, `last_command.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, brief, check_array, check_items, keep, numbers_of
from lqrsim.kernels.declarations import M, N
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.costs import Cost, CostTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.coordinates import Coordinates, PerEntry

Range = npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]  # a number r for -r to r, or (low, high)


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlRate:
    """The cost and the limits of the rates of controls: of (u_t - u_{t-1}) / dt, in a control's unit per second.

        ls.Problem(..., control_rate=ls.ControlRate(weight=0.01, limits=5.0))

    A step costs `1/2 sum_i weight_i rate_i^2`; like any stage cost it is not multiplied by dt. Limits hold at each step
    of a plan. A first plan may begin with any command, unless `previous` says which was the last; a re-plan knows it.
    Feedback adds to the rates of a plan; see `Problem.control_rate` for what holds then.

    Args:
      weight: cost per square of a rate: a number, (m,), or a dictionary of name or unit of a control: number, with 0
        for controls that it leaves out. None for no cost.
      limits: the range of the rates, with 0 inside: r for -r to r, (low, high), each a number or (m,), or a dictionary
        of name or unit of a control: r or (low, high). Infinite for no limit.
      previous: the command (m,) before the first step, or a dictionary of name or unit: number, with 0 for the rest.
        None: the first command is free, and has no rate.
    """

    weight: PerEntry | None = None
    limits: Range | Mapping[str, Any] | None = None
    previous: PerEntry | None = None

    def __post_init__(self) -> None:
        if self.weight is None and self.limits is None:
            raise InputError("ControlRate: got neither a weight nor limits, want one of the two at least")
        for name in ("weight", "previous"):
            numbers = getattr(self, name)
            if numbers is not None and not isinstance(numbers, Mapping):
                numbers = _sized(f"ControlRate: {name}", numbers, "a number, or one for each control")
                if name == "weight" and (numbers < 0).any():
                    raise InputError(f"ControlRate: weight: got {brief(numbers)}, want numbers >= 0")
                keep(self, **{name: numbers})
        if self.limits is not None and not isinstance(self.limits, Mapping):
            keep(self, limits=_range("ControlRate: limits", self.limits))

    def __repr__(self) -> str:
        named = ((name, getattr(self, name)) for name in ("weight", "limits", "previous"))
        return f"ControlRate({', '.join(f'{name}={brief(value)}' for name, value in named if value is not None)})"

    def _in(self, dynamics: Dynamics) -> "ControlRate":
        """The same with an array (m,) for all that is given. Raises InputError if it does not fit the controls."""
        space, fields = dynamics.control_coordinates, dict[str, Any]()
        for name in ("weight", "previous"):
            numbers = getattr(self, name)
            if isinstance(numbers, Mapping):
                numbers = space._numbers(f"ControlRate: {name}", numbers)
            fields[name] = None if numbers is None else _each(f"ControlRate: {name}", numbers, space)
        limits: Any = self.limits
        if isinstance(limits, Mapping):
            sides = np.tile([[-inf], [inf]], len(space))
            for i, (low, high) in space._by_name("ControlRate: limits", limits, partial(_range, single=True)).items():
                sides[:, i] = low, high
            limits = sides[0], sides[1]
        if limits is not None:
            limits = tuple(_each("ControlRate: limits", side, space) for side in limits)
        return ControlRate(weight=fields["weight"], limits=limits, previous=fields["previous"])

    def _numbers(self, dt: float, dynamics: Dynamics) -> Array:
        """What both kernels begin with."""
        known = self.previous is not None
        previous = np.asarray(self.previous) if known else np.zeros(len(dynamics.control_coordinates))
        return np.concatenate([[float(known), dt], previous])


def _sized(field: str, value: object, want: str, *, infinite: bool = False) -> Array:
    """A number, (), or numbers (m,)."""
    numbers = numbers_of(field, value, want)
    return check_array(field, numbers, (None,) * min(numbers.ndim, 1), infinite=infinite)


def _range(field: str, value: Any, *, single: bool = False) -> tuple[Array, Array]:
    """(low, high), each () or (m,), of r or (low, high); of a single control, ()."""
    want = "a number, or (low, high), each a number or one for each control"
    if isinstance(value, (tuple, list)):
        sides = check_items(field, value, object, want)
        if len(sides) != 2:
            raise InputError(f"{field}: got {len(sides)} items, want {want}")
        low, high = (_sized(field, side, want, infinite=True) for side in sides)
    else:
        high = check_array(field, numbers_of(field, value, want), (), infinite=True)
        low = -high
    if not ((low < 0).all() and (high > 0).all()):
        raise InputError(f"{field}: got {brief(low)} to {brief(high)}, want a range with 0 inside")
    if single and (low.ndim or high.ndim):
        raise InputError(f"{field}: got {brief(low)} to {brief(high)}, want one range for a control")
    return low, high


def _each(field: str, numbers: Array, space: Coordinates) -> Array:
    """One number for each control, (m,)."""
    if numbers.ndim and len(numbers) != len(space):
        raise InputError(f"{field}: got {len(numbers)} numbers, want {len(space)}, one for each control")
    return np.broadcast_to(numbers, len(space)).astype(np.float64)


class RateCost(Cost):
    """The cost of rates, for dynamics whose last m states are the last command."""

    def __init__(self, rate: ControlRate, dt: float) -> None:
        self.rate, self.dt = rate, dt

    def bind(self, dynamics: Dynamics) -> CostTerm:
        numbers = np.concatenate([self.rate._numbers(self.dt, dynamics), np.asarray(self.rate.weight)])
        return CostTerm(source_of(__name__), numbers, uses_control=True)


class RateLimits(Constraint):
    """Their limits, for such dynamics."""

    def __init__(self, rate: ControlRate, dt: float) -> None:
        self.rate, self.dt = rate, dt

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        assert isinstance(self.rate.limits, tuple)
        space, (low, high) = dynamics.control_coordinates, np.asarray(self.rate.limits)
        sides = (1.0, low), (-1.0, high)
        rows = [(i, sign, side[i]) for sign, side in sides for i in np.flatnonzero(np.isfinite(side)).tolist()]

        def describe(row: int) -> str:
            i, sign, bound = rows[row]
            words = f"{space.names[i]} of {'at least' if sign > 0 else 'at most'} {bound:g} {space.units[i]}/s"
            return f"a rate of {words}".replace(" /s", " 1/s")

        kernels = source_of(__name__)
        return ConstraintTerm(
            kernels.filled(value=(kernels, "limit_value"), slope=(kernels, "limit_slope")),
            np.concatenate([self.rate._numbers(self.dt, dynamics), *rows]), len(rows), describe,
            uses_control=True, convex=True, linear=True, ranges=np.array([high[i] - low[i] for i, *_ in rows]),
            names=tuple(f"{space.names[i]} {'low' if sign > 0 else 'high'}" for i, sign, _ in rows),
        )  # fmt: skip


# The kernels. `data` has 1 if the command before the first step is known, else 0; dt in s; and that command (M,). Then
# follow the weights (M,) of a cost; or, for each row of limits, the control, 1 for a lower or -1 for an upper limit,
# and the limit.
KNOWN, DT, PREVIOUS = 0, 1, 2


def value(x, u, t, data):
    """The cost of the rates."""
    total = 0.0
    for i in range(M):
        rate = rate_of(i, x, u, t, data)
        total += 0.5 * data[PREVIOUS + M + i] * rate * rate
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    total = 0.0
    for i in range(M):
        rate, weight, last = rate_of(i, x, u, t, data), data[PREVIOUS + M + i], N - M + i
        slope, curve = weight * rate / data[DT], weight / (data[DT] * data[DT])
        total += 0.5 * weight * rate * rate
        if t > 0 or data[KNOWN] > 0:
            gradient[N + i] += slope
            hessian[N + i, N + i] += curve
        if t > 0:
            gradient[last] -= slope
            hessian[last, last] += curve
            hessian[last, N + i] -= curve
            hessian[N + i, last] -= curve
    return total


def limit_value(x, u, t, row, data):
    """The distance of a rate to a limit; infinite for a first command that is free."""
    if t == 0 and data[KNOWN] == 0:
        return inf
    first = PREVIOUS + M + 3 * row
    return data[first + 1] * (rate_of(int(data[first]), x, u, t, data) - data[first + 2])


def limit_slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    first = PREVIOUS + M + 3 * row
    i, slope = int(data[first]), data[first + 1] / data[DT]
    gradient[N + i] += slope
    if t > 0:
        gradient[N - M + i] -= slope


def rate_of(i, x, u, t, data):
    """The rate of a control, in its unit per second; 0 for a first command that is free."""
    if t > 0:
        return (u[i] - x[N - M + i]) / data[DT]
    if data[KNOWN] > 0:
        return (u[i] - data[PREVIOUS + i]) / data[DT]
    return 0.0

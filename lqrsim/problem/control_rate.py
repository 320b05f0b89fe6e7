"""Costs and limits of the rates of controls, and the problem that solvers solve for them: classes and kernels.

A rate joins two controls. A solver that looks at one step at a time needs the last command as a state. With `x = (y,
z)`, `y_{t+1} = g(y_t, u_t)` and `z_{t+1} = u_t`, a rate is that of u_t and z_t.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from math import inf
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.codegen import user_functions
from lqrsim.codegen.sources import Source, source_of
from lqrsim.errors import Array, InputError, brief, check_array, check_items, free_name, keep, numbers_of
from lqrsim.kernels.declarations import M, N, W, at, call, stack, zeros
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import Constraint, ConstraintTerm, Cost, CostTerm, ProblemPart
from lqrsim.problem.quadratic_cost import QuadraticCost
from lqrsim.results.coordinates import Coordinates, PerEntry

if TYPE_CHECKING:
    from lqrsim.problem.problem import Problem

Range = npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]  # a number r for -r to r, or (low, high)
Part = TypeVar("Part", bound=ProblemPart[Any])


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


class LastCommand(Dynamics):
    """Dynamics `of` a system, with the last command as their last m states."""

    def __init__(self, of: Dynamics) -> None:
        self.of, self._name, self.level, self.functions = of, of.name, of.level, ()
        self.parameters, self.disturbances = dict[str, float](), dict[str, float]()  # those of `of` are its own
        # The steps are those of `of`, and so is what is told of them: its states come first.
        self._period, self.by_mujoco, self.rounding = of.period, of.by_mujoco, of.rounding
        self.period_near, self.check_period = of.period_near, of.check_period
        self.solving, self.quiet, self._with_finer_steps = of.solving, of.quiet, of._with_finer_steps
        self.touches, self.grazed, self._cause_of_failure = of.touches, of.grazed, of._cause_of_failure
        self.untouched_body = of.untouched_body
        space, controls = of.state_coordinates, of.control_coordinates
        names = list(space.names)
        for name in controls.names:
            names.append(free_name(f"last_{name}", names))
        self.control_coordinates = controls
        self.state_coordinates = Coordinates(
            names=tuple(names), units=(*space.units, *controls.units), position=space.position, plane=space.plane,
            offset=space.offset, angles=space.angles, rotation_vectors=space.rotation_vectors,
        )  # fmt: skip

    @property
    def calling(self) -> Dynamics:
        return self.of.calling

    @cached_property
    def step_source(self) -> Source:
        return source_of(__name__)

    @cached_property
    def curvature_source(self) -> Source | None:
        return self.step_source if self.of.step_curvature else None

    @property
    def data(self) -> Array:
        """The addresses that the kernels read."""
        functions = *self.of.compiled.addresses("advance", "step_jacobian"), self.of.step_curvature
        return np.array([*functions, self._own_numbers.ctypes.data], dtype=np.float64)

    @cached_property
    def _own_numbers(self) -> Array:
        """The numbers of the dynamics without, kept where their address is in use."""
        return user_functions.numbers_of(self.of)

    def _own(self, states: npt.ArrayLike) -> Array:
        """States (..., n) without the last command."""
        return np.asarray(states)[..., : len(self.of.state_coordinates)]

    def softened(self, states: Array) -> Iterator[tuple[str, Dynamics]]:
        return ((name, LastCommand(softer)) for name, softer in self.of.softened(states))

    def approaches(self, states: Array, change: Array) -> Iterator[tuple[str, Dynamics, Array]]:
        for words, dynamics, motion in self.of.approaches(states, change):
            yield words, LastCommand(dynamics), motion

    def _runge_kutta(self, states: Array, controls: Array, dt: float) -> tuple[float, Array] | None:
        return self.of._runge_kutta(self._own(states), controls, dt)

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        """That of the dynamics; 0 for the last command, which jumps."""
        return np.pad(self.of.rate(self._own(state), control), (0, len(self.control_coordinates)))

    def rate_jacobian(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        fx, fu = self.of.rate_jacobian(self._own(state), control)
        m = len(self.control_coordinates)
        return np.pad(fx, (0, m)), np.pad(fu, [(0, m), (0, 0)])

    def step(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> Array:
        return np.concatenate([self.of.step(self._own(state), control, dt), np.asarray(control, dtype=np.float64)])

    def linearize(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> tuple[Array, Array, Array]:
        a, b, c = self.of.linearize(self._own(state), control, dt)
        m = len(self.control_coordinates)
        return np.pad(a, (0, m)), np.vstack([b, np.eye(m)]), np.pad(c, (0, m))


def with_last_command(problem: "Problem") -> "Problem":
    """The problem of a problem with a `control_rate`, with the last command as its last m states.

    That before the first step is no state: the cost and the limits of rates have it.
    """
    rate, dynamics, m = problem.control_rate, problem.dynamics, len(problem.control_coordinates)
    assert rate is not None
    wide = LastCommand(dynamics)

    def added(part: Part) -> Part:
        for _ in range(m):
            part = part.with_added_state(dynamics)
        return part

    if not isinstance(problem.initial, Cost):
        initial = problem.initial._extended(np.zeros(m))
    else:
        # A weight, which costs nothing: a cost-to-come needs one of each state.
        weight = np.diag(np.pad(np.ones(m), (len(dynamics.state_coordinates), 0)))
        initial = added(problem.initial)
        if isinstance(initial, QuadraticCost):  # else the problem's start would be no longer known
            initial = QuadraticCost(initial.weight + weight, about=initial.about)
        else:
            initial += QuadraticCost(weight, about=np.zeros(len(weight)))
    stage, constraints = added(problem.stage_cost), list(map(added, problem.constraints))
    if rate.weight is not None:
        stage += RateCost(rate, problem.dt)
    if rate.limits is not None:
        constraints.append(RateLimits(rate, problem.dt))
    final = added(problem.final_cost)
    # Without new checks, as the rest of a problem may begin where a new problem may not.
    other = problem._with(dynamics=wide, control_rate=None)
    return other._with(**other._bound(constraints, initial=initial, stage_cost=stage, final_cost=final))


# The kernels of cost and limits. `data` has 1 if the command before the first step is known, else 0; dt in s; and that
# command (M,). Then follow the weights (M,) of a cost; or, for each row of limits, the control, 1 for a lower or -1 for
# an upper limit, and the limit.
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


# The kernels of the step. g is called at its address, with sizes of its own, so that it may be any: a formula's
# Runge-Kutta step, a user's function, or MuJoCo's steps. `p` has the addresses below.
ADVANCE, STEP_JACOBIAN, STEP_CURVATURE, NUMBERS = 0, 1, 2, 3  # of g's functions, and of the numbers that they call p


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    call(p[ADVANCE], x, u, at(p[NUMBERS]), h, out)
    for i in range(M):
        out[N - M + i] = u[i]


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step, and its Jacobian [A B] (N, W)."""
    own = stack(N - M, N)
    call(p[STEP_JACOBIAN], x, u, at(p[NUMBERS]), h, out, own)
    write_jacobian(u, own, out, jacobian)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write the same; add the Hessian (W, W) of the next state times weights (N,)."""
    own, curve = stack(N - M, N), zeros(N, N)
    call(p[STEP_CURVATURE], x, u, at(p[NUMBERS]), h, weights, out, own, curve)
    write_jacobian(u, own, out, jacobian)
    for i in range(N):
        row = i if i < N - M else i + M
        for j in range(N):
            column = j if j < N - M else j + M
            hessian[row, column] += curve[i, j]


def write_jacobian(u, inner, out, jacobian):
    """Write the last M states, and the Jacobian of all, given that of the others, (N - M, N)."""
    for i in range(N):
        for j in range(W):
            jacobian[i, j] = 0.0
    for i in range(N - M):
        for j in range(N - M):
            jacobian[i, j] = inner[i, j]
        for j in range(M):
            jacobian[i, N + j] = inner[i, N - M + j]
    for i in range(M):
        out[N - M + i] = u[i]
        jacobian[N - M + i, N + i] = 1.0

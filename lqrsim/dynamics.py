"""The dynamics of a system, stated as a plain function and traced once into exact derivatives."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import integration, rotations, tracing
from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError, check_array, check_name, check_number

Limits = tuple[npt.ArrayLike, npt.ArrayLike]


class Dynamics:
    """`xdot = f(x, u)`: Eq. (1), with what its states and controls mean.

    A pendulum, swung by a motor:

        def pendulum(x, u, p):
            from sympy import sin
            angle, speed = x
            return [speed, u[0] / p.inertia - p.gravity / p.length * sin(angle)]

        ls.Dynamics(
            pendulum,
            states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "N m"},
            parameters={"inertia": 0.02, "gravity": 9.81, "length": 0.2}, angles=("angle",),
        )

    Args:
      f: `f(x, u, p)` of SymPy symbols; returns one expression a state. x and u are lists, p has the parameters as
        attributes.
      states, controls: name -> unit, in order.
      parameters: name -> value. Values are data: changing one compiles nothing.
      position: names of the 2 or 3 states that are the robot's position in the world, in metres.
      angles: names of the states that are angles in radians, equal up to whole turns.
      rotation_vectors: names, by threes, of the states that are rotation vectors.
      control_limits: lowest and highest control, numbers or (m,); what the actuators can do, for execution.

    Raises:
      InputError: `f` does not return one expression a state, fails on symbols or reads an unknown parameter; a name
        does not exist; a parameter is not finite.
    """

    def __init__(
        self,
        f: Callable[[Any, Any, Any], Sequence[Any]],
        *,
        states: Mapping[str, str],
        controls: Mapping[str, str],
        parameters: Mapping[str, float] | None = None,
        position: Sequence[str] = (),
        angles: Sequence[str] = (),
        rotation_vectors: Sequence[Sequence[str]] = (),
        control_limits: Limits | None = None,
    ) -> None:
        if not states or not controls:
            raise InputError(
                f"dynamics: got {len(states)} states and {len(controls)} controls, want at least one of each"
            )
        names = tuple(states)

        def index(field: str, name: str) -> int:
            return names.index(check_name(field, name, names))

        starts = []
        for triple in rotation_vectors:
            indices = [index("rotation_vectors", name) for name in triple]
            if len(indices) != 3 or indices != list(range(indices[0], indices[0] + 3)):
                raise InputError(f"rotation_vectors: got {tuple(triple)}, want three neighbouring states")
            starts.append(indices[0])
        low, high = control_limits if control_limits is not None else (-np.inf, np.inf)
        self.f = f
        self.parameters = {
            name: check_number(f"parameters: {name}", value) for name, value in (parameters or {}).items()
        }
        self.state_coordinates = Coordinates(
            names=names,
            units=tuple(states.values()),
            position=tuple(index("position", name) for name in position),
            angles=tuple(index("angles", name) for name in angles),
            rotation_vectors=tuple(starts),
        )
        self.control_coordinates = Coordinates(
            names=tuple(controls),
            units=tuple(controls.values()),
            low=tuple(np.broadcast_to(np.asarray(low, dtype=float), len(controls)).tolist()),
            high=tuple(np.broadcast_to(np.asarray(high, dtype=float), len(controls)).tolist()),
        )

    @property
    def name(self) -> str:
        """What messages call the dynamics: the name of `f`."""
        return getattr(self.f, "__qualname__", repr(self.f))

    @property
    def data(self) -> Array:
        """The parameters' values, in order."""
        return np.array(list(self.parameters.values()), dtype=np.float64)

    @cached_property
    def source(self) -> str:
        """Source of `rate` and `rate_jacobian` of `solvers/interface.py`. Traces `f` at the first call."""
        n, m = len(self.state_coordinates), len(self.control_coordinates)
        rates, x, u = tracing.trace(self.f, n, m, list(self.parameters))
        if len(rates) != n:
            name = getattr(self.f, "__qualname__", repr(self.f))
            states = ", ".join(self.state_coordinates.names)
            raise InputError(f"{name}(x, u, p): got {len(rates)} entries, want {n}: one for each of {states}")
        values = {f"out[{i}]": rate for i, rate in enumerate(rates)}
        slopes = {f"fx[{i}, {j}]": rate.diff(xj) for i, rate in enumerate(rates) for j, xj in enumerate(x)}
        slopes |= {f"fu[{i}, {j}]": rate.diff(uj) for i, rate in enumerate(rates) for j, uj in enumerate(u)}
        slopes = {target: slope for target, slope in slopes.items() if slope != 0}
        return "\n\n".join(
            [
                tracing.write_function("rate", "x, u, p, out", "p", values),
                tracing.write_function("rate_jacobian", "x, u, p, out, fx, fu", "p", values | slopes),
                tracing.write_chain(n, slopes),
            ]
        )

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        """`xdot` (n,) at one state (n,) and control (m,), in plain Python."""
        x, u = self._check(state, control)
        out = np.zeros(len(x))
        self._plain["rate"](x, u, self.data, out)
        return out

    def step(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> Array:
        """The state (n,) after `dt` seconds (negative: before), control held: one Runge-Kutta step, in plain Python."""
        x, u = self._check(state, control)
        out = np.zeros(len(x))
        self._plain["step"](x, u, self.data, check_number("dt", dt), out)
        return out

    def linearize(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> tuple[Array, Array, Array]:
        """A (n, n), B (n, m) and c (n,) of the step about a state and control: x' = A x + B u + c. Eqs. (24)-(25)."""
        x, u = self._check(state, control)
        n, m = len(x), len(u)
        out, jacobian = np.zeros(n), np.zeros((n, n + m))
        self._plain["step_jacobian"](
            x, u, self.data, check_number("dt", dt), np.zeros((n, n)), np.zeros((n, m)), out, jacobian
        )
        a, b = jacobian[:, :n].copy(), jacobian[:, n:].copy()
        return a, b, out - a @ x - b @ u

    def _check(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        return (
            check_array("state", state, (len(self.state_coordinates),)),
            check_array("control", control, (len(self.control_coordinates),)),
        )

    @cached_property
    def _plain(self) -> dict[str, Any]:
        """The very source that gets compiled, run as plain Python."""
        n, m = len(self.state_coordinates), len(self.control_coordinates)
        names = {"N": n, "M": m, "W": n + m, "stack": lambda *shape: np.empty(shape)}
        names |= vars(math) | {name: value for name, value in vars(rotations).items() if callable(value)}
        exec(compile(self.source, "<traced dynamics>", "exec"), names)
        for function in (integration.step, integration.chain, integration.step_jacobian):
            exec(compile(inspect.getsource(function), "<integration>", "exec"), names)
        return names

"""The dynamics of a system, stated as a function: of symbols, or of arrays for numba, JAX or NumPy."""

import contextlib
import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Count, Finite, Positive, checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
from lqrsim.codegen.edge_pushing import Operations, hessian_of
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.sources import Source, source_of, text_source
from lqrsim.codegen.user_functions import (
    JaxSteps,
    UserFunction,
    check_derivative,
    interrupt_of,
    level_of,
    name_of,
    numbers_of,
    with_derivatives,
)
from lqrsim.errors import Array, InputError, check_array, check_count, check_items, check_name, excerpt
from lqrsim.kernels import differences, runge_kutta, user_functions
from lqrsim.results.coordinates import Coordinates, Limits

# The largest number of steps of second derivatives. A thousand take 0.6 s to derive and 1 s to compile; the aeroplane
# of `experiments/altro_problems.py` takes 2,300.
MOST_STEPS = 10_000


class Dynamics:
    """`xdot = f(x, u)`: Eq. (1), or with `period` a map `x+ = f(x, u)`, with the meaning of its states and controls.

    A pendulum, swung by a motor:

        def pendulum(x, u, p):
            from sympy import sin
            return [x.speed, u.torque / p.inertia - p.gravity / p.length * sin(x.angle)]

        ls.Dynamics(
            pendulum,
            states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "N m"},
            parameters={"inertia": 0.02, "gravity": 9.81, "length": 0.2}, angles=("angle",),
        )

    A function can be stated at four levels, which differ in speed and in what it may contain:

      symbolic  called once with SymPy symbols; exact derivatives follow. The fastest, and the default.
      compiled  a numba function, or one that numba can compile, of arrays. Without `jacobian`, derivatives are central
                differences, good to some eight digits, and an iteration takes longer.
      jax       a function of arrays of jax.numpy, such as a neural network. JAX compiles it, in double precision, and
                derives exact derivatives. Each step is a call through Python, some 20 us and more.
      plain     any Python function of NumPy arrays, called back through Python at every evaluation, and slow.

    Args:
      f: `f(x, u, p)`; returns one entry per state, without changing x (n,) and u (m,). The parameters are attributes of
        p. If x and u are symbols, states and controls are also attributes: `x.speed` is `x[1]`.
      states: name -> unit, in order; n of them.
      controls: name -> unit, in order; m of them.
      parameters: name -> value. Values are data: changing one compiles nothing.
      disturbances: quantities unknown when planning, such as a wind or the remaining fraction of a motor's force: name
        -> the value that the plan assumes, usually 0 or 1. To f they are parameters; for planning they are constants,
        which cost no time. `disturbed` makes them parameters, so that they can be estimated. `uncertainty_of` knows
        the names wind_x, wind_y, wind_z in m/s; force_x, ... in N; torque_x, ... in N m; all in world axes.
      position: names of the 2 or 3 states that are the robot's position in the world, in metres; of 3 as x, y, z.
      plane: plane of a position of 2 states, such as "xz"; by default that of two states named x, y or z.
      offset: coordinate of the plane along the third axis, in metres.
      angles: names of the states that are angles in radians, equal up to whole turns.
      rotation_vectors: names, by threes, of the states that are rotation vectors.
      control_limits: (lowest, highest) control, each a number or (m,), or a dictionary of name or unit of a control:
        (lowest, highest), as `{"force": (-2, 2)}`. It is the range of the actuators in execution.
      jacobian: `jacobian(x, u, p, fx, fu)`, for the compiled and the plain level, a numba function if f is one: writes
        the nonzero entries of df/dx and df/du to fx (n, n) and fu (n, m), which are zero on entry.
      level: one of the four; by default compiled if f is a numba function, else symbolic.
      period: for a map, f is the next state, after this many seconds, and every `dt` is this period. `rate` and
        `rate_jacobian` are then f's value and derivatives. A map has no inverse and no state in between: solvers in
        continuous time, form="primal" and free durations are refused. Not with JAX. None for rates.

    The result of f is checked when it is first needed.
    """

    _prefix = ""
    _want = "Dynamics(...), such as robot.dynamics"
    # Whether MuJoCo does the steps; see `problem/mjcf_dynamics.py`. They have no second derivatives.
    by_mujoco: bool = False
    # Relative size of states whose cost is negligible: if the least cost is zero, it is not reached to rounding.
    rounding: float = 1e-13
    # Hash of the model that MuJoCo steps; empty for functions, which source and parameters define.
    model_digest: str = ""
    # The name of dynamics that are not a function.
    _name: str = ""
    # Runge-Kutta steps in a control period; see `with_substeps`.
    substeps: int = 1

    @checked
    def __init__(
        self,
        f: Callable[[Any, Any, Any], Any],
        *,
        states: Mapping[str, str],
        controls: Mapping[str, str],
        parameters: Mapping[str, float] | None = None,
        disturbances: Mapping[str, float] | None = None,
        position: Sequence[str] = (),
        plane: str = "",
        offset: float | None = None,
        angles: Sequence[str] = (),
        rotation_vectors: Sequence[Sequence[str]] = (),
        control_limits: Limits | None = None,
        jacobian: Callable[..., None] | None = None,
        level: str | None = None,
        period: Positive | None = None,
    ) -> None:
        self._period = period
        for field, units in (("states", states), ("controls", controls)):
            if not isinstance(units, Mapping) or not all(isinstance(name, str) for name in units):
                raise InputError(f"{field}: got {excerpt(units)}, want a dictionary of name: unit")
        if not states or not controls:
            got = f"{len(states)} states and {len(controls)} controls"
            raise InputError(f"dynamics: got {got}, want at least one of each")
        names = tuple(states)
        for field, listed in (("position", position), ("angles", angles), ("rotation_vectors", rotation_vectors)):
            if isinstance(listed, str):
                raise InputError(f"{field}: got {excerpt(listed)}, want a tuple of names: ({excerpt(listed)},)")
        want = f"a tuple of names of states, of {', '.join(names)}"
        position = check_items("position", position, str, want)
        angles = check_items("angles", angles, str, want)

        def index(field: str, name: str) -> int:
            return names.index(check_name(field, name, names))

        starts = []
        for triple in check_items("rotation_vectors", rotation_vectors, (tuple, list), "a tuple of threes of names"):
            listed = check_items("rotation_vectors", triple, str, "tuples of three names of states")
            indices = [index("rotation_vectors", name) for name in listed]
            if len(indices) != 3 or indices != list(range(indices[0], indices[0] + 3)):
                raise InputError(f"rotation_vectors: got {excerpt(listed)}, want three neighbouring states")
            starts.append(indices[0])
        self.f, self.jacobian = f, jacobian
        self.level = level_of(f, level)
        if self.level == "jax" and period is not None:
            raise InputError(f'period: got {period:g} beside level="jax", want none: functions of JAX are rates')
        if jacobian is not None:
            check_derivative("jacobian", jacobian, f, self.level, "x, u, p, fx, fu")
        self.parameters, self.disturbances = map(symbolic.check_parameters, (parameters, disturbances))
        if twice := self.parameters.keys() & self.disturbances.keys():
            raise InputError(f"disturbances: got {min(twice)!r}, which is also a parameter, want another name")
        if self.level != "symbolic":  # constants gain nothing
            self.parameters |= self.disturbances
        self.state_coordinates = Coordinates(
            names=names, units=tuple(states.values()), plane=plane, offset=offset, rotation_vectors=tuple(starts),
            position=tuple(index("position", name) for name in position),
            angles=tuple(index("angles", name) for name in angles),
        )  # fmt: skip
        space = Coordinates(names=tuple(controls), units=tuple(controls.values()))
        self.control_coordinates = space if control_limits is None else space.limited(control_limits)
        # Computed now, not when first needed: several threads may need the functions, and addresses must not change.
        self.functions = self._functions()

    def __getstate__(self) -> dict[str, Any]:
        """Without derived attributes that cannot be pickled."""
        derived = "_plain", "disturbed", "compiled", "step_curvature"
        return {name: value for name, value in vars(self).items() if name not in derived}

    def __repr__(self) -> str:
        states, controls = (", ".join(space.labels) for space in (self.state_coordinates, self.control_coordinates))
        return f"{type(self).__name__}({self.name}: states {states}; controls {controls})"

    @property
    def name(self) -> str:
        return self._name or name_of(self.f)

    @property
    def period(self) -> float | None:
        """For a map, the only duration of a step in s; MuJoCo's time step, of which it is a multiple; else None."""
        return self._period

    @property
    def discrete(self) -> bool:
        """Whether the dynamics are the state after a step, not a rate: there is no inverse."""
        return self.period is not None

    def with_parameters(self, **values: float) -> "Dynamics":
        """The same dynamics with other values of some parameters, `mass=0.6`. Nothing compiles again."""
        for name in values:
            check_name("parameters", name, self.parameters)
        other = copy.copy(self)  # without `_plain` and `disturbed`, which have the old values
        other.parameters = self.parameters | symbolic.check_parameters(values)
        return other

    @cached_property
    def disturbed(self) -> "Dynamics":
        """The same dynamics with the disturbances as parameters, too. At their planned values nothing changes."""
        if self.disturbances.keys() <= self.parameters.keys():
            return self
        return self._traced_anew(parameters=self.parameters | self.disturbances)

    def with_substeps(self, count: int) -> "Dynamics":
        """The same dynamics with several equal Runge-Kutta steps in each control period; see `Problem.accuracy`."""
        count = check_count("substeps", count)
        if self.discrete or self.level == "jax":
            raise InputError(f"substeps: got {count} for {self.name}, want a rate that is no function of JAX")
        return self if count == self.substeps else self._traced_anew(substeps=count)

    def _traced_anew(self, **changed: Any) -> Self:
        """A copy with other attributes, without what was compiled for the present ones."""
        other = copy.copy(self)  # without `compiled` and `step_curvature`
        for name in ("source", "step_source", "curvature_source"):
            vars(other).pop(name, None)
        vars(other).update(changed)
        return other

    @property
    def calling(self) -> "Dynamics":
        """The dynamics whose functions compiled code calls for a step: these, unless they are made of others."""
        return self

    @property
    def data(self) -> Array:
        """The parameters' values, in order."""
        return np.array(list(self.parameters.values()), dtype=np.float64)

    @property
    def places(self) -> dict[str, int]:
        """The index of each parameter among the numbers that compiled code takes."""
        return {name: len(self.functions) + i for i, name in enumerate(self.parameters)}

    def _functions(self) -> tuple[UserFunction, ...]:
        """The functions that compiled code calls: none if the dynamics are symbolic, else f and the Jacobian, if there
        is one; and of JAX, also whole steps.
        """
        if self.level == "symbolic":
            return ()
        n, m = len(self.state_coordinates), len(self.control_coordinates)
        returned = {"values": n, "entries": self.state_coordinates.names}
        sizes: dict[str, Any] = {"level": self.level, "states": n, "controls": m, "parameters": tuple(self.parameters)}
        if self.level != "jax":
            return with_derivatives(self.f, returned, self.jacobian, ((n, n), (n, m)), **sizes)
        first = with_derivatives(self.f, returned, None, ((n, n), (n, m)), more=1, **sizes)
        return *first, JaxSteps(function=first[0].function, offset=first[0].offset, **returned, **sizes)

    @cached_property
    def source(self) -> Source:
        """Source of `rate` and `rate_jacobian` of `kernels/declarations.py`; symbolic dynamics are traced, once."""
        if self.level != "symbolic":
            kernel = source_of(user_functions)
            return kernel if len(self.functions) > 1 else source_of(differences).filled(rate=kernel)
        details = ("dynamics", *self._names, *self.constants.items())
        traced = symbolic.kept(self.f, details, lambda: {"source": self._trace()}, source=str)
        return text_source(traced["source"], f"{self.name}(x, u, p)")

    def touches(self, states: Array) -> bool:
        """Whether a contact or a limit acts in one of some states (k, n)."""
        return False

    def grazed(self, states: Array) -> tuple[int, list[str]]:
        """The first step at which a plan (T+1, n) grazes geoms that are fixed to the world, and the names of these.

        Ground does not count, nor geoms that the plan touches in its first or last state.
        """
        return 0, []

    def untouched_body(self, states: Array, state: int) -> str:
        """The body that a state moves, by its index, if nothing that moves touches it along a plan; or empty."""
        return ""

    def _cause_of_failure(self, state: Array) -> str | None:
        """Why a step from a state (n,) is not finite, as the end of a message; None if that is unknown."""
        return None

    def softened(self, states: Array) -> Iterator[tuple[str, "Dynamics"]]:
        """The dynamics with softer contacts and limits, in several degrees with their names, the softest first.

        There are none if nothing touches along the plan (T+1, n).
        """
        return iter(())

    def approaches(self, states: Array, change: Array) -> Iterator[tuple[str, "Dynamics", Array]]:
        """Motions of the robot that touch a body and take it along, in words: geometry alone, and so not feasible.

        Args:
          states: (T+1, n) of a plan in which nothing touches the body.
          change: (n,) by how much its states are to change until the end; zero for all others.

        Returns:
          For each, dynamics in which the robot passes through the body, and the motion (T+1, n), NaN for states that
          are not the robot's positions.
        """
        return iter(())

    @cached_property
    def step_source(self) -> Source:
        """Source of `advance` and `step_jacobian`, as in `kernels/runge_kutta.py`."""
        if self.level == "jax":
            return self.source.filled(rate_jacobian=self.source)
        return self._in_parts(self._part_source(), "advance", "step_jacobian")

    def _in_parts(self, part: Source, *names: str) -> Source:
        """Functions of a period, given their source of one Runge-Kutta step."""
        if self.substeps == 1:
            return part
        return part.filled(**{name: (part, f"{name}_in_parts") for name in names})

    def _part_source(self, **constants: int | tuple[int, ...]) -> Source:
        """The same of one Runge-Kutta step."""
        part = source_of(runge_kutta, MAP=int(self.discrete), PARTS=self.substeps, **constants)
        return part.filled(**self._rates)

    @property
    def _rates(self) -> dict[str, Source]:
        """The functions of `source` that steps leave open."""
        return {name: self.source for name in ("rate", "rate_jacobian", "chain") if self.source.has(name)}

    @property
    def _names(self) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        """The names of states, controls and parameters, on which traced formulas depend."""
        return self.state_coordinates.names, self.control_coordinates.names, tuple(self.parameters)

    @cached_property
    def compiled(self) -> CompiledModule:
        return self._module_of(self.step_source)

    def _module_of(self, source: Source) -> CompiledModule:
        n, m = len(self.state_coordinates), len(self.control_coordinates)
        return module_of(source, f"{self.name} ({n} states, {m} controls)", N=n, M=m)

    @cached_property
    def curvature_source(self) -> Source | None:
        """Source of `step_curvature`, as in `kernels/runge_kutta.py`; None if it is zero everywhere."""
        if self.level == "jax":
            return self.step_source
        part = self._curvature_of_part()
        return None if part is None else self._in_parts(part, "step_curvature")

    def _curvature_of_part(self) -> Source | None:
        """The same of one Runge-Kutta step."""
        axes = tuple(range(len(self.state_coordinates) + len(self.control_coordinates)))
        part, by_values = self._part_source(), source_of(differences, ACTIVE=axes)
        by_values = by_values.filled(**self._rates, advance=part, step_jacobian=part)
        by_jacobians = part.filled(step_curvature=(by_values, "curvature_from_jacobians"))
        if self.level != "symbolic" and self.jacobian is None:
            by_values = by_values.filled(value=(by_values, "weighted_step"))
            return part.filled(step_curvature=(by_values, "curvature_from_values"))
        if self.level != "symbolic":
            return by_jacobians
        details = ("second derivatives", MOST_STEPS, *self._names, *self.constants.items())
        traced = symbolic.kept(self.f, details, self._trace_curvature, source=str, support=list)
        support = tuple(traced["support"])
        if not traced["source"]:  # the formula would be too long
            return by_jacobians
        if not support:
            return None
        states = sum(i < len(self.state_coordinates) for i in support)
        curved = text_source(traced["source"], f"second derivatives of {self.name}(x, u, p)")
        return self._part_source(SUPPORT=support, K=len(support), STATES=states).filled(rate_curvature=curved)

    @cached_property
    def step_curvature(self) -> float:
        """The address of the second derivatives of a step, which are compiled; 0 if they are zero everywhere."""
        source = self.curvature_source
        return 0.0 if source is None else self._module_of(source).addresses("step_curvature")[0]

    @property
    def constants(self) -> dict[str, float]:
        """The disturbances that the plan treats as constants."""
        return {name: value for name, value in self.disturbances.items() if name not in self.parameters}

    def _traced(self) -> tuple[list[Any], list[Any], list[Any]]:
        return symbolic.trace(self.f, *self._names, constants=self.constants)

    def _trace(self) -> str:
        n = len(self.state_coordinates)
        rates, x, u = self._traced()
        if len(rates) != n:
            states = ", ".join(self.state_coordinates.names)
            raise InputError(f"{self.name}(x, u, p): got {len(rates)} entries, want {n}: one for each of {states}")
        values = {f"out[{i}]": rate for i, rate in enumerate(rates)}
        slopes = {f"fx[{i}, {j}]": rate.diff(xj) for i, rate in enumerate(rates) for j, xj in enumerate(x)}
        slopes |= {f"fu[{i}, {j}]": rate.diff(uj) for i, rate in enumerate(rates) for j, uj in enumerate(u)}
        slopes = {target: slope for target, slope in slopes.items() if slope != 0}
        of = f"{self.name}(x, u, p)"
        rate = symbolic.write_function("rate", "x, u, p, out", "p", values, of=of)
        jacobian = symbolic.write_function("rate_jacobian", "x, u, p, out, fx, fu", "p", values | slopes, of=of)
        return "\n\n".join([rate, jacobian, symbolic.write_chain(n, slopes)])

    def _trace_curvature(self) -> dict[str, Any]:
        """Source of `rate_curvature`, empty beyond MOST_STEPS, and in which entries of (x, u) f is curved."""
        hessian = self._weighted_hessian()
        if hessian is None:
            return {"source": "", "support": []}
        steps, curves = hessian
        support = sorted({i for pair in curves for i in pair})
        place = {i: k for k, i in enumerate(support)}
        values = {f"curve[{place[j]}, {place[i]}]": curve for (i, j), curve in curves.items()}
        of = f"{self.name}(x, u, p)"
        source = symbolic.write_function("rate_curvature", "x, u, p, w, curve", "p", values, of=of, steps=steps)
        return {"source": source, "support": support}

    def _weighted_hessian(self) -> tuple[list[tuple[Any, Any]], dict[tuple[int, int], Any]] | None:
        """The second derivatives by (x, u) of f's entries, weighted by w0, w1, ..., as `hessian_of` has them."""
        (rates, x, u), operations = self._traced(), Operations()
        return hessian_of(operations, operations.of(rates), symbolic.weights(len(rates)), [*x, *u], most=MOST_STEPS)

    @checked
    def period_near(self, dt: Finite) -> float:
        """The possible duration of steps nearest to `dt`, in seconds: `dt` itself; of a map its period; 0 for none.

        Of MuJoCo it is a multiple of the physics step.
        """
        if self.period is None:
            return dt
        return self.period if round(dt / self.period) >= 1 else 0.0

    def _parts_of(self, dt: float, most: int) -> int:
        """The number of equal parts, up to `most`, of a period of `dt` seconds at whose ends states are known."""
        return 1 if self.discrete else most

    @checked
    def check_period(self, dt: Finite) -> None:
        """Check that a step can last `dt` seconds: of a map, its period; see `MjcfDynamics` for MuJoCo's steps."""
        if self.period is not None and abs(dt - self.period) > 1e-9 * self.period:  # rounding, as of 1 / 30
            raise InputError(f"dt: got {dt:g} s, want {self.period:g} s, the period of the map {self.name}")

    def _runge_kutta(self, states: Array, controls: Array, dt: float) -> tuple[float, Array] | None:
        """The duration of the Runge-Kutta steps of periods of `dt` seconds, and df/dx (k, n, n) where these begin.

        None if the steps are another method's. The periods begin in states (k, n), under controls (k, m).
        """
        if self.discrete:
            return None
        slopes = np.zeros((len(states), states.shape[1], states.shape[1]))
        of = in_c_order(states), in_c_order(controls), numbers_of(self)
        self.compiled.state_jacobians(len(states), *of, slopes)
        if error := interrupt_of(self.functions):  # as by Ctrl-C
            raise error
        return dt / self.substeps, slopes

    def _with_finer_steps(self, dt: float, most: float) -> str:
        """How Runge-Kutta's steps in a control period of `dt` seconds become as short as `most` seconds, as text."""
        return f"use dt of at most {most * self.substeps:g} s, with {math.ceil(dt / most)} times as many steps"

    @checked
    def solving(self, threads: Count) -> contextlib.AbstractContextManager[None]:
        """A context in which a solver works, with this number of threads for one trajectory."""
        return contextlib.nullcontext()

    def quiet(self) -> contextlib.AbstractContextManager[None]:
        """A context in which their steps print nothing, for those that call compiled code outside of a solve."""
        return contextlib.nullcontext()

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        """The rate `xdot` (n,), per second, at one state (n,) and control (m,), in plain Python."""
        x, u = self._check(state, control)
        out = np.zeros(len(x))
        self._plain["rate"](x, u, self._numbers(), out)
        return out

    def rate_jacobian(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        """df/dx (n, n) and df/du (n, m) at one state (n,) and control (m,), in plain Python."""
        x, u = self._check(state, control)
        n, m = len(x), len(u)
        fx, fu = np.zeros((n, n)), np.zeros((n, m))
        self._plain["rate_jacobian"](x, u, self._numbers(), np.zeros(n), fx, fu)
        return fx, fu

    def step(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> Array:
        """The state (n,) after one step of `dt` seconds from a state (n,), with a control (m,) held.

        Negative steps lead backwards in time; a map and MuJoCo have none. MuJoCo's are NaN if they overflow.
        """
        x, u = self._check(state, control)
        out = np.zeros(len(x))
        self.check_period(dt)
        self._evaluate("advance", x, u, float(dt), out)
        return out

    def linearize(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> tuple[Array, Array, Array]:
        """A (n, n), B (n, m) and c (n,) of a step about a state and control: x' = A x + B u + c. Eqs. (24)-(25)."""
        x, u = self._check(state, control)
        n, m = len(x), len(u)
        out, jacobian = np.zeros(n), np.zeros((n, n + m))
        self.check_period(dt)
        self._evaluate("step_jacobian", x, u, float(dt), out, jacobian)
        a, b = jacobian[:, :n].copy(), jacobian[:, n:].copy()
        return a, b, out - a @ x - b @ u

    def _evaluate(self, name: str, x: Array, u: Array, dt: float, *out: Array) -> None:
        self._plain[name](x, u, self._numbers(), dt, *out)

    def _check(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        x = check_array("state", state, (len(self.state_coordinates),))
        return x, check_array("control", control, (len(self.control_coordinates),))

    @cached_property
    def _plain(self) -> dict[str, Any]:
        """What is compiled, as plain Python."""
        sizes = {"N": len(self.state_coordinates), "M": len(self.control_coordinates)}
        names = ("rate", "rate_jacobian", "advance", "step_jacobian")
        calls = [function.plain_call(self.parameters) for function in self.functions]
        return plain_functions(self.step_source, sizes, names, calls)

    def _numbers(self) -> Array:
        """The `p` of the compiled functions, with places for the addresses of functions."""
        return np.concatenate([np.arange(len(self.functions), dtype=np.float64), self.data])

"""MuJoCo as dynamics: the state after a control period, computed by MuJoCo's own steps."""

import contextlib
import copy
import math
import threading
from collections.abc import Iterator
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from lqrsim import process
from lqrsim.annotations import Count, Positive, checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError, check_name, check_number
from lqrsim.kernels import mjcf_dynamics as kernel
from lqrsim.machine import processors
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.scenes.contact_modes import ContactModes
from lqrsim.scenes.mjcf_approach import Approaches
from lqrsim.scenes.mjcf_model import FAR_PAST, MjcfModel
from lqrsim.scenes.mjcf_physics import (
    RK4,
    MjcfPhysics,
    carriers_of,
    check_planned,
    state_jacobians,
    touches,
    untouched_body,
)
from lqrsim.scenes.mujoco_log import unlogged

# Forces that may act on the robot's body, in the world's axes: names that `uncertainty_of` knows.
WRENCH = tuple(f"{what}_{axis}" for what in ("force", "torque") for axis in "xyz")

SOFTER = 0.1, 0.03, 0.01, 0.003  # m or rad, softness of contacts and limits in successive solves

_forming = threading.Lock()  # held while a team of threads is formed
_making = threading.Lock()  # held while MuJoCo's memory is made, which one thread does for all


class MjcfDynamics(Dynamics):
    """`x' = g(x, u)`, by MuJoCo's steps of a whole control period; `MjcfRobot` makes it.

    The state is the position of each joint, in MuJoCo's order of degrees of freedom and with rotations of ball and free
    joints as rotation vectors, or with `turns_about` as turns and tilts; then the velocities; then the states of
    actuators that have states. The control is MuJoCo's `ctrl`. Derivatives are products of those of the physics steps,
    differences that are each good to 1e-5 of the largest entry; those of an arm's period are good to some 1e-7. There
    is no rate: solvers in continuous time, and solvers that need an inverse, do not accept these dynamics.
    """

    by_mujoco: ClassVar[bool] = True
    rounding: ClassVar[float] = 1e-7  # MuJoCo iterates for its forces: arms that hold still move by 1e-11

    def __init__(
        self, mjcf: MjcfModel, name: str, *, body: int, obstacles: tuple[int, ...], states: Coordinates,
        controls: Coordinates, actuators: tuple[int, ...],
    ) -> None:  # fmt: skip
        self._name = name
        self._stated: dict[str, Any] = {"body": body, "obstacles": obstacles, "actuators": actuators}
        self.functions, self.level = (), "compiled"
        self.parameters: dict[str, float] = {}
        self.state_coordinates, self.control_coordinates = states, controls
        self._set_mjcf(mjcf)

    def _set_mjcf(self, mjcf: MjcfModel) -> None:
        self.mjcf, self.fixed, self._physics = mjcf, sha256(mjcf.xml, mjcf.turns_about or "", repr(self._stated)), None
        check_planned(mjcf.model, self._name, self._stated["obstacles"])
        loads = [f"{mjcf.model.body(number).name}_load" for number in carriers_of(mjcf.model)]
        self.disturbances = dict.fromkeys([*WRENCH, *loads], 0.0)

    @property
    def physics(self) -> MjcfPhysics:
        """MuJoCo's model, and memory for each thread, which are made when they are first asked for."""
        with _making:
            if self._physics is None:
                loaded = bool(self.parameters)
                self._physics = MjcfPhysics(self.mjcf, loaded=loaded, **self._stated)
            return self._physics

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_physics", "disturbed", "compiled")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._set_mjcf(self.mjcf)

    def __copy__(self) -> "MjcfDynamics":
        """A copy that shares MuJoCo's memory, if there is any yet."""
        other = object.__new__(type(self))
        vars(other).update({name: value for name, value in vars(self).items() if name != "disturbed"})
        return other

    @property
    def name(self) -> str:
        return self._name

    @cached_property
    def source(self) -> Source:
        return self.step_source

    @cached_property
    def step_source(self) -> Source:
        return source_of(kernel)

    @cached_property
    def disturbed(self) -> "MjcfDynamics":
        if self.parameters:
            return self
        other = copy.copy(self)
        other.parameters = dict(self.disturbances)
        other._set_mjcf(self.mjcf)  # with its own models, which carry the loads
        return other

    @property
    def data(self) -> Array:
        numbers, places = self.physics.numbers.copy(), self.places
        for name, value in self.parameters.items():
            numbers[places[name]] = value
        return numbers

    @property
    def places(self) -> dict[str, int]:
        loads = int(self.physics.numbers[kernel.LOADS])
        where = [*range(kernel.WRENCH, kernel.WRENCH + len(WRENCH)), *range(loads, loads + len(self.physics.carriers))]
        return {name: where[i] for i, name in enumerate(self.parameters)}

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of the MJCF that `with_parameters` takes, with their values.

        `mass` in kg, of all moving bodies, and `<body>_mass`; `<joint>_damping`, `_stiffness`, `_armature` and
        `_frictionloss`; `<geom>_friction`, sliding, of colliding geoms; `<actuator>_gear`, the largest number if there
        are several; `density` and `viscosity` of the medium. In MuJoCo's units.
        """
        passed = {self.mjcf.model.geom(geom).name for geom in self._stated["obstacles"]}  # which do not collide here
        found = self.mjcf.numbers.items()
        return {name: one.value for name, one in found if one.what != "friction" or one.part not in passed}

    def with_parameters(self, **values: float) -> "MjcfDynamics":
        """The same with other `numbers`: `dynamics.with_parameters(mass=0.6, pole_damping=0.02)`. Nothing compiles.

        A body's inertia scales with its mass; several numbers of a gear keep their ratios. Forces on the body are also
        parameters: `dynamics.disturbed.with_parameters(force_x=1.0)`.
        """
        numbers = self.numbers
        for name in values:
            check_name(f"{self.name}: parameters", name, [*self.parameters, *numbers])
        other = copy.copy(self)
        pushed = {name: check_number(name, value) for name, value in values.items() if name in self.parameters}
        other.parameters = self.parameters | pushed
        stated = {name: value for name, value in values.items() if name not in pushed}
        if stated:
            other._set_mjcf(self.mjcf.with_numbers(stated, self.name))
        return other

    @cached_property
    def curvature_source(self) -> Source | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """None: MuJoCo has no second derivatives."""
        return None

    def touches(self, states: Array) -> bool:
        return touches(self.physics.model, self._qpos_of(states[np.isfinite(states).all(axis=1)]))

    def untouched_body(self, states: Array, state: int) -> str:
        return untouched_body(self.physics.model, self._qpos_of(states), state)

    def _qpos_of(self, states: Array) -> Array:
        return self.mjcf.qpos_of(states[:, : self.mjcf.model.nv])

    def _cause_of_failure(self, state: Array) -> str | None:
        found = (one.past_limits(float(state[one.dof]), FAR_PAST) for one in self.mjcf.joints)
        return next((said for said in found if said), None)

    def softened(self, states: Array) -> Iterator[tuple[str, "MjcfDynamics"]]:
        if "softness" in self._stated or not np.isfinite(states).all() or not self.touches(states):
            return
        for softness in SOFTER:
            yield f"{softness:g}", self._stating(softness=softness)

    def approaches(self, states: Array, moves: Array) -> Iterator[tuple[str, "MjcfDynamics", Array]]:
        nv = self.physics.model.nv
        wanted = moves[:nv] if moves[:nv].any() else moves[nv : 2 * nv]  # a velocity points the way
        if not wanted.any():
            return
        found = Approaches(self.mjcf, states, wanted)
        with contextlib.suppress(InputError):  # in a <pair> the body collides in any case
            other = self._stating(obstacles=(*self._stated["obstacles"], *found.thing))
            for words, positions in found:
                yield words, other, np.pad(positions, [(0, 0), (0, len(moves) - nv)], constant_values=np.nan)

    def unlimited(self, actuators: tuple[int, ...], joints: tuple[int, ...]) -> "MjcfDynamics":
        """The same without limits on the forces of these actuators and on the sums at these joints."""
        return self._stating(unlimited=(actuators, joints))

    def _stating(self, **stated: Any) -> "MjcfDynamics":
        """The same with other arguments of its `MjcfPhysics`."""
        other = copy.copy(self)
        other._stated = self._stated | stated
        other._set_mjcf(self.mjcf)
        return other

    def contact_modes(self, dt: float) -> ContactModes | None:
        model, known = self.physics.model, not self.parameters and ContactModes.known_for(self.physics.model)
        substeps = round(dt / float(model.opt.timestep))
        return ContactModes(model, self._stated["actuators"], substeps) if known else None

    def _runge_kutta(self, states: Array, controls: Array, dt: float) -> tuple[float, Array] | None:
        model, nv = self.physics.model, self.mjcf.model.nv
        if model.opt.integrator != RK4:
            return None
        places, actuators = self._qpos_of(states), self._stated["actuators"]
        return self.period, state_jacobians(model, places, states[:, nv:], controls, actuators)

    def _with_finer_steps(self, dt: float, most: float) -> str:
        return f'set <option timestep="{dt / math.ceil(dt / most):.9g}"/>, or integrator="implicitfast", in the MJCF'

    @property
    def period(self) -> float:
        """The physics step in seconds."""
        return float(self.mjcf.model.opt.timestep)

    def _parts_of(self, dt: float, most: int) -> int:
        return round(dt / self.period)

    @checked
    def check_period(self, dt: Positive) -> None:
        """Raises InputError unless `dt` seconds are a whole number of physics steps."""
        timestep = float(self.physics.model.opt.timestep)
        steps = dt / timestep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise InputError(
                f"dt: got {dt:g} s, want a multiple of the physics step of {self.name}, {timestep:g} s;"
                f' or set <option timestep="{float(dt / max(round(steps), 1))!r}"/> there'
            )

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        raise InputError(f"{self.name}: got MuJoCo's steps, which have no rate, want `step`")

    def rate_jacobian(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        raise InputError(f"{self.name}: got MuJoCo's steps, which have no rate, want `linearize`")

    def step(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> Array:
        """The state (n,) after `dt` seconds, with the control held; NaN if it overflows."""
        x, u = self._check(state, control)
        self.check_period(dt)
        out = np.empty(len(x))
        with unlogged():
            self.compiled.advance(in_c_order(x), in_c_order(u), self.data, float(dt), out)
        return out

    def linearize(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> tuple[Array, Array, Array]:
        """A (n, n), B (n, m) and c (n,) of the step about a state and control: x' = A x + B u + c."""
        x, u = self._check(state, control)
        self.check_period(dt)
        n, m = len(x), len(u)
        out, jacobian = np.empty(n), np.empty((n, n + m))
        with unlogged():
            self.compiled.step_jacobian(in_c_order(x), in_c_order(u), self.data, float(dt), out, jacobian)
        a, b = jacobian[:, :n].copy(), jacobian[:, n:].copy()
        return a, b, out - a @ x - b @ u

    def quiet(self) -> contextlib.AbstractContextManager[None]:
        return unlogged()

    @contextlib.contextmanager
    @checked
    def solving(self, threads: Count) -> Iterator[None]:
        """In this context, that many threads linearise together, and MuJoCo does not print what statuses report.

        No more threads than processors are started, because they would wait for each other. None are started if bodies
        carry loads, which helper threads do not have. After a signal that raises KeyboardInterrupt all steps are NaN,
        so that the signal need not wait for the end of an iteration.
        """
        threads = min(threads, 1 if self.parameters else processors())
        team, helpers = self.physics.team, list[threading.Thread]()
        with unlogged(), process.on_interrupt(partial(team.__setitem__, kernel.SIGNALLED, 1)):
            with _forming:
                if team[kernel.HELPERS] == 0:
                    numbers, help_out = self.data, self.compiled.help_out
                    helpers += [threading.Thread(target=help_out, args=(numbers,)) for _ in range(threads - 1)]
                    team[kernel.HELPERS] = len(helpers)
            for helper in helpers:
                helper.start()
            try:
                yield
            finally:
                team[kernel.SIGNALLED] = 0
                if helpers:
                    team[kernel.STOP] = 1
                    for helper in helpers:
                        helper.join()
                    team[kernel.STOP] = team[kernel.HELPERS] = 0


class MjcfMemory(UserFunction):
    """The address that kernels call p, in the place of a function's: they find MuJoCo's memory of dynamics there."""

    @classmethod
    def of(cls, dynamics: MjcfDynamics) -> "MjcfMemory":
        memory = cls(
            function=_nothing, level="compiled", states=len(dynamics.state_coordinates), controls=0, parameters=(),
            offset=1, values=1, with_control=False, is_memory=True,
        )  # fmt: skip
        memory.held.append((dynamics.physics, dynamics.physics.address()))
        vars(memory).update(identity=dynamics.fixed, of_what=dynamics)
        return memory

    def __reduce__(self) -> tuple[Any, ...]:
        """The address for the dynamics in the other process."""
        return MjcfMemory.of, (vars(self)["of_what"],)


def _nothing(x: Array, p: Any) -> float:
    return 0.0

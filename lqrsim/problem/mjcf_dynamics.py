"""MuJoCo as dynamics: the state after a control period, computed by MuJoCo's own steps."""

import contextlib
import copy
import ctypes
import math
import platform
import threading
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim import process
from lqrsim.annotations import Count, Finite, Positive, checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError, check_name, check_number
from lqrsim.kernels import mjcf_dynamics as kernel
from lqrsim.machine import processors
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.rotations import AXES
from lqrsim.scenes.contacts import Approaches, ContactModes
from lqrsim.scenes.mjcf_kinematics import posed
from lqrsim.scenes.mjcf_model import FAR_PAST, MjcfModel
from lqrsim.scenes.mujoco_log import unlogged

RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_CONVERGED = 1e-14  # the constraint solver's tolerance: its error is divided by the step of a difference quotient
_DIFFERENCE = 1e-6  # step of `mjd_transitionFD`, that of MuJoCo's own tests
_GRAZED = 1e-3  # m; a plan along a geom is this close to it, in contact or just not
_TOLERANCE, _ITERATIONS = 1e-10, 100  # tolerance in m, and largest number of iterations, of distances
_KINDS = mujoco.mjtConstraint.__members__.items()
_ONE_SIDED = [int(kind) for name, kind in _KINDS if name.startswith(("mjCNSTR_LIMIT", "mjCNSTR_CONTACT"))]

# Forces that may act on the robot's body, in the world's axes: names that `uncertainty_of` knows.
WRENCH = tuple(f"{what}_{axis}" for what in ("force", "torque") for axis in "xyz")

SOFTER = 0.1, 0.03, 0.01, 0.003  # m or rad, softness of contacts and limits in successive solves

_forming = threading.Lock()  # held while a team of threads is formed
_making = threading.Lock()  # held while MuJoCo's memory is made, which one thread does for all


@dataclass(eq=False)
class MjcfPhysics:
    """The model that plans step with, and MuJoCo's memory for the threads of `kernels/mjcf_dynamics.py`.

    `physics.model` is a changed copy of the MJCF's own, `mjcf.model`:

    - obstacles do not collide: costs and constraints keep clear of them;
    - controls are not clipped to their range, which would hide from a solver the direction back into the range, nor are
      forces whose limits are constraints;
    - the constraint solver ends nearer to its solution;
    - an unstable simulation is not reset.

    Args:
      body: id of the body that is pushed. obstacles: ids of the geoms that are obstacles.
      unlimited: ids of the actuators and of the joints whose forces are not limited here.
      softness: least depth in m or rad over which the impedance of contacts and limits rises from zero; 0 for the
        MJCF's impedance.
      loaded: whether bodies carry loads, point masses at their centres of mass, which are then among the numbers.
    """

    mjcf: MjcfModel
    body: int
    obstacles: tuple[int, ...]
    unlimited: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    softness: float = 0.0
    loaded: bool = False

    def __post_init__(self) -> None:
        self.model = model = copy.copy(self.mjcf.model)
        for geom in np.intersect1d(self.obstacles, [model.pair_geom1, model.pair_geom2])[:1]:
            who = model.geom(int(geom)).name
            raise InputError(f"geom {who!r}: got an obstacle in a <contact><pair>, want contype/conaffinity instead")
        model.geom_contype[list(self.obstacles)] = model.geom_conaffinity[list(self.obstacles)] = 0
        option, flags = model.opt, mujoco.mjtDisableBit
        option.disableflags |= int(flags.mjDSBL_CLAMPCTRL) | int(flags.mjDSBL_AUTORESET) | int(flags.mjDSBL_SENSOR)
        option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        option.tolerance = min(option.tolerance, _CONVERGED)
        if mujoco.__version__ == "4.0.0":
            option.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)  # on sparse Jacobians its Newton solver is wrong
        model.actuator_forcelimited[list(self.unlimited[0])] = 0
        model.jnt_actfrclimited[list(self.unlimited[1])] = 0
        if self.softness > 0:
            # By default `solimp` is "0.9 0.95 0.001": a contact that is just reached has 90 % of its impedance, so that
            # a body which arrives at speed is stopped or not. If the impedance rises from zero, a step is continuous.
            for solimp in (model.geom_solimp, model.pair_solimp, model.jnt_solimp, model.tendon_solimp_lim):
                solimp[:, 0], solimp[:, 2] = 0.0, np.maximum(self.softness, solimp[:, 2])
            option.o_solimp[0], option.o_solimp[2] = 0.0, max(self.softness, option.o_solimp[2])
        n, m = 2 * model.nv + model.na, model.nu
        self.team = np.zeros(8, dtype=np.int64)  # the words that the threads share
        self.team[kernel.TICKET] = n + m  # a job without columns left
        self._job = np.zeros(1 + (n + m) + n + 6 + n * (n + m))
        self._kernel_numbers: Array | None = None
        self._for_distances: mujoco.MjModel | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return MjcfPhysics, tuple(getattr(self, field.name) for field in fields(self))

    @cached_property
    def digest(self) -> str:
        """Of what the model is made from; whether it is loaded is told by the names of parameters."""
        arguments = ((field, getattr(self, field.name)) for field in fields(self)[1:-1])
        changed = {field.name: value for field, value in arguments if value != field.default}
        return sha256(self.mjcf.xml, self.mjcf.turns_about or "", repr(changed))

    @property
    def kernel_numbers(self) -> Array:
        """Those for the kernel, without a wrench and loads; they have addresses in the memory, which is made here."""
        with _making:
            if self._kernel_numbers is None:
                self._kernel_numbers = self._with_memory()
            return self._kernel_numbers

    def _with_memory(self) -> Array:
        model, carriers = self.model, list(self.mjcf.carriers if self.loaded else ())
        # With loads, each slot has its own model, which may be large; filters need one slot.
        slots = 2 if self.loaded else 2 * processors()
        self._models = [copy.copy(model) if self.loaded else model for _ in range(slots)]
        self._data = [mujoco.MjData(model) for _ in range(slots)]
        self._flags, self._table = np.zeros(slots, dtype=np.int64), np.zeros((slots, kernel.SLOT))
        for row, own_model, data in zip(self._table, self._models, self._data, strict=True):
            # MuJoCo reports the first warning of each kind to a file and the console; here none is the first.
            data.warning.number[:] = 1
            arrays = {
                kernel.QPOS: data.qpos, kernel.QVEL: data.qvel, kernel.ACT: data.act, kernel.CTRL: data.ctrl,
                kernel.WARM: data.qacc_warmstart, kernel.QACC: data.qacc, kernel.XPOS: data.xpos,
                kernel.XMAT: data.xmat, kernel.GEOM_XPOS: data.geom_xpos, kernel.GEOM_XMAT: data.geom_xmat,
                kernel.XFRC_APPLIED: data.xfrc_applied[self.body], kernel.MASSES: own_model.body_mass,
            }  # fmt: skip
            row[list(arrays)] = [array.ctypes.data for array in arrays.values()]
            row[[kernel.DATA, kernel.OWN_MODEL]] = data._address, own_model._address
        joints = np.stack([model.jnt_type, model.jnt_qposadr, model.jnt_dofadr], axis=1).astype(np.float64)
        loads = np.zeros(len(carriers)), carriers, model.body_mass[carriers]
        entries = _functions() | {
            kernel.FLAGS: self._flags.ctypes.data, kernel.SLOTS: self._table.ctypes.data,
            kernel.COUNT: slots, kernel.TEAM: self.team.ctypes.data, kernel.JOB: self._job.ctypes.data,
            kernel.MODEL: model._address, kernel.TIMESTEP: model.opt.timestep, kernel.NV: model.nv,
            kernel.NA: model.na, kernel.JOINTS: model.njnt,
            kernel.KEEPS: model.opt.integrator != RK4,  # RK4 ends with the stages of its last evaluation
            kernel.LOADED: len(carriers), kernel.LOADS: kernel.TABLE + joints.size,
        }  # fmt: skip
        if self.mjcf.turns_about is not None:
            entries[kernel.AXIS + AXES.index(self.mjcf.turns_about)] = 1.0
        numbers = np.zeros(kernel.TABLE)
        numbers[list(entries)] = list(entries.values())
        return np.concatenate([numbers, joints.ravel(), *loads])

    def address(self) -> int:
        """The address of the numbers, for kernels of distances. Their model, which may be large, is not made before.

        Its distances are more exact, so that their directions are gradients: with MuJoCo's tolerance of 1e-6 m,
        directions between geoms that nearly touch can be a few degrees off.
        """
        numbers = self.kernel_numbers
        with _making:
            if self._for_distances is None:
                self._for_distances = exact = copy.copy(self.model)
                option = exact.opt
                option.ccd_tolerance, option.ccd_iterations = _TOLERANCE, max(_ITERATIONS, option.ccd_iterations)
                # The other algorithm is wrong at a distance.
                option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
                numbers[kernel.DISTANCE_MODEL] = exact._address
        return numbers.ctypes.data


@cache
def _functions() -> dict[int, float]:
    """The addresses of the functions that the kernel calls, by their indices: MuJoCo's, and one that yields, if any."""
    folder = Path(mujoco.__file__).parent
    patterns = {"Windows": "mujoco.dll", "Darwin": "libmujoco*.dylib"}
    (library, *_) = sorted(folder.glob(patterns.get(platform.system(), "libmujoco.so*")))
    loaded = ctypes.CDLL(str(library))
    functions = {
        kernel.STEP: loaded.mj_step, kernel.STEP_SKIP: loaded.mj_stepSkip, kernel.KINEMATICS: loaded.mj_kinematics,
        kernel.RESET: loaded.mj_resetData, kernel.COMPOS: loaded.mj_comPos, kernel.JAC: loaded.mj_jac,
        kernel.DISTANCE: loaded.mj_geomDistance, kernel.CONSTANTS: loaded.mj_setConst,
    }  # fmt: skip
    if platform.system() != "Windows":
        functions[kernel.YIELD] = ctypes.CDLL(None).sched_yield
    return {index: float(ctypes.cast(call, ctypes.c_void_p).value or 0) for index, call in functions.items()}


class MjcfDynamics(Dynamics):
    """`x' = g(x, u)`, by MuJoCo's steps of a whole control period; `MjcfRobot` makes it.

    `MjcfRobot` says what states and controls are. Derivatives are products of those of the physics steps, differences
    that are each good to 1e-5 of the largest entry; those of an arm's period are good to some 1e-7. There is no rate:
    solvers in continuous time, and solvers that need an inverse, do not accept these dynamics.
    """

    by_mujoco: bool = True
    curvature_source = None  # pyright: ignore[reportAssignmentType] MuJoCo has no second derivatives
    rounding: float = 1e-7  # MuJoCo iterates for its forces: arms that hold still move by 1e-11

    def __init__(
        self, mjcf: MjcfModel, name: str, *, body: int, obstacles: tuple[int, ...], states: Coordinates
    ) -> None:
        model = mjcf.model
        refusals = {
            "actuators": (model.nu == 0, "got none", "at least one <actuator> that has a control"),
            "deformable parts": (model.nflex > 0, "got some", "rigid bodies"),
            "plugins": (model.npluginstate > 0, "got plugins with their own states", "none"),
            "delays": (model.actuator_history.any(), "got actuators with a delay", "none"),
        }
        for part, (present, got, wanted) in refusals.items():
            if present:
                raise InputError(f"{name}: {part}: {got}, want {wanted}")
        self._name, self.physics = name, MjcfPhysics(mjcf, body, obstacles)
        self.functions, self.level = (), "compiled"
        names, units, low, high = zip(*mjcf.controls, strict=True)
        self.state_coordinates = states
        self.control_coordinates = Coordinates(names=names, units=units, low=low, high=high)
        loads = [f"{model.body(number).name}_load" for number in mjcf.carriers]
        self.parameters: dict[str, float] = {}
        self.disturbances = dict.fromkeys([*WRENCH, *loads], 0.0)

    def with_physics(self, **changed: Any) -> "MjcfDynamics":
        """The same with other arguments of its `MjcfPhysics`, which has its own memory."""
        dynamics = copy.copy(self)
        dynamics.physics = replace(self.physics, **changed)
        return dynamics

    @property
    def mjcf(self) -> MjcfModel:
        return self.physics.mjcf

    @property
    def model_digest(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.physics.digest

    @cached_property
    def step_source(self) -> Source:
        return source_of(kernel)

    @cached_property
    def disturbed(self) -> "MjcfDynamics":
        if self.parameters:
            return self
        dynamics = self.with_physics(loaded=True)  # with its own models, which carry the loads
        dynamics.parameters = dict(self.disturbances)
        return dynamics

    @property
    def data(self) -> Array:
        numbers = self.physics.kernel_numbers.copy()
        numbers[list(self.places.values())] = list(self.parameters.values())
        return numbers

    @property
    def places(self) -> dict[str, int]:
        loads = kernel.TABLE + 3 * self.physics.model.njnt
        where = [*range(kernel.WRENCH, kernel.WRENCH + len(WRENCH)), *range(loads, loads + len(self.mjcf.carriers))]
        return {name: where[i] for i, name in enumerate(self.parameters)}

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of the MJCF that `with_parameters` takes, with their values.

        `mass` in kg, of all moving bodies, and `<body>_mass`; `<joint>_damping`, `_stiffness`, `_armature` and
        `_frictionloss`; `<geom>_friction`, sliding, of colliding geoms; `<actuator>_gear`, the largest number if there
        are several; `density` and `viscosity` of the medium. In MuJoCo's units.
        """
        obstacles = {self.mjcf.model.geom(geom).name for geom in self.physics.obstacles}  # which do not collide here
        entries = self.mjcf.numbers.items()
        return {name: entry.value for name, entry in entries if entry.what != "friction" or entry.part not in obstacles}

    def with_parameters(self, **values: float) -> "MjcfDynamics":
        """The same with other `numbers`: `dynamics.with_parameters(mass=0.6, pole_damping=0.02)`. Nothing compiles.

        A body's inertia scales with its mass; several numbers of a gear keep their ratios. Of `disturbed`, forces on
        the body are also parameters: `dynamics.disturbed.with_parameters(force_x=1.0)`.
        """
        numbers = self.numbers
        for name in values:
            check_name(f"{self.name}: parameters", name, [*self.parameters, *numbers])
        disturbances = {name: check_number(name, value) for name, value in values.items() if name in self.parameters}
        mjcf_numbers = {name: value for name, value in values.items() if name not in disturbances}
        dynamics = copy.copy(self)
        if mjcf_numbers:
            dynamics = self.with_physics(mjcf=self.mjcf.with_numbers(mjcf_numbers, self.name))
        dynamics.parameters = self.parameters | disturbances
        return dynamics

    @unlogged()
    def touches(self, states: Array) -> bool:
        poses = self._posed(self.physics.model, states[np.isfinite(states).all(axis=1)])
        return any(np.isin(data.efc_type, _ONE_SIDED).any() for data in poses)

    @unlogged()
    def grazed(self, states: Array) -> tuple[int, list[str]]:
        model, touched = copy.copy(self.physics.model), list[set[int]]()
        model.geom_margin[:] += _GRAZED
        ground = np.isin(model.geom_type, [int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)])
        passed = np.flatnonzero((model.body_weldid[model.geom_bodyid] == 0) & ~ground)
        for data in self._posed(model, states):
            touched.append(set(passed[np.isin(passed, data.contact.geom)].tolist()))
        met = set[int]().union(*touched) - touched[0] - touched[-1]
        if not met:
            return 0, []
        return next(t for t, geoms in enumerate(touched) if geoms & met), [model.geom(i).name for i in sorted(met)]

    @unlogged()
    def untouched_body(self, states: Array, state: int) -> str:
        model = self.physics.model
        if state >= 2 * model.nv:  # of an actuator
            return ""
        body, welds = int(model.dof_bodyid[state % model.nv]), model.body_weldid
        for data in self._posed(model, states):
            for pair in data.contact.geom:
                first, second = (int(welds[model.geom_bodyid[geom]]) for geom in pair)
                if int(welds[body]) in (first, second) and first and second:
                    return ""
        return model.body(body).name

    def _posed(self, model: mujoco.MjModel, states: Array) -> Iterator[mujoco.MjData]:
        return posed(model, self.mjcf.qpos_of(states[:, : model.nv]), mujoco.mj_fwdPosition)

    def _cause_of_failure(self, state: Array) -> str | None:
        complaints = (joint.past_limits(float(state[joint.dof]), FAR_PAST) for joint in self.mjcf.joints)
        return next((complaint for complaint in complaints if complaint), None)

    def softened(self, states: Array) -> Iterator[tuple[str, "MjcfDynamics"]]:
        if self.physics.softness or not np.isfinite(states).all() or not self.touches(states):
            return
        for softness in SOFTER:
            yield f"{softness:g}", self.with_physics(softness=softness)

    def approaches(self, states: Array, change: Array) -> Iterator[tuple[str, "MjcfDynamics", Array]]:
        nv = self.physics.model.nv
        motion = change[:nv] if change[:nv].any() else change[nv : 2 * nv]  # a velocity points the way
        if not motion.any():
            return
        approaches = Approaches(self.mjcf, states, motion)
        with contextlib.suppress(InputError):  # in a <pair> the body collides in any case
            dynamics = self.with_physics(obstacles=(*self.physics.obstacles, *approaches.body_geoms))
            for words, positions in approaches:
                yield words, dynamics, np.pad(positions, [(0, 0), (0, len(change) - nv)], constant_values=np.nan)

    def contact_modes(self, dt: float) -> ContactModes | None:
        """The contact modes of periods of `dt` seconds; None unless all switches are known."""
        known = not self.parameters and ContactModes.known_for(self.physics.model)
        return ContactModes(self.physics.model, round(dt / self.period)) if known else None

    def _runge_kutta(self, states: Array, controls: Array, dt: float) -> tuple[float, Array] | None:
        """The slopes are those of an explicit Euler step, which MuJoCo can differentiate, divided by the step.

        Positions change with the velocities alone: that the axes of a ball turn with it is left out.
        """
        if self.physics.model.opt.integrator != RK4:
            return None
        explicit, nv, n = copy.copy(self.physics.model), self.mjcf.model.nv, states.shape[1]
        explicit.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        explicit.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        data, jacobians, step = mujoco.MjData(explicit), np.zeros((len(states), n, n)), np.zeros((n, n))
        jacobians[:, :nv, nv : 2 * nv], positions = np.eye(nv), self.mjcf.qpos_of(states[:, :nv])
        for slopes, qpos, state, control in zip(jacobians, positions, states, controls, strict=True):
            data.qpos[:], data.qvel[:], data.act[:] = qpos, state[nv : 2 * nv], state[2 * nv :]
            data.qacc_warmstart[:], data.ctrl[:] = 0.0, control
            with unlogged():
                mujoco.mjd_transitionFD(explicit, data, _DIFFERENCE, True, step, None, None, None)
            slopes[nv:] = (step - np.eye(n))[nv:] / self.period
        return self.period, jacobians

    def _with_finer_steps(self, dt: float, most: float) -> str:
        return f'set <option timestep="{dt / math.ceil(dt / most):.9g}"/>, or integrator="implicitfast", in the MJCF'

    @property
    def period(self) -> float:
        """The physics step."""
        return float(self.mjcf.model.opt.timestep)

    def _parts_of(self, dt: float, most: int) -> int:
        return round(dt / self.period)

    @checked
    def period_near(self, dt: Finite) -> float:
        return max(round(dt / self.period), 0) * self.period

    @checked
    def check_period(self, dt: Positive) -> None:
        """Raises InputError unless `dt` seconds are a whole number of physics steps."""
        steps = dt / self.period
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise InputError(
                f"dt: got {dt:g} s, want a multiple of the physics step of {self.name}, {self.period:g} s;"
                f' or set <option timestep="{float(dt / max(round(steps), 1))!r}"/> there'
            )

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        raise InputError(f"{self.name}: got MuJoCo's steps, which have no rate, want `step`")

    def rate_jacobian(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        raise InputError(f"{self.name}: got MuJoCo's steps, which have no rate, want `linearize`")

    def _evaluate(self, name: str, x: Array, u: Array, dt: float, *out: Array) -> None:
        """By MuJoCo, which writes NaN where a step overflows."""
        with unlogged():
            getattr(self.compiled, name)(in_c_order(x), in_c_order(u), self.data, dt, *out)

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

    is_memory = True

    @classmethod
    def of(cls, dynamics: MjcfDynamics) -> "MjcfMemory":
        memory = cls(
            function=_nothing, level="compiled", states=len(dynamics.state_coordinates), controls=0, parameters=(),
            offset=1, values=1, with_control=False,
        )  # fmt: skip
        held = dynamics.physics, dynamics.physics.address()
        vars(memory).update(identity=dynamics.model_digest, held=held, of_what=dynamics)
        return memory

    def __reduce__(self) -> tuple[Any, ...]:
        """The address for the dynamics in the other process."""
        return MjcfMemory.of, (vars(self)["of_what"],)


def _nothing(x: Array, p: Any) -> float:
    return 0.0

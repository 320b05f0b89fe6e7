"""MuJoCo's own steps as numbers for compiled code: addresses, sizes, and memory for several threads."""

import copy
import ctypes
import platform
from collections.abc import Sequence
from functools import cache, cached_property
from pathlib import Path

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.kernels import mjcf_dynamics as kernel
from lqrsim.machine import processors
from lqrsim.rotations import AXES
from lqrsim.scenes.mjcf_kinematics import posed
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mujoco_log import unlogged

RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_CONVERGED = 1e-14  # the constraint solver's tolerance: its error is divided by the step of a difference quotient
_DIFFERENCE = 1e-6  # step of `mjd_transitionFD`, that of MuJoCo's own tests
_CLOSE, _LOOKS = 1e-10, 100  # tolerance in m, and largest number of iterations, of distances


class MjcfPhysics:
    """The data of an MJCF for `kernels/mjcf_dynamics.py`.

    The model is the MJCF's own, except that

    - obstacles do not collide: costs and constraints keep clear of them;
    - controls are not clipped to their range, which would hide from a solver the direction back into the range, nor are
      forces whose limits are constraints;
    - the constraint solver ends nearer to its solution;
    - an unstable simulation is not reset.

    Args:
      mjcf: the MJCF, whose model passes `check_planned`. body: id of the body that is pushed.
      actuators: ids of the controlled actuators, in order. obstacles: ids of the geoms that are obstacles.
      loaded: whether bodies carry loads, point masses at their centres of mass, which are then among the numbers.
      softness: depth in m or rad over which the impedance of contacts and limits rises from zero; 0 for the MJCF's
        impedance.
      unlimited: ids of the actuators and of the joints whose forces are not limited here.

    Attributes:
      model: MuJoCo's model. numbers: the numbers for the kernel, without a wrench and loads. team: the words that its
        threads share. carriers: ids of the bodies that can carry a load: bodies that move and have mass.
    """

    def __init__(
        self,
        mjcf: MjcfModel,
        *,
        body: int,
        actuators: tuple[int, ...],
        obstacles: tuple[int, ...],
        loaded: bool = False,
        softness: float = 0.0,
        unlimited: tuple[tuple[int, ...], tuple[int, ...]] = ((), ()),
    ) -> None:
        model = mjcf.model
        self.model = copy.copy(model)
        _prepare(self.model, obstacles)
        self.model.actuator_forcelimited[list(unlimited[0])] = 0
        self.model.jnt_actfrclimited[list(unlimited[1])] = 0
        if softness > 0:
            _soften(self.model, softness)
        self.carriers = carriers_of(model)
        # With loads, each slot has its own model, which may be large; filters need one slot.
        slots = 2 if loaded else 2 * processors()
        self._models = [copy.copy(self.model) if loaded else self.model for _ in range(slots)]
        self._data = [mujoco.MjData(self.model) for _ in range(slots)]
        for data in self._data:
            # MuJoCo reports the first warning of each kind to a file and the console; here no warning counts as the
            # first.
            for warning in range(len(data.warning.number)):
                data.warning.number[warning] = 1
        self._flags = np.zeros(slots, dtype=np.int64)
        self.team = np.zeros(8, dtype=np.int64)
        n, m = 2 * self.model.nv + self.model.na, len(actuators)
        self.team[kernel.TICKET] = n + m  # a job without columns left
        self._job = np.zeros(1 + (n + m) + n + 6 + n * (n + m))
        addresses = [self._addresses(data, model, body) for data, model in zip(self._data, self._models, strict=True)]
        self._table = np.array(addresses, dtype=np.float64)
        self.numbers = self._numbers(actuators, self.carriers if loaded else (), mjcf.turns_about)

    def address(self) -> int:
        """The address of the numbers, for kernels of places and distances.

        The model for distances, which is as large as all meshes and textures, is not made before.
        """
        self.numbers[kernel.DISTANCE_MODEL] = self._for_distances._address
        return self.numbers.ctypes.data

    @cached_property
    def _for_distances(self) -> mujoco.MjModel:
        """The model with more exact distances, whose directions are gradients.

        With MuJoCo's own tolerance of 1e-6 m, the direction between two geoms that nearly touch can be a few degrees
        off.
        """
        exact = copy.copy(self.model)
        exact.opt.ccd_tolerance, exact.opt.ccd_iterations = _CLOSE, max(_LOOKS, exact.opt.ccd_iterations)
        # The other algorithm is wrong at a distance.
        exact.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        return exact

    def _addresses(self, data: mujoco.MjData, model: mujoco.MjModel, body: int) -> list[float]:
        row = np.zeros(kernel.SLOT)
        fields = {
            kernel.QPOS: data.qpos, kernel.QVEL: data.qvel, kernel.ACT: data.act, kernel.CTRL: data.ctrl,
            kernel.WARM: data.qacc_warmstart, kernel.QACC: data.qacc, kernel.PUSH: data.xfrc_applied[body],
            kernel.XPOS: data.xpos, kernel.XMAT: data.xmat, kernel.GEOM_XPOS: data.geom_xpos,
            kernel.GEOM_XMAT: data.geom_xmat, kernel.MASSES: model.body_mass,
        }  # fmt: skip
        for place, array in fields.items():
            row[place] = array.ctypes.data
        row[kernel.DATA], row[kernel.OWN_MODEL] = data._address, model._address
        return row.tolist()

    def _numbers(self, actuators: tuple[int, ...], carriers: tuple[int, ...], turns_about: str | None) -> Array:
        model, functions = self.model, _functions()
        joints = np.stack([model.jnt_type, model.jnt_qposadr, model.jnt_dofadr], axis=1).astype(np.float64)
        numbers = np.zeros(kernel.TABLE)
        numbers[kernel.FLAGS], numbers[kernel.SLOTS] = self._flags.ctypes.data, self._table.ctypes.data
        numbers[kernel.COUNT], numbers[kernel.MODEL] = len(self._flags), model._address
        numbers[kernel.STEP], numbers[kernel.STEP_SKIP] = functions["mj_step"], functions["mj_stepSkip"]
        # RK4 ends with the stages of its last evaluation.
        numbers[kernel.KEEPS] = model.opt.integrator != RK4
        numbers[kernel.TIMESTEP], numbers[kernel.NV], numbers[kernel.NA] = model.opt.timestep, model.nv, model.na
        numbers[kernel.JOINTS], numbers[kernel.ACTUATORS] = model.njnt, kernel.TABLE + joints.size
        numbers[kernel.TEAM], numbers[kernel.JOB] = self.team.ctypes.data, self._job.ctypes.data
        numbers[kernel.YIELD], numbers[kernel.KINEMATICS] = _yield(), functions["mj_kinematics"]
        numbers[kernel.RESET], numbers[kernel.COMPOS] = functions["mj_resetData"], functions["mj_comPos"]
        numbers[kernel.JAC], numbers[kernel.DISTANCE] = functions["mj_jac"], functions["mj_geomDistance"]
        numbers[kernel.LOADED], numbers[kernel.LOADS] = len(carriers), kernel.TABLE + joints.size + len(actuators)
        loads = np.zeros(len(carriers)), carriers, model.body_mass[list(carriers)]
        numbers[kernel.CONSTANTS] = functions["mj_setConst"]
        if turns_about is not None:
            numbers[kernel.AXIS + AXES.index(turns_about)] = 1.0
        return np.concatenate([numbers, joints.ravel(), actuators, *loads])


def carriers_of(model: mujoco.MjModel) -> tuple[int, ...]:
    """Ids of the bodies that can carry a load: bodies that move and have mass."""
    return tuple(np.flatnonzero((model.body_treeid >= 0) & (model.body_mass > 0)).tolist())


def check_planned(model: mujoco.MjModel, name: str, obstacles: tuple[int, ...]) -> None:
    """Raises InputError if there is no actuator, an obstacle is in a <pair>, or something has states of its own."""
    refused = {
        "actuators": (model.nu == 0, "got none", "at least one <actuator> that has a control"),
        "deformable parts": (model.nflex > 0, "got some", "rigid bodies"),
        "plugins": (model.npluginstate > 0, "got plugins with their own states", "none"),
        "delays": (model.actuator_history.any(), "got actuators with a delay", "none"),
    }
    for what, (found, got, wanted) in refused.items():
        if found:
            raise InputError(f"{name}: {what}: {got}, want {wanted}")
    for geom in np.intersect1d(obstacles, [model.pair_geom1, model.pair_geom2])[:1]:
        who = model.geom(int(geom)).name
        raise InputError(f"geom {who!r}: got an obstacle in a <contact><pair>, want contype/conaffinity instead")


def _prepare(model: mujoco.MjModel, obstacles: tuple[int, ...]) -> None:
    model.geom_contype[list(obstacles)] = model.geom_conaffinity[list(obstacles)] = 0
    option, flags = model.opt, mujoco.mjtDisableBit
    option.disableflags |= int(flags.mjDSBL_CLAMPCTRL) | int(flags.mjDSBL_AUTORESET) | int(flags.mjDSBL_SENSOR)
    option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    option.tolerance = min(option.tolerance, _CONVERGED)
    if mujoco.__version__ == "4.0.0":
        option.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)  # on sparse Jacobians its Newton solver is wrong


def _soften(model: mujoco.MjModel, width: float) -> None:
    """Let the impedance of contacts and limits rise from zero, over at least this depth in m or rad.

    By default `solimp` is "0.9 0.95 0.001": a contact that is just reached has 90 % of its impedance, so a body that
    arrives at speed is either stopped or not. If the impedance rises from zero, a step is continuous.
    """
    for solimp in (model.geom_solimp, model.pair_solimp, model.jnt_solimp, model.tendon_solimp_lim):
        solimp[:, 0], solimp[:, 2] = 0.0, np.maximum(width, solimp[:, 2])
    model.opt.o_solimp[0], model.opt.o_solimp[2] = 0.0, max(width, model.opt.o_solimp[2])


@unlogged()
def touches(model: mujoco.MjModel, qpos: Array) -> bool:
    """Whether a contact or a limit acts at one of these positions (k, nq)."""
    kinds = mujoco.mjtConstraint.__members__
    one_sided = [int(kind) for name, kind in kinds.items() if name.startswith(("mjCNSTR_LIMIT", "mjCNSTR_CONTACT"))]
    return any(np.isin(data.efc_type, one_sided).any() for data in posed(model, qpos, mujoco.mj_fwdPosition))


@unlogged()
def untouched_body(model: mujoco.MjModel, qpos: Array, state: int) -> str:
    """The body that a state (an index) moves, if nothing moving touches it at any of these (k, nq); else empty."""
    dof = state % model.nv if state < 2 * model.nv else -1
    if dof < 0:
        return ""
    body = int(model.dof_bodyid[dof])
    roots = model.body_weldid
    for data in posed(model, qpos, mujoco.mj_fwdPosition):
        for pair in data.contact.geom:
            first, second = (int(roots[model.geom_bodyid[one]]) for one in pair)
            if int(roots[body]) in (first, second) and first and second:
                return ""
    return model.body(body).name


def state_jacobians(
    model: mujoco.MjModel, qpos: Array, rest: Array, controls: Array, actuators: Sequence[int]
) -> Array:
    """Derivatives (k, n, n) of the rates of positions, velocities and activations by these.

    They are those of an explicit Euler step, which MuJoCo can differentiate, divided by the step. Positions change
    with the velocities alone: that the axes of a ball turn with it is left out.

    Args:
      qpos: (k, nq). rest: (k, n - nv), velocities and activations. controls: (k, m), of these actuators.
    """
    explicit = copy.copy(model)
    explicit.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    explicit.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    data, nv, n = mujoco.MjData(explicit), model.nv, 2 * model.nv + model.na
    found, step = np.zeros((len(qpos), n, n)), np.zeros((n, n))
    found[:, :nv, nv : 2 * nv] = np.eye(nv)
    for slopes, place, other, control in zip(found, qpos, rest, controls, strict=True):
        data.qpos[:], data.qvel[:], data.act[:], data.qacc_warmstart[:] = place, other[:nv], other[nv:], 0.0
        data.ctrl[list(actuators)] = control
        with unlogged():
            mujoco.mjd_transitionFD(explicit, data, _DIFFERENCE, True, step, None, None, None)
        slopes[nv:] = (step - np.eye(n))[nv:] / model.opt.timestep
    return found


@cache
def _yield() -> int:
    """The address of a function that yields to other threads; 0 if there is none."""
    if platform.system() == "Windows":
        return 0
    return ctypes.cast(ctypes.CDLL(None).sched_yield, ctypes.c_void_p).value or 0


@cache
def _functions() -> dict[str, int]:
    """The addresses of MuJoCo's functions, in the library that the bindings have loaded."""
    folder = Path(mujoco.__file__).parent
    patterns = {"Windows": "mujoco.dll", "Darwin": "libmujoco*.dylib"}
    (library, *_) = sorted(folder.glob(patterns.get(platform.system(), "libmujoco.so*")))
    loaded = ctypes.CDLL(str(library))
    names = (
        "mj_step", "mj_stepSkip", "mj_kinematics", "mj_resetData", "mj_comPos", "mj_jac", "mj_geomDistance",
        "mj_setConst",
    )  # fmt: skip
    return {name: ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value or 0 for name in names}

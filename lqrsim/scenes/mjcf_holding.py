"""The controls that hold a robot from an MJCF still, by MuJoCo's inverse dynamics."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.scenes.mjcf_joints import Equalities, control_ranges, couplings_of, loops_of, ranges
from lqrsim.scenes.scene import unlogged

_HELD = 1e-6  # largest missing force of a robot that counts as held, relative to the largest force
_NEWTON, _HALVES, _NUDGE = 100, 12, 1e-7  # limits of steps and halvings; m or rad of difference quotients
_RATHER, _RANK = 1e3, 1e-6  # preference for joints without actuators as those that follow, and what is no slope
_LIGHT = 1e-9  # weight of the controls relative to the forces: selects the smallest controls that hold


@dataclass(frozen=True, eq=False)
class Holding:
    """Controls, and the forces that they leave.

    Attributes:
      controls: (m,), within their limits, that come nearest to holding the robot still.
      activations: (na,), the states of actuators at which they do so: a filter's state is its control, an integrator's
        state is the value that it has reached.
      missed: (nv,), the missing force of each joint in N or N m; 0 for joints that follow others.
      drifting: (nu,), the actuators whose activation never rests: integrators whose control cannot be 0.
      held: whether the controls hold the robot.
    """

    controls: Array
    activations: Array
    missed: Array
    drifting: npt.NDArray[np.bool_]
    held: bool


class _Levels:
    """The variable in which each actuator's force is affine: its control or, if it has one, its activation.

    A filter's and a muscle's activation comes to rest at the control, or at the end of its own range that is nearest to
    it. An integrator's rests anywhere with a control of zero. Where its control cannot be zero, it rests at the end of
    its range, and without a range it drifts.

    Attributes:
      low, high: (nu,), of the levels at which it may rest. drifting: (nu,), whether it never does.
      ranges: of the controls, two (nu,).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        kinds, D = model.actuator_dyntype, mujoco.mjtDyn
        integrates = kinds == D.mjDYN_INTEGRATOR.value
        follows = np.isin(kinds, [one.value for one in (D.mjDYN_FILTER, D.mjDYN_FILTEREXACT, D.mjDYN_MUSCLE)])
        self.activated = np.flatnonzero(follows | integrates)
        self.places = model.actuator_actadr[self.activated] + model.actuator_actnum[self.activated] - 1
        self.ranges = control_ranges(model)
        least, most = ranges(model.actuator_actlimited.astype(bool) & (follows | integrates), model.actuator_actrange)
        self.low, self.high = (np.clip(side, least, most) for side in self.ranges)
        pushed = np.clip(0.0, *self.ranges)  # the control of an integrator that is nearest to rest
        self.low = np.where(integrates, np.where(pushed > 0, most, least), self.low)
        self.high = np.where(integrates, np.where(pushed < 0, least, most), self.high)
        self.drifting = integrates & (((pushed > 0) & np.isinf(most)) | ((pushed < 0) & np.isinf(least)))
        self.low[self.drifting], self.high[self.drifting] = -np.inf, np.inf
        self._integrates, self._pushed = integrates, pushed

    def controls(self, levels: Array) -> Array:
        """The controls (nu,) that go with levels (nu,), which need not be within the range."""
        return np.where(self._integrates, self._pushed, levels)

    def act(self, levels: Array, data: mujoco.MjData) -> None:
        """Apply levels (nu,) to the model's data."""
        data.ctrl[:] = self.controls(levels)
        data.act[self.places] = levels[self.activated]


@unlogged()
def holding(model: mujoco.MjModel, qpos: Array, act: Array, actuators: npt.NDArray[np.intp]) -> Holding:
    """The controls of actuators, in that order, with which nothing accelerates at rest once activations have settled.

    Actuator forces are assumed to be affine in the controls or activations, like those of motors and servos: inverse
    dynamics give the required forces, and least squares within the limits finds the controls. `act` matters only for
    actuators of other kinds.
    """
    from scipy.optimize import lsq_linear

    free = _without_force_limits(model)
    data = mujoco.MjData(free)
    data.qpos[:], data.act[:] = qpos, act
    mujoco.mj_inverse(free, data)
    wanted = data.qfrc_inverse.copy()
    levels = _Levels(model)
    low, high = levels.low, levels.high

    def force(asked: Array) -> Array:
        levels.act(asked, data)
        mujoco.mj_forward(free, data)
        return data.qfrc_actuator.copy()

    middle = np.clip(np.zeros(model.nu), low, high)
    rest = force(middle)
    columns = np.stack([force(middle + one) - rest for one in np.eye(model.nu)], axis=1)
    size = max(1.0, float(np.abs(wanted).max(initial=0.0)))
    kept, carried = _carried(model, qpos, np.asarray(columns.any(axis=1)))
    columns, rest, wanted = carried @ columns, carried @ rest, carried @ wanted
    scale = np.abs(columns).max(axis=0)
    scale[scale == 0] = 1.0  # for example if a state of the actuator comes in between
    rows = np.concatenate([columns / scale, _LIGHT * np.eye(model.nu)])
    aims = np.concatenate([wanted - rest, np.zeros(model.nu)])
    bounds = (low - middle) * scale, (high - middle) * scale
    tight = bounds[1] - bounds[0] < 1e-12  # lsq_linear refuses such bounds
    bounds = np.where(tight, -1e-12, bounds[0]), np.where(tight, 1e-12, bounds[1])
    found = middle + lsq_linear(rows, aims, bounds).x / scale
    found = np.clip(found, low, high)
    found[np.abs(found) * scale < 1e-12 * size] = 0.0  # rounding
    missed = np.zeros(model.nv)
    missed[kept] = wanted - rest - columns @ (found - middle)
    levels.act(found, data)
    held = bool((np.abs(missed) <= _HELD * size).all()) and not levels.drifting.any()
    controls = np.clip(data.ctrl, *levels.ranges)[actuators]
    return Holding(controls, data.act.copy(), missed, levels.drifting, held)


def _without_force_limits(model: mujoco.MjModel) -> mujoco.MjModel:
    free = copy.copy(model)
    free.actuator_forcelimited[:] = 0
    free.jnt_actfrclimited[:] = 0
    return free


@unlogged()
def settled(model: mujoco.MjModel, qpos: Array) -> tuple[Array, float]:
    """Positions (nq,) nearby at which the undriven joints are at rest, and the largest force (N, N m) left on them.

    It uses Newton's method with steps of least norm: contacts are springs, and nothing moves in a free direction, such
    as along a floor.
    """
    data, levels, strong = mujoco.MjData(model), _Levels(model), _without_force_limits(model)
    data.qpos[:] = qpos

    def forces(asked: Array) -> Array:
        levels.act(asked, data)
        mujoco.mj_forward(strong, data)  # at its limit, a force does not change, though the joint is driven
        return data.qfrc_actuator.copy()

    driven = np.zeros(model.nv, dtype=bool)
    for one in np.eye(model.nu):
        driven |= forces(one) != forces(-one)
    free = np.flatnonzero(~driven)
    if not len(free):
        return qpos.copy(), 0.0

    def missing(moved: Array) -> tuple[Array, Array]:
        place, motion = qpos.copy(), np.zeros(model.nv)
        motion[free] = moved
        mujoco.mj_integratePos(model, place, motion, 1.0)
        data.qpos[:], data.qvel[:], data.qacc[:] = place, 0, 0
        mujoco.mj_inverse(model, data)
        return place, data.qfrc_inverse[free].copy()

    moved = np.zeros(len(free))
    place, left = missing(moved)
    for _ in range(_NEWTON):
        slopes = [missing(moved + one)[1] - missing(moved - one)[1] for one in _NUDGE * np.eye(len(free))]
        step = -np.linalg.lstsq(np.array(slopes).reshape(len(free), -1).T / (2 * _NUDGE), left, rcond=1e-6)[0]
        for share in 0.5 ** np.arange(_HALVES):
            tried, then = missing(moved + share * step)
            if np.linalg.norm(then) < np.linalg.norm(left):
                moved, place, left = moved + share * step, tried, then
                break
        else:
            break
    return place, float(np.abs(left).max(initial=0.0))


def _carried(model: mujoco.MjModel, qpos: Array, driven: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.intp], Array]:
    """The free joints, and the map from forces on all joints to those on them, (free, nv), through equalities.

    In a loop those follow that are not driven, as far as there are enough of them.
    """
    if loops_of(model):
        from scipy.linalg import qr

        _, slopes = Equalities(model).at(qpos)
        _, corner, order = qr(slopes * np.where(driven, 1.0, _RATHER), mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
        rank = int((np.abs(np.diagonal(corner)) > _RANK * np.abs(slopes).max(initial=0.0)).sum())
        follow, kept = (np.sort(one).astype(np.intp) for one in (order[:rank], order[rank:]))
        moves = np.eye(model.nv)[:, kept]
        moves[follow] = -np.linalg.lstsq(slopes[:, follow], slopes[:, kept], rcond=None)[0]
        return kept, moves.T
    moves, coupled = np.eye(model.nv), couplings_of(model)
    for one in coupled:
        moves[one.dof] = one.ratio * moves[one.other] if one.other >= 0 else 0.0
    kept = np.setdiff1d(np.arange(model.nv), [one.dof for one in coupled])
    return kept, moves[:, kept].T


@unlogged()
def efforts(model: mujoco.MjModel, actuators: npt.NDArray[np.intp]) -> Array:
    """The largest size of each control, (m,): from its own limits, else from its force's; 1 without limits."""
    found = np.ones(model.nu)
    for number in range(model.nu):
        gain, gear = abs(float(model.actuator_gainprm[number, 0])), abs(float(model.actuator_gear[number, 0]))
        joint = int(model.actuator_trnid[number, 0])
        of_joint = model.actuator_trntype[number] == mujoco.mjtTrn.mjTRN_JOINT and model.jnt_actfrclimited[joint]
        servo = model.actuator_biastype[number] != mujoco.mjtBias.mjBIAS_NONE  # its control is no force
        if model.actuator_ctrllimited[number]:
            largest = float(np.abs(model.actuator_ctrlrange[number]).max())
        elif model.actuator_forcelimited[number] and gain and not servo:
            largest = float(np.abs(model.actuator_forcerange[number]).max()) / gain
        elif of_joint and gain and gear and not servo:
            largest = float(np.abs(model.jnt_actfrcrange[joint]).max()) / (gain * gear)
        else:
            continue
        found[number] = largest if largest > 0 else 1.0
    return found[actuators]

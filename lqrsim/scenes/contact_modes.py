"""The contact mode of an MJCF, that is, what acts at each physics step of a control period; and the distance to others.

A contact or a limit begins to act when its distance crosses zero. An active one, or an edge of its friction cone, lets
go when its force crosses zero. Each of these *switches* is a number that changes sign at the event. As long as no
switch changes sign, a control period is a smooth function of its state and control. If a distance changes sign, the
period is in general discontinuous. If a force changes sign, it has a kink.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

_WATCHED = 0.02  # m or rad; smaller distances are watched
_SMALLER = 1.0, 1e-2, 1e-4  # steps of differences, relative to the first; tried until one stays in the mode
_KIND = mujoco.mjtConstraint
_LIMITS = np.array([int(_KIND.mjCNSTR_LIMIT_JOINT), int(_KIND.mjCNSTR_LIMIT_TENDON)])
_CONTACTS = np.array([int(_KIND.mjCNSTR_CONTACT_FRICTIONLESS), int(_KIND.mjCNSTR_CONTACT_PYRAMIDAL)])
# The name of a switch as a number: its stage, whether it is a force, the kind of element, and the element.
_STAGE, _FORCE, _CONTACT, _GEOM, _NUMBER, _EDGE = 1 << 48, 1 << 47, 1 << 46, 1 << 14, 1 << 16, 1 << 4

Names = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Switches:
    """Switches of a control period, (k,): their names, ascending, and their values, negative for active ones."""

    names: Names
    values: Array

    def at(self, names: Names, numbers: Array | None = None) -> Array:
        """The values of the switches of these names, NaN where there is none; or other numbers of them, (k, ...)."""
        numbers = self.values if numbers is None else numbers
        if np.array_equal(names, self.names):
            return numbers
        values = np.full((len(names), *numbers.shape[1:]), np.nan)
        _, places, own_places = np.intersect1d(names, self.names, assume_unique=True, return_indices=True)
        values[places] = numbers[own_places]
        return values

    @property
    def forces(self) -> npt.NDArray[np.bool_]:
        """Flags of the switches that are forces; their change of sign is a kink, not a jump."""
        return (self.names & _FORCE) != 0

    def before_jump(self, crossed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Which of them are seen before the first distance of those crossed has an effect, or with it."""
        jumps = self.names[crossed & ~self.forces]
        return self.names < (jumps[0] // _FORCE + 1) * _FORCE if len(jumps) else np.ones(len(self.names), np.bool_)

    def same_mode(self, other: "Switches") -> bool:
        """Whether the same elements act in both. An element that is out of sight does not act."""
        if not np.array_equal(self.names[self.forces], other.names[other.forces]):
            return False
        acts_there, acts_here = other.at(self.names) < 0, self.at(other.names) < 0
        return np.array_equal(self.values < 0, acts_there) and np.array_equal(other.values < 0, acts_here)


class Period(NamedTuple):
    """A control period, linearised in its contact mode."""

    state: Array  # (n,) at its end
    jacobian: Array  # (n, n+m)
    switches: Switches
    slopes: Array  # (k, n+m) of the switches, NaN if unknown


class ContactModes:
    """Control periods of an MJCF by MuJoCo's bindings, with the switches of each stage of each physics step."""

    # Called before each part of a long computation, which its exception ends.
    check_time: Callable[[], None] = staticmethod(lambda: None)

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self._model, self._substeps = model, substeps
        self._data, self._wide_model = mujoco.MjData(model), copy.copy(model)
        for margins in (self._wide_model.jnt_margin, self._wide_model.tendon_margin, self._wide_model.geom_margin):
            margins[:] += _WATCHED
        self._wide_data, self._nv = mujoco.MjData(self._wide_model), model.nv
        self._four = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)

    @staticmethod
    def known_for(model: mujoco.MjModel) -> bool:
        """Whether all switches are known: joints only slide or turn, and friction cones are pyramids."""
        turning = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
        dry = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
        elliptic = model.opt.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
        return bool(turning.all()) and not (dry or elliptic or model.na or model.npair or model.geom_gap.any())

    def step(self, state: Array, control: Array) -> tuple[Array, Switches]:
        """The state (n,) after a control period, and its switches."""
        data, observed = self._data, list[tuple[Names, Array]]()
        data.qpos[:], data.qvel[:] = state[: self._nv], state[self._nv :]
        data.ctrl[:], data.qacc_warmstart[:], data.time = control, 0.0, 0.0
        for step in range(self._substeps):
            if self._four:
                self._runge_kutta(4 * step, observed)
            else:
                qpos = data.qpos.copy()
                mujoco.mj_step(self._model, data)
                self._observe(step, qpos, observed)
        names = np.concatenate([np.zeros(0, np.int64), *(switch_names for switch_names, _ in observed)])
        values = np.concatenate([np.zeros(0), *(switch_values for _, switch_values in observed)])
        order = np.argsort(names)
        return np.concatenate([data.qpos, data.qvel]), Switches(names[order], values[order])

    def _runge_kutta(self, stage: int, switches: list[tuple[Names, Array]]) -> None:
        """A physics step of `mj_RungeKutta`, whose four stages each have their own contacts."""
        model, data, h = self._model, self._data, self._model.opt.timestep
        qpos, qvel, time = data.qpos.copy(), data.qvel.copy(), data.time
        mujoco.mj_forward(model, data)
        self._observe(stage, data.qpos, switches)
        speeds, rates = [qvel], [data.qacc.copy()]
        for number, fraction in enumerate((0.5, 0.5, 1.0)):
            data.qpos[:] = qpos + h * fraction * speeds[number]
            data.qvel[:], data.time = qvel + h * fraction * rates[number], time + h * fraction
            mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_NONE, 1)
            self._observe(stage + number + 1, data.qpos, switches)
            speeds.append(data.qvel.copy())
            rates.append(data.qacc.copy())
        weights = np.array([1.0, 2.0, 2.0, 1.0]) / 6
        data.qpos[:], data.qvel[:] = qpos + h * weights @ speeds, qvel + h * weights @ rates
        data.time = time + h

    def _observe(self, stage: int, qpos: Array, switches: list[tuple[Names, Array]]) -> None:
        """Add the switches of a stage at these positions (nq,), whose forces are in the data."""
        model, seen = self._model, self._wide_data
        seen.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._wide_model, seen)
        limits, first = _among(seen.efc_type, _LIMITS), stage * _STAGE
        if limits.any():
            distances = (seen.efc_pos - seen.efc_margin)[limits] + _WATCHED
            switches.append((first + _limits(self._wide_model, seen, limits), distances))
        if seen.ncon:
            geoms, wide_margin, geom_margin = seen.contact.geom, self._wide_model.geom_margin, model.geom_margin
            # Versions of MuJoCo differ in whether the margin of two geoms is their sum or their maximum.
            summed = np.abs(seen.contact.includemargin - wide_margin[geoms].sum(axis=1)) < 1e-9
            margins = np.where(summed, geom_margin[geoms].sum(axis=1), geom_margin[geoms].max(axis=1))
            switches.append((first + _contacts(geoms), seen.contact.dist - margins))
        data = self._data
        if data.nefc == 0:
            return
        limits, contacts = _among(data.efc_type, _LIMITS), _among(data.efc_type, _CONTACTS)
        excess = np.empty(data.nefc)  # acceleration minus the constraint's reference; it pushes if this is negative
        mujoco.mj_mulJacVec(model, data, excess, data.qacc)
        excess -= data.efc_aref
        if limits.any():
            switches.append((first + _FORCE + _limits(model, data, limits), excess[limits]))
        if contacts.any():
            numbers = data.efc_id[contacts]
            edges = np.arange(len(numbers)) - np.searchsorted(numbers, numbers)
            names = first + _FORCE + _contacts(data.contact.geom)[numbers] + edges
            switches.append((names, excess[contacts]))

    def linearize(self, state: Array, control: Array) -> Period:
        """The control period and its derivatives, by differences that stay in its contact mode.

        Differences are central if both sides stay in the mode, one-sided if one side does, and smaller if neither does.
        """
        n, point = len(state), np.concatenate([state, control])
        end, switches = self.step(state, control)
        jacobian, slopes = np.empty((n, len(point))), np.empty((len(switches.names), len(point)))
        for k in range(len(point)):
            ends, sides, width = dict[int, tuple[Array, Switches]](), dict[int, tuple[Array, Switches]](), 0.0
            for fraction in _SMALLER:
                width = fraction * 1e-6 * max(1.0, abs(point[k]))
                for sign in (1, -1):
                    shifted = point.copy()
                    shifted[k] += sign * width
                    ends[sign] = self.step(shifted[:n], shifted[n:])
                sides = {sign: side for sign, side in ends.items() if side[1].same_mode(switches)}
                if sides:
                    break
            else:
                sides = ends
            high, low = sides.get(1, (end, switches)), sides.get(-1, (end, switches))
            width *= len(sides)
            jacobian[:, k] = (high[0] - low[0]) / width
            slopes[:, k] = (high[1].at(switches.names) - low[1].at(switches.names)) / width
        return Period(end, jacobian, switches, slopes)


def _among(types: npt.NDArray[np.int32], kinds: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """`np.isin`, which takes long for so few."""
    return np.asarray((types[:, None] == kinds).any(axis=1))


def _limits(model: mujoco.MjModel, data: mujoco.MjData, rows: npt.NDArray[np.bool_]) -> Names:
    """Names of the limits in these rows: a joint or a tendon, its number, and which of its two limits."""
    numbers, joints = data.efc_id[rows].astype(np.int64), data.efc_type[rows] == _LIMITS[0]
    lower = data.efc_J.reshape(data.nefc, -1)[rows].sum(axis=1) > 0  # of a joint
    tendons = numbers[~joints]
    lower[~joints] = np.isclose(data.efc_pos[rows][~joints], data.ten_length[tendons] - model.tendon_range[tendons, 0])
    return 4 * numbers + 2 * joints + lower


def _contacts(geoms: npt.NDArray[np.int32]) -> Names:
    """Names of contacts: the two geoms, and a number; they leave room for the edges of a friction pyramid."""
    pairs = (geoms[:, 0].astype(np.int64) * _GEOM + geoms[:, 1]) * _NUMBER
    earlier = np.tril(pairs[:, None] == pairs, -1).sum(axis=1, dtype=np.int64)
    return _CONTACT + pairs + earlier * _EDGE

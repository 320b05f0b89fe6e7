"""The force limits of an MJCF as constraints: class and kernel.

MuJoCo clips forces. Past a limit, a control has no effect, and a solver cannot tell how to come back: a servo with a
stiffness of 4,500 N m/rad and 87 N m is past it at 0.02 rad from its target. So plans are made with dynamics without
these limits and with the limits as constraints, where forces are linear in the state and the control. Such a plan
never clips, and both models are the same along it.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError
from lqrsim.kernels.declarations import M, N, W
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.mjcf_dynamics import MjcfDynamics
from lqrsim.scenes.mjcf_model import MjcfModel, Side, unlogged

_PROBES, _LINEAR = 4, 1e-9  # random states and controls at which a force is compared with its slopes; relative error


class ForceLimit(NamedTuple):
    """A limited force that is linear in state and control.

    Attributes:
      name, unit: of the force, as "of actuator" or "on joint". low, high: its limits.
      slopes: (1+n+m,) its value at zero, and its slopes.
      of_joint: whether the limit is that of a joint, on the sum of all actuators, or of an actuator. id: its id.
    """

    name: str
    unit: str
    low: float
    high: float
    slopes: Array
    of_joint: bool
    id: int

    def can_be_kept(self, state: Array, low: Array, high: Array) -> bool:
        """Whether some control (m,) between `low` and `high` keeps it in a state (n,)."""
        n = len(state)
        slopes = self.slopes[1 + n :]
        ends = np.stack([np.where(slopes != 0, slopes * side, 0.0) for side in (low, high)])
        force = self.slopes[0] + self.slopes[1 : 1 + n] @ state
        return bool(force + ends.min(axis=0).sum() <= self.high and force + ends.max(axis=0).sum() >= self.low)


class ForceLimits(Constraint):
    """The forces of actuators and joints within their limits, at the beginning of each control period.

    `MjcfRobot.force_limits` makes it, for problems with `MjcfRobot.unlimited` as their dynamics. Limits of actuators
    whose forces are not linear, such as those of muscles, stay in the dynamics.

    Attributes:
      limits: the limited forces.
    """

    def __init__(self, limits: Sequence[ForceLimit]) -> None:
        self.limits = tuple(limits)

    def removed_from(self, dynamics: MjcfDynamics) -> MjcfDynamics:
        """Dynamics without these limits."""
        actuators, joints = (tuple(one.id for one in self.limits if one.of_joint is joint) for joint in (False, True))
        return dynamics.unlimited(actuators, joints)

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        size = len(dynamics.state_coordinates) + len(dynamics.control_coordinates)
        rows, described, ranges = [], [], []
        for one in self.limits:
            if len(one.slopes) != 1 + size:
                raise InputError(
                    f"ForceLimits: got forces of {len(one.slopes) - 1} states and controls, want {size}, as the"
                    " dynamics have"
                )
            for side, sign, word in ((one.low, 1.0, "at least"), (one.high, -1.0, "at most")):
                rows.append(sign * (one.slopes - side * np.eye(1, 1 + size)[0]))
                described.append(f"the force {one.name} of {word} {side:g} {one.unit}")
                ranges.append(one.high - one.low)
        return ConstraintTerm(
            source_of(__name__), np.ravel(rows), len(rows), described.__getitem__, uses_control=True, convex=True,
            ranges=np.array(ranges),
        )  # fmt: skip


def limited_forces(mjcf: MjcfModel) -> tuple[tuple[ForceLimit, ...], tuple[str, ...]]:
    """The limited forces of an MJCF that are linear, and the names of the others.

    A force is linear if its differences about zero predict it at random states.
    """
    limited: list[tuple[str, str, Side, int, bool, int]] = []
    units = {one.name: "N m" if one.kind == "hinge" else "N" for one in mjcf.joints}
    for i, one in enumerate(mjcf.actuators):
        unit = units.get(one.joint or "", "N")
        limited.append((f"of {one.name}", unit, one.forces, one.outputs.start, False, i))
    for i, one in enumerate(mjcf.joints):
        limited.append((f"on {one.name}", units[one.name], one.forces, mjcf.model.nout + one.dof, True, i))
    limited = [one for one in limited if np.isfinite(one[2]).any()]
    if not limited:
        return (), ()
    slopes, linear = _slopes(mjcf)
    found = (ForceLimit(name, unit, *sides, slopes[:, place].copy(), *of) for name, unit, sides, place, *of in limited)
    kept = tuple(one for one, (*_, place, _, _) in zip(found, limited, strict=True) if linear[place])
    return kept, tuple(name for name, *_, place, _, _ in limited if not linear[place])


def _slopes(mjcf: MjcfModel) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Forces of all actuators' outputs and on all joints: their values at zero and slopes, (1+n+m, nout+nv), and
    whether they are linear.
    """
    model = copy.copy(mjcf.model)
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    data, nv, n = mujoco.MjData(model), model.nv, 2 * model.nv + model.na

    def forces(z: Array) -> Array:
        data.qpos[:], data.qvel[:] = mjcf.qpos_of(z[:nv]), z[nv : 2 * nv]
        data.act[:], data.ctrl[:] = z[2 * nv : n], z[n:]
        for part in (mujoco.mj_fwdPosition, mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation):
            part(model, data)
        return np.concatenate([data.actuator_force, data.qfrc_actuator])

    with unlogged():
        slopes = np.stack([(forces(one) - forces(-one)) / 2 for one in np.eye(n + model.nu)])
        zero, linear = forces(np.zeros(n + model.nu)), np.ones(slopes.shape[1], dtype=bool)
        for z in np.random.default_rng(0).normal(size=(_PROBES, n + model.nu)):
            size = np.abs(zero) + np.abs(z) @ np.abs(slopes)
            linear &= np.abs(forces(z) - zero - z @ slopes) <= _LINEAR * size
    return np.vstack([zero, slopes]), linear


# The kernel: a row's value at zero, and its slopes in states and controls, are the numbers of `data`, row by row.


def value(x, u, t, row, data):
    """The distance to a limit."""
    first = row * (1 + W)
    total = data[first]
    for i in range(N):
        total += data[first + 1 + i] * x[i]
    for i in range(M):
        total += data[first + 1 + N + i] * u[i]
    return total


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    first = row * (1 + W)
    for i in range(W):
        gradient[i] += data[first + 1 + i]

"""The force limits of an MJCF as constraints: class and kernel.

MuJoCo clips forces. Past a limit, a control has no effect, and a solver cannot tell how to come back: a servo with a
stiffness of 4,500 N m/rad and 87 N m is past it at 0.02 rad from its target. So plans are made with dynamics without
these limits and with the limits as constraints, where forces are linear in the state and the control. Such a plan
never clips, and both models are the same along it.
"""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError
from lqrsim.kernels.declarations import M, N, W
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics

_PROBES, _LINEAR = 4, 1e-9  # random states and controls at which a force is compared with its slopes; relative error


class ForceLimit(NamedTuple):
    """A limited force that is linear in state and control.

    Attributes:
      name, unit: of the force. low, high: its limits. slopes: (1+n+m,) its value at zero, and its slopes.
    """

    name: str
    unit: str
    low: float
    high: float
    slopes: Array


class ForceLimits(Constraint):
    """The forces of actuators and joints within their limits, at the beginning of each control period.

    `MjcfRobot.force_limits` makes it, for problems with `MjcfRobot.unlimited` as their dynamics.

    Attributes:
      limits: the limited forces.
    """

    def __init__(self, limits: Sequence[ForceLimit]) -> None:
        self.limits = tuple(limits)

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
                described.append(f"{one.name} of {word} {side:g} {one.unit}")
                ranges.append(one.high - one.low)
        return ConstraintTerm(
            source_of(__name__), np.ravel(rows), len(rows), described.__getitem__, uses_control=True, convex=True,
            ranges=np.array(ranges),
        )  # fmt: skip


def limited_forces(
    model: mujoco.MjModel, configuration: Callable[[Array], tuple[Array, Array]]
) -> tuple[list[ForceLimit], mujoco.MjModel, list[str]]:
    """The limited forces of a model that are linear; a copy without their limits; and the names of the other forces.

    A force is linear if it is so in MuJoCo: its differences about one state predict it at random ones.

    Args:
      configuration: qpos and qvel of a state (n,).
    """
    free = copy.copy(model)
    free.actuator_forcelimited[:] = 0
    free.jnt_actfrclimited[:] = 0
    data, n = mujoco.MjData(free), 2 * model.nv + model.na

    def forces(z: Array) -> Array:
        data.qpos[:], data.qvel[:] = configuration(z[:n])
        data.act[:], data.ctrl[:] = z[2 * model.nv : n], z[n:]
        mujoco.mj_fwdPosition(free, data)
        mujoco.mj_fwdVelocity(free, data)
        mujoco.mj_fwdActuation(free, data)
        return np.concatenate([data.actuator_force, data.qfrc_actuator])

    rng = np.random.default_rng(0)
    zero = forces(np.zeros(n + model.nu))
    slopes = np.stack([zero, *((forces(one) - forces(-one)) / 2 for one in np.eye(n + model.nu))])
    linear = np.ones(len(zero), dtype=bool)
    for _ in range(_PROBES):
        z = rng.normal(size=n + model.nu)
        size = np.abs(slopes[0]) + np.abs(slopes[1:]).T @ np.abs(z)
        linear &= np.abs(forces(z) - slopes[0] - z @ slopes[1:]) <= _LINEAR * np.maximum(size, 1e-12)
    found, rest = list[ForceLimit](), list[str]()
    elements = [
        (f"the force of {model.actuator(i).name}", "N", model.actuator_forcerange, i, i)
        for i in np.flatnonzero(model.actuator_forcelimited).tolist()
    ] + [
        (
            f"the force on {model.joint(i).name}", "N m" if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE else "N",
            model.jnt_actfrcrange, i, len(data.actuator_force) + int(model.jnt_dofadr[i]),
        )
        for i in np.flatnonzero(model.jnt_actfrclimited).tolist()
    ]  # fmt: skip
    for name, unit, limits, i, place in elements:
        if linear[place]:
            found.append(ForceLimit(name, unit, *limits[i].tolist(), slopes[:, place].copy()))
        else:
            rest.append(name)
    return found, free, rest


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

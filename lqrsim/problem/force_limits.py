"""Limits of MuJoCo's forces as constraints of a plan: classes and kernel.

MuJoCo clips forces. Past a limit, a control has no effect, and a solver cannot tell how to come back: a servo with a
stiffness of 4,500 N m/rad and 87 N m is past it at 0.02 rad from its target. So plans are made with dynamics without
these limits and with the limits as constraints, where forces are linear in the state and the control. Such a plan
never clips, and both models are the same along it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError
from lqrsim.kernels.declarations import M, N, W
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.mjcf_dynamics import MjcfDynamics
from lqrsim.problem.parts import Constraint, ConstraintTerm
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.mjcf_holding import without_limits
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mujoco_log import mujoco, unlogged

# Fraction of its range that a plan keeps a force from its limits: MuJoCo's implicit integrators step differently where
# a force is clipped, by however little.
SPARED = 1e-3
_PROBES, _LINEAR = 4, 1e-9  # random states at which a force is compared with its slopes, and the relative error


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

    @property
    def range(self) -> float:
        """Its range; if one limit is nominal, such as -1e6 N, twice the other; infinite for a side of 0 alone."""
        return min([self.high - self.low, *(2 * abs(side) for side in (self.low, self.high) if side)])

    @property
    def spared(self) -> float:
        """How far a plan keeps it from its limits."""
        return SPARED * (self.range if np.isfinite(self.range) else 1.0)  # nothing tells how large such a force is

    def can_be_kept(self, state: Array, low: Array, high: Array) -> bool:
        """Whether some control (m,) between `low` and `high` keeps it in a state (n,)."""
        n = len(state)
        slopes = self.slopes[1 + n :]
        moved = slopes != 0
        ends = np.stack([slopes[moved] * side[moved] for side in (low, high)])
        force = self.slopes[0] + self.slopes[1 : 1 + n] @ state
        return bool(force + ends.min(axis=0).sum() <= self.high and force + ends.max(axis=0).sum() >= self.low)


class ForceLimits(Constraint):
    """The forces of actuators and joints within their limits, at each physics step of each control period.

    A stiff servo's force changes its sign within a period. The state at a physics step is predicted by derivatives:
    those at the start, and if a force of the plan is beyond its limit, `smooth` solves again with those along the plan.

    `MjcfRobot.force_limits` makes it, for problems with `MjcfRobot.unlimited` as their dynamics. Limits of actuators
    whose forces are not linear, such as those of muscles, stay in the dynamics.

    Attributes:
      later: (K, S L, 1+n+m) the forces at the S later physics steps, of each of K periods or of all: each force's value
        at zero, and its slopes in state and control; None for the beginning of a period alone.
    """

    _same_with_added_state = True

    def __init__(self, limits: Sequence[ForceLimit], later: Array | None = None) -> None:
        self.limits, self.later = tuple(limits), later
        self._slopes = np.stack([limit.slopes for limit in self.limits])
        # Less than what is spared, so that forces of such a plan are within their limits.
        self._rough = 0.5 * min(limit.spared for limit in self.limits)

    def removed_from(self, dynamics: MjcfDynamics) -> MjcfDynamics:
        """Dynamics without these limits."""
        ids = [tuple(limit.id for limit in self.limits if limit.of_joint is joint) for joint in (False, True)]
        return dynamics.with_physics(unlimited=tuple(ids))

    def within(self, dynamics: MjcfDynamics, state: Array, control: Array, dt: float) -> "ForceLimits":
        """These limits at all physics steps of each period, predicted by the derivatives at a state."""
        later = self._at_later_steps(dynamics, state, control, round(dt / dynamics.period))
        return ForceLimits(self.limits, later[None])

    def _at_later_steps(self, dynamics: MjcfDynamics, x: Array, u: Array, count: int) -> Array:
        """The forces ((count-1) L, 1+n+m) at the physics steps of a period but the first, by its state and control."""
        state, a, b = x, np.eye(len(x)), np.zeros((len(x), len(u)))
        by_state, by_control = np.split(self._slopes[:, 1:], [len(x)], axis=1)
        forces = [np.zeros((0, 1 + len(x) + len(u)))]
        for _ in range(1, count):
            A, B, c = dynamics.linearize(state, u, dynamics.period)
            state, a, b = A @ state + B @ u + c, A @ a, A @ b + B
            at_zero = self._slopes[:, :1] + (by_state @ (state - a @ x - b @ u))[:, None]
            forces.append(np.hstack([at_zero, by_state @ a, by_state @ b + by_control]))
        return np.concatenate(forces)

    def _refined(self, dynamics: Dynamics, plan: Trajectory) -> "ForceLimits | None":
        mjcf_dynamics = dynamics.calling
        assert isinstance(mjcf_dynamics, MjcfDynamics)
        states, count = plan.states[:, : len(mjcf_dynamics.state_coordinates)], round(plan.dt / mjcf_dynamics.period)
        pairs = zip(states, plan.controls, strict=False)
        later = np.stack([self._at_later_steps(mjcf_dynamics, x, u, count) for x, u in pairs])
        forces = later[..., 0] + np.einsum("tki,ti->tk", later[..., 1:], np.hstack([states[:-1], plan.controls]))
        low, high = (np.tile([getattr(limit, side) for limit in self.limits], count - 1) for side in ("low", "high"))
        return ForceLimits(self.limits, later) if ((forces < low) | (forces > high)).any() else None

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        n, m = len(dynamics.calling.state_coordinates), len(dynamics.control_coordinates)
        added = len(dynamics.state_coordinates) - n  # further states, the last ones, which do not count
        for limit in self.limits:
            if len(limit.slopes) != 1 + n + m:
                got = f"forces of {len(limit.slopes) - 1} states and controls"
                raise InputError(f"ForceLimits: got {got}, want {n + m}, as the dynamics have")
        later = np.zeros((1, 0, 1 + n + m)) if self.later is None else self.later
        first = np.broadcast_to(self._slopes, (len(later), *self._slopes.shape))
        table = np.insert(np.concatenate([first, later], axis=1), [1 + n] * added, 0.0, axis=-1)
        limits, described = self.limits * (table.shape[1] // len(self.limits)), []
        for side, word in (("low", "at least"), ("high", "at most")):
            described += [f"the force {limit.name} of {word} {getattr(limit, side):g} {limit.unit}" for limit in limits]
        names = tuple(f"{limit.name} {side}" for side in ("low", "high") for limit in limits)
        low, high = (table.copy(), -table)
        low[..., 0] -= [limit.low + limit.spared for limit in limits]
        high[..., 0] += [limit.high - limit.spared for limit in limits]
        rows = np.concatenate([low, high], axis=1)
        return ConstraintTerm(
            source_of(__name__), np.concatenate([rows.shape[:2], rows.ravel()]), rows.shape[1], described.__getitem__,
            uses_control=True, convex=True, linear=True, yields=True, names=names,
            ranges=np.array([limit.range for limit in limits] * 2),
        )  # fmt: skip


def limited_forces(mjcf: MjcfModel) -> tuple[tuple[ForceLimit, ...], tuple[str, ...]]:
    """The limited forces of an MJCF that are linear, and the names of the others.

    A force is linear if its differences about zero predict it at random states.
    """
    model = without_limits(mjcf.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    data, nv, n = mujoco.MjData(model), model.nv, 2 * model.nv + model.na
    units = {joint.name: "N m" if joint.kind == "hinge" else "N" for joint in mjcf.joints}
    limited = [
        (f"of {actuator.name}", units.get(actuator.joint or "", "N"), actuator.forces, actuator.outputs.start, False, i)
        for i, actuator in enumerate(mjcf.actuators)
    ]
    limited += [
        (f"on {joint.name}", units[joint.name], joint.forces, model.nout + joint.dof, True, i)
        for i, joint in enumerate(mjcf.joints)
    ]
    limited = [force for force in limited if np.isfinite(force[2]).any()]
    if not limited:
        return (), ()

    def forces(z: Array) -> Array:
        """Of all actuators' outputs and on all joints, (nout+nv,)."""
        data.qpos[:], data.qvel[:] = mjcf.qpos_of(z[:nv]), z[nv : 2 * nv]
        data.act[:], data.ctrl[:] = z[2 * nv : n], z[n:]
        for part in (mujoco.mj_fwdPosition, mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation):
            part(model, data)
        return np.concatenate([data.actuator_force, data.qfrc_actuator])

    with unlogged():
        slopes = np.stack([(forces(axis) - forces(-axis)) / 2 for axis in np.eye(n + model.nu)])
        zero, linear = forces(np.zeros(n + model.nu)), np.ones(slopes.shape[1], dtype=bool)
        for z in np.random.default_rng(0).normal(size=(_PROBES, n + model.nu)):
            size = np.abs(zero) + np.abs(z) @ np.abs(slopes)
            linear &= np.abs(forces(z) - zero - z @ slopes) <= _LINEAR * size
    slopes = np.vstack([zero, slopes])
    limits = tuple(
        ForceLimit(name, unit, *sides, slopes[:, column].copy(), of_joint, number)
        for name, unit, sides, column, of_joint, number in limited
        if linear[column]
    )
    return limits, tuple(name for name, _, _, column, _, _ in limited if not linear[column])


# The kernel of ForceLimits. `data` has the numbers of steps and rows, and for each step and row its value at zero and
# its slopes.


def value(x, u, t, row, data):
    """The distance to a limit."""
    first = row_at(t, row, data)
    total = data[first]
    for i in range(N):
        total += data[first + 1 + i] * x[i]
    for i in range(M):
        total += data[first + 1 + N + i] * u[i]
    return total


def slope(x, u, t, row, data, gradient):
    """Add the gradient (W,) of the distance to a limit."""
    first = row_at(t, row, data)
    for i in range(W):
        gradient[i] += data[first + 1 + i]


def row_at(t, row, data):
    """The index at which the numbers of a row at a step begin."""
    return 2 + (min(t, int(data[0]) - 1) * int(data[1]) + row) * (1 + W)

"""Costs and constraints on sites of an MJCF, such as a gripper at a desired pose: classes and kernel."""

from math import atan2, sqrt
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import OneOf, checked
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, check_array, check_name, check_text, check_weight_vector
from lqrsim.kernels.declarations import N, at, call, int32, stack, store
from lqrsim.kernels.linear_algebra import clear
from lqrsim.kernels.mjcf_dynamics import (
    COMPOS,
    DATA,
    FLAGS,
    JAC,
    KINEMATICS,
    MODEL,
    NV,
    QPOS,
    SLOT,
    SLOTS,
    XMAT,
    XPOS,
    claim_slot,
    turn_to_states,
    write_positions,
)
from lqrsim.kernels.rotation_ratios import cotangent_ratio
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.problem.parts import STEPS, Constraint, ConstraintTerm, Cost, CostTerm, Residual
from lqrsim.scenes.mjcf_kinematics import axes_of, posed
from lqrsim.scenes.mujoco_log import mujoco, unlogged
from lqrsim.scenes.world import SPACE


class _OfSite:
    """A cost or a constraint on a site: on its position (3,), its orientation (4,), or both."""

    _same_with_added_state = True

    def _set_place(self, site: str, position: npt.ArrayLike | None, orientation: npt.ArrayLike | None) -> None:
        what = type(self).__name__
        self.site = check_text(f"{what}: site", site, "the name of a site", at_most=1000)
        if position is None and orientation is None:
            raise InputError(f"{what}: got neither position nor orientation, want at least one")
        self.position = None if position is None else check_array(f"{what}: position", position, (3,))
        self.orientation: Array | None = None
        if orientation is not None:
            self.orientation = check_array(f"{what}: orientation", orientation, (4,))
            if not np.linalg.norm(self.orientation) > 1e-9:
                raise InputError(f"{what}: orientation: got {self.orientation.tolist()}, want a nonzero (w, x, y, z)")

    def _errors(self, dynamics: Dynamics) -> Residual:
        """How far the site is off, as functions of the state. Raises InputError if the dynamics have no such site."""
        if not isinstance(mjcf_dynamics := dynamics.calling, MjcfDynamics):
            raise InputError(f"{type(self).__name__}: got {dynamics.name}, want the dynamics of an MjcfRobot")
        model, turn = mjcf_dynamics.physics.model, self.orientation
        names = [model.site(number).name for number in range(model.nsite)]
        field = f"{type(self).__name__}: site"
        number = names.index(check_name(field, self.site, [name for name in names if name]))
        rows = [f"{self.site} at its {axis}" for axis in SPACE if self.position is not None]
        rows += [f"{self.site} turned about {axis}" for axis in SPACE if turn is not None]
        position = np.zeros(3) if self.position is None else self.position
        wanted = np.eye(3) if turn is None else axes_of(turn / np.linalg.norm(turn))
        source = source_of(__name__, PLACED=int(self.position is not None), TURNED=int(turn is not None))
        axes = axes_of(model.site_quat[number]).ravel()
        data = np.concatenate([[model.site_bodyid[number]], model.site_pos[number], axes, position, wanted.ravel()])
        return Residual(source, data, tuple(rows), model.nv, functions=(MjcfMemory.of(mjcf_dynamics),))

    @unlogged()
    def off_place(self, dynamics: Dynamics, states: Array) -> dict[str, Array]:
        mjcf_dynamics = dynamics.calling
        assert isinstance(mjcf_dynamics, MjcfDynamics)
        model, places = mjcf_dynamics.physics.model, {self.site: self.position, f"{self.site} turned": self.orientation}
        site, finite = model.site(self.site).id, np.isfinite(states).all(axis=1)
        errors = {name: np.full(len(states), np.nan) for name, place in places.items() if place is not None}
        positions, quaternion, turn = mjcf_dynamics.mjcf.qpos_of(states[finite, : model.nv]), np.zeros(4), np.zeros(3)
        for k, data in zip(np.flatnonzero(finite), posed(model, positions), strict=True):
            if self.position is not None:
                errors[self.site][k] = np.linalg.norm(data.site_xpos[site] - self.position)
            if self.orientation is not None:
                mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
                mujoco.mju_subQuat(turn, quaternion, self.orientation / np.linalg.norm(self.orientation))
                errors[f"{self.site} turned"][k] = np.linalg.norm(turn)
        return errors


class SiteCost(_OfSite, Cost):
    """`1/2 weight |p - position|^2 + 1/2 turn_weight |r|^2` of a site of a robot from an MJCF.

    p is the position of the site, and r the rotation vector from the desired orientation to the site's.

        ls.SiteCost("gripper", position=(0.4, 0.2, 0.3), orientation=(0, 1, 0, 0), weight=1e4, turn_weight=1e3)

    As a stage cost it acts at each step; as a final cost, at the end.

    Args:
      position: (3,) the desired position in the world, in metres; None for any.
      orientation: (4,) the desired orientation in the world, as a quaternion (w, x, y, z); None for any. |r| is the
        angle of the rotation, less than half a turn.
      weight: weight of the position error: one number, or one per world axis, (3,).
      turn_weight: weight of the orientation error: one number, or one per axis of the desired orientation, (3,).
    """

    def __init__(
        self,
        site: str,
        *,
        position: npt.ArrayLike | None = None,
        orientation: npt.ArrayLike | None = None,
        weight: npt.ArrayLike = 1.0,
        turn_weight: npt.ArrayLike = 1.0,
    ) -> None:
        self._set_place(site, position, orientation)
        self.weights = tuple(
            check_weight_vector(f"SiteCost: {name}", values, 3)
            for name, values in (("weight", weight), ("turn_weight", turn_weight))
        )

    def bind(self, dynamics: Dynamics) -> CostTerm:
        errors, places = self._errors(dynamics), (self.position, self.orientation)
        used = [weights for weights, place in zip(self.weights, places, strict=True) if place is not None]
        return CostTerm.of_residual(errors, source_of(__name__, AT=errors.numbers), np.concatenate(used))


class SiteConstraint(_OfSite, Constraint):
    """A site of a robot from an MJCF has exactly a desired position, or a desired orientation, or both.

        ls.SiteConstraint("gripper", position=(0.4, 0.2, 0.3), orientation=(0, 1, 0, 0))

    Args:
      position: (3,) as in a SiteCost.
      orientation: (4,) as in a SiteCost.
      at: "final", or "all" steps except a start that is given exactly.
    """

    @checked
    def __init__(
        self,
        site: str,
        *,
        position: npt.ArrayLike | None = None,
        orientation: npt.ArrayLike | None = None,
        at: Annotated[str, OneOf(STEPS)] = "final",
    ) -> None:
        self._set_place(site, position, orientation)
        self.at = at

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        errors = self._errors(dynamics)
        return ConstraintTerm.of_residual(
            errors, np.zeros((1, 1)), [0] * errors.rows, errors.parts.__getitem__, equality=True,
            final_only=self.at == "final",
        )  # fmt: skip


# The kernel: the errors of position and orientation. `data` has the address of the numbers p of an `MjcfPhysics`; the
# site's body; its position and axes (3 x 3) in the body's axes; and the desired position and axes. For a cost, from AT
# on, it has a weight for each row. The rows are three for the position, in world axes; or three for the rotation vector
# from the desired axes to the site's, in the desired axes; or both.
AT = 0
PLACED = 1  # whether there are rows of the position
TURNED = 1  # whether there are rows of the orientation
BODY, OFFSET, AXES, WANTED, WANTED_AXES = 1, 2, 5, 14, 17  # layout of data


def residual(x, data, out):
    """Write the errors, a row each."""
    p = at(data[0])
    slot = claim_slot(p)
    arrays, point = at(p[SLOTS] + 8 * SLOT * slot), stack(3)
    write_positions(x, p, at(arrays[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(arrays[DATA]))
    write_errors(arrays, data, out, point)
    store(p[FLAGS], slot, 0)


def residual_jacobian(x, data, out, slopes):
    """Write the errors, and their derivatives in the states (rows, N), which are zero on entry."""
    p = at(data[0])
    slot, nv, body = claim_slot(p), int(p[NV]), int(data[BODY])
    arrays, point, moves, turns = at(p[SLOTS] + 8 * SLOT * slot), stack(3), stack(3 * N), stack(3 * N)
    write_positions(x, p, at(arrays[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(arrays[DATA]))
    call(p[COMPOS], at(p[MODEL]), at(arrays[DATA]))
    write_errors(arrays, data, out, point)
    call(p[JAC], at(p[MODEL]), at(arrays[DATA]), moves, turns, point, int32(body))
    if PLACED:
        for i in range(3):
            for j in range(nv):
                slopes[i, j] = moves[nv * i + j]
    if TURNED:
        inverse, first = stack(3, 3), 3 * PLACED
        write_inverse(out, first, inverse)
        for j in range(nv):
            for i in range(3):
                total = 0.0
                for k in range(3):
                    for m in range(3):
                        total += inverse[i, k] * data[WANTED_AXES + 3 * m + k] * turns[nv * m + j]
                slopes[first + i, j] = total
    for row in range(3 * PLACED + 3 * TURNED):
        turn_to_states(x, p, slopes[row])
    store(p[FLAGS], slot, 0)


def write_errors(arrays, data, out, point):
    """Write the errors, and the position of the site as `point`, after MuJoCo's kinematics."""
    body = int(data[BODY])
    origins, axes = at(arrays[XPOS]), at(arrays[XMAT])
    for i in range(3):
        point[i] = origins[3 * body + i]
        for j in range(3):
            point[i] += axes[9 * body + 3 * i + j] * data[OFFSET + j]
        if PLACED:
            out[i] = point[i] - data[WANTED + i]
    if TURNED:
        site_axes, turned, first = stack(3, 3), stack(3, 3), 3 * PLACED
        clear(site_axes, 3, 3)
        clear(turned, 3, 3)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    site_axes[i, j] += axes[9 * body + 3 * i + k] * data[AXES + 3 * k + j]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    turned[i, j] += data[WANTED_AXES + 3 * k + i] * site_axes[k, j]
        out[first] = 0.5 * (turned[2, 1] - turned[1, 2])
        out[first + 1] = 0.5 * (turned[0, 2] - turned[2, 0])
        out[first + 2] = 0.5 * (turned[1, 0] - turned[0, 1])
        square = 0.0
        for i in range(3):
            square += out[first + i] * out[first + i]
        sine, cosine = sqrt(square), 0.5 * (turned[0, 0] + turned[1, 1] + turned[2, 2] - 1)
        ratio = atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
        for i in range(3):
            out[first + i] *= ratio


def write_inverse(out, first, inverse):
    """Write the matrix from an angular velocity in the desired axes to the rate of the rotation vector."""
    a, b, c = out[first], out[first + 1], out[first + 2]
    square = a * a + b * b + c * c
    ratio = cotangent_ratio(square)
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = (
        1 + ratio * (a * a - square),
        1 + ratio * (b * b - square),
        1 + ratio * (c * c - square),
    )
    inverse[0, 1], inverse[1, 0] = ratio * a * b + 0.5 * c, ratio * a * b - 0.5 * c
    inverse[0, 2], inverse[2, 0] = ratio * a * c - 0.5 * b, ratio * a * c + 0.5 * b
    inverse[1, 2], inverse[2, 1] = ratio * b * c + 0.5 * a, ratio * b * c - 0.5 * a


def loss(error, row, data):
    """`1/2 weight error^2`, and its first two derivatives."""
    weight = data[AT + row]
    return 0.5 * weight * error * error, weight * error, weight

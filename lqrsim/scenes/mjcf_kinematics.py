"""Places of bodies of an MJCF, how joints move them, and positions of joints at which kinematic loops close."""

import copy
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.scenes.mujoco_log import mujoco, unlogged

_MET, _NEWTON = 1e-10, 30  # m or rad by which an equality may be off, and steps to it at most
_MET_AS_GIVEN = 1e-6  # m or rad by which it may be off if all its joints are given, as by rounding
_RANK = 1e-9  # relative size of singular values that count as zero
_STRIDE = 0.05  # m or rad, of joints that others follow


def placed(model: mujoco.MjModel, qpos: Array | None = None) -> mujoco.MjData:
    """MuJoCo's data with the places of all bodies at positions (nq,), by default at rest."""
    return next(posed(model, [model.qpos0 if qpos is None else qpos]))


def posed(
    model: mujoco.MjModel,
    positions: Iterable[Array],
    place: Callable[[mujoco.MjModel, mujoco.MjData], None] = mujoco.mj_kinematics,
) -> Iterator[mujoco.MjData]:
    """MuJoCo's data with the places of all bodies at each of these positions (nq,): one object, which changes."""
    data = mujoco.MjData(model)
    for qpos in positions:
        data.qpos[:] = qpos
        place(model, data)
        yield data


def driven_trees(model: mujoco.MjModel, body: int) -> set[int]:
    """The kinematic trees that actuators move, and the tree of a body."""
    data = next(posed(model, [model.qpos0], mujoco.mj_fwdPosition))
    dofs = data.moment_colind[: data.moment_rownnz.sum()]  # the rest is unused, as of an adhesion that touches nothing
    return {int(model.body_treeid[body]), *model.dof_treeid[dofs].tolist()}


@unlogged()
def contacts_of(model: mujoco.MjModel, qpos: Array) -> list[tuple[str, str]]:
    """The names of the bodies that touch, each pair once."""
    data = placed(model, qpos)
    mujoco.mj_collision(model, data)
    bodies = model.geom_bodyid[data.contact.geom] if data.ncon else np.zeros((0, 2), dtype=np.intp)
    pairs = dict.fromkeys(map(tuple, bodies.tolist()))
    return [(model.body(first).name, model.body(second).name) for first, second in pairs]


def colliding(model: mujoco.MjModel) -> npt.NDArray[np.bool_]:
    """Flags (ngeom,) of the geoms that can collide, by contype or conaffinity."""
    return (model.geom_contype != 0) | (model.geom_conaffinity != 0)


def leaders_of(model: mujoco.MjModel) -> npt.NDArray[np.bool_]:
    """Which degrees of freedom (nv,) are those of joints that others follow by an equality, and that follow none."""
    joints = np.flatnonzero(model.eq_active0 & (model.eq_type == mujoco.mjtEq.mjEQ_JOINT.value))
    leads, follows = np.zeros(model.nv, dtype=bool), np.zeros(model.nv, dtype=bool)
    follows[model.jnt_dofadr[model.eq_obj1id[joints]]] = True
    others = model.eq_obj2id[joints]
    leads[model.jnt_dofadr[others[others >= 0]]] = True
    return leads & ~follows


class Equalities:
    """All active equality constraints of a model, at given positions."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        self._data = mujoco.MjData(self.model)

    @unlogged()
    def at(self, qpos: Array) -> tuple[Array, Array]:
        """How far they are off at positions (nq,), (k,) in m or rad, and the derivatives by the velocities, (k, nv)."""
        data = self._data
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self.model, data)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return data.efc_pos[rows].copy(), data.efc_J.reshape(-1, self.model.nv)[rows].copy()

    def met(self, qpos: Array, aim: Array, fixed: npt.NDArray[np.bool_]) -> Array | None:
        """Positions (nq,) nearest to qpos at which they are met; None if none were found.

        The fixed degrees of freedom, (nv,), go to `aim`; others follow in small steps, so that no loop flips over.
        """
        positions, move, model = qpos.copy(), np.zeros(self.model.nv), self.model
        mujoco.mj_differentiatePos(model, move, 1.0, qpos, aim)
        move[~fixed] = 0.0
        steps = max(1, int(np.ceil(np.abs(move).max(initial=0.0) / _STRIDE)))
        residual = np.zeros(0)
        for _ in range(steps):
            mujoco.mj_integratePos(model, positions, move / steps, 1.0)
            for _ in range(_NEWTON):
                residual, slopes = self.at(positions)
                within_reach = slopes[:, ~fixed].any(axis=1)  # others need to be met at the aim only
                if np.abs(residual[within_reach]).max(initial=0.0) < _MET:
                    break
                step = np.zeros(model.nv)
                step[~fixed] = -np.linalg.lstsq(slopes[:, ~fixed], residual, rcond=_RANK)[0]
                mujoco.mj_integratePos(model, positions, step, 1.0)
                if np.abs(step).max() < _MET:  # as near as it gets on the way: only the aim is to be consistent
                    break
            else:
                return None
        return positions if np.abs(residual).max(initial=0.0) < _MET_AS_GIVEN else None

    def closed(self, qpos: Array, qvel: Array) -> tuple[Array, Array] | None:
        """Positions (nq,) and velocities (nv,) near those given at which they are met; None if none were found."""
        positions = self.met(qpos, qpos, np.zeros(self.model.nv, dtype=bool))
        if positions is None:
            return None
        _, slopes = self.at(positions)
        return positions, qvel - np.linalg.lstsq(slopes, slopes @ qvel, rcond=_RANK)[0]


def in_axes_of_bodies(model: mujoco.MjModel, geoms: npt.NDArray[np.int64], vectors: Array) -> Array:
    """Vectors (..., k, 3) along the world's axes, each in the axes of the body of its geom (k,), at rest."""
    axes = placed(model).xmat[model.geom_bodyid[geoms]].reshape(-1, 3, 3)
    # By elements, so that the bits of one do not depend on how many others there are.
    x, y, z = (vectors[..., i, None] * axes[:, i] for i in range(3))
    return x + y + z


def axes_of(quaternion: Array) -> Array:
    """The rotation matrix (3, 3) of a quaternion (4,) of length 1."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)


def quaternion_of(rotation: Array) -> Array:
    """The quaternion (4,) of a rotation (3, 3) or (9,), scalar first; of a reflection, with the x axis turned back.

    The shapes of obstacles but meshes are their own mirror images, so that their axes may be left-handed.
    """
    axes, quaternion = np.reshape(rotation, (3, 3)), np.empty(4)
    if np.linalg.det(axes) < 0:
        axes = axes * [-1.0, 1.0, 1.0]
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(axes).ravel())
    return quaternion


def farthest_out(model: mujoco.MjModel, body: int) -> tuple[int, Array, float]:
    """The body of a tree's geom that is farthest out at rest, the geom's place (3,) on it and bounding radius in m."""
    data = placed(model)
    moves = (model.body_rootid[model.geom_bodyid] == model.body_rootid[body]) & (model.geom_rbound > 0)
    geoms = np.flatnonzero(moves & (model.body_weldid[model.geom_bodyid] != 0))
    if not len(geoms):
        return body, np.zeros(3), 0.0
    geom = int(geoms[np.argmax(np.linalg.norm(data.geom_xpos[geoms] - data.xpos[body], axis=1))])
    return int(model.geom_bodyid[geom]), model.geom_pos[geom].copy(), float(model.geom_rbound[geom])


def reach_of(model: mujoco.MjModel, body: int) -> float:
    """How far the colliding geoms, else all geoms, of a body and of what it carries reach from its origin, in m."""
    collides = colliding(model) & (model.body_rootid[model.geom_bodyid] == model.body_rootid[body])
    turning = model.jnt_type != mujoco.mjtJoint.mjJNT_SLIDE.value
    reach = 0.0
    for geom in np.flatnonzero(collides).tolist() if collides.any() else range(model.ngeom):
        if (path := path_to(model, geom, body)) is not None:
            place, lengths = model.geom_pos[geom], list[float]()
            for link in path:  # a turn keeps the distance from its anchor
                anchors = model.jnt_pos[turning & (model.jnt_bodyid == link)]
                for anchor in anchors[::-1] if len(anchors) else np.zeros((1, 3)):
                    lengths.append(float(np.linalg.norm(place - anchor)))
                    place = anchor
                place = model.body_pos[link] + axes_of(model.body_quat[link]) @ place
            reach = max(reach, float(model.geom_rbound[geom]) + sum([*lengths, float(np.linalg.norm(place))]))
    return reach


def path_to(model: mujoco.MjModel, geom: int, body: int) -> list[int] | None:
    """The bodies from a geom's own up to `body`, without it; None if that one does not carry the geom."""
    path = list(carriers(model, int(model.geom_bodyid[geom])))
    return path[: path.index(body)] if body in path else None


def carriers(model: mujoco.MjModel, body: int) -> Iterator[int]:
    """A body, and those that carry it, up to the world, without it."""
    while body:
        yield body
        body = int(model.body_parentid[body])

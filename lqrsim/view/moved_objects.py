"""The objects that a run moved, such as a box that was pushed, for figures."""

from typing import NamedTuple

import mujoco
import numpy as np

from lqrsim.errors import Array
from lqrsim.results.rollout import Rollout
from lqrsim.scenes.mjcf_kinematics import placed
from lqrsim.scenes.world import Obstacle
from lqrsim.view.recorded_trial import SHOWN_GROUPS, model_of, robot_body

MOVED = 0.01  # way of an object that counts as moved, relative to the extent of the robot's
SHAPES = "sphere", "capsule", "cylinder", "box"  # other geoms are drawn as their bounding boxes


class MovedObject(NamedTuple):
    """A body that is not driven: its centre of mass (F, 3) in each frame, and its geoms in the first and the last."""

    name: str
    path: Array
    first: list[Obstacle]
    last: list[Obstacle]

    @property
    def places(self) -> Array:
        """Its path, and corners (k, 3) around its geoms."""
        around = [one.position + side * one.size.max() for one in (*self.first, *self.last) for side in (-1, 1)]
        return np.vstack([self.path, *around])


def moved_objects(rollout: Rollout, trial: int) -> list[MovedObject]:
    """The objects that moved in this trial: kinematic trees that are not the robot's, and that no actuator moves.

    Raises:
      InputError: the rollout's model cannot be compiled, or lacks a part that was recorded.
    """
    frames = rollout.frames[trial]
    frames = frames[np.isfinite(frames).all(axis=1)]
    if len(frames) < 2:
        return []
    model = model_of(rollout, trial)
    data = placed(model)
    mujoco.mj_fwdPosition(model, data)  # which also finds what actuators move
    driven = {int(model.body_treeid[robot_body(model, rollout.body)]), *model.dof_treeid[data.moment_colind].tolist()}
    objects = [(tree, int(model.tree_bodyadr[tree])) for tree in range(model.ntree) if tree not in driven]
    path, geoms = np.zeros((len(frames), model.nbody, 3)), list[list[list[Obstacle]]]()
    for number, frame in enumerate(frames):
        data.qpos[:] = frame
        mujoco.mj_kinematics(model, data)
        path[number] = data.xipos
        if number in (0, len(frames) - 1):
            geoms.append([_geoms(model, data, tree) for tree, _ in objects])
    least = MOVED * float(np.ptp(np.vstack([rollout.planned_places, rollout.places(trial)]), axis=0).max())
    return [
        MovedObject(model.body(body).name or f"body {body}", path[:, body], first, last)
        for (_, body), first, last in zip(objects, *geoms, strict=True)
        if np.linalg.norm(path[:, body] - path[0, body], axis=1).max() > least
    ]


def _geoms(model: mujoco.MjModel, data: mujoco.MjData, tree: int) -> list[Obstacle]:
    """The visible geoms of a kinematic tree, in the pose of the data."""
    seen = (model.body_treeid[model.geom_bodyid] == tree) & (model.geom_group < SHOWN_GROUPS)
    found = list[Obstacle]()
    for geom in np.flatnonzero(seen).tolist():
        kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
        axes, place, size = (
            data.geom_xmat[geom].reshape(3, 3).copy(),
            data.geom_xpos[geom].copy(),
            model.geom_size[geom],
        )
        if kind not in SHAPES:
            kind, size, place = "box", model.geom_aabb[geom, 3:], place + axes @ model.geom_aabb[geom, :3]
        found.append(Obstacle(f"geom {geom}", kind, place, axes, np.array(size)))
    return found

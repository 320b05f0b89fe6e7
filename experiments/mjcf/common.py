"""What scripts about MJCFs share: measures by MuJoCo's bindings alone, plans without dry friction, sheets."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.mjcf_dynamics import MjcfDynamics

TILE = 400, 225  # pixels of a picture on a sheet


def least_distance(robot: ls.MjcfRobot, states: Array) -> float:
    """From what moves and collides to the obstacles of the scene, in m, by `mujoco.mj_geomDistance`."""
    model, least = robot.scene.model, np.inf
    data = mujoco.MjData(model)
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    moving = np.flatnonzero(collides & (model.body_weldid[model.geom_bodyid] != 0)).tolist()
    for state in states:
        data.qpos[:] = robot.configuration(state)[0]
        mujoco.mj_kinematics(model, data)
        for obstacle in robot.scene.geoms:
            for geom in moving:
                least = min(least, mujoco.mj_geomDistance(model, data, geom, obstacle, 10.0, None))
    return float(least)


def pose(robot: ls.MjcfRobot, state: Array, site: str) -> tuple[Array, Array]:
    """Place of a site, (3,) in m, and its quaternion, (4,)."""
    data, turn = mujoco.MjData(robot.scene.model), np.zeros(4)
    data.qpos[:] = robot.configuration(state)[0]
    mujoco.mj_kinematics(robot.scene.model, data)
    mujoco.mju_mat2Quat(turn, data.site(site).xmat)
    return data.site(site).xpos.copy(), turn


def pose_error(robot: ls.MjcfRobot, state: Array, site: str, goal: Sequence[Sequence[float] | Array]) -> list[float]:
    """How far a site is from a place and a quaternion, in m and rad."""
    (place, turn), (wanted_place, wanted_turn) = pose(robot, state, site), goal
    angle = 2 * np.arccos(min(1.0, abs(float(turn @ np.asarray(wanted_turn)))))
    return [float(np.linalg.norm(place - wanted_place)), float(angle)]


def without_friction(problem: ls.Problem) -> ls.Problem:
    """The same without dry friction in any joint."""
    dynamics = problem.dynamics
    assert isinstance(dynamics, MjcfDynamics)
    losses = {name: 0.0 for name in dynamics.numbers if name.endswith("_frictionloss")}
    return replace(problem, dynamics=dynamics.with_parameters(**losses))


def sheet(pictures: Sequence[Path], to: Path, across: int = 3) -> None:
    """One picture of all, so many beside each other."""
    whole = Image.new("RGB", (across * TILE[0], -(-len(pictures) // across) * TILE[1]), "white")
    for number, path in enumerate(pictures):
        tile = Image.open(path).convert("RGB").resize(TILE, Image.Resampling.LANCZOS)
        whole.paste(tile, (number % across * TILE[0], number // across * TILE[1]))
    whole.save(to, optimize=True)

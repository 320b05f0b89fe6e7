"""What a rollout recorded for drawing: its model, the robot in it, and what that stands on."""

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError, check_count, check_kind
from lqrsim.results.rollout import BallRecord, Rollout
from lqrsim.scenes.scene import model_from_xml


def model_of(rollout: Rollout, trial: int) -> mujoco.MjModel:
    """The model that was run, anew. Raises InputError unless there is such a trial of it, of a robot with a place."""
    check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
    if not 0 <= check_count("trial", trial, at_least=0) < rollout.trials:
        raise InputError(f"trial: got {trial}, want one of 0 to {rollout.trials - 1}")
    if not rollout.plane:
        wanted = "the 2 or 3 states that are the position, or a run of a robot with balls that has frames"
        raise InputError(f"state_coordinates.position: got none, want {wanted}")
    if rollout.balls is not None and not rollout.state_coordinates.position:
        _ = rollout.balls.tracked  # which says what is missing
    model = model_from_xml(rollout.model, "rollout.model")
    robot_body(model, rollout.body)
    if rollout.balls is not None and (rollout.balls.anchors[:, 0] >= model.nbody).any():
        raise InputError(f"rollout.balls.anchors: got bodies beyond the model's {model.nbody}, want its own")
    if model.nq != rollout.frames.shape[-1]:
        raise InputError(f"rollout.frames: got {rollout.frames.shape[-1]} numbers each, want the model's {model.nq}")
    return model


def robot_body(model: mujoco.MjModel, name: str) -> int:
    """The number of the body that is the robot. Raises InputError unless the model has one of that name."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) if isinstance(name, str) else -1
    if number < 0:
        raise InputError(f"rollout.body: got {name!r}, want a body of its model")
    return number


def place_in(data: mujoco.MjData, rollout: Rollout, robot: int) -> Array:
    """Where the robot of that body is (3,): its origin, or, without a position, its last ball."""
    return place_of(data, robot, None if rollout.state_coordinates.position else rollout.balls)


def place_of(data: mujoco.MjData, robot: int, balls: BallRecord | None) -> Array:
    """The origin of that body (3,), or where the last of the balls is, by the site that it names."""
    if balls is None:
        return data.xpos[robot]
    body, place = balls.tracked
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ place


def floor_below(model: mujoco.MjModel, data: mujoco.MjData, robot: int) -> float:
    """The height of what is below that body, in metres; its own where there is nothing."""
    centre, drop = data.xpos[robot], np.array([0.0, 0.0, -1.0])
    hit = mujoco.mj_ray(model, data, centre, drop, None, True, robot, np.zeros(1, np.int32))
    return float(centre[2] - max(hit, 0.0))

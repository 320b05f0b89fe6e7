"""One trial of a rollout as pictures need it: the model at any moment, and where the robot is and should be."""

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError, check_count, check_kind
from lqrsim.results.rollout import BallRecord, Rollout
from lqrsim.scenes.scene import model_from_xml

FORCE_WINDOW = (
    0.2  # seconds for which a push is shown: one control period would be gone before it is seen, and noise flickers
)


class RecordedTrial:
    """A trial; where it diverged, it ends with its last finite state and stands still.

    Attributes:
      model: to draw. robot: the body of the model that is the robot.
      planar: whether it is seen from above, and what is drawn of it lies on the floor.
      floor: height of what it stands on in the first frame, in metres.
      end: seconds from the first state to the last one of the plan.
      times: (k,) of the finite states; states, measured: (k, n); error, clearance: (k,) in metres.
      force: (T, 3) in N, averaged over a moment.
    """

    def __init__(self, rollout: Rollout, trial: int) -> None:
        """Raises InputError: there is no such trial, or nothing of it that could be drawn."""
        self.rollout, self.trial = rollout, trial
        self.model = model_of(rollout, trial)
        whole = np.isfinite(rollout.frames[trial]).all(axis=1)
        alive = np.isfinite(rollout.states[trial]).all(axis=1)
        if not (whole.any() and alive.any()):
            raise InputError(f"rollout: got trial {trial} without one finite state, want something to draw")
        self.frame_times, self.frames = rollout.frame_times[whole], rollout.frames[trial][whole]
        self.times, self.states = rollout.times[alive], rollout.states[trial, alive]
        self.measured = rollout.measured[trial, alive]
        self.error, self.clearance = rollout.tracking_error[trial, alive], rollout.clearance[trial, alive]
        self.force = _recent_mean(rollout.forces[trial], rollout.plan.dt)
        self.end = float(rollout.times[-1])
        self.planar = rollout.state_coordinates.from_above
        self.robot = robot_body(self.model, rollout.body)
        data = mujoco.MjData(self.model)
        self.pose(data, 0.0)
        self.floor = floor_below(self.model, data, self.robot)

    def pose(self, data: mujoco.MjData, time: float) -> None:
        """Puts the model where it was at `time`, between two recorded frames if need be."""
        first = int(np.clip(np.searchsorted(self.frame_times, time, side="right") - 1, 0, max(len(self.frames) - 2, 0)))
        data.qpos[:] = self.frames[first]
        if len(self.frames) > 1:
            start, end = self.frame_times[first : first + 2]
            motion = np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, motion, 1.0, self.frames[first], self.frames[first + 1])
            mujoco.mj_integratePos(self.model, data.qpos, motion, float(np.clip((time - start) / (end - start), 0, 1)))
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def driven(self, at: Array | float) -> Array:
        """Where the robot was at these times, (..., 3); on the floor, if it is seen from above."""
        alive = np.isin(self.rollout.times, self.times)
        return self._between(self.rollout.places(self.trial)[alive], self.times, at)

    def planned(self, at: Array | float) -> Array:
        """Where it was meant to be, (..., 3)."""
        return self._between(self.rollout.planned_places, self.rollout.times, at)

    def shown(self) -> Array:
        """The positions (k, 3) that the controller was shown; none of a robot without a position."""
        places = self.measured[:, list(self.rollout.state_coordinates.position)]
        return self._between(places, self.times, self.times) if places.size else np.zeros((0, 3))

    def planned_balls(self, time: float) -> tuple[Array, Array]:
        """Where the robot's balls were meant to be (B, 3), and their radii (B,); the one that it is, without any."""
        run = self.rollout
        if run.balls is None:
            return self.planned(time)[None], np.array([run.radius])
        planned = run.balls.planned
        flat = self._interpolated(planned.reshape(len(planned), -1), run.times, time)
        return flat.reshape(-1, 3), run.balls.radii

    def _between(self, places: Array, times: Array, at: Array | float) -> Array:
        """Points (..., 3) in the world of places (k, 2 or 3) at `times`, at other times."""
        return self.rollout.in_world(self._interpolated(places, times, at), height=self.floor)

    @staticmethod
    def _interpolated(values: Array, times: Array, at: Array | float) -> Array:
        return np.stack([np.interp(at, times, column) for column in values.T], axis=-1)

    def place_in(self, data: mujoco.MjData) -> Array:
        """Where the robot is (3,) in the model as it is posed."""
        return place_in(data, self.rollout, self.robot)

    def force_at(self, time: float) -> Array:
        """The force (3,) in N that has disturbed the robot lately."""
        return self.force[min(self.step(time), len(self.force) - 1)]

    def step(self, time: float) -> int:
        """The control period in which a time is; at the end of the plan, how many there are."""
        return min(int(time / self.rollout.plan.dt + 1e-9), self.rollout.plan.steps)

    def interpolate(self, values: Array, time: float) -> float:
        """One of `error` and `clearance` at a time."""
        return float(np.interp(time, self.times, values))

    def ending(self, time: float) -> str:
        """What had ended the trial by then, in words; empty if nothing had."""
        run, k = self.rollout, self.trial
        if run.outcome[k] not in ("collided", "diverged", "error") or time < run.ended[k]:
            return ""
        return f"collided with {run.obstacles[k]}" if run.collided[k] else run.outcome[k]


def _recent_mean(forces: Array, dt: float) -> Array:
    """Mean forces (T, 3) over the moment before each period's end."""
    window = max(round(FORCE_WINDOW / dt), 1)
    total = np.cumsum(np.vstack([np.zeros((window, 3)), np.nan_to_num(forces)]), axis=0)
    return (total[window:] - total[:-window]) / window


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

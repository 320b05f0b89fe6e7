"""The common part of the viewers: a moving model with its plan and trace, and interaction by a person."""

import abc
import copy
import time as clock
from typing import Self

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.rollout import BallRecord
from lqrsim.results.solution_parts import Trajectory
from lqrsim.view import geoms
from lqrsim.view.overlays import Line, MovingBody, rgba_of
from lqrsim.view.recorded_trial import floor_below, place_of, robot_body

GHOST_OPACITY = 0.25
TRACE_RGBA = (0.05, 0.35, 0.62, 1.0)
SEGMENTS = 60  # number of segments of the plan; the trace has twice as many
LIFT = 0.008  # m, height of lines above the floor
STRONGEST_DRAG = 2.0  # largest force of a drag, relative to the robot's weight
GOAL_STEP = 0.1  # m, step of the goal for each key press
MOST_DELAY = 0.2  # s, largest delay that is caught up on a slow machine
# The direction of each key, seen from the camera: right, away, up.
PUSHES = {
    "LeftArrow": (-1.0, 0.0, 0.0),
    "RightArrow": (1.0, 0.0, 0.0),
    "UpArrow": (0.0, 1.0, 0.0),
    "DownArrow": (0.0, -1.0, 0.0),
    "PageUp": (0.0, 0.0, 1.0),
    "PageDown": (0.0, 0.0, -1.0),
}


class ViewerClosed(Exception):
    """The viewer was closed, or its time is over."""


class RestartRequested(Exception):
    """The person asks for a restart."""


class Viewer(abc.ABC):
    """A viewer. Subclasses draw, and call `push`, `drag` and so on when the person interferes.

    Args:
      balls: with their planned positions, for a robot without a position.
      goal: name of the mocap body of a goal that can be moved; see `MovableGoal`.
      push: velocity that a key adds, in m/s.
      speed: of the time shown; 1 is real time.
      seconds: after which the viewer closes; never by default.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        plan: Trajectory,
        space: Coordinates,
        body: str,
        *,
        radius: float,
        balls: BallRecord | None = None,
        goal: str | None = None,
        push: float = 0.3,
        speed: float = 1.0,
        seconds: float | None = None,
    ) -> None:
        if not space.position and balls is None:
            wanted = "the 2 or 3 states that are the position, or balls"
            raise InputError(f"state_coordinates.position: got none, want {wanted}")
        # A copy, because a viewer has sliders for gravity and other settings.
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)  # that is shown, with a caption whose last lines are the remark
        self.space, self.robot = space, robot_body(model, body)
        self.radius, self.speed, self.paused, self.caption, self.remark = radius, speed, False, "", ""
        self.goal_body, self.holds_goal = 0 if goal is None else robot_body(model, goal), False
        self._balls = None if space.position else balls
        self.wrench = np.zeros(6)  # of a drag
        self._mass = float(model.body_subtreemass[self.robot])
        self._push, self._impulse = push * self._mass, np.zeros(3)
        if self._balls is not None:
            _ = self._balls.tracked  # raises an exception if no site is named
        self.follow(plan, self._balls)
        self._trace_spacing = float(np.linalg.norm(np.ptp(self._places, axis=0))) / SEGMENTS
        self._time, self._overrun, self._restart = 0.0, 0.0, False
        self._until = np.inf if seconds is None else clock.monotonic() + seconds
        self._trace: list[Array] = []
        self._floor = 0.0

    def __enter__(self) -> Self:
        return self

    @abc.abstractmethod
    def refresh(self) -> bool:
        """Draw the current state and read the person's input; returns whether the viewer is still open."""

    def show(self, time: float, qpos: Array) -> Array:
        """Wait until `time`, show the model at `qpos`, and return the place of the robot, (3,).

        Raises:
          ViewerClosed, RestartRequested: the person asked for it.
        """
        begins = time <= self._time or not self._trace
        self._wait(max(time - self._time, 0.0))
        self._time, self.data.time, self.data.qpos[:] = time, time, qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)
        place = place_of(self.data, self.robot, self._balls).copy()
        if begins:
            self._trace.clear()
            self._floor = floor_below(self.model, self.data, self.robot)
        on_floor = self._on_floor(self.of_world(place))
        if not self._trace or np.linalg.norm(on_floor - self._trace[-1]) > self._trace_spacing:
            self._trace = [*self._trace, on_floor][-2 * SEGMENTS :]
        self.caption = f"{time:.1f} s, {1e3 * np.linalg.norm(on_floor - self.planned_position()):.0f} mm from the plan"
        if self.remark:
            self.caption += f"\n{self.remark}"
        if self.goal_body:
            self.move_goal(self.goal)  # puts back a goal that was dragged off the floor, or turned
        return place

    def follow(self, plan: Trajectory, balls: BallRecord | None, *, begins: float = 0.0) -> None:
        """Show this plan, which begins at a given time, with its balls if the robot has no position."""
        self._times, self._places = begins + plan.times, plan.states[:, list(self.space.position)]
        if not self.space.position and balls is not None:
            self._places = balls.planned[:, -1]

    @property
    def goal(self) -> Array:
        """The position of the movable goal, in the coordinates of the plan's position, (2 or 3,)."""
        return self.space.of_world(self.data.mocap_pos[self.model.body_mocapid[self.goal_body]])

    def move_goal(self, place: Array) -> None:
        number = self.model.body_mocapid[self.goal_body]
        self.data.mocap_pos[number], self.data.mocap_quat[number] = self._on_floor(place), (1.0, 0.0, 0.0, 0.0)

    def of_world(self, points: Array) -> Array:
        """Points (..., 3) in the coordinates of the plan's position, (..., 2 or 3)."""
        return self.space.of_world(points) if self._balls is None else points

    def wait(self, seconds: float) -> None:
        """Stand still for a while. Raises exceptions as `show` does."""
        self._wait(seconds * self.speed)

    def hold(self, selected: int) -> int:
        """Note which body the person selected (0: none); returns the body to select: the goal or the robot."""
        if selected:
            self.holds_goal = selected == self.goal_body
        return selected or (self.goal_body if self.holds_goal else self.robot)

    def other(self) -> int:
        """The body that Enter selects: the robot or the goal, whichever is not held."""
        return self.robot if self.holds_goal or not self.goal_body else self.goal_body

    def push(self, right_away_up: tuple[float, float, float], azimuth: float) -> None:
        """Push the robot, or move a goal that is held, as seen from a camera that looks along `azimuth`, in degrees."""
        (right, away, up), along = right_away_up, np.radians(azimuth)
        x = right * np.sin(along) + away * np.cos(along)
        y = away * np.sin(along) - right * np.cos(along)
        direction = np.array([x, y, up])  # along the world's axes
        if self.holds_goal:
            self.move_goal(self.goal + self.space.of_world(GOAL_STEP * direction))
        else:
            self._impulse += self._push * direction

    def drag(self, wrenches: Array) -> None:
        """Drag the robot with the sum of forces and torques (nbody, 6), up to the strongest drag."""
        wrench, strength = np.asarray(wrenches).reshape(-1, 6).sum(axis=0), STRONGEST_DRAG * 9.81 * self._mass
        for entries, largest in ((slice(0, 3), strength), (slice(3, 6), strength * self.radius)):
            if (size := float(np.linalg.norm(wrench[entries]))) > largest:
                wrench[entries] *= largest / size
        self.wrench = wrench

    def request_restart(self) -> None:
        self._restart = True

    def pop_wrench(self, dt: float) -> Array:
        """Mean force and torque (6,) of the person over the next `dt` seconds; pushes are used up."""
        push, self._impulse = np.append(self._impulse / dt, np.zeros(3)), np.zeros(3)
        return self.wrench + push

    def planned_position(self) -> Array:
        """The planned place now, (3,)."""
        return self._on_floor([np.interp(self._time, self._times, column) for column in self._places.T])

    def draw_overlays(self, new: geoms.NewGeom) -> None:
        """Draw the plan, the trace and the planned place; `new` returns a new geom."""
        knots = np.unique(np.linspace(0, len(self._times) - 1, SEGMENTS + 1).astype(int))
        plan = np.array([self._on_floor(self._places[knot]) for knot in knots])
        width, flat = 0.002 * float(self.model.stat.extent), self.space.from_above
        radius = self.radius if self._balls is None else float(self._balls.radii[-1])
        kind, size = "cylinder" if flat else "sphere", np.array([radius, LIFT, 0.0])
        place, now = self.planned_position()[None], np.zeros(1)
        for drawable in (
            Line("plan", rgba_of("plan"), "", plan, (0.6 * width, 0.6 * width)),
            Line("trace", TRACE_RGBA, "", np.array(self._trace), (width, width)),
            MovingBody("ghost", rgba_of("ghost", GHOST_OPACITY), "", kind, size, np.eye(3), now, place),
        ):
            geoms.draw(drawable, self._time, new, emission=0.0)

    def aim_camera(self, camera: mujoco.MjvCamera) -> None:
        """Aim a free camera as the scene's `overview` camera, if it has one."""
        mujoco.mjv_defaultFreeCamera(self.model, camera)
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, "overview")
        if number >= 0:
            sight = np.array(self.model.stat.center) - self.model.cam_pos[number]
            lenses = np.radians([self.model.cam_fovy[number], self.model.vis.global_.fovy])
            camera.distance = np.linalg.norm(sight) * np.divide(*np.tan(lenses / 2))
            camera.azimuth = np.degrees(np.arctan2(sight[1], sight[0]))
            camera.elevation = np.degrees(np.arctan2(sight[2], np.hypot(sight[0], sight[1])))

    def _on_floor(self, place: Array | list[float]) -> Array:
        if self._balls is not None:
            return np.array(place)
        return self.space.in_world(place, height=self._floor + LIFT)

    def _wait(self, left: float) -> None:
        """Wait until `left` seconds of the time shown have passed."""
        left = max(left - self._overrun, -MOST_DELAY)
        before = clock.perf_counter()
        while True:
            if clock.monotonic() > self._until or not self.refresh():
                raise ViewerClosed
            if self._restart:
                self._restart = False
                raise RestartRequested
            now = clock.perf_counter()
            left -= 0.0 if self.paused else (now - before) * self.speed
            before = now
            if left <= 0 and not self.paused:
                break
            clock.sleep(float(np.clip(left / self.speed, 0.001, 0.01)))
        self._overrun = -left

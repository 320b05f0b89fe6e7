"""MuJoCo's own viewer, in a window or a browser: recorded runs, and live runs with a person at the viewer."""

import abc
import contextlib
import copy
import os
import sys
import threading
import time as clock
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Self

import mujoco
import numpy as np

from lqrsim.control.controllers import Controller, ControllerLike, ControllerRun
from lqrsim.control.replanner import LiveReplanner
from lqrsim.errors import Array, InputError, free_name
from lqrsim.problem.parts import Cost, CostSum, goals_of, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import references_of
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, spaces_of
from lqrsim.results.rollout import BallRecord, Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.scenes.mjcf_model import compiled
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.plant import Plant
from lqrsim.view.overlays import Line, MovingBody, Shape, rgba_of
from lqrsim.view.recorded_trial import POINT, RecordedTrial, floor_below, interpolated, place_of, robot_body

GHOST_OPACITY = 0.25
TRACE_RGBA = (0.05, 0.35, 0.62, 1.0)
SEGMENTS = 60  # number of segments of the plan; the trace has twice as many
LIFT = 0.008  # m, height of lines above the floor
STRONGEST_DRAG = 2.0  # largest force of a drag, relative to the robot's weight
GOAL_STEP = 0.1  # m, step of the goal for each key press
MOST_DELAY = 0.2  # s, largest delay that is caught up on a slow machine
# The direction of each key, seen from the camera: right, away, up.
PUSHES = {
    "LeftArrow": (-1.0, 0.0, 0.0), "RightArrow": (1.0, 0.0, 0.0), "DownArrow": (0.0, -1.0, 0.0),
    "UpArrow": (0.0, 1.0, 0.0), "PageDown": (0.0, 0.0, -1.0), "PageUp": (0.0, 0.0, 1.0),
}  # fmt: skip


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

    instructions: str  # for the person

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

    def __exit__(self, *_: object) -> None:  # noqa: B027 - a viewer that opens nothing closes nothing
        """Close what is open."""

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
        return self._on_floor(interpolated(self._places, self._times, self._time))

    def overlay_shapes(self) -> Iterator[Shape]:
        """The shapes of the plan, the trace and the planned place."""
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
            yield from drawable.shapes(self._time)

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

    def _on_floor(self, place: Array) -> Array:
        return place if self._balls is not None else self.space.in_world(place, height=self._floor + LIFT)

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


KEYS = """Arrow keys and Page Up/Down push the robot, seen from the camera. Ctrl and the right mouse button drag it.
Space pauses, Backspace starts again."""
GOAL_KEYS = "Enter, or a double click on the orange goal: the same keys and mouse move the goal. Again: the robot."
PAUSE_SECONDS = 1.0  # s, between two runs
GLFW_KEYS = {"RightArrow": 262, "LeftArrow": 263, "DownArrow": 264, "UpArrow": 265, "PageUp": 266, "PageDown": 267}


class Window(Viewer):
    """A viewer in a window, to be used with `with`: it is open as long as the block. The arguments are a Viewer's."""

    instructions = "A window has opened; closing it, or Ctrl-C here, ends it."

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        from mujoco import viewer

        keys = {GLFW_KEYS[name]: direction for name, direction in PUSHES.items()}

        def pressed(code: int) -> None:
            if code in keys:
                self.push(keys[code], self._viewer.cam.azimuth)
            elif code == 257:  # enter
                self._viewer.perturb.select = self.other()
            elif code == 32:  # the space bar
                self.paused = not self.paused
            elif code == 259:  # backspace
                self.request_restart()

        _check_window_opens()
        others = set(threading.enumerate())
        try:
            self._viewer = viewer.launch_passive(self.model, self.data, key_callback=pressed, show_right_ui=False)
        except RuntimeError as error:  # on macOS mjpython has to run it
            raise InputError(f"window: {' '.join(str(error).split())}; or use --viewer browser") from None
        self._threads = set(threading.enumerate()) - others
        with self._viewer.lock():
            self.aim_camera(self._viewer.cam)
            self._viewer.perturb.select = self.robot

    def __exit__(self, *_: object) -> None:
        self._viewer.close()
        for thread in self._threads:  # if the process ended before these threads, it would crash
            thread.join(timeout=5.0)

    def refresh(self) -> bool:
        if not self._viewer.is_running():
            return False
        self._viewer.sync()  # this moves the dragged goal
        with self._viewer.lock():
            self._viewer.perturb.select = self.hold(self._viewer.perturb.select)
        self.drag(self.data.xfrc_applied)
        return True

    def show(self, time: float, qpos: Array) -> Array:
        place, scene = super().show(time, qpos), self._viewer.user_scn
        with self._viewer.lock():
            scene.ngeom = 0
            for shape in self.overlay_shapes():
                shape.append(scene)
        self._viewer.set_texts((None, None, self.caption, None))
        return place


def open_viewer(kind: str, port: int, *, title: str, **options: Any) -> Viewer:
    """Open a `window` or a `browser`, to be used with `with`; the options are a Viewer's.

    `auto` is a window where there is a screen.
    """
    screen = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if kind == "window" or (kind == "auto" and screen):
        return Window(**options)
    from lqrsim.view.browser import Browser

    return Browser(port=port, title=title, **options)


def _check_window_opens() -> None:
    """Raises InputError if no window can be opened: MuJoCo's viewer would wait forever."""
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        usable = glfw.init()
        if usable:
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "lqrsim", None, None)
            usable = bool(window)
            glfw.terminate()
    if not usable:
        raise InputError("window: the display opens no window, want one with OpenGL; or use --viewer browser")


LONGEST_RUN = 600.0  # s, after which a run restarts, because the whole run is kept in memory
RECENT = 100  # number of solves in the median of the caption
GOAL_RGBA = (1.0, 0.72, 0.05, 0.65)  # differs from the colours of plan and trace
GOAL_SIZE = 0.5  # relative to the robot's radius: a robot at the goal can still be seen and clicked


class MovableGoal:
    """The goal position of a problem's final cost, which can be moved. There must be exactly one."""

    def __init__(self, problem: Problem) -> None:
        space = problem.dynamics.state_coordinates
        self._position = list(space.position)
        if not self._position:
            raise InputError("goal: got a robot without a position, want one with a position to move its goal")
        held = [space.names[i] for i in goals_of(problem.constraints, problem.dynamics) if i in self._position]
        if held:
            raise InputError(f"goal: got a GoalState that holds {', '.join(held)}, want a QuadraticCost")
        self._dynamics, self._cost = problem.dynamics, problem.final_cost
        references = references_of(self._cost, self._dynamics)
        of_position = [(term, reference) for term, reference in references if reference.weight[self._position].any()]
        if len(of_position) != 1:
            raise InputError(f"goal: got {len(of_position)} QuadraticCosts of the position in final_cost, want one")
        ((self._goal_term, self._reference),) = of_position
        self.place = self._reference.about[self._position]  # (2 or 3,)

    def cost_at(self, place: Array) -> Cost:
        """The final cost with its goal at another place (2 or 3,)."""
        about = self._reference.about.copy()
        about[self._position] = place
        moved = self._goal_term.moved_to(about, self._dynamics)
        terms = tuple(moved if term is self._goal_term else term for term in terms_of(self._cost))
        return terms[0] if len(terms) == 1 else CostSum(terms)


def model_with_goal(plant: Plant, goal: MovableGoal) -> tuple[mujoco.MjModel, str]:
    """The plant's model with a body for the goal, which a mouse can drag and nothing collides with; and its name."""
    spec = plant.scene.mjcf.spec()
    space = plant.robot.dynamics.state_coordinates
    radius = GOAL_SIZE * (plant.robot.radius or POINT * float(plant.model.stat.extent))
    name = free_name("goal", [body.name for body in spec.bodies])
    body = spec.worldbody.add_body(name=name, mocap=True, pos=space.in_world(goal.place))
    flat = space.from_above
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER if flat else mujoco.mjtGeom.mjGEOM_SPHERE
    size = np.array([radius, 0.1 * radius if flat else 0.0, 0.0])
    body.add_geom(type=kind, size=size, rgba=GOAL_RGBA, contype=0, conaffinity=0)
    return compiled(spec), name


class ViewedReplanner(Controller, ControllerRun):
    """A live re-planner as the controller of the one run that a viewer shows.

    Its decisions depend on the speed of this machine.
    """

    def __init__(self, live: LiveReplanner, plant: Plant, viewer: Viewer, goal: MovableGoal | None) -> None:
        self.live, self.plant, self.viewer, self.goal = live, plant, viewer, goal
        self._planned_goal = np.zeros(0) if goal is None else goal.place

    def start(self, trials: int) -> ControllerRun:
        if self.goal is not None:
            self.viewer.move_goal(self.goal.place)
        self._show_plan()
        return self

    @property
    def digest(self) -> str:
        """Hash of the problem; the decisions also depend on the clock."""
        return sha256(f"live {self.live.problem.digest}")[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return spaces_of(self.live.active.plan.policy)

    def control(self, step: int, measured: Array) -> Array:
        t, before, goal = step * self.live.problem.dt, self.live.active, self.goal
        if goal is not None and not np.array_equal(self.viewer.goal, self._planned_goal):  # the person has moved it
            self._planned_goal = self.viewer.goal
            self.live.change(final_cost=goal.cost_at(self.viewer.goal))
        command = self.live.step(measured[0], t)
        if self.live.active is not before:
            self._show_plan()
        self.viewer.remark = caption(self.live, t)
        return command[None]

    def _show_plan(self) -> None:
        plan = self.live.active.plan.trajectory
        balls = self.plant.record_of_balls(plan.states, plan.states[None])
        self.viewer.follow(plan, balls, begins=self.live.active.first * plan.dt)


def caption(live: LiveReplanner, t: float) -> str:
    """The plan in force and its age, and statistics of the solves, as lines."""
    begun, log = live.active.first * live.problem.dt, live.log
    took, missed = [1e3 * record.seconds for record in log.records[-RECENT:]], log.kept
    if not took:
        solves = "no solve yet"
    else:
        solves = f"solve {took[-1]:.1f} ms, median {np.median(took):.1f} ms; {log.solved} used"
    if missed:
        reasons = "; ".join(f"{count} {why}" for why, count in missed.most_common())
        for status in Status:
            reasons = reasons.replace(status.name, status.value)  # in words
        solves += f"\n{missed.total()} missed: {reasons}"
    name = f"plan of {begun:.1f} s" if live.active.first else "first plan"
    return f"in force: {name}, {t - begun:.1f} s old\n{solves}"


def lengthened(solution: Solution) -> Solution:
    """The solution with its end repeated up to the longest run, for `simulate`; the control is the re-planner's."""
    plan, policy = solution.trajectory, solution.policy
    more = max(int(LONGEST_RUN / plan.dt) - plan.steps, 0)

    def stays(array: Array) -> Array:
        return np.concatenate([array, np.repeat(array[-1:], more, axis=0)])

    laws = {name: stays(getattr(policy, name)) for name in ("gain", "offset", "nominal")}
    return replace(
        solution, trajectory=Trajectory(stays(plan.states), stays(plan.controls), plan.dt),
        policy=replace(policy, **laws), inverse_policy=None, cost_to_go=None, cost_to_come=None, clearance=None,
        multipliers=(), candidates=(),
    )  # fmt: skip


def arguments_for_rollout(rollout: Rollout, trial: int) -> dict[str, Any]:
    """Arguments of a Viewer for one trial."""
    return {
        "model": RecordedTrial(rollout, trial).model, "plan": rollout.plan, "space": rollout.state_coordinates,
        "body": rollout.body, "radius": rollout.radius, "balls": rollout.balls,
    }  # fmt: skip


def arguments_for_plant(plant: Plant, solution: Solution, goal: MovableGoal | None = None) -> dict[str, Any]:
    """Arguments of a Viewer for a live run, and for moving its goal."""
    robot, plan = plant.robot, solution.trajectory
    model, name = (plant.model, None) if goal is None else model_with_goal(plant, goal)
    return {
        "model": model, "goal": name, "plan": plan, "space": robot.dynamics.state_coordinates, "body": robot.body,
        "radius": robot.radius, "balls": plant.record_of_balls(plan.states, plan.states[None]),
    }  # fmt: skip


class _UserForces(Disturbance):
    """Forces on the robot from the person at the viewer."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer

    def start(self, plant: Plant, plan: Any, generators: Sequence[np.random.Generator]) -> Effect:
        wrench = np.zeros(6)

        def force(step: int, states: Array) -> Array:
            wrench[:] = self.viewer.pop_wrench(plan.dt)
            return wrench[None, :3]

        return Effect(force=force, torque=lambda step, states: wrench[None, 3:])


def play(rollout: Rollout, viewer: Viewer, *, trial: int = 0, loop: bool = True) -> None:
    """Show the frames of one trial in time, once or in a loop, until the viewer is closed."""
    recorded = RecordedTrial(rollout, trial)
    with contextlib.suppress(ViewerClosed):
        while True:
            with contextlib.suppress(RestartRequested):
                for time, qpos in zip(recorded.frame_times.tolist(), recorded.frames, strict=True):
                    viewer.show(time, qpos)
                viewer.wait(PAUSE_SECONDS if loop else np.inf)


def live(
    plant: Plant,
    solution: Solution,
    viewer: Viewer,
    *,
    disturbances: Sequence[Disturbance] = (),
    controller: ControllerLike | None = None,
    planner: Callable[[], LiveReplanner] | None = None,
    goal: MovableGoal | None = None,
    seed: int = 0,
    report: Callable[[str], object] = lambda line: None,
) -> None:
    """Simulate in step with the viewer, under the forces of the person, until the viewer is closed.

    A run restarts at the end of the horizon, and when the robot is lost: when its distance from the plan exceeds the
    size of the scene, or the simulation becomes unstable. Run k has the random numbers of trial k of the seed.

    Args:
      planner: makes a live re-planner for each run, in place of a controller: `replanner.live`. A run then continues
        after the plan's horizon, for at most ten minutes.
      goal: a goal that the person moves, with a planner and a viewer that shows it.
    """

    def watch(time: float, qpos: Array, unstable: np.ndarray) -> None:
        apart = np.linalg.norm(viewer.of_world(viewer.show(time, qpos[0]) - viewer.planned_position()))
        if unstable.any() or not apart < plant.model.stat.extent:
            report(f"run {run}: lost after {time:.1f} s")
            raise RestartRequested

    def once() -> str:
        """Run once to the end; return a line on the run."""
        options = {"disturbances": everything, "seed": seed, "first_trial": run, "watch": watch}
        if planner is None:
            rollout = simulate(plant, solution, controller=controller, **options)
            return rollout.summary().splitlines()[-1].strip().replace("trial", "run")
        with planner() as replanner:
            law = ViewedReplanner(replanner, plant, viewer, goal)
            try:
                rollout = simulate(plant, lengthened(solution), controller=law, **options)
            finally:
                report(replanner.summary())
        return f"run {run}: {rollout.reasons[0] or f'has lasted {LONGEST_RUN:g} s'}"

    run, everything = 0, [*disturbances, _UserForces(viewer)]
    with contextlib.suppress(ViewerClosed):
        while True:
            with contextlib.suppress(RestartRequested):
                report(once())
                viewer.wait(PAUSE_SECONDS)
            run += 1

"""Runs in MuJoCo's own viewer: recorded runs, and live runs in which a person pushes the robot or moves its goal."""

import contextlib
import os
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from lqrsim.control.controllers import Controller, ControllerLike, ControllerRun
from lqrsim.control.replan_rule import ActivePlan
from lqrsim.control.replanner import LiveReplanner
from lqrsim.errors import Array, InputError, free_name
from lqrsim.problem.constraints import goals_of
from lqrsim.problem.costs import Cost, CostSum, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import references_of
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, spaces_of
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.scenes.mjcf_model import compiled
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.plant import Plant
from lqrsim.view.browser import Browser
from lqrsim.view.geoms import appending_to
from lqrsim.view.recorded_trial import POINT, model_of
from lqrsim.view.viewer_base import PUSHES, RestartRequested, Viewer, ViewerClosed

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
        ((self._drawing, self._reference),) = of_position
        self.place = self._reference.about[self._position]  # (2 or 3,)

    def cost_at(self, place: Array) -> Cost:
        """The final cost with its goal at another place (2 or 3,)."""
        about = self._reference.about.copy()
        about[self._position] = place
        moved = self._drawing.moved_to(about, self._dynamics)
        terms = tuple(moved if term is self._drawing else term for term in terms_of(self._cost))
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


class ViewedReplanner(Controller):
    """A live re-planner as the controller of a run that a viewer shows.

    Its decisions depend on the speed of this machine.
    """

    def __init__(self, live: LiveReplanner, plant: Plant, viewer: Viewer, goal: MovableGoal | None) -> None:
        self.live, self.plant, self.viewer, self.goal = live, plant, viewer, goal

    def start(self, trials: int) -> ControllerRun:
        return _ViewedRun(self)

    @property
    def digest(self) -> str:
        """Hash of the problem; the decisions also depend on the clock."""
        return sha256(f"live {self.live.problem.digest}")[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return spaces_of(self.live.active.plan.policy)


class _ViewedRun(ControllerRun):
    """A run, which begins with the goal and the plan of the problem."""

    def __init__(self, controller: ViewedReplanner) -> None:
        self._controller, goal = controller, controller.goal
        self._planned_goal = np.zeros(0) if goal is None else goal.place
        if goal is not None:
            controller.viewer.move_goal(goal.place)
        self._show(controller.live.active)

    def control(self, step: int, measured: Array) -> Array:
        live, viewer, goal = self._controller.live, self._controller.viewer, self._controller.goal
        t, before = step * live.problem.dt, live.active
        if goal is not None and not np.array_equal(viewer.goal, self._planned_goal):  # the person has moved it
            self._planned_goal = viewer.goal
            live.change(final_cost=goal.cost_at(viewer.goal))
        command = live.step(measured[0], t)
        if live.active is not before:
            self._show(live.active)
        viewer.remark = caption(live, t)
        return command[None]

    def summary(self) -> str:
        return self._controller.live.summary()

    def _show(self, active: ActivePlan) -> None:
        plan = active.plan.trajectory
        balls = self._controller.plant.record_of_balls(plan.states, plan.states[None])
        self._controller.viewer.follow(plan, balls, begins=active.first * plan.dt)


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


KEYS = """Arrow keys and Page Up/Down push the robot, seen from the camera. Ctrl and the right mouse button drag it.
Space pauses, Backspace starts again."""
GOAL_KEYS = "Enter, or a double click on the orange goal: the same keys and mouse move the goal; and back to the robot."
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
            self.draw_overlays(appending_to(scene))
        self._viewer.set_texts((None, None, self.caption, None))
        return place


def open_viewer(kind: str, port: int, *, title: str, **options: Any) -> Window | Browser:
    """Open a `window` or a `browser`, to be used with `with`; the options are a Viewer's."""
    return Window(**options) if kind == "window" else Browser(port=port, title=title, **options)


def arguments_for_rollout(rollout: Rollout, trial: int) -> dict[str, Any]:
    """Arguments of a Viewer for one trial."""
    model = model_of(rollout, trial)
    if not np.isfinite(rollout.frames[trial]).all(axis=1).any():
        raise InputError(f"rollout: got trial {trial} without a finite state, want one that can be shown")
    return {
        "model": model, "plan": rollout.plan, "space": rollout.state_coordinates, "body": rollout.body,
        "radius": rollout.radius, "balls": rollout.balls,
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
    finite = np.isfinite(rollout.frames[trial]).all(axis=1)
    frames = list(zip(rollout.frame_times[finite].tolist(), rollout.frames[trial][finite], strict=True))
    with contextlib.suppress(ViewerClosed):
        while True:
            with contextlib.suppress(RestartRequested):
                for time, qpos in frames:
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
    ended: Callable[[str], object] = lambda line: None,
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
            ended(f"run {run}: lost after {time:.1f} s")
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
                ended(replanner.summary())
        return f"run {run}: {rollout.reasons[0] or f'has lasted {LONGEST_RUN:g} s'}"

    run, everything = 0, [*disturbances, _UserForces(viewer)]
    with contextlib.suppress(ViewerClosed):
        while True:
            with contextlib.suppress(RestartRequested):
                ended(once())
                viewer.wait(PAUSE_SECONDS)
            run += 1


def has_display() -> bool:
    """Whether there is a screen to open a window on."""
    return sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


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

"""A robot in a viewer that plans again as it goes, while someone moves its goal; however slow the machine is."""

import contextlib
import os
import re
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import browsing
import mujoco
import numpy as np
import pytest
from live_solves import ready
from mechanisms import sled
from planar_arm import LENGTH, LINK, PlanarArm
from viewers import Recorder, said, said_after, viewing

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.view import viewer
from lqrsim.view.overlays import colour_of
from lqrsim.view.viewer import PUSHES, MovableGoal, model_with_goal

PORT = 19700 + os.getpid() % 1000  # of our own, also where tests run side by side
FREE = np.zeros(3)  # a metre from all beams: closer to them, what they cost keeps the robot from staying


BEFORE: list[threading.Thread] = []  # those of other tests in this process


@pytest.fixture(autouse=True)
def count_from_here() -> None:
    BEFORE[:] = [thread for thread in threading.enumerate() if thread.name.startswith("lqrsim re-planner")]


def planning() -> list[threading.Thread]:
    threads = [thread for thread in threading.enumerate() if thread.name.startswith("lqrsim re-planner")]
    return [thread for thread in threads if thread not in BEFORE]


class Run:
    """Live runs with a planner, in a viewer that closes after so many frames.

    The planner has 0.2 s on the clock for a solve, and the viewer waits for it where `patient`, so that it matters
    little how fast the machine is.
    """

    def __init__(
        self, scenario: ls.Scenario, solution: ls.Solution, frames: int, clock: Any = lambda: 0.0, **options: Any
    ) -> None:
        self.scenario, self.solution, self.plant = scenario, solution, scenario.plant()
        self.goal = MovableGoal(scenario.problem)
        self.screen = Recorder(frames, **viewer.arguments_for_plant(self.plant, solution, self.goal))
        self.planners: list[ls.types.LiveReplanner] = []
        self.lines: list[str] = []
        self.captions: list[str] = []
        self.acts: list[Callable[[float], object]] = []
        self.patient = True
        self.clock = clock
        self.options = {"every": 0.2, "deadline": 0.2, "horizon": "moving"} | options
        self.screen.act = self.act

    def act(self, time: float) -> None:
        self.captions.append(self.screen.caption)
        for one in self.acts:
            one(time)
        if self.patient:
            ready(self.planners[-1])

    def planner(self) -> ls.types.LiveReplanner:
        replanner = ls.Replanner(self.scenario.problem, self.solution, **self.options)
        self.planners.append(replanner.live(clock=self.clock))
        return self.planners[-1]

    def go(self, **options: Any) -> "Run":
        made = {"planner": self.planner, "goal": self.goal, "report": self.lines.append}
        viewer.live(self.plant, self.solution, self.screen, **(made | options))
        return self


@pytest.fixture(scope="module")
def moved(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> Run:
    """15 s of the quadrotor, whose plan has 5; at 1 s someone moves its goal, and at 8 s pushes it."""
    run = Run(quadrotor, quadrotor_solution, 450)
    run.acts.append(lambda time: run.screen.move_goal(FREE) if abs(time - 1.0) < 0.01 else None)
    run.acts.append(lambda time: run.screen.push((1.0, 0.0, 0.0), 0.0) if abs(time - 8.0) < 0.01 else None)
    return run.go()


def test_a_moved_goal_is_reached(moved: Run) -> None:
    """Before its goal moves it does what the first plan says. A push of 0.3 m/s does not keep it from there."""
    places = np.array(moved.screen.shown)[:, :3]
    away = np.linalg.norm(places - FREE, axis=1)
    np.testing.assert_allclose(moved.screen.goal, FREE, atol=1e-12)
    assert away[29] > 2.0
    assert away[:240].min() < 0.3
    assert away[-1] < 0.1
    velocity = 30 * np.diff(places, axis=0)
    assert velocity[241, 1] - velocity[239, 1] < -0.1  # -y is to the right of a camera that looks along x


def test_a_run_goes_on_after_the_first_plan(moved: Run) -> None:
    assert len(moved.planners) == 1
    assert moved.captions[-1].startswith("15.0 s, ")


def test_the_caption_tells_solves_and_the_law(moved: Run) -> None:
    """Of the last frame: what the planner's own records say, and the law that begins at a multiple of 0.2 s."""
    (planner,) = moved.planners
    _, law, solves, *_ = moved.captions[-1].splitlines()
    known = planner.log.records[:-1]  # the last answer came after the last frame
    took, used = [1e3 * one.seconds for one in known], sum(one.used for one in known)
    assert len(took) == 450 // 6 - 1
    begins = f"solve {took[-1]:.1f} ms, median {np.median(took):.1f} ms; {used} used"
    assert solves.startswith(begins)
    assert law == "in force: plan of 14.8 s, 0.2 s old"
    assert moved.captions[0].splitlines()[1:] == ["in force: first plan, 0.0 s old", "no solve yet"]


def test_the_plan_in_force_is_drawn(moved: Run) -> None:
    """The last piece of the line ends where the plan does that is in force, and that is near the new goal."""
    geoms = [shape.set(mujoco.MjvGeom()) for shape in moved.screen.overlay_shapes()]
    last = [geom for geom in geoms if np.allclose(geom.rgba, (*colour_of("plan"), 1.0))][-1]
    ends = last.pos + np.outer((-1, 1), last.size[2] * last.mat[:, 2])
    planned = moved.planners[0].active.plan.trajectory.states[-1, :3]
    assert np.linalg.norm(ends - planned, axis=1).min() < 1e-6
    assert np.linalg.norm(planned - FREE) < 0.1


def test_the_summary_tells_how_it_went(moved: Run) -> None:
    (line,) = moved.lines
    assert line == moved.planners[0].summary()
    assert re.match(r"solved again \d+ times", line)


def test_a_goal_on_the_floor(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    """A disc, that stays flat on the floor wherever a hand takes it; the next plans end there, within 0.1 m."""
    run = Run(differential_drive, drive_solution, 60, every=1 / 6, deadline=1 / 6)
    number = run.screen.model.body_mocapid[run.screen.goal_body]

    def dragged(time: float) -> None:
        run.screen.data.mocap_pos[number] = (1.5, 1.5, 0.7)
        run.screen.data.mocap_quat[number] = (0.5, 0.5, 0.5, 0.5)

    run.acts.append(dragged)
    put: list[tuple[float, ...]] = []
    run.acts.insert(
        0, lambda time: put.append((*run.screen.data.mocap_pos[number], *run.screen.data.mocap_quat[number]))
    )
    run.go()
    assert put[-1] == pytest.approx((1.5, 1.5, 0.0, 1, 0, 0, 0), abs=0.02)
    assert np.linalg.norm(run.planners[0].active.plan.trajectory.states[-1, :2] - 1.5) < 0.1


def test_what_is_not_ready_is_missed_and_the_run_goes_on(
    quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """The thread is held for a second: until then the robot does what it does without re-planning, to 1e-9 m."""
    held, main_thread = threading.Event(), threading.current_thread()

    def clock() -> float:
        if threading.current_thread() is not main_thread:
            held.wait(600)
        return 0.0

    run = Run(quadrotor, quadrotor_solution, 60, clock=clock)
    run.patient = False

    def release(time: float) -> None:
        if time > 0.99:
            held.set()
            ready(run.planners[-1])

    run.acts.append(release)
    run.go()
    still = ls.simulate(run.plant, quadrotor_solution).frames[0][1:31]
    np.testing.assert_allclose(np.array(run.screen.shown)[:30], still, rtol=0, atol=1e-9)
    assert run.planners[0].log.kept["not ready in time"] == 1
    assert "in force: first plan, 0.9 s old" in run.captions[28]
    assert re.search(r"\n\d+ missed: .*\b1 not ready in time", run.captions[-1])
    assert run.planners[0].active.first > 30


@pytest.mark.parametrize("how", ["closed", "started again", "interrupted", "lost"])
def test_no_thread_is_left(how: str, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """And each run begins with the problem's own goal and the first plan."""
    run = Run(quadrotor, quadrotor_solution, 40)
    seen: list[int] = []
    first: list[np.ndarray] = []  # where the goal is as a run begins

    def act(time: float) -> None:
        seen.append(len(planning()))
        if abs(time - 1 / 30) < 1e-6:
            first.append(run.screen.goal)
            run.screen.move_goal(FREE)
        if len(seen) != 15:
            return
        if how == "started again":
            run.screen.request_restart()
        if how == "interrupted":
            raise KeyboardInterrupt
        if how == "lost":
            run.screen.data.qpos[:3] = 1e6
            run.screen.follow(
                replace(quadrotor_solution.trajectory, states=1e6 + quadrotor_solution.trajectory.states), None
            )

    run.acts.append(act)
    with contextlib.suppress(KeyboardInterrupt):
        run.go()
    assert max(seen) == seen[-1] == 1  # from the first solve on
    assert planning() == []
    runs = 1 + (how in ("started again", "lost"))
    assert len(run.planners) == runs
    solved = [line for line in run.lines if line.startswith("solved again")]
    assert len(solved) == runs
    np.testing.assert_allclose(first, [run.goal.place] * runs, atol=1e-12)
    if how == "lost":
        assert any(re.match(r"run 0: lost after 0\.5 s", line) for line in run.lines)
    if runs == 2:
        assert "in force: first plan, 0.0 s old" in run.captions[15]


def test_keys_move_what_is_held(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """A tenth of a metre, seen from the camera; the robot is pushed only while that is held."""
    screen = Run(quadrotor, quadrotor_solution, 1).screen
    first = screen.goal
    assert screen.hold(0) == screen.robot
    screen.push(PUSHES["PageUp"], 0.0)
    assert screen.pop_wrench(1.0)[2] > 0
    np.testing.assert_array_equal(screen.goal, first)
    assert screen.hold(screen.other()) == screen.goal_body  # Enter
    for key, azimuth, way in (
        ("RightArrow", 0.0, (0, -1, 0)),
        ("UpArrow", 90.0, (0, 1, 0)),
        ("PageDown", 5.0, (0, 0, -1)),
    ):
        before = screen.goal
        screen.push(PUSHES[key], azimuth)
        np.testing.assert_allclose(screen.goal - before, 0.1 * np.array(way), atol=1e-12)
    assert not screen.pop_wrench(1.0).any()
    assert screen.hold(0) == screen.goal_body  # a click on nothing
    assert screen.hold(screen.robot) == screen.robot  # a double click on the robot
    assert screen.other() == screen.goal_body
    assert not screen.holds_goal
    without = Recorder(1, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    assert without.hold(without.other()) == without.robot


def test_the_goal_of_a_robot_without_a_radius_is_seen(tmp_path: Path) -> None:
    (tmp_path / "point.xml").write_text(sled("xy", actuators='<motor joint="x"/>'))
    robot = ls.MjcfRobot(str(tmp_path / "point.xml"), radius=0.0)
    goal = MovableGoal(robot.problem(np.zeros(4), np.ones(4), steps=5))
    model, name = model_with_goal(ls.Plant(robot, robot.scene), goal)
    assert model.geom_size[model.body(name).geomadr[0], 0] > 0


def test_the_goal_in_the_model(quadrotor: ls.Scenario, differential_drive: ls.Scenario) -> None:
    """All else keeps its numbers; MuJoCo's own mouse moves it, and it touches nothing."""
    for scenario in (quadrotor, differential_drive):
        plant, goal = scenario.plant(), MovableGoal(scenario.problem)
        model, name = model_with_goal(plant, goal)
        bodies = [[one.body(i).name for i in range(one.nbody)] for one in (model, plant.model)]
        assert bodies[0] == [*bodies[1], name]
        assert model.nq == plant.model.nq
        data, hand, number = mujoco.MjData(model), mujoco.MjvPerturb(), model.body(name).id
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.mocap_pos[0][: len(goal.place)], goal.place)
        hand.select, hand.active = number, int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
        hand.refpos[:], hand.refquat[:] = (0.1, 0.2, 0.3), (1, 0, 0, 0)
        mujoco.mjv_applyPerturbPose(model, data, hand, 0)
        mujoco.mjv_applyPerturbForce(model, data, hand)
        np.testing.assert_allclose(data.mocap_pos[0], (0.1, 0.2, 0.3))
        assert not data.xfrc_applied.any()
        data.mocap_pos[0] = data.xpos[model.body(scenario.robot.body).id]
        mujoco.mj_forward(model, data)
        assert not any(model.body(name).geomadr[0] in pair for pair in data.contact.geom)


def test_the_cost_of_a_moved_goal(quadrotor: ls.Scenario) -> None:
    """Zero at the new place with all else as it was, by hand beside it; other terms stay."""
    goal = MovableGoal(quadrotor.problem)
    changed = replace(quadrotor.problem, final_cost=goal.cost_at(FREE))
    first = quadrotor.problem.goal
    assert first is not None
    np.testing.assert_array_equal(goal.place, first[:3])
    np.testing.assert_array_equal(changed.goal, [*FREE, *first[3:]])
    other = ls.SymbolicCost(lambda x, u, p: x[3] ** 2)
    both = replace(quadrotor.problem, final_cost=other + quadrotor.problem.final_cost)
    summed = replace(both, final_cost=MovableGoal(both).cost_at(FREE))
    np.testing.assert_array_equal(summed.goal, changed.goal)


def test_goals_that_cannot_be_moved(quadrotor: ls.Scenario) -> None:
    problem = quadrotor.problem
    weight = np.repeat((0.0, 1.0), (3, 9))
    cases = (
        (replace(problem, final_cost=problem.final_cost + problem.final_cost), "got 2 QuadraticCosts of the position"),
        (replace(problem, final_cost=ls.QuadraticCost(weight, about=np.zeros(12))), "got 0 QuadraticCosts"),
        (replace(problem, constraints=(ls.GoalState(y=1.0),)), "got a GoalState that holds y"),
        (arm_problem(PlanarArm()), "got a robot without a position"),
    )
    for wrong, line in cases:
        with pytest.raises(ls.InputError, match=f"goal: {line}"):
            MovableGoal(wrong)


def arm_problem(arm: PlanarArm) -> ls.Problem:
    """To another place from its first; 1 s."""
    return ls.Problem(
        dynamics=arm.dynamics, dt=0.05, steps=20, initial=ls.FixedState(np.zeros(6)),
        stage_cost=ls.ControlCost(np.ones(3)), final_cost=ls.QuadraticCost([100.0] * 6, about=[0.3, 0.2, 0.1, 0, 0, 0]),
    )  # fmt: skip


@pytest.mark.long
def test_a_robot_without_a_position_plans_again(tmp_path: Path) -> None:
    """It has no goal to move, and Enter leaves the robot selected; its last ball is drawn where the new plan has it."""
    arm = PlanarArm()
    problem, plant = arm_problem(arm), ls.Plant(arm, PlanarArm.scene(tmp_path, things=""))
    solution, made = ls.smooth(problem), []

    def planner() -> ls.types.LiveReplanner:
        replanner = ls.Replanner(problem, solution, every=0.2, deadline=0.2, horizon="moving")
        made.append(replanner.live(clock=lambda: 0.0))
        return made[-1]

    screen = Recorder(120, **viewer.arguments_for_plant(plant, solution))
    screen.act = lambda time: ready(made[-1])
    viewer.live(plant, solution, screen, planner=planner)
    assert screen.hold(screen.other()) == screen.robot
    (planner_made,) = made
    law = planner_made.active
    assert law.first * 0.05 > 1.0
    angles = np.cumsum(law.plan.trajectory.states[0, :3])
    end = LENGTH * np.array([np.cos(angles).sum(), np.sin(angles).sum()])
    screen._time = law.first * 0.05
    assert screen.planned_position()[:2] == pytest.approx(end, abs=LENGTH / LINK.count)
    assert planning() == []


def test_rates_and_options_that_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    cases = (
        (["quadrotor", "--replan", "0"], "--replan: got 0"),
        (["quadrotor", "--replan", "31"], "--replan: got 31"),
        (["quadrotor", "--replan", "0.1"], "--replan: got 0.1"),
        (["differential_drive", "--replan", "30"], "--replan: got 30"),
        (["quadrotor", "--replan", "30", "--speed", "2"], "--speed: got 2 with --replan, want at most 1"),
        (["quadrotor", "--replan", "30", "--controller", "track"], "--controller: got track with --replan"),
        (["run.npz", "--replan", "30"], "--replan: got 30 with run.npz, want it with a SCENARIO"),
    )
    for arguments, line in cases:
        assert main(["view", *arguments]) == 2
        error = capsys.readouterr().err
        assert line in error
        assert len(error.strip().splitlines()) == 1


needs_browser = pytest.mark.skipif(not browsing.CHROMIUM, reason="there is no browser: sudo apt-get install chromium")


@needs_browser
@pytest.mark.long
def test_keys_and_the_mouse_move_the_goal(tmp_path: Path) -> None:
    """In the browser: after Enter an arrow key moves it, and Ctrl with the right mouse button drags it."""
    before = """import lqrsim.view.viewer as viewer
move, press, key = viewer.Viewer.move_goal, viewer.Viewer.push, []
def moved(self, place):
    before = self.goal
    move(self, place)
    if abs(self.goal - before).max() > 1e-9:
        print("key" if key else "mouse", "moved it", flush=True)
def pressed(self, direction, azimuth):
    key.append(self.holds_goal)
    press(self, direction, azimuth)
    key.clear()
viewer.Viewer.move_goal, viewer.Viewer.push = moved, pressed"""
    with viewing(tmp_path, "quadrotor", "--port", str(PORT), "--replan", "30", before=before) as process:
        text = said(process, "Ctrl-C ends it")
        assert "plans again every 0.03333 s, 30 times a second" in text
        with browsing.browser(f"http://127.0.0.1:{PORT}/", tmp_path / "profile", size=(500, 400)) as page:
            next(page.pictures())

            def press(i: int) -> None:
                if i % 4 == 0:
                    page.press("Enter", 13)
                page.press("ArrowRight", 39)

            assert "mouse moved it" not in said_after(process, "key moved it", press)
            said_after(process, "mouse moved it", lambda i: page.drag((350, 140), (350, 80 + i % 2)))
        process.send_signal(signal.SIGINT)
        said(process, "solved again")
        assert process.wait(600) == 0

"""Pictures of a robot of balls without a position, what is read from their pixels, and the file of its run."""

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from matplotlib.patches import Circle
from mechanisms import NO_CONTACT, motors, scene
from PIL import Image
from planar_arm import HEIGHT, LENGTH, LINK, PlanarArm
from tracking import track

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.rollout import BallRecord
from lqrsim.view import style, viewer
from lqrsim.view.plots import MOMENTS, _of_balls
from lqrsim.view.viewer import Viewer

FLAT = {"size": (640, 480), "fps": 4}


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> ls.Plant:
    return ls.Plant(PlanarArm(), PlanarArm.scene(tmp_path_factory.mktemp("arm")))


@pytest.fixture(scope="module")
def plan(plant: ls.Plant) -> ls.Solution:
    """A turn beside the posts; nothing of the solver is looked at here."""
    dynamics, start = plant.robot.dynamics, (-0.9, 0.2, 0.3, 0.0, 0.0, 0.0)
    balls = plant.robot.balls
    problem = ls.Problem(
        dynamics=dynamics, dt=0.05, steps=40, initial=ls.FixedState(start),
        stage_cost=ls.ControlCost(np.full(3, 0.05)) + ls.ObstacleCost(ls.World([]), balls=balls),
        final_cost=ls.QuadraticCost(np.full(6, 1000.0), about=(-0.3, 0.9, -0.2, 0.0, 0.0, 0.0)),
        constraints=[ls.Clearance(ls.World([]), balls=balls)],
    )  # fmt: skip
    return ls.smooth(problem)


@pytest.fixture(scope="module")
def run(plant: ls.Plant, plan: ls.Solution) -> ls.Rollout:
    return ls.simulate(plant, plan, disturbances=[ls.disturbances.ControlNoise(0.1)], trials=2)


def test_a_run_records_where_its_balls_were(plant: ls.Plant, plan: ls.Solution, run: ls.Rollout) -> None:
    assert run.balls is not None
    dynamics, balls = plant.robot.dynamics, PlanarArm().balls
    np.testing.assert_array_equal(run.balls.driven, balls.centres(dynamics, run.states))
    np.testing.assert_array_equal(run.balls.planned, balls.centres(dynamics, plan.trajectory.states))
    np.testing.assert_array_equal(run.places(1), run.balls.driven[1, :, -1])
    np.testing.assert_array_equal(run.in_world(run.places(1)), run.places(1))
    body, place = run.balls.tracked
    assert plant.model.body(body).name == "hand"
    np.testing.assert_array_equal(place, [0.4, 0, 0])
    assert ls.simulate(plant, plan, frames=False).balls is None


class Bare(PlanarArm):
    balls = None  # pyright: ignore[reportAssignmentType]


def test_without_balls_the_outermost_part_stands_for_it(plant: ls.Plant) -> None:
    """The middle of the last link, by the sums of the joints' angles; nothing where a run has ended."""
    states = np.random.default_rng(0).uniform(-3.0, 3.0, (2, 5, 6))
    states[1, 3:] = np.nan
    record = ls.Plant(Bare(), plant.scene).record_of_balls(states[0], states)
    assert record is not None
    angles, lengths = np.cumsum(states[..., :3], axis=-1), LENGTH * np.array([1.0, 1.0, 0.5])
    level = np.stack([np.cos(angles) @ lengths, np.sin(angles) @ lengths], axis=-1)
    np.testing.assert_allclose(record.driven[..., 0, :2], level, atol=1e-12)
    np.testing.assert_allclose(record.planned[:, 0, :2], level[0], atol=1e-12)
    np.testing.assert_allclose(record.planned[..., 2], HEIGHT, atol=1e-12)


def test_its_file_is_the_same_run(run: ls.Rollout, tmp_path: Path) -> None:
    read = ls.load(ls.save(run, tmp_path / "rollout.npz"), ls.Rollout)
    assert run.balls is not None
    assert read.balls is not None
    for field in dataclasses.fields(BallRecord):
        np.testing.assert_array_equal(getattr(read.balls, field.name), getattr(run.balls, field.name))
    bare = dataclasses.replace(run, balls=None)
    assert ls.load(ls.save(bare, tmp_path / "bare.npz"), ls.Rollout).balls is None


def test_the_silhouette_is_where_the_last_ball_is(plan: ls.Solution, run: ls.Rollout) -> None:
    found = ls.verify_run(run, 1, solution=plan)
    # The plan is the solution's; the noise pushed the run off it, which the record says, too.
    assert found.passed, str(found)


def test_a_run_of_other_states_is_not_verified(run: ls.Rollout) -> None:
    assert run.balls is not None
    moved = dataclasses.replace(run.balls, driven=run.balls.driven + np.array([0.03, 0, 0]))
    found = ls.verify_run(dataclasses.replace(run, balls=moved))
    assert not found.passed
    assert "a camera is off" in str(found) or "another run" in str(found)


def test_a_video_is_verified_by_its_mark(plan: ls.Solution, run: ls.Rollout, tmp_path: Path) -> None:
    video = ls.render(run, tmp_path / "arm.mp4", camera="top", insets=("side",), quality="draft", fps=5)
    found = ls.verify_video(video, run, solution=plan)
    assert found.passed, str(found)


def test_the_figure_has_the_balls_at_several_times(
    plan: ls.Solution, run: ls.Rollout, plant: ls.Plant, tmp_path: Path
) -> None:
    with style.figure(tmp_path / "axes.png", size=(5, 5)) as figure:
        (axes,) = _of_balls(plan, {"run": run}, plant.scene.world, 0).draw(figure, [figure.add_gridspec()[0]])
        circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert run.balls is not None
    assert len(circles) == MOMENTS * 3 * LINK.count
    seen = np.array([circle.center for circle in circles[-3 * LINK.count :]])
    np.testing.assert_allclose(seen, run.balls.driven[0, -1, :, :2], rtol=0, atol=1e-12)
    assert ls.view.plot_run(plan, {"run": run}, tmp_path / "run.png", world=plant.scene.world).stat().st_size > 10_000
    assert ls.view.plot_policy(plan, tmp_path / "p.png", world=plant.scene.world, radius=0.1).stat().st_size > 10_000


@pytest.mark.parametrize("moments", [1, 2, 3, MOMENTS])
def test_the_balls_of_the_last_moment_have_the_full_colour(
    moments: int, plan: ls.Solution, run: ls.Rollout, plant: ls.Plant
) -> None:
    """However few moments there are, as of a run of one period, or one that ended at once."""
    assert run.balls is not None
    driven = run.balls.driven.copy()
    driven[:, moments:] = np.nan
    short = dataclasses.replace(run, balls=dataclasses.replace(run.balls, driven=driven))
    views = _of_balls(plan, {"run": short}, plant.scene.world, 0)
    colours = list(dict.fromkeys(colour for *_, colour in views.balls))
    assert len(colours) == moments
    assert colours[-1] == style.RUNS[0]


class Closing(Viewer):
    """A viewer that no one looks at, which closes after so many frames."""

    def __init__(self, frames: int, **options: Any) -> None:
        super().__init__(speed=1000.0, **options)
        self.count = frames
        self.apart: list[float] = []

    def refresh(self) -> bool:
        return len(self.apart) < self.count

    def show(self, time: float, qpos: Array) -> Array:
        place = super().show(time, qpos)
        self.apart.append(float(np.linalg.norm(place - self.planned_position())))
        return place


def test_viewers_follow_its_last_ball(plant: ls.Plant, plan: ls.Solution, run: ls.Rollout) -> None:
    assert run.balls is not None
    recorded = Closing(len(run.frame_times), **viewer.arguments_for_rollout(run, 0))
    viewer.play(run, recorded)
    off = np.linalg.norm(run.balls.driven[0, :, -1] - run.balls.planned[:, -1], axis=1)
    assert max(recorded.apart) == pytest.approx(off.max(), rel=0.2)
    assert "mm from the plan" in recorded.caption
    at_work = Closing(60, **viewer.arguments_for_plant(plant, plan))
    viewer.live(plant, plan, at_work)
    assert max(at_work.apart) < 2e-3
    *_, ghost = at_work.overlay_shapes()
    np.testing.assert_allclose(ghost.place, at_work.planned_position(), rtol=0, atol=1e-6)
    with pytest.raises(ls.InputError, match="the position, or balls"):
        Closing(1, **viewer.arguments_for_rollout(run, 0) | {"balls": None})


@pytest.mark.parametrize("kind", ["turning", "folding"])
def test_a_robot_with_neither_position_nor_balls_is_drawn_by_what_is_farthest_out(kind: str, tmp_path: Path) -> None:
    """A body on a ball joint, or two links that touch nothing; places by MuJoCo's kinematics of the recorded frames."""
    flag = f'<geom name="{{}}" type="capsule" fromto="{{}} 0 0 {{}} 0 0.1" size="0.03" {NO_CONTACT}/>'
    inner = {
        "turning": f'<joint name="turn" type="ball" damping="0.1"/>{flag.format("tip", 0.4, 0.6)}',
        "folding": f'<joint name="turn" axis="0 1 0"/>{flag.format("inner", 0, 0.3)}<body name="fore" pos="0.3 0 0">'
        f'<joint name="elbow" axis="0 1 0"/>{flag.format("tip", 0, 0.3)}</body>',
    }[kind]
    file = tmp_path / "scene.xml"
    file.write_text(scene(f'<body name="hub">{inner}</body>', '<general joint="turn" gear="1 0.5 0.2"/>'))
    robot = ls.MjcfRobot(file, outline=False)
    assert robot.balls is None
    plant = ls.Plant(robot, robot.scene)
    plan = track(robot, robot.at(), np.zeros((10, len(robot.actuators))), 0.02, feedback=False)
    run = ls.simulate(plant, plan, disturbances=[ls.disturbances.ControlNoise(0.5)])
    assert run.balls is not None
    data = mujoco.MjData(plant.model)
    for time, frame in zip(run.frame_times, run.frames[0], strict=True):
        data.qpos[:] = frame
        mujoco.mj_kinematics(plant.model, data)
        knot = time / run.plan.dt
        if abs(knot - round(knot)) < 1e-9:
            place = run.places(0)[round(knot)]
            np.testing.assert_allclose(place, data.geom("tip").xpos, rtol=0, atol=1e-6)  # frames are single floats
    assert np.ptp(run.places(0), axis=0).max() > 0.01  # and not the middle, which stays
    still = ls.render(run, tmp_path / "still.png", size=(160, 120))
    assert np.asarray(Image.open(still)).std() > 0


def test_what_is_missing_is_said(run: ls.Rollout, plan: ls.Solution, plant: ls.Plant, tmp_path: Path) -> None:
    bare = dataclasses.replace(run, balls=None)
    with pytest.raises(ls.InputError, match="or a run of a robot with balls that has frames"):
        ls.render(bare, tmp_path / "arm.mp4", **FLAT)
    with pytest.raises(ls.InputError, match="or runs of a robot with balls that have frames"):
        ls.view.plot_run(plan, {"run": bare}, tmp_path / "run.png", world=plant.scene.world)
    assert run.balls is not None
    nameless = dataclasses.replace(run.balls, anchors=np.full_like(run.balls.anchors, np.nan))
    with pytest.raises(ls.InputError, match="want one in sites= of CollisionSpheres"):
        ls.verify_run(dataclasses.replace(run, balls=nameless))
    with pytest.raises(ls.InputError, match="got a body that the model does not have"):
        ls.verify_run(dataclasses.replace(run, balls=dataclasses.replace(run.balls, anchors=1e3 + run.balls.anchors)))
    with pytest.raises(ls.InputError, match=r"balls\.driven: got shape"):
        dataclasses.replace(run, balls=dataclasses.replace(run.balls, driven=run.balls.driven[:1]))


@pytest.mark.parametrize("own", ['<camera name="own" pos="0 0 9"/><light pos="0 0 3"/>', ""])
@pytest.mark.parametrize("size", [(480, 270), (400, 300)])
def test_an_overview_has_all_of_an_arm_before_a_light_sky_and_no_hulls(
    tmp_path: Path, own: str, size: tuple[int, int]
) -> None:
    """Red is what is drawn of the arm, blue the hull that collides, larger; the ball that is followed is low."""
    corners = "-1 -1 -1  1 -1 -1  0 1 -1  0 0 1"
    path = tmp_path / "tall.xml"
    mast = f"""<body name="mast"><joint name="turn" axis="0 0 1" range="-1.5 1.5" damping="1"/>
      <geom type="mesh" mesh="drawn" pos="0.3 0 1.5" rgba="1 0 0 1" {NO_CONTACT}/>
      <geom type="mesh" mesh="hull" pos="0.3 0 1.5" rgba="0 0 1 1"/>
      <geom type="cylinder" fromto="0 0 0 0.3 0 1.5" size="0.02" rgba="1 0 0 1" {NO_CONTACT}/>
      <geom type="sphere" size="0.05" pos="0.3 0 0" rgba="1 0 0 1"/></body>"""
    meshes = "".join(
        f'<mesh name="{name}" vertex="{corners}" scale="{size} {size} {size}"/>'
        for name, size in (("hull", 0.12), ("drawn", 0.1))
    )
    path.write_text(scene(mast, motors(["turn"], [5]), things=own, before=f"<asset>{meshes}</asset>"))
    robot = ls.MjcfRobot(path)
    problem = robot.problem(robot.at(), robot.at(turn=1.0), steps=20, dt=0.02)
    run = ls.simulate(ls.Plant(robot, robot.scene), ls.smooth(problem, max_iterations=1))
    still = tmp_path / "still.png"
    ls.render(run, still, size=size, every=run.times[-1] / 4, overlays=())
    colours = np.asarray(Image.open(still).convert("RGB")).astype(int)
    red = (colours[..., 0] > 100) & (colours[..., 1:].max(axis=2) < 60)
    blue = (colours[..., 2] > 100) & (colours[..., :2].max(axis=2) < 60)
    rows, columns = np.nonzero(red)
    assert np.ptp(rows) > 150  # a large part of the picture
    assert rows.min() > 0
    assert rows.max() < size[1] - 1
    assert columns.min() > 0
    assert columns.max() < size[0] - 1
    assert not blue.any()
    assert colours[5, 5].min() > 150

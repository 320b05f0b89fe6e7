"""Videos and stills of real runs: what is in the file, and what is in the picture."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import mujoco
import numpy as np
import pytest
from mechanisms import motors, scene, sled
from PIL import Image, ImageSequence
from sampling import rarely
from tracking import funnel_by_hand, hover, track

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, DisplacedObstacles, Push
from lqrsim.view import cameras, gl
from lqrsim.view.options import DRAWN_BY, OVERLAY_KINDS, OVERLAYS, Overlay
from lqrsim.view.overlays import DrawnTube, Overlays, Scale, colour_of, legend_entries
from lqrsim.view.picture import Legend, open_picture
from lqrsim.view.recorded_trial import RecordedTrial
from lqrsim.view.render import digest, read_metadata, render

draws = pytest.mark.skipif(bool(gl.missing()), reason=f"no OpenGL here: {gl.INSTALL}")
SMALL = (320, 180)


@pytest.fixture(scope="module")
def drive(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> ls.Rollout:
    return ls.simulate(differential_drive.plant(), drive_solution, disturbances=[ControlNoise(0.05)], seed=3)


@pytest.fixture(scope="module")
def flight(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> ls.Rollout:
    push = Push((0.2, 0.0, 0.0), at=2.0)
    return ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[push], seed=3)


@pytest.fixture(params=["drive", "flight"])
def rollout(request: pytest.FixtureRequest) -> ls.Rollout:
    return request.getfixturevalue(request.param)


BARE: tuple[Overlay, ...] = tuple(one for one in OVERLAYS if one != "caption")  # the whole picture is one pane


def overlays_of(run: ls.Rollout, *show: Overlay, **options: Any) -> Overlays:
    return Overlays(RecordedTrial(run, 0), show, Scale(1.0, 1.0), **options)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(int)


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]


LOFT = sled(
    "xy", name="cart", geom='type="box" size=".1 .05 .05" mass="1"', carried='<joint name="turn" axis="0 0 1"/>',
    things="""<light pos="0 0 3"/><geom name="cone" type="ellipsoid" size=".2 .1 .1" pos="-.5 .4 .1" euler="0 0 30"/>
      <body pos="0 0 .3" euler="20 40 60"><geom name="beam" type="box" size=".1 .2 .3" pos=".6 .1 0"/></body>""",
    actuators=motors(("x", "y", "turn")), compiler="",
)  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("kind", ["quadrotor", "mjcf"])
def test_pictures_have_the_obstacles_where_they_were_in_the_trial(kind: str, seed: int, tmp_path: Path) -> None:
    """MuJoCo's distances in the model that is drawn are the recorded clearance, also after saving and loading."""
    if kind == "mjcf":
        (tmp_path / "loft.xml").write_text(LOFT)
        robot = ls.MjcfRobot(tmp_path / "loft.xml")
        plant, own, plan = ls.Plant(robot, robot.scene), "cart", track(robot, np.zeros(6), np.full((20, 3), 0.3), 0.02)
    else:
        plant, own, plan = ls.scenarios.quadrotor().plant(), "quadrotor_sphere", hover(20)
    run = ls.simulate(plant, plan, disturbances=[DisplacedObstacles(0.1)], trials=3, seed=seed, contacts=False)
    run = ls.load(ls.save(run, tmp_path / "run.npz"), ls.Rollout)
    assert run.obstacle_geoms is not None
    for k in range(3):
        model = RecordedTrial(run, k).model
        data, cart = mujoco.MjData(model), model.geom(own).id
        solid = [geom for geom in run.obstacle_geoms if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE.value]
        for knot, row in enumerate(np.abs(run.frame_times - run.times[:, None]).argmin(axis=1)):
            data.qpos[:] = run.frames[k, row]
            mujoco.mj_kinematics(model, data)
            near = min(mujoco.mj_geomDistance(model, data, cart, geom, 9.0, None) for geom in solid)
            np.testing.assert_allclose(near, run.clearance[k, knot], rtol=0, atol=1e-6)


@draws
@pytest.mark.parametrize(
    ("kind", "size", "area"),
    [
        ("box", (0.2, 0.1, 0.05), 0.08),
        ("capsule", (0.1, 0.2, 0), np.pi * 0.01),  # upright, seen from above
        *rarely(("sphere", (0.2, 0, 0), np.pi * 0.04), ("cylinder", (0.1, 0.3, 0), np.pi * 0.01)),
    ],
)
def test_obstacles_that_move_are_drawn_where_they_are(
    kind: str, size: tuple[float, float, float], area: float, drive_solution: ls.Solution, tmp_path: Path
) -> None:
    """By the pixels that they change in an orthographic picture, also after saving and loading."""
    begin, velocity = np.array([1.4, -2.4, 0.4]), np.array([-0.02, 0.03, 0.0])
    moving = ls.World([ls.Obstacle("it", kind, begin, np.eye(3), np.array(size), velocity)])
    plant = ls.scenarios.differential_drive().plant()
    run = ls.simulate(plant, drive_solution, moving=moving, contacts=False)
    run = ls.load(ls.save(run, tmp_path / "run.npz"), ls.Rollout)
    camera = cameras.calibrated("top", run)
    options: dict = {"camera": "top", "overlays": (), "size": (640, 480), "quality": "draft"}
    for time in (0.0, 5.0):
        both = [
            pixels(render(one, tmp_path / "still.png", time=time, **options))
            for one in (run, dataclasses.replace(run, moving=None))
        ]
        rows, columns = np.nonzero(np.abs(both[0] - both[1]).max(axis=2) > 3)
        seen = np.array([columns.mean(), rows.mean()]) + 0.5
        wanted = camera.project(begin + time * velocity, (640, 480))
        np.testing.assert_allclose(seen, wanted, atol=1.0)
        assert abs(len(rows) * (camera.height / 480) ** 2 / area - 1) < 0.1


@draws
def test_video_is_what_browsers_play(rollout: ls.Rollout, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    path = render(rollout, tmp_path / "run.mp4", size=SMALL, fps=1, progress=lambda *call: calls.append(call))
    assert path == tmp_path / "run.mp4"
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == SMALL
        assert stream.average_rate == 1
        times = [float(frame.time or 0.0) for frame in container.decode(video=0)]
    # Real time: the last frame shows the last moment that falls on a frame.
    assert times == pytest.approx(np.arange(len(times)), abs=1e-6)
    assert rollout.times[-1] - 1 < times[-1] <= rollout.times[-1] + 1e-6
    assert calls == [(number + 1, len(times)) for number in range(len(times))]
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a player would have to load all of it first"


@draws
@pytest.mark.parametrize(("rollout", "fps"), [("drive", 0.7), *rarely(("flight", 3))], indirect=["rollout"])
def test_frames_show_their_moment_at_any_rate(rollout: ls.Rollout, fps: float, tmp_path: Path) -> None:
    look: dict = {"size": SMALL, "overlays": ("plan", "ghost", "trace")}
    frames = decode(render(rollout, tmp_path / "run.mp4", fps=fps, **look))
    for number in (0, len(frames) // 2, len(frames) - 1):
        path = render(rollout, tmp_path / "still.png", time=number / fps, **look)
        # Compared where they differ most, which is where the robot is; the rest is the same at any time. What
        # h264 loses there is a third or less of what one frame of motion changes.
        assert 2 * difference(frames[number], pixels(path)) < difference(frames[number - 1], pixels(path))


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """The largest mean absolute difference of two pictures over a block of 8 x 8 pixels."""
    change = np.abs(first - second).mean(axis=2)[:176]
    return float(change.reshape(22, 8, -1, 8).mean(axis=(1, 3)).max())


@draws
@pytest.mark.parametrize("rollout", ["flight", *rarely("drive")], indirect=True)
def test_robot_is_seen_throughout(rollout: ls.Rollout) -> None:
    """Where its geoms are, painting it changes what the default camera sees, obstacles before it or not."""
    with (
        open_picture(rollout, size=(640, 360), overlays=BARE) as drawn,
        mujoco.Renderer(drawn.parts[0].model, 360, 640) as segmenter,
    ):
        segmenter.enable_segmentation_rendering()
        renderer = drawn.parts[0]
        model = renderer.model
        robot = np.isin(model.geom_group, (0, 1, 2)) & (model.body_weldid[model.geom_bodyid] != 0)
        painted, material = model.geom_rgba.copy(), model.geom_matid.copy()

        def hide(geoms: np.ndarray) -> None:
            model.geom_rgba[:], model.geom_matid[:] = painted, material
            model.geom_matid[geoms], model.geom_rgba[geoms] = -1, (0, 0, 0, 0)

        for time in np.linspace(0, rollout.times[-1], 8):
            hide(~robot)
            masked = segmented(segmenter, renderer.recorded, time)
            hide(np.zeros(0, dtype=int))
            seen = drawn.draw(time).astype(int)
            hide(robot)
            unseen = drawn.draw(time).astype(int)
            assert masked.sum() > 30, f"at {time:.2f} s"
            changed = np.abs(seen - unseen).max(axis=2)[masked] > 20
            assert changed.mean() > 0.4, f"at {time:.2f} s"


def segmented(renderer: mujoco.Renderer, recorded: RecordedTrial, time: float) -> np.ndarray:
    """Which pixels of the overview show a geom."""
    data = mujoco.MjData(renderer.model)
    recorded.pose(data, time)
    renderer.update_scene(data, "overview")
    return renderer.render()[..., 1] == mujoco.mjtObj.mjOBJ_GEOM.value


@draws
def test_plan_and_trace_are_drawn(drive: ls.Rollout, tmp_path: Path) -> None:
    # Moved a quarter of a metre aside, and so in the colour of a large error, which is yellow.
    states = drive.states + np.array([0.25, 0.0, 0.0])
    moved = dataclasses.replace(drive, states=states)

    def count(time: float) -> tuple[int, int]:
        image = pixels(render(moved, tmp_path / "still.png", time=time, size=(640, 360), overlays=BARE))
        red, green, blue = np.moveaxis(image, 2, 0)
        plan = (red > 120) & (green < 90) & (blue > 50) & (red > 1.4 * blue)
        trace = (red > 140) & (green > 120) & (blue < 0.75 * green) & (red < 1.5 * green)
        return int(plan.sum()), int(trace.sum())

    (plan_early, trace_early), (plan_late, trace_late) = count(1.0), count(24.0)
    assert min(plan_early, plan_late) > 300
    assert trace_late > trace_early + 300


@draws
@pytest.mark.parametrize("rollout", ["flight", *rarely("drive")], indirect=True)
def test_same_rollout_gives_the_same_pictures(rollout: ls.Rollout, tmp_path: Path) -> None:
    """But for single pixels: OpenGL does not promise bits, and one machine of several has drawn others, once."""
    one, other = (decode(render(rollout, tmp_path / f"{name}.mp4", size=SMALL, fps=0.4)) for name in "ab")
    assert len(one) == len(other)
    assert max(map(difference, one, other)) < 1
    one, other = (pixels(render(rollout, tmp_path / f"{name}.png", every=2, size=SMALL)) for name in "ab")
    assert difference(one, other) < 1


@draws
def test_many_disturbances_do_not_fill_a_small_picture(
    quadrotor: ls.Scenario, quadrotor_solution: ls.Solution, tmp_path: Path
) -> None:
    """All of a preset, which takes more lines than there is room for: the rest is counted; GIFs can be read."""
    plant = quadrotor.plant()
    run = ls.simulate(plant, quadrotor_solution, disturbances=ls.disturbances.preset("light", plant))
    for insets in ((), ("top",)):
        ls.render(run, tmp_path / "a.png", size=(320, 180), insets=insets)
    path = render(run, tmp_path / "a.gif", quality="draft", fps=1)
    with Image.open(path) as image:
        assert image.size == (480, 270)


@draws
@pytest.mark.parametrize(
    "body",
    [
        '<geom size=".1" mass="1"/>',
        '<geom size=".1" pos="0 0 .3" mass="1" contype="0" conaffinity="0"/>',
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>',
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_robot_without_a_radius_is_drawn_and_measured(body: str, tmp_path: Path) -> None:
    """A point for the plan, it is as wide in pictures as its body, or as a point that can be seen."""
    slides = '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
    option = 'timestep="0.02" gravity="0 0 0"'
    text = scene(f'<body name="point">{slides}{body}</body>', motors("xy", (2, 2)), option=option)
    (tmp_path / "point.xml").write_text(text)
    robot = ls.MjcfRobot(str(tmp_path / "point.xml"), body="point", radius=0.0)
    solution = track(robot, np.zeros(4), np.full((20, 2), 1.0), 0.02)
    push = Push((0.1, 0.0, 0.0), at=0.1)
    run = ls.simulate(ls.Plant(robot, robot.scene), solution, disturbances=[push], goal_radius=0.1)
    assert run.radius == 0
    choices: list[tuple[Overlay, ...]] = [("plan", "ghost", "forces"), ()]
    for camera in ("overview", "chase", "top", "side"):
        video = render(run, tmp_path / "run.mp4", size=SMALL, fps=10, camera=camera)
        assert read_metadata(video).markers[0] > 0
        if camera == "top" and "geom" in body:
            assert (found := ls.verify_video(video, run)).passed, str(found)
            assert (found := ls.verify_run(run)).passed, str(found)
        shown, hidden = (
            pixels(render(run, tmp_path / "still.png", size=SMALL, camera=camera, overlays=overlays))
            for overlays in choices
        )
        assert (shown != hidden).any()


@draws
def test_draft_and_gif_show_the_same_run(flight: ls.Rollout, tmp_path: Path) -> None:
    """A GIF loops, in real time, at any rate, and its colours are near those of the video."""
    with Image.open(render(flight, tmp_path / "fast.gif", size=(64, 64), fps=50, speed=25, overlays=())) as image:
        assert {frame.info["duration"] for frame in ImageSequence.Iterator(image)} == {20}
    path = render(flight, tmp_path / "run.gif", quality="draft", fps=3)
    with Image.open(path) as image:
        assert image.size == (480, 270)
        assert image.info["loop"] == 0
        durations, frames = [], []
        for frame in ImageSequence.Iterator(image):
            durations.append(frame.info["duration"])
            frames.append(np.asarray(frame.convert("RGB")).astype(int))
    assert sum(durations) / 1e3 == pytest.approx(len(frames) / 3, abs=0.01)
    assert set(durations) <= {330, 340}
    video = decode(render(flight, tmp_path / "run.mp4", quality="draft", size=(480, 270), fps=3))
    assert len(video) == len(frames)
    assert max(np.abs(one - other).mean() for one, other in zip(frames, video, strict=True)) < 4


@draws
def test_speed_is_seconds_of_the_run_in_one_of_the_video(flight: ls.Rollout, tmp_path: Path) -> None:
    slow = decode(render(flight, tmp_path / "slow.mp4", size=SMALL, fps=2, speed=0.5, overlays=("trace",)))
    fast = decode(render(flight, tmp_path / "fast.mp4", size=SMALL, fps=1, speed=2, overlays=("trace",)))
    assert (len(slow), len(fast)) == (21, 3)
    # The second frame of the fast one shows 2 s, which the slow one does in its ninth.
    assert 3 * difference(slow[8], fast[1]) < difference(slow[8], fast[2])


@draws
def test_video_says_what_it_shows(flight: ls.Rollout, tmp_path: Path) -> None:
    """Two runs, each with the first camera and two calibrated ones: where the panes are, and that they are apart."""
    other = dataclasses.replace(flight, seed=4)
    path = render([flight, other], tmp_path / "run.mp4", size=(640, 360), fps=1, insets=("top", "side"))
    found = read_metadata(path)
    assert found.runs == (digest(flight), digest(other))
    assert (found.rate, found.speed, found.frames) == (1, 1.0, 6)
    assert [pane.run for pane in found.panes] == [0, 0, 0, 1, 1, 1]
    cameras = [None if pane.camera is None else pane.camera.name for pane in found.panes]
    assert cameras == 2 * [None, "top", "side"]
    covered = np.zeros((360, 640), dtype=int)
    for pane in found.panes:
        covered[pane.top : pane.top + pane.height, pane.left : pane.left + pane.width] += 1
    assert covered.max() == 1
    assert covered.mean() > 0.75  # the rest are captions


@draws
@pytest.mark.parametrize("camera", ["overview", *rarely("top", "side", "chase")])
def test_captions_cover_neither_the_plan_nor_one_another(camera: str, flight: ls.Rollout) -> None:
    """Texts are strips beside the panes, and calibrated panes show the whole plan."""
    with open_picture(flight, camera=camera, size=(640, 360), insets=("top",)) as drawn:
        (part,) = drawn.parts
        assert part.caption is not None
        assert drawn.legend is not None
        for pane, view in part.views:
            assert part.caption.height <= pane.top
            assert part.box.top + pane.top + pane.height <= drawn.size[1] - drawn.legend.height
            if view.camera is not None:
                pixels = view.camera.project(flight.plan.states[:, :3], (pane.width, pane.height))
                assert (pixels > 0).all()
                assert (pixels < [pane.width, pane.height]).all()


@draws
@pytest.mark.parametrize("camera", ["overview", *rarely("top", "side")])
def test_runs_side_by_side_have_one_zoom(camera: str, quadrotor: ls.Scenario, flight: ls.Rollout) -> None:
    """The farther run is what both panes show, and a metre of both has as many pixels."""
    far = dataclasses.replace(flight, states=flight.states + np.r_[[3.0, 0, 0], np.zeros(flight.states.shape[2] - 3)])
    with open_picture([flight, far], camera=camera, size=(640, 360)) as drawn:
        drawn.draw(0.0)
        seen = [part.scene.camera[0] for part in drawn.parts]
        for name in ("pos", "forward", "frustum_top", "orthographic"):
            np.testing.assert_allclose(*(getattr(one, name) for one in seen), rtol=1e-6, atol=0)
    with open_picture(flight, camera=camera, size=(320, 360)) as alone:
        alone.draw(0.0)
        before = alone.parts[0].scene.camera[0]
        assert before.frustum_top != seen[0].frustum_top or not np.allclose(before.pos, seen[0].pos)


@draws
def test_captions_of_narrow_parts_are_not_cut_off(flight: ls.Rollout) -> None:
    """No ink in the last columns of a caption's strip: what is too long for one line goes on in the next."""
    with open_picture([flight] * 3, size=(720, 360)) as drawn:
        for time in (0.0, drawn.end):
            image = drawn.draw(time)
            for part in drawn.parts:
                strip, right = part.views[0][0].top, part.box.left + part.box.width
                assert strip > 0
                assert image[:strip, part.box.left + 1 : right].min() < 100  # there is ink
                assert image[:strip, right - 3 : right].min() > 200


@draws
@pytest.mark.parametrize("camera", ["side", *rarely("top")])
def test_marker_is_where_the_calibration_says(camera: str, rollout: ls.Rollout, tmp_path: Path) -> None:
    """Green pixels of a pane, against where the camera's own formula sees the marker on the simulator's body."""
    with open_picture(rollout, insets=(camera,), size=(640, 360)) as drawn:
        pane, data = drawn.panes[1], mujoco.MjData(drawn.parts[0].recorded.model)
        assert pane.camera is not None
        for time in (0.0, 2.0, 4.5):
            drawn.parts[0].recorded.pose(data, time)
            want = pane.camera.project(data.xpos[drawn.parts[0].recorded.robot], (pane.width, pane.height))
            area = drawn.draw(time)[pane.top : pane.top + pane.height, pane.left : pane.left + pane.width].astype(int)
            green = area[..., 1] - area[..., [0, 2]].max(axis=2) > 70
            rows, columns = np.nonzero(green)
            assert len(rows) >= 3, f"at {time:g} s"
            # A ball of a few pixels is not quite round.
            assert np.abs([columns.mean() + 0.5 - want[0], rows.mean() + 0.5 - want[1]]).max() < 0.5, f"at {time:g} s"


@draws
def test_each_overlay_is_seen(flight: ls.Rollout, quadrotor_solution: ls.Solution, tmp_path: Path) -> None:
    """Each changes the picture, and only where it is: a few percent of it. Captions take room from the scene."""
    tube = np.tile(np.diag([0.01, 0.02, 0.01]), (len(flight.times), 1, 1))
    noisy = dataclasses.replace(flight, measured=flight.states + 0.05 * np.sin(np.arange(12)), tube=tube)
    funnel = funnel_by_hand(quadrotor_solution, 0.04 * np.eye(3), knots=(0, 100), levels=(1.0, 1.0))

    def shown(*overlays: Overlay) -> np.ndarray:
        options: dict = {"time": 2.1, "size": (480, 270), "overlays": overlays}
        options |= {"solution": quadrotor_solution} if "cost_tube" in overlays else {}
        options |= {"funnel": funnel} if "funnel" in overlays else {}
        return pixels(render(noisy, tmp_path / "still.png", **options))

    bare = shown()
    for overlay in OVERLAY_KINDS:
        changed = (np.abs(shown(overlay) - bare).max(axis=2) > 10).mean()
        assert 1e-4 < changed < (1.0 if overlay == "caption" else 0.05), overlay
    moved = dataclasses.replace(flight.plan, states=flight.plan.states + 0.1)
    options: dict = {"overlays": ("cost_tube",), "size": SMALL}
    with pytest.raises(ls.InputError, match="solution: got a plan other than"):
        render(dataclasses.replace(flight, plan=moved), tmp_path / "a.png", solution=quadrotor_solution, **options)
    with pytest.raises(ls.InputError, match="solution: got None with the overlay cost_tube"):
        render(flight, tmp_path / "a.png", **options)


@pytest.mark.parametrize("name", DRAWN_BY)
@pytest.mark.parametrize("several", [False, True])
def test_what_no_overlay_draws_is_refused(
    flight: ls.Rollout, quadrotor_solution: ls.Solution, tmp_path: Path, name: str, several: bool
) -> None:
    funnel = funnel_by_hand(quadrotor_solution, 0.04 * np.eye(3), knots=(0, 100), levels=(1.0, 1.0))
    given: Any = {"solution": quadrotor_solution, "funnel": funnel, "titles": ("a",)}[name]
    given = [None, given] if several and name != "titles" else given
    others: Any = tuple(overlay for overlay in OVERLAY_KINDS if overlay != DRAWN_BY[name])
    message = f"^{name}: got one without {DRAWN_BY[name]} in overlays=, want it with that"
    with pytest.raises(ls.InputError, match=message):
        render([flight] * (1 + several), tmp_path / "a.png", overlays=others, **{name: given})
    if name != "titles" and not several:
        with pytest.raises(ls.InputError, match=message):
            ls.view.render_html(flight, tmp_path / "a.html", overlays=others, **{name: given})


def test_predicted_tube_has_the_half_axes_of_its_covariance(flight: ls.Rollout, drive: ls.Rollout) -> None:
    """Against the covariance: an ellipsoid's points are 2 standard deviations off the plan, in every direction."""
    rng = np.random.default_rng(1)
    for run, size in ((flight, 3), (drive, 2)):
        factors = 0.1 * rng.normal(size=(len(run.times), size, size))
        tube = factors @ factors.transpose(0, 2, 1)
        assert overlays_of(run, "tube").drawables == []
        (drawn,) = overlays_of(dataclasses.replace(run, tube=tube), "tube").drawables
        assert isinstance(drawn, DrawnTube)
        assert drawn.label.startswith("predicted: 2 sigma, 95 % in each direction")
        each = drawn.knots, drawn.centres, drawn.half_axes, drawn.rotations
        for knot, centre, half_axes, rotation in zip(*each, strict=True):
            assert centre[:size] == pytest.approx(run.plan.states[knot, :size])
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1)
            ends = (rotation * half_axes)[:size, :size].T  # those that are not across the floor
            inverse = np.linalg.inv(tube[knot])
            np.testing.assert_allclose(np.einsum("ki,ij,kj->k", ends, inverse, ends), 4.0, rtol=1e-6)


@draws
def test_half_axes_of_a_tube_in_pixels(flight: ls.Rollout, tmp_path: Path) -> None:
    """One ellipsoid where a plan begins, far from the rest of it, from above: as wide as the camera says."""
    states = np.tile(flight.plan.states[75], (151, 1))
    states[1:, 0] += 10.0
    tube = np.zeros((151, 3, 3))
    tube[0] = np.diag([0.3**2, 0.15**2, 0.1**2])
    run = dataclasses.replace(flight, plan=dataclasses.replace(flight.plan, states=states), tube=tube)
    options: dict = {"camera": "top", "overlays": ("tube",), "size": (1280, 720)}
    with open_picture(run, **options) as drawn:
        with_it = drawn.draw(4.0).astype(int)
        camera, recorded = drawn.panes[0].camera, drawn.parts[0].recorded
        assert camera is not None
        centre = recorded.planned(0.0)
        ends = np.array([centre + sign * 2 * std * axis for std, axis in ((0.3, np.eye(3)[0]), (0.15, np.eye(3)[1]))
                         for sign in (-1, 1)])  # fmt: skip
        places = np.array([camera.project(end, (1280, 720)) for end in ends])
    with open_picture(dataclasses.replace(run, tube=None), **options) as drawn:
        changed = np.abs(with_it - drawn.draw(4.0)).max(axis=2) > 4
    middle = places.mean(axis=0)
    rows, columns = np.nonzero(changed)
    near = (np.abs(columns - middle[0]) < 200) & (np.abs(rows - middle[1]) < 200)
    for axis, found in enumerate((columns[near], rows[near])):
        want = np.ptp(places[:, axis])
        assert want > 40
        assert found.max() - found.min() + 1 == pytest.approx(want, abs=3)  # pixels


def test_what_legends_say_of_tubes_is_said_once(drive: ls.Rollout) -> None:
    """Of a tube that is drawn as a whole and one that ends, the legend has the one that says more."""
    recordings = [
        RecordedTrial(dataclasses.replace(drive, tube=std**2 * np.tile(np.eye(2), (len(drive.times), 1, 1))), 0)
        for std in (0.05, 5.0)
    ]
    # All of the second is too wide; its first knots are not.
    narrow, wide = recordings
    assert wide.rollout.tube is not None
    wide.rollout.tube.setflags(write=True)
    wide.rollout.tube[:50] = 0.01 * np.eye(2)
    overlays = [Overlays(one, ("tube",), Scale(1.0, 1.0)) for one in (narrow, wide)]
    whole, part = (one.drawables[0].label for one in overlays)
    assert part.startswith(f"{whole}; drawn up to ")
    both, second = (Legend(shown, (640, 360)) for shown in (overlays, overlays[1:]))
    assert both.tile is not None
    assert second.tile is not None
    np.testing.assert_array_equal(both.tile, second.tile)


@draws
def test_tube_is_seen_in_a_video(drive: ls.Rollout, tmp_path: Path) -> None:
    tube = dataclasses.replace(drive, tube=np.tile(0.01 * np.eye(2), (len(drive.times), 1, 1)))
    options: dict = {"size": SMALL, "fps": 0.5, "overlays": ("plan", "tube")}
    with_it = decode(render(tube, tmp_path / "with.mp4", **options))
    without = decode(render(drive, tmp_path / "without.mp4", **options))
    assert len(with_it) == len(without)
    assert all((np.abs(a - b).max(axis=2) > 20).mean() > 0.003 for a, b in zip(with_it, without, strict=True))


def test_tube_of_the_cost_is_the_shadow_of_what_the_total_cost_allows(
    flight: ls.Rollout, quadrotor_solution: ls.Solution
) -> None:
    """Against the cost: of all states with a position on the ellipsoid its least is 2 above the least of all."""
    overlays = overlays_of(flight, "cost_tube", solution=quadrotor_solution)
    (tube,) = overlays.drawables
    assert isinstance(tube, DrawnTube)
    assert legend_entries([overlays]) == {"2 sigma of the cost: total ≤ least + 2": colour_of("cost_tube")}
    go, come = quadrotor_solution.cost_to_go, quadrotor_solution.cost_to_come
    assert go is not None
    assert isinstance(come, ls.types.Moments)
    knots = tube.knots
    assert (knots[0], knots[-1]) == (0, flight.plan.steps)
    for number in (3, 12, 20):
        centre, half_axes, rotation = tube.centres[number], tube.half_axes[number], tube.rotations[number]
        knot = knots[number]
        hessian = go.hessian[knot] + np.linalg.inv(come.covariance[knot])
        shown, hidden = hessian[:3, :3], hessian[3:, 3:]
        cross = hessian[:3, 3:]
        for axis in range(3):
            step = half_axes[axis] * rotation[:, axis]
            rest = -np.linalg.solve(hidden, cross.T @ step)
            least = 0.5 * (step @ shown @ step + 2 * step @ cross @ rest + rest @ hidden @ rest)
            # Inverting the covariance costs some of the digits.
            assert least == pytest.approx(2.0, rel=1e-4)
        best = ls.types.TotalCost(go, come).minimizer()[knot, :3]
        assert centre == pytest.approx(best, abs=1e-12)


@draws
def test_robot_is_shown_several_times(flight: ls.Rollout, tmp_path: Path) -> None:
    once = pixels(render(flight, tmp_path / "once.png", size=(640, 360)))
    often = pixels(render(flight, tmp_path / "often.png", every=1, size=(640, 360)))
    assert (np.abs(once - often).max(axis=2) > 20).sum() > 5 * 60


@draws
def test_picture_may_exceed_the_buffer_of_the_model(drive: ls.Rollout, tmp_path: Path) -> None:
    small = drive.model.replace('offwidth="1920" offheight="1080"', 'offwidth="64" offheight="64"')
    assert small != drive.model
    path = render(dataclasses.replace(drive, model=small), tmp_path / "still.png", size=SMALL)
    assert pixels(path).shape == (180, 320, 3)


@draws
def test_diverged_trial_stands_still(flight: ls.Rollout, tmp_path: Path) -> None:
    states, frames = flight.states.copy(), flight.frames.copy()
    states[:, 60:], frames[:, flight.frame_times > 2.0] = np.nan, np.nan
    broken = dataclasses.replace(flight, states=states, frames=frames, diverged_at=np.array([2.0]))
    images = [pixels(render(broken, tmp_path / "still.png", time=time, size=SMALL)) for time in (3.0, 5.0)]
    # The captions, upper left, tell the time; the marks of the plan move on.
    assert (np.abs(images[0] - images[1])[70:].max(axis=2) > 20).mean() < 0.02
    lost = dataclasses.replace(broken, states=np.full_like(states, np.nan), frames=np.full_like(frames, np.nan))
    with pytest.raises(ls.InputError, match="without a finite state"):
        render(lost, tmp_path / "still.png", size=SMALL)


@draws
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (641, 360)}, "size: got 641 x 360, want even numbers"),
        ({"size": (640,)}, "size: got 1 entries, want 2"),
        ({"size": (32, 360)}, r"size\[0\]: got 32, want a whole number >= 64"),
        ({"size": (64, 64)}, "size: got 64 x 64, which captions would fill, want it larger"),
        ({"camera": "overvew"}, r"camera: got 'overvew', want one of: .*top.*did you mean overview"),
        ({"insets": ("top", "above")}, "camera: got 'above', want one of: overview, chase, top, side"),
        ({"insets": ("top", "side", "chase", "top")}, "insets: got 4, want 3 at most"),
        ({"overlays": ("plan", "glost")}, r"overlays\[1\]: got 'glost', want one of: .*did you mean ghost"),
        ({"quality": "good"}, "quality: got 'good', want one of: draft, standard, publication"),
        ({"titles": ("one", "two")}, "titles: got 2, want one for each of 1 runs"),
        ({"trial": ()}, "trial: got none, want 1 to 6"),
        ({"speed": 0}, "speed: got 0, want"),
        ({"trial": 1}, "trial: got 1, want one of 0 to 0"),
        ({"fps": 0}, "fps: got 0, want"),
        *(({"path": "a.gif", "fps": fps}, "fps: got .*, want at most 50 for a GIF") for fps in (50.1, 60, 240)),
        ({"path": "run.avi"}, "path: got .*run.avi', want a name that ends in .mp4, .gif, .png"),
        ({"path": "file/run.mp4"}, "want a file that can be written"),
    ],
)
def test_bad_input_gets_one_line(options: dict, message: str, drive: ls.Rollout, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    path = tmp_path / options.pop("path", "run.mp4")
    with pytest.raises(ls.InputError, match=message):
        render(drive, path, **{"size": SMALL, **options})
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


@draws
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": 26.0}, "time: got 26.0, want a finite number >= 0 and <= 25"),
        ({"every": 0}, "every: got 0, want a finite number >= 0.5"),
        *[
            ({"path": path, **options}, f"fps, speed: got '{path}', want FILE.mp4 or FILE.gif: they belong to videos")
            for options in ({"fps": 30}, {"speed": 2}, {"fps": 0.5, "speed": 0.1})
            for path in ("a.png", "b.PNG")
        ],
        ({"path": "still.gif", "time": 1.0}, "time, every: got 'still.gif', want FILE.png: they belong to stills"),
    ],
)
def test_bad_input_for_a_still(options: dict, message: str, drive: ls.Rollout, tmp_path: Path) -> None:
    with pytest.raises(ls.InputError, match=message):
        render(drive, tmp_path / options.pop("path", "still.png"), **{"size": SMALL, **options})


@pytest.mark.parametrize("model", ["<mujoco><worldbody>", "<mujoco/>"])
def test_model_that_does_not_fit(model: str, drive: ls.Rollout, tmp_path: Path) -> None:
    with pytest.raises(ls.InputError, match=r"rollout\.(model|body|frames): got"):
        render(dataclasses.replace(drive, model=model), tmp_path / "run.mp4")
    assert list(tmp_path.iterdir()) == []


@draws
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_interrupted_video_leaves_nothing(error: type[BaseException], drive: ls.Rollout, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == 3:
            raise error

    with pytest.raises(error):
        render(drive, tmp_path / "run.mp4", size=SMALL, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("choice", ["", "off"])
def test_without_opengl_the_message_says_what_to_do(
    choice: str, drive: ls.Rollout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(gl, "find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", choice)
    gl.bind.cache_clear()
    try:
        assert gl.missing()
        with pytest.raises(ls.InputError, match=r"apt-get install -y libegl1|want it unset"):
            render(drive, tmp_path / "run.mp4")
    finally:
        gl.bind.cache_clear()
    assert list(tmp_path.iterdir()) == []


def test_import_leaves_the_environment_alone() -> None:
    code = "import os; before = dict(os.environ); import lqrsim.view.render; print(before == dict(os.environ))"
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["True"]


def test_a_rope_is_drawn_between_its_sites(tmp_path: Path) -> None:
    """In a picture's pose its points are those of MuJoCo's own forward kinematics."""
    path = tmp_path / "pendulum.xml"
    rope = '<tendon><spatial name="rope"><site site="top"/><site site="eye"/></spatial></tendon>'
    text = sled(geom='size="0.1"', carried='<site name="eye"/>', things='<site name="top" pos="0 0 1"/>', more=rope)
    path.write_text(text, encoding="utf-8")
    robot = ls.MjcfRobot(path)
    run = ls.simulate(ls.Plant(robot, robot.scene), track(robot, robot.at(), np.full((30, 1), 30.0), 0.01))
    recorded = RecordedTrial(run, 0)
    data, whole = mujoco.MjData(recorded.model), mujoco.MjData(recorded.model)
    recorded.pose(data, run.times[-1])
    whole.qpos[:] = data.qpos
    mujoco.mj_forward(recorded.model, whole)
    assert whole.ten_length[0] > 1.04  # it has moved by 0.3 m to the side
    np.testing.assert_array_equal(data.wrap_xpos, whole.wrap_xpos)
    assert data.ten_wrapnum[0] == 2

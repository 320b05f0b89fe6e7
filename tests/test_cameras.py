"""Calibrated cameras, against MuJoCo's own pictures, and what videos say of themselves."""

import dataclasses
import json
from fractions import Fraction
from pathlib import Path

import av
import mechanisms
import mujoco
import numpy as np
import pytest
from sampling import rarely

import lqrsim as ls
from lqrsim.results.rollout import BallRecord
from lqrsim.view import cameras, gl
from lqrsim.view.cameras import MARK_RGB, Camera, draw_mark, mark_radius
from lqrsim.view.picture import Pane
from lqrsim.view.recorded_trial import RecordedTrial, drawn_size
from lqrsim.view.render import VideoMetadata, digest, encoder, read_metadata

draws = pytest.mark.skipif(bool(gl.missing()), reason=f"no OpenGL here: {gl.INSTALL}")
TILTED = Camera("tilted", (3.0, -4.0, 5.0), (0.0, 0.6, -0.8), (0.0, 0.8, 0.6), 4.0)


@pytest.fixture(scope="module", params=["differential_drive", "quadrotor"])
def rollout(request: pytest.FixtureRequest) -> ls.Rollout:
    name = {"differential_drive": "drive_solution", "quadrotor": "quadrotor_solution"}[request.param]
    scenario = request.getfixturevalue(request.param)
    solution = request.getfixturevalue(name)
    return ls.simulate(scenario.plant(), solution, disturbances=scenario.disturbances, seed=1, trials=2)


@draws
@pytest.mark.parametrize("size", [(640, 480), (320, 480)])
@pytest.mark.parametrize("kind", ["top", "side", "tilted"])
def test_projection_is_where_mujoco_draws(kind: str, size: tuple[int, int], rollout: ls.Rollout) -> None:
    gl.bind()
    aspect = size[0] / size[1]
    camera = TILTED if kind == "tilted" else cameras.calibrated(kind, rollout, aspect)
    # A cross of balls over the picture, at different depths, which an orthographic picture does not show.
    across, depth = np.array([[0, 0], [0.4, 0.1], [-0.45, 0.3], [0.2, -0.45], [-0.3, -0.4]]), [10, 7, 12, 9, 15]
    right, up = camera.axes
    places = [
        np.array(camera.position) + camera.height * (aspect * x * right + y * up) + far * np.array(camera.forward)
        for (x, y), far in zip(across, depth, strict=True)
    ]
    model = mujoco.MjModel.from_xml_string(
        mechanisms.scene("<body/>", before='<visual><quality offsamples="0"/></visual>')
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        for place in places:
            renderer.update_scene(data)
            scene = renderer.scene
            ball, colour = np.full(3, 0.03 * camera.height), np.ones(4, dtype=np.float32)
            mujoco.mjv_initGeom(scene.geoms[0], mujoco.mjtGeom.mjGEOM_SPHERE, ball, place, np.eye(3).ravel(), colour)
            scene.ngeom = 1
            camera.place(scene, aspect)
            rows, columns = np.nonzero(renderer.render().max(axis=2))
            assert len(rows) == pytest.approx(np.pi * (0.03 * size[1]) ** 2, rel=0.1)
            seen = np.array([columns.mean(), rows.mean()]) + 0.5
            # Whole pixels of a ball 29 wide: its middle is known to a tenth of one.
            np.testing.assert_allclose(seen, camera.project(place, size), rtol=0, atol=0.1)
            tenth = 0.1 * camera.height / size[1]
            np.testing.assert_allclose(camera.measure(seen, size), camera.axes @ place, rtol=0, atol=tenth)


def test_measure_is_the_inverse_of_project() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    pixels = TILTED.project(points, (640, 480))
    np.testing.assert_allclose(TILTED.measure(pixels, (640, 480)), points @ TILTED.axes.T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("aspect", [0.75, 4 / 3, 16 / 9])
def test_fixed_cameras_see_the_whole_run(aspect: float, rollout: ls.Rollout) -> None:
    size = (round(1000 * aspect), 1000)
    position = list(rollout.state_coordinates.position)
    for camera in (cameras.calibrated("top", rollout, aspect), cameras.calibrated("side", rollout, aspect)):
        for states in (rollout.plan.states, *rollout.states):
            places = np.zeros((len(states), 3))
            places[:, : len(position)] = states[:, position]
            margin = rollout.radius / camera.height * 1000
            pixels = camera.project(places, size)
            assert (pixels > margin).all()
            assert (pixels < np.array(size) - margin).all()


@pytest.mark.parametrize("aspect", [0.75, 16 / 9])
@pytest.mark.parametrize("seed", range(3))
def test_fixed_cameras_see_all_balls_of_a_robot(aspect: float, seed: int, rollout: ls.Rollout) -> None:
    """As of a forklift, whose fork is far ahead of its position; also where a trial ends early."""
    rng = np.random.default_rng(seed)
    turned, radii = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.uniform(0.1, 0.4, 3)
    about = 5 * rollout.radius * np.array([[1.0, 0, 0], [0, 0, 0], [-0.5, 0.2, 0]]) @ turned
    planned = rollout.in_world(rollout.planned_places)[:, None] + about
    driven = np.stack([rollout.in_world(rollout.places(k))[:, None] + about for k in range(rollout.trials)])
    driven[0, 40:] = np.nan
    balls = BallRecord(planned=planned, driven=driven, radii=radii, anchors=np.full((3, 4), np.nan))
    long, size = dataclasses.replace(rollout, balls=balls), (round(1000 * aspect), 1000)
    for camera in (cameras.calibrated("top", long, aspect), cameras.calibrated("side", long, aspect)):
        for centres in (planned, *driven):
            pixels, margin = camera.project(centres, size), radii[:, None] / camera.height * 1000
            shown = np.isfinite(centres).all(axis=2)
            assert (pixels - margin)[shown].min() > -1e-6
            assert (pixels + margin - np.array(size))[shown].max() < 1e-6


def test_a_diverged_trial_does_not_hide_the_others(rollout: ls.Rollout) -> None:
    states = rollout.states.copy()
    states[0, 40:] = np.nan
    assert np.isfinite(cameras.calibrated("top", dataclasses.replace(rollout, states=states)).position).all()


def metadata(rollout: ls.Rollout) -> VideoMetadata:
    mark = mark_radius(RecordedTrial(rollout, 0))
    panes = (
        Pane(0, 0, 320, 240, camera=cameras.calibrated("top", rollout)),
        Pane(320, 0, 320, 240, trial=1, camera=cameras.calibrated("side", rollout)),
        Pane(0, 240, 640, 240),
    )
    return VideoMetadata((digest(rollout),), (mark,), Fraction(30000, 1001), 0.5, 3, panes)


def test_footage_survives_its_file(rollout: ls.Rollout, tmp_path: Path) -> None:
    written = metadata(rollout)
    path = tmp_path / "run.mp4"
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        container.metadata["comment"] = written.as_json()
        stream = container.add_stream("libx264", rate=written.rate)
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for _ in range(written.frames):
            frame = av.VideoFrame.from_ndarray(np.zeros((480, 640, 3), dtype=np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert read_metadata(path) == written
    np.testing.assert_allclose(written.times(), np.arange(3) * 0.5 * 1001 / 30000)


def test_other_files_are_refused(rollout: ls.Rollout, tmp_path: Path) -> None:
    with pytest.raises(ls.InputError, match="want a file that exists"):
        read_metadata(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(ls.InputError, match="want one that can be read"):
        read_metadata(tmp_path / "text.mp4")
    good = metadata(rollout)
    with encoder(tmp_path / "latin.mp4", (64, 64), Fraction(10), crf=20, preset="ultrafast", metadata=good) as encode:
        encode(np.zeros((64, 64, 3), dtype=np.uint8))
    content = (tmp_path / "latin.mp4").read_bytes()
    (tmp_path / "latin.mp4").write_bytes(content.replace(b'{"format', b"Mus\xe9es "))  # of another program, in Latin-1
    with pytest.raises(ls.InputError, match="want a video of `lqrsim render`"):
        read_metadata(tmp_path / "latin.mp4")
    with pytest.raises(ls.InputError, match="want a video of `lqrsim render`"):
        VideoMetadata.from_json(100_000 * "[")
    with encoder(tmp_path / "other.mp4", (64, 64), Fraction(10), crf=20, preset="ultrafast") as encode:
        encode(np.zeros((64, 64, 3), dtype=np.uint8))
    with pytest.raises(ls.InputError, match="want a video of `lqrsim render`"):
        read_metadata(tmp_path / "other.mp4")
    good = json.loads(metadata(rollout).as_json())
    for change, message in [
        ({"version": 99}, "got version 99"),
        ({"frames": 0}, "metadata: VideoMetadata: frames: got 0"),
        *[
            ({"rate": bad}, "damaged")
            for bad in (
                "30/0",
                "1e99999",
                10**400,
                float("inf"),
                float("nan"),
                "inf",
                "-1",
                "",
                " 1",
                "1/",
                None,
                [1],
                3.5,
            )
        ],
        ({"markers": []}, "whose parts do not fit together"),
        ({"panes": [{"left": 0}]}, r"metadata\.panes\.0\.top: got nothing, want this field"),
    ]:
        with pytest.raises(ls.InputError, match=message):
            VideoMetadata.from_json(json.dumps(good | change))
    good["panes"][0]["camera"]["up"] = [0, 0, 1]
    with pytest.raises(ls.InputError, match="want orthogonal unit vectors"):
        VideoMetadata.from_json(json.dumps(good))


def test_digest_tells_runs_apart(rollout: ls.Rollout) -> None:
    plan = dataclasses.replace(rollout.plan, states=rollout.plan.states + 1e-9)
    others = [
        dataclasses.replace(rollout, plan=plan),
        dataclasses.replace(rollout, states=rollout.states[::-1]),
        dataclasses.replace(rollout, applied=rollout.applied * (1 + 1e-12)),
        dataclasses.replace(rollout, seed=rollout.seed + 1),
    ]
    assert len({digest(rollout), *map(digest, others)}) == 5
    assert digest(dataclasses.replace(rollout, states=rollout.states.copy())) == digest(rollout)


@draws
@pytest.mark.parametrize("kind", ["top", *rarely("side")])
def test_mark_is_seen_where_the_robot_is_whatever_hides_it(kind: str, rollout: ls.Rollout) -> None:
    """In its colour to the last bit, in light and shade, before the sky and behind beams."""
    gl.bind()
    camera, size, mark = cameras.calibrated(kind, rollout), (640, 480), mark_radius(RecordedTrial(rollout, 0))
    model = mujoco.MjModel.from_xml_string(rollout.model)
    model.vis.quality.offsamples = 0
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        for frame in rollout.frames[0, ::30]:
            data.qpos = frame
            mujoco.mj_forward(model, data)
            renderer.update_scene(data)
            centre = data.body(rollout.body).xpos
            draw_mark(renderer.scene, camera, centre, mark)
            camera.place(renderer.scene, size[0] / size[1])
            rows, columns = np.nonzero((renderer.render() == 255 * np.array(MARK_RGB)).all(axis=2))
            assert len(rows) == pytest.approx(np.pi * (mark * size[1] / camera.height) ** 2, rel=0.15)
            seen = np.array([columns.mean(), rows.mean()]) + 0.5
            np.testing.assert_allclose(seen, camera.project(centre, size), rtol=0, atol=0.3)


@pytest.mark.parametrize(("kind", "sizes"), [("cylinder", "0.2 0.1"), ("box", "0.2 0.15 0.1"), ("sphere", "0.2")])
@pytest.mark.parametrize("reach", [0.6, 1.5])
@pytest.mark.parametrize("turn", ["0 0 0", "0 0 90"])
def test_what_stands_for_a_robot_is_as_wide_as_its_base_and_not_as_its_arms_reach(
    kind: str, sizes: str, reach: float, turn: str, rollout: ls.Rollout
) -> None:
    capsule = f'<geom type="capsule" fromto="0 0 0.05 {reach} 0 0.05" size="0.02" mass="0.1"/>'
    xml = mechanisms.sled(
        "xy", name="base", place="0 0 0.2", geom=f'type="{kind}" size="{sizes}" mass="5" euler="{turn}"',
        carried=f'<body name="arm" pos="0 0 0.1"><joint name="turn" axis="0 0 1"/>{capsule}</body>',
        things='<geom type="plane" size="5 5 0.1"/><geom type="cylinder" size="0.1 0.5" pos="4 3 0.5"/>', compiler="",
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(xml)
    run = dataclasses.replace(rollout, radius=reach + 0.02)
    assert drawn_size(model, run, model.body("base").id) == pytest.approx(0.2, rel=1e-6)
    # A radius that is the base's own is what is drawn.
    whole = dataclasses.replace(rollout, radius=0.25)
    assert drawn_size(model, whole, model.body("base").id) == 0.25


def test_marks_and_planned_places_of_packaged_robots_have_their_radius(rollout: ls.Rollout) -> None:
    recorded = RecordedTrial(rollout, 0)
    assert mark_radius(recorded) == 0.25 * rollout.radius
    assert recorded.ghost_radius == rollout.radius
    # Of a robot whose radius were a reach, both would be as small as its body.
    armed = RecordedTrial(dataclasses.replace(rollout, radius=1.5), 0)
    assert mark_radius(armed) == 0.25 * armed.ghost_radius
    assert armed.ghost_radius == pytest.approx(rollout.radius, rel=0.2)

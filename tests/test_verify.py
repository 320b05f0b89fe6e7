"""Verification from pixels: honest runs and videos pass with room to spare, and every fault is told."""

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import motors, scene
from sampling import examples, rarely
from tracking import weave

import lqrsim as ls
from lqrsim import verify
from lqrsim.cli import main
from lqrsim.verify import check_plan, run_beside
from lqrsim.view import cameras, gl, recorded_trial
from lqrsim.view.cameras import Camera
from lqrsim.view.recorded_trial import model_of
from lqrsim.view.render import VideoMetadata, digest, read_metadata

faults: Any = importlib.import_module("injected_faults")  # of experiments/, whose benchmark makes them at full size

pytestmark = pytest.mark.skipif(bool(gl.missing()), reason=f"no OpenGL here: {gl.INSTALL}")

ROBOTS = ("quadrotor", "differential_drive")
# Metres; the first as the packaged robots are verified, rms and at worst, the second of videos.
BOUNDS = {"quadrotor": (0.005, 0.010), "differential_drive": (0.003, 0.005)}
BEGINNING = 50  # control periods, a third of all


@dataclasses.dataclass(frozen=True)
class Case:
    """A disturbed run, the same with another seed, and the video of the first, small, in its file and decoded."""

    name: str
    solution: ls.Solution
    run: ls.Rollout
    other: ls.Rollout
    video: Path
    frames: list[np.ndarray]
    metadata: VideoMetadata

    def beginning(self, frames: np.ndarray | None = None) -> ls.Rollout:
        """The beginning of the run, as if it had diverged then, which is as good for faults; or with other frames."""
        frames = (self.run.frames if frames is None else frames[None]).copy()
        states = self.run.states.copy()
        frames[:, self.run.frame_times > self.run.times[BEGINNING] + 1e-9], states[:, BEGINNING + 1 :] = np.nan, np.nan
        return dataclasses.replace(self.run, states=states, frames=frames, diverged_at=self.run.times[[BEGINNING + 1]])


@pytest.fixture(scope="module", params=[ROBOTS[0], *rarely(ROBOTS[1])])
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Overlays and shadows are on, and the robot's mark is five pixels wide or so."""
    name = request.param
    scenario: ls.Scenario = request.getfixturevalue(name)
    solution = request.getfixturevalue({"quadrotor": "quadrotor_solution"}.get(name, "drive_solution"))
    run, other = (
        ls.simulate(scenario.plant(), solution, disturbances=scenario.disturbances, seed=seed) for seed in (0, 1)
    )
    path = tmp_path_factory.mktemp("video") / "run.mp4"
    if name == "quadrotor":
        ls.render(run, path, camera="top", insets=("side",), size=(800, 360), speed=3)
    else:
        ls.render(run, path, camera="top", size=(560, 360), speed=10)
    return Case(name, solution, run, other, path, list(faults.decoded(path)), read_metadata(path))


def failed(found: ls.types.Verification) -> set[str]:
    return {test.name for test in found.tests if test.passed is False}


# -- Runs


def test_an_honest_run_is_verified(case: Case) -> None:
    found = ls.verify_run(case.run, solution=case.solution)
    assert found.passed, found.summary()
    assert found.likely == ""
    assert found.worst < BOUNDS[case.name][0] / 2
    assert abs(found.scale - 1) < 5e-4
    assert "X-ray" in found.method
    np.testing.assert_allclose(found.tracking_error, case.run.tracking_error[0], rtol=0, atol=found.worst + 1e-9)


Fault = Callable[[np.ndarray, np.ndarray], np.ndarray]


def late(frames: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.concatenate([frames[:1], frames[:-1]])


def dropped(frames: np.ndarray, other: np.ndarray) -> np.ndarray:
    gone = len(frames) // 4
    return np.concatenate([frames[:gone], frames[gone + 1 :], frames[-1:]])


def swapped(frames: np.ndarray, other: np.ndarray) -> np.ndarray:
    changed = frames.copy()
    step = 1 if len(frames) < 400 else 5  # recorded frames in a control period
    first, second = step * 40, step * 41
    changed[[first, second]] = frames[[second, first]]
    return changed


def mirrored(frames: np.ndarray, other: np.ndarray) -> np.ndarray:
    return frames * np.where(np.arange(frames.shape[1]) == 0, -1, 1)  # x is the first number in both models


def another(frames: np.ndarray, other: np.ndarray) -> np.ndarray:
    return other


FAULTS = {
    "late": "1.0 frames late",
    "dropped": "left out",
    "swapped": "swapped",
    "mirrored": "mirrored",
    "another": "another run",
}


@pytest.mark.parametrize("fault", [late, dropped, swapped, mirrored, another])
def test_a_fault_in_what_a_run_recorded_is_told(fault: Fault, case: Case) -> None:
    frames = fault(case.run.frames[0], case.other.frames[0])
    found = ls.verify_run(case.beginning(frames), solution=case.solution)
    assert "position" in failed(found)
    assert FAULTS[fault.__name__] in found.likely
    assert "NOT VERIFIED" in found.summary()


def test_a_record_that_contradicts_itself_verifies_no_video(case: Case) -> None:
    frames = late(case.run.frames[0], case.other.frames[0])[None]
    assert "record" in failed(ls.verify_video(case.video, dataclasses.replace(case.run, frames=frames)))


def test_a_plan_that_is_not_the_runs_is_told(case: Case) -> None:
    plan = case.solution.candidates[1].trajectory
    position = list(case.run.state_coordinates.position)
    begins = np.linalg.norm((plan.states[0] - case.run.plan.states[0])[position])
    assert begins < 0.05  # that does not tell
    changed = dataclasses.replace(case.beginning(), plan=plan)
    found = ls.verify_run(changed, solution=case.solution)
    assert failed(found) == {"plan"}
    assert "plan" in found.likely
    # With the solution that the plan is of it is not checked: that solution's policy was not run.
    policy = dataclasses.replace(case.solution.policy, nominal=plan.states[:-1])
    its_own = dataclasses.replace(case.solution, trajectory=plan, policy=policy)
    assert "not checked  plan" in ls.verify_run(changed, solution=its_own).summary()
    assert failed(ls.verify_video(case.video, dataclasses.replace(case.run, plan=plan))) == {"run"}
    unchecked = ls.verify_run(case.beginning())
    assert unchecked.passed
    assert "not checked  plan" in unchecked.summary()


def test_a_controllers_run_is_about_the_solutions_plan(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    law = ls.track(quadrotor.problem, quadrotor_solution, tolerate={"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s": 1.0})
    run = ls.simulate(quadrotor.plant(), quadrotor_solution, controller=law)
    told = check_plan(run, quadrotor_solution)
    assert (told.passed, told.detail.partition(";")[0]) == (None, "that of the solution")
    tracked = dataclasses.replace(quadrotor_solution, policy=law)
    assert check_plan(run, tracked).passed
    other = dataclasses.replace(tracked, trajectory=quadrotor_solution.candidates[1].trajectory)
    assert check_plan(run, other).passed is False


def off(view: str, axis: int) -> Callable[[Camera, object, float], None]:
    """`Camera.place` of a camera that stands 2 cm from where it is said to."""
    place = Camera.place

    def elsewhere(self: Camera, scene: object, aspect: float) -> None:
        position = np.array(self.position) + (0.02 * np.eye(3)[axis] if self.name == view else 0)
        place(dataclasses.replace(self, position=tuple(position.tolist())), scene, aspect)  # pyright: ignore

    return elsewhere


@pytest.mark.parametrize(("view", "axis"), [("top", 0), ("side", 2), *rarely(("top", 1))])
def test_a_camera_that_is_off_by_2_cm_is_told(
    view: str, axis: int, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    if view == "side" and case.name != "quadrotor":
        pytest.skip("a robot in the plane is seen from above alone")
    monkeypatch.setattr(Camera, "place", off(view, axis))
    found = ls.verify_run(case.beginning())
    assert "position" in failed(found)
    assert "camera is off" in found.likely


def test_a_camera_may_be_anywhere_along_its_line_of_sight(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = ls.verify_run(case.beginning()).seen
    monkeypatch.setattr(Camera, "place", off("top", 2))
    np.testing.assert_array_equal(ls.verify_run(case.beginning()).seen, seen)


# -- Videos


def test_an_honest_video_is_verified(case: Case) -> None:
    found = ls.verify_video(case.video, case.run, solution=case.solution)
    assert found.passed, found.summary()
    # The bounds are for full-size panes; these have a third of the pixels or less.
    assert found.rms < 0.3 * BOUNDS[case.name][1]
    assert found.worst < BOUNDS[case.name][1]
    assert len(found.times) == len(case.frames)


@pytest.mark.parametrize(
    ("fault", "likely"),
    [("late", "1.0 frames late"), ("dropped", "left out"), ("swapped", "swapped"), ("mirrored", "mirrored")],
)
def test_a_fault_in_a_videos_frames_is_told(fault: str, likely: str, case: Case, tmp_path: Path) -> None:
    """Also where the file gives the right number of frames."""
    getattr(faults, fault)(case.video, tmp_path / "changed.mp4")
    found = ls.verify_video(tmp_path / "changed.mp4", case.run)
    assert "position" in failed(found)
    assert "frames" not in failed(found)
    assert likely in found.likely


def test_a_frame_that_is_missing_from_the_file_is_counted(case: Case, tmp_path: Path) -> None:
    faults.write(tmp_path / "short.mp4", case.frames[:-1], case.metadata)
    found = ls.verify_video(tmp_path / "short.mp4", case.run)
    assert failed(found) == {"frames"}
    assert "cut" in found.likely


def test_a_video_that_plays_at_another_speed_is_told(case: Case, tmp_path: Path) -> None:
    faults.write(tmp_path / "fast.mp4", case.frames, case.metadata, rate=case.metadata.rate * 2)
    assert failed(ls.verify_video(tmp_path / "fast.mp4", case.run)) == {"frames"}


def test_calibration_that_is_off_by_2_cm_is_told(case: Case, tmp_path: Path) -> None:
    _, camera = faults.calibrated(case.metadata)[-1]  # the side of the quadrotor's video, the top of the other's
    for axis in range(3):
        faults.off(camera.name, axis)(case.video, tmp_path / "changed.mp4")
        found = ls.verify_video(tmp_path / "changed.mp4", case.run)
        if abs(camera.forward[axis]) == 1:  # along the line of sight it is the same camera
            assert found.passed
        else:
            assert "position" in failed(found)
            assert "camera is off" in found.likely


def test_another_seeds_run_is_told_by_the_pixels_alone(case: Case, tmp_path: Path) -> None:
    assert {"run", "position"} <= failed(ls.verify_video(case.video, case.other))
    faults.forged(digest(case.other))(case.video, tmp_path / "changed.mp4")
    found = ls.verify_video(tmp_path / "changed.mp4", case.other)
    assert "position" in failed(found)
    assert "run" not in failed(found)
    assert "another run" in found.likely


def test_a_covered_robot_is_counted_not_guessed(case: Case, tmp_path: Path) -> None:
    """A few frames without it are said; more than one in twenty are too many."""
    frames, path = [frame.copy() for frame in case.frames], tmp_path / "covered.mp4"
    for hidden, verdict in [(2, set()), (len(frames) // 10, {"seen"})]:
        for frame in frames[30 : 30 + hidden]:
            frame[:] = 200
        faults.write(
            path, frames, case.metadata, preset="ultrafast"
        )  # as sharp as possible: encoded twice, it is small
        found = ls.verify_video(path, case.run)
        assert failed(found) == verdict
        assert f"in {len(frames) - hidden} of {len(frames)} frames" in found.summary()
        assert np.isnan(found.seen).all(axis=1).sum() == hidden
    faults.write(path, [np.full_like(frame, 200) for frame in frames], case.metadata)
    found = ls.verify_video(path, case.run)
    assert "seen" in failed(found)
    assert "not in the pictures" in found.likely


@pytest.mark.parametrize("shown", [(0, 1), (1, 0), (1, 1), (0, 0, 1)])
def test_any_trial_of_a_run_that_is_shown_several_times(shown: tuple[int, ...], tmp_path: Path) -> None:
    """As by `lqrsim render RUN.npz RUN.npz --trial 0 1`, which loads the run twice."""
    plant, noise = ls.scenarios.differential_drive().plant(), ls.disturbances.ControlNoise(0.1)
    one, other = (ls.simulate(plant, weave(12), disturbances=[noise], trials=2) for _ in range(2))
    runs = [one, other, one][: len(shown)]
    video = ls.render(runs, tmp_path / "run.mp4", trial=shown, camera="top", quality="draft", size=(960, 360), fps=10)
    for trial in {*shown, None}:
        assert (found := ls.verify_video(video, other, trial=trial)).passed, str(found)


def test_what_can_not_be_verified_is_refused(case: Case, tmp_path: Path) -> None:
    bare = dataclasses.replace(case.metadata, panes=(dataclasses.replace(case.metadata.panes[0], camera=None),))
    path = tmp_path / "changed.mp4"
    faults.with_metadata(case.video, path, bare)
    with pytest.raises(ls.InputError, match="views: got none, want"):
        ls.verify_video(path, case.run)
    if case.name == "quadrotor":
        faults.with_metadata(case.video, path, dataclasses.replace(case.metadata, panes=case.metadata.panes[:1]))
        with pytest.raises(ls.InputError, match="views: got top, want top and side"):
            ls.verify_video(path, case.run)
    faults.write(path, [np.ascontiguousarray(frame[::2, ::2]) for frame in case.frames[:3]], case.metadata)
    with pytest.raises(ls.InputError, match="want the size that lqrsim wrote"):
        ls.verify_video(path, case.run)
    with pytest.raises(ls.InputError, match="trial: got 1, want one of 0 to 0"):
        ls.verify_run(case.run, 1)
    without = dataclasses.replace(case.run, frames=case.run.frames[:, :0], frame_times=case.run.frame_times[:0])
    with pytest.raises(ls.InputError, match="want what simulate"):
        ls.verify_run(without)


def test_a_video_without_its_run_beside_it_asks_for_the_runs_file(case: Case, tmp_path: Path) -> None:
    path = tmp_path / "alone.mp4"
    path.write_bytes(Path(case.video).read_bytes())
    for beside in (None, case.other):
        if beside is not None:
            ls.save(beside, tmp_path / "other.npz")
        with pytest.raises(ls.InputError) as caught:
            run_beside(path)
        said = str(caught.value)
        assert said == f"run: no file in {tmp_path} has the run that alone.mp4 shows, want its file, --run RUN.npz"


# -- The command, and its parts


def test_the_command_says_it_with_its_exit_code(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ls.save(case.run, tmp_path / "run.npz")
    ls.save(case.other, tmp_path / "other.npz")
    ls.save(case.solution, tmp_path / "solution.npz")
    (tmp_path / "run.mp4").write_bytes(case.video.read_bytes())
    assert main(["verify", str(tmp_path / "run.npz")]) == 0
    assert main(["verify", str(tmp_path / "run.mp4")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("\nverified: ") + printed.startswith("verified: ") == 2
    assert printed.count("passed  plan") == 2
    assert main(["verify", str(tmp_path / "run.mp4"), "--run", str(tmp_path / "other.npz")]) == 1
    assert "FAILED  position" in capsys.readouterr().out
    assert main(["verify", str(tmp_path / "none.mp4"), "--run", str(tmp_path / "run.npz")]) == 2


def test_a_trial_that_diverged_is_verified_up_to_there(case: Case) -> None:
    found = ls.verify_run(case.beginning())
    assert found.passed
    assert found.times[-1] == pytest.approx(case.run.times[BEGINNING])


@pytest.fixture(scope="module")
def short(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> ls.Rollout:
    """Ten control periods of an undisturbed run, as if it had diverged then."""
    run = ls.simulate(quadrotor.plant(), quadrotor_solution, seed=0)
    frames, states = run.frames.copy(), run.states.copy()
    frames[:, run.frame_times > run.times[10] + 1e-9], states[:, 11:] = np.nan, np.nan
    return dataclasses.replace(run, states=states, frames=frames, diverged_at=run.times[[11]])


def verified_as_rod(
    run: ls.Rollout, thickness: float, seed: int | None, changed: pytest.MonkeyPatch
) -> ls.types.Verification:
    """The verification of a quadrotor's run with its ball drawn as a rod of that many pixels of 640 x 480.

    Without a seed the rod lies along the pixels.
    """
    model = model_of(run, 0)
    geom, pixel = verify._tracked_geom(model, model.body(run.body).id), 0.0
    for view in (cameras.calibrated("top", run), cameras.calibrated("side", run)):
        pixel = max(pixel, view.height / verify.SIZE[1])
    turn = np.array([1.0, 0, 1, 0]) if seed is None else np.random.default_rng(seed).normal(size=4)
    model.geom_type[geom], model.geom_quat[geom] = mujoco.mjtGeom.mjGEOM_CAPSULE, turn / np.linalg.norm(turn)
    model.geom_size[geom] = thickness * pixel / 2, run.radius, 0.0
    changed.setattr(recorded_trial, "model_of", lambda *_: model)
    # A small radius is a tight bound: less than half of the finest pixel.
    return ls.verify_run(dataclasses.replace(run, radius=0.08) if seed is None else run)


@pytest.mark.parametrize(
    ("thickness", "seed"), [(0.3, 0), (17.0, None), *rarely((0.8, 1), (2.3, None), (5.0, 3), (7.4, None))]
)
def test_a_thin_rod_is_seen_as_well_as_a_ball(
    thickness: float, seed: int | None, short: ls.Rollout, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = verified_as_rod(short, thickness, seed, monkeypatch)
    assert failed(found) == set(), found.summary()
    told = [one.detail for one in found.tests if one.name == "thickness"]
    assert len(told) == (thickness < 16)
    assert all(thickness <= float(text.split()[0]) <= 4.4 * thickness for text in told)  # of the nearer view


def test_a_rod_that_is_too_thin_is_said_to_be(short: ls.Rollout, monkeypatch: pytest.MonkeyPatch) -> None:
    found = verified_as_rod(short, 0.1, 0, monkeypatch)
    assert "thickness" in failed(found)
    assert "pixels where it is thinnest, want 1 or more" in str(found)
    assert found.likely.startswith("the geom is too thin to be seen")


SOLID = '<asset><mesh name="solid" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>'  # no symmetric silhouette
HEAD = '<geom name="head" type="box" size=".12 .05 .04" mass="1"/>'
LENS = {
    "ball": '<geom name="lens" type="sphere" pos=".5 0 0" size=".03" mass=".1" contype="0" conaffinity="0"/>',
    "mesh": '<geom name="lens" type="mesh" mesh="solid" pos=".5 0 0" mass=".1"/>',
}
TILTING = '<joint name="tilt" axis="0 1 0" damping=".1" armature=".01"/>'
# Geoms of a mount that turns, of the mount's head that tilts, and of what the head carries; the geom to be drawn.
FOLLOWED = {
    "the followed geom": ("", HEAD + LENS["ball"], "", "lens"),
    "another of its body": ("", HEAD + LENS["mesh"], "", "head"),
    "one that cannot collide": (
        "",
        HEAD.replace("mass", 'contype="0" conaffinity="0" mass') + LENS["mesh"],
        "",
        "head",
    ),
    "one of a body that carries it": (HEAD, LENS["mesh"], "", "head"),
    "one of a body that it carries": ("", LENS["mesh"], HEAD, "head"),
    "none": ("", LENS["mesh"], "", ""),
}


@pytest.mark.parametrize("kind", list(FOLLOWED))
def test_a_robot_without_position_or_balls_is_measured_by_a_geom_that_is_whole_in_the_picture(
    kind: str, tmp_path: Path
) -> None:
    """Within a 60th of the radius, which the page promises, of the lens as MuJoCo places it."""
    mount, head, carried, drawn = FOLLOWED[kind]
    bodies = f"""<body name="mount"><joint name="pan" axis="0 0 1" damping=".1" armature=".01"/>
      <inertial pos="0 0 0" mass=".5" diaginertia=".01 .01 .01"/>{mount}
      <body name="camera">{TILTING}{head}<body name="hung" pos="-.1 0 0">{carried}</body></body></body>"""
    text = scene(
        bodies, motors(("pan", "tilt")), things='<geom name="table" type="box" size=".1 .1 .1" pos="0 0 -2"/>',
        before=SOLID, option='timestep="0.005" gravity="0 0 0"',
    )  # fmt: skip
    (tmp_path / "scene.xml").write_text(text)
    robot = ls.MjcfRobot(tmp_path / "scene.xml", body="mount", outline=False, radius=0.05)
    problem = robot.problem(robot.at(), robot.at(pan=0.6, tilt=0.4), steps=16)
    run = ls.simulate(ls.Plant(robot, robot.scene), ls.smooth(problem, max_iterations=3, starts=1), seed=0)
    if not drawn:
        with pytest.raises(ls.InputError, match="got no geom to track"):
            ls.verify_run(run)
        return
    found = ls.verify_run(run)
    assert found.passed, found.summary()
    assert f"the silhouette of {drawn} in" in found.method
    data = mujoco.MjData(model := model_of(run, 0))
    for seen, frame in zip(found.seen, run.frames[0, verify.frames_at_states(run, 0)[1]], strict=True):
        data.qpos[:] = frame
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(seen, data.geom("lens").xpos, rtol=0, atol=0.05 / 60)
    late = dataclasses.replace(run, frames=np.roll(run.frames, run.frames.shape[1] // 10, axis=1))
    assert "position" in failed(ls.verify_run(late))


@settings(max_examples=examples(200))
@given(
    thickness=st.floats(1.0, 16.0), length=st.floats(20.0, 90.0), angle=st.floats(0.0, np.pi),
    centre=st.tuples(st.floats(95.0, 105.0), st.floats(95.0, 105.0)),
)  # fmt: skip
def test_the_middle_of_a_thin_mask_is_its_centre(
    thickness: float, length: float, angle: float, centre: tuple[float, float]
) -> None:
    """Pixels whose middle is in a capsule of at least one pixel: to one pixel, where the mean is up to ten off."""
    x, y = np.meshgrid(np.arange(200) + 0.5 - centre[0], np.arange(200) + 0.5 - centre[1])
    along = np.clip(x * np.cos(angle) + y * np.sin(angle), -length, length)
    mask = np.hypot(x - along * np.cos(angle), y - along * np.sin(angle)) <= thickness / 2
    np.testing.assert_allclose(verify.mask_middle(mask), centre, rtol=0, atol=1.0)


@settings(max_examples=examples(12))
@given(
    kind=st.sampled_from(["capsule", "cylinder", "box", "ellipsoid", "sphere"]),
    size=st.tuples(*[st.floats(0.3, 1.0)] * 3), seed=st.integers(0, 1000),
)  # fmt: skip
def test_how_far_a_geom_reaches(kind: str, size: tuple[float, float, float], seed: int) -> None:
    """The largest product with a direction, over points of its surface that are found by MuJoCo's rays."""
    shape = " ".join(map(str, size[: {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)]))
    model = mujoco.MjModel.from_xml_string(scene(f'<geom type="{kind}" size="{shape}"/>'))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_forward(model, data)
    rays = rng.normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    found = np.zeros(1, dtype=np.int32)
    away = [mujoco.mj_ray(model, data, 5 * ray, -ray, None, 1, -1, found, None) for ray in rays]
    surface = (5 - np.array(away))[:, None] * rays
    directions = rays[:20]
    reach = verify._reach(mujoco.mjtGeom(model.geom_type[0]), model.geom_size[0], directions)
    sampled = (directions @ surface.T).max(axis=1)
    assert (sampled <= reach + 1e-9).all()
    np.testing.assert_allclose(sampled, reach, rtol=0.1, atol=0)  # of so many rays the nearest to a corner


def test_views_that_disagree_are_told_apart() -> None:
    top = Camera("top", (0.0, 0.0, 10.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 5.0)
    side = Camera("side", (0.0, -10.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 5.0)
    point = np.array([0.3, -0.2, 0.5])
    measured = np.array([[view.axes @ point for view in (top, side)]])
    place, apart = verify.triangulate((top, side), measured, "xyz")
    np.testing.assert_allclose(place, [point], rtol=0, atol=1e-12)
    np.testing.assert_allclose(apart, 0, rtol=0, atol=1e-12)
    measured[0, 0, 0] += 0.01
    place, apart = verify.triangulate((top, side), measured, "xyz")
    np.testing.assert_allclose(place, [point + np.array([0.005, 0, 0])], rtol=0, atol=1e-12)
    np.testing.assert_allclose(apart, 0.01, rtol=0, atol=1e-12)


@pytest.mark.parametrize("centre", [(50.0, 40.0), (33.3, 61.7), (4.0, 40.0)])
def test_the_marks_middle_is_found_between_pixels(centre: tuple[float, float]) -> None:
    """Drawn by its exact share of each pixel, with stray green elsewhere, as a video leaves it."""
    fine = (np.arange(800) + 0.5) / 8
    radius = 5.0
    inside = ((fine - centre[0]) ** 2 + (fine[:, None] - centre[1]) ** 2 < radius**2).astype(float)
    share = inside.reshape(100, 8, 100, 8).mean(axis=(1, 3))
    image = np.zeros((100, 100, 3), dtype=np.uint8)
    image[..., 1] = np.round(255 * share)
    image[90:92, 90] = (20, 220, 10)
    # Where a fifth of it is outside of the picture, its middle is not the ball's, by less than that.
    near = 0.03 if centre[0] > radius else 0.5
    np.testing.assert_allclose(verify.marker_centre(image, radius), centre, rtol=0, atol=near)
    image[:, 50:] = 0
    image[:, :50] = 0
    assert np.isnan(verify.marker_centre(image, radius)).all()


def test_cameras_of_a_robot_in_the_plane_see_it_from_above(case: Case) -> None:
    views = [cameras.calibrated("side", case.run)]
    with pytest.raises(ls.InputError, match="views: got side, want"):
        verify.triangulate(views, np.zeros((0, 1, 2)), case.run.state_coordinates.plane)

"""Runs as one HTML file: what it holds is where MuJoCo has it, and it asks for nothing from a network."""

import base64
import gzip
import json
import re
import time
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import browsing
import mujoco
import numpy as np
import pytest
from tracking import funnel_by_hand

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.results.rollout import MovingObstacles
from lqrsim.scenes.mjcf_model import model_from_xml
from lqrsim.view.recorded_trial import RecordedTrial

TRIALS = 8


@pytest.fixture(scope="module", params=ls.scenarios.names())
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    assert main(["solve", request.param, "--out", str(folder)]) == 0
    command = ["simulate", str(folder / "solution.npz"), "--disturbances", "scenario", "--trials", str(TRIALS)]
    assert main(command) == 0
    return folder


@pytest.fixture(scope="module")
def rollout(folder: Path) -> ls.Rollout:
    return ls.load(folder / "rollout.npz", ls.Rollout)


class Page:
    """A page as a browser reads it: its data, and its arrays by their places."""

    def __init__(self, path: Path) -> None:
        self.text = path.read_text(encoding="utf-8")
        (packed,) = re.findall(r'<script id="data" type="text/plain">([^<]*)</script>', self.text)
        whole = gzip.decompress(base64.b64decode(packed))
        length = int.from_bytes(whole[:4], "little")
        self.data: dict[str, Any] = json.loads(whole[4 : 4 + length])
        self._arrays = whole[4 + length :]

    def numbers(self, place: Mapping[str, Any]) -> np.ndarray:
        """An array. One of 16 bits has the changes of each column, as multiples of its step above its least number."""
        count = int(np.prod(place["shape"]))
        kept = np.frombuffer(self._arrays, np.dtype(place["kind"]).newbyteorder("<"), count, place["at"])
        if place["kind"] != "uint16":
            return kept.reshape(place["shape"])
        levels = np.cumsum(kept.reshape(place["shape"][::-1]), axis=1) % 2**16
        return np.array(place["low"]) + levels.T * np.array(place["step"])


def rotation(quaternion: np.ndarray) -> np.ndarray:
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, quaternion / np.linalg.norm(quaternion))
    return found.reshape(3, 3)


def shown_in(model: mujoco.MjModel) -> list[int]:
    """The geoms that MuJoCo's pictures show."""
    return np.flatnonzero((model.geom_group < 3) & (model.geom_rgba[:, 3] > 0)).tolist()


def test_what_moves_is_where_mujoco_has_it(rollout: ls.Rollout, tmp_path: Path) -> None:
    """To 0.1 mm and 0.2 mrad: half of a 16-bit step across 6 m is 0.05 mm, and of a quaternion 0.015 mrad a part."""
    page = Page(ls.view.render_html(rollout, tmp_path / "run.html"))
    model = model_from_xml(rollout.model, "model")
    shown = shown_in(model)
    assert len(page.data["geoms"]) == len(shown)
    assert len(page.data["trials"]) == TRIALS
    data = mujoco.MjData(model)
    for row in (0, TRIALS - 1):
        trial = page.data["trials"][row]
        np.testing.assert_allclose(page.numbers(trial["times"]), rollout.frame_times, rtol=1e-6)
        poses = page.numbers(trial["poses"]).reshape(len(rollout.frame_times), -1, 7)
        places = page.numbers(trial["places"])
        for frame in (0, len(poses) // 2, len(poses) - 1):
            data.qpos[:] = rollout.frames[row, frame]
            mujoco.mj_kinematics(model, data)
            for number, geom in enumerate(shown):
                place, turn = places[number, :3], rotation(places[number, 3:])
                if page.data["geoms"][number]["moves"]:
                    body = poses[frame, trial["bodies"][number]]
                    place, turn = body[:3] + rotation(body[3:]) @ place, rotation(body[3:]) @ turn
                np.testing.assert_allclose(place, data.geom_xpos[geom], atol=1e-4)
                np.testing.assert_allclose(turn, data.geom_xmat[geom].reshape(3, 3), atol=2e-4)


def test_colours_are_those_of_mujocos_pictures(rollout: ls.Rollout, tmp_path: Path) -> None:
    """Of textures, which the scene of a picture does not have in colours, the mean; here of two greys."""
    assets = """<asset><material name="red" rgba="1 0 0 0.5"/></asset>"""
    geoms = """<geom name="own" type="sphere" size="1" material="red" rgba="0 1 0 1" contype="0" conaffinity="0"/>
      <geom name="of_material" type="sphere" size="1" material="red" contype="0" conaffinity="0"/>
      <geom name="unseen" type="sphere" size="1" material="red" rgba="1 1 1 0" contype="0" conaffinity="0"/>"""
    xml = rollout.model.replace("<worldbody>", f"{assets}<worldbody>{geoms}", 1)
    page = Page(ls.view.render_html(replace(rollout, model=xml), tmp_path / "run.html", trial=0))
    model = model_from_xml(xml, "model")
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=1000)
    mujoco.mj_forward(model, data)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
    drawn = [geom for geom in scene.geoms[: scene.ngeom] if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM]
    drawn.sort(key=lambda geom: geom.objid)
    for seen, geom in zip(drawn, page.data["geoms"], strict=True):
        if model.geom(seen.objid).name != "floor":
            np.testing.assert_allclose(geom["colour"], seen.rgba, atol=1e-6)  # 32 bits
        else:  # the MJCF's rgb1 and rgb2, half of it each, in bytes
            greys = np.array([[0.74, 0.75, 0.77], [0.70, 0.71, 0.735]])
            np.testing.assert_allclose(geom["colour"], [*greys.mean(axis=0), 1.0], atol=1 / 255)


def test_quaternions_do_not_jump(rollout: ls.Rollout, tmp_path: Path) -> None:
    """A browser interpolates between them: the robot would turn the long way round."""
    page = Page(ls.view.render_html(rollout, tmp_path / "run.html"))
    for trial in page.data["trials"]:
        turns = page.numbers(trial["poses"]).reshape(len(rollout.frame_times), -1, 7)[:, :, 3:]
        assert np.sum(turns[1:] * turns[:-1], axis=2).min() > 0


def test_lines_and_tube_are_those_of_the_run(rollout: ls.Rollout, tmp_path: Path) -> None:
    """To 0.1 mm, and lines on a floor up to 1 cm above it."""
    assert rollout.tube is not None
    page = Page(ls.view.render_html(rollout, tmp_path / "run.html", trial=1))
    (trial,) = page.data["trials"]
    position = list(rollout.state_coordinates.position)
    kinds = rollout.plan.states[:, position], rollout.states[1, :, position].T
    size = len(position)
    for places, points in zip(
        kinds, (page.numbers(page.data["plan"]["points"]), page.numbers(trial["trace"]["points"])), strict=True
    ):
        knots = np.unique(np.linspace(0, rollout.plan.steps, len(points)).astype(int))
        np.testing.assert_allclose(points[:, :size], places[knots], atol=1e-4)
    np.testing.assert_allclose(page.numbers(trial["robot"])[:, :size], kinds[1], atol=1e-4)
    (tube,) = page.data["tubes"]
    centres, sizes = page.numbers(tube["places"]), page.numbers(tube["sizes"])
    apart = np.linalg.norm(centres[:, None, :size] - kinds[0], axis=2)
    assert apart.min(axis=1).max() < 2e-4
    # The half axes are 2 standard deviations, of an ellipsoid on a floor the two across it.
    wanted = 2 * np.sqrt(np.maximum(np.linalg.eigvalsh(rollout.tube[apart.argmin(axis=1)]), 0))
    np.testing.assert_allclose(np.sort(sizes, axis=1)[:, 3 - size :], wanted, rtol=1e-5, atol=1e-3)


def test_it_is_small_and_asks_for_nothing(rollout: ls.Rollout, tmp_path: Path) -> None:
    path = ls.view.render_html(rollout, tmp_path / "run.html")
    assert path.stat().st_size < 3e6
    text = path.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'" in text
    seen: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            seen.append(tag)
            assert not {name for name, _ in attrs} & {"src", "href", "srcset", "data", "action"}, (tag, attrs)

    reader = Reader()
    reader.feed(text)
    reader.close()
    assert seen.count("canvas") == 1
    assert ls.view.render_html(rollout, tmp_path / "again.html").read_bytes() == path.read_bytes()


def test_trials_say_how_they_ended(rollout: ls.Rollout, tmp_path: Path) -> None:
    """One of them collides; and one has no finite state, and is left out by default."""
    at, hit, states = rollout.collided_at.copy(), list(rollout.obstacles), rollout.states.copy()
    at[:], hit[:] = np.inf, [""] * TRIALS
    at[2], hit[2] = 1.25, "wall_1"
    diverged = np.full(TRIALS, np.inf)
    diverged[3], states[3] = 0.0, np.nan
    run = replace(rollout, collided_at=at, obstacles=tuple(hit), diverged_at=diverged, states=states, first_trial=10)
    trials = Page(ls.view.render_html(run, tmp_path / "run.html")).data["trials"]
    assert len(trials) == TRIALS - 1
    assert trials[2]["name"] == "trial 12: collided with wall 1 at 1.2 s"
    assert (trials[2]["outcome"], trials[2]["ended"]) == ("collided", 1.25)
    assert trials[0]["name"] == f"trial 10: {run.outcome[0]}"
    assert trials[0]["ended"] is None
    assert [trial["name"].split(":")[0] for trial in trials[3:]] == [f"trial {n}" for n in range(14, 10 + TRIALS)]
    assert "collided with wall 1" in trials[2]["readings"][-1]
    assert "collided" not in trials[2]["readings"][0]
    with pytest.raises(ls.InputError, match="trial 3 without a finite state"):
        ls.view.render_html(run, tmp_path / "run.html", trial=(0, 3))


def test_each_trial_has_its_obstacles(rollout: ls.Rollout, tmp_path: Path) -> None:
    assert rollout.obstacle_geoms is not None
    model = model_from_xml(rollout.model, "model")
    geom = next(int(geom) for geom in rollout.obstacle_geoms if model.geom_group[geom] < 3)
    displaced = np.zeros_like(rollout.displaced)
    displaced[1, list(rollout.obstacle_geoms).index(geom)] = 0.1, -0.2, 0.05
    page = Page(ls.view.render_html(replace(rollout, displaced=displaced), tmp_path / "run.html", trial=(0, 1)))
    before, after = (page.numbers(trial["places"]) for trial in page.data["trials"])
    (moved,) = np.flatnonzero((before != after).any(axis=1))
    np.testing.assert_allclose(after[moved, :3] - before[moved, :3], [0.1, -0.2, 0.05], atol=1e-6)  # 32 bits
    fixed = [number for number, one in enumerate(page.data["geoms"]) if not one["moves"]]
    shown = shown_in(model)
    assert moved in fixed
    assert shown[moved] == geom


def test_obstacles_that_move(rollout: ls.Rollout, tmp_path: Path) -> None:
    """A ball and a cylinder without an end; a plane is not drawn."""
    moving = MovingObstacles(
        names=("ball", "bar", "wall"), kinds=("sphere", "cylinder", "plane"), positions=np.arange(9.0).reshape(3, 3),
        rotations=np.stack([np.eye(3)] * 3), sizes=np.array([[0.2] * 3, [0.1, np.inf, 0], [0, 0, 0]]),
        velocities=np.full((3, 3), 0.5),
    )  # fmt: skip
    page = Page(ls.view.render_html(replace(rollout, moving=moving), tmp_path / "run.html", trial=0))
    _, ball, bar = page.data["bodies"]  # the first is the planned place
    assert (ball["kind"], ball["size"]) == ("sphere", [0.2] * 3)
    places = np.array([0.0, 1.0, 2.0]) + 0.5 * rollout.times[:, None]
    np.testing.assert_allclose(page.numbers(ball["places"]), places, atol=1e-3)  # 16 bits of metres
    assert bar["kind"] == "cylinder"
    assert np.isfinite(bar["size"]).all()
    assert bar["size"][1] > 5 * model_from_xml(rollout.model, "model").stat.extent
    assert bar["turn"] == [1, 0, 0, 0]


def test_every_shape_is_drawn(rollout: ls.Rollout, tmp_path: Path) -> None:
    """A mesh by MuJoCo's vertices, and a height field where MuJoCo's rays meet it."""
    hills = "0 1 2  3 1 0"
    assets = f"""<asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 2 0  0 0 3"/>
      <hfield name="hills" nrow="2" ncol="3" size="1 1.5 0.9 0.1" elevation="{hills}"/></asset>"""
    geoms = """<geom name="wedge" type="mesh" mesh="wedge" contype="0" conaffinity="0" rgba="0.1 0.2 0.3 0.4"/>
      <geom name="pill" type="capsule" size="0.1 0.3" pos="1 2 3" contype="0" conaffinity="0"/>
      <geom name="hills" type="hfield" hfield="hills" pos="50 50 50" contype="0" conaffinity="0"/>
      <geom name="ground" type="plane" size="0 0 1" pos="0 0 -90" contype="0" conaffinity="0"/></worldbody>"""
    xml = rollout.model.replace("<worldbody>", f"{assets}<worldbody>", 1).replace("</worldbody>", geoms, 1)
    page = Page(ls.view.render_html(replace(rollout, model=xml), tmp_path / "run.html", trial=0))
    model = model_from_xml(xml, "model")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    drawn = dict(zip(shown_in(model), page.data["geoms"], strict=True))
    wedge, pill, field, ground = (drawn[model.geom(name).id] for name in ("wedge", "pill", "hills", "ground"))
    assert wedge["colour"] == pytest.approx([0.1, 0.2, 0.3, 0.4], abs=1e-6)
    start = int(model.mesh("wedge").vertadr[0])
    vertices = page.numbers(wedge["vertices"])
    np.testing.assert_allclose(vertices, model.mesh_vert[start : start + len(vertices)], atol=1e-4)
    assert page.numbers(wedge["faces"]).shape[1] == 3
    assert (pill["kind"], pill["size"][:2]) == ("capsule", [0.1, 0.3])
    corners, faces = page.numbers(field["vertices"]), page.numbers(field["faces"])
    assert faces.shape == (4, 3)
    inside = corners[faces].mean(axis=1)
    for point, corner in zip(inside, corners[faces], strict=True):
        above = point + np.array([50.0, 50.0, 60.0])
        hit = mujoco.mj_ray(model, data, above, [0.0, 0.0, -1.0], None, True, -1, np.zeros(1, np.int32))
        assert above[2] - hit - 50 == pytest.approx(point[2], abs=1e-4)
        assert np.cross(corner[1] - corner[0], corner[2] - corner[0])[2] > 0  # seen from above
    assert min(ground["size"][:2]) > model.stat.extent


def test_a_funnel_and_the_cost(folder: Path, rollout: ls.Rollout, tmp_path: Path) -> None:
    solution, size = ls.load(folder / "solution.npz", ls.Solution), len(rollout.state_coordinates.position)
    funnel = funnel_by_hand(solution, 0.25**2 * np.eye(size), knots=(0, 100), levels=(1.0, 0.5))
    ls.save(funnel, tmp_path / "funnel.npz")
    path = tmp_path / "run.html"
    command = ["render", str(folder / "rollout.npz"), "--out", str(path), "--overlays", "funnel", "cost_tube"]
    files = ["--funnel", str(tmp_path / "funnel.npz"), "--solution", str(folder / "solution.npz")]
    assert main([*command, *files]) == 0
    page = Page(path)
    _, certified, between = page.data["tubes"]
    np.testing.assert_allclose(page.numbers(certified["sizes"])[:, :size], [[0.25] * size, [0.125] * size], rtol=1e-6)
    assert page.numbers(between["sizes"])[:, :size].max() < 0.25
    assert any("funnel" in label for label, _ in page.data["legend"])
    assert "plan" not in page.data
    assert "trace" not in page.data["trials"][0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--camera", "top"], "--camera: got top with run.html, want it with a video or a still"),
        (["--trial", "99"], "trial: got 99, want one of 0 to"),
        (["--trial"], "trial: got none, want 1 to"),
        (["--overlays", "cost_tube"], "solution: got None with the overlay cost_tube"),
        (["--solution", "a", "b", "--overlays", "cost_tube"], "error: --solution: got 2 with run.html, want one"),
        (["--funnel", "a", "b", "--overlays", "funnel"], "error: --funnel: got 2 with run.html, want one"),
    ],
)
def test_wrong_options_are_refused(
    options: list[str], said: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["render", str(folder / "rollout.npz"), "--out", str(tmp_path / "run.html"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not browsing.CHROMIUM, reason="there is no browser: sudo apt-get install chromium")
@pytest.mark.long
def test_a_browser_plays_it(rollout: ls.Rollout, tmp_path: Path) -> None:
    """Between frames, too, geoms are where MuJoCo has them, to 1 mm; and the page is as wide as a telephone."""
    path = ls.view.render_html(rollout, tmp_path / "run.html")
    with browsing.browser(path.as_uri(), tmp_path / "profile", size=(500, 800)) as page:

        def asked(script: str) -> Any:
            answer = page.call("Runtime.evaluate", expression=script, returnByValue=True)
            assert "exceptionDetails" not in answer, answer
            return answer["result"].get("value")

        page.call("Emulation.setDeviceMetricsOverride", width=420, height=800, deviceScaleFactor=1, mobile=True)
        until = time.monotonic() + 600
        while "time" not in (words := asked("document.getElementById('readings')?.textContent ?? ''")):
            assert time.monotonic() < until, words
            time.sleep(0.2)
        assert asked("document.documentElement.scrollWidth <= innerWidth")
        assert asked("document.getElementById('trial').length") == TRIALS
        picture = page.picture()
        assert np.ptp(picture.reshape(-1, 3), axis=0).min() > 150  # a scene, and no blank page
        moment = 0.37 * rollout.plan.horizon
        asked(f"play(false); choose(1); show({moment}); draw()")
        recorded = RecordedTrial(rollout, 1)
        data = mujoco.MjData(recorded.model)
        recorded.pose(data, moment)
        places = asked("solids().filter((body) => 'moves' in body).map((body) => body.place)")
        np.testing.assert_allclose(places, data.geom_xpos[shown_in(recorded.model)], atol=1e-3)
        before = page.picture()
        page.press("ArrowDown", 40)
        assert asked("trial.number") == 2
        page.press("End", 35)
        assert asked("state.time") == pytest.approx(rollout.plan.horizon)
        assert (page.picture() != before).any()

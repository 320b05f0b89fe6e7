"""Recordings for Rerun's viewer, read back by Rerun's own reader: what moves is where MuJoCo has it."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from tracking import funnel_by_hand, hover

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.scenes.mjcf_model import model_from_xml
from lqrsim.simulation.disturbances import Push
from lqrsim.view import exports
from lqrsim.view.recorded_trial import RecordedTrial

Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert main(["solve", "quadrotor", "--out", str(folder)]) == 0
    assert main(["simulate", str(folder / "solution.npz"), "--disturbances", "scenario", "--trials", "2"]) == 0
    return folder / "rollout.npz"


def read(path: Path) -> dict[str, Columns]:
    """Entity -> its components, a row a moment; "time" has the seconds."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    found: dict[str, Columns] = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path.replace("\\", ""), {})
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name == "time":
                entity["time"] = column.cast("int64").to_numpy() * 1e-9
            elif ":" in name and "color" not in name:
                entity[name.rpartition(":")[2]] = np.array(column.to_pylist(), dtype=object)
    return found


def numbers(columns: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """A component of one instance a row, as numbers."""
    return np.array([row[0] for row in columns[name]], dtype=float)


def test_what_moves_is_where_mujoco_has_it(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun", reason="needs the `rerun` extra")
    path = tmp_path / "run.rrd"
    capsys.readouterr()
    assert main(["render", str(run), "--out", str(path), "--trial", "1"]) == 0
    assert capsys.readouterr().out == f"wrote {path}\n"
    found, rollout = read(path), ls.load(run, ls.Rollout)
    model = model_from_xml(rollout.model, "model")
    data = mujoco.MjData(model)
    moving = {name: one for name, one in found.items() if name.startswith("/world/model/") and "time" in one}
    assert len(moving) > 5
    for name, columns in moving.items():
        geom = int(name.split("/")[3].split()[0])
        np.testing.assert_allclose(columns["time"], rollout.frame_times, atol=1e-8)
        places, turns = numbers(columns, "translation"), numbers(columns, "quaternion")
        for frame in (0, 70, len(rollout.frame_times) - 1):
            data.qpos[:] = rollout.frames[1, frame]
            mujoco.mj_kinematics(model, data)
            np.testing.assert_allclose(places[frame], data.geom_xpos[geom], atol=1e-6)  # 32 bits
            turned = np.empty(9)
            mujoco.mju_quat2Mat(turned, np.roll(turns[frame], 1))
            np.testing.assert_allclose(turned, data.geom_xmat[geom], atol=1e-6)
    still = [name for name, one in found.items() if name.startswith("/world/model/") and "time" not in one]
    assert len(still) + len(moving) == np.sum((model.geom_group < 3) & (model.geom_rgba[:, 3] > 0))


def test_numbers_plan_and_tube_are_those_of_the_run(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the `rerun` extra")
    rollout, path = ls.load(run, ls.Rollout), tmp_path / "run.rrd"
    exports.write_rerun(rollout, path)
    found = read(path)
    assert rollout.tube is not None
    assert rollout.collision_chance is not None
    for name, values in {
        "error/tracking error, m": rollout.tracking_error[0],
        "clearance/clearance, m": rollout.clearance[0],
        "chance/chance of collision": rollout.collision_chance,
        "states/z (m)": rollout.states[0, :, 2],
        "plan/z (m)": rollout.plan.states[:, 2],
        "applied/rotor_2 (N)": rollout.applied[0, :, 1],
    }.items():
        columns = next(one for entity, one in found.items() if entity.replace(r"\,", ",") == f"/numbers/{name}")
        np.testing.assert_array_equal(numbers(columns, "scalars"), values)
        np.testing.assert_allclose(columns["time"], rollout.times[: len(values)], atol=1e-8)
    np.testing.assert_allclose(numbers(found["/world/planned"], "positions"), rollout.plan.states[:, :3], atol=1e-6)
    line = np.array(found["/world/path"]["strips"][0][0], dtype=float)
    np.testing.assert_allclose(line, rollout.states[0, :, :3], atol=1e-6)
    # The tube's half axes are 2 standard deviations.
    axes = np.sort(numbers(found["/world/tube"], "half_sizes"), axis=1)
    wanted = 2 * np.sqrt(np.maximum(np.linalg.eigvalsh(rollout.tube), 0))
    np.testing.assert_allclose(axes, np.maximum(wanted, 1e-4), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("at", range(0, 10, 3))
@pytest.mark.parametrize("how", ["diverged", "error"])
def test_the_command_that_ended_a_trial_is_recorded(how: str, at: int, quadrotor: ls.Scenario) -> None:
    """Of a trial that ends within its plan the numbers end with the last of each, by the knot that it belongs to."""
    solution = hover(10)
    dt = solution.trajectory.dt

    def failing(state: np.ndarray, t: float) -> np.ndarray:
        return np.full(4, 1.0 if t < (at - 0.5) * dt else np.nan)

    options: Any = {"controller": failing} if how == "error" else {"disturbances": [Push((1e9, 0.0, 0.0), at=at * dt)]}
    rollout, sent = ls.simulate(quadrotor.plant(), solution, **options), dict[str, tuple[list[float], np.ndarray]]()
    assert rollout.outcome == (how,)
    stub = SimpleNamespace(
        Scalars=SimpleNamespace(columns=lambda scalars: scalars), new_entity_path="/".join,
        TimeColumn=lambda name, duration: duration,
        send_columns=lambda path, index, columns, recording: sent.update({path: (index[0], columns)}),
    )  # fmt: skip
    exports._Recording(stub, None, RecordedTrial(rollout, 0)).draw_numbers()
    for name, values in (
        ("states/z (m)", rollout.states[0, :, 2]),
        ("commanded/rotor_1 (N)", rollout.commanded[0, :, 0]),
    ):
        known = np.flatnonzero(np.isfinite(values))
        times, shown = sent.get(f"numbers/{name}", ([], np.zeros(0)))
        np.testing.assert_array_equal(shown, values[known])
        np.testing.assert_array_equal(times, rollout.times[known])


def test_a_funnel(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Balls of a quarter of a metre about the plan, of half of it at the second knot, and what is in between."""
    pytest.importorskip("rerun", reason="needs the `rerun` extra")
    solution, path, kept = (
        ls.load(run.parent / "solution.npz", ls.Solution),
        tmp_path / "run.rrd",
        tmp_path / "funnel.npz",
    )
    ls.save(funnel_by_hand(solution, 0.25**2 * np.eye(3), knots=(0, 100), levels=(1.0, 0.5)), kept)
    assert main(["render", str(run), "--out", str(path), "--funnel", str(kept)]) == 0
    found, plan = read(path), solution.trajectory.states[:, :3]
    certified, between = (found[f"/world/funnel/{name}"] for name in ("certified", "interpolated"))
    np.testing.assert_allclose(np.array(certified["centers"][0].tolist()), plan[[0, 100]], atol=1e-6)
    sizes = np.array(certified["half_sizes"][0].tolist())
    np.testing.assert_allclose(sizes, np.repeat([[0.25], [0.125]], 3, axis=1), atol=1e-6)
    middles = np.array(between["centers"][0].tolist())
    nearest = np.linalg.norm(middles[:, None] - plan[1:100], axis=2).argmin(axis=1) + 1
    np.testing.assert_allclose(middles, plan[nearest], atol=1e-6)
    sizes = np.array(between["half_sizes"][0].tolist())
    np.testing.assert_allclose(sizes, 0.25 * (1 - nearest[:, None] / 200) * np.ones(3), rtol=0.02)
    capsys.readouterr()
    assert main(["render", str(run), "--out", str(path), "--funnel", str(kept), str(kept)]) == 2
    assert "error: --funnel: got 2 with run.rrd, want one" in capsys.readouterr().err


def test_every_shape_is_drawn(run: Path, tmp_path: Path) -> None:
    """A mesh by MuJoCo's own vertices, a capsule from its lower end, a height field by its corners."""
    pytest.importorskip("rerun", reason="needs the `rerun` extra")
    assets = """<asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 2 0  0 0 3"/>
      <hfield name="hills" nrow="2" ncol="2" size="1 1 1 1"/></asset>"""
    geoms = """<geom name="wedge" type="mesh" mesh="wedge" contype="0" conaffinity="0"/>
      <geom name="pill" type="capsule" size="0.1 0.3" pos="1 2 3" contype="0" conaffinity="0"/>
      <geom name="egg" type="ellipsoid" size="0.1 0.2 0.3" contype="0" conaffinity="0"/>
      <geom name="hills" type="hfield" hfield="hills" contype="0" conaffinity="0"/></worldbody>"""
    rollout, path = ls.load(run, ls.Rollout), tmp_path / "shapes.rrd"
    xml = rollout.model.replace("<worldbody>", f"{assets}<worldbody>", 1).replace("</worldbody>", geoms, 1)
    exports.write_rerun(replace(rollout, model=xml), path)
    model = model_from_xml(xml, "model")
    found = {name.rpartition(" ")[2]: one for name, one in read(path).items()}
    start = int(model.mesh("wedge").vertadr[0])
    vertices = np.array(found["wedge"]["vertex_positions"][0], dtype=float)
    np.testing.assert_allclose(vertices, model.mesh_vert[start : start + len(vertices)], atol=1e-6)
    np.testing.assert_array_equal(np.array(found["wedge"]["triangle_indices"][0]).shape[1], 3)
    corners = np.array(found["hills"]["vertex_positions"][0], dtype=float)
    np.testing.assert_array_equal(corners, [[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])
    assert numbers(found["pill"], "lengths") == pytest.approx([0.6])
    np.testing.assert_allclose(numbers(found["pill"], "translations"), [[0, 0, -0.3]], atol=1e-6)
    np.testing.assert_allclose(numbers(found["pill"], "translation"), [[1, 2, 3]], atol=1e-6)
    np.testing.assert_allclose(numbers(found["egg"], "half_sizes"), [[0.1, 0.2, 0.3]], atol=1e-6)


def test_without_the_package_it_says_what_to_install(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    capsys.readouterr()
    assert main(["render", str(run), "--out", str(tmp_path / "run.rrd")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'lqrsim[rerun]'" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--fps", "5"], "--fps: got 5 with run.rrd, want it with a video or a still"),
        (["--overlays", "plan"], "--overlays: got plan with run.rrd, want it with a video or a still"),
        (["--trial", "0", "1"], "--trial: got 2 with run.rrd, want one"),
        (["--trial"], "--trial: got 0 with run.rrd, want one"),
    ],
)
def test_what_the_viewer_decides_is_refused(
    options: list[str], named: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["render", str(run), "--out", str(tmp_path / "run.rrd"), *options]) == 2
    assert capsys.readouterr().err == f"lqrsim: error: {named}\n"
    assert not list(tmp_path.iterdir())

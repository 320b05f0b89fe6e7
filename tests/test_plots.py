"""The figure of a run: what is written on it, and that it is the same each time."""

import gc
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, ForceNoise
from lqrsim.view import style
from lqrsim.view.plots import plot_run, surface


@pytest.fixture(scope="module")
def drive_runs(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> dict[str, ls.Rollout]:
    plant = differential_drive.plant()
    disturbed = ls.simulate(plant, drive_solution, disturbances=[ControlNoise(0.05)], seed=1)
    return {"calm": ls.simulate(plant, drive_solution), "with noise": disturbed}


@pytest.fixture(scope="module")
def flight_runs(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> dict[str, ls.Rollout]:
    plant = quadrotor.plant()
    disturbed = ls.simulate(plant, quadrotor_solution, disturbances=[ForceNoise(0.1)], seed=1)
    return {"calm": ls.simulate(plant, quadrotor_solution), "with noise": disturbed}


def texts(path: Path) -> list[str]:
    """Every text in an svg."""
    return [re.sub(r"<[^>]+>", "", text) for text in re.findall(r"<text.*?</text>", path.read_text(), re.DOTALL)]


def test_axes_have_units_and_runs_have_names(
    drive_solution: ls.Solution,
    drive_runs: dict[str, ls.Rollout],
    differential_drive: ls.Scenario,
    tmp_path: Path,
) -> None:
    path = plot_run(drive_solution, drive_runs, tmp_path / "figure.svg", world=differential_drive.scene.world)
    found = texts(path)
    wanted = {"x (m)", "y (m)", "time (s)", "the plan (mm)", "(m/s)", "iteration of smooth", "calm", "with noise"}
    assert wanted <= set(found)
    assert path.read_text().count('id="limit"') == 4, "two controls, a low and a high limit each"


def test_errors_that_differ_by_decades_get_a_logarithmic_axis(
    quadrotor_solution: ls.Solution, flight_runs: dict[str, ls.Rollout], quadrotor: ls.Scenario, tmp_path: Path
) -> None:
    path = plot_run(quadrotor_solution, flight_runs, tmp_path / "figure.svg", world=quadrotor.scene.world)
    assert {"z (m)", "the plan (m)", "(N)"} <= set(texts(path))
    alone = {"with noise": flight_runs["with noise"]}
    path = plot_run(quadrotor_solution, alone, tmp_path / "figure.svg", world=quadrotor.scene.world)
    assert "the plan (mm)" in texts(path)


@pytest.mark.parametrize("robot", ["drive", *rarely("flight")])
def test_a_predicted_tube_is_drawn_with_its_chance_of_collision(
    robot: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    names = {"drive": ("differential_drive", "drive_solution"), "flight": ("quadrotor", "quadrotor_solution")}
    scenario, solution = (request.getfixturevalue(name) for name in names[robot])
    runs = request.getfixturevalue(f"{robot}_runs")
    noise = [ControlNoise(0.05)] if robot == "drive" else [ForceNoise(0.1)]
    tube = ls.predict_tube(scenario.problem, solution, ls.uncertainty_of(scenario.plant(), noise))
    with_tube = runs | {"with noise": tube.added_to(runs["with noise"])}
    without, found = (
        texts(plot_run(solution, shown, tmp_path / "figure.svg", world=scenario.scene.world))
        for shown in (runs, with_tube)
    )
    assert set(found) - set(without) >= {
        "area: with noise, predicted: 2 sigma, 95 % in each direction",
        "predicted chance of being in collision",
        "chance",
    }
    # No chance is to be seen of the drive, whose tube stays away from the pillars.
    assert ("below 1e-06 throughout" in found) == (robot == "drive") == (tube.step_chance.max() < 1e-6)


@pytest.mark.parametrize("suffix", [".pdf", *rarely(".png", ".svg")])
def test_same_runs_give_the_same_bytes(
    suffix: str,
    drive_solution: ls.Solution,
    drive_runs: dict[str, ls.Rollout],
    differential_drive: ls.Scenario,
    tmp_path: Path,
) -> None:
    before = dict(matplotlib.rcParams)
    world = differential_drive.scene.world
    files = [plot_run(drive_solution, drive_runs, tmp_path / f"{n}{suffix}", world=world).read_bytes() for n in "ab"]
    assert files[0] == files[1]
    assert dict(matplotlib.rcParams) == before
    assert {file.suffix for file in tmp_path.iterdir()} == {suffix}


@pytest.mark.parametrize("layout", ["screen", *rarely("column", "page")])
def test_where_objects_lie_in_memory_does_not_change_the_bytes(
    layout: style.Style,
    drive_solution: ls.Solution,
    drive_runs: dict[str, ls.Rollout],
    differential_drive: ls.Scenario,
    tmp_path: Path,
) -> None:
    """Collections at other times lead to other addresses, by which the solver of the layout orders its variables."""
    before, files, world = gc.get_threshold(), [], differential_drive.scene.world
    try:
        for young in (*range(1, examples(7)), 700):
            gc.set_threshold(young, 2, 2)
            path = tmp_path / f"{young}.svg"
            files.append(plot_run(drive_solution, drive_runs, path, world=world, style=layout).read_bytes())
    finally:
        gc.set_threshold(*before)
    assert len(set(files)) == 1


def test_works_without_obstacles(
    drive_solution: ls.Solution, drive_runs: dict[str, ls.Rollout], tmp_path: Path
) -> None:
    assert plot_run(drive_solution, drive_runs, tmp_path / "figure.png", world=ls.World([])).stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder"])
@pytest.mark.parametrize("infinite", [False, True])
def test_surfaces_lie_on_the_obstacles(kind: str, infinite: bool) -> None:
    """The distance is the oracle: it is zero on a surface. A tube is drawn without its ends."""
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    half = np.inf if infinite and kind in ("capsule", "cylinder") else 0.7
    obstacle = ls.Obstacle("it", kind, np.array([0.3, -0.2, 0.1]), turn, np.array([0.4, half, 0.5]))
    x, y, z = surface(obstacle, np.array([-3.0, -3.0, -3.0]), np.array([3.0, 3.0, 3.0]))
    points = np.stack([x, y, z], axis=-1)
    assert ls.World([obstacle]).distance(points) == pytest.approx(0.0, abs=1e-12)


def test_bad_input_gets_one_line(
    drive_solution: ls.Solution,
    drive_runs: dict[str, ls.Rollout],
    flight_runs: dict[str, ls.Rollout],
    differential_drive: ls.Scenario,
    tmp_path: Path,
) -> None:
    world = differential_drive.scene.world
    with pytest.raises(ls.InputError, match=r"path: got .*figure\.jpg', want a name that ends in \.png"):
        plot_run(drive_solution, drive_runs, tmp_path / "figure.jpg", world=world)
    with pytest.raises(ls.InputError, match="rollouts: got 0, want 1 to 4"):
        plot_run(drive_solution, {}, tmp_path / "figure.png", world=world)
    with pytest.raises(ls.InputError, match=r"rollouts\['calm'\]: got a run with the states"):
        plot_run(drive_solution, flight_runs, tmp_path / "figure.png", world=world)
    with pytest.raises(ls.InputError, match="trial: got 1, want one of 0 to 0"):
        plot_run(drive_solution, drive_runs, tmp_path / "figure.png", world=world, trial=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(ls.InputError, match="want a file that can be written"):
        plot_run(drive_solution, drive_runs, tmp_path / "file" / "figure.png", world=world)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_needs_no_pyplot() -> None:
    code = "import sys, lqrsim.view.plots; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_logarithmic_axes_have_numbers_and_names_keep_their_dollars(tmp_path: Path) -> None:
    """Where names are not mathematics, neither are matplotlib's own powers of ten."""
    path = tmp_path / "decades.svg"
    with style.figure(path, size=(4, 3)) as figure:
        axes = figure.add_subplot()
        axes.semilogy([0, 1], [1e-3, 10.0])
        axes.set_title("a $name$ of mine")
    found = texts(path)
    assert "a $name$ of mine" in found
    assert {"0.001", "0.1", "10"} <= set(found)
    assert not any("mathdefault" in text for text in found)

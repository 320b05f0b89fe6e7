"""Every script in experiments/ and tests/tools/ runs, and reports what it is for."""

import itertools
import json
import runpy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import lqrsim as ls
from lqrsim.disturbances import MassMismatch, MeasurementDropouts, MeasurementLatency, MotorLag
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.view import gl

FOLDER, TOOLS = Path(__file__).parent.parent / "experiments", Path(__file__).parent / "tools"
FILES = sorted([*FOLDER.glob("*.py"), *TOOLS.glob("*.py")])
SCRIPTS = [path for path in FILES if "__main__" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_explain_themselves(
    script: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert not ended.value.code
    printed = capsys.readouterr().out
    assert "--quick" in printed or script.stem in ("print_numbers", "print_words", "seed_faults")


def benchmark(*arguments: str) -> dict[str, Any]:
    """The benchmark's results, from a process of its own: with the C++ reference in it, tiny numbers become zero."""
    script = FOLDER / "benchmark_solver.py"
    done = subprocess.run(
        [sys.executable, script, "--quick", "--json", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["result"]


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    """All sections, in two processes at once, for most of the time goes into compiling."""
    with ThreadPoolExecutor() as pool:
        speed = pool.submit(benchmark, "--sections", "speed", "--queries", "4", "--rounds", "1")
        others = ("peers", "scaling", "threads", "startup")
        return benchmark("--sections", *others, "--queries", "2", "--rounds", "1") | speed.result()


# Tests have no business with how long anything takes: what is asserted holds on any machine.


@pytest.mark.long
def test_benchmark_of_speed_compares_the_same_iterations(results: dict[str, Any]) -> None:
    assert results["config"]["seed"] == 0
    assert results["versions"]["lqrsim"]
    speed = results["speed"]
    assert speed["derivative_difference"] < 1e-10
    for solver in ("smooth", "primal", "ilqr"):
        found = speed[solver]
        assert ("by hand" in found) == ("compiled level" in found) == (solver == "ilqr")  # in a quick run
        for name in ("by hand", "compiled level") if solver == "ilqr" else ():
            assert found[name]["iterations"] == found["symbolic"]["iterations"]
            np.testing.assert_allclose(found[name]["cost"], found["symbolic"]["cost"], rtol=1e-8)
            assert found[name]["milliseconds"] >= found[name]["milliseconds_loop"] > 0
        if "reference" in speed:
            assert speed["reference"]["skipped"]
        else:
            assert found["same_iterations"]
            # The reference has the primal form; the dual takes another way to the same optimum.
            assert found["cost_difference"] < (1e-4 if solver == "smooth" else 1e-8)


@pytest.mark.long
def test_benchmark_of_peers_recomputes_what_they_claim(results: dict[str, Any]) -> None:
    """Needs the `bench` extra and g++, which few machines have; without them it says so."""
    peers = results["peers"]
    if "skipped" in peers:
        assert "installed" in peers["skipped"]
        pytest.skip(peers["skipped"])
    assert set(peers) == {"smooth, hover", "Newton, hover", "ilqr, hover", "FDDP, hover", "FDDP, line"}
    for found in peers.values():
        assert found["converged"] == [True, True]
        assert found["cost_difference"] < 1e-8
    # From a trajectory FDDP is iLQR, but for how it regularises and how far its line search looks.
    np.testing.assert_allclose(peers["FDDP, hover"]["cost"], peers["ilqr, hover"]["cost"], rtol=1e-3)


@pytest.mark.long
def test_benchmark_of_threads(results: dict[str, Any]) -> None:
    threads = results["threads"]
    if "skipped" in threads:
        pytest.skip(threads["skipped"])
    assert set(threads) == {"smooth", "ilqr"}
    assert all(found["same_costs"] for found in threads.values())


@pytest.mark.long
def test_benchmark_of_scaling_and_startup(results: dict[str, Any]) -> None:
    scaling = results["scaling"]
    assert {line["states"] for line in scaling["states"]} == {3}
    for solver in ("smooth", "ilqr"):
        lines = [(line["steps"], line["bytes"]) for line in scaling["steps"] if line["solver"] == solver]
        # Of each step more; what a solve takes whatever the horizon, some 15 kB, is not looked at.
        per_step = [(more - less) / (long - short) for (short, less), (long, more) in itertools.pairwise(lines)]
        assert max(per_step) < 1.02 * min(per_step), "memory does not grow linearly with the horizon"
    assert set(results["startup"]) == {"--help", "warm", "cold"}


def test_benchmark_says_what_it_skips(tmp_path: Path) -> None:
    script = import_module("benchmark_solver")
    with pytest.raises(script.peers.Unavailable, match="name its folder with --reference"):
        script.speed.load_reference(script.Config(reference=tmp_path))
    assert script.report({"peers": {"skipped": "no such thing"}}) == "peers: skipped: no such thing"


@pytest.mark.parametrize("measured", [None, [0.0, 0.0, 0.1]])
def test_robust_policies_reports_what_has_no_chance(measured: list[float] | None) -> None:
    """In a quick run splitting may find no failure, or no trial fail: there is then no ratio of two chances."""
    module = import_module("robust.emphasis")
    for pairs, row in (
        ([[measured, measured]], "| light | 0 | - | - | - | 0 | 0 |"),
        ([[measured, measured], [[0.3, 0.2, 1.0], [0.1, 0.0, 0.15]]], "| light | 1 | 3 | 3 | 3 | 0 | 1 |"),
    ):
        assert module.report({"light": pairs})[1].splitlines()[-1] == row
    one = {"asked": 0.01, "predicted": 0.02}
    plans = [one | {"measured": measured}, one | {"measured": [0.04, 0.03, 0.05]}]
    said, rows = import_module("robust.chances").report({"light": plans})
    assert rows.splitlines()[-1] == "| light | 1 | 0.01 | 0.50 | 0.50 | 0.50 |"
    assert said.endswith("Left out: 1 plans of which none collided.")


@pytest.mark.parametrize(("chance", "said"), [(1.0, "1"), (0.0312, "0.03"), (2.4e-127, "2e-127"), (0.0, "< 1e-300")])
def test_no_chance_is_said_to_be_zero(chance: float, said: str) -> None:
    """A test of thousands of trials may have a p-value below all numbers."""
    assert import_module("runner").improbable(chance) == said


@pytest.mark.parametrize("lost", [0.0, 0.02, 0.3, 0.6])
def test_a_filter_that_is_right_is_inside_its_bands_whatever_is_lost(lost: float) -> None:
    """Errors and innovations that are normal as predicted, a share of the latter never measured."""
    of_run, rng = import_module("robust.consistency").of_run, np.random.default_rng(0)
    trials, steps, size = 200, 400, 3
    innovations = rng.normal(size=(steps, trials, size))
    innovations[rng.random((steps, trials)) < lost] = np.nan
    run = SimpleNamespace(estimates=rng.normal(size=(steps + 1, trials, size)), innovations=innovations)
    right = np.tile(np.eye(size), (steps + 1, 1, 1))
    law = SimpleNamespace(filter=SimpleNamespace(corrected=right, innovation=right))
    space = SimpleNamespace(difference=np.subtract)
    states = np.zeros((trials, steps + 1, size))
    rollout = SimpleNamespace(states=states, state_coordinates=space, controller_run=run)
    found = of_run(law, rollout, np.arange(trials))
    for name in ("NEES", "NIS"):
        assert found[name]["mean"] == pytest.approx(1, abs=0.01)
        assert found[name]["inside"] == pytest.approx(95, abs=3.3)  # three standard deviations of 400 knots


def test_funnels_of_known_truth() -> None:
    """A small part: levels are right at least as often as is stated, to 3 standard deviations of so few searches."""
    script = import_module("funnels")
    found = script.coverage(script.Config(repetitions=100))
    assert all(one["right"][0] >= 95 - 3 * 2.2 for one in found["known"].values())
    assert all(0.5 < one["of the largest"] <= 1.1 for one in found["known"].values())
    assert found["test"][0] == pytest.approx(95, abs=6.6)
    assert "known in closed form" in script.report({"coverage": found})


def test_benchmark_of_intervals() -> None:
    """A small part: differences cover exactly computed 93 % or more; so few rare studies only that it counts them."""
    script = import_module("benchmark_intervals")
    result = script.main(script.Config(quick=True, studies=10))
    assert all(0.93 < one["least"] <= one["mean"] <= 1 for one in result["differences"])
    for one in result["rare"]:
        assert one["covered"] == pytest.approx(1 - one["below"] - one["above"])
        assert one["covered"] > 0.5
    assert "rare failures, 95 % intervals" in script.report(result)


@pytest.mark.parametrize(("share", "times"), [(0.0, 1.0), (0.3, 3.0), (0.1, 5.0), (0.02, 8.0)])
def test_an_interval_of_a_standard_deviation_covers_it_also_with_heavy_tails(share: float, times: float) -> None:
    """Normal numbers, a share of which deviates by some times as much; three standard deviations of 400 studies."""
    script, rng = import_module("belief_space"), np.random.default_rng(0)
    true, covered = np.sqrt(1 - share + share * times**2), 0
    for _ in range(400):
        sample = np.where(rng.random(4000) < share, times, 1.0) * rng.normal(size=4000)
        value, low, high = script.deviation(sample)
        assert low < value < high
        covered += low <= true <= high
    assert 0.95 - 3.3e-2 <= covered / 400 <= 0.95 + 3.3e-2


@pytest.mark.long
def test_benchmark_of_sensors() -> None:
    """A small part: a drawn half of a preset and four noises; what is counted is what the trials say."""
    script = import_module("benchmark_sensors")
    result = script.main(script.Config(only=(14,), trials=6, workers=1))
    (row,) = result["rows"]
    assert row["robot"] == "my_robot"
    assert any(one.startswith("MeasurementNoise") for one in row["disturbances"])
    assert row["reached"] == [6] * 4
    assert result["summary"]["tests"] == 6
    assert not result["summary"]["harm"]
    won, lost = np.array([True] * 5 + [False]), np.zeros(6, dtype=bool)
    assert script.p_worse(lost, won) == pytest.approx(0.5**5)
    assert script.p_worse(won, lost) == 1.0
    assert "by more than chance" in script.report(result)


def test_benchmark_of_lags() -> None:
    """A small part: the template's disc does as well without its lag, and what is told of it is printed."""
    script = import_module("benchmark_lag")
    result = script.main(script.Config(robots=("my_robot",), presets=("light",), trials=3))
    row, at_its_word = result["rows"]
    assert row["reached"] == at_its_word["reached"] == [3] * 4
    assert row["periods"] == pytest.approx(0.48)
    assert 0 < row["told"] <= 1
    assert at_its_word["told"] == 1
    assert [one.time_constant for one in script.with_lag([MotorLag(0.1)], 0.5)] == [0.05]
    assert "| my_robot, light | 0.48 |" in script.report(result)


@pytest.mark.long
def test_benchmark_of_reliability() -> None:
    """On few problems: bad advice breaks the bare method and not the guarded one, which changes nothing elsewhere."""
    script = import_module("benchmark_reliability")
    # What else there is of random problems has tests of its own.
    result = script.main(script.Config(quick=True, kinds=("linear_2_1", "drive")))
    assert result["versions"]["lqrsim"]
    for found in result["stiff"].values():
        assert found["status"] == ["CONVERGED"] * 8
        assert max(found["improvement"]) < 1e-3
    assert result["fragile"]["1, without"]["status"].count("CONVERGED") < 8
    assert result["fragile"]["1, with"]["status"] == ["CONVERGED"] * 8
    assert list(result["random"]) == ["linear_2_1", "drive"]
    for found in result["random"].values():
        assert set(found["status"]) == {"CONVERGED"}
    for found in result["overhead"].values():
        assert all(found["same_bits"])
        assert all(bare == guarded for bare, guarded in found["iterations"])
    ablation = result["ablation"]
    assert len(ablation) == 16
    assert sum("skipped" in found for found in ablation.values()) == 4
    exact = ablation["dual, fixed, prior, safeguard"]
    np.testing.assert_allclose(exact["cost_from_start"], exact["cost"], rtol=1e-9)
    assert "handed over" in script.report(result)


@pytest.fixture(scope="module")
def quality() -> ModuleType:
    return import_module("benchmark_quality")


@pytest.mark.long
def test_benchmark_of_quality(quality: ModuleType, tmp_path: Path) -> None:
    """On two queries and five worlds, without peers: what solutions claim, recomputed by formulas of nobody's."""
    known = [50.0, 200.0]
    (tmp_path / "best_known.json").write_text(json.dumps({"0": known}), encoding="utf-8")
    search = quality.ingredients.multistart
    before = dict(vars(search))
    result = quality.main(quality.Config(quick=True, queries=2, peers=False, reference=tmp_path))
    assert {name: value for name, value in vars(search).items() if value is not before[name]} == {}
    (starts,) = result["starts"]["seeds"].values()
    ingredients = result["ingredients"]["rows"]
    clearance, limits, worlds, resolve = (result[name] for name in ("clearance", "limits", "worlds", "resolve"))
    robots = [worlds["robots"][robot][how]["smooth"] for robot in ("drive", "quadrotor") for how in ("free", "kept")]
    solved = [
        *starts.values(), *clearance["free"].values(), *clearance["kept"].values(), *limits["robots"].values(), *robots,
        *ingredients.values(),
    ]  # fmt: skip
    for found in solved:
        assert set(found["status"]) == {"CONVERGED"}
        np.testing.assert_allclose(found["claimed"], found["cost"], rtol=1e-9)
    np.testing.assert_allclose(starts["smooth"]["excess"], np.array(starts["smooth"]["cost"]) / known - 1)
    assert ingredients["7 starts, the default"]["cost"] == starts["smooth"]["cost"]
    assert ingredients["+ continuation"]["cost"] == starts["smooth, one start"]["cost"]
    assert ingredients["hover"]["cost"] == starts["smooth, hover"]["cost"]
    assert sum(ingredients["dropped late"]["all_iterations"]) > sum(starts["smooth"]["all_iterations"])
    for found in clearance["kept"].values():
        # Between the steps, the finer rollout ends elsewhere by the error of the coarser one.
        assert (np.array(found["between"]) < np.array(found["clearance"]) + 1e-6).all()
        np.testing.assert_allclose(found["violation"], np.maximum(-np.array(found["clearance"]), 0), atol=1e-9)
        assert max(found["violation"]) <= 1e-3
    for found in limits["robots"].values():
        assert all(found["within"])
        assert max(found["at_limits"]) > 0
        assert max(found["followed"]) < 1e-9
    for found in robots[1::2]:
        assert min(found["clearance"]) >= -1e-3
    for pairs in resolve.values():
        for pair in pairs:
            for solution in pair.values():
                assert solution["status"] == "CONVERGED"
                np.testing.assert_allclose(solution["claimed"], solution["cost"], rtol=1e-9)
    assert set(result["time"]["milliseconds"]) == {"smooth, one start", "smooth"}
    text = quality.report(result)
    assert "lower than the best known: smooth, seed 0, query 1" in text
    assert "IPOPT: skipped: not asked for" in text


def test_the_best_plans_cost_what_is_said_of_them(quality: ModuleType) -> None:
    """As many as are there; recomputed by formulas of nobody's, to rounding."""
    with np.load(FOLDER / "quality" / "best_plans.npz", allow_pickle=False) as plans:
        rows = list(zip(*(plans[name] for name in ("seed", "query", "cost", "controls")), strict=True))
    assert rows
    for seed, query, cost, controls in rows:
        problem = ls.scenarios.quadrotor(int(query), int(seed)).problem
        assert quality.peers.cost_of(problem, controls) == pytest.approx(cost, rel=1e-12)


@pytest.mark.long
def test_benchmark_of_quality_says_what_it_skips(quality: ModuleType, tmp_path: Path) -> None:
    config = quality.Config(
        quick=True, queries=1, sections=("starts",), peers=False, reference=tmp_path, seeds=(7,)
    )  # fmt: skip
    result = quality.main(config)
    assert "name its folder with --reference" in quality.report(result)
    assert all("excess" not in one for one in result["starts"]["seeds"]["7"].values())


def test_worlds_of_the_benchmark_of_quality(quality: ModuleType) -> None:
    """One in five has a barrier, with one gap in it, as wide as was drawn; each is what it is by its number alone."""
    worlds, distances = quality.random_worlds.worlds, quality.peers.truth.distances
    for kind in ("drive", "quadrotor"):
        drawn = [worlds.draw(kind, index) for index in range(15)]
        digests = [one.problem.digest for one in drawn]
        assert len(set(digests)) == 15
        assert worlds.draw(kind, 14).problem.digest == digests[14]
        assert worlds.draw(kind, 14, seed=1).problem.digest != digests[14]
        assert [i for i, one in enumerate(drawn) if one.gap is not None] == [4, 9, 14]
        for one in drawn[4::5]:
            (cost,) = one.problem.obstacle_costs
            gap, size = one.gap, len(one.gap.middle)
            world = cost.world.seen_by("xyz"[:size])
            across = [axis % size for axis in range(gap.axis + 1, gap.axis + size)]
            for axis, width in zip(across, gap.widths, strict=True):
                assert 0.05 <= width - 2 * cost.radius <= 0.25
                line = np.linspace(-0.5, 0.5, 20001)
                points = gap.middle + line[:, None] * np.eye(size)[axis]
                free = line[distances(world, points).min(axis=1) > 0]
                assert np.ptp(free) == pytest.approx(width, abs=1.1e-4)
            grid = np.meshgrid(*[np.linspace(-3, 3, 121)] * len(across))
            points = np.tile(gap.middle, (grid[0].size, 1))
            points[:, across] = np.stack([axis.ravel() for axis in grid], axis=1)
            fits = points[distances(world, points).min(axis=1) > cost.radius]
            assert (np.abs(fits - gap.middle)[:, across] < np.array(gap.widths) / 2 - cost.radius).all()
            start, goal = (state[:size] for state in (one.problem.start, one.problem.goal))
            assert (start - gap.middle)[gap.axis] * (goal - gap.middle)[gap.axis] < 0
            assert distances(world, np.array([start, goal])).min() > cost.radius


@pytest.fixture(scope="module")
def stress() -> ModuleType:
    return import_module("stress_test")


class TestStressTest:
    def test_half_fail_where_success_falls_through_one_half(self, stress: ModuleType) -> None:
        certain = [[rate, rate, rate] for rate in (1.0, 0.75, 0.25, 0.0)]
        found = stress.half_fail([*zip((1.0, 2.0, 8.0, 16.0), certain, strict=True)])
        assert found == {"value": pytest.approx(4.0), "above": 2.0, "below": 8.0}
        unsure = [[1.0, 0.6, 1.0], [0.7, 0.4, 0.9], [0.3, 0.1, 0.6], [0.1, 0.0, 0.4]]
        found = stress.half_fail([*zip((1.0, 2.0, 8.0, 16.0), unsure, strict=True)])
        assert found == {"value": pytest.approx(4.0), "above": 1.0, "below": 16.0}

    def test_half_may_fail_from_the_first_on_or_never(self, stress: ModuleType) -> None:
        assert stress.half_fail([(1.0, [0.2, 0.1, 0.4])]) == {"value": 1.0, "above": None, "below": 1.0}
        assert stress.half_fail([(1.0, [0.9, 0.8, 1.0])]) == {"value": None, "above": 1.0, "below": None}
        assert stress.half_fail([(1.0, [0.9, 0.8, 1.0]), (2.0, [0.6, 0.4, 0.8])]) == {
            "value": None, "above": 1.0, "below": None,
        }  # fmt: skip

    def test_only_strengths_that_can_be_and_differ_are_tried(self, stress: ModuleType) -> None:
        assert stress.possible(MassMismatch(0.1), (1.0, 2.0, 3.0, 4.0)) == [1.0, 2.0, 3.0]
        assert stress.possible(MeasurementDropouts(0.5), (1.0, 2.0, 3.0)) == [1.0, 2.0]
        assert stress.possible(MeasurementLatency(1), (1.0, 1.1, 2.0)) == [1.0, 2.0]


@pytest.mark.long
def test_three_links_go_round_posts(tmp_path: Path) -> None:
    script: Any = import_module("three_link_arm")
    found = script.main(script.Config(quick=True, out=tmp_path))
    assert found["status"] == "converged"
    assert found["planned"] >= found["missed"] + script.MARGIN
    assert found["calm"] == "reached"
    # MuJoCo's own distances, at each frame: undisturbed what was planned, within what the balls miss and a step moves.
    assert found["planned"] - found["missed"] - 0.01 < found["calm clear"] < found["planned"] + 1e-4
    assert found["noisy clear"] > 0
    assert found["noisy reached"] >= 0.7 * found["trials"]
    assert str(found["trials"]) in script.report(found)


def test_numbers_are_fitted_to_a_run_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan on paper fails in the plant; what that run recorded, with noise, is enough for one that does not."""
    script: Any = import_module("fit_to_data")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "tabulate", None)
        with pytest.raises(ls.InputError, match=r"want what it needs: pip install 'lqrsim\[sysid\]'"):
            script.main(script.Config(quick=True))
    try:
        script.library()
    except ls.InputError as error:
        pytest.skip(str(error))
    result = script.main(script.Config(quick=True))
    (case,) = result["cases"]
    for one in case["numbers"]:
        assert one["on paper"] < 0.8 * one["true"]
        # Four times the half of a 95 % interval that the fit itself states; and near in any case.
        assert abs(one["fitted"] - one["true"]) < 4 * one["within"] < 0.2 * one["true"]
    on_paper, fitted, true = case["plans"]
    assert on_paper["reached"] == 0
    assert fitted["reached"] == true["reached"] == fitted["trials"] == 10
    np.testing.assert_allclose(fitted["cost"], true["cost"], rtol=0.05)
    assert "slider_damping" in script.report(result)


@pytest.mark.long
def test_an_arm_is_fitted_to_a_run_that_failed() -> None:
    """Load, friction, damping and a motor; the plan for the fitted ones is followed as well as for the true ones."""
    script: Any = import_module("fit_to_data")
    try:
        script.library()
    except ls.InputError as error:
        pytest.skip(str(error))
    (case,) = script.main(script.Config(quick=True, only=("arm",)))["cases"]
    for one in case["numbers"]:
        # The intervals are those of a linear model without the kinks of friction; no number is off by a twentieth.
        assert abs(one["fitted"] - one["true"]) < 0.05 * one["true"]
    on_paper, fitted, true = case["plans"]
    assert on_paper["reached"] == 0
    assert fitted["reached"] == true["reached"] == fitted["trials"] == 10
    assert max(fitted["off"], true["off"]) < 0.05 * on_paper["off"]


@pytest.mark.long
def test_an_arm_reaches_past_a_shelf() -> None:
    """The first joint alone would hit the divider; plan and run keep the clearance, to the tolerance of constraints."""
    script: Any = import_module("mjcf_shelf")
    found = script.main(script.Config())
    (row,) = found["rows"]
    assert row["status"] == "CONVERGED"
    assert row["straight"] < 0
    assert min(row["planned"], row["run"]) > 0.02 - 1e-6
    assert max(row["missed"]) < 1e-5  # m, rad
    assert "arm of six hinges" in script.report(found)


@pytest.mark.parametrize(("file", "formula"), [("THRUSTERS", "thrusters"), ("SLUNG_LOAD", "slung_load")])
def test_formulas_are_those_of_their_files(file: str, formula: str) -> None:
    """Accelerations by `mj_forward`, and rates of positions by differences of MuJoCo's own way along velocities."""
    robot = ls.MjcfRobot(scene_from_xml(getattr(import_module("mjcf.files"), file), formula))
    dynamics, model = getattr(import_module("mjcf.formulas"), formula)(), robot.scene.model
    data, rng, nv = mujoco.MjData(model), np.random.default_rng(0), model.nv
    for _ in range(20):
        state = rng.normal(scale=0.3, size=2 * nv)
        state[2] += 3.0  # above the floor
        control = rng.uniform(0.0, 3.0, model.nu)
        data.qpos[:], data.qvel[:] = robot.configuration(state)
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        rate = dynamics.rate(state, control)
        # MuJoCo keeps the load's inertia about its own axes above 0: 1e-9 kg m^2 of the 0.13 about the quadrotor.
        np.testing.assert_allclose(rate[nv:], data.qacc, rtol=0, atol=1e-7 * np.abs(data.qacc).max())
        mujoco.mj_integratePos(model, data.qpos, data.qvel, 1e-6)
        moved = robot.state(data.qpos, data.qvel, near=state)[:nv]
        np.testing.assert_allclose((moved - state[:nv]) / 1e-6, rate[:nv], rtol=0, atol=1e-4)  # a one-sided difference


@pytest.mark.parametrize(
    ("winch", "load", "lifted"),
    [
        ("a motor, -60 to 0 N", "in the plane", 0.4), ("a motor, -60 to 0 N", "in space", -0.5),
        ("a rope of 1 m, no winch", "in space", 0.0), ("a servo with a lag of 0.1 s, -60 to 0 N", "in the plane", 0.4),
    ],
)  # fmt: skip
@pytest.mark.long
def test_a_crane_with_a_rope_converges(winch: str, load: str, lifted: float) -> None:
    """As the page says: by a run in MuJoCo, the load hangs at its goal, to 2 cm."""
    script: Any = import_module("mjcf_crane")
    found = script.solved(winch, load, lifted, 20)
    assert (found["status"], found["outcome"]) == ("CONVERGED", "reached")
    assert found["off"] < 0.02
    assert winch in script.report({"rows": [found]})


@pytest.mark.long
def test_a_body_that_nothing_touches_is_moved() -> None:
    """As the page says, from nothing, here in a few iterations: the box is past most of its way."""
    script: Any = import_module("mjcf_contacts")
    found = script.solved(script.CASES[0], script.Config(quick=True))
    assert found["off"] < 0.3 * found["way"]
    assert found["cost"] < found["rest"]
    assert "a disc pushes a box ahead" in script.report({"rows": [found]})


@pytest.mark.long
def test_pictures_of_own_robots_are_drawn(tmp_path: Path) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    script: Any = import_module("mjcf_pictures")
    result = script.main(script.Config(quick=True, out=tmp_path))
    assert len(result["figures"]) == 5  # four, and the sheet
    assert all((tmp_path / "figures" / name).stat().st_size > 1000 for name in result["figures"])


@pytest.mark.long
def test_the_packaged_quadrotor_by_its_mjcf() -> None:
    """MuJoCo's steps lead to the optimum of the formulas: to 1e-6 of the cost is wanted, what is left is rounding."""
    script: Any = import_module("mjcf_packaged")
    result = script.main(script.Config(quick=True, only=("quadrotor",)))
    found = result["quadrotor"]
    assert found["formulas"]["status"] == found["MJCF"]["status"] == "CONVERGED"
    assert found["relative"] < 1e-9
    assert found["apart"] < 1e-6
    assert "quadrotor" in script.report(result)


@pytest.mark.long
def test_benchmark_of_replanning(tmp_path: Path) -> None:
    """Every solve is counted once; and laws that plan again do what those that do not cannot."""
    script = import_module("benchmark_replanning")
    found = script.main(script.Config(quick=True, out=tmp_path))
    assert len(found["times"]["rows"]) == 12
    for row in found["times"]["rows"]:
        assert sum(row["ended"].values()) == row["plans"] >= 40
        assert 0 < row["median"] <= row["p999"] <= row["most"]
    # Two runs each: the first policy ends at the old goal and runs into the pillar.
    for what in ("goal", "pillar", "moving"):
        assert found["changes"][what]["re-planning"][0] == 100
        assert found["changes"][what]["the first policy"][0] == 0
    used = found["delay"]["used"]
    assert used["a quarter are late, predicted"] < 90 < used["one period, predicted"]
    assert set(found["estimate"]["presets"]["light"]["reached"]) == {
        "the first plan", "a new plan where it is needed", "a new plan each time",
    }  # fmt: skip
    # Two methods, one optimum; the other solvers are there or it is said why not.
    solvers = found["peers"]["rows"]
    assert {"lqrsim, prepare", "lqrsim, ilqr"} <= set(solvers)
    assert len(solvers) + len(found["peers"]["skipped"]) == 5
    for row in solvers.values():
        assert row["plans"] == 300
        assert row["converged"] == 100
        assert abs(row["more"]) < 1
    assert "### How long re-plans take" in script.report(found)


@pytest.mark.long
def test_a_learner_that_sees_the_state_does_as_its_expert_does_and_one_that_sees_the_time_does_not() -> None:
    script = import_module("gym_imitation")
    result = script.main(script.Config(quick=True))
    reached = {name: one["reached"] for name, one in result["agents"].items()}
    assert reached["the policy"] == 20
    assert reached["learnt, with the state"] >= 18
    assert reached["learnt, time alone"] <= 10
    assert "| the policy | 20 of 20 |" in script.report(result)


@pytest.mark.long
def test_board_of_realaigym() -> None:
    """Two of the runs: one whose model is right but for a motor's inertia, of zero, and one of velocity noise."""
    script = import_module("realaigym_board")
    result = script.main(script.Config(quick=True, robots=("pendubot",), versions=(1,)))
    (board,) = result["boards"]
    assert board["trials"] == 2
    assert board["columns"] == {"model": 1.0, "velocity noise": 1.0, "score": 1.0}
    assert "| pendubot, version 1 | 100.0 | 100.0 |" in script.report(result)


@pytest.mark.long
def test_a_network_learns_what_a_formula_lacks() -> None:
    pytest.importorskip("jax", reason="needs the `jax` extra")
    script: Any = import_module("jax_residual")
    result = script.main(script.Config(quick=True))
    assert result["misfit"]["with the network"] < 0.2 * result["misfit"]["formula"]
    found = result["runs"]
    assert found["with the network"]["apart"] < 0.1 < found["formula"]["apart"]
    assert found["with the network"]["stands"][0] > 0.8 > found["formula"]["stands"][0]
    for each in result["times"].values():  # one optimum, by the same iterations
        assert each["formula"]["iterations"] == each["the same in JAX"]["iterations"]
    assert "| with the network |" in script.report(result)


@pytest.mark.long
def test_weights_are_tuned_so_that_the_policy_fails_less() -> None:
    script: Any = import_module("tune_weights")
    result = script.main(script.Config(quick=True))
    rows = result["rows"]
    assert rows["tuned"]["fails"][1][2] < rows["the scenario's"]["fails"][1][1]  # the intervals are apart
    assert "| tuned |" in script.report(result)


def test_a_race_says_how_far_off_a_path_passes_the_waypoints() -> None:
    """Straight lines past them, one of them moved aside; knots are where the lines are not nearest."""
    race = import_module("race")
    aside = np.zeros((19, 3))
    aside[4] = 0.0, 0.0, 0.5  # across a leg from straight above, where the nearest place is on the leg itself
    aside[9] = 0.0, 0.7, 0.0
    path = np.vstack([race.START, race.WAYPOINTS + aside, race.GOAL])
    knots = [10 * k for k in range(1, 20)]
    at = np.arange(201) / 10
    states = np.column_stack([np.interp(at, np.arange(21), axis) for axis in path.T])
    found = race.misses(np.stack([states, states[:, [0, 1, 2]] + [0.0, 0.0, np.nan]]), knots)
    fine = np.column_stack([np.interp(np.arange(200001) / 10000, np.arange(21), axis) for axis in path.T])
    nearest = [
        np.linalg.norm(fine[10000 * k - 5000 : 10000 * k + 5000] - place, axis=1).min()
        for k, place in enumerate(race.WAYPOINTS, start=1)
    ]
    np.testing.assert_allclose(found[0], nearest, rtol=0, atol=2e-3)  # the sampling's: 16 m in 10,000 parts
    assert not (found[1] <= 1.0).any()  # a run that diverged passes nothing


def test_what_a_script_prints_as_json_has_no_infinity(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runner: Any = import_module("runner")
    monkeypatch.setattr(sys, "argv", ["script", "--json"])
    found = {"figures": [], "ratio": np.inf, "rows": [np.nan, 1.0, -np.inf]}
    runner.run(runner.Settings, lambda config: found, lambda result: "", None)
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert printed["result"] == {"figures": [], "ratio": None, "rows": [None, 1.0, None]}


def test_rows_that_are_kept_may_be_infinite(tmp_path: Path) -> None:
    """A solver that was not there has no least cost; read again, the report is of the same numbers."""
    runner: Any = import_module("runner")
    runner.Kept(tmp_path / "kept.json", {"trials": 1}).row("cost", lambda: [np.inf, 1.0])
    assert runner.Kept(tmp_path / "kept.json", {"trials": 1}).row("cost", pytest.fail) == [np.inf, 1.0]

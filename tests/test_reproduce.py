"""`lqrsim reproduce`: all experiments of the paper, the page that sums them up, and what happens when one fails."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands import reproduce
from lqrsim.commands.reproduce import results_page
from lqrsim.disturbances import InitialStateError, MotorLag

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "experiments"

GOOD = """
import argparse, json, pathlib
parser = argparse.ArgumentParser()
parser.add_argument("--out", type=pathlib.Path); parser.add_argument("--json", action="store_true")
parser.add_argument("--quick", action="store_true")
told = parser.parse_args()
(told.out / "figures").mkdir(parents=True, exist_ok=True)
(told.out / "figures" / "table_1.png").touch()
statement = dict(where="Sec. X", paper="it works", test="1 is 1", ours="1", holds=True, figure="table_1")
result = dict(versions=dict(lqrsim="0"), figures=["table_1.png"], quick=told.quick)
print(json.dumps(dict(result=result, report="## It works", statements=[statement])))
"""


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for scripts that stand in for the experiments, which take long."""
    folder = tmp_path / "experiments"
    folder.mkdir()
    monkeypatch.setattr(reproduce, "EXPERIMENTS", folder)
    return folder


def test_a_script_that_fails_does_not_stop_the_others(
    scripts: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (scripts / "table_1.py").write_text(GOOD)
    (scripts / "figure_3.py").write_text("import sys; sys.exit('no such robot')")
    (scripts / "figure_2.py").write_text("print('by the way')")
    assert main(["reproduce", "figure_3", "table_1", "figure_2", "--out", str(tmp_path / "out")]) == 1
    printed = capfd.readouterr()
    assert "no such robot" in printed.err
    assert "printed something that is not its result:\nby the way" in printed.err
    assert "FAILED figure_3: exit code 1" in printed.out
    assert "HOLDS          Sec. X: it works" in printed.out
    saved = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(saved["results"]) == ["table_1"]
    text = (tmp_path / "out" / "results.md").read_text()
    assert "| it works (Sec. X) | 1 is 1 | 1 | holds |" in text
    assert "Of 1 tests of what the paper says, 1 hold and 0 do not." in text
    assert main(["reproduce", "table_1", "--out", str(tmp_path / "out")]) == 0


def test_other_results_are_kept_on_request(scripts: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("table_1", "figure_2"):
        mine = GOOD.replace("## It works", f"## {name}").replace('lqrsim="0"', f'lqrsim="of {name}"')
        (scripts / f"{name}.py").write_text(mine)
    out = tmp_path / "out"
    assert main(["reproduce", "table_1", "--keep", "--out", str(out)]) == 2
    assert "--keep: got" in capsys.readouterr().err  # there is nothing to keep yet
    assert main(["reproduce", "table_1", "--out", str(out)]) == 0
    assert main(["reproduce", "figure_2", "--quick", "--keep", "--out", str(out)]) == 2
    assert "written without --quick, want the same option" in capsys.readouterr().err
    before = json.loads((out / "results.json").read_text())
    (out / "results.json").write_text(json.dumps(before | {"machine": "another machine"}))
    whole = json.loads((out / "results.json").read_text())
    spoilt = [{name: part for name, part in whole.items() if name != left_out} for left_out in whole]
    spoilt += [whole | {"results": bad} for bad in ({}, [], None, {"table_1": {}}, {"table_1": 3})]
    for bad in (*spoilt, [], 3, "text", "[" * 100_000):
        (out / "results.json").write_text(bad if isinstance(bad, str) else json.dumps(bad))
        assert main(["reproduce", "figure_2", "--keep", "--out", str(out)]) == 2
        assert "want a file that `lqrsim reproduce` wrote" in capsys.readouterr().err
    (out / "results.json").write_text(json.dumps(whole))
    assert main(["reproduce", "figure_2", "--keep", "--out", str(out)]) == 0
    page = (out / "results.md").read_text()
    assert "Computed with lqrsim of figure_2 on another machine." in page
    assert re.search(r"figure_2.py`, \d+ s, on (?!another)", page)
    assert re.search(r"table_1.py`, \d+ s, with lqrsim of table_1, on (?!another)", page)
    saved = json.loads((out / "results.json").read_text())
    assert list(saved["results"]) == ["figure_2", "table_1"]  # in the order of the page
    assert saved["results"]["table_1"] == before["results"]["table_1"]
    assert saved["machine"] == "another machine"  # which the page's first lines are about
    page = (out / "results.md").read_text()
    assert page.index("## figure_2") < page.index("## table_1")
    # A script that fails loses nothing.
    (scripts / "table_1.py").write_text("import sys; sys.exit(1)")
    assert main(["reproduce", "figure_2", "table_1", "--keep", "--out", str(out)]) == 1
    assert json.loads((out / "results.json").read_text())["results"]["table_1"] == before["results"]["table_1"]


def test_what_is_not_installed_is_skipped_and_named(
    scripts: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scripts / "table_1.py").write_text(GOOD.replace("quick=", "skipped='no A', b=dict(skipped='no B'), quick="))
    (scripts / "figure_2.py").write_text(GOOD.replace("quick=", "skipped=dict(c='no C'), quick="))
    assert main(["reproduce", "figure_2", "table_1", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out.splitlines()
    named = ["figure_2: skipped c: no C", "table_1: skipped: no A", "table_1: skipped b: no B"]
    assert [line for line in printed if ": skipped" in line] == named


def test_a_benchmark_of_what_is_not_installed_skips_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rotorpy", None)
    bench = import_module("adaptive_quad_bench")
    result = bench.main(bench.Config(quick=True))
    assert "skipped: rotorpy: got no such package, want it installed: pip install" in bench.report(result)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table_2"], "results: got 'table_2', want one of: figure_2, .*did you mean table_1"),
        (["--out", "/proc/nowhere"], "--out: got /proc/nowhere, want a folder that can be written"),
    ],
)
def test_bad_arguments_get_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)


@pytest.mark.skipif(os.name != "posix", reason="signals of process groups are POSIX's")
def test_ctrl_c_ends_the_script_too_and_leaves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "experiments"
    folder.mkdir()
    (folder / "table_1.py").write_text(
        "import os, pathlib, time\npathlib.Path(__file__).with_name('pid').write_text(str(os.getpid()))\ntime.sleep(60)"
    )
    code = "import sys, pathlib; from lqrsim import cli; from lqrsim.commands import reproduce\n"
    code += "reproduce.EXPERIMENTS = pathlib.Path(sys.argv[1])\n"
    code += "sys.exit(cli.main(['reproduce', 'table_1', '--out', sys.argv[2]]))"
    command = [sys.executable, "-c", code, str(folder), str(tmp_path / "out")]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 600
        while not (folder / "pid").exists() or not (folder / "pid").read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(600) == 130
        assert process.stderr is not None
        assert "lqrsim: stopped" in process.stderr.read()
    with pytest.raises(ProcessLookupError):
        os.kill(int((folder / "pid").read_text()), 0)
    assert not (tmp_path / "out").exists()


def test_every_script_has_its_place_on_the_page() -> None:
    """A script that reproduces something of the paper is run by `lqrsim reproduce`."""
    made = {path.stem for path in FOLDER.glob("*.py") if "def statements(" in path.read_text(encoding="utf-8")}
    assert made <= set(reproduce.SCRIPTS) <= {path.stem for path in FOLDER.glob("*.py")}


def same_page(folder: Path) -> dict[str, Any]:
    """Checks that the page and what is said in it follow from the numbers beside it; the numbers."""
    saved = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for name, found in saved["results"].items():
        script = import_module(name)
        assert script.report(found["result"]) == found["report"], name
        statements = script.statements(found["result"]) if hasattr(script, "statements") else []
        assert [vars(statement) for statement in statements] == found["statements"], name
        for file in found["result"]["figures"]:
            # Of the published page, the pdf files are not in the repository.
            assert file.endswith(".pdf") or (folder / "figures" / file).stat().st_size > 0
        for statement in found["statements"]:
            assert f"{statement['figure']}.png" in found["result"]["figures"]
    assert (folder / "results.md").read_text(encoding="utf-8") == results_page(saved)
    return saved


def test_the_published_page_is_what_the_scripts_wrote() -> None:
    saved = same_page(ROOT / "docs")
    assert not saved["quick"]
    assert list(saved["results"]) == list(reproduce.SCRIPTS)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """All of it, on a small part of the problems."""
    folder = tmp_path_factory.mktemp("paper")
    assert main(["reproduce", "--quick", "--out", str(folder)]) == 0
    return folder, same_page(folder)


@pytest.mark.long
def test_all_results_quickly(quick: tuple[Path, dict[str, Any]]) -> None:
    folder, saved = quick
    assert list(saved["results"]) == list(reproduce.SCRIPTS)
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert drawn == {name for found in saved["results"].values() for name in found["result"]["figures"]}
    page = (folder / "results.md").read_text(encoding="utf-8")
    for name in re.findall(r"\(figures/(\w+\.png)\)", page):
        assert name in drawn


@pytest.mark.long
def test_table_1_claims_what_its_plans_cost(quick: tuple[Path, dict[str, Any]]) -> None:
    """The costs of a fixed start, recomputed by formulas of nobody's; six digits are saved."""
    truth = import_module("peers.truth")
    found = quick[1]["results"]["table_1"]["result"]["seeds"]["0"]["smoothing, fixed start"]
    for query, cost in enumerate(found["cost"][:3]):
        scenario = ls.scenarios.quadrotor(query)
        problem = replace(scenario.problem, control_limits=(-float("inf"), float("inf")))
        assert problem.start is not None
        fixed = replace(problem, initial=ls.FixedState(problem.start))
        solution = ls.smooth(fixed, start=scenario.paper_start, stop="cost")
        assert truth.cost_of(problem, solution.trajectory.controls) == pytest.approx(cost, rel=1e-5)
        assert len(solution.iterations) == found["iterations"][query]


@pytest.mark.long
def test_stress_test_counts_what_simulations_do(quick: tuple[Path, dict[str, Any]]) -> None:
    """The same disturbances and numbers, without a campaign; the outcomes are the rollout's own."""
    result = quick[1]["results"]["stress_test"]["result"]
    for name, robot in result["robots"].items():
        scenario = ls.scenarios.get(name)
        plant, solution = scenario.plant(), ls.smooth(scenario.problem)
        (cell,) = [one for one in robot["together"] if (one["policy"], one["strength"]) == ("smooth", 1.0)]
        kinds = {"motor lag": MotorLag, "initial state error": InitialStateError}
        light = ls.disturbances.preset("light", plant)
        run = ls.simulate(plant, solution, disturbances=light, trials=cell["trials"], contacts=False, frames=False)
        assert run.outcome.count("reached") == cell["reached"]
        for alone in robot["alone"]:
            if alone["kind"] in kinds:
                (disturbance,) = [one for one in light if isinstance(one, kinds[alone["kind"]])]
                strength, rate = alone["range"][-1], alone["at_last"]
                run = ls.simulate(
                    plant, solution, disturbances=[disturbance.scaled(strength)], trials=robot["trials_alone"],
                    contacts=False, frames=False,
                )  # fmt: skip
                assert run.outcome.count("reached") == pytest.approx(rate * robot["trials_alone"])


@pytest.mark.long
def test_robust_policies_counts_what_simulations_do(quick: tuple[Path, dict[str, Any]]) -> None:
    """The policy of the smoother needs none of the script's plans and laws."""
    result = quick[1]["results"]["robust_policies"]["result"]
    scenario, presets = ls.scenarios.quadrotor(), result["presets"]
    plant, trials = scenario.plant(), presets["trials"]
    run = ls.simulate(
        plant, ls.smooth(scenario.problem), disturbances=ls.disturbances.preset("light", plant), trials=trials
    )
    told = presets["presets"]["light"]["reached"]
    assert told["smoother's policy"][0] == pytest.approx(100 * run.outcome.count("reached") / trials)
    assert told["offset free, safe plan"][0] > 80  # it misses fewer than 1 in 100: docs/robust_policies.md
    chances = result["chances"]["quadrotor, 'light'"]
    assert chances
    assert all(one["predicted"] <= one["asked"] for one in chances)


@pytest.mark.long
def test_minimal_total_cost_states_obey_the_true_dynamics(quick: tuple[Path, dict[str, Any]]) -> None:
    """Statements of the paper that do not depend on how many queries were looked at."""
    said = {
        (name, one["paper"]): one["holds"] for name, found in quick[1]["results"].items() for one in found["statements"]
    }
    assert said["convergence", "upon convergence the minimal-total-cost states satisfy the true dynamics"]
    assert said["convergence", "upon convergence policy and inverse policy give the same controls there"]
    assert said["figure_2", "7 iterations until convergence; from u*, prior"]
    assert said["figure_3", "a trajectory through the cage, without an initial one"]

"""Stress tests of scenarios of one's own: the commands that are printed run as they are, and constraints are kept."""

import html
import json
import re
import shlex
import sys
from pathlib import Path

import pytest

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.scenarios.references import resolve
from lqrsim.stress.campaign import run_campaign
from lqrsim.stress.results import Results
from lqrsim.stress.study import Campaign, Cell

OWN = """
import dataclasses

import lqrsim as ls

given = ls.scenarios.differential_drive()


def shorter(steps: int = 150) -> ls.Scenario:
    problem = dataclasses.replace(given.problem, steps=steps)
    return dataclasses.replace(given, name="my arena", problem=problem)


def walled() -> ls.Scenario:
    clearance = ls.Clearance(given.scene.world, radius=given.robot.radius, margin=0.05)
    problem = dataclasses.replace(given.problem, constraints=[clearance])
    return dataclasses.replace(given, name="walled", problem=problem)
"""
FEW = ["--strengths", "1", "--trials", "3", "--workers", "0", "--sweep", "scenario"]


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The scenarios are in the working directory, which has a space and a quote in its name."""
    folder = tmp_path / "my robot's"
    folder.mkdir()
    (folder / "own file.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(folder)
    return folder


def test_printed_commands_run_as_printed(
    elsewhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lqrsim.reports.FPS", 1)  # as fast as it gets
    reference = "own file.py:shorter,steps=8"
    assert main(["stress", reference, "--policies", "smooth", "open_loop", *FEW]) == 0
    folder = Path("runs") / "stress" / "my_arena"
    assert f"wrote {folder}" in capsys.readouterr().out
    assert main(["report", str(folder), "--scenario", reference, "--videos", "1"]) == 0
    page = html.unescape((folder / "report.html").read_text(encoding="utf-8"))
    printed = sorted(set(re.findall(r"<code>(lqrsim .*?)</code>", page)))
    results = Results(folder, scenario=reference)
    roundabout = Path("runs") / ".." / ".." / elsewhere.name / "own file.py:shorter,steps=8"
    assert Results(folder, scenario=str(roundabout)).campaign.resolved.problem.steps == 8
    with pytest.raises(ls.InputError, match=r"which .* was run on"):
        Results(folder, scenario="../own file.py:shorter,steps=8")
    assert results.command in printed
    assert {shlex.split(line)[1] for line in printed} == {"stress", "report", "replay"}

    (tmp_path / "another place").mkdir()
    monkeypatch.chdir(tmp_path / "another place")
    with pytest.raises(ls.InputError, match="code"):  # a file never chooses code to run
        _ = Results(elsewhere / folder).runner
    for line in printed:
        program, *words = shlex.split(line)
        assert program == "lqrsim"
        assert main(words) == 0, line
    assert Path("rollout.npz").is_file()


def test_what_cannot_keep_constraints_is_left_out_and_said_so(
    elsewhere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stress", "own file.py:walled", *FEW]) == 0
    says = "left out: ilqr, which cannot keep the scenario's constraints"
    assert says in capsys.readouterr().out
    folder = elsewhere / "runs" / "stress" / "walled"
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["campaign"]["policies"] == ["smooth", "open_loop", "replan"]
    assert manifest["left_out"] == says
    assert main(["report", str(folder), "--scenario", "own file.py:walled", "--videos", "0"]) == 0
    assert html.escape(says) in (folder / "report.html").read_text(encoding="utf-8").replace("&#39;", "&#x27;")


def test_policies_that_were_not_asked_for_are_not_said_to_be_left_out(
    elsewhere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stress", "own file.py:walled", "--policies", "open_loop", *FEW]) == 0
    assert "left out" not in capsys.readouterr().out


def test_of_a_file_that_lacks_the_function_those_are_offered_that_can_be_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not what it imports, nor its helpers."""
    text = "from dataclasses import dataclass\n\n\ndef rate(x, u, p):\n    return x\n\n\ndef camera(): ...\n"
    (tmp_path / "own.py").write_text(text, encoding="utf-8")
    assert main(["solve", f"{tmp_path / 'own.py'}:camra"]) == 2
    assert "got 'camra', want one of: camera (did you mean camera?)" in capsys.readouterr().err


def test_asked_by_name_it_is_refused(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = "policies: got ilqr, which cannot keep the scenario's constraints, want some of smooth, open_loop, replan,"
    wanted += " track, offset_free, track_per_cell, offset_free_per_cell"
    assert main(["stress", "own file.py:walled", "--policies", "ilqr", "smooth", *FEW]) == 2
    assert capsys.readouterr().err == f"lqrsim: error: {wanted}\n"
    assert not (elsewhere / "runs").exists()
    disturbances = resolve("own file.py:walled").disturbances
    with pytest.raises(ls.InputError, match="got ilqr, which cannot keep"):
        run_campaign(Campaign(scenario="own file.py:walled", sweeps={"own": disturbances}), "runs")


def test_a_campaign_knows_where_its_scenario_is(elsewhere: Path) -> None:
    """Workers and whoever reads the report may be in another folder."""
    found = Campaign(scenario="own file.py:shorter,steps=9", sweeps={"calm": ()}).scenario
    assert found == f"{elsewhere / 'own file.py'}:shorter,steps=9"
    assert Campaign(scenario="quadrotor,query=2", sweeps={"calm": ()}).scenario == "quadrotor,query=2"
    assert Campaign(scenario="package.robots:hallway", sweeps={"calm": ()}).scenario == "package.robots:hallway"


def test_a_file_may_import_the_files_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if Python ran it, wherever the command is run; also in a function, and in a worker. They hide no module."""
    monkeypatch.setattr(sys, "path", sys.path.copy())
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "arena_of_mine.py").write_text("STEPS = 9\n", encoding="utf-8")
    (folder / "length_of_mine.py").write_text("DT = 0.25\n", encoding="utf-8")
    (folder / "json.py").write_text("raise AssertionError\n", encoding="utf-8")
    (folder / "tests_own.py").write_text(
        "import arena_of_mine\n" + OWN + "\n\ndef beside() -> ls.Scenario:\n"
        "    import json\n\n    import length_of_mine\n\n"
        "    scenario = shorter(arena_of_mine.STEPS)\n    problem = scenario.problem\n    json.dumps(problem.steps)\n"
        "    return dataclasses.replace(scenario, problem=dataclasses.replace(problem, dt=length_of_mine.DT))\n",
        encoding="utf-8",
    )
    reference = f"{folder / 'tests_own.py'}:beside"
    problem = resolve(reference).problem
    assert (problem.steps, problem.dt) == (9, 0.25)
    in_worker = ["1" if word == "0" else word for word in FEW]
    assert main(["stress", reference, "--out", str(tmp_path / "run"), "--policies", "smooth", *in_worker]) == 0
    summaries = Results(tmp_path / "run", scenario=reference).cell_summaries()
    assert "error" not in summaries[Cell("smooth", "scenario", 1.0)].tally

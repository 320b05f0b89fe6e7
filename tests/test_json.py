"""`--json`: one object on stdout and nothing else there, with the numbers that Python has, to the last bit."""

import contextlib
import io
import json
import math
import re
import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import past_a_crate
import pytest
from tracking import weave

import lqrsim as ls
from lqrsim.cli import _parse, main
from lqrsim.codegen import disk_cache
from lqrsim.commands import COMMANDS
from lqrsim.stress.statistics import rate
from lqrsim.view import gl

OWN = """
import dataclasses

import lqrsim as ls


def noisy(std: float = 0.05) -> ls.Scenario:
    print("this is not the result")
    given = ls.scenarios.differential_drive()
    return dataclasses.replace(given, name="noisy", disturbances=(ls.disturbances.ControlNoise(std),))


def shifted(std: float = 0.1) -> ls.Scenario:
    given = ls.scenarios.differential_drive()
    here = ls.QuadraticCost((5000.0, 5000.0, 50.0), about=given.problem.start)
    problem = dataclasses.replace(given.problem, steps=3, final_cost=here)
    error = ls.disturbances.InitialStateError((0.0, std, 0.0))
    return dataclasses.replace(given, name="shifted", problem=problem, disturbances=(error,))
"""


def refuse(text: str) -> None:
    raise AssertionError(f"{text} is not JSON")


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs a command with --json; what it prints, which must be one line, and its exit code."""

    def run(*arguments: str, code: int = 0) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*arguments, "--json"]) == code
        out = capsys.readouterr().out
        assert out.count("\n") == 1
        found = json.loads(out, parse_constant=refuse)
        assert (found["format"], found["exit_code"]) == (f"lqrsim {arguments[0]}", code)
        return found

    return run


def same(found: object, meant: object) -> None:
    """Equal to the last bit; null is what is not finite."""
    if isinstance(meant, float) and not math.isfinite(meant):
        meant = None
    assert found == meant


def test_solve_and_simulate(printed: Any, tmp_path: Path) -> None:
    found = printed("solve", "differential_drive", "--out", str(tmp_path))
    assert found["wrote"] == [str(tmp_path / "solution.npz")]
    solution, shown = ls.load(tmp_path / "solution.npz", ls.Solution), found["solution"]
    for name in ("cost", "gap", "optimality", "violation", "detail", "solver", "scenario", "problem_digest", "success"):
        same(shown[name], getattr(solution, name))
    assert shown["status"] == "CONVERGED"
    assert shown["certificate"] == asdict(solution.certificate) | {"curvature": solution.curvature.name}
    assert len(shown["iterations"]) == len(solution.iterations) > 3
    for row, iteration in zip(shown["iterations"], solution.iterations, strict=True):
        for field in fields(iteration):
            same(row[field.name], getattr(iteration, field.name))
    assert [one["start"] for one in shown["candidates"]] == [one.start for one in solution.candidates]
    assert solution.clearance is not None
    assert shown["clearance"]["least"] == solution.clearance.min()
    end = solution.trajectory.states[-1]
    assert shown["goal"]["distance"] == solution.target.distance(end)

    noise = ["--control-noise", "0.05", "--trials", "3", "--seed", "2", "--first-trial", "4"]
    found = printed("simulate", found["wrote"][0], *noise)
    rollout, run = ls.load(found["wrote"][0], ls.Rollout), found["run"]
    table = ls.stress.outcomes(rollout, ls.scenarios.differential_drive().problem)
    assert [row["trial"] for row in run["trials"]] == [4, 5, 6]
    for name, column in table.columns().items():
        for row, value in zip(run["trials"], column.tolist(), strict=True):
            same(row[name], value)
    assert run["reached"] == rollout.reached.sum()
    assert rollout.collision_chance is not None
    assert run["collision_chance"] == rollout.collision_chance.max()
    assert found["tube_leaves_out"] == ""


BOUNDED = """
import dataclasses

import lqrsim as ls


def bounded() -> ls.Scenario:
    drive = ls.scenarios.differential_drive()
    bounds = ls.StateBounds({"x": (-0.2, 0.3), "y": (-9.0, 2.0)})
    return dataclasses.replace(drive, problem=dataclasses.replace(drive.problem, constraints=[bounds]))
"""


def test_violations_are_those_of_the_problem(printed: Any, drive_solution: ls.Solution, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(BOUNDED)
    plan, own = ls.save(drive_solution, tmp_path / "plan.npz"), f"{tmp_path / 'own.py'}:bounded"
    found = printed(
        "simulate", str(plan), "--scenario", own, "--trials", "3", "--first-trial", "5", "--force-noise", "1"
    )
    rollout = ls.load(found["wrote"][0], ls.Rollout)
    shown = {one["constraint"]: one for one in found["violations"]}
    assert sum(one["trials"] > 0 for one in shown.values()) > 1
    for name, by in {
        "x low": -0.2 - rollout.states[..., 0],
        "x high": rollout.states[..., 0] - 0.3,
        "y low": -9 - rollout.states[..., 1],
        "y high": rollout.states[..., 1] - 2,
    }.items():
        by, one = np.where(rollout.counts, by, 0.0)[:, 1:], shown.pop(f"StateBounds: {name}")
        assert one["trials"] == (by > 1e-6).any(axis=1).sum()
        k, t = np.unravel_index(by.argmax(), by.shape)
        assert one["most"] == pytest.approx(max(by.max(), 0.0), rel=1e-12)
        assert (one["trial"], one["time"]) == ((5 + k, rollout.times[1 + t]) if one["trials"] else (None, None))
    assert not shown


@pytest.mark.parametrize("own", [False, True], ids=["packaged", "constrained"])
def test_a_plan_of_another_horizon_is_run(own: bool, printed: Any, tmp_path: Path) -> None:
    """Its costs and violations are those of no problem that is known."""
    (tmp_path / "own.py").write_text(BOUNDED)
    plan = ls.save(weave(60), tmp_path / "plan.npz")
    scenario = f"{tmp_path / 'own.py'}:bounded" if own else "differential_drive"
    found = printed("simulate", str(plan), "--scenario", scenario)
    assert found["violations"] is None
    assert [one["cost"] for one in found["run"]["trials"]] == [None]


def test_not_converged_and_bad_input(printed: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ilqr = ["--solver", "ilqr", "--max-iterations", "1", "--out", str(tmp_path)]
    found = printed("solve", "quadrotor", *ilqr, code=1)
    assert found["solution"]["status"] == "MAX_ITERATIONS"
    assert found["solution"]["remedy"]
    assert main(["solve", "no_such_robot", "--json"]) == 2
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert (found["format"], found["exit_code"]) == ("lqrsim solve", 2)
    assert captured.err == f"lqrsim: error: {found['error']}\n"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("solve quadrotor --no-such-option 3", "no-such-option"),
        ("solve quadrotor --solver newton", "newton"),
        ("solve", "SCENARIO"),
        ("stress quadrotor --trials many", "many"),
        ("break quadrotor --rounds 0", "rounds: got 0"),
        ("no_such_command", "no_such_command"),
    ],
)
def test_usage_errors_are_an_object_too(arguments: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments.split(), "--json"]) == 2
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert (found["version"], found["exit_code"]) == (1, 2)
    assert says in found["error"]
    assert captured.err == f"lqrsim: error: {found['error']}\n"


@pytest.mark.parametrize("command", ["certify", "verify"])
def test_a_missing_file_is_named_without_escape_codes(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "nothing\x1b[2J.mp4"]) == 2
    error = capsys.readouterr().err
    assert "nothing?[2J.mp4, want a file that exists" in error
    assert error.removesuffix("\n").isprintable()


REQUIRED = {"bridge": ["--commands", "1"], "export": ["--c", "1"], "replay": ["--cell", "1", "--trial", "1"]}
CHOSEN = {"--overlays": "plan", "--policies": "smooth"}  # lists whose help does not show the choices


def listed(command: str, capsys: pytest.CaptureFixture[str]) -> tuple[list[str], list[tuple[str, str, list[str], str]]]:
    """The beginning of a valid command line, and the command's options in its help.

    Each with its opposite if it is a flag, values, and how the help shows these.
    """
    with pytest.raises(SystemExit):
        main([command, "--help"])
    printed = capsys.readouterr().out
    arguments = re.findall(r"^[│ ] ([A-Z{]\S*)", printed, re.MULTILINE)
    options = re.findall(r"^[│ ] (--[\w-]+)(?:, (--no-[\w-]+))?(?: (\S+(?: \S+)*))?", printed, re.MULTILINE)
    assert options

    def values(option: str, shown: str) -> list[str]:
        words = [word for word in shown.split() if word not in ("...", "│")]
        return [word[1:].split(",")[0].rstrip("}") if word[0] == "{" else CHOSEN.get(option, "1") for word in words]

    begun = [command, *(word for shown in arguments for word in values("", shown)), *REQUIRED.get(command, [])]
    return begun, [(option, opposite, values(option, shown), shown) for option, opposite, shown in options]


@pytest.mark.parametrize("command", COMMANDS)
def test_an_option_that_is_repeated_is_refused(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each option in the help of each command, with values; as --option=value and with underscores, too.

    The last value was taken in silence. The error is an object, too, where the command has --json.
    """
    begun, options = listed(command, capsys)
    for option, opposite, given, shown in options:
        again = [f"{option.replace('-', '_').replace('__', '--')}={given[0]}"] if len(given) == 1 else [option, *given]
        as_json = ["--json"] if option != "--json" and any(name == "--json" for name, *_ in options) else []
        wrong = [*begun, option, *given, *([opposite] if opposite else again), *as_json]
        times = 3 if option in begun else 2
        assert main(wrong) == 2, wrong
        out, err = capsys.readouterr()
        several = ", with all its values" if shown.endswith("...") or len(given) > 1 else ""
        assert err == f"lqrsim: error: {option}: got it {times} times, want it once{several}\n", wrong
        if as_json:
            assert json.loads(out)["error"] == err.removeprefix("lqrsim: error: ").rstrip(), wrong


@pytest.mark.parametrize("command", COMMANDS)
def test_errors_of_usage_have_no_markup_nor_types(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One value too few for each option of several values; and for three others, drawn, a word that is no number.

    tyro prints `[bold]X Y Z AT[/bold]` as it stands, and types as Python names them, where a value may be None.
    """
    begun, options = listed(command, capsys)
    rng = np.random.default_rng(list(COMMANDS).index(command))
    wrong = [[option, *given[:-1]] for option, _, given, _ in options if len(given) > 1]
    single = [option for option, _, given, shown in options if len(given) == 1 and shown[0] != "{"]
    wrong += (
        [[str(option), "many"] for option in rng.choice(single, min(3, len(single)), replace=False)] if single else []
    )
    for words in wrong:
        with contextlib.suppress(SystemExit):  # a word may be what an option wants
            _parse([*begun, *words])
        said = capsys.readouterr().err
        assert words[0] in said or words[-1] == "many", words
        assert not re.search(r"\[/?bold|NoneType|\{None\}|<class", said), words


LONG = "x" * 500  # longer than the lines of a box
WRONG = {
    "an option that no command has": ["--no-such-option"],
    "a value that is no number": ["--seed", "many"],
    "a choice that is none": ["--solver", "newton"],
    "an option without its value": ["--out"],
    "a flag with a value": ["--json=3"],
    "more arguments than there are": ["a", "b", "c", "d", "e", "f"],
    "a long word": [f"--{LONG}"],
    "nothing": [""],
    "an escape code": ["--\x1b[2J"],
}


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize("command", COMMANDS)
def test_wrong_options_of_every_command_are_one_object(
    command: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command's own object, on one line, and the same text on stderr, wherever --json stands."""
    chosen = 4 * list(COMMANDS).index(command) + 2 * (encoding == "ascii")  # two for each: all of them take a minute
    for what in [list(WRONG)[(chosen + i) % len(WRONG)] for i in range(2)]:
        for arguments in ([command, *WRONG[what], "--json"], [command, "--json", *WRONG[what]])[chosen // 2 % 2 :][:1]:
            streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
            monkeypatch.setattr(sys, "stdout", streams[0])
            monkeypatch.setattr(sys, "stderr", streams[1])
            assert main(arguments) == 2, what
            for stream in streams:
                stream.flush()
            out, err = (stream.buffer.getvalue().decode() for stream in streams)  # pyright: ignore[reportAttributeAccessIssue]
            (line,) = out.splitlines()
            found = json.loads(line)
            error = found["error"]
            assert (found["format"], found["version"], found["exit_code"]) == (f"lqrsim {command}", 1, 2), what
            assert err == f"lqrsim: error: {error}\n", what
            assert error.isprintable(), what
            assert not set("─│╭") & set(error), what
            assert "----" not in error.replace(LONG, ""), what
            assert error.count("x" * 50) == error.count(LONG) * (len(LONG) // 50), what  # no word is broken
            assert error.strip("- "), what


def test_in_a_process_of_its_own_stdout_has_nothing_else(tmp_path: Path) -> None:
    """With a scenario that prints."""
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    command = [sys.executable, "-m", "lqrsim.cli", "solve", f"{tmp_path / 'own.py'}:noisy", "--json"]
    done = subprocess.run([*command, "--out", str(tmp_path)], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["solution"]["cost"] == ls.load(tmp_path / "solution.npz", ls.Solution).cost
    assert "this is not the result" in done.stderr
    assert "CONVERGED" in done.stderr


def test_list_and_cache(printed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {one["name"]: one for one in printed("list")["scenarios"]}
    assert sorted(found) == sorted(ls.scenarios.names())
    assert found["differential_drive"]["states"][2] == {"name": "heading", "unit": "rad"}
    assert found["quadrotor"]["dt"] == ls.scenarios.quadrotor().problem.dt
    monkeypatch.setenv(
        "LQRSIM_CACHE_DIR", str(tmp_path)
    )  # with little in it: of all that the tests compile, it takes long
    assert ls.Dynamics(lambda x, u, p: [-x[0] + u[0]], states={"x": "m"}, controls={"u": "m/s"}).compiled
    found = printed("cache")
    assert found["items"]
    assert found["folder"] == str(disk_cache.folder())
    assert {item["what"] for item in found["items"]} <= {item.what for item in disk_cache.items()}


def test_verify(printed: Any, tmp_path: Path) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    printed("solve", "differential_drive", "--out", str(tmp_path))
    printed("simulate", str(tmp_path / "solution.npz"))
    shown = printed("verify", str(tmp_path / "rollout.npz"))["verification"]
    solution, rollout = ls.load(tmp_path / "solution.npz", ls.Solution), ls.load(tmp_path / "rollout.npz", ls.Rollout)
    again = ls.verify_run(rollout, solution=solution)
    assert (shown["passed"], shown["rms"], shown["worst"]) == (True, again.rms, again.worst)
    assert shown["tests"] == [asdict(test) for test in again.tests]
    np.testing.assert_array_equal(np.array(shown["seen"], dtype=float), again.seen)


def test_stress_report_and_replay(printed: Any, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    asked = ["--policies", "smooth", "open_loop", "--strengths", "0", "2", "--trials", "6", "--workers", "0"]
    campaign = printed("stress", "differential_drive", *asked, "--out", str(folder))["campaign"]
    results = ls.stress.Results(folder)
    assert campaign["complete"] is True
    assert len(campaign["cells"]) == len(results.cells) == 4
    for row, cell in zip(campaign["cells"], results.cells, strict=True):
        assert (row["policy"], row["sweep"], row["strength"]) == (cell.policy, cell.sweep, cell.strength)
        outcome = results.outcomes(cell).outcome.tolist()
        assert row["outcomes"] == {name: outcome.count(name) for name in row["outcomes"]}
        assert row["reached"]["value"] == outcome.count("reached") / 6
        assert row["deterministic"] == (cell.strength == 0)
        if cell.strength:
            assert row["reached"] == asdict(rate(outcome.count("reached"), 6))
    report = printed("report", str(folder), "--videos", "0")
    assert report["campaign"] == campaign
    assert report["wrote"] == [str(folder / "report.html")]
    again = printed("replay", str(folder), "--cell", "smooth,light,2", "--trial", "3", "--out", str(tmp_path / "r.npz"))
    assert again["differences"] == []
    assert again["cell"] == {"policy": "smooth", "sweep": "light", "strength": 2.0}
    (row,) = again["run"]["trials"]
    table = results.outcomes(next(cell for cell in results.cells if (cell.policy, cell.strength) == ("smooth", 2)))
    assert {name: row[name] for name in ("trial", "worst", "cost")} == {
        "trial": 3, "worst": table.worst[3], "cost": table.cost[3],
    }  # fmt: skip


@pytest.mark.long
def test_rare_and_break_print_their_files(printed: Any, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    reference = f"{tmp_path / 'own.py'}:shifted"
    small = {"rare": ["--particles", "60", "--repetitions", "2", "--shown", "1"], "break": []}
    for name, options in small.items():
        found = printed(name, reference, "--policy", "open_loop", *options, "--out", str(tmp_path / name))
        file = json.loads((tmp_path / name / f"{name}.json").read_text(encoding="utf-8"))
        assert {key: found[key] for key in file} == file
        assert set(found) - set(file) == {"exit_code", "wrote"}
    found = printed("rare", f"{reference},std=0.0001", "--policy", "open_loop", "--out", str(tmp_path / "none"), code=1)
    assert found["found"] is None
    assert "wrote" not in found


def test_harden_prints_its_file(printed: Any, tmp_path: Path) -> None:
    """A plan that is not as safe as requested: the exit code is 1, and the object has what the file has."""
    (tmp_path / "crate.py").write_text(past_a_crate.OWN, encoding="utf-8")
    asked = ["--strength", "2", "--particles", "40", "--repetitions", "2", "--rounds", "1", "--chance", "1e-6"]
    law = ["--policy", "track", "--design-disturbances", "scenario"]
    found = printed("harden", f"{tmp_path / 'crate.py'}:told", *asked, *law, "--out", str(tmp_path / "out"), code=1)
    file = json.loads((tmp_path / "out" / "harden.json").read_text(encoding="utf-8"))
    assert {key: found[key] for key in file} == file
    assert set(found) - set(file) == {"exit_code", "wrote"}
    assert (found["found"]["success"], len(found["found"]["rounds"])) == (False, 1)
    assert all(Path(path).is_file() for path in found["wrote"])


def test_demo(printed: Any, tmp_path: Path) -> None:
    found = printed("demo", "--robots", "differential_drive", "--no-video", "--out", str(tmp_path))
    (one,) = found["scenarios"]
    folder = tmp_path / "differential_drive"
    assert one["solution"]["cost"] == ls.load(folder / "solution.npz", ls.Solution).cost
    for name, run in one["runs"].items():
        rollout = ls.load(folder / f"{name}.npz", ls.Rollout)
        assert run["trials"][0]["goal"] == rollout.goal_distance[0]
    assert found["failures"] == []
    assert all(Path(path).is_file() for path in found["wrote"])


@pytest.mark.long
def test_reproduce(printed: Any, tmp_path: Path) -> None:
    found = printed("reproduce", "figure_3", "--quick", "--out", str(tmp_path))
    file = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert {key: found[key] for key in file} == file
    assert found["failures"] == []

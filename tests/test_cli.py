"""The commands, each on what the one before wrote; and bad input: one line, no traceback, a non-zero exit."""

import dataclasses
import inspect
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import av
import numpy as np
import pytest
from failing_solves import CASES
from mechanisms import arm
from refusing import error_line
from sampling import rarely

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.codegen import disk_cache
from lqrsim.commands import COMMANDS, console, solving, stressing
from lqrsim.commands.options import arguments_for, options_of
from lqrsim.commands.reproduce import SCRIPTS
from lqrsim.commands.solving import Solve
from lqrsim.view import gl

OWN_SCENARIOS = """
import dataclasses
import time

import lqrsim as ls


def shorter(steps: int = 120) -> ls.Scenario:
    given = ls.scenarios.differential_drive()
    return dataclasses.replace(given, name="shorter", problem=dataclasses.replace(given.problem, steps=steps))


def not_a_scenario() -> int:
    return 3


def endless() -> ls.Scenario:
    print("ready", flush=True)
    time.sleep(60)
    return shorter()
"""


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The solution file of the differential drive."""
    folder = tmp_path_factory.mktemp("solved")
    assert main(["solve", "differential_drive", "--out", str(folder)]) == 0
    return folder / "solution.npz"


@pytest.fixture(scope="module")
def rollout_file(solved: Path) -> Path:
    simulate(solved, solved.parent)
    return solved.with_name("rollout.npz")


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A Python file with scenarios that are not lqrsim's."""
    path = tmp_path / "own.py"
    path.write_text(OWN_SCENARIOS, encoding="utf-8")
    return path


def simulate(solved: Path, out: Path, *options: str) -> ls.Rollout:
    assert main(["simulate", str(solved), "--out", str(out), *options]) == 0
    return ls.load(out / "rollout.npz", ls.Rollout)


def test_list_names_every_scenario_with_units(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{name}: " in printed for name in ls.scenarios.names())
    assert "heading (rad)" in printed
    assert "rotor_1 (N)" in printed


def test_list_describes_the_robot_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(arm(0.3, names=("hinge",)), encoding="utf-8")
    assert main(["list", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "  controls: hinge (N m)" in printed
    assert "  held at rest by: hinge" in printed
    assert main(["list", "arm.xml"]) == 2
    assert "arm.xml" in error_line(capsys)


def test_solve_prints_the_log_and_writes_the_solution(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "quadrotor,query=2,seed=0", "--out", str(tmp_path), "--stop", "cost",
                 "--figure", str(tmp_path / "policy.pdf")]) == 0  # fmt: skip
    assert (tmp_path / "policy.pdf").read_bytes().startswith(b"%PDF")
    solution = ls.load(tmp_path / "solution.npz", ls.Solution)
    printed = capsys.readouterr().out
    assert solution.log in printed
    assert solution.summary() in printed
    assert solution.status is ls.Status.COST_CONVERGED
    assert solution.scenario == "quadrotor,query=2,seed=0"
    again = ls.smooth(ls.scenarios.quadrotor(query=2).problem, stop="cost")
    np.testing.assert_array_equal(solution.policy.gain, again.policy.gain)  # the same program: the same bits


@pytest.mark.parametrize("option", [["--solver", "ilqr"], ["--finish", "none"]])
def test_a_failed_solve_has_no_figure(option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its cost falls without end, so that it has no cost-to-go; it is saved, and is no bad input."""
    file, figure = tmp_path / "own.py", tmp_path / "policy.png"
    file.write_text("""from dataclasses import replace
import lqrsim as ls

def bent():
    scenario = ls.scenarios.differential_drive()
    cost = ls.SymbolicCost(lambda x, u, p: -(u.left**2) - u.right**2)
    return replace(scenario, problem=replace(scenario.problem, stage_cost=cost, control_limits=None))
""")
    out = tmp_path / "out"
    assert main(["solve", f"{file}:bent", "--out", str(out), "--figure", str(figure), *option]) == 1
    assert "no figure: the solve has no cost-to-go" in capsys.readouterr().out
    assert not ls.load(out / "solution.npz", ls.Solution).success
    assert not figure.exists()


@pytest.mark.parametrize("rows", [1, 3])
def test_a_solve_that_is_stopped_keeps_its_best_plan(
    rows: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C after some iterations. The file goes on as a start, and a finished solution that is there stays."""
    assert main(["solve", "quadrotor", "--starts", "1", "--out", str(tmp_path)]) == 0
    whole, say = (tmp_path / "solution.npz").read_bytes(), console.say

    def stop(text: str) -> None:
        say(text)
        if text.split()[0] == str(rows):
            raise KeyboardInterrupt

    monkeypatch.setattr(console, "say", stop)
    with pytest.raises(KeyboardInterrupt):
        Solve(scenario="quadrotor", starts=1, out=tmp_path).run()
    monkeypatch.undo()
    kept = ls.load(tmp_path / "stopped.npz", ls.Solution)
    assert (kept.status, len(kept.iterations)) == (ls.Status.INTERRUPTED, rows)
    assert console.summary_of(kept) in capsys.readouterr().out
    assert (tmp_path / "solution.npz").read_bytes() == whole
    assert main(["solve", "quadrotor", "--start", str(tmp_path / "stopped.npz"), "--out", str(tmp_path / "on")]) == 0


@pytest.mark.parametrize(
    "remedy", sorted({*(status.remedy for status in ls.Status), *(case.remedy for case in CASES.values())})
)
def test_a_remedy_that_a_command_prints_names_its_options(remedy: str, solved: Path) -> None:
    """Of the solver's options those that the command has, too: any that is left would be one for Python."""
    solution = dataclasses.replace(ls.load(solved, ls.Solution), remedy=remedy)
    printed = next((line for line in console.summary_of(solution).splitlines() if "remedy:" in line), "")
    options = {field.name for field in dataclasses.fields(Solve)}
    assert not {name for name in re.findall(r"(\w+)=", printed) if name in options}
    assert not {name for name in re.findall(r"(?<!-)\b[a-z]+_[a-z_]+\b", printed) if name in options}
    assert {name.replace("-", "_") for name in re.findall(r"--([a-z-]+)", printed)} <= options


def test_a_file_that_is_there_is_replaced_and_the_output_says_so(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solution = ls.load(solved, ls.Solution)
    for remark in ("", " in place of an older one"):
        console.save(solution, tmp_path / "solution.npz")
        assert capsys.readouterr().out == f"wrote {tmp_path / 'solution.npz'}{remark}\n"


def test_python_runs_the_package_as_the_command() -> None:
    run = subprocess.run([sys.executable, "-m", "lqrsim", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout == f"lqrsim {ls.__version__}\n"


def test_a_stopped_command_says_nothing_about_exceptions(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object, **options: Any) -> None:
        ls.smooth(ls.scenarios.differential_drive().problem, callback=interrupt)

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(solving.List, "run", stopped)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "lqrsim: stopped\n"


def test_solve_says_that_it_did_not_converge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["solve", "quadrotor", "--solver", "ilqr", "--max-iterations", "1", "--out", str(tmp_path)]
    assert main(command) == 1
    assert "remedy:" in capsys.readouterr().out
    solution = ls.load(tmp_path / "solution.npz", ls.Solution)
    assert (solution.status, solution.solver, len(solution.iterations)) == (ls.Status.MAX_ITERATIONS, "ilqr", 1)


def test_simulate_is_the_library_call_that_its_options_say(solved: Path, tmp_path: Path) -> None:
    noise = "--control-noise 0.05 --force-noise 2 --measurement-noise 0.01 0.01 0.02"
    rest = "--push 1 0 0 2.5 --seed 4 --trials 2 --first-trial 3"
    rollout = simulate(solved, tmp_path, *f"{noise} {rest}".split())
    disturbances = [
        ls.disturbances.ControlNoise(0.05),
        ls.disturbances.ForceNoise(2.0),
        ls.disturbances.MeasurementNoise((0.01, 0.01, 0.02)),
        ls.disturbances.Push((1.0, 0.0, 0.0), at=2.5),
    ]
    plant, solution = ls.scenarios.differential_drive().plant(), ls.load(solved, ls.Solution)
    again = ls.simulate(plant, solution, disturbances=disturbances, seed=4, trials=2, first_trial=3)
    np.testing.assert_array_equal(rollout.states, again.states)  # the same seed: the same bits
    assert rollout.disturbances == again.disturbances


def test_simulate_with_disturbances_by_name_and_without_feedback(solved: Path, tmp_path: Path) -> None:
    scenario, solution = ls.scenarios.differential_drive(), ls.load(solved, ls.Solution)
    options = "--disturbances light scenario:ControlNoise --strength 2 --push 1 0 0 2.5 --open-loop --seed 4"
    rollout = simulate(solved, tmp_path, *options.split())
    noise, push = ls.disturbances.ControlNoise(0.1), ls.disturbances.Push((1.0, 0.0, 0.0), at=2.5)
    disturbances = [*ls.disturbances.preset("moderate", scenario.plant()), noise, push]
    again = ls.simulate(scenario.plant(), solution.open_loop(), disturbances=disturbances, seed=4)
    np.testing.assert_array_equal(rollout.states, again.states)
    assert rollout.disturbances == again.disturbances
    # Without feedback the plan's controls are sent, whatever happens.
    np.testing.assert_array_equal(rollout.commanded[0], solution.trajectory.controls)
    assert main(["simulate", str(solved), "--disturbances", "gale"]) == 2


def test_simulate_predicts_where_the_run_will_be_or_says_why_not(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, solution = ls.scenarios.differential_drive(), ls.load(solved, ls.Solution)
    plant, noise = scenario.plant(), [ls.disturbances.ControlNoise(0.05), ls.disturbances.MeasurementNoise(0.01)]
    rollout = simulate(solved, tmp_path, "--control-noise", "0.05", "--measurement-noise", "0.01", "--open-loop")
    assert "tube" not in capsys.readouterr().out
    tube = ls.predict_tube(scenario.problem, solution.open_loop(), ls.uncertainty_of(plant, noise))
    assert rollout.tube is not None
    np.testing.assert_array_equal(rollout.tube, tube.covariance[:, :2, :2])
    np.testing.assert_array_equal(rollout.collision_chance, tube.step_chance)
    # Without feedback the wheels' noise adds up: the heading is off by the root of the time.
    std = np.sqrt(tube.covariance[:, 2, 2])
    np.testing.assert_allclose(std, np.sqrt(np.arange(151)) * np.sqrt(2) * 0.05 / 0.258 / 6, rtol=1e-6)

    pushed = simulate(solved, tmp_path, "--control-noise", "0.05", "--push", "1", "0", "0", "2.5")
    assert pushed.tube is not None
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "tube" in line]
    assert line.startswith("the predicted tube leaves out push of (1, 0, 0) N s at 2.5 s")
    assert simulate(solved, tmp_path).tube is None
    assert "tube" not in capsys.readouterr().out


def test_render_writes_a_video_of_a_rollout(solved: Path, tmp_path: Path) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    rollout = simulate(solved, tmp_path)
    size = ["--size", "320", "180", "--fps", "0.5"]
    assert main(["render", str(tmp_path / "rollout.npz"), "--out", str(tmp_path / "run.mp4"), *size]) == 0
    with av.open(str(tmp_path / "run.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.width, stream.height) == ("h264", 320, 180)
        assert stream.frames == int(rollout.times[-1] / 2) + 1


def test_own_scenario_in_a_file(own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reference = f"{own}:shorter,steps=100"
    assert main(["solve", reference, "--out", str(tmp_path)]) == 0
    solution = tmp_path / "solution.npz"
    assert ls.load(solution, ls.Solution).trajectory.steps == 100
    capsys.readouterr()
    # A file of someone else's must not decide what code runs here.
    assert main(["simulate", str(solution)]) == 2
    assert f"--scenario {reference}" in error_line(capsys)
    assert main(["simulate", str(solution), "--scenario", reference]) == 0


def test_runs_are_named_after_the_scenario(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not after the function that makes it; and what a file cannot be called is left out."""
    own.write_text(own.read_text().replace('name="shorter"', 'name="a/b: short, 2 m"'))
    monkeypatch.chdir(tmp_path)
    assert main(["solve", "own.py:shorter,steps=100"]) == 0
    solution = tmp_path / "runs" / "a_b_short_2_m" / "solution.npz"
    assert "wrote runs/a_b_short_2_m/solution.npz" in capsys.readouterr().out
    # What it says is to be given in any working directory.
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["simulate", str(solution)]) == 2
    option = error_line(capsys).split("which runs only with ")[1].removesuffix("\n")
    assert main(["simulate", str(solution), *shlex.split(option)]) == 0


def test_own_scenario_in_a_module(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert main(["solve", "own:shorter"]) == 0
    assert ls.load("runs/shorter/solution.npz", ls.Solution).scenario == "own:shorter"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("solve quadrotr", ["scenario: got 'quadrotr'", "differential_drive, quadrotor", "did you mean quadrotor?"]),
        ("solve quadrotor,querry=3", ["setting of quadrotor: got 'querry'", "query, seed"]),
        ("solve quadrotor,query=-1", ["query: got -1", ">= 0"]),
        ("solve quadrotor,query=x", ["query: got 'x'"]),
        ("solve nowhere.py:make", ["nowhere.py", "a Python file that exists"]),
        (
            "bridge a.npz --odometry /o --commands /c --names x=a y=b x=c",
            ["--names: got x=a y=b x=c, want each state at most once"],
        ),
        ("solve no_such_module:make", ["no_such_module", "can be imported"]),
        ("render .", ["ROLLOUT: got ., a folder, want a file that"]),
        ("render /", ["ROLLOUT: got /, a folder, want a file that"]),
        (
            "demo --robots quadrotor,query=1 quadrotor,query=2",
            ["--robots: got quadrotor,query=1 and quadrotor,query=2"],
        ),
        (
            "solve quadrotor --figure policy.bmp",
            ["--figure: got 'policy.bmp', want a name that ends in .png, .pdf, .svg"],
        ),
        (
            "solve quadrotor --figure /proc/nowhere/a.png",
            ["--figure: got /proc/nowhere/a.png, want a file that can be"],
        ),
        ("solve {own}:larger", ["got 'larger'", "shorter, not_a_scenario, endless"]),
        ("solve {own}:not_a_scenario", ["got a int", "want a lqrsim Scenario"]),
        ("solve {own}:shorter,steps=0", ["steps: got 0"]),
        ("solve quadrotor --tolerance -1 --out {tmp}", ["tolerance: got -1"]),
        ("solve quadrotor --max-iterations 0 --out {tmp}", ["max_iterations: got 0"]),
        ("solve quadrotor --out {own}/runs", ["--out: got", "a folder that can be written"]),
        ("simulate {tmp}/none.npz", ["none.npz", "a file that exists"]),
        ("simulate {own}", ["own.py", "a file that lqrsim wrote"]),
        ("simulate {truncated}", ["truncated.npz", "a file that lqrsim wrote"]),
        ("simulate {solved} --out {own}", ["--out: got", "a folder that can be written"]),
        ("simulate {solved} --scenario quadrotor", ["x, y, heading", "quadrotor"]),
        ("simulate {solved} --trials 0", ["trials: got 0"]),
        ("simulate {solved} --seed -1", ["seed: got -1"]),
        ("simulate {solved} --control-noise -0.1", ["ControlNoise: std: got -0.1"]),
        ("simulate {solved} --force-noise nan", ["ForceNoise: std: got nan"]),
        ("simulate {solved} --measurement-noise 1 2", ["MeasurementNoise: std: got 2 numbers", "x, y, heading"]),
        ("simulate {solved} --push 1 0 0 99", ["Push: at: got 99"]),
        ("render {solved}", ["holds a 'lqrsim solution'", "want a 'lqrsim rollout'"]),
        ("render {solved} --out x.avi", ["--out: got x.avi", ".mp4, .gif, .png, .html or .rrd"]),
        ("render", ["ROLLOUT: got none"]),
        ("demo --robots quadrotor hexapod --out {tmp}", ["scenario: got 'hexapod'"]),
        ("demo --out {own}", ["--out: got", "a folder that can be written"]),
    ],
)
def test_bad_input_is_one_line(
    command: str, says: list[str], solved: Path, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truncated = tmp_path / "truncated.npz"
    truncated.write_bytes(solved.read_bytes()[:-100])
    before = sorted(path.name for path in tmp_path.iterdir())
    capsys.readouterr()
    places = {"solved": solved, "own": own, "tmp": tmp_path, "truncated": truncated}
    assert main([word.format(**places) for word in command.split()]) == 2
    message = error_line(capsys)
    assert all(part in message for part in says), message
    assert sorted(path.name for path in tmp_path.iterdir()) in (before, sorted([*before, "__pycache__"]))


def test_what_is_done_quickly_is_not_talked_about(capsys: pytest.CaptureFixture[str]) -> None:
    """Only what is resumed says at once how much is done: that has taken somebody's time before."""
    for total in (1, 2, 150):
        with console.Progress("simulating", "step") as progress:
            for done in range(1, total + 1):
                progress(done, total)
    assert capsys.readouterr() == ("", "")
    with console.Progress("stressing", "trial") as progress:
        for done in (40, 60, 100):
            progress(done, 100)
    assert capsys.readouterr() == ("40 of 100 trials are done, 60 to go\n", "")


@pytest.mark.parametrize(("total", "each", "count"), [(12, 30.0, 12), (400, 0.7, 27), (3, 4000.0, 3)])
def test_lines_say_how_far_it_is_what_is_found_and_how_long_it_takes(
    total: int, each: float, count: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where there is no terminal, at most one in ten seconds, by a clock on which each part takes as long."""
    now, times = 0.0, list[float]()
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: now))
    with console.Progress("looking", "knot") as progress:
        for done in range(total + 1):
            progress(done, total, f"level {done}")
            for line in capsys.readouterr().out.splitlines():
                times.append(now)
                what, rate, left, found = re.split(", |; ", line)
                assert (what, found) == (f"looking: {done} of {total} knots", f"level {done}")
                assert float(rate.removesuffix(" knots/s")) == pytest.approx(1 / each, rel=0.01)
                *hours, minutes, seconds = map(int, left.removesuffix(" left").split(":"))
                assert 60 * (60 * sum(hours) + minutes) + seconds == pytest.approx((total - done) * each, abs=1.0)
            now += each
    assert len(times) == count
    assert (np.diff(times[:-1]) > 10.0).all()


@pytest.mark.skipif(os.name != "posix", reason="Windows has no semaphores with names")
def test_a_bar_leaves_no_semaphore_where_a_process_ends_at_once() -> None:
    """As a signal ends one; processes that are spawned, as by default from Python 3.14 on, would know it by a name."""
    program = """
import multiprocessing, os
multiprocessing.set_start_method("spawn")
from lqrsim.commands import console
with console.Progress("simulating", "step") as progress:
    progress(1, 3)
    console.say("above the bar")
    os._exit(0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("above the bar\n", "")


def test_help_has_a_line_for_each_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    begun = lines.index("commands:") + 1
    listed = lines[begun : lines.index("", begun)]
    assert [line.split()[0] for line in listed] == list(COMMANDS)
    assert all(line[2:].split(maxsplit=1)[1] == COMMANDS[line.split()[0]] for line in listed)
    assert all(line.endswith(".") for line in listed)


def test_help_of_reproduce_lists_all_results(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["reproduce", "--help"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in SCRIPTS)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert f"usage: lqrsim {command}".strip() in printed
    assert not re.search(r"\{None\}|\{\[|\[\{|\[\.\.\.\]|NoneType", printed)  # types, as tyro prints them


@pytest.mark.parametrize(
    ("command", "function", "names"),
    [
        (stressing.Rare, ls.stress.ReliabilityProblem.rare_failures, "particles repetitions"),
        (stressing.Break, ls.stress.ReliabilityProblem.smallest_failure, "rounds particles"),
        (stressing.Harden, ls.stress.harden, "chance rounds particles repetitions"),
        (stressing.Certify, ls.stress.certify, "repetitions seed"),
        (stressing.FunnelCommand, ls.funnel, "rate failures"),
        (stressing.Stress, ls.stress.Campaign, "strengths trials replan_every shard time_limit goal_radius seed"),
        (stressing.Stress, ls.stress.run_campaign, "workers batch scheduler"),
        (solving.Simulate, ls.simulate, "seed trials first_trial"),
    ],
)
def test_options_that_are_read_from_source_are_those_that_python_has(command: Any, function: Any, names: str) -> None:
    """Here the API is imported. Each of these options is passed on."""
    given, options = inspect.signature(function).parameters, {one.name: one for one in dataclasses.fields(command)}
    types = get_type_hints(function)  # without what is checked besides the type
    for name in names.split():
        assert options[name].default == given[name].default
        assert get_args(options[name].type)[0] == types[name]
    passed = arguments_for(function, SimpleNamespace(**dict.fromkeys(options, 0)), seed=1)
    assert {*names.split()} <= {*passed}
    assert passed["seed"] == 1


def test_an_option_that_the_api_does_not_describe_is_refused() -> None:
    with pytest.raises(AssertionError, match="harden does not say what nothing is"):
        options_of("stress/safer_plans.py", "harden", nothing="INT")(type("Command", (), {}))


def test_unknown_option_is_refused_before_anything_runs(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["solve", "quadrotor", "--tolerence", "1"])
    assert stop.value.code == 2
    assert "--tolerance" in capsys.readouterr().err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"lqrsim {ls.__version__}\n"


def start(*command: str) -> subprocess.Popen[str]:
    arguments = [sys.executable, "-m", "lqrsim.cli", *command]
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_exit_code_and_line_reach_the_shell() -> None:
    with start("solve", "quadrotr") as process:
        printed, error = process.communicate(timeout=600)
    assert (process.returncode, printed, error.count("\n")) == (2, "", 1)
    assert "Traceback" not in error


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one OpenGL")
@pytest.mark.parametrize("command", ["list", "verify", *rarely("render")])
def test_an_opengl_that_mujoco_cannot_load_is_one_line(
    command: str, monkeypatch: pytest.MonkeyPatch, rollout_file: Path
) -> None:
    """Whichever module imports MuJoCo first."""
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with start(command, *([] if command == "list" else [str(rollout_file)])) as process:
        printed, error = process.communicate(timeout=600)
    assert (process.returncode, printed, error.count("\n")) == (2, "", 1)
    assert error.count("MUJOCO_GL: got 'nonsense', with which MuJoCo cannot be imported here") == 1


@pytest.mark.skipif(sys.platform != "linux" or "DISPLAY" in os.environ, reason="GLFW works where there is a display")
def test_an_opengl_that_needs_a_display_is_one_line(monkeypatch: pytest.MonkeyPatch, rollout_file: Path) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with start("render", str(rollout_file), "--out", str(rollout_file.with_suffix(".png"))) as process:
        _, error = process.communicate(timeout=600)
    assert process.returncode == 2
    assert "Traceback" not in error
    assert "OpenGL: got glfw, which fails" in error.splitlines()[-1]


def test_in_python_an_opengl_that_mujoco_cannot_load_is_named() -> None:
    code = "import lqrsim as ls\ntry:\n    ls.render\nexcept ls.InputError as error:\n    print(error)"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "MUJOCO_GL": "nonsense"}, capture_output=True, text=True
    )
    assert done.stdout.startswith("MUJOCO_GL: got 'nonsense'"), done.stderr


@pytest.mark.parametrize(
    ("columns", "command"), [*((20, command) for command in COMMANDS), *((n, "solve") for n in range(1, 20, 4))]
)
def test_help_of_a_narrow_terminal_ends(
    columns: int, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With 5 columns or less it went on for ever. Less than 20 are taken for 20."""
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert "usage: lqrsim" in capsys.readouterr().out
    assert os.environ["COLUMNS"] == str(columns)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        *((f"view quadrotor {option}", option) for option in ("--trial 1", "--no-loop")),
        *((f"view run.npz {option}", option) for option in ("--disturbances 1", "--seed 3", "--push 1", "--replan 30")),
        ("verify run.npz --run other.npz", "--run"),
        ("report folder --out rates.csv --videos 2", "--videos"),
        ("simulate a.npz --strength 2 --force-noise 0.1", "--strength"),
        *(
            (f"render run.npz {option} {out}", option)
            for option in ("--solution a.npz", "--funnel a.npz", "--title one --overlays plan trace")
            for out in ("", "--out run.png", "--out run.gif")
        ),
        *((f"render run.npz {option} --out run.html", option) for option in ("--solution a.npz", "--funnel a.npz")),
        *(
            (f"stress quadrotor --resume {option}", option)
            for option in (
                "--sweep severe",
                "--policies smooth",
                "--trials 9",
                "--replan-every 0.1",
                "--shard 7",
                "--time-limit 9",
                "--strengths 1 2",
                "--goal-radius 0.1",
                "--goal-tolerance 0.1",
                "--seed 3",
                "--design-disturbances severe",
            )
        ),
        *(
            (f"bridge a.npz --odometry /o --commands /c --robot {option}", option)
            for option in ("--safe 0 0", "--lockstep", "--seconds 1", "--lost-after 1")
        ),
        ("bridge a.npz --odometry /o --commands /c --safe 0 --scenario quadrotor", "--scenario"),
    ],
)
def test_options_that_would_be_ignored_are_refused(words: str, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Before anything is read or solved."""
    assert main(words.split()) == 2
    assert capsys.readouterr().err.startswith(f"lqrsim: error: {option.split()[0].replace('no-', '')}: got ")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps a folder in which a process works")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_working_folder_that_was_removed_is_one_line(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is done."""
    words = {
        "new": ["robot"], "cache": [], "demo": [], "list": [], "reproduce": [], "compare": ["a"],
        "replay": ["a", "--trial", "0", "--cell", "0"], "bridge": ["a", "--scenario", "quadrotor", "--listen", "udp:1"],
    }.get(command, ["quadrotor"])  # fmt: skip
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    try:
        code = main([command, *words])
    except SystemExit as end:
        code = end.code
    error = capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    said = "lqrsim: error: working folder: got one that was removed, want one that exists: change to another\n"
    assert code == 2
    assert error == said or "usage" in error.lower() or "required" in error.lower()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such names")
@pytest.mark.parametrize(
    "command", ["new robot", "solve quadrotor", "stress quadrotor", "rare quadrotor", "harden quadrotor", "demo"]
)
def test_a_name_that_is_not_utf_8_is_refused_before_the_work(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lqrsim.commands.console.solve_and_print", None)
    assert main([*command.split(), "--out", os.fsdecode(b"b\xff")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "--out: got 'b\\udcff', want the path of an output, of names in UTF-8 of at most 255 bytes" in error


def test_too_little_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lqrsim.commands.solving.List.run", lambda self: len(np.zeros(1 << 58, np.int8)))
    assert main(["list"]) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(r"lqrsim: error: memory: got too little for this \(.*\), want more, or a smaller task\n", error)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
@pytest.mark.parametrize("megabytes", [999, *rarely(300)])
def test_too_little_address_space_is_refused_before_a_library_meets_it(megabytes: int) -> None:
    program = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({megabytes}_000_000,) * 2)\n"
        "from lqrsim.cli import main; raise SystemExit(main(['simulate', 'solution.npz']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert done.returncode == 2
    assert done.stderr == (
        f"lqrsim: error: memory: got {megabytes} MB of address space (ulimit -v), want at least 1000 MB\n"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    """In another process, for a video that could not even be begun ended it by a fault of memory."""
    program = """
import resource
from fractions import Fraction
from pathlib import Path
import numpy as np
import lqrsim as ls
from lqrsim.cli import main
from lqrsim.results.archive import replacing
from lqrsim.stress.results import write
from lqrsim.view.render import encoder

rng = np.random.default_rng(0)
arrays = dict(gain=rng.random((9000, 1, 1)), offset=rng.random((9000, 1)), nominal=rng.random((9000, 1)))
space = ls.types.Coordinates(names=("x",), units=("m",))
policy = ls.AffinePolicy(**arrays, dt=0.1, state_coordinates=space, control_coordinates=space)

def video():
    with replacing(Path("a.mp4")) as file, encoder(file, (64, 64), Fraction(30), crf=1, preset="ultrafast") as put:
        for number in range(60):
            put(np.random.default_rng(number).integers(0, 255, (64, 64, 3), dtype=np.uint8))

save = lambda: ls.save(policy, "a.npz")
table = lambda: write(bytes(50_000), Path("a.parquet"))
new = lambda: main(["new", "robot"])
for largest, work in ((0, new), (40_000, video), (4096, save), (4096, table), (0, save), (0, video)):
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))
    try:
        work()
    except ls.InputError as error:
        print(f"lqrsim: error: {error}")
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=600)
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.startswith("lqrsim: error")]
    assert done.returncode == 0, done.stderr
    assert len(said) == 6
    assert all(line.endswith("want a file that can be written (File too large)") for line in said)
    assert "Traceback" not in done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(("a.", ".unfinished", "robot"))]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send to another process")
def test_ctrl_c_is_one_line_and_leaves_nothing(own: Path, tmp_path: Path) -> None:
    with start("solve", f"{own}:endless", "--out", str(tmp_path / "out")) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (130, "lqrsim: stopped\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGPIPE, nor an exit code for it")
def test_whoever_reads_the_output_may_stop() -> None:
    with start("list") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        error = process.stderr.read()
    assert (process.returncode, error) == (141, "")


def test_cache_shows_and_clears(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    disk_cache.save("kept", bytes(10_000), "smoother for pendulum (2 states, 1 controls)")
    for name in ("part 1", "part 2"):
        disk_cache.save(name, bytes(10_000), "parts")
    assert main(["cache"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    kept, parts = sorted(lines)
    assert kept.startswith("    0.01 MB  last used 20")
    assert kept.endswith("smoother for pendulum (2 states, 1 controls)")
    assert parts.startswith("    0.02 MB  last used 20")
    assert parts.endswith("parts (2 items)")
    assert last == f"3 items, 0.0 of at most 537 MB, in {tmp_path}"
    assert main(["cache", "--clear"]) == 0
    assert capsys.readouterr().out == f"removed 3 items from {tmp_path}\n"
    assert list(tmp_path.iterdir()) == []


def test_many_iterations_are_not_many_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A solve of two thousand iterations: each of the first hundred, then ever fewer, with their true numbers."""
    scenario = ls.scenarios.differential_drive()
    solution = ls.smooth(scenario.problem, max_iterations=2)

    def solve(scenario: ls.Scenario, solver: str, *, callback: Any) -> ls.Solution:
        for _ in range(2000):
            callback(solution.iterations[0])
        return solution

    monkeypatch.setattr("lqrsim.scenarios.solutions.solve", solve)
    console.solve_and_print(scenario)
    rows = [int(line.split()[0]) for line in capsys.readouterr().out.splitlines() if line.split()[0].isdecimal()]
    assert rows == [*range(1, 100), *range(100, 1000, 10), *range(1000, 2001, 100)]

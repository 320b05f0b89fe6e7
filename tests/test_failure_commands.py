"""`lqrsim rare` and `lqrsim break`: what they print holds, the same seed gives the same files, nothing is left over."""

import dataclasses
import json
import re
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interrupting import interrupted
from refusing import error_line
from sampling import is_short, rarely
from scipy import stats

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.scenarios import solutions
from lqrsim.scenarios.references import resolve
from lqrsim.stress import reliability
from lqrsim.stress.failure_search import TrialScore, write_json

# One random number decides: how far towards the wall behind it the robot begins.
OWN = """
import dataclasses

import numpy as np

import lqrsim as ls
from lqrsim.disturbances import ActuatorLoss, Disturbance, Effect, ForceNoise, MeasurementDropouts, Push


@dataclasses.dataclass(frozen=True)
class Shift(Disturbance):
    std: float
    most: float

    def scaled(self, strength):
        return Shift(strength * self.std, self.most)

    def describe(self, plant):
        return f"shifted to the south, std {self.std:g} m"

    def start(self, plant, plan, generators):
        offset = np.zeros((len(generators), plan.states.shape[1]))
        offset[:, 1] = [-min(self.std * generator.standard_normal(), self.most) for generator in generators]
        return Effect(initial_states=lambda states: states + offset)


def shifted(std: float = 0.1, most: float = 9.0, steps: int = 1) -> ls.Scenario:
    given = ls.scenarios.differential_drive()
    here = ls.QuadraticCost((5000.0, 5000.0, 50.0), about=given.problem.start)
    problem = dataclasses.replace(given.problem, steps=steps, final_cost=here)
    shift = (Shift(std, most),)  # a robot that is to stay, within its radius of where its plan begins and ends
    near = given.robot.radius
    return dataclasses.replace(given, name="shifted", problem=problem, disturbances=shift, goal_radius=near)


def lossy(std: float, *kinds: Disturbance) -> ls.Scenario:
    return dataclasses.replace(shifted(std), disturbances=(*shifted(std).disturbances, *kinds))


def losing(loss: float = 0.1) -> ls.Scenario:
    return lossy(0.1, MeasurementDropouts(loss), ActuatorLoss("create_wheel_left"))


def pushed() -> ls.Scenario:
    return dataclasses.replace(shifted(), disturbances=(Push((0.1, 0.0, 0.0), at=0.1),))


def blocked() -> ls.Scenario:
    given = ls.scenarios.quadrotor(query=3)
    return dataclasses.replace(given, disturbances=(ForceNoise(0.01),))
"""
OPEN = ["--policy", "open_loop"]  # it stays where it was shifted to
SMALL = ["--particles", "60", "--repetitions", "5"]


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("own") / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return str(path)


def found(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def exact(scenario: ls.Scenario) -> float:
    """How many standard deviations to the south it takes until it collides: by halving, one trial at a time."""
    (shift,) = scenario.disturbances
    trials = TrialScore(scenario.plant(), ls.smooth(scenario.problem).open_loop(), [shift])
    low, high = 0.0, 40.0
    assert trials([[high]])[0] > 0
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if trials([[middle]])[0] > 0 else (middle, high)
    return high


def test_rare_measures_a_probability_that_is_known(
    own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference = f"{own}:shifted"
    distance = exact(resolve(reference))
    assert main(["rare", reference, *OPEN, *SMALL, "--shown", "3", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    rare = found(tmp_path / "rare.json")
    numbers, asked = rare["found"], rare["asked"]
    assert abs(numbers["probability"] - stats.norm.sf(distance)) < 4 * numbers["standard_error"]
    assert 0 < numbers["standard_error"] < 0.5 * stats.norm.sf(distance)
    p, n = numbers["probability"], numbers["plain_trials"]
    assert np.sqrt(p * (1 - p) / n) == pytest.approx(numbers["standard_error"])
    assert f"{p:.2g} [{numbers['low']:.2g}, {numbers['high']:.2g}] (95 % interval, 5 repetitions)" in printed
    assert f"{numbers['simulations']:,} trials" in printed
    assert (asked["scenario"], asked["policy"], asked["particles"]) == (reference, "open_loop", 60)
    assert rare["disturbances"] == [{"kind": "Shift", "settings": {"std": 0.1, "most": 9.0}}]
    # What is written fails, the worst first.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["certificate.npz", "rare.json", "rollout.npz"]
    rollout = ls.load(tmp_path / "rollout.npz", ls.Rollout)
    assert rollout.outcome == ("collided",) * 3
    assert rollout.frames.shape[1] > 1
    begun = rollout.states[:, 0, 1]
    assert begun[0] == begun.min()


def test_a_certificate_is_measured_again_and_a_false_one_is_found_out(
    own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same bits, in whole or in part. Other bits, or fresh numbers whose interval is elsewhere, exit with 1."""
    reference, file = f"{own}:shifted", str(tmp_path / "certificate.npz")
    few = ["--particles", "20", "--repetitions", "3", "--strength", "3"]
    assert main(["rare", reference, *OPEN, *few, "--out", str(tmp_path)]) == 0
    for more in ([], ["--repetitions", "2"]):
        assert main(["certify", file, "--scenario", reference, *more]) == 0
        assert "as certified, to the last bit" in capsys.readouterr().out
    assert main(["certify", file, "--scenario", reference, "--seed", "7"]) == 0
    assert "as certified: the intervals overlap" in capsys.readouterr().out
    assert main(["certify", file]) == 2
    assert "scenario: got none, want the certificate's scenario" in capsys.readouterr().err
    true = ls.load(file, ls.stress.FailureCertificate)
    less = {name: getattr(true, name) / 1000 for name in ("probability", "low", "high", "repetitions")}
    for change, more, says in (
        (less, [], "NOT as certified: repetition 0: got"),
        (less, ["--seed", "7"], "NOT as certified: probability: got"),
        ({"policy_digest": "0"}, [], "NOT as certified: policy_digest: got"),
    ):
        false = ls.save(dataclasses.replace(true, **change), tmp_path / "false.npz")
        assert main(["certify", str(false), "--scenario", reference, "--repetitions", "2", *more]) == 1
        assert says in capsys.readouterr().out
    with pytest.raises(ls.InputError, match=r"want a number from .*, its interval"):
        dataclasses.replace(true, probability=0.0)
    with pytest.raises(ls.InputError, match="of which the probability is the mean"):
        dataclasses.replace(true, repetitions=true.repetitions * 1.01)


@pytest.mark.long
def test_break_finds_a_distance_that_is_known(own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reference = f"{own}:shifted,std=0.04"
    distance = exact(resolve(reference)) / 2
    words = ["--strength", "2", "--rounds", "1", "--out", str(tmp_path)]
    assert main(["break", reference, *OPEN, *words]) == 0
    printed = capsys.readouterr().out
    numbers = found(tmp_path / "break.json")["found"]
    assert distance < numbers["distance"] < 1.001 * distance
    assert numbers["first_order_probability"] == pytest.approx(stats.norm.sf(numbers["distance"]))
    assert numbers["numbers"] == pytest.approx([numbers["distance"]])
    assert f"{numbers['distance']:.3g} standard deviations from the undisturbed trial" in printed
    assert "100.0 % of the squared distance: shifted to the south, std 0.08 m (1 numbers)" in printed
    rollout = ls.load(tmp_path / "rollout.npz", ls.Rollout)
    assert rollout.outcome == ("collided",)
    assert -0.001 < rollout.clearance[0].min() < 0


def test_draws_with_few_values_are_named_where_splitting_may_miss_failures(own: str) -> None:
    """Not of counted failures, nor draws without such values, nor losses that are not drawn."""
    losing, shifted = (
        ls.stress.ReliabilityProblem(f"{own}:{name}", strength=1.5, policy="open_loop")
        for name in ("losing", "shifted")
    )
    named = "few values, as of 15 % of measurements lost; rare_failures(keep=0) counts"
    options: dict[str, Any] = {"particles": 60, "repetitions": 2}
    assert named in str(losing.rare_failures(**options))
    for problem, keep in ((losing, 0.0), (shifted, 0.1)):
        assert "few values" not in str(problem.rare_failures(**options, keep=keep))


def same_files(one: Path, other: Path, name: str) -> None:
    assert (one / name).read_bytes() == (other / name).read_bytes()
    runs = [ls.load(folder / "rollout.npz", ls.Rollout) for folder in (one, other)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)


def test_python_and_the_commands_give_the_same(own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same seed, the same files. One problem is asked twice: what the first search simulated does not count for the
    second.
    """
    reference = f"{own}:shifted"
    command, python = tmp_path / "command", tmp_path / "python"
    more = [*OPEN, "--strength", "2", "--out", str(command)]
    assert main(["rare", reference, "--particles", "20", "--repetitions", "2", "--shown", "2", *more]) == 0
    rare_says = capsys.readouterr().out
    problem = ls.stress.ReliabilityProblem(reference, strength=2, policy="open_loop")
    told: list[str] = []
    rare = problem.rare_failures(particles=20, repetitions=2, report=told.append)
    shown = rare.save(python, shown=2)
    assert (shown.trials, shown.outcome) == (2, ("collided",) * 2)
    assert rare_says.startswith("\n".join([*told, str(rare)]))
    numbers = found(command / "rare.json")["found"]
    assert (rare.probability.value, rare.probability.high) == (numbers["probability"], numbers["high"])
    assert rare.splitting.simulations == numbers["simulations"]
    same_files(command, python, "rare.json")
    of_study = dataclasses.replace(problem, seed=1).rare_failures(particles=20, repetitions=2).splitting
    of_call = problem.rare_failures(particles=20, repetitions=2, seed=1).splitting
    assert of_study.repetitions.tolist() == of_call.repetitions.tolist()
    assert main(["break", reference, "--rounds", "1", "--particles", "30", "--seed", "3", *more]) == 0
    break_says = capsys.readouterr().out
    told.clear()
    smallest = problem.smallest_failure(rounds=1, particles=30, seed=3, report=told.append)
    assert smallest.save(python).outcome == ("collided",)
    assert break_says.startswith("\n".join([*told, str(smallest)]))
    numbers = found(command / "break.json")["found"]
    assert (smallest.point.distance, smallest.simulations) == (numbers["distance"], numbers["simulations"])
    assert list(smallest.shares) == numbers["shares"] == pytest.approx([1.0])
    same_files(command, python, "break.json")


@pytest.mark.parametrize("seed", [0, *rarely(1, 2)])
def test_the_search_for_first_failures_has_the_given_number_of_particles(own: str, seed: int) -> None:
    """More particles, more trials; 200 are the default. All find the same failure, to a tenth."""
    problem = ls.stress.ReliabilityProblem(f"{own}:shifted", strength=2, policy="open_loop")
    given: list[dict[str, Any]] = [{"particles": 20}, {"particles": 60}, *[{}] * (not is_short())]
    found = [problem.smallest_failure(rounds=1, seed=seed, **more) for more in given]
    sizes = [one.options["particles"] for one in found]
    assert sizes == [20, 60, 200][: len(given)]
    for one, other in pairwise(found):
        more = other.options["particles"] - one.options["particles"]
        assert other.simulations - one.simulations > 2 * more - 1  # two repetitions, of at least one level
    for one in found:
        assert one.point.distance == pytest.approx(found[-1].point.distance, rel=0.1)


def test_a_given_solution_is_what_fails(own: str, tmp_path: Path) -> None:
    """A plan that is given without its feedback fails as the policy open_loop does, to the last digit."""
    reference, given = f"{own}:shifted", tmp_path / "solution.npz"
    still = ls.smooth(resolve(reference).problem).open_loop()
    ls.save(still, given)
    few = ["--particles", "20", "--repetitions", "2", "--shown", "2", "--strength", "2"]
    for name, words in {"solved": OPEN, "given": ["--solution", str(given)]}.items():
        assert main(["rare", reference, *few, *words, "--out", str(tmp_path / name)]) == 0
    written = {name: found(tmp_path / name / "rare.json") for name in ("solved", "given")}
    assert written["given"]["found"] == written["solved"]["found"]
    assert written["given"]["policy"] == written["solved"]["policy"]
    assert written["solved"]["asked"]["solution"] is None
    # The same in Python, of the solution itself.
    problem = ls.stress.ReliabilityProblem(reference, strength=2, solution=still)
    problem.rare_failures(particles=20, repetitions=2).save(tmp_path / "python", shown=2)
    same_files(tmp_path / "given", tmp_path / "python", "rare.json")
    assert main(["break", reference, "--rounds", "1", *few[-2:], "--solution", str(given), "--out", str(tmp_path)]) == 0
    assert found(tmp_path / "break.json")["policy"] == written["given"]["policy"]


@pytest.mark.parametrize(
    ("options", "says"),
    [({"particles": 19}, "particles: got 19"), ({"repetitions": 1}, "repetitions: got 1"), ({"seed": -1}, "seed")],
)
def test_options_are_refused_before_anything_is_solved(options: dict[str, Any], says: str) -> None:
    problem = ls.stress.ReliabilityProblem("quadrotor")
    with pytest.raises(ls.InputError, match=says):
        problem.rare_failures(**options)
    assert "score" not in vars(problem)


@pytest.mark.parametrize("command", ["rare", *rarely("break")])
def test_where_there_is_no_failure_it_says_so(
    command: str, own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reliability, "MOST_BATCHES", 4)
    small = ["--particles", "20", *(["--repetitions", "2"] if command == "rare" else ["--rounds", "3"])]
    words = [command, f"{own}:shifted,most=0.2", *OPEN, *small, "--out", str(tmp_path / "out")]
    assert main(words) == 1
    assert "no failure was found" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("rare quadrotr", ["scenario: got 'quadrotr'", "did you mean quadrotor?"]),
        ("rare {own}:shifted --sweep gale", ["disturbances: got 'gale'", "scenario, calm, light"]),
        ("rare {own}:shifted --sweep scenario:Gusts", ["kind of disturbance in scenario: got 'Gusts'", "Shift"]),
        ("rare {own}:shifted --strength 0", ["strength: got 0", "> 0"]),
        ("rare {own}:shifted --strength nan", ["strength: got nan"]),
        ("rare {own}:shifted --seed -1", ["seed: got -1"]),
        ("rare {own}:shifted --particles 5", ["particles: got 5", ">= 20"]),
        ("rare {own}:shifted --repetitions 1", ["repetitions: got 1"]),
        ("rare {own}:shifted --shown 0", ["shown: got 0"]),
        ("rare {own}:pushed", ["sweep: got 'scenario', in which nothing is random"]),
        ("break {own}:pushed", ["sweep: got 'scenario', in which nothing is random"]),
        ("break {own}:shifted --rounds -1", ["rounds: got -1"]),
        ("break {own}:blocked", ["policy: got smooth, which fails with all random numbers at zero"]),
    ],
)
def test_bad_input_is_one_line(
    command: str, says: list[str], own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main([*(word.format(own=own) for word in command.split()), "--out", str(out)]) == 2
    error = error_line(capsys)
    assert all(part in error for part in says), error
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("funnel quadrotor --rate 1", "rate: got 1"),
        ("funnel quadrotor --confidence 0.3", "confidence: got 0.3"),
        ("funnel quadrotor --knots 150", "knots: got (150,), want some of 0 to 149"),
        ("funnel quadrotor --states q", "states: got 'q'"),
        ("funnel quadrotor --failures -1", "failures: got -1"),
        ("funnel quadrotor --seed -1", "seed: got -1"),
        ("funnel quadrotor --goal-tolerance 0.1", "goal_tolerance: got 0.1, want goal_radius"),
        ("funnel quadrotor --policy track --design-disturbances gale", "got 'gale'"),
        ("rare quadrotor --goal-tolerance 0.1", "goal_tolerance: got 0.1, want goal_radius"),
        ("rare quadrotor --policy track --design-disturbances gale", "got 'gale'"),
        ("rare quadrotor --repetitions 0", "repetitions: got 0"),
        ("break quadrotor --rounds 0", "rounds: got 0"),
        ("break quadrotor --particles 19", "particles: got 19"),
    ],
)
def test_commands_check_their_options_before_they_solve(
    command: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solutions, "solve", lambda *_: pytest.fail("solved"))
    assert main([*command.split(), "--out", str(tmp_path / "out")]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send to another process")
@pytest.mark.parametrize(
    ("command", "at", "says"),
    [
        *rarely(
            ("rare --particles 20 --repetitions 500", "2 of 500", r"stopped after \d+ of 500 repetitions"),
            (
                "funnel,steps=3 --rate 0.6 --knots 0 1 2 --disturbances light",
                "1 of 3",
                "stopped before this knot was done",
            ),
            ("break --rounds 900 --strength 3", "1 of 900", r"stopped after \d+ of 900 rounds"),
        ),
    ],
)
def test_ctrl_c_keeps_what_there_is_and_says_how_far_it_came(
    command: str, at: str, says: str, own: str, tmp_path: Path
) -> None:
    """SIGINT to a process that has done some of its work, but not all: it ends with 130, and its files can be used."""
    asked, *more = command.split()
    name, *settings = asked.split(",")
    scenario = ",".join([f"{own}:shifted", *settings])
    code, printed, error = interrupted([name, scenario, *more, *OPEN, "--out", str(tmp_path)], at)
    assert (code, error.splitlines()[-1]) == (130, "lqrsim: stopped")
    assert re.search(says, printed)
    if name == "funnel":
        funnel = ls.load(tmp_path / "funnel.npz", ls.types.Funnel)
        assert funnel.levels[0] > 0
        assert funnel.levels[-1] == 0
        assert funnel.reasons[-1] == says
        return
    written = found(tmp_path / f"{name}.json")
    assert written["stopped"] in printed
    assert (
        f"after {len(written['found']['repetitions' if name == 'rare' else 'history']) - (name == 'break')} of"
        in printed
    )
    assert ls.load(tmp_path / "rollout.npz", ls.Rollout).outcome[0] == "collided"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send to another process")
@pytest.mark.parametrize("command", ["rare", *rarely("break")])
def test_ctrl_c_is_one_line_and_leaves_nothing(command: str, own: str, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "lqrsim.cli", command, f"{own}:shifted,steps=150", "--out", str(tmp_path / "out")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while "a trial draws" not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=600)
    assert process.returncode == 130
    assert error.splitlines()[-1] == "lqrsim: stopped"
    assert not (tmp_path / "out").exists()


def test_what_is_written_of_a_search_has_no_infinity(tmp_path: Path) -> None:
    """As null, which every program can read; a plan's numbers may be infinite, and so may a distance."""
    problem = ls.stress.ReliabilityProblem("quadrotor")
    found = {"distance": np.inf, "shares": [np.float64("nan"), 1.0]}
    solution = ls.smooth(ls.scenarios.quadrotor().problem, max_iterations=1, safeguard=False)
    write_json(problem, solution, tmp_path / "break.json", {"largest": -np.inf}, found, "")
    written = json.loads((tmp_path / "break.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert written["found"] == {"distance": None, "shares": [None, 1.0]}
    assert written["asked"]["largest"] is None

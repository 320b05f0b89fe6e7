"""`ls.stress.harden` and `lqrsim harden`: hardened plans against Monte Carlo of the exact dynamics, and what they say.

A point mass passes a crate. A force of unknown size, drawn once for each trial, pushes it; in its runs the force is
twice as large as its plans and laws were told.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interrupting import interrupted
from past_a_crate import OWN
from sampling import rarely
from scipy.stats import binom, norm

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands import console
from lqrsim.stress import reliability
from lqrsim.stress.reliability import NoFailure, failure_probability
from lqrsim.stress.safer_plans import AIMED_FRACTION, HardenedPlan, HardeningRound, _Search
from lqrsim.stress.statistics import rate

CHANCE, OFFSET = 0.05, 0.25
FEW: dict[str, Any] = {"chance": CHANCE, "particles": 200, "repetitions": 2}
TRIALS = 20_000


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("own") / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return f"{path}:told"


def stated(reference: str, **more: Any) -> ls.stress.ReliabilityProblem:
    """Twice what is told, unless other options say otherwise."""
    options: dict[str, Any] = {"strength": 2.0, "policy": "track", "design_disturbances": "scenario"}
    return ls.stress.ReliabilityProblem(reference, **options | more)


@pytest.fixture(scope="module")
def hardened(own: str) -> HardenedPlan:
    return ls.stress.harden(stated(own), **FEW)


def collisions(problem: ls.stress.ReliabilityProblem, solution: ls.Solution) -> int:
    """The number of TRIALS that touch crate or pillar at a step of the exact dynamics."""
    score, rng = replace(problem, solution=solution).score, np.random.default_rng(99)
    law = score.solution.policy
    pushed = 2 * OFFSET * rng.standard_normal((TRIALS, 2))
    x, hit = np.tile([-1.0, 0.3, 0.0, 0.0], (TRIALS, 1)), np.zeros(TRIALS, dtype=bool)
    for gain, offset in zip(law.gain, law.offset, strict=True):
        command = np.clip(x @ gain.T + offset, -2, 2)
        force = np.clip(command + pushed, -2, 2)
        for _ in range(5):
            x = x + 0.02 * np.hstack([x[:, 2:], (force - 0.2 * x[:, 2:]) / 0.5])
            outside = np.maximum(np.abs(x[:, :2] - (0.0, 0.1)) - (0.3, 0.4), 0.0)
            hit |= (np.linalg.norm(outside, axis=1) < 0.1) | (np.linalg.norm(x[:, :2] - (0.9, -0.5), axis=1) < 0.25)
    return int(hit.sum())


def test_a_hardened_plan_is_as_safe_as_requested(own: str, hardened: HardenedPlan) -> None:
    """Plain Monte Carlo of the exact dynamics. With the request as its probability, a plan would have fewer collisions
    than 0.9 times those of the request in less than one in 1e4 of such tests, as the first line says; the first plan
    has many more.
    """
    assert binom.cdf(0.9 * CHANCE * TRIALS, TRIALS, CHANCE) < 1e-3
    first, *_, last = hardened.rounds
    assert first.rare is not None
    assert last.rare is not None
    assert first.rare.probability.low > CHANCE
    assert collisions(stated(own), first.solution) > 1.1 * CHANCE * TRIALS
    assert hardened.success
    assert hardened.solution is last.solution
    assert collisions(stated(own), hardened.solution) < 0.9 * CHANCE * TRIALS
    assert last.rare.probability.high <= CHANCE
    # At little cost: a fifth of the request's room and more is used, and the plan costs a few percent more.
    assert collisions(stated(own), hardened.solution) > 0.1 * CHANCE * TRIALS
    assert first.cost < last.cost < 1.1 * first.cost


def test_what_is_never_hit_gets_no_more_room(own: str, hardened: HardenedPlan) -> None:
    """As numbers of standard deviations, for drawn rounds; and a plan costs the same where it does not exist."""
    assert all(set(one.hit) == {"crate"} for one in hardened.rounds)
    search, rng = _Search(stated(own), CHANCE, {}), np.random.default_rng(3)
    names = search.names
    for _ in range(50):
        search.deviations, hit = rng.uniform(1.0, 9.0, len(names)), str(rng.choice(names))
        last = replace(hardened.rounds[0], hit={hit: 1.0}, strays=0.0)
        wanted = search.wanted(last)
        others = np.array(names) != hit
        assert (wanted[others] <= search.deviations[others]).all()
        assert wanted[~others] > search.deviations[~others]  # its measured probability is more than the request
    without = ls.stress.harden(stated(f"{own},pillar=0"), **FEW, rounds=2)
    assert without.rounds[-1].cost == pytest.approx(hardened.rounds[-1].cost, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_the_room_is_that_of_the_normal_distribution(own: str, hardened: HardenedPlan, seed: int) -> None:
    """A clearance that is normal, with standard deviations that are off by a factor, needs one round."""
    rng, search = np.random.default_rng(seed), _Search(stated(own), CHANCE, {})
    wrong, measured = rng.uniform(0.6, 1.5), rng.uniform(0.02, 0.08)
    count = len(search.names)
    search.deviations = np.full(count, wrong * norm.isf(measured))
    first = hardened.rounds[0]
    assert first.rare is not None
    splitting = first.rare.splitting
    rare = replace(
        first.rare, splitting=replace(splitting, probability=replace(splitting.probability, value=measured, low=0.0))
    )
    wanted = search.wanted(HardeningRound(solution=first.solution, cost=1.0, rare=rare, hit={"crate": 1.0}, strays=0.0))
    assert norm.sf(wanted[search.names.index("crate")] / wrong) == pytest.approx(AIMED_FRACTION * CHANCE)


@pytest.mark.parametrize(
    ("words", "strength", "says"),
    [
        ("", 2.0, "not after 1 plans; allow more rounds, or a higher chance"),
        (",near=1", 2.0, "there is no plan with more room"),
        ("", 8.0, "of the failing runs leave the last one for good; give the controls more range"),
    ],
)
def test_what_cannot_be_reached_says_why(own: str, words: str, strength: float, says: str) -> None:
    problem = stated(own + words, strength=strength)
    if words:  # a search for a safe first plan would take long
        problem = replace(problem, solution=ls.smooth(problem.resolved.problem))
    found = ls.stress.harden(problem, **FEW, rounds=2 if words else 1)
    assert not found.success
    assert says in found.reason
    assert str(found).endswith(f"is the safest, NOT as requested: {found.reason}")
    measured = [one.rare.probability.value for one in found.rounds if one.rare]
    assert found.rare is not None
    assert found.rare.probability.value == min(measured)


@pytest.mark.parametrize(
    ("words", "more", "options", "says", "changes"),
    [
        (
            "", {}, {"rounds": 1}, "not after 1 plans; allow more rounds, or a higher chance",
            [("", {}, {"rounds": 4}), ("", {}, {"rounds": 1, "chance": 0.3})],
        ),
        (
            ",near=1", {}, {"rounds": 2}, "there is no plan with more room; allow a higher chance, or another route",
            [(",near=1", {}, {"chance": 0.1}), ("", {}, {})],
        ),
        *rarely((
            "", {}, {"rounds": 2, "particles": 25}, "an interval; allow more particles or repetitions",
            [("", {}, {"rounds": 2}), ("", {}, {"rounds": 2, "particles": 25, "repetitions": 16})],
        )),
        (
            "", {"strength": 4.0}, {}, "design the law for what is run (without design_disturbances)",
            [(",limit=8", {"strength": 4.0, "design_disturbances": None}, {}),
             ("", {"strength": 4.0}, {"chance": 0.6})],
        ),
    ],
    ids=["few rounds", "no room", "wide interval", "leaves for good"],
)  # fmt: skip
def test_what_its_reason_advises_helps(
    own: str, words: str, more: dict[str, Any], options: dict[str, Any], says: str, changes: list[Any]
) -> None:
    def found(words: str, more: dict[str, Any], options: dict[str, Any]) -> HardenedPlan:
        problem = stated(own + words, **more)
        if "near" in words:  # a search for a safe first plan would take long
            problem = replace(problem, solution=ls.smooth(problem.resolved.problem))
        return ls.stress.harden(problem, **FEW | options)

    failed = found(words, more, options)
    assert not failed.success
    assert says in failed.reason
    for change in changes:
        better = found(*change)
        assert better.success, str(better)


def test_more_range_of_the_controls_keeps_runs_near_their_plan(own: str) -> None:
    """So does a law that is designed for the forces of the runs, here four times those it was told."""
    weak, strong, knowing = (
        ls.stress.harden(problem, **FEW, rounds=2).rounds[-1].strays
        for problem in (
            stated(own, strength=4.0), stated(f"{own},limit=8", strength=4.0),
            stated(own, strength=4.0, design_disturbances=None),
        )
    )  # fmt: skip
    assert weak > 0.5
    assert max(strong, knowing) < 0.25


def test_it_ends_early_where_all_failing_runs_leave_the_plan(own: str, hardened: HardenedPlan) -> None:
    search = _Search(stated(own), CHANCE, {})
    search.rounds.append(replace(hardened.rounds[0], hit={}, strays=1.0))
    assert search.next() is None
    assert search.shortfall().startswith("all failing runs leave the plan for good")
    assert search.shortfall().endswith("; " + search.remedy)


@pytest.mark.parametrize("seed", range(6))
def test_what_splitting_does_not_find_is_counted(
    own: str, hardened: HardenedPlan, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Splitting that finds nothing; the exact bound of k = 0 in n is 1 - 0.025^(1/n), and n that are too many are not
    run. Every second plan fails in one of its trials.
    """
    chance, asked = 10 ** np.random.default_rng(seed).uniform(-5.5, -2.5), list[tuple[float, int]]()

    def found(self: object, *, particles: int, repetitions: int, keep: float, **_: object) -> Any:
        asked.append((keep, particles * repetitions))
        if keep == 0 and seed % 2:
            return failing
        raise NoFailure("score: none", particles * repetitions if keep == 0 else 0)

    known = hardened.rare
    assert known is not None
    failing = replace(known, splitting=replace(known.splitting, probability=rate(1, 10)))
    monkeypatch.setattr(ls.stress.ReliabilityProblem, "rare_failures", found)
    problem = stated(own, solution=hardened.solution)
    result = ls.stress.harden(problem, chance=chance, particles=100, repetitions=3, rounds=1)
    needed = np.log(0.025) / np.log1p(-chance)
    affordable = needed <= 100_000
    assert result.success == (affordable and seed % 2 == 0)
    assert [keep for keep, _ in asked] == ([0.1, 0.0] if affordable else [0.1]) * (2 if result.success else 1)
    assert all(needed <= trials < needed + 60 for keep, trials in asked if keep == 0)
    if result.success:
        bound = 1 - 0.025 ** (1 / asked[1][1])
        assert result.rounds[0].probability.high == pytest.approx(bound, rel=1e-9)
        assert f"so at most {bound:.2g} of them do" in str(result)
    elif not affordable:
        assert "may have missed some, and 0 trials without one prove at most 1; allow more particles:" in result.reason
        assert result.rounds[0].probability.high == 1.0


def test_a_plan_without_failures_is_as_safe_as_its_trials_prove(own: str, hardened: HardenedPlan) -> None:
    """And is not ranked before a plan that is measured to be safer than that."""
    search, rng = _Search(stated(own), 1e-6, {}), np.random.default_rng(5)
    one = hardened.rounds[-1]
    assert one.rare is not None
    for _ in range(50):
        trials = rng.integers(0, 3000, 5)
        search.rounds = [replace(one, rare=None, unfailing=int(count)) for count in trials]
        search.rounds.insert(int(rng.integers(6)), one)
        bounds = [1 - 0.025 ** (1 / count) if count else 1.0 for count in trials]
        best = search.result("not enough").solution, search.rounds[search.result("not enough").chosen]
        if min(bounds) > one.rare.probability.value:
            assert best[1] is one
        else:
            assert best[1].unfailing == trials.max()


def test_a_plan_that_never_fails_is_proved_by_trials(
    own: str, hardened: HardenedPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A force of a fiftieth, and a splitting that gives up early."""
    monkeypatch.setattr(reliability, "failure_probability", partial(failure_probability, most_levels=2))
    problem = stated(own, strength=0.02, solution=hardened.solution)
    found = ls.stress.harden(problem, chance=0.05, particles=20, repetitions=2, rounds=1)
    assert found.success
    assert found.rare is None
    assert found.rounds[0].unfailing == 72  # log(0.025) / log(0.95) = 71.9
    assert found.save(tmp_path) is None
    written = json.loads((tmp_path / "harden.json").read_text(encoding="utf-8"))["found"]["rounds"][0]
    assert written["probability"] == asdict(rate(0, found.rounds[0].unfailing))


def test_the_same_seed_gives_the_same_and_another_one_does_not(own: str, hardened: HardenedPlan) -> None:
    again, other = (ls.stress.harden(stated(own), **FEW, seed=seed, rounds=2 - seed) for seed in (0, 1))
    assert str(again) == str(hardened)
    np.testing.assert_array_equal(again.solution.trajectory.states, hardened.solution.trajectory.states)
    assert str(other.rounds[0]) != str(hardened.rounds[0])


def test_a_given_plan_that_is_safe_enough_is_kept(own: str, hardened: HardenedPlan) -> None:
    found = ls.stress.harden(stated(own, solution=hardened.solution), **FEW, seed=50)
    assert len(found.rounds) == 1
    np.testing.assert_array_equal(found.solution.trajectory.states, hardened.solution.trajectory.states)


def test_ctrl_c_keeps_the_plans_that_are_measured(own: str) -> None:
    for at, kept in ((0, None), (2, 1)):

        def stop(done: int, total: int, found: str, at: int = at) -> None:
            assert total == 2 * 4 * 2
            if done > at:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt) as stopped:
            ls.stress.harden(stated(own), **FEW, progress=stop)
        found = getattr(stopped.value, "found", None)
        assert (found and len(found.rounds)) == kept
        if found is not None:
            assert found.stopped == "stopped after 1 of 4 plans"
            assert not found.success


def test_ctrl_c_in_the_second_measurement_keeps_the_first(own: str, hardened: HardenedPlan) -> None:
    def stop(done: int, total: int, found: str) -> None:
        if "again" in found:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        ls.stress.harden(stated(own, solution=hardened.solution), **FEW, seed=50, progress=stop)
    found = stopped.value.found  # pyright: ignore[reportAttributeAccessIssue]
    assert (len(found.rounds), found.success) == (1, False)
    np.testing.assert_array_equal(found.solution.trajectory.states, hardened.solution.trajectory.states)


WORDS = ["--strength", "2", "--policy", "track", "--design-disturbances", "scenario", "--particles", "200",
         "--repetitions", "2", "--shown", "2"]  # fmt: skip


def test_the_command_writes_what_other_commands_read(
    own: str, hardened: HardenedPlan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["harden", own, *WORDS, "--chance", str(CHANCE), "--out", str(tmp_path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "harden.json").read_text(encoding="utf-8"))
    assert {name: printed[name] for name in written} == written
    assert sorted(Path(name).name for name in printed["wrote"]) == sorted(path.name for path in tmp_path.iterdir())
    assert written["found"]["success"]
    assert hardened.rare is not None
    assert written["found"]["rounds"][-1]["probability"] == asdict(hardened.rare.probability)
    solution = ls.load(tmp_path / "solution.npz", ls.Solution)
    np.testing.assert_array_equal(solution.trajectory.states, hardened.solution.trajectory.states)
    assert ls.load(tmp_path / "rollout.npz", ls.Rollout).outcome == ("collided",) * 2
    # The certificate is measured again; with another plan it is found out.
    file = tmp_path / "certificate.npz"
    assert main(["certify", str(file), "--scenario", own]) == 0
    assert "as certified, to the last bit" in capsys.readouterr().out
    false = replace(ls.load(file, ls.stress.FailureCertificate), solution=hardened.rounds[0].solution)
    assert main(["certify", str(ls.save(false, tmp_path / "false.npz")), "--scenario", own]) == 1
    assert "NOT as certified" in capsys.readouterr().out


def test_the_command_keeps_what_there_is_and_says_if_it_is_not_enough(
    own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["harden", own, *WORDS, "--chance", str(CHANCE), "--rounds", "1", "--out", str(tmp_path)]
    assert main(words) == 1
    assert "plan 1 is the safest, NOT as requested: not after 1 plans" in capsys.readouterr().out

    def stop(self: object, done: int, total: int, found: str = "") -> None:
        if done == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(console.Progress, "__call__", stop)
    assert main([*words[:-4], "--rounds", "3", "--out", str(tmp_path / "stopped")]) == 130
    written = json.loads((tmp_path / "stopped" / "harden.json").read_text(encoding="utf-8"))
    assert written["stopped"] == "stopped after 1 of 3 plans"
    assert ls.load(tmp_path / "stopped" / "solution.npz", ls.Solution).success


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send to another process")
@pytest.mark.parametrize(("at", "kept"), rarely((1, 0), (3, 1)))
def test_ctrl_c_in_a_process_of_its_own_keeps_the_plans_that_are_measured(
    own: str, tmp_path: Path, at: int, kept: int
) -> None:
    """In the first plan nothing is kept, in the second the first; each takes two repetitions, and the end is 130."""
    words = ["harden", own, *WORDS, "--chance", "0.001", "--rounds", "3", "--out", str(tmp_path / "out")]
    code, printed, error = interrupted(words, f"{at} of 12")
    assert (code, error.splitlines()[-1]) == (130, "lqrsim: stopped")
    assert (tmp_path / "out").exists() == bool(kept)
    if kept:
        written = json.loads((tmp_path / "out" / "harden.json").read_text(encoding="utf-8"))
        assert written["stopped"] == f"stopped after {kept} of 3 plans"
        assert written["stopped"] in printed
        assert len(written["found"]["rounds"]) == kept
        assert ls.load(tmp_path / "out" / "solution.npz", ls.Solution).success
        assert {path.name for path in (tmp_path / "out").iterdir()} == {
            "solution.npz", "harden.json", "rollout.npz", "rare.json", "certificate.npz",
        }  # fmt: skip


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"problem": 3}, "problem: got 3, want a ReliabilityProblem"),
        (
            {"problem": {"policy": "ilqr", "design_disturbances": None}},
            "problem: policy: got 'ilqr', want one of: smooth,",
        ),
        ({"problem": {"failure": "miss"}}, "problem: failure: got 'miss', want 'collision'"),
        ({"problem": {"sweep": "gale"}}, "got 'gale'"),
        ({"problem": {"design_disturbances": "gale"}}, "got 'gale'"),
        ({"chance": 0.0}, "chance: got 0"),
        ({"chance": 1.0}, "chance: got 1"),
        ({"rounds": 0}, "rounds: got 0"),
        ({"rounds": 21}, "rounds: got 21"),
        ({"particles": 19}, "particles: got 19"),
        ({"repetitions": 1}, "repetitions: got 1"),
        ({"seed": -1}, "seed: got -1"),
        ({"report": 3}, "report: got 3"),
        ({"progress": lambda: None}, "progress: got "),
    ],
)
def test_wrong_options_are_refused_before_anything_is_solved(
    own: str, options: dict[str, Any], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lqrsim.stress.safer_plans.smooth_chance_constrained", refuse("solved"))
    problem = options.pop("problem", {})
    problem = stated(own, **problem) if isinstance(problem, dict) else problem
    with pytest.raises(ls.InputError) as refused:
        ls.stress.harden(problem, **options)
    assert str(refused.value).startswith(says) or says in str(refused.value)


def refuse(why: str) -> Callable[..., Any]:
    return lambda *_, **__: pytest.fail(why)

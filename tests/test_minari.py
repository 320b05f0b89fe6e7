"""Data sets of Minari: the episodes of the environment, to the last bit, as Minari and as h5py read them."""

import dataclasses
import itertools
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mechanisms
import numpy as np
import pytest

import lqrsim as ls
import lqrsim.gym
from lqrsim.cli import main
from lqrsim.errors import InputError

pytest.importorskip("minari", reason="needs the `minari` extra")


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Minari's folder, which is not there yet."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    return tmp_path / "sets"


@pytest.fixture(scope="module")
def runs(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> ls.Rollout:
    """Trials of which some collide and some do not."""
    plant = quadrotor.plant()
    options: Any = {"disturbances": ls.disturbances.preset("light", plant), "seed": 1, "trials": 6, "frames": False}
    rollout = ls.simulate(plant, quadrotor_solution, first_trial=2, **options)
    assert {"collided", "reached"} <= set(rollout.outcome)
    return rollout


@pytest.fixture(scope="module")
def env(quadrotor_solution: ls.Solution) -> Any:
    return lqrsim.gym.make_env("quadrotor", solution=quadrotor_solution, disturbances="light", actions="controls")


def test_episodes_are_those_of_the_environment(env: Any, runs: ls.Rollout, quadrotor: ls.Scenario, root: Path) -> None:
    """For the same commands, the environment, begun with an episode's metadata, returns the episode."""
    h5py = pytest.importorskip("h5py")
    dataset = lqrsim.gym.write_minari("test/light-v0", env, runs, author="me")
    assert dataset.total_episodes == runs.trials
    costs = ls.stress.outcomes(runs, quadrotor.problem).cost
    file = h5py.File(root / "test" / "light-v0" / "data" / "main_data.hdf5")
    for k, about in enumerate(dataset.storage.get_episode_metadata(range(runs.trials))):
        episode, group = dataset[k], file[f"episode_{k}"]
        steps, trial = len(episode.rewards), int(about["trial"])
        assert (about["seed"], trial, about["outcome"], about["rollout"]) == (1, 2 + k, runs.outcome[k], 0)
        assert (group.attrs["seed"], group.attrs["trial"]) == (1, trial)
        assert episode.observations.shape == (steps + 1, 13)
        np.testing.assert_array_equal(episode.observations[:, :-1], runs.measured[k, : steps + 1])
        np.testing.assert_array_equal(episode.actions, runs.commanded[k, :steps])
        np.testing.assert_array_equal(group["observations"], episode.observations)
        np.testing.assert_array_equal(group["actions"], episode.actions)
        (observation, info), ended = env.reset(seed=about["seed"], options={"trial": trial}), [False, False]
        np.testing.assert_array_equal(observation, episode.observations[0])
        for t in range(steps):
            observation, reward, *ended, info = env.step(episode.actions[t])
            np.testing.assert_array_equal(observation, episode.observations[t + 1])
            assert ended == [episode.terminations[t], episode.truncations[t]]
            assert reward == pytest.approx(episode.rewards[t], rel=1e-12)  # of one trial alone: rounding
            np.testing.assert_array_equal(info["state"], episode.infos["state"][t + 1])
            assert info["clearance"] == episode.infos["clearance"][t + 1]
        assert any(ended)
        assert info["outcome"] == about["outcome"]
        if info["outcome"] != "collided":
            assert -episode.rewards.sum() == pytest.approx(costs[k], rel=1e-12)  # sums in another order: rounding
    metadata = json.loads((root / "test" / "light-v0" / "data" / "metadata.json").read_text(encoding="utf-8"))
    (fact,) = metadata["lqrsim"]
    assert fact["policy_digest"] == runs.policy_digest
    assert fact["disturbances"] == list(runs.disturbances)
    assert fact["versions"] == dict(runs.versions)
    assert metadata["author"] == ["me"]


def test_normalized_actions_lie_in_the_space(
    runs: ls.Rollout, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """Clipped commands, between the limits."""
    env = lqrsim.gym.make_env(quadrotor, solution=quadrotor_solution)
    dataset = lqrsim.gym.write_minari("light-v3", env, iter([runs, runs]), data_format="arrow")
    assert dataset.total_episodes == 2 * runs.trials
    space = quadrotor.robot.dynamics.control_coordinates
    for k, episode in enumerate(dataset.iterate_episodes()):
        assert all(map(dataset.action_space.contains, episode.actions))
        commands = np.clip(runs.commanded[k % runs.trials, : len(episode.actions)], space.low, space.high)
        share = (commands - space.low) / (np.array(space.high) - space.low)
        np.testing.assert_allclose(episode.actions, 2 * share - 1, rtol=0, atol=1e-15)  # rounding


def test_trials_that_came_to_nothing(env: Any, runs: ls.Rollout) -> None:
    """One that diverges has its last valid state at the end; a failed controller truncates; at once, no episode."""
    dt, k = runs.plan.dt, runs.outcome.index("reached")
    three = [[k] * 3]
    arrays = {
        name: getattr(runs, name)[tuple(three)].copy()
        for name in ("states", "measured", "commanded", "applied", "clearance", "forces", "torques", "displaced")
    }
    arrays |= {name: getattr(runs, name)[tuple(three)] for name in ("contacts", "collided_at", "frames", "warnings")}
    for row, (knot, command) in enumerate(((5, 5), (8, 7), (1, 0))):
        for name in ("states", "measured", "clearance"):
            arrays[name][row, knot:] = np.nan
        for name in ("commanded", "applied"):
            arrays[name][row, command:] = np.nan
    never = np.inf
    failed: Any = {
        "diverged_at": np.array([5 * dt, never, never]), "failed_at": np.array([never, 7 * dt, 0.0]),
        "obstacles": ("",) * 3, "reasons": ("", "it broke", "it broke"),
    }  # fmt: skip
    rollout = dataclasses.replace(runs, **arrays, **failed)
    assert rollout.outcome == ("diverged", "error", "error")
    dataset = lqrsim.gym.write_minari("test/nothing-v0", env, rollout)
    diverged, broke = dataset.iterate_episodes()
    assert len(diverged.rewards) == 5
    np.testing.assert_array_equal(diverged.observations[5, :-1], runs.measured[k, 4])
    assert np.isfinite(diverged.rewards).all()
    assert (diverged.terminations[-1], diverged.truncations[-1]) == (True, False)
    np.testing.assert_array_equal(broke.observations[:, :-1], runs.measured[k, :8])
    assert (broke.terminations[-1], broke.truncations[-1]) == (False, True)
    with pytest.raises(InputError, match=r"^rollouts: got no trial that ran for a control period"):
        lqrsim.gym.write_minari("test/none-v0", env, [])


def test_an_interrupt_leaves_nothing(env: Any, runs: ls.Rollout, root: Path) -> None:
    def interrupted() -> Iterator[ls.Rollout]:
        yield runs
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lqrsim.gym.write_minari("a/b/light-v0", env, interrupted())
    assert not list(root.iterdir())
    lqrsim.gym.write_minari("aa/light-v0", env, runs)
    before = sorted(root.rglob("*"))
    with pytest.raises(KeyboardInterrupt):
        lqrsim.gym.write_minari("aa/bb/light-v0", env, interrupted())
    assert sorted(root.rglob("*")) == before
    with pytest.raises(InputError, match=r"^name: got the name of .*light-v0, which exists, want another"):
        lqrsim.gym.write_minari("aa/light-v0", env, runs)


def test_what_is_wrong_is_refused(
    env: Any, runs: ls.Rollout, drive_solution: ls.Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = dataclasses.replace(runs, plan=dataclasses.replace(runs.plan, controls=runs.plan.controls + 1e-9))
    drive = lqrsim.gym.make_env("differential_drive", solution=drive_solution)
    write: Any = lqrsim.gym.write_minari
    for name, made, given, line in (
        ("light", env, runs, "name: got 'light', want NAMESPACE/NAME-vVERSION"),
        ("../light-v0", env, runs, "name: got '../light-v0', want NAMESPACE/NAME-vVERSION"),
        ("light-v0", runs, runs, "env: got "),
        ("light-v0", env, 3, "rollouts: got 3, want a Rollout, or several"),
        ("light-v0", env, [runs, 3], "rollouts: got 3, want a Rollout, or several"),
        ("light-v0", env, other, "rollouts: got runs of another plan than env's"),
        ("light-v0", drive, runs, "rollouts: got a run with the states"),
    ):
        with pytest.raises(InputError) as caught:
            write(name, made, given)
        assert str(caught.value).startswith(line)
    (tmp_path / "file").touch()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "file"))
    with pytest.raises(InputError, match=r"^name: got light-v0, want the folder of Minari to be writable"):
        write("light-v0", env, runs)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(InputError, match=r"run: pip install 'lqrsim\[minari\]'$"):
        write("light-v0", env, runs)


def test_runs_and_campaigns_on_the_command_line(
    runs: ls.Rollout, quadrotor_solution: ls.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import minari

    solution = dataclasses.replace(quadrotor_solution, scenario="quadrotor")
    ls.save(solution, tmp_path / "solution.npz")
    ls.save(runs, tmp_path / "rollout.npz")
    assert main(["export", str(tmp_path / "rollout.npz"), "--minari", "run/light-v0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == runs.trials
    recovered: Any = minari.load_dataset("run/light-v0").recover_environment()
    np.testing.assert_array_equal(recovered.unwrapped.solution.policy.gain, solution.policy.gain)

    wind = ls.disturbances.preset("light", ls.scenarios.quadrotor().plant())[-1:]
    asked: Any = {"sweeps": {"wind": wind}, "strengths": (1.0, 2.0), "policies": ("smooth",), "trials": 2}
    campaign = ls.stress.Campaign(scenario="quadrotor", solution=solution, **asked)
    results = ls.stress.run_campaign(campaign, tmp_path / "campaign", workers=0)
    export = ["export", str(tmp_path / "campaign"), "--actions", "controls", "--minari"]
    assert main([*export, "run/all-v0"]) == 0
    assert main([*export, "run/strong-v0", "--cell", "smooth,wind,2"]) == 0
    again = ls.stress.replay(results, ls.stress.Cell("smooth", "wind", 2.0), 0, trials=2)
    every, strong = (list(minari.load_dataset(name).iterate_episodes()) for name in ("run/all-v0", "run/strong-v0"))
    assert len(every) == 4
    for k, pair in enumerate(zip(every[2:], strong, strict=True)):
        for episode in pair:
            np.testing.assert_array_equal(episode.actions, again.commanded[k, : len(episode.actions)])
    capsys.readouterr()
    for words, line in (
        (["--cell", "1", "--minari", "run/x-v0"], "--cell: got 1 with"),
        (["--c", "c", "--minari", "run/x-v0"], "--c, --minari: got both"),
        ([], "--c, --minari: got none"),
        (["--name", "x", "--minari", "run/x-v0"], "--name: got x without --c"),
        (["--minari", "run/light-v0"], "name: got the name of"),
    ):
        assert main(["export", str(tmp_path / "rollout.npz"), *words]) == 2
        assert line in capsys.readouterr().err


def test_cells_are_of_one_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All choices of cells of three policies, of which two have the same plan."""
    monkeypatch.chdir(tmp_path)
    Path("cart.xml").write_text(mechanisms.draw("cart", 0).xml, encoding="utf-8")
    noise, policies = (ls.disturbances.ControlNoise(0.01),), ("smooth", "open_loop", "ilqr")
    asked: Any = {"sweeps": {"noise": noise}, "strengths": (1.0,), "policies": policies, "trials": 2}
    campaign = ls.stress.Campaign(scenario="cart.xml,steps=20,goal={'slider': 0.1}", **asked)
    ls.stress.run_campaign(campaign, "campaign", workers=0)
    for number, chosen in enumerate(c for size in range(4) for c in itertools.combinations(policies, size)):
        plans = {"ilqr" if policy == "ilqr" else "smooth" for policy in chosen or policies}
        cells = [f"{policy},noise,1" for policy in chosen]
        words = ["export", "campaign", "--minari", f"run/n{number}-v0", *(["--cell", *cells] if cells else [])]
        assert main(words) == (0 if len(plans) == 1 else 2)
        said = capsys.readouterr()
        assert said.err.startswith("lqrsim: error: --cell: got cells with plans of ") == (len(plans) == 2)
        assert (f"\n{2 * len(chosen)} episodes" in said.out) == (len(plans) == 1)

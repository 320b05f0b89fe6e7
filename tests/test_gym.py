"""Environments of Gymnasium: its own checks, and that they are the closed loop of `simulate`, to the last bit."""

import contextlib
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mechanisms
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from mechanisms import arm
from PIL import Image
from sampling import rarely

import lqrsim as ls
import lqrsim.gym
from lqrsim.control.controllers import Feedback
from lqrsim.errors import InputError
from lqrsim.gym import LARGEST
from lqrsim.view import gl

NAMES = {"lqrsim/DifferentialDrive-v0": "differential_drive", "lqrsim/Quadrotor-v0": "quadrotor"}


def run(env: Any, act: Any, **reset: Any) -> tuple[np.ndarray, np.ndarray, dict[str, Any], list[bool]]:
    """All observations (T+1, n+1) and rewards (T,) of an episode, the last info, and how it ended."""
    observation, info = env.reset(**reset)
    seen, rewards, ended = [observation], [], [False, False]
    while not any(ended):
        observation, reward, *ended, info = env.step(act(observation))
        seen.append(observation)
        rewards.append(reward)
    return np.array(seen), np.array(rewards), info, ended


@pytest.fixture(scope="module", params=NAMES)
def case(request: pytest.FixtureRequest) -> tuple[str, ls.Scenario, ls.Solution]:
    name = NAMES[request.param]
    solution = request.getfixturevalue({"differential_drive": "drive_solution"}.get(name, "quadrotor_solution"))
    return request.param, request.getfixturevalue(name), solution


def test_gymnasiums_own_check_finds_nothing(case: tuple[str, ls.Scenario, ls.Solution]) -> None:
    name, _, solution = case
    env = gymnasium.make(name, solution=solution, render_mode="rgb_array" if not gl.missing() else None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=bool(gl.missing()))
    env.close()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("lqrsim/Quadrotor-v0", ""),
        *rarely(("lqrsim/DifferentialDrive-v0", ""), ("lqrsim/Scenario-v0", "scenario='quadrotor'")),
        ("lqrsim/Quadrotor-v0", "num_envs=2"),
    ],
)
def test_a_name_alone_is_enough_where_nothing_has_imported_lqrsim(name: str, options: str) -> None:
    make = "make_vec" if "num_envs" in options else "make"
    program = f"""
import sys, gymnasium
assert not any("lqrsim" in module for module in sys.modules)
print(gymnasium.{make}("lqrsim.gym:{name}", {options}).spec.id)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == (f"{name}\n", 0), done.stderr


def test_an_episode_is_the_trial_of_simulate(case: tuple[str, ls.Scenario, ls.Solution]) -> None:
    """The policy in its place: the same states, measurements, controls and cost."""
    name, scenario, solution = case
    plant = scenario.plant()
    disturbances = ls.disturbances.preset("light", plant)
    rollout = ls.simulate(plant, solution, disturbances=disturbances, seed=3, trials=3, **scenario.near_enough())
    told = ls.stress.outcomes(rollout, scenario.problem)
    env: Any = gymnasium.make(name, solution=solution, disturbances="light", actions="controls")
    expert = lqrsim.gym.Expert(env)
    for trial in range(3):
        seen, rewards, info, ended = run(env, expert, seed=3 if trial == 0 else None)
        steps = len(rewards)
        assert (info["seed"], info["trial"], info["outcome"]) == (3, trial, rollout.outcome[trial])
        assert ended == ([False, True] if info["outcome"] in ("reached", "timed out") else [True, False])
        np.testing.assert_array_equal(seen[:, :-1], rollout.measured[trial, : steps + 1])
        np.testing.assert_array_equal(seen[:, -1], np.arange(steps + 1) / scenario.problem.steps)
        own = env.unwrapped.rollout()
        for field in ("states", "applied", "forces", "clearance"):
            count = steps + (field in ("states", "clearance"))
            np.testing.assert_array_equal(
                getattr(own, field)[0, :count], getattr(rollout, field)[trial, :count], err_msg=field
            )
            assert np.isnan(getattr(own, field)[0, count:]).all()
        assert own.ended[0] == rollout.ended[trial]
        if info["outcome"] == "reached":
            # Sums in another order: rounding.
            assert -rewards.sum() == pytest.approx(told.cost[trial], rel=1e-12)
            assert steps == scenario.problem.steps


def test_a_filter_as_an_agent_takes_repeated_measurements_for_lost(case: tuple[str, ls.Scenario, ls.Solution]) -> None:
    """Observations say no more than that; with noise no two measurements are equal, and it flies as in `simulate`."""
    name, scenario, solution = case
    lossy = [ls.disturbances.MeasurementNoise(1e-3), ls.disturbances.MeasurementDropouts(0.3)]
    law = ls.OffsetFree(scenario.problem, solution, ls.uncertainty_of(scenario.plant(), lossy))
    rollout = ls.simulate(scenario.plant(), solution, controller=law, disturbances=lossy, seed=2, frames=False)
    env: Any = gymnasium.make(name, solution=solution, disturbances=lossy, actions="controls")
    _, rewards, _, _ = run(env, lqrsim.gym.Expert(env, law), seed=2)
    own, steps = env.unwrapped.rollout(), len(rewards)
    np.testing.assert_array_equal(own.applied[0, :steps], rollout.applied[0, :steps])
    assert (own.measured[0, 1:] == own.measured[0, :-1]).all(axis=1).any()


def test_many_at_once_are_the_same_trials(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Under severe disturbances, of which some trials collide; who has ended stands still."""
    plant = quadrotor.plant()
    disturbances = ls.disturbances.preset("light", plant)
    rollout = ls.simulate(plant, quadrotor_solution, disturbances=disturbances, seed=1, trials=8)
    options: Any = {"solution": quadrotor_solution, "disturbances": "light", "actions": "controls"}
    env = gymnasium.make_vec("lqrsim/Quadrotor-v0", num_envs=4, **options)
    assert isinstance(env, lqrsim.gym.VectorEnvironment)
    expert, single = lqrsim.gym.Expert(env), lqrsim.gym.make_env("quadrotor", **options)
    for first in (0, 4):
        observations, info = env.reset(seed=1 if first == 0 else None)
        assert observations.shape == env.observation_space.shape
        rewards, before = np.zeros(4), np.zeros(4, dtype=bool)
        while not before.all():
            kept = observations
            observations, gained, terminated, truncated, info = env.step(expert(observations))
            np.testing.assert_array_equal(observations[before], kept[before])
            assert not gained[before].any()
            assert not (terminated & truncated).any()
            rewards, before = rewards + gained, terminated | truncated
        assert info["trial"].tolist() == [first, first + 1, first + 2, first + 3]
        assert info["outcome"].tolist() == list(rollout.outcome[first : first + 4])
        own = env.rollout()
        for k in range(4):
            count = int(np.ceil(rollout.ended[first + k] / quadrotor.problem.dt - 1e-9)) + 1
            np.testing.assert_array_equal(own.states[k, :count], rollout.states[first + k, :count])
        alone = run(single, lqrsim.gym.Expert(single), seed=1, options={"trial": first + 2})
        assert rewards[2] == pytest.approx(alone[1].sum(), rel=1e-12)
    assert {"collided"} <= set(rollout.outcome)
    with pytest.raises(InputError, match=r"^step: all episodes have ended"):
        env.step(env.action_space.sample())


def test_normalized_actions_are_the_controls_between_their_limits(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    env: Any = lqrsim.gym.make_env(differential_drive, solution=drive_solution)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)
    env.reset(seed=0)
    for action in ([-1.0, 1.0], [0.0, 0.5], [3.0, -3.0]):  # the last is cut off
        env.unwrapped.step(action)
    space = differential_drive.robot.dynamics.control_coordinates
    fast = np.array(space.high)
    expected = np.array([[-1, 1], [0, 0.5], [1, -1]]) * fast
    np.testing.assert_allclose(env.unwrapped.rollout().applied[0, :3], expected, rtol=0, atol=1e-15)
    # The expert's actions are its controls, to rounding.
    _, rewards, info, _ = run(env, lqrsim.gym.Expert(env), seed=0)
    undisturbed = ls.simulate(differential_drive.plant(), drive_solution)
    told = ls.stress.outcomes(undisturbed, differential_drive.problem)
    assert info["is_success"]
    assert -rewards.sum() == pytest.approx(told.cost[0], rel=1e-9)


def test_a_collision_terminates(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    """Straight ahead from the start, the robot meets something; the final cost is that of where it ends."""
    env = lqrsim.gym.make_env(differential_drive, solution=drive_solution, actions="controls")
    seen, rewards, info, ended = run(env, lambda seen: np.full(2, 0.5), seed=0)
    assert ended == [True, False]
    assert info["outcome"] == "collided"
    assert not info["is_success"]
    assert info["clearance"] < 1e-3  # it stands at what it hit
    assert len(rewards) < differential_drive.problem.steps
    weight, goal = np.array((5000.0, 5000.0, 50.0)), np.array((0.0, 2.5, np.pi))
    final = 0.5 * weight @ np.square(info["state"] - goal)  # of Fig. 2
    assert -rewards[-1] == pytest.approx(final, rel=0.01)
    assert seen.shape == (len(rewards) + 1, 4)


def test_options_of_reset(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    env: Any = lqrsim.gym.make_env("quadrotor", solution=quadrotor_solution)
    calm, _ = env.reset(seed=0)
    # As MuJoCo has it: through a quaternion and back.
    np.testing.assert_allclose(calm[:-1], quadrotor_solution.trajectory.states[0], rtol=0, atol=1e-14)
    by_name, _ = env.reset(seed=0, options={"preset": "severe"})
    alike, _ = env.reset(seed=0, options={"disturbances": "severe"})
    listed, info = env.reset(
        seed=0, options={"disturbances": ls.disturbances.preset("severe", quadrotor.plant()), "trial": 2}
    )
    assert info["trial"] == 2
    weak, _ = env.reset(seed=0, options={"preset": "light", "strength": 3.0})
    np.testing.assert_array_equal(by_name, alike)
    np.testing.assert_array_equal(by_name, weak)  # severe is three times light
    assert (by_name != listed).any()
    again, info = env.reset()  # the trial after it, and the disturbances of `make` again: none
    assert info["trial"] == 1
    np.testing.assert_array_equal(again, calm)


REFUSED: tuple[Any, ...] = (
    {"wind": 1}, {"preset": "mild"}, {"strength": 2}, {"trial": -1}, {"disturbances": "light", "strength": -1},
    {"preset": "calm", "disturbances": ()}, {"disturbances": (ls.disturbances.Push((1, 0, 0), at=99),)},
)  # fmt: skip


@pytest.mark.parametrize("case", range(4))
def test_a_refused_reset_changes_nothing(case: int, quadrotor_solution: ls.Solution) -> None:
    """Each seed and trial is that of an environment whose resets were all right."""
    rng, make = np.random.default_rng([91, case]), lqrsim.gym.make_vec if case % 2 else lqrsim.gym.make_env
    options: dict[str, Any] = {"num_envs": 2} if case % 2 else {}
    asked, other = (make("quadrotor", solution=quadrotor_solution, **options).unwrapped for _ in range(2))
    for turn in range(6):
        random = asked.np_random
        with pytest.raises(InputError):
            asked.reset(seed=[None, int(rng.integers(9))][rng.integers(2)], options=REFUSED[rng.integers(len(REFUSED))])
        assert asked.np_random is random
        seed = int(rng.integers(9)) if turn in (0, 3) else None
        (_, found), (_, wanted) = asked.reset(seed=seed), other.reset(seed=seed)
        assert (found["seed"], np.ravel(found["trial"]).tolist()) == (
            wanted["seed"],
            np.ravel(wanted["trial"]).tolist(),
        )


class Reading(Feedback):
    """The numbers that it wants are no observations, however many there are."""

    sensors = property(lambda self: object())  # pyright: ignore


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda env: env.step(np.zeros(4)), "no episode: call reset() first"),
        (lambda env: (env.reset(), env.step([np.nan] * 4)), "action: got nan at index [0, 0], want finite"),
        (lambda env: (env.reset(), env.step([0.0])), "action: got shape (1, 1)"),
        (lambda env: env.reset(options={"wind": 1}), "options: got 'wind', want one of: disturbances, preset"),
        (lambda env: env.reset(options={"preset": "mild"}), "disturbances: got 'mild', want one of: scenario, calm"),
        (lambda env: env.reset(options={"preset": None}), "options: preset: got None, want a name, as in"),
        (lambda env: env.reset(options={"preset": ["calm"]}), "options: preset: got ['calm'], want a name, as in"),
        (lambda env: env.reset(options={"strength": 2}), "options: got strength alone"),
        (lambda env: env.reset(options={"preset": "calm", "disturbances": ()}), "options: got disturbances and preset"),
        (lambda env: lqrsim.gym.Expert(env)(np.zeros((0, 13))), "observation: got shape (0, 13), want (13,) or"),
        (lambda env: lqrsim.gym.Expert(env)(np.zeros((2, 3, 13))), "observation: got shape (2, 3, 13), want (13,)"),
        (lambda env: lqrsim.gym.Expert(env)(np.zeros(12)), "observation: got shape (12,)"),
        (lambda env: lqrsim.gym.Expert(env, Reading(env.solution.policy)), "controller: got a Reading that reads sen"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused(call: Any, line: str, quadrotor_solution: ls.Solution) -> None:
    env = lqrsim.gym.Environment("quadrotor", solution=quadrotor_solution)
    with pytest.raises(InputError) as caught:
        call(env)
    assert str(caught.value).startswith(line)


def test_wrong_environments_are_refused(drive_solution: ls.Solution, quadrotor_solution: ls.Solution) -> None:
    wrong: Any = lqrsim.gym.Environment
    for options, line in (
        ({"scenario": 3}, "scenario: got 3, want"),
        ({"scenario": "drive"}, "scenario: got 'drive', want one of"),
        ({"scenario": "quadrotor", "actions": "torques"}, "actions: got 'torques', want one of: normalized, controls"),
        ({"scenario": "quadrotor", "render_mode": "human"}, "render_mode: got 'human', want one of: rgb_array"),
        ({"scenario": "quadrotor", "camera": "chase"}, "camera: got 'chase'"),
        ({"scenario": "quadrotor", "camera": np.zeros(0)}, "camera: got array([], dtype=float64), want the name"),
        *[
            ({"scenario": "quadrotor", "strength": size}, f"strength: got {size} without disturbances")
            for size in (0, 2.5)
        ],
    ):
        with pytest.raises(InputError) as caught:
            wrong(**options)
        assert str(caught.value).startswith(line)
    with pytest.raises(InputError, match=r"^solution: got "):
        wrong("quadrotor", solution=drive_solution).reset()
    many: Any = lqrsim.gym.VectorEnvironment("quadrotor", num_envs=2, solution=quadrotor_solution)
    for reset, line in (
        ({"seed": [1, 2]}, "seed: got 2 seeds, want one"),
        ({"options": {"reset_mask": np.array([True, False])}}, "options: reset_mask: got a part of the episodes"),
    ):
        with pytest.raises(InputError) as caught:
            many.reset(**reset)
        assert str(caught.value).startswith(line)


def test_any_mjcf_and_any_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cart.xml").write_text(mechanisms.draw("cart", 0).xml, encoding="utf-8")
    Path("mine.py").write_text(
        "import lqrsim as ls\n\ndef push(steps=20):\n    return ls.scenarios.mjcf('cart.xml', steps=steps)\n",
        encoding="utf-8",
    )
    for reference in ("cart.xml,steps=20", "mine.py:push,steps=20"):
        env: Any = lqrsim.gym.make_env(reference)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env.unwrapped, skip_render_check=True)
        _, rewards, _, ended = run(env, lambda seen: np.zeros(1), seed=0)
        assert len(rewards) == 20
        assert ended == [False, True]


def test_controls_without_limits_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(arm(0.3), encoding="utf-8")
    with pytest.raises(InputError, match=r"^scenario: got control a within -inf to inf, want finite limits"):
        lqrsim.gym.Environment(str(path))


@pytest.mark.skipif(bool(gl.missing()), reason="needs OpenGL")
def test_pictures_are_those_of_still(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution, tmp_path: Path) -> None:
    rollout = ls.simulate(quadrotor.plant(), quadrotor_solution)
    env: Any = lqrsim.gym.make_env(
        "quadrotor", solution=quadrotor_solution, actions="controls", render_mode="rgb_array", camera="top"
    )
    expert, pictures = lqrsim.gym.Expert(env), {}
    seen, _ = env.reset(seed=0)
    for step in range(61):
        if step in (0, 60):
            pictures[step] = env.render().copy()
        seen, *_ = env.step(expert(seen))
    env.close()
    assert env.metadata["render_fps"] == 30
    assert (pictures[0] != pictures[60]).any()
    for step, picture in pictures.items():
        path = ls.render(
            rollout, tmp_path / "still.png", time=step / 30, camera="top", overlays=("plan",), quality="draft",
        )  # fmt: skip
        np.testing.assert_array_equal(picture, np.asarray(Image.open(path)))


@pytest.mark.skipif(bool(gl.missing()), reason="needs OpenGL")
def test_pictures_have_the_obstacles_of_their_episode(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Each episode has its obstacles elsewhere, or none of them has; a picture does not depend on those before."""

    def picture(env: Any, trial: int, size: float) -> np.ndarray:
        moved = {"disturbances": (ls.disturbances.DisplacedObstacles(size),)}
        env.reset(seed=3, options={"trial": trial, **moved})
        return env.render().copy()

    options: dict[str, Any] = {"solution": quadrotor_solution, "render_mode": "rgb_array", "size": (320, 180)}
    with contextlib.closing(lqrsim.gym.Environment(quadrotor, **options)) as env:
        cases = [(trial, size) for size in (0.3, 0.0) for trial in (0, 1, 1, 2)]
        seen = [picture(env, *case) for case in cases]
    assert len({image.tobytes() for image in seen}) == 4
    for image, case in zip(seen, cases, strict=True):
        with contextlib.closing(lqrsim.gym.Environment(quadrotor, **options)) as alone:
            np.testing.assert_array_equal(image, picture(alone, *case))


def test_observations_are_bounded_as_mujoco_bounds_them() -> None:
    assert mujoco.mjMAXVAL == LARGEST

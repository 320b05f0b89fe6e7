"""The double pendulum of RealAIGym's board, its runs and its score."""

import mujoco
import numpy as np
import pytest
from board import double_pendulum, performance, trials
from board.double_pendulum import MODELS, UNKNOWN, Robot, advance, dynamics, off_upright, rate

from lqrsim.errors import Array

MJCF = """
<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/>
<worldbody><body>
  <joint name="shoulder" axis="0 -1 0" damping="{b1}"/>
  <inertial pos="0 0 -{r1}" mass="{m1}" diaginertia="1 {i1} 1"/>
  <body pos="0 0 -{l1}"><joint name="elbow" axis="0 -1 0" damping="{b2}"/>
    <inertial pos="0 0 -{r2}" mass="{m2}" diaginertia="1 {i2} 1"/>
  </body>
</body></worldbody></mujoco>"""


def of(robot: Robot, version: int, **wrong: float) -> dict[str, Array]:
    return {name: np.array([value]) for name, value in {**MODELS[robot, version], **UNKNOWN, **wrong}.items()}


@pytest.mark.parametrize(("robot", "version"), MODELS)
def test_it_moves_as_in_mujoco(robot: Robot, version: int) -> None:
    """Accelerations at random states and torques, to 1e-9 of them; the inertias are about the joints there.

    The longer lever of the acrobot of version 1 has less inertia than its mass at the end: MuJoCo takes no body of that
    kind, so all get shorter ones.
    """
    rng, short = np.random.default_rng(version), {"r1": 0.15, "r2": 0.15}
    p = {**MODELS[robot, version], **short, "b1": 0.03, "b2": 0.02}
    about = {"i1": p["I1"] - p["m1"] * p["r1"] ** 2, "i2": p["I2"] - p["m2"] * p["r2"] ** 2}
    model = mujoco.MjModel.from_xml_string(MJCF.format(**p, **about).replace('"1 ', '"0.03 ').replace(' 1"', ' 0.03"'))
    data = mujoco.MjData(model)
    for _ in range(20):
        x, torques = rng.uniform(-3, 3, 4), rng.uniform(-6, 6, 2)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = x[:2], x[2:], torques
        mujoco.mj_forward(model, data)
        ours = rate(x[None], torques[None], of(robot, version, **short, b1=0.03, b2=0.02))[0]
        np.testing.assert_allclose(ours[2:], data.qacc, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(ours[:2], x[2:])


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_the_plans_know_the_same_motion(robot: double_pendulum.Robot) -> None:
    """To rounding."""
    rng = np.random.default_rng(0)
    model, motor = dynamics(robot, 2), double_pendulum.ACTUATED[robot]
    for _ in range(10):
        x, torques = rng.uniform(-3, 3, 4), np.zeros(2)
        torques[motor] = rng.uniform(-6, 6)
        ours = advance(x[None], torques[None], of(robot, 2), 0.02)[0]
        np.testing.assert_allclose(model.step(x, torques[[motor]], 0.02), ours, rtol=0, atol=1e-11)


def test_runs_are_as_published() -> None:
    for version, count in ((1, 672), (2, 722)):
        every = trials.trials("acrobot", version)
        assert len(every) == count == 10 * 21 + 2 * 21 * 10 + 2 * 21 + 50 * (version == 2)
        assert [one.number for one in every] == list(range(count))
        assert max(one.late for one in every) == 20  # 40 ms
    levers = [one.parameters["r1"] for one in every if one.column == "m1r1"]
    np.testing.assert_allclose(levers, 0.2 * np.linspace(0.75, 1.25, 21))
    levers = [one.parameters["r1"] for one in trials.trials("pendubot", 1) if one.column == "m1r1"]
    np.testing.assert_allclose(levers, 0.3 * np.linspace(0.75, 1.25, 21))  # whose links are of other lengths


@pytest.mark.parametrize("seed", range(3))
def test_pushes_are_a_second_apart(seed: int) -> None:
    """Six of them, of 0.5 to 5 Nm."""
    pushes = trials._pushes(np.random.default_rng(seed))
    strong = np.abs(pushes) > 0.45
    tops = [t for joint in range(2) for t in range(1, len(pushes) - 1)
            if strong[t, joint] and abs(pushes[t, joint]) >= np.abs(pushes[t - 1 : t + 2, joint]).max()]  # fmt: skip
    assert len(tops) == 6
    assert np.diff(sorted(tops)).min() * trials.DT > 0.99
    assert 0.49 < np.abs(pushes).max() < 5.01


def test_upright_is_so_after_any_turns() -> None:
    turned = np.array([[-np.pi, 2 * np.pi, 0, 0], [3 * np.pi + 0.1, -0.2, 0.3, -0.4], [0, np.pi, 0, 0]])
    wanted = [[0, 0, 0, 0], [0.1, 0.2, 0.3, 0.4], [np.pi, np.pi, 0, 0]]
    np.testing.assert_allclose(off_upright(turned), wanted, rtol=0, atol=1e-12)


def test_a_law_that_does_nothing_never_swings_up() -> None:
    """Nor does noise at its most help it; and a run does not depend on which others there are."""
    every = trials.trials("acrobot", 1)
    chosen = [every[0], [one for one in every if one.torque_noise][-1]]
    assert not trials.simulate(chosen, lambda measured: np.zeros(len(measured)), "acrobot", 1, 0).any()


def test_a_level_of_noise_counts_by_most_of_its_runs() -> None:
    every = trials.trials("acrobot", 1)
    noise = [one for one in every if one.column == "torque noise"][:20]
    model = [one for one in every if one.column == "b1"][:4]
    good = np.array([True] * 6 + [False] * 4 + [True] * 5 + [False] * 5 + [True, False, False, False])
    found = trials.columns([*noise, *model], good)
    assert found == {"model": 0.25, "torque noise": 0.5, "score": 0.375}
    assert trials.of_parameters([*noise, *model], good) == {"b1": 0.25}


@pytest.mark.parametrize(
    ("version", "criteria", "score"),
    [  # time, energy, most torque, its integral, its cost, smoothness and velocity cost, as the board shows them
        (1, (1.1, 9.81, 2.82, 1.27, 2.27, 0.057, 242.44), 0.869),
        (1, (4.8, 53.75, 3.0, 12.28, 33.06, 0.136, 870.16), 0.594),
        (2, (1.0, 8.08, 0, 0, 1.8, 0.01, 88.5), 0.655),
        (2, (4.13, 9.53, 0, 0, 1.26, 0.007, 211.12), 0.526),
    ],
)
def test_scores_are_the_published_ones(version: int, criteria: tuple[float, ...], score: float) -> None:
    """Up to the digits that the board shows, of which those of the smoothness weigh most."""
    digit = {1: 1e-3, 2: 0.0005 * np.pi / 0.1 / 5 + 5e-4}[version]
    assert performance.score(np.array(criteria), version) == pytest.approx(score, abs=digit)


def test_criteria_of_a_run_whose_integrals_are_known() -> None:
    """The shoulder turns one and a half times in 5 s under 3 Nm, and stays upright: to a step in 5000.

    It passes upright before, which does not count.
    """
    t, rate = trials.DT * np.arange(trials.STEPS), 3 * np.pi / 5
    states, torques = np.zeros((trials.STEPS, 4)), np.full(trials.STEPS, -3.0)
    states[:, 0], states[:, 2] = np.minimum(rate * t, 3 * np.pi), np.where(t < 5, rate, 0.0)
    found = performance.criteria(states, torques, "pendubot", 1)
    known = [5 - np.arccos(0.9) / rate, 3 * 3 * np.pi, 3, 30, 90, 0, 5 * rate**2]
    np.testing.assert_allclose(found, known, rtol=5e-4, atol=1e-12)
    assert performance.score(performance.criteria(0 * states, torques, "pendubot", 1), 1) == 0

"""Rare failures: trials as functions of numbers, and probabilities by splitting against what is known exactly."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from mechanisms import motors, sled
from sampling import is_short, rarely
from scipy import stats

import lqrsim as ls
from lqrsim.disturbances import (
    DisplacedObstacles,
    Disturbance,
    ForceNoise,
    InitialStateError,
    MeasurementNoise,
    Push,
)
from lqrsim.simulation.disturbances import preset
from lqrsim.stress.failure_search import PrescribedDraws, ReliabilityProblem, TrialScore, collision_score, miss_score
from lqrsim.stress.reliability import NoFailure, failure_probability, smallest_failure
from lqrsim.stress.statistics import rate
from lqrsim.templates.my_robot.my_robot import MyRobot


def along(size: int, distance: float) -> Callable[[np.ndarray], np.ndarray]:
    """Fails beyond a plane so far from the origin: a known probability, and a known nearest failure."""
    return lambda z: z @ np.full(size, 1 / np.sqrt(size)) - distance


# Numbers that are given


@pytest.mark.parametrize(
    ("draw", "distribution"),
    [
        (lambda g, n: g.standard_normal(n), stats.norm()),
        (lambda g, n: g.normal(2.0, 3.0, n), stats.norm(2, 3)),
        (lambda g, n: g.random(n), stats.uniform()),
        (lambda g, n: g.uniform(-1.0, 4.0, size=(n,)), stats.uniform(-1, 5)),
        (lambda g, n: g.exponential(2.0, n), stats.expon(scale=2)),
    ],
)
def test_numbers_have_the_distribution_that_was_asked_for(draw: Callable[..., Any], distribution: Any) -> None:
    numbers = np.random.default_rng(5).standard_normal(4000)
    assert stats.kstest(draw(PrescribedDraws(numbers), 4000), distribution.cdf).pvalue > 0.001


def test_whole_numbers_and_choices_have_their_shares() -> None:
    draws = PrescribedDraws(np.random.default_rng(5).standard_normal(9000))
    assert stats.chisquare(np.bincount(draws.integers(2, 5, size=3000))[2:]).pvalue > 0.001
    assert stats.chisquare(np.bincount(draws.choice(3, 3000, p=(0.2, 0.5, 0.3))), (600, 1500, 900)).pvalue > 0.001
    assert sorted(draws.choice([4, 5, 6], 3, replace=False)) == [4, 5, 6]
    assert draws.used == 6003
    pairs = draws.integers([2, 6], [4, 7], (1000, 2), endpoint=True)
    assert stats.chisquare(np.bincount(pairs[:, 0])[2:]).pvalue > 0.001
    assert stats.chisquare(np.bincount(pairs[:, 1])[6:]).pvalue > 0.001


def test_sizes_are_those_of_numpy() -> None:
    numpy = np.random.default_rng(0)
    draws: Any = PrescribedDraws(np.random.default_rng(1).standard_normal(100))
    for name, arguments in (
        ("standard_normal", {}), ("standard_normal", {"size": (2, 3)}), ("random", {}), ("random", {"size": 4}),
        ("normal", {"loc": [0.0, 1.0]}), ("normal", {"scale": 2.0}), ("uniform", {"low": [0.0, 1.0], "high": 2.0}),
        ("integers", {"low": 4}), ("integers", {"low": 1, "high": 3, "size": 5}), ("choice", {"a": 3}),
        ("integers", {"low": [1, 2], "high": [5, 9]}), ("integers", {"low": [[1], [2]], "high": 4, "size": (2, 3)}),
        ("integers", {"low": [3, 4, 5]}), ("integers", {"low": 2, "high": np.array([3, 4]), "endpoint": True}),
        ("choice", {"a": [1.5, 2.5], "size": (2, 2)}), ("choice", {"a": 4, "size": 2, "replace": False}),
        ("integers", {"low": [1, 2, 3]}), ("integers", {"low": 0, "high": [1, 2], "endpoint": True}),
        ("choice", {"a": np.ones((2, 3)), "size": 4, "axis": 1}), ("choice", {"a": np.ones((2, 3))}),
        ("choice", {"a": np.ones((4, 3)), "size": 2, "replace": False, "shuffle": False}),
    ):  # fmt: skip
        assert np.shape(getattr(draws, name)(**arguments)) == np.shape(getattr(numpy, name)(**arguments)), name


@pytest.mark.parametrize("dtype", [np.int64, np.int8, np.uint16, "int32", int, bool, np.float32, "float64"])
def test_types_and_bounds_are_those_of_numpy(dtype: Any) -> None:
    rng, draws = np.random.default_rng(0), PrescribedDraws(np.linspace(-9, 9, 4000))
    whole = np.dtype(dtype).kind != "f"
    for size in (None, 7, (2, 3)) if whole else (7, (2, 3)):
        if whole:
            calls = [lambda of, size=size: of.integers(0, 2, size, dtype)]
            calls += [lambda of, size=size: of.integers(1, size=size, dtype=dtype, endpoint=True)]
        else:
            calls = [
                lambda of, name=name, size=size: getattr(of, name)(size, dtype)
                for name in ("random", "standard_normal")
            ]
        for call in calls:
            assert np.asarray(call(draws)).dtype == np.asarray(call(rng)).dtype
    if whole:
        assert set(PrescribedDraws(np.linspace(-9, 9, 4000)).integers(0, 2, 4000, dtype).tolist()) == {0, 1}
    else:
        assert PrescribedDraws(np.linspace(-9, 9, 4000)).random(4000, dtype).max() < 1


# Trials of a robot


@pytest.fixture(scope="module")
def disturbances() -> list[Disturbance]:
    return [
        ForceNoise(0.2),
        MeasurementNoise(0.005),
        Push((0.1, 0.0, 0.0), at=1.0),
    ]


def test_the_same_numbers_give_the_trial_that_simulate_gives(
    quadrotor: ls.Scenario, quadrotor_solution: ls.Solution, disturbances: list[Disturbance]
) -> None:
    trials = TrialScore(quadrotor.plant(), quadrotor_solution, disturbances, contacts=True)
    assert trials.sizes == (150 * 3, 151 * 12, 0)
    simulated = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=disturbances, seed=2, trials=3)
    keys = [[np.random.SeedSequence(2, spawn_key=(trial, stream)) for stream in (0, 1)] for trial in range(3)]
    numbers = np.array([
        np.concatenate([
            np.random.Generator(np.random.SFC64(key)).standard_normal(count)
            for key, count in zip(pair, trials.sizes, strict=False)
        ])
        for pair in keys
    ])  # fmt: skip
    np.testing.assert_array_equal(trials.rollout(numbers).states, simulated.states)
    np.testing.assert_array_equal(trials(numbers), -simulated.clearance.min(axis=1))
    # Nothing drawn is nothing that goes wrong, but for what is not random.
    push = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=disturbances[2:])
    np.testing.assert_allclose(trials.rollout(np.zeros((1, trials.size))).states, push.states, atol=1e-12)


@pytest.mark.parametrize("name", ["quadrotor", "differential_drive"])
def test_any_numbers_give_trials_of_every_preset(
    name: str, quadrotor_solution: ls.Solution, drive_solution: ls.Solution
) -> None:
    """However large: each number of a trial decides on its own part of it."""
    solution = {"quadrotor": quadrotor_solution, "differential_drive": drive_solution}[name]
    plant = ls.scenarios.get(name).plant()
    trials = TrialScore(plant, solution, preset("light", plant), failure=miss_score)
    scores = trials([np.zeros(trials.size), np.full(trials.size, 9.0), np.full(trials.size, -9.0)])
    assert scores[0] < 0
    assert not np.isnan(scores).any()


def test_scores_are_positive_where_trials_fail(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    rollout = ls.simulate(
        quadrotor.plant(),
        quadrotor_solution.open_loop(),
        disturbances=[ForceNoise(0.1)],
        trials=60,
        frames=False,
    )
    np.testing.assert_array_equal(collision_score(rollout) > 0, rollout.collided)
    np.testing.assert_array_equal(miss_score(rollout) > 0, ~rollout.reached)
    assert 5 < rollout.reached.sum() < 55


# Splitting, where the probability is known


@pytest.mark.parametrize("size", [2, 200])
def test_a_plane_one_in_a_million(size: int) -> None:
    """Within four standard errors, which are at most a seventh of it: 1 % of what plain Monte Carlo takes for that."""
    found = failure_probability(along(size, 4.75), size, repetitions=20, seed=1)
    exact = stats.norm.sf(4.75)
    assert found.standard_error < exact / 7
    assert abs(found.probability.value - exact) < 4 * found.standard_error
    plain = (1 - exact) * exact / found.standard_error**2
    assert found.simulations < plain / 50
    assert found.probability.low < exact < found.probability.high
    assert len(str(found).splitlines()) == 2  # no arrays
    assert f"{found.probability:.2g} (95 % interval, 20 repetitions)" in str(found)


def test_outside_of_a_ball_one_in_a_million() -> None:
    """Many directions at once, against the chi-square distribution."""
    radius = np.sqrt(stats.chi2.isf(1e-6, 20))
    found = failure_probability(lambda z: np.linalg.norm(z, axis=1) - radius, 20, repetitions=20, seed=1)
    assert abs(found.probability.value - 1e-6) < 4 * found.standard_error
    assert found.standard_error < 1e-6 / 7


def test_two_opposite_planes_are_both_found() -> None:
    found = failure_probability(lambda z: np.abs(z[:, 0]) - 4.0, 5, repetitions=20, seed=1)
    assert abs(found.probability.value - 2 * stats.norm.sf(4)) < 4 * found.standard_error
    assert 0.2 < np.mean(found.failures[:, 0] > 0) < 0.8


def test_failures_are_counted_without_levels() -> None:
    """Each vector is evaluated once; the interval is Clopper and Pearson's."""
    found = failure_probability(along(3, 1.5), 3, particles=200, keep=0, repetitions=7, seed=5)
    k, n = len(found.failures), 1400
    assert (found.simulations, found.levels.tolist()) == (n, [0.0])
    exact = stats.binomtest(k, n).proportion_ci(method="exact")
    one = found.probability
    assert (one.value, one.low, one.high) == pytest.approx((k / n, exact.low, exact.high))
    assert stats.binomtest(k, n, float(stats.norm.sf(1.5))).pvalue > 1e-4


def test_repetitions_have_no_bias_and_the_standard_error_is_theirs() -> None:
    """Few particles and one move, where levels from the particles themselves would be off."""
    repetitions = 1000 if is_short() else 2000
    found = failure_probability(along(4, 3.5), 4, particles=40, moves=1, keep=0.25, repetitions=repetitions, seed=4)
    exact = stats.norm.sf(3.5)
    assert abs(found.probability.value - exact) < 4 * found.standard_error
    assert found.standard_error < 0.05 * exact * np.sqrt(2000 / repetitions)


@pytest.mark.parametrize(("particles", "repetitions"), [(200, 3), *rarely((20, 10))])
def test_intervals_cover(particles: int, repetitions: int) -> None:
    """Of 400 studies 95 % less three standard deviations, also with so few particles that a third find nothing.

    Student's interval about the mean covers 88 % with 20 particles, and misses on one side.
    """
    exact = stats.norm.sf(3.0)
    found = []
    for seed in range(400):
        try:
            one = failure_probability(along(3, 3.0), 3, particles=particles, repetitions=repetitions, seed=seed)
            found.append(one.probability)
        except NoFailure:
            continue
    assert len(found) > 390
    low, high = (sum(missed) for missed in zip(*((one.high < exact, one.low > exact) for one in found), strict=True))
    deviation = np.sqrt(len(found) * 0.95 * 0.05)
    assert low + high <= 0.05 * len(found) + 3 * deviation
    assert low <= 0.025 * len(found) + 3 * deviation


def test_repetitions_that_bound_nothing_say_so() -> None:
    """Two that differ by a half: by Student's t with one degree of freedom anything above may be."""
    found = failure_probability(along(3, 4.0), 3, particles=20, repetitions=2, seed=0)
    assert found.repetitions.min() < 0.5 * found.repetitions.max()
    assert found.probability.high == 1.0
    assert 0 < found.probability.low < found.probability.value


def test_repetitions_that_agree_by_chance_are_not_sure() -> None:
    """So few particles that two repetitions have the same product; independent particles would differ."""
    found = failure_probability(along(2, 2.0), 2, particles=10, keep=0.2, repetitions=2, seed=51)
    assert (len(found.levels), found.standard_error) == (3, 0)
    assert found.probability.low < 0.5 * found.probability.value
    assert found.probability.high == 1


def test_one_level_is_plain_trials() -> None:
    """Counted by hand; certain failure, too, is only so certain."""
    found = failure_probability(along(2, 0.5), 2, repetitions=4)
    counted = round(float(found.repetitions.sum()) * 500)
    assert found.probability == rate(counted, 2000)
    short: Any = np.int8(2)
    small = failure_probability(along(2, 0.5), short, particles=10 * np.int16(1), keep=0.2, repetitions=short)  # pyright: ignore[reportArgumentType]
    assert small.probability == failure_probability(along(2, 0.5), 2, particles=10, keep=0.2, repetitions=2).probability
    always = failure_probability(lambda z: np.ones(len(z)), 2, particles=10, keep=0.2, repetitions=2).probability
    assert always == rate(20, 20)
    assert always.low < 0.9


def test_failures_are_failures_and_simulations_are_counted() -> None:
    asked = []

    def score(z: np.ndarray) -> np.ndarray:
        asked.append(len(z))
        return along(6, 3.0)(z)

    one, again = (failure_probability(score, 6, particles=100, repetitions=3, seed=9) for _ in range(2))
    assert (one.scores > 0).all()
    np.testing.assert_array_equal(one.scores, along(6, 3.0)(one.failures))
    assert one.simulations == again.simulations == sum(asked) / 2
    np.testing.assert_array_equal(one.repetitions, again.repetitions)
    assert one.levels[-1] == 0
    assert (np.diff(one.levels) > 0).all()


def test_plain_trials_for_the_same_certainty() -> None:
    """By their definition: so many of a known rate have the standard error that was found."""
    found = failure_probability(along(3, 3.0), 3, particles=200, repetitions=8)
    p, n = found.probability.value, found.plain_trials
    assert np.sqrt(p * (1 - p) / n) == pytest.approx(found.standard_error)
    assert n > found.simulations


def test_what_is_not_rare_needs_no_levels() -> None:
    found = failure_probability(along(2, 0.5), 2, repetitions=10)
    assert found.levels.tolist() == [0.0]
    assert found.probability.low < stats.norm.sf(0.5) < found.probability.high


def with_floor(rng: np.random.Generator) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """A score that is the same for nearly all vectors, and its probability. Some jump where they fail."""
    chance, floor, jump = 10 ** rng.uniform(-3.5, -2.5), rng.uniform(0.01, 0.6), rng.uniform() < 0.5
    beyond = stats.norm.isf(chance)
    if jump:
        return lambda z: np.where(z[:, 0] > beyond, 1.0, -floor), chance
    return lambda z: np.maximum(z[:, 0] - beyond, -floor), chance


def test_scores_that_tie_are_told_apart_by_more_vectors() -> None:
    """20 drawn scores: each within five standard errors, their mean ratio within four of it. All were refused before,
    or had an interval up to 1: of 250 vectors none or one is above the tie.
    """
    rng, ratios = np.random.default_rng(8), list[float]()
    for seed in range(20):
        score, chance = with_floor(rng)
        found = failure_probability(score, 3, particles=250, repetitions=6, seed=seed)
        assert abs(found.probability.value - chance) < 5 * found.standard_error, (chance, found)
        assert found.probability.high < 4 * chance
        assert (found.scores > 0).all()
        ratios.append(found.probability.value / chance)
    assert abs(np.mean(ratios) - 1) < 4 * np.std(ratios, ddof=1) / np.sqrt(len(ratios))


def test_more_vectors_at_a_tie_leave_no_bias() -> None:
    """Few particles, a tie at first and one in the middle: 500 repetitions, against the normal distribution."""

    def score(z: np.ndarray) -> np.ndarray:
        x = z[:, 0] - 3.2
        return np.where((x > -0.9) & (x < -0.3), -0.6, np.maximum(x, -1.6))

    found = failure_probability(score, 2, particles=40, moves=2, keep=0.25, repetitions=500, seed=3)
    assert {-1.6, -0.6} < {*found.levels.tolist()}
    assert abs(found.probability.value - stats.norm.sf(3.2)) < 4 * found.standard_error
    assert found.standard_error < 0.1 * stats.norm.sf(3.2)


@pytest.mark.parametrize("floor", [0.0, -0.02, -3.0])
def test_scores_that_all_tie_are_named(floor: float) -> None:
    with pytest.raises(NoFailure, match=f"scores that tie at {floor:g} after 0 levels, and none of 1,280 ") as refused:
        failure_probability(lambda z: np.full(len(z), floor), 2, particles=20)
    assert refused.value.trials == 1280
    with pytest.raises(NoFailure) as refused:
        failure_probability(lambda z: np.full(len(z), floor), 2, particles=20, keep=0, repetitions=7)
    assert refused.value.trials == 140
    with pytest.raises(NoFailure, match="too rare, or none exist") as refused:
        failure_probability(along(2, 60.0), 2, particles=20)
    assert refused.value.trials == 0


def docked(gap: float, folder: Path) -> tuple[ls.Plant, ls.Solution]:
    """A disc that starts at this distance from its dock, and passes a pillar at 0.15 m."""
    text = sled(
        "xy", name="my_robot", names=("slide_x", "slide_y"), joint='damping="0.2"',
        geom='type="cylinder" size="0.1 0.03" mass="0.5"', option='timestep="0.025" integrator="Euler" gravity="0 0 0"',
        things=f"""<geom name="dock" type="cylinder" size="0.1 0.1" pos="{-1.2 - gap} 0 0.07"/>
          <geom name="pillar" type="cylinder" size="0.15 0.1" pos="0.6 -0.4 0.07"/>""",
        actuators=motors(("slide_x", "slide_y"), (2, 2)).replace('name="slide', 'name="push'),
    )  # fmt: skip
    (folder / "docked.xml").write_text(text, encoding="utf-8")
    robot, scene = MyRobot(), ls.load_scene(folder / "docked.xml")
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.1, steps=40, initial=ls.FixedState((-1.0, 0.0, 0.0, 0.0)),
        stage_cost=ls.ControlCost((1.0, 1.0)), final_cost=ls.QuadraticCost((500.0,) * 4, about=(1.2, 0.0, 0.0, 0.0)),
    )  # fmt: skip
    return ls.Plant(robot, scene), ls.smooth(problem)


@pytest.mark.parametrize("seed", [0, *rarely(1, 2)])
def test_a_start_beside_an_obstacle_hides_no_failure(seed: int, tmp_path: Path) -> None:
    """Against plain trials. Nearly all have their least clearance at the start, which tells nothing."""
    gap = np.random.default_rng(seed).uniform(0.005, 0.04)
    plant, solution = docked(gap, tmp_path)
    trials = TrialScore(plant, solution, [ForceNoise((0.0, 0.13, 0.0))], threads=1)
    assert 5 < trials.first < 25
    numbers = np.random.default_rng(9 + seed).standard_normal((200, trials.size))
    run, scores = trials.rollout(numbers, frames=False), trials(numbers)
    assert np.mean(run.clearance.argmin(axis=1) == 0) > 0.97
    np.testing.assert_array_equal(scores, -run.clearance[:, trials.first :].min(axis=1))
    assert len(np.unique(scores)) == 200
    np.testing.assert_array_equal(collision_score(run), -run.clearance.min(axis=1))
    outside = run.goal_distance - run.goal_radius
    np.testing.assert_array_equal(miss_score(run, first=trials.first), np.maximum(scores, outside))
    # What does collide at the start is a failure; what may change the start is not left out.
    pushed, back = TrialScore(plant, solution, [ForceNoise((0.13, 0.0, 0.0))]), np.full((1, trials.size), -50.0)
    assert pushed.first > 0
    assert pushed.rollout(back, frames=False).obstacles == ("dock",)
    assert pushed(back)[0] > 0
    for kind in (InitialStateError((0.01, 0.01, 0.0, 0.0)), DisplacedObstacles(0.01)):
        assert TrialScore(plant, solution, [kind]).first == 0
    assert docked_far(plant, solution, tmp_path) == 0


def docked_far(plant: ls.Plant, solution: ls.Solution, folder: Path) -> int:
    """The first knot that counts if the pillar is the nearest obstacle, and if nothing is random."""
    far, plan = docked(0.4, folder)
    fixed = TrialScore(plant, solution, [Push((0.01, 0.0, 0.0), at=1.0)])
    return TrialScore(far, plan, [ForceNoise(0.1)]).first + fixed.first


def test_the_probability_of_a_start_beside_an_obstacle(tmp_path: Path) -> None:
    """Against 30,000 plain trials of the equations of motion in NumPy, within four standard errors of the two.

    MuJoCo's Euler step is implicit in the damping: (m + h d) / h (v' - v) = f - d v, x' = x + h v'.
    """
    plant, solution = docked(0.02, tmp_path)
    force, h, rng = 0.15, 0.025, np.random.default_rng(4)
    x, hit = np.tile([-1.0, 0.0, 0.0, 0.0], (30_000, 1)), np.zeros(30_000, dtype=bool)
    for gain, offset in zip(solution.policy.gain, solution.policy.offset, strict=True):
        control = np.clip(x @ gain.T + offset, -2, 2)
        control[:, 1] += force * rng.standard_normal(len(x))
        for _ in range(4):
            v = x[:, 2:] + h * (control - 0.2 * x[:, 2:]) / (0.5 + h * 0.2)
            x = np.hstack([x[:, :2] + h * v, v])
            hit |= np.hypot(x[:, 0] - 0.6, x[:, 1] + 0.4) < 0.25
    p, n = hit.mean(), len(hit)
    assert 2e-4 < p < 2e-3
    trials = TrialScore(plant, solution, [ForceNoise((0.0, force, 0.0))], threads=1)
    found = failure_probability(trials, trials.size, particles=60, moves=2, repetitions=4, seed=1)
    assert abs(found.probability.value - p) < 4 * np.hypot(found.standard_error, np.sqrt(p / n))
    assert set(trials.rollout(found.failures, frames=False).obstacles) == {"pillar"}


@pytest.mark.long
def test_a_quadrotor_against_plain_monte_carlo(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Wind in which 1 to 2 % of the trials collide: the two agree within four standard errors of their difference."""
    trials = TrialScore(quadrotor.plant(), quadrotor_solution, [ForceNoise(0.19)])
    rng = np.random.default_rng(8)
    plain = trials(rng.standard_normal((1000, trials.size))) > 0
    expected = rate(int(plain.sum()), len(plain))
    assert 0.002 < expected.value < 0.03
    found = failure_probability(trials, trials.size, particles=100, moves=2, keep=0.25, repetitions=4, seed=2)
    error = np.hypot(found.standard_error, np.sqrt(expected.value * (1 - expected.value) / len(plain)))
    assert abs(found.probability.value - expected.value) < 4 * error
    assert found.standard_error < expected.value
    # The numbers of a failure are all that is needed to see it again.
    again = trials.rollout(found.failures[:1], frames=False)
    assert again.outcome == ("collided",)


@pytest.mark.parametrize("obstacles", [0, 3])
@pytest.mark.parametrize("goal", ["m", "of the way"])
@pytest.mark.parametrize("failure", ["collision", "miss"])
def test_levels_have_a_unit_where_all_scores_have_one(
    failure: Any, goal: str, obstacles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A miss of a goal without a position, among obstacles, may be metres from a collision or a share of the way."""
    if failure == "collision" and not obstacles:
        return  # is refused
    score = Mock(solution=Mock(target=Mock(unit=goal)))
    score.plant.world = range(obstacles)
    monkeypatch.setattr(ReliabilityProblem, "score", score)
    monkeypatch.setattr(ReliabilityProblem, "summary", lambda self: "")
    lines = list[str]()
    tell = ReliabilityProblem("quadrotor", failure=failure)._begin(lines.append)
    assert tell is not None
    tell(-0.5)
    units = {"m"} if failure == "collision" else {goal} | ({"m"} if obstacles else set())
    assert lines[1:] == [f"level: 0.5 {units.pop() + ' ' if len(units) == 1 else ''}from failing"]


@pytest.mark.parametrize("seed", range(3))
def test_progress_is_told_from_the_beginning_to_the_result(seed: int) -> None:
    """Before anything is done, after each part, and at last with what is returned."""
    told: list[tuple[int, int, str]] = []

    def note(done: int, of: int, found: str) -> None:
        told.append((done, of, found))

    rare = failure_probability(along(3, 2.0), 3, repetitions=5, particles=200, seed=seed, progress=note)
    assert [one[:2] for one in told] == [(done, 5) for done in range(6)]
    assert (told[0][2], told[-1][2]) == ("", f"{rare.probability.value:.2g}")
    for done, _, found in told[1:]:  # the mean of what is done
        assert float(found) == pytest.approx(rare.repetitions[:done].mean(), rel=0.06)
    told.clear()
    nearest = smallest_failure(along(3, 2.0), 3, rounds=6, seed=seed, progress=note)
    assert told[0][:2] == (0, 6)
    assert [one[0] for one in told] == list(range(len(told)))
    distances = [float(found.removeprefix("distance ")) for _, _, found in told]
    assert distances == pytest.approx(nearest.history[: len(told)], rel=0.01)
    assert distances[-1] == pytest.approx(nearest.distance, rel=0.01)

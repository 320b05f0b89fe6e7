"""Rare failures: trials as functions of numbers, and probabilities by splitting against what is known exactly."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sampling import rarely
from scipy import stats

import lqrsim as ls
from lqrsim.disturbances import Disturbance, ForceNoise, MeasurementNoise, Push
from lqrsim.simulation.disturbances import preset
from lqrsim.stress.multilevel_splitting import NoFailure, failure_probability
from lqrsim.stress.statistics import rate
from lqrsim.stress.trial_score import PrescribedDraws, TrialScore, collision_score, miss_score


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


def test_sizes_are_those_of_numpy() -> None:
    numpy = np.random.default_rng(0)
    draws: Any = PrescribedDraws(np.random.default_rng(1).standard_normal(100))
    for name, arguments in (
        ("standard_normal", {}), ("standard_normal", {"size": (2, 3)}), ("random", {}), ("random", {"size": 4}),
        ("normal", {"loc": [0.0, 1.0]}), ("normal", {"scale": 2.0}), ("uniform", {"low": [0.0, 1.0], "high": 2.0}),
        ("integers", {"low": 4}), ("integers", {"low": 1, "high": 3, "size": 5}), ("choice", {"a": 3}),
        ("choice", {"a": [1.5, 2.5], "size": (2, 2)}), ("choice", {"a": 4, "size": 2, "replace": False}),
    ):  # fmt: skip
        assert np.shape(getattr(draws, name)(**arguments)) == np.shape(getattr(numpy, name)(**arguments)), name


def test_what_can_not_be_given_is_named() -> None:
    with pytest.raises(ls.InputError, match="draws by poisson"):
        PrescribedDraws(np.zeros(3)).poisson(2.0)
    with pytest.raises(ls.InputError, match="numbers: got 3"):
        PrescribedDraws(np.zeros(3)).standard_normal(4)


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
    assert trials.simulations == 3
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
    """Few particles and one move, where levels from the particles themselves would be off: 2,000 repetitions."""
    found = failure_probability(along(4, 3.5), 4, particles=40, moves=1, keep=0.25, repetitions=2000, seed=4)
    exact = stats.norm.sf(3.5)
    assert abs(found.probability.value - exact) < 4 * found.standard_error
    assert found.standard_error < 0.05 * exact


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: failure_probability(along(2, 1), 0), "size: got 0"),
        (lambda: failure_probability(along(2, 1), 2, particles=3), "particles: got 3"),
        (lambda: failure_probability(along(2, 1), 2, keep=0.9), "keep: got 0.9"),
        (lambda: failure_probability(along(2, 1), 2, keep=-0.1), "keep: got -0.1"),
        (lambda: failure_probability(along(2, 1), 2, particles=20, keep=0.09), "keep: got 0.09, want .* >= 0.1"),
        (lambda: failure_probability(along(2, 1), 2, repetitions=1), "repetitions: got 1"),
        (lambda: failure_probability(lambda z: np.full(len(z), np.nan), 2), "score: got NaN returned"),
        (
            lambda: failure_probability(lambda z: np.minimum(z[:, 0], 1.0) - 2.0, 2),
            "score: got no failure in .* levels up to -1",
        ),
    ],
)
def test_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        call()

"""The nearest failure, where it is known, and what it is in newtons and seconds."""

import numpy as np
import pytest
from sampling import examples
from scipy import stats

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, ForceNoise, Push
from lqrsim.stress.failure_search import TrialScore, largest_effects
from lqrsim.stress.reliability import smallest_failure

UNITS = 1.0, 2.0**20, 2.0**-20  # powers of two, which round nothing


@pytest.mark.parametrize("size", [2, 50])
def test_beyond_a_plane_the_nearest_failure_and_its_estimate_are_exact(size: int) -> None:
    """4 away, straight at the plane; within 1 %, of which the estimate is 16 %, for it falls by 4 % for each 0.01."""
    normal = np.random.default_rng(size).standard_normal(size)
    normal /= np.linalg.norm(normal)
    found = smallest_failure(lambda z: z @ normal - 4.0, size, seed=1)
    assert 4.0 < found.distance < 4.04
    assert normal @ found.numbers / found.distance > 0.99
    assert found.first_order_probability == pytest.approx(stats.norm.sf(4.0), rel=0.16)
    assert found.first_order_probability == pytest.approx(stats.norm.sf(found.distance), rel=1e-9)


@pytest.mark.parametrize("passing", [-1.0, -np.inf])
@pytest.mark.parametrize("failing", [1.0, np.inf])
@pytest.mark.parametrize("seed", range(3))
def test_scores_without_a_slope_may_be_infinite(passing: float, failing: float, seed: int) -> None:
    """As of a robot without obstacles that diverges, or a score that only says whether a trial fails."""
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal(10)
    normal /= np.linalg.norm(normal)
    failures = 5 * normal + rng.standard_normal((20, 10))
    found = smallest_failure(lambda z: np.where(z @ normal > 2.5, failing, passing), 10, failures=failures, seed=seed)
    assert found.converged
    assert 2.5 < found.distance < 2.53


@pytest.mark.parametrize("seed", range(examples(20)))
def test_the_unit_of_scores_does_not_matter(seed: int) -> None:
    """Also where some are infinite, as of trials that diverge."""
    rng = np.random.default_rng(seed)
    size, limit, infinite = int(rng.integers(2, 12)), rng.uniform(1.5, 3), rng.uniform(0.1, 1)
    normal, curved = rng.standard_normal(size), 0.02 * rng.standard_normal((size, size))
    normal /= np.linalg.norm(normal)

    def score(z: np.ndarray) -> np.ndarray:
        depth = z @ normal - limit + np.einsum("ki,ij,kj->k", z, curved, z)
        return np.where((depth > infinite) | (z[:, 0] > 2.2), np.inf, depth)

    found, *others = (smallest_failure(lambda z, unit=unit: unit * score(z), size, seed=seed) for unit in UNITS)
    for other in others:
        np.testing.assert_array_equal(other.numbers, found.numbers)
        assert (other.converged, other.simulations) == (found.converged, found.simulations)


def test_many_numbers_take_longer_but_get_there() -> None:
    """Of 500 numbers, random failures are 22 away; what they have in common is 4."""
    normal = np.full(500, 1 / np.sqrt(500))
    found = smallest_failure(lambda z: z @ normal - 4.0, 500, rounds=40)
    assert found.distance < 4.2
    assert (np.diff(found.history) <= 0).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_it_goes_on_until_little_is_left(seed: int) -> None:
    """It says how much is left, whenever it is stopped: to a fifth of that, for it is of noise; and ends at 1 %."""
    normal = np.full(200, 1 / np.sqrt(200))

    def score(z: np.ndarray) -> np.ndarray:
        return z @ normal - 4.0

    stopped = smallest_failure(score, 200, rounds=8, seed=seed)
    assert not stopped.converged
    assert stopped.remaining > 0.02
    assert 1 - 4.0 / stopped.distance == pytest.approx(stopped.remaining, rel=0.2)
    found = smallest_failure(score, 200, rounds=100, seed=seed)
    assert found.converged
    assert 4.0 < found.distance < 4.0 * 1.013
    assert len(found.history) > 20


def test_the_nearer_of_two_ways_to_fail_is_found() -> None:
    """The farther one is a quarter as frequent, so that random failures are of both."""
    found = smallest_failure(lambda z: np.maximum(z[:, 0] - 3.0, -z[:, 1] - 3.4), 10)
    assert 3.0 < found.distance < 3.03
    assert found.numbers[0] == pytest.approx(3.0, abs=0.03)


def test_a_curved_boundary() -> None:
    """Of |z|^2 with z0 = 3 - 0.1 r^2 the least is at r = 0: its slope over r^2 there is 1 - 0.6."""
    found = smallest_failure(lambda z: z[:, 0] - 3.0 + 0.1 * (z[:, 1:] ** 2).sum(axis=1), 6)
    assert 3.0 < found.distance < 3.03


def test_infinite_scores_are_failures_like_others() -> None:
    found = smallest_failure(lambda z: np.where(z[:, 0] > 3.0, np.inf, z[:, 0] - 3.5), 4)
    assert 3.0 < found.distance < 3.1
    assert found.score == np.inf


def test_what_it_finds_fails_and_simulations_are_counted() -> None:
    asked = []

    def score(z: np.ndarray) -> np.ndarray:
        asked.append(len(z))
        return z[:, 0] - 2.0

    one, again = (smallest_failure(score, 3, failures=np.array([[4.0, 3.0, 0.0]]), seed=3) for _ in range(2))
    assert one.score == score(one.numbers[None])[0] > 0
    assert one.simulations + again.simulations == sum(asked) - 1
    np.testing.assert_array_equal(one.numbers, again.numbers)


@pytest.mark.long
def test_a_quadrotor_is_broken_by_less_than_what_broke_it(
    quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """Gusts that break it need an eighth of a random failure's size, if they all push in the right direction."""
    trials = TrialScore(quadrotor.plant(), quadrotor_solution, [ForceNoise(0.2)])
    drawn = 1.5 * np.random.default_rng(1).standard_normal((200, trials.size))
    failures = drawn[trials(drawn) > 0]
    assert len(failures) > 5
    found = smallest_failure(trials, trials.size, failures=failures, rounds=3, pairs=50)
    assert found.distance < 0.5 * np.linalg.norm(failures, axis=1).min()
    rollout = trials.rollout(found.numbers[None], frames=False)
    assert rollout.outcome == ("collided",)
    force, *others = largest_effects(rollout)
    assert (force.what, force.unit) == ("force", "N")
    assert not [one for one in others if "measured" in one.what]
    forces = np.linalg.norm(0.2 * found.numbers.reshape(-1, 3), axis=1)
    step = round(force.time / rollout.plan.dt)
    assert force.size == pytest.approx(forces[step])
    assert force.size <= forces.max() + 1e-12


def test_disturbances_in_physical_units(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    push = Push((0.0, 0.3, 0.4), at=2.0)
    force, *rest = largest_effects(
        ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[push, ControlNoise(0.01)], frames=False)
    )
    assert (force.size, force.time) == (pytest.approx(0.5 * 30), pytest.approx(2.0))
    assert [one.what for one in rest] == [f"error of rotor_{i} as applied" for i in (1, 2, 3, 4)]
    assert all(one.unit == "N" and 0.01 < one.size < 0.05 for one in rest)

"""Funnels: against the closed form of a linear system's region of success, and how runs begin on the way."""

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import strategies as st
from matplotlib.figure import Figure
from pucks import RADIUS, STEPS, Puck, left, plant, solution
from sampling import examples, rarely
from scipy import stats
from tracking import funnel_by_hand

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.disturbances import (
    ControlDelay,
    ControlNoise,
    Disturbance,
    Dryden,
    ForceNoise,
    Gusts,
    InitialStateError,
    MassMismatch,
    MeanWind,
    MeasurementNoise,
    Push,
    Saturation,
)
from lqrsim.errors import InputError
from lqrsim.simulation.closed_loop import simulate_from
from lqrsim.stress import funnels
from lqrsim.stress.funnels import (
    BATCH,
    PILOT_ACCURACY,
    FoundLevel,
    LevelTest,
    find_level,
    lowest_rate,
    points_of,
    run_test,
    smallest_test,
)
from lqrsim.stress.statistics import rate as rate_of
from lqrsim.view import plots

ice: Any = pytest.fixture(scope="module")(lambda tmp_path_factory: plant(tmp_path_factory.mktemp("ice")))
PLAN = solution()
COARSE: dict[str, Any] = {"rate": 0.8, "confidence": 0.9, "failures": 20}


@dataclass(frozen=True)
class Sail(Puck):
    """The puck, in the wind."""

    drag: float = 0.5


def reach(knot: int) -> float:
    """How far off in x or y a run may begin at a knot, with the plan's velocity, to end at the goal, in m."""
    return RADIUS / abs(left(knot)[0, 0])


@pytest.mark.parametrize(("states", "power"), [(("x", "y"), 2), *rarely((("x",), 1))])
def test_levels_of_a_linear_system(ice: ls.Plant, states: tuple[str, ...], power: int) -> None:
    """Runs succeed from an interval or a disc, which is a known share of a larger one.

    Level 1 is 1 m. What is certified has at least the rate: the interval is wrong in 1 of 10, for this seed it is not.
    The largest such level is (1/rate)^(1/d) of the disc's radius, and a fifth less is found at worst.
    """
    found = ls.funnel(ice, PLAN, knots=(0, 8, 15), states=states, seed=3, **COARSE)
    assert found.states == states
    assert found.knots.tolist() == [0, 8, 15]
    for knot, level in zip((0, 8, 15), found.levels, strict=True):
        share = min(1.0, (reach(knot) / level) ** power)
        assert share >= 0.8
        assert 0.8 * reach(knot) * 0.8 ** (-1 / power) < level
    checks = ls.stress.check_funnel(found, ice, PLAN, trials=2000)
    outside = ls.stress.check_funnel(found, ice, PLAN, trials=2000, between=(1.0, 1.3))
    for knot, level, inside, more in zip((0, 8, 15), found.levels, checks, outside, strict=True):
        share, wider = (min(1.0, (reach(knot) / (much * level)) ** power) for much in (1.0, 1.3))
        assert stats.binomtest(int(inside.successes.sum()), 2000, share).pvalue > 1e-3
        shell = max(wider * 1.3**power - share, 0.0) / (1.3**power - 1)
        assert more.successes.mean() == pytest.approx(shell, abs=0.04)  # 3.6 standard deviations at worst
        assert inside.reached.low <= share <= inside.reached.high


def test_what_is_in_the_way_counts(tmp_path: Path) -> None:
    """A wall cuts a segment off the disc of the positions that the goal can be reached from.

    Nothing overshoots before the goal, so that a run collides if it begins in the wall.
    """
    walled = plant(tmp_path, wall=RADIUS + 0.05)  # which its surface reaches if it is 5 cm off
    found = ls.funnel(walled, PLAN, knots=(0,), states=("x", "y"), seed=3, **COARSE)
    level = found.levels[0]
    assert level < reach(0)
    cap = np.arccos(min(0.05 / level, 1.0))
    share = 1 - (cap - np.sin(cap) * np.cos(cap)) / np.pi
    assert share >= 0.8
    check = ls.stress.check_funnel(found, walled, PLAN, trials=2000)[0]
    assert stats.binomtest(int(check.successes.sum()), 2000, share).pvalue > 1e-3
    assert share < 0.9  # it was not stopped far too early


def test_contains(ice: ls.Plant) -> None:
    found = ls.funnel(ice, PLAN, knots=(0, 10), states=("x", "y"), seed=1, **COARSE)
    first, second = found.levels
    assert found.contains([[0.999 * first, 0, 9, 9], [0, 1.001 * first, 0, 0]], 0.0).tolist() == [True, False]
    assert found.level(0.5) == pytest.approx((first + second) / 2)
    assert found.level(1.9) == second
    assert found.deviation([0.3, 0.4, 5, 5], 0.7) == pytest.approx(0.5)
    assert found.deviation([0.3, 0.4, 5, 5], 0.7, about=[0.3, 0, 0, 0]) == pytest.approx(0.4)
    begun = np.array([[0.9 * first, 0, 0, 0], [1.1 * first, 0, 0, 0]])
    run = simulate_from(ice, PLAN, begun)
    assert found.left_at(run)[1] == 0.0
    inside = np.hypot(run.states[0, :, 0], run.states[0, :, 1]) <= [found.level(t) for t in found.plan.times]
    assert found.left_at(run)[0] == (np.inf if inside.all() else 0.1 * np.argmin(inside))
    assert f"{found.successes[0]} of {found.trials[0]} fresh" in found.summary()


def test_what_does_not_act_is_not_listed(ice: ls.Plant) -> None:
    """The command takes an error of the start out of a set by scaling it to zero; the others keep their numbers."""
    given = [ForceNoise(0.02), InitialStateError(0.1).scaled(0.0), ControlNoise(0.01)]
    found = ls.funnel(ice, PLAN, disturbances=given, knots=(0,), largest=0.01, **COARSE)
    assert found.disturbances == tuple(given[i].describe(ice) for i in (0, 2))


def test_from_nowhere(ice: ls.Plant) -> None:
    """A goal that the plan misses: level 0, with the reason; and a largest level that all succeed from."""
    lost = replace(PLAN, goal=np.array([1.0, 0, 0, 0]))
    found = ls.funnel(ice, lost, knots=(0,), **COARSE)
    assert found.levels.tolist() == [0.0]
    assert found.trials.tolist() == [0]
    assert "even when they begin on the plan" in found.reasons[0]
    assert not found.contains(np.zeros(4), 0.0)
    assert ls.stress.check_funnel(found, ice, lost) == ()
    small = ls.funnel(ice, PLAN, knots=(0,), largest=0.01, **COARSE)
    assert small.levels.tolist() == [0.01]
    assert small.reasons == ("levels beyond 0.01 were not tried",)


def test_the_same_again_and_in_a_file(ice: ls.Plant, tmp_path: Path) -> None:
    options: dict[str, Any] = {"disturbances": [ForceNoise(0.02)], "knots": (0, 3), "seed": 4, **COARSE}
    told: list[tuple[int, int, str]] = []
    found = ls.funnel(ice, PLAN, progress=lambda *one: told.append(one), **options)
    assert {one[:2] for one in told[:-1]} == {(0, 2), (1, 2)}  # while it looks, too
    assert told[-1] == (2, 2, f"level {found.levels[1]:.3g} at knot 3; {found.simulated:,} trials")
    again = ls.funnel(ice, PLAN, threads=1, **options)
    assert found.digest == again.digest
    options["seed"] = 5
    assert found.digest != ls.funnel(ice, PLAN, **options).digest
    read = ls.load(ls.save(found, tmp_path / "funnel.npz"), ls.types.Funnel)
    assert read.digest == found.digest
    for name in ("states", "family", "reasons", "rate", "confidence", "simulated", "seed", "options", "disturbances"):
        assert getattr(read, name) == getattr(found, name), name
    assert read.trials.tolist() == found.trials.tolist()
    assert read.summary() == found.summary()
    with pytest.raises(InputError, match="want a 'lqrsim funnel'"):
        ls.load(ls.save(PLAN, tmp_path / "solution.npz"), ls.types.Funnel)


@pytest.mark.parametrize("trials", [3, 40, 5000])
def test_a_check_is_shown_by_its_counts_and_not_by_its_trials(trials: int) -> None:
    successes = np.arange(trials) % 3 > 0
    reached = rate_of(int(successes.sum()), trials)
    check = ls.stress.FunnelCheck(4, 0.25, reached, successes)
    assert str(check).startswith(f"knot 4, level 0.25: {sum(successes.tolist())} of {trials} new trials succeed, ")
    assert f"{reached.low:.3g}, {reached.high:.3g}" in str(check)
    for text in (str(check), repr((check,))):
        assert "True" not in text
        assert len(text) < 200


@hypothesis.given(st.integers(1, 3 * BATCH), st.data())
def test_a_level_is_tested_by_trials_of_its_own(trials: int, data: st.DataObject) -> None:
    """In order, once each, none of the pilot's; to the end of the batch in which too many have failed."""
    allowed, bad = data.draw(st.integers(0, 3)), data.draw(st.sets(st.integers(0, trials - 1), max_size=6))
    ran: list[int] = []

    def runs(level: float, numbers: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        assert len(numbers) <= BATCH
        ran.extend(numbers.tolist())
        return ~np.isin(numbers, [trials + number for number in bad])

    failed, done = run_test(runs, 1.0, LevelTest(trials, allowed))
    assert ran == list(range(trials, trials + done))
    assert failed == sum(number < done for number in bad)
    last = sorted(bad)[allowed] if len(bad) > allowed else trials - 1
    assert done == min(trials, (last // BATCH + 1) * BATCH)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"rate": 1.0}, "rate: got 1.0"),
        ({"confidence": 0.2}, "confidence: got 0.2"),
        ({"knots": (STEPS,)}, f"want some of 0 to {STEPS - 1}"),
        ({"knots": ()}, "knots"),
        ({"states": ("z",)}, "states: got 'z'"),
        ({"states": ("x", "x")}, "want different names"),
        ({"shape": np.eye(3)}, "shape"),
        ({"shape": np.diag([1.0, 1, 1, 0])}, "flat at knot 0"),
        ({"largest": 0.0}, "largest"),
        ({"failures": -1}, "failures"),
        ({"rate": 0.99999, "confidence": 0.999, "failures": 100}, "needs more than"),
        ({"seed": -1}, "seed"),
        ({"disturbances": [3]}, "disturbances"),
        ({"disturbances": [InitialStateError(5.0)]}, "got InitialStateError, which changes the start"),
        (
            {"disturbances": [ForceNoise(0.1), InitialStateError(1e-9)], "knots": (5,)},
            "got InitialStateError, which changes the start",
        ),
        ({"controller": 3}, "controller"),
        ({"progress": 3}, "progress"),
        ({"plant": 3}, "plant"),
        ({"solution": replace(PLAN, cost_to_go=None)}, "shape: got none and no cost-to-go"),
    ],
)
def test_refused(ice: ls.Plant, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as caught:
        ls.funnel(**({"plant": ice, "solution": PLAN} | wrong))
    assert said in str(caught.value)


@pytest.mark.parametrize("strength", [5.0, 1e-9])
def test_a_funnel_is_not_checked_under_disturbances_that_change_the_start(ice: ls.Plant, strength: float) -> None:
    found = funnel_by_hand(PLAN, np.eye(4), knots=(0,), levels=(0.1,))
    given = [ForceNoise(0.1), InitialStateError(strength)]
    with pytest.raises(InputError, match="got InitialStateError, which changes the start"):
        ls.stress.check_funnel(found, ice, PLAN, disturbances=given)


@hypothesis.given(st.integers(0, 2**32 - 1), st.booleans())
@hypothesis.settings(max_examples=examples(40))
def test_rotated_covariances_are_symmetric_up_to_rounding(seed: int, at_each_knot: bool) -> None:
    """U diag(w) U' of equal variances has entries beside its diagonal that are rounding alone."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(4, 4)))
    covariance = rotation @ np.diag(np.full(4, 3.0)) @ rotation.T
    given = np.tile(covariance, (STEPS + 1, 1, 1)) if at_each_knot else covariance
    found = funnels._shapes(PLAN, given, [0, 2])
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
    np.testing.assert_allclose(found, np.tile(3.0 * np.eye(2), (STEPS + 1, 1, 1)), rtol=0, atol=1e-14)
    given = covariance + 1e-8 * np.eye(4, k=1)
    with pytest.raises(InputError, match=r"shape: got 1e-08 at .* and .*, want a symmetric matrix"):
        funnels._shapes(PLAN, given, [0, 2])


WHOLE = st.fixed_dictionaries(
    {},
    optional={
        "rate": st.sampled_from([0.5, 0.9, 0.0, 2.0, None]),
        "confidence": st.sampled_from([0.5, 0.9, 0.1, "x"]),
        "knots": st.sampled_from([(0,), (5, 2), (2, 2), (99,), (-1,), "ab", 3]),
        "states": st.sampled_from([("x",), ("vy", "x"), "x", ("x", 3), ()]),
        "shape": st.sampled_from([np.eye(4), np.full((4, 4), np.nan), np.eye(4)[:3], -np.eye(4), "x"]),
        "largest": st.sampled_from([1e-9, 1e300, np.inf, None, -1]),
        "failures": st.sampled_from([0, 4, 1.5]),
        "goal_radius": st.sampled_from([0.05, 1e9, 0.0]),
        "seed": st.sampled_from([0, 2**40, 1.5]),
    },
)


@hypothesis.given(WHOLE)
@hypothesis.settings(max_examples=examples(40))
def test_whole_inputs(given: dict[str, Any]) -> None:
    """Whatever is asked for, it is refused in one line, or the funnel is whole: what it says of itself holds."""
    here = whole_inputs_plant()
    found, refused = None, ""
    try:
        found = ls.funnel(here, PLAN, **({"rate": 0.5, "confidence": 0.6, "knots": (3,), "failures": 2} | given))
    except InputError as error:
        refused = str(error)
    if found is None:
        assert len(refused.splitlines()) == 1
        return
    held = found.levels > 0
    assert ((found.trials > 0) == held).all()
    confidence = 1 - (1 - found.confidence) / len(found.knots)
    for successes, trials in zip(found.successes[held], found.trials[held], strict=True):
        assert lowest_rate(int(successes), int(trials), confidence) >= found.rate
    for knot, level in zip(found.knots[held], found.levels[held], strict=True):
        edge = found.states_at(int(knot), np.eye(len(found.states))[0], level)
        assert found.deviation(edge, 0.1 * knot) == pytest.approx(level)
    assert all(bool(reason) for reason, one in zip(found.reasons, held, strict=True) if not one)


def whole_inputs_plant(made: list[ls.Plant] = []) -> ls.Plant:  # noqa: B006  made once
    if not made:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            made.append(plant(Path(folder)))
    return made[0]


class TestLevels:
    """How a level is found, where the share of successes at each level is known."""

    @staticmethod
    def runs(rate_of: Callable[[float], float], seed: int) -> Callable[[float, Any], Any]:
        """Trials that each succeed up to a level of their own; the share that does so at each is `rate_of`."""

        def run(level: float, numbers: Any) -> Any:
            drawn = np.array([np.random.default_rng([seed, number]).random() for number in numbers])
            return drawn < rate_of(level)

        return run

    def find(self, rate_of: Callable[[float], float], seed: int = 0, **options: Any) -> FoundLevel:
        rate, test = 0.9, smallest_test(0.9, 0.95, 5)
        return find_level(self.runs(rate_of, seed), test, **({"guess": 1.0, "largest": 100.0, "rate": rate} | options))

    def test_the_test_is_the_smallest(self) -> None:
        """Its trials are the fewest that show the rate: by the binomial distribution itself."""
        many = [(1 - 1e-5, 0.95, 3), (1 - 4e-6, 0.95, 0), (1 - 1.05e-5, 0.9, 5)]  # almost as many as are allowed
        for rate, confidence, failures in [(0.9, 0.95, 5), (0.99, 0.99, 0), (0.5, 0.6, 3), *many]:
            test = smallest_test(rate, confidence, failures)
            assert stats.binom.cdf(failures, test.trials, 1 - rate) <= 1 - confidence
            assert stats.binom.cdf(failures, test.trials - 1, 1 - rate) > 1 - confidence

    def test_it_comes_near(self) -> None:
        """The pilot is within its own step of where as many of the trials fail as it aims at."""
        found = self.find(lambda level: 1 / (1 + (level / 20) ** 4), seed=2)
        test = smallest_test(0.9, 0.95, 5)
        drawn = np.sort([np.random.default_rng([2, number]).random() for number in range(test.trials)])
        edge = 20 * (1 / drawn[test.trials - test.pilot_failures - 1] - 1) ** 0.25  # where one more than that fails
        assert edge / PILOT_ACCURACY <= found.pilot <= edge
        assert found.level in (0.7 * found.pilot, 0.9 * found.pilot, found.pilot)

    def test_no_level(self) -> None:
        assert "begin on the plan" in self.find(lambda level: 0.5).reason
        assert "down to the smallest" in self.find(lambda level: 1.0 if level == 0 else 0.5).reason
        capped = self.find(lambda level: 1.0, largest=7.0)
        assert (capped.level, capped.reason) == (7.0, "levels beyond 7 were not tried")

    def test_few_are_run_again(self) -> None:
        """A pilot and three tests, and few more."""
        test = smallest_test(0.99, 0.99, 3)
        found = find_level(
            self.runs(lambda level: 1 / (1 + (level / 20) ** 12), 1), test, guess=1.0, largest=1e3, rate=0.99
        )
        assert found.simulated < 4.6 * test.trials


class TestBegunLater:
    """A run from a knot, in the state that another has there, goes on as that one."""

    @pytest.mark.parametrize("knot", [0, 1, 9])
    def test_goes_on_as_the_whole(self, ice: ls.Plant, knot: int) -> None:
        """Forces, controls, measurements, delays and noise on states, each of its own stream; to rounding."""
        noise = ls.Noise(lambda x, u, p: [[0.0], [0.0], [0.01 + 0.01 * x[0]], [0.01]], size=1)
        wrong = [
            ControlNoise(0.1),
            ForceNoise(0.05),
            MeasurementNoise(0.01),
            noise,
        ]
        whole = ls.simulate(ice, PLAN, disturbances=wrong, trials=4, seed=7)
        rest = simulate_from(ice, PLAN, whole.states[:, knot], knot=knot, disturbances=wrong, seed=7)
        assert rest.plan.steps == STEPS - knot
        np.testing.assert_allclose(rest.states, whole.states[:, knot:], rtol=0, atol=1e-12)
        np.testing.assert_allclose(rest.applied, whole.applied[:, knot:], rtol=0, atol=1e-12)
        assert (np.abs(whole.states[:, knot:]).max(axis=(1, 2)) > 1e-3).all()

    @pytest.mark.parametrize(
        "one",
        [
            MeanWind((0.2, 0.1, 0.0)), Gusts(0.5), Dryden("light"), Push((0.3, 0.0, 0.0), at=1.2),
            MassMismatch(0.05), Saturation(lowest=-0.01, highest=0.01), ForceNoise(0.05),
        ],
        ids=lambda one: type(one).__name__,
    )  # fmt: skip
    def test_what_happens_at_a_time_happens_then(self, ice: ls.Plant, one: Disturbance) -> None:
        """Each kind without a memory of its own, alone, goes on as in the whole run: to rounding."""
        sail = ls.Plant(Sail(), ice.scene)
        whole = ls.simulate(sail, PLAN, disturbances=[ForceNoise(0.1), one], trials=3, seed=7)
        rest = simulate_from(sail, PLAN, whole.states[:, 9], knot=9, disturbances=[ForceNoise(0.1), one], seed=7)
        np.testing.assert_allclose(rest.states, whole.states[:, 9:], rtol=0, atol=1e-12)
        without = ls.simulate(sail, PLAN, disturbances=[ForceNoise(0.1)], trials=3, seed=7)
        assert np.abs(whole.states[:, 9:] - without.states[:, 9:]).max() > 1e-4

    def test_a_delay_has_its_past(self, ice: ls.Plant) -> None:
        """Controls that are on their way at the knot are the plan's, and not those of the deviation."""
        run = simulate_from(ice, PLAN, np.tile([0.1, 0, 0, 0], (1, 1)), knot=5, disturbances=[ControlDelay(2)])
        assert run.applied[0, :2] == pytest.approx(np.zeros((2, 2)))
        assert run.applied[0, 2, 0] == pytest.approx(-0.03)

    @pytest.mark.parametrize("raises_at", [0, 3, 5, 8])
    def test_a_controller_that_raises_on_the_way_has_failed(self, ice: ls.Plant, raises_at: int) -> None:
        def controller(state: np.ndarray, t: float) -> np.ndarray:
            if round(t / PLAN.trajectory.dt) == raises_at:
                raise KeyError("lost")
            return np.zeros(2)

        run = simulate_from(ice, PLAN, np.tile([0.1, 0, 0, 0], (2, 1)), knot=5, controller=controller)
        assert run.outcome == ("error", "error")
        assert all("KeyError: 'lost'" in reason for reason in run.reasons)
        assert (run.failed_at == max(raises_at - 5, 0) * PLAN.trajectory.dt).all()

    def test_points_fill_a_ball(self) -> None:
        """Radii to the power of the dimension are uniform, and each trial has its own point."""
        points = points_of(np.arange(500), 3, 4)
        assert stats.kstest(np.linalg.norm(points, axis=1) ** 4, "uniform").pvalue > 1e-3
        assert np.array_equal(points[[7, 3]], points_of(np.array([7, 3]), 3, 4))
        shell = np.linalg.norm(points_of(np.arange(200), 3, 4, (1.0, 1.3)), axis=1)
        assert shell.min() >= 1.0
        assert shell.max() <= 1.3


@pytest.fixture(scope="module")
def funnel(quadrotor_solution: ls.Solution) -> ls.types.Funnel:
    """About the packaged quadrotor's plan, of level 1 throughout, which nothing has certified."""
    found = ls.funnel(
        ls.scenarios.quadrotor().plant(), quadrotor_solution, knots=(0,), rate=0.5, confidence=0.5, failures=0,
        largest=0.1,
    )  # fmt: skip
    return replace(found, levels=np.array([1.0]))


def test_its_picture(funnel: ls.types.Funnel, tmp_path: Path) -> None:
    """The shadow on the position is as wide as the states on the boundary reach, in each direction."""
    rng = np.random.default_rng(0)
    points = rng.standard_normal((40_000, 12))
    points[:20_000, 3:] *= 0.1  # that some are near each edge of the shadow
    points /= np.linalg.norm(points, axis=1)[:, None]
    off = funnel.states_at(30, points, 1.0)[:, :3] - funnel.plan.states[30, :3]
    for direction in np.eye(3):
        reached = (off @ direction).max() / np.sqrt(direction @ funnel.position_covariance[30] @ direction)
        assert 0.85 < reached <= 1 + 1e-12
    scenario = ls.scenarios.quadrotor()
    options: dict[str, Any] = {"world": scenario.scene.world, "radius": scenario.robot.radius}
    assert ls.view.plot_funnel(funnel, tmp_path / "funnel.png", **options).stat().st_size > 10_000
    some = replace(funnel, states=("x", "y"), shape=funnel.shape[:, :2, :2])
    with pytest.raises(InputError, match="want the position among them"):
        ls.view.plot_funnel(some, tmp_path / "funnel.png", **options)


@pytest.mark.parametrize("level", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("knot", [0, 140])
def test_its_picture_shows_all_places_from_which_runs_are_certified(
    funnel: ls.types.Funnel, level: float, knot: int
) -> None:
    """States on its boundary are within the axes, from above and from the side."""
    one = replace(funnel, knots=np.array([knot]), levels=np.array([level]))
    rng = np.random.default_rng(1)
    points = rng.standard_normal((3000, 12)) * rng.choice([0.1, 1.0], (3000, 12))
    points /= np.linalg.norm(points, axis=1)[:, None]
    places = one.states_at(knot, points, level)[:, :3]
    views, figure = plots.funnel_views(one, ls.World(), 0.3), Figure()
    grid = figure.add_gridspec(1, 2)
    for plane, axes in zip(views.planes, views.draw(figure, [grid[0], grid[1]]), strict=True):
        for i, (low, high) in zip(plane, (axes.get_xlim(), axes.get_ylim()), strict=True):
            assert low < places[:, i].min()
            assert places[:, i].max() < high


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--rate", "0.5", "--confidence", "0.6", "--failures", "1", "--knots", "140", "--disturbances", "calm"]
    assert main(["funnel", "quadrotor", *options, "--out", str(tmp_path)]) == 0
    found = ls.load(tmp_path / "funnel.npz", ls.types.Funnel)
    said = capsys.readouterr().out
    assert found.summary() in said
    assert found.knots.tolist() == [140]
    assert (tmp_path / "funnel.png").stat().st_size > 0
    assert main(["funnel", "quadrotor", *options, "--out", str(tmp_path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["wrote"] == [str(tmp_path / name) for name in ("funnel.npz", "funnel.png")]
    assert printed["funnel"]["rate"] == 0.5
    (knot,) = printed["funnel"]["knots"]
    assert (knot["knot"], knot["level"], knot["trials"]) == (140, found.levels[0], found.trials[0])
    assert knot["time"] == pytest.approx(140 / 30)
    assert main(["funnel", "quadrotor", "--knots", "150", "--out", str(tmp_path)]) == 2
    assert "want some of 0 to 149" in capsys.readouterr().err


@pytest.mark.parametrize(("shape", "drawn"), [({"radius": 0.25}, 0.25), ({"balls": None}, 0.0), ({"geoms": None}, 0.0)])
def test_its_picture_on_the_command_line_has_grey_places_of_one_ball_only(
    funnel: ls.types.Funnel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: dict[str, Any], drawn: float
) -> None:
    """As those of policies: around several balls or geoms they would be wrong."""
    seen: list[float] = []

    def plotted(*args: Any, radius: float, **options: Any) -> Path:
        seen.append(radius)
        return tmp_path / "funnel.png"

    monkeypatch.setattr(ls, "funnel", functools.wraps(ls.funnel)(lambda **options: funnel))
    monkeypatch.setattr(ls.view, "plot_funnel", plotted)
    monkeypatch.setattr(ls.stress.Study, "closed_loop", {})
    monkeypatch.setattr(ls.Quadrotor, "shape", shape)
    assert main(["funnel", "quadrotor", "--out", str(tmp_path)]) == 0
    assert seen == [drawn]


class TestReplannerWhenLeft:
    """`Replanner(when=funnel)` solves where a trial is outside, and only there."""

    def test_only_who_is_outside(
        self, quadrotor: ls.Scenario, quadrotor_solution: Any, funnel: ls.types.Funnel
    ) -> None:
        """Of runs that begin on and far off the plan, only the latter are solved for, at the first time they can be."""
        law = ls.Replanner(quadrotor.problem, quadrotor_solution, every=1.0, deadline=0.0, when=funnel)
        begun = funnel.states_at(0, np.eye(12)[[0, 0]], 1.0)
        begun[1] += 10 * (begun[1] - funnel.plan.states[0])
        begun[0] = funnel.plan.states[0]
        run = simulate_from(quadrotor.plant(), quadrotor_solution, begun, controller=law, frames=False)
        records = run.controller_run.log.records
        whole = funnel.deviation(run.measured[:, 30], 1.0)
        assert whole[0] < 1 < whole[1]
        assert {(one.step, one.trial) for one in records if one.step == 30} == {(30, 1)}
        assert all(one.trial == 1 for one in records)
        plain = ls.simulate(quadrotor.plant(), quadrotor_solution, frames=False)
        np.testing.assert_array_equal(run.commanded[0], plain.commanded[0])

    def test_a_funnel_without_levels_is_always_left(self, quadrotor: Any, quadrotor_solution: Any, funnel: Any) -> None:
        """Then it is what it is without: the same solves, and the same controls to the bit."""
        none = replace(funnel, levels=np.zeros(1), trials=np.zeros(1), successes=np.zeros(1), reasons=("none",))
        runs, laws = [], [
            ls.Replanner(quadrotor.problem, quadrotor_solution, every=1.5, when=when) for when in (None, none)
        ]  # fmt: skip
        for law in laws:
            runs.append(ls.simulate(quadrotor.plant(), quadrotor_solution, controller=law, trials=2, frames=False))
        np.testing.assert_array_equal(runs[0].commanded, runs[1].commanded)
        first, second = ([one.step for one in run.controller_run.log.records] for run in runs)
        assert first == second != []
        assert laws[0].digest != laws[1].digest

    def test_bad_input(self, quadrotor: Any, quadrotor_solution: Any, funnel: ls.types.Funnel) -> None:
        unchecked: Any = ls.Replanner
        moved = replace(funnel, plan=ls.Trajectory(funnel.plan.states + 1, funnel.plan.controls, funnel.plan.dt))
        for wrong, said in (
            ({"when": 3}, "when: got 3"),
            ({"when": moved}, "when: got a funnel of another plan"),
            ({"when": funnel, "horizon": "moving"}, 'want horizon="shrinking"'),
        ):
            with pytest.raises(InputError, match=said):
                unchecked(quadrotor.problem, quadrotor_solution, every=1.0, **wrong)


def test_the_safest_way(quadrotor: ls.Scenario) -> None:
    """It is the way that most of the same trials succeed by, counted again here; then new trials are run."""
    plant, gusts = quadrotor.plant(), [Gusts(0.5)]
    found = ls.stress.smooth_safest(quadrotor.problem, plant, gusts, trials=20, starts=4, seed=3)

    def counted(solution: ls.Solution, first: int) -> int:
        run = ls.simulate(plant, solution, disturbances=gusts, seed=3, trials=20, first_trial=first, frames=False)
        return run.outcome.count("reached")

    succeeded = [counted(way.solution, 0) for way in found.compared]
    assert succeeded == [int(way.successes.sum()) for way in found.compared]
    assert succeeded[0] > succeeded[-1]
    assert succeeded == sorted(succeeded, reverse=True)
    assert found.solution is found.compared[0].solution
    assert found.reached.value == counted(found.solution, 20) / 20
    cheapest = ls.smooth(quadrotor.problem, starts=4).cost
    assert min(one.solution.cost for one in found.compared) == pytest.approx(cheapest)
    for one, other in zip(found.compared, found.compared[1:], strict=False):
        assert np.abs(one.solution.trajectory.states - other.solution.trajectory.states).max() > 0.05
    with pytest.raises(InputError, match="trials: got 0"):
        ls.stress.smooth_safest(quadrotor.problem, plant, gusts, trials=0)

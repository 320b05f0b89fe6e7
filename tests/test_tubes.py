"""Predicted tubes: chances against SciPy and Monte Carlo, moments against a simulated linear loop, and effects."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from linear_plans import DT, Linear, double_integrator, linear
from sampling import examples
from scipy.integrate import quad
from scipy.stats import binomtest, multivariate_normal, norm
from tracking import by_hand

import lqrsim as ls
from lqrsim.control.controllers import Feedback
from lqrsim.control.plan_model import PlanDerivatives, PlanModel, recursions
from lqrsim.control.prediction import DeviationNorm, LinearLoop, SampledLoop, Surroundings, both_below, sample_loop
from lqrsim.disturbances import Uncertainty
from lqrsim.errors import Array
from lqrsim.kernels.records import LoopMoments
from lqrsim.problem.obstacles import KeepsClear, each_once


@hypothesis.given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-1, 1))
@hypothesis.example(0.0, 5e-324, 1.0)
@hypothesis.settings(max_examples=examples(150))
def test_both_below_is_the_bivariate_normal(a: float, b: float, correlation: float) -> None:
    """To 1e-9 of quadrature; beyond a correlation of 0.9999 that has no more digits: the limit is at most 1e-2 off."""
    found = float(both_below(np.array([a]), np.array([b]), np.array([correlation]))[0])
    if abs(correlation) > 0.9999:
        at_limit = norm.cdf(min(a, b)) if correlation > 0 else max(norm.cdf(a) - norm.cdf(-b), 0.0)
        assert found == pytest.approx(at_limit, abs=1e-2)
    else:
        expected = _bivariate(a, b, correlation)
        assert found == pytest.approx(expected, abs=1e-9)
    assert -1e-12 <= found <= min(norm.cdf(a), norm.cdf(b)) + 1e-12


def _bivariate(a: float, b: float, correlation: float) -> float:
    """P(x < a, y < b), by integrating y's conditional probability over x."""
    spread = np.sqrt(1 - correlation**2)
    steep = [one for one in (b / correlation,) if -9 < one < a] if abs(correlation) > 1e-9 else []
    edges = sorted({-9.0, a, *steep, *(e + k * spread for e in steep for k in (-8, 8) if -9 < e + k * spread < a)})
    return sum(
        quad(lambda x: norm.pdf(x) * norm.cdf((b - correlation * x) / spread), low, high, epsabs=1e-13, epsrel=1e-12)[0]
        for low, high in pairwise(edges)
    )


def _correlated(correlation: float) -> Any:
    return np.array([[1, correlation], [correlation, 1]])


def test_it_agrees_with_scipys_own() -> None:
    """On a grid, to 1e-6, which is what SciPy's integration of normal probabilities promises here."""
    for correlation in (-0.9, -0.3, 0.0, 0.5, 0.97):
        for a, b in ((0.0, 0.0), (-1.0, 0.5), (-2.0, -2.1), (1.0, 3.0)):
            expected = multivariate_normal(np.zeros(2), _correlated(correlation)).cdf([a, b])
            found = both_below(np.array([a]), np.array([b]), np.array([correlation]))[0]
            assert found == pytest.approx(expected, abs=1e-6)


@hypothesis.given(
    st.floats(-3, 3), st.floats(1e-3, 3), st.floats(-3, 1), st.floats(0.1, 4), st.sampled_from(["both", "low", "high"])
)
@hypothesis.settings(max_examples=examples(60))
def test_limited_moments_are_those_of_quadrature(
    centre: float, std: float, low: float, width: float, sides: str
) -> None:
    """Slope, mean and what is left of the variance of a clipped normal number, to 1e-8."""
    high = low + width
    lowest, highest = (low if sides != "high" else -np.inf), (high if sides != "low" else np.inf)
    slope, mean, left = recursions().limit(centre, std, lowest, highest)

    def expected(function: Any) -> float:
        # In pieces, for a narrow peak in a wide interval is beyond the quadrature.
        pieces = [centre + i * std for i in (-10, -6, -3, -1, 0, 1, 3, 6, 10)]
        edges = sorted({*pieces, *np.clip([low, high], pieces[0], pieces[-1])})
        return sum(
            quad(lambda x: norm.pdf(x, centre, std) * function(x, np.clip(x, lowest, highest)), a, b, epsabs=1e-12)[0]
            for a, b in pairwise(edges)
            if b - a > 1e-12  # quad warns of shorter pieces, which add nothing
        )

    first = expected(lambda x, y: y)
    covariance = expected(lambda x, y: (x - centre) * (y - first))
    variance = expected(lambda x, y: (y - first) ** 2)
    assert slope == pytest.approx(covariance / std**2, abs=1e-7)
    assert mean == pytest.approx(first, abs=1e-8)
    assert left == pytest.approx(variance - slope**2 * std**2, abs=1e-8)


def test_the_chance_of_collision_beside_a_plane_is_that_of_monte_carlo() -> None:
    """A stationary Gaussian process 2 std from a wall: the expected number of entries, and at each knot.

    Of 200,000 paths the entries are known to 1 %. The total takes them for independent, and paths that enter once enter
    again, so it is above the share of the paths that enter: by a third for this one, which is rough and often there.
    """
    steps, keep, paths = 60, 0.9, 200_000
    wall = ls.World([ls.Obstacle("wall", "plane", np.array([0.0, -0.2, 0.0]), _facing_y(), np.zeros(3))])
    surroundings = _among(wall, radius=0.0, std=0.0)
    std = 0.1
    covariance = np.tile(np.diag([0.05, std]) ** 2, (steps + 1, 1, 1))
    each, total = surroundings.spread(np.zeros((steps + 1, 2)), covariance, keep * covariance[1:]).chance()
    rng = np.random.default_rng(0)
    y = std * rng.normal(size=paths)
    hit, entries = y < -0.2, float((y < -0.2).mean())
    for _ in range(steps):
        before, y = y, keep * y + np.sqrt(1 - keep**2) * std * rng.normal(size=paths)
        entries += float(((y < -0.2) & (before >= -0.2)).mean())
        hit |= y < -0.2
    np.testing.assert_allclose(each, norm.cdf(-2.0), rtol=1e-9)
    assert -np.log1p(-total) == pytest.approx(entries, rel=0.02)
    assert hit.mean() < total < 1.35 * hit.mean()


@hypothesis.given(
    st.lists(st.tuples(st.sampled_from([0, 1]), st.booleans(), st.sampled_from([0.1, 0.2])), min_size=1, max_size=6)
)
@hypothesis.settings(max_examples=20)
def test_the_same_obstacles_count_once_however_often_they_are_stated(stated: list[tuple[int, bool, float]]) -> None:
    """By costs and clearances, with one World or with equal ones: the first of each kind, and its chance once."""
    walls = [
        lambda side=side: ls.World([ls.Obstacle("wall", "plane", np.array([0, side, 0]), _facing_y(), np.zeros(3))])
        for side in (-0.2, -0.3)
    ]
    shared = [wall() for wall in walls]
    worlds = [shared[which] if one else walls[which]() for which, one, _ in stated]
    kept: list[KeepsClear] = [
        ls.Clearance(world, radius=radius) if k % 2 else ls.ObstacleCost(world, radius=radius, sharpness=10.0)
        for k, (world, (_, _, radius)) in enumerate(zip(worlds, stated, strict=True))
    ]
    firsts = {(which, radius): k for k, (which, _, radius) in reversed(list(enumerate(stated)))}
    assert each_once(kept) == [kept[k] for k in sorted(firsts.values())]
    alone = _among(worlds[0], radius=stated[0][2], std=0.1)
    twice = ls.World(list(worlds[0].obstacles))
    system = linear(
        np.zeros((2, 2)), np.eye(2), np.eye(2), steps=2, position=("s0", "s1"),
        costs=tuple(ls.ObstacleCost(one, radius=stated[0][2], sharpness=10.0) for one in (worlds[0], twice)),
    )  # fmt: skip
    still, spread = np.zeros((3, 2)), np.tile(np.diag([0.1, 0.1]) ** 2, (3, 1, 1))
    found = [one.spread(still, spread, spread[1:]).chance()[1] for one in (alone, Surroundings.of(system.problem, 0.1))]
    assert found[0] == found[1] > 0


def _among(world: ls.World, *, radius: float, std: float) -> Surroundings:
    """What a robot in the plane of that radius sees."""
    system = linear(
        np.zeros((2, 2)), np.eye(2), np.eye(2), steps=2, position=("s0", "s1"),
        costs=(ls.ObstacleCost(world, radius=radius, sharpness=10.0),),
    )  # fmt: skip
    return Surroundings.of(system.problem, std)


def _facing_y() -> Array:
    """The rotation of a plane whose normal, its z axis, is along y."""
    return np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def test_two_obstacles_and_one_that_is_displaced() -> None:
    """A place between two balls, whose own spread adds to that of the robot; one knot: in closed form."""
    balls = [
        ls.Obstacle(f"ball {i}", "sphere", np.array([x, 0.0, 0.0]), np.eye(3), np.array([0.5, 0, 0]))
        for i, x in enumerate((-1.0, 1.2))
    ]
    surroundings = _among(ls.World(balls), radius=0.2, std=0.04)
    covariance = np.tile(np.diag([0.03, 0.3]) ** 2, (1, 1, 1))
    each, total = surroundings.spread(np.zeros((1, 2)), covariance, np.zeros((0, 2, 2))).chance()
    expected = norm.cdf(-0.3 / 0.05) + norm.cdf(-0.5 / 0.05)
    assert each[0] == pytest.approx(expected, rel=1e-9)
    assert total == pytest.approx(-np.expm1(-expected), rel=1e-9)


# The closed loop.


def simulated(
    system: Linear, control: Any, uncertainty: Uncertainty, trials: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """States (T+1, K, n) and applied commands (T, K, m) of a NumPy run under exactly what is stated: d0 is constant."""
    low, high = (
        np.array(one)
        for one in (system.problem.dynamics.control_coordinates.low, system.problem.dynamics.control_coordinates.high)
    )
    assert isinstance(uncertainty.start, float)
    assert isinstance(uncertainty.measurement, float)
    assert isinstance(uncertainty.control, float)
    push = sum(one.std for one in uncertainty.unknowns) * rng.normal(size=(trials, 1))
    held, losses = np.tile(system.plan.controls[0], (trials, 1)), np.random.default_rng(1)
    x = system.plan.states[0] + uncertainty.start * rng.normal(size=(trials, len(system.A)))
    states, applied = [x], []
    for t in range(system.plan.steps):
        shown = x + uncertainty.measurement * rng.normal(size=x.shape)
        u = np.clip(control(t, shown), low, high)
        applied.append(u)
        held = u = np.where(losses.random((trials, 1)) < uncertainty.command_loss, held, u)
        x = x @ system.A.T + (u + uncertainty.control * rng.normal(size=u.shape)) @ system.B.T + push @ system.E.T
        states.append(x)
    return np.array(states), np.array(applied)


STATED = Uncertainty(unknowns=[ls.disturbances.Unknown("d0", 0.3)], start=0.1, control=0.2, measurement=0.02)


def weave(limit: float) -> Linear:
    return double_integrator(
        start=[0.5, 0.0], controls=0.5 * np.sin(np.arange(40) / 5)[:, None], limits=(-limit, limit)
    )


@pytest.mark.parametrize("estimates", [False, True])
@pytest.mark.parametrize(
    ("limit", "lost", "tolerance", "share"), [(1e6, 0.0, 0.04, 0.0), (1.5, 0.0, 0.15, 0.008), (1e6, 0.2, 0.04, 0.0)]
)
def test_moments_are_those_of_a_simulated_loop(
    estimates: bool, limit: float, lost: float, tolerance: float, share: float
) -> None:
    """Mean and covariance of 20,000 runs in NumPy, with the policy or with the compiled filter.

    Of so many runs a standard deviation is known to 0.5 %, and the largest of its errors over 40 knots is some 2 %.
    With commands at their limits now and then the linearisation is no longer exact: 15 % where it is 1 in 100. (It is
    worse where they stay there: a push that lasts, and that the limits cannot hold, is no noise.) With lost
    commands the moments are exact, but the more are lost the heavier the tails are, and the worse a std is known.
    """
    trials, system, stated = 20_000, weave(limit), replace(STATED, command_loss=lost)
    problem, solution, controller = system.problem, system.solution, None
    if estimates:
        controller = ls.OffsetFree(problem, solution, stated, tolerate={"s0": 0.1, "s1": 0.5}, effort=0.5)
        control = controller.start(trials).control
    else:
        tolerate = {"s0": 0.1, "s1": 0.5}
        policy = ls.track(problem, solution, tolerate=tolerate, effort=0.5, uncertainty=stated)
        solution = by_hand(system.plan, policy)
        control = Feedback(policy).start(trials).control
    tube = ls.predict_tube(problem, solution, stated, controller)
    states, applied = simulated(system, control, stated, trials, np.random.default_rng(0))
    off = states - system.plan.states[:, None]
    std = np.sqrt(np.diagonal(tube.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(off.std(axis=1), std, rtol=tolerance)
    assert (np.abs(off.mean(axis=1) - tube.mean) < 5 * std / np.sqrt(trials) + share * std).all()
    correlation = np.mean(off[:, :, 0] * off[:, :, 1], axis=1) - off[:, :, 0].mean(axis=1) * off[:, :, 1].mean(axis=1)
    np.testing.assert_allclose(
        correlation, tube.covariance[:, 0, 1], rtol=0, atol=tolerance * (std[:, 0] * std[:, 1]).max()
    )
    beyond = (np.abs(applied) >= limit).mean(axis=1)
    np.testing.assert_allclose(tube.saturation, beyond, rtol=0, atol=0.02)
    assert beyond.max() >= share


@pytest.mark.parametrize("told", [Uncertainty(start=0.01, control=0.3, measurement=0.05), replace(STATED, lag=0.2)])
def test_moments_of_a_law_that_was_designed_for_something_else_are_those_of_the_run(told: Uncertainty) -> None:
    """The filter knows no push; or it is told of a lag that is not there. 20,000 runs in NumPy, 4 % as above."""
    trials, system = 20_000, weave(1e6)
    law = ls.OffsetFree(system.problem, system.solution, told, tolerate={"s0": 0.1, "s1": 0.5}, effort=0.5)
    tube = ls.predict_tube(system.problem, system.solution, STATED, law)
    states, _ = simulated(system, law.start(trials).control, STATED, trials, np.random.default_rng(0))
    std = np.sqrt(np.diagonal(tube.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose((states - system.plan.states[:, None]).std(axis=1), std, rtol=0.04)


def test_the_error_of_the_estimate_is_the_filters_where_that_is_told_the_truth() -> None:
    """To rounding, if the least errors that a filter assumes are stated: what is stated wins where it is larger."""
    system = weave(1e6)

    def law_for(stated: Uncertainty) -> ls.OffsetFree:
        return ls.OffsetFree(system.problem, system.solution, stated, tolerate=0.3, effort=0.5, memory=1e9)

    assumed = law_for(STATED).model.uncertainty
    truth = replace(STATED, control=assumed.control, model_error=assumed.model_error)
    law = law_for(truth)
    tube = ls.predict_tube(system.problem, system.solution, truth, law)
    assert tube.estimate_covariance is not None
    np.testing.assert_allclose(tube.estimate_covariance, law.filter.predicted[:, :2, :2], rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize("field", ["latency", "delay"])
def test_moments_of_what_is_late_need_samples(field: str) -> None:
    system = double_integrator(steps=5)
    late = Uncertainty(**{field: 2})  # type: ignore[arg-type]
    with pytest.raises(
        ls.InputError, match=f"samples: got 0, want more: moments leave out a {field} of 2 control periods"
    ):
        ls.predict_tube(system.problem, system.solution, late, samples=0)


# Sampled trials.


@pytest.mark.parametrize("seed", [10**9 + 1, 2**64, 2**128 - 1])
def test_seeds_are_as_large_as_those_of_simulate(seed: int) -> None:
    system = double_integrator(steps=5)
    late = Uncertainty(latency=1, start=0.1)
    tube, same, other = (
        ls.predict_tube(system.problem, system.solution, late, samples=20, seed=one) for one in (seed, seed, 0)
    )
    np.testing.assert_array_equal(tube.covariance, same.covariance)
    assert (tube.covariance != other.covariance).any()


@pytest.mark.parametrize("estimates", [False, True])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_sampled_moments_of_a_linear_system_are_those_of_its_matrices(estimates: bool, lost: float) -> None:
    """Of 20,000 trials a standard deviation is known to 0.5 %; the largest error over 40 knots is some 2 %.

    Lost commands give heavier tails.
    """
    system = weave(1e6)
    stated = replace(STATED, lag=0.0 if lost else 0.05, command_loss=lost)
    if estimates:
        law = ls.OffsetFree(system.problem, system.solution, stated, tolerate={"s0": 0.1, "s1": 0.5}, effort=0.5)
        loop, controller = law.loop(), law
    else:
        tolerate = {"s0": 0.1, "s1": 0.5}
        policy = ls.track(system.problem, system.solution, tolerate=tolerate, effort=0.5, uncertainty=stated)
        controller, model = Feedback(policy), PlanModel(PlanDerivatives(system.problem.dynamics, system.plan), stated)
        offset = np.einsum("tij,tj->ti", policy.gain, system.plan.states[:-1]) + policy.offset - system.plan.controls
        loop = LinearLoop(model, policy.gain, offset, None, (np.full(1, -1e6), np.full(1, 1e6)))
    moments, n = loop.moments(), loop.model.n
    surroundings, norm = Surroundings.of(system.problem, 0.0), DeviationNorm.of(system.solution, ())
    found = sample_loop(loop.model, controller, loop.limits, surroundings, norm, 20_000, 0).moments
    std = np.sqrt(np.diagonal(moments.covariance[:, :n, :n], axis1=1, axis2=2))
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)), std, rtol=0.05)
    assert (np.abs(found.mean - moments.mean[:, :n]) < 5 * std / np.sqrt(20_000)).all()
    scale = std[1:, :, None] * std[:-1, None, :]
    np.testing.assert_allclose(found.across / scale, moments.across[:, :n, :n] / scale, rtol=0, atol=0.05)


def test_samples_are_those_of_a_loop_with_limits_latency_and_delay() -> None:
    """The share of collisions with a wall, against runs in NumPy: of two times 20,000 trials 10 % are off by 3 %.

    The force that pushes towards the wall is at times more than the limits, so that the moments' chance is another.
    """
    trials, limit, wall = 20_000, 0.8, -0.5
    system = walled(limit, wall)
    stated = replace(STATED, control=0.0, unknowns=(ls.disturbances.Unknown("d0", 0.5),), latency=1, delay=2, loss=0.1)
    policy = ls.track(system.problem, system.solution, tolerate={"s0": 0.2, "s1": 0.5}, effort=0.5, uncertainty=stated)
    solution = by_hand(system.plan, policy)
    tube = ls.predict_tube(system.problem, solution, stated, samples=trials)
    rng = np.random.default_rng(5)
    push = 0.5 * rng.normal(size=(trials, 1))
    x = system.plan.states[0] + 0.1 * rng.normal(size=(trials, 2))
    measured, under_way, shown = (
        [],
        [np.tile(one, (trials, 1)) for one in system.plan.controls[:2]],
        system.plan.states[0],
    )
    hit = x[:, 0] < wall
    for t in range(system.plan.steps):
        measured.append(x + 0.02 * rng.normal(size=x.shape))
        arrived = measured[max(t - 1, 0)]
        shown = np.where(rng.random((trials, 1)) < 0.1, shown, arrived)
        under_way.append(np.clip(shown @ policy.gain[t].T + policy.offset[t], -limit, limit))
        x = x @ system.A.T + under_way.pop(0) @ system.B.T + push @ system.E.T
        hit |= x[:, 0] < wall
    assert 0.05 < hit.mean() < 0.5
    assert tube.collision_chance == pytest.approx(hit.mean(), rel=0.1)
    assert tube.samples == trials
    again = ls.predict_tube(system.problem, solution, stated, samples=trials)
    np.testing.assert_array_equal(again.covariance, tube.covariance)


def walled(limit: float, wall: float) -> Linear:
    """A mass on a line with a wall behind it."""
    behind = ls.World([ls.Obstacle("wall", "plane", np.array([wall, 0.0, 0.0]), _facing_x(), np.zeros(3))])
    return linear(
        [[0, 1], [0, 0]], [[0], [1]], [[0], [1]], steps=40, limits=(-limit, limit), position=("s0", "s1"),
        costs=(ls.ObstacleCost(behind, radius=0.0, sharpness=10.0),),
    )  # fmt: skip


def _facing_x() -> Array:
    """The rotation of a plane whose normal, its z axis, is along x."""
    return np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])


def test_the_nearest_obstacle_of_each_trial_is_where_it_was_displaced_to() -> None:
    """Two balls, in closed form."""
    centres, rng = np.array([[-1.0, 0.0, 0.0], [1.0, 0.5, 0.0]]), np.random.default_rng(0)
    balls = [
        ls.Obstacle(f"ball {i}", "sphere", centre, np.eye(3), np.array([0.5, 0, 0])) for i, centre in enumerate(centres)
    ]
    surroundings = _among(ls.World(balls), radius=0.2, std=0.3)
    displaced, states = surroundings.displacements(rng, 2000), rng.normal(size=(2000, 2))
    assert displaced[0][..., :2].std() == pytest.approx(0.3, rel=0.05)
    assert not displaced[0][..., 2].any()  # a robot in a plane sees obstacles in it
    away = np.linalg.norm(states[:, None] - centres[:, :2] - displaced[0][..., :2], axis=2) - 0.7
    np.testing.assert_allclose(surroundings.nearest(states, displaced), away.min(axis=1), atol=1e-12)


@pytest.mark.parametrize("collided", [0, 1, 7, 40, 1000])
@pytest.mark.parametrize("predicted", [0.0, 1e-9, 1e-3, 0.05, 0.9])
def test_a_chance_is_between_the_predicted_and_the_counted_one(collided: int, predicted: float) -> None:
    """And the norm one, none as a half, where an exact interval of 95 % does not have the predicted one."""
    trials = 1000
    hit = np.arange(trials) < collided
    none = LoopMoments(*[np.zeros((0, 0))] * 5)
    found = SampledLoop(none, hit, np.zeros(trials)).chance(predicted)
    low, high = binomtest(collided, trials).proportion_ci(0.95, method="exact")
    if low <= predicted <= high:
        assert min(predicted, collided / trials) <= found <= max(predicted, collided / trials)
    else:
        assert found == max(collided, 0.5) / trials


# Dynamics that declare what disturbs them.


def test_disturbances_are_constants_to_a_plan_and_parameters_to_an_estimate(quadrotor: ls.Scenario) -> None:
    dynamics = quadrotor.robot.dynamics
    bare = ls.Dynamics(
        dynamics.f, states=dict(zip(dynamics.state_coordinates.names, dynamics.state_coordinates.units, strict=True)),
        controls=dict.fromkeys(dynamics.control_coordinates.names, "N"), parameters=dynamics.parameters,
        disturbances=dynamics.disturbances,
    )  # fmt: skip
    assert bare.source == dynamics.source
    assert "wind_x" not in dynamics.parameters
    told = dynamics.disturbed
    assert told.disturbed is told
    assert list(told.parameters) == [*dynamics.parameters, *dynamics.disturbances]
    rng = np.random.default_rng(0)
    for _ in range(5):
        x, u = rng.normal(size=12), rng.uniform(0, 3, size=4)
        np.testing.assert_allclose(told.step(x, u, 0.03), dynamics.step(x, u, 0.03), rtol=0, atol=1e-12)
    other = dynamics.with_parameters(mass=0.6)
    assert other.disturbed.parameters["mass"] == 0.6


def test_dynamics_with_the_same_formula_without_disturbances_have_the_same_source() -> None:
    def pushed(x: Any, u: Any, p: Any) -> list[Any]:
        return [x[1], (u[0] + p.push - p.drag * (x[1] - p.wind)) / p.mass]

    def bare(x: Any, u: Any, p: Any) -> list[Any]:
        return [x[1], (u[0] - p.drag * x[1]) / p.mass]

    common: dict[str, Any] = {
        "states": {"x": "m", "v": "m/s"},
        "controls": {"u": "N"},
        "parameters": {"mass": 2.0, "drag": 0.3},
    }
    assert (
        ls.Dynamics(pushed, disturbances={"push": 0.0, "wind": 0.0}, **common).source
        == ls.Dynamics(bare, **common).source
    )


def test_effects_are_those_of_finite_differences(quadrotor: ls.Scenario) -> None:
    """Of the quadrotor's wind, force, torque, mass, gains and offsets on the next state: 1e-6."""
    rng = np.random.default_rng(0)
    dynamics, dt = quadrotor.robot.dynamics, quadrotor.problem.dt
    controls = rng.uniform(0.8, 1.6, size=(3, 4))
    states: list[Any] = [0.2 * rng.normal(size=12)]
    for control in controls:
        states.append(dynamics.step(states[-1], control, dt))
    plan = ls.Trajectory(np.array(states), controls, dt)
    names = ["wind_x", "force_z", "torque_y", "mass", "gain of rotor_2", "offset of rotor_3"]
    model = PlanModel(
        PlanDerivatives(dynamics, plan), Uncertainty(unknowns=[ls.disturbances.Unknown(name, 1.0) for name in names])
    )
    h = 1e-4
    for t in range(3):
        for i, name in enumerate(names):
            ends: list[Any] = []
            for change in (h, -h):
                told, u = dynamics.disturbed, controls[t].copy()
                if name == "gain of rotor_2":
                    u[1] *= 1 + change
                elif name == "offset of rotor_3":
                    u[2] += change
                else:
                    told = told.with_parameters(**{name: told.parameters[name] + change})
                ends.append(told.step(plan.states[t], u, dt))
            np.testing.assert_allclose(model.step.F[t, :12, 12 + i], (ends[0] - ends[1]) / (2 * h), rtol=0, atol=1e-6)


def test_a_system_without_the_parameter_has_another_law() -> None:
    """A wind that is taken for granted is in the plan: with_parameters of what is disturbed moves the run."""
    system = linear([[-0.5]], [[1.0]], [[2.0]], steps=3)
    told = system.problem.dynamics.disturbed.with_parameters(d0=0.25)
    np.testing.assert_allclose(
        told.step([1.0], [0.0], DT), system.A @ [1.0] + 0.25 * system.E[:, 0], rtol=0, atol=1e-12
    )
    assert replace(STATED, loss=0.1).as_stated().loss == 0.1

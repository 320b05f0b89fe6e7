"""Beliefs: against LQG in closed form, an extended Kalman filter of matrices, differences, and drawn runs."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sampling import is_short
from scipy.linalg import solve_discrete_are
from scipy.stats import norm
from sympy import Matrix, cos, sin, sqrt

import lqrsim as ls
from lqrsim.codegen.plain import plain_functions
from lqrsim.commands.solving import tube_under
from lqrsim.errors import Array
from lqrsim.problem.problem import PlainTerm
from lqrsim.results.solution_parts import Status
from lqrsim.view.plots import accuracy

DT = 0.1
A, B = np.array([[1.0, DT], [-0.3, 0.9]]), np.array([[0.0, 0.1], [DT, 0.3]])
H, R = np.array([[1.0, 0.2], [-0.3, 1.0]]), np.array([0.3, 0.5])
M = np.array([[0.1, 0.02], [0.0, 0.2]])


def linear(x: Any, u: Any, p: Any) -> list[Any]:
    return [sum(A[i, j] * x[j] + B[i, j] * u[j] for j in range(2)) for i in range(2)]


def linear_readings(x: Any, u: Any, p: Any) -> list[Any]:
    return [(sum(H[i, j] * x[j] for j in range(2)), float(R[i])) for i in range(2)]


def linear_belief(delay: int = 0) -> ls.belief.Belief:
    dynamics = ls.Dynamics(linear, states={"x": "m", "v": "m/s"}, controls={"a": "N", "b": "N"}, period=DT)
    sensors = ls.belief.NoisySensors(linear_readings, delay=delay)
    return ls.belief.Belief(dynamics, dt=DT, noise=ls.Noise(M), sensors=sensors)


def unicycle(x: Any, u: Any, p: Any) -> list[Any]:
    return [u.speed * cos(x.heading), u.speed * sin(x.heading), u.turn]


def skids(x: Any, u: Any, p: Any) -> list[Any]:
    return [[p.skid * cos(x.heading), 0, 0.01], [p.skid * sin(x.heading), 0.01, 0], [0, p.skid + 0.1 * u.turn, 0]]


def beacons(x: Any, u: Any, p: Any) -> list[Any]:
    distances = [sqrt((x.x - place) ** 2 + x.y**2 + 0.01) for place in (p.left, 2.0)]
    return [*((one, p.noise * (0.1 + one)) for one in distances), (sin(x.heading), 0.2)]


def robot() -> ls.Dynamics:
    states, controls = {"x": "m", "y": "m", "heading": "rad"}, {"speed": "m/s", "turn": "rad/s"}
    return ls.Dynamics(unicycle, states=states, controls=controls, position=("x", "y"), angles=("heading",))


def belief() -> ls.belief.Belief:
    noise = ls.Noise(skids, size=3, parameters={"skid": 0.05})
    sensors = ls.belief.NoisySensors(beacons, parameters={"left": -2.0, "noise": 0.1})
    return ls.belief.Belief(robot(), dt=DT, noise=noise, sensors=sensors)


START = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.05]])


def test_linear_gaussian_is_lqg() -> None:
    """Cost and gains of separation: Riccati's equations for the law and for the filter. To 1e-8, as of the solver."""
    of, steps, start = linear_belief(), 60, np.array([1.0, -0.5])
    q, r = np.array([2.0, 1.0]), np.array([0.5, 0.3])
    p = solve_discrete_are(A, B, np.diag(q), np.diag(r))
    weights = of.uncertainty({"x": q[0], "v": q[1]})
    final = np.zeros((5, 5))
    final[:2, :2] = p
    rows, columns = np.tril_indices(2)  # of tr(p L L'): entries of one column of L are weighed together
    final[2:, 2:] = p[np.ix_(rows, rows)] * (columns[:, None] == columns)
    problem = ls.Problem(
        dynamics=of, dt=DT, steps=steps, initial=ls.FixedState(of.state(start, START[:2, :2])),
        stage_cost=ls.QuadraticCost({"x": q[0], "v": q[1]} | weights, about=[0] * 5) + ls.ControlCost(r),
        final_cost=ls.QuadraticCost(final, about=[0] * 5), noise=of.innovations,
    )  # fmt: skip
    cost, covariance = 0.5 * start @ p @ start, START[:2, :2]
    for _ in range(steps):
        cost += 0.5 * np.trace(np.diag(q) @ covariance)
        predicted = A @ covariance @ A.T + M @ M.T
        gain = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + np.diag(R**2))
        covariance = predicted - gain @ H @ predicted
        cost += 0.5 * np.trace(p @ (predicted - covariance))
    cost += 0.5 * np.trace(p @ covariance)
    law = -np.linalg.solve(np.diag(r) + B.T @ p @ B, B.T @ p @ A)
    for solve in (ls.smooth, *[ls.ilqr] * (not is_short())):
        solution = solve(problem)
        assert solution.status is Status.CONVERGED
        assert solution.cost == pytest.approx(cost, rel=1e-8)
        np.testing.assert_allclose(solution.policy.gain[..., :2], np.tile(law, (steps, 1, 1)), atol=1e-8)
        np.testing.assert_allclose(solution.policy.gain[..., 2:], 0, atol=1e-8)
        np.testing.assert_allclose(of.covariance(solution.trajectory.states[-1]), covariance, atol=1e-12)


def test_the_predicted_covariance_is_that_of_drawn_runs() -> None:
    """Of 10,000 runs with the filter, after 15 periods: entries within 4.5 standard errors of normal samples."""
    of, steps, trials, rng = linear_belief(), 15, 10_000, np.random.default_rng(3)
    first = of.state([1.0, -0.5], START[:2, :2])
    plan, beliefs = first, np.tile(first, (trials, 1))
    states = rng.multivariate_normal(first[:2], START[:2, :2], size=trials)
    for _ in range(steps):
        controls = beliefs[:, :2] @ np.array([[-0.4, -0.1], [-0.2, -0.5]])
        states = states @ A.T + controls @ B.T + rng.normal(size=(trials, 2)) @ M.T
        beliefs = of.corrected(beliefs, controls, states @ H.T + R * rng.normal(size=(trials, 2)))
        plan = of.step(plan, [0, 0], DT)
    off, expected = states - beliefs[:, :2], of.covariance(plan)
    found = off.T @ off / trials
    variances = np.diag(expected)
    errors = np.sqrt((np.outer(variances, variances) + expected**2) / trials)
    assert (np.abs(found - expected) < 4.5 * errors).all()


@pytest.mark.parametrize("delay", [0, 2])
def test_late_and_lost_readings_are_taken_at_their_time(delay: int) -> None:
    """The controls of a run are of the mean by a Kalman filter of matrices that has only what arrived; to rounding."""
    of, steps, trials, rng = linear_belief(delay), 8, 3, np.random.default_rng(7)
    problem = ls.Problem(
        dynamics=of, dt=DT, steps=steps, initial=ls.FixedState(of.state([1.0, -0.5], START[:2, :2])),
        stage_cost=ls.QuadraticCost({"x": 2.0, "v": 1.0}, about={}) + ls.ControlCost([0.5, 0.3]),
        final_cost=ls.QuadraticCost({"x": 2.0}, about={}), noise=of.innovations,
    )  # fmt: skip
    plan = ls.smooth(problem)
    run = ls.belief.BeliefFeedback(problem, plan).start(trials)
    readings = rng.normal(size=(steps, trials, 2))
    readings[rng.random(readings.shape) < 0.4] = np.nan
    late = np.full((delay, trials, 2), np.nan)
    controls = [run.control(t, shown) for t, shown in enumerate([*late, *readings][:steps])]
    for t, k in np.ndindex(steps, trials):
        mean, covariance = np.array([1.0, -0.5]), START[:2, :2]
        for i in range(t):
            mean, covariance = A @ mean + B @ controls[i][k], A @ covariance @ A.T + M @ M.T
            got = np.isfinite(readings[i + 1, k]) & (i + 1 <= t - delay)
            h, y = H[got], readings[i + 1, k][got]
            gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + np.diag(R[got] ** 2))
            mean, covariance = mean + gain @ (y - h @ mean), covariance - gain @ h @ covariance
        belief = run.beliefs[t, k]
        np.testing.assert_allclose(belief[:2], mean, atol=1e-12)
        np.testing.assert_allclose(of.covariance(belief), covariance, atol=1e-12)
        affine = plan.policy.gain[t] @ belief + plan.policy.offset[t]
        np.testing.assert_allclose(controls[t][k], affine, atol=1e-12)


def test_averaged_noise_is_that_of_the_readings_drawn() -> None:
    """A variance that is quadratic in the state: its mean in closed form, to rounding, and so the filter's covariance.

    Of 20,000 drawn states the filter errs as it says, within 4.5 standard errors; taken at the mean, it is too sure.
    """

    def seen(x: Any, u: Any, p: Any) -> list[Any]:
        return [(x.x, sqrt(0.01 + (x.x - x.v / 2) ** 2 / 2)), (x.v, 0.5)]

    beliefs = [
        ls.belief.Belief(
            linear_belief().robot, dt=DT, noise=ls.Noise(M), sensors=ls.belief.NoisySensors(seen), averaged=averaged
        )
        for averaged in (False, True)
    ]
    covariance, control, trials, rng = 4 * START[:2, :2] + 1e-3, np.array([0.3, -0.2]), 20_000, np.random.default_rng(5)
    mean = np.array([0.3, 0.1])
    after, predicted = A @ mean + B @ control, A @ covariance @ A.T + M @ M.T
    along, trusted = np.array([1.0, -0.5]), [0.0, 0.0]
    states = rng.multivariate_normal(after, predicted, size=trials)
    readings = states + rng.normal(size=(trials, 2)) * np.column_stack(
        [np.sqrt(0.01 + (states @ along) ** 2 / 2), np.full(trials, 0.5)]
    )
    for of, spread, number in zip(beliefs, (0.0, along @ predicted @ along), (0, 1), strict=True):
        noise = np.diag(np.array([0.01 + ((along @ after) ** 2 + spread) / 2, 0.25]))
        expected = predicted - predicted @ np.linalg.solve(predicted + noise, predicted)
        first = of.state(mean, covariance)
        np.testing.assert_allclose(of.covariance(of.step(first, control, DT)), expected, atol=1e-12)
        ones = np.ones((trials, 1))
        errors = states - of.corrected(ones * first, ones * control, readings)[:, :2]
        squares = errors[:, 0] ** 2
        trusted[number] = (squares.mean() - expected[0, 0]) / (squares.std() / np.sqrt(trials))
    assert trusted[0] > 20
    assert abs(trusted[1]) < 4.5


def test_the_tube_of_a_linear_system_is_that_of_lqg() -> None:
    """Covariances of state, command and error, by the recursion of state and error; to rounding."""
    of, steps = linear_belief(), 20
    first = of.state([1.0, -0.5], START[:2, :2])
    weights = of.uncertainty({"x": 2.0, "v": 1.0})
    problem = ls.Problem(
        dynamics=of, dt=DT, steps=steps, initial=ls.FixedState(first), noise=of.innovations,
        stage_cost=ls.QuadraticCost({"x": 2.0, "v": 1.0} | weights, about={}) + ls.ControlCost([0.5, 0.3]),
        final_cost=ls.QuadraticCost({"x": 2.0}, about={}),
    )  # fmt: skip
    solution = ls.smooth(problem)
    tube, gains = ls.predict_tube(problem, solution), solution.policy.gain[:, :, :2]
    covariance, known = np.kron([[1.0, 1.0], [1.0, 1.0]], START[:2, :2]), START[:2, :2]  # of state and error
    for t, gain in enumerate(gains):
        np.testing.assert_allclose(tube.covariance[t], covariance[:2, :2], atol=1e-12)
        law = np.hstack([gain, -gain])
        np.testing.assert_allclose(tube.command[t] ** 2, np.diag(law @ covariance @ law.T), atol=1e-12)
        predicted = A @ known @ A.T + M @ M.T
        kalman = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + np.diag(R**2))
        kept = np.eye(2) - kalman @ H
        moves = np.block([[A + B @ gain, -B @ gain], [np.zeros((2, 2)), kept @ A]])
        noise = np.block([[M, np.zeros((2, 2))], [kept @ M, -kalman * R]])
        np.testing.assert_allclose(tube.across[t], (moves @ covariance)[:2, :2], atol=1e-12)
        covariance, known = moves @ covariance @ moves.T + noise @ noise.T, kept @ predicted
        assert tube.estimate_covariance is not None
        np.testing.assert_allclose(tube.estimate_covariance[t + 1], predicted, atol=1e-12)
    with pytest.raises(ls.InputError, match="in belief space, want none"):
        ls.predict_tube(problem, solution, ls.disturbances.Uncertainty())


@pytest.mark.parametrize("form", [list, tuple, np.array, Matrix])
def test_readings_and_chance_constraints_are_lists_arrays_or_matrices(form: Any) -> None:
    def near(x: Any, u: Any, p: Any) -> list[Any]:
        return [1 - x.x, 2 - x.v**2]

    of = linear_belief()
    sensors = ls.belief.NoisySensors(lambda x, u, p: form(linear_readings(x, u, p)))
    read = ls.belief.Belief(of.robot, dt=DT, noise=ls.Noise(M), sensors=sensors)
    states = np.array([[0.3, -0.2], [1.0, 2.0]])
    for one, other in zip(of.read(states), read.read(states), strict=True):
        np.testing.assert_array_equal(one, other)
    kept, formed = (of.chance_constraint(f, chance=0.1) for f in (near, lambda x, u, p: form(near(x, u, p))))
    point = np.concatenate([of.state([0.3, -0.2], np.diag([0.1, 0.2])), np.zeros(2)])
    terms = [PlainTerm(one.bind(of), 5, 2) for one in (kept, formed)]
    assert [terms[0].value(point, row) for row in (0, 1)] == [terms[1].value(point, row) for row in (0, 1)]


def test_what_is_no_belief_is_refused() -> None:
    given: dict[str, Any] = {"dt": DT, "noise": ls.Noise(0.1 * np.eye(3)), "sensors": ls.belief.NoisySensors(beacons)}
    two: dict[str, Any] = given | {"noise": ls.Noise(M)}
    plain = ls.Dynamics(lambda x, u, p: x, states={"x": "m"}, controls={"u": "m"}, period=DT, level="plain")
    known = ls.belief.NoisySensors(lambda x, u, p: [(x.x, 0.1 + u.speed**2)])
    told: dict[str, Any] = given | {"sensors": known}
    for message, call in (
        ("dynamics: got a function of arrays, want a formula", lambda: ls.belief.Belief(plain, **given)),
        ("got a matrix of 2 rows", lambda: ls.belief.Belief(robot(), **two)),
        ("got a reading that depends on u", lambda: ls.belief.Belief(robot(), **told).readings),
        ("covariance: got one that is not positive definite", lambda: belief().state([0, 0, 0], [1, 1, 0])),
        ("covariance: got -1, want standard deviations >= 0", lambda: belief().state([0, 0, 0], [1, -1, 1])),
        ("covariance: got .* want a symmetric", lambda: belief().state([0, 0, 0], np.eye(3) + np.eye(3, k=1))),
        ("got None, want expressions", lambda: linear_belief().chance_constraint(lambda x, u, p: None, chance=0.1).bind(
            linear_belief()
        )),
        ("chance: got 0.7", lambda: belief().chance_constraint(unicycle, chance=0.7)),
        ("parameters: got 'skid' twice", lambda: ls.belief.Belief(
            robot(), dt=DT, noise=belief().process, sensors=ls.belief.NoisySensors(beacons, parameters={"skid": 1.0}),
        )),
    ):  # fmt: skip
        with pytest.raises(ls.InputError, match=message):
            call()


def filtered(mean: Array, covariance: Array, u: Array, readings: Array | None) -> tuple[Array, Array]:
    """The extended Kalman filter of `belief()`, by matrices; without readings, of the most likely ones."""
    p = SimpleNamespace(left=-2.0, noise=0.1, skid=0.05)
    after = robot().step(mean, u, DT)
    a = robot().linearize(mean, u, DT)[0]
    m = np.array(
        [[p.skid * np.cos(mean[2]), 0, 0.01], [p.skid * np.sin(mean[2]), 0.01, 0], [0, p.skid + 0.1 * u[1], 0]]
    )
    predicted = a @ covariance @ a.T + m @ m.T
    h, expected, std = np.zeros((3, 3)), np.zeros(3), np.array([0.0, 0.0, 0.2])
    for i, place in enumerate((p.left, 2.0)):
        expected[i] = np.sqrt((after[0] - place) ** 2 + after[1] ** 2 + 0.01)
        h[i, :2] = (after[0] - place) / expected[i], after[1] / expected[i]
        std[i] = p.noise * (0.1 + expected[i])
    expected[2], h[2, 2] = np.sin(after[2]), np.cos(after[2])
    gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + np.diag(std**2))
    moved = 0.0 if readings is None else gain @ (readings - expected)
    return after + moved, predicted - gain @ h @ predicted


def test_a_step_is_that_of_an_extended_kalman_filter() -> None:
    """To rounding: its mean and covariance, the spread of its mean by readings, and its corrections by given ones."""
    of, rng = belief(), np.random.default_rng(0)
    for _ in range(5):
        mean, u, readings = rng.normal(size=3), rng.normal(size=2), rng.normal(size=3) + 2
        state = of.state(mean, START)
        after = of.step(state, u, DT)
        expected = filtered(mean, START, u, None)
        np.testing.assert_allclose(after[:3], expected[0], atol=1e-14)
        np.testing.assert_allclose(of.covariance(after), expected[1], atol=1e-14)
        given = of.corrected(state[None], u[None], readings[None])[0]
        np.testing.assert_allclose(given[:3], filtered(mean, START, u, readings)[0], atol=1e-13)
        np.testing.assert_allclose(given[3:], after[3:], atol=1e-14)
        columns = of.innovations.matrices(of, state[None], u[None])[0, :3]
        a, shaken = robot().linearize(mean, u, DT)[0], of.process.matrices(robot(), mean[None], u[None])[0]
        predicted = a @ START @ a.T + shaken @ shaken.T
        np.testing.assert_allclose(columns @ columns.T, predicted - expected[1], atol=1e-14)


def test_states_that_are_known_have_no_covariance() -> None:
    """A step, its innovations and corrections, by matrices of the uncertain block; derivatives against differences."""
    noise = ls.Noise(skids, size=3, parameters={"skid": 0.05})
    near = ls.belief.NoisySensors(lambda x, u, p: beacons(x, u, p)[:2], parameters={"left": -2.0, "noise": 0.1})
    of = ls.belief.Belief(robot(), dt=DT, noise=noise, sensors=near, uncertain=("y", "x"))
    assert of.state_coordinates.names[3:] == ("root_x_x", "root_y_x", "root_y_y")
    mean, u, block = np.array([0.4, -0.3, 0.7]), np.array([0.8, 0.5]), START[:2, :2]
    state, readings = of.state(mean, np.pad(block, (0, 1))), np.array([2.6, 1.5])
    after, a = robot().step(mean, u, DT), robot().linearize(mean, u, DT)[0][:2, :2]
    m = of.process.matrices(robot(), mean[None], u[None])[0, :2]
    predicted = a @ block @ a.T + m @ m.T
    apart = after[:2] - [[-2.0, 0.0], [2.0, 0.0]]
    expected = np.sqrt(np.square(apart).sum(axis=1) + 0.01)
    h = apart / expected[:, None]
    gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + np.diag(0.1 * (0.1 + expected)) ** 2)
    found = of.step(state, u, DT)
    np.testing.assert_allclose(found[:3], after, atol=1e-14)
    full = np.pad(predicted - gain @ h @ predicted, (0, 1))
    np.testing.assert_allclose(of.covariance(found), full, atol=1e-14)
    columns = of.innovations.matrices(of, state[None], u[None])[0, :3]
    np.testing.assert_allclose(columns @ columns.T, np.pad(gain @ h @ predicted, (0, 1)), atol=1e-14)
    given = of.corrected(state[None], u[None], readings[None])[0, :3]
    np.testing.assert_allclose(given, after + np.pad(gain @ (readings - expected), (0, 1)), atol=1e-13)
    assert all(check.good for check in ls.check_derivatives(of))
    for names, message in ((("z",), "uncertain: got 'z'"), ((), "at least one state"), (("x", "x"), "at most once")):
        with pytest.raises(ls.InputError, match=message):
            ls.belief.Belief(robot(), dt=DT, noise=noise, sensors=near, uncertain=names)


def test_derivatives_of_a_step_are_those_of_differences() -> None:
    """First and second ones; differences of Jacobians in steps of 1e-6 are good to some 1e-8."""
    of, rng = belief(), np.random.default_rng(1)
    assert all(check.good for check in ls.check_derivatives(of))
    source, numbers = of.curvature_source, of._numbers()
    assert source is not None
    n, w = 9, 11
    second = plain_functions(source, {"N": n, "M": 2}, ["step_curvature"])["step_curvature"]
    z = np.concatenate([of.state(rng.normal(size=3), START), rng.normal(size=2)])
    weights, hessian = rng.normal(size=n), np.zeros((w, w))
    second(z[:n], z[n:], numbers, DT, weights, np.zeros(n), np.zeros((n, w)), hessian)

    def gradient(z: Array) -> Array:
        a, b, _ = of.linearize(z[:n], z[n:], DT)
        return weights @ np.hstack([a, b])

    steps = 1e-6 * np.eye(w)
    expected = np.array([(gradient(z + step) - gradient(z - step)) / 2e-6 for step in steps])
    np.testing.assert_allclose(hessian, expected, atol=1e-7)


def drive(scenario: ls.Scenario, *, compass: bool = False, **changed: Any) -> ls.Problem:
    """The packaged drive, two seconds along a wall with a beacon. With a compass, its heading is known."""
    sensors = ls.belief.NoisySensors(beacons, parameters={"left": -2.0, "noise": 0.05}, delay=1)
    noise, known = ls.Noise(0.01 * np.eye(3)), ("x", "y") if compass else None
    of = ls.belief.Belief(scenario.robot.dynamics, dt=DT, noise=noise, sensors=sensors, uncertain=known)
    covariance = np.pad(START[:2, :2], (0, 1)) / 10 if compass else START / 10
    given: dict[str, Any] = {
        "dt": DT, "steps": 20, "initial": ls.FixedState(of.state([-0.9, -2.4, 0.0], covariance)),
        "stage_cost": ls.ControlCost([1.0, 1.0]), "noise": of.innovations,
        "final_cost": ls.QuadraticCost({"m": 100.0}, about={"x": -0.3, "y": -2.3}),
    }  # fmt: skip
    return ls.Problem(dynamics=of, **given | changed)


@pytest.mark.parametrize("wall", ["wall", "deviations", "deviations_"])
@pytest.mark.parametrize("chance", [0.2, 0.02])
def test_a_chance_constraint_is_a_quantile_away(chance: float, wall: str) -> None:
    """At drawn beliefs: SciPy's quantile, of the distance's gradient times the covariance, times four."""
    of = drive(ls.scenarios.differential_drive()).dynamics
    assert isinstance(of, ls.belief.Belief)
    side = of.chance_constraint(lambda x, u, p: getattr(p, wall) - x.x * x.y, chance=chance, parameters={wall: 1.0})
    value = PlainTerm(side.bind(of), len(of.state_coordinates), 2).value
    rng = np.random.default_rng(0)
    for _ in range(20):
        roots = np.tril(rng.normal(size=(3, 3)))
        mean, covariance = rng.normal(size=3), roots @ roots.T
        slope = np.array([-mean[1], -mean[0], 0.0])
        expected = 1.0 - mean[0] * mean[1] - norm.isf(chance) * np.sqrt(slope @ covariance @ slope)
        assert value(np.concatenate([of.state(mean, covariance), np.zeros(2)]), 0, 0) == pytest.approx(
            expected, rel=1e-9
        )


@pytest.mark.long
@pytest.mark.parametrize("chance", [0.2, 0.02])
def test_a_chance_constraint_keeps_standard_deviations_away(chance: float) -> None:
    """From a wall that the plan would pass nearer: by the quantile of SciPy, along the gradient of the distance."""
    free = drive(ls.scenarios.differential_drive())
    of = free.dynamics
    assert isinstance(of, ls.belief.Belief)
    side = of.chance_constraint(
        lambda x, u, p: p.wall - 0.6 * x.x - 0.8 * x.y, chance=chance, parameters={"wall": -2.1}
    )
    solution = ls.smooth(drive(ls.scenarios.differential_drive(), constraints=[side]))
    assert solution.status is Status.CONVERGED
    along, states = np.array([0.6, 0.8, 0.0]), solution.trajectory.states
    std = np.sqrt(np.einsum("i,tij,j->t", along, of.covariance(states), along))
    left = -2.1 - states[1:, :3] @ along - norm.isf(chance) * std[1:]
    assert 0 <= left.min() <= 1.1e-3  # with noise, a solver keeps 1e-3 to spare


@pytest.mark.long  # what is compiled for it takes 6 s
def test_the_filter_in_the_loop_is_as_good_as_it_says() -> None:
    """The errors of its means, in MuJoCo with the stated noise: 3 squares of normal numbers, on average over trials.

    Four standard errors, and a tenth for what the filter leaves out: the second order, and the wheels in MuJoCo.
    """
    scenario, trials = ls.scenarios.differential_drive(), 200
    problem = drive(scenario)
    of, plan = problem.dynamics, ls.smooth(problem)
    assert isinstance(of, ls.belief.Belief)
    law = ls.belief.BeliefFeedback(problem, plan)
    first = plan.trajectory.states[0]
    off = ls.disturbances.InitialStateError(tuple(np.sqrt(np.diag(of.covariance(first))).tolist()))
    met = [off, of.process, ls.belief.ReadingErrors(of)]
    run = ls.simulate(scenario.plant(), controller=law, disturbances=met, trials=trials, frames=False, contacts=False)
    beliefs = run.controller_run.beliefs[-1]
    error = beliefs[:, :3] - run.states[:, -2]
    squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(of.covariance(beliefs)), error)
    assert squares.mean() == pytest.approx(3, abs=0.3 + 4 * np.sqrt(6 / trials))
    alone = ls.simulate(
        scenario.plant(), controller=law, disturbances=met, trials=1, first_trial=7, frames=False, contacts=False
    )
    np.testing.assert_array_equal(alone.states[0], run.states[7])
    exact = ls.simulate(scenario.plant(), controller=law, frames=False)
    np.testing.assert_allclose(exact.states[0], plan.trajectory.states[:, :3], atol=0.02)


class Reading(ls.belief.BeliefFeedback):
    """Notes what it reads."""

    def start(self, trials: int) -> Any:
        run, self.read = super().start(trials), list[Array]()
        decide = run.control

        def control(step: int, measured: Array) -> Array:
            self.read.append(measured.copy())
            return decide(step, measured)

        run.control = control  # pyright: ignore[reportAttributeAccessIssue]
        return run


def test_a_run_reads_its_true_states_as_late_as_is_stated() -> None:
    """The formulas of the beacons in NumPy, to rounding; before the first reading arrives nothing but what is known."""
    scenario, trials = ls.scenarios.differential_drive(), 3
    problem = drive(scenario, compass=True)
    law, delay = Reading(problem, ls.smooth(problem)), 1
    off = ls.disturbances.InitialStateError(0.05)
    run = ls.simulate(scenario.plant(), controller=law, disturbances=[off], trials=trials, frames=False)
    x, y, heading = np.moveaxis(run.states, 2, 0)
    exact = [*(np.sqrt((x - place) ** 2 + y**2 + 0.01) for place in (-2.0, 2.0)), np.sin(heading)]
    read, wanted = np.moveaxis(np.array(law.read), 0, 1), np.stack(exact, axis=2)
    np.testing.assert_array_equal(read[..., 3], heading[:, :-1])
    read = read[..., :3]
    assert np.isnan(read[:, :delay]).all()
    np.testing.assert_allclose(read[:, delay:], wanted[:, : read.shape[1] - delay], atol=1e-12)


def belief_scenario() -> ls.Scenario:
    """The packaged drive along a wall, with what a run meets."""
    scenario = ls.scenarios.differential_drive()
    problem = drive(scenario, compass=True)
    of = problem.dynamics
    assert isinstance(of, ls.belief.Belief)
    lost = ls.belief.ReadingErrors(of, loss=0.2)
    met = (ls.disturbances.InitialStateError(0.1), ls.disturbances.StateNoise(of.process), lost)
    return dataclasses.replace(scenario, name="along a wall", problem=problem, disturbances=met, goal_radius=0.1)


@pytest.mark.parametrize(
    ("sweep", "strength", "numbers"), [("scenario", 1.0, [1, 2]), ("scenario:StateNoise", 2.0, [1])]
)
def test_failures_under_disturbances_of_formulas_are_written(
    sweep: str, strength: float, numbers: list[int], tmp_path: Path
) -> None:
    """What has no plain data is stated by its number among the scenario's own, and in words; the rest by settings."""
    reference = f"{__file__}:belief_scenario"
    problem = ls.stress.ReliabilityProblem(reference, sweep=sweep, strength=strength, failure="miss")
    problem.rare_failures(particles=20, repetitions=2, keep=0.0).save(tmp_path, shown=1)
    stated = json.loads((tmp_path / "rare.json").read_text())["disturbances"]
    of_scenario = [one["settings"] for one in stated if one["kind"] == "of the scenario"]
    assert [one["number"] for one in of_scenario] == numbers
    met = [problem.resolved.disturbances[number].scaled(strength) for number in numbers]
    assert [one["text"] for one in of_scenario] == [one.describe(problem.resolved.plant()) for one in met]
    assert len(stated) == len(problem.disturbances)


def test_a_campaign_and_a_figure_of_plans_in_belief_space(tmp_path: Path) -> None:
    """Outcomes are those of `simulate`; formulas of disturbances are those of the scenario. Sensors are drawn."""
    reference = f"{__file__}:belief_scenario"
    campaign = ls.stress.Campaign.of_sets(reference, ["scenario"], strengths=(1.0,), policies=("smooth",), trials=20)
    results = ls.stress.run_campaign(campaign, tmp_path / "runs", workers=0, batch=7)
    scenario, cell = campaign.resolved, results.cells[0]
    solution = results.runner.solutions["smooth"]
    law = ls.belief.BeliefFeedback(scenario.problem, solution)
    options: dict[str, Any] = {"goal_radius": 0.1, "disturbances": scenario.disturbances}
    run = ls.simulate(scenario.plant(), controller=law, trials=20, frames=False, contacts=False, **options)
    found = results.outcomes(cell)
    assert found.outcome.tolist() == list(run.outcome)
    assert 0 < results.cell_summaries()[cell].tally["reached"] < 20
    assert "loss 0.2" in " ".join(run.disturbances)
    whole = found.outcome != "collided"
    np.testing.assert_array_equal(found.goal[whole], run.goal_distance[whole])
    stored = ls.stress.Results(tmp_path / "runs", scenario=reference)
    assert ls.stress.replay(stored, cell, 3).outcome == (run.outcome[3],)
    others = "track", "offset_free", "replan"
    for policy in others:
        with pytest.raises(ls.InputError, match="planned in belief space"):
            ls.stress.run_campaign(dataclasses.replace(campaign, policies=(policy,)), tmp_path / policy)
    tube, one = tube_under(scenario.problem, solution, scenario.plant(), scenario.disturbances)[0], law.plan
    assert tube is not None
    alone = tube.added_to(ls.simulate(scenario.plant(), controller=law, **options))
    of, world = law.belief, scenario.scene.world
    ls.view.plot_run(one, {"disturbed": alone}, tmp_path / "run.svg", world=world, belief=of)
    ls.view.plot_policy(solution, tmp_path / "policy.svg", world=world, tube=tube, belief=of)
    for name in ("run", "policy"):
        assert "by readings alone" in (tmp_path / f"{name}.svg").read_text()
    states = np.array([[0.3, 0.4, 0.0], [-1.0, 2.0, 1.0]])  # whose distances to the beacons have unit gradients in part
    apart = states[:, None, :2] - [[-2.0, 0.0], [2.0, 0.0]]
    distance = np.sqrt(np.square(apart).sum(axis=2) + 0.01)
    information = np.square(np.linalg.norm(apart, axis=2) / distance / (0.05 * (0.1 + distance))).sum(axis=1)
    np.testing.assert_allclose(accuracy(of, states), np.sqrt(2 / information), rtol=1e-7)

"""Other people's solvers and controllers are told the problem that lqrsim solves, and gains agree with theirs.

Needs the `bench` extra, and Crocoddyl g++ too.
"""

import importlib
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sampling import rarely

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels.declarations import ROW
from lqrsim.kernels.distances import signed_distance_derivatives
from lqrsim.problem.parts import terms_of

ROBOTS = ("differential_drive", "quadrotor")


@pytest.fixture(scope="module")
def peers() -> ModuleType:
    return importlib.import_module("peers")


def crocoddyl(peers: ModuleType, problem: ls.Problem) -> Any:
    try:
        return peers.Crocoddyl(problem)
    except peers.Unavailable as error:
        pytest.skip(str(error))


def fixed(name: str) -> ls.Problem:
    """The scenario's problem from exactly the wished start."""
    problem = ls.scenarios.get(name).problem
    assert problem.start is not None
    return replace(problem, initial=ls.FixedState(problem.start))


def control_cost(problem: ls.Problem) -> ls.ControlCost:
    (cost,) = [term for term in terms_of(problem.stage_cost) if isinstance(term, ls.ControlCost)]
    return cost


def among_all_kinds(name: str) -> ls.Problem:
    """Ten steps of it among obstacles of all kinds that there are, tilted for the quadrotor."""
    problem, rng = fixed(name), np.random.default_rng(0)
    (cost,) = problem.obstacle_costs
    effort = control_cost(problem)
    kinds = {
        "sphere": (0.3, 0.0, 0.0),
        "capsule": (0.2, 0.4, 0.0),
        "cylinder": (0.3, 0.2, 0.0),
        "bar": (0.2, np.inf, 0.0),
        "box": (0.3, 0.2, 0.4),
    }
    things = []
    for kind, size in kinds.items():
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation = np.eye(3) if name == "differential_drive" else rotation
        place = rng.uniform(-1, 1, size=3)
        things.append(ls.Obstacle(kind, kind.replace("bar", "cylinder"), place, rotation, np.array(size)))
    world = ls.World([*(wall for wall in cost.world.obstacles if wall.kind == "plane"), *things])
    return replace(problem, steps=10, stage_cost=effort + ls.ObstacleCost(world, radius=cost.radius, sharpness=3.0))


def random_points(problem: ls.Problem, count: int = 40) -> list[tuple[Array, Array]]:
    """States and controls, near obstacles and inside, at turns from nothing to beyond a half."""
    rng, n = np.random.default_rng(1), len(problem.dynamics.state_coordinates)
    points: list[tuple[Array, Array]] = []
    for size in rng.choice([0.0, 1e-3, 0.3, 1.0], size=count):
        state, nominal = rng.normal(size=n), problem.nominal_control
        state[6:9] *= size
        points.append((state, nominal + 0.3 * rng.normal(size=len(nominal))))
    return points


def obstacle_cost(problem: ls.Problem, state: Array) -> tuple[float, Array, Array]:
    """Of a place, as lqrsim has it: value, gradient, and the Hessian, projected."""
    (cost,) = problem.obstacle_costs
    place = state[list(problem.dynamics.state_coordinates.position)]
    x, y, z = (*place.tolist(), 0.0)[:3]
    size, world = len(place), cost.world.seen_by("xyz"[: len(place)])
    total, slopes, curves = 0.0, np.zeros(3), np.zeros((3, 3))
    for i in range(len(world)):
        slope, curve = np.zeros(3), np.zeros((3, 3))
        distance = signed_distance_derivatives(world.table.ravel(), ROW * i, x, y, z, slope, curve)
        value = cost.weight * np.exp(-cost.sharpness * (distance - cost.radius))
        total += value
        slopes -= cost.sharpness * value * slope
        curves += cost.sharpness * value * (cost.sharpness * np.outer(slope, slope) - curve)
    values, vectors = np.linalg.eigh(curves[:size, :size])
    return total, slopes[:size], vectors * np.maximum(values, 0) @ vectors.T


@pytest.mark.parametrize("name", ROBOTS)
def test_a_plan_costs_what_lqrsim_says(peers: ModuleType, name: str) -> None:
    problem = fixed(name)
    solution = ls.smooth(problem)
    controls, states = solution.trajectory.controls, solution.trajectory.states
    np.testing.assert_allclose(peers.cost_of(problem, controls), solution.cost, rtol=1e-9)
    np.testing.assert_allclose(peers.rollout(problem, controls), states, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_clearance_is_the_distance_to_the_nearest_of_all_kinds(peers: ModuleType, name: str) -> None:
    problem = among_all_kinds(name)
    (cost,) = problem.obstacle_costs
    states = np.array([state for state, _ in random_points(problem)])
    places = states[:, list(problem.dynamics.state_coordinates.position)]
    world = cost.world.seen_by(problem.dynamics.state_coordinates.plane)
    np.testing.assert_allclose(peers.clearance_of(problem, states), world.distance(places) - cost.radius, atol=1e-12)
    for distances, place in zip(peers.truth.distances(world, places), places, strict=True):
        np.testing.assert_allclose(distances, world.distances(place), atol=1e-12)


@pytest.mark.long  # compiles C++
@pytest.mark.parametrize("name", ROBOTS)
def test_crocoddyl_is_told_the_same_problem(peers: ModuleType, name: str) -> None:
    problem = among_all_kinds(name)
    fddp, nominal = crocoddyl(peers, problem), problem.nominal_control
    size, n = len(problem.dynamics.state_coordinates.position), len(problem.dynamics.state_coordinates)
    effort = control_cost(problem)
    for state, control in random_points(problem):
        total, slope, curve = obstacle_cost(problem, state)
        off = control - nominal
        wanted = np.zeros(n), np.zeros((n, n))
        wanted[0][:size], wanted[1][:size, :size] = slope, curve
        cost, after, fx, fu, lx, lu, lxx, luu = fddp.look(5, state, control)
        a, b, _ = problem.dynamics.linearize(state, control, problem.dt)
        np.testing.assert_allclose(after, problem.dynamics.step(state, control, problem.dt), atol=1e-12)
        np.testing.assert_allclose(np.hstack([fx, fu]), np.hstack([a, b]), atol=1e-10)
        np.testing.assert_allclose(cost, total + 0.5 * off @ effort.weight @ off, rtol=1e-12)
        np.testing.assert_allclose(lx, wanted[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(lxx, wanted[1], rtol=1e-8, atol=1e-8 * np.abs(curve).max())
        np.testing.assert_allclose(lu, effort.weight @ off, rtol=1e-12)
        np.testing.assert_allclose(luu, effort.weight)
        # The start is given, and pays for no obstacle.
        np.testing.assert_allclose(fddp.look(0, state, control)[0], 0.5 * off @ effort.weight @ off, rtol=1e-12)
    for answer in (fddp.from_hover(problem), fddp.from_line(problem)):
        assert answer.converged
        np.testing.assert_allclose(peers.cost_of(problem, answer.controls), answer.cost, rtol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_ipopt_is_told_the_same_problem(peers: ModuleType, name: str) -> None:
    pytest.importorskip("casadi")
    problem = replace(among_all_kinds(name), control_limits=(-np.inf, np.inf))
    told, numbers = peers.formulas.formulas(problem), peers.formulas.parameters(problem)
    begin, between, _ = told.costs
    for state, control in random_points(problem):
        off, after = control - problem.nominal_control, problem.dynamics.step(state, control, problem.dt)
        effort = 0.5 * off @ control_cost(problem).weight @ off
        np.testing.assert_allclose(told.step(state, control, numbers).full().ravel(), after, atol=1e-12)
        np.testing.assert_allclose(float(begin(state, control, numbers)), effort, rtol=1e-9)
        cost = effort + obstacle_cost(problem, state)[0]
        np.testing.assert_allclose(float(between(state, control, numbers)), cost, rtol=1e-9)
    # From its optimum, which lqrsim has found, IPOPT has nowhere to go.
    ours = ls.smooth(problem, tolerance=1e-9)
    solver = peers.Shooting(problem, "ipopt", compile=False)
    answer = solver.solve(problem, ours.trajectory.states, ours.trajectory.controls)
    assert answer.converged
    np.testing.assert_allclose(answer.cost, ours.cost, rtol=1e-6)
    np.testing.assert_allclose(peers.cost_of(problem, answer.controls), answer.cost, rtol=1e-8)
    np.testing.assert_allclose(answer.states[0], peers.common.ends(problem)[0], atol=1e-12)


def test_ipopt_keeps_bounds_and_clearance(peers: ModuleType) -> None:
    pytest.importorskip("casadi")
    problem = fixed("differential_drive")
    low, high, clearance = -0.27, 0.27, 0.15
    ours = ls.smooth(problem).trajectory
    assert np.abs(ours.controls).max() > 0.28
    assert peers.clearance_of(problem, ours.states).min() < clearance - 0.005
    (cost,) = problem.obstacle_costs
    kept = [ls.Clearance(cost.world, radius=cost.radius, margin=clearance)]
    limited = replace(problem, control_limits=(low, high), constraints=kept)
    answer = peers.Shooting(limited, "ipopt", compile=False).solve(limited, ours.states, ours.controls)
    assert answer.converged
    assert (answer.controls >= low).all()
    assert (answer.controls <= high).all()
    states = peers.rollout(problem, answer.controls)
    np.testing.assert_allclose(states, answer.states, atol=1e-6)
    assert peers.clearance_of(problem, states)[1:].min() > clearance - 1e-6


@pytest.mark.parametrize("solver", ["Fatrop", *rarely("box-FDDP")])
@pytest.mark.parametrize("name", ["differential_drive", *rarely("quadrotor")])
def test_solvers_keep_limits_and_find_an_optimum(peers: ModuleType, name: str, solver: str) -> None:
    """From the controls of the plan without limits, cut off: iLQR has next to nothing to add to what they find."""
    problem = fixed(name)
    free, middle = ls.smooth(problem).trajectory.controls, problem.nominal_control
    low, high = middle + 0.8 * (free.min(axis=0) - middle), middle + 0.8 * (free.max(axis=0) - middle)
    limited = replace(problem, control_limits=(low, high))
    try:
        if solver == "box-FDDP":
            peer = peers.Crocoddyl(limited, box=True)
        else:
            peer = peers.Shooting(limited, "fatrop", compile=True, tol=peers.TOLERANCE)
    except peers.Unavailable as error:
        pytest.skip(str(error))
    guess = np.clip(free, low, high)
    answer = peer.solve(limited, peers.rollout(limited, guess), guess)
    assert answer.converged
    assert (answer.controls >= low).all()
    assert (answer.controls <= high).all()
    near = np.minimum(answer.controls - low, high - answer.controls) < 1e-3
    assert near.mean() > 0.1
    again = ls.ilqr(limited, start=answer.controls)
    np.testing.assert_allclose(again.cost, answer.cost, rtol=5e-4)
    np.testing.assert_allclose(peers.cost_of(problem, answer.controls), answer.cost, rtol=1e-5)
    np.testing.assert_array_equal(answer.states[0], problem.start)


def test_a_run_costs_what_its_parts_cost(peers: ModuleType) -> None:
    """Of another length than the problem's; states and controls that do not belong together."""
    problem, rng = fixed("quadrotor"), np.random.default_rng(0)
    states, controls = rng.standard_normal((8, 12)), rng.standard_normal((7, 4))
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    off = states[-1] - problem.final_cost.about
    wanted = sum(
        0.5 * (u - problem.nominal_control) @ control_cost(problem).weight @ (u - problem.nominal_control)
        for u in controls
    )
    wanted += sum(obstacle_cost(problem, x)[0] for x in states[1:-1])
    wanted += 0.5 * off @ problem.final_cost.weight @ off
    np.testing.assert_allclose(peers.cost_along(problem, states, controls), wanted, rtol=1e-9)


@pytest.fixture(scope="module")
def flight(peers: ModuleType) -> tuple[ls.Scenario, ls.Quadrotor, ls.Solution]:
    """The quadrotor's query and its plan, where RotorPy can fly it."""
    scenario = ls.scenarios.quadrotor()
    robot, solution = scenario.plant().robot, ls.smooth(scenario.problem)
    assert isinstance(robot, ls.Quadrotor)
    try:
        peers.RotorPy(robot, solution)
    except peers.Unavailable as error:
        pytest.skip(str(error))
    return scenario, robot, solution


def test_rotorpy_asks_for_the_thrust_of_the_plan_and_its_attitude(peers: ModuleType, flight: Any) -> None:
    """On the plan, turning as fast as it wants, it asks for the plan's thrust and no torque: 1e-9 N."""
    _, robot, solution = flight
    plan = solution.trajectory
    control = peers.RotorPy(robot, solution, feed_drag=True).start(1).control
    yaw_rates = peers.rotorpy.flat_outputs(robot, plan, feed_drag=True)["yaw_dot"]
    for step, (state, controls) in enumerate(zip(plan.states[:-1], plan.controls, strict=True)):
        shown = np.concatenate([state[:9], [0, 0, yaw_rates[step]]])[None]
        np.testing.assert_allclose(control(step, shown)[0], np.full(4, controls.mean()), rtol=0, atol=1e-9)


def test_rotorpy_is_told_the_motion_of_the_plan(peers: ModuleType, flight: Any) -> None:
    """Its acceleration against second differences of the position, to 0.02 m/s2 of up to 1.8: their own error."""
    _, robot, solution = flight
    plan = solution.trajectory
    told, more = (peers.rotorpy.flat_outputs(robot, plan, feed_drag=feed) for feed in (False, True))
    place = plan.states[:, :3]
    np.testing.assert_allclose(told["x_ddot"][1:], np.diff(place, 2, axis=0) / plan.dt**2, rtol=0, atol=0.02)
    drag = robot.drag / robot.mass * plan.states[:-1, 3:6]
    np.testing.assert_allclose(more["x_ddot"] - told["x_ddot"], drag, rtol=0, atol=1e-12)


def test_rotorpy_turns_the_body_back(peers: ModuleType, flight: Any) -> None:
    """To first order in the angle, about each axis: the angular acceleration of our dynamics is -attitude gain x angle.

    At an angle of 1e-4 rad, to 1e-6 of that; the rotors' layout and the sign of yaw are our dynamics', not RotorPy's.
    """
    _, robot, solution = flight
    gains = peers.rotorpy.BEST_AT_LIGHT
    control = peers.RotorPy(robot, replace_plan(solution, hover=robot.hover_force)).start(1).control
    for angle in 1e-4 * np.eye(3):
        state = np.concatenate([np.zeros(6), angle, np.zeros(3)])
        (forces,) = control(0, state[None])
        turning = robot.dynamics.rate(state, forces)[9:12]
        np.testing.assert_allclose(turning, -gains.attitude * angle, rtol=0, atol=1e-6 * gains.attitude * 1e-4)
        assert forces.sum() == pytest.approx(4 * robot.hover_force, rel=1e-6)


def replace_plan(solution: ls.Solution, *, hover: float) -> ls.Solution:
    """With a plan that hovers at the origin."""
    plan = solution.trajectory
    at_rest = ls.Trajectory(np.zeros_like(plan.states), np.full_like(plan.controls, hover), plan.dt)
    return replace(solution, trajectory=at_rest)


def test_rotorpy_flies_the_plan(peers: ModuleType, flight: Any) -> None:
    """It stays within 0.15 m of it undisturbed, and at preset light reaches the goal in more trials than the policy.

    Trials are the same alone.
    """
    scenario, robot, solution = flight
    law, plant = peers.RotorPy(robot, solution), scenario.plant()
    calm = ls.simulate(plant, solution, controller=law, frames=False)
    assert calm.outcome == ("reached",)
    assert calm.tracking_error.max() < 0.15
    disturbances = ls.disturbances.preset("light", plant)
    light, policy, last = (
        ls.simulate(
            plant, solution, controller=controller, disturbances=disturbances, frames=False, trials=20 - first,
            first_trial=first,
        )
        for controller, first in ((law, 0), (None, 0), (law, 19))
    )  # fmt: skip
    assert light.outcome.count("reached") > policy.outcome.count("reached") + 5
    np.testing.assert_array_equal(light.states[19], last.states[0])


def drake(peers: ModuleType) -> ModuleType:
    try:
        peers.drake.stationary_gains(np.eye(1), np.eye(1), np.eye(1), np.eye(1))
    except peers.Unavailable as error:
        pytest.skip(str(error))
    return peers.drake


def tracking_problem() -> tuple[Array, Array, Array, Array]:
    """A, B (a row a step), Q, R of the quadrotor, about its plan."""
    problem = ls.scenarios.quadrotor().problem
    plan = ls.smooth(problem).trajectory
    steps = [
        problem.dynamics.linearize(x, u, problem.dt)[:2] for x, u in zip(plan.states[:-1], plan.controls, strict=True)
    ]
    A, B = (np.array(each) for each in zip(*steps, strict=True))
    return A, B, np.diag(np.repeat([50.0, 5.0, 5.0, 0.5], 3)), np.eye(4)


def gains_of_smooth_lq(A: Array, B: Array, Q: Array, R: Array, Qf: Array) -> Array:
    """The gains (T, m, n) of our backward pass."""
    n = len(Q)
    solution = ls.lq.smooth_lq(
        ls.lq.Stage(A=A, B=B, Q=Q, R=R),
        initial=ls.FixedState(np.zeros(n)),
        final=ls.types.Quadratic(Qf, np.zeros(n), 0.0),
    )
    assert solution.status is ls.Status.CONVERGED
    return solution.policy.gain


def random_weights(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@pytest.mark.parametrize("radius", [0.5, 1.0, 1.7])
def test_drakes_gains_of_steps_are_those_of_a_riccati_recursion(peers: ModuleType, radius: float) -> None:
    """To 1e-12 of the largest, over sixty steps that all differ, A with eigenvalues of up to that size."""
    rng, steps, n, m = np.random.default_rng(0), 60, 4, 2
    A, B = rng.normal(size=(steps, n, n)), rng.normal(size=(steps, n, m))
    A *= radius / np.abs(np.linalg.eigvals(A)).max(axis=1)[:, None, None]
    Q, R = (np.array([random_weights(rng, size) for _ in range(steps)]) for size in (n, m))
    Qf = random_weights(rng, n)
    gains, values = drake(peers).finite_horizon_gains(A, B, Q, R, Qf)
    S = Qf
    np.testing.assert_array_equal(values[-1], S)
    for t in reversed(range(steps)):
        K = np.linalg.solve(R[t] + B[t].T @ S @ B[t], B[t].T @ S @ A[t])
        S = Q[t] + A[t].T @ S @ (A[t] - B[t] @ K)
        np.testing.assert_allclose(gains[t], K, rtol=0, atol=1e-12 * np.abs(K).max())
        np.testing.assert_allclose(values[t], S, rtol=0, atol=1e-12 * np.abs(S).max())


def test_the_backward_pass_along_a_plan_is_drakes(peers: ModuleType) -> None:
    """Tracking gains along the quadrotor's plan, to 1e-12 of the largest; and those that go on for ever, to 1e-9."""
    A, B, Q, R = tracking_problem()
    K, _ = drake(peers).finite_horizon_gains(A, B, Q, R, 3 * Q)
    np.testing.assert_allclose(gains_of_smooth_lq(A, B, Q, R, 3 * Q), -K, rtol=0, atol=1e-12 * np.abs(K).max())
    stationary, _ = peers.drake.stationary_gains(A[0], B[0], Q, R)
    As, Bs = (np.repeat(each[:1], 1000, axis=0) for each in (A, B))
    ours = gains_of_smooth_lq(As, Bs, Q, R, 3 * Q)[0]
    np.testing.assert_allclose(ours, -stationary, rtol=0, atol=1e-9 * np.abs(stationary).max())


def test_the_backward_pass_tends_to_drakes_in_continuous_time(peers: ModuleType) -> None:
    """An error proportional to the step, of a system that changes with time; and `smooth_lq_continuous` to 1e-7."""
    rng, n, m, knots = np.random.default_rng(3), 3, 2, np.linspace(0.0, 1.0, 11)
    (A0, A1), (B0, B1) = rng.normal(size=(2, n, n)), rng.normal(size=(2, n, m))
    Q, R, Qf = np.eye(n), np.eye(m), 2 * np.eye(n)

    def at(t: float) -> tuple[Array, Array]:
        return A0 + t * A1, B0 + t * B1

    A, B = (np.array(each) for each in zip(*(at(t) for t in knots), strict=True))
    K, S = drake(peers).continuous_gains(A, B, Q, R, Qf, knots)
    end = ls.types.Quadratic(Qf, np.zeros(n), 0.0)

    def stage(t: float) -> ls.lq.Stage:
        A, B = at(t)
        return ls.lq.Stage(A=A, B=B, Q=Q, R=R)

    whole = ls.lq.smooth_lq_continuous(
        stage, horizon=1.0, initial=ls.types.Quadratic(np.eye(n), np.zeros(n), 0.0), final=end
    )
    for t, value in zip(knots, S, strict=True):
        np.testing.assert_allclose(whole.cost_to_go(t).hessian, value, rtol=0, atol=1e-7 * np.abs(S).max())
    errors: list[float] = []
    for parts in (8, 16, 32, 64):
        steps = 10 * parts
        dt = 1.0 / steps
        rates = [at(dt * t) for t in range(steps)]
        A, B = np.array([np.eye(n) + dt * rate for rate, _ in rates]), np.array([dt * rate for _, rate in rates])
        errors.append(np.abs(gains_of_smooth_lq(A, B, dt * Q, dt * R, Qf)[::parts] + K[:-1]).max())
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.05)
    assert errors[-1] < 0.02 * np.abs(K).max()

"""Other people's solvers are told the problem that lqrsim solves. Needs the `bench` extra, and Crocoddyl g++ too."""

import importlib
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels.declarations import ROW
from lqrsim.kernels.signed_distance import signed_distance_derivatives
from lqrsim.problem.costs import terms_of

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
    step, _, obstacles, _, _ = peers.ipopt.functions(problem, peers.common.parts(problem))
    for state, control in random_points(problem):
        after = problem.dynamics.step(state, control, problem.dt)
        np.testing.assert_allclose(step(state, control).full().ravel(), after, atol=1e-12)
        np.testing.assert_allclose(float(obstacles(state)), obstacle_cost(problem, state)[0], rtol=1e-9)
    # From its optimum, which lqrsim has found, IPOPT has nowhere to go.
    ours = ls.smooth(problem, tolerance=1e-9)
    answer = peers.Ipopt(problem).from_trajectory(problem, ours.trajectory.states, ours.trajectory.controls)
    assert answer.converged
    np.testing.assert_allclose(answer.cost, ours.cost, rtol=1e-6)
    np.testing.assert_allclose(peers.cost_of(problem, answer.controls), answer.cost, rtol=1e-8)
    np.testing.assert_array_equal(answer.states[0], problem.start)


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
    answer = peers.Ipopt(limited).from_trajectory(limited, ours.states, ours.controls)
    assert answer.converged
    assert (answer.controls >= low).all()
    assert (answer.controls <= high).all()
    states = peers.rollout(problem, answer.controls)
    np.testing.assert_allclose(states, answer.states, atol=1e-6)
    assert peers.clearance_of(problem, states)[1:].min() > clearance - 1e-6

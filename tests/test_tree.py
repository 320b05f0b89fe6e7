"""Trees of short plans: their ways by an independent integrator and distance, their metric by dense least squares."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.integrate import solve_ivp

import lqrsim as ls
from lqrsim.solvers.budget import Stop
from lqrsim.solvers.tree import LocalPlanner, grow, in_steps_of, ways_by_trees

# A room that opens to the left: centres and half sizes of its walls. The start is inside, the goal to the right of it.
WALLS = np.array([(1.6, 0.0, 0.1, 1.1), (0.6, 1.0, 1.1, 0.1), (0.6, -1.0, 1.1, 0.1)])
RADIUS = 0.1


def pushed(x: Any, u: Any, p: Any) -> list[Any]:
    return [x.vx, x.vy, u.ax, u.ay]


def rolling(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [u.v * cos(x.a), u.v * sin(x.a), u.w]


PUSHED = ls.Dynamics(
    pushed, states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"ax": "m/s^2", "ay": "m/s^2"},
    position=("x", "y"), control_limits=(-1.0, 1.0),
)  # fmt: skip
ROLLING = ls.Dynamics(
    rolling, states={"x": "m", "y": "m", "a": "rad"}, controls={"v": "m/s", "w": "rad/s"},
    position=("x", "y"), angles=("a",), control_limits=(-0.5, 0.5),
)  # fmt: skip


def trap(dynamics: ls.Dynamics, horizon: float, **options: Any) -> ls.Problem:
    start, goal = np.zeros((2, len(dynamics.state_coordinates)))
    start[0], goal[0] = 1.2, 2.2
    walls = [
        ls.Obstacle(f"wall {k}", "box", np.array([x, y, 0]), np.eye(3), np.array([width, height, 9.0]))
        for k, (x, y, width, height) in enumerate(WALLS)
    ]
    bounds = ls.StateBounds({"x": (-2, 3), "y": (-2, 2)})
    if dynamics is PUSHED:
        bounds = ls.StateBounds({"x": (-2, 3), "y": (-2, 2), "vx": (-1, 1), "vy": (-1, 1)})
    return ls.Problem(
        dynamics=dynamics, dt=horizon / 60, steps=60, initial=ls.FixedState(start),
        stage_cost=ls.ControlCost([1e-3, 1e-3]), final_cost=ls.QuadraticCost(np.zeros(len(goal)), about=goal),
        constraints=[ls.GoalState(goal), bounds, ls.Clearance(ls.World(walls), radius=RADIUS)], **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pushed_trap() -> ls.Problem:
    return trap(PUSHED, 12.0, duration=(1.0, 60.0), time_weight=1.0)


@pytest.fixture(scope="module")
def way(pushed_trap: ls.Problem) -> ls.Trajectory:
    return first_way(pushed_trap)


def first_way(problem: ls.Problem) -> ls.Trajectory:
    found = next((one for seed in range(4) if (one := grow(problem, seed=seed)) is not None), None)
    assert found is not None
    return found


def clearances(states: np.ndarray) -> np.ndarray:
    """The distance to the nearest wall, minus the radius."""
    outside = np.abs(states[:, None, :2] - WALLS[:, :2]) - WALLS[:, 2:]
    inside = np.minimum(outside.max(axis=2), 0.0)
    return (np.linalg.norm(np.maximum(outside, 0.0), axis=2) + inside).min(axis=1) - RADIUS


def test_a_way_follows_the_dynamics_but_for_a_jump_and_keeps_clear(pushed_trap: ls.Problem, way: ls.Trajectory) -> None:
    assert np.array_equal(way.states[[0, -1]], [[1.2, 0, 0, 0], [2.2, 0, 0, 0]])
    reached = np.array([
        solve_ivp(lambda t, x, u=u: [x[2], x[3], *u], (0, way.dt), x, rtol=1e-10, atol=1e-12).y[:, -1]
        for x, u in zip(way.states[:-1], way.controls, strict=True)
    ])  # fmt: skip
    jumps = np.abs(reached - way.states[1:])
    # A Runge-Kutta step of these dynamics is exact; what is left is the integrator's error.
    assert (jumps.max(axis=1) > 1e-8).sum() <= 1
    # The mean square relative to a tenth of the half ranges, (2.5, 2, 1, 1), is less than 1: each is below 2 of them.
    assert (jumps < 2 * 0.1 * np.array([2.5, 2.0, 1.0, 1.0])).all()
    assert clearances(way.states).min() >= -1e-6
    assert (np.abs(way.states) <= [3, 2, 1, 1]).all()
    assert (np.abs(way.controls) <= 1).all()


def test_the_same_seed_leads_to_the_same_way(pushed_trap: ls.Problem, way: ls.Trajectory) -> None:
    again = first_way(pushed_trap)
    assert np.array_equal(again.states, way.states)
    assert np.array_equal(again.controls, way.controls)
    assert grow(pushed_trap, seed=0, extensions=2) is None


def test_a_way_leads_to_a_plan_out_of_the_trap(pushed_trap: ls.Problem, way: ls.Trajectory) -> None:
    start = in_steps_of(pushed_trap, way)
    assert start.horizon == pytest.approx(way.horizon)
    solution = ls.smooth(dataclasses.replace(pushed_trap, dt=start.dt), start=start)
    assert solution.success
    assert clearances(solution.trajectory.states).min() >= -1e-6
    # At full thrust between stops it takes 2 sqrt(d) s for d m, and there are more than 5 m round the walls.
    assert 2 * np.sqrt(5) < solution.trajectory.horizon < way.horizon


def test_in_the_steps_of_a_problem_a_way_keeps_its_ends_and_mean_controls(way: ls.Trajectory) -> None:
    fixed = trap(PUSHED, 9.0)
    start = in_steps_of(fixed, way)
    assert start.states.shape == (61, 4)
    assert start.horizon == pytest.approx(9.0)
    assert np.array_equal(start.states[[0, -1]], way.states[[0, -1]])
    assert start.controls.mean(axis=0) == pytest.approx(way.controls.mean(axis=0))  # sums, but for rounding


def round_walls(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import Abs, Max

    return [Max(Abs(x.x - at) - w, Abs(x.y - up) - h) - RADIUS for at, up, w, h in WALLS]


@pytest.mark.parametrize(
    "options", [{"duration": (1.0, 15.0), "time_weight": 1.0}, {}], ids=["free duration", "fixed duration"]
)
def test_a_solve_grows_trees_where_no_path_is_known(pushed_trap: ls.Problem, options: dict[str, Any]) -> None:
    """Without a position there are no shortest paths. In 15 s and 60 steps none is so long that it jumps a wall."""
    nameless = ls.Dynamics(
        pushed, states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"ax": "m/s^2", "ay": "m/s^2"},
        control_limits=(-1.0, 1.0),
    )  # fmt: skip
    goal_and_bounds = pushed_trap.constraints[:2]
    problem = dataclasses.replace(
        trap(PUSHED, 10.0, **options), dynamics=nameless, initial=ls.FixedState([1.0, 0, 0, 0]),
        constraints=[*goal_and_bounds, ls.SymbolicConstraint(round_walls)],
    )  # fmt: skip
    solution = ls.smooth(problem, time_limit=600.0)  # it ends with the first plan
    assert solution.success
    assert clearances(solution.trajectory.states).min() >= -1e-6
    assert np.array_equal(solution.trajectory.states[0], [1.0, 0, 0, 0])
    assert solution.trajectory.states[-1] == pytest.approx([2.2, 0, 0, 0], abs=1e-6)
    led = [one.start for one in solution.candidates if one.status is ls.Status.CONVERGED]
    assert len(led) == 1
    assert led[0].startswith("trees of short plans, seed ")


def test_trees_grow_until_the_time_is_over_and_not_where_they_cannot(pushed_trap: ls.Problem) -> None:
    stop = Stop()
    for limit in (0.0, None):
        stop.begin(limit)
        assert not list(ways_by_trees(pushed_trap, stop))
    stop.begin(600.0)
    seeds = [seed for seed, _ in itertools.islice(ways_by_trees(pushed_trap, stop), 2)]
    assert len(set(seeds)) == 2
    inside = dataclasses.replace(pushed_trap, initial=ls.FixedState([1.6, 0, 0, 0]))
    for problem in (inside, pushed_trap.with_constraints(pushed_trap.constraints[:2])):
        assert not list(ways_by_trees(problem, stop))


def test_headings_reach_their_goals_up_to_whole_turns() -> None:
    problem = trap(ROLLING, 20.0)
    way = first_way(problem)
    turns = way.states[-1, 2] / (2 * np.pi)
    assert turns == pytest.approx(round(turns))
    assert clearances(way.states).min() >= -1e-6


def test_the_metric_is_the_least_cost_of_time_and_controls(pushed_trap: ls.Problem) -> None:
    """Beside dense least squares: k + 1/2 |u|^2 over k steps, to end near a state."""
    planner = LocalPlanner(pushed_trap, np.zeros(4), np.ones(4), 10)
    state, target, dt = np.array([0.3, -0.2, 0.5, 0.1]), np.array([0.6, 0.1, 0.2, -0.3]), pushed_trap.dt
    reach = planner.reach(state, 1)
    assert reach is not None
    spread = planner._spread
    for root, mean, constant, steps in zip(*reach, planner.arrivals, strict=True):
        found = constant + np.sum((root @ target - mean) ** 2) / 2
        later = dt * np.arange(steps - 1, -1, -1.0)
        push = np.kron(np.vstack([dt * later + dt**2 / 2, np.full(steps, dt)]), np.eye(2))
        drift = np.concatenate([state[:2] + steps * dt * state[2:], state[2:]])
        rows = np.vstack([np.eye(2 * steps), push / spread[:, None]])
        wanted = np.concatenate([np.zeros(2 * steps), (target - drift) / spread])
        least = np.linalg.lstsq(rows, wanted, rcond=None)[0]
        assert found == pytest.approx(steps + np.sum((rows @ least - wanted) ** 2) / 2, rel=1e-8)


@settings(max_examples=examples(20))
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, -1]))
def test_short_plans_stay_as_they_are_while_others_are_made(pushed_trap: ls.Problem, seed: int, sign: int) -> None:
    """Others may be of another thread, and have the memory that the first one gave back."""
    planner = LocalPlanner(pushed_trap, np.zeros(4), np.ones(4), 10)
    ends = np.random.default_rng(seed).normal(size=(4, 4))
    plan, come = planner._smoothed(ends[0], sign, 8, 3, ends[1])
    before = [array.copy() for array in (*plan, *come)]
    planner._smoothed(ends[2], sign, 8, 3, ends[3])
    assert all(map(np.array_equal, (*plan, *come), before))


def test_without_a_goal_or_steps_backwards_there_is_no_way(pushed_trap: ls.Problem) -> None:
    aimless = pushed_trap.with_constraints(pushed_trap.constraints[1:])
    assert grow(aimless, seed=0) is None
    falling = ls.Dynamics(lambda x, u, p: [x.h + u.v], states={"h": "m"}, controls={"v": "m"}, period=0.1)
    mapped = ls.Problem(
        dynamics=falling, dt=0.1, steps=10, initial=ls.FixedState([0.0]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0], about=[1.0]),
    )  # fmt: skip
    assert grow(mapped, seed=0) is None


@pytest.mark.parametrize("growth", [1.0, 10.0, 30.0, 100.0])
def test_trees_survive_what_diverges(growth: float) -> None:
    """One control moves two states alike: the covariance of e^(2 growth t) is singular but for what rounding leaves."""

    def diverging(x: Any, u: Any, p: Any) -> list[Any]:
        return [p.growth * x.a + u.f, p.growth * x.b + u.f]

    dynamics = ls.Dynamics(
        diverging, states={"a": "m", "b": "m"}, controls={"f": "m/s"}, parameters={"growth": growth},
        position=("a", "b"), plane="xy", control_limits=(-1.0, 1.0),
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=20, initial=ls.FixedState([0.1, 0.2]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0, 1.0], about=[1.0, -1.0]),
    )  # fmt: skip
    planner = LocalPlanner(problem, np.array([0.1, 0.2]), np.array([1.0, -1.0]), 20)
    reach = planner.reach(np.array([0.1, 0.2]), 1)
    assert reach is not None if growth == 1.0 else reach is None or np.isfinite(reach.root).all()

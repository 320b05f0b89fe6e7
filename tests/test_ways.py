"""Ways from start to goal: closed forms of shortest paths, symmetry, and plans that a rollout does not lead to."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples

import lqrsim as ls
from lqrsim.kernels.records import Motion
from lqrsim.results.solution_parts import Status
from lqrsim.solvers.multistart import _other_axes, ways
from lqrsim.solvers.stages import Stages

PLANE = {"x": "m", "y": "m", "a": "rad"}
FALLING = {**PLANE, "vx": "m/s", "vy": "m/s", "w": "rad/s"}


def rolling(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [u.v * cos(x.a + p.mounted), u.v * sin(x.a + p.mounted), u.w]


def falling(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    lift = (u.left + u.right) * 9.81 / 2
    return [x.vx, x.vy, x.w, -lift * sin(x.a), lift * cos(x.a) - 9.81, 160.0 * (u.left - u.right)]


def wheels(mounted: float = 0.0, slowest: float = -0.1) -> ls.Dynamics:
    return ls.Dynamics(
        rolling, states=PLANE, controls={"v": "m/s", "w": "rad/s"}, parameters={"mounted": mounted},
        position=("x", "y"), angles=("a",), control_limits={"v": (slowest, 0.5), "w": (-0.5, 0.5)},
    )  # fmt: skip


ROTORS = ls.Dynamics(
    falling, states=FALLING, controls={"left": "", "right": ""}, position=("x", "y"), angles=("a",),
    control_limits=(0.0, 1.3),
)  # fmt: skip


def stated(dynamics: ls.Dynamics, start: Any, goal: Any, *constraints: ls.Constraint, **options: Any) -> ls.Problem:
    effort = ls.ControlCost([1e-6, 1e-6], about=[1.0, 1.0] if dynamics is ROTORS else None)
    weights = [0.0 if name == "a" else 1.0 for name in dynamics.state_coordinates.names]
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=60, initial=ls.FixedState(start), stage_cost=effort,
        final_cost=ls.QuadraticCost(weights, about=goal), constraints=[ls.GoalState(goal), *constraints], **options,
    )  # fmt: skip


def pillar(radius: float, *, height: float = 0.0) -> ls.Clearance:
    """Beside a disc at (2, height), which a point must not enter."""
    world = ls.World([ls.Obstacle("pillar", "sphere", np.array([2.0, height, 0]), np.eye(3), np.array([radius, 0, 0]))])
    return ls.Clearance(world, radius=1e-3)


def found(problem: ls.Problem) -> dict[str, np.ndarray]:
    return {way.name: way.over(problem).states for way in ways(problem, Stages(problem))}


def length(states: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum())


@settings(max_examples=examples(6))
@given(st.floats(0.3, 1.2), st.floats(-0.2, 0.2))
def test_the_shortest_path_round_a_disc_is_two_tangents_and_an_arc(radius: float, height: float) -> None:
    """And the second path passes on the other side.

    A path on a grid of eight directions is at most 8 % too long; what it cuts of corners, and rounds, is not more.
    """
    problem = stated(wheels(), [0.0, 0, 0], [4.0, 0, 0], pillar(radius, height=height))
    ahead = [states for name, states in found(problem).items() if "forwards" in name]
    tangents, lengths = np.sqrt(4 + height**2 - (radius + 1e-3) ** 2), []
    for side in (1, -1):
        off = np.arctan2(side * height, 2.0)
        arc = np.pi - 2 * np.arccos((radius + 1e-3) / np.hypot(2.0, height)) - 2 * off
        lengths.append(2 * tangents + (radius + 1e-3) * arc)
    sides = [np.sign(states[np.abs(states[:, 0] - 2).argmin(), 1] - height) for states in ahead]
    assert set(sides) == {-1.0, 1.0}
    assert length(ahead[0]) == pytest.approx(min(lengths), rel=0.08)


@pytest.mark.parametrize("mounted", [0.0, 2.0])
def test_a_robot_on_wheels_heads_along_its_path(mounted: float) -> None:
    """Forwards, though the angle has another zero; backwards, it heads the other way. Corners are a few knots."""
    problem = stated(wheels(mounted), [0.0, 0, 0], [4.0, 0, 0], pillar(0.8))
    for name, states in found(problem).items():
        if "path" in name:
            step, heading = np.diff(states[1:, :2], axis=0), states[1:-1, 2] + mounted
            along = np.cos(heading) * step[:, 0] + np.sin(heading) * step[:, 1]
            sign = 1 if "forwards" in name else -1
            assert np.median(sign * along / np.linalg.norm(step, axis=1)) > 0.99


def test_a_robot_that_falls_has_no_heading_and_rates_are_those_of_the_line() -> None:
    problem = stated(ROTORS, [0.0] * 6, [2.0, 0, 0, 0, 0, 0])
    states = found(problem)["a line of states, a turn more of a"]
    np.testing.assert_allclose(states[1:-1, 3], 2.0 / 6.0, rtol=1e-9)
    np.testing.assert_allclose(states[1:-1, 5], 2 * np.pi / 6.0, rtol=1e-9)
    assert states[-1, 2] == 2 * np.pi


def test_upside_down_a_robot_rights_itself_by_the_shorter_turn_or_the_other() -> None:
    """In least time, from where every rollout falls. Mirrored, the problem takes as long."""
    horizons = []
    for turned in (3.0, -3.0):
        problem = stated(
            ROTORS, [0, 1, turned, 0, 0, 0], [0, 1, 0, 0, 0, 0], ls.StateBounds({"m/s": (-4, 4), "rad/s": (-8, 8)}),
            duration=(0.1, 20.0), time_weight=1.0,
        )  # fmt: skip
        solution = ls.smooth(problem)
        assert solution.success
        assert solution.violation <= 1e-6
        assert any(one.start.startswith("a line of states, a turn less of a") for one in solution.candidates)
        end = solution.trajectory.states[-1, 2]
        assert end == pytest.approx(2 * np.pi * round(end / (2 * np.pi)), abs=1e-6)
        horizons.append(solution.trajectory.horizon)
    assert horizons[0] == pytest.approx(horizons[1], rel=1e-3)


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_a_large_turn_also_leads_about_other_axes(turn: list[float]) -> None:
    """By half of the turn aside, perpendicular to it; a turn by less than a right angle goes straight."""
    dynamics = ls.Dynamics(
        lambda x, u, p: ls.rotations.vector_rate(x, u), states=dict.fromkeys(("rx", "ry", "rz"), "rad"),
        controls=dict.fromkeys(("wx", "wy", "wz"), "rad/s"), rotation_vectors=[("rx", "ry", "rz")],
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=60, initial=ls.FixedState(turn), stage_cost=ls.ControlCost(np.ones(3)),
        final_cost=ls.QuadraticCost(np.ones(3), about=np.zeros(3)),
    )  # fmt: skip
    line, size = np.linspace(turn, np.zeros(3), 61), float(np.linalg.norm(turn))
    drawn = [way.states for way in _other_axes(problem, line)]
    assert bool(drawn) == (size > np.pi / 2)
    for states in drawn:
        np.testing.assert_allclose(states[[0, -1]], line[[0, -1]], atol=1e-12)
        aside = states[30] - line[30]
        assert np.linalg.norm(aside) == pytest.approx(size / 2)
        assert abs(aside @ turn) < 1e-12 * size**2
    assert len(np.unique(np.round(drawn, 6), axis=0)) == len(drawn)


def test_a_robot_that_cannot_stop_drives_half_a_circle_to_turn_round() -> None:
    """To a place beside it, a diameter away: in no less time than half a turn takes at the fastest turn, and in that.

    At the speed with which the half circle ends there. A rollout of the nominal controls does not turn at all.
    """
    fastest, turning = 0.5, 0.5
    goal = [0.0, 2 * fastest / turning, np.pi]
    problem = stated(wheels(slowest=0.3), [0.0, 0, 0], goal, duration=(1.0, 60.0), time_weight=1.0)
    solution = ls.smooth(problem)
    assert solution.success
    assert solution.trajectory.horizon == pytest.approx(np.pi / turning, rel=1e-3)


@settings(max_examples=examples(25))
@given(st.floats(-20, 20), st.floats(-20, 20), st.booleans())
def test_an_angle_reaches_its_goal_up_to_whole_turns(end: float, goal: float, count: bool) -> None:
    """As `numpy.remainder` says, unless turns count."""
    problem = stated(wheels(), [0.0, 0, 0], [0, 0, 0]).with_constraints([ls.GoalState(a=goal, count_turns=count)])
    states = np.zeros((61, 3))
    states[-1, 2] = end
    missed = Stages.lent(problem).values(Motion(states, np.zeros((60, 2))))[-1, 0]
    off = end - goal if count else np.remainder(end - goal + np.pi, 2 * np.pi) - np.pi
    assert abs(missed) == pytest.approx(abs(off), abs=1e-12)


def test_a_search_by_ways_is_the_same_again_and_given_a_start_there_is_none() -> None:
    problem = stated(
        wheels(), [0.0, 0, 0], [4.0, 0, 0], pillar(1.0), duration=(1.0, 60.0), time_weight=1.0,
    )  # fmt: skip
    first, again = ls.smooth(problem), ls.smooth(problem)
    assert first.success
    assert np.array_equal(first.trajectory.states, again.trajectory.states)
    assert [one.start for one in first.candidates] == [one.start for one in again.candidates]
    assert ls.smooth(problem, start=first).candidates == ()


def test_a_trap_is_left_with_a_fixed_duration() -> None:
    """Out of a pocket of three walls towards its closed end; straight ahead there is no way."""
    walls = [(2.0, 0.0, 0.1, 1.0), (1.2, 1.0, 0.9, 0.1), (1.2, -1.0, 0.9, 0.1)]
    world = ls.World([
        ls.Obstacle(f"wall {i}", "box", np.array([x, y, 0]), np.eye(3), np.array([a, b, 1.0]))
        for i, (x, y, a, b) in enumerate(walls)
    ])  # fmt: skip
    bounds = ls.StateBounds(x=(-2, 5), y=(-3, 3))
    problem = stated(wheels(), [1.5, 0, 0], [3.5, 0, 0], ls.Clearance(world, radius=0.2), bounds)
    solution = ls.smooth(dataclasses.replace(problem, dt=0.5))
    assert solution.success
    assert solution.clearance is not None
    assert solution.clearance.min() >= -1e-6
    converged = [one.start for one in solution.candidates if one.status is Status.CONVERGED]
    assert converged
    assert all("round obstacles" in start for start in converged)


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("height", [0.0, 0.4])
@pytest.mark.parametrize("free", [False, True])
def test_ways_of_few_steps(steps: int, height: float, free: bool) -> None:
    """Those of one step have no knot between start and goal. It jumps over the pillar, for which it needs its time."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0], u[1]], states={"x": "m", "y": "m"}, controls={"u": "m/s", "v": "m/s"},
        position=("x", "y"), control_limits=(-2.0, 2.0),
    )  # fmt: skip
    options: dict[str, Any] = {"duration": (0.1, 20.0), "time_weight": 1.0} if free else {}
    problem = dataclasses.replace(
        stated(dynamics, [0.0, 0.0], [4.0, 0.0], pillar(0.5, height=height)), dt=0.6 / steps, steps=steps, **options
    )
    solution = ls.smooth(problem, max_iterations=50)
    assert solution.status is (Status.CONVERGED if free else Status.INFEASIBLE)
    if free and steps % 2:
        assert solution.trajectory.horizon == pytest.approx(2.0, rel=1e-6)

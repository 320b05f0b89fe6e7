"""Bounds of states that change from knot to knot: the conditions of an optimum, and what moves the bounds with time."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import constraints
from sampling import examples, is_short
from shooting import Shooting
from systems import linear

import lqrsim as ls
from lqrsim.errors import Array

DT = 0.1
CART = ls.Dynamics(lambda x, u, p: [x.v, u.push], states={"x": "m", "v": "m/s"}, controls={"push": "m/s^2"})
PUCK = ls.Dynamics(
    lambda x, u, p: [x.vx, x.vy, u.ax, u.ay], states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
    controls={"ax": "m/s^2", "ay": "m/s^2"}, position=("x", "y"),
)  # fmt: skip


def cart(steps: int = 20, **changed: Any) -> ls.Problem:
    stated = ls.Problem(
        dynamics=CART, dt=DT, steps=steps, initial=ls.FixedState(x=0.0, v=0.0), stage_cost=ls.ControlCost([0.1]),
        final_cost=ls.QuadraticCost({"x": 100.0, "v": 100.0}, about={"x": 1.0}),
    )  # fmt: skip
    return dataclasses.replace(stated, **changed)


def drawn(seed: int, steps: int, n: int, m: int) -> tuple[ls.Problem, Array, Array]:
    """A linear problem with bounds at some knots, and these bounds (T+1, n)."""
    rng = np.random.default_rng(seed)
    a, b, start = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=n)
    problem = ls.Problem(
        dynamics=linear(a, b), dt=DT, steps=steps, initial=ls.FixedState(start),
        stage_cost=ls.QuadraticCost(np.eye(n), about=np.zeros(n)) + ls.ControlCost(0.1 * np.ones(m)),
        final_cost=ls.QuadraticCost(10 * np.eye(n), about=np.zeros(n)),
    )  # fmt: skip
    # A feasible plan, about which some states have bounds at some knots.
    there = Shooting(problem).points(0.5 * rng.normal(size=steps * m))[:, :n]
    acts = rng.random((2, steps + 1, n)) < 0.4
    low = np.where(acts[0], there - rng.uniform(0.01, 0.3, there.shape), -np.inf)
    high = np.where(acts[1], there + rng.uniform(0.01, 0.3, there.shape), np.inf)
    acting = [i for i in range(n) if np.isfinite([low[:, i], high[:, i]]).any()]
    sides: dict[str, tuple[Any, Array]] = {f"x{i}": (low[:, i], high[:, i]) for i in acting}
    if n > 1 and rng.random() < 0.5 and "x0" in sides:  # a bound that holds at all knots beside
        low[:, 0], least = there[:, 0].min() - 0.1, float(there[:, 0].min() - 0.1)
        sides["x0"] = (least, sides["x0"][1])
    return dataclasses.replace(problem, constraints=[ls.StateBounds(sides)] if sides else []), low, high


# Of states and controls: where few are drawn, those for which other tests have solvers.
SIZES = [(2, 1), (3, 2), (2, 2) if is_short() else (1, 1)]


@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**31), steps=st.integers(1, 8), size=st.sampled_from(SIZES))
def test_plans_meet_the_conditions_of_an_optimum(seed: int, steps: int, size: tuple[int, int]) -> None:
    """The problem is convex, so that this is the optimum. The cost is right to 1e-10, and the slope to its root."""
    problem, low, high = drawn(seed, steps, *size)
    solution = ls.smooth(problem, tolerance=1e-10)
    assert solution.success
    states = solution.trajectory.states[1:]
    assert (states >= low[1:] - 1e-9).all()
    assert (states <= high[1:] + 1e-9).all()
    found = Shooting(problem).conditions(solution)
    assert found.slope < 1e-4
    assert found.sign == 0
    assert found.spare < 1e-7  # a product of what is right to 1e-9 and multipliers of some tens
    assert found.violation <= 1e-9


@pytest.mark.parametrize("finish", ["newton", None])
def test_the_same_bound_at_each_knot_is_one_bound(finish: Any) -> None:
    """To the last bit."""
    once = cart(constraints=[ls.StateBounds(x=(-np.inf, 1.02), v=(-0.2, 0.7))])
    each = cart(constraints=[ls.StateBounds(x=(-np.inf, 1.02), v=(np.full(21, -0.2), np.full(21, 0.7)))])
    one, other = ls.smooth(once, finish=finish), ls.smooth(each, finish=finish)
    assert one.success
    assert one.cost == other.cost
    np.testing.assert_array_equal(one.trajectory.states, other.trajectory.states)
    assert once.digest != each.digest


def test_a_gate_is_passed_while_it_is_open_and_a_waypoint_is_met() -> None:
    """A gate at x = 0.5 opens after 1.6 s; and at 0.5 s the cart is to have been 0.2 m back."""
    closed, waypoint = np.full(21, np.inf), np.full(21, np.inf)
    closed[:17], waypoint[5] = 0.5, -0.2
    gate, there = ls.StateBounds(x=(-np.inf, closed)), ls.StateBounds(x=(-np.inf, waypoint))
    solution = ls.smooth(cart(constraints=[gate, there]))
    x = solution.trajectory.states[:, 0]
    assert solution.success
    assert x[16] == pytest.approx(0.5, abs=1e-6)  # both press
    assert x[5] == pytest.approx(-0.2, abs=1e-6)
    assert x[-1] > 0.6
    assert solution.multipliers[0].values[16] > 0
    assert solution.multipliers[1].values[5] > 0


def test_they_move_with_time() -> None:
    """The rest of a plan has the bounds that are left, a moving horizon repeats the last; so has a margin by knot."""
    ball = ls.Obstacle("ball", "sphere", np.array([9.0, 0.0, 0.0]), np.eye(3), np.array([1.0, 0.0, 0.0]))
    high, world = 1.0 + 0.1 * np.arange(21), ls.World([ball])
    bounds, clear = ls.StateBounds(x=(-1.0, high)), ls.Clearance(world, radius=0.1, margin=0.01 * np.arange(21))
    stated = ls.Problem(
        dynamics=PUCK, dt=DT, steps=20, initial=ls.FixedState([0.0, 0.0, 0.0, 0.0]),
        stage_cost=ls.ControlCost([0.1, 0.1]), final_cost=ls.QuadraticCost({"m": 100.0}, about={"x": 1.0}),
        constraints=[bounds, ls.StateBounds(vx=(-5.0, 5.0)), clear],
    )  # fmt: skip
    rest, later = stated.from_state(np.zeros(4), after=4), stated.later(4 * DT)
    ends = [one.constraints[0].bounds["x"][1] for one in (rest, later)]  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_array_equal(ends[0], high[4:])
    np.testing.assert_array_equal(ends[1], [*high[4:], *high[-1:].repeat(4)])
    margins = [one.constraints[2].margin for one in (rest, later)]  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_array_equal(margins[0], 0.01 * np.arange(4, 21))
    np.testing.assert_array_equal(margins[1], 0.01 * np.array([*range(4, 21), 20, 20, 20, 20]))
    assert later.digest != stated.digest
    assert later.constraints[1] is stated.constraints[1]
    with pytest.raises(ls.InputError, match=r"seconds: got 0.25, want a multiple of dt"):
        stated.later(0.25)


@pytest.mark.parametrize("horizon", ["shrinking", "moving"])
def test_replanning_keeps_them_at_their_times(horizon: Any) -> None:
    """A solve at each step, from where the plan is then, changes nothing: the plan is optimal for what is left."""
    closed = np.full(21, np.inf)
    closed[:13] = 0.5
    stated = cart(constraints=[ls.StateBounds(x=(-np.inf, closed))])
    plan = ls.smooth(stated, tolerance=1e-12)
    here, after = plan.trajectory.states[8], 8
    problem = stated.from_state(here, after=after) if horizon == "shrinking" else stated.later(after * DT)
    again = ls.smooth(problem.from_state(here), tolerance=1e-12)
    x = again.trajectory.states[:, 0]
    assert x[4] <= 0.5 + 1e-9
    if horizon == "shrinking":
        np.testing.assert_allclose(x, plan.trajectory.states[after:, 0], atol=1e-5)
    else:
        assert x.max() > 0.6


@pytest.mark.parametrize("after", [12, 13, 19])
@pytest.mark.parametrize("horizon", ["shrinking", "moving"])
def test_bounds_that_are_over_hold_nothing(horizon: str, after: int) -> None:
    """The gate is closed up to knot 12; of what is left after that, the plan is the one without a gate."""
    closed = np.full(21, np.inf)
    closed[:13] = 0.5

    def rest(problem: ls.Problem) -> ls.Problem:
        if horizon == "moving":
            problem, gone = problem.later(after * DT), 0
        else:
            gone = after
        return problem.from_state([0.45, 0.3], after=gone)

    gated, free = (ls.smooth(rest(cart(constraints=kept))) for kept in ([ls.StateBounds(x=(-np.inf, closed))], []))
    assert gated.success
    assert gated.cost == pytest.approx(free.cost, rel=1e-9)


def test_violations_of_runs_are_counted_knot_by_knot() -> None:
    closed = np.full(21, np.inf)
    closed[:13] = 0.5
    stated = cart(constraints=[ls.StateBounds(x=(-np.inf, closed))])
    hasty = ls.smooth(cart())
    over = float((hasty.trajectory.states[1:13, 0] - 0.5).max())
    kept = constraints.of(stated)[0]
    assert over > 0.01
    assert kept.violation(constraints.points(hasty.trajectory)) == pytest.approx(over)
    begun = ls.smooth(stated, start=hasty.trajectory)
    assert begun.success
    assert begun.trajectory.states[1:13, 0].max() <= 0.5 + 1e-9


def test_a_free_duration_keeps_them_at_their_knots() -> None:
    closed = np.full(21, np.inf)
    closed[:13] = 0.5
    stated = cart(constraints=[ls.StateBounds(x=(-np.inf, closed)), ls.GoalState(x=1.0, v=0.0)])
    solution = ls.smooth(dataclasses.replace(stated, duration=(1.5, 4.0), time_weight=1.0))
    assert solution.success
    assert solution.trajectory.states[12, 0] <= 0.5 + 1e-6


def test_numbers_that_do_not_fit_the_problem_are_named() -> None:
    with pytest.raises(ls.InputError, match="StateBounds: x: got 20 numbers, want one, or one for each of 21 knots"):
        cart(constraints=[ls.StateBounds(x=(np.zeros(20), 1.0))])
    crossing = [ls.StateBounds(x=(-np.inf, np.arange(21.0))), ls.StateBounds(x=(3.0, np.inf))]
    with pytest.raises(ls.InputError, match="x of at least 3 and at most 0 at knot 0, want bounds with room"):
        cart(constraints=crossing)
    low = ls.StateBounds(x=(np.linspace(0, 2, 21) - 1, np.inf))
    cart(constraints=[low, ls.GoalState(x=1.0)])
    with pytest.raises(ls.InputError, match=r"got a goal of 0.9 m for x, want x of at least -1 to 1 m"):
        cart(constraints=[low, ls.GoalState(x=0.9)])

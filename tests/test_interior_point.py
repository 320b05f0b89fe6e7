"""Constraints and limits to the end: against conditions of first order worked out anew, SciPy's SLSQP, closed forms."""

import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.linalg
import sympy
from hypothesis import HealthCheck, example, given, settings
from sampling import examples, rarely
from shooting import Shooting

import lqrsim as ls
from lqrsim.kernels.records import Motion
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.solvers.stages import STRONG, InteriorPoint, Stages

DT = 0.1
# A state, a speed, a control and the cost in another unit: by how much their numbers are larger.
UNITS: Mapping[str, float] = {"place": 1.0, "speed": 1.0, "force": 1.0, "cost": 1.0}


def swing(x, u, p):
    """A pendulum, or without `pull` a mass on a line; in any units."""
    from sympy import sin

    push = p.push * u[0] / p.force - p.pull * sin(x[0] / p.place) - p.drag * x[1] / p.speed
    return [p.place / p.speed * x[1], p.speed * push]


def power(x, u, p):
    """No more power than that, nor more effort and speed together."""
    return [
        p.power - u[0] * x[1] / (p.force * p.speed),
        p.most - (u[0] / p.force) ** 2 - p.beside * (x[1] / p.speed) ** 2,
    ]


def meeting(x, u, p):
    return x[0] / p.place + p.share * x[1] / p.speed + p.bent * (x[0] / p.place) ** 2 - p.there


def system(
    *, pull: float = 0.0, push: float = 1.0, drag: float = 0.0, units: Mapping[str, float] = UNITS
) -> ls.Dynamics:
    numbers = {name: units[name] for name in ("place", "speed", "force")}
    return ls.Dynamics(
        swing, states={"x": "m", "v": "m/s"}, controls={"u": "N"},
        parameters={"pull": pull, "push": push, "drag": drag, **numbers},
    )  # fmt: skip


def problem(
    *constraints: ls.Constraint, dynamics: ls.Dynamics | None = None, start: Any = (0.0, 0.0), goal: Any = (1.0, 0.0),
    effort: float = 1.0, final: Any = (1.0, 1.0), on_the_way: Any = (0.0, 0.0), limit: float = np.inf, steps: int = 15,
    soft: float | None = None, more: ls.Cost | None = None,
) -> ls.Problem:  # fmt: skip
    stage = ls.ControlCost([effort], about=[0.0]) + ls.QuadraticCost(on_the_way, about=goal)
    return ls.Problem(
        dynamics=system() if dynamics is None else dynamics, dt=DT, steps=steps,
        initial=ls.FixedState(start) if soft is None else ls.QuadraticCost([soft, soft], about=start),
        stage_cost=stage, final_cost=ls.QuadraticCost(final, about=goal) if more is None else more,
        constraints=constraints, control_limits=(-limit, limit) if np.isfinite(limit) else None,
    )  # fmt: skip


def solved(of: ls.Problem, **options: Any) -> ls.Solution:
    solution = ls.smooth(of, **options)
    assert solution.status is Status.CONVERGED, solution.summary()
    return solution


def is_optimal(of: ls.Problem, solution: ls.Solution, tolerance: float = 1e-5) -> None:
    found = Shooting(of).conditions(solution)
    assert found.violation <= solution.options["constraint_tolerance"], found  # pyright: ignore[reportOperatorIssue]
    assert found.sign == 0, found
    acts = any(one.values.any() for one in solution.multipliers)
    # Without constraints that act, 1e-8 is what a step promises: slopes are about the root of that, and of weights that
    # are up to 1e4 apart.
    assert max(found.slope, found.pressing, found.spare) < (tolerance if acts else 1e-2), found


def reached(x, u, p):
    return -p.worth * x[0]


def racing(*constraints: ls.Constraint, limit: float = 1.0) -> ls.Problem:
    """As far as possible in the time there is."""
    of = problem(*constraints, limit=limit)
    nothing = ls.QuadraticCost([0.0, 0.0], about=[0.0, 0.0])
    final = ls.SymbolicCost(reached, parameters={"worth": 1.0}, convex=True)
    return replace(of, stage_cost=nothing, final_cost=final)


# Whole problems that can be solved: what is asked for is kept by a motion that was drawn first.


def drawn(number: int) -> ls.Problem:
    """One with bounds, goals, limits of any kind, or none, and weights over four decades."""
    rng = np.random.default_rng(number)
    limit, steps, start = rng.choice([np.inf, 2.0, 5.0]), int(rng.integers(8, 20)), rng.uniform(-1, 1, 2)
    dynamics = system(pull=rng.choice([0.0, 4.0]), push=rng.uniform(0.5, 2), drag=rng.choice([0.0, 0.5]))
    most, times = 0.9 * min(limit, 4.0), np.arange(steps) * DT
    controls = most * np.sin(rng.uniform(0.5, 4) * times + rng.uniform(0, 6))
    z = Shooting(problem(dynamics=dynamics, start=start, steps=steps)).points(controls)
    (x, v), u, room = z[:, :2].T, controls, rng.choice([0.02, 0.3])
    kept: list[ls.Constraint] = []
    if rng.random() < 0.5:
        kept.append(ls.StateBounds(x=(x.min() - room, np.inf), v=(-np.inf, v.max() + room)))
    if rng.random() < 0.5:
        strongest, beside = float((u * v[:-1]).max()) + room, 0.5
        most = float((u**2 + beside * v[:-1] ** 2).max()) + room
        numbers = {"power": strongest, "most": most, "beside": beside, "force": 1.0, "speed": 1.0}
        kept.append(ls.SymbolicConstraint(power, parameters=numbers))
    end = rng.choice(["none", "all", "place", "met"])
    if end == "all":
        kept.append(ls.GoalState(z[-1, :2]))
    elif end == "place":
        kept.append(ls.GoalState(x=x[-1]))
    elif end == "met":
        numbers = {"share": 0.3, "bent": 0.2, "place": 1.0, "speed": 1.0}
        there = x[-1] + 0.3 * v[-1] + 0.2 * x[-1] ** 2
        kept.append(ls.SymbolicConstraint(meeting, parameters=numbers | {"there": there}, equality=True, at="final"))
    return problem(
        *kept, dynamics=dynamics, start=start, goal=rng.uniform(-3, 3, 2), steps=steps, limit=limit,
        effort=10 ** rng.uniform(-2, 2), final=10 ** rng.uniform(0, 4, 2),
        on_the_way=[rng.choice([0.0, 1.0]), 0.0], soft=None if rng.random() < 0.5 else 100.0,
    )  # fmt: skip


numbers = st.integers(0, 2**32 - 1)
enough = settings(max_examples=examples(40), derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@enough
@given(number=numbers)
def test_what_can_be_solved_is(number: int) -> None:
    of = drawn(number)
    solution = solved(of)
    is_optimal(of, solution)


@settings(enough, max_examples=examples(15))
@given(number=numbers, size=st.sampled_from([1.0, 10.0]))
def test_what_can_be_solved_is_not_called_infeasible_from_any_start(number: int, size: float) -> None:
    of, rng = drawn(number), np.random.default_rng(number + 1)
    solution = ls.smooth(of, start=size * rng.normal(size=(of.steps, 1)))
    assert solution.status is not Status.INFEASIBLE, solution.summary()
    if solution.success:
        is_optimal(of, solution)
    states = size * rng.normal(size=(of.steps + 1, 2))
    guess = ls.Trajectory(states, size * rng.normal(size=(of.steps, 1)), DT)
    assert ls.smooth(of, start=guess).status is not Status.INFEASIBLE


# What a plan does not depend on.


def weighed(units: Mapping[str, float], *, effort: float = 1.0) -> ls.Problem:
    """One problem, whose states, control and cost are numbers in other units."""
    place, speed, force, cost = (units[name] for name in ("place", "speed", "force", "cost"))
    sizes = np.array([place, speed])
    parameters = {"power": 1.2, "most": 9.0, "beside": 1.0, "force": force, "speed": speed}
    return problem(
        ls.GoalState(x=2.0 * place), ls.StateBounds(v=(-np.inf, 1.7 * speed)),
        ls.SymbolicConstraint(power, parameters=parameters),
        dynamics=system(pull=1.0, units=units), start=(0.0, 0.0), goal=sizes * (1.5, 0.5), limit=2.5 * force, steps=20,
        effort=effort * cost / force**2, final=cost * np.array([1.0, 3.0]) / sizes**2,
        on_the_way=cost * np.array([0.2, 0.1]) / sizes**2,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["place", "speed", "force", "cost"])
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_units_do_not_matter(name: str, factor: float) -> None:
    plan = solved(weighed(UNITS)).trajectory
    units = {**UNITS, name: factor}
    other = solved(weighed(units))
    sizes = np.array([units["place"], units["speed"]])
    np.testing.assert_allclose(other.trajectory.states / sizes, plan.states, rtol=0, atol=1e-5)
    np.testing.assert_allclose(other.trajectory.controls / units["force"], plan.controls, rtol=0, atol=1e-5)


@settings(enough, max_examples=examples(20))
@given(powers=st.tuples(*[st.floats(-3, 3)] * 4))
def test_nor_do_all_of_them_at_once(powers: tuple[float, ...]) -> None:
    units = dict(zip(UNITS, (10.0**power for power in powers), strict=True))
    plan, other = solved(weighed(UNITS)).trajectory, solved(weighed(units)).trajectory
    sizes = np.array([units["place"], units["speed"]])
    np.testing.assert_allclose(other.states / sizes, plan.states, rtol=0, atol=1e-5)
    np.testing.assert_allclose(other.controls / units["force"], plan.controls, rtol=0, atol=1e-5)


@pytest.mark.parametrize("bounded", [False, True])
def test_what_the_goal_weighs_does_not_matter_where_the_plan_is_to_reach_it(bounded: bool) -> None:
    """On a convex problem; unbounded it is the cubic in time, from the normal equations of the least effort."""
    bound = [ls.StateBounds(v=(-np.inf, 0.9))] if bounded else []
    limit = 3.0 if bounded else np.inf
    plans = [
        solved(problem(ls.GoalState([1.0, 0.0]), *bound, final=[weight, weight], limit=limit)).trajectory
        for weight in 10.0 ** np.arange(5)
    ]
    for plan in plans[1:]:
        np.testing.assert_allclose(plan.controls, plans[0].controls, rtol=0, atol=1e-5)
    of = problem(ls.GoalState([1.0, 0.0]), *bound, limit=limit)
    if bounded:
        best, _ = Shooting(of).least(np.zeros(15))
    else:
        times = np.arange(15) * DT
        reach = np.stack([DT * (15 * DT - times) - DT**2 / 2, np.full(15, DT)])
        best = reach.T @ np.linalg.solve(reach @ reach.T, [1.0, 0.0])
    np.testing.assert_allclose(plans[0].controls[:, 0], best, rtol=0, atol=1e-5)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-8])
def test_constraints_are_missed_by_the_tolerance_at_most(tolerance: float) -> None:
    for number in (3, 8, 15, 49):
        of = drawn(number)
        assert of.constraints
        solution = solved(of, constraint_tolerance=tolerance)
        assert solution.options["constraint_tolerance"] == tolerance
        assert Shooting(of).conditions(solution).violation <= min(tolerance, 1e-6)
        assert solution.violation <= min(tolerance, 1e-6)


# Constraints at a price.


def priced() -> list[ls.Problem]:
    """Convex ones with equalities, inequalities or both."""
    speed, goal = ls.StateBounds(v=(-np.inf, 0.65)), ls.GoalState([0.7, 0.0])
    return [
        problem(goal, final=[3.0, 1.0]), problem(speed, final=[100.0, 10.0]),
        problem(goal, speed, final=[3.0, 1.0], limit=3.0),
    ]  # fmt: skip


@pytest.mark.parametrize("which", range(3))
def test_a_price_above_the_largest_multiplier_is_as_good_as_none(which: int) -> None:
    of = priced()[which]
    hard = solved(of)
    largest = max(float(np.abs(one.values).max()) for one in hard.multipliers)
    elastic = solved(of, elastic=1.5 * largest)
    np.testing.assert_allclose(elastic.trajectory.controls, hard.trajectory.controls, rtol=0, atol=1e-6)
    assert elastic.violation <= 1e-6
    for one, other in zip(hard.multipliers, elastic.multipliers, strict=True):
        np.testing.assert_allclose(other.values, one.values, rtol=0, atol=1e-4 * largest)


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("share", [0.4, *rarely(0.03, 0.8)])
def test_a_price_below_it_is_paid(which: int, share: float) -> None:
    of = priced()[which]
    hard = solved(of)
    price = share * max(float(np.abs(one.values).max()) for one in hard.multipliers)
    elastic = solved(of, elastic=price)
    shooting = Shooting(of)
    z = shooting.pack(elastic.trajectory)
    paid = np.abs(shooting.rows(z, True)).sum() + np.maximum(-shooting.rows(z, False), 0).sum()
    _, least = shooting.least(0 * z, price=price)
    assert paid > 1e-3
    assert elastic.cost + price * paid == pytest.approx(least, rel=1e-6)
    assert max(float(np.abs(one.values).max()) for one in elastic.multipliers) <= price * (1 + 1e-9)
    assert elastic.detail.startswith("elastic: ")
    assert elastic.violation > 1e-4


@pytest.mark.parametrize("price", [0.1, 10.0])
@pytest.mark.parametrize("most", [1, 2, 3, 5])
@pytest.mark.parametrize("loose", ["bounds", "nothing", "both"])
def test_constraints_that_a_stopped_plan_keeps_are_not_called_missed(loose: str, most: int, price: float) -> None:
    """Nor do those without a row, as of an empty world, end the solve."""
    balls = ls.CollisionSpheres(lambda x, p: [(x[0], 0.0)], [0.1])
    wide, empty = ls.StateBounds(v=(-50.0, 50.0)), ls.Clearance(ls.World([]), balls=balls)
    of = problem(*{"bounds": [wide], "nothing": [empty], "both": [empty, wide]}[loose], final=[3.0, 1.0])
    solution = ls.smooth(of, elastic=price, max_iterations=most)
    assert "missed" not in solution.detail
    assert solution.violation == 0


# Warm starts.


@pytest.mark.parametrize("number", [3, 8, 15, 20, 33, 49, 93])
def test_the_solution_as_a_start_is_the_solution(number: int) -> None:
    of = drawn(number)
    solution = solved(of)
    again = solved(of, start=solution)
    assert len(again.iterations) <= 4
    assert again.cost == pytest.approx(solution.cost, rel=1e-8)
    np.testing.assert_allclose(again.trajectory.controls, solution.trajectory.controls, rtol=0, atol=1e-4)


def kept_plan(number: int) -> tuple[ls.Problem, ls.Trajectory]:
    """A problem of inequalities, and a plan that keeps them and is not the best."""
    rng = np.random.default_rng(number)
    controls = 0.3 * rng.normal(size=(15, 1))
    states = Shooting(problem()).points(controls.ravel())[:, :2]
    low, high = states.min(axis=0) - 0.01, states.max(axis=0) + 0.01
    bounds = ls.StateBounds(x=(low[0], high[0]), v=(low[1], high[1]))
    return problem(bounds, goal=(0.5, 1.0), final=[100.0, 10.0]), ls.Trajectory(states, controls, DT)


@pytest.mark.parametrize("most", [1, 2, 3, 5, 500])
@pytest.mark.parametrize("number", range(3))
def test_a_plan_that_is_given_and_keeps_the_constraints_is_not_left_behind(number: int, most: int) -> None:
    of, plan = kept_plan(number)
    cost = float(Shooting(of).cost(plan.controls.ravel()))
    for start in (plan, plan.controls):
        solution = ls.smooth(of, start=start, max_iterations=most)
        assert solution.cost <= cost * (1 + 1e-9)
        assert solution.violation <= 1e-6
        assert len(solution.iterations) <= most
        assert solution.status is Status.CONVERGED or most < 500
        assert solution.status in (Status.CONVERGED, Status.MAX_ITERATIONS)


@pytest.mark.parametrize("weight", [100.0, 1e3, 1e5])
@pytest.mark.parametrize("bound", [0.2, 0.9])
def test_the_optimum_is_told_as_such_where_it_is_given(weight: float, bound: float) -> None:
    """A speed of more than the bound would be cheaper, so the force is the same at each step, by a closed form.

    The solver's plan ends a thousandth of the tolerance inside, which costs more than this plan by the multiplier.
    """
    of = problem(ls.StateBounds(v=(-np.inf, bound)), goal=(0.0, 1.0), final=[0.0, weight], steps=10)
    controls = np.full((10, 1), bound / (10 * DT))
    plan = ls.Trajectory(Shooting(problem(steps=10)).points(controls.ravel())[:, :2], controls, DT)
    solution = solved(of, start=plan)
    np.testing.assert_allclose(solution.trajectory.controls, controls, rtol=0, atol=1e-7)
    assert solution.multipliers[0].values.sum() == pytest.approx(weight * (1 - bound) - controls[0, 0] / DT, rel=1e-5)


@pytest.mark.parametrize("number", range(4))
def test_a_plan_that_costs_nothing_is_the_optimum_though_it_touches_its_bounds(number: int) -> None:
    rng = np.random.default_rng(number)
    controls = 0.3 * rng.normal(size=(15, 1))
    states = Shooting(problem()).points(controls.ravel())[:, :2]
    bounds = ls.StateBounds(v=(states[:, 1].min(), states[:, 1].max()))
    of = replace(
        problem(bounds),
        stage_cost=ls.QuadraticCost([1.0, 1.0], about=states) + ls.ControlCost([1.0], about=controls),
        final_cost=ls.QuadraticCost([10.0, 10.0], about=states[-1]),
    )
    for start in (None, controls, ls.Trajectory(states, controls, DT)):
        assert solved(of, start=start).cost < 1e-15


# Rows that are many, and mostly far from acting.


def balls_along(x, p):
    """Six along each of two links of 0.4 m, whose angles are x[0] and x[0] + x[1]."""
    from sympy import cos, sin

    first, both = x[0], x[0] + x[1]
    shares = [0.4 * k / 6 for k in range(1, 7)]
    upper = [[way * cos(first), way * sin(first), 0] for way in shares]
    return upper + [[0.4 * cos(first) + way * cos(both), 0.4 * sin(first) + way * sin(both), 0] for way in shares]


@pytest.mark.parametrize("seed", [0, 5, 7, 9])
def test_an_arm_at_rest_finds_a_plan_among_posts(seed: int) -> None:
    """How far each of its 36 rows is from what a step foresaw adds up, though hardly any of them acts."""
    rng = np.random.default_rng(seed)
    places = [(rng.uniform(0.5, 0.75), rng.uniform(*span)) for span in ((-0.7, -0.3), (0.3, 0.9), (1.5, 2.0))]
    posts = np.array([(far * np.cos(turn), far * np.sin(turn), 0.0) for far, turn in places])
    world = ls.World(
        [ls.Obstacle(f"{i}", "cylinder", post, np.eye(3), np.array([0.04, np.inf, 0])) for i, post in enumerate(posts)]
    )
    goal, weight = np.array([2.6, -0.2, 0, 0]), 10 ** rng.uniform(1, 3.3) * np.array([1, 1, 0.1, 0.1])
    dynamics = ls.Dynamics(
        lambda x, u, p: [x[2], x[3], u[0], u[1]], angles=("shoulder", "elbow"), control_limits=(-4, 4),
        states={"shoulder": "rad", "elbow": "rad", "turn": "rad/s", "bend": "rad/s"}, controls={"a": "", "b": ""},
    )  # fmt: skip
    of = ls.Problem(
        dynamics=dynamics, dt=0.05, steps=80, initial=ls.FixedState((-1.2, 0.1, 0, 0)),
        stage_cost=ls.ControlCost((0.05, 0.05)), final_cost=ls.QuadraticCost(weight, about=goal),
        constraints=[ls.Clearance(world, balls=ls.CollisionSpheres(balls_along, np.full(12, 0.03)), margin=0.02)],
    )  # fmt: skip
    still = Motion(np.tile((-1.2, 0.1, 0, 0), (81, 1)), np.zeros((80, 2)))
    found = InteriorPoint(Stages(of), still, STRONG).run(tolerance=1e-8, violation=1e-6, most=200)
    assert found.solved
    states, controls = found.plan
    speeds = states[:-1, 2:]
    moved = np.column_stack([states[:-1, :2] + 0.05 * speeds + 0.05**2 / 2 * controls, speeds + 0.05 * controls])
    np.testing.assert_allclose(states[1:], moved, atol=1e-7)
    angles = np.cumsum(states[:, :2], axis=1)
    ends = np.cumsum(0.4 * np.stack([np.cos(angles), np.sin(angles)], axis=2), axis=1)  # (T+1, link, 2)
    begins = np.concatenate([np.zeros((81, 1, 2)), ends[:, :1]], axis=1)
    balls = begins[:, :, None] + np.arange(1, 7)[:, None] / 6 * (ends - begins)[:, :, None]
    apart = np.linalg.norm(balls[:, :, :, None] - posts[:, :2], axis=-1) - (0.03 + 0.04 + 0.02)
    assert apart.min() >= -1e-6
    off = states[-1] - goal
    cost = 0.5 * 0.05 * (controls**2).sum() + 0.5 * off**2 @ weight
    assert found.measures.cost == pytest.approx(cost, rel=1e-9)
    assert cost < 0.8 * 0.5 * (states[0] - goal) ** 2 @ weight


# What cannot be.


@pytest.mark.parametrize(
    ("constraints", "changes", "named", "against"),
    [
        ([ls.GoalState(x=5.0)], {"limit": 1.0}, "the goal of 5 m for x", ["the limits of u"]),
        ([ls.GoalState(x=1.0), ls.StateBounds(v=(-np.inf, 0.2))], {}, "the goal of 1 m", ["v of at most"]),
        ([ls.GoalState([5.0, 0.0])], {"limit": 1.0}, "the goal of 5 m for x", ["the limits of u", "the goal of 0 m/s"]),
        ([ls.GoalState(x=4.0)], {"limit": 1.0, "dynamics": system(pull=4.0)}, "the goal", ["limits of"]),
    ],
    ids=["too far", "too slow", "too far to stop", "too weak to swing up"],
)  # fmt: skip
def test_what_cannot_be_is_infeasible(
    constraints: list, changes: dict[str, Any], named: str, against: list[str]
) -> None:
    of = problem(*constraints, **changes)
    solution = ls.smooth(of)
    assert solution.status is Status.INFEASIBLE, solution.summary()
    assert named in solution.detail
    said = solution.detail.split("against it stand")[1]
    for name in against:
        assert name in said
    shooting = Shooting(of)
    z = shooting.pack(solution.trajectory)
    if len(shooting.rows(z, True)) == 1 and len(constraints) == 1:  # nothing else can be missed in its place
        best, _ = shooting.least(z, price=1.0, cost=0.0)
        assert solution.violation == pytest.approx(float(np.abs(shooting.rows(best, True)).max()), rel=1e-3)


@pytest.mark.parametrize("way", np.exp(np.random.default_rng(0).uniform(np.log(3.0), np.log(150.0), 8)).tolist())
def test_limits_that_stand_against_a_goal_are_named_however_far_it_is(way: float) -> None:
    """With a force of at most 1 N, a mass of 1 kg gets 1 m far in 2 s and stops, and 2 m without stopping."""
    dynamics = ls.Dynamics(lambda x, u, p: [x[1], u[0]], states={"x": "m", "v": "m/s"}, controls={"force": "N"})
    solution = ls.smooth(
        ls.Problem(
            dynamics=dynamics, dt=0.1, steps=20, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.1]),
            final_cost=ls.QuadraticCost([10.0, 10.0], about=[1.0, 0.0]), constraints=[ls.GoalState(x=way, v=0.0)],
            control_limits=(-1, 1),
        )
    )  # fmt: skip
    assert solution.status is Status.INFEASIBLE
    assert way - 2 - 1e-6 <= solution.violation <= way - 1 + 1e-3
    assert "the limits of force" in solution.detail.split("against it stand")[1]
    assert "relax the limits of force" in solution.remedy


def test_bounds_that_contradict_each_other_are_infeasible() -> None:
    """One as a bound, one as a formula: half of what is between them is the least that can be missed."""
    numbers = {"share": 0.0, "bent": 0.0, "place": 1.0, "speed": 1.0, "there": 0.5}
    at_least = ls.SymbolicConstraint(meeting, parameters=numbers)
    of = problem(at_least, ls.StateBounds(x=(-np.inf, 0.3)), start=(0.4, 0.0))
    solution = ls.smooth(of)
    assert solution.status is Status.INFEASIBLE, solution.summary()
    assert 0.1 - 1e-3 <= solution.violation <= 0.2 + 1e-3


# The end.


@pytest.mark.parametrize("number", [0, 12, 22, 29, 44])
def test_controls_that_press_are_exactly_at_their_limits(number: int) -> None:
    of = replace(drawn(number), control_limits=(-0.4, 0.5), constraints=(), initial=ls.FixedState([1.0, 0.5]))
    solution = solved(of)
    z, shooting = solution.trajectory.controls.ravel(), Shooting(of)
    slope = shooting.slope(shooting.cost, z)
    pressing = np.abs(slope) > 1e-4 * np.abs(shooting.slope(shooting.parts, z)).max()
    assert pressing.any()
    np.testing.assert_array_equal(z[pressing], np.where(slope > 0, -0.4, 0.5)[pressing])
    assert not solution.policy.gain[pressing].any()


@pytest.mark.parametrize("when", [1, 2, 4, 7])
@pytest.mark.parametrize("error", [RuntimeError("enough"), KeyboardInterrupt()])
def test_what_a_callback_raises_ends_it_with_the_best_plan(when: int, error: BaseException) -> None:
    of, seen = weighed(UNITS), []

    def callback(iteration: Iteration) -> None:
        seen.append(iteration)
        if len(seen) == when:
            raise error

    assert len(solved(of).iterations) > 7
    with pytest.raises(type(error)) as caught:
        ls.smooth(of, callback=callback)
    solution = caught.value.solution  # pyright: ignore[reportAttributeAccessIssue]
    assert solution.status is Status.INTERRUPTED
    assert len(solution.iterations) == when
    ends(of, solution)


def ends(of: ls.Problem, solution: ls.Solution) -> None:
    """The plan is a motion inside its limits, and what is said of it is so."""
    shooting = Shooting(of)
    z = shooting.pack(solution.trajectory)
    np.testing.assert_allclose(shooting.points(z)[:, : shooting.n], solution.trajectory.states, rtol=0, atol=1e-9)
    assert ((shooting.low <= z) & (z <= shooting.high)).all()
    assert solution.cost == pytest.approx(float(shooting.cost(z)), rel=1e-9)
    assert solution.violation == pytest.approx(
        max(np.abs(shooting.rows(z, True)).max(initial=0.0), -shooting.rows(z, False).min(initial=0.0)), abs=1e-12
    )


@pytest.mark.parametrize("far", [1.0, 30.0])
def test_a_callback_hears_of_the_iterations_of_all_starts_that_are_run_to_their_end(far: float) -> None:
    """Motions along paths, by which other starts are put in order, are not among them."""
    told: list[Iteration] = []
    solution = ls.smooth(problem(ls.GoalState(x=far, v=0.0), goal=(far, 0.0), limit=0.5), callback=told.append)
    assert solution.status is Status.INFEASIBLE
    assert len(solution.candidates) >= 3
    assert len(told) == sum(one.iterations for one in solution.candidates)


def test_the_time_limit_and_the_limit_of_iterations_end_it_with_the_best_plan() -> None:
    of, before = weighed(UNITS), np.inf
    for most in (1, 3, 6, 9):
        solution = ls.smooth(of, max_iterations=most)
        assert solution.status is Status.MAX_ITERATIONS
        assert len(solution.iterations) <= most
        ends(of, solution)
        assert solution.violation <= before
        before = solution.violation
    late = ls.smooth(of, time_limit=1.0, callback=lambda iteration: time.sleep(1.0))
    assert late.status is Status.TIME_LIMIT
    assert len(late.iterations) == 1
    ends(of, late)
    at_once = ls.smooth(of, time_limit=1e-9)
    assert at_once.status is Status.TIME_LIMIT
    ends(of, at_once)


def two_forces(x, u, p):
    return [x[2], x[3], u[0], u[1]]


def shared(x, u, p):
    """The power of both together."""
    return [p.most - u[0] * x[2] - u[1] * x[3]]


@pytest.mark.parametrize("effort", [0.1, 1.0])
@pytest.mark.parametrize("most", [0.3, 1.0])
def test_one_constraint_may_couple_controls(effort: float, most: float) -> None:
    goal = np.array([2.0, 2.0, 0.0, 0.0])
    of = ls.Problem(
        dynamics=ls.Dynamics(
            two_forces, states={"x": "m", "y": "m", "v": "m/s", "w": "m/s"}, controls={"a": "N", "b": "N"}
        ),
        dt=DT, steps=20, initial=ls.FixedState([0.1, 0.0, 0.2, 0.1]),
        stage_cost=ls.ControlCost([effort, effort], about=[0.0, 0.0]) + ls.QuadraticCost([1, 1, 0, 0], about=goal),
        final_cost=ls.QuadraticCost([100, 100, 1, 1], about=goal),
        constraints=[ls.SymbolicConstraint(shared, parameters={"most": most})],
    )  # fmt: skip
    solution = solved(of)
    is_optimal(of, solution)
    (pressing,) = (one.values > 0 for one in solution.multipliers)
    assert pressing.any()
    x, u = solution.trajectory.states[:-1], solution.trajectory.controls
    # What presses ends a thousandth of the tolerance inside, and not where a barrier has left it.
    np.testing.assert_allclose((u * x[:, 2:]).sum(axis=1)[pressing[:-1, 0]], most, rtol=0, atol=2e-9)


# A cost that is flat in the control.


def test_without_a_cost_of_the_control_it_is_at_its_limits() -> None:
    solution = solved(racing())
    np.testing.assert_array_equal(solution.trajectory.controls, 1.0)
    # To end at rest: full speed ahead for one half, and back for the other, of which the middle step is zero.
    stopped = solved(racing(ls.GoalState(v=0.0)))
    switch = np.sign(7.0 - np.arange(15))
    np.testing.assert_allclose(stopped.trajectory.controls[:, 0], switch, rtol=0, atol=1e-6)
    again = solved(racing(ls.GoalState(v=0.0)), start=stopped)
    assert len(again.iterations) <= 4
    assert again.cost == pytest.approx(stopped.cost, rel=1e-8)


def test_a_cost_without_end_is_not_called_a_solution() -> None:
    solution = ls.smooth(racing(limit=np.inf))
    assert not solution.success
    assert solution.remedy


# Re-plans.


@pytest.mark.parametrize("number", [0, 3, 5, 8, 12, 17, 22, 29])
def test_the_rest_of_drawn_problems(number: int) -> None:
    """With bounds, goals as equalities, and limits of any kind, from beside the plan at a later step."""
    of, rng = drawn(number), np.random.default_rng(number)
    before = ls.smooth(of)
    assert before.success
    after = int(rng.integers(1, of.steps // 2))
    state = before.trajectory.states[after] + 1e-3 * rng.normal(size=2)
    found = ls.prepare(of).solve(state, before.shifted(after, horizon="shrinking"), after=after)
    rest = of.from_state(state, after=after)
    assert found.status is Status.CONVERGED, found.detail
    conditions = Shooting(rest).conditions(found)  # pyright: ignore[reportArgumentType]
    assert max(conditions.slope, conditions.pressing, conditions.spare) < 1e-5, conditions
    assert conditions.sign == 0
    assert conditions.violation <= 1e-6


def test_what_cannot_be_kept_is_not_called_converged() -> None:
    """Twice as much power as there may be, at once: the plan is the one that misses least, or no worse."""
    numbers = {"power": 1.0, "most": 9.0, "beside": 0.5, "force": 1.0, "speed": 1.0}
    of = problem(
        ls.StateBounds(v=(-np.inf, 0.5)), ls.SymbolicConstraint(power, parameters=numbers), dynamics=system(), limit=2.0
    )
    before = ls.smooth(of)
    found = ls.prepare(of).solve([0.0, 1.5], before.shifted(0), time_limit=5.0)
    assert not found.success
    went = Shooting(of.from_state([0.0, 1.5]))
    z = went.pack(found.trajectory)
    assert found.violation == pytest.approx(-went.rows(z, False).min(), abs=1e-9)
    # From 1.5 m/s the bound of 0.5 is missed at the first step by what full braking leaves.
    assert found.violation >= 1.5 - 2.0 * DT - 0.5 - 1e-9


@pytest.mark.parametrize("far", [1e30, 1e67, 1e70, 1e150])
def test_from_a_start_thrown_far_off_the_merit_falls(far: float) -> None:
    """A slope of up to 1e300 is beyond what powers can hold. The cost is quadratic, so that its optimum is known."""
    of = problem(start=(far, far), limit=10 * far)
    times = DT * np.arange(16)
    coasting = Motion(far * np.column_stack([1 + times, np.ones(16)]), np.zeros((15, 1)))
    since = np.maximum(times[:, None] - times[1:], 0.0)  # from the end of each control's step
    led = times[:, None] > times[:-1]
    moved, sped = led * (DT**2 / 2 + DT * since), led * DT  # (time, control): what a unit of control does
    off = np.concatenate([[1.0, 0.0] - coasting.states[-1], np.zeros(15)])
    best = np.linalg.lstsq(np.vstack([moved[-1], sped[-1], np.eye(15)]), off, rcond=None)[0]
    found = InteriorPoint(Stages(of), coasting).run(tolerance=1e-8, violation=1e-6, most=20)
    assert found.solved
    # No control is at its limit; relative to the largest, for rounding is.
    np.testing.assert_allclose(found.plan.controls[:, 0], best, rtol=0, atol=1e-10 * np.abs(best).max())


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=examples(10))
def test_a_result_stays_as_it_is_when_another_run_uses_its_memory(seed: int) -> None:
    rng, stages = np.random.default_rng(seed), Stages(problem(limit=1.0))
    plans = [Motion(rng.normal(size=(16, 2)), rng.normal(size=(15, 1))) for _ in range(2)]
    first = InteriorPoint(stages, plans[0]).run(tolerance=1e-8, violation=1e-6, most=20)
    before = deepcopy(first)
    InteriorPoint(stages, plans[1]).run(tolerance=1e-8, violation=1e-6, most=2)
    for name in ("plan", "gain", "multipliers", "pressing", "sizes"):
        for found, wanted in zip(getattr(first, name), getattr(before, name), strict=True):
            np.testing.assert_array_equal(found, wanted)


def pole(length: float, fastest: float, steps: int, *, held: bool) -> ls.Problem:
    """A cart, whose acceleration is its control, carries a pole upright over a distance, and may not be fast.

    If it is held, the control is what is added to a law that holds the pole up, so that rounding does not grow.
    """
    g, dt = 9.81, 0.02
    rate = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0], [0, g / length, 0, 0]])
    push = np.array([[0], [0], [1], [-1 / length]])
    law = -(push.T @ scipy.linalg.solve_continuous_are(rate, push, np.eye(4), np.eye(1)))[0] if held else np.zeros(4)

    def acceleration(x: Any, u: Any) -> Any:
        states = (x.place, x.angle, x.speed, x.turn)
        return u.push + sum(float(gain) * state for gain, state in zip(law, states, strict=True))

    def following(x: Any, u: Any, p: Any) -> Any:
        a = acceleration(x, u)
        turning = (g * sympy.sin(x.angle) - a * sympy.cos(x.angle)) / length
        return [x.place + dt * x.speed, x.angle + dt * x.turn, x.speed + dt * a, x.turn + dt * turning]

    dynamics = ls.Dynamics(
        following, states={"place": "m", "angle": "rad", "speed": "m/s", "turn": "rad/s"}, controls={"push": "m/s^2"},
        period=dt,
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=dt, steps=steps, initial=ls.FixedState(place=0.0),
        stage_cost=ls.SymbolicCost(lambda x, u, p: 0.05 * acceleration(x, u) ** 2),
        final_cost=ls.QuadraticCost({"place": 100, "angle": 10, "speed": 10, "turn": 10}, about={"place": 1.5}),
        constraints=[ls.SymbolicConstraint(lambda x, u, p: fastest - x.speed)],
    )  # fmt: skip


@settings(max_examples=examples(20))
@given(length=st.floats(0.12, 1.0), fastest=st.floats(0.35, 0.6), steps=st.integers(200, 400))
@example(length=0.171875, fastest=0.5, steps=212)  # slopes of ten to a thousand tolerances, to the last iteration
@example(length=0.27725587, fastest=0.35264654, steps=261)
def test_rounding_that_unstable_dynamics_enlarge_is_no_slope(length: float, fastest: float, steps: int) -> None:
    """Over 8 s a pole of 12 cm falls exp(70) times as far as it began to, and with it the rounding of a slope."""
    plain, held = (ls.smooth(pole(length, fastest, steps, held=held), starts=1) for held in (False, True))
    assert held.status is ls.Status.CONVERGED
    assert plain.status is ls.Status.CONVERGED, plain
    assert plain.curvature is held.curvature
    # To a relative decrease of 1e-8, and the speed to 1e-6, which costs what its multiplier says.
    assert plain.cost == pytest.approx(held.cost, rel=1e-5)

"""Problems and costs: what is refused, each with one line that names the field, what it got and what it wanted."""

import dataclasses
import logging
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from sampling import examples

import lqrsim as ls
from lqrsim.errors import check_symmetric
from lqrsim.problem.control_rate import with_last_command
from lqrsim.problem.derivative_check import evaluate
from lqrsim.problem.parts import CostSum
from lqrsim.problem.state_bounds import LimitCost
from lqrsim.solvers import compiled


def test_a_sum_of_costs_keeps_its_terms_in_order() -> None:
    a, b, c = (ls.ControlCost([weight], about=[0.0]) for weight in (1.0, 2.0, 3.0))
    assert ((a + b) + c).terms == (a + (b + c)).terms == (a, b, c)
    summed = sum([a, b + c])
    assert isinstance(summed, CostSum)
    assert summed.terms == (a, b, c)
    assert sum([a]) is a
    for other in (1, 0.5, None):
        with pytest.raises(TypeError, match="unsupported operand"):
            _ = other + a  # pyright: ignore[reportOperatorIssue]


def test_a_sum_is_scaled_ahead_and_by_knot_as_its_terms() -> None:
    rows = np.arange(3.0)[:, None]
    a, b = ls.ControlCost({"u": 2.0}), ls.QuadraticCost([3.0, 1.0], about=rows * [1.0, 1.0])
    stated = ls.Problem(
        dynamics=_two(), dt=0.1, steps=2, initial=ls.FixedState(x=0.0), stage_cost=a + b,
        final_cost=ls.QuadraticCost({"x": 1.0}, about={"y": 1.0}),
    )  # fmt: skip
    np.testing.assert_array_equal(stated.final_cost.weight, np.diag([1.0, 0.0]))  # pyright: ignore[reportAttributeAccessIssue]
    summed = stated.stage_cost
    effort, follows = summed.scaled(2).terms  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_array_equal(effort.weight, [[4.0]])
    np.testing.assert_array_equal(follows.weight, np.diag([6.0, 2.0]))
    np.testing.assert_array_equal(follows.about, b.about)
    np.testing.assert_array_equal(summed.ahead(1).terms[1].about, b.about[1:])  # pyright: ignore[reportAttributeAccessIssue]
    assert (summed.by_knot, summed.moving) == (True, True)
    twice = dataclasses.replace(stated, stage_cost=summed.scaled(2), final_cost=stated.final_cost.scaled(2))
    assert ls.smooth(twice).cost == pytest.approx(2 * ls.smooth(stated).cost, rel=1e-9)
    for what in ("kept_clear", "state_reference", "control_reference", "contact_curvature"):
        with pytest.raises(ls.InputError, match=r"^cost: got a sum of costs, want a single term"):
            getattr(summed, what)


def _bump(x: Any, u: Any, p: Any) -> Any:
    return p.height * (x[0] - 0.3) ** 2 * (1 + u[0] ** 2) + x[1] ** 4


class Own(ls.Cost):
    """x, squared."""

    def bind(self, dynamics: ls.Dynamics) -> ls.types.CostTerm:
        value = "def value(x, u, t, data):\n    return data[0] * x[0] * x[0]\n\n\n"
        first = "def derivatives(x, u, t, data, hessian, gradient):\n    gradient[0] += 2 * data[0] * x[0]\n"
        then = "    hessian[0, 0] += 2 * data[0]\n    return data[0] * x[0] * x[0]\n"
        return ls.types.CostTerm(value + first + then, np.array([3.0]))


KINDS = {
    "symbolic": ls.SymbolicCost(_bump, parameters={"height": 0.7}),
    "function": ls.FunctionCost(_bump, parameters={"height": 0.7}),
    "limit": LimitCost({"x": 0.5}, {"y": 0.2}, weight=3.0),
    "own": Own(),
    "quadratic": ls.QuadraticCost([1.0, 2.0], about=[0.1, 0.2]),
    "control": ls.ControlCost([3.0], about=[0.5]),
}


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=examples(3))
@given(first=st.floats(0.0, 9.0), then=st.floats(0.1, 9.0), seed=st.integers(0, 2**32 - 1))
def test_any_cost_times_a_number_is_that_many_times_the_cost(kind: str, first: float, then: float, seed: int) -> None:
    cost, dynamics, rng = KINDS[kind], _two(), np.random.default_rng(seed)
    times: Any = sum([cost.scaled(first).scaled(then)])
    x, u = rng.normal(size=2), rng.normal(size=1)
    for once, other in zip(evaluate(cost.bind(dynamics), x, u), evaluate(times.bind(dynamics), x, u), strict=True):
        np.testing.assert_allclose(other, first * then * np.asarray(once), rtol=1e-12, atol=1e-12)
    assert (times.name, times.by_knot, times.moving) == (cost.name, cost.by_knot, cost.moving)
    with pytest.raises(ls.InputError, match=r"^factor: got -1.0, want a finite number >= 0"):
        cost.scaled(-1.0)


@pytest.mark.parametrize("kinds", [("limit", "own"), ("function", "symbolic", "quadratic")])
@settings(max_examples=examples(2))
@given(factor=st.floats(0.5, 4.0))
def test_the_plan_of_all_costs_times_a_number_is_the_same(kinds: tuple[str, ...], factor: float) -> None:
    """To the accuracy to which both are solved, relative to costs of 1."""
    stage = sum((KINDS[kind] for kind in kinds), ls.ControlCost([1.0]))
    once = ls.Problem(
        dynamics=_two(), dt=0.1, steps=10, initial=ls.FixedState(x=1.0, y=-0.5), stage_cost=stage, final_cost=Own(),
    )  # fmt: skip
    times = dataclasses.replace(once, stage_cost=stage.scaled(factor), final_cost=Own().scaled(factor))
    solutions = [ls.smooth(one) for one in (once, times)]
    assert solutions[1].cost == pytest.approx(factor * solutions[0].cost, rel=1e-8)
    plans = [solution.trajectory.states for solution in solutions]
    np.testing.assert_allclose(*plans, rtol=0, atol=1e-5)
    assert times.digest != once.digest
    assert "Own()" in str(times)


@settings(max_examples=examples(3))
@given(about=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), weight=st.floats(0.5, 20.0))
def test_a_soft_start_by_name_is_known_with_rates(about: tuple[float, float], weight: float) -> None:
    named = ls.QuadraticCost({"x": weight, "y": weight}, about=dict(zip(("x", "y"), about, strict=True)))
    solutions = []
    for initial in (named, ls.QuadraticCost([weight, weight], about=about)):
        stated = ls.Problem(
            dynamics=_two(), dt=0.1, steps=5, initial=initial, stage_cost=ls.ControlCost([1.0]),
            final_cost=ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0]), control_rate=ls.ControlRate(weight=0.1),
        )  # fmt: skip
        np.testing.assert_array_equal(with_last_command(stated).start, [*about, 0.0])
        solutions.append(ls.smooth(stated))
    np.testing.assert_array_equal(*(solution.trajectory.controls for solution in solutions))


def _two(**fields: Any) -> ls.Dynamics:
    return ls.Dynamics(_double, states={"x": "", "y": ""}, controls={"u": ""}, **fields)


def _double(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], u[0]]


def test_digests_are_of_everything_that_differs() -> None:
    """Terms that move to another part, what wraps, where the robot is, and its actuators' range."""
    costs = [ls.QuadraticCost([1.0, weight], about=[0.5, 0.0]) for weight in (1.0, 2.0, 3.0, 4.0)]
    effort, limits = ls.ControlCost([1.0]), {"control_limits": (-1.0, 1.0)}
    made: list[dict[str, Any]] = [
        # Three costs, in this order, of three parts: where one part ends and the next begins.
        *(
            {
                "initial": sum(costs[:i]),
                "stage_cost": sum([*costs[i:j], effort, *costs[j:k]]),
                "final_cost": sum(costs[k:]),
            }
            for i in (1, 2) for j in range(i, 4) for k in range(j, 4)
        ),
        {"initial": ls.QuadraticCost([0.0, 0.0], about=[1.0, 2.0])},
        {"initial": ls.FixedState([1.0, 2.0])},
        {"dynamics": _two(angles=("x",))}, {"dynamics": _two(angles=("y",))}, {"dynamics": _two(angles=("x", "y"))},
        {"dynamics": _two(position=("x", "y"))}, {"dynamics": _two(position=("x", "y"), offset=1.0)},
        limits, {"dynamics": _two(**limits)}, {"dynamics": _two(control_limits=(-2.0, 2.0)), **limits},
    ]  # fmt: skip
    known = {"dynamics": _two(), "dt": 0.1, "steps": 5, "stage_cost": effort, "final_cost": costs[0]}
    problems = [ls.Problem(**{"initial": costs[1], **known, **one}) for one in made]
    assert len({one.digest for one in problems}) == len(problems)
    for one in problems:
        assert dataclasses.replace(one).digest == one.digest


@given(seed=st.integers(0, 2**32 - 1), m=st.integers(1, 4), count=st.integers(0, 4))
@settings(max_examples=examples(30))
def test_the_nominal_control_is_where_all_control_costs_together_are_least(seed: int, m: int, count: int) -> None:
    """By least squares of the roots, to 1e-9: the weights are well conditioned."""
    rng, names = np.random.default_rng(seed), [f"u{i}" for i in range(m)]
    roots = np.eye(m) + 0.3 * rng.normal(size=(count, m, m))
    abouts = rng.normal(size=(count, m))
    costs = [ls.ControlCost(root.T @ root, about=about) for root, about in zip(roots, abouts, strict=True)]
    problem = ls.Problem(
        dynamics=ls.Dynamics(lambda x, u, p: [sum(u)], states={"x": ""}, controls=dict.fromkeys(names, "")),
        dt=0.1, steps=2, initial=ls.FixedState([0.0]), final_cost=ls.QuadraticCost([1.0], about=[0.0]),
        stage_cost=sum(costs, start=ls.QuadraticCost([1.0], about=[0.0])),
    )  # fmt: skip
    least = np.zeros(m)
    if count:
        least = np.linalg.lstsq(roots.reshape(-1, m), np.einsum("kij,kj->ki", roots, abouts).ravel())[0]
    np.testing.assert_allclose(problem.nominal_control, least, rtol=0, atol=1e-9 * max(1, np.abs(least).max()))


@pytest.mark.parametrize("constant", [0, 3, -2, 0.5])
def test_a_formula_that_is_a_constant_costs_that_at_each_step(constant: float) -> None:
    """A whole number, too: what a simplified formula came to was garbage, for nothing made a float of it."""
    dynamics = ls.Dynamics(lambda x, u, p: [u[0]], states={"x": "m"}, controls={"speed": "m/s"})
    plain = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=7, initial=ls.FixedState([0.0]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([5.0], about=[1.0]),
    )  # fmt: skip
    dearer = dataclasses.replace(
        plain, stage_cost=plain.stage_cost + ls.SymbolicCost(lambda x, u, p: 0 * x[0] + constant, convex=True)
    )
    for solve in (ls.smooth, ls.ilqr):
        assert solve(dearer).cost == pytest.approx(solve(plain).cost + 7 * constant, rel=1e-9)


@given(
    weights=st.lists(st.integers(1, 999), min_size=3, max_size=3), goal=st.integers(-99, 99), bound=st.integers(3, 9),
    margin=st.integers(1, 9), obstacles=st.integers(0, 5), free=st.booleans(),
)  # fmt: skip
def test_a_problem_and_its_parts_print_what_they_were_made_of(
    weights: list[int], goal: int, bound: int, margin: int, obstacles: int, free: bool
) -> None:
    world = ls.World([
        ls.Obstacle(f"ball {k}", "sphere", np.array([5.0 * k, 5, 0]), np.eye(3), np.ones(3)) for k in range(obstacles)
    ])  # fmt: skip
    stated: dict[str, Any] = {"duration": (1.0, 9.0), "time_weight": 2.0} if free else {}
    problem = ls.Problem(
        dynamics=ls.DifferentialDrive().dynamics, dt=0.1, steps=20, initial=ls.FixedState(heading=0.5),
        stage_cost=ls.ControlCost({"m/s": 7.0}) + ls.ObstacleCost(world, radius=0.25),
        final_cost=ls.QuadraticCost(weights, about={"y": goal}),
        constraints=[
            ls.GoalState(x=goal), ls.StateBounds(y=(-bound, np.inf)),
            ls.Clearance(world, radius=0.25, margin=margin / 100),
        ], control_limits=(-0.5, 0.75), **stated,
    )  # fmt: skip
    text = str(problem)
    assert " at 0x" not in text + repr(problem) + repr(problem.dynamics)
    lines = {line[:14].strip(" :") or "more": line[15:] for line in text.splitlines()}
    assert lines["states"] == "x (m), y (m), heading (rad)"
    assert lines["start"] == "FixedState([0, 0, 0.5])"
    assert ("1 to 9 s in all" if free else "20 steps of 0.1 s, 2 s in all") in lines["dynamics"]
    assert ("cost of time" in lines) is free
    assert lines["limits"].count("-0.5 to 0.75") == 2
    shown = f"World({obstacles} obstacle{'s' * (obstacles > 1)}: " if obstacles else "World()"
    assert "ControlCost(weight=diag([7, 7])" in lines["stage cost"]
    assert f"ObstacleCost(world={shown}" in lines["stage cost"]
    listed = ", ".join(map(str, weights))
    assert f"QuadraticCost(weight=diag([{listed}]), about=[0, {goal}, 0])" in lines["final cost"]
    assert f"GoalState(goal={{x: {goal}}})" in text
    assert f"StateBounds(bounds={{y: (-{bound}, inf)}})" in text
    assert f"margin={margin / 100:g}, radius=0.25)" in text


@given(digits=st.integers(1, 5000), sign=st.sampled_from([1, -1]))
def test_numbers_of_any_size_are_printed(digits: int, sign: int) -> None:
    """Also beyond 1e308, which no float holds, and beyond 4,300 digits, which Python does not print."""
    shown = repr(ls.types.BetweenKnots(sign * 10 ** (digits - 1), 0.0, {}))
    assert shown.startswith(
        "BetweenKnots(step_error=" + (f"{sign * 10.0 ** (digits - 1):g}," if digits < 310 else "an int of ")
    )
    assert len(shown) < 100


@pytest.mark.parametrize("size", [1, 2, 5])
def test_weights_of_any_number_of_controls_are_printed(size: int) -> None:
    listed = {1: "7", 2: "7, 7", 5: "7, ... 5 times"}[size]
    assert repr(ls.ControlCost(np.full(size, 7.0))).startswith(f"ControlCost(weight=diag([{listed}]), about=[")
    full = np.eye(size) + 1
    shown = "diag([2])" if size == 1 else f"array ({size}, {size})"
    assert repr(ls.ControlCost(full)).startswith(f"ControlCost(weight={shown}, about=[")


def test_the_stage_model_is_the_cost_to_second_order(quadrotor: ls.Scenario) -> None:
    """Gradient by central differences of the value, step 1e-6: 1e-5 of gradients of order ten."""
    problem = quadrotor.problem
    costs, stage = compiled.costs_module(problem), compiled.compile_problem(problem).stage
    rng, h = np.random.default_rng(0), 1e-6
    for _ in range(20):
        z = rng.uniform(-1, 1, size=16)
        hessian, gradient = np.zeros((16, 16)), np.zeros(16)
        value = costs.cost_of_order(z[:12], z[12:], 1, stage, 0.0, hessian, gradient)
        assert value == pytest.approx(costs.cost_value(z[:12], z[12:], 1, stage), rel=1e-12)
        for i, unit in enumerate(np.eye(16)):
            ahead, behind = (
                costs.cost_value((z + s * h * unit)[:12], (z + s * h * unit)[12:], 1, stage) for s in (1, -1)
            )
            assert gradient[i] == pytest.approx((ahead - behind) / (2 * h), abs=1e-5 * max(1, value))
        assert np.linalg.eigvalsh(hessian).min() > -1e-9 * np.abs(hessian).max()


def test_a_symbolic_cost_is_the_built_in_one(differential_drive: ls.Scenario) -> None:
    """The control cost once more as a formula: the same optimum to rounding."""
    problem = differential_drive.problem
    scene, robot = differential_drive.scene, differential_drive.robot

    def effort(x, u, p):
        return p.weight / 2 * ((u[0] - p.cruise) ** 2 + (u[1] - p.cruise) ** 2)

    stage = ls.SymbolicCost(effort, parameters={"weight": 60.0, "cruise": 0.25}, convex=True)
    stage += ls.ObstacleCost(scene.world, radius=robot.radius)
    other = dataclasses.replace(problem, stage_cost=stage)
    start = (0.25, 0.25)  # a formula has no control of its own to begin with
    assert ls.ilqr(other, start=start).cost == pytest.approx(ls.ilqr(problem, start=start).cost, rel=1e-9)


STATES = {"x": "m", "y": "m", "speed": "m/s"}
DYNAMICS = ls.Dynamics(
    lambda x, u, p: [x[2], 0 * x[2], u[0]], states=STATES, controls={"force": "N"}, position=("x", "y")
)
PILLAR = ls.World([ls.Obstacle("pillar", "cylinder", np.zeros(3), np.eye(3), np.array([0.5, 1.0, 0.0]))])
FIELDS: dict[str, Any] = {
    "dynamics": DYNAMICS,
    "dt": 0.1,
    "steps": 10,
    "initial": ls.QuadraticCost(np.ones(3), about=(2.0, 0.0, 0.0)),
    "stage_cost": ls.ControlCost([1.0], about=[0.0]) + ls.ObstacleCost(PILLAR, radius=0.1),
    "final_cost": ls.QuadraticCost(np.ones(3), about=(4.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("solve", [ls.smooth, ls.ilqr])
@settings(max_examples=examples(8))
@given(x=st.floats(-1.0, 1.0), y=st.floats(-1.0, 1.0), speed=st.floats(-1.0, 1.0), weighed=st.booleans())
def test_a_goal_inside_an_obstacle_is_said_before_the_solve(
    solve: Callable[..., ls.Solution], x: float, y: float, speed: float, weighed: bool
) -> None:
    """The pillar's radius is 0.5 m, the robot's 0.1 m. A goal without a weight on its place is no place."""
    depth = 0.6 - np.hypot(x, y)
    assume(abs(depth) > 1e-6)
    weight = [1.0, 1.0, 0.0] if weighed else [1.0, 0.0, 1.0]
    problem = ls.Problem(**{**FIELDS, "final_cost": ls.QuadraticCost(weight, about=(x, y, speed))})
    said, begun = list[str](), list[int]()
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage() * (not begun))
    logging.getLogger("lqrsim").addHandler(handler)
    try:
        solve(problem, max_iterations=1, callback=lambda *_: begun.append(1))
    finally:
        logging.getLogger("lqrsim").removeHandler(handler)
    about = [line for line in said if "the goal is" in line]
    if depth > 0 and weighed:
        assert about == [f"the goal is {problem.goal_inside}: a plan that ends there collides"]
        assert f"{depth:.3g} m inside obstacle 'pillar'" in problem.goal_inside
    else:
        assert (about, problem.goal_inside) == ([], "")


def test_where_a_goal_is_inside_is_known_of_constraints_and_of_what_moves() -> None:
    """A ball that is 1 m away at the start, and at the goal when the plan ends."""
    ball = ls.Obstacle(
        "ball", "sphere", np.array([3.0, 0, 0]), np.eye(3), np.array([0.2, 0, 0]), velocity=np.array([1.0, 0, 0])
    )
    stage, kept = ls.ControlCost([1.0], about=[0.0]), [ls.Clearance(ls.World([ball]), radius=0.1), ls.GoalState(x=4.0)]
    problem = ls.Problem(**{**FIELDS, "stage_cost": stage, "constraints": kept})
    assert problem.goal_inside == "at (4, 0) m, 0.3 m inside obstacle 'ball'"
    assert not dataclasses.replace(problem, begin=1.0).goal_inside


@settings(max_examples=examples(50))
@given(
    st.integers(0, 2**32 - 1), st.integers(2, 6), st.sampled_from([(), (5,), (2, 3)]), st.sampled_from([1e-200, 1, 1e9])
)
def test_what_is_symmetric_is_measured_by_the_largest_entry_of_its_matrix(
    seed: int, n: int, leading: tuple[int, ...], size: float
) -> None:
    """An entry off by 1e-12 of that is rounding; one that is off by 1e-8 is an error, and the message names it."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(*leading, n, n))
    matrices = size * 10.0 ** rng.uniform(-9, 0, (*leading, 1, 1)) * (roots + np.swapaxes(roots, -1, -2))
    np.testing.assert_array_equal(check_symmetric("it", matrices), matrices)
    where, (i, j) = tuple(int(rng.integers(k)) for k in leading), rng.choice(n, 2, replace=False).tolist()
    largest, before = np.abs(matrices[where]).max(), matrices[(*where, i, j)]
    matrices[(*where, i, j)] = before + 1e-12 * largest
    found = check_symmetric("it", matrices)
    np.testing.assert_array_equal(found, np.swapaxes(found, -1, -2))
    np.testing.assert_allclose(found, matrices, rtol=0, atol=1e-12 * largest)
    matrices[(*where, i, j)] = before + 1e-8 * largest
    with pytest.raises(ls.InputError, match=r"it: got .* and .*, want a symmetric matrix") as caught:
        check_symmetric("it", matrices)
    assert str([*where, i, j]) in str(caught.value)
    assert str([*where, j, i]) in str(caught.value)


def test_an_obstacle_cost_needs_a_position() -> None:
    nowhere = ls.Dynamics(lambda x, u, p: [u[0]], states={"x": ""}, controls={"u": ""})
    with pytest.raises(ls.InputError, match="got dynamics without a position"):
        ls.Problem(
            dynamics=nowhere,
            dt=0.1,
            steps=2,
            initial=ls.FixedState([0.0]),
            stage_cost=ls.ObstacleCost(PILLAR, radius=0.1),
            final_cost=ls.QuadraticCost([1.0], about=[0.0]),
        )


def test_a_prior_may_be_about_a_trajectory(differential_drive: ls.Scenario) -> None:
    """Constant in time it is the same prior, to the last bit; in continuous time it is a line between the steps."""
    problem, prior = differential_drive.problem, differential_drive.paper_start
    assert prior is not None
    along = ls.InitialPrior(prior.weight, about=np.tile(prior.about, (problem.steps + 1, 1)), iterations=2)
    one, other = ls.smooth(problem, start=prior), ls.smooth(problem, start=along)
    np.testing.assert_array_equal(one.policy.gain, other.policy.gain)
    np.testing.assert_allclose(ls.InitialPrior([1.0], about=[[0.0], [2.0], [6.0]]).at(1.25), [3.0], rtol=1e-15)
    np.testing.assert_array_equal(ls.InitialPrior([1.0], about=[[0.0], [2.0], [6.0]]).at(2.0), [6.0])


def test_a_control_cost_is_about_no_control_unless_told() -> None:
    np.testing.assert_array_equal(ls.ControlCost([[2.0, 0.1], [0.1, 1.0]]).about, np.zeros(2))


WEIGHTS = st.dictionaries(st.sampled_from([*STATES, *STATES.values()]), st.floats(0.0, 100.0), min_size=1)


def in_order(given: dict[str, float]) -> list[float]:
    """By hand: a name wins over a unit, and the rest are 0."""
    return [given.get(name, given.get(unit, 0.0)) for name, unit in STATES.items()]


@settings(max_examples=examples(50))
@given(weight=WEIGHTS, about=WEIGHTS, start=WEIGHTS, effort=st.floats(0.1, 10.0), unit=st.booleans(), push=WEIGHTS)
def test_numbers_by_name_or_unit_are_those_in_order(
    weight: dict, about: dict, start: dict, effort: float, unit: bool, push: dict
) -> None:
    key = "N" if unit else "force"
    named = ls.Problem(**{
        **FIELDS,
        "initial": ls.FixedState(start),
        "stage_cost": ls.ControlCost({key: effort}, about={key: 1.0}),
        "final_cost": ls.QuadraticCost(weight, about=about),
        "control_limits": {key: (-effort, 2 * effort)},
    })  # fmt: skip
    listed = ls.Problem(**{
        **FIELDS,
        "initial": ls.FixedState(in_order(start)),
        "stage_cost": ls.ControlCost([effort], about=[1.0]),
        "final_cost": ls.QuadraticCost(in_order(weight), about=in_order(about)),
        "control_limits": (-effort, 2 * effort),
    })  # fmt: skip
    assert named.digest == listed.digest
    np.testing.assert_array_equal(named.goal, listed.goal)
    np.testing.assert_array_equal(named.start, in_order(start))
    np.testing.assert_array_equal(named.nominal_control, [1.0])
    bound = ls.QuadraticCost(weight, about=about).bind(named.dynamics)
    np.testing.assert_array_equal(bound.data, listed.terms("final_cost")[0].data)
    again = named.with_costs(final_cost=ls.QuadraticCost(push, about=about))
    np.testing.assert_array_equal(again.goal, in_order(about))


SHUFFLED = st.permutations(["count", "index", "names", "v", "x"])  # attributes of tuples are names, too


@settings(max_examples=examples(20))
@given(states=SHUFFLED, controls=st.permutations(["turn", "push"]), seed=st.integers(0, 2**16))
def test_formulas_know_states_and_controls_by_name(states: list[str], controls: list[str], seed: int) -> None:
    """The same system with its states in any order: its rates by name do not depend on the order, to the last bit."""

    def rates(x: Any, u: Any, p: Any) -> list[Any]:
        found = {"count": x.v * u.turn, "index": p.gain * x.x, "names": x.count + x.index, "v": u.push, "x": x.names}
        assert x[1:3] == (x[1], x[2])
        assert getattr(x[1:3], states[1]) is x[1]
        return [found[name] for name in states]

    dynamics = ls.Dynamics(
        rates, states=dict.fromkeys(states, "m"), controls=dict.fromkeys(controls, "N"), parameters={"gain": 3.0}
    )
    at = dict(zip([*states, *controls], np.random.default_rng(seed).normal(size=7), strict=True))
    found = dict(zip(states, dynamics.rate([at[one] for one in states], [at[one] for one in controls]), strict=True))
    assert found == {
        "count": at["v"] * at["turn"], "index": 3.0 * at["x"], "names": at["count"] + at["index"], "v": at["push"],
        "x": at["names"],
    }  # fmt: skip
    wrong = ls.Dynamics(lambda x, u, p: [x.speed], states={"v": "m/s"}, controls={"u": "N"})
    with pytest.raises(ls.InputError, match="got 'speed', want one of: v"):
        wrong.rate([0.0], [0.0])


class TestProblemsThatBeginInside:
    """The rest of a problem may begin inside an obstacle, whatever else is asked of it; a new problem may not."""

    NOISE = ls.Noise(0.01 * np.eye(2))

    def problem(self, **fields: Any) -> ls.Problem:
        world = ls.World([ls.Obstacle("ball", "sphere", np.zeros(3), np.eye(3), np.array([0.3, 0.0, 0.0]))])
        dynamics = ls.Dynamics(
            lambda x, u, p: [u[0], u[1]], states={"x": "m", "y": "m"}, controls={"u": "m/s", "v": "m/s"},
            position=("x", "y"),
        )  # fmt: skip
        return ls.Problem(
            dynamics=dynamics, dt=0.1, steps=20, initial=ls.FixedState(x=-2.0),
            stage_cost=ls.ControlCost([0.1, 0.1]) + ls.ObstacleCost(world, radius=0.1),
            final_cost=ls.QuadraticCost([100.0, 100.0], about=[2.0, 0.0]), **fields,
        )  # fmt: skip

    @pytest.mark.parametrize(
        "fields",
        [
            {}, {"noise": NOISE, "risk": 0.01}, {"accuracy": 1e-8}, {"between_knots": True},
            {"duration": (0.5, 3.0), "time_weight": 1.0}, {"control_rate": ls.ControlRate(weight=0.01)},
            {"segments": [10]},
        ],
    )  # fmt: skip
    @settings(max_examples=examples(3))
    @given(place=st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25)), after=st.integers(0, 9))
    def test_they_are_solved_and_printed(self, fields: dict[str, Any], place: tuple[float, float], after: int) -> None:
        stated = self.problem(**fields)
        rest = stated.from_state(place, after=0 if stated.duration else after)
        solution = ls.smooth(rest, max_iterations=30)
        np.testing.assert_array_equal(solution.trajectory.states[0], place)
        assert str(solution).startswith(solution.status.name)
        if not {"control_rate", "duration", "accuracy"} & fields.keys():
            assert np.isfinite(ls.smooth(rest, noise=self.NOISE, max_iterations=3).cost)
        with pytest.raises(ls.InputError, match=r"initial: got a start at .* inside obstacle 'ball'"):
            dataclasses.replace(rest, initial=ls.FixedState(place))
        if rest.control_rate is not None:  # as for softer contacts
            wide = with_last_command(rest)
            again = dataclasses.replace(wide, dynamics=wide.dynamics)
            np.testing.assert_array_equal(again.start, [*place, 0.0, 0.0])

    @settings(max_examples=examples(6))
    @given(away=st.floats(-0.2, 0.2), soft=st.booleans())
    def test_so_may_those_that_begin_later(self, away: float, soft: bool) -> None:
        """When an obstacle that moves is where the robot starts."""
        ball = ls.Obstacle(
            "ball", "sphere", np.array([-3.0, away, 0.0]), np.eye(3), np.array([0.3, 0.0, 0.0]),
            velocity=np.array([1.0, 0.0, 0.0]),
        )  # fmt: skip
        stated = self.problem()
        cost = ls.ControlCost([0.1, 0.1]) + ls.ObstacleCost(ls.World([ball]), radius=0.1)
        start = ls.QuadraticCost([100.0, 100.0], about=[-2.0, 0.0]) if soft else stated.initial
        later = dataclasses.replace(stated, initial=start, stage_cost=cost).later(1.0)
        solution = ls.smooth(later, max_iterations=30)
        assert str(solution).startswith(solution.status.name)
        assert np.isfinite(ls.smooth(later, noise=self.NOISE, max_iterations=3).cost)
        with pytest.raises(ls.InputError, match="inside obstacle 'ball'"):
            dataclasses.replace(later, initial=start)

    def test_a_segment_of_which_one_step_is_left_is_part_of_the_next(self) -> None:
        stated = self.problem(segments=[4, 10])
        for after, left in ((0, (4, 10)), (2, (2, 8)), (3, (7,)), (4, (6,)), (8, (2,)), (9, ()), (15, ())):
            rest = stated.from_state([-1.0, 1.0], after=after)
            assert rest.segments == left
            assert dataclasses.replace(rest, risk=0.0).segments == left


class TestOtherParts:
    """Costs and constraints are refused in place of others as they are in a new problem."""

    WORLD = ls.World([
        ls.Obstacle(
            "ball", "sphere", np.array([1.0, 5.0, 0.0]), np.eye(3), np.array([0.3, 0.0, 0.0]),
            velocity=np.array([1.0, 0.0, 0.0]),
        )
    ])  # fmt: skip
    PARTS: ClassVar[dict[str, Any]] = {
        "constraints": [ls.Clearance(WORLD, radius=0.1)],
        "stage_cost": ls.ControlCost([0.1, 0.1]) + ls.ObstacleCost(WORLD, radius=0.1),
        "final_cost": ls.ControlCost([1.0, 1.0]) + ls.QuadraticCost([1.0, 1.0], about=[2.0, 0.0]),
    }

    @pytest.mark.parametrize(
        "fields", [{}, {"duration": (0.5, 3.0), "time_weight": 1.0}, {"between_knots": True}, {"segments": [10]}]
    )
    @pytest.mark.parametrize("part", PARTS)
    def test_they_are_refused_alike(self, part: str, fields: dict[str, Any]) -> None:
        problem, other = TestProblemsThatBeginInside().problem(**fields), {part: self.PARTS[part]}

        def said(make: Callable[[], ls.Problem]) -> str:
            try:
                make()
            except ls.InputError as error:
                return str(error)
            return ""

        stated = said(lambda: dataclasses.replace(problem, **other))
        assert (
            said(lambda: problem.with_constraints(**other) if part == "constraints" else problem.with_costs(**other))
            == stated
        )
        assert bool(stated) == (part == "final_cost" or bool({"duration", "between_knots"} & fields.keys()))

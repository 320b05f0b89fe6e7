"""A final time that is free: closed forms, differences in the duration, and other solves of the settled problem."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples, rarely
from scipy.integrate import solve_ivp
from scipy.optimize import linprog
from sympy import cos, sin

import lqrsim as ls
import lqrsim.gym
from lqrsim import cli
from lqrsim.results.solution_parts import Status
from lqrsim.scenarios.references import resolve
from lqrsim.solvers import budget, free_duration, smoother, strategy
from lqrsim.solvers.settings import SmootherSettings


def cart(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], p.push * u[0]]


def problem(
    *, way: float = 1.0, push: float = 1.0, steps: int = 20, weight: float = 1e-6, **options: Any
) -> ls.Problem:
    dynamics = ls.Dynamics(
        cart, states={"x": "m", "v": "m/s"}, controls={"push": ""}, parameters={"push": push}, control_limits=(-1, 1)
    )
    told: dict[str, Any] = {"duration": (0.1, 20.0), "time_weight": 1.0} | options
    return ls.Problem(
        dynamics=dynamics, dt=4.0 / steps, steps=steps, initial=ls.FixedState([0.0, 0.0]),
        stage_cost=ls.ControlCost([weight]), final_cost=ls.QuadraticCost([0.0, 0.0], about=[way, 0.0]),
        constraints=[ls.GoalState([way, 0.0])], **told,
    )  # fmt: skip


@settings(max_examples=examples(15))
@given(st.floats(0.1, 5.0), st.floats(0.3, 3.0), st.integers(5, 20))
def test_a_cart_pushes_and_brakes_for_half_of_the_way_each(way: float, push: float, half: int) -> None:
    """The least time is 2 sqrt(way / push); an even number of steps can have the switch where it belongs.

    Next to nothing for the control changes it by less than a part in a million.
    """
    solution = ls.smooth(problem(way=way, push=push, steps=2 * half))
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.horizon == pytest.approx(2 * np.sqrt(way / push), rel=1e-6)
    expected = np.repeat([1.0, -1.0], half)
    np.testing.assert_allclose(solution.trajectory.controls[:, 0], expected, atol=1e-6)


def test_bounds_and_goals_by_unit_are_of_the_states_alone() -> None:
    """A free duration is in s, too; a clock among the states has the bounds of its unit, and the duration has none."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [x[1], u[0], 1.0], states={"x": "m", "v": "m/s", "clock": "s"}, controls={"push": "m/s^2"},
        control_limits=(-1, 1),
    )  # fmt: skip
    free = ls.Problem(
        dynamics=dynamics, dt=0.2, steps=20, initial=ls.FixedState(np.zeros(3)), stage_cost=ls.ControlCost([1e-6]),
        final_cost=ls.QuadraticCost(np.zeros(3), about=[1.0, 0.0, 0.0]), duration=(0.1, 20.0), time_weight=1.0,
    )  # fmt: skip
    goal = ls.GoalState(x=1.0, v=0.0)
    kept = (
        (ls.StateBounds({"s": (-1.0, 9.0)}), ls.StateBounds(clock=(-1.0, 9.0)), 2.0),
        (ls.GoalState({"s": 3.0}), ls.GoalState(clock=3.0), 3.0),
    )
    for by_unit, by_name, seconds in kept:  # two are the least
        one, other = (ls.smooth(dataclasses.replace(free, constraints=[goal, kept])) for kept in (by_unit, by_name))
        assert one.status is Status.CONVERGED
        np.testing.assert_array_equal(one.trajectory.states, other.trajectory.states)
        assert one.trajectory.horizon == pytest.approx(seconds, rel=1e-6)


def test_a_control_that_costs_nothing_stands_at_its_limits() -> None:
    free = dataclasses.replace(problem(), stage_cost=ls.SymbolicCost(lambda x, u, p: 1e-12 * x[0] ** 2, convex=True))
    solution = ls.smooth(free)
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.horizon == pytest.approx(2.0, rel=1e-9)
    np.testing.assert_array_equal(np.abs(solution.trajectory.controls), 1.0)


@pytest.mark.parametrize(("weight", "way"), [(1e-12, 2.7), (1e-9, 1.0), (1.0, 0.3)])
def test_a_cost_that_is_zero_where_the_goal_is_met_is_no_worse_than_zero(weight: float, way: float) -> None:
    """Two plans that meet the goal differ by rounding alone, however small or large the weight is."""
    free = dataclasses.replace(
        problem(way=way), stage_cost=ls.SymbolicCost(lambda x, u, p: 0 * x[0], convex=True),
        final_cost=ls.QuadraticCost([weight, weight], about=[way, 0.0]),
    )  # fmt: skip
    solution = ls.smooth(free)
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.horizon == pytest.approx(2 * np.sqrt(way), rel=1e-9)
    np.testing.assert_allclose(np.abs(solution.trajectory.controls), 1.0, rtol=0, atol=1e-6)


def _least_at_a_price(way: float, seconds: float, steps: int, price: float) -> float:
    """The least price of what the goal is missed by, x and v, in that time: a linear program, by SciPy."""
    dt, left = seconds / steps, steps - 0.5 - np.arange(steps)
    ends = np.stack([left * dt**2, np.full(steps, dt)])  # of x and of v, by the push of each step
    ways = np.hstack([ends, np.eye(2), -np.eye(2)])
    found = linprog(
        np.r_[np.zeros(steps), np.full(4, price)], A_eq=ways, b_eq=[way, 0.0],
        bounds=[(-1, 1)] * steps + [(0, None)] * 4,
    )  # fmt: skip
    assert found.success
    return float(found.fun)


@pytest.mark.parametrize("way", [1.0, 9.0])
@pytest.mark.parametrize("price", [0.05, 0.6, 50.0])
def test_a_goal_at_a_price_is_weighed_against_time(way: float, price: float) -> None:
    """With at most 4 s; a way of 9 m takes 6."""
    steps, low, high = 12, 1.5, 4.0
    free = problem(way=way, steps=steps, duration=(low, high), weight=1e-8)
    solution = ls.smooth(free, elastic=price)
    assert solution.status is Status.CONVERGED, solution.detail
    seconds, end = solution.trajectory.horizon, solution.trajectory.states[-1]
    paid = seconds + price * (abs(end[0] - way) + abs(end[1]))
    assert low <= seconds <= high
    assert paid == pytest.approx(seconds + _least_at_a_price(way, seconds, steps, price), abs=1e-5)
    assert paid <= min(one + _least_at_a_price(way, one, steps, price) for one in np.linspace(low, high, 26)) + 1e-5


@pytest.mark.parametrize("kind", ["a state", "a parameter", "both", "a disturbance"])
def test_names_of_the_system_may_be_those_of_the_duration(kind: str) -> None:
    """The least time is 2 sqrt(way / push), whatever the names."""
    name = "stated_duration" if kind in ("a parameter", "both") else "push"
    states = {"x": "m", "duration" if kind in ("a state", "both") else "v": "m/s"}
    known: dict[str, Any] = {"disturbances" if kind == "a disturbance" else "parameters": {name: 0.5}}
    dynamics = ls.Dynamics(
        lambda x, u, p: [x[1], getattr(p, name) * u[0]], states=states, controls={"u": ""}, control_limits=(-1, 1),
        **known,
    )  # fmt: skip
    solution = ls.smooth(dataclasses.replace(problem(), dynamics=dynamics.disturbed))
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.horizon == pytest.approx(2 * np.sqrt(2), rel=1e-6)


@pytest.mark.parametrize("price", [5.0, 20.0])
def test_no_other_duration_costs_less(price: float) -> None:
    """A pendulum, swung up: of neighbouring durations, each solved on its own, the costs are higher, as a square."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [x[1], -9.81 * _sine(x[0]) + u[0]], states={"angle": "rad", "rate": "rad/s"},
        controls={"torque": "N m"}, control_limits=(-12, 12),
    )  # fmt: skip
    free = ls.Problem(
        dynamics=dynamics, dt=0.05, steps=40, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.05]),
        final_cost=ls.QuadraticCost([0.0, 0.0], about=[np.pi, 0.0]), constraints=[ls.GoalState([np.pi, 0.0])],
        duration=(0.3, 8.0), time_weight=price,
    )  # fmt: skip
    solution = ls.smooth(free)
    assert solution.status is Status.CONVERGED
    best, plan = solution.trajectory.horizon, solution.trajectory
    costs = []
    for share in (0.998, 1.0, 1.002):
        other = free._of_duration(share * best)
        found = ls.smooth(other, start=ls.Trajectory(plan.states, plan.controls, other.dt))
        assert found.status is Status.CONVERGED
        costs.append(found.cost + price * share * best)
    low, here, high = costs
    assert min(low, high) > here
    # Its slope is next to nothing beside its curvature over such a step.
    assert abs(high - low) < 0.2 * (high + low - 2 * here)
    assert here == pytest.approx(solution.cost + price * best, rel=1e-9)


def _sine(angle: Any) -> Any:
    from sympy import sin

    return sin(angle)


def test_a_duration_that_is_not_the_best_is_not_dropped_for_the_stated_one() -> None:
    """The stated 4 s take three iterations, and the least time of 2 s seven: with six there is a plan between."""
    solution = ls.smooth(problem(time_weight=5.0), max_iterations=6, safeguard=False)
    assert solution.status is Status.MAX_ITERATIONS
    assert "the best duration was not found" in solution.detail
    assert solution.remedy.startswith("raise max_iterations")
    assert solution.violation <= 1e-6
    assert 2.0 <= solution.trajectory.horizon < 4.0 - 1e-3


def test_a_search_that_ends_early_goes_on_from_its_own_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each search has fewer iterations than it mostly needs, six to nine; the limit of the solve allows many.

    Far from the limits, the effort for a duration T is that of the least pushes from rest to rest, effort / T^4, so the
    best duration is (4 effort / price)^(1/5). A search may end so far away that there is nothing to go on from.
    """
    monkeypatch.setattr(free_duration, "SHORTENED", 0)
    draws, ended = np.random.default_rng(0), []
    for _ in range(24):
        way, push, weight = np.exp(draws.uniform(np.log([0.3, 0.5, 0.1]), np.log([3.0, 3.0, 1.0]))).tolist()
        monkeypatch.setattr(free_duration, "MOST", int(draws.integers(4, 7)))
        free = dataclasses.replace(problem(way=way, push=push, weight=weight), control_limits=(-100, 100))
        steps = np.arange(free.steps)
        reached = push * np.stack([(free.steps - steps - 0.5) / free.steps**2, np.full(free.steps, 1 / free.steps)])
        effort = 0.5 * weight * np.sum(np.linalg.lstsq(reached, np.array([way, 0.0]), rcond=None)[0] ** 2)
        solution = ls.smooth(free)
        ended.append(solution.status)
        if solution.success:
            assert solution.trajectory.horizon == pytest.approx((4 * effort) ** 0.2, rel=1e-6)
    assert set(ended) <= {Status.CONVERGED, Status.STALLED}
    assert ended.count(Status.CONVERGED) >= 20  # without going on, fewer than half


@pytest.mark.parametrize("seed", range(2))
def test_the_status_of_a_search_without_success_is_true(seed: int) -> None:
    """In the longest duration the mass gets as far as a quarter of its square, and the goal is farther."""
    draws = np.random.default_rng(seed)
    longest = float(draws.uniform(4.0, 6.0))
    far = float(draws.uniform(1.1, 2.0)) * longest**2 / 4
    solution = ls.smooth(problem(way=far, duration=(1.0, longest)), max_iterations=5000)
    assert solution.status is Status.INFEASIBLE
    assert solution.detail.startswith(f"even in {longest:g} s the goal of {far:g} m for x is missed by ")
    assert solution.remedy.startswith(f"allow more time than {longest:g} s, relax ")
    spent = sum(candidate.iterations for candidate in solution.candidates)
    assert solution.detail.endswith(f"; {spent} iterations in all solves")
    longer = ls.smooth(problem(way=far, duration=(1.0, 2 * longest)))
    assert longer.success
    spent = len(longer.iterations) + sum(candidate.iterations for candidate in longer.candidates)
    assert spent <= int(longer.detail.removesuffix(" iterations in all solves"))
    assert "\n  remedy:" in str(solution)


def test_seconds_of_an_iteration_are_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that only runs while fixed durations are solved for, which is part of no iteration of the search."""
    now = [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0])
    monkeypatch.setattr(budget, "time", clock)

    stop = budget.Stop()
    stop.begin(1e6)

    def solve(fixed: ls.Problem, settings: SmootherSettings) -> ls.Solution:
        now[0] += 100.0
        return strategy.Search(fixed, settings, stop).solve()

    solution = free_duration.solve_for_duration(problem(), SmootherSettings(), solve, stop)
    assert solution.status is Status.CONVERGED
    assert now[0] >= 300.0  # the stated duration, a shorter one, and the end
    assert max(one.seconds for one in solution.iterations) < 50.0


@pytest.mark.parametrize("share", [0.01, 0.3, *rarely(0.1, 0.6, 0.9)])
def test_the_time_limit_is_that_of_the_whole_solve(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """On a clock that advances whenever it is read, so that a solve takes the same time on every machine.

    The stated second is too short, so most of the time is that of the solve for it. A plan that the search has found
    until then is an optimum; to return it takes some more readings, however long the limit is.
    """
    now = [0.0]

    def read() -> float:
        now[0] += 1.0
        return now[0]

    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=read))
    short, options = dataclasses.replace(problem(), dt=1 / 20), SmootherSettings()
    assert smoother.solve(short, options, budget.Stop()).success
    whole, now[0] = now[0], 0.0
    limited = smoother.solve(short, dataclasses.replace(options, time_limit=share * whole), budget.Stop())
    assert limited.status is Status.TIME_LIMIT or (limited.success and share > 0.01)
    assert now[0] <= share * whole + 40
    assert whole > 300


def test_a_duration_ends_at_its_bound() -> None:
    solution = ls.smooth(problem(duration=(3.0, 5.0)))
    assert solution.trajectory.horizon == pytest.approx(3.0, abs=1e-7)
    assert "\n  duration:  3 s, free from 3 to 5 s, at a price of 1 a second\n" in str(solution)
    assert re.search(r"\n  detail:    \d+ iterations in all solves\n", str(solution))
    solution = ls.smooth(problem(weight=1.0, duration=(1.0, 5.0), time_weight=0.0))
    assert solution.trajectory.horizon == pytest.approx(5.0, abs=1e-6)


def test_the_policy_runs_with_the_period_of_the_plan(differential_drive: ls.Scenario) -> None:
    stated = differential_drive.problem
    assert stated.goal is not None
    free = dataclasses.replace(stated, duration=(5.0, 60.0), time_weight=1.0, constraints=[ls.GoalState(stated.goal)])
    solution = ls.smooth(free)
    assert solution.status is Status.CONVERGED
    plan = solution.trajectory
    assert solution.policy.dt == plan.dt
    plant = differential_drive.plant()
    with pytest.raises(ls.InputError, match=r"plant\.for_period"):
        ls.simulate(plant, solution)
    fitting = plant.for_period(plan.dt)
    assert fitting.timestep <= plant.timestep
    assert plan.dt / fitting.timestep == pytest.approx(fitting.substeps(plan.dt), rel=1e-12)
    assert ls.simulate(fitting, solution, seed=0).outcome[0] == "reached"
    assert plant.for_period(4 * plant.timestep).timestep == pytest.approx(plant.timestep, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"duration": (5.0, 6.0)}, "between"),
        ({"duration": (0.0, 6.0)}, "above 0"),
        ({"duration": None}, "time_weight: got 1 without a duration"),
        ({"time_weight": -1.0}, "time_weight"),
    ],
)
def test_what_makes_no_sense_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ls.InputError, match=said):
        problem(**changes)


@pytest.mark.parametrize("dt", [0.05, 0.1, 0.02, 1 / 6])
def test_a_bound_that_is_the_stated_duration_in_decimals_contains_it(dt: float) -> None:
    """3 * 0.1 is more than 0.3, and 3 * 0.7 is less than 2.1; a millionth further is outside."""
    free = problem()
    for steps in range(1, 50):
        stated = round(steps * dt, 10)
        for duration in ((stated / 2, stated), (stated, 2 * stated)):
            assert dataclasses.replace(free, dt=dt, steps=steps, duration=duration).duration == duration
        for duration in ((stated / 2, stated * (1 - 1e-6)), (stated * (1 + 1e-6), 2 * stated)):
            with pytest.raises(ls.InputError, match="between"):
                dataclasses.replace(free, dt=dt, steps=steps, duration=duration)


@pytest.mark.parametrize("duration", [(0.1, 0.3), (0.3, 0.9)])
def test_a_duration_is_found_from_a_bound_that_rounding_exceeds(duration: tuple[float, float]) -> None:
    """In three steps of h (push, coast, brake) the cart goes 2 h^2. The result may be stated again with the bounds."""
    free = dataclasses.replace(problem(way=0.02, steps=3), dt=0.1, duration=duration)
    solution = ls.smooth(free)
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.horizon == pytest.approx(0.3, rel=1e-6)
    again = dataclasses.replace(free, dt=solution.trajectory.dt)
    assert ls.smooth(again).trajectory.horizon == pytest.approx(0.3, rel=1e-6)


def test_solvers_that_cannot_free_it_say_so() -> None:
    free = problem()
    with pytest.raises(ls.InputError, match="duration"):
        ls.ilqr(dataclasses.replace(free, constraints=()))
    with pytest.raises(ls.InputError, match="duration"):
        ls.prepare(free)
    fixed = dataclasses.replace(free, duration=None, time_weight=0.0)
    with pytest.raises(ls.InputError, match="duration"):
        ls.prepare(fixed).check(free)
    with pytest.raises(ls.InputError, match="duration"):
        ls.smooth(free, finish=None)
    soft = dataclasses.replace(free, constraints=(), initial=ls.QuadraticCost([9.0, 9.0], about=[0.0, 0.0]))
    with pytest.raises(ls.InputError, match="duration"):
        ls.lq.smooth_continuous(soft)


@pytest.mark.parametrize("longest", [4.0, 4.5, 20.0])
@pytest.mark.parametrize("shortest", [0.1, 3.0, 3.9])
@pytest.mark.parametrize("after", [1, 8, 19])
def test_the_rest_of_a_plan_has_the_time_that_is_left(longest: float, shortest: float, after: int) -> None:
    """What is over and what follows take together no less than the shortest and no more than the longest duration."""
    near = ls.QuadraticCost([1.0, 1.0], about=[1.0, 0.0])
    whole = dataclasses.replace(problem(duration=(shortest, longest)), constraints=(), final_cost=near)
    rest = whole.from_state([0.5, 0.1], after=after)
    past = after * whole.dt
    assert rest.duration is not None
    low, high = rest.duration
    assert past + high == pytest.approx(longest)
    assert low == pytest.approx(max(shortest - past, 1e-3 * high))
    dataclasses.replace(rest)  # it is as a new problem may be
    assert low * (1 - 1e-9) <= ls.smooth(rest).trajectory.horizon <= high * (1 + 1e-9)


HURRIED = """
import dataclasses

import numpy as np

import lqrsim as ls


def hurried() -> ls.Scenario:
    stated = ls.scenarios.differential_drive()
    problem = dataclasses.replace(
        stated.problem, dt=1 / 6, steps=30, initial=ls.FixedState((0.0, -2.5, np.pi)),
        stage_cost=ls.ControlCost((60.0, 60.0), about=(0.25, 0.25)), duration=(1.0, 20.0), time_weight=1.0,
        final_cost=ls.QuadraticCost((1.0, 1.0, 1.0), about=(-0.8, -2.5, np.pi)),
        constraints=[ls.GoalState((-0.8, -2.5, np.pi))],
    )
    noise = ls.disturbances.ControlNoise(0.01)
    return dataclasses.replace(stated, name="hurried", problem=problem, disturbances=(noise,))
"""


def test_commands_run_a_plan_in_the_duration_that_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its control period is no multiple of the physics step of the MJCF; by plain MuJoCo the plan ends at its goal."""
    monkeypatch.chdir(tmp_path)
    Path("hurried.py").write_text(HURRIED)
    own = ["--scenario", "hurried.py:hurried"]
    assert cli.main(["solve", "hurried.py:hurried", "--figure", "hurried.png"]) == 0
    solution = ls.load("runs/hurried/solution.npz", ls.Solution)
    scenario = resolve("hurried.py:hurried")
    dt, physics = solution.trajectory.dt, scenario.scene.model.opt.timestep
    assert abs(dt / physics - round(dt / physics)) > 1e-3
    for controller in ("feedback", "track"):
        given = ["runs/hurried/solution.npz", *own, "--controller", controller, "--out", controller]
        assert cli.main(["simulate", *given, "--disturbances", "scenario"]) == 0
        rollout = ls.load(f"{controller}/rollout.npz", ls.Rollout)
        assert rollout.outcome == ("reached",)
        assert rollout.times[-1] == pytest.approx(solution.trajectory.horizon)
        assert rollout.tube is not None
    assert cli.main(["demo", "--robots", "hurried.py:hurried", "--no-video", "--out", "videos"]) == 0
    assert ls.load("videos/hurried/disturbed.npz", ls.Rollout).tube is not None
    policies = ["--policies", "smooth", "track", "offset_free", "replan"]
    few = ["--trials", "2", "--strengths", "1", "--sweep", "scenario", "--workers", "0"]
    assert cli.main(["stress", "hurried.py:hurried", *policies, *few]) == 0
    results = ls.stress.Results("runs/stress/hurried", scenario="hurried.py:hurried")
    assert all(results.cell_summaries()[cell].tally["reached"] == 2 for cell in results.cells)
    reliability = ls.stress.ReliabilityProblem("hurried.py:hurried", solution="runs/hurried/solution.npz")
    assert reliability.score.plant.substeps(dt) == round(np.ceil(dt / physics))


def test_a_gymnasium_environment_has_the_duration_that_was_found(tmp_path: Path) -> None:
    (tmp_path / "hurried.py").write_text(HURRIED)
    environment = lqrsim.gym.Environment(f"{tmp_path / 'hurried.py'}:hurried")
    environment.reset(seed=0)
    solution, ended, steps = environment.task.solution, False, 0
    while not ended:
        *_, terminated, truncated, _ = environment.step(
            environment.task.actions_of(solution.trajectory.controls[steps])
        )
        ended, steps = terminated or truncated, steps + 1
    assert steps == solution.trajectory.steps


def near(x: Any, u: Any, p: Any) -> Any:
    return p.radius**2 - (x[0] - p.x) ** 2


def by_waypoints(places: list[float], knots: list[int], end: float, steps: int = 40, **options: Any) -> ls.Problem:
    """A cart that passes places, within a centimetre, on its way to where it stops."""
    passed = ls.SymbolicConstraint(near, parameters={"x": places, "radius": 0.01}, at=knots, name="waypoint")
    return dataclasses.replace(
        problem(way=end, steps=steps, weight=1e-5), dt=0.2, constraints=[ls.GoalState([end, 0.0]), passed],
        **{"segments": knots} | options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("places", "knots", "end"),
    [([2.0], [20], -1.0), ([2.0], [6], -1.0), ([2.0, -1.0], [10, 20], 0.5), *rarely(([1.0], [30], -2.0))],
)
def test_segments_take_the_times_that_they_need(
    places: list[float], knots: list[int], end: float, tmp_path: Path
) -> None:
    """There and back: at each waypoint the cart turns a centimetre before it, so segments last 2 sqrt(way) each.

    That the turns and the switches between them are at knots costs some thousandths, and half a step for each turn.
    """
    solution = ls.smooth(by_waypoints(places, knots, end))
    assert solution.status is Status.CONVERGED, solution.detail
    turns = np.array([0.0, *(place - 0.01 * np.sign(place) for place in places), end])
    seconds = 2 * np.sqrt(np.abs(np.diff(turns)))
    assert seconds.sum() * (1 - 1e-6) <= solution.trajectory.horizon <= 1.005 * seconds.sum()
    fixed = by_waypoints(places, knots, end).with_duration_of(solution)
    assert ls.load(ls.save(solution, tmp_path / "plan.npz"), ls.Solution).options == solution.options
    assert fixed.duration is None
    assert fixed.dt == pytest.approx(solution.trajectory.dt)
    ends = np.cumsum(seconds)[:-1]
    np.testing.assert_allclose(np.array(fixed.segments) * fixed.dt, ends, rtol=0, atol=fixed.dt)
    # The waypoints moved along: the plan keeps the fixed problem, and is its optimum.
    passed = solution.trajectory.states[list(fixed.segments), 0]
    np.testing.assert_allclose(passed, turns[1:-1], rtol=0, atol=1e-5)
    assert fixed.digest == solution.problem_digest
    again = ls.smooth(fixed, start=solution)
    assert again.status is Status.CONVERGED
    assert again.cost == pytest.approx(solution.cost, rel=1e-6)


def test_rows_by_knot_move_with_segments() -> None:
    """Each knot has the row of its own segment, and ends of segments keep theirs."""
    lows = np.full(41, -np.inf)
    lows[20] = 1.5  # a gate at the end of the first segment
    rows = np.column_stack([np.arange(41.0), np.zeros(41)])
    stated = by_waypoints([2.0], [20], -1.0)
    stage = ls.ControlCost([1e-5]) + ls.QuadraticCost([1e-9, 0.0], about=rows)
    stated = dataclasses.replace(
        stated, stage_cost=stage, constraints=[*stated.constraints, ls.StateBounds(x=(lows, 9))]
    )
    moved = stated._with_segments([8])
    _, waypoint, gate = moved.constraints
    assert moved.segments == waypoint.at == (8,)  # pyright: ignore[reportAttributeAccessIssue]
    ((low, _),) = gate.state_bounds(stated.dynamics).values()
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(low)), [8])
    about = moved.stage_cost.terms[1].about[:, 0]  # pyright: ignore[reportAttributeAccessIssue]
    assert about[[0, 8, 40]].tolist() == [0.0, 20.0, 40.0]
    assert (np.diff(about) >= 0).all()
    assert (about[1:8] < 20).all()
    assert (about[9:40] > 20).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"segments": [20, 10]}, "knots in order"),
        ({"segments": [1]}, "2 steps"),
        ({"segments": [39]}, "2 steps"),
        ({"segments": [2.5]}, "whole numbers"),
        ({"between_knots": True}, "between_knots"),
    ],
)
def test_segments_that_make_no_sense_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ls.InputError, match=said):
        by_waypoints([2.0], [20], -1.0, **changes)


def test_a_plan_of_other_segments_does_not_settle_a_problem() -> None:
    solution = ls.smooth(problem())
    with pytest.raises(ls.InputError, match="segments"):
        by_waypoints([2.0], [20], -1.0).with_duration_of(solution)


def through(stated: ls.Problem, places: npt.ArrayLike) -> ls.Trajectory:
    """Straight lines from waypoint to waypoint, with velocities by differences, which no control follows."""
    places = np.asarray(places)
    n, knots, at = (
        len(stated.dynamics.state_coordinates),
        [0, *stated.segments, stated.steps],
        np.arange(stated.steps + 1),
    )
    states = np.zeros((stated.steps + 1, n))
    for i, column in enumerate(places.T):
        states[:, i] = np.interp(at, knots, column)
        rate = n // 2 + i
        states[1:-1, rate] = (states[2:, i] - states[:-2, i]) / (2 * stated.dt)
    return ls.Trajectory(states, np.tile(stated.nominal_control, (stated.steps, 1)), stated.dt)


def test_segments_are_found_from_lines_through_the_waypoints() -> None:
    """Seven turns by the formula, as above; a plan that keeps the stated knots is not sought first.

    The shortest segment has four steps, so the ends at whole knots cost twice as much as above."""
    places = [0.1, -2.0, 2.0, -2.0, 0.1, -0.1, 1.0]
    stated = by_waypoints(places, list(range(15, 120, 15)), 0.0, steps=120, duration=(1.0, 30.0))
    solution = ls.smooth(stated, start=through(stated, [[0.0], *([place] for place in places), [0.0]]))
    assert solution.status is Status.CONVERGED, solution.detail
    turns = [
        0.0,
        *(place - 0.01 * np.sign(step) for step, place in zip(np.diff([0.0, *places]), places, strict=True)),
        0.0,
    ]
    seconds = 2 * np.sqrt(np.abs(np.diff(turns))).sum()
    assert seconds * (1 - 1e-6) <= solution.trajectory.horizon <= 1.01 * seconds
    assert len(solution.iterations) < 200  # 64; a search by way of plans for the stated knots takes 465


@pytest.mark.parametrize(
    ("places", "weight"),
    [
        ([(3.0, 1.0), (-2.0, 2.0), (4.0, -1.0), (1.0, 3.0)], 1e-4),
        *rarely(([(5.0, 0.0), (5.0, 3.0), (-5.0, 3.0), (-5.0, 0.0), (2.0, 1.0)], 1e-4)),
    ],
)
def test_a_planar_quadrotor_races_through_waypoints(places: list[tuple[float, float]], weight: float) -> None:
    """Integrated by SciPy with its held controls, the plan passes all waypoints and stops where it began.

    The tolerance is that of four Runge-Kutta steps in a period of 45 ms, in which it turns by up to 0.3 rad.
    """

    def rates(x: Any, u: Any, p: Any) -> list[Any]:
        return [x[3], x[4], x[5], -(u[0] + u[1]) * sin(x[2]), (u[0] + u[1]) * cos(x[2]) - 9.81, 60 * (u[1] - u[0])]

    def flight(_: float, x: Any, u: Any) -> list[Any]:
        return [*x[3:], -sum(u) * np.sin(x[2]), sum(u) * np.cos(x[2]) - 9.81, 60 * (u[1] - u[0])]

    def reached(x: Any, u: Any, p: Any) -> Any:
        return p.radius**2 - (x.x - p.x) ** 2 - (x.z - p.z) ** 2

    dynamics = ls.Dynamics(
        rates, states={"x": "m", "z": "m", "tilt": "rad", "vx": "m/s", "vz": "m/s", "spin": "rad/s"},
        controls={"left": "N/kg", "right": "N/kg"}, position=("x", "z"),
    ).with_substeps(4)  # fmt: skip
    knots = [round(100 * k / (len(places) + 1)) for k in range(1, len(places) + 1)]
    across, up = map(list, zip(*places, strict=True))
    stated = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=100, initial=ls.FixedState(np.zeros(6)),
        stage_cost=ls.ControlCost([weight, weight], about=[4.905, 4.905]),
        final_cost=ls.QuadraticCost(np.zeros(6), about=np.zeros(6)), control_limits=(0.0, 12.0),
        constraints=[
            ls.GoalState(np.zeros(6)),
            ls.SymbolicConstraint(reached, parameters={"x": across, "z": up, "radius": 0.1}, at=knots),
        ],
        duration=(1.0, 60.0), time_weight=1.0, segments=knots,
    )  # fmt: skip
    solution = ls.smooth(stated, start=through(stated, [(0.0, 0.0), *places, (0.0, 0.0)]))
    assert solution.status is Status.CONVERGED, solution.detail
    plan, state = solution.trajectory, np.zeros(6)
    passed = dict(zip(stated.with_duration_of(solution).segments, places, strict=True))
    with pytest.warns(FutureWarning, match="settled is with_duration_of now"):
        assert stated.settled(solution).digest == stated.with_duration_of(solution).digest
    for knot, control in enumerate(plan.controls):
        if knot in passed:
            assert np.hypot(*(state[:2] - passed[knot])) <= 0.1 + 1e-3
        assert ((control >= 0) & (control <= 12)).all()
        moved = solve_ivp(flight, (0.0, plan.dt), state, args=(control,), rtol=1e-10, atol=1e-10)
        state = moved.y[:, -1]
    np.testing.assert_allclose(state, 0.0, atol=1e-3)
    assert plan.horizon < 5  # of the stated 10 s

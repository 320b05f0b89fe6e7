"""Which start is gone on with, what the others cost, and what is refused."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from comparing import same
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import kkt
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels.records import Motion, Policy
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.solvers import contact_modes, strategy
from lqrsim.solvers.budget import Stop
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.multistart import bends, guides, path, reweighted
from lqrsim.solvers.settings import SmootherSettings
from lqrsim.solvers.stages import Stages

STARTS = ["straight", *(f"{far} m to the {side}" for far in (1, 2, 3) for side in ("left", "right"))]


def without_floor(problem: ls.Problem) -> ls.Problem:
    """The same: seen from above a floor bounds nothing, and kkt.py does not know that."""
    (cost,) = problem.obstacle_costs
    world = ls.World([one for one in cost.world.obstacles if one.name != "floor"])
    assert len(world) == len(cost.world) - 1
    effort = next(term for term in problem.stage_cost.terms if term is not cost)  # pyright: ignore[reportAttributeAccessIssue]
    obstacles = ls.ObstacleCost(world, radius=cost.radius, sharpness=cost.sharpness, weight=cost.weight)
    return replace(problem, stage_cost=effort + obstacles)


class TestCandidates:
    def test_all_starts_are_there_in_their_order_with_what_they_cost(self, differential_drive, drive_solution) -> None:
        """To 1e-9, by a motion and a cost that know nothing of the solver; and each plan is a motion."""
        assert [one.start for one in drive_solution.candidates] == STARTS
        problem = without_floor(differential_drive.problem)
        for one in drive_solution.candidates:
            cost, residual = kkt.recompute(problem, one.trajectory)
            assert one.cost == pytest.approx(cost, rel=1e-9)
            assert residual < 1e-12

    def test_the_half_that_costs_less_goes_on_and_then_the_best(self, drive_solution) -> None:
        candidates = drive_solution.candidates
        ended = [one for one in candidates if one.status is not None]
        assert len(ended) == 1
        chosen = ended[0]
        assert chosen.status is drive_solution.status
        assert (chosen.cost, chosen.iterations) == (drive_solution.cost, len(drive_solution.iterations))
        np.testing.assert_array_equal(chosen.trajectory.states, drive_solution.trajectory.states)
        four = [one for one in candidates if one.status is None and one.iterations == 4]
        three = [one for one in candidates if one.status is None and one.iterations == 3]
        assert (len(three), len(four)) == (4, 2)
        assert drive_solution.iterations[3].cost < min(one.cost for one in four)
        assert f"the plan is from the start {chosen.start!r}, one of 7" in drive_solution.summary()
        # What goes on was better than what was dropped at that time; of the two that were dropped later, cost fell.
        assert max(one.cost for one in four) < min(one.cost for one in three)

    @pytest.mark.parametrize("costs", [(np.inf,), (np.inf, np.inf, np.inf), (np.inf, 7.5, 9.25), (7.5, 7.5)])
    def test_a_summary_states_the_cost_of_dropped_starts_if_it_is_finite(self, drive_solution, costs) -> None:
        (best,) = [one for one in drive_solution.candidates if one.status is not None]
        dropped = [replace(best, start=f"other {i}", status=None, cost=cost) for i, cost in enumerate(costs)]
        text = replace(drive_solution, candidates=(best, *dropped)).summary()
        said = "which cost 7.5 or more" if min(costs) < np.inf else "for no cost was finite"
        assert f"; {len(costs)} {'was' if len(costs) == 1 else 'were'} dropped, {said}" in text
        assert " inf" not in text

    def test_the_same_bits_however_they_are_run(self, differential_drive, drive_solution) -> None:
        problem = differential_drive.problem
        others = [ls.smooth(problem, threads=1), ls.smooth(problem, threads=2, starts=7)]
        others += [*ls.smooth_many([problem, problem], threads=2), *ls.smooth_many([problem], threads=1)]
        for other in others:
            assert same(other, drive_solution)
            for one, of_it in zip(drive_solution.candidates, other.candidates, strict=True):
                assert (one.start, one.cost, one.iterations) == (of_it.start, of_it.cost, of_it.iterations)
                np.testing.assert_array_equal(one.trajectory.states, of_it.trajectory.states)

    def test_one_start_is_the_straight_one_alone(self, differential_drive, drive_solution) -> None:
        alone = ls.smooth(differential_drive.problem, starts=1)
        assert alone.candidates == ()
        assert same(alone, drive_solution)  # where it was the best
        assert "starts:" not in alone.summary()

    @pytest.mark.parametrize("limit", [1, 2, 3, 4, 5])
    def test_the_iteration_limit_may_come_before_the_choice(self, differential_drive, limit: int) -> None:
        calls: list[Iteration] = []
        options: dict[str, Any] = {"max_iterations": limit, "safeguard": False, "callback": calls.append}
        solution = ls.smooth(differential_drive.problem, **options)
        assert solution.status is Status.MAX_ITERATIONS
        assert list(map(repr, calls)) == list(map(repr, solution.iterations))
        assert len(calls) == limit
        assert solution.cost == min(one.cost for one in solution.candidates)

    @pytest.mark.parametrize(
        ("form", "first_pass"), [("dual", "backward"), pytest.param("primal", "forward", marks=pytest.mark.long)]
    )
    def test_in_the_other_form_and_order(self, differential_drive, form: str, first_pass: str) -> None:
        calls: list[Iteration] = []
        solution = ls.smooth(differential_drive.problem, form=form, first_pass=first_pass, callback=calls.append)
        assert solution.status is Status.CONVERGED
        assert [one.start for one in solution.candidates] == STARTS
        assert list(map(repr, calls)) == list(map(repr, solution.iterations))
        report = kkt.check(without_floor(differential_drive.problem), solution)
        assert report.decrease < 1e-4
        assert report.cost == pytest.approx(solution.cost, rel=1e-9)


class TestPaths:
    @pytest.mark.parametrize("size", [2, 3])
    @pytest.mark.parametrize("count", [1, 2, 7, 12])
    def test_they_bend_across_the_way_and_evenly(self, size: int, count: int) -> None:
        rng = np.random.default_rng(size)
        start, goal = rng.normal(size=(2, size))
        way, found = goal - start, bends(goal - start, count)
        assert len(found) == len({name for name, _ in found}) == count
        name, straight = found[0]
        assert name == "straight"
        assert not straight.any()
        others = np.array([bend for _, bend in found[1:]]).reshape(-1, size)
        np.testing.assert_allclose(others @ way, 0, atol=1e-12)
        if size == 3 and count > 2:  # a ring
            np.testing.assert_allclose(others.sum(axis=0), 0, atol=1e-12)
            apart = np.linalg.norm(others - np.roll(others, 1, axis=0), axis=1)
            np.testing.assert_allclose(apart, apart[0], rtol=1e-9)
        if size == 2:  # pairs; the left is a quarter turn on from the way
            side = way[0] * others[:, 1] - way[1] * others[:, 0]
            assert [name.endswith("left") for name, _ in found[1:]] == (side > 0).tolist()
            np.testing.assert_allclose(others[1::2], -others[: count - 1][0::2][: len(others[1::2])], atol=1e-12)

    @pytest.mark.parametrize("size", [1, 4, 7])
    @pytest.mark.parametrize("count", [1, 2, 7, 20])
    def test_of_joints_they_bend_in_pairs_at_right_angles(self, size: int, count: int) -> None:
        way = np.random.default_rng(size).normal(size=size)
        found = bends(way, count, ring=0.5, unit="rad")
        assert len(found) == len({name for name, _ in found}) == min(count, 1 + 2 * (size - 1))
        others = np.array([bend for _, bend in found[1:]]).reshape(-1, size)
        np.testing.assert_allclose(others @ way, 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(others, axis=1), 0.5 * np.linalg.norm(way), rtol=1e-12)
        np.testing.assert_allclose(others[1::2], -others[0::2][: len(others[1::2])], rtol=0, atol=1e-15)
        np.testing.assert_allclose(np.tril(others[0::2] @ others[0::2].T, -1), 0, atol=1e-12)

    def test_they_go_from_rest_to_rest(self) -> None:
        start, goal, bend = np.array([1.0, 2.0]), np.array([5.0, -1.0]), np.array([0.6, 0.8])
        steps = 1000
        places = path(start, goal, bend, steps)
        np.testing.assert_allclose(places[[0, steps // 2, -1]], [start, (start + goal) / 2 + bend, goal], atol=1e-12)
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) * steps  # per unit of time
        assert max(speeds[0], speeds[-1]) < 1e-4 * speeds.max()
        np.testing.assert_allclose(path(start, goal, 0 * bend, steps) @ (3.0, 4.0), 11.0, atol=1e-12)  # a line

    def test_one_of_them_alone_is_an_initial_prior(self, differential_drive, drive_solution) -> None:
        """What the search is made of can be given by hand, or by a function of the problem."""
        problem = differential_drive.problem
        calls: list[ls.Problem] = []

        def straight(problem: ls.Problem) -> Any:
            calls.append(problem)
            return guides(problem, 1)[0][1]

        assert same(ls.smooth(problem, start=straight), drive_solution)
        other = replace(problem, final_cost=ls.QuadraticCost((5000.0, 5000.0, 50.0), about=(0.3, 2.4, np.pi)))
        many = ls.smooth_many([problem, other], start=straight)
        assert same(many[0], drive_solution)
        assert same(many[1], ls.smooth(other, start=guides(other, 1)[0][1]))
        assert {id(one) for one in calls} == {id(problem), id(other)}


def test_the_second_search_may_begin_within_an_obstacle(differential_drive) -> None:
    """As a robot may that has been pushed: a problem that is stated must not, and what is made of this one may."""
    pillar = next(one for one in ls.load_scene("arena").world.obstacles if one.name == "pillar_1")
    x, y, _ = pillar.position
    of = differential_drive.problem.from_state((x + 0.1, y, np.pi / 2))
    with pytest.raises(ls.InputError, match="pillar_1"):
        replace(of, initial=ls.FixedState(of.initial.numbers))
    harder, (weight,), (final,) = reweighted(of, 10.0), of.obstacle_costs, [of.final_cost]
    assert [one.weight for one in harder.obstacle_costs] == [10 * weight.weight]
    np.testing.assert_array_equal(harder.final_cost.terms[0].weight, 10 * final.weight)  # pyright: ignore[reportAttributeAccessIssue]
    solution = ls.smooth(of)
    assert any("times the weight" in one.start for one in solution.candidates)
    assert of.goal is not None
    np.testing.assert_allclose(solution.trajectory.states[-1, :2], of.goal[:2], rtol=0, atol=0.05)
    assert solution.clearance is not None
    assert solution.clearance[0] < 0 < solution.clearance[-1]


def in_the_plane(*, plain: bool = False, **changes: Any) -> ls.Problem:
    """Past a ball, by the differential drive: of the structure that is packaged, or stated in plain Python."""
    ball = ls.Obstacle("ball", "sphere", np.array([0.0, 0.1, 0.0]), np.eye(3), np.array([0.4, 0, 0]))
    dynamics = ls.DifferentialDrive().dynamics
    if plain:
        dynamics = ls.Dynamics(
            arcs, states={"x": "m", "y": "m", "heading": "rad"}, controls={"left": "m/s", "right": "m/s"},
            parameters=dynamics.parameters, position=("x", "y"), angles=("heading",), level="plain",
            control_limits=(-0.5, 0.5),
        )  # fmt: skip
    fields: dict[str, Any] = {
        "dynamics": dynamics, "dt": 0.5, "steps": 12, "initial": ls.FixedState([-1.0, 0.0, 0.0]),
        "stage_cost": ls.ControlCost([0.5, 0.5], about=[0.3, 0.3])
        + ls.ObstacleCost(ls.World([ball]), radius=0.1, sharpness=5.0),
        "final_cost": ls.QuadraticCost([100.0, 100.0, 1.0], about=[1.0, 0.0, 0.0]),
    }  # fmt: skip
    return ls.Problem(**fields | changes)


def arcs(x: Array, u: Array, p: Any) -> list[float]:
    if x[1] < -50:
        raise RuntimeError("off the map")
    speed = (u[0] + u[1]) / 2
    return [speed * np.cos(x[2]), speed * np.sin(x[2]), (u[1] - u[0]) / p.axle_length]


def discs_of(seed: int) -> Array:
    """Middles and radii of two discs, (2, 3)."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform([-0.5, -0.3], [0.5, 0.3], (2, 2)), rng.uniform(0.15, 0.3, 2)])


def among_discs(seed: int) -> ls.Problem:
    """A point mass that is to get past two discs, which are constraints and no costs."""
    numbers = {f"{name}{i}": float(one[k]) for i, one in enumerate(discs_of(seed)) for k, name in enumerate("abr")}
    dynamics = ls.Dynamics(
        lambda x, u, p: [x[2], x[3], u[0], u[1]],
        states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"ax": "m/s^2", "ay": "m/s^2"},
        position=("x", "y"),
    )  # fmt: skip

    def outside(x: Any, u: Any, p: Any) -> list[Any]:
        return [(x[0] - p.a0) ** 2 + (x[1] - p.b0) ** 2 - p.r0**2, (x[0] - p.a1) ** 2 + (x[1] - p.b1) ** 2 - p.r1**2]

    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=30, initial=ls.FixedState((-1.0, 0.0, 0.0, 0.0)),
        stage_cost=ls.ControlCost((0.1, 0.1)),
        final_cost=ls.QuadraticCost(np.full(4, 100.0), about=(1.0, 0.0, 0.0, 0.0)),
        constraints=[ls.SymbolicConstraint(outside, parameters=numbers)],
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("starts", [None, 1])
def test_a_first_plan_is_the_answer_only_where_the_other_attempts_change_nothing(
    seed: int, starts: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = [float(x) for x in np.random.default_rng(seed).uniform(0.8, 1.5, 2)]
    goal = ls.QuadraticCost([100.0, 100.0, 1.0], about=[far[0], 0.2 * far[1], 0.0])
    problems = among_discs(seed), in_the_plane(final_cost=goal), in_the_plane(stage_cost=ls.ControlCost([0.5, 0.5]))
    found = [ls.smooth(problem, starts=starts) for problem in problems]
    monkeypatch.setattr(strategy.Search, "is_answered", False)
    for problem, one in zip(problems, found, strict=True):
        other = ls.smooth(problem, starts=starts)
        assert same(one, other)
        assert (one.detail, one.remedy, one.options) == (other.detail, other.remedy, other.options)
        assert [each.start for each in one.candidates] == [each.start for each in other.candidates]


def a_result(problem: ls.Problem, status: Status, **changed: Any) -> RunResult:
    n, m = len(problem.dynamics.state_coordinates), len(problem.control_coordinates)
    plan = Motion(np.zeros((problem.steps + 1, n)), np.zeros((problem.steps, m)))
    return RunResult(status=status, plan=plan, policy=Policy(np.zeros((problem.steps, m, n)), plan.controls), **changed)


@given(data=st.data())
@settings(max_examples=examples(100))
def test_a_plan_that_was_preferred_stays_the_best_until_a_better_one_is_found(data: st.DataObject) -> None:
    """Such as a plan that has not converged, but costs less than doing nothing, when others follow that do nothing."""
    runs = strategy.Runs(problem := in_the_plane(), SmootherSettings(), Stop())
    best: RunResult | None = None
    for _ in range(data.draw(st.integers(1, 8))):
        status = data.draw(st.sampled_from([Status.CONVERGED, Status.STALLED, Status.INFEASIBLE]))
        violation, cost = data.draw(st.sampled_from([0.0, 0.5])), float(data.draw(st.integers(1, 4)))
        result = a_result(problem, status, violation=violation, cost=cost)
        preferred = data.draw(st.sampled_from([None, True, False]))
        outranks = all(result.rank < other.rank for _, other in runs.finished)
        runs.offer(runs.another(None), result, better=preferred)
        best = result if best is None or (outranks if preferred is None else preferred) else best
        assert runs.best is best


@pytest.mark.parametrize("detail", ["", "no step lowers the cost", "the undamped method failed (diverged); stalled"])
@pytest.mark.parametrize("origin", ["", "begun with contacts of softness 8 mm, 2 mm"])
def test_a_plan_within_contact_modes_says_with_what_it_began_and_not_how_that_ended(
    detail: str, origin: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keep_modes(run: SolveRun, plan: RunResult) -> RunResult:
        return a_result(run.problem, Status.CONVERGED, detail="within its contact modes", cost=1.0)

    monkeypatch.setattr(contact_modes, "keep_modes", keep_modes)
    runs = strategy.Runs(problem := in_the_plane(), SmootherSettings(), Stop())
    begin = a_result(problem, Status.STALLED, detail=detail, origin=origin, cost=2.0)
    runs.offer(runs.another(None), begin)
    assert strategy.Softening(runs, strategy.Approaches(runs))._keep_modes(begin)
    assert (runs.best.origin, runs.best.detail) == (origin, "within its contact modes")


class TestConstraintsInTheWay:
    @given(seed=st.integers(0, 10_000))
    @settings(max_examples=examples(10))
    def test_a_plan_that_touches_one_costs_no_more_than_those_from_either_side(self, seed: int) -> None:
        problem = among_discs(seed)
        found = ls.smooth(problem)
        alone = ls.smooth(problem, starts=1)
        assert found.success
        assert alone.candidates == ()
        touches = any(one.values.any() for one in alone.multipliers)
        assert [one.start for one in found.candidates] == (
            ["nominal control", "a path 0.4 m to the left", "a path 0.4 m to the right"] if touches else []
        )
        costs = [alone.cost]
        for aside in (-0.4, 0.4) if touches else ():
            share = np.linspace(0, 1, problem.steps + 1)
            way = share**3 * (10 - 15 * share + 6 * share**2)
            states = np.outer(2 * way - 1, [1.0, 0.0, 0.0, 0.0])
            states[:, 1] = aside * np.sin(np.pi * way)
            side = ls.smooth(problem, start=ls.Trajectory(states, np.zeros((problem.steps, 2)), problem.dt))
            costs.append(side.cost if side.success else np.inf)
        assert found.cost == pytest.approx(min(costs), rel=1e-9)  # the same runs
        # Recomputed by the closed form of a point mass with constant acceleration; constraints are kept to 1e-6.
        x, u = found.trajectory.states, found.trajectory.controls
        moved = x[:-1, :2] + 0.1 * x[:-1, 2:] + 0.005 * u
        np.testing.assert_allclose(x[1:], np.hstack([moved, x[:-1, 2:] + 0.1 * u]), atol=1e-12)
        end = x[-1] - [1.0, 0.0, 0.0, 0.0]
        assert found.cost == pytest.approx(0.05 * (u**2).sum() + 50 * (end**2).sum(), rel=1e-9)
        middles, radii = np.split(discs_of(seed), [2], axis=1)
        squares = ((x[:, None, :2] - middles) ** 2).sum(axis=2) - radii[:, 0] ** 2
        assert squares.min() > -1e-6

    def test_a_bound_of_a_speed_has_no_other_side(self) -> None:
        """A plan at its bound is not searched for a way round; it is asked for in a line."""
        problem = replace(among_discs(0), constraints=[ls.StateBounds(vx=(-np.inf, 0.8))])
        solution = ls.smooth(problem)
        assert any(one.values.any() for one in solution.multipliers)
        assert solution.candidates == ()
        with pytest.raises(ls.InputError, match="starts: got 3, want 1: there is nothing to go round"):
            ls.smooth(problem, starts=3)


class TestWithoutAWay:
    def test_plain_functions_are_searched_with_too(self) -> None:
        """One thread, two, and formulas: all the same."""
        problem = in_the_plane(plain=True)
        one, two = (ls.smooth(problem, threads=threads, safeguard=False) for threads in (1, 2))
        formula = ls.smooth(in_the_plane(), safeguard=False)
        assert one.status is Status.CONVERGED
        assert same(one, two)
        for a, b in zip(one.candidates, formula.candidates, strict=True):
            assert (a.start, a.iterations, a.status) == (b.start, b.iterations, b.status)
            assert a.cost == pytest.approx(b.cost, rel=1e-6)

    def test_a_goal_where_it_starts(self) -> None:
        here = ls.QuadraticCost([100.0, 100.0, 1.0], about=[-1.0, 0.0, 0.0])
        solution = ls.smooth(in_the_plane(final_cost=here), safeguard=False)
        assert solution.status is Status.CONVERGED
        assert solution.candidates == ()

    def test_no_goal_no_obstacles_or_no_start(self, differential_drive) -> None:
        nowhere = in_the_plane(steps=12)
        (_, obstacles) = nowhere.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
        bare = ls.ControlCost([0.5, 0.5], about=[0.3, 0.3])
        free = bare + ls.ObstacleCost(ls.World(), radius=0.1)
        weightless = bare + ls.ObstacleCost(obstacles.world, radius=0.1, weight=0.0)
        goal = ls.QuadraticCost([1.0, 1.0, 1.0], about=[1.0, 0.0, 0.0])
        changed: list[dict[str, Any]] = [
            {"stage_cost": bare}, {"stage_cost": free}, {"stage_cost": weightless}, {"final_cost": goal + goal},
            {"initial": goal + goal},
        ]  # fmt: skip
        for changes in changed:
            problem = in_the_plane(**changes)
            assert guides(problem, None) == guides(problem, 1) == [("nominal control", None)]
            with pytest.raises(ls.InputError, match="starts: got 2, want 1: there is nothing to go round"):
                ls.smooth(problem, starts=2)
            with pytest.raises(ls.InputError, match=r"problems\[1\]: starts: got 2"):
                ls.smooth_many([nowhere, problem], starts=2)


@pytest.mark.long
def test_where_no_control_helps_by_itself_some_do_together() -> None:
    """Sideways is only reached by turns of both controls: at rest the cost is flat, and to do nothing is stationary."""

    def rate(x, u, p):
        return [u[0], u[1], x[0] * u[1] - x[1] * u[0]]

    dynamics = ls.Dynamics(rate, states=dict.fromkeys(("a", "b", "c"), ""), controls=dict.fromkeys(("u", "v"), ""))
    problem = ls.Problem(
        dynamics=dynamics, dt=0.05, steps=40, initial=ls.FixedState(np.zeros(3)), stage_cost=ls.ControlCost([0.1, 0.1]),
        final_cost=ls.QuadraticCost([100.0, 100.0, 100.0], about=[0.0, 0.0, 1.0]),
    )  # fmt: skip
    assert ls.ilqr(problem, start=np.zeros(2)).cost == pytest.approx(50.0)
    led, found = ls.smooth(problem, start=np.zeros(2)), ls.smooth(problem)
    # c counts twice the area that (a, b) encloses; the least effort goes round it in a circle, once. With a radius r,
    # 2 pi r^2 = 1 and a speed of 2 pi r / T, that is 1/2 0.1 (T / dt) (2 pi r / T)^2 = 0.1 pi / (dt T).
    for solution in (led, found):
        assert solution.cost == pytest.approx(0.1 * np.pi / (0.05 * 2.0), rel=0.05)
    # With a start no others are tried: there the saddle is left along a direction of negative curvature.
    assert [one.start for one in led.candidates] == ["the given start", "beside a saddle"]
    assert led.candidates[0].cost == pytest.approx(50.0)
    assert [one.start for one in found.candidates][:1] == ["nominal control"]


@pytest.mark.parametrize("most", range(4))
def test_a_saddle_is_not_said_to_have_converged(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor after others were left: here each of two states may go to either side, and one goes at a time."""
    monkeypatch.setattr(strategy, "SADDLES", most)
    dynamics = ls.Dynamics(lambda x, u, p: [u[0], u[1]], states={"a": "", "b": ""}, controls={"c": "", "d": ""})
    problem = ls.Problem(
        dynamics=dynamics, dt=0.2, steps=5, initial=ls.FixedState(np.zeros(2)), stage_cost=ls.ControlCost([0.1, 0.1]),
        final_cost=ls.SymbolicCost(lambda x, u, p: (x.a**2 - 1) ** 2 + (x.b**2 - 1) ** 2),
    )  # fmt: skip
    solution = ls.smooth(problem, start=np.zeros(2))
    assert solution.curvature == ("minimum" if most > 1 else "saddle")
    assert solution.success == (solution.curvature == "minimum")
    assert solution.detail.startswith("a saddle") != solution.success
    assert np.count_nonzero(np.abs(solution.trajectory.states[-1]) > 0.5) == min(most, 2)


@pytest.fixture(scope="module")
def on_wheels() -> ls.Problem:
    """The packaged drive by MuJoCo's steps, from rest on the floor to the other side of the arena, 150 steps."""
    drive = ls.scenarios.differential_drive()
    robot = ls.MjcfRobot("arena", position=("create_base_x", "create_base_y"), radius=drive.robot.radius)
    start, goal = (robot.at(create_base_y=y, create_base_z=0.036, create_base_rz=np.pi) for y in (-2.5, 2.5))
    weight = np.zeros(len(start))
    weight[[0, 1, 5]] = 1000.0
    return replace(
        drive.problem, dynamics=robot.dynamics, initial=ls.FixedState(start),
        final_cost=ls.QuadraticCost(weight, about=goal),
    )  # fmt: skip


class TestWhatContactsHold:
    def test_what_moves_little_is_held_and_wheels_turn(self, on_wheels) -> None:
        """By runs of `step` alone: tilts and height move little with swaying controls, and wheels most."""
        few = replace(on_wheels, steps=40)
        (_, prior), *others = guides(few, None)
        assert prior is not None
        weight = dict(zip(few.dynamics.state_coordinates.names, prior.weight, strict=True))
        weight = {name.removeprefix("create_").removeprefix("base_"): number for name, number in weight.items()}
        assert weight["x"] == weight["y"] > 0
        held = ("z", "rx", "ry", "vz", "wx")
        assert min(weight[name] for name in held) > 100 * max(weight[f"wheel_{side}"] for side in ("left", "right"))
        assert weight["z"] > 100 * weight["x"]
        assert weight["wx"] > 100 * weight["wz"]
        for _, one in others:
            assert one is not None
            np.testing.assert_array_equal(one.weight, prior.weight)
            ends = np.array([few.start, few.goal]) * (prior.weight > 0)
            np.testing.assert_allclose(one.about[[0, -1]], ends, atol=1e-12)  # the sine of pi

    @pytest.mark.long
    def test_the_first_pass_is_not_lost(self, on_wheels) -> None:
        """Attracted by its position alone, the robot is tilted in the first pass, which is NOT_FINITE."""
        ((_, prior),) = guides(on_wheels, 1)
        once = ls.smooth(on_wheels, start=prior, max_iterations=1, safeguard=False, threads=1)
        assert once.status is Status.MAX_ITERATIONS
        assert once.cost < 1e4

    def test_formulas_and_robots_in_the_air_are_drawn_by_their_position_alone(self, differential_drive) -> None:
        robot = ls.MjcfRobot("cage")
        flight, names = ls.scenarios.quadrotor().problem, [f"quadrotor_{axis}" for axis in "xyz"]
        ends = np.array([flight.start, flight.goal])[:, :3].tolist()
        start, goal = (robot.at(**dict(zip(names, end, strict=True))) for end in ends)
        for problem, place in ((differential_drive.problem, [0, 1]), (robot.problem(start, goal, steps=20), [0, 1, 2])):
            for _, one in guides(problem, None):
                assert one is not None
                assert one.iterations == 1
                assert np.flatnonzero(one.weight).tolist() == place


def balancing(x: Any, u: Any, p: Any) -> list[Any]:
    """A body that balances on two wheels, by a formula: place and heading, tilt, speed and rates."""
    from sympy import cos, sin

    s, c = sin(x.tilt), cos(x.tilt)
    torque = u.left + u.right - p.damping * 2 * (x.speed / p.wheel - x.tilting)
    force, moment = torque / p.wheel + p.lever * s * x.tilting**2, p.lever * 9.81 * s - torque
    mixed = p.mass * p.inertia - (p.lever * c) ** 2
    forward = (p.inertia * force - p.lever * c * moment) / mixed
    over = (p.mass * moment - p.lever * c * force) / mixed
    turn = (u.right - u.left) * 0.17 / p.wheel / p.turned
    return [x.speed * cos(x.yaw), x.speed * sin(x.yaw), x.turning, x.tilting, forward, turn, over]


@pytest.mark.long
@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("aside", [0.03, 0.0, -0.05])
def test_a_cheaper_plan_that_has_not_converged_is_the_answer_or_named(exact: bool, aside: float) -> None:
    """Round a post, 1.8 m in 5 s. Plans that somersault converge, at hundreds of times the cost of others."""
    dynamics = ls.Dynamics(
        balancing,
        states={"x": "m", "y": "m", "yaw": "rad", "tilt": "rad", "speed": "m/s", "turning": "rad/s",
                "tilting": "rad/s"},
        controls={"left": "N m", "right": "N m"}, angles=("yaw", "tilt"), position=("x", "y"),
        parameters={"mass": 9.9, "lever": 1.4, "inertia": 0.611, "wheel": 0.1, "turned": 0.177, "damping": 0.01},
        control_limits=(-6, 6),
    )  # fmt: skip
    post = ls.Obstacle("post", "cylinder", np.array([0.8, aside, 0.5]), np.eye(3), np.array([0.1, 0.5, 0.0]))
    kept = ls.Clearance(ls.World([post]), radius=0.22, margin=0.05)
    there = ls.GoalState(x=1.8, y=0, tilt=0, speed=0, turning=0, tilting=0)
    problem = ls.Problem(
        dynamics=dynamics, dt=0.02, steps=250, initial=ls.FixedState(x=0.0),
        stage_cost=ls.ControlCost([0.1, 0.1]) + ls.QuadraticCost({"tilt": 1.0, "turning": 0.1}, about={}),
        final_cost=ls.QuadraticCost({"m": 100, "rad": 10, "m/s": 10, "rad/s": 10}, about={"x": 1.8}),
        constraints=[kept, there] if exact else [kept],
    )  # fmt: skip
    solution = ls.smooth(problem)
    cheaper = [
        one.cost for one in solution.candidates
        if one.cost < 0.99 * solution.cost
        and np.hypot(*(one.trajectory.states[:, :2] - (0.8, aside)).T).min() > 0.37 - 1e-6
        and (not exact or np.abs(one.trajectory.states[-1] - (1.8, 0, 0, 0, 0, 0, 0))[[0, 1, 4, 5, 6]].max() < 1e-6)
    ]  # fmt: skip
    said = "a plan that has not converged keeps the constraints and costs less"
    assert (said in solution.detail) == bool(cheaper)
    assert solution.success or not cheaper
    if cheaper:
        (least,) = (one for one in solution.candidates if one.cost == min(cheaper))
        assert f"{said}, {least.cost:.6g}: the trajectory of candidate {least.start!r}" in solution.detail


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("goal", [0.5, -2.0])
def test_a_callback_hears_of_what_is_run_to_its_end_alone_and_in_the_callers_thread(goal: float, threads: int) -> None:
    """From rest no single control turns it (Brockett's integrator): of the oscillating starts, one is gone on with."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0], u[1], x[0] * u[1] - x[1] * u[0]],
        states=dict.fromkeys(("x", "y", "turn"), ""), controls=dict.fromkeys("uv", ""),
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=20, initial=ls.FixedState(np.zeros(3)), stage_cost=ls.ControlCost([0.1, 0.1]),
        final_cost=ls.QuadraticCost([10.0, 10.0, 10.0], about=[0.0, 0.0, goal]),
    )  # fmt: skip
    told: list[tuple[Iteration, int]] = []
    solution = ls.smooth(problem, threads=threads, callback=lambda one: told.append((one, threading.get_ident())))
    assert len(solution.candidates) == 2
    assert {thread for _, thread in told} == {threading.get_ident()}
    assert len(told) == sum(one.iterations for one in solution.candidates)


@pytest.mark.parametrize("far", [5.0, 9.0])
def test_memory_that_was_given_back_is_not_used_again(monkeypatch: pytest.MonkeyPatch, far: float) -> None:
    """Another solve, in another thread, may have it. A goal out of reach, past an obstacle, takes all attempts."""
    problem = in_the_plane(
        constraints=[ls.GoalState(x=far)], final_cost=ls.QuadraticCost([100.0, 100.0, 1.0], about=[far, 0.0, 0.0])
    )
    found, used = ls.smooth(problem), list[Stages]()
    assert found.status is Status.INFEASIBLE

    def give_back(stages: Stages) -> None:
        monkeypatch.setattr(stages, "call", lambda *_: used.append(stages))
        monkeypatch.setattr(stages, "sizes", lambda *_: used.append(stages))

    monkeypatch.setattr(Stages, "give_back", give_back)
    assert same(ls.smooth(problem), found)
    assert used == []

"""Constraints: against SciPy's SLSQP, and the conditions of first order, worked out from a motion of its own."""

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from point_mass import DT, ONE, RADIUS, Effort, Oracle, balls, check, problem
from sampling import rarely

import lqrsim as ls
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.solvers import budget

# As much is left to spare as the constraints are solved for to, and what that costs is no more than 1e-3 of all.
TIGHT: dict[str, Any] = {"tolerance": 1e-7, "gap_tolerance": 1e-4, "constraint_tolerance": 1e-5}


@pytest.mark.parametrize("form", ["dual", pytest.param("primal", marks=pytest.mark.long)])
@pytest.mark.parametrize("weight", [0.0, 0.5], ids=["constraint alone", "cost, too"])
def test_past_a_ball(form: str, weight: float) -> None:
    case = problem(weight=weight, soft=form == "primal")
    solution = ls.smooth(case, form=form, **TIGHT)
    check(solution, case)
    assert solution.clearance is not None
    distances = Oracle.distances(solution.trajectory.states, ONE)[:, 0]
    np.testing.assert_allclose(solution.clearance, distances - RADIUS, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_among_balls_with_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = balls(*rng.uniform((-1.2, -0.5, 0.2), (1.2, 0.5, 0.4), size=(2, 3)))
    case = problem(world, weight=0.2, limit=6.0, soft=seed % 2 == 1)
    check(ls.smooth(case, **TIGHT), case)


def test_multipliers_are_right_where_the_safeguard_had_to_step_in() -> None:
    """Three balls in each other's way: the penalty must not be taken from models that have one already."""
    world = balls((-0.70156366, 0.32844489, 0.24478464), (0.03073108, -0.3640804, 0.40671094),
                  (0.82019454, -0.074491, 0.4870778))  # fmt: skip
    case = problem(world, start=(-2, 0.01, 0, 0))
    check(ls.smooth(case, tolerance=1e-6), case, cost=5e-3, spare=1e-3)


class TestOfTheControl:
    """A constraint of the control acts at the first step, whose state may be given, and not at the end."""

    @pytest.mark.parametrize("soft", [False, True], ids=["fixed", "soft"])
    @pytest.mark.parametrize(("most", "power"), [(3.5, 1e3), (100.0, 2.5), (3.3, 2.8)])
    def test_with_a_clearance(self, most: float, power: float, soft: bool) -> None:
        case = problem(others=(Effort(most, power),), soft=soft, steps=25)
        solution = ls.smooth(case, **TIGHT)
        check(solution, case, spare=1e-4)
        assert solution.multipliers[1].values.any()

    def test_what_the_last_control_would_do_after_the_end_is_nobodys_business(self) -> None:
        """It speeds up until the end, and only then would the power be too much."""
        case = problem(balls((0.0, 5.0, 0.1)), others=(Effort(1e3, 10.0),), goal=(2, 0, 6, 0), steps=10)
        solution = ls.smooth(case, **TIGHT)
        plan = solution.trajectory
        assert plan.states[-1, 2:] @ plan.controls[-1] > 10.1
        check(solution, case, spare=1e-4)


def test_a_plan_that_keeps_them_anyway_is_the_same_to_the_last_bit(differential_drive: ls.Scenario) -> None:
    drive_solution = ls.smooth(differential_drive.problem)
    (cost,) = differential_drive.problem.obstacle_costs
    kept = [ls.Clearance(cost.world, radius=cost.radius, margin=0.1)]
    solution = ls.smooth(replace(differential_drive.problem, constraints=kept))
    assert solution.status is drive_solution.status
    assert solution.multipliers == ()
    assert len(solution.iterations) == len(drive_solution.iterations)
    np.testing.assert_array_equal(solution.trajectory.states, drive_solution.trajectory.states)
    np.testing.assert_array_equal(solution.policy.gain, drive_solution.policy.gain)


class TestInfeasible:
    @pytest.mark.parametrize(
        "changes",
        [
            {"start": (-0.95, 0.1, 5, 0), "limit": 1.0},  # too fast to turn aside
            {"start": (-0.65, 0.1, 0, 0)},  # within the margin, and no way out in one step
            {"margin": 10.0, "start": (-2, 0, 0, 0)},
        ],
        ids=["fast", "inside", "nowhere"],
    )
    @pytest.mark.parametrize("weight", [0.5, *rarely(0.0)])
    def test_it_is_said_what_is_in_the_way_and_when(self, changes: dict[str, Any], weight: float) -> None:
        case = problem(weight=weight, **changes)
        solution = ls.smooth(case)
        assert solution.status is Status.INFEASIBLE
        values = Oracle(case).spare(solution.trajectory.controls.ravel())[0]
        step = int(values.min(axis=1).argmin()) + 1
        assert solution.violation == pytest.approx(-values.min(), rel=1e-9)
        assert f"to obstacle 'ball 0' is missed by {-values.min():.2g} at {step * DT:.2f} s (step {step})" in (
            solution.detail
        )
        assert solution.remedy in solution.summary()
        assert np.isfinite(solution.policy.gain).all()
        bare = ls.smooth(case, safeguard=False)
        assert not bare.success
        assert bare.violation > 0

    def test_another_way_round_is_taken(self) -> None:
        """The shortest leads through a gap that is too narrow, too fast to stop before it."""
        world = balls((0.0, 0.888, 0.7), (0.0, -0.888, 0.7))
        case = problem(world, weight=0.95, start=(-2.22, 0.02, 3.5, 0), limit=6.16, steps=28)
        calls: list[Iteration] = []
        solution = ls.smooth(case, callback=calls.append)
        check(ls.smooth(case, **TIGHT), case)
        assert len(calls) == sum(one.iterations for one in solution.candidates if one.status is not None)
        assert np.abs(solution.trajectory.states[:, 1]).max() > 1.5
        ended = {one.start: one for one in solution.candidates if one.status is not None}
        assert Status.INFEASIBLE in {one.status for one in ended.values()}
        chosen = next(name for name, one in ended.items() if one.cost == solution.cost)
        assert f"the plan is from the start {chosen!r}, one of 7" in solution.summary()


def car(way: tuple[float, float], weight: float, *, seconds: float = 3.0, steps: int = 30) -> ls.Problem:
    """A car that drives at most 2 m/s and is to stand at a place, as it stands at the start."""
    from sympy import cos, sin

    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0] * cos(x[2]), u[0] * sin(x[2]), u[1]], states={"x": "m", "y": "m", "heading": "rad"},
        controls={"speed": "m/s", "turn": "rad/s"}, position=("x", "y"),
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=seconds / steps, steps=steps, initial=ls.FixedState(np.zeros(3)),
        stage_cost=ls.ControlCost(np.full(2, 0.01)),
        final_cost=ls.QuadraticCost(np.full(3, weight), about=(*way, 0.0)),
        constraints=[ls.GoalState((*way, 0.0))], control_limits=(-2.0, 2.0),
    )  # fmt: skip


class TestInfeasibleByTheMultipliersAlone:
    """With finish=None: a violation that no longer falls is evidence only if two starts lead to it."""

    @pytest.mark.parametrize("weight", [0.0, 1.0, 100.0])
    @pytest.mark.parametrize("aside", [0.2, -0.5, 0.8])
    def test_a_car_moves_sideways(self, aside: float, weight: float) -> None:
        """Standing still, nothing moves it that way: there the violation is stationary, from whatever optimum."""
        solution = ls.smooth(car((0.0, aside), weight), finish=None)
        assert solution.success, solution.summary()
        np.testing.assert_allclose(solution.trajectory.states[-1], (0.0, aside, 0.0), atol=1e-3)

    @pytest.mark.parametrize("share", [1.2, 4.0])
    def test_what_is_too_far_is_infeasible_from_two_starts(self, share: float) -> None:
        case = car((share * 2.0 * 0.6, 0.1), 1.0, seconds=0.6, steps=10)
        solution = ls.smooth(case, finish=None)
        assert solution.status is Status.INFEASIBLE, solution.summary()
        assert solution.violation >= (share - 1) * 2.0 * 0.6
        assert len(solution.candidates) >= 2
        alone = ls.smooth(case, finish=None, start=(0.1, 0.1))
        assert alone.status is Status.STALLED
        assert alone.violation == pytest.approx(solution.violation, rel=0.05)


@pytest.mark.parametrize("share", [1.2, 4.0])
def test_out_of_time_nothing_is_called_infeasible(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """INFEASIBLE needs the other starts, too: a clock that jumps while one of them is tried leaves none."""
    case = car((share * 2.0 * 0.6, 0.1), 1.0, seconds=0.6, steps=10)
    whole = ls.smooth(case)
    assert whole.status is Status.INFEASIBLE
    assert len(whole.candidates) > 2
    heard, late, clock = 0, 0.0, time.perf_counter
    last = whole.candidates[0].iterations + 1  # of the next start

    def hear(_: Iteration) -> None:
        nonlocal heard, late
        heard += 1
        late = 1e6 if heard >= last else 0.0

    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=lambda: clock() + late))
    solution = ls.smooth(case, time_limit=1e5, callback=hear)
    assert solution.status is Status.TIME_LIMIT, solution.summary()
    assert "is missed by" in solution.detail
    assert solution.violation >= (share - 1) * 2.0 * 0.6


class TestTolerance:
    @pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
    def test_so_much_is_left_to_spare_at_most(self, tolerance: float) -> None:
        solution = ls.smooth(problem(), constraint_tolerance=tolerance)
        spare = Oracle(problem()).spare(solution.trajectory.controls.ravel())[0].min()
        assert solution.status is Status.CONVERGED
        assert 0 <= spare <= 2 * tolerance

    def test_a_world_without_obstacles_constrains_nothing(self) -> None:
        case = problem(balls(), others=(Effort(3.5),))
        solution = ls.smooth(case, **TIGHT)
        check(solution, case, spare=1e-4)
        assert [one.values.shape for one in solution.multipliers] == [(21, 0), (21, 2)]


def test_a_file_keeps_multipliers_and_candidates(tmp_path: Path) -> None:
    case = problem(weight=0.5)
    solution = ls.smooth(case)
    loaded = ls.load(ls.save(solution, tmp_path / "solution.npz"), ls.Solution)
    np.testing.assert_array_equal(loaded.multipliers[0].values, solution.multipliers[0].values)
    assert loaded.multipliers[0].penalty == solution.multipliers[0].penalty
    for one, other in zip(loaded.candidates, solution.candidates, strict=True):
        assert (one.start, one.cost, one.iterations, one.status) == (
            other.start, other.cost, other.iterations, other.status,
        )  # fmt: skip
        np.testing.assert_array_equal(one.trajectory.states, other.trajectory.states)
    # A loaded solution has no problem that can be looked at between the knots.
    between = [line for line in solution.summary().splitlines() if not line.startswith("  between:")]
    assert loaded.summary().splitlines() == between
    again = ls.smooth(case, start=loaded)  # with the multipliers it begins where it had ended
    assert len(again.iterations) <= 3
    assert again.cost == pytest.approx(solution.cost, rel=1e-4)


def test_many_on_any_number_of_threads() -> None:
    cases = [problem(balls((0.0, y, 0.5)), weight=0.2) for y in (-0.3, 0.1, 0.4)]
    one, two = (ls.smooth_many(cases, threads=threads) for threads in (1, 2))
    for case, a, b in zip(cases, one, two, strict=True):
        for other in (b, ls.smooth(case, threads=2)):
            np.testing.assert_array_equal(a.trajectory.states, other.trajectory.states)
            np.testing.assert_array_equal(a.multipliers[0].values, other.multipliers[0].values)


@pytest.mark.parametrize("iteration", [1, 8])
def test_it_can_be_interrupted_before_the_constraints_and_with_them(iteration: int) -> None:
    count = 0

    def interrupt(_: Iteration) -> None:
        nonlocal count
        count += 1
        if count == iteration:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ls.smooth(problem(weight=0.2), callback=interrupt)
    assert count == iteration


def test_check_derivatives_finds_a_wrong_slope(differential_drive: ls.Scenario) -> None:
    """Of a speed limit whose slope has one sign wrong; those of a clearance are right."""

    class Slow(ls.Constraint):
        def bind(self, dynamics: ls.Dynamics) -> ls.types.ConstraintTerm:
            source = (
                "def value(x, u, t, row, data):\n    return data[0] - u[0] * u[1]\n\n\n"
                "def slope(x, u, t, row, data, gradient):\n    gradient[3] -= u[1]\n    gradient[4] += u[0]\n"
            )
            return ls.types.ConstraintTerm(source, np.array([0.1]), 1, lambda row: "slowness", uses_control=True)

    clear = ls.Clearance(differential_drive.scene.world, radius=differential_drive.robot.radius)
    stated = replace(differential_drive.problem, constraints=[Slow(), clear])
    checks = ls.check_derivatives(stated, samples=3)
    bad = [check for check in checks if not check.good]
    assert [(check.what, check.column) for check in bad] == [("slope of slowness", "right")]
    assert sum("clearance" in check.what for check in checks) == 15

"""Limits of the controls: against bounded least squares, dense KKT systems and differences of the true cost."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import systems
from bounded import DT, bounded, random_problem
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_quadratic import matrices_of, solve_dense
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status

TIGHT: dict[str, Any] = {"tolerance": 1e-12, "gap_tolerance": 1e-9}
NO_LIMITS = (-np.inf, np.inf)


def bang_bang(steps: int) -> ls.Problem:
    """From rest to rest over just the distance that full thrust covers: half of the time ahead, half of it back.

    What is asked for is a little beyond that, where to reach more of it all controls would have to be larger yet.
    """
    time, beyond = steps * DT, 1e-3
    return ls.Problem(
        dynamics=systems.DOUBLE_INTEGRATOR, dt=DT, steps=steps, initial=ls.FixedState([0.0, 0.0]),
        stage_cost=systems.stage_cost(
            ls.ControlCost([1e-6], about=[0.0]), ls.QuadraticCost([0.0, 0.0], about=[0.0, 0.0])
        ),
        final_cost=ls.QuadraticCost([1e4, 1e4], about=[time**2 / 4 + beyond, -beyond * time / 2]),
        control_limits=(-1.0, 1.0),
    )  # fmt: skip


class TestLinearQuadratic:
    @given(
        seed=st.integers(0, 10**6), steps=st.integers(1, 12), limit=st.floats(0.05, 3), fixed=st.booleans(),
        first_pass=st.sampled_from(["forward", "backward"]),
    )  # fmt: skip
    @settings(max_examples=examples(60))
    def test_it_is_what_bounded_least_squares_finds(self, seed, steps, limit, fixed, first_pass) -> None:
        problem = random_problem(seed, steps=steps, limit=limit, fixed=fixed)
        solution = ls.smooth(problem, first_pass=first_pass, **TIGHT)
        cost, controls = bounded(problem)
        assert solution.status is Status.CONVERGED
        assert solution.cost == pytest.approx(cost, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(solution.trajectory.controls, controls, rtol=0, atol=1e-6)
        assert (np.abs(solution.trajectory.controls) <= limit).all()

    @pytest.mark.parametrize("seed", [1, 2, 3, 5])
    def test_what_is_held_has_no_gain_and_the_rest_those_of_the_reduced_problem(self, seed: int) -> None:
        """Gains as differences of dense KKT solutions of what is left of the horizon, held controls being constants."""
        problem = random_problem(seed, limit=0.4)
        solution, of = ls.smooth(problem, **TIGHT), matrices_of(problem)
        plan, gain = solution.trajectory, solution.policy.gain
        held = np.abs(plan.controls) == 0.4
        assert held.any()
        assert not held.all()
        np.testing.assert_array_equal(held, (gain == 0).all(axis=2))
        of.H[:, [3, 4], [3, 4]] = np.where(held, 1.0, of.H[:, [3, 4], [3, 4]])
        of.h[:, 3:][held] = 0
        free = replace(of, B=of.B * ~held[:, None], c=held * plan.controls @ of.B[0].T)
        for t in range(problem.steps):
            left = {name: getattr(free, name)[t:] for name in ("A", "B", "c", "H", "h", "k")}
            found = [
                solve_dense(replace(free, **left, fixed=plan.states[t] + moved))[1][0]
                for moved in np.vstack([np.zeros(3), np.eye(3)])
            ]
            np.testing.assert_allclose(gain[t], np.array(found[1:]).T - found[0][:, None], rtol=0, atol=1e-9)
            np.testing.assert_allclose(~held[t] * plan.controls[t], found[0], rtol=0, atol=1e-8)

    @pytest.mark.parametrize("form", ["dual", pytest.param("primal", marks=pytest.mark.long)])
    def test_the_value_functions_count_what_held_controls_cost(self, form: str) -> None:
        """Eq. (20): the least total cost is the cost at every step. The primal form's inverse step is O(dt^5) off.

        No eigenvalue of this system is larger than 1.03 / s, and so little of that is left of the cost.
        """
        problem = random_problem(1, limit=0.3, fixed=False)
        solution = ls.smooth(problem, form=form, tolerance=1e-10, gap_tolerance=1e-9 if form == "dual" else 1e-3)
        cost, controls = bounded(problem)
        assert (np.abs(controls) > 0.3 - 1e-9).any()
        np.testing.assert_allclose(solution.total_cost.minimum(), cost, rtol=1e-9 if form == "dual" else 1e-6)
        assert solution.inverse_policy is not None
        for t in range(problem.steps):
            arrived = solution.trajectory.states[t + 1]
            np.testing.assert_allclose(
                solution.inverse_policy(arrived, t * DT), controls[t], rtol=0, atol=1e-6 if form == "dual" else 1e-4
            )

    @pytest.mark.parametrize("seed", range(4))
    def test_ilqr_finds_the_same(self, seed: int) -> None:
        problem = random_problem(seed, limit=0.3)
        found = ls.ilqr(problem, tolerance=1e-12)
        np.testing.assert_allclose(found.cost, bounded(problem)[0], rtol=1e-9)
        assert (np.abs(found.trajectory.controls) <= 0.3).all()

    @pytest.mark.parametrize("low", [0.0, 0.2, -0.3])
    def test_the_nominal_control_may_stand_at_a_limit_or_beyond_it(self, low: float) -> None:
        """Held from the first pass on, it is let go where that pays. The second control has no limits at all."""
        problem = random_problem(5)
        about = np.array([0.0, 0.1])
        effort, wish, _ = problem.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
        problem = replace(problem, stage_cost=systems.stage_cost(ls.ControlCost(effort.weight, about=about), wish),
                          control_limits=((low, -np.inf), (0.5, np.inf)))  # fmt: skip
        cost, controls = bounded(problem)
        solution = ls.smooth(problem, **TIGHT)
        assert solution.cost == pytest.approx(cost, rel=1e-9)
        np.testing.assert_allclose(solution.trajectory.controls, controls, rtol=0, atol=1e-6)

    def test_many_on_any_number_of_threads(self) -> None:
        problems = [random_problem(seed, limit=0.2) for seed in range(12)]
        one, two = (ls.smooth_many(problems, threads=threads) for threads in (1, 2))
        for problem, a, b in zip(problems, one, two, strict=True):
            alone = ls.smooth(problem)
            for other in (b, alone):
                np.testing.assert_array_equal(a.trajectory.controls, other.trajectory.controls)
                np.testing.assert_array_equal(a.policy.gain, other.policy.gain)


@pytest.mark.parametrize("steps", [2, 10, 30])
def test_full_thrust_ahead_and_then_back(steps: int) -> None:
    """Nothing else gets there, and the limits are kept to the last bit."""
    solution = ls.smooth(bang_bang(steps))
    assert solution.status is Status.CONVERGED
    expected = np.repeat([1.0, -1.0], steps // 2)
    np.testing.assert_array_equal(solution.trajectory.controls[:, 0], expected)
    assert not solution.policy.gain.any()
    np.testing.assert_allclose(solution.trajectory.states[-1], [(steps * DT / 2) ** 2, 0.0], rtol=0, atol=1e-9)


LIMIT = 0.27  # m/s, of the wheels of the differential drive; without it, the plan takes 0.29


@pytest.fixture(scope="module")
def limited(differential_drive: ls.Scenario) -> ls.Solution:
    problem = replace(differential_drive.problem, control_limits=(-LIMIT, LIMIT))
    return ls.smooth(problem, tolerance=1e-10, gap_tolerance=1e-7)


class TestDifferentialDrive:
    def test_held_controls_would_only_go_further(self, differential_drive: ls.Scenario, limited: ls.Solution) -> None:
        """Slopes of the true cost along each control, by central differences of motions that are worked out here.

        Of the free ones nothing is left but 1e-4 of what each term of the cost pulls with; the held ones pull outward.
        """
        plan, small = limited.trajectory, 1e-5
        assert limited.status is Status.CONVERGED
        high, low = plan.controls == LIMIT, plan.controls == -LIMIT
        assert high.sum() > 5
        moves = small * np.eye(plan.controls.size).reshape(-1, *plan.controls.shape)
        ahead, behind = (_cost(differential_drive, plan, plan.controls + sign * moves) for sign in (1, -1))
        slopes = ((ahead - behind) / (2 * small)).reshape(plan.controls.shape)
        scale = np.abs(60.0 * (plan.controls - 0.25)).max()
        assert np.abs(slopes[~high & ~low]).max() < 1e-4 * scale
        assert (slopes[high] < 1e-4 * scale).all()
        assert (slopes[low] > -1e-4 * scale).all()
        assert slopes[high].min() < -0.1 * scale
        cost = _cost(differential_drive, plan, plan.controls[None])[0]
        assert limited.cost == pytest.approx(cost, rel=1e-9)

    def test_limits_that_do_not_bind_change_not_one_bit(self, differential_drive, drive_solution: ls.Solution) -> None:
        assert np.abs(drive_solution.trajectory.controls).max() < 0.5
        for limits in (NO_LIMITS, (-3.0, 3.0), ((-0.4, -np.inf), 0.45)):
            other = ls.smooth(replace(differential_drive.problem, control_limits=limits))
            assert other.cost == drive_solution.cost
            np.testing.assert_array_equal(other.trajectory.states, drive_solution.trajectory.states)
            np.testing.assert_array_equal(other.policy.gain, drive_solution.policy.gain)
            assert (np.abs(other.policy([9.0, 9.0, 9.0], 3.0)) <= 0.5).all()  # of the actuators

    @given(
        state=st.tuples(*[st.floats(-1e3, 1e3)] * 3), t=st.floats(0, 40), interpolate=st.booleans(),
    )  # fmt: skip
    @settings(max_examples=examples(200))
    def test_the_policy_never_leaves_the_box(self, limited: ls.Solution, state, t: float, interpolate: bool) -> None:
        assert (np.abs(limited.policy(state, t, interpolate=interpolate)) <= LIMIT).all()


def _cost(scenario: ls.Scenario, plan: ls.Trajectory, controls: Array) -> Array:
    """Costs (k,) of controls (k, T, m) from the plan's first state. Pillars and walls are told by their geoms."""
    problem, radius = scenario.problem, scenario.problem.obstacle_costs[0].radius
    track, dt = problem.dynamics.parameters["axle_length"], plan.dt
    x = np.tile(plan.states[0], (len(controls), 1))
    ends: Any = (problem.initial, problem.final_cost)
    total = 0.5 * ((x - ends[0].about) ** 2 @ np.diag(ends[0].weight))
    for t in range(plan.steps):
        speed, turn = controls[:, t].mean(axis=1), np.diff(controls[:, t])[:, 0] / track
        total += 30.0 * ((controls[:, t] - 0.25) ** 2).sum(axis=1)
        for one in problem.obstacle_costs[0].world.obstacles if t > 0 else ():
            away = (x[:, :2] - one.position[:2]) @ one.rotation[:2]
            if one.kind == "plane" and one.name != "floor":
                total += np.exp(-10 * (away[:, 2] - radius))
            elif one.kind != "plane":
                total += np.exp(-10 * (np.hypot(*(x[:, :2] - one.position[:2]).T) - one.size[0] - radius))
        headings = [x[:, 2] + share * dt * turn for share in (0, 0.5, 1)]  # where Runge-Kutta looks: Simpson's rule
        along = [np.stack([np.cos(h), np.sin(h)], axis=1) for h in headings]
        x[:, :2] += (speed * dt / 6)[:, None] * (along[0] + 4 * along[1] + along[2])
        x[:, 2] += dt * turn
    return total + 0.5 * ((x - ends[1].about) ** 2 @ np.diag(ends[1].weight))

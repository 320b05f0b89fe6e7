"""What once was wrong, or could be: numbers far from one, motions that escape, starts that lead nowhere."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import systems

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status


def cubic(*, effort: float = 1.0, constant: float = 0.0) -> ls.Problem:
    """A scalar that runs away by itself: the nominal control cannot even be rolled out."""
    return ls.Problem(
        dynamics=systems.scalar(cubic=1.0), dt=0.1, steps=40, initial=ls.QuadraticCost([10.0], about=[1.0]),
        stage_cost=systems.scalar_cost(effort, weight=0.1, constant=constant),
        final_cost=ls.QuadraticCost([10.0], about=[0.5]),
    )  # fmt: skip


def rolled(solution: ls.Solution, problem: ls.Problem) -> Array:
    """The states that the policy leads to, from the plan's first."""
    states = [solution.trajectory.states[0]]
    for t in range(problem.steps):
        control = solution.policy.control(states[-1], t)
        states.append(problem.dynamics.step(states[-1], control, problem.dt) if np.isfinite(control).all() else control)
    return np.array(states)


class TestInfiniteCosts:
    @pytest.mark.parametrize("stop", ["optimal", "cost"])
    def test_two_of_them_are_not_the_same(self, stop: str) -> None:
        """The first two rollouts escape; inf - inf is no small change."""
        solution = ls.smooth(cubic(effort=1000.0), stop=stop)
        assert solution.success
        assert np.isfinite(solution.cost)
        assert len(solution.iterations) > 1

    @pytest.mark.parametrize("constant", [1e308, -1e308])
    def test_a_cost_beyond_all_numbers_is_no_success(self, constant: float) -> None:
        solution = ls.smooth(cubic(constant=constant), max_iterations=20)
        assert solution.status is Status.DIVERGED
        assert not np.isfinite(solution.cost)

    def test_where_nothing_leads_anywhere_the_plan_is_still_a_rollout_of_the_policy(self) -> None:
        """The nominal rollout of x' = x^3 from 1 escapes; with one iteration for each part, nothing better is found."""
        problem = dataclasses.replace(cubic(), steps=400, dt=0.2)
        solution = ls.smooth(problem, max_iterations=1)
        assert not solution.success
        with np.errstate(all="ignore"):
            kept = np.isfinite(solution.trajectory.states[:, 0])
            np.testing.assert_allclose(solution.trajectory.states[kept], rolled(solution, problem)[kept], rtol=1e-9)


def test_backward_first_from_a_policy_that_escapes_does_not_raise() -> None:
    problem = cubic()
    policy = ls.smooth(problem).policy
    wild = dataclasses.replace(policy, gain=policy.gain + 2.0)
    for first_pass in ("forward", "backward"):
        solution = ls.smooth(problem, start=wild, first_pass=first_pass)
        assert np.isfinite(solution.cost) or not solution.success


def unicycle(offset: float, weight: float, effort: float) -> ls.Problem:
    def rate(x, u, p):
        from sympy import cos, sin

        return [cos(x[2]), sin(x[2]), u[0]]

    dynamics = ls.Dynamics(rate, states={"x": "m", "y": "m", "h": "rad"}, controls={"w": "rad/s"})
    about = np.array([offset, offset, 0.0])
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=40, initial=ls.FixedState(about),
        stage_cost=ls.ControlCost([effort], about=[0.0]),
        final_cost=ls.QuadraticCost(np.full(3, weight), about=about + np.array([3.0, 2.0, 0.5])),
    )  # fmt: skip


@pytest.mark.parametrize("offset", [5e6, 1e8])
def test_far_from_the_origin_converged_means_what_it_does_near(offset: float) -> None:
    """As in a survey: what rounding leaves there must not pass for a cost of zero. 0.1 %, for 1e-4 promised."""
    near, far = (ls.smooth(unicycle(where, 1e8, 1e-3)) for where in (0.0, offset))
    assert near.status is Status.CONVERGED
    assert far.status is not Status.CONVERGED or far.cost < near.cost * (1 + 1e-3)


# Of two states and a control, and of nothing else.
EFFORT = systems.stage_cost(ls.ControlCost([1.0], about=[0.0]), ls.QuadraticCost([0.0, 0.0], about=[0.0, 0.0]))


@pytest.mark.parametrize("form", ["dual", "primal"])
# At 1e-12 what rounding leaves of the gap, the cost-to-come being 1e12, is as large as its tolerance.
@pytest.mark.parametrize("weights", [(1e8, 1e-3), (1e12, 1.0), (1.0, 1e-11)])
def test_weights_of_a_soft_start_may_differ_by_any_factor(form: str, weights: tuple[float, float]) -> None:
    """A linear-quadratic problem is solved by one iteration, and the second sees it; the cost is the closed form's."""
    problem = ls.Problem(
        dynamics=systems.DOUBLE_INTEGRATOR, dt=0.1, steps=20, initial=ls.QuadraticCost(weights, about=(-1.0, 5.0)),
        stage_cost=EFFORT, final_cost=ls.QuadraticCost([10.0, 10.0], about=(1.0, 0.0)),
    )  # fmt: skip
    solution = ls.smooth(problem, form=form)
    assert solution.status is Status.CONVERGED
    assert len(solution.iterations) == 2
    # The start x0 is that of least v(x0) + c_0(x0), with v that of the Riccati equation.
    value = solution.cost_to_go
    assert value is not None
    H, g = value.hessian[0] + np.diag(weights), value.gradient[0] - np.diag(weights) @ (-1.0, 5.0)
    np.testing.assert_allclose(solution.trajectory.states[0], -np.linalg.solve(H, g), rtol=1e-6)
    assert solution.cost_to_come is not None
    if isinstance(solution.cost_to_come, ls.types.Moments):
        np.testing.assert_allclose(np.diag(solution.cost_to_come.covariance[0]) * weights, 1.0, rtol=1e-9)


def test_a_state_that_nothing_weighs_may_be_anywhere() -> None:
    problem = ls.Problem(
        dynamics=systems.linear(np.zeros((2, 2)), [[1.0], [0.0]]), dt=0.1, steps=10,
        initial=ls.QuadraticCost([1.0, 0.0], about=(1.0, 3.0)), stage_cost=EFFORT,
        final_cost=ls.QuadraticCost([1.0, 0.0], about=(0.0, 0.0)),
    )  # fmt: skip
    solution = ls.smooth(problem)
    assert solution.status is Status.CONVERGED
    assert solution.trajectory.states[0, 1] == pytest.approx(3.0)


class TestLinearQuadratic:
    """smooth_lq() tests its own answer, too."""

    def test_a_saddle_is_no_minimum(self) -> None:
        stage = ls.lq.Stage(A=np.ones((4, 1, 1)), B=[[1e-3]], R=[[1.0]])
        for form in ("dual", "primal"):
            solution = ls.lq.smooth_lq(
                stage, initial=ls.types.Quadratic(np.eye(1), np.zeros(1), 0.0),
                final=ls.types.Quadratic(-10 * np.eye(1), np.zeros(1), 0.0), form=form,
            )  # fmt: skip
            assert solution.status is Status.NOT_POSITIVE_DEFINITE
            assert "minimum of the total cost" in solution.detail

    @pytest.mark.parametrize("growth", [1e60, 1e100, 1e160, 1e200])
    @pytest.mark.parametrize("steps", [2, 4])
    def test_what_overflows_says_so_and_can_be_saved(self, growth: float, steps: int, tmp_path: Path) -> None:
        stage = ls.lq.Stage(A=np.full((steps, 1, 1), growth), B=[[1.0]], R=[[1.0]], Q=[[1.0]])
        end = ls.types.Quadratic(np.eye(1), np.zeros(1), 0.0)
        for start in (end, ls.FixedState([1.0])):
            solution = ls.lq.smooth_lq(stage, initial=start, final=end)
            loaded = ls.load(ls.save(solution, tmp_path / "failed.npz"), ls.Solution)
            assert loaded.status is solution.status
            assert loaded.detail == solution.detail

    @pytest.mark.parametrize("weight", [1.0, 1e4, 1e8, 1e12])
    @pytest.mark.parametrize("effort", [1.0, 1e-6])
    def test_what_is_ill_conditioned_is_right_or_says_so(self, weight: float, effort: float) -> None:
        """A chain of four integrators; in exact rational arithmetic the plan's end is a 4 x 4 system."""
        n, steps, dt = 4, 60, 0.1
        A = np.eye(n) + dt * np.eye(n, k=1)
        B = np.zeros((n, 1))
        B[-1] = dt
        start = np.array([1.0, 0.0, 0.0, 0.0])
        final = ls.types.Quadratic(weight * np.eye(n), np.zeros(n), 0.0)
        solution = ls.lq.smooth_lq(
            ls.lq.Stage(A=np.tile(A, (steps, 1, 1)), B=B, R=[[effort]]), initial=ls.FixedState(start), final=final
        )
        assert solution.success or "too ill-conditioned" in solution.detail
        if solution.success:
            exact = _chain_end(A, B, start, weight, effort, steps)
            np.testing.assert_allclose(solution.trajectory.states[-1], exact, rtol=0, atol=1e-3 * np.abs(exact).max())
        if solution.cost_to_come is not None:
            gap = np.abs(solution.total_cost.minimizer() - solution.trajectory.states).max()
            assert gap < 1e-5

    def test_the_cost_to_come_of_an_unstable_motion_is_left_out_when_it_is_lost(self) -> None:
        stage = ls.lq.Stage(A=np.full((400, 1, 1), 1.2), B=[[1.0]], R=[[1.0]])
        end = ls.types.Quadratic(np.eye(1), np.zeros(1), 0.0)
        solution = ls.lq.smooth_lq(stage, initial=ls.FixedState([1.0]), final=end)
        assert solution.success
        # The stationary cost of x' = a x + u with no state cost is (a^2 - 1) x^2 / 2.
        assert solution.cost == pytest.approx((1.2**2 - 1) / 2, rel=1e-9)
        if solution.cost_to_come is None:
            assert "the cost-to-come is left out" in solution.detail
        else:
            np.testing.assert_allclose(solution.total_cost.minimizer(), solution.trajectory.states, atol=1e-6)


def _chain_end(A: Array, B: Array, start: Array, weight: float, effort: float, steps: int) -> Array:
    """x_T of least 1/2 effort |u|^2 + 1/2 weight |x_T|^2: (I + weight / effort G) x_T = A^T x_0, in exact fractions."""
    import sympy

    a, b = sympy.Matrix(A.tolist()).applyfunc(sympy.nsimplify), sympy.Matrix(B.tolist()).applyfunc(sympy.nsimplify)
    reach, gramian = b, sympy.zeros(4, 4)
    for _ in range(steps):
        gramian += reach * reach.T
        reach = a * reach
    free = a**steps * sympy.Matrix(start.tolist()).applyfunc(sympy.nsimplify)
    system = sympy.eye(4) + sympy.nsimplify(weight) / sympy.nsimplify(effort) * gramian
    return np.array(system.LUsolve(free).tolist(), dtype=float).ravel()


class TestSafeguard:
    def test_it_keeps_a_good_plan_that_it_was_given(self, differential_drive: ls.Scenario) -> None:
        """Whatever the first iterations make of it, the answer costs no more than what was there."""
        problem = differential_drive.problem
        assert problem.start is not None
        held = dataclasses.replace(problem, initial=ls.FixedState(problem.start))
        good = ls.ilqr(held, tolerance=1e-8)
        for start in (good.trajectory, good.policy, good.trajectory.controls):
            for first_pass in ("forward", "backward"):
                again = ls.smooth(held, start=start, first_pass=first_pass, max_iterations=1)
                assert again.cost <= good.cost * (1 + 1e-9)

    def test_it_says_when_the_cost_to_come_is_lost(self) -> None:
        """An unstable motion for long: the optimum is that of the Riccati equation, whatever becomes of x_hat."""
        problem = ls.Problem(
            dynamics=systems.scalar(linear=2.0), dt=0.1, steps=300, initial=ls.FixedState([1.0]),
            stage_cost=systems.scalar_cost(), final_cost=ls.QuadraticCost([1.0], about=[0.0]),
        )  # fmt: skip
        solution = ls.smooth(problem)
        assert solution.status is Status.CONVERGED
        a = 1 + 0.2 + 0.2**2 / 2 + 0.2**3 / 6 + 0.2**4 / 24
        b = (a - 1) / 2  # of RK4 as of the exponential: the integral of what multiplies u
        assert solution.cost == pytest.approx((a**2 - 1) / b**2 / 2, rel=1e-6)
        if solution.cost_to_come is None:
            assert "the cost-to-come is left out: the states of least total cost are " in solution.detail
        else:
            np.testing.assert_allclose(solution.total_cost.minimizer(), solution.trajectory.states, atol=1e-3)


class TestArguments:
    def test_numbers_of_numpy_are_numbers(self, differential_drive: ls.Scenario, tmp_path) -> None:
        options = {"max_iterations": np.int64(20), "tolerance": np.float32(1e-4), "safeguard": np.True_}
        solution = ls.smooth(differential_drive.problem, **options)
        loaded = ls.load(ls.save(solution, tmp_path / "solution.npz"), ls.Solution)
        assert loaded.options["max_iterations"] == 20
        assert loaded.options["safeguard"] is True

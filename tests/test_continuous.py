"""Sec. V in continuous time: iteration, how it ends, and how the discrete solver approaches it."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Quadratic, Status
from lqrsim.solvers import continuous
from lqrsim.solvers.continuous import ContinuousSolution, smooth_continuous, smooth_lq_continuous
from lqrsim.solvers.linear_quadratic import Stage


def measured_orders(errors: list[Any]) -> Array:
    """The exponents of dt between errors, one or several kinds in a row, where dt halves from each row to the next."""
    table = np.array(errors)
    return np.log2(table[:-1] / table[1:])


def drive_in_steps_of(problem: ls.Problem, parts: int) -> ls.Problem:
    """The problem of Fig. 2 with each step cut in parts, its weights with it."""
    control, obstacles = problem.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
    return dataclasses.replace(
        problem,
        dt=problem.dt / parts,
        steps=problem.steps * parts,
        stage_cost=ls.ControlCost(control.weight / parts, about=control.about)
        + ls.ObstacleCost(
            obstacles.world, radius=obstacles.radius, sharpness=obstacles.sharpness, weight=obstacles.weight / parts
        ),
    )


@pytest.mark.long
def test_the_discrete_solution_of_the_differential_drive_comes_closer_at_first_order(
    differential_drive: ls.Scenario,
) -> None:
    """As dt halves from 1/6 s, all of these approach at order 1, to within 0.15.

    The states between the ends do so only below 1/100 s: what the rectangle rule has of first order are terms of the
    ends, small here, and until then the second order is larger. Both solvers are iterated until what convergence
    leaves, 1e-7, is far below the smallest difference, 4e-6.
    """
    problem, prior = differential_drive.problem, differential_drive.paper_start
    assert prior is not None
    exact = smooth_continuous(problem, start=prior, tolerance=1e-10, gap_tolerance=1e-7)
    assert exact.status is Status.CONVERGED
    seconds, ends = np.arange(25.0), exact.x_hat([0.0, 25.0])
    errors = []
    for parts in (1, 2, 4, 8):
        start = ls.InitialPrior(prior.weight / parts, about=prior.about, iterations=prior.iterations)
        held = ls.smooth(drive_in_steps_of(problem, parts), start=start, tolerance=1e-10, gap_tolerance=1e-7)
        assert held.status is Status.CONVERGED
        plan = held.trajectory
        assert held.cost_to_go is not None
        differences = {
            "cost": held.cost - exact.cost,
            "states at the ends": plan.states[[0, -1]] - ends,
            "controls": plan.controls[:: 6 * parts] - exact.u_hat(seconds),
            "cost-to-go": held.cost_to_go.hessian[0] - exact.cost_to_go(0.0).hessian,
        }
        errors.append([np.abs(difference).max() for difference in differences.values()])
    np.testing.assert_allclose(measured_orders(errors), 1, atol=0.15)
    # The weights of a second are the same however the steps are cut.
    start = ls.InitialPrior(prior.weight / 4, about=prior.about, iterations=prior.iterations)
    again = smooth_continuous(drive_in_steps_of(problem, 4), start=start)
    assert again.cost == pytest.approx(exact.cost, rel=1e-5)


def test_the_step_of_the_dynamics_alone_is_of_order_four(differential_drive: ls.Scenario) -> None:
    """Over 2 s against the arcs of circles on which the drive moves at held speeds: order 4 to within 0.3."""
    dynamics, (left, right) = differential_drive.robot.dynamics, (0.3, 0.1)
    speed, turn = (left + right) / 2, (right - left) / 0.258
    exact = np.array([speed / turn * np.sin(2 * turn), speed / turn * (1 - np.cos(2 * turn)), 2 * turn])
    errors = []
    for steps in (5, 10, 20, 40):
        x = np.zeros(3)
        for _ in range(steps):
            x = dynamics.step(x, (left, right), 2 / steps)
        errors.append(float(np.abs(x - exact).max()))
    np.testing.assert_allclose(measured_orders(errors), 4, atol=0.3)


def swing(*, bend: float, quartic: float, steep: float) -> ls.Problem:
    """An oscillator that `bend` makes a pendulum; `quartic` and `steep` make its final and initial cost non-quadratic.

    With all of them zero the problem is linear-quadratic, with a cross term and a term in x u.
    """

    def motion(x, u, p):
        from sympy import sin

        return [x[1], u[0] - (1 - p.bend) * x[0] - p.bend * 4 * sin(x[0]) - 0.1 * x[1] + 0.3]

    def stage(x, u, p):
        return 0.05 * (x[0] ** 2 + 0.5 * x[1] ** 2 + 2 * u[0] ** 2 / 2 + 0.4 * x[0] * u[0] + 0.3 * u[0] - x[1])

    def first(x, u, p):
        from sympy import cosh, log

        return 2 * (x[0] - 1) ** 2 + (x[1] ** 2) / 2 + p.steep * (log(cosh(3 * (x[0] - 1.5))) + x[1] ** 4 / 4)

    def last(x, u, p):
        return (x[0] + 0.5) ** 2 + x[1] ** 2 + p.quartic * ((x[0] + 1) ** 4 + (x[0] + x[1]) ** 4 / 4)

    return ls.Problem(
        dynamics=ls.Dynamics(
            motion,
            states={"angle": "rad", "speed": "rad/s"},
            controls={"torque": "N m"},
            parameters={"bend": bend},
        ),
        dt=0.05,
        steps=40,
        initial=ls.SymbolicCost(first, parameters={"steep": steep}),
        stage_cost=ls.SymbolicCost(stage),
        final_cost=ls.SymbolicCost(last, parameters={"quartic": quartic}),
    )


def linear_swing(prior: tuple[float, float] = (0.0, 0.0)) -> ContinuousSolution:
    """The same with all of them zero, stated by its matrices; with a prior of that weight a second about (0.5, 0)."""
    stage = Stage(
        A=[[0, 1], [-1, -0.1]], B=[[0], [1]], c=[0, 0.3],
        Q=np.diag([2.0 + prior[0], 1.0 + prior[1]]), P=[[0.4, 0]], R=[[2.0]], q=[-0.5 * prior[0], -1.0], r=[0.3],
        constant=0.125 * prior[0],
    )  # fmt: skip
    initial = Quadratic(np.diag([4.0, 1.0]), np.array([-4.0, 0]), np.array(2.0))
    final = Quadratic(np.diag([2.0, 2.0]), np.array([1.0, 0]), np.array(0.25))
    return smooth_lq_continuous(stage, horizon=2.0, initial=initial, final=final)


def assert_same_values(one: ContinuousSolution, other: ContinuousSolution, times: Array) -> None:
    pairs = [(getattr(s, which)(times) for s in (one, other)) for which in ("cost_to_go", "cost_to_come")]
    for found, exact in pairs:
        for name in ("hessian", "gradient", "constant"):
            np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=0, atol=1e-6)


def test_a_linear_quadratic_problem_takes_one_iteration_and_is_the_same() -> None:
    """Both integrate the same equations, to 1e-8: values and policies agree to 1e-6."""
    found = smooth_continuous(swing(bend=0, quartic=0, steep=0), start=(0.7,))
    assert found.status is Status.CONVERGED
    assert len(found.iterations) == 2  # the second sees that nothing changes
    assert found.iterations[0].gap < 1e-6
    exact = linear_swing()
    assert found.cost == pytest.approx(exact.cost, abs=1e-6)
    times = np.linspace(0, 2, 9)
    assert_same_values(found, exact, times)
    x = np.array([0.3, -0.8])
    np.testing.assert_allclose(found.policy(x, times), exact.policy(x, times), rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.inverse_policy(x, times), exact.inverse_policy(x, times), rtol=0, atol=1e-6)


def test_the_prior_acts_in_both_passes_of_its_iterations_and_not_in_the_cost() -> None:
    """On a linear system one iteration with it is the exact solution of the problem that has it in its cost: 1e-6."""
    prior = ls.InitialPrior((0.1, 0.02), about=(0.5, 0.0))
    problem = swing(bend=0, quartic=0, steep=0)
    with_it = smooth_continuous(problem, start=prior, max_iterations=1)
    assert_same_values(with_it, linear_swing(prior=(2.0, 0.4)), np.linspace(0, 2, 9))  # a second has twenty steps
    assert with_it.iterations[0].optimality > 1e-3
    found = smooth_continuous(problem, start=prior)
    assert found.success
    assert found.cost == pytest.approx(linear_swing().cost, abs=1e-6)


# Periods and numbers of steps for which steps * dt / dt is rounded up.
LATE = [(dt, steps) for dt in (0.05, 0.1, 0.02, 1 / 6, 1 / 30) for steps in range(1, 60) if steps * dt / dt > steps]


@pytest.mark.parametrize(("dt", "steps"), [*LATE[:3], *LATE[-3:]])
def test_a_prior_with_a_row_for_each_knot_reaches_a_rounded_horizon(dt: float, steps: int) -> None:
    """Equal rows are the prior of one state, up to rounding."""
    problem = dataclasses.replace(swing(bend=1, quartic=0, steep=0), dt=dt, steps=steps)
    one, rows = (
        smooth_continuous(problem, start=ls.InitialPrior((0.1, 0.02), about=about), max_iterations=1)
        for about in (np.array([0.5, 0.0]), np.tile([0.5, 0.0], (steps + 1, 1)))
    )
    assert rows.cost == pytest.approx(one.cost, rel=1e-9)


def test_costs_that_are_not_quadratic_at_the_ends() -> None:
    """Against BFGS over the first state and a control that is a polynomial of degree 11, in NumPy alone.

    The cost agrees to 1e-5 of itself, which is what the polynomial and the 200 Runge-Kutta steps leave; states to 1e-3,
    where the cost is flat.
    """
    found = smooth_continuous(swing(bend=1, quartic=1, steep=1), tolerance=1e-8, gap_tolerance=1e-6)
    assert found.status is Status.CONVERGED
    assert len(found.iterations) > 2

    def rate(y: Array, u: Any) -> Array:
        x, v = y[:2]
        cost = x**2 + 0.5 * v**2 + u**2 + 0.4 * x * u + 0.3 * u - v
        return np.array([v, u - 4 * np.sin(x) - 0.1 * v + 0.3, cost])

    def rollout(z: Array) -> Array:
        """The last state and the cost, of a batch of unknowns (14, any)."""
        y, h = np.array([z[0], z[1], 0 * z[0]]), 2 / 200
        for i in range(200):
            start, middle, end = (np.polynomial.chebyshev.chebval(i / 100 - 1 + d, z[2:]) for d in (0, h / 2, h))
            a = rate(y, start)
            b = rate(y + h / 2 * a, middle)
            c = rate(y + h / 2 * b, middle)
            y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c, end))
        return y

    def cost(z: Array) -> Array:
        x, v, total = rollout(z)
        total = total + (x + 0.5) ** 2 + v**2 + (x + 1) ** 4 + (x + v) ** 4 / 4
        return total + 2 * (z[0] - 1) ** 2 + z[1] ** 2 / 2 + np.log(np.cosh(3 * (z[0] - 1.5))) + z[1] ** 4 / 4

    def slope(z: Array) -> Array:
        shifts = 1e-5 * np.eye(len(z))
        return (cost(z[:, None] + shifts) - cost(z[:, None] - shifts)) / 2e-5

    best = minimize(
        lambda z: float(cost(z[:, None])[0]), np.zeros(14), jac=slope, method="BFGS", options={"gtol": 1e-6}
    )
    assert found.cost == pytest.approx(best.fun, rel=1e-5)
    np.testing.assert_allclose(found.x_hat(0.0), best.x[:2], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.x_hat(2.0), rollout(best.x[:, None])[:2, 0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.u_hat(1.0), np.polynomial.chebyshev.chebval(0.0, best.x[2:]), rtol=0, atol=5e-3)


@pytest.mark.long
def test_converged_means_what_it_says(differential_drive: ls.Scenario) -> None:
    """Sec. V-C: at convergence to 1e-9, Eq. (22) holds to 1e-5, and the total cost is the true cost at all times."""
    seen: list[ls.types.Iteration] = []
    found = smooth_continuous(differential_drive.problem, tolerance=1e-9, gap_tolerance=1e-6, callback=seen.append)
    assert tuple(seen) == found.iterations
    assert found.success
    assert seen[-1].gap < 1e-6
    assert seen[-1].optimality < 1e-9
    times = np.linspace(0, 25, 51)
    x = found.x_hat(times)
    np.testing.assert_allclose(found.policy(x, times), found.inverse_policy(x, times), rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.total_cost(times).minimum(), found.cost, rtol=1e-6)
    text = str(found)
    assert text.splitlines()[0] == ls.types.Iteration.HEADER
    assert f"CONVERGED after {len(seen)} iterations" in text


def scalar(
    *, cubic: float = 0.0, root: float = 0.0, inside: float = 9.0, bonus: float = 0.0, about: float = 1.0,
    weight: float = 1.0, far: float = 0.0,
) -> ls.Problem:  # fmt: skip
    """A scalar integrator that can be made to escape, to leave the domain of its formula, or to be paid for effort."""

    def rate(x, u, p):
        from sympy import sqrt

        return [u[0] + p.cubic * x[0] ** 3 + p.root * sqrt(x[0] + p.inside)]

    return ls.Problem(
        dynamics=ls.Dynamics(
            rate, states={"x": ""}, controls={"u": ""}, parameters={"cubic": cubic, "root": root, "inside": inside}
        ),
        dt=0.5,
        steps=20,
        initial=ls.QuadraticCost([weight], about=[about]),
        stage_cost=ls.ControlCost([1.0], about=[0.0])
        + ls.SymbolicCost(lambda x, u, p: -p.bonus * u[0] ** 2, parameters={"bonus": bonus}, convex=True),
        final_cost=ls.QuadraticCost([1.0], about=[far]),
    )


class TestEndings:
    """A hard problem never raises; its status is true and its detail says when."""

    def test_a_motion_that_escapes_to_infinity(self) -> None:
        found = smooth_continuous(scalar(cubic=100.0), max_iterations=5)
        assert found.status in (Status.NOT_FINITE, Status.DIVERGED, Status.NOT_POSITIVE_DEFINITE)
        assert " of iteration " in found.detail
        assert " s: " in found.detail
        assert found.remedy in str(found)

    def test_a_cost_without_a_minimum(self) -> None:
        found = smooth_continuous(scalar(bonus=1.0))
        assert found.status is Status.NOT_POSITIVE_DEFINITE
        assert found.detail == "forward pass of iteration 1, at 0 s: R is not positive definite"
        assert found.iterations == ()
        assert np.isnan(found.cost)
        with pytest.raises(ls.InputError, match="policy: got a solution that is not positive definite before"):
            found.policy([0.0], 0.0)

    def test_a_start_that_costs_nothing(self) -> None:
        found = smooth_continuous(scalar(weight=0.0))
        assert found.status is Status.NOT_POSITIVE_DEFINITE
        assert found.detail == "forward pass of iteration 1, at 0 s: S + Sbar is not positive definite"

    def test_a_formula_left_on_the_way(self) -> None:
        found = smooth_continuous(scalar(root=1.0, inside=-0.9, far=-20.0), max_iterations=5)
        assert not found.success
        assert found.status in (Status.NOT_FINITE, Status.DIVERGED, Status.NOT_POSITIVE_DEFINITE)
        assert " s: " in found.detail

    def test_a_formula_outside_its_domain_at_the_start(self) -> None:
        with pytest.raises(ls.InputError, match=r"got nan as entry 0 .* want a finite number"):
            smooth_continuous(scalar(root=1.0, inside=-5.0))

    def test_a_cost_of_zero(self) -> None:
        found = smooth_continuous(scalar(about=0.0))
        assert found.status is Status.CONVERGED
        assert abs(found.cost) < 1e-12

    def test_too_few_iterations(self, differential_drive: ls.Scenario) -> None:
        found = smooth_continuous(differential_drive.problem, max_iterations=2)
        assert found.status is Status.MAX_ITERATIONS
        assert len(found.iterations) == 2
        assert np.isfinite(found.iterations[-1].optimality)
        assert np.isfinite(found.policy(np.zeros(3), 3.0)).all()

    def test_an_integration_that_takes_too_long(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(continuous, "_EVALUATIONS", 20)
        found = smooth_continuous(scalar())
        assert found.status is Status.MAX_ITERATIONS
        assert "forward pass of iteration 1, at " in found.detail
        assert found.detail.endswith("the integration is not done after 20 evaluations")

    def test_an_interrupt_is_not_swallowed(self) -> None:
        def interrupt(iteration: ls.types.Iteration) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            smooth_continuous(scalar(), callback=interrupt)

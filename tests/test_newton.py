"""Newton's method at the end of `smooth`: its second derivatives, its order, what it finds, and its policy.

References are differences of what has fewer derivatives, problems solved again from other starts, and
`oracle.kkt`, which knows a problem by its formulas alone.
"""

import ctypes
import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reliability import problems as random_problems
from sampling import examples, rarely
from whole_problems import claims

import lqrsim as ls
from lqrsim.codegen.user_functions import numbers_of
from lqrsim.errors import Array
from lqrsim.problem import dynamics as dynamics_module

HOVER = np.full(4, 1.225)  # N, a quarter of the quadrotor's weight


def swing(x, u, p):
    from sympy import cos, sin

    angle, speed = x
    return [speed, (u[0] * cos(angle) - p.drag * speed**3) / p.inertia - p.gravity * sin(angle)]


def swing_in_numbers(x, u, p):
    angle, speed = x
    return [speed, (u[0] * math.cos(angle) - p.drag * speed**3) / p.inertia - p.gravity * math.sin(angle)]


def slope_in_numbers(x, u, p, fx, fu):
    fx[0, 1] = 1.0
    fx[1, 0] = -u[0] * math.sin(x[0]) / p.inertia - p.gravity * math.cos(x[0])
    fx[1, 1] = -3 * p.drag * x[1] ** 2 / p.inertia
    fu[1, 0] = math.cos(x[0]) / p.inertia


def pendulum(f=swing, **options) -> ls.Dynamics:
    return ls.Dynamics(
        f, states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "N m"},
        parameters={"inertia": 0.5, "gravity": 9.81, "drag": 0.02}, angles=("angle",), **options,
    )  # fmt: skip


def swing_up(dynamics: ls.Dynamics | None = None, **changes) -> ls.Problem:
    problem = ls.Problem(
        dynamics=pendulum() if dynamics is None else dynamics, dt=0.05, steps=40, initial=ls.FixedState([0.2, 0.0]),
        stage_cost=ls.ControlCost([1.0]) + ls.QuadraticCost([0.1, 0.1], about=[1.5, 0.0]),
        final_cost=ls.QuadraticCost([50.0, 5.0], about=[1.5, 0.0]),
    )  # fmt: skip
    return dataclasses.replace(problem, **changes)


def among_obstacles(query: int = 0) -> ls.Problem:
    return dataclasses.replace(ls.scenarios.quadrotor(query=query).problem)


def second_derivatives(dynamics: ls.Dynamics, x: Array, u: Array, weights: Array, dt: float) -> Array:
    """What compiled code calls."""
    n, m = len(x), len(u)
    function = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_double, *[ctypes.c_void_p] * 4)
    hessian, arrived, jacobian = np.zeros((n + m, n + m)), np.zeros(n), np.zeros((n, n + m))
    arrays = x, u, numbers_of(dynamics), weights, arrived, jacobian, hessian
    first, rest = [one.ctypes.data for one in arrays[:3]], [one.ctypes.data for one in arrays[3:]]
    function(int(dynamics.step_curvature))(*first, dt, *rest)
    a, b, _ = dynamics.linearize(x, u, dt)
    # The same sums in another order; differences divide what is rounded by their step, 1e-5.
    np.testing.assert_allclose(jacobian, np.hstack([a, b]), rtol=1e-12, atol=1e-9 if dynamics.functions else 1e-12)
    np.testing.assert_allclose(arrived, dynamics.step(x, u, dt), rtol=1e-12, atol=1e-12)
    return hessian


def by_differences(dynamics: ls.Dynamics, x: Array, u: Array, weights: Array, dt: float) -> Array:
    """Of the Jacobian, which is exact."""
    z, n, found = np.concatenate([x, u]), len(x), []
    for i in range(len(z)):
        sides = []
        for sign in (1, -1):
            moved = z.copy()
            moved[i] += sign * 1e-5
            a, b, _ = dynamics.linearize(moved[:n], moved[n:], dt)
            sides.append(weights @ np.hstack([a, b]))
        found.append((sides[0] - sides[1]) / 2e-5)
    return np.array(found)


class TestSecondDerivatives:
    @settings(max_examples=examples(15))
    @given(seed=st.integers(0, 2**32 - 1), which=st.sampled_from(["drive", "quadrotor", "pendulum", "map"]))
    def test_of_formulas(self, seed: int, which: str) -> None:
        rng = np.random.default_rng(seed)
        dynamics = {"drive": ls.DifferentialDrive().dynamics, "quadrotor": ls.Quadrotor().dynamics}.get(which)
        dt = rng.uniform(0.01, 0.2)
        dynamics = pendulum(period=dt if which == "map" else None) if dynamics is None else dynamics
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        # Rotations of up to 3 rad: within and beyond where the ratios of an angle are series.
        x, u, weights = rng.uniform(-1.5, 1.5, n), rng.uniform(-2, 2, m), rng.normal(size=n)
        found = second_derivatives(dynamics, x, u, weights, dt)
        wanted = by_differences(dynamics, x, u, weights, dt)
        np.testing.assert_allclose(found, found.T, atol=1e-12)
        # Central differences with a step of 1e-5 are good to some 1e-10 of the function's size, and to rounding.
        np.testing.assert_allclose(found, wanted, atol=1e-7 * max(1.0, np.abs(wanted).max()))

    @pytest.mark.parametrize("period", [None, *rarely(0.1)])
    @pytest.mark.parametrize("level", ["plain", "plain with Jacobian", "a formula that is too long"])
    def test_by_differences(self, level: str, period: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(dynamics_module, "MOST_STEPS", 3)
        if level.startswith("plain"):
            given = slope_in_numbers if "Jacobian" in level else None
            dynamics = pendulum(swing_in_numbers, level="plain", jacobian=given, period=period)
        else:
            dynamics = pendulum(period=period)
        x, u, weights = np.array([0.7, -1.3]), np.array([0.4]), np.array([0.3, -2.0])
        found = second_derivatives(dynamics, x, u, weights, 0.1)
        wanted = by_differences(pendulum(period=period), x, u, weights, 0.1)
        assert dynamics.curvature_source is not None
        assert "differences" in repr(dynamics.curvature_source)
        # Second differences with a step of 1e-4 leave some 1e-8, and rounding as much.
        np.testing.assert_allclose(found, wanted, atol=1e-6)

    def test_linear_dynamics_have_none(self) -> None:
        def cart(x, u, p):
            return [x[1], u[0]]

        assert ls.Dynamics(cart, states={"x": "m", "v": "m/s"}, controls={"a": "m/s^2"}).step_curvature == 0


class TestConvergence:
    @pytest.mark.parametrize("query", [0, 3])
    def test_is_quadratic(self, query: int) -> None:
        """The optimality goes with the square of the distance to the optimum: it is squared in each iteration."""
        solution = ls.smooth(among_obstacles(query), tolerance=1e-22)
        left = [one.optimality for one in solution.iterations if one.method == "newton"]
        pairs = [pair for pair in itertools.pairwise(left) if pair[0] < 1e-4 and pair[1] > 1e-24]
        assert len(pairs) >= 2
        # Linear convergence would make it come to 1; a constant before the square takes a little of the 2.
        assert min(math.log(after) / math.log(before) for before, after in pairs) > 1.8

    @pytest.mark.parametrize("query", range(4))
    def test_in_the_optimum_of_smoothing(self, query: int) -> None:
        problem = among_obstacles(query)
        newton = ls.smooth(problem, start=HOVER)
        smoothed = ls.smooth(problem, start=HOVER, finish=None, tolerance=1e-10)
        assert newton.status is ls.Status.CONVERGED
        assert newton.cost == pytest.approx(smoothed.cost, rel=2e-8)  # both are that far from the optimum, squared
        assert len(newton.iterations) <= 20 < len(smoothed.iterations)

    @pytest.mark.parametrize("kind", ["drive", "quadrotor", "pendulum", "cart_pole", "acrobot", "arm", "car"])
    @pytest.mark.parametrize("index", [3, *rarely(5)])
    def test_of_random_problems(self, kind: str, index: int) -> None:
        problem = random_problems.draw(kind, index)
        solution = ls.smooth(problem, threads=1)
        assert solution.status is ls.Status.CONVERGED, solution.detail
        assert solution.certificate.optimality < 2e-8
        assert solution.iterations[-1].method == "newton"

    @settings(max_examples=examples(6))
    @given(seed=st.integers(0, 2**32 - 1))
    def test_is_stationary(self, seed: int) -> None:
        """By the problem's formulas, differentiated elsewhere: whatever the start, limits, form and weights."""
        rng = np.random.default_rng(seed)
        low, high = (-rng.uniform(1.5, 4), rng.uniform(1.5, 4)) if rng.random() < 0.5 else (-np.inf, np.inf)
        soft = ls.QuadraticCost(10.0 ** rng.uniform(0, 3) * np.ones(2), about=rng.normal(size=2))
        problem = swing_up(
            initial=soft if rng.random() < 0.5 else ls.FixedState(rng.normal(size=2)), control_limits=(low, high),
            final_cost=ls.QuadraticCost(10.0 ** rng.uniform(-1, 3, size=2), about=rng.normal(size=2)),
        )  # fmt: skip
        form = "primal" if problem.initial is soft and rng.random() < 0.5 else "dual"
        solution = ls.smooth(problem, form=form)
        assert solution.status is ls.Status.CONVERGED
        assert solution.options["tolerance"] == 1e-8
        assert claims.contradictions(problem, solution) == []

    def test_of_a_users_function(self) -> None:
        numbers, formula = (
            ls.smooth(swing_up(pendulum(swing_in_numbers, level="plain"))), ls.smooth(swing_up()),
        )  # fmt: skip
        assert numbers.status is ls.Status.CONVERGED
        assert numbers.iterations[-1].method == "newton"
        assert numbers.cost == pytest.approx(formula.cost, rel=1e-8)
        np.testing.assert_allclose(numbers.policy.gain, formula.policy.gain, rtol=1e-3, atol=1e-4)

    def test_with_noise(self, differential_drive: ls.Scenario) -> None:
        def shaken(x, u, p):
            return [[0.0], [0.0], [p.size * u[0]]]

        noise = ls.Noise(shaken, size=1, parameters={"size": 0.05})
        problem = dataclasses.replace(differential_drive.problem, noise=noise)
        for risk in (0.0, 1e-3):
            newton = ls.smooth(problem, risk=risk)
            smoothed = ls.smooth(problem, risk=risk, finish=None, tolerance=1e-9)
            assert newton.status is ls.Status.CONVERGED
            # What the noise costs is weighed with another cost-to-go, that of second order: the difference is 1e-8.
            assert newton.cost == pytest.approx(smoothed.cost, rel=1e-6)


class TestPolicy:
    @pytest.mark.parametrize("limit", [0.24, 0.26, 0.27, 0.28])
    def test_a_control_at_its_limit_has_no_gain(self, limit: float) -> None:
        """Narrow limits, at which the wheels stand for long; with 0.27 one is there that the next step would free."""
        problem = ls.scenarios.differential_drive().problem
        assert problem.start is not None
        exact = dataclasses.replace(
            problem, initial=ls.FixedState(problem.start), control_limits=(-limit, limit)
        )  # fmt: skip
        solution = ls.smooth(exact)
        at_limit = np.abs(solution.trajectory.controls) == limit
        assert solution.status is ls.Status.CONVERGED
        assert at_limit.any()
        assert (solution.policy.gain[at_limit] == 0).all()
        assert claims.contradictions(exact, solution) == []

    def test_is_that_of_the_optima_from_neighbouring_starts(self) -> None:
        """The gain is the derivative of the optimal control in the start. That of smoothing's convex models is not."""
        start, far = np.array([0.2, 0.0]), 1e-4
        solution = ls.smooth(swing_up(), tolerance=1e-16)
        slopes = []
        for i in range(2):
            optima = []
            for sign in (1, -1):
                moved = start.copy()
                moved[i] += sign * far
                optima.append(ls.smooth(swing_up(initial=ls.FixedState(moved)), tolerance=1e-16, start=solution))
            ahead, behind = optima
            slopes.append((ahead.trajectory.controls[0] - behind.trajectory.controls[0]) / (2 * far))
        # Differences of optima that are right to some 1e-8 of their controls.
        np.testing.assert_allclose(solution.policy.gain[0], np.array(slopes).T, rtol=1e-3)
        smoothed = ls.smooth(swing_up(), finish=None, tolerance=1e-12)
        assert np.abs(smoothed.policy.gain[0] / np.array(slopes).T - 1).max() > 0.02


class TestOptions:
    def test_without_it_smoothing_has_all_iterations(self) -> None:
        for solution in (ls.smooth(swing_up(), finish=None), ls.smooth(swing_up(), stop="cost")):
            assert {one.method for one in solution.iterations} == {"smooth"}
            assert solution.options["tolerance"] == 1e-4

    def test_a_deadline_leaves_the_best_plan_so_far(self) -> None:
        problem = random_problems.draw("acrobot", 3)
        found = []

        def stop(iteration: ls.types.Iteration) -> None:
            found.append(iteration)
            if sum(one.method == "newton" for one in found) == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt) as raised:
            ls.smooth(problem, callback=stop)
        solution = raised.value.solution  # pyright: ignore[reportAttributeAccessIssue]
        assert solution.cost == pytest.approx(min(one.cost for one in found if np.isfinite(one.cost)), rel=1e-9)
        assert claims.contradictions(problem, solution) == []

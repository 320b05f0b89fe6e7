"""Dynamics that are stated as a map x+ = f(x, u): against SciPy's Riccati equation, loops in NumPy and differences."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.linalg import solve_discrete_are
from sympy import Max, cos, sin, tanh

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status

DT = 0.1
STATES, CONTROLS = {"x": "m", "y": "m", "heading": "rad"}, {"speed": "m/s", "turn": "rad/s"}


def euler(x: Any, u: Any, p: Any) -> list[Any]:
    """A unicycle by Euler's method."""
    return [
        x.x + p.dt * u.speed * cos(x.heading), x.y + p.dt * u.speed * sin(x.heading), x.heading + p.dt * u.turn
    ]  # fmt: skip


def euler_of_arrays(x: Array, u: Array, p: Any) -> Array:
    v, w = u
    return np.array([x[0] + p.dt * v * np.cos(x[2]), x[1] + p.dt * v * np.sin(x[2]), x[2] + p.dt * w])


def unicycle(**changed: Any) -> ls.Dynamics:
    given = {"states": STATES, "controls": CONTROLS, "parameters": {"dt": DT}, "period": DT, "position": ("x", "y")}
    return ls.Dynamics(changed.pop("f", euler), **given | changed)


def problem(dynamics: ls.Dynamics, **changed: Any) -> ls.Problem:
    given = {
        "dt": DT, "steps": 30, "initial": ls.FixedState(x=0), "stage_cost": ls.ControlCost([0.1, 0.1]),
        "final_cost": ls.QuadraticCost([100.0] * 3, about=[1, 1, 0]),
    }  # fmt: skip
    return ls.Problem(dynamics=dynamics, **given | changed)


@settings(max_examples=examples(50))
@given(dt=st.floats(-10, 10), period=st.floats(1e-3, 1))
def test_the_period_near_one_is_possible(dt: float, period: float) -> None:
    """That of the map, or none for less than half of it."""
    dynamics = unicycle(period=period)
    near = dynamics.period_near(dt)
    assert (near == 0) == (dt / period <= 0.5)
    if near > 0:
        dynamics.check_period(near)


@settings(max_examples=examples(30))
@given(seed=st.integers(0, 2**32 - 1))
def test_gains_are_those_of_riccati_equations(seed: int) -> None:
    """A long plan begins with the stationary gains, also for singular A, which has no inverse: to rounding."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(3, 3)) / 2, rng.normal(size=(3, 2))
    a[:, 2] *= rng.integers(2)
    names = [f"{matrix}{i}{j}" for matrix, size in (("a", 3), ("b", 2)) for i in range(3) for j in range(size)]

    def linear(x: Any, u: Any, p: Any) -> list[Any]:
        terms = [[getattr(p, f"a{i}{j}") * x[j] for j in range(3)] for i in range(3)]
        return [sum(row) + sum(getattr(p, f"b{i}{j}") * u[j] for j in range(2)) for i, row in enumerate(terms)]

    dynamics = unicycle(f=linear, parameters=dict(zip(names, [*a.ravel(), *b.ravel()], strict=True)))
    q, r = np.diag([1.0, 2.0, 3.0]), np.diag([0.5, 0.2])
    p = solve_discrete_are(a, b, q, r)
    gain = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    stated = problem(
        dynamics, steps=60, initial=ls.FixedState([1.0, -1.0, 0.5]),
        stage_cost=ls.QuadraticCost(np.diag(q), about=[0] * 3) + ls.ControlCost(np.diag(r)),
        final_cost=ls.QuadraticCost(p, about=[0] * 3),
    )  # fmt: skip
    solution = ls.smooth(stated)
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(solution.policy.gain[0], gain, atol=1e-9 * max(1.0, np.abs(gain).max()))


@pytest.mark.parametrize("level", ["symbolic", "plain"])
def test_a_plan_is_the_rollout_of_the_map(level: str) -> None:
    """By a loop in NumPy, to rounding; that of the formula with constraints."""
    if level == "symbolic":
        slow = ls.SymbolicConstraint(lambda x, u, p: 0.25 - u.speed**2)
        solution = ls.smooth(problem(unicycle(), constraints=[slow, ls.GoalState(x=0.8, y=0.4)]))
        assert np.abs(solution.trajectory.controls[:, 0]).max() == pytest.approx(0.5, abs=1e-5)
    else:
        solution = ls.ilqr(problem(unicycle(f=euler_of_arrays, level="plain")))
        assert solution.cost == pytest.approx(ls.ilqr(problem(unicycle())).cost, rel=1e-6)  # slopes by differences
    assert solution.status is Status.CONVERGED, solution.summary()
    x = solution.trajectory.states[0]
    for u, after in zip(solution.trajectory.controls, solution.trajectory.states[1:], strict=True):
        x = euler_of_arrays(x, u, SimpleNamespace(dt=DT))
        np.testing.assert_allclose(after, x, atol=1e-12)


def test_what_needs_a_rate_or_an_inverse_is_refused() -> None:
    dynamics, free = unicycle(), {"duration": (1, 5)}
    soft = problem(dynamics, initial=ls.QuadraticCost([1.0] * 3, about=[0] * 3))
    for message, call in (
        ("dt: got 0.2 s, want 0.1 s, the period of the map euler", lambda: problem(dynamics, dt=0.2)),
        ("dt: got -0.1 s, want 0.1 s", lambda: dynamics.step([0, 0, 0], [1, 1], -DT)),
        ("duration: got 1 to 5 s with dynamics that are not a formula of rates", lambda: problem(dynamics, **free)),
        ("form: got 'primal' for euler, whose steps have no inverse", lambda: ls.smooth(soft, form="primal")),
        ("dynamics: got euler, which has no rate", lambda: ls.lq.smooth_continuous(soft)),
        ("period: got 0, want a finite number > 0", lambda: unicycle(period=0)),
    ):  # fmt: skip
        with pytest.raises(ls.InputError, match=message):
            call()


@settings(max_examples=examples(15))
@given(seed=st.integers(0, 2**32 - 1))
def test_derivatives_of_drawn_maps(seed: int) -> None:
    """Jacobians against differences of the step. `test_newton.py` has second derivatives."""
    rng = np.random.default_rng(seed)
    numbers, kinds = rng.normal(size=(3, 5)), rng.integers(4, size=3)

    def drawn(x: Any, u: Any, p: Any) -> list[Any]:
        outer = (sin, tanh, lambda z: z**2 / 2, lambda z: Max(z, z**3))
        return [
            outer[kind](sum(c * z for c, z in zip(row, [*x, *u], strict=True)))
            for kind, row in zip(kinds, numbers.tolist(), strict=True)
        ]

    dynamics = unicycle(f=drawn, parameters={})
    x, u = rng.normal(size=3), rng.normal(size=2)
    a, b, c = dynamics.linearize(x, u, DT)
    np.testing.assert_allclose(dynamics.step(x, u, DT), a @ x + b @ u + c, atol=1e-12)
    assert all(check.good for check in ls.check_derivatives(dynamics))

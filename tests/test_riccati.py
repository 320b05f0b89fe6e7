"""The Riccati steps against one dense KKT solve, and what the paper proves of them.

Tolerance 1e-9, relative to the size of what is compared: the problems are well conditioned (by construction, at
horizons up to 12), and two ways of solving the same linear system differ by rounding alone.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_quadratic import LinearQuadratic, random_problem, solve_dense

import lqrsim as ls
from lqrsim import compiled
from lqrsim.core import Core
from lqrsim.errors import Array
from lqrsim.results import Quadratic


def integrator(n: int, m: int) -> Core:
    """The core of some problem with n states and m controls; the Riccati steps in it know no more than the sizes."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[i % m] - x[i] for i in range(n)],
        states={f"x{i}": "" for i in range(n)},
        controls={f"u{i}": "" for i in range(m)},
    )
    problem = ls.Problem(
        dynamics=dynamics,
        dt=1.0,
        steps=1,
        initial=ls.QuadraticCost(np.ones(n), about=np.zeros(n)),
        stage_cost=ls.ControlCost(np.ones(m), about=np.zeros(m)),
        final_cost=ls.QuadraticCost(np.ones(n), about=np.zeros(n)),
    )
    return compiled.core(problem)


class Smoothed:
    """LQR smoothing of a linear-quadratic problem, step by step with the compiled kernels."""

    def __init__(self, core: Core, problem: LinearQuadratic) -> None:
        steps, n, m = problem.B.shape
        self.L, self.l = np.zeros((steps, m, n)), np.zeros((steps, m))
        self.Lbar, self.lbar = np.zeros((steps, m, n)), np.zeros((steps, m))
        S, s, k = np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n)), np.zeros(steps + 1)
        Sbar, sbar, kbar = S.copy(), s.copy(), k.copy()
        S[steps], s[steps], k[steps] = problem.QT, problem.qT, problem.kT
        Sbar[0], sbar[0], kbar[0] = problem.Q0, problem.q0, problem.k0
        for t in reversed(range(steps)):
            jacobian = np.hstack([problem.A[t], problem.B[t]])
            k[t], good = core.riccati_backward(
                jacobian, problem.c[t].copy(), problem.H[t].copy(), problem.h[t].copy(), problem.k[t],
                S[t + 1], s[t + 1], k[t + 1], self.L[t], self.l[t], S[t], s[t],
            )  # fmt: skip
            assert good
        for t in range(steps):
            inverse = np.linalg.inv(problem.A[t])
            jacobian = np.ascontiguousarray(np.hstack([inverse, -inverse @ problem.B[t]]))
            kbar[t + 1], good = core.riccati_forward(
                jacobian, -inverse @ problem.c[t], problem.H[t].copy(), problem.h[t].copy(), problem.k[t],
                Sbar[t], sbar[t], kbar[t], self.Lbar[t], self.lbar[t], Sbar[t + 1], sbar[t + 1],
            )  # fmt: skip
            assert good
        self.cost_to_go, self.cost_to_come = Quadratic(S, s, k), Quadratic(Sbar, sbar, kbar)
        self.x_hat = np.zeros((steps + 1, n))
        for t in range(steps + 1):
            assert core.minimizer(S[t], s[t], Sbar[t], sbar[t], self.x_hat[t])


def assert_close(actual: Array, expected: Array) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * max(1.0, float(np.abs(expected).max())))


SIZES = [(1, 1), (3, 2), (2, 3), (5, 2)]


@pytest.mark.parametrize(("n", "m"), SIZES)
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 12))
def test_smoothing_solves_the_kkt_system(n: int, m: int, seed: int, steps: int) -> None:
    problem = random_problem(seed, n, m, steps)
    smoothed = Smoothed(_core(n, m), problem)
    states, controls, cost = solve_dense(problem)

    assert_close(smoothed.x_hat, states)
    # The minimum of the total cost is the optimal cost, at every step: constants included.
    total = smoothed.cost_to_go + smoothed.cost_to_come
    assert_close(total.minimum(), np.full(steps + 1, cost))
    assert_close(total.minimizer(), states)
    for t in range(steps):
        forward = smoothed.L[t] @ smoothed.x_hat[t] + smoothed.l[t]
        backward = smoothed.Lbar[t] @ smoothed.x_hat[t + 1] + smoothed.lbar[t]
        assert_close(forward, controls[t])
        # Lemma 1 and Eq. (22): both policies agree, and the minimisers satisfy the dynamics.
        assert_close(backward, forward)
        step = problem.A[t] @ smoothed.x_hat[t] + problem.B[t] @ forward + problem.c[t]
        assert_close(step, smoothed.x_hat[t + 1])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 8))
def test_value_functions_are_the_cost_of_the_rest_of_the_way(seed: int, steps: int) -> None:
    problem = random_problem(seed, 3, 2, steps)
    smoothed = Smoothed(_core(3, 2), problem)
    rng = np.random.default_rng(seed)
    x = start = rng.normal(size=3)
    cost = 0.0
    for t in range(steps):
        z = np.concatenate([x, smoothed.L[t] @ x + smoothed.l[t]])
        cost += 0.5 * z @ problem.H[t] @ z + problem.h[t] @ z + problem.k[t]
        x = problem.A[t] @ x + problem.B[t] @ z[3:] + problem.c[t]
    cost += 0.5 * x @ problem.QT @ x + problem.qT @ x + problem.kT
    value = smoothed.cost_to_go
    at_start = 0.5 * start @ value.hessian[0] @ start + value.gradient[0] @ start + value.constant[0]
    assert abs(at_start - cost) <= 1e-9 * max(1.0, abs(cost))


def test_a_control_that_costs_nothing_and_does_nothing_is_refused() -> None:
    core = _core(3, 2)
    cost = np.diag([1.0, 1.0, 1.0, 0.0, 0.0])
    out = np.zeros((2, 3)), np.zeros(2), np.zeros((3, 3)), np.zeros(3)
    jacobian = np.hstack([np.eye(3), np.zeros((3, 2))])
    _, good = core.riccati_backward(jacobian, np.zeros(3), cost, np.zeros(5), 0.0, np.eye(3), np.zeros(3), 0.0, *out)
    assert not good


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_projection_is_the_nearest_semidefinite_matrix(seed: int) -> None:
    """Jointly over states and control, against LAPACK: 1e-12 of the matrix's size, the accuracy of both."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(4, 4)) * 10.0 ** rng.uniform(-3, 3)
    matrix = matrix + matrix.T
    values, vectors = np.linalg.eigh(matrix)
    nearest = (vectors * np.maximum(values, 0)) @ vectors.T
    np.testing.assert_allclose(_project(matrix), nearest, rtol=0, atol=1e-12 * max(1.0, np.abs(matrix).max()))


def _project(matrix: Array) -> Array:
    """What the solver makes of a cost with this Hessian in (x, u)."""
    dynamics = ls.Dynamics(lambda x, u, p: [u[0], x[0], x[1]], states={"x": "", "y": "", "z": ""}, controls={"u": ""})

    def form(x, u, p):
        z = [*x, *u]
        return sum(getattr(p, f"h{i}{j}") * z[i] * z[j] / 2 for i in range(4) for j in range(4))

    names = {f"h{i}{j}": float(matrix[i, j]) for i in range(4) for j in range(4)}
    problem = ls.Problem(
        dynamics=dynamics,
        dt=1.0,
        steps=1,
        initial=ls.QuadraticCost(np.ones(3), about=np.zeros(3)),
        stage_cost=ls.ControlCost([1.0], about=[0.0]) + ls.SymbolicCost(form, parameters=names),
        final_cost=ls.QuadraticCost(np.ones(3), about=np.zeros(3)),
    )
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    core, data = compiled.core(problem), compiled.arguments(problem)
    core.stage_quadratic(np.zeros(3), np.zeros(1), 1, data["stage"], hessian, gradient)
    return hessian - np.diag([0.0, 0.0, 0.0, 1.0])  # less the control cost, which is convex and added as it is


_cores: dict[tuple[int, int], Core] = {}


def _core(n: int, m: int) -> Core:
    if (n, m) not in _cores:
        _cores[n, m] = integrator(n, m)
    return _cores[n, m]

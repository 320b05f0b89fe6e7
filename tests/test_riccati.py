"""smooth_lq() and its Riccati steps, in both forms, against one dense KKT solve, and what the paper proves of them.

Tolerance 1e-9, relative to the size of what is compared: the problems are well conditioned (by construction, at
horizons up to 12), and two ways of solving the same linear system differ by rounding alone.
"""

import contextlib
import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from linear_quadratic import LinearQuadratic, random_problem, solve_dense
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.solvers import compiled


def stage_of(problem: LinearQuadratic) -> ls.lq.Stage:
    n = problem.A.shape[-1]
    return ls.lq.Stage(
        A=problem.A, B=problem.B, c=problem.c, Q=problem.H[:, :n, :n], P=problem.H[:, n:, :n], R=problem.H[:, n:, n:],
        q=problem.h[:, :n], r=problem.h[:, n:], constant=problem.k,
    )  # fmt: skip


def smoothed(problem: LinearQuadratic, form: str) -> ls.Solution:
    start = ls.types.Quadratic(problem.Q0, problem.q0, problem.k0)
    solution = ls.lq.smooth_lq(
        stage_of(problem),
        initial=start if problem.fixed is None else ls.FixedState(problem.fixed),
        final=ls.types.Quadratic(problem.QT, problem.qT, problem.kT),
        form=form,
    )
    assert solution.status is ls.Status.CONVERGED
    return solution


def assert_close(actual: Array, expected: Array) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * max(1.0, float(np.abs(expected).max())))


def assert_solves(problem: LinearQuadratic, form: str) -> ls.Solution:
    """What must hold of every linear-quadratic problem, against the dense KKT solution."""
    solution = smoothed(problem, form)
    states, controls, cost = solve_dense(problem)
    x_hat = solution.total_cost.minimizer()
    assert_close(x_hat, states)
    # The minimum of the total cost is the optimal cost, at every step: constants included.
    assert_close(solution.total_cost.minimum(), np.full(len(states), cost))
    for t in range(len(controls)):
        control = solution.policy.control(x_hat[t], t)
        assert_close(control, controls[t])
        # Lemma 1: the minimisers satisfy the dynamics.
        assert_close(problem.A[t] @ x_hat[t] + problem.B[t] @ control + problem.c[t], x_hat[t + 1])
        if solution.inverse_policy is not None:  # Eq. (22): both policies agree
            assert_close(solution.inverse_policy.control(x_hat[t + 1], t), control)
    # What is reported of it.
    assert_close(solution.trajectory.states, states)
    assert_close(solution.trajectory.controls, controls)
    assert abs(solution.cost - cost) <= 1e-9 * max(1.0, abs(cost))
    assert max(solution.gap, solution.dynamics_residual, solution.optimality) < 1e-9
    return solution


SIZES = [(1, 1), (3, 2), (2, 3), pytest.param(5, 2, marks=pytest.mark.long)]


@pytest.mark.parametrize(("n", "m"), SIZES)
@settings(max_examples=examples(30))
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 12))
def test_both_forms_solve_the_kkt_system_and_agree(n: int, m: int, seed: int, steps: int) -> None:
    """With each other to 1e-10: the same numbers by two ways."""
    problem = random_problem(seed, n, m, steps)
    primal, dual = (assert_solves(problem, form) for form in ("primal", "dual"))
    for one, other in ((primal.cost_to_go, dual.cost_to_go), (primal.cost_to_come, dual.cost_to_come)):
        other = other.quadratic() if isinstance(other, ls.types.Moments) else other
        assert one is not None
        assert other is not None
        for name in ("hessian", "gradient", "constant"):
            a, b = getattr(one, name), getattr(other, name)
            # As quadratics the costs-to-come are inverses, and no better than their condition.
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * max(1.0, float(np.abs(a).max())))
    scale = max(1.0, float(np.abs(primal.trajectory.states).max()))
    np.testing.assert_allclose(primal.trajectory.states, dual.trajectory.states, rtol=0, atol=1e-10 * scale)
    np.testing.assert_allclose(primal.policy.gain, dual.policy.gain, rtol=0, atol=1e-10 * 10)
    again, once = dual.total_cost.minimizer(), primal.total_cost.minimizer()
    np.testing.assert_allclose(again, once, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize("form", ["primal", "dual"])
@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**32 - 1), exponents=st.tuples(*[st.floats(-6, 6)] * 3))
def test_each_state_may_have_a_unit_of_its_own(form: str, seed: int, exponents: tuple[float, ...]) -> None:
    """Metres beside microns: the start's Hessian and the steps were called singular by the ratio of their entries."""
    usual, unit = random_problem(seed, 3, 2, 8), 10.0 ** np.array(exponents)
    both = np.concatenate([unit, np.ones(2)])
    other = LinearQuadratic(
        usual.A * unit / unit[:, None], usual.B / unit[:, None], usual.c / unit, usual.H * np.outer(both, both),
        usual.h * both, usual.k, usual.Q0 * np.outer(unit, unit), usual.q0 * unit, usual.k0,
        usual.QT * np.outer(unit, unit), usual.qT * unit, usual.kT,
    )  # fmt: skip
    one, another = smoothed(usual, form), smoothed(other, form)
    assert_close(another.trajectory.states * unit, one.trajectory.states)
    assert_close(another.trajectory.controls, one.trajectory.controls)


@pytest.mark.parametrize(("n", "m"), SIZES)
@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 12), rank=st.integers(0, 4))
def test_the_dual_form_takes_a_fixed_start_singular_steps_and_singular_costs(
    n: int, m: int, seed: int, steps: int, rank: int
) -> None:
    """A of low rank, the joint cost of a stage singular but for R, cross terms, a final cost of low rank or none."""
    rng = np.random.default_rng(seed)
    problem = random_problem(seed, n, m, steps)
    for t in range(steps):
        u, values, v = np.linalg.svd(problem.A[t])
        values[min(rank, n - 1) :] = 0
        problem.A[t] = (u * values) @ v
        R, P = problem.H[t, n:, n:], 0.3 * rng.normal(size=(m, n))
        Q = P.T @ np.linalg.solve(R, P)  # just enough: the joint cost has rank m
        problem.H[t] = np.block([[0.5 * (Q + Q.T), P.T], [P, R]])
    root = rng.normal(size=(n, min(rank, n)))
    final = root @ root.T
    assert_solves(
        dataclasses.replace(problem, fixed=rng.normal(size=n), QT=final, qT=final @ rng.normal(size=n)), "dual"
    )
    assert_solves(dataclasses.replace(problem, QT=final, qT=final @ rng.normal(size=n)), "dual")


@settings(max_examples=examples(20))
@given(
    seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 12), far=st.sampled_from([1.0, 1e3]), fixed=st.booleans(),
    stated=st.booleans(),
)  # fmt: skip
def test_a_plan_that_can_be_followed_costs_nothing_and_is_found(
    seed: int, steps: int, far: float, fixed: bool, stated: bool
) -> None:
    """Deviations from a plan are weighed, in coordinates about the origin: rounding is all that is left of the cost.

    `stated`: the weights are about the plan; otherwise states begin far from an origin to which the drift brings them.
    """
    problem, rng = random_problem(seed, 3, 2, steps), np.random.default_rng(seed)
    states, controls = [far * rng.normal(size=3)], far * rng.normal(size=(steps, 2))
    for A, B, u, c in zip(problem.A, problem.B, controls, problem.c, strict=True):
        states.append(A @ states[-1] + B @ u + c)
    if not stated:  # to the origin in one step, at which all weights are
        controls, drift = 0 * controls, np.zeros_like(problem.c)
        drift[0], states = -problem.A[0] @ states[0], [states[0], *[np.zeros(3)] * steps]
        problem = dataclasses.replace(problem, c=drift)
        problem.H[0, :3] = problem.H[0, :, :3] = 0.0
    plan = np.hstack([states[:-1], controls])
    pull = np.einsum("tij,tj->ti", problem.H, plan)
    ends = problem.Q0 @ states[0], problem.QT @ states[-1]
    problem = dataclasses.replace(
        problem, h=-pull, k=0.5 * np.einsum("ti,ti->t", pull, plan), fixed=states[0] if fixed else None,
        q0=-ends[0], k0=0.5 * float(ends[0] @ states[0]), qT=-ends[1], kT=0.5 * float(ends[1] @ states[-1]),
    )  # fmt: skip
    for form in ("dual",) if fixed else ("primal", "dual"):
        solution, size = smoothed(problem, form), max(1.0, float(np.abs(states).max()))
        assert abs(solution.cost) <= 1e-12 * size**2
        np.testing.assert_allclose(solution.trajectory.states, states, rtol=0, atol=1e-9 * size)


@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 6), rank=st.integers(0, 2))
def test_the_covariance_is_the_inverse_of_the_dense_hessian_with_any_start(seed: int, steps: int, rank: int) -> None:
    """The primal form takes a singular initial cost: all else determines the start."""
    problem = random_problem(seed, 3, 2, steps)
    root = np.random.default_rng(seed).normal(size=(3, rank))
    problem = dataclasses.replace(problem, Q0=root @ root.T, q0=np.zeros(3))
    total = smoothed(problem, "primal").total_cost
    assert isinstance(total.cost_to_come, ls.types.Quadratic)
    hessian = (total.cost_to_go + total.cost_to_come).hessian
    unit = total.covariance() @ hessian
    np.testing.assert_allclose(unit, np.tile(np.eye(3), (steps + 1, 1, 1)), rtol=0, atol=1e-9)


@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 3), fixed=st.booleans(), singular=st.booleans())
def test_another_form_is_advised_where_it_is_taken(seed: int, steps: int, fixed: bool, singular: bool) -> None:
    """A control that pays in the stage cost has no forward pass; the primal form has no fixed start."""
    rng = np.random.default_rng(seed)
    stage = ls.lq.Stage(
        A=rng.normal(size=(steps, 2, 2)) * (1.0, 0.0 if singular else 1.0), B=rng.normal(size=(steps, 2, 1)),
        R=[[-1e-3]],
    )  # fmt: skip
    start = ls.types.Quadratic(np.eye(2), np.zeros(2), 0.0)
    ends = {"initial": ls.FixedState([1.0, 0.0]) if fixed else start, "final": start}
    failed = ls.lq.smooth_lq(stage, **ends)
    assume(failed.detail.startswith("forward pass"))
    assert ('form="primal"' in failed.detail) == (not fixed and not singular)
    with contextlib.ExitStack() as refused:
        if fixed or singular:
            refused.enter_context(pytest.raises(ls.InputError, match=r"got a FixedState|singular"))
        ls.lq.smooth_lq(stage, **ends, form="primal")


@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 8))
def test_value_functions_are_the_cost_of_the_rest_of_the_way(seed: int, steps: int) -> None:
    problem = random_problem(seed, 3, 2, steps)
    solution = smoothed(problem, "dual")
    rng = np.random.default_rng(seed)
    x = start = rng.normal(size=3)
    cost = 0.0
    for t in range(steps):
        z = np.concatenate([x, solution.policy.control(x, t)])
        cost += 0.5 * z @ problem.H[t] @ z + problem.h[t] @ z + problem.k[t]
        x = problem.A[t] @ x + problem.B[t] @ z[3:] + problem.c[t]
    cost += 0.5 * x @ problem.QT @ x + problem.qT @ x + problem.kT
    value = solution.cost_to_go
    assert value is not None
    at_start = 0.5 * start @ value.hessian[0] @ start + value.gradient[0] @ start + np.asarray(value.constant)[0]
    assert abs(at_start - cost) <= 1e-9 * max(1.0, abs(cost))


@pytest.mark.parametrize("form", ["dual", "primal"])
def test_a_control_that_costs_nothing_and_does_nothing_is_refused(form: str) -> None:
    stage = ls.lq.Stage(A=np.eye(3), B=np.zeros((4, 3, 2)), R=np.zeros((2, 2)), Q=np.eye(3))
    end = ls.types.Quadratic(np.eye(3), np.zeros(3), np.array(0.0))
    solution = ls.lq.smooth_lq(stage, initial=end, final=end, form=form)
    assert solution.status is ls.Status.NOT_POSITIVE_DEFINITE
    assert solution.detail == "backward pass, step 3 of 4"
    assert not solution.iterations


@settings(max_examples=examples(40))
@given(st.integers(0, 2**32 - 1), st.sampled_from(["primal", "dual"]))
def test_weights_in_rotated_coordinates_are_symmetric_up_to_rounding(seed: int, form: str) -> None:
    """U diag(w) U' of equal weights has entries beside its diagonal that are rounding alone.

    The least cost is the same as without U, to 1e-9 of its size: both problems are well conditioned.
    """
    rng, n = np.random.default_rng(seed), 5
    weights = {name: np.full(n, 10.0 ** rng.uniform(-3, 3)) for name in ("Q", "initial", "final")}
    A, B, start, end = np.eye(n) + 0.1 * rng.normal(size=(n, n)), rng.normal(size=(n, 2)), *rng.normal(size=(2, n))
    U, _ = np.linalg.qr(rng.normal(size=(n, n)))

    def least(U: Array) -> float:
        Q, initial, final = (U @ np.diag(weight) @ U.T for weight in weights.values())
        stage = ls.lq.Stage(A=np.tile(U @ A @ U.T, (7, 1, 1)), B=U @ B, R=np.eye(2), Q=Q)
        ends = (ls.types.Quadratic(H, -H @ U @ x, np.array(0.0)) for H, x in ((initial, start), (final, end)))
        return ls.lq.smooth_lq(stage, initial=next(ends), final=next(ends), form=form).cost

    scale = sum(float(weight[0]) for weight in weights.values()) * float(start @ start + end @ end)
    assert least(U) == pytest.approx(least(np.eye(n)), abs=1e-9 * scale)


@settings(max_examples=examples(50))
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
    costs, stage = compiled.costs_module(problem), compiled.compile_problem(problem).stage
    costs.cost_of_order(np.zeros(3), np.zeros(1), 1, stage, 0.0, hessian, gradient)
    return hessian - np.diag([0.0, 0.0, 0.0, 1.0])  # less the control cost, which is convex and added as it is

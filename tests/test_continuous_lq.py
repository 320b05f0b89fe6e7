"""Sec. IV in continuous time, against boundary-value problems, matrix equations and one dense linear system."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_bvp
from scipy.linalg import expm, solve_continuous_are

from lqrsim.errors import Array
from lqrsim.results.solution_parts import Quadratic, Status
from lqrsim.solvers.continuous import smooth_lq_continuous
from lqrsim.solvers.linear_quadratic import Stage

UNIT = Quadratic(np.eye(1), np.zeros(1), np.array(0.0))
STAGE = Stage(A=[[0.0]], B=[[1.0]], R=[[1.0]])


def random_stage(seed: int, n: int = 3, m: int = 2) -> dict[str, Any]:
    """A stage with every term, cross terms too, whose joint Hessian is positive definite."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n + m, n + m))
    H = 0.3 * root @ root.T + np.eye(n + m)
    return {
        "A": 0.5 * rng.normal(size=(n, n)), "B": rng.normal(size=(n, m)), "c": rng.normal(size=n),
        "Q": H[:n, :n], "P": H[n:, :n], "R": H[n:, n:],
        "q": rng.normal(size=n), "r": rng.normal(size=m), "constant": float(rng.normal()),
    }  # fmt: skip


def random_end(seed: int, n: int = 3) -> Quadratic:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return Quadratic(root @ root.T + np.eye(n), rng.normal(size=n), np.array(rng.normal()))


def stage_cost(s: dict[str, Any], x: Array, u: Array) -> float:
    """Eq. (7)."""
    quadratic = 0.5 * x @ s["Q"] @ x + 0.5 * u @ s["R"] @ u + u @ s["P"] @ x
    return float(quadratic + x @ s["q"] + u @ s["r"] + s["constant"])


def hamiltonian(s: dict[str, Any]) -> tuple[Array, Array]:
    """The rate of (x, costate) as a matrix and an offset, by Pontryagin's principle: Ru + Px + r + B'costate = 0."""
    inverse = np.linalg.inv(s["R"])
    drift = s["A"] - s["B"] @ inverse @ s["P"]
    spread = s["B"] @ inverse @ s["B"].T
    matrix = np.block([[drift, -spread], [-(s["Q"] - s["P"].T @ inverse @ s["P"]), -drift.T]])
    return matrix, np.concatenate([s["c"] - s["B"] @ inverse @ s["r"], s["P"].T @ inverse @ s["r"] - s["q"]])


def control_at(s: dict[str, Any], x: Array, costate: Array) -> Array:
    return -np.linalg.solve(s["R"], s["P"] @ x + s["r"] + s["B"].T @ costate)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_smoothing_solves_the_boundary_value_problem(seed: int) -> None:
    """Against the exponential of the Hamiltonian matrix: 1e-6 where the integration is good to 1e-9.

    The exponential itself loses some three digits to its growing half over these 2 s.
    """
    s, horizon, n = random_stage(seed), 2.0, 3
    initial, final = random_end(seed + 10), random_end(seed + 20)
    solution = smooth_lq_continuous(Stage(**s), horizon=horizon, initial=initial, final=final)
    assert solution.status is Status.CONVERGED

    matrix, offset = hamiltonian(s)
    extended = np.zeros((2 * n + 1, 2 * n + 1))
    extended[:-1, :-1], extended[:-1, -1] = matrix, offset

    def flow(t: float) -> Array:
        return expm(extended * t)[:-1]

    # The costate is minus the slope of c_0 at 0 and the slope of c_l at l.
    start = np.vstack([np.hstack([np.eye(n), np.zeros((n, 1))]), np.c_[-initial.hessian, -initial.gradient]])
    end = flow(horizon)[:, :-1] @ start
    end[:, -1] += flow(horizon)[:, -1]
    slope = end[n:] - final.hessian @ end[:n]
    x_0 = np.linalg.solve(slope[:, :-1], final.gradient - slope[:, -1])
    first = start @ np.append(x_0, 1.0)

    def along(t: float) -> tuple[Array, Array, Array]:
        joint = flow(t) @ np.append(first, 1.0)
        return joint[:n], control_at(s, joint[:n], joint[n:]), joint[n:]

    times = np.linspace(0, horizon, 21)
    states, controls, costates = (np.array(column) for column in zip(*map(along, times), strict=True))
    np.testing.assert_allclose(solution.x_hat(times), states, rtol=0, atol=1e-6)
    np.testing.assert_allclose(solution.u_hat(times), controls, rtol=0, atol=1e-6)
    go = solution.cost_to_go(times)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", go.hessian, states) + go.gradient, costates, rtol=0, atol=1e-6)
    cost = quad(lambda t: stage_cost(s, *along(t)[:2]), 0, horizon, epsabs=1e-10)[0]
    cost += float(initial(states[0]) + final(states[-1]))
    assert solution.cost == pytest.approx(cost, abs=1e-6)


def test_lemma_1() -> None:
    """The states of least total cost move as Eq. (22) says, under both policies, and cost the same at all times.

    Central differences over 1e-4 s are good to 1e-6, as they divide the integration's 1e-9 by that; the rest is 1e-7.
    """
    s = random_stage(3)
    solution = smooth_lq_continuous(Stage(**s), horizon=3.0, initial=random_end(4), final=random_end(5))
    times, step = np.linspace(0.1, 2.9, 29), 1e-4
    x, u = solution.x_hat(times), solution.u_hat(times)
    np.testing.assert_allclose(solution.inverse_policy(x, times), u, rtol=0, atol=1e-7)
    rate = (solution.x_hat(times + step) - solution.x_hat(times - step)) / (2 * step)
    np.testing.assert_allclose(rate, x @ s["A"].T + u @ s["B"].T + s["c"], rtol=0, atol=1e-5)
    least = solution.total_cost(np.linspace(0, 3, 31)).minimum()
    np.testing.assert_allclose(least, solution.cost, rtol=0, atol=1e-7)


def test_a_stage_that_changes_with_time() -> None:
    """Against SciPy's collocation of the boundary-value problem, both to 1e-8: 1e-6."""

    one, other = random_stage(6), random_stage(7)

    def at(t: float) -> dict[str, Any]:
        share = 0.5 + 0.5 * np.sin(t)
        return {name: (1 - share) * one[name] + share * other[name] for name in one}

    initial, final = random_end(8), random_end(9)
    solution = smooth_lq_continuous(lambda t: Stage(**at(t)), horizon=2.0, initial=initial, final=final)
    assert solution.success

    def rate(times: Array, joint: Array) -> Array:
        columns = []
        for t, column in zip(times, joint.T, strict=True):
            matrix, offset = hamiltonian(at(t))
            columns.append(matrix @ column + offset)
        return np.array(columns).T

    def ends(first: Array, last: Array) -> Array:
        leaving = first[3:] + initial.hessian @ first[:3] + initial.gradient
        return np.concatenate([leaving, last[3:] - final.hessian @ last[:3] - final.gradient])

    times = np.linspace(0, 2, 21)
    found = solve_bvp(rate, ends, times, np.zeros((6, 21)), tol=1e-8, max_nodes=10_000)
    assert found.success
    np.testing.assert_allclose(solution.x_hat(times), found.sol(times)[:3].T, rtol=0, atol=1e-6)


def test_far_from_the_ends_the_value_functions_are_those_of_no_end() -> None:
    """SciPy's algebraic Riccati equation, with cross terms: 1e-7. After 20 s the ends are forgotten to rounding."""
    s = random_stage(11)
    solution = smooth_lq_continuous(Stage(**s), horizon=20.0, initial=random_end(12), final=random_end(13))
    go = solve_continuous_are(s["A"], s["B"], s["Q"], s["R"], s=s["P"].T)
    come = solve_continuous_are(-s["A"], -s["B"], s["Q"], s["R"], s=s["P"].T)
    np.testing.assert_allclose(solution.cost_to_go(0.0).hessian, go, rtol=0, atol=1e-7)
    np.testing.assert_allclose(solution.cost_to_come(20.0).hessian, come, rtol=0, atol=1e-7)


def held_controls(s: dict[str, Any], initial: Quadratic, final: Quadratic, horizon: float, steps: int) -> Any:
    """States (T+1, n) and cost where controls are held over steps and each costs dt times the rate at its beginning.

    All states are affine in z = (x_0, u_0, u_1, ...): one linear system.
    """
    n, m = s["B"].shape
    dt, size = horizon / steps, n + steps * m
    extended = np.zeros((n + m + 1, n + m + 1))
    extended[:n] = np.c_[s["A"], s["B"], s["c"]]
    step = expm(extended * dt)[:n]
    H = dt * np.block([[s["Q"], s["P"].T], [s["P"], s["R"]]])
    h = dt * np.concatenate([s["q"], s["r"]])
    state = np.eye(n, size + 1)  # the last column is the offset
    maps, hessian, gradient = [state], np.zeros((size, size)), np.zeros(size)
    constant = float(steps * dt * s["constant"])

    def add(weight: Array, slope: Array, where: Array) -> None:
        nonlocal hessian, gradient, constant
        matrix, offset = where[:, :-1], where[:, -1]
        hessian += matrix.T @ weight @ matrix
        gradient += matrix.T @ (weight @ offset + slope)
        constant += float(0.5 * offset @ weight @ offset + slope @ offset)

    for t in range(steps):
        both = np.vstack([state, np.eye(m, size + 1, n + t * m)])
        add(H, h, both)
        state = step[:, :-1] @ both
        state[:, -1] += step[:, -1]
        maps.append(state)
    add(initial.hessian, initial.gradient, maps[0])
    add(final.hessian, final.gradient, maps[-1])
    z = -np.linalg.solve(hessian, gradient)
    cost = constant + float(initial.constant + final.constant) + 0.5 * gradient @ z
    return np.array([state @ np.append(z, 1.0) for state in maps]), cost


def test_the_discrete_solution_of_a_linear_system_comes_closer_at_first_order() -> None:
    """One dense solve over all held controls, as dt halves from 1/20 s: the order is 1 to within 0.15.

    The dynamics are exact there, so what is left is the rectangle rule of the cost and the holding of the control.
    """
    s, horizon, initial, final = random_stage(14), 2.0, random_end(15), random_end(16)
    exact = smooth_lq_continuous(Stage(**s), horizon=horizon, initial=initial, final=final)
    state_errors, cost_errors = [], []
    for steps in (40, 80, 160):
        states, cost = held_controls(s, initial, final, horizon, steps)
        times = np.linspace(0, horizon, steps + 1)
        state_errors.append(float(np.abs(states - exact.x_hat(times)).max()))
        cost_errors.append(abs(cost - exact.cost))
    for errors in (np.array(state_errors), np.array(cost_errors)):
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 1, atol=0.15)


@pytest.mark.parametrize("seed", range(6))
def test_each_state_may_have_a_unit_of_its_own(seed: int) -> None:
    """The total cost was called flat by the ratio of its curvatures in metres and in microns."""
    s, start, end = random_stage(seed), random_end(seed + 10), random_end(seed + 20)
    unit = 10.0 ** np.random.default_rng(seed).uniform(-6, 6, 3)
    other = s | {
        "A": s["A"] * unit / unit[:, None], "B": s["B"] / unit[:, None], "c": s["c"] / unit,
        "Q": s["Q"] * np.outer(unit, unit), "P": s["P"] * unit, "q": s["q"] * unit,
    }  # fmt: skip

    def scaled(cost: Quadratic) -> Quadratic:
        return Quadratic(cost.hessian * np.outer(unit, unit), cost.gradient * unit, cost.constant)

    one = smooth_lq_continuous(Stage(**s), horizon=1.0, initial=start, final=end)
    another = smooth_lq_continuous(Stage(**other), horizon=1.0, initial=scaled(start), final=scaled(end))
    assert another.status is Status.CONVERGED
    times = np.linspace(0, 1, 5)
    np.testing.assert_allclose(another.x_hat(times) * unit, one.x_hat(times), rtol=0, atol=1e-5)


def test_problems_without_a_minimum() -> None:
    """With x' = u and Q = -1 a cost-to-go ends where tan does: from S = 1, pi/4 + pi/2 before the horizon."""
    none = Quadratic(np.zeros((1, 1)), np.zeros(1), np.array(0.0))
    escaping = Stage(A=[[0.0]], B=[[1.0]], R=[[1.0]], Q=[[-1.0]])
    found = smooth_lq_continuous(escaping, horizon=5.0, initial=UNIT, final=UNIT)
    assert found.status is Status.NOT_FINITE
    assert found.detail.startswith("backward pass, at 2.644 s")
    paid = Stage(A=[[0.0]], B=[[1.0]], R=[[-1.0]])
    found = smooth_lq_continuous(paid, horizon=1.0, initial=UNIT, final=UNIT)
    assert found.status is Status.NOT_POSITIVE_DEFINITE
    assert found.detail == "backward pass, at 1 s: R is not positive definite"
    found = smooth_lq_continuous(STAGE, horizon=1.0, initial=none, final=none)
    assert found.status is Status.NOT_POSITIVE_DEFINITE
    assert found.detail == "total cost, at 0 s: S + Sbar is not positive definite"
    assert np.isnan(found.cost)
    assert found.remedy in str(found)
    for shorter in (1.0, 0.5):
        assert smooth_lq_continuous(escaping, horizon=shorter, initial=UNIT, final=UNIT).remedy == ""
    heavier = Stage(A=[[0.0]], B=[[1.0]], R=[[1.0]], Q=[[1.0]])
    assert smooth_lq_continuous(heavier, horizon=5.0, initial=UNIT, final=UNIT).success
    assert smooth_lq_continuous(STAGE, horizon=1.0, initial=UNIT, final=none).success


def test_times_come_in_any_shape() -> None:
    solution = smooth_lq_continuous(STAGE, horizon=2.0, initial=UNIT, final=UNIT)
    assert solution.cost_to_go(1.0).hessian.shape == (1, 1)
    assert np.shape(solution.cost_to_go(np.zeros((4, 3))).constant) == (4, 3)
    assert solution.policy(np.zeros((5, 1)), 1.0).shape == (5, 1)
    assert solution.policy(np.zeros(1), np.ones(5)).shape == (5, 1)
    # S = 1 / (1 + l - t), by hand.
    assert solution.cost_to_go(2.0 + 1e-12).hessian[0, 0] == pytest.approx(1.0)
    assert solution.cost_to_go(0.0).hessian[0, 0] == pytest.approx(1 / 3, abs=1e-8)
    assert "one pass each way" in str(solution)

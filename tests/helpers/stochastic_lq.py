"""Linear-quadratic problems with multiplicative noise, and their solutions by NumPy: oracles for the tests of noise."""

from typing import Any, NamedTuple

import numpy as np

import lqrsim as ls

Array = np.ndarray[Any, Any]
STATES, CONTROLS, SIZE, STEPS, DT = 3, 2, 2, 12, 0.1


class Numbers(NamedTuple):
    """xdot = F x + G u + f; M's columns m_i = J_i (x, u) + e_i; costs 1/2 (z - about)' weight (z - about)."""

    F: Array
    G: Array
    f: Array
    J: Array  # (k, n, n + m)
    e: Array  # (k, n)
    state_weight: Array
    control_weight: Array
    end_weight: Array
    start: Array
    goal: Array


def draw(rng: np.random.Generator, *, multiplicative: float = 0.1, additive: float = 0.1) -> Numbers:
    def weight(size: int) -> Array:
        root = rng.normal(size=(size, size))
        return root @ root.T + 0.5 * np.eye(size)

    n, m = STATES, CONTROLS
    return Numbers(
        F=rng.normal(size=(n, n)), G=rng.normal(size=(n, m)), f=rng.normal(size=n),
        J=multiplicative * rng.normal(size=(SIZE, n, n + m)), e=additive * rng.normal(size=(SIZE, n)),
        state_weight=weight(n), control_weight=weight(m), end_weight=weight(n), start=rng.normal(size=n),
        goal=rng.normal(size=n),
    )  # fmt: skip


def linear(x: Any, u: Any, p: Any) -> list[Any]:
    """The rate with all numbers as parameters, so that one compiled core serves all problems."""
    z = [*x, *u, 1]
    return [sum(getattr(p, f"f{i}{j}") * z[j] for j in range(len(z))) for i in range(STATES)]


def affine(x: Any, u: Any, p: Any) -> list[list[Any]]:
    z = [*x, *u, 1]
    return [[sum(getattr(p, f"m{k}{i}{j}") * z[j] for j in range(len(z))) for k in range(SIZE)] for i in range(STATES)]


def parameters_of_noise(numbers: Numbers) -> dict[str, float]:
    table = np.concatenate([numbers.J, numbers.e[:, :, None]], axis=2)
    return {f"m{k}{i}{j}": float(value) for (k, i, j), value in np.ndenumerate(table)}


def problem_of(numbers: Numbers, *, fixed: bool = True, noise: ls.Noise | None = None, risk: float = 0.0) -> ls.Problem:
    table = np.concatenate([numbers.F, numbers.G, numbers.f[:, None]], axis=1)
    dynamics = ls.Dynamics(
        linear, states={f"x{i}": "" for i in range(STATES)}, controls={f"u{i}": "" for i in range(CONTROLS)},
        parameters={f"f{i}{j}": float(value) for (i, j), value in np.ndenumerate(table)},
    )  # fmt: skip
    if noise is None:
        noise = ls.Noise(affine, size=SIZE, parameters=parameters_of_noise(numbers))
    soft = ls.QuadraticCost(numbers.end_weight, about=numbers.start)
    return ls.Problem(
        dynamics=dynamics, dt=DT, steps=STEPS, initial=ls.FixedState(numbers.start) if fixed else soft,
        stage_cost=ls.QuadraticCost(numbers.state_weight, about=numbers.goal) + ls.ControlCost(numbers.control_weight),
        final_cost=ls.QuadraticCost(numbers.end_weight, about=numbers.goal), noise=noise, risk=risk,
    )  # fmt: skip


class Oracle(NamedTuple):
    """Cost-to-go (T+1, ...) about the origin, and law; `broken` is the step at which there is none, or -1."""

    S: Array
    s: Array
    constant: Array
    gain: Array
    offset: Array
    broken: int


def riccati(numbers: Numbers, problem: ls.Problem, *, risk: float = 0.0) -> Oracle:
    """The stochastic Riccati recursion; with a risk, that of LEQG, whose noise must not depend on state or control."""
    n, m = STATES, CONTROLS
    A, B, c = problem.dynamics.linearize(np.zeros(n), np.zeros(m), DT)
    AB = np.hstack([A, B])
    Q, R, goal = numbers.state_weight, numbers.control_weight, numbers.goal
    S, s, k = np.zeros((STEPS + 1, n, n)), np.zeros((STEPS + 1, n)), np.zeros(STEPS + 1)
    gain, offset = np.zeros((STEPS, m, n)), np.zeros((STEPS, m))
    end = numbers.end_weight
    S[-1], s[-1], k[-1] = end, -end @ goal, 0.5 * goal @ end @ goal
    for t in range(STEPS - 1, -1, -1):
        ahead, slope, constant = S[t + 1], s[t + 1], k[t + 1]
        if risk:
            M = numbers.e.T
            inner = np.eye(SIZE) - risk * M.T @ ahead @ M
            if np.linalg.eigvalsh(inner)[0] <= 0:
                return Oracle(S, s, k, gain, offset, t)
            # v + theta/2 (S x + s)' M W M' (S x + s): a quadratic in where the step leads.
            spread = risk * M @ np.linalg.inv(inner) @ M.T
            constant += 0.5 * slope @ spread @ slope - np.linalg.slogdet(inner)[1] / (2 * risk)
            ahead, slope = ahead + ahead @ spread @ ahead, slope + ahead @ spread @ slope
        H, h = AB.T @ ahead @ AB, AB.T @ (ahead @ c + slope)
        constant += 0.5 * c @ ahead @ c + slope @ c
        if not risk:
            for J, e in zip(numbers.J, numbers.e, strict=True):
                H, h, constant = H + J.T @ ahead @ J, h + J.T @ ahead @ e, constant + 0.5 * e @ ahead @ e
        H[:n, :n] += Q
        H[n:, n:] += R
        h[:n] -= Q @ goal
        constant += 0.5 * goal @ Q @ goal
        gain[t], offset[t] = -np.linalg.solve(H[n:, n:], H[n:, :n]), -np.linalg.solve(H[n:, n:], h[n:])
        S[t] = H[:n, :n] + H[:n, n:] @ gain[t]
        s[t] = h[:n] + H[:n, n:] @ offset[t]
        k[t] = constant + 0.5 * h[n:] @ offset[t]
    return Oracle(S, s, k, gain, offset, -1)

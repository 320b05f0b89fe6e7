"""Random linear-quadratic problems and their exact solution by one dense linear system: the oracle of the tests."""

from dataclasses import dataclass
from math import factorial

import numpy as np
from oracle import kkt

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import terms_of


@dataclass(frozen=True)
class LinearQuadratic:
    """x' = A x + B u + c; stage cost 1/2 z'Hz + z'h + k with z = (x, u); ends 1/2 x'Qx + x'q + k."""

    A: Array
    B: Array
    c: Array
    H: Array
    h: Array
    k: Array
    Q0: Array
    q0: Array
    k0: float
    QT: Array
    qT: Array
    kT: float
    fixed: Array | None = None  # an initial state that is given, in place of Q0, q0, k0


def random_problem(seed: int, n: int, m: int, steps: int) -> LinearQuadratic:
    """Well conditioned, with cross terms: the joint Hessian is positive definite, A near the identity."""
    rng = np.random.default_rng(seed)

    def definite(size: int) -> Array:
        root = rng.normal(size=(size, size))
        return root @ root.T + np.eye(size)

    return LinearQuadratic(
        A=np.eye(n) + 0.2 * rng.normal(size=(steps, n, n)),
        B=rng.normal(size=(steps, n, m)),
        c=rng.normal(size=(steps, n)),
        H=np.array([definite(n + m) for _ in range(steps)]),
        h=rng.normal(size=(steps, n + m)),
        k=rng.normal(size=steps),
        Q0=definite(n),
        q0=rng.normal(size=n),
        k0=float(rng.normal()),
        QT=definite(n),
        qT=rng.normal(size=n),
        kT=float(rng.normal()),
    )


def matrices_of(problem: ls.Problem) -> LinearQuadratic:
    """A problem of `systems.linear`; its step is that of Runge and Kutta, the first powers of the exponential."""
    n, m, steps = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates), problem.steps
    rates = np.zeros((n + m + 1, n + m + 1))
    rates[:n] = problem.dt * np.array(list(problem.dynamics.parameters.values())).reshape(n, n + m + 1)
    step = sum((np.linalg.matrix_power(rates, k) / factorial(k) for k in range(5)), np.zeros_like(rates))[:n]
    H, h, k = np.zeros((steps, n + m, n + m)), np.zeros((steps, n + m)), np.zeros(steps)
    for term in terms_of(problem.stage_cost):
        if isinstance(term, ls.SymbolicCost):  # systems.cross_cost
            upper = np.zeros((n + m, n + m))
            upper[np.triu_indices(n + m)] = list(term.parameters.values())
            H += upper + np.triu(upper, 1).T
        elif isinstance(term, ls.QuadraticCost | ls.ControlCost):
            place = slice(0, n) if isinstance(term, ls.QuadraticCost) else slice(n, n + m)
            about, weight = kkt.quadratic_at(term, steps)
            pull = (weight @ about[..., None])[..., 0]
            H[:, place, place] += weight
            h[:, place] -= pull
            k += 0.5 * (about * pull).sum(axis=-1)

    def of_end(cost: ls.QuadraticCost, at: int) -> tuple[Array, Array, float]:
        weight, about = (part[at] if part.ndim > size else part for part, size in ((cost.weight, 2), (cost.about, 1)))
        return weight, -weight @ about, float(0.5 * about @ weight @ about)

    fixed = problem.initial.numbers if isinstance(problem.initial, ls.FixedState) else None
    none = ls.QuadraticCost(np.zeros(n), about=np.zeros(n))
    Q0, q0, k0 = of_end(problem.initial if fixed is None else none, 0)  # pyright: ignore[reportArgumentType]
    QT, qT, kT = of_end(problem.final_cost, -1)  # pyright: ignore[reportArgumentType]
    A, B, c = (np.tile(part, (steps, *[1] * part.ndim)) for part in (step[:, :n], step[:, n:-1], step[:, -1]))
    return LinearQuadratic(A, B, c, H, h, k, Q0, q0, k0, QT, qT, kT, fixed)


def solve_dense(problem: LinearQuadratic) -> tuple[Array, Array, float]:
    """States (T+1, n), controls (T, m) and the least cost, from the KKT system of the whole horizon at once."""
    steps, n, m = problem.B.shape
    size = (steps + 1) * n + steps * m

    def state(t: int) -> slice:
        return slice(t * n, (t + 1) * n)

    def control(t: int) -> slice:
        return slice((steps + 1) * n + t * m, (steps + 1) * n + (t + 1) * m)

    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    constraint, right = np.zeros((steps * n, size)), np.zeros(steps * n)
    if problem.fixed is None:
        hessian[state(0), state(0)] += problem.Q0
        gradient[state(0)] += problem.q0
    hessian[state(steps), state(steps)] += problem.QT
    gradient[state(steps)] += problem.qT
    for t in range(steps):
        z = np.r_[state(t), control(t)]
        hessian[np.ix_(z, z)] += problem.H[t]
        gradient[z] += problem.h[t]
        constraint[state(t), state(t)] = -problem.A[t]
        constraint[state(t), control(t)] = -problem.B[t]
        constraint[state(t), state(t + 1)] = np.eye(n)
        right[state(t)] = problem.c[t]
    if problem.fixed is not None:
        given = np.zeros((n, size))
        given[:, state(0)] = np.eye(n)
        constraint, right = np.vstack([constraint, given]), np.concatenate([right, problem.fixed])
    zeros = np.zeros((len(right), len(right)))
    solution = np.linalg.solve(
        np.block([[hessian, constraint.T], [constraint, zeros]]), np.concatenate([-gradient, right])
    )[:size]
    cost = 0.5 * solution @ hessian @ solution + gradient @ solution
    cost += problem.kT + problem.k.sum() + (problem.k0 if problem.fixed is None else 0.0)
    states = solution[: (steps + 1) * n].reshape(steps + 1, n)
    return states, solution[(steps + 1) * n :].reshape(steps, m), float(cost)

"""Linear-quadratic problems with limits of the controls, and their solution by bounded least squares."""

from math import factorial
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

import lqrsim as ls
from lqrsim.errors import Array

DT = 0.2


def linear(x, u, p):
    return [p.a * x[0] + p.b * x[1] + p.c * u[0] + p.d * u[1], p.e * x[0] + p.f * x[1] + p.g * u[0] + p.h * u[1]]


def random_problem(seed: int, *, steps: int = 10, limit: float = 0.5, fixed: bool = True) -> ls.Problem:
    """A stable linear system with two controls, pushed by wishes that it can not all meet."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    a -= (np.linalg.eigvals(a).real.max() + 0.1) * np.eye(2)
    numbers = {name: float(entry) for name, entry in zip("abcdefgh", np.hstack([a, b]).ravel(), strict=True)}
    start = 2 * rng.normal(size=2)
    stage = ls.ControlCost(rng.uniform(0.05, 1, 2), about=0.3 * rng.normal(size=2))
    return ls.Problem(
        dynamics=ls.Dynamics(linear, states={"x": "", "y": ""}, controls={"u": "", "w": ""}, parameters=numbers),
        dt=DT, steps=steps, initial=ls.FixedState(start) if fixed else ls.QuadraticCost([3.0, 5.0], about=start),
        stage_cost=stage + ls.QuadraticCost(rng.uniform(0.1, 2, 2), about=rng.normal(size=2)),
        final_cost=ls.QuadraticCost(rng.uniform(1, 10, 2), about=rng.normal(size=2)), control_limits=(-limit, limit),
    )  # fmt: skip


def matrices(problem: ls.Problem) -> tuple[Array, Array]:
    """The Runge-Kutta step of the linear system, as a Taylor polynomial."""
    p = list(problem.dynamics.parameters.values())
    both = np.array(p).reshape(2, 4)
    a, b = both[:, :2] * DT, both[:, 2:] * DT
    powers = [np.linalg.matrix_power(a, k) for k in range(5)]
    terms = [(powers[k] / factorial(k), powers[k] / factorial(k + 1) * (k < 4)) for k in range(5)]
    return np.sum([one for one, _ in terms], axis=0), np.sum([one for _, one in terms], axis=0) @ b


def bounded(problem: ls.Problem) -> tuple[float, Array]:
    """Least cost and controls by SciPy's bounded-variable least squares; of a soft start, the first state is free."""
    A, B = matrices(problem)
    effort, wish = problem.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
    fixed = isinstance(problem.initial, ls.FixedState)
    free, steps = 0 if fixed else 2, problem.steps
    assert problem.start is not None
    reach, x = np.eye(2, free + 2 * steps) * (not fixed), problem.start * fixed
    rows, right = [], []

    def add(cost: Any, slope: Array, at: Array) -> None:
        root = np.sqrt(np.diag(cost.weight))
        rows.append(root[:, None] * slope)
        right.append(root * (cost.about - at))

    if not fixed:
        add(problem.initial, reach, x)
    for t in range(steps):
        control = np.eye(2, free + 2 * steps, k=free + 2 * t)
        add(wish, reach, x)
        add(effort, control, np.zeros(2))
        reach, x = A @ reach + B @ control, A @ x
    add(problem.final_cost, reach, x)
    space = problem.control_coordinates
    low, high = (np.concatenate([np.full(free, s * np.inf), np.tile(side, steps)])
                 for s, side in ((-1, space.low), (1, space.high)))  # fmt: skip
    found = lsq_linear(np.vstack(rows), np.concatenate(right), (low, high), method="bvls", tol=1e-15, max_iter=10_000)
    return float(found.cost), found.x[free:].reshape(steps, 2)

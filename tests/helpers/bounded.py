"""Linear-quadratic problems with limits of the controls, and their solution by bounded least squares."""

from typing import Any

import numpy as np
import systems
from linear_quadratic import matrices_of
from scipy.optimize import lsq_linear

import lqrsim as ls
from lqrsim.errors import Array

DT, N, M = 0.2, 3, 2


def random_problem(seed: int, *, steps: int = 10, limit: float = 0.5, fixed: bool = True) -> ls.Problem:
    """A stable linear system of three states and two controls, with targets that it cannot all meet."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(N, N)), rng.normal(size=(N, M))
    a -= (np.linalg.eigvals(a).real.max() + 0.1) * np.eye(N)
    start = 2 * rng.normal(size=N)
    effort = ls.ControlCost(rng.uniform(0.05, 1, M), about=0.3 * rng.normal(size=M))
    return ls.Problem(
        dynamics=systems.linear(a, b), dt=DT, steps=steps, control_limits=(-limit, limit),
        initial=ls.FixedState(start) if fixed else ls.QuadraticCost([3.0, 5.0, 4.0], about=start),
        stage_cost=systems.stage_cost(
            effort, ls.QuadraticCost(rng.uniform(0.1, 2, N), about=rng.normal(size=N))
        ),
        final_cost=ls.QuadraticCost(rng.uniform(1, 10, N), about=rng.normal(size=N)),
    )  # fmt: skip


def bounded(problem: ls.Problem) -> tuple[float, Array]:
    """Least cost and controls by SciPy's bounded-variable least squares; with a soft start the first state is free."""
    of = matrices_of(problem)
    A, B = of.A[0], of.B[0]
    effort, wish, _ = problem.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
    fixed = isinstance(problem.initial, ls.FixedState)
    free, steps = 0 if fixed else N, problem.steps
    assert problem.start is not None
    reach, x = np.eye(N, free + M * steps) * (not fixed), problem.start * fixed
    rows, right = [], []

    def add(cost: Any, slope: Array, at: Array) -> None:
        root = np.sqrt(np.diag(cost.weight))
        rows.append(root[:, None] * slope)
        right.append(root * (cost.about - at))

    if not fixed:
        add(problem.initial, reach, x)
    for t in range(steps):
        control = np.eye(M, free + M * steps, k=free + M * t)
        add(wish, reach, x)
        add(effort, control, np.zeros(M))
        reach, x = A @ reach + B @ control, A @ x
    add(problem.final_cost, reach, x)
    space = problem.control_coordinates
    low, high = (np.concatenate([np.full(free, s * np.inf), np.tile(side, steps)])
                 for s, side in ((-1, space.low), (1, space.high)))  # fmt: skip
    found = lsq_linear(np.vstack(rows), np.concatenate(right), (low, high), method="bvls", tol=1e-15, max_iter=10_000)
    return float(found.cost), found.x[free:].reshape(steps, M)

"""What a solution of a drawn family claims, held against its formulas alone: dense derivatives in the controls.

The variables are the controls and, where it is free, the length of a step; states follow by RK4. Gradients are by
complex steps, Hessians by central differences of these, so that nothing is shared with a solver.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status

from .families import Case

COST = 1e-7  # rounding of sums of a few hundred terms, and of steps that amplify it
WIDE = 100.0  # limits that are this much farther apart than the largest control say nothing of its size
ACTIVE = 1e-5  # how near to a bound or a limit, relative to its size, counts as at it
FLAT = 1e-6  # eigenvalues up to this part of the largest are neither positive nor negative: those of differences
SLACK = 10.0  # times the tolerance: what may still be saved; the solver's own Hessians are others
GAIN = 1e-6  # what a step may lower the cost by where nothing can be gained, relative
WORSE = 1e-6  # a plan that costs this much more than another, relative, is worse
VIOLATED = 1e-6  # tolerance of constraints, in their units


def contradictions(case: Case, solution: ls.Solution) -> list[str]:
    """What a solution claims, or is, that must not be; empty where all is right."""
    found, plan, free = [], solution.trajectory, case.problem.duration is not None
    if not np.isfinite(plan.states).all():
        return (
            [] if solution.status is Status.NOT_FINITE else [f"{solution.status.name} with a plan that is not finite"]
        )
    if solution.status is Status.NOT_CERTIFIED:
        found.append(f"NOT_CERTIFIED: {solution.detail}")
    price = case.problem.time_weight * plan.horizon if free else 0.0
    cost = float(_cost(case, _variables(case, solution))) - price
    if not abs(cost - solution.cost) <= COST * abs(cost) + 1e-9 * _size(case):
        found.append(f"costs {cost:.9g}, not {solution.cost:.9g}")
    if case.given is not None:
        found += _worse_than_given(case, solution)
    if solution.status is Status.CONVERGED and case.model is None:
        found += _of_an_optimum(case, solution)
    elif (
        not solution.success and solution.status is not Status.MAX_ITERATIONS
        and not case.problem.constraints and _can_be_lowered(case, solution)
    ):  # fmt: skip
        found.append(f"{solution.status.name}, but a step lowers the cost")
    return found


def _size(case: Case) -> float:
    """The cost of the nominal controls, or of none at all where that is not finite."""
    nominal = np.broadcast_to(case.problem.nominal_controls, (case.problem.steps, len(case.low)))
    cost = float(case.cost(nominal))
    return cost if np.isfinite(cost) else 1.0


def _variables(case: Case, solution: ls.Solution) -> Array:
    controls = solution.trajectory.controls.ravel()
    return np.append(controls, solution.trajectory.dt) if case.problem.duration is not None else controls


def _split(case: Case, z: Array) -> tuple[Array, Any]:
    m, free = len(case.low), case.problem.duration is not None
    controls = z[:-1] if free else z
    return controls.reshape(-1, m, *z.shape[1:]), z[-1] if free else case.problem.dt


def _cost(case: Case, z: Array) -> Array:
    controls, dt = _split(case, z)
    total = case.cost(controls, case.roll(controls, dt))  # type: ignore[arg-type]
    return total + case.problem.time_weight * len(controls) * dt if case.problem.duration is not None else total


def _rows(case: Case, z: Array) -> tuple[Array, Array]:
    controls, dt = _split(case, z)
    return case.constraints(controls, dt)


def _worse_than_given(case: Case, solution: ls.Solution) -> list[str]:
    given = rollout_of(case)
    before, missed = float(case.cost(given)), _violation(case, given.reshape(-1))
    cost, own = solution.cost, solution.violation
    if not np.isfinite(before):
        return []
    if missed <= VIOLATED and own > VIOLATED:
        return [f"misses a constraint by {own:.2g}, which the start keeps"]
    if missed > VIOLATED and own > missed * 1.01 and own > VIOLATED:
        return [f"misses a constraint by {own:.2g}, the start by {missed:.2g}"]
    same = (missed <= VIOLATED) == (own <= VIOLATED) and (own <= VIOLATED or own > 0.99 * missed)
    if same and cost > before + WORSE * abs(before) + 1e-9 * _size(case):
        return [f"{solution.status.name} at {cost:.6g}, worse than its start at {before:.6g}"]
    return []


def rollout_of(case: Case) -> Array:
    """The controls (T, m) of what is given, run from the start within the limits."""
    given, steps = case.given, case.problem.steps
    if isinstance(given, ls.Trajectory):
        return np.clip(given.controls, case.low, case.high)
    policy = given.policy if isinstance(given, ls.Solution) else given
    if not isinstance(policy, ls.AffinePolicy):
        return np.clip(np.broadcast_to(np.asarray(given), (steps, len(case.low))), case.low, case.high)
    controls = []
    x = np.asarray(case.problem.initial.numbers)  # type: ignore[union-attr]
    for t in range(steps):
        u = np.clip(policy.gain[t] @ x + policy.offset[t], case.low, case.high)
        controls.append(u)
        x = case.roll(np.array(controls))[-1] if t + 1 < steps else x
    return np.array(controls)


def _violation(case: Case, z: Array) -> float:
    above, equal = _rows(case, z)
    return max(float((-above).max(initial=0.0)), float(np.abs(equal).max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Dense:
    """Derivatives of a plan in variables that are scaled by their sizes.

    Attributes:
      gradient: (D,) of the cost. rows: (K, D) slopes of what is active: equalities, inequalities and limits.
      inequality: (K,) which of these are. forces: (K,) multipliers by least squares. left: (D,) what of the gradient
        they leave.
      hessian: (D, D) of the Lagrangian. reduced: the eigenvalues of the Hessian on the tangent space of the rows.
      slopes: of the cost along their eigenvectors.
    """

    gradient: Array
    rows: Array
    inequality: NDArray[np.bool_]
    forces: Array
    left: Array
    hessian: Array
    reduced: Array
    slopes: Array


def dense(case: Case, solution: ls.Solution) -> Dense:
    """The dense derivatives of a solution's plan."""
    z = _variables(case, solution)
    size, D, free = _sizes(case, z), len(z), case.problem.duration is not None
    step = 1e-30

    def slopes(function: object, at: Array) -> Array:
        """By complex steps, (K, ..., D), of variables (D, ...)."""
        moved = at[..., None] + 1j * step * np.diag(size).reshape(D, *[1] * (at.ndim - 1), D)
        return np.imag(function(moved)) / step  # type: ignore[operator]

    gradient = slopes(lambda y: _cost(case, y), z)
    above = _rows(case, z)[0]
    pulls_above, pulls_equal = (slopes(lambda y, k=k: _rows(case, y)[k], z) for k in (0, 1))
    reach = np.abs(pulls_above).max(axis=1, initial=0.0) if len(above) else np.zeros(0)
    near = np.abs(above) <= ACTIVE * np.maximum(reach, 1e-300)
    low, high = (np.tile(side, case.problem.steps) for side in (case.low, case.high))
    if free:
        total = np.array(case.problem.duration) / case.problem.steps
        low, high = np.append(low, total[0]), np.append(high, total[1])
    at_low, at_high = (z - low) / size <= ACTIVE, (high - z) / size <= ACTIVE
    rows = np.concatenate([pulls_equal, pulls_above[near], np.eye(D)[at_low], -np.eye(D)[at_high]])
    inequality = np.arange(len(rows)) >= len(pulls_equal)
    forces = np.linalg.lstsq(rows.T, gradient, rcond=1e-10)[0] if len(rows) else np.zeros(0)
    left = gradient - rows.T @ forces
    on_equal, on_above = forces[: len(pulls_equal)], np.zeros(len(above))
    on_above[near] = forces[len(pulls_equal) : len(pulls_equal) + int(near.sum())]

    def lagrangian(y: Array) -> Array:
        over, even = _rows(case, y)
        return _cost(case, y) - np.tensordot(on_above, over, 1) - np.tensordot(on_equal, even, 1)

    step_aside = 1e-4 * np.diag(size)
    ahead, back = (slopes(lagrangian, z[:, None] + sign * step_aside) for sign in (1, -1))
    hessian = (ahead - back) / 2e-4
    hessian = (hessian + hessian.T) / 2
    tangent = np.eye(D)
    if len(rows):
        _, values, across = np.linalg.svd(rows)
        rank = int((values > 1e-8 * values.max()).sum())
        tangent = across[rank:].T
    reduced, across = np.linalg.eigh(tangent.T @ hessian @ tangent)
    return Dense(gradient, rows, inequality, forces, left, hessian, reduced, (tangent @ across).T @ left)


def _sizes(case: Case, z: Array) -> Array:
    """Typical sizes of the variables: ranges of limits, or the largest control, or a step's length."""
    m, steps = len(case.low), case.problem.steps
    controls, dt = _split(case, z)
    span = case.high - case.low
    own = np.abs(controls).max(axis=0)
    own = np.where(own > 1e-3 * own.max(), own, own.max())
    own = np.where(own > 1e-100, own, 1.0)  # squares of less are no numbers
    size = np.where(span < WIDE * own, span, own)
    both = np.tile(size, steps)
    assert m == len(size)
    return np.append(both, dt) if case.problem.duration is not None else both


def _of_an_optimum(case: Case, solution: ls.Solution) -> list[str]:
    of = dense(case, solution)
    found, curve = [], np.abs(of.hessian).max(initial=0.0)
    if not np.isfinite(of.reduced).all():
        return ["derivatives are not finite"]
    claimed = solution.curvature
    least = float(of.reduced.min(initial=np.inf))
    largest = max(float(np.abs(of.reduced).max(initial=0.0)), 1e-3 * curve, 1e-300)
    bent = of.reduced > FLAT * largest
    promised = 0.5 * float((of.slopes[bent] ** 2 / of.reduced[bent]).sum())
    tolerance, cost = solution.options["tolerance"], float(_cost(case, _variables(case, solution)))
    assert isinstance(tolerance, float)
    if not promised <= SLACK * tolerance * abs(cost) + 1e-11 * _size(case):
        found.append(f"no optimum: {promised:.2g} of {cost:.2g} could still be saved")
    if least < -FLAT * largest:
        found.append(f"a saddle: the least eigenvalue is {least:.2g} of {largest:.2g} (said: {claimed})")
    if claimed == "minimum" and least < 1e-11 * largest:
        found.append(f"no minimum: the least eigenvalue is {least:.2g} of {largest:.2g}")
    idle = of.inequality & (np.abs(of.forces) < 1e-6 * max(float(np.abs(of.gradient).max(initial=0.0)), curve))
    if claimed == "singular" and least > 1e-3 * largest and not idle.any():
        found.append(f"not singular: the least eigenvalue is {least:.2g} of {largest:.2g}")
    return found


def _can_be_lowered(case: Case, solution: ls.Solution) -> bool:
    """Whether a step of iLQR lowers the cost by more than `GAIN`."""
    after = ls.ilqr(case.problem, start=solution.trajectory.controls, max_iterations=1)
    return after.cost < solution.cost - GAIN * abs(solution.cost)

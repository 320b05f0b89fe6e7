"""Whether a plan is what a solver says of it, in plain NumPy: nothing of lqrsim's or the other solvers' is believed.

Dynamics, costs and constraints are evaluated anew by `oracle/kkt.py` and `constraints.py`: formulas through
SymPy's `lambdify`, distances from geometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from oracle import constraints, kkt
from scipy import sparse
from scipy.sparse.linalg import splu

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.mjcf_holding import nonnegative_least_squares

VIOLATION = 1e-6  # what counts as kept: dynamics, start, limits and constraints
NEAR = 1e-3  # how near its limit an inequality is that may have a multiplier
COST = 1e-6  # as a share: how closely the cost that is claimed is that of the plan


@dataclass(frozen=True)
class Verified:
    """What was found.

    Attributes:
      cost: of the plan, with the price of a free duration.
      motion: by how much a state is off the step from the one before, at most.
      violation: by how much a constraint, a limit of the controls, a bound of the duration or the given start is
        missed, at most.
      optimality: by how much the first-order conditions are missed, relative to the slope of the cost; see `_missed`.
      faults: in words, what is not as it must be; empty where all is.
    """

    cost: float
    motion: float
    violation: float
    optimality: float
    faults: tuple[str, ...]


def verify(problem: ls.Problem, plan: ls.Trajectory, claimed: float) -> Verified:
    """Recompute a plan that is claimed to keep to all of the problem, and to cost so much."""
    states, controls = plan.states, plan.controls
    n = len(problem.dynamics.state_coordinates)
    m = len(problem.control_coordinates)
    if states.shape != (problem.steps + 1, n) or controls.shape != (problem.steps, m):
        return Verified(np.nan, np.inf, np.inf, np.inf, ("the plan is of another size",))
    if not (np.isfinite(states).all() and np.isfinite(controls).all()):
        return Verified(np.nan, np.inf, np.inf, np.inf, ("the plan is not finite",))
    assert isinstance(problem.initial, ls.FixedState)
    z = np.hstack([states[:-1], controls])
    with np.errstate(all="ignore"):
        arrived = _step(problem, states[:-1], controls, plan.dt)
        cost = problem.time_weight * plan.horizon + float(
            kkt.cost_values(problem, problem.stage_cost, z, n, first=0).sum()
            + kkt.cost_values(problem, problem.final_cost, states[-1:], n, first=-1)[0]
        )
        along = constraints.points(plan)
        missed = max((one.violation(along) for one in constraints.of(problem)), default=0.0)
    motion = float(np.abs(arrived - states[1:]).max())
    start = float(np.abs(states[0] - problem.initial.numbers).max())
    low, high = np.array(problem.control_coordinates.low), np.array(problem.control_coordinates.high)
    limits = float(np.maximum(low - controls, controls - high).max())
    shortest, longest = (problem.steps * problem.dt,) * 2 if problem.duration is None else problem.duration
    late = max(shortest - plan.horizon, plan.horizon - longest)
    kept = {
        "the dynamics": motion, "the start": start, "a limit of the controls": limits, "a constraint": missed,
        "the duration": late,
    }  # fmt: skip
    faults = [f"{what}: missed by {amount:.2g}" for what, amount in kept.items() if not amount < VIOLATION]
    if not abs(cost - claimed) <= COST * abs(cost):
        faults.append(f"it costs {cost:.9g}, not {claimed:.9g}")
    return Verified(cost, motion, max(start, limits, missed, late), _optimality(problem, plan), tuple(faults))


def _optimality(problem: ls.Problem, plan: ls.Trajectory) -> float:
    """The residual of the first-order conditions of a plan, whatever the solver's multipliers are.

    The residual is the slope of the Lagrangian in each state after the first, in each control and in a free period, and
    each inequality times its multiplier. The multipliers are those that make it least, by least squares; those of
    inequalities are not negative. The largest entry counts, relative to the largest slope of the cost.
    """
    steps, n, m = problem.steps, plan.states.shape[1], plan.controls.shape[1]
    z, p, rate = np.hstack([plan.states[:-1], plan.controls]), kkt.numbers_of(problem), _rate(problem)
    _, gradient, _ = kkt.cost_model(problem, problem.stage_cost, z, n, first=0)
    _, end, _ = kkt.cost_model(problem, problem.final_cost, plan.states[-1:], n, first=-1)
    # The unknowns are points (T+1, n+m), as those of the constraints, and the period. Some are not free: see `free`.
    size, free = (steps + 1) * (n + m) + 1, np.ones((steps + 1, n + m), bool)
    free[0, :n] = free[-1, n:] = False
    free = np.append(free.ravel(), problem.duration is not None)
    slope = np.append(np.vstack([gradient, np.append(end, np.zeros(m))]).ravel(), problem.time_weight * steps)
    place = np.arange(size - 1).reshape(steps + 1, n + m)

    _, jacobian = kkt.step_jacobian(rate, z, n, p, plan.dt)
    in_time = kkt.step(rate, z[:, :n] + 0j, z[:, n:] + 0j, p, plan.dt + 1e-30j).imag / 1e-30  # pyright: ignore
    column = np.arange(steps * n).reshape(steps, n)
    equalities = [
        _entries(jacobian, place[:-1, None, :], column[:, :, None], size),
        _entries(-np.ones((steps, n)), place[1:, :n], column, size),
        _entries(in_time, np.array(size - 1), column, size),
    ]
    equal, unequal, spare = [sum(equalities[1:], equalities[0])], [], []
    along = constraints.points(plan)
    for one in constraints.of(problem):
        t, row = np.nonzero(one.acts)
        part = _entries(one.slopes(along)[t, row], place[t], np.arange(len(t))[:, None], size)
        if one.equality:
            equal.append(part)
        else:
            unequal.append(part)
            spare.append(one.function(along)[t, row])
    identity = sparse.csc_array(sparse.eye_array(size))
    low, high = np.array(problem.control_coordinates.low), np.array(problem.control_coordinates.high)
    bounds = [(plan.controls - low, place[:-1, n:], 1.0), (high - plan.controls, place[:-1, n:], -1.0)]
    if problem.duration is not None:
        shortest, longest = (bound / steps for bound in problem.duration)
        last = np.array([size - 1])
        bounds += [(np.array([plan.dt - shortest]), last, 1.0), (np.array([longest - plan.dt]), last, -1.0)]
    for left, where, sign in bounds:
        finite = np.isfinite(left)
        unequal.append(sign * identity[:, where[finite]])
        spare.append(left[finite])

    gaps, kept = np.concatenate(spare), np.flatnonzero(free)
    near = np.flatnonzero(gaps < NEAR)  # the rest has no part in it
    signed = np.vstack([_beside(unequal).toarray()[kept][:, near], np.diag(gaps[near])])
    pulls = _beside(equal)[kept]
    pulls = sparse.block_array([[pulls], [sparse.csc_array((len(near), pulls.shape[1]))]], format="csc")
    wanted = np.append(slope[kept], np.zeros(len(near)))
    left = _left_of(np.column_stack([wanted, signed]), pulls)
    # SciPy 1.17 ends the process if there is nothing to choose. Any other multipliers that are not negative leave more,
    # so that no fault of what finds them makes a plan optimal.
    pushes = nonnegative_least_squares(left[:, 1:], left[:, 0]) if len(near) else np.zeros(0)
    assert (pushes >= 0).all()
    return float(np.abs(left[:, 0] - left[:, 1:] @ pushes).max() / np.abs(wanted).max())


def _entries(values: Array, rows: Any, columns: Any, size: int) -> Any:
    """A sparse matrix with `size` rows and as many columns as are named."""
    values, rows, columns = np.broadcast_arrays(values, rows, columns)
    shape = (size, int(columns.max(initial=-1)) + 1)
    return sparse.csc_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _beside(matrices: Sequence[Any]) -> Any:
    return sparse.csc_array(sparse.hstack(matrices))


def _left_of(values: Any, columns: Any) -> Array:
    """What least squares with some columns leave of `values`, from the augmented system: it is well conditioned."""
    lengths = np.sqrt(columns.multiply(columns).sum(axis=0)) + 1e-300
    scaled = columns @ sparse.diags_array(1 / lengths)
    rows, count = scaled.shape
    shift = sparse.diags_array(np.full(count, -1e-14))  # where columns depend on each other
    system = sparse.block_array([[sparse.eye_array(rows), scaled], [scaled.T, shift]], format="csc")
    factors, right = splu(system), np.vstack([values, np.zeros((count, values.shape[1]))])
    found = factors.solve(right)
    found += factors.solve(right - system @ found)
    return found[:rows]


def rolled_out(problem: ls.Problem, controls: Array) -> Array:
    """States (T+1, n) that the controls (T, m) lead to."""
    assert isinstance(problem.initial, ls.FixedState)
    states = [problem.initial.numbers.copy()]
    for control in controls:
        states.append(_step(problem, states[-1], control, problem.dt))
    return np.array(states)


def _step(problem: ls.Problem, states: Array, controls: Array, dt: float) -> Array:
    """Where states (..., n) are a step later under controls (..., m)."""
    return kkt.step(_rate(problem), states, controls, kkt.numbers_of(problem), dt)


def _rate(problem: ls.Problem) -> kkt.Rate:
    """xdot of the problem's dynamics, in NumPy."""
    written = kkt.quadrotor_rate if problem.dynamics.f is ls.Quadrotor().dynamics.f else None
    return kkt.rate_of(problem, written)

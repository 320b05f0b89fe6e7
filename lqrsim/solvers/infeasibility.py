"""Evidence that constraints are infeasible near a plan: the violation is stationary.

The total violation, each row relative to its size, has a gradient in the controls. It is recomputed here from the
problem's own functions, on a code path that the solvers do not use. Rows that are just satisfied balance the gradient
with multipliers from 0 to 1, which the restoration finds. Controls at their limits balance it by themselves. If the sum
is zero, no plan nearby violates the constraints less.

With the augmented Lagrangian, the evidence is a violation that does not fall while the penalty grows. Either evidence
counts as infeasibility only if two starts lead to the same violation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lqrsim.errors import Array
from lqrsim.problem.problem import Problem
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.stages import Sizes

STARTS, ALIKE = 2, 0.05  # starts that must lead to equal violations, and relative difference up to which they are equal
STATIONARY = 5e-3  # largest remaining gradient, relative to the gradients that cancel
NEAR_LIMIT = 1e-4  # distance from a limit, relative to the range, that a barrier may leave
NAMED = 3  # largest number of constraints that a message names in addition to the most violated constraint


@dataclass(frozen=True, eq=False)
class Evidence:
    """A plan whose violation is stationary."""

    plan: RunResult
    missed: float  # its violation, in a measure that is the same for a whole search
    against: tuple[str, ...] = ()  # the other constraints that conflict, in words, the strongest first

    def beside(self, worst: str) -> tuple[str, ...]:
        """The conflicting constraints other than the one that a message begins with, in words."""
        return tuple(name for name in self.against if not worst.startswith(name.rsplit(" at ", 1)[0]))[:NAMED]


def alike(cases: Sequence[Evidence]) -> list[Evidence]:
    """The evidence with equally small violations, the least first; empty unless it is from `STARTS` starts."""
    least = sorted(cases, key=lambda case: case.missed)
    same = [case for case in least if case.missed <= (1 + ALIKE) * least[0].missed]
    return same if len(same) >= STARTS else []


def evidence(run: SolveRun, plan: RunResult, shares: list[Array], sizes: Sizes) -> Evidence | None:
    """Return the evidence that a plan for the problem of a run provides, or None.

    Args:
      shares: multipliers of each constraint relative to the price, (T+1, rows), from -1 to 1.
      sizes: typical sizes of states, controls and rows.
    """
    problem = run.problem
    missed, slopes, alone, holding = _violation_slopes(run, plan, shares, sizes)
    if not missed > 0:
        return None
    left, size, pull, pressed = _balance(problem, plan, slopes, alone, sizes)
    if not left <= STATIONARY * size:
        return None
    if size > 0:
        forces = zip(problem.dynamics.control_coordinates.names, pressed.tolist(), strict=True)
        holding += [(force / size, f"the limits of {name}") for name, force in forces if force > 1e-2 * min(pull, size)]
    return Evidence(plan, missed, tuple(name for _, name in sorted(holding, reverse=True)))


def _violation_slopes(
    run: SolveRun, plan: RunResult, shares: list[Array], sizes: Sizes
) -> tuple[float, Array, Array, list[tuple[float, str]]]:
    """The total violation, relative to the rows' sizes, and its slopes.

    Returns:
      The violation; slopes (T+1, n+m) of all rows with their multipliers, and of the violated rows alone; and the rows
      in words, each with its fraction.
    """
    problem, work, states, controls = run.problem, run.work, plan.states, plan.controls
    allowed = run.settings.violation_tolerance(problem)
    steps, joint = len(controls), states.shape[1] + controls.shape[1]
    slopes, alone, missed = np.zeros((steps + 1, joint)), np.zeros((steps + 1, joint)), 0.0
    holding: list[tuple[float, str]] = []
    for k, (term, numbers) in enumerate(zip(problem.constraint_terms, work.constraint_values(plan.plan), strict=True)):
        rows = sizes.rows[run.stages.owners == k]
        short = np.where(np.isfinite(numbers), np.abs(numbers) if term.equality else -numbers, 0.0)
        weights = np.where(short > allowed, 1.0, np.abs(shares[k])) * (np.sign(shares[k]) if term.equality else 1.0)
        weights[np.where(np.isfinite(numbers), numbers, np.inf) > 1e-2 * rows] *= term.equality
        for t, row in np.argwhere(np.abs(weights) > 1e-6):
            weight = weights[t, row] / rows[row]
            slope = weight * work.constraint_slope(k, int(row), states[t], controls[min(t, steps - 1)], int(t))
            slopes[t] -= slope
            if short[t, row] > allowed:
                alone[t] -= slope
                missed += float(short[t, row] / rows[row])
        for row in range(term.rows):
            excess = float(short[:, row].max())
            weight_of_row = 1 + excess / rows[row] if excess > allowed else float(np.abs(weights[:, row]).sum())
            if weight_of_row > 1e-2:
                t = int((short if excess > allowed else np.abs(weights))[:, row].argmax())
                shortfall = f", missed by {excess:.2g}" if excess > allowed else ""
                holding.append((weight_of_row, f"{term.describe(row)} at {t * problem.dt:.2f} s{shortfall}"))
    return missed, slopes, alone, holding


def _balance(
    problem: Problem, plan: RunResult, slopes: Array, alone: Array, sizes: Sizes
) -> tuple[float, float, float, Array]:
    """The largest remaining gradient in a control, the size of the cancelling ones, and (m,) the limits' part.

    The third number is the largest gradient of the violated rows alone. The size is above it by orders of magnitude if
    they depend on controls through states of other magnitudes only.
    """
    states, controls = plan.states, plan.controls
    steps, (n, m) = len(controls), (states.shape[1], controls.shape[1])
    space, state_size, control_size = problem.control_coordinates, sizes.states, sizes.controls
    low = controls <= space.low + NEAR_LIMIT * control_size
    high = controls >= space.high - NEAR_LIMIT * control_size
    total, size, pull, pressed = 0.0, 0.0, 0.0, np.zeros(m)
    costate, costate_alone = slopes[steps, :n], alone[steps, :n]
    for t in range(steps - 1, -1, -1):
        A, B, _ = problem.dynamics.linearize(states[t], controls[t], problem.dt)
        slope, of_missed = slopes[t, n:] + B.T @ costate, alone[t, n:] + B.T @ costate_alone
        free = ~((low[t] & (slope > 0)) | (high[t] & (slope < 0)))
        total = max(total, float((np.abs(slope) * control_size * free).max()))
        pressed = np.maximum(pressed, np.abs(slope) * control_size * ~free)
        reach = np.linalg.norm(B / state_size[:, None], axis=0) * control_size
        force = max(np.linalg.norm(costate * state_size), np.linalg.norm(costate_alone * state_size))
        pull = max(pull, float((np.abs(of_missed) * control_size).max()))
        size = max(size, pull, float(force * reach.max()))
        costate, costate_alone = slopes[t, :n] + A.T @ costate, alone[t, :n] + A.T @ costate_alone
    return total, size, pull, pressed

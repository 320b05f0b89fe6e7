"""Evidence that constraints cannot be kept, at least not near a plan: no change lessens what is missed.

What is missed in all, each row relative to its size, has a slope in the controls. It is worked out here from the
problem's own functions, on a path that the solvers do not use. Rows that are just kept hold against it with a share of
their own, from 0 to 1, which the interior point comes to where constraints may be missed at a price; controls at their
limits hold by themselves. Where all of it cancels, the plan is the best near it that can be had.
"""

from dataclasses import dataclass

import numpy as np

from lqrsim.errors import Array
from lqrsim.problem.problem import Problem
from lqrsim.solvers.engine import Workspace

STATIONARY = 5e-3  # slope that may be left, relative to what cancels
AT_LIMIT = 1e-4  # of a control's range, which a barrier may have left, and which could lessen nothing that matters
NAMED = 3  # constraints at most that a message names beside the one that is missed most


@dataclass(frozen=True)
class Evidence:
    """Of a plan about which what is missed is stationary.

    Attributes:
      states: (T+1, n). controls: (T, m). left: the slope that is left, relative to what cancels. missed: in all.
      against: what stands against what is missed, and what else is missed, in words, the strongest first.
    """

    states: Array
    controls: Array
    left: float
    missed: float
    against: tuple[str, ...]

    def beside(self, worst: str) -> str:
        """What a message names beside the constraint that it begins with."""
        return ", ".join([name for name in self.against if not worst.startswith(name.split(" at ")[0])][:NAMED])


def evidence(
    problem: Problem, work: Workspace, states: Array, controls: Array, *, shares: list[Array], sizes: list[Array],
    allowed: float, control_size: Array, state_size: Array,
) -> Evidence | None:  # fmt: skip
    """The evidence that a plan is, or None.

    Args:
      shares: of each constraint (T+1, rows), from -1 to 1. sizes: of each (rows,) by how much its rows change.
      allowed: how much may be missed. control_size, state_size: by how much these change.
    """
    steps, (n, m) = len(controls), (states.shape[1], controls.shape[1])
    slopes, alone, missed = np.zeros((steps + 1, n + m)), np.zeros((steps + 1, n + m)), 0.0
    holding: list[tuple[float, str]] = []
    for k, (term, numbers) in enumerate(
        zip(problem.constraint_terms, work.constraint_values(states, controls), strict=True)
    ):
        short = np.where(np.isfinite(numbers), np.abs(numbers) if term.equality else -numbers, 0.0)
        weights = np.where(short > allowed, 1.0, np.abs(shares[k])) * (np.sign(shares[k]) if term.equality else 1.0)
        weights[np.where(np.isfinite(numbers), numbers, np.inf) > 1e-2 * sizes[k]] *= term.equality
        for t, row in np.argwhere(np.abs(weights) > 1e-6):
            weight = weights[t, row] / sizes[k][row]
            slope = weight * work.constraint_slope(k, int(row), states[t], controls[min(t, steps - 1)], int(t))
            slopes[t] -= slope
            if short[t, row] > allowed:
                alone[t] -= slope
                missed += float(short[t, row] / sizes[k][row])
        for row in range(term.rows):
            beyond = float(short[:, row].max())
            share = 1 + beyond / sizes[k][row] if beyond > allowed else float(np.abs(weights[:, row]).sum())
            if share > 1e-2:
                t = int((short if beyond > allowed else np.abs(weights))[:, row].argmax())
                told = f", missed by {beyond:.2g}" if beyond > allowed else ""
                holding.append((share, f"{term.describe(row)} at {t * problem.dt:.2f} s{told}"))
    if not missed > 0:
        return None
    space = problem.control_coordinates
    low = controls <= space.low + AT_LIMIT * control_size
    high = controls >= space.high - AT_LIMIT * control_size
    total, size, pressed = 0.0, 0.0, np.zeros(m)
    ahead, own = slopes[steps, :n], alone[steps, :n]
    for t in range(steps - 1, -1, -1):
        A, B, _ = problem.dynamics.linearize(states[t], controls[t], problem.dt)
        slope, of_missed = slopes[t, n:] + B.T @ ahead, alone[t, n:] + B.T @ own
        free = ~((low[t] & (slope > 0)) | (high[t] & (slope < 0)))
        total = max(total, float((np.abs(slope) * control_size * free).max()))
        pressed = np.maximum(pressed, np.abs(slope) * control_size * ~free)
        reach = np.linalg.norm(B / state_size[:, None], axis=0) * control_size
        size = max(size, float((np.linalg.norm(ahead * state_size) * reach).max()))
        size = max(
            size,
            float((np.linalg.norm(own * state_size) * reach).max()),
            float((np.abs(of_missed) * control_size).max()),
        )
        ahead, own = slopes[t, :n] + A.T @ ahead, alone[t, :n] + A.T @ own
    left = total / size if size > 0 else 0.0
    if not left <= STATIONARY:
        return None
    names = problem.dynamics.control_coordinates.names
    if size > 0:
        holding += [
            (float(pressed[i]) / size, f"the limits of {names[i]}") for i in range(m) if pressed[i] > 1e-2 * size
        ]
    return Evidence(states, controls, left, missed, tuple(name for _, name in sorted(holding, reverse=True)))

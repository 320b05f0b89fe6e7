"""Whether a plan is what a solver says of it, in plain NumPy: nothing of lqrsim's or the other solvers' is used.

Dynamics, costs and constraints are evaluated anew by `oracle/kkt.py` and `constraints.py`: formulas through
SymPy's `lambdify`, distances from geometry.
"""

from dataclasses import dataclass

import numpy as np
from oracle import constraints, kkt

import lqrsim as ls
from lqrsim.errors import Array

VIOLATION = 1e-6  # what counts as kept: dynamics, start, limits and constraints
COST = 1e-6  # as a share: how closely the cost that is claimed is that of the plan


@dataclass(frozen=True)
class Verified:
    """What was found.

    Attributes:
      cost: of the plan, with the price of a free duration.
      motion: by how much a state is off the step from the one before, at most.
      violation: by how much a constraint, a limit of the controls, a bound of the duration or the given start is
        missed, at most.
      faults: in words, what is not as it must be; empty where all is.
    """

    cost: float
    motion: float
    violation: float
    faults: tuple[str, ...]


def verify(problem: ls.Problem, plan: ls.Trajectory, claimed: float) -> Verified:
    """Recompute a plan that is claimed to keep to all of the problem, and to cost so much."""
    states, controls = plan.states, plan.controls
    n = len(problem.dynamics.state_coordinates)
    m = len(problem.control_coordinates)
    if states.shape != (problem.steps + 1, n) or controls.shape != (problem.steps, m):
        return Verified(np.nan, np.inf, np.inf, ("the plan is of another size",))
    if not (np.isfinite(states).all() and np.isfinite(controls).all()):
        return Verified(np.nan, np.inf, np.inf, ("the plan is not finite",))
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
    return Verified(cost, motion, max(start, limits, missed, late), tuple(faults))


def rolled_out(problem: ls.Problem, controls: Array) -> Array:
    """States (T+1, n) that the controls (T, m) lead to."""
    assert isinstance(problem.initial, ls.FixedState)
    states = [problem.initial.numbers.copy()]
    for control in controls:
        states.append(_step(problem, states[-1], control, problem.dt))
    return np.array(states)


def _step(problem: ls.Problem, states: Array, controls: Array, dt: float) -> Array:
    """Where states (..., n) are a step later under controls (..., m)."""
    written = kkt.quadrotor_rate if problem.dynamics.f is ls.Quadrotor().dynamics.f else None
    return kkt.step(kkt.rate_of(problem, written), states, controls, kkt.numbers_of(problem), dt)

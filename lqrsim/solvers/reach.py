"""Goals that no control comes nearer to: states whose change with every control of a plan is zero.

Such a plan is stationary, but says nothing: a box that nothing touches does not move, whatever the weight of its place.
"""

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.constraints import goals_of
from lqrsim.problem.problem import Problem
from lqrsim.solvers import compiled
from lqrsim.solvers.engine import RunResult
from lqrsim.solvers.multistart import SWAYS, sinusoidal_controls

LEFT = 1e-3  # slope of the final cost, relative to the slope at the end of a given plan, that has died away
MOST_OF = (
    0.1  # part of the cost that a change of a state by its size would save, from which on its goal counts as missed
)
NONE = 1e-9  # change of a state, relative to its size, that counts as none


def unmoved(problem: Problem, states: Array, controls: Array, cost: float, allowed: float) -> list[int]:
    """The states that miss their goal and that no control changes along a plan.

    Args:
      states: (T+1, n), finite. controls: (T, m). cost: of the plan. allowed: tolerance of constraints.
    """
    end, goal, start = states[-1], problem.goal, states[0]
    sizes = np.maximum(np.ptp(states, axis=0), 0.0 if goal is None else np.abs(np.nan_to_num(goal - end)))
    sizes = np.where(sizes > 0, sizes, 1.0)
    missed = np.abs(_final_cost(problem, end, controls[-1])[1]) * sizes > MOST_OF * abs(cost)
    for i, number in goals_of(problem.constraints, problem.dynamics).items():
        missed[i] |= abs(end[i] - number) > allowed
    if not missed.any():
        return []
    space = problem.control_coordinates
    span = np.subtract(space.high, space.low)
    span = np.where(np.isfinite(span), span, np.maximum(np.abs(controls).max(axis=0), 1.0))
    places = np.flatnonzero(missed)
    pull = np.eye(len(start))[places]
    for state, control in zip(states[-2::-1], controls[::-1], strict=True):
        with np.errstate(all="ignore"):
            a, b, _ = problem.dynamics.linearize(state, control, problem.dt)
        still = (np.abs(pull @ b) * span).sum(axis=1) <= NONE * sizes[places]
        places, pull = places[still], (pull @ a)[still]
        if not len(places):
            break
    return places.tolist()


def differ(plan: RunResult | Motion, other: RunResult | Motion, places: list[int]) -> bool:
    """Whether two plans end with different values of these states."""
    return bool((np.abs(plan.states[-1] - other.states[-1])[places] > NONE).any())


def goal_left(problem: Problem, found: RunResult, given: RunResult) -> bool:
    """Whether a plan has gone farther from the goal than a given one, to where the final cost has no slope."""
    value, slope = _final_cost(problem, found.states[-1], found.controls[-1])
    before, steeper = _final_cost(problem, given.states[-1], given.controls[-1])
    return value > before and float(np.abs(slope).max()) < LEFT * float(np.abs(steeper).max())


def _final_cost(problem: Problem, state: Array, control: Array) -> tuple[float, Array]:
    """The final cost and its gradient (n,)."""
    n, joint = len(state), len(state) + len(control)
    hessian, gradient = np.zeros((joint, joint)), np.zeros(joint)
    final = compiled.arguments(problem).final
    module, at = compiled.costs_module(problem), (state.copy(), control.copy(), problem.steps)
    return module.cost_quadratic(*at, final, hessian, gradient), gradient[:n]


def moved_otherwise(problem: Problem, states: Array, places: list[int]) -> bool:
    """Whether other controls would change one of these states: then the plan is on a plateau, and no optimum."""
    if any(problem.dynamics.untouched_body(states, i) for i in places):
        return True
    gain = np.zeros((problem.steps, len(problem.nominal_control), len(states[0])))
    for cycles in SWAYS[:2]:
        other, _ = compiled.rollout(problem, gain, sinusoidal_controls(problem, cycles), states[0].copy())
        if (np.abs(other[-1] - states[-1])[places] > NONE).any():
            return True
    return False


def described(problem: Problem, states: Array, places: list[int]) -> str:
    """In words: which states no control changes, and which bodies nothing touches."""
    names = problem.dynamics.state_coordinates.names
    found = f"no control changes {' or '.join(names[i] for i in places)} along this plan"
    bodies = dict.fromkeys(filter(None, (problem.dynamics.untouched_body(states, i) for i in places)))
    return found + (f": nothing that moves touches {' or '.join(bodies)}" if bodies else "")

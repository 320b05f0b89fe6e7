"""Goals that no control comes nearer to: states whose change with every control of a plan is zero.

Such a plan is stationary, but says nothing: a box that nothing touches does not move, whatever the weight of its place.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.constraints import goals_of
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import QuadraticCost
from lqrsim.solvers import compiled
from lqrsim.solvers.engine import RunResult
from lqrsim.solvers.multistart import FOLLOWED, SWAYS, sinusoidal_controls

LEFT = 1e-3  # slope of the final cost, relative to the slope at the end of a given plan, that has died away
# Part of the cost that a change of a state by its size would save, from which on its goal counts as missed.
MOST_OF = 0.1
NEARER = 0.3  # part of the way to its goal that a body must be taken
LEAST_WAY = 0.1  # least way of a joint, relative to the longest, by which its weight along an approach is scaled
NONE = 1e-9  # change of a state, relative to its size, that counts as none


def unmoved(problem: Problem, states: Array, controls: Array, cost: float, allowed: float) -> list[int]:
    """States that miss their goal, of a constraint by more than `allowed`, and that no control of a plan changes."""
    end, goal, start = states[-1], problem.goal, states[0]
    sizes = np.maximum(np.ptp(states, axis=0), 0.0 if goal is None else np.abs(np.nan_to_num(goal - end)))
    sizes = np.where(sizes > 0, sizes, 1.0)
    missed = np.abs(_final_cost(problem, end)[1]) * sizes > MOST_OF * abs(cost)
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


def goal_left(problem: Problem, result: RunResult, baseline: RunResult) -> bool:
    """Whether a plan has gone farther from the goal than a given one, to where the final cost has no slope."""
    value, slope, _ = _final_cost(problem, result.states[-1])
    before, steeper, _ = _final_cost(problem, baseline.states[-1])
    return value > before and float(np.abs(slope).max()) < LEFT * float(np.abs(steeper).max())


def _final_cost(problem: Problem, state: Array) -> tuple[float, Array, Array]:
    """The final cost, its gradient (n,) and its Hessian (n, n)."""
    n, final = len(state), compiled.compile_problem(problem).final
    no_control = np.zeros(len(problem.nominal_control))
    value, gradient, hessian = compiled.quadratic_at(problem, final, state, no_control, problem.steps)
    return value, gradient[:n], hessian[:n, :n]


def missing(problem: Problem, state: Array, places: list[int]) -> Array:
    """By how much these states of a final state (n,) are short of the goal, (n,); zero for all others."""
    shortfall, (_, slope, curvature) = np.zeros(len(state)), _final_cost(problem, state)
    shortfall[places] = -np.linalg.lstsq(curvature[np.ix_(places, places)], slope[places])[0]
    for i, number in goals_of(problem.constraints, problem.dynamics).items():
        shortfall[i] = number - state[i] if i in places else 0.0
    return shortfall


def comes_nearer(problem: Problem, plan: RunResult | Motion, other: RunResult, places: list[int]) -> bool:
    """Whether these states end nearer to their goal in a plan than in another, by a good part of the way."""
    if not np.isfinite(plan.states[-1]).all():
        return False
    ways = [missing(problem, motion.states[-1], places) for motion in (plan, other)]
    return bool(np.linalg.norm(ways[0]) < (1 - NEARER) * np.linalg.norm(ways[1]))


def approaches(problem: Problem, result: RunResult, places: list[int]) -> Iterator[tuple[str, Problem]]:
    """Problems in which the robot passes through a body that nothing touches, and is drawn along motions that take the
    body to its goal, in words. Their solutions are starts in which the robot touches the body, whose own goals are left
    out of the constraints, as it does not move there.
    """
    constraints = [part for part in problem.constraints if not part.final_states(problem.dynamics)]
    shortfall = missing(problem, result.states[-1], places)
    for words, dynamics, about in problem.dynamics.approaches(result.states, shortfall):
        drawn = ~np.isnan(about)
        ways = np.where(drawn, about, -np.inf).max(axis=0) - np.where(drawn, about, np.inf).min(axis=0)
        ways = np.maximum(ways, LEAST_WAY * ways.max())
        weights = np.where(drawn[0], FOLLOWED * abs(result.cost) / (problem.steps * ways**2), 0.0)
        stage = problem.stage_cost + QuadraticCost(
            drawn[:, :, None] * np.diag(weights), about=np.where(drawn, about, 0.0)
        )
        yield words, replace(problem, dynamics=dynamics, constraints=constraints).with_costs(stage_cost=stage)


def can_change(problem: Problem, states: Array, places: list[int]) -> bool:
    """Whether other controls would change one of these states: then the plan is on a plateau, and no optimum."""
    if any(problem.dynamics.untouched_body(states, i) for i in places):
        return True
    gain = np.zeros((problem.steps, len(problem.nominal_control), len(states[0])))
    for cycles in SWAYS[:2]:
        other, _ = compiled.rollout(problem, gain, sinusoidal_controls(problem, cycles), states[0].copy())
        if (np.abs(other - states)[:, places] > NONE).any():  # at any time, for what sways may come back to the end
            return True
    return False


def described(problem: Problem, states: Array, places: list[int]) -> str:
    """In words: which states no control changes, and which bodies nothing touches."""
    names = problem.dynamics.state_coordinates.names
    text = f"no control changes {' or '.join(names[i] for i in places)} along this plan"
    bodies = dict.fromkeys(filter(None, (problem.dynamics.untouched_body(states, i) for i in places)))
    return text + (f": nothing that moves touches {' or '.join(bodies)}" if bodies else "")

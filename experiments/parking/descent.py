"""Whether there is a cheaper plan beside one that is said to be optimal: steps along linear programs, checked.

What is found is a plan: it moves by the dynamics, misses nothing by more than the given one, and costs less. Where none
is found, that is no proof.
"""

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

from parking import judge
from parking.task import Task

Array = np.ndarray

REACH, TRIES = 0.01, 12  # how far the first step changes controls, of the largest ones; how many steps are tried
SPACE = 2 * judge.INEQUALITY  # what is nearer than this to being missed may not come nearer: solvers leave some space
CORRECTIONS = 4
DIFFERENCE = 1e-6


def saved(task: Task, controls: Array) -> float:
    """The share of the cost that a few steps save; 0 where none was found."""
    first = float(judge.cost(task, judge.rollout(task, task.start, controls, task.dt), controls))
    keep = np.minimum(_numbers(task, controls)[0], SPACE)
    reach = REACH
    for _ in range(TRIES):
        better = _step(task, controls, keep, reach)
        reach *= 0.3 if better is None else 1.5
        controls = controls if better is None else better
    last = float(judge.cost(task, judge.rollout(task, task.start, controls, task.dt), controls))
    return max(0.0, first - last) / max(first, 1e-12)


def _numbers(task: Task, controls: Array) -> tuple[Array, Array, Array]:
    """Inequalities, how far the last state is from an exact goal, and the cost, of controls (..., T, 2)."""
    states = judge.rollout(task, task.start, controls, task.dt)
    goal = states[..., -1, :] - task.goal if task.exact else states[..., -1, :0]
    return judge.inequalities(task, states), goal, judge.cost(task, states, controls)


def _step(task: Task, controls: Array, keep: Array, reach: float) -> Array | None:
    """The controls of a cheaper plan within reach; None if there is none along the linear program."""
    kept, ends, cost = _numbers(task, controls)
    moves = DIFFERENCE * np.eye(controls.size).reshape(-1, *controls.shape)
    ahead, behind = _numbers(task, controls + moves), _numbers(task, controls - moves)
    slopes, of_ends, of_cost = ((a - b).T / (2 * DIFFERENCE) for a, b in zip(ahead, behind, strict=True))
    most = np.broadcast_to(reach * task.top, controls.shape).ravel()
    low = np.maximum(-most, (-task.top - controls).ravel())
    high = np.minimum(most, (task.top - controls).ravel())
    near = kept - np.abs(slopes) @ most < keep + SPACE
    right, rest = kept - keep, np.zeros_like(ends)
    for _ in range(CORRECTIONS):
        found = linprog(
            of_cost, A_ub=csr_array(-slopes[near]), b_ub=right[near], A_eq=of_ends if task.exact else None,
            b_eq=rest if task.exact else None, bounds=np.stack([low, np.maximum(low, high)], axis=1),
        )  # fmt: skip
        if found.status != 0:
            return None
        tried = np.clip(controls + found.x.reshape(controls.shape), -task.top, task.top)
        now, end, costs = _numbers(task, tried)
        off = np.abs(end - ends).max(initial=0.0)
        if (now - keep).min() >= -1e-7 and off <= 1e-8 and costs < cost:
            return tried
        # What the linear program does not see of the step, it is told of.
        right, rest = now - keep - slopes @ found.x, ends - end + of_ends @ found.x
    return None

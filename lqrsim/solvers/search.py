"""Which optimum: where `smooth` starts if nobody says where, and which of several starts it goes on with.

A continuation draws the first iteration along a smooth path from start to goal, blind to obstacles, and lets the
obstacles come in by and by; it ends in a good optimum far more often than a start from the nominal control does. Other
paths, bent to the sides, lead to other optima. Which start is best shows after a few iterations, long before it ends.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from lqrsim.checks import functions_of
from lqrsim.errors import Array, InputError
from lqrsim.problem import Problem
from lqrsim.solvers.attempt import Attempt
from lqrsim.solvers.common import workers
from lqrsim.solvers.start import InitialPrior

# `python experiments/benchmark_quality.py --sections ingredients` shows what each of these choices brings.
STARTS = 7
SHARES = (0.0, 0.1, 0.4, 0.7)  # of the obstacle costs, in the first iterations
PULL = 0.1  # of the path, relative to the curvature of an obstacle's cost where it is touched
RING, STEP, WIDEST = 0.3, 0.2, 0.6  # how far paths bend, relative to the distance from start to goal
HALVE, CHOOSE = 3, 4  # the iterations after which half of the starts are left, and one


def guides(problem: Problem, count: int | None) -> list[tuple[str, InitialPrior | None]]:
    """What to start from, each with what to call it: paths to the goal, the straight one first.

    Problems without obstacles, or without a position to start from and one to go to, have nothing to go round: there
    is one start, the nominal control.

    Args:
      count: how many; by default `STARTS` where there are obstacles.
    """
    pull = _pull(problem)
    if pull == 0 or problem.start is None or problem.goal is None:
        return [("nominal control", None)]
    position = list(problem.dynamics.state_coordinates.position)
    ends = problem.start[position], problem.goal[position]
    weight = np.zeros(len(problem.start))
    weight[position] = pull
    found = []
    for name, bend in bends(ends[1] - ends[0], STARTS if count is None else count):
        about = np.zeros((problem.steps + 1, len(weight)))
        about[:, position] = path(*ends, bend, problem.steps)
        found.append((name, InitialPrior(weight, about=about, obstacles=SHARES)))
    return found


def check_starts(problem: Problem, count: int | None) -> None:
    """Raises InputError if more than one start is asked for where there is nothing to go round."""
    if count is not None and count > 1 and _pull(problem) == 0:
        raise InputError(
            f"starts: got {count}, want 1 without an ObstacleCost, a start and a goal some way apart: there is nothing"
            " to go round; or give a start"
        )


def _pull(problem: Problem) -> float:
    """The weight of the paths; 0 where there is nothing to go round."""
    position = list(problem.dynamics.state_coordinates.position)
    if not position or problem.start is None or problem.goal is None:
        return 0.0
    if np.array_equal(problem.start[position], problem.goal[position]):
        return 0.0
    costs = [cost for cost in problem.obstacle_costs if len(cost.world)]
    return max((PULL * cost.weight * cost.sharpness**2 for cost in costs), default=0.0)


def bends(way: Array, count: int) -> list[tuple[str, Array]]:
    """How far the middle of each path is from that of the straight one, and a name: none, then to the sides.

    In space the others are a ring about the straight one, in the plane pairs to the left and the right.
    """
    distance = float(np.linalg.norm(way))
    straight: list[tuple[str, Array]] = [("straight", np.zeros(len(way)))]
    if count == 1:
        return straight
    ahead, others = way / distance, count - 1
    if len(way) == 2:
        left, step = np.array([-ahead[1], ahead[0]]), min(STEP, WIDEST / ((others + 1) // 2))
        sides = [((i // 2 + 1) * step, i % 2) for i in range(others)]
        return straight + [
            (f"{far * distance:.3g} m to the {('left', 'right')[side]}", far * distance * (1 - 2 * side) * left)
            for far, side in sides
        ]
    across = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    across /= np.linalg.norm(across)
    upright = np.cross(ahead, across)
    angles = 2 * np.pi * np.arange(others) / others
    return straight + [
        (
            f"{RING * distance:.3g} m aside at {np.degrees(angle):.0f} degrees",
            RING * distance * (np.cos(angle) * across + np.sin(angle) * upright),
        )
        for angle in angles
    ]


def path(start: Array, goal: Array, bend: Array, steps: int) -> Array:
    """Positions (T+1, 2 or 3): from rest to rest with the least jerk, and aside by a sine."""
    time = np.linspace(0, 1, steps + 1)[:, None]
    way = time**3 * (10 - 15 * time + 6 * time**2)
    return start + way * (goal - start) + np.sin(np.pi * way) * bend


def choose(attempts: Sequence[Attempt], advance: Callable[..., None], threads: int) -> list[Attempt]:
    """Run the attempts a few iterations, the worse ones fewer, and return them with the most promising first.

    What they are judged by is the true cost of the plan that each has so far.

    Args:
      advance: `advance(attempt, last=...)` runs one up to so many iterations. threads: how many at once.
    """
    left, dropped = list(attempts), []
    for last, keep in ((HALVE, max(len(left) // 2, 1)), (CHOOSE, 1)):
        if len(left) > 1:
            if threads > 1:
                with workers(threads, functions_of(left[0].problem)) as pool:
                    list(pool.map(partial(advance, last=last), left))
            else:
                for attempt in left:
                    advance(attempt, last=last)
            left.sort(key=lambda attempt: attempt.cost)  # a stable sort: of equals, the first
            left, dropped = left[:keep], left[keep:] + dropped
    return left + dropped

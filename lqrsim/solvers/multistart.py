"""The starts that `smooth` tries if the caller gives none, and the choice among them.

A homotopy draws the first iteration along a smooth path from start to goal, without obstacles, and then raises the
obstacles' cost to its full weight. This ends in a good optimum far more often than a start from the nominal control.
Other paths, bent to the sides, lead to other optima. After a few iterations it becomes clear which start is best.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.kernels.records import Motion
from lqrsim.problem.costs import CostSum, terms_of, weighing_obstacles
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.engine import SolveRun
from lqrsim.solvers.initial_guess import InitialPrior
from lqrsim.solvers.parallel import workers

# `python experiments/benchmark_quality.py --sections ingredients` shows the gain from each of these choices.
STARTS = 7
DETOURS = 3  # number of starts for passing a constraint on another side
OBSTACLES = (0.0, 0.1, 0.4, 0.7)  # fractions of the obstacle costs in the first iterations
PATH_WEIGHT = 0.1  # weight of the path, relative to the curvature of an obstacle's cost at contact
RING, STEP, WIDEST = 0.3, 0.2, 0.6  # sideways bend of the paths, relative to the distance from start to goal
FOLD = 0.9  # bend for states that move collision spheres: an arm must fold up before it passes an obstacle
# States that contacts hold, such as the tilt of a robot on a floor, are drawn to their start. HOLD is the weight,
# relative to the path's, for a state that moves by 1. LEAST is the least range, relative to the largest of the unit: of
# angles that is the angle by which wheels turn, 170 rad in half a minute.
HOLD, LEAST = 0.01, 1e-4
# Constant controls that are tried where the nominal ones lead out of the domain: fractions of the range between the
# limits; where there is no limit, of this many units about the nominal control.
LEVELS, UNLIMITED = (0.0, 0.25, 0.5, 0.75, 1.0), (1.0, 10.0, 100.0)
# Pushes: fractions of the way from the nominal control to a limit, and of the time.
PUSHED, PARTS = (0.03, 0.1, 0.3, 1.0), (0.2, 0.5, 1.0)
HALVE, CHOOSE = 3, 4  # numbers of iterations after which half of the starts remain, and one start
# Trajectories along paths, tried while no plan keeps the constraints: their number, the weight of the path relative to
# a plan's cost, and the number of iterations in which the path acts.
MOTIONS, FOLLOWED, FOLLOW = 5, 100.0, 8
# For robots at rest on which no single control has an effect, as for a swimmer: numbers of cycles of oscillating
# controls along the plan, and their amplitude relative to the distance from the limits.
SWAYS, SWAY = (1, 2, 4, 8), 0.3


def sinusoidal_name(cycles: int) -> str:
    """The name of `sinusoidal_controls` as a start."""
    periods = f"{abs(cycles)} period{'s' if abs(cycles) > 1 else ''}"
    return f"sinusoidal controls of {periods}{', mirrored' if cycles < 0 else ''}"


def guides(problem: Problem, count: int | None) -> list[tuple[str, InitialPrior | None]]:
    """The starts of a search, by default `STARTS`, and their names: paths to the goal, the straight path first.

    A problem without obstacles, or without a start and a goal, has one start, the nominal control. The paths are paths
    of the position. For a robot of collision spheres without a position, they are paths of the states that move the
    spheres, such as the angles of an arm. The other states of a robot that stands on contacts are also drawn to a
    straight line.
    """
    weight_of_path = path_weight(problem)
    if weight_of_path == 0 or problem.start is None or problem.goal is None:
        return [("nominal control", None)]
    moving = _moving(problem)
    ends = problem.start[moving], problem.goal[moving]
    holding = bool(problem.dynamics.state_coordinates.position) and _stands(problem)
    weight = weight_of_path * _holding(problem) if holding else np.zeros(len(problem.start))
    weight[moving] = weight_of_path
    between = np.where(weight > 0, np.linspace(problem.start, problem.goal, problem.steps + 1), 0.0)
    starts, unit = [], problem.dynamics.state_coordinates.units[moving[0]]
    ring = RING if problem.dynamics.state_coordinates.position else FOLD
    for name, bend in bends(ends[1] - ends[0], STARTS if count is None else count, ring=ring, unit=unit):
        about = between.copy()
        about[:, moving] = path(*ends, bend, problem.steps)
        prior = InitialPrior(weight, about=about, iterations=CHOOSE if holding else 1, obstacles=OBSTACLES)
        starts.append((name, prior))
    return starts


def _stands(problem: Problem) -> bool:
    """Whether contacts act at the start, or a control period later, when a robot on the floor has settled."""
    assert problem.start is not None
    later = problem.dynamics.step(problem.start, problem.nominal_control, problem.dt)
    return problem.dynamics.touches(np.array([problem.start, later]))


def _holding(problem: Problem) -> Array:
    """Weights (n,) of all states, relative to the path's: larger for states that oscillating controls move less.

    Derivatives at rest say how controls tilt a robot, but not that the floor ends the tilt after a millimetre. About
    states of least total cost in which it is tilted, or above the floor, wheels drive nothing.
    """
    dynamics, start, ranges = problem.dynamics, problem.start, np.zeros(len(problem.dynamics.state_coordinates))
    assert start is not None
    for cycles in SWAYS:
        state = start
        for control in sinusoidal_controls(problem, cycles):
            state = dynamics.step(state, control, problem.dt)
            if not np.isfinite(state).all():
                break
            ranges = np.maximum(ranges, np.abs(state - start))
    units = np.array(dynamics.state_coordinates.units)
    largest = np.array([ranges[units == unit].max() for unit in units])
    ranges = np.maximum(ranges, LEAST * largest)
    return np.divide(HOLD, ranges**2, out=np.zeros_like(ranges), where=ranges > 0)


def detours(problem: Problem, count: int | None = None) -> dict[str, Trajectory]:
    """Paths to the goal that bend to the sides, by name; none without a position, or if the goal is at the start.

    The number of starts, by default `DETOURS`, includes the straight path, which is not returned.
    """
    place, begin, goal = list(problem.dynamics.state_coordinates.position), problem.start, problem.goal
    if not place or begin is None or goal is None or np.array_equal(begin[place], goal[place]):
        return {}
    trajectories = {}
    for name, bend in bends((goal - begin)[place], DETOURS if count is None else count)[1:]:
        states = path(begin, goal, np.zeros(len(begin)), problem.steps)
        states[:, place] = path(begin[place], goal[place], bend, problem.steps)
        controls = np.tile(problem.nominal_control, (problem.steps, 1))
        trajectories[f"a path {name}"] = Trajectory(states, controls, problem.dt)
    return trajectories


def along_paths(problem: Problem, moving: Sequence[int], cost: float) -> dict[str, InitialPrior]:
    """Starts whose first iterations follow paths of some states from start to goal, by name; none without such ends.

    After smoothing they are feasible motions on one side of an obstacle or the other; a path alone is not feasible. The
    cost is typical of a plan.
    """
    begin, goal, place = problem.start, problem.goal, list(moving)
    if not place or begin is None or goal is None or np.array_equal(begin[place], goal[place]):
        return {}
    priors, unit, space = {}, problem.dynamics.state_coordinates.units[place[0]], problem.dynamics.state_coordinates
    distance = float(np.linalg.norm((goal - begin)[place]))
    ring, count = (RING, MOTIONS) if space.position else (FOLD, STARTS)
    for name, bend in bends((goal - begin)[place], count, ring=ring, unit=unit):
        about, weight = np.tile(begin, (problem.steps + 1, 1)), np.zeros(len(begin))
        about[:, place] = path(begin[place], goal[place], bend, problem.steps)
        weight[place] = FOLLOWED * cost / (problem.steps * max(STEP * distance, float(np.linalg.norm(bend))) ** 2)
        priors[f"a motion along a path {name}"] = InitialPrior(weight, about=about, iterations=FOLLOW)
    return priors


def passable(problem: Problem) -> list[bool]:
    """Whether a robot may pass each constraint on one side or another: whether it is an inequality of states."""
    return [
        not (term.equality or term.final_only or term.uses_control or term.convex) for term in problem.constraint_terms
    ]


def reweighted(problem: Problem, times: float) -> Problem:
    """The problem with larger weights of obstacles and goal: plans then go round and arrive at any price of controls.

    Only numbers change, so nothing is compiled. The constraints do not act in its solves.
    """
    stage, final = (weighing_obstacles(cost, times) for cost in (problem.stage_cost, problem.final_cost))
    heavier = (term if term.state_reference is None else term.times(times) for term in final.terms)
    return problem.with_costs(stage_cost=stage, final_cost=CostSum(tuple(heavier)))


def sinusoidal_controls(problem: Problem, cycles: int) -> Array:
    """Controls (T, m) that oscillate about the nominal ones, with a phase shift from each to the next.

    If the number of cycles along the plan is negative, they begin the other way.
    """
    (low, high), nominal = problem.applied_coordinates.limits, problem.nominal_control
    margin = np.minimum(high - nominal, nominal - low)
    amplitude = SWAY * np.where(np.isfinite(margin), np.maximum(margin, 0.0), 1.0)
    times = np.arange(problem.steps)[:, None] / problem.steps
    phases = abs(cycles) * times - np.arange(len(nominal)) / 4
    return nominal + amplitude * np.sign(cycles) * np.sin(2 * np.pi * phases)


def constant_controls(problem: Problem) -> Iterator[tuple[Array, Motion]]:
    """Constant controls (m,) under which all states from a start are finite, and the plans that they make."""
    space, nominal, start = problem.control_coordinates, problem.nominal_control, problem.start
    assert start is not None
    m, steps = len(nominal), problem.steps
    levels = LEVELS if m < 3 else LEVELS[::2]
    combinations = itertools.product(levels, repeat=m) if m < 5 else zip(*[levels] * m, strict=True)
    limited = np.isfinite([space.low, space.high]).all()
    for level, half_range in itertools.product(combinations, (1.0,) if limited else UNLIMITED):
        low = np.where(np.isfinite(space.low), space.low, nominal - half_range)
        high = np.where(np.isfinite(space.high), space.high, nominal + half_range)
        control = low + np.array(level) * (high - low)
        plan = compiled.rollout(problem, np.zeros((steps, m, len(start))), np.tile(control, (steps, 1)), start.copy())
        if np.isfinite(plan.states).all():
            yield control, plan


def pushes(problem: Problem) -> Iterator[tuple[str, Array, Motion]]:
    """Plans in which one control at a time leaves its nominal value for a part of the time; none without a start."""
    space, start, steps = problem.applied_coordinates, problem.start, problem.steps
    if start is None:
        return
    low, high = space.limits
    nominal = np.broadcast_to(problem.nominal_controls, (steps, len(low)))
    gain = np.zeros((steps, len(low), len(start)))
    for i, side, fraction, duration in itertools.product(range(len(low)), (high, low), PUSHED, PARTS):
        change = fraction * np.where(np.isfinite(side[i]), side[i] - nominal[:, i], 1.0 if side is high else -1.0)
        controls = nominal.copy()
        controls[:, i] += np.where(np.arange(steps) < duration * steps, change, 0.0)
        if change.any():
            plan = compiled.rollout(problem, gain, controls, start.copy())
            if np.isfinite(plan.states).all():
                yield f"a push by {space.names[i]}", controls, plan


def check_starts(problem: Problem, count: int | None) -> None:
    """Raises InputError if more than one start is requested although there is nothing to go round."""
    several = count is not None and count > 1
    if several and path_weight(problem) == 0 and not (any(passable(problem)) and detours(problem)):
        raise InputError(
            f"starts: got {count}, want 1: there is nothing to go round. More starts need a start and a goal apart from"
            " each other, and an ObstacleCost or a constraint on states between them"
        )


def path_weight(problem: Problem) -> float:
    """The weight of the path in the first iteration; 0 if there is nothing to go round."""
    moving = _moving(problem)
    start, goal = problem.start, problem.goal
    if not moving or start is None or goal is None or np.array_equal(start[moving], goal[moving]):
        return 0.0
    costs = [cost for cost in problem.obstacle_costs if len(cost.kept_clear.world)]
    return max((PATH_WEIGHT * cost.contact_curvature for cost in costs), default=0.0)


def _moving(problem: Problem) -> list[int]:
    """Indices of the states that place the robot: its position, or else the states that move its collision spheres."""
    position = list(problem.dynamics.state_coordinates.position)
    if position:
        return position
    pairs = zip(terms_of(problem.stage_cost), problem.terms("stage_cost"), strict=True)
    return sorted({i for cost, term in pairs if cost.kept_clear is not None for i in term.nonconvex_in or ()})


def bends(way: Array, count: int, *, ring: float = RING, unit: str = "m") -> list[tuple[str, Array]]:
    """Offsets of the middle of each path from the straight path, with names: first none, then to the sides.

    In space the other paths form a ring about the straight path; in the plane, pairs to the left and the right; in more
    dimensions, pairs along directions orthogonal to the straight path and to each other. `ring` is the bend in more
    than two dimensions, relative to the way (k,) from start to goal, whose unit the names tell.
    """
    distance = float(np.linalg.norm(way))
    straight: list[tuple[str, Array]] = [("straight", np.zeros(len(way)))]
    if count == 1 or len(way) == 1:
        return straight
    forward, others = way / distance, count - 1
    if len(way) == 2:
        left, step = np.array([-forward[1], forward[0]]), min(STEP, WIDEST / ((others + 1) // 2))
        sides = [((i // 2 + 1) * step, i % 2) for i in range(others)]
        return straight + [
            (f"{bend * distance:.3g} {unit} to the {('left', 'right')[side]}", bend * distance * (1 - 2 * side) * left)
            for bend, side in sides
        ]
    if len(way) > 3:
        axes = np.eye(len(way))[:, np.argsort(np.abs(forward))[:-1]]
        sideways, bend = np.linalg.qr(np.column_stack([forward, axes]))[0][:, 1:], ring * distance
        named = [
            (f"{bend:.3g} {unit} aside, direction {sign}{side + 1}", factor * bend * sideways[:, side])
            for side in range(len(way) - 1)
            for sign, factor in (("", 1), ("-", -1))
        ]
        return straight + named[:others]
    across = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    across /= np.linalg.norm(across)
    upright = np.cross(forward, across)
    angles = 2 * np.pi * np.arange(others) / others
    return straight + [
        (
            f"{ring * distance:.3g} {unit} aside at {np.degrees(angle):.0f} degrees",
            ring * distance * (np.cos(angle) * across + np.sin(angle) * upright),
        )
        for angle in angles
    ]


def path(start: Array, goal: Array, bend: Array, steps: int) -> Array:
    """Places, or states, (T+1, n): from rest to rest with minimum jerk, displaced sideways by a sine."""
    time = np.linspace(0, 1, steps + 1)[:, None]
    way = time**3 * (10 - 15 * time + 6 * time**2)
    return start + way * (goal - start) + np.sin(np.pi * way) * bend


def choose(runs: Sequence[SolveRun], threads: int) -> list[SolveRun]:
    """Run each start for a few iterations, the worse half for fewer; return the runs, the least true cost first."""
    left, dropped = list(runs), []
    for last, keep in ((HALVE, max(len(left) // 2, 1)), (CHOOSE, 1)):
        if len(left) > 1:
            if threads > 1:
                with workers(threads, functions_of(left[0].problem)) as pool:
                    list(pool.map(lambda run, last=last: run.smooth(last), left))
            else:
                for run in left:
                    run.smooth(last)
            left.sort(key=lambda run: run.cost)  # a stable sort: of equal costs, the first run
            left, dropped = left[:keep], left[keep:] + dropped
    return left + dropped

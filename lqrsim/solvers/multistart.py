"""The starts that `smooth` tries if the caller gives none, and the choice among them.

A homotopy draws the first iteration along a smooth path from start to goal, without obstacles, and then raises the
obstacles' cost to its full weight. This ends in a good optimum far more often than a start from the nominal control.
Other paths, bent to the sides, lead to other optima. After a few iterations it becomes clear which start is best.

The interior point can also begin with a `Way`, a path of states that no control need follow. The rollout of the nominal
controls is near no plan if the robot must right itself, turn round, or leave a trap. A path of states may be: the
straight line, also with a whole turn more or less of an angle, and shortest paths of the position round the obstacles,
forwards and backwards.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.parts import CostSum, terms_of, weighing_obstacles
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import workers
from lqrsim.solvers.engine import SolveRun
from lqrsim.solvers.settings import InitialPrior
from lqrsim.solvers.stages import Stages

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

# Ways.
CELLS = {2: 100, 3: 36}  # of the grid, along its longest side, in the plane and in space
AROUND = 0.3  # margin of the grid where states have no bounds, relative to the extent of start, goal and obstacles
NEAR = 3  # cells round start and goal that count as free, because a robot may begin or end beside a wall
TURNS = 8  # headings with which a robot that turns must fit into a cell
ROUTES = 3  # shortest paths with room to turn, and with less, each of which avoids the paths before
BESIDE, AVOIDED = 0.1, 4.0  # cells this near to an earlier path, relative to the way, count this much longer
DENSE = 200  # points at which paths are compared
ROUND = 20  # a path's corners are rounded over this part of the steps
TURNED = 0.7  # rad by which all angles are turned, to see whether the motion turns with them
SAME = 1e-6  # relative difference of two motions that are the same but for rounding
SIDEWAYS = 0.05  # sideways part of the motion of a robot that drives along its heading
LARGE, AXES = np.pi / 2, 4  # rad, turn of a rotation vector from which on other axes are tried, and their number
RATE = 0.1  # relative error of the derivative of a state that still counts as another state
SHORT = 1e-3  # of a control period, over which derivatives are taken


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
    moving, dynamics = _moving(problem), problem.dynamics
    ends = problem.start[moving], problem.goal[moving]
    if holding := bool(dynamics.state_coordinates.position):
        # Contacts may act at the start, or a control period later, when a robot on the floor has settled.
        later = dynamics.step(problem.start, problem.nominal_control, problem.dt)
        holding = dynamics.touches(np.array([problem.start, later]))
    weight = weight_of_path * _holding(problem) if holding else np.zeros(len(problem.start))
    weight[moving] = weight_of_path
    between = np.where(weight > 0, np.linspace(problem.start, problem.goal, problem.steps + 1), 0.0)
    starts, unit = [], dynamics.state_coordinates.units[moving[0]]
    ring = RING if dynamics.state_coordinates.position else FOLD
    for name, bend in bends(ends[1] - ends[0], STARTS if count is None else count, ring=ring, unit=unit):
        about = between.copy()
        about[:, moving] = path(*ends, bend, problem.steps)
        prior = InitialPrior(weight, about=about, iterations=CHOOSE if holding else 1, obstacles=OBSTACLES)
        starts.append((name, prior))
    return starts


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


def reweighted(problem: Problem, factor: float) -> Problem:
    """The problem with larger weights of obstacles and goal: plans then go round and arrive at any price of controls.

    Only numbers change, so nothing is compiled. The constraints do not act in its solves.
    """
    stage, final = (weighing_obstacles(cost, factor) for cost in (problem.stage_cost, problem.final_cost))
    heavier = CostSum(term if term.state_reference is None else term.scaled(factor) for term in final.terms)
    return problem.with_costs(stage_cost=stage, final_cost=heavier)


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


class Way(NamedTuple):
    """A way from start to goal: its name, and states (T+1, n), of which rates are not yet known."""

    name: str
    states: Array

    def over(self, problem: Problem) -> Trajectory:
        """The way in the time of a problem, with rates by differences and the nominal controls."""
        states, dt = self.states.copy(), problem.dt
        for i, rate in _rates(problem):
            states[1:-1, rate] = (states[2:, i] - states[:-2, i]) / (2 * dt)
        controls = np.broadcast_to(problem.nominal_controls, (problem.steps, len(problem.control_coordinates)))
        return Trajectory(states, controls.copy(), dt)


class Headings(NamedTuple):
    """The angles of a robot that drives along its heading, and the direction in which it drives where they are 0."""

    angles: list[int]
    ahead: float


def ways(problem: Problem, stages: Stages) -> Iterator[Way]:
    """Ways from start to goal in a fixed duration, the straight line first; none without two different ends."""
    start, goal, space = problem.start, problem.weighed_goal, problem.dynamics.state_coordinates
    if start is None or goal is None:
        return
    goal = np.where(np.isnan(goal), start, goal)
    if np.array_equal(start, goal):
        return
    yield Way("a line of states", line := np.linspace(start, goal, problem.steps + 1))
    share = np.linspace(0, 1, problem.steps + 1)[:, None]
    headings = _headings(problem)
    turned = {name: share * turns for name, turns in _whole_turns(problem, headings, goal)}
    paths = _paths(problem, stages, headings, start, goal) if len(space.position) in CELLS else ()
    for route, (path, backwards) in enumerate(paths, start=1):
        name, states = f"path {route} round obstacles", line.copy()
        states[:, list(space.position)] = drawn = _drawn(path, problem.steps)
        if not headings.angles:
            yield Way(name, states)
            yield from (Way(f"{name}, {which}", states + turns) for which, turns in turned.items())
            continue
        east, north = np.gradient(drawn, axis=0)[1:].T
        angle = np.arctan2(north, east) - headings.ahead + (np.pi if backwards else 0.0)
        for i in headings.angles:
            states[:, i] = np.unwrap(np.append(start[i], angle))
        yield Way(f"{name}, {'backwards' if backwards else 'forwards'}", states)
    yield from (Way(f"a line of states, {which}", line + turns) for which, turns in turned.items())
    yield from _other_axes(problem, line)


def _whole_turns(problem: Problem, headings: Headings, goal: Array) -> Iterator[tuple[str, Array]]:
    """A turn more and less of each angle whose goal is any whole turn, and of all of them: names, and turns (n,).

    Headings turn together.
    """
    dynamics, names = problem.dynamics, problem.dynamics.state_coordinates.names
    free = sorted({i for constraint in problem.constraints for i in constraint._turning_states(dynamics)})
    bounds = [constraint.state_bounds(dynamics) for constraint in problem.constraints]
    groups = [free] if headings.angles else [*([i] for i in free), *([free] if len(free) > 1 else [])]
    for group, (word, turn) in itertools.product(groups, (("more", 2 * np.pi), ("less", -2 * np.pi))):
        turns = np.zeros(len(goal))
        turns[group] = turn
        sides = [(goal[i] + turn, *limits[i]) for limits in bounds for i in group if i in limits]
        if group and all(np.min(low) <= at <= np.max(high) for at, low, high in sides):
            yield f"a turn {word} of {' and '.join(names[i] for i in group)}", turns


def _other_axes(problem: Problem, line: Array) -> Iterator[Way]:
    """Lines of states along which a large turn of a rotation vector also leads about other axes."""
    names, share = problem.dynamics.state_coordinates.names, np.linspace(0, np.pi, len(line))[:, None]
    for first in problem.dynamics.state_coordinates.rotation_vectors:
        turn = (line[-1] - line[0])[first : first + 3]
        if np.linalg.norm(turn) > LARGE:
            for name, bend in bends(turn, 1 + AXES, ring=0.5, unit="rad")[1:]:
                states = line.copy()
                states[:, first : first + 3] += np.sin(share) * bend
                yield Way(f"a line of states, {names[first]} {name}", states)


def _rates(problem: Problem) -> list[tuple[int, int]]:
    """States and the states that are their rates, at the start or at the goal."""
    dynamics, pairs = problem.dynamics, set[tuple[int, int]]()
    h = problem.dt if dynamics.discrete else SHORT * problem.dt
    units = dynamics.state_coordinates.units
    for state in (problem.start, problem.goal):
        if state is None:
            continue
        slopes = (dynamics.linearize(state, problem.nominal_control, h)[0] - np.eye(len(state))) / h
        for i, j in np.argwhere(np.abs(slopes - 1) < RATE).tolist():
            if i != j and units[j] == (f"{units[i]}/s" if units[i] else ""):
                pairs.add((i, j))
    return sorted(pairs)


def _headings(problem: Problem) -> Headings:
    """The headings of a planar robot whose motion turns with its angles; none if it can move sideways, or falls."""
    dynamics, draws = problem.dynamics, np.random.default_rng(0)
    space, controls, start = dynamics.state_coordinates, problem.control_coordinates, problem.start
    angles, place = list(space.angles), list(space.position)
    if not angles or start is None or len(place) != 2:
        return Headings([], 0.0)
    h = problem.dt if dynamics.discrete else SHORT * problem.dt
    low, high = (np.clip(side, -1.0, 1.0) for side in (controls.low, controls.high))
    c, s = np.cos(TURNED), np.sin(TURNED)
    directions = []
    for _ in range(4):
        state, control = start + draws.uniform(-1, 1, len(start)), draws.uniform(low, high)
        state[place], state[angles] = start[place], 0.0
        turned = state.copy()
        turned[angles] += TURNED
        motion, turned_motion = (dynamics.step(begin, control, h) - begin for begin in (state, turned))
        motion[place] = c * motion[place[0]] - s * motion[place[1]], s * motion[place[0]] + c * motion[place[1]]
        if not np.abs(motion - turned_motion).max() <= SAME * np.abs(motion).max():
            return Headings([], 0.0)
        directions.append(turned_motion[place])
    _, sizes, axes = np.linalg.svd(np.array(directions))
    if not sizes[1] <= SIDEWAYS * sizes[0]:
        return Headings([], 0.0)
    east, north = axes[0] if np.sum(directions @ axes[0]) >= 0 else -axes[0]  # forwards is where it is faster
    return Headings(angles, float(np.arctan2(north, east) - TURNED))


class Grid:
    """Cells of the space of the position, of a size in m, with centres `points` (N, 2 or 3)."""

    def __init__(self, low: Array, high: Array, cell: float) -> None:
        axes = [a + cell * np.arange(1 + int(np.ceil((b - a) / cell))) for a, b in zip(low, high, strict=True)]
        self.cell, self.shape = cell, tuple(len(axis) for axis in axes)
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(low))

    def nearest(self, places: Array) -> tuple[npt.NDArray[np.int64], ...]:
        """The indices along each axis of the cells nearest to places (K, 2 or 3)."""
        last = np.array(self.shape) - 1
        return tuple(np.clip(np.rint((places - self.points[0]) / self.cell), 0, last).astype(int).T)

    def shortest(self, begin: Array, end: Array, free: "Fits", length: Array) -> Array | None:
        """The shortest path between two places, as the cells' centres (K, 2 or 3); None if there is none.

        The way through each cell counts longer by its factor in `length`, (N,).
        """
        index, length = np.arange(len(self.points)).reshape(self.shape), length.reshape(self.shape)
        rows, columns, weights = [], [], []
        for move in itertools.product((-1, 0, 1), repeat=len(self.shape)):
            if not any(move):
                continue
            cells_here = tuple(slice(max(-m, 0), n - max(m, 0)) for m, n in zip(move, self.shape, strict=True))
            neighbour = tuple(slice(max(m, 0), n - max(-m, 0)) for m, n in zip(move, self.shape, strict=True))
            fits = free.along(np.array(move)).reshape(self.shape)
            both = fits[cells_here] & fits[neighbour]
            rows.append(index[cells_here][both])
            columns.append(index[neighbour][both])
            weights.append(np.linalg.norm(move) * (length[cells_here][both] + length[neighbour][both]) / 2)
        graph = coo_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (index.size,) * 2)
        first, last = index[self.nearest(np.array([begin, end]))].tolist()
        distances, before = dijkstra(graph.tocsr(), indices=first, return_predecessors=True)
        if not np.isfinite(distances[last]):
            return None
        cells = [last]
        while cells[-1] != first:
            cells.append(int(before[cells[-1]]))
        return self.points[cells[::-1]]

    def cut(self, points: Array, free: "Fits") -> Array:
        """A path without the corners that can be cut."""
        corners, i = [0], 0
        while i < len(points) - 1:
            j = len(points) - 1
            while j > i + 1 and not self._clear(points[i], points[j], free):
                j -= 1
            corners.append(i := j)
        return points[corners]

    def _clear(self, begin: Array, end: Array, free: "Fits") -> bool:
        between = np.linspace(begin, end, 2 + int(2 * np.linalg.norm(end - begin) / self.cell))
        return bool(free.along(end - begin).reshape(self.shape)[self.nearest(between)].all())


class Fits(NamedTuple):
    """The cells into which a robot fits."""

    each: npt.NDArray[np.bool_]  # (A, N) with each attitude
    # Whether the attitudes are headings, one after another from that of the first axis on, and the robot has that of
    # its motion, or `backwards` the opposite; else it may have any.
    turns: bool
    backwards: bool = False

    def along(self, move: Array) -> npt.NDArray[np.bool_]:
        """(N,) whether the robot fits into each cell when it moves in a direction."""
        if not self.turns:
            return np.array(self.each.any(axis=0))
        turn = np.arctan2(move[1], move[0]) / (2 * np.pi) + (0.5 if self.backwards else 0.0)
        return self.each[round(turn * len(self.each)) % len(self.each)]


def _paths(
    problem: Problem, stages: Stages, headings: Headings, start: Array, goal: Array
) -> Iterator[tuple[Array, bool]]:
    """Shortest paths of the position round what is in the way, (K, 2 or 3), and whether they are driven backwards."""
    place = list(problem.dynamics.state_coordinates.position)
    begin, end = start[place], goal[place]
    if not any(passable(problem)) or np.array_equal(begin, end):
        return
    low, high = _extent(problem, begin, end)
    grid = Grid(low, high, (high - low).max() / CELLS[len(place)])
    fits = _fits(stages, headings, np.array([start, goal]), grid.points)
    for at in (begin, end):
        fits |= np.abs(grid.points - at).max(axis=1) <= NEAR * grid.cell
    distance, any_heading = float(np.linalg.norm(end - begin)), np.array([fits.all(axis=0)])
    straight = [] if headings.angles else [np.linspace(begin, end, DENSE)]
    for backwards in (False, True) if headings.angles else (False,):
        known = straight.copy()
        narrow = [Fits(fits, True, backwards)] if headings.angles else []
        for free in (Fits(any_heading, False), *narrow, Fits(fits, False)):
            for path in _routes(grid, begin, end, free, BESIDE * distance):
                dense = _drawn(path, DENSE)
                if all(KDTree(other).query(dense)[0].max() > BESIDE * distance for other in known):
                    known.append(dense)
                    yield path, backwards


def _routes(grid: Grid, begin: Array, end: Array, free: Fits, beside: float) -> Iterator[Array]:
    """`ROUTES` paths, (K, 2 or 3): the shortest, and the shortest for which cells near those before count more."""
    length = np.ones(len(grid.points))
    for _ in range(ROUTES):
        cells = grid.shortest(begin, end, free, length)
        if cells is None:
            return
        near = KDTree(cells).query(grid.points, distance_upper_bound=beside)[0] < beside
        length = np.where(near, AVOIDED * length, length)
        yield np.vstack([begin, grid.cut(cells, free)[1:-1], end])


def _extent(problem: Problem, begin: Array, end: Array) -> tuple[Array, Array]:
    """The corners of the region for paths: the bounds of the position, or a margin round all that is known."""
    dynamics, space = problem.dynamics, problem.dynamics.state_coordinates
    place, known = list(space.position), [begin, end]
    for obstacle in (obstacle for term in problem.kept_clear for obstacle in term.world.obstacles):
        at = obstacle.position[["xyz".index(axis) for axis in space.plane]]
        reach = np.max(obstacle.size, where=np.isfinite(obstacle.size), initial=0.0)
        known += [at - reach, at + reach]
    low, high = np.min(known, axis=0), np.max(known, axis=0)
    margin = AROUND * (high - low).max()
    low, high = low - margin, high + margin
    for constraint in problem.constraints:
        for i, (least, most) in constraint.state_bounds(dynamics).items():
            if i in place and np.isfinite(np.min(least)) and np.isfinite(np.max(most)):
                low[place.index(i)], high[place.index(i)] = np.min(least), np.max(most)
    return low, high


def _fits(stages: Stages, headings: Headings, ends: Array, points: Array) -> npt.NDArray[np.bool_]:
    """Whether the constraints that can be passed on one side or another hold with the position at points (N, d).

    The result is (attitudes, N): headings along the axes and between, or the attitudes of start and goal, the `ends`
    (2, n), and each angle turned.
    """
    problem, start, turn = stages.problem, ends[0], 2 * np.pi * np.arange(TURNS)[:, None] / TURNS
    space, entries = problem.dynamics.state_coordinates, np.arange(len(start))
    place = list(space.position)
    if headings.angles:
        attitudes = np.where(np.isin(entries, headings.angles), turn - headings.ahead, start)
    else:
        attitudes = np.vstack([ends, *(np.where(entries == i, turn, start) for i in space.angles)])
    rows = np.isin(stages.owners, np.flatnonzero(passable(problem)))
    knots = max(problem.steps - 1, 1)  # between the first and the last, where a row may not act; or the last
    fits = np.ones((len(attitudes), len(points)), dtype=bool)
    controls = np.broadcast_to(problem.nominal_controls, (problem.steps, len(problem.control_coordinates)))
    for fitting, attitude in zip(fits, attitudes, strict=True):
        for first in range(0, len(points), knots):
            batch = points[first : first + knots]
            states = np.tile(attitude, (problem.steps + 1, 1))
            states[1 : 1 + len(batch), place] = batch
            values = stages.values(Motion(in_c_order(states), in_c_order(controls)))[1 : 1 + len(batch), rows]
            fitting[first : first + knots] = ~(values < 0).any(axis=1)
    return fits


def _drawn(path: Array, steps: int) -> Array:
    """A path (K, d) at constant speed with rounded corners, (T+1, d)."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.linspace(0.0, way[-1], steps + 1)
    drawn = np.column_stack([np.interp(at, way, axis) for axis in path.T])
    for _ in range(max(2, steps // ROUND)):
        drawn[1:-1] = drawn[1:-1] / 2 + (drawn[:-2] + drawn[2:]) / 4
    return drawn

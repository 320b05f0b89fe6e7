"""A search from outside the solver: starts that are made by hand for a robot, until one of them leads to a plan.

Straight lines in the states, and shortest paths round the obstacles on a grid, along which robots with wheels go
forwards or in reverse; each with whole turns more or less at the goal, and in two durations.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

import lqrsim as ls
from kinodynamic.data import Array, Case
from kinodynamic.statements import STEPS, in_least_time

ROOM = 0.25  # m between the path and the obstacles, about half a robot's length: closer paths turn into no plan
SPACING = {2: 0.1, 3: 0.2}  # m, of the grid in so many dimensions
LONGER = (1.0, 2.0)  # times the model's guess
EACH = {"max_iterations": 200, "time_limit": 8.0}
SPEEDS = {"x": "vx", "y": "vy", "z": "vz", "a": "w", "q": "wq", "q1": "w1", "q2": "w2"}  # angle or position: its rate
TURNING = {"quad2d_v0": ("a",), "quad2dpole_v0": ("q",), "acrobot_v0": ("q1",), "car1_v0": ("a", "b")}


def found(case: Case) -> ls.Solution | None:
    """The first plan that is CONVERGED, if any is."""
    for problem, start in starts(case):
        plan = ls.smooth(problem, start=start, threads=1, **EACH)
        if plan.success:
            return plan
    return None


def starts(case: Case) -> Iterator[tuple[ls.Problem, ls.Trajectory]]:
    """Problems, whose goals differ in whole turns, and starts for them."""
    wheels = case.robot.startswith(("unicycle", "car"))
    names = TURNING.get(case.robot, ("a",) if wheels else ())
    turning = [case.model.number(name) for name in names]
    path = _path(case) if case.model.position else None
    ways: list[tuple[Array | None, bool]] = [(path, False)]
    if wheels and path is not None:  # of others the path is a line where nothing is in the way
        ways += [(path, True), (None, False)]
    for longer, turns, (way, reverse) in itertools.product(LONGER, (0, 1, -1) if turning else (0,), ways):
        goal, heading = case.goal.copy(), None
        goal[turning] += 2 * np.pi * turns
        if wheels and way is not None:
            heading = _heading(case, way, reverse)
            goal[turning] += 2 * np.pi * np.round((heading[-1] - case.goal[2]) / (2 * np.pi))
        states = np.linspace(case.start, goal, STEPS + 1)
        if way is not None:
            states[:, : way.shape[1]] = way
        if heading is not None:
            states[1:-1, turning] = heading[1:-1, None]
        yield in_least_time(replace(case, goal=goal)), _with_speeds(case, states, longer * case.model.guess / STEPS)


def _with_speeds(case: Case, states: Array, dt: float) -> ls.Trajectory:
    names = list(case.model.states)
    for name, speed in SPEEDS.items():
        if name in names and speed in names:
            column = states[:, names.index(name)]
            states[1:-1, names.index(speed)] = (column[2:] - column[:-2]) / (2 * dt)
    return ls.Trajectory(states, np.tile(np.array(case.model.rest, dtype=float), (STEPS, 1)), dt)


def _heading(case: Case, path: Array, reverse: bool) -> Array:
    along = np.gradient(path, axis=0)
    heading = np.arctan2(along[:, 1], along[:, 0]) + (np.pi if reverse else 0.0)
    return np.unwrap(np.append(case.start[2], heading))[1:]


def _path(case: Case) -> Array | None:
    """The shortest path (STEPS + 1, d) on a grid, its corners rounded; None if there is none."""
    if not len(case.boxes):
        return None
    places, spacing = len(case.low), SPACING[len(case.low)]
    counts = np.round((case.high - case.low) / spacing).astype(int) + 1
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, places)
    at = case.low + spacing * grid
    ends = [case.start[:places], case.goal[:places]]
    outside = np.maximum(np.abs(at[:, None] - case.boxes[:, :places]) - case.boxes[:, places:] / 2, 0.0)
    free = np.linalg.norm(outside, axis=-1).min(axis=1) > ROOM
    for end in ends:  # a robot may begin and end closer
        free |= np.linalg.norm(at - end, axis=1) < 2 * ROOM
    number = np.arange(len(grid)).reshape(counts)
    edges = []
    for move in itertools.product((-1, 0, 1), repeat=places):
        inside = ((grid + move >= 0) & (grid + move < counts)).all(axis=1) & free & any(move)
        others = number[tuple((grid[inside] + move).T)]
        ahead = free[others]
        length = np.full(ahead.sum(), spacing * np.linalg.norm(move))
        edges.append((length, number.ravel()[inside][ahead], others[ahead]))
    lengths, one, other = map(np.concatenate, zip(*edges, strict=True))
    graph = coo_array((lengths, (one, other)), shape=(len(grid), len(grid))).tocsr()
    first, last = (int(np.linalg.norm(at - end, axis=1).argmin()) for end in ends)
    before = dijkstra(graph, indices=first, return_predecessors=True)[1]
    nodes = [last]
    while nodes[-1] != first:
        if before[nodes[-1]] < 0:
            return None
        nodes.append(int(before[nodes[-1]]))
    corners = np.concatenate([ends[:1], at[nodes[::-1][1:-1]], ends[1:]])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    path = np.stack([np.interp(np.linspace(0, along[-1], STEPS + 1), along, one) for one in corners.T], axis=1)
    for _ in range(STEPS // 20):
        path[1:-1] = path[1:-1] / 2 + (path[:-2] + path[2:]) / 4
    return path

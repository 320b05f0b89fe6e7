"""Random worlds of the two robots, from a fixed start. World i of a robot and seed is the same however many are drawn.

One in five is nearly blocked: a barrier from wall to wall, between start and goal, with one gap that is little wider
than the robot; whatever else is there leaves a way to it. Of the others nobody knows whether there is a way.
"""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from numpy.random import Generator
from reliability.common import fixed
from reliability.worlds import clear_place, wall
from reliability.worlds import drive as open_drive
from reliability.worlds import quadrotor as open_quadrotor

import lqrsim as ls
from lqrsim.errors import Array

Kind = Literal["drive", "quadrotor"]
EVERY = 5  # one in so many is nearly blocked
SPARE = (0.05, 0.25)  # m, by how much a gap is wider than the robot


@dataclass(frozen=True)
class Gap:
    """Where the barrier lets the robot through: its middle, the axis that it leads along, and its width across."""

    middle: Array
    axis: int
    widths: tuple[float, ...]


@dataclass(frozen=True)
class Drawn:
    """A problem, and the gap where its world is nearly blocked."""

    problem: ls.Problem
    gap: Gap | None = None


def draw(kind: Kind, index: int, seed: int = 0) -> Drawn:
    """World `index` of a robot."""
    rng = np.random.default_rng([seed, zlib.crc32(f"quality {kind}".encode()), index])
    if index % EVERY == EVERY - 1:
        return _BLOCKED[kind](rng)
    return Drawn(fixed({"drive": open_drive, "quadrotor": open_quadrotor}[kind](rng)))


def blocked_drive(rng: Generator) -> Drawn:
    """The paper's arena of 4 m by 6 m, with a row of boxes or pillars across."""
    robot = ls.DifferentialDrive()
    half = np.array([2.0, 3.0])
    walls = [wall(f"wall{axis}{side:+}", axis, side, half[axis]) for axis in (0, 1) for side in (-1, 1)]
    width = 2 * robot.radius + rng.uniform(*SPARE)
    middle = np.array([rng.uniform(-1.3, 1.3), rng.uniform(-0.6, 0.6)])
    left, right = middle[0] - width / 2, middle[0] + width / 2
    thick = rng.uniform(0.05, 0.2)  # half of it
    if rng.random() < 0.5:
        barrier = [
            _box("left", [(left - 2) / 2, middle[1], 0.5], [(left + 2) / 2, thick, 0.5]),
            _box("right", [(right + 2) / 2, middle[1], 0.5], [(2 - right) / 2, thick, 0.5]),
        ]
    else:  # pillars that overlap, the innermost at the gap
        away = thick * (1 + 1.8 * np.arange(100))
        places = [place for place in (*(left - away), *(right + away)) if abs(place) < 2 + thick]
        barrier = [_pillar(f"pillar{i}", place, middle[1], thick) for i, place in enumerate(places)]
    world = ls.World([*walls, *barrier])
    for name, place, size in _things(rng, world.seen_by("xy"), half, robot.radius, int(rng.integers(3))):
        world = ls.World([*world.obstacles, _pillar(name, place[0], place[1], size)])
    start, goal = _either_side(rng, world.seen_by("xy"), half - 0.3, middle, 1, thick, robot.radius + 0.05)
    by = np.linalg.norm(goal - middle) + np.linalg.norm(middle - start)
    ahead = np.arctan2(goal[1] - start[1], goal[0] - start[0])
    first, last = ([*place, ahead + rng.uniform(-np.pi, np.pi)] for place in (start, goal))
    problem = ls.Problem(
        dynamics=robot.dynamics,
        dt=1 / 6,
        steps=int(np.ceil(6 * by / 0.25 * rng.uniform(1.1, 1.5))),  # at 0.25 m/s, and some time to turn
        initial=ls.FixedState(first),
        stage_cost=ls.ControlCost((60.0, 60.0), about=(0.25, 0.25))
        + ls.ObstacleCost(world, radius=robot.radius, sharpness=10.0),
        final_cost=ls.QuadraticCost((5000.0, 5000.0, 50.0), about=last),
    )
    return Drawn(problem, Gap(middle, 1, (width,)))


def blocked_quadrotor(rng: Generator) -> Drawn:
    """The paper's cube of 6 m, with a wall of four boxes across one of its axes."""
    robot, half = ls.Quadrotor(), np.full(3, 3.0)
    walls = [wall(f"wall{axis}{side:+}", axis, side, 3.0) for axis in range(3) for side in (-1, 1)]
    axis = int(rng.integers(3))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    middle, thick = rng.uniform(-1.5, 1.5, size=3), rng.uniform(0.05, 0.2)
    middle[axis] = rng.uniform(-0.6, 0.6)
    widths = 2 * robot.radius + rng.uniform(*SPARE, size=2)
    barrier = []
    for side in (-1, 1):
        # Beside the gap from wall to wall, and as wide as the gap where that leaves the wall open.
        for name, across, width in (("beside", first, widths[0]), ("over", second, widths[1])):
            edge = middle[across] + side * width / 2
            place, size = middle.copy(), np.full(3, thick)
            place[across], size[across] = (edge + side * 3.0) / 2, (3.0 - side * edge) / 2
            if across == first:
                place[second], size[second] = 0.0, 3.0
            else:
                size[first] = widths[0] / 2
            barrier.append(_box(f"{name}{side:+}", place, size))
    world = ls.World([*walls, *barrier])
    for name, place, size in _things(rng, world, half, robot.radius, int(rng.integers(5))):
        world = ls.World([*world.obstacles, ls.Obstacle(name, "sphere", place, np.eye(3), np.array([size, 0, 0]))])
    start, goal = _either_side(rng, world, half - 0.5, middle, axis, thick, robot.radius + 0.05)
    at_rest = [np.concatenate([place, np.zeros(9)]) for place in (start, goal)]
    problem = ls.Problem(
        dynamics=robot.dynamics,
        dt=1 / 30,
        steps=int(rng.integers(110, 151)),
        initial=ls.FixedState(at_rest[0]),
        stage_cost=ls.ControlCost(np.full(4, 20.0), about=np.full(4, robot.hover_force))
        + ls.ObstacleCost(world, radius=robot.radius, sharpness=10.0),
        final_cost=ls.QuadraticCost(np.full(12, 500.0), about=at_rest[1]),
    )
    return Drawn(problem, Gap(middle, axis, tuple(widths.tolist())))


_BLOCKED: dict[str, Callable[[Generator], Drawn]] = {"drive": blocked_drive, "quadrotor": blocked_quadrotor}


def _things(
    rng: Generator, world: ls.World, half: Array, radius: float, count: int
) -> Iterator[tuple[str, Array, float]]:
    """Names, places and radii of round things, so far from everything that the robot fits between."""
    places: list[tuple[Array, float]] = []
    while len(places) < count:
        size = rng.uniform(0.1, 0.2)
        place = clear_place(rng, world, half, size + 2 * radius + 0.1)
        if all(np.linalg.norm(place - there) > size + thick + 2 * radius + 0.1 for there, thick in places):
            places.append((place, size))
            yield f"thing{len(places)}", place, size


def _either_side(
    rng: Generator, world: ls.World, half: Array, middle: Array, axis: int, thick: float, clearance: float
) -> tuple[Array, Array]:
    """A clear start and a clear goal on the two sides of a barrier, each side as likely."""
    places = []
    for side in (-1, 1):
        while True:
            place = clear_place(rng, world, half, clearance)
            if side * (place[axis] - middle[axis]) > thick + clearance:
                places.append(place)
                break
    start, goal = places if rng.random() < 0.5 else places[::-1]
    return start, goal


def _box(name: str, place: npt.ArrayLike, half: npt.ArrayLike) -> ls.Obstacle:
    return ls.Obstacle(name, "box", np.asarray(place, dtype=float), np.eye(3), np.asarray(half, dtype=float))


def _pillar(name: str, x: float, y: float, radius: float) -> ls.Obstacle:
    return ls.Obstacle(name, "cylinder", np.array([x, y, 0.5]), np.eye(3), np.array([radius, 0.5, 0.0]))

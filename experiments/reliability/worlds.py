"""The two robots in random worlds: pillars for the differential drive; bars, balls and boxes for the quadrotor.

Nothing makes sure that there is a way through: a penalty is not a constraint, and there is an optimum all the same.
Half have a fixed start.
"""

import numpy as np
import numpy.typing as npt
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array


def wall(name: str, axis: int, side: int, distance: float) -> ls.Obstacle:
    """A plane across an axis, at that distance on one side of the origin; its free side is the inner one."""
    normal = -side * np.eye(3)[axis]
    first = np.eye(3)[(axis + 1) % 3]
    rotation = np.column_stack([first, np.cross(normal, first), normal])
    return ls.Obstacle(name, "plane", -distance * normal, rotation, np.zeros(3))


def turned(rng: Generator) -> Array:
    """A random rotation."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def clear_place(rng: Generator, world: ls.World, half: Array, clearance: float) -> Array:
    """A random place in the box of those half lengths about the origin, that far from all obstacles."""
    while True:
        place = rng.uniform(-half, half)
        if world.distances(place).min() > clearance:
            return place


def ends(rng: Generator, world: ls.World, half: Array, clearance: float, apart: float) -> tuple[Array, Array]:
    """A clear start and a clear goal, so far apart."""
    while True:
        start, goal = (clear_place(rng, world, half, clearance) for _ in range(2))
        if np.linalg.norm(goal - start) > apart:
            return start, goal


def drive(rng: Generator) -> ls.Problem:
    """The differential drive among 3 to 16 pillars in the paper's arena, with about the paper's weights."""
    robot = ls.DifferentialDrive()
    walls = [wall(f"wall{axis}{side:+}", axis, side, (2.0, 3.0)[axis]) for axis in (0, 1) for side in (-1, 1)]
    pillars = [
        _obstacle(
            f"pillar{i}", "cylinder", [*rng.uniform((-1.9, -2.9), (1.9, 2.9)), 0.5], np.eye(3),
            [rng.uniform(0.1, 0.35), 0.5, 0.0],
        )
        for i in range(rng.integers(3, 17))
    ]  # fmt: skip
    world = ls.World([*walls, *pillars])
    start, goal = ends(rng, world.seen_by("xy"), np.array([1.7, 2.7]), robot.radius + 0.03, apart=2.0)
    ahead = np.arctan2(goal[1] - start[1], goal[0] - start[0])
    # Of the headings that are the same, the ones nearest to the way ahead: that is how a user would write them.
    first, last = ([*place, ahead + rng.uniform(-np.pi, np.pi)] for place in (start, goal))
    effort, weight = rng.uniform(30.0, 120.0), np.array([5000.0, 5000.0, 50.0]) * rng.uniform(0.2, 2.0)
    distance = float(np.linalg.norm(goal - start))
    return ls.Problem(
        dynamics=robot.dynamics,
        dt=1 / 6,
        steps=int(np.ceil(6 * distance / 0.25 * rng.uniform(1.0, 1.4))),  # at 0.25 m/s, and some time to go round
        initial=ls.FixedState(first) if rng.random() < 0.5 else ls.QuadraticCost(weight, about=first),
        stage_cost=ls.ControlCost((effort, effort), about=(0.25, 0.25))
        + ls.ObstacleCost(world, radius=robot.radius, sharpness=10.0),
        final_cost=ls.QuadraticCost(weight, about=last),
    )


def quadrotor(rng: Generator) -> ls.Problem:
    """The quadrotor between 5 and 40 obstacles in the paper's cube of 6 m, with about the paper's weights."""
    robot = ls.Quadrotor()
    walls = [wall(f"wall{axis}{side:+}", axis, side, 3.0) for axis in range(3) for side in (-1, 1)]
    world = ls.World([*walls, *(_thing(rng, f"thing{i}") for i in range(rng.integers(5, 41)))])
    start, goal = ends(rng, world, np.full(3, 2.5), robot.radius + 0.05, apart=2.5)
    first, last = (np.concatenate([place, np.zeros(9)]) for place in (start, goal))
    weight = np.full(12, 500.0 * rng.uniform(0.2, 2.0))
    return ls.Problem(
        dynamics=robot.dynamics,
        dt=1 / 30,
        steps=int(rng.integers(90, 151)),
        initial=ls.FixedState(first) if rng.random() < 0.5 else ls.QuadraticCost(weight, about=first),
        stage_cost=ls.ControlCost(np.full(4, rng.uniform(10.0, 40.0)), about=np.full(4, robot.hover_force))
        + ls.ObstacleCost(world, radius=robot.radius, sharpness=10.0),
        final_cost=ls.QuadraticCost(weight, about=last),
    )


def _thing(rng: Generator, name: str) -> ls.Obstacle:
    """A bar through the whole cube, a short bar, a ball or a box."""
    place, rotation = rng.uniform(-2.2, 2.2, size=3), turned(rng)
    kind = rng.choice(["long bar", "short bar", "ball", "box"])
    if kind == "long bar":  # along an axis
        along = np.roll(np.eye(3), int(rng.integers(3)), axis=1)
        return _obstacle(name, "cylinder", place, along, [rng.uniform(0.1, 0.4), np.inf, 0.0])
    if kind == "short bar":
        return _obstacle(name, "capsule", place, rotation, [rng.uniform(0.1, 0.3), rng.uniform(0.3, 1.0), 0.0])
    if kind == "ball":
        return _obstacle(name, "sphere", place, np.eye(3), [rng.uniform(0.2, 0.7), 0.0, 0.0])
    return _obstacle(name, "box", place, rotation, rng.uniform(0.1, 0.6, size=3))


def _obstacle(name: str, kind: str, position: npt.ArrayLike, rotation: Array, size: npt.ArrayLike) -> ls.Obstacle:
    return ls.Obstacle(name, kind, np.asarray(position, dtype=float), rotation, np.asarray(size, dtype=float))

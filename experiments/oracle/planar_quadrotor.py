"""A planar quadrotor that has to get round a wall and a ball: somebody's own system, with random starts and goals.

The wall stands between start and goal, and is higher than it looks from either side: plans that go straight on end in
front of it. Seen from above the two directions are `x` and `y`; the box and the ball are long enough to be seen whole.
"""

from typing import Any

import numpy as np
from numpy.random import Generator

import lqrsim as ls

MASS, INERTIA, ARM, DRAG, GRAVITY = 0.5, 0.005, 0.16, 0.05, 9.81
RADIUS, MARGIN, DT = 0.2, 0.05, 0.02
WALL, BALL = ((0.0, 0.2), (0.15, 0.8)), ((0.9, 1.6), 0.3)


def rate(x: Any, u: Any, p: Any) -> list[Any]:
    """Two rotors that push along the body's own upward direction, at the ends of an arm; drag against the velocity."""
    from sympy import cos, sin

    _, _, roll, vx, vy, turn = x
    thrust, torque = u[0] + u[1], p.arm * (u[1] - u[0])
    return [
        vx, vy, turn, (-thrust * sin(roll) - p.drag * vx) / p.mass,
        (thrust * cos(roll) - p.drag * vy) / p.mass - p.gravity, torque / p.inertia,
    ]  # fmt: skip


def dynamics() -> ls.Dynamics:
    return ls.Dynamics(
        rate,
        states={"x": "m", "y": "m", "roll": "rad", "vx": "m/s", "vy": "m/s", "turn": "rad/s"},
        controls={"left": "N", "right": "N"},
        parameters={"mass": MASS, "inertia": INERTIA, "arm": ARM, "drag": DRAG, "gravity": GRAVITY},
        control_limits=(0.0, 6.0),
        position=("x", "y"),
        angles=("roll",),
    )


def world() -> ls.World:
    (box, half), (ball, radius) = WALL, BALL
    upright = np.eye(3)
    return ls.World(
        (
            ls.Obstacle("wall", "box", np.array([*box, 0.0]), upright, np.array([*half, 1.0])),
            ls.Obstacle("ball", "cylinder", np.array([*ball, 0.0]), upright, np.array([radius, 1.0, 0.0])),
        )
    )


def problem(
    start: Any,
    goal: Any,
    *,
    steps: int = 200,
    clearance: bool = True,
    effort: float = 1.0,
    weight: float = 500.0,
    sharpness: float = 20.0,
) -> ls.Problem:
    """From rest to rest. `start` and `goal` are places (2,) in metres."""
    hover = MASS * GRAVITY / 2
    obstacles = world()
    return ls.Problem(
        dynamics=dynamics(),
        dt=DT,
        steps=steps,
        initial=ls.FixedState([*start, 0.0, 0.0, 0.0, 0.0]),
        stage_cost=ls.ControlCost((effort, effort), about=(hover, hover))
        + ls.ObstacleCost(obstacles, radius=RADIUS, sharpness=sharpness),
        final_cost=ls.QuadraticCost(np.full(6, weight), about=[*goal, 0.0, 0.0, 0.0, 0.0]),
        constraints=[ls.Clearance(obstacles, radius=RADIUS, margin=MARGIN)] if clearance else [],
    )


def draw(rng: Generator, *, clearance: bool, sharpness: float = 20.0) -> ls.Problem:
    """A random one; start and goal are drawn until both are clear by the margin."""
    obstacles = world().seen_by("xy")

    def place(low: float, high: float) -> np.ndarray:
        while True:
            drawn = np.array([rng.uniform(low, high), rng.uniform(-0.2, 1.0)])
            if obstacles.distances(drawn).min() > RADIUS + 2 * MARGIN:
                return drawn

    start, goal = place(-2.0, -1.0), place(1.2, 2.3)
    return problem(start, goal, steps=int(rng.integers(120, 301)), clearance=clearance, sharpness=sharpness)

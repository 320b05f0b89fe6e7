"""A point mass that passes pillars, and how often it hits them: by Monte Carlo with its exact discrete dynamics."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import lqrsim as ls
from lqrsim.disturbances import Uncertainty
from lqrsim.errors import Array

STEPS, DT, LIMIT = 40, 0.1, 5.0
THICK, RADIUS = 0.4, 0.2  # radii of a pillar and of the point mass, in m
START = (-1.5, 0.0, 0.0, 0.0)


class Noise(NamedTuple):
    """Standard deviations of all states at the start, of all controls, and of all measurements."""

    start: float
    control: float
    measurement: float

    @property
    def told(self) -> Uncertainty:
        return Uncertainty(**self._asdict())


def moves(x, u, p):
    return [x[2], x[3], u[0], u[1]]


def pillars(*places: tuple[float, float]) -> ls.World:
    size = np.array([THICK, 2.0, 0.0])
    return ls.World(
        [
            ls.Obstacle(f"pillar {i}", "cylinder", np.array([x, y, 0.0]), np.eye(3), size)
            for i, (x, y) in enumerate(places)
        ]
    )


def problem(obstacles: ls.ObstacleCost | None = None, *constraints: ls.Constraint) -> ls.Problem:
    """From START to the other side, with a cost of obstacles and with constraints."""
    dynamics = ls.Dynamics(
        moves, states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"ax": "m/s2", "ay": "m/s2"},
        position=("x", "y"), control_limits=(-LIMIT, LIMIT),
    )  # fmt: skip
    effort = ls.ControlCost((1.0, 1.0))
    return ls.Problem(
        dynamics=dynamics, dt=DT, steps=STEPS, initial=ls.FixedState(START),
        stage_cost=effort if obstacles is None else effort + obstacles, constraints=constraints,
        final_cost=ls.QuadraticCost(np.full(4, 500.0), about=(1.5, 0.0, 0.0, 0.0)),
    )  # fmt: skip


def clearances(states: Array, place: tuple[float, float]) -> Array:
    """Of states (K, 4) to the pillar at a place, (K,)."""
    return np.linalg.norm(states[:, :2] - place, axis=1) - THICK - RADIUS


def collisions(policy: ls.AffinePolicy, noise: Noise, places: Sequence[tuple[float, float]], trials: int) -> float:
    """The share of trials that hit a pillar at a knot."""
    rng = np.random.default_rng(1)
    A = np.eye(4) + DT * np.eye(4, k=2)
    B = np.concatenate([DT**2 / 2 * np.eye(2), DT * np.eye(2)])
    x = np.array(START) + noise.start * rng.standard_normal((trials, 4))
    hit = np.zeros(trials, dtype=bool)
    for t in range(STEPS + 1):
        for place in places:
            hit |= clearances(x, place) < 0
        if t < STEPS:
            shown = x + noise.measurement * rng.standard_normal(x.shape)
            u = shown @ policy.gain[t].T + policy.offset[t]
            u = np.clip(u, -LIMIT, LIMIT) + noise.control * rng.standard_normal((trials, 2))
            x = x @ A.T + np.clip(u, -LIMIT, LIMIT) @ B.T
    return float(hit.mean())

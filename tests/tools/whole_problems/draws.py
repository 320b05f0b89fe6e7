"""Whole problems, drawn at random: a system, an end, limits, constraints, and how it is solved.

Each kind is one structure, so each is compiled once; all else is numbers. A draw depends on its kind and number alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import systems
from numpy.random import Generator
from oracle import kkt, planar_quadrotor
from reliability import classics

import lqrsim as ls


@dataclass(frozen=True, repr=False)
class Draw:
    """A problem, the options to solve it with, and its rates in NumPy where it has more than a formula."""

    kind: str
    number: int
    problem: ls.Problem
    options: dict[str, Any]
    rate: kkt.Rate | None

    def __repr__(self) -> str:
        return f"draw({self.kind!r}, {self.number}) with {sorted(self.options)}"


def draw(kind: str, number: int, *, seed: int = 0) -> Draw:
    """The draw of that kind and number: the same whatever else is drawn."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(KINDS).index(kind), number)))
    problem = KINDS[kind](rng)
    if not isinstance(problem.initial, ls.FixedState) and rng.random() < 0.5 and problem.start is not None:
        problem = replace(problem, initial=ls.FixedState(problem.start))
    problem = _limited(rng, problem)
    return Draw(kind, number, problem, _options(rng, problem), kkt.quadrotor_rate if kind == "quadrotor" else None)


def solve(drawn: Draw) -> list[ls.Solution]:
    """Its solution; and where it says so, that of a warm start from there, with the goal moved a little."""
    options = dict(drawn.options)
    shift = options.pop("warm", None)
    solution = ls.smooth(drawn.problem, threads=1, **options)
    if shift is None:
        return [solution]
    options.pop("starts", None)
    options["start"] = solution.shifted(shift)
    return [solution, ls.smooth(drawn.problem, threads=1, **options)]


def _limited(rng: Generator, problem: ls.Problem) -> ls.Problem:
    """Half of them with tighter limits of the controls, some so tight that they act nearly always."""
    if rng.random() < 0.5:
        return problem
    size = np.exp(rng.uniform(np.log(0.05), np.log(20.0)))
    middle, space = problem.nominal_control, problem.dynamics.control_coordinates
    low = np.maximum(middle - size * rng.uniform(0.5, 1.5, size=len(middle)), space.low)
    high = np.minimum(middle + size * rng.uniform(0.5, 1.5, size=len(middle)), space.high)
    return replace(problem, control_limits=(low, high))


def _options(rng: Generator, problem: ls.Problem) -> dict[str, Any]:
    options: dict[str, Any] = {
        "safeguard": bool(rng.random() < 0.8),
        "max_iterations": int(rng.choice([3, 20, 60, 200])),
    }
    if rng.random() < 0.2:
        options["stop"] = "cost"
    if rng.random() < 0.2:
        options["tolerance"] = float(10 ** rng.uniform(-8, -2))
    if rng.random() < 0.2 and problem.steps > 3:
        options["warm"] = int(rng.integers(0, 3))
    begin = rng.random()
    if begin < 0.2:
        n, m = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates)
        size = np.exp(rng.uniform(-3, 2))
        controls = problem.nominal_control + size * rng.normal(size=(problem.steps, m))
        states = np.cumsum(0.1 * size * rng.normal(size=(problem.steps + 1, n)), axis=0)
        options["start"] = controls if begin < 0.1 else ls.Trajectory(states, controls, problem.dt)
    elif begin < 0.4 and any(len(cost.world) for cost in problem.obstacle_costs):
        options["starts"] = int(rng.integers(1, 4))
    if begin > 0.9:
        options["first_pass"] = "backward"
    return options


def _weights(rng: Generator, size: int, low: float = 0.1, high: float = 1000.0) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), size=size))


def _ends(rng: Generator, start: np.ndarray) -> ls.QuadraticCost | ls.FixedState:
    weights = _weights(rng, len(start))
    return ls.FixedState(start) if rng.random() < 0.6 else ls.QuadraticCost(weights, about=start)


def linear(rng: Generator) -> ls.Problem:
    """Three states, two controls, stable or not."""
    a, (b0, b1, *c) = rng.normal(size=(3, 3)), rng.normal(size=4)
    dynamics = systems.linear(a, [[b0, 0.0], [0.0, b1], c])
    return ls.Problem(
        dynamics=dynamics, dt=float(rng.uniform(0.01, 0.2)), steps=int(rng.integers(1, 60)),
        initial=_ends(rng, rng.normal(size=3)),
        stage_cost=systems.stage_cost(
            ls.ControlCost(_weights(rng, 2), about=rng.normal(size=2)),
            ls.QuadraticCost(_weights(rng, 3, 1e-3, 10.0), about=rng.normal(size=3)),
        ),
        final_cost=ls.QuadraticCost(_weights(rng, 3), about=rng.normal(size=3)),
    )  # fmt: skip


def _point_rate(x: Any, u: Any, p: Any) -> list[Any]:
    return [*x[3:], *((u[i] - p.drag * x[3 + i]) / p.mass for i in range(3))]


def point(rng: Generator) -> ls.Problem:
    """A point mass in space among balls and beams, which it must keep clear of."""
    dynamics = ls.Dynamics(
        _point_rate,
        states={"x": "m", "y": "m", "z": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s"},
        controls={"fx": "N", "fy": "N", "fz": "N"},
        parameters={"mass": float(rng.uniform(0.2, 3.0)), "drag": float(rng.uniform(0, 0.5))},
        position=("x", "y", "z"),
    )
    radius, start, goal = 0.2, rng.uniform(-2, 2, size=3), rng.uniform(-2, 2, size=3)
    return _among(rng, dynamics, start, goal, radius, steps=int(rng.integers(20, 80)), dt=0.05, planar=False)


def _car_rate(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [x[3] * cos(x[2]), x[3] * sin(x[2]), u[1] * x[3], u[0] - p.drag * x[3]]


def car(rng: Generator) -> ls.Problem:
    """A car among pillars, which it must keep clear of."""
    dynamics = ls.Dynamics(
        _car_rate,
        states={"x": "m", "y": "m", "heading": "rad", "speed": "m/s"},
        controls={"throttle": "m/s^2", "curvature": "1/m"},
        parameters={"drag": float(rng.uniform(0, 0.5))},
        position=("x", "y"),
        angles=("heading",),
        control_limits=((-3.0, -2.0), (3.0, 2.0)),
    )
    start, goal = rng.uniform(-2, 2, size=2), rng.uniform(-2, 2, size=2)
    return _among(rng, dynamics, start, goal, 0.2, steps=int(rng.integers(30, 100)), dt=0.06, planar=True)


def _among(
    rng: Generator, dynamics: ls.Dynamics, start: Any, goal: Any, radius: float, *, steps: int, dt: float, planar: bool
) -> ls.Problem:
    """From rest to rest, some way clear of a few obstacles at the start; the goal may be inside one."""
    obstacles = []
    for i in range(int(rng.integers(1, 5))):
        where, size = rng.uniform(-2, 2, size=3), float(rng.uniform(0.1, 0.7))
        if planar:
            where[2] = 0.0
        if np.linalg.norm((where - np.array([*start, 0.0])[:3])[: len(start)]) > size + radius + 0.1:
            kind, sizes = ("cylinder", (size, np.inf, 0.0)) if planar else ("sphere", (size, 0.0, 0.0))
            obstacles.append(ls.Obstacle(f"{kind} {i}", kind, where, np.eye(3), np.array(sizes)))
    world = ls.World(obstacles)
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    rest = np.zeros(n - len(start))
    return ls.Problem(
        dynamics=dynamics, dt=dt, steps=steps, initial=_ends(rng, np.array([*start, *rest])),
        stage_cost=ls.ControlCost(_weights(rng, m, 0.1, 20.0), about=np.zeros(m))
        + ls.ObstacleCost(world, radius=radius, sharpness=float(rng.uniform(3, 20)), weight=float(rng.uniform(0.1, 3))),
        final_cost=ls.QuadraticCost(_weights(rng, n, 50.0), about=np.array([*goal, *rest])),
        constraints=[ls.Clearance(world, radius=radius, margin=float(rng.uniform(0, 0.1)))],
    )  # fmt: skip


def planar(rng: Generator) -> ls.Problem:
    """The planar quadrotor over its wall, with a clearance."""
    return _reweighed(rng, planar_quadrotor.draw(rng, clearance=True))


def planar_free(rng: Generator) -> ls.Problem:
    """The same without one."""
    return _reweighed(rng, planar_quadrotor.draw(rng, clearance=False))


def _reweighed(rng: Generator, problem: ls.Problem) -> ls.Problem:
    """With weights of any size: where controls cost much, plans go through the wall, or stop before it."""
    hover, goal, world = problem.nominal_control, problem.goal, planar_quadrotor.world()
    assert goal is not None
    return replace(
        problem,
        stage_cost=ls.ControlCost(np.full(2, _weights(rng, 1, 0.1, 20.0)[0]), about=hover)
        + ls.ObstacleCost(world, radius=planar_quadrotor.RADIUS, sharpness=float(rng.choice([5.0, 10.0, 20.0]))),
        final_cost=ls.QuadraticCost(np.full(6, _weights(rng, 1, 100.0, 1000.0)[0]), about=goal),
    )


def quadrotor(rng: Generator) -> ls.Problem:
    """The packaged quadrotor between any two places of its cage."""
    return ls.scenarios.quadrotor(query=int(rng.integers(100)), seed=int(rng.integers(1000))).problem


def drive(rng: Generator) -> ls.Problem:
    """The packaged drive with other weights, to any heading."""
    problem = ls.scenarios.differential_drive().problem
    goal = np.array([rng.uniform(-1, 1), 2.5, rng.uniform(-np.pi, np.pi)])
    return replace(problem, final_cost=ls.QuadraticCost(_weights(rng, 3, 10.0, 5000.0), about=goal))


def _sideways(x: Any, u: Any, p: Any) -> list[Any]:
    across = u[1] * x[3] ** 2  # m/s^2
    return [p.grip - across, p.grip + across]


def _aligned(x: Any, u: Any, p: Any) -> Any:
    from sympy import cos, sin

    return x[0] * sin(p.bearing) - x[1] * cos(p.bearing)


def parking(rng: Generator) -> ls.Problem:
    """The car onto a line, at a heading and at rest, within bounds on its speed and on its sideways acceleration."""
    problem, bearing = car(rng), float(rng.uniform(-np.pi, np.pi))
    goal = np.array([0.0, 0.0, bearing, 0.0])
    return replace(
        problem,
        steps=int(rng.integers(30, 80)),
        stage_cost=ls.ControlCost(_weights(rng, 2, 0.1, 20.0)),
        final_cost=ls.QuadraticCost(_weights(rng, 4, 1.0, 100.0), about=goal),
        constraints=[
            ls.SymbolicConstraint(_aligned, parameters={"bearing": bearing}, equality=True, at="final"),
            ls.GoalState(heading=bearing, speed=0.0),
            ls.StateBounds(speed=(float(rng.choice([-1.0, 0.0])), float(rng.uniform(0.5, 3.0)))),
            ls.SymbolicConstraint(_sideways, parameters={"grip": float(rng.uniform(0.5, 5.0))}),
        ],
    )


def tracking(rng: Generator) -> ls.Problem:
    """The planar quadrotor along a reference that it need not be able to follow, with weights that change."""
    problem = planar_quadrotor.draw(rng, clearance=False)
    steps, hover, goal = problem.steps, problem.nominal_control, problem.goal
    assert goal is not None

    def walk(size: int, rows: int) -> np.ndarray:
        return np.cumsum(rng.normal(size=(rows, size)), axis=0) / np.sqrt(rows)

    states = np.linspace(0, 1, steps + 1)[:, None] * goal + 0.5 * walk(6, steps + 1)
    weights = _weights(rng, 6, 1e-2, 100.0) * np.exp(walk(6, steps + 1))
    controls, efforts = hover + 0.2 * walk(2, steps), _weights(rng, 2, 0.1, 20.0) * np.exp(walk(2, steps))
    changing = rng.random() < 0.7
    stage = ls.QuadraticCost(
        weights[:, :, None] * np.eye(6) if changing else weights[0], about=states[: steps + int(rng.integers(2))]
    ) + ls.ControlCost(efforts[:, :, None] * np.eye(2) if changing else efforts[0], about=controls)
    return replace(problem, stage_cost=stage, final_cost=ls.QuadraticCost(_weights(rng, 6, 1.0), about=states[-1]))


KINDS: dict[str, Callable[[Generator], ls.Problem]] = {
    "linear": linear,
    "pendulum": classics.pendulum,
    "cart_pole": classics.cart_pole,
    "acrobot": classics.acrobot,
    "arm": classics.arm,
    "car": car,
    "point": point,
    "planar": planar,
    "planar_free": planar_free,
    "drive": drive,
    "quadrotor": quadrotor,
    "parking": parking,
    "tracking": tracking,
}

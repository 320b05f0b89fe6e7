"""A parking problem as numbers, and the `ls.Problem` that it is.

A car with none, one or two trailers. The state is the middle of the rear axle, the heading, the steering angle, and of
each trailer the angle by which it turns less than what draws it; the controls are the speed and the steering rate.
There are four obstacles: two parked cars, a kerb and a post. One number of trailers is one structure for the compiler,
with or without an ObstacleCost and a GoalState; all else is data.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array

RADIUS = 0.9  # m, of all balls
ALONG_CAR, ALONG_TRAILER = (0.0, 0.5, 1.0), (0.55, 1.0)  # where balls are: of the wheelbase, of a trailer's length
LENGTHS = ("first", "second")  # of trailers, among the parameters


@dataclass(frozen=True)
class Shape:
    """An upright box or a lying capsule, or a ball: a capsule of length 0.

    Attributes:
      name: of the obstacle.
      box: whether it is one.
      place: (2,) of its middle in metres.
      turned: the angle of its long side to the x axis.
      half: of a box (half length, half width); of a capsule (half length of its segment, radius).
    """

    name: str
    box: bool
    place: Array
    turned: float
    half: tuple[float, float]

    @property
    def obstacle(self) -> ls.Obstacle:
        c, s = np.cos(self.turned), np.sin(self.turned)
        along, across, up = [c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]
        position, (length, width) = np.array([*self.place, 0.0]), self.half
        if self.box:
            rotation, size = np.array([along, across, up]).T, np.array([length, width, 1.0])
            return ls.Obstacle(self.name, "box", position, rotation, size)
        if not length:
            return ls.Obstacle(self.name, "sphere", position, np.eye(3), np.array([width, 0.0, 0.0]))
        rotation, size = np.array([across, up, along]).T, np.array([width, length, 0.0])  # it lies along its z
        return ls.Obstacle(self.name, "capsule", position, rotation, size)


@dataclass(frozen=True, kw_only=True)
class Task:
    """The numbers of a problem, in metres, seconds and radians.

    Attributes:
      wheelbase: of the car.
      trailers: the length of each.
      dt: the control period.
      steps: how many.
      start: (n,), given exactly.
      goal: (n,).
      exact: whether the goal is a GoalState, too, or only weighed.
      weight: of the final cost, of all states alike.
      effort: (2,) weights of the controls.
      obstacles: the shapes, in order.
      repulsion: (weight, sharpness) of the ObstacleCost, None without one.
      clearance: of each ball from each obstacle, from step 1 on.
      top: (2,) the largest speed and steering rate, either way.
      bounds: (n - 3,) the largest steering angle and angles of trailers, either way, from step 1 on.
      road: the least and the largest y of the rear axle, from step 1 on.
    """

    wheelbase: float
    trailers: tuple[float, ...]
    dt: float
    steps: int
    start: Array
    goal: Array
    exact: bool
    weight: float
    effort: Array
    obstacles: tuple[Shape, ...]
    repulsion: tuple[float, float] | None
    clearance: float
    top: Array
    bounds: Array
    road: tuple[float, float]


def _rate(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin, tan

    speed, turn = u[0], u[0] * tan(x[3]) / p.wheelbase
    rates = [speed * cos(x[2]), speed * sin(x[2]), turn, u[1]]
    for angle, name in zip(x[4:], LENGTHS, strict=False):
        drawn = speed * sin(angle) / getattr(p, name)  # what draws it turns it so fast
        rates.append(turn - drawn)
        speed, turn = speed * cos(angle), drawn
    return rates


def _places(x: Any, p: Any) -> list[list[Any]]:
    from sympy import cos, sin

    px, py, heading = x[0], x[1], x[2]
    ahead = [share * p.wheelbase for share in ALONG_CAR]
    places = [[px + one * cos(heading), py + one * sin(heading)] for one in ahead]
    for angle, name in zip(x[4:], LENGTHS, strict=False):
        heading, length = heading - angle, getattr(p, name)
        behind = [share * length for share in ALONG_TRAILER]
        places += [[px - one * cos(heading), py - one * sin(heading)] for one in behind]
        px, py = places[-1]
    return places


def _on_road(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1] - p.low, p.high - x[1]]


def problem_of(task: Task) -> ls.Problem:
    """The problem; it may begin within an obstacle."""
    count = len(task.trailers)
    angles = ("steering", *(f"hitch{i}" for i in range(count)))
    dynamics = ls.Dynamics(
        _rate,
        states={"x": "m", "y": "m", "heading": "rad"} | dict.fromkeys(angles, "rad"),
        controls={"speed": "m/s", "steering_rate": "rad/s"},
        parameters={"wheelbase": task.wheelbase, **dict(zip(LENGTHS, task.trailers, strict=False))},
        position=("x", "y"),
        offset=0.0,  # capsules lie in this plane
        control_limits=(-task.top, task.top),
    )
    world = ls.World([shape.obstacle for shape in task.obstacles])
    balls = ls.CollisionSpheres(_places, [RADIUS] * (len(ALONG_CAR) + count * len(ALONG_TRAILER)))
    cost: ls.Cost = ls.ControlCost(task.effort)
    if task.repulsion is not None:
        weight, sharpness = task.repulsion
        cost = cost + ls.ObstacleCost(world, balls=balls, weight=weight, sharpness=sharpness)
    widest = dict(zip(angles, task.bounds.tolist(), strict=True))
    low, high = task.road
    constraints: list[ls.Constraint] = [
        ls.Clearance(world, balls=balls, margin=task.clearance),
        ls.StateBounds({name: (-most, most) for name, most in widest.items()}),
        ls.SymbolicConstraint(_on_road, parameters={"low": low, "high": high}),
    ]
    if task.exact:
        constraints.append(ls.GoalState(task.goal))
    far = task.start + 1e3 * np.eye(len(task.start))[1]
    stated = ls.Problem(
        dynamics=dynamics,
        dt=task.dt,
        steps=task.steps,
        initial=ls.FixedState(far),
        stage_cost=cost,
        final_cost=ls.QuadraticCost(np.full(len(task.goal), task.weight), about=task.goal),
        constraints=constraints,
    )
    return stated.from_state(task.start)  # for a problem that is stated may not begin in an obstacle, and this may

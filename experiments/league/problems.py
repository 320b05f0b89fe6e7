"""The problems of the league, and what all solvers begin with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import altro_problems
import numpy as np
import three_link_arm
from numpy.typing import NDArray
from oracle import planar_quadrotor

import lqrsim as ls
from league import flights

Start = NDArray[np.float64] | ls.Trajectory
Instance = tuple[ls.Problem, Start]


@dataclass(frozen=True, kw_only=True)
class Family:
    """Problems of one kind.

    Attributes:
      make: the problem of a seed, and what a solve begins with: controls (T, m), or a trajectory.
      instances: how many seeds there are; 1 where nothing is random.
      published: Altro.jl's iterations and cost at commit 4864df2; None where there are none.
    """

    make: Callable[[int], Instance]
    instances: int = 1
    published: tuple[int, float] | None = None


KNOTS, PERIOD, CAR_RADIUS = 101, 0.05, 0.02


def _car(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [x[3] * cos(x[2]), x[3] * sin(x[2]), u[1], u[0]]


def _outside(x: Any, u: Any, p: Any) -> list[Any]:
    circles = [(p.x0, p.y0, p.r0), (p.x1, p.y1, p.r1), (p.x2, p.y2, p.r2), (p.x3, p.y3, p.r3)]
    return [(x[0] - a) ** 2 + (x[1] - b) ** 2 - r**2 for a, b, r in circles]


def concar(seed: int) -> tuple[ls.Problem, NDArray[np.float64]]:
    """The car among circles of InteriorPointDDP.jl, drawn anew from its distributions.

    The circles are constraints here; there they cost 50 for a unit that they are missed by, which is the same where
    their multipliers are below that. They act at the last knot, too, and the steps are RK4 and not the midpoint rule.
    """
    rng = np.random.default_rng(seed)
    force, turn = rng.uniform(1.5, 2.5), rng.uniform(3.0, 5.0)
    parameters: dict[str, float] = {}
    for i, middle in enumerate(((0.25, 0.25), (0.75, 0.75), (0.25, 0.75), (0.75, 0.25))):
        (x, y), radius = middle + rng.uniform(-0.1, 0.1, 2), 0.05 + rng.uniform(0, 0.15)
        parameters |= {f"x{i}": float(x), f"y{i}": float(y), f"r{i}": radius + CAR_RADIUS}
    heading = np.pi / 8 + rng.uniform(0, np.pi / 4)
    dynamics = ls.Dynamics(
        _car,
        states={"x": "m", "y": "m", "heading": "rad", "speed": "m/s"},
        controls={"force": "N", "turn": "rad/s"},
        position=("x", "y"),
    )
    problem = ls.Problem(
        dynamics=dynamics,
        dt=PERIOD,
        steps=KNOTS - 1,
        initial=ls.FixedState((0.0, 0.0, heading, 0.0)),
        stage_cost=ls.ControlCost((10.0 * PERIOD, 2.0 * PERIOD)),
        final_cost=ls.QuadraticCost(np.full(4, 400.0), about=(1.0, 1.0, np.pi / 4, 0.0)),
        control_limits=((-force, -turn), (force, turn)),
        constraints=[ls.SymbolicConstraint(_outside, parameters=parameters)],
    )
    return problem, _nominal(problem)


def planar(seed: int) -> Instance:
    """The package's planar quadrotor that has to get over a wall, with a clearance, from hovering."""
    drawn = planar_quadrotor.draw(np.random.default_rng(seed), clearance=True)
    problem = replace(drawn, steps=200)
    return problem, _nominal(problem)


def quadrotor(seed: int) -> Instance:
    """The quadrotor of the paper in its cage, from hovering; obstacles are a cost, and rotors have their limits."""
    problem = ls.scenarios.quadrotor(query=seed).problem
    assert problem.start is not None
    problem = replace(problem, initial=ls.FixedState(problem.start))
    return problem, _nominal(problem)


def arm(seed: int) -> Instance:
    """The arm of three links among posts, from rest, without the cost of coming near them.

    The posts are so high that the ends do not matter.
    """
    posts = [
        ls.Obstacle(name, "cylinder", np.array([*place, 0.0]), np.eye(3), np.array([three_link_arm.POST, np.inf, 0.0]))
        for name, place in three_link_arm.POSTS.items()
    ]
    stated = three_link_arm.problem(three_link_arm.ThreeLinkArm(), ls.World(posts))
    problem = replace(stated, stage_cost=ls.ControlCost(np.full(3, 0.05)))
    return problem, _nominal(problem)


def _nominal(problem: ls.Problem) -> NDArray[np.float64]:
    return altro_problems.same(problem, *problem.nominal_control)


def _of_altro(name: str) -> Family:
    case = altro_problems.CASES[name]
    return Family(make=lambda seed: case.make(), published=case.published)


FAMILIES = {name: _of_altro(name) for name in altro_problems.CASES} | {
    "concar": Family(make=concar, instances=100),
    "planar": Family(make=planar, instances=10),
    "quadrotor": Family(make=quadrotor, instances=10),
    "arm": Family(make=arm),
    "gap": Family(make=flights.gap),
    "gap_least_time": Family(make=flights.gap_in_least_time),
    "rocket": Family(make=flights.rocket),
    "rocket_free_time": Family(make=flights.rocket_in_free_time),
    "rocket_least_time": Family(make=flights.rocket_in_least_time),
}


def instances(name: str, most: int) -> Sequence[Instance]:
    """The problems of a family, at most so many."""
    family = FAMILIES[name]
    return [family.make(seed) for seed in range(min(family.instances, most))]

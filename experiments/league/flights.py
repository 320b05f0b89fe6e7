"""Two flights: a quadrotor through a gap that it has to pass tilted, and a rocket that lands.

Each with a given duration, and with one that is free and has a price.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracle import planar_quadrotor

import lqrsim as ls

# The gap: where the normal of its wall points, half its width, and how far from the wall it is wider by the root of 2.
# The rotors are 0.16 m from the middle: while that is in the gap, both are clear only within 26 degrees of the normal.
NORMAL, HALF, DEPTH = np.radians(-45.0), 0.04, 0.1


def _between(x: Any, u: Any, p: Any) -> list[Any]:
    """Both rotors between the branches of a hyperbola, with the gap at its waist."""
    from sympy import cos, sin

    rows = []
    for side in (-1, 1):
        place = x[0] + side * p.arm * cos(x[2]), x[1] + side * p.arm * sin(x[2])
        ahead, across = place[0] * p.ahead + place[1] * p.up, place[1] * p.ahead - place[0] * p.up
        rows.append(1 + (ahead / p.depth) ** 2 - (across / p.half) ** 2)
    return rows


def gap(seed: int, *, effort: float = 0.1, turning: float = 0.01) -> tuple[ls.Problem, ls.Trajectory]:
    """A planar quadrotor from hovering to hovering, through a gap in a wall that leans, from level on a straight line.

    It has a quarter more time than it needs. With much more there is an optimum for each knot that may be in the gap,
    and solvers end in one or another.
    """
    hover = np.full(2, planar_quadrotor.MASS * planar_quadrotor.GRAVITY / 2)
    start, goal = np.array([-1.2, 0.9, 0, 0, 0, 0]), np.array([1.3, -0.8, 0, 0, 0, 0])
    leaning = {"ahead": float(np.cos(NORMAL)), "up": float(np.sin(NORMAL)), "half": HALF, "depth": DEPTH}
    problem = ls.Problem(
        dynamics=planar_quadrotor.dynamics(),
        dt=0.02,
        steps=60,
        initial=ls.FixedState(start),
        stage_cost=ls.ControlCost(np.full(2, effort), about=hover)
        + ls.QuadraticCost([0, 0, 0, 0, 0, turning], about=np.zeros(6)),
        final_cost=ls.QuadraticCost(np.zeros(6), about=goal),
        constraints=[
            ls.SymbolicConstraint(_between, parameters={"arm": planar_quadrotor.ARM, **leaning}),
            ls.GoalState(goal),
        ],
    )
    line = np.linspace(start, goal, problem.steps + 1)
    return problem, ls.Trajectory(line, np.tile(hover, (problem.steps, 1)), problem.dt)


def gap_in_least_time(seed: int) -> tuple[ls.Problem, ls.Trajectory]:
    """The same as fast as the rotors let it: they cost next to nothing."""
    problem, start = gap(seed, effort=1e-3, turning=1e-4)
    return replace(problem, duration=(0.5, 5.0), time_weight=10.0), start


GRAVITY = 0.0371  # of Mars, in hm/s^2
WET, DRY = 2.0, 1.5  # t
BURNT = 0.05  # t of fuel for 100 kN, for a second
PRICE = 100.0  # of a tonne of fuel


def _rocket(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import sqrt

    thrust = sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    return [*x[3:6], u[0] / x[6], u[1] / x[6], u[2] / x[6] - p.gravity, -p.burnt * thrust]


def _fuel(x: Any, u: Any, p: Any) -> Any:
    from sympy import sqrt

    return p.price * sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)


def _engine(x: Any, u: Any, p: Any) -> list[Any]:
    """Thrust no less and no more than the engine has, and no further from upright than it may lean."""
    from sympy import sqrt

    square = u[0] ** 2 + u[1] ** 2 + u[2] ** 2
    return [square - p.least**2, p.most**2 - square, u[2] - p.upright * sqrt(square)]


def _glide(x: Any, u: Any, p: Any) -> Any:
    """Inside a cone about the vertical whose tip is below where it lands: at its tip it would have no slope."""
    return (x[2] + p.below) ** 2 - p.slope**2 * (x[0] ** 2 + x[1] ** 2)


def rocket(seed: int) -> tuple[ls.Problem, NDArray[np.float64]]:
    """A rocket that lands softly with the least fuel, and is lighter for each second of thrust.

    In units of 100 m, s and t, and so of 100 kN, in which all numbers are of a size. It begins with the thrust that
    carries it.
    """
    dynamics = ls.Dynamics(
        _rocket,
        states={**dict.fromkeys("xyz", "hm"), **dict.fromkeys(("vx", "vy", "vz"), "hm/s"), "mass": "t"},
        controls=dict.fromkeys(("tx", "ty", "tz"), "100 kN"),
        parameters={"gravity": GRAVITY, "burnt": BURNT},
    )
    engine = {"least": 0.04, "most": 0.14, "upright": float(np.cos(np.radians(40.0)))}
    problem = ls.Problem(
        dynamics=dynamics,
        dt=1.0,
        steps=50,
        initial=ls.FixedState((6.0, 4.0, 15.0, 0.2, -0.1, -0.6, WET)),
        stage_cost=ls.SymbolicCost(_fuel, parameters={"price": PRICE * BURNT}),
        final_cost=ls.QuadraticCost(np.zeros(7), about=np.zeros(7)),
        constraints=[
            ls.SymbolicConstraint(_engine, parameters=engine),
            ls.SymbolicConstraint(_glide, parameters={"slope": 1.0, "below": 0.1}),
            ls.StateBounds(z=(0.0, np.inf), mass=(DRY, np.inf)),
            ls.GoalState(x=0, y=0, z=0, vx=0, vy=0, vz=0),
        ],
    )
    return problem, np.tile([0.0, 0.0, WET * GRAVITY], (problem.steps, 1))


def rocket_in_free_time(seed: int, *, second: float = 1.0) -> tuple[ls.Problem, NDArray[np.float64]]:
    """The same, with a price of a second beside that of the thrust, which is that of a step however long it is."""
    problem, start = rocket(seed)
    return replace(problem, duration=(20.0, 100.0), time_weight=second), start


def rocket_in_least_time(seed: int) -> tuple[ls.Problem, NDArray[np.float64]]:
    """The same, with so high a price of time that the thrust hardly counts."""
    return rocket_in_free_time(seed, second=10.0)

"""Well-known problems, with the quadratic costs that people write for them: swinging up, parking, reaching."""

from typing import Any

import numpy as np
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array


def pendulum_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """A point mass on a rod, driven by a torque. The angle is 0 at the top."""
    from sympy import sin

    angle, turn = x
    return [turn, (u[0] - p.friction * turn) / (p.mass * p.length**2) + p.gravity / p.length * sin(angle)]


def cart_pole_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """A cart that is pushed, and a point mass on a rod that is hinged to it. The angle is 0 at the top."""
    from sympy import cos, sin

    _, angle, speed, turn = x
    sine, cosine = sin(angle), cos(angle)
    push = u[0] + p.pole * sine * (p.length * turn**2 - p.gravity * cosine)
    acceleration = push / (p.cart + p.pole * sine**2)
    return [speed, turn, acceleration, (p.gravity * sine - cosine * acceleration) / p.length]


def two_links(angles: Any, turns: Any, torques: Any, p: Any) -> list[Any]:
    """Accelerations of the joints of two equal uniform rods, the first hanging at 0, the second straight at 0."""
    from sympy import cos, sin

    mass, half, inertia = p.mass, p.length / 2, p.mass * p.length**2 / 12
    (first, second), (w1, w2) = angles, turns
    both = mass * p.length * half
    a22 = mass * half**2 + inertia
    a12 = a22 + both * cos(second)
    a11 = 2 * a22 + mass * p.length**2 + 2 * both * cos(second)
    swing = both * sin(second)
    pull = mass * half * p.gravity * sin(first + second)
    b1 = torques[0] - p.friction * w1 + swing * (2 * w1 * w2 + w2**2) - 3 * mass * half * p.gravity * sin(first) - pull
    b2 = torques[1] - p.friction * w2 - swing * w1**2 - pull
    determinant = a11 * a22 - a12**2
    return [(a22 * b1 - a12 * b2) / determinant, (a11 * b2 - a12 * b1) / determinant]


def acrobot_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """Two links with a motor between them only."""
    return [x[2], x[3], *two_links(x[:2], x[2:], (0, u[0]), p)]


def arm_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """Two links with a motor in each joint."""
    return [x[2], x[3], *two_links(x[:2], x[2:], u, p)]


def hand_cost(x: Any, u: Any, p: Any) -> Any:
    """Half the squared distance of the arm's hand from where it is to be, weighted: no quadratic in the angles."""
    from sympy import cos, sin

    right = p.length * (sin(x[0]) + sin(x[0] + x[1]))
    down = p.length * (cos(x[0]) + cos(x[0] + x[1]))
    return p.weight / 2 * ((right - p.right) ** 2 + (down - p.down) ** 2)


def car_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """A kinematic car: place of the rear axle, heading, speed of the front wheels; steering angle, acceleration."""
    from sympy import cos, sin

    _, _, heading, speed = x
    forward = speed * cos(u[0])
    return [forward * cos(heading), forward * sin(heading), speed * sin(u[0]) / p.axles, u[1]]


def pendulum(rng: Generator) -> ls.Problem:
    """From about hanging to standing."""
    dynamics = ls.Dynamics(
        pendulum_rate,
        states={"angle": "rad", "turn": "rad/s"},
        controls={"torque": "N m"},
        parameters={
            "mass": rng.uniform(0.5, 2), "length": rng.uniform(0.3, 1.5), "friction": rng.uniform(0, 0.1),
            "gravity": 9.81,
        },
        angles=("angle",),
    )  # fmt: skip
    start = np.array([_around(rng, np.pi), rng.uniform(-0.5, 0.5)])
    return _problem(rng, dynamics, start, np.zeros(2), steps=int(rng.integers(40, 81)), dt=0.05, effort=(0.01, 1.0))


def cart_pole(rng: Generator) -> ls.Problem:
    """From about hanging to standing over the origin."""
    dynamics = ls.Dynamics(
        cart_pole_rate,
        states={"position": "m", "angle": "rad", "speed": "m/s", "turn": "rad/s"},
        controls={"force": "N"},
        parameters={
            "cart": rng.uniform(0.5, 2), "pole": rng.uniform(0.1, 0.5), "length": rng.uniform(0.3, 0.8),
            "gravity": 9.81,
        },
        angles=("angle",),
    )  # fmt: skip
    start = np.array([rng.uniform(-0.5, 0.5), _around(rng, np.pi), 0.0, 0.0])
    return _problem(rng, dynamics, start, np.zeros(4), steps=int(rng.integers(50, 81)), dt=0.05, effort=(0.03, 1.0))


def acrobot(rng: Generator) -> ls.Problem:
    """From about hanging to standing."""
    start = np.array([_around(rng, 0.0), _around(rng, 0.0), 0.0, 0.0])
    goal = np.array([np.pi, 0.0, 0.0, 0.0])
    steps = int(rng.integers(60, 101))
    return _problem(rng, _links(rng, acrobot_rate, 9.81), start, goal, steps=steps, dt=0.05, effort=(0.01, 1.0))


def arm(rng: Generator) -> ls.Problem:
    """The hand from one place to another, lying in the plane or hanging; the posture at the end is free."""
    dynamics = _links(rng, arm_rate, gravity=9.81 * rng.integers(2))
    start = np.array([*rng.uniform(-np.pi, np.pi, size=2), 0.0, 0.0])
    reach, direction = rng.uniform(0.3, 1.9) * dynamics.parameters["length"], rng.uniform(-np.pi, np.pi)
    place = {"right": reach * np.sin(direction), "down": reach * np.cos(direction)}
    problem = _problem(rng, dynamics, start, np.zeros(4), steps=int(rng.integers(30, 61)), dt=0.04, effort=(0.01, 1.0))
    weight = rng.uniform(100, 1000)
    at_rest = ls.QuadraticCost([0.0, 0.0, weight / 10, weight / 10], about=np.zeros(4))
    hand = ls.SymbolicCost(hand_cost, parameters={"weight": weight, "length": dynamics.parameters["length"], **place})
    # Nothing draws the angles anywhere but the hand.
    effort, _ = problem.stage_cost.terms  # pyright: ignore[reportAttributeAccessIssue]
    quiet = ls.QuadraticCost([0.0, 0.0, *np.full(2, rng.choice([0.0, 0.1]))], about=np.zeros(4))
    return ls.Problem(
        dynamics=dynamics, dt=problem.dt, steps=problem.steps, initial=problem.initial, stage_cost=effort + quiet,
        final_cost=hand + at_rest,
    )  # fmt: skip


def car(rng: Generator) -> ls.Problem:
    """Into a parking place, with manoeuvres: any heading, a metre or two away, at rest at both ends."""
    dynamics = ls.Dynamics(
        car_rate,
        states={"x": "m", "y": "m", "heading": "rad", "speed": "m/s"},
        controls={"steering": "rad", "acceleration": "m/s^2"},
        parameters={"axles": rng.uniform(1.0, 2.0)},
        angles=("heading",),
    )
    start = np.array([*rng.uniform(-2, 2, size=2), rng.uniform(-np.pi, np.pi), 0.0])
    steps = int(rng.integers(60, 121))
    return _problem(rng, dynamics, start, np.zeros(4), steps=steps, dt=0.06, effort=((0.3, 0.01), (3.0, 0.1)))


KINDS = {"pendulum": pendulum, "cart_pole": cart_pole, "acrobot": acrobot, "arm": arm, "car": car}


def _links(rng: Generator, rate: Any, gravity: float) -> ls.Dynamics:
    return ls.Dynamics(
        rate,
        states={"first": "rad", "second": "rad", "first_turn": "rad/s", "second_turn": "rad/s"},
        controls={"elbow": "N m"} if rate is acrobot_rate else {"shoulder": "N m", "elbow": "N m"},
        parameters={
            "mass": rng.uniform(0.5, 1.5), "length": rng.uniform(0.5, 1.2), "friction": rng.uniform(0, 0.1),
            "gravity": gravity,
        },
        angles=("first", "second"),
    )  # fmt: skip


def _around(rng: Generator, angle: float) -> float:
    return float(angle + rng.uniform(-0.3, 0.3))


def _problem(
    rng: Generator, dynamics: ls.Dynamics, start: Array, goal: Array, *, steps: int, dt: float, effort: Any
) -> ls.Problem:
    """Quadratic in the distance from the goal, at the end and, in half of them, lightly on the way."""
    n, m = len(start), len(dynamics.control_coordinates)
    weight = np.full(n, rng.uniform(100.0, 1000.0))
    low, high = np.log(effort)
    on_the_way = rng.choice([0.0, 0.01, 0.1])
    return ls.Problem(
        dynamics=dynamics,
        dt=dt,
        steps=steps,
        initial=ls.FixedState(start) if rng.random() < 0.5 else ls.QuadraticCost(weight, about=start),
        stage_cost=ls.ControlCost(np.broadcast_to(np.exp(rng.uniform(low, high)), m), about=np.zeros(m))
        + ls.QuadraticCost(np.full(n, on_the_way), about=goal),
        final_cost=ls.QuadraticCost(weight, about=goal),
    )

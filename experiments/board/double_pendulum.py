"""The board's double pendulum: its published numbers, and its motion as formulas for plans and in NumPy for runs.

Numbers and equations are those of the project's repository, github.com/dfki-ric-underactuated-lab/double_pendulum
(`leaderboard/*/robustness_v1` and `_v2`, `model/plant.py`). In version 1 the acrobot has the design C.0 with model 3.0
and the pendubot the design A.0 with model 2.0; in version 2 both have the design C.1 with model 1.0. All are without
friction and motor inertia, which some of the runs add.
"""

from typing import Any, Literal

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array

Robot = Literal["acrobot", "pendubot"]
LIMIT, GRAVITY, GEAR = 6.0, 9.81, 6.0  # Nm of the one motor, m/s^2, of both motors
ACTUATED = {"acrobot": 1, "pendubot": 0}  # the joint with a motor, by its index
UPRIGHT = np.array([np.pi, 0.0, 0.0, 0.0])

_C1 = {
    "I1": 0.031887199591513114, "I2": 0.05086984812807257, "m1": 0.5234602302310271, "m2": 0.6255677234174437,
    "l1": 0.2, "r1": 0.2, "r2": 0.25569305436052964,
}  # fmt: skip
# By robot and version, in kg m^2, kg and m; inertias are about the joints.
MODELS: dict[tuple[Robot, int], dict[str, float]] = {
    ("acrobot", 1): {
        "I1": 0.02671076499939512, "I2": 0.053878129629650884, "m1": 0.6416937799349799, "m2": 0.563935954099688,
        "l1": 0.2, "r1": 0.2, "r2": 0.3212669909674605,
    },
    ("pendubot", 1): {
        "I1": 0.053470810264216295, "I2": 0.02392374528789766, "m1": 0.5593806151425046, "m2": 0.6043459469186889,
        "l1": 0.3, "r1": 0.3, "r2": 0.18377686083653508,
    },
    ("acrobot", 2): _C1,
    ("pendubot", 2): _C1,
}  # fmt: skip
# What the plans know nothing of: damping in Nm s, friction in Nm, inertia of a motor in kg m^2.
UNKNOWN = {"b1": 0.0, "b2": 0.0, "cf1": 0.0, "cf2": 0.0, "Ir": 0.0}


def dynamics(robot: Robot, version: int) -> ls.Dynamics:
    """As the plans have it."""
    return ls.Dynamics(
        acrobot if robot == "acrobot" else pendubot, states={"q1": "rad", "q2": "rad", "v1": "rad/s", "v2": "rad/s"},
        controls={"torque": "Nm"}, parameters=MODELS[robot, version],
    )  # fmt: skip


def acrobot(x, u, p):
    """The motor is at the elbow."""
    return planned_rate(x, (0, u[0]), p)


def pendubot(x, u, p):
    """The motor is at the shoulder."""
    return planned_rate(x, (u[0], 0), p)


def planned_rate(x, torques, p):
    """The motion of SymPy symbols, without what the plans know nothing of."""
    from sympy import cos, sin

    q1, q2, v1, v2 = x
    coupling = p.m2 * p.l1 * p.r2
    m11 = p.I1 + p.I2 + p.m2 * p.l1**2 + 2 * coupling * cos(q2)
    m12, m22 = p.I2 + coupling * cos(q2), p.I2
    pull = GRAVITY * p.m2 * p.r2 * sin(q1 + q2)
    first = torques[0] - GRAVITY * (p.m1 * p.r1 + p.m2 * p.l1) * sin(q1) - pull
    first += coupling * sin(q2) * (2 * v1 * v2 + v2**2)
    second = torques[1] - pull - coupling * sin(q2) * v1**2
    determinant = m11 * m22 - m12**2
    return [v1, v2, (m22 * first - m12 * second) / determinant, (m11 * second - m12 * first) / determinant]


def rate(x: Array, torques: Array, p: dict[str, Any]) -> Array:
    """The motion with everything, of many runs at once: states (K, 4), torques (K, 2), each parameter (K,)."""
    q1, q2, v1, v2 = x.T
    coupling = p["m2"] * p["l1"] * p["r2"]
    sine, cosine = np.sin(q2), np.cos(q2)
    m11 = p["I1"] + p["I2"] + p["m2"] * p["l1"] ** 2 + 2 * coupling * cosine + (GEAR**2 + 1) * p["Ir"]
    m12, m22 = p["I2"] + coupling * cosine - GEAR * p["Ir"], p["I2"] + GEAR**2 * p["Ir"]
    pull = GRAVITY * p["m2"] * p["r2"] * np.sin(q1 + q2)
    first = torques[:, 0] - GRAVITY * (p["m1"] * p["r1"] + p["m2"] * p["l1"]) * np.sin(q1) - pull
    first += coupling * sine * (2 * v1 * v2 + v2**2) - p["b1"] * v1 - p["cf1"] * np.arctan(100 * v1)
    second = torques[:, 1] - pull - coupling * sine * v1**2 - p["b2"] * v2 - p["cf2"] * np.arctan(100 * v2)
    determinant = m11 * m22 - m12**2
    turns = (m22 * first - m12 * second) / determinant, (m11 * second - m12 * first) / determinant
    return np.stack([v1, v2, *turns], axis=1)


def advance(x: Array, torques: Array, p: dict[str, Any], dt: float) -> Array:
    """A Runge-Kutta step of fourth order, as the board's."""
    k1 = rate(x, torques, p)
    k2 = rate(x + dt / 2 * k1, torques, p)
    k3 = rate(x + dt / 2 * k2, torques, p)
    return x + dt / 6 * (k1 + 2 * (k2 + k3) + rate(x + dt * k3, torques, p))


def off_upright(x: Array) -> Array:
    """How far states (K, 4) are from standing upright, whatever turns they have made: (K, 4), positive."""
    turn = np.stack([x[:, 0] % (2 * np.pi), (x[:, 1] + np.pi) % (2 * np.pi) - np.pi, x[:, 2], x[:, 3]], axis=1)
    return np.abs(turn - UPRIGHT)

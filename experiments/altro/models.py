"""The models of RobotZoo.jl that the problems are about, as formulas."""

from collections.abc import Sequence
from typing import Any

import lqrsim as ls

GRAVITY = 9.81
QUATERNION = {f"q{i}": "" for i in range(4)}  # scalar first, from the body's axes to the world's


def _point(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], u[0]]


def double_integrator() -> ls.Dynamics:
    """A mass of 1 kg on a line."""
    return ls.Dynamics(_point, states={"x": "m", "v": "m/s"}, controls={"force": "N"})


def _pendulum(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import sin

    inertia = p.mass * p.length**2
    return [x[1], (u[0] - p.friction * x[1]) / inertia - p.gravity * sin(x[0]) / p.length]


def pendulum() -> ls.Dynamics:
    """It hangs at 0."""
    return ls.Dynamics(
        _pendulum,
        states={"angle": "rad", "rate": "rad/s"},
        controls={"torque": "N m"},
        parameters={"mass": 1.0, "length": 0.5, "friction": 0.1, "gravity": GRAVITY},
    )


def _cartpole(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    s, c, rate = sin(x[1]), cos(x[1]), x[3]
    # (cart + pole) a + pole l c alpha = u + pole l s rate^2;  c a + l alpha = -g s
    acceleration = (u[0] + p.pole * s * (p.length * rate**2 + p.gravity * c)) / (p.cart + p.pole * s**2)
    return [x[2], x[3], acceleration, -(c * acceleration + p.gravity * s) / p.length]


def cartpole() -> ls.Dynamics:
    """The pole, a point at the end of a rod without mass, hangs at 0."""
    return ls.Dynamics(
        _cartpole,
        states={"x": "m", "angle": "rad", "v": "m/s", "rate": "rad/s"},
        controls={"force": "N"},
        parameters={"cart": 1.0, "pole": 0.2, "length": 0.5, "gravity": GRAVITY},
    )


def _acrobot(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    first, second, w1, w2 = x
    a, b = p.length1, p.length2
    m11 = p.mass1 * a**2 + p.inertia1 + p.mass2 * (a**2 + b**2 + 2 * a * b * cos(second)) + p.inertia2
    m12 = p.mass2 * (b**2 + a * b * cos(second) + p.inertia2)
    m22 = b**2 * p.mass2 + p.inertia2
    bent = a * b * p.mass2 * sin(second)
    lower = p.mass2 * b * cos(first + second) * p.gravity
    upper = (p.mass1 + p.mass2) * b * cos(first) * p.gravity + lower
    r1 = (2 * w1 * w2 + w2**2) * bent - upper - p.friction * w1
    r2 = u[0] - bent * w1**2 - lower - p.friction * w2
    whole = m11 * m22 - m12**2
    return [w1, w2, (m22 * r1 - m12 * r2) / whole, (m11 * r2 - m12 * r1) / whole]


def acrobot() -> ls.Dynamics:
    """Driven at the elbow; the first angle is that from the horizontal, the second from the first link."""
    ones = dict.fromkeys(("length1", "length2", "mass1", "mass2", "inertia1", "inertia2", "friction"), 1.0)
    return ls.Dynamics(
        _acrobot,
        states={"shoulder": "rad", "elbow": "rad", "shoulder_rate": "rad/s", "elbow_rate": "rad/s"},
        controls={"torque": "N m"},
        parameters={**ones, "gravity": GRAVITY},
    )


def _car(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [u[0] * cos(x[2]), u[0] * sin(x[2]), u[1]]


def car() -> ls.Dynamics:
    """A unicycle, driven by speed and turn rate."""
    return ls.Dynamics(
        _car,
        states={"x": "m", "y": "m", "heading": "rad"},
        controls={"speed": "m/s", "turn": "rad/s"},
        position=("x", "y"),
    )


def rotation(q: Sequence[Any]) -> list[list[Any]]:
    """The matrix (3, 3) of a unit quaternion, scalar first."""
    w, x, y, z = q
    return [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]


def cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    """The vector product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def times(matrix: list[list[Any]], vector: Sequence[Any]) -> list[Any]:
    """A matrix times a vector."""
    return [sum(row[i] * vector[i] for i in range(3)) for row in matrix]


def added(*vectors: Sequence[Any]) -> list[Any]:
    """Their sum."""
    return [sum(entries) for entries in zip(*vectors, strict=True)]


def turning(q: Sequence[Any], rate: Sequence[Any]) -> list[Any]:
    """The rate of a quaternion under an angular velocity in the body's axes."""
    w, x, y, z = q
    a, b, c = rate
    return [
        (-x * a - y * b - z * c) / 2, (w * a + y * c - z * b) / 2, (w * b + z * a - x * c) / 2,
        (w * c + x * b - y * a) / 2,
    ]  # fmt: skip


def _quadrotor(x: Any, u: Any, p: Any) -> list[Any]:
    q, v, rate = x[3:7], x[7:10], x[10:13]
    thrust = times(rotation(q), [0, 0, u[0] + u[1] + u[2] + u[3]])
    inertia = [p.inertia_x, p.inertia_y, p.inertia_z]
    torque = [p.arm * (u[1] - u[3]), p.arm * (u[2] - u[0]), p.drag * (u[0] - u[1] + u[2] - u[3])]
    spin = cross(rate, [inertia[i] * rate[i] for i in range(3)])
    acceleration = [thrust[0] / p.mass, thrust[1] / p.mass, thrust[2] / p.mass - p.gravity]
    # The last state counts the knots, for costs that are of some of them.
    return [*v, *turning(q, rate), *acceleration, *[(torque[i] - spin[i]) / inertia[i] for i in range(3)], p.pace]


def quadrotor(dt: float) -> ls.Dynamics:
    """Position, quaternion, velocity in the world's axes, angular velocity in the body's, number of the knot."""
    states = {"x": "m", "y": "m", "z": "m", **QUATERNION, "vx": "m/s", "vy": "m/s", "vz": "m/s"}
    states |= {"wx": "rad/s", "wy": "rad/s", "wz": "rad/s", "knot": ""}
    return ls.Dynamics(
        _quadrotor,
        states=states,
        controls={f"rotor_{i}": "N" for i in range(1, 5)},
        parameters={
            "mass": 0.5, "inertia_x": 0.0023, "inertia_y": 0.0023, "inertia_z": 0.004, "arm": 0.175, "drag": 0.0245,
            "gravity": GRAVITY, "pace": 1 / dt,
        },
    )  # fmt: skip

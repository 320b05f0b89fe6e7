"""Two of the MJCFs in `files.py` as formulas: states and controls in the order of `ls.MjcfRobot`."""

from typing import Any

import numpy as np
import sympy

import lqrsim as ls

FREE = {"x y z": "m", "rx ry rz": "rad", "vx vy vz": "m/s", "wx wy wz": "rad/s"}

# The direction of each thruster of THRUSTERS and its place, both in the axes of the body.
ALONG, ASIDE, UP = (0.7071, 0.7071, 0.0), (0.7071, -0.7071, 0.0), (0.0, 0.0, 1.0)
DIRECTIONS = (ALONG, ASIDE, ASIDE, ALONG, UP, UP, UP, UP)
PLACES = (
    (0.15, -0.11, 0.0), (0.15, 0.11, 0.0), (-0.15, -0.11, 0.0), (-0.15, 0.11, 0.0),
    (0.12, -0.2, 0.0), (0.12, 0.2, 0.0), (-0.12, -0.2, 0.0), (-0.12, 0.2, 0.0),
)  # fmt: skip
GUARD = 0.25  # m, the radius of the ball that collides
AXES = (0, 1, 2), (1, 2, 0), (2, 0, 1)


def thrusters() -> ls.Dynamics:
    """The body of THRUSTERS: an ellipsoid whose drag is that of the box with its inertia, as MuJoCo computes it."""
    mass, axes = 11.5, np.array([0.25, 0.18, 0.13])
    inertia = mass / 5 * (sum(axes**2) - axes**2)
    parameters = {"mass": mass, "density": 1000.0, "viscosity": 0.001}
    parameters |= {f"inertia_{i}": value for i, value in enumerate(inertia)}
    parameters |= {f"box_{i}": value for i, value in enumerate(np.sqrt(6 / mass * (inertia.sum() - 2 * inertia)))}
    names = {name: unit for group, unit in FREE.items() for name in group.split()}
    return ls.Dynamics(
        _thruster_rate, states=names, controls={f"u{i}": "N" for i in range(8)}, parameters=parameters,
        position=("x", "y", "z"), rotation_vectors=(("rx", "ry", "rz"),), control_limits=(-35.0, 35.0),
    )  # fmt: skip


def _thruster_rate(x: Any, u: Any, p: Any) -> list[Any]:
    r, velocity, w = x[3:6], x[6:9], x[9:12]
    v = ls.rotations.rotate([-angle for angle in r], velocity)  # in the axes of the body, as all below
    inertia, box = ([getattr(p, f"{name}_{i}") for i in range(3)] for name in ("inertia", "box"))
    size = sum(box) / 3
    force = [sum(push * way[i] for push, way in zip(u, DIRECTIONS, strict=True)) for i in range(3)]
    arms = np.cross(PLACES, DIRECTIONS)
    torque = [sum(push * arm[i] for push, arm in zip(u, arms, strict=True)) for i in range(3)]
    for i, j, k in AXES:
        force[i] -= p.density / 2 * box[j] * box[k] * abs(v[i]) * v[i] + 3 * np.pi * p.viscosity * size * v[i]
        torque[i] -= p.density / 64 * box[i] * (box[j] ** 4 + box[k] ** 4) * abs(w[i]) * w[i]
        torque[i] -= np.pi * p.viscosity * size**3 * w[i] + (inertia[k] - inertia[j]) * w[j] * w[k]
    acceleration = ls.rotations.rotate(r, [one / p.mass for one in force])
    turning = [one / own for one, own in zip(torque, inertia, strict=True)]
    return [*velocity, *ls.rotations.vector_rate(r, w), *acceleration, *turning]


def slung_load() -> ls.Dynamics:
    """SLUNG_LOAD: the load at n, a unit vector, times the length, and the tension that keeps it there."""
    states = {
        "x y z": "m", "rx ry rz roll pitch": "rad", "vx vy vz": "m/s", "wx wy wz roll_rate pitch_rate": "rad/s",
    }  # fmt: skip
    return ls.Dynamics(
        _slung_rate, states={name: unit for group, unit in states.items() for name in group.split()},
        controls={f"u{i}": "N" for i in range(4)},
        parameters={"mass": 0.5, "load": 0.2, "length": 0.8, "inertia": 0.05, "arm": 0.17, "ratio": 0.025,
                    "drag": 0.15, "gravity": 9.8},
        position=("x", "y", "z"), rotation_vectors=(("rx", "ry", "rz"),), control_limits=(0.0, 3.71),
    )  # fmt: skip


def _slung_rate(x: Any, u: Any, p: Any) -> list[Any]:
    r, (roll, pitch), velocity, w, (rolling, pitching) = x[3:6], x[6:8], x[8:11], x[11:14], x[14:16]
    (sr, cr), (sp, cp) = ((sympy.sin(angle), sympy.cos(angle)) for angle in (roll, pitch))
    n = -sp, cp * sr, -cp * cr
    by_roll, by_pitch = (0, cp * cr, cp * sr), (-cp, -sp * sr, sp * cr)  # derivatives of n, at right angles to it
    thrust = ls.rotations.rotate(r, [0, 0, sum(u)])
    pushed = [(thrust[i] - p.drag * velocity[i]) / p.mass for i in range(3)]  # without the rod

    def along(one: Any) -> Any:
        return sum(a * b for a, b in zip(one, pushed, strict=True))

    faster = cp**2 * rolling**2 + pitching**2  # the square of the rate of n
    tension = (p.length * faster - along(n)) / (1 / p.mass + 1 / p.load)
    acceleration = [pushed[i] + tension * n[i] / p.mass for i in range(3)]
    acceleration[2] -= p.gravity
    torque = [p.arm * (u[1] - u[3]), p.arm * (u[2] - u[0]), p.ratio * (u[0] - u[1] + u[2] - u[3])]
    swing = [
        -along(by_roll) / (p.length * cp**2) + 2 * sp / cp * rolling * pitching,
        -along(by_pitch) / p.length - sp * cp * rolling**2,
    ]
    return [
        *velocity, *ls.rotations.vector_rate(r, w), rolling, pitching, *acceleration,
        *(one / p.inertia for one in torque), *swing,
    ]  # fmt: skip

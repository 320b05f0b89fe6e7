"""Judges plans with NumPy and SciPy alone: the motion in exact time, and by the Euler steps of dynobench.

States are those of dynobench: of a quadrotor the position, the quaternion (w first), the velocity and the angular
velocity. Rates are written from `src/*.cpp` and `src/quadpole_acceleration_auto.h`, not from `statements.py`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from kinodynamic.data import GRAVITY, STEEPEST, Array, Case, Model

# What dynobench accepts (`include/dynobench/motions.hpp`): a jump from an Euler step, depth in an obstacle, excess of
# bounds and of control limits; and the distance to the goal.
ACCEPTED = {"jump": 1e-2, "depth": 1e-2, "bounds": 1e-2, "controls": 1e-2, "goal": 3e-2}
# What is right in exact time. Of the goal 0.5 mrad and 1 mm, of an obstacle 1 mm.
RIGHT = {"depth": 1e-3, "bounds": 1e-4, "controls": 1e-9, "goal": 1e-3}
TIMES = 20  # within each period at which a motion is looked at

THRUST_AND_TORQUES = {
    "quadrotor_v0": 0.034 * GRAVITY / 4 * np.array([1.0, 0.707106781 * 0.046, 0.707106781 * 0.046, 0.006])[:, None]
    * np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]),
    "quadrotor_v1": np.diag([GRAVITY, 20.0, 20.0, 20.0]),
}  # fmt: skip
MASS = {"quadrotor_v0": 0.034, "quadrotor_v1": 1.0}
INERTIA = {"quadrotor_v0": np.array([16.571710e-6, 16.655602e-6, 29.261652e-6]), "quadrotor_v1": np.ones(3)}


def rate(robot: str, x: Array, u: Array) -> Array:
    """The rate of the state of a robot."""
    sin, cos, g = np.sin, np.cos, GRAVITY
    if robot.startswith("unicycle1"):
        return np.array([u[0] * cos(x[2]), u[0] * sin(x[2]), u[1]])
    if robot == "unicycle2_v0":
        return np.array([x[3] * cos(x[2]), x[3] * sin(x[2]), x[4], u[0], u[1]])
    if robot == "car1_v0":
        turning = u[0] / 0.25 * np.tan(u[1])
        return np.array([u[0] * cos(x[2]), u[0] * sin(x[2]), turning, u[0] / 0.5 * sin(x[2] - x[3])])
    if robot == "quad2d_v0":
        f1, f2 = u * 0.034 * g / 2
        return np.array(
            [*x[3:6], -(f1 + f2) * sin(x[2]) / 0.034, (f1 + f2) * cos(x[2]) / 0.034 - g, 0.1 / 1e-4 * (f1 - f2)]
        )
    if robot == "quad2dpole_v0":
        return _pole(x, u)
    if robot == "acrobot_v0":
        return _acrobot(x, u)
    wrench, w = THRUST_AND_TORQUES[robot] @ u, x[10:]
    attitude = x[3:7] / np.linalg.norm(x[3:7])
    push = rotated(attitude, np.array([0.0, 0.0, wrench[0]])) / MASS[robot] - np.array([0.0, 0.0, g])
    spin = (np.cross(INERTIA[robot] * w, w) + wrench[1:]) / INERTIA[robot]
    return np.concatenate([x[7:10], product(attitude, np.append(0.0, w)) / 2, push, spin])


def _pole(x: Array, u: Array) -> Array:
    """As a computer algebra system wrote it there, with its terms of both rotors collected."""
    m, mp, inertia, arm, r, g = 2.5, 0.25, 1.2, 0.25, 1.0, GRAVITY
    (f1, f2), a, q, w, wq = u * m * g / 2, x[2], x[3], x[6], x[7]
    f, b, sin, cos = f1 + f2, a + q, np.sin, np.cos
    swing = m * mp * r * (wq**2 + 2 * wq * w + w**2)
    ax = -f * m * sin(a) + f * mp * (sin(a + 2 * q) + sin(3 * a + 2 * q)) / 4 + f * mp * sin(a) * (sin(b) ** 2 - 1)
    ay = f * m * cos(a) - f * mp * (cos(a + 2 * q) - cos(3 * a + 2 * q)) / 4 - f * mp * cos(a) * (cos(b) ** 2 - 1)
    ax, ay = ax + swing * sin(b), ay - swing * cos(b) - g * m**2 - g * m * mp
    turning = arm * (f1 - f2) / inertia
    return np.array(
        [x[4], x[5], w, wq, ax / (m * (m + mp)), ay / (m * (m + mp)), turning, -f * sin(q) / (m * r) - turning]
    )


def _acrobot(x: Array, u: Array) -> Array:
    """The mass matrix, solved: links of 1 kg and 1 m, inertias about their pivots."""
    (q1, q2, w1, w2), inertia, half, g = x, 0.33333, 0.5, GRAVITY
    c2, s2, s1, s12 = np.cos(q2), np.sin(q2), np.sin(q1), np.sin(q1 + q2)
    mass = np.array([[2 * inertia + 1 + 2 * half * c2, inertia + half * c2], [inertia + half * c2, inertia]])
    force = np.array([
        2 * half * s2 * w1 * w2 + half * s2 * w2**2 - half * g * s1 - g * (s1 + half * s12),
        -half * s2 * w1**2 - half * g * s12 + u[0],
    ])  # fmt: skip
    return np.append(x[2:], np.linalg.solve(mass, force))


def product(one: Array, other: Array) -> Array:
    """The product of two quaternions."""
    vector = one[0] * other[1:] + other[0] * one[1:] + np.cross(one[1:], other[1:])
    return np.append(one[0] * other[0] - one[1:] @ other[1:], vector)


def quaternion(r: Array) -> Array:
    """The quaternion of a rotation vector."""
    angle = float(np.linalg.norm(r))
    return np.append(np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * r)


def rotated(q: Array, v: Array) -> Array:
    return v + 2 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)


def in_their_states(case: Case, states: Array) -> Array:
    """States of a `Case` or a plan, (..., n), as dynobench has them."""
    if case.model.radius is None:
        return states
    attitudes = np.apply_along_axis(quaternion, -1, states[..., 6:9])
    return np.concatenate([states[..., :3], attitudes, states[..., 3:6], states[..., 9:]], axis=-1)


def euler_step(case: Case, x: Array, u: Array) -> Array:
    """The next state by dynobench's Euler step: q exp(w dt) for an attitude q."""
    h, slope = case.model.period, rate(case.robot, x, u)
    after = x + h * slope
    if case.model.radius is not None:
        after[3:7] = product(x[3:7] / np.linalg.norm(x[3:7]), quaternion(h * x[10:]))
    return after


def distance(model: Model, x: Array, goal: Array) -> float:
    """dynobench's weighted distance of two states; angles are equal up to whole turns."""
    if model.radius is not None:
        apart = min(1.0, abs(float(x[3:7] @ goal[3:7])) / float(np.linalg.norm(x[3:7]) * np.linalg.norm(goal[3:7])))
        parts = [x[:3] - goal[:3], np.array([2 * np.arccos(apart)]), x[7:10] - goal[7:10], x[10:] - goal[10:]]
    else:
        parts = []
        for _, group in model.distance:
            names = group.split()
            places = [model.number(name) for name in names]
            part = x[places] - goal[places]
            parts.append(_wrapped(part) if model.states[names[0]] == "rad" else part)
    return float(sum(weight * np.linalg.norm(part) for (weight, _), part in zip(model.distance, parts, strict=True)))


def _wrapped(angle: Any) -> Any:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def frames(robot: str, x: Any, cos: Any = np.cos, sin: Any = np.sin) -> list[tuple[Any, Any, Any]]:
    """Of each box of a robot in the plane: x and y of its centre, and the angle of its long side."""
    if robot == "acrobot_v0":  # the pivot is the origin, and the first link hangs down at 0
        first, second = x[0] - np.pi / 2, x[0] + x[1] - np.pi / 2
        c, s, d, t = cos(first), sin(first), cos(second) / 2, sin(second) / 2
        return [(c / 2, s / 2, first), (c + d, s + t, second)]
    found = [(x[0], x[1], x[2])]
    if robot == "car1_v0":
        found.append((x[0] - cos(x[3]) / 2, x[1] - sin(x[3]) / 2, x[3]))
    if robot == "quad2dpole_v0":
        angle = x[2] + x[3] - np.pi / 2
        found.append((x[0] + cos(angle) / 2, x[1] + sin(angle) / 2, angle))
    return found


def clearances(case: Case, states: Array) -> Array:
    """Signed distance of the robot to the nearest obstacle at states (k, n), (k,); below 0 the depth in it."""
    if not len(case.boxes):
        return np.full(len(states), np.inf)
    if case.model.radius is not None:
        outside = np.abs(states[:, None, :3] - case.boxes[:, :3]) - case.boxes[:, 3:] / 2
        gaps = np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(outside.max(axis=-1), 0.0)
        return gaps.min(axis=-1) - case.model.radius
    corners = [_corners(x, y, 0.0, *size) for x, y, *size in case.boxes]
    return np.array([
        min(
            apart(_corners(*frame, *size), box)
            for frame, size in zip(frames(case.robot, x), case.model.boxes, strict=True)
            for box in corners
        )
        for x in states
    ])  # fmt: skip


def _corners(x: float, y: float, angle: float, length: float, width: float) -> Array:
    """The corners (4, 2) of a box in the plane."""
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.array([c, s]) * length / 2, np.array([-s, c]) * width / 2
    return np.array([x, y]) + np.array([along + across, across - along, -along - across, along - across])


def apart(one: Array, other: Array) -> float:
    """The distance of two boxes with these corners (4, 2); below 0 the least way out of each other."""
    gaps = []
    for box, points in ((one, other), (other, one)):
        sides = np.roll(box, -1, axis=0) - box
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1)[:, None]
        gaps.append(((points[None] - box[:, None]) * normals[:, None]).sum(axis=-1).min(axis=1).max())
    if max(gaps) <= 0.0:
        return float(max(gaps))
    return min(_to_sides(one, other), _to_sides(other, one))


def _to_sides(points: Array, box: Array) -> float:
    """The least distance of points (k, 2) to the sides of a box."""
    sides = np.roll(box, -1, axis=0) - box
    offset = points[:, None] - box
    share = np.clip((offset * sides).sum(axis=-1) / (sides**2).sum(axis=-1), 0.0, 1.0)
    return float(np.linalg.norm(offset - share[..., None] * sides, axis=-1).min())


def excess(case: Case, states: Array) -> float:
    """By how much states (k, n) exceed their bounds."""
    names = list(case.model.states)
    if case.model.radius is not None:
        names[3:9] = ["qw", "qx", "qy", "qz", "vx", "vy", "vz"]  # in place of vx vy vz rx ry rz
    bounded = [(names.index(name), low, high) for name, (low, high) in case.bounds.items()]
    worst = [max(float((low - states[:, i]).max()), float((states[:, i] - high).max())) for i, low, high in bounded]
    if case.robot == "car1_v0":
        worst.append(float(np.abs(_wrapped(states[:, 2] - states[:, 3])).max()) - STEEPEST)
    return max(0.0, *worst)


def _judged(case: Case, states: Array, controls: Array) -> dict[str, float]:
    limits = np.array([case.model.limits[name] for name in case.model.controls])
    return {
        "goal": distance(case.model, states[-1], in_their_states(case, case.goal)),
        "bounds": excess(case, states),
        "controls": max(0.0, float((limits[:, 0] - controls).max()), float((controls - limits[:, 1]).max())),
        "depth": max(0.0, float(-clearances(case, states).min())),
    }


def exactly(case: Case, controls: Array, dt: float) -> dict[str, float]:
    """What controls (T, m), held for dt, do in exact time, from the start and between the knots: see `RIGHT`."""
    x, states = in_their_states(case, case.start), []
    for u in controls:
        motion = solve_ivp(
            lambda _, z, u=u: rate(case.robot, z, u), (0.0, dt), x, method="DOP853", rtol=1e-9, atol=1e-11,
            t_eval=np.linspace(0.0, dt, TIMES + 1),
        ).y.T  # fmt: skip
        states.append(motion)
        x = motion[-1]
    return _judged(case, np.concatenate(states), controls)


def by_euler(case: Case, states: Array, controls: Array) -> dict[str, float]:
    """What dynobench's check finds of a plan in its states (T+1, n) and controls (T, m): see `ACCEPTED`."""
    jumps = [
        distance(case.model, euler_step(case, x, u), after)
        for x, u, after in zip(states[:-1], controls, states[1:], strict=True)
    ]
    began = distance(case.model, states[0], in_their_states(case, case.start))
    return _judged(case, states, controls) | {"jump": max(began, *jumps)}


def failures(found: dict[str, float], asked: dict[str, float]) -> Sequence[str]:
    """What is not as asked, in words."""
    return [f"{name} {found[name]:.2g}" for name, most in asked.items() if not found[name] <= most]

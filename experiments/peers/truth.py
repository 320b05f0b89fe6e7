"""What a plan or a run is worth, whoever made it: recomputed in NumPy, by formulas of this file alone.

It starts exactly at the problem's start, and there is no initial cost.
"""

from collections.abc import Callable, Sequence
from math import cos, sin, sqrt, tan

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from peers.common import parts

Rate = Callable[[Sequence[float], Sequence[float], dict[str, float]], list[float]]


def rollout(problem: ls.Problem, controls: Array) -> Array:
    """States (T+1, n) that the controls (T, m) lead to: one Runge-Kutta step each."""
    step = _step(problem)
    states = [np.array(parts(problem).start, dtype=float)]
    for control in np.asarray(controls).tolist():
        states.append(step(states[-1], control))
    return np.array(states)


def ahead(problem: ls.Problem, states: Array, controls: Array) -> Array:
    """Where one step takes each of the states (T, n) under its control (T, m)."""
    step = _step(problem)
    return np.array([step(x, control) for x, control in zip(states, np.asarray(controls).tolist(), strict=True)])


def _step(problem: ls.Problem) -> Callable[[Array, Sequence[float]], Array]:
    """A Runge-Kutta step of the problem's dynamics, from a state and a control."""
    told, h = parts(problem), problem.dt
    rate: Rate = _quadrotor if told.robot == ls.Quadrotor.name else _drive

    def step(x: Array, control: Sequence[float]) -> Array:
        def slope(z: Array) -> Array:
            return np.array(rate(z.tolist(), control, told.parameters))

        first = slope(x)
        second = slope(x + h / 2 * first)
        third = slope(x + h / 2 * second)
        fourth = slope(x + h * third)
        return x + h / 6 * (first + 2 * second + 2 * third + fourth)

    return step


def cost_of(problem: ls.Problem, controls: Array) -> float:
    """What the controls cost from exactly the start."""
    return cost_along(problem, rollout(problem, controls), controls)


def cost_along(problem: ls.Problem, states: Array, controls: Array) -> float:
    """What states (T+1, n) and controls (T, m) cost, of any number of steps, whether or not they belong together."""
    told = parts(problem)
    effort, miss = controls - told.nominal, states[-1] - told.goal
    place = list(problem.dynamics.state_coordinates.position)
    near = distances(told.world, states[1:-1, place]) - told.radius  # not where the start is given, nor at the end
    total = 0.5 * np.einsum("ti,ij,tj->", effort, told.control_weight, effort)
    total += told.obstacle_weight * np.exp(-told.sharpness * near).sum()
    return float(total + 0.5 * miss @ told.final_weight @ miss)


def clearance_of(problem: ls.Problem, states: Array) -> Array:
    """Metres from the robot's surface to the nearest obstacle, (T+1,) of states (T+1, n); below 0 inside."""
    told, place = parts(problem), list(problem.dynamics.state_coordinates.position)
    return distances(told.world, states[:, place]).min(axis=1, initial=np.inf) - told.radius


def distances(world: ls.World, points: Array) -> Array:
    """Signed distances in metres of points (P, 2 or 3) to all obstacles, (P, len(world))."""
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    found = np.empty((len(points), len(world)))
    for kind in {obstacle.kind for obstacle in world.obstacles}:
        which = [i for i, obstacle in enumerate(world.obstacles) if obstacle.kind == kind]
        some = [world.obstacles[i] for i in which]
        away = points[:, None] - np.array([obstacle.position for obstacle in some])
        local = np.einsum("oji,poj->poi", np.array([obstacle.rotation for obstacle in some]), away)
        size = np.array([obstacle.size for obstacle in some])
        side, height = np.hypot(local[..., 0], local[..., 1]), np.abs(local[..., 2])
        radius, half = size[:, 0], size[:, 1]
        match kind:
            case "plane":
                found[:, which] = local[..., 2]
            case "sphere":
                found[:, which] = np.linalg.norm(away, axis=-1) - radius
            case "capsule":
                found[:, which] = np.hypot(side, np.maximum(height - half, 0)) - radius
            case "cylinder":
                found[:, which] = _outside(np.stack([side - radius, height - half], axis=-1))
            case _:
                found[:, which] = _outside(np.abs(local) - size)
    return found


def _outside(beyond: Array) -> Array:
    """Distance to a convex body from how far a point is beyond each of its mutually perpendicular faces."""
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def _drive(x: Sequence[float], u: Sequence[float], p: dict[str, float]) -> list[float]:
    speed = (u[0] + u[1]) / 2
    return [speed * cos(x[2]), speed * sin(x[2]), (u[1] - u[0]) / p["axle_length"]]


def _quadrotor(x: Sequence[float], u: Sequence[float], p: dict[str, float]) -> list[float]:
    _, _, _, vx, vy, vz, a, b, c, wa, wb, wc = x
    s = a * a + b * b + c * c
    angle = sqrt(s)
    half = sin(angle / 2) / angle if angle > 0 else 0.5
    sine, cosine = (sin(angle) / angle if angle > 0 else 1.0), 2 * half * half  # of angle, over it; 1 - cos, over s
    if angle > 0.3:
        cotangent = (1 - angle / 2 / tan(angle / 2)) / s
    else:
        cotangent = 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s / 47900160)))
    # The body's z axis in the world, and r x w and r x (r x w).
    up = (cosine * a * c + sine * b, cosine * b * c - sine * a, 1 - cosine * (a * a + b * b))
    once = (b * wc - c * wb, c * wa - a * wc, a * wb - b * wa)
    twice = (b * once[2] - c * once[1], c * once[0] - a * once[2], a * once[1] - b * once[0])
    thrust, drag = sum(u) / p["mass"], p["drag"] / p["mass"]
    tilt, turn = p["arm"] / p["inertia"], p["torque_ratio"] / p["inertia"]
    return [
        vx, vy, vz,
        thrust * up[0] - drag * vx, thrust * up[1] - drag * vy, thrust * up[2] - drag * vz - p["gravity"],
        *(w + turned / 2 + cotangent * more for w, turned, more in zip((wa, wb, wc), once, twice, strict=True)),
        tilt * (u[1] - u[3]), tilt * (u[2] - u[0]), turn * (u[0] - u[1] + u[2] - u[3]),
    ]  # fmt: skip

"""Plans past obstacles and within bounds, looked at between their knots: as they are, and with between_knots=True.

    python experiments/between_knots.py                  # 100 problems, some minutes
    python experiments/between_knots.py --problems 1000
    python experiments/between_knots.py --quick          # 6 problems

A point in space goes past two balls and a capsule, a drive and a planar quadrotor past three balls, with bounded
speeds, half of them in least time, in 12 to 30 steps. Each plan is integrated by SciPy from knot to
knot, and its clearance and speeds are recomputed at 60 times within each period by NumPy alone. A plan that is
CONVERGED with between_knots=True and violates one of them by more than 1e-6 is a failure.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from runner import Result, Settings, at_most, opening, progress, run, table
from scipy.integrate import solve_ivp

import lqrsim as ls

Array = np.ndarray

TIMES = 60  # within each period
TOLERANCE = 1e-6  # of constraints, the default
RADIUS = 0.15  # of each robot, in m
SPEED = 1.5  # m/s


def point(x: Any, u: Any, p: Any) -> list[Any]:
    return [x.vx, x.vy, x.vz, u.ax, u.ay, u.az]


def drive(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [x.v * cos(x.heading), x.v * sin(x.heading), u.turn, u.force]


def quadrotor(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    thrust = u.left + u.right
    return [x.vx, x.vz, x.spin, -thrust * sin(x.tilt), thrust * cos(x.tilt) - 9.81, 8 * (u.right - u.left)]


@dataclass(frozen=True)
class Robot:
    """A robot.

    Attributes:
      dynamics: its first states are its position. bounded: the states whose speed is bounded.
      control_limits: of its controls. hover: its controls at rest.
    """

    dynamics: ls.Dynamics
    bounded: tuple[str, ...]
    control_limits: dict[str, tuple[float, float]]
    hover: Sequence[float]


ROBOTS = {
    "point": Robot(
        ls.Dynamics(
            point, states={"x": "m", "y": "m", "z": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s"},
            controls={"ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2"}, position=("x", "y", "z"),
        ),
        ("vx", "vy", "vz"), {"ax": (-2.0, 2.0), "ay": (-2.0, 2.0), "az": (-2.0, 2.0)}, [0.0, 0.0, 0.0],
    ),
    "drive": Robot(
        ls.Dynamics(
            drive, states={"x": "m", "y": "m", "heading": "rad", "v": "m/s"}, position=("x", "y"),
            controls={"turn": "rad/s", "force": "m/s^2"}, angles=("heading",),
        ),
        ("v",), {"turn": (-2.0, 2.0), "force": (-2.0, 2.0)}, [0.0, 0.0],
    ),
    "quadrotor": Robot(
        ls.Dynamics(
            quadrotor, states={"x": "m", "z": "m", "tilt": "rad", "vx": "m/s", "vz": "m/s", "spin": "rad/s"},
            controls={"left": "m/s^2", "right": "m/s^2"}, position=("x", "z"),
        ),
        ("vx", "vz"), {"left": (0.0, 10.0), "right": (0.0, 10.0)}, [4.905, 4.905],
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem, and the numbers that it is checked with.

    Attributes:
      robot: its name. problem: the problem, right at its knots.
      segments: (3, 2, 3) the axes of the obstacles, in m; those of balls are points. radii: (3,) in m.
    """

    robot: str
    problem: ls.Problem
    segments: Array
    radii: Array


def draw(number: int) -> Case:
    """The problem of that number."""
    rng = np.random.default_rng(number)
    name = list(ROBOTS)[number % len(ROBOTS)]
    robot, free = ROBOTS[name], bool(rng.random() < 0.5)
    space, n = robot.dynamics.state_coordinates, len(robot.dynamics.state_coordinates)
    distance, steps = rng.uniform(2.5, 4.0), int(rng.integers(12, 31))
    axes = [number for number, axis in enumerate("xyz") if axis in space.names]
    segments, radii = _obstacles(rng, distance, axes)
    obstacles = [_obstacle(i, *one) for i, one in enumerate(zip(segments, radii, strict=True))]
    goal = np.zeros(n)
    goal[0] = distance
    duration = distance / SPEED + 2.5
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=duration / steps, steps=steps, initial=ls.FixedState(np.zeros(n)),
        stage_cost=ls.ControlCost(np.full(len(robot.hover), 1e-4 if free else 1e-2), about=robot.hover),
        final_cost=ls.QuadraticCost(np.ones(n), about=goal), control_limits=robot.control_limits,
        constraints=[
            ls.GoalState(goal), ls.Clearance(ls.World(obstacles), radius=RADIUS),
            ls.StateBounds(dict.fromkeys(robot.bounded, (-SPEED, SPEED))),
        ],
        duration=(0.2 * duration, 4 * duration) if free else None, time_weight=1.0 if free else 0.0,
    )  # fmt: skip
    return Case(robot=name, problem=problem, segments=segments, radii=radii)


def _obstacles(rng: Generator, distance: float, axes: list[int]) -> tuple[Array, Array]:
    """Axes and radii of obstacles between start and goal, and clear of both, in the plane of these axes or in space."""
    while True:
        middle, along = np.zeros((3, 3)), np.zeros((3, 3))
        middle[:, axes] = rng.uniform(-0.6, 0.6, (3, len(axes)))
        middle[:, 0] = rng.uniform(0.2, 0.8, 3) * distance
        if len(axes) == 3:
            along[2] = rng.uniform(-0.4, 0.4, 3)
        segments, radii = np.stack([middle - along, middle + along], axis=1), rng.uniform(0.03, 0.35, 3)
        if clearance(np.array([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]]), segments, radii).min() > 0.1:
            return segments, radii


def _obstacle(number: int, segment: Array, radius: float) -> ls.Obstacle:
    """A capsule, or a ball if its axis is a point."""
    middle, along = segment.mean(axis=0), segment[1] - segment[0]
    length = float(np.linalg.norm(along))
    if not length:
        return ls.Obstacle(f"ball {number}", "sphere", middle, np.eye(3), np.array([radius, 0.0, 0.0]))
    rotation = np.linalg.qr(np.column_stack([along, np.eye(3)[:, :2]]))[0][:, [1, 2, 0]]
    rotation[:, 0] *= np.linalg.det(rotation)
    return ls.Obstacle(f"capsule {number}", "capsule", middle, rotation, np.array([radius, length / 2, 0.0]))


def clearance(places: Array, segments: Array, radii: Array) -> Array:
    """Distances (...) of a robot at places (..., 3) to the nearest obstacle, in m."""
    along = segments[:, 1] - segments[:, 0]
    square = np.maximum((along**2).sum(axis=1), 1e-300)
    offset = places[..., None, :] - segments[:, 0]
    share = np.clip((offset * along).sum(axis=-1) / square, 0.0, 1.0)
    away = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    return (away - radii - RADIUS).min(axis=-1)


def violation(case: Case, plan: ls.Trajectory) -> float:
    """The largest violation of clearance and speeds between the knots, in m and m/s, by SciPy and NumPy."""
    dynamics, worst = ROBOTS[case.robot].dynamics, 0.0
    names = dynamics.state_coordinates.names
    speeds, axes = [names.index(one) for one in ROBOTS[case.robot].bounded], ["xyz".find(one) for one in names]
    moved = [(at, axis) for at, axis in enumerate(axes) if axis >= 0]
    for x, u in zip(plan.states, plan.controls, strict=False):
        exact = solve_ivp(
            lambda _, z, u=u: dynamics.rate(z, u), (0.0, plan.dt), x, method="DOP853", rtol=1e-10, atol=1e-12,
            t_eval=np.linspace(0.0, plan.dt, TIMES),
        ).y.T  # fmt: skip
        places = np.zeros((TIMES, 3))
        for at, axis in moved:
            places[:, axis] = exact[:, at]
        missed = -clearance(places, case.segments, case.radii), np.abs(exact[:, speeds]).max(axis=1) - SPEED
        worst = max(worst, *(float(one.max()) for one in missed))
    return worst


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    problems: int = 100
    """Number of problems."""
    first: int = 0
    """Number of the first."""


def main(config: Config) -> Result:
    config = at_most(config, problems=6)
    rows: list[dict[str, Any]] = []
    for number in progress(range(config.first, config.first + config.problems), "problems"):
        case = draw(number)
        row: dict[str, Any] = {"number": number, "robot": case.robot, "free": case.problem.duration is not None}
        for name, problem in (("knots", case.problem), ("between", replace(case.problem, between_knots=True))):
            began = time.process_time()
            plan = ls.smooth(problem, threads=1)
            row[name] = {
                "status": plan.status.name, "seconds": time.process_time() - began, "detail": plan.detail,
                "violation": violation(case, plan.trajectory) if plan.success else None,
                "cost": plan.cost + problem.time_weight * plan.trajectory.horizon,
            }  # fmt: skip
        rows.append(row)
    return opening(config) | {"rows": rows}


def false(result: Result) -> list[int]:
    """The problems whose plan is CONVERGED with between_knots=True, and violates a constraint between the knots."""
    return [one["number"] for one in result["rows"] if (one["between"]["violation"] or 0.0) > TOLERANCE]


def report(result: Result) -> str:
    lines = []
    for name, label in (("knots", "as they are"), ("between", "between_knots=True")):
        found = [one[name] for one in result["rows"]]
        violations = [one["violation"] for one in found if one["violation"] is not None]
        lines.append([
            label, f"{len(violations)} of {len(found)}", sum(one > TOLERANCE for one in violations),
            f"{max(violations, default=0.0):.2g}", f"{np.median([one['seconds'] for one in found]):.2g}",
            f"{sum(one['seconds'] for one in found):.3g}",
        ])  # fmt: skip
    others = Counter(one["between"]["status"] for one in result["rows"] if one["between"]["violation"] is None)
    lost = [
        one["number"] for one in result["rows"]
        if one["knots"]["violation"] is not None and one["between"]["violation"] is None
    ]  # fmt: skip
    columns = ["", "CONVERGED", "violated between knots", "by at most", "median s", "all s"]
    text = table(columns, lines)
    text += f"\n\nWith between_knots=True other statuses are {dict(others)}; lost: {lost}; false: {false(result)}."
    return text


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=false)

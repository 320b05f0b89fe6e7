"""Safe plans in random worlds: whether those asked for a chance of collision of 1e-3 keep it, and what they cost."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from runner import progress, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.stress.statistics import rate
from robust.common import Config, run

ASKED = 1e-3
HALF = 3.0  # m, of the cube
# Of the obstacles' cost, in 1/m: it shows ways round, and beyond some centimetres it keeps nobody away.
SHARPNESS = 100.0
ROOM = 0.15  # m, at least, about a robot at its start and its goal
BARS = (4, 12)  # at least, and fewer than


def measure(config: Config) -> dict[str, Any]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in progress(range(config.worlds), "random worlds"):
            rng = np.random.default_rng([config.seed, number])
            scene = draw(rng, Path(folder) / f"world_{number}.xml")
            robot = ls.Quadrotor()
            start, goal = ends(rng, scene.world, robot.radius)
            rows.append(of_world(config, robot, scene, start, goal))
    solved = [row for row in rows if row["success"]]
    more = [row["cost"] / row["bare"] - 1 for row in solved if row["bare_solved"]]
    return {
        "worlds": len(rows), "trials": config.world_trials,
        "at_first": float(np.median([row["at_first"] for row in rows])),
        **{what: sum(row[what] for row in rows) for what in ("success", "kept", "below", "misses")},
        "collided": sum(row["collided"] for row in solved),
        "more": [float(np.quantile(more, share)) for share in (0.5, 0.9)] if more else None,
    }  # fmt: skip


def of_world(config: Config, robot: ls.Quadrotor, scene: ls.Scene, start: Array, goal: Array) -> dict[str, Any]:
    plant = ls.Plant(robot, scene)
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=1 / 30, steps=150, initial=ls.FixedState(start),
        stage_cost=ls.ControlCost(np.full(4, 20.0), about=np.full(4, robot.hover_force))
        + ls.ObstacleCost(scene.world, radius=robot.radius, sharpness=SHARPNESS),
        final_cost=ls.QuadraticCost(np.full(12, 500.0), about=goal),
        constraints=[ls.Clearance(scene.world, radius=robot.radius)],
    )  # fmt: skip
    disturbances = ls.disturbances.preset("light", plant)
    bare = ls.smooth(problem)  # which only keeps clear, and has no chance in mind
    safe = ls.smooth_chance_constrained(problem, ls.uncertainty_of(plant, disturbances), chance=ASKED)
    rollout = run(plant, safe.solution, safe.controller, disturbances, trials=config.world_trials, seed=config.seed)
    collided = int(np.isfinite(rollout.collided_at).sum())
    measured = rate(collided, config.world_trials)
    return {
        "success": safe.success, "bare_solved": bare.success, "bare": bare.cost, "cost": safe.cost,
        "misses": safe.solution.target.misses(robot.radius),  # the goal: the way there may be too narrow
        "at_first": safe.rounds[0][3], "collided": collided,
        # More often than asked, as surely as 95 %.
        "kept": safe.success and measured.low <= ASKED, "below": safe.success and measured.value <= ASKED,
    }  # fmt: skip


def draw(rng: Generator, file: Path) -> ls.Scene:
    """A cube with walls, floor and ceiling, and some bars along the axes, as MJCF."""
    walls = "".join(
        f'<geom name="wall_{axis}_{side:+}" type="plane" size="3 3 0.1" pos="{_text(side * HALF * np.eye(3)[axis])}"'
        f' zaxis="{_text(-side * np.eye(3)[axis])}"/>'
        for axis in range(3)
        for side in (-1, 1)
    )
    bars = "".join(
        f'<geom name="bar_{i}" type="cylinder" size="{rng.uniform(0.15, 0.45):.3f} {HALF}"'
        f' pos="{_text(rng.uniform(-2, 2, size=3))}" zaxis="{_text(np.eye(3)[rng.integers(3)])}"/>'
        for i in range(rng.integers(*BARS))
    )
    file.write_text(
        f'<mujoco model="{file.stem}"><include file="quadrotor.xml"/><compiler autolimits="true"/>'
        f"<worldbody>{walls}{bars}</worldbody></mujoco>\n",
        encoding="utf-8",
    )
    return ls.load_scene(file)


def _text(vector: Array) -> str:
    return " ".join(f"{value:.4g}" for value in vector)


def ends(rng: Generator, world: ls.World, radius: float) -> tuple[Array, Array]:
    """A start and a goal at rest, clear of everything, 3 m apart or more, and something in the way between them."""
    while True:
        places = rng.uniform(-2.5, 2.5, size=(2, 3))
        between = np.linspace(places[0], places[1], 100)
        nearest = world.distance(between)
        clear = min(nearest[0], nearest[-1]) > radius + ROOM
        if clear and nearest.min() < radius and np.linalg.norm(places[1] - places[0]) > 3:
            start, goal = np.zeros((2, 12))
            start[:3], goal[:3] = places
            return start, goal


def report(found: dict[str, Any]) -> list[str]:
    trials = found["trials"] * found["success"]
    share = f"{found['collided'] / trials:.1e}" if trials else "-"
    median, most = ([f"{100 * more:+.1f}" for more in found["more"]]) if found["more"] else ("-", "-")
    return [
        table((f"safe plans in random worlds, asked for {ASKED:g}", ""), [
            ["worlds, each with something between start and goal", found["worlds"]],
            ["predicted chance of collision of a plan that is only clear, median", f"{found['at_first']:.2g}"],
            ["a plan whose predicted chance is as asked", found["success"]],
            ["kept: not surely (95 %) more collisions than asked", found["kept"]],
            ["no more collisions than asked, of those", found["below"]],
            ["plans that stop short of the goal, for no way there is safe enough", found["misses"]],
            [f"share of collisions, {found['trials']} trials a world", share],
            ["cost against a plan that is only clear, median (%)", median],
            ["the same, of nine in ten at most (%)", most],
        ]),
    ]  # fmt: skip

"""Robots of MJCFs that others wrote: solved from rest without a guess, compared with iLQR, and run in the same MJCF.

    pip install 'lqrsim[models]'                    # dm_control, gymnasium and crazyflow bring the files
    python experiments/mjcf_robots.py               # all eleven, with pictures
    python experiments/mjcf_robots.py --only acrobot swimmer
    python experiments/mjcf_robots.py --quick       # a few iterations of each

`experiments/mjcf/tasks.py` says what each is to do. What is not installed is left out, and named.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mjcf.tasks import TASKS, Task
from paper.common import render_still
from PIL import Image
from runner import FIGURES, FolderSettings, Result, opening, progress, run, table

import lqrsim as ls

OUT = Path("runs/mjcf_robots")
TILE = 400, 225  # pixels of a picture on the sheet of all
WORSE, BETTER = 1.01, 0.99  # of iLQR's cost: from where a cost is worse, and below what it is better


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = OUT
    """Folder for the pictures, in a folder of that name."""
    only: tuple[str, ...] = ()
    """Names of robots, or words of them; by default all."""
    iterations: int = 300
    """At most, of each solver."""
    pictures: bool = True
    """Draw each run."""


def main(config: Config) -> Result:
    most = min(config.iterations, 2) if config.quick else config.iterations
    wanted = [task for task in TASKS if not config.only or any(word in task.name for word in config.only)]
    here = [task for task in wanted if task.path is not None]
    result = opening(config) | {"rows": [], "missing": [task.name for task in wanted if task not in here]}
    for task in progress(here, "robots"):
        result["rows"].append(of_task(config, task, most, result))
    if result["figures"]:
        sheet(config, result)
    return result


def sheet(config: Config, result: Result) -> None:
    """One sheet with all pictures."""
    folder, names, across = config.out / FIGURES, list(result["figures"]), 3
    pictures = [Image.open(folder / name).convert("RGB").resize(TILE, Image.Resampling.LANCZOS) for name in names]
    rows = -(-len(pictures) // across)
    whole = Image.new("RGB", (across * TILE[0], rows * TILE[1]), "white")
    for number, picture in enumerate(pictures):
        whole.paste(picture, (number % across * TILE[0], number // across * TILE[1]))
    whole.save(folder / "mjcf_robots.png", optimize=True)
    result["figures"].append("mjcf_robots.png")


def of_task(config: Config, task: Task, most: int, result: Result) -> dict[str, Any]:
    """Solve by both methods from the same start, and run the plan."""
    robot = task.robot()
    problem, plant = task.problem(robot), ls.Plant(robot, robot.scene)
    found, seconds = {}, {}
    for name, solve in (("smooth", ls.smooth), ("ilqr", ls.ilqr)):
        solve(problem, max_iterations=1)  # compiles
        clock = time.perf_counter()
        found[name] = solve(problem, max_iterations=most)
        seconds[name] = time.perf_counter() - clock
    solution, other = found["smooth"], found["ilqr"]
    rollout = ls.simulate(plant, solution)
    outcome = ls.stress.outcomes(rollout)
    row = {
        "name": task.name, "states": len(robot.dynamics.state_coordinates), "file": f"{task.package}/{task.file}",
        "controls": len(robot.dynamics.control_coordinates), "status": solution.status.name, "cost": solution.cost,
        "ilqr_cost": other.cost, "ilqr_status": other.status.name, "iterations": len(solution.iterations),
        "ms": float(np.median([1000 * one.seconds for one in solution.iterations])), "seconds": seconds["smooth"],
        "ilqr_seconds": seconds["ilqr"], "off": float(outcome.worst[0]), "unit": rollout.tracking_unit,
        "missed": {
            name: float(solution.trajectory.states[-1, i] - problem.goal[i])
            for i, name in enumerate(robot.dynamics.state_coordinates.names)
            if task.ends.get(name, 0) >= 10 and problem.goal is not None
        },
    }  # fmt: skip
    if config.pictures:
        (config.out / FIGURES).mkdir(parents=True, exist_ok=True)
        name = task.name.replace(" ", "_")
        camera = camera_of(robot)
        render_still(
            config, result, name, rollout, every=rollout.times[-1] / 8, camera=camera, overlays=("trace", "caption")
        )
    return row


def camera_of(robot: ls.MjcfRobot) -> str:
    """One of the scene's cameras."""
    model = robot.scene.model
    names = [model.camera(number).name for number in range(model.ncam)]
    return next((name for name in ("overview", "fixed", *names) if name in names), "overview")


def report(result: Result) -> str:
    rows, head = [], (
        "robot", "states", "controls", "status", "cost", "iLQR's cost", "iterations", "ms an iteration",
        "tracking error in MuJoCo", "farthest from the goal",
    )  # fmt: skip
    for row in result["rows"]:
        missed = max(row["missed"].items(), key=lambda pair: abs(pair[1]), default=("", 0.0))
        rows.append([
            row["name"], row["states"], row["controls"], row["status"], f"{row['cost']:.4g}",
            f"{row['ilqr_cost']:.4g}", row["iterations"], f"{row['ms']:.1f}", f"{row['off']:.1e} {row['unit']}",
            f"{missed[0]} {missed[1]:+.2g}",
        ])  # fmt: skip
    ratios = [row["cost"] / row["ilqr_cost"] for row in result["rows"]]
    lines = [table(head, rows), ""]
    lines.append(
        f"Cost not more than 1 % above iLQR's from the same start: {sum(one <= WORSE for one in ratios)} of"
        f" {len(ratios)}; at least 1 % below: {sum(one < BETTER for one in ratios)}."
    )
    if result["missing"]:
        lines.append(f"Not installed, and left out: {', '.join(result['missing'])}.")
    return "\n".join(lines)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

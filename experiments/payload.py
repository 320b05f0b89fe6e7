"""One kilogram in the hand that the plan does not know of: a law that tracks, and one that estimates the load.

    python experiments/payload.py --models models             # `experiments/mjcf/family.py` says how to get the files
    python experiments/payload.py --models models --only Panda --mass 2

Each arm goes from posture to posture as in `experiments/mjcf_robots.py --family`, with noise in what is measured. Both
laws have the same tolerances.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mjcf.family import FAMILY, FamilyTask
from runner import Result, Settings, opening, progress, run, table

import lqrsim as ls
from lqrsim.errors import Array

ARMS = ("Panda", "UR5e", "Kinova Gen3", "Sawyer", "Spot arm")
NOISE = {"rad": 1e-4, "rad/s": 1e-3}  # an encoder of 16 bits, and its differences


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: Path | None = None
    """Folder with unpacked packages, for those that are not installed."""
    only: tuple[str, ...] = ARMS
    """Names of robots."""
    mass: float = 1.0
    """Of the load, in kg."""
    time_limit: float = 120.0
    """Seconds of each solve at most."""
    trials: int = 10
    """Runs of each law."""
    tolerate: tuple[float, float] = (0.1, 1.0)
    """Tolerances of both laws, in rad and rad/s."""


def main(config: Config) -> Result:
    tasks = [task.found_in(config.models) for task in FAMILY if task.name in config.only]
    here = [task for task in tasks if task.path is not None]
    result = opening(config) | {"rows": [], "missing": [task.name for task in tasks if task not in here]}
    for task in progress(here[:1] if config.quick else here, "robots"):
        result["rows"].append(of_task(config, task))
    return result


def of_task(config: Config, task: FamilyTask) -> dict[str, Any]:
    """How far the hand is from the plan's end at the end, with each law."""
    robot = task.robot()
    problem, plant, hand = task.problem(robot), ls.Plant(robot, robot.scene), hand_of(robot)
    solution = ls.smooth(problem, time_limit=config.time_limit)
    units = robot.dynamics.state_coordinates.units
    noise = ls.disturbances.MeasurementNoise(tuple(NOISE[unit] for unit in units))
    met = [ls.disturbances.Payload(config.mass, hand), noise]
    uncertainty, tolerate = ls.uncertainty_of(plant, met), dict(zip(NOISE, config.tolerate, strict=True))
    laws: dict[str, Any] = {
        "smooth": None,
        "track": ls.track(problem, solution, tolerate=tolerate),
        "OffsetFree": ls.OffsetFree(problem, solution, uncertainty, tolerate=tolerate, record=True),
    }
    row = {"name": task.name, "hand": hand, "status": solution.status.name, "laws": {}}
    planned = place_of(robot, hand, solution.trajectory.states[-1])
    for name, law in laws.items():
        runs = ls.simulate(plant, solution, controller=law, disturbances=met, trials=config.trials, frames=False)
        off = [np.linalg.norm(place_of(robot, hand, last) - planned) for last in runs.states[:, -1]]
        joints = np.abs(
            runs.states[:, -1, : robot.scene.model.nv] - solution.trajectory.states[-1, : robot.scene.model.nv]
        )
        row["laws"][name] = {
            "mm": 1000 * float(np.median(off)), "mrad": 1000 * float(np.median(joints.max(axis=1))),
        }  # fmt: skip
        if name == "OffsetFree":
            row["estimate"] = float(np.median(runs.controller_run.estimates[-2, :, -1]))
    return row


def hand_of(robot: ls.MjcfRobot) -> str:
    """The last body of the chain that has mass."""
    model = robot.scene.model
    heavy = np.flatnonzero((model.body_treeid >= 0) & (model.body_mass > 0.01))
    return model.body(int(heavy[-1])).name


def place_of(robot: ls.MjcfRobot, body: str, state: Array) -> Array:
    """Where the body's centre of mass is, in m."""
    data = mujoco.MjData(robot.scene.model)
    data.qpos[:] = robot.configuration(state)[0]
    mujoco.mj_kinematics(robot.scene.model, data)
    return data.body(body).xipos.copy()


def report(result: Result) -> str:
    head = ("robot", "load on", "status", "smooth (mm)", "track (mm)", "OffsetFree (mm)", "estimated (kg)")
    rows = [
        [
            one["name"],
            one["hand"],
            one["status"],
            *(f"{law['mm']:.2g}" for law in one["laws"].values()),
            f"{one['estimate']:.3f}",
        ]
        for one in result["rows"]
    ]
    missing = f"\nNot installed, and left out: {', '.join(result['missing'])}." if result["missing"] else ""
    return "Hand from the plan's end, median of the runs:\n\n" + table(head, rows) + missing


if __name__ == "__main__":
    run(Config, main, report, __doc__)

"""Pictures of robots from MJCFs of this repository, each where it is at five times of its run in MuJoCo.

    python experiments/mjcf_pictures.py             # a minute
    python experiments/mjcf_pictures.py --quick     # two seconds each, small

An arm reaches past a shelf, a body with eight thrusters goes among pillars with a clearance of 0.15 m, a disc pushes a
box aside, and a gripper lifts a cube. The last two begin as `experiments/mjcf_contacts.py` says, with nothing touched.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mjcf_contacts
import mjcf_shelf
from mjcf.common import sheet
from mjcf.files import ARM, THRUSTERS
from paper.common import render_still
from runner import FIGURES, FolderSettings, Result, at_most, opening, progress, run

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

PUSHED, LIFTED = "aside", "a gripper lifts a cube"  # cases of mjcf_contacts
TIMES = 5  # at which a robot is drawn


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/mjcf_pictures")
    """Folder for the pictures, in a folder of that name."""
    time_limit: float = 15.0
    """Seconds of each solve at most, without compiling."""


def main(config: Config) -> Result:
    config = at_most(config, time_limit=2.0)
    result: Result = opening(config) | {"statuses": {}}
    (config.out / FIGURES).mkdir(parents=True, exist_ok=True)
    for name, robot, problem in progress(list(stated()), "pictures"):
        solution = ls.smooth(problem, time_limit=config.time_limit)
        result["statuses"][name] = solution.status.name
        with warnings.catch_warnings(action="ignore"):
            rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)
        render_still(
            config, result, name.replace(" ", "_"), rollout, every=problem.steps * problem.dt / (TIMES - 1),
            overlays=("trace",),
        )  # fmt: skip
    if result["figures"]:
        pictures = [config.out / FIGURES / name for name in result["figures"]]
        result["figures"].append("mjcf_own.png")
        sheet(pictures, config.out / FIGURES / "mjcf_own.png", across=2)
    return result


def stated() -> Iterator[tuple[str, ls.MjcfRobot, ls.Problem]]:
    """Names, robots and what they are to do."""
    options = mjcf_shelf.Config()
    arm, turned, goal = mjcf_shelf.by_a_shelf("arm", ARM, "hand", options.steps)
    yield "an arm reaches past a shelf", arm, mjcf_shelf.to_pose(options, arm, turned[0], "hand", goal)
    body = ls.MjcfRobot(scene_from_xml(THRUSTERS, "thrusters"))
    there = body.at(rov_x=5.0, rov_y=0.3, rov_z=1.4)
    yield "eight thrusters among pillars", body, body.problem(body.at(), there, steps=80, dt=0.1, clearance=0.15)
    names = {PUSHED: "a disc pushes a box aside", LIFTED: LIFTED}
    for case in mjcf_contacts.CASES:
        if case.name in names:
            yield names[case.name], *mjcf_contacts.stated(case)


def report(result: Result) -> str:
    return "\n".join(f"{name}: {status}" for name, status in result["statuses"].items())


if __name__ == "__main__":
    run(Config, main, report, __doc__)

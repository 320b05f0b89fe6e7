"""The hand of an arm from an MJCF, from one compartment of a shelf over the divider to a pose in the next, with a
clearance, and the run of the plan in MuJoCo on the file as it is, with the shelf in it.

    python experiments/mjcf_shelf.py                                # an arm of this repository
    python experiments/mjcf_shelf.py --models panda.xml iiwa14.xml  # any arms that first turn about the vertical
    python experiments/mjcf_shelf.py --quick

A plan starts at rest in the first keyframe of the file that has a name, and the shelf is built about the hand, a site.
The pose is that of the hand after one radian of the first joint alone, a way on which it hits the divider. The solver
is told the pose, and no posture. Processor time includes making the problem; a solve before it compiles.
"""

import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mjcf.common import least_distance, pose, pose_error, without_friction
from mjcf.files import ARM
from runner import Result, Settings, opening, progress, run, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.scene import scene_from_xml

WAY = 1.0  # rad of the first joint
BENT = {"b": -0.8, "c": 1.6, "e": 0.8}  # rad, of this repository's arm: its hand points downwards
BELOW, ABOVE = 0.2, 0.06  # m from the hand down to the floor of the shelf, and up to the top of its divider
DEEP, THIN, ASIDE = 0.15, 0.01, 0.12  # m, half of its depth and of its boards' thickness; its floor beyond the hand
BOARDS = "floor of the shelf", "divider"
WEIGHTS = 1e3, 1e2  # of the hand's error, 1/m^2 and 1/rad^2, to come near; velocities at the end have the second


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = ()
    """MJCFs of arms; by default one in this repository."""
    site: str = "attachment_site"
    """The hand, in these files."""
    clearance: float = 0.02
    """In m, from all boards."""
    steps: int = 100
    """Control periods of a plan, of about 20 ms each."""
    damping: float = 0.1
    """Weight of the velocities of joints. A servo's control is a place, which costs next to nothing: with a small
    weight, only limits of forces keep a plan slow."""
    time_limit: float = 60.0
    """Seconds for each plan."""
    frictionless: bool = False
    """Plan without the dry friction of joints. Runs have it."""


def main(config: Config) -> Result:
    arms = [(path.stem, MjcfModel.of_file(path).xml, config.site) for path in config.models]
    result = opening(config)
    result["rows"] = [reached(config, *arm) for arm in progress(arms or [("arm of six hinges", ARM, "hand")], "arms")]
    return result


def reached(config: Config, name: str, xml: str, site: str) -> Result:
    """A plan to the pose, the clearance that it keeps, and those of its run."""
    robot, turned, goal = by_a_shelf(name, xml, site, config.steps)
    start, nv = turned[0], robot.scene.model.nv
    limits: dict[str, Any] = {"max_iterations": 3} if config.quick else {"time_limit": config.time_limit}
    ls.smooth(to_pose(config, robot, start, site, goal), max_iterations=1, threads=1)  # which compiles
    clock = time.process_time()
    solution = ls.smooth(to_pose(config, robot, start, site, goal), threads=1, **limits)
    seconds = time.process_time() - clock
    with warnings.catch_warnings(action="ignore"):
        rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)
    states = rollout.states[0, : config.steps + 1]
    return {
        "name": name, "status": solution.status.name, "detail": solution.detail, "seconds": seconds,
        "iterations": len(solution.iterations), "violation": solution.violation,
        "straight": least_distance(robot, turned), "planned": least_distance(robot, solution.trajectory.states),
        "run": least_distance(robot, states), "missed": pose_error(robot, states[-1], site, goal),
        "off": float(np.abs(states - solution.trajectory.states)[:, :nv].max()),
    }  # fmt: skip


def by_a_shelf(name: str, xml: str, site: str, steps: int) -> tuple[ls.MjcfRobot, Array, tuple[Array, Array]]:
    """The arm by its shelf, states (steps+1, n) of its first joint's way alone, and the pose at their end."""
    bare = ls.MjcfRobot(scene_from_xml(xml, name, obstacles=False))
    model = bare.scene.model
    keyframe = next((model.key(i).name for i in range(model.nkey) if model.key(i).name), None)
    start = bare.at(None, **BENT) if xml == ARM else bare.at(keyframe)
    start[model.nv : 2 * model.nv] = 0.0
    turned = start + WAY * np.linspace(0, 1, steps + 1)[:, None] * np.eye(len(start))[0]
    whole = xml.replace("</mujoco>", shelf(pose(bare, start, site)[0]) + "</mujoco>")
    robot = ls.MjcfRobot(scene_from_xml(whole, name, obstacles=BOARDS))
    return robot, turned, pose(bare, turned[-1], site)


def shelf(hand: Array) -> str:
    """A floor below the way of the hand, as MJCF, and a divider in the middle of it, which is as high as it."""
    radius, heading = np.hypot(*hand[:2]), np.arctan2(hand[1], hand[0]) + WAY / 2
    x, y = radius * np.cos(heading), radius * np.sin(heading)
    wide, high = radius * np.sin(WAY / 2) + ASIDE, (ABOVE + BELOW) / 2
    sizes = (hand[2] - BELOW - THIN, wide, THIN), (hand[2] - BELOW + high, THIN, high)
    turn = f"{np.cos(heading / 2)} 0 0 {np.sin(heading / 2)}"
    geoms = "".join(
        f'<geom name="{name}" type="box" pos="{x} {y} {z}" quat="{turn}" size="{DEEP} {aside} {up}" contype="1"'
        ' conaffinity="1" rgba=".2 .4 .6 1"/>' for name, (z, aside, up) in zip(BOARDS, sizes, strict=True)
    )  # fmt: skip
    return f"<worldbody>{geoms}</worldbody>"


def to_pose(config: Config, robot: ls.MjcfRobot, start: Array, site: str, goal: tuple[Array, Array]) -> ls.Problem:
    """From the start to a pose of a site, at rest there."""
    nv, (place, turn), weights = robot.scene.model.nv, goal, np.zeros(len(start))
    weights[nv : 2 * nv] = WEIGHTS[1]
    problem = robot.problem(
        start, start, steps=config.steps, dt=robot.dynamics.period_near(0.02), weights=weights, damping=config.damping,
        clearance=config.clearance,
    )  # fmt: skip
    drawn = ls.SiteCost(site, position=place, orientation=turn, weight=WEIGHTS[0], turn_weight=WEIGHTS[1])
    exact = ls.SiteConstraint(site, position=place, orientation=turn)
    problem = replace(problem, final_cost=problem.final_cost + drawn, constraints=[*problem.constraints, exact])
    return without_friction(problem) if config.frictionless else problem


def report(result: Result) -> str:
    head = (
        "arm", "status", "iterations", "processor (s)", "by the first joint alone (mm)", "plan's clearance (mm)",
        "run's (mm)", "hand off its pose in the run", "run off the plan (rad)",
    )  # fmt: skip
    return table(head, [
        [one["name"], one["status"], one["iterations"], f"{one['seconds']:.1f}", f"{1e3 * one['straight']:.0f}",
         f"{1e3 * one['planned']:.1f}", f"{1e3 * one['run']:.1f}",
         f"{1e3 * one['missed'][0]:.2g} mm, {one['missed'][1]:.1g} rad", f"{one['off']:.0e}"]
        for one in result["rows"]
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)

"""Bodies that nothing touches at the start: pushed, kicked and picked up by `smooth` from nothing, and run by MuJoCo.

    python experiments/mjcf_contacts.py             # some minutes
    python experiments/mjcf_contacts.py --quick     # four iterations each

The goal weighs the body's place alone, and its weight is such that to move it pays. How far the body comes is measured
with MuJoCo's own steps from the plan's controls.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mjcf.files import DISC, FOREARM, GRIPPER, LEG
from runner import FolderSettings, Result, opening, run, table

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

DT, WEIGHT = 0.02, 1000.0  # s; 1/m^2


@dataclass(frozen=True, kw_only=True)
class Case:
    """A file, by how much its body is to move (3,), positions of joints, number of steps, weight of the controls."""

    name: str
    xml: str
    way: tuple[float, float, float]
    at: tuple[tuple[str, float], ...] = ()
    steps: int = 50
    effort: float = 1 / 400


CASES = (
    Case(name="a disc pushes a box ahead", xml=DISC, way=(0.2, 0.0, 0.0)),
    Case(name="aside", xml=DISC, way=(0.0, 0.2, 0.0)),
    Case(name="towards itself", xml=DISC, way=(-0.2, 0.0, 0.0)),
    Case(name="at an angle", xml=DISC, way=(0.15, 0.15, 0.0)),
    Case(name="an arm pushes a puck away", xml=FOREARM, way=(0.0, 0.15, 0.0), at=(("b", 0.8),)),
    Case(name="towards itself, round it", xml=FOREARM, way=(0.0, -0.15, 0.0), at=(("a", -0.6), ("b", 0.8))),
    Case(name="a foot kicks a ball", xml=LEG, way=(1.0, 0.0, 0.0), at=(("hip", 0.3), ("knee", 0.3)), effort=1e-4),
    Case(name="a gripper lifts a cube", xml=GRIPPER, way=(0.0, 0.0, 0.15), steps=60),
    Case(name="from 8 cm aside", xml=GRIPPER.replace("0 0 0.35", "-0.08 0 0.35"), way=(0.0, 0.0, 0.15), steps=60),
)


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    time_limit: float = 15.0
    """Seconds of each solve at most, without compiling."""


def main(config: Config) -> Result:
    result = opening(config)
    result["rows"] = [solved(case, config) for case in CASES]
    return result


def stated(case: Case) -> tuple[ls.MjcfRobot, ls.Problem]:
    """The robot, and the problem that weighs the place of the body alone."""
    robot = ls.MjcfRobot(scene_from_xml(case.xml, "contacts"))
    start, space = robot.at_rest(robot.at(None, **dict(case.at))), robot.dynamics.control_coordinates
    names = robot.dynamics.state_coordinates.names
    weighed = {f"body_{axis}": way for axis, way in zip("xyz", case.way, strict=True) if way}
    ends = {name: start[names.index(name)] + way for name, way in weighed.items()}
    return robot, ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=case.steps, initial=ls.FixedState(start),
        stage_cost=ls.ControlCost([case.effort] * len(space)), control_limits=(space.low, space.high),
        final_cost=ls.QuadraticCost(dict.fromkeys(ends, WEIGHT), about=ends),
    )  # fmt: skip


def solved(case: Case, config: Config) -> dict[str, Any]:
    """A plan from nothing, and how far MuJoCo's steps from its controls take the body."""
    robot, problem = stated(case)
    limits: dict[str, Any] = {"max_iterations": 4} if config.quick else {"time_limit": config.time_limit}
    solution = ls.smooth(problem, **limits)
    rest = 0.5 * WEIGHT * float(np.dot(case.way, case.way))
    return {
        "case": case.name, "status": solution.status.name, "rest": rest, "cost": solution.cost,
        "way": float(np.linalg.norm(case.way)), "off": missed(robot, case, solution),
    }  # fmt: skip


def missed(robot: ls.MjcfRobot, case: Case, solution: ls.Solution) -> float:
    """By how much the body misses its goal, in m, with MuJoCo's own steps on the file as it is."""
    model = mujoco.MjModel.from_xml_string(robot.scene.xml)
    data, plan = mujoco.MjData(model), solution.trajectory
    data.qpos[:], data.qvel[:] = robot.configuration(plan.states[0])
    mujoco.mj_forward(model, data)
    goal = data.body("body").xpos + case.way
    for control in plan.controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, round(DT / model.opt.timestep))
    return float(np.linalg.norm((data.body("body").xpos - goal)[np.abs(case.way) > 0]))


def report(result: Result) -> str:
    rows = [
        [one["case"], f"{one['way']:.2f} m", f"{one['off']:.3f} m", one["status"], f"{one['cost']:.2f}",
         f"{one['rest']:.1f}"]
        for one in result["rows"]
    ]  # fmt: skip
    return table(("from nothing", "way", "missed by", "status", "cost", "cost of standing still"), rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

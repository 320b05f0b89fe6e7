"""A crane whose load hangs on a rope, a tendon that only pulls: what plans converge, by how the winch is modelled.

    python experiments/mjcf_crane.py             # some minutes
    python experiments/mjcf_crane.py --quick     # ten iterations each

The load moves with its cart by 1 m, and is lifted by 0.4 m or lowered by 0.5 m, in 3 s. The rope without a winch is a
tendon with a largest length; its load is only moved.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from runner import FolderSettings, Result, opening, run, table

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

MOVED, LIFTED = 1.0, (0.4, -0.5)  # m
SERVO = '<position name="winch" tendon="rope" kp="2000" kv="100" ctrlrange="0.3 1.9" {}/>'
WINCHES = {
    "a rope of 1 m, no winch": "",
    "a motor, -60 to 0 N": '<motor name="winch" tendon="rope" ctrlrange="-60 0"/>',
    "a servo with a lag of 0.1 s, -60 to 0 N": SERVO.format('forcerange="-60 0" timeconst="0.1"'),
    "a servo, -60 to 60 N": SERVO.format('forcerange="-60 60"'),
    "a servo, any force": SERVO.format(""),
    "a servo, -60 to 0 N": SERVO.format('forcerange="-60 0"'),
}
LOADS = {
    "in the plane": '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>',
    "in space": '<freejoint name="load"/>',
}
CRANE = """
<mujoco model="crane">
  <option timestep="0.005" integrator="implicitfast"/>
  <compiler autolimits="true"/>
  <worldbody>
    <body name="cart" pos="0 0 2"><joint name="cart" type="slide" axis="1 0 0" range="-3 3" damping="1"/>
      <geom type="box" size="0.15 0.1 0.08" mass="2" contype="0" conaffinity="0"/><site name="hook"/></body>
    <body name="load" pos="0 0 1">{joints}
      <geom type="sphere" size="0.08" mass="1" contype="0" conaffinity="0"/><site name="top"/></body>
  </worldbody>
  <tendon><spatial name="rope" range="0 {length}"><site site="hook"/><site site="top"/></spatial></tendon>
  <actuator><motor name="push" joint="cart" ctrlrange="-20 20"/>{winch}</actuator>
</mujoco>"""


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    iterations: int = 150
    """At most, of each solve."""
    loads: tuple[Literal["in the plane", "in space"], ...] = ("in the plane", "in space")
    """How the load can move."""


def main(config: Config) -> Result:
    result, most = opening(config), 10 if config.quick else config.iterations
    result["rows"] = [
        solved(winch, load, lifted, most)
        for winch, lifts in ((name, LIFTED if name != next(iter(WINCHES)) else (0.0,)) for name in WINCHES)
        for load in config.loads
        for lifted in lifts
    ]
    return result


def solved(winch: str, load: str, lifted: float, most: int) -> dict[str, Any]:
    """A plan from hanging at rest to hanging at rest, and its run."""
    length = 1.9 if WINCHES[winch] else 1.0
    robot = ls.MjcfRobot(scene_from_xml(CRANE.format(joints=LOADS[load], length=length, winch=WINCHES[winch]), "crane"))
    start, names = robot.at_rest(robot.at()), robot.dynamics.state_coordinates.names
    goal = start.copy()
    for name in ("cart", "x", "load_x"):
        goal[[i for i, one in enumerate(names) if one == name]] += MOVED
    for name in ("z", "load_z"):
        goal[[i for i, one in enumerate(names) if one == name]] += lifted
    if "winch_activation" in names:
        goal[names.index("winch_activation")] = robot.hold(goal)[1]
    solution = ls.smooth(robot.problem(start, goal, steps=150), max_iterations=most)
    ran = ls.simulate(ls.Plant(robot, robot.scene), solution)
    off = (solution.trajectory.states[-1] - goal)[: robot.scene.model.nv]
    return {
        "winch": winch, "load": load, "lifted": lifted, "status": solution.status.name,
        "iterations": len(solution.iterations), "cost": solution.cost, "off": float(np.abs(off).max()),
        "outcome": ran.outcome[0],
    }  # fmt: skip


def report(result: Result) -> str:
    rows = [
        [one["winch"], one["load"], f"{one['lifted']:+g} m" if one["lifted"] else "0", one["status"],
         one["iterations"], f"{one['cost']:.4g}", f"{one['off']:.3f} m", one["outcome"]]
        for one in result["rows"]
    ]  # fmt: skip
    head = ("winch", "load", "lifted by", "status", "iterations", "cost", "off the goal", "run")
    return table(head, rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

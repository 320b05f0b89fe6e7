"""The command that controls a robot through ROS 2 messages, or simulates such a robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import Json, optional, options_of, stated


@dataclass(frozen=True, kw_only=True)
@options_of("bridge.py", "run", seconds="SECONDS", lost_after="SECONDS", patience="SECONDS", domain="NUMBER")
class Bridge:
    """Run a policy on a robot, by messages of ROS 2; needs lqrsim[ros].

    Reads states from an Odometry or a JointState and publishes a Float64MultiArray in each control period. The safe
    command is published last: at the end, if states stay away, on an error and on Ctrl-C. docs/bridge.md describes
    units, frames and reactions to events. Exits with 1 if it had to stop early.

      lqrsim bridge runs/quadrotor/solution.npz --odometry /odom --commands /rotors/commands --safe 0 0 0 0
      lqrsim bridge runs/quadrotor/solution.npz --odometry /odom --commands /rotors/commands --robot  # in place of it
    """

    policy: Annotated[Positional[Path], arg(metavar="POLICY.npz")]
    """A file from `lqrsim solve`, or a policy from `ls.save`: of ls.track, or of ls.OffsetFree with its filter."""
    commands: Annotated[str, arg(metavar="TOPIC")]
    """Topic of the commands, a std_msgs/msg/Float64MultiArray."""
    odometry: Annotated[str | None, optional("TOPIC", "Topic of the states, a nav_msgs/msg/Odometry.")] = None
    joints: Annotated[str | None, optional("TOPIC", "Topic of the states, a sensor_msgs/msg/JointState.")] = None
    names: Annotated[tuple[str, ...], optional("STATE=NAME ...")] = ()
    """Names of states in the messages, where they differ: theta=heading."""
    safe: Annotated[tuple[float, ...], optional("CONTROL ...")] = ()
    """The command for a robot that nobody controls any more: one number for each control. There is no default."""
    lockstep: FlagCreatePairsOff[bool] = False
    """Run a control period for each state that arrives, and not by the clock: for simulations."""
    robot: FlagCreatePairsOff[bool] = False
    """Be the robot: MuJoCo runs the solution's scenario with the commands that arrive."""
    scenario: Annotated[str | None, optional("SCENARIO", "With --robot, as in `lqrsim simulate`.")] = None
    json: Json = False

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim import bridge

        pairs = [pair.partition("=") for pair in self.names]
        if any(not (state and equals and name) for state, equals, name in pairs):
            raise ls.InputError(f"--names: got {' '.join(self.names)}, want pairs such as theta=heading")
        names = {state: name for state, _, name in pairs}
        if self.robot:
            return self._be_robot(names)
        if not self.safe:
            raise ls.InputError("--safe: got none, want the command for a robot that nobody controls, such as 0 0 0 0")
        policy: Any = ls.load(self.policy)
        ran = bridge.run(policy, **stated(self, bridge.run, names=names))
        console.say(ran.summary())
        numbers = {"held": ran.held, "refused": ran.refused[0], "response": ran.response, "late": ran.late}
        console.result(periods=len(ran.commands), completed=ran.completed, reason=ran.reason, **numbers)
        return 0 if ran.completed else 1

    def _be_robot(self, names: dict[str, str]) -> int:
        from lqrsim import bridge

        solution, scenario = console.load_with_scenario(self.policy, self.scenario)
        with bridge.SimulatedRobot(solution, **stated(self, bridge.SimulatedRobot, names=names)) as robot:
            rollout = ls.simulate(scenario.plant(), solution, controller=robot, **scenario.near_enough())
        console.say(rollout.summary())
        console.say(robot.summary())
        console.result(outcome=rollout.outcome, round_trips=robot.round_trips)
        return 0 if rollout.outcome == ("reached",) else 1

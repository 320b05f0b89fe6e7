"""What each robot is to do: from rest, without a hint and without a derivative, with the limits of its actuators.

The MJCFs are read from where their packages are installed (`pip install 'lqrsim[models]'`). Nothing of them is copied.
"""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from mjcf.crazyflie import SCALE, crazyflie_in_cage


@dataclass(frozen=True, kw_only=True)
class Task:
    """A robot, and what it is to do.

    Attributes:
      name: of it. package, file: the MJCF in that installed package.
      start, goal: states by name, the rest as the MJCF has them. ends: what misses at the end cost, by state, 0 for
        those that are not named. effort: of the controls. dt: the control period in s. steps: how many.
    """

    name: str
    package: str
    file: str
    goal: Mapping[str, float]
    ends: Mapping[str, float]
    effort: float
    dt: float
    steps: int
    start: Mapping[str, float] = field(default_factory=dict)

    @property
    def path(self) -> Path | None:
        """Where the MJCF is; None if its package is not installed."""
        found = importlib.util.find_spec(self.package)
        if found is None or not found.submodule_search_locations:
            return None
        return Path(next(iter(found.submodule_search_locations))) / self.file

    def robot(self) -> ls.MjcfRobot:
        """The robot, in its scene."""
        assert self.path is not None
        return ls.MjcfRobot(self.path)

    def problem(self, robot: ls.MjcfRobot) -> ls.Problem:
        """From rest at the start to the goal."""
        space, m = robot.dynamics.control_coordinates, len(robot.dynamics.control_coordinates)
        return ls.Problem(
            dynamics=robot.dynamics, dt=self.dt, steps=self.steps, initial=ls.FixedState(robot.at(None, **self.start)),
            stage_cost=ls.ControlCost(np.full(m, self.effort)),
            final_cost=ls.QuadraticCost(self.weights(robot), about=robot.at(None, **self.goal)),
            control_limits=(space.low, space.high),
        )  # fmt: skip

    def weights(self, robot: ls.MjcfRobot) -> Array:
        """Of the states at the end, (n,)."""
        return np.array([self.ends.get(name, 0.0) for name in robot.dynamics.state_coordinates.names])


class CrazyflieTask(Task):
    """A flight through the cage, scaled to the robot's size, with its beams in the cost."""

    def robot(self) -> ls.MjcfRobot:
        assert self.path is not None
        return ls.MjcfRobot(crazyflie_in_cage(self.path))

    def problem(self, robot: ls.MjcfRobot) -> ls.Problem:
        bare = super().problem(robot)
        hover = 9.81 * float(robot.scene.model.body_mass.sum()) / 4
        obstacles = ls.ObstacleCost(robot.scene.world, radius=robot.radius, sharpness=10.0 / SCALE)
        return ls.Problem(
            dynamics=bare.dynamics, dt=bare.dt, steps=bare.steps, initial=bare.initial, final_cost=bare.final_cost,
            stage_cost=ls.ControlCost(np.full(4, self.effort), about=np.full(4, hover)) + obstacles,
            control_limits=bare.control_limits,
        )  # fmt: skip


DM, GYM = "dm_control", "gymnasium"
ASSETS = "envs/mujoco/assets/"


TASKS: tuple[Task, ...] = (
    Task(
        name="cart-pole swing-up", package=DM, file="suite/cartpole.xml", start={"hinge_1": np.pi}, goal={},
        ends={"slider": 100, "hinge_1": 100, "slider_velocity": 100, "hinge_1_velocity": 100},
        effort=0.1, dt=0.02, steps=150,
    ),
    Task(
        name="pendulum", package=DM, file="suite/pendulum.xml", start={"hinge": np.pi}, goal={},
        ends={"hinge": 100, "hinge_velocity": 100}, effort=0.1, dt=0.04, steps=150,
    ),
    Task(
        name="acrobot", package=DM, file="suite/acrobot.xml", start={"shoulder": np.pi}, goal={},
        ends={"shoulder": 100, "elbow": 100, "shoulder_velocity": 10, "elbow_velocity": 10},
        effort=0.1, dt=0.04, steps=150,
    ),
    Task(
        name="double inverted pendulum", package=GYM, file=ASSETS + "inverted_double_pendulum.xml",
        start={"hinge": np.pi}, goal={},
        ends={"slider": 100, "hinge": 100, "hinge2": 100, "slider_velocity": 10, "hinge_velocity": 10,
              "hinge2_velocity": 10},
        effort=0.1, dt=0.02, steps=200,
    ),
    Task(
        name="reacher", package=DM, file="suite/reacher.xml", goal={"shoulder": 2.0, "wrist": -1.0},
        ends={"shoulder": 100, "wrist": 100, "shoulder_velocity": 1, "wrist_velocity": 1}, effort=0.1, dt=0.02,
        steps=100,
    ),
    Task(
        name="swimmer", package=GYM, file=ASSETS + "swimmer.xml", goal={"slider1": 1.0}, ends={"slider1": 100},
        effort=0.01, dt=0.04, steps=100,
    ),
    Task(
        name="point mass", package=DM, file="suite/point_mass.xml", start={"root_x": -0.2, "root_y": -0.2},
        goal={"root_x": 0.2, "root_y": 0.2},
        ends={"root_x": 100, "root_y": 100, "root_x_velocity": 100, "root_y_velocity": 100}, effort=0.001, dt=0.02,
        steps=200,
    ),
    Task(
        name="ball in cup", package=DM, file="suite/ball_in_cup.xml", goal={"ball_z": 0.3},
        ends={"cup_x": 1, "cup_z": 1, "ball_x": 100, "ball_z": 100, "ball_x_velocity": 1, "ball_z_velocity": 1},
        effort=0.01, dt=0.02, steps=75,
    ),
    Task(
        name="hopper", package=DM, file="suite/hopper.xml", goal={"rootx": 0.5},
        ends={"rootx": 100, "rootz": 10, "rooty": 10}, effort=0.01, dt=0.02, steps=50,
    ),
    Task(
        name="half-cheetah", package=GYM, file=ASSETS + "half_cheetah.xml", start={"rootz": -0.1},
        goal={"rootx": 1.0},
        ends={"rootx": 100, "rootz": 1, "rooty": 1, "rootx_velocity": 0.1, "rootz_velocity": 0.1,
              "rooty_velocity": 0.1},
        effort=0.01, dt=0.02, steps=75,
    ),
    CrazyflieTask(
        name="Crazyflie through the cage", package="crazyflow", file="drones/cf2x_L250.xml",
        start={"x": -0.55, "y": -0.55, "z": -0.55}, goal={"x": 0.55, "y": 0.55, "z": 0.55},
        ends={"x": 500, "y": 500, "z": 500, "rx": 5, "ry": 5, "rz": 5, "vx": 50, "vy": 50, "vz": 50, "wx": 0.5,
              "wy": 0.5, "wz": 0.5},
        effort=200.0, dt=0.02, steps=150,
    ),
)  # fmt: skip

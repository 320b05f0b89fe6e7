"""A scenario in a file of its own: a point mass that passes a crate, pushed by a force of unknown size.

The force is drawn once for each trial. The exact dynamics are those of a `Simulator` that takes no time to compile.
"""

OWN = """
from dataclasses import dataclass
from functools import cached_property

import numpy as np

import lqrsim as ls
from lqrsim.disturbances import ControlOffset
from lqrsim.simulators import Simulator
from lqrsim.templates.my_robot.my_robot import MJCF, MyRobot, rate


@dataclass(frozen=True)
class Euler(Simulator):
    name = "Euler"
    timestep = 0.02
    weight = 5.0

    def start(self, states, factors, timestep):
        return np.array(states)

    def step(self, simulations, controls, wrench, wind, steps):
        for _ in range(steps):
            force = controls - 0.2 * simulations[:, 2:]
            simulations[:, :2] += 0.02 * simulations[:, 2:]
            simulations[:, 2:] += 0.02 * force / 0.5

    def states(self, simulations):
        return simulations


@dataclass(frozen=True)
class Pushed(MyRobot):
    limit: float = 2.0  # N

    @cached_property
    def dynamics(self):
        states = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
        return ls.Dynamics(
            rate, states=states, controls={"push_x": "N", "push_y": "N"}, position=("x", "y"),
            parameters={"mass": self.mass, "damping": self.damping}, disturbances={"force_x": 0.0, "force_y": 0.0},
            control_limits=(-self.limit, self.limit),
        )


def told(offset: float = 0.25, pillar: bool = True, near: bool = False, limit: float = 2.0) -> ls.Scenario:
    robot, scene = MyRobot() if limit == 2.0 else Pushed(limit=limit), ls.load_scene(MJCF)
    world = scene.world if pillar else ls.World([one for one in scene.world.obstacles if one.name != "pillar"])
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.1, steps=24, initial=ls.FixedState((-1.0, 0.3, 0.0, 0.0)),
        stage_cost=ls.ControlCost((1.0, 1.0)) + ls.ObstacleCost(world, radius=robot.radius, sharpness=100.0),
        final_cost=ls.QuadraticCost((5000.0,) * 4, about=(1.0, 0.4, 0.0, 0.0)),
        constraints=[ls.GoalState({"x": -0.42, "y": 0.1})] if near else [],  # 0.02 m from the crate
    )
    return ls.Scenario(
        name="told", summary="past a crate", robot=robot, scene=scene, problem=problem, tracking_bound=0.1,
        disturbances=(ControlOffset((offset, offset)),), simulator=Euler(),
    )
"""

"""The robot my_robot: a disc that two motors push over a table, and its task.

Change the MJCF, the dynamics and the scenario to those of your robot; `test_my_robot.py` tells whether they agree.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls

MJCF = Path(__file__).parent / "my_robot.xml"


def rate(x: Any, u: Any, p: Any) -> list[Any]:
    """The rate of the state under a control."""
    force_x = u.push_x + p.force_x - p.damping * x.vx
    force_y = u.push_y + p.force_y - p.damping * x.vy
    return [x.vx, x.vy, force_x / p.mass, force_y / p.mass]


@dataclass(frozen=True)
class MyRobot(ls.Robot):
    """Its constants, its dynamics, and its names in the MJCF.

    Args:
      mass: in kg. damping: of the joints, in N s/m. radius: of its collision circle, in m.
    """

    mass: float = 0.5
    damping: float = 0.2
    radius: float = 0.1

    name = "my_robot"
    body = "my_robot"
    joints = ("slide_x", "slide_y")
    actuators = ("push_x", "push_y")

    @cached_property  # it is read often
    def dynamics(self) -> ls.Dynamics:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The model that plans are made with; lqrsim derives the derivatives of the rate."""
        return ls.Dynamics(
            rate,
            states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
            controls={"push_x": "N", "push_y": "N"},
            parameters={"mass": self.mass, "damping": self.damping},
            disturbances={"force_x": 0.0, "force_y": 0.0},  # the forces of ForceNoise, for predictions and estimates
            position=("x", "y"),
            control_limits=(-2.0, 2.0),
        )

    def state(self, qpos: Any, qvel: Any, near: Any = None) -> np.ndarray:
        """The state (..., 4) of MuJoCo's joint positions (..., 2) and velocities (..., 2)."""
        return np.concatenate([qpos, qvel], axis=-1)

    def configuration(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """MuJoCo's joint positions (..., 2) and velocities (..., 2) of the state (..., 4)."""
        state = np.asarray(state, dtype=np.float64)
        return state[..., :2], state[..., 2:]


def scenario(goal_x: float = 1.2, goal_y: float = 0.3) -> ls.Scenario:
    """From the left of the crate to a goal on its right, in metres."""
    robot, scene = MyRobot(), ls.load_scene(MJCF)
    problem = ls.Problem(
        dynamics=robot.dynamics,
        dt=0.05,
        steps=80,
        initial=ls.FixedState((-1.0, 0.0, 0.0, 0.0)),
        stage_cost=ls.ControlCost((1.0, 1.0)) + ls.ObstacleCost(scene.world, radius=robot.radius),
        final_cost=ls.QuadraticCost((5000.0,) * 4, about=(goal_x, goal_y, 0.0, 0.0)),  # larger ends nearer to the goal
        constraints=[ls.Clearance(scene.world, radius=robot.radius, margin=0.02)],
        between_knots=True,  # not only at its knots does the plan keep clear
    )
    return ls.Scenario(
        name="my_robot",
        summary="a disc round a crate",
        robot=robot,
        scene=scene,
        problem=problem,
        tracking_bound=1e-3,
        disturbances=(
            ls.disturbances.ControlNoise(0.05),
            ls.disturbances.ForceNoise((0.05, 0.05, 0.0)),
            ls.disturbances.MeasurementNoise((0.005, 0.005, 0.02, 0.02)),
        ),
    )

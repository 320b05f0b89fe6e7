"""The iRobot Create: two wheels, driven by their speeds. Paper: Sec. VI-A."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Positive, checked
from lqrsim.errors import Array, vectors_of
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.base import Robot, configuration_of


@checked
@dataclass(frozen=True)
class DifferentialDrive(Robot):
    """State: (x, y, heading) of the middle of the axle. Control: speed of the left and the right wheel.

    Lengths are in m. MJCF: models/create.xml.

    Attributes:
      max_speed: largest speed of a wheel's rim in m/s, in either direction.
      wheel_radius: radius of a wheel in m; also the height of the axle.
    """

    axle_length: Positive = 0.258
    radius: Positive = 0.17
    max_speed: Positive = 0.5
    wheel_radius: Positive = 0.036

    name = "differential_drive"
    body = "create"
    joints = ("create_base", "create_wheel_left", "create_wheel_right")
    actuators = ("create_wheel_left", "create_wheel_right")
    wheels = ("create_tread_left", "create_tread_right")

    @cached_property
    def dynamics(self) -> Dynamics:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Dynamics(
            _rate,
            states={"x": "m", "y": "m", "heading": "rad"},
            controls={"left": "m/s", "right": "m/s"},
            parameters={"axle_length": self.axle_length},
            position=("x", "y"),
            angles=("heading",),
            control_limits=(-self.max_speed, self.max_speed),
        )

    def state(self, qpos: npt.ArrayLike, qvel: npt.ArrayLike, near: npt.ArrayLike | None = None) -> Array:
        qpos, _ = configuration_of(qpos, qvel, 9, 8)
        qw, qx, qy, qz = np.moveaxis(qpos[..., 3:7], -1, 0)
        heading = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        state = np.concatenate([qpos[..., :2], heading[..., None]], axis=-1)
        return state if near is None else self.dynamics.state_coordinates.nearest(state, near)

    def configuration(self, state: npt.ArrayLike) -> tuple[Array, Array]:
        """The qpos (..., 9) and qvel (..., 8) at rest in states (..., 3), wheels on a floor at height zero."""
        state = vectors_of("state", state, 3)
        qpos = np.zeros((*state.shape[:-1], 9))
        qpos[..., :2] = state[..., :2]
        qpos[..., 2] = self.wheel_radius
        qpos[..., 3] = np.cos(state[..., 2] / 2)
        qpos[..., 6] = np.sin(state[..., 2] / 2)
        return qpos, np.zeros((*state.shape[:-1], 8))


def _rate(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    _, _, heading = x
    left, right = u
    speed = (left + right) / 2
    return [speed * cos(heading), speed * sin(heading), (right - left) / p.axle_length]

"""The robots of the paper, which are the packaged ones. To add one, add a class here and its MJCF in models/."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import rotations
from lqrsim.annotations import NonNegative, Positive, checked
from lqrsim.errors import Array, check_number, vectors_of
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.base import Robot, configuration_of


@checked
@dataclass(frozen=True)
class DifferentialDrive(Robot):
    """The iRobot Create: two wheels, driven by their speeds. Paper: Sec. VI-A.

    State: (x, y, heading) of the middle of the axle. Control: speed of the left and the right wheel.

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
            _drive_rate,
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


def _drive_rate(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    _, _, heading = x
    left, right = u
    speed = (left + right) / 2
    return [speed * cos(heading), speed * sin(heading), (right - left) / p.axle_length]


@checked
@dataclass(frozen=True)
class Quadrotor(Robot):
    """A quadrotor, driven by the forces of its rotors. Paper: Sec. VI-B.

    State: position, velocity in world axes, rotation vector, angular velocity in body axes. Control: rotor forces.

    Rotor 1 is at +x, 2 at +y, 3 at -x, 4 at -y of the body. Numbers are in kg, m, s and N. MJCF: models/quadrotor.xml.

    Attributes:
      inertia: moment of inertia about each axis in kg m^2.
      yaw_inertia: moment of inertia about the body's z axis in kg m^2, if it differs; else None.
      arm: distance from the centre of mass to a rotor in m.
      torque_ratio: drag torque of a rotor in N m per N of its force; the paper's k_m.
      drag: linear drag against the velocity in N s/m; the paper's k_v.
    """

    mass: Positive = 0.5
    inertia: Positive = 0.05
    arm: Positive = 0.17
    torque_ratio: NonNegative = 0.025
    drag: NonNegative = 0.15
    gravity: NonNegative = 9.8
    max_force: Positive = 3.71
    radius: Positive = 0.3
    yaw_inertia: Positive | None = None
    min_force: NonNegative = 0.0

    name = "quadrotor"
    body = "quadrotor"
    joints = ("quadrotor_x", "quadrotor_y", "quadrotor_z", "quadrotor_rotation")
    actuators = ("quadrotor_rotor_1", "quadrotor_rotor_2", "quadrotor_rotor_3", "quadrotor_rotor_4")

    def __post_init__(self) -> None:
        check_number("Quadrotor: min_force", self.min_force, below=self.max_force)

    @property
    def hover_force(self) -> float:
        """The force of each rotor in hover, in N: a quarter of the weight."""
        return self.mass * self.gravity / 4

    @cached_property
    def dynamics(self) -> Dynamics:  # pyright: ignore[reportIncompatibleMethodOverride]
        units = {"x y z": "m", "vx vy vz": "m/s", "rx ry rz": "rad", "wx wy wz": "rad/s"}
        constants = ("mass", "inertia", "arm", "torque_ratio", "drag", "gravity")
        if self.yaw_inertia is not None:
            constants += ("yaw_inertia",)
        return Dynamics(
            _quadrotor_rate if self.yaw_inertia is None else _quadrotor_rate_with_two_inertias,
            states={name: unit for names, unit in units.items() for name in names.split()},
            controls={f"rotor_{i}": "N" for i in (1, 2, 3, 4)},
            parameters={name: getattr(self, name) for name in constants},
            disturbances={f"{kind}_{axis}": 0.0 for kind in ("wind", "force", "torque") for axis in "xyz"},
            position=("x", "y", "z"),
            rotation_vectors=(("rx", "ry", "rz"),),
            control_limits=(self.min_force, self.max_force),
        )

    def state(self, qpos: npt.ArrayLike, qvel: npt.ArrayLike, near: npt.ArrayLike | None = None) -> Array:
        qpos, qvel = configuration_of(qpos, qvel, 7, 6)
        rotation = rotations.rotation_vector(qpos[..., 3:7])
        state = np.concatenate([qpos[..., :3], qvel[..., :3], rotation, qvel[..., 3:6]], axis=-1)
        return state if near is None else self.dynamics.state_coordinates.nearest(state, near)

    def configuration(self, state: npt.ArrayLike) -> tuple[Array, Array]:
        state = vectors_of("state", state, 12)
        position, velocity, rotation, angular_velocity = np.split(state, 4, axis=-1)
        qpos = np.concatenate([position, rotations.quaternion(rotation)], axis=-1)
        return qpos, np.concatenate([velocity, angular_velocity], axis=-1)


def _quadrotor_rate_with_two_inertias(x: Any, u: Any, p: Any) -> list[Any]:
    """As `_quadrotor_rate`, with J = diag(inertia, inertia, yaw_inertia) and the gyroscopic torque -w x J w."""
    *rate, x_rate, y_rate, z_rate = _quadrotor_rate(x, u, p)
    gyroscopic = (p.yaw_inertia - p.inertia) / p.inertia * x[11]
    return [*rate, x_rate - gyroscopic * x[10], y_rate + gyroscopic * x[9], z_rate * p.inertia / p.yaw_inertia]


def _quadrotor_rate(x: Any, u: Any, p: Any) -> list[Any]:
    velocity, rotation, w = x[3:6], x[6:9], x[9:12]
    thrust = rotations.rotate(rotation, [0, 0, sum(u)])
    wind, force, push = ([getattr(p, f"{name}_{axis}") for axis in "xyz"] for name in ("wind", "force", "torque"))
    acceleration = [(thrust[i] + force[i] - p.drag * (velocity[i] - wind[i])) / p.mass for i in range(3)]
    acceleration[2] -= p.gravity
    # The inertia is the same about each axis, so the gyroscopic term w x J w is zero.
    torque = [p.arm * (u[1] - u[3]), p.arm * (u[2] - u[0]), p.torque_ratio * (u[0] - u[1] + u[2] - u[3])]
    turned = rotations.rotate([-angle for angle in rotation], push)  # in the body's axes
    torque = [own + pushed for own, pushed in zip(torque, turned, strict=True)]
    return [*velocity, *acceleration, *rotations.vector_rate(rotation, w), *(t / p.inertia for t in torque)]

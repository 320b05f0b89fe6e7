"""RotorPy's SE(3) controller, which flies the plan of a quadrotor's solution.

The law is `rotorpy.controllers.quadrotor_control.SE3Control`, as its wheel has it, after Lee, Leok and McClamroch
(2010): a PD law on the position asks for a force, another on the attitude turns the body there. It is told our
quadrotor's mass, inertia, rotors and gravity. Of the plan it reads position, velocity, acceleration, yaw and its rate,
and neither jerk nor snap: the body rates that it wants are zero, but for that of yaw. Its mixer gives the rotors'
forces, and each is cut off at its limits by itself, as RotorPy's `Multirotor` cuts off speeds.

The law is asked as `simulate` asks, once a control period, and what it says is held in between; RotorPy's own
simulation asks it at 100 Hz, and `simulate` has no way to.

The law multiplies its gains by mass and inertia, so they are not of one vehicle: 1/s2 on position and attitude, 1/s on
their rates. But DEFAULT suits 100 Hz and rotors that answer at once. At a control period h a rate gain above 2 / h =
60 1/s is unstable even with nothing else in the loop, and the default is 57; and our rotors can turn the body at no
more than 12.6 rad/s2, which the default asks for at an error of 0.04 rad. The others are what the coarse search of
`experiments/rotorpy_gains.py` found best: what reaches the goal undisturbed, and in most of 100 trials of that preset,
other ones than those of its table. The law filters nothing: the higher the gains, the more of the measurements' noise
goes into the rotors, up to their limits.
"""

import importlib
from dataclasses import astuple, dataclass
from functools import cache
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim import rotations
from lqrsim.control.controllers import Controller, ControllerRun
from lqrsim.errors import Array
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from peers.common import Unavailable


@dataclass(frozen=True)
class Gains:
    """Of position and velocity, along the world's axes, of the attitude and of the angular velocity."""

    position: tuple[float, float, float]  # 1/s2
    velocity: tuple[float, float, float]  # 1/s
    attitude: float  # 1/s2
    rate: float  # 1/s


DEFAULT = Gains((6.5, 6.5, 15.0), (4.0, 4.0, 9.0), 310.0, 57.0)
BEST_AT_LIGHT = Gains((15.0, 15.0, 15.0), (4.65, 4.65, 6.97), 100.0, 20.0)
BEST_AT_MODERATE = Gains((10.0, 10.0, 8.0), (3.79, 3.79, 3.39), 60.0, 15.49)  # with feed_drag


class RotorPy(Controller):
    """The law, along a plan. It has no memory: one instance serves all trials, one after the other.

    Args:
      robot: whose plan it is. solution: with the plan.
      gains: see the module. feed_drag: whether the plan's acceleration has the drag added that the plan's velocity
        brings, of which the law knows nothing, so that undisturbed the rotors are asked for the plan's thrust.

    Raises:
      Unavailable: RotorPy is not installed.
    """

    def __init__(
        self, robot: ls.Quadrotor, solution: ls.Solution, gains: Gains = BEST_AT_LIGHT, *, feed_drag: bool = False
    ) -> None:
        self._law = _se3_control()(vehicle(robot))
        self._law.g = robot.gravity
        self._law.kp_pos, self._law.kd_pos = np.array(gains.position), np.array(gains.velocity)
        self._law.kp_att, self._law.kd_att = gains.attitude, gains.rate
        self._coordinates = robot.dynamics.state_coordinates, robot.dynamics.control_coordinates
        self._outputs = flat_outputs(robot, solution.trajectory, feed_drag=feed_drag)
        self._dt = solution.trajectory.dt
        self._digest = sha256(f"{robot} {self._dt} {astuple(gains)} {feed_drag}", *self._outputs.values())[:16]

    def start(self, trials: int) -> ControllerRun:
        return self._Run(self)

    class _Run(ControllerRun):
        def __init__(self, of: "RotorPy") -> None:
            self._law, self._dt, self._limits = of._law, of._dt, of.coordinates[1]
            rows = zip(*of._outputs.values(), strict=True)
            self._wanted = [dict(zip(of._outputs, row, strict=True)) for row in rows]

        def control(self, step: int, measured: Array) -> Array:
            wanted = self._wanted[min(step, len(self._wanted) - 1)]
            attitudes = np.roll(rotations.quaternion(measured[:, 6:9]), -1, axis=1)  # RotorPy's have the scalar last
            forces = np.empty((len(measured), 4))
            for trial, (state, attitude) in enumerate(zip(measured, attitudes, strict=True)):
                seen = {"x": state[:3], "v": state[3:6], "q": attitude, "w": state[9:12]}
                forces[trial] = self._law.update(step * self._dt, seen, wanted)["cmd_motor_thrusts"]
            return self._limits.clip(forces)

    @property
    def digest(self) -> str:
        return self._digest

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self._coordinates


def vehicle(robot: ls.Quadrotor) -> dict[str, Any]:
    """What RotorPy calls `quad_params`, of our quadrotor.

    The rotors' speeds are the roots of their forces, as if the coefficient of thrust were 1. The law makes no use of
    what is zero here.
    """
    unused = ("Ixy", "Ixz", "Iyz", "c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_flap", "tau_m")
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    return dict.fromkeys(unused, 0.0) | {
        "mass": robot.mass,
        **dict.fromkeys(("Ixx", "Iyy"), robot.inertia),
        "Izz": robot.inertia if robot.yaw_inertia is None else robot.yaw_inertia,
        "num_rotors": 4,
        "rotor_pos": {f"r{i + 1}": robot.arm * corner for i, corner in enumerate(corners)},
        "rotor_directions": np.array([1, -1, 1, -1]),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": np.sqrt(robot.max_force),
        "k_eta": 1.0,
        "k_m": robot.torque_ratio,
    }


def flat_outputs(robot: ls.Quadrotor, plan: ls.Trajectory, *, feed_drag: bool) -> dict[str, Array]:
    """What RotorPy's laws are told at each of the T steps of a plan, by RotorPy's names: (T, 3) or (T,).

    The acceleration is that of the dynamics at the beginning of the step. Yaw is that of which the law makes the plan's
    attitude again: the direction of the body's y axis, seen from above, less a quarter turn.
    """
    states, turns = plan.states[:-1], np.array([rotations.rotate(r, np.eye(3)[1]) for r in plan.states[:, 6:9]])
    yaw = np.unwrap(np.arctan2(-turns[:, 0], turns[:, 1]))
    rates = np.array([robot.dynamics.rate(x, u) for x, u in zip(states, plan.controls, strict=True)])
    drag = robot.drag / robot.mass * states[:, 3:6]
    return {
        "x": states[:, :3],
        "x_dot": states[:, 3:6],
        "x_ddot": rates[:, 3:6] + drag if feed_drag else rates[:, 3:6],
        "yaw": yaw[:-1],
        "yaw_dot": np.diff(yaw) / plan.dt,
    }


@cache
def _se3_control() -> Any:
    try:
        return importlib.import_module("rotorpy.controllers.quadrotor_control").SE3Control
    except ImportError:
        raise Unavailable("RotorPy is not installed: pip install 'lqrsim[bench]'") from None

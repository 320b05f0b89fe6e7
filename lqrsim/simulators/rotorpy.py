"""RotorPy's vehicles as plants: its rotors with their lag, its drag on body and rotors, and its wind."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lqrsim.annotations import Positive, checked
from lqrsim.errors import Array, InputError, check_array, check_kind, check_number, excerpt, keep
from lqrsim.machine import versions_of
from lqrsim.robots.base import Robot
from lqrsim.robots.packaged import Quadrotor
from lqrsim.simulation.simulator import PARAMETERS, Simulator
from lqrsim.simulators.quadrotors import Frame, package

GRAVITY = 9.81  # m/s2, RotorPy's
POSITIVE = ("mass", "Ixx", "Iyy", "Izz", "k_eta", "k_m", "rotor_speed_max")  # numbers of a vehicle


@checked
@dataclass(frozen=True)
class RotorPy(Simulator):
    """RotorPy's `Multirotor` for each trial: `Plant(simulator.quadrotor(), scene, simulator)`.

    A control is the force of a rotor. The speed of the rotor follows the speed for this force, with the vehicle's lag.
    A factor of the thrust acts through the speed. Rotors begin at hover speed. There is no ground.

    Args:
      vehicle: RotorPy's `quad_params`, or a name: "hummingbird", "crazyflie", or another NAME with a module NAME_params
        in `rotorpy.vehicles`.
      timestep: timestep in s; within it, RotorPy's integrator chooses its own steps.
    """

    vehicle: str | Mapping[str, Any] = "hummingbird"
    timestep: Positive = 0.01

    name = "RotorPy"
    parameters = PARAMETERS
    wind = True

    def __post_init__(self) -> None:
        vehicle = self.vehicle
        if isinstance(vehicle, str):
            package("rotorpy", "rotorpy")
            try:
                vehicle = package(f"rotorpy.vehicles.{vehicle}_params", "rotorpy").quad_params
            except (InputError, AttributeError):
                wanted = "'hummingbird', 'crazyflie' or its quad_params"
                raise InputError(f"RotorPy: vehicle: got {excerpt(vehicle)}, want {wanted}") from None
        if not isinstance(vehicle, Mapping):
            raise InputError(f"RotorPy: vehicle: got {excerpt(vehicle)}, want a name, or RotorPy's quad_params")
        if missing := [key for key in (*POSITIVE, "rotor_pos", "rotor_directions") if key not in vehicle]:
            raise InputError(f"RotorPy: vehicle: got a dict without {', '.join(missing)}, want RotorPy's quad_params")
        for key in POSITIVE:
            check_number(f"RotorPy: vehicle: {key}", vehicle[key], above=0.0)
        for key in ("rotor_speed_min", "k_d"):
            check_number(f"RotorPy: vehicle: {key}", vehicle.get(key, 0.0), at_least=0.0)
        if noise := check_number("RotorPy: vehicle: motor_noise_std", vehicle.get("motor_noise_std", 0.0)):
            # Its generator is shared by all trials.
            raise InputError(f"RotorPy: vehicle: got motor_noise_std {noise:g}, want 0, and ControlNoise instead")
        keep(self, vehicle=dict(vehicle))
        _ = self._frame

    @cached_property
    def _frame(self) -> Frame:
        named = check_kind("RotorPy: vehicle: rotor_pos", self._numbers["rotor_pos"], Mapping, "name -> place")
        places = check_array("RotorPy: vehicle: rotor_pos", [*named.values()], (4, 3))
        turning = check_array("RotorPy: vehicle: rotor_directions", self._numbers["rotor_directions"], (4,))
        return Frame.of("RotorPy: vehicle", places, turning)

    @property
    def _numbers(self) -> Mapping[str, Any]:
        assert not isinstance(self.vehicle, str)
        return self.vehicle

    @property
    def weight(self) -> float:
        return self._numbers["mass"] * GRAVITY

    @property
    def hover_speed(self) -> float:
        """The speed of each rotor in rad/s at which the rotors carry the weight."""
        return float(np.sqrt(self.weight / 4 / self._numbers["k_eta"]))

    @property
    def versions(self) -> dict[str, str]:
        return versions_of("rotorpy", "scipy")

    def quadrotor(self, **changes: Any) -> Quadrotor:
        """A model with the vehicle's numbers, but for changes of fields, such as a fitted drag.

        The drag is the drag of the rotors at hover speed, across their axes. The inertia about the level axes is their
        mean.
        """
        parameters = self._numbers
        numbers = {
            "mass": parameters["mass"], "inertia": (parameters["Ixx"] + parameters["Iyy"]) / 2,
            "yaw_inertia": parameters["Izz"], "arm": self._frame.arm,
            "torque_ratio": parameters["k_m"] / parameters["k_eta"], "gravity": GRAVITY,
            "drag": 4 * self.hover_speed * parameters.get("k_d", 0.0),
            "max_force": parameters["k_eta"] * parameters["rotor_speed_max"] ** 2,
            "min_force": parameters["k_eta"] * parameters.get("rotor_speed_min", 0.0) ** 2,
        }  # fmt: skip
        return Quadrotor(**numbers | changes)

    def check(self, robot: Robot) -> None:
        check_kind("RotorPy: robot", robot, Quadrotor, "a Quadrotor, such as simulator.quadrotor()")

    def start(self, states: Array, factors: Mapping[str, Array], timestep: float) -> "_Vehicles":
        kind, vehicles = pushed_multirotor(), list[Any]()
        for trial in range(len(states)):
            vehicle = kind(copy.deepcopy(dict(self._numbers)))
            vehicle.mass = vehicle.mass * float(factors["mass"][trial, 0]) if "mass" in factors else vehicle.mass
            vehicle.weight = np.array([0.0, 0.0, -vehicle.mass * vehicle.g])
            if "inertia" in factors:
                vehicle.inertia = vehicle.inertia * factors["inertia"][trial, 0]
                vehicle.inv_inertia = np.linalg.inv(vehicle.inertia)
            if "thrust" in factors:
                vehicle.rotor_speed_max *= np.sqrt(max(factors["thrust"][trial].max(), 1.0))
            vehicles.append(vehicle)
        gain = np.sqrt(factors.get("thrust", np.ones((len(states), 4))) / self._numbers["k_eta"])
        simulations = _Vehicles(
            vehicles, [{"rotor_speeds": np.full(4, self.hover_speed)} for _ in states], gain, timestep
        )
        self.place(simulations, states)
        return simulations

    def step(self, simulations: "_Vehicles", controls: Array, wrench: Array, wind: Array, steps: int) -> None:
        speeds = np.empty_like(controls)
        speeds[:, self._frame.order] = np.sqrt(controls) * simulations.gain
        for trial, (vehicle, state) in enumerate(zip(simulations.vehicles, simulations.states, strict=True)):
            if not all(np.isfinite(part).all() for part in state.values()):
                continue
            state["wind"], vehicle.pushed = wind[trial], wrench[trial]
            command = {"cmd_motor_speeds": speeds[trial]}
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    for _ in range(steps):
                        state = vehicle.step(state, command, simulations.timestep)
            except (ValueError, FloatingPointError):  # numbers that overflowed
                state = state | {"x": np.full(3, np.nan)}
            simulations.states[trial] = state

    def states(self, simulations: "_Vehicles") -> Array:
        states = simulations.states
        return self._frame.ours(*(np.array([state[key] for state in states]) for key in ("x", "v", "q", "w")))

    def place(self, simulations: "_Vehicles", states: Array) -> None:
        for state, x, v, q, w in zip(simulations.states, *self._frame.theirs(states), strict=True):
            state |= {"x": x.copy(), "v": v.copy(), "q": q, "w": w}


@dataclass(frozen=True, eq=False)
class _Vehicles:
    """For each of K trials a `Multirotor`, and its state in RotorPy's form."""

    vehicles: list[Any]
    states: list[dict[str, Any]]
    gain: Array  # (K, 4), speed in rad/s of our rotors at a force of 1 N, which grows with the root of the force
    timestep: float


def pushed_multirotor() -> Any:
    """RotorPy's `Multirotor` with a force in N and a torque in N m on it, along the world's axes."""
    base = package("rotorpy.vehicles.multirotor", "rotorpy").Multirotor

    class Pushed(base):
        pushed = np.zeros(6)

        def _s_dot_fn(self, t: float, s: Array, cmd_rotor_speeds: Array) -> Array:
            rate = super()._s_dot_fn(t, s, cmd_rotor_speeds)
            rate[3:6] += self.pushed[:3] / self.mass
            if self.pushed[3:].any():
                rate[10:13] += self.inv_inertia @ Rotation.from_quat(s[6:10]).as_matrix().T @ self.pushed[3:]
            return rate

    return Pushed

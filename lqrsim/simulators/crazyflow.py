"""crazyflow's identified Crazyflies as plants: their thrust curves, rotor lag and momentum, and drag."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import OneOf, Positive, checked
from lqrsim.errors import Array, InputError, check_kind
from lqrsim.machine import versions_of
from lqrsim.robots.base import Robot
from lqrsim.robots.packaged import Quadrotor
from lqrsim.simulation.simulator import PARAMETERS, Simulator
from lqrsim.simulators.quadrotors import Frame, package

DRONES = ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350")
INTEGRATORS = ("euler", "rk4", "symplectic_euler")


@checked
@dataclass(frozen=True)
class Crazyflow(Simulator):
    """crazyflow's first-principles model for each trial: `Plant(simulator.quadrotor(), scene, simulator)`.

    A control is the force of a rotor. The speed of the rotor follows the speed for this force, with the rotor's lag.
    Rotors begin at hover speed. There is no floor, and a wind acts through the robot's linear drag. Trials are computed
    in double precision, one after the other, because the bits of crazyflow's batches depend on their size.

    Args:
      timestep: timestep of the physics in s; 1 / timestep has to be a whole number.
    """

    drone: Annotated[str, OneOf(DRONES)] = "cf21B_500"
    timestep: Positive = 0.002
    integrator: Annotated[str, OneOf(INTEGRATORS)] = "rk4"

    name = "crazyflow"
    parameters = PARAMETERS

    @property
    def weight(self) -> float:
        parameters = numbers_of(self.drone)
        return float(parameters["mass"] * -parameters["gravity_vec"][2])

    @property
    def versions(self) -> dict[str, str]:
        return versions_of("crazyflow", "jax", "jaxlib")

    def quadrotor(self, **changes: Any) -> Quadrotor:
        """A model with the drone's numbers, but for changes of fields, such as a fitted drag.

        The inertia about the level axes is their mean. The drag is the drag along them, and the drag torque of a rotor
        is the torque at hover.
        """
        parameters, hover = numbers_of(self.drone), self.weight / 4
        inertia = np.diag(parameters["J"])
        torque = np.polyval(parameters["rpm2torque"][::-1], speed_of(self.drone, np.array(hover)))
        numbers = {
            "mass": float(parameters["mass"]), "inertia": float(inertia[:2].mean()), "yaw_inertia": float(inertia[2]),
            "arm": frame_of(self.drone).arm, "torque_ratio": float(torque / hover),
            "gravity": self.weight / parameters["mass"], "drag": float(-np.diag(parameters["drag_matrix"])[:2].mean()),
            "max_force": float(parameters["thrust_max"]), "min_force": float(parameters["thrust_min"]),
        }  # fmt: skip
        return Quadrotor(**numbers | changes)

    def check(self, robot: Robot) -> None:
        check_kind("crazyflow: robot", robot, Quadrotor, "a Quadrotor, such as simulator.quadrotor()")
        limits, parameters = robot.dynamics.control_coordinates, numbers_of(self.drone)
        low, high = parameters["thrust_min"], parameters["thrust_max"]
        if min(limits.low) < low - 1e-12 or max(limits.high) > high + 1e-12:
            rotors = f"rotors of {min(limits.low):g} to {max(limits.high):g} N"
            raise InputError(f"crazyflow: got a robot with {rotors}, want at most {low:g} to {high:g} N")

    def start(self, states: Array, factors: Mapping[str, Array], timestep: float) -> "_Drones":
        frequency, trials = round(1 / timestep), len(states)
        if abs(frequency * timestep - 1) > 1e-9:
            raise InputError(f"crazyflow: got a timestep of {timestep:g} s, want 1 s divided by a whole number")
        multiplied = np.ones((trials, 6))
        for parameter, columns in (("mass", slice(0, 1)), ("inertia", slice(1, 2))):
            multiplied[:, columns] = factors.get(parameter, 1.0)
        multiplied[:, 2 + frame_of(self.drone).order] = factors.get("thrust", 1.0)
        hover_speed = float(speed_of(self.drone, np.array(self.weight / 4)))
        simulations = _Drones(np.full((trials, 17), hover_speed), multiplied, frequency)
        self.place(simulations, states)
        return simulations

    def step(self, simulations: "_Drones", controls: Array, wrench: Array, wind: Array, steps: int) -> None:
        speeds, states = np.empty_like(controls), simulations.states
        speeds[:, frame_of(self.drone).order] = speed_of(self.drone, controls)
        advance = stepper(self.drone, self.integrator, simulations.frequency, steps)
        for trial, inputs in enumerate(np.concatenate([states, speeds, wrench, simulations.factors], axis=1)):
            if np.isfinite(inputs).all():
                states[trial] = advance(inputs)

    def states(self, simulations: "_Drones") -> Array:
        states = simulations.states
        return frame_of(self.drone).ours(states[:, :3], states[:, 7:10], states[:, 3:7], states[:, 10:13])

    def place(self, simulations: "_Drones", states: Array) -> None:
        x, v, q, w = frame_of(self.drone).theirs(states)
        simulations.states[:, :13] = np.concatenate([x, q, v, w], axis=1)


@dataclass(frozen=True, eq=False)
class _Drones:
    """K trials in crazyflow's form."""

    states: Array  # (K, 17): position, quaternion, velocity, rates, rotor speeds in 1/min
    factors: Array  # (K, 6): of the mass, the inertia, and the thrust of its rotors
    frequency: int  # of its steps, in 1/s


@cache
def numbers_of(drone: str) -> dict[str, Any]:
    """crazyflow's parameters of a drone."""
    dynamics = package("crazyflow.dynamics", "crazyflow")
    return dynamics.load_params(dynamics.Dynamics.first_principles, drone)


@cache
def frame_of(drone: str) -> Frame:
    """Our body axes in the drone's body axes, where torques are sums of y_i f_i about x, and of -x_i f_i about y."""
    parameters = numbers_of(drone)
    mixed, arm = parameters["mixing_matrix"], parameters["L"]
    return Frame.of("crazyflow", np.stack([-mixed[1] * arm, mixed[0] * arm], axis=1), mixed[2])


def speed_of(drone: str, forces: Array) -> Array:
    """The speeds in 1/min at which rotors have these forces in N; same shape."""
    c, b, a = numbers_of(drone)["rpm2thrust"]
    return (-b + np.sqrt(b**2 - 4 * a * (c - forces))) / (2 * a)


@cache
def stepper(drone: str, integrator: str, frequency: int, steps: int) -> Any:
    """A function of a trial's 17 states, 4 rotor speeds, wrench (6,) and factors (6,) that returns its next states."""
    jax, sim = package("jax", "crazyflow"), package("crazyflow.sim", "crazyflow")
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they concern its scene, which is not used
        simulation = sim.Sim(
            drone=drone, dynamics="first_principles", control="rotor_vel", integrator=integrator, freq=frequency
        )
        del simulation.step_pipeline["clip_floor_pos"]
        advance, template = simulation.build_step_fn(), simulation.data

        @jax.jit
        def compiled(numbers: Any) -> Any:
            def at(first: int, size: int) -> Any:
                return numbers[first : first + size].reshape(1, 1, size)

            moved = template.states.replace(
                pos=at(0, 3), quat=at(3, 4), vel=at(7, 3), ang_vel=at(10, 3), rotor_vel=at(13, 4), force=at(21, 3),
                torque=at(24, 3),
            )  # fmt: skip
            parameters, (mass, inertia), thrust = template.params, numbers[27:29], numbers[29:33]
            changed = parameters.replace(
                mass=parameters.mass * mass, J=parameters.J * inertia, J_inv=parameters.J_inv / inertia,
                rpm2thrust=parameters.rpm2thrust * thrust[:, None], rpm2torque=parameters.rpm2torque * thrust[:, None],
            )  # fmt: skip
            data = template.replace(
                states=moved, params=changed, controls=template.controls.replace(rotor_vel=at(17, 4))
            )
            states = advance(data, n_steps=steps).states
            return jax.numpy.concatenate(
                [part.ravel() for part in (states.pos, states.quat, states.vel, states.ang_vel, states.rotor_vel)]
            )

    def run(numbers: Array) -> Array:
        with jax.enable_x64(True):
            return np.asarray(compiled(numbers))

    return run

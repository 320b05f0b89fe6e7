"""White noise on controls, measurements, forces and torques; and pushes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lqrsim.control.uncertainty import Uncertainty, Unknown
from lqrsim.errors import InputError, check_array, check_number
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import (
    Disturbance,
    Effect,
    GaussianDisturbance,
    Numbers,
    fit,
    left_out,
    normal,
    times,
    unknowns_of,
    with_units,
    words,
)
from lqrsim.simulation.plant import Plant


class ControlNoise(GaussianDisturbance):
    """White noise on each control, redrawn each control period.

    Args:
      std: standard deviation in the control's unit (N of a rotor, m/s of a wheel); one number, or one a control.
    """

    def describe(self, plant: Plant) -> str:
        return f"control noise, std {with_units(self, self.std, plant.robot.dynamics.control_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = fit(self, self.std, plant.robot.dynamics.control_coordinates.names)
        noise = std * normal(generators, plan.steps, len(std))
        return Effect(actuate=lambda step, controls: controls + noise[:, step])

    def uncertainty(self, plant: Plant) -> Uncertainty:
        std = fit(self, self.std, plant.robot.dynamics.control_coordinates.names)
        return Uncertainty(control=tuple(std.tolist()) if std.any() else 0.0)


class MeasurementNoise(GaussianDisturbance):
    """White noise on each state that the policy is shown.

    Args:
      std: standard deviation in the state's unit; one number, or one a state.
    """

    def describe(self, plant: Plant) -> str:
        return f"measurement noise, std {with_units(self, self.std, plant.robot.dynamics.state_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        noise = std * normal(generators, plan.steps + 1, len(std))
        return Effect(measure=lambda step, states: states + noise[:, step])

    def uncertainty(self, plant: Plant) -> Uncertainty:
        std = fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        return Uncertainty(measurement=tuple(std.tolist()) if std.any() else 0.0)


class ForceNoise(GaussianDisturbance):
    """A random force at the robot's centre of mass, redrawn each control period and held over it.

    Args:
      std: standard deviation in N; one number, or three along the world's axes.
    """

    along = "xyz"

    def describe(self, plant: Plant) -> str:
        return f"force noise, std {words(self.std)} N"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        forces = fit(self, self.std, "xyz") * normal(generators, plan.steps, 3)
        return Effect(force=lambda step, states: forces[:, step])

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return unknowns_of(self, plant, drawn_anew("force", self.std))


class TorqueNoise(GaussianDisturbance):
    """A random torque on the robot, redrawn each control period and held over it.

    Args:
      std: standard deviation in N m; one number, or three about the world's axes.
    """

    along = "xyz"

    def describe(self, plant: Plant) -> str:
        return f"torque noise, std {words(self.std)} N m"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        torques = fit(self, self.std, "xyz") * normal(generators, plan.steps, 3)
        return Effect(torque=lambda step, states: torques[:, step])

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return unknowns_of(self, plant, drawn_anew("torque", self.std))


@dataclass(frozen=True)
class Push(Disturbance):
    """One push at the robot's centre of mass, spread over the control period in which it comes.

    Args:
      impulse: in N s along the world's axes, (3,).
      at: seconds after the start.
    """

    impulse: Sequence[float]
    at: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "impulse", tuple(check_array("Push: impulse", self.impulse, (3,)).tolist()))
        object.__setattr__(self, "at", check_number("Push: at", self.at, at_least=0.0))

    def describe(self, plant: Plant) -> str:
        return f"push of {words(self.impulse)} N s at {self.at:g} s"

    def scaled(self, strength: float) -> "Push":
        return replace(self, impulse=times(self, self.impulse, strength))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        period = int(self.at / plan.dt + 1e-9)  # a time that is a knot up to rounding belongs to the period after it
        if period >= plan.steps:
            raise InputError(f"Push: at: got {self.at:g} s, want a time before the plan ends at {plan.horizon:g} s")
        forces = np.zeros((plan.steps, 3))
        forces[period] = np.array(self.impulse) / plan.dt
        return Effect(force=lambda step, states: np.broadcast_to(forces[step], (len(states), 3)))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return left_out(self, plant, "it comes once, and no noise does") if any(self.impulse) else Uncertainty()


def drawn_anew(what: str, std: Numbers) -> list[Unknown]:
    """White noise along the world's axes, of which std is one number or three."""
    return [
        Unknown(f"{what}_{axis}", float(one), time_constant=0.0)
        for axis, one in zip("xyz", np.broadcast_to(np.asarray(std, dtype=np.float64), 3), strict=True)
    ]

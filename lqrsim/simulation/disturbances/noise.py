"""Random errors: noise on controls, measurements, sensors, forces and states; wrong starts and obstacles; pushes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from lqrsim.annotations import NonNegative, Share, checked
from lqrsim.control.uncertainty import OFFSET, Uncertainty, Unknown
from lqrsim.errors import Array, InputError, check_array, check_items, check_kind, check_name, keep
from lqrsim.problem.belief import Belief
from lqrsim.problem.noise import Noise
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import Sensor
from lqrsim.simulation.disturbances.base import (
    Disturbance,
    Effect,
    GaussianDisturbance,
    normal,
    uniform,
    with_units,
    words,
)
from lqrsim.simulation.plant import Plant

READINGS, DEVIATIONS = "readings", "standard deviations"  # keys under which `Effect.read` gets those of a belief
SETTINGS = tuple(field.name for field in fields(Sensor)[1:])  # all but the name


class AddedError(GaussianDisturbance):
    """Base class of Gaussian errors on states or controls: drawn anew at each step, or once for a whole run."""

    what: ClassVar[str]
    hook: ClassVar[Literal["measure", "actuate", "initial_states"]]  # the field of an `Effect`
    constant: ClassVar[bool] = True
    uncertainty_field: ClassVar[str]  # the field of an Uncertainty
    by_name = True

    def _coordinates(self, plant: Plant) -> Coordinates:
        """The quantity to which the error is added."""
        dynamics = plant.robot.dynamics
        return dynamics.control_coordinates if self.hook == "actuate" else dynamics.state_coordinates

    def describe(self, plant: Plant) -> str:
        return f"{self.what}, std {with_units(self._deviations(plant), self._coordinates(plant))}"

    def _deviations(self, plant: Plant) -> Array:
        return self._fit(self.std, self._coordinates(plant))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std, steps = self._deviations(plant), 1 if self.constant else plan.steps + (self.hook == "measure")
        errors = std * normal(generators, steps, len(std))
        if self.hook == "initial_states":
            return Effect(initial_states=lambda states: _moved(plant, states, errors[:, 0]))
        return replace(Effect(), **{self.hook: lambda step, values: values + errors[:, 0 if self.constant else step]})

    def uncertainty(self, plant: Plant) -> Uncertainty:
        std = self._deviations(plant)
        return replace(Uncertainty(), **{self.uncertainty_field: tuple(std.tolist()) if std.any() else 0.0})


class ControlNoise(AddedError):
    """White noise on each control, redrawn each control period; `std` as one number, one each, or by name or unit."""

    what, hook, constant, uncertainty_field = "control noise", "actuate", False, "control"


class ControlOffset(AddedError):
    """A constant error of each control, drawn for each trial; `std` as one number, one each, or by name or unit."""

    what, hook = "control offset", "actuate"

    def uncertainty(self, plant: Plant) -> Uncertainty:
        controls = zip(self._coordinates(plant).names, self._deviations(plant).tolist(), strict=True)
        return self._unknowns(plant, [Unknown(OFFSET + name, std) for name, std in controls])


class MeasurementNoise(AddedError):
    """White noise on each measured state; `std` as one number, one each, or by unit: {"m": 0.01, "rad": 0.02}."""

    what, hook, constant, uncertainty_field = "measurement noise", "measure", False, "measurement"


class MeasurementBias(AddedError):
    """A constant error of each measured state, drawn for each trial; `std` as of `MeasurementNoise`."""

    what, hook = "measurement bias", "measure"

    def uncertainty(self, plant: Plant) -> Uncertainty:
        acts = bool(self._deviations(plant).any())
        return self._left_out(plant, "measurements cannot distinguish it from the state", acts=acts)


class InitialStateError(AddedError):
    """The robot begins in a state that differs from the first state of the plan; `std` as of `MeasurementNoise`.

    Kinematic loops of an MJCF, and other equality constraints, are closed again: each trial begins in the state that
    meets them and is nearest to the drawn one.
    """

    what, hook, uncertainty_field = "initial state off", "initial_states", "start"


def _moved(plant: Plant, states: Array, errors: Array) -> Array:
    """The states (K, n) moved by errors, with the robot's kinematic loops closed again."""
    rows, moved = errors.any(axis=-1), states + errors
    moved[rows] = plant.robot.with_closed_loops(moved[rows])
    return moved


class WrenchNoise(GaussianDisturbance):
    """Base class of random forces and torques, redrawn each control period and held over it."""

    along = "xyz"
    kind: ClassVar[Literal["force", "torque"]]
    unit: ClassVar[str]

    def describe(self, plant: Plant) -> str:
        return f"{self.kind} noise, std {words(self.std)} {self.unit}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        vectors = self._fit(self.std, self.along) * normal(generators, plan.steps, 3)
        return replace(Effect(), **{self.kind: lambda step, states: vectors[:, step]})

    def uncertainty(self, plant: Plant) -> Uncertainty:
        axes = zip(self.along, self._fit(self.std, self.along).tolist(), strict=True)
        return self._unknowns(plant, [Unknown(f"{self.kind}_{axis}", std, time_constant=0.0) for axis, std in axes])


class ForceNoise(WrenchNoise):
    """A random force at the centre of mass of the robot's body; `std` in N, one, or three along the world's axes."""

    kind, unit = "force", "N"


class TorqueNoise(WrenchNoise):
    """A random torque on the robot; `std` in N m, one number, or three about the world's axes."""

    kind, unit = "torque", "N m"


class DisplacedObstacles(GaussianDisturbance):
    """Obstacles are displaced from the plan's; planes are not. Heights stay if the robot is seen from above.

    `std` in m is one number, or three along the world's axes.
    """

    along = "xyz"

    def describe(self, plant: Plant) -> str:
        return f"obstacles displaced, std {words(self.std)} m"

    def check(self, plant: Plant) -> None:
        if not any(obstacle.kind != "plane" for obstacle in plant.world.obstacles):
            scene = f"scene {plant.scene.name}, where robot {plant.robot.name} has no obstacles but planes"
            raise InputError(f"DisplacedObstacles: got {scene}, want one with other obstacles")

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        displaced = self._fit(self.std, self.along) * normal(generators, len(plant.world), 3)
        displaced[:, [obstacle.kind == "plane" for obstacle in plant.world.obstacles]] = 0.0
        if plant.robot.dynamics.state_coordinates.from_above:
            displaced[..., 2] = 0.0
        return Effect(displaced=displaced)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """The root mean square of the standard deviations over the axes that matter."""
        axes = 2 if plant.robot.dynamics.state_coordinates.from_above else 3
        return Uncertainty(obstacles=float(np.sqrt(np.mean(self._fit(self.std, self.along)[:axes] ** 2))))


@checked
@dataclass(frozen=True)
class StateNoise(Disturbance):
    """The noise of a problem, `lqrsim.Noise`: the state jumps by M(x, u) w at the end of each control period.

    w is drawn anew each time; x is the state at the beginning of the period, u the control that reached the actuators.
    """

    noise: Noise

    def describe(self, plant: Plant) -> str:
        return f"noise on the states, {self.noise!r}"

    def scaled(self, strength: float) -> "StateNoise":
        return StateNoise(self.noise.scaled(self._strength(strength)))

    def check(self, plant: Plant) -> None:
        self.noise.bind(plant.robot.dynamics)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        draws = normal(generators, plan.steps, self.noise.size)

        def kick(step: int, states: Array, controls: Array) -> Array:
            matrices = self.noise.matrices(plant.robot.dynamics, states, controls)
            return sum(  # the order must not depend on the number of trials
                (matrices[:, :, k] * draws[:, step, k, None] for k in range(1, self.noise.size)),
                start=matrices[:, :, 0] * draws[:, step, 0, None],
            )

        return Effect(kick=kick)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "filters and tubes have no noise that acts on the states directly")


def as_disturbances(disturbances: object) -> tuple[Disturbance, ...]:
    """The disturbances, with each `Noise` converted to StateNoise. Raises InputError for anything else."""
    wanted = "disturbances, such as ControlNoise(0.05)"
    items = check_items("disturbances", disturbances, (Disturbance, Noise), wanted)
    return tuple(StateNoise(item) if isinstance(item, Noise) else item for item in items)


@checked
@dataclass(frozen=True)
class Push(Disturbance):
    """A single push at the centre of mass of the robot's body, spread over the control period in which it comes.

    Args:
      impulse: the impulse in N s along the world's axes, (3,).
      at: seconds after the start.
    """

    impulse: Sequence[float]
    at: NonNegative

    _scales = "impulse"

    def __post_init__(self) -> None:
        keep(self, impulse=tuple(check_array("Push: impulse", self.impulse, (3,)).tolist()))

    def describe(self, plant: Plant) -> str:
        return f"push of {words(self.impulse)} N s at {self.at:g} s"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        periods = min(self.at / plan.dt, plan.steps)
        period = int(periods + 1e-9)  # a time that is a knot, up to rounding, belongs to the next period
        if period >= plan.steps:
            raise InputError(f"Push: at: got {self.at:g} s, want a time before the plan ends at {plan.horizon:g} s")
        forces = np.zeros((plan.steps, 3))
        forces[period] = np.array(self.impulse) / plan.dt
        return Effect(force=lambda step, states: np.broadcast_to(forces[step], (len(states), 3)))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "it comes once, and noise does not", acts=any(self.impulse))


@checked
@dataclass(frozen=True)
class SensorErrors(Disturbance):
    """Noise, biases and losses of sensors of the MJCF, for a controller that reads them.

    Without it, readings are exact. Rates and delays are those of the controller's sensors in any case.

    Args:
      sensors: the sensors, as in `plant.sensors`; or the settings of each by its name, as they are kept and stored.
        Those that the controller does not read have no effect.
      strength: factor of the standard deviations, and of the chance of a loss, which is at most 1.
    """

    sensors: Mapping[str, Mapping[str, float]] | Sequence[Sensor]
    strength: NonNegative = 1.0

    discrete = True
    _scales = "strength"

    def __post_init__(self) -> None:
        if isinstance(self.sensors, Mapping):
            for name, settings in self.sensors.items():
                field = f"SensorErrors: sensors: {name}"
                for key in check_kind(field, settings, Mapping, "settings of a Sensor by name"):
                    check_name(field, key, SETTINGS)
            sensors = [Sensor(name, **settings) for name, settings in self.sensors.items()]
        else:
            sensors = check_items("SensorErrors: sensors", self.sensors, Sensor, "a list of Sensor")
        by_name = {sensor.name: {key: getattr(sensor, key) for key in SETTINGS} for sensor in sensors}
        if len(by_name) < len(sensors):
            raise InputError(f"SensorErrors: sensors: got {[one.name for one in sensors]}, want each at most once")
        keep(self, sensors=by_name)

    @cached_property
    def sensor_records(self) -> tuple[Sensor, ...]:
        sensors: Any = self.sensors
        return tuple(Sensor(name, **settings) for name, settings in sensors.items())

    def check(self, plant: Plant) -> None:
        plant.sensors(self.sensor_records)

    def describe(self, plant: Plant) -> str:
        listed = (
            f"{sensor.name} (noise {sensor.noise:g}, bias {sensor.bias:g} and {sensor.bias_walk:g} in 1 s,"
            f" loss {sensor.loss:g})"
            for sensor in plant.sensors(self.sensor_records).sensors
        )
        return f"errors of sensors, times {self.strength:g}: {', '.join(listed)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        sensors, knots = plant.sensors(self.sensor_records), plan.steps + 1
        size = len(sensors.names)
        errors = sensors.per_reading("noise") * normal(generators, knots, size)
        errors += sensors.per_reading("bias") * normal(generators, 1, size)
        walks = normal(generators, plan.steps, size).cumsum(axis=1)
        errors[:, 1:] += sensors.per_reading("bias_walk") * np.sqrt(plan.dt) * walks
        losses = np.array([sensor.loss for sensor in sensors.sensors])
        lost = uniform(generators, knots, len(losses)) < self.strength * losses
        errors *= self.strength
        for i, columns in enumerate(sensors.columns):
            errors[..., columns][lost[..., i]] = np.nan
        by_sensor = {sensor.name: errors[..., sensors.columns[i]] for i, sensor in enumerate(sensors.sensors)}

        def read(step: int, readings: dict[str, Array]) -> dict[str, Array]:
            both = by_sensor.keys() & readings
            return readings | {name: readings[name] + by_sensor[name][:, step] for name in both}

        return Effect(read=read)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "OffsetFree takes them from its sensors=", acts=self.strength > 0)


@checked
@dataclass(frozen=True)
class ReadingErrors(Disturbance):
    """Noise of the sensors of a belief, as strong as these are in the true state. Without it, readings are exact.

    Args:
      loss: chance that a reading is lost, each by itself.
      strength: factor of the standard deviations and of the chance of a loss.
    """

    belief: Belief
    loss: Share = 0.0
    strength: NonNegative = 1.0

    discrete = True
    _scales = "strength"

    def describe(self, plant: Plant) -> str:
        lost = f", loss {self.loss:g}" if self.loss else ""
        return f"errors of {self.belief.readings} readings{lost}, times {self.strength:g}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        errors = self.strength * normal(generators, plan.steps + 1, self.belief.readings)
        if self.loss:
            errors[uniform(generators, *errors.shape[1:]) < self.strength * self.loss] = np.nan

        def read(step: int, readings: Mapping[str, Array]) -> dict[str, Array]:
            noisy = dict(readings)
            if READINGS in noisy:
                noisy[READINGS] = noisy[READINGS] + errors[:, step] * noisy[DEVIATIONS]
            return noisy

        return Effect(read=read)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "a BeliefFeedback takes them from its belief", acts=self.strength > 0)

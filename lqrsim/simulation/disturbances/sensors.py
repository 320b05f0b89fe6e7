"""The errors of the sensors of an MJCF, and of those of a belief."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from lqrsim.annotations import NonNegative, Share, checked
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_items, check_kind, check_name, keep
from lqrsim.problem.belief import Belief
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import Sensor
from lqrsim.simulation.disturbances.base import Disturbance, Effect, normal, uniform
from lqrsim.simulation.plant import Plant

READINGS, DEVIATIONS = "readings", "standard deviations"  # of a belief, by which `read` has them
SETTINGS = tuple(field.name for field in fields(Sensor)[1:])  # all but the name


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
    def known(self) -> tuple[Sensor, ...]:
        sensors: Any = self.sensors
        return tuple(Sensor(name, **settings) for name, settings in sensors.items())

    def check(self, plant: Plant) -> None:
        plant.sensors(self.known)

    def describe(self, plant: Plant) -> str:
        listed = (
            f"{sensor.name} (noise {sensor.noise:g}, bias {sensor.bias:g} and {sensor.bias_walk:g} in 1 s,"
            f" loss {sensor.loss:g})"
            for sensor in plant.sensors(self.known).sensors
        )
        return f"errors of sensors, times {self.strength:g}: {', '.join(listed)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        known, knots = plant.sensors(self.known), plan.steps + 1
        size = len(known.names)
        errors = known.per_reading("noise") * normal(generators, knots, size)
        errors += known.per_reading("bias") * normal(generators, 1, size)
        walks = normal(generators, plan.steps, size).cumsum(axis=1)
        errors[:, 1:] += known.per_reading("bias_walk") * np.sqrt(plan.dt) * walks
        losses = np.array([sensor.loss for sensor in known.sensors])
        lost = uniform(generators, knots, len(losses)) < self.strength * losses
        errors *= self.strength
        for i, columns in enumerate(known.columns):
            errors[..., columns][lost[..., i]] = np.nan
        of = {sensor.name: errors[..., columns] for sensor, columns in zip(known.sensors, known.columns, strict=True)}

        def read(step: int, readings: dict[str, Array]) -> dict[str, Array]:
            return {name: reading + of[name][:, step] if name in of else reading for name, reading in readings.items()}

        return Effect(read=read)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "OffsetFree has them by its own sensors=", acts=self.strength > 0)


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
        return self._left_out(plant, "a BeliefFeedback has them by its belief", acts=self.strength > 0)

"""Disturbances of a run: one class each, in physical units, drawn for each trial from its own generator.

`base.py` explains how to add one; `KINDS` has all classes by name.
"""

import inspect

from lqrsim.simulation.disturbances.actuation import ActuatorLoss, MotorLag, Saturation
from lqrsim.simulation.disturbances.base import Disturbance, Effect
from lqrsim.simulation.disturbances.links import (
    CommandDropouts,
    ControlDelay,
    GilbertElliott,
    MeasurementDropouts,
    MeasurementLatency,
)
from lqrsim.simulation.disturbances.mismatch import (
    AxleMismatch,
    FrictionMismatch,
    InertiaMismatch,
    MassMismatch,
    Payload,
    ThrustMismatch,
    WheelRadiusMismatch,
)
from lqrsim.simulation.disturbances.noise import (
    ControlNoise,
    ControlOffset,
    DisplacedObstacles,
    ForceNoise,
    InitialStateError,
    MeasurementBias,
    MeasurementNoise,
    Push,
    TorqueNoise,
)
from lqrsim.simulation.disturbances.noise import as_disturbances as as_disturbances
from lqrsim.simulation.disturbances.presets import PRESETS as PRESETS
from lqrsim.simulation.disturbances.presets import preset
from lqrsim.simulation.disturbances.sensors import SensorErrors
from lqrsim.simulation.disturbances.wind import Dryden, Gusts, MeanWind

KINDS: dict[str, type[Disturbance]] = {
    name: item
    for name, item in sorted(vars().items())
    if inspect.isclass(item) and issubclass(item, Disturbance) and not inspect.isabstract(item)
}

__all__ = [
    "ActuatorLoss", "AxleMismatch", "CommandDropouts", "ControlDelay", "ControlNoise", "ControlOffset",
    "DisplacedObstacles", "Disturbance", "Dryden", "Effect", "ForceNoise", "FrictionMismatch", "GilbertElliott",
    "Gusts", "InertiaMismatch", "InitialStateError", "MassMismatch", "MeanWind", "MeasurementBias",
    "MeasurementDropouts", "MeasurementLatency", "MeasurementNoise", "MotorLag", "Payload", "Push", "Saturation",
    "SensorErrors", "ThrustMismatch", "TorqueNoise", "WheelRadiusMismatch", "preset",
]  # fmt: skip

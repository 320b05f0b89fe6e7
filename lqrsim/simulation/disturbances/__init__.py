"""What goes wrong in a run: one class a disturbance, in physical units, drawn for each trial from its own generator.

`base.py` says what a disturbance is, and how to add one; `KINDS` has all classes by name.
"""

import inspect

from lqrsim.simulation.disturbances.actuation import ActuatorLoss, ControlDelay, MotorLag, Saturation
from lqrsim.simulation.disturbances.base import Disturbance, Effect
from lqrsim.simulation.disturbances.mismatch import (
    AxleMismatch,
    FrictionMismatch,
    InertiaMismatch,
    MassMismatch,
    ThrustMismatch,
    WheelRadiusMismatch,
)
from lqrsim.simulation.disturbances.noise import ControlNoise, ForceNoise, MeasurementNoise, Push, TorqueNoise
from lqrsim.simulation.disturbances.presets import PRESETS, preset
from lqrsim.simulation.disturbances.sensing import (
    CommandDropouts,
    GilbertElliott,
    MeasurementBias,
    MeasurementDropouts,
    MeasurementLatency,
)
from lqrsim.simulation.disturbances.surroundings import DisplacedObstacles, InitialStateError
from lqrsim.simulation.disturbances.wind import Dryden, Gusts, MeanWind

KINDS: dict[str, type[Disturbance]] = {
    name: item
    for name, item in sorted(vars().items())
    if inspect.isclass(item) and issubclass(item, Disturbance) and not inspect.isabstract(item)
}

__all__ = [
    "KINDS",
    "PRESETS",
    "ActuatorLoss",
    "AxleMismatch",
    "CommandDropouts",
    "ControlDelay",
    "ControlNoise",
    "DisplacedObstacles",
    "Disturbance",
    "Dryden",
    "Effect",
    "ForceNoise",
    "FrictionMismatch",
    "GilbertElliott",
    "Gusts",
    "InertiaMismatch",
    "InitialStateError",
    "MassMismatch",
    "MeanWind",
    "MeasurementBias",
    "MeasurementDropouts",
    "MeasurementLatency",
    "MeasurementNoise",
    "MotorLag",
    "Push",
    "Saturation",
    "ThrustMismatch",
    "TorqueNoise",
    "WheelRadiusMismatch",
    "preset",
]

"""Disturbances of a run: one class each, in physical units, drawn for each trial from its own generator.

`base.py` explains how to add one; `KINDS` has all classes by name. Presets are named sets of them, from calm to severe;
a plant gets only those that it supports. `uncertainty_of` has disturbances in the form that filters, tracking laws and
predicted tubes use.
"""

import inspect
from collections.abc import Sequence

import numpy as np

from lqrsim.annotations import checked
from lqrsim.control.uncertainty import Uncertainty, gathered
from lqrsim.errors import InputError, check_kind, check_name
from lqrsim.problem.noise import Noise
from lqrsim.simulation.disturbances.actuation import (
    ActuatorLoss,
    CommandDropouts,
    ControlDelay,
    GilbertElliott,
    MeasurementDropouts,
    MeasurementLatency,
    MotorLag,
    Saturation,
)
from lqrsim.simulation.disturbances.base import Disturbance, Effect, GaussianDisturbance
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
    SensorErrors,
    TorqueNoise,
)
from lqrsim.simulation.disturbances.noise import as_disturbances as as_disturbances
from lqrsim.simulation.disturbances.wind import Dryden, Gusts, MeanWind
from lqrsim.simulation.plant import Plant

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

# Strengths relative to light; as in MIL-F-8785C, with 15, 30 and 45 knots for light, moderate and severe turbulence.
PRESETS = {"calm": 0.5, "light": 1.0, "moderate": 2.0, "strong": 2.5, "severe": 3.0}

# Measurement noise by unit: RotorPy's 5e-4 m, 5e-3 m/s, 5e-4 rad, 5e-4 rad/s per square root of Hz, at 100 Hz.
MEASURED = {"m": 5e-3, "m/s": 5e-2, "rad": 5e-3, "rad/s": 5e-3}
# Error of the start by unit: our choice, the order of a careful placement by hand.
PLACED = {"m": 0.01, "m/s": 0.01, "rad": 0.01, "rad/s": 0.01}

LIQUID = 100.0  # kg/m^3; a medium that is denser has currents, not the turbulence of air


@checked
def preset(name: str, plant: Plant) -> list[Disturbance]:
    """The disturbances of a preset that the plant supports, in the order in which they act. Each can be scaled by 2.

    Presets leave out disturbances whose strength depends on the robot or the plan. Latency and delay come in whole
    control periods, and the 6 to 7 ms of motion capture are less than half a period. For pushes, time and direction
    matter. A quadrotor does not survive the loss of an actuator. There is no `MotorLag` for a robot whose actuators
    have their own states, because its MJCF describes their lag. In a liquid there are currents in place of turbulence.
    """
    strength = PRESETS[check_name("preset", name, PRESETS)]
    return [disturbance.scaled(strength) for disturbance in _light(plant) if _affects(disturbance, plant)]


def _light(plant: Plant) -> list[Disturbance]:
    """All disturbances at strength 1, in the order in which they act."""
    space, controls = plant.robot.dynamics.state_coordinates, plant.robot.dynamics.control_coordinates
    ranges = np.subtract(controls.high, controls.low)
    liquid = plant.simulator is None and plant.has_medium and plant.model.opt.density > LIQUID
    lag = MotorLag(0.024)  # severe is the Crazyflie's 0.072 s in RotorPy; the Hummingbird's is 0.005 s
    return [
        InitialStateError([PLACED.get(unit, 0.0) for unit in space.units]),
        DisplacedObstacles(0.01),  # our choice: the accuracy of a map
        MassMismatch(0.02),  # our choice: a battery, a camera
        InertiaMismatch(0.1 / 3),  # +-10 % in all, SkyJEPA's data card
        ThrustMismatch(0.12 / 3),  # +-12 % in all, SkyJEPA's data card
        WheelRadiusMismatch(0.005),  # our choice: 0.2 mm of a wheel of the Create
        AxleMismatch(0.01),  # our choice: accuracy of the contact points of the wheels
        FrictionMismatch(0.05),  # our choice: severe is +-45 % in all
        MeasurementNoise([MEASURED.get(unit, 0.0) for unit in space.units]),
        MeasurementDropouts(0.01),  # our choice
        CommandDropouts(0.01),  # our choice: the same link
        ControlNoise(np.where(np.isfinite(ranges), 0.01 * ranges, 0.0).tolist()),  # our choice: 1 % of the range
        *([] if plant.robot.activations else [lag]),
        ForceNoise(0.01 * plant.weight),  # our choice: 1 % of the weight
        # Our choice: severe are 0.15 m/s along each axis, which change within minutes.
        Gusts(0.05, time_constant=60.0) if liquid else Dryden("light", altitude=2.0),
    ]


def _affects(disturbance: Disturbance, plant: Plant) -> bool:
    """Whether the plant can have it, and it is not zero for its robot, as a share of the weight is without gravity."""
    try:
        disturbance.check(plant)
    except InputError:
        return False
    return not isinstance(disturbance, GaussianDisturbance) or bool(np.any(np.asarray(disturbance.std)))


@checked
def uncertainty_of(plant: Plant, disturbances: Sequence[Disturbance | Noise]) -> Uncertainty:
    """Convert disturbances to zero-mean Gaussian uncertainty. Disturbances that do not fit are left out, by name.

    A fixed value (`MeanWind`, the `factor` of a mismatch) counts as unknown, with its size as standard deviation; two
    fixed winds are one, as are two factors of one kind, and two loads on one body. A truncated normal distribution
    counts with its own standard deviation. Losses in bursts count as independent ones, and displaced obstacles as
    displaced equally along all axes. `left_out` lists, with reasons, the disturbances that the robot's dynamics do not
    declare, and all that are not small, lasting and linear: pushes, narrower limits, the loss of an actuator.

    Args:
      disturbances: as in `simulate`; your own kinds have a method `uncertainty`.
    """
    single, parts = list[Disturbance](), list[Uncertainty]()
    for disturbance in as_disturbances(disturbances):
        disturbance.check(plant)
        for i, other in enumerate(single):
            if (both := other._together(disturbance)) is not None:
                single[i] = both
                break
        else:
            single.append(disturbance)
    for disturbance in single:
        field = f"{type(disturbance).__name__}: uncertainty"
        wanted = "a method that returns an Uncertainty"
        parts.append(check_kind(field, disturbance.uncertainty(plant), Uncertainty, wanted))
    total = gathered(parts)
    total.check(plant.robot.dynamics)
    return total

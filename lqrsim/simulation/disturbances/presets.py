"""Named sets of disturbances, from calm to severe, of those that a plant can have."""

import numpy as np

from lqrsim.errors import InputError, check_kind, check_name
from lqrsim.simulation.disturbances.actuation import MotorLag
from lqrsim.simulation.disturbances.base import Disturbance
from lqrsim.simulation.disturbances.mismatch import (
    AxleMismatch,
    FrictionMismatch,
    InertiaMismatch,
    MassMismatch,
    ThrustMismatch,
    WheelRadiusMismatch,
)
from lqrsim.simulation.disturbances.noise import ControlNoise, ForceNoise, MeasurementNoise
from lqrsim.simulation.disturbances.sensing import CommandDropouts, MeasurementDropouts
from lqrsim.simulation.disturbances.surroundings import DisplacedObstacles, InitialStateError
from lqrsim.simulation.disturbances.wind import Dryden
from lqrsim.simulation.plant import Plant

# Strengths, of which light is 1: as MIL-F-8785C has light, moderate and severe turbulence, 15, 30 and 45 knots.
PRESETS = {"calm": 0.5, "light": 1.0, "moderate": 2.0, "strong": 2.5, "severe": 3.0}

# What a state of each unit is measured to: RotorPy's 5e-4 m, 5e-3 m/s, 5e-4 rad, 5e-4 rad/s per root of Hz, at 100 Hz.
MEASURED = {"m": 5e-3, "m/s": 5e-2, "rad": 5e-3, "rad/s": 5e-3}
# How far off a run begins: our choice, of the order of a careful placement by hand.
PLACED = {"m": 0.01, "m/s": 0.01, "rad": 0.01, "rad/s": 0.01}


def preset(name: str, plant: Plant) -> list[Disturbance]:
    """The set of that name: `PRESETS` has them. All of them can be twice as strong.

    Not in it is what no strength can be given to without knowing the robot or the plan: latency and delay, which come
    in whole control periods, while motion capture's 6 to 7 ms are less than half of one; a push, of which it matters
    when it comes and from where; and the loss of an actuator, which a quadrotor does not survive.

    Args:
      name: calm, light, moderate, strong or severe.
      plant: which decides what disturbances it can have.

    Returns:
      The disturbances, in the order in which they act.

    Raises:
      InputError: there is none of that name.
    """
    check_kind("plant", plant, Plant, "a Plant, such as scenario.plant()")
    strength = PRESETS[check_name("preset", name, PRESETS)]
    return [one.scaled(strength) for one in _light(plant) if _can_have(plant, one)]


def _light(plant: Plant) -> list[Disturbance]:
    """All, at strength 1, in the order in which they happen."""
    space, controls = plant.robot.dynamics.state_coordinates, plant.robot.dynamics.control_coordinates
    ranges = np.subtract(controls.high, controls.low)
    weight = float(plant.model.body_subtreemass[plant.body] * np.linalg.norm(plant.model.opt.gravity))
    return [
        InitialStateError([PLACED.get(unit, 0.0) for unit in space.units]),
        DisplacedObstacles(0.01),  # our choice: as a map is drawn
        MassMismatch(0.02),  # our choice: a battery, a camera
        InertiaMismatch(0.1 / 3),  # +-10 % in all, SkyJEPA's data card
        ThrustMismatch(0.12 / 3),  # +-12 % in all, SkyJEPA's data card
        WheelRadiusMismatch(0.005),  # our choice: 0.2 mm of a wheel of the Create
        AxleMismatch(0.01),  # our choice: where a tread touches the floor is not known better
        FrictionMismatch(0.05),  # our choice: severe is +-45 % in all
        MeasurementNoise([MEASURED.get(unit, 0.0) for unit in space.units]),
        MeasurementDropouts(0.01),  # our choice
        CommandDropouts(0.01),  # our choice: the same link
        ControlNoise(np.where(np.isfinite(ranges), 0.01 * ranges, 0.0).tolist()),  # our choice: 1 % of the range
        MotorLag(0.024),  # severe is the Crazyflie's 0.072 s in RotorPy; the Hummingbird's is 0.005 s
        ForceNoise(0.01 * weight),  # our choice: 1 % of the weight
        Dryden("light", altitude=2.0),
    ]


def _can_have(plant: Plant, disturbance: Disturbance) -> bool:
    try:
        disturbance.check(plant)
    except InputError:
        return False
    return True

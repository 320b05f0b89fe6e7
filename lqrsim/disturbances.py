"""Disturbances of a run, such as `ls.disturbances.ControlNoise(0.05)`; sensors; unknowns that filters estimate."""

from lqrsim.control.uncertainty import Uncertainty, Unknown
from lqrsim.robots.sensors import Sensor
from lqrsim.simulation import disturbances as _disturbances
from lqrsim.simulation.disturbances import *  # noqa: F403
from lqrsim.simulation.disturbances.noise import StateNoise

__all__ = ["Sensor", "StateNoise", "Uncertainty", "Unknown"]
__all__ += _disturbances.__all__

"""Disturbances of a run, such as `ls.disturbances.ControlNoise(0.05)`, and unknowns that a filter can estimate."""

from lqrsim.control.uncertainty import Uncertainty, Unknown
from lqrsim.simulation import disturbances as _disturbances
from lqrsim.simulation.disturbances import *  # noqa: F403

__all__ = ["Uncertainty", "Unknown"]
__all__ += _disturbances.__all__

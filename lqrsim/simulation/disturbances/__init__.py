"""What goes wrong in a run: one class a disturbance, in physical units, drawn for each trial from its own generator.

`base.py` says what a disturbance is, and how to add one.
"""

from lqrsim.simulation.disturbances.base import Disturbance, Effect
from lqrsim.simulation.disturbances.noise import ControlNoise, ForceNoise, MeasurementNoise, Push

__all__ = ["ControlNoise", "Disturbance", "Effect", "ForceNoise", "MeasurementNoise", "Push"]

"""Simulators other than MuJoCo for `Plant(robot, scene, simulator)`, each with the extra that installs it."""

from lqrsim.simulation.simulator import Simulator as Simulator
from lqrsim.simulators.crazyflow import Crazyflow as Crazyflow
from lqrsim.simulators.rotorpy import RotorPy as RotorPy

__all__ = ["Crazyflow", "RotorPy", "Simulator"]

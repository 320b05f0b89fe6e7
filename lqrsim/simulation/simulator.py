"""The base class for simulators other than MuJoCo.

The scene is still MuJoCo's: obstacles, distances to them and pictures come from its MJCF. A robot that another
simulator moves passes through obstacles. Its first collision is found from its states; see `Collisions`.
"""

import abc
from collections.abc import Mapping
from typing import Any

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.robots.base import Robot

PARAMETERS = ("mass", "inertia", "thrust")  # the parameters that disturbances may multiply


class Simulator(abc.ABC):
    """A simulator for `Plant(robot, scene, simulator)`. To add one, write a frozen dataclass that subclasses it.

    A simulator simulates K trials at once, and keeps them in an object of its own type, `simulations` below. A trial
    must give the same bits whatever other trials run with it. States (K, n) and controls (K, m) are the robot's.

    Attributes:
      timestep: the longest timestep in s. A control period consists of a whole number of steps.
      parameters: which of "mass", "inertia" and "thrust" `start` can multiply. Disturbances that multiply others are
        refused.
      wind: whether it simulates wind. If not, wind is a force on the robot: `robot.drag` times the wind.
    """

    name: str
    timestep: float
    parameters: tuple[str, ...] = ()
    wind: bool = False

    @property
    @abc.abstractmethod
    def weight(self) -> float:
        """Weight of the simulated robot in N; presets scale forces with it."""

    @property
    def versions(self) -> Mapping[str, str]:
        """Name -> version of each package that affects the bits of the results; none by default."""
        return {}

    def check(self, robot: Robot) -> None:  # noqa: B027 - a simulator may take any robot
        """Raise an InputError for a robot that the simulator does not support."""

    @abc.abstractmethod
    def start(self, states: Array, factors: Mapping[str, Array], timestep: float) -> Any:
        """The simulations of K trials.

        Args:
          states: (K, n), where the trials begin.
          factors: parameter -> (K, 1), or (K, m) for the thrust: the factor of each trial, or of each of its controls.
            Parameters without factors keep their values.
          timestep: duration of each step in s, at most the simulator's `timestep`.
        """

    @abc.abstractmethod
    def step(self, simulations: Any, controls: Array, wrench: Array, wind: Array, steps: int) -> None:
        """Advance what `start` returned.

        Args:
          controls: (K, m), held constant, within the robot's limits.
          wrench: (K, 6), force in N at the centre of mass and torque in N m, along the world's axes.
          wind: (K, 3), in m/s along the world's axes; zero unless `wind` is true.
        """

    @abc.abstractmethod
    def states(self, simulations: Any) -> Array:
        """The current states (K, n); not finite for a trial whose simulation has become unstable."""

    def place(self, simulations: Any, states: Array) -> None:
        """Put the robots into other states (K, n), for noise on the states. Refused by default."""
        raise InputError(f"StateNoise: got a plant simulated by {self.name}, want one that overrides `place`")


def states_of(simulator: Simulator, simulations: Any, shape: tuple[int, ...]) -> Array:
    """A copy of the current states. Raises InputError unless it has this shape, (K, n)."""
    states = np.array(simulator.states(simulations), dtype=np.float64)
    if states.shape != shape:
        raise InputError(f"{simulator.name}: states: got shape {states.shape}, want {shape}: trials, states")
    return states

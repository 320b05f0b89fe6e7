"""The base class for simulators other than MuJoCo.

The scene is still MuJoCo's: obstacles, distances to them and pictures come from its MJCF. A robot that another
simulator moves passes through obstacles. Its first collision is found from its states, as in `collisions.py`.
"""

import abc
from collections.abc import Mapping
from typing import Any

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.robots.base import Robot

PARAMETERS = ("mass", "inertia", "thrust")  # that disturbances may multiply


class Simulator(abc.ABC):
    """Another simulator, for `Plant(robot, scene, simulator)`. Subclass it to bring one, as a frozen dataclass.

    It simulates K trials at once, and keeps them in an object of its own kind, `simulations` below. A trial must give
    the same bits whatever the trials beside it. States (K, n) and controls (K, m) are those of the robot.

    Attributes:
      name: for messages and records.
      timestep: the longest timestep in s. A control period has a whole number of steps.
      parameters: which of "mass", "inertia" and "thrust" `start` can multiply. Disturbances that multiply others are
        refused.
      wind: whether it has a wind. Without, a wind is a force on the robot: `robot.drag` times the wind.
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
        """Name -> version of the packages that the bits of its results depend on; none by default."""
        return {}

    def check(self, robot: Robot) -> None:  # noqa: B027 - a simulator may take any robot
        """Check that it can simulate this robot.

        Args:
          robot: that of the plant.

        Raises:
          InputError: it cannot.
        """

    @abc.abstractmethod
    def start(self, states: Array, factors: Mapping[str, Array], timestep: float) -> Any:
        """Start the simulations.

        Args:
          states: (K, n), where the trials begin.
          factors: parameter -> (K, 1), or (K, m) for the thrust: the factor of each trial, or of each of its controls.
            Parameters that are not there keep their values.
          timestep: of each step in s, at most its own.

        Returns:
          The simulations.
        """

    @abc.abstractmethod
    def step(self, simulations: Any, controls: Array, wrench: Array, wind: Array, steps: int) -> None:
        """Advance the simulations.

        Args:
          simulations: what `start` returned; it is changed.
          controls: (K, m), held, within the robot's limits.
          wrench: (K, 6), force in N at the centre of mass and torque in N m, along the world's axes.
          wind: (K, 3), in m/s along the world's axes; zero unless `wind` is true.
          steps: number of timesteps.
        """

    @abc.abstractmethod
    def states(self, simulations: Any) -> Array:
        """The current states.

        Args:
          simulations: what `start` returned.

        Returns:
          (K, n); not finite for a trial whose simulation has become unstable.
        """

    def place(self, simulations: Any, states: Array) -> None:
        """Put the robots elsewhere, for noise on the states. By default it is refused.

        Args:
          simulations: what `start` returned; it is changed.
          states: (K, n).

        Raises:
          InputError: it cannot.
        """
        raise InputError(f"StateNoise: got a plant simulated by {self.name}, want one that overrides `place`")


def states_of(simulator: Simulator, simulations: Any, shape: tuple[int, ...]) -> Array:
    """A copy of the current states, of this shape (K, n). Raises InputError if it is another one."""
    states = np.array(simulator.states(simulations), dtype=np.float64)
    if states.shape != shape:
        raise InputError(f"{simulator.name}: states: got shape {states.shape}, want {shape}: trials, states")
    return states

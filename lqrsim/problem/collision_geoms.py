"""Robots whose distances to obstacles a simulator knows: what costs and constraints need of them."""

import abc
from dataclasses import dataclass

import numpy.typing as npt

from lqrsim.codegen.sources import Source
from lqrsim.codegen.user_functions import Term
from lqrsim.errors import Array
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.scene import Scene
from lqrsim.scenes.world import World


@dataclass(frozen=True)
class GeomDistances(Term):
    """Distances between parts of a robot and obstacles, made for one system: the source to compile, and its data.

    The source defines `distances(x, data, out)`, which writes one number per row, and `distances_jacobian(x, data, out,
    slopes)`, which writes them and the derivatives in the states (rows, N) that are not zero, to zeros.

    Attributes:
      parts: for messages, the name of each row's part of the robot. obstacles: the number of each row's obstacle; -1
        for the nearest of all.
      moved: number of states, from the first one on, that the distances depend on.
    """

    parts: tuple[str, ...]
    obstacles: tuple[int, ...]
    moved: int

    def filling(self, kernel: Source) -> Source:
        """A kernel of costs or constraints, with the distances as what it calls places."""
        return kernel.filled(places=(self.code, "distances"), places_jacobian=(self.code, "distances_jacobian"))


class CollisionGeoms(abc.ABC):
    """The colliding geoms of a robot, whose distances its simulator knows; `MjcfRobot.geoms` is it.

    `ObstacleCost(world, geoms=...)` and `Clearance(world, geoms=...)` keep all of it clear.
    """

    @property
    @abc.abstractmethod
    def size(self) -> float:
        """The radius of the largest geom's bounding sphere, in metres."""

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics, world: World, reach: float) -> GeomDistances:
        """Bind the distances to a system.

        Args:
          dynamics: dynamics of the robot. world: the obstacles. reach: in metres, the largest distance of interest.

        Raises:
          InputError: the dynamics are not the robot's, or an obstacle is not in its MJCF, or moves.
        """

    @abc.abstractmethod
    def clearances(
        self, dynamics: Dynamics, world: World, states: npt.ArrayLike, displaced: Array | None = None
    ) -> Array:
        """Signed distances to the obstacles.

        Args:
          dynamics: dynamics of the robot. world: the obstacles. states: (..., n). displaced: (K, O, 3), by how much
            obstacles are elsewhere in each trial, in metres; states are then (K, ..., n).

        Returns:
          (..., O) in metres.

        Raises:
          InputError: as `bind`.
        """

    @abc.abstractmethod
    def slopes(self, dynamics: Dynamics, world: World, states: npt.ArrayLike) -> tuple[Array, Array]:
        """Signed distances to the obstacles, and their derivatives in the states.

        Args:
          dynamics: dynamics of the robot. world: the obstacles. states: (K, n).

        Returns:
          (K, O) in metres and (K, O, n).

        Raises:
          InputError: as `bind`.
        """

    @abc.abstractmethod
    def of_scene(self, scene: Scene) -> bool:
        """Whether these are the geoms of that scene, with its obstacles.

        Args:
          scene: the scene of a plant.
        """

    @abc.abstractmethod
    def travel(self, before: Array, after: Array) -> Array:
        """How far any point moves at most, in metres, on a straight line between states.

        Args:
          before: (..., n). after: (..., n).
        """

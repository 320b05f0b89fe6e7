"""A robot that begins elsewhere, and obstacles that are elsewhere."""

from collections.abc import Sequence

import numpy as np

from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import InputError
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import Effect, GaussianDisturbance, fit, normal, with_units, words
from lqrsim.simulation.plant import Plant


class InitialStateError(GaussianDisturbance):
    """The robot does not begin where the plan does.

    Args:
      std: standard deviation in the state's unit; one number, or one a state.
    """

    def describe(self, plant: Plant) -> str:
        return f"initial state off, std {with_units(self, self.std, plant.robot.dynamics.state_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        error = std * normal(generators, 1, len(std))[:, 0]
        return Effect(initial_states=lambda states: states + error)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        std = fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        return Uncertainty(start=tuple(std.tolist()) if std.any() else 0.0)


class DisplacedObstacles(GaussianDisturbance):
    """Obstacles are not where the plan has them. Planes stay, and for a robot that is seen from above, heights.

    Args:
      std: standard deviation in m; one number, or three along the world's axes.
    """

    along = "xyz"

    def describe(self, plant: Plant) -> str:
        return f"obstacles displaced, std {words(self.std)} m"

    def check(self, plant: Plant) -> None:
        if not any(obstacle.kind != "plane" for obstacle in plant.world.obstacles):
            raise InputError(
                f"DisplacedObstacles: got scene {plant.scene.name}, in which nothing but planes bounds robot"
                f" {plant.robot.name}, want one with obstacles"
            )

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        self.check(plant)
        displaced = fit(self, self.std, "xyz") * normal(generators, len(plant.world), 3)
        displaced[:, [obstacle.kind == "plane" for obstacle in plant.world.obstacles]] = 0.0
        if plant.robot.dynamics.state_coordinates.from_above:
            displaced[..., 2] = 0.0
        return Effect(displaced=displaced)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """One standard deviation for all axes: the root mean square of those that count.

        Args:
          plant: as in `uncertainty_of`.

        Returns:
          An Uncertainty with `obstacles`.
        """
        axes = 2 if plant.robot.dynamics.state_coordinates.from_above else 3
        return Uncertainty(obstacles=float(np.sqrt(np.mean(fit(self, self.std, "xyz")[:axes] ** 2))))

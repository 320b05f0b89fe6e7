"""The noise that a problem is stated with, `lqrsim.Noise`, in a run: what it plans for, it meets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, check_items
from lqrsim.problem.noise import Noise
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import Disturbance, Effect, check_strength, left_out, normal
from lqrsim.simulation.plant import Plant


@dataclass(frozen=True)
class StateNoise(Disturbance):
    """The state gets M(x, u) w more at the end of each control period, w drawn anew; x where the period began, u what
    the actuators got.

    Args:
      noise: whose M it is.
    """

    noise: Noise

    def describe(self, plant: Plant) -> str:
        return f"noise on the states, {self.noise!r}"

    def scaled(self, strength: float) -> "StateNoise":
        return StateNoise(self.noise.scaled(check_strength(self, strength)))

    def check(self, plant: Plant) -> None:
        self.noise.bind(plant.robot.dynamics)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        self.check(plant)
        draws = normal(generators, plan.steps, self.noise.size)

        def kick(step: int, states: Array, controls: Array) -> Array:
            matrices = self.noise.matrices(plant.robot.dynamics, states, controls)
            return sum(  # in an order that does not depend on how many trials there are
                (matrices[:, :, k] * draws[:, step, k, None] for k in range(1, self.noise.size)),
                start=matrices[:, :, 0] * draws[:, step, 0, None],
            )

        return Effect(kick=kick)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return left_out(self, plant, "it acts on the states at once, which filters and tubes do not have")


def as_disturbances(given: object, wanted: str) -> tuple[Disturbance, ...]:
    """Disturbances, a `Noise` among them as one. Raises InputError for what is neither."""
    items = check_items("disturbances", given, (Disturbance, Noise), wanted)
    return tuple(StateNoise(one) if isinstance(one, Noise) else one for one in items)

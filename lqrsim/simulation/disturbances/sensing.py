"""What is wrong with the states that the policy is shown, and links that lose what is sent over them.

White noise on them is in `noise.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, check_count, check_number
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import (
    Disturbance,
    Effect,
    GaussianDisturbance,
    check_strength,
    fit,
    left_out,
    normal,
    times,
    uniform,
    with_units,
)
from lqrsim.simulation.plant import Plant


class MeasurementBias(GaussianDisturbance):
    """A constant error of each state that the policy is shown, drawn for each trial from a normal distribution.

    Args:
      std: standard deviation in the state's unit; one number, or one a state.
    """

    def describe(self, plant: Plant) -> str:
        return f"measurement bias, std {with_units(self, self.std, plant.robot.dynamics.state_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        bias = std * normal(generators, 1, len(std))[:, 0]
        return Effect(measure=lambda step, states: states + bias)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        if not np.any(self.std):
            return Uncertainty()
        return left_out(self, plant, "no measurement tells it from the state itself")


@dataclass(frozen=True)
class MeasurementLatency(Disturbance):
    """The policy is shown the state of some control periods ago; until there is one, the first.

    Args:
      periods: how many.
    """

    periods: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "periods", check_count("MeasurementLatency: periods", self.periods, at_least=0))

    def describe(self, plant: Plant) -> str:
        return f"measurements late by {counted(self.periods)}"

    def scaled(self, strength: float) -> "MeasurementLatency":
        """The same with `strength` times the periods, rounded to whole ones.

        Args:
          strength: factor, 0 or more.

        Returns:
          A MeasurementLatency.
        """
        return replace(self, periods=int(times(self, self.periods, strength) + 0.5))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        seen: list[Array] = []

        def measure(step: int, states: Array) -> Array:
            seen.append(states.copy())
            return seen.pop(0) if len(seen) > self.periods else seen[0].copy()

        return Effect(measure=measure)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return Uncertainty(latency=self.periods)


@dataclass(frozen=True)
class GilbertElliott:
    """A link that loses in bursts: it is good or bad, and begins in its stationary state.

    Args:
      to_bad: probability per control period of turning bad while good.
      to_good: probability per control period of turning good while bad.
      lost_when_good: share that is lost while good.
      lost_when_bad: share that is lost while bad.
    """

    to_bad: float
    to_good: float
    lost_when_good: float = 0.0
    lost_when_bad: float = 1.0

    def __post_init__(self) -> None:
        for name in ("to_bad", "to_good", "lost_when_good", "lost_when_bad"):
            above, at_least = (0.0, None) if name == "to_good" else (None, 0.0)  # or a bad link stays bad forever
            field = f"GilbertElliott: {name}"
            value = check_number(field, getattr(self, name), above=above, at_least=at_least, at_most=1.0)
            object.__setattr__(self, name, value)

    @property
    def bad(self) -> float:
        """Share of the time in which the link is bad."""
        return self.to_bad / (self.to_bad + self.to_good)

    @property
    def lost(self) -> float:
        """Share that is lost, in the long run."""
        return (1 - self.bad) * self.lost_when_good + self.bad * self.lost_when_bad

    def draw(self, steps: int, generators: Sequence[np.random.Generator]) -> np.ndarray:
        """Draw whether each of T items is lost.

        Args:
          steps: T.
          generators: K of them, one per trial.

        Returns:
          (K, T), True where the item is lost.
        """
        numbers = uniform(generators, steps, 2)
        bad, lost = numbers[:, 0, 0] < self.bad, np.empty(numbers.shape[:2], dtype=bool)
        for t in range(steps):
            if t:
                bad = np.where(bad, numbers[:, t, 0] >= self.to_good, numbers[:, t, 0] < self.to_bad)
            lost[:, t] = numbers[:, t, 1] < np.where(bad, self.lost_when_bad, self.lost_when_good)
        return lost


class Dropouts(Disturbance):
    """What the losses of measurements and of commands share."""

    loss: float | GilbertElliott

    def _check_loss(self) -> None:
        if not isinstance(self.loss, GilbertElliott):
            loss = check_number(f"{type(self).__name__}: loss", self.loss, at_least=0.0, at_most=1.0)
            object.__setattr__(self, "loss", loss)

    def describe(self, plant: Plant) -> str:
        what = "measurements" if isinstance(self, MeasurementDropouts) else "commands"
        if not isinstance(self.loss, GilbertElliott):
            return f"{100 * self.loss:g} % of {what} lost"
        length = 1 / self.loss.to_good
        return f"{100 * self.loss.lost:.3g} % of {what} lost, in bad spells of {length:.3g} control periods on average"

    @property
    def share(self) -> float:
        """That is lost, in the long run."""
        return self.loss.lost if isinstance(self.loss, GilbertElliott) else self.loss

    def _scaled_loss(self, strength: float) -> float | GilbertElliott:
        strength, loss = check_strength(self, strength), self.loss
        if not isinstance(loss, GilbertElliott):
            return min(1.0, strength * loss)
        return replace(
            loss,
            to_bad=min(1.0, strength * loss.to_bad),
            lost_when_good=min(1.0, strength * loss.lost_when_good),
        )

    def draw(self, steps: int, generators: Sequence[np.random.Generator]) -> np.ndarray:
        """Whether each of T things that are sent is lost, (K, T)."""
        if isinstance(self.loss, GilbertElliott):
            return self.loss.draw(steps, generators)
        return uniform(generators, steps, 1)[..., 0] < self.loss


@dataclass(frozen=True)
class MeasurementDropouts(Dropouts):
    """Measurements get lost: the policy is shown the last that came; before the first, the plan's first state.

    Args:
      loss: probability that one is lost, each on its own; or `GilbertElliott`, in bursts.
    """

    loss: float | GilbertElliott

    def __post_init__(self) -> None:
        self._check_loss()

    def scaled(self, strength: float) -> "MeasurementDropouts":
        """The same with `strength` times as many losses or bad spells, at most all.

        Args:
          strength: factor, 0 or more.

        Returns:
          A MeasurementDropouts.
        """
        return replace(self, loss=self._scaled_loss(strength))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        lost = self.draw(plan.steps + 1, generators)
        last = np.tile(plan.states[0], (len(generators), 1))

        def measure(step: int, states: Array) -> Array:
            last[~lost[:, step]] = states[~lost[:, step]]
            return last.copy()

        return Effect(measure=measure)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """The share lost, as if each loss were independent.

        Args:
          plant: as in `uncertainty_of`.

        Returns:
          An Uncertainty with `loss`.
        """
        return Uncertainty(loss=self.share)


@dataclass(frozen=True)
class CommandDropouts(Dropouts):
    """Commands get lost: the actuators keep the last that came; before the first, the plan's first control.

    Args:
      loss: probability that one is lost, each on its own; or `GilbertElliott`, in bursts.
    """

    loss: float | GilbertElliott

    def __post_init__(self) -> None:
        self._check_loss()

    def scaled(self, strength: float) -> "CommandDropouts":
        """The same with `strength` times as many losses or bad spells, at most all.

        Args:
          strength: factor, 0 or more.

        Returns:
          A CommandDropouts.
        """
        return replace(self, loss=self._scaled_loss(strength))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        lost = self.draw(plan.steps, generators)
        last = np.tile(plan.controls[0], (len(generators), 1))

        def actuate(step: int, controls: Array) -> Array:
            last[~lost[:, step]] = controls[~lost[:, step]]
            return last.copy()

        return Effect(actuate=actuate)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        if self.share == 0:
            return Uncertainty()
        return left_out(self, plant, "what it does depends on how the commands change, and no noise does")


def counted(periods: int) -> str:
    """`1 control period`, `2 control periods`."""
    return f"{periods} control period{'' if periods == 1 else 's'}"

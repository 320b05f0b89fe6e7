"""Links to sensors and actuators: late or lost measurements and commands."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Index, Share, checked
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, check_number, keep
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import Disturbance, Effect, uniform
from lqrsim.simulation.plant import Plant


@checked
@dataclass(frozen=True)
class Late(Disturbance):
    """Base class of delays, in control periods."""

    periods: Index

    what: ClassVar[str]
    hook: ClassVar[Literal["measure", "actuate"]]  # the field of an `Effect`
    uncertainty_field: ClassVar[str]  # the field of an Uncertainty

    def describe(self, plant: Plant) -> str:
        return f"{self.what} late by {self.periods} control period{'' if self.periods == 1 else 's'}"

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return replace(Uncertainty(), **{self.uncertainty_field: self.periods})

    def scaled(self, strength: float) -> Self:
        """The delay with `strength` times the periods, rounded to whole periods."""
        return replace(self, periods=int(self._times(self.periods, strength) + 0.5))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        under_way: list[Array] = []

        def carry(step: int, values: Array) -> Array:
            under_way.append(values.copy())
            if len(under_way) > self.periods:
                return under_way.pop(0)
            return under_way[0].copy() if self.hook == "measure" else np.tile(plan.controls[step], (len(values), 1))

        return replace(Effect(), **{self.hook: carry})


class ControlDelay(Late):
    """Commands arrive late, by control periods; until the first one arrives, the plan's controls are applied."""

    what, hook, uncertainty_field = "commands", "actuate", "delay"


class MeasurementLatency(Late):
    """Measurements arrive late, by control periods; until then the first one is repeated."""

    what, hook, uncertainty_field = "measurements", "measure", "latency"


@checked
@dataclass(frozen=True)
class GilbertElliott:
    """A link with losses in bursts. It has a good and a bad state, and begins with their stationary distribution.

    Args:
      to_bad: probability per control period of turning bad while good.
      to_good: probability per control period of turning good while bad.
    """

    to_bad: Share
    to_good: Annotated[float, Bounds(above=0.0, at_most=1.0)]  # or a bad link stays bad forever
    lost_when_good: Share = 0.0
    lost_when_bad: Share = 1.0

    @property
    def bad(self) -> float:
        """The fraction of the time in which the link is bad."""
        return self.to_bad / (self.to_bad + self.to_good)

    @property
    def lost(self) -> float:
        """The fraction that is lost in the long run."""
        return (1 - self.bad) * self.lost_when_good + self.bad * self.lost_when_bad

    def draw(self, steps: int, generators: Sequence[np.random.Generator]) -> npt.NDArray[np.bool_]:
        """Whether each of T items is lost in each of K trials, (K, T)."""
        numbers = uniform(generators, steps, 2)
        bad, lost = numbers[:, 0, 0] < self.bad, np.empty(numbers.shape[:2], dtype=bool)
        for t in range(steps):
            if t:
                bad = np.where(bad, numbers[:, t, 0] >= self.to_good, numbers[:, t, 0] < self.to_bad)
            lost[:, t] = numbers[:, t, 1] < np.where(bad, self.lost_when_bad, self.lost_when_good)
        return lost


@dataclass(frozen=True)
class Dropouts(Disturbance):
    """Base class of losses on a link."""

    loss: float | GilbertElliott

    what: ClassVar[str]
    discrete = True
    hook: ClassVar[Literal["measure", "actuate"]]  # the field of an `Effect`
    uncertainty_field: ClassVar[str]  # the field of an Uncertainty

    def __post_init__(self) -> None:
        if not isinstance(self.loss, GilbertElliott):
            keep(self, loss=check_number(f"{type(self).__name__}: loss", self.loss, at_least=0.0, at_most=1.0))

    def describe(self, plant: Plant) -> str:
        if not isinstance(self.loss, GilbertElliott):
            return f"{100 * self.loss:g} % of {self.what} lost"
        lost, length = f"{100 * self.loss.lost:.3g} % of {self.what} lost", 1 / self.loss.to_good
        return f"{lost}, in bad spells of {length:.3g} control periods on average"

    @property
    def share(self) -> float:
        return self.loss.lost if isinstance(self.loss, GilbertElliott) else self.loss

    def scaled(self, strength: float) -> Self:
        """The link with `strength` times as many losses or bad spells; at most everything is lost."""
        strength, loss = self._strength(strength), self.loss
        if not isinstance(loss, GilbertElliott):
            return replace(self, loss=min(1.0, strength * loss))
        to_bad, lost = min(1.0, strength * loss.to_bad), min(1.0, strength * loss.lost_when_good)
        return replace(self, loss=replace(loss, to_bad=to_bad, lost_when_good=lost))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """The fraction that is lost, as if losses were independent."""
        return replace(Uncertainty(), **{self.uncertainty_field: self.share})

    def draw(self, steps: int, generators: Sequence[np.random.Generator]) -> npt.NDArray[np.bool_]:
        if isinstance(self.loss, GilbertElliott):
            return self.loss.draw(steps, generators)
        return uniform(generators, steps, 1)[..., 0] < self.loss

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        steps, first = plan.steps, plan.controls[0]
        if self.hook == "measure":
            steps, first = steps + 1, plan.states[0]
        lost, last = self.draw(steps, generators), np.tile(first, (len(generators), 1))

        def receive(step: int, values: Array) -> Array:
            last[~lost[:, step]] = values[~lost[:, step]]
            return last.copy()

        return replace(Effect(), **{self.hook: receive})


class MeasurementDropouts(Dropouts):
    """Measurements are lost, each with the probability `loss`, or in bursts by `GilbertElliott`.

    The last measurement that arrived is repeated; at first, the plan's first state.
    """

    what, hook, uncertainty_field = "measurements", "measure", "loss"


class CommandDropouts(Dropouts):
    """Commands are lost, each with the probability `loss`, or in bursts by `GilbertElliott`.

    The actuators keep the last command that arrived; at first, the plan's first control.
    """

    what, hook, uncertainty_field = "commands", "actuate", "command_loss"

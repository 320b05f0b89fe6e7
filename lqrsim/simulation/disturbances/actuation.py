"""Actuators that lag, have narrower limits, or fail; and the links to them and to sensors, with delays and losses.

Noise on controls and measurements is in `noise.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.annotations import Bounds, Index, NonNegative, Share, Want, checked
from lqrsim.control.plan_model import Lag
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_name, check_number, keep
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import Disturbance, Effect, Numbers, uniform, with_units
from lqrsim.simulation.plant import Plant

_FIXED = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))


@checked
@dataclass(frozen=True)
class MotorLag(Disturbance):
    """Actuators follow their commands, within the limits, with a first-order lag, from the plan's first control on.

    The control that is applied in a control period is the exact mean over the period.
    """

    time_constant: NonNegative

    _scales = "time_constant"

    def describe(self, plant: Plant) -> str:
        return f"motor lag, time constant {self.time_constant:g} s"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        if self.time_constant == 0:
            return Effect()
        lag = Lag.of(self.time_constant, plan.dt)
        space, reached = plant.robot.dynamics.control_coordinates, np.tile(plan.controls[0], (len(generators), 1))

        def actuate(step: int, controls: Array) -> Array:
            controls = space.clip(controls)
            behind = reached - controls
            reached[:] = controls + lag.left * behind
            return controls + lag.mean * behind

        return Effect(actuate=actuate)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return Uncertainty(lag=self.time_constant)


@checked
@dataclass(frozen=True)
class Saturation(Disturbance):
    """Control limits that are narrower than the robot's own.

    Args:
      lowest: lower limits in the control's unit, within the robot's limits: one number, or one per control. None keeps
        the robot's lower limits.
      highest: the upper limits, in the same form.
      share: in place of lowest and highest, the remaining fraction of the robot's own limits, 0 to 1.
      strength: interpolates from the robot's own limits (0) to these (1), and beyond, until they meet.
    """

    lowest: Numbers | None = None
    highest: Numbers | None = None
    share: Share | None = None
    strength: NonNegative = 1.0

    _scales = "strength"

    def __post_init__(self) -> None:
        stated = [name for name in ("lowest", "highest") if getattr(self, name) is not None]
        if bool(stated) == (self.share is not None):
            got = "both" if stated else "neither"
            raise InputError(f"Saturation: share: got {got} share and limits, want lowest, highest or both, or a share")
        for name in stated:
            keep(self, **{name: self._checked(name, getattr(self, name))})

    def describe(self, plant: Plant) -> str:
        space = plant.robot.dynamics.control_coordinates
        if self.share is not None:
            limits = f"to {100 * self.share:g} % of the robot's own"
        else:
            sides = {"from": self.lowest, "to": self.highest}
            limits = " ".join(
                f"{word} {with_units(self._fit(v, space), space)}" for word, v in sides.items() if v is not None
            )
        strength = f", strength {self.strength:g}" if self.strength != 1 else ""
        return f"controls limited {limits}{strength}"

    def limits(self, plant: Plant) -> tuple[Array, Array]:
        """The narrowed limits, which the robot's own limits must contain."""
        space = plant.robot.dynamics.control_coordinates
        full = np.array(space.limits)
        if self.share is not None:
            if not np.isfinite(full).all():
                raise InputError(f"Saturation: share: got robot {plant.robot.name} without limits, want one with them")
            # If a range does not contain zero, only its far side moves.
            wanted = np.array([np.maximum(full[0], self.share * full[0]), np.minimum(full[1], self.share * full[1])])
        else:
            sides = zip(("lowest", "highest"), (self.lowest, self.highest), full, strict=True)
            wanted = np.array([self._fit(o if v is None else v, space.names, name) for name, v, o in sides])
        wrong = (wanted != np.clip(wanted, *full)).any(axis=0) | (wanted[0] > wanted[1])
        if wrong.any():
            i = int(wrong.argmax())
            own = f"a range within that of {plant.robot.name}, {full[0, i]:g} to {full[1, i]:g}"
            raise InputError(f"Saturation: got {wanted[0, i]:g} to {wanted[1, i]:g} for {space.names[i]}, want {own}")
        if self.strength != 1:
            moved = wanted != full
            if not np.isfinite(full[moved]).all():
                raise InputError(f"Saturation: strength: got {self.strength:g} for a robot without limits, want 1")
            by = np.zeros_like(full)
            by[moved] = wanted[moved] - full[moved]
            closing, width = by[0] - by[1], full[1] - full[0]
            meeting = np.divide(width, closing, out=np.full(len(space), np.inf), where=closing > 0)
            wanted = full + np.minimum(self.strength, meeting) * by
            met = self.strength >= meeting
            wanted[:, met] = np.minimum(wanted[0], full[1])[met]
        return wanted[0], wanted[1]

    def check(self, plant: Plant) -> None:
        self.limits(plant)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        low, high = self.limits(plant)
        return Effect(actuate=lambda step, controls: np.clip(controls, low, high))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        space = plant.robot.dynamics.control_coordinates
        if np.array_equal(self.limits(plant), (space.low, space.high)):
            return Uncertainty()
        return self._left_out(plant, "limits are not linear, and a law uses the robot's own")


@checked
@dataclass(frozen=True)
class ActuatorLoss(Disturbance):
    """An actuator fails for good: its force in MuJoCo drops to a fraction. A wheel that loses its drive turns freely.

    Args:
      actuator: one of the robot's `actuators`; None draws one for each trial.
      at: seconds after the start; the loss begins with the next control period.
      remaining: fraction of the force that remains, 0 to 1.
    """

    actuator: Annotated[str, Want("a name, or None to draw one")] | None = None
    at: NonNegative = 0.0
    remaining: Share = 0.0

    discrete = True

    def describe(self, plant: Plant) -> str:
        which = self.actuator or f"one of {', '.join(plant.robot.actuators)}"
        return f"{which} down to {100 * self.remaining:g} % from {self.at:g} s on"

    def scaled(self, strength: float) -> "ActuatorLoss":
        """The same with `strength` times the loss, at most a complete loss."""
        lost = min(1.0, self._times(1 - self.remaining, strength))
        return replace(self, remaining=self.remaining if strength == 1 else 1 - lost)

    def check(self, plant: Plant) -> None:
        if self.actuator is not None:
            check_name(f"ActuatorLoss: actuator of {plant.robot.name}", self.actuator, plant.robot.actuators)
        plant.check_simulator("ActuatorLoss")
        check_gains(self, plant)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        # A time within rounding of a knot counts as that knot.
        period = int(np.ceil(min(self.at / plan.dt, plan.steps) - 1e-9))
        if period >= plan.steps:
            last = f"the last control period of the plan, which ends at {plan.horizon:g} s"
            raise InputError(f"ActuatorLoss: at: got {self.at:g} s, want a time before {last}")
        if self.actuator is None:
            lost = plant.actuators[[int(generator.integers(len(plant.actuators))) for generator in generators]]
        else:
            lost = np.full(len(generators), plant.actuators[plant.robot.actuators.index(self.actuator)])
        trials, parameters = np.arange(len(generators)), []

        def alter(simulations: batch.Batch) -> None:
            parameters.extend(simulations.expand(field) for field in ("actuator_gainprm", "actuator_biasprm"))

        def actuate(step: int, controls: Array) -> Array:
            for values in parameters if step == period else ():
                values[trials, lost] *= self.remaining
            return controls

        return Effect(alter=alter, actuate=actuate)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "it is not a small deviation, and comes once", acts=self.remaining != 1)


def check_gains(disturbance: Disturbance, plant: Plant) -> None:
    """Raise InputError unless the forces of the robot's actuators are proportional to their gains and biases."""
    for name, number in zip(plant.robot.actuators, plant.actuators, strict=True):
        if plant.model.actuator_gaintype[number] not in _FIXED or plant.model.actuator_biastype[number] not in (0, 1):
            got = f"robot {plant.robot.name}, whose actuator {name!r} has a gain or bias of another type"
            raise InputError(f"{type(disturbance).__name__}: got {got}, want fixed or affine")


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


class MeasurementDropouts(Dropouts):
    """Measurements are lost, each with the probability `loss`, or in bursts by `GilbertElliott`.

    A filter is told. For other controllers the last measurement that arrived is repeated; at first, the plan's first
    state.
    """

    what, uncertainty_field = "measurements", "loss"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        lost = self.draw(plan.steps + 1, generators)
        return Effect(measure=lambda step, states: np.where(lost[:, step, None], np.nan, states))


class CommandDropouts(Dropouts):
    """Commands are lost, each with the probability `loss`, or in bursts by `GilbertElliott`.

    The actuators keep the last command that arrived; at first, the plan's first control.
    """

    what, uncertainty_field = "commands", "command_loss"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        lost, in_force = self.draw(plan.steps, generators), np.tile(plan.controls[0], (len(generators), 1))

        def actuate(step: int, controls: Array) -> Array:
            in_force[~lost[:, step]] = controls[~lost[:, step]]
            return in_force.copy()

        return Effect(actuate=actuate)

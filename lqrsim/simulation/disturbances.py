"""What goes wrong in a run: one class a disturbance, in physical units, drawn for each trial from its own generator.

To add one, subclass `Disturbance` and give it a `start`. It is called once a run, and returns what the closed loop then
calls in every control period, on all trials at once: functions, so that they may look at the state (wind that depends
on where the robot is) or remember the past (a delay).
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError, check_array, check_number
from lqrsim.results import Trajectory
from lqrsim.simulation.plant import Plant

Hook = Callable[[int, Array], Array]
Numbers = float | Sequence[float]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """What a disturbance does in one run of K trials. Functions of the control period's number; None does nothing.

    Attributes:
      measure: (step, states (K, n)) -> the states that the policy is shown, (K, n); step runs to T inclusive.
      actuate: (step, controls (K, m)) -> the controls on their way to the actuators, (K, m), which then saturate.
      force: (step, true states (K, n)) -> force at the robot's centre of mass in N, world axes, (K, 3).
    """

    measure: Hook | None = None
    actuate: Hook | None = None
    force: Hook | None = None


class Disturbance(abc.ABC):
    """Base class of all disturbances."""

    def describe(self, plant: Plant) -> str:
        """In words and units, for the record; unless it is overridden, how the object is made."""
        return repr(self)

    @abc.abstractmethod
    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        """Begin a run of one trial a generator. A trial's numbers may come from its own generator only.

        Raises:
          InputError: the disturbance does not fit the plant or the plan.
        """


@dataclass(frozen=True)
class ControlNoise(Disturbance):
    """White noise on each control, redrawn each control period.

    Args:
      std: standard deviation in the control's unit (N of a rotor, m/s of a wheel); one number, or one a control.
    """

    std: Numbers

    def __post_init__(self) -> None:
        object.__setattr__(self, "std", _check_std(self, self.std))

    def describe(self, plant: Plant) -> str:
        return f"control noise, std {_with_units(self, self.std, plant.robot.dynamics.control_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = _fit(self, self.std, plant.robot.dynamics.control_coordinates.names)
        noise = std * _normal(generators, plan.steps, len(std))
        return Effect(actuate=lambda step, controls: controls + noise[:, step])


@dataclass(frozen=True)
class MeasurementNoise(Disturbance):
    """White noise on each state that the policy is shown.

    Args:
      std: standard deviation in the state's unit; one number, or one a state.
    """

    std: Numbers

    def __post_init__(self) -> None:
        object.__setattr__(self, "std", _check_std(self, self.std))

    def describe(self, plant: Plant) -> str:
        return f"measurement noise, std {_with_units(self, self.std, plant.robot.dynamics.state_coordinates)}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        std = _fit(self, self.std, plant.robot.dynamics.state_coordinates.names)
        noise = std * _normal(generators, plan.steps + 1, len(std))
        return Effect(measure=lambda step, states: states + noise[:, step])


@dataclass(frozen=True)
class ForceNoise(Disturbance):
    """A random force at the robot's centre of mass, redrawn each control period and held over it.

    Args:
      std: standard deviation in N; one number, or three along the world's axes.
    """

    std: Numbers

    def __post_init__(self) -> None:
        object.__setattr__(self, "std", _check_std(self, self.std))
        _fit(self, self.std, "xyz")

    def describe(self, plant: Plant) -> str:
        return f"force noise, std {_words(self.std)} N"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        forces = _fit(self, self.std, "xyz") * _normal(generators, plan.steps, 3)
        return Effect(force=lambda step, states: forces[:, step])


@dataclass(frozen=True)
class Push(Disturbance):
    """One push at the robot's centre of mass, spread over the control period in which it comes.

    Args:
      impulse: in N s along the world's axes, (3,).
      at: seconds after the start.
    """

    impulse: Sequence[float]
    at: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "impulse", tuple(check_array("Push: impulse", self.impulse, (3,)).tolist()))
        object.__setattr__(self, "at", check_number("Push: at", self.at, at_least=0.0))

    def describe(self, plant: Plant) -> str:
        return f"push of {_words(self.impulse)} N s at {self.at:g} s"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        period = int(self.at / plan.dt + 1e-9)  # a time that is a knot up to rounding belongs to the period after it
        if period >= plan.steps:
            raise InputError(f"Push: at: got {self.at:g} s, want a time before the plan ends at {plan.horizon:g} s")
        forces = np.zeros((plan.steps, 3))
        forces[period] = np.array(self.impulse) / plan.dt
        return Effect(force=lambda step, states: np.broadcast_to(forces[step], (len(states), 3)))


def _normal(generators: Sequence[np.random.Generator], steps: int, size: int) -> Array:
    """Standard normal numbers (K, steps, size), each trial's from its own generator."""
    return np.stack([generator.standard_normal((steps, size)) for generator in generators])


def _check_std(disturbance: Disturbance, std: Numbers) -> Numbers:
    field = f"{type(disturbance).__name__}: std"
    if np.ndim(std) == 0:
        return check_number(field, std, at_least=0.0)
    values = check_array(field, std, (None,))
    if (values < 0).any():
        raise InputError(f"{field}: got {values.min():g}, want numbers >= 0")
    return tuple(values.tolist())


def _fit(disturbance: Disturbance, std: npt.ArrayLike, names: Sequence[str]) -> Array:
    """`std` as one number for each of `names`. Raises InputError if it has another number of them."""
    values = np.asarray(std, dtype=np.float64)
    if values.ndim and len(values) != len(names):
        raise InputError(
            f"{type(disturbance).__name__}: std: got {len(values)} numbers, want 1 or {len(names)}: {', '.join(names)}"
        )
    return np.broadcast_to(values, len(names))


def _with_units(disturbance: Disturbance, std: Numbers, coordinates: Coordinates) -> str:
    """The numbers with their units, each unit once where its numbers are the same: `0.01 m, 0.02 rad`."""
    values = _fit(disturbance, std, coordinates.names)
    of_unit = {
        unit: [v for v, u in zip(values, coordinates.units, strict=True) if u == unit] for unit in coordinates.units
    }
    return ", ".join(f"{_words(v if len(set(v)) > 1 else v[0])} {unit}".rstrip() for unit, v in of_unit.items())


def _words(numbers: Numbers) -> str:
    values = np.atleast_1d(numbers)
    text = ", ".join(f"{value:g}" for value in values)
    return text if np.ndim(numbers) == 0 else f"({text})"

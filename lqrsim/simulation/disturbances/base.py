"""The base classes of disturbances, and their effects in a run.

To add one, subclass `Disturbance` and implement `start`. It is called once per run, and returns an `Effect`: functions
that the closed loop calls in every control period for all trials at once. They may use the state (wind that depends on
the position) or remember the past (a delay). `Effects` calls them, one after the other, and checks what they return.
"""

import abc
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.annotations import LINE, Want, check_string, checked
from lqrsim.control.uncertainty import Uncertainty, Unknown, per_entry, possible_unknowns
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_kind,
    check_name,
    check_number,
    excerpt,
    keep,
    real,
    shaped,
    without_addresses,
)
from lqrsim.results.coordinates import Coordinates, PerEntry
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.physics import AnyPhysics, MujocoPhysics
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.simulator import PARAMETERS

ONE, TWO = Want("a function of one argument, or None"), Want("a function of the step and an array, or None")
Hook = Annotated[Callable[[int, Array], Array], TWO]
ReadHook = Annotated[Callable[[int, dict[str, Array]], dict[str, Array]], TWO]
Kick = Annotated[Callable[[int, Array, Array], Array], Want("a function of the step, states and controls, or None")]
Numbers = float | Sequence[float]
MakeGenerator = Annotated[
    Callable[[int, int], np.random.Generator],
    Want("a function of the trial and the disturbance's number that returns a numpy.random.Generator"),
]


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """The effect of a disturbance on a run of K trials. A field of None has no effect. Steps count control periods.

    Each function must give a trial the same bits whatever other trials run with it. It must not sum over trials.

    Attributes:
      initial_states: (first states of the plan (K, n)) -> first states of the trials, (K, n).
      factors: "mass" or "inertia" -> (K, 1), or "thrust" -> (K, actuators): factors of these parameters of the robot.
      alter: called once, before the first step, with MuJoCo's simulations; `simulations.expand(field)` gives each trial
        its own values of a field of the model; the first axis is the trial. Refused for other simulators.
      measure: (step, states (K, n)) -> measured states, (K, n), a row of NaN for one that gets lost; step runs to T
        inclusive.
      read: (step, readings (K, any) by the sensor's name) -> the same with errors; NaN for a reading that gets lost.
        It is called for a controller that reads sensors of the MJCF.
      actuate: (step, controls (K, m)) -> controls at the actuators, before they saturate, (K, m).
      force: (step, true states (K, n)) -> force at the centre of mass of the robot's body in N, world axes, (K, 3).
      torque: (step, true states (K, n)) -> torque on the robot in N m, world axes, (K, 3).
      wind: (step, true states (K, n)) -> wind in m/s, world axes, (K, 3): the velocity of the medium if the plant
        `has_medium`, and a force of `robot.drag` times the wind unless a simulator has a wind.
      kick: (step, true states (K, n), saturated controls (K, m)) -> jump of the states at the end of the control
        period, (K, n).
      displaced: (K, obstacles, 3), displacement of each of the plant's obstacles from its place in the scene, in m.
    """

    initial_states: Annotated[Callable[[Array], Array], ONE] | None = None
    factors: Annotated[Mapping[str, Array], Want("factors by name: {'mass': factors}")] | None = None
    alter: Annotated[Callable[[batch.Batch], None], ONE] | None = None
    measure: Hook | None = None
    read: ReadHook | None = None
    actuate: Hook | None = None
    force: Hook | None = None
    torque: Hook | None = None
    wind: Hook | None = None
    kick: Kick | None = None
    displaced: Annotated[Array, "K obstacles 3"] | None = None

    def __post_init__(self) -> None:
        if self.factors is not None:
            factors: dict[str, Array] = {}
            for name, factor in self.factors.items():
                check_name("Effect: factors", name, PARAMETERS)
                factors[name] = check_array(f"Effect: factors: {name}", factor, (None, None))
                if not (factors[name] > 0).all():
                    raise InputError(f"Effect: factors: {name}: got {factors[name].min():g}, want numbers > 0")
            keep(self, factors=factors)


class Disturbance(abc.ABC):
    """Base class of all disturbances.

    Attributes:
      discrete: whether its draws have few values, such as those that decide on a loss. Failures that such draws alone
        cause can be missed by a splitting.
    """

    discrete: ClassVar[bool] = False
    _scales: ClassVar[str] = ""  # the field of a dataclass that is proportional to the effect

    def describe(self, plant: Plant) -> str:
        """The disturbance in words and units, for records; by default its repr, without addresses of objects."""
        return without_addresses(repr(self))

    def scaled(self, strength: float) -> "Disturbance":
        """The disturbance with `strength` times the effect, for sweeps: 0 has none, 1 is the disturbance itself."""
        if self._scales:
            disturbance: Any = self
            return replace(disturbance, **{self._scales: self._times(getattr(self, self._scales), strength)})
        got = f"{type(self).__name__}: got strength {self._strength(strength):g}"
        raise InputError(f"{got}, want one that overrides `scaled`")

    def check(self, plant: Plant) -> None:  # noqa: B027 - most plants can have most disturbances
        """Raise an InputError for a plant that cannot have this disturbance; called before each `start`."""

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """The disturbance in numbers, for `uncertainty_of`. By default it is left out, with a reason."""
        return self._left_out(plant, f"{type(self).__name__} does not override `uncertainty`")

    @abc.abstractmethod
    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        """The effect on a run of K trials, one per generator, from which alone its random numbers must come."""

    # For `uncertainty`.

    def _together(self, other: "Disturbance") -> "Disturbance | None":
        """A single disturbance with the effect of both, if both are fixed values of one kind; None for others."""
        return None

    def _left_out(self, plant: Plant, why: str, *, acts: bool = True) -> Uncertainty:
        """No linear model represents it: its description and the reason, if it acts."""
        return Uncertainty(left_out=(f"{self.describe(plant)}: {why}",) if acts else ())

    def _unknowns(self, plant: Plant, wanted: Iterable[Unknown]) -> Uncertainty:
        """The unknowns that are not zero. Unknowns that the robot's dynamics lack are listed as left out, by name."""
        known, missing = possible_unknowns(plant.robot.dynamics), dict[str, None]()
        unknowns = list[Unknown]()
        for unknown in wanted:
            if unknown.std == 0:
                continue
            missing |= dict.fromkeys(name for name in unknown.shares if name not in known)
            shares = {name: share for name, share in unknown.shares.items() if name in known}
            if shares:
                unknowns.append(replace(unknown, of=shares))
        why = f"the dynamics of robot {plant.robot.name} have no {', '.join(missing)}"
        return replace(self._left_out(plant, why, acts=bool(missing)), unknowns=unknowns)

    # Fields that are numbers: one, or one for each component; and strengths.

    def _checked(self, name: str, numbers: PerEntry, *, at_least: float = -np.inf, by_name: bool = False) -> Any:
        """A field as a number, a tuple or, if it may have them, numbers by name or unit."""
        field, lowest = f"{type(self).__name__}: {name}", at_least if np.isfinite(at_least) else None
        if isinstance(numbers, Mapping):
            if not by_name:
                raise InputError(f"{field}: got numbers by name, want one number, or one for each component in order")
            if not numbers:
                raise InputError(f"{field}: got no numbers, want at least one")
            keys = [check_string(f"{field}: name", key, LINE) for key in numbers]
            return {key: check_number(f"{field}: {key}", numbers[key], at_least=lowest) for key in keys}
        if real(field, numbers).ndim == 0:
            return check_number(field, numbers, at_least=lowest)
        values = check_array(field, numbers, (None,))
        if not len(values):
            raise InputError(f"{field}: got no numbers, want at least one")
        if (values < at_least).any():
            raise InputError(f"{field}: got {values.min():g}, want numbers >= {at_least:g}")
        return tuple(values.tolist())

    def _fit(self, numbers: PerEntry, components: Coordinates | Sequence[str], field: str = "std") -> Array:
        """A field as one number for each component."""
        names = components.names if isinstance(components, Coordinates) else components
        if isinstance(numbers, Mapping):
            assert isinstance(components, Coordinates)
            return per_entry(f"{type(self).__name__}: {field}", numbers, components)
        values = np.asarray(numbers, dtype=np.float64)
        if values.ndim and len(values) != len(names):
            want = f"1 or {len(names)}: {', '.join(names)}"
            raise InputError(f"{type(self).__name__}: {field}: got {len(values)} numbers, want {want}")
        return np.broadcast_to(values, len(names))

    def _strength(self, strength: float) -> float:
        return check_number(f"{type(self).__name__}: strength", strength, at_least=0.0)

    def _times(self, numbers: PerEntry, strength: float) -> Any:
        """Numbers times the strength, which must not be so large that they overflow."""
        if isinstance(numbers, Mapping):
            return {name: self._times(number, strength) for name, number in numbers.items()}
        with np.errstate(over="ignore"):
            product = self._strength(strength) * np.asarray(numbers, dtype=np.float64)
        if not np.isfinite(product).all():
            raise InputError(f"{type(self).__name__}: strength: got {strength:g}, want less: the result overflows")
        return float(product) if product.ndim == 0 else tuple(product.tolist())


@dataclass(frozen=True)
class GaussianDisturbance(Disturbance):
    """Base class of disturbances that are drawn from normal distributions of mean zero."""

    std: PerEntry  # one number, or one for each component

    _scales = "std"
    along: ClassVar[str] = ""  # the components, if they are the same for every plant
    by_name: ClassVar[bool] = False  # whether numbers may have the names or units of the components

    def __post_init__(self) -> None:
        keep(self, std=self._checked("std", self.std, at_least=0.0, by_name=self.by_name))
        if self.along:
            self._fit(self.std, self.along)


class Effects:
    """The effects of disturbances on K trials, started; `displaced` are the obstacles, by (K, obstacles, 3) m."""

    def __init__(
        self, plant: Plant, plan: Trajectory, disturbances: Sequence[Disturbance], trials: range, make: MakeGenerator
    ) -> None:
        self._effects: list[tuple[str, Effect]] = []
        for stream, disturbance in enumerate(disturbances):
            name = type(disturbance).__name__
            disturbance.check(plant)
            effect = disturbance.start(plant, plan, _Streams(make, trials, stream))
            self._effects.append((name, check_kind(f"{name}.start", effect, Effect, "an Effect")))
        self.displaced = np.zeros((len(trials), len(plant.world), 3))
        for name, effect in self._effects:
            if effect.displaced is not None:
                self.displaced += shaped(f"{name}: displaced", effect.displaced, self.displaced.shape)
        if not np.isfinite(self.displaced).all():
            raise InputError("disturbances: got infinite displacements of obstacles, want finite numbers")
        self._arrived = np.tile(plan.states[0], (len(trials), 1))  # the last measurements that arrived
        self._measures, self._actuations = self._hooks("measure"), self._hooks("actuate")
        self._reads, self._kicks = self._hooks("read"), self._hooks("kick")
        kinds = "torque", "force", "wind"
        self._pushes = [(kind, *hook) for one in self._effects for kind in kinds for hook in self._hooks(kind, [one])]
        self._has_medium = plant.has_medium
        # An MJCF may have a drag beside its fluid; a simulator with a wind has its own.
        self._drag = 0.0 if plant.has_medium and plant.simulator is not None else plant.robot.drag

    def _hooks(self, kind: str, effects: Sequence[tuple[str, Effect]] | None = None) -> list[tuple[str, Any]]:
        """The hooks of one kind, of all effects or these, each with its label for messages."""
        hooks = [(name, getattr(effect, kind)) for name, effect in effects or self._effects]
        return [(f"{name}: {kind}: returned", hook) for name, hook in hooks if hook is not None]

    def initial_states(self, planned: Array, starts: Array | None = None) -> Array:
        """The first states (K, n) of the trials, from the plan's; or `starts`, which no disturbance may change."""
        states = planned
        for name, effect in self._effects:
            if effect.initial_states is None:
                continue
            states = shaped(f"{name}: initial_states: returned", effect.initial_states(states.copy()), planned.shape)
            if starts is not None and not np.array_equal(states, planned):
                raise InputError(f"disturbances: got {name}, which changes the start, want others: states are given")
        states = states if starts is None else starts
        if not np.isfinite(states).all():
            raise InputError("disturbances: got an infinite first state, want finite numbers")
        return states

    def alter_models(self, physics: AnyPhysics) -> bool:
        """Alter the models of the trials; return whether anything was altered, for `prepare`, which must follow."""
        for name, effect in self._effects:
            for parameter, factors in (effect.factors or {}).items():
                columns = len(physics.plant.actuators) if parameter == "thrust" else 1
                shape = len(self.displaced), columns
                physics.multiply(parameter, shaped(f"{name}: factors: {parameter}", factors, shape))
            if effect.alter is not None:
                physics.plant.check_simulator(name)
                assert isinstance(physics, MujocoPhysics)
                effect.alter(physics.simulations)
        moved = bool(self.displaced.any())
        if moved:
            physics.displace(self.displaced)
        return moved or any(effect.alter or effect.factors for _, effect in self._effects)

    def follow(self, step: int, states: Array, controls: Array) -> None:
        """Call all hooks with the plan's states (K, n) and controls (K, m), for disturbances that have a memory.

        Those of readings are called where a controller reads: see `Readings.arriving`.
        """
        self.measure(step, states)
        for _, actuate in self._actuations:
            actuate(step, controls.copy())
        self.push(step, states)
        for _, kick in self._kicks:
            kick(step, states, controls)

    def measure(self, step: int, states: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The measured states (K, n) for the true states, and which got lost, (K,): the last ones that arrived."""
        measured, lost = states.copy(), np.zeros(len(states), dtype=bool)
        for name, measure in self._measures:
            measured = shaped(name, measure(step, measured), measured.shape)
        if self._measures:
            lost |= np.isnan(measured).all(axis=1)
            measured = self._arrived = np.where(lost[:, None], self._arrived, measured)
        return measured.copy(), lost

    def read(self, step: int, readings: dict[str, Array]) -> dict[str, Array]:
        """The readings (K, any) of sensors, by name, with errors."""
        for label, read in self._reads:
            noisy = check_kind(label, read(step, dict(readings)), dict, "readings by the names of sensors")
            readings = {
                name: shaped(f"{label}: {name}", noisy.get(name), reading.shape) for name, reading in readings.items()
            }
        return readings

    def actuate(self, step: int, controls: Array) -> Array:
        """The disturbed controls (K, m), before they saturate."""
        for name, actuate in self._actuations:
            controls = shaped(name, actuate(step, controls), controls.shape)
        return controls

    def push(self, step: int, states: Array) -> tuple[Array, Array]:
        """Forces in N and torques in N m, (K, 6), and the wind in m/s, (K, 3), in world axes, at states (K, n)."""
        wrench, wind = np.zeros((len(states), 6)), np.zeros((len(states), 3))
        sums = {"force": wrench[:, :3], "torque": wrench[:, 3:], "wind": wind}
        for kind, label, push in self._pushes:
            vector = shaped(label, push(step, states), wind.shape)
            sums[kind] += vector
            if kind == "wind":
                sums["force"] += self._drag * vector
        return wrench, wind if self._has_medium else np.zeros_like(wind)

    def kick(self, step: int, states: Array, controls: Array) -> Array | None:
        """The jump of the states at the end of a period, (K, n), for the applied controls; None for none."""
        jumps = [shaped(name, kick(step, states, controls), states.shape) for name, kick in self._kicks]
        return sum(jumps[1:], start=jumps[0]) if jumps else None


class _Streams(Sequence[np.random.Generator]):
    """The generator of each trial, made on demand: some disturbances draw nothing."""

    def __init__(self, make: MakeGenerator, trials: range, stream: int) -> None:
        self._make, self._trials, self._stream = make, trials, stream
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._trials)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        trial = self._trials[place]
        if trial not in self._made:
            generator = self._make(trial, self._stream)
            for draw in ("standard_normal", "random"):  # TrialScore uses objects that draw but are no Generators
                if not callable(getattr(generator, draw, None)):
                    raise InputError(f"generators: got {excerpt(generator)}, want a numpy.random.Generator")
            self._made[trial] = generator
        return self._made[trial]


def seeded(seed: int) -> MakeGenerator:
    """The generators of a seed: (trial, number of the disturbance) -> its own generator."""

    def make(trial: int, stream: int) -> np.random.Generator:
        # The fastest of NumPy's generators; it makes the loop measurably faster.
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(trial, stream))))

    return make


def normal(generators: Sequence[np.random.Generator], steps: int, size: int) -> Array:
    """Standard normal numbers (K, steps, size). Each trial draws from its own generator."""
    numbers = np.empty((steps, len(generators), size))  # in memory, all trials of a step are adjacent, as they are read
    for trial, generator in enumerate(generators):
        numbers[:, trial] = generator.standard_normal((steps, size))
    return numbers.transpose(1, 0, 2)


def uniform(generators: Sequence[np.random.Generator], steps: int, size: int) -> Array:
    """Uniform numbers (K, steps, size) in [0, 1). Each trial draws from its own generator."""
    return np.stack([generator.random((steps, size)) for generator in generators])


def with_units(values: Array, space: Coordinates) -> str:
    """One number for each entry, grouped by unit; a group is one number if all are the same: `0.01 m, 0.02 rad`."""
    of_unit = {unit: [v for v, u in zip(values, space.units, strict=True) if u == unit] for unit in space.units}
    return ", ".join(f"{words(v if len(set(v)) > 1 else v[0])} {unit}".rstrip() for unit, v in of_unit.items())


def words(numbers: PerEntry) -> str:
    """Numbers in order as text: 0.1, or (0.1, 0.2)."""
    text = ", ".join(f"{value:g}" for value in np.atleast_1d(np.asarray(numbers)))
    return text if np.ndim(np.asarray(numbers)) == 0 else f"({text})"

"""The effects of disturbances in a run, one after the other, with checks of the values they return."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Want
from lqrsim.errors import Array, InputError, check_kind, excerpt, shaped
from lqrsim.problem.belief import Belief
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import RobotSensors
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.disturbances.noise import DEVIATIONS, READINGS
from lqrsim.simulation.physics import AnyPhysics, MujocoPhysics
from lqrsim.simulation.plant import Plant

MakeGenerator = Annotated[
    Callable[[int, int], np.random.Generator],
    Want("a function of the trial and the disturbance's number that returns a numpy.random.Generator"),
]


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
        winds = [(slice(6, 9), 1.0)] if plant.has_medium else []
        if plant.simulator is None or not plant.has_medium:  # an MJCF may have a drag beside its fluid
            winds.append((slice(0, 3), plant.robot.drag))
        # Label, hook, the entries of force, torque and wind, (9,) together, to which it adds, and a factor.
        self._pushes = [(*hook, slice(3, 6), 1.0) for hook in self._hooks("torque")]
        for named in self._effects:
            self._pushes += [(*hook, slice(0, 3), 1.0) for hook in self._hooks("force", [named])]
            self._pushes += [(*hook, *wind) for hook in self._hooks("wind", [named]) for wind in winds]

    def _hooks(self, kind: str, effects: Sequence[tuple[str, Effect]] | None = None) -> list[tuple[str, Any]]:
        """The hooks of one kind, of all effects or these, each with its label for messages."""
        hooks = [(name, getattr(effect, kind)) for name, effect in effects or self._effects]
        return [(f"{name}: {kind}: returned", hook) for name, hook in hooks if hook is not None]

    def initial_states(self, planned: Array, given: Array | None = None) -> Array:
        """The first states (K, n) of the trials, from the plan's; or given ones, which no disturbance may change."""
        states = planned
        for name, effect in self._effects:
            if effect.initial_states is None:
                continue
            states = shaped(f"{name}: initial_states: returned", effect.initial_states(states.copy()), planned.shape)
            if given is not None and not np.array_equal(states, planned):
                raise InputError(f"disturbances: got {name}, which changes the start, want others: states are given")
        states = states if given is None else given
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
                physics.alter(name, effect.alter)
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
        for _, push, _, _ in self._pushes:
            push(step, states)
        for _, kick in self._kicks:
            kick(step, states, controls)

    def measure(self, step: int, states: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The measured states (K, n) for the true states, and which got lost, (K,): the last ones that arrived."""
        measured, lost = states.copy(), np.zeros(len(states), dtype=bool)
        for name, measure in self._measures:
            measured = shaped(name, measure(step, measured), measured.shape)
        if self._measures:
            lost = np.isnan(measured).all(axis=1)
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
        pushed = np.zeros((len(states), 9))
        for label, push, entries, factor in self._pushes:
            pushed[:, entries] += factor * shaped(label, push(step, states), (len(states), 3))
        return pushed[:, :6], pushed[:, 6:]

    def kick(self, step: int, states: Array, controls: Array) -> Array | None:
        """The jump of the states at the end of a period, (K, n), for the applied controls; None for none."""
        jumps = [shaped(name, kick(step, states, controls), states.shape) for name, kick in self._kicks]
        return sum(jumps[1:], start=jumps[0]) if jumps else None


class Readings:
    """What a controller reads of the sensors of an MJCF in K trials, with errors, rates and delays.

    A number is NaN where no reading of its sensor arrives, or it got lost. The run begins at the plan's knot `first`.
    """

    def __init__(
        self, sensors: RobotSensors, effects: Effects, physics: AnyPhysics, plan: Trajectory, first: int
    ) -> None:
        if not isinstance(physics, MujocoPhysics):
            raise InputError("controller: got one that reads sensors of the MJCF, want a plant moved by MuJoCo")
        self._sensors, self._effects, self._physics, self._plan = sensors, effects, physics, plan
        self._first, self._late, self._readings = first, sensors.delay_periods(plan.dt), dict[int, Array]()

    def arriving(self, step: int, states: Array, measured: Array) -> Array:
        """The readings (K, Y) that arrive at a knot; those before the run begins are exact.

        They are taken under the last controls. Up to the first knot of the run these are the plan's.
        """
        sensors, planned = self._sensors, step < self._first
        held = np.tile(self._plan.controls[max(step - 1, 0)], (len(states), 1))
        if planned:
            exact = np.repeat(sensors.reader()(states[:1], held[:1], np.zeros((1, 6))), len(states), axis=0)
        else:
            exact = sensors.readings(self._physics.sense(held if step == self._first else None))
        pairs = zip(sensors.sensors, sensors.columns, strict=True)
        named = self._effects.read(step, {sensor.name: exact[:, at] for sensor, at in pairs})
        noisy = np.concatenate([named[sensor.name] for sensor in sensors.sensors], axis=1)
        self._readings[step] = readings = exact if planned else noisy
        self._readings.pop(step - max(self._late) - 1, None)
        out = np.full(readings.shape, np.nan)
        for i, (at, late) in enumerate(zip(sensors.columns, self._late, strict=True)):
            if step - late in self._readings and sensors.due(step - late, self._plan.dt)[i]:
                out[:, at] = self._readings[step - late][:, at]
        return out


class BeliefReadings:
    """The readings of K trials by the formulas of a belief, in the true states, followed by the states that it knows.

    `ReadingErrors` adds the noise of the readings. The run begins at the plan's knot `first`.
    """

    def __init__(self, belief: Belief, effects: Effects, first: int) -> None:
        self.belief, self._effects, self._first, self._readings = belief, effects, first, list[Array]()

    def arriving(self, step: int, states: Array, measured: Array) -> Array:
        """The readings (K, Y) that arrive in the true states (K, n), NaN for lost ones; and measured known states.

        Those before the run begins are exact.
        """
        exact, deviations = self.belief.read(states)
        noisy = self._effects.read(step, {READINGS: exact, DEVIATIONS: deviations})[READINGS]
        self._readings.append(exact if step < self._first else noisy)
        arrived = len(self._readings) > self.belief.sensors.delay
        arriving = self._readings.pop(0) if arrived else np.full_like(exact, np.nan)
        return np.hstack([arriving, measured[:, self.belief.known]])


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

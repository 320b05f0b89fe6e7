"""The physics of the closed loop: K simulations of a plant, advanced by one control period at a time."""

import abc
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.errors import Array
from lqrsim.machine import processors
from lqrsim.results.rollout import WARNINGS
from lqrsim.robots.base import Indices
from lqrsim.scenes.mjcf_kinematics import in_axes_of_bodies
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.simulator import Simulator, states_of

FRAME_PERIOD = 1 / 30  # s; positions are checked and recorded at least this often, unless the physics step is longer
SENSED_DEPTH = 2.0**20  # m; inside an obstacle, up to which it exerts no force while contacts are only sensed

# Warnings after which MuJoCo resets the state or the controls.
UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC", "CTRL")]


@dataclass(eq=False)
class Period:
    """The result of a control period, in S parts of equal length."""

    states: list[Array]  # S arrays (K, n), at the end of each part; angles are not unwrapped
    frames: list[Array]  # S arrays (K, nq), MuJoCo's qpos at these times
    # S arrays (K, obstacles), whether MuJoCo detected a contact at the beginning of the last physics step of the part;
    # nowhere if contacts are not sensed.
    touching: list[npt.NDArray[np.bool_]]
    stable: npt.NDArray[np.int64]  # (K,) number of leading parts in which the simulation was stable


class Physics(abc.ABC):
    """K simulations of a plant. Call `place`, then change the models, then `prepare`, then `advance` repeatedly.

    `MujocoPhysics` says what each method does.

    Attributes:
      parts: S, parts of a control period. drawn_parts: number of parts that end with a frame to draw.
      unstable: (K,) whether a simulation has become unstable. solid: (K,) whether its obstacles are solid.
      warnings: (K, 7) number of MuJoCo's warnings of each kind, as in a `Rollout`.
    """

    def __init__(self, plant: Plant, trials: int, substeps: int, *, each_step: bool = False) -> None:
        per_frame = steps_per_frame(plant, substeps)
        self.plant, self._part = plant, 1 if each_step else per_frame
        self.parts, self.drawn_parts = substeps // self._part, substeps // per_frame
        self.unstable: npt.NDArray[np.bool_] = np.zeros(trials, dtype=bool)
        self.solid: npt.NDArray[np.bool_] = np.zeros(trials, dtype=bool)
        self.warnings: npt.NDArray[np.int64] = np.zeros((trials, len(WARNINGS)), dtype=np.int64)

    @abc.abstractmethod
    def state(self) -> Array: ...
    @abc.abstractmethod
    def frame(self) -> Array: ...
    @abc.abstractmethod
    def _step(self, rows: npt.NDArray[np.intp] | None) -> npt.NDArray[np.bool_]:
        """Advance some or all simulations by a part of a period; returns the contacts, as in `Period.touching`."""

    @abc.abstractmethod
    def _kick(self, period: Period, jumps: Array, rows: npt.NDArray[np.intp] | None) -> None: ...

    def _run(self, jumps: Array | None, rows: npt.NDArray[np.intp] | None = None) -> Period:
        """Advance some or all simulations by a period, and let their states jump at its end."""
        period = Period([], [], [], np.full(len(self.unstable), self.parts))
        for part in range(self.parts):
            touching = self._step(rows)
            if self.unstable.any():
                period.stable[self.unstable] = np.minimum(period.stable[self.unstable], part)
            period.states.append(self.state())
            period.frames.append(self.frame())
            period.touching.append(touching)
        if jumps is not None:
            self._kick(period, jumps, rows)
        return period


class MujocoPhysics(Physics):
    """MuJoCo's physics. Robots pass through obstacles until `rerun_with_contacts` makes the obstacles solid for them.

    Until then a simulation is bit-identical with and without later contacts. If the robot can touch something at a
    clearance above 0, contacts are sensed without a force.

    Attributes:
      simulations: MuJoCo's simulations.
      senses_contacts: whether contacts are sensed without a force. solidifies: whether obstacles may become solid.
    """

    def __init__(self, plant: Plant, trials: int, substeps: int, *, contacts: bool, threads: int | None) -> None:
        self.senses_contacts, self.solidifies = not plant.enclosed, contacts
        # Contacts are sensed at each step.
        super().__init__(plant, trials, substeps, each_step=self.senses_contacts)
        sensing = contacts or self.senses_contacts
        model = plant.model if sensing else plant.without_contacts
        self.simulations = batch.Batch(model, trials, min(trials, threads or processors()))
        self._sensors = self.simulations.bind("sensordata") if sensing and plant.obstacles else None
        self._qpos, self._qvel = self.simulations.bind("qpos"), self.simulations.bind("qvel")
        self._ctrl, self._wrench = self.simulations.bind("ctrl"), self.simulations.bind("xfrc_applied")
        self._act = self.simulations.bind("act") if plant.robot.activations else np.zeros((trials, 0))
        # Velocity of the medium, to which winds are added.
        self._medium = self.simulations.expand("opt.wind") if plant.has_medium else None
        self._in_qpos, self._in_qvel, self._in_ctrl = map(_span, (plant.qpos, plant.qvel, plant.ctrl))
        self._before = self.simulations.state
        self._inactive: list[tuple[Array, npt.NDArray[np.intp], Array]] = []
        self._quaternions = _quaternions(plant)

    def place(self, states: Array) -> None:
        """Put the robots into these analytic states (K, n)."""
        qpos, qvel = self.plant.robot.configuration(states)
        self._qpos[:, self._in_qpos], self._qvel[:, self._in_qvel] = qpos, qvel
        self._act[:] = states[:, states.shape[1] - self._act.shape[1] :]

    def multiply(self, parameter: str, factors: Array) -> None:
        """Multiply a parameter of `simulator.PARAMETERS` by factors (K, 1), or (K, actuators)."""
        field, which = {
            "mass": ("body_mass", self.plant.bodies),
            "inertia": ("body_inertia", self.plant.bodies),
            "thrust": ("actuator_gainprm", self.plant.actuators),
        }[parameter]
        values = self.simulations.expand(field)
        values[:, which] *= factors if values.ndim == 2 else factors[:, :, None]

    def displace(self, displaced: Array) -> None:
        """Move the obstacles by (K, obstacles, 3) m, in the world's axes."""
        model, geoms = self.plant.model, self.plant.obstacle_geoms
        self.simulations.expand("geom_pos")[:, geoms] += in_axes_of_bodies(model, geoms, displaced)

    def prepare(self, *, altered: bool) -> None:
        """Make obstacles passable, and update all fields that depend on the `altered` ones."""
        model = self.simulations.model
        if altered:
            # This happens while obstacles are still solid, because MuJoCo also determines here which bodies can collide
            # at all.
            self.simulations.set_const()
        geoms = np.array([model.geom(name).id for name in self.plant.obstacles], dtype=np.intp)
        if self.senses_contacts:
            # MuJoCo detects a contact below margin + gap, and pushes below the margin.
            pairs = np.flatnonzero(np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms))
            for field, ids, sign in (
                ("geom_margin", geoms, -1), ("geom_gap", geoms, 1), ("pair_margin", pairs, -1), ("pair_gap", pairs, 1),
            ):  # fmt: skip
                if len(ids):
                    self._disarm(field, ids, lambda values, sign=sign: values + sign * SENSED_DEPTH)
            self.simulations.set_const()
        elif self.solidifies and len(geoms):
            for field in ("geom_contype", "geom_conaffinity"):
                self._disarm(field, geoms, np.zeros_like)

    def _disarm(self, field: str, ids: npt.NDArray[np.intp], change: Callable[[Array], Array]) -> None:
        values = self.simulations.expand(field)
        self._inactive.append((values, ids, values[:, ids].copy()))
        values[:, ids] = change(values[:, ids])

    def frame(self) -> Array:
        """The current qpos, (K, nq)."""
        return self._qpos.copy()

    def state(self) -> Array:
        """The current analytic states (K, n); angles are not unwrapped."""
        return self.plant.state(self._qpos[:, self._in_qpos], self._qvel[:, self._in_qvel], self._act)

    def touching_now(self) -> npt.NDArray[np.bool_]:
        """Whether each robot touches each obstacle, (K, obstacles). The simulations must not advance afterwards."""
        assert self._sensors is not None
        self.simulations.forward()
        return (self._sensors[:, self.plant.contact] > 0).any(axis=1)

    def sense(self, held: Array | None) -> Array:
        """MuJoCo's current `sensordata` (K, any), under the last forces and the last controls, or `held` (K, m).

        The state of the simulations is restored afterwards.
        """
        if held is not None:
            self._ctrl[:, self._in_ctrl] = self.plant.robot.actuation(held)
        before, readings = self.simulations.state.copy(), self.simulations.bind("sensordata")
        self.simulations.forward()
        self.simulations.state[:] = before
        return readings.copy()

    def advance(self, controls: Array, wrench: Array, wind: Array, jumps: Array | None) -> Period:
        """Run a control period with controls (K, m), forces and torques (K, 6), wind (K, 3), and jumps (K, n)."""
        self._ctrl[:, self._in_ctrl] = self.plant.robot.actuation(controls)
        self._wrench[:, self.plant.body] = wrench
        if self._medium is not None:
            self._medium[:] = self.plant.model.opt.wind + wind
        if self.solidifies:
            self._before, self._was_unstable = self.simulations.state.copy(), self.unstable.copy()
            self._had_warned, self._jumps = self.warnings.copy(), jumps
        return self._run(jumps)

    def _kick(self, period: Period, jumps: Array, rows: npt.NDArray[np.intp] | None) -> None:
        """Let the states of some or all trials jump by (K, n) at the end of a period.

        MuJoCo's positions that are not in the state, such as the wheels' angles or a small tilt, do not change.
        """
        which = np.arange(len(jumps)) if rows is None else rows
        states, robot = period.states[-1][which], self.plant.robot
        before, after = robot.configuration(states), robot.configuration(states + jumps[which])
        qpos = self._qpos[which][:, self.plant.qpos]
        moved = qpos + (after[0] - before[0])
        for first in self._quaternions:
            turn = slice(first, first + 4)
            moved[:, turn] = _turned(after[0][:, turn], before[0][:, turn], qpos[:, turn])
        self._qpos[np.ix_(which, self.plant.qpos)] = moved
        self._qvel[np.ix_(which, self.plant.qvel)] += after[1] - before[1]
        self._act[which] += jumps[which, jumps.shape[1] - self._act.shape[1] :]
        period.states[-1][which], period.frames[-1][which] = self.state()[which], self.frame()[which]

    def rerun_with_contacts(self, rows: npt.NDArray[np.intp], period: Period) -> None:
        """Make obstacles solid for these simulations, and repeat the period for them; replaces its result."""
        self.simulations.state[rows] = self._before[rows]
        self.unstable[rows], self.warnings[rows] = self._was_unstable[rows], self._had_warned[rows]
        for values, ids, solid in self._inactive:
            values[np.ix_(rows, ids)] = solid[rows]
        if self.senses_contacts:
            self.simulations.set_const(rows)
        self.solid[rows] = True
        again = self._run(self._jumps, rows)
        for part in range(self.parts):
            period.states[part][rows] = again.states[part][rows]
            period.frames[part][rows] = again.frames[part][rows]
            period.touching[part][rows] = again.touching[part][rows]  # the others' are those of their own period
        period.stable[rows] = again.stable[rows]

    def _step(self, rows: npt.NDArray[np.intp] | None) -> npt.NDArray[np.bool_]:
        try:
            self.simulations.step(rows, nstep=self._part)
        except batch.SimulationError as error:
            self.unstable[error.ids] = True
        # MuJoCo resets an unstable simulation and continues; only its warnings show it.
        warned = self.simulations.warning[..., 1]
        if warned.any():
            self.warnings += np.where(self.unstable[:, None], 0, warned)
            self.unstable |= (warned[:, UNSTABLE] > 0).any(axis=1)
            self.simulations.warning[:] = 0
        if self._sensors is not None and (self.senses_contacts or self.solid.any()):
            return (self._sensors[:, self.plant.contact] > 0).any(axis=1)
        return np.zeros((len(self.solid), len(self.plant.obstacles)), dtype=bool)


class SimulatorPhysics(Physics):
    """The physics of a plant with a `Simulator`. Robots pass through obstacles; frames show them in their states."""

    def __init__(self, plant: Plant, simulator: Simulator, trials: int, substeps: int) -> None:
        super().__init__(plant, trials, substeps)
        self._simulator, self._factors = simulator, dict[str, Array]()

    def place(self, states: Array) -> None:
        self._states = states

    def multiply(self, parameter: str, factors: Array) -> None:
        self.plant.check_simulator(parameter, parameter)
        self._factors[parameter] = self._factors.get(parameter, 1.0) * factors

    def displace(self, displaced: Array) -> None:
        """Do nothing: collisions are computed from the positions of the obstacles."""

    def prepare(self, *, altered: bool) -> None:
        self._simulations = self._simulator.start(self._states, self._factors, self.plant.timestep)
        self._read_states()

    def _read_states(self) -> None:
        """Read the states. A state with an entry that is not finite becomes NaN."""
        self._states = states_of(self._simulator, self._simulations, self._states.shape)
        diverged = ~np.isfinite(self._states).all(axis=1)
        self._states[diverged], self.unstable[diverged] = np.nan, True

    def state(self) -> Array:
        return self._states.copy()

    def frame(self) -> Array:
        plant = self.plant
        frames = np.tile(plant.model.qpos0, (len(self._states), 1))
        known = np.isfinite(self._states).all(axis=1)
        frames[~known] = np.nan
        frames[np.ix_(known, plant.qpos)] = plant.robot.configuration(self._states[known])[0]
        return frames

    def advance(self, controls: Array, wrench: Array, wind: Array, jumps: Array | None) -> Period:
        self._inputs = controls, wrench, wind
        return self._run(jumps)

    def _step(self, rows: npt.NDArray[np.intp] | None) -> npt.NDArray[np.bool_]:
        self._simulator.step(self._simulations, *self._inputs, self._part)
        self._read_states()
        return np.zeros((len(self._states), len(self.plant.obstacles)), dtype=bool)

    def _kick(self, period: Period, jumps: Array, rows: npt.NDArray[np.intp] | None) -> None:
        self._simulator.place(self._simulations, self._states + jumps)
        self._read_states()
        period.states[-1], period.frames[-1] = self.state(), self.frame()


AnyPhysics = MujocoPhysics | SimulatorPhysics


def steps_per_frame(plant: Plant, substeps: int) -> int:
    """Physics steps per frame: the longest equal parts of the control period that are at most FRAME_PERIOD long."""
    longest = min(substeps, int((FRAME_PERIOD + 1e-9) / plant.timestep))
    return max((part for part in range(1, longest + 1) if substeps % part == 0), default=1)


def _quaternions(plant: Plant) -> list[int]:
    """The indices at which quaternions begin in the robot's own qpos: the last four numbers of ball and free joints."""
    sizes = [plant.model.joint(name).qpos0.size for name in plant.robot.joints]
    return [end - 4 for end, size in zip(np.cumsum(sizes).tolist(), sizes, strict=True) if size >= 4]


def _turned(after: Array, before: Array, now: Array) -> Array:
    """Quaternions `now` (K, 4), rotated by the rotation from `before` to `after`, in the world's axes."""
    back = before * np.array([1.0, -1.0, -1.0, -1.0])
    turned = _product(_product(after, back), now)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _product(a: Array, b: Array) -> Array:
    (w, x, y, z), (s, i, j, k) = a.T, b.T
    return np.stack(
        [w * s - x * i - y * j - z * k, w * i + x * s + y * k - z * j, w * j - x * k + y * s + z * i,
         w * k + x * j - y * i + z * s], axis=1,
    )  # fmt: skip


def _span(indices: Indices) -> slice | Indices:
    """The indices as a slice, which copies nothing, if they are consecutive; else as they are."""
    first, last = int(indices.min(initial=0)), int(indices.max(initial=-1))
    return slice(first, last + 1) if np.array_equal(indices, np.arange(first, last + 1)) else indices

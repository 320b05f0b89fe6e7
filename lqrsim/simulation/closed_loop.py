"""Running a controller on a plant: one code path for one trial and for many.

`simulate` loops over the control periods; `ClosedLoop` has a method for each phase of a period. `Effects` of
`disturbances/base.py` applies the disturbances, and `physics.py` advances the physics.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, Count, Index, Progress, Seed, Want, check_string, checked
from lqrsim.control.controllers import Controller, ControllerLike, ControllerRun, as_controller, turn_to_nearest
from lqrsim.errors import Array, InputError, check_array, check_items, check_kind, check_memory, format_error, shaped
from lqrsim.machine import versions
from lqrsim.problem.belief import Belief
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.problem.noise import Noise
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.goal import Target
from lqrsim.results.rollout import GOAL_MOVED, MovingObstacles, Rollout
from lqrsim.results.solution import Plan
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import RobotSensors
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.world import World
from lqrsim.simulation.disturbances import Disturbance, as_disturbances
from lqrsim.simulation.disturbances.base import Effects, MakeGenerator, seeded
from lqrsim.simulation.disturbances.noise import DEVIATIONS, READINGS
from lqrsim.simulation.physics import AnyPhysics, MujocoPhysics, Period, SimulatorPhysics, steps_per_frame
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.budget import check_threads

MOST_STEPS = 100_000_000  # physics steps in a run; they take minutes to hours
FINEST = 0.02  # smallest step along a line, relative to the radius; a larger clearance is itself the step
MOST_POINTS = 1000  # that are checked along a line
Watch = Annotated[
    Callable[[float, Array, npt.NDArray[np.bool_]], object],
    Want("a function of the time, MuJoCo's qpos and which trials are unstable"),
]


def simulate(
    plant: Plant,
    plan: Plan | None = None,
    *,
    controller: ControllerLike | None = None,
    disturbances: Sequence[Disturbance | Noise] = (),
    seed: int = 0,
    trials: int = 1,
    first_trial: int = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    frames: bool = True,
    contacts: bool = True,
    moving: World | None = None,
    threads: int | None = None,
    generators: Callable[[int, int], np.random.Generator] | None = None,
    progress: Callable[[int, int], object] | None = None,
    watch: Callable[[float, Array, npt.NDArray[np.bool_]], object] | None = None,
) -> Rollout:
    """Run a policy or another controller closed-loop in the plant's physics, from a plan's first state.

    The first state is measured. In each control period: compute the control, disturb it, saturate it, apply disturbing
    forces, step the physics, let the state jump, read the true state and measure it.

    A trial ends with its first collision, as `Collisions` defines it, when its simulation becomes unstable, when a
    disturbing force is not finite, when the filter of its controller diverges, or when the controller fails. A
    controller fails if it raises an exception, which ends all trials that it computes together, or if it returns
    invalid controls. Records after a collision do not count. In the other cases they are NaN.

    Args:
      plan: a solution or another plan, which gives the first state, the duration, and the reference for comparisons. By
        default the controller's own plan; an `OffsetFree` and a `Replanner` have their own.
      controller: computes the controls; by default the plan's policy. Another policy, with or without a filter; a
        `Controller`; or a function of the measured state (n,) and the time in s that returns controls (m,).
      disturbances: in the order in which they act. Each has its own stream of random numbers. The `Noise` of a problem
        is allowed, too.
      seed: seed of all random numbers.
      trials: number of trials.
      first_trial: number of the first trial. Trial `i` of a seed is bit-identical, whatever other trials run with it.
      goal_radius: distance in metres within which the goal counts as reached; by default the robot's radius, or a tenth
        of the distance to the goal if the plan starts within the radius.
      goal_tolerance: the tolerance for goals without a position, relative to each state's way; 0.1 by default.
        `results/goal.py` has the details.
      frames: whether to record the data for drawing, including times between the control periods; needed for a video.
      contacts: whether obstacles stop the robot, from the control period of its first collision on. If False, the robot
        moves through them. This takes a quarter less time, is bit-identical until the collision, and has the same
        outcome. In simulators other than MuJoCo the robot always moves through obstacles.
      moving: further obstacles, which move at their velocity, and are in their places at the time 0 of the plan. MuJoCo
        does not have them: the robot passes through them, but touching one is a collision, `clearance` counts them, and
        `render` draws them.
      threads: number of MuJoCo's threads; by default one per processor.
      generators: (trial, number of the disturbance) -> its random generator, instead of the generators of the seed.
      progress: called after each control period with the number of finished periods and the number of all periods.
      watch: called with each frame: its time, MuJoCo's qpos (K, nq), and which trials are unstable (K,).

    Returns:
      A Rollout of the trials. Its `controller_run` is the run of the controller, with its records.
    """
    loop = ClosedLoop(**locals())  # all arguments, by name
    loop.run()
    return loop.rollout(undisturbed=True)


def simulate_from(plant: Plant, plan: Plan, states: Array, *, knot: int = 0, **options: Any) -> Rollout:
    """Run the rest of a plan after `knot` periods, one trial from each of the states (K, n).

    Until the knot, states and measurements are taken to be those of the plan: disturbances and controller are called
    with them, period by period, so that a delay has its past, a filter its estimate, and what happens at a given time
    happens at that time. The physics begins at the knot.

    Args:
      states: (K, n), where the trials begin.
      options: other options of `simulate`, except `trials`. Disturbances that change the start, such as
        `InitialStateError`, are refused. Times of the rollout count from the knot.
    """
    states = check_array("states", states, (None, None))
    loop = ClosedLoop(plant=plant, plan=plan, starts=states, knot=knot, trials=len(states), **options)
    loop.run()
    return loop.rollout()


Mask = npt.NDArray[np.bool_]


class Records:
    """The records of K trials of a plan with T steps, from which a `Rollout` is made.

    Attributes:
      states, measured: (K, T+1, n). clearance: (K, T+1). commanded, applied: (K, T, m). wrench: (K, T, 6).
      contacts: (K,) number of control periods in contact.
      invalid_since: (K,) knot from which on the records are invalid; T+1 if all are valid.
      failed_since: (K,) knot at which the controller failed; T+1 if it never failed.
      reasons: why each trial's controller failed, its filter diverged or a force was not finite; else empty.
      frames: arrays of MuJoCo's qpos, (K, nq) each.
    """

    def __init__(self, plan: Trajectory, trials: int) -> None:
        def zeros(steps: int, size: int) -> Array:
            """Zeros (K, steps, size). In memory, all trials of a step are adjacent, as they are written."""
            return np.zeros((steps, trials, size)).transpose(1, 0, 2)

        self.plan, steps = plan, plan.steps
        n, m = plan.states.shape[1], plan.controls.shape[1]
        self.states, self.measured = zeros(steps + 1, n), zeros(steps + 1, n)
        self.clearance = zeros(steps + 1, 1)[..., 0]
        self.commanded, self.applied, self.wrench = zeros(steps, m), zeros(steps, m), zeros(steps, 6)
        self.contacts = np.zeros(trials, dtype=np.int64)
        self.invalid_since, self.failed_since = np.full(trials, steps + 1), np.full(trials, steps + 1)
        self.reasons, self.frames = [""] * trials, list[Array]()

    def end(self, step: int, who: Literal["controller", "filter", "disturbances"], reasons: Mapping[int, str]) -> None:
        """Record that trials end, row -> reason, unless they have before; where it is the controller, they failed."""
        over, since = self.over(step), self.failed_since if who == "controller" else self.invalid_since
        for row, reason in reasons.items():
            if not over[row]:
                since[row] = step
                self.reasons[row] = f"{who} at {step * self.plan.dt:.4g} s: {reason}"

    def over(self, step: int) -> Mask:
        """Whether each trial's controller has failed, or its records are invalid, at this knot or before, (K,)."""
        return np.minimum(self.invalid_since, self.failed_since) <= step

    def time_of(self, knots: npt.NDArray[np.int64]) -> Array:
        """The times of knots (K,) in s; infinite beyond the last one."""
        return np.where(knots <= self.plan.steps, self.plan.dt * knots, np.inf)

    def finish(self, parts: int, *, all_frames: bool) -> Array:
        """Set the records after the end of a trial to NaN, and return the frames (K, F, nq), NaN as well.

        There are `parts` frames in a period, or only the first one of all.
        """
        steps = self.plan.steps
        missing = steps * parts + 1 - len(self.frames) if all_frames else 0
        frames = np.stack(self.frames + [np.full_like(self.frames[0], np.nan)] * missing, axis=1)
        if not self.over(steps).any():
            return frames
        known_until = np.minimum(
            self.invalid_since, self.failed_since + 1
        )  # where a controller fails, the state is known
        driven_until = np.minimum(self.invalid_since, self.failed_since)
        knots = np.arange(steps + 1)
        # A frame belongs to the knot at the end of its period: the trial ended somewhere before that.
        knot_of_frame = -(np.arange(frames.shape[1]) // -parts)
        for array, knot, until in (
            *((array, knots, known_until) for array in (self.states, self.measured, self.clearance)),
            *((array, knots[:-1], driven_until) for array in (self.commanded, self.applied, self.wrench)),
            (frames, knot_of_frame, known_until),
        ):
            array[knot >= until[:, None]] = np.nan
        return frames


class Collisions:
    """The first collisions of K trials: for each, the first moment at which the robot touches an obstacle.

    The robot touches an obstacle if MuJoCo detects a contact, or if a signed distance minus the radius is negative. The
    distance is measured from the robot's position, or from one of its balls or geoms. Detection uses states without
    obstacle contacts, so its result is bit-identical whether or not an obstacle then stops the robot. It checks the
    knots, the parts of a control period that `Physics` has, and straight lines between them. Obstacles that move, which
    MuJoCo does not have, are where they are at each moment; `passing` is the robot's shape among them, at the run's
    start.

    Attributes:
      at: (K,) times in s; infinite without a collision. obstacles: names of the obstacles; empty without one.
      clearance: (K,) current signed distance to the nearest obstacle, minus the radius, in metres.
    """

    def __init__(self, plant: Plant, states: Array, displaced: Array, dt: float, passing: ShapeInWorld | None) -> None:
        self.plant, self.shape, self.dt, self._passing = plant, plant.shape, dt, passing
        moving = () if passing is None else passing.world.obstacles
        self._velocities = np.array([obstacle.velocity for obstacle in moving]).reshape(-1, 3)
        self._fastest = float(np.linalg.norm(self._velocities, axis=1).max(initial=0.0))
        self._displaced, self._any_displaced = self.shape.across(displaced), bool(displaced.any())
        self.at = np.full(len(displaced), np.inf)
        self.obstacles = [""] * len(displaced)
        self._time = 0.0  # of the last places, in s
        self.relocate(states)
        for row in np.flatnonzero(self.clearance < 0):
            self._hit(int(row), 0.0, self._places[row])

    def detect(self, step: int, period: Period, *, ignored: Mask) -> npt.NDArray[np.intp]:
        """Find the trials, except `ignored` ones (K,), that first collide in a period, and return their rows."""
        begun, parts = self.at.copy(), len(period.states)
        for part, (states, touching) in enumerate(zip(period.states, period.touching, strict=True)):
            running = np.isinf(self.at) & ~ignored & (part < period.stable)
            self.touch((step + part / parts) * self.dt, touching, running)
            if len(self.plant.world) or len(self._velocities):
                self._search_line(step, part, parts, self.shape.places(states), running)
        rows = np.flatnonzero(np.isfinite(self.at) & np.isinf(begun))
        # Rounding may put a time in the period past the period's end.
        self.at[rows] = np.minimum(self.at[rows], (step + 1) * self.dt)
        return rows

    def touch(self, time: float, touching: Mask, running: Mask) -> None:
        """Record contacts that MuJoCo detected, (K, obstacles), in the `running` trials (K,)."""
        for row in np.flatnonzero(running & np.isinf(self.at) & touching.any(axis=1)):
            self.at[row] = time
            self.obstacles[row] = self.plant.obstacles[int(np.argmax(touching[row]))]

    def relocate(self, states: Array) -> None:
        """Replace the current states (K, n), as after obstacles have stopped some of the trials."""
        self._places = self.shape.places(states)
        self.clearance = self._clear(self._places, self._time)

    def _search_line(self, step: int, part: int, parts: int, arrived: Array, running: Mask) -> None:
        """Check the lines from the robot's last positions to the new ones, (K, B, 2 or 3) or (K, 1, n)."""
        last, before = self._places, self.clearance
        self._time = (step + (part + 1) / parts) * self.dt
        self._places, self.clearance = arrived, self._clear(arrived, self._time)
        length = self.shape.travel(last, arrived) + self._fastest * self.dt / parts  # moves of robot and obstacles
        # If the clearances at both ends add up to more than the length, no point of the line touches an obstacle.
        rows = np.flatnonzero(running & np.isinf(self.at) & ~(before + self.clearance > length))
        rows = rows[np.isfinite(length[rows])]
        if not len(rows):
            return
        finest = np.maximum(FINEST * float(self.shape.radii.min()), length[rows] / MOST_POINTS)
        travelled, clear = np.zeros(len(rows)), before[rows]
        searching = np.ones(len(rows), dtype=bool)
        while searching.any():
            travelled = np.where(searching, np.minimum(travelled + np.maximum(clear, finest), length[rows]), travelled)
            ratio = (travelled / np.where(length[rows] > 0, length[rows], 1.0))[:, None, None]
            at_end = travelled >= length[rows]
            places = np.where(at_end[:, None, None], arrived[rows], last[rows] + ratio * (arrived[rows] - last[rows]))
            times = (step + (part + ratio[:, 0, 0]) / parts) * self.dt
            clear = self._clear(places, times, rows)
            for k in np.flatnonzero(searching & (clear < 0)):
                self._hit(int(rows[k]), float(times[k]), places[k])
            searching &= (clear >= 0) & ~at_end

    def _clear(self, places: Array, time: float | Array, rows: npt.NDArray[np.intp] | slice = slice(None)) -> Array:
        """The clearance (k,) of these trials with their balls at places (k, B, 2 or 3), at times (k,) in s."""
        clear = self.shape.clearance(places, self._displaced[rows] if self._any_displaced else None)
        if self._passing is None:
            return clear
        return np.minimum(clear, self._passing.clearance(places, self._motion(np.broadcast_to(time, len(places)))))

    def _motion(self, times: Array) -> Array:
        """How far the moving obstacles have come at times (k,) in s, (k, obstacles, 3) in m."""
        return times[:, None, None] * self._velocities

    def _hit(self, row: int, time: float, places: Array) -> None:
        """Record a collision with the obstacle that is nearest to the balls at these places (B, 2 or 3)."""
        self.at[row] = time
        moved = self._motion(np.array([time]))
        if self._passing is None or not self._passing.clearance(places[None], moved)[0] < 0:
            self.obstacles[row] = self.plant.world.names[self.shape.nearest(places, self._displaced[row])]
        else:
            self.obstacles[row] = self._passing.world.names[self._passing.nearest(places, moved[0])]


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


@checked
@dataclass(kw_only=True, eq=False, repr=False)
class ClosedLoop:
    """The closed loop of K trials, with a method for each phase of a control period, by the arguments of `simulate`.

    All trials are advanced together. `run` runs the whole loop, `period` one step. Steps count from the knot at
    which the run begins; disturbances and controller are given those of the whole plan.

    Attributes:
      starts: (K, n), where the trials begin; by default in the plan's first state. knot: number of the plan's knot at
        which they begin. Both are for `simulate_from`.
      active_disturbances: the disturbances, each `Noise` as a StateNoise.
      active_controller: the controller, by default the plan's policy.
      remaining_plan: the plan of the run, the given one or else the controller's own, from the knot on.
      trajectory: its trajectory.
      state_coordinates, control_coordinates: those of the controller, with limits within the robot's limits.
      step: number of the next control period. measured: (K, n), the measured states at its beginning. lost: (K,) which
        of them got lost; these are the last ones that arrived.
      controller_run: the run of the controller.
    """

    _prefix = ""

    plant: Plant
    plan: Plan | None = None
    controller: ControllerLike | None = None
    disturbances: Sequence[Disturbance | Noise] = ()
    seed: Seed = 0
    trials: Count = 1
    first_trial: Seed = 0
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    frames: bool = True
    contacts: bool = True
    threads: int | None = None
    generators: MakeGenerator | None = None
    progress: Progress | None = None
    watch: Watch | None = None
    starts: Array | None = None
    knot: Index = 0
    moving: Annotated[World, Want("a World of them, such as ls.World([ls.Obstacle(..., velocity=...)])")] | None = None

    @unlogged()
    def __post_init__(self) -> None:
        plant, trials = self.plant, self.trials
        self.active_disturbances = as_disturbances(self.disturbances)
        threads = check_threads(self.threads)
        self.active_controller, plan = as_controller(self.controller, self.plan, plant.robot.dynamics)
        self.state_coordinates, self.control_coordinates = _checked_coordinates(self.active_controller, plan, plant)
        full = plan.trajectory
        if self.knot >= full.steps:
            raise InputError(f"knot: got {self.knot}, want one from 0 to {full.steps - 1}, before the plan's end")
        self.remaining_plan = plan.shifted(self.knot, horizon="shrinking") if self.knot else plan
        if self.starts is not None:
            self.starts = check_array("states", self.starts, (trials, full.states.shape[1]))
        self.trajectory, dt = self.remaining_plan.trajectory, full.dt
        self._target = Target(self.state_coordinates, self.remaining_plan.goal, self.trajectory.states)
        self._radius = self._target.radius(plant.robot.radius, self.goal_radius, self.goal_tolerance)
        substeps = plant.substeps(dt)
        passing = None
        if self.moving is not None:
            if twice := sorted({*self.moving.names} & {*plant.obstacles, *plant.world.names}):
                raise InputError(f"moving: got {twice[0]}, which is an obstacle of the scene, want another name")
            passing = plant.robot.among(self.moving.moved(self.knot * dt))
        _check_size(plant, self.trajectory, substeps, trials, frames=self.frames)
        numbers = range(self.first_trial, self.first_trial + trials)
        self.effects = Effects(plant, full, self.active_disturbances, numbers, self.generators or seeded(self.seed))
        self.physics: AnyPhysics
        if plant.simulator is not None:
            self.physics = SimulatorPhysics(plant, plant.simulator, trials, substeps)
        else:
            self.physics = MujocoPhysics(plant, trials, substeps, contacts=self.contacts, threads=threads)
        self.physics.place(self.effects.initial_states(np.tile(full.states[0], (trials, 1)), self.starts))
        self.physics.prepare(altered=self.effects.alter_models(self.physics))
        name, run = f"{type(self.active_controller).__name__}.start", self.active_controller.start(trials)
        self.controller_run = check_kind(name, run, ControllerRun, "a ControllerRun returned")
        self.records = Records(self.trajectory, trials)
        self.records.frames.append(self.physics.frame())
        self.states = self.physics.state()
        self.collisions = Collisions(plant, self.states, self.effects.displaced, dt, passing)
        space = plant.robot.dynamics.control_coordinates
        self._names, self._limits = space.names, space.limits
        sensors = self.active_controller.sensors
        self._readings: Readings | BeliefReadings | None = None
        if isinstance(sensors, Belief):
            self._readings = BeliefReadings(sensors, self.effects, self.knot)
        elif sensors is not None:
            self._readings = Readings(sensors, self.effects, self.physics, full, self.knot)
        self._follow(full)
        self.step, self.measured = 0, self.measure(0)

    def _follow(self, plan: Trajectory) -> None:
        """Let disturbances and controller follow the plan to the knot at which the run begins."""
        for step in range(self.knot):
            states, controls = (np.tile(rows[step], (self.trials, 1)) for rows in (plan.states, plan.controls))
            self.effects.follow(step, states, controls)
            observed = states if self._readings is None else self._readings.arriving(step, states, states)
            try:
                self.controller_run.control(step, observed)
            except Exception as error:
                self.records.end(0, "controller", dict.fromkeys(range(self.trials), format_error(error)))
                break

    def run(self) -> None:
        """Run all control periods; fewer if all trials have ended."""
        steps = self.trajectory.steps
        with unlogged():
            while self.step < steps and self.period():
                if self.progress is not None:
                    self.progress(self.step, steps)

    def period(self) -> bool:
        """Run one control period, up to the measurement at its end. Returns False if all trials have ended.

        MuJoCo computes contacts at the beginning of a physics step, so those at the end of a period are detected in the
        next one; at the last knot, after which nothing advances, they are detected here.
        """
        step, physics = self.step, self.physics
        commands = self.decide(step, self.measured)
        controls = self.actuate(step, commands)
        wrench, wind = self.push(step)
        if self.records.over(step).all():
            return False
        self.advance(step, controls, wrench, wind)
        self.step, self.measured = step + 1, self.measure(step + 1)
        if self.step == self.trajectory.steps and isinstance(physics, MujocoPhysics) and physics.senses_contacts:
            self.collisions.touch(self.trajectory.horizon, physics.touching_now(), ~self.records.over(self.step))
        return True

    def measure(self, step: int) -> Array:
        measured, self.lost = self.effects.measure(self.knot + step, self.states)
        records, invalid = self.records, self.physics.unstable | _not_finite(self.states) | _not_finite(measured)
        records.states[:, step], records.measured[:, step] = self.states, measured
        records.clearance[:, step] = self.collisions.clearance
        records.invalid_since[invalid] = np.minimum(records.invalid_since[invalid], step)
        over = records.over(step)
        if over.any():  # trials that have ended continue in the plan's states, so as not to disturb the others
            measured[over] = self.trajectory.states[step]
        return measured

    def decide(self, step: int, measured: Array) -> Array:
        """The controller's commands (K, m); if it fails, the plan's controls."""
        shape = self.trials, len(self._names)
        observed, knot = measured, self.knot + step
        if self._readings is not None:
            observed = self._readings.arriving(knot, self.states, measured)
        elif self.active_controller.sees_losses:
            observed = np.where(self.lost[:, None], np.nan, measured)
        try:
            commands = shaped("commands", self.controller_run.control(knot, observed), shape)
            failed = _not_finite(commands)
            first = np.argmin(np.isfinite(commands), axis=1)
            reasons = {
                k: f"got {commands[k, first[k]]} for {self._names[first[k]]}, want a finite number"
                for k in np.flatnonzero(failed).tolist()
            }
        except Exception as error:  # a controller may raise anything; its trials have failed
            commands, failed = np.zeros(shape), np.ones(len(measured), dtype=bool)
            reasons = dict.fromkeys(range(len(measured)), format_error(error))
        self.records.end(step, "filter", self.controller_run.estimator_diverged())
        self.records.end(step, "controller", reasons)
        self.records.commanded[:, step] = commands
        return np.where(failed[:, None], self.trajectory.controls[step], commands)

    def actuate(self, step: int, commands: Array) -> Array:
        """Disturb the commands and clip them to the robot's limits. Returns the applied controls (K, m)."""
        controls = np.clip(self.effects.actuate(self.knot + step, commands), *self._limits)
        self.records.applied[:, step] = controls
        return controls

    def push(self, step: int) -> tuple[Array, Array]:
        """The disturbing forces in N and torques in N m, (K, 6), and the wind in m/s, (K, 3)."""
        wrench, wind = self.effects.push(self.knot + step, self.states)
        self.records.wrench[:, step] = wrench
        invalid = _not_finite(wrench) | _not_finite(wind)
        if invalid.any():  # MuJoCo would let such a robot stand still, without a warning
            reasons = dict.fromkeys(np.flatnonzero(invalid).tolist(), "got a force, torque or wind that is not finite")
            self.records.end(step, "disturbances", reasons)
            wrench[invalid], wind[invalid] = 0.0, 0.0
        return wrench, wind

    def advance(self, step: int, controls: Array, wrench: Array, wind: Array) -> None:
        """Advance the physics to the next knot. Obstacles stop a trial from the period of its first collision on.

        Controls, forces and wind are held over the period; a kick is of the states at its beginning, and acts at its
        end.
        """
        physics, records, watch = self.physics, self.records, self.watch
        over, kick = records.over(step), self.effects.kick(self.knot + step, self.states, controls)
        period = physics.advance(controls, wrench, wind, kick)
        begun = self.collisions.detect(step, period, ignored=over)
        if len(begun) and isinstance(physics, MujocoPhysics) and physics.solidifies:
            physics.rerun_with_contacts(begun, period)
            self.collisions.relocate(period.states[-1])
        if physics.solid.any():
            touched = np.any([touching.any(axis=1) for touching in period.touching], axis=0)
            records.contacts += physics.solid & touched & ~over
        self.states = period.states[-1]
        every = physics.parts // physics.drawn_parts
        for frame in period.frames[every - 1 :: every] if self.frames else ():
            time = len(records.frames) * records.plan.dt / physics.drawn_parts
            records.frames.append(frame)
            if watch is not None:
                watch(time, frame, physics.unstable)

    def so_far(self) -> Rollout:
        """A Rollout of the records so far, as if the controller had failed now. The loop can continue."""
        twin = copy.copy(self)
        twin.records = copy.deepcopy(self.records)
        if self.step < self.trajectory.steps:
            twin.records.end(self.step, "controller", dict.fromkeys(range(self.trials), "went no further"))
        return twin.rollout()

    def run_undisturbed(self) -> Array | None:
        """States (T+1, n) of the plan's own policy without disturbances, NaN once that run has ended; None if unknown.

        A run of that policy that is undisturbed itself is that run. Where the plan is of MuJoCo's own steps, which the
        plant repeats, there is a further run; the plant remembers it until another plan runs there.
        """
        plant, plan, records = self.plant, self.remaining_plan, self.records
        if self.moving is not None:
            return None
        if not self.active_disturbances and self.active_controller.digest == plan.policy.digest:
            ended = min(self.collisions.at[0], records.time_of(records.invalid_since)[0])
            return np.where(plan.trajectory.times[:, None] < ended, records.states[0], np.nan)
        if not plant.robot.dynamics.by_mujoco or plant.simulator is not None:
            return None
        which = plan.policy.digest, plan.trajectory.states.tobytes()
        if plant.ran is None or plant.ran[:2] != which:
            alone = simulate(
                plant, plan, controller=plan.policy, frames=False, threads=1,
                goal_radius=self.goal_radius, goal_tolerance=self.goal_tolerance,
            )  # fmt: skip
            plant.ran = (*which, alone.undisturbed)
        return plant.ran[2]

    def rollout(self, *, undisturbed: bool = False) -> Rollout:
        """A Rollout of all records; if asked for, with the states of an undisturbed run."""
        records, collisions = self.records, self.collisions
        for array in (records.states, records.measured):
            turn_to_nearest(self.state_coordinates, array.transpose(1, 0, 2), records.plan.states)
        alone = self.run_undisturbed() if undisturbed else None
        plant, plan, parts = self.plant, self.trajectory, self.physics.drawn_parts
        goal, radius = self.remaining_plan.goal, self._radius
        if (moved := self.controller_run.moved_goal()) is not None:
            # A radius by argument holds for another goal only in the same unit.
            target = replace(self._target, goal=moved)
            stated = (self.goal_radius, self.goal_tolerance) if target.unit == self._target.unit else (None, None)
            goal, radius = moved, target.radius(plant.robot.radius, *stated)
        described = (disturbance.describe(plant) for disturbance in self.active_disturbances)
        changed = () if moved is None else (GOAL_MOVED,)
        begun = () if self.starts is None else ("given first states",)
        passing = () if self.moving is None else (f"moving obstacles {', '.join(self.moving.names)}",)
        frames = records.finish(parts, all_frames=self.frames)
        return Rollout(
            robot=plant.robot.name, body=plant.robot.body, radius=plant.robot.radius, scene=plant.scene.name,
            model=plant.scene.xml, plan=plan, policy_digest=self.active_controller.digest,
            state_coordinates=self.state_coordinates, control_coordinates=self.control_coordinates, goal=goal,
            goal_radius=radius, states=records.states, measured=records.measured, commanded=records.commanded,
            applied=records.applied, forces=records.wrench[..., :3], torques=records.wrench[..., 3:],
            displaced=self.effects.displaced, clearance=records.clearance, contacts=records.contacts,
            collided_at=collisions.at, obstacles=tuple(collisions.obstacles),
            diverged_at=records.time_of(records.invalid_since),
            failed_at=records.time_of(records.failed_since), reasons=tuple(records.reasons), frames=frames,
            frame_times=np.arange(frames.shape[1]) * (plan.dt / parts), seed=self.seed, first_trial=self.first_trial,
            disturbances=(*described, *begun, *passing, *changed), controller_run=self.controller_run,
            versions={**versions(), **({} if plant.simulator is None else plant.simulator.versions)},
            balls=plant.record_of_balls(plan.states, records.states) if self.frames else None,
            obstacle_geoms=plant.obstacle_geoms, undisturbed=alone,
            warnings=self.physics.warnings if plant.simulator is None else None,
            moving=MovingObstacles.of(self.moving.moved(self.knot * plan.dt)) if self.moving else None,
        )  # fmt: skip


def _not_finite(rows: Array) -> Mask:
    """Whether each row has a number that is not finite, (K,)."""
    finite = np.isfinite(rows)
    if finite.all():  # much faster than testing each row
        return np.zeros(len(rows), dtype=bool)
    return ~np.all(finite, axis=1)


def _checked_coordinates(controller: Controller, plan: Plan, plant: Plant) -> tuple[Coordinates, Coordinates]:
    """The coordinates of the controller's states and controls; InputError unless they and the plan fit the robot's."""
    dynamics, kind = plant.robot.dynamics, type(controller).__name__
    check_string(f"{kind}.digest", controller.digest, LINE)
    wanted_kind = "Coordinates of states and of controls"
    spaces = check_items(f"{kind}.coordinates", controller.coordinates, Coordinates, wanted_kind)
    if len(spaces) != 2:
        raise InputError(f"{kind}.coordinates: got {len(spaces)}, want two: of the states, of the controls")
    robot = f"robot {plant.robot.name}"
    check_same_system("controller", "a policy", (spaces[0], spaces[1]), spaces_of(dynamics), robot)
    meant, moves = spaces[0], dynamics.state_coordinates
    if (meant.position, meant.plane, meant.offset) != (moves.position, moves.plane, moves.offset):
        whose = f"the position of {robot}: {_place(moves)}"
        raise InputError(f"controller: got a policy for a position {_place(meant)}, want {whose}")
    trajectory = plan.trajectory
    sizes, wanted = (trajectory.states.shape[1], trajectory.controls.shape[1]), (len(spaces[0]), len(spaces[1]))
    if sizes != wanted:
        got, want = (f"{n} states and {m} controls" for n, m in (sizes, wanted))
        raise InputError(f"plan: got {got}, want {want}, as the robot has")
    if not trajectory.finite:
        raise InputError(f"plan: got a plan that is not finite ({plan.status.name}), want one that can be run")
    # A command that the robot clips is at a limit, whatever limits the policy assumed.
    control_space = dynamics.control_coordinates
    low, high = np.maximum(spaces[1].low, control_space.low), np.minimum(spaces[1].high, control_space.high)
    return spaces[0], spaces[1].limited((low, high))


def _check_size(plant: Plant, plan: Trajectory, substeps: int, trials: int, *, frames: bool) -> None:
    """Raise InputError for a run that takes too many physics steps or too much memory."""
    if (count := plan.steps * substeps) > MOST_STEPS:
        periods = f"{plan.steps} control periods of {plan.dt:g} s"
        raise InputError(f"plan: got {periods}, which takes {count} physics steps, want at most {MOST_STEPS}")
    n, m = plan.states.shape[1], plan.controls.shape[1]
    pictures = plan.steps * (substeps // steps_per_frame(plant, substeps)) + 1 if frames else 1
    numbers = (plan.steps + 1) * 3 * (2 * n + 2 * m + 6 + 1) + 2 * pictures * plant.model.nq + 3 * len(plant.world)
    check_memory("trials", trials, 8 * numbers + 2000, "whose records")


def _place(space: Coordinates) -> str:
    names = ", ".join(space.names[index] for index in space.position) or "of no states"
    plane = f" in the plane {space.plane!r}" if len(space.plane) == 2 else ""
    return f"({names}){plane}" + ("" if space.offset is None else f" at {space.offset:g} m")

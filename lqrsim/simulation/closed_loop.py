"""Running a policy on a plant: one code path for one trial and for many."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError, check_count, excerpt
from lqrsim.results import Solution
from lqrsim.rollout import Rollout
from lqrsim.scenes import unlogged
from lqrsim.simulation.collisions import Collisions
from lqrsim.simulation.controllers import Controller, Feedback
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.physics import Physics
from lqrsim.simulation.plant import Plant
from lqrsim.target import Target
from lqrsim.versions import versions


def simulate(
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance] = (),
    controller: Controller | None = None,
    seed: int = 0,
    trials: int = 1,
    first_trial: int = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    frames: bool = True,
    contacts: bool = True,
    threads: int | None = None,
    generators: Callable[[int, int], np.random.Generator] | None = None,
    progress: Callable[[int, int], object] | None = None,
    watch: Callable[[float, Array, npt.NDArray[np.bool_]], object] | None = None,
) -> Rollout:
    """Execute the solution's policy closed-loop in MuJoCo, from the first state of its plan.

    In each control period: read the true state, measure it, ask the policy, disturb its command, saturate, push, step.

    A trial ends with the first collision, as `collisions.py` defines it, when it becomes unstable, or when the
    controller fails: raises an exception, which ends all the trials that it was asked for, or returns what are no
    controls of theirs. What is recorded after a collision does not count; after the others it is NaN.

    Args:
      disturbances: what goes wrong, in the order in which it happens. Each has its own stream of random numbers.
      controller: what decides on the controls; by default the solution's policy.
      seed: of all random numbers. trials: how many runs. first_trial: number of the first; trial `i` of a seed is the
        same to the last bit whatever runs beside it.
      goal_radius: how near the goal counts as having reached it, in metres; by default the robot's radius.
      goal_tolerance: the same for goals without a position, relative to the plan's range; 0.1 by default. `target.py`
        says of what.
      frames: whether to record what drawing needs, between the control periods too; without it there is no video.
      contacts: whether obstacles stop the robot, from the control period of its first collision on; or it goes through
        them, which takes a quarter less time and is the same to the bit until then, with the same outcome.
      threads: of MuJoCo's; by default as many as there are processors.
      generators: (trial, number of the disturbance) -> where its numbers come from, in place of the seed.
      progress: called after each control period with the number of periods done and of all.
      watch: called with each frame as it comes: its time, MuJoCo's qpos (K, nq), and who has become unstable (K,).

    Raises:
      InputError: the policy is for another robot, or its plan is not finite; the control period is no multiple of the
        physics step; a disturbance does not fit; or an option is out of range.
    """
    check_count("seed", seed, at_least=0)
    check_count("trials", trials)
    check_count("first_trial", first_trial, at_least=0)
    threads = None if threads is None else check_count("threads", threads)
    controller = Feedback(solution.policy) if controller is None else controller
    plan, space = solution.trajectory, plant.robot.dynamics.control_coordinates
    _check_solution(solution, controller, plant)
    target = Target(controller.spaces[0], solution.goal, plan.states)
    radius = target.radius(plant.robot.radius, goal_radius, goal_tolerance)
    substeps = plant.substeps(plan.dt)

    def seeded(trial: int, stream: int) -> np.random.Generator:
        # Of NumPy's generators the quickest to make and to draw from, which shows in the time of the loop.
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(trial, stream))))

    effects = _start(disturbances, plant, solution, generators or seeded, range(first_trial, first_trial + trials))
    displaced = np.zeros((trials, len(plant.world), 3))
    for effect in effects:
        displaced += 0.0 if effect.displaced is None else effect.displaced

    physics = Physics(plant, trials, substeps, contacts=contacts, threads=threads)
    begun = np.tile(plan.states[0], (trials, 1))
    for effect in effects:
        begun = begun if effect.begin is None else effect.begin(begun)
    physics.place(begun)
    for effect in effects:
        if effect.alter is not None:
            effect.alter(physics.simulations)
    if displaced.any():
        plant.displace(physics.simulations, displaced)
    with unlogged():
        physics.begin(altered=bool(displaced.any()) or any(effect.alter for effect in effects))

    measures = [effect.measure for effect in effects if effect.measure is not None]
    actuations = [effect.actuate for effect in effects if effect.actuate is not None]
    wrenches = [(slice(0, 3), effect.force) for effect in effects if effect.force is not None]
    wrenches += [(slice(3, 6), effect.torque) for effect in effects if effect.torque is not None]
    control = controller.start(trials)
    low, high = (np.array(limits) for limits in (space.low, space.high))

    steps, (n, m) = plan.steps, (plan.states.shape[1], plan.controls.shape[1])
    states, measured = _records(trials, steps + 1, n), _records(trials, steps + 1, n)
    commanded, applied, wrench = _records(trials, steps, m), _records(trials, steps, m), _records(trials, steps, 6)
    clearance = _records(trials, steps + 1, 1)[..., 0]
    contact_periods = np.zeros(trials, dtype=np.int64)
    lost_since = np.full(trials, steps + 1)  # the knot from which on a trial's records mean nothing
    failed_since, reasons = np.full(trials, steps + 1), [""] * trials
    seen = [physics.frame()]
    state = physics.state()
    collisions = Collisions(plant, state, displaced, plan.dt)
    watched = 0
    with unlogged():
        for step in range(steps + 1):
            shown = state.copy()
            for measure in measures:
                shown = measure(step, shown)
            states[:, step], measured[:, step], clearance[:, step] = state, shown, collisions.clearance
            lost = physics.unstable | _not_finite(shown)
            if lost.any():
                lost_since[lost] = np.minimum(lost_since[lost], step)
            over = np.minimum(lost_since, failed_since) <= step
            if over.any():
                shown[over] = plan.states[step]  # a trial that is over goes on with the plan's state, for the others
            if step == steps:
                break
            try:
                command = _commands(control(step, shown), (trials, m))
                wrong = _not_finite(command)
                why = [_not_a_number(row, space.names) for row in command[wrong]]
            except Exception as error:  # of a controller, whatever it is: these trials failed
                command, wrong = np.zeros((trials, m)), np.ones(trials, dtype=bool)
                why = [f"{type(error).__name__}: {' '.join(str(error).split())}"] * trials
            for row, reason in zip(np.flatnonzero(wrong), why, strict=True):
                if failed_since[row] > step:
                    failed_since[row], reasons[row] = step, f"controller at {step * plan.dt:.4g} s: {reason}"
            commanded[:, step] = command
            applying = np.where(wrong[:, None], plan.controls[step], command)
            for actuate in actuations:
                applying = actuate(step, applying)
            applying = np.clip(applying, low, high)
            for which, push in wrenches:
                wrench[:, step, which] += push(step, state)
            applied[:, step] = applying
            over = np.minimum(lost_since, failed_since) <= step
            if over.all():
                break
            period = physics.advance(applying, wrench[:, step])
            collided = collisions.look(step, period, ignored=over)
            if contacts and len(collided):
                physics.collide(collided, period)
                collisions.now(period.states[-1])
            if contacts:
                contact_periods += physics.touched(period) & ~over
            state = period.states[-1]
            if frames:
                pictures = physics.drawn(period)
                seen += pictures
                for picture in pictures:
                    watched += 1
                    if watch is not None:
                        watch(watched * plan.dt / physics.drawn_parts, picture, physics.unstable)
            if progress is not None:
                progress(step + 1, steps)
        if physics.feels:
            touching = physics.felt()
            for row in np.flatnonzero(touching.any(axis=1) & np.isinf(collisions.at) & (lost_since > steps)):
                collisions.feel(int(row), plan.horizon, touching[row])

    missing = (steps * physics.drawn_parts + 1 - len(seen)) if frames else 0
    seen += [np.full_like(seen[0], np.nan)] * missing
    drawn = np.stack(seen, axis=1)
    for array in (states, measured):
        compiled.turn_to_nearest(controller.spaces[0], array.transpose(1, 0, 2), plan.states)
    if (np.minimum(lost_since, failed_since) <= steps).any():
        known_until = np.minimum(lost_since, failed_since + 1)  # the knot at which a controller fails is known
        driven_until = np.minimum(lost_since, failed_since)
        # A frame belongs to the knot that ends its period: the trial was lost somewhere before that.
        knot_of_frame = -(np.arange(len(seen)) // -physics.drawn_parts)
        for array, knots, until in (
            *((array, np.arange(steps + 1), known_until) for array in (states, measured, clearance)),
            *((array, np.arange(steps), driven_until) for array in (commanded, applied, wrench)),
            (drawn, knot_of_frame, known_until),
        ):
            array[knots >= until[:, None]] = np.nan
    return Rollout(
        robot=plant.robot.name,
        body=plant.robot.body,
        scene=plant.scene.name,
        model=plant.scene.xml,
        plan=plan,
        policy_digest=controller.digest,
        state_coordinates=controller.spaces[0],
        control_coordinates=controller.spaces[1],
        goal=solution.goal,
        goal_radius=radius,
        radius=plant.robot.radius,
        states=states,
        measured=measured,
        commanded=commanded,
        applied=applied,
        forces=wrench[..., :3],
        torques=wrench[..., 3:],
        displaced=displaced,
        clearance=clearance,
        contacts=contact_periods,
        collided_at=collisions.at,
        obstacles=tuple(collisions.obstacles),
        diverged_at=np.where(lost_since <= steps, plan.dt * lost_since, np.inf),
        failed_at=np.where(failed_since <= steps, plan.dt * failed_since, np.inf),
        reasons=tuple(reasons),
        frame_times=np.arange(len(seen)) * (plan.dt / physics.drawn_parts),
        frames=drawn,
        disturbances=tuple(disturbance.describe(plant) for disturbance in disturbances),
        seed=seed,
        first_trial=first_trial,
        versions=versions(),
    )


def _commands(given: Any, shape: tuple[int, int]) -> Array:
    """What a controller returned. Raises InputError for what are no controls of all trials."""
    try:
        command = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"got {excerpt(given)}, want controls of shape {shape}") from None
    if command.shape != shape:
        raise InputError(f"got controls of shape {command.shape}, want {shape}")
    return command


def _not_a_number(command: Array, names: Sequence[str]) -> str:
    name, value = next(pair for pair in zip(names, command.tolist(), strict=True) if not np.isfinite(pair[1]))
    return f"got {value} for {name}, want a finite number"


def _records(trials: int, steps: int, size: int) -> Array:
    """Zeros (K, steps, size) that lie in memory as they are written: all trials of a step together."""
    return np.zeros((steps, trials, size)).transpose(1, 0, 2)


def _not_finite(rows: Array) -> npt.NDArray[np.bool_]:
    """Which rows (K,) have a number that is not finite."""
    finite = np.isfinite(rows)
    if finite.all():  # a look at all at once is far quicker
        return np.zeros(len(rows), dtype=bool)
    return ~np.all(finite, axis=1)


def _start(
    disturbances: Sequence[Disturbance],
    plant: Plant,
    solution: Solution,
    generators: Callable[[int, int], np.random.Generator],
    trials: range,
) -> list[Effect]:
    effects = []
    for stream, disturbance in enumerate(disturbances):
        if not isinstance(disturbance, Disturbance):
            raise InputError(f"disturbances: got {disturbance!r}, want Disturbance objects, such as ControlNoise(0.05)")
        effects.append(disturbance.start(plant, solution.trajectory, _Streams(generators, trials, stream)))
    return effects


class _Streams(Sequence[np.random.Generator]):
    """The generator of each trial, made when it is asked for: some disturbances draw nothing."""

    def __init__(self, make: Callable[[int, int], np.random.Generator], trials: range, stream: int) -> None:
        self._make, self._trials, self._stream = make, trials, stream
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._trials)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        trial = self._trials[place]
        if trial not in self._made:
            self._made[trial] = self._make(trial, self._stream)
        return self._made[trial]


def _check_solution(solution: Solution, controller: Controller, plant: Plant) -> None:
    dynamics = plant.robot.dynamics
    wanted = dynamics.state_coordinates.names, dynamics.control_coordinates.names
    for field, space, want in zip(("states", "controls"), controller.spaces, wanted, strict=True):
        if space.names != want:
            raise InputError(
                f"solution: got a policy with {field} {', '.join(space.names)}, want those of robot"
                f" {plant.robot.name}: {', '.join(want)}"
            )
    meant, moves = controller.spaces[0], dynamics.state_coordinates
    if (meant.position, meant.plane, meant.offset) != (moves.position, moves.plane, moves.offset):
        raise InputError(
            f"solution: got a policy for a position {_place(meant)}, want that of robot {plant.robot.name}:"
            f" {_place(moves)}"
        )
    if not np.isfinite(solution.trajectory.states).all():
        raise InputError(f"solution: got a plan that is not finite ({solution.status.name}), want one that can be run")


def _place(space: Coordinates) -> str:
    """What the position is, for a message."""
    names = ", ".join(space.names[index] for index in space.position) or "of no states"
    plane = f" in the plane {space.plane!r}" if len(space.plane) == 2 else ""
    return f"({names}){plane}" + ("" if space.offset is None else f" at {space.offset:g} m")

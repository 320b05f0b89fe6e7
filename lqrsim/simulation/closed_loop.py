"""Running a policy on a plant: one code path for one trial and for many."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.control import law
from lqrsim.control.controllers import Controller, Feedback
from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_flag,
    check_function,
    check_items,
    check_kind,
    check_memory,
    check_seed,
    check_text,
    excerpt,
    shaped,
    told,
)
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.goal import Target
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution, Trajectory
from lqrsim.scenes.scene import unlogged
from lqrsim.simulation.collisions import Collisions
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.disturbances.base import Hook
from lqrsim.simulation.physics import Physics, part_of
from lqrsim.simulation.plant import MOST_STEPS, Plant
from lqrsim.solvers.common import check_threads
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
      goal_tolerance: the same for goals without a position, relative to the plan's range; 0.1 by default.
        `results/goal.py` says of what.
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
    check_kind("plant", plant, Plant, "a Plant, such as scenario.plant()")
    check_kind("solution", solution, Solution, "a Solution, such as smooth(problem)")
    kinds = (Controller, type(None))
    check_kind("controller", controller, kinds, "a Controller, such as Feedback(solution.policy), or None")
    disturbances = check_items("disturbances", disturbances, Disturbance, "disturbances, such as ControlNoise(0.05)")
    seed, first_trial = check_seed("seed", seed), check_seed("first_trial", first_trial)
    trials, threads = check_count("trials", trials), check_threads(threads)
    frames, contacts = check_flag("frames", frames), check_flag("contacts", contacts)
    wanted = "a function of the trial and the disturbance's number that returns a numpy.random.Generator"
    check_function("generators", generators, wanted, arguments=2)
    check_function("progress", progress, "a function of how many periods are done, of how many", arguments=2)
    check_function("watch", watch, "a function of the time, MuJoCo's qpos and who is unstable", arguments=3)
    controller = Feedback(solution.policy) if controller is None else controller
    plan, space = solution.trajectory, plant.robot.dynamics.control_coordinates
    states_space, controls_space = _check_solution(solution, controller, plant)
    target = Target(states_space, solution.goal, plan.states)
    radius = target.radius(plant.robot.radius, goal_radius, goal_tolerance)
    substeps = plant.substeps(plan.dt)
    _check_size(plant, plan, substeps, trials, frames=frames)

    def seeded(trial: int, stream: int) -> np.random.Generator:
        # Of NumPy's generators the quickest to make and to draw from, which shows in the time of the loop.
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(trial, stream))))

    named = [type(disturbance).__name__ for disturbance in disturbances]
    effects = _start(disturbances, plant, solution, generators or seeded, range(first_trial, first_trial + trials))
    displaced = np.zeros((trials, len(plant.world), 3))
    n, m = len(plant.robot.dynamics.state_coordinates), len(space)
    for name, effect in zip(named, effects, strict=True):
        if effect.displaced is not None:
            displaced += shaped(f"{name}: displaced", effect.displaced, displaced.shape)
    if not np.isfinite(displaced).all():
        raise InputError("disturbances: got obstacles that are displaced infinitely far, want finite numbers")

    physics = Physics(plant, trials, substeps, contacts=contacts, threads=threads)
    begun = np.tile(plan.states[0], (trials, 1))
    for name, effect in zip(named, effects, strict=True):
        if effect.begin is not None:
            begun = shaped(f"{name}: begin: returned", effect.begin(begun), (trials, n))
    if not np.isfinite(begun).all():
        raise InputError("disturbances: got a start that is infinitely far away, want finite numbers")
    physics.place(begun)
    for effect in effects:
        if effect.alter is not None:
            effect.alter(physics.simulations)
    if displaced.any():
        plant.displace(physics.simulations, displaced)
    with unlogged():
        physics.begin(altered=bool(displaced.any()) or any(effect.alter for effect in effects))

    def hooks(kind: str) -> list[tuple[str, Hook]]:
        """What is called in each period, and what messages call it."""
        given = [(name, getattr(effect, kind)) for name, effect in zip(named, effects, strict=True)]
        return [(f"{name}: {kind}: returned", hook) for name, hook in given if hook is not None]

    measures, actuations = hooks("measure"), hooks("actuate")
    wrenches = [(slice(0, 3), *one) for one in hooks("force")] + [(slice(3, 6), *one) for one in hooks("torque")]
    control = controller.start(trials)
    check_function(
        f"{type(controller).__name__}.start", control, "a function of step and states", arguments=2, optional=False
    )
    low, high = (np.array(limits) for limits in (space.low, space.high))

    steps = plan.steps
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
            for name, measure in measures:
                shown = shaped(name, measure(step, shown), shown.shape)
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
                why = [told(error)] * trials
            for row, reason in zip(np.flatnonzero(wrong), why, strict=True):
                if failed_since[row] > step:
                    failed_since[row], reasons[row] = step, f"controller at {step * plan.dt:.4g} s: {reason}"
            commanded[:, step] = command
            applying = np.where(wrong[:, None], plan.controls[step], command)
            for name, actuate in actuations:
                applying = shaped(name, actuate(step, applying), applying.shape)
            applying = np.clip(applying, low, high)
            for which, name, push in wrenches:
                wrench[:, step, which] += shaped(name, push(step, state), (trials, 3))
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
        law.turn_to_nearest(states_space, array.transpose(1, 0, 2), plan.states)
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
        state_coordinates=states_space,
        control_coordinates=controls_space,
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
        effect = disturbance.start(plant, solution.trajectory, _Streams(generators, trials, stream))
        effects.append(check_kind(f"{type(disturbance).__name__}.start", effect, Effect, "an Effect"))
    return effects


def _check_size(plant: Plant, plan: Trajectory, substeps: int, trials: int, *, frames: bool) -> None:
    """Raises InputError for a run that would not end, or does not fit into memory."""
    if plan.steps * substeps > MOST_STEPS:
        raise InputError(
            f"solution: got a plan of {plan.steps} control periods of {plan.dt:g} s, which are {plan.steps * substeps}"
            f" physics steps, want at most {MOST_STEPS}"
        )
    n, m = plan.states.shape[1], plan.controls.shape[1]
    pictures = plan.steps * (substeps // part_of(plant, substeps)) + 1 if frames else 1
    numbers = (plan.steps + 1) * 3 * (2 * n + 2 * m + 6 + 1) + 2 * pictures * plant.model.nq + 3 * len(plant.world)
    check_memory("trials", trials, 8 * numbers + 2000, "whose records")


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
            made = self._make(trial, self._stream)
            for draw in ("standard_normal", "random"):  # those of `Given` are no Generators
                if not callable(getattr(made, draw, None)):
                    raise InputError(f"generators: got {excerpt(made)}, want a numpy.random.Generator of each trial")
            self._made[trial] = made
        return self._made[trial]


def _check_solution(solution: Solution, controller: Controller, plant: Plant) -> tuple[Coordinates, Coordinates]:
    """What the controller's states and controls are. Raises InputError unless they, and the plan, are the plant's."""
    dynamics = plant.robot.dynamics
    wanted = dynamics.state_coordinates.names, dynamics.control_coordinates.names
    kind = type(controller).__name__
    check_text(f"{kind}.digest", controller.digest, "a hash as text")
    spaces = check_items(f"{kind}.spaces", controller.spaces, Coordinates, "Coordinates of states and of controls")
    if len(spaces) != 2:
        raise InputError(f"{kind}.spaces: got {len(spaces)}, want two: of the states, of the controls")
    for field, space, want in zip(("states", "controls"), spaces, wanted, strict=True):
        if space.names != want:
            raise InputError(
                f"solution: got a policy with {field} {', '.join(space.names)}, want those of robot"
                f" {plant.robot.name}: {', '.join(want)}"
            )
    meant, moves = spaces[0], dynamics.state_coordinates
    if (meant.position, meant.plane, meant.offset) != (moves.position, moves.plane, moves.offset):
        raise InputError(
            f"solution: got a policy for a position {_place(meant)}, want that of robot {plant.robot.name}:"
            f" {_place(moves)}"
        )
    plan = solution.trajectory
    if plan.states.shape[1] != len(wanted[0]) or plan.controls.shape[1] != len(wanted[1]):
        shapes = f"{plan.states.shape[1]} states and {plan.controls.shape[1]} controls"
        raise InputError(f"solution: got a plan of {shapes}, want {len(wanted[0])} and {len(wanted[1])}")
    if not (np.isfinite(plan.states).all() and np.isfinite(plan.controls).all()):
        raise InputError(f"solution: got a plan that is not finite ({solution.status.name}), want one that can be run")
    # A command that the robot cuts off is at a limit, whatever the policy took the limits to be.
    own = dynamics.control_coordinates
    low, high = np.maximum(spaces[1].low, own.low), np.minimum(spaces[1].high, own.high)
    return spaces[0], spaces[1].limited(low, high)


def _place(space: Coordinates) -> str:
    """What the position is, for a message."""
    names = ", ".join(space.names[index] for index in space.position) or "of no states"
    plane = f" in the plane {space.plane!r}" if len(space.plane) == 2 else ""
    return f"({names}){plane}" + ("" if space.offset is None else f" at {space.offset:g} m")

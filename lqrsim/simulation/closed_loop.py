"""Running a policy on a plant: one code path for one trial and for many."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError, check_count, check_number
from lqrsim.results import Solution
from lqrsim.rollout import Rollout
from lqrsim.scenes import unlogged
from lqrsim.simulation.controllers import Controller, Feedback
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.physics import Physics
from lqrsim.simulation.plant import Plant
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
    frames: bool = True,
    contacts: bool = True,
    threads: int | None = None,
    generators: Callable[[int, int], np.random.Generator] | None = None,
    progress: Callable[[int, int], object] | None = None,
    watch: Callable[[float, Array, npt.NDArray[np.bool_]], object] | None = None,
) -> Rollout:
    """Execute the solution's policy closed-loop in MuJoCo, from the first state of its plan.

    In each control period: read the true state, measure it, ask the policy, disturb its command, saturate, push, step.

    Args:
      disturbances: what goes wrong, in the order in which it happens. Each has its own stream of random numbers.
      controller: what decides on the controls; by default the solution's policy.
      seed: of all random numbers. trials: how many runs. first_trial: number of the first; trial `i` of a seed is the
        same to the last bit whatever runs beside it.
      goal_radius: how near the plan's end counts as having reached it, in metres; by default the robot's radius.
      frames: whether to record what drawing needs, between the control periods too; without it there is no video.
      contacts: whether obstacles stop the robot, or it goes through them, which takes a quarter less time and is the
        same until the first collision.
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
    goal_radius = plant.robot.radius if goal_radius is None else check_number("goal_radius", goal_radius, above=0.0)
    controller = Feedback(solution.policy) if controller is None else controller
    plan, space = solution.trajectory, plant.robot.dynamics.control_coordinates
    _check_solution(solution, controller, plant)
    substeps = plant.substeps(plan.dt)

    def seeded(trial: int, stream: int) -> np.random.Generator:
        # Of NumPy's generators the quickest to make and to draw from, which shows in the time of the loop.
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(trial, stream))))

    effects = _start(disturbances, plant, solution, generators or seeded, range(first_trial, first_trial + trials))
    displaced = np.zeros((trials, len(plant.world), 3))
    for effect in effects:
        displaced += 0.0 if effect.displaced is None else effect.displaced

    physics = Physics(plant, trials, substeps, frames=frames, contacts=contacts, threads=threads, watch=watch)
    begun = np.tile(plan.states[0], (trials, 1))
    for effect in effects:
        begun = begun if effect.begin is None else effect.begin(begun)
    physics.place(begun)
    for effect in effects:
        if effect.alter is not None:
            effect.alter(physics.simulations)
    if displaced.any():
        plant.displace(physics.simulations, displaced)
    if any(effect.alter for effect in effects) or displaced.any():
        with unlogged():
            physics.simulations.set_const()

    measures = [effect.measure for effect in effects if effect.measure is not None]
    actuations = [effect.actuate for effect in effects if effect.actuate is not None]
    wrenches = [(slice(0, 3), effect.force) for effect in effects if effect.force is not None]
    wrenches += [(slice(3, 6), effect.torque) for effect in effects if effect.torque is not None]
    control = controller.start(trials)
    low, high = (np.array(limits) for limits in (space.low, space.high))

    steps, (n, m) = plan.steps, (plan.states.shape[1], plan.controls.shape[1])
    states, measured = _records(trials, steps + 1, n), _records(trials, steps + 1, n)
    commanded, applied, wrench = _records(trials, steps, m), _records(trials, steps, m), _records(trials, steps, 6)
    contact_periods = np.zeros(trials, dtype=np.int64)
    lost = np.zeros(trials, dtype=bool)
    lost_since = np.full(trials, steps + 1)  # the knot from which on a trial's records mean nothing
    seen = [physics.frame()]
    with unlogged():
        for step in range(steps + 1):
            state = physics.state()
            shown = state.copy()
            for measure in measures:
                shown = measure(step, shown)
            states[:, step], measured[:, step] = state, shown
            lost |= physics.unstable | _not_finite(shown)
            if lost.any():
                lost_since[lost] = np.minimum(lost_since[lost], step)
                shown[lost] = plan.states[step]  # a lost trial goes on with the plan's state, so that the others do
            if step == steps:
                break
            command = control(step, shown)
            lost |= _not_finite(command)
            applying = command.copy()
            for actuate in actuations:
                applying = actuate(step, applying)
            applying = np.clip(applying, low, high)
            for which, push in wrenches:
                wrench[:, step, which] += push(step, state)
            commanded[:, step], applied[:, step] = command, applying
            touched, pictures = physics.advance(applying, wrench[:, step])
            contact_periods += touched & ~lost
            seen += pictures
            if progress is not None:
                progress(step + 1, steps)

    drawn = np.stack(seen, axis=1)
    for array in (states, measured):
        compiled.turn_to_nearest(controller.spaces[0], array.transpose(1, 0, 2), plan.states)
    if lost.any():
        # A frame belongs to the knot that ends its period: the trial was lost somewhere before that.
        knot_of_frame = -(np.arange(len(seen)) // -max(physics.parts, 1))
        for array, knots in (
            *((array, np.arange(steps + 1)) for array in (states, measured)),
            *((array, np.arange(steps)) for array in (commanded, applied, wrench)),
            (drawn, knot_of_frame),
        ):
            array[knots >= lost_since[:, None]] = np.nan
    return Rollout(
        robot=plant.robot.name,
        body=plant.robot.body,
        scene=plant.scene.name,
        model=plant.scene.xml,
        plan=plan,
        policy_digest=controller.digest,
        state_coordinates=controller.spaces[0],
        control_coordinates=controller.spaces[1],
        radius=plant.robot.radius,
        goal_radius=goal_radius,
        states=states,
        measured=measured,
        commanded=commanded,
        applied=applied,
        forces=wrench[..., :3],
        torques=wrench[..., 3:],
        displaced=displaced,
        clearance=plant.clearance(states, displaced),
        contacts=contact_periods,
        diverged=lost,
        frame_times=np.arange(len(seen)) * (plan.dt / max(physics.parts, 1)),
        frames=drawn,
        disturbances=tuple(disturbance.describe(plant) for disturbance in disturbances),
        seed=seed,
        first_trial=first_trial,
        versions=versions(),
    )


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

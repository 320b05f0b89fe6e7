"""Running a policy on a plant: one code path for one trial and for many."""

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from mujoco import batch

from lqrsim.errors import Array, InputError, check_count, check_number
from lqrsim.machine import processors
from lqrsim.policy import AffinePolicy
from lqrsim.results import Solution
from lqrsim.rollout import Rollout
from lqrsim.simulation.disturbances import Disturbance, Effect
from lqrsim.simulation.plant import Plant
from lqrsim.versions import versions

FRAME_PERIOD = 1 / 30  # s; positions for drawing are recorded at least this often, if the physics step is not longer


def simulate(
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance] = (),
    seed: int = 0,
    trials: int = 1,
    first_trial: int = 0,
    goal_radius: float | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Rollout:
    """Execute the solution's policy closed-loop in MuJoCo, from the first state of its plan.

    In each control period: read the true state, measure it, ask the policy, disturb its command, saturate, push, step.

    Args:
      disturbances: what goes wrong, in the order in which it happens. Each has its own stream of random numbers.
      seed: of all random numbers. trials: how many runs. first_trial: number of the first; trial `i` of a seed is the
        same to the last bit whatever runs beside it.
      goal_radius: how near the plan's end counts as having reached it, in metres; by default the robot's radius.
      progress: called after each control period with the number of periods done and of all.

    Raises:
      InputError: the policy is for another robot, or its plan is not finite; the control period is no multiple of the
        physics step; a disturbance does not fit; or an option is out of range.
    """
    check_count("seed", seed, at_least=0)
    check_count("trials", trials)
    check_count("first_trial", first_trial, at_least=0)
    goal_radius = plant.robot.radius if goal_radius is None else check_number("goal_radius", goal_radius, above=0.0)
    policy, plan = solution.policy, solution.trajectory
    _check_solution(solution, plant)
    substeps = plant.substeps(plan.dt)
    effects = _start(disturbances, plant, solution, seed, range(first_trial, first_trial + trials))

    measures = [effect.measure for effect in effects if effect.measure is not None]
    actuations = [effect.actuate for effect in effects if effect.actuate is not None]
    pushes = [effect.force for effect in effects if effect.force is not None]

    simulation = _Simulation(plant, trials, substeps)
    simulation.place(plan.states[0])
    steps, (n, m) = plan.steps, (plan.states.shape[1], plan.controls.shape[1])
    states, measured = np.empty((trials, steps + 1, n)), np.empty((trials, steps + 1, n))
    commanded, applied = np.empty((trials, steps, m)), np.empty((trials, steps, m))
    forces = np.zeros((trials, steps, 3))
    contacts = np.zeros(trials, dtype=np.int64)
    lost = np.zeros(trials, dtype=bool)
    lost_since = np.full(trials, steps + 1)  # the knot from which on a trial's records mean nothing
    frames = [simulation.frame()]

    for step in range(steps + 1):
        nominal = plan.states[step]
        state = simulation.state(nominal)
        shown = state.copy()
        for measure in measures:
            shown = measure(step, shown)
        states[:, step], measured[:, step] = state, shown
        lost |= simulation.unstable | ~np.isfinite(shown).all(axis=1)
        lost_since[lost] = np.minimum(lost_since[lost], step)
        if step == steps:
            break
        # A lost trial goes on with the plan's state, so that the others do. One matrix product a trial, whatever their
        # number: a product of all at once may round differently.
        command = policy(np.where(lost[:, None], nominal, shown)[:, None], step * plan.dt)[:, 0]
        lost |= ~np.isfinite(command).all(axis=1)
        control = command.copy()
        for actuate in actuations:
            control = actuate(step, control)
        control = plant.robot.dynamics.control_coordinates.clip(control)
        for push in pushes:
            forces[:, step] += push(step, state)
        commanded[:, step], applied[:, step] = command, control
        touched, seen = simulation.advance(control, forces[:, step])
        contacts += touched & ~lost
        frames += seen
        if progress is not None:
            progress(step + 1, steps)

    # A frame belongs to the knot that ends its period: the trial was lost somewhere before that.
    per_period = (len(frames) - 1) // steps
    knot_of_frame = -(np.arange(len(frames)) // -per_period)
    pictures = np.stack(frames, axis=1)
    for array, knots in (
        *((array, np.arange(steps + 1)) for array in (states, measured)),
        *((array, np.arange(steps)) for array in (commanded, applied, forces)),
        (pictures, knot_of_frame),
    ):
        array[knots >= lost_since[:, None]] = np.nan
    return Rollout(
        robot=plant.robot.name,
        scene=plant.scene.name,
        model=plant.scene.xml,
        plan=plan,
        policy_digest=_digest(policy),
        state_coordinates=policy.state_coordinates,
        control_coordinates=policy.control_coordinates,
        radius=plant.robot.radius,
        goal_radius=goal_radius,
        states=states,
        measured=measured,
        commanded=commanded,
        applied=applied,
        forces=forces,
        clearance=plant.clearance(states),
        contacts=contacts,
        diverged=lost,
        frame_times=np.arange(len(frames)) * (plan.dt / per_period),
        frames=pictures,
        disturbances=tuple(disturbance.describe(plant) for disturbance in disturbances),
        seed=seed,
        first_trial=first_trial,
        versions=versions(),
    )


class _Simulation:
    """MuJoCo's side of the loop: all trials' states, and how to advance them by a control period."""

    def __init__(self, plant: Plant, trials: int, substeps: int) -> None:
        self.plant = plant
        self.batch = batch.Batch(plant.model, trials, min(trials, processors()))
        self._sensors = self.batch.bind("sensordata")
        # The longest equal parts of the period that are short enough to draw.
        parts = [part for part in range(1, substeps + 1) if substeps % part == 0]
        self._part = max([part for part in parts if part * plant.timestep <= FRAME_PERIOD + 1e-9], default=1)
        self._parts = substeps // self._part
        self.unstable = np.zeros(trials, dtype=bool)

    def place(self, state: Array) -> None:
        """Put all robots where an analytic state (n,) says."""
        self.batch.qpos[:, self.plant.qpos], self.batch.qvel[:, self.plant.qvel] = self.plant.robot.configuration(state)

    def frame(self) -> Array:
        return self.batch.qpos.copy()

    def state(self, near: Array) -> Array:
        """The analytic states (K, n), in the representative nearest to `near` (n,)."""
        qpos, qvel = self.batch.qpos[:, self.plant.qpos], self.batch.qvel[:, self.plant.qvel]
        return self.plant.robot.state(qpos, qvel, near=near)

    def advance(self, controls: Array, forces: Array) -> tuple[np.ndarray, list[Array]]:
        """One control period under controls (K, m) and forces (K, 3): who touched an obstacle, (K,), and the frames."""
        touched = np.zeros(len(controls), dtype=bool)
        frames = []
        self.batch.ctrl[:, self.plant.ctrl] = self.plant.robot.actuation(controls)
        self.batch.xfrc_applied[:, self.plant.body, :3] = forces
        with _unlogged():
            for _ in range(self._parts):
                try:
                    self.batch.step(nstep=self._part)
                except batch.SimulationError as error:
                    self.unstable[error.ids] = True
                touched |= (self._sensors[:, self.plant.contact] > 0).any(axis=1)
                frames.append(self.frame())
        # MuJoCo resets an unstable simulation and goes on; only its warnings tell.
        self.unstable |= (self.batch.warning[:, _UNSTABLE, 1] > 0).any(axis=1)
        return touched, frames


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Keeps MuJoCo from writing MUJOCO_LOG.TXT into the working folder when a trial becomes unstable; we record it."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_file = quiet.logto_console = False
    quiet.set()
    try:
        yield
    finally:
        before.set()


_WARNINGS = mujoco.mjtWarning
_UNSTABLE = [int(warning) for warning in (_WARNINGS.mjWARN_BADQPOS, _WARNINGS.mjWARN_BADQVEL, _WARNINGS.mjWARN_BADQACC)]


def _start(
    disturbances: Sequence[Disturbance], plant: Plant, solution: Solution, seed: int, trials: range
) -> list[Effect]:
    effects = []
    for stream, disturbance in enumerate(disturbances):
        if not isinstance(disturbance, Disturbance):
            raise InputError(f"disturbances: got {disturbance!r}, want Disturbance objects, such as ControlNoise(0.05)")
        keys = [np.random.SeedSequence(seed, spawn_key=(trial, stream)) for trial in trials]
        generators = [np.random.Generator(np.random.Philox(key)) for key in keys]
        effects.append(disturbance.start(plant, solution.trajectory, generators))
    return effects


def _check_solution(solution: Solution, plant: Plant) -> None:
    policy, dynamics = solution.policy, plant.robot.dynamics
    for field, got, want in (
        ("states", policy.state_coordinates.names, dynamics.state_coordinates.names),
        ("controls", policy.control_coordinates.names, dynamics.control_coordinates.names),
    ):
        if got != want:
            raise InputError(
                f"solution: got a policy with {field} {', '.join(got)}, want those of robot {plant.robot.name}:"
                f" {', '.join(want)}"
            )
    if not np.isfinite(solution.trajectory.states).all():
        raise InputError(f"solution: got a plan that is not finite ({solution.status.name}), want one that can be run")


def _digest(policy: AffinePolicy) -> str:
    hasher = hashlib.sha256()
    for array in (policy.gain, policy.offset, policy.nominal, np.float64(policy.dt)):
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.hexdigest()[:16]

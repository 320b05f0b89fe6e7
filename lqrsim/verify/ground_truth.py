"""The record of a run: actual and planned positions, and whether the parts of the record fit together."""

from collections.abc import Callable

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_function, check_kind
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.verify.verdict import Criterion
from lqrsim.view.recorded_trial import model_of, place_in, robot_body

Progress = Callable[[int, int], object]


def check_arguments(solution: Solution | None, progress: Progress | None) -> None:
    """Raises InputError unless these are a solution and a function, or None."""
    check_kind("solution", solution, (Solution, type(None)), "the Solution of the run, or None")
    check_function("progress", progress, "a function of how many frames are done, of how many", arguments=2)


def drawable_model(rollout: Rollout, trial: int) -> mujoco.MjModel:
    """The model that was run. Raises InputError if there is no such trial, or it has no frames."""
    model = model_of(rollout, trial)
    if len(rollout.frame_times) < 2:
        raise InputError(f"rollout.frames: got shape {rollout.frames.shape}, want what simulate(frames=True) records")
    return model


def describe(rollout: Rollout, trial: int) -> str:
    """Robot, scene, seed and trial, as text."""
    return f"{rollout.robot} in {rollout.scene}, seed {rollout.seed}, trial {rollout.first_trial + trial}"


def frames_at_states(rollout: Rollout, trial: int) -> tuple[Array, npt.NDArray[np.intp]]:
    """The times of the states that have a frame, and the rows of these frames."""
    rows = np.abs(rollout.frame_times - rollout.times[:, None]).argmin(axis=1)
    good = np.abs(rollout.frame_times[rows] - rollout.times) < 1e-6 * rollout.plan.dt
    good &= np.isfinite(rollout.frames[trial, rows]).all(axis=1) & np.isfinite(rollout.states[trial]).all(axis=1)
    if good.sum() < 3:
        raise InputError(f"rollout: got trial {trial} with {good.sum()} frames to draw, want 3 or more")
    return rollout.times[good], rows[good]


def state_positions(rollout: Rollout, trial: int, times: Array) -> Array:
    """Positions (N, d) of the states nearest to these times."""
    rows = np.abs(rollout.times - times[:, None]).argmin(axis=1)
    return rollout.places(trial)[rows]


def planned_positions(rollout: Rollout, times: Array) -> Array:
    """Planned positions (N, d)."""
    return np.stack([np.interp(times, rollout.times, column) for column in rollout.planned_places.T], axis=1)


def frame_positions(rollout: Rollout, trial: int, model: mujoco.MjModel, times: Array) -> Array:
    """Positions (N, d) of the robot's body from the frames, which are denser than the states."""
    good = np.isfinite(rollout.frames[trial]).all(axis=1)
    data, body, places = mujoco.MjData(model), robot_body(model, rollout.body), []
    for frame in rollout.frames[trial, good]:
        data.qpos = frame
        mujoco.mj_kinematics(model, data)
        places.append(place_in(data, rollout, body).copy())
    columns = rollout.of_world(places).T
    return np.stack([np.interp(times, rollout.frame_times[good], column) for column in columns], axis=1)


def check_record(rollout: Rollout, trial: int, model: mujoco.MjModel, bound: float) -> Criterion:
    """Whether states and frames are one motion."""
    times, _ = frames_at_states(rollout, trial)
    found, wanted = frame_positions(rollout, trial, model, times), state_positions(rollout, trial, times)
    apart = np.linalg.norm(found - wanted, axis=1).max()
    said = f"frames and states at most {1e3 * apart:.2f} mm apart, want {1e3 * bound:.2f} at most"
    return Criterion("record", bool(apart <= bound), said)


def check_plan(rollout: Rollout, solution: Solution | None) -> Criterion:
    """Whether the plan is that of the solution; not checked if another policy was run."""
    if solution is None:
        return Criterion("plan", None, "not checked without the solution")
    same = np.array_equal(rollout.plan.states, solution.trajectory.states)
    same = same and np.array_equal(rollout.plan.controls, solution.trajectory.controls)
    if not same:
        return Criterion("plan", False, "not that of the solution")
    if not ran_policy_of(solution, rollout):
        unknown = "whether the controller followed it is unknown, for it was not the solution's policy"
        return Criterion("plan", None, f"that of the solution; {unknown}")
    return Criterion("plan", True, "that of the solution, whose policy was run")


def ran_policy_of(solution: Solution, rollout: Rollout) -> bool:
    """Whether the solution's policy was run, with or without its gains."""
    return rollout.policy_digest in [one.policy.digest for one in (solution, solution.open_loop())]

"""Runs as a data set of Minari, to learn from; needs the extra `minari`."""

import contextlib
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from lqrsim.errors import Array, InputError, check_kind, check_text, excerpt
from lqrsim.gym.environment import Environment, Task
from lqrsim.results.coordinates import check_same_system, spaces_of
from lqrsim.results.rollout import Rollout

NAMED = "NAMESPACE/NAME-vVERSION, such as quadrotor/light-v0, of letters, digits, - and _"
FACTS = ("robot", "scene", "disturbances", "seed", "policy_digest")  # of each rollout, in the data set's metadata


def write_minari(name: str, env: Any, rollouts: Rollout | Iterable[Rollout], **about: Any) -> Any:
    """Write runs as a data set of Minari: the episodes that an environment has under the same commands.

    Each trial is an episode: observations (t+1, n+1), actions (t, m), and rewards, terminations and truncations (t,) as
    in `Environment`, for the t control periods until it ended. Its infos are the true `state` (t+1, n) and the
    `clearance` (t+1,). A trial whose controller failed is truncated there; if it failed at once, it has no episode.

    An episode's metadata has its `seed`, `trial`, `outcome`, and the number of its `rollout`; `env.reset(seed=seed,
    options={"trial": trial})` begins it again. The data set's metadata has a list `lqrsim`: for each rollout robot,
    scene, disturbances, seed, hash of the controller, and versions.

    The folder is that of Minari, `MINARI_DATASETS_PATH`. The data set is written as a whole or not at all.

    Args:
      env: an `Environment` with the solution that was run; wrappers do not matter. Rewards are by the costs of its
        scenario, actions in its units. If text describes its arguments, `dataset.recover_environment()` makes it.
      rollouts: runs of that solution's plan, by any controller.
      about: more arguments of `minari.create_dataset_from_buffers`, such as author, description, data_format.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage import get_dataset_path
    except ImportError as error:
        raise InputError(f"minari: {error}; run: pip install 'lqrsim[minari]'") from None
    try:
        parse_dataset_id(check_text("name", name, NAMED))
    except (ValueError, TypeError):  # a TypeError for a name without a version
        raise InputError(f"name: got {excerpt(name)}, want {NAMED}") from None
    unwrapped = check_kind("env", getattr(env, "unwrapped", env), Environment, "an Environment of lqrsim.gym")
    task, facts, episodes = unwrapped.task, list[Any](), list[Any]()
    runs = [rollouts] if isinstance(rollouts, Rollout) else rollouts

    def buffers() -> Iterator[Any]:
        """All episodes, one at a time, for all runs together may be more than fits into memory."""
        for rollout in _checked(task, runs):
            for row, arrays in _episodes(task, rollout):
                trial = {"trial": rollout.first_trial + row, "outcome": rollout.outcome[row], "rollout": len(facts)}
                episodes.append(trial)
                yield EpisodeBuffer(seed=rollout.seed, **arrays)
            facts.append({fact: getattr(rollout, fact) for fact in FACTS} | {"versions": dict(rollout.versions)})
        if not episodes:
            raise InputError("rollouts: got no trial that ran for a control period, want at least one")

    about = {"description": f"{task.scenario.name}: {task.scenario.summary}", "env": unwrapped, **about}
    try:
        with _removed_on_failure(get_dataset_path(name)), warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"minari\.")  # what is not known, such as an author
            storage = minari.create_dataset_from_buffers(name, cast("list[Any]", buffers()), **about).storage
            storage.update_episode_metadata(episodes)
            storage.update_metadata({"lqrsim": facts})
    except OSError as error:
        raise InputError(f"name: got {name}, want the folder of Minari to be writable ({error})") from None
    return minari.load_dataset(name)


@contextlib.contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a new data set, and namespaces made for it, unless the block succeeds. Raises InputError if it exists."""
    if os.path.lexists(folder):
        raise InputError(f"name: got the name of {folder}, which exists, want another name or version")
    namespaces = [parent for parent in folder.parents if not parent.exists()]
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        for namespace in namespaces:
            with contextlib.suppress(OSError):
                if set(os.listdir(namespace)) <= {"namespace_metadata.json"}:  # nobody else has written into it
                    shutil.rmtree(namespace)
        raise


def _checked(task: Task, rollouts: Iterable[Any]) -> Iterator[Rollout]:
    """The runs. Raises InputError unless each is a run of the task's plan."""
    wanted = "a Rollout, or several, such as simulate(...) returns"
    plan, system = task.solution.trajectory, spaces_of(task.plant.robot.dynamics)
    if not isinstance(rollouts, Iterable) or isinstance(rollouts, np.ndarray):
        raise InputError(f"rollouts: got {excerpt(rollouts)}, want {wanted}")
    for rollout in rollouts:
        run_plan = check_kind("rollouts", rollout, Rollout, wanted).plan
        check_same_system("rollouts", "a run", spaces_of(rollout), system, "the environment")
        if run_plan.dt != plan.dt or not all(
            map(np.array_equal, (run_plan.states, run_plan.controls), (plan.states, plan.controls))
        ):
            raise InputError("rollouts: got runs of another plan than env's, want env to have their solution=")
        yield rollout


def _episodes(task: Task, rollout: Rollout) -> Iterator[tuple[int, dict[str, Any]]]:
    """The rows of the trials that ran for a control period, each with the arrays of its episode; see `write_minari`."""
    plan, states, applied = rollout.plan, rollout.states, rollout.applied
    # The period of a collision is the last one, also if it begins with that. Rounding: 3 * 0.1 is more than 0.3.
    periods = np.clip(np.ceil(rollout.ended / plan.dt - 1e-9).astype(int), 1, plan.steps)
    time = np.broadcast_to(np.arange(plan.steps + 1) / plan.steps, states.shape[:2])
    observations = np.concatenate([rollout.measured, time[..., None]], axis=2)
    actions = task.actions_of(np.clip(rollout.commanded, task.low, task.high))
    rewards = -np.stack([task.costs.stage(t, states[:, t], applied[:, t]) for t in range(plan.steps)], axis=1)
    for row, outcome in enumerate(rollout.outcome):
        count = min(int(periods[row]), int(np.isfinite(rollout.commanded[row]).all(axis=1).sum()))
        if not count:
            continue
        last: Array = states[row, count]
        if not np.isfinite(last).all():  # an unstable trial has no valid state: its previous one
            last, observations[row, count, :-1] = states[row, count - 1], observations[row, count - 1, :-1]
        rewards[row, count - 1] -= task.costs.final(last[None], applied[row, count - 1][None])[0]
        terminated = outcome in ("collided", "diverged")
        at_end, clearance = np.arange(1, count + 1) == count, rollout.clearance[row, : count + 1]
        arrays = {
            "observations": observations[row, : count + 1],
            "actions": actions[row, :count],
            "rewards": rewards[row, :count],
            "terminations": at_end & terminated,
            "truncations": at_end & (not terminated),
            # A list: Minari 0.5.4 writes arrays (t+1,) of infos to Arrow's format, but cannot read them.
            "infos": {"state": states[row, : count + 1], "clearance": clearance.tolist()},
        }
        yield row, arrays

"""Many environments of one scenario, run by MuJoCo as one batch."""

import os
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from lqrsim.errors import Array, InputError, check_count, check_seed, shaped
from lqrsim.gym.episode import Episode, Resettable
from lqrsim.gym.task import Actions, Disturbances, Flags, Task, reset_options
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario


class VectorEnvironment(Resettable, VectorEnv[Array, Array, Any]):
    """K trials of one scenario at once, with the actions, observations and rewards of `Environment`.

    All begin together and have the same horizon. After its end a trial keeps its observation and flags; its rewards are
    0, and its actions have no effect. There is no automatic reset: `reset` begins all trials again.

    `reset(seed=s)` begins trials 0 to K-1 of seed s, the next `reset()` trials K to 2K-1. Each is bit-identical to the
    trial in `simulate` and in an `Environment`. The info has arrays with an entry per trial.

    Args:
      num_envs: K. threads: of MuJoCo; by default one per processor.
      frames: whether `rollout()` can be drawn; it takes memory.

    The others are those of `Environment`.

    Raises:
      InputError: as `Environment` does.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012 - as in its base class

    def __init__(
        self,
        scenario: str | Scenario,
        *,
        num_envs: int = 1,
        solution: Solution | str | os.PathLike[str] | None = None,
        disturbances: Disturbances = (),
        strength: float = 1.0,
        actions: Actions = "normalized",
        threads: int | None = None,
        frames: bool = False,
    ) -> None:
        self.num_envs = check_count("num_envs", num_envs)
        self.task = Task(scenario, solution, disturbances, strength, actions)
        self.single_action_space, self.single_observation_space = (
            self.task.action_space(), self.task.observation_space(),
        )  # fmt: skip
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._frames, self._threads = frames, threads

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes. Raises InputError for more than one seed, or an invalid option."""
        if isinstance(seed, Sequence) and not isinstance(seed, str):
            raise InputError(f"seed: got {len(seed)} of them, want one: episodes are trials 0, 1, 2, ... of it")
        seed, options = None if seed is None else check_seed("seed", seed), reset_options(options)
        mask = options.pop("reset_mask", None)
        if mask is not None and not shaped("options: reset_mask", mask, (self.num_envs,)).all():
            raise InputError("options: reset_mask: got some of the episodes, want all: they begin together")
        super().reset(seed=seed)
        count, frames, threads = self.num_envs, self._frames, self._threads
        episode = self._begin(seed, self.np_random, options, count, frames=frames, threads=threads)
        return episode.observations, self._info(episode)

    def step(self, actions: npt.ArrayLike) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """Run one control period of all episodes that have not ended.

        Raises:
          InputError: the actions are not finite, or not (K, m); or all episodes have ended.
        """
        episode = self._current()
        if episode.ended.all():
            raise InputError("step: all episodes have ended, call reset() first")
        moment = episode.advance(self.task.controls_of(actions, self.num_envs))
        return moment.observations, moment.rewards, moment.terminated, moment.truncated, self._info(episode)

    def render(self) -> NoReturn:
        """Raises InputError: a batch has no pictures of its own; `lqrsim.render` draws its rollout."""
        raise InputError("render: got a batch, want an Environment, or lqrsim.render(rollout()) with frames=True")

    def _info(self, episode: Episode) -> dict[str, Any]:
        numbers = episode.trials.first + np.arange(self.num_envs)
        return {
            "seed": episode.trials.seed, "trial": numbers, "time": episode.time, "state": episode.states,
            "clearance": episode.clearance, "outcome": episode.outcomes.copy(),
            "is_success": episode.outcomes == "reached",
        }  # fmt: skip

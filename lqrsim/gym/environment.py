"""Scenarios as Gymnasium environments, one or many at once, and controllers as agents."""

import os
from collections.abc import Sequence
from typing import Annotated, Any, NoReturn

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from lqrsim.annotations import Count, OneOf, Seed, checked
from lqrsim.control.controllers import ControllerLike, ControllerRun, as_controller
from lqrsim.errors import Array, InputError, check_kind, check_seed, excerpt, shaped, vectors_of
from lqrsim.gym.episode import Actions, Disturbances, Episode, Flags, Resettable, Task, reset_options
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.view.picture import LivePicture

RENDER_MODES = ("rgb_array",)


class Environment(Resettable, gymnasium.Env[Any, Any]):
    """The closed loop of `simulate` with an agent instead of the policy.

    An observation is the measured state, (n,), angles in the representative nearest the plan, followed by the time as a
    fraction of the horizon. An action is a control; it is clipped to the limits, as in `simulate`. The reward is minus
    the stage cost of the scenario's problem, for the true state and the applied control; the last reward includes minus
    the final cost. An episode is truncated at the horizon, and terminates with a collision or an unstable simulation.

    Episodes are trials: `reset(seed=s)` begins trial 0 of seed s, and each following `reset()` begins the next trial.
    Each episode is bit-identical to that trial in `simulate` with the same commands.

    Options of `reset`, for that episode only: `disturbances` and `strength` as below; `preset`, a name as in
    `lqrsim.disturbances.preset`; `trial`, the number of the trial. The info has `seed`, `trial`, `time` in s, the true
    `state` (n,) and the `clearance` in m; at the end also `outcome`, as in `Rollout.outcome`, and `is_success`.

    Args:
      scenario: a reference as on the command line, such as "quadrotor,query=3", or a Scenario.
      solution: a Solution, or the path of a saved solution. Its plan gives the first state, the duration and the
        reference of disturbances. By default the scenario's problem is solved at the first `reset`.
      disturbances: a name as in `lqrsim simulate --disturbances`, or a tuple of names and disturbances. strength:
        factor by which the disturbances are scaled.
      actions: "normalized": from -1 to 1, between the limits of each control; "controls": the controls themselves in
        their units, within their limits.
      camera, size: of the pictures; any camera of `render` except "chase".

    Attributes:
      task: the scenario and its plant. solution: the solution with the plan.
    """

    _prefix = ""

    metadata: dict[str, Any] = {  # noqa: RUF012 - as in its base class
        "render_modes": list(RENDER_MODES),
        "render_fps": 30,
    }

    @checked
    def __init__(
        self,
        scenario: str | Scenario,
        *,
        solution: Solution | str | os.PathLike[str] | None = None,
        disturbances: Disturbances = (),
        strength: float = 1.0,
        actions: Actions = "normalized",
        render_mode: Annotated[str, OneOf(RENDER_MODES)] | None = None,
        camera: str = "overview",
        size: tuple[int, int] = (640, 360),
    ) -> None:
        self.task = Task(scenario, solution, disturbances, strength, actions)
        self.render_mode = render_mode
        self._picture = LivePicture(camera, size)
        self.action_space, self.observation_space = self.task.action_space(), self.task.observation_space()
        fps = max(round(1 / self.task.scenario.problem.dt), 1)
        self.metadata = {**type(self).metadata, "render_fps": fps}

    @checked
    def reset(self, *, seed: Seed | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see the class."""
        super().reset(seed=seed)
        before, episode = self._episode, self._begin(seed, self.np_random, options)
        if before is not None and not np.array_equal(before.loop.effects.displaced, episode.loop.effects.displaced):
            self._picture.close()  # its obstacles are where they were in the episode before
        return episode.observations[0], self._info(episode)

    def step(self, action: npt.ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        episode = self._current()
        if episode.ended[0]:
            raise InputError("step: the episode has ended, call reset() first")
        seen, rewards, terminated, truncated = episode.advance(self.task.controls_of([action], 1))
        return seen[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self._info(episode)

    def render(self) -> npt.NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A picture of the current state, (height, width, 3); None without a render_mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        episode = self._current()
        return self._picture.draw(episode.loop.so_far, episode.loop.physics.frame()[0], episode.time)

    def close(self) -> None:
        self._picture.close()

    def _info(self, episode: Episode) -> dict[str, Any]:
        info: dict[str, Any] = {
            "seed": episode.loop.seed, "trial": episode.loop.first_trial, "time": episode.time,
            "state": episode.states[0], "clearance": float(episode.clearance[0]),
        }  # fmt: skip
        if episode.ended[0]:
            info |= {"outcome": episode.outcomes[0], "is_success": episode.outcomes[0] == "reached"}
        return info


class Expert:
    """A controller as an agent, to imitate or to compare with.

        expert = lqrsim.gym.Expert(env)
        observation, info = env.reset(seed=0)
        observation, reward, *ended, info = env.step(expert(observation))

    For the observation (n+1,) of an `Environment` it returns the action (m,); for the observations (K, n+1) of a
    `VectorEnvironment`, the actions (K, m). At time 0 the controller starts anew.

    Args:
      env: the environment, possibly in wrappers that change neither observations nor actions.
    """

    def __init__(self, env: Any, controller: ControllerLike | None = None) -> None:
        kinds = (Environment, VectorEnvironment)
        unwrapped = check_kind("env", getattr(env, "unwrapped", env), kinds, "an environment of lqrsim.gym")
        self._law, _ = as_controller(controller, unwrapped.solution, unwrapped.task.plant.robot.dynamics)
        self._task, self._steps = unwrapped.task, unwrapped.solution.trajectory.steps
        self._run: ControllerRun | None = None

    def __call__(self, observation: npt.ArrayLike) -> Array:
        """The action for an observation. Raises InputError unless the environment can have made it."""
        size = len(self._task.plant.robot.dynamics.state_coordinates) + 1
        seen = vectors_of("observation", observation, size)
        if seen.ndim > 2 or not seen.size:
            raise InputError(f"observation: got shape {seen.shape}, want ({size},) or (K, {size})")
        rows = np.atleast_2d(seen)
        if not ((rows[:, -1] >= 0) & (rows[:, -1] <= 1)).all():
            raise InputError(f"observation: got {excerpt(rows[:, -1])} as its time, want fractions of the horizon")
        step = round(float(rows[:, -1].max()) * self._steps)
        if step == 0 or self._run is None:
            self._run = self._law.start(len(rows))
        return self._task.actions_of(self._run.control(step, rows[:, :-1])).reshape(*seen.shape[:-1], -1)


class VectorEnvironment(Resettable, VectorEnv[Array, Array, Any]):
    """K trials of one scenario at once, with the actions, observations and rewards of `Environment`.

    All begin together and have the same horizon. After its end a trial keeps its observation and flags; its rewards are
    0, and its actions have no effect. There is no automatic reset: `reset(seed=s)` begins trials 0 to K-1 of seed s,
    the next `reset()` trials K to 2K-1. Each is bit-identical to the trial in `simulate` and in an `Environment`. The
    info has arrays with an entry per trial. The other arguments are those of `Environment`.

    Args:
      num_envs: K. threads: number of MuJoCo's threads; by default one per processor.
      frames: whether `rollout()` can be drawn; it takes memory.
    """

    _prefix = ""

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012 - as in its base class

    @checked
    def __init__(
        self,
        scenario: str | Scenario,
        *,
        num_envs: Count = 1,
        solution: Solution | str | os.PathLike[str] | None = None,
        disturbances: Disturbances = (),
        strength: float = 1.0,
        actions: Actions = "normalized",
        threads: int | None = None,
        frames: bool = False,
    ) -> None:
        self.num_envs = num_envs
        self.task = Task(scenario, solution, disturbances, strength, actions)
        self.single_action_space = self.task.action_space()
        self.single_observation_space = self.task.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._trials, self._frames, self._threads = num_envs, frames, threads

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes. Raises InputError for more than one seed, or an invalid option."""
        if isinstance(seed, Sequence) and not isinstance(seed, str):
            raise InputError(f"seed: got {len(seed)} seeds, want one: the episodes are its trials 0, 1, 2, ...")
        seed, options = None if seed is None else check_seed("seed", seed), reset_options(options)
        mask = options.pop("reset_mask", None)
        if mask is not None and not shaped("options: reset_mask", mask, (self.num_envs,)).all():
            raise InputError("options: reset_mask: got a part of the episodes, want all: they begin together")
        super().reset(seed=seed)
        episode = self._begin(seed, self.np_random, options)
        return episode.observations, self._info(episode)

    def step(self, actions: npt.ArrayLike) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """Run one control period of all episodes that have not ended."""
        episode = self._current()
        if episode.ended.all():
            raise InputError("step: all episodes have ended, call reset() first")
        return *episode.advance(self.task.controls_of(actions, self.num_envs)), self._info(episode)

    def render(self) -> NoReturn:
        """Raises InputError: a batch has no pictures of its own; `lqrsim.render` draws its rollout."""
        raise InputError("render: got a batch, want an Environment; or frames=True and lqrsim.render(rollout(), path)")

    def _info(self, episode: Episode) -> dict[str, Any]:
        numbers = episode.loop.first_trial + np.arange(self.num_envs)
        return {
            "seed": episode.loop.seed, "trial": numbers, "time": episode.time, "state": episode.states,
            "clearance": episode.clearance, "outcome": episode.outcomes.copy(),
            "is_success": episode.outcomes == "reached",
        }  # fmt: skip

"""A scenario as an environment of Gymnasium."""

import os
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_name, check_seed
from lqrsim.gym.episode import Episode, Resettable
from lqrsim.gym.task import Actions, Disturbances, Task
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.view.picture import LivePicture

RENDER_MODES = ("rgb_array",)


class Environment(Resettable, gymnasium.Env[Any, Any]):
    """The closed loop of `simulate` with an agent instead of the policy.

    An observation is the measured state, (n,), angles in the representative nearest the plan, followed by the time as a
    share of the horizon. An action is a control; it is clipped to the limits, as in `simulate`. The reward is minus the
    stage cost of the scenario's problem, for the true state and the applied control; the last one includes minus the
    final cost. An episode is truncated at the horizon, and terminates with a collision or an unstable simulation.

    Episodes are trials: `reset(seed=s)` begins trial 0 of seed s, each following `reset()` the next one. Each is
    bit-identical to that trial in `simulate` with the same commands.

    Options of `reset`, for that episode only: `disturbances` and `strength` as below; `preset`, a name as in
    `lqrsim.disturbances.preset`; `trial`, its number. The info has `seed`, `trial`, `time` in s, the true `state` (n,)
    and the `clearance` in m; at the end also `outcome`, as in `Rollout.outcome`, and `is_success`.

    Args:
      scenario: a reference as on the command line, such as "quadrotor,query=3", or a Scenario.
      solution: a Solution, or the path of one. Its plan gives the first state, the duration and the reference of
        disturbances. By default the scenario's problem is solved at the first `reset`.
      disturbances: a name as in `lqrsim simulate --disturbances`, or a tuple of names and disturbances. strength:
        factor by which they are scaled.
      actions: "normalized": from -1 to 1, between the limits of each control; "controls": the controls themselves in
        their units, within their limits.
      render_mode: None or "rgb_array". camera, size: of its pictures; any camera of `render` except "chase".

    Attributes:
      task: the scenario and its plant. solution: with the plan.

    Raises:
      InputError: there is no such scenario, disturbance, camera or mode; or a control has no limits.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as in its base class
        "render_modes": list(RENDER_MODES),
        "render_fps": 30,
    }

    def __init__(
        self,
        scenario: str | Scenario,
        *,
        solution: Solution | str | os.PathLike[str] | None = None,
        disturbances: Disturbances = (),
        strength: float = 1.0,
        actions: Actions = "normalized",
        render_mode: str | None = None,
        camera: str = "overview",
        size: tuple[int, int] = (640, 360),
    ) -> None:
        self.task = Task(scenario, solution, disturbances, strength, actions)
        if render_mode is not None:
            check_name("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self._picture = LivePicture(camera, size)
        self.action_space, self.observation_space = self.task.action_space(), self.task.observation_space()
        fps = max(round(1 / self.task.scenario.problem.dt), 1)
        self.metadata = {**type(self).metadata, "render_fps": fps}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see the class. Raises InputError for an invalid seed or option."""
        seed = None if seed is None else check_seed("seed", seed)
        super().reset(seed=seed)
        episode = self._begin(seed, self.np_random, options, 1, frames=True, threads=1)
        return episode.observations[0], self._info(episode)

    def step(self, action: npt.ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Run one control period.

        Raises:
          InputError: the action is not finite, or not (m,); or no episode is running.
        """
        episode = self._current()
        if episode.ended[0]:
            raise InputError("step: the episode has ended, call reset() first")
        moment = episode.advance(self.task.controls_of([action], 1))
        ended = bool(moment.terminated[0]), bool(moment.truncated[0])
        return moment.observations[0], float(moment.rewards[0]), *ended, self._info(episode)

    def render(self) -> npt.NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A picture of the current state, (height, width, 3); None without a render_mode.

        Raises:
          InputError: there is no OpenGL, or no such camera.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        episode = self._current()
        return self._picture.draw(episode.rollout, episode.frames[0], episode.time)

    def close(self) -> None:
        """Free the resources of pictures."""
        self._picture.close()

    def _info(self, episode: Episode) -> dict[str, Any]:
        info: dict[str, Any] = {
            "seed": episode.trials.seed, "trial": episode.trials.first, "time": episode.time,
            "state": episode.states[0], "clearance": float(episode.clearance[0]),
        }  # fmt: skip
        if episode.ended[0]:
            info |= {"outcome": episode.outcomes[0], "is_success": episode.outcomes[0] == "reached"}
        return info

"""One scenario as an environment of Gymnasium."""

import os
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_name, check_seed
from lqrsim.gym.episode import Episode
from lqrsim.gym.task import Actions, Disturbances, Task
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.view.picture import LivePicture

RENDER_MODES = ("rgb_array",)


class Environment(gymnasium.Env[Any, Any]):
    """The closed loop of `simulate` with an agent in place of the policy.

    An observation is the state that is measured, (n,), angles in the representative nearest the plan, followed by the
    time as a share of the horizon. An action is a control, and what is beyond the limits is cut off there, as in
    `simulate`. The reward is minus the stage cost of the scenario's problem, of the true state and of what the
    actuators got; with the last one comes minus the final cost. An episode is truncated at the horizon, and terminates
    with a collision or where the simulation becomes unstable.

    Episodes are trials: `reset(seed=s)` begins trial 0 of seed s, each `reset()` after it the next one. Each is the
    same to the last bit as that trial in `simulate`, if the same controls are commanded.

    Options of `reset`, for that episode alone: `disturbances` and `strength` as below; `preset`, a name as in
    `lqrsim.disturbances.preset`; `trial`, its number. The info that comes with an observation has `seed`, `trial`,
    `time` in s, the true `state` (n,) and the `clearance` in m; with the last one `outcome`, as in `Rollout.outcome`,
    and `is_success`.

    Args:
      scenario: a reference as on the command line, such as "quadrotor,query=3", or a Scenario.
      solution: whose plan says where to begin, how long, and what disturbances refer to; or the path of one. By
        default the scenario's problem is solved with the first `reset`.
      disturbances: what goes wrong: a name as in `lqrsim simulate --disturbances`, or a tuple of names and
        disturbances. strength: what they are multiplied by.
      actions: "normalized": from -1 to 1, between the limits of each control; "controls": the controls themselves in
        their units, within their limits.
      render_mode: None or "rgb_array". camera, size: of its pictures; any camera of `render` but "chase".

    Attributes:
      task: the scenario and its plant. solution: the plan's.

    Raises:
      InputError: no such scenario, disturbance, camera or mode; or a control without limits.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as its base class has it
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
        self._seed: int | None = None
        self._following = 0
        self._episode: Episode | None = None

    @property
    def solution(self) -> Solution:
        """The one whose plan it is."""
        return self.task.solution

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see the class. Raises InputError for a seed or an option that is wrong."""
        seed = None if seed is None else check_seed("seed", seed)
        super().reset(seed=seed)
        if seed is not None:
            self._seed, self._following = seed, 0
        elif self._seed is None:
            self._seed = int(self.np_random.integers(2**63))
        assert self._seed is not None
        trials = self.task.trials(self._seed, self._following, options)
        self._episode = Episode(self.task, trials, 1, frames=True, threads=1)
        self._following = trials.first + 1
        return self._episode.observations[0], self._info(self._episode)

    def step(self, action: npt.ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period.

        Raises:
          InputError: the action is not finite, or not (m,); or no episode goes on.
        """
        episode = self._begun()
        if episode.ended[0]:
            raise InputError("step: got an episode that has ended, want reset() first")
        moment = episode.advance(self.task.controls_of([action], 1))
        ended = bool(moment.terminated[0]), bool(moment.truncated[0])
        return moment.observations[0], float(moment.rewards[0]), *ended, self._info(episode)

    def render(self) -> npt.NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The picture (height, width, 3) now; None without a render_mode.

        Raises:
          InputError: there is no OpenGL, or no such camera.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        episode = self._begun()
        return self._picture.draw(episode.rollout, episode.frames[0], episode.time)

    def rollout(self) -> Rollout:
        """The episode so far, as `simulate` records it, for `render`, `outcomes` and `save`."""
        return self._begun().rollout()

    def close(self) -> None:
        """Free what pictures need."""
        self._picture.close()

    def _begun(self) -> Episode:
        if self._episode is None:
            raise InputError("environment: got one without an episode, want reset() first")
        return self._episode

    def _info(self, episode: Episode) -> dict[str, Any]:
        info: dict[str, Any] = {
            "seed": episode.trials.seed, "trial": episode.trials.first, "time": episode.time,
            "state": episode.states[0], "clearance": float(episode.clearance[0]),
        }  # fmt: skip
        if episode.ended[0]:
            info |= {"outcome": episode.outcomes[0], "is_success": episode.outcomes[0] == "reached"}
        return info

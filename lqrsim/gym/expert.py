"""Controllers as agents."""

from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.control.controllers import ControllerLike, ControllerRun, as_controller
from lqrsim.errors import Array, InputError, check_kind, excerpt, vectors_of
from lqrsim.gym.environment import Environment
from lqrsim.gym.vector import VectorEnvironment


class Expert:
    """A controller as an agent, to imitate or to compare with.

        expert = lqrsim.gym.Expert(env)
        observation, info = env.reset(seed=0)
        observation, reward, *ended, info = env.step(expert(observation))

    Called with the observation (n+1,) of an `Environment`, or those (K, n+1) of a `VectorEnvironment`, it returns the
    action (m,), or the actions (K, m). At time 0 the controller starts anew.

    Args:
      env: the environment, possibly in wrappers that change neither observations nor actions.
      controller: as in `simulate`; by default the policy of the environment's solution.

    Raises:
      InputError: the environment is not one of lqrsim's, or the controller is invalid.
    """

    def __init__(self, env: Any, controller: ControllerLike | None = None) -> None:
        kinds = (Environment, VectorEnvironment)
        made = check_kind("env", getattr(env, "unwrapped", env), kinds, "an environment of lqrsim.gym")
        self._law, _ = as_controller(controller, made.solution, made.task.plant.robot.dynamics)
        self._task, self._steps = made.task, made.solution.trajectory.steps
        self._run: ControllerRun | None = None

    def __call__(self, observation: npt.ArrayLike) -> Array:
        """The action for an observation. Raises InputError unless it is one of the environment's."""
        size = len(self._task.plant.robot.dynamics.state_coordinates) + 1
        seen = vectors_of("observation", observation, size)
        rows = np.atleast_2d(seen)
        if not ((rows[:, -1] >= 0) & (rows[:, -1] <= 1)).all():
            raise InputError(f"observation: got {excerpt(rows[:, -1])} for the time, want a share of the horizon")
        step = round(float(rows[:, -1].max()) * self._steps)
        if step == 0 or self._run is None:
            self._run = self._law.start(len(rows))
        return self._task.actions_of(self._run.control(step, rows[:, :-1])).reshape(*seen.shape[:-1], -1)

"""The task of an environment: scenario, plan, disturbances, and the meaning of actions and observations."""

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from lqrsim.errors import (
    Array,
    InputError,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_seed,
    excerpt,
    shaped,
)
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set, resolve
from lqrsim.scenarios.solutions import given, remarks, solve
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.compiled import CostsByStep

_log = logging.getLogger("lqrsim")

Actions = Literal["normalized", "controls"]
Disturbances = str | Sequence[str | Disturbance]

LARGEST = 1e10  # MuJoCo's mjMAXVAL: a simulation with larger numbers counts as unstable
ACTIONS = ("normalized", "controls")
RESET_OPTIONS = ("disturbances", "preset", "strength", "trial")


@dataclass(frozen=True, kw_only=True)
class EpisodeTrials:
    """The trials of an episode: number `first` of a seed and those after it, with their disturbances."""

    seed: int
    first: int
    disturbances: tuple[Disturbance, ...]


class Task:
    """The task of an environment. The arguments are those of `Environment`.

    Attributes:
      scenario, plant: robot and problem of the episodes. low, high: limits of the controls, (m,) each.

    Raises:
      InputError: as `Environment` does.
    """

    def __init__(
        self,
        scenario: str | Scenario,
        solution: Solution | str | os.PathLike[str] | None,
        disturbances: Disturbances,
        strength: float,
        actions: Actions,
    ) -> None:
        if not isinstance(scenario, Scenario):
            kinds = "a Scenario, or a reference to one, such as 'quadrotor,query=3'"
            scenario = resolve(check_kind("scenario", scenario, str, kinds))
        self.scenario, self.plant = scenario, _plant_of(scenario)
        check_name("actions", actions, ACTIONS)
        self._actions = actions
        self._given = None if solution is None else given(self.scenario, solution)
        for remark in [] if self._given is None else remarks(self.scenario, self._given):
            _log.warning("the given solution %s", remark)
        space = self.plant.robot.dynamics.control_coordinates
        self.low, self.high = np.array(space.low), np.array(space.high)
        for name, low, high in zip(space.names, space.low, space.high, strict=True):
            if not np.isfinite(high - low):
                raise InputError(
                    f"scenario: got control {name} within {low:g} to {high:g}, want finite limits, for the actions"
                )
        self._disturbances = self.disturbances_of(disturbances, strength)

    @cached_property
    def solution(self) -> Solution:
        """The given solution, or that of `smooth` for the scenario."""
        return solve(self.scenario) if self._given is None else self._given

    @cached_property
    def costs(self) -> CostsByStep:
        """The costs of the scenario's problem."""
        problem, plan = self.scenario.problem, self.solution.trajectory
        if (problem.steps, problem.dt) != (plan.steps, plan.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} of {problem.dt:g} s"
            raise InputError(f"solution: got a plan of {got}, want {want}, as in the scenario's problem")
        return CostsByStep(problem)

    def action_space(self) -> Box:
        """The action space of one environment, (m,)."""
        if self._actions == "controls":
            return Box(self.low, self.high, dtype=np.float64)
        return Box(-1.0, 1.0, self.low.shape, dtype=np.float64)

    def observation_space(self) -> Box:
        """The observation space of one environment, (n + 1,)."""
        most = np.full(len(self.plant.robot.dynamics.state_coordinates), LARGEST)
        return Box(np.append(-most, 0.0), np.append(most, 1.0), dtype=np.float64)

    def controls_of(self, actions: Any, trials: int) -> Array:
        """Convert actions (K, m) to controls (K, m). Raises InputError unless they are finite and have this shape."""
        actions = shaped("action", actions, (trials, len(self.low)))
        if not np.isfinite(actions).all():
            raise InputError(f"action: got {excerpt(actions)}, want finite numbers")
        if self._actions == "controls":
            return actions
        return self.low + (actions + 1) / 2 * (self.high - self.low)

    def actions_of(self, controls: Array) -> Array:
        """Convert controls (..., m) to actions (..., m)."""
        if self._actions == "controls":
            return controls
        return np.clip(2 * (controls - self.low) / (self.high - self.low) - 1, -1.0, 1.0)

    def disturbances_of(self, given: Any, strength: Any) -> tuple[Disturbance, ...]:
        """Scaled disturbances, given by name or as objects. Raises InputError for anything else."""
        wanted = "a name, such as 'moderate', or a tuple of names and disturbances"
        strength = check_number("strength", strength, at_least=0.0)
        items = (given,) if isinstance(given, str) else check_items("disturbances", given, (str, Disturbance), wanted)
        found: list[Disturbance] = []
        for one in items:
            found += disturbance_set(one, self.scenario) if isinstance(one, str) else (one,)
        return tuple(found if strength == 1 else [one.scaled(strength) for one in found])

    def trials(self, seed: int, following: int, options: Any) -> EpisodeTrials:
        """The trials for the options of a `reset`; by default they begin with number `following`.

        Raises:
          InputError: an option is unknown or invalid.
        """
        given = reset_options(options)
        for name in given:
            check_name("options", name, RESET_OPTIONS)
        first = check_seed("options: trial", given.get("trial", following))
        if "preset" in given and "disturbances" in given:
            raise InputError("options: got disturbances and preset, want one of the two")
        if "preset" not in given and "disturbances" not in given:
            if "strength" in given:
                raise InputError("options: got strength alone, want it with disturbances or preset")
            return EpisodeTrials(seed=seed, first=first, disturbances=self._disturbances)
        disturbances = given.get("disturbances", given.get("preset"))
        disturbances = self.disturbances_of(disturbances, given.get("strength", 1.0))
        return EpisodeTrials(seed=seed, first=first, disturbances=disturbances)


def reset_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a `reset`. Raises InputError unless they are a mapping or None."""
    return dict(check_kind("options", options, (Mapping, type(None)), "options by name, or None") or {})


def _plant_of(scenario: Scenario) -> Plant:
    """The scenario's plant. Raises InputError if its problem has other states."""
    plant = scenario.plant()
    robot, problem = plant.robot.dynamics.state_coordinates, scenario.problem.dynamics.state_coordinates
    if robot.names != problem.names:
        raise InputError(f"scenario: got a problem of states {', '.join(problem.names)}, want {', '.join(robot.names)}")
    return plant


Flags = npt.NDArray[np.bool_]

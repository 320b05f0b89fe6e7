"""What an environment is about: the scenario, its plan, what disturbs it, and what actions and observations mean."""

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

LARGEST = 1e10  # MuJoCo's mjMAXVAL: it calls a simulation unstable whose numbers are beyond it
ACTIONS = ("normalized", "controls")
RESET_OPTIONS = ("disturbances", "preset", "strength", "trial")


@dataclass(frozen=True, kw_only=True)
class EpisodeTrials:
    """Which trials an episode runs: `first` and those after it, of a seed, under these disturbances."""

    seed: int
    first: int
    disturbances: tuple[Disturbance, ...]


class Task:
    """A scenario as environments have it. The arguments are those of `Environment`.

    Attributes:
      scenario, plant: what is run. low, high: limits of the controls, (m,).

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
                    f"scenario: got control {name} within {low:g} to {high:g}, want finite limits, which bound actions"
                )
        self._disturbances = self.disturbances_of(disturbances, strength)

    @cached_property
    def solution(self) -> Solution:
        """The plan: as given, or what `smooth` makes of the scenario."""
        return solve(self.scenario) if self._given is None else self._given

    @cached_property
    def costs(self) -> CostsByStep:
        """Of the scenario's problem."""
        problem, plan = self.scenario.problem, self.solution.trajectory
        if (problem.steps, problem.dt) != (plan.steps, plan.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} of {problem.dt:g} s"
            raise InputError(f"solution: got a plan of {got}, want {want}, as in the scenario's problem")
        return CostsByStep(problem)

    def action_space(self) -> Box:
        """Of one environment, (m,)."""
        if self._actions == "controls":
            return Box(self.low, self.high, dtype=np.float64)
        return Box(-1.0, 1.0, self.low.shape, dtype=np.float64)

    def observation_space(self) -> Box:
        """Of one environment, (n + 1,)."""
        most = np.full(len(self.plant.robot.dynamics.state_coordinates), LARGEST)
        return Box(np.append(-most, 0.0), np.append(most, 1.0), dtype=np.float64)

    def controls_of(self, actions: Any, trials: int) -> Array:
        """The controls (K, m) of actions (K, m). Raises InputError unless these are finite, and so many."""
        actions = shaped("action", actions, (trials, len(self.low)))
        if not np.isfinite(actions).all():
            raise InputError(f"action: got {excerpt(actions)}, want finite numbers")
        if self._actions == "controls":
            return actions
        return self.low + (actions + 1) / 2 * (self.high - self.low)

    def actions_of(self, controls: Array) -> Array:
        """The actions (..., m) that have these controls (..., m)."""
        if self._actions == "controls":
            return controls
        return np.clip(2 * (controls - self.low) / (self.high - self.low) - 1, -1.0, 1.0)

    def disturbances_of(self, given: Any, strength: Any) -> tuple[Disturbance, ...]:
        """Disturbances by name or as they are, so many times as strong. Raises InputError for what is neither."""
        wanted = "a name, such as 'moderate', or a tuple of names and disturbances"
        strength = check_number("strength", strength, at_least=0.0)
        items = (given,) if isinstance(given, str) else check_items("disturbances", given, (str, Disturbance), wanted)
        found: list[Disturbance] = []
        for one in items:
            found += disturbance_set(one, self.scenario) if isinstance(one, str) else (one,)
        return tuple(found if strength == 1 else [one.scaled(strength) for one in found])

    def trials(self, seed: int, following: int, options: Any) -> EpisodeTrials:
        """What `reset` asks for, with `following` as the first trial where its options name none.

        Raises:
          InputError: an option is unknown, or wrong.
        """
        stated = stated_options(options)
        for name in stated:
            check_name("options", name, RESET_OPTIONS)
        first = check_seed("options: trial", stated.get("trial", following))
        if "preset" in stated and "disturbances" in stated:
            raise InputError("options: got disturbances and preset, want one of the two")
        if "preset" not in stated and "disturbances" not in stated:
            if "strength" in stated:
                raise InputError("options: got strength alone, want it with disturbances or preset")
            return EpisodeTrials(seed=seed, first=first, disturbances=self._disturbances)
        disturbances = stated.get("disturbances", stated.get("preset"))
        disturbances = self.disturbances_of(disturbances, stated.get("strength", 1.0))
        return EpisodeTrials(seed=seed, first=first, disturbances=disturbances)


def stated_options(options: Any) -> dict[str, Any]:
    """The options of a `reset`. Raises InputError for what are none."""
    return dict(check_kind("options", options, (Mapping, type(None)), "options by name, or None") or {})


def _plant_of(scenario: Scenario) -> Plant:
    """The plant. Raises InputError for a problem of another system."""
    plant = scenario.plant()
    moved, stated = plant.robot.dynamics.state_coordinates, scenario.problem.dynamics.state_coordinates
    if moved.names != stated.names:
        raise InputError(f"scenario: got a problem of states {', '.join(stated.names)}, want {', '.join(moved.names)}")
    return plant


Flags = npt.NDArray[np.bool_]

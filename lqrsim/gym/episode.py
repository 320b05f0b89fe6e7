"""Episodes of an environment: its task, and the closed loop of `simulate` one period at a time."""

import logging
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from lqrsim.annotations import checked
from lqrsim.control.controllers import Controller, ControllerRun, turn_to_nearest
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
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set, resolve
from lqrsim.scenarios.solutions import check_solution, remarks, solve
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.simulation.closed_loop import ClosedLoop
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.solvers.compiled import CostsByStep

_log = logging.getLogger("lqrsim")

Actions = Literal["normalized", "controls"]
Disturbances = str | Sequence[str | Disturbance]

LARGEST = 1e10  # MuJoCo's mjMAXVAL: a simulation with larger numbers counts as unstable
RESET_OPTIONS = ("disturbances", "preset", "strength", "trial")


class Task:
    """The task of an environment. It takes the arguments of `Environment`."""

    _prefix = ""

    @checked
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
        self.scenario, self.plant = scenario, scenario.plant()
        spaces, robot = spaces_of(scenario.problem.dynamics), self.plant.robot
        check_same_system("scenario", "a problem", spaces, spaces_of(robot.dynamics), f"robot {robot.name}")
        self._actions = actions
        self._given = None if solution is None else check_solution(self.scenario, solution)
        for remark in [] if self._given is None else remarks(self.scenario, self._given):
            _log.warning("the given solution %s", remark)
        space = self.plant.robot.dynamics.control_coordinates
        self.low, self.high = space.limits
        for name, low, high in zip(space.names, space.low, space.high, strict=True):
            if not np.isfinite(high - low):
                raise InputError(f"scenario: got control {name} within {low:g} to {high:g}, want finite limits")
        self._disturbances = self.disturbances_of(disturbances, strength)
        if strength != 1 and not self._disturbances:
            raise InputError(
                f"strength: got {strength:g} without disturbances, want it with these, or in reset's options"
            )
        if scenario.problem.duration is not None:  # the control period is part of the solution
            self.scenario = scenario.with_duration_of(self.solution)
            self.plant = self.scenario.plant()

    @cached_property
    def solution(self) -> Solution:
        """The given solution, or the solution of `smooth` for the scenario."""
        return solve(self.scenario) if self._given is None else self._given

    @cached_property
    def costs(self) -> CostsByStep:
        problem, plan = self.scenario.problem, self.solution.trajectory
        if (problem.steps, problem.dt) != (plan.steps, plan.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} of {problem.dt:g} s"
            raise InputError(f"solution: got a plan of {got}, want {want}, as in the scenario's problem")
        return CostsByStep(problem)

    def action_space(self) -> Box:
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
        if self._actions == "controls":
            return controls
        return np.clip(2 * (controls - self.low) / (self.high - self.low) - 1, -1.0, 1.0)

    def disturbances_of(self, choice: Any, strength: Any) -> tuple[Disturbance, ...]:
        """Scaled disturbances, given by name or as objects. Raises InputError for anything else."""
        wanted = "a name, such as 'moderate', or a tuple of names and disturbances"
        strength = check_number("strength", strength, at_least=0.0)
        kinds = str, Disturbance
        items = (choice,) if isinstance(choice, str) else check_items("disturbances", choice, kinds, wanted)
        disturbances: list[Disturbance] = []
        for item in items:
            disturbances += disturbance_set(item, self.scenario) if isinstance(item, str) else (item,)
        return tuple(disturbances if strength == 1 else [disturbance.scaled(strength) for disturbance in disturbances])

    def trials(self, following: int, options: Any) -> tuple[int, tuple[Disturbance, ...]]:
        """The first trial for the options of a `reset`, by default `following`, and the disturbances."""
        settings = reset_options(options)
        for name in settings:
            check_name("options", name, RESET_OPTIONS)
        first = check_seed("options: trial", settings.get("trial", following))
        if "preset" in settings and "disturbances" in settings:
            raise InputError("options: got disturbances and preset, want one of the two")
        if "preset" not in settings and "disturbances" not in settings:
            if "strength" in settings:
                raise InputError("options: got strength alone, want it with disturbances or preset")
            return first, self._disturbances
        if "preset" in settings:
            check_kind("options: preset", settings["preset"], str, "a name, as in lqrsim.disturbances.preset")
        disturbances = settings.get("disturbances", settings.get("preset"))
        return first, self.disturbances_of(disturbances, settings.get("strength", 1.0))


def reset_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a `reset`. Raises InputError unless they are a mapping or None."""
    return dict(check_kind("options", options, (Mapping, type(None)), "options by name, or None") or {})


Flags = npt.NDArray[np.bool_]


class Commanded(Controller, ControllerRun):
    """A controller, and its run, whose commands come from outside: set `commands` (K, m) before each control period."""

    def __init__(self, coordinates: tuple[Coordinates, Coordinates], trials: int) -> None:
        self._coordinates = coordinates
        self.commands: Array = np.zeros((trials, len(coordinates[1])))

    def start(self, trials: int) -> "Commanded":
        return self

    def control(self, step: int, measured: Array) -> Array:
        return self.commands

    @property
    def digest(self) -> str:
        return "commanded from outside"

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self._coordinates


class Resettable:
    """Base class of `Environment` and `VectorEnvironment`: a task, and its current episode."""

    task: Task
    _trials: int = 1  # of an episode
    _frames: bool = True
    _threads: int | None = 1
    _seed: int | None = None
    _next_trial = 0
    _episode: "Episode | None" = None

    @property
    def solution(self) -> Solution:
        return self.task.solution

    def rollout(self) -> Rollout:
        """The current episode so far, as `simulate` records it, for `render`, `outcomes` and `save`."""
        return self._current().loop.so_far()

    def _begin(self, seed: int | None, random: np.random.Generator, options: Any) -> "Episode":
        """Begin an episode: the first trials of a seed, or those after the last episode."""
        if seed is not None:
            self._seed, self._next_trial = seed, 0
        elif self._seed is None:
            self._seed = int(random.integers(2**63))
        assert self._seed is not None
        first, disturbances = self.task.trials(self._next_trial, options)
        self._episode = Episode(
            self.task, self._trials, disturbances=disturbances, seed=self._seed, first_trial=first,
            frames=self._frames, threads=self._threads,
        )  # fmt: skip
        self._next_trial = first + self._trials
        return self._episode

    def _current(self) -> "Episode":
        if self._episode is None:
            raise InputError("no episode: call reset() first")
        return self._episode


class Episode:
    """A run of K trials of a task. A trial that has ended keeps its observation, without a reward, until all have."""

    def __init__(self, task: Task, trials: int, **options: Any) -> None:
        self._commanded = Commanded(spaces_of(task.plant.robot.dynamics), trials)
        self.loop = ClosedLoop(
            plant=task.plant, plan=task.solution, controller=self._commanded, trials=trials, **options,
            **task.scenario.near_enough(),
        )  # fmt: skip
        self._costs, self._plan = task.costs, self.loop.trajectory
        self.loop.begin()
        self.ended = np.zeros(trials, dtype=bool)
        self.outcomes = np.full(trials, "", dtype=object)  # empty while an episode is running
        self._terminated, self._truncated = np.zeros((2, trials), dtype=bool)
        self._observations = self._observe()

    @property
    def observations(self) -> Array:
        """The current observations, (K, n+1)."""
        return self._observations.copy()

    @property
    def time(self) -> float:
        return self.loop.step * self._plan.dt

    @property
    def states(self) -> Array:
        """The current true states, (K, n), angles in the representative nearest the plan."""
        return self._near_plan(self.loop.states)

    @property
    def clearance(self) -> Array:
        """Current signed distance to the nearest obstacle minus the robot's radius, (K,), in metres."""
        return self.loop.collisions.clearance.copy()

    def advance(self, controls: Array) -> tuple[Array, Array, Flags, Flags]:
        """Run a control period with controls (K, m): observations (K, n+1), rewards, terminations, truncations."""
        loop, step, states = self.loop, self.loop.step, self.states
        self._commanded.commands = controls
        with unlogged():
            loop.period()
            if loop.step == self._plan.steps:
                loop.detect_contacts_at_end()
        running = ~self.ended
        lost = loop.records.over(loop.step)
        collided = np.isfinite(loop.collisions.at)
        at_horizon = loop.step == self._plan.steps
        self._terminated[running] = (lost | collided)[running]
        self._truncated[running] = at_horizon & ~(lost | collided)[running]
        rewards = np.zeros(len(running))
        rewards[running] = -self._costs.stage(step, states, loop.records.applied[:, step])[running]
        ending = (self._terminated | self._truncated) & running
        if ending.any():
            # A trial that has become unstable has no valid state; use the previous state.
            last = np.where(lost[:, None], states, self.states)
            rewards[ending] -= self._costs.final(last, loop.records.applied[:, step])[ending]
        self._observations[running] = self._observe(lost)[running]
        self.ended |= ending
        if ending.any():
            first = loop.collisions.at <= loop.records.time_of(loop.records.lost_since)
            early = np.where(collided & first, "collided", "diverged").astype(object)
            self.outcomes[ending] = (np.array(loop.so_far().outcome, dtype=object) if at_horizon else early)[ending]
        return self.observations, rewards, self._terminated.copy(), self._truncated.copy()

    def _observe(self, lost: Flags | None = None) -> Array:
        """Measured states, and time as a fraction of the horizon; for unstable trials the last valid states."""
        loop, plan = self.loop, self._plan
        seen = np.column_stack([self._near_plan(loop.measured), np.full(len(loop.measured), loop.step / plan.steps)])
        if lost is not None:
            seen[lost, :-1] = self._observations[lost, :-1]
        return seen

    def _near_plan(self, states: Array) -> Array:
        turned = np.array(states, order="C")[None]
        turn_to_nearest(self.loop.state_coordinates, turned, self._plan.states[self.loop.step][None])
        return turned[0]

"""The closed loop of `simulate`, one control period at a time, with commands from outside."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller, ControllerRun, turn_to_nearest
from lqrsim.errors import Array, InputError
from lqrsim.gym.task import EpisodeTrials, Flags, Task
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenes.scene import unlogged
from lqrsim.simulation.closed_loop import ClosedLoop
from lqrsim.simulation.run_settings import RunSettings


class Commanded(Controller):
    """A controller whose commands come from outside."""

    def __init__(self, coordinates: tuple[Coordinates, Coordinates]) -> None:
        self._coordinates = coordinates

    def start(self, trials: int) -> "CommandedRun":
        return CommandedRun(np.zeros((trials, len(self._coordinates[1]))))

    @property
    def digest(self) -> str:
        return "commanded from outside"

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self._coordinates


class CommandedRun(ControllerRun):
    """Set `commands` (K, m) before each control period."""

    def __init__(self, commands: Array) -> None:
        self.commands = commands

    def control(self, step: int, measured: Array) -> Array:
        return self.commands


@dataclass(frozen=True)
class Moment:
    """The result of a control period of K trials: observations (K, n+1), rewards and flags, (K,) each."""

    observations: Array
    rewards: Array
    terminated: Flags
    truncated: Flags


class Resettable:
    """Base class of `Environment` and `VectorEnvironment`: a task, and its current episode."""

    task: Task
    _seed: int | None = None
    _next_trial = 0
    _episode: "Episode | None" = None

    @property
    def solution(self) -> Solution:
        """The solution with the plan."""
        return self.task.solution

    def rollout(self) -> Rollout:
        """The current episode so far, as `simulate` records it, for `render`, `outcomes` and `save`."""
        return self._current().rollout()

    def _begin(
        self, seed: int | None, random: np.random.Generator, options: Any, count: int, *, frames: bool,
        threads: int | None,
    ) -> "Episode":  # fmt: skip
        """Begin an episode of `count` trials: the first ones of a seed, or those after the last episode."""
        if seed is not None:
            self._seed, self._next_trial = seed, 0
        elif self._seed is None:
            self._seed = int(random.integers(2**63))
        assert self._seed is not None
        trials = self.task.trials(self._seed, self._next_trial, options)
        self._episode = Episode(self.task, trials, count, frames=frames, threads=threads)
        self._next_trial = trials.first + count
        return self._episode

    def _current(self) -> "Episode":
        if self._episode is None:
            raise InputError("no episode: call reset() first")
        return self._episode


class Episode:
    """A run of K trials of a task. A trial that has ended keeps its observation, without a reward, until all have.

    Attributes:
      ended: (K,) whether each episode has ended. outcomes: (K,) how; empty for those still running.
    """

    def __init__(self, task: Task, trials: EpisodeTrials, count: int, *, frames: bool, threads: int | None) -> None:
        self.task, self.trials = task, trials
        dynamics = task.plant.robot.dynamics
        commanded = Commanded((dynamics.state_coordinates, dynamics.control_coordinates))
        settings = RunSettings(
            plant=task.plant, plan=task.solution, disturbances=trials.disturbances, controller=commanded,
            seed=trials.seed, trials=count, first_trial=trials.first, frames=frames, contacts=True, threads=threads,
            generators=None, progress=None, watch=None, **task.scenario.near_enough(),
        )  # fmt: skip
        self._costs, self._plan = task.costs, settings.trajectory
        self._loop = ClosedLoop(settings)
        self._loop.begin()
        self.ended = np.zeros(count, dtype=bool)
        self.outcomes = np.full(count, "", dtype=object)
        self._last, self._ended_at = self._observe(), np.zeros((2, count), dtype=bool)

    @property
    def observations(self) -> Array:
        """The current observations, (K, n+1)."""
        return self._last.copy()

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self._loop.step * self._plan.dt

    @property
    def states(self) -> Array:
        """The current true states, (K, n), angles in the representative nearest the plan."""
        return self._near_plan(self._loop.states)

    @property
    def clearance(self) -> Array:
        """Current signed distance to the nearest obstacle minus the robot's radius, (K,), in metres."""
        return self._loop.collisions.clearance.copy()

    @property
    def frames(self) -> Array:
        """MuJoCo's current qpos, (K, nq)."""
        return self._loop.physics.frame()

    def advance(self, controls: Array) -> Moment:
        """Run one control period with controls (K, m)."""
        loop, step, before = self._loop, self._loop.step, self.states
        run = self._loop.controller_run
        assert isinstance(run, CommandedRun)
        run.commands = controls
        with unlogged():
            loop.period()
            if loop.step == self._plan.steps:
                loop.detect_contacts_at_end()
        running = ~self.ended
        lost = loop.records.over(loop.step)
        collided = np.isfinite(loop.collisions.at)
        over = loop.step == self._plan.steps
        self._ended_at[0, running] = (lost | collided)[running]
        self._ended_at[1, running] = over & ~(lost | collided)[running]
        rewards = np.zeros(len(running))
        rewards[running] = -self._costs.stage(step, before, loop.records.applied[:, step])[running]
        now = self._ended_at.any(axis=0) & running
        if now.any():
            # A trial that has become unstable has no state; use the one before.
            last = np.where(lost[:, None], before, self.states)
            rewards[now] -= self._costs.final(last, loop.records.applied[:, step])[now]
        self._last[running] = self._observe(lost)[running]
        self.ended |= now
        if now.any():
            first = loop.collisions.at <= loop.records.time_of(loop.records.lost_since)
            early = np.where(collided & first, "collided", "diverged").astype(object)
            self.outcomes[now] = (np.array(self.rollout().outcome, dtype=object) if over else early)[now]
        return Moment(self.observations, rewards, *self._ended_at.copy())

    def rollout(self) -> Rollout:
        """The records so far, as `simulate` has them; NaN after now."""
        return self._loop.so_far()

    def _observe(self, lost: Flags | None = None) -> Array:
        """Measured states and time as a share of the horizon; the last valid ones of unstable trials."""
        loop, plan = self._loop, self._plan
        seen = np.column_stack([self._near_plan(loop.measured), np.full(len(loop.measured), loop.step / plan.steps)])
        if lost is not None:
            seen[lost, :-1] = self._last[lost, :-1]
        return seen

    def _near_plan(self, states: Array) -> Array:
        near = np.array(states, order="C")[None]
        turn_to_nearest(self._loop.settings.states, near, self._plan.states[self._loop.step][None])
        return near[0]

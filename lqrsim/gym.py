"""Scenarios as Gymnasium environments, one or many at once, and controllers as agents; needs the extra `gym`.

    import gymnasium
    import lqrsim.gym

    env = gymnasium.make("lqrsim/Quadrotor-v0", disturbances="moderate")
    env = lqrsim.gym.make_env("my_robot.py:hallway")

Importing this module registers lqrsim/Quadrotor-v0, lqrsim/DifferentialDrive-v0 and lqrsim/Scenario-v0. If only a name
can be given, as in a trainer's configuration, "lqrsim.gym:lqrsim/Quadrotor-v0" imports the module, too. Gymnasium
has not read entry points since version 1.0.

`write_minari` writes runs as a data set of Minari, to learn from; it needs the extra `minari`.
"""

import contextlib
import logging
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, cast

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ImportError(f"lqrsim.gym: {error}; run: pip install 'lqrsim[gym]'") from None

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from lqrsim.annotations import Count, OneOf, Seed, checked
from lqrsim.control.controllers import Controller, ControllerLike, ControllerRun, as_controller, turn_to_nearest
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_seed,
    check_text,
    excerpt,
    vectors_of,
)
from lqrsim.results.coordinates import Spaces, check_same_system, spaces_of
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set, resolve
from lqrsim.scenarios.solutions import check_solution, remarks, solve
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.simulation.closed_loop import ClosedLoop
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.solvers.compiled import CostsByStep
from lqrsim.view.picture import LivePicture

__all__ = ["Environment", "Expert", "VectorEnvironment", "make_env", "make_vec", "write_minari"]

_log = logging.getLogger("lqrsim")

SCENARIOS = {"lqrsim/Quadrotor-v0": "quadrotor", "lqrsim/DifferentialDrive-v0": "differential_drive"}
ANY_SCENARIO = "lqrsim/Scenario-v0"
RENDER_MODES = ("rgb_array",)
Actions = Literal["normalized", "controls"]
Disturbances = str | Sequence[str | Disturbance]

LARGEST = 1e10  # MuJoCo's mjMAXVAL: a simulation with larger numbers counts as unstable
RESET_OPTIONS = ("disturbances", "preset", "strength", "trial")


class Task:
    """What an environment runs: scenario, plant, solution, disturbances, and how actions become controls."""

    def __init__(
        self, scenario: str | Scenario, solution: Solution | str | os.PathLike[str] | None, disturbances: Disturbances,
        strength: float, actions: Actions,
    ) -> None:  # fmt: skip
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
        space = robot.dynamics.control_coordinates
        self.low, self.high = space.limits
        for name, low, high in zip(space.names, space.low, space.high, strict=True):
            if not np.isfinite(high - low):
                raise InputError(f"scenario: got control {name} within {low:g} to {high:g}, want finite limits")
        self._disturbances = self.disturbances_of(disturbances, strength)
        if strength != 1 and not self._disturbances:
            raise InputError(f"strength: got {strength:g} without disturbances, want it with these, or in a reset")
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
        most = np.full(len(self.plant.robot.dynamics.state_coordinates), LARGEST)
        return Box(np.append(-most, 0.0), np.append(most, 1.0), dtype=np.float64)

    def controls_of(self, actions: Any, trials: int) -> Array:
        """Convert actions (K, m) to controls (K, m). Raises InputError unless they are finite and have this shape."""
        actions = check_array("action", actions, (trials, len(self.low)))
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

    def choices_of(self, options: Any, following: int) -> tuple[int, tuple[Disturbance, ...]]:
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

    def __init__(self, coordinates: Spaces, trials: int) -> None:
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
    def coordinates(self) -> Spaces:
        return self._coordinates


class Resettable:
    """Base class of `Environment` and `VectorEnvironment`: a task, and its current episode."""

    _prefix = ""
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
        first, disturbances = self.task.choices_of(options, self._next_trial if seed is None else 0)
        if seed is None:
            seed = int(random.integers(2**63)) if self._seed is None else self._seed
        self._episode = Episode(
            self.task, self._trials, disturbances=disturbances, seed=seed, first_trial=first,
            frames=self._frames, threads=self._threads,
        )  # fmt: skip
        self._seed, self._next_trial = seed, first + self._trials  # which a refused reset leaves as they were
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
        running, at_horizon = ~self.ended, loop.step == self._plan.steps
        invalid, collided = loop.records.over(loop.step), np.isfinite(loop.collisions.at)
        over = invalid | collided
        self._terminated[running] = over[running]
        self._truncated[running] = at_horizon & ~over[running]
        ending = (self._terminated | self._truncated) & running
        # A trial that has become unstable has no valid state; its last state is the previous one.
        rewards = self._rewards(step, states, running, np.where(invalid[:, None], states, self.states), ending)
        self._observations[running] = self._observe(invalid)[running]
        self.ended |= ending
        if ending.any():
            self.outcomes[ending] = self._outcomes(collided, at_horizon)[ending]
        return self.observations, rewards, self._terminated.copy(), self._truncated.copy()

    def _rewards(self, step: int, states: Array, running: Flags, last: Array, ending: Flags) -> Array:
        """Minus the stage costs of the trials that are running, and minus the final costs of those that end."""
        rewards, applied = np.zeros(len(running)), self.loop.records.applied[:, step]
        rewards[running] = -self._costs.stage(step, states, applied)[running]
        if ending.any():
            rewards[ending] -= self._costs.final(last, applied)[ending]
        return rewards

    def _outcomes(self, collided: Flags, at_horizon: bool) -> npt.NDArray[np.object_]:
        loop = self.loop
        if at_horizon:
            return np.array(loop.so_far().outcome, dtype=object)
        first = loop.collisions.at <= loop.records.time_of(loop.records.invalid_since)
        return np.where(collided & first, "collided", "diverged").astype(object)

    def _observe(self, invalid: Flags | None = None) -> Array:
        """Measured states, and time as a fraction of the horizon; for unstable trials the last valid states."""
        loop, plan = self.loop, self._plan
        seen = np.column_stack([self._near_plan(loop.measured), np.full(len(loop.measured), loop.step / plan.steps)])
        if invalid is not None:
            seen[invalid, :-1] = self._observations[invalid, :-1]
        return seen

    def _near_plan(self, states: Array) -> Array:
        turned = np.array(states, order="C")[None]
        turn_to_nearest(self.loop.state_coordinates, turned, self._plan.states[self.loop.step][None])
        return turned[0]


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

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}  # noqa: RUF012 - as in its base

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
        self.metadata = {**type(self).metadata, "render_fps": max(round(1 / self.task.scenario.problem.dt), 1)}

    @checked
    def reset(self, *, seed: Seed | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see the class."""
        before, episode = self._episode, self._begin(seed, self.np_random, options)
        super().reset(seed=seed)
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
    `VectorEnvironment`, the actions (K, m). At time 0 the controller starts anew. Observations do not say which
    measurements got lost: for a controller with a filter, a state that equals the last one did.

    Args:
      env: the environment, possibly in wrappers that change neither observations nor actions.
    """

    def __init__(self, env: Any, controller: ControllerLike | None = None) -> None:
        kinds = (Environment, VectorEnvironment)
        unwrapped = check_kind("env", getattr(env, "unwrapped", env), kinds, "an environment of lqrsim.gym")
        self._law, _ = as_controller(controller, unwrapped.solution, unwrapped.task.plant.robot.dynamics)
        self._law._check_reads_states()
        self._task, self._steps = unwrapped.task, unwrapped.solution.trajectory.steps
        self._run: ControllerRun | None = None
        self._previous: Array | None = None

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
        measured, previous = rows[:, :-1], self._previous
        if step == 0 or self._run is None:
            self._run, previous = self._law.start(len(rows)), None
        self._previous = measured.copy()
        if self._law.sees_losses and previous is not None:
            measured = np.where((measured == previous).all(axis=1, keepdims=True), np.nan, measured)
        return self._task.actions_of(self._run.control(step, measured)).reshape(*seen.shape[:-1], -1)


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
        if mask is not None and not check_array("options: reset_mask", mask, (self.num_envs,)).all():
            raise InputError("options: reset_mask: got a part of the episodes, want all: they begin together")
        episode = self._begin(seed, self.np_random, options)
        super().reset(seed=seed)
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


def make_env(scenario: str | Scenario, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment of any scenario, with Gymnasium's usual wrappers.

    Args:
      scenario: a Scenario, or a reference as on the command line: a name with settings, "quadrotor,query=3"; your own
        function, "my_robot.py:hallway"; an MJCF, "cartpole.xml,start={'pole': 3.14}".
      options: options of `Environment` and of `gymnasium.make`.
    """
    return gymnasium.make(ANY_SCENARIO, scenario=scenario, **options)


def make_vec(scenario: str | Scenario, num_envs: int, **options: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make many environments of one scenario, run by MuJoCo as one batch, with options of `VectorEnvironment`."""
    return VectorEnvironment(scenario, num_envs=num_envs, **options)


for _name, _scenario in {**SCENARIOS, ANY_SCENARIO: None}.items():
    if _name not in gymnasium.registry:
        gymnasium.register(
            _name, entry_point="lqrsim.gym:Environment", vector_entry_point="lqrsim.gym:VectorEnvironment",
            kwargs={} if _scenario is None else {"scenario": _scenario},
        )  # fmt: skip


NAME_FORM = "NAMESPACE/NAME-vVERSION, such as quadrotor/light-v0, of letters, digits, - and _"
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
        parse_dataset_id(check_text("name", name, NAME_FORM))
    except (ValueError, TypeError):  # a TypeError for a name without a version
        raise InputError(f"name: got {excerpt(name)}, want {NAME_FORM}") from None
    unwrapped = check_kind("env", getattr(env, "unwrapped", env), Environment, "an Environment of lqrsim.gym")
    task, facts, episodes = unwrapped.task, list[Any](), list[Any]()
    runs = [rollouts] if isinstance(rollouts, Rollout) else rollouts

    def buffers() -> Iterator[Any]:
        """All episodes, one at a time, for all runs together may be more than fits into memory."""
        for rollout in _runs_of(task, runs):
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
            warnings.filterwarnings("ignore", module=r"minari\.")  # of metadata that are missing, such as the author
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


def _runs_of(task: Task, rollouts: Iterable[Any]) -> Iterator[Rollout]:
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

"""Plans, laws and trials that all questions share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from paper.common import fixed
from runner import FolderSettings, Kept, at_most

import lqrsim as ls
from lqrsim.control.controllers import ControllerLike
from lqrsim.disturbances import Disturbance
from lqrsim.stress.statistics import rate

Reached = npt.NDArray[np.bool_]
PRESETS = ("light", "moderate", "severe")
KEPT = ("particles", "world_trials", "without", "hardened", "seed")  # what rows depend on
# The chance of collision that a safe plan is asked for; under severe turbulence few plans have less.
ASKED = {"light": 1e-3, "moderate": 1e-2, "severe": 0.2}


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    trials: int = 100
    """Of each query, preset and policy."""
    queries: int = 20
    """Of the quadrotor: a start and a goal each."""
    alone: int = 100
    """Trials of each strength of one disturbance alone."""
    plans: int = 10
    """Whose predicted chance of collision is held against splitting."""
    particles: int = 300
    """Of splitting."""
    worlds: int = 100
    """Random ones, each with a safe plan."""
    world_trials: int = 1000
    """In each of them."""
    without: int = 300
    """Trials at severe of each thing that is better than it is, and with plans that know what they meet."""
    hardened: int = 1000
    """Trials of each of ten repetitions with which 'harden' measures. Ten may fail, which is the chance asked."""
    seed: int = 0
    """Of the disturbances, as in stress_test.py."""
    cases: tuple[str, ...] = ()
    """Those of 'chances' whose name has one of these in it, such as severe drive; by default all."""
    keep: Path | None = None
    """File of the plans that 'chances' and 'severe' are done with: the same command goes on there, with more plans
    too."""

    def kept(self) -> Kept:
        """What is done."""
        return Kept(self.keep, {name: getattr(self, name) for name in KEPT})

    def bounded(self) -> Self:
        """The settings, reduced by `--quick`."""
        return at_most(
            self,
            trials=5,
            queries=1,
            alone=3,
            plans=1,
            particles=20,
            worlds=1,
            world_trials=20,
            without=10,
            hardened=20,
        )


def reach_exactly(problem: ls.Problem) -> ls.Problem:
    """From exactly the wished start to exactly the wished place."""
    goal = problem.goal
    assert goal is not None
    space = problem.dynamics.state_coordinates
    place = ls.GoalState({space.names[i]: goal[i] for i in space.position})
    return replace(fixed(problem), constraints=[*problem.constraints, place])


@cache
def safe_plan(query: int, preset: str, asked: float) -> ls.types.SafePlan:
    """Of a query of the quadrotor; several sections ask for the same one."""
    scenario = ls.scenarios.quadrotor(query)
    plant = scenario.plant()
    stated = ls.uncertainty_of(plant, ls.disturbances.preset(preset, plant))
    return ls.smooth_chance_constrained(reach_exactly(scenario.problem), stated, chance=asked)


def reached(
    plant: ls.Plant, solution: ls.Solution, controller: ControllerLike | None, disturbances: Sequence[Disturbance],
    *, trials: int, seed: int, first: int = 0,
) -> Reached:  # fmt: skip
    """Which trials reach the goal."""
    rollout = run(plant, solution, controller, disturbances, trials=trials, seed=seed, first=first)
    return np.array(ls.stress.outcomes(rollout).outcome) == "reached"


def run(
    plant: ls.Plant, solution: ls.Solution, controller: ControllerLike | None, disturbances: Sequence[Disturbance],
    *, trials: int, seed: int, first: int = 0,
) -> ls.Rollout:  # fmt: skip
    """The trials."""
    return ls.simulate(
        plant, solution, controller=controller, disturbances=disturbances, trials=trials, seed=seed, first_trial=first,
        frames=False, contacts=False,
    )  # fmt: skip


def share(successes: Reached) -> list[float]:
    """The share with its exact interval, in percent."""
    one = rate(int(successes.sum()), len(successes))
    return [100 * one.value, 100 * one.low, 100 * one.high]

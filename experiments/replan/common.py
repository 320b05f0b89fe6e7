"""Problems and settings that all questions share."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from paper.common import FREE
from runner import FolderSettings, at_most

import lqrsim as ls

ROBOTS = ("quadrotor", "differential_drive")
WAYS = ("obstacle cost", "control limits", "clearance")
MARGIN = 0.02  # m, of the clearance


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    queries: int = 20
    """A start and a goal each."""
    plans: int = 10_000
    """Re-plans of each robot and kind of problem, at least."""
    trials: int = 100
    """Of each law, in the sections about outcomes."""
    deadline: float = 0.012
    """Seconds that a solve may take, in the section about times."""
    arms: tuple[Path, ...] = ()
    """MJCFs of arms, for the section about reaching; by default one of six hinges."""
    seed: int = 0
    """Of the disturbances."""

    def bounded(self) -> Self:
        """The settings, reduced by `--quick`."""
        return at_most(self, queries=1, plans=40, trials=2)


def scenario_of(robot: str, query: int) -> ls.Scenario:
    """One of 20 queries; the drive's are from and to places on the two sides of its arena."""
    if robot == "quadrotor":
        return ls.scenarios.quadrotor(query)
    scenario = ls.scenarios.differential_drive()
    if query == 0:
        return scenario
    rng = np.random.default_rng([query])
    start, goal = np.array(scenario.problem.start), np.array(scenario.problem.goal)
    start[0], goal[0] = rng.uniform(-2.0, 2.0, 2)
    weight = np.array((5000.0, 5000.0, 50.0))
    changed = replace(
        scenario.problem, initial=ls.QuadraticCost(weight, about=start), final_cost=ls.QuadraticCost(weight, about=goal)
    )
    return replace(scenario, problem=changed)


def stated(scenario: ls.Scenario, way: str) -> ls.Problem:
    """The problem with or without limits and constraints, from exactly its start."""
    problem, robot = scenario.problem, scenario.robot
    assert problem.start is not None
    problem = replace(problem, initial=ls.FixedState(problem.start))
    if way == "obstacle cost":
        return replace(problem, control_limits=FREE)
    if way == "clearance":
        kept = ls.Clearance(scenario.scene.world, radius=robot.radius, margin=MARGIN)
        return replace(problem, constraints=[kept])
    return problem

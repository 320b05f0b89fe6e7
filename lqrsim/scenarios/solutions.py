"""Solutions of scenarios: one way to solve, which begins as the scenario says."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.solvers.ilqr import ilqr
from lqrsim.solvers.initial_guess import InitialPrior, is_function, resolve
from lqrsim.solvers.smoother import smooth

SOLVERS: Mapping[str, Callable[..., Solution]] = {"smooth": smooth, "ilqr": ilqr}


def solve(scenario: Scenario, solver: str = "smooth", **options: Any) -> Solution:
    """Solve a scenario's problem from the scenario's start.

    Args:
      scenario: what to solve.
      solver: one of SOLVERS. "ilqr", which has no prior, begins with the controls of an InitialPrior.
      **options: of the solver; a `start` among them replaces the scenario's.

    Returns:
      The Solution, with the scenario's goal radius.

    Raises:
      InputError: as the solver does.
    """
    start, problem = options.pop("start", scenario.start), scenario.problem
    if solver == "ilqr":
        start = start(problem) if is_function(start) else start
        start = start.controls if isinstance(start, InitialPrior) else start
    solution = SOLVERS[solver](problem, start=start, **options)
    return replace(solution, goal_radius=scenario.target_radius())


def digest_of_start(scenario: Scenario) -> str | None:
    """Hash of everything that the scenario has its solver begin with; None where that is left to the solver."""
    return None if scenario.start is None else resolve(scenario.start, scenario.problem).digest

"""Solutions of scenarios: one way to solve, which begins as the scenario says, or with what was stored."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from lqrsim.errors import InputError
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.output_feedback import OutputFeedbackPolicy
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.save_load import load
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
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


def stored_start(scenario: Scenario, path: str | os.PathLike[str]) -> Solution | AffinePolicy | Trajectory:
    """What a file has for a solver of the scenario to begin with.

    Args:
      scenario: what is to be solved.
      path: of a solution, a policy, or a rollout or funnel, of which the plan is taken.

    Returns:
      The solution, the policy or the plan.

    Raises:
      InputError: the file holds something else, or it is of another system or of another number of steps.
    """
    found = load(path)
    if isinstance(found, OutputFeedbackPolicy):
        raise InputError(
            f"start: got {path}, a policy that needs estimates, want a solution, a policy of the state, or a rollout or"
            " a funnel, whose plan is taken"
        )
    if isinstance(found, Solution | AffinePolicy):
        policy = found if isinstance(found, AffinePolicy) else found.policy
        _check_fits("start", path, scenario, policy.state_coordinates, policy.control_coordinates, len(policy.gain))
        return found
    plan = found.plan
    _check_fits("start", path, scenario, found.state_coordinates, found.control_coordinates, plan.steps)
    return plan


def _check_fits(
    field: str, what: object, scenario: Scenario, states: Coordinates, controls: Coordinates, steps: int
) -> None:
    """Raise InputError unless these are the states, controls and number of steps of the scenario's problem."""
    problem = scenario.problem
    wanted = problem.dynamics.state_coordinates, problem.dynamics.control_coordinates
    for kind, got, want in zip(("states", "controls"), (states, controls), wanted, strict=True):
        if got.names != want.names:
            raise InputError(
                f"{field}: got {what} with the {kind} {', '.join(got.names)}, want {', '.join(want.names)}, as"
                f" {scenario.name} has them"
            )
    if steps != problem.steps:
        raise InputError(f"{field}: got {what} of {steps} steps, want {problem.steps}, as {scenario.name} has them")


def digest_of_start(scenario: Scenario) -> str | None:
    """Hash of everything that the scenario has its solver begin with; None where that is left to the solver."""
    return None if scenario.start is None else resolve(scenario.start, scenario.problem).digest

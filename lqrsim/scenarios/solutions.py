"""Solutions of scenarios: one way to solve, what was stored to begin with, and what is given in place of a solve."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lqrsim.errors import InputError, check_kind
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


def given(scenario: Scenario, solution: Solution | str | os.PathLike[str]) -> Solution:
    """A solution in place of a solve of the scenario. It need not have converged, or be of the very problem: `remarks`.

    Args:
      scenario: in which it is to run.
      solution: as it is, or the path of one.

    Returns:
      The solution, with the scenario's goal radius.

    Raises:
      InputError: it cannot be read, is of another system, number of steps, control period or goal, or its plan is not
        finite.
    """
    stored = isinstance(solution, str | os.PathLike)
    what = str(solution) if stored else "one"
    found = load(solution, Solution) if stored else solution
    check_kind("solution", found, Solution, "a Solution, or the path of one")
    law, plan, problem = found.policy, found.trajectory, scenario.problem
    _check_fits("solution", what, scenario, law.state_coordinates, law.control_coordinates, plan.steps)
    if plan.dt != problem.dt and problem.duration is None:
        raise InputError(f"solution: got {what} with a control period of {plan.dt:g} s, want {problem.dt:g} s")
    names = law.state_coordinates.names
    none = np.full(len(names), np.nan)
    goals = zip(*(none if one is None else one for one in (found.goal, problem.weighed_goal)), strict=True)
    for name, (got, want) in zip(names, goals, strict=True):
        if got != want and not (np.isnan(got) and np.isnan(want)):
            raise InputError(
                f"solution: got {what} with the goal {name} = {got:.9g}, want {want:.9g} (nan: none), as"
                f" {scenario.name} has it"
            )
    if not np.isfinite(plan.states).all():
        raise InputError(
            f"solution: got {what}, whose plan is not finite ({found.status.name}), want one that can be run"
        )
    return replace(found, goal_radius=scenario.target_radius())


def remarks(scenario: Scenario, solution: Solution) -> list[str]:
    """What is to be said of a solution that is run in a scenario, in lines; none if it is a success of its problem."""
    lines: list[str] = []
    if not solution.success:
        lines.append(f"did not converge ({solution.status.name}); its plan is run as it is")
    # A free duration is settled by the solve, in a problem of its own.
    if scenario.problem.duration is None and solution.problem_digest != scenario.problem.digest:
        solved = f" (solved as {solution.scenario})" if solution.scenario else ""
        lines.append(f"is of another problem than that of {scenario.name}{solved}; its plan is run as it is")
    return lines


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

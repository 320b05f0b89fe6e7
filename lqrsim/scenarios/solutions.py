"""Solutions of scenarios: computed, computed from a stored start, or given instead of solving."""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lqrsim.errors import InputError, check_kind
from lqrsim.machine import other_lqrsim
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.certified import FailureCertificate
from lqrsim.results.coordinates import Spaces, check_same_system, spaces_of
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.save_load import load
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenarios.packaged import Scenario
from lqrsim.solvers.settings import InitialPrior, is_function, resolve
from lqrsim.solvers.smoother import ilqr, smooth

SOLVERS: Mapping[str, Callable[..., Solution]] = {"smooth": smooth, "ilqr": ilqr}

LONGEST = 600  # characters of a description of what differs


def solve(scenario: Scenario, solver: str = "smooth", **options: Any) -> Solution:
    """Solve a scenario's problem from the scenario's start.

    Args:
      solver: one of SOLVERS. "ilqr" uses only the controls of a start that is an InitialPrior.
      **options: options of the solver; a `start` among them replaces the scenario's.
    """
    start, problem = options.pop("start", scenario.start), scenario.problem
    if solver == "ilqr":
        start = start(problem) if is_function(start) else start
        start = start.controls if isinstance(start, InitialPrior) else start
    solution = SOLVERS[solver](problem, start=start, **options)
    return replace(solution, goal_radius=scenario.target_radius(target=solution.target))


def stored_start(scenario: Scenario, path: str | os.PathLike[str]) -> Solution | AffinePolicy | Trajectory:
    """Load a start for a solve: a solution, a policy, that of a certificate, or the plan of a rollout or funnel."""
    stored = load(path)
    if isinstance(stored, FailureCertificate):
        stored = stored.solution
    if isinstance(stored, OutputFeedbackPolicy):
        wanted = "a solution, a policy of the state, a rollout or a funnel"
        raise InputError(f"start: got {path}, a policy with an estimator, want {wanted}")
    if isinstance(stored, Solution | AffinePolicy):
        policy = stored if isinstance(stored, AffinePolicy) else stored.policy
        _check_fits("start", path, scenario, spaces_of(policy), len(policy.gain))
        return stored
    plan = stored.plan
    _check_fits("start", path, scenario, spaces_of(stored), plan.steps)
    return plan


def check_solution(scenario: Scenario, solution: Solution | str | os.PathLike[str]) -> Solution:
    """Check a solution that is given instead of solving the scenario.

    The solution may not have converged, or may be of another problem; `remarks` then says so.
    """
    stored = isinstance(solution, str | os.PathLike)
    label = str(solution) if stored else "one"
    loaded = load(solution, Solution) if stored else solution
    check_kind("solution", loaded, Solution, "a Solution, or the path of one")
    law, plan, problem = loaded.policy, loaded.trajectory, scenario.problem
    _check_fits("solution", label, scenario, spaces_of(law), plan.steps)
    if plan.dt != problem.dt and problem.duration is None:
        raise InputError(f"solution: got {label} with a control period of {plan.dt:g} s, want {problem.dt:g} s")
    names = law.state_coordinates.names
    none = np.full(len(names), np.nan)
    goals = zip(*(none if goal is None else goal for goal in (loaded.goal, problem.weighed_goal)), strict=True)
    for name, (got, want) in zip(names, goals, strict=True):
        if got != want and not (np.isnan(got) and np.isnan(want)):
            wanted = f"{want:.9g} (nan: none), as {scenario.name} has it"
            raise InputError(f"solution: got {label} with the goal {name} = {got:.9g}, want {wanted}")
    if not np.isfinite(plan.states).all():
        raise InputError(f"solution: got {label}, whose plan is not finite ({loaded.status.name}), want a finite one")
    return replace(loaded, goal_radius=scenario.target_radius(target=loaded.target))


def remarks(scenario: Scenario, solution: Solution) -> list[str]:
    """Lines of warning about a solution that runs in a scenario; none if it solves the scenario's problem."""
    lines: list[str] = []
    if not solution.success:
        lines.append(f"did not converge ({solution.status.name}); its plan is run as it is")
    problem = scenario.with_duration_of(solution).problem
    if solution.problem_digest != problem.digest:
        solved = f" (solved as {solution.scenario})" if solution.scenario else ""
        other = difference(solution, problem)
        lines.append(f"is of another problem than that of {scenario.name}{solved}{other}; its plan is run as it is")
    return lines


def difference(solution: Solution, problem: Problem) -> str:
    """Which parts of a solution's problem differ from another problem's, to be put after a name; or nothing.

    Numbers that descriptions leave out, such as places of obstacles, differ without being named. Solutions of older
    files have no description.
    """
    if not solution.problem_parts:
        return ""
    pairs = {name: (solution.problem_parts.get(name, "none"), text or "none") for name, text in problem.parts.items()}
    named = [
        f"{name} {' instead of '.join(_differing(solved, stated))}"
        for name, (solved, stated) in pairs.items()
        if solved != stated
    ]
    text = "; ".join(named)
    text = text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
    if named:
        return f": {text}"
    if older := other_lqrsim(solution.versions):
        return f", or of the same: it is described alike, but {older} hashes problems otherwise; solve it again to know"
    return ", in numbers that a description of it leaves out"


def _differing(*texts: str) -> list[str]:
    """Two descriptions without the items with which both begin or end."""
    items = [re.split(r"(?<=[,;] )|(?<= \+ )", text) for text in texts]
    least = min(map(len, items)) - 1
    begin = next((i for i, (item, other) in enumerate(zip(*items, strict=False)) if item != other), least)
    begin = min(begin, least)
    back = zip(*(reversed(parts[begin + 1 :]) for parts in items), strict=False)
    end = next((i for i, (item, other) in enumerate(back) if item != other), least - begin)
    middles = ("".join(parts[begin : len(parts) - end]).strip(" ,;") for parts in items)
    return [f"{'... ' * (begin > 0)}{middle}{' ...' * (end > 0)}" for middle in middles]


def _check_fits(field: str, what: object, scenario: Scenario, spaces: Spaces, steps: int) -> None:
    """Raise InputError unless states, controls and number of steps agree with the scenario's problem."""
    problem = scenario.problem
    check_same_system(field, what, spaces, spaces_of(problem.dynamics), scenario.name)
    if steps != problem.steps:
        raise InputError(f"{field}: got {what} of {steps} steps, want {problem.steps}, as {scenario.name} has them")


def digest_of_start(scenario: Scenario) -> str | None:
    """Hash of the scenario's start; None if it has none."""
    return None if scenario.start is None else resolve(scenario.start, scenario.problem).digest


def digest_of_solution(solution: Solution) -> str:
    """Hash of everything in a solution that its runs depend on, which excludes the log of its solve."""
    plan, policy = solution.trajectory, solution.policy
    goal = np.zeros(0) if solution.goal is None else solution.goal
    arrays = [plan.states, plan.controls, policy.gain, policy.offset, policy.nominal, np.array([plan.dt]), goal]
    if solution.cost_to_go is not None:  # re-planning begins with the cost-to-go and the multipliers
        arrays += [np.asarray(part) for part in vars(solution.cost_to_go).values()]
    arrays += [multiplier.values for multiplier in solution.multipliers]
    rules = policy.state_coordinates.rules, policy.control_coordinates.rules
    return sha256(*(part for array in arrays for part in (f"{array.shape}", array)), *rules)

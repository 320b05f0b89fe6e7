"""The policies that a stress test compares, by name, with the solver and the controller of each."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lqrsim.control.controllers import BeliefFeedback, Controller
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.replanner import Replanner
from lqrsim.control.tracking import track
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import InputError, check_name
from lqrsim.problem.belief import Belief
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.scenarios import solutions as solving
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.effects import uncertainty_of

_log = logging.getLogger("lqrsim")


class PolicyKind(NamedTuple):
    """The way in which a policy is made."""

    solver: str = "smooth"
    controller: str = "feedback"
    designed: bool = False  # for disturbances that the user may choose
    per_cell: bool = False  # anew for the disturbances of each cell, at their strength


POLICY_KINDS = {
    "smooth": PolicyKind(),
    "ilqr": PolicyKind(solver="ilqr"),
    "open_loop": PolicyKind(),
    "replan": PolicyKind(controller="replan"),
    "track": PolicyKind(designed=True),  # `solve_policies` puts the tracking law into its solution
    "offset_free": PolicyKind(controller="offset_free", designed=True),
    "track_per_cell": PolicyKind(controller="track", per_cell=True),
    "offset_free_per_cell": PolicyKind(controller="offset_free", per_cell=True),
}
CAMPAIGN_POLICIES = tuple(POLICY_KINDS)
POLICIES = tuple(name for name, kind in POLICY_KINDS.items() if not kind.per_cell)  # also outside of a campaign
DESIGNED = tuple(name for name, kind in POLICY_KINDS.items() if kind.designed)
DEFAULT_POLICIES = tuple(name for name in POLICIES if name not in DESIGNED)
CONTROLLERS = ("feedback", "track", "offset_free", "replan")
DEFAULT_DESIGN = "moderate"  # the set for which policies are designed by default

Design = Sequence[Disturbance] | str | None  # disturbances, the name of a set, or None for the default


def check_designed(design: Design, policies: Sequence[str]) -> None:
    """Raise InputError if disturbances are given and none of the policies is designed for any."""
    if design is not None and not {*DESIGNED} & {*policies}:
        got = f"got them with {', '.join(policies)}"
        raise InputError(f"design_disturbances: {got}, want {' or '.join(DESIGNED)}, or leave them out")


def design_disturbances(scenario: Scenario, design: Design = None) -> Sequence[Disturbance]:
    """The disturbances for which "track" and "offset_free" are designed."""
    design = DEFAULT_DESIGN if design is None else design
    return disturbance_set(design, scenario) if isinstance(design, str) else design


def design_uncertainty(scenario: Scenario, design: Design = None) -> Uncertainty:
    """These disturbances as an Uncertainty. Raises InputError if the scenario's robot does not support one of them."""
    disturbances = design_disturbances(scenario, design)
    try:
        return uncertainty_of(scenario.plant(), disturbances)
    except InputError as error:
        raise InputError(f"design_disturbances: {error}") from None


def solve_policies(
    policies: Sequence[str], scenario: Scenario, design: Design = None, given: Solution | None = None, *,
    remark: bool = True,
) -> dict[str, Solution]:  # fmt: skip
    """The solution that each policy runs, by the policy's name.

    The policy in the solution for "track" is the tracking law, in that for "offset_free" the policy of "smooth".

    Args:
      given: a solution from `solutions.check_solution`, in place of the result of its solver.
      remark: whether to warn of plans that have not converged, or are of another problem.
    """
    check_used(given, policies)
    plans = {} if given is None else {solver_of(given): given}
    solutions: dict[str, Solution] = {}
    for policy in policies:
        solver = POLICY_KINDS[policy].solver
        if solver not in plans:
            plans[solver] = solving.solve(scenario, solver)
        solutions[policy] = plans[solver].open_loop() if policy == "open_loop" else plans[solver]
    for solver, plan in plans.items():
        if not np.isfinite(plan.trajectory.states).all():
            raise InputError(f"policies: got a plan of {solver} that is {plan.status.name}, want a finite one")
        for line in solving.remarks(scenario, plan) if remark else []:
            _log.warning("the solution of %s %s", solver, line)
    if "track" in policies:
        problem = scenario.with_duration_of(solutions["track"]).problem
        law = track(problem, solutions["track"], uncertainty=design_uncertainty(scenario, design))
        solutions["track"] = replace(solutions["track"], policy=law)
    return solutions


def solver_of(solution: Solution) -> str:
    """The solver whose result a given solution replaces."""
    return "ilqr" if solution.solver == "ilqr" else "smooth"


def check_used(given: Solution | None, policies: Sequence[str]) -> None:
    """Raise InputError if a solution is given and none of the policies uses it."""
    if given is None:
        return
    users = [policy for policy, kind in POLICY_KINDS.items() if kind.solver == solver_of(given)]
    if not {*users} & {*policies}:
        got = f"a solution of {given.solver} with {', '.join(policies)}"
        raise InputError(f"solution: got {got}, want it with {', '.join(users)}")


def impossible_policies(scenario: Scenario, given: Solution | None = None) -> dict[str, str]:
    """The policies that cannot run in the scenario with the given solution, if any, each with the reason."""
    impossible: dict[str, str] = {}
    if scenario.problem.constraints:
        impossible["ilqr"] = "which cannot keep the scenario's constraints"
    elif scenario.problem.duration is not None:
        impossible["ilqr"] = "which cannot find the scenario's free duration"
    if isinstance(scenario.problem.dynamics, Belief):
        others = (name for name, kind in POLICY_KINDS.items() if kind.controller != "feedback" or kind.designed)
        impossible |= dict.fromkeys(others, "which is of states, while the scenario is planned in belief space")
    if given is not None and solver_of(given) == POLICY_KINDS["replan"].solver:
        stated = scenario.with_duration_of(given).problem
        if given.problem_digest != stated.digest:
            other = f"another problem{solving.difference(given, stated)}"
            impossible["replan"] = f"which re-plans the scenario's problem, while the solution is of {other}"
    return impossible


def make_controller(
    name: str, scenario: Scenario, solution: Solution, *, design: Design = None, replan_every: float | None = None
) -> Controller | AffinePolicy:
    """A controller for a solution of the scenario.

    Args:
      name: one of CONTROLLERS. "feedback" is the solution's policy, in belief space with its filter; "track" and
        "offset_free" are `lqrsim.track` and `lqrsim.OffsetFree` for its plan; "replan" re-plans during the run.
      replan_every: seconds between two solves of "replan"; by default a tenth of the horizon.
    """
    problem = scenario.with_duration_of(solution).problem
    if isinstance(problem.dynamics, Belief):
        if name != "feedback":
            raise InputError(f"controller: got {name} for a plan in belief space, want feedback")
        return BeliefFeedback(problem, solution)
    match check_name("controller", name, CONTROLLERS):
        case "track":
            return track(problem, solution, uncertainty=design_uncertainty(scenario, design))
        case "offset_free":
            read = scenario.plant().sensors(scenario.sensors) if scenario.sensors else None
            return OffsetFree(problem, solution, design_uncertainty(scenario, design), sensors=read)
        case "replan":
            if solution.problem_digest != problem.digest:
                other = solving.difference(solution, problem)
                got = f"replan for a solution of another problem than that of {scenario.name}{other}"
                raise InputError(f"controller: got {got}; want one of its own, or {', '.join(CONTROLLERS[:-1])}")
            every = max(problem.dt, problem.steps * problem.dt / 10) if replan_every is None else replan_every
            return Replanner(problem, solution, every=every, deadline=0.0)
    return solution.policy

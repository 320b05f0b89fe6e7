"""Solves of problems with a `control_rate`: with the last command as a state, which the answer does not have.

The best feedback of such a problem also depends on the last command. Without its part of the gains, what is left may
not even be stable: when changes are dear, it moves a control by little at a time and relies on the sum. So the policy
of the answer is that of another problem, which has the same optimum. There the rates' cost gives way to a quadratic
that is nowhere below it and touches it at the plan: with D the deviations from the plan,

    1/2 w (D_t - D_{t-1})^2 <= w D_t^2 + w D_{t-1}^2.

So each control is charged for the changes before and after it, whatever the controls beside it do.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from lqrsim.annotations import checked
from lqrsim.errors import Array, InputError
from lqrsim.kernels.records import Motion
from lqrsim.problem.control_rate import with_last_command
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import ControlCost
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.solution import Replan, Solution
from lqrsim.results.solution_parts import Multipliers, Quadratic, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of, parts_of
from lqrsim.solvers.budget import Budget
from lqrsim.solvers.engine import SolveRun
from lqrsim.solvers.settings import InitialGuess, InitialPrior, Settings, SmootherSettings, resolve

P = TypeVar("P", Solution, Replan)
S = TypeVar("S", bound=Settings)


def solve_with_rates(problem: Problem, settings: S, solve: Callable[[Problem, S], Solution]) -> Solution:
    """Solve a problem with a `control_rate`; `solve` is for problems without."""
    wide = with_last_command(problem)
    guess = None if settings.start is None else widened(resolve(settings.start, problem), problem, wide)
    solution = solve(wide, replace(settings, start=guess))
    policy, cost_to_go = feedback(problem, solution.trajectory, solution.multipliers)
    states = solution.trajectory.states[:, : len(problem.dynamics.state_coordinates)]
    return narrowed(
        solution, problem, policy, cost_to_go,
        inverse_policy=None, cost_to_come=None, clearance=clearance_of(problem, states),
        candidates=tuple(
            replace(candidate, trajectory=_narrow(candidate.trajectory, problem)) for candidate in solution.candidates
        ),
        problem_digest=problem.digest, problem_parts=parts_of(problem),
    )  # fmt: skip


def narrowed(plan: P, problem: Problem, policy: AffinePolicy, cost_to_go: Quadratic | None, **others: Any) -> P:
    """The plan without the last command, with another policy; and with `others`, of a solution."""
    n, count = len(problem.dynamics.state_coordinates), len(problem.constraints)
    return replace(
        plan, trajectory=_narrow(plan.trajectory, problem), policy=policy, cost_to_go=cost_to_go,
        multipliers=plan.multipliers[:count], goal=None if plan.goal is None else plan.goal[:n], **others,
    )  # fmt: skip


def _narrow(plan: Trajectory, problem: Problem) -> Trajectory:
    return replace(plan, states=plan.states[:, : len(problem.dynamics.state_coordinates)].copy())


def feedback(
    problem: Problem, plan: Trajectory, multipliers: tuple[Multipliers, ...] = ()
) -> tuple[AffinePolicy, Quadratic | None]:
    """A policy about a plan that has the last command, if possible with feedback, and its cost-to-go: those of the
    problem with the quadratic in place of the rates' cost.
    """
    states, controls = _narrow(plan, problem).states, plan.controls
    gain, cost_to_go = np.zeros((*controls.shape, states.shape[1])), None
    if plan.finite:
        stage = problem.stage_cost + bounding_cost(problem, controls)
        other = problem._with(control_rate=None, **problem._bound(stage_cost=stage))
        gain, cost_to_go = _gains(other, states, controls, multipliers[: len(problem.constraints)])
    policy = compiled.policy_about(states, controls, gain)
    return compiled.policy_of(problem, *policy, states[:-1].copy()), cost_to_go


def _gains(
    problem: Problem, states: Array, controls: Array, multipliers: tuple[Multipliers, ...]
) -> tuple[Array, Quadratic | None]:
    """Gains (T, m, n) about a finite plan, and the cost-to-go; zeros and None if there are none."""
    gain, cost_to_go = np.zeros((*controls.shape, states.shape[1])), None
    guess = InitialGuess(gain, controls, multipliers=multipliers)
    run = SolveRun(problem, SmootherSettings(), guess, states[0].copy(), Budget(1))
    run.work.set_best(Motion(states, controls), compiled.cost_of(problem, states, controls))
    with problem.dynamics.quiet():
        if np.isfinite(run.linearize_about_plan()):
            gain = run.work.arrays.policy.gain.copy()
            cost_to_go = deepcopy(Quadratic(*run.work.arrays.to_go))
    run.give_back()
    return gain, cost_to_go


@checked
def rate_feedback(problem: Problem, solution: Solution) -> OutputFeedbackPolicy:
    """The best feedback about a plan for a problem with a `control_rate`, which remembers the last command.

        rollout = ls.simulate(plant, solution, controller=ls.lq.rate_feedback(problem, solution))

    The solution's own policy has no memory, so it has to charge each control for all changes that it may lead to. This
    one moves a control by little at a time and goes on from there. It measures all states, and like other output
    feedback it can be simulated, saved and exported to C. It minimises the cost of rates; limits of rates it does not
    know.

    Args:
      problem: the problem, with a weight on rates.

    Raises:
      InputError: the problem has no such weight, the solution is of another problem, or there is no feedback about its
        plan.
    """
    rate = problem.control_rate
    if rate is None or rate.weight is None:
        raise InputError(f"problem: got control_rate={rate!r}, want one with a weight")
    if solution.problem_digest != problem.digest:
        raise InputError("solution: got that of another problem, want that of this one")
    wide, plan, n = with_last_command(problem), solution.trajectory, len(problem.dynamics.state_coordinates)
    states = with_commands(plan).states
    if rate.previous is not None:
        states[0, n:] = np.asarray(rate.previous)
    multipliers = widened(resolve(solution, problem), problem, wide).multipliers
    gain, cost_to_go = _gains(wide, states, plan.controls, multipliers) if plan.finite else (np.zeros(0), None)
    if cost_to_go is None:
        raise InputError(f"solution: got a plan without feedback ({solution.status.name}), want one that converged")
    steps, m = plan.controls.shape
    pairs = zip(plan.states[:-1], plan.controls, strict=True)
    linearizations = [problem.dynamics.linearize(x, u, plan.dt) for x, u in pairs]
    A, B, c = (np.array(matrices) for matrices in zip(*linearizations, strict=True))
    gain, offset = compiled.policy_about(states, plan.controls, gain)
    onto = np.eye(n + m, n)
    return OutputFeedbackPolicy(
        gain=gain, offset=offset, correction=np.tile(onto, (steps, 1, 1)), sensor=np.tile(np.eye(n), (steps, 1, 1)),
        sensor_offset=np.zeros((steps, n)), transition=onto @ A @ onto.T,
        input=np.concatenate([B, np.tile(np.eye(m), (steps, 1, 1))], axis=1), drift=np.pad(c, [(0, 0), (0, m)]),
        nominal=states[:-1], dt=plan.dt, state_coordinates=problem.dynamics.state_coordinates,
        control_coordinates=problem.applied_coordinates, measured_coordinates=problem.dynamics.state_coordinates,
    )  # fmt: skip


def bounding_cost(problem: Problem, controls: Array) -> ControlCost:
    """The least quadratic, separate for each step, that is above the cost of rates and touches it at controls (T, m).

    It has the slope of the rates' cost there, but not its value.
    """
    rate, (steps, m) = problem.control_rate, controls.shape
    assert rate is not None
    weight = np.zeros(m) if rate.weight is None else np.asarray(rate.weight) / problem.dt**2
    changes, known = np.diff(controls, axis=0), rate.previous is not None
    slope, count = np.zeros((steps, m)), np.zeros(steps)  # in units of the weight
    slope[1:] += changes
    slope[:-1] -= changes
    count[1:] += 2
    count[:-1] += 2
    if known:
        slope[0] += controls[0] - np.asarray(rate.previous)
        count[0] += 1  # for the last command does not deviate
    about = controls - slope / np.maximum(count, 1)[:, None]
    matrices = count[:, None, None] * np.diag(weight)
    # No weight of its own need be definite beside the problem's.
    return ControlCost(np.ones(m))._with(matrices, about)


def widened(guess: InitialGuess, problem: Problem, wide: Problem) -> InitialGuess:
    """A start of the problem as one of the problem with the last command."""
    m, prior, trajectory = len(problem.control_coordinates), guess.prior, guess.trajectory
    if prior is not None:
        padded = [(0, 0)] * (prior.about.ndim - 1) + [(0, m)]
        prior = InitialPrior(
            np.pad(prior.weight, (0, m)), about=np.pad(prior.about, padded), iterations=prior.iterations,
            obstacles=prior.obstacles, controls=prior.controls,
        )  # fmt: skip
    if trajectory is not None:
        trajectory = with_commands(trajectory)
    rows = [term.rows for term in wide.constraint_terms[len(guess.multipliers) :]] if guess.multipliers else []
    others = (Multipliers(np.zeros((wide.steps + 1, count)), 0.0) for count in rows)
    return replace(
        guess, gain=np.pad(guess.gain, [(0, 0), (0, 0), (0, m)]), cost_to_go=None, prior=prior, trajectory=trajectory,
        multipliers=(*guess.multipliers, *others),
    )  # fmt: skip


def with_commands(plan: Trajectory) -> Trajectory:
    """A plan with the command before each state; zeros before the first."""
    commands = np.pad(plan.controls, [(1, 0), (0, 0)])
    return replace(plan, states=np.hstack([np.asarray(plan.states), commands]))

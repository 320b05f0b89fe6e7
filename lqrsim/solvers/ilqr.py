"""Iterative LQR with line search: the paper's baseline for comparison."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lqrsim.annotations import checked
from lqrsim.errors import InputError, check_number
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Policy
from lqrsim.problem.derivative_check import check_functions
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status
from lqrsim.results.value_functions import Quadratic
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import assemble
from lqrsim.solvers.budget import Budget, Callback, Stop
from lqrsim.solvers.control_rates import solve_with_rates
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.initial_guess import InitialGuess, InitialPrior, StartLike, resolve
from lqrsim.solvers.parallel import all_driven_by, check_threads, solve_all
from lqrsim.solvers.risk import name_risk
from lqrsim.solvers.settings import Settings, SmootherSettings, settings_from, warn_of_goal

TOLERANCE = 1e-4  # default tolerance


@checked
def ilqr(
    problem: Problem,
    *,
    stop: str = "optimal",
    tolerance: float = TOLERANCE,
    max_iterations: int = 500,
    time_limit: float | None = None,
    start: StartLike = None,
    noise: Noise | None = None,
    risk: float | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Compute a locally optimal feedback policy by iterative LQR with a line search that halves the step.

    Each iteration is a backward pass about a feasible trajectory and the accepted rollout of its policy. The start is
    fixed: the state of a `FixedState`, or the state at which the initial cost is zero. The cost never rises. Control
    limits are respected; constraints are not supported.

    The other arguments are as in `smooth`.

    Args:
      problem: a problem with a start that is given exactly, or by the initial cost.
      stop: as in `smooth`; the gap is zero here, because every iterate is feasible.
      tolerance: tolerance of the relative change of cost, and of the optimality, as in `smooth`.
      start: controls of the first trajectory: (m,) or (T, m), by default the problem's nominal control; the controls of
        a Trajectory; or the policy of a Solution, or an AffinePolicy, run from the start.
      noise: as in `smooth`; with noise this is iLQG.

    Returns:
      A Solution, as `smooth` returns, but without cost-to-come and inverse policy. A hard problem raises no
      exception.

    Raises:
      InputError: the problem names no start.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, max_iterations=max_iterations, time_limit=time_limit, start=start
    )
    problem = problem.driven_by(noise, risk)
    _check(problem, settings)
    warn_of_goal(problem)
    with problem.dynamics.solving(check_threads(None)):
        return _solve(problem, settings, Stop(callback, attentive=True))


def ilqr_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    progress: Callable[[int, int], object] | None = None,
    noise: Noise | None = None,
    risk: float | None = None,
    **options: Any,
) -> list[Solution]:
    """Solve many problems as `ilqr` does, on several threads.

    The arguments are as in `smooth_many`; the options are those of `ilqr`.

    Returns:
      One Solution per problem, in their order.
    """
    settings = settings_from(Settings, "ilqr_many", {"tolerance": TOLERANCE, **options})
    return solve_all(all_driven_by(problems, noise, risk), settings, _check, _solve, threads=threads, progress=progress)


_NO_PRIOR = "start: got an InitialPrior, want controls, a Trajectory, an AffinePolicy or a Solution: iLQR has no prior"


@checked
def _check(problem: Problem, settings: Settings) -> None:
    check_number("tolerance", settings.tolerance, above=0.0)
    if isinstance(settings.start, InitialPrior):
        raise InputError(_NO_PRIOR)
    if problem.duration is not None:
        raise InputError("duration: got a free duration, want None for ilqr; use `smooth`, which solves for it")
    if problem.accuracy is not None or problem.between_knots:
        raise InputError("accuracy, between_knots: got one of them, want neither for ilqr; use smooth")
    if problem.constraints or (problem.control_rate is not None and problem.control_rate.limits is not None):
        raise InputError(
            "constraints: got a problem with constraints, want none for ilqr, which keeps only limits; use smooth"
        )
    if problem.start is None:
        raise InputError(
            "initial: got a cost that names no start, want FixedState(x) or QuadraticCost(weight, about=x)"
        )


def _solve(problem: Problem, settings: Settings, stop: Stop | None = None) -> Solution:
    if problem.control_rate is not None:
        return solve_with_rates(problem, settings, partial(_solve, stop=stop))
    assert problem.start is not None
    stop = Stop() if stop is None else stop
    stop.begin(settings.time_limit)
    budget = Budget(settings.max_iterations, stop, callback=stop.callback)
    with stop.not_counting():
        guess = resolve(settings.start, problem)
        if guess.prior is not None:  # a function may return one
            raise InputError(_NO_PRIOR)
        start = problem.start.copy()
        check_functions(problem, start, guess.offset[0].copy())
        options = SmootherSettings(stop=settings.stop, tolerance=settings.tolerance, finish=None)
        run = SolveRun.lent(problem, options, InitialGuess(guess.gain, guess.offset), start, budget, "ilqr")
        run.work.fixed = True  # if by the initial cost alone
    with stop.reporting("ilqr"):
        ending = run.ilqr()
    log, work = budget.log, run.work
    complete = len(log) > 0 and ending.failed < 0
    if ending.outcome == declarations.TIMED_OUT:  # the last backward pass was made about the previous trajectory
        if not log:
            run.roll_out()
        complete = bool(np.isfinite(run.linearize_about_plan()))
    (states, controls), gain = work.best, work.arrays.policy.gain
    # Without a pass about the trajectory the policy has no feedback.
    law = compiled.law_about(states, controls, gain) if complete else Policy(np.zeros_like(gain), controls)
    result = RunResult(
        status=ending.status, detail=ending.detail(problem.steps), plan=work.best, law=law, cost=work.cost,
        violation=0.0, gap=0.0,
        values={"cost_to_go": Quadratic(*work.arrays.to_go)} if complete else {},
    )  # fmt: skip
    result = run.certified(result)
    if result.status is Status.RISK_TOO_HIGH:
        result = replace(result, detail=name_risk(run, result))
    solution = assemble(problem, result, log, solver="ilqr", options=settings.options(guess))
    run.give_back()
    return stop.finish(solution)

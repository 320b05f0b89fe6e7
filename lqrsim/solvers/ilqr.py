"""Iterative LQR with line search: the paper's baseline for comparison."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lqrsim.errors import InputError, check_number
from lqrsim.kernels import declarations
from lqrsim.kernels.records import (
    CERTIFICATE,
    LOG,
    CostToGo,
    IlqrArrays,
    IterationSettings,
    Motion,
    Policy,
    StructuredArray,
)
from lqrsim.problem.derivative_check import check_functions
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status
from lqrsim.results.value_functions import Quadratic
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import assemble
from lqrsim.solvers.budget import Budget, Callback
from lqrsim.solvers.certify import certified
from lqrsim.solvers.engine import RunResult, check_finite_at_start, iterate
from lqrsim.solvers.initial_guess import InitialPrior, StartLike, resolve
from lqrsim.solvers.parallel import all_driven_by, check_threads, solve_all
from lqrsim.solvers.risk import named
from lqrsim.solvers.settings import Settings, check_callback, check_problem, settings_from, warn_of_goal

TOLERANCE = 1e-4  # default tolerance


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

    Args:
      problem: a problem with a start that is given exactly, or by the initial cost.
      stop: as in `smooth`; the gap is zero here, because every iterate is feasible.
      tolerance: tolerance of the relative change of cost, and of the optimality, as in `smooth`.
      max_iterations: the largest number of iterations.
      time_limit: as in `smooth`.
      start: controls of the first trajectory: (m,) or (T, m), by default the problem's nominal control; the controls of
        a Trajectory; or the policy of a Solution, or an AffinePolicy, run from the start.
      callback: as in `smooth`.
      noise: as in `smooth`; with noise this is iLQG.
      risk: as in `smooth`.

    Returns:
      A Solution, as `smooth` returns, but without cost-to-come and inverse policy. A hard problem raises no
      exception.

    Raises:
      InputError: an argument is not as described, or the problem names no start.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, max_iterations=max_iterations, time_limit=time_limit, start=start
    )
    check_callback(callback)
    check_problem(problem)
    problem = problem.driven_by(noise, risk)
    _check(problem, settings)
    warn_of_goal(problem)
    with problem.dynamics.solving(check_threads(None)):
        return _solve(problem, settings, attentive=True, callback=callback)


def ilqr_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    progress: Callable[[int, int], object] | None = None,
    noise: Noise | None = None,
    risk: float | None = None,
    **options: Any,
) -> list[Solution]:
    """Solve many problems as `ilqr` does, on several threads; see `smooth_many`.

    Args:
      problems: problems of one structure or of many; each structure is compiled once.
      threads: number of threads; by default all processors that this process may use.
      progress: called with the number of solved problems and the number of all problems, as each solve ends.
      noise: as in `ilqr`, for all problems.
      risk: as in `ilqr`, for all problems.
      options: other keyword arguments of `ilqr`, except `callback`, for all problems.

    Returns:
      One Solution per problem, in their order.

    Raises:
      InputError: an argument is not as described; a problem that is refused is named by its place in the list.
    """
    settings = settings_from(Settings, "ilqr_many", {"tolerance": TOLERANCE, **options})
    return solve_all(all_driven_by(problems, noise, risk), settings, _check, _solve, threads=threads, progress=progress)


_NO_PRIOR = "start: got an InitialPrior, want controls, a Trajectory, an AffinePolicy or a Solution: iLQR has no prior"


def _check(problem: Problem, settings: Settings) -> None:
    check_problem(problem)
    check_number("tolerance", settings.tolerance, above=0.0)
    if isinstance(settings.start, InitialPrior):
        raise InputError(_NO_PRIOR)
    if problem.duration is not None:
        raise InputError("duration: got a free duration, want None for ilqr; use `smooth`, which solves for it")
    if problem.constraints:
        raise InputError(
            "constraints: got a problem with constraints, want none for ilqr, which keeps only limits; use smooth"
        )
    if problem.start is None:
        raise InputError(
            "initial: got a cost that names no start, want FixedState(x) or QuadraticCost(weight, about=x)"
        )


def _solve(
    problem: Problem, settings: Settings, *, attentive: bool = False, callback: Callback | None = None
) -> Solution:
    """Solve; `attentive`: see `Budget`."""
    assert problem.start is not None
    assert settings.tolerance is not None
    initial_guess = resolve(settings.start, problem)
    if initial_guess.prior is not None:  # a function may return one
        raise InputError(_NO_PRIOR)
    start, control = problem.start.copy(), initial_guess.offset[0].copy()
    check_functions(problem, start, control)
    n, steps, zeros = len(start), problem.steps, np.zeros
    policy = Policy(initial_guess.gain.copy(), initial_guess.offset.copy())
    plan = Motion(zeros((steps + 1, n)), zeros(initial_guess.offset.shape))
    states, controls = plan
    go = CostToGo(zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1))
    work = IlqrArrays(
        start=start, policy=policy, to_go=go, best=plan, trial=Motion(states.copy(), controls.copy()), damping=zeros(1),
        certificate=zeros(1, CERTIFICATE),
    )  # fmt: skip
    most = settings.max_iterations
    rows = zeros(most + 1, LOG)
    options = IterationSettings(
        steps=steps, max_iterations=most, tolerance=settings.tolerance, gap_tolerance=0.0,
        optimal=settings.stop == "optimal", fixed=True, guided=False, prior_iterations=0,
    )  # fmt: skip
    budget = Budget(most, callback=callback, attentive=attentive)
    budget.stop.begin(settings.time_limit)
    with budget.stop.not_counting():
        model = compiled.arguments(problem)
        loop = compiled.core(problem).lay_out("ilqr", declarations.ITERATE, 0, 0, options, model, work, rows)
    with budget.stop.reporting("ilqr", attentive):
        ending = iterate(
            problem, lambda first, last: loop(declarations.ITERATE, first, last, options, model, work, rows), rows,
            first=0, last=most, budget=budget,
        )  # fmt: skip
    done = len(budget.log)
    ending = check_finite_at_start(problem, ending, rows["cost"][:done], start, control, refuse=attentive)
    whole = done > 0 and ending.failed < 0
    if ending.outcome == declarations.TIMED_OUT:  # the last backward pass was made about the previous trajectory
        if not done:
            loop(declarations.ITERATE, 0, 0, options, model, work, rows)  # only the first rollout
        *_, failed = loop(declarations.LINEARIZE, 0, 0, options, model, work, rows)
        whole = failed < 0 and np.isfinite(states).all()
    if not whole:  # without a pass about the trajectory the policy has no feedback
        policy.gain[:] = 0
    offset = compiled.law_about(states, controls, policy.gain)[1] if whole else controls.copy()
    status, detail = ending.status, ending.detail(steps)

    def check(task: int, to_go: CostToGo, out: StructuredArray) -> None:
        checked = work._replace(policy=Policy(policy.gain, offset), to_go=to_go, certificate=out)
        loop(task, 0, 0, options, model, checked, rows)

    value = Quadratic(*go) if whole else None
    certificate, wrong = certified(
        problem, check, states, value, violation=0.0, claimed=budget.log[-1].cost if status.success else None,
        tolerance=settings.tolerance if status is Status.CONVERGED else None,
    )  # fmt: skip
    if wrong:
        status, detail = Status.NOT_CERTIFIED, f"of the plan that converged: {wrong}"
    if status is Status.RISK_TOO_HIGH:

        def fails(risk: float) -> int:
            model.noise.risk[0] = risk
            return loop(declarations.LINEARIZE, 0, 0, options, model, work, rows)[3]

        detail = "; ".join(part for part in (named(fails, problem.risk, steps), detail) if part)
    found = RunResult(
        status=status, detail=detail, states=states, controls=controls, law=(policy.gain, offset),
        cost=certificate.cost, violation=0.0, gap=0.0, values={"cost_to_go": value}, certificate=certificate,
    )  # fmt: skip
    solution = assemble(problem, found, budget.log, solver="ilqr", options=settings.options(initial_guess))
    return budget.stop.finish(solution)

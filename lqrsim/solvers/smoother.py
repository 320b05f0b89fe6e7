"""`smooth`, iterated LQR smoothing (Sec. V of the paper), and its baseline `ilqr`; both also for many problems.

`strategy.py` describes what `smooth` tries. Loops around that (`solve`) find a free duration (`free_duration.py`), put
right what a plan does between its knots (`between_knots.py`), and leave the last command out of a plan with a
`control_rate` (`control_rates.py`).
"""

import contextlib
import logging
from collections.abc import Callable, Iterable
from concurrent.futures import as_completed
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from lqrsim.annotations import Progress, checked
from lqrsim.errors import InputError, check_items, check_kind, check_memory, check_number
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Policy
from lqrsim.problem.control_rate import with_last_command
from lqrsim.problem.derivative_check import check_functions, functions_of
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Iteration, Quadratic, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import assemble
from lqrsim.solvers.between_knots import between_knots, solve_between_knots
from lqrsim.solvers.budget import Budget, Callback, Stop, check_threads, reported, workers
from lqrsim.solvers.certify import certified
from lqrsim.solvers.control_rates import solve_with_rates
from lqrsim.solvers.engine import RunResult, SolveRun, copied
from lqrsim.solvers.free_duration import solve_for_duration
from lqrsim.solvers.multistart import STARTS, detours, passable, path_weight
from lqrsim.solvers.settings import InitialGuess, InitialPrior, Settings, SmootherSettings, StartLike, resolve
from lqrsim.solvers.strategy import Search

ILQR_TOLERANCE = 1e-4  # default tolerance of iLQR
# Refinements of constraints along a plan, of which arms' force limits need two or three: along an outline, which takes
# this number of iterations without them; then along a plan of this tolerance; and then along plans that have converged.
REFINEMENTS, OUTLINED, PRELIMINARY = 5, 3, 1e-3
_log = logging.getLogger("lqrsim")


@checked
def smooth(
    problem: Problem,
    *,
    form: str = "dual",
    first_pass: str = "forward",
    safeguard: bool = True,
    stop: str = "optimal",
    tolerance: float | None = None,
    gap_tolerance: float = 1e-3,
    max_iterations: int = 500,
    time_limit: float | None = None,
    start: StartLike = None,
    starts: int | None = None,
    constraint_tolerance: float | None = None,
    penalty: float | None = None,
    finish: str | None = "newton",
    elastic: float | None = None,
    noise: Noise | None = None,
    risk: float | None = None,
    threads: int | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Compute a locally optimal feedback policy by iterated LQR smoothing.

    Each iteration is a forward pass (cost-to-come), a backward pass (cost-to-go) and a rollout of the new policy. Both
    passes linearise about the states of least total cost. No initial trajectory is needed. Paper: Sec. V. Once these
    states are near the rollout, Newton's method takes over. Problems with constraints are finished by an interior
    point.

    The start determines which local optimum is found. With an ObstacleCost and no start, several starts are tried for
    a few iterations each, and the most promising one is continued; see `solvers/strategy.py`.

    Args:
      problem: a problem with an initial cost, the paper's soft start, or with a `FixedState`, which only the dual form
        supports.
      form: "dual" represents the cost-to-come by its moments and needs no inverse dynamics; "primal" is the paper's
        form.
      first_pass: "forward" or "backward"; each iteration ends with a backward pass, so "backward" adds one pass.
        From controls, "backward" runs the dynamics backwards in time, from the minimiser of the final cost. The
        dynamics of an MJCF, and maps, cannot run backwards, and are run forwards.
      safeguard: if the method fails, continue from the best plan so far with steps that lower its cost; see
        `kernels/iterations.py`. If this does not converge either among contacts or joint limits of an MJCF, and
        there is no start, plan for softer contacts and limits from nine starts, continue from there, and soften and
        descend within contact modes in at most five rounds; see docs/mjcf_robots.md. If the method converges, results
        are bit-identical with and without the safeguard.
      stop: "optimal" (gap and first-order optimality within tolerance; for smoothing, also the change of cost) or
        "cost", the paper's test, which considers the change of cost alone and can pass early.
      tolerance: tolerance of the optimality and of the relative change of cost (see `Iteration`); by default 1e-8;
        1e-4 without Newton's method, and 1e-5 with constraints that act and an MJCF's dynamics.
      gap_tolerance: tolerance of the gap (see `Iteration`).
      max_iterations: the largest number of iterations from a start, by any method. Each start of a search may use that
        many, including those that are tried while no plan satisfies the constraints, and plans for softer contacts.
      time_limit: seconds after which the best plan so far is the answer, with the status TIME_LIMIT; compiling, which
        comes first, does not count, and if it takes long, a log line says so. An iteration that would end later, if it
        took as long as the last, is not begun.
      start: the initial guess, in place of a search. Controls (m,) or (T, m) to apply in the first pass, such as the
        problem's nominal control; an InitialPrior, which attracts the first iterations; an AffinePolicy; a
        Trajectory, feasible or not; or a Solution or other Plan of a similar problem, whose policy, cost-to-go and
        multipliers are used. Or a function of the problem that returns one of these. Controls are clipped to their
        limits. With constraints, the answer costs no more than a given feasible plan.
      starts: number of starts to try. By default 7 with an ObstacleCost; 3 if the first plan touches an inequality on
        the states, other than StateBounds, in a problem with a position; else 1, the straight path to the goal or the
        nominal control, and more if that leads to no plan that keeps the constraints. The candidates are in the
        solution.
      constraint_tolerance: largest violation of constraints, each in its unit; by default 1e-6, which is also the
        largest for equalities. If the augmented Lagrangian handles them (see `finish`), inequalities are solved with
        this margin, by default 1e-3.
      penalty: the initial penalty of all constraints in the augmented Lagrangian, in cost per square of their unit;
        they then act from the first iteration. It needs a start.
      finish: "newton" leaves the last iterations to Newton's method, or with constraints to the interior point; see
        `solvers/finish.py`. None uses the paper's method to the end, with an augmented Lagrangian for constraints. So
        do `stop="cost"`, noise with constraints and, without constraints, the steps of an MJCF.
      elastic: the price of violating a constraint, in cost per unit, summed over rows and steps. Constraints whose
        multipliers would exceed the price are violated, and the detail says by how much. None: they must hold.
      noise: replaces the problem's own noise; see `Noise`. The cost is then an expectation, in the log, line searches
        and the choice among starts.
      risk: replaces the problem's own risk; see `Problem`.
      threads: number of starts to run at once; by default the number of processors.
      callback: called with each `Iteration` as it ends; in a search, with iterations of starts that are run to their
        end, also those for heavier obstacles or softer contacts. An exception in it ends the solve, as Ctrl-C does; it
        is raised again, with the best plan so far as `solution`.

    Returns:
      A Solution. A hard problem raises no exception: the status says how the solve ended and what to try.
    """
    settings = SmootherSettings(
        form=form, first_pass=first_pass, safeguard=safeguard, stop=stop, tolerance=tolerance,
        gap_tolerance=gap_tolerance, max_iterations=max_iterations, time_limit=time_limit, start=start, starts=starts,
        constraint_tolerance=constraint_tolerance, penalty=penalty, finish=finish, elastic=elastic,
    )  # fmt: skip
    problem = problem.driven_by(noise, risk)
    _check_smooth(problem, settings)
    _warn_of_goal(problem)
    return solve(problem, settings, Stop(callback, check_threads(threads), attentive=True))


def smooth_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    progress: Callable[[int, int], object] | None = None,
    noise: Noise | None = None,
    risk: float | None = None,
    **options: Any,
) -> list[Solution]:
    """Solve many problems as `smooth` does, on several threads, without Python between the iterations.

    The solutions are identical to the solutions of `smooth`, to the last bit, with any number of threads; only the
    seconds of an iteration are an average. Constraints are checked after each iteration. Dynamics and costs in plain
    Python run one at a time, and gain nothing from threads.

    Args:
      problems: problems of one structure or of many; each structure is compiled once.
      threads: number of threads; by default all processors that this process may use.
      progress: called with the number of solved problems and the number of all problems, as each solve ends.
      noise: as in `smooth`, for all problems.
      risk: as in `smooth`, for all problems.
      options: other keyword arguments of `smooth`, except `callback`, for all problems.

    Returns:
      One Solution per problem, in their order.

    Raises:
      InputError: a refused problem is named by its index in the list. A problem that is only not finite at its start
        ends as NOT_FINITE, and its detail says where.
    """
    settings = _settings_from(SmootherSettings, "smooth_many", options)
    listed = _driven_by(problems, noise, risk)
    return _solve_all(listed, settings, _check_smooth, solve, threads=threads, progress=progress)


@checked
def ilqr(
    problem: Problem,
    *,
    stop: str = "optimal",
    tolerance: float = ILQR_TOLERANCE,
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
    _check_ilqr(problem, settings)
    _warn_of_goal(problem)
    with problem.dynamics.solving(check_threads(None)):
        return _solve_ilqr(problem, settings, Stop(callback, attentive=True))


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
    settings = _settings_from(Settings, "ilqr_many", {"tolerance": ILQR_TOLERANCE, **options})
    listed = _driven_by(problems, noise, risk)
    return _solve_all(listed, settings, _check_ilqr, _solve_ilqr, threads=threads, progress=progress)


@checked
def _check_smooth(problem: Problem, settings: SmootherSettings) -> None:
    if problem.control_rate is not None:
        for option, got, want in (("form", settings.form, "dual"), ("first_pass", settings.first_pass, "forward")):
            if got != want:
                raise InputError(f"{option}: got {got!r} with control_rate, want {want!r}: no step leads back from it")
        problem = with_last_command(problem)  # its constraints have the limits of rates
    method = settings.method(problem)
    if problem.between_knots and not (method.exact and settings.elastic is None):
        want = 'finish="newton" and stop="optimal", without elastic= and noise'
        raise InputError(f"between_knots: got True without an interior point that keeps all constraints, want {want}")
    if settings.elastic is not None and not method.interior:
        if problem.constraints:
            noisy = settings.finish and settings.stop == "optimal"
            why = "with noise" if noisy else 'without finish="newton" and stop="optimal"'
            raise InputError(f"elastic: got {settings.elastic:g}, want None {why}")
        raise InputError(f"elastic: got {settings.elastic:g} for a problem without constraints, want None")
    if problem.duration is not None and not method.exact:
        raise InputError('duration: got a free one without the interior point, want finish="newton" and stop="optimal"')
    starts = settings.starts or (STARTS if settings.start is None and problem.obstacle_costs else 1)
    check_memory("starts", starts, problem.steps * problem.bytes_per_step)
    if settings.form == "primal" and problem.dynamics.discrete:
        raise InputError(f"form: got 'primal' for {problem.dynamics.name}, whose steps have no inverse, want 'dual'")
    if settings.form == "primal" and isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start):"
            ' the primal form has no other start; form="dual" has'
        )
    if (settings.starts or 1) > 1 and path_weight(problem) == 0 and not (any(passable(problem)) and detours(problem)):
        raise InputError(
            f"starts: got {settings.starts}, want 1: there is nothing to go round. More starts need a start and a goal"
            " apart from each other, and an ObstacleCost or a constraint on states between them"
        )


_NO_PRIOR = "start: got an InitialPrior, want controls, a Trajectory, an AffinePolicy or a Solution: iLQR has no prior"


@checked
def _check_ilqr(problem: Problem, settings: Settings) -> None:
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


def _solve_ilqr(problem: Problem, settings: Settings, stop: Stop) -> Solution:
    stop.begin(settings.time_limit)
    solve_part: Callable[..., Solution] = partial(_iterate_ilqr, stop=stop)
    if problem.control_rate is not None:
        solve_part = partial(solve_with_rates, solve=solve_part)
    return stop.deliver(solve_part(problem, settings))


def _iterate_ilqr(problem: Problem, settings: Settings, stop: Stop) -> Solution:
    assert problem.start is not None
    budget = Budget(settings.max_iterations, stop)
    budget.report()
    with stop.not_counting():
        guess = resolve(settings.start, problem)
        if guess.prior is not None:  # a function may return one
            raise InputError(_NO_PRIOR)
        check_functions(problem, guess.offset[0].copy())
        options = SmootherSettings(stop=settings.stop, tolerance=settings.tolerance, finish=None)
        run = SolveRun(problem, options, InitialGuess(guess.gain, guess.offset), problem.start.copy(), budget, "ilqr")
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
    policy = compiled.policy_about(states, controls, gain) if complete else Policy(np.zeros_like(gain), controls)
    result = RunResult(
        status=ending.status, detail=ending.detail(problem.steps), plan=work.best, policy=policy, cost=work.cost,
        violation=0.0, gap=0.0,
        values={"cost_to_go": Quadratic(*work.arrays.to_go)} if complete else {},
    )  # fmt: skip
    result = certified(run, result)
    solution = assemble(run, result, solver="ilqr", options=settings.options(guess))
    run.give_back()
    return solution


def solve(problem: Problem, settings: SmootherSettings, stop: Stop) -> Solution:
    """Solve one problem; the solution can look at its plan between the knots."""
    stop.begin(settings.time_limit)

    def search(problem: Problem, settings: SmootherSettings, *, trees: bool = True) -> Solution:
        return Search(problem, settings, stop).solve(trees=trees)

    # The loops that a problem needs, the innermost first: each solves problems with the one before.
    solve_part: Callable[..., Solution] = search
    if any(constraint._rough for constraint in problem.constraints):
        solve_part = partial(solve_refined, solve=solve_part, stop=stop)
    if problem.duration is not None:
        solve_part = partial(solve_for_duration, solve=partial(solve_part, trees=False), stop=stop)
    if problem.accuracy is not None or problem.between_knots:
        solve_part = partial(solve_between_knots, solve=solve_part, stop=stop)
    if problem.control_rate is not None:
        solve_part = partial(solve_with_rates, solve=solve_part)
    solution = solve_part(problem, settings)
    substeps = solution.options.get("substeps")  # of dynamics whose single steps may be too coarse to look with
    seen = replace(problem, dynamics=problem.dynamics.with_substeps(substeps)) if isinstance(substeps, int) else problem
    return stop.deliver(solution)._examined_by(partial(between_knots, seen, solution.trajectory))


def solve_refined(
    problem: Problem, settings: SmootherSettings, solve: Callable[..., Solution], stop: Stop, *, trees: bool = True
) -> Solution:
    """Solve a problem; refine constraints that the plan misses within periods, and solve again.

    With a start, the constraints are refined along the plan that follows from it. Without, they are at first refined
    along an outline, which is the start of what follows if it does not keep them.
    """
    method, rough, current, refinements, log = settings.method(problem), settings, problem, REFINEMENTS, ()
    if method.exact:  # a plan along which the constraints are to be refined once more
        missed = max(method.violation, min(constraint._rough for constraint in problem.constraints))
        rough = replace(settings, tolerance=max(method.tolerance, PRELIMINARY), constraint_tolerance=missed)
    options = rough
    if settings.start is None:
        outline, log = _outlined(problem, rough, stop)
        refined = problem._refined(outline) if outline.finite else None
        if refined is None:
            options = settings
        else:
            current = refined
            options = replace(rough, start=outline, starts=None) if settings.starts in (None, 1) else rough
    preliminary, outlined = options is not settings, current is not problem
    while True:
        solution = solve(current, options, trees=trees)
        if log:
            solution = replace(solution, iterations=(*log, *solution.iterations))
        log = solution.iterations
        failed = solution.status in (Status.INFEASIBLE, Status.STALLED) and solution.trajectory.finite
        if stop.due or not (solution.success or (failed and outlined)):
            return solution
        if failed:  # no plan may keep the constraints as they are along the outline
            options = replace(rough, start=solution.trajectory, starts=None)
            current, outlined = problem, False
            continue
        refined = current._refined(solution.trajectory) if refinements else None
        settled = solution.status is Status.COST_CONVERGED and solution.violation <= method.violation
        if refined is None and (settled or not preliminary):
            return solution
        current, options = refined or current, replace(settings, start=solution, starts=None)
        refinements, preliminary, outlined = refinements - 1, False, False


def _outlined(problem: Problem, settings: SmootherSettings, stop: Stop) -> tuple[Trajectory, tuple[Iteration, ...]]:
    """The plan of a few iterations without the constraints that are refined, and these iterations."""
    free = problem.with_constraints([constraint for constraint in problem.constraints if not constraint._rough])
    with stop.not_counting():  # compiling
        guess, budget = resolve(None, free), Budget(min(OUTLINED, settings.max_iterations), stop)
        check_functions(free, guess.offset[0].copy())
        run = SolveRun(free, settings, guess, free._start_or_zero, budget)
    budget.report()
    with problem.dynamics.solving(stop.threads), stop.reporting("smooth"):
        run.smooth(OUTLINED)
    outline = Trajectory(*copied(run.work.best), problem.dt)
    run.give_back()
    return outline, tuple(budget.log)


def _settings_from(kind: type[Settings], function: str, options: dict[str, Any]) -> Settings:
    """Make settings from keyword arguments. Raises TypeError for one that there is not."""
    names = [field.name for field in fields(kind)]
    for name in options:
        if name not in names:
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}, want {', '.join(names)}")
    return kind(**options)


def _warn_of_goal(problem: Problem) -> None:
    """Log a warning if the goal is inside an obstacle."""
    if where := problem.goal_inside:
        _log.warning("the goal is %s: a plan that ends there collides", where)


def _driven_by(problems: Iterable[Problem], noise: Noise | None, risk: float | None) -> list[Problem]:
    """The problems as a list, with noise and risk replaced if given. Raises InputError for anything else."""
    listed = list(check_items("problems", problems, object, "a list of Problem"))
    if noise is None and risk is None:
        return listed
    return [check_kind("problems", problem, Problem, "Problems").driven_by(noise, risk) for problem in listed]


@checked
def _solve_all(
    problems: list[Problem],
    settings: Settings,
    check: Callable[[Problem, Any], None],
    solve: Callable[..., Solution],
    *,
    threads: int | None,
    progress: Progress | None,
) -> list[Solution]:
    """Solve each problem with `solve(problem, settings, stop)`, on several threads; return the solutions in order."""
    threads = check_threads(threads)
    for i, problem in enumerate(problems):
        try:
            check(problem, settings)
            check_functions(problem, resolve(settings.start, problem).offset[0])
            compiled.core(problem, getattr(settings, "form", "dual"))
            compiled.compile_problem(problem)
        except InputError as error:
            raise InputError(f"problems[{i}]: {error}") from None
    functions = [function for problem in problems for function in functions_of(problem)]
    with workers(threads, functions) as pool:
        futures = [pool.submit(solve, problem, settings, Stop()) for problem in problems]
        done = 0
        report = reported("solving", lambda: f"{done} of {len(futures)} problems done")
        with report if progress is None else contextlib.nullcontext():
            for done, _ in enumerate(as_completed(futures), start=1):
                if progress is not None:
                    progress(done, len(futures))
        return [future.result() for future in futures]

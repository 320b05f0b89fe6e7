"""`smooth` and `smooth_many`: iterated LQR smoothing, Sec. V of the paper. `strategy.py` describes what they try."""

from collections.abc import Callable, Iterable
from typing import Any

from lqrsim.annotations import checked
from lqrsim.errors import InputError, check_memory
from lqrsim.problem.last_command import with_last_command
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution import Solution
from lqrsim.solvers.budget import Callback, Stop
from lqrsim.solvers.initial_guess import StartLike
from lqrsim.solvers.multistart import STARTS, check_starts
from lqrsim.solvers.parallel import all_driven_by, check_threads, solve_all
from lqrsim.solvers.settings import SmootherSettings, settings_from, warn_of_goal
from lqrsim.solvers.strategy import solve


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
        `kernels/descent.py`. If this does not converge either among contacts or joint limits of an MJCF, and
        there is no start, plan for softer contacts and limits from nine starts, continue from there, and soften and
        descend within contact modes in at most five rounds; see docs/mjcf_robots.md. If the method converges, results
        are bit-identical with and without the safeguard.
      stop: "optimal" (gap and first-order optimality within tolerance; for smoothing, also the change of cost) or
        "cost", the paper's test, which considers the change of cost alone and can pass early.
      tolerance: tolerance of the optimality and of the relative change of cost (see `Iteration`); by default 1e-8;
        1e-4 without Newton's method, and 1e-5 with constraints that act and an MJCF's dynamics.
      gap_tolerance: tolerance of the gap (see `Iteration`).
      max_iterations: the largest number of iterations that lead to the answer, by any method. In a search, each start
        may use that many, including the further starts that are tried while no plan satisfies the constraints.
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
        `solvers/strategy.py`. None uses the paper's method to the end, with an augmented Lagrangian for constraints. So
        do `stop="cost"`, noise with constraints and, without constraints, the steps of an MJCF.
      elastic: the price of violating a constraint, in cost per unit, summed over rows and steps. Constraints whose
        multipliers would exceed the price are violated, and the detail says by how much. None: they must hold.
      noise: replaces the problem's own noise; see `Noise`. The cost is then an expectation, in the log, line searches
        and the choice among starts.
      risk: replaces the problem's own risk; see `Problem`.
      threads: number of starts to run at once; by default the number of processors.
      callback: called with each `Iteration` as it ends; in a search, with iterations of starts that are run to their
        end. An exception in it ends the solve, as Ctrl-C does; it is raised again, with the best plan so far as
        `solution`.

    Returns:
      A Solution. A hard problem raises no exception: the status says how the solve ended and what to try.
    """
    settings = SmootherSettings(
        form=form, first_pass=first_pass, safeguard=safeguard, stop=stop, tolerance=tolerance,
        gap_tolerance=gap_tolerance, max_iterations=max_iterations, time_limit=time_limit, start=start, starts=starts,
        constraint_tolerance=constraint_tolerance, penalty=penalty, finish=finish, elastic=elastic,
    )  # fmt: skip
    problem = problem.driven_by(noise, risk)
    _check(problem, settings)
    warn_of_goal(problem)
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
    settings = settings_from(SmootherSettings, "smooth_many", options)
    return solve_all(all_driven_by(problems, noise, risk), settings, _check, solve, threads=threads, progress=progress)


@checked
def _check(problem: Problem, settings: SmootherSettings) -> None:
    if problem.control_rate is not None:
        for option, got, want in (("form", settings.form, "dual"), ("first_pass", settings.first_pass, "forward")):
            if got != want:
                raise InputError(f"{option}: got {got!r} with control_rate, want {want!r}: no step leads back from it")
        problem = with_last_command(problem)  # its constraints have the limits of rates
    if problem.between_knots and not (settings.second_order(problem) and settings.elastic is None):
        want = 'finish="newton" and stop="optimal", without elastic= and noise'
        raise InputError(f"between_knots: got True without an interior point that keeps all constraints, want {want}")
    if settings.elastic is not None and not (problem.constraints and settings.second_order(problem)):
        if problem.constraints:
            why = 'None without finish="newton" and stop="optimal"'
            if settings.finish and settings.stop == "optimal":
                why = "None with noise"
            raise InputError(f"elastic: got {settings.elastic:g}, want {why}")
        raise InputError(f"elastic: got {settings.elastic:g} for a problem without constraints, want None")
    if problem.duration is not None and not settings.second_order(problem):
        raise InputError('duration: got a free one without the interior point, want finish="newton" and stop="optimal"')
    several = settings.start is None and len(problem.obstacle_costs) > 0
    starts = settings.starts or (STARTS if several else 1)
    check_memory("starts", starts, problem.steps * problem.bytes_per_step)
    if settings.form == "primal" and problem.dynamics.discrete:
        raise InputError(f"form: got 'primal' for {problem.dynamics.name}, whose steps have no inverse, want 'dual'")
    if settings.form == "primal" and isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start):"
            ' the primal form has no other start; form="dual" has'
        )
    if settings.start is None:
        check_starts(problem, settings.starts)

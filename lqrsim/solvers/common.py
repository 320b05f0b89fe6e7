"""What the solvers share: settings, when to stop, and the iterations with a look after each."""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_flag,
    check_function,
    check_items,
    check_kind,
    check_memory,
    check_name,
    check_number,
)
from lqrsim.kernels import declarations
from lqrsim.kernels.records import StructuredArray
from lqrsim.machine import processors
from lqrsim.problem.derivative_check import check_functions, check_start, functions_of
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.solvers import compiled
from lqrsim.solvers.initial_guess import InitialGuess, StartLike, is_function, resolve

Callback = Callable[[Iteration], object]

_STATUS = {
    declarations.RUNNING: Status.MAX_ITERATIONS,  # stopped from outside
    declarations.CONVERGED: Status.CONVERGED,
    declarations.COST_CONVERGED: Status.COST_CONVERGED,
    declarations.MAX_ITERATIONS: Status.MAX_ITERATIONS,
    declarations.DIVERGED: Status.DIVERGED,
    declarations.NOT_POSITIVE_DEFINITE: Status.NOT_POSITIVE_DEFINITE,
    declarations.NOT_FINITE: Status.NOT_FINITE,
    declarations.NO_START: Status.NOT_FINITE,
    declarations.STALLED: Status.MAX_ITERATIONS,
    declarations.CYCLING: Status.MAX_ITERATIONS,
    declarations.NO_PROGRESS: Status.MAX_ITERATIONS,
    declarations.TIMED_OUT: Status.TIME_LIMIT,
    declarations.RISK_TOO_HIGH: Status.RISK_TOO_HIGH,
    declarations.IN_VALLEY: Status.MAX_ITERATIONS,
}


_METHODS = {
    declarations.SMOOTH: "smooth",
    declarations.DAMPED: "damped",
    declarations.REJECTED: "rejected",
    declarations.ILQR: "ilqr",
    declarations.NEWTON: "newton",
}
MOST_STARTS, MOST_THREADS = 10_000, 1024
ROUGH, FINE = 1e-4, 1e-8  # the tolerances of smoothing and of Newton's method, by default
INSIDE = 1e-3  # of what they may be missed by, what constraints that press have to spare for rounding
MISSED, SPARED = 1e-6, 1e-3  # those of constraints, by the interior point and by the augmented Lagrangian
ATTENTION = 0.1  # s, after which compiled code comes back to heed Ctrl-C


@dataclass(frozen=True, kw_only=True)
class Settings:
    """When to stop, and from where to start; see `ilqr` for what each means."""

    stop: str
    tolerance: float | None
    max_iterations: int
    time_limit: float | None
    start: StartLike | InitialGuess

    def __post_init__(self) -> None:
        check_name("stop", self.stop, ("optimal", "cost"))
        if is_function(self.start):
            check_function("start", self.start, "a function of a Problem, or what it returns", arguments=1)
        # What is kept is plain Python's: NumPy's numbers would be other types for the compiler, and not for JSON.
        if self.tolerance is not None:
            object.__setattr__(self, "tolerance", check_number("tolerance", self.tolerance, above=0.0))
        # The log of so many takes 48 MB.
        most = check_count("max_iterations", self.max_iterations, at_most=1_000_000)
        object.__setattr__(self, "max_iterations", most)
        if self.time_limit is not None:
            object.__setattr__(self, "time_limit", check_number("time_limit", self.time_limit, above=0.0))

    @property
    def core_form(self) -> str:
        """The form of the core that is used."""
        return "dual"

    def stop_early(self) -> "Stop":
        """For a solve that begins now."""
        return Stop(np.inf if self.time_limit is None else time.perf_counter() + self.time_limit)

    def options(self, start: InitialGuess) -> dict[str, object]:
        """The settings as a solution keeps them."""
        return {field.name: getattr(self, field.name) for field in fields(self)} | {"start": start.summary}


@dataclass(frozen=True, kw_only=True)
class SmootherSettings(Settings):
    """What `smooth` has beyond that."""

    gap_tolerance: float
    form: str
    first_pass: str
    safeguard: bool
    starts: int | None
    constraint_tolerance: float | None = None
    penalty: float | None = None
    finish: str | None = "newton"
    elastic: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elastic is not None:
            object.__setattr__(self, "elastic", check_number("elastic", self.elastic, above=0.0))
        if self.finish is not None:
            check_name("finish", self.finish, ("newton",))
        if self.starts is not None:
            object.__setattr__(self, "starts", check_count("starts", self.starts, at_most=MOST_STARTS))
            if self.starts > 1 and self.start is not None:
                raise InputError(f"starts: got {self.starts} beside a start, want one of the two")
        object.__setattr__(self, "gap_tolerance", check_number("gap_tolerance", self.gap_tolerance, above=0.0))
        if self.constraint_tolerance is not None:
            number = check_number("constraint_tolerance", self.constraint_tolerance, above=0.0)
            object.__setattr__(self, "constraint_tolerance", number)
        if self.penalty is not None:
            object.__setattr__(self, "penalty", check_number("penalty", self.penalty, above=0.0))
            if self.start is None:
                raise InputError(f"penalty: got {self.penalty:g} without a start, want start=... beside it")
        check_name("form", self.form, tuple(compiled.FORMS))
        check_name("first_pass", self.first_pass, ("forward", "backward"))
        object.__setattr__(self, "safeguard", check_flag("safeguard", self.safeguard))

    @property
    def core_form(self) -> str:
        return self.form

    def newton(self, problem: Problem) -> bool:
        """Whether the last iterations are of second order. With "cost", the paper's test ends the paper's method.

        Steps of an MJCF have no second derivatives. Without these it is Gauss-Newton's, of which an iteration of
        smoothing is worth several; see `experiments/convergence.py`. Nor has what noise costs.
        """
        exact = not problem.dynamics.discrete and not (problem.constraints and problem.noise_term is not None)
        return self.finish is not None and self.stop == "optimal" and exact

    @property
    def price(self) -> float:
        """What missing constraints costs, a unit; infinite where they are not to be missed."""
        return np.inf if self.elastic is None else self.elastic

    def missed(self, problem: Problem) -> float:
        """By how much constraints may be missed, or what is to spare where the augmented Lagrangian keeps them."""
        return self.constraint_tolerance or (MISSED if self.newton(problem) else SPARED)

    def final(self, problem: Problem) -> float:
        """What the optimality of the answer is to be below."""
        return self.tolerance or (FINE if self.newton(problem) else ROUGH)

    def rough(self, problem: Problem) -> float:
        """The same of what smoothing comes to: where Newton's method goes on from there, it need not be less."""
        final = self.final(problem)
        return max(final, ROUGH) if self.newton(problem) else final


@dataclass
class Stop:
    """Why a solve is to end early, if it is: a deadline, on the clock of `time.perf_counter`, or what was raised.

    What the callback raises, and Ctrl-C, end the solve as a deadline does: with the best plan so far. Then it is raised
    again, and has that as its `solution`.
    """

    deadline: float = np.inf
    error: BaseException | None = None
    # How long the next iteration may take, in s: one that would end after the deadline is not begun.
    reserve: float = 0.0

    @property
    def due(self) -> bool:
        return self.error is not None or time.perf_counter() + self.reserve >= self.deadline

    def finish(self, solution: Solution) -> Solution:
        """The solution; or, where something was raised, raises it again."""
        if self.error is None:
            return solution
        with contextlib.suppress(AttributeError, TypeError):  # an exception that takes no attributes
            self.error.solution = replace(solution, status=Status.INTERRUPTED)  # pyright: ignore[reportAttributeAccessIssue]
            self.error.add_note("lqrsim: the best plan so far is this exception's `solution`")
        raise self.error


@dataclass(frozen=True)
class Termination:
    """How the iterations of `iterate` ended.

    `failed` is the step of the pass that failed, or -1; `raised` what a user's function raised, if one did.
    """

    iterations: tuple[Iteration, ...]
    outcome: int
    backward: bool
    failed: int
    raised: str

    @property
    def status(self) -> Status:
        return _STATUS[self.outcome]

    @property
    def success(self) -> bool:
        return self.status.success

    @property
    def pass_failed(self) -> bool:
        """Whether a pass of one more iteration was begun and not completed."""
        return self.outcome in (
            declarations.NOT_POSITIVE_DEFINITE, declarations.NOT_FINITE, declarations.RISK_TOO_HIGH
        )  # fmt: skip

    def detail(self, steps: int) -> str:
        """What there is to say besides the status: where it ended, and what a user's function raised there."""
        raised = "" if self.success or self.outcome == declarations.TIMED_OUT else self.raised
        return ": ".join(part for part in (self._place(steps), raised) if part)

    def _place(self, steps: int) -> str:
        if self.pass_failed:
            if self.iterations and self.failed < 0:
                return ""
            which = "backward" if self.backward else "forward"
            return f"{which} pass of iteration {len(self.iterations) + 1}, step {self.failed} of {steps}"
        if self.outcome == declarations.NO_START:
            return "rollout of the initial controls"
        if self.outcome == declarations.CYCLING:
            return "the iterations repeat themselves"
        if self.outcome == declarations.NO_PROGRESS:
            return "the least cost so far no longer falls"
        return "the line search found no lower cost" if self.outcome == declarations.STALLED else ""


def iterate(
    problem: Problem,
    run: Callable[[int, int], tuple[int, int, bool, int]],
    log: StructuredArray,
    last: int,
    *,
    done: tuple[Iteration, ...] = (),
    before: tuple[Iteration, ...] = (),
    look: Callable[[], float] = lambda: 0.0,
    each: bool,
    stop: Stop,
    callback: Callback | None = None,
) -> Termination:
    """Run a loop of `kernels/iterations.py` until it ends, or there are so many iterations.

    Args:
      problem: whose functions may raise meanwhile.
      run: runs the iterations from its first argument up to its second, or fewer.
      log: (any,) rows of `LOG`, where `run` writes.
      last: how many iterations there are to be.
      done: those that there are already.
      before: the iterations of what ran before, which come first in the termination's.
      look: how far the constraints are missed by what `run` found last.
      each: come back from compiled code to heed Ctrl-C: after each iteration where there is a callback, a deadline, or
        something to look at, else after `ATTENTION`. The seconds of an iteration are the average of those between.
      stop: looked at before each iteration, where there is a deadline or a callback.
    """
    functions = functions_of(problem)
    single = (each and (callback is not None or bool(functions))) or bool(problem.constraints) or stop.deadline < np.inf
    bite = 1 if each or single else last
    for function in functions:
        function.forget()
    iterations = list(done)
    outcome, backward, failed = declarations.RUNNING, False, -1
    try:
        while outcome == declarations.RUNNING and len(iterations) < last:
            if stop.due:
                outcome = declarations.TIMED_OUT
                break
            first = len(iterations)
            clock = time.perf_counter()
            count, outcome, backward, failed = run(first, min(first + bite, last))
            seconds = (time.perf_counter() - clock) / max(count - first, 1)
            if each and not single:
                bite = max(1, int(ATTENTION / max(seconds, 1e-9)))
            for i, row in enumerate(log[first:count].tolist(), first):
                cost, improvement, gap, optimality, residual, method = row
                missed = look() if i == count - 1 or not problem.constraints else float("nan")
                name = _METHODS[int(method)]
                iterations.append(Iteration(cost, improvement, gap, optimality, residual, missed, seconds, name))
                if callback is not None:
                    callback(iterations[-1])
            for function in functions:
                if function.raised is not None and not isinstance(function.raised, Exception):
                    raise function.raised  # Ctrl-C
    except BaseException as error:  # the callback's, or Ctrl-C: raised again when there is a solution
        stop.error, outcome = error, declarations.TIMED_OUT
    return Termination((*before, *iterations), outcome, backward, failed, raised_by(functions))


def raised_by(functions: Iterable[UserFunction]) -> str:
    """What functions have raised since they were told to forget it."""
    raised = [f"{f.name} raised {type(f.raised).__name__}: {f.raised}" for f in functions if f.raised is not None]
    return "; ".join(raised)


def solve_all(
    problems: list[Problem],
    settings: Settings,
    check: Callable[[Problem, Any], None],
    solve: Callable[..., Solution],
    *,
    threads: int | None,
    progress: Callable[[int, int], object] | None,
) -> list[Solution]:
    """Solve each problem with `solve(problem, settings, each=False)`, on several threads; the answers in order."""
    check_function("progress", progress, "a function of how many are done, of how many", arguments=2)
    threads = check_threads(threads)
    for i, problem in enumerate(problems):
        try:
            check(problem, settings)
            start = np.zeros(len(problem.dynamics.state_coordinates)) if problem.start is None else problem.start
            check_functions(problem, start, resolve(settings.start, problem).offset[0])
            compiled.core(problem, settings.core_form)
            compiled.arguments(problem)  # compiles numba functions
        except InputError as error:
            raise InputError(f"problems[{i}]: {error}") from None
    functions = [function for problem in problems for function in functions_of(problem)]
    with workers(threads, functions) as pool:
        futures = [pool.submit(solve, problem, settings, each=False) for problem in problems]
        for done, _ in enumerate(as_completed(futures), start=1):
            if progress is not None:
                progress(done, len(futures))
        return [future.result() for future in futures]


@contextlib.contextmanager
def workers(threads: int, functions: Iterable[UserFunction]) -> Iterator[ThreadPoolExecutor]:
    """Threads that solve. On an error, Ctrl-C too, what is compiled ends in a moment; plain functions are told to."""
    with ThreadPoolExecutor(threads, thread_name_prefix="lqrsim") as pool:
        try:
            yield pool
        except BaseException:
            for function in functions:
                function.stopped.set()
            pool.shutdown(wait=True, cancel_futures=True)
            for function in functions:
                function.stopped.clear()
            raise


def check_callback(callback: Callback | None) -> None:
    """Raises InputError for what cannot be called."""
    check_function("callback", callback, "a function of an Iteration", arguments=1)


def check_threads(threads: int | None) -> int:
    """How many threads to use; by default as many as there are processors. Raises InputError."""
    return processors() if threads is None else check_count("threads", threads, at_most=MOST_THREADS)


def check_attempts(problem: Problem, starts: int) -> None:
    """Raises InputError if the arrays of so many starts do not fit into memory."""
    check_memory("starts", starts, problem.steps * problem.bytes_per_step)


def list_of(problems: Iterable[Problem]) -> list[Problem]:
    """The problems as a list. Raises InputError for what is no collection."""
    return list(check_items("problems", problems, object, "a list of Problem"))


def all_driven_by(problems: Iterable[Problem], noise: Noise | None, risk: float | None) -> list[Problem]:
    """The problems as a list, under that noise and risk; of what is None, their own."""
    listed = list_of(problems)
    if noise is None and risk is None:
        return listed
    return [check_kind("problems", one, Problem, "Problems").driven_by(noise, risk) for one in listed]


def check_problem(problem: Problem) -> None:
    """Raises InputError unless it is a problem."""
    check_kind("problem", problem, Problem, "a Problem, such as scenario.problem")


def check_outcome(problem: Problem, termination: Termination, x: Array, u: Array, *, refuse: bool) -> Termination:
    """Look for the cause if the first iteration led nowhere: a function that is not finite at the start (n,), (m,).

    Raises:
      InputError: that is so, and `refuse` is set; otherwise the returned termination says it.
    """
    lost = not termination.iterations and termination.status is Status.NOT_FINITE
    if lost or (termination.iterations and not np.isfinite(termination.iterations[0].cost)):
        try:
            check_start(problem, x, u)
        except InputError as error:
            if refuse:
                raise
            return replace(termination, outcome=declarations.NOT_FINITE, raised=str(error))
    return termination

"""Solves many problems on several threads."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

import numpy as np

from lqrsim.annotations import Progress, checked
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import InputError, check_count, check_items, check_kind
from lqrsim.machine import processors
from lqrsim.problem.derivative_check import check_functions, functions_of
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import reported
from lqrsim.solvers.initial_guess import resolve
from lqrsim.solvers.settings import Settings

MOST_THREADS = 1024


@checked
def solve_all(
    problems: list[Problem],
    settings: Settings,
    check: Callable[[Problem, Any], None],
    solve: Callable[..., Solution],
    *,
    threads: int | None,
    progress: Progress | None,
) -> list[Solution]:
    """Solve each problem with `solve(problem, settings)`, on several threads; return the solutions in order."""
    threads = check_threads(threads)
    for i, problem in enumerate(problems):
        try:
            check(problem, settings)
            start = np.zeros(len(problem.dynamics.state_coordinates)) if problem.start is None else problem.start
            check_functions(problem, start, resolve(settings.start, problem).offset[0])
            compiled.core(problem, getattr(settings, "form", "dual"))
            compiled.arguments(problem)  # this compiles numba functions
        except InputError as error:
            raise InputError(f"problems[{i}]: {error}") from None
    functions = [function for problem in problems for function in functions_of(problem)]
    with workers(threads, functions) as pool:
        futures = [pool.submit(solve, problem, settings) for problem in problems]
        done = 0
        report = reported("solving", lambda: f"{done} of {len(futures)} problems done")
        with report if progress is None else contextlib.nullcontext():
            for done, _ in enumerate(as_completed(futures), start=1):
                if progress is not None:
                    progress(done, len(futures))
        return [future.result() for future in futures]


@contextlib.contextmanager
def workers(threads: int, functions: Iterable[UserFunction]) -> Iterator[ThreadPoolExecutor]:
    """A pool of threads. After an error or Ctrl-C plain Python functions are told to stop; compiled code ends soon."""
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


def check_threads(threads: int | None) -> int:
    """Check a number of threads; by default the number of processors. Raises InputError."""
    return processors() if threads is None else check_count("threads", threads, at_most=MOST_THREADS)


def all_driven_by(problems: Iterable[Problem], noise: Noise | None, risk: float | None) -> list[Problem]:
    """The problems as a list, with noise and risk replaced if given. Raises InputError for anything else."""
    listed = list(check_items("problems", problems, object, "a list of Problem"))
    if noise is None and risk is None:
        return listed
    return [check_kind("problems", problem, Problem, "Problems").driven_by(noise, risk) for problem in listed]

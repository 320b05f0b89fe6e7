"""Iterative LQR with line search: the baseline that the paper compares with."""

from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.checks import check_functions
from lqrsim.errors import InputError
from lqrsim.problem import Problem
from lqrsim.results import Quadratic, Solution
from lqrsim.solvers.common import (
    Callback,
    Settings,
    assemble,
    check_outcome,
    check_problem,
    iterate,
    list_of,
    model,
    solve_all,
)


def ilqr(
    problem: Problem,
    *,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    max_iterations: int = 500,
    initial_controls: npt.ArrayLike | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Compute a locally optimal feedback policy by iterative LQR with a line search that halves the step.

    Each iteration is a backward pass about a feasible trajectory and the accepted rollout of its policy. The start is
    fixed: the state of a `FixedState`, or the one that the initial cost is about. The cost never rises.

    Args:
      stop, tolerance, max_iterations, callback: as in `smooth`; the gap is zero here, for every iterate is feasible.
      initial_controls: (m,) or (T, m), what the first trajectory applies; the problem's nominal control by default.

    Returns:
      The same Solution as `smooth`, without cost-to-come and inverse policy. A hard problem does not raise.

    Raises:
      InputError: an argument is not as described, or the problem names no start.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, max_iterations=max_iterations, initial_controls=initial_controls
    )
    _check(problem)
    return _solve(problem, settings, each=True, callback=callback)


def ilqr_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    max_iterations: int = 500,
    initial_controls: npt.ArrayLike | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Solution]:
    """Solve many problems as `ilqr` does, on several threads; see `smooth_many`.

    Raises:
      InputError: an argument is not as described; a problem that is refused is named by its place in the list.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, max_iterations=max_iterations, initial_controls=initial_controls
    )
    return solve_all(list_of(problems), settings, _check, _solve, threads=threads, progress=progress)


def _check(problem: Problem) -> None:
    check_problem(problem)
    if problem.start is None:
        raise InputError(
            "initial: got a cost that names no start, want FixedState(x) or QuadraticCost(weight, about=x)"
        )


def _solve(problem: Problem, settings: Settings, *, each: bool, callback: Callback | None = None) -> Solution:
    """Solve; with `each`, a look after each iteration (see `iterate`)."""
    assert problem.start is not None
    n, steps, zeros = len(problem.dynamics.state_coordinates), problem.steps, np.zeros
    controls = settings.controls(problem)
    start, control = problem.start.copy(), controls[0].copy()
    check_functions(problem, start, control)
    m = controls.shape[1]
    states = zeros((steps + 1, n))
    L, l = zeros((steps, m, n)), zeros((steps, m))
    go = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
    log = zeros((settings.max_iterations + 1, 4))
    core = compiled.core(problem)
    options = settings.max_iterations, settings.tolerance, settings.stop == "optimal"
    arrays = (
        start, L, l, *go, *model(problem),
        states, controls, states.copy(), controls.copy(), zeros(1), log,
    )  # fmt: skip
    loop = core.entry("ilqr_iterations", steps, 0, 0, *options, *arrays)
    ending = iterate(
        problem,
        lambda first, last: loop(steps, first, last, *options, *arrays),
        log, settings.max_iterations, each=each, callback=callback,
    )  # fmt: skip
    ending = check_outcome(problem, ending, start, control, refuse=each)
    whole = ending.iterations != () and ending.failed < 0
    if not whole:
        L[:] = 0  # without a pass about the trajectory there is no feedback; what is left is to play the controls
    offset = controls - np.einsum("tij,tj->ti", L, states[:-1]) if whole else controls.copy()
    return assemble(
        problem, solver="ilqr", settings=settings, ending=ending, states=states, controls=controls,
        law=(L, offset), inverse_law=None, cost_to_go=Quadratic(*go) if whole else None, cost_to_come=None,
    )  # fmt: skip

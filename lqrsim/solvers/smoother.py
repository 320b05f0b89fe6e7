"""Iterated LQR smoothing: Sec. V of the paper, in its primal form."""

from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.checks import check_functions
from lqrsim.errors import InputError
from lqrsim.problem import FixedState, Problem
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


def smooth(
    problem: Problem,
    *,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    gap_tolerance: float = 1e-3,
    max_iterations: int = 200,
    initial_controls: npt.ArrayLike | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Compute a locally optimal feedback policy by iterated LQR smoothing.

    Each iteration is a forward pass (cost-to-come), a backward pass (cost-to-go) and a rollout of the new policy; both
    passes linearise about the states of least total cost. No trajectory is needed to start from. Paper: Sec. V.

    Args:
      problem: with an initial cost, the paper's soft start.
      stop: "optimal" (change of cost, gap and first-order optimality all within tolerance) or "cost", the paper's
        test, which looks at the change of cost alone and can pass early.
      tolerance: of the relative change of cost, and of the optimality (see `Iteration`).
      gap_tolerance: of the gap (see `Iteration`).
      max_iterations: when to give up.
      initial_controls: (m,) or (T, m), what the first pass applies; the problem's nominal control by default. It has a
        say in which local optimum is found.
      callback: called with each `Iteration` as it ends.

    Returns:
      A Solution. A hard problem does not raise: the status says how it ended and what to try.

    Raises:
      InputError: an argument is not as described.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, gap_tolerance=gap_tolerance, max_iterations=max_iterations,
        initial_controls=initial_controls,
    )  # fmt: skip
    _check(problem)
    return _solve(problem, settings, each=True, callback=callback)


def smooth_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    gap_tolerance: float = 1e-3,
    max_iterations: int = 200,
    initial_controls: npt.ArrayLike | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Solution]:
    """Solve many problems as `smooth` does, on several threads, without Python between the iterations.

    The solutions are those of `smooth`, to the last bit, whatever the number of threads; only the seconds of an
    iteration are an average. Dynamics and costs that are plain Python take turns, and gain nothing from threads.

    Args:
      problems: of one structure or of many; each structure is compiled once.
      threads: how many to use; by default all processors that this process may run on.
      stop, tolerance, gap_tolerance, max_iterations, initial_controls: as in `smooth`, for all problems.
      progress: called with how many are done, of how many, as each one ends.

    Returns:
      One Solution a problem, in their order.

    Raises:
      InputError: an argument is not as described; a problem that is refused is named by its place in the list. One that
        is only not finite at its start ends as NOT_FINITE, and its detail says where.
    """
    settings = Settings(
        stop=stop, tolerance=tolerance, gap_tolerance=gap_tolerance, max_iterations=max_iterations,
        initial_controls=initial_controls,
    )  # fmt: skip
    return solve_all(list_of(problems), settings, _check, _solve, threads=threads, progress=progress)


def _check(problem: Problem) -> None:
    check_problem(problem)
    if isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start);"
            " ilqr() takes a FixedState"
        )


def _solve(problem: Problem, settings: Settings, *, each: bool, callback: Callback | None = None) -> Solution:
    """Solve; with `each`, a look after each iteration (see `iterate`)."""
    n, steps, zeros = len(problem.dynamics.state_coordinates), problem.steps, np.zeros
    x_hat = zeros(n) if problem.start is None else problem.start.copy()
    controls = settings.controls(problem)
    start, control = x_hat.copy(), controls[0].copy()
    check_functions(problem, start, control)
    m = controls.shape[1]
    x_hats, states = zeros((steps + 1, n)), zeros((steps + 1, n))
    L, Lbar, kept_L = zeros((steps, m, n)), zeros((steps, m, n)), zeros((steps, m, n))
    l, lbar, kept_l = controls.copy(), zeros((steps, m)), zeros((steps, m))
    go = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
    come = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
    prior_weight, prior_about, prior_iterations = zeros(n), zeros((steps + 1, n)), 0
    if problem.prior is not None:
        prior_weight, prior_iterations = problem.prior.weight.copy(), problem.prior.iterations
        prior_about[:] = problem.prior.about
    log = zeros((settings.max_iterations, 4))
    core = compiled.core(problem)
    options = (
        settings.max_iterations,
        settings.tolerance,
        float(settings.gap_tolerance or 0),
        settings.stop == "optimal",
    )
    arrays = (
        x_hat, x_hats, L, l, *go, Lbar, lbar, *come, *model(problem),
        prior_weight, prior_about, prior_iterations, states, controls, kept_L, kept_l, log,
    )  # fmt: skip
    loop = core.entry("smoother_iterations", steps, 0, 0, *options, *arrays)
    ending = iterate(
        problem,
        lambda first, last: loop(steps, first, last, *options, *arrays),
        log, settings.max_iterations, each=each, callback=callback,
    )  # fmt: skip
    ending = check_outcome(problem, ending, start, control, refuse=each)
    whole = not ending.pass_failed
    return assemble(
        problem, solver="smooth", settings=settings, ending=ending, states=states, controls=controls,
        law=(kept_L, kept_l), inverse_law=(Lbar, lbar) if whole else None,
        cost_to_go=Quadratic(*go) if whole else None, cost_to_come=Quadratic(*come) if whole else None,
    )  # fmt: skip

"""Iterated LQR smoothing: Sec. V of the paper, with a safeguard for where it would fail."""

import contextlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lqrsim import compiled
from lqrsim.checks import check_functions
from lqrsim.errors import Array, InputError
from lqrsim.problem import FixedState, Problem
from lqrsim.results import Moments, Quadratic, Solution, Status
from lqrsim.solvers import interface
from lqrsim.solvers.common import (
    LOG_COLUMNS,
    Callback,
    Ending,
    SmootherSettings,
    assemble,
    check_outcome,
    check_problem,
    iterate,
    list_of,
    model,
    solve_all,
)
from lqrsim.solvers.start import Start, StartLike, resolve


def smooth(
    problem: Problem,
    *,
    form: str = "dual",
    first_pass: str = "forward",
    safeguard: bool = True,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    gap_tolerance: float = 1e-3,
    max_iterations: int = 500,
    start: StartLike = None,
    callback: Callback | None = None,
) -> Solution:
    """Compute a locally optimal feedback policy by iterated LQR smoothing.

    Each iteration is a forward pass (cost-to-come), a backward pass (cost-to-go) and a rollout of the new policy; both
    passes linearise about the states of least total cost. No trajectory is needed to start from. Paper: Sec. V.

    Args:
      problem: with an initial cost, the paper's soft start, or a `FixedState`, which only the dual form takes.
      form: "dual" has the cost-to-come by its moments and needs no inverse dynamics; "primal" is the paper's.
      first_pass: "forward" or "backward"; each iteration ends with a backward pass, so the latter is one pass more.
        From controls it runs the dynamics backwards in time, from the minimiser of the final cost.
      safeguard: where the method fails, go on from the best plan so far by steps that lower its cost; see
        `solvers/safeguard.py`. Where it converges, the safeguard changes nothing, to the last bit.
      stop: "optimal" (change of cost, gap and first-order optimality all within tolerance) or "cost", the paper's
        test, which looks at the change of cost alone and can pass early.
      tolerance: of the relative change of cost, and of the optimality (see `Iteration`).
      gap_tolerance: of the gap (see `Iteration`).
      max_iterations: when to give up the method; the safeguard, if it steps in, has as many again.
      start: what to begin with; it has a say in which local optimum is found. Controls (m,) or (T, m) to apply in the
        first pass, by default the problem's nominal control; an AffinePolicy; a Trajectory, feasible or not, about
        which the first pass linearises; or a Solution of a similar problem, whose policy and cost-to-go it takes up.
      callback: called with each `Iteration` as it ends.

    Returns:
      A Solution. A hard problem does not raise: the status says how it ended and what to try.

    Raises:
      InputError: an argument is not as described.
    """
    settings = SmootherSettings(
        form=form, first_pass=first_pass, safeguard=safeguard, stop=stop, tolerance=tolerance,
        gap_tolerance=gap_tolerance, max_iterations=max_iterations, start=start,
    )  # fmt: skip
    _check(problem, settings)
    return _solve(problem, settings, each=True, callback=callback)


def smooth_many(
    problems: Iterable[Problem],
    *,
    threads: int | None = None,
    form: str = "dual",
    first_pass: str = "forward",
    safeguard: bool = True,
    stop: str = "optimal",
    tolerance: float = 1e-4,
    gap_tolerance: float = 1e-3,
    max_iterations: int = 500,
    start: StartLike = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Solution]:
    """Solve many problems as `smooth` does, on several threads, without Python between the iterations.

    The solutions are those of `smooth`, to the last bit, whatever the number of threads; only the seconds of an
    iteration are an average. Dynamics and costs that are plain Python take turns, and gain nothing from threads.

    Args:
      problems: of one structure or of many; each structure is compiled once.
      threads: how many to use; by default all processors that this process may run on.
      form, first_pass, safeguard, stop, tolerance, gap_tolerance, max_iterations, start: as in `smooth`, for all.
      progress: called with how many are done, of how many, as each one ends.

    Returns:
      One Solution a problem, in their order.

    Raises:
      InputError: an argument is not as described; a problem that is refused is named by its place in the list. One that
        is only not finite at its start ends as NOT_FINITE, and its detail says where.
    """
    settings = SmootherSettings(
        form=form, first_pass=first_pass, safeguard=safeguard, stop=stop, tolerance=tolerance,
        gap_tolerance=gap_tolerance, max_iterations=max_iterations, start=start,
    )  # fmt: skip
    return solve_all(list_of(problems), settings, _check, _solve, threads=threads, progress=progress)


def _check(problem: Problem, settings: SmootherSettings) -> None:
    check_problem(problem)
    if settings.form == "primal" and isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start):"
            ' the primal form has no other start; form="dual" has'
        )


class _Arrays:
    """What the loops read and write; see `solvers/loops.py` and `safeguard.py` for what each is."""

    def __init__(self, problem: Problem, settings: SmootherSettings, begin: Start, start: Array) -> None:
        n, steps, zeros = len(start), problem.steps, np.zeros
        m = begin.offset.shape[1]
        self.dual = settings.form == "dual"
        self.fixed = isinstance(problem.initial, FixedState)
        self.start = start
        self.x_hat, self.x_hats = self.start.copy(), zeros((steps + 1, n))
        self.law = begin.gain.copy(), begin.offset.copy()
        self.go = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
        if begin.cost_to_go is not None:
            value = begin.cost_to_go
            self.go = value.hessian.copy(), value.gradient.copy(), np.array(value.constant)
        self.come = zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)
        kept = steps if self.dual else 1  # the primal form finds its way back without
        self.back = zeros((kept, n, n)), zeros((kept, n)), zeros((steps, m, n)), zeros((steps, m))
        self.no_prior = zeros(n), zeros((steps + 1, n))
        self.prior = (*self.no_prior, 0)
        if problem.prior is not None:
            about = np.broadcast_to(problem.prior.about, (steps + 1, n)).copy()
            self.prior = problem.prior.weight.copy(), about, problem.prior.iterations
        # Without a trajectory to begin with: the start, and the controls with which the dynamics can run backwards.
        self.guess = np.tile(self.start, (steps + 1, 1)), begin.offset.copy()
        if begin.trajectory is not None:
            self.guess = begin.trajectory.states.copy(), begin.trajectory.controls.copy()
        self.plan = self.guess[0].copy(), self.guess[1].copy()
        self.states, self.controls = zeros((steps + 1, n)), zeros((steps, m))
        self.kept = zeros((steps, m, n)), zeros((steps, m))
        self.memory = zeros(interface.MEMORY)
        self.model = model(problem)

    @property
    def passes(self) -> tuple[Any, ...]:
        """The part that all loops have."""
        return (
            self.start, self.x_hat, self.x_hats, *self.law, *self.go, *self.come, *self.back, *self.model
        )  # fmt: skip

    def value_functions(self) -> dict[str, Any]:
        """Cost-to-go, cost-to-come and inverse law of the last passes, as `assemble` takes them."""
        if not self.dual:
            inverse = self.back[2], self.back[3]
            return {"cost_to_go": Quadratic(*self.go), "cost_to_come": Quadratic(*self.come), "inverse_law": inverse}
        covariance, mean, _ = self.come
        inverse = None
        if not self.fixed:  # or the first covariances are singular
            # u = gain costate + offset, where the costate at a state of arrival x is -covariance^-1 (x - mean).
            with contextlib.suppress(np.linalg.LinAlgError):
                gain = -np.linalg.solve(covariance[1:], np.swapaxes(self.back[2], 1, 2))
                gain = np.ascontiguousarray(np.swapaxes(gain, 1, 2))
                inverse = gain, self.back[3] - np.einsum("tij,tj->ti", gain, mean[1:])
        return {"cost_to_go": Quadratic(*self.go), "cost_to_come": Moments(*self.come), "inverse_law": inverse}


def _solve(problem: Problem, settings: SmootherSettings, *, each: bool, callback: Callback | None = None) -> Solution:
    """Solve; with `each`, a look after each iteration (see `iterate`)."""
    begin = resolve(settings.start, problem)
    start = np.zeros(len(problem.dynamics.state_coordinates)) if problem.start is None else problem.start.copy()
    control = begin.offset[0].copy()
    check_functions(problem, start, control)
    if settings.first_pass == "backward" and begin.gain.any():
        begin = begin.rolled_out(problem, start)
    arrays = _Arrays(problem, settings, begin, start)
    ending = _undamped(problem, settings, begin, arrays, each=each, callback=callback)
    checked = check_outcome(problem, ending, start, control, refuse=each)
    lost = checked is not ending  # a function that is not finite at the start: nothing can help
    failed = ending.status not in (Status.CONVERGED, Status.COST_CONVERGED)
    options = settings.options(begin)
    detail = checked.detail(problem.steps)
    if settings.safeguard and failed and not lost:
        why = detail or ending.status.meaning
        return _rescue(problem, settings, arrays, ending, options, why, each=each, callback=callback)
    values = {} if ending.pass_failed else arrays.value_functions()
    return assemble(
        problem, solver="smooth", options=options, status=checked.status, detail=detail, iterations=checked.iterations,
        states=arrays.states, controls=arrays.controls, law=arrays.kept, **values,
    )  # fmt: skip


def _undamped(
    problem: Problem,
    settings: SmootherSettings,
    begin: Start,
    arrays: _Arrays,
    *,
    each: bool,
    callback: Callback | None,
) -> Ending:
    """The method of the paper."""
    core = compiled.core(problem, settings.form)
    log = np.zeros((settings.max_iterations, LOG_COLUMNS))
    options = (
        settings.max_iterations, settings.tolerance, settings.gap_tolerance, settings.stop == "optimal",
        arrays.fixed, begin.trajectory is not None and settings.first_pass == "forward",
    )  # fmt: skip
    more = (
        *arrays.prior, *arrays.guess, *arrays.plan, arrays.states, arrays.controls, *arrays.kept, arrays.memory, log
    )  # fmt: skip
    loop = core.entry("smoother_iterations", problem.steps, 0, 0, *options, *arrays.passes, *more)
    if settings.first_pass == "backward":
        loop(problem.steps, 0, 0, *options, *arrays.passes, *more)  # where the start leads, before it is forgotten
        p, dt, _, stage, final = arrays.model
        failed, good = core.opening_pass(
            problem.steps, begin.trajectory is not None, *arrays.guess, *arrays.law, *arrays.go, p, dt, stage, final,
            *arrays.prior[:2],
        )  # fmt: skip
        if failed >= 0:
            return Ending((), interface.NOT_POSITIVE_DEFINITE if good else interface.NOT_FINITE, True, failed, "")
    return iterate(
        problem,
        lambda first, last: loop(problem.steps, first, last, *options, *arrays.passes, *more),
        log, settings.max_iterations, each=each, callback=callback,
    )  # fmt: skip


def _rescue(
    problem: Problem,
    settings: SmootherSettings,
    arrays: _Arrays,
    ending: Ending,
    options: dict[str, object],
    why: str,
    *,
    each: bool,
    callback: Callback | None,
) -> Solution:
    """The safeguard: iterations from the best plan so far."""
    core = compiled.core(problem, settings.form)
    log = np.zeros((settings.max_iterations, LOG_COLUMNS))
    stops = (
        settings.max_iterations, settings.tolerance, settings.gap_tolerance, settings.stop == "optimal", arrays.fixed
    )  # fmt: skip
    arrays.memory[interface.REACH], arrays.memory[interface.ILQR_NEXT] = 1.0, 2.0
    trial = np.zeros_like(arrays.states), np.zeros_like(arrays.controls)
    more = *arrays.no_prior, *arrays.plan, *trial, arrays.memory, log
    loop = core.entry("damped_iterations", problem.steps, 0, 0, *stops, *arrays.passes, *more)
    damped = iterate(
        problem,
        lambda first, last: loop(problem.steps, first, last, *stops, *arrays.passes, *more),
        log, settings.max_iterations, before=ending.iterations, each=each, callback=callback,
    )  # fmt: skip
    found: dict[str, Any] = {"solver": "smooth", "options": options, "iterations": damped.iterations}
    detail = f"the undamped method failed ({why})"
    if not np.isfinite(arrays.memory[interface.PLAN_COST]):
        # Nothing that was tried leads anywhere. What is left is how it failed.
        return assemble(
            problem, status=ending.status, detail=detail, states=arrays.states, controls=arrays.controls,
            law=arrays.kept, **found,
        )  # fmt: skip
    status = damped.status
    if damped.outcome == interface.STALLED:
        status, detail = ending.status, f"{detail}; from the best plan, no step lowers the cost any more"
    found["states"], found["controls"] = arrays.plan
    if not np.isfinite(damped.iterations[-1].optimality):  # there is no model about the plan, nor a policy
        law = np.zeros_like(arrays.law[0]), arrays.plan[1].copy()
        return assemble(problem, status=status, detail=detail, law=law, **found)
    values = arrays.value_functions()
    gap = arrays.memory[interface.FINAL_GAP]
    if not gap < settings.gap_tolerance:
        # As from iLQR, whose steps need neither of these.
        values["cost_to_come"] = values["inverse_law"] = None
        detail += f"; the states of least total cost are {gap:.1g} off the plan, so the cost-to-come is left out"
    return assemble(problem, status=status, detail=detail, law=arrays.law, **found, **values)

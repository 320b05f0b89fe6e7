"""Iterated LQR smoothing: Sec. V of the paper, in its primal form."""

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.errors import InputError
from lqrsim.problem import FixedState, Problem
from lqrsim.results import Quadratic, Solution, Status
from lqrsim.solvers.common import Callback, Log, Settings, Workspace, assemble, predicted_decrease


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
    if isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start);"
            " ilqr() takes a FixedState"
        )
    n, steps = len(problem.dynamics.state_coordinates), problem.steps
    start = problem.start if problem.start is not None else np.zeros(n)
    core, data = compiled.core(problem), compiled.arguments(problem)
    work = Workspace.of(problem, start, settings.controls(problem))
    prior_about, no_prior = np.zeros((steps + 1, n)), np.zeros(n)
    if problem.prior is not None:
        prior_about[:] = problem.prior.about
    iteration = (
        work.x_hat, work.x_hats, work.L, work.l, work.S, work.s, work.k,
        work.Lbar, work.lbar, work.Sbar, work.sbar, work.kbar, *_model(data),
    )  # fmt: skip
    # What there is if not even the first iteration is completed: the initial controls and where they lead.
    states, controls = work.states.copy(), work.controls.copy()
    core.rollout(start, work.L, work.l, *_model(data), states, controls)
    compiled.prepare(core.smoother_iteration, *iteration, no_prior, prior_about, work.states, work.controls)
    compiled.prepare(core.initial_decrease, start, data["initial"], work.S[0], work.s[0])
    predicted_decrease(core, data, states, controls, soft=True)  # compiled before the clock starts, too
    log = Log(settings, callback)
    law, detail, status = (work.L.copy(), work.l.copy()), "", None
    while status is None:
        prior = problem.prior is not None and len(log.iterations) < problem.prior.iterations
        prior_weight = problem.prior.weight.copy() if problem.prior is not None and prior else no_prior
        failed, backward, finite, cost, gap = core.smoother_iteration(
            *iteration, prior_weight, prior_about, work.states, work.controls
        )
        if failed >= 0:
            status = Status.NOT_POSITIVE_DEFINITE if finite else Status.NOT_FINITE
            which = "backward" if backward else "forward"
            detail = f"{which} pass of iteration {len(log.iterations) + 1}, step {failed} of {steps}"
            break

        def optimality(cost: float = cost) -> float:
            left = predicted_decrease(core, data, work.states, work.controls, soft=True)
            return left / max(abs(cost), np.finfo(float).tiny)

        status = log.add(cost, gap, optimality)
        law = work.L.copy(), work.l.copy()
        states, controls = work.states.copy(), work.controls.copy()
    whole = not detail
    return assemble(
        problem, solver="smooth", settings=settings, status=status, detail=detail, log=log,
        states=states, controls=controls, law=law, inverse_law=(work.Lbar, work.lbar) if whole else None,
        cost_to_go=Quadratic(work.S, work.s, work.k) if whole else None,
        cost_to_come=Quadratic(work.Sbar, work.sbar, work.kbar) if whole else None,
    )  # fmt: skip


def _model(data: dict) -> tuple:
    return data["p"], data["dt"], data["initial"], data["stage"], data["final"]

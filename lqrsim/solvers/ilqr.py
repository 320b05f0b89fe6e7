"""Iterative LQR with line search: the baseline that the paper compares with."""

from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.errors import Array, InputError
from lqrsim.problem import Problem
from lqrsim.results import Quadratic, Solution, Status
from lqrsim.solvers.common import Callback, Log, Settings, Workspace, assemble, predicted_decrease

# Far outside an arena costs reach 1e20, and rounding takes the backward pass its positive-definite matrices. Then, and
# only then, changes of the controls get a weight; it falls again by the same steps.
_LEAST_DAMPING, _MOST_DAMPING = 1.0, 1e25


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
    if problem.start is None:
        raise InputError(
            "initial: got a cost that names no start, want FixedState(x) or QuadraticCost(weight, about=x)"
        )
    core, data = compiled.core(problem), compiled.arguments(problem)
    costs = data["initial"], data["stage"], data["final"]
    work = Workspace.of(problem, problem.start, settings.controls(problem))
    cost = core.rollout(work.x_hat, work.L, work.l, data["p"], data["dt"], *costs, work.states, work.controls)
    states, controls = work.states, work.controls
    new_states, new_controls = states.copy(), controls.copy()
    relative = np.zeros_like(work.l)
    search = work.L, relative, data["p"], data["dt"], *costs
    compiled.prepare(core.line_search, states, controls, *search, cost, new_states, new_controls)
    _backward(core, data, states, controls, 0.0, work, relative)  # compiled before the clock starts, too
    log = Log(settings, callback, first_cost=cost)
    status = Status.NOT_FINITE if not np.isfinite(cost) else None
    detail = "rollout of the initial controls" if status else ""
    damping = 0.0
    while status is None:
        damping *= 0.1
        failed, finite = _backward(core, data, states, controls, damping, work, relative)
        while failed >= 0 and finite and damping < _MOST_DAMPING:
            damping = max(10 * damping, _LEAST_DAMPING)
            failed, finite = _backward(core, data, states, controls, damping, work, relative)
        if failed >= 0:
            status = Status.NOT_POSITIVE_DEFINITE if finite else Status.NOT_FINITE
            detail = f"backward pass of iteration {len(log.iterations) + 1}, step {failed} of {problem.steps}"
            break
        damping = damping if damping > _LEAST_DAMPING else 0.0
        cost, fraction = core.line_search(states, controls, *search, cost, new_states, new_controls)
        if fraction > 0:
            states, new_states, controls, new_controls = new_states, states, new_controls, controls

        def optimality(states: Array = states, controls: Array = controls, cost: float = cost) -> float:
            left = predicted_decrease(core, data, states, controls, soft=False)
            return left / max(abs(cost), np.finfo(float).tiny)

        status = log.add(cost, 0.0, optimality)
        if status is None and fraction == 0:
            status, detail = Status.MAX_ITERATIONS, "the line search found no lower cost"
    # One more backward pass, so that the policy and its cost-to-go are about the trajectory that was found.
    whole = _backward(core, data, states, controls, 0.0, work, relative)[0] < 0
    offset = controls - np.einsum("tij,tj->ti", work.L, states[:-1])
    return assemble(
        problem, solver="ilqr", settings=settings, status=status, detail=detail, log=log,
        states=states, controls=controls, law=(work.L, offset), inverse_law=None,
        cost_to_go=Quadratic(work.S, work.s, work.k) if whole else None, cost_to_come=None,
    )  # fmt: skip


def _backward(
    core: ModuleType,
    data: dict[str, Any],
    states: Array,
    controls: Array,
    damping: float,
    work: Workspace,
    relative: Array,
) -> tuple[int, bool]:
    """The backward pass about a trajectory; the step at which it failed or -1, and whether all was finite there."""
    failed, finite, _ = core.differential_pass(
        states, controls, data["p"], data["dt"], data["stage"], data["final"], damping,
        work.L, relative, work.S, work.s, work.k,
    )  # fmt: skip
    return failed, finite

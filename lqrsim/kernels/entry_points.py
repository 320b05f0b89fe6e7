"""The functions that Python calls: one for each solver and method, single passes and rollouts.

All code that a solve can need is compiled together, before the solve begins. Code that its parts share is compiled
once.
"""

from math import inf

from lqrsim.kernels.active_set import active_set as active_set
from lqrsim.kernels.certificate import certify, reduced_curvature
from lqrsim.kernels.cost_to_come import riccati_forward, smoothed_state
from lqrsim.kernels.declarations import (
    CERTIFY,
    CURVE,
    DESCEND,
    EVALUATE,
    LINEARIZE,
    RUNNING,
    M,
    N,
    W,
    stack,
    zeros,
)
from lqrsim.kernels.interior_point import interior_point as interior_point
from lqrsim.kernels.iterations import (
    descend,
    ilqr_iterations,
    measure_optimality,
    relative_optimality,
    smoother_iterations,
)
from lqrsim.kernels.linear_algebra import copy, copy_matrix, fill
from lqrsim.kernels.passes import ilqr_pass
from lqrsim.kernels.passes import opening_pass as opening_pass
from lqrsim.kernels.passes import rollout as rollout
from lqrsim.kernels.records import Limits, LinearStep, QuadraticStage
from lqrsim.kernels.restoration import restoration as restoration
from lqrsim.kernels.riccati import riccati_backward
from lqrsim.kernels.stages import adjoint as adjoint
from lqrsim.kernels.stages import determine_scales as determine_scales
from lqrsim.kernels.stages import evaluate_plan as evaluate_plan
from lqrsim.kernels.stages import least_curvatures as least_curvatures
from lqrsim.kernels.stages import read_rows as read_rows
from lqrsim.kernels.stages import write_models as write_models


def smoother(task, first, stop, settings, model, work, memory, log):
    """Run one task of the smoother: iterate, descend, or linearise, certify or measure a plan.

    Args:
      task: one of ITERATE, DESCEND; LINEARIZE, to compute policy and value functions about the best plan; CERTIFY,
        to certify the last policy and rollout with the Hessians of the cost-to-go; EVALUATE, the same with the Hessians
        of the cost of following the policy, which replace those of the cost-to-go; or CURVE, to measure the curvature
        of the cost about the last rollout.
      first, stop: iterations to run, `stop` excluded. The rest are records.
    """
    if task == CURVE:
        reduced_curvature(settings, work.last, model, work.certificate[0])
        return 0, 0, False, -1
    if task >= CERTIFY:
        certify(settings, task == EVALUATE, work.last, work.last_policy, work.to_go, model, work.certificate[0])
        return 0, 0, False, -1
    if task == LINEARIZE:
        measure_optimality(settings, False, False, model, work, memory[0], log[0])
        return 0, RUNNING, memory[0].failed >= 0, int(memory[0].failed)
    if task == DESCEND:
        return descend(first, stop, settings, model, work, memory[0], log)
    return smoother_iterations(first, stop, settings, model, work, memory[0], log)


def ilqr(task, first, stop, settings, model, work, memory, log):
    """Run iterations of iLQR; or linearise about the plan, or certify a plan, as `smoother` does.

    DESCEND and CURVE are not among its tasks.
    """
    if task >= CERTIFY:
        certify(settings, task == EVALUATE, work.last, work.last_policy, work.to_go, model, work.certificate[0])
        return 0, 0, False, -1
    if task == LINEARIZE:
        failed, _, decrease = ilqr_pass(settings.steps, work.best, model, 0.0, work.policy, work.to_go)
        log[0].optimality = relative_optimality(failed, decrease, memory[0].plan_cost, 0.0)
        return 0, RUNNING, failed >= 0, failed
    return ilqr_iterations(first, stop, settings, model, work, memory[0], log)


def lq_passes(steps, dynamics, forward_steps, stages, constants, work):
    """Both passes of a linear-quadratic problem, and its smoothed states.

    Args:
      dynamics: LinearStep, [A B] (T, N, W) and c (T, N).
      forward_steps: steps of the forward pass: inverse steps in the primal form, `dynamics` in the dual form.
      stages: QuadraticStage, (T, W, W) and (T, W). constants: (T,).
      work: RiccatiArrays, with the cost-to-go at T and the cost-to-come at 0.

    Returns:
      The step that failed, or -1; and 0 if it was in the backward pass, 1 in the forward pass, 2
      where the two value functions were added.
    """
    stage, costate, anywhere = QuadraticStage(stack(W, W), stack(W)), stack(N), zeros(N)
    limits = Limits(stack(M), stack(M))
    fill(limits.low, M, -inf)
    fill(limits.high, M, inf)
    for t in range(steps - 1, -1, -1):
        copy_stage(t, stages, stage)
        step = LinearStep(dynamics.jacobian[t], dynamics.offset[t])
        if not riccati_backward(t, step, stage, constants[t], anywhere, limits, work.policy, work.to_go):
            return t, 0
    for t in range(steps):
        copy_stage(t, stages, stage)
        step = LinearStep(forward_steps.jacobian[t], forward_steps.offset[t])
        if not riccati_forward(t, step, stage, constants[t], work.to_come, work.smoothing):
            return t, 1
    for t in range(steps + 1):
        if not smoothed_state(t, work.to_go, work.to_come, costate, work.x_hats[t]):
            return t, 2
    return -1, 0


def copy_stage(t, stages, stage):
    """Copy a stage, because the Riccati steps overwrite theirs."""
    copy_matrix(stages.hessian[t], W, W, stage.hessian)
    copy(stages.gradient[t], W, stage.gradient)

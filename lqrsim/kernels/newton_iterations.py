"""Newton's method from the plan that smoothing has found. Written in the kernels' subset.

A pass is the backward pass of differential dynamic programming. It differs from iLQR's pass in two ways: the Hessians
of the costs are not projected, and the Hessians of the dynamics times the costate are added. If a control block is not
positive definite, the pass is repeated with a smaller fraction of these second-order terms, down to none, which is
iLQR's pass. Near an optimum with enough curvature, convergence is quadratic.
"""

from math import isnan, nan

from lqrsim.kernels.damped_iterations import update_plan_cost, value_functions_at_plan
from lqrsim.kernels.declarations import (
    CONVERGED,
    MAX_ITERATIONS,
    NEWTON,
    NOISY,
    REJECTED,
    RUNNING,
    STALLED,
    M,
    N,
    stack,
)
from lqrsim.kernels.iterations import failure, relative_improvement, relative_optimality, write_row
from lqrsim.kernels.linear_algebra import copy, fill
from lqrsim.kernels.records import CostToGo, ModelOrder
from lqrsim.kernels.rollouts import copy_plan, differential_pass, ilqr_pass, initial_step, line_search

# Fractions of the second-order terms, tried in this order until a pass has a minimum.
SHARES = (1.0, 0.97, 0.9, 0.75, 0.5, 0.0)
ARMIJO = 1e-4  # fraction of the predicted decrease that a step must achieve
# Smallest fractions of a step that the line search tries: usually, and of patient steps without second-order terms. A
# projected model knows nothing of where a cost saturates, so its steps may be too long by orders of magnitude.
SMALLEST, LEAST = 1e-3, 1e-8
ROUNDING = 1e-12  # rounding error of a merit, relative to the merit
SMALL, WEIGHTS = 1e-10, 8  # first weight on control changes, relative to the merit; number of weights, each times 1000
MORE = 3  # largest number of further steps while the smoothed states are not at the plan


def newton_iterations(first, last, settings, model, work, memory, log):
    """Newton steps from the plan, each of which lowers its merit.

    If no fraction of a step lowers the merit, the step is repeated without second-order terms. If that also fails, the
    method has stalled. At the end, the value functions are computed as in smoothing, without second-order terms. They
    are convex, so that the minimum of their sum is at the plan. If it is not, up to MORE further steps follow: in flat
    directions a plan may be far off although the predicted decrease is small.

    Args:
      settings: IterationSettings. model: ProblemModel. work: SmootherArrays, with the plan.
      memory: row of MEMORY, with the plan's cost and merit; its share is negative until a pass about the plan was made.
      log: rows of LOG. An iteration's optimality is the decrease that the next step predicts.

    Returns:
      As `iterations.py` says.
    """
    steps, plan, shift = settings.steps, work.best, stack(N)
    if memory.share < 0:
        memory.share, memory.small_changes = 1.0, 0.0
        good = newton_pass(settings, model, work, memory)
        if memory.failed >= 0:
            return first, failure(good, model), True, int(memory.failed)
        if first < last and memory.promised < settings.tolerance:
            write_row(log[first], memory.plan_cost, 0.0, 0.0, memory.promised, nan, NEWTON)
            if finish_at_plan(settings, model, work, memory, log[first]):
                return first + 1, CONVERGED, False, -1
    for done in range(first, last):
        for i in range(N):
            shift[i] = work.x_hat[i] - plan.states[0, i]
        bound, wanted = memory.merit + ROUNDING * abs(memory.merit), ARMIJO * memory.decrease
        smallest = SMALLEST
        if memory.share == 0 and memory.patient > 0:
            wanted, smallest = 0.0, LEAST
        merit, cost, fraction = line_search(steps, shift, work, model, bound, wanted, smallest, work.last)
        outcome = RUNNING
        if fraction > 0:
            improvement = relative_improvement(memory.merit, merit, memory.negligible)
            copy_plan(steps, work.last, plan)
            memory.plan_cost, memory.merit, memory.share = cost, merit, 1.0
            write_row(log[done], cost, improvement, 0.0, nan, nan, NEWTON)
        else:
            write_row(log[done], memory.plan_cost, 0.0, 0.0, nan, nan, REJECTED)
            outcome = RUNNING if memory.share > 0 else STALLED
            memory.share = 0.0
        good = newton_pass(settings, model, work, memory)
        if memory.failed >= 0:
            return done + 1, failure(good, model), True, int(memory.failed)
        log[done].cost, log[done].optimality = memory.plan_cost, memory.promised
        if memory.promised < settings.tolerance and finish_at_plan(settings, model, work, memory, log[done]):
            return done + 1, CONVERGED, False, -1
        if outcome == STALLED and memory.promised < settings.tolerance:  # the rest is rounding
            outcome = CONVERGED
        if outcome == RUNNING and done + 1 == settings.max_iterations:
            outcome = MAX_ITERATIONS
        if outcome != RUNNING:
            convex_value_functions(settings, model, work, memory, log[done])
            return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def newton_pass(settings, model, work, memory):
    """A pass about the plan, with the largest fraction of second-order terms, up to the memory's, that has a minimum.

    If even convex models have no minimum, for example if a control costs nothing, changes of the controls get a weight.

    Args:
      work: SmootherArrays. The policy is written, relative to the plan; `x_hat` is also written, if the start is to
        move. The second-order cost-to-go takes the place of the cost-to-come.
      memory: `share`, `damping`, `failed`, `decrease`, `promised` and `negligible` are written.

    Returns:
      Whether all numbers were finite.
    """
    begin, failed, good, left, plan, shift = memory.share, -1, True, nan, work.best, stack(N)
    second = CostToGo(work.to_come.matrix, work.to_come.vector, work.to_come.constant)
    if NOISY:  # the cost of noise is weighed with the cost-to-go of smoothing
        failed, good, _ = ilqr_pass(settings.steps, plan, model, 0.0, work.last_policy, work.to_go)
        memory.failed = failed
        if failed >= 0:
            return good
        update_plan_cost(settings.steps, model, work, memory)
    for k in range(len(SHARES) + WEIGHTS):
        share, damping = 0.0, 0.0
        if k < len(SHARES):
            share = SHARES[k]
        else:
            damping = SMALL * max(abs(memory.merit), SMALL) * 1e3 ** (k - len(SHARES))
        if share <= begin:
            order = ModelOrder(damping, share, work.to_go)
            failed, good, left = differential_pass(settings.steps, plan, model, order, 1, work.policy, second)
            copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
            if failed < 0 and not settings.fixed:
                left += initial_step(plan.states[0], model, share, second, shift)
                for i in range(N):
                    work.x_hat[i] += shift[i]
                if isnan(left):
                    failed = 0
            memory.failed, memory.share, memory.damping = failed, share, damping
            if failed < 0 or not good:
                break
    size = 0.0
    for t in range(settings.steps + 1):
        size = max(size, abs(second.constant[t]))
    memory.negligible = 1e-26 * size
    memory.decrease = 2 * left
    memory.promised = relative_optimality(failed, left, memory.merit, max(memory.negligible, memory.least))
    return good


def finish_at_plan(settings, model, work, memory, row):
    """Compute the policy and value functions at the plan; return False, after another pass, if these need a step."""
    convex_value_functions(settings, model, work, memory, row)
    if memory.final_gap < settings.gap_tolerance or memory.small_changes >= MORE:
        return True
    memory.small_changes += 1
    newton_pass(settings, model, work, memory)
    return False


def convex_value_functions(settings, model, work, memory, row):
    """Compute the value functions about the plan without second-order terms, and a policy that reproduces the plan.

    A control at a limit gets no gain, even if the next step would move it off the limit by less than the tolerance.
    """
    policy, controls = work.policy, work.best.controls
    if not NOISY:
        ilqr_pass(settings.steps, work.best, model, memory.damping, work.last_policy, work.to_go)
    value_functions_at_plan(settings, model, work, memory, row)
    for t in range(settings.steps):
        for i in range(M):
            if controls[t, i] == model.limits.low[i] or controls[t, i] == model.limits.high[i]:
                policy.offset[t, i] = controls[t, i]
                fill(policy.gain[t, i], N, 0.0)

"""Newton's method from a plan: down the valley that smoothing has found, to its bottom. The kernels' subset.

A pass is that of iLQR with models of second order: the Hessians of costs as they are, not projected, and that of the
dynamics times the costate (differential dynamic programming). Where it finds a control with nothing to gain from being
finite, it is done again with a smaller share of the second order, down to none, which is iLQR's. About an optimum with
enough curvature, the plan's error is squared in each iteration.
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
from lqrsim.kernels.passes import copy
from lqrsim.kernels.records import CostToGo, ModelOrder
from lqrsim.kernels.rollouts import copy_plan, differential_pass, initial_step, line_search

# The shares that are tried where a pass with more of the second order has no minimum.
SHARES = (1.0, 0.97, 0.9, 0.75, 0.5, 0.0)
ARMIJO = 1e-4  # of the decrease that a step promises, what there has to be of it
SMALLEST = 1e-3  # part of a step
ROUNDING = 1e-12  # of a merit
SMALL, WEIGHTS = 1e-10, 8  # of the merit, a weight on changes of controls; how many are tried, in thousands
MORE = 3  # steps at most, while the states of least total cost are not at the plan


def newton_iterations(first, last, settings, model, work, memory, log):
    """Newton steps from the plan, whose cost and merit are in the memory, each of which lowers its merit.

    A share below 0 in the memory is for a plan about which there was no pass yet. A row of the log tells of the plan
    after the step, its optimality included: what the next step promises. A step of which no part lowers the merit is
    tried once more without the second order; then it has stalled.

    The policy is, at the end, the one of the last pass. The value functions are about the plan, and those of smoothing,
    without the second order: convex, so that their sum has its minimum at the plan. Where it is not there yet, some
    more steps are made: in flat directions a plan may be far off though there is negligible to gain.
    """
    steps, plan, shift = settings.steps, work.plan, stack(N)
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
        merit, cost, fraction = line_search(steps, shift, work, model, bound, wanted, SMALLEST, work.rollout)
        outcome = RUNNING
        if fraction > 0:
            improvement = relative_improvement(memory.merit, merit, memory.negligible)
            copy_plan(steps, work.rollout, plan)
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
            value_functions(settings, model, work, memory, log[done])
            return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def newton_pass(settings, model, work, memory):
    """A pass about the plan, with as much of the second order as the memory allows and has a minimum.

    Writes to the memory the share it had, the decrease of cost that it promises, also relative to the merit, and the
    step at which it failed, or -1; to `work.x_hat` where the start is to move. Returns whether all numbers were finite.
    The cost-to-go of second order is in the place of the cost-to-come.
    """
    steps, plan, shift, begin = settings.steps, work.plan, stack(N), memory.share
    failed, good, left = -1, True, nan
    second = CostToGo(work.to_come.matrix, work.to_come.vector, work.to_come.constant)
    if NOISY:  # what noise costs is what smoothing takes it to cost
        failed, good, _ = differential_pass(
            steps, plan, model, ModelOrder(0.0, 0.0, work.to_go), 1, work.kept, work.to_go
        )
        memory.failed = failed
        if failed >= 0:
            return good
        update_plan_cost(steps, model, work, memory)
    for k in range(len(SHARES)):
        share = SHARES[k]
        if share <= begin:
            order = ModelOrder(0.0, share, work.to_go)
            failed, good, left = differential_pass(steps, plan, model, order, 1, work.policy, second)
            copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
            if failed < 0 and not settings.fixed:
                left += initial_step(plan.states[0], model, share, second, shift)
                for i in range(N):
                    work.x_hat[i] += shift[i]
                if isnan(left):
                    failed = 0
            memory.failed, memory.share, memory.damping = failed, share, 0.0
            if failed < 0 or not good:
                break
    if failed >= 0 and good:
        failed, left = damped_pass(settings, model, work, memory, second)
    size = 0.0
    for t in range(steps + 1):
        size = max(size, abs(second.constant[t]))
    memory.negligible = 1e-26 * size
    memory.decrease = 2 * left
    memory.promised = relative_optimality(failed, left, memory.merit, memory.negligible)
    return good


def damped_pass(settings, model, work, memory, second):
    """A pass where not even convex models have a minimum, as where a control costs negligible: with the least weight on
    changes of the controls, of some, with which they have. Returns as a pass does, without whether numbers are finite.
    """
    steps, plan, shift, damping, failed, left = settings.steps, work.plan, stack(N), 0.0, 0, nan
    for k in range(WEIGHTS):
        damping = SMALL * max(abs(memory.merit), SMALL) * 1e3**k
        order = ModelOrder(damping, 0.0, work.to_go)
        failed, good, left = differential_pass(steps, plan, model, order, 1, work.policy, second)
        copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
        if failed < 0 and not settings.fixed:
            left += initial_step(plan.states[0], model, 0.0, second, shift)
            for i in range(N):
                work.x_hat[i] += shift[i]
            if isnan(left):
                failed = 0
        if failed < 0 or not good:
            break
    memory.failed, memory.damping = failed, damping
    return failed, left


def finish_at_plan(settings, model, work, memory, row):
    """Make policy and value functions of the answer; whether it is one. If not, there is a pass to go on with."""
    value_functions(settings, model, work, memory, row)
    if memory.final_gap < settings.gap_tolerance or memory.small_changes >= MORE:
        return True
    memory.small_changes += 1
    newton_pass(settings, model, work, memory)
    return False


def value_functions(settings, model, work, memory, row):
    """Make those of the plan, without the second order; the policy becomes one that makes the plan.

    A control at a limit has no gain, be it one that the next step would take off it, by less than counts.
    """
    policy, controls = work.policy, work.plan.controls
    if not NOISY:
        order = ModelOrder(memory.damping, 0.0, work.to_go)
        differential_pass(settings.steps, work.plan, model, order, 1, work.kept, work.to_go)
    value_functions_at_plan(settings, model, work, memory, row)
    for t in range(settings.steps):
        for i in range(M):
            if controls[t, i] == model.limits.low[i] or controls[t, i] == model.limits.high[i]:
                policy.offset[t, i] = controls[t, i]
                for j in range(N):
                    policy.gain[t, i, j] = 0.0

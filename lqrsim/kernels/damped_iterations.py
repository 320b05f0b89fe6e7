"""The safeguard: damped LQR smoothing near the best plan so far, for when undamped smoothing fails.

Written in the kernels' subset. Rollouts on the way to an optimum can cost any multiple of the first, so a rising cost
does not mean that the method will fail. It runs undamped until a pass fails or the lowest cost no longer falls; see
`no_progress`. Damped iterations are to LQR smoothing what Levenberg-Marquardt is to Gauss-Newton.
"""

from math import inf, isnan, nan

from lqrsim.kernels.declarations import (
    DAMPED,
    IDLE,
    ILQR,
    MAX_ITERATIONS,
    NOISY,
    PATIENCE,
    REJECTED,
    ROUNDING,
    RUNNING,
    STALLED,
    M,
    N,
    stack,
)
from lqrsim.kernels.iterations import outcome_of, relative_improvement, relative_optimality, write_row
from lqrsim.kernels.linear_algebra import copy
from lqrsim.kernels.passes import backward_pass, forward_pass, smoothed_states
from lqrsim.kernels.records import Linearization
from lqrsim.kernels.rollouts import (
    copy_plan,
    dynamics_residual,
    ilqr_pass,
    initial_step,
    largest_gap,
    line_search,
    plan_cost,
    policy_about_plan,
    shorten_step,
)


def damped_iterations(first, last, settings, model, work, memory, log):
    """Iterations from the best plan so far that never raise its merit: the cost plus the augmented Lagrangian.

    The forward pass linearises about the plan, the backward pass a fraction `reach` of the way from the plan to the
    smoothed states, and a line search by halves follows the new policy. If a tenth of the step does not lower the
    merit, the next iteration reaches less far. At reach 0 both passes linearise about the plan, and the step is iLQR's:
    a descent direction, unless the plan is stationary or rounding spoils the matrices. If it fails, changes of the
    controls (and of a soft start) get a weight in both passes, relative to the cost's own curvature, which grows
    tenfold until it helps. After many iterations without convergence, reach 0 is also used, each time for twice as
    long.

    A small change of cost can come from a short step, so two in a row are required. Then one more undamped pass about
    the plan measures its optimality, and computes the policy and the value functions of the answer. If the merit falls
    only by rounding in IDLE steps in a row, as at a kink of the dynamics, the method has stalled.

    Arguments and results are as for `smoother_iterations`.
    """
    for done in range(first, last):
        reach = memory.reach
        merit, cost, fraction, negligible = damped_step(settings, model, work, memory)
        full = done + 1 == settings.max_iterations
        if fraction > 0:
            improvement = relative_improvement(memory.merit, merit, negligible)
            shorten_step(settings.steps, fraction, work.best, work.x_hats)
            # At reach 0, as in iLQR, the models are about a rollout, which has no gap.
            gap = largest_gap(settings.steps, work.x_hats, work.last.states) if reach > 0 else 0.0
            copy_plan(settings.steps, work.last, work.best)
            memory.plan_cost, memory.merit = cost, merit
            small = abs(improvement) < settings.tolerance and (gap < settings.gap_tolerance or not settings.optimal)
            memory.small_changes = memory.small_changes + 1 if small else 0.0
            memory.idle = memory.idle + 1 if improvement < ROUNDING else 0.0
            stalled = memory.idle >= IDLE
            settled = stalled or memory.small_changes > 1
            relax_damping(memory, fraction)
            write_row(log[done], cost, improvement, gap, nan, nan, DAMPED if reach > 0 else ILQR)
        else:
            tighten_damping(memory)
            settled = stalled = memory.weight > 1e12
            write_row(log[done], memory.plan_cost, 0.0, nan, nan, nan, REJECTED)
        if settled or full:
            outcome, _ = relinearize(settings, settled, negligible, model, work, memory, log[done])
            if outcome == RUNNING and (stalled or full):
                outcome = STALLED if stalled else MAX_ITERATIONS
            if outcome != RUNNING:
                return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def damped_step(settings, model, work, memory):
    """Both passes and the line search.

    Returns:
      The new merit, the new cost, the fraction of the step that was taken, and the negligible cost.
    """
    shift, reach = stack(N), memory.reach
    merit, cost, fraction, negligible = inf, inf, 0.0, 0.0
    copy(work.start if settings.fixed else work.best.states[0], N, work.x_hat)
    about = Linearization(work.best, True, reach, memory.weight, work.prior)
    failed, _ = forward_pass(settings, model, about, work)
    if failed < 0:
        failed, _, negligible = backward_pass(settings, model, about, work)
    if failed < 0:
        for i in range(N):
            shift[i] = work.x_hat[i] - work.best.states[0, i]
        policy_about_plan(settings.steps, work.best, work.policy)
        if NOISY:  # with the new policy's cost-to-go
            update_plan_cost(settings.steps, model, work, memory)
        smallest = 0.1 if reach > 0 else 1e-8
        bound = memory.merit + 1e-12 * abs(memory.merit)  # differences by rounding are accepted
        merit, cost, fraction = line_search(settings.steps, shift, work, model, bound, 0.0, smallest, work.last)
    return merit, cost, fraction, negligible


def update_plan_cost(steps, model, work, memory):
    """Evaluate the plan's expected cost and merit with the latest cost-to-go."""
    cost, added = plan_cost(steps, work.best, model, work.to_go)
    memory.plan_cost, memory.merit = cost, cost + added


def relax_damping(memory, fraction):
    """Adapt weight and reach after an iteration that lowered the merit with that fraction of its step."""
    if memory.weight > 0:
        memory.weight = 0.1 * memory.weight if memory.weight > 1e-6 else 0.0
    elif memory.reach > 0:
        if fraction == 1:
            memory.reach = min(2 * memory.reach, 1.0)
        memory.since_ilqr += 1
        if memory.since_ilqr > PATIENCE:
            turn_to_ilqr(memory)
    else:
        memory.ilqr_left -= 1
        memory.reach = 0.25 if memory.ilqr_left <= 0 else 0.0


def tighten_damping(memory):
    """Adapt weight and reach after an iteration that did not lower the merit."""
    if memory.reach > 0.25:
        memory.reach = 0.25
    elif memory.reach > 0:
        turn_to_ilqr(memory)
    else:
        memory.weight = max(10 * memory.weight, 1e-3)


def turn_to_ilqr(memory):
    """Set reach to 0 for a while, each time for twice as long."""
    memory.reach, memory.since_ilqr = 0.0, 0.0
    memory.ilqr_left = memory.ilqr_next
    memory.ilqr_next *= 2


def relinearize(settings, settled, negligible, model, work, memory, row):
    """Compute policy and value functions about the plan, undamped; write optimality and residual to the log's row.

    Returns:
      The outcome, and the step that failed, or -1.
    """
    steps, plan, policy, to_go, shift = settings.steps, work.best, work.policy, work.to_go, stack(N)
    failed, _, left = ilqr_pass(steps, plan, model, 0.0, policy, to_go)
    if failed >= 0:
        return RUNNING, failed
    if NOISY:
        update_plan_cost(steps, model, work, memory)
        row.cost = memory.plan_cost
    if not settings.fixed:
        left += initial_step(plan.states[0], model, 0.0, to_go, shift)
    row.optimality = left = relative_optimality(failed, left, memory.merit, negligible)
    value_functions_at_plan(settings, model, work, memory, row)
    return outcome_of(settled and left < settings.tolerance, settings, left, memory.plan_cost, False), -1


def value_functions_at_plan(settings, model, work, memory, row):
    """Complete a backward pass about the plan: a policy that reproduces the plan, and the cost-to-come.

    Writes the residual to the log's row, and the gap between smoothed states and plan to the memory: if the dynamics
    are unstable, rounding can spoil the cost-to-come while the rest is right.
    """
    steps, plan, policy = settings.steps, work.best, work.policy
    copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
    failed, _ = forward_pass(settings, model, Linearization(plan, True, 1.0, 0.0, work.prior), work)
    memory.final_gap = inf
    if failed < 0 and smoothed_states(steps, work.to_go, work.to_come, work.x_hats):
        memory.final_gap = largest_gap(steps, work.x_hats, plan.states)
    # The forward pass left x_hat at T; the next iteration begins at the start.
    copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
    for t in range(steps):
        for i in range(M):
            policy.offset[t, i] = plan.controls[t, i]
            for j in range(N):
                policy.offset[t, i] -= policy.gain[t, i, j] * plan.states[t, j]
    row.residual = dynamics_residual(steps, work.x_hats, policy, model, plan.states)
    if isnan(row.gap):  # the iteration was rejected
        row.gap = 0.0

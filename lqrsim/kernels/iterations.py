"""Iterations of LQR smoothing and of iLQR, all in compiled code.

Each function, as `descend` of `descent.py`, runs the iterations `first` to `last` - 1, and can be called again to
continue, because its state is in its arrays. The log gets a row per iteration. All return four values: the number of
iterations so far, the outcome (a name in `declarations.py`), whether a failed pass was the backward one, and
the step at which it failed, or -1.
"""

from math import inf, isnan, nan

from lqrsim.kernels.declarations import (
    CONVERGED,
    COST_CONVERGED,
    CYCLING,
    DIVERGED,
    ILQR,
    IN_VALLEY,
    LINGER,
    LONGEST_CYCLE,
    MAX_ITERATIONS,
    NO_FALL,
    NO_PROGRESS,
    NO_START,
    NOISY,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    RISK_TOO_HIGH,
    RUNNING,
    SLOW_FALL,
    SMOOTH,
    STALLED,
    M,
    N,
    stack,
    zeros,
)
from lqrsim.kernels.linear_algebra import copy
from lqrsim.kernels.passes import backward_pass, forward_pass
from lqrsim.kernels.records import CostToGo, Linearization, ModelOrder, Policy, Prior, ProblemModel
from lqrsim.kernels.rollouts import (
    copy_plan,
    copy_policy,
    ddp_pass,
    dynamics_residual,
    ilqr_pass,
    initial_step,
    largest_gap,
    line_search,
    noise_cost,
    plan_cost,
    rollout,
)


def relative_improvement(old, cost, negligible):
    """The decrease of cost relative to the new cost; 0 if it did not change, -inf if the cost is not finite.

    Costs below `negligible` are rounding errors about zero, and would never settle.
    """
    if not abs(cost) < inf:
        return -inf
    return 0.0 if old == cost else (old - cost) / max(abs(cost), negligible)


def smoother_iterations(first, last, settings, model, work, memory, log):
    """Iterated LQR smoothing: a forward pass, a backward pass and the rollout of the new policy in each iteration.

    It ends where, asked in this order,
      1. a pass fails;
      2. the gap is below `settings.valley`: IN_VALLEY;
      3. cost and gap have settled: COST_CONVERGED, or CONVERGED if the rollout is optimal, too;
      4. there were `settings.max_iterations`: MAX_ITERATIONS, or DIVERGED without a finite cost;
      5. the costs repeat, CYCLING; or, if `memory.watched`, they no longer fall, or the gap does not: NO_PROGRESS.

    Args:
      settings: IterationSettings. model: ProblemModel. memory, log: rows of MEMORY and LOG.
      work: SmootherArrays. Policy and cost-to-go are what to begin with. `last` and `last_policy` are those of the
        last complete iteration, and before any those of the first policy. `best` is the rollout of lowest cost so far,
        the first policy's included, and `memory.plan_cost` its cost: for the safeguard.

    With `last` of 0, only the first policy is rolled out.
    """
    no_weight, steps, fixed, x_hat = zeros(N), settings.steps, settings.fixed, work.x_hat
    scaled = ProblemModel(
        model.dynamics, model.dt, model.initial, work.homotopy_scaled, model.final, model.limits, model.noise
    )
    if memory.started == 0:
        memory.started, memory.plan_cost = 1.0, inf
        roll_out_and_keep(steps, work.start, model, work, memory)
        copy(work.start, N, x_hat)
        if settings.guided and not fixed:
            copy(work.given.states[0], N, x_hat)
    for done in range(first, last):
        if fixed:  # whatever ran before, each pass begins at the given start
            copy(work.start, N, x_hat)
        weight = work.prior.weight if done < settings.prior_iterations else no_weight
        guided = settings.guided and done == 0
        about = Linearization(work.given, guided, 1.0, 0.0, Prior(weight, work.prior.about))
        failed, good = forward_pass(settings, scaled, about, work)
        if failed >= 0:
            return done, failure(good, model), False, failed
        failed, good, negligible = backward_pass(settings, scaled, about, work)
        if failed >= 0:
            return done, failure(good, model), True, failed
        memory.negligible = negligible
        if NOISY and done == 0 and memory.plan_cost > -inf:  # the cost-to-go of the first policy was unknown
            memory.plan_cost, _ = plan_cost(steps, work.best, model, work.to_go)
        cost = roll_out_and_keep(steps, x_hat, model, work, memory)
        improvement = relative_improvement(log[done - 1].cost if done > 0 else inf, cost, negligible)
        gap = largest_gap(steps, work.x_hats, work.last.states)
        met = gap < settings.gap_tolerance or not settings.optimal
        cost_converged = abs(improvement) < settings.tolerance and met
        full = done + 1 == settings.max_iterations
        left, residual = nan, nan
        if gap < settings.valley and improvement >= 0 and not full:
            write_row(log[done], cost, improvement, gap, left, residual, SMOOTH)
            return done + 1, IN_VALLEY, False, -1
        if cost_converged or full:
            left = optimality(settings, work.last, model, cost, negligible)
            residual = dynamics_residual(steps, work.x_hats, work.policy, model, work.last.states)
        write_row(log[done], cost, improvement, gap, left, residual, SMOOTH)
        outcome = outcome_of(cost_converged, settings, left, cost, full)
        if outcome == RUNNING and cycling(log, done):
            outcome = CYCLING
        if outcome == RUNNING and memory.watched > 0 and (no_progress(log, done) or lingering(log, done, settings)):
            outcome = NO_PROGRESS
        if outcome != RUNNING:
            return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def roll_out_and_keep(steps, start, model, work, memory):
    """Run the policy, and keep it with its rollout. The rollout of lowest cost is the plan. Returns the cost."""
    cost = rollout(steps, start, work.policy, model, work.last)
    if NOISY:
        cost += noise_cost(steps, work.last, model, work.to_go)
    copy_policy(steps, work.policy, work.last_policy)
    if cost < memory.plan_cost:
        memory.plan_cost = cost
        copy_plan(steps, work.last, work.best)
    return cost


def failure(good, model):
    """The outcome of a pass that failed, given whether all numbers in it were finite."""
    if NOISY and model.noise.risk[1] > 0:
        return RISK_TOO_HIGH
    return NOT_POSITIVE_DEFINITE if good else NOT_FINITE


def cycling(log, done):
    """Whether the costs repeat, up to rounding; they then always will.

    A cycle must repeat twice; a cycle that the iterations still approach does not count. A constant cost is also a
    cycle: iterations that have not converged by then never will.
    """
    same = done >= 5
    for i in range(5):
        if same:
            same = abs(log[done - i].cost - log[done - i - 1].cost) <= 1e-12 * abs(log[done].cost)
    if same:
        return True
    for period in range(2, LONGEST_CYCLE + 1):
        same = done + 1 >= 3 * period
        for i in range(2 * period):
            if same:
                cost, before = log[done - i].cost, log[done - i - period].cost
                same = abs(cost - before) <= 1e-9 * abs(cost)
        if same and abs(log[done].cost - log[done - 1].cost) > 1e-6 * abs(log[done].cost):
            return True
    return False


def no_progress(log, done):
    """Whether the lowest cost has not fallen for NO_FALL iterations, or by less than a thousandth for SLOW_FALL.

    A rising cost is no sign of failure, because the method passes through worse rollouts on its way. Costs that
    oscillate, creep or stay infinite are a sign.
    """
    least, reference, since, slow = inf, inf, 0, 0
    for i in range(done + 1):
        cost = log[i].cost
        since, slow = since + 1, slow + 1
        if abs(cost) < inf and cost < least:
            least = cost
            since = 0
        if not least < inf:
            since = 0
        if least < reference - 1e-3 * abs(reference) or (least < inf and not reference < inf):
            reference, slow = least, 0
    return since >= NO_FALL or slow >= SLOW_FALL


def lingering(log, done, settings):
    """Whether the cost has settled for LINGER iterations, in which the gap has not halved.

    States of least cost then swing to and fro about the rollout, as where the dynamics curve; damped iterations do not.
    """
    if done < LINGER or log[done].gap < settings.gap_tolerance:
        return False
    for i in range(LINGER):
        if not abs(log[done - i].improvement) < settings.tolerance:
            return False
    return log[done].gap > 0.5 * log[done - LINGER].gap


def optimality(settings, plan, model, cost, negligible):
    """The decrease that iLQR's model about a trajectory predicts, relative to its cost; infinite if its pass fails."""
    policy, to_go = Policy(stack(1, M, N), stack(1, M)), CostToGo(stack(1, N, N), stack(1, N), stack(1))
    shift = stack(N)
    failed, _, left = ddp_pass(settings.steps, plan, model, ModelOrder(0.0, 0.0, to_go), 0, policy, to_go)
    if not settings.fixed:
        left += initial_step(plan.states[0], model, 0.0, to_go, shift)
    return relative_optimality(failed, left, cost, negligible)


def write_row(row, cost, improvement, gap, left, residual, method):
    """Write a row of the log."""
    row.cost, row.improvement, row.gap = cost, improvement, gap
    row.optimality, row.residual, row.method = left, residual, method


def relative_optimality(failed, decrease, cost, negligible):
    """A predicted decrease relative to the cost; infinite if the pass that predicts it failed."""
    if failed >= 0 or not decrease < inf or not abs(cost) < inf:
        return inf
    return decrease / max(abs(cost), negligible, 1e-300)


def outcome_of(cost_converged, settings, left, cost, full):
    """The outcome of an iteration, given whether its cost settled, its optimality, and whether it was the last."""
    if cost_converged and not settings.optimal:
        return COST_CONVERGED
    if cost_converged and left < settings.tolerance:
        return CONVERGED
    if full:
        return MAX_ITERATIONS if abs(cost) < inf else DIVERGED
    return RUNNING


def ilqr_iterations(first, last, settings, model, work, memory, log):
    """Iterative LQR: a backward pass about a feasible trajectory and a line search in each iteration.

    Far outside an arena costs reach 1e20, and rounding makes the backward pass's matrices indefinite. Only then do
    changes of the controls get a weight, which falls again by the same factor.

    Args:
      settings: IterationSettings. model: ProblemModel.
      work: SmootherArrays. The policy makes the first trajectory. Afterwards the plan is the best trajectory, with the
        policy relative to it and the cost-to-go about it.
      memory: row of MEMORY, with the plan's cost and the weight.
    """
    steps, policy, plan, to_go = settings.steps, work.policy, work.best, work.to_go
    no_shift = zeros(N)
    if first == 0:
        cost = rollout(steps, work.start, policy, model, plan)
        memory.plan_cost = cost
        if not abs(cost) < inf:
            return 0, NO_START, False, -1
    cost, damping = memory.plan_cost, memory.weight
    for done in range(first, last):
        damping *= 0.1
        failed, good, _ = ilqr_pass(steps, plan, model, damping, policy, to_go)
        while failed >= 0 and good and damping < 1e25:
            damping = max(10 * damping, 1.0)
            failed, good, _ = ilqr_pass(steps, plan, model, damping, policy, to_go)
        if failed >= 0:
            return done, failure(good, model), True, failed
        if not damping > 1.0:
            damping = 0.0
        if NOISY:  # with the new policy's cost-to-go
            cost, _ = plan_cost(steps, plan, model, to_go)
        old = cost
        cost, _, fraction = line_search(steps, no_shift, work, model, old, 0.0, 1e-8, work.last)
        if fraction > 0:
            copy_plan(steps, work.last, plan)
        improvement = relative_improvement(old, cost, 0.0)
        cost_converged = abs(improvement) < settings.tolerance
        left = nan
        if cost_converged or done + 1 == settings.max_iterations:
            failed, _, left = ilqr_pass(steps, plan, model, 0.0, policy, to_go)
            if NOISY:
                cost, _ = plan_cost(steps, plan, model, to_go)
            left = relative_optimality(failed, left, cost, 0.0)
        memory.plan_cost, memory.weight = cost, damping
        write_row(log[done], cost, improvement, 0.0, left, 0.0, ILQR)
        outcome = outcome_of(cost_converged, settings, left, cost, done + 1 == settings.max_iterations)
        if outcome == RUNNING and fraction == 0:
            outcome = STALLED
        if outcome != RUNNING:
            if isnan(left):  # policy and cost-to-go are not yet computed about the trajectory that was found
                failed, _, _ = ilqr_pass(steps, plan, model, 0.0, policy, to_go)
            return done + 1, outcome, failed >= 0, failed
    return last, RUNNING, False, -1

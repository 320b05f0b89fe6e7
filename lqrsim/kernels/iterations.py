"""Iterations of LQR smoothing and of iLQR, and a descent, all in compiled code.

Python calls `smoother` and `ilqr`, and functions that are imported here for it, such as the certificate's. All code
that a solve can need is compiled together, before the solve begins. Code that its parts share is compiled once.

`smoother_iterations`, `ilqr_iterations` and `descend` run the iterations `first` to `stop` - 1, and can be called again
to continue, because their state is in their arrays. The log gets a row per iteration. They return four values: the
number of iterations so far, the outcome (a name in `declarations.py`), whether a failed pass was the backward one, and
the step at which it failed, or -1.

A descent takes steps from a plan that lower its merit: the cost plus the augmented Lagrangian. Newton's method and
damped smoothing are one loop, `descend`; a `Descent` says which.

Newton's steps are from the backward pass of differential dynamic programming about the plan. It does not project the
Hessians of the costs, and adds the Hessians of the dynamics times the costate. If such a model has no minimum, the pass
is repeated with less of these second-order terms, down to none, which is iLQR's pass, and then with growing weights
on changes of the controls. Near an optimum with enough curvature, convergence is quadratic.

Damped smoothing is the safeguard, for when undamped smoothing fails. Rollouts on the way to an optimum can cost any
multiple of the first, so a rising cost does not mean that the method will fail: it runs undamped until a pass fails or
the lowest cost no longer falls; see `no_progress`. Damped iterations are to LQR smoothing what Levenberg-Marquardt is
to Gauss-Newton. The forward pass linearises about the plan, the backward pass a fraction `reach` of the way from the
plan to the smoothed states. If a tenth of the step does not lower the merit, the next iteration reaches less far. At
reach 0 both passes linearise about the plan, and the step is iLQR's: a descent direction, unless the plan is stationary
or rounding spoils the matrices. If it fails, changes of the controls (and of a soft start) get a weight in both passes,
relative to the cost's own curvature, which grows tenfold until it helps. After many iterations without convergence,
reach 0 is also used, each time for twice as long.
"""

from math import inf, isnan, nan

from lqrsim.kernels.certificate import certify, reduced_curvature
from lqrsim.kernels.declarations import (
    CERTIFY,
    CONVERGED,
    COST_CONVERGED,
    CURVE,
    CYCLING,
    DAMPED,
    DESCEND,
    DIVERGED,
    EVALUATE,
    ILQR,
    IN_VALLEY,
    LINEARIZE,
    LINGER,
    LONGEST_CYCLE,
    MAX_ITERATIONS,
    MIXES,
    NEWTON,
    NO_FALL,
    NO_PROGRESS,
    NO_START,
    NOISY,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    REJECTED,
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
from lqrsim.kernels.linear_algebra import copy, fill
from lqrsim.kernels.passes import (
    backward_pass,
    copy_plan,
    copy_policy,
    ddp_pass,
    dynamics_residual,
    forward_pass,
    ilqr_pass,
    initial_step,
    largest_gap,
    line_search,
    noise_cost,
    plan_cost,
    policy_about_plan,
    rollout,
    smoothed_states,
    towards,
)
from lqrsim.kernels.passes import opening_pass as opening_pass
from lqrsim.kernels.records import CostToGo, Descent, Linearization, ModelOrder, Policy, Prior, ProblemModel

# A small change of cost can come from a short step, so two in a row are required. At a kink of the dynamics damped
# steps may lower the merit by rounding for ever.
DAMPED_STEPS = Descent(DAMPED, changes=2, idle=12.0, reach=1.0, smallest=0.1, lightest=1e-3, factor=10.0, heaviest=1e12)
# Weights are rarely needed, but then by unknown orders of magnitude: 8 span 21 of them.
NEWTON_STEPS = Descent(
    NEWTON, changes=0, second_order=1.0, smallest=1e-3, armijo=1e-4, weights=8, lightest=1e-10, factor=1e3,
    patient=False,
)  # fmt: skip
# Smallest fraction of a step of a convex model about the plan. Such a model knows nothing of where a cost saturates, so
# its steps may be too long by orders of magnitude.
SHORTEST = 1e-8
RISE = 1e-12  # rise of the merit, relative to it, that counts as rounding
NEAR = 0.25  # least reach above 0
# After a success, the weight on changes of the controls is multiplied by WEIGHT_DECAY, and dropped once it is at most
# NEGLIGIBLE_WEIGHT.
WEIGHT_DECAY, NEGLIGIBLE_WEIGHT = 0.1, 1e-6
PATIENCE = 50  # number of steps at a reach above 0 after which iLQR's are tried
ROUNDING = 1e-11  # relative improvement that may be rounding
MAX_EXTRA_STEPS = 3  # largest number of further steps of Newton's method while the smoothed states are not at the plan


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


def relative_improvement(old, cost, negligible):
    """The decrease of cost relative to the new cost; 0 if it did not change, -inf if the cost is not finite.

    Costs below `negligible` are rounding errors about zero, and would never settle.
    """
    if not abs(cost) < inf:
        return -inf
    return 0.0 if old == cost else (old - cost) / max(abs(cost), negligible)


def smoother_iterations(first, stop, settings, model, work, memory, log):
    """Iterated LQR smoothing: a forward pass, a backward pass and the rollout of the new policy in each iteration.

    It ends with the first of these that holds:
      1. a pass fails;
      2. the gap is below `settings.valley`, the cost did not rise, and more iterations may follow: IN_VALLEY;
      3. the cost has settled: COST_CONVERGED without `settings.optimal`; with it CONVERGED, if the gap has, too, and
         the rollout is optimal;
      4. `settings.max_iterations` are done: MAX_ITERATIONS, or DIVERGED without a finite cost;
      5. the costs repeat, CYCLING; or, if `memory.watched`, they no longer fall, or the gap does not: NO_PROGRESS.

    Args:
      settings: IterationSettings. model: ProblemModel. memory, log: rows of MEMORY and LOG.
      work: SmootherArrays. Policy and cost-to-go are what to begin with. `last` and `last_policy` are those of the
        last complete iteration, and before any those of the first policy. `best` is the rollout of lowest cost so far,
        the first policy's included, and `memory.plan_cost` its cost: for the safeguard.

    With `stop` of 0, only the first policy is rolled out.
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
            copy(work.guess.states[0], N, x_hat)
    for done in range(first, stop):
        if fixed:  # whatever ran before, each pass begins at the given start
            copy(work.start, N, x_hat)
        weight = work.prior.weight if done < settings.prior_iterations else no_weight
        guided = settings.guided and done == 0
        about = Linearization(work.guess, guided, 1.0, 0.0, Prior(weight, work.prior.about))
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
        optimality, residual = nan, nan
        if gap < settings.valley and improvement >= 0 and not full:
            write_row(log[done], cost, improvement, gap, optimality, residual, SMOOTH)
            return done + 1, IN_VALLEY, False, -1
        if cost_converged or full:
            optimality = optimality_of(settings, work.last, model, cost, negligible)
            residual = dynamics_residual(steps, work.x_hats, work.policy, model, work.last.states)
        write_row(log[done], cost, improvement, gap, optimality, residual, SMOOTH)
        outcome = outcome_of(cost_converged, settings, optimality, cost, full)
        if outcome == RUNNING and cycling(log, done):
            outcome = CYCLING
        if outcome == RUNNING and memory.watched > 0 and (no_progress(log, done) or lingering(log, done, settings)):
            outcome = NO_PROGRESS
        if outcome != RUNNING:
            return done + 1, outcome, False, -1
    return stop, RUNNING, False, -1


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


def optimality_of(settings, plan, model, cost, negligible):
    """The decrease that iLQR's model about a trajectory predicts, relative to its cost; infinite if its pass fails."""
    policy, to_go = Policy(stack(1, M, N), stack(1, M)), CostToGo(stack(1, N, N), stack(1, N), stack(1))
    shift = stack(N)
    failed, _, decrease = ddp_pass(settings.steps, plan, model, ModelOrder(0.0, 0.0, to_go), 0, policy, to_go)
    if not settings.fixed:
        decrease += initial_step(plan.states[0], model, 0.0, to_go, shift)
    return relative_optimality(failed, decrease, cost, negligible)


def write_row(row, cost, improvement, gap, optimality, residual, method):
    """Write a row of the log."""
    row.cost, row.improvement, row.gap = cost, improvement, gap
    row.optimality, row.residual, row.method = optimality, residual, method


def relative_optimality(failed, decrease, cost, negligible):
    """A predicted decrease relative to the cost; infinite if the pass that predicts it failed."""
    if failed >= 0 or not decrease < inf or not abs(cost) < inf:
        return inf
    return decrease / max(abs(cost), negligible, 1e-300)


def outcome_of(cost_converged, settings, optimality, cost, full):
    """The outcome of an iteration, given whether its cost settled, its optimality, and whether it was the last."""
    if cost_converged and not settings.optimal:
        return COST_CONVERGED
    if cost_converged and optimality < settings.tolerance:
        return CONVERGED
    if full:
        return MAX_ITERATIONS if abs(cost) < inf else DIVERGED
    return RUNNING


def ilqr_iterations(first, stop, settings, model, work, memory, log):
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
    for done in range(first, stop):
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
        cost, _, fraction = line_search(steps, no_shift, work, model, old, 0.0, SHORTEST)
        if fraction > 0:
            copy_plan(steps, work.last, plan)
        improvement = relative_improvement(old, cost, 0.0)
        cost_converged = abs(improvement) < settings.tolerance
        optimality = nan
        if cost_converged or done + 1 == settings.max_iterations:
            failed, _, decrease = ilqr_pass(steps, plan, model, 0.0, policy, to_go)
            if NOISY:
                cost, _ = plan_cost(steps, plan, model, to_go)
            optimality = relative_optimality(failed, decrease, cost, 0.0)
        memory.plan_cost, memory.weight = cost, damping
        write_row(log[done], cost, improvement, 0.0, optimality, 0.0, ILQR)
        if fraction == 0 and not optimality < settings.tolerance:  # the cost did not change for want of a step
            cost_converged = False
        outcome = outcome_of(cost_converged, settings, optimality, cost, done + 1 == settings.max_iterations)
        if outcome == RUNNING and fraction == 0:
            outcome = STALLED
        if outcome != RUNNING:
            if isnan(optimality):  # policy and cost-to-go are not yet computed about the trajectory that was found
                failed, _, _ = ilqr_pass(steps, plan, model, 0.0, policy, to_go)
            return done + 1, outcome, failed >= 0, failed
    return stop, RUNNING, False, -1


# A descent.


def descend(first, stop, settings, model, work, memory, log):
    """Iterations from the plan: a step, a line search and, once the cost has settled, a pass that judges the plan.

    They end where the plan is optimal, CONVERGED or COST_CONVERGED; where nothing is left to try, or the merit falls by
    rounding alone, STALLED; where there were `settings.max_iterations`; or, unless the steps are damped, where a pass
    fails.

    Args:
      settings: IterationSettings, with the Descent. model: ProblemModel. log: rows of LOG.
      work: SmootherArrays, with the plan, `best`.
      memory: row of MEMORY, after `Workspace.begin_descent`.
    """
    how, damped, plan = settings.descent, settings.descent.method == DAMPED, work.best
    for done in range(first, stop):
        reach, known = memory.reach, memory.known > 0
        if damped:
            good = smoothing_step(settings, model, work, memory)
        else:
            good = known or newton_step(settings, model, work, memory)
        if memory.failed >= 0 and not damped:
            return done, failure(good, model), True, int(memory.failed)
        if not damped and not known and memory.relative_decrease < settings.tolerance:  # there is nothing to do
            write_row(log[done], memory.plan_cost, 0.0, 0.0, nan, nan, NEWTON)
            if measure_optimality(settings, True, False, model, work, memory, log[done]) != RUNNING:
                return done + 1, CONVERGED, False, -1
        merit, cost, fraction = memory.merit, memory.plan_cost, 0.0
        if memory.failed < 0:
            merit, cost, fraction = follow_step(settings, model, work, memory)
        improvement, gap, method = 0.0, 0.0, how.method
        cost_converged, exhausted, full = how.changes == 0, False, done + 1 == settings.max_iterations
        if fraction > 0:
            improvement = relative_improvement(memory.merit, merit, memory.negligible)
            if reach > 0:
                for t in range(settings.steps + 1 if fraction < 1 else 0):
                    towards(work.x_hats[t], fraction, plan.states[t], N)
                gap = largest_gap(settings.steps, work.x_hats, work.last.states)
            elif damped:  # the models are about a rollout, which has no gap
                method = ILQR
            copy_plan(settings.steps, work.last, plan)
            memory.plan_cost, memory.merit = cost, merit
            small = abs(improvement) < settings.tolerance and (gap < settings.gap_tolerance or not settings.optimal)
            memory.small_changes = memory.small_changes + 1 if small else 0.0
            memory.idle = memory.idle + 1 if improvement < ROUNDING else 0.0
            cost_converged, exhausted = memory.small_changes >= how.changes, memory.idle >= how.idle
            relax(how, memory, fraction)
        else:
            exhausted, method = tighten(how, memory), REJECTED
            gap = nan if damped else 0.0
        write_row(log[done], memory.plan_cost, improvement, gap, nan, nan, method)
        if cost_converged or exhausted or full:
            settled, ending = cost_converged or exhausted, exhausted or full
            outcome = measure_optimality(settings, settled, ending, model, work, memory, log[done])
            if outcome == RUNNING and ending:
                outcome = STALLED if exhausted else MAX_ITERATIONS
            if outcome != RUNNING:
                return done + 1, outcome, memory.failed >= 0, int(memory.failed)
    return stop, RUNNING, False, -1


def smoothing_step(settings, model, work, memory):
    """Find a step by both passes of smoothing: write its policy, relative to the plan, and where it begins to `x_hat`.

    If a pass fails, `memory.failed` is the step at which it did, else -1. Returns whether all numbers in the
    passes were finite.
    """
    copy(work.start if settings.fixed else work.best.states[0], N, work.x_hat)
    about, negligible = Linearization(work.best, True, memory.reach, memory.weight, work.prior), 0.0
    failed, good = forward_pass(settings, model, about, work)
    if failed < 0:
        failed, good, negligible = backward_pass(settings, model, about, work)
    if failed < 0:
        policy_about_plan(settings.steps, work.best, work.policy)
        if NOISY:  # with the new policy's cost-to-go
            update_plan_cost(settings.steps, model, work, memory)
    memory.failed, memory.negligible = failed, negligible
    return good


def newton_step(settings, model, work, memory):
    """Find a step by a pass about the plan, with the least regularisation that gives a minimum.

    The rest is as in `smoothing_step`. The ladder of regularisation has the shares of second-order terms, from the
    memory's down to none, and then the weights on changes of the controls. The second-order cost-to-go takes the place
    of the cost-to-come.
    """
    how, failed, good, decrease, second_order, size = settings.descent, -1, True, nan, 0.0, 0.0
    second = CostToGo(work.to_come.matrix, work.to_come.vector, work.to_come.constant)
    if NOISY:  # the cost of noise is weighed with the cost-to-go of smoothing
        order = ModelOrder(0.0, 0.0, work.to_go)
        failed, good, _ = pass_about_plan(settings, order, model, work, work.last_policy, work.to_go)
        memory.failed = failed
        if failed >= 0:
            return good
        update_plan_cost(settings.steps, model, work, memory)
    damping, lightest = 0.0, how.lightest * max(abs(memory.merit), how.lightest)
    for k in range(len(MIXES) + how.weights):
        if k < len(MIXES):
            second_order = 1 - MIXES[k]
        else:
            damping = max(how.factor * damping, lightest)
        if second_order <= memory.second_order:
            order = ModelOrder(damping, second_order, work.to_go)
            failed, good, decrease = pass_about_plan(settings, order, model, work, work.policy, second)
            if failed < 0 and isnan(decrease) and not settings.fixed:  # the start has no minimum
                failed = 0
            if failed < 0 or not good:
                break
    memory.failed, memory.known = failed, 1.0 if failed < 0 else 0.0
    memory.second_order, memory.damping = second_order, damping
    for t in range(settings.steps + 1):
        size = max(size, abs(second.constant[t]))
    memory.negligible, memory.decrease = settings.rounding * size, 2 * decrease
    negligible = max(memory.negligible, memory.least)
    memory.relative_decrease = relative_optimality(failed, decrease, memory.merit, negligible)
    return good


def pass_about_plan(settings, order, model, work, policy, to_go):
    """`ddp_pass` about the plan, and the step of a soft start, which is written to `x_hat`.

    Returns:
      The step at which it failed, or -1; whether all numbers were finite; and the decrease of cost that it predicts,
      NaN if the start has no minimum.
    """
    plan, shift = work.best, stack(N)
    failed, good, decrease = ddp_pass(settings.steps, plan, model, order, 1, policy, to_go)
    copy(work.start if settings.fixed else plan.states[0], N, work.x_hat)
    if failed < 0 and not settings.fixed:
        decrease += initial_step(plan.states[0], model, order.second_order, to_go, shift)
        for i in range(N):
            work.x_hat[i] += shift[i]
    return failed, good, decrease


def update_plan_cost(steps, model, work, memory):
    """Evaluate the plan's expected cost and merit with the latest cost-to-go."""
    cost, added = plan_cost(steps, work.best, model, work.to_go)
    memory.plan_cost, memory.merit = cost, cost + added


def follow_step(settings, model, work, memory):
    """Follow the step as far as it lowers the merit; return the new merit and cost, and the fraction, 0 for none."""
    how, shift, bound = settings.descent, stack(N), memory.merit + RISE * abs(memory.merit)
    for i in range(N):
        shift[i] = work.x_hat[i] - work.best.states[0, i]
    if memory.reach == 0 and memory.second_order == 0 and how.patient:
        return line_search(settings.steps, shift, work, model, bound, 0.0, SHORTEST)
    slope = how.armijo * memory.decrease
    return line_search(settings.steps, shift, work, model, bound, slope, how.smallest)


def relax(how, memory, fraction):
    """Regularise less after an iteration that lowered the merit with that fraction of its step."""
    memory.second_order, memory.known = how.second_order, 0.0
    if memory.weight > 0:
        memory.weight = WEIGHT_DECAY * memory.weight if memory.weight > NEGLIGIBLE_WEIGHT else 0.0
    elif memory.reach > 0:
        if fraction == 1:
            memory.reach = min(2 * memory.reach, 1.0)
        memory.since_ilqr += 1
        if memory.since_ilqr > PATIENCE:
            turn_to_ilqr(memory)
    elif how.method == DAMPED:
        memory.ilqr_left -= 1
        memory.reach = NEAR if memory.ilqr_left <= 0 else 0.0


def tighten(how, memory):
    """Regularise more after an iteration that did not lower the merit; return whether there is nothing left to try."""
    memory.known = 0.0
    if memory.second_order > 0:
        memory.second_order = 0.0
    elif memory.reach > NEAR:
        memory.reach = NEAR
    elif memory.reach > 0:
        turn_to_ilqr(memory)
    else:
        memory.weight = max(how.factor * memory.weight, how.lightest)
    return memory.weight > how.heaviest


def turn_to_ilqr(memory):
    """Set reach to 0 for a while, each time for twice as long."""
    memory.reach, memory.since_ilqr = 0.0, 0.0
    memory.ilqr_left = memory.ilqr_next
    memory.ilqr_next *= 2


def measure_optimality(settings, cost_converged, ending, model, work, memory, row):
    """Measure the plan's optimality; compute policy and value functions about it. CONVERGED if optimal, else RUNNING.

    For Newton's method, the pass that measures it also provides the next step. Value functions are computed only when
    the method ends, without second-order terms, so that they are convex. The minimum of their sum should then be at the
    plan. If it is not, up to MAX_EXTRA_STEPS further steps follow, because in flat directions a plan may be far off
    although the predicted decrease is small.
    """
    how = settings.descent
    if how.method == DAMPED:
        order = ModelOrder(0.0, 0.0, work.to_go)
        failed, _, decrease = pass_about_plan(settings, order, model, work, work.policy, work.to_go)
        if NOISY and failed < 0:
            update_plan_cost(settings.steps, model, work, memory)
        memory.failed = failed
        negligible = max(memory.negligible, memory.least)
        memory.relative_decrease = relative_optimality(failed, decrease, memory.merit, negligible)
    elif memory.known == 0:
        newton_step(settings, model, work, memory)
    if memory.failed >= 0:
        return RUNNING
    row.cost, row.optimality = memory.plan_cost, memory.relative_decrease
    optimal = cost_converged and memory.relative_decrease < settings.tolerance
    if how.method == DAMPED:
        value_functions_at_plan(settings, model, work, memory, row)
    elif optimal or ending:
        convex_value_functions(settings, model, work, memory, row)
        if not ending and not memory.final_gap < settings.gap_tolerance and memory.extra_steps < MAX_EXTRA_STEPS:
            memory.extra_steps += 1
            newton_step(settings, model, work, memory)
            optimal = False
    if not optimal:
        return RUNNING
    return CONVERGED if settings.optimal else COST_CONVERGED


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


def convex_value_functions(settings, model, work, memory, row):
    """Compute the value functions about the plan without second-order terms, and a policy that reproduces the plan.

    A control at a limit gets no gain, even if the next step would move it off the limit by less than the tolerance.
    """
    policy, controls = work.policy, work.best.controls
    if not NOISY:
        order = ModelOrder(memory.damping, 0.0, work.to_go)
        ddp_pass(settings.steps, work.best, model, order, 1, work.last_policy, work.to_go)
    value_functions_at_plan(settings, model, work, memory, row)
    for t in range(settings.steps):
        for i in range(M):
            if controls[t, i] == model.limits.low[i] or controls[t, i] == model.limits.high[i]:
                policy.offset[t, i] = controls[t, i]
                fill(policy.gain[t, i], N, 0.0)

"""The iterations of the solvers, with nothing but compiled code between them. The numba subset; see `interface.py`.

Each function runs the iterations `first` to `last` - 1 and can be called again to go on: what it needs to remember is
in its arrays. `log` (any, 6) gets a row an iteration: cost, relative improvement, gap, optimality and dynamics residual
(NaN where they were not worked out), method. All return how many iterations there are now, the outcome (a name in
`interface.py`), and for a pass that failed whether it was the backward one and its step, else -1.
"""

from math import inf, isnan, nan

from lqrsim.kernels.interface import (
    CONVERGED,
    COST_CONVERGED,
    CYCLING,
    DIVERGED,
    ILQR,
    LONGEST_CYCLE,
    MAX_ITERATIONS,
    NO_FALL,
    NO_PROGRESS,
    NO_START,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    PLAN_COST,
    RUNNING,
    SLOW_FALL,
    SMOOTH,
    STALLED,
    STARTED,
    WATCHED,
    M,
    N,
    stack,
)
from lqrsim.kernels.passes import backward_pass, copy, forward_pass
from lqrsim.kernels.rollouts import (
    differential_pass,
    dynamics_residual,
    initial_step,
    keep_law,
    keep_plan,
    largest_gap,
    line_search,
    rollout,
)


def relative_improvement(old, cost, nothing):
    """The decrease of cost relative to what is left; 0 for no change, at a cost of zero too; infinite if the cost is.

    Costs below `nothing` are zero but for rounding: what there is of them never settles.
    """
    if not abs(cost) < inf:
        return -inf
    return 0.0 if old == cost else (old - cost) / max(abs(cost), nothing)


def smoother_iterations(
    steps, first, last, max_iterations, tolerance, gap_tolerance, optimal, fixed, guided,
    start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
    eased, prior_weight, prior_about, prior_iterations, guess_x, guess_u, plan_x, plan_u,
    states, controls, kept_L, kept_l, memory, log,
):  # fmt: skip
    """Iterated LQR smoothing: a forward pass, a backward pass and the rollout of the new policy, again and again.

    L, l, S, s are the policy and the cost-to-go to begin with; `eased` is the stage cost as the passes see it, which is
    not yet the true one in the first iterations of a continuation. With `guided`, the first pass linearises about the
    guess. `states`, `controls`, `kept_L`, `kept_l` are what the last iteration that was completed found; before any,
    where the first policy leads. The plan is the rollout of least cost so far, that of the first policy included, and
    memory[PLAN_COST] that cost: for the safeguard. With `last` of 0, only that is begun with.
    """
    no_weight = stack(N)
    for i in range(N):
        no_weight[i] = 0.0
    if memory[STARTED] == 0:
        memory[STARTED], memory[PLAN_COST] = 1.0, inf
        cost = rollout(steps, start, L, l, p, dt, initial, stage, final, states, controls)
        keep_law(steps, L, l, kept_L, kept_l)
        if cost < inf:
            memory[PLAN_COST] = cost
            keep_plan(steps, states, controls, plan_x, plan_u)
        copy(start, N, x_hat)
        if guided and not fixed:
            copy(guess_x[0], N, x_hat)
    for done in range(first, last):
        weight = prior_weight if done < prior_iterations else no_weight
        for i in range(N):
            if fixed and x_hat[i] != start[i]:  # whatever ran before: each forward pass begins where the start is given
                x_hat[i] = start[i]
        failed, good = forward_pass(
            steps, fixed, guided and done == 0, 0.0, guess_x, guess_u,
            x_hat, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, eased, final, weight, prior_about,
        )  # fmt: skip
        if failed >= 0:
            return done, NOT_POSITIVE_DEFINITE if good else NOT_FINITE, False, failed
        failed, good, nothing = backward_pass(
            steps, fixed, 1.0, 0.0, guess_x, guess_u,
            x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, eased, weight, prior_about,
        )  # fmt: skip
        if failed >= 0:
            return done, NOT_POSITIVE_DEFINITE if good else NOT_FINITE, True, failed
        cost = rollout(steps, x_hat, L, l, p, dt, initial, stage, final, states, controls)
        keep_law(steps, L, l, kept_L, kept_l)
        if cost < memory[PLAN_COST]:
            memory[PLAN_COST] = cost
            keep_plan(steps, states, controls, plan_x, plan_u)
        improvement = relative_improvement(log[done - 1, 0] if done > 0 else inf, cost, nothing)
        gap = largest_gap(steps, x_hats, states)
        settled = abs(improvement) < tolerance and (gap < gap_tolerance or not optimal)
        full = done + 1 == max_iterations
        left, residual = nan, nan
        if settled or full:
            left = optimality(steps, fixed, states, controls, cost, nothing, p, dt, initial, stage, final)
            residual = dynamics_residual(steps, x_hats, L, l, p, dt, stage, states)
        write_row(log, done, cost, improvement, gap, left, residual, SMOOTH)
        outcome = ending(settled, optimal, left, tolerance, cost, full)
        if outcome == RUNNING and cycling(log, done):
            outcome = CYCLING
        if outcome == RUNNING and memory[WATCHED] > 0 and no_progress(log, done):
            outcome = NO_PROGRESS
        if outcome != RUNNING:
            return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def cycling(log, done):
    """Whether the last costs are, to rounding, those before them in the same order: so they will be from now on.

    Two rounds of a cycle that the iterations have come to are looked at; one that they only come nearer to is none yet.
    A cost that stays the same is one, too: where the iterations that it comes of have not converged, they never will.
    """
    same = done >= 5
    for i in range(5):
        if same:
            same = abs(log[done - i, 0] - log[done - i - 1, 0]) <= 1e-12 * abs(log[done, 0])
    if same:
        return True
    for period in range(2, LONGEST_CYCLE + 1):
        same = done + 1 >= 3 * period
        for i in range(2 * period):
            if same:
                cost, before = log[done - i, 0], log[done - i - period, 0]
                same = abs(cost - before) <= 1e-9 * abs(cost)
        if same and abs(log[done, 0] - log[done - 1, 0]) > 1e-6 * abs(log[done, 0]):
            return True
    return False


def no_progress(log, done):
    """Whether the least cost so far has not fallen for NO_FALL iterations, or next to nothing for SLOW_FALL.

    Costs that rise are no sign: the method passes through them on its way. Costs that swing about, or creep, are, and
    costs that stay infinite.
    """
    least, reference, since, slow = inf, inf, 0, 0
    for i in range(done + 1):
        cost = log[i, 0]
        since, slow = since + 1, slow + 1
        if abs(cost) < inf and cost < least:
            least = cost
            since = 0
        if not least < inf:
            since = 0
        if least < reference - 1e-3 * abs(reference) or (least < inf and not reference < inf):
            reference, slow = least, 0
    return since >= NO_FALL or slow >= SLOW_FALL


def optimality(steps, fixed, states, controls, cost, nothing, p, dt, initial, stage, final):
    """What a linear-quadratic model about a trajectory promises, relative to its cost; infinite if there is none."""
    A, B, at, slope, constant, shift = stack(1, M, N), stack(1, N, N), stack(1, M), stack(1, N), stack(1), stack(N)
    failed, _, left = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 0, A, at, B, slope, constant)
    if not fixed:
        left += initial_step(states[0], initial, B[0], slope[0], shift)
    return relative_optimality(failed, left, cost, nothing)


def write_row(log, row, cost, improvement, gap, left, residual, method):
    """Write a line of the log."""
    log[row, 0], log[row, 1], log[row, 2], log[row, 3] = cost, improvement, gap, left
    log[row, 4], log[row, 5] = residual, method


def relative_optimality(failed, decrease, cost, nothing):
    """A promised decrease relative to the cost; infinite where the pass failed that was to tell it."""
    if failed >= 0 or not decrease < inf or not abs(cost) < inf:
        return inf
    return decrease / max(abs(cost), nothing, 1e-300)


def ending(settled, optimal, left, tolerance, cost, full):
    """The outcome after an iteration whose cost did or did not settle, with that optimality left."""
    if settled and not optimal:
        return COST_CONVERGED
    if settled and left < tolerance:
        return CONVERGED
    if full:
        return MAX_ITERATIONS if abs(cost) < inf else DIVERGED
    return RUNNING


def ilqr_iterations(
    steps, first, last, max_iterations, tolerance, optimal,
    x0, L, l, S, s, k, p, dt, initial, stage, final,
    states, controls, new_states, new_controls, damping, log,
):  # fmt: skip
    """Iterative LQR: a backward pass about a feasible trajectory and a line search, again and again.

    Far outside an arena costs reach 1e20, and rounding takes the backward pass its positive-definite matrices. Then,
    and only then, changes of the controls get a weight; it falls again by the same steps.

    L, l are the policy that makes the first trajectory, from x0; afterwards `states` and `controls` are the best one,
    and L, l (relative to it), S, s, k are about it. `damping` (1,) is the weight on changes of the controls; `log` has,
    in its last row, the cost that the first iteration improves on. With `first` of `last`, there is no iteration: only
    policy and cost-to-go are made, about the trajectory as it is.
    """
    no_shift = stack(N)
    for i in range(N):
        no_shift[i] = 0.0
    if first == 0:
        cost = rollout(steps, x0, L, l, p, dt, initial, stage, final, states, controls)
        log[max_iterations, 0] = cost
        if not abs(cost) < inf:
            return 0, NO_START, False, -1
    cost = log[first - 1 if first > 0 else max_iterations, 0]
    if first == last:
        failed, _, _ = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
        return last, RUNNING, failed >= 0, failed
    for done in range(first, last):
        damping[0] *= 0.1
        failed, good, _ = differential_pass(steps, states, controls, p, dt, stage, final, damping[0], 1, L, l, S, s, k)
        while failed >= 0 and good and damping[0] < 1e25:
            damping[0] = max(10 * damping[0], 1.0)
            failed, good, _ = differential_pass(
                steps, states, controls, p, dt, stage, final, damping[0], 1, L, l, S, s, k
            )  # fmt: skip
        if failed >= 0:
            return done, NOT_POSITIVE_DEFINITE if good else NOT_FINITE, True, failed
        if not damping[0] > 1.0:
            damping[0] = 0.0
        old = cost
        cost, _, fraction = line_search(
            steps, states, controls, no_shift, L, l, p, dt, initial, stage, final, old, 1e-8, new_states, new_controls
        )
        if fraction > 0:
            keep_plan(steps, new_states, new_controls, states, controls)
        improvement = relative_improvement(old, cost, 0.0)
        settled = abs(improvement) < tolerance
        left = nan
        if settled or done + 1 == max_iterations:
            failed, _, left = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
            left = relative_optimality(failed, left, cost, 0.0)
        write_row(log, done, cost, improvement, 0.0, left, 0.0, ILQR)
        outcome = ending(settled, optimal, left, tolerance, cost, done + 1 == max_iterations)
        if outcome == RUNNING and fraction == 0:
            outcome = STALLED
        if outcome != RUNNING:
            if isnan(left):  # not worked out; but policy and cost-to-go are to be about the trajectory that was found
                failed, _, _ = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
            return done + 1, outcome, failed >= 0, failed
    return last, RUNNING, False, -1

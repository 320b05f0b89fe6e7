"""The iterations of the solvers, with nothing but compiled code between them. The numba subset; see `interface.py`.

Each function runs the iterations `first` to `last` - 1 and can be called again to go on: what it needs to remember is
in its arrays. `log` (any, 4) gets a row an iteration: cost, relative improvement, gap, optimality (NaN where it was not
worked out). Both return how many iterations there are now, the outcome (a name in `interface.py`), and for a pass that
failed whether it was the backward one and its step, else -1.
"""

from math import inf, isnan, nan

from lqrsim.solvers.interface import (
    CONVERGED,
    COST_CONVERGED,
    DIVERGED,
    MAX_ITERATIONS,
    NO_START,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    RUNNING,
    STALLED,
    M,
    N,
    stack,
)
from lqrsim.solvers.passes import (
    backward_pass,
    differential_pass,
    forward_pass,
    initial_decrease,
    largest_gap,
    line_search,
    rollout,
)

# Far outside an arena costs reach 1e20, and rounding takes iLQR's backward pass its positive-definite matrices. Then,
# and only then, changes of the controls get a weight; it falls again by the same steps.


def relative_improvement(old, cost):
    """The decrease of cost relative to what is left; 0 for no change, at a cost of zero too."""
    return 0.0 if old == cost else (old - cost) / abs(cost)


def smoother_iterations(
    steps, first, last, max_iterations, tolerance, gap_tolerance, optimal,
    x_hat, x_hats, L, l, S, s, k, Lbar, lbar, Sbar, sbar, kbar, p, dt, initial, stage, final,
    prior_weight, prior_about, prior_iterations, states, controls, kept_L, kept_l, log,
):  # fmt: skip
    """Iterated LQR smoothing: a forward pass, a backward pass and the rollout of the new policy, again and again.

    `x_hat` is the wished start, L and l a policy that plays the initial controls. `states`, `controls`, `kept_L`,
    `kept_l` are what the last iteration that was completed found; before any, where the initial controls lead.
    """
    A, a, B, b, c = stack(1, M, N), stack(1, M), stack(1, N, N), stack(1, N), stack(1)
    no_weight = stack(N)
    for i in range(N):
        no_weight[i] = 0.0
    if first == 0:
        rollout(steps, x_hat, L, l, p, dt, initial, stage, final, states, controls)
        keep_law(steps, L, l, kept_L, kept_l)
    for done in range(first, last):
        weight = prior_weight if done < prior_iterations else no_weight
        failed, good = forward_pass(
            steps, x_hat, L, l, S, s, k, Lbar, lbar, Sbar, sbar, kbar, p, dt, initial, stage, final, weight, prior_about
        )
        if failed >= 0:
            return done, NOT_POSITIVE_DEFINITE if good else NOT_FINITE, False, failed
        failed, good = backward_pass(
            steps, x_hat, x_hats, L, l, S, s, k, Lbar, lbar, Sbar, sbar, kbar, p, dt, initial, stage,
            weight, prior_about,
        )  # fmt: skip
        if failed >= 0:
            return done, NOT_POSITIVE_DEFINITE if good else NOT_FINITE, True, failed
        cost = rollout(steps, x_hat, L, l, p, dt, initial, stage, final, states, controls)
        keep_law(steps, L, l, kept_L, kept_l)
        improvement = relative_improvement(log[done - 1, 0] if done > 0 else inf, cost)
        gap = largest_gap(steps, x_hats, states)
        settled = abs(improvement) < tolerance and (gap < gap_tolerance or not optimal)
        left = nan
        if settled or done + 1 == max_iterations:
            failed, _, left = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 0, A, a, B, b, c)
            left += initial_decrease(states[0], initial, B[0], b[0])
            left = relative_optimality(failed, left, cost)
        log[done, 0], log[done, 1], log[done, 2], log[done, 3] = cost, improvement, gap, left
        outcome = ending(settled, optimal, left, tolerance, cost, done + 1 == max_iterations)
        if outcome != RUNNING:
            return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def relative_optimality(failed, decrease, cost):
    """What a linear-quadratic model about a trajectory promises, relative to its cost; infinite if there is none."""
    return decrease / max(abs(cost), 1e-300) if failed < 0 and decrease < inf else inf


def ending(settled, optimal, left, tolerance, cost, full):
    """The outcome after an iteration whose cost did or did not settle, with that optimality left."""
    if settled and not optimal:
        return COST_CONVERGED
    if settled and left < tolerance:
        return CONVERGED
    if full:
        return MAX_ITERATIONS if abs(cost) < inf else DIVERGED
    return RUNNING


def keep_law(steps, L, l, kept_L, kept_l):
    """Copy a policy."""
    for t in range(steps):
        for i in range(M):
            kept_l[t, i] = l[t, i]
            for j in range(N):
                kept_L[t, i, j] = L[t, i, j]


def ilqr_iterations(
    steps, first, last, max_iterations, tolerance, optimal,
    x0, L, l, S, s, k, p, dt, initial, stage, final,
    states, controls, new_states, new_controls, damping, log,
):  # fmt: skip
    """Iterative LQR: a backward pass about a feasible trajectory and a line search, again and again.

    `controls` are the initial ones; afterwards `states` and `controls` are the best trajectory, and L, l (relative to
    it), S, s, k are about it. `damping` (1,) is the weight on changes of the controls; `log` has, in its last row, the
    cost that the first iteration improves on.
    """
    if first == 0:
        for t in range(steps):
            for i in range(M):
                l[t, i] = controls[t, i]
                for j in range(N):
                    L[t, i, j] = 0.0
        cost = rollout(steps, x0, L, l, p, dt, initial, stage, final, states, controls)
        log[max_iterations, 0] = cost
        if not abs(cost) < inf:
            return 0, NO_START, False, -1
    cost = log[first - 1 if first > 0 else max_iterations, 0]
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
        cost, fraction = line_search(
            steps, states, controls, L, l, p, dt, initial, stage, final, old, new_states, new_controls
        )
        if fraction > 0:
            for t in range(steps + 1):
                for i in range(N):
                    states[t, i] = new_states[t, i]
            for t in range(steps):
                for i in range(M):
                    controls[t, i] = new_controls[t, i]
        improvement = relative_improvement(old, cost)
        settled = abs(improvement) < tolerance
        left = nan
        if settled or done + 1 == max_iterations:
            failed, _, left = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
            left = relative_optimality(failed, left, cost)
        log[done, 0], log[done, 1], log[done, 2], log[done, 3] = cost, improvement, 0.0, left
        outcome = ending(settled, optimal, left, tolerance, cost, done + 1 == max_iterations)
        if outcome == RUNNING and fraction == 0:
            outcome = STALLED
        if outcome != RUNNING:
            if isnan(left):  # not worked out; but policy and cost-to-go are to be about the trajectory that was found
                failed, _, _ = differential_pass(steps, states, controls, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
            return done + 1, outcome, failed >= 0, failed
    return last, RUNNING, False, -1

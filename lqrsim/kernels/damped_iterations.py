"""The safeguard: LQR smoothing held near the best plan so far, for when it fails on its own. The numba subset.

Rollouts on the way to an optimum can be worse than the first one by any factor, so a rising cost does not tell that the
method will fail. It is left alone until a pass fails or the least cost so far no longer falls; see `no_progress`. What
Levenberg-Marquardt is to Gauss-Newton, the damped iterations are to LQR smoothing.
"""

from math import inf, isnan, nan

from lqrsim.kernels.interface import (
    DAMPED,
    FINAL_GAP,
    ILQR,
    ILQR_LEFT,
    ILQR_NEXT,
    MAX_ITERATIONS,
    MERIT,
    PATIENCE,
    PLAN_COST,
    REACH,
    REJECTED,
    RUNNING,
    SINCE_ILQR,
    SMALL,
    STALLED,
    WEIGHT,
    M,
    N,
    stack,
)
from lqrsim.kernels.iterations import ending, relative_improvement, relative_optimality, write_row
from lqrsim.kernels.passes import backward_pass, copy, forward_pass, minimizers
from lqrsim.kernels.rollouts import (
    about_plan,
    differential_pass,
    dynamics_residual,
    follow,
    initial_step,
    keep_plan,
    largest_gap,
    line_search,
)


def damped_iterations(
    steps, first, last, max_iterations, tolerance, gap_tolerance, optimal, fixed,
    start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
    no_weight, no_about, plan_x, plan_u, states, controls, memory, log,
):  # fmt: skip
    """Iterations from the best plan so far, each of which lowers its cost or leaves it as it is; with constraints, its
    merit, to which the augmented Lagrangian belongs.

    The forward pass linearises about the plan, the backward pass part of the way (`reach`) to where the minimisers
    lead, and the new policy is followed as far as lowers the cost, by halves. Where a tenth of the way does not, the
    next iteration reaches less far. At reach 0 both passes linearise about the plan, and the step is that of iLQR: it
    points downhill, and some part of it lowers the cost, unless the plan is stationary or rounding spoils the matrices.
    If so, changes of the controls (and of a soft start) get a weight in both passes, relative to the cost's own
    curvature, which grows tenfold until it helps.

    A small change of cost can come from a short step, so two in a row are wanted. Then everything is done once more,
    about the plan and without a weight, to tell how far it is from optimal; that also gives the policy and the value
    functions of the answer.

    After many iterations without an end, too, reach 0 has its turn, each time for twice as long. `memory` (MEMORY,) is
    what one iteration leaves to the next; see `interface.py`.

    With `first` of `last`, there is no iteration: only policy and value functions are made, about the plan as it is.
    """
    shift = stack(N)
    if first == last:
        relinearize(
            steps, fixed, tolerance, optimal, False, 0.0,
            start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
            no_weight, no_about, plan_x, plan_u, memory, log, first,
        )  # fmt: skip
    for done in range(first, last):
        reach, weight, nothing = memory[REACH], memory[WEIGHT], 0.0
        copy(start if fixed else plan_x[0], N, x_hat)
        failed, _ = forward_pass(
            steps, fixed, True, weight, plan_x, plan_u,
            x_hat, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final, no_weight, no_about,
        )  # fmt: skip
        if failed < 0:
            failed, _, nothing = backward_pass(
                steps, fixed, reach, weight, plan_x, plan_u, x_hat, x_hats,
                L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, no_weight, no_about,
            )  # fmt: skip
        merit, cost, fraction = inf, inf, 0.0
        if failed < 0:
            for i in range(N):
                shift[i] = x_hat[i] - plan_x[0, i]
            about_plan(steps, plan_x, plan_u, L, l)
            smallest = 0.1 if reach > 0 else 1e-8
            bound = memory[MERIT] + 1e-12 * abs(memory[MERIT])  # what differs by rounding is not refused
            merit, cost, fraction = line_search(
                steps, plan_x, plan_u, shift, L, l, p, dt, initial, stage, final, bound, smallest, states, controls
            )
        full = done + 1 == max_iterations
        if fraction > 0:
            improvement = relative_improvement(memory[MERIT], merit, nothing)
            follow(steps, fraction, plan_x, x_hats)
            # At reach 0 as for iLQR: nothing but a rollout was linearised about.
            gap = largest_gap(steps, x_hats, states) if reach > 0 else 0.0
            keep_plan(steps, states, controls, plan_x, plan_u)
            memory[PLAN_COST], memory[MERIT] = cost, merit
            small = abs(improvement) < tolerance and (gap < gap_tolerance or not optimal)
            memory[SMALL] = memory[SMALL] + 1 if small else 0.0
            settled, stalled = memory[SMALL] > 1, False
            be_bolder(memory, fraction)
            write_row(log, done, cost, improvement, gap, nan, nan, DAMPED if reach > 0 else ILQR)
        else:
            be_more_careful(memory)
            stalled = memory[WEIGHT] > 1e12
            settled = stalled
            write_row(log, done, memory[PLAN_COST], 0.0, nan, nan, nan, REJECTED)
        if settled or full:
            outcome = relinearize(
                steps, fixed, tolerance, optimal, settled, nothing,
                start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
                no_weight, no_about, plan_x, plan_u, memory, log, done,
            )  # fmt: skip
            if outcome == RUNNING and (stalled or full):
                outcome = STALLED if stalled else MAX_ITERATIONS
            if outcome != RUNNING:
                return done + 1, outcome, False, -1
    return last, RUNNING, False, -1


def be_bolder(memory, fraction):
    """What the next iteration ventures after one that lowered the cost, by that fraction of its step."""
    if memory[WEIGHT] > 0:
        memory[WEIGHT] = 0.1 * memory[WEIGHT] if memory[WEIGHT] > 1e-6 else 0.0
    elif memory[REACH] > 0:
        if fraction == 1:
            memory[REACH] = min(2 * memory[REACH], 1.0)
        memory[SINCE_ILQR] += 1
        if memory[SINCE_ILQR] > PATIENCE:
            turn_to_ilqr(memory)
    else:
        memory[ILQR_LEFT] -= 1
        memory[REACH] = 0.25 if memory[ILQR_LEFT] <= 0 else 0.0


def be_more_careful(memory):
    """What the next iteration ventures after one that did not lower the cost."""
    if memory[REACH] > 0.25:
        memory[REACH] = 0.25
    elif memory[REACH] > 0:
        turn_to_ilqr(memory)
    else:
        memory[WEIGHT] = max(10 * memory[WEIGHT], 1e-3)


def turn_to_ilqr(memory):
    """Reach 0 for a while: each time for twice as long, for what lies beyond has not helped so far."""
    memory[REACH], memory[SINCE_ILQR] = 0.0, 0.0
    memory[ILQR_LEFT] = memory[ILQR_NEXT]
    memory[ILQR_NEXT] *= 2


def relinearize(
    steps, fixed, tolerance, optimal, settled, nothing,
    start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
    no_weight, no_about, plan_x, plan_u, memory, log, done,
):  # fmt: skip
    """Policy and value functions about the plan, without a weight. Returns the outcome.

    Writes optimality and residual to the log, and to the memory how far the states of least total cost are from the
    plan: where motions are unstable, rounding can spoil the cost-to-come while the rest is right.
    """
    shift = stack(N)
    failed, _, left = differential_pass(steps, plan_x, plan_u, p, dt, stage, final, 0.0, 1, L, l, S, s, k)
    if failed >= 0:
        return RUNNING
    if not fixed:
        left += initial_step(plan_x[0], initial, S[0], s[0], shift)
    left = relative_optimality(failed, left, memory[MERIT], nothing)
    copy(start if fixed else plan_x[0], N, x_hat)
    failed, _ = forward_pass(
        steps, fixed, True, 0.0, plan_x, plan_u,
        x_hat, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final, no_weight, no_about,
    )  # fmt: skip
    memory[FINAL_GAP] = inf
    if failed < 0 and minimizers(steps, S, s, C, b, x_hats):
        memory[FINAL_GAP] = largest_gap(steps, x_hats, plan_x)
    # The forward pass has left it at the end; what comes next begins at the start.
    copy(start if fixed else plan_x[0], N, x_hat)
    for t in range(steps):
        for i in range(M):  # the policy that makes the plan
            l[t, i] = plan_u[t, i]
            for j in range(N):
                l[t, i] -= L[t, i, j] * plan_x[t, j]
    log[done, 3], log[done, 4] = left, dynamics_residual(steps, x_hats, L, l, p, dt, stage, plan_x)
    if isnan(log[done, 2]):  # of an iteration that was rejected
        log[done, 2] = 0.0
    return ending(settled and left < tolerance, optimal, left, tolerance, memory[PLAN_COST], False)

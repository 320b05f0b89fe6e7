"""Certification of a plan, computed from the problem on a separate, short path.

It uses only the problem's functions, their derivatives and a Cholesky factor: nothing from the passes, rollouts and
line searches that found the plan. The cost is the value that comes with the derivatives, not the sum from rollouts.
`certify.py` compares the results with a solver's claims.
"""

from math import inf, isnan, nan

from lqrsim.kernels.declarations import NOISY, M, N, W, stack, zeros
from lqrsim.kernels.linear_algebra import cholesky, cholesky_solve, congruence, copy, copy_matrix, copy_part, fill
from lqrsim.kernels.model_functions import (
    augment_cost,
    cost_alone,
    cost_of_order,
    cost_quadratic,
    noise_quadratic,
    step_jacobian,
    step_second_order,
)
from lqrsim.kernels.passes import larger
from lqrsim.kernels.records import Limits, LinearStep, NextStep, QuadraticStage
from lqrsim.kernels.riccati import minimize_control

# A predicted decrease below this, relative to the terms that cancel in it, consists of squares of rounding errors: all
# that an optimal cost of zero leaves.
NEGLIGIBLE_DECREASE = 1e-28
# A control block that is definite by less than this part of its own largest curvature gets as much more. If its own is
# less than this part of the largest along the plan, this part of the typical cost takes the place of a curvature.
OF_BLOCK, OF_PLAN, WEIGHT = 1e-12, 1e-9, 1e-2
# A control that is smaller than this part of 1 or of its limit is at rest: what is left is rounding, and no size of it.
AT_REST = 1e-9


def certify(settings, of_policy, plan, policy, to_go, model, row):
    """Write cost, residuals and predicted decrease of a plan and its policy.

    The predicted decrease is `1/2 sum e' E^-1 e`, with the gradients e of the cost in the offsets of the policy while
    later controls respond with its gains, and E = R + B'SB with the Hessians S of the cost-to-go. It equals the
    prediction of a Riccati pass about the plan if the gains are from that pass. Controls go no further than their
    limits. Where E is singular, as for a control that costs nothing, it gets a little more. Cost and
    decrease include the expected cost of noise; the decrease includes the augmented Lagrangian, the cost does not.

    Args:
      of_policy: whether to compute the Hessians S (T+1, N, N) here, for the policy with controls at their limits, and
        write them to `to_go`. The Hessians of a Riccati pass assume that clamped controls respond.
      plan: Motion. policy: Policy. to_go: CostToGo. model: ProblemModel.
      row: row of CERTIFICATE, written; before, `typical` may have the least typical cost where nothing is curved.
        scale: size of the curved part of the cost without cancellation; rounding errors are relative to it.
        typical: the cost of changing each state and control by its range along the plan, or a control by its size.
        dynamics_residual: the largest |x_{t+1} - g(x_t, u_t)|, each state relative to its largest size, or to 1.
        policy_residual: the largest difference of a control from the policy's, within its limits, relative to the terms
        of the policy's sum.
        beyond_limits: the largest violation of a control's limit.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, change_limits = stack(N), Limits(stack(M), stack(M))
    none, costate, size, residual, nowhere = zeros(M), stack(N), stack(N), zeros(N), zeros(N)
    states, steps, hessians, sizes = plan.states, settings.steps, to_go.hessian, stack(W)
    off_policy, limits, decrease, uncurved = 0.0, 0.0, 0.0, 0.0
    for i in range(N):
        size[i] = 1.0
        low, high = states[0, i], states[0, i]
        for t in range(steps + 1):
            size[i] = max(size[i], abs(states[t, i]))
            low, high = min(low, states[t, i]), max(high, states[t, i])
        sizes[i] = high - low
    for i in range(M):
        sizes[N + i] = 0.0
        for t in range(steps):
            sizes[N + i] = max(sizes[N + i], abs(plan.controls[t, i]))
        full = min(1.0, max(model.limits.high[i], -model.limits.low[i]))
        if sizes[N + i] <= AT_REST * full:
            sizes[N + i] = full
    # Constraint terms are never part of the sum: a large penalty would leave its rounding errors.
    cost = cost_alone(states[steps], none, steps, model.final, 0.0, stage.hessian, stage.gradient)
    typical = largest = cost_of_change(stage, sizes)
    augment_cost(states[steps], none, steps, model.final, stage.hessian, stage.gradient)
    scale = scale_of(states[steps], none, stage)
    copy(stage.gradient, N, costate)
    if of_policy:
        copy_matrix(stage.hessian, N, N, hessians[steps])
    for t in range(steps - 1, -1, -1):
        x, u = states[t], plan.controls[t]
        step_jacobian(x, u, model, model.dt, arrived, step.jacobian)
        cost += cost_alone(x, u, t, model.stage, 0.0, stage.hessian, stage.gradient)
        typical += cost_of_change(stage, sizes)
        augment_cost(x, u, t, model.stage, stage.hessian, stage.gradient)
        if NOISY:  # for this policy, the gradient of the cost-to-go is the costate
            given = model.noise.risk[2] > 0  # a cost-to-go about the origin
            there = nowhere if of_policy and not given else arrived
            slope = costate if of_policy else to_go.gradient[t + 1]
            next_step = NextStep(step.jacobian, there, hessians[t + 1], slope)
            cost += noise_quadratic(x, u, t, model.noise, next_step, False, stage)
        terms = scale_of(x, u, stage)
        scale += terms
        for i in range(N):
            residual[i] = larger(residual[i], abs(states[t + 1, i] - arrived[i]))
        for i in range(M):
            change_limits.low[i], change_limits.high[i] = model.limits.low[i] - u[i], model.limits.high[i] - u[i]
            limits = max(limits, change_limits.low[i], -change_limits.high[i])
        off_policy = policy_residual(x, u, policy.gain[t], policy.offset[t], model.limits, off_policy)
        terms += curved_terms(states[t + 1], hessians[t + 1])
        predicted, slopes, largest = predicted_decrease(
            step, stage, policy.gain[t], hessians[t + 1], change_limits, sizes, largest, costate
        )
        decrease += 0.0 if predicted <= NEGLIGIBLE_DECREASE * terms else predicted
        uncurved += slopes
        if of_policy:
            gain, S = policy.gain[t], hessians[t + 1]
            closed_loop_hessian(step.jacobian, stage.hessian, gain, change_limits, S, hessians[t])
    if not settings.fixed:
        cost += cost_quadratic(states[0], none, 0, model.initial, stage.hessian, stage.gradient)
        typical += cost_of_change(stage, sizes)
        terms = scale_of(states[0], none, stage)
        scale += terms
        terms += curved_terms(states[0], hessians[0])
        decrease += start_decrease(stage, hessians[0], NEGLIGIBLE_DECREASE * terms, costate)
    worst = 0.0
    for i in range(N):
        worst = larger(worst, residual[i] / size[i])
    if uncurved > 0:  # where nothing is curved, as with a cost of the final state alone, the cost itself is typical
        decrease += uncurved / (2 * WEIGHT * max(typical, abs(cost), row.typical))
    row.cost, row.scale, row.typical, row.dynamics_residual = cost, scale, typical, worst
    row.policy_residual, row.beyond_limits, row.decrease = off_policy, limits, decrease


def cost_of_change(stage, sizes):
    """The cost of changing each entry of (x, u) by its size (W,), by the curvature of a stage."""
    total = 0.0
    for i in range(W):
        total += 0.5 * stage.hessian[i, i] * sizes[i] * sizes[i]
    return total


def scale_of(x, u, stage):
    """The quadratic part of a cost at (x, u) with the sizes of its terms, states and controls apart."""
    scale = curved_terms(x, stage.hessian)
    for i in range(M):
        for j in range(M):
            scale += 0.5 * abs(u[i] * stage.hessian[N + i, N + j] * u[j])
    return scale


def curved_terms(x, S):
    """The quadratic part of a function at x (N,) with the sizes of its terms."""
    terms = 0.0
    for i in range(N):
        for j in range(N):
            terms += 0.5 * abs(x[i] * S[i, j] * x[j])
    return terms


def policy_residual(x, u, gain, offset, limits, worst):
    """The relative difference of a control from the policy's within its limits, if above `worst`; else `worst`."""
    for i in range(M):
        total, terms = offset[i], abs(offset[i]) + abs(u[i])
        for j in range(N):
            total += gain[i, j] * x[j]
            terms += abs(gain[i, j] * x[j])
        difference = abs(min(max(total, limits.low[i]), limits.high[i]) - u[i])
        if not isnan(worst) and not difference <= worst * terms:
            worst = difference / max(terms, 1e-300)
    return worst


def predicted_decrease(step, stage, gain, S, change_limits, sizes, largest, costate):
    """The decrease `1/2 e' E^-1 e` that the controls of a step predict, within their limits.

    Args:
      step: LinearStep. stage: QuadraticStage at the plan. gain: (M, N). S: (N, N) at t + 1. change_limits: Limits.
      sizes: (W,) of states and controls. largest: the largest curvature of a control so far, for a change by its size.
      costate: (N,) at t + 1, overwritten by the costate at t; controls respond with the gain, but not at a limit.

    Returns:
      The decrease, 0 if E has no curvature; the squares of the slopes along changes by the controls' sizes, 0 if E has
      curvature; and the largest curvature.
    """
    jacobian, hessian, gradient = step.jacobian, stage.hessian, stage.gradient
    slope, curve, factor, best, before = stack(M), stack(M, N), stack(M, M), stack(M), stack(N)
    for i in range(M):
        slope[i] = gradient[N + i]
        for j in range(N):
            slope[i] += jacobian[j, N + i] * costate[j]
            total = 0.0
            for k in range(N):
                total += jacobian[k, N + i] * S[k, j]
            curve[i, j] = total
        for j in range(M):
            total = hessian[N + i, N + j]
            for k in range(N):
                total += curve[i, k] * jacobian[k, N + j]
            factor[i, j] = total
    for i in range(N):
        before[i] = gradient[i]
        for j in range(N):
            before[i] += jacobian[j, i] * costate[j]
    for i in range(M):
        if change_limits.low[i] < 0 < change_limits.high[i]:
            for j in range(N):
                before[j] += gain[i, j] * slope[i]
    copy(before, N, costate)
    curvature = 0.0
    for i in range(M):
        curvature = larger(curvature, 0.5 * factor[i, i] * sizes[N + i] * sizes[N + i])
    largest = larger(largest, curvature)
    if curvature > OF_PLAN * largest:
        if not is_curved(factor, sizes, OF_BLOCK * curvature):
            for i in range(M):
                factor[i, i] += 2 * OF_BLOCK * curvature / (sizes[N + i] * sizes[N + i])
        return box_decrease(factor, slope, change_limits.low, change_limits.high, best), 0.0, largest
    squares = 0.0
    for i in range(M):
        size = min(sizes[N + i], -change_limits.low[i] if slope[i] > 0 else change_limits.high[i])
        squares += size * size * slope[i] * slope[i]
    return 0.0, squares, largest


def is_curved(matrix, sizes, least):
    """Whether a control block (M, M) is definite by at least this cost for changes by the controls' sizes."""
    block = stack(M, M)
    for i in range(M):
        copy(matrix[i], M, block[i])
        block[i, i] -= 2 * least / (sizes[N + i] * sizes[N + i])
    return cholesky(block, M)


def start_decrease(stage, S, rounding, costate):
    """The predicted decrease of a soft start, its cost quadratised in `stage`; add its gradient to the costate (N,).

    A decrease up to `rounding` is none.
    """
    factor, direction = stack(N, N), stack(N)
    for i in range(N):
        costate[i] += stage.gradient[i]
        direction[i] = costate[i]
        for j in range(N):
            factor[i, j] = stage.hessian[i, j] + S[i, j]
        if costate[i] == 0 and factor[i, i] == 0:  # a state without weight need not move
            factor[i, i] = 1.0
    good, decrease = cholesky(factor, N), 0.0
    cholesky_solve(factor, N, direction)
    for i in range(N):
        decrease += 0.5 * costate[i] * direction[i] if good else abs(costate[i]) * 1e300
    return 0.0 if decrease <= rounding else decrease


def closed_loop_hessian(jacobian, cost, gain, change_limits, next_hessian, out):
    """Write the Hessian (N, N) of the policy's cost-to-go at t, given that `next_hessian`, at t + 1.

    A control at a limit does not respond.
    """
    closed, both, product = stack(N, N), stack(W, N), stack(W, N)
    for j in range(N):
        for i in range(M):
            both[N + i, j] = gain[i, j] if change_limits.low[i] < 0 < change_limits.high[i] else 0.0
        for i in range(N):
            both[i, j] = 1.0 if i == j else 0.0
            closed[i, j] = jacobian[i, j]
            for k in range(M):
                closed[i, j] += jacobian[i, N + k] * both[N + k, j]
    for i in range(W):
        for j in range(N):
            product[i, j] = 0.0
            for k in range(W):
                product[i, j] += cost[i, k] * both[k, j]
    for i in range(N):
        for j in range(N):
            out[i, j] = 0.0
            for k in range(W):
                out[i, j] += both[k, i] * product[k, j]
    for i in range(N):
        for j in range(N):
            product[i, j] = 0.0
            for k in range(N):
                product[i, j] += next_hessian[i, k] * closed[k, j]
    for i in range(N):
        for j in range(N):
            for k in range(N):
                out[i, j] += closed[k, i] * product[k, j]


def box_decrease(matrix, slope, lowest, highest, best):
    """The decrease of `1/2 x'E x + e'x` at its minimiser in a box about zero, to `best`; NaN unless E > 0."""
    factor = stack(M, M)
    inside = True
    for i in range(M):
        best[i] = -slope[i]
        copy(matrix[i], M, factor[i])
    if not cholesky(factor, M):
        return nan
    cholesky_solve(factor, M, best)
    for i in range(M):
        inside = inside and lowest[i] <= best[i] <= highest[i]
    if not inside:  # coordinate descent, until no entry moves
        fill(best, M, 0.0)
        for _ in range(1000):
            change, size = 0.0, 0.0
            for i in range(M):
                left = slope[i]
                for j in range(M):
                    left += matrix[i, j] * best[j]
                new = min(max(best[i] - left / matrix[i, i], lowest[i]), highest[i])
                change, size = max(change, abs(new - best[i])), max(size, abs(new))
                best[i] = new
            if not change > 1e-12 * size:
                break
    decrease = 0.0
    for i in range(M):
        decrease -= slope[i] * best[i]
        for j in range(M):
            decrease -= 0.5 * best[i] * matrix[i, j] * best[j]
    return decrease


def reduced_curvature(settings, plan, model, row):
    """Write the least curvature of the cost of a plan in the controls, while later controls respond at their best.

    The recursion is that of Newton's method, with exact Hessians, about a plan without constraints. A control that its
    slope presses against a limit stays there. The curvatures of a control are relative to its largest along the plan.

    Args:
      plan: Motion that satisfies the dynamics. model: ProblemModel, with second derivatives of the dynamics.
      row: row of CERTIFICATE; `curvature` is written, -1 unless the reduced Hessian is positive definite.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    S, costate, none, least, most, states = stack(N, N), stack(N), zeros(M), stack(M), zeros(M), plan.states
    hessian, gradient, low, high = stage.hessian, stage.gradient, model.limits.low, model.limits.high
    row.curvature = -1.0
    fill(least, M, inf)
    cost_of_order(states[settings.steps], none, settings.steps, model.final, 1.0, hessian, gradient)
    copy_matrix(hessian, N, N, S)
    copy(gradient, N, costate)
    for t in range(settings.steps - 1, -1, -1):
        u = plan.controls[t]
        cost_of_order(states[t], u, t, model.stage, 1.0, hessian, gradient)
        step_second_order(states[t], u, model, costate, step.offset, step.jacobian, hessian)
        congruence(step.jacobian, S, costate, hessian, gradient)
        for i in range(M):
            if (u[i] == low[i] and gradient[N + i] > 0) or (u[i] == high[i] and gradient[N + i] < 0):
                for j in range(W):
                    hessian[N + i, j], hessian[j, N + i] = 0.0, 0.0
                hessian[N + i, N + i] = inf
            else:
                most[i] = max(most[i], hessian[N + i, N + i])
        copy(gradient, N, costate)
        if not reduce_stage(hessian, least, S):
            return
    if not settings.fixed:
        cost_of_order(states[0], none, 0, model.initial, 1.0, hessian, gradient)
        for i in range(N):
            for j in range(N):
                S[i, j] += hessian[i, j]
            if S[i, i] == 0 and gradient[i] + costate[i] == 0:  # a state without weight need not move
                S[i, i] = 1.0
        if not cholesky(S, N):
            return
    curvature = inf
    for i in range(M):
        if most[i] > 0:
            curvature = min(curvature, least[i] / most[i])
    row.curvature = curvature


def reduce_stage(hessian, least, S):
    """Minimise a stage's curvature, which is overwritten, over the controls: write S (N, N) of the states alone.

    Lowers the least curvatures (M,) of the controls to those of the control block, each with the earlier controls at
    their best. A control whose curvature is infinite stays. Returns whether the block is positive definite.
    """
    block, gain, offset, none, unused = stack(M, M), stack(M, N), stack(M), zeros(W), stack(N)
    for i in range(M):
        copy_part(hessian[N + i], N, block[i], 0, M)
    for k in range(M):
        if block[k, k] == inf:
            hessian[N + k, N + k] = 1.0
            continue
        if not block[k, k] > 0:
            return False
        least[k] = min(least[k], block[k, k])
        for i in range(k + 1, M):
            factor = block[k, i] / block[k, k]
            for j in range(i, M):
                block[i, j] -= factor * block[k, j]
    return minimize_control(hessian, none, gain, offset, S, unused) >= 0

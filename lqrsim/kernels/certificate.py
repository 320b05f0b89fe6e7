"""What a plan really is, worked out from the problem by a short path of its own. The kernels' subset.

Nothing of the passes, rollouts and line searches that found the plan is used: only the problem's own functions, their
derivatives, and a Cholesky factor. The cost is the one that derivatives come with, not what rollouts added up.
`certify.py` compares with what a solver claims.
"""

from math import nan

from lqrsim.kernels.declarations import (
    NOISY,
    M,
    N,
    W,
    stack,
)
from lqrsim.kernels.linear_algebra import cholesky, cholesky_solve
from lqrsim.kernels.model_functions import augment_cost, cost_alone, cost_quadratic, noise_quadratic, step_jacobian
from lqrsim.kernels.records import Limits, LinearStep, NextStep, QuadraticStage


def certify(settings, own, plan, policy, to_go, model, found):
    """Write to `found`: cost, its scale, motion, law, limits, and the decrease of cost that is still promised.

    The scale is what the curved part of the cost would be if nothing in it cancelled: rounding is a share of it.
    Motion is the largest |x_{t+1} - g(x_t, u_t)|, each state relative to its largest size, or to 1. Law is the largest
    difference of a control from the policy's, within the limits, relative to the terms of that sum. Limits is by how
    much a control is beyond one.

    The promised decrease is `1/2 sum e' E^-1 e` with the slopes e of the cost in the offsets of the policy, later
    controls responding with its gains, and E = R + B'SB with the Hessians S (T+1, N, N) of the cost-to-go. It is what
    a Riccati pass predicts where the gains are that pass's, about the plan. Controls go no further than their limits.
    What noise is expected to cost belongs to all of it. With `own`, the Hessians are worked out here, of the policy as
    it is with controls at their limits, and written to the cost-to-go: those of a Riccati pass take controls to respond
    that cannot. The cost includes no augmented Lagrangian, the decrease does.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, room = stack(N), Limits(stack(M), stack(M))
    none, costate, size, beyond = stack(M), stack(N), stack(N), stack(N)
    states, steps, hessians, nowhere = plan.states, settings.steps, to_go.hessian, stack(N)
    law, limits, decrease = 0.0, 0.0, 0.0
    for i in range(M):
        none[i] = 0.0
    for i in range(N):
        size[i], beyond[i], nowhere[i] = 1.0, 0.0, 0.0
        for t in range(steps + 1):
            size[i] = max(size[i], abs(states[t, i]))
    # What constraints add is never part of the sum: a large penalty would leave its rounding.
    cost = cost_alone(states[steps], none, steps, model.final, 0.0, stage.hessian, stage.gradient)
    augment_cost(states[steps], none, steps, model.final, stage.hessian, stage.gradient)
    scale = scale_of(states[steps], none, stage)
    for i in range(N):
        costate[i] = stage.gradient[i]
        for j in range(N):
            if own:
                hessians[steps, i, j] = stage.hessian[i, j]
    for t in range(steps - 1, -1, -1):
        x, u = states[t], plan.controls[t]
        step_jacobian(x, u, model, model.dt, arrived, step.jacobian)
        cost += cost_alone(x, u, t, model.stage, 0.0, stage.hessian, stage.gradient)
        augment_cost(x, u, t, model.stage, stage.hessian, stage.gradient)
        if NOISY:  # of the policy as it is, the slope ahead is the costate
            slope = NextStep(
                step.jacobian,
                nowhere if own else arrived,
                hessians[t + 1],
                costate if own else to_go.gradient[t + 1],
            )
            cost += noise_quadratic(x, u, model.noise, slope, False, stage)
        scale += scale_of(x, u, stage)
        for i in range(N):
            difference = abs(states[t + 1, i] - arrived[i])
            if not difference <= beyond[i]:  # a NaN stays
                beyond[i] = difference
        for i in range(M):
            room.low[i], room.high[i] = model.limits.low[i] - u[i], model.limits.high[i] - u[i]
            limits = max(limits, room.low[i], -room.high[i])
        law = policy_residual(x, u, policy.gain[t], policy.offset[t], model.limits, law)
        decrease += promised_decrease(step, stage, policy.gain[t], hessians[t + 1], room, costate)
        if own:
            closed_loop_hessian(step.jacobian, stage.hessian, policy.gain[t], room, hessians[t + 1], hessians[t])
    if not settings.fixed:
        cost += cost_quadratic(states[0], none, 0, model.initial, stage.hessian, stage.gradient)
        scale += scale_of(states[0], none, stage)
        decrease += start_decrease(stage, hessians[0], costate)
    motion = 0.0
    for i in range(N):
        if not beyond[i] <= motion * size[i]:
            motion = beyond[i] / size[i]
    found.cost, found.scale, found.motion = cost, scale, motion
    found.law, found.limits, found.decrease = law, limits, decrease


def scale_of(x, u, stage):
    """What the curved part of a cost at (x, u) would be if nothing in it cancelled, states and controls apart."""
    scale = 0.0
    for i in range(N):
        for j in range(N):
            scale += 0.5 * abs(x[i] * stage.hessian[i, j] * x[j])
    for i in range(M):
        for j in range(M):
            scale += 0.5 * abs(u[i] * stage.hessian[N + i, N + j] * u[j])
    return scale


def policy_residual(x, u, gain, offset, limits, worst):
    """By how much a control is off the policy's within the limits, or what is worse already."""
    for i in range(M):
        total, terms = offset[i], abs(offset[i]) + abs(u[i])
        for j in range(N):
            total += gain[i, j] * x[j]
            terms += abs(gain[i, j] * x[j])
        difference = abs(min(max(total, limits.low[i]), limits.high[i]) - u[i])
        if not difference <= worst * terms:
            worst = difference / max(terms, 1e-300)
    return worst


def promised_decrease(step, stage, gain, S, room, costate):
    """What the controls of a step promise: `1/2 e' E^-1 e` within the room that the limits leave.

    The costate at t + 1 becomes that at t, the controls responding with the gain (M, N); at a limit they do not.
    """
    jacobian, hessian, gradient = step.jacobian, stage.hessian, stage.gradient
    slope, curve, factor, moved, before = stack(M), stack(M, N), stack(M, M), stack(M), stack(N)
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
        if room.low[i] < 0 < room.high[i]:
            for j in range(N):
                before[j] += gain[i, j] * slope[i]
    for i in range(N):
        costate[i] = before[i]
    return box_decrease(factor, slope, room.low, room.high, moved)


def singular_semidefinite(matrix):
    """Whether a block is singular and no more than that: positive definite with next to nothing on its diagonal."""
    block, size = stack(M, M), 1e-300
    for i in range(M):
        size = max(size, abs(matrix[i, i]))
    for i in range(M):
        for j in range(M):
            block[i, j] = matrix[i, j]
        block[i, i] += 1e-9 * size
    return cholesky(block, M)


def start_decrease(stage, S, costate):
    """What a soft start promises, its cost quadratised in `stage`."""
    factor, direction = stack(N, N), stack(N)
    for i in range(N):
        costate[i] += stage.gradient[i]
        direction[i] = costate[i]
        for j in range(N):
            factor[i, j] = stage.hessian[i, j] + S[i, j]
        if costate[i] == 0 and factor[i, i] == 0:  # a state that nothing weighs may stay
            factor[i, i] = 1.0
    good, decrease = cholesky(factor, N), 0.0
    cholesky_solve(factor, N, direction)
    for i in range(N):
        decrease += 0.5 * costate[i] * direction[i] if good else abs(costate[i]) * 1e300
    return decrease


def closed_loop_hessian(jacobian, cost, gain, room, ahead, out):
    """Write the Hessian of what the policy costs from here on, given that from the next step on.

    A control at a limit, where there is no room on one side, does not respond.
    """
    closed, both, product = stack(N, N), stack(W, N), stack(W, N)
    for j in range(N):
        for i in range(M):
            both[N + i, j] = gain[i, j] if room.low[i] < 0 < room.high[i] else 0.0
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
                product[i, j] += ahead[i, k] * closed[k, j]
    for i in range(N):
        for j in range(N):
            for k in range(N):
                out[i, j] += closed[k, i] * product[k, j]


def box_decrease(matrix, slope, lowest, highest, best):
    """The decrease of `1/2 x'E x + e'x` at its minimiser `best` (M,) within a box about zero; NaN unless E >= 0.

    Where E is singular, it is that of e'x.
    """
    factor = stack(M, M)
    inside = True
    for i in range(M):
        best[i] = -slope[i]
        for j in range(M):
            factor[i, j] = matrix[i, j]
    if not cholesky(
        factor, M
    ):  # singular_semidefinite: no more than a straight line promises, up to where the box ends
        decrease = 0.0
        for i in range(M):
            if slope[i] != 0:
                decrease += slope[i] * -lowest[i] if slope[i] > 0 else -slope[i] * highest[i]
        return decrease if singular_semidefinite(matrix) else nan
    cholesky_solve(factor, M, best)
    for i in range(M):
        inside = inside and lowest[i] <= best[i] <= highest[i]
    if not inside:  # one entry after the other, until none moves
        for i in range(M):
            best[i] = 0.0
        for _ in range(1000):
            moved, size = 0.0, 0.0
            for i in range(M):
                left = slope[i]
                for j in range(M):
                    left += matrix[i, j] * best[j]
                new = min(max(best[i] - left / matrix[i, i], lowest[i]), highest[i])
                moved, size = max(moved, abs(new - best[i])), max(size, abs(new))
                best[i] = new
            if not moved > 1e-12 * size:
                break
    decrease = 0.0
    for i in range(M):
        decrease -= slope[i] * best[i]
        for j in range(M):
            decrease -= 0.5 * best[i] * matrix[i, j] * best[j]
    return decrease

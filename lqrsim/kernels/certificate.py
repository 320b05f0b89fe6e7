"""What a plan really is, worked out from the problem by a short path of its own. The numba subset; see `interface.py`.

Nothing of the passes, rollouts and line searches that found the plan is used: only the problem's own functions, their
derivatives, and a Cholesky factor. `certify.py` compares with what a solver claims.
"""

from math import nan

from lqrsim.kernels.interface import (
    LIMITS,
    M,
    N,
    W,
    final_quadratic,
    final_value,
    initial_quadratic,
    initial_value,
    stack,
    stage_quadratic,
    stage_value,
)
from lqrsim.kernels.linear_algebra import cholesky, cholesky_solve, clear
from lqrsim.kernels.runge_kutta import step_jacobian


def certify(steps, fixed, own, states, controls, gain, offset, hessians, p, dt, initial, stage, final, found):
    """Write to `found` (6,): cost, its scale, motion, law, limits, and the decrease of cost that is still promised.

    The scale is what the curved part of the cost would be if nothing in it cancelled: rounding is a share of it.
    Motion is the largest |x_{t+1} - g(x_t, u_t)|, each state relative to its largest size, or to 1. Law is the largest
    difference of a control from the policy's, `gain` x + `offset` within the limits, relative to the terms of that sum.
    Limits is by how much a control is beyond one.

    The promised decrease is `1/2 sum e' E^-1 e` with the slopes e of the cost in the offsets of the policy, later
    controls responding with its gains, and E = R + B'SB with the Hessians S (T+1, N, N) of the cost-to-go. It is what
    a Riccati pass predicts where the gains are that pass's, about the plan. Controls go no further than their limits.
    With `own`, the Hessians are worked out here, of the policy as it is with controls at their limits, and written to
    `hessians`: those of a Riccati pass take controls to respond that cannot. The cost includes no augmented Lagrangian,
    the decrease does.
    """
    hessian, gradient, jacobian = stack(W, W), stack(W), stack(N, W)
    fx, fu, arrived, none = stack(N, N), stack(N, M), stack(N), stack(M)
    ahead, costate, size, beyond = stack(N), stack(N), stack(N), stack(N)
    slope, curve, factor, moved = stack(M), stack(M, N), stack(M, M), stack(M)
    lowest, highest, response = stack(M), stack(M), stack(M, N)
    start_factor = stack(N, N)
    clear(fx, N, N)
    clear(fu, N, M)
    motion, law, limits, decrease, scale = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(M):
        none[i] = 0.0
    for i in range(N):
        size[i], beyond[i] = 1.0, 0.0
        for t in range(steps + 1):
            size[i] = max(size[i], abs(states[t, i]))
    # The end.
    cost = final_value(states[steps], none, steps, final)
    final_quadratic(states[steps], none, steps, final, hessian, gradient)
    for i in range(N):
        costate[i] = gradient[i]
        for j in range(N):
            scale += 0.5 * abs(states[steps, i] * hessian[i, j] * states[steps, j])
            if own:
                hessians[steps, i, j] = hessian[i, j]
    for t in range(steps - 1, -1, -1):
        x, u = states[t], controls[t]
        cost += stage_value(x, u, t, stage)
        step_jacobian(x, u, p, dt, fx, fu, arrived, jacobian)
        stage_quadratic(x, u, t, stage, hessian, gradient)
        for i in range(N):
            difference = abs(states[t + 1, i] - arrived[i])
            if not difference <= beyond[i]:  # a NaN stays
                beyond[i] = difference
            for j in range(N):
                scale += 0.5 * abs(x[i] * hessian[i, j] * x[j])
        for i in range(M):
            # The law, and the limits.
            total, terms = offset[t, i], abs(offset[t, i]) + abs(u[i])
            for j in range(N):
                total += gain[t, i, j] * x[j]
                terms += abs(gain[t, i, j] * x[j])
            low, high = stage[LIMITS][i], stage[LIMITS][M + i]
            limits = max(limits, low - u[i], u[i] - high)
            difference = abs(min(max(total, low), high) - u[i])
            if not difference <= law * terms:
                law = difference / max(terms, 1e-300)
            # The slope in the offset, and the matrix that makes a cost of it.
            slope[i] = gradient[N + i]
            for j in range(N):
                slope[i] += jacobian[j, N + i] * costate[j]
                total = 0.0
                for k in range(N):
                    total += jacobian[k, N + i] * hessians[t + 1, k, j]
                curve[i, j] = total
            for j in range(M):
                total = hessian[N + i, N + j]
                scale += 0.5 * abs(u[i] * total * u[j])
                for k in range(N):
                    total += curve[i, k] * jacobian[k, N + j]
                factor[i, j] = total
        for i in range(N):
            ahead[i] = gradient[i]
            for j in range(N):
                ahead[i] += jacobian[j, i] * costate[j]
        for i in range(M):
            low, high = stage[LIMITS][i], stage[LIMITS][M + i]
            if low < u[i] < high:  # at a limit a control does not respond
                for j in range(N):
                    ahead[j] += gain[t, i, j] * slope[i]
            lowest[i], highest[i] = low - u[i], high - u[i]
        decrease += within_box(factor, slope, lowest, highest, moved)
        if own:
            for i in range(M):
                for j in range(N):
                    response[i, j] = gain[t, i, j] if lowest[i] < 0 < highest[i] else 0.0
            closed_loop_hessian(jacobian, hessian, response, hessians[t + 1], hessians[t])
        for i in range(N):
            costate[i] = ahead[i]
    if not fixed:
        cost += initial_value(states[0], none, 0, initial)
        initial_quadratic(states[0], none, 0, initial, hessian, gradient)
        for i in range(N):
            costate[i] += gradient[i]
            ahead[i] = costate[i]
            for j in range(N):
                scale += 0.5 * abs(states[0, i] * hessian[i, j] * states[0, j])
                start_factor[i, j] = hessian[i, j] + hessians[0, i, j]
            if costate[i] == 0 and start_factor[i, i] == 0:  # a state that nothing weighs may stay
                start_factor[i, i] = 1.0
        good = cholesky(start_factor, N)
        cholesky_solve(start_factor, N, ahead)
        for i in range(N):
            decrease += 0.5 * costate[i] * ahead[i] if good else abs(costate[i]) * 1e300
    for i in range(N):
        if not beyond[i] <= motion * size[i]:
            motion = beyond[i] / size[i]
    found[0], found[1], found[2], found[3], found[4], found[5] = cost, scale, motion, law, limits, decrease


def closed_loop_hessian(jacobian, cost, gain, ahead, out):
    """Write the Hessian of what the policy costs from here on, given that from the next step on."""
    closed, both, product = stack(N, N), stack(W, N), stack(W, N)
    for j in range(N):
        for i in range(N):
            both[i, j] = 1.0 if i == j else 0.0
            closed[i, j] = jacobian[i, j]
            for k in range(M):
                closed[i, j] += jacobian[i, N + k] * gain[k, j]
        for i in range(M):
            both[N + i, j] = gain[i, j]
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


def within_box(matrix, slope, lowest, highest, best):
    """The decrease of `1/2 x'E x + e'x` at its minimiser `best` (M,) within a box about zero; NaN unless E > 0."""
    factor = stack(M, M)
    inside = True
    for i in range(M):
        best[i] = -slope[i]
        for j in range(M):
            factor[i, j] = matrix[i, j]
    if not cholesky(factor, M):
        return nan
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

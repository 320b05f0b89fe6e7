"""What a plan really is, worked out from the problem by a short path of its own. The numba subset; see `interface.py`.

Nothing of the passes, rollouts and line searches that found the plan is used: only the problem's own functions, their
derivatives, and a Cholesky factor. `certify.py` compares with what a solver claims.
"""

from lqrsim.integration import step_jacobian
from lqrsim.solvers.interface import (
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
from lqrsim.solvers.kernels import cholesky, cholesky_solve, clear


def certify(steps, fixed, states, controls, gain, offset, hessians, p, dt, initial, stage, final, found):
    """Write to `found` (6,): cost, its scale, motion, law, limits, and the decrease of cost that is still promised.

    The scale is what the curved part of the cost would be if nothing in it cancelled: rounding is a share of it.
    Motion is the largest |x_{t+1} - g(x_t, u_t)|, each state relative to its largest size, or to 1. Law is the largest
    difference of a control from the policy's, `gain` x + `offset` within the limits, relative to the terms of that sum.
    Limits is by how much a control is beyond one.

    The promised decrease is `1/2 sum e' E^-1 e` with the slopes e of the cost in the offsets of the policy, later
    controls responding with its gains, and E = R + B'SB with the Hessians S (T+1, N, N) of the cost-to-go. It is what
    a Riccati pass predicts where the gains are that pass's, about the plan. Controls at a limit that would go beyond it
    do not count. The cost includes no augmented Lagrangian, the decrease does.
    """
    hessian, gradient, jacobian = stack(W, W), stack(W), stack(N, W)
    fx, fu, arrived, none = stack(N, N), stack(N, M), stack(N), stack(M)
    ahead, costate, size, beyond = stack(N), stack(N), stack(N), stack(N)
    slope, curve, factor, moved = stack(M), stack(M, N), stack(M, M), stack(M)
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
            at_limit = u[i] == low or u[i] == high
            if (u[i] == low and slope[i] >= 0) or (u[i] == high and slope[i] <= 0):
                for j in range(M):
                    factor[i, j] = factor[j, i] = 0.0
                factor[i, i], slope[i] = 1.0, 0.0
            if not at_limit:  # at a limit a control does not respond
                for j in range(N):
                    ahead[j] += gain[t, i, j] * slope[i]
            moved[i] = slope[i]
        good = cholesky(factor, M)
        cholesky_solve(factor, M, moved)
        for i in range(M):
            decrease += 0.5 * slope[i] * moved[i] if good else abs(slope[i]) * 1e300
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

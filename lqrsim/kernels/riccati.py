"""The steps of the Riccati recursions: backwards from the cost-to-go at t + 1 to t, and forwards of the cost-to-come.

Paper: Eqs. (9)-(13), in discrete time. A step backwards is linear and its cost quadratic in z = (x, u):

    x_{t+1} = J z + c
    cost_t  = 1/2 z'Hz + h'z + k
    v_{t+1} = 1/2 x'S1 x + s1'x + k1

Their sum is again quadratic in z, with the paper's blocks for x and u:

    G = H + J'S1 J = [D C'; C E],    g = h + J'(S1 c + s1) = (d, e)

The control u = L x + l minimises it, and leaves the cost-to-go v_t = 1/2 x'Sx + s'x + constant:

    L = -E^-1 C,    l = -E^-1 e
    S = D + C'L,    s = d + C'l
    constant = k + k1 + 1/2 c'S1 c + s1'c + 1/2 e'l

A control that is at a limit and would go beyond it is *fixed*: a constant in step and cost, without a gain.
The backward pass determines which controls are fixed, by minimising within the limits at the expected state. The
forward pass fixes the same controls. Every control that is applied is clamped. At convergence each control minimises
the remaining cost within its limits: the first-order conditions hold, up to rounding, without a penalty or a
multiplier. iLQR's steps become steps of control-limited DDP (Tassa, Mansard and Todorov, 2014).

The cost-to-come is in one of two forms; `PRIMAL` says which. The primal form is that of the paper, Eqs. (14)-(21): a
quadratic, by inverse dynamics.

The dual form is a Kalman filter for its moments, in which the control acts as process noise. The cost-to-come is
`1/2 (x - mean)' covariance^-1 (x - mean) + constant`. The covariance may be singular, and is zero at a fixed start;
neither inverse dynamics nor an invertible A is needed. In the backward pass the costate, the gradient of the cost-to-go
at the smoothed state, is propagated from each step to the previous step (the modified Bryson-Frazier smoother). With
F = R^-1 P and h = R^-1 r, the substitution u = w - F x - h eliminates the control: At = A - B F, Qt = Q - P'F,
qt = q - P'h, ct = c - B h.
"""

from math import sqrt

from lqrsim.kernels.declarations import NOISY, PRIMAL, M, N, W, inline, stack, zeros
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    clamp,
    congruence,
    copy,
    copy_matrix,
    copy_part,
    quadratic_at,
    step_offset,
)
from lqrsim.kernels.model_functions import advance, linearize_forward, step_jacobian

# The cost-to-go.


def add_cost_to_go(t, step, stage, constant, to_go):
    """Add to a stage the cost-to-go of the state that its step leads to; return the constant of the sum."""
    S1, s1, k1 = to_go.hessian[t + 1], to_go.gradient[t + 1], to_go.constant[t + 1]
    c, v = step.offset, stack(N)
    affine(S1, s1, c, N, N, v)
    shifted = k1 + constant + quadratic_at(S1, s1, c)
    congruence(step.jacobian, S1, v, stage.hessian, stage.gradient)
    return shifted


def minimize_control(g, h, gain, feedforward, hessian, gradient):
    """Minimise `1/2 z'gz + h'z` over the control in z = (x, u), as above; the minimiser is `u = gain x + feedforward`.

    Returns the decrease due to the feedforward, or -1 if E is not positive definite.

    Args:
      gain, feedforward: L (M, N) and l (M,), written. hessian, gradient: S (N, N) and s (N,) of the minimum, written.
    """
    e, c, y = stack(M, M), stack(M, N), stack(M)
    for i in range(M):
        y[i] = h[N + i]
        copy_part(g[N + i], N, e[i], 0, M)
        copy(g[N + i], N, c[i])
    if not cholesky(e, M):
        return -1.0
    # With E = U'U: c becomes U^-T C and y becomes U^-T e.
    decrease = 0.0
    for i in range(M):
        y[i] *= e[i, i]
        decrease += 0.5 * y[i] * y[i]
        for j in range(N):
            c[i, j] *= e[i, i]
        for k in range(i + 1, M):
            factor = e[i, k]
            y[k] -= factor * y[i]
            for j in range(N):
                c[k, j] -= factor * c[i, j]
    for i in range(N):
        total = h[i]
        for k in range(M):
            total -= c[k, i] * y[k]
        gradient[i] = total
        for j in range(i, N):
            total = 0.5 * (g[i, j] + g[j, i])
            for k in range(M):
                total -= c[k, i] * c[k, j]
            hessian[i, j] = total
            hessian[j, i] = total
    # Back substitution: c becomes E^-1 C and y becomes E^-1 e.
    for i in range(M - 1, -1, -1):
        for k in range(i + 1, M):
            factor = e[i, k]
            y[i] -= factor * y[k]
            for j in range(N):
                c[i, j] -= factor * c[k, j]
        y[i] *= e[i, i]
        feedforward[i] = -y[i]
        for j in range(N):
            gain[i, j] = -e[i, i] * c[i, j]
            c[i, j] *= e[i, i]
    return decrease


def limited_control(gain, offset, x, limits, u):
    """Write the control u = gain x + offset, (M,), clamped to its limits."""
    affine(gain, offset, x, M, N, u)
    clamp(u, limits)


def fix_controls_at_limits(u, gain, limits, stage, step):
    """Fix the controls that the last backward pass fixed: the controls at a limit without a gain, (M, N).

    Stage and step, about the origin in the form for `riccati_forward`, are changed. Returns the stage's new constant
    minus the old.
    """
    constant, jacobian, c = 0.0, step.jacobian, step.offset
    for i in range(M):
        if u[i] == limits.low[i] or u[i] == limits.high[i]:
            free = False
            for j in range(N):
                free = free or gain[i, j] != 0
            if not free:
                constant += fix_control(i, u[i], stage)
                for j in range(N):
                    c[j] += jacobian[j, N + i] * u[i]
                    jacobian[j, N + i] = 0.0
    return constant


def fix_control(i, value, stage):
    """Make control i a constant in a stage about the origin; return the change of the stage's constant.

    A control without effect, of cost `1/2 (u - value)^2`, takes its place.
    """
    hessian, slope = stage.hessian, stage.gradient
    k = N + i
    constant = (slope[k] + 0.5 * hessian[k, k] * value) * value
    for j in range(W):
        if j != k:
            slope[j] += hessian[j, k] * value
            hessian[j, k], hessian[k, j] = 0.0, 0.0
    hessian[k, k], slope[k] = 1.0, -value  # 1, so that the minimiser is this value to the last bit
    return constant + 0.5 * value * value


def minimize_within(stage, x, limits, gain, feedforward, hessian, gradient):
    """Minimise a stage over the control, clamped at the state x (N,); return the decrease, and whether E is definite.

    Controls at a limit are fixed in the stage, which is about the origin. The rest is as in `minimize_control`.
    """
    low, high = limits.low, limits.high
    u, outward = stack(M), stack(M)
    decrease, constant = 0.0, 0.0
    for last in range(2):  # a loop, so that the long function is compiled once
        decrease = minimize_control(stage.hessian, stage.gradient, gain, feedforward, hessian, gradient)
        if last == 1 or not decrease >= 0:
            break
        affine(gain, feedforward, x, M, N, u)
        violated = False
        for i in range(M):
            violated = violated or u[i] < low[i] or u[i] > high[i]
        if not violated:
            break
        coordinate_descent(stage, x, limits, u)
        for i in range(M):  # all slopes first: a fixed control no longer affects the slopes of the others
            outward[i] = slope_at(stage, x, u, i)
        for i in range(M):
            if (u[i] == low[i] and outward[i] > 0) or (u[i] == high[i] and outward[i] < 0):
                constant += fix_control(i, u[i], stage)
    return decrease - constant, decrease >= 0


def coordinate_descent(stage, x, limits, u):
    """Minimise a stage over the control within its limits, at a state (N,), one control at a time until none moves."""
    low, high = limits.low, limits.high
    clamp(u, limits)
    for _ in range(1000):
        change, size = 0.0, 0.0
        for i in range(M):
            new = min(max(u[i] - slope_at(stage, x, u, i) / stage.hessian[N + i, N + i], low[i]), high[i])
            change, size = max(change, abs(new - u[i])), max(size, abs(new))
            u[i] = new
        if not change > 1e-14 * size:
            break


def slope_at(stage, x, u, i):
    """The derivative of a stage about the origin in control i, at (x, u)."""
    g = stage.hessian
    total = stage.gradient[N + i]
    for j in range(N):
        total += g[N + i, j] * x[j]
    for j in range(M):
        total += g[N + i, N + j] * u[j]
    return total


def riccati_backward(t, step, stage, constant, x, limits, policy, to_go):
    """Write policy and cost-to-go at t, if the control block is definite. Eqs. (9)-(11), (13).

    Args:
      step: LinearStep, x_{t+1} = [A B] (x, u) + c. stage, constant: the cost at t about the origin; overwritten.
      x: (N,) the state at which controls are clamped to their limits.
    """
    shifted = add_cost_to_go(t, step, stage, constant, to_go)
    decrease, good = minimize_within(
        stage, x, limits, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]
    )
    to_go.constant[t] = shifted - decrease
    return good


# The cost-to-come.


def initial_cost_to_come(Q, q, constant, x, to_go, to_come):
    """Write the cost-to-come at 0, given c_0 quadratised at x; return its constant, and whether it exists. Eq. (18).

    If the Hessian of c_0 is nearly singular or indefinite, it has no usable inverse. The dual form then adds a small
    curvature about x, relative to each state's own curvature or the cost-to-go's. Its value and gradient vanish at
    x, so an optimum stays a fixed point; other starts are reached over several iterations.
    """
    if PRIMAL:
        copy(q, N, to_come.vector[0])
        copy_matrix(Q, N, N, to_come.matrix[0])
        return constant, True
    S, covariance, mean = to_go.hessian[0], to_come.matrix[0], to_come.vector[0]
    factor, column, slope = stack(N, N), stack(N), stack(N)
    largest = 0.0
    for i in range(N):
        largest = max(largest, abs(Q[i, i]))
        slope[i] = q[i]
        column[i] = sqrt(Q[i, i]) if Q[i, i] > 0 else 0.0
    for i in range(N):
        for j in range(N):
            scale = column[i] * column[j]
            factor[i, j] = Q[i, j] / scale if scale > 0 else 0.0
    definite = cholesky(factor, N)
    for i in range(N):
        definite = definite and factor[i, i] < 1e6  # the reciprocal of the root of a pivot
    copy_matrix(Q, N, N, factor)
    if not definite:
        for i in range(N):
            little = 1e-6 * max(abs(Q[i, i]), S[i, i])
            if not little > 0:
                little = 1e-6 * largest if largest > 0 else 1e-6
            factor[i, i] += little
            slope[i] -= little * x[i]
            constant += 0.5 * little * x[i] * x[i]
    if not cholesky(factor, N):
        return constant, False
    for j in range(N):
        for i in range(N):
            column[i] = 1.0 if i == j else 0.0
        cholesky_solve(factor, N, column)
        for i in range(N):
            covariance[i, j] = column[i]
    for i in range(N):
        for j in range(i):
            covariance[i, j] = covariance[j, i] = 0.5 * (covariance[i, j] + covariance[j, i])
    for i in range(N):
        total = 0.0
        for j in range(N):
            total -= covariance[i, j] * slope[j]
        mean[i] = total
        constant += 0.5 * slope[i] * total
    return constant, True


@inline
def linearize(x, u, model, arrived, step, forward_jacobian):
    """Write the next state (N,), and the linear step of `riccati_forward`; return the forward Jacobian (N, W).

    In the primal form the linear step is the inverse, linearised there: x = jacobian (x_next, u) + offset. The
    forward Jacobian is then computed only if there is a risk, and written to `forward_jacobian`; else it is undefined.
    """
    if not PRIMAL:
        linearize_forward(x, u, model, arrived, step)
        return step.jacobian
    x_back = stack(N)
    advance(x, u, model, model.dt, arrived)
    step_jacobian(arrived, u, model, -model.dt, x_back, step.jacobian)
    step_offset(step.jacobian, arrived, u, x_back, step.offset)
    if NOISY and model.noise.risk[0] != 0:
        step_jacobian(x, u, model, model.dt, arrived, forward_jacobian)
    return forward_jacobian


def riccati_forward(t, step, stage, constant, to_come, smoothing):
    """Write the cost-to-come at t + 1 and the smoother's gains at t; return whether the cost-to-come exists.

    Args:
      step: LinearStep of `linearize`. stage, constant: the cost at t about the origin. to_come: CostToCome.
      smoothing: SmootherGains; in the primal form it gets the inverse policy u_t = Lbar x_{t+1} + lbar.
    """
    if PRIMAL:
        return primal_step(t, step, stage, constant, to_come, smoothing)
    return dual_step(t, step, stage, constant, to_come, smoothing)


@inline
def primal_step(t, step, stage, constant, to_come, smoothing):
    """`riccati_forward` by the inverse step, x_t = [Abar Bbar] (x_{t+1}, u_t) + cbar. Eqs. (15)-(17), (19)."""
    S0, s0, jacobian, c = to_come.matrix[t], to_come.vector[t], step.jacobian, step.offset
    cost, slope = stage.hessian, stage.gradient
    z, a, v, b, joint = stack(N, N), stack(N), stack(N), zeros(W), zeros(W, W)
    crossed = 0.0
    for i in range(N):
        a[i] = s0[i] + slope[i]
        v[i] = a[i]
        for j in range(N):
            z[i, j] = S0[i, j] + cost[i, j]
            v[i] += z[i, j] * c[j]
        for j in range(M):
            crossed += abs(cost[i, N + j])
    for i in range(M):
        b[N + i] = slope[N + i]
        copy_part(cost[N + i], N, joint[N + i], N, M)
    if crossed != 0:
        # The cross term u'P x_t in terms of (x_{t+1}, u): P Abar, P Bbar + its transpose, P cbar.
        for i in range(M):
            for k in range(N):
                factor = cost[N + i, k]
                b[N + i] += factor * c[k]
                for j in range(W):
                    joint[N + i, j] += factor * jacobian[k, j]
                    joint[j, N + i] += factor * jacobian[k, j]
    shifted = to_come.constant[t] + constant + quadratic_at(z, a, c)
    congruence(jacobian, z, v, joint, b)
    decrease = minimize_control(
        joint, b, smoothing.control_gain[t], smoothing.control[t], to_come.matrix[t + 1], to_come.vector[t + 1]
    )
    to_come.constant[t + 1] = shifted - decrease
    return decrease >= 0


@inline
def dual_step(t, step, stage, constant, to_come, smoothing):
    """`riccati_forward` by the step x_{t+1} = [A B] (x, u) + c."""
    jacobian, c, cost, slope = step.jacobian, step.offset, stage.hessian, stage.gradient
    V0, mean, V, next_mean = to_come.matrix[t], to_come.vector[t], to_come.matrix[t + 1], to_come.vector[t + 1]
    updated, gain, feedforward = smoothing.state[t], smoothing.control_gain[t], smoothing.control[t]
    factor, F, h, AT, BT = stack(M, M), stack(M, N), stack(M), stack(N, N), stack(M, N)
    Q, q, diagonal, slope_at_mean = stack(N, N), stack(N), stack(N), stack(N)
    # Products are formed in arrays of this function and then copied: without aliasing they become vector code.
    U, G = stack(N, N), stack(N, N)
    # Eliminate the control from the step and its stage.
    crossed = 0.0
    for i in range(M):
        h[i] = slope[N + i]
        copy_part(cost[N + i], N, factor[i], 0, M)
        for j in range(N):
            F[i, j] = cost[N + i, j]
            BT[i, j] = jacobian[j, N + i]
            crossed += abs(F[i, j])
    if not cholesky(factor, M):
        return False
    cholesky_solve(factor, M, h)
    for i in range(N):
        q[i], diagonal[i] = slope[i], abs(cost[i, i])
        for j in range(N):
            Q[i, j] = cost[i, j]
            AT[i, j] = jacobian[j, i]
    if crossed != 0:
        forward_substitute(factor, F)
        back_substitute(factor, F)
        for k in range(M):
            for i in range(N):
                q[i] -= cost[N + k, i] * h[k]
                for j in range(N):
                    Q[i, j] -= cost[N + k, i] * F[k, j]
                    AT[i, j] -= F[k, i] * BT[k, j]
    # Update with the cost of the stage: first its value and gradient at the mean.
    value = to_come.constant[t] + constant
    for k in range(M):
        value -= 0.5 * slope[N + k] * h[k]
    for i in range(N):
        row_product = 0.0
        for j in range(N):
            row_product += Q[i, j] * mean[j]
            U[i, j] = V0[i, j]
        slope_at_mean[i] = row_product + q[i]
        value += (0.5 * row_product + q[i]) * mean[i]
    if not update(U, Q, diagonal):
        return False
    for i in range(N):
        shift = 0.0
        for j in range(N):
            shift += U[i, j] * slope_at_mean[j]
        updated[i] = mean[i] - shift
        value -= 0.5 * slope_at_mean[i] * shift
    # Predict along the step, with the control as noise.
    for i in range(N):
        for j in range(N):
            total = 0.0
            for k in range(N):
                total += U[i, k] * AT[k, j]
            G[i, j] = total
        total = c[i]
        for j in range(N):
            total += AT[j, i] * updated[j]
        for k in range(M):
            total -= BT[k, i] * h[k]
        next_mean[i] = total
    forward_substitute(factor, BT)
    for i in range(N):
        for j in range(N):
            total = 0.0
            for k in range(N):
                total += AT[k, i] * G[k, j]
            for k in range(M):
                total += BT[k, i] * BT[k, j]
            U[i, j] = total
    for i in range(N):
        for j in range(N):
            smoothing.state_gain[t, i, j] = G[i, j]
            V[i, j] = U[i, j] if i <= j else U[j, i]
    back_substitute(factor, BT)
    # The control at t, an affine function of the costate at t + 1.
    for k in range(M):
        feedforward[k] = -h[k]
        for j in range(N):
            gain[k, j] = -BT[k, j]
    if crossed != 0:
        for k in range(M):
            for i in range(N):
                feedforward[k] -= F[k, i] * updated[i]
                for j in range(N):
                    gain[k, j] += F[k, i] * G[i, j]
    to_come.constant[t + 1] = value
    return True


def forward_substitute(factor, rows):
    """Turn rows (M, N) into U^-T rows, given the Cholesky factor U (M, M)."""
    for i in range(M):
        for j in range(N):
            rows[i, j] *= factor[i, i]
        for k in range(i + 1, M):
            for j in range(N):
                rows[k, j] -= factor[i, k] * rows[i, j]


def back_substitute(factor, rows):
    """Turn rows (M, N) into U^-1 rows, given the Cholesky factor U (M, M)."""
    for i in range(M - 1, -1, -1):
        for k in range(i + 1, M):
            for j in range(N):
                rows[i, j] -= factor[i, k] * rows[k, j]
        for j in range(N):
            rows[i, j] *= factor[i, i]


def update(V, Q, diagonal):
    """Turn V into (V^-1 + Q)^-1, for V and Q semidefinite, in place; False if it does not exist.

    With Q = sum of d f f', V is updated by one rank-one term at a time: V - K f'V with K = d V f / (1 + d f'V f). If
    1 + d f'V f is large, digits cancel. The update is then completed to Joseph's form, (I - K f') V (I - K f')' +
    K K' / d: a sum of squares, which keeps V semidefinite. Zero rows of Q are skipped, so a cost of few states, as of
    obstacles, is cheap.

    Args:
      V: (N, N), overwritten. Q: (N, N), destroyed.
      diagonal: (N,) absolute diagonal of Q before the control was eliminated; much smaller pivots are rounding errors.
    """
    f, w, gain = stack(N), stack(N), stack(N)
    scale = 0.0
    for i in range(N):
        scale = max(scale, diagonal[i])
    for i in range(N):
        d = Q[i, i]
        if abs(d) <= 1e-14 * diagonal[i]:  # then the row is also zero, unless Q is indefinite
            for j in range(i + 1, N):
                if not abs(Q[i, j]) <= 1e-6 * scale:
                    return False
            continue
        for j in range(N):
            f[j] = Q[i, j] / d if j >= i else 0.0
            w[j] = V[i, j]  # f[i] is 1
        for k in range(i + 1, N):
            if f[k] != 0:
                for j in range(N):
                    Q[k, j] -= d * f[k] * f[j]
                    w[j] += f[k] * V[k, j]
        total = w[i]
        for j in range(i + 1, N):
            total += f[j] * w[j]
        total = 1 + d * total
        if not total > 0:
            return False
        for j in range(N):
            gain[j] = d / total * w[j]
            for k in range(N):
                V[j, k] -= gain[j] * w[k]
        if total > 1e3:
            for j in range(N):
                left = 0.0
                for k in range(N):
                    left += V[j, k] * f[k]
                w[j] = left
            for j in range(N):
                for k in range(N):
                    V[j, k] += (gain[j] / d - w[j]) * gain[k]
    return True


def smoothed_state(t, to_go, to_come, costate, x):
    """Write the smoothed state (N,) at t, and the costate there, (N,); return whether it exists.

    In the primal form they are x = -(S + Sbar)^-1 (s + sbar), Eq. (21), and S x + s; in the dual form x = mean - V
    costate and (I + S V)^-1 (S mean + s), with V the covariance.
    """
    S, s, a = to_go.hessian[t], to_go.gradient[t], stack(N, N)
    if PRIMAL:
        Sbar, sbar = to_come.matrix[t], to_come.vector[t]
        for i in range(N):
            x[i] = -(s[i] + sbar[i])
            for j in range(N):
                a[i, j] = S[i, j] + Sbar[i, j]
        if not cholesky(a, N):
            return False
        cholesky_solve(a, N, x)
        affine(S, s, x, N, N, costate)
        return True
    V, mean = to_come.matrix[t], to_come.vector[t]
    for i in range(N):
        for j in range(N):
            total = 1.0 if i == j else 0.0
            for k in range(N):
                total += S[i, k] * V[k, j]
            a[i, j] = total
    affine(S, s, mean, N, N, costate)
    if not solve(a, costate):
        return False
    for i in range(N):
        total = mean[i]
        for j in range(N):
            total -= V[i, j] * costate[j]
        x[i] = total
    return True


def solve(a, b):
    """Solve a y = b in place, (N, N) and (N,), by elimination with row pivots; False for a singular matrix.

    Whole rows are subtracted, zeros included: loops of constant length are faster than shorter ones.
    """
    for k in range(N):
        pivot, largest = k, abs(a[k, k])
        for i in range(k + 1, N):
            if abs(a[i, k]) > largest:
                pivot, largest = i, abs(a[i, k])
        if not largest > 0:  # a NaN too
            return False
        if pivot != k:
            b[k], b[pivot] = b[pivot], b[k]
            for j in range(N):
                a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
        inverse = 1 / a[k, k]
        for i in range(k + 1, N):
            factor = inverse * a[i, k]
            b[i] -= factor * b[k]
            for j in range(N):
                a[i, j] -= factor * a[k, j]
        b[k] *= inverse
        for j in range(N):
            a[k, j] *= inverse
    for k in range(N - 1, 0, -1):
        for i in range(k):
            b[i] -= a[i, k] * b[k]
    return True


def previous_state(t, x_hat, costate, smoothing, model, x, u):
    """Write the state (N,) and control (M,) at t, given the smoothed state (N,) at t + 1 and the costate (N,) there."""
    if PRIMAL:
        limited_control(smoothing.control_gain[t], smoothing.control[t], x_hat, model.limits, u)
        advance(x_hat, u, model, -model.dt, x)
        return
    for i in range(N):
        total = smoothing.state[t, i]
        for j in range(N):
            total -= smoothing.state_gain[t, i, j] * costate[j]
        x[i] = total
    affine(smoothing.control_gain[t], smoothing.control[t], costate, M, N, u)
    clamp(u, model.limits)

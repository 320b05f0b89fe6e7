"""One step of the Riccati recursion, from the cost-to-go at t + 1 to t.

Paper: Eqs. (9)-(13), in discrete time. The step is linear and the cost quadratic in z = (x, u):

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
"""

from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import affine, cholesky, clamp, congruence, copy, copy_part, quadratic_at


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
        moved, size = 0.0, 0.0
        for i in range(M):
            new = min(max(u[i] - slope_at(stage, x, u, i) / stage.hessian[N + i, N + i], low[i]), high[i])
            moved, size = max(moved, abs(new - u[i])), max(size, abs(new))
            u[i] = new
        if not moved > 1e-14 * size:
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

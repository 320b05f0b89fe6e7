"""Limits of the controls.

A control that is at a limit and would go beyond it is *fixed*: a constant in step and cost, without a gain.
The backward pass determines which controls are fixed, by minimising within the limits at the expected state. The
forward pass fixes the same controls. Every control that is applied is clamped. At convergence each control minimises
the remaining cost within its limits: the first-order conditions hold, up to rounding, without a penalty or a
multiplier. iLQR's steps become steps of control-limited DDP (Tassa, Mansard and Todorov, 2014).
"""

from lqrsim.kernels.cost_to_go import add_cost_to_go, minimize_control
from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import affine, clamp


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

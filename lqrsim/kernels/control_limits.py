"""Limits of the controls. The kernels' subset.

A control that stands at a limit and would go beyond it is *fixed*: a constant in step and cost, with no gain.
The backward pass finds out which controls are, by minimising within the limits where the state is expected to be; the
forward pass takes the same ones out; and wherever a control is applied, it is cut off at its limits. Where that
settles, each control minimises what is left of the cost within its limits: the conditions of first order, to rounding,
without a penalty or a multiplier. iLQR's steps become those of control-limited DDP (Tassa, Mansard and Todorov, 2014).
"""

from lqrsim.kernels.cost_to_go import add_cost_to_go, minimize_control
from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import within


def fix_control(i, value, stage, step) -> float:
    """Make control i a constant in a step and a stage about the origin, as `riccati_forward` takes them.

    In its place comes one that does nothing and costs `1/2 (u - value)^2`. Returns what the stage's constant gains.
    """
    constant = fix_control_in_cost(i, value, stage)
    jacobian, c = step.jacobian, step.offset
    for j in range(N):
        c[j] += jacobian[j, N + i] * value
        jacobian[j, N + i] = 0.0
    return constant


def fix_control_in_cost(i, value, stage) -> float:
    """The same for the cost alone."""
    hessian, slope = stage.hessian, stage.gradient
    k = N + i
    constant = (slope[k] + 0.5 * hessian[k, k] * value) * value
    for j in range(W):
        if j != k:
            slope[j] += hessian[j, k] * value
            hessian[j, k], hessian[k, j] = 0.0, 0.0
    hessian[k, k], slope[k] = 1.0, -value  # 1, so that the minimiser is this value to the last bit
    return constant + 0.5 * value * value


def fix_controls_at_limits(u, gain, limits, stage, step) -> float:
    """Fix the controls that the last backward pass fixed: at a limit, without a gain. Returns what the stage gains."""
    constant = 0.0
    for i in range(M):
        if u[i] == limits.low[i] or u[i] == limits.high[i]:
            free = False
            for j in range(N):
                free = free or gain[i, j] != 0
            if not free:
                constant += fix_control(i, u[i], stage, step)
    return constant


def minimize_within(stage, x, limits, gain, feedforward, hessian, gradient) -> tuple[float, bool]:
    """As `minimize_control`, but the control keeps its limits at the state x (N,), and those at a limit are fixed.

    Returns the decrease that the feedforward brings, and whether the control block is positive definite.
    """
    low, high = limits.low, limits.high
    u, outward = stack(M), stack(M)
    decrease, constant = 0.0, 0.0
    for last in range(2):  # one call in the text, for it takes long to compile
        decrease = minimize_control(stage.hessian, stage.gradient, gain, feedforward, hessian, gradient)
        if last == 1 or not decrease >= 0:
            break
        beyond = False
        for i in range(M):
            u[i] = feedforward[i]
            for j in range(N):
                u[i] += gain[i, j] * x[j]
            beyond = beyond or u[i] < low[i] or u[i] > high[i]
        if not beyond:
            break
        coordinate_descent(stage, x, limits, u)
        for i in range(M):  # all of them first: what is fixed no longer shows in the slopes of the others
            outward[i] = slope_at(stage, x, u, i)
        for i in range(M):
            if (u[i] == low[i] and outward[i] > 0) or (u[i] == high[i] and outward[i] < 0):
                constant += fix_control_in_cost(i, u[i], stage)
    return decrease - constant, decrease >= 0


def coordinate_descent(stage, x, limits, u) -> None:
    """Write the control of least cost within the limits at a state: one entry after the other, until none moves."""
    low, high = limits.low, limits.high
    within(u, limits)
    for _ in range(1000):
        moved, size = 0.0, 0.0
        for i in range(M):
            new = u[i] - slope_at(stage, x, u, i) / stage.hessian[N + i, N + i]
            if new < low[i]:
                new = low[i]
            elif new > high[i]:
                new = high[i]
            moved, size = max(moved, abs(new - u[i])), max(size, abs(new))
            u[i] = new
        if not moved > 1e-14 * size:
            break


def slope_at(stage, x, u, i) -> float:
    """The slope of a stage about the origin along control i, at (x, u)."""
    g = stage.hessian
    total = stage.gradient[N + i]
    for j in range(N):
        total += g[N + i, j] * x[j]
    for j in range(M):
        total += g[N + i, N + j] * u[j]
    return total


def riccati_backward_within(t, step, stage, constant, x, limits, policy, to_go) -> bool:
    """As `riccati_backward`, within the limits at the state x."""
    shifted = add_cost_to_go(t, step, stage, constant, to_go)
    decrease, good = minimize_within(
        stage, x, limits, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]
    )
    to_go.constant[t] = shifted - decrease
    return good

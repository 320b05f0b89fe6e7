"""Limits of the controls. The numba subset; see `interface.py`.

A control that stands at a limit and would go beyond it is *held*: a constant in the step and in the cost, with no gain.
The backward pass finds out which controls are, by minimising within the limits where the state is expected to be; the
forward pass takes the same ones out; and wherever a control is applied, it is cut off at its limits. Where that
settles, each control minimises what is left of the cost within its limits: the conditions of first order, to rounding,
without a penalty or a multiplier. iLQR's steps become those of control-limited DDP (Tassa, Mansard and Todorov, 2014).
"""

from lqrsim.kernels.interface import LIMITS, M, N, W, stack
from lqrsim.kernels.linear_algebra import ahead, minimize_control, within


def limits(stage, low, high) -> None:
    """Write the limits of the controls, (M,) each: infinite where there is none."""
    for i in range(M):
        low[i], high[i] = stage[LIMITS][i], stage[LIMITS][M + i]


def hold(i, value, hessian, slope, jacobian, c) -> float:
    """Make control i a constant in a step and a stage about the origin, as `riccati_forward` takes them.

    In its place comes one that does nothing and costs `1/2 (u - value)^2`. Returns what the stage's constant gains.
    """
    constant = hold_cost(i, value, hessian, slope)
    for j in range(N):
        c[j] += jacobian[j, N + i] * value
        jacobian[j, N + i] = 0.0
    return constant


def hold_cost(i, value, hessian, slope) -> float:
    """The same for the cost alone."""
    k = N + i
    constant = (slope[k] + 0.5 * hessian[k, k] * value) * value
    for j in range(W):
        if j != k:
            slope[j] += hessian[j, k] * value
            hessian[j, k], hessian[k, j] = 0.0, 0.0
    hessian[k, k], slope[k] = 1.0, -value  # 1, so that the minimiser is this value to the last bit
    return constant + 0.5 * value * value


def hold_those_at_limits(u, gain, low, high, hessian, slope, jacobian, c) -> float:
    """Hold the controls that the last backward pass held: at a limit, without a gain. Returns what the stage gains."""
    constant = 0.0
    for i in range(M):
        if u[i] == low[i] or u[i] == high[i]:
            free = False
            for j in range(N):
                free = free or gain[i, j] != 0
            if not free:
                constant += hold(i, u[i], hessian, slope, jacobian, c)
    return constant


def minimize_within(g, h, x, low, high, gain, feedforward, hessian, gradient) -> tuple[float, bool]:
    """As `minimize_control`, but the control keeps its limits at the state x (N,), and those at a limit are held.

    Returns the decrease that the feedforward brings, and whether the control block is positive definite.
    """
    u, outward = stack(M), stack(M)
    decrease, constant = 0.0, 0.0
    for last in range(2):  # one call in the text, for it takes long to compile
        decrease = minimize_control(g, h, gain, feedforward, hessian, gradient)
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
        settle(g, h, x, low, high, u)
        for i in range(M):  # all of them first: what is held no longer shows in the slopes of the others
            outward[i] = slope_at(g, h, x, u, i)
        for i in range(M):
            if (u[i] == low[i] and outward[i] > 0) or (u[i] == high[i] and outward[i] < 0):
                constant += hold_cost(i, u[i], g, h)
    return decrease - constant, decrease >= 0


def settle(g, h, x, low, high, u) -> None:
    """Write the control of least cost within the limits at a state: one entry after the other, until none moves."""
    within(u, low, high)
    for _ in range(1000):
        moved, size = 0.0, 0.0
        for i in range(M):
            new = u[i] - slope_at(g, h, x, u, i) / g[N + i, N + i]
            if new < low[i]:
                new = low[i]
            elif new > high[i]:
                new = high[i]
            moved, size = max(moved, abs(new - u[i])), max(size, abs(new))
            u[i] = new
        if not moved > 1e-14 * size:
            break


def slope_at(g, h, x, u, i) -> float:
    """The slope of `1/2 z'gz + h'z` along control i, at z = (x, u)."""
    total = h[N + i]
    for j in range(N):
        total += g[N + i, j] * x[j]
    for j in range(M):
        total += g[N + i, N + j] * u[j]
    return total


def riccati_backward_within(
    jacobian, c, cost, slope, constant, S1, s1, k1, x, low, high, gain, feedforward, S, s
) -> tuple[float, bool]:
    """As `riccati_backward`, within the limits at the state x."""
    shifted = ahead(jacobian, c, cost, slope, constant, S1, s1, k1)
    decrease, good = minimize_within(cost, slope, x, low, high, gain, feedforward, S, s)
    return shifted - decrease, good

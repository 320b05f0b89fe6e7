"""A control period as several Runge-Kutta steps of equal length, with the control held.

Its derivatives follow from those of a step by the chain rule: Jacobians forwards, weights of the last state backwards.
"""

from lqrsim.kernels.declarations import M, N, W, compact, part_curvature, stack, zeros
from lqrsim.kernels.linear_algebra import copy, copy_matrix
from lqrsim.kernels.runge_kutta import advance as part
from lqrsim.kernels.runge_kutta import state_jacobians as state_jacobians
from lqrsim.kernels.runge_kutta import step_jacobian as part_jacobian

PARTS = 2  # number of steps


@compact
def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds; a negative `h` leads backwards in time, as for one step."""
    z = stack(N)
    copy(x, N, z)
    for _ in range(PARTS):
        part(z, u, p, h / PARTS, out)
        copy(out, N, z)


@compact
def step_jacobian(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W)."""
    z, own = stack(N), stack(N, W)
    copy(x, N, z)
    begin(jacobian)
    for _ in range(PARTS):
        part_jacobian(z, u, p, h / PARTS, out, own)
        follow(own, jacobian, jacobian)
        copy(out, N, z)


@compact
def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write a period and its Jacobian; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    states, slopes = stack(PARTS + 1, N), stack(PARTS + 1, N, W)  # at the beginning of each step, and at the end
    own, w, before = stack(N, W), stack(N), stack(N)
    copy(x, N, states[0])
    begin(slopes[0])
    for k in range(PARTS):
        part_jacobian(states[k], u, p, h / PARTS, states[k + 1], own)
        follow(own, slopes[k], slopes[k + 1])
    for i in range(N):
        out[i] = states[PARTS, i]
        w[i] = weights[i]
        for j in range(W):
            jacobian[i, j] = slopes[PARTS, i, j]
    for back in range(PARTS):
        k = PARTS - 1 - back
        curve, arrived = zeros(W, W), stack(N)
        part_curvature(states[k], u, p, h / PARTS, w, arrived, own, curve)
        pull_back(curve, slopes[k], hessian)
        for j in range(N):
            before[j] = 0.0
            for i in range(N):
                before[j] += own[i, j] * w[i]
        copy(before, N, w)


def begin(slopes):
    """Write the Jacobian [1 0] of a state in itself and the control, (N, W)."""
    for i in range(N):
        for j in range(W):
            slopes[i, j] = 1.0 if i == j else 0.0


def follow(step_jacobian, before, after):
    """Write the Jacobian (N, W) after a step [A B], `A before + [0 B]`; both may be the same array."""
    product = stack(N, W)
    for i in range(N):
        for j in range(W):
            product[i, j] = step_jacobian[i, j] if j >= N else 0.0
        for k in range(N):
            for j in range(W):
                product[i, j] += step_jacobian[i, k] * before[k, j]
    copy_matrix(product, N, W, after)


def pull_back(curve, slopes, total):
    """Add G' curve G, (W, W), where G is a step's Jacobian of state and control in those of the period."""
    product = stack(W, W)
    for i in range(W):
        for j in range(W):
            product[i, j] = curve[i, j] if j >= N else 0.0
        for k in range(N):
            for j in range(W):
                product[i, j] += curve[i, k] * slopes[k, j]
    for i in range(W):
        for j in range(W):
            for k in range(N):
                total[i, j] += slopes[k, i] * product[k, j]
    for i in range(M):
        for j in range(W):
            total[N + i, j] += product[N + i, j]

"""One Runge-Kutta step with the control held, its Jacobian and its curvature.

A negative `h` steps backwards in time: the approximate inverse `gbar` of the step, exact to O(h^5).

Of dynamics that are stated as a map, `rate` is the next state F(x, u), and the map knows by itself how long a step is.
It has no inverse: backwards in time the result is NaN, as by MuJoCo's steps.

A control period may be several steps of equal length: the functions `..._in_parts` take the place of those of one step.
Their derivatives follow by the chain rule: Jacobians forwards, weights of the last state backwards.
"""

from math import nan

from lqrsim.kernels.declarations import M, N, W, compact, rate, rate_curvature, rate_jacobian, stack, zeros
from lqrsim.kernels.linear_algebra import copy, copy_matrix, copy_part, fill

SUPPORT = (0,)  # entries of (x, u) in which the rates are nonlinear, states first
K = 1  # their number
STATES = 1  # the number of states among them
MAP = 0  # 1 for a map
PARTS = 2  # number of steps in a period


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    if MAP:
        if h > 0:
            rate(x, u, p, out)
        else:
            fill(out, N, nan)
        return
    z, k = stack(N), stack(N)
    for i in range(N):
        out[i] = z[i] = x[i]
    for stage in range(4):
        weight = h / 6 if stage == 0 or stage == 3 else h / 3
        delta = 0.5 * h if stage < 2 else h
        rate(z, u, p, k)
        for i in range(N):
            out[i] += weight * k[i]
            z[i] = x[i] + delta * k[i]


def chain(fx, fu, previous, a, out):
    """Write `fx ([1 0] + a previous) + [0 fu]`, (N, W): a Runge-Kutta stage's Jacobian in (x, u), a seconds after x.

    Dynamics with known zeros have their own `chain`; see `write_chain` in `codegen/symbolic.py`.
    """
    row = stack(W)  # a local array instead of out[i] stays in registers
    for i in range(N):
        copy(fx[i], N, row)
        copy_part(fu[i], 0, row, N, M)
        for k in range(N):
            if fx[i, k] != 0:  # most systems couple few states
                factor = a * fx[i, k]
                for j in range(W):
                    row[j] += factor * previous[k, j]
        copy(row, W, out[i])


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W).

    The four stages are written out, because a loop over them is slower.
    """
    fx, fu = zeros(N, N), zeros(N, M)
    if MAP:
        rate_jacobian(x, u, p, out, fx, fu)
        for i in range(N):
            copy(fx[i], N, jacobian[i])
            copy_part(fu[i], 0, jacobian[i], N, M)
        return
    k, z, first, second = stack(N), stack(N), stack(N, W), stack(N, W)
    rate_jacobian(x, u, p, k, fx, fu)
    for i in range(N):
        out[i] = k[i]
        z[i] = x[i] + 0.5 * h * k[i]
        copy(fx[i], N, first[i])
        copy_part(fu[i], 0, first[i], N, M)
        copy(first[i], W, jacobian[i])
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, first, 0.5 * h, second)
    for i in range(N):
        out[i] += 2 * k[i]
        z[i] = x[i] + 0.5 * h * k[i]
        for j in range(W):
            jacobian[i, j] += 2 * second[i, j]
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, second, 0.5 * h, first)
    for i in range(N):
        out[i] += 2 * k[i]
        z[i] = x[i] + h * k[i]
        for j in range(W):
            jacobian[i, j] += 2 * first[i, j]
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, first, h, second)
    for i in range(N):
        out[i] = x[i] + h / 6 * (out[i] + k[i])
        for j in range(W):
            jacobian[i, j] = h / 6 * (jacobian[i, j] + second[i, j])
        jacobian[i, i] += 1


@compact
def state_jacobians(count, states, controls, p, slopes):
    """Write df/dx to slopes (count, N, N), which are zero on entry, at states (count, N) and controls (count, M)."""
    for t in range(count):
        k, fu = stack(N), zeros(N, M)
        rate_jacobian(states[t], controls[t], p, k, slopes[t], fu)


# The Hessian of a step times weights, for rates with second derivatives. A sweep backwards through the stages turns the
# weights of the next state into weights of each stage's rates. The Hessian of the weighted rates at a stage is then
# pulled back to the step's state and control by the Jacobian of the stage.


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian as above; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    curve = zeros(K, K)
    if MAP:
        step_jacobian(x, u, p, h, out, jacobian)
        full_curvature(x, u, p, weights, curve)
        for a in range(K):
            for b in range(K):
                hessian[SUPPORT[a], SUPPORT[b]] += curve[a, b]
        return
    k, z2, z3, z4 = stack(N), stack(N), stack(N), stack(N)
    fu, fx1, fx2, fx3, fx4 = zeros(N, M), zeros(N, N), zeros(N, N), zeros(N, N), zeros(N, N)
    slope1, slope2, slope3, slope4 = stack(N, W), stack(N, W), stack(N, W), stack(N, W)
    w1, w2, w3, w4 = stack(N), stack(N), stack(N), stack(N)
    rate_jacobian(x, u, p, k, fx1, fu)
    for i in range(N):
        out[i] = k[i]
        z2[i] = x[i] + 0.5 * h * k[i]
        copy(fx1[i], N, slope1[i])
        copy_part(fu[i], 0, slope1[i], N, M)
    rate_jacobian(z2, u, p, k, fx2, fu)
    chain(fx2, fu, slope1, 0.5 * h, slope2)
    for i in range(N):
        out[i] += 2 * k[i]
        z3[i] = x[i] + 0.5 * h * k[i]
    rate_jacobian(z3, u, p, k, fx3, fu)
    chain(fx3, fu, slope2, 0.5 * h, slope3)
    for i in range(N):
        out[i] += 2 * k[i]
        z4[i] = x[i] + h * k[i]
    rate_jacobian(z4, u, p, k, fx4, fu)
    chain(fx4, fu, slope3, h, slope4)
    for i in range(N):
        out[i] = x[i] + h / 6 * (out[i] + k[i])
        w4[i] = h / 6 * weights[i]
        for j in range(W):
            jacobian[i, j] = h / 6 * (slope1[i, j] + 2 * slope2[i, j] + 2 * slope3[i, j] + slope4[i, j])
        jacobian[i, i] += 1
    back(fx4, w4, h, h / 3, weights, w3)
    back(fx3, w3, 0.5 * h, h / 3, weights, w2)
    back(fx2, w2, 0.5 * h, h / 6, weights, w1)
    full_curvature(x, u, p, w1, curve)
    for a in range(K):
        for b in range(K):
            hessian[SUPPORT[a], SUPPORT[b]] += curve[a, b]
    add_curvature(z2, u, p, w2, 0.5 * h, slope1, hessian)
    add_curvature(z3, u, p, w3, 0.5 * h, slope2, hessian)
    add_curvature(z4, u, p, w4, h, slope3, hessian)


def back(fx, after, delta, weight, weights, before):
    """Write the weights (N,) of a stage's rates, given the next stage's weights."""
    for j in range(N):
        total = 0.0
        for i in range(N):
            total += fx[i, j] * after[i]
        before[j] = weight * weights[j] + delta * total


def full_curvature(x, u, p, w, curve):
    """Write the second derivatives of the weighted rates, (K, K), on both sides of the diagonal."""
    rate_curvature(x, u, p, w, curve)
    for a in range(K):
        for b in range(a):
            curve[b, a] = curve[a, b]


def add_curvature(z, u, p, weights, delta, slope, total):
    """Add the Hessian (W, W) of the weighted rates at a stage with state `x + delta k`; `slope` (N, W) is k's."""
    curve, rows, product = zeros(K, K), stack(STATES + 1, W), stack(K, W)
    line = stack(W)  # a local array, not a row of a matrix, stays in registers
    full_curvature(z, u, p, weights, curve)
    for a in range(STATES):
        for j in range(W):
            rows[a, j] = delta * slope[SUPPORT[a], j]
        rows[a, SUPPORT[a]] += 1
    for a in range(K):
        fill(line, W, 0.0)
        for b in range(STATES):
            for j in range(W):
                line[j] += curve[a, b] * rows[b, j]
        for b in range(STATES, K):  # controls are held: their rows are the identity's
            line[SUPPORT[b]] += curve[a, b]
        copy(line, W, product[a])
    for i in range(W):
        copy(total[i], W, line)
        for a in range(STATES):
            for j in range(W):
                line[j] += rows[a, i] * product[a, j]
        copy(line, W, total[i])
    for a in range(STATES, K):
        for j in range(W):
            total[SUPPORT[a], j] += product[a, j]


# Several steps.


@compact
def advance_in_parts(x, u, p, h, out):
    """Write the state (N,) after `h` seconds; a negative `h` leads backwards in time, as for one step."""
    z = stack(N)
    copy(x, N, z)
    for _ in range(PARTS):
        advance(z, u, p, h / PARTS, out)
        copy(out, N, z)


@compact
def step_jacobian_in_parts(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W)."""
    z, step = stack(N), stack(N, W)
    copy(x, N, z)
    begin(jacobian)
    for _ in range(PARTS):
        step_jacobian(z, u, p, h / PARTS, out, step)
        follow(step, jacobian, jacobian)
        copy(out, N, z)


@compact
def step_curvature_in_parts(x, u, p, h, weights, out, jacobian, hessian):
    """Write a period and its Jacobian; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    states, slopes = stack(PARTS + 1, N), stack(PARTS + 1, N, W)  # at the beginning of each step, and at the end
    step, w, before = stack(N, W), stack(N), stack(N)
    copy(x, N, states[0])
    begin(slopes[0])
    for k in range(PARTS):
        step_jacobian(states[k], u, p, h / PARTS, states[k + 1], step)
        follow(step, slopes[k], slopes[k + 1])
    for i in range(N):
        out[i] = states[PARTS, i]
        w[i] = weights[i]
        for j in range(W):
            jacobian[i, j] = slopes[PARTS, i, j]
    for back in range(PARTS):
        k = PARTS - 1 - back
        curve, arrived = zeros(W, W), stack(N)
        step_curvature(states[k], u, p, h / PARTS, w, arrived, step, curve)
        pull_back(curve, slopes[k], hessian)
        for j in range(N):
            before[j] = 0.0
            for i in range(N):
                before[j] += step[i, j] * w[i]
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

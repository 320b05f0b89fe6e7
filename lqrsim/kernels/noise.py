"""What noise is expected to cost, as part of each stage. The numba subset; see `declarations.py`.

With x' = g(x, u) + M(x, u) w and w ~ N(0, I), a quadratic cost-to-go v with Hessian S at t + 1 has the expectation

    E v(g + M w) = v(g) + 1/2 tr M'SM

so noise is one more cost of the stage, which depends on S alone: the backward pass has just worked S out, and the
forward pass takes that of the last backward pass. Where dynamics and M are linear and costs quadratic, this is exact.

With a risk theta it is (1/theta) log E exp(theta v(g + M w)), and with d = S g + s, the slope of v there,

    v(g) + theta/2 d'M W M'd - 1/(2 theta) log det(I - theta M'SM),    W = (I - theta M'SM)^-1

which exists where I - theta M'SM is positive definite. For theta to 0 it is the expectation, and for theta above 0 it
is what v is at g + y, y = theta M W M'd, the worst noise, less what that would cost.

Slopes are exact, curvatures Gauss-Newton's: second derivatives of M, and what of the curvature can be negative, are
left out. The matrices here are compact: the rows of M that are not zero everywhere, and of (x, u) what M depends on.
"""

from math import inf, log1p, sqrt

from lqrsim.kernels.declarations import (
    M,
    N,
    W,
    final_value,
    initial_value,
    noise_slopes,
    noise_values,
    stack,
    stage_value,
)
from lqrsim.kernels.linear_algebra import affine, within
from lqrsim.kernels.runge_kutta import advance

ROWS = (0,)  # the states that noise acts on at once
COUNT = 1  # how many these are
SIZE = 1  # independent normal numbers in w
ACTIVE = (0,)  # entries of (x, u) that M depends on
SOME = 1  # how many these are

# The numba subset


def noise_value(x, u, model, ahead):
    """What it is expected to cost; infinite where the risk is too high."""
    values, mixed, slope = stack(COUNT, SIZE), stack(COUNT, SIZE), stack(COUNT)
    factor, root, weighed = stack(SIZE, SIZE), stack(SIZE), stack(COUNT, SIZE)
    noise_values(x, u, model.noise[0], values)
    weigh(ahead.hessian, values, weighed)
    theta = model.noise[1][0]
    if theta == 0:
        return half_trace(values, weighed)
    total, good = factor_of_risk(theta, values, weighed, factor, root)
    if not good:
        return inf
    mix(theta, factor, root, values, mixed)
    slope_ahead(ahead, slope)
    return total + 0.5 * theta * square_along(mixed, slope)


def noise_quadratic(x, u, model, ahead, convex, stage):
    """Add the quadratic model to a stage, Hessian (W, W) and gradient (W,), and return the value.

    With `convex` what is added is positive semidefinite, with a negative risk, too. Where the risk is too high the
    Hessian is spoilt, so that the pass fails, and `model.noise[1][1]` is 1.
    """
    values, slopes = stack(COUNT, SIZE), stack(SIZE, COUNT, SOME)
    weighed, factor, root = stack(COUNT, SIZE), stack(SIZE, SIZE), stack(SIZE)
    noise_slopes(x, u, model.noise[0], values, slopes)
    weigh(ahead.hessian, values, weighed)
    theta = model.noise[1][0]
    if theta == 0:
        if SOME:
            add_weighed(ahead.hessian, weighed, slopes, stage)
        return half_trace(values, weighed)
    total, good = factor_of_risk(theta, values, weighed, factor, root)
    model.noise[1][1] = 0.0 if good else 1.0
    if not good:
        stage.hessian[W - 1, W - 1] = -inf
        return inf
    mixed, slope = stack(COUNT, SIZE), stack(COUNT)
    mix(theta, factor, root, values, mixed)
    if SOME:
        weigh(ahead.hessian, mixed, weighed)
        mix_slopes(theta, factor, root, slopes)
        add_weighed(ahead.hessian, weighed, slopes, stage)
    slope_ahead(ahead, slope)
    add_risk(theta, ahead, mixed, slopes, slope, convex, stage)
    return total + 0.5 * theta * square_along(mixed, slope)


def noisy_costs(count, steps, start, policy, model, draws, costs):
    """What runs of a policy from a state cost, the noise drawn: draws (count steps, SIZE), run by run."""
    x, u, ahead, values = stack(N), stack(M), stack(N), stack(COUNT, SIZE)
    for run in range(count):
        for i in range(N):
            x[i] = start[i]
        total = initial_value(x, u, 0, model.initial)
        for t in range(steps):
            affine(policy.gain[t], policy.offset[t], x, u)
            within(u, model.limits)
            total += stage_value(x, u, t, model.stage)
            advance(x, u, model.parameters, model.dt, ahead)
            noise_values(x, u, model.noise[0], values)
            for i in range(COUNT):
                for k in range(SIZE):
                    ahead[ROWS[i]] += values[i, k] * draws[run * steps + t, k]
            for i in range(N):
                x[i] = ahead[i]
        costs[run] = total + final_value(x, u, steps, model.final)


def weigh(S, values, weighed):
    """Write S M."""
    for i in range(COUNT):
        for k in range(SIZE):
            total = 0.0
            for j in range(COUNT):
                total += S[ROWS[i], ROWS[j]] * values[j, k]
            weighed[i, k] = total


def half_trace(values, weighed):
    """1/2 tr M'SM, given S M."""
    total = 0.0
    for i in range(COUNT):
        for k in range(SIZE):
            total += values[i, k] * weighed[i, k]
    return 0.5 * total


def add_weighed(S, weighed, slopes, stage):
    """Add 1/2 tr M'SM linearised: with columns m_i ~ J_i z, the sums of J_i'S J_i and of J_i'S m_i, given S M."""
    row = stack(COUNT)
    for k in range(SIZE):
        for a in range(SOME):
            total = 0.0
            for i in range(COUNT):
                total += slopes[k, i, a] * weighed[i, k]
                moved = 0.0
                for j in range(COUNT):
                    moved += S[ROWS[i], ROWS[j]] * slopes[k, j, a]
                row[i] = moved
            stage.gradient[ACTIVE[a]] += total
            for b in range(SOME):
                curved = 0.0
                for i in range(COUNT):
                    curved += row[i] * slopes[k, i, b]
                stage.hessian[ACTIVE[a], ACTIVE[b]] += curved


def factor_of_risk(theta, values, weighed, factor, root):
    """Factor I - theta M'SM = L D L': write 1 - L below the diagonal, and the reciprocal roots of D.

    Pivots are kept as their distance from 1, so that no digits are lost where theta is small. Returns
    -1/(2 theta) log det, and whether the matrix is positive definite.
    """
    X, total = stack(SIZE, SIZE), 0.0
    for k in range(SIZE):
        for j in range(SIZE):
            X[k, j] = 0.0
            for i in range(COUNT):
                X[k, j] += values[i, k] * weighed[i, j]
    for k in range(SIZE):
        pivot = 1 - theta * X[k, k]
        if not pivot > 0:
            return total, False
        total -= log1p(-theta * X[k, k]) / (2 * theta)
        root[k] = 1 / sqrt(pivot)
        for i in range(k + 1, SIZE):
            factor[i, k] = theta * X[i, k] / pivot
            for j in range(k + 1, SIZE):
                X[i, j] += factor[i, k] * X[k, j]
    return total, True


def mix(theta, factor, root, values, mixed):
    """Write M V with V V' = W: other columns with the same covariance as noise has when it is as bad as the risk."""
    for k in range(SIZE):
        for i in range(COUNT):
            mixed[i, k] = values[i, k]
            for j in range(k):
                mixed[i, k] += factor[k, j] * mixed[i, j]
    for k in range(SIZE):
        for i in range(COUNT):
            mixed[i, k] *= root[k]


def mix_slopes(theta, factor, root, slopes):
    """Mix the slopes of the columns likewise, in place."""
    for k in range(SIZE):
        for j in range(k):
            for i in range(COUNT):
                for a in range(SOME):
                    slopes[k, i, a] += factor[k, j] * slopes[j, i, a]
    for k in range(SIZE):
        for i in range(COUNT):
            for a in range(SOME):
                slopes[k, i, a] *= root[k]


def slope_ahead(ahead, slope):
    """Write the slope of the cost-to-go where the step leads, in the states that noise acts on."""
    for i in range(COUNT):
        slope[i] = ahead.gradient[ROWS[i]]
        for j in range(N):
            slope[i] += ahead.hessian[ROWS[i], j] * ahead.arrived[j]


def square_along(mixed, slope):
    """d'M W M'd."""
    total = 0.0
    for k in range(SIZE):
        along = 0.0
        for i in range(COUNT):
            along += mixed[i, k] * slope[i]
        total += along * along
    return total


def add_risk(theta, ahead, mixed, slopes, slope, convex, stage):
    """Add theta/2 d'M W M'd: its slope, and the part theta D'D of its curvature, D the slopes of V'M'd.

    D'D is seen about the worst noise y, which M moves by J_y z. With a negative risk D is that of M as it is, so that
    the sum with the cost-to-go's own curvature stays positive semidefinite.
    """
    S, jacobian, row = ahead.hessian, ahead.jacobian, stack(W)
    pulled, steered, along = stack(COUNT), stack(N), stack(SIZE)
    for k in range(SIZE):
        along[k] = 0.0
        for i in range(COUNT):
            along[k] += mixed[i, k] * slope[i]
    if SOME:  # the slope at g + y
        for i in range(COUNT):
            pulled[i] = slope[i]
            for k in range(SIZE):
                for j in range(COUNT):
                    pulled[i] += theta * along[k] * S[ROWS[i], ROWS[j]] * mixed[j, k]
    for k in range(SIZE):
        for j in range(N):
            steered[j] = 0.0
            for i in range(COUNT):
                steered[j] += S[j, ROWS[i]] * mixed[i, k]
        for a in range(W):
            row[a] = 0.0
        for j in range(N):
            for a in range(W):
                row[a] += jacobian[j, a] * steered[j]
        for a in range(W):
            stage.gradient[a] += theta * along[k] * row[a]
        if SOME:
            for a in range(SOME):
                pull = 0.0
                for i in range(COUNT):
                    pull += slopes[k, i, a] * pulled[i]
                stage.gradient[ACTIVE[a]] += theta * along[k] * pull
                if theta > 0:
                    row[ACTIVE[a]] += pull
        if theta > 0 or not convex:
            for a in range(W):
                for b in range(W):
                    stage.hessian[a, b] += theta * row[a] * row[b]

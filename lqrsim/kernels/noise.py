"""What noise is expected to cost, as part of each stage. The kernels' subset.

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

from lqrsim.kernels.declarations import M, N, W, noise_slopes, noise_values, stack
from lqrsim.kernels.linear_algebra import affine, within
from lqrsim.kernels.model_functions import advance, cost_value

ROWS = (0,)  # the states that noise acts on at once
COUNT = 1  # how many these are
CONTIGUOUS = 0  # whether these are the first ones, in their order
SIZE = 1  # independent normal numbers in w
ACTIVE = (0,)  # entries of (x, u) that M depends on
ACTIVE_COUNT = 1  # how many these are
PADDED_COUNT = 4  # the same, rounded up to vectors of four


def noise_value(x, u, data, risk, ahead):
    """What it is expected to cost, given what lies ahead; infinite where the risk is too high."""
    values, mixed, slope = stack(COUNT, SIZE), stack(COUNT, SIZE), stack(COUNT)
    factor, root, weighed = stack(SIZE, SIZE), stack(SIZE), stack(COUNT, SIZE)
    S = stack(COUNT, COUNT)
    noise_values(x, u, data, values)
    noisy_block(ahead.hessian, S)
    times_hessian(S, values, weighed)
    theta = risk[0]
    if theta == 0:
        return half_trace(values, weighed)
    total, good = factor_of_risk(theta, values, weighed, factor, root)
    if not good:
        return inf
    risk_columns(theta, factor, root, values, mixed)
    next_slope(ahead, slope)
    return total + 0.5 * theta * square_along(mixed, slope)


def noise_quadratic(x, u, data, risk, ahead, convex, stage):
    """Add the quadratic model to a stage, Hessian (W, W) and gradient (W,), and return the value.

    With `convex` what is added is positive semidefinite, with a negative risk, too. Where the risk is too high the
    Hessian is spoilt, so that the pass fails, and `risk[1]` is 1.
    """
    values, slopes = stack(COUNT, SIZE), stack(SIZE, COUNT, PADDED_COUNT)
    weighed, factor, root = stack(COUNT, SIZE), stack(SIZE, SIZE), stack(SIZE)
    S = stack(COUNT, COUNT)
    for k in range(SIZE):
        for i in range(COUNT):
            for a in range(ACTIVE_COUNT, PADDED_COUNT):
                slopes[k, i, a] = 0.0
    noise_slopes(x, u, data, values, slopes)
    noisy_block(ahead.hessian, S)
    times_hessian(S, values, weighed)
    theta = risk[0]
    if theta == 0:
        if ACTIVE_COUNT:
            add_trace_model(S, weighed, slopes, stage)
        return half_trace(values, weighed)
    total, good = factor_of_risk(theta, values, weighed, factor, root)
    risk[1] = 0.0 if good else 1.0
    if not good:
        stage.hessian[W - 1, W - 1] = -inf
        return inf
    mixed, slope = stack(COUNT, SIZE), stack(COUNT)
    risk_columns(theta, factor, root, values, mixed)
    if ACTIVE_COUNT:
        times_hessian(S, mixed, weighed)
        risk_column_slopes(theta, factor, root, slopes)
        add_trace_model(S, weighed, slopes, stage)
    next_slope(ahead, slope)
    add_risk(theta, ahead, mixed, slopes, slope, convex, stage)
    return total + 0.5 * theta * square_along(mixed, slope)


def noisy_costs(count, steps, start, policy, model, draws, costs):
    """What runs of a policy from a state cost, the noise drawn: draws (count steps, SIZE), run by run."""
    x, u, ahead, values = stack(N), stack(M), stack(N), stack(COUNT, SIZE)
    for run in range(count):
        for i in range(N):
            x[i] = start[i]
        total = cost_value(x, u, 0, model.initial)
        for t in range(steps):
            affine(policy.gain[t], policy.offset[t], x, u)
            within(u, model.limits)
            total += cost_value(x, u, t, model.stage)
            advance(x, u, model, model.dt, ahead)
            noise_values(x, u, model.noise.data, values)
            for i in range(COUNT):
                for k in range(SIZE):
                    ahead[i if CONTIGUOUS else ROWS[i]] += values[i, k] * draws[run * steps + t, k]
            for i in range(N):
                x[i] = ahead[i]
        costs[run] = total + cost_value(x, u, steps, model.final)


def noisy_block(S, compact):
    """Write the rows and columns of S that noise acts on; looked up once, for that takes longer than the sums."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        for j in range(COUNT):
            compact[i, j] = S[row, j if CONTIGUOUS else ROWS[j]]


def times_hessian(S, values, weighed):
    """Write S M."""
    for i in range(COUNT):
        for k in range(SIZE):
            weighed[i, k] = 0.0
        for j in range(COUNT):
            for k in range(SIZE):
                weighed[i, k] += S[i, j] * values[j, k]


def half_trace(values, weighed):
    """1/2 tr M'SM, given S M."""
    total = 0.0
    for i in range(COUNT):
        for k in range(SIZE):
            total += values[i, k] * weighed[i, k]
    return 0.5 * total


def add_trace_model(S, weighed, slopes, stage):
    """Add 1/2 tr M'SM linearised: with columns m_i ~ J_i z, the sums of J_i'S J_i and of J_i'S m_i, given S M."""
    line, curve, slope = stack(PADDED_COUNT), stack(ACTIVE_COUNT, PADDED_COUNT), stack(PADDED_COUNT)
    for b in range(PADDED_COUNT):
        slope[b] = 0.0
        for a in range(ACTIVE_COUNT):
            curve[a, b] = 0.0
    for k in range(SIZE):
        for i in range(COUNT):  # line by line, which stays in registers
            factor = weighed[i, k]
            for b in range(PADDED_COUNT):
                line[b] = 0.0
                slope[b] += slopes[k, i, b] * factor
            for j in range(COUNT):
                factor = S[i, j]
                for b in range(PADDED_COUNT):
                    line[b] += factor * slopes[k, j, b]
            for a in range(ACTIVE_COUNT):
                factor = slopes[k, i, a]
                for b in range(PADDED_COUNT):
                    curve[a, b] += factor * line[b]
    for a in range(ACTIVE_COUNT):
        entry = ACTIVE[a]
        stage.gradient[entry] += slope[a]
        for b in range(ACTIVE_COUNT):
            stage.hessian[entry, ACTIVE[b]] += curve[a, b]


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


def risk_columns(theta, factor, root, values, mixed):
    """Write M V with V V' = W: other columns with the same covariance as noise has when it is as bad as the risk."""
    for k in range(SIZE):
        for i in range(COUNT):
            mixed[i, k] = values[i, k]
            for j in range(k):
                mixed[i, k] += factor[k, j] * mixed[i, j]
    for k in range(SIZE):
        for i in range(COUNT):
            mixed[i, k] *= root[k]


def risk_column_slopes(theta, factor, root, slopes):
    """Mix the slopes of the columns likewise, in place."""
    for k in range(SIZE):
        for j in range(k):
            for i in range(COUNT):
                for a in range(PADDED_COUNT):
                    slopes[k, i, a] += factor[k, j] * slopes[j, i, a]
    for k in range(SIZE):
        for i in range(COUNT):
            for a in range(PADDED_COUNT):
                slopes[k, i, a] *= root[k]


def next_slope(ahead, slope):
    """Write the slope of the cost-to-go where the step leads, in the states that noise acts on."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        total = ahead.gradient[row]
        for j in range(N):
            total += ahead.hessian[row, j] * ahead.arrived[j]
        slope[i] = total


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
    S, jacobian, slopes_along, line = ahead.hessian, ahead.jacobian, stack(SIZE, W), stack(W)
    pulled, steered, along, compact = stack(COUNT), stack(N), stack(SIZE), stack(COUNT, COUNT)
    for k in range(SIZE):
        total = 0.0
        for i in range(COUNT):
            total += mixed[i, k] * slope[i]
        along[k] = total
        for j in range(N):
            steered[j] = 0.0
        for i in range(COUNT):
            state, factor = i if CONTIGUOUS else ROWS[i], mixed[i, k]
            for j in range(N):
                steered[j] += S[state, j] * factor
        for a in range(W):
            line[a] = 0.0
        for j in range(N):
            factor = steered[j]
            for a in range(W):
                line[a] += jacobian[j, a] * factor
        for a in range(W):
            slopes_along[k, a] = line[a]
            stage.gradient[a] += theta * total * line[a]
    if ACTIVE_COUNT:
        noisy_block(S, compact)
        for i in range(COUNT):  # the slope at g + y
            pulled[i] = slope[i]
            for j in range(COUNT):
                for k in range(SIZE):
                    pulled[i] += theta * along[k] * compact[i, j] * mixed[j, k]
        for k in range(SIZE):
            for a in range(ACTIVE_COUNT):
                pull, entry = 0.0, ACTIVE[a]
                for i in range(COUNT):
                    pull += slopes[k, i, a] * pulled[i]
                stage.gradient[entry] += theta * along[k] * pull
                if theta > 0:
                    slopes_along[k, entry] += pull
    if theta > 0 or convex == 0:
        for a in range(W):  # line by line, which stays in registers
            for b in range(W):
                line[b] = 0.0
            for k in range(SIZE):
                factor = theta * slopes_along[k, a]
                for b in range(W):
                    line[b] += factor * slopes_along[k, b]
            for b in range(W):
                stage.hessian[a, b] += line[b]

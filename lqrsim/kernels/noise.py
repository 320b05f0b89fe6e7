"""The expected cost of noise, as part of each stage.

With x' = g(x, u) + M(x, u) w and w ~ N(0, I), a quadratic cost-to-go v with Hessian S at t + 1 has the expectation

    E v(g + M w) = v(g) + 1/2 tr M'SM

so noise is an additional cost of the stage, which depends on S alone. The backward pass has just computed S; the
forward pass uses S from the last backward pass. If dynamics and M are linear and costs quadratic, this is exact. With
constraints another S may be given, without their penalties; see `SolveRun.weigh_noise`.

With a risk theta, the expectation is replaced by (1/theta) log E exp(theta v(g + M w)). With d = S g + s, the gradient
of v at g, this is

    v(g) + theta/2 d'M C M'd - 1/(2 theta) log det(I - theta M'SM),    C = (I - theta M'SM)^-1

which exists if I - theta M'SM is positive definite. As theta goes to 0 it becomes the expectation. For theta above 0 it
is v at g + y minus the cost of y, where y = theta M C M'd is the worst noise.

Gradients are exact. Hessians are Gauss-Newton approximations: second derivatives of M, and other parts that can be
negative, are left out. The matrices here are compact: they contain only the rows of M that are not zero everywhere, and
only the entries of (x, u) that M depends on. Shapes: M (COUNT, COLUMNS), its derivatives by columns (COLUMNS, COUNT,
PADDED_ACTIVE_COUNT), S (COUNT, COUNT). In formulas M is the noise matrix; in code M is the number of controls.
"""

from math import inf, log1p, sqrt

from lqrsim.kernels.declarations import M, N, W, noise_slopes, noise_values, outline, stack, zeros
from lqrsim.kernels.linear_algebra import copy, fill
from lqrsim.kernels.model_functions import advance, cost_value
from lqrsim.kernels.riccati import limited_control

ROWS = (0,)  # the states that noise acts on directly
COUNT = 1  # their number
CONTIGUOUS = 0  # whether they are the first states, in order
COLUMNS = 1  # number of columns of M, and of entries of w
ACTIVE = (0,)  # entries of (x, u) that M depends on
ACTIVE_COUNT = 1  # their number
PADDED_ACTIVE_COUNT = 4  # this number, rounded up to a multiple of four for vector code


def constant_values(x, u, data, out):
    """Write a constant M: `data` has its entries, row by row, then the strength."""
    for i in range(COUNT):
        for k in range(COLUMNS):
            out[i, k] = data[COUNT * COLUMNS] * data[COLUMNS * i + k]


def constant_slopes(x, u, data, out, slopes):
    """Write a constant M, which has no derivatives."""
    constant_values(x, u, data, out)


def matrices_of(count, states, controls, data, out):
    """Write M (count, COUNT, COLUMNS) at states (count, N) and controls (count, M)."""
    for i in range(count):
        matrix_at(states[i], controls[i], data, out[i])


@outline
def matrix_at(x, u, data, out):
    """Write M at one state and control."""
    noise_values(x, u, data, out)


def noise_value(x, u, data, risk, next_step):
    """The expected cost of noise at (x, u); infinite unless I - theta M'SM is positive definite, theta = risk[0]."""
    values, MV, slope = stack(COUNT, COLUMNS), stack(COUNT, COLUMNS), stack(COUNT)
    factor, root, SM = stack(COLUMNS, COLUMNS), stack(COLUMNS), stack(COUNT, COLUMNS)
    S = stack(COUNT, COUNT)
    noise_values(x, u, data, values)
    noisy_block(next_step.hessian, S)
    times_hessian(S, values, SM)
    theta = risk[0]
    if theta == 0:
        return half_trace(values, SM)
    total, good = factor_of_risk(theta, values, SM, factor, root)
    if not good:
        return inf
    risk_columns(theta, factor, root, values, MV)
    next_slope(next_step, slope)
    return total + 0.5 * theta * square_along(MV, slope)


def noise_quadratic(x, u, data, risk, next_step, convex, stage):
    """Add the quadratic model of the expected cost to a stage at (x, u), and return its value.

    Args:
      risk: (3,); the second entry is written: 1 if the risk is too high. The Hessian is then made indefinite, so that
        the pass fails.
      convex: 1 to keep the added terms positive semidefinite even with a negative risk.
    """
    values, slopes = stack(COUNT, COLUMNS), zeros(COLUMNS, COUNT, PADDED_ACTIVE_COUNT)
    SM, factor, root = stack(COUNT, COLUMNS), stack(COLUMNS, COLUMNS), stack(COLUMNS)
    S = stack(COUNT, COUNT)
    noise_slopes(x, u, data, values, slopes)
    noisy_block(next_step.hessian, S)
    times_hessian(S, values, SM)
    theta = risk[0]
    if theta == 0:
        if ACTIVE_COUNT:
            add_trace_model(S, SM, slopes, stage)
        return half_trace(values, SM)
    total, good = factor_of_risk(theta, values, SM, factor, root)
    risk[1] = 0.0 if good else 1.0
    if not good:
        stage.hessian[W - 1, W - 1] = -inf
        return inf
    MV, slope = stack(COUNT, COLUMNS), stack(COUNT)
    risk_columns(theta, factor, root, values, MV)
    if ACTIVE_COUNT:
        times_hessian(S, MV, SM)  # from here on S M V
        risk_column_slopes(theta, factor, root, slopes)
        add_trace_model(S, SM, slopes, stage)
    next_slope(next_step, slope)
    add_risk(theta, next_step, MV, slopes, slope, convex, stage)
    return total + 0.5 * theta * square_along(MV, slope)


def noisy_costs(count, steps, start, policy, model, draws, costs):
    """Write the costs (count,) of rollouts of a policy with given noise: draws (count steps, COLUMNS), run by run."""
    x, u, arrived, values = stack(N), stack(M), stack(N), stack(COUNT, COLUMNS)
    for run in range(count):
        copy(start, N, x)
        total = cost_value(x, u, 0, model.initial)
        for t in range(steps):
            limited_control(policy.gain[t], policy.offset[t], x, model.limits, u)
            total += cost_value(x, u, t, model.stage)
            advance(x, u, model, model.dt, arrived)
            noise_values(x, u, model.noise.data, values)
            for i in range(COUNT):
                for k in range(COLUMNS):
                    arrived[i if CONTIGUOUS else ROWS[i]] += values[i, k] * draws[run * steps + t, k]
            copy(arrived, N, x)
        costs[run] = total + cost_value(x, u, steps, model.final)


def noisy_block(S, compact):
    """Copy the rows and columns of S that noise acts on, once, because looking them up takes longer than the sums."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        for j in range(COUNT):
            compact[i, j] = S[row, j if CONTIGUOUS else ROWS[j]]


def times_hessian(S, values, SM):
    """Write S M, (COUNT, COLUMNS)."""
    for i in range(COUNT):
        fill(SM[i], COLUMNS, 0.0)
        for j in range(COUNT):
            for k in range(COLUMNS):
                SM[i, k] += S[i, j] * values[j, k]


def half_trace(values, SM):
    """1/2 tr M'SM, given S M."""
    total = 0.0
    for i in range(COUNT):
        for k in range(COLUMNS):
            total += values[i, k] * SM[i, k]
    return 0.5 * total


def add_trace_model(S, SM, slopes, stage):
    """Add the model of 1/2 tr M'SM: of columns m_i and Jacobians J_i (slopes), with S M, sum J_i'S J_i and
    sum J_i'S m_i.
    """
    line, curve = stack(PADDED_ACTIVE_COUNT), zeros(ACTIVE_COUNT, PADDED_ACTIVE_COUNT)
    slope = zeros(PADDED_ACTIVE_COUNT)
    for k in range(COLUMNS):
        for i in range(COUNT):  # row by row, which stays in registers
            factor = SM[i, k]
            for b in range(PADDED_ACTIVE_COUNT):
                line[b] = 0.0
                slope[b] += slopes[k, i, b] * factor
            for j in range(COUNT):
                factor = S[i, j]
                for b in range(PADDED_ACTIVE_COUNT):
                    line[b] += factor * slopes[k, j, b]
            for a in range(ACTIVE_COUNT):
                factor = slopes[k, i, a]
                for b in range(PADDED_ACTIVE_COUNT):
                    curve[a, b] += factor * line[b]
    for a in range(ACTIVE_COUNT):
        entry = ACTIVE[a]
        stage.gradient[entry] += slope[a]
        for b in range(ACTIVE_COUNT):
            stage.hessian[entry, ACTIVE[b]] += curve[a, b]


def factor_of_risk(theta, values, SM, factor, root):
    """Factor I - theta M'SM = L D L'; return -1/(2 theta) log det, and whether the matrix is positive definite.

    Pivots are stored as their distance from 1, so that no digits are lost if theta is small.

    Args:
      factor: (COLUMNS, COLUMNS), gets I - L below the diagonal.
      root: (COLUMNS,), gets the reciprocal square roots of D.
    """
    X, total = stack(COLUMNS, COLUMNS), 0.0
    for k in range(COLUMNS):
        for j in range(COLUMNS):
            X[k, j] = 0.0
            for i in range(COUNT):
                X[k, j] += values[i, k] * SM[i, j]
    for k in range(COLUMNS):
        pivot = 1 - theta * X[k, k]
        if not pivot > 0:
            return total, False
        total -= log1p(-theta * X[k, k]) / (2 * theta)
        root[k] = 1 / sqrt(pivot)
        for i in range(k + 1, COLUMNS):
            factor[i, k] = theta * X[i, k] / pivot
            for j in range(k + 1, COLUMNS):
                X[i, j] += factor[i, k] * X[k, j]
    return total, True


def risk_columns(theta, factor, root, values, MV):
    """Write M V with V V' = C: columns with the covariance of noise under the risk."""
    for k in range(COLUMNS):
        for i in range(COUNT):
            MV[i, k] = values[i, k]
            for j in range(k):
                MV[i, k] += factor[k, j] * MV[i, j]
    for k in range(COLUMNS):
        for i in range(COUNT):
            MV[i, k] *= root[k]


def risk_column_slopes(theta, factor, root, slopes):
    """Convert the derivatives of the columns of M, in place, to derivatives of M V with fixed V."""
    for k in range(COLUMNS):
        for j in range(k):
            for i in range(COUNT):
                for a in range(PADDED_ACTIVE_COUNT):
                    slopes[k, i, a] += factor[k, j] * slopes[j, i, a]
    for k in range(COLUMNS):
        for i in range(COUNT):
            for a in range(PADDED_ACTIVE_COUNT):
                slopes[k, i, a] *= root[k]


def next_slope(next_step, slope):
    """Write the gradient (COUNT,) of the cost-to-go at the next state, in the states that noise acts on."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        total = next_step.gradient[row]
        for j in range(N):
            total += next_step.hessian[row, j] * next_step.arrived[j]
        slope[i] = total


def square_along(MV, slope):
    """d'M C M'd, given M V and d."""
    total = 0.0
    for k in range(COLUMNS):
        along = 0.0
        for i in range(COUNT):
            along += MV[i, k] * slope[i]
        total += along * along
    return total


def add_risk(theta, next_step, MV, slopes, slope, convex, stage):
    """Add the model of theta/2 d'M C M'd: its gradient, and theta D'D of its Hessian, D the Jacobian of V'M'd.

    D is evaluated at the worst noise y, for both M and d. With a negative risk it is the Jacobian for d alone, so that
    the sum with the cost-to-go's Hessian stays positive semidefinite.
    """
    S, jacobian, slopes_along, line = next_step.hessian, next_step.jacobian, stack(COLUMNS, W), stack(W)
    pulled, steered, along, compact = stack(COUNT), stack(N), stack(COLUMNS), stack(COUNT, COUNT)
    for k in range(COLUMNS):
        total = 0.0
        for i in range(COUNT):
            total += MV[i, k] * slope[i]
        along[k] = total
        fill(steered, N, 0.0)
        for i in range(COUNT):
            state, factor = i if CONTIGUOUS else ROWS[i], MV[i, k]
            for j in range(N):
                steered[j] += S[state, j] * factor
        fill(line, W, 0.0)
        for j in range(N):
            factor = steered[j]
            for a in range(W):
                line[a] += jacobian[j, a] * factor
        for a in range(W):
            slopes_along[k, a] = line[a]
            stage.gradient[a] += theta * total * line[a]
    if ACTIVE_COUNT:
        noisy_block(S, compact)
        for i in range(COUNT):  # the gradient at g + y
            pulled[i] = slope[i]
            for j in range(COUNT):
                for k in range(COLUMNS):
                    pulled[i] += theta * along[k] * compact[i, j] * MV[j, k]
        for k in range(COLUMNS):
            for a in range(ACTIVE_COUNT):
                pull, entry = 0.0, ACTIVE[a]
                for i in range(COUNT):
                    pull += slopes[k, i, a] * pulled[i]
                stage.gradient[entry] += theta * along[k] * pull
                if theta > 0:
                    slopes_along[k, entry] += pull
    if theta > 0 or convex == 0:
        for a in range(W):  # row by row, which stays in registers
            fill(line, W, 0.0)
            for k in range(COLUMNS):
                factor = theta * slopes_along[k, a]
                for b in range(W):
                    line[b] += factor * slopes_along[k, b]
            for b in range(W):
                stage.hessian[a, b] += line[b]

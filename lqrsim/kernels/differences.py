"""Central differences, for functions that come without derivatives.

The step for first derivatives is the cube root of the machine precision: truncation and rounding errors are then both
about 1e-10 of the function's size. The step for second derivatives from values is the fourth root of the machine
precision.
"""

from lqrsim.kernels.declarations import M, N, W, noise_values, places, rate, stack, value, zeros
from lqrsim.kernels.linear_algebra import copy, entry, set_entry
from lqrsim.kernels.records import WeightedStep
from lqrsim.kernels.runge_kutta import advance, step_jacobian

FIRST, SECOND = 6e-6, 1.2e-4  # steps, relative to max(1, |entry|)
ACTIVE = (0,)  # entries of (x, u) that the function depends on
BALLS = 1  # number of balls of `places`
COLUMNS = 1  # number of columns of the noise matrix M


def rate_jacobian(x, u, p, out, fx, fu):
    """Write f (N,), df/dx (N, N) and df/du (N, M)."""
    y, v, above, below = stack(N), stack(M), stack(N), stack(N)
    copy(x, N, y)
    copy(u, M, v)
    rate(x, u, p, out)
    for j in range(W):
        z = entry(x, u, j)
        h = FIRST * max(1.0, abs(z))
        set_entry(y, v, j, z + h)
        rate(y, v, p, above)
        set_entry(y, v, j, z - h)
        rate(y, v, p, below)
        set_entry(y, v, j, z)
        for i in range(N):
            slope = (above[i] - below[i]) / (2 * h)
            if j < N:
                fx[i, j] = slope
            else:
                fu[i, j - N] = slope


def places_jacobian(x, data, out, slopes):
    """Write the centres of balls, and their Jacobian (3 BALLS, N) into an array of zeros."""
    y, above, below = stack(N), stack(3 * BALLS), stack(3 * BALLS)
    copy(x, N, y)
    places(x, data, out)
    for a in range(len(ACTIVE)):
        j = ACTIVE[a]
        h = FIRST * max(1.0, abs(x[j]))
        y[j] = x[j] + h
        places(y, data, above)
        y[j] = x[j] - h
        places(y, data, below)
        y[j] = x[j]
        for i in range(3 * BALLS):
            slopes[i, j] = (above[i] - below[i]) / (2 * h)


def noise_slopes(x, u, data, out, slopes):
    """Write the noise matrix (N, COLUMNS), and the derivatives of its entries (i, k) by those of ACTIVE (k, i, any)."""
    y, v, above, below = stack(N), stack(M), stack(N, COLUMNS), stack(N, COLUMNS)
    copy(x, N, y)
    copy(u, M, v)
    noise_values(x, u, data, out)
    for a in range(len(ACTIVE)):
        j = ACTIVE[a]
        z = entry(x, u, j)
        h = FIRST * max(1.0, abs(z))
        set_entry(y, v, j, z + h)
        noise_values(y, v, data, above)
        set_entry(y, v, j, z - h)
        noise_values(y, v, data, below)
        set_entry(y, v, j, z)
        for k in range(COLUMNS):
            for i in range(N):
                slopes[k, i, a] = (above[i, k] - below[i, k]) / (2 * h)


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and gradient (W,) of the cost `value`, by differences of its values; return the cost."""
    h, above, below = stack(W), stack(W), stack(W)
    middle = value(x, u, t, data)
    for a in range(len(ACTIVE)):
        i = ACTIVE[a]
        h[i] = SECOND * max(1.0, abs(entry(x, u, i)))
        above[i] = value_near(x, u, t, data, i, h[i], i, 0.0)
        below[i] = value_near(x, u, t, data, i, -h[i], i, 0.0)
        gradient[i] += (above[i] - below[i]) / (2 * h[i])
        hessian[i, i] += (above[i] - 2 * middle + below[i]) / (h[i] * h[i])
    for a in range(len(ACTIVE)):
        for b in range(a):
            i, j = ACTIVE[a], ACTIVE[b]
            both = value_near(x, u, t, data, i, h[i], j, h[j]) + value_near(x, u, t, data, i, -h[i], j, -h[j])
            mixed = (both + 2 * middle - above[i] - below[i] - above[j] - below[j]) / (2 * h[i] * h[j])
            hessian[i, j] += mixed
            hessian[j, i] += mixed
    return middle


def value_near(x, u, t, data, i, a, j, b):
    """The cost with entry i of (x, u) moved by a and entry j by b."""
    y, v = stack(N), stack(M)
    copy(x, N, y)
    copy(u, M, v)
    set_entry(y, v, i, entry(y, v, i) + a)
    set_entry(y, v, j, entry(y, v, j) + b)
    return value(y, v, t, data)


def curvature_from_values(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian; add the Hessian (W, W) of weights (N,) times its next state.

    To be compiled with `weighted_step` as `value`, and with all entries of (x, u) ACTIVE.
    """
    gradient = zeros(W)
    step_jacobian(x, u, p, h, out, jacobian)
    derivatives(x, u, 0, WeightedStep(p, h, weights), hessian, gradient)


def weighted_step(x, u, t, data):
    """The change of state over a step, times weights; the state itself is linear and would only add rounding."""
    out, total = stack(N), 0.0
    advance(x, u, data.parameters, data.duration, out)
    for k in range(N):
        total += data.weights[k] * (out[k] - x[k])
    return total


def curvature_from_jacobians(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian; add the Hessian (W, W) of its next state times weights (N,), by differences of
    Jacobians: for a formula whose second derivatives would be too long.
    """
    y, v = stack(N), stack(M)
    copy(x, N, y)
    copy(u, M, v)
    for j in range(W):
        z = entry(x, u, j)
        width = FIRST * max(1.0, abs(z))
        for side in range(2):
            set_entry(y, v, j, z + width if side == 0 else z - width)
            step_jacobian(y, v, p, h, out, jacobian)
            factor = 0.25 / width if side == 0 else -0.25 / width  # halved, because it is added to both triangles
            for k in range(W):
                total = 0.0
                for i in range(N):
                    total += weights[i] * jacobian[i, k]
                hessian[j, k] += factor * total
                hessian[k, j] += factor * total
        set_entry(y, v, j, z)
    step_jacobian(x, u, p, h, out, jacobian)

"""A user's own functions, called at their addresses.

The data of each function begin with its address and, if given, the address of its derivatives; its parameters follow.
Outputs are NaN where the user's function does not write them. `differences.py` computes derivatives by differences.
Of JAX, whole Runge-Kutta steps are a function, too, one or all of a plan at once: that of `codegen/user_functions.py`.
"""

from math import nan

from lqrsim.kernels.declarations import HESSIANS, JACOBIANS, STATES, M, N, W, call, stack, zeros
from lqrsim.kernels.linear_algebra import clear, fill
from lqrsim.kernels.runge_kutta import state_jacobians as state_jacobians

BALLS = 1  # number of balls of `places`
COORDINATES = 3  # number of coordinates that the function returns per ball; 2 in a plane
COLUMNS = 1  # number of columns of the noise matrix M
STRENGTH = 1  # index in the data of the factor of M
STEPS = 2  # index in the data of the address of JAX's steps: the rates and their Jacobian come first


def rate(x, u, p, out):
    """Write xdot = f(x, u), (N,)."""
    fill(out, N, nan)
    call(p[0], x, u, p, out)


def rate_jacobian(x, u, p, out, fx, fu):
    """Write f (N,), df/dx (N, N) and df/du (N, M)."""
    rate(x, u, p, out)
    clear(fx, N, N)
    clear(fu, N, M)
    call(p[1], x, u, p, fx, fu)


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    call(p[STEPS], STATES, 1, 0, x, u, p, h, out, out, out, out)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W)."""
    call(p[STEPS], JACOBIANS, 1, 0, x, u, p, h, out, out, jacobian, jacobian)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """The same, and add the Hessian (W, W) of the next state times weights (N,)."""
    call(p[STEPS], HESSIANS, 1, 0, x, u, p, h, weights, out, jacobian, hessian)


def all_steps(what, steps, states, controls, p, h, costates, arrived, jacobian, hessian):
    """Write the state after each step of a plan, or also its Jacobian, or also add its Hessian: see `STATES`.

    The weights of the next states are costates[1:].
    """
    call(p[STEPS], what, steps, 1, states, controls, p, h, costates, arrived, jacobian, hessian)


def value(x, u, t, data):
    """A cost."""
    out = stack(1)
    out[0] = nan
    call(data[0], x, u, data, out)
    return out[0]


def derivatives(x, u, t, data, hessian, gradient):
    """Add the symmetric part of a cost's Hessian (W, W), and its gradient (W,); return the cost."""
    slope, curve = zeros(W), zeros(W, W)
    call(data[1], x, u, data, slope, curve)
    for i in range(W):
        gradient[i] += slope[i]
        for j in range(W):
            hessian[i, j] += 0.5 * (curve[i, j] + curve[j, i])
    return value(x, u, t, data)


def places(x, data, out):
    """Write the centres of balls, three coordinates each; the third is 0 in a plane."""
    returned = stack(BALLS * COORDINATES)
    fill(returned, BALLS * COORDINATES, nan)
    call(data[0], x, x, data, returned)
    for k in range(BALLS):
        out[3 * k + 2] = 0.0
        for i in range(COORDINATES):
            out[3 * k + i] = returned[COORDINATES * k + i]


def places_jacobian(x, data, out, slopes):
    """Write the centres, and their Jacobian (3 balls, N), which the caller has set to zero."""
    returned = zeros(BALLS * COORDINATES, N)
    places(x, data, out)
    call(data[1], x, x, data, returned)
    for k in range(BALLS):
        for i in range(COORDINATES):
            for j in range(N):
                slopes[3 * k + i, j] = returned[COORDINATES * k + i, j]


def noise_values(x, u, data, out):
    """Write the noise matrix M (N, COLUMNS), times its strength."""
    returned = stack(N, COLUMNS)
    for i in range(N):
        fill(returned[i], COLUMNS, nan)
    call(data[0], x, u, data, returned)
    for i in range(N):
        for k in range(COLUMNS):
            out[i, k] = data[STRENGTH] * returned[i, k]

"""The step of dynamics that are stated as a map, in place of a Runge-Kutta step.

Here `rate` is the next state F(x, u). A map has no inverse: backwards in time the result is NaN, as by MuJoCo's steps.
"""

from math import nan

from lqrsim.kernels.declarations import M, N, rate, rate_curvature, rate_jacobian, zeros
from lqrsim.kernels.linear_algebra import copy, copy_part, fill

SUPPORT = (0,)  # entries of (x, u) in which the map is nonlinear, states first
K = 1  # their number


def advance(x, u, p, h, out):
    """Write the next state (N,); the map knows by itself how long a step is."""
    if h > 0:
        rate(x, u, p, out)
    else:
        fill(out, N, nan)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step, and its Jacobian `[A B]` (N, W)."""
    fx, fu = zeros(N, N), zeros(N, M)
    rate_jacobian(x, u, p, out, fx, fu)
    for i in range(N):
        copy(fx[i], N, jacobian[i])
        copy_part(fu[i], 0, jacobian[i], N, M)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    curve = zeros(K, K)
    step_jacobian(x, u, p, h, out, jacobian)
    rate_curvature(x, u, p, weights, curve)
    for a in range(K):
        for b in range(K):
            hessian[SUPPORT[a], SUPPORT[b]] += curve[max(a, b), min(a, b)]

"""The cost-to-go: a step of the Riccati recursion, from t + 1 to t. The kernels' subset.

Paper: Eqs. (9)-(13), in discrete time.
"""

from lqrsim.kernels.declarations import M, N, stack
from lqrsim.kernels.linear_algebra import cholesky, congruence, quadratic_at


def riccati_backward(t, step, stage, constant, policy, to_go):
    """One step of the cost-to-go, Eqs. (9)-(11), (13): from t + 1 to t. Returns whether it succeeded.

    The stage, with its constant, is about the origin, and is used up.
    """
    shifted = add_cost_to_go(t, step, stage, constant, to_go)
    decrease = minimize_control(
        stage.hessian, stage.gradient, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]
    )
    to_go.constant[t] = shifted - decrease
    return decrease >= 0


def add_cost_to_go(t, step, stage, constant, to_go):
    """Add to a stage about the origin the cost-to-go at t + 1, where its step leads. Returns the sum's constant."""
    S1, s1, k1 = to_go.hessian[t + 1], to_go.gradient[t + 1], to_go.constant[t + 1]
    c = step.offset
    v = stack(N)
    for i in range(N):
        v[i] = s1[i]
        for j in range(N):
            v[i] += S1[i, j] * c[j]
    shifted = k1 + constant + quadratic_at(S1, s1, c)
    congruence(step.jacobian, S1, v, stage.hessian, stage.gradient)
    return shifted


def minimize_control(g, h, gain, feedforward, hessian, gradient):
    """Minimise `1/2 z'gz + h'z` over the control part of z = (x, u).

    Writes the minimiser `u = gain x + feedforward` and what is left, a quadratic in x. Returns the decrease that
    the feedforward brings, or -1 if the control block is not positive definite. `g` (W, W) and `h` (W,) are used up.

    With C, E and e the parts of method and paper: L = -E^-1 C, l = -E^-1 e, S = D + C'L, s = d + C'l.
    """
    e, c, y = stack(M, M), stack(M, N), stack(M)
    for i in range(M):
        y[i] = h[N + i]
        for j in range(M):
            e[i, j] = g[N + i, N + j]
        for j in range(N):
            c[i, j] = g[N + i, j]
    if not cholesky(e, M):
        return -1.0
    # With E = U'U: c becomes U^-T C and y becomes U^-T e.
    decrease = 0.0
    for i in range(M):
        y[i] *= e[i, i]
        decrease += 0.5 * y[i] * y[i]
        for j in range(N):
            c[i, j] *= e[i, i]
        for k in range(i + 1, M):
            factor = e[i, k]
            y[k] -= factor * y[i]
            for j in range(N):
                c[k, j] -= factor * c[i, j]
    for i in range(N):
        total = h[i]
        for k in range(M):
            total -= c[k, i] * y[k]
        gradient[i] = total
        for j in range(i, N):
            total = 0.5 * (g[i, j] + g[j, i])
            for k in range(M):
                total -= c[k, i] * c[k, j]
            hessian[i, j] = total
            hessian[j, i] = total
    # Back substitution: c becomes E^-1 C and y becomes E^-1 e.
    for i in range(M - 1, -1, -1):
        for k in range(i + 1, M):
            factor = e[i, k]
            y[i] -= factor * y[k]
            for j in range(N):
                c[i, j] -= factor * c[k, j]
        y[i] *= e[i, i]
        feedforward[i] = -y[i]
        for j in range(N):
            gain[i, j] = -e[i, i] * c[i, j]
            c[i, j] *= e[i, i]
    return decrease

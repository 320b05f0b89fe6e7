"""One step of the Riccati recursion, from the cost-to-go at t + 1 to t.

Paper: Eqs. (9)-(13), in discrete time. The step is linear and the cost quadratic in z = (x, u):

    x_{t+1} = J z + c
    cost_t  = 1/2 z'Hz + h'z + k
    v_{t+1} = 1/2 x'S1 x + s1'x + k1

Their sum is again quadratic in z, with the paper's blocks for x and u:

    G = H + J'S1 J = [D C'; C E],    g = h + J'(S1 c + s1) = (d, e)

The control u = L x + l minimises it, and leaves the cost-to-go v_t = 1/2 x'Sx + s'x + constant:

    L = -E^-1 C,    l = -E^-1 e
    S = D + C'L,    s = d + C'l
    constant = k + k1 + 1/2 c'S1 c + s1'c + 1/2 e'l
"""

from lqrsim.kernels.declarations import M, N, stack
from lqrsim.kernels.linear_algebra import affine, cholesky, congruence, quadratic_at


def add_cost_to_go(t, step, stage, constant, to_go):
    """Add to a stage the cost-to-go of the state that its step leads to; return the constant of the sum."""
    S1, s1, k1 = to_go.hessian[t + 1], to_go.gradient[t + 1], to_go.constant[t + 1]
    c, v = step.offset, stack(N)
    affine(S1, s1, c, N, N, v)
    shifted = k1 + constant + quadratic_at(S1, s1, c)
    congruence(step.jacobian, S1, v, stage.hessian, stage.gradient)
    return shifted


def minimize_control(g, h, gain, feedforward, hessian, gradient):
    """Minimise `1/2 z'gz + h'z` over the control in z = (x, u), as above; the minimiser is `u = gain x + feedforward`.

    Returns the decrease due to the feedforward, or -1 if E is not positive definite.

    Args:
      gain, feedforward: L (M, N) and l (M,), written. hessian, gradient: S (N, N) and s (N,) of the minimum, written.
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

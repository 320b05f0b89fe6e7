"""The primal form, the paper's: the cost-to-come as a quadratic, along the dynamics run backwards. The numba subset.

`dual_form.py` has functions of the same names; `passes.py` is written against either. Paper: Eqs. (14)-(21).
"""

from lqrsim.kernels.interface import M, N, W, stack
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    clear,
    congruence,
    minimize_control,
    offset,
    quadratic_at,
    within,
)
from lqrsim.kernels.runge_kutta import step, step_jacobian


def begin(Q, q, constant, x, S, Sbar, sbar):
    """Write the cost-to-come at 0, given c_0 about the origin, quadratised at x; return its constant. Eq. (18)."""
    for i in range(N):
        sbar[i] = q[i]
        for j in range(N):
            Sbar[i, j] = Q[i, j]
    return constant, True


def linearize(x, u, p, dt, fx, fu, x_next, jacobian, c):
    """Write where (x, u) leads, and the inverse step linearised there: x = jacobian (x_next, u) + c."""
    x_back = stack(N)
    step(x, u, p, dt, x_next)
    step_jacobian(x_next, u, p, -dt, fx, fu, x_back, jacobian)
    offset(jacobian, x_next, u, x_back, c)


def riccati_forward(jacobian, c, cost, slope, constant, S0, s0, k0, smoothing, updated, gain, feedforward, S, s):
    """One step of the cost-to-come, Eqs. (15)-(17), (19): from (S0, s0, k0) at t to (S, s) at t + 1.

    `jacobian` = [Abar Bbar] and c are the linearised inverse step x_t = Abar x_{t+1} + Bbar u_t + cbar; the rest as in
    `riccati_backward`. The inverse policy is u_t = gain x_{t+1} + feedforward. Returns the constant and whether the
    step succeeded.
    """
    z, a, v, b = stack(N, N), stack(N), stack(N), stack(W)
    joint = stack(W, W)
    crossed = 0.0
    for i in range(N):
        a[i] = s0[i] + slope[i]
        v[i] = a[i]
        for j in range(N):
            z[i, j] = S0[i, j] + cost[i, j]
            v[i] += z[i, j] * c[j]
        for j in range(M):
            crossed += abs(cost[i, N + j])
    clear(joint, W, W)
    for i in range(N):
        b[i] = 0.0
    for i in range(M):
        b[N + i] = slope[N + i]
        for j in range(M):
            joint[N + i, N + j] = cost[N + i, N + j]
    if crossed != 0:
        # What the cross term u'P x_t becomes in (x_{t+1}, u): P Abar, P Bbar + its transpose, P cbar.
        for i in range(M):
            for k in range(N):
                factor = cost[N + i, k]
                b[N + i] += factor * c[k]
                for j in range(W):
                    joint[N + i, j] += factor * jacobian[k, j]
                    joint[j, N + i] += factor * jacobian[k, j]
    shifted = k0 + constant + quadratic_at(z, a, c)
    congruence(jacobian, z, v, joint, b)
    decrease = minimize_control(joint, b, gain, feedforward, S, s)
    return shifted - decrease, decrease >= 0


def minimizer(S, s, Sbar, sbar, costate, x):
    """Write x = -(S + Sbar)^-1 (s + sbar), Eq. (21), and the costate S x + s; False unless the sum is definite."""
    total = stack(N, N)
    for i in range(N):
        x[i] = -(s[i] + sbar[i])
        for j in range(N):
            total[i, j] = S[i, j] + Sbar[i, j]
    if not cholesky(total, N):
        return False
    cholesky_solve(total, N, x)
    for i in range(N):
        costate[i] = s[i]
        for j in range(N):
            costate[i] += S[i, j] * x[j]
    return True


def depart(x_hat, costate, smoothing, updated, gain, feedforward, p, dt, low, high, x, u):
    """Write the state and control (x, u) that lead to x_hat = x_{t+1}: the inverse policy, then the inverse step."""
    affine(gain, feedforward, x_hat, u)
    within(u, low, high)
    step(x_hat, u, p, -dt, x)

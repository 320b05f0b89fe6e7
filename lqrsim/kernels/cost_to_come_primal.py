"""The primal form of the paper: the cost-to-come as a quadratic, by inverse dynamics.

`cost_to_come_dual.py` has functions of the same names; `passes.py` is written against either. Paper: Eqs. (14)-(21).
"""

from lqrsim.kernels.control_limits import limited_control
from lqrsim.kernels.cost_to_go import minimize_control
from lqrsim.kernels.declarations import NOISY, M, N, W, stack, zeros
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    congruence,
    copy,
    copy_matrix,
    quadratic_at,
    step_offset,
)
from lqrsim.kernels.model_functions import advance, step_jacobian


def initial_cost_to_come(Q, q, constant, x, to_go, to_come):
    """Write the cost-to-come at 0: c_0 about the origin, (N, N), (N,), constant. Eq. (18)."""
    copy(q, N, to_come.vector[0])
    copy_matrix(Q, N, N, to_come.matrix[0])
    return constant, True


def linearize(x, u, model, arrived, step):
    """Write the next state (N,), and the inverse step linearised there: x = jacobian (x_next, u) + offset."""
    x_back = stack(N)
    advance(x, u, model, model.dt, arrived)
    step_jacobian(arrived, u, model, -model.dt, x_back, step.jacobian)
    step_offset(step.jacobian, arrived, u, x_back, step.offset)


def forward_jacobian(x, u, model, arrived, step, spare):
    """The Jacobian (N, W) of the step forwards; computed only if there is a risk, else undefined."""
    if NOISY and model.noise.risk[0] != 0:
        step_jacobian(x, u, model, model.dt, arrived, spare)
    return spare


def riccati_forward(t, step, stage, constant, to_come, smoothing):
    """Write the cost-to-come at t + 1 and the inverse policy at t, if R is definite. Eqs. (15)-(17), (19).

    Args:
      step: LinearStep, the inverse step x_t = [Abar Bbar] (x_{t+1}, u_t) + cbar.
      stage, constant: the cost at t about the origin. to_come: CostToCome.
      smoothing: SmootherGains; gets the inverse policy u_t = Lbar x_{t+1} + lbar.
    """
    S0, s0, jacobian, c = to_come.matrix[t], to_come.vector[t], step.jacobian, step.offset
    cost, slope = stage.hessian, stage.gradient
    z, a, v, b, joint = stack(N, N), stack(N), stack(N), zeros(W), zeros(W, W)
    crossed = 0.0
    for i in range(N):
        a[i] = s0[i] + slope[i]
        v[i] = a[i]
        for j in range(N):
            z[i, j] = S0[i, j] + cost[i, j]
            v[i] += z[i, j] * c[j]
        for j in range(M):
            crossed += abs(cost[i, N + j])
    for i in range(M):
        b[N + i] = slope[N + i]
        for j in range(M):
            joint[N + i, N + j] = cost[N + i, N + j]
    if crossed != 0:
        # The cross term u'P x_t in terms of (x_{t+1}, u): P Abar, P Bbar + its transpose, P cbar.
        for i in range(M):
            for k in range(N):
                factor = cost[N + i, k]
                b[N + i] += factor * c[k]
                for j in range(W):
                    joint[N + i, j] += factor * jacobian[k, j]
                    joint[j, N + i] += factor * jacobian[k, j]
    shifted = to_come.constant[t] + constant + quadratic_at(z, a, c)
    congruence(jacobian, z, v, joint, b)
    decrease = minimize_control(
        joint, b, smoothing.control_gain[t], smoothing.control[t], to_come.matrix[t + 1], to_come.vector[t + 1]
    )
    to_come.constant[t + 1] = shifted - decrease
    return decrease >= 0


def smoothed_state(t, to_go, to_come, costate, x):
    """Write the smoothed state x = -(S + Sbar)^-1 (s + sbar), (N,), Eq. (21), and the costate S x + s, (N,), at t."""
    S, s, Sbar, sbar = to_go.hessian[t], to_go.gradient[t], to_come.matrix[t], to_come.vector[t]
    total = stack(N, N)
    for i in range(N):
        x[i] = -(s[i] + sbar[i])
        for j in range(N):
            total[i, j] = S[i, j] + Sbar[i, j]
    if not cholesky(total, N):
        return False
    cholesky_solve(total, N, x)
    affine(S, s, x, N, N, costate)
    return True


def previous_state(t, x_hat, costate, smoothing, model, x, u):
    """Write the state (N,) and control (M,) that lead to x_hat at t + 1, by the inverse policy and the inverse step."""
    limited_control(smoothing.control_gain[t], smoothing.control[t], x_hat, model.limits, u)
    advance(x_hat, u, model, -model.dt, x)

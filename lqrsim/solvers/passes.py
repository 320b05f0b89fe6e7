"""The sweeps over time that the solvers are made of. The numba subset; see `interface.py`.

Shapes: `states` (T+1, N), `controls` (T, M), Hessians (T+1, N, N), gradients (T+1, N), constants (T+1,), gains
(T, M, N), feedforwards (T, M). `p` are the parameters of the dynamics; `initial`, `stage`, `final` tuples of arrays,
one a cost term. A sweep returns the step at which it failed, or -1, and whether all numbers there were finite.

The prior is `1/2 (x - prior_about[t])' diag(prior_weight) (x - prior_about[t])` at t >= 1: no part of the cost, but
added to its quadratic model in the first iterations, where it keeps the linearisations sensible.
"""

from lqrsim.integration import step, step_jacobian
from lqrsim.solvers.interface import (
    M,
    N,
    W,
    final_quadratic,
    final_value,
    initial_quadratic,
    initial_value,
    stack,
    stage_quadratic,
    stage_value,
)
from lqrsim.solvers.kernels import (
    about_origin,
    affine,
    cholesky,
    cholesky_solve,
    clear,
    congruence,
    finite,
    minimize_control,
    minimizer,
    offset,
    riccati_backward,
    riccati_forward,
)


def rollout(steps, x0, gain, feedforward, p, dt, initial, stage, final, states, controls):
    """Run the policy from x0 under the true dynamics; write the trajectory and return its true cost."""
    x, u = states[0], stack(M)
    for i in range(N):
        x[i] = x0[i]
    cost = initial_value(x, u, 0, initial)
    for t in range(steps):
        x, u = states[t], controls[t]
        affine(gain[t], feedforward[t], x, u)
        cost += stage_value(x, u, t, stage)
        step(x, u, p, dt, states[t + 1])
    return cost + final_value(states[steps], u, steps, final)


def stage_model(x, u, t, stage, prior_weight, prior_about, hessian, gradient):
    """Write the stage about (x, u) as a quadratic about the origin, Eqs. (26)-(27); return its constant."""
    value = stage_quadratic(x, u, t, stage, hessian, gradient)
    if t > 0:
        for i in range(N):
            weight, error = prior_weight[i], x[i] - prior_about[t, i]
            hessian[i, i] += weight
            gradient[i] += weight * error
            value += 0.5 * weight * error * error
    return about_origin(hessian, gradient, x, u, value)


def end_model(hessian, gradient, value, x, S, s):
    """Write an initial or final cost, quadratised at x, as (S, s) about the origin; return its constant.

    Paper: Eqs. (23), (31).
    """
    none = stack(M)
    for i in range(M):
        none[i] = 0.0
    constant = about_origin(hessian, gradient, x, none, value)
    for i in range(N):
        s[i] = gradient[i]
        for j in range(N):
            S[i, j] = hessian[i, j]
    return constant


def forward_pass(
    steps, x_hat, L, l, S, s, k, Lbar, lbar, Sbar, sbar, kbar, p, dt, initial, stage, final, prior_weight, prior_about
):  # fmt: skip
    """The forward extended LQR pass, Sec. V-B: from the cost-to-go and its policy, the cost-to-come and its own.

    `x_hat` (N,) is where c_0 is quadratised, and on return the minimiser at T, where c_l was. S[T], s[T], k[T] are set.
    """
    hessian, gradient, jacobian, c = stack(W, W), stack(W), stack(N, W), stack(N)
    fx, fu, x_next, x_back, u = stack(N, N), stack(N, M), stack(N), stack(N), stack(M)
    clear(fx, N, N)
    clear(fu, N, M)
    value = initial_quadratic(x_hat, u, 0, initial, hessian, gradient)
    kbar[0] = end_model(hessian, gradient, value, x_hat, Sbar[0], sbar[0])
    for t in range(steps):
        affine(L[t], l[t], x_hat, u)
        step(x_hat, u, p, dt, x_next)
        step_jacobian(x_next, u, p, -dt, fx, fu, x_back, jacobian)
        offset(jacobian, x_next, u, x_back, c)
        constant = stage_model(x_hat, u, t, stage, prior_weight, prior_about, hessian, gradient)
        kbar[t + 1], good = riccati_forward(
            jacobian, c, hessian, gradient, constant, Sbar[t], sbar[t], kbar[t], Lbar[t], lbar[t],
            Sbar[t + 1], sbar[t + 1],
        )  # fmt: skip
        if not good:
            return t, finite(hessian, W, W) and finite(jacobian, N, W)
        if t + 1 < steps and not minimizer(S[t + 1], s[t + 1], Sbar[t + 1], sbar[t + 1], x_hat):
            return t + 1, finite(S[t + 1], N, N) and finite(Sbar[t + 1], N, N)
        if t + 1 == steps:
            if not minimizer(S[steps], s[steps], Sbar[steps], sbar[steps], x_hat):
                # In the first iteration there may be no minimum without c_l, and the state of arrival is what we have.
                for i in range(N):
                    x_hat[i] = x_next[i]
            value = final_quadratic(x_hat, u, steps, final, hessian, gradient)
            k[steps] = end_model(hessian, gradient, value, x_hat, S[steps], s[steps])
            if not minimizer(S[steps], s[steps], Sbar[steps], sbar[steps], x_hat):
                return steps, finite(S[steps], N, N) and finite(Sbar[steps], N, N)
    return -1, True


def backward_pass(
    steps, x_hat, x_hats, L, l, S, s, k, Lbar, lbar, Sbar, sbar, kbar, p, dt, initial, stage, prior_weight, prior_about
):  # fmt: skip
    """The backward extended LQR pass, Sec. V-A: from the cost-to-come and its policy, the cost-to-go and its own.

    `x_hat` (N,) is the minimiser at T, and on return that at 0, where c_0 was quadratised anew. Writes all the
    minimisers to `x_hats` (T+1, N).
    """
    hessian, gradient, jacobian, c = stack(W, W), stack(W), stack(N, W), stack(N)
    fx, fu, x_next, x_back, u = stack(N, N), stack(N, M), stack(N), stack(N), stack(M)
    clear(fx, N, N)
    clear(fu, N, M)
    for t in range(steps - 1, -1, -1):
        for i in range(N):
            x_hats[t + 1, i] = x_hat[i]
        affine(Lbar[t], lbar[t], x_hat, u)
        step(x_hat, u, p, -dt, x_back)
        step_jacobian(x_back, u, p, dt, fx, fu, x_next, jacobian)
        offset(jacobian, x_back, u, x_next, c)
        constant = stage_model(x_back, u, t, stage, prior_weight, prior_about, hessian, gradient)
        k[t], good = riccati_backward(
            jacobian, c, hessian, gradient, constant, S[t + 1], s[t + 1], k[t + 1], L[t], l[t], S[t], s[t]
        )
        if not good or not minimizer(S[t], s[t], Sbar[t], sbar[t], x_hat):
            return t, finite(hessian, W, W) and finite(jacobian, N, W) and finite(Sbar[t], N, N)
    value = initial_quadratic(x_hat, u, 0, initial, hessian, gradient)
    kbar[0] = end_model(hessian, gradient, value, x_hat, Sbar[0], sbar[0])
    if not minimizer(S[0], s[0], Sbar[0], sbar[0], x_hat):
        return 0, finite(S[0], N, N) and finite(Sbar[0], N, N)
    for i in range(N):
        x_hats[0, i] = x_hat[i]
    return -1, True


def differential_pass(steps, states, controls, p, dt, stage, final, damping, keep, L, l, S, s, k):
    """The backward pass of iLQR about a feasible trajectory; l is relative to it, S, s, k are about the origin.

    `damping` is a weight on changes of the controls. With `keep` of 1 all steps are written; with 0 each overwrites the
    one after it, for those who only ask what the model predicts.

    Returns as every sweep does, and the decrease of cost that the linear-quadratic model predicts.
    """
    hessian, gradient, jacobian = stack(W, W), stack(W), stack(N, W)
    fx, fu, x_next, none = stack(N, N), stack(N, M), stack(N), stack(M)
    slope, curve = stack(N), stack(N, N)
    clear(fx, N, N)
    clear(fu, N, M)
    for i in range(M):
        none[i] = 0.0
    value = final_quadratic(states[steps], none, steps, final, hessian, gradient)
    predicted, ahead = 0.0, value
    for i in range(N):
        slope[i] = gradient[i]
        for j in range(N):
            curve[i, j] = hessian[i, j]
    last = steps * keep
    k[last] = end_model(hessian, gradient, value, states[steps], S[last], s[last])
    for t in range(steps - 1, -1, -1):
        at = t * keep
        step_jacobian(states[t], controls[t], p, dt, fx, fu, x_next, jacobian)
        ahead += stage_quadratic(states[t], controls[t], t, stage, hessian, gradient)
        congruence(jacobian, curve, slope, hessian, gradient)
        for i in range(M):
            hessian[N + i, N + i] += damping
        decrease = minimize_control(hessian, gradient, L[at], l[at], curve, slope)
        if not decrease >= 0:
            return t, finite(hessian, W, W) and finite(jacobian, N, W), predicted
        predicted += decrease
        constant = ahead - predicted
        for i in range(N):
            moved = slope[i]
            for j in range(N):
                S[at, i, j] = curve[i, j]
                moved -= curve[i, j] * states[t, j]
            s[at, i] = moved
            constant -= 0.5 * (slope[i] + moved) * states[t, i]
        k[at] = constant
    return -1, True, predicted


def initial_decrease(x0, initial, S, s):
    """The decrease that moving the soft start x0 adds to the prediction, given the cost-to-go at 0; NaN if none."""
    hessian, gradient, none = stack(W, W), stack(W), stack(M)
    total, slope, direction = stack(N, N), stack(N), stack(N)
    for i in range(M):
        none[i] = 0.0
    initial_quadratic(x0, none, 0, initial, hessian, gradient)
    for i in range(N):
        slope[i] = gradient[i] + s[i]
        for j in range(N):
            slope[i] += S[i, j] * x0[j]
            total[i, j] = hessian[i, j] + S[i, j]
        direction[i] = slope[i]
    if not cholesky(total, N):
        return float("nan")
    cholesky_solve(total, N, direction)
    decrease = 0.0
    for i in range(N):
        decrease += 0.5 * slope[i] * direction[i]
    return decrease


def largest_gap(steps, x_hats, states):
    """The largest difference between two sequences of states, each state relative to its range (at least 1)."""
    gap = 0.0
    for i in range(N):
        low, high, worst = states[0, i], states[0, i], 0.0
        for t in range(steps + 1):
            difference = abs(x_hats[t, i] - states[t, i])
            if not difference <= worst:  # a NaN too
                worst = difference
            low, high = min(low, states[t, i]), max(high, states[t, i])
        relative = worst / max(high - low, 1.0)
        if not relative <= gap:
            gap = relative
    return gap


def line_search(
    steps, states, controls, L, l, p, dt, initial, stage, final, old, new_states, new_controls
):  # fmt: skip
    """Try steps 1, 1/2, 1/4, ... along the change l of the controls until the true cost falls below `old`.

    Writes the trajectory. Returns its cost and the step, which is 0 if none above 1e-8 lowers the cost.
    """
    fraction = 1.0
    while fraction >= 1e-8:
        for i in range(N):
            new_states[0, i] = states[0, i]
        cost = initial_value(new_states[0], new_controls[0], 0, initial)
        for t in range(steps):
            x, u = new_states[t], new_controls[t]
            for i in range(M):
                total = controls[t, i] + fraction * l[t, i]
                for j in range(N):
                    total += L[t, i, j] * (x[j] - states[t, j])
                u[i] = total
            cost += stage_value(x, u, t, stage)
            step(x, u, p, dt, new_states[t + 1])
        cost += final_value(new_states[steps], new_controls[steps - 1], steps, final)
        if cost < old:
            return cost, fraction
        fraction *= 0.5
    return old, 0.0

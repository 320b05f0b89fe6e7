"""The passes of LQR smoothing. The numba subset; see `interface.py`.

Shapes: `states` (T+1, N), `controls` (T, M), Hessians (T+1, N, N), gradients (T+1, N), constants (T+1,), gains
(T, M, N), feedforwards (T, M). `p` are the parameters of the dynamics; `initial`, `stage`, `final` tuples of arrays,
one a cost term. A sweep returns the step at which it failed, or -1, and whether all numbers there were finite.

The prior is `1/2 (x - prior_about[t])' diag(prior_weight) (x - prior_about[t])` at t >= 1: no part of the cost, but
added to its quadratic model in the first iterations, where it keeps the linearisations sensible.
"""

from math import inf

from lqrsim.kernels.control_limits import hold_those_at_limits, limits, riccati_backward_within
from lqrsim.kernels.interface import (
    M,
    N,
    W,
    begin,
    depart,
    final_quadratic,
    initial_quadratic,
    linearize,
    minimizer,
    riccati_forward,
    stack,
    stage_quadratic,
)
from lqrsim.kernels.linear_algebra import about_origin, affine, cholesky, cholesky_solve, clear, finite, offset, within
from lqrsim.kernels.runge_kutta import step, step_jacobian


def stage_model(x, u, t, stage, prior_weight, prior_about, damping, plan_u, hessian, gradient):
    """Write the stage about (x, u) as a quadratic about the origin, Eqs. (26)-(27); return its constant.

    `damping` weighs how far the control moves from the plan's, in units of the control's own curvature.
    """
    value = stage_quadratic(x, u, t, stage, hessian, gradient)
    if t > 0:
        for i in range(N):
            weight, error = prior_weight[i], x[i] - prior_about[t, i]
            hessian[i, i] += weight
            gradient[i] += weight * error
            value += 0.5 * weight * error * error
    if damping > 0:
        for i in range(M):
            weight, error = damping * hessian[N + i, N + i], u[i] - plan_u[t, i]
            hessian[N + i, N + i] += weight
            gradient[N + i] += weight * error
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


def begin_model(x, initial, fixed, damping, plan_x, S, C, b):
    """Write the cost-to-come at 0, with c_0 quadratised at x, and return its constant; or of a start that is given.

    Returns also whether there is one, and what the quadratic of c_0 is at the origin.
    """
    hessian, gradient, Q, q, none = stack(W, W), stack(W), stack(N, N), stack(N), stack(M)
    if fixed:
        clear(C, N, N)
        copy(x, N, b)
        return 0.0, True, 0.0
    value = initial_quadratic(x, none, 0, initial, hessian, gradient)
    if damping > 0:
        for i in range(N):
            weight, error = damping * hessian[i, i], x[i] - plan_x[0, i]
            hessian[i, i] += weight
            gradient[i] += weight * error
            value += 0.5 * weight * error * error
    constant = end_model(hessian, gradient, value, x, Q, q)
    k, good = begin(Q, q, constant, x, S, C, b)
    return k, good, constant


def forward_pass(
    steps, fixed, guided, damping, plan_x, plan_u, x_hat, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar,
    p, dt, initial, stage, final, prior_weight, prior_about,
):  # fmt: skip
    """The forward extended LQR pass, Sec. V-B: from the cost-to-go and its policy, the cost-to-come and its own.

    C, b, kbar are the cost-to-come and G, a, Lbar, lbar what `depart` needs, as the form has them. `x_hat` (N,) is
    where c_0 is quadratised, and on return the minimiser at T, where c_l was. S[T], s[T], k[T] are set. With `guided`
    the plan is what is linearised about, and not the minimisers.
    """
    hessian, gradient, jacobian, c = stack(W, W), stack(W), stack(N, W), stack(N)
    fx, fu, x_next, costate, u = stack(N, N), stack(N, M), stack(N), stack(N), stack(M)
    low, high = stack(M), stack(M)
    limits(stage, low, high)
    clear(fx, N, N)
    clear(fu, N, M)
    kbar[0], good, _ = begin_model(x_hat, initial, fixed, damping, plan_x, S[0], C[0], b[0])
    if not good:
        return 0, finite(C[0], N, N)
    for t in range(steps):
        if guided:
            copy(plan_x[t], N, x_hat)
            copy(plan_u[t], M, u)
        else:
            affine(L[t], l[t], x_hat, u)
            within(u, low, high)
        linearize(x_hat, u, p, dt, fx, fu, x_next, jacobian, c)
        constant = stage_model(
            x_hat, u, t, stage, prior_weight, prior_about, damping, plan_u, hessian, gradient
        )  # fmt: skip
        constant += hold_those_at_limits(u, L[t], low, high, hessian, gradient, jacobian, c)
        kbar[t + 1], good = riccati_forward(
            jacobian, c, hessian, gradient, constant, C[t], b[t], kbar[t], G[t], a[t], Lbar[t], lbar[t],
            C[t + 1], b[t + 1],
        )  # fmt: skip
        if not good:
            return t, finite(hessian, W, W) and finite(jacobian, N, W)
        if t + 1 < steps and not guided and not minimizer(S[t + 1], s[t + 1], C[t + 1], b[t + 1], costate, x_hat):
            return t + 1, finite(S[t + 1], N, N) and finite(C[t + 1], N, N)
    if guided:
        copy(plan_x[steps], N, x_hat)
    elif not minimizer(S[steps], s[steps], C[steps], b[steps], costate, x_hat):
        # In the first iteration there may be no minimum without c_l, and the state of arrival is what we have.
        copy(x_next, N, x_hat)
    value = final_quadratic(x_hat, u, steps, final, hessian, gradient)
    k[steps] = end_model(hessian, gradient, value, x_hat, S[steps], s[steps])
    if not minimizer(S[steps], s[steps], C[steps], b[steps], costate, x_hat):
        return steps, finite(S[steps], N, N) and finite(C[steps], N, N)
    return -1, True


def backward_pass(
    steps, fixed, reach, damping, plan_x, plan_u, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar,
    p, dt, initial, stage, prior_weight, prior_about,
):  # fmt: skip
    """The backward extended LQR pass, Sec. V-A: from the cost-to-come and its policy, the cost-to-go and its own.

    `x_hat` (N,) is, on return, the minimiser at 0, where c_0 was quadratised anew. Writes all the minimisers to
    `x_hats` (T+1, N). What is linearised about lies a fraction `reach` of the way from the plan to where the minimisers
    lead: all of it in the paper's method. The rest is as in `forward_pass`.

    Returns also a cost that is as good as none. Where the least cost is zero, squares of rounding errors remain of it,
    some 1e-13 of the numbers that cancel: those are in what the quadratic models are at the origin.
    """
    hessian, gradient, jacobian, c = stack(W, W), stack(W), stack(N, W), stack(N)
    fx, fu, x_next, x, u, costate = stack(N, N), stack(N, M), stack(N), stack(N), stack(M), stack(N)
    low, high = stack(M), stack(M)
    limits(stage, low, high)
    clear(fx, N, N)
    clear(fu, N, M)
    if not minimizer(S[steps], s[steps], C[steps], b[steps], costate, x_hat):
        return steps, finite(S[steps], N, N) and finite(C[steps], N, N), 0.0
    size = abs(k[steps])
    for t in range(steps - 1, -1, -1):
        copy(x_hat, N, x_hats[t + 1])
        depart(x_hat, costate, G[t], a[t], Lbar[t], lbar[t], p, dt, low, high, x, u)
        if reach < 1:
            for i in range(N):
                x[i] = plan_x[t, i] + reach * (x[i] - plan_x[t, i]) if reach > 0 else plan_x[t, i]
            for i in range(M):
                u[i] = plan_u[t, i] + reach * (u[i] - plan_u[t, i]) if reach > 0 else plan_u[t, i]
        step_jacobian(x, u, p, dt, fx, fu, x_next, jacobian)
        offset(jacobian, x, u, x_next, c)
        constant = stage_model(x, u, t, stage, prior_weight, prior_about, damping, plan_u, hessian, gradient)
        size += abs(constant)
        k[t], good = riccati_backward_within(
            jacobian, c, hessian, gradient, constant, S[t + 1], s[t + 1], k[t + 1], x, low, high, L[t], l[t], S[t], s[t]
        )
        if not good or not minimizer(S[t], s[t], C[t], b[t], costate, x_hat):
            return t, finite(hessian, W, W) and finite(jacobian, N, W) and finite(C[t], N, N), 0.0
    good = True
    if not fixed:
        kbar[0], good, constant = begin_model(x_hat, initial, fixed, damping, plan_x, S[0], C[0], b[0])
        size += abs(constant)
    if not good or not minimizer(S[0], s[0], C[0], b[0], costate, x_hat):
        return 0, finite(S[0], N, N) and finite(C[0], N, N), 0.0
    copy(x_hat, N, x_hats[0])
    return -1, True, 1e-26 * size if size < inf else 0.0


def opening_pass(
    steps, guided, plan_x, plan_u, L, l, S, s, k, p, dt, stage, final, prior_weight, prior_about
):  # fmt: skip
    """A backward pass before any forward one: there is no cost-to-come, and the minimisers are of the cost-to-go alone.

    Without a plan to be guided by, the dynamics run backwards from the minimiser of c_l, with the controls `plan_u`;
    c_l is first quadratised at plan_x[T].
    """
    hessian, gradient, jacobian, c = stack(W, W), stack(W), stack(N, W), stack(N)
    fx, fu, x_next, x, x_hat, u = stack(N, N), stack(N, M), stack(N), stack(N), stack(N), stack(M)
    low, high = stack(M), stack(M)
    limits(stage, low, high)
    clear(fx, N, N)
    clear(fu, N, M)
    copy(plan_x[steps], N, x_hat)
    for _ in range(2):
        value = final_quadratic(x_hat, u, steps, final, hessian, gradient)
        k[steps] = end_model(hessian, gradient, value, x_hat, S[steps], s[steps])
        if not guided:
            lowest(S[steps], s[steps], x_hat)
    for t in range(steps - 1, -1, -1):
        copy(plan_u[t], M, u)
        if guided:
            copy(plan_x[t], N, x)
        else:
            step(x_hat, u, p, -dt, x)
        step_jacobian(x, u, p, dt, fx, fu, x_next, jacobian)
        offset(jacobian, x, u, x_next, c)
        constant = stage_model(x, u, t, stage, prior_weight, prior_about, 0.0, plan_u, hessian, gradient)
        k[t], good = riccati_backward_within(
            jacobian, c, hessian, gradient, constant, S[t + 1], s[t + 1], k[t + 1], x, low, high, L[t], l[t], S[t], s[t]
        )
        if not good:
            return t, finite(hessian, W, W) and finite(jacobian, N, W)
        copy(x, N, x_hat)
        lowest(S[t], s[t], x_hat)
    return -1, True


def minimizers(steps, S, s, C, b, x_hats):
    """Write the states of least total cost; False if one has none."""
    costate, good = stack(N), True
    for t in range(steps + 1):
        good = minimizer(S[t], s[t], C[t], b[t], costate, x_hats[t]) and good
    return good


def lowest(S, s, x):
    """Write the minimiser of a cost-to-go, if it has one; leave x as it is if not."""
    factor, least = stack(N, N), stack(N)
    for i in range(N):
        least[i] = -s[i]
        for j in range(N):
            factor[i, j] = S[i, j]
    if cholesky(factor, N):
        cholesky_solve(factor, N, least)
        copy(least, N, x)


def copy(source, size, target):
    """Copy a vector."""
    for i in range(size):
        target[i] = source[i]

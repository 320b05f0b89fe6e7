"""The passes of LQR smoothing. The kernels' subset; see `records.py` for what they are given.

A pass returns the step at which it failed, or -1, and whether all numbers there were finite.
"""

from math import inf

from lqrsim.kernels.control_limits import fix_controls_at_limits, riccati_backward_within
from lqrsim.kernels.declarations import (
    NOISY,
    M,
    N,
    W,
    forward_jacobian,
    initial_cost_to_come,
    linearize,
    previous_state,
    riccati_forward,
    smoothed_state,
    stack,
)
from lqrsim.kernels.linear_algebra import about_origin, affine, cholesky, cholesky_solve, clear, finite, offset, within
from lqrsim.kernels.model_functions import advance, cost_quadratic, noise_quadratic, step_jacobian
from lqrsim.kernels.records import Linearization, LinearStep, NextStep, QuadraticStage


def forward_pass(settings, model, about, work):
    """The forward extended LQR pass, Sec. V-B: from the cost-to-go and its policy, the cost-to-come and its own.

    `work.x_hat` is where c_0 is quadratised, and on return the minimiser at T, where c_l was. The cost-to-go at T is
    set. Where the linearisation is guided, it is about the plan, and not about the minimisers.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived = stack(N)
    costate, u, x_hat, to_go, to_come = stack(N), stack(M), work.x_hat, work.to_go, work.to_come
    spare = stack(N, W)
    good, _ = initial_model(x_hat, settings.fixed, model, about, to_go, to_come)
    if not good:
        return 0, finite(to_come.matrix[0], N, N)
    for t in range(settings.steps):
        if about.guided:
            copy(about.plan.states[t], N, x_hat)
            copy(about.plan.controls[t], M, u)
        else:
            affine(work.policy.gain[t], work.policy.offset[t], x_hat, u)
            within(u, model.limits)
        linearize(x_hat, u, model, arrived, step)
        jacobian = forward_jacobian(x_hat, u, model, arrived, step, spare)
        ahead = NextStep(jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x_hat, u, t, model, about, ahead, True, stage)
        constant += fix_controls_at_limits(u, work.policy.gain[t], model.limits, stage, step)
        if not riccati_forward(t, step, stage, constant, to_come, work.smoothing):
            return t, finite(stage.hessian, W, W) and finite(step.jacobian, N, W)
        if t + 1 < settings.steps and not about.guided and not smoothed_state(t + 1, to_go, to_come, costate, x_hat):
            return t + 1, finite(to_go.hessian[t + 1], N, N) and finite(to_come.matrix[t + 1], N, N)
    steps = settings.steps
    if about.guided:
        copy(about.plan.states[steps], N, x_hat)
    elif not smoothed_state(steps, to_go, to_come, costate, x_hat):
        # In the first iteration there may be no minimum without c_l, and the state of arrival is what we have.
        copy(arrived, N, x_hat)
    final_model(x_hat, steps, model, to_go)
    if not smoothed_state(steps, to_go, to_come, costate, x_hat):
        return steps, finite(to_go.hessian[steps], N, N) and finite(to_come.matrix[steps], N, N)
    return -1, True


def backward_pass(settings, model, about, work):
    """The backward extended LQR pass, Sec. V-A: from the cost-to-come and its policy, the cost-to-go and its own.

    `work.x_hat` is, on return, the minimiser at 0, where c_0 was quadratised anew, and `work.x_hats` has all of them.
    What is linearised about lies a fraction `about.reach` of the way from the plan to where the minimisers lead: all of
    it in the paper's method.

    Returns also a cost that is as good as none. Where the least cost is zero, squares of rounding errors remain of it,
    some 1e-13 of the numbers that cancel: those are in what the quadratic models are at the origin.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived = stack(N)
    x, u, costate, x_hat, to_go, to_come = stack(N), stack(M), stack(N), work.x_hat, work.to_go, work.to_come
    steps = settings.steps
    if not smoothed_state(steps, to_go, to_come, costate, x_hat):
        return steps, finite(to_go.hessian[steps], N, N) and finite(to_come.matrix[steps], N, N), 0.0
    size = abs(to_go.constant[steps])
    for t in range(steps - 1, -1, -1):
        copy(x_hat, N, work.x_hats[t + 1])
        previous_state(t, x_hat, costate, work.smoothing, model, x, u)
        if about.reach < 1:
            towards(x, about.reach, about.plan.states[t], N)
            towards(u, about.reach, about.plan.controls[t], M)
        linearize_forward(x, u, model, arrived, step)
        ahead = NextStep(step.jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x, u, t, model, about, ahead, False, stage)
        size += abs(constant)
        good = riccati_backward_within(t, step, stage, constant, x, model.limits, work.policy, to_go)
        if not good or not smoothed_state(t, to_go, to_come, costate, x_hat):
            return (
                t,
                finite(stage.hessian, W, W) and finite(step.jacobian, N, W) and finite(to_come.matrix[t], N, N),
                0.0,
            )
    good = True
    if not settings.fixed:
        good, constant = initial_model(x_hat, settings.fixed, model, about, to_go, to_come)
        size += abs(constant)
    if not good or not smoothed_state(0, to_go, to_come, costate, x_hat):
        return 0, finite(to_go.hessian[0], N, N) and finite(to_come.matrix[0], N, N), 0.0
    copy(x_hat, N, work.x_hats[0])
    return -1, True, 1e-26 * size if size < inf else 0.0


def opening_pass(steps, guided, guess, prior, model, policy, to_go):
    """A backward pass before any forward one: there is no cost-to-come, and the minimisers are of the cost-to-go alone.

    Without a plan to be guided by, the dynamics run backwards from the minimiser of c_l, with the controls of the
    guess; c_l is first quadratised at its last state.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived = stack(N)
    x, x_hat, u = stack(N), stack(N), stack(M)
    about = Linearization(guess, guided, 1.0, 0.0, prior)
    copy(guess.states[steps], N, x_hat)
    for _ in range(2):
        final_model(x_hat, steps, model, to_go)
        if not guided:
            minimize_cost_to_go(to_go.hessian[steps], to_go.gradient[steps], x_hat)
    for t in range(steps - 1, -1, -1):
        copy(guess.controls[t], M, u)
        if guided:
            copy(guess.states[t], N, x)
        else:
            advance(x_hat, u, model, -model.dt, x)
        linearize_forward(x, u, model, arrived, step)
        ahead = NextStep(step.jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x, u, t, model, about, ahead, False, stage)
        if not riccati_backward_within(t, step, stage, constant, x, model.limits, policy, to_go):
            return t, finite(stage.hessian, W, W) and finite(step.jacobian, N, W)
        copy(x, N, x_hat)
        minimize_cost_to_go(to_go.hessian[t], to_go.gradient[t], x_hat)
    return -1, True


def linearize_forward(x, u, model, arrived, step):
    """Write where (x, u) leads, and the step linearised there, Eq. (25): x_next = jacobian (x, u) + offset."""
    step_jacobian(x, u, model, model.dt, arrived, step.jacobian)
    offset(step.jacobian, x, u, arrived, step.offset)


def stage_model(x, u, t, model, about, ahead, convex, stage):
    """Write the stage about (x, u) as a quadratic about the origin, Eqs. (26)-(27); return its constant.

    What noise is expected to cost belongs to it, given what lies ahead; `convex` is as in `noise_quadratic`.
    The prior is no part of the cost, but added to its quadratic model in the first iterations, where it keeps the
    linearisations sensible. Damping weighs how far the control moves from the plan's.
    """
    hessian, gradient, prior = stage.hessian, stage.gradient, about.prior
    value = cost_quadratic(x, u, t, model.stage, hessian, gradient)
    if NOISY:
        value += noise_quadratic(x, u, model.noise, ahead, convex, stage)
    if t > 0:
        for i in range(N):
            weight, error = prior.weight[i], x[i] - prior.about[t, i]
            hessian[i, i] += weight
            gradient[i] += weight * error
            value += 0.5 * weight * error * error
    if about.damping > 0:
        for i in range(M):
            weight, error = about.damping * hessian[N + i, N + i], u[i] - about.plan.controls[t, i]
            hessian[N + i, N + i] += weight
            gradient[N + i] += weight * error
            value += 0.5 * weight * error * error
    return about_origin(hessian, gradient, x, u, value)


def final_model(x, steps, model, to_go):
    """Write the cost-to-go at T: c_l quadratised at x. Paper: Eq. (31)."""
    hessian, gradient, none = stack(W, W), stack(W), stack(M)
    value = cost_quadratic(x, none, steps, model.final, hessian, gradient)
    to_go.constant[steps] = end_model(hessian, gradient, value, x, to_go.hessian[steps], to_go.gradient[steps])


def initial_model(x, fixed, model, about, to_go, to_come):
    """Write the cost-to-come at 0, with c_0 quadratised at x, Eq. (23); or of a start that is given.

    Returns whether there is one, and what the quadratic of c_0 is at the origin.
    """
    hessian, gradient, Q, q, none = stack(W, W), stack(W), stack(N, N), stack(N), stack(M)
    if fixed:
        clear(to_come.matrix[0], N, N)
        copy(x, N, to_come.vector[0])
        to_come.constant[0] = 0.0
        return True, 0.0
    value = cost_quadratic(x, none, 0, model.initial, hessian, gradient)
    if about.damping > 0:
        for i in range(N):
            weight, error = about.damping * hessian[i, i], x[i] - about.plan.states[0, i]
            hessian[i, i] += weight
            gradient[i] += weight * error
            value += 0.5 * weight * error * error
    constant = end_model(hessian, gradient, value, x, Q, q)
    to_come.constant[0], good = initial_cost_to_come(Q, q, constant, x, to_go, to_come)
    return good, constant


def end_model(hessian, gradient, value, x, S, s):
    """Write an initial or final cost, quadratised at x, as (S, s) about the origin; return its constant."""
    none = stack(M)
    for i in range(M):
        none[i] = 0.0
    constant = about_origin(hessian, gradient, x, none, value)
    for i in range(N):
        s[i] = gradient[i]
        for j in range(N):
            S[i, j] = hessian[i, j]
    return constant


def towards(z, fraction, origin, size):
    """Draw a vector towards another, so that only that fraction of the difference is left."""
    for i in range(size):
        z[i] = origin[i] + fraction * (z[i] - origin[i]) if fraction > 0 else origin[i]


def smoothed_states(steps, to_go, to_come, x_hats):
    """Write the states of least total cost; False if one has none."""
    costate, good = stack(N), True
    for t in range(steps + 1):
        good = smoothed_state(t, to_go, to_come, costate, x_hats[t]) and good
    return good


def minimize_cost_to_go(S, s, x):
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

"""The passes of LQR smoothing. `records.py` describes their arguments.

A pass returns the step at which it failed, or -1, and whether all numbers there were finite.
"""

from math import inf

from lqrsim.kernels.control_limits import fix_controls_at_limits, limited_control, riccati_backward
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
    zeros,
)
from lqrsim.kernels.linear_algebra import (
    about_origin,
    cholesky,
    cholesky_solve,
    clear,
    copy,
    copy_matrix,
    finite,
)
from lqrsim.kernels.model_functions import advance, cost_quadratic, linearize_forward, noise_quadratic
from lqrsim.kernels.records import Linearization, LinearStep, NextStep, QuadraticStage


def forward_pass(settings, model, about, work):
    """The forward extended LQR pass, Sec. V-B: cost-to-come and inverse policy, given cost-to-go and policy.

    Linearises about the smoothed states; or, if `about.guided`, about the plan. Sets the cost-to-go at T.

    Args:
      settings: IterationSettings. model: ProblemModel. about: Linearization.
      work: SmootherArrays. `x_hat` is the state at which c_0 is quadratised, and on return the smoothed state at T, at
        which c_l was quadratised.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, costate, u, spare = stack(N), stack(N), stack(M), stack(N, W)
    steps, x_hat, to_go, to_come = settings.steps, work.x_hat, work.to_go, work.to_come
    good, _ = initial_model(x_hat, settings.fixed, model, about, to_go, to_come)
    if not good:
        return 0, finite(to_come.matrix[0], N, N)
    for t in range(steps):
        if about.guided:
            copy(about.plan.states[t], N, x_hat)
            copy(about.plan.controls[t], M, u)
        else:
            limited_control(work.policy.gain[t], work.policy.offset[t], x_hat, model.limits, u)
        linearize(x_hat, u, model, arrived, step)
        jacobian = forward_jacobian(x_hat, u, model, arrived, step, spare)
        next_step = NextStep(jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x_hat, u, t, model, about, next_step, True, stage)
        constant += fix_controls_at_limits(u, work.policy.gain[t], model.limits, stage, step)
        if not riccati_forward(t, step, stage, constant, to_come, work.smoothing):
            return t, finite(stage.hessian, W, W) and finite(step.jacobian, N, W)
        if t + 1 < steps and not about.guided and not smoothed_state(t + 1, to_go, to_come, costate, x_hat):
            return t + 1, finite(to_go.hessian[t + 1], N, N) and finite(to_come.matrix[t + 1], N, N)
    if about.guided:
        copy(about.plan.states[steps], N, x_hat)
    elif not smoothed_state(steps, to_go, to_come, costate, x_hat):
        # In the first iteration there may be no minimum without c_l; the state of arrival is then used.
        copy(arrived, N, x_hat)
    final_model(x_hat, steps, model, to_go)
    if not smoothed_state(steps, to_go, to_come, costate, x_hat):
        return steps, finite(to_go.hessian[steps], N, N) and finite(to_come.matrix[steps], N, N)
    return -1, True


def backward_pass(settings, model, about, work):
    """The backward extended LQR pass, Sec. V-A: cost-to-go and policy, given cost-to-come and inverse policy.

    Linearises at a fraction `about.reach` of the way from the plan to the smoothed states; in the paper, at these.

    Args:
      work: SmootherArrays. On return `x_hat` is the smoothed state at 0, where c_0 was quadratised anew, and `x_hats`
        has all smoothed states. The rest is as for `forward_pass`.

    It also returns the negligible cost: if the optimal cost is zero, squares of rounding errors of the constants of the
    stages' models remain, which cancel.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, x, u, costate = stack(N), stack(N), stack(M), stack(N)
    steps, x_hat, to_go, to_come = settings.steps, work.x_hat, work.to_go, work.to_come
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
        next_step = NextStep(step.jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x, u, t, model, about, next_step, False, stage)
        size += abs(constant)
        good = riccati_backward(t, step, stage, constant, x, model.limits, work.policy, to_go)
        if not good or not smoothed_state(t, to_go, to_come, costate, x_hat):
            good = finite(stage.hessian, W, W) and finite(step.jacobian, N, W) and finite(to_come.matrix[t], N, N)
            return t, good, 0.0
    good = True
    if not settings.fixed:
        good, constant = initial_model(x_hat, settings.fixed, model, about, to_go, to_come)
        size += abs(constant)
    if not good or not smoothed_state(0, to_go, to_come, costate, x_hat):
        return 0, finite(to_go.hessian[0], N, N) and finite(to_come.matrix[0], N, N), 0.0
    copy(x_hat, N, work.x_hats[0])
    return -1, True, settings.rounding * size if size < inf else 0.0


def opening_pass(steps, guided, guess, prior, model, policy, to_go):
    """A backward pass before the first cost-to-come: it linearises about the minimisers of the cost-to-go.

    From the minimiser of c_l, first quadratised at the guess, the dynamics run backwards with the guessed controls.
    With `guided`, the pass linearises about the guess.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, x, x_hat, u = stack(N), stack(N), stack(N), stack(M)
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
        next_step = NextStep(step.jacobian, arrived, to_go.hessian[t + 1], to_go.gradient[t + 1])
        constant = stage_model(x, u, t, model, about, next_step, False, stage)
        if not riccati_backward(t, step, stage, constant, x, model.limits, policy, to_go):
            return t, finite(stage.hessian, W, W) and finite(step.jacobian, N, W)
        copy(x, N, x_hat)
        minimize_cost_to_go(to_go.hessian[t], to_go.gradient[t], x_hat)
    return -1, True


def stage_model(x, u, t, model, about, next_step, convex, stage):
    """Write the stage cost, quadratised at (x, u), about the origin, Eqs. (26)-(27); return its constant.

    It includes the expected cost of noise; the prior, which is no part of the cost, but keeps the linearisations
    sensible in the first iterations; and damping, a weight on the control's distance from the plan's.
    """
    hessian, gradient, prior = stage.hessian, stage.gradient, about.prior
    value = cost_quadratic(x, u, t, model.stage, hessian, gradient)
    if NOISY:
        value += noise_quadratic(x, u, t, model.noise, next_step, convex, stage)
    if t > 0:
        for i in range(N):
            value += add_square(i, prior.weight[i], x[i] - prior.about[t, i], hessian, gradient)
    if about.damping > 0:
        for i in range(M):
            weight = about.damping * hessian[N + i, N + i]
            value += add_square(N + i, weight, u[i] - about.plan.controls[t, i], hessian, gradient)
    return about_origin(hessian, gradient, x, u, value)


def add_square(i, weight, error, hessian, gradient):
    """Add `1/2 weight error^2`, the error of entry i, to a quadratic model; return its value."""
    hessian[i, i] += weight
    gradient[i] += weight * error
    return 0.5 * weight * error * error


def final_model(x, steps, model, to_go):
    """Write the cost-to-go at T: c_l quadratised at x, Eq. (31)."""
    hessian, gradient, none = stack(W, W), stack(W), zeros(M)
    value = cost_quadratic(x, none, steps, model.final, hessian, gradient)
    to_go.constant[steps] = end_model(hessian, gradient, value, x, to_go.hessian[steps], to_go.gradient[steps])


def initial_model(x, fixed, model, about, to_go, to_come):
    """Write the cost-to-come at 0: c_0 quadratised at x, Eq. (23), or that of a fixed start.

    Returns whether it exists, and the constant of c_0's model about the origin.
    """
    hessian, gradient, Q, q, none = stack(W, W), stack(W), stack(N, N), stack(N), zeros(M)
    if fixed:
        clear(to_come.matrix[0], N, N)
        copy(x, N, to_come.vector[0])
        to_come.constant[0] = 0.0
        return True, 0.0
    value = cost_quadratic(x, none, 0, model.initial, hessian, gradient)
    if about.damping > 0:
        for i in range(N):
            value += add_square(i, about.damping * hessian[i, i], x[i] - about.plan.states[0, i], hessian, gradient)
    constant = end_model(hessian, gradient, value, x, Q, q)
    to_come.constant[0], good = initial_cost_to_come(Q, q, constant, x, to_go, to_come)
    return good, constant


def end_model(hessian, gradient, value, x, S, s):
    """Write an initial or final cost, quadratised at x, about the origin: S (N, N), s (N,); return its constant."""
    none = zeros(M)
    constant = about_origin(hessian, gradient, x, none, value)
    copy(gradient, N, s)
    copy_matrix(hessian, N, N, S)
    return constant


def towards(z, fraction, origin, size):
    """Move a vector towards an origin until this fraction of the distance remains."""
    for i in range(size):
        z[i] = origin[i] + fraction * (z[i] - origin[i]) if fraction > 0 else origin[i]


def smoothed_states(steps, to_go, to_come, x_hats):
    """Write all smoothed states, (T+1, N); False if one does not exist."""
    costate, good = stack(N), True
    for t in range(steps + 1):
        good = smoothed_state(t, to_go, to_come, costate, x_hats[t]) and good
    return good


def minimize_cost_to_go(S, s, x):
    """Write the minimiser of a cost-to-go; leave x as it is if there is none."""
    factor, least = stack(N, N), stack(N)
    for i in range(N):
        least[i] = -s[i]
    copy_matrix(S, N, N, factor)
    if cholesky(factor, N):
        cholesky_solve(factor, N, least)
        copy(least, N, x)

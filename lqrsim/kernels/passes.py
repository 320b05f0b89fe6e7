"""Sweeps along a trajectory: the passes of LQR smoothing and of iLQR, rollouts, costs and line searches.

A pass returns the step at which it failed, or -1, and whether all numbers there were finite. `records.py` describes the
arguments.
"""

from math import inf, isnan, nan

from lqrsim.kernels.declarations import NOISY, M, N, W, inline, stack, zeros
from lqrsim.kernels.linear_algebra import (
    about_origin,
    affine,
    cholesky,
    cholesky_solve,
    clamp,
    clear,
    congruence,
    copy,
    copy_matrix,
    fill,
    finite,
)
from lqrsim.kernels.model_functions import (
    advance,
    cost_added,
    cost_of_order,
    cost_of_plan,
    cost_quadratic,
    cost_value,
    linearize_forward,
    noise_quadratic,
    noise_value,
    step_jacobian,
    step_second_order,
)
from lqrsim.kernels.records import Limits, Linearization, LinearStep, ModelOrder, NextStep, QuadraticStage
from lqrsim.kernels.riccati import (
    fix_controls_at_limits,
    initial_cost_to_come,
    limited_control,
    linearize,
    minimize_within,
    previous_state,
    riccati_backward,
    riccati_forward,
    smoothed_state,
)

# A predicted decrease below this fraction of the terms that cancel in it is a rounding error.
NEGLIGIBLE_DECREASE = 1e-28


def forward_pass(settings, model, about, work):
    """The forward extended LQR pass, Sec. V-B: cost-to-come and inverse policy, given cost-to-go and policy.

    Linearises about the smoothed states; or, if `about.guided`, about the plan. Sets the cost-to-go at T.

    Args:
      settings: IterationSettings. model: ProblemModel. about: Linearization.
      work: SmootherArrays. `x_hat` is the state at which c_0 is quadratised; on return the smoothed state at T, after
        c_l was quadratised at the one before.
    """
    stage, step = QuadraticStage(stack(W, W), stack(W)), LinearStep(stack(N, W), stack(N))
    arrived, costate, u, forward_jacobian = stack(N), stack(N), stack(M), stack(N, W)
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
        jacobian = linearize(x_hat, u, model, arrived, step, forward_jacobian)
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
      work: SmootherArrays. On return `x_hat` is the smoothed state at 0, after c_0 was quadratised at the one before,
        and `x_hats` has all smoothed states. The rest is as for `forward_pass`.

    Also returns the cost that counts as zero: at an optimal cost of zero the constants of the stages' models cancel, up
    to rounding errors of about this size.
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


def rollout(steps, x0, policy, model, plan):
    """Run the policy from x0 (N,) under the true dynamics; write the trajectory, and return its true cost."""
    x, u = plan.states[0], stack(M)
    copy(x0, N, x)
    cost = cost_value(x, u, 0, model.initial)
    for t in range(steps):
        x, u = plan.states[t], plan.controls[t]
        limited_control(policy.gain[t], policy.offset[t], x, model.limits, u)
        cost += cost_value(x, u, t, model.stage)
        advance(x, u, model, model.dt, plan.states[t + 1])
    return cost + cost_value(plan.states[steps], u, steps, model.final)


def noise_cost(steps, plan, model, to_go):
    """The expected cost of noise along a trajectory, given the cost-to-go of the policy that makes it."""
    total, none = 0.0, stack(N, W)
    for t in range(steps):
        next_step = NextStep(none, plan.states[t + 1], to_go.hessian[t + 1], to_go.gradient[t + 1])
        total += noise_value(plan.states[t], plan.controls[t], t, model.noise, next_step)
    return total


def plan_cost(steps, plan, model, to_go):
    """The cost of a trajectory with the expected cost of noise, and the augmented Lagrangian's terms."""
    added = 0.0
    for t in range(steps):
        added += cost_added(plan.states[t], plan.controls[t], t, model.stage)
    added += cost_added(plan.states[steps], plan.controls[steps - 1], steps, model.final)
    return cost_of_plan(steps, plan, model) + noise_cost(steps, plan, model, to_go), added


def ddp_pass(steps, plan, model, order, keep, policy, to_go):
    """The backward pass of iLQR or DDP about a trajectory.

    Args:
      plan: a Motion that satisfies the dynamics. order: ModelOrder.
      keep: 1 to write all steps; 0 to overwrite a single step, if only the predicted decrease is needed.
      policy: relative to the plan, written. to_go: about the origin, written.

    The decrease of cost that the model predicts is returned, too: 0 if it is only rounding, as at an optimal cost of 0.
    """
    second_order, stage = order.second_order, QuadraticStage(stack(W, W), stack(W))
    jacobian, arrived, weights, none, no_change = stack(N, W), stack(N), stack(N), zeros(M), zeros(N)
    slope, curve = stack(N), stack(N, N)
    hessian, gradient, change_limits = stage.hessian, stage.gradient, Limits(stack(M), stack(M))
    states, controls, S, s, k = plan.states, plan.controls, to_go.hessian, to_go.gradient, to_go.constant
    value = cost_of_order(states[steps], none, steps, model.final, second_order, hessian, gradient)
    predicted, cost_ahead = 0.0, value
    copy(gradient, N, slope)
    copy_matrix(hessian, N, N, curve)
    last = steps * keep
    k[last] = end_model(hessian, gradient, value, states[steps], S[last], s[last])
    for t in range(steps - 1, -1, -1):
        at, x, u = t * keep, states[t], controls[t]
        cost_ahead += cost_of_order(x, u, t, model.stage, second_order, hessian, gradient)
        if second_order > 0:
            for i in range(N):
                weights[i] = second_order * slope[i]
            step_second_order(x, u, model, weights, arrived, jacobian, hessian)
        else:
            step_jacobian(x, u, model, model.dt, arrived, jacobian)
        if NOISY:
            next_step = NextStep(jacobian, arrived, curve, s[(t + 1) * keep])
            if second_order > 0:
                next_step = NextStep(jacobian, arrived, order.known.hessian[t + 1], order.known.gradient[t + 1])
            cost_ahead += noise_quadratic(x, u, t, model.noise, next_step, False, stage)
        terms = diagonal_terms(arrived, N, 0, curve) + diagonal_terms(x, N, 0, hessian)
        terms += diagonal_terms(u, M, N, hessian)
        congruence(jacobian, curve, slope, hessian, gradient)
        for i in range(M):
            hessian[N + i, N + i] += order.damping
            change_limits.low[i], change_limits.high[i] = model.limits.low[i] - u[i], model.limits.high[i] - u[i]
        gain, offset = policy.gain[at], policy.offset[at]
        decrease, good = minimize_within(stage, no_change, change_limits, gain, offset, curve, slope)
        if not good:
            return t, finite(hessian, W, W) and finite(jacobian, N, W), predicted
        if not decrease <= NEGLIGIBLE_DECREASE * terms:  # a NaN stays
            predicted += decrease
        constant = cost_ahead - predicted
        for i in range(N):
            gradient_at_origin = slope[i]
            for j in range(N):
                S[at, i, j] = curve[i, j]
                gradient_at_origin -= curve[i, j] * x[j]
            s[at, i] = gradient_at_origin
            constant -= 0.5 * (slope[i] + gradient_at_origin) * x[i]
        k[at] = constant
    return -1, True, predicted


@inline
def ilqr_pass(steps, plan, model, damping, policy, to_go):
    """`ddp_pass` of iLQR, with that damping."""
    return ddp_pass(steps, plan, model, ModelOrder(damping, 0.0, to_go), 1, policy, to_go)


def initial_step(x0, model, second_order, to_go, direction):
    """Write the best change (N,) of a start x0 that has a cost, given the cost-to-go; return its predicted decrease."""
    S, s = to_go.hessian[0], to_go.gradient[0]
    hessian, gradient, none = stack(W, W), stack(W), zeros(M)
    total, slope = stack(N, N), stack(N)
    cost_of_order(x0, none, 0, model.initial, second_order, hessian, gradient)
    for i in range(N):
        slope[i] = gradient[i] + s[i]
        for j in range(N):
            slope[i] += S[i, j] * x0[j]
            total[i, j] = hessian[i, j] + S[i, j]
        direction[i] = -slope[i]
        if slope[i] == 0 and total[i, i] == 0:  # a state without weight need not move
            total[i, i] = 1.0
    if not cholesky(total, N):
        return nan
    cholesky_solve(total, N, direction)
    decrease = 0.0
    for i in range(N):
        decrease -= 0.5 * slope[i] * direction[i]
    terms = diagonal_terms(x0, N, 0, hessian) + diagonal_terms(x0, N, 0, S)
    return 0.0 if decrease <= NEGLIGIBLE_DECREASE * terms else decrease


def diagonal_terms(z, size, first, hessian):
    """The sum of |H_ii| z_i^2 / 2 for z (size,), from an index of H on: the size of terms that may cancel."""
    total = 0.0
    for i in range(size):
        total += 0.5 * abs(hessian[first + i, first + i]) * z[i] * z[i]
    return total


def largest_gap(steps, x_hats, states):
    """The largest difference between two sequences of states, each state relative to its range, or to 1."""
    gap = 0.0
    for i in range(N):
        low, high, worst = states[0, i], states[0, i], 0.0
        for t in range(steps + 1):
            worst = larger(worst, abs(x_hats[t, i] - states[t, i]))
            low, high = min(low, states[t, i]), max(high, states[t, i])
        gap = larger(gap, worst / max(high - low, 1.0))
    return gap


def dynamics_residual(steps, x_hats, policy, model, states):
    """The largest x_{t+1} - g(x_t, u_t) of a sequence of states under a policy, relative as `largest_gap` is."""
    u, arrived, least, most, worst = stack(M), stack(N), stack(N), stack(N), zeros(N)
    copy(states[0], N, least)
    copy(states[0], N, most)
    for t in range(steps):
        limited_control(policy.gain[t], policy.offset[t], x_hats[t], model.limits, u)
        advance(x_hats[t], u, model, model.dt, arrived)
        for i in range(N):
            worst[i] = larger(worst[i], abs(x_hats[t + 1, i] - arrived[i]))
            least[i], most[i] = min(least[i], states[t + 1, i]), max(most[i], states[t + 1, i])
    residual = 0.0
    for i in range(N):
        residual = larger(residual, worst[i] / max(most[i] - least[i], 1.0))
    return residual


def larger(a, b):
    """The larger of two numbers; NaN if one of them is."""
    return b if b > a or isnan(b) else a


def line_search(steps, shift, work, model, bound, slope, smallest):
    """Try fractions 1, 1/2, 1/4, ... of a step until the merit is below `bound` by that fraction of `slope`.

    The merit is the true cost (with noise the expected one) plus the augmented Lagrangian's terms. Returns merit, cost
    and fraction; or `bound`, `bound` and 0 if no fraction down to `smallest` is accepted.

    Args:
      shift: (N,) shift of the start. work: its policy contains the changes of the controls, about its plan; the rollout
        is written to its `last`.
    """
    fraction, plan, policy, trial = 1.0, work.best, work.policy, work.last
    while fraction >= smallest:
        for i in range(N):
            trial.states[0, i] = plan.states[0, i] + fraction * shift[i]
        cost, added = cost_value(trial.states[0], trial.controls[0], 0, model.initial), 0.0
        for t in range(steps):
            x, u = trial.states[t], trial.controls[t]
            for i in range(M):
                total = plan.controls[t, i] + fraction * policy.offset[t, i]
                for j in range(N):
                    total += policy.gain[t, i, j] * (x[j] - plan.states[t, j])
                u[i] = total
            clamp(u, model.limits)
            cost += cost_value(x, u, t, model.stage)
            added += cost_added(x, u, t, model.stage)
            advance(x, u, model, model.dt, trial.states[t + 1])
        cost += cost_value(trial.states[steps], trial.controls[steps - 1], steps, model.final)
        if NOISY:
            cost += noise_cost(steps, trial, model, work.to_go)
        added += cost_added(trial.states[steps], trial.controls[steps - 1], steps, model.final)
        if cost + added < bound - fraction * slope:
            return cost + added, cost, fraction
        fraction *= 0.5
    return bound, bound, 0.0


def copy_plan(steps, source, target):
    """Copy a trajectory."""
    copy_matrix(source.states, steps + 1, N, target.states)
    copy_matrix(source.controls, steps, M, target.controls)


def copy_policy(steps, source, target):
    """Copy a policy."""
    for t in range(steps):
        copy(source.offset[t], M, target.offset[t])
        copy_matrix(source.gain[t], M, N, target.gain[t])


def policy_about_plan(steps, plan, policy):
    """Make a policy relative to the plan: its offsets become L x + l - u, the changes of the controls."""
    u = stack(M)
    for t in range(steps):
        affine(policy.gain[t], policy.offset[t], plan.states[t], M, N, u)
        for i in range(M):
            policy.offset[t, i] = u[i] - plan.controls[t, i]


def lq_passes(steps, dynamics, forward_steps, stages, constants, work):
    """Both passes of a linear-quadratic problem, and its smoothed states.

    Args:
      dynamics: LinearStep, [A B] (T, N, W) and c (T, N).
      forward_steps: steps of the forward pass: inverse steps in the primal form, `dynamics` in the dual form.
      stages: QuadraticStage, (T, W, W) and (T, W). constants: (T,).
      work: RiccatiArrays, with the cost-to-go at T and the cost-to-come at 0.

    Returns:
      The step that failed, or -1; and 0 if it was in the backward pass, 1 in the forward pass, 2
      where the two value functions were added.
    """
    stage, costate, anywhere = QuadraticStage(stack(W, W), stack(W)), stack(N), zeros(N)
    limits = Limits(stack(M), stack(M))
    fill(limits.low, M, -inf)
    fill(limits.high, M, inf)
    for t in range(steps - 1, -1, -1):
        copy_stage(t, stages, stage)
        step = LinearStep(dynamics.jacobian[t], dynamics.offset[t])
        if not riccati_backward(t, step, stage, constants[t], anywhere, limits, work.policy, work.to_go):
            return t, 0
    for t in range(steps):
        copy_stage(t, stages, stage)
        step = LinearStep(forward_steps.jacobian[t], forward_steps.offset[t])
        if not riccati_forward(t, step, stage, constants[t], work.to_come, work.smoothing):
            return t, 1
    for t in range(steps + 1):
        if not smoothed_state(t, work.to_go, work.to_come, costate, work.x_hats[t]):
            return t, 2
    return -1, 0


def copy_stage(t, stages, stage):
    """Copy a stage, because the Riccati steps overwrite theirs."""
    copy_matrix(stages.hessian[t], W, W, stage.hessian)
    copy(stages.gradient[t], W, stage.gradient)

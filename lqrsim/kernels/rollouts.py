"""Sweeps along a trajectory: rollouts of a policy, costs, line searches, and the backward pass of iLQR.

Shapes and names are as in `passes.py`.
"""

from math import isnan, nan

from lqrsim.kernels.control_limits import limited_control, minimize_within
from lqrsim.kernels.declarations import NOISY, M, N, W, inline, stack, zeros
from lqrsim.kernels.linear_algebra import affine, cholesky, cholesky_solve, clamp, congruence, copy, copy_matrix, finite
from lqrsim.kernels.model_functions import (
    advance,
    cost_added,
    cost_of_order,
    cost_value,
    noise_quadratic,
    noise_value,
    step_jacobian,
    step_second_order,
)
from lqrsim.kernels.passes import end_model
from lqrsim.kernels.records import Limits, ModelOrder, NextStep, QuadraticStage

# A predicted decrease below this fraction of the terms that cancel in it is a rounding error.
SQUARES = 1e-28


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
    states, controls = plan.states, plan.controls
    cost, added = cost_value(states[0], controls[0], 0, model.initial), 0.0
    for t in range(steps):
        cost += cost_value(states[t], controls[t], t, model.stage)
        added += cost_added(states[t], controls[t], t, model.stage)
    cost += cost_value(states[steps], controls[steps - 1], steps, model.final)
    added += cost_added(states[steps], controls[steps - 1], steps, model.final)
    return cost + noise_cost(steps, plan, model, to_go), added


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
        if not decrease <= SQUARES * terms:  # a NaN stays
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
    return 0.0 if decrease <= SQUARES * (diagonal_terms(x0, N, 0, hessian) + diagonal_terms(x0, N, 0, S)) else decrease


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


def line_search(steps, shift, work, model, bound, slope, smallest, trial):
    """Try fractions 1, 1/2, 1/4, ... of a step until the merit is below `bound` by that fraction of `slope`.

    The merit is the true cost (with noise the expected one) plus the augmented Lagrangian's terms. Returns merit, cost
    and fraction; or `bound`, `bound` and 0 if no fraction down to `smallest` is accepted.

    Args:
      shift: (N,) shift of the start. work: its policy contains the changes of the controls, about its plan.
      trial: Motion, written.
    """
    fraction, plan, policy = 1.0, work.best, work.policy
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


def shorten_step(steps, fraction, plan, x_hats):
    """Convert the states (T+1, N) after a whole step, in place, to the states after a fraction of the step."""
    if fraction < 1:
        for t in range(steps + 1):
            for i in range(N):
                x_hats[t, i] = plan.states[t, i] + fraction * (x_hats[t, i] - plan.states[t, i])


def policy_about_plan(steps, plan, policy):
    """Make a policy relative to the plan: its offsets become L x + l - u, the changes of the controls."""
    u = stack(M)
    for t in range(steps):
        affine(policy.gain[t], policy.offset[t], plan.states[t], M, N, u)
        for i in range(M):
            policy.offset[t, i] = u[i] - plan.controls[t, i]

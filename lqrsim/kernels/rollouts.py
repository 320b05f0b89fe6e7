"""Sweeps along a trajectory: running a policy, and what a linear-quadratic model about the plan says.

The kernels' subset. Shapes and names are those of `passes.py`.
"""

from math import isnan, nan

from lqrsim.kernels.control_limits import minimize_within
from lqrsim.kernels.declarations import (
    NOISY,
    M,
    N,
    W,
    stack,
)
from lqrsim.kernels.linear_algebra import affine, cholesky, cholesky_solve, congruence, finite, within
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
from lqrsim.kernels.passes import copy, end_model
from lqrsim.kernels.records import Limits, NextStep, QuadraticStage


def rollout(steps, x0, policy, model, plan):
    """Run the policy from x0 under the true dynamics; write the trajectory and return its true cost."""
    x, u = plan.states[0], stack(M)
    for i in range(N):
        x[i] = x0[i]
    cost = cost_value(x, u, 0, model.initial)
    for t in range(steps):
        x, u = plan.states[t], plan.controls[t]
        affine(policy.gain[t], policy.offset[t], x, u)
        within(u, model.limits)
        cost += cost_value(x, u, t, model.stage)
        advance(x, u, model, model.dt, plan.states[t + 1])
    return cost + cost_value(plan.states[steps], u, steps, model.final)


def noise_cost(steps, plan, model, to_go):
    """What noise is expected to cost along a trajectory, with the cost-to-go of the policy that makes it."""
    total, none = 0.0, stack(N, W)
    for t in range(steps):
        ahead = NextStep(none, plan.states[t + 1], to_go.hessian[t + 1], to_go.gradient[t + 1])
        total += noise_value(plan.states[t], plan.controls[t], model.noise, ahead)
    return total


def plan_cost(steps, plan, model, to_go):
    """Cost of a trajectory, with what noise is expected to cost, and what the augmented Lagrangian adds to it."""
    states, controls = plan.states, plan.controls
    cost, added = cost_value(states[0], controls[0], 0, model.initial), 0.0
    for t in range(steps):
        cost += cost_value(states[t], controls[t], t, model.stage)
        added += cost_added(states[t], controls[t], t, model.stage)
    cost += cost_value(states[steps], controls[steps - 1], steps, model.final)
    added += cost_added(states[steps], controls[steps - 1], steps, model.final)
    return cost + noise_cost(steps, plan, model, to_go), added


def differential_pass(steps, plan, model, order, keep, policy, to_go):
    """The backward pass of iLQR about a feasible trajectory; the policy is relative to it, the cost-to-go is about the
    origin.

    With `keep` of 1 all steps are written; with 0 each overwrites the one after it, for those who only ask what the
    model predicts.

    Returns as every pass does, and the decrease of cost that the linear-quadratic model predicts.
    """
    share, stage, arrived, weights = order.share, QuadraticStage(stack(W, W), stack(W)), stack(N), stack(N)
    jacobian, none, no_change = stack(N, W), stack(M), stack(N)
    slope, curve = stack(N), stack(N, N)
    hessian, gradient, room = stage.hessian, stage.gradient, Limits(stack(M), stack(M))
    states, controls, S, s, k = plan.states, plan.controls, to_go.hessian, to_go.gradient, to_go.constant
    for i in range(N):
        no_change[i] = 0.0
    for i in range(M):
        none[i] = 0.0
    value = cost_of_order(states[steps], none, steps, model.final, share, hessian, gradient)
    predicted, ahead = 0.0, value
    for i in range(N):
        slope[i] = gradient[i]
        for j in range(N):
            curve[i, j] = hessian[i, j]
    last = steps * keep
    k[last] = end_model(hessian, gradient, value, states[steps], S[last], s[last])
    for t in range(steps - 1, -1, -1):
        at, x, u = t * keep, states[t], controls[t]
        ahead += cost_of_order(x, u, t, model.stage, share, hessian, gradient)
        if share > 0:
            for i in range(N):
                weights[i] = share * slope[i]
            step_second_order(x, u, model, weights, arrived, jacobian, hessian)
        else:
            step_jacobian(x, u, model, model.dt, arrived, jacobian)
        if NOISY:
            beyond = NextStep(jacobian, arrived, curve, s[(t + 1) * keep])
            if share > 0:
                beyond = NextStep(jacobian, arrived, order.known.hessian[t + 1], order.known.gradient[t + 1])
            ahead += noise_quadratic(x, u, model.noise, beyond, False, stage)
        congruence(jacobian, curve, slope, hessian, gradient)
        for i in range(M):
            hessian[N + i, N + i] += order.damping
            room.low[i], room.high[i] = model.limits.low[i] - u[i], model.limits.high[i] - u[i]
        decrease, good = minimize_within(stage, no_change, room, policy.gain[at], policy.offset[at], curve, slope)
        if not good:
            return t, finite(hessian, W, W) and finite(jacobian, N, W), predicted
        predicted += decrease
        constant = ahead - predicted
        for i in range(N):
            moved = slope[i]
            for j in range(N):
                S[at, i, j] = curve[i, j]
                moved -= curve[i, j] * x[j]
            s[at, i] = moved
            constant -= 0.5 * (slope[i] + moved) * x[i]
        k[at] = constant
    return -1, True, predicted


def initial_step(x0, model, share, to_go, direction):
    """Write where the soft start x0 would best move, given the cost-to-go at 0; return what that promises, or NaN."""
    S, s = to_go.hessian[0], to_go.gradient[0]
    hessian, gradient, none = stack(W, W), stack(W), stack(M)
    total, slope = stack(N, N), stack(N)
    for i in range(M):
        none[i] = 0.0
    cost_of_order(x0, none, 0, model.initial, share, hessian, gradient)
    for i in range(N):
        slope[i] = gradient[i] + s[i]
        for j in range(N):
            slope[i] += S[i, j] * x0[j]
            total[i, j] = hessian[i, j] + S[i, j]
        direction[i] = -slope[i]
        if slope[i] == 0 and total[i, i] == 0:  # a state that nothing weighs may stay
            total[i, i] = 1.0
    if not cholesky(total, N):
        return nan
    cholesky_solve(total, N, direction)
    decrease = 0.0
    for i in range(N):
        decrease -= 0.5 * slope[i] * direction[i]
    return decrease


def largest_gap(steps, x_hats, states):
    """The largest difference between two sequences of states, each state relative to its range (at least 1)."""
    gap = 0.0
    for i in range(N):
        low, high, worst = states[0, i], states[0, i], 0.0
        for t in range(steps + 1):
            difference = abs(x_hats[t, i] - states[t, i])
            if difference > worst or isnan(difference):  # and then it stays
                worst = difference
            low, high = min(low, states[t, i]), max(high, states[t, i])
        relative = worst / max(high - low, 1.0)
        if relative > gap or isnan(relative):
            gap = relative
    return gap


def dynamics_residual(steps, x_hats, policy, model, states):
    """The largest step x_{t+1} - g(x_t, u_t) of a sequence of states under a policy, relative as the gap is."""
    u, ahead, least, most, worst = stack(M), stack(N), stack(N), stack(N), stack(N)
    for i in range(N):
        least[i], most[i], worst[i] = states[0, i], states[0, i], 0.0
    for t in range(steps):
        affine(policy.gain[t], policy.offset[t], x_hats[t], u)
        within(u, model.limits)
        advance(x_hats[t], u, model, model.dt, ahead)
        for i in range(N):
            difference = abs(x_hats[t + 1, i] - ahead[i])
            if difference > worst[i] or isnan(difference):
                worst[i] = difference
            least[i], most[i] = min(least[i], states[t + 1, i]), max(most[i], states[t + 1, i])
    residual = 0.0
    for i in range(N):
        relative = worst[i] / max(most[i] - least[i], 1.0)
        if relative > residual or isnan(relative):
            residual = relative
    return residual


def line_search(steps, shift, work, model, bound, slope, smallest, trial):
    """Try steps 1, 1/2, 1/4, ... along the changes of start and controls until the merit falls below `bound`, by that
    part of `slope` too.

    The changes are from the plan, by the policy in the workspace. The merit is the true cost, expected where there is
    noise, and what the augmented Lagrangian adds to it. Writes the trajectory. Returns its merit, its cost, and the
    step, which is 0 if none down to `smallest` lowers the merit.
    """
    fraction, plan, policy = 1.0, work.plan, work.policy
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
            within(u, model.limits)
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
    for t in range(steps + 1):
        copy(source.states[t], N, target.states[t])
    for t in range(steps):
        copy(source.controls[t], M, target.controls[t])


def copy_policy(steps, source, target):
    """Copy a policy."""
    for t in range(steps):
        for i in range(M):
            target.offset[t, i] = source.offset[t, i]
            for j in range(N):
                target.gain[t, i, j] = source.gain[t, i, j]


def shorten_step(steps, fraction, plan, x_hats):
    """Make of the states that a whole step was to lead to those that a part of it was."""
    if fraction < 1:
        for t in range(steps + 1):
            for i in range(N):
                x_hats[t, i] = plan.states[t, i] + fraction * (x_hats[t, i] - plan.states[t, i])


def policy_about_plan(steps, plan, policy):
    """Make the policy relative to the plan: l becomes L x + l - u, the change of the controls that it asks for."""
    u = stack(M)
    for t in range(steps):
        affine(policy.gain[t], policy.offset[t], plan.states[t], u)
        for i in range(M):
            policy.offset[t, i] = u[i] - plan.controls[t, i]

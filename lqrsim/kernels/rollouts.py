"""Sweeps along a trajectory: running a policy, and what a linear-quadratic model about the plan says. The numba subset.

Shapes and names are those of `passes.py`.
"""

from math import isnan, nan

from lqrsim.kernels.control_limits import limits, minimize_within
from lqrsim.kernels.interface import (
    M,
    N,
    W,
    final_added,
    final_quadratic,
    final_value,
    initial_quadratic,
    initial_value,
    stack,
    stage_added,
    stage_quadratic,
    stage_value,
)
from lqrsim.kernels.linear_algebra import affine, cholesky, cholesky_solve, clear, congruence, finite, within
from lqrsim.kernels.passes import copy, end_model
from lqrsim.kernels.runge_kutta import step, step_jacobian


def rollout(steps, x0, gain, feedforward, p, dt, initial, stage, final, states, controls):
    """Run the policy from x0 under the true dynamics; write the trajectory and return its true cost."""
    x, u, low, high = states[0], stack(M), stack(M), stack(M)
    limits(stage, low, high)
    for i in range(N):
        x[i] = x0[i]
    cost = initial_value(x, u, 0, initial)
    for t in range(steps):
        x, u = states[t], controls[t]
        affine(gain[t], feedforward[t], x, u)
        within(u, low, high)
        cost += stage_value(x, u, t, stage)
        step(x, u, p, dt, states[t + 1])
    return cost + final_value(states[steps], u, steps, final)


def costs_of(count, steps, states, controls, stage, final, costs):
    """Stage and final cost of trajectories (count (steps + 1), N) and (count steps, M), one after the other."""
    for k in range(count):
        costs[k] = 0.0
        for t in range(steps):
            costs[k] += stage_value(states[k * (steps + 1) + t], controls[k * steps + t], t, stage)
        last = controls[(k + 1) * steps - 1]
        costs[k] += final_value(states[(k + 1) * (steps + 1) - 1], last, steps, final)


def differential_pass(steps, states, controls, p, dt, stage, final, damping, keep, L, l, S, s, k):
    """The backward pass of iLQR about a feasible trajectory; l is relative to it, S, s, k are about the origin.

    `damping` is a weight on changes of the controls. With `keep` of 1 all steps are written; with 0 each overwrites the
    one after it, for those who only ask what the model predicts.

    Returns as every sweep does, and the decrease of cost that the linear-quadratic model predicts.
    """
    hessian, gradient, jacobian = stack(W, W), stack(W), stack(N, W)
    fx, fu, x_next, none = stack(N, N), stack(N, M), stack(N), stack(M)
    slope, curve = stack(N), stack(N, N)
    no_change, low, high, lowest, highest = stack(N), stack(M), stack(M), stack(M), stack(M)
    limits(stage, low, high)
    for i in range(N):
        no_change[i] = 0.0
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
            lowest[i], highest[i] = low[i] - controls[t, i], high[i] - controls[t, i]
        decrease, good = minimize_within(hessian, gradient, no_change, lowest, highest, L[at], l[at], curve, slope)
        if not good:
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


def initial_step(x0, initial, S, s, direction):
    """Write where the soft start x0 would best move, given the cost-to-go at 0; return what that promises, or NaN."""
    hessian, gradient, none = stack(W, W), stack(W), stack(M)
    total, slope = stack(N, N), stack(N)
    for i in range(M):
        none[i] = 0.0
    initial_quadratic(x0, none, 0, initial, hessian, gradient)
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


def dynamics_residual(steps, x_hats, L, l, p, dt, stage, states):
    """The largest step x_{t+1} - g(x_t, u_t) of a sequence of states under a policy, relative as the gap is."""
    u, ahead, least, most, worst = stack(M), stack(N), stack(N), stack(N), stack(N)
    low, high = stack(M), stack(M)
    limits(stage, low, high)
    for i in range(N):
        least[i], most[i], worst[i] = states[0, i], states[0, i], 0.0
    for t in range(steps):
        affine(L[t], l[t], x_hats[t], u)
        within(u, low, high)
        step(x_hats[t], u, p, dt, ahead)
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


def line_search(
    steps, states, controls, shift, L, l, p, dt, initial, stage, final, old, smallest, new_states, new_controls
):  # fmt: skip
    """Try steps 1, 1/2, 1/4, ... along the changes of start and controls until the merit falls below `old`.

    The merit is the true cost and what the augmented Lagrangian adds to it. Writes the trajectory. Returns its merit,
    its cost, and the step, which is 0 if none down to `smallest` lowers the merit.
    """
    low, high = stack(M), stack(M)
    limits(stage, low, high)
    fraction = 1.0
    while fraction >= smallest:
        for i in range(N):
            new_states[0, i] = states[0, i] + fraction * shift[i]
        cost, added = initial_value(new_states[0], new_controls[0], 0, initial), 0.0
        for t in range(steps):
            x, u = new_states[t], new_controls[t]
            for i in range(M):
                total = controls[t, i] + fraction * l[t, i]
                for j in range(N):
                    total += L[t, i, j] * (x[j] - states[t, j])
                u[i] = total
            within(u, low, high)
            cost += stage_value(x, u, t, stage)
            added += stage_added(x, u, t, stage)
            step(x, u, p, dt, new_states[t + 1])
        cost += final_value(new_states[steps], new_controls[steps - 1], steps, final)
        added += final_added(new_states[steps], new_controls[steps - 1], steps, final)
        if cost + added < old:
            return cost + added, cost, fraction
        fraction *= 0.5
    return old, old, 0.0


def keep_plan(steps, states, controls, plan_x, plan_u):
    """Copy a trajectory."""
    for t in range(steps + 1):
        copy(states[t], N, plan_x[t])
    for t in range(steps):
        copy(controls[t], M, plan_u[t])


def keep_law(steps, L, l, kept_L, kept_l):
    """Copy a policy."""
    for t in range(steps):
        for i in range(M):
            kept_l[t, i] = l[t, i]
            for j in range(N):
                kept_L[t, i, j] = L[t, i, j]


def follow(steps, fraction, plan_x, x_hats):
    """Make of the states that a whole step was to lead to those that a part of it was."""
    if fraction < 1:
        for t in range(steps + 1):
            for i in range(N):
                x_hats[t, i] = plan_x[t, i] + fraction * (x_hats[t, i] - plan_x[t, i])


def about_plan(steps, plan_x, plan_u, L, l):
    """Make the policy relative to the plan: l becomes L x + l - u, the change of the controls that it asks for."""
    u = stack(M)
    for t in range(steps):
        affine(L[t], l[t], plan_x[t], u)
        for i in range(M):
            l[t, i] = u[i] - plan_u[t, i]

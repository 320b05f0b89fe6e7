"""What an iteration of the interior point takes of a problem, and the step that it makes. The kernels' subset.

The plan need not be a motion: where a step leads and where the next state is are apart by a gap, which the iterations
close. `solvers/interior_point.py` has the method.
"""

from lqrsim.kernels.cost_to_go import minimize_control
from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import cholesky, cholesky_solve, congruence
from lqrsim.kernels.model_functions import (
    USES_CONTROL,
    advance,
    cost_of_order,
    cost_quadratic,
    cost_value,
    slope_of_constraint,
    step_jacobian,
    step_second_order,
)

TINY = 1e-9  # what is left of a control's own curvature when that is as good as none
STEP = 6e-6  # of differences of slopes, relative to a number and at least 1: the cube root of rounding


def stage_models(t, steps, second, plan, costates, model, rows, out):
    """Write those of a stage, but for the constraints' slopes, which `slopes` has written. Return its cost."""
    none = stack(M)
    for i in range(M):
        none[i] = 0.0
    x, u = plan.states[t], plan.controls[min(t, steps - 1)]
    if t < steps:
        total = cost_of_order(x, u, t, model.stage, 1.0, out.hessian[t], out.gradient[t])
        if second == 1:
            step_second_order(x, u, model, costates[t + 1], out.arrived[t], out.jacobian[t], out.hessian[t])
        else:
            step_jacobian(x, u, model, model.dt, out.arrived[t], out.jacobian[t])
    else:
        total = cost_of_order(x, none, t, model.final, 1.0, out.hessian[t], out.gradient[t])
    if second == 1:
        curvatures(x, u, t, steps, model.stage.constraints, rows, out.hessian[t])
    return total


def convex_models(steps, soft, plan, model, out):
    """Write the projected Hessians of the cost at a plan."""
    gradient, none, hessian = stack(W), stack(M), stack(W, W)
    for i in range(M):
        none[i] = 0.0
    for t in range(steps):
        cost_quadratic(plan.states[t], plan.controls[t], t, model.stage, out.convex[t], gradient)
    cost_quadratic(plan.states[steps], none, steps, model.final, out.convex[steps], gradient)
    if soft == 1:
        cost_quadratic(plan.states[0], none, 0, model.initial, hessian, gradient)
        for i in range(N):
            for j in range(N):
                out.convex[0, i, j] += hessian[i, j]


def add_initial(x, model, out):
    """Add the initial cost to the first stage; return its value."""
    hessian, gradient, none = stack(W, W), stack(W), stack(M)
    for i in range(M):
        none[i] = 0.0
    cost = cost_of_order(x, none, 0, model.initial, 1.0, hessian, gradient)
    for i in range(N):
        out.gradient[0, i] += gradient[i]
        for j in range(N):
            out.hessian[0, i, j] += hessian[i, j]
    return cost


def constraint_slopes(steps, plan, constraints, rows, out):
    """Write the slopes of all constraints at all steps, and which entries they depend on."""
    slope = stack(W)
    for t in range(steps + 1):
        x, u = plan.states[t], plan.controls[min(t, steps - 1)]
        for k in range(constraints.size):
            acts = acts_at(k, t, steps, constraints)
            for row in range(int(constraints.multipliers[k][1])):
                place = int(rows.first[k]) + row
                for i in range(W):
                    slope[i] = 0.0
                if acts:
                    slope_of_constraint(k, row, x, u, t, constraints, slope)
                for i in range(W):
                    out.slopes[rows.size * t + place, i] = slope[i]
                    if slope[i] != 0:
                        rows.support[place, i] = 1.0


def acts_at(k, t, steps, constraints):
    """Whether a constraint acts at a step."""
    return t >= constraints.multipliers[k][2] and not (t == steps and constraints.functions[k, USES_CONTROL] != 0)


def curvatures(x, u, t, steps, constraints, rows, hessian):
    """Subtract the Hessians of all constraints at a step times their multipliers."""
    for k in range(constraints.size):
        if not acts_at(k, t, steps, constraints):
            continue
        for row in range(int(constraints.multipliers[k][1])):
            if abs(rows.multipliers[rows.size * t + int(rows.first[k]) + row]) > rows.least:
                subtract_curvature(k, row, x, u, t, constraints, rows, hessian)


def subtract_curvature(k, row, x, u, t, constraints, rows, hessian):
    """Subtract the Hessian of one of a constraint's numbers times its multiplier: differences of its slope."""
    place = int(rows.first[k]) + row
    weight = rows.multipliers[rows.size * t + place]
    y, v, ahead, behind = stack(N), stack(M), stack(W), stack(W)
    for i in range(N):
        y[i] = x[i]
    for i in range(M):
        v[i] = u[i]
    for j in range(W):
        if rows.support[place, j] == 0:
            continue
        z = x[j] if j < N else u[j - N]
        far = STEP * max(1.0, abs(z))
        for i in range(W):
            ahead[i], behind[i] = 0.0, 0.0
        set_entry(y, v, j, z + far)
        slope_of_constraint(k, row, y, v, t, constraints, ahead)
        set_entry(y, v, j, z - far)
        slope_of_constraint(k, row, y, v, t, constraints, behind)
        set_entry(y, v, j, z)
        for i in range(W):
            half = 0.5 * weight * (ahead[i] - behind[i]) / (2 * far)
            hessian[i, j] -= half
            hessian[j, i] -= half


def set_entry(y, v, j, number):
    """Write one entry of a state and a control, joined."""
    if j < N:
        y[j] = number
    else:
        v[j - N] = number


def trial_cost(steps, soft, plan, model, arrived):
    """The cost of a plan; writes where each of its steps leads, (T, N)."""
    for t in range(steps):
        advance(plan.states[t], plan.controls[t], model, model.dt, arrived[t])
    return cost_of_plan(steps, soft, plan, model)


def cost_of_plan(steps, soft, plan, model):
    """The cost of a plan."""
    none = stack(M)
    for i in range(M):
        none[i] = 0.0
    total = cost_value(plan.states[0], none, 0, model.initial) if soft == 1 else 0.0
    for t in range(steps):
        total += cost_value(plan.states[t], plan.controls[t], t, model.stage)
    return total + cost_value(plan.states[steps], none, steps, model.final)


def adjoint(steps, gradient, jacobian, costates, slopes):
    """The costates (T+1, N) of a sum of stages with these gradients (T+1, W), and its slopes in the controls (T, M)."""
    for i in range(N):
        costates[steps, i] = gradient[steps, i]
    for t in range(steps - 1, -1, -1):
        for j in range(W):
            total = gradient[t, j]
            for i in range(N):
                total += jacobian[t, i, j] * costates[t + 1, i]
            if j < N:
                costates[t, j] = total
            else:
                slopes[t, j - N] = total


def terminal_cost_to_go(steps, stage, slope, to_go):
    """Write the cost-to-go at the end."""
    for i in range(N):
        to_go.gradient[steps, i] = slope[i]
        for j in range(N):
            to_go.hessian[steps, i, j] = stage[i, j]


def riccati_step(t, stage, slope, jacobian, gap, policy, to_go):
    """A step of the Riccati recursion, from t + 1 to t, with the gap closed; uses up the stage.

    Args:
      policy: gets the gains, and the changes of controls where states do not change. to_go: gets the cost-to-go of
        changes.

    Returns:
      Whether the control block is positive definite.
    """
    ahead, least = stack(N), stack(M)
    for i in range(M):
        least[i] = TINY * abs(stage[N + i, N + i])
    for i in range(N):
        ahead[i] = to_go.gradient[t + 1, i]
        for j in range(N):
            ahead[i] += to_go.hessian[t + 1, i, j] * gap[j]
    congruence(jacobian, to_go.hessian[t + 1], ahead, stage, slope)
    if not control_block_definite(stage, least):
        return False
    return minimize_control(stage, slope, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]) >= 0


def forward_sweep(steps, free, jacobian, gaps, policy, to_go, changes):
    """Write the changes of the plan that a policy makes, and as gradients of the cost-to-go the costates where they
    forward_sweep; whether the start's have a minimum. `free` (N,) is 0 for the states that the start fixes.
    """
    if not start_change(free, to_go, changes.states[0]):
        return False
    for t in range(steps):
        for i in range(M):
            total = policy.offset[t, i]
            for j in range(N):
                total += policy.gain[t, i, j] * changes.states[t, j]
            changes.controls[t, i] = total
        for i in range(N):
            total = gaps[t, i]
            for j in range(N):
                total += jacobian[t, i, j] * changes.states[t, j]
            for j in range(M):
                total += jacobian[t, i, N + j] * changes.controls[t, j]
            changes.states[t + 1, i] = total
    for t in range(steps + 1):
        for i in range(N):
            for j in range(N):
                to_go.gradient[t, i] += to_go.hessian[t, i, j] * changes.states[t, j]
    return True


def start_change(free, to_go, change):
    """Write by how much the start moves, (N,); whether that has a minimum. What is fixed does not move."""
    curve = stack(N, N)
    for i in range(N):
        change[i] = -to_go.gradient[0, i] * free[i]
        for j in range(N):
            curve[i, j] = to_go.hessian[0, i, j] * free[i] * free[j]
        if free[i] == 0:
            curve[i, i] = 1.0
    good = cholesky(curve, N)
    cholesky_solve(curve, N, change)
    return good


def control_block_definite(stage, least):
    """Whether a control block is positive definite when so much is subtracted from its diagonal, (M,)."""
    block = stack(M, M)
    for i in range(M):
        for j in range(M):
            block[i, j] = stage[N + i, N + j]
        block[i, i] -= least[i]
    return cholesky(block, M)


def closed_loop_rollout(steps, part, plan, policy, limits, model, out):
    """The motion that a part of a step leads to, its gains closing the loop; writes states and controls.

    Args:
      plan: a motion. policy: gains, and changes of controls where states do not change, as `riccati_step` writes them.
      limits: what the controls are held between, at each step, (T, M) each. out: gets the motion.
    """
    for i in range(N):
        out.states[0, i] = plan.states[0, i]
    for t in range(steps):
        for i in range(M):
            total = plan.controls[t, i] + part * policy.offset[t, i]
            for j in range(N):
                total += policy.gain[t, i, j] * (out.states[t, j] - plan.states[t, j])
            out.controls[t, i] = min(max(total, limits.low[t, i]), limits.high[t, i])
        advance(out.states[t], out.controls[t], model, model.dt, out.states[t + 1])

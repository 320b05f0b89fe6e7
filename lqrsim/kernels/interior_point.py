"""The evaluations of an interior-point iteration, and its step. Written in the kernels' subset.

The plan need not satisfy the dynamics. The gap between the end of a step and the next state is closed by the
iterations. `solvers/interior_point.py` describes the method.
"""

from lqrsim.kernels.cost_to_go import add_cost_to_go, minimize_control
from lqrsim.kernels.declarations import FIRST, ROWS, M, N, W, stack, zeros
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    copy,
    entry,
    fill,
    set_entry,
)
from lqrsim.kernels.model_functions import (
    USES_CONTROL,
    advance,
    cost_of_order,
    cost_quadratic,
    cost_value,
    slope_of_constraint,
    step_second_order,
)
from lqrsim.kernels.records import LinearStep, QuadraticStage

TINY = 1e-12  # least curvature that a control block must have, relative to the control's own
STEP = 6e-6  # step for differences of gradients, relative to a number or to 1: the cube root of the precision


def stage_models(t, steps, plan, costates, model, rows, out):
    """Write the models of cost, step and constraints at t; return the cost.

    Args:
      costates: (T+1, N). rows: ConstraintRows.
      out: StageModels; it contains the constraints' gradients from `constraint_slopes`.
    """
    none = zeros(M)
    x, u = plan.states[t], plan.controls[min(t, steps - 1)]
    if t < steps:
        total = cost_of_order(x, u, t, model.stage, 1.0, out.hessian[t], out.gradient[t])
        step_second_order(x, u, model, costates[t + 1], out.arrived[t], out.jacobian[t], out.hessian[t])
    else:
        total = cost_of_order(x, none, t, model.final, 1.0, out.hessian[t], out.gradient[t])
    subtract_curvatures(x, u, t, steps, model.stage.constraints, rows, out.hessian[t])
    return total


def convex_models(steps, soft, plan, model, out):
    """Write the projected Hessians (T+1, W, W) of the cost at a plan; `soft` is 1 if there is an initial cost."""
    gradient, none, hessian = stack(W), zeros(M), stack(W, W)
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
    hessian, gradient, none = stack(W, W), stack(W), zeros(M)
    cost = cost_of_order(x, none, 0, model.initial, 1.0, hessian, gradient)
    for i in range(N):
        out.gradient[0, i] += gradient[i]
        for j in range(N):
            out.hessian[0, i, j] += hessian[i, j]
    return cost


def constraint_slopes(steps, plan, constraints, rows, out):
    """Write the gradients ((T+1) size, W) of all constraints, and the entries that they depend on."""
    for t in range(steps + 1):
        x, u = plan.states[t], plan.controls[min(t, steps - 1)]
        for k in range(constraints.size):
            acts = acts_at(k, t, steps, constraints)
            for row in range(int(constraints.multipliers[k][ROWS])):
                place = int(rows.first[k]) + row
                slope = out.slopes[rows.size * t + place]
                fill(slope, W, 0.0)
                if acts:
                    slope_of_constraint(k, row, x, u, t, constraints, slope)
                for i in range(W):
                    if slope[i] != 0:
                        rows.support[place, i] = 1.0


def acts_at(k, t, steps, constraints):
    """Whether constraint k acts at a step."""
    return t >= constraints.multipliers[k][FIRST] and not (t == steps and constraints.functions[k, USES_CONTROL] != 0)


def subtract_curvatures(x, u, t, steps, constraints, rows, hessian):
    """Subtract from a Hessian (W, W) the Hessians of all constraints at a step, times their multipliers."""
    for k in range(constraints.size):
        if not acts_at(k, t, steps, constraints):
            continue
        for row in range(int(constraints.multipliers[k][ROWS])):
            if abs(rows.multipliers[rows.size * t + int(rows.first[k]) + row]) > rows.least:
                subtract_curvature(k, row, x, u, t, constraints, rows, hessian)


def subtract_curvature(k, row, x, u, t, constraints, rows, hessian):
    """Subtract the Hessian of one value of a constraint times its multiplier, by differences of its gradient."""
    place = int(rows.first[k]) + row
    weight = rows.multipliers[rows.size * t + place]
    y, v, above, below = stack(N), stack(M), stack(W), stack(W)
    copy(x, N, y)
    copy(u, M, v)
    for j in range(W):
        if rows.support[place, j] == 0:
            continue
        z = entry(x, u, j)
        far = STEP * max(1.0, abs(z))
        fill(above, W, 0.0)
        fill(below, W, 0.0)
        set_entry(y, v, j, z + far)
        slope_of_constraint(k, row, y, v, t, constraints, above)
        set_entry(y, v, j, z - far)
        slope_of_constraint(k, row, y, v, t, constraints, below)
        set_entry(y, v, j, z)
        for i in range(W):
            half = 0.5 * weight * (above[i] - below[i]) / (2 * far)
            hessian[i, j] -= half
            hessian[j, i] -= half


def trial_cost(steps, soft, plan, model, arrived):
    """Write the state after each step of a plan, (T, N), and return the plan's cost."""
    for t in range(steps):
        advance(plan.states[t], plan.controls[t], model, model.dt, arrived[t])
    return cost_of_plan(steps, soft, plan, model)


def cost_of_plan(steps, soft, plan, model):
    """The cost of a plan; `soft` is 1 if there is an initial cost."""
    none = zeros(M)
    total = cost_value(plan.states[0], none, 0, model.initial) if soft == 1 else 0.0
    for t in range(steps):
        total += cost_value(plan.states[t], plan.controls[t], t, model.stage)
    return total + cost_value(plan.states[steps], none, steps, model.final)


def adjoint(steps, gradient, jacobian, costates, slopes):
    """Write the costates (T+1, N) and the gradient in the controls (T, M) of a sum of stages.

    Args:
      gradient: (T+1, W) of the stages. jacobian: (T, N, W) of the steps.
    """
    copy(gradient[steps], N, costates[steps])
    for t in range(steps - 1, -1, -1):
        for j in range(W):
            total = gradient[t, j]
            for i in range(N):
                total += jacobian[t, i, j] * costates[t + 1, i]
            set_entry(costates[t], slopes[t], j, total)


def riccati_step(t, stage, slope, jacobian, gap, policy, to_go):
    """Write gains and cost-to-go at t, given the cost-to-go at t + 1, so that the gap closes.

    Args:
      stage: (W, W) and slope: (W,) of the model at the plan; overwritten. jacobian: (N, W). gap: (N,).
      policy: its offsets are the changes of the controls for an unchanged state. to_go: the cost-to-go of changes of
        the state.

    Returns:
      Whether the control block is positive definite.
    """
    least = stack(M)
    for i in range(M):
        least[i] = TINY * abs(stage[N + i, N + i])
    add_cost_to_go(t, LinearStep(jacobian, gap), QuadraticStage(stage, slope), 0.0, to_go)
    if not control_block_definite(stage, least):
        return False
    return minimize_control(stage, slope, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]) >= 0


def forward_sweep(steps, free, jacobian, gaps, policy, to_go, changes):
    """Write the changes of the plan that a policy makes, and the costates after them, as gradients of the cost-to-go.

    Args:
      free: (N,) 0 for the states that the start fixes, else 1. jacobian: (T, N, W). gaps: (T, N). changes: Motion.

    Returns:
      Whether the change of the start has a minimum.
    """
    if not start_change(free, to_go, changes.states[0]):
        return False
    for t in range(steps):
        affine(policy.gain[t], policy.offset[t], changes.states[t], M, N, changes.controls[t])
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
    """Write the best change of the start, (N,), zero where it is fixed; return whether it has a minimum."""
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
    """Whether the control block of a stage (W, W) minus a diagonal (M,) is positive definite."""
    block = stack(M, M)
    for i in range(M):
        for j in range(M):
            block[i, j] = stage[N + i, N + j]
        block[i, i] -= least[i]
    return cholesky(block, M)


def closed_loop_rollout(steps, part, plan, policy, limits, model, out):
    """Roll out a fraction of a step from a trajectory, with its gains closing the loop.

    Args:
      part: the fraction. plan: a Motion that satisfies the dynamics. policy: as `riccati_step` writes it.
      limits: limits of the controls at each step, (T, M) each. out: Motion, written.
    """
    copy(plan.states[0], N, out.states[0])
    for t in range(steps):
        for i in range(M):
            total = plan.controls[t, i] + part * policy.offset[t, i]
            for j in range(N):
                total += policy.gain[t, i, j] * (out.states[t, j] - plan.states[t, j])
            out.controls[t, i] = min(max(total, limits.low[t, i]), limits.high[t, i])
        advance(out.states[t], out.controls[t], model, model.dt, out.states[t + 1])

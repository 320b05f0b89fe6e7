"""Models of all stages of a plan, and the step to their minimum, with or without an active set.

Written in the kernels' subset.

The plan need not satisfy the dynamics. The gap between the end of a step and the next state is closed by the
iterations. The rows are those of all constraints, then the limits of the controls. An active set fixes some of them at
zero. `solvers/interior_point.py`, `solvers/active_set.py` and `solvers/restoration.py` describe the methods.
"""

from math import inf

from lqrsim.kernels.certificate import reduce_stage
from lqrsim.kernels.cost_to_go import add_cost_to_go, minimize_control
from lqrsim.kernels.declarations import FIRST, ROWS, M, N, W, stack, zeros
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    congruence,
    copy,
    copy_matrix,
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
    evaluate_constraints,
    slope_of_constraint,
    step_second_order,
)
from lqrsim.kernels.records import LinearStep, QuadraticStage
from lqrsim.kernels.rollouts import larger

TINY = 1e-12  # least curvature that a control block must have, relative to the control's own
STEP = 6e-6  # step for differences of gradients, relative to a number or to 1: the cube root of the precision

# Columns of `ActiveRows.table`: the kind of a row; its typical size; its target value in the active set; and for a
# limit, the control, 1 for a lower or -1 for an upper limit, and its value.
KIND, SIZE, AIM, CONTROL, SIGN, SIDE = 0, 1, 2, 3, 4, 5
INEQUALITY, LIMIT, EQUALITY = 0, 1, 2
ROUNDING = 1e-10  # allowed violation by a model, relative to a row's size


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


def least_curvatures(steps, free, hessian, jacobian, held, least):
    """Write the least curvatures (M,) of the controls along a plan, while later controls respond at their best.

    Args:
      free: (N,) 0 for the states that the start fixes, else 1. hessian: (T+1, W, W) of the Lagrangian, with weights on
      rows that are held. jacobian: (T, N, W). held: (T, M), not 0 for a control that stays at its limit.

    Returns:
      Whether the reduced Hessian is positive definite.
    """
    S, stage, none = stack(N, N), stack(W, W), zeros(W)
    copy_matrix(hessian[steps], N, N, S)
    fill(least, M, inf)
    for t in range(steps - 1, -1, -1):
        copy_matrix(hessian[t], W, W, stage)
        congruence(jacobian[t], S, none, stage, zeros(W))
        for i in range(M):
            if held[t, i] != 0:
                for j in range(W):
                    stage[N + i, j], stage[j, N + i] = 0.0, 0.0
                stage[N + i, N + i] = inf
        if not reduce_stage(stage, least, S):
            return False
    for i in range(N):
        for j in range(N):
            S[i, j] *= free[i] * free[j]
        if free[i] == 0:
            S[i, i] = 1.0
    return cholesky(S, N)


# With an active set.


def linearize_plan(steps, soft, own, plan, costates, model, values, rows, out, active):
    """Write the models of all stages at a plan, and the values of the active set's rows, if there are any.

    Args:
      soft: 1 if there is an initial cost.
      own: 1 to compute the costates here, for this plan and the forces of its rows. costates: (T+1, N).
      values: a vector for each constraint, written. rows: ConstraintRows. out: StageModels, written.
      active: ActiveRows; rows that do not act leave the active set.

    Returns:
      The cost.
    """
    if active.size > 0:
        evaluate_constraints(steps, plan.states, plan.controls, model.stage.constraints, values)
        read_row_values(steps, plan, model.stage.constraints, values, rows, active)
    constraint_slopes(steps, plan, model.stage.constraints, rows, out)
    total, slope = 0.0, stack(W)
    for t in range(steps, -1, -1):
        total += stage_models(t, steps, plan, costates, model, rows, out)
        if own == 1 and t > 0:
            lagrangian_slope(t, steps, costates[min(t + 1, steps)], out, active, slope)
            copy(slope, N, costates[t])
    if soft == 1:
        total += add_initial(plan.states[0], model, out)
    return total


def read_row_values(steps, plan, constraints, values, rows, active):
    """Write the values of all rows, and remove those that do not act from the active set."""
    for t in range(steps + 1):
        u = plan.controls[min(t, steps - 1)]
        for k in range(constraints.size):
            count = int(constraints.multipliers[k][ROWS])
            for row in range(count):
                active.numbers[active.size * t + int(rows.first[k]) + row] = values[k][count * t + row]
        for row in range(active.size):
            at = active.size * t + row
            if active.table[row, KIND] == LIMIT:
                number = u[int(active.table[row, CONTROL])] - active.table[row, SIDE]
                active.numbers[at] = active.table[row, SIGN] * number
            if active.numbers[at] == inf:  # the constraint does not act
                active.live[at] = 0.0
            if active.live[at] == 0:
                active.force[at], active.held[at] = 0.0, 0.0


def lagrangian_slope(t, steps, after, models, active, slope):
    """Write the gradient (W,) of the Lagrangian in state and control at t, given the costate (N,) at t + 1."""
    copy(models.gradient[t], W, slope)
    if t < steps:
        for j in range(N):
            for i in range(W):
                slope[i] += models.jacobian[t, j, i] * after[j]
    for row in range(active.size):
        at = active.size * t + row
        if active.force[at] != 0:
            for i in range(W):
                slope[i] -= active.force[at] * models.slopes[at, i]


def optimality_measures(steps, plan, models, gaps, active, state_size, control_size):
    """Measure the optimality of a plan; write its gaps (T, N).

    Args:
      models: StageModels. active: ActiveRows. state_size: (N,) and control_size: (M,), typical sizes.

    Returns:
      The largest derivative of the Lagrangian in a control, times its size; the largest violation of an inequality,
      negative if all are satisfied; the largest violation of an equality; the largest gap, relative to the state's
      size; and the largest product of a multiplier and its row's value.
    """
    slope, after = stack(W), stack(N)
    steepest, missed, unequal, widest, product = 0.0, -inf, 0.0, 0.0, 0.0
    for t in range(steps, -1, -1):
        lagrangian_slope(t, steps, after, models, active, slope)
        copy(slope, N, after)
        if t < steps:
            for i in range(M):
                steepest = larger(steepest, abs(slope[N + i]) * control_size[i])
            for i in range(N):
                gaps[t, i] = models.arrived[t, i] - plan.states[t + 1, i]
                widest = larger(widest, abs(gaps[t, i]) / state_size[i])
        for row in range(active.size):
            at = active.size * t + row
            if active.live[at] == 0:
                continue
            number = active.numbers[at]
            if active.table[row, KIND] == EQUALITY:
                unequal = larger(unequal, abs(number))
            else:
                missed = larger(missed, -number)
                product = larger(product, abs(number) * active.force[at])
    return steepest, missed, unequal, widest, product


def pivot(steps, free, share, scale, weight, price, models, gaps, active, policy, to_go, changes):
    """The step to the minimum of the stages' models with the active set fixed, and the rows that are wrong there.

    Args:
      free: (N,) 0 for the states that the start fixes, else 1. share: fraction of the projected Hessian of the cost.
      scale: the cost to which multipliers are relative.
      weight: weight on the distance of a fixed row from its target, relative to its size; times `price` for
        constraints.
      models: StageModels. gaps: (T, N). active: ActiveRows, written.
      policy, to_go: as in `riccati_step`; gradients become the costates after the step. changes: Motion, written.

    Returns:
      The step whose control block is not positive definite (T + 1 for the start, -1 for none), and the number of rows
      with the wrong state.
    """
    stage, slope = stack(W, W), stack(W)
    for t in range(steps, -1, -1):
        copy(models.gradient[t], W, slope)
        blend(share, models.hessian[t], models.convex[t], stage)
        add_held_rows(t, weight, price, models, active, stage, slope)
        if t == steps:
            copy(slope, N, to_go.gradient[steps])
            copy_matrix(stage, N, N, to_go.hessian[steps])
        elif not riccati_step(t, stage, slope, models.jacobian[t], gaps[t], policy, to_go):
            return t, 0
    if not forward_sweep(steps, free, models.jacobian, gaps, policy, to_go, changes):
        return steps + 1, 0
    return -1, predict_rows(steps, scale, weight, price, models, active, changes)


def blend(share, one, other, out):
    """Write (1 - share) one + share other, (W, W)."""
    for i in range(W):
        for j in range(W):
            if share == 0:
                out[i, j] = one[i, j]
            elif share == 1:
                out[i, j] = other[i, j]
            else:
                out[i, j] = (1 - share) * one[i, j] + share * other[i, j]


def add_held_rows(t, weight, price, models, active, stage, slope):
    """Add the penalties of the fixed rows at a step to its model."""
    for row in range(active.size):
        at = active.size * t + row
        if active.held[at] == 0:
            continue
        own = held_weight(row, weight, price, active)
        pull = own * (active.numbers[at] - active.table[row, AIM]) - active.force[at]
        for i in range(W):
            entry = models.slopes[at, i]
            if entry != 0:
                slope[i] += pull * entry
                for j in range(W):
                    stage[i, j] += own * entry * models.slopes[at, j]


def held_weight(row, weight, price, active):
    """The penalty on a fixed row."""
    size = active.table[row, SIZE]
    return (weight if active.table[row, KIND] == LIMIT else price * weight) / (size * size)


def predict_rows(steps, scale, weight, price, models, active, changes):
    """Write the multipliers after a step, and which rows are wrong there; return the number of wrong rows."""
    count = 0
    for t in range(steps + 1):
        for row in range(active.size):
            at = active.size * t + row
            active.pressing[at], active.wrong[at] = 0.0, 0.0
            if active.live[at] == 0:
                continue
            size, ahead = active.table[row, SIZE], active.numbers[at] - active.table[row, AIM]
            for i in range(N):
                ahead += models.slopes[at, i] * changes.states[t, i]
            if t < steps:
                for i in range(M):
                    ahead += models.slopes[at, N + i] * changes.controls[t, i]
            if active.held[at] != 0:
                active.pressing[at] = active.force[at] - held_weight(row, weight, price, active) * ahead
                missed = 0.0 if active.table[row, KIND] == EQUALITY else active.pressing[at] * size / scale
            else:
                missed = ahead / size
            if missed < -ROUNDING:
                active.wrong[at] = missed
                count += 1
    return count


def update_active_set(steps, worst, active):
    """Add violated rows to the active set, and remove rows with a negative multiplier.

    Args:
      worst: 1 for all rows that are worse than at the neighbouring steps; 0 for the last wrong row alone.
    """
    last = -1
    for row in range(active.size):
        before, was_held = 0.0, 0.0
        for t in range(steps + 1):
            at = active.size * t + row
            here, held = active.wrong[at], active.held[at]
            if here < 0:
                last = max(last, at)
                after = at + active.size
                no_worse_before = was_held != held or here <= before
                worse_after = t == steps or active.held[after] != held or here < active.wrong[after]
                if worst == 1 and no_worse_before and worse_after:
                    active.held[at] = 1 - held
            before, was_held = here, held
    if worst == 0 and last >= 0:
        active.held[last] = 1 - active.held[last]


def rollout_of_active_set(steps, soft, plan, policy, limits, active, model, values, out):
    """Roll out a policy about a plan, and evaluate the constraints there; return the cost.

    Args:
      soft: 1 if there is an initial cost. plan: its controls are clamped, and set to the limits that are fixed.
      policy: its offsets are set to zero, and so are its gains at limits. limits: (T, M) each.
      values: a vector for each constraint, written. out: Motion, written.
    """
    for t in range(steps):
        for i in range(M):
            policy.offset[t, i] = 0.0
            plan.controls[t, i] = min(max(plan.controls[t, i], limits.low[t, i]), limits.high[t, i])
        for row in range(active.size):
            if active.table[row, KIND] == LIMIT and active.held[active.size * t + row] != 0:
                i = int(active.table[row, CONTROL])
                plan.controls[t, i] = active.table[row, SIDE]
                fill(policy.gain[t, i], N, 0.0)
    closed_loop_rollout(steps, 0.0, plan, policy, limits, model, out)
    evaluate_constraints(steps, out.states, out.controls, model.stage.constraints, values)
    return cost_of_plan(steps, soft, out, model)

"""The evaluations of an iteration with an active set, and its pivots. Written in the kernels' subset.

The rows are the rows of all constraints, then the limits of the controls. The active set fixes some of them at zero.
`solvers/active_set.py` describes the method.
"""

from math import inf

from lqrsim.kernels.declarations import ROWS, M, N, W, stack
from lqrsim.kernels.interior_point import (
    add_initial,
    closed_loop_rollout,
    constraint_slopes,
    cost_of_plan,
    forward_sweep,
    riccati_step,
    stage_models,
)
from lqrsim.kernels.linear_algebra import copy, copy_matrix, fill
from lqrsim.kernels.model_functions import evaluate_constraints
from lqrsim.kernels.rollouts import larger

# Columns of `ActiveRows.table`: the kind of a row; its typical size; its target value in the active set; and for a
# limit, the control, 1 for a lower or -1 for an upper limit, and its value.
KIND, SIZE, AIM, CONTROL, SIGN, SIDE = 0, 1, 2, 3, 4, 5
INEQUALITY, LIMIT, EQUALITY = 0, 1, 2
ROUNDING = 1e-10  # allowed violation by a model, relative to a row's size


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

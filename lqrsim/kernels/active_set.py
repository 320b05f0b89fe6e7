"""The step to the minimum of the stages' models with some rows fixed at zero, and the rows that are wrong there.

Written in the kernels' subset. `solvers/active_set.py` describes the method.
"""

from math import inf

from lqrsim.kernels.declarations import M, N
from lqrsim.kernels.linear_algebra import fill
from lqrsim.kernels.model_functions import evaluate_constraints
from lqrsim.kernels.stages import (
    AIM,
    CONTROL,
    EQUALITY,
    KIND,
    LIMIT,
    SIDE,
    SIZE,
    closed_loop_rollout,
    cost_of_plan,
    direction,
    look,
    look_with_own_costates,
    moved,
    read_rows,
)

ROUNDING = 1e-10  # allowed violation by a model, relative to a row's size


def begin_active_set(stages, plan, costates):
    """Write the models about a plan, its costates and its rows' values; return its cost.

    Rows that do not act at a step leave the active set.
    """
    read_rows(stages, plan, stages.rows.numbers)
    leave(stages)
    return look_with_own_costates(stages, plan, costates)


def look_at_rows(stages, plan, costates):
    """Write the models about a plan with these costates, and its rows' values; return its cost."""
    read_rows(stages, plan, stages.rows.numbers)
    leave(stages)
    return look(stages, plan, costates, 0.0)


def leave(stages):
    """Remove rows that do not act from the active set."""
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        if rows.numbers[at] == inf:
            rows.live[at] = 0.0
        if rows.live[at] == 0:
            rows.force[at], rows.held[at] = 0.0, 0.0


def pivot(stages, plan, gaps, share, scale, weight, price, work):
    """The step to the minimum of the models with the active set fixed, and the rows that are wrong there.

    Args:
      stages, plan, gaps, share: as in `direction`.
      scale: the cost to which multipliers are relative.
      weight: weight on the distance of a fixed row from its target, relative to its size; times `price` for
        constraints.
      work: RowWork.

    Returns:
      The step whose control block is not positive definite (T + 1 for the start, -1 for none), and the number of rows
      with the wrong state.
    """
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        work.curves[at], work.forces[at] = 0.0, 0.0
        if rows.held[at] != 0:
            row = at % rows.size
            work.curves[at] = held_weight(row, weight, price, rows)
            work.forces[at] = rows.force[at] - work.curves[at] * (rows.numbers[at] - rows.table[row, AIM])
    failed = direction(stages, plan, gaps, share, 0.0, 1.0, work.curves, work.forces)
    return failed, predict_rows(stages, scale, work) if failed == -1 else 0


def held_weight(row, weight, price, rows):
    """The penalty on a fixed row."""
    size = rows.table[row, SIZE]
    return (weight if rows.table[row, KIND] == LIMIT else price * weight) / (size * size)


def predict_rows(stages, scale, work):
    """Write the multipliers after a step, and which rows are wrong there; return the number of wrong rows."""
    rows, count = stages.rows, 0
    for t in range(stages.steps + 1):
        for row in range(rows.size):
            at = rows.size * t + row
            work.pressing[at], work.wrong[at] = 0.0, 0.0
            if rows.live[at] == 0:
                continue
            size, ahead = rows.table[row, SIZE], rows.numbers[at] - rows.table[row, AIM] + moved(t, row, stages)
            if rows.held[at] != 0:
                work.pressing[at] = rows.force[at] - work.curves[at] * ahead
                missed = 0.0 if rows.table[row, KIND] == EQUALITY else work.pressing[at] * size / scale
            else:
                missed = ahead / size
            if missed < -ROUNDING:
                work.wrong[at] = missed
                count += 1
    return count


def update_active_set(stages, worst, work):
    """Add violated rows to the active set, and remove rows with a negative multiplier.

    Args:
      worst: 1 for all rows that are worse than at the neighbouring steps; 0 for the last wrong row alone.
    """
    rows, last = stages.rows, -1
    for row in range(rows.size):
        before, was_held = 0.0, 0.0
        for t in range(stages.steps + 1):
            at = rows.size * t + row
            here, held = work.wrong[at], rows.held[at]
            if here < 0:
                last = max(last, at)
                after = at + rows.size
                no_worse_before = was_held != held or here <= before
                worse_after = t == stages.steps or rows.held[after] != held or here < work.wrong[after]
                if worst == 1 and no_worse_before and worse_after:
                    rows.held[at] = 1 - held
            before, was_held = here, held
    if worst == 0 and last >= 0:
        rows.held[last] = 1 - rows.held[last]


def rollout_of_active_set(stages, plan, limits, out):
    """Roll out the policy about a plan, and evaluate the constraints there; return the cost.

    Args:
      plan: its controls are clamped, and set to the limits that are fixed. The policy's offsets are set to zero, and so
        are its gains at limits.
      limits: (T, M) each. out: Motion, written.
    """
    rows, policy = stages.rows, stages.policy
    for t in range(stages.steps):
        for i in range(M):
            policy.offset[t, i] = 0.0
            plan.controls[t, i] = min(max(plan.controls[t, i], limits.low[t, i]), limits.high[t, i])
        for row in range(rows.size):
            if rows.table[row, KIND] == LIMIT and rows.held[rows.size * t + row] != 0:
                i = int(rows.table[row, CONTROL])
                plan.controls[t, i] = rows.table[row, SIDE]
                fill(policy.gain[t, i], N, 0.0)
    closed_loop_rollout(stages.steps, 0.0, plan, policy, limits, stages.model, out)
    evaluate_constraints(stages.steps, out.states, out.controls, stages.model.stage.constraints, stages.values)
    return cost_of_plan(stages, out)

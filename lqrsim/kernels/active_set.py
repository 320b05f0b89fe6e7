"""Newton steps with an active set, to a nearby constrained optimum: after a small change of a problem, or a barrier.

Each step solves the quadratic problem of second-order models about the plan, with linearised dynamics and constraints;
gaps between the steps of the plan close on the way. Most active rows are known, and are held at their targets. Pivoting
finds the others: rows with a multiplier of the wrong sign are released, and violated rows are held. Of neighbouring
steps only the worst row is held, because holding it usually satisfies them all. If the number of wrong rows does not
decrease, rows change one at a time, which terminates for convex models.

Second-order models have a minimum only if the right rows are held. If the known rows are not enough, convex models
choose the rows first. The step itself uses the largest fraction of the second-order terms with which a minimum exists.

A row whose price is too low to keep it does not press more than its price: it stays violated.
"""

from math import copysign, inf, isfinite, nan

from lqrsim.kernels.declarations import CONVERGED, RUNNING, STALLED, M, N, inline
from lqrsim.kernels.linear_algebra import copy, copy_matrix, fill
from lqrsim.kernels.model_functions import cost_of_plan, evaluate_constraints
from lqrsim.kernels.passes import larger
from lqrsim.kernels.stages import (
    CONTROL,
    EQUALITY,
    LIMIT,
    SIDE,
    closed_loop_rollout,
    direction,
    plan_residuals,
    read_rows,
    regularised_direction,
    row_change,
    typical_sizes,
    write_models,
)

COMPACT = 1  # all functions but those that are inline

# What rows do: nothing, stay at their targets, or, at a price, stay violated.
FREE, HELD, PAID = 0.0, 1.0, 2.0
SOFTNESS = 1e-8  # inverse of the weight that holds a row, relative to the cost of a change by its size
FIRMNESS = 8.0  # the same weight for the gains of a policy, which is to keep the constraints without shaking
AT_LIMIT = 1e-9  # distance, relative to its range, at which a control counts as at its limit
ROUNDING = 1e-10  # allowed violation by a model, relative to a row's size
CANCELLED = 1e-6  # least scale, relative to the typical cost of a change: the cost's terms may cancel
# The phases of a step: fractions of the convex models, and largest numbers of pivots. The rows that are known; the rows
# that convex models choose; and these with more and more convex models.
CONVEX_FRACTIONS = (0.0, 1.0, 0.0, 0.3, 1.0)
PIVOTS = (0, 15, 4, 4, 0)
CHOOSING, LAST = 1, 4
PATIENCE = 3  # pivots without fewer wrong rows before rows change one at a time

# Tasks of `active_set`: to begin at a plan; to begin a step; to pivot once; to take the step; and to roll out.
BEGIN, PREPARE, PIVOT, TAKE, ROLL_OUT = 0, 1, 2, 3, 4


def active_set(task, violation, stages, work, memory):
    """Do a part of a step with an active set, so that the caller can end it in time; for PIVOT as `pivot` returns.

    Args:
      task: one of BEGIN, PREPARE, PIVOT, TAKE and ROLL_OUT. violation: tolerance of equalities.
      stages: PlanStages. work: ActiveSetArrays. memory: (1,) row of ACTIVE_SET.
    """
    mem = memory[0]
    if task == PIVOT:
        return pivot(SOFTNESS, stages, work, mem)
    if task == BEGIN:
        begin_active_set(violation, stages, work, mem)
    elif task == PREPARE:
        prepare_step(stages, work, mem)
    elif task == TAKE:
        apply_step(violation, stages, work, mem)
    else:
        roll_out(stages, work, mem)
    return RUNNING


def begin_active_set(violation, stages, work, mem):
    """Compute the models about the plan, its costates, typical sizes and measures; choose the first active set."""
    rows = stages.rows
    copy(rows.acts, rows.size * (stages.steps + 1), rows.live)
    read_rows(stages, work.plan, rows.numbers)
    leave(stages)
    mem.cost = write_models(False, stages, work.plan, work.costates, 0.0)
    mem.typical = typical_sizes(stages, work.plan, stages.models.hessian)
    for at in range(rows.size * (stages.steps + 1)):
        at_limit = rows.kinds[at] == LIMIT and rows.numbers[at] <= AT_LIMIT * rows.sizes[at]
        known = rows.kinds[at] == EQUALITY or rows.force[at] > 0 or at_limit
        rows.held[at] = HELD if known and rows.live[at] != 0 else FREE
    measure_plan(violation, stages, work, mem)


def leave(stages):
    """Remove rows that do not act at a step from the active set."""
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        if rows.numbers[at] == inf:
            rows.live[at] = 0.0
        if rows.live[at] == 0:
            rows.force[at], rows.held[at] = 0.0, FREE


def measure_plan(violation, stages, work, mem):
    """Compute the measures of the plan about which the models are, and whether it keeps the constraints."""
    rows, priced = stages.rows, False
    least = CANCELLED * mem.typical
    mem.scale = max(abs(mem.cost), least) if isfinite(mem.cost) else nan
    steepest, missed, unequal, widest, product = plan_residuals(stages, work.plan, rows.numbers, work.gaps)
    for at in range(rows.size * (stages.steps + 1)):
        priced = priced or rows.prices[at] < inf
    mem.kept = 1.0 if priced or (missed <= 0 and unequal <= violation) else 0.0
    mem.stationarity, mem.gap, mem.complementarity = steepest / mem.scale, widest, product / mem.scale
    mem.violation = larger(larger(missed, unequal), 0.0)


def prepare_step(stages, work, mem):
    """Begin a step: with the rows that are known."""
    copy(stages.rows.held, stages.rows.size * (stages.steps + 1), work.before)
    mem.phase, mem.pivots, mem.fewest, mem.patience = 0.0, 0.0, inf, float(PATIENCE)


def pivot(softness, stages, work, mem):
    """Solve the quadratic problem with the rows that are held; then change rows, or go to the next phase, if need be.

    Returns CONVERGED if the step was found, STALLED if there is none, otherwise RUNNING.
    """
    phase, count = int(mem.phase), stages.rows.size * (stages.steps + 1)
    hold(mem.scale / softness, mem.scale / softness, stages, work)
    failed = direction(stages, work.plan, work.gaps, CONVEX_FRACTIONS[phase], 0.0, 1.0, work.curves, work.forces)
    wrong = predict_rows(mem.scale, stages, work) if failed == -1 else -1
    if wrong > 0 and mem.pivots < PIVOTS[phase]:
        if wrong < mem.fewest:
            mem.fewest, mem.patience = float(wrong), float(PATIENCE)
        else:
            mem.patience -= 1
        change_rows(mem.patience > 0, stages, work)
        mem.pivots += 1
        return RUNNING
    if (wrong == 0 and phase != CHOOSING) or (wrong >= 0 and phase == LAST):
        return CONVERGED
    if phase == CHOOSING:
        copy(stages.rows.held, count, work.chosen)
    if phase == LAST or (wrong < 0 and phase == CHOOSING):
        copy(work.before, count, stages.rows.held)
        return STALLED
    if phase >= CHOOSING:
        copy(work.chosen, count, stages.rows.held)
    mem.phase, mem.pivots, mem.fewest, mem.patience = phase + 1.0, 0.0, inf, float(PATIENCE)
    return RUNNING


def hold(weight, price, stages, work):
    """Write the curvature and the force of each row: `weight` holds limits, `price` constraints; relative to sizes."""
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        work.curves[at], work.forces[at] = 0.0, rows.force[at] if rows.held[at] != FREE else 0.0
        if rows.held[at] == HELD:
            size = rows.sizes[at]
            work.curves[at] = (weight if rows.kinds[at] == LIMIT else price) / (size * size)
            work.forces[at] -= work.curves[at] * (rows.numbers[at] - rows.targets[at])


def predict_rows(scale, stages, work):
    """Write the multipliers after a step, and which rows are wrong there; return the number of wrong rows."""
    rows, count = stages.rows, 0
    for at in range(rows.size * (stages.steps + 1)):
        work.pressing[at], work.wrong[at] = 0.0, 0.0
        if rows.live[at] == 0:
            continue
        size, price, missed, change = rows.sizes[at], rows.prices[at], 0.0, row_change(at, stages)
        if rows.held[at] == HELD:
            force = work.forces[at] - work.curves[at] * change
            work.pressing[at] = force
            if rows.kinds[at] != EQUALITY:
                missed = min(missed, force * size / scale)
            if price < inf:
                missed = min(missed, (price - abs(force)) * size / scale)
        elif rows.held[at] == PAID:
            work.pressing[at] = rows.force[at]
            missed = -(rows.numbers[at] + change) * copysign(1.0, rows.force[at]) / size
        else:
            missed = (rows.numbers[at] - rows.targets[at] + change) / size
        if missed < -ROUNDING:
            work.wrong[at] = missed
            count += 1
    return count


def change_rows(worst, stages, work):
    """Hold rows that are violated, and release or pay for rows with a wrong multiplier.

    Args:
      worst: whether to change all rows that are worse than at the neighbouring steps; else the last wrong row alone.
    """
    rows, last = stages.rows, -1
    for row in range(rows.size):
        before, was_held = 0.0, FREE
        for t in range(stages.steps + 1):
            at = rows.size * t + row
            here, held = work.wrong[at], rows.held[at]
            if here < 0:
                last = max(last, at)
                after = at + rows.size
                no_worse_before = was_held != held or here <= before
                worse_after = t == stages.steps or rows.held[after] != held or here < work.wrong[after]
                if worst and no_worse_before and worse_after:
                    change_row(at, rows, work)
            before, was_held = here, held
    if not worst and last >= 0:
        change_row(last, rows, work)


@inline
def change_row(at, rows, work):
    """Hold a row; or, if it is held, release it or pay for it."""
    if rows.held[at] != HELD:
        rows.held[at] = HELD
    elif abs(work.pressing[at]) > rows.prices[at]:
        rows.held[at] = PAID
        rows.force[at] = copysign(rows.prices[at], work.pressing[at])
    else:
        rows.held[at] = FREE


def apply_step(violation, stages, work, mem):
    """Take the step that pivoting has found; compute the models and measures there."""
    rows, changes = stages.rows, stages.changes
    for at in range(rows.size * (stages.steps + 1)):
        force = work.pressing[at]
        rows.force[at] = force if rows.kinds[at] == EQUALITY else max(force, 0.0)
    copy_matrix(stages.to_go.gradient, stages.steps + 1, N, work.costates)
    for t in range(stages.steps + 1):
        for i in range(N):
            work.plan.states[t, i] += changes.states[t, i]
        if t < stages.steps:
            for i in range(M):
                work.plan.controls[t, i] += changes.controls[t, i]
    read_rows(stages, work.plan, rows.numbers)
    leave(stages)
    mem.cost = write_models(True, stages, work.plan, work.costates, 0.0)
    measure_plan(violation, stages, work, mem)


def roll_out(stages, work, mem):
    """Roll out a policy about the plan into `work.out`, and evaluate the constraints there; write the cost.

    The policy's gains come from a step with a penalty on the active rows; they are zero at limits. Controls are set to
    the limits that are held.
    """
    rows, policy, limits = stages.rows, stages.policy, stages.model.limits
    hold(mem.scale / SOFTNESS, FIRMNESS * mem.scale, stages, work)
    rung = regularised_direction(stages, work.plan, work.gaps, 0.0, mem.scale, work.curves, work.forces)
    for t in range(stages.steps):
        for i in range(M):
            policy.offset[t, i] = 0.0
            work.limits.low[t, i], work.limits.high[t, i] = limits.low[i], limits.high[i]
            work.plan.controls[t, i] = min(max(work.plan.controls[t, i], limits.low[i]), limits.high[i])
            if rung < 0:
                fill(policy.gain[t, i], N, 0.0)
        for row in range(rows.size):
            at = rows.size * t + row
            if rows.kinds[at] == LIMIT and rows.held[at] == HELD:
                i = int(rows.limits[row, CONTROL])
                work.plan.controls[t, i] = rows.limits[row, SIDE]
                fill(policy.gain[t, i], N, 0.0)
    closed_loop_rollout(0.0, work.plan, stages, work.limits, work.out)
    evaluate_constraints(
        stages.steps, work.out.states, work.out.controls, stages.model.stage.constraints, stages.values
    )
    mem.cost = cost_of_plan(stages.steps, work.out, stages.model)

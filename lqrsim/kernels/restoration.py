"""Restoration: descent on an exact penalty, to a plan that violates the constraints least.

A violation costs its size times a price, smoothed by a logarithmic barrier with a decreasing parameter. A separate
barrier keeps controls within their limits. Steps are Newton steps by the Riccati recursion, and are rolled out in
closed loop. Every plan therefore satisfies the dynamics, and each has a lower merit than the previous iterate. Far from
a solution this is more reliable than the interior point, whose states need not satisfy the dynamics. Near a solution it
is slower.

Far from feasibility the penalty is linear in the constraint. It has no curvature, so the minimum of a quadratic model
may be anywhere. Two things are added: the curvature of the parabola that touches the penalty from above, and weights on
changes of controls. Both are reduced after full steps and increased after short steps.
"""

from math import hypot, inf, isfinite, log

from lqrsim.kernels.declarations import NO_PROGRESS, NOT_FINITE, RUNNING, STALLED, M, N
from lqrsim.kernels.linear_algebra import copy_matrix, fill, finite
from lqrsim.kernels.passes import copy_plan, larger
from lqrsim.kernels.stages import (
    EQUALITY,
    LIMIT,
    closed_loop_rollout,
    evaluate_plan,
    read_rows,
    regularised_direction,
    row_change,
    write_models,
)

COMPACT = 1  # all functions

# First and least barrier parameter, relative to the price; factor by which it falls.
FIRST, LEAST, FALL = 1e-1, 1e-6, 0.2
LEAST_DECREASE = 0.1  # predicted decrease per row, relative to the parameter, below which the parameter falls
LAST = 1e-6  # predicted decrease over all rows at the end: multipliers are accurate to its square root
ARMIJO, SHORTEST = 1e-4, 1e-6  # least part of the predicted decrease that a step must have; smallest step
ROUNDING = 1e-13  # relative difference of merits that may be rounding
INSIDE = 0.01  # fraction of the distance to a limit that a step leaves
EDGE = 0.01  # distance from the limits at the beginning, relative to the range
DAMPING, LIGHT, HEAVY = 0.1, 1e-3, 1e6  # weight at a damping of 1; bounds of the damping
LONG, SHORT, TIMES = 0.4, 0.2, 4.0  # step fractions above or below which the damping falls or grows by a factor
WIDE = 1e3  # factor by which a multiplier may differ from the multiplier that the barrier implies
# The descent ends when the violation (relative to the rows' sizes) is below CLOSE and the change of cost below SLOW,
# PATIENCE times in a row.
CLOSE, SLOW, PATIENCE = 1e-4, 1e-2, 2
LEVEL, FINER = 1e-4, 0.1  # negligible predicted decrease, relative to the merit; factor by which it falls


def restoration(first, last, price, stages, work, memory, log):
    """Run the iterations `first` to `last` - 1 from the plan in `work.plan`; `last` = 0 only prepares them.

    Args:
      price: the cost of violating a constraint by its typical size. stages: PlanStages.
      work: RestorationArrays. memory: (1,) row of RESTORATION. log: rows of RESTORED, written.

    Returns:
      The number of iterations so far; and RUNNING, STALLED if no step helps or none is needed, NOT_FINITE if no step
      can be computed; or NO_PROGRESS if the caller is to test whether the violation of the plan is stationary, with the
      multipliers relative to the price in `work.relative_multipliers`. If it is not, the next call continues.
    """
    mem = memory[0]
    if last == 0:
        begin_restoration(price, stages, work, mem)
        return 0, RUNNING
    done, ended = first, False
    while True:
        if mem.unfinished != 0:  # the last iteration is to be completed
            mem.unfinished = 0.0
            if mem.fraction == 0 or (mem.parameter <= mem.least and mem.decrease < LAST * mem.parameter):
                return done, STALLED
            copy_plan(stages.steps, work.trial, work.plan)
        if done >= last:
            return done, RUNNING
        if not descend(price, stages, work, mem):
            return done, NOT_FINITE
        ended = measure_violation(stages, mem)
        row = log[done]
        row.cost, row.violation, row.relative_decrease = mem.cost, mem.violation, mem.relative_decrease
        done += 1
        if ended:
            return done, STALLED
        mem.unfinished = 1.0
        if mem.nearly_feasible == 0 and 2 * mem.relative_decrease < mem.level and mem.damping < 1:
            mem.level *= FINER
            write_relative_multipliers(price, stages, work)
            return done, NO_PROGRESS


def begin_restoration(price, stages, work, mem):
    """Begin with the rollout of the plan's controls, moved inside their limits."""
    rows, limits, steps = stages.rows, stages.model.limits, stages.steps
    for i in range(M):
        low, high = limits.low[i], limits.high[i]
        edge = EDGE * (high - low) if high - low < inf else 0.0
        for t in range(steps):
            work.plan.controls[t, i] = min(max(work.plan.controls[t, i], low + edge), high - edge)
            stages.policy.offset[t, i] = 0.0
            fill(stages.policy.gain[t, i], N, 0.0)
    confine(stages, work)
    copy_plan(steps, work.plan, work.trial)
    closed_loop_rollout(0.0, work.trial, stages, work.limits, work.plan)
    mem.rows = 0.0
    for at in range(rows.size * (steps + 1)):
        rows.force[at] = 0.0
        if rows.live[at] != 0:
            mem.rows += 1
    mem.parameter, mem.least = FIRST * price / max(mem.rows, 1.0), LEAST * price / max(mem.rows, 1.0)
    mem.damping, mem.level, mem.close, mem.before, mem.unfinished, mem.has_duals = 1.0, LEVEL, 0.0, inf, 0.0, 0.0
    for t in range(steps + 1):
        fill(work.costates[t], N, 0.0)


def confine(stages, work):
    """Write the limits of the controls in one step from the plan."""
    limits = stages.model.limits
    for t in range(stages.steps):
        for i in range(M):
            control, low, high = work.plan.controls[t, i], limits.low[i], limits.high[i]
            work.limits.low[t, i] = low + INSIDE * (control - low) if low > -inf else low
            work.limits.high[t, i] = high - INSIDE * (high - control) if high < inf else high


def descend(price, stages, work, mem):
    """Find a step and try fractions of it, into `work.trial`; return whether there is a step."""
    rows, steps = stages.rows, stages.steps
    mem.cost = evaluate_plan(stages, work.plan, stages.models.arrived)
    read_rows(stages, work.plan, rows.numbers)
    good = isfinite(mem.cost)
    for at in range(rows.size * (steps + 1)):
        good = good and (rows.live[at] == 0 or isfinite(rows.numbers[at]))
    if not good:
        return False
    write_models(True, stages, work.plan, work.costates, 0.0)
    for t in range(steps):
        fill(work.gaps[t], N, 0.0)
    while True:
        model_penalties(price, stages, work, mem)
        each = price / steps
        weight = mem.damping * DAMPING * each
        if regularised_direction(stages, work.plan, work.gaps, weight, each, work.curves, rows.force) < 0:
            return False
        mem.decrease = -slope_of_merit(stages)
        if mem.decrease > LEAST_DECREASE * mem.parameter * mem.rows or mem.parameter <= mem.least:
            break
        mem.parameter = max(FALL * mem.parameter, mem.least)
    copy_matrix(stages.to_go.gradient, steps + 1, N, work.costates)
    mem.merit = penalized(mem.cost, rows.numbers, price, stages, mem)
    confine(stages, work)
    mem.fraction, fraction = 0.0, 1.0
    while fraction > SHORTEST and mem.fraction == 0:
        closed_loop_rollout(fraction, work.plan, stages, work.limits, work.trial)
        if finite(work.trial.states, steps + 1, N):
            cost = evaluate_plan(stages, work.trial, work.arrived)
            read_rows(stages, work.trial, work.numbers)
            merit = penalized(cost, work.numbers, price, stages, mem)
            if merit <= mem.merit - ARMIJO * fraction * mem.decrease + ROUNDING * abs(mem.merit):
                mem.fraction = fraction
        if mem.fraction == 0:
            fraction /= 2
    for at in range(rows.size * (steps + 1)):
        if rows.live[at] != 0:
            work.full_step_duals[at] = rows.force[at] - work.curves[at] * row_change(at, stages)
            work.duals[at] += fraction * (work.full_step_duals[at] - work.duals[at])
    if fraction > LONG:
        mem.damping /= TIMES
    elif fraction < SHORT:
        mem.damping = min(max(TIMES * mem.damping, LIGHT), HEAVY)
    return True


def slope_of_merit(stages):
    """Derivative of the merit along the step."""
    changes, rows, slope = stages.changes, stages.rows, 0.0
    for t in range(stages.steps + 1):
        for i in range(N):
            slope += stages.models.gradient[t, i] * changes.states[t, i]
        if t < stages.steps:
            for i in range(M):
                slope += stages.models.gradient[t, N + i] * changes.controls[t, i]
        for row in range(rows.size):
            at = rows.size * t + row
            if rows.live[at] != 0:
                slope -= rows.force[at] * row_change(at, stages)
    return slope


def model_penalties(price, stages, work, mem):
    """Write forces and curvatures of the penalties; unknown multipliers are the forces."""
    rows, parameter = stages.rows, mem.parameter
    for at in range(rows.size * (stages.steps + 1)):
        work.curves[at] = 0.0
        if rows.live[at] == 0:
            continue
        number = rows.numbers[at]
        limit, highest = rows.kinds[at] == LIMIT, price / rows.sizes[at]
        lowest = -highest if rows.kinds[at] == EQUALITY else 0.0
        slack, excess = slacks_of(at, number, price, parameter, rows)
        lower_slack = number if limit else slack
        rows.force[at] = lowest + parameter / lower_slack
        if mem.has_duals == 0:
            work.duals[at] = rows.force[at]
        middle = parameter / lower_slack
        low = min(max(work.duals[at] - lowest, middle / WIDE), middle * WIDE)
        if limit:
            work.curves[at] = low / lower_slack
            continue
        middle = parameter / excess
        high = min(max(highest - work.duals[at], middle / WIDE), middle * WIDE)
        curve = 1 / (lower_slack / low + excess / high)
        both = 2 * excess if rows.kinds[at] == EQUALITY else slack + excess
        work.curves[at] = curve + min(mem.damping, 1.0) * max(parameter / (slack * both) - curve, 0.0)
    mem.has_duals = 1.0


def slacks_of(at, number, price, parameter, rows):
    """The two slacks of a row whose sum of price and barrier is least; their difference is the value of the row."""
    steep = price / rows.sizes[at]
    if rows.kinds[at] == EQUALITY:
        steep *= 2
    size, root = steep * abs(number), hypot(steep * number, 2 * parameter)
    rest = 4 * parameter * parameter / (root + size)  # root - size, without cancelling
    small, large = (2 * parameter + rest) / (2 * steep), (2 * parameter + root + size) / (2 * steep)
    if number > 0:
        return large, small
    return small, large


def penalized(cost, numbers, price, stages, mem):
    """The merit of a plan of this cost, whose rows have these values: cost and penalties; infinite if there is none."""
    rows, total, parameter = stages.rows, cost, mem.parameter
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] == 0:
            continue
        if rows.kinds[at] == LIMIT:
            total -= parameter * log(numbers[at])
            continue
        slack, excess = slacks_of(at, numbers[at], price, parameter, rows)
        paid = excess + slack if rows.kinds[at] == EQUALITY else excess
        total += price / rows.sizes[at] * paid - parameter * (log(slack) + log(excess))
    return total if isfinite(total) else inf


def measure_violation(stages, mem):
    """Compute the violation of the plan before the step; return whether the descent ends."""
    rows, relative = stages.rows, 0.0
    mem.violation = 0.0
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0 and rows.kinds[at] != LIMIT:
            missed = abs(rows.numbers[at]) if rows.kinds[at] == EQUALITY else -rows.numbers[at]
            mem.violation, relative = larger(mem.violation, missed), larger(relative, missed / rows.sizes[at])
    mem.nearly_feasible = 1.0 if relative < CLOSE else 0.0
    still = relative < CLOSE and abs(mem.before - mem.cost) < SLOW * abs(mem.cost)
    mem.close = mem.close + 1 if still else 0.0
    mem.before, mem.relative_decrease = mem.cost, 0.5 * mem.decrease / max(abs(mem.merit), 1e-300)
    return mem.close >= PATIENCE


def write_relative_multipliers(price, stages, work):
    """Write the multipliers after the step relative to the price, from -1 to 1; 0 for limits."""
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        work.relative_multipliers[at] = 0.0
        if rows.live[at] != 0 and rows.kinds[at] != LIMIT:
            lowest = -1.0 if rows.kinds[at] == EQUALITY else 0.0
            work.relative_multipliers[at] = min(max(work.full_step_duals[at] * rows.sizes[at] / price, lowest), 1.0)

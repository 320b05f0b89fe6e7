"""Constraints by a primal-dual interior point with exact second derivatives, on states and controls at once.

Each iteration takes a step to the minimum of a quadratic model of the Lagrangian with a logarithmic barrier, subject to
the linearised dynamics, by a Riccati recursion; gaps between the steps of the plan are closed on the way. The barrier
parameter is reduced by Mehrotra's rule if the last step was long and the measures decrease. Otherwise it is reduced
when the barrier problem is nearly solved. A filter decides how much of a step is taken (Waechter and Biegler, 2006).
Corrections with the same models then reduce the residuals of a long step. If a model has no minimum, the ladder of
`stages.py` gives it one.

A row d of an inequality means d >= 0, a row of an equality d = 0. Control limits are rows, too. The multiplier y of a
row lies between a lower and an upper bound, and `d = s - p` has two slacks. The product of s and y - lower is the
barrier parameter, and so is the product of p and upper - y. For an inequality, the lower bound is 0. Without an upper
bound there is no p. An upper bound is the price of a violation, in cost per unit: the constraint is then elastic. An
equality without a price has no slacks, and is regularised.

If MuJoCo linearises, that takes most of an iteration. Where the plan hardly moves, as when a robot plans again, the
derivatives of the dynamics may serve for several steps; the gaps that steps leave are always MuJoCo's own. They are
computed anew if a step with old ones has to be shortened, and before a plan counts as converged.

Of dynamics without second derivatives, such as MuJoCo's steps, the models of `stages.py` have the curvature of cost and
rows alone. What they lack at each stage is learned from the changes of the Lagrangian's gradient by the steps taken,
by symmetric updates of rank one (SR1). It enters the Hessians only if convergence without it is slow: at first the
updates know little.
"""

from math import copysign, inf, isfinite, isnan, log, nan

from lqrsim.kernels.active_set import (
    AT_LIMIT,
    CANCELLED,
    FREE,
    HELD,
    PAID,
    SOFTNESS,
    apply_step,
    measure_plan,
    pivot,
    prepare_step,
)
from lqrsim.kernels.declarations import CONVERGED, RUNNING, STALLED, M, N, W, inline, stack
from lqrsim.kernels.linear_algebra import clear, copy, copy_matrix, fill
from lqrsim.kernels.passes import copy_plan, larger
from lqrsim.kernels.stages import (
    EQUALITY,
    LIMIT,
    add_matrix,
    adjoint,
    convex_fraction_at,
    determine_scales,
    direction,
    evaluate_plan,
    lagrangian_slope,
    plan_residuals,
    read_rows,
    regularised_direction,
    row_change,
    write_models,
)
from lqrsim.kernels.stages import least_curvatures as least_curvatures  # for Python

COMPACT = 1  # all functions but those that are inline

# The two slacks of a row, which belong to its multiplier's lower and upper bound, and their signs in `d = s - p`.
LOWER, UPPER = 0, 1
SIGNS = (1.0, -1.0)

# Tasks of `interior_point`: to find typical sizes at a plan; to choose slacks and multipliers there; to take steps
# without a barrier from there; to iterate; and to cross over, because no iteration follows.
SCALE, BEGIN, POLISH, ITERATE, CLOSE = 0, 1, 2, 3, 4

LONG = 0.3  # fraction of a step above which the next step uses Mehrotra's rule
CROSSINGS = 8  # largest number of final steps without a barrier
NEGLIGIBLE = 1e-7  # multiplier that counts as zero in the Hessians, times its row's size and relative to the cost


def interior_point(task, first, last, tolerance, violation, begun, stages, work, memory, log):
    """Begin an interior point, polish a known optimum, or run the iterations `first` to `last` - 1.

    All code that a solve can need is compiled together, before it begins.

    Args:
      task: one of SCALE, BEGIN, POLISH, ITERATE and CLOSE.
      tolerance: tolerance of stationarity, gaps and complementarity. violation: of constraints, in their units.
      begun: PlanBeginning. stages: PlanStages. work: InteriorArrays. memory: (1,) row of INTERIOR.
      log: rows of MEASURES, written.

    Returns:
      The number of iterations so far; and CONVERGED if the crossover succeeded, STALLED if nothing helps any more,
      otherwise RUNNING. `memory.solved` says whether the measures were within tolerance.
    """
    if task == SCALE:
        find_sizes(begun, stages, work, memory[0])
        return 0, RUNNING
    if task == BEGIN:
        begin(begun, stages, work, memory[0])
        return 0, RUNNING
    if task == POLISH:
        return first, CONVERGED if polish(tolerance, violation, begun, stages, work, memory[0]) else RUNNING
    return iterations(first, last, task == CLOSE, tolerance, violation, stages, work, memory[0], log)


# The first plan.

WIDE_RANGE = 1e3  # range relative to the first controls, or to 1, from which on limits may be very wide
EDGE = 0.05  # distance of the first controls from their limits, relative to the range
LEAST_SCALE = 1e-4  # least scale of the first plan, relative to the typical cost of a change
BARELY = 1e-3  # least first excess, relative to the least first slack
WITHIN, AROUND = 0.9, 10.0  # known multipliers: fraction of a bound, and factor from the barrier's, that they may reach
FARTHEST = 10.0  # largest violation relative to the first plan's
PER_ROW = 0.05  # that may be taken for the first plan's, relative to sizes: even rows far from active count in a sum


def find_sizes(begun, stages, work, mem):
    """Take a plan, with its controls a little inside their limits; compute typical sizes and the models there."""
    now, steps, limits = work.now, stages.steps, stages.model.limits
    copy_plan(steps, begun.plan, now.plan)
    widest, largest = 0.0, 1.0
    for i in range(M):
        widest = max(widest, limits.high[i] - limits.low[i] if limits.high[i] - limits.low[i] < inf else 0.0)
        for t in range(steps):
            largest = max(largest, abs(now.plan.controls[t, i]))
    wide = widest > WIDE_RANGE * largest
    if wide:  # whether they are is known from the models alone
        determine_scales(stages, now.plan)
    for i in range(M):
        low, high = limits.low[i], limits.high[i]
        edge = EDGE * (high - low) if high - low < inf else 0.0
        edge = min(edge, EDGE * stages.control_size[i]) if wide else edge
        for t in range(steps):
            now.plan.controls[t, i] = min(max(now.plan.controls[t, i], low + edge), high - edge)
    stages.reuses_derivatives[0] = 0.0
    mem.typical = determine_scales(stages, now.plan)


def begin(begun, stages, work, mem):
    """Begin from that plan: compute slacks, multipliers and measures."""
    rows, now, steps = stages.rows, work.now, stages.steps
    mem.cost = evaluate_plan(stages, now.plan, now.arrived)
    read_rows(stages, now.plan, now.numbers)
    # A cost near zero, as when standing still, says nothing about the scale of the problem.
    mem.scale = max(mem.cost, LEAST_SCALE * mem.typical) if mem.cost < inf else mem.typical
    mem.pairs, mem.elastic = 0.0, 0.0
    for at in range(rows.size * (steps + 1)):
        if rows.live[at] != 0:
            for side in range(2):
                if has_slack(at, side, rows):
                    mem.pairs += 1
            if rows.prices[at] < inf:
                mem.elastic = 1.0
    mem.barrier, mem.parameter = begun.barrier, begun.barrier * mem.scale / max(mem.pairs, 1.0)
    mem.highest, mem.fraction, mem.soft, mem.target, mem.since = mem.parameter, 1.0, 1.0, nan, float(CROSSINGS)
    mem.rung, mem.forced, mem.filter_rows, mem.falls, mem.solved, mem.short = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mem.unchanged, mem.level, mem.age, mem.oldest = 0.0, nan, 0.0, begun.oldest
    clear(now.slacks, rows.size * (steps + 1), 2)
    for at in range(rows.size * (steps + 1)):
        rows.force[at] = 0.0
        if rows.live[at] != 0:
            begin_row(at, begun, stages, work, mem)
    for t in range(steps):
        clear(stages.policy.gain[t], M, N)
    adjoint(stages, work.costates, work.alternative.changes.controls)
    measure_iterate(stages, work, mem)
    violated = total_violation(now, stages)
    forget(stages)
    mem.before = mem.cost
    mem.farthest_gap = FARTHEST * max(PER_ROW * steps, violated)
    mem.farthest = FARTHEST * max(PER_ROW * max(float(steps), mem.pairs), violated)


def begin_row(at, begun, stages, work, mem):
    """Choose the first slacks and the multiplier of a row."""
    rows = stages.rows
    equality, size, price = rows.kinds[at] == EQUALITY, rows.sizes[at], rows.prices[at]
    number, force, least = work.now.numbers[at], 0.0, begun.least_slack * size
    if begun.has_multipliers:
        force = begun.multipliers[at]
    if force > 0 and not equality:
        least = min(least, mem.parameter / force)
    slack = 0.0
    if has_slack(at, LOWER, rows):
        slack = max(number, 0.0) + least if equality else max(number, least)
        middle = mem.parameter / slack
        if begun.has_multipliers and not equality:
            force = min(max(force, middle / AROUND), AROUND * middle)
        elif not begun.has_multipliers:
            force = 0.0 if equality else middle
        work.now.slacks[at, LOWER] = slack
    if has_slack(at, UPPER, rows):
        work.now.slacks[at, UPPER] = max(slack - number, BARELY * least)
    highest = WITHIN * price if price < inf else inf
    rows.force[at] = min(max(force, -highest if equality else 0.0), highest)


@inline
def has_slack(at, side, rows):
    """Whether a row has the slack of a side: rows with a price have both, other inequalities the lower one."""
    return rows.prices[at] < inf or (side == LOWER and rows.kinds[at] != EQUALITY)


@inline
def regularised(at, rows):
    """Whether a row is an equality without a price."""
    return rows.kinds[at] == EQUALITY and not rows.prices[at] < inf


@inline
def from_bound(at, side, rows):
    """Distance of a row's multiplier from the bound of a side."""
    if side == UPPER:
        return rows.prices[at] - rows.force[at]
    return rows.force[at] + rows.prices[at] if rows.kinds[at] == EQUALITY else rows.force[at]


# The loop.

FINER, FINEST = 1e-2, 1e-13  # factor by which the target falls if a crossover fails, and its least value
CREEP, CREEPING = 0.1, 20  # fraction of a step that is short; number of short steps in a row that end the run
SLOW = 0.01  # unless the constraints are satisfied and the cost falls by this fraction during them
# Where derivatives of the dynamics jump, as by dry friction, no plan is stationary. The stationarity above which that
# may be; the change of cost, relative to the cost, that is none; the number of such iterations after which the barrier
# falls nevertheless; and after which the run ends, if the barrier costs no more than that change.
STEEP, FLAT_COST, FLAT_BEFORE_FALL, FLAT_BEFORE_END = 1e-3, 1e-3, 2, 6
ROUNDED = 1e3  # slope relative to the tolerance, from which on it counts as rounding if the cost does not change
OUTLIER = 10.0  # factor by which a product of slack and multiplier may differ from the barrier parameter
LATELY = 4  # number of iterations with Mehrotra's rule; to continue, the measures must be below the worst of these
HIGHER = 10.0  # the largest barrier parameter of Mehrotra's rule, relative to the first
# Least barrier parameter, relative to the tolerance; the same where there is no crossover, of all rows together.
LEAST_PARAMETER, LEAST_TOTAL = 0.1, 0.5
LEVELS = 4  # largest number of reductions of the barrier parameter at once
NEARLY = 10.0  # residuals of a barrier problem that is nearly solved, relative to the parameter
# Factor by which the parameter then falls at least, and power of the parameter, if that is less.
FALL_FACTOR, FALL_POWER = 0.2, 1.5
STUCK, SOFTER, SOFTEST = 1e-2, 1e2, 1e10  # fraction of a step that softens equalities; factor, limit
ABSURD = 1e3  # change of a multiplier, times its row's size and relative to the cost, that is implausible
CENTRED = 0.5  # fraction of an affine step above which Mehrotra's corrections of products are used
# If a step is not long: the longer fraction for which centring aims, and the part of this gain that is required.
REACH, FURTHER = 0.5, 0.1
BOUNDARY = 0.99  # least part of the distance to a zero slack that a step may take


def iterations(first, last, closing, tolerance, violation, stages, work, mem, log):
    """Run the iterations `first` to `last` - 1, until the measures are within tolerance or no step helps.

    With `closing`, no iteration follows.
    """
    done, ended = first, closing
    if isnan(mem.target):  # the first call
        mem.target = tolerance
    while True:
        outcome = judge(ended, tolerance, violation, stages, work, mem)
        if outcome != RUNNING or done >= last:
            return done, outcome
        if not isfinite(mem.cost) or not iterate(done, tolerance, stages, work, mem):
            ended = True
            continue
        row = log[done]
        row.cost, row.stationarity, row.violation = mem.cost, mem.stationarity, mem.violation
        row.gap, row.complementarity = mem.gap, mem.complementarity
        done += 1
        mem.since += 1
        count_unchanged(stages.learns == 1, violation, mem)
        ended = creeping(violation, mem) or (stages.learns == 1 and cost_is_flat(mem))


def judge(ended, tolerance, violation, stages, work, mem):
    """Whether the iterate is optimal (CONVERGED), nothing helps any more (STALLED), or iterations go on (RUNNING).

    If the measures are within tolerance, a crossover to the active set makes controls end exactly at their limits. If
    it fails, the barrier falls further, which shows which rows are active even if most of the cost is constant. Without
    second derivatives of the dynamics there is no crossover: its steps have no line search, and the plan ends inside
    the constraints. `ended`: no iteration can follow.
    """
    learns = stages.learns == 1
    inside = within(learns, tolerance, violation, mem)
    if inside and mem.age > 0 and (ended or central(tolerance, mem)):
        renew(stages, work, mem)
        inside = within(learns, tolerance, violation, mem)
    if learns:
        mem.solved = 1.0 if inside else 0.0
        if inside and (ended or central(tolerance, mem)):
            return CONVERGED
        return STALLED if ended else RUNNING
    if inside:
        mem.solved = 1.0
    close = max(mem.complementarity, mem.stationarity) < mem.target
    if mem.solved != 0 and (ended or close or mem.since >= CROSSINGS):
        if not inside:
            go_back(stages, work, mem)
            return STALLED
        if cross(tolerance, violation, stages, work, mem):
            return CONVERGED
        ended = ended or mem.target <= FINEST or mem.unchanged >= FLAT_BEFORE_END
        mem.target *= FINER
        mem.since = 0.0
    return STALLED if ended else RUNNING


@inline
def creeping(violation, mem):
    """Whether the steps are short, and have been for long."""
    falls = mem.violation <= violation and mem.cost < mem.before - SLOW * abs(mem.before)
    if mem.fraction >= CREEP or falls or mem.solved != 0:
        mem.short, mem.before = 0.0, mem.cost
    else:
        mem.short += 1
    return mem.short >= CREEPING


@inline
def count_unchanged(learns, violation, mem):
    """Count the iterations in a row in which the cost does not change, though the plan is not stationary.

    Where derivatives may jump, changes count as none that elsewhere would not, and steps may be short.
    """
    kept = mem.violation <= violation and (mem.stationarity > STEEP if learns else mem.fraction >= LONG)
    if kept and abs(mem.cost - mem.level) <= (FLAT_COST if learns else ROUNDING) * abs(mem.level):
        mem.unchanged += 1
    else:
        mem.unchanged, mem.level = 0.0, mem.cost


@inline
def cost_is_flat(mem):
    """Whether the cost no longer changes at the least barrier."""
    return mem.unchanged >= FLAT_BEFORE_END and mem.pairs * mem.parameter <= FLAT_COST * mem.scale


@inline
def within(learns, tolerance, violation, mem):
    """Whether the measures are within tolerance. The violation of elastic rows is in their slacks.

    Where long steps no longer change the cost, a slope far above the tolerance is rounding, which grows along unstable
    dynamics.
    """
    row_residual = mem.miss < tolerance if mem.elastic != 0 else mem.violation <= violation
    rounded = not learns and mem.unchanged >= FLAT_BEFORE_END and mem.stationarity > ROUNDED * tolerance
    stationary = rounded or mem.stationarity < tolerance
    return stationary and mem.gap < tolerance and mem.complementarity < tolerance and row_residual


@inline
def central(tolerance, mem):
    """Whether the barrier costs no more than the tolerance, relative to the cost."""
    close = mem.pairs * mem.complementarity <= OUTLIER * tolerance
    return close and mem.pairs * mem.parameter <= tolerance * mem.scale


def iterate(done, tolerance, stages, work, mem):
    """Do one iteration; return whether a step was found."""
    least, free = LEAST_PARAMETER * mem.target * mem.scale, falls_lately(work, mem)
    if stages.learns == 1:
        least = LEAST_TOTAL * tolerance * mem.scale / max(mem.pairs, 1.0)
        if mem.unchanged >= FLAT_BEFORE_FALL and mem.parameter > least:
            mem.parameter = max(least, FALL_FACTOR * FALL_FACTOR * mem.parameter)
            mem.filter_rows, mem.unchanged = 0.0, 0.0
    lower_barrier(done, least, free, stages, work, mem)
    fraction = -1.0
    while True:
        if not models_with_barrier(stages, work, mem):
            return False
        find_step(least, free, stages, work, mem)
        fraction = search(True, stages, work, mem)
        if fraction < min(LONG, mem.whole) and mem.age > 0:
            renew(stages, work, mem)
            continue
        # Far away, linearised equalities may be absurd; softened equalities demand only a part.
        if fraction >= STUCK or largest_multiplier_step(stages, work) < ABSURD * mem.scale or mem.soft >= SOFTEST:
            break
        mem.soft *= SOFTER
    if fraction < 0:
        fraction = force_step(stages, work, mem)
    if fraction < 0:
        return False
    accept_step(fraction, stages, work, mem)
    return True


def largest_multiplier_step(stages, work):
    """The largest change of the multiplier of an equality without a price, times its row's size."""
    rows, largest = stages.rows, 0.0
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0 and regularised(at, rows):
            largest = larger(largest, abs(work.step.force[at]) * rows.sizes[at])
    return largest


def falls_lately(work, mem):
    """Whether the measures have decreased lately, so that Mehrotra's rule may choose the barrier parameter.

    The rule empties the filter each time. Without this condition, iterations may cycle.
    """
    error = larger(larger(mem.stationarity, mem.gap), larger(mem.miss, mem.product / mem.scale))
    count, worst = int(mem.falls), inf
    if count > 0:
        worst = -inf
        for i in range(min(count, LATELY)):
            worst = max(worst, work.errors[i])
    good = error < worst
    if good:
        work.errors[count % LATELY] = error
        mem.falls += 1
    return good


def lower_barrier(done, least, free, stages, work, mem):
    """Lower the barrier parameter while the measures are small relative to it, unless Mehrotra's rule will."""
    # A bad first plan may cost a hundred times the optimum, which would make the first barrier too high.
    mem.highest = min(mem.highest, mem.barrier * mem.scale / max(mem.pairs, 1.0))
    if mem.parameter > mem.highest and done > 0:
        mem.parameter, mem.filter_rows = mem.highest, 0.0
    if free and mem.rung == 0 and mem.fraction >= LONG:
        return
    for _ in range(LEVELS):
        residual = max(mem.stationarity * mem.scale, max(mem.miss, mem.gap) * mem.scale)
        residual = max(residual, off_centre(stages, work, mem))
        if residual > NEARLY * mem.parameter or mem.parameter <= least:
            break
        lower = mem.scale * (mem.parameter / mem.scale) ** FALL_POWER
        mem.parameter, mem.filter_rows = max(least, min(FALL_FACTOR * mem.parameter, lower)), 0.0


def off_centre(stages, work, mem):
    """The largest difference of a product of slack and multiplier from the barrier parameter."""
    rows, slacks, largest = stages.rows, work.now.slacks, 0.0
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and has_slack(at, side, rows):
                largest = max(largest, abs(slacks[at, side] * from_bound(at, side, rows) - mem.parameter))
    return largest


def models_with_barrier(stages, work, mem):
    """Give the models the barrier's curvature, and the least regularisation with which they have a minimum."""
    rows, slacks = stages.rows, work.now.slacks
    clear(work.corrections, rows.size * (stages.steps + 1), 2)
    for at in range(rows.size * (stages.steps + 1)):
        work.curves[at] = 0.0
        if rows.live[at] != 0:
            width = 0.0
            if regularised(at, rows):
                size = rows.sizes[at]
                width = mem.soft * SOFTNESS * size * size / mem.scale
            for side in range(2):
                if has_slack(at, side, rows):
                    width += slacks[at, side] / from_bound(at, side, rows)
            work.curves[at] = 1 / width
    write_row_forces(False, work.corrections, stages, work, mem)
    rung = regularised_direction(stages, work.now.plan, work.gaps, 0.0, mem.scale, work.curves, work.forces)
    if rung < 0:
        return False
    mem.rung, mem.convex_fraction = float(rung), convex_fraction_at(rung)
    return True


def write_row_forces(extra_residuals, corrections, stages, work, mem):
    """Write the forces of the rows in the condensed equations of a step; `extra_residuals` adds further residuals."""
    rows = stages.rows
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            residual = residual_of(at, corrections, rows, work, mem)
            if extra_residuals:
                residual += work.extra_residuals[at]
            work.forces[at] = rows.force[at] - work.curves[at] * residual


def residual_of(at, corrections, rows, work, mem):
    """Residual of a row in these equations: its value, minus slacks with the desired products."""
    residual = work.now.numbers[at]
    for side in range(2):
        if has_slack(at, side, rows):
            residual -= SIGNS[side] * (mem.parameter - corrections[at, side]) / from_bound(at, side, rows)
    return residual


def solve(extra_residuals, corrections, gaps, stages, work, mem):
    """Compute another step with the same models, but without weights on changes; return whether there is one."""
    write_row_forces(extra_residuals, corrections, stages, work, mem)
    return direction(stages, work.now.plan, gaps, mem.convex_fraction, 0.0, 1.0, work.curves, work.forces) == -1


def complete(extra_residuals, corrections, out, stages, work, mem):
    """Complete the step in `stages` by slacks and multipliers, (PlanStep)."""
    rows, slacks = stages.rows, work.now.slacks
    copy_plan(stages.steps, stages.changes, out.changes)
    copy_matrix(stages.to_go.gradient, stages.steps + 1, N, out.costates)
    clear(out.slacks, rows.size * (stages.steps + 1), 2)
    for at in range(rows.size * (stages.steps + 1)):
        out.force[at] = 0.0
        if rows.live[at] == 0:
            continue
        residual = row_change(at, stages) + residual_of(at, corrections, rows, work, mem)
        if extra_residuals:
            residual += work.extra_residuals[at]
        change = -work.curves[at] * residual
        out.force[at] = change
        for side in range(2):
            if has_slack(at, side, rows):
                wanted, dual = mem.parameter - corrections[at, side], from_bound(at, side, rows)
                slack = slacks[at, side]
                out.slacks[at, side] = wanted / dual - slack - SIGNS[side] * slack / dual * change


def find_step(least, free, stages, work, mem):
    """Find the step of an iteration, with corrections if its models have a minimum without regularisation."""
    if mem.rung == 0 and free and mem.fraction >= LONG and mem.pairs > 0:
        predict(least, stages, work, mem)
        solve(False, work.corrections, work.gaps, stages, work, mem)
    complete(False, work.corrections, work.step, stages, work, mem)
    if mem.rung == 0:
        centre(stages, work, mem)


def predict(least, stages, work, mem):
    """Mehrotra's rule: set the barrier parameter by an affine step, and second-order corrections of the products."""
    rows, slacks, step, corrections = stages.rows, work.now.slacks, work.alternative, work.corrections
    mem.parameter = 0.0
    solve(False, corrections, work.gaps, stages, work, mem)
    complete(False, corrections, step, stages, work, mem)
    primal, dual = longest(1.0, slacks, step, stages)
    average, after = 0.0, 0.0
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and has_slack(at, side, rows):
                distance, change = from_bound(at, side, rows), SIGNS[side] * step.force[at]
                average += slacks[at, side] * distance
                after += (slacks[at, side] + primal * step.slacks[at, side]) * (distance + dual * change)
    average, ratio = average / mem.pairs, after / average
    mem.parameter = max(least, min(HIGHER * mem.highest, ratio * ratio * ratio * average))
    mem.filter_rows = 0.0
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and primal > CENTRED:
                corrections[at, side] = SIGNS[side] * step.slacks[at, side] * step.force[at]


def centre(stages, work, mem):
    """If a slack stops the step early, replace it by another step if that goes further.

    The corrections of that step bring outliers among the products, predicted for a slightly longer step, back to within
    a factor of `OUTLIER` of the barrier parameter (Gondzio, 1996).
    """
    rows, slacks, step, corrections = stages.rows, work.now.slacks, work.step, work.corrections
    tau = boundary(mem)
    fraction, dual = longest(tau, slacks, step, stages)
    if fraction >= LONG:
        return
    longer, dual_longer = min(1.0, fraction + REACH), min(1.0, dual + REACH)
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and has_slack(at, side, rows):
                distance = from_bound(at, side, rows) + SIGNS[side] * dual_longer * step.force[at]
                product = (slacks[at, side] + longer * step.slacks[at, side]) * distance
                work.centring[at, side] = corrections[at, side] - lacking(product, mem)
    if not solve(False, work.centring, work.gaps, stages, work, mem):
        return
    complete(False, work.centring, work.alternative, stages, work, mem)
    other_fraction, _ = longest(tau, slacks, work.alternative, stages)
    if other_fraction >= fraction + FURTHER * REACH:
        copy_matrix(work.centring, rows.size * (stages.steps + 1), 2, corrections)
        complete(False, corrections, step, stages, work, mem)


@inline
def lacking(product, mem):
    """What brings a product to within a factor of the barrier parameter, but not more than that."""
    wanted = min(max(product, mem.parameter / OUTLIER), OUTLIER * mem.parameter)
    return max(wanted - product, -OUTLIER * mem.parameter)


@inline
def boundary(mem):
    """The fraction of the distance to a zero slack that a step may take."""
    return max(BOUNDARY, 1 - mem.parameter / mem.scale)


def longest(tau, slacks, step, stages):
    """The largest fractions of a PlanStep by the fraction-to-the-boundary rule with `tau`, at most 1.

    Returns that of the changes of these slacks, and that of the changes of the multipliers.
    """
    rows, primal, dual = stages.rows, 1.0, 1.0
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and has_slack(at, side, rows):
                if step.slacks[at, side] < 0:
                    primal = min(primal, -tau * slacks[at, side] / step.slacks[at, side])
                change = SIGNS[side] * step.force[at]
                if change < 0:
                    dual = min(dual, -tau * from_bound(at, side, rows) / change)
    return primal, dual


# The line search.

SHORTEST = 1e-7  # fraction of a step below which the line search gives up
# Largest number of corrections after a long step, and the largest fraction of the violation that each may leave.
CLOSINGS, CLOSER = 3, 0.3
MARGIN = 1e-5  # improvement that the filter requires
ARMIJO = 1e-4  # fraction of the predicted decrease that a step must achieve
SWITCH, SWITCHED = 2.3, 1.1  # powers of the predicted decrease and of the violation in the switching condition
LARGEST_POWER = 1e100  # the most that such a power can take
# Violation below which a step may be judged by its merit alone; the same for each gap.
NEARLY_FEASIBLE, PER_GAP = 1e-4, 1e-2
AT_REST = 1e-9  # violation below which the merit may stay as it is
ROUNDING, RESTING = 1e-12, 1e-11  # relative differences of merits that may be rounding, in these two tests
# Largest number of steps that are taken although the filter rejects them; the fraction of these.
FORCED, FORCED_FRACTION = 6, 0.1
WIDE = 1e10  # factor by which slack times multiplier may differ from the barrier parameter
CRAWL = 0.5  # factor by which stationarity falls too little, so that the Hessians need what is learned of them


def search(corrected, stages, work, mem):
    """Backtrack along the step until the filter accepts; the first trial also with a second-order correction.

    The correction reduces the residuals after the whole step, which remain because rows and dynamics are not linear.
    Only if `corrected` are there corrections. Where derivatives are kept, none follow an accepted step: another step
    costs as little.

    Returns:
      The fraction of the step that leads to the point in `work.tried`, or -1.
    """
    step, now = work.step, work.now
    mem.slope, mem.violated = slope_of_merit(stages, work, mem), total_violation(now, stages)
    mem.merit = merit_of(now, mem.cost, stages, mem)
    fraction, _ = longest(boundary(mem), now.slacks, step, stages)
    mem.whole, first = fraction, True
    while fraction > SHORTEST:
        mem.tried = write_trial(fraction, now, step.changes, step.slacks, work.tried, stages)
        if isfinite(mem.tried) and acceptable(fraction, work.tried, mem.tried, stages, work, mem):
            if corrected and fraction >= LONG and mem.oldest == 0:
                close_residuals(fraction, stages, work, mem)
            return fraction
        if first and isfinite(mem.tried) and corrected and correct(fraction, stages, work, mem):
            close_residuals(fraction, stages, work, mem)
            return fraction
        first = False
        fraction /= 2
    return -1.0


def correct(fraction, stages, work, mem):
    """Try a step that also reduces the residuals at a trial, if these have not fallen; return whether it is accepted.

    Multipliers and costates come from the uncorrected step.
    """
    rows, now, tried = stages.rows, work.now, work.tried
    if not total_violation(tried, stages) >= mem.violated:
        return False
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            before = row_residual(at, now)
            work.extra_residuals[at] = fraction * before + row_residual(at, tried) - before
    for t in range(stages.steps):
        for i in range(N):
            work.extra_gaps[t, i] = fraction * work.gaps[t, i] + tried.arrived[t, i] - tried.plan.states[t + 1, i]
    if not solve(True, work.corrections, work.extra_gaps, stages, work, mem):
        return False
    complete(True, work.corrections, work.alternative, stages, work, mem)
    longest_fraction, _ = longest(boundary(mem), now.slacks, work.alternative, stages)
    cost = write_trial(longest_fraction, now, work.alternative.changes, work.alternative.slacks, work.closer, stages)
    if not isfinite(cost) or not acceptable(fraction, work.closer, cost, stages, work, mem):
        return False
    copy_point(work.closer, work.tried, stages)
    mem.tried = cost
    return True


def close_residuals(fraction, stages, work, mem):
    """Move the trial towards feasibility by the smallest changes, as far as the filter accepts them.

    The changes use the models of the step, so each change costs a Riccati pass and an evaluation of the steps. A good
    plan is then feasible long before it is optimal.
    """
    rows, tried, slacks, other = stages.rows, work.tried, work.now.slacks, work.alternative
    for _ in range(CLOSINGS):
        violated = total_violation(tried, stages)
        for at in range(rows.size * (stages.steps + 1)):
            work.forces[at] = -work.curves[at] * row_residual(at, tried) if rows.live[at] != 0 else 0.0
        for t in range(stages.steps):
            for i in range(N):
                work.extra_gaps[t, i] = tried.arrived[t, i] - tried.plan.states[t + 1, i]
        convex, plan = mem.convex_fraction, work.now.plan
        if direction(stages, plan, work.extra_gaps, convex, 0.0, 0.0, work.curves, work.forces) != -1:
            return
        for at in range(rows.size * (stages.steps + 1)):
            if rows.live[at] != 0:
                change = -work.curves[at] * (row_change(at, stages) + row_residual(at, tried))
                for side in range(2):
                    dual = from_bound(at, side, rows)
                    other.slacks[at, side] = -SIGNS[side] * slacks[at, side] / dual * change
        longest_fraction, _ = longest(boundary(mem), tried.slacks, other, stages)
        cost = write_trial(longest_fraction, tried, stages.changes, other.slacks, work.closer, stages)
        if not isfinite(cost) or total_violation(work.closer, stages) > CLOSER * violated:
            return
        if not acceptable(fraction, work.closer, cost, stages, work, mem):
            return
        copy_point(work.closer, tried, stages)
        mem.tried = cost


def force_step(stages, work, mem):
    """A step for when the filter rejects every fraction of the last step: its fraction; -1 if there is none.

    It is the step of the projected Hessian; or, if the filter rejects that, a small fraction of it, better or not.
    """
    mem.forced += 1
    mem.convex_fraction = 1.0
    clear(work.corrections, stages.rows.size * (stages.steps + 1), 2)
    if mem.forced > FORCED or not solve(False, work.corrections, work.gaps, stages, work, mem):
        return -1.0
    mem.filter_rows = 0.0
    complete(False, work.corrections, work.step, stages, work, mem)
    fraction = search(False, stages, work, mem)
    if fraction >= 0:
        return fraction
    fraction, _ = longest(boundary(mem), work.now.slacks, work.step, stages)
    fraction *= FORCED_FRACTION
    mem.tried = write_trial(fraction, work.now, work.step.changes, work.step.slacks, work.tried, stages)
    return fraction if isfinite(mem.tried) else -1.0


def accept_step(fraction, stages, work, mem):
    """Go to the trial, with that fraction of the step in multipliers and costates."""
    rows, step, count = stages.rows, work.step, int(mem.filter_rows)
    work.filter[count, 0] = (1 - MARGIN) * mem.violated
    work.filter[count, 1] = mem.merit - MARGIN * mem.violated
    mem.filter_rows += 1
    mem.fraction = fraction
    if fraction >= LONG:
        mem.soft = max(1.0, mem.soft / SOFTER)
    _, dual = longest(boundary(mem), work.now.slacks, step, stages)
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            rows.force[at] += (fraction if regularised(at, rows) else dual) * step.force[at]
            if is_hard(at, rows):  # its product stays within a factor of the barrier parameter
                middle = mem.parameter / work.tried.slacks[at, LOWER]
                rows.force[at] = min(max(rows.force[at], middle / WIDE), WIDE * middle)
    for t in range(stages.steps + 1):
        for i in range(N):
            work.costates[t, i] += fraction * (step.costates[t, i] - work.costates[t, i])
    before, new, learns = mem.stationarity, work.tried.plan, stages.learns == 1 and mem.oldest == 0
    mem.age = mem.age + 1 if mem.age < mem.oldest else 0.0
    stages.reuses_derivatives[0] = 1.0 if mem.age > 0 else 0.0
    if learns:
        remember(stages, work.now.plan, new, work.costates, work.last_step, work.turns)
    go_to(work.tried, mem.tried, NEGLIGIBLE * mem.scale, stages, work, mem)
    if learns:
        learn(stages, work.costates, work.last_step, work.turns, fraction >= LONG and mem.stationarity > CRAWL * before)


def write_trial(fraction, about, changes, slacks, out, stages):
    """Write the point at a fraction of a step from a point; return its cost, NaN if it is not finite."""
    rows, steps, good = stages.rows, stages.steps, True
    for t in range(steps + 1):
        for i in range(N):
            out.plan.states[t, i] = about.plan.states[t, i] + fraction * changes.states[t, i]
        if t < steps:
            for i in range(M):
                out.plan.controls[t, i] = about.plan.controls[t, i] + fraction * changes.controls[t, i]
    cost = evaluate_plan(stages, out.plan, out.arrived)
    for t in range(steps):
        for i in range(N):
            good = good and isfinite(out.arrived[t, i])
    read_rows(stages, out.plan, out.numbers)
    for at in range(rows.size * (steps + 1)):
        if rows.live[at] != 0:
            good = good and isfinite(out.numbers[at])
            for side in range(2):
                out.slacks[at, side] = about.slacks[at, side] + fraction * slacks[at, side]
            if is_hard(at, rows):
                out.slacks[at, LOWER] = max(out.slacks[at, LOWER], out.numbers[at])
    return cost if good else nan


@inline
def is_hard(at, rows):
    """Whether a row is an inequality without a price."""
    return rows.kinds[at] != EQUALITY and not rows.prices[at] < inf


@inline
def row_residual(at, point):
    """A row's value minus its slacks."""
    return point.numbers[at] - (point.slacks[at, LOWER] - point.slacks[at, UPPER])


def total_violation(point, stages):
    """Total violation of dynamics and rows at a point, relative to their sizes."""
    rows, total = stages.rows, gap_of(point, stages)
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            total += abs(row_residual(at, point)) / rows.sizes[at]
    return total


def gap_of(point, stages):
    """The part of the violation that is due to the dynamics."""
    total = 0.0
    for t in range(stages.steps):
        for i in range(N):
            total += abs(point.arrived[t, i] - point.plan.states[t + 1, i]) / stages.state_size[i]
    return total


def merit_of(point, cost, stages, mem):
    """Cost plus prices plus barrier."""
    rows, logarithms, paid = stages.rows, 0.0, 0.0
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            for side in range(2):
                if has_slack(at, side, rows):
                    logarithms += log(point.slacks[at, side])
            if rows.prices[at] < inf:
                slack = point.slacks[at, LOWER] if rows.kinds[at] == EQUALITY else 0.0
                paid += rows.prices[at] * (point.slacks[at, UPPER] + slack)
    return cost + paid - mem.parameter * logarithms


def slope_of_merit(stages, work, mem):
    """Derivative of the merit along the step."""
    rows, step, slacks, slope = stages.rows, work.step, work.now.slacks, 0.0
    for t in range(stages.steps + 1):
        for i in range(N):
            slope += stages.models.gradient[t, i] * step.changes.states[t, i]
        if t < stages.steps:
            for i in range(M):
                slope += stages.models.gradient[t, N + i] * step.changes.controls[t, i]
    for at in range(rows.size * (stages.steps + 1)):
        for side in range(2):
            if rows.live[at] != 0 and has_slack(at, side, rows):
                price = rows.prices[at] if side == UPPER or rows.kinds[at] == EQUALITY else 0.0
                slope += (price - mem.parameter / slacks[at, side]) * step.slacks[at, side]
    return slope


def acceptable(fraction, point, cost, stages, work, mem):
    """Whether the filter accepts a trial."""
    violated, merit = total_violation(point, stages), merit_of(point, cost, stages, mem)
    before, slope = mem.violated, mem.slope
    if not isfinite(merit) or violated > mem.farthest or gap_of(point, stages) > mem.farthest_gap:
        return False
    for k in range(int(mem.filter_rows)):
        if violated > work.filter[k, 0] and merit > work.filter[k, 1]:
            return False
    small = NEARLY_FEASIBLE * max(1.0, PER_GAP * stages.steps * N)
    if before < small and slope < 0 and min(-fraction * slope, LARGEST_POWER) ** SWITCH > before**SWITCHED:
        return merit <= mem.merit + ARMIJO * fraction * slope + ROUNDING * abs(mem.merit)
    at_rest = violated < AT_REST and merit <= mem.merit + RESTING * abs(mem.merit)
    return violated <= (1 - MARGIN) * before or merit <= mem.merit - MARGIN * before or at_rest


# Points, and the models about them.


def copy_point(source, target, stages):
    """Copy a point."""
    count = stages.rows.size * (stages.steps + 1)
    copy_plan(stages.steps, source.plan, target.plan)
    copy_matrix(source.arrived, stages.steps, N, target.arrived)
    copy(source.numbers, count, target.numbers)
    copy_matrix(source.slacks, count, 2, target.slacks)


def go_to(point, cost, least, stages, work, mem):
    """Go to a point of this cost; its multipliers up to `least` count as zero in the models."""
    copy_point(point, work.now, stages)
    mem.cost = cost
    copy_matrix(point.arrived, stages.steps, N, stages.models.arrived)
    write_models(True, stages, work.now.plan, work.costates, least)
    measure_iterate(stages, work, mem)


def renew(stages, work, mem):
    """Compute the derivatives of the dynamics anew, about the iterate."""
    stages.reuses_derivatives[0], mem.age = 0.0, 0.0
    write_models(True, stages, work.now.plan, work.costates, NEGLIGIBLE * mem.scale)
    measure_iterate(stages, work, mem)


def go_back(stages, work, mem):
    """Go back to the point that was kept."""
    stages.reuses_derivatives[0], mem.age = 0.0, 0.0
    copy(work.kept_force, stages.rows.size * (stages.steps + 1), stages.rows.force)
    copy_matrix(work.kept_costates, stages.steps + 1, N, work.costates)
    go_to(work.kept, mem.kept, NEGLIGIBLE * mem.kept_scale, stages, work, mem)


def keep_point(stages, work, mem):
    """Keep the iterate."""
    copy_point(work.now, work.kept, stages)
    mem.kept, mem.kept_scale = mem.cost, mem.scale
    copy(stages.rows.force, stages.rows.size * (stages.steps + 1), work.kept_force)
    copy_matrix(work.costates, stages.steps + 1, N, work.kept_costates)


def measure_iterate(stages, work, mem):
    """Compute the measures of the iterate, about which the models are."""
    rows, slacks = stages.rows, work.now.slacks
    steepest, missing, unequal, widest, product = plan_residuals(stages, work.now.plan, work.now.numbers, work.gaps)
    # Measures are relative to the cost, or to a fraction of its typical size if its terms cancel.
    least = CANCELLED * mem.typical
    mem.scale = max(abs(mem.cost), least) if isfinite(mem.cost) else least
    mem.stationarity, mem.gap, mem.violation = steepest / mem.scale, widest, larger(larger(missing, unequal), 0.0)
    mem.miss, mem.product = 0.0, 0.0
    for at in range(rows.size * (stages.steps + 1)):
        if rows.live[at] != 0:
            mem.miss = larger(mem.miss, abs(row_residual(at, work.now)) / rows.sizes[at])
            for side in range(2):
                if has_slack(at, side, rows):
                    mem.product = larger(mem.product, slacks[at, side] * from_bound(at, side, rows))
    # The product of margin and multiplier; for violated elastic rows, that of the other slack.
    mem.complementarity = (mem.product if mem.elastic != 0 else product) / mem.scale


# Curvature from secants.

UNLEARNED = 1e-8  # least part of a residual along its step from which curvature is learned (Nocedal and Wright, (6.26))


def forget(stages):
    """Begin with nothing learned."""
    stages.uses_learned[0] = 0.0
    for t in range(stages.steps + 1):
        for i in range(W):
            fill(stages.models.learned[t, i], W, 0.0)


def remember(stages, before, after, costates, last_step, turns):
    """Before a step is taken, keep it, (T+1, W), and the Lagrangian's gradients at its beginning, (T+1, W).

    The Lagrangian is that of the multipliers after the step.
    """
    for t in range(stages.steps + 1):
        lagrangian_slope(t, stages, costates[min(t + 1, stages.steps)], turns[t])
        for i in range(N):
            last_step[t, i] = after.states[t, i] - before.states[t, i]
        for i in range(M):
            last_step[t, N + i] = after.controls[t, i] - before.controls[t, i] if t < stages.steps else 0.0


def learn(stages, costates, last_step, turns, slow):
    """Update what is learned, with the models at the end of the step; after a `slow` step, add it to the Hessians."""
    models, slope, lacks = stages.models, stack(W), stack(W)
    for t in range(stages.steps + 1):
        lagrangian_slope(t, stages, costates[min(t + 1, stages.steps)], slope)
        along, square, wide = 0.0, 0.0, 0.0
        for i in range(W):
            lacks[i] = slope[i] - turns[t, i]
            for j in range(W):
                known = models.hessian[t, i, j]
                if stages.uses_learned[0] == 0:
                    known += models.learned[t, i, j]
                lacks[i] -= known * last_step[t, j]
            along += lacks[i] * last_step[t, i]
            square += last_step[t, i] * last_step[t, i]
            wide += lacks[i] * lacks[i]
        if along * along > UNLEARNED * UNLEARNED * square * wide:
            for i in range(W):
                for j in range(W):
                    change = lacks[i] * lacks[j] / along
                    models.learned[t, i, j] += change
                    if stages.uses_learned[0] != 0:
                        models.hessian[t, i, j] += change
    if slow and stages.uses_learned[0] == 0:
        stages.uses_learned[0] = 1.0
        for t in range(stages.steps + 1):
            add_matrix(models.learned[t], W, models.hessian[t])


# The crossover from the barrier to the active set.

# Regularisation of active rows in the first step without a barrier. If a row couples controls, the curvature across it
# must exceed 1e-9 of its weight; the kernel treats less as rounding.
CROSSING = 1e-6
POLISHED = 1e-3  # fraction of the tolerances at which these steps end


def polish(tolerance, violation, begun, stages, work, mem):
    """Take steps without a barrier from the given plan and multipliers; return whether they converge."""
    rows, plan = stages.rows, work.active.plan
    keep_point(stages, work, mem)
    copy_plan(stages.steps, begun.plan, plan)
    cost = evaluate_plan(stages, plan, work.tried.arrived)
    read_rows(stages, plan, rows.numbers)
    for at in range(rows.size * (stages.steps + 1)):
        rows.force[at] = 0.0
        if rows.live[at] != 0:
            size, price = rows.sizes[at], rows.prices[at]
            rows.force[at] = min(max(begun.multipliers[at], -price), price)
            if rows.kinds[at] == LIMIT and rows.numbers[at] <= AT_LIMIT * size:
                rows.force[at] = AT_LIMIT * mem.scale / size
    if not isfinite(cost):
        go_back(stages, work, mem)
        return False
    write_models(False, stages, plan, work.active.costates, 0.0)
    return polish_rows(tolerance, violation, stages, work, mem)


def cross(tolerance, violation, stages, work, mem):
    """Cross over from the barrier to the active set: active rows become equalities. Return whether they were right.

    Controls then end exactly at their limits, and multipliers lose the barrier's contribution. Constraints keep a
    margin for rounding. If the rows were not right, the iterate is as before.
    """
    keep_point(stages, work, mem)
    copy_plan(stages.steps, work.now.plan, work.active.plan)
    copy(work.now.numbers, stages.rows.size * (stages.steps + 1), stages.rows.numbers)
    copy_matrix(work.costates, stages.steps + 1, N, work.active.costates)
    return polish_rows(tolerance, violation, stages, work, mem)


def polish_rows(tolerance, violation, stages, work, mem):
    """Take steps with the rows that press held at their targets, and write_trial where they converge, or else back.

    Returns whether they converge.
    """
    rows, active, active_mem = stages.rows, work.active, work.active_memory[0]
    for at in range(rows.size * (stages.steps + 1)):
        rows.held[at] = first_state(at, rows, mem) if rows.live[at] != 0 else FREE
        if rows.held[at] == FREE:
            rows.force[at] = 0.0
        elif rows.held[at] == PAID:
            rows.force[at] = copysign(rows.prices[at], rows.force[at])
    active_mem.typical = mem.typical
    active_mem.cost = write_models(True, stages, active.plan, active.costates, 0.0)
    measure_plan(violation, stages, active, active_mem)
    for k in range(CROSSINGS):
        # The first step may be long; with a weight as large as in the other steps, rounding would spoil it.
        softness, outcome = SOFTNESS if k > 0 else CROSSING, RUNNING
        prepare_step(stages, active, active_mem)
        while outcome == RUNNING:
            outcome = pivot(softness, stages, active, active_mem)
        if outcome == STALLED:
            break
        apply_step(violation, stages, active, active_mem)
        if not isfinite(active_mem.cost):
            break
        farthest = farthest_from_target(rows, stages.steps)
        if max(active_mem.stationarity, active_mem.gap) < POLISHED * tolerance and farthest < POLISHED * violation:
            break
    kept = mem.elastic != 0 or active_mem.violation <= violation
    if not isfinite(active_mem.cost) or not kept or not max(active_mem.stationarity, active_mem.gap) < tolerance:
        go_back(stages, work, mem)
        return False
    copy_plan(stages.steps, active.plan, work.now.plan)
    copy(rows.numbers, rows.size * (stages.steps + 1), work.now.numbers)
    copy_matrix(active.costates, stages.steps + 1, N, work.costates)
    mem.cost = active_mem.cost
    measure_iterate(stages, work, mem)
    return True


def first_state(at, rows, mem):
    """What a row does in the active set, by its value and multiplier."""
    number, force = rows.numbers[at], rows.force[at]
    size, price, equality = rows.sizes[at], rows.prices[at], rows.kinds[at] == EQUALITY
    if price < inf:
        violation = abs(number) if equality else -number
        if violation / size > 1 - abs(force) / price:
            return PAID
    return HELD if equality or force * size / mem.scale > number / size else FREE


@inline
def farthest_from_target(rows, steps):
    """The largest distance of a row that is held from its target."""
    largest = 0.0
    for at in range(rows.size * (steps + 1)):
        if rows.held[at] == HELD:
            largest = larger(largest, abs(rows.numbers[at] - rows.targets[at]))
    return largest

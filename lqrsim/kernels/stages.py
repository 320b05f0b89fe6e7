"""Quadratic models of all stages about a plan, and the step to their minimum; the plan need not satisfy the dynamics.

The gap between the end of a step and the next state is closed by the iterations. The rows are those of all constraints,
then the limits of the controls. To a model, a row of value d is `curve d^2 / 2 - force d`; each method has its own
curves and forces: see `interior_point.py`, `active_set.py` and `restoration.py`.
"""

from math import inf, sin, sqrt

from lqrsim.kernels.certificate import reduce_stage
from lqrsim.kernels.declarations import MIXES, ROWS, M, N, W, stack, zeros
from lqrsim.kernels.linear_algebra import (
    affine,
    cholesky,
    cholesky_solve,
    congruence,
    copy,
    copy_matrix,
    copy_part,
    entry,
    fill,
    set_entry,
)
from lqrsim.kernels.model_functions import (
    acts_at,
    advance,
    advance_all,
    all_steps_second_order,
    cost_of_order,
    cost_of_plan,
    cost_quadratic,
    evaluate_constraints,
    slope_of_constraint,
    step_second_order,
)
from lqrsim.kernels.passes import larger
from lqrsim.kernels.records import LinearStep, QuadraticStage
from lqrsim.kernels.riccati import add_cost_to_go, minimize_control

TINY = 1e-12  # least curvature that a control block must have, relative to the control's own
STEP = 6e-6  # step for differences of gradients, relative to a number or to 1: the cube root of the precision
PROBE_DISTANCE = 1e-3  # distance from a plan where gradients are evaluated, too: at the plan entries may vanish
# The size of a state that hardly moves is 1, or that of another in its unit if all move little or that moves far.
SMALLEST = 1e-3  # a state that moves less hardly moves; where none moves more, relative to what moves most
REST = 1e-12  # where none moves more, all motions are rounding errors
FAR = 100.0  # a state that moves more moves far
WIDE = 1e5  # limits this many times farther apart than what a control needs say nothing about its size
SLOWEST = 1e-6  # least effect of a control without limits, relative to the states' sizes

# The weights on changes of the controls, relative to the cost, that end the ladder of regularisation if no fraction of
# the projected Hessians gives the models a minimum.
WEIGHTS = (1e-6, 1e-3, 1.0, 1e3)

CONTROL, SIGN, SIDE, RANGE, LINEAR = 0, 1, 2, 3, 4  # columns of `StageRows.limits`
INEQUALITY, LIMIT, EQUALITY = 0.0, 1.0, 2.0  # kinds of rows


def write_models(known, stages, plan, costates, least):
    """Write the models of all stages at a plan, with costates (T+1, N), and return its cost.

    Multipliers up to `least`, times the sizes of their rows, count as zero in the Hessians. Unless the costates are
    `known`, they are computed from this plan and the multipliers of its rows.
    """
    constraint_slopes(stages, plan)
    stages.projected[0] = 0.0
    total, slope, out = 0.0, stack(W), stages.models
    for t in range(stages.steps, -1, -1):
        total += cost_model(t, stages, plan)
    anew = stages.reuses_derivatives[0] == 0
    if known and anew:
        all_steps_second_order(stages.steps, plan, stages.model, costates, out.arrived, out.jacobian, out.hessian)
    for t in range(stages.steps, -1, -1):
        if anew and t < stages.steps:
            if not known:
                x, u = plan.states[t], plan.controls[t]
                step_second_order(x, u, stages.model, costates[t + 1], out.arrived[t], out.jacobian[t], out.hessian[t])
            cut_at_jump(t, stages, plan, out.arrived, out.jacobian[t])
        add_curvatures(t, stages, plan, least)
        if not known and t > 0:
            lagrangian_slope(t, stages, costates[min(t + 1, stages.steps)], slope)
            copy(slope, N, costates[t])
    return total + add_initial(plan.states[0], stages)


def cost_model(t, stages, plan):
    """Write the model of the cost at t, and return the cost."""
    none, model, out = zeros(M), stages.model, stages.models
    if t < stages.steps:
        return cost_of_order(plan.states[t], plan.controls[t], t, model.stage, 1.0, out.hessian[t], out.gradient[t])
    return cost_of_order(plan.states[t], none, t, model.final, 1.0, out.hessian[t], out.gradient[t])


def add_curvatures(t, stages, plan, least):
    """Add the Hessians of the constraints at t, after `constraint_slopes`, and what is learned of the step's."""
    out, u = stages.models, plan.controls[min(t, stages.steps - 1)]
    subtract_curvatures(plan.states[t], u, t, stages, least, out.hessian[t])
    if stages.uses_learned[0] != 0:
        add_matrix(out.learned[t], W, out.hessian[t])


def add_matrix(matrix, size, out):
    """Add a square matrix."""
    for i in range(size):
        for j in range(size):
            out[i, j] += matrix[i, j]


def project(stages, plan):
    """Write the projected Hessians (T+1, W, W) of the cost at a plan, unless they are known."""
    if stages.projected[0] != 0:
        return
    gradient, none, hessian, model, convex = stack(W), zeros(M), stack(W, W), stages.model, stages.models.convex
    for t in range(stages.steps):
        cost_quadratic(plan.states[t], plan.controls[t], t, model.stage, convex[t], gradient)
    cost_quadratic(plan.states[stages.steps], none, stages.steps, model.final, convex[stages.steps], gradient)
    cost_quadratic(plan.states[0], none, 0, model.initial, hessian, gradient)
    add_matrix(hessian, N, convex[0])
    stages.projected[0] = 1.0


def add_initial(x, stages):
    """Add the initial cost to the first stage; return its value."""
    hessian, gradient, none, out = stack(W, W), stack(W), zeros(M), stages.models
    cost = cost_of_order(x, none, 0, stages.model.initial, 1.0, hessian, gradient)
    for i in range(N):
        out.gradient[0, i] += gradient[i]
    add_matrix(hessian, N, out.hessian[0])
    return cost


def constraint_slopes(stages, plan):
    """Write the gradients ((T+1) size, W) of all constraints, and the entries that they depend on."""
    constraints, rows = stages.model.stage.constraints, stages.rows
    for t in range(stages.steps + 1):
        x, u = plan.states[t], plan.controls[min(t, stages.steps - 1)]
        for k in range(constraints.size):
            acts = acts_at(k, t, stages.steps, constraints)
            for row in range(int(constraints.multipliers[k][ROWS])):
                place = int(rows.first[k]) + row
                slope = stages.models.slopes[rows.size * t + place]
                fill(slope, W, 0.0)
                if acts:
                    slope_of_constraint(k, row, x, u, t, constraints, slope)
                for i in range(W):
                    if slope[i] != 0:
                        rows.support[place, i] = 1.0


def subtract_curvatures(x, u, t, stages, least, hessian):
    """Subtract from a Hessian (W, W) the Hessians of all constraints at a step, times their multipliers."""
    constraints, rows = stages.model.stage.constraints, stages.rows
    for k in range(constraints.size):
        if not acts_at(k, t, stages.steps, constraints):
            continue
        for row in range(int(constraints.multipliers[k][ROWS])):
            at = rows.size * t + int(rows.first[k]) + row
            linear = rows.limits[int(rows.first[k]) + row, LINEAR] != 0
            if not linear and abs(rows.force[at]) * rows.sizes[at] > least:
                subtract_curvature(k, row, x, u, t, constraints, rows, hessian)


def subtract_curvature(k, row, x, u, t, constraints, rows, hessian):
    """Subtract the Hessian of one value of a constraint times its multiplier, by differences of its gradient."""
    place = int(rows.first[k]) + row
    weight = rows.force[rows.size * t + place]
    y, v, above, below = stack(N), stack(M), stack(W), stack(W)
    copy(x, N, y)
    copy(u, M, v)
    for j in range(W):
        if rows.support[place, j] == 0:
            continue
        z = entry(x, u, j)
        h = STEP * max(1.0, abs(z))
        fill(above, W, 0.0)
        fill(below, W, 0.0)
        set_entry(y, v, j, z + h)
        slope_of_constraint(k, row, y, v, t, constraints, above)
        set_entry(y, v, j, z - h)
        slope_of_constraint(k, row, y, v, t, constraints, below)
        set_entry(y, v, j, z)
        for i in range(W):
            half = 0.5 * weight * (above[i] - below[i]) / (2 * h)
            hessian[i, j] -= half
            hessian[j, i] -= half


def evaluate_plan(stages, plan, arrived):
    """Write the state after each step of a plan, (T, N), and return the plan's cost."""
    advance_all(stages.steps, plan, stages.model, arrived)
    for t in range(stages.steps):
        cut_at_jump(t, stages, plan, arrived, stages.models.jacobian[t])
    return cost_of_plan(stages.steps, plan, stages.model)


def cut_at_jump(t, stages, plan, arrived, jacobian):
    """If the last state jumps after step t: no gap, and no dependence on the step."""
    if stages.jumps[t + 1] != 0:
        arrived[t, N - 1] = plan.states[t + 1, N - 1]
        fill(jacobian[N - 1], W, 0.0)


def read_rows(stages, plan, numbers):
    """Write the values of all rows, ((T+1) size,); those of rows that do not act are undefined."""
    constraints, rows, values = stages.model.stage.constraints, stages.rows, stages.values
    evaluate_constraints(stages.steps, plan.states, plan.controls, constraints, values)
    for t in range(stages.steps + 1):
        u = plan.controls[min(t, stages.steps - 1)]
        for k in range(constraints.size):
            count = int(constraints.multipliers[k][ROWS])
            for row in range(count):
                numbers[rows.size * t + int(rows.first[k]) + row] = values[k][count * t + row]
        for row in range(rows.size):
            at = rows.size * t + row
            if rows.kinds[at] == LIMIT:
                number = u[int(rows.limits[row, CONTROL])] - rows.limits[row, SIDE]
                numbers[at] = rows.limits[row, SIGN] * number


def determine_scales(stages, plan):
    """Determine which rows act, and typical sizes, from a plan and the models about it; return the typical cost.

    Which entries a row depends on is determined from slopes at the plan and near it.
    """
    rows, probed = stages.rows, stages.changes
    read_rows(stages, plan, rows.numbers)
    for at in range(rows.size * (stages.steps + 1)):
        # Infinity means that the constraint does not act at that step.
        rows.live[at] = 0.0 if rows.numbers[at] == inf else rows.acts[at]
        rows.force[at] = 0.0
    for t in range(stages.steps + 1):
        for i in range(N):
            probed.states[t, i] = plan.states[t, i] + PROBE_DISTANCE * sin(1.0 + i)
        if t < stages.steps:
            for i in range(M):
                probed.controls[t, i] = plan.controls[t, i] + PROBE_DISTANCE * sin(1.0 + N + i)
        fill(stages.to_go.gradient[t], N, 0.0)
    constraint_slopes(stages, probed)
    write_models(True, stages, plan, stages.to_go.gradient, inf)
    project(stages, plan)
    return typical_sizes(stages, plan, stages.models.convex)


def typical_sizes(stages, plan, hessian):
    """Write typical sizes of states, controls and rows; return the cost of such changes, by Hessians (T+1, W, W) of it.

    The size of a control without limits, or with very wide ones, is the change that moves a state by its typical size.
    """
    steps, rows, models = stages.steps, stages.rows, stages.models
    moves, farthest = stack(N), 0.0
    for i in range(N):
        least, most = plan.states[0, i], plan.states[0, i]
        for t in range(1, steps + 1):
            least, most = min(least, plan.states[t, i]), max(most, plan.states[t, i])
        moves[i] = max(most - least, stages.reach[i])
        farthest = max(farthest, moves[i])
    small = farthest > REST and farthest < SMALLEST
    least = SMALLEST * farthest if small else SMALLEST
    for i in range(N):
        most = 0.0
        for j in range(N):
            most = max(most, moves[j]) if stages.unit[j] == stages.unit[i] else most
        rest = most if most > FAR or (small and most > least) else 1.0
        stages.state_size[i] = moves[i] if moves[i] > least else rest
    for j in range(M):
        effect, largest = 0.0, 0.0
        for i in range(N):
            row_change = 0.0
            for t in range(steps):
                row_change += abs(models.jacobian[t, i, N + j])
            effect = max(effect, row_change / stages.state_size[i])
        for t in range(steps):
            largest = max(largest, abs(plan.controls[t, j]))
        span = stages.model.limits.high[j] - stages.model.limits.low[j]
        wide = span == inf or (span * effect > WIDE and span > WIDE * largest)
        stages.control_size[j] = max(1 / max(effect, SLOWEST), largest) if wide else span
    for row in range(rows.size):
        total, count = 0.0, 0.0
        for t in range(steps + 1):
            at = rows.size * t + row
            count += rows.live[at]
            for i in range(W):
                span = models.slopes[at, i] * entry(stages.state_size, stages.control_size, i)
                total += span * span
        size = sqrt(total / max(count, 1.0)) if total > 0 else 1.0
        size = min(size, rows.limits[row, RANGE])
        for t in range(steps + 1):
            rows.sizes[rows.size * t + row] = size
    cost = 0.0
    for t in range(steps + 1):
        for i in range(W):
            size = entry(stages.state_size, stages.control_size, i)
            cost += 0.5 * abs(hessian[t, i, i]) * size * size
    return cost if cost > 0 and cost < inf else 1.0


def lagrangian_slope(t, stages, after, slope):
    """Write the gradient (W,) of the Lagrangian in state and control at t, given the costate (N,) at t + 1."""
    models, rows = stages.models, stages.rows
    copy(models.gradient[t], W, slope)
    if t < stages.steps:
        for j in range(N):
            for i in range(W):
                slope[i] += models.jacobian[t, j, i] * after[j]
    for row in range(rows.size):
        at = rows.size * t + row
        if rows.force[at] != 0:
            for i in range(W):
                slope[i] -= rows.force[at] * models.slopes[at, i]


def adjoint(stages, costates, slopes):
    """Write the costates (T+1, N) and the gradient in the controls (T, M) of the Lagrangian.

    Controls respond by the gains of the policy. At a stationary plan that changes nothing but rounding, which does not
    grow then where dynamics are unstable.
    """
    slope = stack(W)
    for t in range(stages.steps, -1, -1):
        lagrangian_slope(t, stages, costates[min(t + 1, stages.steps)], slope)
        if t < stages.steps:
            copy_part(slope, N, slopes[t], 0, M)
            for i in range(M):
                for j in range(N):
                    slope[j] += stages.policy.gain[t, i, j] * slopes[t, i]
        copy(slope, N, costates[t])


def plan_residuals(stages, plan, numbers, gaps):
    """Measure the optimality of the plan of the models, whose rows have these values; write its gaps (T, N).

    Returns:
      The largest derivative of the Lagrangian in a control, a free start or a jump, times its size; the largest
      violation of an inequality, negative if all are satisfied; the largest violation of an equality; the largest gap,
      relative to the state's size; and the largest product of a multiplier and the value of its inequality, if that has
      no price.
    """
    slope, after, rows = stack(W), stack(N), stages.rows
    steepest, missed, unequal, widest, product = 0.0, -inf, 0.0, 0.0, 0.0
    for t in range(stages.steps, -1, -1):
        lagrangian_slope(t, stages, after, slope)
        copy(slope, N, after)
        if t < stages.steps:
            for i in range(M):
                steepest = larger(steepest, abs(slope[N + i]) * stages.control_size[i])
            if t > 0 and stages.jumps[t] != 0:
                steepest = larger(steepest, abs(after[N - 1]) * stages.state_size[N - 1])
            for i in range(N):
                gaps[t, i] = stages.models.arrived[t, i] - plan.states[t + 1, i]
                widest = larger(widest, abs(gaps[t, i]) / stages.state_size[i])
        for row in range(rows.size):
            at = rows.size * t + row
            if rows.live[at] == 0:
                continue
            if rows.kinds[at] == EQUALITY:
                unequal = larger(unequal, abs(numbers[at]))
            else:
                missed = larger(missed, -numbers[at])
                if not rows.prices[at] < inf:
                    product = larger(product, abs(numbers[at]) * rows.force[at])
    for i in range(N):
        steepest = larger(steepest, abs(after[i]) * stages.state_size[i] * stages.free[i])
    return steepest, missed, unequal, widest, product


def direction(stages, plan, gaps, convex_fraction, weight, base, curves, forces):
    """The step to the minimum of the stages' models, with weights on their rows.

    The change of the plan is written to `stages.changes`, the policy relative to the plan to `stages.policy`, and the
    costates after the step to the gradient of `stages.to_go`.

    Args:
      plan: that of the models. gaps: (T, N), to be closed. convex_fraction: that of the projected Hessian of the cost.
      weight: twice the cost of a change of a control by its typical size. base: 1, or 0 to leave out the gradient of
        the cost.
      curves, forces: ((T+1) size,) for each row d that acts, `1/2 curve d^2 - force d` is added; zero for others.

    Returns:
      The step whose control block is not positive definite; T + 1 for the start, -1 if there is a minimum.
    """
    stage, slope, steps, models, to_go = stack(W, W), stack(W), stages.steps, stages.models, stages.to_go
    if convex_fraction > 0:
        project(stages, plan)
    for t in range(steps, -1, -1):
        for i in range(W):
            slope[i] = base * models.gradient[t, i]
        blend(convex_fraction, models.hessian[t], models.convex[t], stage)
        for i in range(M):
            size = stages.control_size[i]
            stage[N + i, N + i] += weight / (size * size)
        add_rows(t, stages, curves, forces, stage, slope)
        if t == steps:
            copy(slope, N, to_go.gradient[steps])
            copy_matrix(stage, N, N, to_go.hessian[steps])
        elif not riccati_step(t, stage, slope, models.jacobian[t], gaps[t], stages.policy, to_go):
            return t
        if t > 0 and stages.jumps[t] != 0 and not jump_law(to_go.hessian[t], to_go.gradient[t], stages.reset[t]):
            return t
    return -1 if forward_sweep(stages, gaps) else steps + 1


def regularised_direction(stages, plan, gaps, weight, scale, curves, forces):
    """Raise the regularisation until the models have a minimum; return its level, -1 if none suffices.

    The weights on changes of the controls are relative to `scale`, and added to `weight`; the rest as in `direction`.
    """
    for rung in range(len(MIXES) + len(WEIGHTS)):
        more = weight + (WEIGHTS[rung - len(MIXES)] if rung >= len(MIXES) else 0.0) * scale
        if direction(stages, plan, gaps, convex_fraction_at(rung), more, 1.0, curves, forces) == -1:
            return rung
    return -1


def convex_fraction_at(rung):
    """The fraction of the projected Hessian at a rung of the ladder."""
    return MIXES[rung] if rung < len(MIXES) else 1.0


def blend(convex_fraction, one, other, out):
    """Write (1 - f) one + f other, (W, W), with f the convex fraction."""
    for i in range(W):
        for j in range(W):
            if convex_fraction == 0:
                out[i, j] = one[i, j]
            elif convex_fraction == 1:
                out[i, j] = other[i, j]
            else:
                out[i, j] = (1 - convex_fraction) * one[i, j] + convex_fraction * other[i, j]


def add_rows(t, stages, curves, forces, stage, slope):
    """Add `curve d^2 / 2 - force d` of each row of a step to its model."""
    slopes = stages.models.slopes
    for row in range(stages.rows.size):
        at = stages.rows.size * t + row
        curve, force = curves[at], forces[at]
        if curve == 0 and force == 0:
            continue
        for i in range(W):
            entry = slopes[at, i]
            if entry != 0:
                slope[i] -= force * entry
                for j in range(W):
                    stage[i, j] += curve * entry * slopes[at, j]


def row_change(at, stages):
    """The change of a row's value by the step in `stages.changes`."""
    t, slope, changes, total = at // stages.rows.size, stages.models.slopes[at], stages.changes, 0.0
    for i in range(N):
        total += slope[i] * changes.states[t, i]
    if t < stages.steps:
        for i in range(M):
            total += slope[N + i] * changes.controls[t, i]
    return total


def riccati_step(t, stage, slope, jacobian, gap, policy, to_go):
    """Write gains and cost-to-go at t so that the gap closes; return whether the control block is definite.

    The stage, which is overwritten, the cost-to-go and the policy's offsets are in deviations from the plan.
    """
    least, block = stack(M), stack(M, M)
    for i in range(M):
        least[i] = TINY * abs(stage[N + i, N + i])
    add_cost_to_go(t, LinearStep(jacobian, gap), QuadraticStage(stage, slope), 0.0, to_go)
    for i in range(M):
        copy_part(stage[N + i], N, block[i], 0, M)
        block[i, i] -= least[i]
    if not cholesky(block, M):
        return False
    return minimize_control(stage, slope, policy.gain[t], policy.offset[t], to_go.hessian[t], to_go.gradient[t]) >= 0


def forward_sweep(stages, gaps):
    """Write the changes of the plan that the policy makes, and the costates after them, as gradients of the cost-to-go.

    Returns whether the change of the start has a minimum.
    """
    policy, to_go, changes, jacobian = stages.policy, stages.to_go, stages.changes, stages.models.jacobian
    if not start_change(stages.free, to_go, changes.states[0]):
        return False
    for t in range(stages.steps):
        affine(policy.gain[t], policy.offset[t], changes.states[t], M, N, changes.controls[t])
        for i in range(N):
            total = gaps[t, i]
            for j in range(N):
                total += jacobian[t, i, j] * changes.states[t, j]
            for j in range(M):
                total += jacobian[t, i, N + j] * changes.controls[t, j]
            changes.states[t + 1, i] = total
        if stages.jumps[t + 1] != 0:
            law, total = stages.reset[t + 1], stages.reset[t + 1, N]
            for i in range(N - 1):
                total += law[i] * changes.states[t + 1, i]
            changes.states[t + 1, N - 1] = total
    for t in range(stages.steps + 1):
        for i in range(N):
            for j in range(N):
                to_go.gradient[t, i] += to_go.hessian[t, i, j] * changes.states[t, j]
    return True


def jump_law(hessian, gradient, law):
    """Eliminate the last state: write its best change as an affine function (N+1,) of the others.

    The cost-to-go becomes that of the others. Returns whether there is a best change.
    """
    last = N - 1
    curve = hessian[last, last]
    if not curve > 0:
        return False
    for i in range(last):
        law[i] = -hessian[last, i] / curve
    law[last], law[N] = 0.0, -gradient[last] / curve
    for i in range(last):
        gradient[i] += law[i] * gradient[last]
        for j in range(last):
            hessian[i, j] += law[i] * hessian[last, j]
    gradient[last] = 0.0
    for i in range(N):
        hessian[i, last], hessian[last, i] = 0.0, 0.0
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


def closed_loop_rollout(fraction, plan, stages, limits, out):
    """Roll out a fraction of the step that `direction` found, with its gains closing the loop.

    Args:
      plan: a Motion that satisfies the dynamics. limits: limits of the controls at each step, (T, M) each.
      out: Motion, written.
    """
    policy, model = stages.policy, stages.model
    copy(plan.states[0], N, out.states[0])
    for t in range(stages.steps):
        for i in range(M):
            total = plan.controls[t, i] + fraction * policy.offset[t, i]
            for j in range(N):
                total += policy.gain[t, i, j] * (out.states[t, j] - plan.states[t, j])
            out.controls[t, i] = min(max(total, limits.low[t, i]), limits.high[t, i])
        advance(out.states[t], out.controls[t], model, model.dt, out.states[t + 1])


def least_curvatures(stages, curves, held, least):
    """Write the least curvatures (M,) of the controls along a plan, with later controls optimised out.

    Returns whether the reduced Hessian is positive definite.

    Args:
      stages: PlanStages; the Hessians of their models are used. curves: ((T+1) size,) weights on rows that are held.
      held: (T, M), not 0 for a control that stays at its limit.
    """
    S, stage, none, steps, models = stack(N, N), stack(W, W), zeros(W), stages.steps, stages.models
    slope, law = zeros(W), stack(N + 1)
    fill(least, M, inf)
    for t in range(steps, -1, -1):
        copy_matrix(models.hessian[t], W, W, stage)
        add_rows(t, stages, curves, curves, stage, slope)
        if t == steps:
            copy_matrix(stage, N, N, S)
            continue
        congruence(models.jacobian[t], S, none, stage, zeros(W))
        for i in range(M):
            if held[t, i] != 0:
                for j in range(W):
                    stage[N + i, j], stage[j, N + i] = 0.0, 0.0
                stage[N + i, N + i] = inf
        if not reduce_stage(stage, least, S):
            return False
        if t > 0 and stages.jumps[t] != 0 and not jump_law(S, none, law):
            return False
    for i in range(N):
        for j in range(N):
            S[i, j] *= stages.free[i] * stages.free[j]
        if stages.free[i] == 0:
            S[i, i] = 1.0
    return cholesky(S, N)

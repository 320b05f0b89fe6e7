"""Calls of a problem's functions by address: dynamics, costs, constraints, noise.

Passes and iterations are therefore compiled once per size, and serve all problems of that size. See
`records.ProblemModel`.
"""

from lqrsim.kernels.declarations import FIRST, HESSIANS, STATES, M, N, W, call, call_for_value, compact, stack, zeros
from lqrsim.kernels.linear_algebra import clear, copy, copy_matrix, fill, step_offset
from lqrsim.kernels.records import NextStep

VALUE, DERIVATIVES = 0, 1  # columns of `CostModel.functions`
# Columns of `Constraints.functions`.
AUGMENT, AUGMENTATION, VALUES, SLOPE, USES_CONTROL = 0, 1, 2, 3, 4

# The arguments of functions that are called by their addresses, and the fields of the records among them, which are
# passed field by field. Arrays are vectors, or have rows of N or W.
SIGNATURES = {
    "advance": "x u p h:float out",
    "step_jacobian": "x u p h:float out jacobian:W",
    "step_curvature": "x u p h:float weights out jacobian:W hessian:W",
    "all_steps": "what:int steps:int states controls p h:float costates arrived jacobian hessian",
    "value": "x u t:int data",
    "derivatives": "x u t:int data hessian:W gradient",
    "project": "hessian:W",
    "augment": "x u t:int data multipliers hessian:W gradient",
    "augmentation": "x u t:int data multipliers",
    "constraint_values": "x u t:int acts:int data multipliers values",
    "add_slope": "x u t:int row:int data gradient",
    "noise_value": "x u data risk next_step:NextStep",
    "noise_quadratic": "x u data risk next_step:NextStep convex:int stage:QuadraticStage",
    "measure": "x data out",
    "measure_slope": "x data out:N",
    "NextStep": "jacobian:W arrived hessian:N gradient",
    "QuadraticStage": "hessian:W gradient",
}


def advance(x, u, model, h, out):
    """Write the state (N,) after `h` seconds with the control held."""
    call(model.dynamics.advance, x, u, model.dynamics.parameters, h, out)


def step_jacobian(x, u, model, h, out, jacobian):
    """Write the state after `h` seconds (N,), and its Jacobian [A B] (N, W)."""
    call(model.dynamics.step_jacobian, x, u, model.dynamics.parameters, h, out, jacobian)


def linearize_forward(x, u, model, arrived, step):
    """Write the next state (N,), and the step linearised at (x, u), Eq. (25): x_next = jacobian (x, u) + offset."""
    step_jacobian(x, u, model, model.dt, arrived, step.jacobian)
    step_offset(step.jacobian, x, u, arrived, step.offset)


def step_second_order(x, u, model, weights, out, jacobian, hessian):
    """Write the next state and its Jacobian; add the Hessian (W, W) of the next state times weights (N,)."""
    dynamics = model.dynamics
    if dynamics.step_curvature != 0:
        call(dynamics.step_curvature, x, u, dynamics.parameters, model.dt, weights, out, jacobian, hessian)
    else:
        step_jacobian(x, u, model, model.dt, out, jacobian)


def advance_all(steps, plan, model, arrived):
    """Write the state after each step of a plan, (T, N)."""
    dynamics, none = model.dynamics, arrived  # any array stands for what STATES does not need
    if dynamics.all_steps != 0:
        p = dynamics.parameters
        call(dynamics.all_steps, STATES, steps, plan.states, plan.controls, p, model.dt, none, arrived, none, none)
        return
    for t in range(steps):
        advance(plan.states[t], plan.controls[t], model, model.dt, arrived[t])


def all_steps_second_order(steps, plan, model, costates, arrived, jacobian, hessian):
    """As `step_second_order`, for all steps of a plan: arrived (T, N), jacobian (T, N, W), hessian (T+1, W, W).

    The weights of the next states are costates[1:].
    """
    x, u, dynamics = plan.states, plan.controls, model.dynamics
    if dynamics.all_steps != 0:
        p = dynamics.parameters
        call(dynamics.all_steps, HESSIANS, steps, x, u, p, model.dt, costates, arrived, jacobian, hessian)
        return
    for t in range(steps):
        step_second_order(x[t], u[t], model, costates[t + 1], arrived[t], jacobian[t], hessian[t])


def cost_value(x, u, t, cost):
    """The cost c(x, u, t)."""
    total = 0.0
    for k in range(cost.size):
        total += call_for_value(cost.functions[k, VALUE], x, u, t, cost.data[k])
    return total


def cost_of_plan(steps, plan, model):
    """The cost of a plan, without noise."""
    none = zeros(M)
    total = cost_value(plan.states[0], none, 0, model.initial)
    for t in range(steps):
        total += cost_value(plan.states[t], plan.controls[t], t, model.stage)
    return total + cost_value(plan.states[steps], none, steps, model.final)


def cost_added(x, u, t, cost):
    """The value of the augmented Lagrangian's terms for constraints."""
    total, constraints = 0.0, cost.constraints
    for k in range(constraints.size):
        total += call_for_value(
            constraints.functions[k, AUGMENTATION], x, u, t, constraints.data[k], constraints.multipliers[k]
        )
    return total


def cost_quadratic(x, u, t, cost, hessian, gradient):
    """As `cost_of_order`, of the convex model."""
    return cost_of_order(x, u, t, cost, 0.0, hessian, gradient)


def cost_of_order(x, u, t, cost, second_order, hessian, gradient):
    """Write the quadratic model of a cost and its augmented Lagrangian at (x, u); return the value.

    The Hessian (W, W) is second_order H + (1 - second_order) H+. In H+ the sum of the terms that may be indefinite is
    projected to the nearest positive-semidefinite matrix.
    """
    value = cost_alone(x, u, t, cost, second_order, hessian, gradient)
    return value + augment_cost(x, u, t, cost, hessian, gradient)


def cost_alone(x, u, t, cost, second_order, hessian, gradient):
    """As `cost_of_order`, without the augmented Lagrangian."""
    total, projected = 0.0, stack(W, W)
    clear(hessian, W, W)
    fill(gradient, W, 0.0)
    for k in range(cost.size):
        total += call_for_value(cost.functions[k, DERIVATIVES], x, u, t, cost.data[k], hessian, gradient)
        if k + 1 == cost.indefinite and cost.project != 0:
            if second_order == 0:
                call(cost.project, hessian)
            elif second_order < 1:
                copy_matrix(hessian, W, W, projected)
                call(cost.project, projected)
                for i in range(W):
                    for j in range(W):
                        hessian[i, j] = second_order * hessian[i, j] + (1 - second_order) * projected[i, j]
    return total


def augment_cost(x, u, t, cost, hessian, gradient):
    """Add the quadratic model of the augmented Lagrangian's terms for constraints; return their value."""
    total, constraints = 0.0, cost.constraints
    for k in range(constraints.size):
        total += call_for_value(
            constraints.functions[k, AUGMENT],
            x, u, t, constraints.data[k], constraints.multipliers[k], hessian, gradient,
        )  # fmt: skip
    return total


def evaluate_constraints(steps, states, controls, constraints, values):
    """Write the values of all constraints along a plan, each in the order of its multipliers."""
    for t in range(steps + 1):
        u = controls[min(t, steps - 1)]
        for k in range(constraints.size):
            acts = acts_at(k, t, steps, constraints)
            call(
                constraints.functions[k, VALUES],
                states[t], u, t, acts, constraints.data[k], constraints.multipliers[k], values[k],
            )  # fmt: skip


def acts_at(k, t, steps, constraints):
    """Whether constraint k acts at a step; those of the control do not at the last one, which has none."""
    return t >= constraints.multipliers[k][FIRST] and not (t == steps and constraints.functions[k, USES_CONTROL] != 0)


def slope_of_constraint(which, row, x, u, t, constraints, gradient):
    """Add the gradient (W,) of one value of one constraint."""
    call(constraints.functions[which, SLOPE], x, u, t, row, constraints.data[which], gradient)


def noise_value(x, u, t, noise, next_step):
    """The expected cost of noise at (x, u); see `problem/noise.py`.

    The cost-to-go that weighs it is that of `next_step`, the rest of the problem after step t; or, with constraints, a
    given one.
    """
    hessian = noise.hessian[t + 1] if noise.risk[2] > 0 else next_step.hessian
    gradient = noise.gradient[t + 1] if noise.risk[2] > 0 else next_step.gradient
    weighed = NextStep(next_step.jacobian, next_step.arrived, hessian, gradient)
    return call_for_value(noise.value, x, u, noise.data, noise.risk, weighed)


def noise_quadratic(x, u, t, noise, next_step, convex, stage):
    """Add the quadratic model of that cost to a stage; return its value."""
    hessian = noise.hessian[t + 1] if noise.risk[2] > 0 else next_step.hessian
    gradient = noise.gradient[t + 1] if noise.risk[2] > 0 else next_step.gradient
    weighed = NextStep(next_step.jacobian, next_step.arrived, hessian, gradient)
    return call_for_value(noise.quadratic, x, u, noise.data, noise.risk, weighed, convex, stage)


def costs_of(count, steps, plans, model, costs):
    """Write the sum of stage and final costs, (count,), of trajectories that are stored one after the other.

    Args:
      plans: Motion with states (count (steps + 1), N) and controls (count steps, M).
    """
    for k in range(count):
        costs[k] = 0.0
        for t in range(steps):
            x, u = plans.states[k * (steps + 1) + t], plans.controls[k * steps + t]
            costs[k] += cost_value(x, u, t, model.stage)
        last = plans.controls[(k + 1) * steps - 1]
        costs[k] += cost_value(plans.states[(k + 1) * (steps + 1) - 1], last, steps, model.final)


def cost_of_each(count, t, plans, cost, costs):
    """Write a cost at step t, (count,), of states (count, N) and controls (count, M)."""
    for k in range(count):
        costs[k] = cost_value(plans.states[k], plans.controls[k], t, cost)


@compact
def states_within(steps, parts, again, plan, model, out):
    """Write the states (steps parts, N) at the ends of `parts` equal parts of each period, with the controls held.

    Args:
      again: whether each period begins at the plan's knot; else where the last one ended.
    """
    z = stack(N)
    for t in range(steps):
        if again or t == 0:
            copy(plan.states[t], N, z)
        for k in range(parts):
            advance(z, plan.controls[t], model, model.dt / parts, out[t * parts + k])
            copy(out[t * parts + k], N, z)

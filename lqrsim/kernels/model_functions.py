"""What a problem brings, called at its addresses: dynamics, costs, constraints, noise.

So the passes and iterations are compiled once for a size, and serve all problems of it. See `records.ProblemModel`; the
C signatures are in `codegen/compiled_module.py`.
"""

from lqrsim.kernels.declarations import W, call, call_for_value, stack
from lqrsim.kernels.linear_algebra import clear

VALUE, DERIVATIVES = 0, 1  # columns of `CostModel.functions`
# Those of `Constraints.functions`; CURVATURE is the place of second derivatives against multipliers, 0 where there are
# none.
AUGMENT, AUGMENTATION, VALUES, SLOPE, CURVATURE, USES_CONTROL = 0, 1, 2, 3, 4, 5


def advance(x, u, model, h, out):
    """Write where a control held for `h` seconds leads from x, (N,)."""
    call(model.dynamics.advance, x, u, model.dynamics.parameters, h, out)


def step_jacobian(x, u, model, h, out, jacobian):
    """Write this, and the Jacobian [A B] (N, W)."""
    call(model.dynamics.step_jacobian, x, u, model.dynamics.parameters, h, out, jacobian)


def cost_value(x, u, t, cost):
    """A cost c(x, u, t)."""
    total = 0.0
    for k in range(cost.size):
        total += call_for_value(cost.functions[k, VALUE], x, u, t, cost.data[k])
    return total


def cost_added(x, u, t, cost):
    """What the augmented Lagrangian adds to it for constraints."""
    total, constraints = 0.0, cost.constraints
    for k in range(constraints.size):
        total += call_for_value(
            constraints.functions[k, AUGMENTATION], x, u, t, constraints.data[k], constraints.multipliers[k]
        )
    return total


def cost_quadratic(x, u, t, cost, hessian, gradient):
    """Write the Hessian (W, W) and the gradient (W,) of a cost with what is added, at (x, u); return its value.

    The sum of what may be indefinite is projected to the nearest positive-semidefinite matrix; what is convex is added
    after.
    """
    return cost_of_order(x, u, t, cost, 0.0, hessian, gradient)


def cost_of_order(x, u, t, cost, share, hessian, gradient):
    """The same with a Hessian that is that share of the way from the projected one to the true one."""
    own = cost_alone(x, u, t, cost, share, hessian, gradient)
    return own + augment_cost(x, u, t, cost, hessian, gradient)


def cost_alone(x, u, t, cost, share, hessian, gradient):
    """The same without what is added for constraints."""
    total, projected = 0.0, stack(W, W)
    clear(hessian, W, W)
    for i in range(W):
        gradient[i] = 0.0
    for k in range(cost.size):
        total += call_for_value(cost.functions[k, DERIVATIVES], x, u, t, cost.data[k], hessian, gradient)
        if k + 1 == cost.indefinite and cost.project != 0:
            if share == 0:
                call(cost.project, hessian)
            elif share < 1:
                for i in range(W):
                    for j in range(W):
                        projected[i, j] = hessian[i, j]
                call(cost.project, projected)
                for i in range(W):
                    for j in range(W):
                        hessian[i, j] = share * hessian[i, j] + (1 - share) * projected[i, j]
    return total


def augment_cost(x, u, t, cost, hessian, gradient):
    """Add the quadratic model of what the augmented Lagrangian adds for constraints; return its value."""
    total, constraints = 0.0, cost.constraints
    for k in range(constraints.size):
        total += call_for_value(
            constraints.functions[k, AUGMENT],
            x, u, t, constraints.data[k], constraints.multipliers[k], hessian, gradient,
        )  # fmt: skip
    return total


def step_second_order(x, u, model, weights, out, jacobian, hessian):
    """As `step_jacobian`; and add the step's second derivatives, each state's times its weight (N,), to a Hessian."""
    dynamics = model.dynamics
    if dynamics.step_curvature != 0:
        call(dynamics.step_curvature, x, u, dynamics.parameters, model.dt, weights, out, jacobian, hessian)
    else:
        step_jacobian(x, u, model, model.dt, out, jacobian)


def evaluate_constraints(steps, states, controls, constraints, values):
    """Write all of the constraints' numbers, step by step as the multipliers are."""
    for t in range(steps + 1):
        u = controls[min(t, steps - 1)]
        for k in range(constraints.size):
            acts = 0 if t == steps and constraints.functions[k, USES_CONTROL] != 0 else 1  # there is no last control
            call(
                constraints.functions[k, VALUES],
                states[t], u, t, acts, constraints.data[k], constraints.multipliers[k], values[k],
            )  # fmt: skip


def slope_of_constraint(which, row, x, u, t, constraints, gradient):
    """Add the gradient (W,) of one of the numbers of one of the constraints."""
    call(constraints.functions[which, SLOPE], x, u, t, row, constraints.data[which], gradient)


def noise_value(x, u, noise, ahead):
    """What noise is expected to cost at (x, u); see `noise.py`."""
    return call_for_value(noise.value, x, u, noise.data, noise.risk, ahead)


def noise_quadratic(x, u, noise, ahead, convex, stage):
    """The same, and its quadratic model added to the stage."""
    return call_for_value(noise.quadratic, x, u, noise.data, noise.risk, ahead, convex, stage)


def costs_of(count, steps, plans, model, costs):
    """Stage and final cost of trajectories, one after the other: states (count (steps + 1), N), controls alike."""
    for k in range(count):
        costs[k] = 0.0
        for t in range(steps):
            x, u = plans.states[k * (steps + 1) + t], plans.controls[k * steps + t]
            costs[k] += cost_value(x, u, t, model.stage)
        last = plans.controls[(k + 1) * steps - 1]
        costs[k] += cost_value(plans.states[(k + 1) * (steps + 1) - 1], last, steps, model.final)


def cost_of_each(count, t, plans, cost, costs):
    """A cost at step t of states (count, N) and controls (count, M)."""
    for k in range(count):
        costs[k] = cost_value(plans.states[k], plans.controls[k], t, cost)

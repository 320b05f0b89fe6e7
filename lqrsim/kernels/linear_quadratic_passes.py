"""Both passes of a linear-quadratic problem, whose stages are given. The kernels' subset."""

from lqrsim.kernels.cost_to_go import riccati_backward
from lqrsim.kernels.declarations import N, W, riccati_forward, smoothed_state, stack
from lqrsim.kernels.records import LinearStep, QuadraticStage


def lq_passes(steps, dynamics, backwards, costs, constants, work):
    """The backward pass from the cost-to-go at T, the forward pass from the cost-to-come at 0, and the minimisers.

    `dynamics` are the steps, [A B] (T, N, W) and c (T, N), `backwards` what the form's forward pass takes; `costs` and
    `constants` (T,) the stages. Returns the step that failed, or -1, and of which: 0 the backward pass, 1 the forward
    pass, 2 the minimum of their sum.
    """
    stage, costate = QuadraticStage(stack(W, W), stack(W)), stack(N)
    for t in range(steps - 1, -1, -1):
        take(t, costs, stage)
        step = LinearStep(dynamics.jacobian[t], dynamics.offset[t])
        if not riccati_backward(t, step, stage, constants[t], work.policy, work.to_go):
            return t, 0
    for t in range(steps):
        take(t, costs, stage)
        step = LinearStep(backwards.jacobian[t], backwards.offset[t])
        if not riccati_forward(t, step, stage, constants[t], work.to_come, work.smoothing):
            return t, 1
    for t in range(steps + 1):
        if not smoothed_state(t, work.to_go, work.to_come, costate, work.x_hats[t]):
            return t, 2
    return -1, 0


def take(t, costs, stage):
    """Copy a stage, for the Riccati steps use theirs up."""
    for i in range(W):
        stage.gradient[i] = costs.gradient[t, i]
        for j in range(W):
            stage.hessian[i, j] = costs.hessian[t, i, j]

"""Curvature from secants, for dynamics without second derivatives, such as MuJoCo's steps.

The models of `stages.py` then have the curvature of cost and rows alone. What they lack at each stage is learned from
the changes of the Lagrangian's gradient by the steps taken, by symmetric updates of rank one (SR1). It enters the
Hessians only if convergence without it is slow: at first the updates know little.
"""

from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import fill
from lqrsim.kernels.stages import add_matrix, lagrangian_slope

COMPACT = 1  # all functions

NOTHING = 1e-8  # least part of a residual along its step from which curvature is learned (Nocedal and Wright, (6.26))


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
        along, moved, wide = 0.0, 0.0, 0.0
        for i in range(W):
            lacks[i] = slope[i] - turns[t, i]
            for j in range(W):
                known = models.hessian[t, i, j]
                if stages.uses_learned[0] == 0:
                    known += models.learned[t, i, j]
                lacks[i] -= known * last_step[t, j]
            along += lacks[i] * last_step[t, i]
            moved += last_step[t, i] * last_step[t, i]
            wide += lacks[i] * lacks[i]
        if along * along > NOTHING * NOTHING * moved * wide:
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

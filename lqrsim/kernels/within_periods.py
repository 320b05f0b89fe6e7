"""What a plan does between its knots, with the controls held."""

from lqrsim.kernels.declarations import N, compact, stack
from lqrsim.kernels.linear_algebra import copy
from lqrsim.kernels.model_functions import advance


@compact
def states_within(steps, parts, again, plan, model, found):
    """Write the states (steps parts, N) at the ends of `parts` equal parts of each period.

    Args:
      again: whether each period begins at the plan's knot; else where the last one ended.
    """
    z = stack(N)
    for t in range(steps):
        if again or t == 0:
            copy(plan.states[t], N, z)
        for k in range(parts):
            advance(z, plan.controls[t], model, model.dt / parts, found[t * parts + k])
            copy(found[t * parts + k], N, z)

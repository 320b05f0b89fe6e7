"""How fast iterations converge: factor and order, from the costs of a run that went on until rounding stopped it.

The error of an iteration is its cost less the lowest that was reached, relative to that. Near an optimum it is
quadratic in how far the plan is off, so that both have the same order. Only the tail says anything: from where errors
are below `CLOSE` for good to where they are still above `ROUNDING`, and above a hundred times the last change, next to
which what the lowest cost itself is off is small.
"""

from dataclasses import dataclass

import numpy as np

from lqrsim.errors import Array

CLOSE, ROUNDING = 1e-3, 1e-13
FEWEST = 3  # errors that an order takes: two pairs of one and the next


@dataclass(frozen=True)
class Rate:
    """Of one run; NaN where its tail is too short.

    Attributes:
      order: p of `e[k+1] = C e[k]^p`, the slope of a line through all pairs of the tail, log over log.
      factor: of an iteration, the geometric mean over the second half of the tail.
    """

    order: float
    factor: float


def errors(costs: Array) -> Array:
    """Relative errors (K,) of the costs (K,) of a run."""
    return (costs - costs.min()) / abs(costs.min())


def tail(costs: Array) -> Array:
    """The errors of the tail."""
    found = errors(costs)
    floor = max(ROUNDING, 100 * abs(costs[-1] - costs[-2]) / abs(costs.min())) if len(costs) > 1 else np.inf
    far = np.flatnonzero(~(found < CLOSE))
    found = found[far[-1] + 1 :] if len(far) else found
    lost = np.flatnonzero(found < floor)
    return found[: lost[0]] if len(lost) else found


def rate(costs: Array) -> Rate:
    """Of a run by its costs (K,)."""
    left = np.log(tail(costs))
    if len(left) < FEWEST:
        return Rate(np.nan, np.nan)
    half = left[(len(left) - 1) // 2 :]
    return Rate(
        order=float(np.polyfit(left[:-1], left[1:], 1)[0]),
        factor=float(np.exp((half[-1] - half[0]) / (len(half) - 1))),
    )

"""Funnels with a shape and levels chosen by hand; nothing has certified them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

import lqrsim as ls


def funnel_by_hand(
    solution: ls.Solution, shape: npt.ArrayLike, *, knots: Sequence[int] = (0,), levels: Sequence[float] = (1.0,)
) -> ls.types.Funnel:
    """A funnel of the first d states, with one shape (d, d) or one per knot (T+1, d, d)."""
    shape, space = np.asarray(shape, dtype=float), solution.policy.state_coordinates
    tried = 1000 * (np.asarray(levels) > 0)  # enough to show any rate that is asked for
    return ls.types.Funnel(
        plan=solution.trajectory, state_coordinates=space, control_coordinates=solution.policy.control_coordinates,
        states=space.names[: shape.shape[-1]], family="given",
        shape=np.broadcast_to(shape, (solution.trajectory.steps + 1, *shape.shape[-2:])),
        knots=np.array(knots), levels=np.array(levels), trials=tried, successes=tried, reasons=("",) * len(knots),
        rate=0.9, confidence=0.95, simulated=1, policy_digest="", goal_radius=0.1, disturbances=(), seed=0,
    )  # fmt: skip

"""How a trial ends: which event comes first, and nothing after it counts. NumPy only."""

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

OUTCOMES = ("reached", "timed out", "collided", "diverged", "error")


def endings(
    *, collided_at: Array, diverged_at: Array, failed_at: Array, distance: Array, radius: float, horizon: float
) -> tuple[npt.NDArray[np.str_], Array]:
    """How trials ended, and when: the first event in time ends a trial, and nothing after it counts.

    Args:
      collided_at, diverged_at, failed_at: (K,) seconds, infinite where it did not happen. Of what happens at the same
        time the earlier named counts.
      distance: (K,) from the target at the end. radius: within which it counts as reached. horizon: in seconds.

    Returns:
      one of OUTCOMES for each, (K,), and the time in seconds at which it ended, (K,).
    """
    events = np.stack([collided_at, diverged_at, failed_at])
    first = np.argmin(events, axis=0)
    happened = np.isfinite(events.min(axis=0))
    arrived = np.where(np.asarray(distance) <= radius, "reached", "timed out")
    outcome = np.where(happened, np.array(["collided", "diverged", "error"])[first], arrived)
    return outcome, np.where(happened, events.min(axis=0), horizon)

"""The tube: where the policy expects the robot, an ellipsoid at each knot of the plan."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.results.solution import Solution

SIGMAS = 2.0  # of the ellipsoids
COST_ABOVE_LEAST = SIGMAS**2 / 2  # the total cost on them, above its least


def ellipsoids(solution: Solution, states: Sequence[int], knots: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Centres (k, d), half axes (k, d) and rotations (k, d, d) of the ellipsoids of d of the states.

    Of all states whose total cost is at most its least plus `COST_ABOVE_LEAST`, these are what those d can be: what is
    an ellipsoid of the whole state casts one on them, with that block of the covariance.

    Raises:
      InputError: the solution has no total cost.
    """
    total, chosen = solution.total_cost, list(states)
    block = total.covariance()[knots][:, chosen][:, :, chosen]
    variances, rotations = np.linalg.eigh(0.5 * (block + np.swapaxes(block, 1, 2)))
    rotations[:, :, 0] *= np.linalg.det(rotations)[:, None]
    return total.minimizer()[knots][:, chosen], SIGMAS * np.sqrt(np.maximum(variances, 0.0)), rotations


def outlines(solution: Solution, states: Sequence[int], knots: npt.NDArray[np.int64], points: int = 48) -> Array:
    """The outlines (k, points, 2) of the ellipses of two of the states. Raises as `ellipsoids` does."""
    centres, half_axes, rotations = ellipsoids(solution, states, knots)
    around = np.linspace(0, 2 * np.pi, points, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
    return centres[:, None, :] + np.einsum("kij,kj,pj->kpi", rotations, half_axes, circle)

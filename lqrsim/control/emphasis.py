"""Emphasis: where along a plan, and in which direction, a deviation leads to a collision.

A law that holds all deviations equally tightly spends effort where nothing is near. The chance of a collision depends
on the variance s^2 of the clearance c at each knot and obstacle. Its derivative is close to p z^2 / (2 s^2), with z =
c / s and the chance p that a collision begins there. To first order, a law lowers the chance most if these derivatives
are its weights of deviations along the normals of the obstacles.

The derivatives belong to one law, and weights change the law. Their ratios change little. How much they count, compared
with the tolerances, is a number that is chosen as these are.
"""

import numpy as np

from lqrsim.control.collision_chance import Surroundings, beginnings
from lqrsim.errors import Array


def emphasis_of(surroundings: Surroundings, states: Array, covariance: Array, across: Array, weights: Array) -> Array:
    """Weights of deviations from a plan (T+1, n, n), as large as these weights (n,) at the most critical knot.

    Zero if there are no obstacles.

    Args:
      states: mean states, (T+1, n). covariance: (T+1, n, n). across: as for `collision_chance`.
      weights: weights of the states' deviations, (n,).
    """
    found = np.zeros_like(covariance)
    if not surroundings.kept:
        return found
    spread = surroundings.spread(states, covariance, across)
    margin = spread.mean / spread.std
    slopes = beginnings(margin, spread.correlation) * margin**2 / spread.std**2
    place = np.array(surroundings.position)
    found[:, place[:, None], place] = np.einsum("to,toi,toj->tij", slopes, spread.normal, spread.normal)
    largest = float(np.max(np.diagonal(found, axis1=1, axis2=2) @ (1 / weights)))
    return found / largest if largest > 0 else found

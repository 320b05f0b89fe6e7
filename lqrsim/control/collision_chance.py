"""Chance of collision, from mean and covariance of the states along a plan.

The clearance of each obstacle is linearised about the mean, so that it is normally distributed. A collision is counted
when it begins: the expected number of steps in which the clearance falls below zero. Clearances of two neighbouring
steps are nearly the same number, so adding or multiplying the chances of single steps would count each collision many
times.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, owens_t

from lqrsim.errors import Array, InputError
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.problem.obstacles import Clearance, KeepsClear, each_once
from lqrsim.problem.problem import Problem

LARGEST_MARGIN = 12.0  # standard deviations of clearance; with more the chance of a collision is below 1e-32


class Spread(NamedTuple):
    """Distribution of the clearances to O obstacles at T+1 knots; further axes are the first."""

    mean: Array  # (T+1, O), in m, as the standard deviation
    std: Array
    correlation: Array  # (T, O), of each clearance with the same clearance at the previous knot
    normal: Array  # (T+1, O, p), derivative of each clearance by the position


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Obstacles of a problem, as its robot sees them."""

    kept: tuple[KeepsClear, ...]  # the costs and constraints that keep it away from obstacles, without repetitions
    shapes: tuple[ShapeInWorld, ...]  # for each of these, the shape of the robot among its obstacles
    position: tuple[int, ...]  # the states that are the robot's position; with balls or geoms, all that move these
    std: float  # of an obstacle's position, in m

    @classmethod
    def of(cls, problem: Problem, std: float) -> "Surroundings":
        """The obstacles of the problem's costs and constraints, each world once."""
        terms, place = each_once(problem.kept_clear), problem.dynamics.state_coordinates.position
        if any(term.moving for term in terms):
            raise InputError("problem: got obstacles that move, want ones that stand still for a chance of collision")
        pairs = [(term, shape) for term in terms if len((shape := term.in_world(problem.dynamics)).world)]
        shapes = tuple(shape for _, shape in pairs)
        states = [shape.depends_on for shape in shapes]
        position = place if set(states) <= {place} else tuple(sorted({i for indices in states for i in indices}))
        return cls(tuple(term for term, _ in pairs), shapes, position, std)

    def keep_away(self, margin: Array) -> list[Clearance]:
        """Constraints that keep a margin from each obstacle, (T+1, O)."""
        ends = np.cumsum([len(shape.world) for shape in self.shapes])[:-1]
        pairs = zip(self.kept, np.split(margin, ends, axis=1), strict=True)
        return [Clearance(term.world, **term.shape, margin=columns) for term, columns in pairs]

    def clearances(self, states: Array) -> tuple[Array, Array, Array]:
        """At states (K, n): the distance to each obstacle (K, O), its gradient (K, O, p) and its variance (O,).

        With balls, the distance is measured from the ball nearest to the obstacle.
        """
        if not self.shapes:
            return np.zeros((len(states), 0)), np.zeros((len(states), 0, len(self.position))), np.zeros(0)
        parts = [shape.with_slopes(states, self.position) for shape in self.shapes]
        fixed = [obstacle.kind == "plane" for shape in self.shapes for obstacle in shape.world.obstacles]
        clearance, normals = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        return clearance, normals, np.where(fixed, 0.0, self.std**2)

    @property
    def by_mujoco(self) -> bool:
        """Whether MuJoCo computes the distances, between geoms."""
        return any("geoms" in term.shape for term in self.kept)

    def displacements(self, rng: np.random.Generator, trials: int) -> list[Array]:
        """Random displacements (K, O, 3) of each world's obstacles in K trials; planes stay, and heights from above."""
        displaced = []
        for shape in self.shapes:
            axes = [1.0, 1.0, 0.0 if shape.dynamics.state_coordinates.from_above else 1.0]
            moves = np.array([[obstacle.kind != "plane"] for obstacle in shape.world.obstacles])
            displaced.append(self.std * moves * axes * rng.standard_normal((trials, len(moves), 3)))
        return displaced

    def nearest(self, states: Array, displaced: list[Array]) -> Array:
        """Clearance of states (K, n) to the nearest obstacle, (K,), the obstacles of each world displaced (K, O, 3)."""
        pairs = zip(self.shapes, displaced, strict=True)
        clearances = [shape.clearance(shape.places(states), moved) for shape, moved in pairs]
        return np.min(clearances, axis=0, initial=np.inf) if clearances else np.full(len(states), np.inf)

    def spread(self, states: Array, covariance: Array, across: Array) -> Spread:
        """Clearances at mean states (..., T+1, n); `across` (..., T, n, n) is the covariance with the previous knot."""
        place, many = list(self.position), states.shape[:-1]
        clearance, normal, displaced = self.clearances(states.reshape(-1, states.shape[-1]))
        clearance, normal = clearance.reshape(*many, -1), normal.reshape(*many, -1, len(place))
        covariance, across = (matrix[..., place, :][..., place] for matrix in (covariance, across))
        ones = np.ones(len(place))  # a product with it is much faster than `sum` over a short axis
        variance = (normal @ covariance * normal) @ ones + displaced
        std = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 1e-12)
        shared = (normal[..., 1:, :, :] @ across * normal[..., :-1, :, :]) @ ones + displaced
        return Spread(clearance, std, np.clip(shared / (std[..., 1:, :] * std[..., :-1, :]), -1.0, 1.0), normal)

    def emphasis(self, states: Array, covariance: Array, across: Array, weights: Array) -> Array:
        """Weights (T+1, n, n) of deviations that lead to a collision, at most as large as `weights` (n,).

        A law that holds all deviations equally tightly spends effort where nothing is near. The chance of a collision
        depends on the variance s^2 of the clearance c at each knot and obstacle. Its derivative is close to
        p z^2 / (2 s^2), with z = c / s and the chance p that a collision begins there. To first order, a law lowers the
        chance most if these derivatives are its weights of deviations along the normals of the obstacles. They belong
        to one law, and weights change the law, but their ratios change little.
        """
        emphasis = np.zeros_like(covariance)
        if not self.kept:
            return emphasis
        spread = self.spread(states, covariance, across)
        margin = spread.mean / spread.std
        slopes = beginnings(margin, spread.correlation) * margin**2 / spread.std**2
        place = np.array(self.position)
        emphasis[:, place[:, None], place] = np.einsum("to,toi,toj->tij", slopes, spread.normal, spread.normal)
        largest = float(np.max(np.diagonal(emphasis, axis1=1, axis2=2) @ (1 / weights)))
        return emphasis / largest if largest > 0 else emphasis


def collision_chance(
    states: Array, covariance: Array, across: Array, surroundings: Surroundings
) -> tuple[Array, Array]:
    """The chance of being in collision at each knot (..., T+1), and of colliding at all, (...).

    It is that of mean states (..., T+1, n), covariances, and covariances with the previous state, (..., T, n, n).
    """
    if not surroundings.kept:
        return np.zeros(states.shape[:-1]), np.zeros(states.shape[:-2])
    spread = surroundings.spread(states, covariance, across)
    return chance_of_clearances(spread.mean / spread.std, spread.correlation)


def chance_of_clearances(margin: Array, correlation: Array) -> tuple[Array, Array]:
    """`collision_chance` of clearances in std (..., T+1, O) and their correlations with the last knot (..., T, O)."""
    expected = beginnings(margin, correlation).sum(axis=(-2, -1))
    return np.minimum(ndtr(-margin).sum(axis=-1), 1.0), -np.expm1(-expected)


def beginnings(margin: Array, correlation: Array) -> Array:
    """The chance that a collision with each obstacle begins at each knot, (..., T+1, O)."""
    chance, now, previous = ndtr(-margin), margin[..., 1:, :], margin[..., :-1, :]
    begins, possible = np.zeros_like(margin), now < LARGEST_MARGIN
    begins[..., 0, :] = chance[..., 0, :]
    # In collision at a knot, but not at the previous knot.
    both = both_below(-now[possible], -previous[possible], correlation[possible])
    begins[..., 1:, :][possible] = np.maximum(chance[..., 1:, :][possible] - both, 0.0)
    return begins


def both_below(first: Array, second: Array, correlation: Array) -> Array:
    """P(a < first, b < second) of standard normal numbers with that correlation, elementwise, by Owen's T (1956)."""
    # T needs ratios to both numbers, and to the spread of one given the other; tiny numbers count as 1e-200. Beyond 40,
    # chances do not change.
    a, b = (np.where(np.abs(bound) < 1e-200, 1e-200, np.clip(bound, -40.0, 40.0)) for bound in (first, second))
    spread = np.maximum(np.sqrt((1 - correlation) * (1 + correlation)), 1e-100)
    with np.errstate(over="ignore"):
        owens = owens_t(a, (b - correlation * a) / (a * spread)) + owens_t(b, (a - correlation * b) / (b * spread))
    opposite = (a < 0) != (b < 0)
    return np.maximum(0.5 * (ndtr(a) + ndtr(b) - opposite) - owens, 0.0)

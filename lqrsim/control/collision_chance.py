"""Chance of collision, from mean and covariance of the states along a plan.

The clearance of each obstacle is linearised about the mean, so that it is normally distributed. A collision is counted
when it begins: the expected number of steps in which the clearance falls below zero. Clearances of two neighbouring
steps are nearly the same number, so to add up or to multiply the chances of single steps would count each collision
many times.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, owens_t

from lqrsim.codegen.distances import distances_with_normals, signed_distance_displaced
from lqrsim.errors import Array, InputError
from lqrsim.problem.clearance import Clearance
from lqrsim.problem.collision_spheres import SphereCenters, bind_outline, evaluate, evaluate_slopes
from lqrsim.problem.costs import ObstacleCost
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import Problem
from lqrsim.scenes.world import World

FAR = 12.0  # standard deviations of clearance, with which the chance of a collision is below 1e-32


class Spread(NamedTuple):
    """Distribution of the clearances to O obstacles at T+1 knots.

    Attributes:
      mean: in m, (T+1, O). std: in m, (T+1, O). correlation: of each with that of the knot before, (T, O).
    """

    mean: Array
    std: Array
    correlation: Array


@dataclass(frozen=True)
class Surroundings:
    """Obstacles of a problem, as its robot sees them.

    Attributes:
      dynamics: dynamics of the problem.
      worlds: each world with the costs and constraints that keep the robot away from it, each kind once.
      seen: the worlds as the robot sees them. places: for those that are kept from balls, the places of the balls.
      place: the states that are its position. position: the same, or, with balls, all states that move it.
      std: standard deviation of an obstacle's position, in m.
    """

    dynamics: Dynamics
    worlds: tuple[ObstacleCost | Clearance, ...]
    seen: tuple[World, ...]
    places: tuple[SphereCenters | None, ...]
    place: tuple[int, ...]
    position: tuple[int, ...]
    std: float

    @classmethod
    def of(cls, problem: Problem, std: float) -> "Surroundings":
        """The obstacles of the problem's costs and constraints, each world once."""
        space, worlds = problem.dynamics.state_coordinates, []
        clearances = [one for one in problem.constraints if isinstance(one, Clearance)]
        for one in (*problem.obstacle_costs, *clearances):
            kind = id(one.world), one.radius, id(one.balls), id(one.geoms)
            if not any(kind == (id(other.world), other.radius, id(other.balls), id(other.geoms)) for other in worlds):
                worlds.append(one)
        if any(one.moving for one in worlds):
            raise InputError(
                "problem: got obstacles that move, want none: chances of collision are for obstacles that stand still"
            )
        bound = [
            (None, one.world)
            if one.geoms is not None
            else bind_outline("problem", one.balls, problem.dynamics, one.world)
            for one in worlds
        ]
        found = [(one, places, seen) for one, (places, seen) in zip(worlds, bound, strict=True) if len(seen)]
        moving = space.position
        if any(places is not None or one.geoms is not None for one, places, _ in found):
            own = [
                tuple(range(one.geoms.bind(problem.dynamics, one.world, 0.0).moved))
                if one.geoms is not None
                else places.depends_on
                if places is not None
                else space.position
                for one, places, _ in found
            ]
            moving = tuple(sorted({i for indices in own for i in indices}))
        kept, of_balls, seen = (tuple(part) for part in zip(*found, strict=True)) if found else ((), (), ())
        return cls(problem.dynamics, kept, seen, of_balls, space.position, moving, std)

    def keep_away(self, margin: Array) -> list[Clearance]:
        """Constraints that keep a margin from each obstacle, (T+1, O)."""
        kept, first = [], 0
        for one, seen in zip(self.worlds, self.seen, strict=True):
            own = margin[:, first : first + len(seen)]
            radius = one.radius if one.balls is None and one.geoms is None else None
            kept.append(Clearance(one.world, radius=radius, balls=one.balls, geoms=one.geoms, margin=own))
            first += len(seen)
        return kept

    def clearances(self, states: Array) -> tuple[Array, Array, Array]:
        """At states (K, n): the distance to each obstacle (K, O), its gradient (K, O, p), and its variance (O,).

        With balls it is the clearance of the ball nearest to the obstacle.
        """
        if not self.worlds:
            return np.zeros((len(states), 0)), np.zeros((len(states), 0, len(self.position))), np.zeros(0)
        pairs = zip(self.worlds, self.seen, self.places, strict=True)
        parts = [self._of_one(one, seen, places, states) for one, seen, places in pairs]
        fixed = [[one.kind == "plane" for one in seen.obstacles] for seen in self.seen]
        return (
            np.concatenate([clearance for clearance, _ in parts], axis=1),
            np.concatenate([normals for _, normals in parts], axis=1),
            np.where(np.concatenate(fixed), 0.0, self.std**2),
        )

    def _of_one(
        self, one: ObstacleCost | Clearance, seen: World, places: SphereCenters | None, states: Array
    ) -> tuple[Array, Array]:
        if one.geoms is not None:
            distances, slopes = one.geoms.slopes(self.dynamics, one.world, states)
            return distances, slopes[..., list(self.position)]
        if one.balls is None or places is None:
            distances, across = distances_with_normals(seen, states[:, list(self.place)])
            normals = np.zeros((*distances.shape, len(self.position)))
            normals[..., [self.position.index(i) for i in self.place]] = across
            return distances - one.radius, normals
        count, knots = len(one.balls), np.arange(len(states))[:, None]
        middles, slopes = evaluate_slopes(places, count, states)
        distances, normals = distances_with_normals(seen, middles.reshape(-1, 3))
        clearance = distances.reshape(len(states), count, -1) - one.balls.radii[:, None]
        nearest, obstacle = clearance.argmin(axis=1), np.arange(len(seen))
        normals = normals.reshape(len(states), count, -1, 3)[knots, nearest, obstacle]
        moves = slopes[knots, nearest][..., list(self.position)]
        return clearance[knots, nearest, obstacle], np.einsum("kod,kodi->koi", normals, moves)

    @property
    def by_mujoco(self) -> bool:
        """Whether distances are those of MuJoCo's geoms."""
        return any(one.geoms is not None for one in self.worlds)

    def displacements(self, rng: np.random.Generator, trials: int) -> list[Array]:
        """By how much the obstacles of each world are off in K trials, (K, O, 3), in their plane; planes stay."""
        axes = np.arange(3) < (len(self.place) or 3)
        std = [np.array([self.std * axes * (one.kind != "plane") for one in seen.obstacles]) for seen in self.seen]
        return [own * rng.standard_normal((trials, *own.shape)) for own in std]

    def nearest(self, states: Array, displaced: list[Array]) -> Array:
        """Clearance of states (K, n) to the nearest obstacle, (K,), the obstacles of each world displaced (K, O, 3)."""
        nearest = np.full(len(states), np.inf)
        for one, seen, places, away in zip(self.worlds, self.seen, self.places, displaced, strict=True):
            if one.balls is None or places is None:
                points, radii = states[:, None, list(self.place)], one.radius
            else:
                points, radii = evaluate(places, len(one.balls), states), one.balls.radii
            clearance = signed_distance_displaced(seen, points, away) - radii
            nearest = np.minimum(nearest, clearance.min(axis=1))
        return nearest

    def spread(self, states: Array, covariance: Array, across: Array) -> Spread:
        """Clearances at mean states (T+1, n); `across` (T, n, n) is the covariance with the knot before."""
        place = list(self.position)
        clearance, normal, displaced = self.clearances(states)
        variance = np.einsum("toi,tij,toj->to", normal, covariance[:, place][:, :, place], normal) + displaced
        std = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 1e-12)
        shared = np.einsum("toi,tij,toj->to", normal[1:], across[:, place][:, :, place], normal[:-1]) + displaced
        return Spread(clearance, std, np.clip(shared / (std[1:] * std[:-1]), -1.0, 1.0))


def collision_chance(
    states: Array, covariance: Array, across: Array, surroundings: Surroundings
) -> tuple[Array, float]:
    """The chance of being in collision at each knot (T+1,), and of colliding at all.

    Args:
      states: means, (T+1, n). covariance: (T+1, n, n). across: of each state with the one before it, (T, n, n).
    """
    if not surroundings.worlds:
        return np.zeros(len(states)), 0.0
    clearance, std, correlation = surroundings.spread(states, covariance, across)
    return chance_of_clearances(clearance / std, correlation)


def chance_of_clearances(margin: Array, correlation: Array) -> tuple[Array, float]:
    """`collision_chance` of clearances in standard deviations (T+1, O) and their correlations with the knot before."""
    each = ndtr(-margin)
    begins, near = np.zeros_like(correlation), margin[1:] < FAR
    # In collision at a knot and not at the one before.
    before = both_below(-margin[1:][near], -margin[:-1][near], correlation[near])
    begins[near] = np.maximum(each[1:][near] - before, 0.0)
    expected = each[0].sum() + begins.sum()
    return np.minimum(each.sum(axis=1), 1.0), float(-np.expm1(-expected))


def both_below(first: Array, second: Array, correlation: Array) -> Array:
    """P(a < first, b < second) of standard normal numbers with that correlation, elementwise, by Owen's T (1956)."""
    # T needs ratios to both numbers, and to the spread of one given the other: what is tiny counts as 1e-200. No chance
    # tells 40 from infinity.
    a, b = (np.where(np.abs(one) < 1e-200, 1e-200, np.clip(one, -40.0, 40.0)) for one in (first, second))
    spread = np.maximum(np.sqrt((1 - correlation) * (1 + correlation)), 1e-100)
    with np.errstate(over="ignore"):
        beyond = owens_t(a, (b - correlation * a) / (a * spread)) + owens_t(b, (a - correlation * b) / (b * spread))
    opposite = (a < 0) != (b < 0)
    return np.maximum(0.5 * (ndtr(a) + ndtr(b) - opposite) - beyond, 0.0)

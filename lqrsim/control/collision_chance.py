"""How likely a robot is to collide, of the mean and the covariance of its states along a plan.

Of each obstacle, the clearance is taken to be linear about the mean, so that it is normal. A collision is counted when
it begins: the expected number of steps in which the clearance falls below zero. Clearances of two neighbouring steps
are nearly the same number, so to add up or to multiply the chances of single steps would count each collision many
times.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.codegen.distances import distances_with_normals
from lqrsim.errors import Array
from lqrsim.problem.constraints import Clearance
from lqrsim.problem.problem import Problem
from lqrsim.scenes.world import World


class Spread(NamedTuple):
    """How the clearances to O obstacles are distributed at T+1 knots.

    Attributes:
      mean: in m, (T+1, O). std: in m, (T+1, O). correlation: of each with that of the knot before, (T, O).
    """

    mean: Array
    std: Array
    correlation: Array


@dataclass(frozen=True)
class Surroundings:
    """What a robot must not touch.

    Attributes:
      worlds: with the radius to keep from each. seen: the worlds as the robot sees them.
      position: which states are its place.
      std: of where an obstacle is, in m.
    """

    worlds: tuple[tuple[World, float], ...]
    seen: tuple[World, ...]
    position: tuple[int, ...]
    std: float

    @classmethod
    def of(cls, problem: Problem, std: float) -> "Surroundings":
        """The obstacles of the problem's costs and constraints, each world once."""
        space, worlds = problem.dynamics.state_coordinates, []
        clearances = [one for one in problem.constraints if isinstance(one, Clearance)]
        for one in (*problem.obstacle_costs, *clearances):
            if not any(world is one.world and radius == one.radius for world, radius in worlds):
                worlds.append((one.world, one.radius))
        pairs = [(pair, pair[0].seen_by(space.plane, space.offset)) for pair in worlds]
        pairs = [(pair, seen) for pair, seen in pairs if len(seen)]
        return cls(tuple(pair for pair, _ in pairs), tuple(seen for _, seen in pairs), space.position, std)

    def keep_away(self, margin: Array) -> list[Clearance]:
        """Constraints that keep a margin from each obstacle, (T+1, O)."""
        kept, first = [], 0
        for (world, radius), seen in zip(self.worlds, self.seen, strict=True):
            kept.append(Clearance(world, radius=radius, margin=margin[:, first : first + len(seen)]))
            first += len(seen)
        return kept

    def clearances(self, states: Array) -> tuple[Array, Array, Array]:
        """At states (K, n): to each obstacle (K, O), in which direction that grows (K, O, p), and its variance (O,)."""
        places = states[:, list(self.position)]
        worlds = [(seen, radius) for (_, radius), seen in zip(self.worlds, self.seen, strict=True)]
        parts = [(*distances_with_normals(world, places), radius, world) for world, radius in worlds]
        if not parts:
            return np.zeros((len(states), 0)), np.zeros((len(states), 0, len(self.position))), np.zeros(0)
        fixed = [[one.kind == "plane" for one in world.obstacles] for *_, world in parts]
        return (
            np.concatenate([distances - radius for distances, _, radius, _ in parts], axis=1),
            np.concatenate([normals for _, normals, *_ in parts], axis=1),
            np.where(np.concatenate(fixed), 0.0, self.std**2),
        )

    def spread(self, states: Array, covariance: Array, across: Array) -> Spread:
        """At mean states (T+1, n), of covariances (T+1, n, n), and (T, n, n) with the states of the knot before."""
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
    """The same of clearances in standard deviations (T+1, O), and the correlation of each with that before (T, O)."""
    each = ndtr(-margin)
    # Who is in collision at a knot and was not at the one before.
    begins = each[1:] - both_below(-margin[1:], -margin[:-1], correlation)
    expected = each[0].sum() + np.maximum(begins, 0.0).sum()
    return np.minimum(each.sum(axis=1), 1.0), float(-np.expm1(-expected))


def both_below(first: Array, second: Array, correlation: Array) -> Array:
    """P(a < first, b < second) of standard normal numbers with that correlation, elementwise.

    Plackett's integral over the correlation's angle, by Gauss and Legendre's rule.
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    # Near 1 the integrand is steep: from there it is done from the other end, where it is min(a, b).
    angle = np.arcsin(correlation)
    start = np.where(np.abs(correlation) > 0.95, np.sign(correlation) * np.pi / 2, 0.0)
    at = start[..., None] + (angle - start)[..., None] * (nodes + 1) / 2
    a, b = first[..., None], second[..., None]
    cosine, sine = np.cos(at), np.sin(at)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        exponent = -(a * a + b * b - 2 * a * b * sine) / (2 * np.maximum(cosine, 1e-150) ** 2)
    total = (np.exp(np.nan_to_num(exponent, nan=-np.inf)) @ weights) * (angle - start) / (4 * np.pi)
    independent = ndtr(first) * ndtr(second)
    same, opposite = ndtr(np.minimum(first, second)), np.maximum(ndtr(first) - ndtr(-second), 0.0)
    return total + np.where(start > 0, same, np.where(start < 0, opposite, independent))

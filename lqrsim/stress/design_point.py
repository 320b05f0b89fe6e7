"""The most likely failure: among the standard normal vectors z whose trial fails, the nearest to the origin.

In reliability analysis this is the design point of FORM, the first-order reliability method. If the failures were the
half-space beyond a plane, their probability would be Phi(-|z|), which is FORM's estimate. It is only a hint;
multilevel_splitting.py measures the probability. The search uses no derivatives, and scores many vectors at once:

1. It begins with given failures, or failures from a splitting, and with their mean, which shows their common direction.
2. Along a ray it finds the smallest multiple that fails, on a grid that is refined.
3. Around the best failure it scores pairs z + s e, z - s e with random e. The mean of (difference of scores) e
   estimates the gradient of the score; estimates of the last rounds are added up. The search then tries rays between
   the gradient and the best failure.
4. The remaining distance depends on the noise of the gradient: along a wrong direction a plane is further away, by the
   cosine of the angle. The two halves of the pairs have independent noise, so their agreement tells this angle. Rounds
   are added up while the failure does not move. The search ends when the possible gain is less than the tolerance.

The result is a failure. There may be a nearer failure; a search from other failures is a check.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.special import ndtr

from lqrsim.annotations import Bounds, Count, Seed, TextProgress, checked
from lqrsim.errors import Array, InputError, check_array, check_memory
from lqrsim.process import keeping
from lqrsim.results.rollout import Rollout
from lqrsim.stress.multilevel_splitting import CountedScore, Rounds, Score, failure_probability

MIXTURES = 1 - np.geomspace(1, 0.02, 12)  # fraction of the best failure in the direction of a ray, from 0 to 98 %
DISCOUNT = 0.95  # factor of earlier rounds' gradients, after each round that comes nearer by more than PROGRESS
PROGRESS = 0.01  # fraction of the distance
SPREAD = 0.5  # s, where e is a standard normal vector divided by the root of its size
TOLERANCE = 0.01  # share of the distance that may be left to gain
GRID, REFINED = 16, 3  # number of points on a ray, and number of refinements of the grid


@dataclass(frozen=True, eq=False)
class DesignPoint:
    """The nearest failure that was found."""

    numbers: Array  # z, (d,)
    distance: float  # |z|, the reliability index
    score: float  # of z, positive
    first_order_probability: float  # Phi(-|z|), FORM's estimate of the probability of failure
    history: Array  # |z| after each round, the start first
    simulations: int  # number of computed scores
    # Fraction of |z| that could still be gained, by the noise of the gradient, if the failures lie beyond a plane; NaN
    # without a gradient.
    remaining: float
    converged: bool  # whether this is less than the tolerance, and the last rounds did not come closer


@checked
def smallest_failure(
    score: Score,
    size: Count,
    *,
    failures: Array | None = None,
    rounds: Rounds = 40,
    pairs: Annotated[int, Bounds(at_least=2)] | None = None,
    seed: Seed = 0,
    progress: TextProgress | None = None,
) -> DesignPoint:
    """Search for the failure that is nearest to the origin.

    Args:
      failures: (k, size), failures to begin with; by default the failures of a small splitting.
      rounds: largest number of rounds. The search ends earlier if the noise permits a gain of less than 1 % of the
        distance, and five rounds together gain less than a tenth of that.
      pairs: pairs in each round; by default half the size, at least 250. With fewer the gradient is mostly noise.

    Raises:
      KeyboardInterrupt: Ctrl-C; its `found` is the DesignPoint after the rounds that are done, if any.
    """
    pairs = max(250, size // 2) if pairs is None else pairs
    check_memory("pairs", pairs, 8 * 5 * size, "whose vectors")
    check_memory("size", size, 8 * 16 * 12, "whose vectors")  # the vectors along the rays
    rng, counted = np.random.default_rng(seed), CountedScore(score)
    tell = progress or (lambda done, total, text: None)
    if failures is None:
        failures = failure_probability(counted, size, particles=200, keep=0.2, repetitions=2, seed=seed).failures
    failures = check_array("failures", failures, (None, size))
    best = _nearest_of(counted, failures)
    history = [float(np.linalg.norm(best))]
    halves, remaining, converged = np.zeros((2, size)), float("nan"), False

    def so_far() -> DesignPoint:
        distance = history[-1]
        return DesignPoint(
            numbers=best, distance=distance, score=float(counted(best[None])[0]),
            first_order_probability=float(ndtr(-distance)), history=np.array(history),
            simulations=counted.evaluations, remaining=remaining, converged=converged,
        )  # fmt: skip

    tell(0, rounds, f"distance {history[-1]:.3g}")
    with keeping(lambda _: so_far()):
        for number in range(rounds):
            # The oldest rounds were around another point.
            discount = DISCOUNT if history[-1] < (1 - PROGRESS) * history[-2:][0] else 1.0
            halves = discount * halves + _gradients(counted, best, pairs, rng)
            remaining = _remaining(halves)
            nearer = _nearer(counted, best, halves.sum(axis=0))
            best = best if nearer is None else nearer
            history.append(float(np.linalg.norm(best)))
            tell(number + 1, rounds, f"distance {history[-1]:.3g}")
            is_steady = number >= 5 and history[-1] > (1 - TOLERANCE / 10) * history[-6]
            converged = is_steady and remaining < TOLERANCE
            if converged:
                break
    return so_far()


def _nearest_of(score: Score, failures: Array) -> Array:
    """The nearest failure on the rays through some failures and through their mean."""
    if not len(failures):
        raise InputError("failures: got none, want at least one")
    lengths = np.linalg.norm(failures, axis=1)
    nearest = np.argsort(lengths)[:8]
    rays = np.array([*failures[nearest], failures.mean(axis=0)])
    best = _ray_search(score, _directions(rays), np.append(lengths[nearest], lengths.max()))
    if best is None:
        raise InputError("failures: got vectors that do not fail, want some with a positive score")
    return best


def _directions(vectors: Array) -> Array:
    """Normalise vectors (k, d) to length 1; vectors of length 0 stay as they are."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def _ray_search(score: Score, directions: Array, lengths: Array) -> Array | None:
    """The nearest failure on rays of directions (k, d), each up to its length (k,); None if there is none."""
    low, high = np.zeros(len(directions)), lengths
    failing = np.full(len(directions), np.inf)
    for _ in range(REFINED):
        steps = low[:, None] + (high - low)[:, None] * np.arange(1, GRID + 1) / GRID
        vectors = steps[..., None] * directions[:, None]
        failed = (score(vectors.reshape(-1, directions.shape[1])) > 0).reshape(steps.shape)
        first = np.where(failed.any(axis=1), failed.argmax(axis=1), -1)
        rows = np.flatnonzero(first >= 0)
        failing[rows] = np.minimum(failing[rows], steps[rows, first[rows]])
        # Refine only the nearest.
        rows = rows[np.argsort(failing[rows])[:3]]
        if not len(rows):
            break
        place = steps[rows, first[rows]]
        width = (high - low)[rows] / GRID
        directions, failing = directions[rows], failing[rows]
        low, high = place - width, place
    if not np.isfinite(failing).any():
        return None
    row = int(np.argmin(failing))
    return failing[row] * directions[row]


def _gradients(score: Score, best: Array, pairs: int, rng: np.random.Generator) -> Array:
    """Estimate the gradient of the score at the best failure from each half of the pairs, (2, d)."""
    steps = SPREAD * rng.standard_normal((pairs, len(best))) / np.sqrt(len(best))
    scores = score(np.concatenate([best + steps, best - steps]))
    # Trials that diverge have an infinite score; it counts as slightly worse than the worst finite score, and one of
    # minus infinity, as without obstacles, as slightly better than the best.
    finite = scores[np.isfinite(scores)]
    scores = scores.clip(finite.min(initial=0.0) - 1.0, finite.max(initial=0.0) + 1.0)
    difference, half = scores[:pairs] - scores[pairs:], pairs // 2
    parts = [difference[:half] @ steps[:half], difference[half:] @ steps[half:]]
    return np.array(parts) / (pairs * SPREAD**2) * len(best)


def _remaining(halves: Array) -> float:
    """Fraction of the distance to a plane that could still be gained without gradient noise; NaN if halves disagree."""
    lengths = float(np.linalg.norm(halves[0]) * np.linalg.norm(halves[1]))
    agree = float(halves[0] @ halves[1]) / lengths if lengths > 0 else 0.0
    return 1 - float(np.sqrt(2 * agree / (1 + agree))) if agree > 0 else float("nan")


def _nearer(score: Score, best: Array, gradient: Array) -> Array | None:
    """A failure nearer than the best, on rays between the best and the gradient of the score; None if there is none."""
    distance, steepness = float(np.linalg.norm(best)), float(np.linalg.norm(gradient))
    if steepness == 0:
        return None
    mixed = MIXTURES[:, None] * best / distance + (1 - MIXTURES)[:, None] * gradient / steepness
    lengths = np.full(len(mixed), distance * (1 - 1e-6))
    return _ray_search(score, _directions(mixed), lengths)


@dataclass(frozen=True)
class LargestEffect:
    """The largest value of a disturbance in a trial. The size of a vector is its length."""

    what: str
    size: float
    unit: str
    time: float


def largest_effects(rollout: Rollout) -> list[LargestEffect]:
    """The largest disturbances of the first trial until its end, in physical units, except those that are always zero.

    The error of an applied control includes the error that the actuators' limits cause.
    """
    last = int(rollout.counts[0].sum()) - 1
    states, controls = rollout.state_coordinates, rollout.control_coordinates
    measured = states.difference(rollout.measured[0], rollout.states[0])
    disturbed = rollout.applied[0] - rollout.commanded[0]
    sizes_over_time: list[tuple[str, Array, str]] = [
        ("force", np.linalg.norm(rollout.forces[0], axis=1), "N"),
        ("torque", np.linalg.norm(rollout.torques[0], axis=1), "N m"),
        *(
            (f"error of {name}{kind}", np.abs(errors[:, i]), unit)
            for kind, space, errors in ((" as applied", controls, disturbed), (" as measured", states, measured))
            for i, (name, unit) in enumerate(zip(space.names, space.units, strict=True))
        ),
    ]
    effects = []
    for what, sizes, unit in sizes_over_time:
        until = np.nan_to_num(sizes[: last + 1])
        step = int(until.argmax())
        effects.append(LargestEffect(what, float(until[step]), unit, float(rollout.times[step])))
    return [effect for effect in effects if effect.size > 0]

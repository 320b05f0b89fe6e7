"""The most likely way to fail: of all standard normal vectors z whose trial fails, the one nearest to the origin.

In reliability analysis it is the design point of FORM. If the failures were all of those beyond a plane, their
probability would be Phi(-|z|), which is FORM's estimate; they are not, so it is no more than a hint, and
multilevel_splitting.py measures. The search uses no derivatives, and scores many vectors at once:

1. It begins with given failures, or with those of a splitting, and their mean: what random failures share.
2. Along a ray it finds the least multiple that fails, on a grid that is refined.
3. Around the best failure it scores pairs z + s e, z - s e with random e. The mean of (difference of scores) e points
   to where scores grow fastest. Means of the last rounds are added up. Rays between there and the best failure are
   tried.
4. How near that gets depends on how well the gradient is known: in the direction of a noisy one, a plane is further
   away, by the cosine of the angle between the two. The halves of the pairs have independent noise, so that what they
   agree in tells that angle. Rounds are added up for as long as the failure stays where it is, and it ends where the
   noise leaves less to be gained than the tolerance.

What it finds fails; that nothing nearer does is not proven, and starting elsewhere is a check.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_count,
    check_function,
    check_memory,
    check_number,
    check_seed,
)
from lqrsim.results.rollout import Rollout
from lqrsim.stress.multilevel_splitting import MOST, CountedScore, Score, split
from lqrsim.stress.trial_score import normal_tail

MIXTURES = 1 - np.geomspace(1, 0.02, 12)  # how much of the best failure is in the rays that are tried; none, 98 %
DISCOUNT = 0.95  # of the gradient from earlier rounds, each round that comes nearer by more than
MOVED = 0.01  # of the distance


@dataclass(frozen=True)
class DesignPoint:
    """The nearest failure that was found.

    Attributes:
      numbers: z, (d,). distance: |z|, the reliability index. score: of z, positive.
      first_order_probability: Phi(-|z|), FORM's estimate of the probability of failure.
      history: |z| after each round, the start first. simulations: scores that were computed in all.
      remaining: the share of |z| that the noise of the gradient leaves to be gained, were failures all beyond a plane;
        NaN where there is no gradient. converged: it is less than the tolerance, and the last rounds came no nearer.
    """

    numbers: Array
    distance: float
    score: float
    first_order_probability: float
    history: Array
    simulations: int
    remaining: float
    converged: bool


def smallest_failure(
    score: Score,
    size: int,
    *,
    failures: Array | None = None,
    rounds: int = 40,
    pairs: int | None = None,
    spread: float = 0.5,
    tolerance: float = 0.01,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
) -> DesignPoint:
    """The failure nearest to the origin, as near as the search finds it.

    Args:
      score: of vectors (K, size), (K,); positive is failure.
      size: how many numbers a vector has.
      failures: (k, size) to begin with; by default those of a small splitting.
      rounds: at most; it ends earlier where the noise leaves less than `tolerance` of the distance to be gained, and
        five rounds together gain less than a tenth of that.
      pairs: scored in each round; by default half the size, and at least 250: with fewer the gradient is mostly noise.
      spread: of these, s; each number of e is standard normal, over the root of `size`.
      tolerance: share of the distance to be gained below which the search ends.
      seed: of all random numbers.
      progress: called with the rounds that are done, and all of them.

    Returns:
      The DesignPoint: its numbers and its distance from the origin.

    Raises:
      InputError: an option is out of range, or none of the failures is one.
      NoFailure: none was given, and none was found.
    """
    check_function("score", score, "a function of vectors (K, size)", arguments=1, optional=False)
    check_function("progress", progress, "a function of how many rounds are done, of how many", arguments=2)
    check_count("size", size)
    check_count("rounds", rounds, at_least=0, at_most=MOST)
    pairs = max(250, size // 2) if pairs is None else check_count("pairs", pairs, at_least=2)
    check_memory("pairs", pairs, 8 * 5 * size, "whose vectors")
    check_memory("size", size, 8 * 16 * 12, "whose vectors")  # of the rays
    spread = check_number("spread", spread, above=0.0, at_most=1e6)
    tolerance = check_number("tolerance", tolerance, above=0.0)
    rng, counted = np.random.default_rng(check_seed("seed", seed)), CountedScore(score)
    if failures is None:
        failures = split(counted, size, particles=200, keep=0.2, repetitions=2, seed=seed).failures
    failures = check_array("failures", failures, (None, size))
    best = _nearest_of(counted, failures)
    history = [float(np.linalg.norm(best))]
    halves, remaining, converged = np.zeros((2, size)), float("nan"), False
    if progress is not None:
        progress(0, rounds)
    for number in range(rounds):
        # The oldest rounds were elsewhere.
        discount = DISCOUNT if history[-1] < (1 - MOVED) * history[-2:][0] else 1.0
        halves = discount * halves + _gradients(counted, best, pairs, spread, rng)
        remaining = _remaining(halves)
        nearer = _nearer(counted, best, halves.sum(axis=0))
        best = best if nearer is None else nearer
        history.append(float(np.linalg.norm(best)))
        if progress is not None:
            progress(number + 1, rounds)
        settled = number >= 5 and history[-1] > (1 - tolerance / 10) * history[-6]
        converged = settled and remaining < tolerance
        if converged:
            break
    final = float(counted(best[None])[0])
    distance = history[-1]
    return DesignPoint(
        numbers=best,
        distance=distance,
        score=final,
        first_order_probability=normal_tail(distance),
        history=np.array(history),
        simulations=counted.evaluations,
        remaining=remaining,
        converged=converged,
    )


def _nearest_of(score: Score, failures: Array) -> Array:
    """The nearest failure along the rays of some failures and of their mean."""
    if not len(failures):
        raise InputError("failures: got none, want at least one")
    nearest = failures[np.argsort(np.linalg.norm(failures, axis=1))[:8]]
    mean = failures.mean(axis=0)
    farthest = float(np.linalg.norm(failures, axis=1).max())
    rays = np.array([*nearest, mean])
    lengths = np.append(np.linalg.norm(nearest, axis=1), farthest)
    best = _ray_search(score, _directions(rays), lengths)
    if best is None:
        raise InputError("failures: got none that fails, want vectors with a positive score")
    return best


def _directions(vectors: Array) -> Array:
    """Of length 1; those of length 0 are left out, as any direction of theirs would be made up."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def _ray_search(score: Score, directions: Array, lengths: Array, *, grid: int = 16, refined: int = 3) -> Array | None:
    """The nearest failure on rays (k, d), each up to its length (k,); None if there is none."""
    low, high = np.zeros(len(directions)), lengths
    failing = np.full(len(directions), np.inf)
    for _ in range(refined):
        steps = low[:, None] + (high - low)[:, None] * np.arange(1, grid + 1) / grid
        vectors = steps[..., None] * directions[:, None]
        failed = (score(vectors.reshape(-1, directions.shape[1])) > 0).reshape(steps.shape)
        first = np.where(failed.any(axis=1), failed.argmax(axis=1), -1)
        rows = np.flatnonzero(first >= 0)
        failing[rows] = np.minimum(failing[rows], steps[rows, first[rows]])
        # Only the nearest are worth looking at closer.
        rows = rows[np.argsort(failing[rows])[:3]]
        if not len(rows):
            break
        place = steps[rows, first[rows]]
        width = (high - low)[rows] / grid
        directions, failing = directions[rows], failing[rows]
        low, high = place - width, place
    if not np.isfinite(failing).any():
        return None
    row = int(np.argmin(failing))
    return failing[row] * directions[row]


def _gradients(score: Score, best: Array, pairs: int, spread: float, rng: np.random.Generator) -> Array:
    """Which way scores grow around the best failure, by each half of the pairs, (2, d): their noise is independent."""
    steps = spread * rng.standard_normal((pairs, len(best))) / np.sqrt(len(best))
    scores = score(np.concatenate([best + steps, best - steps]))
    # What is lost has an infinite score, which says nothing of a gradient but which side is the worse.
    highest = scores[np.isfinite(scores)].max(initial=0.0)
    scores = np.minimum(scores, highest + 1.0)
    difference = scores[:pairs] - scores[pairs:]
    half = pairs // 2
    parts = [difference[:half] @ steps[:half], difference[half:] @ steps[half:]]
    return np.array(parts) / (pairs * spread**2) * len(best)


def _remaining(halves: Array) -> float:
    """The share of the distance that the gradient's noise leaves to be gained of a plane; NaN where halves disagree."""
    lengths = float(np.linalg.norm(halves[0]) * np.linalg.norm(halves[1]))
    agree = float(halves[0] @ halves[1]) / lengths if lengths > 0 else 0.0
    return 1 - float(np.sqrt(2 * agree / (1 + agree))) if agree > 0 else float("nan")


def _nearer(score: Score, best: Array, gradient: Array) -> Array | None:
    """A failure nearer than the best, on rays between it and the way in which scores grow; None if there is none."""
    distance, steepness = float(np.linalg.norm(best)), float(np.linalg.norm(gradient))
    if steepness == 0:
        return None
    mixed = MIXTURES[:, None] * best / distance + (1 - MIXTURES)[:, None] * gradient / steepness
    lengths = np.full(len(mixed), distance * (1 - 1e-6))
    return _ray_search(score, _directions(mixed), lengths)


@dataclass(frozen=True)
class LargestEffect:
    """What disturbances did at their largest. Vectors are measured by their length."""

    what: str
    size: float
    unit: str
    time: float


def largest_effects(rollout: Rollout, trial: int = 0) -> list[LargestEffect]:
    """The largest disturbances of a trial in physical units, until it ends; what was not there is left out.

    An applied control differs from the command also by the actuators' limits.
    """
    last = int(rollout.counts[trial].sum()) - 1
    states, controls = rollout.state_coordinates, rollout.control_coordinates
    measured = states.difference(rollout.measured[trial], rollout.states[trial])
    disturbed = rollout.applied[trial] - rollout.commanded[trial]
    sizes_over_time: list[tuple[str, Array, str]] = [
        ("force", np.linalg.norm(rollout.forces[trial], axis=1), "N"),
        ("torque", np.linalg.norm(rollout.torques[trial], axis=1), "N m"),
        *(
            (f"error of {name}{kind}", np.abs(errors[:, i]), unit)
            for kind, space, errors in ((" as applied", controls, disturbed), (" as measured", states, measured))
            for i, (name, unit) in enumerate(zip(space.names, space.units, strict=True))
        ),
    ]
    largest = []
    for what, sizes, unit in sizes_over_time:
        until = np.nan_to_num(sizes[: last + 1])
        step = int(until.argmax())
        if until[step] > 0:
            largest.append(LargestEffect(what, float(until[step]), unit, float(rollout.times[step])))
    return largest

"""How likely a rare failure is, by splitting: through levels of a score, each not so rare given the one before.

A trial is a function of a vector z of standard normal numbers (trial_score.py), and fails if its score is positive. A
pilot run finds levels that about `keep` of the vectors exceed given the level before, and how far to move at each of
them. The repetitions that count use these levels and moves: N vectors; those above the level are kept and copied in
place of the others; each is moved by preconditioned Crank-Nicolson steps, z' = sqrt(1 - b^2) z + b xi, that are refused
if the score falls below the level, and so leave the distribution above it as it is. The estimate is the product of the
shares above each level. With levels and moves fixed beforehand its mean is the probability exactly, for any number of
particles and moves (Del Moral, Feynman-Kac Formulae, 2004, Theorem 7.4.2); levels taken from the particles themselves,
as subset simulation takes them, would bias it by the order of 1/N (Cerou, Del Moral, Furon & Guyader, Statistics and
Computing 22, 2012).

The interval is of the relative error. A product's standard deviation grows with its mean, so repetitions that happen to
come out low look more alike than they are, and Student's interval about them then misses the probability. How their
standard deviation relates to their mean depends on neither: an interval holds each probability p from which the mean is
no more than t standard errors away, with p's own standard error. It is not symmetric, and where the repetitions differ
so much that they bound nothing from above, it says so: it ends at 1.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from lqrsim.errors import Array, InputError, check_count, check_function, check_memory, check_number, check_seed, shaped
from lqrsim.stress.statistics import CONFIDENCE, Estimate, rate

Score = Callable[[Array], Array]
MOST = 10_000  # repetitions, moves, levels and rounds
ACCEPTANCE = 0.4  # the share of moves for which the pilot run aims


class NoFailure(InputError):
    """No failure was found: they are too rare, or there are none."""


@dataclass(frozen=True)
class SplittingResult:
    """How likely failure is.

    Attributes:
      probability: the mean of the repetitions, with its interval: see the top of this file. Where there is one level
        alone, repetitions are plain trials, and it is the exact one of Clopper and Pearson.
      standard_error: of that mean. repetitions: (R,), independent and each without bias.
      levels: of the score, the last one 0. step_sizes: b of the moves at each but the last.
      simulations: scores that were computed in all, those of the pilot run included.
      failures: (k, d) vectors that fail, of the repetitions, distributed as failures are. scores: (k,) theirs.
    """

    probability: Estimate
    standard_error: float
    repetitions: Array
    levels: Array
    step_sizes: Array
    simulations: int
    failures: Array
    scores: Array

    @property
    def plain_trials(self) -> float:
        """How many plain trials have the same standard error, in the mean; NaN where all repetitions agree."""
        if self.standard_error == 0:
            return float("nan")
        return self.probability.value * (1 - self.probability.value) / self.standard_error**2


def split(
    score: Score,
    size: int,
    *,
    particles: int = 500,
    keep: float = 0.1,
    moves: int = 5,
    repetitions: int = 10,
    seed: int = 0,
    confidence: float = CONFIDENCE,
    most_levels: int = 40,
    level: Callable[[float], object] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> SplittingResult:
    """The probability that the score of a standard normal vector is positive.

    Args:
      score: of vectors (K, size), (K,); positive is failure.
      size: how many numbers a vector has.
      particles: N of each repetition.
      keep: share that exceeds the next level.
      moves: of each particle at a level.
      repetitions: independent ones; the interval is made of how much they differ.
      seed: of all random numbers.
      confidence: of the interval.
      most_levels: with as many the pilot run gives up.
      level: called with each level as the pilot run finds it.
      progress: called with the repetitions that are done, and all of them.

    Returns:
      The probability with its interval, and the failures.

    Raises:
      InputError: an option is out of range, or a score is NaN.
      NoFailure: none was found.
    """
    check_function("score", score, "a function of vectors (K, size)", arguments=1, optional=False)
    check_count("size", size)
    check_count("particles", particles, at_least=10)
    check_memory("particles", particles, 8 * 5 * size, "whose vectors")  # vectors, moved ones, and copies of them
    keep = check_number("keep", keep, at_least=2 / particles, at_most=0.5)
    check_count("moves", moves, at_most=MOST)
    check_count("repetitions", repetitions, at_least=2, at_most=MOST)
    check_memory("repetitions", repetitions, 8 * particles * (size + 1), "whose failures")
    check_count("most_levels", most_levels, at_most=MOST)
    confidence = check_number("confidence", confidence, above=0.0, below=1.0)
    check_function("level", level, "a function of a level", arguments=1)
    check_function("progress", progress, "a function of how many repetitions are done, of how many", arguments=2)
    counted = CountedScore(score)
    first, *rest = np.random.SeedSequence(check_seed("seed", seed)).spawn(repetitions + 1)
    levels, step_sizes = _pilot_run(
        counted, size, particles, keep, moves, most_levels, np.random.default_rng(first), level
    )
    shares = np.zeros((repetitions, len(levels)))
    failures, scores = [], []
    for number, key in enumerate(rest):
        if progress is not None:
            progress(number, repetitions)
        shares[number], failed, failed_scores = _repetition(
            counted, size, particles, moves, levels, step_sizes, np.random.default_rng(key)
        )
        failures.append(failed)
        scores.append(failed_scores)
    if progress is not None:
        progress(repetitions, repetitions)
    estimates = shares.prod(axis=1)
    if not estimates.any():
        raise NoFailure(f"particles: got {particles}, of which none failed, want more")
    return SplittingResult(
        _estimate(shares, particles, confidence),
        float(estimates.std(ddof=1) / np.sqrt(repetitions)),
        estimates,
        levels,
        step_sizes,
        counted.evaluations,
        np.concatenate(failures),
        np.concatenate(scores),
    )


def _estimate(shares: Array, particles: int, confidence: float) -> Estimate:
    """The mean of the repetitions' products of shares (R, levels), none of them NaN, with its interval."""
    count, levels = shares.shape
    if levels == 1:
        return rate(round(float(shares.sum()) * particles), count * particles, confidence=confidence)
    estimates = shares.prod(axis=1)
    mean = float(estimates.mean())
    # Repetitions may agree by chance. Particles that were independent at each level would differ by so much.
    reached = np.column_stack([np.ones(count), shares[:, :-1]]).cumprod(axis=1) > 0
    typical = shares.sum(axis=0) / reached.sum(axis=0)
    least = np.sqrt(np.sum((1 - typical) / typical) / particles)
    deviation = max(estimates.std(ddof=1) / mean, least)
    half_width = float(stats.t.ppf(0.5 + confidence / 2, count - 1) * deviation / np.sqrt(count))
    high = mean / (1 - half_width) if half_width < 1 - mean else 1.0
    return Estimate(mean, mean / (1 + half_width), high, confidence)


class CountedScore:
    """A score that is checked, and that counts its evaluations. Raises InputError for what is no number for each."""

    def __init__(self, score: Score) -> None:
        self.score, self.evaluations = score, 0

    def __call__(self, vectors: Array) -> Array:
        self.evaluations += len(vectors)
        # With vectors of its own, for a user's function may write to them.
        scores = shaped("score: returned", self.score(vectors.copy()), (len(vectors),))
        if np.isnan(scores).any():
            raise InputError(f"score: got NaN returned, want a number for each of {len(vectors)} vectors")
        return scores


def _pilot_run(
    score: Score,
    size: int,
    particles: int,
    keep: float,
    moves: int,
    most_levels: int,
    rng: np.random.Generator,
    on_level: Callable[[float], object] | None,
) -> tuple[Array, Array]:
    """Levels, the last one 0, and how far to move at each but the last."""
    vectors = rng.standard_normal((particles, size))
    scores = score(vectors)
    levels: list[float] = []
    step_sizes: list[float] = []
    b = 0.5
    while len(levels) < most_levels:
        level = float(np.quantile(scores, 1 - keep, method="inverted_cdf"))
        if on_level is not None:
            on_level(min(level, 0.0))
        if level >= 0 and (scores > 0).any():
            return np.array([*levels, 0.0]), np.array(step_sizes)
        if not (scores > level).any():
            break
        vectors, scores = _resample(vectors, scores, level, rng)
        for _ in range(moves):
            vectors, scores, accepted = _crank_nicolson_step(score, vectors, scores, level, b, rng)
            b = float(np.clip(b * np.exp(accepted - ACCEPTANCE), 1e-3, 1.0))
        levels.append(level)
        step_sizes.append(b)
    raise NoFailure(f"score: got no failure in {len(levels)} levels up to {scores.max():g}, want some")


def _repetition(
    score: Score, size: int, particles: int, moves: int, levels: Array, step_sizes: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """One repetition: the share above each level, 0 from where none was; and the failures with their scores."""
    vectors = rng.standard_normal((particles, size))
    scores = score(vectors)
    shares = np.zeros(len(levels))
    for number, (level, b) in enumerate(zip(levels[:-1], step_sizes, strict=True)):
        shares[number] = np.mean(scores > level)
        if shares[number] == 0:
            return shares, vectors[:0], scores[:0]
        vectors, scores = _resample(vectors, scores, level, rng)
        for _ in range(moves):
            vectors, scores, _ = _crank_nicolson_step(score, vectors, scores, level, b, rng)
    failed = scores > levels[-1]
    shares[-1] = failed.mean()
    return shares, vectors[failed], scores[failed]


def _resample(vectors: Array, scores: Array, level: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """As many as there were, of those above the level: each as often as any other, but for chance where that is odd."""
    above = np.flatnonzero(scores > level)
    times, left = divmod(len(scores), len(above))
    chosen = np.concatenate([np.repeat(above, times), rng.choice(above, left, replace=False)])
    return vectors[chosen], scores[chosen]


def _crank_nicolson_step(
    score: Score, vectors: Array, scores: Array, level: float, b: float, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """One move of each that stays above the level; and the share of those that were accepted."""
    proposed = np.sqrt(1 - b * b) * vectors + b * rng.standard_normal(vectors.shape)
    proposed_scores = score(proposed)
    accepted = proposed_scores > level
    return (
        np.where(accepted[:, None], proposed, vectors),
        np.where(accepted, proposed_scores, scores),
        float(accepted.mean()),
    )

"""The probability of a rare failure by multilevel splitting: the product of the probabilities of more frequent levels.

A trial is a function of a vector z of standard normal numbers (trial_score.py), and fails if its score is positive. A
pilot run finds levels of the score, each exceeded by a fraction of about `keep` of the vectors above the previous
level, and a step size for each level. Each repetition uses these levels and step sizes: it begins with N vectors; those
above the level replace the others; then all are moved by preconditioned Crank-Nicolson steps, z' = sqrt(1 - b^2) z + b
xi. A step is rejected if the score falls below the level, so that the steps preserve the distribution above the level.
The estimate is the product of the fractions above each level. With levels and step sizes fixed beforehand it is
unbiased, for any number of particles and moves (Del Moral, Feynman-Kac Formulae, 2004, Theorem 7.4.2). Levels taken
from the particles themselves, as in subset simulation, would bias it by the order of 1/N (Cerou, Del Moral, Furon &
Guyader, Statistics and Computing 22, 2012).

The interval uses the relative error. The standard deviation of a product grows with its mean, so repetitions that
happen to be low also vary too little, and Student's interval about them misses the probability. The ratio of standard
deviation and mean does not depend on the mean. The interval therefore contains each probability p from which the mean
is at most t standard errors away, with the standard error that belongs to p. It is not symmetric. If the repetitions
vary so much that they give no upper bound, it ends at 1.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lqrsim.errors import Array, InputError, check_count, check_function, check_memory, check_number, check_seed, shaped
from lqrsim.process import keeping
from lqrsim.stress.statistics import CONFIDENCE, Estimate, rate, rounded

Score = Callable[[Array], Array]
Progress = Callable[[int, int, str], object]  # called with the amount done, the whole amount, and the result so far
MOST = 10_000  # largest number of repetitions, moves, levels and rounds
ACCEPTANCE = 0.4  # fraction of accepted moves at which the pilot run aims


class NoFailure(InputError):
    """No failure was found: failures are too rare, or do not exist."""


@dataclass(frozen=True)
class SplittingResult:
    """An estimate of the probability of failure.

    Attributes:
      probability: the mean of the repetitions, with its interval; see the top of this file. If there is only one level,
        the repetitions are plain trials, and the interval is Clopper and Pearson's exact interval.
      standard_error: standard error of the mean. repetitions: (R,), independent unbiased estimates.
      levels: levels of the score, the last one 0. step_sizes: b of the moves at each level but the last.
      simulations: number of computed scores, including the pilot run.
      failures: (k, d) vectors that fail, from all repetitions, in their own distribution. scores: (k,) scores of these.
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
        """Number of plain trials with the same standard error; NaN if all repetitions agree."""
        if self.standard_error == 0:
            return float("nan")
        return self.probability.value * (1 - self.probability.value) / self.standard_error**2

    def summary(self) -> str:
        """Two lines: the probability with its interval, and the number of simulated trials."""
        one, plain = self.probability, self.plain_trials
        interval = f"{100 * one.confidence:g} % interval, {len(self.repetitions)} repetitions"
        needed = f"about {rounded(plain)}" if np.isfinite(plain) else "unknown, because all repetitions agree"
        return (
            f"probability of failure: {one:.2g} ({interval})\n"
            f"simulated: {self.simulations:,} trials; plain trials for the same standard error: {needed}"
        )

    __str__ = summary


def failure_probability(
    score: Score,
    size: int,
    *,
    particles: int = 500,
    keep: float = 0.1,
    moves: int = 5,
    repetitions: int = 10,
    seed: int = 0,
    most_levels: int = 40,
    level: Callable[[float], object] | None = None,
    progress: Progress | None = None,
) -> SplittingResult:
    """Estimate the probability that the score of a standard normal vector is positive, by multilevel splitting.

    Args:
      score: a function of vectors (K, size) that returns (K,); positive is failure.
      size: length of a vector.
      particles: number of vectors N in each repetition.
      keep: fraction of the vectors that exceeds the next level, at least 2 / `particles`. With 0 there are no levels,
        and failures are counted.
      moves: number of moves of each particle at a level.
      repetitions: number of independent estimates; the interval follows from their spread.
      seed: seed of all random numbers.
      most_levels: number of levels after which the pilot run gives up.
      level: called with each level that the pilot run finds.
      progress: called with the number of finished repetitions, the number of all repetitions, and the estimate so far
        as text.

    Raises:
      InputError: an option is out of range, or a score is NaN.
      NoFailure: no failure was found.
      KeyboardInterrupt: Ctrl-C; its `found` is the result of the repetitions that are done, None if none has failed.
    """
    check_function("score", score, "a function of vectors (K, size)", arguments=1, optional=False)
    size = check_count("size", size)
    particles = check_count("particles", particles, at_least=10)
    check_memory("particles", particles, 8 * 5 * size, "whose vectors")  # vectors, moved vectors, and copies of both
    keep = check_keep(keep, particles)
    moves = check_count("moves", moves, at_most=MOST)
    repetitions = check_count("repetitions", repetitions, at_least=2, at_most=MOST)
    check_memory("repetitions", repetitions, 8 * particles * (size + 1), "whose failures")
    most_levels = check_count("most_levels", most_levels, at_most=MOST)
    check_function("level", level, "a function of a level", arguments=1)
    check_function("progress", progress, "a function of how much is done, of how much, and a text", arguments=3)
    counted = CountedScore(score)
    first, *rest = np.random.SeedSequence(check_seed("seed", seed)).spawn(repetitions + 1)
    levels, step_sizes = np.zeros(1), np.zeros(0)
    if keep:
        rng = np.random.default_rng(first)
        levels, step_sizes = _pilot_run(counted, size, particles, keep, moves, most_levels, rng, level)
    done: list[tuple[Array, Array, Array]] = []

    def so_far() -> SplittingResult | None:
        shares = np.array([one for one, _, _ in done])
        if len(done) < 2 or not shares.prod(axis=1).any():
            return None
        estimates = shares.prod(axis=1)
        error = float(estimates.std(ddof=1) / np.sqrt(len(done)))
        failures, scores = (np.concatenate([one[i] for one in done]) for i in (1, 2))
        interval = _estimate(shares, particles)
        return SplittingResult(interval, error, estimates, levels, step_sizes, counted.evaluations, failures, scores)

    with keeping(lambda _: so_far()):
        for number, key in enumerate(rest):
            if progress is not None:
                mean = np.mean([shares.prod() for shares, _, _ in done]) if done else None
                progress(number, repetitions, "" if mean is None else f"{mean:.2g}")
            done.append(_repetition(counted, size, particles, moves, levels, step_sizes, np.random.default_rng(key)))
    found = so_far()
    if progress is not None:
        progress(repetitions, repetitions, f"{0.0 if found is None else found.probability.value:.2g}")
    if found is None:
        raise NoFailure(f"particles: got {particles}, none of which failed, want more of them")
    return found


def check_keep(keep: object, particles: int) -> float:
    """The fraction of vectors that exceeds the next level. Raises InputError if it is out of range."""
    kept = check_number("keep", keep, at_least=0.0, at_most=0.5)
    return check_number("keep", kept, at_least=2 / particles) if kept else kept


def _estimate(shares: Array, particles: int) -> Estimate:
    """The mean of the estimates with its interval, from the fractions (R, levels) above each level."""
    from scipy import stats

    count, levels = shares.shape
    if levels == 1:
        return rate(round(float(shares.sum()) * particles), count * particles)
    estimates = shares.prod(axis=1)
    mean = float(estimates.mean())
    # Repetitions may agree by chance. Their spread is at least the spread of independent particles at each level.
    reached = np.column_stack([np.ones(count), shares[:, :-1]]).cumprod(axis=1) > 0
    typical = shares.sum(axis=0) / reached.sum(axis=0)
    least = np.sqrt(np.sum((1 - typical) / typical) / particles)
    deviation = max(estimates.std(ddof=1) / mean, least)
    half_width = float(stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * deviation / np.sqrt(count))
    high = mean / (1 - half_width) if half_width < 1 - mean else 1.0
    return Estimate(mean, mean / (1 + half_width), high, CONFIDENCE)


class CountedScore:
    """Counts the evaluations of a score and checks its results: InputError unless there is one for each vector."""

    def __init__(self, score: Score) -> None:
        self.score, self.evaluations = score, 0

    def __call__(self, vectors: Array) -> Array:
        self.evaluations += len(vectors)
        # A copy, because a user's function may write to its vectors.
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
    """Find the levels, the last of which is 0, and the step size at all levels except the last."""
    vectors = rng.standard_normal((particles, size))
    scores = score(vectors)
    levels: list[float] = []
    step_sizes: list[float] = []
    b = 0.5
    while len(levels) < most_levels:
        level = _exceeded_by(keep, scores)
        if on_level is not None:
            on_level(min(level, 0.0))
        if level >= 0 and (scores > 0).any():
            return np.array([*levels, 0.0]), np.array(step_sizes)
        if not (scores > level).any():
            break
        vectors, scores = _resample(vectors, scores, level, rng)
        for _ in range(moves):
            vectors, scores, accepted = _crank_nicolson_step(score, vectors, scores, level, b, rng)
            b = _adapted(b, accepted)
        levels.append(level)
        step_sizes.append(b)
    raise NoFailure(
        f"score: got no failure in {len(levels)} levels up to {scores.max():g}: failures are too rare, or none exist"
    )


def _exceeded_by(share: float, scores: Array) -> float:
    """The score that this share of the scores exceeds."""
    return float(np.quantile(scores, 1 - share, method="inverted_cdf"))


def _adapted(b: float, accepted: float) -> float:
    """The next step size, larger if more moves are accepted than wanted."""
    return float(np.clip(b * np.exp(accepted - ACCEPTANCE), 1e-3, 1.0))


def _repetition(
    score: Score, size: int, particles: int, moves: int, levels: Array, step_sizes: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """One repetition: the fraction above each level, 0 once no vector is left; and the failures with their scores."""
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
    """Replace all vectors by copies of those above the level, equally often, with a random choice for the remainder."""
    above = np.flatnonzero(scores > level)
    times, left = divmod(len(scores), len(above))
    chosen = np.concatenate([np.repeat(above, times), rng.choice(above, left, replace=False)])
    return vectors[chosen], scores[chosen]


def _crank_nicolson_step(
    score: Score, vectors: Array, scores: Array, level: float, b: float, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Move each vector if it stays above the level. Returns vectors, scores and the fraction of accepted moves."""
    proposed = np.sqrt(1 - b * b) * vectors + b * rng.standard_normal(vectors.shape)
    proposed_scores = score(proposed)
    accepted = proposed_scores > level
    return (
        np.where(accepted[:, None], proposed, vectors),
        np.where(accepted, proposed_scores, scores),
        float(accepted.mean()),
    )

"""Reliability analysis: the probability of a rare failure by multilevel splitting, and the most likely failure.

A trial is a function of a vector z of standard normal numbers (`TrialScore`), and fails if its score is positive. A
pilot run finds levels of the score, each exceeded by a fraction of about `keep` of the vectors above the previous
level, and a step size for each level. Each repetition uses these levels and step sizes: it begins with N vectors; those
above the level replace the others; then all are moved by preconditioned Crank-Nicolson steps, z' = sqrt(1 - b^2) z + b
xi. A step is rejected if the score falls below the level, so that the steps preserve the distribution above the level.
The estimate is the product of the fractions above each level. With levels and step sizes fixed beforehand it is
unbiased, for any number of particles and moves (Del Moral, Feynman-Kac Formulae, 2004, Theorem 7.4.2). Levels taken
from the particles themselves, as in subset simulation, would bias it by the order of 1/N (Cerou, Del Moral, Furon &
Guyader, Statistics and Computing 22, 2012).

The best scores may tie, as the clearance does if the nearest place is the same in all trials. No level then separates
any of them. The pilot run draws further batches of N vectors until some are above the tie, up to MOST_BATCHES. The
tie is the level, and each repetition draws as many batches for it, so that some of its vectors are above it too. The
number of vectors at a level is thus also fixed beforehand, and the estimate stays unbiased.

The interval uses the relative error. The standard deviation of a product grows with its mean, so repetitions that
happen to be low also vary too little, and Student's interval about them misses the probability. The ratio of standard
deviation and mean does not depend on the mean. The interval therefore contains each probability p from which the mean
is at most t standard errors away, with the standard error that belongs to p. It is not symmetric. If the repetitions
vary so much that they give no upper bound, it ends at 1.

The most likely failure is the vector nearest to the origin whose trial fails: the design point of FORM, the first-order
reliability method. If the failures were the half-space beyond a plane, their probability would be Phi(-|z|), which is
FORM's estimate. It is only a hint. The search uses no derivatives, and scores many vectors at once:

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from scipy.special import ndtr

from lqrsim.annotations import Bounds, Count, Seed, TextProgress, Want, checked
from lqrsim.errors import Array, InputError, check_array, check_memory, shaped
from lqrsim.process import keeping
from lqrsim.stress.statistics import CONFIDENCE, Estimate, rate, rounded

MOST_REPEATS = 10_000  # largest number of repetitions, moves, levels and rounds
Score = Annotated[Callable[[Array], Array], Want("a function of vectors (K, size)")]
OnLevel = Annotated[Callable[[float], object], Want("a function of a level")]
Rounds = Annotated[int, Bounds(at_least=1, at_most=MOST_REPEATS)]
Repetitions = Annotated[int, Bounds(at_least=2, at_most=MOST_REPEATS)]
Keep = Annotated[float, Bounds(at_least=0.0, at_most=0.5)]
ACCEPTANCE = 0.4  # fraction of accepted moves at which the pilot run aims
ENOUGH_ABOVE_TIE = 10  # vectors above a tie with which the pilot run goes on; their number then varies by a third
MOST_BATCHES = 64  # batches of vectors that the pilot run draws at a tie
# Of the search for the most likely failure.
MIXTURES = 1 - np.geomspace(1, 0.02, 12)  # fraction of the best failure in the direction of a ray, from 0 to 98 %
DISCOUNT = 0.95  # factor of earlier rounds' gradients, after each round that comes nearer by more than PROGRESS
PROGRESS = 0.01  # fraction of the distance
SPREAD = 0.5  # s, where e is a standard normal vector divided by the root of its size
TOLERANCE = 0.01  # share of the distance that may be left to gain
GRID, REFINED = 16, 3  # number of points on a ray, and number of refinements of the grid


class NoFailure(InputError):
    """No failure was found: failures are too rare, do not exist, or the score does not tell what is near them.

    It bounds the probability only as far as independent trials were run.

    Attributes:
      trials: number of independent trials, none of which failed; 0 after a splitting beyond the first level.
    """

    def __init__(self, message: str, trials: int = 0) -> None:
        super().__init__(message)
        self.trials = trials


@dataclass(frozen=True, eq=False)
class SplittingResult:
    """An estimate of the probability of failure."""

    # The mean of the repetitions, with its interval; see the top of this file. If there is only one level, the
    # repetitions are plain trials, and the interval is Clopper and Pearson's exact interval.
    probability: Estimate
    standard_error: float  # of the mean
    repetitions: Array  # (R,), independent unbiased estimates
    levels: Array  # of the score, the last one 0
    step_sizes: Array  # b of the moves at each level but the last
    simulations: int  # number of computed scores, including the pilot run
    failures: Array  # (k, d) vectors that fail, from all repetitions, in their own distribution
    scores: Array  # (k,), of these

    @property
    def plain_trials(self) -> float:
        """Number of plain trials with the same standard error; NaN if all repetitions agree."""
        if self.standard_error == 0:
            return float("nan")
        return self.probability.value * (1 - self.probability.value) / self.standard_error**2

    def summary(self) -> str:
        """Two lines: the probability with its interval, and the number of simulated trials."""
        estimate, plain = self.probability, self.plain_trials
        interval = f"{100 * estimate.confidence:g} % interval, {len(self.repetitions)} repetitions"
        needed = f"about {rounded(plain)}" if np.isfinite(plain) else "unknown, because all repetitions agree"
        simulated = f"{self.simulations:,} trials; plain trials for the same standard error: {needed}"
        return f"probability of failure: {estimate:.2g} ({interval})\nsimulated: {simulated}"

    __str__ = summary


@checked
def failure_probability(
    score: Score,
    size: Count,
    *,
    particles: Annotated[int, Bounds(at_least=10)] = 500,
    keep: Keep = 0.1,
    moves: Rounds = 5,
    repetitions: Repetitions = 10,
    seed: Seed = 0,
    most_levels: Rounds = 40,
    level: OnLevel | None = None,
    progress: TextProgress | None = None,
) -> SplittingResult:
    """Estimate the probability that the score of a standard normal vector is positive, by multilevel splitting.

    Args:
      score: a function of vectors (K, size) that returns (K,); positive is failure.
      keep: fraction of the vectors that exceeds the next level, at least 2 / `particles`. With 0 there are no levels,
        and failures are counted.
      repetitions: number of independent estimates; the interval follows from their spread.
      most_levels: number of levels after which the pilot run gives up.
      level: called with each level that the pilot run finds, and again for each batch that it draws where scores tie.

    Raises:
      KeyboardInterrupt: Ctrl-C; its `found` is the result of the repetitions that are done, None if none has failed.
    """
    check_memory("particles", particles, 8 * 5 * size, "whose vectors")  # vectors, moved vectors, and copies of both
    check_keep(keep, particles)
    check_memory("repetitions", repetitions, 8 * particles * (size + 1), "whose failures")
    tell = progress or (lambda done, total, text: None)
    counted = CountedScore(score)
    splitting = _Splitting(counted, size, particles, moves)
    first, *keys = np.random.SeedSequence(seed).spawn(repetitions + 1)
    levels, step_sizes, batches = np.zeros(1), np.zeros(0), [1]
    if keep:
        rng = np.random.default_rng(first)
        levels, step_sizes, batches = splitting.pilot_run(keep, most_levels, rng, level or (lambda level: None))
    done: list[tuple[Array, Array, Array]] = []

    def so_far() -> SplittingResult | None:
        fractions = np.array([of_levels for of_levels, _, _ in done])
        if len(done) < 2 or not (estimates := fractions.prod(axis=1)).any():
            return None
        error = float(estimates.std(ddof=1) / np.sqrt(len(done)))
        failures, scores = (np.concatenate([repetition[i] for repetition in done]) for i in (1, 2))
        interval = _estimate(fractions, particles, batches)
        return SplittingResult(interval, error, estimates, levels, step_sizes, counted.evaluations, failures, scores)

    with keeping(lambda _: so_far()):
        for number, key in enumerate(keys):
            estimates = [fractions.prod() for fractions, _, _ in done]
            tell(number, repetitions, f"{np.mean(estimates):.2g}" if estimates else "")
            rng = np.random.default_rng(key)
            done.append(splitting.repetition(levels, step_sizes, batches, rng))
    result = so_far()
    tell(repetitions, repetitions, f"{0.0 if result is None else result.probability.value:.2g}")
    if result is None:
        trials = repetitions * particles * batches[0] if len(levels) == 1 else 0
        raise NoFailure(f"particles: got {particles}, none of which failed, want more of them", trials)
    return result


def check_keep(keep: float, particles: int) -> None:
    """Raises InputError if fewer than two vectors would exceed a level."""
    if 0 < keep < 2 / particles:
        raise InputError(f"keep: got {keep:g}, want a finite number >= {2 / particles:g}, or 0")


def _estimate(fractions: Array, particles: int, batches: Sequence[int]) -> Estimate:
    """The mean of the estimates with its interval, from the fractions (R, levels) of batches of particles at levels."""
    from scipy import stats

    count, levels = fractions.shape
    if levels == 1:
        vectors = particles * batches[0]
        return rate(round(float(fractions.sum()) * vectors), count * vectors)
    estimates = fractions.prod(axis=1)
    mean = float(estimates.mean())
    # Repetitions may agree by chance. Their spread is at least the spread of independent particles at each level.
    reached = np.column_stack([np.ones(count), fractions[:, :-1]]).cumprod(axis=1) > 0
    typical = fractions.sum(axis=0) / reached.sum(axis=0)
    least = np.sqrt(np.sum((1 - typical) / typical / np.array(batches)) / particles)
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


@dataclass(frozen=True, eq=False)
class _Splitting:
    """What the pilot run and the repetitions do with vectors (k, d) and their scores (k,)."""

    score: Score
    size: int
    particles: int  # N
    moves: int  # of each particle at a level

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """N vectors with their scores."""
        vectors = rng.standard_normal((self.particles, self.size))
        return vectors, self.score(vectors)

    def resample(self, vectors: Array, scores: Array, level: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """N copies of the vectors above the level, equally often, with a random choice for the remainder."""
        above = np.flatnonzero(scores > level)
        times, left = divmod(self.particles, len(above))
        chosen = np.concatenate([np.repeat(above, times), rng.choice(above, left, replace=False)])
        return vectors[chosen], scores[chosen]

    def move(
        self, vectors: Array, scores: Array, level: float, b: float, rng: np.random.Generator, *, tune: bool = False
    ) -> tuple[Array, Array, float]:
        """Move vectors where they stay above the level; `tune` adapts b to the wanted fraction of accepted moves."""
        for _ in range(self.moves):
            proposed = np.sqrt(1 - b * b) * vectors + b * rng.standard_normal(vectors.shape)
            new_scores = self.score(proposed)
            accepted = new_scores > level
            vectors, scores = np.where(accepted[:, None], proposed, vectors), np.where(accepted, new_scores, scores)
            if tune:
                b = float(np.clip(b * np.exp(accepted.mean() - ACCEPTANCE), 1e-3, 1.0))
        return vectors, scores, b

    def pilot_run(
        self, keep: float, most_levels: int, rng: np.random.Generator, on_level: OnLevel
    ) -> tuple[Array, Array, list[int]]:
        """Find the levels, the last of which is 0; the step size at all levels except the last; the batches at each."""
        vectors, scores = self.draw(rng)
        levels, step_sizes, batches = list[float](), list[float](), list[int]()
        b, enough = 0.5, min(ENOUGH_ABOVE_TIE, int(keep * self.particles))
        while len(levels) < most_levels:
            level, batch_count = min(float(np.quantile(scores, 1 - keep, method="inverted_cdf")), 0.0), 1
            on_level(level)
            above = scores > level
            # Later vectors are copies, a few of which may always tie.
            tie = not levels and np.sum(scores == level) > 1 and above.sum() < enough
            if tie or not above.any():
                survivors = [(vectors[above], scores[above])]
                while sum(len(kept) for _, kept in survivors) < enough and batch_count < MOST_BATCHES:
                    on_level(level)
                    # As many vectors again, from the distribution above the last level.
                    vectors, scores = self.move(vectors, scores, levels[-1], b, rng)[:2] if levels else self.draw(rng)
                    above, batch_count = scores > level, batch_count + 1
                    survivors.append((vectors[above], scores[above]))
                vectors, scores = (np.concatenate(parts) for parts in zip(*survivors, strict=True))
            if not len(scores):
                tied = batch_count * self.particles
                got = f"scores that tie at {level:g} after {len(levels)} levels, and none of {tied:,} above it"
                why = "the score does not tell which vectors are nearer to failing"
                raise NoFailure(f"score: got {got}: {why}", 0 if levels else tied)
            batches.append(batch_count)
            if level == 0:
                return np.array([*levels, 0.0]), np.array(step_sizes), batches
            vectors, scores = self.resample(vectors, scores, level, rng)
            vectors, scores, b = self.move(vectors, scores, level, b, rng, tune=True)
            levels.append(level)
            step_sizes.append(b)
        got = f"no failure in {len(levels)} levels up to {scores.max():g}"
        raise NoFailure(f"score: got {got}: failures are too rare, or none exist")

    def repetition(
        self, levels: Array, step_sizes: Array, batches: Sequence[int], rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """The fraction above each level, 0 once no vector is left; and the failures with their scores."""
        vectors, scores, fractions = np.zeros((0, self.size)), np.zeros(0), np.zeros(len(levels))
        for number, level in enumerate(levels):
            survivors: list[tuple[Array, Array]] = []
            for _ in range(batches[number]):
                if number == 0:
                    moved, moved_scores = self.draw(rng)
                else:
                    below, step_size = levels[number - 1], step_sizes[number - 1]
                    moved, moved_scores = self.resample(vectors, scores, below, rng)
                    moved, moved_scores, _ = self.move(moved, moved_scores, below, step_size, rng)
                above = moved_scores > level
                survivors.append((moved[above], moved_scores[above]))
            vectors, scores = (np.concatenate(parts) for parts in zip(*survivors, strict=True))
            fractions[number] = len(scores) / (self.particles * batches[number])
            if fractions[number] == 0:
                break
        return fractions, vectors, scores


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
    particles: Annotated[int, Bounds(at_least=10)] = 200,
    rounds: Rounds = 40,
    pairs: Annotated[int, Bounds(at_least=2)] | None = None,
    seed: Seed = 0,
    level: OnLevel | None = None,
    progress: TextProgress | None = None,
) -> DesignPoint:
    """Search for the failure that is nearest to the origin.

    Args:
      failures: (k, size), failures to begin with; by default those of a small splitting: see `failure_probability` for
        its `particles` and `level`.
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
        options: dict[str, Any] = {"particles": particles, "keep": 0.2, "repetitions": 2, "seed": seed}
        failures = failure_probability(counted, size, level=level, **options).failures
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
    # Trials that diverge have an infinite score; it counts as worse than the worst finite score by twice their range,
    # in whatever unit, and one of minus infinity, as without obstacles, as better than the best by as much.
    finite = scores[np.isfinite(scores)]
    low, high = finite.min(initial=0.0), finite.max(initial=0.0)
    beyond = 2 * (high - low) or 1.0
    scores = scores.clip(low - beyond, high + beyond)
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

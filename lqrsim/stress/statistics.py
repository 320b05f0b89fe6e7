"""How sure a number is: exact intervals of rates, paired comparisons, bootstrap intervals. SciPy does the work."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import stats

from lqrsim.errors import Array, InputError, check_array, check_count, check_number

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A number and the interval that it lies in with the given confidence."""

    value: float
    low: float
    high: float
    confidence: float = CONFIDENCE

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"


def rate(successes: int, trials: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """A success rate with its exact (Clopper-Pearson) interval, which covers at least as often as it says.

    Raises:
      InputError: no trials, or more successes than trials.
    """
    return _rate(successes, trials, confidence, "exact")


def wilson(successes: int, trials: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """A success rate with Wilson's interval, which is narrower and covers as often as it says on average: for plots.

    Raises:
      InputError: as `rate` does.
    """
    return _rate(successes, trials, confidence, "wilson")


def _rate(successes: int, trials: int, confidence: float, method: Literal["exact", "wilson"]) -> Estimate:
    check_count("trials", trials)
    if check_count("successes", successes, at_least=0) > trials:
        raise InputError(f"successes: got {successes}, want at most the {trials} trials")
    check_number("confidence", confidence, above=0, below=1)
    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method=method)
    return Estimate(successes / trials, float(interval.low), float(interval.high), confidence)


@dataclass(frozen=True)
class Pairs:
    """Two policies on the same trials: in how many only one of them succeeded, and the exact McNemar test.

    Attributes:
      p_value: how likely so uneven a split, or a less even one, were if neither was the better.
    """

    only_first: int
    only_second: int
    p_value: float


def compare(first: npt.ArrayLike, second: npt.ArrayLike) -> Pairs:
    """Whether each of two policies succeeded, trial by trial, (K,) each.

    Raises:
      InputError: of different lengths, or none.
    """
    one, other = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if one.shape != other.shape or one.ndim != 1 or not len(one):
        raise InputError(f"second: got shape {other.shape}, want that of first, {one.shape}, and at least one trial")
    only_first, only_second = int(np.sum(one & ~other)), int(np.sum(other & ~one))
    split = only_first + only_second
    return Pairs(only_first, only_second, float(stats.binomtest(only_first, split).pvalue) if split else 1.0)


def paired_difference(only_first: int, only_second: int, trials: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """How much more often the first of two policies succeeds, on the same trials, with Tango's score interval.

    It holds each difference that the score test does not reject, with the shares most likely under that difference
    (Tango, Statistics in Medicine 17, 1998). It has a width also where no trial told the two apart.

    Args:
      only_first, only_second: in how many trials only that one succeeded. trials: in all.

    Raises:
      InputError: no trials, or fewer than those that tell the two apart.
    """
    check_count("trials", trials)
    apart = check_count("only_first", only_first, at_least=0) + check_count("only_second", only_second, at_least=0)
    if apart > trials:
        raise InputError(f"trials: got {trials}, want at least the {apart} in which only one succeeded")
    check_number("confidence", confidence, above=0, below=1)
    surplus, z = only_first - only_second, float(stats.norm.ppf(0.5 + confidence / 2))

    def accepted(difference: float) -> bool:
        # The likeliest share of trials in which only the second succeeds, given the difference, is a quadratic's root.
        linear = (2 * trials - surplus) * difference - apart
        constant = -only_second * difference * (1 - difference)
        share = (np.sqrt(max(linear**2 - 8 * trials * constant, 0.0)) - linear) / (4 * trials)
        variance = trials * max(2 * share + difference * (1 - difference), 0.0)
        return bool((surplus - trials * difference) ** 2 <= z * z * variance)

    low, high = (_last(accepted, surplus / trials, end) for end in (-1.0, 1.0))
    return Estimate(surplus / trials, low, high, confidence)


def _last(accepted: Callable[[float], bool], inside: float, end: float) -> float:
    """The last number from `inside` to `end` that is accepted, by bisection to rounding."""
    outside = end
    for _ in range(60):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if accepted(middle) else (inside, middle)
    return inside


def mean(sample: npt.ArrayLike, *, confidence: float = CONFIDENCE) -> Estimate:
    """The mean of a sample (K,) with Student's interval.

    Raises:
      InputError: fewer than two numbers, or one that is not finite.
    """
    numbers = check_array("sample", sample, (None,))
    if len(numbers) < 2:
        raise InputError(f"sample: got {len(numbers)} numbers, want at least 2")
    check_number("confidence", confidence, above=0, below=1)
    reach = stats.t.ppf(0.5 + confidence / 2, len(numbers) - 1) * numbers.std(ddof=1) / np.sqrt(len(numbers))
    middle = float(numbers.mean())
    return Estimate(middle, middle - float(reach), middle + float(reach), confidence)


def holm(p_values: npt.ArrayLike) -> Array:
    """The p-values of several tests, made larger so that any one false alarm is as rare as they say (Holm, 1979)."""
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    raised = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)
    adjusted = np.empty(len(values))
    adjusted[order] = raised
    return adjusted


def bootstrap(
    statistic: Callable[..., Array | float],
    *samples: npt.ArrayLike,
    confidence: float = CONFIDENCE,
    resamples: int = 10_000,
    seed: int = 0,
) -> Estimate:
    """A statistic of samples (K,) that belong together, row by row, with its bootstrap interval (of percentiles).

    Args:
      statistic: of the samples and `axis`, as `scipy.stats.bootstrap` wants it; for example
        `lambda a, b, axis: a.mean(axis) / b.mean(axis)`.
      seed: of the resampling.

    Raises:
      InputError: fewer than two rows, or samples of different lengths.
    """
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    if not arrays or any(array.shape != arrays[0].shape or array.ndim != 1 for array in arrays) or len(arrays[0]) < 2:
        raise InputError(f"samples: got shapes {[array.shape for array in arrays]}, want one length of at least 2")
    check_number("confidence", confidence, above=0, below=1)
    check_count("resamples", resamples, at_most=1_000_000)
    interval = stats.bootstrap(
        arrays,
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, min(1000, 10_000_000 // len(arrays[0]))),  # bounds the memory
        confidence_level=confidence,
        method="percentile",  # BCa is undefined for medians of counts, which we have
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(float(statistic(*arrays, axis=0)), float(interval.low), float(interval.high), confidence)

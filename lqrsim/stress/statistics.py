"""Statistics of trials: exact intervals of rates, and paired comparisons, mostly by SciPy."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Chance, Count, Index, checked
from lqrsim.errors import Array, InputError, check_array, check_number, excerpt

CONFIDENCE = 0.95


@checked
@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval."""

    value: float
    low: float
    high: float
    confidence: float = CONFIDENCE

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"


@checked
def rate(
    successes: Index, trials: Count, *, confidence: Chance = CONFIDENCE, method: Literal["exact", "wilson"] = "exact"
) -> Estimate:
    """A success rate with its exact (Clopper-Pearson) interval, whose coverage is at least the confidence.

    Wilson's interval is for plots: it is narrower, and its coverage is right on average.
    """
    from scipy import stats  # in functions here: it takes half a second to import, and much of lqrsim.stress needs none

    if successes > trials:
        raise InputError(f"successes: got {successes}, want at most the {trials} trials")
    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method=method)
    return Estimate(successes / trials, float(interval.low), float(interval.high), confidence)


@dataclass(frozen=True)
class PairedComparison:
    """A comparison of two policies on the same trials, with the exact McNemar test."""

    only_first: int
    only_second: int
    p_value: float  # of a split that is at least as uneven, if both policies were equally good


def compare(first: npt.ArrayLike, second: npt.ArrayLike) -> PairedComparison:
    """Compare two policies trial by trial; `first` and `second` (K,) say whether each trial succeeded."""
    from scipy import stats

    first_flags, second_flags = _flags("first", first), _flags("second", second)
    if first_flags.shape != second_flags.shape:
        raise InputError(f"second: got {len(second_flags)} trials, want {len(first_flags)}, as first has")
    only_first, only_second = int(np.sum(first_flags & ~second_flags)), int(np.sum(second_flags & ~first_flags))
    different = only_first + only_second
    p_value = float(stats.binomtest(only_first, different).pvalue) if different else 1.0
    return PairedComparison(only_first, only_second, p_value)


def _flags(field: str, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    array = check_array(field, values, (None,))
    if not len(array) or not np.isin(array, (0, 1)).all():
        raise InputError(f"{field}: got {excerpt(values)}, want at least one trial, each True or False")
    return array.astype(bool)


@checked
def paired_difference(
    only_first: Index, only_second: Index, trials: Count, *, confidence: Chance = CONFIDENCE
) -> Estimate:
    """The difference of the success rates of two policies on the same trials, with Tango's score interval.

    The interval contains each difference that the score test does not reject, with the fractions that are most likely
    under that difference (Tango, Statistics in Medicine 17, 1998). It has a width even if the policies always agree.

    Args:
      only_first, only_second: number of trials in which only this policy succeeded. trials: number of all trials.
    """
    from scipy import stats

    different = only_first + only_second
    if different > trials:
        raise InputError(f"trials: got {trials}, want at least the {different} in which only one succeeded")
    surplus, z = only_first - only_second, float(stats.norm.ppf(0.5 + confidence / 2))

    def accepted(difference: float) -> bool:
        # The likeliest fraction of trials in which only the second succeeds, given the difference, is the root of a
        # quadratic.
        linear = (2 * trials - surplus) * difference - different
        constant = -only_second * difference * (1 - difference)
        fraction = (np.sqrt(max(linear**2 - 8 * trials * constant, 0.0)) - linear) / (4 * trials)
        variance = trials * max(2 * fraction + difference * (1 - difference), 0.0)
        return bool((surplus - trials * difference) ** 2 <= z * z * variance)

    low, high = (_last_accepted(accepted, surplus / trials, end) for end in (-1.0, 1.0))
    return Estimate(surplus / trials, low, high, confidence)


def independent_difference(first: tuple[int, int], second: tuple[int, int]) -> tuple[Estimate, float]:
    """The difference of two success rates, (successes, trials), of independent trials, and Fisher's exact test of it.

    The interval is Newcombe's hybrid score (Statistics in Medicine 17, 1998, method 10): how far the rates can be off
    by their Wilson intervals, added as independent errors are.

    Returns:
      The rate of the first minus that of the second, and the p-value.
    """
    from scipy import stats

    first_rate, second_rate = (rate(*counts, method="wilson") for counts in (first, second))
    value = first_rate.value - second_rate.value
    low = value - float(np.hypot(first_rate.value - first_rate.low, second_rate.high - second_rate.value))
    high = value + float(np.hypot(first_rate.high - first_rate.value, second_rate.value - second_rate.low))
    test = stats.fisher_exact([[reached, trials - reached] for reached, trials in (first, second)])
    return Estimate(value, low, high), float(test.pvalue)  # pyright: ignore[reportAttributeAccessIssue]


def _last_accepted(accepted: Callable[[float], bool], inside: float, outside: float) -> float:
    """The last accepted number between `inside` and `outside`, by bisection down to rounding."""
    for _ in range(60):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if accepted(middle) else (inside, middle)
    return inside


def mean(sample: npt.ArrayLike) -> Estimate:
    """The mean of a sample (K,) with Student's interval."""
    from scipy import stats

    numbers = check_array("sample", sample, (None,))
    if len(numbers) < 2:
        raise InputError(f"sample: got {len(numbers)} numbers, want at least 2")
    half_width = stats.t.ppf(0.5 + CONFIDENCE / 2, len(numbers) - 1) * numbers.std(ddof=1) / np.sqrt(len(numbers))
    middle = float(numbers.mean())
    return Estimate(middle, middle - float(half_width), middle + float(half_width))


def holm(p_values: npt.ArrayLike) -> Array:
    """Adjust the p-values (K,) of several tests for their number (Holm, 1979)."""
    values = check_array("p_values", p_values, (None,))
    for value in values[(values < 0) | (values > 1)]:
        check_number("p_values", value, at_least=0.0, at_most=1.0)
    order = np.argsort(values, kind="stable")
    raised = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)
    return raised[np.argsort(order)]


def rounded(number: float) -> str:
    """The number with two significant digits, without an exponent from 1e-4 to 1e9."""
    return f"{float(f'{number:.2g}'):,.15g}" if number < 1e9 else f"{number:.2g}"

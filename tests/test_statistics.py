"""Intervals and tests against closed forms, brute force, and how often they cover what is known."""

from itertools import product
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper.common import bootstrap
from sampling import rarely
from scipy import optimize, stats

import lqrsim as ls
from lqrsim.stress.statistics import compare, holm, independent_difference, mean, paired_difference, rate, rounded


def at_least(successes: int, trials: int, p: float) -> float:
    """Probability of so many successes or more, summed term by term."""
    return sum(comb(trials, k) * p**k * (1 - p) ** (trials - k) for k in range(successes, trials + 1))


@given(st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))), st.sampled_from([0.9, 0.95]))
def test_exact_interval_is_where_the_tails_are_half_of_what_is_left(case: tuple[int, int], confidence: float) -> None:
    """The definition of Clopper and Pearson; 1e-9, for the bounds are roots of it."""
    successes, trials = case
    found = rate(successes, trials, confidence=confidence)
    tail = (1 - confidence) / 2
    assert found.value == successes / trials
    assert found.low <= found.value <= found.high
    if successes:
        assert at_least(successes, trials, found.low) == pytest.approx(tail, abs=1e-9)
    else:
        assert found.low == 0
    if successes < trials:
        assert 1 - at_least(successes + 1, trials, found.high) == pytest.approx(tail, abs=1e-9)
    else:
        assert found.high == 1


def test_published_values() -> None:
    """0 of 300 by the closed form 1 - 0.025^(1/300); 950 of 1,000 to the three digits of published tables."""
    assert rate(0, 300).high == pytest.approx(1 - 0.025 ** (1 / 300), rel=1e-9)
    assert (round(rate(950, 1000).low, 3), round(rate(950, 1000).high, 3)) == (0.935, 0.963)


@pytest.mark.parametrize("p", [0.02, 0.3, 0.9])
def test_exact_interval_covers(p: float) -> None:
    """Summed over all outcomes: at least what it says, whatever the rate."""
    trials = 40
    covered = 0.0
    for k in range(trials + 1):
        found = rate(k, trials)
        covered += (found.low <= p <= found.high) * comb(trials, k) * p**k * (1 - p) ** (trials - k)
    assert covered >= 0.95


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_s_interval_is_where_the_score_test_just_rejects(case: tuple[int, int]) -> None:
    """Its definition: |rate - p| is 1.96 standard deviations of p at both ends."""
    successes, trials = case
    found = rate(successes, trials, method="wilson")
    for end in (found.low, found.high):
        distance = abs(found.value - end)
        assert distance == pytest.approx(1.959964 * np.sqrt(end * (1 - end) / trials), abs=1e-6)
    assert found.low <= found.value + 1e-12
    assert found.value <= found.high + 1e-12


def test_holm_s_procedure() -> None:
    """By hand: of three, the smallest is tripled, the next doubled, and none falls below one before it."""
    np.testing.assert_allclose(holm([0.04, 0.01, 0.03]), [0.06, 0.03, 0.06])
    np.testing.assert_allclose(holm([0.9, 0.8]), 1.0)
    assert len(holm([])) == 0
    for wrong in ([-1.0, 0.5], [0.5, 1.0 + 1e-9], [2]):
        with pytest.raises(ls.InputError, match=r"p_values: got [-\d.]*, want a finite number >= 0 and <= 1"):
            holm(wrong)


def test_paired_test_is_the_sign_test_of_those_that_differ() -> None:
    """Brute force: of all ways the pairs that differ could have gone, those that are no more likely than this one."""
    first, second = [True] * 9 + [False] * 3 + [True] * 5, [False] * 8 + [True] * 4 + [True] * 5
    found = compare(first, second)
    assert (found.only_first, found.only_second) == (8, 3)
    ways = [sum(way) for way in product((0, 1), repeat=11)]
    assert found.p_value == pytest.approx(np.mean([comb(11, k) <= comb(11, 8) for k in ways]), rel=1e-12)
    assert compare(first, first).p_value == 1


@pytest.mark.parametrize(
    ("only_first", "only_second", "trials", "confidence", "published"),
    [
        (1, 7, 21, 0.95, (-0.517, -0.026)),  # Fagerland, Lydersen & Laake, Statistics in Medicine 33 (2014)
        (0, 1, 44, 0.90, (-0.096, 0.037)),  # Tango, Statistics in Medicine 17 (1998)
    ],
)
def test_published_differences(
    only_first: int, only_second: int, trials: int, confidence: float, published: tuple[float, float]
) -> None:
    found = paired_difference(only_first, only_second, trials, confidence=confidence)
    assert (round(found.low, 3), round(found.high, 3)) == published
    assert found.value == (only_first - only_second) / trials


@given(st.tuples(st.integers(0, 80), st.integers(0, 80), st.integers(0, 80)).filter(any))
def test_ends_of_a_difference_are_where_the_score_test_just_rejects(case: tuple[int, int, int]) -> None:
    """Its definition, with the likeliest shares found by brute force in place of the formula; 1e-4, for that search."""
    only_first, only_second, alike = case
    trials = only_first + only_second + alike
    found = paired_difference(only_first, only_second, trials)
    mirrored = paired_difference(only_second, only_first, trials)
    assert (mirrored.low, mirrored.high) == (pytest.approx(-found.high), pytest.approx(-found.low))
    assert -1 <= found.low <= found.value <= found.high <= 1
    assert found.high - found.low > 0
    counts = np.array([only_first, only_second, trials - only_first - only_second])
    for end in (found.low, found.high):
        if abs(end) > 0.999:
            continue
        least, most = max(0.0, -end), (1 - end) / 2

        def unlikely(share: float, end: float = end) -> float:
            shares = np.maximum([share + end, share, 1 - end - 2 * share], 1e-300)
            return -float(counts @ np.log(shares))

        share = optimize.minimize_scalar(unlikely, bounds=(least, most), method="bounded", options={"xatol": 1e-10}).x
        deviation = np.sqrt(max(2 * share + end - end * end, 0) / trials)
        assert abs(found.value - end) == pytest.approx(1.959964 * deviation, abs=1e-4)


@pytest.mark.parametrize("trials", [20, 50])
@pytest.mark.parametrize(("first", "second"), [(0.01, 0.0), (0.05, 0.04), (0.3, 0.2), (0.6, 0.0)])
def test_differences_cover(trials: int, first: float, second: float) -> None:
    """Summed over all outcomes. A score interval covers 95 % in the mean, and nowhere here less than 94 %."""
    covered = 0.0
    for one, other in product(range(trials + 1), repeat=2):
        if one + other <= trials:
            weight = stats.multinomial.pmf(
                [one, other, trials - one - other], trials, [first, second, 1 - first - second]
            )
            if weight > 1e-7:
                found = paired_difference(one, other, trials)
                covered += weight * (found.low <= first - second <= found.high)
    assert covered > 0.94


@pytest.mark.parametrize(
    ("first", "second", "published"),
    [
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.1705, 0.8090)),
        ((6, 7), (2, 7), (0.0582, 0.8062)),
        ((5, 56), (0, 29), (-0.0381, 0.1926)),
        ((0, 10), (0, 20), (-0.1611, 0.2775)),
        ((10, 10), (0, 20), (0.6791, 1.0)),
    ],
)
def test_published_differences_of_independent_rates(
    first: tuple[int, int], second: tuple[int, int], published: tuple[float, float]
) -> None:
    """Newcombe, Statistics in Medicine 17 (1998), Table II, method 10, to its four digits."""
    found, _ = independent_difference(first, second)
    assert found.value == first[0] / first[1] - second[0] / second[1]
    assert (round(found.low, 4), round(found.high, 4)) == published


@given(st.tuples(st.integers(1, 40), st.integers(1, 40)).flatmap(
    lambda n: st.tuples(st.integers(0, n[0]), st.just(n[0]), st.integers(0, n[1]), st.just(n[1]))
))  # fmt: skip
def test_fisher_s_test_is_the_sum_of_tables_that_are_no_more_likely(case: tuple[int, int, int, int]) -> None:
    """By binomial coefficients; 1e-6 of a probability counts as equal, as for SciPy's."""
    k, n, other, m = case
    ways = {i: comb(n, i) * comb(m, k + other - i) for i in range(max(0, k + other - m), min(n, k + other) + 1)}
    wanted = sum(way for way in ways.values() if way <= ways[k] * (1 + 1e-6)) / comb(n + m, k + other)
    assert independent_difference((k, n), (other, m))[1] == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("trials", [(20, 50), *rarely(((20, 20),))])
@pytest.mark.parametrize(("first", "second"), [(0.98, 0.97), (0.9, 0.1), *rarely((0.9, 0.7), (0.5, 0.5))])
def test_differences_of_independent_rates_cover(trials: tuple[int, int], first: float, second: float) -> None:
    """Summed over all outcomes. A score interval covers 95 % in the mean, and nowhere here less than 93 %."""
    covered = 0.0
    chances = [stats.binom.pmf(np.arange(n + 1), n, p) for n, p in zip(trials, (first, second), strict=True)]
    for one, other in product(*(range(n + 1) for n in trials)):
        if (weight := chances[0][one] * chances[1][other]) > 1e-7:
            found, _ = independent_difference((one, trials[0]), (other, trials[1]))
            covered += weight * (found.low <= first - second <= found.high)
    assert covered > 0.93


@given(st.integers(2, 20), st.floats(1e-3, 1e3), st.integers(0, 2**32 - 1))
def test_mean_has_student_s_interval(count: int, scale: float, seed: int) -> None:
    """That of SciPy's t-test; to rounding."""
    sample = scale * np.random.default_rng(seed).normal(0.5, 1.0, count)
    found, interval = mean(sample), stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
    assert found.value == sample.mean()
    np.testing.assert_allclose((found.low, found.high), interval, rtol=1e-9, atol=1e-9 * scale)


def test_bootstrap_of_a_mean_is_near_the_normal_interval() -> None:
    """At 2,000 normal draws the two agree to the noise of 10,000 resamples: 3 % of the width."""
    sample = np.random.default_rng(1).normal(size=2000)
    found = bootstrap(lambda x, axis: x.mean(axis), sample)
    half = 1.96 * sample.std() / np.sqrt(len(sample))
    assert found.low == pytest.approx(sample.mean() - half, abs=0.06 * half)
    assert found.high == pytest.approx(sample.mean() + half, abs=0.06 * half)
    assert found == bootstrap(lambda x, axis: x.mean(axis), sample)


def test_bootstrap_keeps_pairs_together() -> None:
    """The ratio of a sample to twice itself is 1/2 in each resample."""
    sample = np.random.default_rng(1).exponential(size=50)
    found = bootstrap(lambda x, y, axis: x.mean(axis) / y.mean(axis), sample, 2 * sample)
    np.testing.assert_allclose((found.value, found.low, found.high), 0.5, rtol=1e-12)
    assert f"{found:.2f}" == "0.50 [0.50, 0.50]"


def test_bootstrap_covers() -> None:
    """The median of 40 counts, where other intervals are not defined: of 200 studies 95 %, less three deviations."""
    rng = np.random.default_rng(3)
    draws = rng.exponential(size=(200, 40))
    found = [bootstrap(lambda x, axis: np.median(x, axis), draw, resamples=500) for draw in draws]
    covered = sum(one.low <= np.log(2) <= one.high for one in found)
    assert covered >= 200 * 0.95 - 3 * np.sqrt(200 * 0.95 * 0.05)


@given(st.floats(1e-4, 1e12))
def test_rounded_numbers_have_two_digits(number: float) -> None:
    said = rounded(number)
    assert float(said.replace(",", "")) == float(f"{number:.2g}")
    assert ("e" in said) == (number >= 1e9)

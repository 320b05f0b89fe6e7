"""How often intervals cover the true value: differences of two policies on the same trials, and rare failures.

    python experiments/benchmark_intervals.py            # everything, some minutes
    python experiments/benchmark_intervals.py --quick    # bounded, and coarse

differences  Success of two policies on the same n trials. The coverage is exact: the sum of the probabilities of all
             outcomes whose interval holds the difference, over a grid of the shares in which only one succeeds.
rare         `split` of a standard normal number beyond a threshold, whose probability is known, again and again.
cliff        The same with a second way to fail that the score does not announce.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from runner import Settings, opening, run
from scipy import stats

from lqrsim.errors import Array
from lqrsim.stress.reliability import NoFailure, failure_probability
from lqrsim.stress.statistics import CONFIDENCE, Estimate, paired_difference

TRIALS = 20, 50, 200, 500
SHARES = 0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4
# Probability, numbers, particles, repetitions: those of `lqrsim rare`, and less.
RARE = (
    (1e-2, 3, 250, 10),
    (1e-4, 3, 250, 10),
    (1e-6, 3, 250, 10),
    (1e-4, 100, 250, 10),
    (1e-4, 3, 250, 3),
    (1e-4, 3, 50, 10),
    (1e-3, 3, 20, 10),
)


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    """What is measured."""

    studies: int = 2000
    """Of each rare failure."""


@cache
def interval(only_first: int, only_second: int, trials: int) -> Estimate:
    return paired_difference(only_first, only_second, trials)


def covered(trials: int, first: float, second: float) -> float:
    """The probability that the interval holds the difference, less that of outcomes rarer than 1e-9 each."""
    outcomes = np.array(list(product(_likely(trials, first), _likely(trials, second))))
    outcomes = np.column_stack([outcomes, trials - outcomes.sum(axis=1)])
    outcomes = outcomes[outcomes[:, 2] >= 0]
    weights = stats.multinomial.pmf(outcomes, trials, [first, second, 1 - first - second])
    total = 0.0
    for (one, other, _), weight in zip(outcomes[weights > 1e-9].tolist(), weights[weights > 1e-9], strict=True):
        found = interval(one, other, trials)
        total += float(weight) * (found.low <= first - second <= found.high)
    return total


def _likely(trials: int, share: float) -> range:
    low, high = stats.binom.ppf([1e-9, 1 - 1e-9], trials, share)
    return range(int(low), int(high) + 1)


def differences(config: Config) -> list[dict[str, Any]]:
    found = []
    for trials in TRIALS[:2] if config.quick else TRIALS:
        grid = [(one, other) for one, other in product(SHARES, SHARES) if one >= other and 0 < one + other < 1]
        of_grid = {pair: covered(trials, *pair) for pair in (grid[::4] if config.quick else grid)}
        worst = min(of_grid, key=of_grid.__getitem__)
        found.append({"trials": trials, "pairs": len(of_grid), "mean": float(np.mean(list(of_grid.values()))),
                      "least": of_grid[worst], "at": worst})  # fmt: skip
    return found


def rare(config: Config) -> list[dict[str, Any]]:
    cases = RARE[::3] if config.quick else RARE
    return [coverage(config, beyond(chance), chance, *others) for chance, *others in cases]


def cliff(config: Config) -> list[dict[str, Any]]:
    """Two ways to fail: the score rises towards the one, and not towards the other until it is there."""
    first, second = 4.0, 4.2

    def hidden(z: Array) -> Array:
        return np.maximum(z[:, 0] - first, np.where(z[:, 1] > second, z[:, 1] - second, -5 + 0.1 * z[:, 1]))

    chances = stats.norm.sf([first, second])
    both = float(chances.sum() - chances.prod())
    return [
        coverage(config, beyond(float(chances[0])), float(chances[0]), 2, 250, 10),
        coverage(config, hidden, both, 2, 250, 10),
    ]


def beyond(probability: float) -> Callable[[Array], Array]:
    """The score of vectors whose first number is that large."""
    threshold = stats.norm.isf(probability)
    return lambda z: z[:, 0] - threshold


def coverage(
    config: Config, score: Callable[[Array], Array], probability: float, size: int, particles: int, repetitions: int
) -> dict[str, Any]:
    below = above = none = 0
    widths = []
    studies = min(config.studies, 40) if config.quick else config.studies
    for seed in range(studies):
        try:
            one = failure_probability(
                score, size, particles=particles, repetitions=repetitions, seed=seed
            ).probability  # fmt: skip
        except NoFailure:
            none += 1
            continue
        below += one.high < probability
        above += one.low > probability
        widths.append(one.high / one.low)
    given = studies - none
    return {"probability": probability, "size": size, "particles": particles, "repetitions": repetitions,
            "studies": studies, "none": none, "covered": 1 - (below + above) / given, "below": below / given,
            "above": above / given, "width": float(np.median(widths))}  # fmt: skip


def main(config: Config) -> dict[str, Any]:
    return opening(config) | {"differences": differences(config), "rare": rare(config), "cliff": cliff(config)}


def report(result: dict[str, Any]) -> str:
    lines = [f"differences of success, {100 * CONFIDENCE:g} % intervals; coverage, exact",
             f"{'trials':>6} {'pairs of shares':>16} {'mean':>7} {'least':>7}  at"]  # fmt: skip
    for one in result["differences"]:
        lines.append(f"{one['trials']:>6} {one['pairs']:>16} {one['mean']:>7.3f} {one['least']:>7.3f}  {one['at']}")
    for name, what in (("rare", "rare failures"), ("cliff", "one way to fail, and two, of which one is a cliff")):
        lines += ["", f"{what}, {100 * CONFIDENCE:g} % intervals; coverage, of studies that found a failure",
                  f"{'probability':>11} {'numbers':>8} {'particles':>9} {'repetitions':>11} {'studies':>7} {'none':>5}"
                  f" {'covered':>7} {'too low':>7} {'too high':>8} {'high/low':>8}"]  # fmt: skip
        lines += [
            f"{one['probability']:>11.3g} {one['size']:>8} {one['particles']:>9} {one['repetitions']:>11}"
            f" {one['studies']:>7} {one['none']:>5} {one['covered']:>7.3f} {one['below']:>7.3f} {one['above']:>8.3f}"
            f" {one['width']:>8.1f}"
            for one in result[name]
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

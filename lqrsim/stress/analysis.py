"""The answers of a stress test: how often each policy succeeds, which is better, how it fails, and where it breaks.

All of it is of a table, `Mapping[Cell, Outcomes]`. A trial succeeds if its outcome is "reached"; all else is a failure.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_count, check_name, check_number
from lqrsim.stress.outcome_table import Outcomes
from lqrsim.stress.specification import Cell
from lqrsim.stress.statistics import CONFIDENCE, Estimate, Pairs, compare, holm, mean, paired_difference, rate, wilson

Table = Mapping[Cell, Outcomes]

MEASURES = {  # with units; those of tracking errors and of the goal's distance are of robots with a position
    "worst": "m", "rms": "m", "final": "m", "goal": "m", "clearance": "m", "effort": "unit² s",
    "saturated": "", "cost": "",
}  # fmt: skip
LEVELS = (0.05, 0.5, 0.95)


def succeeded(outcomes: Outcomes) -> npt.NDArray[np.bool_]:
    """Which trials reached their goal, (K,)."""
    return outcomes.outcome == "reached"


@dataclass(frozen=True)
class Success:
    """How often a cell's trials succeeded.

    Attributes:
      exact: the rate with the interval of Clopper and Pearson, for claims. band: with Wilson's, for plots.
      alike: all trials are the same, as without a disturbance; the rate is then known, and has no interval.
    """

    cell: Cell
    reached: int
    trials: int
    exact: Estimate
    band: Estimate
    alike: bool


def success(cell: Cell, outcomes: Outcomes, *, confidence: float = CONFIDENCE) -> Success:
    """How often the trials of a cell succeeded, and how sure that is. Raises InputError for no trials."""
    reached, trials = int(succeeded(outcomes).sum()), len(outcomes)
    exact, band = rate(reached, trials, confidence=confidence), wilson(reached, trials, confidence=confidence)
    same = alike(outcomes)
    if same:
        exact = band = Estimate(exact.value, exact.value, exact.value, confidence)
    return Success(cell, reached, trials, exact, band, same)


def alike(outcomes: Outcomes) -> bool:
    """Whether all trials, of several, are the same run."""
    numbers = (outcomes.ended, outcomes.rms, outcomes.worst, outcomes.effort)
    same = all(np.array_equal(one, np.full_like(one, one[0]), equal_nan=True) for one in numbers)
    return len(outcomes) > 1 and same and len(set(outcomes.outcome.tolist())) == 1


def degradation(table: Table, policy: str, sweep: str, *, confidence: float = CONFIDENCE) -> list[Success]:
    """Success of a policy over the strength of a sweep, the weakest first. Raises InputError if there is none."""
    check_name("policy", policy, dict.fromkeys(cell.policy for cell in table))
    check_name("sweep", sweep, dict.fromkeys(cell.sweep for cell in table))
    cells = [cell for cell in table if (cell.policy, cell.sweep) == (policy, sweep)]
    return [success(cell, table[cell], confidence=confidence) for cell in sorted(cells, key=lambda cell: cell.strength)]


@dataclass(frozen=True)
class BreakingPoint:
    """Where a policy breaks.

    Attributes:
      strength: the least that was tried at which the interval of its success lies below `below`; None: at none.
      success: there.
    """

    policy: str
    sweep: str
    below: float
    strength: float | None
    success: Estimate | None


def breaks(table: Table, *, below: float = 0.95, confidence: float = CONFIDENCE) -> list[BreakingPoint]:
    """What breaks first: for each policy and sweep, the least strength with less success than `below`, surely so.

    What breaks at the least strength comes first, what does not break last.

    Raises:
      InputError: `below` is no rate.
    """
    check_number("below", below, above=0.0, at_most=1.0)
    breaking_points = []
    for policy, sweep in dict.fromkeys((cell.policy, cell.sweep) for cell in table):
        points = degradation(table, policy, sweep, confidence=confidence)
        first = next((point for point in points if point.exact.high < below), None)
        strength, exact = (None, None) if first is None else (first.cell.strength, first.exact)
        breaking_points.append(BreakingPoint(policy, sweep, below, strength, exact))
    return sorted(breaking_points, key=lambda one: np.inf if one.strength is None else one.strength)


@dataclass(frozen=True)
class Comparison:
    """Two policies on the same trials.

    Attributes:
      pairs: in how many trials only one of them succeeded, and the exact test of that.
      success: of the first less that of the second. rms: the same of the mean tracking error, among the
        `both` trials in which both succeeded; None if there are fewer than two.
      adjusted: the p-value, for as many comparisons as were made.
    """

    first: Cell
    second: Cell
    pairs: Pairs
    success: Estimate
    rms: Estimate | None
    both: int
    adjusted: float


def comparisons(table: Table) -> list[Comparison]:
    """The first policy of the table against each other one, in every sweep and at every strength at which it meets it.

    Differences are on the same trials: of success with Tango's score interval, of errors with Student's. Where the
    trials of both are all alike, they are one trial and there is nothing to test.

    Raises:
      InputError: two policies ran other trials.
    """
    policies = list(dict.fromkeys(cell.policy for cell in table))
    compared: list[Comparison] = []
    for other in policies[1:]:
        for cell in table:
            second = Cell(other, cell.sweep, cell.strength)
            if cell.policy != policies[0] or second not in table:
                continue
            if not (alike(table[cell]) and alike(table[second])):
                compared.append(_compared(cell, second, table[cell], table[second]))
    adjusted = holm([one.pairs.p_value for one in compared])
    return [
        Comparison(one.first, one.second, one.pairs, one.success, one.rms, one.both, float(p))
        for one, p in zip(compared, adjusted, strict=True)
    ]


def _compared(first: Cell, second: Cell, one: Outcomes, other: Outcomes) -> Comparison:
    if not np.array_equal(one.trial, other.trial):
        raise InputError(f"{second}: got other trials than those of {first}, want the same, in the same order")
    pairs = compare(succeeded(one), succeeded(other))
    difference = paired_difference(pairs.only_first, pairs.only_second, len(one))
    both = succeeded(one) & succeeded(other)
    rms = mean(one.rms[both] - other.rms[both]) if both.sum() > 1 else None
    return Comparison(first, second, pairs, difference, rms, int(both.sum()), pairs.p_value)


def modes(outcomes: Outcomes) -> dict[tuple[str, str], int]:
    """How trials failed: outcome and obstacle (empty if it was none) -> how many, the most frequent first."""
    failed = ~succeeded(outcomes)
    kinds = zip(outcomes.outcome[failed].tolist(), outcomes.obstacle[failed].tolist(), strict=True)
    return dict(sorted(Counter(kinds).items(), key=lambda kind: (-kind[1], kind[0])))


def quantiles(outcomes: Outcomes, measure: str, levels: Sequence[float] = LEVELS) -> Array:
    """Quantiles of a measure (see MEASURES) over the trials that have it; NaN if none has.

    Infinite values count: where there are no obstacles, all clearance is.
    """
    values = getattr(outcomes, check_name("measure", measure, MEASURES))
    values = values[~np.isnan(values)]
    # Not interpolated, which would make a NaN of two infinite values.
    return np.quantile(values, levels, method="inverted_cdf") if len(values) else np.full(len(levels), np.nan)


RANKING = (
    "Worst are trials that did not run through, then those that collided or were lost, the earliest first, then those"
    " with the least clearance, then those with the largest tracking error."
)


@dataclass(frozen=True)
class Trial:
    """One trial of a cell; its row of the outcomes."""

    cell: Cell
    trial: int
    outcome: str
    obstacle: str
    ended: float
    clearance: float
    worst: float


def worst(table: Table, count: int = 10) -> list[Trial]:
    """The worst trials of all cells, ranked as RANKING says."""
    check_count("count", count)
    ranked: list[tuple[tuple[float, ...], Trial]] = []
    for cell, outcomes in table.items():
        over = np.isin(outcomes.outcome, ("collided", "diverged"))
        keys = (
            np.where(outcomes.outcome == "error", 0.0, np.where(over, 1.0, 2.0)),
            np.where(over, outcomes.ended, 0.0),
            np.nan_to_num(outcomes.clearance, nan=-np.inf, posinf=np.inf, neginf=-np.inf),
            -np.nan_to_num(outcomes.worst, nan=np.inf, posinf=np.inf, neginf=-np.inf),
        )
        for row in np.lexsort((outcomes.trial, *reversed(keys)))[:count]:
            trial = Trial(
                cell,
                int(outcomes.trial[row]),
                str(outcomes.outcome[row]),
                str(outcomes.obstacle[row]),
                *(float(values[row]) for values in (outcomes.ended, outcomes.clearance, outcomes.worst)),
            )
            ranked.append((tuple(float(key[row]) for key in keys), trial))
    return [trial for _, trial in sorted(ranked, key=lambda one: one[0])[:count]]

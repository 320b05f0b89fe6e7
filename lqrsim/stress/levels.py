"""The largest of nested levels at which trials succeed at a given rate, certified with a given confidence.

A pilot search finds a candidate by steps and bisection, with the same random numbers at each level. Fresh trials then
test fixed fractions of that level, from the smallest up, each with the whole confidence, until a test fails; the last
level that passed is the result. The order is fixed before the fresh trials run, and a level is tested only if all
smaller levels passed. A result is therefore wrong only if the first level with too low a rate passes its test, which is
as improbable as that test allows. The confidence need not be divided among the levels (the fixed-sequence procedure;
Maurer, Hothorn & Lehmacher, 1995). The tests may share their trials. They are exact: a level passes if the one-sided
bound of Clopper and Pearson is at least the rate.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Chance, checked
from lqrsim.errors import InputError
from lqrsim.stress.statistics import rate as rate_of

SHARES = (0.7, 0.9, 1.0)  # fractions of the pilot's level, in the order in which they are tested
NEAR = 1.04  # the pilot's accuracy: ratio of a level with too many failures to its result
HALVINGS = 40  # number of steps down after which the pilot gives up
FEW = 64  # trials of the pilot's coarse search
BATCH = 512  # trials that are simulated together
MOST_TRIALS = 1_000_000

Runs = Callable[[float, npt.NDArray[np.intp]], npt.NDArray[np.bool_]]


@dataclass(frozen=True)
class LevelTest:
    """The test that a level has to pass.

    Attributes:
      trials: number of trials. failures: number of trials that may fail. aim: number that may fail in the pilot. It is
        smaller, because a level that just passes in the pilot would fail every second test.
    """

    trials: int
    failures: int
    aim: int


@checked
def smallest_test(
    rate: Chance, confidence: Chance, failures: Annotated[int, Bounds(at_least=0, at_most=10_000)]
) -> LevelTest:
    """The test with the fewest trials that proves the rate with the given confidence if `failures` trials fail."""

    def proves(trials: int) -> bool:
        return lowest_rate(trials - failures, trials, confidence) >= rate

    high = failures + 1
    while not proves(high):
        high *= 2
        if high > MOST_TRIALS:
            raise InputError(
                f"rate: got {rate:g} with confidence {confidence:g} and failures {failures}, which needs more than"
                f" {MOST_TRIALS:,} trials, want a smaller one of the three"
            )
    low = failures  # trials that all fail
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if proves(middle) else (middle, high)
    return LevelTest(high, failures, (2 * failures) // 3)


def lowest_rate(successes: int, trials: int, confidence: float) -> float:
    """The exact one-sided lower bound of a success rate: the bound of a two-sided interval with less confidence."""
    if confidence < 0.5:  # there is no such two-sided interval
        raise InputError(f"confidence: got {confidence:g}, want a number >= 0.5")
    return rate_of(successes, trials, confidence=max(2 * confidence - 1, 1e-12)).low


@dataclass(frozen=True)
class FoundLevel:
    """A certified level.

    Attributes:
      level: 0 if no level passed. trials, successes: the numbers in its test. reason: why the level is 0, or why no
        larger level was tried; else empty. pilot: the pilot's level. simulated: number of all trials.
    """

    level: float
    trials: int
    successes: int
    reason: str
    pilot: float
    simulated: int


def find_level(runs: Runs, test: LevelTest, *, guess: float, largest: float, rate: float) -> FoundLevel:
    """Find the largest level that passes the test, within the accuracy of the pilot.

    Args:
      runs: (level, numbers of the trials (K,)) -> whether each succeeds. Trials with different numbers are independent;
        a trial has the same random numbers at all levels.
      guess: level at which the pilot begins. largest: largest level that is tried. rate: tested rate, for the text of
        the reason.
    """
    pilot = _Pilot(runs, test)
    aimed = pilot.level(min(guess, largest), largest)
    if aimed == 0:
        failed = pilot.failures(0.0, test.trials)
        if failed > test.aim:
            reason = (
                f"begun on the plan itself, {failed} of {test.trials} trials fail; to prove a rate of {rate:g}, at most"
                f" {test.aim} may"
            )
        else:
            reason = "too many trials fail at all levels that were tried, down to the smallest"
        return FoundLevel(0.0, 0, 0, reason, 0.0, pilot.simulated)
    passed, stopped, simulated = (0.0, 0, 0), "", pilot.simulated
    for level in dict.fromkeys(min(share * aimed, largest) for share in SHARES):
        failed, done = fresh(runs, level, test)
        simulated += done
        if failed > test.failures:
            stopped = f"{failed} of {done} fresh trials fail at level {level:.4g}; {test.failures} of {test.trials} may"
            break
        passed = level, test.trials, test.trials - failed
    beyond = f"levels beyond {largest:.4g} were not tried" if passed[0] == largest else ""
    return FoundLevel(*passed, beyond if passed[0] else stopped, aimed, simulated)


def fresh(runs: Runs, level: float, test: LevelTest) -> tuple[int, int]:
    """Run the test's own trials, which the pilot has not used. Returns the number of failures and the number of trials.

    It stops as soon as too many trials have failed.
    """
    failed, done = 0, 0
    while done < test.trials and failed <= test.failures:
        count = min(BATCH, test.trials - done)
        succeeded = runs(level, np.arange(test.trials + done, test.trials + done + count))
        failed, done = failed + count - int(np.sum(succeeded)), done + count
    return failed, done


class _Pilot:
    """The search for a level. It saves trials by assuming that a trial that succeeds also succeeds at all lower levels.

    If this is wrong, the level is less accurate. The fresh trials do not rely on the assumption.
    """

    def __init__(self, runs: Runs, test: LevelTest) -> None:
        self.runs, self.test, self.simulated = runs, test, 0
        self._good = np.full(test.trials, -np.inf)  # the largest level at which each trial has succeeded
        self._bad = np.full(test.trials, np.inf)  # the smallest level at which each trial has failed

    def failures(self, level: float, trials: int) -> int:
        """Number of failures at a level among the first `trials` trials."""
        unknown = np.flatnonzero((self._good[:trials] < level) & (self._bad[:trials] > level))
        for first in range(0, len(unknown), BATCH):
            numbers = unknown[first : first + BATCH]
            succeeded = self.runs(level, numbers)
            self._good[numbers[succeeded]], self._bad[numbers[~succeeded]] = level, level
        self.simulated += len(unknown)
        return int(np.sum(self._bad[:trials] <= level))

    def level(self, guess: float, largest: float) -> float:
        """The largest level that seems to pass; 0 if there is none.

        A few trials find the rough level, then all trials run there. At lower levels only the trials that failed run
        again.
        """
        test = self.test
        few = min(FEW, test.trials)
        some = max(int(np.ceil(2 * test.aim * few / test.trials)), 2 if few < test.trials else test.aim)
        high = self._last(lambda level: self.failures(level, few) <= some, guess, largest, factor=2.0)
        if high == 0:
            return 0.0
        return self._last(lambda level: self.failures(level, test.trials) <= test.aim, high, largest, factor=1.2)

    @staticmethod
    def _last(good: Callable[[float], bool], guess: float, largest: float, *, factor: float) -> float:
        """The largest good level, by steps of the factor and bisection; 0 if none is found."""
        low = high = guess
        if good(guess):
            while low < largest:
                high = min(factor * low, largest)
                if not good(high):
                    break
                low = high
            else:
                return largest
        else:
            for _ in range(HALVINGS):
                low = high / factor
                if good(low):
                    break
                high = low
            else:
                return 0.0
        while high > NEAR * low:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if good(middle) else (low, middle)
        return low

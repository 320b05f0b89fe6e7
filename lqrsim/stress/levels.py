"""The largest of nested levels at which trials succeed with a stated rate, and how sure that is.

A pilot looks for it, by steps and bisection, with the same random numbers at each level. What it says is not
believed. Fresh trials then test levels that are fixed shares of the pilot's, from the smallest up, each at the whole
confidence, until one does not pass: the last that did is the answer. That order is fixed before the fresh trials are
run, and a level is only tested if all below it passed. So a wrong claim needs the first level at which the rate is too
low to pass its test, which is as improbable as that test allows: no confidence has to be shared among the levels, and
none is lost to choosing (the fixed-sequence procedure; Maurer, Hothorn & Lehmacher, 1995). The tests may share their
trials. They are exact: a test passes if the one-sided bound of Clopper and Pearson is at least the rate.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import InputError, check_count, check_number
from lqrsim.stress.statistics import rate as rate_of

SHARES = (0.7, 0.9, 1.0)  # of the pilot's level, in the order in which they are tested
NEAR = 1.04  # how near the pilot comes: the ratio of a level at which too many fail to the one that it returns
HALVINGS = 40  # after which there is no level
FEW = 64  # trials that find out about where the level is
BATCH = 512  # trials that are run together
MOST_TRIALS = 1_000_000

Runs = Callable[[float, npt.NDArray[np.intp]], npt.NDArray[np.bool_]]


@dataclass(frozen=True)
class Test:
    """What a level has to pass.

    Attributes:
      trials: that are run. failures: of them that are allowed. aim: that the pilot allows of as many: fewer, for what
        just passes there would fail every other time.
    """

    trials: int
    failures: int
    aim: int


def smallest_test(rate: float, confidence: float, failures: int) -> Test:
    """The fewest trials of which so many may fail, so that the rate is shown with that confidence.

    Raises:
      InputError: one is out of range, or it takes more trials than anybody wants to run.
    """
    rate = check_number("rate", rate, above=0.0, below=1.0)
    confidence = check_number("confidence", confidence, above=0.0, below=1.0)
    check_count("failures", failures, at_least=0, at_most=10_000)

    def shown(trials: int) -> bool:
        return lowest_rate(trials - failures, trials, confidence) >= rate

    high = failures + 1
    while not shown(high):
        high *= 2
        if high > MOST_TRIALS:
            raise InputError(
                f"rate: got {rate:g} with confidence {confidence:g} and failures {failures}, which take more than"
                f" {MOST_TRIALS:,} trials, want less of one of them"
            )
    low = failures  # of which none succeeds
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if shown(middle) else (middle, high)
    return Test(high, failures, (2 * failures) // 3)


def lowest_rate(successes: int, trials: int, confidence: float) -> float:
    """The exact lower bound of a success rate: one-sided, so it is that of a two-sided interval of less confidence."""
    if confidence < 0.5:  # which no two-sided interval has
        raise InputError(f"confidence: got {confidence:g}, want a number >= 0.5")
    return rate_of(successes, trials, confidence=max(2 * confidence - 1, 1e-12)).low


@dataclass(frozen=True)
class FoundLevel:
    """What was found.

    Attributes:
      level: 0 where none passed. trials, successes: of its test. reason: why it is 0, or what kept larger ones from
        being tried; else empty. pilot: the pilot's level. simulated: trials that were run in all.
    """

    level: float
    trials: int
    successes: int
    reason: str
    pilot: float
    simulated: int


def find_level(runs: Runs, test: Test, *, guess: float, largest: float, rate: float) -> FoundLevel:
    """The largest level that passes the test, as far as the pilot finds it.

    Args:
      runs: (level, numbers of the trials (K,)) -> which of them succeed. Trials of different numbers are independent;
        those of the same number have the same random numbers at all levels.
      guess: where the pilot begins. largest: beyond which it does not look. rate: that is tested, for the reason.
    """
    pilot = _Pilot(runs, test)
    aimed = pilot.level(min(guess, largest), largest)
    if aimed == 0:
        failed = pilot.failures(0.0, test.trials)
        if failed > test.aim:
            reason = (
                f"begun on the plan itself, {failed} of {test.trials} trials fail, and no more than {test.aim} may for"
                f" {rate:g} to be shown"
            )
        else:
            reason = "too many trials fail at every level that was tried, however small"
        return FoundLevel(0.0, 0, 0, reason, 0.0, pilot.simulated)
    found, stopped, simulated = (0.0, 0, 0), "", pilot.simulated
    for level in dict.fromkeys(min(share * aimed, largest) for share in SHARES):
        failed, done = fresh(runs, level, test)
        simulated += done
        if failed > test.failures:
            stopped = f"{failed} of {done} fresh trials fail at level {level:.4g}; {test.failures} of {test.trials} may"
            break
        found = level, test.trials, test.trials - failed
    reason = stopped if found[0] == 0 else f"levels beyond {largest:.4g} were not tried" if found[0] == largest else ""
    return FoundLevel(*found, reason, aimed, simulated)


def fresh(runs: Runs, level: float, test: Test) -> tuple[int, int]:
    """How many of the test's own trials fail, and of how many; no more are run once it is more than allowed.

    No pilot has seen these trials.
    """
    failed, done = 0, 0
    while done < test.trials and failed <= test.failures:
        count = min(BATCH, test.trials - done)
        succeeded = runs(level, np.arange(test.trials + done, test.trials + done + count))
        failed, done = failed + count - int(np.sum(succeeded)), done + count
    return failed, done


class _Pilot:
    """Looks for a level. It takes a trial that succeeds to succeed at all lower levels, too, and so runs few again.

    Where that is not so it looks in the wrong place; the fresh trials do not rest on it.
    """

    def __init__(self, runs: Runs, test: Test) -> None:
        self.runs, self.test, self.simulated = runs, test, 0
        self._good = np.full(test.trials, -np.inf)  # the largest level at which each has succeeded
        self._bad = np.full(test.trials, np.inf)  # the smallest one at which it has failed

    def failures(self, level: float, trials: int) -> int:
        """How many of the first trials fail."""
        unknown = np.flatnonzero((self._good[:trials] < level) & (self._bad[:trials] > level))
        for first in range(0, len(unknown), BATCH):
            numbers = unknown[first : first + BATCH]
            succeeded = self.runs(level, numbers)
            self._good[numbers[succeeded]], self._bad[numbers[~succeeded]] = level, level
        self.simulated += len(unknown)
        return int(np.sum(self._bad[:trials] <= level))

    def level(self, guess: float, largest: float) -> float:
        """The largest level of which it seems that it would pass; 0 where there is none.

        A few trials find about where some fail, all trials how many do there. From there down only those have to be run
        that failed.
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
        """The largest level that is good, by steps of the factor and bisection; 0 where none is found."""
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

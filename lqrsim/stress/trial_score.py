"""Trials as a function of the numbers that they draw: a vector of standard normal numbers decides on all of a trial.

So what is rare can be searched for in the space of these vectors, whatever the disturbances are and remember. It is the
standard normal space of reliability analysis; the score is its limit-state function, but positive where a trial fails.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from lqrsim.control.controllers import ControllerLike
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_count,
    check_flag,
    check_function,
    check_items,
    check_kind,
    excerpt,
    shaped,
)
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant

Size = int | Sequence[int] | None
_LARGEST = np.nextafter(1.0, 0.0)  # of what numpy calls random, which is below 1


class PrescribedDraws:
    """What a disturbance uses of NumPy's generators, with numbers that are made of given standard normal ones.

    Each number that is drawn takes one of them, in turn. Uniform ones are the normal distribution's function of it.

    Attributes:
      used: how many have been taken.
    """

    def __init__(self, numbers: Array) -> None:
        self.numbers, self.used = numbers, 0

    def standard_normal(self, size: Size = None) -> Any:
        count = 1 if size is None else int(np.prod(size))
        numbers = self._take(count)
        return float(numbers[0]) if size is None else numbers.reshape(size).copy()

    def _take(self, count: int) -> Array:
        if self.used + count > len(self.numbers):
            raise InputError(f"numbers: got {len(self.numbers)}, want as many as a trial draws, at least one more")
        self.used += count
        return self.numbers[self.used - count : self.used]

    def random(self, size: Size = None) -> Any:
        return np.minimum(ndtr(self.standard_normal(size)), _LARGEST)[()]

    def normal(self, loc: npt.ArrayLike = 0.0, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        drawn = self.standard_normal(_shape(size, loc, scale))
        return np.asarray(loc) + np.asarray(scale) * drawn

    def uniform(self, low: npt.ArrayLike = 0.0, high: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        drawn = self.random(_shape(size, low, high))
        return np.asarray(low) + (np.asarray(high) - np.asarray(low)) * drawn

    def exponential(self, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        return -np.asarray(scale) * np.log1p(-self.random(_shape(size, scale)))

    def integers(self, low: int, high: int | None = None, size: Size = None, *, endpoint: bool = False) -> Any:
        low, high = (0, low) if high is None else (low, high)
        drawn = np.floor(self.random(size) * (high - low + endpoint)).astype(np.int64) + low
        return int(drawn) if size is None else drawn

    def choice(
        self, a: int | npt.ArrayLike, size: Size = None, replace: bool = True, p: npt.ArrayLike | None = None
    ) -> Any:
        options = np.arange(a) if isinstance(a, (int, np.integer)) else np.asarray(a)
        if not replace:
            order = np.argsort(self.random(len(options)))  # a random order; p would need another way
            if p is not None:
                raise InputError("choice: got p without replacement, want one of the two")
            return options[order[: 1 if size is None else int(np.prod(size))]].reshape(() if size is None else size)[()]
        shares = np.full(len(options), 1 / len(options)) if p is None else np.asarray(p, dtype=np.float64)
        which = np.searchsorted(np.cumsum(shares), self.random(size), side="right")
        return options[np.minimum(which, len(options) - 1)]

    def __getattr__(self, name: str) -> Any:
        raise InputError(f"disturbance: got draws by {name}, want those that can be made of given normal numbers")


def _shape(size: Size, *arguments: npt.ArrayLike) -> Size:
    """The size that NumPy's generators give what they draw."""
    return size if size is not None else (np.broadcast_shapes(*(np.shape(one) for one in arguments)) or None)


class _CountedDraws(PrescribedDraws):
    """Has as many numbers as are asked for."""

    def __init__(self) -> None:
        super().__init__(np.zeros(0))

    def _take(self, count: int) -> Array:
        self.used += count
        return np.zeros(count)


LEAST_DEPTH = 1e-9  # m; the score of a collision that no knot sees


def collision(rollout: Rollout) -> Array:
    """How far into an obstacle each trial that collides gets, (K,), in metres; less the least clearance of the others.

    It is positive for all that collide or are lost, and only for them. How far is meant of runs without contacts, in
    which the robot goes on through what it has run into. What is lost, or what its controller fails, counts as
    infinitely far.

    Args:
      rollout: K trials.

    Returns:
      (K,), in metres; positive where the trial fails.
    """
    check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
    depth = -np.where(np.isnan(rollout.clearance), np.inf, rollout.clearance).min(axis=1)
    outcome = np.array(rollout.outcome)
    score = np.where(outcome == "collided", np.maximum(depth, LEAST_DEPTH), -rollout.least_clearance())
    return np.where(np.isin(outcome, ("diverged", "error")), np.inf, score)


def miss(rollout: Rollout) -> Array:
    """Positive for each trial that does not reach its goal, (K,): it collides, or ends too far away.

    In metres; where the goal has no position, of the scaled error by which it is judged.

    Args:
      rollout: K trials.

    Returns:
      (K,); positive where the trial fails.
    """
    check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
    outside = np.nan_to_num(rollout.goal_distance - rollout.goal_radius, nan=-np.inf)
    return np.maximum(collision(rollout), outside)


@dataclass
class TrialScore:
    """Scores of trials as a function of what they draw: call it with numbers (K, size) for scores (K,).

    A trial fails if its score is positive. Numbers that are standard normal give the trials that `simulate` gives.

    Args:
      plant: what is run.
      solution: with the plan, and the policy unless there is a controller.
      disturbances: as in `simulate`.
      controller: as in `simulate`.
      failure: scores a rollout's trials, (K,).
      goal_radius: as in `simulate`.
      goal_tolerance: as in `simulate`.
      contacts: as in `simulate`.
      batch: how many trials are run at once.
      threads: as in `simulate`.

    Attributes:
      sizes: how many numbers each disturbance draws.
      simulations: how many trials have been run.
    """

    plant: Plant
    solution: Solution
    disturbances: Sequence[Disturbance]
    controller: ControllerLike | None = None
    failure: Callable[[Rollout], Array] = collision
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    contacts: bool = False
    batch: int = 256
    threads: int | None = None
    simulations: int = 0

    def __post_init__(self) -> None:
        wanted = "disturbances, such as ControlNoise(0.05)"
        self.disturbances = check_items("disturbances", self.disturbances, Disturbance, wanted)
        check_function("failure", self.failure, "a function of a Rollout", arguments=1, optional=False)
        self.contacts = check_flag("contacts", self.contacts)
        check_count("batch", self.batch)
        check_count("simulations", self.simulations, at_least=0)
        draws = [_CountedDraws() for _ in self.disturbances]
        self._simulate(1, lambda trial, stream: draws[stream], frames=False)
        self.sizes = tuple(one.used for one in draws)

    @property
    def size(self) -> int:
        """How many numbers a trial draws."""
        return sum(self.sizes)

    def __call__(self, numbers: npt.ArrayLike) -> Array:
        """The scores of trials that draw the given numbers.

        Args:
          numbers: (K, size).

        Returns:
          (K,); positive is failure.

        Raises:
          InputError: not numbers of that shape, or the scores are not numbers.
        """
        vectors = check_array("numbers", numbers, (None, self.size))
        parts: Iterable[Array] = (vectors[first : first + self.batch] for first in range(0, len(vectors), self.batch))
        scores = [self._score(self.rollout(part, frames=False)) for part in parts]
        self.simulations += len(vectors)
        return np.concatenate(scores) if scores else np.zeros(0)

    def _score(self, rollout: Rollout) -> Array:
        """One number a trial, which is not NaN. Raises InputError for anything else."""
        scores = shaped("failure: returned", self.failure(rollout), (rollout.trials,))
        if np.isnan(scores).any():
            raise InputError(f"failure: got {excerpt(scores.tolist())} returned, want numbers: positive is failure")
        return scores

    def rollout(self, numbers: npt.ArrayLike, *, frames: bool = True) -> Rollout:
        """The trials with these numbers, (K, size), in full; their `seed` means nothing.

        Args:
          numbers: (K, size).
          frames: whether to record for drawing.

        Returns:
          A Rollout of K trials.
        """
        vectors = check_array("numbers", numbers, (None, self.size))
        ends = np.cumsum((0, *self.sizes))

        def draws_of(trial: int, stream: int) -> PrescribedDraws:
            return PrescribedDraws(vectors[trial, ends[stream] : ends[stream + 1]])

        return self._simulate(len(vectors), draws_of, frames=frames)

    def _simulate(self, trials: int, generators: Callable[[int, int], PrescribedDraws], *, frames: bool) -> Rollout:
        return simulate(
            self.plant,
            self.solution,
            disturbances=self.disturbances,
            controller=self.controller,
            trials=trials,
            goal_radius=self.goal_radius,
            goal_tolerance=self.goal_tolerance,
            frames=frames,
            contacts=self.contacts,
            threads=self.threads,
            generators=cast(Callable[[int, int], np.random.Generator], generators),
        )


def normal_tail(distance: float) -> float:
    """Probability that a standard normal number is larger."""
    return float(ndtr(-distance))

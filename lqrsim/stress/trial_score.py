"""Trials as a function of their random numbers: a vector of standard normal numbers determines a trial.

Rare failures can then be searched for in the space of these vectors, for any disturbances. It is the standard normal
space of reliability analysis. The score is its limit-state function with the opposite sign: positive is failure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, cast

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from lqrsim.annotations import Count, Index, Want, checked
from lqrsim.control.controllers import ControllerLike
from lqrsim.errors import Array, InputError, check_array, excerpt, shaped
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant

Size = int | Sequence[int] | None
LEAST_DEPTH = 1e-9  # m; the score of a collision between two knots
ZEROS = np.broadcast_to(0.0, 10**12)  # more than any trial draws, in the memory of one number
PROBES = 32  # trials that show how much the disturbances change the clearance while the robot leaves an obstacle
STEADY = 20.0  # a clearance of more of its standard deviations does not show which trials are near a collision


class PrescribedDraws:
    """The methods of NumPy's generators that disturbances use, with numbers made from given standard normal numbers.

    Each draw uses the next given number. Uniform draws are its normal distribution function.
    """

    def __init__(self, numbers: Array) -> None:
        self.numbers, self.used = numbers, 0

    def standard_normal(self, size: Size = None, dtype: npt.DTypeLike = np.float64) -> Any:
        count = 1 if size is None else int(np.prod(size))
        numbers = self._draw(count)
        return float(np.dtype(dtype).type(numbers[0])) if size is None else numbers.reshape(size).astype(dtype)

    def _draw(self, count: int) -> Array:
        if self.used + count > len(self.numbers):
            raise InputError(f"numbers: got {len(self.numbers)}, want more: a trial draws at least one more")
        self.used += count
        return self.numbers[self.used - count : self.used]

    def random(self, size: Size = None, dtype: npt.DTypeLike = np.float64) -> Any:
        kind = np.dtype(dtype).type
        return np.minimum(ndtr(self.standard_normal(size)).astype(kind), np.nextafter(kind(1), kind(0)))[()]

    def normal(self, loc: npt.ArrayLike = 0.0, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        return np.asarray(loc) + np.asarray(scale) * self.standard_normal(_shape(size, loc, scale))

    def uniform(self, low: npt.ArrayLike = 0.0, high: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        drawn = self.random(_shape(size, low, high))
        return np.asarray(low) + (np.asarray(high) - np.asarray(low)) * drawn

    def exponential(self, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        return -np.asarray(scale) * np.log1p(-self.random(_shape(size, scale)))

    def integers(
        self, low: npt.ArrayLike, high: npt.ArrayLike | None = None, size: Size = None,
        dtype: npt.DTypeLike = np.int64, endpoint: bool = False,
    ) -> Any:  # fmt: skip
        least, most = (0, low) if high is None else (low, high)
        least, most = np.asarray(least, dtype=np.int64), np.asarray(most, dtype=np.int64)
        drawn = np.floor(self.random(_shape(size, least, most)) * (most - least + endpoint)).astype(np.int64) + least
        return int(drawn) if not drawn.ndim and np.dtype(dtype) == np.int64 else drawn.astype(dtype)[()]

    def choice(
        self, a: int | npt.ArrayLike, size: Size = None, replace: bool = True, p: npt.ArrayLike | None = None,
        axis: int = 0, shuffle: bool = True,
    ) -> Any:  # fmt: skip
        options = np.arange(a) if isinstance(a, (int, np.integer)) else np.asarray(a)
        count = options.shape[axis]
        if not replace:
            if p is not None:
                raise InputError("choice: got p and replace=False, want one of the two")
            order = np.argsort(self.random(count))
            which = order[: 1 if size is None else int(np.prod(size))].reshape(() if size is None else size)
            return np.take(options, which, axis)[()]
        probabilities = np.full(count, 1 / count) if p is None else np.asarray(p, dtype=np.float64)
        which = np.searchsorted(np.cumsum(probabilities), self.random(size), side="right")
        return np.take(options, np.minimum(which, count - 1), axis)[()]

    def __getattr__(self, name: str) -> Any:
        known = "standard_normal, normal, random, uniform, exponential, integers or choice"
        raise InputError(f"disturbance: got draws by {name}, want {known}, which are made from standard normal numbers")


def _shape(size: Size, *arguments: npt.ArrayLike) -> Size:
    """The shape of the numbers that NumPy's generators draw with these arguments."""
    return size if size is not None else (np.broadcast_shapes(*(np.shape(argument) for argument in arguments)) or None)


@checked
def collision_score(rollout: Rollout, *, first: Index = 0) -> Array:
    """The depth in metres to which each trial enters obstacles, (K,); minus the least clearance without a collision.

    The score is positive exactly for trials that collide, diverge or have a failing controller; infinite for the latter
    two. The depth needs a rollout without contacts, in which the robot moves through the obstacles.

    Args:
      first: the first knot whose clearance counts in trials without a collision. See `TrialScore`.
    """
    if first > rollout.plan.steps:
        raise InputError(f"first: got {first}, want a whole number from 0 to {rollout.plan.steps}")
    depth = -np.where(np.isnan(rollout.clearance), np.inf, rollout.clearance).min(axis=1)
    outcome = np.array(rollout.outcome)
    clearance = np.where(rollout.counts, rollout.clearance, np.inf)[:, first:].min(axis=1)
    score = np.where(outcome == "collided", np.maximum(depth, LEAST_DEPTH), -clearance)
    return np.where(np.isin(outcome, ("diverged", "error")), np.inf, score)


@checked
def miss_score(rollout: Rollout, *, first: Index = 0) -> Array:
    """The distance by which each trial misses its goal, or a larger `collision_score`, (K,); positive if it fails.

    The unit is metres; for a goal without a position, it is the scaled error by which the trial is judged.
    """
    outside = np.nan_to_num(rollout.goal_distance - rollout.goal_radius, nan=-np.inf)
    return np.maximum(collision_score(rollout, first=first), outside)


@checked
@dataclass(eq=False)
class TrialScore:
    """The score of trials as a function of their random numbers: call it with numbers (K, size) for scores (K,).

    A trial fails if its score is positive. Standard normal numbers give trials with the distribution of `simulate`.

    If the robot starts close beside an obstacle and leaves it, its least clearance is the same in nearly all trials and
    does not tell which of them are near a failure. `collision_score` and `miss_score` then leave out the knots until it
    has left, as far as the clearance there is more than 20 of its standard deviations.

    The other arguments are as in `simulate`.

    Args:
      failure: returns the scores (K,) of a rollout.
      batch: number of trials that are run at once.

    Attributes:
      sizes: number of random numbers that each disturbance draws.
      first: the first knot whose clearance counts in trials without a collision.
    """

    _prefix = ""

    plant: Plant
    solution: Solution
    disturbances: Annotated[Sequence[Disturbance], Want("disturbances, such as ControlNoise(0.05)")]
    controller: ControllerLike | None = None
    failure: Annotated[Callable[[Rollout], Array], Want("a function of a Rollout")] = collision_score
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    contacts: bool = False
    batch: Count = 256
    threads: int | None = None
    simulations: Index = 0

    def __post_init__(self) -> None:
        draws = [PrescribedDraws(ZEROS) for _ in self.disturbances]  # counts how many each draws
        usual = self._simulate(1, lambda trial, stream: draws[stream], frames=False)
        self.sizes = tuple(stream.used for stream in draws)
        self.first, clearance = 0, usual.clearance[0]
        # The number of knots until the clearance first falls by a tenth; it must be least before.
        departure = int((clearance < 0.9 * np.maximum.accumulate(clearance)).argmax())
        if not (departure and clearance[:departure].min() <= clearance[departure:].min()):
            return
        if self.size and self.failure in (collision_score, miss_score):
            numbers = np.random.default_rng(0).standard_normal((PROBES, self.size))
            probed = self.rollout(numbers, frames=False).clearance[:, :departure]
            steady = probed.mean(axis=0) > STEADY * probed.std(axis=0)
            self.first = departure if steady.all() else int(steady.argmin())

    @property
    def size(self) -> int:
        """Number of random numbers of a trial."""
        return sum(self.sizes)

    def __call__(self, numbers: npt.ArrayLike) -> Array:
        """The scores (K,) of trials with the given random numbers (K, size)."""
        vectors = check_array("numbers", numbers, (None, self.size))
        parts = (vectors[first : first + self.batch] for first in range(0, len(vectors), self.batch))
        options = {"first": self.first} if self.first else {}  # only lqrsim's own scores leave knots out
        scores: list[Array] = [np.zeros(0)]
        for part in parts:
            returned = self.failure(self.rollout(part, frames=False), **options)
            scores.append(shaped("failure: returned", returned, (len(part),)))
            if np.isnan(scores[-1]).any():
                raise InputError(f"failure: returned {excerpt(scores[-1].tolist())}, want numbers: positive is failure")
        self.simulations += len(vectors)
        return np.concatenate(scores)

    def rollout(self, numbers: npt.ArrayLike, *, frames: bool = True) -> Rollout:
        """The trials with the given random numbers (K, size); their `seed` means nothing."""
        vectors = check_array("numbers", numbers, (None, self.size))
        parts = np.split(vectors, np.cumsum(self.sizes)[:-1], axis=1)  # of each disturbance
        return self._simulate(len(vectors), lambda trial, stream: PrescribedDraws(parts[stream][trial]), frames=frames)

    def _simulate(self, trials: int, generators: Callable[[int, int], PrescribedDraws], *, frames: bool) -> Rollout:
        named = ("disturbances", "controller", "goal_radius", "goal_tolerance", "contacts", "threads")
        options = {name: getattr(self, name) for name in named} | {"trials": trials, "frames": frames}
        drawn = cast(Callable[[int, int], np.random.Generator], generators)
        return simulate(self.plant, self.solution, generators=drawn, **options)

"""What trials certify of a policy: from which states it succeeds, and how often it fails. NumPy only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, SHARE, Bounds, Chance, Index, Line, NonNegative, OneOf, Positive, Share, checked
from lqrsim.errors import Array, InputError, check_name, check_symmetric, excerpt, shaped, vectors_of
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory

FAMILIES = ("cost_to_go", "tube", "given")
FLAT = 1e-13  # smallest eigenvalue of a shape scaled to a unit diagonal, below which the ellipsoid is flat


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Funnel:
    """Ellipsoids about a plan, at some knots, from which runs succeed at a stated rate.

    The ellipsoid at a knot is `{plan + e: e' shape^-1 e <= level^2}`. The rate is the fraction of runs that succeed,
    over states drawn uniformly from the volume of the ellipsoid and over the disturbances. With the stated confidence
    it is at least `rate` at all knots at once. This says nothing about a single state, nor about other knots, where the
    level is interpolated; see `level`.

    T steps, n states, k knots; d of the states may be off the plan, all others are on it.

    Attributes:
      states: names of the d states that may be off the plan.
      shape: (T+1, d, d), the ellipsoids of level 1, in the units of these states.
      family: origin of the shape: "cost_to_go", the inverse of its Hessian, so that level^2/2 is the cost of the
        deviation; "tube", the predicted covariance, so that levels are standard deviations; or "given".
      levels: (k,), the level at each knot; 0 if none was certified.
      trials: (k,) fresh trials that certify the level; 0 if the level is 0.
      successes: (k,), successes of these trials. They must show the rate with the confidence.
      reasons: (k) why a level is 0, or why no larger level was tried; otherwise empty.
    """

    _want = "a Funnel, such as funnel(...) returns"

    plan: Trajectory
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]
    states: Annotated[tuple[Line, ...], "d"]
    shape: Annotated[Array, "T+1 d d", Bounds()]
    family: Annotated[str, OneOf(FAMILIES)]
    knots: Annotated[npt.NDArray[np.int64], "k"]
    levels: Annotated[Array, "k", Bounds(at_least=0.0)]
    trials: Annotated[npt.NDArray[np.int64], "k"]
    successes: Annotated[npt.NDArray[np.int64], "k"]
    reasons: Annotated[tuple[Line, ...], "k"]
    rate: Chance
    confidence: Chance
    simulated: int
    policy_digest: Line
    goal_radius: Positive
    disturbances: tuple[Line, ...]
    seed: int
    options: Mapping[str, object] = field(default_factory=dict)
    versions: Mapping[str, Line] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.plan.finite:
            raise InputError("Funnel: plan: got NaN or infinity, want finite states and controls")
        if not self.states or len(set(self.states)) < len(self.states):
            raise InputError(f"Funnel: states: got {excerpt(self.states)}, want different names, at least one")
        for name in self.states:
            check_name("Funnel: states", name, self.state_coordinates.names)
        check_symmetric("Funnel: shape", self.shape)
        last = self.plan.steps - 1
        if not len(self.knots) or (np.diff(self.knots) <= 0).any() or self.knots[-1] > last:
            raise InputError(f"Funnel: knots: got {excerpt(self.knots.tolist())}, want some of 0 to {last}, in order")
        for name, wrong, want in (
            ("successes", self.successes > self.trials, "no more than the trials"),
            ("trials", (self.trials == 0) != (self.levels == 0), "some where there is a level, and none elsewhere"),
        ):
            if wrong.any():
                raise InputError(f"Funnel: {name}: got {excerpt(getattr(self, name))}, want {want}")
        doubt = (1 - self.confidence) / len(self.knots)  # Bonferroni: at one knot, for all to hold at once
        for trials, successes in zip(self.trials.tolist(), self.successes.tolist(), strict=True):
            if trials and _chance_of_so_few(trials - successes, trials, self.rate) > doubt * (1 + 1e-6):
                shown = f"a rate of {self.rate:g} with confidence {self.confidence:g} at {len(self.knots)} knots"
                got = f"{successes} of {trials} trials, which do not show {shown}"
                raise InputError(f"Funnel: successes: got {got}, want more")

    @cached_property
    def chosen(self) -> list[int]:
        """The indices of `states`, (d,)."""
        return [self.state_coordinates.names.index(name) for name in self.states]

    @property
    def times(self) -> Array:
        """Times of the knots in seconds, (k,)."""
        return self.plan.dt * self.knots

    def level(self, t: float) -> float:
        """The level `t` seconds after the start of the plan, linear between two knots.

        It is certified at `knots` only. It is constant before the first and after the last knot.
        """
        return float(np.interp(self._knot(t), self.knots, self.levels))

    def deviation(self, x: npt.ArrayLike, t: float, *, about: npt.ArrayLike | None = None) -> Array:
        """The levels (...) of the ellipsoids through states (..., n), at the nearest knot of the plan.

        Angles may be in any representative. Only `states` count. The level is infinite where the ellipsoid is flat or
        the state is not finite.

        Args:
          about: (n,), the centre of the ellipsoid, in place of the plan's state.
        """
        knot, size = self._knot(t), len(self.state_coordinates)
        states = vectors_of("x", x, size)
        middle = self.plan.states[knot] if about is None else shaped("about", about, (size,))
        off = self.state_coordinates.difference(states, middle)[..., self.chosen]
        curve = self._inverse[knot]
        with np.errstate(over="ignore", invalid="ignore"):
            level = np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", off, curve, off), 0.0))
        return np.where(np.isfinite(level), level, np.inf)

    def contains(self, x: npt.ArrayLike, t: float, *, about: npt.ArrayLike | None = None) -> npt.NDArray[np.bool_]:
        """Whether states (..., n) are in the funnel `t` seconds after the plan's start, (...); at level 0 none is."""
        level = self.level(t)
        return (self.deviation(x, t, about=about) <= level) & (level > 0)

    @checked
    def left_at(self, rollout: Rollout) -> Array:
        """The time at which each run first left the funnel, (K,), in seconds; infinite if it never did."""
        if not np.array_equal(rollout.plan.states, self.plan.states):
            raise InputError("rollout: got a run of another plan, want a run of the funnel's plan")
        inside = np.array([self.contains(rollout.states[:, i], t) for i, t in enumerate(self.plan.times)])
        return np.where(inside.all(axis=0), np.inf, self.plan.dt * np.argmin(inside, axis=0))

    @checked
    def states_at(self, knot: Index, points: npt.ArrayLike, level: NonNegative) -> Array:
        """The states (..., n) of points (..., d) of the unit ball, in the ellipsoid of a level at a knot."""
        if knot > self.plan.steps:
            raise InputError(f"knot: got {knot}, want a whole number from 0 to {self.plan.steps}")
        points = vectors_of("points", points, len(self.states))
        states = np.tile(self.plan.states[knot], (*points.shape[:-1], 1))
        states[..., self.chosen] += level * points @ self._root(knot).T
        return states

    @property
    def position_covariance(self) -> Array:
        """Matrices (T+1, p, p) in m^2 whose one-sigma ellipsoids are the funnel's projection onto the position."""
        place = self.state_coordinates.position
        names = [self.state_coordinates.names[i] for i in place]
        if not place or not set(names) <= set(self.states):
            raise InputError(f"Funnel: states: got {', '.join(self.states)}, want the position among them to draw it")
        rows = [self.states.index(name) for name in names]
        levels = np.array([self.level(t) for t in self.plan.times])
        return self.shape[:, rows][:, :, rows] * levels[:, None, None] ** 2

    @property
    def digest(self) -> str:
        """Hash of the plan, the ellipsoids and their levels, and which states wrap."""
        texts = f"{self.states} {self.plan.dt!r} {self.state_coordinates.rules}"
        return sha256(texts, self.plan.states, self.shape, self.knots, self.levels)[:16]

    def summary(self) -> str:
        """A line for each knot: its level, the extent along the states, and the trials that certify the level."""
        meant = {"cost_to_go": "level^2/2 is cost", "tube": "levels are standard deviations"}.get(self.family, "")
        of = "all states" if len(self.states) == len(self.state_coordinates) else ", ".join(self.states)
        shape = f"funnel of {of}, {self.family}{f' ({meant})' if meant else ''}"
        sure = f"with confidence {self.confidence:g} at all knots at once; {self.simulated:,} trials"
        lines = [f"{shape}: at least {self.rate:g} of the runs that start in it succeed, {sure}"]
        for i, knot in enumerate(self.knots):
            line = f"  {self.times[i]:6.2f} s  level {self.levels[i]:.4g}"
            if self.levels[i] > 0:
                line += f"  {self.successes[i]} of {self.trials[i]} fresh trials  up to {self._extent(int(knot))}"
            lines.append(f"{line}  {self.reasons[i]}".rstrip())
        return "\n".join(lines)

    __str__ = summary

    def _extent(self, knot: int) -> str:
        """The largest half width among the states of each unit."""
        half = self.level(knot * self.plan.dt) * np.sqrt(np.diagonal(self.shape[knot]))
        units = [self.state_coordinates.units[i] for i in self.chosen]
        widest = {unit: max(h for h, u in zip(half, units, strict=True) if u == unit) for unit in units}
        return ", ".join(f"{size:.3g} {unit}".rstrip() for unit, size in widest.items())

    @checked
    def _knot(self, t: NonNegative) -> int:
        return min(round(t / self.plan.dt), self.plan.steps)

    @cached_property
    def _inverse(self) -> Array:
        """The inverse shapes, (T+1, d, d); NaN if the shape is flat."""
        inverse = np.full(self.shape.shape, np.nan)
        for knot in range(len(self.shape)):
            if not flat(self.shape[knot]):
                inverse[knot] = inverse_of(self.shape[knot])
        return inverse

    def _root(self, knot: int) -> Array:
        """The lower triangular L (d, d) with L L' = shape."""
        if flat(self.shape[knot]):
            raise InputError(f"shape: got a flat ellipsoid at knot {knot}, want one with a volume")
        size = np.sqrt(np.diagonal(self.shape[knot]))
        return size[:, None] * np.linalg.cholesky(self.shape[knot] / np.outer(size, size))


def flat(shape: Array) -> bool:
    """Whether an ellipsoid of this shape (d, d) has no volume, in any units of its states."""
    size = np.sqrt(np.maximum(np.diagonal(shape), 0.0))
    if not (np.isfinite(shape).all() and (size > 0).all()):
        return True
    return bool(np.linalg.eigvalsh(shape / np.outer(size, size))[0] < FLAT)


def inverse_of(matrix: Array) -> Array:
    """The inverse of a covariance or a Hessian (d, d) of an ellipsoid that is not flat, scaled against rounding."""
    size = np.sqrt(np.diagonal(matrix))
    return np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)


def _chance_of_so_few(failures: int, trials: int, rate: float) -> float:
    """The chance of at most this number of failures in independent trials that succeed at this rate."""
    i = np.arange(failures)
    ratios = np.log((trials - i) / (i + 1)) + np.log1p(-rate) - np.log(rate)  # ratios of successive terms
    return float(np.exp(trials * np.log(rate) + np.concatenate([[0.0], np.cumsum(ratios)])).sum())


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class FailureCertificate:
    """The probability that a policy fails, as measured by multilevel splitting, and a description of the measurement.

    Attributes:
      model: hash of the simulated MJCF.
      repetitions: the estimate of each repetition, (R,).
      keep: fraction of the trials that exceeds the next level; 0 if failures were counted.
    """

    solution: Solution
    scenario: Annotated[str, 10 * LINE]
    sweep: Line
    strength: Positive
    policy: Line
    design_disturbances: Line | None
    failure: Line
    goal_radius: Positive | None
    goal_tolerance: Positive | None
    disturbances: tuple[Line, ...]
    model: Line
    policy_digest: Line
    probability: Share
    low: Share
    high: Share
    confidence: Chance
    repetitions: Annotated[Array, "R", SHARE]
    particles: int
    seed: int
    versions: Mapping[str, Line]
    keep: Annotated[float, Bounds(at_least=0.0, at_most=0.5)] = 0.1

    _want = "a FailureCertificate, such as rare.certificate()"

    def __post_init__(self) -> None:
        if not self.low <= self.probability <= self.high:
            wanted = f"a number from {self.low:g} to {self.high:g}, its interval"
            raise InputError(f"FailureCertificate: probability: got {self.probability:g}, want {wanted}")
        mean = float(self.repetitions.mean()) if len(self.repetitions) > 1 else -1.0
        if abs(mean - self.probability) > 1e-9 * self.probability:
            got = f"{len(self.repetitions)} whose mean is not {self.probability:g}"
            want = "at least two, of which the probability is the mean"
            raise InputError(f"FailureCertificate: repetitions: got {got}, want {want}")

    def summary(self) -> str:
        """Lines that describe the measurement, and the probability."""
        interval = f"{100 * self.confidence:g} % interval, {len(self.repetitions)} repetitions"
        run = f"{self.policy} on {self.scenario}, {self.sweep} at strength {self.strength:g}; failure: {self.failure}"
        return f"{run}\nprobability of failure: {self.probability:.2g} [{self.low:.2g}, {self.high:.2g}] ({interval})"

    __str__ = summary

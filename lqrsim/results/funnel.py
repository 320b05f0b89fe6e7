"""A funnel: from where about its plan a policy works, how often, and how sure that is. NumPy only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_kind,
    check_name,
    check_number,
    excerpt,
    shaped,
    vectors_of,
)
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.fields import Bounds, Line, check_fields
from lqrsim.results.hashing import sha256
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution_parts import Trajectory

FAMILIES = ("cost_to_go", "tube", "given")
FLAT = 1e-13  # smallest eigenvalue of a shape whose diagonal is 1s, below which the ellipsoid is flat


@dataclass(frozen=True, kw_only=True)
class Funnel:
    """Ellipsoids about a plan, at some knots, from which runs succeed with a stated rate.

    At each of the knots, `{plan + e: e' shape^-1 e <= level^2}`. The share that succeeds is of states drawn uniformly
    in the ellipsoid, by volume, and of the disturbances. With the stated confidence that share is at least `rate` at
    all of the knots at once. It is not the share of each single state, and says nothing of other knots: there the level
    is interpolated, see `level`.

    T steps, n states, k knots; d of the states are off the plan, all others on it.

    Attributes:
      plan: nominal states and controls.
      state_coordinates: what the states are.
      control_coordinates: what the controls are.
      states: names of the d states that may be off the plan.
      shape: (T+1, d, d), of level 1, in these states' units.
      family: where the shape is from: "cost_to_go", the inverse of its Hessian, so that level^2/2 is what being off the
        plan costs; "tube", the predicted covariance, so that levels are standard deviations; or "given".
      knots: (k,), in order.
      levels: (k,), 0 where there is none.
      trials: (k,) of the fresh trials that certify the level; 0 where there is none.
      successes: (k,), of these trials.
      reasons: (k) why a level is 0, or what kept larger ones from being tried; else empty.
      rate: as asked for.
      confidence: as asked for.
      simulated: trials that were run in all.
      policy_digest: of what decided on the controls.
      goal_radius: within which the goal counts as reached, as in `Rollout`.
      disturbances: a description of each.
      seed: of all draws.
      options: the settings of the search.
      versions: of lqrsim and the libraries that the bits depend on, and the processor.

    Raises:
      InputError: parts that do not fit together.
    """

    plan: Trajectory
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]
    states: Annotated[tuple[Line, ...], "d"]
    shape: Annotated[Array, "T+1 d d", Bounds()]
    family: Line
    knots: Annotated[npt.NDArray[np.int64], "k"]
    levels: Annotated[Array, "k", Bounds(at_least=0.0)]
    trials: Annotated[npt.NDArray[np.int64], "k"]
    successes: Annotated[npt.NDArray[np.int64], "k"]
    reasons: Annotated[tuple[Line, ...], "k"]
    rate: Annotated[float, Bounds(above=0.0, below=1.0)]
    confidence: Annotated[float, Bounds(above=0.0, below=1.0)]
    simulated: int
    policy_digest: Line
    goal_radius: Annotated[float, Bounds(above=0.0)]
    disturbances: tuple[Line, ...]
    seed: int
    options: Mapping[str, object] = field(default_factory=dict)
    versions: Mapping[str, Line] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        check_name("Funnel: family", self.family, FAMILIES)
        if not self.plan.finite:
            raise InputError("Funnel: plan: got NaN or infinity, want finite states and controls")
        if not self.states or len(set(self.states)) < len(self.states):
            raise InputError(f"Funnel: states: got {excerpt(self.states)}, want different names, at least one")
        for name in self.states:
            check_name("Funnel: states", name, self.state_coordinates.names)
        skew = np.abs(self.shape - self.shape.transpose(0, 2, 1)).max(initial=0.0)
        if skew > 1e-9 * max(np.abs(self.shape).max(initial=0.0), np.finfo(float).tiny):
            raise InputError("Funnel: shape: got a matrix that is not symmetric, want symmetric matrices")
        last = self.plan.steps - 1
        if not len(self.knots) or (np.diff(self.knots) <= 0).any() or self.knots[-1] > last:
            raise InputError(f"Funnel: knots: got {excerpt(self.knots.tolist())}, want some of 0 to {last}, in order")
        for name, wrong, want in (
            ("successes", self.successes > self.trials, "no more than the trials"),
            ("trials", (self.trials == 0) != (self.levels == 0), "some where there is a level, and none elsewhere"),
        ):
            if wrong.any():
                raise InputError(f"Funnel: {name}: got {excerpt(getattr(self, name))}, want {want}")
        self._check_certified()

    def _check_certified(self) -> None:
        """Raises InputError where the fresh trials do not certify their level, whatever a file says."""
        doubt = (1 - self.confidence) / len(self.knots)  # of each knot, so that all are right with the confidence
        for trials, successes in zip(self.trials.tolist(), self.successes.tolist(), strict=True):
            if trials and _chance_of_so_few(trials - successes, trials, self.rate) > doubt * (1 + 1e-6):
                raise InputError(
                    f"Funnel: successes: got {successes} of {trials} trials, which do not show a rate of {self.rate:g}"
                    f" with confidence {self.confidence:g} at {len(self.knots)} knots, want more"
                )

    @cached_property
    def chosen(self) -> list[int]:
        """The indices of `states`, (d,)."""
        return [self.state_coordinates.names.index(name) for name in self.states]

    @property
    def times(self) -> Array:
        """Times of the knots in seconds, (k,)."""
        return self.plan.dt * self.knots

    def level(self, t: float) -> float:
        """The level in force `t` seconds after the start of the plan: that of the knot, or linear between two knots.

        Only at `knots` is it certified. Before the first and after the last of them, theirs is held.

        Args:
          t: seconds since the start of the plan.

        Returns:
          A level.

        Raises:
          InputError: `t` is negative or not finite.
        """
        return float(np.interp(self._knot(t), self.knots, self.levels))

    def deviation(self, x: npt.ArrayLike, t: float, *, about: npt.ArrayLike | None = None) -> Array:
        """The levels (...) of the ellipsoids on which states (..., n) are, at the nearest knot of the plan.

        Angles may be in any representative. Only `states` count. Infinite where the ellipsoid is flat, or the state not
        finite.

        Args:
          x: (..., n).
          t: seconds since the start of the plan.
          about: (n,), the state to which they are compared, in place of the plan's.

        Returns:
          (...).

        Raises:
          InputError: states of another size; `t` is negative or not finite.
        """
        knot, size = self._knot(t), len(self.state_coordinates)
        given = vectors_of("x", x, size)
        middle = self.plan.states[knot] if about is None else shaped("about", about, (size,))
        off = self.state_coordinates.difference(given, middle)[..., self.chosen]
        curve = self._inverse[knot]
        with np.errstate(over="ignore", invalid="ignore"):
            level = np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", off, curve, off), 0.0))
        return np.where(np.isfinite(level), level, np.inf)

    def contains(self, x: npt.ArrayLike, t: float, *, about: npt.ArrayLike | None = None) -> npt.NDArray[np.bool_]:
        """Whether states (..., n) are in the funnel `t` seconds after the start of the plan, (...).

        None is where the level is 0.

        Args:
          x: (..., n).
          t: seconds since the start of the plan.
          about: (n,), the state to which they are compared, in place of the plan's.

        Returns:
          (...), True or False.

        Raises:
          InputError: as `deviation`.
        """
        level = self.level(t)
        return (self.deviation(x, t, about=about) <= level) & (level > 0)

    def left_at(self, rollout: Rollout) -> Array:
        """When each run first was outside, (K,), in seconds; infinite where it never was.

        Args:
          rollout: a run of the funnel's plan, K trials.

        Returns:
          (K,).

        Raises:
          InputError: it is no run of the funnel's plan.
        """
        check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
        if not np.array_equal(rollout.plan.states, self.plan.states):
            raise InputError("rollout: got one of another plan than the funnel's, want a run of that")
        inside = np.array([self.contains(rollout.states[:, i], t) for i, t in enumerate(self.plan.times)])
        return np.where(inside.all(axis=0), np.inf, self.plan.dt * np.argmin(inside, axis=0))

    def states_at(self, knot: int, points: npt.ArrayLike, level: float) -> Array:
        """The states (..., n) that points (..., d) of the unit ball are in the ellipsoid of a level at a knot.

        Args:
          knot: number of it.
          points: (..., d), of the unit ball for states in the ellipsoid.
          level: of the ellipsoid.

        Returns:
          (..., n).

        Raises:
          InputError: no such knot, no such points, or the ellipsoid is flat there.
        """
        knot = check_count("knot", knot, at_least=0, at_most=self.plan.steps)
        points = vectors_of("points", points, len(self.states))
        states = np.tile(self.plan.states[knot], (*points.shape[:-1], 1))
        states[..., self.chosen] += check_number("level", level, at_least=0.0) * points @ self._root(knot).T
        return states

    @property
    def position_covariance(self) -> Array:
        """(T+1, p, p): of the funnel's shadow on the position, whose outline is at 1 standard deviation, in m^2.

        Raises:
          InputError: the robot has no position, or some of it is not among `states`.
        """
        place = self.state_coordinates.position
        names = [self.state_coordinates.names[i] for i in place]
        if not place or not set(names) <= set(self.states):
            raise InputError(f"Funnel: states: got {', '.join(self.states)}, want the position among them to draw it")
        rows = [self.states.index(name) for name in names]
        levels = np.array([self.level(t) for t in self.plan.times])
        return self.shape[:, rows][:, :, rows] * levels[:, None, None] ** 2

    @property
    def digest(self) -> str:
        """Hash of the plan, the ellipsoids and their levels."""
        texts = f"{self.states} {self.plan.dt!r}"
        return sha256(texts, self.plan.states, self.shape, self.knots, self.levels)[:16]

    def summary(self) -> str:
        """A line for each knot: its level, how far that is along each state, and the trials that certify it."""
        meant = {"cost_to_go": "level^2/2 is cost", "tube": "levels are standard deviations"}.get(self.family, "")
        of = "all states" if len(self.states) == len(self.state_coordinates) else ", ".join(self.states)
        lines = [
            f"funnel of {of}, {self.family}{f' ({meant})' if meant else ''}: at least {self.rate:g} of the runs begun"
            f" in it succeed, with confidence {self.confidence:g} at all knots at once; {self.simulated:,} trials"
        ]
        for i, knot in enumerate(self.knots):
            line = f"  {self.times[i]:6.2f} s  level {self.levels[i]:.4g}"
            if self.levels[i] > 0:
                line += f"  {self.successes[i]} of {self.trials[i]} fresh trials  up to {self._extent(int(knot))}"
            lines.append(f"{line}  {self.reasons[i]}".rstrip())
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def _extent(self, knot: int) -> str:
        """The largest half axis along the states of each unit."""
        half = self.level(knot * self.plan.dt) * np.sqrt(np.diagonal(self.shape[knot]))
        units = [self.state_coordinates.units[i] for i in self.chosen]
        widest = {unit: max(h for h, u in zip(half, units, strict=True) if u == unit) for unit in units}
        return ", ".join(f"{size:.3g} {unit}".rstrip() for unit, size in widest.items())

    def _knot(self, t: float) -> int:
        return min(round(check_number("t", t, at_least=0.0) / self.plan.dt), self.plan.steps)

    @cached_property
    def _inverse(self) -> Array:
        """(T+1, d, d); NaN where the shape has none."""
        inverse = np.full(self.shape.shape, np.nan)
        for knot in range(len(self.shape)):
            if not flat(self.shape[knot]):
                size = np.sqrt(np.diagonal(self.shape[knot]))
                inverse[knot] = np.linalg.inv(self.shape[knot] / np.outer(size, size)) / np.outer(size, size)
        return inverse

    def _root(self, knot: int) -> Array:
        """Lower triangular L (d, d) with L L' = shape."""
        if flat(self.shape[knot]):
            raise InputError(f"shape: got an ellipsoid that is flat at knot {knot}, want one of all of its states")
        size = np.sqrt(np.diagonal(self.shape[knot]))
        return size[:, None] * np.linalg.cholesky(self.shape[knot] / np.outer(size, size))


def flat(shape: Array) -> bool:
    """Whether an ellipsoid of this shape (d, d) has no volume, whatever its states' units are."""
    size = np.sqrt(np.maximum(np.diagonal(shape), 0.0))
    if not (np.isfinite(shape).all() and (size > 0).all()):
        return True
    return bool(np.linalg.eigvalsh(shape / np.outer(size, size))[0] < FLAT)


def _chance_of_so_few(failures: int, trials: int, rate: float) -> float:
    """The chance of at most so many failures in trials that succeed at this rate, which are independent."""
    i = np.arange(failures)
    ratios = (
        np.log((trials - i) / (i + 1)) + np.log1p(-rate) - np.log(rate)
    )  # of each term of the sum to the one before
    return float(np.exp(trials * np.log(rate) + np.concatenate([[0.0], np.cumsum(ratios)])).sum())

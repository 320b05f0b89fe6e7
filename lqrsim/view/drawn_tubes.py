"""Ellipsoids along the plan in pictures: a predicted tube, that of the cost, and a funnel."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError
from lqrsim.results.funnel import Funnel
from lqrsim.results.solution import Solution
from lqrsim.view.ellipsoids import OF_COST, SIGMAS, Ellipsoids
from lqrsim.view.recorded_trial import RecordedTrial

# Opacity, for planar robots and for robots in space: of a whole tube, of a funnel between its knots, and of a certified
# ellipsoid.
OPACITY = {True: 0.43, False: 0.2}
BETWEEN = {True: 0.4, False: 0.18}
CERTIFIED = {True: 0.4, False: 0.16}
MOST_ELLIPSOIDS = 80  # more take too long to draw
LIFT = 0.006  # metres between the floor and the lines on it


@dataclass(frozen=True)
class DrawnTube:
    """Ellipsoids in the world.

    Attributes:
      knots: (k,) of the plan.
      in_world: centres (k, 3), half axes (k, 3) and rotations (k, 3, 3).
      label: in the legend.
      opacity: opacity of each ellipsoid.
    """

    knots: npt.NDArray[np.int64]
    in_world: tuple[Array, Array, Array]
    label: str
    opacity: float


@dataclass(frozen=True)
class DrawnFunnel:
    """A funnel in the world.

    Attributes:
      certified: its ellipsoids at knots that have a level, if there are any.
      between: some ellipsoids of interpolated levels, if there are any.
      said: (T+1) whether the run was in the funnel at each step, in words.
    """

    certified: DrawnTube | None
    between: DrawnTube | None
    said: tuple[str, ...]


def predicted(recorded: RecordedTrial) -> DrawnTube | None:
    """The predicted tube of the run; None if there is none, or it has no width."""
    run = recorded.rollout
    if run.tube is None or run.tube.max() < 1e-12:
        return None
    ellipsoids = Ellipsoids.predicted(run.plan.states[:, list(run.state_coordinates.position)], run.tube)
    return _tube(recorded, ellipsoids, np.arange(len(ellipsoids.centres)), ellipsoids.label)


def of_cost(recorded: RecordedTrial, solution: Solution | None) -> DrawnTube:
    """The ellipsoids in which the solution's total cost is near its least."""
    run = recorded.rollout
    if solution is None:
        raise InputError("solution: got None with the overlay cost_tube, want the Solution that was run")
    if not run.state_coordinates.position:
        raise InputError("overlays: got cost_tube for a robot without a position, want other overlays")
    if not np.array_equal(solution.trajectory.states, run.plan.states):
        raise InputError("solution: got one with another plan than the run's, want the Solution that was run")
    ellipsoids = Ellipsoids.of_cost(solution, run.state_coordinates.position)
    return _tube(recorded, ellipsoids, np.arange(len(ellipsoids.centres)), OF_COST)


def of_funnel(recorded: RecordedTrial, funnel: Funnel | None) -> DrawnFunnel:
    """The projection of a funnel onto the position, from its first knot to its last, where it has a level.

    Raises:
      InputError: there is no funnel, it has another plan, or the position is not among its states.
    """
    run = recorded.rollout
    if funnel is None:
        raise InputError("funnel: got None with the overlay funnel, want the Funnel about the plan of the run")
    if not np.array_equal(funnel.plan.states, run.plan.states):
        raise InputError("funnel: got one with another plan, want a funnel about the plan of the run")
    covariances = funnel.position_covariance / SIGMAS**2  # so that half axes are those of the level
    every = Ellipsoids(run.plan.states[:, list(run.state_coordinates.position)], covariances)
    levels, knots = np.array([funnel.level(t) for t in run.times]), np.arange(len(run.times))
    drawn = (levels > 0) & (knots >= funnel.knots[0]) & (knots <= funnel.knots[-1])
    at_knots = np.isin(knots, funnel.knots)
    held, between = _some_of(np.flatnonzero(drawn & at_knots)), np.flatnonzero(drawn & ~at_knots)
    said = ["no funnel here"] * len(knots)
    for knot in np.flatnonzero(drawn):
        inside = funnel.contains(run.states[recorded.trial, knot], float(run.times[knot]))
        said[knot] = "in the funnel" if inside else "outside the funnel"
    stated = f"funnel: {100 * funnel.rate:g} % succeed, confidence {100 * funnel.confidence:g} %"
    certified = DrawnTube(held, _in_world(recorded, every, held), stated, CERTIFIED[recorded.planar])
    return DrawnFunnel(
        certified=certified if len(held) else None,
        between=_tube(recorded, every, between, "funnel, interpolated", BETWEEN) if len(between) else None,
        said=tuple(said),
    )


def _tube(
    recorded: RecordedTrial,
    every: Ellipsoids,
    among: npt.NDArray[np.int64],
    label: str,
    opaque: Mapping[bool, float] = OPACITY,
) -> DrawnTube:
    """Some of the ellipsoids at these knots, which overlap to about this opacity."""
    one = Ellipsoids(every.centres[among], every.covariances[among])
    chosen = one.spread(MOST_ELLIPSOIDS)
    apart = np.linalg.norm(np.diff(one.centres[chosen], axis=0), axis=1).sum() / max(len(chosen) - 1, 1)
    overlap = 2 * float(one.axes()[0][chosen].mean()) / apart if apart > 0 else 1.0
    # Ellipsoids that hardly overlap must not be too opaque: they would show as stripes on the lines within.
    opacity = 1 - (1 - opaque[recorded.planar]) ** (1 / np.clip(overlap, 1.6, 10.0))
    knots = among[chosen]
    return DrawnTube(knots, _in_world(recorded, every, knots), label, float(opacity))


def _in_world(recorded: RecordedTrial, every: Ellipsoids, knots: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Centres (k, 3), half axes (k, 3) and rotations (k, 3, 3) of the ellipsoids at these knots."""
    space = recorded.rollout.state_coordinates
    size, count = len(space.position), len(knots)
    lengths, turns = (part[knots] for part in every.axes())
    half_axes, rotations = np.full((count, 3), 0.1 * LIFT), np.zeros((count, 3, 3))
    half_axes[:, :size] = np.maximum(lengths, 0.1 * LIFT)  # an ellipsoid without width cannot be drawn
    rotations[:, list(space.world_axes), :size] = turns
    if size == 2:  # the third axis of a flat ellipsoid
        rotations[:, :, 2] = np.cross(rotations[:, :, 0], rotations[:, :, 1])
    return space.in_world(every.centres[knots], height=recorded.floor), half_axes, rotations


def _some_of(knots: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """At most as many knots as can be drawn, evenly spread."""
    return knots[np.linspace(0, len(knots) - 1, min(MOST_ELLIPSOIDS, len(knots))).astype(np.int64)]

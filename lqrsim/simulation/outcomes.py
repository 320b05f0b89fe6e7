"""How trials ended: a table with one row a trial, made of a rollout, small enough to be kept for millions of them."""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.errors import Array
from lqrsim.problem import Problem
from lqrsim.rollout import Rollout
from lqrsim.simulation.plant import Plant
from lqrsim.world import ROW, signed_distance

OUTCOMES = ("reached", "timed out", "collided", "diverged", "error")


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """One entry a trial; the first collision ends a trial, and what is measured is of the time until then.

    Attributes:
      trial: its number. outcome: one of OUTCOMES; "error" is for campaigns, of trials that could not be run.
      obstacle: what it collided with; empty where it did not.
      ended: when it collided or was lost, in seconds; the horizon where neither happened.
      worst, rms: tracking error in metres. final: at the end of the plan; NaN for what ended before.
      clearance: the least, in metres.
      effort: the integral of the squares of the applied controls over time, in their unit squared times s.
      saturated: share of the control periods with a command at a limit.
      cost: of the problem, over stages and end, with the controls that were applied; NaN for what ended before.
    """

    trial: npt.NDArray[np.int64]
    outcome: npt.NDArray[np.str_]
    obstacle: npt.NDArray[np.str_]
    ended: Array
    worst: Array
    rms: Array
    final: Array
    clearance: Array
    effort: Array
    saturated: Array
    cost: Array

    def __len__(self) -> int:
        return len(self.trial)

    def columns(self) -> dict[str, npt.NDArray[np.generic]]:
        """The table by its columns, in their order."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def outcomes(rollout: Rollout, plant: Plant, problem: Problem | None = None) -> Outcomes:
    """The outcomes of a rollout's trials.

    Args:
      plant: that it was run on. problem: whose cost to work out; NaN without one.
    """
    plan, dt, steps = rollout.plan, rollout.plan.dt, rollout.plan.steps
    hit = np.less(rollout.clearance, 0)
    lost = np.any(~np.isfinite(rollout.states), axis=2)
    over = hit | lost
    last = np.where(over.any(axis=1), over.argmax(axis=1), steps)  # the knot with which a trial ends
    alive = np.arange(steps + 1) <= last[:, None]
    rows = np.arange(rollout.trials)
    collided = hit[rows, last]
    ended = collided | lost[rows, last] | rollout.diverged
    measured = alive & ~lost
    outcome = np.where(
        collided,
        "collided",
        np.where(ended, "diverged", np.where(rollout.reached, "reached", "timed out")),
    )
    error = np.where(measured, rollout.tracking_error, 0.0)
    driven = measured[:, :-1] & (np.arange(steps) < last[:, None])
    effort = dt * np.where(driven, np.sum(np.square(rollout.applied), axis=2), 0.0).sum(axis=1)
    cost = np.full(rollout.trials, np.nan)
    if problem is not None and not ended.all():
        cost[~ended] = compiled.costs_of(problem, rollout.states[~ended], rollout.applied[~ended])
    return Outcomes(
        trial=rollout.first_trial + rows,
        outcome=outcome,
        obstacle=_obstacles(rollout, plant, collided, last),
        ended=np.where(ended, last * dt, plan.horizon),
        worst=error.max(axis=1),
        rms=np.sqrt(np.square(error).sum(axis=1) / np.maximum(measured.sum(axis=1), 1)),
        final=np.where(ended, np.nan, rollout.tracking_error[:, -1]),
        clearance=np.where(measured, rollout.clearance, np.inf).min(axis=1),
        effort=effort,
        saturated=np.where(driven, rollout.saturated, False).sum(axis=1) / np.maximum(driven.sum(axis=1), 1),
        cost=cost,
    )


def _obstacles(
    rollout: Rollout, plant: Plant, collided: npt.NDArray[np.bool_], last: npt.NDArray[np.int64]
) -> npt.NDArray[np.str_]:
    """Names of what was hit, for the trials that hit something."""
    names = ["" for _ in collided]
    place, table = list(rollout.state_coordinates.position), plant.world.table.ravel()
    for trial in np.flatnonzero(collided):
        point = np.zeros(3)
        point[: len(place)] = rollout.states[trial, last[trial], place]
        there = (point - plant.across(rollout.displaced[trial])).tolist()  # seen from where each obstacle is
        distances = [signed_distance(table, ROW * number, *seen) for number, seen in enumerate(there)]
        names[trial] = plant.world.names[int(np.argmin(distances))]
    return np.array(names, dtype=np.str_)

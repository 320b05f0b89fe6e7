"""The outcomes of trials: a table with one row per trial, small enough for millions of trials."""

from dataclasses import dataclass, fields, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Count, checked
from lqrsim.errors import Array, InputError, check_shape, excerpt, keep
from lqrsim.problem.belief import Belief
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import check_same_system, spaces_of
from lqrsim.results.goal import OUTCOMES
from lqrsim.results.rollout import Rollout
from lqrsim.solvers import compiled

Column = Annotated[Array, "K"]


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """The outcomes of K trials, an array (K,) for each measure. Measures cover the time until the trial ended.

    Attributes:
      obstacle: the obstacle that the trial collided with; empty if it ended otherwise.
      ended: time in seconds of its collision, divergence or error; the horizon without one.
      worst: largest tracking error, in `Rollout.tracking_unit`: metres for robots with a position.
      rms: root mean square of the tracking error, in the same unit.
      final: tracking error at the end of the plan; NaN if the trial ended before.
      goal: distance from the goal at the end, in `Target.unit`; NaN if the trial ended before.
      clearance: the least clearance in metres; at most 0 after a collision.
      effort: integral of the squared applied controls over time, in their unit squared times s.
      saturated: fraction of the control periods with a command at a limit.
      cost: cost of the problem, for the true states and the applied controls; NaN if the trial ended before. Of a
        problem in belief space, that of true states as if they were known: without the cost of what is not known.
      deterministic: whether the trials drew nothing, so that all are the same run.
    """

    trial: Annotated[npt.NDArray[np.int64], "K"]
    outcome: npt.NDArray[np.str_]
    obstacle: npt.NDArray[np.str_]
    ended: Column
    worst: Column
    rms: Column
    final: Column
    goal: Column
    clearance: Column
    effort: Column
    saturated: Column
    cost: Column
    deterministic: bool = False

    _want = "Outcomes, such as results.outcomes(cell)"

    def __post_init__(self) -> None:
        for field in ("outcome", "obstacle"):
            value, name = getattr(self, field), f"Outcomes: {field}"
            if not isinstance(value, np.ndarray) or value.dtype.kind != "U":
                raise InputError(f"{name}: got {excerpt(value)}, want an array of texts")
            check_shape(name, value, self.trial.shape)
            keep(self, **{field: value.copy()})
        if not np.isin(self.outcome, OUTCOMES).all():
            raise InputError(f"Outcomes: outcome: got {excerpt(self.outcome)}, want each one of {', '.join(OUTCOMES)}")

    def __len__(self) -> int:
        return len(self.trial)

    @checked
    def first(self, count: Count) -> "Outcomes":
        """The outcomes of the first `count` trials; more than there are means all."""
        return replace(self, **{name: column[:count] for name, column in self.columns().items()})

    def columns(self) -> dict[str, npt.NDArray[np.generic]]:
        """Name -> column, in order."""
        return {name: getattr(self, name) for name in COLUMNS}


COLUMNS = tuple(field.name for field in fields(Outcomes) if field.name != "deterministic")


@checked
def outcomes(
    rollout: Rollout,
    problem: Problem | None = None,
    *,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
) -> Outcomes:
    """Compute the outcomes of a rollout's trials.

    Args:
      problem: the problem that defines the cost; without it the cost is NaN.
      goal_radius: radius in metres, in place of the rollout's; see `simulate`.
      goal_tolerance: a scaled error, in place of the rollout's; see `simulate`.
    """
    if problem is not None and (problem.steps, problem.dt) != (rollout.plan.steps, rollout.plan.dt):
        got = f"{problem.steps} steps of {problem.dt:g} s"
        raise InputError(f"problem: got {got}, want {rollout.plan.steps} of {rollout.plan.dt:g} s, as in the rollout")
    belief = problem.dynamics if problem is not None and isinstance(problem.dynamics, Belief) else None
    if problem is not None:
        spaces = spaces_of(problem.dynamics if belief is None else belief.robot)
        check_same_system("problem", "a problem", spaces, spaces_of(rollout), "the rollout")
    if goal_radius is not None or goal_tolerance is not None:
        rollout = replace(rollout, goal_radius=rollout.target.radius(None, goal_radius, goal_tolerance))
    plan, ended, counts = rollout.plan, rollout.ended, rollout.counts
    outcome = np.array(rollout.outcome, dtype=np.str_)
    completed = np.isin(outcome, ("reached", "timed out"))
    error = np.where(counts, rollout.tracking_error, 0.0)
    spent = np.clip(ended[:, None] - rollout.times[:-1], 0.0, plan.dt)  # seconds of each control period

    driven = (spent > 0) & np.isfinite(rollout.applied).all(axis=2)
    effort = np.where(driven, spent * np.sum(np.square(rollout.applied), axis=2), 0.0).sum(axis=1)
    cost = np.full(rollout.trials, np.nan)
    if problem is not None and completed.any():
        states = rollout.states[completed]
        if belief is not None:
            known = np.zeros((*states.shape[:2], len(belief.state_coordinates) - belief.size))
            states = np.concatenate([states, known], axis=2)
        cost[completed] = compiled.costs_of(problem, states, rollout.applied[completed])
    return Outcomes(
        trial=rollout.first_trial + np.arange(rollout.trials),
        outcome=outcome,
        obstacle=np.where(outcome == "collided", np.array(rollout.obstacles, dtype=np.str_), ""),
        ended=ended,
        worst=error.max(axis=1),
        rms=np.sqrt(np.square(error).sum(axis=1) / np.maximum(counts.sum(axis=1), 1)),
        final=np.where(completed, rollout.tracking_error[:, -1], np.nan),
        goal=np.where(completed, rollout.goal_distance, np.nan),
        clearance=rollout.least_clearance(),
        effort=effort,
        saturated=np.where(driven, rollout.saturated, False).sum(axis=1) / np.maximum(driven.sum(axis=1), 1),
        cost=cost,
    )

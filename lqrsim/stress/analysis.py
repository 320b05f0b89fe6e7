"""The outcomes of trials, and their analysis: success rates, comparisons of policies, failures, and breaking points.

Outcomes are a table with one row per trial, small enough for millions of trials. Most functions of the analysis take
those of several cells, `Mapping[Cell, Outcomes]`. A trial succeeds if its outcome is "reached"; every other outcome is
a failure.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import SHARE, Bounds, Count, OneOf, checked
from lqrsim.errors import Array, InputError, check_shape, excerpt, keep
from lqrsim.problem.belief import Belief
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import check_same_system, spaces_of
from lqrsim.results.goal import OUTCOMES
from lqrsim.results.rollout import Rollout
from lqrsim.solvers import compiled
from lqrsim.stress import statistics
from lqrsim.stress.statistics import Estimate
from lqrsim.stress.study import Cell

Column = Annotated[Array, "K"]
MEASURES = {  # measure -> unit; tracking errors and the distance from the goal are in metres for robots with a position
    "worst": "m", "rms": "m", "final": "m", "goal": "m", "clearance": "m", "effort": "unit² s",
    "saturated": "", "cost": "",
}  # fmt: skip
LEVELS = np.array([0.05, 0.5, 0.95])
RANKING = (
    "The worst trials are those with errors, then those that collided or diverged, the earliest first, then those with"
    " the least clearance, then those with the largest tracking error."
)


@dataclass(frozen=True)
class Success:
    """The success rate of a cell."""

    reached: int
    trials: int
    exact: Estimate  # the rate with Clopper and Pearson's interval, for claims
    band: Estimate  # the rate with Wilson's interval, for plots
    alike: bool  # whether all trials are the same run, because nothing was drawn; the rate is then exact


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """The outcomes of K trials, an array (K,) for each measure. Measures cover the time until the trial ended.

    Attributes:
      obstacle: the obstacle that the trial collided with; empty if it ended otherwise.
      ended: time in seconds at which the trial collided, diverged or raised an error; else the horizon.
      worst: largest tracking error, in `Rollout.tracking_unit`: metres for robots with a position.
      rms: root mean square of the tracking error, in the same unit.
      final: tracking error at the end of the plan; NaN if the trial ended before.
      goal: distance from the goal at the end, in `Target.unit`; NaN if the trial ended before.
      clearance: the least clearance in metres; at most 0 after a collision.
      effort: integral of the squared applied controls over time, in their unit squared times s.
      saturated: fraction of the control periods with a command at a limit.
      cost: cost of the problem, for the true states and the applied controls; NaN if the trial ended before. In belief
        space it is the cost of a state that is known.
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

    @cached_property
    def success(self) -> Success:
        """The success rate with its intervals."""
        reached, trials = int(succeeded(self).sum()), len(self)
        exact, band = statistics.rate(reached, trials), statistics.rate(reached, trials, method="wilson")
        # Equal outcomes alone do not show that all trials are the same run: random trials may end alike. Nor are trials
        # that were not simulated, or that differ although nothing was drawn.
        alike = self.deterministic and not np.isnan(self.ended).any() and len(set(self.outcome.tolist())) == 1
        for values in (self.ended, self.rms, self.worst, self.effort):
            alike = alike and np.array_equal(values, np.full_like(values, values[0]), equal_nan=True)
        if alike:
            exact = band = Estimate(exact.value, exact.value, exact.value)
        return Success(reached, trials, exact, band, alike)

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


OutcomesByCell = Mapping[Cell, Outcomes]


@checked
def succeeded(outcomes: Outcomes) -> npt.NDArray[np.bool_]:
    """Whether each trial reached its goal, (K,)."""
    return outcomes.outcome == "reached"


def _checked_table(table: OutcomesByCell) -> OutcomesByCell:
    known = isinstance(table, Mapping) and all(isinstance(cell, Cell) for cell in table)
    if not known or not all(isinstance(outcomes, Outcomes) for outcomes in table.values()):
        raise InputError(f"table: got {excerpt(table)}, want a mapping from Cell to Outcomes")
    return table


@checked
def breaks(
    table: OutcomesByCell, *, below: Annotated[float, Bounds(above=0.0, at_most=1.0)] = 0.95
) -> list[tuple[str, str, Cell | None]]:
    """Where each policy breaks in each sweep, the weakest first.

    It is the cell of the smallest tried strength at which the interval of the success rate lies below the limit, if
    there is one.
    """
    points = dict[tuple[str, str], Cell | None].fromkeys((cell.policy, cell.sweep) for cell in _checked_table(table))
    for cell in sorted(table, key=lambda cell: -cell.strength):
        if table[cell].success.exact.high < below:
            points[cell.policy, cell.sweep] = cell
    order = sorted(points, key=lambda name: np.inf if (there := points[name]) is None else there.strength)
    return [(*name, points[name]) for name in order]


@dataclass(frozen=True)
class Comparison:
    """A comparison of two cells on the same trials; or on different ones, with None for what needs pairs."""

    first: Cell
    second: Cell
    rates: tuple[Success, Success]
    success: Estimate  # success rate of the first minus that of the second; failure rates the other way round
    rms: Estimate | None  # difference of the mean tracking errors, over `both`; None if there are fewer than two
    both: int  # trials in which both succeeded
    only_first: int | None  # trials in which only the first succeeded
    only_second: int | None
    p_value: float  # that success rates are equal: McNemar's exact test, or Fisher's; NaN if nothing was drawn
    adjusted: float  # p-value, adjusted for the number of comparisons


def comparisons(table: OutcomesByCell) -> list[Comparison]:
    """Compare the first policy of the table with each other policy, for every sweep and strength that both have.

    Differences are paired by trial. Differences of success have Tango's score interval, differences of errors
    Student's. If nothing was drawn, all trials of a policy are the same run, and there is nothing to test.
    """
    policies, pairs = list(dict.fromkeys(cell.policy for cell in _checked_table(table))), list[tuple[Cell, Cell]]()
    for other in policies[1:]:
        for first in (cell for cell in table if cell.policy == policies[0]):
            second = replace(first, policy=other)
            if second in table and not (table[first].success.alike and table[second].success.alike):
                pairs.append((first, second))
    return compare_cells(pairs, table, table)


def compare_cells(
    pairs: Iterable[tuple[Cell, Cell]], firsts: OutcomesByCell, seconds: OutcomesByCell, *, paired: bool = True
) -> list[Comparison]:
    """Compare pairs of cells, with p-values adjusted for their number (Holm).

    Args:
      paired: whether trials of the same number are compared with each other, see `comparisons`. If not, the difference
        of success has Newcombe's hybrid score interval for independent proportions (Statistics in Medicine 17, 1998).
    """
    compared = list[Comparison]()
    for first, second in pairs:
        outcomes, other_outcomes = firsts[first], seconds[second]
        rates = outcomes.success, other_outcomes.success
        rms, both, only_first, only_second = None, 0, None, None
        if paired:
            if not np.array_equal(outcomes.trial, other_outcomes.trial):
                raise InputError(f"{second}: got other trials than {first} has, want the same trials in the same order")
            split = statistics.compare(succeeded(outcomes), succeeded(other_outcomes))
            only_first, only_second, p_value = split.only_first, split.only_second, split.p_value
            difference = statistics.paired_difference(only_first, only_second, len(outcomes))
            joint = succeeded(outcomes) & succeeded(other_outcomes)
            both = int(joint.sum())
            rms = statistics.mean(outcomes.rms[joint] - other_outcomes.rms[joint]) if both > 1 else None
        else:
            difference, p_value = statistics.independent_difference(*((rate.reached, rate.trials) for rate in rates))
        if all(rate.alike for rate in rates):  # the difference of two runs
            difference, p_value = replace(difference, low=difference.value, high=difference.value), float("nan")
        found = Comparison(first, second, rates, difference, rms, both, only_first, only_second, p_value, p_value)
        compared.append(found)
    tested = [number for number, comparison in enumerate(compared) if not np.isnan(comparison.p_value)]
    p_values = statistics.holm([compared[number].p_value for number in tested]).tolist()
    for number, adjusted in zip(tested, p_values, strict=True):
        compared[number] = replace(compared[number], adjusted=adjusted)
    return compared


def modes(outcomes: Outcomes) -> dict[tuple[str, str], int]:
    """Count the kinds of failures: (outcome, obstacle or "") -> number of trials, the most frequent first."""
    failed = ~succeeded(outcomes)
    kinds = zip(outcomes.outcome[failed].tolist(), outcomes.obstacle[failed].tolist(), strict=True)
    return dict(sorted(Counter(kinds).items(), key=lambda kind: (-kind[1], kind[0])))


@checked
def quantiles(
    outcomes: Outcomes, measure: Annotated[str, OneOf(MEASURES)], levels: Annotated[Array, "L", SHARE] = LEVELS
) -> Array:
    """Quantiles of a measure over the trials for which it is defined; NaN if there are none.

    Infinite values count: without obstacles, clearance is infinite.
    """
    values = getattr(outcomes, measure)
    values = values[~np.isnan(values)]
    # Not interpolated: interpolation between two infinite values gives NaN.
    return np.quantile(values, levels, method="inverted_cdf") if len(values) else np.full(len(levels), np.nan)


@dataclass(frozen=True)
class Trial:
    """A trial of a cell, with some of its outcomes."""

    cell: Cell
    trial: int
    outcome: str
    obstacle: str
    ended: float
    clearance: float
    worst: float


@checked
def worst(table: OutcomesByCell, count: Count = 10) -> list[Trial]:
    """The worst trials of all cells, ranked as RANKING says."""
    ranked: list[tuple[tuple[float, ...], Trial]] = []
    for cell, outcomes in _checked_table(table).items():
        over = np.isin(outcomes.outcome, ("collided", "diverged"))
        keys = (
            np.where(outcomes.outcome == "error", 0.0, np.where(over, 1.0, 2.0)),
            np.where(over, outcomes.ended, 0.0),
            np.nan_to_num(outcomes.clearance, nan=-np.inf, posinf=np.inf, neginf=-np.inf),
            -np.nan_to_num(outcomes.worst, nan=np.inf, posinf=np.inf, neginf=-np.inf),
        )
        for row in np.lexsort((outcomes.trial, *reversed(keys)))[:count]:
            texts = str(outcomes.outcome[row]), str(outcomes.obstacle[row])
            numbers = (float(values[row]) for values in (outcomes.ended, outcomes.clearance, outcomes.worst))
            trial = Trial(cell, int(outcomes.trial[row]), *texts, *numbers)
            ranked.append((tuple(float(key[row]) for key in keys), trial))
    return [trial for _, trial in sorted(ranked, key=lambda pair: pair[0])[:count]]

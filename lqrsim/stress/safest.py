"""The way that runs succeed by most often, among those that the search for the cheapest plan has looked at."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.errors import InputError, check_count, check_items, check_kind, check_seed
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.smoother import smooth
from lqrsim.stress.levels import MOST_TRIALS
from lqrsim.stress.statistics import Estimate
from lqrsim.stress.statistics import rate as rate_of

SAME = 0.02  # of a state's range along the plan: plans that are nowhere farther apart are one


class Way(NamedTuple):
    """A plan that was compared.

    Attributes:
      start: what the search began with.
      solution: what it became.
      successes: which of the common trials reached the goal, (K,).
    """

    start: str
    solution: Solution
    successes: npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SafestPlan:
    """The way that most of the common trials succeeded by.

    Attributes:
      solution: of it.
      ways: all that were compared, the best first.
      reached: the share of fresh trials that reach the goal by it, with its exact interval. Those by which it was
        chosen would say too much.
    """

    solution: Solution
    ways: tuple[Way, ...]
    reached: Estimate

    def __post_init__(self) -> None:
        check_kind("SafestPlan: solution", self.solution, Solution, "a Solution")
        object.__setattr__(self, "ways", check_items("SafestPlan: ways", self.ways, Way, "a tuple of Ways"))
        check_kind("SafestPlan: reached", self.reached, Estimate, "an Estimate")

    def summary(self) -> str:
        """A line for each way: cost and successes."""
        lines = [f"{100 * self.reached.value:.1f} % of fresh trials reach the goal by the first of these ways:"]
        for way in self.ways:
            found = f"{int(way.successes.sum())} of {len(way.successes)} trials"
            lines.append(f"  {way.start}: cost {way.solution.cost:.6g}, {found}")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()


def smooth_safest(
    problem: Problem,
    plant: Plant,
    disturbances: Sequence[Disturbance | Noise],
    *,
    trials: int = 200,
    starts: int | None = None,
    seed: int = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
) -> SafestPlan:
    """Choose among the ways that `smooth` looks at by how often runs succeed, not by cost.

    Each candidate of the search is solved for to its end. Of plans that are the same only the first is kept. All are
    run in the same trials, and the one that most of them succeed by is the answer; of several, the cheapest.

    Args:
      problem: as for `smooth`.
      plant: as in `simulate`.
      disturbances: as in `simulate`.
      trials: of each way, and as many fresh ones of the chosen way.
      starts: as for `smooth`.
      seed: of the disturbances.
      goal_radius: as in `simulate`.
      goal_tolerance: as in `simulate`.
      threads: of the search and of the simulations.

    Returns:
      A SafestPlan.

    Raises:
      InputError: as `smooth` and `simulate`, or no way leads to a plan.
    """
    count, seed = check_count("trials", trials, at_most=MOST_TRIALS), check_seed("seed", seed)
    first = smooth(problem, starts=starts, threads=threads)
    found: list[tuple[str, Solution]] = []
    for candidate in first.candidates:
        plan = candidate.trajectory
        if not (np.isfinite(plan.states).all() and np.isfinite(plan.controls).all()):
            continue
        one = first if candidate.status is not None and candidate.cost == first.cost else smooth(problem, start=plan)
        if one.success and not any(_same(one, other) for _, other in found):
            found.append((candidate.start, replace(one, candidates=first.candidates)))
    if not found and first.success:
        found.append(("the search's own", first))
    if not found:
        raise InputError(f"problem: got one for which no way leads to a plan ({first.status.name}), want one that does")

    def reached(solution: Solution, begin: int) -> npt.NDArray[np.bool_]:
        run = simulate(
            plant, solution, disturbances=disturbances, seed=seed, trials=count, first_trial=begin, threads=threads,
            goal_radius=goal_radius, goal_tolerance=goal_tolerance, frames=False, contacts=False,
        )  # fmt: skip
        return np.array([one == "reached" for one in run.outcome])

    ways = [Way(start, one, reached(one, 0)) for start, one in found]
    ways.sort(key=lambda way: (-int(way.successes.sum()), way.solution.cost))
    best = ways[0].solution
    fresh = int(reached(best, count).sum())
    return SafestPlan(solution=best, ways=tuple(ways), reached=rate_of(fresh, count))


def _same(one: Solution, other: Solution) -> bool:
    """Whether two plans are one, to within what solves leave open."""
    apart = one.policy.state_coordinates.difference(one.trajectory.states, other.trajectory.states)
    scale = np.maximum(np.ptp(other.trajectory.states, axis=0), 1e-9)
    return bool((np.abs(apart) <= SAME * scale).all())

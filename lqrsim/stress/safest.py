"""The safest plan: the candidate of a solve whose runs reach the goal most often."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Line, Seed, Want, checked
from lqrsim.errors import InputError, check_array, keep
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.smoother import smooth
from lqrsim.stress.funnels import MOST_TRIALS
from lqrsim.stress.statistics import Estimate
from lqrsim.stress.statistics import rate as rate_of

SAME_PLAN = 0.02  # fraction of a state's range along the plan; plans that differ by no more count as the same


@checked
@dataclass(frozen=True, eq=False)
class ComparedPlan:
    """A plan that was compared.

    Attributes:
      start: the start of its search.
      successes: whether each of the common trials reached the goal, (K,).
    """

    start: Line
    solution: Solution
    successes: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        keep(self, successes=check_array("ComparedPlan: successes", self.successes, (None,)) != 0)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class SafestPlan:
    """The plan with which most of the common trials reached the goal.

    Attributes:
      compared: all plans that were compared, the best first.
      reached: its success rate in fresh trials, with the exact interval. The trials by which it was selected would be
        biased.
    """

    solution: Solution
    compared: Annotated[tuple[ComparedPlan, ...], Want("a tuple of ComparedPlan")]
    reached: Estimate

    def summary(self) -> str:
        """The success rate, and a line for each plan with its cost and successes."""
        lines = [f"{100 * self.reached.value:.1f} % of fresh trials reach the goal with the first of these plans:"]
        for plan in self.compared:
            count = f"{int(plan.successes.sum())} of {len(plan.successes)} trials"
            lines.append(f"  {plan.start}: cost {plan.solution.cost:.6g}, {count}")
        return "\n".join(lines)

    __str__ = summary


@checked
def smooth_safest(
    problem: Problem,
    plant: Plant,
    disturbances: Sequence[Disturbance | Noise],
    *,
    trials: Annotated[int, Bounds(at_least=1, at_most=MOST_TRIALS)] = 200,
    starts: int | None = None,
    seed: Seed = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
) -> SafestPlan:
    """Choose among the candidates of `smooth` by success rate instead of cost.

    Each candidate is solved to convergence; duplicates are dropped. All plans run in the same trials. The result is the
    plan with the most successes; the cheapest plan if there are several. What is not named here is as for `smooth` and
    `simulate`.

    Args:
      trials: number of trials of each plan, and of fresh trials of the chosen plan.
    """
    first = smooth(problem, starts=starts, threads=threads)
    plans: list[tuple[str, Solution]] = []
    for candidate in first.candidates:
        plan = candidate.trajectory
        if not plan.finite:
            continue
        solution = (
            first if candidate.status is not None and candidate.cost == first.cost else smooth(problem, start=plan)
        )
        if solution.success and not any(_same(solution, other) for _, other in plans):
            plans.append((candidate.start, replace(solution, candidates=first.candidates)))
    if not plans and first.success:
        plans.append(("the search's own", first))
    if not plans:
        raise InputError(f"problem: got no converged plan ({first.status.name}), want a problem that can be solved")

    def reached(solution: Solution, begin: int) -> npt.NDArray[np.bool_]:
        run = simulate(
            plant, solution, disturbances=disturbances, seed=seed, trials=trials, first_trial=begin, threads=threads,
            goal_radius=goal_radius, goal_tolerance=goal_tolerance, frames=False, contacts=False,
        )  # fmt: skip
        return np.array([outcome == "reached" for outcome in run.outcome])

    compared = [ComparedPlan(start, solution, reached(solution, 0)) for start, solution in plans]
    compared.sort(key=lambda plan: (-int(plan.successes.sum()), plan.solution.cost))
    best = compared[0].solution
    successes = int(reached(best, trials).sum())
    return SafestPlan(solution=best, compared=tuple(compared), reached=rate_of(successes, trials))


def _same(first: Solution, second: Solution) -> bool:
    """Whether two plans are the same within SAME_PLAN."""
    deviation = first.policy.state_coordinates.difference(first.trajectory.states, second.trajectory.states)
    scale = np.maximum(np.ptp(second.trajectory.states, axis=0), 1e-9)
    return bool((np.abs(deviation) <= SAME_PLAN * scale).all())

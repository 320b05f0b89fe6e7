"""The runs of `convergence.py`: each query by both solvers until rounding stops them, with obstacles and without."""

from dataclasses import dataclass, replace

import numpy as np
from peers import truth

import lqrsim as ls
from lqrsim.problem.parts import CostSum, terms_of
from paper.common import as_in_the_paper
from paper.curvature import discarded

SMOOTHING, ILQR, FINISHED = "smoothing", "iLQR", "smoothing, then Newton"
WITH, WITHOUT = "with obstacles", "without"
PAPER_STOP, TIGHT = 1e-4, 1e-15  # of the relative change of cost; the latter is less than rounding leaves of it
STOPPED, RUN_ON = "at the paper's stop", "run on"
STOPS = {STOPPED: PAPER_STOP, RUN_ON: TIGHT}
MOST = 2000  # iterations


@dataclass(frozen=True)
class Measured:
    """One query: logs by case and solver, the factor of what is thrown away by solver, consistency by form and stop."""

    logs: dict[str, dict[str, tuple[ls.types.Iteration, ...]]]
    discarded: dict[str, float]
    consistency: dict[str, dict[str, dict[str, float]]]


def measure(scenario: ls.Scenario) -> Measured:
    problem = as_in_the_paper(scenario.problem)
    free = without_obstacles(problem)
    ends = {
        form: {stop: smooth(scenario, problem, form=form, tolerance=tolerance) for stop, tolerance in STOPS.items()}
        for form in ("dual", "primal")
    }
    solved = {
        WITH: {SMOOTHING: ends["dual"][RUN_ON], ILQR: ilqr(problem), FINISHED: finished(scenario, problem)},
        WITHOUT: {SMOOTHING: smooth(scenario, free), ILQR: ilqr(free), FINISHED: finished(scenario, free)},
    }
    return Measured(
        logs={case: {solver: one.iterations for solver, one in both.items()} for case, both in solved.items()},
        discarded={
            solver: discarded(problem, one.trajectory, fixed=solver == ILQR) for solver, one in solved[WITH].items()
        },
        consistency={
            form: {stop: consistency(problem, one) for stop, one in stops.items()} for form, stops in ends.items()
        },
    )


def ilqr(problem: ls.Problem) -> ls.Solution:
    return ls.ilqr(problem, stop="cost", tolerance=TIGHT, max_iterations=MOST)


def smooth(
    scenario: ls.Scenario, problem: ls.Problem, *, tolerance: float = TIGHT, form: str = "dual", most: int = MOST
) -> ls.Solution:
    return ls.smooth(
        problem, form=form, start=scenario.paper_start, stop="cost", tolerance=tolerance, max_iterations=most,
        safeguard=False,
    )  # fmt: skip


def finished(scenario: ls.Scenario, problem: ls.Problem) -> ls.Solution:
    """With Newton's method for the last iterations; a plan that is off by rounding has some 1e-24 left."""
    return ls.smooth(problem, start=scenario.paper_start, tolerance=1e-24, max_iterations=MOST, safeguard=False)


def without_obstacles(problem: ls.Problem) -> ls.Problem:
    """The same with an obstacle weight of zero, which compiles nothing."""
    terms = [
        ls.ObstacleCost(term.world, radius=term.radius, sharpness=term.sharpness, weight=0.0)
        if isinstance(term, ls.ObstacleCost)
        else term
        for term in terms_of(problem.stage_cost)
    ]
    return replace(problem, stage_cost=CostSum(tuple(terms)))


def consistency(problem: ls.Problem, solution: ls.Solution) -> dict[str, float]:
    """By how much, at most, minimal-total-cost states miss the true dynamics, and the two policies each other."""
    x_hat, inverse = solution.total_cost.minimizer(), solution.inverse_policy
    assert inverse is not None
    controls = np.array([solution.policy.control(x, t) for t, x in enumerate(x_hat[:-1])])
    backwards = np.array([inverse.control(x, t) for t, x in enumerate(x_hat[1:])])
    missed = truth.ahead(problem, x_hat[:-1], controls) - x_hat[1:]
    return {"residual": float(np.abs(missed).max()), "controls": float(np.abs(controls - backwards).max())}

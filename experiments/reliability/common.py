"""What the sections share: what they are told, the quadrotor's queries, and what is asked of every solution."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from runner import Settings, progress
from tqdm import tqdm

import lqrsim as ls
from lqrsim.errors import check_name
from lqrsim.problem.parts import terms_of
from reliability.problems import KINDS

Section = Literal["stiff", "fragile", "random", "overhead", "ablation"]


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to measure."""
    queries: int = 100
    """How many of the quadrotor's random starts and goals."""
    seed: int = 0
    """Of the queries, and of the random problems."""
    share: float = 1.0
    """Of the thousand random problems."""
    kinds: tuple[str, ...] = KINDS
    """Of random problems."""
    sample: int = 10
    """How many random problems of each kind iLQR tries to improve on."""
    rounds: int = 5
    """How often each is timed."""
    threads: int | None = None
    """How many solve at once where nothing is timed; by default as many as there are processors."""

    def __post_init__(self) -> None:
        for kind in self.kinds:
            check_name("kinds", kind, KINDS)


def queries(config: Config, count: int | None = None, *, soft: bool = False) -> list[ls.Problem]:
    """The quadrotor's problems, by default all, with the start given exactly or, as in the paper, softly.

    Controls have no limits, as in the paper.
    """
    count = config.queries if count is None else min(count, config.queries)
    problems = [ls.scenarios.quadrotor(query=query, seed=config.seed).problem for query in range(count)]
    problems = [replace(problem, control_limits=(-np.inf, np.inf)) for problem in problems]
    return problems if soft else [fixed(problem) for problem in problems]


def fixed(problem: ls.Problem) -> ls.Problem:
    """The same from exactly the wished start."""
    assert problem.start is not None
    return replace(problem, initial=ls.FixedState(problem.start))


def paper_start() -> ls.InitialPrior:
    """How the paper begins with the quadrotor: from hover, upright."""
    start = ls.scenarios.quadrotor().paper_start
    assert start is not None
    return start


def solve(config: Config, problems: Sequence[ls.Problem], name: str, **options: Any) -> list[ls.Solution]:
    """`smooth_many`, with a bar."""
    with tqdm(total=len(problems), desc=name, leave=False, delay=2.0, disable=None) as bar:
        return ls.smooth_many(problems, threads=config.threads, progress=lambda *_: bar.update(), **options)


def summary(solutions: Sequence[ls.Solution]) -> dict[str, Any]:
    """One entry a solution of each thing there is to ask."""
    return {
        "status": [solution.status.name for solution in solutions],
        "detail": [solution.detail for solution in solutions],
        "iterations": [len(solution.iterations) for solution in solutions],
        "cost": [solution.cost for solution in solutions],
        "gap": [solution.gap for solution in solutions],
        "optimality": [solution.optimality for solution in solutions],
        "damped": [not {row.method for row in solution.iterations} <= {"smooth"} for solution in solutions],
        "handed_over": ["ilqr" in {row.method for row in solution.iterations} for solution in solutions],
    }


def converged(found: dict[str, Any]) -> int:
    """How many of a summary."""
    return found["status"].count("CONVERGED")


def endings(found: dict[str, Any]) -> str:
    """How those ended that did not converge, in words."""
    others = Counter(status for status in found["status"] if status != "CONVERGED")
    return ", ".join(f"{count} {status}" for status, count in others.most_common())


def improvements(pairs: Iterable[tuple[ls.Problem, ls.Solution]], name: str) -> list[float | None]:
    """By what share of its cost iLQR, started from the plan and iterated to 1e-9, still improves each of them.

    A soft start is held where the plan has it. None for what did not converge, and for what starts inside an obstacle,
    where no problem may.
    """

    def improvement(problem: ls.Problem, solution: ls.Solution) -> float | None:
        if solution.status.name != "CONVERGED":
            return None
        plan, paid = solution.trajectory, 0.0
        if not isinstance(problem.initial, ls.FixedState):
            for term in terms_of(problem.initial):
                assert isinstance(term, ls.QuadraticCost)
                away = plan.states[0] - term.about
                paid += 0.5 * float(away @ term.weight @ away)
        try:
            held = replace(problem, initial=ls.FixedState(plan.states[0]))
        except ls.InputError:
            return None
        further = ls.ilqr(held, start=plan.controls, tolerance=1e-9, max_iterations=2000)
        return (solution.cost - paid - further.cost) / max(
            abs(solution.cost), 1e-20
        )  # of less, it is a share of rounding

    return [improvement(problem, solution) for problem, solution in progress(list(pairs), name)]


def worst(values: Iterable[float | None]) -> float:
    """The largest, or NaN if one is; 0 if there is none."""
    return float(np.max([value for value in values if value is not None], initial=0.0))


def cost_from_start(problem: ls.Problem, solution: ls.Solution) -> float:
    """What the policy costs from exactly the wished start; NaN if that is not finite."""
    # The improvement of iLQR's first iteration is relative to the cost of the policy that it begins with.
    rows = ls.ilqr(fixed(problem), start=solution.policy, max_iterations=1, stop="cost").iterations
    return rows[0].cost + rows[0].improvement * abs(rows[0].cost) if rows else float("nan")


def mean(values: Iterable[float], wanted: Callable[[float], bool] = np.isfinite) -> float:
    """Of those that are wanted, by default the finite ones."""
    kept = [value for value in values if wanted(value)]
    return float(np.mean(kept)) if kept else float("nan")

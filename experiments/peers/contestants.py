"""Who takes part in a comparison: each is a function of a problem that answers with a plan."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import lqrsim as ls
from peers.common import Answer, Unavailable

Solve = Callable[[ls.Problem], Answer]
Solver = TypeVar("Solver")


def ours(solver: Callable[..., list[ls.Solution]], **options: Any) -> Solve:
    """`ls.smooth_many` or `ls.ilqr_many`, on one thread."""

    def solve(problem: ls.Problem) -> Answer:
        (solution,) = solver([problem], threads=1, **options)
        plan = solution.trajectory
        return Answer(plan.states, plan.controls, solution.cost, all_iterations(solution), solution.success)

    return solve


def all_iterations(solution: ls.Solution) -> int:
    """Of all starts that were tried."""
    return sum(one.iterations for one in solution.candidates) or len(solution.iterations)


def timed(solve: Solve) -> Solve:
    """The same, with the seconds of the whole call."""

    def run(problem: ls.Problem) -> Answer:
        clock = time.perf_counter()
        answer = solve(problem)
        return replace(answer, seconds=time.perf_counter() - clock)

    return run


def installed(makers: Mapping[str, Callable[[], Solver]]) -> tuple[dict[str, Solver], dict[str, str]]:
    """The solvers that can be had here, by name, and why the rest of them cannot."""
    found: dict[str, Solver] = {}
    missing: dict[str, str] = {}
    for name, make in makers.items():
        try:
            found[name] = make()
        except Unavailable as error:
            missing[name] = str(error)
    return found, missing

"""How solutions of cases ended, and what of it is false."""

import time
from dataclasses import dataclass
from typing import Any, Literal

import lqrsim as ls
from parking import cases, descent, judge
from parking.cases import Case
from parking.task import problem_of

Verdict = Literal["right", "false CONVERGED", "false INFEASIBLE", "unsolved", "raised"]

COULD_BE_SAVED = 1e-3  # of the cost, by `descent`: what is more than this is no rounding


@dataclass(frozen=True)
class Outcome:
    """One solve.

    Attributes:
      seed: of the case.
      number: of the case.
      features: of the case.
      verdict: what is to be thought of it.
      status: that it ended with; the name of the exception where it raised.
      said: what is false about it, or what it says of itself.
      iterations: of the solution.
      milliseconds: the solve took; where it was the first of its structure, with compiling or loading.
      cost: of the plan.
      known: the cost of the plan that is known; None for an impossible case.
    """

    seed: int
    number: int
    features: tuple[str, ...]
    verdict: Verdict
    status: str
    said: str
    iterations: int = 0
    milliseconds: float = 0.0
    cost: float = float("nan")
    known: float | None = None


def verdict_of(case: Case, solution: ls.Solution, *, improve: bool = False) -> tuple[Verdict, str]:
    """What is to be thought of a solution, and why. `improve`: whether a plan that is said to be optimal is tried."""
    status, plan = solution.status.name, solution.trajectory
    if status == "INFEASIBLE":
        return ("false INFEASIBLE", solution.detail) if case.plan is not None else ("right", case.reason)
    if not solution.success:
        return "unsolved", solution.detail
    wrong = judge.examine(case.task, plan.states, plan.controls).wrong
    if wrong:
        return "false CONVERGED", f"misses {', '.join(wrong)}"
    if case.plan is None:
        return "false CONVERGED", f"there is no plan: {case.reason}"
    share = descent.saved(case.task, plan.controls) if improve else 0.0
    if share > COULD_BE_SAVED:
        return "false CONVERGED", f"a plan beside it costs {100 * share:.2g} % less"
    return "right", ""


def look(number: int, *, seed: int = 0, improve: bool = False, **options: Any) -> Outcome:
    """Solve a case with options of `ls.smooth`, and judge it."""
    case = cases.draw(number, seed=seed)
    clock = time.perf_counter()
    try:
        solution = ls.smooth(problem_of(case.task), threads=1, **options)
    except Exception as error:  # whatever it is, it is no answer
        return Outcome(seed, number, case.features, "raised", type(error).__name__, str(error))
    milliseconds = 1e3 * (time.perf_counter() - clock)
    verdict, said = verdict_of(case, solution, improve=improve)
    plan = case.plan
    return Outcome(
        seed, number, case.features, verdict, solution.status.name, said, len(solution.iterations), milliseconds,
        solution.cost, None if plan is None else float(judge.cost(case.task, plan.states, plan.controls)),
    )  # fmt: skip

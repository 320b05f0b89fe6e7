"""Time of an iteration of the quadrotor in the compiled loop, and of the C++ reference, in turn."""

from pathlib import Path
from typing import Any

from peers import Unavailable
from solver_benchmark.common import Config, make_problems
from solver_benchmark.speed import load_reference

import lqrsim as ls

PASSES = 2  # over all queries


def measure(queries: int, reference: str | None) -> dict[str, Any]:
    """Seconds of an iteration: ours, and the reference's or why there are none, each by query."""
    config = Config(queries=queries, reference=Path(reference) if reference else None)
    problems, paper = make_problems(config), ls.scenarios.quadrotor().paper_start
    starts, goals = ls.scenarios.quadrotor_queries(queries, seed=config.seed)
    found: dict[str, Any] = {"ours": [], "reference": []}
    try:
        cpp = load_reference(config)
    except Unavailable as error:
        cpp, found["skipped"] = None, str(error)

    def ours(query: int) -> None:
        solution = ls.smooth(problems[query], start=paper, form="primal", stop="cost")
        seconds = sum(iteration.seconds for iteration in solution.iterations)
        found["ours"].append(seconds / len(solution.iterations))

    def theirs(query: int) -> None:
        if cpp is not None:
            one = slice(query, query + 1)
            iterations, _, seconds = cpp.solve(starts[one], goals[one], "smoother", prior=0.3)
            found["reference"].append(seconds / int(iterations.sum()))

    for turn in (ours, theirs):  # compiles, and is not counted
        turn(0)
    found |= {"ours": [], "reference": []}
    for place in range(PASSES * queries):
        # Each goes first at every other query, and at the next pass at the others.
        order = (ours, theirs) if (place % queries + place // queries) % 2 == 0 else (theirs, ours)
        for turn in order:
            turn(place % queries)
    return found

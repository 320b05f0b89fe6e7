"""How much less often the quadrotor collides if its law puts its effort where a deviation leads to a collision.

Two safe plans of each query are compared. The first has wider margins alone: its law has the chosen tolerances, the
same at all knots. The second has the default law with its emphasis. It is the first plan, or one that was asked for a
smaller chance, as small as keeps it no more expensive. The chances of both are measured by splitting where they are
small, else by counting.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from runner import progress, table

import lqrsim as ls
from robust import common
from robust.chances import Case, measured_chance
from robust.common import Config, reach_exactly

LESS = (1.0, 3.0, 10.0, 20.0, 50.0, 100.0)  # factors by which the second plan may be asked for less, in this order
SAME = 1.001  # costs that differ by no more are the same
TEN = 10.0  # factor from which queries are counted


def measure(config: Config) -> dict[str, Any]:
    kept, found = config.kept(), {preset: list[Any]() for preset in ("light", "moderate")}
    for query in progress(range(config.queries), "emphasis"):
        for preset, rows in found.items():
            rows.append(kept.row(f"emphasis, {preset}, {query}", partial(of_query, config, query, preset)))
    return found


def of_query(config: Config, query: int, preset: str) -> list[list[float] | None]:
    """The chances of the first plan and of the second, each with its interval."""
    scenario = ls.scenarios.quadrotor(query)
    plant, problem = scenario.plant(), reach_exactly(scenario.problem)
    disturbances = ls.disturbances.preset(preset, plant)
    stated, asked = ls.uncertainty_of(plant, disturbances), common.ASKED[preset]

    def tolerances_alone(problem: ls.Problem, solution: ls.Solution) -> ls.OffsetFree:
        chosen = ls.OffsetFree(problem, solution, stated).weights
        return ls.OffsetFree(problem, solution, stated, tolerate=tuple(chosen.state**-0.5))

    first = ls.smooth_chance_constrained(problem, stated, chance=asked, controller=tolerances_alone)
    law = ls.OffsetFree(first.problem, first.solution, stated)
    best = replace(first, controller=law, tube=ls.predict_tube(first.problem, first.solution, stated, law))
    for less in LESS:
        plan = ls.smooth_chance_constrained(problem, stated, chance=asked / less)
        if not plan.success or plan.cost > SAME * first.cost:
            break
        best = min(best, plan, key=lambda one: one.tube.collision_chance)
    return [measured_chance(config, Case(plant, disturbances, plan)) for plan in (first, best)]


def report(found: dict[str, Any]) -> list[str]:
    rows = []
    for preset, pairs in found.items():
        ratios = [before[0] / after[0] for before, after in pairs if before and after and after[0] > 0]
        apart = sum(bool(before and after) and after[2] < before[1] for before, after in pairs)
        factors = [f"{pick(ratios):.3g}" if ratios else "-" for pick in (np.median, min, max)]
        rows.append([preset, len(ratios), *factors, sum(ratio >= TEN for ratio in ratios), apart])
    head = ("preset", "queries", "factor, median", "least", "most", f"at least {TEN:g}", "95 % intervals disjoint")
    return [
        "By what factor the quadrotor collides less often with emphasis than with margins alone, on plans that cost at"
        f" most {100 * (SAME - 1):g} % more.",
        table(head, rows),
    ]

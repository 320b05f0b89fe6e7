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


def measure(config: Config) -> dict[str, Any]:
    kept, found = config.kept(), {preset: list[Any]() for preset in ("light", "moderate")}
    for query in progress(range(config.queries), "emphasis"):
        for preset, rows in found.items():
            rows.append(kept.row(f"emphasis, {preset}, {query}", partial(of_query, config, query, preset)))
    return found


def of_query(config: Config, query: int, preset: str) -> dict[str, Any]:
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
    row: dict[str, Any] = {"query": query, "asked": asked}
    for name, plan in (("margins", first), ("emphasis", best)):
        measured, simulations = measured_chance(config, Case(plant, disturbances, plan))
        row[name] = {
            "cost": plan.cost, "predicted": plan.tube.collision_chance, "measured": measured,
            "simulations": simulations,
        }  # fmt: skip
    return row


def report(found: dict[str, Any]) -> list[str]:
    head = ("query", "cost, margins alone", "cost, with emphasis", "chance, margins alone", "95 %",
            "chance, with emphasis", "95 %", "ratio")  # fmt: skip
    lines = []
    for preset, rows in found.items():
        ratios = [ratio for row in rows if np.isfinite(ratio := ratio_of(row))]
        less = (
            f"{len(ratios)} queries: with emphasis, the quadrotor collides less often by a factor of"
            f" {np.median(ratios):.3g} in the median, {min(ratios):.3g} to {max(ratios):.3g}"
            if ratios
            else f"no query of {len(rows)} in which both plans collide in what was run"
        )
        lines += [
            f"Preset '{preset}', {less}.",
            table(head, [cells(row) for row in rows]),
        ]
    return lines


def ratio_of(row: dict[str, Any]) -> float:
    before, after = (row[name]["measured"] for name in ("margins", "emphasis"))
    return before[0] / after[0] if before and after and after[0] > 0 else np.nan


def cells(row: dict[str, Any]) -> list[Any]:
    shown = []
    for name in ("margins", "emphasis"):
        value, low, high = row[name]["measured"] or (np.nan,) * 3
        shown += [f"{value:.2g}", f"{low:.2g} to {high:.2g}"]
    costs = [f"{row[name]['cost']:.4g}" for name in ("margins", "emphasis")]
    return [row["query"], *costs, *shown, f"{ratio_of(row):.2g}"]

"""Bad advice: a prior that draws the first iteration along the straight line, through whatever is in the way."""

from functools import partial
from typing import Any

import numpy as np

import lqrsim as ls
from reliability.common import Config, converged, endings, mean, paper_start, queries, solve, summary

WEIGHTS = (1.0, 10.0, 100.0)


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for weight in WEIGHTS:
        start = partial(along_the_line, weight=weight)
        for safeguard in (False, True):
            name = f"{weight:g}, {'with' if safeguard else 'without'}"
            found[name] = summary(solve(config, queries(config), f"fragile, {name}", safeguard=safeguard, start=start))
    return found


def along_the_line(problem: ls.Problem, weight: float) -> ls.InitialPrior:
    """That weight on the positions, at even speed from start to goal; on the rotation it is the paper's."""
    assert problem.start is not None
    assert problem.goal is not None
    share = np.linspace(0, 1, problem.steps + 1)[:, None]
    weights = paper_start().weight.copy()
    weights[:3] = weight
    return ls.InitialPrior(weights, about=(1 - share) * problem.start + share * problem.goal)


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"fragile: {'weight':>7} {'safeguard':>10} {'converged':>11} {'mean cost':>10} {'handed over':>12}"]
    for name, one in found.items():
        weight, safeguard = name.split(", ")
        count = len(one["status"])
        costs = [cost for cost, status in zip(one["cost"], one["status"], strict=True) if status == "CONVERGED"]
        rows.append(
            f"  {weight:>14} {safeguard:>10} {converged(one):>7}/{count:<3} {mean(costs):>10.2f}"
            f" {sum(one['handed_over']):>12}  {endings(one)}".rstrip()
        )
    return ["\n".join(rows)]

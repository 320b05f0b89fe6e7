"""Bad advice: a prior that draws the first iteration along the straight line, through whatever is in the way."""

from dataclasses import replace
from typing import Any

import numpy as np

import lqrsim as ls
from reliability.common import Config, converged, endings, mean, queries, solve, summary

WEIGHTS = (1.0, 10.0, 100.0)


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for weight in WEIGHTS:
        problems = [along_the_line(problem, weight) for problem in queries(config)]
        for safeguard in (False, True):
            name = f"{weight:g}, {'with' if safeguard else 'without'}"
            found[name] = summary(solve(config, problems, f"fragile, {name}", safeguard=safeguard))
    return found


def along_the_line(problem: ls.Problem, weight: float) -> ls.Problem:
    """The problem with that weight on the positions, at even speed from start to goal; on the rotation it stays."""
    assert problem.start is not None
    assert problem.prior is not None
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    share = np.linspace(0, 1, problem.steps + 1)[:, None]
    line = (1 - share) * problem.start + share * problem.final_cost.about
    weights = problem.prior.weight.copy()
    weights[:3] = weight
    return replace(problem, prior=ls.InitialPrior(weights, about=line))


def table(found: dict[str, Any]) -> str:
    rows = [f"fragile: {'weight':>7} {'safeguard':>10} {'converged':>11} {'mean cost':>10} {'handed over':>12}"]
    for name, one in found.items():
        weight, safeguard = name.split(", ")
        count = len(one["status"])
        costs = [cost for cost, status in zip(one["cost"], one["status"], strict=True) if status == "CONVERGED"]
        rows.append(
            f"  {weight:>14} {safeguard:>10} {converged(one):>7}/{count:<3} {mean(costs):>10.2f}"
            f" {sum(one['handed_over']):>12}  {endings(one)}".rstrip()
        )
    return "\n".join(rows)

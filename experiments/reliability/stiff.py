"""The quadrotor in thicker and thicker air: drag that acts within a step, where no inverse step exists."""

from dataclasses import replace
from typing import Any

import lqrsim as ls
from reliability.common import Config, converged, endings, improvements, paper_start, queries, solve, summary, worst

RATES = (0.01, 0.1, 0.33, 1.0)  # drag / mass * dt
COUNT = 40
BOUND = 1e-3  # of what iLQR may still improve


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for rate in RATES:
        problems = []
        for problem in queries(config, COUNT):
            drag = rate * ls.Quadrotor().mass / problem.dt
            problems.append(replace(problem, dynamics=ls.Quadrotor(drag=drag).dynamics))
        solutions = solve(config, problems, f"stiff, {rate:g}", start=paper_start())
        found[f"{rate:g}"] = summary(solutions) | {
            "improvement": improvements(zip(problems, solutions, strict=True), f"stiff, {rate:g}, improving")
        }
    return found


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"stiff: drag/mass dt {'converged':>11} {'iterations':>11} {'handed over':>12} {'iLQR improves at worst':>23}"
    ]
    for rate, one in found.items():
        count, left = len(one["status"]), worst(one["improvement"])
        verdict = "met" if converged(one) == count and left <= BOUND else "MISSED"
        rows.append(
            f"  {rate:>16} {converged(one):>7}/{count:<3} {sum(one['iterations']) / count:>11.1f}"
            f" {sum(one['handed_over']):>12} {100 * left:>21.4f} %  {verdict}: want all, <= {100 * BOUND:g} %"
            f" {endings(one)}".rstrip()
        )
    return ["\n".join(rows)]

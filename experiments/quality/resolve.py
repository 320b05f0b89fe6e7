"""Warm starts: iterations and cost of what begins with the solution of a similar problem, against a cold solve."""

from dataclasses import replace
from typing import Any

import numpy as np
from peers.contestants import all_iterations
from runner import progress
from solver_benchmark.common import median

import lqrsim as ls
from quality.common import Config, clear, cost, queries

SHIFT = 5  # steps that the horizon moves along
MOVED = 0.1  # m, the goal


def measure(config: Config) -> dict[str, Any]:
    problems = queries(min(config.resolves, config.queries), config.seeds[0])
    found: dict[str, Any] = {}
    for kept in (False, True):
        stated = [clear(problem) for problem in problems] if kept else problems
        name = ", clearance" if kept else ""
        rng = np.random.default_rng(config.seeds[0])
        rows: dict[str, list[dict[str, Any]]] = {f"shifted{name}": [], f"goal moved{name}": []}
        for problem in progress(stated, f"resolve{name}"):
            first = ls.smooth(problem, threads=config.threads)
            goal = moved_goal(problem, rng)
            rows[f"goal moved{name}"].append(again(config, goal, first))
            try:
                along = replace(problem, initial=ls.FixedState(first.trajectory.states[SHIFT]))
            except ls.InputError as error:  # the plan is inside an obstacle there, where no problem may start
                rows[f"shifted{name}"].append({"skipped": str(error)})
                continue
            rows[f"shifted{name}"].append(again(config, along, first.shifted(SHIFT)))
        found |= rows
    return found


def moved_goal(problem: ls.Problem, rng: np.random.Generator) -> ls.Problem:
    """With the goal a little away, in a random direction."""
    final, away = problem.final_cost, rng.normal(size=3)
    assert isinstance(final, ls.QuadraticCost)
    about = final.about.copy()
    about[:3] += MOVED * away / np.linalg.norm(away)
    return replace(problem, final_cost=ls.QuadraticCost(final.weight, about=about))


def again(config: Config, problem: ls.Problem, start: ls.Solution) -> dict[str, Any]:
    """Both solves of a problem."""
    both = {"warm": ls.smooth(problem, start=start), "cold": ls.smooth(problem, threads=config.threads)}
    return {
        name: {
            "status": solution.status.name,
            "iterations": len(solution.iterations),
            "all_iterations": all_iterations(solution),
            "claimed": solution.cost,
            "cost": cost(problem, solution.trajectory.controls),
            "violation": solution.violation,
        }
        for name, solution in both.items()
    }


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"resolve: {'':<22} {'converged':>10} {'(cold)':>8} {'iterations: median, worst':>26} {'cold':>10}"
        f" {'of all starts':>15} {'ratio':>6} {'cost, warm to cold: median, least, worst':>41} {'violation':>10}"
    ]
    for name, some in found.items():
        done = [one for one in some if "skipped" not in one]
        warm, cold = ([one[which] for one in done] for which in ("warm", "cold"))
        ratio = [a["cost"] / b["cost"] for a, b in zip(warm, cold, strict=True)]
        fewer = [a["iterations"] / b["iterations"] for a, b in zip(warm, cold, strict=True)]
        ended = [sum(one["status"] == "CONVERGED" for one in side) for side in (warm, cold)]
        own, others, tried = (
            [one[what] for one in side]
            for side, what in ((warm, "iterations"), (cold, "iterations"), (cold, "all_iterations"))
        )
        rows.append(
            f"  {name:<29} {ended[0]:>6}/{len(done):<3} {ended[1]:>4}/{len(done):<3}"
            f" {median(own):>16g}, {max(own):>8} {median(others):>5g}, {max(others):>3}"
            f" {median(tried):>9g}, {max(tried):>4} {median(fewer):>6.2f}"
            f" {median(ratio):>25.4f}, {min(ratio):.4f}, {max(ratio):.4f}"
            f" {max(one['violation'] for one in warm):>10.1e}"
        )
        skipped = [one["skipped"] for one in some if "skipped" in one]
        if skipped:
            rows.append(f"  {name}: {len(skipped)} skipped, such as: {skipped[0]}")
    return ["\n".join(rows)]

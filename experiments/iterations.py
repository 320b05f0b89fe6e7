"""How many iterations smoothing takes, and iLQR with line search: the quadrotor's random queries, as in Table I.

    python experiments/iterations.py            # 100 queries
    python experiments/iterations.py --quick    # 20

Soft start, no limits of the rotors, the paper's stop test (relative change of cost below 1e-4), both from hover.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

import lqrsim as ls


@dataclass(frozen=True, kw_only=True)
class Config:
    queries: int = 100
    """How many random starts and goals."""
    seed: int = 0
    """Of the queries."""
    quick: bool = False
    """20 queries."""
    json: bool = False
    """Print everything, query by query, as JSON instead of the table."""


def main(config: Config) -> dict[str, Any]:
    count = 20 if config.quick else config.queries
    solvers: dict[str, Callable[..., ls.Solution]] = {"smooth": ls.smooth, "ilqr": ls.ilqr}
    solutions: dict[str, list[ls.Solution]] = {name: [] for name in solvers}
    for query in tqdm(range(count), unit="query", leave=False, delay=2.0, disable=None):
        scenario = ls.scenarios.quadrotor(query=query, seed=config.seed)
        problem = replace(scenario.problem, control_limits=(-np.inf, np.inf))
        for name, solver in solvers.items():
            start = scenario.paper_start if name == "smooth" else None
            solutions[name].append(solver(problem, stop="cost", start=start))
    result: dict[str, Any] = {"config": asdict(config), "versions": dict(solutions["smooth"][0].versions)}
    for name, solved in solutions.items():
        result[name] = {
            "status": [solution.status.name for solution in solved],
            "iterations": [len(solution.iterations) for solution in solved],
            "cost": [solution.cost for solution in solved],
            "start_offset": [_start_offset(solution, seed=config.seed, query=q) for q, solution in enumerate(solved)],
            "milliseconds": [1e3 * sum(iteration.seconds for iteration in solution.iterations) for solution in solved],
        }
    return result


def _start_offset(solution: ls.Solution, *, seed: int, query: int) -> float:
    """How far in metres the plan begins from where it was to begin."""
    start = ls.scenarios.quadrotor_queries(query + 1, seed=seed)[0][query]
    return float(np.linalg.norm(solution.trajectory.states[0, :3] - start[:3]))


def report(result: dict[str, Any]) -> str:
    rows = [
        f"{'solver':<8} {'solved':>8} {'iterations':>11} {'cost':>8} {'ms':>8} {'ms/iteration':>13} {'start off m':>12}"
    ]
    for name in ("smooth", "ilqr"):
        found = result[name]
        iterations, milliseconds = np.mean(found["iterations"]), np.mean(found["milliseconds"])
        solved = sum(status == "COST_CONVERGED" for status in found["status"])
        rows.append(
            f"{name:<8} {solved:>4}/{len(found['status']):<3} {iterations:>11.2f} {np.mean(found['cost']):>8.2f}"
            f" {milliseconds:>8.1f} {milliseconds / iterations:>13.2f} {np.mean(found['start_offset']):>12.3f}"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    outcome = main(settings)
    print(json.dumps(outcome) if settings.json else report(outcome))

"""lqrsim against other people's solvers: time of a query, and what the plan costs from a start given exactly."""

from typing import Any

import numpy as np
import peers
from peers.contestants import ours, timed
from reliability.common import fixed

from solver_benchmark.common import MANY, PAPER, Config, make_problems, median, take_turns


def measure(config: Config) -> dict[str, Any]:
    """Query by query: lqrsim's solvers and Crocoddyl's, and what the plan of each costs from the given start."""
    problems = [fixed(problem) for problem in make_problems(config)]
    crocoddyl = peers.Crocoddyl(problems[0])
    solvers = {
        "smooth, hover": ours(MANY["smooth"], stop="cost"),
        "Newton, hover": ours(PAPER, finish="newton", stop="optimal"),
        "ilqr, hover": ours(MANY["ilqr"], stop="cost"),
        "FDDP, hover": crocoddyl.from_hover,
        "FDDP, line": crocoddyl.from_line,
    }
    contestants = {name: timed(solver) for name, solver in solvers.items()}
    for run in contestants.values():
        run(problems[0])  # compile
    turns = take_turns(contestants, problems, config.rounds, "peers")
    result: dict[str, Any] = {}
    for name, queries in turns.items():
        first = [rounds[0] for rounds in queries]
        costs = [peers.cost_of(problem, answer.controls) for problem, answer in zip(problems, first, strict=True)]
        own = np.array([answer.cost for answer in first])
        seconds = [median(answer.seconds for answer in rounds) for rounds in queries]
        result[name] = {
            "converged": [answer.converged for answer in first],
            "iterations": [answer.iterations for answer in first],
            "cost": costs,
            "cost_difference": float(np.abs(own / costs - 1).max()),
            "milliseconds": [1e3 * value for value in seconds],
        }
    return result


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"peers, one thread: {'converged':>9} {'iterations':>11} {'ms/query':>9} {'(mean)':>8} {'mean cost':>10}"]
    for name, one in found.items():
        solved = f"{sum(one['converged'])}/{len(one['converged'])}"
        rows.append(
            f"  {name:<16} {solved:>9} {np.mean(one['iterations']):>11.2f} {np.median(one['milliseconds']):>9.1f}"
            f" {np.mean(one['milliseconds']):>8.1f} {np.mean(one['cost']):>10.2f}"
        )
    rows.append("  ms/query is the median; costs are from exactly the given start, recomputed in the same way for all")
    return ["\n".join(rows)]

"""How long a query takes, in turns, one thread: one start and several, against FDDP and IPOPT."""

from typing import Any

import numpy as np
from peers.contestants import ours, timed
from runner import judge
from solver_benchmark.common import median, take_turns

import lqrsim as ls
from quality.common import NONE, Config, others, queries, skips

OURS: dict[str, dict[str, Any]] = {"smooth, one start": {"starts": 1}, "smooth": {}}
THEIRS = ("FDDP, hover", "IPOPT, line")
TARGETS = {
    ("smooth, one start", "FDDP, hover"): 0.5,
    ("smooth, one start", "IPOPT, line"): 0.1,
    ("smooth", "FDDP, hover"): 1.3,
}


def measure(config: Config) -> dict[str, Any]:
    problems = queries(config.queries, config.seeds[0], NONE)
    solvers, skipped = others(config, problems[0], THEIRS)
    solvers = {name: ours(ls.smooth_many, **options) for name, options in OURS.items()} | solvers
    runs = {name: timed(solver) for name, solver in solvers.items()}
    for run in runs.values():
        run(problems[0])  # compile
    few, rest = problems[: config.ipopt_queries], problems[config.ipopt_queries :]
    without = {name: run for name, run in runs.items() if not name.startswith("IPOPT")}
    turns = take_turns(runs, few, config.rounds, "time")
    if rest:
        for name, jobs in take_turns(without, rest, config.rounds, "time, without IPOPT").items():
            turns[name] += jobs
    seconds = {
        name: [1e3 * median(answer.seconds for answer in rounds) for rounds in jobs] for name, jobs in turns.items()
    }
    return {"milliseconds": seconds, "skipped": skipped}


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"time, one thread: {'queries':>8} {'ms/query':>9} {'(median)':>9}"]
    taken = found["milliseconds"]
    for name, one in taken.items():
        rows.append(f"  {name:<17} {len(one):>6} {np.mean(one):>9.1f} {np.median(one):>9.1f}")
    for (one, other), most in TARGETS.items():
        if other in taken:
            pairs = list(zip(taken[one], taken[other], strict=False))  # IPOPT solves the first ones only
            mine, their = (np.array(side) for side in zip(*pairs, strict=True))
            ratio = float(mine.mean() / their.mean())
            rows.append(
                f"  {one} / {other}: {ratio:.3f} (of a query, in the median {np.median(mine / their):.3f})"
                f"  {judge(ratio <= most, f'<= {most:g}')}"
            )
    return ["\n".join(rows + skips(found["skipped"]))]

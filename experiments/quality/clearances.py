"""A clearance that is kept: at the steps and between them, and what it costs."""

import time
from typing import Any

import numpy as np
from runner import judge, progress

import lqrsim as ls
from quality.common import Config, Found, clear, clearance, converged, endings, of_solutions, queries

MARGIN = 0.05  # m, on the first seed
TOLERANCE = 1e-3  # m, at the steps
BETWEEN, PARTS = -2e-3, 10  # m, between them, and in how many parts a step is looked at
COST = 1.02  # times that without it


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {"free": {}, "kept": {}}
    for seed in config.clearance_seeds:
        problems = queries(config.queries, seed)
        found["free"][str(seed)] = one_by_one(config, problems, 0.0, f"clearance, seed {seed}, without")
        found["kept"][str(seed)] = one_by_one(config, [clear(p) for p in problems], 0.0, f"clearance, seed {seed}")
    problems = [clear(problem, MARGIN) for problem in queries(config.queries, config.clearance_seeds[0])]
    name = f"{config.clearance_seeds[0]}, {MARGIN:g} m"
    found["kept"][name] = one_by_one(config, problems, MARGIN, f"clearance, seed {name}")
    return found


def one_by_one(config: Config, problems: list[ls.Problem], margin: float, name: str) -> Found:
    """Default settings, one thread; clearances are of what is left beyond the margin."""
    solutions, seconds = [], []
    ls.smooth_many(problems[:1], threads=1)  # compile
    if not config.quick:
        ls.smooth_many(problems[:1], threads=1, max_iterations=1)  # the safeguard, too, which few of them need
    for problem in progress(problems, name):
        clock = time.process_time()
        (solution,) = ls.smooth_many([problem], threads=1)
        seconds.append(time.process_time() - clock)
        solutions.append(solution)
    plans = [(problem, solution.trajectory.controls) for problem, solution in zip(problems, solutions, strict=True)]
    return of_solutions(problems, solutions, name) | {
        "violation": [solution.violation for solution in solutions],
        "candidate": [which(solution) for solution in solutions],
        "clearance": [clearance(*plan) - margin for plan in progress(plans, f"{name}, clearance")],
        "between": [clearance(*plan, parts=PARTS) - margin for plan in progress(plans, f"{name}, between")],
        "milliseconds": [1e3 * value for value in seconds],
    }


def which(solution: ls.Solution) -> int:
    """How many starts were run to their end."""
    return sum(one.status is not None for one in solution.candidates)


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"clearance: {'seed':<10} {'converged':>10} {'cost':>8} {'x without':>10} {'violation':>10} {'at steps':>9}"
        f" {'between':>9} {'iterations':>11} {'of all':>7} {'damped':>7} {'ms/query':>9} {'without':>8}"
        "   (the least clearance in mm; ms of the processor, one thread)"
    ]
    ratios, failed, missed = [], [], 0
    for name, one in found["kept"].items():
        free = found["free"][name.split(",")[0]]
        count, ratio = len(one["cost"]), float(np.mean(one["cost"]) / np.mean(free["cost"]))
        ratios += [ratio] if "," not in name else []
        missed += sum(value > TOLERANCE for value in one["violation"])
        rows.append(
            f"  {name:<19} {converged(one):>6}/{count:<3} {np.mean(one['cost']):>8.3f} {ratio:>10.4f}"
            f" {max(one['violation']):>10.1e} {1e3 * min(one['clearance']):>9.3f} {1e3 * min(one['between']):>9.3f}"
            f" {np.mean(one['iterations']):>11.2f} {np.mean(one['all_iterations']):>7.1f} {sum(one['damped']):>7}"
            f" {np.mean(one['milliseconds']):>9.1f} {np.mean(free['milliseconds']):>8.1f}  {endings(one)}".rstrip()
        )
        failed += [
            f"  {name}, query {i}: {status}: {one['detail'][i]}"
            for i, status in enumerate(one["status"])
            if status != "CONVERGED"
        ]
    several = sum(number > 1 for one in found["kept"].values() for number in one["candidate"])
    if several:
        rows.append(f"  {several} were found with several starts run to their end, for each was below what was found")
    cuts = [sum(value < -TOLERANCE for value in one["clearance"]) for one in found["free"].values()]
    dip = 1e3 * min(value for one in found["kept"].values() for value in one["between"])
    rows.append(f"  without it, {sum(cuts)} plans cut through something")
    rows.append(f"  failed {len(failed)}  {judge(not failed, 'none, with a margin or without')}")
    rows.append(f"  missed by more than {TOLERANCE:g} m at the steps: {missed}  {judge(missed == 0, 'none')}")
    rows.append(
        f"  cost, times that without it: at worst {max(ratios):.4f}  {judge(max(ratios) <= COST, f'<= {COST}')}"
    )
    rows.append(
        f"  between the steps, at worst {dip:.2f} mm  {judge(dip >= 1e3 * BETWEEN, f'>= {1e3 * BETWEEN:g} mm')};"
        f" a margin of {max(-dip, 0):.1f} mm would make up for it"
    )
    return ["\n".join(rows + failed)]

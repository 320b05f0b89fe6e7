"""Which optimum is found: the cost of each plan against the lowest one known."""

from typing import Any

import numpy as np
import peers
from reliability.common import mean, paper_start
from runner import judge, progress

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.archive import replacing
from quality.common import (
    ALL,
    NONE,
    PEERS,
    Config,
    Found,
    best_known,
    converged,
    endings,
    of_answers,
    of_solutions,
    others,
    queries,
    skips,
    solve,
)

ONE, SEVERAL = "smooth, one start", "smooth"
OURS: dict[str, dict[str, Any]] = {
    ONE: {"starts": 1},
    SEVERAL: {},
    "smooth, 13, 1e-9": {"starts": 13, "tolerance": 1e-9, "gap_tolerance": 1e-6},
    "smooth, hover": {"start": paper_start()},
}
NEAR = 0.01  # what counts as the best known
LOWER = 1e-6  # relative, what is lower than that
MEANS = {0: 122.5, 1: 119.5, 2: 119.5}  # of one start, at most
NEAR_ONE, NEAR_SEVERAL = 72, 98  # of 100
ITERATIONS = 8.5


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {"seeds": {}, "skipped": {}}
    lowest: list[tuple[int, int, float, float, Array]] = []
    try:
        known = best_known(config)
    except peers.Unavailable as error:
        known = {}
        found["skipped"]["lowest costs known"] = str(error)
    for seed in config.seeds:
        problems = queries(config.queries, seed, NONE)
        one: dict[str, Found] = {}
        plans: dict[str, list[ls.Solution]] = {}
        for name, options in OURS.items():
            said = f"starts, seed {seed}, {name}"
            plans[name] = solve(config, problems, said, **options)
            one[name] = of_solutions(problems, plans[name], said)
        solvers, skipped = others(config, problems[0], PEERS)
        for name, solver in solvers.items():
            said = f"starts, seed {seed}, {name}"
            one[name] = of_answers(problems, [solver(problem) for problem in progress(problems, said)], said)
        found["skipped"] |= skipped
        if seed in known:
            best = np.array(known[seed][: config.queries])
            for contestant in one.values():
                excess = np.array(contestant["cost"][: len(best)]) / best - 1
                contestant["excess"] = excess.tolist()
            lowest += [(seed, i, *lowest_plan(one, plans, i)) for i in range(len(best))]
        found["seeds"][str(seed)] = one
    if config.save is not None:
        kept = [(seed, i, cost, controls) for seed, i, excess, cost, controls in lowest if excess < -LOWER]
        seeds, indices, costs, controls = zip(*kept, strict=True) if kept else ((), (), (), ())
        with replacing(config.save) as unfinished, unfinished.open("wb") as file:
            np.savez_compressed(file, seed=seeds, query=indices, cost=costs, controls=controls)
    return found


def lowest_plan(one: dict[str, Found], plans: dict[str, list[ls.Solution]], query: int) -> tuple[float, float, Array]:
    """What of the best known the cheapest of our plans costs more, its cost, and its controls."""
    name = min(plans, key=lambda name: one[name]["cost"][query])
    return one[name]["excess"][query], one[name]["cost"][query], plans[name][query].trajectory.controls


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"starts: {'seed':>4} {'':<18} {'failed':>7} {'mean cost':>10} {'within 1 % of best':>19} {'iterations':>11}"
        f" {'of all starts':>14}"
    ]
    lower = []
    for seed, contestants in found["seeds"].items():
        for name, one in contestants.items():
            count = len(one["cost"])
            near = f"{nearest(one)}/{len(one['excess'])}" if "excess" in one else "-"
            rows.append(
                f"  {seed:>10} {name:<18} {count - converged(one):>7} {mean(one['cost']):>10.3f} {near:>19}"
                f" {np.mean(one['iterations']):>11.2f} {np.mean(one['all_iterations']):>14.2f}"
                f"  {endings(one)}".rstrip()
            )
            lower += [
                f"  lower than the best known: {name}, seed {seed}, query {i}: by {-excess:.1e}, {one['cost'][i]:.6f}"
                for i, excess in enumerate(one.get("excess", ()))
                if excess < -LOWER
            ]
    return ["\n".join(rows + verdicts(found) + lower + skips(found["skipped"]))]


def nearest(one: Found) -> int:
    """How many are about the best known."""
    return sum(excess <= NEAR for excess in one["excess"])


def verdicts(found: dict[str, Any]) -> list[str]:
    rows = []
    for seed, contestants in found["seeds"].items():
        one, several = contestants[ONE], contestants[SEVERAL]
        if len(one["cost"]) != ALL:  # what is to be met is so of all of them
            continue
        if int(seed) in MEANS:
            cost, most = mean(one["cost"]), MEANS[int(seed)]
            rows.append(f"  one start, seed {seed}: mean cost {cost:.3f}  {judge(cost <= most, f'<= {most:g}')}")
        if "excess" in one:
            for name, contestant, least in (("one start", one, NEAR_ONE), ("default starts", several, NEAR_SEVERAL)):
                near = nearest(contestant)
                rows.append(f"  {name}, seed {seed}: within 1 % {near}  {judge(near >= least, f'>= {least}')}")
    ones = [contestants[ONE] for contestants in found["seeds"].values()]
    iterations = float(np.mean([np.mean(one["iterations"]) for one in ones]))
    failed = sum(len(one["status"]) - converged(one) for one in ones)
    rows.append(f"  one start: iterations {iterations:.2f}  {judge(iterations <= ITERATIONS, f'<= {ITERATIONS:g}')}")
    rows.append(f"  one start: failed {failed}  {judge(failed == 0, 'none')}")
    failed = sum(len(one[SEVERAL]["status"]) - converged(one[SEVERAL]) for one in found["seeds"].values())
    rows.append(f"  default starts: failed {failed}  {judge(failed == 0, 'none')}")
    return rows

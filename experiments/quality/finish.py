"""Newton's method at the end against smoothing alone: iterations to the same accuracy, and whether costs are the same.

Both begin at hover, with one start, and go on until next to nothing of the cost is promised, so that their costs can be
compared; iterations are counted until less than `EXACT` of it is. Costs are recomputed.
"""

from typing import Any

import numpy as np
from reliability.common import paper_start

import lqrsim as ls
from quality.common import NONE, Config, Found, converged, endings, of_solutions, queries, solve

EXACT = 1e-8  # of the cost, what may still be promised
ENOUGH = 1e-12  # the same at the end
SAME = 1e-9  # relative: costs that differ by less are those of one optimum
NEWTON, ALONE = "newton", "none"
OURS: dict[str, dict[str, Any]] = {NEWTON: {"finish": "newton"}, ALONE: {"finish": None}}


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for seed in config.seeds:
        problems, one = queries(config.queries, seed, NONE), dict[str, Found]()
        for name, options in OURS.items():
            said = f"finish, seed {seed}, {name}"
            told = {"start": paper_start(), "tolerance": ENOUGH, "max_iterations": 2000, **options}
            solutions = solve(config, problems, said, **told)
            one[name] = of_solutions(problems, solutions, said) | {"to_exact": list(map(to_exact, solutions))}
        found[str(seed)] = one
    return found


def to_exact(solution: ls.Solution) -> int:
    """After how many iterations no more than EXACT was promised, and never more again."""
    promised = np.array([one.optimality for one in solution.iterations])
    return int(np.flatnonzero(~(promised <= EXACT)).max(initial=-1)) + 2


def compared(one: dict[str, Found]) -> tuple[int, int, int]:
    """In how many queries Newton's method ends at the same cost, at a lower one, and at a higher one."""
    first, second = (np.array(one[name]["cost"]) for name in (NEWTON, ALONE))
    apart = first / second - 1
    return int((np.abs(apart) <= SAME).sum()), int((apart < -SAME).sum()), int((apart > SAME).sum())


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"finish: {'seed':>6} {'finish=':<8} {'failed':>7} {f'iterations to {EXACT:g}: median, mean, most':>40}"
        f" {f'cost the same to {SAME:g}, lower, higher':>40}"
    ]
    for seed, both in found.items():
        for name, one in both.items():
            counts = one["to_exact"]
            said = f"{np.median(counts):g}, {np.mean(counts):.1f}, {max(counts)}"
            judged = ", ".join(map(str, compared(both))) if name == NEWTON else ""
            failed = len(counts) - converged(one)
            rows.append(f"  {seed:>12} {name:<8} {failed:>7} {said:>40} {judged:>40}  {endings(one)}".rstrip())
    return ["\n".join(rows)]

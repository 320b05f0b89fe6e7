"""What each choice of the search brings: path, continuation, how many starts, when all but one are dropped."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import peers
from reliability.common import mean, paper_start

from lqrsim.errors import Array
from lqrsim.solvers import multistart
from quality.common import (
    NONE,
    Config,
    best_known,
    converged,
    endings,
    of_solutions,
    queries,
    skips,
    solve,
)
from quality.starts import nearest


def linear(start: Array, goal: Array, bend: Array, steps: int) -> Array:
    """As `multistart.path`, but at even speed."""
    way = np.linspace(0, 1, steps + 1)[:, None]
    return start + way * (goal - start) + np.sin(np.pi * way) * bend


LATE = {"HALVE": 1000, "CHOOSE": 1000}  # all run to their end
# Options of `smooth`, and what `multistart` has instead of its own.
ROWS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "hover": ({"start": paper_start()}, {}),
    "+ line": ({"starts": 1}, {"OBSTACLES": ()}),
    "+ continuation": ({"starts": 1}, {}),
    "3 starts": ({"starts": 3}, {}),
    "5 starts": ({"starts": 5}, {}),
    "7 starts, the default": ({}, {}),
    "9 starts": ({"starts": 9}, {}),
    "dropped late": ({}, LATE),
    "no continuation": ({}, {"OBSTACLES": ()}),
    "at even speed": ({}, {"path": linear}),
    "path weight x 0.3": ({}, {"PATH_WEIGHT": 0.3 * multistart.PATH_WEIGHT}),
    "path weight x 3": ({}, {"PATH_WEIGHT": 3 * multistart.PATH_WEIGHT}),
    "1 start, at even speed": ({"starts": 1}, {"path": linear}),
    "1 start, path weight x 0.3": ({"starts": 1}, {"PATH_WEIGHT": 0.3 * multistart.PATH_WEIGHT}),
    "1 start, path weight x 3": ({"starts": 1}, {"PATH_WEIGHT": 3 * multistart.PATH_WEIGHT}),
}


@contextmanager
def instead(values: dict[str, Any]) -> Iterator[None]:
    """`multistart` with other values of its names, within the block only."""
    before = {name: getattr(multistart, name) for name in values}
    try:
        for name, value in values.items():
            setattr(multistart, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(multistart, name, value)


def measure(config: Config) -> dict[str, Any]:
    seed = config.seeds[0]
    problems = queries(config.queries, seed, NONE)
    found: dict[str, Any] = {"rows": {}, "skipped": {}}
    try:
        known = best_known(config).get(seed, [])[: len(problems)]
    except peers.Unavailable as error:
        known = []
        found["skipped"]["lowest costs known"] = str(error)
    solve(config, problems[:1], "ingredients", threads=1)  # compile
    for name, (options, values) in ROWS.items():
        with instead(values):
            clock = time.process_time()
            solutions = solve(config, problems, f"ingredients, {name}", threads=1, **options)
            seconds = time.process_time() - clock
        one = of_solutions(problems, solutions, f"ingredients, {name}")
        one["milliseconds"] = 1e3 * seconds / len(problems)
        if known:
            one["excess"] = (np.array(one["cost"][: len(known)]) / known - 1).tolist()
        found["rows"][name] = one
    return found


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"ingredients: {'':<14} {'mean cost':>10} {'within 1 % of best':>19} {'iterations in all':>18} {'ms/query':>9}"
        f" {'failed':>7}"
    ]
    for name, one in found["rows"].items():
        near = f"{nearest(one)}/{len(one['excess'])}" if "excess" in one else "-"
        rows.append(
            f"  {name:<25} {mean(one['cost']):>10.3f} {near:>19} {np.mean(one['all_iterations']):>18.2f}"
            f" {one['milliseconds']:>9.1f} {len(one['cost']) - converged(one):>7}  {endings(one)}".rstrip()
        )
    rows.append("  ms/query is time of the processor, one thread")
    return ["\n".join(rows + skips(found["skipped"]))]

"""The 43 least-time problems of dynobench, by the default search: least times, beside those that its planners found.

    python experiments/dynobench.py                              # all, an hour at most on one processor
    python experiments/dynobench.py --only quad2d acrobot        # those whose name has one of these in it
    python experiments/dynobench.py --statements knots           # one of those below
    python experiments/dynobench.py --variants 3 --statements knots outside   # variants of those with obstacles
    python experiments/dynobench.py --quick                      # two problems

Robots with wheels, quadrotors, a pole on a quadrotor and an acrobot go from rest to rest among boxes. Each problem is
stated for `ls.smooth(problem)` alone, with a free duration in 100 steps:

  knots    as the defaults have it: one Runge-Kutta step in a period, and conditions at the knots.
  clear    with 3 cm of clearance, as published plans keep.
  exact    with `accuracy=` and `between_knots=True`.
  euler    as dynobench has it, a map of Euler steps of 0.01 or 0.1 s, with 3 cm of clearance: the fewest steps that
           converge, from the plan of `clear`, whose time is not counted here, and at most a few counts.
  outside  as `knots`, by a search that knows the robots (`kinodynamic/outside.py`), for comparison; not by default.

What is said is judged by `kinodynamic/check.py`, which has nothing of lqrsim: `euler` by dynobench's own conditions,
the others in exact time and between the knots. Published is the least time of a feasible plan that comes with
dynobench. A plan that is CONVERGED as `exact` or `euler` and does not pass is a failure.
"""

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

from kinodynamic import check, outside
from kinodynamic.data import CASES, Case
from kinodynamic.statements import KEPT, by_euler_steps, in_least_time
from kinodynamic.variants import drawn
from runner import Kept, Result, Settings, opening, progress, run, table

import lqrsim as ls

Row = dict[str, Any]
Statement = Literal["knots", "clear", "exact", "euler", "outside"]

OPTIONS: Mapping[str, Mapping[str, Any]] = {"knots": {}, "clear": {"margin": KEPT}, "exact": {"right": True}}
USUAL: tuple[Statement, ...] = ("knots", "clear", "exact", "euler")
QUICK = ("quad2d_v0/empty_0", "unicycle1_v0/parallelpark_0")
NOTHING: Row = {"status": "NO_START", "time": None, "seconds": 0.0, "detail": ""}
COUNTS = 8  # of steps that are tried for a plan of Euler steps
SPARED = 0.02  # share of the steps by which their count is first changed


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    only: tuple[str, ...] = ()
    """Problems whose name has one of these in it; by default all."""
    statements: tuple[Statement, ...] = USUAL
    """Those of the list above."""
    variants: int = 0
    """How many variants of each problem with obstacles, in place of the problems."""
    seed: int = 0
    """Of the variants."""
    time_limit: float = 60.0
    """Of each plan, in s; for the Euler steps of all counts."""
    workers: int = 1
    """How many processes, each with one thread."""
    keep: Path | None = None
    """File of the rows so far: the same command goes on where it was stopped."""


def main(config: Config) -> Result:
    if config.quick:
        config = dataclasses.replace(config, only=config.only or QUICK, statements=("exact", "euler"))
    chosen = [case for case in CASES.values() if not config.only or any(part in case.name for part in config.only)]
    if config.variants:
        chosen = [one for case in chosen if len(case.boxes) for one in drawn(case, config.variants, config.seed)]
    asked = {name: getattr(config, name) for name in ("time_limit", "variants", "seed")}
    kept = Kept(config.keep, asked | {"statements": list(config.statements)})
    left = [case for case in chosen if case.name not in kept.rows]
    solved = _solved(config, left)
    for case in progress(left, "problems", delay=0):
        kept.row(case.name, lambda: next(solved))
    return opening(config) | {"rows": [kept.rows[case.name] for case in chosen]}


def _solved(config: Config, cases: Sequence[Case]) -> Iterator[Row]:
    one = partial(solve, statements=config.statements, time_limit=config.time_limit)
    if config.workers == 1:
        yield from map(one, cases)
        return
    with ProcessPoolExecutor(config.workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, cases)


def solve(case: Case, *, statements: Sequence[Statement] = USUAL, time_limit: float = 60.0) -> Row:
    """What became of a problem in these statements."""
    row: Row = {"name": case.name, "published": case.published}
    plan: ls.Solution | None = None
    for name, options in OPTIONS.items():
        if name in statements or (name == "clear" and "euler" in statements):
            problem = in_least_time(case, **options)
            began = time.process_time()
            found = ls.smooth(problem, time_limit=time_limit, threads=1)
            row[name] = _told(case, found, time.process_time() - began)
            plan = found if name == "clear" else plan
    if "euler" in statements:
        assert plan is not None
        row["euler"] = _fewest_steps(case, plan, time_limit)
    if "outside" in statements:
        began = time.process_time()
        by_hand = outside.found(case)
        seconds = time.process_time() - began
        row["outside"] = NOTHING | {"seconds": seconds} if by_hand is None else _told(case, by_hand, seconds)
    return row


def _told(case: Case, found: ls.Solution, seconds: float, *, euler: bool = False) -> Row:
    told = {"status": found.status.name, "time": None, "seconds": seconds, "detail": found.detail}
    if not found.success:
        return told
    plan = found.trajectory
    judged = check.by_euler(case, plan.states, plan.controls) if euler else check.exactly(case, plan.controls, plan.dt)
    return told | {"time": plan.horizon, "check": judged}


def _fewest_steps(case: Case, plan: ls.Solution, time_limit: float) -> Row:
    """The fewest Euler steps in which a plan was found, from one with a free duration; counts by bisection."""
    if not plan.success:
        return NOTHING
    began, limit = time.process_time(), time.monotonic() + time_limit
    steps = math.ceil(plan.trajectory.horizon / case.model.period - 1e-9)
    # `few` is the largest count that failed.
    stride, few, best, last = max(1, round(SPARED * steps)), 0, None, plan
    for tried in range(COUNTS):
        left = limit - time.monotonic()
        if left <= 0 or (best and best.trajectory.steps - few <= 1):
            break
        problem, start = by_euler_steps(case, plan.trajectory, steps)
        last = ls.smooth(problem, start=start, time_limit=left, threads=1)
        if last.success:
            best = last
        else:
            few = max(few, steps)
        if best is None:
            steps += stride * 2**tried
        elif few:
            steps = (best.trajectory.steps + few) // 2
        else:
            steps = max(1, steps - stride * 2**tried)
    return _told(case, best or last, time.process_time() - began, euler=True)


def passed(name: str, found: Row) -> Sequence[str] | None:
    """What the check has against a plan in that statement, nothing if it passes; None if there is no plan."""
    if "check" not in found:
        return None
    return check.failures(found["check"], check.ACCEPTED if name == "euler" else check.RIGHT)


def false(result: Result) -> list[str]:
    """The problems whose plan is CONVERGED, and is not right."""
    return [
        f"{row['name']} ({name})"
        for row in result["rows"] for name in ("exact", "euler")
        if name in row and passed(name, row[name])
    ]  # fmt: skip


def report(result: Result) -> str:
    rows = result["rows"]
    names = [name for name in get_args(Statement) if rows and name in rows[0]]
    lines = [
        [row["name"], _seconds(row["published"]), *(cell for name in names for cell in _cells(name, row))]
        for row in rows
    ]  # fmt: skip
    head = ["problem", "published (s)", *(cell for name in names for cell in (f"{name} (s)", "processor (s)", "check"))]
    return "\n\n".join([table(head, lines), *(_summary(name, rows) for name in names)])


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _cells(name: str, row: Row) -> list[str]:
    found = row[name]
    against = passed(name, found)
    took = f"{found['seconds']:.1f}"
    if against is None:
        return [found["status"], took, "-"]
    return [_seconds(found["time"]), took, "; ".join(against) or "passes"]


def _summary(name: str, rows: Sequence[Row]) -> str:
    found = [row[name] for row in rows]
    solved = [row for row in rows if "check" in row[name]]
    possible = [row for row in rows if "check" in row.get("outside", {})]
    # A plan in whole Euler steps may not be faster by a share of a step.
    ahead = sum(row["published"] is not None and row[name]["time"] <= row["published"] + 1e-9 for row in solved)
    right = sum(not passed(name, row[name]) for row in solved)
    seconds = [one["seconds"] for one in found]
    text = (
        f"{name}: CONVERGED {len(solved)} of {len(rows)}, {ahead} of them at or below the published, {right} pass the"
        f" check; processor {statistics.median(seconds):.2g} s in the median, {sum(seconds):.3g} s in all"
    )
    if possible and name != "outside":
        both = sum("check" in row[name] for row in possible)
        text += f"; CONVERGED in {both} of the {len(possible)} that the search from outside solves"
    return text


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=false)

"""Two threads against one."""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from peers import Unavailable

import lqrsim as ls
from lqrsim.machine import processors
from solver_benchmark.common import MANY, Config, judge, make_problems, median, take_turns


@dataclass(frozen=True)
class Run:
    """All queries once: seconds, and how many processors this process and all others had on average meanwhile."""

    seconds: float
    own: float
    others: float
    costs: list[float]


def measure(config: Config) -> dict[str, Any]:
    """All queries on one thread and on two."""
    if processors() < 2:
        raise Unavailable("this process may run on one processor only")
    problems = make_problems(config)
    found: dict[str, Any] = {}
    for solver, many in MANY.items():
        many(problems[:1], threads=1, max_iterations=1)  # compile
        contestants = {f"{count}": partial(_run, many, count) for count in (1, 2)}
        turns = take_turns(contestants, [problems], config.rounds, f"threads, {solver}")
        one, two = turns["1"][0], turns["2"][0]
        found[solver] = {
            "seconds": [median(run.seconds for run in taken) for taken in (one, two)],
            "speedup": median(a.seconds / b.seconds for a, b in zip(one, two, strict=True)),
            "processors": median(run.own for run in two),
            "processors_of_others": median(run.others for run in two),
            "same_costs": all(run.costs == one[0].costs for run in one + two),
        }
    return found


def _run(many: Callable[..., list[ls.Solution]], count: int, problems: list[ls.Problem]) -> Run:
    clock, own, everyone = time.perf_counter(), time.process_time(), _processor_seconds()
    solutions = many(problems, threads=count, stop="cost")
    seconds = time.perf_counter() - clock
    own, everyone = (time.process_time() - own) / seconds, (_processor_seconds() - everyone) / seconds
    return Run(seconds, own, everyone - own, [solution.cost for solution in solutions])


def _processor_seconds() -> float:
    """Seconds that all processes of the machine have had of its processors; NaN where it does not tell."""
    try:
        user, nice, system, _, _, *rest = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:])
    except OSError:
        return math.nan
    return (user + nice + system + sum(rest[:3])) / os.sysconf("SC_CLK_TCK")


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"threads: {'one, s':>12} {'two, s':>8} {'speed-up':>9} {'processors had':>15} {'by others':>10}"]
    for solver, one in found.items():
        busy = one["processors_of_others"] > (os.cpu_count() or 2) - 2 + 0.2  # too few are left for two threads
        verdict = "not judged: the machine is busy" if busy else judge(one["speedup"], "two threads", at_least=True)
        rows.append(
            f"  {solver:<8} {one['seconds'][0]:>10.3f} {one['seconds'][1]:>8.3f} {one['speedup']:>9.2f}"
            f" {one['processors']:>15.2f} {one['processors_of_others']:>10.2f}  {verdict}"
        )
        if not one["same_costs"]:
            rows.append(f"  {solver:<8} COSTS DIFFER between one thread and two")
    return ["\n".join(rows)]

"""What the safeguard costs where it is not needed: the same iterations, the same bits, no time."""

import statistics
import time
from typing import Any

import numpy as np
from runner import progress

import lqrsim as ls
from reliability.common import Config, paper_start, queries


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for start in ("soft", "fixed"):
        problems = queries(config, soft=start == "soft")
        ratios, iterations, same, needed = [], [], [], []
        ls.smooth_many(problems[:1], threads=1, start=paper_start())  # compile
        for problem in progress(problems, f"overhead, {start}"):
            seconds: dict[bool, list[float]] = {False: [], True: []}
            solutions: dict[bool, ls.Solution] = {}
            order = [False, True]
            for _ in range(config.rounds):
                for safeguard in order:
                    clock = time.perf_counter()
                    options: dict[str, Any] = {
                        "threads": 1,
                        "safeguard": safeguard,
                        "start": paper_start(),
                        "finish": None,
                    }
                    (solutions[safeguard],) = ls.smooth_many([problem], **options)
                    seconds[safeguard].append(time.perf_counter() - clock)
                order.reverse()
            bare, guarded = solutions[False], solutions[True]
            iterations.append((len(bare.iterations), len(guarded.iterations)))
            same.append(same_bits(bare, guarded))
            needed.append(not bare.success)
            ratios.append(min(seconds[True]) / min(seconds[False]))
        found[start] = {"iterations": iterations, "same_bits": same, "needed": needed, "time_ratio": ratios}
    return found


def same_bits(one: ls.Solution, other: ls.Solution) -> bool:
    pairs = [
        (one.policy.gain, other.policy.gain),
        (one.policy.offset, other.policy.offset),
        (one.trajectory.states, other.trajectory.states),
        (one.trajectory.controls, other.trajectory.controls),
    ]
    return one.status is other.status and all(np.array_equal(a, b) for a, b in pairs)


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"overhead: {'start':<6} {'queries':>8} {'same iterations':>16} {'same bits':>10} {'time, median':>13}"]
    for start, one in found.items():
        calm = [i for i, needed in enumerate(one["needed"]) if not needed]
        same = sum(bare == guarded for bare, guarded in (one["iterations"][i] for i in calm))
        bits = sum(one["same_bits"][i] for i in calm)
        ratio = statistics.median([one["time_ratio"][i] for i in calm]) if calm else float("nan")
        verdict = "met" if same == bits == len(calm) else "MISSED"
        rows.append(
            f"  {start:<14} {len(calm):>8} {same:>16} {bits:>10} {ratio:>12.3f}x  {verdict}: want all the same"
            + (f"; {sum(one['needed'])} more needed it" if any(one["needed"]) else "")
        )
    return ["\n".join(rows)]

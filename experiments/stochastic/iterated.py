"""The smoother against iLQR, both under the same noise, which makes the latter iLQG."""

from dataclasses import replace
from typing import Any

import numpy as np
from paper.common import fixed
from runner import table

import lqrsim as ls
from stochastic.common import Config, quadrotor, rotors
from stochastic.planning import SHARE


def measure(config: Config) -> dict[str, Any]:
    problems = [
        replace(fixed(quadrotor(query)), noise=rotors(SHARE), control_limits=None) for query in range(config.iterated)
    ]
    smoother, single = ls.smooth_many(problems), ls.smooth_many(problems, starts=1)
    ilqg = ls.ilqr_many(problems)

    def of(solutions: list[ls.Solution]) -> dict[str, Any]:
        return {
            "costs": [one.cost for one in solutions], "converged": sum(one.success for one in solutions),
            "iterations": float(np.median([len(one.iterations) for one in solutions])),
        }  # fmt: skip

    return {"smoother": of(smoother), "one start": of(single), "iLQG": of(ilqg), "share": SHARE}


def report(found: dict[str, Any]) -> list[str]:
    least = np.array(found["iLQG"]["costs"])
    rows = [
        [name, len(least), one["converged"], f"{np.mean(one['costs']):.2f}", f"{one['iterations']:g}",
         int((np.array(one["costs"]) <= least * (1 + 1e-6)).sum())]
        for name, one in found.items() if name != "share"
    ]  # fmt: skip
    head = ("", "queries", "converged", "expected cost, mean", "iterations, median", "not worse than iLQG")
    return [
        f"From exactly the given start, rotors off by {100 * found['share']:g} % of their force. Costs are those that"
        " are expected.",
        table(head, rows),
    ]

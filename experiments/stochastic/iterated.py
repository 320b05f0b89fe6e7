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
            "mean": float(np.mean([one.cost for one in solutions])), "converged": sum(one.success for one in solutions),
            "iterations": float(np.median([len(one.iterations) for one in solutions])),
            "no worse": sum(one.cost <= other.cost * (1 + 1e-6) for one, other in zip(solutions, ilqg, strict=True)),
        }  # fmt: skip

    solved = {"smoother": of(smoother), "one start": of(single), "iLQG": of(ilqg)}
    return {"queries": len(problems), "share": SHARE, "solved": solved}


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        [name, one["converged"], f"{one['mean']:.2f}", f"{one['iterations']:g}", one["no worse"]]
        for name, one in found["solved"].items()
    ]
    return [
        f"{found['queries']} queries from exactly the given start, rotors off by {100 * found['share']:g} % of their"
        " force. Iterations of the smoother are those of the start whose plan it returns.",
        table(("", "converged", "expected cost, mean", "iterations, median", "not worse than iLQG"), rows),
    ]

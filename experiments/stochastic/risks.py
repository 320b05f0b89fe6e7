"""What a growing risk makes of what runs cost."""

from typing import Any

import numpy as np
from runner import table

import lqrsim as ls
from stochastic.common import Config, clearance, drive, gusts, jolts, quadrotor

KINDS = {"drive, displaced by 0.008 m": (drive, jolts(0.008)), "quadrotor, gusts of 0.04 m/s": (quadrotor, gusts(0.04))}
SHARES = (-1.0, 0.0, 0.25, 0.5, 0.75)  # of the largest risk


def measure(config: Config) -> dict[str, Any]:
    found = {}
    for kind, (stated, noise) in KINDS.items():
        problem = stated().driven_by(noise, None)
        most, rows = ls.largest_risk(problem, ls.smooth(problem)), []
        for share in SHARES[1::2] if config.quick else SHARES:
            risky = problem.driven_by(None, share * most)
            solution = ls.smooth(risky)
            costs = ls.sample_costs(risky, solution, trials=config.trials, seed=config.seed)
            rows.append({
                "share": share, "mean": float(costs.mean()), "spread": float(costs.std(ddof=1)),
                "tail": float(np.quantile(costs, 0.99)), "clearance": clearance(solution),
            })  # fmt: skip
        found[kind] = {"rows": rows}
    return {"kinds": found, "trials": config.trials}


def report(found: dict[str, Any]) -> list[str]:
    lines = [f"{found['trials']} trials each, the same noise for all; risk relative to the largest."]
    for kind, one in found["kinds"].items():
        rows = [
            [f"{row['share']:g}", f"{row['mean']:.2f}", f"{row['spread']:.2f}", f"{row['tail']:.1f}",
             f"{row['clearance']:.3f}"]
            for row in one["rows"]
        ]  # fmt: skip
        lines += [
            f"{kind[0].upper()}{kind[1:]}:",
            table(("risk", "mean cost", "standard deviation", "99 % cost less than", "clearance, m"), rows),
        ]
    return lines

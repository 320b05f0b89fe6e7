"""What a plan is expected to cost against what its runs cost in the mean."""

from typing import Any

from runner import table

import lqrsim as ls
from stochastic.common import Config, drive, gusts, jolts, quadrotor, rotors, slip

# The last of each is so strong that costs are no longer quadratic where runs get to.
KINDS = {
    "drive, wheels off by a share of their speed": (drive, slip, (0.1, 0.3, 1.0)),
    "drive, displaced by so many m": (drive, jolts, (0.004, 0.016, 0.032)),
    "quadrotor, rotors off by a share of their force": (quadrotor, rotors, (0.05, 0.2, 0.5)),
    "quadrotor, gusts of so many m/s": (quadrotor, gusts, (0.02, 0.04, 0.08)),
}


def measure(config: Config) -> dict[str, Any]:
    rows = []
    for kind, (stated, noise, strengths) in KINDS.items():
        for place, strength in enumerate(strengths[:1] if config.quick else strengths):
            problem = stated().driven_by(noise(strength), None)
            solution = ls.smooth(problem)
            costs = ls.sample_costs(problem, solution, trials=config.trials, seed=config.seed)
            rows.append({
                "kind": kind, "strength": strength, "small": place == 0, "expected": solution.cost,
                "ratio": solution.cost / float(costs.mean()),
            })  # fmt: skip
    return {"rows": rows, "trials": config.trials}


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        [f"{row['kind']}: {row['strength']:g}", f"{row['expected']:.2f}", f"{100 * (row['ratio'] - 1):+.2f}"]
        for row in found["rows"]
    ]
    small = max(abs(row["ratio"] - 1) for row in found["rows"] if row["small"])
    return [
        f"{found['trials']} trials of each plan. Weak noise, the first of each kind, costs what was expected to"
        f" {100 * small:.2f} % at worst; noise that takes runs to where the quadratic model about the plan no longer"
        " holds costs more.",
        table(("noise in each control period", "expected cost", "expected against mean, %"), rows),
    ]

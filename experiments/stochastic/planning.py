"""Plans that know of the noise against plans that do not, on the same trials."""

from typing import Any

import numpy as np
from runner import improbable, table

import lqrsim as ls
from stochastic.common import PLACE, Config, drive, on_oil, paired, quadrotor, rotors

SHARE = 0.2  # by which a rotor's force is off
SURE = 0.01


def measure(config: Config) -> dict[str, Any]:
    problems = [quadrotor(query) for query in range(config.queries)]
    noisy = [problem.driven_by(rotors(SHARE), None) for problem in problems]
    aware, plain = ls.smooth_many(noisy), ls.smooth_many(problems)
    rows = [paired(*each, config) for each in zip(noisy, aware, plain, strict=True)]
    return {"share": SHARE, "rows": rows, "oil": oil(config), "trials": config.trials}


def oil(config: Config) -> list[dict[str, float]]:
    """The drive, whose way leads over oil: how far from it the plan keeps."""
    rows, plain = [], ls.smooth(drive())
    for more in (10.0,) if config.quick else (3.0, 10.0, 30.0, 100.0):
        problem = drive().driven_by(on_oil(0.1, more), None)
        aware = ls.smooth(problem)
        off = [np.linalg.norm(one.trajectory.states[:, :2] - PLACE, axis=1).min() for one in (aware, plain)]
        rows.append(paired(problem, aware, plain, config) | {
            "more": more, "expected": aware.cost, "away": float(off[0]), "away_other": float(off[1])
        })  # fmt: skip
    return rows


def report(found: dict[str, Any]) -> list[str]:
    rows = found["rows"]
    sure = sum(row["chance"] < SURE for row in rows)
    gain = [100 * (row["other"] / row["mean"] - 1) for row in rows]
    oil = [
        [
            f"{row['more']:g}",
            f"{row['away']:.2f}",
            f"{row['mean']:.2f}",
            f"{row['other']:.4g}",
            improbable(row["chance"], ".0e"),
        ]
        for row in found["oil"]
    ]
    head = ("slips so many times more", "keeps away, m", "mean cost", "of the plan without noise", "p")
    return [
        f"Rotors that are off by {100 * found['share']:g} % of their force, {len(rows)} queries, {found['trials']}"
        f" trials: the plan that knows of it costs surely less (paired, one-sided, p < {SURE:g}) in {sure}, by"
        f" {np.median(gain):.3f} % in the median and {max(gain):.3f} % at most: to hover, a drone needs its rotors.",
        "The drive, on whose way there is oil, on which its wheels slip more; the plan without noise keeps"
        f" {found['oil'][0]['away_other']:.2f} m away:",
        table(head, oil),
    ]

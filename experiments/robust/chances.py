"""The predicted chance of collision against what splitting measures, for safe plans asked for 1e-1 to 1e-4."""

from typing import Any

import numpy as np
from paper.common import interval, table

import lqrsim as ls
from robust.common import Config, progress, reach_exactly

# In turns. In this order: few plans collide as often as 1e-1 without any clearance, and are not safer than asked.
ASKED = (1e-2, 1e-3, 1e-4, 1e-1)


def measure(config: Config) -> dict[str, Any]:
    rows = []
    for query in progress(range(config.plans), "predicted chances"):
        scenario = ls.scenarios.quadrotor(query)
        plant, asked = scenario.plant(), ASKED[query % len(ASKED)]
        disturbances = ls.preset("light", plant)
        stated = ls.uncertainty_of(plant, disturbances)
        safe = ls.smooth_chance_constrained(reach_exactly(scenario.problem), stated, chance=asked)
        score = ls.TrialScore(plant, safe.solution, disturbances, controller=safe.controller)
        row: dict[str, Any] = {"query": query, "asked": asked, "predicted": safe.tube.collision_chance}
        try:
            found = ls.split(score, score.size, particles=config.particles, repetitions=6, moves=3, seed=config.seed)
            row |= {"measured": interval(found.probability), "simulations": found.simulations}
        except ls.NoFailure:
            row |= {"measured": None, "simulations": score.simulations}
        rows.append(row)
    return {"rows": rows}


def report(found: dict[str, Any]) -> list[str]:
    rows = []
    for row in found["rows"]:
        value, low, high = row["measured"] or (np.nan,) * 3
        ratio = row["predicted"] / value if row["measured"] else np.nan
        rows.append([
            row["query"], f"{row['asked']:g}", f"{row['predicted']:.2g}", f"{value:.2g}", f"{low:.1g} to {high:.1g}",
            f"{ratio:.2g}", row["simulations"],
        ])  # fmt: skip
    head = ("query", "asked", "predicted", "measured by splitting", "95 %", "predicted / measured", "simulations")
    return ["Preset 'light', OffsetFree on safe plans.", table(head, rows)]

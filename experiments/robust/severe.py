"""What keeps the quadrotor from its goal under severe disturbances: the plan, the lag, the thrust or the sensors."""

from typing import Any

import numpy as np
from runner import between, progress, table

import lqrsim as ls
from lqrsim.control.chance_constrained import chances_instead
from robust.common import ASKED, Config, reached, safe_plan, share


def measure(config: Config) -> dict[str, Any]:
    rows, arrived = [], []
    for query in progress(range(config.plans), "severe"):
        plant = ls.scenarios.quadrotor(query).plant()
        disturbances = ls.disturbances.preset("severe", plant)
        told = ls.uncertainty_of(plant, disturbances)
        safe = safe_plan(query, "severe", ASKED["severe"])
        ended = reached(
            plant, safe.solution, safe.controller, disturbances, trials=config.world_trials, seed=config.seed
        )
        arrived.append(ended)
        rows.append({
            "query": query, "weight": safe.weight, "reached": share(ended),
            "chances": {"plan of smooth": safe.rounds[0][3], "safe plan": safe.tube.collision_chance}
            | chances_instead(safe, told),
        })  # fmt: skip
    return {"rows": rows, "reached": share(np.concatenate(arrived)), "trials": config.world_trials}


def report(found: dict[str, Any]) -> list[str]:
    rows = found["rows"]
    kinds = list(rows[0]["chances"])
    each = [
        [row["query"], f"{row['weight']:g}", between(row["reached"], ".1f")]
        + [f"{100 * row['chances'][kind]:.1f}" for kind in kinds]
        for row in rows
    ]
    means = ["mean", "", between(found["reached"], ".1f")]
    means += [f"{100 * np.mean([row['chances'][kind] for row in rows]):.1f}" for kind in kinds]
    return [
        f"Preset 'severe', {found['trials']} trials of each query reach the goal as often as that; and the predicted"
        " chance of collision (%), of the plan of smooth, of the safe one, and on the latter with something better and"
        " a law made for that. The weight is by how much the safe plan multiplies that of the obstacles.",
        table(("query", "weight", "reached (%)", *kinds), [*each, means]),
    ]

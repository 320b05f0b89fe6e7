"""The predicted chance of collision against what is measured: by splitting at 'light', by counting at 'moderate'."""

from typing import Any

import numpy as np
from runner import interval, progress, table

import lqrsim as ls
from lqrsim.stress.statistics import rate
from robust import common
from robust.common import Config, run, safe_plan

# In turns. In this order: few plans collide as often as 1e-1 without any clearance, and are not safer than asked.
ASKED = (1e-2, 1e-3, 1e-4, 1e-1)


def measure(config: Config) -> dict[str, Any]:
    queries = progress(range(config.plans), "predicted chances")
    rows = [{"light": of_light(config, query), "moderate": of_moderate(config, query)} for query in queries]
    return {"rows": rows}


def planned(
    query: int, preset: str, asked: float
) -> tuple[ls.Plant, list[ls.disturbances.Disturbance], ls.types.SafePlan]:
    plant = ls.scenarios.quadrotor(query).plant()
    return plant, ls.disturbances.preset(preset, plant), safe_plan(query, preset, asked)


def of_light(config: Config, query: int) -> dict[str, Any]:
    asked = ASKED[query % len(ASKED)]
    plant, disturbances, safe = planned(query, "light", asked)
    score = ls.stress.TrialScore(plant, safe.solution, disturbances, controller=safe.controller)
    row: dict[str, Any] = {"query": query, "asked": asked, "predicted": safe.tube.collision_chance}
    try:
        options: dict[str, Any] = {"particles": config.particles, "repetitions": 6, "moves": 3, "seed": config.seed}
        found = ls.stress.failure_probability(score, score.size, **options)
        return row | {"measured": interval(found.probability), "simulations": found.simulations}
    except ls.stress.NoFailure:
        return row | {"measured": None, "simulations": score.simulations}


def of_moderate(config: Config, query: int) -> dict[str, Any]:
    asked = common.ASKED["moderate"]
    plant, disturbances, safe = planned(query, "moderate", asked)
    trials = config.world_trials
    rollout = run(plant, safe.solution, safe.controller, disturbances, trials=trials, seed=config.seed)
    measured = interval(rate(int(np.isfinite(rollout.collided_at).sum()), trials))
    return {
        "query": query, "asked": asked, "predicted": safe.tube.collision_chance, "measured": measured,
        "simulations": trials,
    }  # fmt: skip


def report(found: dict[str, Any]) -> list[str]:
    head = ("query", "asked", "predicted", "measured", "95 %", "predicted / measured", "simulations")
    return [
        "Preset 'light', OffsetFree on safe plans; measured by splitting.",
        table(head, [cells(row["light"]) for row in found["rows"]]),
        "Preset 'moderate', the same by counting. There controls are at their limits for much of the time, which the"
        " linear model does not have: runs collide more often than predicted.",
        table(head, [cells(row["moderate"]) for row in found["rows"]]),
    ]


def cells(row: dict[str, Any]) -> list[Any]:
    value, low, high = row["measured"] or (np.nan,) * 3
    ratio = row["predicted"] / value if value > 0 else np.nan
    return [
        row["query"], f"{row['asked']:g}", f"{row['predicted']:.2g}", f"{value:.2g}", f"{low:.1g} to {high:.1g}",
        f"{ratio:.2g}", row["simulations"],
    ]  # fmt: skip

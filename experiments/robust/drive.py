"""The differential drive under all disturbances at once: no worse anywhere, and better where they are strong."""

from typing import Any

from runner import progress, table

import lqrsim as ls
from lqrsim.stress.statistics import compare
from robust.common import Config, reach_exactly, reached, share

STRENGTHS = (1.0, 2.0, 3.0, 6.0)
ASKED = 1e-3


def measure(config: Config) -> dict[str, Any]:
    scenario = ls.scenarios.differential_drive()
    plant, plan = scenario.plant(), ls.smooth(scenario.problem)
    rows, trials = [], 3 * config.trials
    for strength in progress(STRENGTHS[:1] if config.quick else STRENGTHS, "differential drive"):
        disturbances = [one.scaled(strength) for one in ls.disturbances.preset("light", plant)]
        stated = ls.uncertainty_of(plant, disturbances)
        safe = ls.smooth_chance_constrained(reach_exactly(scenario.problem), stated, chance=ASKED)
        flown = {
            "smoother": (plan, None),
            "track": (plan, ls.track(scenario.problem, plan, uncertainty=stated)),
            "offset free": (plan, ls.OffsetFree(scenario.problem, plan, stated)),
            "offset free, safe plan": (safe.solution, safe.controller),
        }
        ended = {
            name: reached(plant, solution, law, disturbances, trials=trials, seed=config.seed)
            for name, (solution, law) in flown.items()
        }
        against = compare(ended["offset free, safe plan"], ended["smoother"])
        rows.append({
            "strength": strength, "reached": {name: share(one) for name, one in ended.items()},
            "cost": [plan.cost, safe.cost], "p_value": against.p_value,
        })  # fmt: skip
    return {"rows": rows, "trials": trials}


def report(found: dict[str, Any]) -> list[str]:
    names = list(found["rows"][0]["reached"])
    rows = [
        [f"{row['strength']:g}", *(f"{row['reached'][name][0]:.1f}" for name in names), f"{row['p_value']:.1g}"]
        for row in found["rows"]
    ]
    more = ", ".join(f"{100 * (safe / plan - 1):+.1f} %" for plan, safe in (row["cost"] for row in found["rows"]))
    return [
        f"{found['trials']} trials a line, reached (%); the safe plans cost {more}; p is McNemar's, of the last"
        " against the first.",
        table(("strength", *names, "p"), rows),
    ]

"""How strong a disturbance alone must be for half of the trials to fail: the smoother's policy, and OffsetFree.

OffsetFree is told of the disturbance, at the strength that it has: how large the noise is, how late a measurement, how
slow the motors. It flies the default plan, as the smoother's policy does, and the safe plan of the preset 'moderate'.
"""

from typing import Any

import numpy as np
from paper.stress_figures import NAMES
from runner import interval, progress, table
from stress_test import GRID, half_fail, in_words, possible

import lqrsim as ls
from lqrsim.disturbances import CommandDropouts, ControlDelay, MeasurementLatency
from lqrsim.stress.statistics import rate
from robust.common import ASKED, Config, reached, safe_plan

OWN, DEFAULT, SAFE = "smoother's policy", "offset free, default plan", "offset free, safe plan"
LATE = (ControlDelay(1), MeasurementLatency(1))
LOST = [*(one for one in GRID if one < 64), 64.0, 68.0, 72.0, 76.0, 80.0, 84.0, 88.0, 92.0]  # it ends at 100


def measure(config: Config) -> dict[str, Any]:
    return {"quadrotor": of_quadrotor(config)}  # of the drive nothing is left to be gained: `drive.py` has all at once


def of_quadrotor(config: Config) -> dict[str, Any]:
    scenario = ls.scenarios.quadrotor()
    plant, plan = scenario.plant(), ls.smooth(scenario.problem)
    safe = safe_plan(0, "moderate", ASKED["moderate"])
    flown = {OWN: (scenario.problem, plan), DEFAULT: (scenario.problem, plan), SAFE: (safe.problem, safe.solution)}
    rows = []
    grid = GRID[6::12] if config.quick else GRID
    kinds = [*ls.disturbances.preset("light", plant), *LATE]
    kinds = kinds[-1:] if config.quick else kinds
    for one in progress(kinds, f"{NAMES[scenario.name]}, one disturbance alone"):
        tried = LOST if isinstance(one, CommandDropouts) and not config.quick else grid
        strengths = [strength for strength in possible(one, tried) if strength >= 1 or one not in LATE]
        points: dict[str, list[tuple[float, list[float]]]] = {policy: [] for policy in flown}
        for policy, found in points.items():
            problem, solution = flown[policy]
            for strength in strengths:
                disturbances = [one.scaled(strength)]
                law = None
                if policy != OWN:
                    law = ls.OffsetFree(problem, solution, ls.uncertainty_of(plant, disturbances))
                ended = reached(plant, solution, law, disturbances, trials=config.alone, seed=config.seed)
                found.append((strength, interval(rate(int(ended.sum()), len(ended)))))
                if found[-1][1][2] < 0.5:
                    break  # surely more than half fail, and stronger is no better
        half = {policy: half_fail(found) for policy, found in points.items()}
        last = {policy: found[-1][0] for policy, found in points.items()}
        rows.append({"kind": in_words(one), "half": half, "last": last})
    return {"rows": rows, "trials": config.alone}


def report(found: dict[str, Any]) -> list[str]:
    lines = []
    for name, robot in found.items():
        rows = [
            [row["kind"], *(told(row, policy) for policy in row["half"]), ratio(row)]
            for row in sorted(robot["rows"], key=lambda row: row["half"][OWN]["value"] or np.inf)
        ]
        head = ("half fail at strength", OWN, DEFAULT, SAFE, "last against first")
        lines += [
            f"{NAMES[name].capitalize()}, {robot['trials']} trials a strength, as under"
            " [What breaks first](#what-breaks-first).",
            table(head, rows),
        ]
    return lines


def told(row: dict[str, Any], policy: str) -> str:
    half, last = row["half"][policy], row["last"][policy]
    if half["value"] is None:
        return f"over {half['above']:.3g}" if half["above"] else f"about {last:.3g}"
    low, high = (f"{half[side]:.3g}" if half[side] else "" for side in ("above", "below"))
    return f"{half['value']:.3g} ({low or 'less'} to {high or 'more'})"


def ratio(row: dict[str, Any]) -> str:
    before, after = row["half"][OWN]["value"], row["half"][SAFE]["value"]
    if before is None:
        return "-"
    return f"{after / before:.2g}" if after else f"over {row['last'][SAFE] / before:.2g}"

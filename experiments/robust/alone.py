"""How strong a disturbance alone must be for half of the trials to fail: the smoother's policy, and OffsetFree.

OffsetFree is told of the disturbance, at the strength that it has: how large the noise is, how late a measurement, how
slow the motors. It flies the safe plan of the preset 'moderate'.
"""

from typing import Any

import numpy as np
from paper.common import interval, table
from paper.stress_figures import NAMES
from stress_test import GRID, half_fail, in_words, possible

import lqrsim as ls
from lqrsim.stress.statistics import rate
from robust.common import ASKED, Config, progress, reach_exactly, reached

LATE = (ls.ControlDelay(1), ls.MeasurementLatency(1))


def measure(config: Config) -> dict[str, Any]:
    names = [*NAMES][-1:]  # of the drive nothing is left to be gained: `drive.py` has all at once
    return {name: of_robot(config, ls.scenarios.get(name)) for name in names}


def of_robot(config: Config, scenario: ls.Scenario) -> dict[str, Any]:
    plant, plan = scenario.plant(), ls.smooth(scenario.problem)
    problem, solution = scenario.problem, plan
    if scenario.name == "quadrotor":
        stated = ls.uncertainty_of(plant, ls.preset("moderate", plant))
        safe = ls.smooth_chance_constrained(reach_exactly(problem), stated, chance=ASKED["moderate"])
        problem, solution = safe.problem, safe.solution
    rows = []
    grid = GRID[::6] if config.quick else GRID
    kinds = [*ls.preset("light", plant), *LATE]
    kinds = kinds[-1:] if config.quick else kinds
    for one in progress(kinds, f"{NAMES[scenario.name]}, one disturbance alone"):
        strengths = [strength for strength in possible(one, grid) if strength >= 1 or one not in LATE]
        points: dict[str, list[tuple[float, list[float]]]] = {"smooth": [], "offset_free": []}
        for policy, found in points.items():
            for strength in strengths:
                disturbances = [one.scaled(strength)]
                if policy == "smooth":
                    ended = reached(plant, plan, None, disturbances, trials=config.alone, seed=config.seed)
                else:
                    law = ls.OffsetFree(problem, solution, ls.uncertainty_of(plant, disturbances))
                    ended = reached(plant, solution, law, disturbances, trials=config.alone, seed=config.seed)
                found.append((strength, interval(rate(int(ended.sum()), len(ended)))))
                if found[-1][1][2] < 0.5:
                    break  # surely more than half fail, and stronger is no better
        half = {policy: half_fail(found) for policy, found in points.items()}
        rows.append({"kind": in_words(one), "half": half, "light": one.describe(plant), "points": points})
    return {"rows": rows, "trials": config.alone}


def report(found: dict[str, Any]) -> list[str]:
    lines = []
    for name, robot in found.items():
        rows = [
            [row["kind"], told(row, "smooth"), told(row, "offset_free"), ratio(row)]
            for row in sorted(robot["rows"], key=lambda row: row["half"]["smooth"]["value"] or np.inf)
        ]
        head = ("half fail at", "smoother's policy", "offset free", "ratio")
        lines += [f"{NAMES[name].capitalize()}, {robot['trials']} trials a strength.", table(head, rows)]
    return lines


def told(row: dict[str, Any], policy: str) -> str:
    value = row["half"][policy]["value"]
    return f"over {row['points'][policy][-1][0]:.3g}" if value is None else f"{value:.2g}"


def ratio(row: dict[str, Any]) -> str:
    before, after = row["half"]["smooth"]["value"], row["half"]["offset_free"]["value"]
    if before is None:
        return "-"
    return f"{after / before:.1f}" if after else f"over {row['points']['offset_free'][-1][0] / before:.1f}"

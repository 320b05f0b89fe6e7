"""How often the policies fail: campaigns of thousands of trials under all disturbances of the presets, and each alone.

    python experiments/stress_test.py            # 300 trials of each policy and strength
    python experiments/stress_test.py --quick    # 3

Strengths are multiples of the preset 'light'. All policies meet the same trials; the plan is that of `smooth`, or that
of `ilqr`. What breaks first is found by one kind of disturbance at a time, made stronger until half of the trials fail.
"""

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from paper.common import picture
from paper.stress_figures import NAMES, WORDS, draw_alone, draw_together
from runner import FolderSettings, Result, between, counting, interval, opening, run, table

import lqrsim as ls
from lqrsim.disturbances import Disturbance
from lqrsim.simulation.disturbances import PRESETS
from lqrsim.stress import analysis

FAILURES = {"collided": "collided", "timed out": "timed out", "diverged": "lost", "error": "error"}
# Of all disturbances together: those of the presets, and beyond, where they can be so strong.
STRENGTHS = (0.125, 0.25, *PRESETS.values(), 6.0)
GRID = (2.0 ** (np.arange(-4, 15) / 2)).tolist()  # of one kind alone


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    trials: int = 300
    """Of each robot, strength and policy, under all disturbances together."""
    alone: int = 100
    """Of each kind of disturbance and strength, where there is one kind alone."""
    seed: int = 0
    """Of the disturbances."""
    folder: Path | None = None
    """Keeps the campaigns, which go on where they were stopped; by default they are kept nowhere."""
    workers: int | None = None
    """Processes; by default one a processor."""


def main(config: Config) -> Result:
    result = opening(config) | {"robots": {}}
    with tempfile.TemporaryDirectory() as temporary:
        for name in NAMES:
            scenario, folder = ls.scenarios.get(name), (config.folder or Path(temporary)) / name
            result["robots"][name] = together(config, scenario, folder) | alone(config, scenario, folder)
    draw_together(config, result)
    draw_alone(config, result)
    return result


def finished(config: Config, asked: ls.stress.Campaign, folder: Path) -> ls.stress.Results:
    """Run the campaign to its end; its results."""
    with counting(f"{NAMES[asked.scenario]}, {folder.name}") as told:
        workers = 0 if config.quick else config.workers
        return ls.stress.run_campaign(asked, folder, workers=workers, progress=told)


def together(config: Config, scenario: ls.Scenario, folder: Path) -> dict[str, Any]:
    """All disturbances of the presets at once, from the weakest preset up: each policy, and all against the first."""
    light = ls.disturbances.preset("light", scenario.plant())
    strengths = [strength for strength in STRENGTHS if all(possible(one, [strength]) for one in light)]
    asked = ls.stress.Campaign(
        scenario=scenario.name, sweeps={"light": tuple(light)}, seed=config.seed, shard=100,
        strengths=(0.25, 1.0) if config.quick else tuple(strengths),
        trials=min(config.trials, 3) if config.quick else config.trials,
        replan_every=scenario.problem.steps * scenario.problem.dt / 10,
    )  # fmt: skip
    results = finished(config, asked, folder / "together")
    outcomes = {cell: results.outcomes(cell) for cell in results.cells}
    against = {one.second: one for one in analysis.comparisons(outcomes)}
    cells = []
    for cell, ended in outcomes.items():
        found = analysis.success(cell, ended)
        cells.append({
            "policy": cell.policy, "strength": cell.strength, "reached": found.reached, "trials": found.trials,
            "exact": interval(found.exact), "band": interval(found.band),
            "modes": [[*mode, count] for mode, count in analysis.modes(ended).items()],
        })  # fmt: skip
        if cell in against:
            one = against[cell]
            cells[-1]["against"] = {
                "only_smooth": one.only_first, "only_this": one.only_second, "p_value": one.adjusted,
            }  # fmt: skip
    plans = {policy: plan_of(results.solution(policy)) for policy in ("smooth", "ilqr")}
    words = [one.describe(scenario.plant()) for one in light]
    told = {"disturbances": words, "plans": plans, "replan_every": asked.replan_every, "trials": asked.trials}
    return told | {"together": cells}


def plan_of(solution: ls.Solution) -> dict[str, float]:
    assert solution.clearance is not None
    return {"cost": solution.cost, "clearance": float(solution.clearance.min())}


def alone(config: Config, scenario: ls.Scenario, folder: Path) -> dict[str, Any]:
    """Each kind of disturbance by itself at growing strength, and the strength at which half of the trials fail.

    First at every fourth strength of a grid, then at those of the grid around where success falls through one half.
    """
    stride = len(GRID) if config.quick else 4
    trials = min(config.alone, 3) if config.quick else config.alone
    plant = scenario.plant()
    kinds = {in_words(one): one for one in ls.disturbances.preset("light", plant)}
    grids = {name: possible(one, GRID) for name, one in kinds.items()}
    found: dict[str, dict[float, ls.stress.Outcomes]] = {name: {} for name in kinds}
    asked = {name: {*grid[::stride], grid[-1]} for name, grid in grids.items()}
    for part in ("alone, coarse",) if config.quick else ("alone, coarse", "alone, fine"):
        cells = {(name, strength): f"{name} {strength:.3g}" for name in kinds for strength in sorted(asked[name])}
        sweeps = {cell: (kinds[name].scaled(strength),) for (name, strength), cell in cells.items()}
        results = finished(
            config,
            ls.stress.Campaign(
                scenario=scenario.name, sweeps=sweeps, strengths=(1.0,), policies=("smooth",), trials=trials,
                seed=config.seed, shard=50,
            ),
            folder / part,
        )  # fmt: skip
        for (name, strength), cell in cells.items():
            found[name][strength] = results.outcomes(ls.stress.Cell("smooth", cell, 1.0))
        for name, grid in grids.items():
            half = half_fail(success(found[name]))
            low, high = half["above"] or 0.0, half["below"] or np.inf
            asked[name] = {strength for strength in grid if low < strength < high} - set(found[name])
    rows = [told(name, one, plant, found[name]) for name, one in kinds.items()]
    # What never fails half of the time comes last, what fails more often before what fails less.
    rows.sort(key=lambda row: (row["half"]["value"] or np.inf, row["success"][-1][0]))
    return {"alone": rows, "trials_alone": trials}


def told(name: str, one: Disturbance, plant: ls.Plant, found: dict[float, ls.stress.Outcomes]) -> dict[str, Any]:
    """The result of one kind of disturbance, in words."""
    points = success(found)
    strengths, half = [strength for strength, _ in points], half_fail(points)
    # Half of the trials fail between two strengths that were tried; how they fail is told of the upper one.
    strength = half["value"] or strengths[-1]
    upper = next(tried for tried in strengths if tried >= strength)
    return {
        "kind": name, "light": one.describe(plant), "strengths": strengths, "success": [rates for _, rates in points],
        "half": half, "there": one.scaled(float(f"{strength:.2g}") if half["value"] else strength).describe(plant),
        "modes": [[*mode, count] for mode, count in analysis.modes(found[upper]).items()],
    }  # fmt: skip


def success(found: dict[float, ls.stress.Outcomes]) -> list[tuple[float, list[float]]]:
    """Strength and exact interval of success, the weakest first."""
    return [
        (strength, interval(analysis.success(ls.stress.Cell("smooth", "alone", strength), outcomes).exact))
        for strength, outcomes in sorted(found.items())
    ]


def possible(one: Disturbance, strengths: Sequence[float]) -> list[float]:
    """The strengths that the disturbance can have and that differ: not more losses than of everything."""
    kept: dict[Disturbance, float] = {}
    for strength in strengths:
        try:
            kept.setdefault(one.scaled(strength), strength)
        except ls.InputError:
            break
    return list(kept.values())


def half_fail(points: Sequence[tuple[float, Sequence[float]]]) -> dict[str, float | None]:
    """Where success falls through one half, of (strength, (success, its lowest, its highest)), the weakest first.

    Returns:
      value: interpolated over the logarithm of the strength between the last before success is first below one half,
        and the first after. above: the last strength before success is first not surely above one half. below: the
        first at which it is surely below. Each is None where there is no such strength.
    """
    strengths, rates = [strength for strength, _ in points], np.array([rates for _, rates in points])
    value, lowest, highest = (next(iter(np.flatnonzero(one < 0.5)), None) for one in rates.T)
    half = None if value is None else strengths[value]
    if value:
        before, after = rates[value - 1, 0], rates[value, 0]
        ratio = strengths[value] / strengths[value - 1]
        half = strengths[value - 1] * ratio ** float((before - 0.5) / (before - after))
    return {
        "value": half,
        "above": strengths[-1] if lowest is None else strengths[lowest - 1] if lowest else None,
        "below": None if highest is None else strengths[highest],
    }


def in_words(one: Disturbance) -> str:
    """The name of its class: MotorLag is motor lag."""
    words = re.sub(r"(?<!^)(?=[A-Z])", " ", type(one).__name__).lower()
    return {"dryden": "Dryden turbulence"}.get(words, words)


def report(result: Result) -> str:
    robots = result["robots"]
    parts = [
        "## How often the policies fail",
        picture(result, "stress_test", "Success against the strength of all disturbances, with Wilson's 95 % bands"),
        "No statement of the paper's, but what it takes to believe the others. Strength 1 is the preset 'light', and"
        f" the presets are {', '.join(f'{name!r} {strength:g}' for name, strength in PRESETS.items())}. All policies"
        " meet the same trials. Open loop is the plan of smoothing without feedback. Replanning solves again from where"
        f" the robot is measured to be, every {robots['differential_drive']['replan_every']:g} s (differential drive)"
        f" and {robots['quadrotor']['replan_every']:g} s (quadrotor).",
    ]
    for name, robot in robots.items():
        parts += [
            f"{NAMES[name].capitalize()}, {robot['trials'] * len(robot['together'])} trials, {robot['trials']} a line;"
            f" at strength 1: {brief('; '.join(robot['disturbances']))}. "
            + " ".join(
                f"The plan of {WORDS[policy]} costs {plan['cost']:.4g}, and its clearance is {plan['clearance']:.3f} m."
                for policy, plan in robot["plans"].items()
            ),
            of_policies(robot["together"]),
        ]
    parts += [
        "Intervals are Clopper and Pearson's, of 95 %. The last columns hold"
        " each policy against smoothing: in how many trials only one of the two reached the goal, and the"
        " p-value of McNemar's exact test, corrected for all comparisons of the robot after Holm.",
        "### What breaks first",
        picture(
            result,
            "stress_test_alone",
            "The strength of one kind of disturbance alone at which half of the trials fail, between those at"
            " which that is surely not yet and surely already so; an open arrow where that is beyond what was tried",
        ),
        "Smoothing's policy under one kind of disturbance at a time, made stronger in steps. Between two of them"
        " success first falls through one half, which is interpolated. In brackets are the last strength up to which"
        " success is surely above one half and the first at which it is surely below, by exact intervals of 95 %."
        " Multiples of the preset are not the same effort for all kinds: the third column says what they come to.",
    ]
    for name, robot in robots.items():
        count = sum(len(kind["strengths"]) for kind in robot["alone"])
        each = robot["trials_alone"]
        parts += [f"{NAMES[name].capitalize()}, {each * count} trials, {each} a strength.", of_kinds(robot["alone"])]
    return "\n\n".join(parts)


def of_policies(cells: Sequence[dict[str, Any]]) -> str:
    rows = []
    for cell in cells:
        ends = ends_of(cell["modes"])
        hit = next((mode[1] for mode in cell["modes"] if mode[1]), "")
        against = cell.get("against")
        compared = ["", "", ""]
        if against:
            compared = [against["only_smooth"], against["only_this"], f"{against['p_value']:.1g}"]
        share = between([100 * value for value in cell["exact"]], ".1f")
        rows.append([f"{cell['strength']:g}, {WORDS[cell['policy']]}", share, *ends.values(), hit, *compared])
    head = (
        "strength, policy", "reached (%)", *FAILURES.values(), "hit most often", "only smoothing", "only this", "p",
    )  # fmt: skip
    return table(head, rows)


def of_kinds(kinds: Sequence[dict[str, Any]]) -> str:
    rows = []
    for kind in kinds:
        half, low, high = (kind["half"][name] for name in ("value", "above", "below"))
        first, last = kind["strengths"][0], kind["strengths"][-1]
        if low == last:
            where = f"over {last:.3g}"
        else:
            span = f"{f'under {first:.3g}' if low is None else f'{low:.3g}'} to"
            span += f" over {last:.3g}" if high is None else f" {high:.3g}"
            where = f"{span}" if half is None else f"{half:.2g} ({span})"
        ends = ends_of(kind["modes"])
        how = ", ".join(f"{count} {FAILURES[outcome]}" for outcome, count in ends.items() if count) or "-"
        rows.append([kind["kind"], where, brief(kind["there"]), how, brief(kind["light"])])
    return table(("kind", "half fail at", "which is", "failures there", "strength 1"), rows)


def ends_of(modes: Sequence[Sequence[Any]]) -> dict[str, int]:
    """Number of trials by kind of failure."""
    return {outcome: sum(count for end, _, count in modes if end == outcome) for outcome in FAILURES}


def brief(text: str) -> str:
    """The text with numbers rounded to three digits."""
    return re.sub(r"\d+\.\d{2,}", lambda number: f"{float(number[0]):.3g}", text)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

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
from runner import FolderSettings, Result, counting, interval, opening, run, table

import lqrsim as ls
from lqrsim.disturbances import Disturbance
from lqrsim.simulation.disturbances import PRESETS

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
    cells = []
    for cell in results.cells:
        found = results.outcomes(cell).success
        cells.append({
            "policy": cell.policy, "strength": cell.strength, "reached": found.reached, "trials": found.trials,
            "band": interval(found.band),
        })  # fmt: skip
    plans = {policy: plan_of(results.solution(policy)) for policy in ("smooth", "ilqr")}
    return {"plans": plans, "replan_every": asked.replan_every, "trials": asked.trials, "together": cells}


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
    rows = [told(name, success(outcomes)) for name, outcomes in found.items()]
    # What never fails half of the time comes last, what fails more often before what fails less.
    rows.sort(key=lambda row: (row["half"]["value"] or np.inf, row["at_last"]))
    return {"alone": rows, "trials_alone": trials}


def told(name: str, points: Sequence[tuple[float, list[float]]]) -> dict[str, Any]:
    """The result of one kind of disturbance."""
    (first, _), (last, (at_last, *_)) = points[0], points[-1]
    return {"kind": name, "range": [first, last], "at_last": at_last, "half": half_fail(points)}


def success(found: dict[float, ls.stress.Outcomes]) -> list[tuple[float, list[float]]]:
    """Strength and exact interval of success, the weakest first."""
    return [(strength, interval(outcomes.success.exact)) for strength, outcomes in sorted(found.items())]


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
        " meet the same trials. Replanning solves again every"
        f" {robots['differential_drive']['replan_every']:g} s (differential drive) and"
        f" {robots['quadrotor']['replan_every']:g} s (quadrotor).",
    ]
    for name, robot in robots.items():
        plans = ", ".join(f"{WORDS[policy]}'s {plan['clearance']:.3f} m" for policy, plan in robot["plans"].items())
        parts += [
            f"{NAMES[name].capitalize()}, reached (%), {robot['trials']} trials each; clearance of the plans: {plans}.",
            of_policies(robot["together"]),
        ]
    parts += [
        "### What breaks first",
        picture(
            result,
            "stress_test_alone",
            "The strength of one kind of disturbance alone at which half of the trials fail, between those at"
            " which that is surely not yet and surely already so; an open arrow where that is beyond what was tried",
        ),
        "Smoothing's policy under one kind at a time, made stronger in steps; success falls through one half between"
        " two of them, which is interpolated. In brackets are the last strength at which success is surely above one"
        " half and the first at which it is surely below.",
    ]
    for name, robot in robots.items():
        title = f"{NAMES[name].capitalize()}, {robot['trials_alone']} trials a strength."
        parts += [title, of_kinds(robot["alone"])]
    return "\n\n".join(parts)


def of_policies(cells: Sequence[dict[str, Any]]) -> str:
    """A row for each strength, a column for each policy."""
    policies = list(dict.fromkeys(cell["policy"] for cell in cells))
    shares = {(cell["strength"], cell["policy"]): 100 * cell["reached"] / cell["trials"] for cell in cells}
    rows = [
        [f"{strength:g}", *(f"{shares[strength, policy]:.1f}" for policy in policies)]
        for strength in dict.fromkeys(cell["strength"] for cell in cells)
    ]
    return table(("strength", *(WORDS[policy] for policy in policies)), rows)


def of_kinds(kinds: Sequence[dict[str, Any]]) -> str:
    rows = []
    for kind in kinds:
        half, low, high = (kind["half"][name] for name in ("value", "above", "below"))
        first, last = kind["range"]
        if low == last:
            where = f"over {last:.3g}"
        else:
            span = f"{f'under {first:.3g}' if low is None else f'{low:.3g}'} to"
            span += f" over {last:.3g}" if high is None else f" {high:.3g}"
            where = f"{span}" if half is None else f"{half:.2g} ({span})"
        rows.append([kind["kind"], where])
    return table(("kind", "half fail at"), rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)

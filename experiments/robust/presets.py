"""How often the quadrotor reaches its goal under all disturbances at once: policies and plans, and RotorPy's law."""

from typing import Any

import numpy as np
from peers import RotorPy, Unavailable
from peers.rotorpy import BEST_AT_LIGHT, BEST_AT_MODERATE
from runner import improbable, progress, table

import lqrsim as ls
from lqrsim.control.controllers import ControllerLike
from lqrsim.stress.statistics import compare
from robust.common import ASKED, PRESETS, Config, Reached, reached, safe_plan, share

OWN, PLAN, SAFE = "smoother's policy", "default plan", "safe plan"
POSES = {
    "offset free of place and attitude alone": ("x", "y", "z", "rx", "ry", "rz"),
    "offset free of the place alone": ("x", "y", "z"),
}
ROTORPY = "RotorPy's SE(3), safe plan"
BEST = f"offset free, {SAFE}"


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, dict[str, list[Reached]]] = {preset: {} for preset in PRESETS}
    costs: dict[str, list[list[float]]] = {preset: [] for preset in PRESETS}
    missing = ""
    for query in progress(range(config.queries), "quadrotor, presets"):
        scenario = ls.scenarios.quadrotor(query)
        plant, plan = scenario.plant(), ls.smooth(scenario.problem)
        for preset in PRESETS[:1] if config.quick else PRESETS:
            disturbances = ls.disturbances.preset(preset, plant)
            stated = ls.uncertainty_of(plant, disturbances)
            safe = safe_plan(query, preset, ASKED[preset])
            costs[preset].append([plan.cost, safe.cost])
            flown = laws(scenario, plan, safe, stated, preset)
            try:
                gains = BEST_AT_LIGHT if preset == "light" else BEST_AT_MODERATE
                quadrotor = ls.Quadrotor()
                peer = RotorPy(quadrotor, safe.solution, gains, feed_drag=preset != "light")
                flown[ROTORPY] = safe.solution, peer
            except Unavailable as error:
                missing = str(error)
            for name, (solution, law) in flown.items():
                ended = reached(
                    plant, solution, law, disturbances, trials=config.trials, seed=config.seed,
                    first=query * config.trials,
                )  # fmt: skip
                found[preset].setdefault(name, []).append(ended)
    return {
        "presets": {preset: of_preset(rows, costs[preset]) for preset, rows in found.items() if rows},
        "trials": config.trials, "queries": config.queries, "missing": missing,
    }  # fmt: skip


def laws(
    scenario: ls.Scenario, plan: ls.Solution, safe: ls.types.SafePlan, stated: ls.disturbances.Uncertainty, preset: str
) -> dict[str, tuple[ls.Solution, ControllerLike | None]]:
    """Name -> plan and what flies it."""
    problem = scenario.problem
    flown: dict[str, tuple[ls.Solution, ControllerLike | None]] = {
        OWN: (plan, None),
        f"track, {PLAN}": (plan, ls.track(problem, plan, uncertainty=stated)),
        f"offset free, {PLAN}": (plan, ls.OffsetFree(problem, plan, stated)),
        f"track, {SAFE}": (safe.solution, ls.track(safe.problem, safe.solution, uncertainty=stated)),
        BEST: (safe.solution, safe.controller),
    }
    if preset == "light":
        for name, sensors in POSES.items():
            law = ls.OffsetFree(safe.problem, safe.solution, stated, sensors=sensors)
            flown[f"{name}, {SAFE}"] = safe.solution, law
    return flown


def of_preset(rows: dict[str, list[Reached]], costs: list[list[float]]) -> dict[str, Any]:
    together = {name: np.concatenate(parts) for name, parts in rows.items()}
    result: dict[str, Any] = {
        "reached": {name: share(ended) for name, ended in together.items()},
        "dearer": float(np.median([safe / plan for plan, safe in costs])) - 1,
    }
    if ROTORPY in together:
        pairs = compare(together[BEST], together[ROTORPY])
        result["against"] = {
            "only_ours": pairs.only_first, "only_theirs": pairs.only_second, "p_value": pairs.p_value,
        }  # fmt: skip
    return result


def report(found: dict[str, Any]) -> list[str]:
    presets = found["presets"]
    names = list(dict.fromkeys(name for one in presets.values() for name in one["reached"]))
    rows = [
        [name, *(f"{one['reached'][name][0]:.1f}" if name in one["reached"] else "-" for one in presets.values())]
        for name in names
    ]
    dearer = ", ".join(f"{100 * one['dearer']:+.0f} % ({preset})" for preset, one in presets.items())
    against = [
        f"{one['against']['only_ours']} against {one['against']['only_theirs']} ({preset}, p:"
        f" {improbable(one['against']['p_value'])})"
        for preset, one in presets.items()
        if "against" in one
    ]
    peers = f"not flown: {found['missing']}" if not against else ", ".join(against)
    return [
        f"{found['queries']} queries of the quadrotor, {found['trials']} trials each, the same for all policies. A safe"
        " plan is asked for a chance of collision of "
        + ", ".join(f"{chance:g} ({preset})" for preset, chance in ASKED.items())
        + f", and costs more than the default plan by {dearer} in the median. RotorPy's law has the gains that a"
        " search found best for the default plan of the first query, at light, and for the other presets at moderate"
        " (`experiments/rotorpy_gains.py`). Trials that only ours reaches against those that only"
        f" theirs does, McNemar's exact test: {peers}.",
        table(("reached (%)", *presets), rows),
    ]

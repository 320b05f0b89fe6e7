"""Whether planning again with what is estimated is worth it: `OffsetFree` with it and without, under the presets."""

from typing import Any

import numpy as np
from robust.common import ASKED, PRESETS, Reached, reach_exactly, run, share
from runner import between, progress, table

import lqrsim as ls
from lqrsim.stress.statistics import compare
from replan.common import Config

EVERY = 0.5  # s
KEPT, NEEDED, ALWAYS = "the first plan", "a new plan where it is needed", "a new plan each time"
FEWER = 5  # times, for what takes longest


def measure(config: Config) -> dict[str, Any]:
    each = max(config.trials * 20 // config.queries, 2)
    ended: dict[str, dict[str, list[Reached]]] = {preset: {KEPT: [], NEEDED: [], ALWAYS: []} for preset in PRESETS}
    solved: dict[str, int] = dict.fromkeys(PRESETS, 0)
    for query in progress(range(config.queries), "with estimates"):
        scenario = ls.scenarios.quadrotor(query)
        plant = scenario.plant()
        for preset in PRESETS[:1] if config.quick else PRESETS:
            disturbances = ls.disturbances.preset(preset, plant)
            stated = ls.uncertainty_of(plant, disturbances)
            safe = ls.smooth_chance_constrained(reach_exactly(scenario.problem), stated, chance=ASKED[preset])
            common = safe.problem, safe.solution, stated
            laws = {
                KEPT: safe.controller,
                NEEDED: ls.OffsetFree(*common, replan_every=EVERY),
                ALWAYS: ls.OffsetFree(*common, replan_every=EVERY, replan_always=True),
            }
            for name, law in laws.items():
                trials = max(each // FEWER, 1) if name == ALWAYS else each
                rollout = run(
                    plant, safe.solution, law, disturbances, trials=trials, seed=config.seed, first=query * each
                )
                ended[preset][name].append(np.array(ls.stress.outcomes(rollout).outcome) == "reached")
                if name == NEEDED:
                    log = rollout.controller_run.log
                    solved[preset] += log.solved + log.kept.total()
    found: dict[str, Any] = {}
    for preset, laws in ended.items():
        if laws[KEPT]:
            whole = {name: np.concatenate(parts) for name, parts in laws.items()}
            pairs = compare(whole[NEEDED], whole[KEPT])
            found[preset] = {
                "reached": {name: share(one) for name, one in whole.items()},
                "solves": solved[preset] / len(whole[KEPT]),
                "only new": pairs.only_first, "only first": pairs.only_second, "p": pairs.p_value,
            }  # fmt: skip
    return {"presets": found, "queries": config.queries, "trials": each}


def report(found: dict[str, Any]) -> list[str]:
    head = ("reached (%)", *found["presets"])
    rows = [
        [name, *(between(one["reached"][name], ".1f") for one in found["presets"].values())]
        for name in (KEPT, NEEDED, ALWAYS)
    ]
    told = [
        f"{preset}: only with new plans {one['only new']}, only with the first {one['only first']}"
        f" (p = {one['p']:.2g}), {one['solves']:.2f} solves a trial"
        for preset, one in found["presets"].items()
    ]
    return [
        f"`OffsetFree` on safe plans of the quadrotor, {found['queries']} queries of {found['trials']} trials, the same"
        f" for all but for new plans each time, which have a {FEWER}th as many. New plans are looked for every"
        f" {EVERY:g} s, with the constants as they are estimated.",
        table(head, rows),
        f"Trials that only one of the first two reaches, McNemar's exact test: {'; '.join(told)}.",
    ]

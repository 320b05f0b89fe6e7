"""What a delay of one control period costs that the planner knows of, and what one that it does not know of."""

from typing import Any

import numpy as np
from paper.common import between, table
from robust.common import share

import lqrsim as ls
from replan.common import Config, progress, scenario_of, stated

EVERY = 1 / 30  # s
LAWS: dict[str, dict[str, Any]] = {
    "no delay": {},
    "one period, predicted": {"computing": EVERY},
    "one period, ignored": {"computing": EVERY, "predict": False},
    "3 to 30 ms, drawn": {"computing": lambda random: random.uniform(0.003, 0.030), "deadline": EVERY},
    "a quarter are late, predicted": {"computing": lambda random: random.uniform(0.0, 4 / 90), "deadline": EVERY},
}


def measure(config: Config) -> dict[str, Any]:
    each, ended = max(config.trials // config.queries, 1), {name: [] for name in LAWS}
    used = dict.fromkeys(LAWS, 0)
    begun = dict.fromkeys(LAWS, 0)
    for query in progress(range(config.queries), "delays"):
        scenario = scenario_of("quadrotor", query)
        problem = stated(scenario, "clearance")
        solution, plant = ls.smooth(problem), scenario.plant()
        for name, how in LAWS.items():
            law = ls.Replanning(problem, solution, every=EVERY, **how)
            rollout = ls.simulate(
                plant, solution, controller=law, disturbances=ls.preset("light", plant), trials=each,
                first_trial=query * each, seed=config.seed, frames=False, contacts=False,
            )  # fmt: skip
            ended[name] += [one == "reached" for one in rollout.outcome]
            used[name] += law.solved
            begun[name] += len(law.records)
    shares = {name: share(np.array(one)) for name, one in ended.items()}
    return {
        "reached": shares, "used": {name: 100 * used[name] / begun[name] for name in LAWS},
        "queries": config.queries, "trials": each,
    }  # fmt: skip


def report(found: dict[str, Any]) -> list[str]:
    rows = [[name, between(share, ".1f"), f"{found['used'][name]:.1f}"] for name, share in found["reached"].items()]
    return [
        f"The quadrotor under the preset light, {found['queries']} queries of {found['trials']} trials, re-planned"
        " every control period for what is left of the horizon.",
        table(("delay", "reached (%)", "plans that were used (%)"), rows),
    ]

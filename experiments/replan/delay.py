"""What a delay of one control period costs that the planner knows of, and what one that it does not know of."""

from dataclasses import replace
from typing import Any

import numpy as np
from robust.common import share
from runner import between, progress, table

import lqrsim as ls
from replan.common import Config, scenario_of, stated

EVERY = 1 / 30  # s
ROOM = 0.2  # m
LAWS: dict[str, dict[str, Any]] = {
    "no delay": {"deadline": 0.0},
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
        problem = firm(scenario)
        solution, plant = ls.smooth(problem), scenario.plant()
        for name, how in LAWS.items():
            law = ls.Replanner(problem, solution, every=EVERY, **how)
            rollout = ls.simulate(
                plant, solution, controller=law, disturbances=ls.disturbances.preset("light", plant), trials=each,
                first_trial=query * each, seed=config.seed, frames=False, contacts=False,
            )  # fmt: skip
            ended[name] += [one == "reached" for one in rollout.outcome]
            log = rollout.controller_run.log
            used[name] += log.solved
            begun[name] += len(log.records)
    shares = {name: share(np.array(one)) for name, one in ended.items()}
    return {
        "reached": shares, "used": {name: 100 * used[name] / begun[name] for name in LAWS},
        "queries": config.queries, "trials": each,
    }  # fmt: skip


def firm(scenario: ls.Scenario) -> ls.Problem:
    """The query with ten times the weight of the goal, a tenth of that of the controls, and room beside obstacles.

    With the scenario's own weights a plan gives way to what disturbs it rather than spend controls on it, and under
    light hardly any run reaches its goal, delay or not.
    """
    problem, robot = stated(scenario, "clearance"), scenario.robot
    assert problem.goal is not None
    return replace(
        problem, final_cost=ls.QuadraticCost(np.full(12, 5000.0), about=problem.goal),
        stage_cost=ls.ControlCost(np.full(4, 2.0), about=problem.nominal_control) + problem.obstacle_costs[0],
        constraints=[ls.Clearance(scenario.scene.world, radius=robot.radius, margin=ROOM)],
    )  # fmt: skip


def report(found: dict[str, Any]) -> list[str]:
    rows = [[name, between(share, ".1f"), f"{found['used'][name]:.1f}"] for name, share in found["reached"].items()]
    return [
        f"The quadrotor under the preset light, {found['queries']} queries of {found['trials']} trials, re-planned"
        " every control period for what is left of the horizon. Its problem has ten times the weight of the goal, a"
        f" tenth of that of the controls, and a clearance of {ROOM:g} m.",
        table(("delay", "reached (%)", "plans that were used (%)"), rows),
    ]

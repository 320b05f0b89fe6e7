"""How long re-plans take, in the closed loop in MuJoCo under the scenario's noise, one robot after the other."""

import gc
import re
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from runner import progress, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from replan.common import ROBOTS, WAYS, Config, scenario_of, stated

# Control period in s and steps, where they are others than the scenario's.
RATES = {"as planned": (None, None), "100 Hz, 2 s": (0.01, 200)}

FAST = 0.007  # s, that a solve may take at 100 Hz


def measure(config: Config) -> dict[str, Any]:
    rows = []
    for robot in ROBOTS:
        for rate in RATES:
            for way in WAYS:
                rows.append({"robot": robot, "rate": rate, "problem": way, **of_one(config, robot, rate, way)})
    return {"rows": rows, "deadline": config.deadline}


def of_one(config: Config, robot: str, rate: str, way: str) -> dict[str, Any]:
    """Times of at least so many re-plans, of all queries in turn."""
    seconds: list[Array] = []
    iterations: list[int] = []
    ended, collided, trial, asked = Counter[str](), 0, 0, []
    worst = Counter[str]()
    for query in progress(range(config.queries), f"{robot}, {rate}, {way}"):
        scenario = scenario_of(robot, query)
        problem = at_rate(stated(scenario, way), rate)
        solution, plant = ls.smooth(problem), plant_at(scenario, problem.dt)
        if not solution.success:
            worst[solution.status.name] += 1
            continue
        deadline = min(config.deadline, FAST if problem.dt < 2 * FAST else np.inf)
        law = ls.Replanner(
            problem, solution, every=problem.dt, deadline=deadline, horizon="moving", computing="measured"
        )
        runs = -(-config.plans // (config.queries * (problem.steps - 1)))
        gc.collect()
        gc.freeze()  # what is there now is not looked at again
        for first in range(runs):
            rollout = ls.simulate(
                plant, solution, controller=law, disturbances=noise(scenario), seed=config.seed,
                first_trial=query * runs + first, frames=False, contacts=False,
            )  # fmt: skip
            collided += int(rollout.collided.sum())
            trial += 1
            records = rollout.controller_run.log.records
            seconds.append(np.array([one.seconds for one in records]))
            iterations += [one.iterations for one in records]
            ended.update(one.status if one.used else one.reason for one in records)
            asked += [one.cost <= one.before * (1 + 1e-9) for one in records if one.used]
    took = 1000 * np.concatenate(seconds) if seconds else np.array([np.nan])
    return {
        "plans": len(took), "median": float(np.median(took)), "p999": float(np.quantile(took, 0.999)),
        "most": float(took.max()), "over30": int((took > 30).sum()), "iterations": float(np.median(iterations or [0])),
        "ended": dict(ended), "collided": collided, "trials": trial, "unsolved": dict(worst),
    }  # fmt: skip


def at_rate(problem: ls.Problem, rate: str) -> ls.Problem:
    """The same problem; or for 2 s of its plan, at 100 Hz."""
    dt, steps = RATES[rate]
    if dt is None or steps is None:
        return problem
    plan = ls.smooth(replace(problem, constraints=())).trajectory
    about = plan.states[min(round(dt * steps / plan.dt), plan.steps)]
    weight = problem.final_cost.weight if isinstance(problem.final_cost, ls.QuadraticCost) else np.ones(len(about))
    return replace(problem, dt=dt, steps=steps, final_cost=ls.QuadraticCost(weight, about=about))


def plant_at(scenario: ls.Scenario, dt: float) -> ls.Plant:
    """The plant, with a physics step of which the control period is a multiple."""
    timestep = float(scenario.scene.model.opt.timestep)
    if abs(dt / timestep - round(dt / timestep)) < 1e-6 and dt >= timestep:
        return scenario.plant()
    xml = re.sub(r'timestep="[^"]*"', f'timestep="{dt:.17g}"', scenario.scene.xml)
    return ls.Plant(scenario.robot, scene_from_xml(xml, scenario.scene.name))


def noise(scenario: ls.Scenario) -> list[ls.disturbances.Disturbance]:
    """The scenario's, but for the push: of a run of 2 s it would be after the end."""
    return [one for one in scenario.disturbances if not isinstance(one, ls.disturbances.Push)]


def report(found: dict[str, Any]) -> list[str]:
    head = (
        "robot", "control", "problem", "re-plans", "median (ms)", "99.9 % (ms)", "most (ms)", "over 30 ms",
        "iterations, median", "in time and converged (%)",
    )  # fmt: skip
    rows = []
    for one in found["rows"]:
        converged = 100 * one["ended"].get("CONVERGED", 0) / max(one["plans"], 1)
        rows.append([
            one["robot"].replace("_", " "), one["rate"], one["problem"], one["plans"], f"{one['median']:.1f}",
            f"{one['p999']:.1f}", f"{one['most']:.1f}", one["over30"], f"{one['iterations']:.0f}", f"{converged:.1f}",
        ])  # fmt: skip
    lines = [
        "Every control period of runs in MuJoCo, under the scenario's noise without its push, each re-planned with a"
        f" moving horizon and at most {1000 * found['deadline']:g} ms, {1000 * FAST:g} ms at 100 Hz. As planned is 30"
        " Hz with a horizon of 5 s for the quadrotor, and 6 Hz with 25 s for the drive. A solve that ends at its time"
        " limit has a plan that is no worse than to go on.",
        table(head, rows),
    ]
    told = [
        f"{one['robot'].replace('_', ' ')}, {one['rate']}, {one['problem']}: "
        + ", ".join(f"{count} {name}" for name, count in sorted(one["ended"].items()))
        + f"; {one['collided']} of {one['trials']} runs collided"
        + "".join(f"; {count} queries not solved: {name}" for name, count in one["unsolved"].items())
        for one in found["rows"]
    ]
    return [*lines, "How they ended: \n\n" + "\n".join(f"- {line}." for line in told)]

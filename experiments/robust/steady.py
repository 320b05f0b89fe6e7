"""Steady disturbances: whether the quadrotor gets there in a wind or with a wrong mass, and what error stays."""

from typing import Any

import numpy as np
from runner import between, progress, table

import lqrsim as ls
from lqrsim.disturbances import MassMismatch, MeanWind
from robust.common import ASKED, Config, reached, run, safe_plan, share

SPEED = 3.0  # m/s
MASSES = (0.8, 1.2)
DIRECTIONS = 5  # of the wind, a query
HOVER = 20.0  # s


def measure(config: Config) -> dict[str, Any]:
    rng, found = np.random.default_rng(config.seed), dict[str, list[bool]]()
    for query in progress(range(config.queries), "steady disturbances"):
        scenario = ls.scenarios.quadrotor(query)
        plant, plan = scenario.plant(), ls.smooth(scenario.problem)
        safe = safe_plan(query, "moderate", ASKED["moderate"])
        flown = ("smoother", plan, None), ("offset free", safe.solution, safe.controller)
        winds = rng.normal(size=(DIRECTIONS, 3))
        cases = {f"wind of {SPEED:g} m/s": [[MeanWind(SPEED * one / np.linalg.norm(one))] for one in winds]}
        cases |= {f"mass times {factor:g}": [[MassMismatch(factor=factor)]] for factor in MASSES}
        for name, several in cases.items():
            for disturbances in several:
                for policy, solution, law in flown:
                    ended = reached(plant, solution, law, disturbances, trials=1, seed=config.seed)
                    found.setdefault(f"{name}: {policy}", []).append(bool(ended[0]))
    return {"reached": {name: share(np.array(ended)) for name, ended in found.items()}, "hover": hover(config)}


def hover(config: Config) -> dict[str, float]:
    """The largest error of the place in m, over the last second of hovering."""
    scenario = ls.scenarios.quadrotor()
    robot, plant = ls.Quadrotor(), scenario.plant()
    here, steps = np.zeros(12), round(HOVER / scenario.problem.dt)
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=scenario.problem.dt, steps=steps, initial=ls.FixedState(here),
        stage_cost=ls.ControlCost(np.full(4, 20.0), about=np.full(4, robot.hover_force)),
        final_cost=ls.QuadraticCost(np.full(12, 500.0), about=here),
    )  # fmt: skip
    plan = ls.smooth(problem)
    law = ls.OffsetFree(problem, plan, ls.uncertainty_of(plant, ls.disturbances.preset("moderate", plant)))
    errors = {}
    for name, one in {
        f"wind of {SPEED:g} m/s along x": MeanWind((SPEED, 0, 0)),
        f"wind of {SPEED:g} m/s upward": MeanWind((0, 0, SPEED)),
        **{f"mass times {factor:g}": MassMismatch(factor=factor) for factor in MASSES},
    }.items():
        rollout = run(plant, plan, law, [one], trials=1, seed=config.seed)
        last = round(1 / problem.dt)
        errors[name] = float(np.linalg.norm(rollout.states[0, -last:, :3], axis=1).max())
    return errors


def report(found: dict[str, Any]) -> list[str]:
    rows = [[name, between(told, ".1f")] for name, told in found["reached"].items()]
    still = ", ".join(f"{1000 * error:.1f} ({name})" for name, error in found["hover"].items())
    return [
        "Laws of the preset 'moderate', to which wind and mass are small and random, and not steady; no noise. When"
        f" hovering for {HOVER:g} s, the largest error in the last second is, in mm: {still}.",
        table(("steady disturbance: policy", "reached (%)"), rows),
    ]

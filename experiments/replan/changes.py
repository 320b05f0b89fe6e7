"""What changes on the way: a goal that jumps, and a pillar that appears where the plan leads."""

from dataclasses import replace
from typing import Any

import numpy as np
from paper.common import between, table
from robust.common import share

import lqrsim as ls
from lqrsim.errors import Array
from replan.common import MARGIN, Config, progress, scenario_of, stated

EVERY = 1 / 30  # s
JUMP, JUMPS_AT = 1.0, 2.0  # m, s: how far the goal of the quadrotor jumps, and when
FIRM = 5000.0  # the weight of the goal, ten times the scenario's: at that a metre less is worth the controls
ROOM = 0.1  # m, between the robot at the new goal and obstacles, at least
AHEAD, SEEN_AT, PILLAR = 1.5, 1.0, 0.1  # s, s, m: where and when a pillar appears, and its radius
ASIDE = 0.05  # m, that its axis is beside the plan at most


def measure(config: Config) -> dict[str, Any]:
    each = max(config.trials // config.queries, 1)
    distances: dict[str, list[Array]] = {"re-planning": [], "the first policy": []}
    clearances: dict[str, list[Array]] = {"re-planning": [], "the first policy": []}
    for query in progress(range(config.queries), "goals and pillars"):
        scenario = scenario_of("quadrotor", query)
        problem = stated(scenario, "clearance")
        assert problem.goal is not None
        problem = replace(problem, final_cost=ls.QuadraticCost(FIRM * np.ones(12), about=problem.goal))
        solution, plant = ls.smooth(problem), scenario.plant()
        goal = jumped(problem, query)
        world, with_pillar = pillar(problem, solution, query)

        def known(t: float, problem: ls.Problem, goal: ls.QuadraticCost = goal) -> ls.Problem:
            return replace(problem, final_cost=goal) if t >= JUMPS_AT else problem

        def seen(t: float, problem: ls.Problem, after: ls.Problem = with_pillar) -> ls.Problem:
            return after if t >= SEEN_AT else problem

        trials = {"trials": each, "first_trial": query * each, "seed": config.seed}
        for name, changes, kept in (("goal", known, distances), ("pillar", seen, clearances)):
            law = ls.Replanning(problem, solution, every=EVERY, computing=EVERY, changes=changes)
            for who, controller in (("re-planning", law), ("the first policy", None)):
                rollout = ls.simulate(
                    plant, solution, controller=controller, disturbances=scenario.disturbances, frames=False,
                    contacts=False, **trials,
                )  # fmt: skip
                if name == "goal":
                    kept[who].append(np.linalg.norm(rollout.states[:, -1, :3] - goal.about[:3], axis=1))
                else:
                    kept[who].append((world.distance(rollout.states[..., :3]) - scenario.robot.radius).min(axis=1))
    radius = ls.Quadrotor().radius
    return {
        "goal": {who: share(np.concatenate(one) <= radius) for who, one in distances.items()},
        "distance": {who: float(np.median(np.concatenate(one))) for who, one in distances.items()},
        "pillar": {who: share(np.concatenate(one) >= 0) for who, one in clearances.items()},
        "clearance": {who: float(np.median(np.concatenate(one))) for who, one in clearances.items()},
        "queries": config.queries, "trials": each,
    }  # fmt: skip


def jumped(problem: ls.Problem, query: int) -> ls.QuadraticCost:
    """The final cost with a goal 1 m from where it was, in a random direction in which there is room for the robot."""
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    (cost,) = problem.obstacle_costs
    rng = np.random.default_rng([query, 1])
    while True:
        about = problem.final_cost.about.copy()
        way = rng.standard_normal(3)
        about[:3] += JUMP * way / np.linalg.norm(way)
        if cost.world.distance(about[:3]) > cost.radius + ROOM:
            return ls.QuadraticCost(problem.final_cost.weight, about=about)


def pillar(problem: ls.Problem, solution: ls.Solution, query: int) -> tuple[ls.World, ls.Problem]:
    """The pillar alone, upright where the plan will be, and the problem with it."""
    plan, rng = solution.trajectory, np.random.default_rng([query, 2])
    (clearance,) = (one for one in problem.constraints if isinstance(one, ls.Clearance))
    place = plan.states[round((SEEN_AT + AHEAD) / plan.dt), :3].copy()
    place[:2] += rng.uniform(-ASIDE, ASIDE, 2)
    one = ls.Obstacle("pillar", "cylinder", place, np.eye(3), np.array([PILLAR, np.inf, 0.0]))
    world = ls.World([*clearance.world.obstacles, one])
    (cost,) = problem.obstacle_costs
    others = [term for term in problem.stage_cost.terms if term is not cost]  # pyright: ignore[reportAttributeAccessIssue]
    stage = sum_of([*others, ls.ObstacleCost(world, radius=cost.radius, sharpness=cost.sharpness, weight=cost.weight)])
    kept = ls.Clearance(world, radius=clearance.radius, margin=MARGIN)
    return ls.World([one]), replace(problem, stage_cost=stage, constraints=[kept])


def sum_of(costs: list[ls.Cost]) -> ls.Cost:
    first, *rest = costs
    for cost in rest:
        first = first + cost
    return first


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        [who, between(found["goal"][who], ".0f"), f"{100 * found['distance'][who]:.0f}",
         between(found["pillar"][who], ".0f"), f"{100 * found['clearance'][who]:.0f}"]
        for who in found["goal"]
    ]  # fmt: skip
    head = (
        "law", "at the new goal (%)", "distance, median (cm)", "past the pillar (%)", "clearance to it, median (cm)",
    )  # fmt: skip
    return [
        f"The quadrotor, {found['queries']} queries of {found['trials']} trials each under the scenario's noise,"
        f" planned with a clearance and again every {1000 * EVERY:.0f} ms, with as long a delay. The goal jumps"
        f" {JUMP:g} m at {JUMPS_AT:g} s of 5; reached is within the robot's radius. The pillar, {100 * PILLAR:g} cm in"
        f" radius, appears at {SEEN_AT:g} s where the plan will be {AHEAD:g} s later, its axis at most"
        f" {100 * ASIDE:g} cm aside. In brackets exact intervals of 95 %.",
        table(head, rows),
    ]

"""What changes on the way: a goal that jumps, and pillars that appear where the plan leads, one of which moves."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from robust.common import share
from runner import between, progress, table

import lqrsim as ls
from lqrsim.errors import Array
from replan.common import MARGIN, Config, scenario_of, stated

EVERY = 1 / 30  # s
JUMP, JUMPS_AT = 1.0, 2.0  # m, s: how far the goal of the quadrotor jumps, and when
FIRM = 5000.0  # the weight of the goal, ten times the scenario's: at that a metre less is worth the controls
ROOM = 0.1  # m, between the robot at the new goal and obstacles, at least
AHEAD, SEEN_AT, PILLAR = 1.5, 1.0, 0.1  # s, s, m: where and when a pillar appears, and its radius
ASIDE = 0.05  # m, that its axis is beside the plan at most
SPEED = 0.5  # m/s, of one that moves
AGAIN, STILL, FIRST = "re-planning", "re-planning, as if it stood still", "the first policy"

Known = Callable[[float, ls.Problem], ls.Problem]


def measure(config: Config) -> dict[str, Any]:
    each = max(config.trials // config.queries, 1)
    distances: dict[str, list[Array]] = {AGAIN: [], FIRST: []}
    standing: dict[str, list[Array]] = {AGAIN: [], FIRST: []}
    crossing: dict[str, list[Array]] = {AGAIN: [], STILL: [], FIRST: []}
    for query in progress(range(config.queries), "goals and pillars"):
        scenario = scenario_of("quadrotor", query)
        problem = stated(scenario, "clearance")
        assert problem.goal is not None
        problem = replace(problem, final_cost=ls.QuadraticCost(FIRM * np.ones(12), about=problem.goal))
        solution, plant = ls.smooth(problem), scenario.plant()
        goal, one = jumped(problem, query), pillar(solution, query)
        moving = crossed(one, query)

        def run(changes: Known | None, query: int = query, problem: ls.Problem = problem, plant: ls.Plant = plant,
                solution: ls.Solution = solution, scenario: ls.Scenario = scenario) -> Array:  # fmt: skip
            """Where the trials went, by a law that plans again for what it knows; without any, by the first policy."""
            law = ls.Replanner(problem, solution, every=EVERY, computing=EVERY, changes=changes) if changes else None
            return ls.simulate(
                plant, solution, controller=law, disturbances=scenario.disturbances, frames=False, contacts=False,
                trials=each, first_trial=query * each, seed=config.seed,
            ).states  # fmt: skip

        first, radius = run(None), scenario.robot.radius
        for who, states in ((AGAIN, run(after_the_jump(goal))), (FIRST, first)):
            distances[who].append(np.linalg.norm(states[:, -1, :3] - goal.about[:3], axis=1))
        for who, states in ((AGAIN, run(seen(one))), (FIRST, first)):
            standing[who].append(clearance(one, states, problem.dt) - radius)
        for who, states in (
            (AGAIN, run(seen(moving))), (STILL, run(seen(moving, still=True))), (FIRST, first),
        ):  # fmt: skip
            crossing[who].append(clearance(moving, states, problem.dt) - radius)
    return {
        "goal": {who: share(np.concatenate(one) <= ls.Quadrotor().radius) for who, one in distances.items()},
        "distance": {who: float(np.median(np.concatenate(one))) for who, one in distances.items()},
        "pillar": {who: share(np.concatenate(one) >= 0) for who, one in standing.items()},
        "moving": {who: share(np.concatenate(one) >= 0) for who, one in crossing.items()},
        "queries": config.queries, "trials": each,
    }  # fmt: skip


def after_the_jump(goal: ls.QuadraticCost) -> Known:
    """The goal as it is known."""
    return lambda t, problem: replace(problem, final_cost=goal) if t >= JUMPS_AT else problem


def seen(one: ls.Obstacle, *, still: bool = False) -> Known:
    """The pillar as it is seen: with its velocity, or as if it stood still where it is at the time."""

    def changes(t: float, problem: ls.Problem) -> ls.Problem:
        if t < SEEN_AT:
            return problem
        here = replace(one, position=one.position + t * one.velocity, velocity=np.zeros(3))
        return beside(problem, here if still else one)

    return changes


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


def pillar(solution: ls.Solution, query: int) -> ls.Obstacle:
    """Upright where the plan will be."""
    plan, rng = solution.trajectory, np.random.default_rng([query, 2])
    place = plan.states[round((SEEN_AT + AHEAD) / plan.dt), :3].copy()
    place[:2] += rng.uniform(-ASIDE, ASIDE, 2)
    return ls.Obstacle("pillar", "cylinder", place, np.eye(3), np.array([PILLAR, np.inf, 0.0]))


def crossed(one: ls.Obstacle, query: int) -> ls.Obstacle:
    """The same pillar, there at the same time as the plan, but on its way."""
    angle = np.random.default_rng([query, 3]).uniform(0, 2 * np.pi)
    velocity = SPEED * np.array([np.cos(angle), np.sin(angle), 0.0])
    return replace(one, position=one.position - (SEEN_AT + AHEAD) * velocity, velocity=velocity)


def clearance(one: ls.Obstacle, states: Array, dt: float) -> Array:
    """The least distance of each trial's positions from an obstacle from when it is seen on, (K,)."""
    world, begun = ls.World([one]), round(SEEN_AT / dt)
    steps = range(begun, states.shape[1])
    return np.min([world.moved(t * dt).distance(states[:, t, :3]) for t in steps], axis=0)


def beside(problem: ls.Problem, one: ls.Obstacle) -> ls.Problem:
    """The problem with one obstacle more."""
    (kept,) = (one for one in problem.constraints if isinstance(one, ls.Clearance))
    world = ls.World([*kept.world.obstacles, one])
    (cost,) = problem.obstacle_costs
    others = [term for term in problem.stage_cost.terms if term is not cost]  # pyright: ignore[reportAttributeAccessIssue]
    stage = sum_of([*others, ls.ObstacleCost(world, radius=cost.radius, sharpness=cost.sharpness, weight=cost.weight)])
    return replace(problem, stage_cost=stage, constraints=[ls.Clearance(world, radius=kept.radius, margin=MARGIN)])


def sum_of(costs: list[ls.Cost]) -> ls.Cost:
    first, *rest = costs
    for cost in rest:
        first = first + cost
    return first


def report(found: dict[str, Any]) -> list[str]:
    laws = list(found["moving"])
    rows = [
        [
            who,
            *(between(found[what][who], ".0f") if who in found[what] else "" for what in ("goal", "pillar", "moving")),
        ]
        for who in laws
    ]
    return [
        f"The quadrotor, {found['queries']} queries of {found['trials']} trials each under the scenario's noise,"
        f" planned with a clearance and again every {1000 * EVERY:.0f} ms, with as long a delay. The goal jumps"
        f" {JUMP:g} m at {JUMPS_AT:g} s of 5; reached is within the robot's radius. The pillar, {100 * PILLAR:g} cm in"
        f" radius, appears at {SEEN_AT:g} s where the plan will be {AHEAD:g} s later, its axis at most"
        f" {100 * ASIDE:g} cm aside. A moving one gets there at the same time, at {SPEED:g} m/s in a random horizontal"
        " direction. In brackets exact intervals of 95 %.",
        table(("law", "at the new goal (%)", "past the pillar (%)", "past the moving pillar (%)"), rows),
    ]

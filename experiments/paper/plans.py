"""Plans as the results have them, for many pairs of weights, and by the way they go."""

from dataclasses import replace
from string import ascii_uppercase
from typing import Any

import numpy as np
from runner import Result, counting

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import terms_of
from paper.common import as_in_the_paper, numbers
from paper.homotopy import Way, way


def described(plan: ls.Solution) -> dict[str, Any]:
    """A plan as JSON has it; `bare` if the safeguard never stepped in."""
    assert plan.clearance is not None
    cost, clearance = numbers([plan.cost, plan.clearance.min()])
    return {
        "status": plan.status.name,
        "converged": plan.success,
        "iterations": len(plan.iterations),
        "bare": {row.method for row in plan.iterations} <= {plan.solver} and not plan.detail,
        "cost": cost,
        "clearance": clearance,
        "clear": plan.success and clearance is not None and clearance >= 0,
    }


def solved(scenario: ls.Scenario, start: Any, factors: Array, name: str) -> list[ls.Solution]:
    """Plans for all pairs of weights, the obstacles' row by row."""
    problems = [weighted(scenario.problem, obstacles, effort) for obstacles in factors for effort in factors]
    with counting(f"weights, from {name}") as told:
        return ls.smooth_many(problems, start=start, stop="cost", progress=told)


def weighted(problem: ls.Problem, obstacles: float, effort: float) -> ls.Problem:
    """With so many times the weights of the obstacles and of the controls."""
    control, obstacle = terms_of(problem.stage_cost)
    assert isinstance(control, ls.ControlCost)
    assert isinstance(obstacle, ls.ObstacleCost)
    cost = ls.ControlCost(effort * control.weight, about=control.about) + ls.ObstacleCost(
        obstacle.world, radius=obstacle.radius, sharpness=obstacle.sharpness, weight=obstacles * obstacle.weight
    )
    return replace(as_in_the_paper(problem), stage_cost=cost)


def sensitive(
    scenario: ls.Scenario, result: Result, grids: dict[str, list[ls.Solution]], plans: dict[str, ls.Solution]
) -> tuple[dict[str, list[dict[str, Any]]], dict[str, Array]]:
    """Which way each plan goes that converged and is clear, by letters, the commonest first; a path for each letter."""
    pillars = np.array([one.position[:2] for one in scenario.scene.world.obstacles if one.kind == "cylinder"])
    start, goal = scenario.problem.start, scenario.problem.goal
    assert start is not None
    assert goal is not None

    def path(plan: ls.Solution) -> Array:
        """From the wished start to the goal, for a homotopy keeps its ends; the plan's are centimetres away."""
        return np.vstack([start[:2], plan.trajectory.states[:, :2], goal[:2]])

    cells = {name: [described(plan) for plan in grid] for name, grid in grids.items()}
    entries = [*zip(result["plans"].values(), plans.values(), strict=True)]
    for name, grid in grids.items():
        entries += zip(cells[name], grid, strict=True)
    found: dict[Way, list[tuple[dict[str, Any], Array]]] = {}
    for entry, plan in entries:
        entry["way"] = ""
        if entry["clear"]:
            found.setdefault(way(path(plan), pillars), []).append((entry, path(plan)))
    paths = {}
    for number, members in enumerate(sorted(found.values(), key=len, reverse=True)):
        name = letters(number)
        for entry, _ in members:
            entry["way"] = name
        lengths = [float(np.linalg.norm(np.diff(taken, axis=0), axis=1).sum()) for _, taken in members]
        paths[name] = members[int(np.argmin(lengths))][1]
    return cells, paths


def letters(number: int) -> str:
    """A, B, ..., Z, AA, AB, ..."""
    first, last = divmod(number, 26)
    return (letters(first - 1) if first else "") + ascii_uppercase[last]

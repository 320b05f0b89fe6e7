"""Results as plain dictionaries, for `--json`. docs/json.md describes them."""

import json
from collections.abc import Mapping
from typing import Any

import lqrsim as ls

Object = dict[str, Any]


def text_of(value: object) -> str:
    """The JSON text of a result in one line, with numbers at full precision."""
    from lqrsim.results.archive import plain  # imports NumPy, which `--help` should not wait for

    return json.dumps(plain(value), allow_nan=False)


def of_scenario(name: str, scenario: "ls.Scenario") -> Object:
    """A scenario, as in `lqrsim list`."""
    problem = scenario.problem
    return {
        "name": name, "summary": scenario.summary, "robot": scenario.robot.name, "scene": scenario.scene.name,
        **_fields(problem, "steps dt"), "states": _named(problem.dynamics.state_coordinates),
        "controls": _named(problem.dynamics.control_coordinates),
    }  # fmt: skip


def of_funnel(funnel: "ls.types.Funnel") -> Object:
    """Settings and levels of a funnel; the ellipsoids are in its file."""
    times = [knot * funnel.plan.dt for knot in funnel.knots]
    columns = {
        "knot": funnel.knots, "time": times, "level": funnel.levels, "trials": funnel.trials,
        "successes": funnel.successes, "reason": funnel.reasons,
    }  # fmt: skip
    names = "rate confidence states family goal_radius disturbances seed options simulated policy_digest versions"
    return {**_fields(funnel, names), "knots": rows_of(columns)}


def of_solution(solution: "ls.Solution") -> Object:
    """Status, log and certificate of a solution; the arrays are in its file."""
    plan, target = solution.trajectory, solution.target
    clearance = None
    if solution.clearance is not None:
        knot = int(solution.clearance.argmin())
        clearance = {"least": solution.clearance[knot], "time": plan.times[knot]}
    distance = target.distance(plan.states[-1])
    names = (
        "scenario solver options status success detail remedy cost gap optimality violation certificate iterations"
        " problem_digest versions"
    )
    return {
        **_fields(solution, names),
        **_fields(plan, "steps dt"),
        "clearance": clearance,
        "goal": {"is": target.name, "distance": distance, "radius": solution.goal_radius, "unit": target.unit},
        "candidates": [_fields(candidate, "start cost iterations status") for candidate in solution.candidates],
    }


def of_rollout(rollout: "ls.Rollout", problem: "ls.Problem | None" = None) -> Object:
    """The outcomes of a rollout's trials. Costs are left out unless a problem with the same steps and dt is given."""
    from lqrsim.stress.analysis import outcomes

    if problem is not None and (problem.steps, problem.dt) != (rollout.plan.steps, rollout.plan.dt):
        problem = None
    columns: Mapping[str, Any] = {**outcomes(rollout, problem).columns(), "reason": rollout.reasons}
    target, chance = rollout.target, rollout.collision_chance
    return {
        **_fields(rollout, "robot scene disturbances seed tracking_unit versions"),
        "goal": {"is": target.name, "radius": rollout.goal_radius, "unit": target.unit},
        "departure": rollout.departure() or None,
        "warned": rollout.warned() or None,
        "tube": rollout.tube is not None,
        "collision_chance": None if chance is None else chance.max(),
        "reached": rollout.reached.sum(),
        "trials": rows_of(columns),
    }


def of_campaign(results: "ls.stress.Results") -> Object:
    """The outcomes of each cell of a campaign so far."""
    from lqrsim.results.goal import OUTCOMES

    cells = []
    for cell, ends, success in results.cell_successes():
        row = {**_fields(cell, "policy sweep strength"), "trials": ends.total()}
        if success is not None:
            outcomes = {name: ends[name] for name in OUTCOMES}
            row |= {"outcomes": outcomes, "reached": success.exact, "deterministic": success.alike}
        cells.append(row)
    return {
        **_fields(results, "folder complete"),
        "cells": cells,
        "left_out": results.manifest["left_out"],
        "plans": results.plans(),
        "came_to_nothing": results.came_to_nothing(),
        "versions": results.manifest["versions"],
    }


def _fields(record: object, names: str) -> Object:
    return {name: getattr(record, name) for name in names.split()}


def rows_of(columns: Mapping[str, Any]) -> list[Object]:
    """A table as a list of rows: column name -> value."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _named(space: "ls.types.Coordinates") -> list[Object]:
    return [{"name": name, "unit": unit} for name, unit in zip(space.names, space.units, strict=True)]

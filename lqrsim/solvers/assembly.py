"""Makes a `Solution` from the result of a run."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from lqrsim.codegen import distances
from lqrsim.errors import Array
from lqrsim.problem.clearance import Clearance
from lqrsim.problem.collision_spheres import clearances
from lqrsim.problem.costs import ObstacleCost
from lqrsim.problem.problem import Problem
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Iteration, Trajectory
from lqrsim.solvers.engine import RunResult
from lqrsim.versions import versions


def assemble(
    problem: Problem,
    found: RunResult,
    log: Sequence[Iteration],
    *,
    solver: str,
    options: dict[str, object],
    candidates: tuple[Candidate, ...] = (),
) -> Solution:
    """Copy the result of a run into a Solution."""
    assert found.certificate is not None
    states, controls, law = found.states.copy(), found.controls.copy(), (found.law[0].copy(), found.law[1].copy())
    inverse_law = found.values.get("inverse_law")
    if inverse_law is not None:
        inverse_law = inverse_law[0].copy(), inverse_law[1].copy()
    if problem.noise is not None:
        options = options | {"noise": repr(problem.noise), "risk": problem.risk}

    def policy(gain: Array, offset: Array, nominal: Array) -> AffinePolicy:
        return AffinePolicy(
            gain=gain, offset=offset, nominal=nominal, dt=problem.dt,
            state_coordinates=problem.dynamics.state_coordinates,
            control_coordinates=problem.applied_coordinates,
        )  # fmt: skip

    later = {
        "inverse_policy": lambda: policy(*inverse_law, states[1:]) if inverse_law is not None else None,
        "clearance": lambda: clearance_of(problem, states),
        "problem_digest": lambda: problem.digest,
    }
    return Solution._assembled(
        later,
        status=found.status,
        detail=found.detail,
        policy=policy(*law, states[:-1]),
        cost_to_go=_copied(found.values.get("cost_to_go")),
        cost_to_come=_copied(found.values.get("cost_to_come")),
        trajectory=Trajectory(states, controls, problem.dt),
        iterations=tuple(log),
        certificate=found.certificate,
        gap=found.gap,
        solver=solver,
        options=options,
        multipliers=found.multipliers,
        candidates=candidates,
        versions=versions(),
        goal=problem.weighed_goal,
        goal_radius=goal_radius_of(problem),
    )


def _copied(value: Any) -> Any:
    """A copy of a value function."""
    if value is None:
        return None
    return type(value)(*(np.array(getattr(value, field.name)) for field in fields(value)))


def goal_radius_of(problem: Problem) -> float | None:
    """The robot's radius, from its obstacle costs and clearances; None without these, or without a goal position."""
    goal, position = problem.weighed_goal, list(problem.dynamics.state_coordinates.position)
    if not position or (goal is not None and np.isnan(goal[position]).all()):
        return None
    return (
        max((one.radius for one in _kept_clear(problem) if one.balls is None and one.geoms is None), default=0.0)
        or None
    )


def clearance_of(problem: Problem, states: Array) -> Array | None:
    """Signed distance to the nearest obstacle minus the robot's radius, (T+1,); None without obstacles.

    For a robot of several collision spheres or geoms it is the smallest of theirs.
    """
    space = problem.dynamics.state_coordinates
    place = states[:, list(space.position)]
    kept = [one for one in _kept_clear(problem) if len(one.world)]
    worlds = {(id(one.world), one.radius, id(one.balls), id(one.geoms)): one for one in kept}
    found = []
    for one in worlds.values():
        if one.geoms is not None:
            found.append(one.geoms.clearances(problem.dynamics, one.world, states).min(axis=1))
        elif one.balls is not None:
            found.append(clearances(one.balls, problem.dynamics, one.world, states, problem.times).min(axis=1))
        else:
            seen = one.world.seen_by(space.plane, space.offset)
            found.append(distances.signed_distance_at(seen, place[:, None], problem.times)[:, 0] - one.radius)
    return np.min(found, axis=0) if found else None


def _kept_clear(problem: Problem) -> tuple[ObstacleCost | Clearance, ...]:
    """The costs and constraints that keep the robot clear of obstacles."""
    return (*problem.obstacle_costs, *(one for one in problem.constraints if isinstance(one, Clearance)))

"""A free final time: the duration is one more state, constant along the plan, with a free initial value.

The number of steps is fixed and their length varies: the dynamics are scaled by duration / stated duration, so that a
Runge-Kutta step over `dt` becomes one over `share * dt`. The interior point finds states, controls and duration at
once. With the duration found, the problem is an ordinary one, and the plan is already at its optimum.
"""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import InputError
from lqrsim.kernels.records import Motion
from lqrsim.problem.clearance import Clearance
from lqrsim.problem.constraints import Constraint, GoalState, StateBounds, SymbolicConstraint
from lqrsim.problem.costs import ControlCost, Cost, CostSum, ObstacleCost, QuadraticCost, SymbolicCost, terms_of
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers.interior_point import Found, InteriorPoint, Measures, Stages

STATE, STATED = "duration", "stated_duration"  # the added state, and the parameter that it is relative to
MOST = 300  # iterations

Stated = TypeVar("Stated", SymbolicCost, SymbolicConstraint)


def find_duration(
    problem: Problem, begin: Trajectory, *, tolerance: float, violation: float, most: int,
    watch: Callable[[Measures], bool],
) -> tuple[Problem, Found]:  # fmt: skip
    """Find the best duration near that of a plan. Return the problem with it, and the optimum, or how far it came.

    `violation` is the tolerance of the constraints, `most` the number of iterations, up to `MOST`; `watch` is called
    with the measures after each, and ends the search by returning True.
    """
    assert problem.duration is not None
    freed, n = with_duration(problem), len(problem.dynamics.state_coordinates)
    stages = Stages(freed)
    stages.free[n] = 1.0
    states = np.column_stack([begin.states, np.full(len(begin.states), problem.steps * problem.dt)])
    plan = Motion(in_c_order(states), in_c_order(begin.controls))
    with np.errstate(all="ignore"):
        point = InteriorPoint(freed, plan, room=0.02, stages=stages)
        found = point.run(tolerance=tolerance, violation=violation, most=min(MOST, most), watch=watch)
    # Remove everything that belongs to the duration.
    rows = found.row_size[stages.owners != len(problem.constraint_terms)]
    found = dataclasses.replace(
        found, plan=Motion(in_c_order(found.plan.states[:, :n]), found.plan.controls),
        gain=in_c_order(found.gain[:, :, :n]), multipliers=found.multipliers[:-1], row_size=rows,
    )  # fmt: skip
    duration = float(np.clip(point.point.plan.states[0, n], *problem.duration))
    return settled(problem, duration), found


def settled(problem: Problem, duration: float) -> Problem:
    """The problem with a fixed duration, in seconds."""
    return dataclasses.replace(problem, dt=duration / problem.steps, duration=None, time_weight=0.0)


def with_duration(problem: Problem) -> Problem:
    """The problem with its duration as the last state.

    Raises:
      InputError: a part of the problem cannot be stated with one more state.
    """
    assert problem.duration is not None
    dynamics, n = problem.dynamics, len(problem.dynamics.state_coordinates)
    stated, (low, high) = problem.steps * problem.dt, problem.duration
    initial = problem.initial
    if isinstance(initial, FixedState):
        initial = FixedState(np.append(initial.numbers, stated))
    else:
        initial = CostSum(tuple(_longer_cost(cost, n) for cost in terms_of(initial)))
    stage, final = (
        tuple(_longer_cost(cost, n) for cost in terms_of(costs)) for costs in (problem.stage_cost, problem.final_cost)
    )
    time = SymbolicCost(lambda x, u, p: p.weight * x[n], parameters={"weight": problem.time_weight}, convex=True)
    bounds = SymbolicConstraint(
        lambda x, u, p: [x[n] - p.low, p.high - x[n]], parameters={"low": low, "high": high}, at="final"
    )
    return Problem(
        dynamics=_scaled(dynamics, stated), dt=problem.dt, steps=problem.steps, initial=initial,
        stage_cost=CostSum(stage), final_cost=CostSum((*final, time)), control_limits=problem.control_limits,
        constraints=(*(_longer(one, dynamics.state_coordinates.names) for one in problem.constraints), bounds),
        begin=problem.begin,
    )  # fmt: skip


def _scaled(dynamics: Dynamics, stated: float) -> Dynamics:
    """The dynamics with the duration as last state; at the stated duration they are unchanged."""
    space, controls, n = dynamics.state_coordinates, dynamics.control_coordinates, len(dynamics.state_coordinates)
    names = space.names

    def f(x: Any, u: Any, p: Any) -> list[Any]:
        share = x[n] / getattr(p, STATED)
        return [*(share * rate for rate in dynamics.f(x[:n], u, p)), 0]

    return Dynamics(
        f, states=dict(zip(names, space.units, strict=True)) | {STATE: "s"},
        controls=dict(zip(controls.names, controls.units, strict=True)),
        parameters=dict(dynamics.parameters) | {STATED: stated}, disturbances=dynamics.disturbances,
        position=tuple(names[i] for i in space.position), plane=space.plane, offset=space.offset,
        angles=tuple(names[i] for i in space.angles),
        rotation_vectors=tuple(names[i : i + 3] for i in space.rotation_vectors),
        control_limits=(controls.low, controls.high),
    )  # fmt: skip


def _longer_cost(cost: Cost, n: int) -> Cost:
    """A cost of n states as a cost of n + 1, independent of the last."""
    if isinstance(cost, QuadraticCost):
        return QuadraticCost(np.pad(cost.weight, (0, 1)), about=np.append(cost.about, 0.0))
    if isinstance(cost, SymbolicCost):
        return _of_fewer(cost, n)
    if isinstance(cost, (ControlCost, ObstacleCost)):
        return cost
    raise InputError(
        f"duration: got a {type(cost).__name__} beside it, want QuadraticCost, ControlCost, ObstacleCost and"
        " SymbolicCost, which can be stated for one more state"
    )


def _longer(constraint: Constraint, names: Sequence[str]) -> Constraint:
    """A constraint of the states of these names as one of these and another, independent of the last."""
    if isinstance(constraint, GoalState):
        goal = constraint.goal
        return GoalState(goal if isinstance(goal, dict) else dict(zip(names, goal.tolist(), strict=True)))
    if isinstance(constraint, SymbolicConstraint):
        return _of_fewer(constraint, len(names))
    if isinstance(constraint, (StateBounds, Clearance)):
        return constraint
    raise InputError(
        f"duration: got a {type(constraint).__name__} beside it, want GoalState, StateBounds, Clearance and"
        " SymbolicConstraint, which can be stated for one more state"
    )


def _of_fewer(stated: Stated, n: int) -> Stated:
    """A formula of n states as a formula of more."""
    other, function = copy.copy(stated), stated.function
    other.function = lambda x, u, p: function(x[:n], u, p)
    return other

"""The packaged robots by their own MJCFs: the problems of their scenarios, with MuJoCo's steps in place of formulas."""

from dataclasses import replace

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array

ORDER = (0, 1, 2, 6, 7, 8, 3, 4, 5, 9, 10, 11)  # the quadrotor's states in MuJoCo's order: positions, then velocities
FRAME = ("create_base_x", "create_base_y", "create_base_rz")  # the drive's states by their names in MuJoCo


def quadrotor(scenario: ls.Scenario, dynamics: ls.Dynamics) -> ls.Problem:
    """The scenario's problem for the dynamics of `MjcfRobot("cage")`: its states in another order."""
    problem = scenario.problem
    assert isinstance(problem.initial, ls.QuadraticCost)
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    return replace(
        problem, dynamics=dynamics, initial=_reordered(problem.initial), final_cost=_reordered(problem.final_cost)
    )


def _reordered(cost: ls.QuadraticCost) -> ls.QuadraticCost:
    order = list(ORDER)
    return ls.QuadraticCost(np.asarray(cost.weight)[np.ix_(order, order)], about=np.asarray(cost.about)[order])


def on_floor(robot: ls.MjcfRobot, pose: Array) -> Array:
    """The state (16,) of the drive at rest at a place and heading (3,), as deep in the floor as it sinks."""
    state = robot.at()
    for _ in range(10):
        state = robot.dynamics.step(state, np.zeros(2), 0.2)
    height = float(state[robot.dynamics.state_coordinates.names.index("create_base_z")])
    return robot.at(None, create_base_z=height, **dict(zip(FRAME, map(float, pose), strict=True)))


def drive(scenario: ls.Scenario, robot: ls.MjcfRobot) -> ls.Problem:
    """The scenario's problem for `MjcfRobot("arena")`, from exactly its start, which is on the floor."""
    problem = scenario.problem
    assert isinstance(problem.initial, ls.QuadraticCost)
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    names = robot.dynamics.state_coordinates.names
    weight = np.zeros(len(names))
    weight[[names.index(name) for name in FRAME]] = np.diag(problem.final_cost.weight)
    return replace(
        problem, dynamics=robot.dynamics, initial=ls.FixedState(on_floor(robot, np.asarray(problem.initial.about))),
        final_cost=ls.QuadraticCost(weight, about=on_floor(robot, np.asarray(problem.final_cost.about))),
    )  # fmt: skip

"""Checks that controller, plan and plant of a run fit together, and that it is not too large."""

import numpy as np

from lqrsim.control.controllers import Controller
from lqrsim.errors import InputError, check_items, check_memory, check_text
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.plan import Plan
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.world import World
from lqrsim.simulation.physics import part_of
from lqrsim.simulation.plant import MOST_STEPS, Plant


def shape_among(plant: Plant, moving: World | None, time: float) -> ShapeInWorld | None:
    """The robot's shape among obstacles that MuJoCo does not have, at this time in s."""
    if moving is None:
        return None
    robot = plant.robot
    if twice := sorted({*moving.names} & {*plant.obstacles, *plant.world.names}):
        raise InputError(f"moving: got {twice[0]}, which is an obstacle of the scene, want another name")
    return robot.among(moving.moved(time))


def coordinates_of(controller: Controller, plant: Plant) -> tuple[Coordinates, Coordinates]:
    """The coordinates of the controller's states and controls. Raises InputError unless they match the plant's."""
    dynamics = plant.robot.dynamics
    kind = type(controller).__name__
    check_text(f"{kind}.digest", controller.digest, "a hash as text")
    wanted_kind = "Coordinates of states and of controls"
    spaces = check_items(f"{kind}.coordinates", controller.coordinates, Coordinates, wanted_kind)
    if len(spaces) != 2:
        raise InputError(f"{kind}.coordinates: got {len(spaces)}, want two: of the states, of the controls")
    check_same_system(
        "controller", "a policy", (spaces[0], spaces[1]), spaces_of(dynamics), f"robot {plant.robot.name}"
    )
    meant, moves = spaces[0], dynamics.state_coordinates
    if (meant.position, meant.plane, meant.offset) != (moves.position, moves.plane, moves.offset):
        raise InputError(
            f"controller: got a policy for a position {_place(meant)}, want the position of robot {plant.robot.name}:"
            f" {_place(moves)}"
        )
    # A command that the robot clips is at a limit, whatever limits the policy assumed.
    own = dynamics.control_coordinates
    low, high = np.maximum(spaces[1].low, own.low), np.minimum(spaces[1].high, own.high)
    return spaces[0], spaces[1].limited((low, high))


def check_plan(given: Plan, plant: Plant) -> None:
    """Raise InputError unless the plan is finite, and has the plant's states and controls."""
    plan, dynamics = given.trajectory, plant.robot.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    if plan.states.shape[1] != n or plan.controls.shape[1] != m:
        shapes = f"{plan.states.shape[1]} states and {plan.controls.shape[1]} controls"
        raise InputError(f"plan: got {shapes}, want {n} states and {m} controls, as the robot has")
    if not plan.finite:
        raise InputError(f"plan: got a plan that is not finite ({given.status.name}), want one that can be run")


def check_size(plant: Plant, plan: Trajectory, substeps: int, trials: int, *, frames: bool) -> None:
    """Raise InputError for a run that takes too many physics steps or too much memory."""
    if plan.steps * substeps > MOST_STEPS:
        raise InputError(
            f"plan: got {plan.steps} control periods of {plan.dt:g} s, which takes {plan.steps * substeps}"
            f" physics steps, want at most {MOST_STEPS}"
        )
    n, m = plan.states.shape[1], plan.controls.shape[1]
    pictures = plan.steps * (substeps // part_of(plant, substeps)) + 1 if frames else 1
    numbers = (plan.steps + 1) * 3 * (2 * n + 2 * m + 6 + 1) + 2 * pictures * plant.model.nq + 3 * len(plant.world)
    check_memory("trials", trials, 8 * numbers + 2000, "whose records")


def _place(space: Coordinates) -> str:
    names = ", ".join(space.names[index] for index in space.position) or "of no states"
    plane = f" in the plane {space.plane!r}" if len(space.plane) == 2 else ""
    return f"({names}){plane}" + ("" if space.offset is None else f" at {space.offset:g} m")

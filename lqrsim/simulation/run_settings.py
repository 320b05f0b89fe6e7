"""The options of `simulate`, with checks that they are valid and that controller, plan and plant fit together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Count, Index, Progress, Seed, Want, checked
from lqrsim.control.controllers import Controller, ControllerLike, as_controller
from lqrsim.errors import Array, InputError, check_array, check_items, check_memory, check_text
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.problem.noise import Noise
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.goal import Target
from lqrsim.results.plan import Plan
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.world import World
from lqrsim.simulation.disturbances import Disturbance, as_disturbances
from lqrsim.simulation.effects import MakeGenerator
from lqrsim.simulation.physics import part_of
from lqrsim.simulation.plant import MOST_STEPS, Plant
from lqrsim.solvers.parallel import check_threads

Watch = Annotated[
    Callable[[float, Array, npt.NDArray[np.bool_]], object],
    Want("a function of the time, MuJoCo's qpos and which trials are unstable"),
]

MOVING = "a World of the obstacles, such as ls.World([ls.Obstacle(..., velocity=...)])"


@checked
@dataclass(kw_only=True, eq=False)
class RunSettings:
    """The arguments of `simulate`, with the same names, meanings and defaults, and what follows from them.

    Attributes:
      starts: (K, n), where the trials begin; by default in the plan's first state. knot: number of the plan's knot at
        which they begin. Both are for `simulate_from`.
      acting: the disturbances, each `Noise` as a StateNoise.
      whole: the plan's trajectory from its own first knot on.
      followed: the plan of the run: the given one, or else the controller's own; from the knot on.
      states, controls: coordinates of the controller, with limits within the robot's limits.
      radius: distance from the goal within which it counts as reached, in `Target.unit`.
      passing: the robot's shape among the moving obstacles, where they are at the knot; None without any.
      substeps: physics steps per control period.
    """

    _prefix = ""

    plant: Plant
    plan: Plan | None = None
    controller: ControllerLike | None = None
    disturbances: Sequence[Disturbance | Noise] = ()
    seed: Seed = 0
    trials: Count = 1
    first_trial: Seed = 0
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    frames: bool = True
    contacts: bool = True
    threads: int | None = None
    generators: MakeGenerator | None = None
    progress: Progress | None = None
    watch: Watch | None = None
    starts: Array | None = None
    knot: Index = 0
    moving: Annotated[World, Want(MOVING)] | None = None
    acting: tuple[Disturbance, ...] = field(init=False)
    law: Controller = field(init=False)
    whole: Trajectory = field(init=False)
    followed: Plan = field(init=False)
    states: Coordinates = field(init=False)
    controls: Coordinates = field(init=False)
    radius: float = field(init=False)
    passing: ShapeInWorld | None = field(init=False)
    substeps: int = field(init=False)

    def __post_init__(self) -> None:
        self.acting = as_disturbances(self.disturbances, "disturbances, such as ControlNoise(0.05)")
        self.threads = check_threads(self.threads)
        self.law, plan = as_controller(self.controller, self.plan, self.plant.robot.dynamics)
        self.states, self.controls = _check_coordinates(self.law, self.plant)
        _check_plan(plan, self.plant)
        self.whole = plan.trajectory
        if self.knot >= self.whole.steps:
            raise InputError(f"knot: got {self.knot}, want one from 0 to {self.whole.steps - 1}, before the plan's end")
        self.followed = plan.shifted(self.knot, horizon="shrinking") if self.knot else plan
        if self.starts is not None:
            self.starts = check_array("states", self.starts, (self.trials, self.whole.states.shape[1]))
        target = Target(self.states, self.followed.goal, self.trajectory.states)
        self.radius = target.radius(self.plant.robot.radius, self.goal_radius, self.goal_tolerance)
        self.substeps = self.plant.substeps(self.trajectory.dt)
        self.passing = _passing(self.plant, self.moving, self.knot * self.trajectory.dt)
        _check_size(self.plant, self.trajectory, self.substeps, self.trials, frames=self.frames)

    def radius_about(self, goal: Array) -> float:
        """The distance from another goal (n,) within which it counts as reached; by default in another unit."""
        plan = self.trajectory.states
        target, given = Target(self.states, goal, plan), (self.goal_radius, self.goal_tolerance)
        same_unit = target.unit == Target(self.states, self.followed.goal, plan).unit
        return target.radius(self.plant.robot.radius, *(given if same_unit else (None, None)))

    @property
    def trajectory(self) -> Trajectory:
        return self.followed.trajectory


def _passing(plant: Plant, moving: World | None, time: float) -> ShapeInWorld | None:
    """The robot's shape among obstacles that MuJoCo does not have, at this time in s."""
    if moving is None:
        return None
    robot = plant.robot
    if twice := sorted({*moving.names} & {*plant.obstacles, *plant.world.names}):
        raise InputError(f"moving: got {twice[0]}, which is an obstacle of the scene, want another name")
    return robot.among(moving.moved(time))


def _check_coordinates(controller: Controller, plant: Plant) -> tuple[Coordinates, Coordinates]:
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


def _check_plan(given: Plan, plant: Plant) -> None:
    """Raise InputError unless the plan is finite, and has the plant's states and controls."""
    plan, dynamics = given.trajectory, plant.robot.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    if plan.states.shape[1] != n or plan.controls.shape[1] != m:
        shapes = f"{plan.states.shape[1]} states and {plan.controls.shape[1]} controls"
        raise InputError(f"plan: got {shapes}, want {n} states and {m} controls, as the robot has")
    if not plan.finite:
        raise InputError(f"plan: got a plan that is not finite ({given.status.name}), want one that can be run")


def _check_size(plant: Plant, plan: Trajectory, substeps: int, trials: int, *, frames: bool) -> None:
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

"""The registered scenarios. To add one, add a function here."""

import inspect
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Bounds, Line, Positive, Seed, Want, checked
from lqrsim.errors import check_name, keep, renamed
from lqrsim.problem.obstacles import ObstacleCost
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import ControlCost, QuadraticCost
from lqrsim.results.goal import Target
from lqrsim.results.pickles import OneVersion
from lqrsim.results.solution import Solution
from lqrsim.robots.base import Robot
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor
from lqrsim.robots.sensors import Sensor
from lqrsim.scenes.scene import Scene, load_scene
from lqrsim.simulation.disturbances import ControlNoise, Disturbance, ForceNoise, MeasurementNoise, Push
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.simulator import Simulator
from lqrsim.solvers.settings import InitialPrior, StartLike, is_function, resolve


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Scenario(OneVersion):
    """A robot in a scene with a problem.

    Attributes:
      problem: the problem to solve; change it with `dataclasses.replace(scenario.problem, ...)`.
      tracking_bound: largest allowed distance of an undisturbed run from its plan, in metres.
      disturbances: the disturbances of the demo: clearly visible, but within the reach of the policy.
      start: initial guess of the solver, as in `smooth`, whenever the scenario is solved; by default several starts are
        tried.
      paper_start: the paper's start, for `smooth(problem, start=...)`, or to become the `start`.
      goal_radius: distance from the goal in metres within which it counts as reached; by default the robot's radius, or
        a tenth of the distance to the goal if the start is within the radius.
      goal_tolerance: the tolerance for goals without a position; both are as in `simulate`.
      simulator: the simulator that moves the robot, such as `ls.simulators.RotorPy()`; None for MuJoCo.
      fit_timestep: whether the plant has the longest physics step that divides the control period, as for a plan of a
        free duration; by default a control period that is not a multiple of the physics step is refused.
      sensors: sensors of the MJCF that the policy "offset_free" reads; by default it has the measured states.
    """

    name: Annotated[str, Want("a name")]
    summary: Line
    robot: Robot
    scene: Scene
    problem: Problem
    tracking_bound: Positive
    disturbances: Annotated[tuple[Disturbance, ...], Want("disturbances, such as ControlNoise(0.05)")] = ()
    start: StartLike = None
    paper_start: InitialPrior | None = None
    goal_radius: Positive | None = None
    goal_tolerance: Positive | None = None
    simulator: Annotated[Simulator, Want("a Simulator, or None for MuJoCo")] | None = None
    fit_timestep: bool = False
    sensors: Annotated[tuple[Sensor, ...], Want("a tuple of Sensor")] = ()

    def near_enough(self, goal_radius: float | None = None, goal_tolerance: float | None = None) -> dict[str, Any]:
        """The goal options of `simulate`: the given ones, or the scenario's own if neither is given."""
        if goal_radius is None and goal_tolerance is None:
            goal_radius, goal_tolerance = self.goal_radius, self.goal_tolerance
        return {"goal_radius": goal_radius, "goal_tolerance": goal_tolerance}

    def target_radius(
        self, goal_radius: float | None = None, goal_tolerance: float | None = None, *, target: Target | None = None
    ) -> float:
        """The distance from the goal within which it counts as reached, in `Target.unit`.

        The default target is that of a plan that starts at the problem's start.
        """
        if target is None:
            space, start = self.problem.dynamics.state_coordinates, self.problem.start
            plan = np.zeros((1, len(space))) if start is None else start[None]
            target = Target(space, self.problem.weighed_goal, plan)
        return target.radius(self.robot.radius, **self.near_enough(goal_radius, goal_tolerance))

    def __repr__(self) -> str:
        return f"Scenario({self.name!r}: {self.summary})"

    def __post_init__(self) -> None:
        if not is_function(self.start):  # a function is called when the scenario is solved
            resolve(self.start, self.problem)

    def plant(self) -> Plant:
        """The robot in its scene, ready to run: one plant, which is made when first needed."""
        if "_plant" not in vars(self):
            plant = Plant(self.robot, self.scene, self.simulator)
            keep(self, _plant=plant.for_period(self.problem.dt) if self.fit_timestep else plant)
        return vars(self)["_plant"]

    @checked
    def with_duration_of(self, plan: Solution) -> "Scenario":
        """The scenario in which a plan runs: if its problem has a free duration, that with the duration of the plan.

        The physics step of its plant then divides the control period of the plan.
        """
        if self.problem.duration is None:
            return self
        return replace(self, problem=self.problem.with_duration_of(plan), fit_timestep=True)

    settled = renamed("settled", "with_duration_of")


def names() -> list[str]:
    """The names of the registered scenarios: the public functions of this module that return a Scenario, but `get`."""
    functions = {name: item for name, item in globals().items() if inspect.isfunction(item) and name[0] != "_"}
    return sorted(
        name for name, f in functions.items() if f.__annotations__.get("return") is Scenario and name != "get"
    )


def get(name: str) -> Scenario:
    """The registered scenario of a name, with its default settings."""
    return globals()[check_name("scenario", name, names())]()


def differential_drive() -> Scenario:
    """The iRobot Create among eleven pillars: Fig. 2, with the authors' weights."""
    robot, scene = DifferentialDrive(), load_scene("arena")
    start, goal, nominal = (0.0, -2.5, np.pi), (0.0, 2.5, np.pi), (0.25, 0.25)
    weight = (5000.0, 5000.0, 50.0)
    problem = Problem(
        dynamics=robot.dynamics, dt=1 / 6, steps=150,
        initial=QuadraticCost(weight, about=start),
        stage_cost=ControlCost((60.0, 60.0), about=nominal)
        + ObstacleCost(scene.world, radius=robot.radius, sharpness=10.0),
        final_cost=QuadraticCost(weight, about=goal),
    )  # fmt: skip
    return Scenario(
        name="differential_drive", summary="the iRobot Create through an arena of pillars (Fig. 2)",
        robot=robot, scene=scene, problem=problem, tracking_bound=0.01,
        disturbances=(ControlNoise(0.05), ForceNoise((3.0, 3.0, 0.0)), MeasurementNoise((0.01, 0.01, 0.02))),
        # Facing the goal keeps the first linearisations sensible; the start faces sideways.
        paper_start=InitialPrior((0.0, 0.0, 0.4), about=(0.0, 0.0, np.pi / 2), iterations=2),
    )  # fmt: skip


@checked
def quadrotor(query: Annotated[int, Bounds(at_least=0, at_most=999_999)] = 0, seed: Seed = 0) -> Scenario:
    """The quadrotor through a cage of twelve beams, from one edge to the antipode: Fig. 3.

    Args:
      query: number of the random start and goal, from 0; see `quadrotor_queries`.
    """
    starts, goals = quadrotor_queries(query + 1, seed=seed)
    robot, scene = Quadrotor(), load_scene("cage")
    weight = np.full(12, 500.0)
    problem = Problem(
        dynamics=robot.dynamics, dt=1 / 30, steps=150,
        initial=QuadraticCost(weight, about=starts[query]),
        stage_cost=ControlCost(np.full(4, 20.0), about=np.full(4, robot.hover_force))
        + ObstacleCost(scene.world, radius=robot.radius, sharpness=10.0),
        final_cost=QuadraticCost(weight, about=goals[query]),
    )  # fmt: skip
    noise = MeasurementNoise(np.repeat((0.01, 0.02, 0.01, 0.02), 3).tolist())
    return Scenario(
        name="quadrotor", summary="the quadrotor through a cage of beams (Fig. 3)",
        robot=robot, scene=scene, problem=problem, tracking_bound=1e-6,
        disturbances=(ControlNoise(0.05), ForceNoise(0.1), noise, Push((0.2, 0.0, 0.0), at=3.0)),
        # Upright keeps the first linearisations sensible.
        paper_start=InitialPrior(np.repeat((0.0, 0.0, 0.3, 0.0), 3), about=np.zeros(12)),
    )  # fmt: skip


@checked
def quadrotor_queries(
    count: Annotated[int, Bounds(at_least=0, at_most=1_000_000)], *, seed: Seed = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Draw random starts and goals at rest, (count, 12) each. The first ones of a seed do not depend on `count`.

    A start lies on an edge of the cube of half-side 2.25 m: one coordinate uniform, the others at +-2.25 m with a
    jitter of +-0.01 m; its goal is the antipode.

    Returns:
      Starts and goals, each (count, 12).
    """
    rng = np.random.default_rng(seed)
    goals = np.zeros((count, 12))
    for goal in goals:
        edge = int(rng.integers(12))
        along, first, second = (edge // 4 + np.arange(3)) % 3
        goal[along] = rng.uniform(-2.25, 2.25)
        goal[first] = (2.25 if edge % 4 < 2 else -2.25) + rng.uniform(-0.01, 0.01)
        goal[second] = (2.25 if edge % 2 == 0 else -2.25) + rng.uniform(-0.01, 0.01)
    return -goals, goals

"""A robot in a viewer that plans again and again as it goes, on the wall's clock, to a goal that a person moves."""

from dataclasses import replace

import mujoco
import numpy as np

from lqrsim.control.controllers import Controller, ControllerRun
from lqrsim.control.replan_rule import ActivePlan
from lqrsim.control.replanner import LiveReplanner
from lqrsim.errors import Array, InputError
from lqrsim.problem.constraints import goals_of
from lqrsim.problem.costs import Cost, CostSum, QuadraticCost, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.scenes.scene import free_name
from lqrsim.simulation.plant import Plant
from lqrsim.view.viewer_base import Viewer

LONGEST_RUN = 600.0  # s; then a run starts again, for all of it is recorded
RECENT = 100  # solves that the caption's median is of
GOAL_RGBA = (1.0, 0.72, 0.05, 0.65)  # neither the plan's colour nor the trace's
GOAL_SIZE = 0.5  # of the robot's radius: a robot that is there can still be seen, and clicked on


class MovableGoal:
    """The place that a problem's final cost asks for.

    Attributes:
      place: where it is in the problem, (2 or 3,).

    Raises:
      InputError: it cannot be moved, for there is none, or more than one.
    """

    def __init__(self, problem: Problem) -> None:
        space = problem.dynamics.state_coordinates
        self._position = list(space.position)
        if not self._position:
            raise InputError("goal: got a robot without a position, want one with a position to move its goal")
        held = [space.names[i] for i in goals_of(problem.constraints, problem.dynamics) if i in self._position]
        if held:
            raise InputError(f"goal: got a GoalState that holds {', '.join(held)}, want a QuadraticCost to move it")
        self._terms = terms_of(problem.final_cost)
        found = [i for i, term in enumerate(self._terms) if self._weighs_place(term)]
        if len(found) != 1:
            raise InputError(
                f"goal: got {len(found)} QuadraticCosts of the position in final_cost, want one to move it"
            )
        (self._number,) = found
        self.place = self._cost.about[self._position]

    @property
    def _cost(self) -> QuadraticCost:
        cost = self._terms[self._number]
        assert isinstance(cost, QuadraticCost)
        return cost

    def _weighs_place(self, term: Cost) -> bool:
        return isinstance(term, QuadraticCost) and bool(term.weight[self._position].any())

    def cost_at(self, place: Array) -> Cost:
        """The final cost with the goal there, (2 or 3,); all else that it asks for stays."""
        about = self._cost.about.copy()
        about[self._position] = place
        terms = list(self._terms)
        terms[self._number] = QuadraticCost(self._cost.weight, about=about)
        return terms[0] if len(terms) == 1 else CostSum(tuple(terms))


def model_with_goal(plant: Plant, goal: MovableGoal) -> tuple[mujoco.MjModel, str]:
    """The plant's model with a body that is the goal, which mice can drag and nothing collides with; and its name."""
    spec = mujoco.MjSpec.from_string(plant.scene.xml)
    space, radius = plant.robot.dynamics.state_coordinates, GOAL_SIZE * plant.robot.radius
    name = free_name("goal", [body.name for body in spec.bodies])
    body = spec.worldbody.add_body(name=name, mocap=True, pos=space.in_world(goal.place))
    flat = space.from_above
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER if flat else mujoco.mjtGeom.mjGEOM_SPHERE
    size = np.array([radius, 0.1 * radius if flat else 0.0, 0.0])
    body.add_geom(type=kind, size=size, rgba=GOAL_RGBA, contype=0, conaffinity=0)
    return spec.compile(), name


class ViewedReplanner(Controller):
    """A live re-planner as the controller of one run, and what a viewer shows of it.

    What it decides depends on how fast this machine is.
    """

    def __init__(self, live: LiveReplanner, plant: Plant, viewer: Viewer, goal: MovableGoal | None) -> None:
        self.live, self.plant, self.viewer, self.goal = live, plant, viewer, goal

    def start(self, trials: int) -> ControllerRun:
        """The run of the one robot there is."""
        return _ViewedRun(self)

    @property
    def digest(self) -> str:
        """Of what it plans for; what it decides depends on the clock, too."""
        return sha256(f"live {self.live.problem.digest}")[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        policy = self.live.active.plan.policy
        return policy.state_coordinates, policy.control_coordinates


class _ViewedRun(ControllerRun):
    """It begins with the goal and the plan at the problem's own."""

    def __init__(self, of: ViewedReplanner) -> None:
        self._live, self._plant, self._viewer, self._goal = of.live, of.plant, of.viewer, of.goal
        self._place = np.zeros(0) if of.goal is None else of.goal.place  # that is planned for
        if of.goal is not None:
            of.viewer.move_goal(of.goal.place)
        self._show(of.live.active)

    def control(self, step: int, measured: Array) -> Array:
        live, t = self._live, step * self._live.problem.dt
        self._take_goal()
        before = live.active
        command = live.step(measured[0], t)
        if live.active is not before:
            self._show(live.active)
        self._viewer.remark = caption(live, t)
        return command[None]

    def summary(self) -> str:
        return self._live.summary()

    def _take_goal(self) -> None:
        """Plan for where the person has moved the goal to."""
        if self._goal is None or np.array_equal(self._viewer.goal, self._place):
            return
        self._place = self._viewer.goal
        self._live.change(final_cost=self._goal.cost_at(self._place))

    def _show(self, active: ActivePlan) -> None:
        plan = active.plan.trajectory
        balls = self._plant.record_of_balls(plan.states, plan.states[None])
        self._viewer.follow(plan, balls, begins=active.first * plan.dt)


def caption(live: LiveReplanner, t: float) -> str:
    """Which law is in force at a time and how the solves went, in lines, with what may be long at the end."""
    begun, log = live.active.first * live.problem.dt, live.log
    took, kept = [1e3 * one.seconds for one in log.records[-RECENT:]], log.kept
    if not took:
        solves = "no solve yet"
    else:
        solves = f"solve {took[-1]:.1f} ms, median {np.median(took):.1f} ms; {log.solved} used"
    if kept:
        reasons = "; ".join(f"{count} {why}" for why, count in kept.most_common())
        for status in Status:
            reasons = reasons.replace(status.name, status.value)  # in words
        solves += f"\n{kept.total()} missed: {reasons}"
    name = f"plan of {begun:.1f} s" if live.active.first else "first plan"
    return f"in force: {name}, {t - begun:.1f} s old\n{solves}"


def lengthened(solution: Solution) -> Solution:
    """The solution with a plan that stays at its end, for as long as a run may be: its law is the re-planner's."""
    plan, policy = solution.trajectory, solution.policy
    more = max(int(LONGEST_RUN / plan.dt) - plan.steps, 0)

    def stays(array: Array) -> Array:
        return np.concatenate([array, np.repeat(array[-1:], more, axis=0)])

    laws = {name: stays(getattr(policy, name)) for name in ("gain", "offset", "nominal")}
    return replace(
        solution, trajectory=Trajectory(stays(plan.states), stays(plan.controls), plan.dt),
        policy=replace(policy, **laws), inverse_policy=None, cost_to_go=None, cost_to_come=None, clearance=None,
        multipliers=(), candidates=(),
    )  # fmt: skip

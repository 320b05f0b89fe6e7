"""Live re-planning in a viewer, in wall-clock time, to a goal that a person may move."""

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

LONGEST_RUN = 600.0  # s, after which a run restarts, for all of it is recorded
RECENT = 100  # number of solves whose median the caption shows
GOAL_RGBA = (1.0, 0.72, 0.05, 0.65)  # neither the colour of the plan nor that of the trace
GOAL_SIZE = 0.5  # relative to the robot's radius: a robot at the goal can still be seen and clicked


class MovableGoal:
    """The goal position of a problem's final cost, which can be moved.

    Attributes:
      place: the goal in the problem, (2 or 3,).

    Raises:
      InputError: the final cost has no goal position, or several.
    """

    def __init__(self, problem: Problem) -> None:
        space = problem.dynamics.state_coordinates
        self._position = list(space.position)
        if not self._position:
            raise InputError("goal: got a robot without a position, want one with a position to move its goal")
        held = [space.names[i] for i in goals_of(problem.constraints, problem.dynamics) if i in self._position]
        if held:
            raise InputError(
                f"goal: got a GoalState that holds {', '.join(held)}, want a QuadraticCost, whose goal can be moved"
            )
        self._terms = terms_of(problem.final_cost)
        found = [i for i, term in enumerate(self._terms) if self._weighs_place(term)]
        if len(found) != 1:
            raise InputError(
                f"goal: got {len(found)} QuadraticCosts of the position in final_cost, want one to move its goal"
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
        """The final cost with its goal at another place (2 or 3,)."""
        about = self._cost.about.copy()
        about[self._position] = place
        terms = list(self._terms)
        terms[self._number] = QuadraticCost(self._cost.weight, about=about)
        return terms[0] if len(terms) == 1 else CostSum(tuple(terms))


def model_with_goal(plant: Plant, goal: MovableGoal) -> tuple[mujoco.MjModel, str]:
    """The plant's model with a body for the goal, which a mouse can drag and nothing collides with; and its name."""
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
    """A live re-planner as the controller of a run that a viewer shows.

    Its decisions depend on the speed of this machine.
    """

    def __init__(self, live: LiveReplanner, plant: Plant, viewer: Viewer, goal: MovableGoal | None) -> None:
        self.live, self.plant, self.viewer, self.goal = live, plant, viewer, goal

    def start(self, trials: int) -> ControllerRun:
        """The run of the single robot."""
        return _ViewedRun(self)

    @property
    def digest(self) -> str:
        """Hash of its problem; its decisions also depend on the clock."""
        return sha256(f"live {self.live.problem.digest}")[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        policy = self.live.active.plan.policy
        return policy.state_coordinates, policy.control_coordinates


class _ViewedRun(ControllerRun):
    """A run, which begins with the goal and the plan of the problem."""

    def __init__(self, of: ViewedReplanner) -> None:
        self._live, self._plant, self._viewer, self._goal = of.live, of.plant, of.viewer, of.goal
        self._place = np.zeros(0) if of.goal is None else of.goal.place  # of the goal that is planned for
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
        """Plan for the goal where the person has moved it."""
        if self._goal is None or np.array_equal(self._viewer.goal, self._place):
            return
        self._place = self._viewer.goal
        self._live.change(final_cost=self._goal.cost_at(self._place))

    def _show(self, active: ActivePlan) -> None:
        plan = active.plan.trajectory
        balls = self._plant.record_of_balls(plan.states, plan.states[None])
        self._viewer.follow(plan, balls, begins=active.first * plan.dt)


def caption(live: LiveReplanner, t: float) -> str:
    """The plan in force and its age, and statistics of the solves, as lines."""
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
    """The solution with its end repeated up to the longest run, for `simulate`; the control is the re-planner's."""
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

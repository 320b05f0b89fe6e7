"""A robot in a viewer that plans again and again as it goes, on the wall's clock, to a goal that a person moves."""

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np

from lqrsim.control.controllers import Control, Controller
from lqrsim.control.planner import Planner
from lqrsim.control.replanner import Law
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.simulation.plant import Plant
from lqrsim.view.movable_goal import MovableGoal
from lqrsim.view.viewer_base import Viewer

LONGEST_RUN = 600.0  # s; then a run starts again, for all of it is recorded
RECENT = 100  # solves that the caption's median is of


class LivePlanner(Controller):
    """A `Planner` as the controller of a live run, and what a viewer shows of it. Use it with `with`.

    Its thread begins and ends with the block. What it decides depends on how fast this machine is.
    """

    def __init__(
        self, planner: Planner, plant: Plant, viewer: Viewer, goal: MovableGoal | None, ended: Callable[[str], object]
    ) -> None:
        self.planner, self.plant, self.viewer, self.goal, self.ended = planner, plant, viewer, goal, ended
        self._place = np.zeros(0) if goal is None else goal.place  # that is planned for

    def __enter__(self) -> Self:
        """Start its thread, with the goal and the plan at the problem's own."""
        if self.goal is not None:
            self.viewer.move_goal(self.goal.place)
        self._show(self.planner.law)
        self.planner.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self.planner.__exit__()
        self.ended(self.planner.summary())

    def start(self, trials: int) -> Control:
        """The law of the one robot there is."""
        planner, dt = self.planner, self.planner.problem.dt

        def control(step: int, shown: Array) -> Array:
            self._take_goal()
            before = planner.law
            command = planner.step(shown[0], step * dt)
            if planner.law is not before:
                self._show(planner.law)
            self.viewer.remark = caption(planner, step * dt)
            return command[None]

        return control

    @property
    def digest(self) -> str:
        """Of what it plans for; what it decides depends on the clock, too."""
        return sha256(f"live {self.planner.problem.digest}")[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        policy = self.planner.law.plan.policy
        return policy.state_coordinates, policy.control_coordinates

    def _take_goal(self) -> None:
        """Plan for where the person has moved the goal to."""
        if self.goal is None or np.array_equal(self.viewer.goal, self._place):
            return
        self._place = self.viewer.goal
        self.planner.change(final_cost=self.goal.cost_at(self._place))

    def _show(self, law: Law) -> None:
        plan = law.plan.trajectory
        balls = self.plant.record_of_balls(plan.states, plan.states[None])
        self.viewer.follow(plan, balls, begins=law.first * plan.dt)


def caption(planner: Planner, t: float) -> str:
    """Which law is in force at a time and how the solves went, in lines, with what may be long at the end."""
    begun, account = planner.law.first * planner.problem.dt, planner.account
    took, kept = [1e3 * one.seconds for one in account.records[-RECENT:]], account.kept
    if not took:
        solves = "no solve yet"
    else:
        solves = f"solve {took[-1]:.1f} ms, median {np.median(took):.1f} ms; {account.solved} used"
    if kept:
        reasons = "; ".join(f"{count} {why}" for why, count in kept.most_common())
        for status in Status:
            reasons = reasons.replace(status.name, status.value)  # in words
        solves += f"\n{kept.total()} missed: {reasons}"
    name = f"plan of {begun:.1f} s" if planner.law.first else "first plan"
    return f"in force: {name}, {t - begun:.1f} s old\n{solves}"


def lengthened(solution: Solution) -> Solution:
    """The solution with a plan that stays at its end, for as long as a run may be: its law is the planner's."""
    plan, policy = solution.trajectory, solution.policy
    more = max(int(LONGEST_RUN / plan.dt) - plan.steps, 0)

    def stays(array: Array) -> Array:
        return np.concatenate([array, np.repeat(array[-1:], more, axis=0)])

    laws = {name: stays(getattr(policy, name)) for name in ("gain", "offset", "nominal")}
    return replace(
        solution, trajectory=Trajectory(stays(plan.states), stays(plan.controls), plan.dt),
        policy=replace(policy, **laws), inverse_policy=None, cost_to_go=None, cost_to_come=None, clearance=None,
        multipliers=(),
    )  # fmt: skip

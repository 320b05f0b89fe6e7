"""Solving again as a robot goes: what is solved, from where, and how that went. Who runs it is another matter.

`replanning.py` runs it in simulations, of many robots at once, `planner.py` on a robot, in a thread of its own, and
`replanned.py` within output feedback.
"""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from lqrsim.errors import Array, InputError, check_count, check_flag, check_kind, check_name, check_number, excerpt
from lqrsim.problem.problem import Problem
from lqrsim.results.funnel import Funnel
from lqrsim.results.replan import Replan
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import HORIZONS
from lqrsim.solvers import compiled
from lqrsim.solvers.initial_guess import InitialGuess
from lqrsim.solvers.prepared import prepare


@dataclass(frozen=True)
class Law:
    """What is in force, or will be: a plan with its law, and the step that it begins at."""

    plan: Solution | Replan
    first: int

    def row(self, step: int) -> int:
        """Which of its laws is in force at a step: after its horizon the last one."""
        return min(max(step - self.first, 0), self.plan.trajectory.steps - 1)


@dataclass(frozen=True)
class Task:
    """What is to be solved: at a step, for a law that begins at another, from a state (n,) and with a law."""

    step: int
    first: int
    state: Array
    start: Solution | Replan | InitialGuess
    problem: Problem


@dataclass(frozen=True, kw_only=True)
class ReplanRecord:
    """How one solve went.

    Attributes:
      step: the control period in which it began.
      trial: of a simulation, else 0.
      status: how the solve ended.
      iterations: how many it took.
      seconds: how long it took.
      cost: of the new plan.
      before: cost of continuing with the law in force.
      used: whether its plan came into force.
      reason: why not, or why it is no better; empty if all went well.
    """

    step: int
    trial: int
    status: str
    iterations: int
    seconds: float
    cost: float
    before: float
    used: bool
    reason: str

    def __post_init__(self) -> None:
        for name in ("step", "trial", "iterations"):
            check_count(f"ReplanRecord: {name}", getattr(self, name), at_least=0)


class Account:
    """How solves went.

    Attributes:
      records: one a solve. solved: how many were used. kept: why others were not, and the law before went on: reason ->
        how many.
    """

    def __init__(self) -> None:
        self.records: list[ReplanRecord] = []
        self.solved, self.kept = 0, Counter[str]()

    def enter(self, step: int, trial: int, replan: Replan, *, late: bool = False) -> bool:
        """Count a solve; whether its plan is to be used."""
        reason = "" if replan.success else replan.status.name
        if late:
            reason = "not ready in time"
        elif not replan.improved and not replan.success:
            reason = f"{replan.status.name}, without a better plan"
        finite = np.isfinite(replan.cost)
        used = finite and not late and (replan.success or replan.improved)
        if not finite:
            reason = "the law before leads to infinity by the model"
        self.solved += used
        if not used:
            self.kept[reason] += 1
        self.records.append(
            ReplanRecord(
                step=step, trial=trial, status=replan.status.name, iterations=replan.iterations, seconds=replan.seconds,
                cost=replan.cost, before=replan.before, used=used, reason=reason,
            )
        )  # fmt: skip
        return used

    def refuse(self, reason: str) -> None:
        """Count a solve that did not begin."""
        self.kept[reason] += 1

    def summary(self, *, times: bool = False) -> str:
        """How often it was solved, and why the law before went on where it did; with `times`, how long solves took."""
        line = f"solved again {self.solved} times"
        early = Counter(one.reason for one in self.records if one.used and one.reason)
        if early:
            line += f" ({', '.join(f'{count} {reason}' for reason, count in early.most_common())})"
        if self.kept:
            reasons = "; ".join(f"{count} times {reason}" for reason, count in self.kept.most_common())
            line += f", kept the law before {self.kept.total()} times: {reasons}"
        if times and self.records:
            took = 1e3 * np.array([one.seconds for one in self.records])
            line += f"; a solve took {np.median(took):.1f} ms in the median and {took.max():.1f} ms at most"
        return line


class Replanner:
    """What is solved, when and from where.

    Args:
      who: for messages. problem: that was solved. solution: its solution.
      every: seconds between two solves. deadline: seconds until its answer comes into force, by default a control
        period. Both are rounded to control periods, the deadline up.
      horizon: "shrinking", to the end of the first plan, or "moving", as long as that.
      predict: whether to solve from where the law in force leads by the deadline, or from the state at the beginning.
      when: a funnel of the solution, if solves are only for states outside it.
      share: of the funnel's level that counts as its boundary.

    Attributes:
      periods: control periods between two solves. delay: until the answer comes into force.
      solver: the prepared solver. account: how the solves of the last run went.

    Raises:
      InputError: as `Replanning`.
    """

    def __init__(
        self,
        who: str,
        problem: Problem,
        solution: Solution,
        every: float,
        *,
        name: str = "every",
        deadline: float | None = None,
        horizon: str = "shrinking",
        predict: bool = True,
        when: Funnel | None = None,
        share: float = 1.0,
    ) -> None:
        check_kind(f"{who}: problem", problem, Problem, "a Problem, such as scenario.problem")
        check_kind(f"{who}: solution", solution, Solution, "its Solution")
        dynamics, plan = problem.dynamics, solution.trajectory
        spaces = solution.policy.state_coordinates.names, solution.policy.control_coordinates.names
        if spaces != (dynamics.state_coordinates.names, dynamics.control_coordinates.names):
            raise InputError(f"{who}: solution: got one of another system, want the problem's")
        if (plan.steps, plan.dt) != (problem.steps, problem.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} steps of {problem.dt:g} s"
            raise InputError(f"{who}: solution: got {got}, want the problem's: {want}")
        self.every = check_number(f"{who}: {name}", every, at_least=0.999 * problem.dt)
        self.periods = round(self.every / problem.dt)
        self.deadline = check_number(f"{who}: deadline", problem.dt if deadline is None else deadline, at_least=0.0)
        self.delay = math.ceil(self.deadline / problem.dt - 1e-9)
        if self.delay > self.periods:
            raise InputError(
                f"{who}: deadline: got {self.deadline:g} s, {self.delay} control periods, want at most"
                f" {name}={self.every:g} s, {self.periods} control periods: one solve at a time"
            )
        self.horizon = check_name(f"{who}: horizon", horizon, HORIZONS)
        self.predict = check_flag(f"{who}: predict", predict)
        self.problem, self.solution, self.when = problem, solution, _checked_funnel(who, when, solution, horizon)
        self.share = check_number(f"{who}: share", share, above=0.0, at_most=1.0)
        if when is None and self.share != 1:
            raise InputError(f"{who}: share: got {self.share:g} without a funnel, want when=... beside it")
        self.solver = prepare(problem)
        self.account = Account()

    def start(self) -> Law:
        """The law to begin with; the last run is forgotten."""
        self.account = Account()
        return Law(self.solution, 0)

    def due(self, step: int) -> bool:
        """Whether a solve begins at a step."""
        left = self.horizon == "moving" or step + self.delay < self.problem.steps
        return step > 0 and step % self.periods == 0 and left

    def left(self, law: Law, step: int, state: Array, *, late: float = 0.0) -> bool:
        """Whether a state (n,), measured `late` seconds after a control period began, is outside the funnel.

        The funnel is about the plan in force, which is interpolated between two knots. Without a funnel all is outside.
        """
        if self.when is None:
            return True
        row, dt, states = law.row(step), self.problem.dt, law.plan.trajectory.states
        about = states[row]
        if late > 0:
            about = about + late / dt * self.when.state_coordinates.difference(states[row + 1], about)
        t = step * dt + late
        level = self.share * self.when.level(t)
        return not (level > 0 and self.when.deviation(state, t, about=about) <= level)

    def task(self, law: Law, step: int, state: Array, problem: Problem | None = None, *, late: float = 0.0) -> Task:
        """What is to be solved in a control period, of a state (n,) that was measured `late` seconds after it began."""
        plan, first = law.plan, step + self.delay
        row = law.row(step)
        here = plan.policy.state_coordinates.nearest(state, plan.policy.nominal[row])
        problem = self.problem if problem is None else problem
        if self.delay and self.predict:
            here = self._ahead(law, step, here, problem, late)
        done = min(first - law.first, plan.trajectory.steps - 1)
        return Task(step, first, here, plan.shifted(done, horizon=self.horizon), problem)

    def _ahead(self, law: Law, step: int, state: Array, problem: Problem, late: float) -> Array:
        """Where the law in force leads by the deadline, by the model."""
        policy, dt = law.plan.policy, problem.dt
        rows = [law.row(step + i) for i in range(self.delay)]
        if late > 1e-9 * dt:
            rest, now = problem.dynamics.period_near(dt - late), rows.pop(0)
            if rest > 0:
                state = compiled.rollout(problem, policy.gain[[now]], policy.offset[[now]], state, dt=rest)[0][-1]
        if rows:
            state = compiled.rollout(problem, policy.gain[rows], policy.offset[rows], state)[0][-1]
        return state

    def solve(self, task: Task, time_limit: float | None = None) -> Replan:
        """The answer, to a task that is due."""
        problem, after = task.problem, task.first
        if self.horizon == "moving":
            problem, after = problem.later(task.first * problem.dt), 0
        return self.solver.solve(task.state, task.start, problem=problem, after=after, time_limit=time_limit)


def _checked_funnel(who: str, when: Funnel | None, solution: Solution, horizon: str) -> Funnel | None:
    """Raises InputError unless it is None, or a funnel of the solution, whose end stays where it is."""
    check_kind(f"{who}: when", when, (Funnel, type(None)), "a Funnel, such as funnel(...) returns")
    if when is not None and not np.array_equal(when.plan.states, solution.trajectory.states):
        raise InputError(f"{who}: when: got a funnel of another plan, want that of the solution")
    if when is not None and horizon != "shrinking":
        raise InputError(f'{who}: when: got a funnel with horizon={excerpt(horizon)}, want "shrinking": it has an end')
    return when

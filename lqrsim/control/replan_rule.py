"""Re-planning: the rule that determines the problem, time and start of each solve; and the log of the solves.

`replanner.py` applies the rule in simulations or on a robot, and `filter_law.py` within output feedback.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lqrsim.annotations import LINE, Index, Line, Want, checked
from lqrsim.errors import Array, InputError, check_kind, check_number, excerpt
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import check_same_system, spaces_of
from lqrsim.results.funnel import Funnel
from lqrsim.results.plan import Plan, Replan
from lqrsim.solvers import compiled
from lqrsim.solvers.initial_guess import InitialGuess
from lqrsim.solvers.prepared import prepare

Changes = Annotated[Callable[[float, Problem], Problem], Want("a function of the time and the problem")]
LONGEST = 1e12  # control periods; more count as that many


@dataclass(frozen=True, eq=False)
class ActivePlan:
    """A plan that is in force, or will be."""

    plan: Plan
    first: int  # the control period at which it begins

    def row(self, step: int) -> int:
        """The index of the plan's law at a step; after the horizon, of the last law."""
        return min(max(step - self.first, 0), self.plan.trajectory.steps - 1)


@dataclass(frozen=True, eq=False)
class SolveRequest:
    """A solve to be done at a step, from a state (n,) and with a law, for a plan that begins at a later step."""

    step: int
    first: int
    state: Array
    start: Plan | InitialGuess
    problem: Problem
    previous: Array | None = None  # (m,) the last command before that step, for a problem with a `control_rate`


@checked
@dataclass(frozen=True, kw_only=True)
class ReplanRecord:
    """The record of one solve.

    Attributes:
      step: control period in which the solve began.
      trial: number of a simulation, else 0.
      before: cost of continuing with the law in force.
      reason: why the plan was not used, or the status with which it was used without having converged; empty if all
        went well. Such a plan may cost more than `before` if it violates the constraints less.
    """

    step: Index
    trial: Index
    status: Line
    iterations: Index
    seconds: float
    cost: float
    before: float
    used: bool
    reason: Annotated[str, 10 * LINE]


class ReplanLog:
    """The log of the solves of one run.

    Attributes:
      records: a `ReplanRecord` of each solve.
      solved: number of solves that were used, over all trials.
      kept: reason why a solve was not used or did not begin, and the previous law continued -> number of such solves.
    """

    def __init__(self) -> None:
        self.records: list[ReplanRecord] = []
        self.solved, self.kept = 0, Counter[str]()

    def enter(self, step: int, trial: int, replan: Replan, *, late: bool = False) -> bool:
        """Whether the new plan of a solve is used; `late` if it came after the deadline. Counts the solve."""
        status, used = replan.status.name, False
        if not np.isfinite(replan.cost):
            reason = "the previous law diverges by the model"
        elif late:
            reason = "not ready in time"
        elif not replan.improved and not replan.success:
            reason = f"{status}, without a better plan"
        else:
            used, reason = True, "" if replan.success else status
        self.solved += used
        if not used:
            self.kept[reason] += 1
        record = ReplanRecord(
            step=step, trial=trial, status=status, iterations=replan.iterations, seconds=replan.seconds,
            cost=replan.cost, before=replan.before, used=used, reason=reason,
        )  # fmt: skip
        self.records.append(record)
        return used

    def summary(self, *, times: bool = False) -> str:
        """The number of solves, and why the previous law continued, in one line; with `times`, how long solves took."""
        line = f"solved again {self.solved} times"
        early = Counter(record.reason for record in self.records if record.used and record.reason)
        if early:
            counts = ", ".join(f"{count} {reason}" for reason, count in early.most_common())
            line += f" ({early.total()} of these plans did not converge, but are no worse than continuing: {counts})"
        if self.kept:
            reasons = "; ".join(f"{count} times {reason}" for reason, count in self.kept.most_common())
            line += f", kept the previous law {self.kept.total()} times: {reasons}"
        if times and self.records:
            took = 1e3 * np.array([record.seconds for record in self.records])
            line += f"; a solve took {np.median(took):.1f} ms in the median and {took.max():.1f} ms at most"
        return line


def _fixed(problem: Problem) -> dict[str, object]:
    """The parts of a problem that must not change while a plan is in force, by field."""
    names = *problem.dynamics.state_coordinates.names, *problem.dynamics.control_coordinates.names
    return {"dt": problem.dt, "steps": problem.steps, "duration": problem.duration, "dynamics": ", ".join(names)}


class ReplanRule:
    """The problem that is solved, when, and from which state. Runs do not change it.

    Args:
      who, name: the user's call and its argument for `every`, in messages. The others are as in `Replanner`.

    Attributes:
      periods: control periods between two solves. delay: control periods until the answer comes into force.
    """

    def __init__(
        self, who: str, problem: Problem, solution: Plan, every: float, deadline: float, *, name: str = "every",
        horizon: str = "shrinking", predict: bool = True, when: Funnel | None = None, share: float = 1.0,
        changes: Changes | None = None,
    ) -> None:  # fmt: skip
        plan, want = solution.trajectory, spaces_of(problem.dynamics)
        check_same_system(f"{who}: solution", "a plan", spaces_of(solution.policy), want, "the problem")
        if (plan.steps, plan.dt) != (problem.steps, problem.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} steps of {problem.dt:g} s"
            raise InputError(f"{who}: solution: got {got}, want the problem's: {want}")
        self.every = check_number(f"{who}: {name}", every, above=0.0)
        if self.every < 0.999 * problem.dt:
            raise InputError(f"{who}: {name}: got {self.every:g} s, want at least a control period, {problem.dt:g} s")
        self.periods = round(min(self.every / problem.dt, LONGEST))
        self.deadline = check_number(f"{who}: deadline", deadline, at_least=0.0)
        self.delay = math.ceil(min(self.deadline / problem.dt, 2 * LONGEST) - 1e-9)
        if self.delay > self.periods:
            got = f"{self.deadline:g} s, {self.delay} control periods"
            most = f"{name}={self.every:g} s, {self.periods} control periods: one solve at a time"
            raise InputError(f"{who}: deadline: got {got}, want at most {most}")
        if when is not None and not np.array_equal(when.plan.states, plan.states):
            raise InputError(f"{who}: when: got a funnel of another plan, want a funnel of the solution")
        if when is not None and horizon != "shrinking":
            raise InputError(f'{who}: when: got a funnel with horizon={excerpt(horizon)}, want horizon="shrinking"')
        self.horizon, self.predict, self.share = horizon, predict, share
        self.problem, self.solution, self.when = problem, solution, when
        if when is None and self.share != 1:
            raise InputError(f"{who}: share: got {self.share:g} without a funnel, want when=... beside it")
        self.changes, self._who = changes, who
        self.solver = prepare(problem)
        solution.shifted(0)  # makes the parts of a Solution that are otherwise made at the first solve

    def problem_at(self, step: int, problem: Problem) -> Problem:
        """A problem as known in a control period, with the result of `changes`."""
        if self.changes is None:
            return problem
        return self.checked(f"{self._who}: changes", self.changes(step * self.problem.dt, problem))

    def checked(self, who: str, problem: Problem) -> Problem:
        """The problem. Raises InputError if it cannot replace the rule's own problem while a plan is in force."""
        check_kind(who, problem, Problem, "a Problem")
        wanted = _fixed(self.problem)
        for field, got in _fixed(problem).items():
            if got != (want := wanted[field]):
                raise InputError(f"{who}: {field}: got {got}, want {want}: it cannot change while a re-planner runs")
        return self.solver.check(problem)

    def due(self, step: int, before: int) -> bool:
        """Whether a solve is due at a step, and was not yet at the step `before`; -1 is before the first of all."""
        left = self.horizon == "moving" or step + self.delay < self.problem.steps
        return left and step // self.periods > before // self.periods

    def outside(self, active: ActivePlan, step: int, state: Array, *, late: float = 0.0) -> bool:
        """Whether a state (n,), measured `late` seconds after a control period began, is outside the funnel.

        The funnel is about the plan in force, which is interpolated between two knots. Without a funnel, every state is
        outside.
        """
        if self.when is None:
            return True
        row, dt, states = active.row(step), self.problem.dt, active.plan.trajectory.states
        about = states[row]
        if late > 0:
            about = about + late / dt * self.when.state_coordinates.difference(states[row + 1], about)
        t = step * dt + late
        level = self.share * self.when.level(t)
        return not (level > 0 and self.when.deviation(state, t, about=about) <= level)

    def request(
        self, active: ActivePlan, step: int, state: Array, problem: Problem, *, late: float = 0.0,
        sent: Array | None = None,
    ) -> SolveRequest:  # fmt: skip
        """The solve for a period, of a state (n,) measured `late` s after it began; `sent` (m,) is the last command."""
        plan, first = active.plan, step + self.delay
        here = plan.policy.state_coordinates.nearest(state, plan.policy.nominal[active.row(step)])
        if self.delay and (self.predict or problem.control_rate is not None):
            predicted, command = self._predicted(active, step, here, problem, late)
            here, sent = predicted if self.predict else here, sent if command is None else command
        done = min(first - active.first, plan.trajectory.steps - 1)
        previous = sent if problem.control_rate is not None else None
        return SolveRequest(step, first, here, plan.shifted(done, horizon=self.horizon), problem, previous)

    def _predicted(
        self, active: ActivePlan, step: int, state: Array, problem: Problem, late: float
    ) -> tuple[Array, Array | None]:
        """The state that the law in force reaches by the deadline, according to the model, and its last command."""
        policy, dt = active.plan.policy, problem.dt
        rows, controls = [active.row(step + i) for i in range(self.delay)], None
        if late > 1e-9 * dt:
            rest, now = problem.dynamics.period_near(dt - late), rows.pop(0)
            if rest > 0:
                states, controls = compiled.rollout(problem, policy.gain[[now]], policy.offset[[now]], state, dt=rest)
                state = states[-1]
        if rows:
            states, controls = compiled.rollout(problem, policy.gain[rows], policy.offset[rows], state)
            state = states[-1]
        return state, None if controls is None else controls[-1]

    def solve(self, request: SolveRequest, time_limit: float | None = None) -> Replan:
        problem, after = request.problem, request.first
        if self.horizon == "moving":
            problem, after = problem.later(request.first * problem.dt), 0
        return self.solver.solve(
            request.state, request.start, problem=problem, after=after, time_limit=time_limit, previous=request.previous
        )


def within_rates(commands: Array, problem: Problem, sent: Array | None) -> Array:
    """Commands (..., m) within the limits of rates after those of the period before; `sent` is None if there is none.

    Plans keep these limits, but feedback adds to their rates.
    """
    rate = problem.control_rate
    if rate is None or rate.limits is None or sent is None:
        return commands
    low, high = np.asarray(rate.limits) * problem.dt
    return np.clip(commands, sent + low, sent + high)

"""Re-planning: the rule that determines the problem, time and start of each solve; the log of the solves; and runs.

`Replanner` is for simulations of many trials, `LiveReplanner` for a robot's own loop, with a thread. Within output
feedback, `offset_free.py` applies the rule.
"""

import math
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, Bounds, Index, Line, Seed, Want, checked
from lqrsim.codegen.fingerprint import identity
from lqrsim.control.controllers import Controller, ControllerRun, evaluator
from lqrsim.errors import Array, InputError, check_array, check_function, check_kind, check_number, excerpt
from lqrsim.machine import processors
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.certified import Funnel
from lqrsim.results.coordinates import Spaces, check_same_system, spaces_of
from lqrsim.results.solution import Plan, Replan
from lqrsim.results.solution_parts import Horizon
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import workers
from lqrsim.solvers.prepared import prepare
from lqrsim.solvers.settings import InitialGuess

Changes = Annotated[Callable[[float, Problem], Problem], Want("a function of the time and the problem")]
LONGEST = 1e12  # control periods; more count as that many
Clock = Annotated[Callable[[], float], Want("a function that returns seconds")]
SPARE = 0.5e-3  # s, time between the end of a solve and its deadline, for handing over the answer


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

    def record(self, step: int, trial: int, replan: Replan, *, late: bool = False) -> bool:
        """Record a solve, `late` if it came after the deadline, and return whether its plan is used."""
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
        self.records.append(ReplanRecord(
            step=step, trial=trial, status=status, iterations=replan.iterations, seconds=replan.seconds,
            cost=replan.cost, before=replan.before, used=used, reason=reason,
        ))  # fmt: skip
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


def _unchangeable(problem: Problem) -> dict[str, object]:
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
        wanted = _unchangeable(self.problem)
        for field, got in _unchangeable(problem).items():
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


class LiveReplanner:
    """One run of a `Replanner` on a robot, made by `Replanner.live`: its own loop calls `step` as often as it likes.

    `step` evaluates the law in force, and never waits for a solve. A solve begins with the first call in a control
    period in which one is due; that call also asks for `changes` and predicts the state at the deadline. The answer
    comes into force at the deadline; one that is not ready then is not used. Everything is compiled before the first
    step.

    Attributes:
      problem: the problem that is solved from now on.
      active: the plan in force, `active.plan`, and the control period at which it begins, `active.first`.
      log: of the solves: `records`, a `ReplanRecord` of each; `solved`, how many were used; and `kept`, why others were
        not, and how often.
    """

    _prefix = "Replanner.live: "

    @checked
    def __init__(self, rule: ReplanRule, *, interpolate: bool, clock: Clock) -> None:
        if not rule.delay:
            raise InputError("Replanner.live: deadline: got 0 s, want more: a solve takes time")
        self._rule, self._clock, self._interpolate = rule, clock, interpolate
        self.problem, self.active, self.log = rule.problem, ActivePlan(rule.solution, 0), ReplanLog()
        self._asked = -1  # the step at which a solve was last due
        self._step, self._command, self._sent = -1, None, None  # of the last call, and the command of a period before
        self._pending: tuple[SolveRequest, Future[Replan]] | None = None
        self._missed = False  # whether the pending solve was not done at its deadline
        self._thread: ThreadPoolExecutor | None = None
        self._begun = False

    def __enter__(self) -> Self:
        if self._begun:
            raise InputError("LiveReplanner: got a second `with` on it, want a new replanner.live() for each run")
        self._thread, self._begun = ThreadPoolExecutor(1, thread_name_prefix="lqrsim re-planner"), True
        return self

    def __exit__(self, *exception: object) -> None:
        """End the thread, after its current solve."""
        if self._thread is not None:
            self._thread.shutdown()
            self._thread = None

    def summary(self) -> str:
        """The number of solves, their times, and why the previous law was kept, in a line."""
        return self.log.summary(times=True)

    def change(self, **parts: Any) -> None:
        """Change fields of the problem from the next solve on: `live.change(final_cost=...)`.

        Goals, weights, obstacles, parameters and limits can change; dt, steps, states and controls cannot. To change an
        estimate of a disturbance, plan with `dynamics.disturbed` from the beginning.
        """
        try:
            changed = replace(self.problem, **parts)
        except TypeError:
            known = ", ".join(name for name in Problem.__dataclass_fields__ if not name.startswith("_"))
            raise InputError(f"change: got {', '.join(parts)}, want fields of a Problem: {known}") from None
        self.problem = self._rule.checked("change", changed)

    def step(self, state: npt.ArrayLike, t: float) -> Array:
        """The control (m,) to apply in a measured state (n,), `t` seconds after the start."""
        if self._thread is None:
            raise InputError("LiveReplanner: got a step without its thread, want `with replanner.live() as live:`")
        t = check_number("t", t, at_least=0.0)
        state = check_array("state", state, (len(self.active.plan.policy.state_coordinates),))
        dt = self.problem.dt
        step = int(min(t / dt, LONGEST) + 1e-9)
        self._adopt_answer(step)
        if self._pending is None and self._rule.due(step, self._asked):
            self._ask(self._thread, state, t, step)
        policy = self.active.plan.policy
        command = policy(state, max(t - self.active.first * dt, 0.0), interpolate=self._interpolate)
        if step != self._step:
            self._step, self._sent = step, self._command
        self._command = within_rates(command, self.problem, self._sent)
        return self._command

    def _ask(self, thread: ThreadPoolExecutor, state: Array, t: float, step: int) -> None:
        """Begin a solve, of a state that is measured within a control period, unless that is in the funnel."""
        begun, dt = self._clock(), self.problem.dt
        late, self._asked = t - step * dt, step
        if not self._rule.outside(self.active, step, state, late=max(late, 0.0)):
            return
        problem = self._rule.problem_at(step, self.problem)
        request = self._rule.request(self.active, step, state, problem, late=late, sent=self._command)
        deadline = begun + self._rule.delay * dt - late
        answer = thread.submit(lambda: self._rule.solve(request, max(deadline - self._clock() - SPARE, 1e-6)))
        self._pending, self._missed = (request, answer), False

    def _adopt_answer(self, step: int) -> None:
        """Put an answer into force at its deadline. A late answer is not used."""
        if self._pending is None or step < self._pending[0].first:
            return
        request, answer = self._pending
        if not answer.done():
            self._missed = True  # its thread continues until the solve is done, and the next solve waits for it
            return
        self._pending = None
        if error := answer.exception():
            self.log.kept[str(error)] += 1
        elif self.log.record(request.step, 0, answer.result(), late=self._missed):
            self.active = ActivePlan(answer.result(), request.first)


MEASURED = "measured"
Computing = float | str | Callable[[np.random.Generator], float]


class Replanner(Controller):
    """Solves repeatedly, from where the robot will be when the solve ends. Until then the previous law stays in force.

        rollout = ls.simulate(plant, controller=replanner)  # in a simulation

        with replanner.live() as live:  # in a robot's own loop, as often as it likes
            while (t := robot.time()) < 20:
                robot.apply(live.step(robot.state(), t))

    Each solve begins with the law in force, and its plan is no worse than continuing with that law; see `Replan`. A
    reference moves with time, see `QuadraticCost`; other costs that depend on the step's number are not supported. With
    a `control_rate`, each plan goes on from the last command, and commands are clipped to the limits of rates. Several
    runs can share a re-planner.

    In a simulation a solve takes as long as `computing` says: a number, a function of a `numpy.random.Generator`, with
    which results do not depend on how long solves take, or "measured". Its first solve is after `every`; a live run
    solves at its first step, too. The rollout's `controller_run` has a `log` of the
    solves, like a `LiveReplanner`, and the plans in force, `active`.

    Args:
      every: seconds between two solves, rounded to control periods.
      deadline: seconds until an answer comes into force, rounded up to control periods, and no more than `every`. By
        default one control period, or `computing` if that is a number and longer.
      horizon: "shrinking", to the end of the first plan, or "moving", always as long as the first plan.
      predict: whether to solve from the state that the model predicts for the deadline, under the law in force. If
        False, a plan begins where the robot was when the solve began.
      changes: a function of the time in seconds and the problem that returns the problem as known at that time, with
        other goals, obstacles or parameters; what would have to be compiled cannot change. If the goal moves, a run
        ends at the goal of the last problem.
      when: a funnel of the solution, for the horizon "shrinking": solve only for states outside the funnel about the
        plan in force. About a later plan, or after a change, its ellipsoids are a rule of thumb, and no certificate.
      share: fraction of the funnel's level at which to solve; 1 is its boundary. Planning earlier takes more solves and
        loses fewer trials, because a plan that begins at the boundary often comes too late.
    """

    @checked
    def __init__(
        self,
        problem: Problem,
        solution: Plan,
        *,
        every: float,
        deadline: float | None = None,
        horizon: Horizon = "shrinking",
        predict: bool = True,
        changes: Changes | None = None,
        when: Funnel | None = None,
        share: Annotated[float, Bounds(above=0.0, at_most=1.0)] = 1.0,
        computing: Computing = 0.0,
        seed: Seed = 0,
    ) -> None:
        who = "Replanner"
        if callable(computing):
            check_function(f"{who}: computing", computing, "a function of a numpy.random.Generator", arguments=1)
        elif isinstance(computing, str) and computing != MEASURED:
            raise InputError(f'{who}: computing: got {excerpt(computing)}, want seconds, a function or "{MEASURED}"')
        elif not isinstance(computing, str):
            computing = check_number(f"{who}: computing", computing, at_least=0.0)
        if deadline is None:
            deadline = max(problem.dt, computing) if isinstance(computing, float) else problem.dt
        self.rule = ReplanRule(
            who, problem, solution, every, deadline, horizon=horizon, predict=predict, when=when, share=share,
            changes=changes,
        )  # fmt: skip
        self.problem, self.solution = problem, solution
        self.computing, self.seed = computing, seed

    def __repr__(self) -> str:
        return f"Replanner(every {self.rule.every:g} s, with a {self.rule.horizon} horizon)"

    def start(self, trials: int) -> "ReplannerRun":
        return ReplannerRun(self, trials)

    def live(self, *, interpolate: bool = False, clock: Callable[[], float] = time.perf_counter) -> LiveReplanner:
        """Re-planning in a robot's own loop, with a thread that solves: `with replanner.live() as live:`.

        Args:
          interpolate: whether laws are blended between two knots, as by an `AffinePolicy`, for faster loops.
          clock: returns the time in seconds, for deadlines.
        """
        return LiveReplanner(self.rule, interpolate=interpolate, clock=clock)

    @property
    def plan(self) -> Plan:
        return self.solution

    @property
    def digest(self) -> str:
        rule, when = self.rule, self.rule.when
        computing = identity(self.computing) if callable(self.computing) else repr(self.computing)
        changes = identity(rule.changes) if rule.changes is not None else ""
        funnel = "" if when is None else f"{when.digest}{rule.share}"
        parts = rule.periods, rule.delay, rule.horizon, rule.predict, self.seed
        return sha256(f"{self.solution.policy.digest} {self.problem.digest} {parts} {computing} {changes}{funnel}")[:16]

    @property
    def coordinates(self) -> Spaces:
        return spaces_of(self.solution.policy)


class ReplannerRun(ControllerRun):
    """K trials of a simulation, with the plan in force in each."""

    def __init__(self, of: Replanner, trials: int) -> None:
        self._of, self._rule, self._evaluate = of, of.rule, evaluator(of.solution.policy)
        self.log = ReplanLog()
        self._problem = of.problem  # as last known
        self.active = [ActivePlan(of.solution, 0)] * trials
        self._next: list[ActivePlan | None] = [None] * trials  # put into force at the step at which they begin
        self._sent: Array | None = None  # the commands of the period before

    def control(self, step: int, measured: Array) -> Array:
        self._activate(step)
        if self._rule.due(step, max(step - 1, 0)):
            self._replan(step, measured)
            self._activate(step)
        commands = np.empty((len(measured), len(self._of.coordinates[1])))
        for trial, active in enumerate(self.active):
            commands[trial] = self._evaluate(active.plan.policy, active.row(step), measured[trial : trial + 1])[0]
        self._sent = within_rates(commands, self._problem, self._sent)
        return self._sent

    def moved_goal(self) -> Array | None:
        goal, first = self._problem.weighed_goal, self._of.problem.weighed_goal
        still = first is None if goal is None else first is not None and np.array_equal(goal, first, equal_nan=True)
        return None if still else goal

    def summary(self) -> str:
        return self.log.summary(times=self._of.computing == MEASURED)

    def _activate(self, step: int) -> None:
        for trial, plan in enumerate(self._next):
            if plan is not None and plan.first == step:
                self.active[trial], self._next[trial] = plan, None

    def _replan(self, step: int, measured: Array) -> None:
        rule = self._rule
        self._problem = problem = rule.problem_at(step, rule.problem)
        trials = [k for k, active in enumerate(self.active) if rule.outside(active, step, measured[k])]
        sent = [None] * len(measured) if self._sent is None else self._sent
        requests = [rule.request(self.active[k], step, measured[k], problem, sent=sent[k]) for k in trials]
        for trial, request, replan in zip(trials, requests, self._solve(requests), strict=True):
            if self.log.record(step, trial, replan, late=self._late(measured[trial], step, replan)):
                self._next[trial] = ActivePlan(replan, request.first)

    def _solve(self, requests: list[SolveRequest]) -> list[Replan]:
        """The answers to all requests: computed at once, or one after the other if their durations are measured."""
        rule, measured = self._rule, self._of.computing == MEASURED
        if len(requests) <= 1 or measured:
            limit = max(rule.deadline, 1e-3) if measured else None
            return [rule.solve(request, limit) for request in requests]
        with workers(min(processors(), len(requests)), rule.problem.dynamics.functions) as pool:
            return list(pool.map(rule.solve, requests))

    def _late(self, state: Array, step: int, replan: Replan) -> bool:
        """Whether a solve took longer than the deadline."""
        computing = self._of.computing
        if computing == MEASURED:
            took = replan.seconds
        elif callable(computing):
            # Seeded by the state of this trial, so that other trials do not change its draws.
            rng = np.random.default_rng([self._of.seed, step, int(sha256(state)[:16], 16)])
            took = check_number("Replanner: computing", computing(rng), at_least=0.0)
        else:
            took = float(computing)
        return took > self._rule.delay * self._rule.problem.dt + 1e-9

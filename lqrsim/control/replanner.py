"""Re-planning: in simulations of many trials, and on a robot."""

import time
from collections.abc import Callable

import numpy as np

from lqrsim.codegen.fingerprint import fingerprint
from lqrsim.control.controllers import Controller, ControllerRun
from lqrsim.control.law import evaluator
from lqrsim.control.live_replanner import LiveReplanner
from lqrsim.control.replan_rule import ActivePlan, ReplanLog, ReplanRule, SolveRequest
from lqrsim.errors import Array, InputError, check_count, check_function, check_number, excerpt
from lqrsim.machine import processors
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.funnel import Funnel
from lqrsim.results.hashing import sha256
from lqrsim.results.plan import Plan, Replan
from lqrsim.solvers.parallel import workers

MEASURED = "measured"
Computing = float | str | Callable[[np.random.Generator], float]


class Replanner(Controller):
    """Solves again and again from where the robot will be when the answer comes; until then the law before goes on.

        rollout = ls.simulate(plant, controller=replanner)  # in a simulation

        with replanner.live() as live:  # in a robot's own loop, as often as it likes
            while (t := robot.time()) < 20:
                robot.apply(live.step(robot.state(), t))

    Each solve begins with the law in force, and its plan is no worse than to go on with that; see `Replan`. What is not
    ready by the deadline is not used. Costs that depend on the step's number are not supported. A re-planner is not
    changed by running it, so several runs can have the same one.

    In a simulation a solve takes as long as `computing` says. With a number or a function the results are the same to
    the last bit wherever they are computed; "measured" is as fast as this machine is. The rollout's `controller_run`
    has a `log` of the solves, as a `LiveReplanner` has, and the plans in force, `active`.

    Args:
      problem: that was solved.
      solution: its solution, or another plan of it.
      every: seconds between two solves, rounded to control periods.
      deadline: seconds until an answer comes into force, rounded up to control periods, and no more than `every`. By
        default one control period, or as long as `computing` takes, where that is a number and longer.
      horizon: "shrinking", what is left of the first plan's, or "moving", always as long as that.
      predict: whether to solve from where the law in force leads by the deadline, by the model. Without it, plans begin
        where the robot was, not where it is.
      changes: a function of the time in seconds and the problem that returns the problem as it is known by then: other
        goals, obstacles or parameters. What plans are stepped by (dt, steps, states and controls) cannot change, nor
        what would have to be compiled.
      when: a funnel of the solution, for the horizon "shrinking": solve only for states that are outside at the time,
        about the plan in force. What is certified is the first plan's; about a later one, or after a change, the same
        ellipsoids are a rule of thumb.
      share: of the funnel's level at which to solve: 1 is its boundary. Planning earlier takes more solves and loses
        fewer trials, for a plan that begins at the boundary often comes too late.
      computing: how long a solve takes in simulations, in seconds: a number; a function of a `numpy.random.Generator`,
        which draws it; or "measured".
      seed: of what `computing` draws.

    Raises:
      InputError: `every` is shorter than a control period or the deadline, or the solution is of another problem.
    """

    def __init__(
        self,
        problem: Problem,
        solution: Plan,
        *,
        every: float,
        deadline: float | None = None,
        horizon: str = "shrinking",
        predict: bool = True,
        changes: Callable[[float, Problem], Problem] | None = None,
        when: Funnel | None = None,
        share: float = 1.0,
        computing: Computing = 0.0,
        seed: int = 0,
    ) -> None:
        who = "Replanner"
        if callable(computing):
            check_function(f"{who}: computing", computing, "a function of a numpy.random.Generator", arguments=1)
        elif isinstance(computing, str) and computing != MEASURED:
            raise InputError(f'{who}: computing: got {excerpt(computing)}, want seconds, a function or "{MEASURED}"')
        elif not isinstance(computing, str):
            computing = check_number(f"{who}: computing", computing, at_least=0.0)
        self.rule = ReplanRule(
            who, problem, solution, every, deadline=deadline, horizon=horizon, predict=predict, when=when, share=share,
            changes=changes, at_least=computing if isinstance(computing, float) else 0.0,
        )  # fmt: skip
        self.problem, self.solution = problem, solution
        self.computing, self.seed = computing, check_count(f"{who}: seed", seed, at_least=0)

    def start(self, trials: int) -> "ReplannerRun":
        return ReplannerRun(self, trials)

    def live(self, *, interpolate: bool = False, clock: Callable[[], float] = time.perf_counter) -> LiveReplanner:
        """Re-planning in a robot's own loop, with a thread that solves: `with replanner.live() as live:`.

        Args:
          interpolate: whether laws are blended between two knots, for loops that are faster than the plan; see
            `AffinePolicy`.
          clock: what time it is, in seconds, for deadlines.

        Returns:
          A LiveReplanner, for one run.

        Raises:
          InputError: the deadline is zero, or an option is not as described.
        """
        return LiveReplanner(self.rule, interpolate=interpolate, clock=clock)

    @property
    def plan(self) -> Plan:
        return self.solution

    @property
    def digest(self) -> str:
        rule, when = self.rule, self.rule.when
        computing = fingerprint(self.computing) if callable(self.computing) else repr(self.computing)
        changes = fingerprint(rule.changes) if rule.changes is not None else ""
        funnel = "" if when is None else f"{when.digest}{rule.share}"
        parts = rule.periods, rule.delay, rule.horizon, rule.predict, self.seed
        return sha256(f"{self.solution.policy.digest} {self.problem.digest} {parts} {computing} {changes}{funnel}")[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self.solution.policy.state_coordinates, self.solution.policy.control_coordinates


class ReplannerRun(ControllerRun):
    """K trials of a simulation, with the plan that is in force in each.

    Attributes:
      log: how the solves went.
      active: the plan in force of each trial.
    """

    def __init__(self, of: Replanner, trials: int) -> None:
        self._of, self._rule, self._evaluate = of, of.rule, evaluator(*of.coordinates)
        self.log = ReplanLog()
        self.active = [ActivePlan(of.solution, 0)] * trials
        self._next: list[ActivePlan | None] = [None] * trials  # for the step that they begin at

    def control(self, step: int, measured: Array) -> Array:
        self._activate(step)
        if self._rule.due(step):
            self._replan(step, measured)
            self._activate(step)
        commands = np.empty((len(measured), len(self._of.coordinates[1])))
        for trial, active in enumerate(self.active):
            row, policy, one = active.row(step), active.plan.policy, measured[trial : trial + 1]
            commands[trial] = self._evaluate(one, policy.gain[row], policy.offset[row], policy.nominal[row])[0]
        return commands

    def summary(self) -> str:
        return self.log.summary(times=self._of.computing == MEASURED)

    def _activate(self, step: int) -> None:
        """Put plans into force that begin at this step."""
        for trial, plan in enumerate(self._next):
            if plan is not None and plan.first == step:
                self.active[trial], self._next[trial] = plan, None

    def _replan(self, step: int, measured: Array) -> None:
        """Solve for all trials for which that is due."""
        rule = self._rule
        problem = rule.problem_at(step, rule.problem)
        trials = [k for k, active in enumerate(self.active) if rule.outside(active, step, measured[k])]
        requests = [rule.request(self.active[k], step, measured[k], problem) for k in trials]
        for trial, request, replan in zip(trials, requests, self._solve(requests), strict=True):
            if self.log.enter(step, trial, replan, late=self._late(measured[trial], step, replan)):
                self._next[trial] = ActivePlan(replan, request.first)

    def _solve(self, requests: list[SolveRequest]) -> list[Replan]:
        """All at once; one after the other where it matters how long each takes."""
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
        elif isinstance(computing, float):
            took = computing
        else:
            # From what this trial is shown, so that it draws the same whatever other trials there are.
            drawn = int.from_bytes(bytes.fromhex(sha256(state)[:16]), "big")
            assert callable(computing)
            given = computing(np.random.default_rng([self._of.seed, step, drawn]))
            took = check_number("Replanner: computing", given, at_least=0.0)
        return took > self._rule.delay * self._rule.problem.dt + 1e-9

"""Solving again and again on the way, in simulations of many trials."""

from collections import Counter
from collections.abc import Callable

import numpy as np

from lqrsim.codegen.fingerprint import fingerprint
from lqrsim.control.controllers import Control, Controller
from lqrsim.control.law import evaluator
from lqrsim.control.replanner import Law, Replanner, ReplanRecord, Task
from lqrsim.errors import Array, InputError, check_count, check_function, check_number, excerpt
from lqrsim.machine import processors
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.funnel import Funnel
from lqrsim.results.hashing import sha256
from lqrsim.results.replan import Replan
from lqrsim.results.solution import Solution
from lqrsim.solvers.common import workers

MEASURED = "measured"
Computing = float | str | Callable[[np.random.Generator], float]


class Replanning(Controller):
    """Solves again and again from where the robot will be when the answer comes; until then the law before goes on.

    Each solve begins with the law in force, and its plan is no worse than to go on with that; see `Replan`. What is not
    ready by the deadline is not used. Costs that depend on the step's number are not supported.

    In a simulation a solve takes as long as `computing` says. With a number or a function the results are the same to
    the last bit wherever they are computed; "measured" is as fast as this machine is. On a robot, use `Planner`.

    Args:
      problem: that was solved.
      solution: its solution.
      every: seconds between two solves, rounded to control periods.
      deadline: seconds until an answer comes into force, rounded up to control periods, and no more than `every`. By
        default as long as `computing` takes, where that is a number, and else one control period.
      horizon: "shrinking", what is left of the first plan's, or "moving", always as long as that.
      computing: how long a solve takes, in seconds: a number; a function of a `numpy.random.Generator`, which draws it;
        or "measured".
      predict: whether to solve from where the law in force leads by the deadline, by the model. Without it, plans begin
        where the robot was, not where it is.
      changes: a function of the time in seconds and the problem that returns the problem as it is known by then: other
        goals, obstacles or parameters, but nothing that would have to be compiled.
      seed: of what `computing` draws.
      when: a funnel of the solution: solve only for trials that are outside at the time, about the plan in force. What
        is certified is the first plan's; about a later one the same ellipsoids are a rule of thumb.
      share: of the funnel's level at which to solve: 1 is its boundary. Planning earlier takes more solves and loses
        fewer trials, for a plan that begins at the boundary often comes too late.

    Attributes:
      records: a `ReplanRecord` of each solve of the last run.
      solved: how many of them were used, of all trials.
      kept: why others were not, and the law before went on: reason -> how many. `summary()` says both in a line.

    Raises:
      InputError: `every` is shorter than a control period or the deadline, or the solution is of another problem.
    """

    def __init__(
        self,
        problem: Problem,
        solution: Solution,
        *,
        every: float,
        deadline: float | None = None,
        horizon: str = "shrinking",
        computing: Computing = 0.0,
        predict: bool = True,
        changes: Callable[[float, Problem], Problem] | None = None,
        seed: int = 0,
        when: Funnel | None = None,
        share: float = 1.0,
    ) -> None:
        who = "Replanning"
        if callable(computing):
            check_function(f"{who}: computing", computing, "a function of a numpy.random.Generator", arguments=1)
        elif isinstance(computing, str) and computing != MEASURED:
            raise InputError(f'{who}: computing: got {excerpt(computing)}, want seconds, a function or "{MEASURED}"')
        elif not isinstance(computing, str):
            computing = check_number(f"{who}: computing", computing, at_least=0.0)
        if deadline is None and isinstance(computing, float):
            deadline = computing
        check_function(f"{who}: changes", changes, "a function of the time and the problem", arguments=2)
        self._replanner = Replanner(
            who, problem, solution, every, deadline=deadline, horizon=horizon, predict=predict, when=when, share=share
        )
        self.problem, self.solution, self.when = problem, solution, when
        self.every, self.deadline, self.horizon = self._replanner.every, self._replanner.deadline, horizon
        self.computing, self.changes, self.seed = computing, changes, check_count(f"{who}: seed", seed, at_least=0)

    @property
    def records(self) -> list[ReplanRecord]:
        return self._replanner.account.records

    @property
    def solved(self) -> int:
        return self._replanner.account.solved

    @property
    def kept(self) -> Counter[str]:
        return self._replanner.account.kept

    def start(self, trials: int) -> Control:
        replanner, evaluate = self._replanner, evaluator(*self.spaces)
        laws = [replanner.start()] * trials
        waiting: list[Law | None] = [None] * trials  # for the step that they begin at

        def control(step: int, shown: Array) -> Array:
            for trial, law in enumerate(waiting):
                if law is not None and law.first == step:
                    laws[trial], waiting[trial] = law, None
            if replanner.due(step):
                problem = self._problem_at(step)
                left = [trial for trial, law in enumerate(laws) if replanner.left(law, step, shown[trial])]
                tasks = [replanner.task(laws[trial], step, shown[trial], problem) for trial in left]
                for trial, task, replan in zip(left, tasks, self._solve(tasks), strict=True):
                    if replanner.account.enter(step, trial, replan, late=self._late(shown[trial], step, replan)):
                        waiting[trial] = Law(replan, task.first)
                if replanner.delay == 0:
                    laws[:] = [new or old for new, old in zip(waiting, laws, strict=True)]
                    waiting[:] = [None] * trials
            commands = np.empty((trials, len(self.spaces[1])))
            for trial, law in enumerate(laws):
                row, policy, one = law.row(step), law.plan.policy, shown[trial : trial + 1]
                commands[trial] = evaluate(one, policy.gain[row], policy.offset[row], policy.nominal[row])[0]
            return commands

        return control

    def _problem_at(self, step: int) -> Problem:
        if self.changes is None:
            return self.problem
        return self._replanner.solver.check(self.changes(step * self.problem.dt, self.problem))

    def _solve(self, tasks: list[Task]) -> list[Replan]:
        """All at once; one after the other where it matters how long each takes."""
        replanner = self._replanner
        if len(tasks) <= 1 or self.computing == MEASURED:
            limit = max(self.deadline, 1e-3) if self.computing == MEASURED else None
            return [replanner.solve(task, limit) for task in tasks]
        with workers(min(processors(), len(tasks)), self.problem.dynamics.functions) as pool:
            return list(pool.map(replanner.solve, tasks))

    def _late(self, state: Array, step: int, replan: Replan) -> bool:
        """Whether a solve took longer than the deadline."""
        if self.computing == MEASURED:
            took = replan.seconds
        elif isinstance(self.computing, float):
            took = self.computing
        else:
            # From what this trial is shown, so that it draws the same whatever other trials there are.
            drawn = int.from_bytes(bytes.fromhex(sha256(state)[:16]), "big")
            assert callable(self.computing)
            given = self.computing(np.random.default_rng([self.seed, step, drawn]))
            took = check_number("Replanning: computing", given, at_least=0.0)
        return took > self._replanner.delay * self.problem.dt + 1e-9

    def summary(self) -> str:
        """How often it solved in the last run, and why where it kept the law before, in a line."""
        return self._replanner.account.summary(times=self.computing == MEASURED)

    @property
    def digest(self) -> str:
        computing = fingerprint(self.computing) if callable(self.computing) else repr(self.computing)
        changes = fingerprint(self.changes) if self.changes is not None else ""
        when = "" if self.when is None else f"{self.when.digest}{self._replanner.share}"
        parts = self._replanner.periods, self._replanner.delay, self.horizon, self._replanner.predict, self.seed
        return sha256(f"{self.solution.policy.digest} {self.problem.digest} {parts} {computing} {changes}{when}")[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.solution.policy.state_coordinates, self.solution.policy.control_coordinates

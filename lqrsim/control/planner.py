"""Re-planning on a robot: a law that is always at hand, and plans that are made beside it, in a thread."""

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy.typing as npt

from lqrsim.control.replanner import Account, Law, Replanner, Task
from lqrsim.errors import Array, InputError, check_flag, check_number, vectors_of
from lqrsim.problem.problem import Problem
from lqrsim.results.funnel import Funnel
from lqrsim.results.replan import Replan
from lqrsim.results.solution import Solution

SPARE = 0.5e-3  # s, between the end of a solve and its deadline: for handing the answer over


@dataclass
class _Solve:
    """A solve that was asked for, and its answer when it is there."""

    task: Task
    deadline: float  # on the clock
    answer: Replan | None = None
    error: Exception | None = None
    missed: bool = False


class Planner:
    """Plans again and again while a robot runs; its own loop calls `step` as often as it likes.

        with ls.Planner(problem, solution, every=0.1) as planner:
            while (t := robot.time()) < 20:
                robot.apply(planner.step(robot.state(), t))

    `step` only evaluates the law in force, and never waits for a solve. A solve begins with the first call in a control
    period in which one is due: from where that law leads by the deadline, by the model. Its answer comes into force at
    the deadline. What is not ready then is not used, and the law before goes on. All is compiled before the first step.

    Args:
      problem: that was solved.
      solution: its solution.
      every: seconds between two solves, rounded to control periods.
      deadline: seconds until an answer comes into force, rounded up to control periods; by default one period.
      horizon: "moving", always as long as the first plan's, or "shrinking", to its end.
      interpolate: whether laws are blended between two knots, for loops that are faster than the plan; see
        `AffinePolicy`.
      when: a funnel of the solution, for the horizon "shrinking": a solve that is due begins only if the measured state
        is outside then, about the plan in force; see `Replanning`. That holds after `change`, too.
      share: as in `Replanning`.
      clock: what time it is, in seconds, for deadlines; for tests.

    Attributes:
      law: in force, with the step that it begins at.
      account: how the solves went, one record each.

    Raises:
      InputError: as `Replanning`.
    """

    def __init__(
        self,
        problem: Problem,
        solution: Solution,
        *,
        every: float,
        deadline: float | None = None,
        horizon: str = "moving",
        interpolate: bool = False,
        when: Funnel | None = None,
        share: float = 1.0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        if deadline is not None:
            check_number("Planner: deadline", deadline, above=0.0)
        self._replanner = Replanner(
            "Planner", problem, solution, every, deadline=deadline, horizon=horizon, when=when, share=share
        )
        self._interpolate, self._clock = check_flag("Planner: interpolate", interpolate), clock
        self.problem = problem
        self.law: Law = self._replanner.start()
        self._asked = -1  # the step at which a solve was last due
        self._solve: _Solve | None = None
        self._tasks: queue.SimpleQueue[_Solve | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Start the thread that solves."""
        self._thread = threading.Thread(target=self._work, name="lqrsim planner", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """End it, after the solve that it is at."""
        if self._thread is not None:
            self._tasks.put(None)
            self._thread.join()
            self._thread = None

    @property
    def account(self) -> Account:
        return self._replanner.account

    def summary(self) -> str:
        """How often it solved, how long that took, and why the law before was kept where it was, in a line."""
        return self.account.summary(times=True)

    def change(self, **parts: Any) -> None:
        """Change the problem from the next solve on: `planner.change(final_cost=...)`; see `dataclasses.replace`.

        Goals, weights, obstacles, parameters and limits can change. So that a new estimate of what disturbs the robot
        can, plan with `dynamics.disturbed` from the beginning.

        Args:
          **parts: field of `Problem` -> new value.

        Raises:
          InputError: the problem is none, or would have to be compiled.
        """
        try:
            changed = replace(self.problem, **parts)
        except TypeError:
            known = ", ".join(name for name in Problem.__dataclass_fields__ if not name.startswith("_"))
            raise InputError(f"change: got {', '.join(parts)}, want fields of a Problem: {known}") from None
        self.problem = self._replanner.solver.check(changed)

    def step(self, state: npt.ArrayLike, t: float) -> Array:
        """The control (m,) to apply in a measured state (n,), `t` seconds after the start.

        Args:
          state: (n,), measured.
          t: seconds since the start, 0 or more.

        Returns:
          (m,).

        Raises:
          InputError: the state is not finite, the time is negative, or the thread does not run.
        """
        if self._thread is None:
            raise InputError("Planner: got a step without its thread, want it within `with planner:`")
        t = check_number("t", t, at_least=0.0)
        state = vectors_of("state", state, len(self.law.plan.policy.state_coordinates))
        dt = self.problem.dt
        step = int(t / dt + 1e-9)
        self._take(step)
        if self._solve is None and step > self._asked and self._due(step):
            self._ask(state, t, step)
        policy = self.law.plan.policy
        return policy(state, max(t - self.law.first * dt, 0.0), interpolate=self._interpolate)

    def _due(self, step: int) -> bool:
        """Whether a solve begins in a control period: that is so of the first, too, and of one after those left out."""
        every, again = self._replanner.periods, self._replanner
        left = again.horizon == "moving" or step + again.delay < again.problem.steps
        return left and step // every > self._asked // every

    def _ask(self, state: Array, t: float, step: int) -> None:
        """Begin a solve, of a state that is measured within a control period, unless that is in the funnel."""
        begun, dt = self._clock(), self.problem.dt
        late, self._asked = t - step * dt, step
        if not self._replanner.left(self.law, step, state, late=max(late, 0.0)):
            return
        task = self._replanner.task(self.law, step, state, self.problem, late=late)
        solve = _Solve(task, begun + self._replanner.delay * dt - late)
        self._solve = solve
        self._tasks.put(solve)

    def _take(self, step: int) -> None:
        """Put an answer into force whose time has come; what is not there by then is not used."""
        solve = self._solve
        if solve is None or step < solve.task.first:
            return
        if solve.answer is None and solve.error is None:
            solve.missed = True  # its thread goes on until it is done with it, and the next solve waits for that
            return
        self._solve = None
        if solve.answer is None:
            self.account.refuse(str(solve.error))
        elif self.account.enter(solve.task.step, 0, solve.answer, late=solve.missed):
            self.law = Law(solve.answer, solve.task.first)

    def _work(self) -> None:
        """The thread: one solve after the other."""
        while (solve := self._tasks.get()) is not None:
            try:
                left = solve.deadline - self._clock() - SPARE
                solve.answer = self._replanner.solve(solve.task, max(left, 1e-6))
            except Exception as error:
                solve.error = error

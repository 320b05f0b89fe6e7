"""Re-planning on a robot: a law that is always at hand, and plans that are made beside it, in a thread."""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy.typing as npt

from lqrsim.control.replan_rule import ActivePlan, ReplanLog, ReplanRule, SolveRequest
from lqrsim.errors import Array, InputError, check_flag, check_function, check_kind, check_number, vectors_of
from lqrsim.problem.problem import Problem
from lqrsim.results.plan import Replan

SPARE = 0.5e-3  # s, between the end of a solve and its deadline: for handing the answer over


@dataclass
class _Solve:
    """A solve that was asked for, and its answer when it is there."""

    request: SolveRequest
    deadline: float  # on the clock
    answer: Replan | None = None
    error: Exception | None = None
    missed: bool = False


class LiveReplanner:
    """One run of a `Replanner` on a robot, made by `Replanner.live`: its own loop calls `step` as often as it likes.

    `step` only evaluates the law in force, and never waits for a solve. A solve begins with the first call in a control
    period in which one is due. Its answer comes into force at the deadline. What is not ready then is not used, and the
    law before goes on. All is compiled before the first step.

    Args:
      rule: what is solved, when and from where.
      interpolate: as in `Replanner.live`.
      clock: likewise.

    Attributes:
      problem: that is solved from now on.
      active: the plan in force, `active.plan`, and the control period that it begins at, `active.first`.
      log: how the solves went: `log.records`, a `ReplanRecord` of each; `log.solved`, how many were used; and
        `log.kept`, why others were not, and the law before went on: reason -> how many.

    Raises:
      InputError: as `Replanner.live`.
    """

    def __init__(self, rule: ReplanRule, *, interpolate: bool, clock: Callable[[], float]) -> None:
        check_kind("LiveReplanner: rule", rule, ReplanRule, "that of a Replanner")
        if not rule.delay:
            raise InputError(
                "Replanner.live: deadline: got 0 s, want more: a solve takes time, in which the law before goes on"
            )
        check_function("Replanner.live: clock", clock, "a function that returns seconds", arguments=0, optional=False)
        self._rule, self._clock = rule, clock
        self._interpolate = check_flag("Replanner.live: interpolate", interpolate)
        self.problem, self.active, self.log = rule.problem, ActivePlan(rule.solution, 0), ReplanLog()
        self._asked = -1  # the step at which a solve was last due
        self._solve: _Solve | None = None
        self._queue: queue.SimpleQueue[_Solve | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Start the thread that solves."""
        if self._thread is not None:
            raise InputError("LiveReplanner: got entered twice, want one `with replanner.live() as live:` for each run")
        self._thread = threading.Thread(target=self._work, name="lqrsim re-planner", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """End it, after the solve that it is at."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()

    def summary(self) -> str:
        """How often it solved, how long that took, and why the law before was kept where it was, in a line."""
        return self.log.summary(times=True)

    def change(self, **parts: Any) -> None:
        """Change the problem from the next solve on: `live.change(final_cost=...)`; see `dataclasses.replace`.

        Goals, weights, obstacles, parameters and limits can change. So that a new estimate of what disturbs the robot
        can, plan with `dynamics.disturbed` from the beginning. What plans are stepped by (dt, steps, states and
        controls) cannot.

        Args:
          **parts: field of `Problem` -> new value.

        Raises:
          InputError: the problem is none; it would have to be compiled; or something changes that cannot.
        """
        try:
            changed = replace(self.problem, **parts)
        except TypeError:
            known = ", ".join(name for name in Problem.__dataclass_fields__ if not name.startswith("_"))
            raise InputError(f"change: got {', '.join(parts)}, want fields of a Problem: {known}") from None
        self.problem = self._rule.checked("change", changed)

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
        if self._thread is None or not self._thread.is_alive():
            raise InputError(
                "LiveReplanner: got a step without its thread, want it within `with replanner.live() as live:`"
            )
        t = check_number("t", t, at_least=0.0)
        state = vectors_of("state", state, len(self.active.plan.policy.state_coordinates))
        dt = self.problem.dt
        step = int(t / dt + 1e-9)
        self._take(step)
        if self._solve is None and step > self._asked and self._due(step):
            self._ask(state, t, step)
        policy = self.active.plan.policy
        return policy(state, max(t - self.active.first * dt, 0.0), interpolate=self._interpolate)

    def _due(self, step: int) -> bool:
        """Whether a solve begins in a control period: that is so of the first, too, and of one after those left out."""
        rule = self._rule
        left = rule.horizon == "moving" or step + rule.delay < rule.problem.steps
        return left and step // rule.periods > self._asked // rule.periods

    def _ask(self, state: Array, t: float, step: int) -> None:
        """Begin a solve, of a state that is measured within a control period, unless that is in the funnel."""
        begun, dt = self._clock(), self.problem.dt
        late, self._asked = t - step * dt, step
        if not self._rule.outside(self.active, step, state, late=max(late, 0.0)):
            return
        problem = self._rule.problem_at(step, self.problem)
        request = self._rule.request(self.active, step, state, problem, late=late)
        solve = _Solve(request, begun + self._rule.delay * dt - late)
        self._solve = solve
        self._queue.put(solve)

    def _take(self, step: int) -> None:
        """Put an answer into force whose time has come; what is not there by then is not used."""
        solve = self._solve
        if solve is None or step < solve.request.first:
            return
        if solve.answer is None and solve.error is None:
            solve.missed = True  # its thread goes on until it is done with it, and the next solve waits for that
            return
        self._solve = None
        if solve.answer is None:
            self.log.refuse(str(solve.error))
        elif self.log.enter(solve.request.step, 0, solve.answer, late=solve.missed):
            self.active = ActivePlan(solve.answer, solve.request.first)

    def _work(self) -> None:
        """The thread: one solve after the other."""
        while (solve := self._queue.get()) is not None:
            try:
                left = solve.deadline - self._clock() - SPARE
                solve.answer = self._rule.solve(solve.request, max(left, 1e-6))
            except Exception as error:
                solve.error = error

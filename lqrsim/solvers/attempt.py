"""The method from one start, as far as it has got; and the safeguard, where it fails."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lqrsim.errors import Array
from lqrsim.problem import Problem
from lqrsim.results import Candidate, Iteration, Multipliers, Status, Trajectory
from lqrsim.solvers import interface
from lqrsim.solvers.common import LOG_COLUMNS, Callback, Ending, SmootherSettings, check_outcome, iterate
from lqrsim.solvers.start import Start
from lqrsim.solvers.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class Found:
    """What there is to answer with; see `assemble`. With `final`, another start would not do better."""

    status: Status
    detail: str
    iterations: tuple[Iteration, ...]
    states: Array
    controls: Array
    law: tuple[Array, Array]
    values: dict[str, Any] = field(default_factory=dict)
    multipliers: tuple[Multipliers, ...] = ()
    final: bool = False

    @property
    def cost(self) -> float:
        """True cost of the plan; infinite where there is none, or it is not known."""
        cost = self.iterations[-1].cost if self.iterations else np.inf
        return cost if np.isfinite(cost) else np.inf

    @property
    def rank(self) -> tuple[bool, float, float]:
        """The smaller, the better: success first, then constraints, then the cost."""
        violation = self.iterations[-1].violation if self.iterations else np.inf
        return not self.success, 0.0 if self.success else violation, self.cost

    @property
    def success(self) -> bool:
        """As of a Solution."""
        return self.status.success


class Attempt:
    """Iterated LQR smoothing from one start.

    Attributes:
      begin: where it starts from. work: its memory.
      ending: how it stands; its outcome is RUNNING until it has ended.
    """

    def __init__(self, problem: Problem, settings: SmootherSettings, begin: Start, start: Array) -> None:
        self.problem, self.settings = problem, settings
        if settings.first_pass == "backward" and begin.gain.any():
            begin = begin.rolled_out(problem, start)
        self.begin = begin
        self.work = Workspace(problem, settings, begin, start)
        self.ending = Ending((), interface.RUNNING, False, -1, "")
        self._log = np.zeros((settings.max_iterations, LOG_COLUMNS))
        self._shares = begin.prior.obstacles if begin.prior is not None else ()
        self._loop = self.work.core.entry("smoother_iterations", *self._arguments(0, 0, self._log))

    @property
    def cost(self) -> float:
        """True cost of the last rollout; infinite where there is none, or a pass failed."""
        if self.ending.pass_failed or not self.ending.iterations:
            return np.inf
        cost = self.ending.iterations[-1].cost
        return cost if np.isfinite(cost) else np.inf

    def run(self, last: int, *, each: bool, callback: Callback | None = None) -> None:
        """Go on until there are `last` iterations, or it ends; with `each`, a look after each (see `iterate`)."""
        if self.ending.outcome != interface.RUNNING:
            return
        if not self.ending.iterations and not self.opened():
            return
        self.ending = iterate(
            self.problem, lambda first, last: self._loop(*self._arguments(first, last, self._log)), self._log,
            min(last, self.settings.max_iterations), done=self.ending.iterations, look=self._violation,
            each=self._looking(each), callback=callback,
        )  # fmt: skip

    def run_on(
        self, log: Array, last: int, *, done: tuple[Iteration, ...], each: bool, callback: Callback | None
    ) -> Ending:
        """More iterations of the same kind, with a log of their own; the prior has had its time."""
        return iterate(
            self.problem, lambda first, last: self._loop(*self._arguments(first, last, log, again=True)), log, last,
            done=done, look=self._violation, each=each, callback=callback,
        )  # fmt: skip

    def roll_out(self) -> None:
        """See where the start leads, if nothing has been done yet; the states and controls are in `work`."""
        self._loop(*self._arguments(0, 0, self._log))

    def finish(self, *, each: bool, callback: Callback | None = None) -> Found:
        """The method, and its safeguard where that fails."""
        settings = self.settings
        self.run(settings.max_iterations, each=each, callback=callback)
        ending = check_outcome(self.problem, self.ending, self.work.start, self.begin.offset[0], refuse=each)
        lost = ending is not self.ending  # a function that is not finite at the start: nothing can help
        found = self.found(ending)
        if settings.safeguard and not lost and not found.success:
            return self.rescue(found.detail or found.status.meaning, each=each, callback=callback)
        return found

    def found(self, ending: Ending) -> Found:
        """What the bare method found; `ending` is its own, or one that knows more of why it failed."""
        work = self.work
        return Found(
            status=ending.status, detail=ending.detail(self.problem.steps), iterations=ending.iterations,
            states=work.states, controls=work.controls, law=work.kept,
            values={} if ending.pass_failed else work.value_functions(),
        )  # fmt: skip

    def rescue(self, why: str, *, each: bool, callback: Callback | None = None) -> Found:
        """The safeguard: iterations from the best plan so far."""
        work, detail = self.work, f"the undamped method failed ({why})"
        work.memory[interface.MERIT] = work.memory[interface.PLAN_COST]
        damped = self.damp(before=self.ending.iterations, each=each, callback=callback)
        if not np.isfinite(work.memory[interface.PLAN_COST]):
            # Nothing that was tried leads anywhere. What is left is how it failed.
            return Found(
                status=self.ending.status, detail=detail, iterations=damped.iterations, states=work.states,
                controls=work.controls, law=work.kept,
            )  # fmt: skip
        status = damped.status
        if damped.outcome == interface.STALLED:
            status, detail = self.ending.status, f"{detail}; from the best plan, no step lowers the cost any more"
        return self.found_damped(damped, status, detail)

    def damp(self, *, before: tuple[Iteration, ...], each: bool, callback: Callback | None) -> Ending:
        """Damped iterations from the plan, whose cost and merit are in the memory; see `solvers/safeguard.py`."""
        settings, work = self.settings, self.work
        log = np.zeros((settings.max_iterations, LOG_COLUMNS))
        memory = work.memory
        memory[interface.REACH], memory[interface.WEIGHT], memory[interface.SMALL] = 1.0, 0.0, 0.0
        memory[interface.ILQR_LEFT], memory[interface.ILQR_NEXT], memory[interface.SINCE_ILQR] = 0.0, 2.0, 0.0
        trial = np.zeros_like(work.states), np.zeros_like(work.controls)

        def arguments(first: int, last: int) -> tuple[Any, ...]:
            return (
                self.problem.steps, first, last, settings.max_iterations, settings.tolerance, settings.gap_tolerance,
                settings.stop == "optimal", work.fixed, *work.passes, *work.no_prior, *work.plan, *trial, memory, log,
            )  # fmt: skip

        loop = work.core.entry("damped_iterations", *arguments(0, 0))
        return iterate(
            self.problem, lambda first, last: loop(*arguments(first, last)), log, settings.max_iterations,
            before=before, look=lambda: self._violation_of(work.plan), each=self._looking(each), callback=callback,
        )  # fmt: skip

    def found_damped(self, damped: Ending, status: Status, detail: str) -> Found:
        """What damped iterations found: the plan, and what was modelled about it."""
        work = self.work
        states, controls = work.plan
        values, law = {}, work.law
        if not np.isfinite(damped.iterations[-1].optimality):  # there is no model about the plan, nor a policy
            law = np.zeros_like(work.law[0]), controls.copy()
        else:
            values = work.value_functions()
            gap = work.memory[interface.FINAL_GAP]
            if not gap < self.settings.gap_tolerance:
                # As from iLQR, whose steps need neither of these.
                values["cost_to_come"] = values["inverse_law"] = None
                detail += (
                    f"; the states of least total cost are {gap:.1g} off the plan, so the cost-to-come is left out"
                )
        return Found(
            status=status, detail=detail, iterations=damped.iterations, states=states, controls=controls, law=law,
            values=values,
        )  # fmt: skip

    def candidate(self, name: str, found: Found | None) -> Candidate:
        """It, as one of several; `found` if it was run to its end."""
        if found is None:
            plan = Trajectory(self.work.states, self.work.controls, self.problem.dt)
            return Candidate(name, self.cost, len(self.ending.iterations), None, plan)
        plan = Trajectory(found.states, found.controls, self.problem.dt)
        return Candidate(name, found.cost, len(found.iterations), found.status, plan)

    def opened(self) -> bool:
        """Do what comes before the first iteration; False if it fails."""
        if self.settings.first_pass == "forward":
            return True
        self.roll_out()  # before the start is forgotten
        work = self.work
        p, dt, _, _, final = work.model
        failed, good = work.core.opening_pass(
            self.problem.steps, self.begin.trajectory is not None, *work.guess, *work.law, *work.go,
            p, dt, work.eased(self._share(0)), final, *work.prior[:2],
        )  # fmt: skip
        if failed >= 0:
            outcome = interface.NOT_POSITIVE_DEFINITE if good else interface.NOT_FINITE
            self.ending = Ending((), outcome, True, failed, "")
        return failed < 0

    def _arguments(self, first: int, last: int, log: Array, *, again: bool = False) -> tuple[Any, ...]:
        """What the loop takes, for the iterations from `first` up to `last`, or fewer: of a continuation, one."""
        settings, work = self.settings, self.work
        share = 1.0 if again else self._share(first)
        tolerance = settings.tolerance
        if share != 1:
            last = min(last, first + 1)
            tolerance = 0.0  # what is not all of the cost does not settle
        guided = self.begin.trajectory is not None and settings.first_pass == "forward" and not again
        prior = (*work.no_prior, 0) if again else work.prior
        return (
            self.problem.steps, first, last, len(log), tolerance, settings.gap_tolerance,
            settings.stop == "optimal", work.fixed, guided, *work.passes, work.eased(share), *prior,
            *work.guess, *work.plan, work.states, work.controls, *work.kept, work.memory, log,
        )  # fmt: skip

    def _share(self, iteration: int) -> float:
        """How much of the obstacle costs the passes of an iteration see."""
        return self._shares[iteration] if iteration < len(self._shares) else 1.0

    def _looking(self, each: bool) -> bool:
        """Whether to come back after each iteration: constraints are looked at from outside of the loops."""
        return each or bool(self.problem.constraints)

    def _violation(self) -> float:
        return self._violation_of((self.work.states, self.work.controls))

    def _violation_of(self, plan: tuple[Array, Array]) -> float:
        return self.work.violation(self.work.constraint_values(*plan)) if self.problem.constraints else 0.0

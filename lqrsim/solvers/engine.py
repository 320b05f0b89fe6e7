"""One run of the solver from one start: memory, smoothing, Newton's method at the end, and the safeguard."""

import contextlib
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lqrsim.codegen.compiled_module import Call, CompiledModule, in_c_order
from lqrsim.codegen.user_functions import raised_by
from lqrsim.errors import Array, InputError
from lqrsim.kernels import declarations, records
from lqrsim.kernels.iterations import DAMPED_STEPS, NEWTON_STEPS
from lqrsim.kernels.records import CERTIFICATE, LOG, CostToGo, Descent, Motion, Policy, Prior, StructuredArray, zeros_of
from lqrsim.problem.derivative_check import check_start, functions_of
from lqrsim.problem.parts import allowed_violation, violation_of
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import (
    Candidate,
    Certificate,
    Iteration,
    Moments,
    Multipliers,
    Quadratic,
    Status,
    Trajectory,
    joined,
)
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import ATTENTION, Budget, Stop, in_slices
from lqrsim.solvers.settings import INSIDE, InitialGuess, SmootherSettings
from lqrsim.solvers.stages import Pool, Stages

_METHODS = {getattr(declarations, name): name.lower() for name in ("SMOOTH", "DAMPED", "REJECTED", "ILQR", "NEWTON")}
# The status of each outcome: that of the same name, if there is one.
_STATUS = {getattr(declarations, status.name): status for status in Status if hasattr(declarations, status.name)} | {
    declarations.RUNNING: Status.MAX_ITERATIONS,  # all requested iterations were done
    declarations.NO_START: Status.NOT_FINITE,
    declarations.CYCLING: Status.STALLED,
    declarations.NO_PROGRESS: Status.STALLED,
    declarations.TIMED_OUT: Status.TIME_LIMIT,
    declarations.IN_VALLEY: Status.MAX_ITERATIONS,
}
_FAILURES = (declarations.NOT_POSITIVE_DEFINITE, declarations.NOT_FINITE, declarations.RISK_TOO_HIGH)
_DETAILS = {
    declarations.NO_START: "rollout of the initial controls",
    declarations.CYCLING: "the iterations repeat themselves",
    declarations.NO_PROGRESS: "neither the least cost so far nor the gap falls any more",
    declarations.STALLED: "the line search found no lower cost",
}

# Newton's method takes over when the states of least total cost are within VALLEY of the rollout, relative to its
# range: smoothing is then near a local optimum. Damped iterations approach it slowly. They end when the cost falls by
# less than NEARLY, twice, with a gap below NEAR.
VALLEY, NEARLY, NEAR = 0.2, 1e-2, 0.1
# The squares that the interior point's margins leave of a cost of zero, relative to those that rounding leaves.
MARGIN_SQUARES = 1e8
ROUNDING = 1e-9  # relative difference of costs below which two plans are equally good
DIGITS = 1e-12  # relative accuracy of the largest risk


@dataclass(frozen=True)
class Ending:
    """The way in which iterations ended, with its texts for users."""

    outcome: int  # in `kernels/declarations.py`
    done: int = 0  # total number of iterations, including earlier ones
    failed: int = -1  # the step at which a pass failed, or -1
    backward: bool = False  # whether it was a backward pass
    raised: str = ""  # the exception of a user's function

    @property
    def status(self) -> Status:
        return _STATUS[self.outcome]

    @property
    def success(self) -> bool:
        return self.status.success

    @property
    def pass_failed(self) -> bool:
        """Whether a pass failed in a further iteration."""
        return self.outcome in _FAILURES

    def detail(self, steps: int) -> str:
        """Text with the step at which it ended, of that many steps, and the exception of a user's function."""
        raised = "" if self.success or self.outcome == declarations.TIMED_OUT else self.raised
        place = _DETAILS.get(self.outcome, "")
        if self.pass_failed and not (self.done and self.failed < 0):
            which = "backward" if self.backward else "forward"
            place = f"{which} pass of iteration {self.done + 1}, step {self.failed} of {steps}"
        return ": ".join(part for part in (place, raised) if part)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunResult:
    """Result of a run, from which `assemble` makes a `Solution`."""

    status: Status
    plan: Motion
    policy: Policy
    cost: float = np.inf  # of the plan, as in the log; infinite without a plan
    violation: float = np.inf
    gap: float = np.nan
    origin: str = ""  # in words, the plan of another problem with which it began
    detail: str = ""
    values: dict[str, Any] = field(default_factory=dict)  # cost-to-go, cost-to-come and inverse policy, for `assemble`
    multipliers: tuple[Multipliers, ...] = ()
    certificate: Certificate | None = None
    decisive: bool = False  # whether no other start can do better
    stuck: bool = False  # whether the violation no longer falls, however large the penalty
    # Of a plan whose violation is stationary: the violation in a measure that is the same for a whole search; and what
    # conflicts with the violated constraints, in words, the strongest first.
    missed: float = np.nan
    against: tuple[str, ...] = ()
    remedy: str = ""  # one that is known already; empty for the usual one

    @property
    def states(self) -> Array:
        return self.plan.states

    @property
    def controls(self) -> Array:
        return self.plan.controls

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """Sort key, best first: success, then INFEASIBLE before other failures, then violation, then cost."""
        missed = 0.0 if self.success else float(f"{self.violation:.2g}")
        return not self.success, self.status is not Status.INFEASIBLE, missed, self.cost

    def is_worse(self, other: "RunResult", work: "Workspace") -> bool:
        """Whether this plan violates constraints more than another, or costs more if both violate them as much."""
        if not np.isfinite(other.cost):
            return False
        # The violations to two digits; 0 within the tolerances.
        missed, others = (
            0.0 if work.keeps(result.plan) else float(f"{result.violation:.2g}") for result in (self, other)
        )
        return missed > others or (missed == others and self.costs_more(other, work))

    def costs_more(self, other: "RunResult", work: "Workspace") -> bool:
        """Whether this plan costs more than another, by more than rounding.

        What active constraints cost by ending inside, and the other plan saves by missing them within the tolerance, is
        rounding, too: a given optimum may be on its bounds. Where both costs are rounding, as where a goal is met
        exactly, the tolerance follows from the size of the terms that cancel.
        """
        rounding = ROUNDING * abs(other.cost) + MARGIN_SQUARES * float(work.memory["negligible"])
        for multipliers, pressing in zip(work.multipliers, self.multipliers, strict=False):
            rounding += float(np.abs(pressing.values).sum()) * (multipliers.margin + other.violation)
        return not self.cost <= other.cost + rounding

    @property
    def success(self) -> bool:
        return self.status.success

    def kept(self) -> "RunResult":
        """A copy that later iterations, which write to the same memory, do not change."""
        return replace(self, plan=deepcopy(self.plan), policy=deepcopy(self.policy), values=deepcopy(self.values))


class LoopCall(NamedTuple):
    """The arguments of the compiled loop; see `kernels/iterations.py`."""

    task: int
    first: int
    last: int
    settings: records.IterationSettings
    model: records.ProblemModel
    arrays: records.SmootherArrays
    memory: StructuredArray
    log: StructuredArray


class SolveRun:
    """Iterated LQR smoothing from one start, and its current state.

    Attributes:
      initial_guess: the start. work: the memory. budget: the iterations and the time.
      ending: the state of smoothing or iLQR; the outcome is RUNNING until it has ended.
      method: what ends the solve, and with which tolerances.
    """

    def __init__(
        self, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array, budget: Budget,
        entry: str = "smoother",
    ) -> None:  # fmt: skip
        """Use the memory that an earlier run gave back, if there is any, and overwrite that run's result."""
        if settings.first_pass == "backward" and (initial_guess.gain.any() or problem.dynamics.discrete):
            initial_guess = initial_guess.rolled_out(problem, start)
        self.problem, self.settings, self.initial_guess, self.budget = problem, settings, initial_guess, budget
        kind = entry, compiled.core(problem, settings.form), problem.steps
        self.work = _pool.take(lambda idle: idle.kind == kind) or Workspace(problem, settings.form, entry)
        self.work.begin(problem, settings, initial_guess, start)
        self.method, self.work.stop = self.work.method, budget.stop
        self._stages: Stages | None = None
        self._rows, self._row = np.zeros(max(budget.left, 1), LOG), 0  # rows of smoothing, and the next row
        self._last: Iteration | None = None  # the last iteration of smoothing
        self.ending = Ending(declarations.RUNNING)
        self._valley = VALLEY if self.method.curved else 0.0
        # Fractions of the obstacle costs in the iterations; the last fraction holds for all later iterations.
        self._fractions = (*(initial_guess.prior.obstacles if initial_guess.prior is not None else ()), 1.0)
        self._loop = self.work.compiled_call(self.work.core, entry, *self._arguments(0, 0, self._rows))

    def give_back(self) -> None:
        """Let later runs have the memory."""
        self.release_stages()
        self.work.stop = Stop()  # the solve's has its callback and exception, which later runs need not keep
        _pool.give_back(self.work, self.problem)

    @property
    def cost(self) -> float:
        """True cost of the last rollout; infinite if there is no rollout, or a pass failed."""
        return np.inf if self.ending.pass_failed else _cost_of(self._last)

    @property
    def stages(self) -> Stages:
        """The stages of the problem, in memory that is lent until the result is certified, or the run's given back."""
        if self._stages is None:
            with self.budget.stop.not_counting():  # compiling
                self._stages = Stages.lent(self.problem)
        return self._stages

    def release_stages(self) -> None:
        if self._stages is not None:
            self._stages.give_back()
            self._stages = None

    # The phases of a run.

    def run_to_end(self, *, return_best: bool = True) -> RunResult:
        """Smooth, unless that has ended; near an optimum take Newton's steps; if the method fails, the safeguard's.

        With `return_best`, a stopped run returns its best plan, which needs another pass for a policy.
        """
        self.smooth(len(self._rows))
        if self.ending.outcome == declarations.IN_VALLEY:
            self.set_aside()
            result = self.newton()
            if result.success or self.budget.over:
                return result
            self.resume()
            self.smooth(len(self._rows))
        ending = self.checked_ending()
        lost = ending is not self.ending  # a function is not finite at the start, so nothing can help
        result = self.result(ending)
        if lost or (result.success and not self.method.exact):
            return result
        if ending.outcome == declarations.TIMED_OUT or (self.settings.safeguard and not self.budget.left):
            return self.best(result) if return_best else result
        if result.success:
            return self.newton(patient=True)
        return self.safeguard(result) if self.settings.safeguard else result

    def smooth(self, most: int) -> None:
        """Continue until smoothing has done `most` iterations, or ends."""
        if self.ending.outcome != declarations.RUNNING:
            return
        if not self._row and not self.run_opening_pass():
            return
        begin, most = len(self.budget.log), min(most, len(self._rows))
        self.ending = self._iterate(self._arguments, self.work.arrays.last, self._rows, self._row, most)
        if len(self.budget.log) > begin:
            self._row, self._last = self._row + len(self.budget.log) - begin, self.budget.log[-1]
        if self.ending.outcome == declarations.TIMED_OUT and not self._row:
            self.roll_out()

    def run_opening_pass(self) -> bool:
        """Do the backward pass that comes before the first iteration, if any; return whether it succeeded."""
        if self.settings.first_pass == "forward":
            return True
        self.roll_out()  # before its arrays are overwritten
        work = self.work
        arrays, homotopy_scaled = work.arrays, work.model._replace(stage=work.homotopy_scaled(self._fractions[0]))
        failed, good = work.core.opening_pass(
            self.problem.steps, self.initial_guess.trajectory is not None, arrays.guess, work.prior, homotopy_scaled,
            arrays.policy, arrays.to_go,
        )  # fmt: skip
        if failed >= 0:
            outcome = declarations.NOT_POSITIVE_DEFINITE if good else declarations.NOT_FINITE
            self.ending = Ending(outcome, failed=failed, backward=True)
        return failed < 0

    def roll_out(self) -> None:
        """Roll out the initial guess, before any iteration; the states and controls are in `work`."""
        self._loop(*self._arguments(0, 0, self._rows))

    def checked_ending(self) -> Ending:
        """The ending. If a function is not finite at the start: NOT_FINITE, or InputError if the solve is attentive."""
        first, ending = self._rows["cost"][: min(self._row, 1)], self.ending
        if not np.isfinite(first).all() or (not len(first) and ending.status is Status.NOT_FINITE):
            try:
                check_start(self.problem, self.work.start, self.initial_guess.offset[0])
            except InputError as error:
                if self.budget.stop.attentive:
                    raise
                return replace(ending, outcome=declarations.NOT_FINITE, raised=str(error))
        return ending

    def newton(self, *, detail: str = "", added: float = 0.0, least: float = 0.0, patient: bool = False) -> RunResult:
        """Newton's method from the best plan so far; if no other method can follow, with short steps too."""
        ending = self.descend(NEWTON_STEPS._replace(patient=patient), self.method.tolerance, added=added, least=least)
        status = ending.status
        if ending.outcome == declarations.STALLED:
            detail = joined(detail, "Newton's method makes no progress")
        if patient and ending.outcome != declarations.TIMED_OUT and not status.success and self.work.memory["damping"]:
            status = Status.NOT_POSITIVE_DEFINITE  # its last models had no minimum without weights
        return self.damped_result(ending, status, detail)

    def safeguard(self, result: RunResult) -> RunResult:
        """Damped iterations from the best plan so far, after smoothing failed."""
        work, detail = self.work, f"the undamped method failed ({result.detail or result.status.meaning})"
        damped = None
        for least in ((NEARLY, NEAR), (0.0, 0.0)) if self.method.exact else ((0.0, 0.0),):
            damped = self.damped(least=least)
            if not (self.method.exact and damped.success) or self.budget.over:
                break
            result = self.newton(detail=detail, patient=True)
            if result.success or self.budget.over:
                return result
        assert damped is not None
        if not np.isfinite(work.cost):
            # Nothing helps: report the failure.
            given_up = result.status in (Status.MAX_ITERATIONS, Status.STALLED)
            return replace(result, status=Status.DIVERGED if given_up else result.status, detail=detail, values={})
        if self.method.exact and damped.success:
            return result
        if self.method.exact and not self.budget.over:
            # Newton's passes are about the plan, and need no inverse of the controls' weights.
            return self.newton(detail=detail, patient=True)
        status = damped.status
        if damped.outcome == declarations.STALLED:
            # The plan is finite, whatever the undamped method met on its way; the detail names it. What a user's
            # function raised is to be mended first.
            lost = self.ending.status in (Status.NOT_FINITE, Status.DIVERGED) and not self.ending.raised
            status = Status.STALLED if lost else self.ending.status
            detail = f"{detail}; from the best plan, no step lowers the cost any more"
        return self.damped_result(damped, status, detail)

    def damped(self, *, added: float = 0.0, least: tuple[float, float] = (0.0, 0.0)) -> Ending:
        """Damped iterations from the best plan so far, with tolerances of cost and gap of at least `least`."""
        return self.descend(DAMPED_STEPS, max(self.method.rough, least[0]), least[1], added=added)

    def descend(
        self, how: Descent, tolerance: float, gap_tolerance: float = 0.0, *, added: float = 0.0, least: float = 0.0
    ) -> Ending:
        """Steps from the best plan so far; `gap_tolerance` is the least, for the rest see `Workspace.begin_descent`."""
        self.work.begin_descent(how, added, least)
        arguments = partial(self._plan_arguments, declarations.DESCEND, how, tolerance, gap_tolerance)
        return self._iterate(arguments, self.work.best)

    def ilqr(self) -> Ending:
        """Iterations of iLQR, from the rollout of the first policy; with the entry "ilqr". The ending is checked."""
        arguments = partial(self._plan_arguments, declarations.ITERATE, records.NO_DESCENT, self.method.tolerance, 0.0)
        self.ending, self._row = self._iterate(arguments, self.work.best, self._rows), len(self.budget.log)
        return self.checked_ending()

    def smooth_with_constraints(self, rows: StructuredArray, first: int, last: int) -> Ending:
        """Run more iterations, in separate rows. A prior no longer acts."""
        # With constraints the least cost is no measure, and a rollout of lower cost is no better plan.
        self.work.memory["watched"], self.work.memory["plan_cost"] = 0.0, -np.inf
        begin, again = len(self.budget.log), partial(self._arguments, again=True)
        ending = self._iterate(again, self.work.arrays.last, rows, first, last)
        if len(self.budget.log) > begin:
            self._last = self.budget.log[-1]
        return ending

    def set_aside(self) -> None:
        """Leave smoothing for another method; if that fails, `resume` goes on from here."""
        arrays = self.work.arrays
        saved = *arrays.policy, *arrays.last_policy, *arrays.to_go, arrays.x_hat
        self._set_aside = [(array, array.copy()) for array in saved], len(self.budget.log)  # and iterations so far

    def resume(self) -> None:
        """Smooth from where that was set aside, without the test that hands over to Newton's method.

        Iterations of other methods that failed count as smoothing's, which has to make progress from there.
        """
        saved, begin = self._set_aside
        for array, copy in saved:
            array[...] = copy
        others = self.budget.log[begin:]
        for row, other in zip(self._rows[self._row :], others, strict=False):
            row["cost"], row["improvement"], row["gap"] = other.cost, other.improvement, other.gap
            row["optimality"] = np.nan
        self._row = min(self._row + len(others), len(self._rows))
        self._valley = 0.0
        self.ending = replace(self.ending, outcome=declarations.RUNNING)

    def linearize_about_plan(self) -> float:
        """Compute policy and value functions about the plan in memory; return its optimality, NaN if that fails."""
        self.work.begin_descent(DAMPED_STEPS)
        return self._linearize()[0]

    def fails_at(self, risk: float) -> int:
        """The step at which a pass about the plan in memory fails with another risk, or -1; with noise only."""
        self.work.model.noise.risk[0] = risk
        _, failed = self._linearize()
        self.work.model.noise.risk[0] = self.problem.risk
        return failed

    def largest_risk(self, high: float) -> float:
        """The largest risk with which a pass about the plan in memory does not fail, given one with which it does."""
        low = 0.0
        while high - low > DIGITS * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.fails_at(middle) < 0 else (low, middle)
        return low

    # The results of a run.

    def result(self, ending: Ending) -> RunResult:
        work, last = self.work, self._last
        return RunResult(
            status=ending.status, detail=ending.detail(self.problem.steps), plan=work.last,
            policy=work.arrays.last_policy, cost=_cost_of(last), violation=np.inf if last is None else last.violation,
            gap=np.nan if last is None else last.gap,
            values={} if ending.pass_failed or last is None else work.value_functions(),
        )  # fmt: skip

    def best(self, last: RunResult) -> RunResult:
        """The best plan so far in place of the last one, with a policy and value functions about it."""
        cost = self.work.cost
        if not np.isfinite(cost) or (not cost < last.cost and last.values):
            return last
        status = Status.MAX_ITERATIONS if last.status is Status.DIVERGED else last.status  # this plan did not
        return self.about_plan(status, joined(last.detail, "the plan is the best so far"))

    def damped_result(self, ending: Ending, status: Status, detail: str) -> RunResult:
        """Result of damped iterations or Newton's: the plan, with policy and value functions about it."""
        if ending.outcome in (declarations.RUNNING, declarations.TIMED_OUT):  # the run was stopped without looking back
            policy = self.work.arrays.last_policy
            return self.best(RunResult(status=status, detail=detail, plan=self.work.last, policy=policy))
        return self.about_plan(status, detail, self.budget.log[-1].optimality if self.budget.log else np.nan)

    def about_plan(self, status: Status, detail: str = "", optimality: float | None = None) -> RunResult:
        """The plan in memory, with policy and value functions about it; by default these are computed now."""
        work, optimality = self.work, self.linearize_about_plan() if optimality is None else optimality
        values, policy, gap = {}, work.arrays.policy, float(work.memory["final_gap"])
        if not np.isfinite(optimality):  # there is neither a model about the plan nor a policy
            policy, gap = Policy(np.zeros_like(work.arrays.policy.gain), work.best.controls.copy()), np.nan
        else:
            values = work.value_functions()
            if not gap < self.settings.gap_tolerance:
                # As for iLQR, whose steps need neither of these.
                values["cost_to_come"] = values["inverse_policy"] = None
                off, gap = gap, np.nan
                why = f"the states of least total cost are {off:.1g} off the plan"
                if not np.isfinite(off):
                    why = "its pass needs a cost that is curved in every control"
                detail = joined(detail, f"the cost-to-come is left out: {why}")
        return RunResult(
            status=status, detail=detail, plan=work.best, policy=policy, cost=work.cost,
            violation=work.violation_of(work.best), gap=gap, values=values,
        )  # fmt: skip

    def weigh_noise(self, plan: Motion) -> None:
        """From now on, weigh noise whose cost depends on the plan by the cost-to-go about this plan without penalties.

        A penalty's curvature comes and goes with the active set, and with it the cost of the noise would: a step that
        lowers the cost for one active set raises it for the next, and the iterations repeat themselves for ever. Nor
        are penalties costs of a run, for constraints are those of the plan.
        """
        term, arrays = self.problem.noise_term, self.work.arrays
        if term is None or not (term.active or self.problem.risk):
            return
        memory, to_go = self.work.memory_rows.copy(), no_value(plan.states)
        apart = arrays._replace(
            best=plan, last=self.work.trial, to_go=to_go, prior=self.work.no_prior, x_hat=arrays.x_hat.copy(),
            x_hats=arrays.x_hats.copy(), policy=deepcopy(arrays.policy),
            to_come=deepcopy(arrays.to_come), smoothing=deepcopy(arrays.smoothing),
        )  # fmt: skip
        _, failed = self._linearize(model=self.work.without_penalties(), arrays=apart, memory=memory)
        if failed < 0:
            noise = self.work.model.noise
            noise.hessian[...], noise.gradient[...], noise.risk[2] = to_go.hessian, to_go.gradient, 1.0

    def candidate(self, name: str, result: RunResult | None) -> Candidate:
        """This run as a candidate of a search; `result` is its result if it was run to its end."""
        plan = self.work.last if result is None else result
        plan = Trajectory(plan.states.copy(), plan.controls.copy(), self.problem.dt)
        cost, status = (self.cost, None) if result is None else (result.cost, result.status)
        return Candidate(name, cost, len(self.budget.log), status, plan)

    # The compiled loop, and its arguments.

    def check(
        self, task: int, result: RunResult, to_go: CostToGo, certificate: StructuredArray,
        model: records.ProblemModel | None = None,
    ) -> None:  # fmt: skip
        """Check a plan and its policy with a cost-to-go, by `kernels/certificate.py`; by default of the run's model."""
        call = self._stated(
            task, 0, 0, self._rows, self.method.tolerance, {}, to_go=to_go, last=result.plan, last_policy=result.policy,
            certificate=certificate,
        )  # fmt: skip
        self._loop(*call._replace(model=model or call.model))

    def _iterate(
        self, arguments: Callable[[int, int, StructuredArray], LoopCall], plan: Motion,
        rows: StructuredArray | None = None, first: int = 0, last: int | None = None,
    ) -> Ending:  # fmt: skip
        """Run the loop with these arguments until it ends, has written `last` rows, or the budget is over.

        Compiled code returns after each iteration if there is a callback, a deadline or a constraint to check, and
        otherwise after `ATTENTION` if the solve is attentive. The seconds of an iteration are averaged over the
        iterations between two returns. An iteration writes `plan`; rows are written from `first` on, by default as many
        as are left.
        """
        budget, stop, functions = self.budget, self.budget.stop, functions_of(self.problem)
        rows = np.zeros(max(budget.left, 1), LOG) if rows is None else rows
        last, missed = min(budget.left if last is None else last, first + budget.left), 0.0
        single = self.problem.constraints or stop.deadline < np.inf or (stop.attentive and budget.watched)
        attention = 0.0 if single else ATTENTION if stop.attentive else np.inf
        for function in functions:
            function.forget()
        if first < last and stop.due:
            return Ending(declarations.TIMED_OUT, len(budget.log))

        def run(begin: int, end: int) -> Sequence[Any]:
            nonlocal missed
            ended = self._loop(*arguments(begin, end, rows))
            if ended[0] > begin:
                missed = self.work.violation_of(plan)
            return ended

        def watch(row: tuple[Any, ...], seconds: float) -> bool:
            cost, improvement, gap, optimality, residual, method = row
            name = _METHODS[int(method)]
            budget.record(Iteration(cost, improvement, gap, optimality, residual, missed, seconds, name))
            return stop.error is not None

        ending, clock = Ending(declarations.RUNNING), stop.elapsed
        slices = in_slices(run, rows[:last], watch, functions, attention, first=first)
        try:
            for (done, outcome, backward, failed), over in slices:
                now = stop.elapsed
                stop.pace, clock = now - clock, now
                if over or (outcome == declarations.RUNNING and done < last and stop.due):
                    outcome = declarations.TIMED_OUT
                ending = Ending(outcome, failed=failed, backward=backward)
                if outcome != declarations.RUNNING:
                    break
        except BaseException as error:  # Ctrl-C: raised again when there is a solution
            stop.error, ending = error, Ending(declarations.TIMED_OUT)
        return replace(ending, done=len(budget.log), raised=raised_by(functions))

    def _arguments(self, first: int, last: int, rows: StructuredArray, *, again: bool = False) -> LoopCall:
        """Arguments of the loop for iterations from `first` up to `last`; one at a time during a homotopy."""
        work, tolerance, valley = self.work, self.method.rough, 0.0 if again else self._valley
        fraction = 1.0 if again else self._fractions[min(first, len(self._fractions) - 1)]
        if fraction != 1:
            last = min(last, first + 1)
            tolerance = valley = 0.0  # with only a part of the cost, the iterations must not converge
        guided = self.initial_guess.trajectory is not None and self.settings.first_pass == "forward" and not again
        prior, count = (work.no_prior, 0) if again else (work.prior, work.prior_iterations)
        return self._stated(
            declarations.ITERATE, first, last, rows, tolerance,
            {"guided": guided, "prior_iterations": count, "valley": valley}, prior=prior,
            homotopy_scaled=work.homotopy_scaled(fraction),
        )  # fmt: skip

    def _plan_arguments(
        self, task: int, how: Descent, tolerance: float, gap_tolerance: float, first: int, last: int,
        rows: StructuredArray,
    ) -> LoopCall:  # fmt: skip
        """Arguments for steps from the plan, with this tolerance of the cost and at least that of the gap."""
        options = {"descent": how, "gap_tolerance": max(self.settings.gap_tolerance, gap_tolerance)}
        return self._stated(task, first, last, rows, tolerance, options, prior=self.work.no_prior, last=self.work.trial)

    def _linearize(self, **changed: Any) -> tuple[float, int]:
        """The optimality of the plan in memory, NaN if a pass fails, and the step at which it does, or -1."""
        rows = np.full(1, np.nan, LOG)
        call = self._plan_arguments(declarations.LINEARIZE, DAMPED_STEPS, self.method.rough, 0.0, 0, 0, rows)
        *_, failed = self._loop(*call._replace(**changed))
        return float(rows["optimality"][0]), failed

    def _stated(
        self, task: int, begin: int, end: int, rows: StructuredArray, tolerance: float, options: dict[str, Any],
        **arrays: Any,
    ) -> LoopCall:  # fmt: skip
        """Arguments for at most one iteration per row, with other options than the run's, and other arrays."""
        work, settings = self.work, records.IterationSettings(
            steps=self.problem.steps, max_iterations=len(rows), tolerance=float(tolerance),
            gap_tolerance=self.settings.gap_tolerance, optimal=self.settings.stop == "optimal", fixed=self.work.fixed,
            rounding=self.problem.dynamics.rounding**2,
        )  # fmt: skip
        arrays_ = work.arrays._replace(**arrays)
        return LoopCall(task, begin, end, settings._replace(**options), work.model, arrays_, work.memory_rows, rows)


class Workspace:
    """The memory of a run, which its iterations read and write.

    Attributes:
      arrays: `records.SmootherArrays`. model: the problem's numbers. memory: what the iterations remember, a row of
        `MEMORY`; memory_rows: (1,) that row.
      multipliers: multipliers of each constraint; changes act at once.
      start: (n,) the start state. best: the best plan so far. last: the last rollout of smoothing. trial: the rollout
        that a line search from the best plan tries. core: the compiled iterations. kind: what its runs have in common.
      fixed: whether the start is given exactly. method: as in `SolveRun`. stop: that of the run's budget.
    """

    def __init__(self, problem: Problem, form: str, entry: str) -> None:
        self._dual, self._calls, self.stop = form == "dual", dict[str, Call](), Stop()
        self.core, self._costs = compiled.core(problem, form), compiled.costs_module(problem)
        self.kind = entry, self.core, problem.steps
        self.memory_rows = np.zeros(1, records.MEMORY)
        self.memory = self.memory_rows[0]
        space, controls = problem.dynamics.state_coordinates, problem.control_coordinates
        sizes = {"T": problem.steps, "N": len(space), "M": len(controls)}
        self.no_prior = zeros_of(Prior, **sizes)
        stated = {"homotopy_scaled": None, "prior": self.no_prior, "certificate": np.zeros(1, CERTIFICATE)}
        self.arrays = zeros_of(records.SmootherArrays, stated, **sizes, S=problem.steps if self._dual else 1)
        self.start, self.trial = self.arrays.start, zeros_of(Motion, **sizes)
        self.best, self.last = self.arrays.best, self.arrays.last

    def compiled_call(self, module: CompiledModule, name: str, *arguments: Any) -> Call:
        """The call of a function, which is compiled if it is new; its arguments are laid out once."""
        if name not in self._calls:
            with self.stop.not_counting():  # compiling
                self._calls[name] = module.lay_out(name, *arguments)
        return self._calls[name]

    def begin(self, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array) -> None:
        """Begin a solve. The memory may have served another solve of the same size and number of steps."""
        self._problem, steps = problem, problem.steps
        self.method = method = settings.method(problem)
        self.priced, self.fixed = np.isfinite(method.price), isinstance(problem.initial, FixedState)
        self.prior, self.prior_iterations = self.no_prior, 0
        if initial_guess.prior is not None:
            about = np.broadcast_to(initial_guess.prior.about, (steps + 1, len(start))).copy()
            self.prior = Prior(initial_guess.prior.weight.copy(), about)
            self.prior_iterations = initial_guess.prior.iterations
        spare = INSIDE * method.violation if method.exact else method.violation
        self.multipliers = [
            compiled.ConstraintMultipliers(problem, term, spare, method.price) for term in problem.constraint_terms
        ]
        for multipliers, known in zip(self.multipliers, initial_guess.multipliers, strict=False):
            multipliers.penalty, multipliers.values[...] = known.penalty, known.values.ravel()
        self.model = compiled.compile_problem(problem, multipliers=self.multipliers, second_order=method.exact)
        arrays = self.arrays = self.arrays._replace(homotopy_scaled=self.model.stage, prior=self.prior)
        # All other memory is written before it is read.
        self.memory_rows[...] = 0.0
        self.memory["watched"] = float(settings.safeguard)
        arrays.start[...] = arrays.x_hat[...] = start
        arrays.policy.gain[...], arrays.policy.offset[...] = initial_guess.gain, initial_guess.offset
        value = initial_guess.cost_to_go
        known = (0.0, 0.0, 0.0) if value is None else (value.hessian, value.gradient, value.constant)
        for array, numbers in zip(arrays.to_go, known, strict=True):
            array[...] = numbers
        # Without a trajectory, use the start state, and the controls with which the dynamics can run backwards.
        plan = initial_guess.trajectory
        for array in (arrays.guess, arrays.best):
            array.states[...] = start if plan is None else plan.states
            array.controls[...] = initial_guess.offset if plan is None else plan.controls

    @property
    def cost(self) -> float:
        return float(self.memory["plan_cost"])

    def set_best(self, plan: Motion, cost: float = np.inf) -> None:
        """Make a plan the best one; its cost is infinite where it is not known."""
        self.best.states[...], self.best.controls[...] = plan
        self.memory["plan_cost"] = cost

    def begin_descent(self, how: Descent, added: float = 0.0, least: float = 0.0) -> None:
        """Begin steps from the best plan; `added` is the constraints' share of its cost.

        Its optimality is relative to the cost, or to `least` if that is more.
        """
        memory = self.memory
        memory["merit"], memory["least"] = memory["plan_cost"] + added, least
        memory["reach"], memory["second_order"] = how.reach, how.second_order
        memory["known"], memory["extra_steps"] = 0.0, 0.0
        memory["weight"], memory["small_changes"], memory["idle"] = 0.0, 0.0, 0.0
        memory["ilqr_left"], memory["ilqr_next"], memory["since_ilqr"] = 0.0, 2.0, 0.0

    def value_functions(self) -> dict[str, Any]:
        """Cost-to-go, cost-to-come and inverse policy of the last passes, for `assemble`."""
        to_go, to_come = Quadratic(*self.arrays.to_go), self.arrays.to_come
        inverse = self.arrays.smoothing.control_gain, self.arrays.smoothing.control
        if not self._dual:
            return {"cost_to_go": to_go, "cost_to_come": Quadratic(*to_come), "inverse_policy": inverse}
        covariance, mean, _ = to_come
        policy = None
        if not self.fixed:  # otherwise the first covariances are singular
            # u = gain costate + offset, where the costate at a state of arrival x is -covariance^-1 (x - mean).
            with contextlib.suppress(np.linalg.LinAlgError):
                gain = -np.linalg.solve(covariance[1:], np.swapaxes(inverse[0], 1, 2))
                gain = np.ascontiguousarray(np.swapaxes(gain, 1, 2))
                policy = gain, inverse[1] - np.einsum("tij,tj->ti", gain, mean[1:])
        return {"cost_to_go": to_go, "cost_to_come": Moments(*to_come), "inverse_policy": policy}

    def without_penalties(self) -> records.ProblemModel:
        """The model without constraints, whose noise is weighed by its own cost-to-go."""
        model = self.model
        stage, final = (
            cost._replace(constraints=cost.constraints._replace(size=0)) for cost in (model.stage, model.final)
        )
        return model._replace(stage=stage, final=final, noise=model.noise._replace(risk=model.noise.risk * (1, 1, 0)))

    def homotopy_scaled(self, fraction: float) -> records.CostModel:
        """The stage cost with its homotopy-scaled terms at that fraction; see `CostTerm.factor`."""
        if fraction == 1:
            return self.model.stage
        data = list(self.model.stage.data)
        for i, term in enumerate(compiled.cost_terms(self._problem, "stage_cost")):
            if term.factor is not None:
                data[i] = data[i].copy()
                data[i][len(term.functions) + term.factor] *= fraction
        return self.model.stage._replace(data=tuple(data))

    def roll_out(self, policy: Policy, state: Array) -> Motion:
        plan = Motion(np.empty_like(self.last.states), np.empty_like(self.last.controls))
        of = self._problem.steps, in_c_order(state), Policy(*map(in_c_order, policy)), self.model, plan
        with self._problem.dynamics.quiet():
            self.compiled_call(self.core, "rollout", *of)(*of)
        return plan

    def constraint_values(self, plan: Motion) -> list[Array]:
        """Values of each constraint, (T+1, rows): d >= 0 or d = 0; infinite or zero if it does not act."""
        values = [np.empty_like(multipliers.values) for multipliers in self.multipliers]
        if values:
            of = self._problem.steps, *map(in_c_order, plan), self.model.stage.constraints, tuple(values)
            self.compiled_call(self._costs, "evaluate_constraints", *of)(*of)
        return [numbers.reshape(self._problem.steps + 1, -1) for numbers in values]

    def constraint_slope(self, which: int, row: int, x: Array, u: Array, step: int) -> Array:
        slope = np.zeros(len(x) + len(u))
        self._costs.slope_of_constraint(which, row, x, u, step, self.model.stage.constraints, slope)
        return slope

    def violation_of(self, plan: Motion) -> float:
        """The largest violation of a constraint; infinite if one is NaN."""
        pairs = zip(self.multipliers, self.constraint_values(plan), strict=True)
        return max((violation_of(multipliers.term, numbers) for multipliers, numbers in pairs), default=0.0)

    def keeps(self, plan: Motion) -> bool:
        """Whether a plan keeps all constraints within their tolerance, or at their price."""
        allowed = partial(allowed_violation, tolerance=self.method.violation, spared=not self.method.exact)
        pairs = zip((multipliers.term for multipliers in self.multipliers), self.constraint_values(plan), strict=True)
        return self.priced or all(violation_of(term, numbers) <= allowed(term) for term, numbers in pairs)


def copied(plan: RunResult | Trajectory | Motion) -> Motion:
    """A copy of the states and controls of a plan."""
    return Motion(plan.states.copy(), plan.controls.copy())


def no_value(states: Array) -> CostToGo:
    """A cost-to-go of zero along states (T+1, n): arguments where there is none."""
    knots, n = states.shape
    return CostToGo(np.zeros((knots, n, n)), np.zeros((knots, n)), np.zeros(knots))


_pool = Pool[Workspace]()


def _cost_of(iteration: Iteration | None) -> float:
    """The cost of the plan; infinite if there is no plan, or its cost is unknown."""
    return iteration.cost if iteration is not None and np.isfinite(iteration.cost) else np.inf

"""The method from one start, as far as it has got; and the safeguard, where it fails."""

import threading
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import LOG, CostToGo, IterationSettings, Motion, Policy, StructuredArray
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Candidate, Certificate, Iteration, Multipliers, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.certify import certified
from lqrsim.solvers.common import Callback, SmootherSettings, Stop, Termination, check_outcome, iterate
from lqrsim.solvers.initial_guess import InitialGuess
from lqrsim.solvers.workspace import Workspace

MOST_KEPT, LARGEST_KEPT = 16, 8 * 1024 * 1024  # attempts, and bytes of each, whose memory waits for the next solve
# Newton's method takes over where the states of least total cost are so near to the rollout, relative to its range:
# smoothing has then found the valley, and what is left is the way along it. Damped iterations, which come there slowly,
# end where the cost falls by less than NEARLY, twice, with a gap below NEAR.
VALLEY, NEARLY, NEAR = 0.2, 1e-2, 0.1
_idle: "list[Attempt]" = []
_lending = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class AttemptResult:
    """What there is to answer with; see `assemble`. With `final`, another start would not do better.

    `cost` is that of the plan, as the iterations that led to it say: infinite where there is none.
    """

    status: Status
    detail: str
    iterations: tuple[Iteration, ...]
    states: Array
    controls: Array
    law: tuple[Array, Array]
    cost: float
    violation: float
    gap: float
    values: dict[str, Any] = field(default_factory=dict)
    multipliers: tuple[Multipliers, ...] = ()
    certificate: Certificate | None = None
    final: bool = False

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """The smaller, the better: success first, then what is known of why not, then constraints, then the cost."""
        missed = 0.0 if self.success else float(f"{self.violation:.2g}")
        return not self.success, self.status is not Status.INFEASIBLE, missed, self.cost

    @property
    def success(self) -> bool:
        """As of a Solution."""
        return self.status.success


class Attempt:
    """Iterated LQR smoothing from one start.

    Attributes:
      initial_guess: where it starts from. work: its memory.
      termination: how it stands; its outcome is RUNNING until it has ended.
      newton: whether Newton's method has the last iterations. final, rough: the tolerances of the answer, and of what
        smoothing comes to; see `SmootherSettings`.
    """

    def __init__(
        self, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array, stop: Stop
    ) -> None:
        self.problem, self.settings, self.stop = problem, settings, stop
        if settings.first_pass == "backward" and (initial_guess.gain.any() or problem.dynamics.discrete):
            initial_guess = initial_guess.rolled_out(problem, start)
        self.work = Workspace(problem, settings, initial_guess, start)
        self._log = np.zeros(settings.max_iterations, LOG)
        self._begin(initial_guess)
        self._loop = self.work.core.lay_out("smoother", *self._arguments(0, 0, self._log))

    @classmethod
    def lent(
        cls, problem: Problem, settings: SmootherSettings, initial_guess: InitialGuess, start: Array, stop: Stop
    ) -> "Attempt":
        """One in memory that an earlier solve gave back, where there is some, for allocating takes its time.

        What the earlier solve returned is written over, so that it has to be copied before.
        """
        core, steps = compiled.core(problem, settings.form), problem.steps
        if settings.first_pass == "forward":
            with _lending:
                for attempt in reversed(_idle):
                    if attempt.work.core is core and attempt.problem.steps == steps:
                        _idle.remove(attempt)
                        attempt.problem, attempt.settings, attempt.stop = problem, settings, stop
                        break
                else:
                    attempt = None
            if attempt is not None:
                attempt.work.begin(problem, settings, initial_guess, start)
                if len(attempt._log) != settings.max_iterations:
                    attempt._log = np.zeros(settings.max_iterations, LOG)
                attempt._begin(initial_guess)
                return attempt
        return cls(problem, settings, initial_guess, start, stop)

    def give_back(self) -> None:
        """Leave the memory to another solve."""
        if self.problem.steps * self.problem.bytes_per_step <= LARGEST_KEPT:
            with _lending:
                _idle.append(self)
                del _idle[:-MOST_KEPT]

    def _begin(self, initial_guess: InitialGuess) -> None:
        self.initial_guess = initial_guess
        self.work.memory["watched"] = float(self.settings.safeguard)
        self.termination = Termination((), declarations.RUNNING, False, -1, "")
        settings, problem = self.settings, self.problem
        self.newton, self.final, self.rough = settings.newton(problem), settings.final(problem), settings.rough(problem)
        self._valley = VALLEY if self.newton else 0.0
        self._shares = initial_guess.prior.obstacles if initial_guess.prior is not None else ()

    @property
    def cost(self) -> float:
        """True cost of the last rollout; infinite where there is none, or a pass failed."""
        if self.termination.pass_failed or not self.termination.iterations:
            return np.inf
        cost = self.termination.iterations[-1].cost
        return cost if np.isfinite(cost) else np.inf

    def run(self, last: int, *, each: bool, callback: Callback | None = None) -> None:
        """Go on until there are `last` iterations, or it ends; with `each`, a look after each (see `iterate`)."""
        if self.termination.outcome != declarations.RUNNING:
            return
        if not self.termination.iterations and not self.run_opening_pass():
            return
        self.termination = iterate(
            self.problem, lambda first, last: self._loop(*self._arguments(first, last, self._log)), self._log,
            min(last, self.settings.max_iterations), done=self.termination.iterations, look=self._violation,
            each=each, stop=self.stop, callback=callback,
        )  # fmt: skip
        if self.termination.outcome == declarations.TIMED_OUT and not self.termination.iterations:
            self.roll_out()

    def run_on(
        self, log: StructuredArray, last: int, *, done: tuple[Iteration, ...], each: bool, callback: Callback | None
    ) -> Termination:
        """More iterations of the same kind, with a log of their own; the prior has had its time."""
        self.work.memory["watched"] = 0.0  # with constraints the least cost is no measure
        return iterate(
            self.problem, lambda first, last: self._loop(*self._arguments(first, last, log, again=True)), log, last,
            done=done, look=self._violation, each=each, stop=self.stop, callback=callback,
        )  # fmt: skip

    def roll_out(self) -> None:
        """See where the start leads, if nothing has been done yet; the states and controls are in `work`."""
        self._loop(*self._arguments(0, 0, self._log))

    def finish(self, *, each: bool, callback: Callback | None = None, look_back: bool = True) -> AttemptResult:
        """The method, Newton's where that has found the valley, and its safeguard where it fails.

        With `look_back`, what is stopped has the best plan so far; it takes another pass to make its policy.
        """
        settings = self.settings
        self.run(settings.max_iterations, each=each, callback=callback)
        if self.termination.outcome == declarations.IN_VALLEY:
            kept = self.kept()
            found = self.descend(self.termination.iterations, each=each, callback=callback)
            if found.success or self.stop.due or not self.iterations_left(found.iterations):
                return found
            self.go_on(kept, found.iterations)
            self.run(settings.max_iterations, each=each, callback=callback)
        termination = check_outcome(
            self.problem, self.termination, self.work.start, self.initial_guess.offset[0], refuse=each
        )
        lost = termination is not self.termination  # a function that is not finite at the start: nothing can help
        found = self.result(termination)
        if lost or (found.success and not self.newton):
            return found
        if termination.outcome == declarations.TIMED_OUT or (
            settings.safeguard and self.iterations_left(found.iterations) == 0
        ):
            return self.best(found) if look_back else found
        if found.success:
            return self.descend(found.iterations, each=each, callback=callback)
        return self.rescue(found, each=each, callback=callback) if settings.safeguard else found

    def descend(
        self,
        before: tuple[Iteration, ...],
        *,
        each: bool,
        callback: Callback | None,
        detail: str = "",
        added: float = 0.0,
    ) -> AttemptResult:
        """Newton's method from the best plan so far, which took these iterations; `added` is what constraints add."""
        work, log = self.work, self._log[len(before) :]
        last, trial = len(log), Motion(np.zeros_like(work.states), np.zeros_like(work.controls))
        work.memory["merit"], work.memory["share"] = work.memory["plan_cost"] + added, -1.0
        done = iterate(
            self.problem, lambda first, to: self._loop(*self._newton_arguments(first, to, log, last, trial)), log, last,
            before=before, look=lambda: self._violation_of(work.plan), each=each, stop=self.stop, callback=callback,
        )  # fmt: skip
        if done.outcome == declarations.STALLED:
            detail = f"{detail}; Newton's method comes no further".removeprefix("; ")
        return self.damped_result(done, done.status, detail)

    def kept(self) -> list[Array]:
        """Copies of what smoothing goes on from."""
        return [array.copy() for array in self._going_on]

    def go_on(self, kept: list[Array], iterations: tuple[Iteration, ...]) -> None:
        """Have smoothing go on from there, after others' iterations that came to nothing."""
        for array, copy in zip(self._going_on, kept, strict=True):
            array[...] = copy
        self._valley = 0.0
        self.termination = replace(self.termination, iterations=iterations, outcome=declarations.RUNNING)

    @property
    def _going_on(self) -> tuple[Array, ...]:
        arrays = self.work.arrays
        return *arrays.policy, *arrays.kept, *arrays.to_go, arrays.x_hat

    def iterations_left(self, iterations: tuple[Iteration, ...]) -> int:
        """How many iterations may still follow these."""
        return max(self.settings.max_iterations - len(iterations), 0)

    def result(self, termination: Termination) -> AttemptResult:
        """What the bare method found; `termination` is its own, or one that knows more of why it failed."""
        work, last = self.work, termination.iterations[-1] if termination.iterations else None
        return AttemptResult(
            status=termination.status, detail=termination.detail(self.problem.steps), iterations=termination.iterations,
            states=work.states, controls=work.controls, law=work.arrays.kept, cost=_cost_of(last),
            violation=np.inf if last is None else last.violation, gap=np.nan if last is None else last.gap,
            values={} if termination.pass_failed or last is None else work.value_functions(),
        )  # fmt: skip

    def best(self, found: AttemptResult) -> AttemptResult:
        """The best plan so far in place of the last one, with a policy and value functions about it."""
        cost = float(self.work.memory["plan_cost"])
        if not np.isfinite(cost) or (not cost < found.cost and found.values):
            return found
        optimality = self.linearize_about_plan()
        detail = f"{found.detail}; the plan is the best so far" if found.detail else "the plan is the best so far"
        status = Status.MAX_ITERATIONS if found.status is Status.DIVERGED else found.status  # this plan has not
        return self._about_plan(found.iterations, optimality, status, detail)

    def linearize_about_plan(self) -> float:
        """Make policy and value functions about the plan in the memory; its optimality, NaN if that fails."""
        work, log = self.work, np.full(1, np.nan, LOG)
        trial = Motion(np.zeros_like(work.states), np.zeros_like(work.controls))
        work.memory["merit"] = work.memory["plan_cost"]
        self._loop(*self._damped_arguments(0, 0, log, 1, trial))
        return float(log["optimality"][0])

    def fails_at(self, risk: float) -> int:
        """The step at which a pass about the plan in the memory fails with another risk, or -1; with noise only.

        The arrays of the passes are written over.
        """
        work, log = self.work, np.full(1, np.nan, LOG)
        trial, own = Motion(np.zeros_like(work.states), np.zeros_like(work.controls)), self.problem.risk
        work.model.noise.risk[0] = risk
        *_, failed = self._loop(*self._damped_arguments(0, 0, log, 1, trial))
        work.model.noise.risk[0] = own
        return failed

    def rescue(self, found: AttemptResult, *, each: bool, callback: Callback | None = None) -> AttemptResult:
        """The safeguard: iterations from the best plan so far."""
        work, detail = self.work, f"the undamped method failed ({found.detail or found.status.meaning})"
        work.memory["merit"] = work.memory["plan_cost"]
        damped, before = None, found.iterations
        for least in ((NEARLY, NEAR), (0.0, 0.0)) if self.newton else ((0.0, 0.0),):
            damped = self.run_damped(before=before, least=least, each=each, callback=callback)
            before = damped.iterations
            if not (self.newton and damped.success) or self.stop.due or not self.iterations_left(before):
                break
            found = self.descend(before, each=each, callback=callback, detail=detail)
            if found.success or self.stop.due or not self.iterations_left(found.iterations):
                return found
            before = found.iterations
        assert damped is not None
        if not np.isfinite(work.memory["plan_cost"]):
            # Nothing that was tried leads anywhere. What is left is how it failed.
            status = Status.DIVERGED if found.status is Status.MAX_ITERATIONS else found.status
            return replace(found, status=status, detail=detail, iterations=damped.iterations, values={})
        if self.newton and damped.success:
            return found
        status = damped.status
        if damped.outcome == declarations.STALLED:
            status, detail = self.termination.status, f"{detail}; from the best plan, no step lowers the cost any more"
        return self.damped_result(damped, status, detail)

    def law_about_plan(self) -> tuple[Array, Array]:
        """Gain and offset that make the plan in the memory, by the last pass about it."""
        gain, (states, controls) = self.work.arrays.policy.gain, self.work.plan
        return gain, controls - np.einsum("tij,tj->ti", gain, states[:-1])

    def run_damped(
        self,
        *,
        before: tuple[Iteration, ...],
        least: tuple[float, float] = (0.0, 0.0),
        each: bool,
        callback: Callback | None,
    ) -> Termination:
        """Damped iterations from the plan, whose cost and merit are in the memory; see `kernels/damped_iterations.py`.

        Args:
          before: the iterations that led there. least: what the tolerances of cost and gap are to be at least.
        """
        work, last = self.work, self.iterations_left(before)
        log = np.zeros(max(last, 1), LOG)
        memory = work.memory
        memory["reach"], memory["weight"], memory["small_changes"] = 1.0, 0.0, 0.0
        memory["ilqr_left"], memory["ilqr_next"], memory["since_ilqr"] = 0.0, 2.0, 0.0
        trial = Motion(np.zeros_like(work.states), np.zeros_like(work.controls))

        def run(first: int, to: int) -> tuple[int, int, bool, int]:
            return self._loop(*self._damped_arguments(first, to, log, last, trial, least))

        return iterate(
            self.problem, run, log, last, before=before, look=lambda: self._violation_of(work.plan),
            each=each, stop=self.stop, callback=callback,
        )  # fmt: skip

    def damped_result(self, damped: Termination, status: Status, detail: str) -> AttemptResult:
        """What damped iterations found: the plan, and what was modelled about it."""
        optimality = damped.iterations[-1].optimality if damped.iterations else np.nan
        if damped.outcome in (declarations.RUNNING, declarations.TIMED_OUT):  # they were stopped, and did not look back
            return self.best(
                AttemptResult(
                    status=status, detail=detail, iterations=damped.iterations, states=self.work.states,
                    controls=self.work.controls, law=self.work.arrays.kept, cost=np.inf, violation=np.inf, gap=np.nan,
                )
            )  # fmt: skip
        return self._about_plan(damped.iterations, optimality, status, detail)

    def _about_plan(
        self, iterations: tuple[Iteration, ...], optimality: float, status: Status, detail: str
    ) -> AttemptResult:
        """The plan in the memory, with the policy and the value functions that were made about it last."""
        work = self.work
        states, controls = work.plan
        values, law, gap = {}, work.arrays.policy, float(work.memory["final_gap"])
        if not np.isfinite(optimality):  # there is no model about the plan, nor a policy
            law, gap = (np.zeros_like(work.arrays.policy.gain), controls.copy()), np.nan
        else:
            values = work.value_functions()
            if not gap < self.settings.gap_tolerance:
                # As from iLQR, whose steps need neither of these.
                values["cost_to_come"] = values["inverse_law"] = None
                off, gap = gap, np.nan
                detail += (
                    f"; the states of least total cost are {off:.1g} off the plan, so the cost-to-come is left out"
                )
        return AttemptResult(
            status=status, detail=detail.removeprefix("; "), iterations=iterations, states=states, controls=controls,
            law=law, cost=float(work.memory["plan_cost"]), violation=self._violation_of(work.plan), gap=gap,
            values=values,
        )  # fmt: skip

    def certified(self, found: AttemptResult) -> AttemptResult:
        """With its certificate; a success that fails it is none."""
        values = self.work.constraint_values(found.states, found.controls)
        violation = self.work.violation(values)
        value = found.values.get("cost_to_go")
        certificate, wrong = certified(
            self.problem, lambda task, to_go, out: self._loop(*self._check_arguments(task, found, to_go, out)),
            found.states, value, violation=violation, kept=self.work.keeps(values),
            claimed=found.iterations[-1].cost if found.success else None,
            tolerance=self.final if found.status is Status.CONVERGED else None,
        )  # fmt: skip
        cost = certificate.cost if np.isfinite(certificate.cost) else np.inf
        found = replace(found, certificate=certificate, cost=cost, violation=violation)
        if not wrong:
            return found
        return replace(found, status=Status.NOT_CERTIFIED, detail=f"of the plan that converged: {wrong}")

    def candidate(self, name: str, found: AttemptResult | None) -> Candidate:
        """It, as one of several; `found` if it was run to its end."""
        if found is None:
            plan = Trajectory(self.work.states.copy(), self.work.controls.copy(), self.problem.dt)
            return Candidate(name, self.cost, len(self.termination.iterations), None, plan)
        plan = Trajectory(found.states.copy(), found.controls.copy(), self.problem.dt)
        return Candidate(name, found.cost, len(found.iterations), found.status, plan)

    def run_opening_pass(self) -> bool:
        """Do what comes before the first iteration; False if it fails."""
        if self.settings.first_pass == "forward":
            return True
        self.roll_out()  # before the start is forgotten
        work = self.work
        arrays, homotopy_scaled = work.arrays, work.model._replace(stage=work.homotopy_scaled(self._obstacle_share(0)))
        failed, good = work.core.opening_pass(
            self.problem.steps, self.initial_guess.trajectory is not None, arrays.guess, work.prior, homotopy_scaled,
            arrays.policy, arrays.to_go,
        )  # fmt: skip
        if failed >= 0:
            outcome = declarations.NOT_POSITIVE_DEFINITE if good else declarations.NOT_FINITE
            self.termination = Termination((), outcome, True, failed, "")
        return failed < 0

    def _arguments(self, first: int, last: int, log: StructuredArray, *, again: bool = False) -> tuple[Any, ...]:
        """What the loop takes, for the iterations from `first` up to `last`, or fewer: of a continuation, one."""
        settings, work = self.settings, self.work
        share = 1.0 if again else self._obstacle_share(first)
        tolerance, valley = self.rough, 0.0 if again else self._valley
        if share != 1:
            last = min(last, first + 1)
            tolerance = valley = 0.0  # what is not all of the cost does not settle
        guided = self.initial_guess.trajectory is not None and settings.first_pass == "forward" and not again
        prior, count = (work.no_prior, 0) if again else (work.prior, work.prior_iterations)
        options = self._settings(len(log), tolerance, settings.gap_tolerance)._replace(
            guided=guided, prior_iterations=count, valley=valley
        )
        arrays = work.arrays._replace(homotopy_scaled=work.homotopy_scaled(share), prior=prior)
        return declarations.ITERATE, first, last, options, work.model, arrays, work.memory_rows, log

    def _damped_arguments(
        self,
        first: int,
        last: int,
        log: StructuredArray,
        most: int,
        trial: Motion,
        least: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[Any, ...]:
        """What it takes for damped iterations, of which there are to be `most`; `trial` is written to on the way."""
        settings, work = self.settings, self.work
        options = self._settings(most, max(self.rough, least[0]), max(settings.gap_tolerance, least[1]))
        arrays = work.arrays._replace(prior=work.no_prior, rollout=trial)
        return declarations.DAMP, first, last, options, work.model, arrays, work.memory_rows, log

    def _newton_arguments(
        self, first: int, last: int, log: StructuredArray, most: int, trial: Motion
    ) -> tuple[Any, ...]:
        """What it takes for Newton iterations, of which there are to be `most`; `trial` is written to on the way."""
        settings, work = self.settings, self.work
        options = self._settings(most, self.final, settings.gap_tolerance)
        arrays = work.arrays._replace(prior=work.no_prior, rollout=trial)
        return declarations.FINISH, first, last, options, work.model, arrays, work.memory_rows, log

    def _check_arguments(
        self, task: int, found: AttemptResult, to_go: CostToGo, certificate: StructuredArray
    ) -> tuple[Any, ...]:
        """What it takes to certify a plan and its policy, with this cost-to-go."""
        settings, work = self.settings, self.work
        arrays = work.arrays._replace(
            to_go=to_go, rollout=Motion(found.states, found.controls),
            kept=Policy(*found.law), certificate=certificate,
        )  # fmt: skip
        options = self._settings(0, self.final, settings.gap_tolerance)
        return task, 0, 0, options, work.model, arrays, work.memory_rows, self._log

    def _settings(self, most: int, tolerance: float, gap_tolerance: float) -> IterationSettings:
        """What the iterations go by, of which there are to be `most`."""
        return IterationSettings(
            steps=self.problem.steps, max_iterations=most, tolerance=float(tolerance),
            gap_tolerance=float(gap_tolerance), optimal=self.settings.stop == "optimal", fixed=self.work.fixed,
            guided=False, prior_iterations=0,
        )  # fmt: skip

    def _obstacle_share(self, iteration: int) -> float:
        """How much of the obstacle costs the passes of an iteration see."""
        return self._shares[iteration] if iteration < len(self._shares) else 1.0

    def _violation(self) -> float:
        return self._violation_of((self.work.states, self.work.controls))

    def _violation_of(self, plan: tuple[Array, Array]) -> float:
        return self.work.violation(self.work.constraint_values(*plan)) if self.problem.constraints else 0.0


def _cost_of(iteration: Iteration | None) -> float:
    """Its cost; infinite where there is none, or it is not known."""
    return iteration.cost if iteration is not None and np.isfinite(iteration.cost) else np.inf

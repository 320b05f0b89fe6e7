"""Repeated solves in real time: everything is compiled beforehand, and each solve ends by its deadline."""

import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Positive, checked
from lqrsim.codegen.user_functions import raised_by
from lqrsim.errors import Array, InputError
from lqrsim.kernels.records import Motion, Policy
from lqrsim.problem.control_rate import with_last_command
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.parts import EQUALITY_TOLERANCE, allowed_violation, violation_of
from lqrsim.problem.problem import Problem
from lqrsim.results.pickles import OneVersion
from lqrsim.results.solution import Plan, Replan
from lqrsim.results.solution_parts import Iteration, Quadratic, Status, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of, goal_radius_of
from lqrsim.solvers.augmented_lagrangian import AugmentedLagrangian, meet_constraints
from lqrsim.solvers.budget import Budget, Laps, Stop, check_threads
from lqrsim.solvers.certify import expected_cost
from lqrsim.solvers.control_rates import feedback, narrowed, widened, with_commands
from lqrsim.solvers.engine import ROUNDING, RunResult, SolveRun, copied
from lqrsim.solvers.finish import Known, finish
from lqrsim.solvers.settings import FINE, InitialGuess, SmootherSettings, resolve
from lqrsim.solvers.stages import WEAK, ActiveSet, Barrier, InteriorPoint, Measures, Sizes, restore

SLOPES = 1e-6  # slope of the Lagrangian relative to the cost; the predicted decrease of cost is about its square
COARSE = 1e-2  # the same where constraints give way, of plans of which a small part is carried out
# Durations of the interior point's first iteration, and of a search farther from the plan, for which there must be
# time; relative to the time for the models about a plan.
BEGINNING, ELSEWHERE = 15.0, 200.0
# Price of a violation by a row's typical size, relative to the typical cost of a change. Multipliers along a Panda's
# plans are at most half of it, so that limits hold where they can. With a hundred times this price, two in five solves
# of two links after hard pushes did not converge.
PRICE = 0.01
OLDEST = 20  # steps for which derivatives may serve; most solves take fewer
# Many rows begin violated. Re-plans of a Panda then take 8 iterations in the median and 11 in 95 %, and 12 and 19 with
# `STRONG`.
STRONGER = Barrier(10.0, 0.5)


@checked
def prepare(
    problem: Problem,
    *,
    tolerance: float | None = None,
    gap_tolerance: float = 1e-3,
    constraint_tolerance: float | None = None,
    max_iterations: int = 300,
    finish: str | None = "newton",
    threads: int | None = None,
) -> "PreparedSolver":
    """Compile everything that problems of this structure need, so that nothing is compiled while a robot runs.

    The other arguments are as in `smooth`.

    Args:
      problem: one of the problems; others may have other states, goals, obstacles and parameters.
      tolerance: as in `smooth`; with constraints it bounds the Lagrangian's slope in each control, multiplied by the
        control's range and relative to the cost; by default 1e-6, or with an MJCF's dynamics 1e-5, and 1e-2 with limits
        of forces.
      constraint_tolerance: the largest violation of equalities, by default 1e-6; inequalities are kept. With noise,
        the margin of inequalities, by default 1e-3.
      finish: as in `smooth`; with None, the augmented Lagrangian method keeps the constraints.
      threads: number of threads that compute derivatives of an MJCF's steps; by default the number of processors. The
        results are the same.
    """
    settings = SmootherSettings(
        tolerance=tolerance, gap_tolerance=gap_tolerance, max_iterations=max_iterations, starts=1,
        constraint_tolerance=constraint_tolerance, finish=finish,
    )  # fmt: skip
    solved = problem if problem.control_rate is None else with_last_command(problem)
    if tolerance is None and settings.method(solved).interior:
        if _can_yield(solved):
            settings = replace(settings, tolerance=COARSE)
        elif settings.method(solved).tolerance == FINE:
            settings = replace(settings, tolerance=SLOPES)
    return PreparedSolver(problem, settings, check_threads(threads))


class PreparedSolver(OneVersion):
    """A solver for problems of one structure, from one state after another; `prepare` makes it.

    Attributes:
      problem: the problem that is solved by default.
      settings: the options given to `prepare`.
      threads: number of threads that compute derivatives of an MJCF's steps.
    """

    @checked
    def __init__(self, problem: Problem, settings: SmootherSettings, threads: int = 1) -> None:
        _check_fixed(problem)
        self.problem, self.settings, self.threads = problem, settings, threads
        self._structure = compiled.structure(problem)
        self._pace, self._closing = 0.0, 0.0  # seconds of a slow iteration, and of the work after the last one
        # With a cost or limits of rates: the solver of the problem with the last command as a state.
        self._wide: PreparedSolver | None = None
        if problem.control_rate is None:
            self._compile()
        else:
            wide, controls = with_last_command(problem), np.tile(problem.nominal_control, (problem.steps, 1))
            n = len(wide.dynamics.state_coordinates)
            feedback(problem, Trajectory(np.zeros((problem.steps + 1, n)), controls, problem.dt))  # compiles it
            self._wide = PreparedSolver(wide, settings, threads)

    def __repr__(self) -> str:
        system, steps = self.problem.dynamics, self.problem.steps
        n, m = len(system.state_coordinates), len(system.control_coordinates)
        return f"PreparedSolver({n} states, {m} controls, {steps} steps)"

    def _compile(self) -> None:
        guess, state = resolve(None, self.problem), self.problem._start_or_zero
        run = SolveRun(self.problem, self.settings, guess, state, Budget(self.settings.max_iterations))
        run.roll_out()
        compiled.rollout(self.problem, guess.gain, guess.offset, state)
        clearance_of(self.problem, run.work.last.states)  # a solution that is shifted has it
        run.work.constraint_values(run.work.best)
        for which in range(len(self.problem.constraint_terms)):
            run.work.constraint_slope(which, 0, state, guess.offset[0], 0)
        if run.method.interior:
            stages, plan, best = run.stages, Motion(*run.work.best), _Best(run)
            _Finder(run, plan, best).find()
            if _can_yield(self.problem):
                return
            # Another solve may need code that this solve did not need.
            sizes = stages.sizes(plan)
            InteriorPoint(stages, plan).run(tolerance=run.method.tolerance, violation=run.method.violation, most=1)
            restore(
                stages, plan, sizes, price=1.0, most=1, laps=Laps(run.budget), over=lambda: True,
                stationary=lambda *_: False,
            )  # fmt: skip

    @checked
    def check(self, problem: Problem) -> Problem:
        """Check that a problem needs no compiling: only numbers may differ from the prepared one."""
        _check_fixed(problem)
        other = (problem.control_rate is None) != (self._wide is None)
        if other or compiled.structure(problem) != self._structure:
            raise InputError(
                "problem: got another structure, want the prepared one with other numbers: goal, weights,"
                " obstacles, parameters, limits, steps"
            )
        if self._wide is not None:
            self._wide.check(with_last_command(problem))
        return problem

    @checked
    def solve(
        self,
        state: npt.ArrayLike,
        start: Plan | InitialGuess,
        *,
        problem: Problem | None = None,
        after: int = 0,
        time_limit: Positive | None = None,
        previous: npt.ArrayLike | None = None,
    ) -> Replan:
        """Solve from a state, starting from a plan. The answer is no worse than continuing with that plan; see
        `Replan`.

        Args:
          state: (n,) the state to plan from.
          start: a plan with as many steps as the problem has left: `before.shifted(k)`; with `after`,
            `before.shifted(k, horizon="shrinking")`.
          problem: the problem to solve from that state; by default the prepared one.
          after: number of steps that are over; the rest is solved.
          time_limit: seconds from this call to its return. An iteration that would probably end later is not begun.
          previous: (m,) the last command before the plan, from which a `control_rate` counts; None if it is free.
        """
        clock = time.perf_counter()
        base = self.problem if problem is None else self.check(problem)
        problem = base.from_state(state, after=after, previous=previous)
        guess, planned = resolve(start, problem), None if isinstance(start, InitialGuess) else start.trajectory
        deadline = np.inf if time_limit is None else clock + time_limit
        if self._wide is None:
            return self._solve(problem, guess, planned, clock, deadline)
        # With a cost or limits of rates: the answer to the problem with the last command as a state.
        wide, planned = with_last_command(problem), None if planned is None else with_commands(planned)
        guess, begun = widened(guess, problem, wide), time.perf_counter()
        wide_plan = self._wide._solve(wide, guess, planned, begun, max(deadline - self._closing, begun + 1e-9))
        ended = time.perf_counter()
        policy, cost_to_go = feedback(problem, wide_plan.trajectory, wide_plan.multipliers)
        plan = narrowed(wide_plan, problem, policy, cost_to_go, seconds=0.0)
        self._closing = max(0.5 * self._closing, time.perf_counter() - ended)
        return replace(plan, seconds=time.perf_counter() - clock)

    def _solve(
        self, problem: Problem, guess: InitialGuess, planned: Trajectory | None, clock: float, deadline: float
    ) -> Replan:
        """The answer, begun at `clock`, from a guess that may be of a plan."""
        stop = Stop(attentive=True, reserve=self._pace + self._closing, deadline=deadline)
        budget = Budget(self.settings.max_iterations, stop)
        run = SolveRun(problem, self.settings, guess, problem._start_or_zero, budget)
        best = _Best(run)
        with problem.dynamics.solving(self.threads):
            if run.method.interior:
                finder = _Finder(run, _plan_of(planned, best), best, self._closing)
                result, ended = finder.find(), finder.laps.ended
                if finder.may_be_far:
                    best.consider(result)
                    result, ended = finish(run, Known()), time.perf_counter()
            else:
                result = _smoothed(run, best)
                result = replace(result, cost=_cost_of(run, result.cost, result.plan, result.policy))
                ended = time.perf_counter()
        if stop.error is not None:
            raise stop.error
        seconds = [iteration.seconds for iteration in budget.log]
        self._pace = max(0.5 * self._pace, max(seconds, default=0.0))
        best.consider(result)
        found = best.result.kept()  # the next solve overwrites this memory
        answer = Replan(
            status=result.status, detail=result.detail, improved=best.improved,
            policy=compiled.policy_of(problem, *found.policy, found.states[:-1].copy()),
            trajectory=Trajectory(*found.plan, problem.dt), cost=found.cost, before=best.before,
            violation=found.violation, cost_to_go=found.values.get("cost_to_go"), multipliers=found.multipliers,
            goal=problem.weighed_goal, goal_radius=goal_radius_of(problem), iterations=len(budget.log),
            seconds=time.perf_counter() - clock, iterating=best.rolling_out + sum(seconds),
        )  # fmt: skip
        run.give_back()  # this is skipped after an exception
        self._closing = max(0.5 * self._closing, time.perf_counter() - ended)
        return answer


def _check_fixed(problem: Problem) -> None:
    """Raises InputError for a problem with a free duration."""
    if problem.duration is not None:
        raise InputError("problem: got a free duration, want a fixed one for solves in real time")


def _plan_of(planned: Trajectory | None, best: "_Best") -> Motion:
    """The plan to start from: the rollout of the old policy, but with the old plan's last state.

    A moving horizon has a last step for which the old policy was not made. If the rollout violates constraints, the old
    plan itself is used, from the new state.
    """
    plan = copied(best.result)
    if planned is None or planned.states.shape != plan.states.shape:
        return plan
    if best.result.violation > 0:
        plan.states[1:], plan.controls[...] = planned.states[1:], planned.controls
    plan.states[-1] = planned.states[-1]
    return plan


def _smoothed(run: SolveRun, best: "_Best") -> RunResult:
    """Smoothing, its safeguard and the augmented Lagrangian, until they converge or have to stop."""
    run.budget.stop.callback = best
    run.budget.report()
    try:
        if run.initial_guess.multipliers:
            return meet_constraints(run, None)
        result = run.run_to_end(return_best=False)
        if run.problem.constraints and result.success and not run.budget.stop.due:
            result = meet_constraints(run, result)
        return result
    except InputError as error:  # a function that is not finite at the start
        return replace(best.result, status=Status.NOT_FINITE, detail=str(error), cost=np.inf)


def _cost_of(run: SolveRun, cost: float, plan: Motion, policy: Policy) -> float:
    """The cost of a plan in a run: under noise with constraints without their penalties, which `cost` has there."""
    if run.problem.noise_term is None or not run.problem.constraints or not np.isfinite(cost):
        return cost
    return expected_cost(run, RunResult(status=Status.STALLED, plan=plan, policy=policy))


class _Finder:
    """Finds the constrained optimum next to a plan, in time.

    Args:
      run: a run with the initial policy and multipliers. best: the plan that the policy leads to.
      plan: states and controls to which the policy belongs; the first state is the start.
      closing: duration of the work after the last iteration, in s.
    """

    may_be_far = False  # whether it found nothing, and there is time to look elsewhere: an obstacle may be in the way

    def __init__(self, run: SolveRun, plan: Motion, best: "_Best", closing: float = 0.0) -> None:
        self._run, self._stages, self._plan, self._best = run, run.stages, plan, best
        self._closing, self._budget = closing, run.budget
        self.laps, self._out_of_time = Laps(run.budget), False  # the last iteration may be an abandoned step
        for function in functions_of(run.problem):
            function.forget()

    def find(self) -> RunResult:
        """Run until it converges or has to stop."""
        with np.errstate(all="ignore"):
            return self._giving_way() if _can_yield(self._run.problem) else self._beside()

    def _late(self, seconds: float) -> bool:
        """Whether work of this duration would end too late; if so, the solve ends."""
        self._out_of_time |= time.perf_counter() + seconds + self._closing >= self._budget.stop.deadline
        return self._out_of_time

    @property
    def _unsolved(self) -> Status:
        return Status.TIME_LIMIT if self._out_of_time else Status.MAX_ITERATIONS

    def _beside(self) -> RunResult:
        """Newton steps with the active set of the plan, or the interior point."""
        run, budget = self._run, self._budget
        if self._late(0.0):
            return self._best.result
        if not np.isfinite(self._best.result.cost):
            detail = "the policy that it begins with diverges"
            return replace(self._best.result, status=Status.NOT_FINITE, detail=detail)
        known = tuple(multipliers.values for multipliers in run.initial_guess.multipliers)
        active = ActiveSet(self._stages, self._plan, known, run.method.violation)
        self.laps.ended = time.perf_counter()
        solved = self._take_steps(active)
        if not (solved or active.hopeless or self._late(BEGINNING * active.model_seconds)) and budget.left:
            point = InteriorPoint(self._stages, copied(self._best.result), WEAK, multipliers=known)
            result = point.run(
                tolerance=run.method.tolerance, violation=run.method.violation, most=budget.left, laps=self.laps,
                over=lambda _, seconds: self._late(seconds) or not budget.left,
            )  # fmt: skip
            if result.solved or not np.isfinite(active.measures.cost):
                active = ActiveSet(self._stages, result.plan, result.multipliers, run.method.violation)
                solved = self._take_steps(active)
        self.laps.ended = time.perf_counter()
        in_time = self.laps.ended + ELSEWHERE * active.model_seconds + self._closing < budget.stop.deadline
        self.may_be_far = not solved and in_time and budget.left > 1
        if not np.isfinite(active.measures).all():
            return replace(self._best.result, status=self._unsolved, detail=raised_by(functions_of(run.problem)))
        plan, gain, cost = active.carried_out()
        for term, numbers in zip(run.problem.constraint_terms, run.work.constraint_values(plan), strict=True):
            solved = solved and violation_of(term, numbers) <= allowed_violation(term, run.method.violation)
        detail = "no plan near it keeps the constraints" if active.hopeless and not solved else ""
        return RunResult(
            status=Status.CONVERGED if solved else self._unsolved, detail=detail, plan=plan,
            policy=compiled.policy_about(*plan, gain), cost=cost, violation=run.work.violation_of(plan),
            multipliers=active.multipliers(),
        )  # fmt: skip

    def _take_steps(self, active: ActiveSet) -> bool:
        """Take the steps of an active set; return whether they converge. A step that would be too late is abandoned."""

        def watch(measures: Measures) -> bool:
            measures.record(self.laps, "active set")
            return self._late(active.model_seconds) or not self._budget.left

        return active.run(self._run.method.tolerance, watch, self._late)

    def _giving_way(self) -> RunResult:
        """The plan if constraints give way that the robot keeps by itself: limits of forces, which MuJoCo clips. It is
        carried out with feedback, unless it is worse than the best.

        After a push, no plan may keep them. A stiff servo whose target is held for a period cannot keep its force
        within its limits from any velocity: at 450 N m s/rad and 87 N m, 0.2 rad/s are too much. The robot then clips
        the force, and the deviation ends within some physics steps. So a violation has a price, and the next plans
        bring the forces back.

        The plan hardly moves from one solve to the next, and derivatives by MuJoCo take most of the time of an
        iteration. So those about the first plan serve for all steps that need not be shortened, and are computed anew
        at the end.
        """
        run, stages, budget, clock = self._run, self._stages, self._budget, time.perf_counter()
        terms, prices = run.problem.constraint_terms, np.zeros(0)
        yields = (stages.owners >= 0) & np.array([term.yields for term in terms])[stages.owners]

        def price(sizes: Sizes) -> Array:
            nonlocal prices
            prices = np.where(yields, PRICE * sizes.cost / sizes.rows, np.inf)
            return prices

        def rank(plan: Motion, cost: float) -> tuple[bool, float, float]:
            """Sort key, best first: violation of what does not give way, then the cost with prices of violations."""
            values, missed = stages.values(plan), 0.0
            for term, numbers in zip(terms, run.work.constraint_values(plan), strict=True):
                if not term.yields:
                    missed = max(missed, violation_of(term, numbers) - allowed_violation(term, run.method.violation))
            short = np.where(stages.live & yields, np.maximum(-values, 0.0), 0.0)
            paid = float((short * np.where(yields, prices, 0.0)).sum())
            return not np.isfinite(plan.states).all(), missed, cost + paid

        point = InteriorPoint(stages, self._plan, STRONGER, price=price, oldest=OLDEST)
        self.laps.ended = time.perf_counter()
        model_seconds = self.laps.ended - clock
        if self._late(model_seconds) or not budget.left:
            return replace(self._best.result, status=self._unsolved)
        result = point.run(
            tolerance=run.method.tolerance, violation=run.method.violation, most=budget.left, laps=self.laps,
            over=lambda _, seconds: self._late(model_seconds + seconds),  # the next may compute derivatives anew
        )  # fmt: skip
        policy = compiled.policy_about(*result.plan, result.gain.copy())
        plan = run.work.roll_out(policy, self._plan.states[0])
        reached = stages.trial(plan)[0]
        found = rank(plan, reached)
        solved = result.solved and found[1] == 0
        if not solved and found > rank(self._best.result.plan, self._best.result.cost):
            return replace(self._best.result, status=self._unsolved)
        status = Status.CONVERGED if solved else self._unsolved
        violation, detail = run.work.violation_of(plan), ""
        if violation > run.method.violation:
            lagrangian = AugmentedLagrangian(run)
            lagrangian.evaluate(plan)
            detail = f"elastic: {lagrangian.worst()}"
        answer = RunResult(status=status, detail=detail, plan=plan, policy=policy, cost=reached, violation=violation)
        self._best.adopt(answer)
        return answer


def _can_yield(problem: Problem) -> bool:
    return any(term.yields for term in problem.constraint_terms)


class _Best:
    """The best plan so far, initially the plan that the solve starts from. It is called after each iteration.

    Attributes:
      result: that plan. improved: whether it differs from the first plan.
      before: cost of the first plan. rolling_out: seconds of its rollout.
    """

    def __init__(self, run: SolveRun) -> None:
        self._run, self._work, guess = run, run.work, run.initial_guess
        clock = time.perf_counter()
        run.roll_out()
        self.rolling_out = time.perf_counter() - clock
        last = self._work.last
        self.result = RunResult(
            status=Status.TIME_LIMIT, plan=copied(last), policy=Policy(guess.gain, guess.offset),
            cost=_cost_of(run, self._work.cost, last, self._work.arrays.last_policy),
            violation=self._work.violation_of(last),
            values={"cost_to_go": guess.cost_to_go}, multipliers=guess.multipliers,
        )  # fmt: skip
        self.before, self.improved = self.result.cost, False
        # Equalities are kept only within a tolerance.
        allowed = run.method.violation
        self._none = max((allowed_violation(term, allowed) for term in run.problem.constraint_terms), default=0.0)
        self._negligible = min(allowed, EQUALITY_TOLERANCE)
        self._most = max(self.result.violation, self._none)
        self._copies: tuple[Array, ...] = ()

    def __call__(self, iteration: Iteration) -> None:
        if iteration.optimality < self._run.method.tolerance and iteration.violation == 0:
            return  # probably the last one; `consider` sees it
        if iteration.method not in ("smooth", "newton"):
            return
        arrays = self._work.arrays
        if iteration.method == "smooth":
            cost = _cost_of(self._run, iteration.cost, arrays.last, arrays.last_policy)
            iteration = replace(iteration, cost=cost)
        if self._better(iteration, self.result):
            if iteration.method == "newton":
                parts = *arrays.best, *compiled.policy_about(*arrays.best, arrays.policy.gain)
            else:
                parts = *arrays.last, *arrays.last_policy, *arrays.to_go
            # The next iteration overwrites these. Copies are allocated once, since writing to new memory is slow.
            if not self._copies:
                self._copies = tuple(
                    np.empty_like(array) for array in (*arrays.best, *arrays.last_policy, *arrays.to_go)
                )
            copies = self._copies[: len(parts)]  # the cost-to-go about Newton's plans is computed at the end
            for copy, array in zip(copies, parts, strict=True):
                np.copyto(copy, array)
            states, controls, gain, offset, *to_go = copies
            self.adopt(replace(
                self.result, plan=Motion(states, controls), policy=Policy(gain, offset), cost=iteration.cost,
                violation=iteration.violation, values={"cost_to_go": Quadratic(*to_go)} if to_go else {},
            ))  # fmt: skip

    def consider(self, result: RunResult) -> None:
        """Adopt the final result if it converged and is as good as the best, or if it is better."""
        as_good = result.success and (self.result.violation > self._none or not self._better(self.result, result))
        if as_good or self._better(result, self.result):
            self.adopt(result)

    def adopt(self, result: RunResult) -> None:
        self.result, self.improved = result, True

    def _better(self, plan: RunResult | Iteration, other: RunResult | Iteration) -> bool:
        """Whether one plan is better than another: constraints first, then the cost, beyond rounding.

        Often the first step decides the largest violation, whatever comes after it. So violations that agree to two
        digits count as equal, as in `RunResult.rank`; but none may be larger than that of the first plan.
        """
        if not np.isfinite(plan.cost) or not plan.violation <= self._most:
            return False
        missed, others = self._missed(plan.violation), self._missed(other.violation)
        if missed != others:
            return missed < others
        return not plan.cost >= other.cost - ROUNDING * abs(other.cost)

    def _missed(self, violation: float) -> float:
        return 0.0 if violation <= self._negligible else float(f"{violation:.2g}")

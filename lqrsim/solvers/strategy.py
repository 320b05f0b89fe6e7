"""The search: the attempts at one problem, in order, until one converges.

`Search.solve` says what is tried in which order, and when; `finish.py` says what is done from one start. If nothing
speaks against the first plan (`Search.is_answered`), nothing else is tried. The budget of each start is
`max_iterations`; all starts share one deadline (`budget.py`). Every answer is certified (`certify.py`).
"""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.kernels import declarations
from lqrsim.kernels.records import Motion
from lqrsim.problem.derivative_check import check_functions
from lqrsim.problem.parts import goals_of
from lqrsim.problem.problem import Problem
from lqrsim.problem.quadratic_cost import QuadraticCost
from lqrsim.results.goal import TOLERANCE, Target
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Curvature, Status, Trajectory, joined
from lqrsim.solvers import compiled, multistart
from lqrsim.solvers.assembly import assemble, clearance_of
from lqrsim.solvers.budget import Budget, Stop
from lqrsim.solvers.certify import certified, curvature_of
from lqrsim.solvers.engine import RunResult, SolveRun, copied
from lqrsim.solvers.finish import Known, finish, from_beside, from_states, refine
from lqrsim.solvers.multistart import SWAYS, choose, guides, passable, sinusoidal_controls, sinusoidal_name
from lqrsim.solvers.settings import InitialGuess, SmootherSettings, StartLike, resolve
from lqrsim.solvers.tree import ways_by_trees

# Controls are idle if they are this close to the nominal controls, relative to their size, which counts as at least 1.
IDLE = 1e-6
# Factors on the weights of obstacles and goal that lead to another route.
HEAVIER = (10.0, 100.0)
# Iterations for each softness of contacts, for a single plan and for each of several; and the factor by which there are
# fewer plans at the next softness.
SOFT, LOOK, FEWER = 60, 25, 3
# Rounds in which the best plan is softened again, with this number of softnesses, and then descends within its modes;
# the relative decrease of cost that is worth another; by how much a softened plan may cost more before it descends.
ROUNDS, AGAIN, FELL, NEAR = 5, 2, 1e-3, 0.1

CHEAPER = 0.01  # by what share a plan that has not converged must cost less than the answer, to be named
# Saddles that are left in turn; steps away from one along its direction of negative curvature, relative to the typical
# sizes; and the relative decrease of cost that such a step must lead to.
SADDLES, SADDLE_STEPS, SADDLE_DECREASE = 5, (0.3, 0.1, 0.03, 0.01), 1e-9

PUSHES = 2  # plans of pushes and approaches from which a descent begins
SAVES = 0.5  # cost of a plan that moves a body, relative to one that does not, with which the search for more ends
APPROACH = 15  # iterations along an approach; without contacts most converge in three
CONSTANT = 3  # constant controls that are tried where the states leave their domain under others
CALLERS_START = "the given start"  # name of the start that the caller gives

LEFT = 1e-3  # slope of the final cost, relative to the slope at the end of a given plan, that has died away
# Part of the cost that a change of a state by its size would save, from which on its goal counts as missed.
MISSED_SHARE = 0.1
NEARER = 0.3  # part of the way to its goal that a body must be taken
LEAST_WAY = 0.1  # least way of a joint, relative to the longest, by which its weight along an approach is scaled
NO_CHANGE = 1e-9  # change of a state, relative to its size, that counts as none

R = TypeVar("R")
Finish = Callable[[SolveRun, Known], R]
Start = StartLike | InitialGuess


class Runs:
    """The runs of a search: how they begin and end, which are named among the candidates, and the results so far.

    Attributes:
      method: how the problem is solved. known: what the runs know of one another.
      finished: the runs that ended, with their results, the best first.
    """

    def __init__(self, problem: Problem, settings: SmootherSettings, stop: Stop) -> None:
        self.problem, self.settings, self.stop = problem, settings, stop
        self.method, self.known = settings.method(problem), Known()
        self.named: list[tuple[str, SolveRun]] = []
        self.finished: list[tuple[SolveRun, RunResult]] = []

    @property
    def best(self) -> RunResult:
        return self.finished[0][1]

    def another(self, start: Start, problem: Problem | None = None) -> SolveRun:
        """A run from another start, perhaps of another problem."""
        problem, budget = problem or self.problem, Budget(self.settings.max_iterations, self.stop)
        return SolveRun(problem, self.settings, resolve(start, problem), self.problem._start_or_zero, budget)

    def add(self, start: Start, name: str | None = None) -> SolveRun:
        """A run from another start that is one of the candidates."""
        run = self.another(start)
        self.named.append((str(run.initial_guess.summary) if name is None else name, run))
        return run

    def result_of(
        self, run: SolveRun, how: Finish[R] = finish, *, most: int | None = None, known: Known | None = None
    ) -> R:
        """Run as `how` says, with at most `most` iterations more, and the callback for all iterations so far, too.

        What is known of the search's problem is not known of another.
        """
        run.budget.report()
        known = known or (self.known if run.problem is self.problem else Known())
        with run.problem.dynamics.solving(self.stop.threads), run.budget.limited(most):
            return how(run, known)

    def try_from(self, name: str, start: Start, how: Finish[RunResult] = finish) -> None:
        """Finish a run from another start, which is one of the candidates, and record its result."""
        run = self.add(start, name)
        self.offer(run, self.result_of(run, how))

    def offer(self, run: SolveRun, result: RunResult, *, better: bool | None = None) -> None:
        """Record a result; it becomes the best if `better` says so, by default if its rank is before all others."""
        if better is None:
            better = all(result.rank < other.rank for _, other in self.finished)
        self.finished.insert(0 if better else len(self.finished), (run, result))

    def cheaper_elsewhere(self, less: float) -> int | None:
        """Number of the cheapest plan that keeps the constraints, if it costs less than the best by this share."""
        allowed, best = self.method.violation, self.best.cost
        kept = [result.violation <= allowed and np.isfinite(result.cost) for _, result in self.finished]
        costs = np.where(kept, [result.cost for _, result in self.finished], np.inf)
        return int(np.argmin(costs)) if costs.min() < best - less * abs(best) else None


class Search:
    """Runs from several starts, the most promising of which are finished."""

    def __init__(
        self, problem: Problem, settings: SmootherSettings, stop: Stop,
        starts: Sequence[tuple[str, Start]] = (),
    ) -> None:  # fmt: skip
        """By default from the caller's start, or the usual ones."""
        self._problem, self._settings, self._stop, self.runs = problem, settings, stop, Runs(problem, settings, stop)
        self._guided = multistart.path_weight(problem) > 0  # whether obstacles in the cost push the plan
        self._default = settings.start is None and settings.starts is None  # not by the caller's choice
        self.tried = not settings.safeguard  # whether other starts were tried, as far as they are to be
        with stop.not_counting():  # compiling
            if not starts and settings.start is not None:
                starts = [(CALLERS_START, resolve(settings.start, problem).penalised(problem, settings.penalty))]
            guesses = [(name, resolve(start, problem)) for name, start in starts or guides(problem, settings.starts)]
            check_functions(problem, guesses[0][1].offset[0].copy())
            self.runs.named = [(name, self.runs.another(guess)) for name, guess in guesses]
        self._solving = self._stop.threads if len(self.runs.named) == 1 else 1
        self._approaches = Approaches(self.runs)
        self._softening = Softening(self.runs, self._approaches)

    def solve(self, *, trees: bool = True) -> Solution:
        """The first plan, if that is the answer, or the best after all attempts; `trees` if they may grow.

        It is no worse than a plan that the caller gave.
        """
        begun = [run for _, run in self.runs.named]
        guess = begun[0].initial_guess
        is_plan = self._settings.start is not None and guess.prior is None and guess.interior is None
        given = self.runs.result_of(begun[0], _initial_rollout) if is_plan else None
        with self._stop.reporting("smooth"):
            with self._problem.dynamics.solving(self._solving):
                self.solve_from_starts()
                answered = given is None and self.is_answered
                if not answered:
                    self.try_other_starts()
                    if trees and self.may_go_on and self.is_barred:
                        self.grow_trees()
                    for name, trajectory in self._detours().items():
                        if not self._stop.due:
                            self.runs.try_from(name, trajectory)
                    self.leave_saddles()  # while the best plan is one
            if not answered:
                self.try_other_dynamics(given)
        run, result = self.runs.finished[0]
        result = result if answered else self._judged(result)
        tolerances = {"tolerance": run.method.tolerance, "constraint_tolerance": self.runs.method.violation}
        options = self._settings.options(run.initial_guess if self._settings.start is None else guess) | tolerances
        solution = assemble(run, result, solver="smooth", options=options, candidates=self._candidates())
        for run in begun:
            run.give_back()
        return solution

    @property
    def is_answered(self) -> bool:
        """Whether the first plan has converged, and none of the attempts that may follow would begin."""
        best = self.runs.best
        if len(self.runs.finished) > 1 or not best.success or self._problem.risk > 0 or self._stop.due:
            return False
        at_saddle = best.certificate is not None and best.certificate.curvature is Curvature.SADDLE
        poor = self._default and self._is_unacceptable
        return not (at_saddle or poor or self._detours() or self._approaches.unmoved())

    def solve_from_starts(self) -> None:
        """Finish the most promising run; with constraints, also the others, as long as they may cost less."""
        problem = self._problem
        chosen, *others = choose([run for _, run in self.runs.named], self._stop.threads)
        if not (problem.constraints or self.runs.method.exact):  # for which other methods follow smoothing
            chosen = self.smooth_or_follow_a_line(chosen)
        self.runs.offer(chosen, self.runs.result_of(chosen))
        if not problem.constraints:
            return
        # Constraints can make the best route the worst, or close it. The costs of the other runs so far, without
        # constraints, are approximate lower bounds on their costs with constraints.
        for run in sorted(others, key=lambda run: run.cost):
            best = self.runs.best
            if self._stop.due or best.decisive or (best.success and not run.cost < best.cost):
                break
            self.runs.offer(run, self.runs.result_of(run))

    def smooth_or_follow_a_line(self, run: SolveRun) -> SolveRun:
        """If smoothing fails for an arm, say, whose every joint has a motor, the run from a line of states, if cheaper.

        From the controls that hold an arm, the first plans may swing it through itself or the floor, where plans stay.
        """
        problem, most = self._problem, self._settings.max_iterations
        driven = 2 * len(problem.control_coordinates) >= len(problem.dynamics.state_coordinates)
        known = problem.start is not None and problem.goal is not None
        if not (driven and known and self._default and self._settings.safeguard):
            return run
        self.runs.result_of(run, lambda run, _: run.smooth(most))
        unfinished = Status.MAX_ITERATIONS, Status.TIME_LIMIT, Status.RISK_TOO_HIGH
        if run.ending.success or run.ending.status in unfinished or self._stop.due:
            return run
        line = self.runs.add(line_of_states(problem), "a line of states")
        self.runs.result_of(line, lambda line, _: line.smooth(most))
        return line if line.ending.success or line.work.cost < run.work.cost else run

    def try_other_starts(self) -> None:
        """Begin elsewhere, in turn, where the plans so far are poor."""
        lost = not np.isfinite(self.runs.best.cost) and self.runs.best.status is not Status.RISK_TOO_HIGH
        if lost and self._problem.start is not None and not self._stop.due:
            self.try_finite()
        if self.needs_others and self.is_barred:
            self.try_past_constraints()
        if self.needs_others and self._guided:
            self.try_reweighted()
        without_plan = bool(self._problem.constraints) and not self.runs.best.success
        if self.needs_others and not self._guided and without_plan:
            self.try_elsewhere()
        if self.needs_others and not self._guided:
            self.try_sinusoidal_controls()

    def try_other_dynamics(self, given: RunResult | None) -> None:
        """The attempts that also solve problems with other dynamics, and set the threads for each."""
        if self._default and self.may_go_on and self._approaches.unmoved():
            self._approaches.push_and_approach()
        too_high = any(run.ending.outcome == declarations.RISK_TOO_HIGH for _, run in self.runs.named)
        if self._problem.risk > 0 and too_high and self.may_go_on:
            self.retry_without_risk()
        left_alone = self._approaches.best_nearer is not None and not self._approaches.comes_nearer(self.runs.best)
        if self._default and self.may_go_on and (left_alone or not self.runs.best.success):
            self._softening.soften()
        if given is not None:
            self.keep_given(given)
        for attempt in (self._softening.alternate, self._softening.leave_contact_modes):
            if not self.runs.best.success and self.may_go_on:
                attempt()

    def try_finite(self) -> None:
        """Where states leave their domain, try constant controls under which they do not, and a line of states."""
        self.runs.known.from_start = False
        problem, work, plans = self._problem, self.runs.finished[0][0].work, list[tuple[float, float, Array]]()
        for control, plan in multistart.constant_controls(problem):
            missed = float(f"{work.violation_of(plan):.2g}")
            cost = compiled.cost_of(problem, *plan)
            if np.isfinite([missed, cost]).all():
                plans.append((missed, cost, control))
        for _, _, control in sorted(plans, key=lambda entry: entry[:2])[:CONSTANT]:
            self.runs.try_from(f"the constant controls {', '.join(f'{u:.3g}' for u in control)}", control)
            if self.runs.best.success or self._stop.due:
                return
        if self.runs.method.exact and not np.isfinite(self.runs.best.cost):
            self.runs.try_from("a line of states", line_of_states(problem), from_states)

    def try_reweighted(self) -> None:
        """Solve with heavier obstacles, and refine the best of these plans by steps that lower the true cost."""
        stop = self._stop
        for times in HEAVIER:
            if stop.due:
                return
            heavier = multistart.reweighted(self._problem, times)
            runs = [self.runs.another(guide, heavier) for _, guide in guides(heavier, None)]
            try:
                chosen = choose(runs, self._stop.threads)[0]
                heaviest = self.runs.result_of(chosen, lambda run, _: run.run_to_end())
            except InputError:  # the heavier cost is not finite at the start
                continue
            if stop.due:
                return
            run = self.runs.add(guess_from(heaviest, f"a plan for {times:g} times the weight of obstacles and goal"))
            result, best = self.runs.result_of(run, refine), self.runs.best
            # The same optimum, different within the tolerances, is no improvement.
            lower = not best.success or result.cost < best.cost - 1e-3 * abs(best.cost)
            self.runs.offer(run, result, better=result.rank < best.rank and lower)
        self.tried = not stop.due

    def try_elsewhere(self) -> None:
        """Try other starts until one leads to a plan, before the constraints are called infeasible."""
        problem, exact = self._problem, self.runs.method.exact
        if exact:
            self._follow_ways()
        motions = dict[str, StartLike](self._motions()) if exact and not self.runs.best.success else {}
        sways = {sinusoidal_name(cycles): sinusoidal_controls(problem, cycles) for cycles in SWAYS[:2]}
        for name, start in (motions | sways).items():
            if self._stop.due or self.runs.best.success:
                break
            self.runs.known.from_start = False
            # A trajectory is on one side of the obstacles; smoothing without the constraints would leave this side. The
            # augmented Lagrangian method stays there only if it begins with the start's own plan.
            self.runs.try_from(name, start, finish if exact and name in sways else refine)
        self.tried = not self._stop.due

    def _follow_ways(self) -> None:
        """Begin with ways of states, whatever a rollout does; all of them, because it is not known which is best."""
        problem = self._problem
        for way in list(multistart.ways(problem, self.runs.finished[0][0].stages)):
            if self._stop.due:
                return
            self.runs.known.from_start = False
            self.runs.try_from(way.name, way.over(problem), from_states)

    @property
    def is_barred(self) -> bool:
        """Whether no plan keeps the constraints, some of which may be passed on one side or another."""
        return self.is_poor and self.runs.method.exact and not self.runs.best.success and any(passable(self._problem))

    def try_past_constraints(self) -> None:
        """Plan without the constraints that may be passed on one side or another.

        A manoeuvre, such as to drive on and back, is found more often where nothing is in the way of its first plans.
        """
        problem = self._problem
        pairs = zip(problem.constraints, passable(problem), strict=True)
        _, best = _searched(problem.with_constraints([one for one, passed in pairs if not passed]), self.runs)
        if best.success and not self._stop.due:
            self.runs.known.from_start = False
            name = "a plan without what is in the way"
            self.runs.try_from(name, guess_from(best, name), refine)

    def grow_trees(self) -> None:
        for seed, way in ways_by_trees(self._problem, self._stop):
            self.runs.try_from(f"trees of short plans, seed {seed}", way, from_states)
            if self.runs.best.success:
                return

    def _motions(self) -> list[tuple[str, Trajectory]]:
        """Trajectories along paths from start to goal, by name; the least violation of constraints first."""
        problem, cost = self._problem, self.runs.best.cost
        motions = list[tuple[float, str, Trajectory]]()
        for name, prior in multistart.along_paths(problem, self._steered(), cost if 0 < cost < np.inf else 1.0).items():
            if self._stop.due:
                break
            run = self.runs.another(prior)
            run.smooth(multistart.FOLLOW)
            plan = copied(run.work.arrays.last)
            if np.isfinite(plan.states).all():
                missed = run.work.violation_of(plan)
                motions.append((missed, name, Trajectory(*plan, problem.dt)))
        return [(name, motion) for _, name, motion in sorted(motions, key=lambda motion: motion[0])]

    def _steered(self) -> list[int]:
        """The states that place the robot: its position, or else states on which constraints to be passed depend."""
        problem, work, moving = self._problem, self.runs.finished[0][0].work, set[int]()
        position = list(problem.dynamics.state_coordinates.position)
        if position or problem.start is None or problem.goal is None:
            return position
        for k in np.flatnonzero(passable(problem)).tolist():
            for row in range(problem.constraint_terms[k].rows):
                for state in (problem.start, problem.goal):
                    slope = work.constraint_slope(k, row, state, problem.nominal_control, 1)
                    moving.update(np.flatnonzero(slope[: len(state)]).tolist())
        return sorted(moving)

    def try_sinusoidal_controls(self) -> None:
        runs = [self.runs.another(sinusoidal_controls(self._problem, cycles)) for cycles in SWAYS]
        chosen = choose(runs, self._stop.threads)[0]
        self.runs.named.append((sinusoidal_name(SWAYS[runs.index(chosen)]), chosen))
        result, best = self.runs.result_of(chosen, known=Known()), self.runs.best
        # Even a plan that has not converged is better than doing nothing.
        self.runs.offer(chosen, result, better=result.violation <= best.violation and result.cost < best.cost)
        self.tried = not self._stop.due

    def _detours(self) -> dict[str, Trajectory]:
        """New paths on other sides of constraints that the best plan touches, by name, unless a cost chose its side."""
        touched = itertools.compress(self.runs.best.multipliers, passable(self._problem))
        chosen = self._settings.start is not None or not self.runs.method.exact or self._guided
        if chosen or not any(multipliers.values.any() for multipliers in touched):
            return {}
        tried = {name for name, _ in self.runs.named}
        paths = multistart.detours(self._problem, self._settings.starts)
        return {name: path for name, path in paths.items() if name not in tried}

    def leave_saddles(self) -> None:
        """Go down along a direction of negative curvature, and converge from there, while the best plan is a saddle.

        A saddle that is not left has not converged, and comes after a plan from elsewhere that costs less.
        """
        for count in range(SADDLES + 1):
            run, best = self.runs.finished[0]
            if best.certificate is None or best.certificate.curvature is not Curvature.SADDLE:
                return
            if count == SADDLES or not self._descend(run, best):
                status = Status.TIME_LIMIT if self._stop.due else Status.STALLED
                detail = "a saddle: the cost falls to second order, but no plan was found beside it that costs less"
                if count == SADDLES:
                    detail = f"a saddle: the cost falls to second order, as it did at {count} plans that were left"
                self.runs.finished[0] = run, replace(best, status=status, detail=detail)
                if (cheapest := self.runs.cheaper_elsewhere(SADDLE_DECREASE)) is not None:
                    self.runs.finished.insert(0, self.runs.finished.pop(cheapest))
                return

    def _descend(self, run: SolveRun, at_saddle: RunResult) -> bool:
        """Leave a saddle; return whether a plan was found that costs less."""
        _, direction = curvature_of(run, at_saddle)
        if direction is None:
            return False
        saddle = at_saddle.kept()
        for size, sign in itertools.product(SADDLE_STEPS, (1, -1)):
            beside = Trajectory(
                saddle.states + sign * size * direction.states, saddle.controls + sign * size * direction.controls,
                self._problem.dt,
            )  # fmt: skip
            run_beside = self.runs.another(guess_from(saddle, "a saddle"))
            result = self.runs.result_of(run_beside, partial(from_beside, plan=beside, saddle=saddle))
            if self._stop.due:
                break
            if result is not None and result.success and result.cost < saddle.cost - SADDLE_DECREASE * abs(saddle.cost):
                self.runs.named.append(("beside a saddle", run_beside))
                self.runs.offer(run_beside, result, better=True)
                return True
        return False

    def keep_given(self, given: RunResult) -> None:
        """Descend from the caller's plan if the best is worse, or no longer moves states that the caller's moved."""
        run, best = self.runs.finished[0]
        still = _differ(best, given, self._approaches.unmoved())
        worsened = still or best.is_worse(given, run.work) or _goal_left(self._problem, best, given)
        if worsened and not self._stop.due:
            run = self.runs.add(guess_from(given, "descent from the given plan"))
            other = self.runs.result_of(run, refine)
            wanted = best.is_worse(given, run.work) or (still and other.cost < best.cost) or other.rank < best.rank
            self.runs.offer(run, other, better=wanted and not other.is_worse(given, run.work))
        run, best = self.runs.finished[0]
        if best.is_worse(given, run.work):
            status = Status.TIME_LIMIT if self._stop.due else Status.STALLED
            detail = "no plan was found that is better than the given one, which is returned"
            self.runs.offer(run, replace(given, status=status, detail=detail), better=True)

    def retry_without_risk(self) -> None:
        """Where the risk was too high for an intermediate plan, solve without risk, and continue from that plan."""
        riskless = replace(self._problem, risk=0.0)
        with self._problem.dynamics.solving(self._solving):
            runs = choose(
                [self.runs.another(run.initial_guess, riskless) for _, run in self.runs.named], self._stop.threads
            )
        plan = self.runs.result_of(runs[0])
        if not plan.success or self._stop.due:
            return
        begin = guess_from(plan, "a plan without risk")
        run = self.runs.add(replace(begin, cost_to_go=plan.values["cost_to_go"], multipliers=plan.multipliers))
        result = self.runs.result_of(run)
        # Of plans whose risk is too high, this one is near an optimum.
        self.runs.offer(run, result, better=result.rank <= self.runs.best.rank)

    def _judged(self, result: RunResult) -> RunResult:
        """The best result with what is to be said of it after all attempts."""
        problem, stop = self._problem, self._stop
        if not np.isfinite(result.states).all() and not result.success:
            result = replace(result, status=Status.NOT_FINITE, detail=left_domain(problem, result))
        elif result.status is Status.INFEASIBLE and not self.tried and stop.error is None:
            untried = "no time was left for other starts, which may keep the constraints"
            result = replace(result, status=Status.TIME_LIMIT, detail=joined(result.detail, untried))
        elif self._cut_short and np.isfinite(result.cost):
            untried = "no time was left for further attempts, which may find a better plan"
            result = replace(result, status=Status.TIME_LIMIT, detail=joined(result.detail, untried))
        elif not stop.due or (self._approaches.still is not None and not self._approaches.comes_nearer(result)):
            result = self._approaches.described(result)
        if result.success and (cheapest := self.runs.cheaper_elsewhere(CHEAPER)) is not None:
            other = self._unfinished(*self.runs.finished[cheapest])
            result = replace(result, detail=joined(result.detail, other))
        return result

    def _unfinished(self, run: SolveRun, result: RunResult) -> str:
        """That another plan costs less and has not converged, and how to go on from it; empty for an unnamed one."""
        less = f"a plan that has not converged keeps the constraints and costs less, {result.cost:.6g}"
        names = (name for name, other in self.runs.named if other is run)
        return next((f"{less}: the trajectory of candidate {name!r}, a start to go on from" for name in names), "")

    def _candidates(self) -> tuple[Candidate, ...]:
        """All runs as candidates; none if there was one run."""
        if len(self.runs.named) == 1:
            return ()
        results = {id(run): result for run, result in self.runs.finished}
        return (
            *(run.candidate(name, results.get(id(run))) for name, run in self.runs.named),
            *self._softening.candidates,
        )

    @property
    def may_go_on(self) -> bool:
        """Whether other starts may be tried: by default, as long as there is time."""
        return self._settings.safeguard and not self._stop.due

    @property
    def _cut_short(self) -> bool:
        """Whether other starts or softer contacts may still make a failed plan better, but no time is left for them."""
        if self.runs.best.success or not (self._default and self._settings.safeguard and self._stop.due):
            return False
        if not self.tried and self._is_unacceptable:
            return True
        return bool(self._softening.problems) or any(
            True for _ in self._problem.dynamics.softened(self.runs.best.states)
        )

    @property
    def is_poor(self) -> bool:
        """Whether other starts are to be tried. INFEASIBLE is said of the problem, wherever the caller begins."""
        return self.runs.best.status is Status.INFEASIBLE or (self._default and self._is_unacceptable)

    @property
    def needs_others(self) -> bool:
        """Whether other starts may be tried, and are to be, and not all were."""
        return not self.tried and self.may_go_on and self.is_poor

    @property
    def _is_unacceptable(self) -> bool:
        """Whether the best plan so far is unacceptable: far from the goal, or through an obstacle.

        Far means farther than the robot's radius, or, without a position, than the tolerance of a goal. Through means
        deeper than half the radius, or half the radius of the largest collision sphere. Without an ObstacleCost, a plan
        is unacceptable if it violates the constraints, or does nothing. With one, a plan that has not converged is
        unacceptable exactly if iterations are left.
        """
        problem, space, (run, best) = self._problem, self._problem.dynamics.state_coordinates, self.runs.finished[0]
        if not self._guided or problem.goal is None:
            # It does nothing where no single control helps from rest, but several together would.
            nominal = problem.nominal_controls
            idle = np.abs(best.controls - nominal).max() <= IDLE * max(1.0, np.abs(nominal).max())
            does_nothing = best.success and best.cost > run.work.memory["negligible"] and idle
            return does_nothing or (bool(problem.constraints) and not best.success)
        radius = max(cost.radius for cost in problem.obstacle_costs)
        if not best.success:
            return run.budget.left > 0
        if space.position:
            place = list(space.position)
            far = not np.linalg.norm(best.states[-1, place] - problem.goal[place]) <= max(radius, 1e-3)
        else:
            far = not Target(space, problem.weighed_goal, best.states).distance(best.states[-1]) <= TOLERANCE
        if far:
            return True
        clearance = clearance_of(problem, best.states)
        return clearance is not None and not clearance.min() >= -0.5 * radius


class Approaches:
    """Motions that change states which miss their goal and which no control changes along the best plan.

    Such a plan is stationary, but says nothing: a box that nothing touches does not move, whatever the weight of its
    place.

    Attributes:
      still: the plan along which nothing changes them, and these states; None before the motions were tried.
      best_nearer: the best plan that brings them nearer to their goal, with the name of its start.
    """

    still: tuple[RunResult, list[int]] | None = None
    best_nearer: tuple[str, RunResult] | None = None
    _cheapest: tuple[str, float] | None = None  # the name and the cost of the cheapest start that brings them nearer

    def __init__(self, runs: Runs) -> None:
        self._runs, self._problem, self._stop = runs, runs.problem, runs.stop
        self._unmoved = dict[RunResult, list[int]]()  # by the plan
        self._tried: list[str] = []  # the approaches

    def push_and_approach(self) -> None:
        """Begin with pushes by one control at a time, and with approaches to a body that nothing touches."""
        problem, before, places = self._problem, self._runs.best, self.unmoved()
        self.still = before, places
        plans = list[tuple[bool, float, str, Start]]()

        def consider(name: str, begin: Start, plan: Motion) -> bool:
            """Keep a plan that changes these states; return whether it takes them nearer to their goal at less cost."""
            cost = compiled.cost_of(problem, *plan)
            if not (np.isfinite(cost) and _differ(plan, before, places)):
                return False
            nearer = self.comes_nearer(plan)
            plans.append((not nearer, cost, name, begin))
            return nearer and cost < SAVES * before.cost

        for name, controls, plan in multistart.pushes(problem):
            consider(name, controls, plan)
        for name, through in _approaches(problem, before, places):
            if self._stop.due:
                break
            drawn = self._runs.result_of(self._runs.another(None, through), refine, most=APPROACH).kept()
            self._tried.append(name)
            plan = compiled.rollout(problem, *drawn.policy, before.states[0].copy())
            if consider(name, guess_from(drawn, name), plan):
                break
        plans.sort(key=lambda entry: entry[:2])
        self._cheapest = next(((name, cost) for missed, cost, name, _ in plans if not missed), None)
        for _, _, name, begin in plans[:PUSHES]:
            run = self._runs.add(begin, name)
            begun, other = (self._runs.result_of(run, how) for how in (_initial_rollout, refine))
            if other.is_worse(begun, run.work):  # a plan that no step can begin from is left by smoothing
                status = Status.TIME_LIMIT if self._stop.due else Status.STALLED
                other = replace(begun, status=status, detail="no step lowers the cost of this plan")
            self._runs.offer(
                run, other, better=before.violation >= other.violation and other.cost < self._runs.best.cost
            )
            if self.comes_nearer(other) and (self.best_nearer is None or other.cost < self.best_nearer[1].cost):
                self.best_nearer = name, other

    def comes_nearer(self, plan: RunResult | Motion) -> bool:
        """Whether a plan brings states, which no control changed along the first plan, well nearer to their goal."""
        if self.still is None or not np.isfinite(plan.states[-1]).all():
            return False
        first, places = self.still
        now, before = (_missing(self._problem, motion.states[-1], places) for motion in (plan, first))
        return bool(np.linalg.norm(now) < (1 - NEARER) * np.linalg.norm(before))

    def unmoved(self) -> list[int]:
        """The states that miss their goal and that no control changes along the best plan."""
        problem, best = self._problem, self._runs.best
        if not np.isfinite(best.cost):
            return []
        if best in self._unmoved:
            return self._unmoved[best]
        states, controls, end, goal = best.states, best.controls, best.states[-1], problem.goal
        sizes = np.maximum(np.ptp(states, axis=0), 0.0 if goal is None else np.abs(np.nan_to_num(goal - end)))
        sizes = np.where(sizes > 0, sizes, 1.0)
        with self._stop.not_counting():  # compiling
            slope = _final_cost(problem, end)[1]
        missed = np.abs(slope) * sizes > MISSED_SHARE * abs(best.cost)
        for i, number in goals_of(problem.constraints, problem.dynamics).items():
            missed[i] |= abs(end[i] - number) > self._runs.method.violation
        space, places = problem.control_coordinates, np.flatnonzero(missed)
        span = np.subtract(space.high, space.low)
        span = np.where(np.isfinite(span), span, np.maximum(np.abs(controls).max(axis=0), 1.0))
        pull = np.eye(len(end))[places]
        for state, control in zip(states[-2::-1], controls[::-1], strict=True):
            if not len(places):
                break
            with np.errstate(all="ignore"):
                a, b, _ = problem.dynamics.linearize(state, control, problem.dt)
            still = (np.abs(pull @ b) * span).sum(axis=1) <= NO_CHANGE * sizes[places]
            places, pull = places[still], (pull @ a)[still]
        return self._unmoved.setdefault(best, places.tolist())

    def described(self, result: RunResult) -> RunResult:
        """The result with the states that miss their goal and that no control changes; STALLED if others would."""
        problem, places, states = self._problem, self.unmoved(), result.states
        if not places:
            return result
        named = [problem.dynamics.state_coordinates.names[i] for i in places]
        bodies = dict.fromkeys(filter(None, (problem.dynamics.untouched_body(states, i) for i in places)))
        said = f"no control changes {' or '.join(named)} along this plan"
        said += f": nothing that moves touches {' or '.join(bodies)}" if bodies else ""
        parts = said, self._in_words(result, untouched=bool(bodies)), result.detail
        # If other controls would change one of these states, the plan is on a plateau, and no optimum. They may at any
        # time, for what sways may come back to the end.
        gain = np.zeros((problem.steps, len(problem.nominal_control), len(states[0])))
        sways = (sinusoidal_controls(problem, cycles) for cycles in SWAYS[:2])
        others = (compiled.rollout(problem, gain, controls, states[0].copy()).states for controls in sways)
        otherwise = bool(bodies) or any((np.abs(other - states)[:, places] > NO_CHANGE).any() for other in others)
        status = Status.STALLED if result.success and otherwise else result.status
        names = ", ".join(named)
        remedy = f"leave {names} out of the goal, which no control that was tried changes"
        if self._cheapest is not None:
            remedy = f"raise the weight of {names} until moving it costs less than leaving it"
        elif otherwise:
            clause = "with which the robot touches that body" if problem.dynamics.by_mujoco else f"that change {names}"
            remedy = f"begin with start=[...], controls {clause}"
        if self._stop.due:
            status, remedy = Status.TIME_LIMIT, ""
        return replace(result, status=status, detail=joined(*parts), remedy=remedy)

    def _in_words(self, result: RunResult, *, untouched: bool) -> str:
        """A text on the motions that were tried to change the states that no control changes along a plan."""
        if self._cheapest is not None:
            name, cost = self._cheapest
            return f"{name} brings it nearer to its goal, at a cost of {cost:.3g} instead of {result.cost:.3g}"
        if self._tried:
            tried = ", ".join(dict.fromkeys(self._tried))
            return f"nothing that was tried brings it nearer to its goal: {tried}"
        known = "nothing that is driven can collide with it, or it is to turn on the spot"
        return f"no approach is known: {known}" if self.still is not None and untouched else ""


class Softening:
    """Plans for softer contacts and limits, and then for the true ones.

    Attributes:
      candidates: the plans for softer contacts.
      problems: the problem with contacts of each softness, the widest first; none before plans were made for them.
    """

    def __init__(self, runs: Runs, approaches: Approaches) -> None:
        self._runs, self._problem, self._stop, self._approaches = runs, runs.problem, runs.stop, approaches
        self.candidates: list[Candidate] = []
        self.problems: list[tuple[str, Problem]] = []

    def soften(self) -> None:
        """Plan for contacts and limits of decreasing softness, and then for the true ones.

        Each solve begins with the policy of the previous solve, not with its controls: if a contact comes slightly
        earlier or later, the rest of the plan must not be lost. Which optimum is found depends on where the widest
        softness begins. So oscillating controls are tried there as well; after two softnesses their costs tell which
        are good, and a third of the plans goes on at each. Before, a plan that moves a body at last is softened by
        less: for the softest contacts, it would leave the body alone again.
        """
        problem, nearer = self._problem, self._approaches.best_nearer
        begin = self._runs.best if nearer is None else nearer[1]
        self.problems = [
            (name, replace(problem, dynamics=dynamics)) for name, dynamics in problem.dynamics.softened(begin.states)
        ]
        if not self.problems:
            return
        (name, widest), *harder = self.problems
        if nearer is not None:
            self._stiffen({f", {nearer[0]}": begin}, harder, [])
            if self._runs.best.success or self._stop.due:
                return
        results = {"": self._keep_softer(name, *_searched(widest, self._runs))}
        for cycles, side in itertools.product(SWAYS, (1, -1)):
            if not self._stop.due:
                begin, origin = sinusoidal_controls(widest, side * cycles), f", {sinusoidal_name(side * cycles)}"
                results[origin] = self._solve_softly(f"{name}{origin}", widest, begin, LOOK)
        self._stiffen(results, harder, [name])

    def alternate(self) -> None:
        """Soften the cheapest plan's contacts a little, stiffen them, and keep its modes, in turn.

        Softness moves a plan across the switches beside which it ended; descent within its modes ends at an optimum
        again. The next round begins with this optimum, until a round gains less than `FELL`; at most `ROUNDS` times.
        """
        optimum, last = None, [] if self._problem.constraints else self.problems[-AGAIN:]
        for _ in range(ROUNDS):
            before = self._cheapest
            again = self._stiffen({", again": before}, last, [], SOFT) if last else None
            begin = min(
                (candidate for candidate in (before, again) if candidate is not None and candidate is not optimum),
                key=lambda result: result.cost, default=before,
            )  # fmt: skip
            if begin is optimum or self._stop.due or not begin.cost < before.cost + NEAR * abs(before.cost):
                return
            if not self._keep_modes(begin):
                return
            optimum = self._cheapest
            if not optimum.cost < before.cost - FELL * abs(before.cost):
                return

    def leave_contact_modes(self) -> None:
        """If the best plan ended within its contact modes, and one beside it is cheaper, descend out of them."""
        run, best = self._runs.finished[0]
        contacts = None if best.certificate is None else best.certificate.contacts
        if contacts is None or not max(contacts.across, contacts.sampled) > run.method.tolerance:
            return
        run = self._runs.add(guess_from(best, "the best plan"), "the best plan, out of its contact modes")
        result = self._runs.result_of(run, refine, most=SOFT)
        self._runs.offer(run, result, better=self._is_better(result))

    def _is_better(self, result: RunResult) -> bool:
        """Whether a plan is better than the best."""
        best = self._runs.best
        # Where only one of them moves a body that was out of reach, cost decides: to leave it alone converges easily.
        if self._approaches.comes_nearer(result) == self._approaches.comes_nearer(best):
            return result.rank < best.rank
        return result.violation <= best.violation and result.cost < best.cost

    def _stiffen(
        self, plans: dict[str, RunResult], soft: Sequence[tuple[str, Problem]], before: list[str],
        most: int | None = None,
    ) -> RunResult | None:  # fmt: skip
        """Continue from these plans for each softness in turn, from fewer at each, and then for the true contacts.

        The plans, by the ends of their names, have passed the softnesses `before`. Returns the plan for the true
        contacts, after `most` iterations there at most, if that is given; None if no time is left for it.
        """
        for name, problem in soft:
            most_soft = LOOK if len(plans) > 1 else SOFT
            plans = {
                origin: self._solve_softly(f"{name}{origin}", problem, guess_from(result, name), most_soft)
                for origin, result in plans.items()
                if np.isfinite(result.cost)
            } or plans
            if self._stop.due:
                return None
            plans = dict(sorted(plans.items(), key=lambda pair: pair[1].cost)[: -(-len(plans) // FEWER)])
        origin = min(plans, key=lambda origin: plans[origin].cost)
        run = self._runs.add(guess_from(plans[origin], "a plan for softer contacts"))
        ended = self._runs.result_of(run, refine, most=most)
        stages = ", ".join([*before, *(name for name, _ in soft)])
        ended = replace(ended, origin=f"begun with contacts of softness {stages}{origin}")
        self._runs.offer(run, ended, better=self._is_better(ended))
        return ended

    def _solve_softly(self, name: str, soft: Problem, begin: Start, most: int) -> RunResult:
        run = self._runs.another(begin, soft)
        return self._keep_softer(name, run, self._runs.result_of(run, refine, most=most))

    def _keep_softer(self, name: str, run: SolveRun, result: RunResult) -> RunResult:
        self.candidates.append(run.candidate(f"contacts of softness {name}", result))
        return result

    def _keep_modes(self, plan: RunResult) -> bool:
        """Continue within the contact modes of a plan, where it may end next to a jump or at a kink, if possible."""
        from lqrsim.solvers.contact_modes import keep_modes  # this imports MuJoCo, which few problems need

        run = self._runs.another(guess_from(plan, "the best plan"))
        result = None
        # A cost that is not curved in all controls has no descent of this kind.
        with contextlib.suppress(np.linalg.LinAlgError):
            result = self._runs.result_of(run, lambda run, _: keep_modes(run, plan))
        if result is None:
            return False
        self._runs.named.append(("the best plan, within its contact modes", run))
        self._runs.offer(run, replace(result, origin=plan.origin), better=result.rank <= self._runs.best.rank)
        return True

    @property
    def _cheapest(self) -> RunResult:
        """The cheapest plan, whether it has converged or not; with constraints, the best."""
        if self._problem.constraints:
            return self._runs.best
        finite = [result for _, result in self._runs.finished if np.isfinite(result.cost)]
        return min(finite, key=lambda result: result.cost, default=self._runs.best)


def _searched(problem: Problem, runs: Runs) -> tuple[SolveRun, RunResult]:
    """The best run of a search for another problem than that of these runs, as far as the choice of a start."""
    search = Search(problem, runs.settings, runs.stop, guides(problem, None))
    with problem.dynamics.solving(search._solving):
        search.solve_from_starts()
        search.try_other_starts()
    return search.runs.finished[0]


def _initial_rollout(run: SolveRun, _: Known) -> RunResult:
    """The rollout of the initial policy, certified, as a plan that the answer must not be worse than."""
    run.roll_out()
    work, policy = run.work, run.work.arrays.last_policy
    result = RunResult(status=Status.STALLED, plan=work.last, policy=policy, cost=work.cost).kept()
    return certified(run, result) if np.isfinite(result.states).all() else result


def left_domain(problem: Problem, result: RunResult) -> str:
    """In words, when the states of a plan that is not finite leave their domain, and which; and what led there."""
    names, finite = problem.dynamics.state_coordinates.names, np.isfinite(result.states)
    step = int(np.argmin(finite.all(axis=1)))
    left = [
        f"{name} {'is not a number' if np.isnan(number) else 'grows beyond all numbers'}"
        for name, number in zip(names, result.states[step], strict=True)
        if not np.isfinite(number)
    ]
    place = f"at {step * problem.dt:.2f} s (step {step} of {problem.steps}) {' and '.join(left)}"
    return joined(place, "" if "nan" in result.detail else result.detail)


def line_of_states(problem: Problem) -> Trajectory:
    """The line of states from start to goal, with the nominal controls."""
    assert problem.start is not None
    end = problem.start if problem.goal is None else np.where(np.isnan(problem.goal), problem.start, problem.goal)
    controls = np.broadcast_to(problem.nominal_controls, (problem.steps, len(problem.control_coordinates)))
    return Trajectory(np.linspace(problem.start, end, problem.steps + 1), controls.copy(), problem.dt)


def guess_from(result: RunResult, summary: str) -> InitialGuess:
    """The policy of a result as a start."""
    return InitialGuess(result.policy.gain.copy(), result.policy.offset.copy(), summary)


def _differ(plan: RunResult | Motion, other: RunResult | Motion, places: list[int]) -> bool:
    """Whether two plans end with different values of these states."""
    return bool((np.abs(plan.states[-1] - other.states[-1])[places] > NO_CHANGE).any())


def _goal_left(problem: Problem, result: RunResult, baseline: RunResult) -> bool:
    """Whether a plan has gone farther from the goal than a given one, to where the final cost has no slope."""
    value, slope, _ = _final_cost(problem, result.states[-1])
    before, steeper, _ = _final_cost(problem, baseline.states[-1])
    return value > before and float(np.abs(slope).max()) < LEFT * float(np.abs(steeper).max())


def _final_cost(problem: Problem, state: Array) -> tuple[float, Array, Array]:
    """The final cost, its gradient (n,) and its Hessian (n, n)."""
    n, final = len(state), compiled.compile_problem(problem).final
    no_control = np.zeros(len(problem.nominal_control))
    value, gradient, hessian = compiled.quadratic_at(problem, final, state, no_control, problem.steps)
    return value, gradient[:n], hessian[:n, :n]


def _missing(problem: Problem, state: Array, places: list[int]) -> Array:
    """By how much these states of a final state (n,) are short of the goal, (n,); zero for all others."""
    shortfall, (_, slope, curvature) = np.zeros(len(state)), _final_cost(problem, state)
    shortfall[places] = -np.linalg.lstsq(curvature[np.ix_(places, places)], slope[places])[0]
    for i, number in goals_of(problem.constraints, problem.dynamics).items():
        shortfall[i] = number - state[i] if i in places else 0.0
    return shortfall


def _approaches(problem: Problem, result: RunResult, places: list[int]) -> Iterator[tuple[str, Problem]]:
    """Motions that take a body that nothing touches to its goal, in words, and problems that draw the robot along them.

    There the robot passes through the body, which does not move: its goals are left out of the constraints. The
    solutions are starts in which the robot touches the body.
    """
    constraints = [part for part in problem.constraints if not part.final_states(problem.dynamics)]
    shortfall = _missing(problem, result.states[-1], places)
    for words, dynamics, about in problem.dynamics.approaches(result.states, shortfall):
        drawn = ~np.isnan(about)
        ways = np.where(drawn, about, -np.inf).max(axis=0) - np.where(drawn, about, np.inf).min(axis=0)
        ways = np.maximum(ways, LEAST_WAY * ways.max())
        weights = np.where(drawn[0], multistart.FOLLOWED * abs(result.cost) / (problem.steps * ways**2), 0.0)
        stage = problem.stage_cost + QuadraticCost(
            drawn[:, :, None] * np.diag(weights), about=np.where(drawn, about, 0.0)
        )
        yield words, replace(problem, dynamics=dynamics, constraints=constraints).with_costs(stage_cost=stage)

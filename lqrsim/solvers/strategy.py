"""What `smooth` tries, top to bottom, until something converges.

`solve`
  1. The search: a few iterations from each start, and the most promising one is continued to its end (`Search.run`).
     With constraints, the others follow as long as they may cost less.
  2. Where the best plan is far from the goal, goes through an obstacle, violates the constraints or does nothing: other
     ways round by heavier obstacles and goal; or, where there is no ObstacleCost, motions along other paths and
     oscillating controls (`Search.widen`).
  3. Where the best plan touches a constraint that may be passed on another side: paths to the left and to the right
     (`Search.look_aside`).
  4. Where the risk is too high on the way: the plan without risk, and on from there (`Search.retry_without_risk`).
  5. Where nothing converges among contacts or joint limits of an MJCF: plans for softer ones, less and less soft, and
     on to the true ones from there (`Search.soften`). Where that ends at a jump or a kink, a descent that keeps to
     the contacts that act (`contact_modes.py`).

`finish`, for one start
  without constraints: smoothing; Newton's method once it has found the valley; damped iterations where smoothing fails
     (`SolveRun.solve`). If controls have limits: the interior point where controls stay at them, or all of that fails.
  with constraints: a ladder of plans to begin with, each finished by the interior point (`constrained.py`).
  without Newton's method, that is with `finish=None`, `stop="cost"`, noise and constraints, or the dynamics of an MJCF:
     smoothing, and the augmented Lagrangian for constraints (`augmented_lagrangian.py`).

The budget of each start is `max_iterations`; the deadline is one for all (`budget.py`). Every answer is certified
(`certify.py`).
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lqrsim.errors import InputError
from lqrsim.kernels import declarations
from lqrsim.problem.derivative_check import check_functions
from lqrsim.problem.problem import Problem
from lqrsim.results.goal import TOLERANCE, Target
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Status, Trajectory
from lqrsim.solvers import augmented_lagrangian
from lqrsim.solvers.assembly import assemble, clearance_of
from lqrsim.solvers.budget import Budget, Callback, Stop
from lqrsim.solvers.constrained import OPENING, Known, Ladder
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.free_duration import find_duration, settled
from lqrsim.solvers.infeasibility import Evidence, alike
from lqrsim.solvers.initial_guess import InitialGuess, StartLike, resolve
from lqrsim.solvers.interior_point import Measures, iteration_of
from lqrsim.solvers.multistart import (
    FOLLOW, SWAYS, along_paths, choose, detours, guides, passable, pull, reweighted, sinusoidal_controls,
)  # fmt: skip
from lqrsim.solvers.risk import name_risk
from lqrsim.solvers.settings import SmootherSettings

# Controls are idle if they are this close to the nominal ones, relative to these and at least 1.
IDLE = 1e-6
# Factors on the weights of obstacles and goal that find another way round.
HEAVIER = (10.0, 100.0)
# For a free duration: how often a shorter one is tried, by which factor, and with how many iterations.
SHORTENED, SHORTER, TRIES = 3, 0.9, 150
# Iterations for each softness of contacts.
SOFT = 60

Finish = Callable[[SolveRun, Known], RunResult]


def solve(
    problem: Problem,
    settings: SmootherSettings,
    *,
    attentive: bool = False,
    threads: int = 1,
    callback: Callback | None = None,
) -> Solution:
    """Solve one problem. For `attentive` see `Budget`; `threads` is for the search among starts."""
    if problem.duration is not None:
        return _solve_for_duration(problem, settings, attentive=attentive, threads=threads, callback=callback)
    given = [("", settings.start)] if settings.start is not None else guides(problem, settings.starts)
    start = np.zeros(len(problem.dynamics.state_coordinates)) if problem.start is None else problem.start.copy()
    first = resolve(given[0][1], problem).penalised(problem, settings.penalty)
    check_functions(problem, start, first.offset[0].copy())
    stop = Stop()
    runs = [
        SolveRun.lent(problem, settings, guess, start, Budget(settings.max_iterations, stop, attentive=attentive))
        for guess in (first, *(resolve(one, problem) for _, one in given[1:]))
    ]
    stop.begin(settings.time_limit)  # compiling, which comes before, does not count
    search = Search([name for name, _ in given], runs, callback, threads)
    with stop.reporting("smooth", attentive):
        with problem.dynamics.solving(threads if len(runs) == 1 else 1):
            search.run()
            default = settings.start is None and settings.starts is None
            # INFEASIBLE is a statement about the problem, wherever the caller begins, so it needs other starts.
            poor = search.says_infeasible or (default and search.is_unacceptable)
            if settings.safeguard and not stop.due and poor:
                search.widen()
            if settings.start is None and search.best[0].second_order and not stop.due:
                search.look_aside()
            if problem.risk > 0 and settings.safeguard and not stop.due:
                search.retry_without_risk()
        if default and settings.safeguard and not stop.due and not search.best[1].success:
            search.soften()
            if not search.best[1].success and not stop.due:
                search.keep_modes()
    chosen, found = search.best
    detail = name_risk(chosen, found) if found.status is Status.RISK_TOO_HIGH else found.detail
    tolerances = {"tolerance": chosen.final, "constraint_tolerance": settings.violation_tolerance(problem)}
    solution = assemble(
        problem, replace(found, detail=detail), chosen.budget.log, solver="smooth",
        options=settings.options(chosen.initial_guess) | tolerances, candidates=search.candidates(),
    )  # fmt: skip
    for run in runs:
        run.give_back()
    return stop.finish(solution)


def finish(run: SolveRun, known: Known) -> RunResult:
    """Run from one start to the end; certified. `known` has the results of other runs of the same problem."""
    if run.initial_guess.found is not None:
        return Ladder(run, known).climb()
    if not run.problem.constraints:
        return run.certified(_without_constraints(run))
    if run.second_order:
        return Ladder(run, known).climb()
    found = augmented_lagrangian.finish(run)
    # It begins with the optimum without the constraints, which is often the same from all starts: they count as one.
    if found.stuck and not known.evidence:
        known.evidence.append(Evidence(found, found.violation))
    return found


def refine(run: SolveRun, known: Known) -> RunResult:
    """Run to the end from the rollout of the first policy, on its side of the obstacles; certified."""
    if run.problem.constraints and run.second_order:
        return Ladder(run, known).climb(stay=True)
    found = augmented_lagrangian.refine(run)
    if not found.stuck:
        return found
    known.evidence.append(one := Evidence(found, found.violation))
    return replace(found, status=Status.INFEASIBLE) if one in alike(known.evidence) else found


def _without_constraints(run: SolveRun) -> RunResult:
    """Smoothing and Newton's method. If controls have limits, the interior point where they stay there or all fails."""
    problem, budget = run.problem, run.budget
    space = problem.control_coordinates
    if not run.second_order or problem.noise_term is not None or not np.isfinite([space.low, space.high]).any():
        return run.solve()
    run.smooth(OPENING)
    controls = run.work.plan.controls
    pressed = ((controls <= space.low) | (controls >= space.high)).any()
    if run.ending.outcome == declarations.RUNNING and pressed and np.isfinite(run.cost):
        found = Ladder(run, Known()).from_plan(run.work.plan)
        if found is not None:
            return found
    found = run.solve()
    if found.success or budget.stop.due or budget.left < 2:
        return found
    ladder = Ladder(run, Known())
    plan = run.work.plan if np.isfinite(found.cost) else ladder.start()
    return ladder.from_plan(plan) or found


class Search:
    """Several runs; the most promising ones are finished.

    Attributes:
      best: the run with the best result so far, and that result.
    """

    def __init__(self, names: Sequence[str], runs: Sequence[SolveRun], callback: Callback | None, threads: int) -> None:
        self._named = list(zip(names, runs, strict=True))
        self._callback, self._threads, self._known = callback, threads, Known()
        self._problem, self._settings = runs[0].problem, runs[0].settings
        self._start, self._budget = runs[0].work.start.copy(), runs[0].budget
        self._finished: list[tuple[SolveRun, RunResult]] = []
        self._softer: list[Candidate] = []  # plans for softer contacts

    @property
    def best(self) -> tuple[SolveRun, RunResult]:
        return self._finished[0]

    def run(self) -> None:
        """Choose a run and finish it; with constraints, finish others too, as long as they may cost less."""
        chosen, *others = choose([run for _, run in self._named], self._threads)
        self._finish(chosen)
        if not chosen.problem.constraints:
            return
        # Constraints can make the best way round the worst, or close it. The others' costs so far, without constraints,
        # are about the least that they can cost with them.
        for run in sorted(others, key=lambda run: run.cost):
            best = self.best[1]
            if self._budget.stop.due or best.final or (best.success and not run.cost < best.cost):
                break
            self._finish(run)

    @property
    def is_unacceptable(self) -> bool:
        """Whether the best plan so far is one that nobody would want: far from the goal, or through an obstacle.

        Far is farther than the robot's radius, or, without a position, than the tolerance of a goal; through is deeper
        than half the radius, or half that of the largest collision sphere.
        """
        problem = self._problem
        space = problem.dynamics.state_coordinates
        if pull(problem) == 0 or problem.goal is None:
            return self._idle() or (bool(problem.constraints) and not self.best[1].success)
        (run, found), radius = self.best, max(cost.radius for cost in problem.obstacle_costs)
        if not found.success:
            return run.budget.left > 0
        if space.position:
            place = list(space.position)
            arrived = np.linalg.norm(found.states[-1, place] - problem.goal[place]) <= max(radius, 1e-3)
        else:
            target = Target(space, problem.weighed_goal, found.states)
            arrived = target.distance(found.states[-1]) <= TOLERANCE
        if not arrived:
            return True
        clearance = clearance_of(problem, found.states)
        return clearance is not None and not clearance.min() >= -0.5 * radius

    def _idle(self) -> bool:
        """Whether the best plan does nothing, as when no single control helps from rest, but several together would."""
        found, nominal = self.best[1], self._problem.nominal_control
        off = np.abs(found.controls - nominal).max()
        return found.success and found.cost > 0 and off <= IDLE * max(1.0, np.abs(nominal).max())

    @property
    def says_infeasible(self) -> bool:
        """Whether the best result is INFEASIBLE, which other starts may disprove."""
        return self._stuck and self.best[1].status is Status.INFEASIBLE

    @property
    def _stuck(self) -> bool:
        """Whether there is a plan whose violation is stationary, and none that keeps the constraints."""
        return bool(self._known.evidence) and not self.best[1].success

    def widen(self) -> None:
        """Try other starts: another way round, or, where there is nothing to go round, other controls and paths."""
        if not self.best[1].success and self._problem.constraints and pull(self._problem) == 0:
            self._try_elsewhere()
        elif pull(self._problem) == 0:
            self._try_sinusoidal_controls()
        else:
            for times in HEAVIER:
                self._try_reweighted(times)

    def _try_sinusoidal_controls(self) -> None:
        problem = self._problem
        runs = [self._another(resolve(sinusoidal_controls(problem, cycles), problem)) for cycles in SWAYS]
        named = dict(zip(map(id, runs), SWAYS, strict=True))
        chosen = choose(runs, self._threads)[0]
        self._named.append((f"controls that sway {named[id(chosen)]} times", chosen))
        found, best = self._to_its_end(chosen, finish, Known()), self.best[1]
        # Even a plan that has not converged is better than doing nothing.
        better = found.violation <= best.violation and found.cost < best.cost
        self._finished.insert(0 if better else len(self._finished), (chosen, found))

    def _try_elsewhere(self) -> None:
        """Try other starts until one leads to a plan, before the constraints are called infeasible."""
        problem, exact = self._problem, self.best[0].second_order
        starts: dict[str, StartLike] = dict(self._motions()) if exact else {}
        sways = {f"controls that sway {cycles} times": sinusoidal_controls(problem, cycles) for cycles in SWAYS[:2]}
        for name, one in (starts | sways).items():
            if self._budget.stop.due or self.best[1].success:
                return
            self._known.from_start = False
            # The augmented Lagrangian keeps to a start only where it begins with the start's own plan. A motion is on
            # its side of the obstacles, which smoothing without the constraints leaves.
            self._finish_from(name, one, finish if exact and name in sways else refine)

    def _motions(self) -> list[tuple[str, Trajectory]]:
        """Motions along paths from start to goal, by name: those first that violate the constraints least."""
        problem, found = self._problem, list[tuple[float, str, Trajectory]]()
        cost = self.best[1].cost
        for name, prior in along_paths(problem, self._moving(), cost if 0 < cost < np.inf else 1.0).items():
            run = self._another(resolve(prior, problem))
            run.smooth(FOLLOW)
            motion = Trajectory(*(part.copy() for part in run.work.arrays.rollout), problem.dt)
            if np.isfinite(motion.states).all():
                values = run.work.constraint_values(motion.states, motion.controls)
                found.append((run.work.violation(values), name, motion))
        return [(name, motion) for _, name, motion in sorted(found, key=lambda one: one[0])]

    def _moving(self) -> list[int]:
        """The states that place the robot: its position, or else those on which constraints to be passed depend."""
        problem, work, controls = self._problem, self._named[0][1].work, self._problem.nominal_control
        position, moving = list(problem.dynamics.state_coordinates.position), set[int]()
        if position or problem.start is None or problem.goal is None:
            return position
        for k, one in enumerate(passable(problem)):
            for row in range(problem.constraint_terms[k].rows if one else 0):
                for state in (problem.start, problem.goal):
                    moving |= set(np.flatnonzero(work.constraint_slope(k, row, state, controls, 1)).tolist())
        return sorted(moving & set(range(len(problem.start))))

    def look_aside(self) -> None:
        """Finish plans from paths aside, if the best plan touches a constraint that may be passed on another side."""
        problem, tried = self._problem, {name for name, _ in self._named}
        touched = any(one.values.any() for one in itertools.compress(self.best[1].multipliers, passable(problem)))
        if touched and pull(problem) == 0:
            for name, one in detours(problem, self._settings.starts).items():
                if name not in tried and not self._budget.stop.due:
                    self._finish_from(name, one)

    def _finish_from(self, name: str, start: StartLike, how: Finish = finish) -> None:
        run = self._another(resolve(start, self._problem))
        self._named.append((name, run))
        self._finish(run, how)

    def _try_reweighted(self, times: float) -> None:
        """Solve for heavier obstacles, and refine the best of these plans by steps that lower the true cost."""
        if self._budget.stop.due:
            return
        heavier = reweighted(self._problem, times)
        runs = [self._another(resolve(guide, heavier), heavier) for _, guide in guides(heavier, None)]
        try:
            boldest = choose(runs, self._threads)[0].solve()
        except InputError:  # the heavier cost is not finite at the start
            return
        if self._budget.stop.due:
            return
        summary = f"a plan for {times:g} times the weight of obstacles and goal"
        run = self._another(InitialGuess(boldest.law[0].copy(), boldest.law[1].copy(), None, None, summary))
        self._named.append((summary, run))
        found, best = self._to_its_end(run, refine, self._known), self.best[1]
        # The same optimum, different within the tolerances, is no improvement.
        other = found.rank < best.rank and (not best.success or found.cost < best.cost - 1e-3 * abs(best.cost))
        self._finished.insert(0 if other else len(self._finished), (run, found))

    def soften(self) -> None:
        """Plan for softer contacts and limits, less and less soft, and then for the true ones.

        Each solve begins with the policy of the one before, not with its controls: what comes to a contact a little
        earlier or later must not lose the rest of the plan.
        """
        problem, begin = self._problem, None
        for name, dynamics in problem.dynamics.softened(self.best[1].states):
            run, found = self._solve_soft(dataclasses.replace(problem, dynamics=dynamics), begin)
            self._softer.append(run.candidate(f"contacts of softness {name}", found))
            if np.isfinite(found.cost):
                begin = InitialGuess(found.law[0].copy(), found.law[1].copy(), None, None, f"softness {name}")
            if self._budget.stop.due:
                return
        if begin is None:
            return
        run = self._another(replace(begin, summary="a plan for softer contacts"))
        self._named.append(("a plan for softer contacts", run))
        with problem.dynamics.solving(self._threads):
            found = self._to_its_end(run, refine, self._known)
        stages = ", ".join(one.start.removeprefix("contacts of softness ") for one in self._softer)
        detail = f"begun with contacts of softness {stages}; {found.detail}".removesuffix("; ")
        # The best so far may have been put before a plan that converged, but does nothing; so nothing is sorted here.
        better = found.rank < self.best[1].rank
        self._finished.insert(0 if better else len(self._finished), (run, replace(found, detail=detail)))

    def keep_modes(self) -> None:
        """From the best plan go on within its contact modes, where a plan may end beside a jump or at a kink."""
        from lqrsim.solvers.contact_modes import keep_modes  # it imports MuJoCo, which few problems need

        best = self.best[1]
        run = self._another(InitialGuess(best.law[0].copy(), best.law[1].copy(), None, None, "the best plan"))
        run.budget.report_to(self._callback)
        with self._problem.dynamics.solving(self._threads):
            found = keep_modes(run, best)
        if found is not None:
            self._named.append(("the best plan, within its contact modes", run))
            detail = "; ".join(part for part in (best.detail.partition("; ")[0], found.detail) if part)
            self._finished.insert(0 if found.rank <= best.rank else 1, (run, replace(found, detail=detail)))

    def _solve_soft(self, soft: Problem, begin: InitialGuess | None) -> tuple[SolveRun, RunResult]:
        """Plan for softer contacts: from that policy, or by a search where there is none."""
        if begin is not None:
            run = self._another(begin, soft)
            with soft.dynamics.solving(self._threads), run.budget.limited(SOFT):
                return run, refine(run, Known())
        given = guides(soft, None)
        runs = [self._another(resolve(one, soft), soft) for _, one in given]
        search = Search([name for name, _ in given], runs, self._callback, self._threads)
        with soft.dynamics.solving(self._threads if len(runs) == 1 else 1):
            search.run()
            if search.is_unacceptable and not self._budget.stop.due:
                search.widen()
        return search.best

    def retry_without_risk(self) -> None:
        """If the risk was too high on the way: solve without risk, and continue from that plan."""
        if all(run.ending.outcome != declarations.RISK_TOO_HIGH for _, run in self._named):
            return
        riskless = dataclasses.replace(self._problem, risk=0.0)
        runs = [self._another(run.initial_guess, riskless) for _, run in self._named]
        found = finish(choose(runs, self._threads)[0], Known())
        if not found.success or self._budget.stop.due:
            return
        summary = "a plan without a risk"
        initial_guess = InitialGuess(
            found.law[0].copy(), found.law[1].copy(), found.values["cost_to_go"], None, summary,
            multipliers=found.multipliers,
        )  # fmt: skip
        run = self._another(initial_guess)
        self._named.append((summary, run))
        self._finish(run)

    def candidates(self) -> tuple[Candidate, ...]:
        """All runs as candidates; none if there was one run."""
        results = {id(run): found for run, found in self._finished}
        found = [run.candidate(name, results.get(id(run))) for name, run in self._named]
        return (*found, *self._softer) if len(found) > 1 else ()

    def _another(self, initial_guess: InitialGuess, problem: Problem | None = None) -> SolveRun:
        problem = self._problem if problem is None else problem
        return SolveRun(problem, self._settings, initial_guess, self._start, self._budget.another())

    def _finish(self, run: SolveRun, how: Finish = finish) -> None:
        self._finished.append((run, self._to_its_end(run, how, self._known)))
        self._finished.sort(key=lambda pair: pair[1].rank)  # a stable sort: of equals, the first

    def _to_its_end(self, run: SolveRun, how: Finish, known: Known) -> RunResult:
        """Finish a run; the callback hears of all its iterations, also those before."""
        run.budget.report_to(self._callback)
        return how(run, known)


def _solve_for_duration(
    problem: Problem, settings: SmootherSettings, *, attentive: bool, threads: int, callback: Callback | None
) -> Solution:
    """Solve for the stated duration, then find the best one near it, and finish the plan with that.

    With a weight on time, and no start from the caller, shorter durations are tried, too, since they may lead another
    way round.
    """
    budget = Budget(settings.max_iterations, callback=callback)
    budget.stop.begin(settings.time_limit)
    log, clock = budget.log, time.perf_counter()

    def watch(measures: Measures) -> bool:
        nonlocal clock
        now, before = time.perf_counter(), log[-1].cost if log else np.inf
        budget.record(iteration_of(measures, before, now - clock))
        clock = now
        return budget.stop.due

    assert problem.duration is not None
    stated, first, best, near = problem.steps * problem.dt, None, None, None
    for attempt in range(SHORTENED + 1 if problem.time_weight > 0 and settings.start is None else 1):
        tries = settings if first is None else replace(settings, max_iterations=min(TRIES, settings.max_iterations))
        begin = solve(settled(problem, stated), tries, attentive=attentive, threads=threads, callback=callback)
        first = begin if first is None else first
        if attempt and not begin.success:
            break
        with budget.stop.reporting("smooth", attentive):
            near = find_duration(
                problem, begin.trajectory, tolerance=settings.final(problem),
                violation=settings.violation_tolerance(problem), most=settings.max_iterations, watch=watch,
            )  # fmt: skip
        cheaper = best is None or near[1].measures.cost < best[1].measures.cost
        if budget.stop.due or not near[1].solved or not cheaper:
            break
        best = near
        stated = max(SHORTER * best[0].steps * best[0].dt, problem.duration[0])
    assert first is not None
    if best is None:
        candidates = [first]
        if near is not None and np.isfinite(near[1].plan.states).all() and not budget.stop.due:
            ordinary, found = near
            start = Trajectory(found.plan.states, found.plan.controls, ordinary.dt)
            begun = replace(settings, start=start, starts=None)
            candidates.append(solve(ordinary, begun, attentive=attentive, callback=callback))
        chosen = min(candidates, key=lambda one: _rank_with_time(one, problem.time_weight))
        status = Status.TIME_LIMIT if budget.stop.due else Status.MAX_ITERATIONS
        detail = f"the best duration was not found, this is {chosen.trajectory.horizon:g} s; {chosen.detail}"
        iterations = (*first.iterations, *log, *(chosen.iterations if chosen is not first else ()))
        return budget.stop.finish(
            replace(chosen, status=status, detail=detail.removesuffix("; "), iterations=iterations)
        )
    ordinary, found = best
    m, n = first.trajectory.controls.shape[1], first.trajectory.states.shape[1]
    guess = InitialGuess(
        np.zeros((ordinary.steps, m, n)), found.plan.controls, None, None,
        f"a plan of {ordinary.steps * ordinary.dt:.6g} s", found=found, log=tuple(log),
    )  # fmt: skip
    settings = replace(settings, start=guess, starts=None)
    return budget.stop.finish(solve(ordinary, settings, attentive=attentive, callback=callback))


def _rank_with_time(solution: Solution, time_weight: float) -> tuple[float, float]:
    """The smaller, the better: the violation of a plan that failed, then the cost with that of its time."""
    missed = 0.0 if solution.success else solution.violation
    return missed, solution.cost + time_weight * solution.trajectory.horizon

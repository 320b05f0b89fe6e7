"""A free final time: the duration is an additional state, constant along the plan, with a free initial value.

The number of steps is fixed and their length varies: the dynamics are scaled by duration / stated duration, so that a
Runge-Kutta step over `dt` becomes a step over `share * dt`. The interior point finds states, controls and duration at
once. With the duration found, the problem is an ordinary one, and the plan is already at its optimum.

Where segments of the plan have free durations, too, that state may jump between them. The steps of the plan that is
found last differently, segment by segment. As many equal steps take its place, with the ends of the segments at the
nearest knots. That leaves gaps, which are closed with the duration held: while it is free, the interior point would
rather shorten the duration. The duration of the whole is found from there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array, free_name
from lqrsim.kernels.records import Motion
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.formulas import SymbolicConstraint, SymbolicCost
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Iteration, Status, Trajectory, joined
from lqrsim.solvers.budget import Budget, Laps, Stop
from lqrsim.solvers.multistart import Way, ways
from lqrsim.solvers.settings import InitialGuess, SmootherSettings, resampled, resolve
from lqrsim.solvers.stages import MEDIUM, STRONG, WEAK, Barrier, InteriorPoint, InteriorResult, Stages
from lqrsim.solvers.tree import ways_by_trees

# The added state, and the parameter to which it is relative; with underscores after them if the system has such names.
STATE, STATED = "duration", "stated_duration"
MOST = 300  # largest number of iterations
# Number of shorter durations that are tried, factor between them, and number of iterations for each.
SHORTENED, SHORTER, TRIES = 3, 0.9, 150
# A sketch with a free duration whose cost is this many times that of the best plan leads to no better one.
PROMISING = 1.1
# Durations from which ways are sketched, relative to the stated one, and whether they are free then: in turn until one
# leads to a plan, and one more, as that plan may be a poor one. The largest number of iterations of a sketch, its
# tolerance, that of constraints in their units, and that of what is worth going on from, violations and gaps.
SKETCHED = (1.0, True), (1.0, False), (1.5, True), (2.0, True), (0.25, True), (2.0, False)
SKETCH, ROUGH, KEPT, WORTH = 100, 1e-2, 1e-4, 1e-2
# Tolerance of the search for durations of segments: their ends go to whole knots, one in some hundred.
NEAR_SEGMENTS = 1e-4
# The duration that is held while gaps are closed, relative to that of the segments together; the interior point's
# beginning then, and its tolerance. Of plans for the race of 19 waypoints in 400 to 800 steps, 10 of 10 were put right;
# with `WEAK` 4 of 6, and with the duration of the segments 5 of 6.
LONGER, CLOSING, CLOSED = 1.01, Barrier(1e-3, 2e-3), 1e-3
PART_WAY = (1.0, 0.25)  # parts of the way to the duration at which a search has failed, from one of which it goes on
FINER = 0.3  # part of the tolerance for a plan that is not certified; where errors grow 1e9-fold, 0.1 is mere rounding
FELL = 1e-3  # relative decrease of cost, with the cost of time, for which a search that failed goes on


def solve_for_duration(
    problem: Problem, settings: SmootherSettings, solve: Callable[..., Solution], stop: Stop,
    begin: Solution | None = None,
) -> Solution:  # fmt: skip
    """Find the best duration, and finish the plan with that duration.

    Without a start from the caller, ways to the goal are sketched. Then comes the solution for the stated duration, in
    whose place a plan `begin` may be. From each of these the search goes to the best duration nearby. Where none led to
    a plan, trees grow. `solve` is for problems with a fixed duration, within the time of `stop`.
    """
    search = DurationSearch(problem, settings, solve, stop)
    alone = begin is None and settings.start is None and settings.safeguard
    if alone:
        search.follow_ways()
    search.go_on_from(begin)
    if alone:
        search.grow_trees()
    if settings.safeguard:
        search.try_longest()
    return search.solution()


class DurationSearch:
    """A search for the best duration, from one plan after another."""

    def __init__(
        self, problem: Problem, settings: SmootherSettings, solve: Callable[..., Solution], stop: Stop
    ) -> None:
        assert problem.duration is not None
        self._problem, self._settings, self._solve = problem, settings, solve
        self._method = settings.method(problem)
        self._range, self._stop = problem.duration, stop
        self._budget = Budget(settings.max_iterations, stop)
        # The cheapest optimum so far: the problem with its duration, and what the interior point found.
        self.best: tuple[Problem, InteriorResult] | None = None
        self.candidates = list[Candidate]()  # what was tried
        self._log = list[Iteration]()  # of the search that led to the best plan
        self._fixed, self._total = list[Solution](), 0

    def follow_ways(self) -> None:
        """Sketch the ways, and go on from the sketches that keep the constraints, the cheapest first."""
        problem, stop = self._problem, self._stop
        stated = problem._of_duration(problem.steps * problem.dt)
        with stop.not_counting():  # compiling
            stages = Stages(stated)
            free = with_duration_state(problem)
        routes, sketches, led = list(ways(stated, stages)), list[tuple[Candidate, bool]](), set[str]()
        spent = dict.fromkeys((way.name for way in routes), 0)
        for fraction, freed in SKETCHED:
            is_last = bool(sketches)
            for way in [way for way in routes if way.name not in led]:
                with stop.reporting("smooth"), stop.heeding():
                    draft = self._sketched(way, fraction, free if freed else None)
                    self._total += draft.iterations
                    spent[way.name] += draft.iterations
                    if np.isfinite(draft.cost):
                        led.add(way.name)
                        sketches.append((replace(draft, iterations=spent[way.name]), freed))
                if stop.due:
                    return
            if is_last:
                break
        failed = (way for way in routes if way.name not in led)
        self.candidates += (Candidate(way.name, np.inf, spent[way.name], None, way.over(stated)) for way in failed)
        for draft, freed in sorted(sketches, key=lambda pair: pair[0].cost):
            if stop.due:
                return
            if self.best is not None and freed and draft.cost > PROMISING * self.best[1].measures.cost:
                self.candidates.append(draft)
            else:
                self._follow(draft.start, draft.trajectory)

    def _sketched(self, way: Way, fraction: float, free: Problem | None) -> Candidate:
        """What a few iterations make of a way in a fraction of the stated duration; its cost is infinite if it is far
        from the constraints. The duration is fixed or, in a problem `with_duration_state`, free.
        """
        problem, price = self._problem, self._method.price
        duration = float(np.clip(fraction * problem.steps * problem.dt, *self._range))
        fixed = problem._of_duration(duration)
        begin, budget = way.over(fixed), Budget(SKETCH, self._stop)
        n, states, horizon = begin.states.shape[1], begin.states, begin.horizon
        with self._stop.not_counting():  # compiling
            stages = Stages.lent(free or fixed)
        prices = np.full(len(stages.owners), price)
        if free is not None:
            stages.free[n] = 1.0
            states = np.column_stack([states, np.full(len(states), horizon)])
            prices[stages.owners == len(problem.constraint_terms)] = np.inf  # the bounds of the duration
        point = InteriorPoint(stages, Motion(*map(in_c_order, (states, begin.controls))), STRONG, price=prices)
        result = point.run(
            tolerance=ROUGH, violation=KEPT, most=SKETCH, laps=Laps(budget), over=lambda *_: self._stop.due
        )
        stages.give_back()
        plan, measures = result.plan, result.measures
        name, cost = way.name, measures.cost
        if free is None:
            name, cost = f"{name}, {duration:g} s", cost + problem.time_weight * duration
        if not (measures.violation < WORTH and measures.gap < WORTH and np.isfinite(cost)):
            cost = np.inf
        elif free is not None:
            horizon = float(plan.states[0, n])
        plan = Trajectory(plan.states[:, :n], plan.controls, horizon / problem.steps)
        return Candidate(name, cost, len(budget.log), None, plan)

    def grow_trees(self) -> None:
        """Grow trees while no plan is known, and go on from the ways through them."""
        if self.best is not None or any(solution.success for solution in self._fixed):
            return
        for seed, way in ways_by_trees(self._problem, self._stop):
            self._follow(f"trees of short plans, seed {seed}, {way.horizon:.4g} s", way)
            if self.best is not None:
                return

    def try_longest(self) -> None:
        """Solve for the longest duration while no plan is known, and go on from there: the stated one may be too short.

        If no plan of that duration keeps the constraints, none of a shorter one is likely to.
        """
        if self.best is not None or any(solution.success for solution in self._fixed) or self._budget.over:
            return
        self._fixed.append(self._solved(self._problem._of_duration(self._range[1]), self._settings))
        if self._fixed[-1].success:
            self._refine(self._fixed[-1].trajectory, self._settings)

    def _follow(self, name: str, plan: Trajectory) -> None:
        before = self._total
        _, ordinary, result = self._find(plan, Budget(self._settings.max_iterations, self._stop))
        status = Status.CONVERGED if result.solved else Status.STALLED
        cost = result.measures.cost if np.isfinite(result.measures.cost) else np.inf
        self.candidates.append(Candidate(name, cost, self._total - before, status, result.trajectory(ordinary.dt)))

    def go_on_from(self, begin: Solution | None) -> None:
        """Go on from the solution for the stated duration; with a weight on time, also from those for shorter ones.

        A shorter duration may lead to another route. Where a way has led to a plan, the first attempts of the solver
        must do, for the others take long and are for problems of which no plan is known.
        """
        problem, settings = self._problem, self._settings
        if problem.segments and settings.start is not None:
            # A trajectory of the caller, as it is, may lead to a plan: its knots may be far from the best ends of
            # segments, so that a plan of the stated duration is hard to find.
            trajectory = resolve(settings.start, problem).trajectory
            if trajectory is not None and self._find(trajectory, self._budget)[0]:
                return
        by_ways, before = self.best, self._total
        if by_ways is not None:
            settings = replace(settings, safeguard=False)
        first = begin or self._solved(problem._of_duration(problem.steps * problem.dt), settings)
        self._fixed.append(first)
        shorter = SHORTENED if problem.time_weight > 0 and settings.start is None else 0
        tries = replace(settings, max_iterations=min(TRIES, settings.max_iterations))
        if by_ways is None or first.success:
            self._refine(first.trajectory, settings)
        while self.best is not None and shorter and not self._budget.over:
            shorter, plan = shorter - 1, self.best[0]
            less = self._solved(problem._of_duration(max(SHORTER * plan.steps * plan.dt, self._range[0])), tries)
            if not (less.success and not self._budget.over and self._find(less.trajectory, self._budget)[0]):
                break
        if self.candidates:
            status, cost, plan = first.status, self._rank(first)[1], first.trajectory
            if self.best is not by_ways and self.best is not None:
                ordinary, result = self.best
                status, cost = Status.CONVERGED, result.measures.cost
                plan = result.trajectory(ordinary.dt)
            name = f"the nominal control, {first.trajectory.horizon:g} s"
            self.candidates.append(Candidate(name, cost, self._total - before, status, plan))

    def _refine(self, begin: Trajectory, settings: SmootherSettings) -> None:
        """Find the best duration near a plan's.

        A search that ends elsewhere may only have ended far from the constraints. It goes on from a plan of the
        duration at which it ended or, if there is none, of one a part of the way there; as long as such plans become
        cheaper.
        """
        while not self._budget.over:
            _, ordinary, result = self._find(begin, self._budget)
            if result.solved or not np.isfinite(result.plan.states).all() or self._stop.due:
                return
            least, end = min(self._rank(solution) for solution in self._fixed), result.trajectory(ordinary.dt)
            for fraction in PART_WAY if least[0] == 0 else PART_WAY[:1]:
                dt = begin.dt + fraction * (end.dt - begin.dt)
                start = end if fraction == 1 else replace(begin, dt=dt)
                fixed = self._problem._of_duration(dt * self._problem.steps)
                again = self._solved(fixed, replace(settings, start=start, starts=None))
                self._fixed.append(again)
                missed, cost = self._rank(again)
                if again.success and (missed, cost + FELL * abs(cost)) < least:
                    break
            else:
                return
            begin = again.trajectory

    def _find(self, begin: Trajectory, budget: Budget, fraction: float = 1.0) -> tuple[bool, Problem, InteriorResult]:
        """Find the best duration near a plan's. Whether it is the cheapest so far, the problem with it, and the optimum
        or the last plan, whose cost includes the price of violations.

        The iterations join the log of the budget, which may end the search.
        """
        before, problem, tolerance = len(budget.log), self._problem, fraction * self._method.tolerance
        budget.report()
        with self._stop.reporting("smooth"):
            by_segment = self._with_timed_segments(begin, budget) if problem.segments else None
            held = by_segment is not None
            if by_segment is not None:
                problem, begin = by_segment
            stages, prices, result = self._searched(problem, begin, budget, tolerance=tolerance, hold=held)
        self._total += len(budget.log) - before
        n, cost = len(problem.dynamics.state_coordinates), result.measures.cost + _paid(stages, result.plan, prices)
        ordinary = problem._of_duration(float(np.clip(result.plan.states[0, n], *self._range)))
        # Remove everything that belongs to the duration.
        rows = result.sizes.rows[stages.owners != len(problem.constraint_terms)]
        result = replace(
            result, plan=Motion(in_c_order(result.plan.states[:, :n]), result.plan.controls),
            gain=in_c_order(result.gain[:, :, :n]), multipliers=result.multipliers[:-1],
            measures=result.measures._replace(cost=cost), sizes=result.sizes._replace(rows=rows),
        )  # fmt: skip
        cheaper = result.solved and (self.best is None or result.measures.cost < self.best[1].measures.cost)
        if cheaper:
            self.best, self._log = (ordinary, result), list(budget.log)
        return cheaper, ordinary, result

    def _searched(
        self, problem: Problem, begin: Trajectory, budget: Budget, *, tolerance: float, segments: Sequence[int] = (),
        hold: bool = False,
    ) -> tuple[Stages, Array, InteriorResult]:  # fmt: skip
        """The optimum near a plan with its duration as a state, which jumps where segments end; and the price of rows.

        With `hold`, the gaps of the plan are first closed with its duration, which must be that of the problem.
        """
        n, violation = len(problem.dynamics.state_coordinates), self._method.violation
        with self._stop.not_counting():  # compiling
            stages = Stages(with_duration_state(problem, by_segment=bool(segments)))
        stages.about.jumps[list(segments)] = 1.0  # the last state may jump there, each after the first
        laps = Laps(budget)
        states = np.column_stack([begin.states, np.full(len(begin.states), begin.horizon)])
        plan = Motion(in_c_order(states), in_c_order(begin.controls))
        # The bounds of the duration hold at any price.
        prices = np.where(stages.owners == len(problem.constraint_terms), np.inf, self._method.price)

        def run(
            plan: Motion, barrier: Barrier, tolerance: float, multipliers: tuple[Array, ...] = ()
        ) -> InteriorResult:
            point = InteriorPoint(stages, plan, barrier, price=prices, multipliers=multipliers)
            return point.run(
                tolerance=tolerance, violation=violation, most=min(MOST, budget.left), hurried=budget.hurried,
                laps=laps, over=lambda *_: self._stop.due,
            )  # fmt: skip

        held = None
        if hold:
            stages.free[n] = 0.0
            held = run(plan, CLOSING, CLOSED)
        stages.free[n] = 1.0
        if held is not None and held.solved:
            return stages, prices, run(held.plan, WEAK, tolerance, held.multipliers)
        return stages, prices, run(plan, MEDIUM, tolerance)

    def _with_timed_segments(self, begin: Trajectory, budget: Budget) -> tuple[Problem, Trajectory] | None:
        """The problem with its segments at the knots where they end in time, and a plan with these, in equal steps.

        The duration of both is a little longer than that of the segments together. None if no durations of the segments
        are found; whether they are the best does not matter here.
        """
        problem = self._problem
        _, _, result = self._searched(problem, begin, budget, tolerance=NEAR_SEGMENTS, segments=problem.segments)
        allowed, measures = self._method.violation, result.measures
        if not (result.solved or (measures.violation <= allowed and measures.gap < NEAR_SEGMENTS)):
            return None
        steps, old = problem.steps, np.array([0, *problem.segments, problem.steps])
        ends = np.cumsum([0.0, *result.plan.states[:-1, -1] / steps])  # times of the knots
        new = np.rint(ends[old] / ends[-1] * steps).astype(int)
        for k in range(1, len(new)):
            new[k] = max(new[k], new[k - 1] + 2)  # `Problem` wants two steps in a segment
        new[-1] = steps
        for k in range(len(new) - 2, 0, -1):
            new[k] = min(new[k], new[k + 1] - 2)
        at = np.interp(np.arange(steps + 1), new, old)
        plan = resampled(result.plan.states[:, :-1], result.plan.controls, at)
        dt = float(np.clip(LONGER * ends[-1], *self._range)) / steps
        return replace(problem._with_segments(new[1:-1].tolist()), dt=dt), Trajectory(*plan, dt)

    def _solved(self, fixed: Problem, settings: SmootherSettings) -> Solution:
        solution = self._solve(fixed, settings)
        if fixed.segments:
            knots = [*fixed.segments]  # a list, as it is in a file
            solution = replace(solution, options=dict(solution.options) | {"segments": knots})
        self._total += max(len(solution.iterations), sum(candidate.iterations for candidate in solution.candidates))
        return solution

    def _rank(self, solution: Solution) -> tuple[float, float]:
        """Sort key, best first: the violation of a failed plan, then the cost with prices of time and violations."""
        problem, plan, price = self._problem, solution.trajectory, self._method.price
        missed, paid = 0.0 if solution.success else solution.violation, 0.0
        if np.isfinite(price):
            stages = Stages(problem.with_duration_of(solution))
            paid = _paid(stages, Motion(in_c_order(plan.states), in_c_order(plan.controls)), price)
        return missed, solution.cost + problem.time_weight * plan.horizon + paid

    def solution(self) -> Solution:
        """The best plan, finished with its duration; or the best for a fixed duration, if none was found."""
        if self.best is not None:
            solution = self._held(*self.best)
            # Each row is within the tolerance; all together may not be, where Newton's method fails that would end it.
            again = Budget(self._settings.max_iterations, self._stop)
            if solution.status is Status.NOT_CERTIFIED and self._find(solution.trajectory, again, FINER)[0]:
                solution = self._held(*self.best)
            return self._described(solution)
        first, last, chosen = self._fixed[0], self._fixed[-1], min(self._fixed, key=self._rank)
        if last.status is Status.INFEASIBLE and not chosen.success and not self._stop.due:
            detail = f"even in {last.trajectory.horizon:g} s {last.detail}"
            return self._described(replace(last, detail=detail))
        status, remedy = Status.STALLED, "begin with another dt"
        if self._stop.due:
            status, remedy = Status.TIME_LIMIT, "raise time_limit"
        elif not self._budget.left or chosen.status is Status.MAX_ITERATIONS:
            status, remedy = Status.MAX_ITERATIONS, "raise max_iterations"
        detail = f"the best duration was not found, this plan takes {chosen.trajectory.horizon:g} s"
        log = (*first.iterations, *self._budget.log, *(chosen.iterations if chosen is not first else ()))
        self._total += len(self._budget.log)
        return self._described(replace(
            chosen, status=status, detail=joined(detail, chosen.detail), iterations=log,
            remedy=f"{remedy}; or begin with start=solution of a fixed duration (duration=None, time_weight=0)",
        ))  # fmt: skip

    def _held(self, ordinary: Problem, result: InteriorResult) -> Solution:
        """What becomes of a plan with its duration held. The log begins with that of the search for it."""
        summary, gain = f"a plan of {ordinary.steps * ordinary.dt:.6g} s", np.zeros_like(result.gain)
        guess = InitialGuess(gain, result.plan.controls, summary, interior=result, log=tuple(self._log))
        return self._solved(ordinary, replace(self._settings, starts=None, start=guess))

    def _described(self, solution: Solution) -> Solution:
        """The solution with the free duration among its options, in words, and with all that was tried."""
        (low, high), weight = self._range, self._problem.time_weight
        price = f", at a price of {weight:g} a second" if weight else ""
        effort = f"{self._total} iterations in all solves" if self._total > len(solution.iterations) else ""
        return replace(
            solution,
            options=dict(solution.options) | {"duration": f"{low:g} to {high:g} s{price}"},
            detail=joined(solution.detail, effort),
            candidates=(*self.candidates, *solution.candidates),
        )


def _paid(stages: Stages, plan: Motion, price: float | Array) -> float:
    """The price of all violations of a plan, at a price of each row (R,)."""
    prices, numbers = np.where(np.isfinite(price) & (stages.owners >= 0), price, 0.0), stages.values(plan)
    missed = np.where(stages.equality, np.abs(numbers), np.maximum(-numbers, 0.0))[stages.live]
    return float((np.broadcast_to(prices, numbers.shape)[stages.live] * missed).sum())


def with_duration_state(problem: Problem, *, by_segment: bool = False) -> Problem:
    """The problem with its duration as the last state; or with that of a plan of steps as long as the segment's."""
    assert problem.duration is not None
    dynamics, n = problem.dynamics, len(problem.dynamics.state_coordinates)
    stated, (low, high) = problem.steps * problem.dt, problem.duration
    start = problem.initial
    initial = start._extended(stated) if isinstance(start, FixedState) else start.with_added_state(dynamics)
    weight = problem.time_weight / (problem.steps if by_segment else 1)
    priced = SymbolicCost(lambda x, u, p: p.weight * x[n], parameters={"weight": weight}, convex=True)
    bounds = SymbolicConstraint(
        lambda x, u, p: [x[n] - p.low, p.high - x[n]], parameters={"low": low, "high": high},
        at="all" if by_segment else "final",
    )  # fmt: skip
    stage_cost, final_cost = (cost.with_added_state(dynamics) for cost in (problem.stage_cost, problem.final_cost))
    return Problem(
        dynamics=_scaled(dynamics, stated), dt=problem.dt, steps=problem.steps, initial=initial,
        stage_cost=stage_cost + priced if by_segment else stage_cost,
        final_cost=final_cost if by_segment else final_cost + priced, control_limits=problem.control_limits,
        constraints=(*(constraint.with_added_state(dynamics) for constraint in problem.constraints), bounds),
        begin=problem.begin,
    )  # fmt: skip


def _scaled(dynamics: Dynamics, stated: float) -> Dynamics:
    """The dynamics with the duration as last state; at the stated duration they are unchanged."""
    space, n = dynamics.state_coordinates, len(dynamics.state_coordinates)
    state, parameter = free_name(STATE, space.names), free_name(STATED, (*dynamics.parameters, *dynamics.disturbances))

    def f(x: Any, u: Any, p: Any) -> list[Any]:
        share = x[n] / getattr(p, parameter)
        return [*(share * rate for rate in dynamics.f(x[:n], u, p)), 0]

    coordinates = replace(space, names=(*space.names, state), units=(*space.units, "s"), low=(), high=())
    return dynamics._traced_anew(
        f=f, state_coordinates=coordinates, parameters=dynamics.parameters | {parameter: stated}
    )

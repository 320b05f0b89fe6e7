"""Which optimum: where `smooth` starts if nobody says where, and which of several starts it goes on with.

A continuation draws the first iteration along a smooth path from start to goal, blind to obstacles, and lets the
obstacles come in by and by; it ends in a good optimum far more often than a start from the nominal control does. Other
paths, bent to the sides, lead to other optima. Which start is best shows after a few iterations, long before it ends.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.kernels import declarations
from lqrsim.problem.costs import Cost, CostSum, ObstacleCost, QuadraticCost, terms_of
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.problem import Problem
from lqrsim.results.goal import TOLERANCE, Target
from lqrsim.results.solution_parts import Candidate, Status, Trajectory
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.budget import Callback
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.initial_guess import InitialGuess, InitialPrior, StartLike, resolve
from lqrsim.solvers.parallel import workers
from lqrsim.solvers.strategy import Known, finish, refine

# `python experiments/benchmark_quality.py --sections ingredients` shows what each of these choices brings.
STARTS = 7
SHARES = (0.0, 0.1, 0.4, 0.7)  # of the obstacle costs, in the first iterations
PULL = 0.1  # of the path, relative to the curvature of an obstacle's cost where it is touched
RING, STEP, WIDEST = 0.3, 0.2, 0.6  # how far paths bend, relative to the distance from start to goal
FOLD = 0.9  # the same of the states that move balls: an arm must be folded up before it passes what it hung over
HALVE, CHOOSE = 3, 4  # the iterations after which half of the starts are left, and one
# Where nothing that the controls do at rest leads anywhere, as for what swims: how often they sway along the plan, and
# how far, of what they may.
SWAYS, SWAY = (1, 2, 4, 8), 0.3
IDLE = 1e-6  # how far controls may be from the nominal ones to be none, relative to these and at least 1
# Where what these lead to is poor: how much heavier obstacles and goal are made to find another way.
HEAVIER = (10.0, 100.0)


def guides(problem: Problem, count: int | None) -> list[tuple[str, InitialPrior | None]]:
    """What to start from, each with what to call it: paths to the goal, the straight one first.

    Problems without obstacles, or without a place to start from and one to go to, have nothing to go round: there is
    one start, the nominal control. The paths are those of the position; of a robot of balls without one, those of the
    states that move its balls, as an arm's angles.

    Args:
      count: how many; by default `STARTS` where there are obstacles.
    """
    pull = _pull(problem)
    if pull == 0 or problem.start is None or problem.goal is None:
        return [("nominal control", None)]
    moving = _moving(problem)
    ends = problem.start[moving], problem.goal[moving]
    weight = np.zeros(len(problem.start))
    weight[moving] = pull
    found, unit = [], problem.dynamics.state_coordinates.units[moving[0]]
    ring = RING if problem.dynamics.state_coordinates.position else FOLD
    for name, bend in bends(ends[1] - ends[0], STARTS if count is None else count, ring=ring, unit=unit):
        about = np.zeros((problem.steps + 1, len(weight)))
        about[:, moving] = path(*ends, bend, problem.steps)
        found.append((name, InitialPrior(weight, about=about, obstacles=SHARES)))
    return found


def reweighted(problem: Problem, times: float) -> Problem:
    """The same with obstacles and goal that weigh more: it goes round and gets there, whatever the controls cost.

    Only numbers change, so nothing is compiled; the constraints are there, and are not made to act.
    """

    def heavier(cost: Cost) -> Cost:
        if isinstance(cost, ObstacleCost):
            return cost.weighing(times * cost.weight)
        return QuadraticCost(times * cost.weight, about=cost.about) if isinstance(cost, QuadraticCost) else cost

    stage = [heavier(cost) if isinstance(cost, ObstacleCost) else cost for cost in terms_of(problem.stage_cost)]
    final = [heavier(cost) for cost in terms_of(problem.final_cost)]
    return problem.with_costs(stage_cost=CostSum(tuple(stage)), final_cost=CostSum(tuple(final)))


def sinusoidal_controls(problem: Problem, cycles: int) -> Array:
    """Controls (T, m) that sway about the nominal ones so often, each a while after the one before it."""
    space, nominal = problem.control_coordinates, problem.nominal_control
    actuators = problem.dynamics.control_coordinates
    low, high = np.maximum(space.low, actuators.low), np.minimum(space.high, actuators.high)
    room = np.minimum(high - nominal, nominal - low)
    far = SWAY * np.where(np.isfinite(room), np.maximum(room, 0.0), 1.0)
    times = np.arange(problem.steps)[:, None] / problem.steps
    return nominal + far * np.sin(2 * np.pi * (cycles * times - np.arange(len(nominal)) / 4))


def check_starts(problem: Problem, count: int | None) -> None:
    """Raises InputError if more than one start is asked for where there is nothing to go round."""
    if count is not None and count > 1 and _pull(problem) == 0:
        raise InputError(
            f"starts: got {count}, want 1 without an ObstacleCost, a start and a goal some way apart: there is nothing"
            " to go round; or give a start"
        )


def _pull(problem: Problem) -> float:
    """The weight of the paths; 0 where there is nothing to go round."""
    moving = _moving(problem)
    if not moving or problem.start is None or problem.goal is None:
        return 0.0
    if np.array_equal(problem.start[moving], problem.goal[moving]):
        return 0.0
    costs = [cost for cost in problem.obstacle_costs if len(cost.world)]
    return max((PULL * cost.weight * cost.sharpness**2 for cost in costs), default=0.0)


def _moving(problem: Problem) -> list[int]:
    """The states that say where the robot is, by their indices: its position, or else what moves its balls."""
    position = list(problem.dynamics.state_coordinates.position)
    if position:
        return position
    pairs = zip(terms_of(problem.stage_cost), problem.terms("stage_cost"), strict=True)
    return sorted({i for cost, term in pairs if isinstance(cost, ObstacleCost) for i in term.nonconvex_in or ()})


def bends(way: Array, count: int, *, ring: float | None = None, unit: str = "m") -> list[tuple[str, Array]]:
    """How far the middle of each path is from that of the straight one, and a name: none, then to the sides.

    In space the others are a ring about the straight one, in the plane pairs to the left and the right; of more
    numbers, pairs along directions at right angles to it and to each other.

    Args:
      way: from start to goal, (k,). unit: of its numbers, for the names.
      ring: how far those in more than a plane bend, relative to the way; by default RING.
    """
    ring = RING if ring is None else ring
    distance = float(np.linalg.norm(way))
    straight: list[tuple[str, Array]] = [("straight", np.zeros(len(way)))]
    if count == 1 or len(way) == 1:
        return straight
    ahead, others = way / distance, count - 1
    if len(way) == 2:
        left, step = np.array([-ahead[1], ahead[0]]), min(STEP, WIDEST / ((others + 1) // 2))
        sides = [((i // 2 + 1) * step, i % 2) for i in range(others)]
        return straight + [
            (f"{far * distance:.3g} {unit} to the {('left', 'right')[side]}", far * distance * (1 - 2 * side) * left)
            for far, side in sides
        ]
    if len(way) > 3:
        aside = np.linalg.qr(np.column_stack([ahead, np.eye(len(way))[:, np.argsort(np.abs(ahead))[:-1]]]))[0][:, 1:]
        far = ring * distance
        named = [
            (f"{far:.3g} {unit} aside, direction {sign}{side + 1}", factor * far * aside[:, side])
            for side in range(len(way) - 1)
            for sign, factor in (("", 1), ("-", -1))
        ]
        return straight + named[:others]
    across = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    across /= np.linalg.norm(across)
    upright = np.cross(ahead, across)
    angles = 2 * np.pi * np.arange(others) / others
    return straight + [
        (
            f"{ring * distance:.3g} {unit} aside at {np.degrees(angle):.0f} degrees",
            ring * distance * (np.cos(angle) * across + np.sin(angle) * upright),
        )
        for angle in angles
    ]


def path(start: Array, goal: Array, bend: Array, steps: int) -> Array:
    """Positions (T+1, 2 or 3): from rest to rest with the least jerk, and aside by a sine."""
    time = np.linspace(0, 1, steps + 1)[:, None]
    way = time**3 * (10 - 15 * time + 6 * time**2)
    return start + way * (goal - start) + np.sin(np.pi * way) * bend


class Search:
    """Several runs, a few iterations each, and the most promising to its end.

    Attributes:
      best: the run that found the best so far, and what it found.
    """

    def __init__(self, names: Sequence[str], runs: Sequence[SolveRun], callback: Callback | None, threads: int) -> None:
        self._named = list(zip(names, runs, strict=True))
        self._callback, self._threads, self._known = callback, threads, Known()
        self._problem, self._settings = runs[0].problem, runs[0].settings
        self._start, self._budget = runs[0].work.start.copy(), runs[0].budget
        self._finished: list[tuple[SolveRun, RunResult]] = []

    @property
    def best(self) -> tuple[SolveRun, RunResult]:
        return self._finished[0]

    def run(self) -> None:
        """Choose one and finish it; with constraints, others too, as long as they could do better."""
        chosen, *others = choose([run for _, run in self._named], self._threads)
        self._finish(chosen)
        if not chosen.problem.constraints:
            return
        # Constraints can make the best way round the worst, or close it. What the others cost without them is about the
        # least that they can cost with them.
        for run in sorted(others, key=lambda run: run.cost):
            best = self.best[1]
            if self._budget.stop.due or best.final or (best.success and not run.cost < best.cost):
                break
            self._finish(run)

    @property
    def is_unacceptable(self) -> bool:
        """Whether the best plan so far is one that nobody would want: far from the goal, or through an obstacle.

        Far is further than the robot's radius, or, without a position, than what counts as reached; through is deeper
        than half of the radius, or of that of the largest ball.
        """
        problem = self._problem
        space = problem.dynamics.state_coordinates
        if _pull(problem) == 0 or problem.goal is None:
            return self._idle() or self._stuck
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
        """Whether what was found is to do nothing: at rest no control helps by itself, and some may together."""
        found, nominal = self.best[1], self._problem.nominal_control
        off = np.abs(found.controls - nominal).max()
        return found.success and found.cost > 0 and off <= IDLE * max(1.0, np.abs(nominal).max())

    @property
    def says_infeasible(self) -> bool:
        """Whether the best is that constraints contradict each other, by evidence that other starts may disprove."""
        return self._stuck and self.best[1].status is Status.INFEASIBLE

    @property
    def _stuck(self) -> bool:
        """Whether a violation is stationary somewhere, and no plan was found."""
        return bool(self._known.evidence) and not self.best[1].success

    def widen(self) -> None:
        """Look for another way round, or, where there is nothing to go round, for controls that lead anywhere."""
        if self._stuck and _pull(self._problem) == 0:
            self._try_elsewhere()
        elif _pull(self._problem) == 0:
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
        # Even one that is not at its end is better than to do nothing.
        better = found.violation <= best.violation and found.cost < best.cost
        self._finished.insert(0 if better else len(self._finished), (chosen, found))

    def _try_elsewhere(self) -> None:
        """From other starts, until one leads to a plan: before constraints are said to contradict each other."""
        problem = self._problem
        starts: dict[str, StartLike] = {
            f"controls that sway {cycles} times": sinusoidal_controls(problem, cycles) for cycles in SWAYS[:2]
        }
        place, begin, goal = list(problem.dynamics.state_coordinates.position), problem.start, problem.goal
        if place and begin is not None and goal is not None and (goal != begin)[place].any():
            for name, bend in bends((goal - begin)[place], 3)[1:]:
                states = path(begin, goal, np.zeros(len(begin)), problem.steps)
                states[:, place] = path(begin[place], goal[place], bend, problem.steps)
                controls = np.tile(problem.nominal_control, (problem.steps, 1))
                starts[f"a path {name}"] = Trajectory(states, controls, problem.dt)
        for name, one in starts.items():
            if self._budget.stop.due or self.best[1].success:
                return
            run = self._another(resolve(one, problem))
            self._named.append((name, run))
            self._known.from_start = False
            self._finish(run)

    def _try_reweighted(self, times: float) -> None:
        """Of plans for heavier obstacles, go on from the best by steps that lower the true cost alone."""
        if self._budget.stop.due:
            return
        heavier = reweighted(self._problem, times)
        runs = [self._another(resolve(guide, heavier), heavier) for _, guide in guides(heavier, None)]
        try:
            boldest = choose(runs, self._threads)[0].solve()
        except InputError:  # its cost is not finite at the start, though the true one is
            return
        if self._budget.stop.due:
            return
        summary = f"a plan for {times:g} times the weight of obstacles and goal"
        run = self._another(InitialGuess(boldest.law[0].copy(), boldest.law[1].copy(), None, None, summary))
        self._named.append((summary, run))
        found, best = self._to_its_end(run, refine, self._known), self.best[1]
        # The same optimum once more, a little different within the tolerances, is no other way.
        other = found.rank < best.rank and (not best.success or found.cost < best.cost - 1e-3 * abs(best.cost))
        self._finished.insert(0 if other else len(self._finished), (run, found))

    def retry_without_risk(self) -> None:
        """Where the risk was too high on the way: search without a risk, and go on from that plan."""
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
        """What was tried, where it was more than one."""
        results = {id(run): found for run, found in self._finished}
        found = [run.candidate(name, results.get(id(run))) for name, run in self._named]
        return tuple(found) if len(found) > 1 else ()

    def _another(self, initial_guess: InitialGuess, problem: Problem | None = None) -> SolveRun:
        problem = self._problem if problem is None else problem
        return SolveRun(problem, self._settings, initial_guess, self._start, self._budget.another())

    def _finish(self, run: SolveRun) -> None:
        self._finished.append((run, self._to_its_end(run, finish, self._known)))
        self._finished.sort(key=lambda pair: pair[1].rank)  # a stable sort: of equals, the first

    def _to_its_end(self, run: SolveRun, how: Callable[[SolveRun, Known], RunResult], known: Known) -> RunResult:
        """Run to the end; report all its iterations to the callback, also those before."""
        run.budget.report_to(self._callback)
        return how(run, known)


def choose(runs: Sequence[SolveRun], threads: int) -> list[SolveRun]:
    """Run each a few iterations, the worse ones fewer, and return them with the most promising first.

    What they are judged by is the true cost of the plan that each has so far.
    """
    left, dropped = list(runs), []
    for last, keep in ((HALVE, max(len(left) // 2, 1)), (CHOOSE, 1)):
        if len(left) > 1:
            if threads > 1:
                with workers(threads, functions_of(left[0].problem)) as pool:
                    list(pool.map(lambda run, last=last: run.smooth(last), left))
            else:
                for run in left:
                    run.smooth(last)
            left.sort(key=lambda run: run.cost)  # a stable sort: of equals, the first
            left, dropped = left[:keep], left[keep:] + dropped
    return left + dropped

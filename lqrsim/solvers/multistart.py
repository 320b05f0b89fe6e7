"""Which optimum: where `smooth` starts if nobody says where, and which of several starts it goes on with.

A continuation draws the first iteration along a smooth path from start to goal, blind to obstacles, and lets the
obstacles come in by and by; it ends in a good optimum far more often than a start from the nominal control does. Other
paths, bent to the sides, lead to other optima. Which start is best shows after a few iterations, long before it ends.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.kernels import declarations
from lqrsim.problem.costs import Cost, CostSum, ObstacleCost, QuadraticCost, terms_of
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.problem import Problem
from lqrsim.results.goal import TOLERANCE, Target
from lqrsim.results.solution_parts import Candidate, Trajectory
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.attempt import Attempt, AttemptResult
from lqrsim.solvers.common import Callback, SmootherSettings, Stop, workers
from lqrsim.solvers.initial_guess import InitialGuess, InitialPrior, StartLike, resolve
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
BOLD = (10.0, 100.0)


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


def bold(problem: Problem, times: float) -> Problem:
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


def swayed(problem: Problem, cycles: int) -> Array:
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
    """Several attempts, run a few iterations each, and the most promising to their end.

    Attributes:
      best: the attempt that found the best so far, and what it found.
    """

    def __init__(self, names: Sequence[str], attempts: Sequence[Attempt], *, each: bool, callback: Callback | None):
        self._named = list(zip(names, attempts, strict=True))
        self._each, self._callback, self._known = each, callback, Known()
        self._finished: list[tuple[Attempt, AttemptResult]] = []

    @property
    def best(self) -> tuple[Attempt, AttemptResult]:
        return self._finished[0]

    def run(self, threads: int) -> None:
        """Choose one and finish it; with constraints, others too, as long as they could do better."""
        chosen, *others = choose([attempt for _, attempt in self._named], self._advance, threads)
        self._finish(chosen)
        if chosen.problem.constraints:
            # Constraints can make the best way round the worst, or close it. What the others cost without them is about
            # the least that they can cost with them.
            for attempt in sorted(others, key=lambda attempt: attempt.cost):
                best = self.best[1]
                if attempt.stop.due or best.final or (best.success and not attempt.cost < best.cost):
                    break
                self._finish(attempt)

    def poor(self, problem: Problem) -> bool:
        """Whether the best plan so far is one that nobody would want: far from the goal, or through an obstacle.

        Far is further than the robot's radius, or, without a position, than what counts as reached; through is deeper
        than half of the radius, or of that of the largest ball.
        """
        space = problem.dynamics.state_coordinates
        if _pull(problem) == 0 or problem.goal is None:
            return self._idle(problem) or self._stuck
        (attempt, found), radius = self.best, max(cost.radius for cost in problem.obstacle_costs)
        if not found.success:
            return attempt.iterations_left(found.iterations) > 0
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

    def _idle(self, problem: Problem) -> bool:
        """Whether what was found is to do nothing: at rest no control helps by itself, and some may together."""
        found, nominal = self.best[1], problem.nominal_control
        off = np.abs(found.controls - nominal).max()
        return found.success and found.cost > 0 and off <= IDLE * max(1.0, np.abs(nominal).max())

    @property
    def _stuck(self) -> bool:
        """Whether what is missed is stationary somewhere, and nothing else was found."""
        return bool(self._known.evidence) and not self.best[1].success

    def widen(self, problem: Problem, settings: SmootherSettings, start: Array, stop: Stop, threads: int) -> None:
        """Look for another way round: of bold plans, go on from the best by steps that lower the true cost alone."""
        if self._stuck and _pull(problem) == 0:
            self._elsewhere(problem, settings, start, stop)
            return
        if _pull(problem) == 0:
            controls = [swayed(problem, cycles) for cycles in SWAYS]
            attempts = [Attempt(problem, settings, resolve(one, problem), start, stop) for one in controls]
            named = dict(zip(map(id, attempts), SWAYS, strict=True))
            chosen = choose(attempts, self._advance, threads)[0]
            self._named.append((f"controls that sway {named[id(chosen)]} times", chosen))
            found, best = finish(chosen, each=self._each, callback=self._callback), self.best[1]
            # Even one that is not at its end is better than to do nothing.
            better = found.violation <= best.violation and found.cost < best.cost
            self._finished.insert(0 if better else len(self._finished), (chosen, found))
            return
        for times in BOLD:
            harder = bold(problem, times)
            attempts = [
                Attempt(harder, settings, resolve(guide, harder), start, stop) for _, guide in guides(harder, None)
            ]
            boldest = choose(attempts, self._advance, threads)[0].finish(each=False)
            if stop.due:
                break
            initial_guess = InitialGuess(
                boldest.law[0].copy(), boldest.law[1].copy(), None, None, f"a plan {times:g} times as bold"
            )
            attempt = Attempt(problem, settings, initial_guess, start, stop)
            self._named.append((f"a plan for {times:g} times the weight of obstacles and goal", attempt))
            found = refine(attempt, each=self._each, callback=self._callback, known=self._known)
            best = self.best[1]
            # The same optimum once more, a little different within the tolerances, is no other way.
            other = found.rank < best.rank and (not best.success or found.cost < best.cost - 1e-3 * abs(best.cost))
            self._finished.insert(0 if other else len(self._finished), (attempt, found))

    def _elsewhere(self, problem: Problem, settings: SmootherSettings, start: Array, stop: Stop) -> None:
        """From other starts, until one leads to a plan: before constraints are said to contradict each other."""
        starts: dict[str, StartLike] = {f"controls that sway {n} times": swayed(problem, n) for n in SWAYS[:2]}
        place = list(problem.dynamics.state_coordinates.position)
        if place and problem.goal is not None and problem.start is not None:
            ends = problem.start, problem.goal
            for name, bend in bends((ends[1] - ends[0])[place], 3)[1:]:
                states = path(*ends, np.zeros(len(start)), problem.steps)
                states[:, place] = path(ends[0][place], ends[1][place], bend, problem.steps)
                controls = np.tile(problem.nominal_control, (problem.steps, 1))
                starts[f"a path {name}"] = Trajectory(states, controls, problem.dt)
        for name, one in starts.items():
            if stop.due or self.best[1].success:
                break
            attempt = Attempt(problem, settings, resolve(one, problem), start, stop)
            self._named.append((name, attempt))
            known = dataclasses.replace(self._known, from_start=False)
            found = finish(attempt, each=self._each, callback=self._callback, known=known)
            self._finished.append((attempt, found))
            self._finished.sort(key=lambda pair: pair[1].rank)

    def calm(self, problem: Problem, settings: SmootherSettings, start: Array, stop: Stop, threads: int) -> None:
        """Where the risk was too high on the way: search without a risk, and go on from that plan."""
        if all(attempt.termination.outcome != declarations.RISK_TOO_HIGH for _, attempt in self._named):
            return
        calm = dataclasses.replace(problem, risk=0.0)
        attempts = [Attempt(calm, settings, attempt.initial_guess, start, stop) for _, attempt in self._named]
        found = finish(choose(attempts, self._advance, threads)[0], each=self._each)
        if not found.success or stop.due:
            return
        summary = "a plan without a risk"
        initial_guess = InitialGuess(
            found.law[0].copy(), found.law[1].copy(), found.values["cost_to_go"], None, summary,
            multipliers=found.multipliers,
        )  # fmt: skip
        attempt = Attempt(problem, settings, initial_guess, start, stop)
        self._named.append((summary, attempt))
        self._finished.append((attempt, finish(attempt, each=self._each, callback=self._callback)))
        self._finished.sort(key=lambda pair: pair[1].rank)

    def candidates(self) -> tuple[Candidate, ...]:
        """What was tried, where it was more than one."""
        results = {id(attempt): found for attempt, found in self._finished}
        found = [attempt.candidate(name, results.get(id(attempt))) for name, attempt in self._named]
        return tuple(found) if len(found) > 1 else ()

    def _advance(self, attempt: Attempt, *, last: int) -> None:
        attempt.run(last, each=self._each)

    def _finish(self, attempt: Attempt) -> None:
        if self._callback is not None:
            for iteration in attempt.termination.iterations:
                try:
                    self._callback(iteration)
                except BaseException as error:
                    attempt.stop.error = error
                    break
        found = finish(attempt, each=self._each, callback=self._callback, known=self._known)
        self._finished.append((attempt, found))
        self._finished.sort(key=lambda pair: pair[1].rank)  # a stable sort: of equals, the first


def choose(attempts: Sequence[Attempt], advance: Callable[..., None], threads: int) -> list[Attempt]:
    """Run the attempts a few iterations, the worse ones fewer, and return them with the most promising first.

    What they are judged by is the true cost of the plan that each has so far.

    Args:
      advance: `advance(attempt, last=...)` runs one up to so many iterations. threads: how many at once.
    """
    left, dropped = list(attempts), []
    for last, keep in ((HALVE, max(len(left) // 2, 1)), (CHOOSE, 1)):
        if len(left) > 1:
            if threads > 1:
                with workers(threads, functions_of(left[0].problem)) as pool:
                    list(pool.map(partial(advance, last=last), left))
            else:
                for attempt in left:
                    advance(attempt, last=last)
            left.sort(key=lambda attempt: attempt.cost)  # a stable sort: of equals, the first
            left, dropped = left[:keep], left[keep:] + dropped
    return left + dropped

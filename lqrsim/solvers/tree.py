"""Trees of short plans from start and goal, for problems that no single path solves: LQR smoothing as a local planner.

It is the use that the paper's conclusion has in mind. A tree grows from the start, and another, backwards in time, from
the goal. Each draws a state, extends the node that is nearest to it by a short plan of LQR smoothing, and keeps what is
free of violations. Then the other tree is extended towards the new node. Where they meet, the way through both is a
start for the whole problem: feasible but for a small jump, and far from optimal.

The cost-to-come of a node says how near a state is. Smoothing computes it for all steps at once: the least cost of time
and controls with which the linearised system is in a state at that step. So it knows that a robot falls, or drifts.

    J.J. Kuffner, S.M. LaValle. RRT-Connect. ICRA 2000.
    A. Perez, R. Platt, G. Konidaris, L. Kaelbling, T. Lozano-Perez. LQR-RRT*. ICRA 2012.
"""

import itertools
from collections.abc import Iterator
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import CostToCome, Motion
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.problem.quadratic_cost import ControlCost, QuadraticCost
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers.budget import Budget, Stop
from lqrsim.solvers.engine import SolveRun
from lqrsim.solvers.multistart import passable
from lqrsim.solvers.settings import InitialGuess, SmootherSettings, resampled
from lqrsim.solvers.stages import Stages

EXTENSIONS = 4000  # of a pair of trees: some 3 s in a bugtrap, so that a time limit has room for several pairs
LONGEST = (12, 25)  # steps of an extension, for seeds in turn: unicycles leave traps with 12, and quadrotors with 25
ARRIVALS = 5  # steps at which an extension may arrive at its target, evenly spread
ITERATIONS = 3  # of smoothing for an extension; with six, no more problems are solved
NEAR = 0.1  # how far an extension may end from its target, at a cost of 1/2, relative to half the ranges
TOWARDS = 0.1  # share of the targets that are the other tree's root
HELD_BACK = 0.5  # share that is kept of an extension that ends in a violation: nodes beside walls lead nowhere
WORN = 3.0  # cost that is added to a node from which an extension failed, as that of so many steps
DRAWS = 100  # largest number of states that are drawn until one violates nothing
TOLERANCE = 1e-6  # of violations, that of a solve


def ways_by_trees(problem: Problem, stop: Stop) -> Iterator[tuple[int, Trajectory]]:
    """Ways from start to goal through one pair of trees after another, in `in_steps_of` the problem, and their seeds.

    They end with the time. Without a time limit there are none: trees know of no end, and a problem that cannot be
    solved would be told ten times as late. Nor are there any where trees cannot grow, where nothing is in the way, or
    where start or goal violates what is.
    """
    ends = _ends(problem)
    if ends is None or not any(passable(problem)) or np.isinf(stop.deadline) or stop.due:
        return
    with stop.not_counting():  # compiling
        planner = LocalPlanner(problem, *ends, min(LONGEST))
    if not all(planner.free_until(end[None]) for end in ends):
        return
    for seed in itertools.count():
        way = None
        with stop.reporting("smooth"), stop.heeding():
            way = grow(problem, seed=seed, stop=stop)
        if stop.due:
            return
        if way is not None:
            yield seed, in_steps_of(problem, way)


def grow(problem: Problem, *, seed: int, extensions: int = EXTENSIONS, stop: Stop | None = None) -> Trajectory | None:
    """A way from start to goal through trees, in steps of the problem's dt; None if none was found.

    Its states follow the dynamics, those of the second part to the accuracy of Runge-Kutta steps backwards, but for a
    jump between the trees: in the root mean square of the states, it is below `NEAR` of half their ranges.
    Inequalities of states alone hold at the knots and in the middles between them. It takes as many steps as it takes;
    `in_steps_of` turns it into a start for the problem. The same seed leads to the same way.

    Args:
      problem: one with a start and a goal, whose dynamics run backwards and whose constraints stand still. States
        without a goal are to end as they begin.
      extensions: the largest number, of both trees.
    """
    ends = _ends(problem)
    if ends is None:
        return None
    start, goal = ends
    planner, draws = LocalPlanner(problem, start, goal, LONGEST[seed % len(LONGEST)]), np.random.default_rng(seed)
    turn = np.zeros(len(goal))
    for constraint in problem.constraints:
        turn[list(constraint._turning_states(problem.dynamics))] = 2 * np.pi
    goals = np.unique([goal, goal + turn, goal - turn], axis=0)
    trees = Tree(planner, start[None], 1, extensions), Tree(planner, goals, -1, extensions)
    for count in range(0, extensions, 2):
        if stop is not None and stop.due:
            return None
        tree, other = trees if count % 4 == 0 else trees[::-1]
        root = other.states[draws.integers(other.roots)]
        node = tree.extend(root if draws.random() < TOWARDS else planner.draw(draws))
        met = None if node is None else other.extend(tree.states[node])
        if node is not None and met is not None and planner.is_near(tree.states[node], other.states[met]):
            forwards, backwards = (node, met) if tree is trees[0] else (met, node)
            return _joined(list(trees[0].branch(forwards)), list(trees[1].branch(backwards)), problem.dt)
    return None


def _ends(problem: Problem) -> tuple[Array, Array] | None:
    """Start and goal between which trees can grow; None if the problem has none, or none that they can."""
    start, goal = problem.start, problem.weighed_goal
    if problem.dynamics.discrete or problem.moving or start is None or goal is None:
        return None
    return start, np.where(np.isnan(goal), start, goal)


def in_steps_of(problem: Problem, way: Trajectory) -> Trajectory:
    """A way in as many steps as a problem has, as a start for it.

    With a free duration it takes as long as before, as far as that is allowed; else it is stretched to the horizon.
    """
    steps = problem.steps
    plan = resampled(way.states, way.controls, np.linspace(0, len(way.controls), steps + 1))
    duration = problem.dt * steps if problem.duration is None else float(np.clip(way.horizon, *problem.duration))
    return Trajectory(*plan, duration / steps)


class Reach(NamedTuple):
    """Where a node leads, for each number of steps: costs `constant + 1/2 |root x - mean|^2` to be near states x."""

    root: Array  # (ARRIVALS, n, n)
    mean: Array
    constant: Array  # (ARRIVALS,)


class LocalPlanner:
    """Short plans of LQR smoothing from state to state, in one of the numbers of steps `arrivals`.

    A step costs 1, and another 1/2 for each control that is at the end of its range.
    """

    def __init__(self, problem: Problem, start: Array, goal: Array, longest: int) -> None:
        space, controls, n = problem.dynamics.state_coordinates, problem.control_coordinates, len(start)
        self.arrivals = np.unique(np.ceil(np.linspace(0, min(longest, problem.steps), ARRIVALS + 1)[1:]).astype(int))
        self.controls = len(controls)
        pairs = zip(problem.constraints, problem.constraint_terms, strict=True)
        still = [part for part, term in pairs if not (term.final_only or term.uses_control or term.equality)]
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        for constraint in still:
            for i, (least, most) in constraint.state_bounds(problem.dynamics).items():
                low[i], high[i] = max(low[i], np.max(least)), min(high[i], np.min(most))
        half = (np.array(controls.high) - controls.low) / 2
        effort = ControlCost(1 / np.where(np.isfinite(half), half, 1.0) ** 2, about=problem.nominal_control)
        free = problem._with(
            initial=FixedState(start), duration=None, time_weight=0.0, segments=(), noise=None, noise_term=None,
            risk=0.0, control_rate=None, accuracy=None, between_knots=False,
        ).with_constraints([])  # fmt: skip
        self._free = free.with_costs(stage_cost=effort, final_cost=QuadraticCost(np.ones(n), about=goal))
        self._settings, self._stop = SmootherSettings(finish=None), Stop()
        knots = 2 * int(self.arrivals[-1]) + 2  # those of a plan and the middles between them, and the ends
        self._stages = Stages(free._with(steps=knots).with_constraints(still))
        # The ranges of states: bounds, the region of the ends, any angle, or else what is reached from the start.
        place = list(space.position)
        size = np.sqrt(np.diagonal(self._come(start, 1)[0], axis1=1, axis2=2).max(axis=0))
        size[[i for i, unit in enumerate(space.units) if unit == "rad"]] = np.pi
        size[place] = np.abs(goal - start)[place].max(initial=0.0) or size[place]
        self._low = np.where(np.isfinite(low), low, np.minimum(start, goal) - size)
        self._high = np.where(np.isfinite(high), high, np.maximum(start, goal) + size)
        self._spread = NEAR * np.maximum(self._high - self._low, 1e-9) / 2

    def draw(self, draws: np.random.Generator) -> Array:
        """A state within the ranges, (n,), that violates nothing, if one is found."""
        state = draws.uniform(self._low, self._high)
        for _ in range(DRAWS):
            if self.free_until(state[None]):
                break
            state = draws.uniform(self._low, self._high)
        return state

    def is_near(self, state: Array, other: Array) -> bool:
        """Whether a jump from a state to another is small, and leads through nothing."""
        between = np.linspace(state, other, int(self.arrivals[-1]))
        return bool(np.mean(((state - other) / self._spread) ** 2) < 1) and self.free_until(between) == len(between)

    def reach(self, state: Array, sign: int) -> Reach | None:
        """Where plans from a state lead, forwards or backwards in time; None where that is infinite or singular."""
        covariance, mean, constant = (part[self.arrivals] for part in self._come(state, sign))
        if not all(np.isfinite(part).all() for part in (covariance, mean, constant)):
            return None
        try:
            root = np.linalg.inv(np.linalg.cholesky(covariance + np.diag(self._spread**2)))
        except np.linalg.LinAlgError:
            return None
        return Reach(root, (root @ mean[..., None])[..., 0], constant + self.arrivals)

    def plan(self, state: Array, target: Array, sign: int, steps: int) -> Motion:
        """A plan from a state towards a target, forwards or backwards in time; empty if it is not finite."""
        plan, _ = self._smoothed(state, sign, steps, ITERATIONS, target)
        return plan if np.isfinite(plan.states).all() else Motion(plan.states[:0], plan.controls[:0])

    def free_until(self, states: Array) -> int:
        """The number of first states (K, n) up to which nothing is violated, there and in the middles between."""
        between = np.empty((2 * len(states) - 1, states.shape[1]))
        between[::2], between[1::2] = states, (states[1:] + states[:-1]) / 2
        knots = np.tile(states[0], (self._stages.steps + 1, 1))
        knots[1 : 1 + len(between)] = between
        controls = np.zeros((self._stages.steps, self.controls))
        values = self._stages.values(Motion(knots, controls))[1 : 1 + len(between), self._stages.owners >= 0]
        bad = ~(values >= -TOLERANCE).all(axis=1)
        return (int(np.argmax(bad)) + 1) // 2 if bad.any() else len(states)

    def _come(self, state: Array, sign: int) -> CostToCome:
        """The cost-to-come about the nominal control, at up to as many steps as an extension may take."""
        return self._smoothed(state, sign, int(self.arrivals[-1]), 1, None)[1]

    def _smoothed(
        self, state: Array, sign: int, steps: int, iterations: int, target: Array | None
    ) -> tuple[Motion, CostToCome]:
        """The plan and the cost-to-come after so many iterations."""
        problem = self._free._with(steps=steps, dt=sign * self._free.dt)
        if target is not None:
            problem = problem.with_costs(final_cost=QuadraticCost(self._spread**-2.0, about=target))
        offset = np.tile(problem.nominal_control, (steps, 1))
        guess = InitialGuess(np.zeros((*offset.shape, len(state))), offset)
        run = SolveRun(problem, self._settings, guess, state, Budget(iterations, self._stop))
        run.smooth(iterations)
        results = deepcopy((run.work.last, run.work.arrays.to_come))  # before another run overwrites them
        run.give_back()
        return results


class Tree:
    """States (N, n) that plans reach from roots (R, n), forwards in time or, by a sign of -1, backwards."""

    def __init__(self, planner: LocalPlanner, roots: Array, sign: int, most: int) -> None:
        self._planner, self._sign, n = planner, sign, roots.shape[1]
        size, counts = most + len(roots), len(planner.arrivals)
        self._states, self._worn = np.empty((size, n)), np.zeros((size, 1))
        self._reach = Reach(np.empty((size, counts, n, n)), np.empty((size, counts, n)), np.empty((size, counts)))
        self._from = list[tuple[int, Motion]]()
        for root in roots:
            self._add(root, -1, Motion(root[None], np.empty((0, planner.controls))))
        self.roots = len(self._from)

    @property
    def states(self) -> Array:
        return self._states[: len(self._from)]

    def extend(self, target: Array) -> int | None:
        """Plan from the node nearest to a target (n,); return the new node, or None if there is no way ahead."""
        count, n = len(self._from), len(target)
        if not count:
            return None
        root, mean, constant = (part[:count] for part in self._reach)
        deviations = (root.reshape(-1, n) @ target).reshape(mean.shape) - mean
        costs = constant + np.square(deviations).sum(axis=-1) / 2 + self._worn[:count]
        node, arrival = np.unravel_index(int(np.argmin(costs)), costs.shape)
        steps = int(self._planner.arrivals[arrival])
        plan = self._planner.plan(self._states[node], target, self._sign, steps)
        free = self._planner.free_until(plan.states) if len(plan.states) else 0
        if free <= steps:
            free = int(np.ceil(HELD_BACK * free))
        free_plan = Motion(plan.states[:free], plan.controls[: max(free - 1, 0)])
        if free < 2 or not self._add(free_plan.states[-1], int(node), free_plan):
            self._worn[node] += WORN
            return None
        return len(self._from) - 1

    def branch(self, node: int) -> Iterator[Motion]:
        """The plans that lead to a node, the last first."""
        while node >= 0:
            node, plan = self._from[node]
            yield plan

    def _add(self, state: Array, origin: int, plan: Motion) -> bool:
        reach, count = self._planner.reach(state, self._sign), len(self._from)
        if reach is None or count == len(self._states):
            return False
        self._states[count] = state
        for part, numbers in zip(self._reach, reach, strict=True):
            part[count] = numbers
        self._from.append((origin, plan))
        return True


def _joined(forwards: list[Motion], backwards: list[Motion], dt: float) -> Trajectory:
    """The way along a branch of the first tree and back along one of the other, both the last plan first.

    Where they meet, the state is that of the other tree.
    """
    plans = [*forwards[::-1], *(Motion(plan.states[::-1], plan.controls[::-1]) for plan in backwards)]
    states = np.concatenate([*(plan.states[:-1] for plan in plans[:-1]), plans[-1].states[-1:]])
    return Trajectory(in_c_order(states), np.concatenate([plan.controls for plan in plans]), dt)

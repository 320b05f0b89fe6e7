"""Constraints by a primal-dual interior point with exact second derivatives, on states and controls at once.

Each iteration takes a step to the minimum of a quadratic model of the Lagrangian with a logarithmic barrier, subject to
the linearised dynamics, by a Riccati recursion; gaps between the steps of the plan are closed on the way. The barrier
falls by Mehrotra's rule where the last step was long and the measures come down, and otherwise when its own problem is
nearly solved. A filter decides how much of a step is taken (Waechter and Biegler, 2006); corrections with the same
models then reduce the residuals of a long step. Where a model has no minimum, the Hessian is mixed with that of the
projected cost until it has.

A row d of an inequality is d >= 0, of an equality d = 0; limits of controls are rows, too. With a multiplier y, held
between a lowest and a highest one, `d = s - p` has two slacks: s, whose product with y - lowest is the barrier's
parameter, and p, whose product with highest - y is. An inequality has 0 for the lowest; without a highest there is no
p. A highest multiplier is the price, in cost a unit, for which a constraint may be missed: then it is elastic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lqrsim.codegen.compiled_module import Call, CompiledModule, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import active_set as active_kernel
from lqrsim.kernels import interior_point as kernel
from lqrsim.kernels.records import ActiveRows, ConstraintRows, CostToGo, Limits, Motion, Policy, StageModels
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import Iteration
from lqrsim.solvers import compiled
from lqrsim.solvers.settings import INSIDE

INTERIOR = "interior point"  # name of its iterations in the log
MIXES = (0.0, 0.03, 0.1, 0.25, 0.5, 1.0)  # fractions of the projected Hessian, tried in turn
WEIGHTS = (1e-6, 1e-3, 1.0, 1e3)  # on changes of controls, relative to the cost, if not even that has a minimum
REGULARISATION = 1e-8  # of equalities, relative
# Regularisation of active rows in the first step without a barrier. Where a row couples controls, curvature across it
# must exceed 1e-9 of its weight, below which the kernel takes it for rounding.
CROSSING = 1e-6
LONG = 0.3  # part of a step above which the next one uses Mehrotra's rule
LATELY = 4  # iterations with that rule; to continue, the measures must be better than in the worst of them
# Most corrections after a long step, and the largest share of the violation that each may leave.
CLOSINGS, CLOSER = 3, 0.3
# How much further the centring of a step that is not long looks, and the share of this that it must gain; the factor by
# which products may then differ from the barrier's parameter.
REACH, FURTHER, OUTLIER = 0.5, 0.1, 10.0
BOUNDARY = 0.99  # least part of the distance to a zero slack that a step may take
NOTHING, FAR = 1e-4, 1e-2  # scale of the first plan, relative to the typical cost of a change: the least; if infinite
SHORTEST = 1e-7  # part of a step before the line search gives up
MARGIN = 1e-5  # improvement that the filter requires
ARMIJO = 1e-4  # part of the promised decrease that a step must achieve
FORCED = 6  # most steps that are taken although the filter rejects them
WIDE = 1e10  # factor by which slack times multiplier may differ from the barrier parameter
CROSSINGS = 8  # most steps without a barrier, at the end
FINER, FINEST = 1e-2, 1e-13  # factor by which the tolerance falls if these fail, and its least value
AT_LIMIT = 1e-9  # distance, relative to its range, at which a control counts as at its limit
CREEP, CREEPING = 0.1, 20  # part of a step that is short, and number of short ones in a row that end the run
SLOW = 0.01  # unless the constraints are kept and the cost falls by this share meanwhile
STUCK, SOFTER, SOFTEST = 1e-2, 1e2, 1e10  # part of a step that softens equalities, the factor, and its limit
ABSURD = 1e3  # change of a multiplier, times its row's size and relative to the cost, that is implausible
FARTHEST = 10.0  # largest violation relative to the first plan's
EDGE = 0.05  # distance of the first controls from their limits, relative to the range


class Measures(NamedTuple):
    """Residuals of a plan.

    Attributes:
      cost: cost of the plan. stationarity: the largest slope of the Lagrangian in a control, times its range, relative
        to the cost. violation: of the worst constraint, in its unit. gap: the largest between two steps, relative to
        the states' ranges. complementarity: the largest product of a multiplier and its margin, relative to the cost.
    """

    cost: float
    stationarity: float
    violation: float
    gap: float
    complementarity: float


def iteration_of(measures: Measures, before: float, seconds: float) -> Iteration:
    """The log entry of measures; `before` is the cost of the previous entry."""
    return Iteration(
        measures.cost, (before - measures.cost) / max(abs(measures.cost), 1e-300), measures.gap,
        max(measures.stationarity, measures.complementarity), measures.gap, measures.violation, seconds, INTERIOR,
    )  # fmt: skip


@dataclass(kw_only=True)
class Found:
    """Result of a run.

    Attributes:
      plan: states and controls, a motion except for gaps. gain: (T, m, n) about it. measures: its measures.
      multipliers: multipliers of each constraint (T+1, rows); of the limits (T, m), positive where a control presses
        against the upper one. solved: whether all measures are within tolerance.
      control_size, row_size: typical sizes of controls (m,) and rows (R,). scale: the cost that measures are relative
        to.
    """

    plan: Motion
    gain: Array
    measures: Measures
    multipliers: tuple[Array, ...]
    pressing: Array
    solved: bool
    control_size: Array
    row_size: Array
    scale: float


class Sizes(NamedTuple):
    """Typical sizes of states (n,), controls (m,) and constraint rows (R,), and of the cost of such changes."""

    states: Array
    controls: Array
    rows: Array
    cost: float


class Stages:
    """The stages of a problem: their models, with all constraints and control limits as rows.

    Attributes:
      live: (T+1, R) which rows act at which step. equality: (R,) which are to be zero. owners: (R,) the constraint that
        a row is of; -1 for limits. models: `records.StageModels` of the last plan; slopes (T+1, R, n+m) of its rows.
      active: `records.ActiveRows`, for an active set. policy: gain and offset of the last step.
      free: (n,) which of the start's states are not fixed. limits: of each row that is one its sign, the control, and
        where it ends.
    """

    def __init__(self, problem: Problem) -> None:
        n, m = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates)
        self.n, self.m, steps = n, m, problem.steps
        what, sizes = f"{n} states and {m} controls", {"N": n, "M": m, "W": n + m}
        self._module = module_of(source_of(kernel), f"interior point, {what}", **sizes)
        self._active = module_of(source_of(active_kernel), f"active set, {what}", **sizes)
        self._calls: dict[str, Call] = {}
        self._take(problem)
        counts = [term.rows for term in problem.constraint_terms]
        rows = len(self.owners)
        self._values = tuple(np.empty((steps + 1) * count) for count in counts)
        self.slopes = np.zeros((steps + 1, rows, n + m))
        for row, (sign, i, _) in enumerate(self.limits, start=sum(counts)):
            self.slopes[:steps, row, n + i] = sign
        self.models = StageModels(
            np.zeros((steps + 1, n + m, n + m)), np.zeros((steps + 1, n + m, n + m)), np.zeros((steps + 1, n + m)),
            np.zeros((steps, n, n + m)), np.zeros((steps, n)), self.slopes.reshape(-1, n + m),
        )  # fmt: skip
        first = np.cumsum([0, *counts])[:-1].astype(np.float64)
        self._rows = ConstraintRows(rows, np.inf, first, np.zeros((rows, n + m)), np.zeros((steps + 1) * rows))
        self.gain, self.offset = np.zeros((steps, m, n)), np.zeros((steps, m))
        self.policy = Policy(self.gain, self.offset)
        arrays = (np.zeros(self.live.size) for _ in range(6))
        self.active = ActiveRows(rows, np.zeros((rows, 6)), *arrays)
        self.to_go = CostToGo(np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n)), np.zeros(steps + 1))
        self.changes = Motion(np.zeros((steps + 1, n)), np.zeros((steps, m)))

    def _take(self, problem: Problem) -> None:
        """Read a problem's numbers, and which of its rows can act."""
        self.problem, self.steps = problem, problem.steps
        fixed, steps = isinstance(problem.initial, FixedState), problem.steps
        self.free, self._soft = np.full(self.n, 0.0 if fixed else 1.0), 0 if fixed else 1
        terms = problem.constraint_terms
        own = [compiled.no_multipliers(problem, term) for term in terms]
        self._model = compiled.arguments(problem, multipliers=own, second_order=True)
        self._costs = compiled.costs_module(problem)
        limits = self._model.limits
        self.low, self.high = limits.low, limits.high
        self.limits = [
            (sign, i, side[i]) for sign, side in ((1.0, limits.low), (-1.0, limits.high)) for i in range(self.m)
            if np.isfinite(side[i])
        ]  # fmt: skip
        counts = [*(term.rows for term in terms), len(self.limits)]
        self.equality = np.repeat([*(term.equality for term in terms), False], counts).astype(bool)
        self.owners = np.repeat([*range(len(terms)), -1], counts)
        self.live = np.ones((steps + 1, sum(counts)), dtype=bool)
        for k, (term, array) in enumerate(zip(terms, own, strict=True)):
            self.live[: int(array[2]), self.owners == k] = False
            self.live[steps, self.owners == k] &= not term.uses_control
        self.live[steps, self.owners == -1] = False

    def renewed(self, problem: Problem) -> "Stages":
        """The stages of another problem of the same structure, in this memory if sizes allow."""
        owners, limits, steps = self.owners, [one[:2] for one in self.limits], self.steps
        self._take(problem)
        same = steps == self.steps and np.array_equal(owners, self.owners)
        if not same or limits != [one[:2] for one in self.limits]:
            return Stages(problem)
        self._rows.support[...] = 0.0
        return self

    def _call(self, name: str, *arguments: Any, module: CompiledModule | None = None) -> Any:
        """Call a compiled function, reusing the layout of its arguments."""
        call = self._calls.get(name)
        if call is None:
            call = self._calls[name] = (module or self._module).lay_out(name, *arguments)
        return call(*arguments)

    def values(self, plan: Motion) -> Array:
        """The rows' values (T+1, R); undefined where they do not act."""
        numbers = np.empty(self.live.shape)
        if self._values:
            constraints, costs = self._model.stage.constraints, self._costs
            self._call("evaluate_constraints", self.steps, *plan, constraints, self._values, module=costs)
        begin = 0
        for one in self._values:
            end = begin + len(one) // (self.steps + 1)
            numbers[:, begin:end] = one.reshape(self.steps + 1, -1)
            begin = end
        for row, (sign, i, side) in enumerate(self.limits, start=begin):
            numbers[:-1, row] = sign * (plan.controls[:, i] - side)
            numbers[-1, row] = numbers[-2, row]
        return numbers

    def trial(self, plan: Motion) -> tuple[float, Array]:
        """The cost of a plan, and the states that its steps arrive at, (T, n)."""
        arrived = np.empty((self.steps, self.n))
        return self._call("trial_cost", self.steps, self._soft, plan, self._model, arrived), arrived

    def linearize(self, plan: Motion, costates: Array, multipliers: Array, least: float) -> float:
        """Compute the models about a plan, with costates (T+1, n) and multipliers (T+1, R); return its cost."""
        cost = self.second_order(plan, costates, multipliers, least)
        self.convexify(plan)
        return cost

    def second_order(
        self, plan: Motion, costates: Array, multipliers: Array, least: float, *, second: bool = True
    ) -> float:
        """`linearize` without projected Hessians; without `second`, also without those of dynamics and constraints."""
        return self._look(plan, costates, self.active._replace(size=0), in_c_order(multipliers), least, second=second)

    def convexify(self, plan: Motion) -> None:
        """Compute the projected Hessians about a plan."""
        self._call("convex_models", self.steps, self._soft, plan, self._model, self.models)

    def act_at(self, plan: Motion) -> None:
        """Determine which rows act."""
        self.live &= ~np.isposinf(self.values(plan))  # infinity means that a constraint does not act at that step

    def look_about(self, plan: Motion) -> None:
        """Determine which rows act, and which variables each depends on, from slopes at the plan and near it."""
        self.act_at(plan)
        wiggle = np.sin(1.0 + np.arange(self.n + self.m))
        nowhere, none = np.zeros((self.steps + 1, self.n)), np.zeros(self.live.shape)
        for far in (1e-3, 0.0):
            beside = Motion(plan.states + far * wiggle[: self.n], plan.controls + far * wiggle[self.n :])
            self.linearize(beside, nowhere, none, np.inf)

    def sizes(self, plan: Motion) -> Sizes:
        """Typical sizes, estimated from a plan and the problem."""
        self.look_about(plan)
        return self.sizes_of(plan, self.models.convex)

    def sizes_of(self, plan: Motion, hessian: Array) -> Sizes:
        """Typical sizes from the plan of the current models and the Hessians of its cost.

        The size of a control without limits is the change that moves a state by its typical size.
        """
        problem = self.problem
        reach = np.ptp(plan.states, axis=0)
        if problem.goal is not None and problem.start is not None:
            reach = np.maximum(reach, np.abs(np.nan_to_num(problem.goal - problem.start)))
        states = np.where(reach > 1e-3, reach, 1.0)
        controls = self.high - self.low
        if not np.isfinite(controls).all():
            moved = np.abs(self.models.jacobian[:, :, self.n :]).sum(axis=0) / states[:, None]
            enough = np.maximum(1 / np.maximum(moved.max(axis=0), 1e-6), np.abs(plan.controls).max(axis=0))
            controls = np.where(np.isfinite(controls), controls, enough)
        both = np.concatenate([states, controls])
        counts = np.maximum(self.live.sum(axis=0), 1)
        rows = np.sqrt(np.einsum("trw,trw->rw", self.slopes, self.slopes) @ both**2 / counts)
        cost = 0.5 * float(np.abs(np.einsum("tww->w", hessian)) @ both**2)
        return Sizes(states, controls, np.where(rows > 0, rows, 1.0), cost or 1.0)

    def spread(self, rows: Array) -> Array:
        """Numbers of the live rows (K,) at their places in (T+1, R); others are zero."""
        spread = np.zeros(self.live.shape)
        spread[self.live] = rows
        return spread

    def of_each(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Numbers of the rows (R,) for each of the live ones, (K,)."""
        return np.broadcast_to(numbers, self.live.shape)[self.live]

    def pull(self, rows: Array) -> Array:
        """The sum of the slopes (T+1, n+m) of the live rows times these numbers."""
        return np.matmul(self.spread(rows)[:, None, :], self.slopes)[:, 0, :]

    def curvature(self, rows: Array) -> Array:
        """The sum of slope times slope' (T+1, n+m, n+m) of the live rows times these numbers."""
        weighed = self.slopes * self.spread(rows)[:, :, None]
        return np.matmul(weighed.transpose(0, 2, 1), self.slopes)

    def follow(self, plan: Motion, part: float, policy: tuple[Array, Array], limits: Limits) -> Motion:
        """Roll out a part of a step in closed loop; see the kernel."""
        out = Motion(np.empty((self.steps + 1, self.n)), np.empty((self.steps, self.m)))
        self._call("closed_loop_rollout", self.steps, float(part), plan, Policy(*policy), limits, self._model, out)
        return out

    def adjoint(self, gradient: Array) -> tuple[Array, Array]:
        """Costates (T+1, n) of stages with these gradients (T+1, n+m), and their slopes in the controls (T, m)."""
        costates, slopes = np.zeros((self.steps + 1, self.n)), np.zeros((self.steps, self.m))
        self._call("adjoint", self.steps, gradient, self.models.jacobian, costates, slopes)
        return costates, slopes

    def direction(self, hessian: Array, gradient: Array, gaps: Array) -> bool:
        """Compute the step to the minimum of the models, and the costates there; return whether there is a minimum."""
        models = self.models._replace(hessian=in_c_order(hessian), gradient=in_c_order(gradient))
        return self._solve(models, self.active._replace(size=0), in_c_order(gaps))[0]

    def joined(self) -> Array:
        """The changes of states and controls side by side, (T+1, n+m)."""
        joined = np.zeros((self.steps + 1, self.n + self.m))
        joined[:, : self.n], joined[:-1, self.n :] = self.changes
        return joined

    def moved(self) -> Array:
        """The changes of the live rows' values, (K,)."""
        return np.matmul(self.slopes, self.joined()[:, :, None])[:, :, 0][self.live]

    def look(self, plan: Motion, costates: Array, *, own: bool = False) -> float:
        """Compute the models about a plan, and the margins of the rows; return its cost. See the kernel."""
        return self._look(plan, costates, self.active, self.active.force, 0.0, own=own)

    def _look(
        self, plan: Motion, costates: Array, active: ActiveRows, multipliers: Array, least: float, *,
        second: bool = True, own: bool = False,
    ) -> float:  # fmt: skip
        rows = self._rows._replace(least=float(least), multipliers=multipliers.reshape(-1))
        return self._call(
            "linearize_plan", self.steps, self._soft, int(second), int(own), plan, costates, self._model, self._values,
            rows, self.models, active, module=self._active,
        )  # fmt: skip

    def measure(self, plan: Motion, gaps: Array, sizes: Sizes) -> tuple[float, ...]:
        """Residuals of the plan of the current models; writes its gaps. See the kernel."""
        of = plan, self.models, gaps, self.active, sizes.states, sizes.controls
        return self._call("optimality_measures", self.steps, *of, module=self._active)

    def pivot(self, gaps: Array, *, share: float, scale: float, weight: float, price: float = 1.0) -> tuple[bool, int]:
        """`direction` with held rows; also returns the number of wrong rows. See the kernel."""
        return self._solve(self.models, self.active, gaps, share, scale, weight, price)

    def _solve(
        self, models: StageModels, rows: ActiveRows, gaps: Array, share: float = 0.0, scale: float = 1.0,
        weight: float = 1.0, price: float = 1.0,
    ) -> tuple[bool, int]:  # fmt: skip
        failed, wrong = self._call(
            "pivot", self.steps, self.free, share, scale, weight, price, models, gaps, rows, self.policy, self.to_go,
            self.changes, module=self._active,
        )  # fmt: skip
        return failed == -1, wrong

    def change(self, *, worst: bool) -> None:
        """Change which rows are held; see the kernel."""
        self._call("update_active_set", self.steps, int(worst), self.active, module=self._active)

    def carry_out(self, plan: Motion, gain: Array) -> tuple[Motion, float, list[Array]]:
        """Roll out a plan with gains (T, m, n) about it; return the motion, its cost and the constraints' values.

        Controls are put at the limits that are held, and have no gain there.
        """
        out = Motion(np.empty_like(plan.states), np.empty_like(plan.controls))
        limits = Limits(*(np.tile(side, (self.steps, 1)) for side in (self.low, self.high)))
        cost = self._call(
            "rollout_of_active_set", self.steps, self._soft, plan, Policy(gain, self.offset), limits, self.active,
            self._model, self._values, out, module=self._active,
        )  # fmt: skip
        return out, cost, [one.reshape(self.steps + 1, -1) for one in self._values]


class Point(NamedTuple):
    """An iterate: a plan, its cost, the states its steps arrive at, the live rows' values (K,), and slacks (P,)."""

    plan: Motion
    cost: float
    arrived: Array
    numbers: Array
    slack: Array


class Step(NamedTuple):
    """A step in plan, slacks (P,) and multipliers (K,), and the costates after it."""

    plan: Motion
    slack: Array
    multipliers: Array
    costates: Array


class InteriorPoint:
    """Runs the interior point from one plan.

    Args:
      problem: a problem with constraints, limits, or neither.
      plan: states (T+1, n) and controls (T, m) to begin with, which need not be a motion or keep anything.
      barrier: its first parameter for each row, as a share of the cost divided by the number of rows.
      room: the least initial slack: relative to a row's size, or to a control's range.
      price: price of missing a constraint, in cost a unit: then it is elastic. Infinite: it must not be missed.
      multipliers: known ones of the constraints, (T+1, rows) each, or none.
      stages: to use again, of the same problem.
    """

    def __init__(
        self,
        problem: Problem,
        plan: Motion,
        *,
        barrier: float = 1.0,
        room: float = 0.02,
        price: float = np.inf,
        multipliers: tuple[Array, ...] = (),
        stages: Stages | None = None,
    ) -> None:
        self.stages = stages = Stages(problem) if stages is None else stages
        finite = np.isfinite(stages.high - stages.low)
        controls = plan.controls
        edge = EDGE * np.where(finite, stages.high - stages.low, 0.0)
        states = plan.states.copy()
        if isinstance(problem.initial, FixedState):
            fixed = stages.free == 0
            states[0, fixed] = np.asarray(problem.start)[fixed]
        within = in_c_order(np.clip(controls, stages.low, stages.high))
        self._begun, self._known = Motion(in_c_order(states), within), multipliers
        plan = Motion(in_c_order(states), in_c_order(np.clip(controls, stages.low + edge, stages.high - edge)))
        self.sizes = stages.sizes(plan)
        self._state_size, self._range, self._row_size, self._typical = self.sizes
        self._rows_of(plan, barrier, room, price, multipliers)
        self.iterations = 0
        self._filter: list[tuple[float, float]] = []
        self._errors: list[float] = []
        self._mixed, self._part, self._forced = False, 1.0, 0
        self._soft = 1.0
        stages.linearize(plan, self._costates, self.stages.spread(self._force), np.inf)
        self._costates, _ = self._adjoint()
        self._measure()
        # In a sum over many rows, those that are far from acting count, too.
        begun, steps = self._off(self.point), stages.steps
        self._farthest_gap = FARTHEST * max(0.05 * steps, begun)
        self._farthest = FARTHEST * max(0.05 * max(steps, len(self._row)), begun)

    def _rows_of(self, plan: Motion, barrier: float, room: float, price: float, multipliers: tuple[Array, ...]) -> None:
        """Set up slacks and multipliers."""
        stages, live = self.stages, self.stages.live
        cost, arrived = stages.trial(plan)
        numbers = stages.values(plan)[live]
        # A cost near zero, as of standing still, says nothing about the scale of the problem.
        self._scale = max(cost, NOTHING * self._typical) if cost < np.inf else FAR * self._typical
        shape = live.shape
        size = stages.of_each(self._row_size)
        equality, limit = stages.of_each(stages.equality), stages.of_each(stages.owners == -1)
        self._size = size
        highest = np.where(limit, np.inf, price)
        self._highest, self._elastic = highest, bool(np.isfinite(highest).any())
        lowest = np.where(equality, -highest, 0.0)
        below, above = np.flatnonzero(np.isfinite(lowest)), np.flatnonzero(np.isfinite(highest))
        # Each slack pairs with the distance of a multiplier from a bound; `row` is the row of each.
        self._row = np.concatenate([below, above])
        self._sign = np.concatenate([np.ones(len(below)), -np.ones(len(above))])
        self._bound = np.concatenate([lowest[below], highest[above]])
        self._hard = np.concatenate([~np.isfinite(highest[below]), np.zeros(len(above), dtype=bool)])
        self._regularised = np.where(np.isfinite(lowest), 0.0, REGULARISATION * size**2 / self._scale)
        # In units of cost.
        self._barrier = barrier
        self._first = barrier * self._scale / max(len(self._row), 1)
        self.parameter = self._first
        known = np.zeros(shape)
        for k, one in enumerate(multipliers):
            known[:, stages.owners == k] = one
        force = known[live]
        least = room * size
        pressed = (force > 0) & ~equality
        if multipliers:
            least = np.where(pressed, np.minimum(least, self.parameter / np.where(pressed, force, 1.0)), least)
        spare = np.maximum(numbers[below] * np.where(equality[below], 0.0, 1.0), least[below])
        spare = np.where(equality[below], np.maximum(numbers[below], 0.0) + least[below], spare)
        filled = np.zeros(len(numbers))
        filled[below] = spare
        slack = np.concatenate([spare, np.maximum(filled[above] - numbers[above], 1e-3 * least[above])])
        if len(multipliers):
            middle = self.parameter / filled[below]
            within = np.clip(force[below], 0.1 * middle, 10 * middle)
            force[below] = np.where(equality[below], force[below], within)
        else:
            force[below] = np.where(equality[below], 0.0, self.parameter / filled[below])
        far = np.where(np.isfinite(highest), 0.9 * highest, np.inf)
        self._force = np.clip(force, np.where(equality, -far, 0.0), far)
        self._costates = np.zeros((stages.steps + 1, stages.n))
        self.point = Point(plan, cost, arrived, numbers, slack)

    def run(
        self,
        *,
        tolerance: float,
        violation: float,
        most: int,
        near: bool = False,
        watch: Callable[[Measures], bool] = lambda measures: False,
    ) -> Found:
        """Iterate until the measures are within tolerance, no step helps, or `watch` ends it.

        Args:
          tolerance: tolerance of stationarity, gaps and complementarity. violation: of the constraints, in their units.
          most: iterations. near: whether the plan may be next to the answer. watch: called with the measures after
            each; True ends it.
        """
        if near and self._settle(tolerance, violation):
            watch(self.measures)
            return self._found(True)
        solved, ended, creeping, begun = self._within(tolerance, violation), False, 0, self.measures.cost
        while not solved and not ended and self.iterations < most and np.isfinite(self.measures.cost):
            if not self._iterate(tolerance):
                break
            solved = self._within(tolerance, violation)
            now = self.measures
            falls = now.violation <= violation and now.cost < begun - SLOW * abs(begun)
            creeping = 0 if self._part >= CREEP or falls else creeping + 1
            begun = begun if creeping else now.cost
            ended = watch(self.measures) or creeping == CREEPING
        finer, found = tolerance, (self.point, self._force, self._costates, self.measures)
        while solved and not self._cross(tolerance, violation) and not ended and finer > FINEST:
            # A lower barrier shows which rows are active, also where the cost is mostly constant.
            finer *= FINER
            for _ in range(min(CROSSINGS, most - self.iterations)):
                ended = not self._iterate(finer) or watch(self.measures)
                if ended or max(self.measures.complementarity, self.measures.stationarity) < finer:
                    break
            ended = ended or self.iterations >= most
            if not self._within(tolerance, violation):
                self.point, self._force, self._costates, self.measures = found
                break
            found = self.point, self._force, self._costates, self.measures
        return self._found(solved)

    def _settle(self, tolerance: float, violation: float) -> bool:
        """Take Newton steps without a barrier from the given plan and multipliers; return whether they converge."""
        stages, kept = self.stages, (self.point, self._force, self._costates, self.measures)
        plan = self._begun
        cost, arrived = stages.trial(plan)
        numbers = stages.values(plan)
        force = np.zeros(stages.live.shape)
        for k, one in enumerate(self._known):
            force[:, stages.owners == k] = one
        at_limit = (stages.owners == -1) & (numbers <= AT_LIMIT * self._row_size)
        force[at_limit] = np.broadcast_to(AT_LIMIT * self._scale / self._row_size, force.shape)[at_limit]
        self.point = Point(plan, cost, arrived, numbers[stages.live], kept[0].slack)
        self._force = np.clip(force[stages.live], -self._highest, self._highest)
        stages.linearize(plan, self._costates, stages.spread(self._force), np.inf)
        self._costates, _ = self._adjoint()
        if np.isfinite(cost) and self._cross(tolerance, violation):
            self.iterations = 1
            return True
        self._go_back(*kept)
        return False

    def _found(self, solved: bool) -> Found:
        stages, spread = self.stages, self.stages.spread(self._force)
        known = tuple(spread[:, stages.owners == k].copy() for k in range(len(stages.problem.constraint_terms)))
        pressing = np.zeros((stages.steps, stages.m))
        for row, (sign, i, _) in zip(np.flatnonzero(stages.owners == -1), stages.limits, strict=True):
            pressing[:, i] -= sign * spread[:-1, row]
        return Found(
            plan=self.point.plan, gain=stages.gain, measures=self.measures, multipliers=known, pressing=pressing,
            solved=solved, control_size=self._range, row_size=self._row_size,
            scale=self._scale,
        )  # fmt: skip

    def _cross(self, tolerance: float, violation: float) -> bool:
        """Cross over from the barrier to the active set: active rows become equalities; return whether they were right.

        So controls end at their limits, and multipliers lose the barrier's contribution. Constraints keep a margin for
        rounding.
        """
        stages, size, highest = self.stages, self._size, self._highest
        equality, limit = stages.of_each(stages.equality), stages.of_each(stages.owners == -1)
        aim = np.where(equality | limit, 0.0, INSIDE * violation)
        kept = self.point, self._force, self._costates, self.measures
        numbers = self.point.numbers
        missed = np.where(equality, np.abs(numbers), -numbers) / size
        paid = np.isfinite(highest) & (missed > 1 - np.abs(self._force) / highest)
        presses = ~paid & (equality | (self._force * size / self._scale > numbers / size))
        right = False
        for k in range(CROSSINGS):
            numbers = self.point.numbers - aim
            # The first step may be long, and a weight as large as that of the others would spoil it by rounding.
            sigma = np.where(presses, self._scale / ((REGULARISATION if k else CROSSING) * size**2), 0.0)
            self._force = np.where(presses, self._force, np.where(paid, np.sign(self._force) * highest, 0.0))
            stages.linearize(self.point.plan, self._costates, self.stages.spread(self._force), 0.0)
            gaps = stages.models.arrived - self.point.plan.states[1:]
            barrier = stages.curvature(sigma)
            gradient = stages.models.gradient - self.stages.pull(self._force - sigma * numbers)
            if not stages.direction(stages.models.hessian + barrier, gradient, gaps):
                break
            moved = stages.moved()
            self._force = self._force - sigma * (numbers + moved)
            self._costates = stages.to_go.gradient.copy()
            there = self._at(Step(stages.changes, np.zeros(len(self._row)), np.zeros(0), self._costates), 1.0)
            if there is None:
                break
            self.point = there._replace(slack=self.point.slack)
            stages.linearize(there.plan, self._costates, self.stages.spread(self._force), 0.0)
            self._measure()
            beyond = presses & (np.abs(self._force) > highest)
            lifted = presses & ~equality & (self._force < 0)
            back = paid & (there.numbers * np.sign(self._force) > 0)
            ignored = ~presses & ~paid & (there.numbers < 0)
            presses, paid = presses & ~beyond & ~lifted | back | ignored, paid & ~back | beyond
            right, found = not (beyond | lifted | back | ignored).any(), self.measures
            off = float(np.abs((there.numbers - aim)[presses]).max(initial=0.0))
            if right and max(found.stationarity, found.gap) < 1e-3 * tolerance and off < 1e-3 * violation:
                break
        found = self.measures
        right = right and found.stationarity < tolerance and found.gap < tolerance
        if right and (self._elastic or found.violation <= violation):
            return True
        self._go_back(*kept)
        return False

    def _go_back(self, point: Point, force: Array, costates: Array, measures: Measures) -> None:
        """Undo steps without a barrier."""
        self.point, self._force, self._costates, self.measures = point, force, costates, measures
        self.stages.linearize(point.plan, costates, self.stages.spread(force), 1e-10 * self._scale)
        self._measure()

    def _within(self, tolerance: float, violation: float) -> bool:
        found = self.measures
        others = found.stationarity < tolerance and found.gap < tolerance and found.complementarity < tolerance
        if self._elastic:  # the violation is in the slacks
            return others and self._residual() < tolerance
        return others and found.violation <= violation

    def _scale_of(self, cost: float) -> float:
        """The scale of relative measures: the cost, or a millionth of its typical size where its terms cancel."""
        least = 1e-6 * self._typical
        return max(abs(cost), least) if np.isfinite(cost) else least

    def _adjoint(self) -> tuple[Array, Array]:
        return self.stages.adjoint(in_c_order(self.stages.models.gradient - self.stages.pull(self._force)))

    def _missed(self, point: Point) -> Array:
        """Row values minus slacks, (K,)."""
        return point.numbers - np.bincount(self._row, self._sign * point.slack, len(point.numbers))

    def _residual(self) -> float:
        """The largest of these now, relative to the rows' sizes."""
        return float((np.abs(self._missed(self.point)) / self._size).max(initial=0.0))

    def _duals(self, force: Array) -> Array:
        """Distances of multipliers from their bounds, (P,)."""
        return self._sign * (force[self._row] - self._bound)

    def _measure(self) -> None:
        """Compute the measures at the plan of the current models."""
        stages, point = self.stages, self.point
        self._gaps = stages.models.arrived - point.plan.states[1:]
        start, slopes = self._adjoint()
        self._scale = self._scale_of(point.cost)
        stationarity = float((np.abs(slopes) * self._range).max())
        stationarity = max(stationarity, float((np.abs(start[0]) * self._state_size * stages.free).max()))
        equality = stages.of_each(stages.equality)
        numbers = point.numbers
        missed = float(np.where(equality, np.abs(numbers), -numbers).max(initial=0.0))
        self._products = point.slack * self._duals(self._force)
        # Margin times multiplier; for violated elastic rows, the product of the other slack.
        largest = float(self._products.max(initial=0.0))
        if self._hard.all():
            largest = float(np.where(equality, 0.0, np.abs(numbers) * self._force).max(initial=0.0))
        self.measures = Measures(
            cost=point.cost, stationarity=stationarity / self._scale, violation=missed,
            gap=float((np.abs(self._gaps) / self._state_size).max()), complementarity=largest / self._scale,
        )  # fmt: skip

    def _iterate(self, tolerance: float) -> bool:
        """Do one iteration; return whether there was a step."""
        stages, point, scale = self.stages, self.point, self._scale
        least = 0.1 * tolerance * scale
        free = self._falls()
        # A bad first plan may cost a hundred times the optimum, which would make the first barrier too high.
        self._first = min(self._first, self._barrier * scale / max(len(self._row), 1))
        if self.parameter > self._first and self.iterations:
            self.parameter, self._filter = self._first, []
        if self._mixed or self._part < LONG or not free:
            self._lower_barrier(least)
        duals = self._duals(self._force)
        ratio = point.slack / duals
        while True:
            # Far away, linearised equalities may be absurd; softened ones demand only a part.
            soft = self._soft * self._regularised
            sigma = 1 / (soft + np.bincount(self._row, ratio, len(point.numbers)))
            barrier = stages.curvature(sigma)
            mix = self._mix(barrier, sigma, duals)
            if mix is None:
                return False
            corrections = np.zeros(len(point.slack))
            self._mixed = mix > 0
            hessian = self._hessian(mix, barrier)
            if free and not self._mixed and self._part >= LONG and len(self._row):
                corrections = self._predict(hessian, sigma, duals, least)
                self._solve(hessian, sigma, duals, corrections)
            step = self._step(sigma, duals, corrections)
            if not self._mixed:
                step, corrections = self._centred(step, hessian, sigma, duals, corrections)
            taken = self._search(step, self._slope(step), hessian, sigma, duals, corrections)
            moving = taken is not None and taken[1] >= STUCK
            asked = float((np.abs(step.multipliers) * self._size * (soft > 0)).max(initial=0.0))
            if moving or asked < ABSURD * scale or self._soft >= SOFTEST:
                break
            self._soft *= SOFTER
        self.iterations += 1
        if taken is None:
            self._forced += 1
            if self._forced > FORCED or not self._solve(
                self._hessian(1.0, barrier), sigma, duals, np.zeros(len(point.slack))
            ):
                return False
            self._filter = []
            step = self._step(sigma, duals, np.zeros(len(point.slack)))
            taken = self._search(step, self._slope(step), None, sigma, duals, corrections)
            if taken is None:  # a little of it, be it better or not
                part = 0.1 * self._longest(point.slack, step.slack)
                tried = self._at(step, part)
                if tried is None:
                    return False
                taken = tried, part, step
        before = self._off(point), self._merit(point)
        new, part, step = taken
        self._filter.append(((1 - MARGIN) * before[0], before[1] - MARGIN * before[0]))
        self._part = part
        if part >= LONG:
            self._soft = max(1.0, self._soft / SOFTER)
        dual_part = self._longest(duals, self._sign * step.multipliers[self._row])
        held = np.isfinite(self._regularised) & (self._regularised > 0)
        self._force = self._force + np.where(held, part, dual_part) * step.multipliers
        self._costates = self._costates + part * (step.costates - self._costates)
        self._tidy(new.slack)
        self.point = new
        stages.linearize(new.plan, self._costates, self.stages.spread(self._force), 1e-10 * scale)
        self._measure()
        return True

    def _falls(self) -> bool:
        """Whether the measures have decreased lately, so that Mehrotra's rule may choose the barrier parameter.

        That rule empties the filter each time; without this condition iterations may cycle.
        """
        found, missed = self.measures, self._residual()
        error = max(found.stationarity, found.gap, missed, float(self._products.max(initial=0.0)) / self._scale)
        good = error < max(self._errors[-LATELY:], default=np.inf)
        if good:
            self._errors.append(error)
        return good

    def _lower_barrier(self, least: float) -> None:
        """Lower the barrier parameter while the measures are small relative to it."""
        missed = self._residual()
        for _ in range(4):
            off = max(
                self.measures.stationarity * self._scale, max(missed, self.measures.gap) * self._scale,
                float(np.abs(self._products - self.parameter).max(initial=0.0)),
            )  # fmt: skip
            if off > 10 * self.parameter or self.parameter <= least:
                break
            lower = self._scale * (self.parameter / self._scale) ** 1.5
            self.parameter, self._filter = max(least, min(0.2 * self.parameter, lower)), []

    def _hessian(self, mix: float, barrier: Array) -> Array:
        models = self.stages.models
        mixed = models.hessian if mix == 0 else (1 - mix) * models.hessian + mix * models.convex
        return mixed + barrier

    def _mix(self, barrier: Array, sigma: Array, duals: Array) -> float | None:
        """Write the step to `stages` with the least fraction of the projected Hessian that works; None if none does."""
        none = np.zeros(len(self.point.slack))
        for mix in MIXES:
            if self._solve(self._hessian(mix, barrier), sigma, duals, none):
                return mix
        hessian, n = self._hessian(1.0, barrier), self.stages.n
        for weight in WEIGHTS:
            heavier = hessian.copy()
            diagonal = np.arange(n, n + self.stages.m)
            heavier[:, diagonal, diagonal] += weight * self._scale / self._range**2
            if self._solve(heavier, sigma, duals, none):
                return 1.0
        return None

    def _solve(
        self, hessian: Array, sigma: Array, duals: Array, corrections: Array, beyond: Array | float = 0.0
    ) -> bool:
        """Compute the step in plan and costates; `beyond` is added to the rows' residuals."""
        pull = self._force - sigma * (self._target(duals, corrections) + beyond)
        gradient = self.stages.models.gradient - self.stages.pull(pull)
        return self.stages.direction(hessian, gradient, self._gaps + self._more)

    _more: Array | float = 0.0  # gaps that a correction adds

    def _target(self, duals: Array, corrections: Array) -> Array:
        """Residuals of the condensed row equations, (K,)."""
        wanted = self._sign * (self.parameter - corrections) / duals
        return self.point.numbers - np.bincount(self._row, wanted, len(self.point.numbers))

    def _step(self, sigma: Array, duals: Array, corrections: Array, beyond: Array | float = 0.0) -> Step:
        """Complete the step in `stages` by slacks and multipliers."""
        stages, point = self.stages, self.point
        moved = stages.moved()
        multipliers = -sigma * (moved + self._target(duals, corrections) + beyond)
        ratio = point.slack / duals
        slack = (self.parameter - corrections) / duals - point.slack - self._sign * ratio * multipliers[self._row]
        plan = Motion(stages.changes.states.copy(), stages.changes.controls.copy())
        return Step(plan, slack, multipliers, stages.to_go.gradient.copy())

    def _predict(self, hessian: Array, sigma: Array, duals: Array, least: float) -> Array:
        """Mehrotra's rule: set the barrier parameter by an affine step; return its second-order corrections, (P,)."""
        point, none = self.point, np.zeros(len(self.point.slack))
        self.parameter = 0.0
        self._solve(hessian, sigma, duals, none)
        step = self._step(sigma, duals, none)
        moved = self._sign * step.multipliers[self._row]
        primal, dual = self._longest(point.slack, step.slack, 1.0), self._longest(duals, moved, 1.0)
        average = float(self._products.mean())
        after = float(((point.slack + primal * step.slack) * (duals + dual * moved)).mean())
        self.parameter = max(least, min(10 * self._first, (after / average) ** 3 * average))
        self._filter = []
        return step.slack * moved if primal > 0.5 else none

    def _centred(
        self, step: Step, hessian: Array, sigma: Array, duals: Array, corrections: Array
    ) -> tuple[Step, Array]:
        """The step and its corrections; where a slack stops it early, another one if it goes further.

        Its corrections bring the outliers among the products, as they would be a little further on, back to within a
        factor of `OUTLIER` of the barrier's parameter (Gondzio, 1996).
        """
        moved, slack = self._sign * step.multipliers[self._row], self.point.slack
        part, dual_part = self._longest(slack, step.slack), self._longest(duals, moved)
        if part >= LONG:
            return step, corrections
        products = (slack + min(1.0, part + REACH) * step.slack) * (duals + min(1.0, dual_part + REACH) * moved)
        wanted = np.clip(products, self.parameter / OUTLIER, OUTLIER * self.parameter)
        others = corrections - np.maximum(wanted - products, -OUTLIER * self.parameter)
        if self._solve(hessian, sigma, duals, others):
            other = self._step(sigma, duals, others)
            if self._longest(slack, other.slack) >= part + FURTHER * REACH:
                return other, others
        return step, corrections

    def _longest(self, numbers: Array, changes: Array, share: float | None = None) -> float:
        """The largest part of the changes, at most 1, by the fraction-to-the-boundary rule."""
        share = max(BOUNDARY, 1 - self.parameter / self._scale) if share is None else share
        falling = changes < 0
        return min(1.0, float((-share * numbers[falling] / changes[falling]).min())) if falling.any() else 1.0

    def _off(self, point: Point) -> float:
        """Total violation of dynamics and rows at a point, relative to their sizes."""
        return self._gap(point) + float((np.abs(self._missed(point)) / self._size).sum())

    def _gap(self, point: Point) -> float:
        """The dynamics' share of it."""
        return float((np.abs(point.arrived - point.plan.states[1:]) / self._state_size).sum())

    def _merit(self, point: Point) -> float:
        """Cost plus prices plus barrier."""
        paid = -float((self._sign * self._bound) @ point.slack)
        return point.cost + paid - self.parameter * float(np.log(point.slack).sum())

    def _slope(self, step: Step) -> float:
        """Derivative of the merit along a step."""
        joined = np.concatenate([step.plan.states, np.pad(step.plan.controls, ((0, 1), (0, 0)))], axis=1)
        slacks = -self._sign * self._bound - self.parameter / self.point.slack
        return float((self.stages.models.gradient * joined).sum() + slacks @ step.slack)

    def _at(self, step: Step, part: float, *, about: Point | None = None) -> Point | None:
        """The point a part of a step further than this one, or another; None where it is not finite."""
        about = self.point if about is None else about
        plan = Motion(
            in_c_order(about.plan.states + part * step.plan.states),
            in_c_order(about.plan.controls + part * step.plan.controls),
        )
        cost, arrived = self.stages.trial(plan)
        numbers = self.stages.values(plan)[self.stages.live]
        if not np.isfinite(cost) or not np.isfinite(numbers).all() or not np.isfinite(arrived).all():
            return None
        slack = about.slack + part * step.slack
        slack = np.where(self._hard, np.maximum(slack, numbers[self._row]), slack)
        return Point(plan, cost, arrived, numbers, slack)

    def _acceptable(self, tried: Point, part: float, slope: float) -> bool:
        """Whether the filter accepts a trial point."""
        off, merit = self._off(tried), self._merit(tried)
        before, at_first = self._off(self.point), self._merit(self.point)
        if not np.isfinite(merit) or off > self._farthest or self._gap(tried) > self._farthest_gap:
            return False
        if any(off > worst and merit > dearest for worst, dearest in self._filter):
            return False
        small = 1e-4 * max(1.0, 1e-2 * self._gaps.size)
        if before < small and slope < 0 and min(-part * slope, 1e100) ** 2.3 > before**1.1:
            return merit <= at_first + ARMIJO * part * slope + 1e-12 * abs(at_first)
        at_rest = off < 1e-9 and merit <= at_first + 1e-11 * abs(at_first)
        return off <= (1 - MARGIN) * before or merit <= at_first - MARGIN * before or at_rest

    def _search(
        self, step: Step, slope: float, hessian: Array | None, sigma: Array, duals: Array, corrections: Array
    ) -> tuple[Point, float, Step] | None:
        """Backtrack along a step until the filter accepts; the first trial also with a second-order correction.

        The correction reduces the residuals after the whole step, which remain because rows and dynamics are not
        linear. Without a Hessian there is none.
        """
        part, first = self._longest(self.point.slack, step.slack), True
        while part > SHORTEST:
            tried = self._at(step, part)
            if tried is not None and self._acceptable(tried, part, slope):
                if hessian is not None and part >= LONG:
                    tried = self._closed(tried, hessian, sigma, duals, part, slope)
                return tried, part, step
            if first and tried is not None and hessian is not None and self._off(tried) >= self._off(self.point):
                beyond = part * self._missed(self.point) + self._missed(tried) - self._missed(self.point)
                self._more = part * self._gaps + tried.arrived - tried.plan.states[1:] - self._gaps
                good = self._solve(hessian, sigma, duals, corrections, beyond)
                self._more = 0.0
                if good:
                    other = self._step(sigma, duals, corrections, beyond)
                    corrected = self._at(other, self._longest(self.point.slack, other.slack))
                    if corrected is not None and self._acceptable(corrected, part, slope):
                        corrected = self._closed(corrected, hessian, sigma, duals, part, slope)
                        # Multipliers and costates are those of the uncorrected step.
                        return corrected, part, step
            first = False
            part /= 2
        return None

    def _closed(self, tried: Point, hessian: Array, sigma: Array, duals: Array, part: float, slope: float) -> Point:
        """The point nearer to a motion that keeps its rows, by the least changes, as far as the filter takes them.

        With the models of the step, so that each change costs a Riccati pass and a look at where the steps lead. So a
        plan that is good enough keeps everything long before it is the best.
        """
        stages = self.stages
        for _ in range(CLOSINGS):
            off, missed = self._off(tried), self._missed(tried)
            gaps = tried.arrived - tried.plan.states[1:]
            if not stages.direction(hessian, stages.pull(sigma * missed), gaps):
                break
            moved = stages.moved()
            multipliers = -sigma * (moved + missed)
            slack = -self._sign * (self.point.slack / duals) * multipliers[self._row]
            change = Step(stages.changes, slack, multipliers, self._costates)
            closer = self._at(change, self._longest(tried.slack, slack), about=tried)
            if closer is None or self._off(closer) > CLOSER * off or not self._acceptable(closer, part, slope):
                break
            tried = closer
        return tried

    def _tidy(self, slack: Array) -> None:
        """Keep the products of slacks and multipliers within reach of the barrier's parameter, where rows are hard."""
        row = self._row[self._hard]
        middle = self.parameter / slack[self._hard]
        self._force[row] = np.clip(self._force[row], middle / WIDE, WIDE * middle)

"""Constraints by a primal-dual interior point with exact second derivatives, on states and controls at once.

Each iteration takes a step to the minimum of a quadratic model of the Lagrangian with a logarithmic barrier, subject to
the linearised dynamics, by a Riccati recursion; gaps between the steps of the plan are closed on the way. The barrier
parameter is reduced by Mehrotra's rule if the last step was long and the measures decrease. Otherwise it is reduced
when the barrier problem is nearly solved. A filter decides how much of a step is taken (Waechter and Biegler, 2006).
Corrections with the same models then reduce the residuals of a long step. If a model has no minimum, the Hessian is
mixed with the Hessian of the projected cost until the model has a minimum.

A row d of an inequality means d >= 0, a row of an equality d = 0. Control limits are rows, too. The multiplier y of a
row lies between a lower and an upper bound, and `d = s - p` has two slacks. The product of s and y - lower is the
barrier parameter, and so is the product of p and upper - y. For an inequality, the lower bound is 0. Without an upper
bound there is no p. An upper bound is the price of a violation, in cost per unit: the constraint is then elastic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.solvers.budget import Laps
from lqrsim.solvers.settings import INSIDE
from lqrsim.solvers.stages import MIXES, Sizes, Stages, joined

INTERIOR = "interior point"  # name of its iterations in the log
WEIGHTS = (1e-6, 1e-3, 1.0, 1e3)  # weights on control changes, relative to the cost, if all these fail
REGULARISATION = 1e-8  # relative regularisation of equalities
# Regularisation of active rows in the first step without a barrier. If a row couples controls, the curvature across it
# must exceed 1e-9 of its weight; the kernel treats less as rounding.
CROSSING = 1e-6
LONG = 0.3  # fraction of a step above which the next step uses Mehrotra's rule
LATELY = 4  # number of iterations with that rule; to continue, the measures must be below the worst of these
# Largest number of corrections after a long step, and the largest fraction of the violation that each may leave.
CLOSINGS, CLOSER = 3, 0.3
# If a step is not long: the longer fraction for which centring aims, the part of this gain that is required, and the
# factor by which products may then differ from the barrier parameter.
REACH, FURTHER, OUTLIER = 0.5, 0.1, 10.0
BOUNDARY = 0.99  # least part of the distance to a zero slack that a step may take
NOTHING, FAR = 1e-4, 1e-2  # least scale of the first plan, relative to the typical cost of a change; if infinite
SHORTEST = 1e-7  # fraction of a step below which the line search gives up
MARGIN = 1e-5  # improvement that the filter requires
ARMIJO = 1e-4  # fraction of the predicted decrease that a step must achieve
FORCED = 6  # largest number of steps that are taken although the filter rejects them
WIDE = 1e10  # factor by which slack times multiplier may differ from the barrier parameter
CROSSINGS = 8  # largest number of final steps without a barrier
FINER, FINEST = 1e-2, 1e-13  # factor by which the tolerance falls if these fail, and its least value
AT_LIMIT = 1e-9  # distance, relative to its range, at which a control counts as at its limit
CREEP, CREEPING = 0.1, 20  # fraction of a step that is short; number of short steps in a row that end the run
SLOW = 0.01  # unless the constraints are satisfied and the cost falls by this fraction during them
STUCK, SOFTER, SOFTEST = 1e-2, 1e2, 1e10  # fraction of a step that softens equalities; factor, limit
ABSURD = 1e3  # change of a multiplier, times its row's size and relative to the cost, that is implausible
FARTHEST = 10.0  # largest violation relative to the first plan's
EDGE = 0.05  # distance of the first controls from their limits, relative to the range


class Measures(NamedTuple):
    """Residuals of a plan.

    Attributes:
      cost: cost of the plan. stationarity: the largest slope of the Lagrangian in a control, times its range, relative
        to the cost. violation: violation of the worst constraint, in its unit. gap: the largest gap between two steps,
        relative to the states' ranges. complementarity: the largest product of a multiplier and its margin, relative to
        the cost.
    """

    cost: float
    stationarity: float
    violation: float
    gap: float
    complementarity: float

    def record(self, laps: Laps, method: str = INTERIOR) -> None:
        """Record the residuals as an iteration that ends now."""
        optimality = max(self.stationarity, self.complementarity)
        laps.record(method, self.cost, optimality=optimality, gap=self.gap, violation=self.violation)


@dataclass(kw_only=True, eq=False)
class Found:
    """Result of a run.

    Attributes:
      plan: states and controls, feasible except for gaps. gain: (T, m, n) about it. measures: its measures.
      multipliers: multipliers of each constraint (T+1, rows), and of the limits (T, m), positive if a control presses
        against its upper limit. solved: whether all measures are within tolerance.
      sizes: typical sizes. scale: the cost to which measures are relative.
    """

    plan: Motion
    gain: Array
    measures: Measures
    multipliers: tuple[Array, ...]
    pressing: Array
    solved: bool
    sizes: Sizes
    scale: float


class Iterate(NamedTuple):
    """A plan, its cost, the states its steps arrive at, the live rows' values (K,), slacks (P,) and multipliers (K,).

    With the costates (T+1, n). A trial of a line search has the multipliers and costates before the step.
    """

    plan: Motion
    cost: float
    arrived: Array
    numbers: Array
    slack: Array
    force: Array
    costates: Array


class Step(NamedTuple):
    """A step in plan, slacks (P,) and multipliers (K,), and the costates after it."""

    plan: Motion
    slack: Array
    multipliers: Array
    costates: Array


class Rows:
    """The live rows of the stages (K,), and the slacks of the barrier (P,): one per row, or two for an elastic row.

    Each slack pairs with the distance of its row's multiplier from a bound.

    Attributes:
      size, equality, limit: (K,) for each row. highest: (K,) largest multiplier. regularised: (K,) softness of hard
        equalities, else 0. elastic: whether any row has a price.
      row, sign, bound: (P,) for each slack, its row, its sign in `d = s - p`, and the multiplier's bound. hard: (P,)
        whether its row is an inequality without a price.
    """

    def __init__(self, stages: Stages, sizes: Sizes, scale: float, price: float | Array) -> None:
        self.size, self.equality = stages.of_each(sizes.rows), stages.of_each(stages.equality)
        self.limit = stages.of_each(stages.owners == -1)
        self.highest = stages.of_each(np.where(stages.owners == -1, np.inf, price))
        self.elastic = bool(np.isfinite(self.highest).any())
        lowest = np.where(self.equality, -self.highest, 0.0)
        self.regularised = np.where(np.isfinite(lowest), 0.0, REGULARISATION * self.size**2 / scale)
        self.below, above = np.flatnonzero(np.isfinite(lowest)), np.flatnonzero(np.isfinite(self.highest))
        self.row = np.concatenate([self.below, above])
        self.sign = np.concatenate([np.ones(len(self.below)), -np.ones(len(above))])
        self.bound = np.concatenate([lowest[self.below], self.highest[above]])
        self.hard = np.concatenate([~np.isfinite(self.highest[self.below]), np.zeros(len(above), dtype=bool)])

    def beginning(self, numbers: Array, known: Array | None, *, parameter: float, room: float) -> tuple[Array, Array]:
        """Initial slacks (P,) and multipliers (K,) for rows with these values; `known` are given multipliers."""
        below, equality = self.below, self.equality[self.below]
        force, least = np.zeros(len(numbers)) if known is None else known, room * self.size
        if known is not None:
            pressed = (force > 0) & ~self.equality
            least = np.where(pressed, np.minimum(least, parameter / np.where(pressed, force, 1.0)), least)
        spare = np.where(
            equality, np.maximum(numbers[below], 0.0) + least[below], np.maximum(numbers[below], least[below])
        )
        filled = np.zeros(len(numbers))
        filled[below] = spare
        above = self.row[len(below) :]
        slack = np.concatenate([spare, np.maximum(filled[above] - numbers[above], 1e-3 * least[above])])
        middle = parameter / filled[below]
        if known is None:
            force[below] = np.where(equality, 0.0, middle)
        else:
            force[below] = np.where(equality, force[below], np.clip(force[below], 0.1 * middle, 10 * middle))
        far = np.where(np.isfinite(self.highest), 0.9 * self.highest, np.inf)
        return slack, np.clip(force, np.where(self.equality, -far, 0.0), far)

    def total(self, slacks: Array) -> NDArray[Any]:
        """The sum of each row's slacks, with their signs, (K,)."""
        return np.bincount(self.row, self.sign * slacks, len(self.size))

    def missed(self, point: Iterate) -> Array:
        """Row values minus slacks, (K,)."""
        return point.numbers - self.total(point.slack)

    def largest_miss(self, point: Iterate) -> float:
        """The largest difference of row values and slacks, relative to the rows' sizes."""
        return float((np.abs(self.missed(point)) / self.size).max(initial=0.0))

    def duals(self, force: Array) -> Array:
        """Distances of multipliers from their bounds, (P,)."""
        return self.sign * (force[self.row] - self.bound)

    def violation(self, numbers: Array) -> Array:
        """The violations of rows with these values, (K,); negative for inequalities that hold."""
        return np.where(self.equality, np.abs(numbers), -numbers)


class System(NamedTuple):
    """The linear equations of an iteration for a step in plan and costates, without slacks and multipliers.

    Attributes:
      hessian: (T+1, n+m, n+m) with the barrier. sigma: (K,) the barrier's curvature in each row.
      duals: (P,) the multipliers' distances from their bounds.
    """

    hessian: Array
    sigma: Array
    duals: Array


class InteriorPoint:
    """Runs the interior point from one plan.

    Args:
      problem: a problem with constraints, limits, or neither.
      plan: initial states (T+1, n) and controls (T, m), which need satisfy neither dynamics nor constraints.
      barrier: initial barrier parameter of each row, as a fraction of the cost divided by the number of rows.
      room: the least initial slack: relative to a row's size, or to a control's range.
      price: price of violating a constraint, in cost per unit; the constraint is then elastic. Infinite if it must
        hold. Or a price for each row, (R,).
      multipliers: known multipliers of the constraints, (T+1, rows) each, or none.
      stages: stages of the same problem, to be reused.

    Attributes:
      point: the current iterate. measures: its measures. sizes: typical sizes. parameter: the barrier parameter.
      iterations: their number so far.
    """

    def __init__(
        self,
        problem: Problem,
        plan: Motion,
        *,
        barrier: float = 1.0,
        room: float = 0.02,
        price: float | Array = np.inf,
        multipliers: tuple[Array, ...] = (),
        stages: Stages | None = None,
    ) -> None:
        self.stages = stages = Stages(problem) if stages is None else stages
        low, high, states = stages.low, stages.high, plan.states.copy()
        edge = EDGE * np.where(np.isfinite(high - low), high - low, 0.0)
        if isinstance(problem.initial, FixedState):
            fixed = stages.free == 0
            states[0, fixed] = np.asarray(problem.start)[fixed]
        self._begun = Motion(in_c_order(states), in_c_order(np.clip(plan.controls, low, high)))
        plan = Motion(in_c_order(states), in_c_order(np.clip(plan.controls, low + edge, high - edge)))
        self.sizes = stages.sizes(plan)
        cost, arrived = stages.trial(plan)
        numbers = stages.values(plan)[stages.live]
        # A cost near zero, as when standing still, says nothing about the scale of the problem.
        self._scale = max(cost, NOTHING * self.sizes.cost) if cost < np.inf else FAR * self.sizes.cost
        self._rows = Rows(stages, self.sizes, self._scale, price)
        self._barrier = barrier
        self.parameter = self._first = barrier * self._scale / max(len(self._rows.row), 1)
        self._known = stages.of_constraints(multipliers)
        known = self._known[stages.live] if multipliers else None
        slack, force = self._rows.beginning(numbers, known, parameter=self.parameter, room=room)
        costates = np.zeros((stages.steps + 1, stages.n))
        self.iterations = 0
        self._filter: list[tuple[float, float]] = []
        self._errors: list[float] = []
        self._mixed, self._part, self._forced = False, 1.0, 0
        self._soft = 1.0
        self._begin_at(Iterate(plan, cost, arrived, numbers, slack, force, costates))
        self._measure()
        # In a sum over many rows, even rows that are far from active count.
        begun, steps = self._off(self.point), stages.steps
        self._farthest_gap = FARTHEST * max(0.05 * steps, begun)
        self._farthest = FARTHEST * max(0.05 * max(steps, len(self._rows.row)), begun)

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
          tolerance: tolerance of stationarity, gaps and complementarity. violation: tolerance of the constraints, in
            their units.
          most: largest number of iterations. near: whether the plan may be next to the answer. watch: called with the
            measures after each iteration; True ends the run.
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
        finer, found = tolerance, (self.point, self.measures)
        while solved and not self._cross(tolerance, violation) and not ended and finer > FINEST:
            # A lower barrier shows which rows are active, even if most of the cost is constant.
            finer *= FINER
            for _ in range(min(CROSSINGS, most - self.iterations)):
                ended = not self._iterate(finer) or watch(self.measures)
                if ended or max(self.measures.complementarity, self.measures.stationarity) < finer:
                    break
            ended = ended or self.iterations >= most
            if not self._within(tolerance, violation):
                self.point, self.measures = found
                break
            found = self.point, self.measures
        return self._found(solved)

    def _begin_at(self, point: Iterate) -> None:
        """Go to a point, with the costates that belong to its multipliers."""
        self.point = point
        self._linearize(np.inf)
        self.point = point._replace(costates=self._adjoint()[0])

    def _go_to(self, point: Iterate, least: float) -> None:
        """Go to a point; its multipliers up to `least` count as zero in the models."""
        self.point = point
        self._linearize(least)
        self._measure()

    def _found(self, solved: bool) -> Found:
        stages, spread = self.stages, self.stages.spread(self.point.force)
        known = tuple(spread[:, stages.owners == k].copy() for k in range(len(stages.problem.constraint_terms)))
        pressing = np.zeros((stages.steps, stages.m))
        for row, (sign, i, _) in zip(np.flatnonzero(stages.owners == -1), stages.limits, strict=True):
            pressing[:, i] -= sign * spread[:-1, row]
        return Found(
            plan=self.point.plan, gain=stages.policy.gain, measures=self.measures, multipliers=known, pressing=pressing,
            solved=solved, sizes=self.sizes, scale=self._scale,
        )  # fmt: skip

    def _linearize(self, least: float) -> None:
        """Compute the models about the plan; multipliers up to `least` count as zero."""
        self.stages.linearize(self.point.plan, self.point.costates, self.stages.spread(self.point.force), least)

    def _adjoint(self) -> tuple[Array, Array]:
        return self.stages.adjoint(in_c_order(self.stages.models.gradient - self.stages.pull(self.point.force)))

    def _measure(self) -> None:
        """Compute the measures at the plan of the current models."""
        stages, point, rows = self.stages, self.point, self._rows
        self._gaps = stages.models.arrived - point.plan.states[1:]
        start, slopes = self._adjoint()
        # Measures are relative to the cost, or to a millionth of its typical size if its terms cancel.
        least = 1e-6 * self.sizes.cost
        self._scale = max(abs(point.cost), least) if np.isfinite(point.cost) else least
        stationarity = float((np.abs(slopes) * self.sizes.controls).max())
        stationarity = max(stationarity, float((np.abs(start[0]) * self.sizes.states * stages.free).max()))
        self._products = point.slack * rows.duals(self.point.force)
        # Margin times multiplier; for violated elastic rows, the product of the other slack.
        largest = float(self._products.max(initial=0.0))
        if rows.hard.all():
            largest = float(np.where(rows.equality, 0.0, np.abs(point.numbers) * self.point.force).max(initial=0.0))
        self.measures = Measures(
            cost=point.cost, stationarity=stationarity / self._scale,
            violation=float(rows.violation(point.numbers).max(initial=0.0)),
            gap=float((np.abs(self._gaps) / self.sizes.states).max()), complementarity=largest / self._scale,
        )  # fmt: skip

    def _within(self, tolerance: float, violation: float) -> bool:
        found = self.measures
        others = found.stationarity < tolerance and found.gap < tolerance and found.complementarity < tolerance
        if self._rows.elastic:  # the violation is in the slacks
            return others and self._rows.largest_miss(self.point) < tolerance
        return others and found.violation <= violation

    def _settle(self, tolerance: float, violation: float) -> bool:
        """Take Newton steps without a barrier from the given plan and multipliers; return whether they converge."""
        stages, kept, plan, size = self.stages, self.point, self._begun, self.sizes.rows
        cost, arrived = stages.trial(plan)
        numbers, force = stages.values(plan), self._known.copy()
        at_limit = (stages.owners == -1) & (numbers <= AT_LIMIT * size)
        force[at_limit] = np.broadcast_to(AT_LIMIT * self._scale / size, force.shape)[at_limit]
        force = np.clip(force[stages.live], -self._rows.highest, self._rows.highest)
        self._begin_at(Iterate(plan, cost, arrived, numbers[stages.live], kept.slack, force, kept.costates))
        if np.isfinite(cost) and self._cross(tolerance, violation):
            self.iterations = 1
            return True
        self._go_to(kept, 1e-10 * self._scale)
        return False

    def _cross(self, tolerance: float, violation: float) -> bool:
        """Cross over from the barrier to the active set: active rows become equalities. Return whether they were right.

        Controls then end exactly at their limits, and multipliers lose the barrier's contribution. Constraints keep a
        margin for rounding.
        """
        rows, kept, size, highest = self._rows, self.point, self._rows.size, self._rows.highest
        aim = np.where(rows.equality | rows.limit, 0.0, INSIDE * violation)
        numbers, force = self.point.numbers, self.point.force
        paid = np.isfinite(highest) & (rows.violation(numbers) / size > 1 - np.abs(force) / highest)
        presses = ~paid & (rows.equality | (force * size / self._scale > numbers / size))
        right = False
        for k in range(CROSSINGS):
            # The first step may be long; with a weight as large as in the other steps, rounding would spoil it.
            sigma = np.where(presses, self._scale / ((REGULARISATION if k else CROSSING) * size**2), 0.0)
            force = np.where(presses, force, np.where(paid, np.sign(force) * highest, 0.0))
            if not self._step_along(sigma, aim, force):
                break
            numbers, force, found = self.point.numbers, self.point.force, self.measures
            beyond = presses & (np.abs(force) > highest)
            lifted = presses & ~rows.equality & (force < 0)
            back = paid & (numbers * np.sign(force) > 0)
            ignored = ~presses & ~paid & (numbers < 0)
            presses, paid = presses & ~beyond & ~lifted | back | ignored, paid & ~back | beyond
            right = not (beyond | lifted | back | ignored).any()
            off = float(np.abs((numbers - aim)[presses]).max(initial=0.0))
            if right and max(found.stationarity, found.gap) < 1e-3 * tolerance and off < 1e-3 * violation:
                break
        found = self.measures
        right = right and found.stationarity < tolerance and found.gap < tolerance
        if right and (rows.elastic or found.violation <= violation):
            return True
        self._go_to(kept, 1e-10 * self._scale)
        return False

    def _step_along(self, sigma: Array, aim: Array, force: Array) -> bool:
        """Take a step without a barrier that brings rows of weight sigma (K,) to their aims; False if there is none.

        It begins with multipliers `force`, (K,).
        """
        stages, numbers = self.stages, self.point.numbers - aim
        self.point = self.point._replace(force=force)
        self._linearize(0.0)
        gaps = stages.models.arrived - self.point.plan.states[1:]
        barrier = stages.curvature(sigma)
        gradient = stages.models.gradient - stages.pull(force - sigma * numbers)
        if not stages.direction(stages.models.hessian + barrier, gradient, gaps):
            return False
        force, costates = force - sigma * (numbers + stages.moved()), stages.to_go.gradient.copy()
        none = np.zeros(len(self.point.slack))
        there = self._at(Step(stages.changes, none, np.zeros(0), costates), 1.0)
        if there is None:
            return False
        self._go_to(there._replace(slack=self.point.slack, force=force, costates=costates), 0.0)
        return True

    def _iterate(self, tolerance: float) -> bool:
        """Do one iteration; return whether a step was found."""
        least, free = 0.1 * tolerance * self._scale, self._falls()
        self._lower_barrier(least, free)
        while True:
            # Far away, linearised equalities may be absurd; softened equalities demand only a part.
            soft = self._soft * self._rows.regularised
            system = self._system(soft)
            if system is None:
                return False
            step, corrections = self._direction(system, least, free)
            taken = self._search(step, system, corrections)
            moving = taken is not None and taken[1] >= STUCK
            asked = float((np.abs(step.multipliers) * self._rows.size * (soft > 0)).max(initial=0.0))
            if moving or asked < ABSURD * self._scale or self._soft >= SOFTEST:
                break
            self._soft *= SOFTER
        self.iterations += 1
        taken = self._force_step(system) if taken is None else taken
        if taken is None:
            return False
        self._take(*taken, system.duals)
        return True

    def _falls(self) -> bool:
        """Whether the measures have decreased lately, so that Mehrotra's rule may choose the barrier parameter.

        The rule empties the filter each time. Without this condition, iterations may cycle.
        """
        found, missed = self.measures, self._rows.largest_miss(self.point)
        error = max(found.stationarity, found.gap, missed, float(self._products.max(initial=0.0)) / self._scale)
        good = error < max(self._errors[-LATELY:], default=np.inf)
        if good:
            self._errors.append(error)
        return good

    def _lower_barrier(self, least: float, free: bool) -> None:
        """Lower the barrier parameter while the measures are small relative to it, unless Mehrotra's rule will."""
        # A bad first plan may cost a hundred times the optimum, which would make the first barrier too high.
        self._first = min(self._first, self._barrier * self._scale / max(len(self._rows.row), 1))
        if self.parameter > self._first and self.iterations:
            self.parameter, self._filter = self._first, []
        if free and not self._mixed and self._part >= LONG:
            return
        missed = self._rows.largest_miss(self.point)
        for _ in range(4):
            off = max(
                self.measures.stationarity * self._scale, max(missed, self.measures.gap) * self._scale,
                float(np.abs(self._products - self.parameter).max(initial=0.0)),
            )  # fmt: skip
            if off > 10 * self.parameter or self.parameter <= least:
                break
            lower = self._scale * (self.parameter / self._scale) ** 1.5
            self.parameter, self._filter = max(least, min(0.2 * self.parameter, lower)), []

    def _system(self, soft: Array) -> System | None:
        """The equations with the least fraction of the projected Hessian that has a minimum; the step is in `stages`.

        None if no fraction has a minimum, not even with a weight on changes of the controls. Rows are softened by
        `soft`, (K,).
        """
        stages, point, rows = self.stages, self.point, self._rows
        duals = rows.duals(self.point.force)
        sigma = 1 / (soft + np.bincount(rows.row, point.slack / duals, len(point.numbers)))
        barrier, none = stages.curvature(sigma), np.zeros(len(point.slack))
        weights = [weight * self._scale / self.sizes.controls**2 for weight in WEIGHTS]
        for number, hessian in enumerate(stages.hessians(barrier, weights)):
            self._mixed = number > 0
            if self._solve(system := System(hessian, sigma, duals), none):
                # Without the weights, no correction has a minimum: there is none then.
                weighed = number >= len(MIXES)
                return system._replace(hessian=stages.models.convex + barrier) if weighed else system
        return None

    def _direction(self, system: System, least: float, free: bool) -> tuple[Step, Array]:
        """The step and its corrections (P,) of the products of slacks and multipliers."""
        corrections = np.zeros(len(self.point.slack))
        if self._mixed:
            return self._step(system, corrections), corrections
        if free and self._part >= LONG and len(self._rows.row):
            corrections = self._predict(system, least)
            self._solve(system, corrections)
        return self._centred(self._step(system, corrections), system, corrections)

    def _solve(
        self, system: System, corrections: Array, beyond: Array | float = 0.0, wider: Array | float = 0.0
    ) -> bool:
        """Compute the step in plan and costates; `beyond` and `wider` add to the residuals of rows and to the gaps."""
        pull = self.point.force - system.sigma * (self._target(system, corrections) + beyond)
        gradient = self.stages.models.gradient - self.stages.pull(pull)
        return self.stages.direction(system.hessian, gradient, self._gaps + wider)

    def _target(self, system: System, corrections: Array) -> Array:
        """Residuals of the condensed row equations, (K,)."""
        return self.point.numbers - self._rows.total((self.parameter - corrections) / system.duals)

    def _step(self, system: System, corrections: Array, beyond: Array | float = 0.0) -> Step:
        """Complete the step in `stages` by slacks and multipliers."""
        stages, slack, duals, rows = self.stages, self.point.slack, system.duals, self._rows
        multipliers = -system.sigma * (stages.moved() + self._target(system, corrections) + beyond)
        moved = rows.sign * multipliers[rows.row]
        change = (self.parameter - corrections) / duals - slack - slack / duals * moved
        plan = Motion(stages.changes.states.copy(), stages.changes.controls.copy())
        return Step(plan, change, multipliers, stages.to_go.gradient.copy())

    def _predict(self, system: System, least: float) -> Array:
        """Mehrotra's rule: set the barrier parameter by an affine step; return its second-order corrections, (P,)."""
        point, duals, none = self.point, system.duals, np.zeros(len(self.point.slack))
        self.parameter = 0.0
        self._solve(system, none)
        step = self._step(system, none)
        moved = self._rows.sign * step.multipliers[self._rows.row]
        primal, dual = self._longest(point.slack, step.slack, 1.0), self._longest(duals, moved, 1.0)
        average = float(self._products.mean())
        after = float(((point.slack + primal * step.slack) * (duals + dual * moved)).mean())
        self.parameter = max(least, min(10 * self._first, (after / average) ** 3 * average))
        self._filter = []
        return step.slack * moved if primal > 0.5 else none

    def _centred(self, step: Step, system: System, corrections: Array) -> tuple[Step, Array]:
        """The step and its corrections. If a slack stops the step early, another step if that goes further.

        The corrections of that step bring outliers among the products, predicted for a slightly longer step, back to
        within a factor of `OUTLIER` of the barrier parameter (Gondzio, 1996).
        """
        rows, slack, duals = self._rows, self.point.slack, system.duals
        moved = rows.sign * step.multipliers[rows.row]
        part, dual_part = self._longest(slack, step.slack), self._longest(duals, moved)
        if part >= LONG:
            return step, corrections
        products = (slack + min(1.0, part + REACH) * step.slack) * (duals + min(1.0, dual_part + REACH) * moved)
        wanted = np.clip(products, self.parameter / OUTLIER, OUTLIER * self.parameter)
        others = corrections - np.maximum(wanted - products, -OUTLIER * self.parameter)
        if self._solve(system, others):
            other = self._step(system, others)
            if self._longest(slack, other.slack) >= part + FURTHER * REACH:
                return other, others
        return step, corrections

    def _longest(self, numbers: Array, changes: Array, share: float | None = None) -> float:
        """The largest part of the changes, at most 1, by the fraction-to-the-boundary rule."""
        share = max(BOUNDARY, 1 - self.parameter / self._scale) if share is None else share
        falling = changes < 0
        return min(1.0, float((-share * numbers[falling] / changes[falling]).min())) if falling.any() else 1.0

    def _search(self, step: Step, system: System, corrections: Array | None) -> tuple[Iterate, float, Step] | None:
        """Backtrack along a step until the filter accepts; the first trial also with a second-order correction.

        The correction reduces the residuals after the whole step, which remain because rows and dynamics are not
        linear. Without the step's corrections it is left out.

        Returns:
          The point, the fraction of the step that leads to it, and the step whose multipliers and costates belong to
          it.
        """
        slope = self._slope(step)
        part, first = self._longest(self.point.slack, step.slack), True
        while part > SHORTEST:
            tried = self._at(step, part)
            if tried is not None and self._acceptable(tried, part, slope):
                if corrections is not None and part >= LONG:
                    tried = self._closed(tried, system, part, slope)
                return tried, part, step
            if first and tried is not None and corrections is not None:
                corrected = self._corrected(tried, system, part, corrections)
                if corrected is not None and self._acceptable(corrected, part, slope):
                    # Multipliers and costates come from the uncorrected step.
                    return self._closed(corrected, system, part, slope), part, step
            first = False
            part /= 2
        return None

    def _corrected(self, tried: Iterate, system: System, part: float, corrections: Array) -> Iterate | None:
        """The point of a step that also reduces the residuals at a trial point; None if these have fallen."""
        now, missed = self.point, self._rows.missed
        if not self._off(tried) >= self._off(now):
            return None
        beyond = part * missed(now) + missed(tried) - missed(now)
        wider = part * self._gaps + tried.arrived - tried.plan.states[1:] - self._gaps
        if not self._solve(system, corrections, beyond, wider):
            return None
        other = self._step(system, corrections, beyond)
        return self._at(other, self._longest(now.slack, other.slack))

    def _closed(self, tried: Iterate, system: System, part: float, slope: float) -> Iterate:
        """The point moved towards feasibility by the smallest changes, as far as the filter accepts them.

        The changes use the models of the step, so each change costs a Riccati pass and an evaluation of the steps. A
        good plan is then feasible long before it is optimal.
        """
        stages, sigma = self.stages, system.sigma
        for _ in range(CLOSINGS):
            off, missed = self._off(tried), self._rows.missed(tried)
            gaps = tried.arrived - tried.plan.states[1:]
            if not stages.direction(system.hessian, stages.pull(sigma * missed), gaps):
                break
            multipliers = -sigma * (stages.moved() + missed)
            slack = -(self.point.slack / system.duals) * (self._rows.sign * multipliers[self._rows.row])
            change = Step(stages.changes, slack, multipliers, self.point.costates)
            closer = self._at(change, self._longest(tried.slack, slack), about=tried)
            if closer is None or self._off(closer) > CLOSER * off or not self._acceptable(closer, part, slope):
                break
            tried = closer
        return tried

    def _force_step(self, system: System) -> tuple[Iterate, float, Step] | None:
        """A step for when the filter rejects every fraction of the last step; None if there is none, or were too many.

        It is the step of the projected Hessian; or, if the filter rejects that, a small fraction of it, better or not.
        """
        self._forced += 1
        none = np.zeros(len(self.point.slack))
        system = system._replace(hessian=self.stages.models.convex + self.stages.curvature(system.sigma))
        if self._forced > FORCED or not self._solve(system, none):
            return None
        self._filter = []
        step = self._step(system, none)
        taken = self._search(step, system, None)
        if taken is not None:
            return taken
        part = 0.1 * self._longest(self.point.slack, step.slack)
        tried = self._at(step, part)
        return None if tried is None else (tried, part, step)

    def _take(self, new: Iterate, part: float, step: Step, duals: Array) -> None:
        """Go to a point, with that fraction of a step in multipliers and costates."""
        off, rows = self._off(self.point), self._rows
        self._filter.append(((1 - MARGIN) * off, self._merit(self.point) - MARGIN * off))
        self._part = part
        if part >= LONG:
            self._soft = max(1.0, self._soft / SOFTER)
        dual_part = self._longest(duals, rows.sign * step.multipliers[rows.row])
        costates = self.point.costates
        force = self.point.force + np.where(rows.regularised > 0, part, dual_part) * step.multipliers
        # For hard rows, the products of slacks and multipliers stay within a factor of the barrier parameter.
        hard, middle = rows.row[rows.hard], self.parameter / new.slack[rows.hard]
        force[hard] = np.clip(force[hard], middle / WIDE, WIDE * middle)
        costates = costates + part * (step.costates - costates)
        self._go_to(new._replace(force=force, costates=costates), 1e-10 * self._scale)

    def _at(self, step: Step, part: float, *, about: Iterate | None = None) -> Iterate | None:
        """The point at a fraction of a step from this point, or from another; None if it is not finite."""
        about, rows = self.point if about is None else about, self._rows
        plan = Motion(
            in_c_order(about.plan.states + part * step.plan.states),
            in_c_order(about.plan.controls + part * step.plan.controls),
        )
        cost, arrived = self.stages.trial(plan)
        numbers = self.stages.values(plan)[self.stages.live]
        if not np.isfinite(cost) or not np.isfinite(numbers).all() or not np.isfinite(arrived).all():
            return None
        slack = about.slack + part * step.slack
        slack = np.where(rows.hard, np.maximum(slack, numbers[rows.row]), slack)
        return about._replace(plan=plan, cost=cost, arrived=arrived, numbers=numbers, slack=slack)

    def _off(self, point: Iterate) -> float:
        """Total violation of dynamics and rows at a point, relative to their sizes."""
        return self._gap(point) + float((np.abs(self._rows.missed(point)) / self._rows.size).sum())

    def _gap(self, point: Iterate) -> float:
        """The part of the violation that is due to the dynamics."""
        return float((np.abs(point.arrived - point.plan.states[1:]) / self.sizes.states).sum())

    def _merit(self, point: Iterate) -> float:
        """Cost plus prices plus barrier."""
        paid = -float((self._rows.sign * self._rows.bound) @ point.slack)
        return point.cost + paid - self.parameter * float(np.log(point.slack).sum())

    def _slope(self, step: Step) -> float:
        """Derivative of the merit along a step."""
        slacks = -self._rows.sign * self._rows.bound - self.parameter / self.point.slack
        return float((self.stages.models.gradient * joined(step.plan)).sum() + slacks @ step.slack)

    def _acceptable(self, tried: Iterate, part: float, slope: float) -> bool:
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

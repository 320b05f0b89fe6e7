"""The stages of a problem as quadratic models about a plan, and the step to the minimum of these models.

All constraints and control limits are rows of numbers, which must be >= 0 for an inequality and = 0 for an equality.
The plan need not satisfy the dynamics; a step closes the gaps between its states. The users of the stages decide what
to do with the rows: the interior point, the active set, and the restoration.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lqrsim.codegen.compiled_module import Call, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import plan_methods as kernel
from lqrsim.kernels.records import CostToGo, Motion, PlanStages, Policy, StageModels, StageRows
from lqrsim.kernels.stages import CONTROL, EQUALITY, INEQUALITY, KIND, LIMIT, PRICE, SIDE, SIGN, SIZE
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.solvers import compiled

FIRMNESS = 8.0  # penalty that makes a policy keep the constraints, in cost per squared row size


class Sizes(NamedTuple):
    """Typical sizes of states (n,), controls (m,) and constraint rows (R,), and of the cost of such changes."""

    states: Array
    controls: Array
    rows: Array
    cost: float


class Stages:
    """The stages of a problem: their models, with all constraints and control limits as rows.

    Attributes:
      live: (T+1, R) whether a row acts at a step. equality: (R,) whether a row must be zero. owners: (R,) the
        constraint to which a row belongs; -1 for limits. models: `records.StageModels` of the last plan; slopes (T+1,
        R, n+m) of its rows.
      force, held: (T+1, R) multipliers of the rows, and 1 for rows that an active set holds.
      limits: for each row that is a limit, its sign, the control, and the value of the limit.
      about: `records.PlanStages`, the argument of the kernels; it has the last step. work: memory of the methods, by
        their names.
    """

    def __init__(self, problem: Problem) -> None:
        n, m = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates)
        self.n, self.m, steps = n, m, problem.steps
        self._module = module_of(source_of(kernel), f"stages of {n} states and {m} controls", N=n, M=m)
        self._calls: dict[str, Call] = {}
        self.work: dict[str, Any] = {}
        zeros, terms = np.zeros, problem.constraint_terms
        counts = [term.rows for term in terms]
        rows = sum(counts) + sum(len(sides) for sides in _finite(problem))
        self.slopes, self.numbers = zeros((steps + 1, rows, n + m)), zeros((steps + 1, rows))
        self.force, self.held, self._live = (zeros((steps + 1, rows)) for _ in range(3))
        self.models = StageModels(
            zeros((steps + 1, n + m, n + m)), zeros((steps + 1, n + m, n + m)), zeros((steps + 1, n + m)),
            zeros((steps, n, n + m)), zeros((steps, n)), self.slopes.reshape(-1, n + m),
        )  # fmt: skip
        self.about = PlanStages(
            steps, 0, zeros(n), zeros(n), np.ones(n), np.ones(m), zeros(1), None,
            tuple(zeros((steps + 1) * count) for count in counts),
            StageRows(
                rows, zeros((rows, PRICE + 1)), np.cumsum([0, *counts])[:-1].astype(np.float64),
                zeros((rows, n + m)), *(one.reshape(-1) for one in (self._live, self.held, self.numbers, self.force)),
            ),
            self.models, Policy(zeros((steps, m, n)), zeros((steps, m))),
            CostToGo(zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1)),
            Motion(zeros((steps + 1, n)), zeros((steps, m))),
        )  # fmt: skip
        self._take(problem)
        for row, (sign, i, _) in enumerate(self.limits, start=sum(counts)):
            self.slopes[:steps, row, n + i] = sign

    def _take(self, problem: Problem) -> None:
        """Read a problem's numbers, and determine which rows can act."""
        self.problem, self.steps = problem, problem.steps
        fixed, steps, terms = isinstance(problem.initial, FixedState), problem.steps, problem.constraint_terms
        own = [compiled.ConstraintMultipliers(problem, term) for term in terms]
        model = compiled.arguments(problem, multipliers=own, second_order=True)
        self.low, self.high = model.limits
        lower, upper = _finite(problem)
        self.limits = [(1.0, i, self.low[i]) for i in lower] + [(-1.0, i, self.high[i]) for i in upper]
        counts = [*(term.rows for term in terms), len(self.limits)]
        self.equality = np.repeat([*(term.equality for term in terms), False], counts).astype(bool)
        self.owners = np.repeat([*range(len(terms)), -1], counts)
        self.live = np.ones((steps + 1, sum(counts)), dtype=bool)
        for k, one in enumerate(own):
            self.live[: one.first, self.owners == k] = False
            self.live[steps, self.owners == k] &= not one.term.uses_control
        self.live[steps, self.owners == -1] = False
        self._live[...] = self.live
        self.about = self.about._replace(steps=steps, soft=0 if fixed else 1, model=model)
        self.about.free[...], self.about.reach[...] = 0.0 if fixed else 1.0, 0.0
        if problem.goal is not None and problem.start is not None:
            self.about.reach[...] = np.abs(np.nan_to_num(problem.goal - problem.start))
        table = self.about.rows.table
        limit = self.owners == -1
        table[:, KIND] = np.where(self.equality, EQUALITY, np.where(limit, LIMIT, INEQUALITY))
        table[:, SIZE], table[:, PRICE] = 1.0, np.inf
        for row, (sign, i, side) in zip(np.flatnonzero(limit), self.limits, strict=True):
            table[row, [CONTROL, SIGN, SIDE]] = i, sign, side

    @property
    def free(self) -> Array:
        """(n,) 1 for the states of the start that are free, else 0."""
        return self.about.free

    def renewed(self, problem: Problem) -> "Stages":
        """The stages of another problem of the same structure, in this memory if sizes allow."""
        owners, limits, steps = self.owners, [one[:2] for one in self.limits], self.steps
        counts = [term.rows for term in problem.constraint_terms]
        lower, upper = _finite(problem)
        same = steps == problem.steps and [*lower, *upper] == [i for _, i in limits] and len(lower) == sum(
            sign > 0 for sign, _ in limits
        )
        if not same or not np.array_equal(owners[owners >= 0], np.repeat(np.arange(len(counts)), counts)):
            return Stages(problem)
        self._take(problem)
        self.about.rows.support[...] = 0.0
        return self

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a compiled function, reusing the layout of its arguments."""
        call = self._calls.get(name)
        if call is None:
            call = self._calls[name] = self._module.lay_out(name, *arguments)
        return call(*arguments)

    def values(self, plan: Motion) -> Array:
        """The rows' values (T+1, R); undefined for rows that do not act."""
        numbers = np.empty(self.live.shape)
        self.call("read_rows", self.about, _ordered(plan), numbers.reshape(-1))
        return numbers

    def trial(self, plan: Motion) -> tuple[float, Array]:
        """The cost of a plan, and the states at the ends of its steps, (T, n)."""
        arrived = np.empty((self.steps, self.n))
        return self.call("trial", self.about, _ordered(plan), arrived), arrived

    def linearize(self, plan: Motion, costates: Array, multipliers: Array, least: float) -> None:
        """Compute the models about a plan, with costates (T+1, n) and multipliers (T+1, R).

        Constraints with multipliers up to `least` count as linear.
        """
        self.force[...] = multipliers
        self.call("look", self.about, plan, costates, float(least))

    def least_curvatures(self, weights: Array, held: Array) -> Array | None:
        """The least curvature (m,) of each control along the plan; None unless the reduced Hessian is definite.

        Args:
          weights: (T+1, R) on rows that are held. held: (T, m) controls that stay at limits.
        """
        least = np.empty(self.m)
        good = self.call(
            "least_curvatures", self.about, in_c_order(weights).reshape(-1), in_c_order(held.astype(np.float64)), least
        )
        return least if good else None

    def sizes(self, plan: Motion) -> Sizes:
        """Typical sizes, estimated from a plan and the problem.

        Determines which rows act, and which variables each depends on, from slopes at the plan and near it.
        """
        return self.sized(self.call("survey", self.about, _ordered(plan)))

    def sizes_of(self, plan: Motion, hessian: Array) -> Sizes:
        """Typical sizes from the plan of the current models and the Hessians of its cost."""
        return self.sized(self.call("typical_sizes", self.about, plan, hessian))

    def sized(self, cost: float) -> Sizes:
        """The sizes that a kernel has just written, with the cost that it returned."""
        self.live[...] = self._live > 0
        about = self.about
        return Sizes(about.state_size.copy(), about.control_size.copy(), about.rows.table[:, SIZE].copy(), cost)

    def spread(self, rows: Array) -> Array:
        """Numbers of the live rows (K,) at their places in (T+1, R); others are zero."""
        spread = np.zeros(self.live.shape)
        spread[self.live] = rows
        return spread

    def of_constraints(self, numbers: Sequence[Array]) -> Array:
        """Numbers of each constraint (T+1, rows) at their places in (T+1, R); zero for limits, or if none are given."""
        rows = np.zeros(self.live.shape)
        for k, one in enumerate(numbers):
            rows[:, self.owners == k] = one
        return rows

    def of_each(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Numbers of the rows (R,) for each of the live rows, (K,)."""
        return np.broadcast_to(numbers, self.live.shape)[self.live]

    def adjoint(self) -> tuple[Array, Array]:
        """Costates (T+1, n) of the Lagrangian, and its slopes in the controls (T, m), with the current multipliers."""
        costates, slopes = np.zeros((self.steps + 1, self.n)), np.zeros((self.steps, self.m))
        self.call("adjoint", self.about, costates, slopes)
        return costates, slopes


def _finite(problem: Problem) -> tuple[list[int], list[int]]:
    """The controls with a lower limit, and those with an upper limit."""
    space = problem.control_coordinates
    lower, upper = (np.flatnonzero(np.isfinite(side)).tolist() for side in (space.low, space.high))
    return lower, upper


def _ordered(plan: Motion) -> Motion:
    """A plan in the order that kernels need."""
    return Motion(*map(in_c_order, plan))

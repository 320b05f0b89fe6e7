"""The stages of a problem as quadratic models about a plan, and the step to the minimum of these models.

All constraints and control limits are rows of numbers, which must be >= 0 for an inequality and = 0 for an equality.
The plan need not satisfy the dynamics; a step closes the gaps between its states. The users of the stages decide what
to do with the rows: the interior point, the active set, and the restoration.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lqrsim.codegen.compiled_module import Call, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import stages as kernel
from lqrsim.kernels.records import ActiveRows, ConstraintRows, CostToGo, Limits, Motion, Policy, StageModels
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.solvers import compiled

MIXES = (0.0, 0.03, 0.1, 0.25, 0.5, 1.0)  # fractions of the projected Hessian, tried in turn
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
      active: `records.ActiveRows`, for an active set. policy: gain and offset in the last step.
      free: (n,) whether a state of the start is free. limits: for each row that is a limit, its sign, the control, and
        the value of the limit.
    """

    def __init__(self, problem: Problem) -> None:
        n, m = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates)
        self.n, self.m, steps = n, m, problem.steps
        self._module = module_of(source_of(kernel), f"stages of {n} states and {m} controls", N=n, M=m)
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
        self.policy = Policy(np.zeros((steps, m, n)), np.zeros((steps, m)))
        arrays = (np.zeros(self.live.size) for _ in range(6))
        self.active = ActiveRows(rows, np.zeros((rows, 6)), *arrays)
        self.to_go = CostToGo(np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n)), np.zeros(steps + 1))
        self.changes = Motion(np.zeros((steps + 1, n)), np.zeros((steps, m)))

    def _take(self, problem: Problem) -> None:
        """Read a problem's numbers, and determine which rows can act."""
        self.problem, self.steps = problem, problem.steps
        fixed, steps = isinstance(problem.initial, FixedState), problem.steps
        self.free, self._soft = np.full(self.n, 0.0 if fixed else 1.0), 0 if fixed else 1
        terms = problem.constraint_terms
        own = [compiled.ConstraintMultipliers(problem, term) for term in terms]
        self._model = compiled.arguments(problem, multipliers=own, second_order=True)
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
        for k, one in enumerate(own):
            self.live[: one.first, self.owners == k] = False
            self.live[steps, self.owners == k] &= not one.term.uses_control
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

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call a compiled function, reusing the layout of its arguments."""
        call = self._calls.get(name)
        if call is None:
            call = self._calls[name] = self._module.lay_out(name, *arguments)
        return call(*arguments)

    def values(self, plan: Motion) -> Array:
        """The rows' values (T+1, R); undefined for rows that do not act."""
        numbers = np.empty(self.live.shape)
        if self._values:
            self._call("evaluate_constraints", self.steps, *plan, self._model.stage.constraints, self._values)
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
        """The cost of a plan, and the states at the ends of its steps, (T, n)."""
        plan, arrived = Motion(*map(in_c_order, plan)), np.empty((self.steps, self.n))
        return self._call("trial_cost", self.steps, self._soft, plan, self._model, arrived), arrived

    def linearize(
        self, plan: Motion, costates: Array, multipliers: Array, least: float, *, convex: bool = True
    ) -> None:
        """Compute the models about a plan, with costates (T+1, n) and multipliers (T+1, R).

        Constraints with multipliers up to `least` count as linear. `convex` is for the projected Hessians, too.
        """
        rows = self._rows._replace(least=float(least), multipliers=in_c_order(multipliers).reshape(-1))
        self._look(plan, costates, rows, self.active._replace(size=0))
        if convex:
            self.convexify(plan)

    def least_curvatures(self, hessian: Array, held: Array) -> Array | None:
        """The least curvature (m,) of each control along the plan; None unless the reduced Hessian is definite.

        Args:
          hessian: (T+1, n+m, n+m), with weights on rows that are held. held: (T, m) controls that stay at limits.
        """
        least = np.empty(self.m)
        good = self._call(
            "least_curvatures", self.steps, self.free, in_c_order(hessian), self.models.jacobian,
            in_c_order(held.astype(np.float64)), least,
        )  # fmt: skip
        return least if good else None

    def convexify(self, plan: Motion) -> None:
        """Compute the projected Hessians about a plan."""
        self._call("convex_models", self.steps, self._soft, plan, self._model, self.models)

    def sizes(self, plan: Motion) -> Sizes:
        """Typical sizes, estimated from a plan and the problem.

        Determines which rows act, and which variables each depends on, from slopes at the plan and near it.
        """
        self.live &= ~np.isposinf(self.values(plan))  # infinity means that a constraint does not act at that step
        wiggle = np.sin(1.0 + np.arange(self.n + self.m))
        nowhere, none = np.zeros((self.steps + 1, self.n)), np.zeros(self.live.shape)
        for far in (1e-3, 0.0):
            beside = Motion(plan.states + far * wiggle[: self.n], plan.controls + far * wiggle[self.n :])
            self.linearize(beside, nowhere, none, np.inf)
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

    def of_constraints(self, numbers: Sequence[Array]) -> Array:
        """Numbers of each constraint (T+1, rows) at their places in (T+1, R); zero for limits, or if none are given."""
        rows = np.zeros(self.live.shape)
        for k, one in enumerate(numbers):
            rows[:, self.owners == k] = one
        return rows

    def of_each(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Numbers of the rows (R,) for each of the live rows, (K,)."""
        return np.broadcast_to(numbers, self.live.shape)[self.live]

    def pull(self, rows: Array) -> Array:
        """The sum of the slopes (T+1, n+m) of the live rows times these numbers."""
        return np.matmul(self.spread(rows)[:, None, :], self.slopes)[:, 0, :]

    def curvature(self, rows: Array) -> Array:
        """The sum of slope times slope' (T+1, n+m, n+m) of the live rows times these numbers."""
        weighed = self.slopes * self.spread(rows)[:, :, None]
        return np.matmul(weighed.transpose(0, 2, 1), self.slopes)

    def follow(self, plan: Motion, part: float, policy: Policy, limits: Limits) -> Motion:
        """Roll out a fraction of a step in closed loop; see the kernel."""
        out = Motion(np.empty((self.steps + 1, self.n)), np.empty((self.steps, self.m)))
        self._call("closed_loop_rollout", self.steps, float(part), plan, policy, limits, self._model, out)
        return out

    def adjoint(self, gradient: Array) -> tuple[Array, Array]:
        """Costates (T+1, n) of stages with these gradients (T+1, n+m), and their slopes in the controls (T, m)."""
        costates, slopes = np.zeros((self.steps + 1, self.n)), np.zeros((self.steps, self.m))
        self._call("adjoint", self.steps, gradient, self.models.jacobian, costates, slopes)
        return costates, slopes

    def direction(self, hessian: Array, gradient: Array, gaps: Array) -> bool:
        """Compute the step to the minimum of the models, and the costates there; return whether there is a minimum."""
        models = self.models._replace(hessian=in_c_order(hessian), gradient=in_c_order(gradient))
        return self.pivot(in_c_order(gaps), models, self.active._replace(size=0))[0]

    def hessians(self, barrier: Array, weights: Iterable[Array]) -> Iterator[Array]:
        """Hessians (T+1, n+m, n+m) of the Lagrangian with a barrier, to be tried in turn until one has a minimum.

        First mixed with those of the projected cost, by `MIXES`; then these with weights (m,) on changes of controls.
        """
        exact, convex = self.models.hessian, self.models.convex
        for mix in MIXES:
            yield (exact if mix == 0 else (1 - mix) * exact + mix * convex) + barrier
        diagonal = np.arange(self.n, self.n + self.m)
        for weight in weights:
            heavier = convex + barrier
            heavier[:, diagonal, diagonal] += weight
            yield heavier

    def moved(self) -> Array:
        """The changes of the live rows' values, (K,)."""
        return np.matmul(self.slopes, joined(self.changes)[:, :, None])[:, :, 0][self.live]

    def look(self, plan: Motion, costates: Array, *, own: bool = False) -> float:
        """Compute the models about a plan, and the margins of the rows; return its cost. See the kernel."""
        rows = self._rows._replace(least=0.0, multipliers=self.active.force)
        return self._look(plan, costates, rows, self.active, own=own)

    def _look(
        self, plan: Motion, costates: Array, rows: ConstraintRows, active: ActiveRows, *, own: bool = False
    ) -> float:
        return self._call(
            "linearize_plan", self.steps, self._soft, int(own), plan, costates, self._model, self._values, rows,
            self.models, active,
        )  # fmt: skip

    def measure(self, plan: Motion, gaps: Array, sizes: Sizes) -> tuple[float, ...]:
        """Residuals of the plan of the current models; writes its gaps. See the kernel."""
        of = plan, self.models, gaps, self.active, sizes.states, sizes.controls
        return self._call("optimality_measures", self.steps, *of)

    def pivot(
        self, gaps: Array, models: StageModels | None = None, rows: ActiveRows | None = None, *,
        share: float = 0.0, scale: float = 1.0, weight: float = 1.0, price: float = 1.0,
    ) -> tuple[bool, int]:  # fmt: skip
        """`direction` with fixed rows; also returns the number of wrong rows. See the kernel."""
        models, rows = self.models if models is None else models, self.active if rows is None else rows
        failed, wrong = self._call(
            "pivot", self.steps, self.free, share, scale, weight, price, models, gaps, rows, self.policy, self.to_go,
            self.changes,
        )  # fmt: skip
        return failed == -1, wrong

    def change(self, *, worst: bool) -> None:
        """Change which rows are fixed; see the kernel."""
        self._call("update_active_set", self.steps, int(worst), self.active)

    def carry_out(self, plan: Motion, gain: Array) -> tuple[Motion, float, list[Array]]:
        """Roll out a plan with gains (T, m, n) about it; return the trajectory, its cost and the constraints' values.

        Controls are set to the limits that are fixed, and have no gain there.
        """
        out = Motion(np.empty_like(plan.states), np.empty_like(plan.controls))
        limits = Limits(*(np.tile(side, (self.steps, 1)) for side in (self.low, self.high)))
        policy = self.policy._replace(gain=gain)
        cost = self._call(
            "rollout_of_active_set", self.steps, self._soft, plan, policy, limits, self.active, self._model,
            self._values, out,
        )  # fmt: skip
        return out, cost, [one.reshape(self.steps + 1, -1) for one in self._values]


def joined(changes: Motion) -> Array:
    """Changes of states and controls side by side, (T+1, n+m)."""
    n, m = changes.states.shape[1], changes.controls.shape[1]
    both = np.zeros((len(changes.states), n + m))  # the last knot has no control
    both[:, :n], both[:-1, n:] = changes.states, changes.controls
    return both

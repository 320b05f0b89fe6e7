"""Gradients of an optimum in parameters of the problem, without solving again.

By the envelope theorem the gradient of the optimal cost is the partial derivative of the Lagrangian,

    L = cost + sum_t costate_{t+1}' (g(x_t, u_t) - x_{t+1}) - sum multiplier * row + costate_0' (start - x_0),

with plan and multipliers held. The rows are those of constraints and control limits; the last term is that of a fixed
start. The gradient of the plan is the minimum of the second-order model of L about it, in which the rows that act stay
at zero: a linear-quadratic problem. What a parameter changes is found by differences of the problem's values and slopes
along the plan, so it may be any number of the problem.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Line, Want, checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array, InputError, check_array, check_kind
from lqrsim.kernels.records import Motion
from lqrsim.machine import other_lqrsim
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Curvature, Status
from lqrsim.solvers.budget import check_threads
from lqrsim.solvers.certify import AT_ZERO, HELD
from lqrsim.solvers.stages import Stages

# Step of the differences, relative to a parameter's scale. The error of a central difference is about its square, that
# of rounding is 1e-16 of the cost divided by it: both are below 1e-8 where the cost changes in proportion.
STEP = 1e-4
SMALLEST = 1e-3  # least scale by default; with that of a number next to zero, differences would be of rounding
# A row's value relative to its size, and its multiplier times that relative to the typical cost of changes at one step,
# that are next to zero. A control has both within this part of its range of where it leaves its limit.
NEAR = 1e-3
SWEEPS = 3  # that hold the rows; each leaves about 1 / HELD of the error of the one before


@checked
@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of an optimum in P parameters; see `gradients`.

    Attributes:
      cost: (P,) of the optimal cost, per unit of each parameter.
      error: (P,) estimated error of `cost` by the differences. What the plan itself is off its optimum adds in
        proportion: a solve to a smaller `tolerance` lowers that.
      changing: names and steps of inequalities and control limits that are about to become active or inactive: both the
        value and the multiplier are next to zero. The gradient of the cost is continuous there, that of the plan jumps.
      states: (T+1, n, P) of the plan's states; None unless asked for.
      controls: (T, m, P) of its controls; None unless asked for.
    """

    cost: Annotated[Array, "P", Bounds()]
    error: Annotated[Array, "P", Bounds(at_least=0.0)]
    changing: tuple[Line, ...]
    states: Annotated[Array, "T+1 n P", Bounds()] | None = None
    controls: Annotated[Array, "T m P", Bounds()] | None = None


@checked
def gradients(
    make: Annotated[Callable[[Array], Problem], Want("a function of the parameters that returns a Problem")],
    at: npt.ArrayLike,
    solution: Solution,
    *,
    plan: bool = False,
    scale: npt.ArrayLike | None = None,
) -> Gradients:
    """The gradient of the optimal cost in parameters of any kind: of dynamics, goal, weights, start, obstacles, limits.

    Nothing is solved again: `make` is called four times for each parameter, and its costs, steps and constraints are
    evaluated along the plan. With `plan`, the gradients of states and controls follow by one linear-quadratic solve.
    Active constraints and limits stay active. With `elastic` constraints the cost includes the price of violations.

    Args:
      make: returns the problem for parameters (P,), always with the same sizes and the same kinds of limits and
        constraints.
      at: (P,) the parameters.
      solution: the CONVERGED solution of `make(at)`. It may be a local optimum; the gradients are those of this one.
      plan: whether to find the gradients of states and controls, too. The solution's curvature must be a MINIMUM, which
        is not known for robots from an MJCF.
      scale: (P,) typical changes of the parameters; by default their sizes, at least 1e-3 each.

    Raises:
      InputError: the problem has noise, rates, a free duration, `accuracy=` or `between_knots=True`, the plan is at the
        edge of its contact modes, or limits of forces were refined within its periods.
    """
    point = check_array("at", at, (None,))
    if not len(point):
        raise InputError("at: got no numbers, want one at least")
    sizes = np.maximum(np.abs(point), SMALLEST) if scale is None else check_array("scale", scale, point.shape)
    if not (sizes > 0).all():
        raise InputError(f"scale: got {sizes.min():g}, want numbers above 0")
    if solution.status is not Status.CONVERGED:
        raise InputError(f"solution: got one that is {solution.status.name}, want a CONVERGED one")
    if solution.certificate.contacts is not None:
        raise InputError("solution: got a plan at the edge of its contact modes, want one within them")
    if plan and solution.curvature is not Curvature.MINIMUM:
        got = solution.curvature.name
        raise InputError(f"plan: got a solution whose curvature is {got}, want MINIMUM, or plan=False")
    problem = _problem_at(make, point)
    if problem.accuracy is not None or problem.between_knots:
        raise InputError("make: got a problem with accuracy= or between_knots=True, want one with neither")
    if problem.digest != solution.problem_digest:
        how = other_lqrsim(solution.versions) or "limits of forces refined"
        raise InputError(f"solution: got one of another problem, or with {how}, want that of make(at)")
    optimum = _Optimum(problem, solution)

    def difference(k: int, step: float) -> list[Array]:
        forward, backward = point.copy(), point.copy()
        forward[k] += step
        backward[k] -= step
        above, below = (optimum.values(_problem_at(make, parameters), plan) for parameters in (forward, backward))
        return [(upper - lower) / (forward[k] - backward[k]) for upper, lower in zip(above, below, strict=True)]

    columns, errors = [], []
    for k, size in enumerate(sizes):
        wide, narrow = difference(k, STEP * size), difference(k, STEP / 2 * size)
        # Of the error, what is of second order is taken out; so its estimate is above what remains.
        columns.append([(4 * fine - coarse) / 3 for fine, coarse in zip(narrow, wide, strict=True)])
        errors.append(abs(float(narrow[0] - wide[0])) / 3)
    partials = [np.stack(derivatives, axis=-1) for derivatives in zip(*columns, strict=True)]
    moves = optimum.sensitivities(*partials[1:]) if plan else (None, None)
    return Gradients(partials[0], np.array(errors), optimum.changing, *moves)


def _problem_at(make: Callable[[Array], Problem], point: Array) -> Problem:
    """The problem for parameters (P,). Raises InputError for one whose optimal cost depends on more than the plan."""
    problem = check_kind("make", make(point.copy()), Problem, "a function that returns a Problem")
    if problem.noise is not None:
        raise InputError("make: got a problem with noise, want one without, whose cost does not depend on the policy")
    if problem.control_rate is not None:
        raise InputError("make: got a problem with control_rate, want one without, such as a ControlCost instead")
    if problem.duration is not None:
        raise InputError("make: got a free duration, want duration=None, time_weight=0.0 and the dt of the solution")
    return problem


class _Optimum:
    """A plan with its multipliers, which are held while a problem's parameters change."""

    def __init__(self, problem: Problem, solution: Solution) -> None:
        states, controls = map(in_c_order, (solution.trajectory.states, solution.trajectory.controls))
        self._ilqr = solution.solver == "ilqr"
        self._plan, self._stages = Motion(states, controls), Stages(self._begun(problem))
        stages, unknown = self._stages, np.zeros_like(states)
        self._forces = forces = stages.of_constraints([multipliers.values for multipliers in solution.multipliers])
        with problem.dynamics.solving(check_threads(None)):
            self._sizes = sizes = stages.sizes(self._plan)
            stages.linearize(self._plan, unknown, forces, np.inf)
        self._costates, slopes = stages.adjoint()  # which need no multipliers of control limits
        for row, (sign, i, side) in zip(np.flatnonzero(stages.owners == -1), stages.limits, strict=True):
            forces[:-1, row] = np.where(controls[:, i] == side, np.maximum(sign * slopes[:, i], 0.0), 0.0)
        numbers = stages.values(self._plan)
        missed = np.where(stages.equality, np.abs(numbers), -numbers) > AT_ZERO * sizes.rows  # elastic, at their price
        self._held = stages.live & ~missed & (stages.equality | (forces > 0))
        small = (numbers <= NEAR * sizes.rows) & (forces * sizes.rows <= NEAR * sizes.cost / (stages.steps + 1))
        weak = np.argwhere(stages.live & ~stages.equality & small)
        self.changing = tuple(f"{_described(stages, row)} at step {t}" for t, row in weak.tolist())

    def _begun(self, problem: Problem) -> Problem:
        """The problem with the start that the solver had: iLQR begins where the initial cost is least."""
        return problem.from_state(problem.start) if self._ilqr and problem.start is not None else problem

    def values(self, problem: Problem, full: bool) -> list[Array]:
        """For another problem, the Lagrangian; and if `full`, the start (n,), the ends of the steps (T, n), the rows
        that act (T+1, R), and the slopes of the Lagrangian (T+1, n+m). Raises InputError for one of other sizes.
        """
        problem = self._begun(problem)
        stages, states = Stages.lent(problem), self._plan.states
        if (stages.steps, *stages.owners) != (self._stages.steps, *self._stages.owners) or stages.n != states.shape[1]:
            raise InputError("make: got problems of other sizes, limits or constraints beside `at`, want the same")
        start = problem.initial.numbers if isinstance(problem.initial, FixedState) else states[0]
        with problem.dynamics.quiet():
            cost, arrived = stages.trial(self._plan)
            rows = np.where(self._held | (self._forces != 0), stages.values(self._plan), 0.0)
            if full:
                stages.linearize(self._plan, self._costates, self._forces, np.inf)
        cost += (self._costates[0] @ (start - states[0])) - (self._forces * rows).sum()
        parts = [np.array(cost + (self._costates[1:] * (arrived - states[1:])).sum())]
        if full:
            slopes = stages.models.gradient - np.einsum("tr,trw->tw", self._forces, stages.slopes)
            slopes[:-1] += np.einsum("tn,tnw->tw", self._costates[1:], stages.models.jacobian)
            parts += [np.array(start), arrived, rows, slopes]
        stages.give_back()
        return parts

    def sensitivities(self, start: Array, arrived: Array, rows: Array, slopes: Array) -> tuple[Array, Array]:
        """The gradients of states (T+1, n, P) and controls (T, m, P), from those of `values`."""
        stages, n = self._stages, self._stages.n
        stages.linearize(self._plan, self._costates, self._forces, 0.0)
        jacobian, across = stages.models.jacobian, np.where(self._held[:, :, None], stages.slopes, 0.0)
        weights = HELD * self._sizes.cost / self._sizes.rows**2
        hessian = stages.models.hessian + np.einsum("r,tri,trj->tij", weights, across, across)
        free, forces = stages.free > 0, np.zeros_like(rows)
        curves, gains, blocks = [hessian[-1][:n, :n]], [], []
        for t in reversed(range(stages.steps)):
            both = hessian[t] + jacobian[t].T @ curves[-1] @ jacobian[t]
            blocks.append(both[n:, n:])
            gains.append(-np.linalg.solve(both[n:, n:], both[n:, :n]))
            curves.append(both[:n, :n] + both[:n, n:] @ gains[-1])
        curves, gains, blocks = curves[::-1], gains[::-1], blocks[::-1]
        states = np.zeros((stages.steps + 1, *start.shape))
        controls = np.zeros((stages.steps, stages.m, start.shape[1]))
        for _ in range(SWEEPS):
            # With the multipliers of the sweep before, the rows get nearer to zero.
            gradient = slopes + np.einsum("tri,trp->tip", across, weights[:, None] * rows + forces)
            costate, offsets = gradient[-1][:n], []
            for t in reversed(range(stages.steps)):
                both = gradient[t] + jacobian[t].T @ (curves[t + 1] @ arrived[t] + costate)
                offsets.append(-np.linalg.solve(blocks[t], both[n:]))
                costate = both[:n] + gains[t].T @ both[n:]
            states[0] = start
            states[0, free] = -np.linalg.solve(curves[0][np.ix_(free, free)], costate[free])
            for t, offset in enumerate(reversed(offsets)):
                controls[t] = gains[t] @ states[t] + offset
                states[t + 1] = jacobian[t] @ np.concatenate([states[t], controls[t]]) + arrived[t]
            changes = np.concatenate([states, np.append(controls, np.zeros_like(controls[:1]), axis=0)], axis=1)
            forces += weights[:, None] * (np.einsum("tri,tip->trp", across, changes) + rows)
        return states, controls


def _described(stages: Stages, row: int) -> str:
    owner, first = stages.owners[row], int(np.argmax(stages.owners == stages.owners[row]))
    if owner >= 0:
        return stages.problem.constraint_terms[owner].describe(row - first)
    sign, i, side = stages.limits[row - first]
    name = stages.problem.control_coordinates.names[i]
    return f"{name} of {'at least' if sign > 0 else 'at most'} {side:g}"

"""The stages of a problem as quadratic models about a plan, and the step to the minimum of these models.

All constraints and control limits are rows of numbers, which must be >= 0 for an inequality and = 0 for an equality.
The plan need not satisfy the dynamics; a step closes the gaps between its states. The users of the stages decide what
to do with the rows: the interior point, the active set, and the restoration.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from lqrsim.codegen.compiled_module import Call, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import iterations, records
from lqrsim.kernels.interior_point import LATELY
from lqrsim.kernels.records import ACTIVE_SET, INTERIOR, RESTORATION, Motion, StructuredArray, zeros_of
from lqrsim.kernels.stages import CONTROL, EQUALITY, INEQUALITY, LIMIT, LINEAR, RANGE, SIDE, SIGN
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.solvers import compiled

MOST_KEPT, LARGEST_KEPT = 16, 8 * 1024 * 1024  # memories that are kept for later solves, and largest size in bytes
M = TypeVar("M")


class Pool(Generic[M]):
    """Memories that were given back, for later solves, because allocating takes time."""

    def __init__(self) -> None:
        self._idle, self._lock = list[M](), threading.Lock()

    def take(self, fits: Callable[[M], bool]) -> M | None:
        """The memory that was given back last and fits; None if there is none."""
        with self._lock:
            memory = next((idle for idle in reversed(self._idle) if fits(idle)), None)
            if memory is not None:
                self._idle.remove(memory)
        return memory

    def give_back(self, memory: M, problem: Problem) -> None:
        """Keep a memory of a solve of this problem, unless it is too large."""
        if problem.steps * problem.bytes_per_step <= LARGEST_KEPT:
            with self._lock:
                self._idle.append(memory)
                del self._idle[:-MOST_KEPT]


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
      free: (n,) 1 for the states of the start that are free, else 0. row_sizes: (R,) typical sizes of the rows.
      about: `records.PlanStages`, the argument of the kernels; it has the last step.
    """

    def __init__(self, problem: Problem) -> None:
        self._shape = n, m, steps, counts, lower, upper = _shape(problem)
        rows, self.n, self.m = sum(counts) + len(lower) + len(upper), n, m
        self._lengths = {"T": steps, "N": n, "M": m, "W": n + m, "R": rows, "K": (steps + 1) * rows, "C": len(counts)}
        self._module = module_of(source_of(iterations), f"stages of {n} states and {m} controls", N=n, M=m)
        self._calls: dict[str, Call] = {}
        stage_rows = zeros_of(records.StageRows, {"size": rows}, **self._lengths)
        stage_rows.limits[...], stage_rows.first[...] = np.inf, np.cumsum([0, *counts])[:-1]
        values = tuple(np.zeros((steps + 1) * count) for count in counts)
        stated = {"steps": steps, "soft": 0, "learns": 0, "model": None, "values": values, "rows": stage_rows}
        self.about = zeros_of(records.PlanStages, stated, **self._lengths)
        self.about.state_size[...], self.about.control_size[...] = 1.0, 1.0
        self.models = self.about.models
        self.slopes = self.models.slopes.reshape(steps + 1, rows, n + m)
        by_step = (array.reshape(steps + 1, rows) for array in stage_rows[4:])
        self._acts, self._live, self.held, self._kinds, *others = by_step
        self._sizes, self._targets, self._prices, _, self.force = others
        self.free, self.row_sizes = self.about.free, self._sizes[0]
        self._read_problem(problem)
        for row, (sign, i, _) in enumerate(self.limits, start=sum(counts)):
            self.slopes[:steps, row, n + i] = sign
        if problem.constraint_terms:
            self.prepare()

    def _read_problem(self, problem: Problem) -> None:
        """Read a problem's numbers, and determine which rows can act."""
        self.problem, self.steps = problem, problem.steps
        fixed, steps, terms = isinstance(problem.initial, FixedState), problem.steps, problem.constraint_terms
        acting = [compiled.ConstraintMultipliers(problem, term) for term in terms]
        # Without noise, of which stages know nothing: memory of problems with and without it would differ.
        model = compiled.compile_problem(problem, multipliers=acting, second_order=True)._replace(noise=())
        self.low, self.high = model.limits
        *_, lower, upper = self._shape
        self.limits = [(1.0, i, self.low[i]) for i in lower] + [(-1.0, i, self.high[i]) for i in upper]
        counts = [*(term.rows for term in terms), len(self.limits)]
        self.equality = np.repeat([*(term.equality for term in terms), False], counts).astype(bool)
        self.owners = np.repeat([*range(len(terms)), -1], counts)
        self.live = np.ones((steps + 1, sum(counts)), dtype=bool)
        for k, constraint in enumerate(acting):
            self.live[: constraint.first, self.owners == k] = False
            self.live[steps, self.owners == k] &= not constraint.term.uses_control
        self.live[steps, self.owners == -1] = False
        self._acts[...] = self._live[...] = self.live
        self.about = self.about._replace(
            steps=steps, soft=0 if fixed else 1, learns=int(problem.dynamics.by_mujoco), model=model
        )
        self.about.uses_learned[...], self.about.reuses_derivatives[...] = 0.0, 0.0
        self.about.free[...], self.about.reach[...] = 0.0 if fixed else 1.0, 0.0
        self.about.jumps[...] = 0.0
        units = problem.dynamics.state_coordinates.units
        self.about.unit[...] = [units.index(unit) if unit else i for i, unit in enumerate(units)]
        if problem.goal is not None and problem.start is not None:
            self.about.reach[...] = np.abs(np.nan_to_num(problem.goal - problem.start))
        limit = self.owners == -1
        self._kinds[...] = np.where(self.equality, EQUALITY, np.where(limit, LIMIT, INEQUALITY))
        self._sizes[...], self._prices[...] = 1.0, np.inf
        for k, term in enumerate(terms):
            self.about.rows.limits[self.owners == k, RANGE] = np.inf if term.ranges is None else term.ranges
            self.about.rows.limits[self.owners == k, LINEAR] = term.linear
        for row, (sign, i, side) in zip(np.flatnonzero(limit), self.limits, strict=True):
            self.about.rows.limits[row, [CONTROL, SIGN, SIDE]] = i, sign, side

    def state(self, *, price: float | Array | None = None, margin: float | None = None) -> None:
        """State prices of violations, in cost per unit, for all or each of the rows; or a margin. Limits have none."""
        limit = self.owners == -1
        if price is not None:
            self._prices[...] = np.where(limit, np.inf, price)
        if margin is not None:
            self._targets[...] = np.where(limit | self.equality, 0.0, margin)

    def jump(self, knots: Sequence[int]) -> None:
        """Let the last state jump at some knots, each after the first."""
        self.about.jumps[list(knots)] = 1.0

    @classmethod
    def lent(cls, problem: Problem) -> "Stages":
        """The stages of a problem, if possible in memory that was given back."""
        shape = _shape(problem)
        stages = _pool.take(lambda idle: idle._shape == shape)
        if stages is None:
            return cls(problem)
        stages._read_problem(problem)
        stages.about.rows.support[...] = 0.0
        return stages

    def give_back(self) -> None:
        _pool.give_back(self, self.problem)

    def prepare(self) -> None:
        """Compile what a solve needs of the stages, with the interior point, together."""
        about, plan = self.about, self.about.changes
        arrays, memory = self.interior
        begun = records.PlanBeginning(plan, about.rows.force, False, 0.0, 0.0, 0.0)
        costates, slopes = about.to_go.gradient, plan.controls
        self._module.prepare(
            interior_point=(0, 0, 0, 0.0, 0.0, begun, about, arrays, memory, np.zeros(0, records.MEASURES)),
            determine_scales=(about, plan), write_models=(True, about, plan, costates, 0.0),
            adjoint=(about, costates, slopes), evaluate_plan=(about, plan, about.models.arrived),
            read_rows=(about, plan, about.rows.numbers),
            least_curvatures=(about, about.rows.force, slopes, slopes[0]),
        )  # fmt: skip

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a compiled function, reusing the layout of its arguments."""
        if name not in self._calls:
            self._calls[name] = self._module.lay_out(name, *arguments)
        return self._calls[name](*arguments)

    def values(self, plan: Motion) -> Array:
        """The rows' values (T+1, R); undefined for rows that do not act."""
        numbers = np.empty(self.live.shape)
        self.call("read_rows", self.about, Motion(*map(in_c_order, plan)), numbers.reshape(-1))
        return numbers

    def trial(self, plan: Motion) -> tuple[float, Array]:
        """The cost of a plan, and the states at the ends of its steps, (T, n)."""
        arrived = np.empty((self.steps, self.n))
        return self.call("evaluate_plan", self.about, Motion(*map(in_c_order, plan)), arrived), arrived

    def linearize(self, plan: Motion, costates: Array, multipliers: Array, least: float) -> None:
        """Compute the models about a plan; constraints with multipliers (T+1, R) up to `least` count as linear."""
        self.force[...] = multipliers
        self.call("write_models", True, self.about, plan, costates, float(least))

    def least_curvatures(self, weights: Array, held: Array) -> Array | None:
        """The least curvature (m,) of each control along the plan; None unless the reduced Hessian is definite.

        Rows are held by weights (T+1, R), controls (T, m) at limits.
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
        return self.sized(self.call("determine_scales", self.about, Motion(*map(in_c_order, plan))))

    def sized(self, cost: float) -> Sizes:
        """The sizes that a kernel has just written, with the cost that it returned."""
        self.live[...] = self._live > 0
        about = self.about
        return Sizes(about.state_size.copy(), about.control_size.copy(), self.row_sizes.copy(), cost)

    def resize(self, sizes: Sizes) -> None:
        self.about.state_size[...], self.about.control_size[...] = sizes.states, sizes.controls
        self._sizes[...] = sizes.rows

    def of_constraints(self, numbers: Sequence[Array]) -> Array:
        """Numbers of each constraint (T+1, rows) at their places in (T+1, R); zero for limits, or if none are given."""
        rows = np.zeros(self.live.shape)
        for k, values in enumerate(numbers):
            rows[:, self.owners == k] = values
        return rows

    def by_constraint(self, rows: Array) -> list[Array]:
        """Copies of the constraints' parts, (T+1, rows) each, of numbers (T+1, R)."""
        return [rows[:, self.owners == k].copy() for k in range(len(self.problem.constraint_terms))]

    def adjoint(self, gain: Array | None = None) -> tuple[Array, Array]:
        """Costates (T+1, n) of the Lagrangian, and its slopes in the controls (T, m), with the current multipliers.

        The gains (T, m, n) of a policy about a stationary plan keep rounding from growing where dynamics are unstable.
        """
        self.about.policy.gain[...] = 0.0 if gain is None else gain
        costates, slopes = np.zeros((self.steps + 1, self.n)), np.zeros((self.steps, self.m))
        self.call("adjoint", self.about, costates, slopes)
        return costates, slopes

    # The memory of the methods; solves of one structure use it in turn.

    @functools.cached_property
    def active_set(self) -> tuple[records.ActiveSetArrays, StructuredArray]:
        """Arrays of an active set, and its state between calls."""
        return zeros_of(records.ActiveSetArrays, **self._lengths), np.zeros(1, ACTIVE_SET)

    @functools.cached_property
    def interior(self) -> tuple[records.InteriorArrays, StructuredArray]:
        active, memory = self.active_set
        crossover = {"active": active, "active_memory": memory}
        return zeros_of(records.InteriorArrays, crossover, **self._lengths, LATELY=LATELY), np.zeros(1, INTERIOR)

    @functools.cached_property
    def restoration(self) -> tuple[records.RestorationArrays, StructuredArray]:
        return zeros_of(records.RestorationArrays, **self._lengths), np.zeros(1, RESTORATION)


_pool = Pool[Stages]()
_Shape = tuple[int, int, int, tuple[int, ...], tuple[int, ...], tuple[int, ...]]


def _shape(problem: Problem) -> _Shape:
    """Numbers of states, controls and steps; rows of each constraint; the controls with lower and upper limits."""
    space, counts = problem.control_coordinates, tuple(term.rows for term in problem.constraint_terms)
    lower, upper = (tuple(np.flatnonzero(np.isfinite(side)).tolist()) for side in (space.low, space.high))
    return len(problem.dynamics.state_coordinates), len(space), problem.steps, counts, lower, upper

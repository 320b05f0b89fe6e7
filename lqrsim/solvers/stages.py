"""The stages of a problem as quadratic models about a plan, and the methods of `kernels/` that step on them.

All constraints and control limits are rows of numbers, which must be >= 0 for an inequality and = 0 for an equality.
The plan need not satisfy the dynamics; a step closes the gaps between its states. What to do with the rows is left to
the methods: the interior point, the active set, and the restoration. The interior point and the restoration run in
slices between which their caller is told, an active set in pieces short enough for a deadline.
"""

import functools
import threading
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from lqrsim.codegen.compiled_module import Call, CompiledModule, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import active_set, interior_point, records, restoration
from lqrsim.kernels.declarations import CONVERGED, NO_PROGRESS, NOT_FINITE, RUNNING
from lqrsim.kernels.interior_point import BEGIN, CLOSE, FLAT_BEFORE_END, ITERATE, LATELY, POLISH, SCALE
from lqrsim.kernels.records import Motion, StructuredArray, zeros_of
from lqrsim.kernels.stages import CONTROL, EQUALITY, INEQUALITY, LIMIT, LINEAR, RANGE, SIDE, SIGN
from lqrsim.problem.derivative_check import functions_of
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import Multipliers, Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import ATTENTION, Laps, in_slices
from lqrsim.solvers.settings import INSIDE

MOST_KEPT, LARGEST_KEPT = 16, 8 * 1024 * 1024  # memories that are kept for later solves, and largest size in bytes
# Iterations in which the cost has changed by less than rounding, relative to itself, so that no slope is left.
ROUNDING_ITERATIONS, ROUNDING = 50, 1e-10
NAME = "interior point"  # name of its iterations in the log
STEPS = 12  # largest number of steps of an active set: a solve that needs more does not converge
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
        self._calls: dict[str, Call] = {}
        stage_rows = zeros_of(records.StageRows, {"size": rows}, **self._lengths)
        stage_rows.limits[...], stage_rows.first[...] = np.inf, np.cumsum([0, *counts])[:-1]
        values = tuple(np.zeros((steps + 1) * count) for count in counts)
        stated = {"steps": steps, "learns": 0, "model": None, "values": values, "rows": stage_rows}
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
        self.about = self.about._replace(steps=steps, learns=int(problem.dynamics.by_mujoco), model=model)
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

    def set_prices_and_margins(self, *, price: float | Array | None = None, margin: float | None = None) -> None:
        """Set prices of violations, in cost per unit, for all or each of the rows; or a margin. Limits have none."""
        limit = self.owners == -1
        if price is not None:
            self._prices[...] = np.where(limit, np.inf, price)
        if margin is not None:
            self._targets[...] = np.where(limit | self.equality, 0.0, margin)

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
        self._module("interior_point").prepare(
            interior_point=(0, 0, 0, 0.0, 0.0, begun, about, arrays, memory, np.zeros(0, records.MEASURES)),
            determine_scales=(about, plan), write_models=(True, about, plan, costates, 0.0),
            adjoint=(about, costates, slopes), evaluate_plan=(about, plan, about.models.arrived),
            read_rows=(about, plan, about.rows.numbers),
            least_curvatures=(about, about.rows.force, slopes, slopes[0]),
        )  # fmt: skip

    def _module(self, name: str) -> CompiledModule:
        """The kernels of a method; those of the interior point have what others need, too."""
        kernel = {"active_set": active_set, "restoration": restoration}.get(name, interior_point)
        return module_of(source_of(kernel), f"stages of {self.n} states and {self.m} controls", N=self.n, M=self.m)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a compiled function, reusing the layout of its arguments."""
        if name not in self._calls:
            self._calls[name] = self._module(name).lay_out(name, *arguments)
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
        return zeros_of(records.ActiveSetArrays, **self._lengths), np.zeros(1, records.ACTIVE_SET)

    @functools.cached_property
    def interior(self) -> tuple[records.InteriorArrays, StructuredArray]:
        active, memory = self.active_set
        crossover = {"active": active, "active_memory": memory}
        return zeros_of(records.InteriorArrays, crossover, **self._lengths, LATELY=LATELY), np.zeros(
            1, records.INTERIOR
        )

    @functools.cached_property
    def restoration(self) -> tuple[records.RestorationArrays, StructuredArray]:
        return zeros_of(records.RestorationArrays, **self._lengths), np.zeros(1, records.RESTORATION)


_pool = Pool[Stages]()
_Shape = tuple[int, int, int, tuple[int, ...], tuple[int, ...], tuple[int, ...]]


def _shape(problem: Problem) -> _Shape:
    """Numbers of states, controls and steps; rows of each constraint; the controls with lower and upper limits."""
    space, counts = problem.control_coordinates, tuple(term.rows for term in problem.constraint_terms)
    lower, upper = (tuple(np.flatnonzero(np.isfinite(side)).tolist()) for side in (space.low, space.high))
    return len(problem.dynamics.state_coordinates), len(space), problem.steps, counts, lower, upper


class Measures(NamedTuple):
    """Residuals of a plan."""

    cost: float
    stationarity: float  # largest slope of the Lagrangian in a control, times its range, relative to the cost
    violation: float  # of the worst constraint, in its unit
    gap: float  # the largest between two steps, relative to the states' ranges
    complementarity: float  # the largest product of a multiplier and its margin, relative to the cost

    @classmethod
    def of(cls, memory: StructuredArray) -> "Measures":
        """Those that compiled code left in its memory."""
        return cls(*(float(memory[name][0]) for name in cls._fields))

    def record(self, laps: Laps, method: str = NAME, seconds: float | None = None) -> None:
        """Record the residuals as those of an iteration; by default it took all the time since the last one."""
        optimality = max(self.stationarity, self.complementarity)
        laps.record(method, self.cost, optimality=optimality, gap=self.gap, violation=self.violation, seconds=seconds)


class Barrier(NamedTuple):
    """The barrier with which an interior point begins."""

    parameter: float  # of each row, as a fraction of the cost divided by the number of rows
    slack: float  # the least, relative to a row's size, or to a control's range


# For plans that are far from an optimum, for those with a duration that is found now, and next to an optimum.
STRONG, MEDIUM, WEAK = Barrier(1.0, 0.06), Barrier(1.0, 0.02), Barrier(0.01, 0.01)


@dataclass(kw_only=True, eq=False)
class InteriorResult:
    """Result of a run."""

    plan: Motion  # if `solved`, feasible except for gaps
    gain: Array  # (T, m, n) about it
    measures: Measures
    multipliers: tuple[Array, ...]  # of each constraint (T+1, rows)
    pressing: Array  # (T, m), the same of the limits, positive if a control presses against its upper limit
    solved: bool  # whether all measures are within tolerance
    flat: bool  # whether it ended because the cost no longer changed, without being stationary
    sizes: Sizes
    scale: float  # the cost to which measures are relative

    def trajectory(self, dt: float) -> Trajectory:
        return Trajectory(self.plan.states, self.plan.controls, dt)


class InteriorPoint:
    """Runs the interior point from one plan.

    Args:
      plan: initial states (T+1, n) and controls (T, m), which need satisfy neither dynamics nor constraints.
      price: price of violating a constraint, in cost per unit; the constraint is then elastic. Infinite if it must
        hold. Or a price for each row, (R,); or a function of the typical sizes that returns these.
      multipliers: known multipliers of the constraints, (T+1, rows) each, or none.
      oldest: number of further steps for which derivatives of the dynamics may serve. Nothing is then learned of their
        curvature.
    """

    def __init__(
        self, stages: Stages, plan: Motion, barrier: Barrier = MEDIUM, *,
        price: float | Array | Callable[[Sizes], Array] = np.inf, multipliers: tuple[Array, ...] = (), oldest: int = 0,
    ) -> None:  # fmt: skip
        self._stages, self._iterations = stages, 0
        problem = stages.problem
        begun = Motion(plan.states.copy(), np.clip(plan.controls, stages.low, stages.high))
        if isinstance(problem.initial, FixedState):
            fixed = stages.free == 0
            begun.states[0, fixed] = np.asarray(problem.start)[fixed]
        known = in_c_order(stages.of_constraints(multipliers)).reshape(-1)
        self._begun = records.PlanBeginning(
            Motion(*map(in_c_order, begun)), known, bool(multipliers), float(barrier.parameter), float(barrier.slack),
            float(oldest),
        )  # fmt: skip
        self._arrays, self._memory = stages.interior
        self._log = np.zeros(0, records.MEASURES)
        self._tolerances = np.nan, np.nan
        self._call(SCALE, 0)
        self._sizes = stages.sized(float(self._memory["typical"][0]))
        stages.set_prices_and_margins(price=price(self._sizes) if callable(price) else price)
        self._call(BEGIN, 0)

    def run(
        self, *, tolerance: float, violation: float, most: int, near: bool = False, hurried: bool = True,
        laps: Laps | None = None, over: Callable[[Measures, float], bool] = lambda measures, seconds: False,
    ) -> InteriorResult:  # fmt: skip
        """Iterate until the measures are within tolerance, no step helps, or it is `over`.

        Args:
          tolerance: of stationarity, gaps and complementarity. violation: that of the constraints, in their units.
          near: whether the plan may be next to the answer.
          laps: which record the iterations.
          over: called with the measures of each iteration, and its seconds, once it is recorded; True ends the run.
          hurried: whether it is to be called after each iteration, rather than after `ATTENTION` seconds.
        """

        def watch(measures: Measures, seconds: float) -> bool:
            if laps is not None:
                measures.record(laps, seconds=seconds)
            return over(measures, seconds)

        self._log = np.zeros(most, records.MEASURES)
        if len(self._arrays.filter) < most:  # like the log, the filter gets a row at each iteration
            self._arrays = self._arrays._replace(filter=np.zeros((most, 2)))
            self._stages.interior = self._arrays, self._memory
        self._tolerances = float(tolerance), float(violation)
        self._stages.set_prices_and_margins(margin=INSIDE * violation)
        clock = time.perf_counter()
        if near and self._call(POLISH, 1)[1] == CONVERGED:
            self._iterations = 1
            watch(Measures.of(self._memory), time.perf_counter() - clock)
            return self._result(True)
        outcome = RUNNING
        slices = in_slices(
            lambda _, last: self._call(ITERATE, last), self._log,
            lambda row, seconds: watch(Measures(*row), seconds), functions_of(self._stages.problem),
            0.0 if hurried else ATTENTION,
        )  # fmt: skip
        for (self._iterations, outcome), _ in slices:
            if outcome != RUNNING:
                break
        if outcome == RUNNING:
            self._call(CLOSE, self._iterations)
        return self._result(bool(self._memory["solved"][0]) or self._is_at_rounding())

    def _is_at_rounding(self) -> bool:
        """Whether only rounding of the slope is left, which unstable dynamics enlarge."""
        (tolerance, violation), now = self._tolerances, Measures.of(self._memory)
        last = self._log[max(self._iterations - ROUNDING_ITERATIONS, 0) : self._iterations]
        if len(last) < ROUNDING_ITERATIONS or self._stages.about.learns or now.violation > violation:
            return False
        return np.ptp(last["cost"]) <= ROUNDING * abs(now.cost) and max(now.gap, now.complementarity) < tolerance

    def _call(self, task: int, last: int) -> tuple[int, int]:
        return self._stages.call(
            "interior_point", task, self._iterations, last, *self._tolerances, self._begun, self._stages.about,
            self._arrays, self._memory, self._log,
        )  # fmt: skip

    def _result(self, solved: bool) -> InteriorResult:
        stages, pressing = self._stages, np.zeros((self._stages.steps, self._stages.m))
        for row, (sign, i, _) in zip(np.flatnonzero(stages.owners == -1), stages.limits, strict=True):
            pressing[:, i] -= sign * stages.force[:-1, row]
        return InteriorResult(
            plan=deepcopy(self._arrays.now.plan), gain=stages.about.policy.gain.copy(),
            measures=Measures.of(self._memory), multipliers=tuple(stages.by_constraint(stages.force)),
            pressing=pressing, solved=solved, flat=bool(self._memory["unchanged"][0] >= FLAT_BEFORE_END),
            sizes=self._sizes, scale=float(self._memory["scale"][0]),
        )  # fmt: skip


class Restored(NamedTuple):
    """Result of a restoration."""

    plan: Motion
    violation_stationary: bool
    nearly_feasible: bool


def restore(
    stages: Stages, plan: Motion, sizes: Sizes, *, price: float, most: int, laps: Laps, over: Callable[[], bool],
    stationary: Callable[[Motion, list[Array]], bool], hurried: bool = True,
) -> Restored | None:  # fmt: skip
    """Descend from the rollout of a plan's controls (T, m); None if a trajectory is not finite, or there is no step.

    Args:
      price: of violating a constraint by its typical size, in units of the typical cost.
      laps: which record the iterations. over: called after each; True ends it.
      stationary: called once the predicted decrease is negligible; returns whether the violation of a trajectory is
        stationary, which ends it. It gets each constraint's multipliers relative to the price, (T+1, rows), in -1 to 1.
      hurried: as in `InteriorPoint.run`.
    """
    work, memory = stages.restoration
    stages.resize(sizes)
    work.plan.states[...], work.plan.controls[...] = plan
    log, price = np.zeros(most, records.RESTORED), float(price * sizes.cost)

    def run(first: int, last: int) -> tuple[int, int]:
        return stages.call("restoration", first, last, price, stages.about, work, memory, log)

    def watch(row: tuple[Any, ...], seconds: float) -> bool:
        cost, violation, predicted, *_ = row
        laps.record("restoration", cost, optimality=predicted, violation=violation, seconds=seconds)
        return over()

    run(0, 0)
    outcome, at_minimum = RUNNING, False
    functions = functions_of(stages.problem)
    for (_, outcome), ended in in_slices(run, log, watch, functions, 0.0 if hurried else ATTENTION):
        if outcome == NO_PROGRESS and not ended:
            shares = stages.by_constraint(work.relative_multipliers.reshape(stages.live.shape))
            at_minimum = stationary(deepcopy(work.plan), shares)
        if at_minimum or outcome not in (RUNNING, NO_PROGRESS):
            break
    if outcome == NOT_FINITE:
        return None
    return Restored(deepcopy(work.plan), at_minimum, bool(memory["nearly_feasible"][0]))


class ActiveSet:
    """Steps from one plan, not necessarily feasible, whose first state is the start.

    The violation is the tolerance of equalities; a fraction of it is the margin of inequalities.

    Attributes:
      plan: the current plan, which steps overwrite. held: (T+1, R) 1 for rows held at their targets, else 0.
      hopeless: whether the plan is stationary but violates rows that no multiplier corrects.
      model_seconds: spent on the models of a plan.
    """

    def __init__(self, stages: Stages, plan: Motion, multipliers: tuple[Array, ...], violation: float) -> None:
        self._stages, self._violation, self.hopeless = stages, float(violation), False
        self._arrays, self._memory = stages.active_set
        self.plan, self.held = self._arrays.plan, stages.held
        self.plan.states[...], self.plan.controls[...] = plan
        stages.set_prices_and_margins(price=np.inf, margin=INSIDE * violation)
        stages.force[...] = stages.of_constraints(multipliers)
        clock = time.perf_counter()
        self._call(active_set.BEGIN)
        self.model_seconds = time.perf_counter() - clock

    @property
    def measures(self) -> Measures:
        return Measures.of(self._memory)

    def run(self, tolerance: float, watch: Callable[[Measures], bool], late: Callable[[float], bool]) -> bool:
        """Take steps until the measures are within tolerance; return whether they are.

        After each step `watch` may end it. Called before a piece of work with its expected duration in seconds, `late`
        may abandon the step.
        """
        ended = False
        for _ in range(STEPS):
            before = self.measures
            if self._within(tolerance) or ended or not self._step(late):
                break
            ended = watch(self.measures) or not np.isfinite(self.measures.cost)
            # If everything else is within tolerance, a remaining violation cannot be removed.
            idle = max(before.stationarity, before.gap) < tolerance
            self.hopeless = idle and self.measures.violation > 0.5 * before.violation > self._violation
            ended = ended or self.hopeless
        return self._within(tolerance)

    def _within(self, tolerance: float) -> bool:
        measures = self.measures
        # The rollout of the plan must not use up the margin of the constraints.
        feasible = self._memory["kept"][0] > 0
        return feasible and max(measures.stationarity, measures.gap / INSIDE, measures.complementarity) < tolerance

    def _step(self, late: Callable[[float], bool]) -> bool:
        """Take a step; return False if there is none, or no time for it: twice that of the models is needed."""
        before = self.held.copy()
        self._call(active_set.PREPARE)
        outcome = RUNNING
        while outcome == RUNNING:
            outcome = self._call(active_set.PIVOT)
            if late(2 * self.model_seconds):
                self.held[...] = before
                return False
        if outcome == CONVERGED:
            self._call(active_set.TAKE)
        return outcome == CONVERGED

    def carried_out(self) -> tuple[Motion, Array, float]:
        """The rollout of the plan with gains (T, m, n) about it; the gains; its cost."""
        self._call(active_set.ROLL_OUT)
        return deepcopy(self._arrays.out), self._stages.about.policy.gain.copy(), self.measures.cost

    def multipliers(self) -> tuple[Multipliers, ...]:
        """The multipliers of each constraint, with a penalty."""
        stages, scale, multipliers = self._stages, float(self._memory["scale"][0]), list[Multipliers]()
        for k, force in enumerate(stages.by_constraint(stages.force)):
            sizes = stages.row_sizes[stages.owners == k]
            price = active_set.FIRMNESS * scale / float(np.median(sizes**2)) if len(sizes) else 1.0
            multipliers.append(Multipliers(force, price))
        return tuple(multipliers)

    def _call(self, task: int) -> int:
        return self._stages.call("active_set", task, self._violation, self._stages.about, self._arrays, self._memory)

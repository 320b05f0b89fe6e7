"""What comes out of a solve: the plan, the log, how it ended. NumPy only.

`policy.py` has the feedback law, `value_functions.py` the value functions. `files.py` writes a `Solution` to disk and
reads it back; `rollout.py` has what comes out of running it.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_items,
    check_kind,
    check_number,
    check_shape,
    check_text,
    excerpt,
    real,
    shaped,
)
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.value_functions import Moments, Quadratic, TotalCost


@dataclass(frozen=True)
class Trajectory:
    """States (T+1, n) and the controls (T, m) held between them, `dt` seconds apart.

    Raises:
      InputError: they do not fit together, there is no step, or dt is not above 0. NaN is what a failed solve has.
    """

    states: Array
    controls: Array
    dt: float

    def __post_init__(self) -> None:
        controls = shaped("Trajectory: controls", self.controls, (None, None))
        if not controls.size:
            raise InputError(f"Trajectory: controls: got shape {controls.shape}, want (T, m), at least one of each")
        states = shaped("Trajectory: states", self.states, (len(controls) + 1, None))
        if not states.size:
            raise InputError(f"Trajectory: states: got shape {states.shape}, want ({len(states)}, n), at least one n")
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "controls", controls)
        object.__setattr__(self, "dt", check_number("Trajectory: dt", self.dt, above=0.0))

    @property
    def steps(self) -> int:
        """T, the number of control periods."""
        return len(self.controls)

    @property
    def horizon(self) -> float:
        """Duration in seconds; the paper's l."""
        return self.steps * self.dt

    @property
    def times(self) -> Array:
        """Times of the states in seconds, (T+1,)."""
        return self.dt * np.arange(self.steps + 1)


class Status(enum.StrEnum):
    """How a solve ended. `meaning` says it in words, `remedy` what to try."""

    CONVERGED = "converged"
    COST_CONVERGED = "cost converged"
    MAX_ITERATIONS = "max iterations"
    TIME_LIMIT = "time limit"
    INTERRUPTED = "interrupted"
    INFEASIBLE = "infeasible"
    DIVERGED = "diverged"
    NOT_FINITE = "not finite"
    NOT_POSITIVE_DEFINITE = "not positive definite"
    NOT_CERTIFIED = "not certified"

    @property
    def success(self) -> bool:
        """True for CONVERGED, and for COST_CONVERGED, where only the cost was asked for."""
        return self in (Status.CONVERGED, Status.COST_CONVERGED)

    @property
    def meaning(self) -> str:
        return _STATUS_TEXT[self][0]

    @property
    def remedy(self) -> str:
        """What to try; empty where nothing needs to be."""
        return _STATUS_TEXT[self][1]


_STATUS_TEXT = {
    Status.CONVERGED: ("cost change, gap and first-order optimality are all within tolerance", ""),
    Status.COST_CONVERGED: (
        "the change of cost is within tolerance; gap and optimality were not asked for",
        'look at the gap, or solve with stop="optimal"',
    ),
    Status.MAX_ITERATIONS: (
        "the iteration limit came first, or no step lowered the cost any more",
        "raise max_iterations if the improvements still shrink; if they do not, try another start",
    ),
    Status.TIME_LIMIT: (
        "the time limit came first; the plan is the best so far",
        "raise time_limit, or begin nearer: start=solution of a similar problem",
    ),
    Status.INTERRUPTED: (
        "the callback raised, or Ctrl-C; the plan is the best so far",
        "solve again, from start=solution",
    ),
    Status.INFEASIBLE: (
        "the constraints can not be met, at least not near the plan that misses them least",
        "relax the constraint that is named, give more time, or try another start",
    ),
    Status.DIVERGED: (
        "the cost of the policy grew beyond all bounds",
        "try a start nearer to a solution or an InitialPrior, shorten dt, or try the other solver",
    ),
    Status.NOT_FINITE: (
        "a NaN or an infinity appeared",
        "check the dynamics and the cost at the step that is named; try another start; shorten dt",
    ),
    Status.NOT_POSITIVE_DEFINITE: (
        "a matrix that must be inverted was not positive definite",
        "raise the control weight, start with an InitialPrior, shorten dt, or try the other solver",
    ),
    Status.NOT_CERTIFIED: (
        "the method converged, but its plan, checked against the problem, is not what it claims",
        "try another start or form; and please report it, for it is a fault of lqrsim",
    ),
}


ITERATION_NUMBERS = ("cost", "improvement", "gap", "optimality", "dynamics_residual", "violation", "seconds")


@dataclass(frozen=True)
class Iteration:
    """One line of the log.

    Attributes:
      cost: true cost of rolling the policy out under the true dynamics; NaN where it was only to keep the constraints.
      improvement: `(previous cost - cost) / |cost|`; infinite in the first iteration. Of damped iterations with
        constraints it is of the cost with the augmented Lagrangian, and so is the optimality.
      gap: largest difference between the minimal-total-cost states and that rollout, each state relative to its
        range along the rollout (at least 1 unit). Where the safeguard went part of the way, they are taken there; 0 for
        steps of iLQR, which has none.
      optimality: the decrease that a linear-quadratic model about the rollout still predicts, relative to the cost; NaN
        where it was not evaluated (it is once the other tests pass, and after the last iteration).
      dynamics_residual: how far one step of the true dynamics takes a minimal-total-cost state from the next one, at
        most; relative as the gap is, and evaluated where the optimality is. The plan itself is a rollout, and has none.
      violation: by how much the worst constraint is missed at the steps, in its unit; 0 where all inequalities are
        kept and there are no equalities, which are off by rounding at least; NaN where it was not evaluated.
      seconds: time this iteration took.
      method: "smooth", the paper's; of the safeguard's: "damped", "ilqr" where its step is that of iLQR, or "rejected"
        (it would have cost more, or a pass failed; cost is that of the plan that was kept).
    """

    cost: float
    improvement: float
    gap: float
    optimality: float
    dynamics_residual: float
    violation: float
    seconds: float
    method: str

    def __post_init__(self) -> None:
        for name in ITERATION_NUMBERS:
            if type(value := getattr(self, name)) is not float:
                object.__setattr__(self, name, float(shaped(f"Iteration: {name}", value, ())))
        check_kind("Iteration: method", self.method, str, "text")

    HEADER = (
        f"{'iteration':>9} {'cost':>14} {'improvement':>12} {'gap':>10} {'optimality':>11} {'violation':>10} {'ms':>8}"
        "  method"
    )

    def row(self, number: int) -> str:
        """This iteration as a line under `HEADER`."""
        number = check_count("number", number, at_least=0)
        optimality = "-" if np.isnan(self.optimality) else f"{self.optimality:.1e}"
        improvement = "-" if np.isinf(self.improvement) else f"{self.improvement:.2e}"
        gap = "-" if np.isnan(self.gap) else f"{self.gap:.1e}"
        violation = "-" if np.isnan(self.violation) else f"{self.violation:.1e}"
        return (
            f"{number:>9} {self.cost:>14.9g} {improvement:>12} {gap:>10} {optimality:>11} {violation:>10}"
            f" {1e3 * self.seconds:>8.2f}  {self.method}"
        )


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What the plan is, recomputed from the problem after the solve, on a path that the solvers do not use.

    A solution that says CONVERGED has passed: each of these is within rounding, and the optimality within tolerance.

    Attributes:
      cost: of the plan.
      start: largest difference of its first state from a `FixedState`; 0 where the start is not fixed.
      motion: largest difference of a state from a step of the dynamics out of the state before it; each state relative
        to its largest size along the plan, at least 1 unit.
      law: largest difference of a control from the policy's at that state, relative to the terms of `L x + l`.
      limits: by how much a control is beyond its limits, in its unit.
      violation: by how much the worst constraint is missed at the steps, in its unit; 0 where all inequalities are
        kept and there are no equalities, which are kept to 1e-6.
      optimality: the decrease of cost that the slopes of the cost in the policy's offsets (and in a start that is not
        fixed) still promise, relative to the cost; infinite where there is no cost-to-go to weigh them with.
    """

    cost: float
    start: float
    motion: float
    law: float
    limits: float
    violation: float
    optimality: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = float(shaped(f"Certificate: {field.name}", getattr(self, field.name), ()))
            object.__setattr__(self, field.name, value)


@dataclass(frozen=True)
class Multipliers:
    """What a constraint presses with, at each step: zero where an inequality is kept with room to spare.

    Attributes:
      values: (T+1, rows): what a unit more of the constraint would cost; of an inequality not negative.
      penalty: mu of the augmented Lagrangian, which holds the policy to the constraint.
    """

    values: Array
    penalty: float

    def __post_init__(self) -> None:
        values = shaped("Multipliers: values", self.values, (None, None))
        if not len(values):
            raise InputError(f"Multipliers: values: got shape {values.shape}, want (T+1, rows)")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "penalty", check_number("Multipliers: penalty", self.penalty, at_least=0.0))


@dataclass(frozen=True)
class Candidate:
    """One of several starts that a search tried.

    Attributes:
      start: what it was.
      cost: true cost of the last plan that it led to; infinite if a pass failed, or the plan is only to keep the
        constraints.
      iterations: how many it took until then.
      status: how it ended; None where it was dropped after a few iterations.
      trajectory: that plan.
    """

    start: str
    cost: float
    iterations: int
    status: Status | None
    trajectory: Trajectory

    def __post_init__(self) -> None:
        check_text("Candidate: start", self.start, "what it was", at_most=1000, empty=True)
        if np.isnan(cost := float(shaped("Candidate: cost", self.cost, ()))):
            raise InputError("Candidate: cost: got nan, want a number, infinite where there is none")
        object.__setattr__(self, "cost", cost)
        check_count("Candidate: iterations", self.iterations, at_least=0)
        check_kind("Candidate: status", self.status, (Status, type(None)), "a Status or None")
        check_kind("Candidate: trajectory", self.trajectory, Trajectory, "a Trajectory")


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A locally optimal feedback policy and how it was found.

    Attributes:
      status: how the solve ended; only CONVERGED and COST_CONVERGED are success.
      detail: where and why, if it is not; and where the safeguard had to step in.
      policy: the feedback law, from the last backward pass that was completed.
      inverse_policy: the law that traces the optimum backwards from a state of arrival; None from `ilqr`, and where
        states of arrival can not be chosen freely, as after a fixed start.
      cost_to_go, cost_to_come: the value functions of the last passes; None where a pass failed, the latter also from
        `ilqr`. The cost-to-come is a `Quadratic` in the primal form and `Moments` in the dual.
      trajectory: the plan: the rollout of the policy under the true dynamics from its first state.
      iterations: the log.
      clearance: signed distance to the nearest obstacle minus the robot's radius along the plan in metres, (T+1,);
        None where the problem has no obstacles.
      solver, options: what was called, with which settings.
      certificate: what the plan is, recomputed from the problem; cost, violation and optimality are read from it.
      gap: of the plan; see `Iteration.gap`. NaN if there is none.
      problem_digest: hash of everything that defined the problem.
      versions: of lqrsim and the libraries that the bits depend on, and the processor.
      scenario: what the command line was asked for; empty where a program called the solver.
      candidates: the starts that were tried, where there were several.
      multipliers: of each of the problem's constraints; none where the plan keeps them all without being made to.
      goal: (n,) the state that the final cost asks for, NaN in the states to which it gives no weight; None where it
        names no state.
      goal_radius: within which the plan's end counts as at the goal, in `target.unit`; None where that is not known. By
        default the robot's radius, in metres; for goals without a position see `results/goal.py`.
    """

    status: Status
    detail: str
    policy: AffinePolicy
    inverse_policy: AffinePolicy | None
    cost_to_go: Quadratic | None
    cost_to_come: Quadratic | Moments | None
    trajectory: Trajectory
    iterations: tuple[Iteration, ...]
    clearance: Array | None
    certificate: Certificate
    gap: float
    solver: str
    options: Mapping[str, object]
    problem_digest: str
    versions: Mapping[str, str]
    scenario: str = ""
    candidates: tuple[Candidate, ...] = ()
    multipliers: tuple[Multipliers, ...] = ()
    goal: Array | None = None
    goal_radius: float | None = None

    @property
    def target(self) -> Target:
        """What a run of the policy is to reach: the goal, or the plan's end where there is none."""
        return Target(self.policy.state_coordinates, self.goal, self.trajectory.states)

    def __post_init__(self) -> None:
        check_kind("Solution: status", self.status, Status, f"a Status, one of {', '.join(Status.__members__)}")
        check_kind("Solution: policy", self.policy, AffinePolicy, "an AffinePolicy")
        check_kind("Solution: trajectory", self.trajectory, Trajectory, "a Trajectory")
        check_kind("Solution: inverse_policy", self.inverse_policy, (AffinePolicy, type(None)), "an AffinePolicy, None")
        check_kind("Solution: cost_to_go", self.cost_to_go, (Quadratic, type(None)), "a Quadratic or None")
        kinds = (Quadratic, Moments, type(None))
        check_kind("Solution: cost_to_come", self.cost_to_come, kinds, "a Quadratic, Moments or None")
        for name, kind in (("iterations", Iteration), ("candidates", Candidate), ("multipliers", Multipliers)):
            items = check_items(f"Solution: {name}", getattr(self, name), kind, f"a tuple of {kind.__name__}")
            object.__setattr__(self, name, items)
        for name in ("detail", "solver", "problem_digest", "scenario"):
            check_kind(f"Solution: {name}", getattr(self, name), str, "text")
        for name in ("options", "versions"):
            given = check_kind(f"Solution: {name}", getattr(self, name), Mapping, "a dictionary by name")
            if not all(isinstance(key, str) for key in given):
                raise InputError(f"Solution: {name}: got {excerpt(given)}, want a dictionary by name")
        self._check_shapes()

    def _check_shapes(self) -> None:
        """Raises InputError for parts of several problems."""
        states, steps = self.trajectory.states.shape, self.trajectory.steps
        laws = {"policy": self.policy, "inverse_policy": self.inverse_policy}
        arrays: dict[str, tuple[Array, tuple[int | None, ...]]] = {
            f"{name}.gain": (law.gain, (steps, self.trajectory.controls.shape[1], states[1]))
            for name, law in laws.items()
            if law is not None
        }
        if self.cost_to_go is not None:
            arrays["cost_to_go.gradient"] = self.cost_to_go.gradient, states
        if isinstance(self.cost_to_come, Quadratic):
            arrays["cost_to_come.gradient"] = self.cost_to_come.gradient, states
        elif self.cost_to_come is not None:
            arrays["cost_to_come.mean"] = self.cost_to_come.mean, states
        if self.clearance is not None:
            arrays["clearance"] = real("Solution: clearance", self.clearance), states[:1]
            object.__setattr__(self, "clearance", arrays["clearance"][0])
        if self.goal is not None:
            arrays["goal"] = real("Solution: goal", self.goal), states[1:]
            object.__setattr__(self, "goal", arrays["goal"][0])
        arrays |= {f"multipliers[{i}]": (one.values, (steps + 1, None)) for i, one in enumerate(self.multipliers)}
        for name, (array, shape) in arrays.items():
            check_shape(f"Solution: {name}", array, shape)
        _ = self.target  # which refuses what is no goal
        if self.goal_radius is not None:
            radius = check_number("Solution: goal_radius", self.goal_radius, above=0.0)
            object.__setattr__(self, "goal_radius", radius)

    @property
    def success(self) -> bool:
        """True for CONVERGED, and for COST_CONVERGED, where only the cost was asked for."""
        return self.status.success

    @property
    def cost(self) -> float:
        """True cost of the plan, start and end included."""
        return self.certificate.cost

    @property
    def optimality(self) -> float:
        """First-order optimality of the plan; see `Certificate`."""
        return self.certificate.optimality

    @property
    def violation(self) -> float:
        """By how much the worst constraint is missed at the steps; see `Certificate`."""
        return self.certificate.violation

    @property
    def dynamics_residual(self) -> float:
        """Dynamics residual of the last iteration; see `Iteration.dynamics_residual`."""
        return self.iterations[-1].dynamics_residual if self.iterations else float("nan")

    @property
    def total_cost(self) -> TotalCost:
        """Cost-to-go plus cost-to-come, Eq. (20). Raises InputError where there is no cost-to-come, as from `ilqr`."""
        if self.cost_to_go is None or self.cost_to_come is None:
            raise InputError(
                f"total_cost: got a solution of {self.solver} without both value functions, want one of smooth, not"
                " shifted, whose passes were completed"
            )
        return TotalCost(self.cost_to_go, self.cost_to_come)

    def shifted(self, steps: int) -> "Solution":
        """What is left of it after so many steps, to start the next solve of a horizon that moves along.

        The end is filled up: the last law, value function and multipliers stay in force, as a policy's last law does
        after its horizon, and the last control is held. Status, log, cost and digest stay those of the whole.
        `smooth(problem, start=solution.shifted(k))`.

        Raises:
          InputError: `steps` is not a whole number from 0 to the last step.
        """
        if check_count("steps", steps, at_least=0) >= self.trajectory.steps:
            raise InputError(f"steps: got {steps}, want less than {self.trajectory.steps}, the steps of the solution")

        def moved(array: Array) -> Array:
            kept = np.minimum(np.arange(steps, steps + len(array)), len(array) - 1)
            return array[kept]

        def law(policy: AffinePolicy) -> AffinePolicy:
            return replace(policy, gain=moved(policy.gain), offset=moved(policy.offset), nominal=moved(policy.nominal))

        plan, value = self.trajectory, self.cost_to_go
        return replace(
            self,
            policy=law(self.policy),
            inverse_policy=None,
            cost_to_go=None
            if value is None
            else Quadratic(moved(value.hessian), moved(value.gradient), moved(np.asarray(value.constant))),
            cost_to_come=None,
            trajectory=Trajectory(moved(plan.states), moved(plan.controls), plan.dt),
            clearance=None if self.clearance is None else moved(self.clearance),
            candidates=(),
            multipliers=tuple(replace(one, values=moved(one.values)) for one in self.multipliers),
            detail=f"what is left of a solution after {steps} steps; {self.detail}".removesuffix("; "),
        )

    def open_loop(self) -> "Solution":
        """The same plan without feedback: its controls, whatever the state. Shows what the feedback is worth."""
        policy = replace(self.policy, gain=np.zeros_like(self.policy.gain), offset=self.trajectory.controls)
        return replace(self, policy=policy, inverse_policy=None)

    def iteration_table(self) -> str:
        """The log as text, a line an iteration."""
        rows = [iteration.row(number) for number, iteration in enumerate(self.iterations, start=1)]
        return "\n".join([Iteration.HEADER, *rows])

    def summary(self) -> str:
        """The status with its remedy, and what came out, in a few lines."""
        lines = [f"{self.status.name} after {len(self.iterations)} iterations of {self.solver}: {self.status.meaning}"]
        if self.detail:
            lines.append(f"  where:     {self.detail}")
        if self.status.remedy:
            lines.append(f"  remedy:    {self.status.remedy}")
        lines.append(f"  cost:      {self.cost:.9g}   gap: {self.gap:.1e}   optimality: {self.optimality:.1e}")
        if self.clearance is not None:
            knot = int(np.argmin(self.clearance))
            verdict = "collides" if self.clearance[knot] < 0 else "clear"
            lines.append(f"  clearance: {self.clearance[knot]:.3f} m at {knot * self.trajectory.dt:.2f} s ({verdict})")
        lines += [f"  goal:      {line}" for line in self._at_goal()]
        lines += [f"  limits:    {line}" for line in self._beyond_limits()]
        lines += [f"  starts:    {line}" for line in self._search()]
        return "\n".join(lines)

    def _at_goal(self) -> list[str]:
        """How far from the goal the plan ends, and whether it misses it."""
        if not np.isfinite(self.trajectory.states).all():
            return []
        target, radius = self.target, self.goal_radius
        if radius is None and not target.places:
            radius = target.radius(None, None, None)
        return target.of_plan(radius)

    def _beyond_limits(self) -> list[str]:
        """One line for each control that the plan takes beyond its limits."""
        space, controls = self.policy.control_coordinates, self.trajectory.controls
        return [
            f"{label} is planned from {used.min():.3g} to {used.max():.3g}, beyond {low:.3g} to {high:.3g}"
            for label, used, low, high in zip(space.labels, controls.T, space.low, space.high, strict=True)
            if used.min() < low or used.max() > high
        ]

    def _search(self) -> list[str]:
        """Which of several starts was the best, if there were several."""
        if not self.candidates:
            return []
        ended = [candidate for candidate in self.candidates if candidate.status is not None]
        dropped = [candidate.cost for candidate in self.candidates if candidate.status is None]
        best = min(
            ended, key=lambda candidate: (candidate.status != self.status, abs(candidate.cost - self.cost))
        ).start
        lines = [f"the plan is of {best}, one of {len(self.candidates)}"]
        if dropped:
            lines[0] += f"; {len(dropped)} were dropped at costs of {min(dropped):.6g} or more"
        others = [one for one in ended if one.start != best]
        return lines + [f"{one.start} ended {one.status and one.status.name} at {one.cost:.6g}" for one in others]

    def __str__(self) -> str:
        return f"{self.iteration_table()}\n{self.summary()}"

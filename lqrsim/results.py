"""What comes out of a solve: the plan, the log, how it ended. NumPy only.

`policy.py` has the feedback law, `value_functions.py` the value functions. `files.py` writes a `Solution` to disk and
reads it back; `rollout.py` has what comes out of running it.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lqrsim.errors import Array, InputError, check_count
from lqrsim.policy import AffinePolicy
from lqrsim.target import Target
from lqrsim.value_functions import Moments, Quadratic, TotalCost


@dataclass(frozen=True)
class Trajectory:
    """States (T+1, n) and the controls (T, m) held between them, `dt` seconds apart."""

    states: Array
    controls: Array
    dt: float

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
    INFEASIBLE = "infeasible"
    DIVERGED = "diverged"
    NOT_FINITE = "not finite"
    NOT_POSITIVE_DEFINITE = "not positive definite"

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
}


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
      violation: by how much the worst constraint is missed at the steps, in its unit; 0 where all are kept, NaN where
        it was not looked at.
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

    HEADER = (
        f"{'iteration':>9} {'cost':>14} {'improvement':>12} {'gap':>10} {'optimality':>11} {'violation':>10} {'ms':>8}"
        "  method"
    )

    def row(self, number: int) -> str:
        """This iteration as a line under `HEADER`."""
        optimality = "-" if np.isnan(self.optimality) else f"{self.optimality:.1e}"
        improvement = "-" if np.isinf(self.improvement) else f"{self.improvement:.2e}"
        gap = "-" if np.isnan(self.gap) else f"{self.gap:.1e}"
        violation = "-" if np.isnan(self.violation) else f"{self.violation:.1e}"
        return (
            f"{number:>9} {self.cost:>14.9g} {improvement:>12} {gap:>10} {optimality:>11} {violation:>10}"
            f" {1e3 * self.seconds:>8.2f}  {self.method}"
        )


@dataclass(frozen=True)
class Multipliers:
    """What a constraint presses with, at each step: zero where it is kept with room to spare.

    Attributes:
      values: (T+1, rows), not negative: what a unit more of the constraint would cost.
      penalty: mu of the augmented Lagrangian, which holds the policy to the constraint.
    """

    values: Array
    penalty: float


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
      problem_digest: hash of everything that defined the problem.
      versions: of lqrsim and the libraries that the numbers depend on.
      scenario: what the command line was asked for; empty where a program called the solver.
      candidates: the starts that were tried, where there were several.
      multipliers: of each of the problem's constraints; none where the plan keeps them all without being made to.
      goal: (n,) the state that the final cost asks for, NaN in the states to which it gives no weight; None where it
        names no state.
      goal_radius: within which the plan's end counts as at the goal, in `target.unit`; None where that is not known. By
        default the robot's radius, in metres; for goals without a position see `target.py`.
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

    @property
    def success(self) -> bool:
        """True for CONVERGED, and for COST_CONVERGED, where only the cost was asked for."""
        return self.status.success

    @property
    def cost(self) -> float:
        """True cost of the plan; NaN if not one iteration was completed, or it was only to keep the constraints."""
        return self.iterations[-1].cost if self.iterations else float("nan")

    @property
    def gap(self) -> float:
        """Gap of the last iteration; see `Iteration.gap`."""
        return self.iterations[-1].gap if self.iterations else float("nan")

    @property
    def optimality(self) -> float:
        """First-order optimality of the last iteration; see `Iteration.optimality`."""
        return self.iterations[-1].optimality if self.iterations else float("nan")

    @property
    def dynamics_residual(self) -> float:
        """Dynamics residual of the last iteration; see `Iteration.dynamics_residual`."""
        return self.iterations[-1].dynamics_residual if self.iterations else float("nan")

    @property
    def violation(self) -> float:
        """By how much the worst constraint is missed at the steps; see `Iteration.violation`."""
        return self.iterations[-1].violation if self.iterations else float("nan")

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

"""What comes out of a solve. NumPy only.

`solution_parts.py` has the plan, the log and how it ended, `policy.py` the feedback law, `value_functions.py` the value
functions. `save_load.py` writes a `Solution` to disk and reads it back; `rollout.py` has what comes out of running it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_shape,
    excerpt,
    real,
)
from lqrsim.results import notebook
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import (
    HORIZONS,
    Candidate,
    Certificate,
    Iteration,
    Multipliers,
    Status,
    Trajectory,
    left_after,
)
from lqrsim.results.value_functions import Moments, Quadratic, TotalCost


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A locally optimal feedback policy and how it was found.

    Attributes:
      status: how the solve ended; only CONVERGED and COST_CONVERGED are success.
      detail: where and why, if it is not; and where the safeguard had to step in.
      policy: the feedback law, from the last backward pass that was completed.
      inverse_policy: the law that traces the optimum backwards from a state of arrival; None from `ilqr`, and where
        states of arrival cannot be chosen freely, as after a fixed start.
      cost_to_go: the value function of the last backward pass, a `Quadratic`; None where a pass failed.
      cost_to_come: the value function of the last forward pass, a `Quadratic` in the primal form and `Moments` in the
        dual; None where a pass failed, and from `ilqr`.
      trajectory: the plan: the rollout of the policy under the true dynamics from its first state.
      iterations: the log.
      clearance: signed distance to the nearest obstacle minus the robot's radius along the plan in metres, (T+1,); None
        where the problem has no obstacles.
      certificate: what the plan is, recomputed from the problem; cost, violation and optimality are read from it.
      gap: of the plan; see `Iteration.gap`. NaN if there is none.
      solver: name of the function that was called.
      options: its settings; with noise, that in words, and the risk.
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

    @classmethod
    def _assembled(cls, later: Mapping[str, Callable[[], Any]], **parts: Any) -> "Solution":
        """A solver's own, whose parts fit each other: without a check, and with parts that are made when they are read.

        Args:
          later: name -> what makes it, for parts that have no default.
          **parts: all others.

        Returns:
          A Solution.
        """
        solution = object.__new__(cls)
        vars(solution).update(parts, _later=later)
        return solution

    def __getattr__(self, name: str) -> Any:
        later = vars(self).get("_later", {})
        if name not in later:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return vars(self).setdefault(name, later[name]())  # of two threads that read it both get the same

    def __getstate__(self) -> dict[str, Any]:
        """With all parts made."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

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
        """True cost of the plan, start and end included; with noise what runs of the policy are expected to cost.

        With a risk it is (1/risk) log E exp(risk cost) of them. Either is worked out to second order about the plan.
        """
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

    def shifted(self, steps: int, *, horizon: str = "moving") -> "Solution":
        """The rest of the solution after `steps` steps, to start the next solve with: `start=solution.shifted(k)`.

        Of a "moving" horizon the end is filled up: the last law, value function and multipliers stay in force, as a
        policy's last law does after its horizon, and the last control is held. A "shrinking" one has so many steps
        less. Status, log, cost and digest stay those of the whole.

        Args:
          steps: how many steps are over, less than the solution has.
          horizon: "moving" fills up the end, "shrinking" has fewer steps.

        Returns:
          A Solution.

        Raises:
          InputError: `steps` is not a whole number from 0 to the last step, or `horizon` is neither of the two.
        """
        if check_count("steps", steps, at_least=0) >= self.trajectory.steps:
            raise InputError(f"steps: got {steps}, want less than {self.trajectory.steps}, the steps of the solution")
        filled = check_name("horizon", horizon, HORIZONS) == "moving"

        def moved(array: npt.ArrayLike) -> Array:
            return left_after(steps, array, filled=filled)

        plan, value = self.trajectory, self.cost_to_go
        return replace(
            self,
            policy=self.policy.shifted(steps, horizon=horizon),
            inverse_policy=None,
            cost_to_go=None
            if value is None
            else Quadratic(moved(value.hessian), moved(value.gradient), moved(value.constant)),
            cost_to_come=None,
            trajectory=Trajectory(moved(plan.states), moved(plan.controls), plan.dt),
            clearance=None if self.clearance is None else moved(self.clearance),
            candidates=(),
            multipliers=tuple(replace(one, values=moved(one.values)) for one in self.multipliers),
            detail=f"the rest of a solution after {steps} steps; {self.detail}".removesuffix("; "),
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
            lines.append(f"  detail:    {self.detail}")
        if self.status.remedy:
            lines.append(f"  remedy:    {self.status.remedy}")
        gap = f"{self.gap:.1e}" if np.isfinite(self.gap) else "none (no cost-to-come)"
        lines.append(f"  cost:      {self.cost:.9g}   gap: {gap}   optimality: {self.optimality:.1e}")
        if "noise" in self.options:
            meant = f"log E exp(risk cost) / risk, risk {self.options.get('risk')}"
            if self.cost_to_go is None:
                meant = "that without noise: there is no cost-to-go to weigh it with"
            elif not self.options.get("risk"):
                meant = "an expectation"
            lines.append(f"  noise:     {self.options['noise']}; the cost is {meant}")
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
        lines = [f"the plan is from the start {best!r}, one of {len(self.candidates)}"]
        if dropped:
            lines[0] += f"; {len(dropped)} were dropped at costs of {min(dropped):.6g} or more"
        others = [one for one in ended if one.start != best]
        return lines + [f"{one.start} ended {one.status and one.status.name} at {one.cost:.6g}" for one in others]

    def __str__(self) -> str:
        return f"{self.iteration_table()}\n{self.summary()}"

    def _repr_html_(self) -> str:
        return notebook.of_solution(self)

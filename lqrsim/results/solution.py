"""The result of a solve: a plan with its feedback law, and how it was found. NumPy only."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, Index, Line, Positive, checked
from lqrsim.errors import Array, InputError, check_shape
from lqrsim.results.display import drawing, number_text, of_table
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import (
    BetweenKnots,
    Candidate,
    Certificate,
    Curvature,
    Horizon,
    Iteration,
    Moments,
    Multipliers,
    Quadratic,
    Status,
    TotalCost,
    Trajectory,
    joined,
    left_after,
)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A plan with its feedback law, and everything with which a later solve can begin.

    A `Solution` and a `Replan` are plans with a `cost` and a `violation`.

    Attributes:
      detail: where and why the solve failed; for solutions also remarks.
      trajectory: the plan: the rollout of the policy by the model from its first state.
      cost_to_go: the value function of the law, a `Quadratic`; None if it is unknown, and for re-plans with
        constraints, which do not need it.
      multipliers: one for each constraint of the problem; none if no constraint is active.
      goal: (n,) the goal state of the problem, NaN in states that do not matter; None if there is no goal.
      goal_radius: distance from the goal, in `target.unit`, within which the plan reaches it; None if it is unknown.
    """

    _want = "a Plan, such as a Solution"

    status: Status
    detail: Annotated[str, 10 * LINE]
    policy: AffinePolicy
    trajectory: Trajectory
    cost_to_go: Quadratic | None
    multipliers: tuple[Multipliers, ...] = ()
    goal: Annotated[Array, "n"] | None = None
    goal_radius: Positive | None = None

    def __post_init__(self) -> None:
        who = type(self).__name__
        if self.cost_to_go is not None:
            check_shape(f"{who}: cost_to_go.gradient", self.cost_to_go.gradient, self.trajectory.states.shape)
        _ = self.target  # raises an exception if the goal is invalid
        self._check_finite("trajectory", "policy", "cost_to_go")

    def _check_finite(self, *names: str) -> None:
        """Raises InputError if a record or an array of a plan that converged contains NaN or infinity."""
        for name in names if self.status.success else ():
            value = getattr(self, name)
            arrays = [value] if isinstance(value, np.ndarray) else vars(value).values() if value is not None else ()
            if not all(np.isfinite(array).all() for array in arrays if isinstance(array, np.ndarray)):
                got = f"got NaN or infinity in a plan that is {self.status.name}"
                raise InputError(f"{type(self).__name__}: {name}: {got}, want numbers")

    @property
    def success(self) -> bool:
        """Whether the solve converged: CONVERGED, or COST_CONVERGED if only the cost was tested."""
        return self.status.success

    @property
    def target(self) -> Target:
        """The goal of a run, or the end of the plan if there is no goal."""
        return Target(self.policy.state_coordinates, self.goal, self.trajectory.states)

    @checked
    def shifted(self, steps: Index, *, horizon: Horizon = "moving") -> Self:
        """The rest of the plan after `steps` steps, as a start for the next solve: `start=solution.shifted(k)`.

        A "moving" horizon keeps its length: the last law, value function, multipliers and control are repeated at the
        end. A "shrinking" horizon has fewer steps. Status, log, cost and digest still describe the whole plan.
        """
        if steps >= self.trajectory.steps:
            raise InputError(f"steps: got {steps}, want less than {self.trajectory.steps}, the steps of the plan")
        filled = horizon == "moving"

        def shift(array: npt.ArrayLike) -> Array:
            return left_after(steps, array, filled=filled)

        plan, value = self.trajectory, self.cost_to_go
        if value is not None:
            value = Quadratic(shift(value.hessian), shift(value.gradient), shift(value.constant))
        parts = {
            "policy": self.policy.shifted(steps, horizon=horizon),
            "trajectory": Trajectory(shift(plan.states), shift(plan.controls), plan.dt),
            "cost_to_go": value,
            "multipliers": tuple(replace(one, values=shift(one.values)) for one in self.multipliers),
        }
        return replace(self, **parts, **self._shifted_parts(steps, shift))

    def _shifted_parts(self, steps: int, shift: Callable[[npt.ArrayLike], Array]) -> dict[str, Any]:
        """Further fields that `shifted` changes, with their new values; `shift` shifts an array."""
        return {}


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Replan(Plan):
    """The result of a prepared solver: a plan from a given state, no worse than the rollout of the initial law.

    No worse means that its violation is no larger, and if both keep the constraints, that its cost is no higher. Of
    plans that violate constraints equally, to two digits or within 1e-6, the one of least cost is chosen. The plan can
    be used with any status, unless `cost` is not finite.

    Attributes:
      improved: whether there is a new plan; otherwise this is the rollout of the law that the solve began with.
      before: cost of the rollout of the law that the solve began with.
      violation: violation of the worst constraint at the steps; 0 if all are kept.
      iterating: the part of `seconds` spent in iterations and in the first rollout.
    """

    improved: bool
    cost: float
    before: float
    violation: float
    iterations: int
    seconds: float
    iterating: float


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Solution(Plan):
    """A locally optimal feedback policy, and how it was found.

    A `Plan` with a record of the solve. `detail` also says where the safeguard stepped in. The policy and the
    cost-to-go come from the last completed backward pass.

    Attributes:
      inverse_policy: the law that follows the optimum backwards from a state of arrival. None from `ilqr`, and with a
        fixed start, from which not every state can be reached.
      cost_to_come: the value function of the last forward pass, a `Quadratic` in the primal form and `Moments` in the
        dual form; None if a pass failed, and from `ilqr`.
      iterations: a record of each iteration; `log` is their table.
      clearance: (T+1,) signed distance to the nearest obstacle minus the robot's radius in m; None without obstacles.
      certificate: measures of the plan, recomputed from the problem; the source of cost, violation and optimality.
      gap: gap of the plan; see `Iteration.gap`. NaN if it is not defined.
      options: the settings of the solver; with noise, also a description of the noise, and the risk.
      problem_parts: what the problem asks for, by part, as `print(problem)` says it; empty in older files.
      remedy: a remedy to try in this case; empty for a success, unless its goal is one that no control comes nearer to,
        or its Runge-Kutta steps are unstable.
      scenario: the scenario that the command line solved; empty if a program called the solver.
      candidates: the starts that were tried, if there were several.
    """

    _want = "a Solution, such as smooth(problem)"

    inverse_policy: AffinePolicy | None
    cost_to_come: Quadratic | Moments | None
    iterations: tuple[Iteration, ...]
    clearance: Annotated[Array, "T+1"] | None
    certificate: Certificate
    gap: float
    solver: Line
    options: Mapping[str, object]
    problem_digest: Line
    versions: Mapping[str, Line]
    remedy: Annotated[str, 10 * LINE] = ""
    scenario: Annotated[str, 10 * LINE] = ""
    candidates: tuple[Candidate, ...] = ()
    problem_parts: Mapping[str, Annotated[str, 10 * LINE]] = field(default_factory=dict)
    _later: ClassVar[Mapping[str, Callable[[], Any]]] = {}  # makes parts, by name, when they are first read

    @classmethod
    def _assembled(cls, later: Mapping[str, Callable[[], Any]], **parts: Any) -> "Solution":
        """A solution without checks, for solvers, whose parts fit; `later` makes further parts."""
        solution = object.__new__(cls)
        vars(solution).update(parts, _later=later)
        return solution

    def _examined_by(self, examine: Callable[[], BetweenKnots]) -> "Solution":
        """This solution, which from now on can say what its plan does between its knots."""
        vars(self)["_later"] = {**self._later, "_examined": examine}
        return self

    def __getattr__(self, name: str) -> Any:
        if name not in self._later:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return vars(self).setdefault(name, self._later[name]())  # two threads that read it get the same object

    def __getstate__(self) -> dict[str, Any]:
        """The attributes, with all parts made."""
        return {part.name: getattr(self, part.name) for part in fields(self)}

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_finite("inverse_policy", "cost_to_come", "clearance")
        come = self.cost_to_come
        if come is not None:
            mean = come.gradient if isinstance(come, Quadratic) else come.mean
            check_shape("Solution: cost_to_come", mean, self.trajectory.states.shape)
        if self.candidates and all(candidate.status is None for candidate in self.candidates):
            raise InputError("Solution: candidates: got none that ended, want at least one, or no candidates")

    @property
    def cost(self) -> float:
        """Cost of the plan; with noise expected, with a risk (1/risk) log E exp(risk cost): both to second order."""
        return self.certificate.cost

    @property
    def optimality(self) -> float:
        """First-order optimality of the plan; see `Certificate`."""
        return self.certificate.optimality

    @property
    def curvature(self) -> Curvature:
        """Whether a converged plan is a minimum; see `Curvature`."""
        return self.certificate.curvature

    @property
    def violation(self) -> float:
        """Violation of the worst constraint at the steps; see `Certificate`."""
        return self.certificate.violation

    def between_knots(self) -> BetweenKnots:
        """What the plan does between its knots. It is worked out when it is first needed, and not stored in files.

        Raises:
          InputError: the solution is from a file or was changed since `smooth` returned it, or is not finite.
        """
        known = "_examined" in self._later
        if not (known and self.trajectory.finite):
            got = "a plan that is not finite" if known else "a solution from a file, or one that was changed"
            raise InputError(f"between_knots: got {got}, want one as smooth returns it, as smooth(problem, start=this)")
        return self._examined

    @property
    def dynamics_residual(self) -> float:
        """Dynamics residual of the last iteration; see `Iteration.dynamics_residual`."""
        return self.iterations[-1].dynamics_residual if self.iterations else float("nan")

    @property
    def total_cost(self) -> TotalCost:
        """Cost-to-go plus cost-to-come, Eq. (20). Raises InputError without a cost-to-come, as from `ilqr`."""
        if self.cost_to_go is None or self.cost_to_come is None:
            got, want = f"a solution of {self.solver} without both value functions", "completed its passes, not shifted"
            raise InputError(f"total_cost: got {got}, want one of smooth that {want}")
        return TotalCost(self.cost_to_go, self.cost_to_come)

    def _shifted_parts(self, steps: int, shift: Callable[[npt.ArrayLike], Array]) -> dict[str, Any]:
        return {
            "inverse_policy": None, "cost_to_come": None, "candidates": (),
            "clearance": None if self.clearance is None else shift(self.clearance),
            "detail": joined(f"the rest of a solution after {steps} steps", self.detail),
        }  # fmt: skip

    def open_loop(self) -> "Solution":
        """The same plan with zero gains, for comparison: the planned controls, independent of the state.

        The value functions are still those of the feedback policy.
        """
        policy = replace(self.policy, gain=np.zeros_like(self.policy.gain), offset=self.trajectory.controls)
        return replace(self, policy=policy, inverse_policy=None)

    @property
    def log(self) -> str:
        """The iterations as a table, one line for each."""
        rows = [iteration.row(number) for number, iteration in enumerate(self.iterations, start=1)]
        return "\n".join([Iteration.HEADER, *rows])

    def summary(self) -> str:
        """The status with its remedy, cost, clearance, goal, limits, motion between knots, starts: at most 16 lines."""
        lines = [f"{self.status.name} after {len(self.iterations)} iterations of {self.solver}: {self.status.meaning}"]
        if self.detail:
            lines.append(f"  detail:    {self.detail}")
        if self.remedy:
            lines.append(f"  remedy:    {self.remedy}")
        gap = f"{self.gap:.1e}" if np.isfinite(self.gap) else "none (no cost-to-come)"
        optimality = f"{self.optimality:.1e}" if np.isfinite(self.optimality) else "unknown"
        lines.append(f"  cost:      {self.cost:.9g}   gap: {gap}   optimality: {optimality}")
        if self.curvature is not Curvature.NOT_CHECKED:
            lines[-1] += f"   curvature: {self.curvature}"
        if self.violation > 1e-6:  # the default tolerance
            lines[-1] += f"   violation: {self.violation:.1e}"
        if self.certificate.contacts is not None:
            lines.append(f"  contacts:  {self.certificate.contacts}")
        if "noise" in self.options:
            risk = self.options.get("risk")
            meant = f"log E exp(risk cost) / risk, risk {risk}" if risk else "an expectation"
            lines.append(f"  noise:     {self.options['noise']}; the cost is {meant}")
        if "duration" in self.options:
            lines.append(f"  duration:  {self.trajectory.horizon:.6g} s, free from {self.options['duration']}")
        if self.clearance is not None:
            knot = int(np.argmin(self.clearance))
            verdict = "collides" if self.clearance[knot] < 0 else "clear"
            lines.append(f"  clearance: {self.clearance[knot]:.3f} m at {knot * self.trajectory.dt:.2f} s ({verdict})")
        lines += [f"  goal:      {line}" for line in self._at_goal()]
        lines += [f"  limits:    {line}" for line in _first(self._beyond_limits(), 1)]
        lines += [f"  between:   {line}" for line in self._between_knots()]
        lines += [f"  starts:    {line}" for line in _first(self._search(), 2)]
        return "\n".join(lines)

    def _at_goal(self) -> list[str]:
        """Distance from the goal to the end of the plan, and whether the plan misses the goal."""
        if not np.isfinite(self.trajectory.states).all():
            return []
        lines = self.target.of_plan(self.target.radius_of_plan(self.goal_radius))
        return lines if self.success and not self.remedy else lines[:1]  # a remedy says what to do

    def _beyond_limits(self) -> list[str]:
        """A line for each control with a plan beyond its limits."""
        space, controls = self.policy.control_coordinates, self.trajectory.controls
        return [
            f"{label} is planned from {used.min():.3g} to {used.max():.3g}, beyond {low:.3g} to {high:.3g}"
            for label, used, low, high in zip(space.labels, controls.T, space.low, space.high, strict=True)
            if used.min() < low or used.max() > high
        ]

    def _between_knots(self) -> list[str]:
        """What is wrong between the knots, with the remedy; nothing for a plan that failed, or from a file."""
        if not self.success or "_examined" not in self._later:
            return []
        faults = self.between_knots()._faults(1e-6)  # the default tolerance
        remedies = {"accuracy": "accuracy=1e-6", "between_knots": "between_knots=True"}
        use = ", ".join(remedies[name] for name in faults)
        return [f"{'; '.join(faults.values())}; use Problem({use})"] if faults else []

    def _search(self) -> list[str]:
        """The start of the plan, and the results of other starts, if there were several."""
        if not self.candidates:
            return []
        ended = [candidate for candidate in self.candidates if candidate.status is not None]
        dropped = [candidate.cost for candidate in self.candidates if candidate.status is None]
        best = min(ended, key=lambda other: (other.status != self.status, abs(other.cost - self.cost))).start
        lines = [f"the plan is from the start {best!r}, one of {len(self.candidates)}"]
        if dropped:
            why = f"which cost {min(dropped):.6g} or more" if np.isfinite(min(dropped)) else "for no cost was finite"
            lines[0] += f"; {len(dropped)} {'was' if len(dropped) == 1 else 'were'} dropped, {why}"
        if (total := sum(candidate.iterations for candidate in self.candidates)) > len(self.iterations):
            lines[0] += f"; {total} iterations in all"
        others = [other for other in ended if other.start != best]
        costs = [f" at a cost of {other.cost:.6g}" if np.isfinite(other.cost) else "" for other in others]
        ends = zip(others, costs, strict=True)
        return lines + [f"{other.start} ended {other.status and other.status.name}{cost}" for other, cost in ends]

    __str__ = summary

    def _repr_html_(self) -> str:
        """Status, numbers and plan, for notebooks."""
        plan, target = self.trajectory, self.target
        rows = [("cost", number_text(self.cost)), ("iterations", str(len(self.iterations)))]
        rows += [(name, number_text(getattr(self, name))) for name in ("gap", "optimality", "violation")]
        if self.clearance is not None:
            rows.append(("clearance", f"{number_text(self.clearance.min())} m"))
        if np.isfinite(plan.states[-1]).all():
            distance = number_text(float(target.distance(plan.states[-1])))
            rows.append((f"from the {target.name}", f"{distance} {target.unit}"))
        rows.append(("horizon", f"{plan.steps} steps of {number_text(plan.dt)} s"))
        remarks = [text for text in (self.status.meaning, self.detail, self.remedy) if text]
        picture = drawing(self.policy.state_coordinates, plan.times, plan.states, np.empty((0, *plan.states.shape)))
        return of_table(f"{self.status.name}, {self.solver}", remarks, rows, picture, head=False)


def _first(lines: list[str], most: int) -> list[str]:
    """The first lines, and the number of further lines."""
    return lines if len(lines) <= most + 1 else [*lines[:most], f"and {len(lines) - most} more"]

"""A plan with its feedback law: the result of every solve. NumPy only."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, Index, Positive, checked
from lqrsim.errors import Array, InputError, check_shape
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import Horizon, Multipliers, Status, Trajectory, left_after
from lqrsim.results.value_functions import Quadratic


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A plan with its feedback law, and everything with which a later solve can begin.

    A `Solution` and a `Replan` are plans with a `cost` and a `violation`.

    Attributes:
      detail: where and why it failed; for solutions also remarks.
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

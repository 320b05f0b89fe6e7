"""A plan with the feedback law along it: what every solve returns, and what every run can follow. NumPy only."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_count, check_name, check_shape
from lqrsim.results.fields import LINE, Bounds, check_fields
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import HORIZONS, Multipliers, Status, Trajectory, left_after
from lqrsim.results.value_functions import Quadratic


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A plan with the feedback law along it, and what a next solve begins with.

    A `Solution` and a `Replan` are plans; both have a `cost` and a `violation` too.

    Attributes:
      status: how the solve ended; see `Status`.
      detail: where and why, if it is not a success.
      policy: the feedback law.
      trajectory: the plan: the rollout of the policy by the model from its first state.
      cost_to_go: the value function of the law, a `Quadratic`; None where it is not known, and of re-plans with
        constraints, which do not need it.
      multipliers: of each of the problem's constraints; none where the plan keeps them all without being made to.
      goal: (n,) the state that the problem asks for, NaN in states that do not matter; None where it names no state.
      goal_radius: within which the plan's end counts as at the goal, in `target.unit`; None where that is not known.
    """

    status: Status
    detail: Annotated[str, 10 * LINE]
    policy: AffinePolicy
    trajectory: Trajectory
    cost_to_go: Quadratic | None
    multipliers: tuple[Multipliers, ...] = ()
    goal: Annotated[Array, "n"] | None = None
    goal_radius: Annotated[float, Bounds(above=0.0)] | None = None

    def __post_init__(self) -> None:
        who = type(self).__name__
        check_fields(self)
        if self.cost_to_go is not None:
            check_shape(f"{who}: cost_to_go.gradient", self.cost_to_go.gradient, self.trajectory.states.shape)
        _ = self.target  # which refuses what is no goal
        if self.status.success and not self.trajectory.finite:
            raise InputError(
                f"{who}: trajectory: got NaN or infinity in a plan that is {self.status.name}, want numbers"
            )

    @property
    def success(self) -> bool:
        """Whether the solve converged: CONVERGED, or COST_CONVERGED where only the cost was asked for."""
        return self.status.success

    @property
    def target(self) -> Target:
        """What a run of the policy is to reach: the goal, or the plan's end where there is none."""
        return Target(self.policy.state_coordinates, self.goal, self.trajectory.states)

    def shifted(self, steps: int, *, horizon: str = "moving") -> Self:
        """The rest of it after `steps` steps, to begin the next solve with: `start=solution.shifted(k)`.

        Of a "moving" horizon the end is filled up: the last law, value function and multipliers stay in force, as a
        policy's last law does after its horizon, and the last control is held. A "shrinking" one has so many steps
        less. Status, log, cost and digest stay those of the whole.

        Args:
          steps: how many steps are over, less than the plan has.
          horizon: "moving" fills up the end, "shrinking" has fewer steps.

        Returns:
          A plan of the same type.

        Raises:
          InputError: `steps` is not a whole number from 0 to the last step, or `horizon` is neither of the two.
        """
        if check_count("steps", steps, at_least=0) >= self.trajectory.steps:
            raise InputError(f"steps: got {steps}, want less than {self.trajectory.steps}, the steps of the plan")
        filled = check_name("horizon", horizon, HORIZONS) == "moving"

        def moved(array: npt.ArrayLike) -> Array:
            return left_after(steps, array, filled=filled)

        plan, value = self.trajectory, self.cost_to_go
        if value is not None:
            value = Quadratic(moved(value.hessian), moved(value.gradient), moved(value.constant))
        parts = {
            "policy": self.policy.shifted(steps, horizon=horizon),
            "trajectory": Trajectory(moved(plan.states), moved(plan.controls), plan.dt),
            "cost_to_go": value,
            "multipliers": tuple(replace(one, values=moved(one.values)) for one in self.multipliers),
        }
        return replace(self, **parts, **self._shifted_parts(steps, moved))

    def _shifted_parts(self, steps: int, moved: Callable[[npt.ArrayLike], Array]) -> dict[str, Any]:
        """What else `shifted` changes: field -> new value. `moved` takes an array to what is left of it."""
        return {}


@dataclass(frozen=True, kw_only=True)
class Replan(Plan):
    """A plan from a given state that is no worse than where the law led that the solve began with.

    No worse means: it keeps the constraints if that did, misses them by no more if that did not, and of two plans that
    keep them it is not the more expensive one. It can be used whatever its status, unless `cost` is not finite. What it
    shares with a `Solution` is in `Plan`.

    Attributes:
      improved: whether there is a new plan; else this is where the law leads that the solve began with.
      cost: of the plan, start and end included.
      before: of where the law led that the solve began with.
      violation: by how much the worst constraint is missed at the steps; 0 where none is.
      iterations: how many there were.
      seconds: how long the solve took.
      iterating: how much of that, in seconds, the iterations took, and to see where the law leads that the solve began
        with.
    """

    improved: bool
    cost: float
    before: float
    violation: float
    iterations: int
    seconds: float
    iterating: float

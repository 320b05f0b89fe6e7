"""A plan with the feedback law along it: what every solve returns, and what every run can follow. NumPy only."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

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
    real,
)
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
    detail: str
    policy: AffinePolicy
    trajectory: Trajectory
    cost_to_go: Quadratic | None
    multipliers: tuple[Multipliers, ...] = ()
    goal: Array | None = None
    goal_radius: float | None = None

    def __post_init__(self) -> None:
        who = type(self).__name__
        check_kind(f"{who}: status", self.status, Status, f"a Status, one of {', '.join(Status.__members__)}")
        check_kind(f"{who}: detail", self.detail, str, "text")
        check_kind(f"{who}: policy", self.policy, AffinePolicy, "an AffinePolicy")
        check_kind(f"{who}: trajectory", self.trajectory, Trajectory, "a Trajectory")
        check_kind(f"{who}: cost_to_go", self.cost_to_go, (Quadratic, type(None)), "a Quadratic or None")
        multipliers = check_items(f"{who}: multipliers", self.multipliers, Multipliers, "a tuple of Multipliers")
        object.__setattr__(self, "multipliers", multipliers)
        if self.goal is not None:
            object.__setattr__(self, "goal", real(f"{who}: goal", self.goal))
        for name, (array, shape) in self._shapes().items():  # which refuses parts of several problems
            check_shape(f"{who}: {name}", array, shape)
        _ = self.target  # which refuses what is no goal
        if self.goal_radius is not None:
            radius = check_number(f"{who}: goal_radius", self.goal_radius, above=0.0)
            object.__setattr__(self, "goal_radius", radius)

    def _shapes(self) -> dict[str, tuple[Array, tuple[int | None, ...]]]:
        """Arrays by name, each with the shape that fits the trajectory."""
        states, steps = self.trajectory.states.shape, self.trajectory.steps
        gain = steps, self.trajectory.controls.shape[1], states[1]
        arrays: dict[str, tuple[Array, tuple[int | None, ...]]] = {"policy.gain": (self.policy.gain, gain)}
        if self.cost_to_go is not None:
            arrays["cost_to_go.gradient"] = self.cost_to_go.gradient, states
        if self.goal is not None:
            arrays["goal"] = self.goal, states[1:]
        return arrays | {f"multipliers[{i}]": (one.values, (steps + 1, None)) for i, one in enumerate(self.multipliers)}

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

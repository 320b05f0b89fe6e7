"""What a prepared solver answers with: a plan and its law, and what the next solve begins with. NumPy only."""

from dataclasses import dataclass, replace

import numpy.typing as npt

from lqrsim.errors import Array, check_items, check_kind
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import Multipliers, Status, Trajectory, left_after
from lqrsim.results.value_functions import Quadratic


@dataclass(frozen=True, kw_only=True)
class Replan:
    """A plan from a given state that is no worse than where the law led that the solve began with.

    No worse means: it keeps the constraints if that did, misses them by no more if that did not, and of two plans that
    keep them it is not the more expensive one.

    Attributes:
      status: how the solve ended; see `Status`. The plan can be used whatever it is, unless `cost` is not finite.
      detail: where and why, if it is not a success.
      improved: whether there is a new plan; else this is where the law leads that the solve began with.
      policy: the feedback law.
      trajectory: the plan, its rollout by the model.
      cost: of the plan, start and end included.
      before: of where the law led that the solve began with.
      violation: by how much the worst constraint is missed at the steps; 0 where none is.
      cost_to_go: with which the next solve begins; None with constraints, where it needs none.
      multipliers: with which the next solve begins.
      iterations: how many there were.
      seconds: how long the solve took.
      iterating: how much of that, in seconds, the iterations took, and to see where the law leads that the solve began
        with.
    """

    status: Status
    detail: str
    improved: bool
    policy: AffinePolicy
    trajectory: Trajectory
    cost: float
    before: float
    violation: float
    cost_to_go: Quadratic | None
    multipliers: tuple[Multipliers, ...]
    iterations: int
    seconds: float
    iterating: float

    def __post_init__(self) -> None:
        check_kind("Replan: status", self.status, Status, f"a Status, one of {', '.join(Status.__members__)}")
        check_kind("Replan: policy", self.policy, AffinePolicy, "an AffinePolicy")
        check_kind("Replan: trajectory", self.trajectory, Trajectory, "a Trajectory")
        check_kind("Replan: cost_to_go", self.cost_to_go, (Quadratic, type(None)), "a Quadratic or None")
        multipliers = check_items("Replan: multipliers", self.multipliers, Multipliers, "a tuple of Multipliers")
        object.__setattr__(self, "multipliers", multipliers)

    @property
    def success(self) -> bool:
        """Whether the solve converged within its time."""
        return self.status.success

    def shifted(self, steps: int, *, horizon: str = "moving") -> "Replan":
        """The rest of it after `steps` steps; see `Solution.shifted`.

        Args:
          steps: how many steps are over.
          horizon: "moving" or "shrinking", as in `Solution.shifted`.

        Returns:
          A Replan.
        """
        policy = self.policy.shifted(steps, horizon=horizon)
        plan, value, filled = self.trajectory, self.cost_to_go, horizon == "moving"

        def moved(array: npt.ArrayLike) -> Array:
            return left_after(steps, array, filled=filled)

        if value is not None:
            value = Quadratic(moved(value.hessian), moved(value.gradient), moved(value.constant))
        return replace(
            self, policy=policy, trajectory=Trajectory(moved(plan.states), moved(plan.controls), plan.dt),
            cost_to_go=value, multipliers=tuple(replace(one, values=moved(one.values)) for one in self.multipliers),
        )  # fmt: skip

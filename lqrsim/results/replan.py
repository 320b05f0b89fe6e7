"""What a prepared solver answers with: a plan and its law, and what the next solve begins with. NumPy only."""

from dataclasses import dataclass, replace

from lqrsim.errors import check_count, check_name
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution_parts import HORIZONS, Multipliers, Status, Trajectory, left_after
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
      policy: the feedback law. trajectory: the plan, its rollout by the model.
      cost: of the plan, start and end included. before: of where the law led that the solve began with.
      violation: by how much the worst constraint is missed at the steps; 0 where none is.
      cost_to_go, multipliers: what the next solve begins with.
      iterations: how many there were. seconds: how long the solve took. iterating: how much of that, in seconds, the
        iterations took.
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

    @property
    def success(self) -> bool:
        """Whether the solve converged within its time."""
        return self.status.success

    def shifted(self, steps: int, *, horizon: str = "moving") -> "Replan":
        """What is left of it after so many steps; see `Solution.shifted`."""
        kept = check_count("steps", steps, at_least=0, at_most=self.trajectory.steps - 1)
        filled = check_name("horizon", horizon, HORIZONS) == "moving"
        plan, value, policy = self.trajectory, self.cost_to_go, self.policy
        if value is not None:
            arrays = (value.hessian, value.gradient, value.constant)
            value = Quadratic(*(left_after(kept, array, filled=filled) for array in arrays))
        return replace(
            self,
            policy=policy.after(kept, filled=filled),
            trajectory=Trajectory(
                left_after(kept, plan.states, filled=filled), left_after(kept, plan.controls, filled=filled), plan.dt
            ),
            cost_to_go=value,
            multipliers=tuple(
                replace(one, values=left_after(kept, one.values, filled=filled)) for one in self.multipliers
            ),
        )

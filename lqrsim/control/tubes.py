"""Tubes: the covariance of a closed loop's deviation from its plan, and its chance of collision.

LQG-MP (van den Berg, Abbeel and Goldberg 2011): with the linear model about the plan, the true state and the estimate
are jointly Gaussian, and known before any run; `linear_loop.py` has the recursion.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lqrsim.control.collision_chance import Surroundings, collision_chance
from lqrsim.control.controllers import ControllerLike
from lqrsim.control.linear_loop import LinearLoop
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking_laws import check_plan
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_kind, check_number, shaped
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory


@dataclass(frozen=True, kw_only=True)
class Tube:
    """Predicted distribution of the closed loop about its plan.

    Attributes:
      plan: nominal states and controls.
      state_coordinates: names and units of the states.
      mean: mean of the deviation of the state, (T+1, n).
      covariance: covariance of that deviation, (T+1, n, n).
      across: covariance of the deviation with that at the knot before, (T, n, n).
      estimate_covariance: covariance of the error of the estimate, before each measurement, (T+1, n, n); None without a
        filter.
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: share of the commands that are beyond the limits, (T, m).
      step_chance: the chance of being in collision at each knot, (T+1,); bounded by the sum over obstacles.
      collision_chance: chance of colliding at all.

    Raises:
      InputError: arrays that do not fit together.
    """

    plan: Trajectory
    state_coordinates: Coordinates
    mean: Array
    covariance: Array
    across: Array
    estimate_covariance: Array | None
    command: Array
    saturation: Array
    step_chance: Array
    collision_chance: float

    def __post_init__(self) -> None:
        plan = check_kind("Tube: plan", self.plan, Trajectory, "a Trajectory")
        check_kind("Tube: state_coordinates", self.state_coordinates, Coordinates, "Coordinates")
        n, m, knots = len(self.state_coordinates), plan.controls.shape[-1], len(plan.states)
        shapes: dict[str, tuple[int, ...]] = {
            "mean": (knots, n), "covariance": (knots, n, n), "estimate_covariance": (knots, n, n),
            "command": (knots - 1, m), "saturation": (knots - 1, m), "step_chance": (knots,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if name != "estimate_covariance" or self.estimate_covariance is not None:
                object.__setattr__(self, name, shaped(f"Tube: {name}", getattr(self, name), shape))
        chance = check_number("Tube: collision_chance", self.collision_chance, at_least=0.0, at_most=1.0)
        object.__setattr__(self, "collision_chance", chance)

    @cached_property
    def position_covariance(self) -> Array:
        """(T+1, 2 or 3, 2 or 3)."""
        place = list(self.state_coordinates.position)
        return self.covariance[:, place][:, :, place]

    def added_to(self, rollout: Rollout) -> Rollout:
        """The rollout with the covariance of the position and the chance of collision, for its figures and videos.

        Args:
          rollout: rollout of the same plan.

        Returns:
          The rollout with its `tube` and `collision_chance`.

        Raises:
          InputError: it is a run of another plan, or of a robot without a position.
        """
        check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
        if not self.state_coordinates.position:
            raise InputError("Tube: state_coordinates.position: got none, want the 2 or 3 states that are the position")
        if not np.array_equal(rollout.plan.states, self.plan.states):
            raise InputError("rollout: got one of another plan than that of the tube, want a run of the tube's plan")
        return replace(rollout, tube=self.position_covariance, collision_chance=self.step_chance)


def predict_tube(
    problem: Problem, solution: Solution, uncertainty: Uncertainty, controller: ControllerLike | None = None
) -> Tube:
    """Predict the distribution of a run about its plan, and its chance of collision.

    Args:
      problem: the problem that was solved, with the obstacles in its costs and constraints.
      solution: the solution whose plan is run.
      uncertainty: the uncertainty in a run.
      controller: an OffsetFree or an AffinePolicy; by default the solution's policy.

    Returns:
      The Tube.

    Raises:
      InputError: something does not fit the system; the controller is of another kind; or the uncertainty has a latency
        or a delay, which the linear model does not have.
    """
    check_plan("predict_tube", problem, solution)
    check_kind("predict_tube: uncertainty", uncertainty, Uncertainty, "an Uncertainty, such as uncertainty_of(...)")
    plan = solution.trajectory
    if isinstance(controller, OffsetFree):
        loop = controller.loop()
    else:
        asked: object = solution.policy if controller is None else controller
        policy = check_kind("predict_tube: controller", asked, AffinePolicy, "an OffsetFree or an AffinePolicy")
        model = PlanModel.of(problem.dynamics, plan, uncertainty)
        at_plan = policy.state_coordinates.nearest(plan.states[:-1], policy.nominal)
        offset = np.einsum("tij,tj->ti", policy.gain, at_plan) + policy.offset - plan.controls
        space = policy.control_coordinates
        loop = LinearLoop(model, policy.gain, offset, None, np.array(space.low), np.array(space.high))
    return tube_of(loop, Surroundings.of(problem, uncertainty.obstacles))


def tube_of(loop: LinearLoop, surroundings: Surroundings) -> Tube:
    """The tube of a closed loop among obstacles. Raises InputError for a controller that the linear model does not
    cover.
    """
    model = loop.model
    for field in ("latency", "delay"):
        if getattr(model.uncertainty, field):
            raise InputError(
                f"Uncertainty: {field}: got {getattr(model.uncertainty, field)} control periods, want 0 for a tube:"
                " it has neither latency nor delay"
            )
    moments = loop.moments()
    n, size = model.n, model.size
    mean, covariance = moments.mean[:, :n], moments.covariance[:, :n, :n]
    estimate = None
    if loop.filter_gain is not None:
        whole = moments.covariance
        guess, both = whole[:, size : size + n, size : size + n], whole[:, :n, size : size + n]
        estimate = covariance + guess - both - both.transpose(0, 2, 1)
    chance, total = collision_chance(model.plan.states + mean, covariance, moments.across, surroundings)
    return Tube(
        plan=model.plan, state_coordinates=model.dynamics.state_coordinates, mean=mean, covariance=covariance,
        across=moments.across, estimate_covariance=estimate, command=moments.command,
        saturation=moments.saturation, step_chance=chance, collision_chance=total,
    )  # fmt: skip

"""A Kalman filter about a plan, and the law that follows its estimates: matrices, made ahead of time."""

from dataclasses import dataclass

import numpy as np

from lqrsim.control.kalman import KalmanFilter
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking_laws import Weights, tracking_laws
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.plan import Plan


@dataclass(frozen=True)
class FilterLaw:
    """A filter and the law `u = gain z + offset` of its estimates z, about one plan.

    Attributes:
      plan: what it is about, as it was solved for.
      model: the linear model about it, which the filter believes.
      filter: its gains and covariances.
      weights: what deviations from the plan cost the law.
      gain: (T, m, Z). offset: (T, m).
      nominal: (T+1, Z), what z is in an undisturbed run.
    """

    plan: Plan
    model: PlanModel
    filter: KalmanFilter
    weights: Weights
    gain: Array
    offset: Array
    nominal: Array

    @classmethod
    def of(
        cls, plan: Plan, model: PlanModel, kalman: KalmanFilter, weights: Weights, granted: Array | None = None
    ) -> "FilterLaw":
        """The law about the model's plan, which takes states (D,) of the unknowns for granted, by default zeros."""
        trajectory = model.plan
        granted = np.zeros(len(model.transition)) if granted is None else granted
        gain, offset = tracking_laws(model, weights)
        # In what the filter estimates, and not in deviations from the plan.
        unknowns = np.tile(granted, (trajectory.steps + 1, 1))
        nominal = np.concatenate([trajectory.states, model.reached, unknowns], axis=1)
        offset = trajectory.controls + offset - np.einsum("tij,tj->ti", gain, nominal[:-1])
        return cls(plan, model, kalman, weights, gain, offset, nominal)

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        """Of the states and of the controls."""
        return self.plan.policy.state_coordinates, self.plan.policy.control_coordinates

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lowest and highest controls, (m,) each."""
        controls = self.plan.policy.control_coordinates
        return np.array(controls.low), np.array(controls.high)

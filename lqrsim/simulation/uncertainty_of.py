"""Disturbances as numbers, in the form that filters, tracking laws and predicted tubes use."""

from collections.abc import Sequence

import numpy as np

from lqrsim.annotations import checked
from lqrsim.control.controllers import ControllerLike
from lqrsim.control.tubes import Tube, predict_tube
from lqrsim.control.uncertainty import Uncertainty, gathered
from lqrsim.errors import InputError, check_kind
from lqrsim.problem.belief import Belief
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.simulation.disturbances import Disturbance, as_disturbances
from lqrsim.simulation.plant import Plant


@checked
def uncertainty_of(plant: Plant, disturbances: Sequence[Disturbance | Noise]) -> Uncertainty:
    """Convert disturbances to zero-mean Gaussian uncertainty. Disturbances that do not fit are left out, by name.

    A fixed value (`MeanWind`, the `factor` of a mismatch) counts as unknown, with its size as standard deviation. A
    truncated normal distribution counts with its own standard deviation. Losses in bursts count as independent ones,
    and displaced obstacles as displaced equally along all axes. `left_out` lists, with reasons, the disturbances that
    the robot's dynamics do not declare, and all that are not small, lasting and linear: pushes, narrower limits, the
    loss of an actuator.

    Args:
      disturbances: as in `simulate`; your own kinds have a method `uncertainty`.
    """
    parts = list[Uncertainty]()
    for disturbance in as_disturbances(disturbances):
        disturbance.check(plant)
        field = f"{type(disturbance).__name__}: uncertainty"
        wanted = "a method that returns an Uncertainty"
        parts.append(check_kind(field, disturbance.uncertainty(plant), Uncertainty, wanted))
    total = gathered(parts)
    total.check(plant.robot.dynamics)
    return total


def tube_under(
    problem: Problem, solution: Solution, plant: Plant, disturbances: Sequence[Disturbance],
    controller: ControllerLike | None = None,
) -> tuple[Tube | None, str]:  # fmt: skip
    """The predicted tube of a run, if there is one, and a line on what it leaves out, or why there is none.

    Without disturbances there is neither a tube nor a line.
    """
    if not disturbances:
        return None, ""
    try:
        uncertainty = None if isinstance(problem.dynamics, Belief) else uncertainty_of(plant, disturbances)
        if not problem.dynamics.state_coordinates.position:
            raise InputError("the robot has no position")
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable loop overflows; it is refused below
            tube = predict_tube(problem, solution, uncertainty, controller)
        if not np.isfinite(tube.covariance).all():
            raise InputError("the loop is not stable, its covariance is not finite")
    except InputError as error:
        return None, f"no predicted tube: {error}"
    if uncertainty is None:
        return tube, "the predicted tube has the noise and the readings of the plan, and no other disturbances"
    left_out = uncertainty.left_out
    return tube, f"the predicted tube leaves out {'; '.join(left_out)}" if left_out else ""

"""The tube of a run under disturbances as `simulate` takes them, or why there is none."""

from collections.abc import Sequence

import numpy as np

from lqrsim.control.controllers import ControllerLike
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.tubes import Tube, predict_tube
from lqrsim.errors import InputError
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.uncertainty_of import uncertainty_of


def tube_under(
    problem: Problem,
    solution: Solution,
    plant: Plant,
    disturbances: Sequence[Disturbance],
    controller: ControllerLike | None = None,
) -> tuple[Tube | None, str]:
    """What `predict_tube` says of a run, if it can, and a line to print: why it cannot, or what it leaves out.

    Undisturbed there is nothing to predict, and nothing to print.

    Args:
      problem: that was solved. solution: its solution. plant, disturbances, controller: as `simulate` takes them.
    """
    if not disturbances:
        return None, ""
    try:
        uncertainty = uncertainty_of(plant, disturbances)
        if not problem.dynamics.state_coordinates.position:
            raise InputError("the robot has no position")
        # Its filter has the states that what it was told of has, and no others.
        if isinstance(controller, OffsetFree) and repr(controller.uncertainty) != repr(uncertainty):
            raise InputError("the controller was told of other disturbances than it meets")
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that is not stable; refused as not finite
            tube = predict_tube(problem, solution, uncertainty, controller)
        if not np.isfinite(tube.covariance).all():
            raise InputError("the loop is not stable, its covariance is not finite")
    except InputError as error:
        return None, f"no predicted tube: {error}"
    left_out = uncertainty.left_out
    return tube, f"the predicted tube leaves out {'; '.join(left_out)}" if left_out else ""

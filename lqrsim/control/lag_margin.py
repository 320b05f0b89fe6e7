"""A margin against a stated lag that does not exist.

A filter and a law that are told of a lag compensate for it: the law commands more, and the filter explains unexpected
motion by actuators that run ahead of their commands. Without the lag, both overcompensate. Such a loop may be unstable
with any tolerances, and the robot then leaves its plan even undisturbed.

Each design is therefore also predicted without the lag. If that is much worse, milder designs compete with it: the
filter assumes noise on the controls that bypasses the actuators, which is the effect of an unknown lag, and it may be
told of only a part of the lag. Among the designs that stay about as near to the plan if the lag exists, the one with
the least chance of failure with and without the lag is chosen. A lag of several control periods leaves little choice:
without it the robot stays near its plan, but may miss its goal.

Designs that do well without their lag, such as those for the quadrotor, stay as they are.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lqrsim.control.filter_law import Design
from lqrsim.control.kalman import kalman_filter
from lqrsim.control.linear_loop import LinearLoop
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking import Prediction, StateMoments, narrowest, predictions, worth_of
from lqrsim.control.tracking_laws import Weights
from lqrsim.errors import Array
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution

# Weight of a failure without the lag, relative to a failure with it. The value is our choice: with a larger one,
# designs lose performance with the lag.
ABSENT = 0.3
# The increase in the chance of failure without the lag from which other designs compete; a tube of six times the width
# counts as much.
CLIFF = 0.1
# What milder filters are told: a fraction of the stated lag, and noise that bypasses the actuators, relative to the
# tolerated effort times `Lag.mean`.
MILDER = ((1.0, 0.05), (1.0, 0.2), (0.75, 0.2), (0.5, 0.2))
# The largest width of the tube with the lag, relative to the narrowest.
WIDER = 1.25
GONE = Prediction(chance=1.0, width=1e30, saturation=1.0)  # for a loop whose moments are not finite


def with_margin(
    problem: Problem, solution: Solution, stated: PlanModel, design: Design, tried: Callable[[], Weights],
    assumed: Callable[[float, float], PlanModel],
) -> Design:  # fmt: skip
    """The design, or a milder one if it is much worse without the lag.

    Args:
      stated: model of the true system, with a lag.
      design: of one law.
      tried: makes the weights of C laws that may be chosen.
      assumed: model for a filter that is told of this share of the lag, with this much doubt.
    """
    told, space = stated.uncertainty.as_steady, solution.policy.control_coordinates
    limits = np.array(space.low), np.array(space.high)
    present, absent = (replace(stated, uncertainty=replace(told, lag=lag)) for lag in (told.lag, 0.0))

    def predicted(one: Design, laws: tuple[Array, Array]) -> tuple[list[Prediction], list[Prediction]]:
        """The predictions for C laws, with the lag and without it."""
        found = []
        for truth in (present, absent):
            moments, lost = _moments(LinearLoop(truth, *laws, one.filter.gain, *limits, one.model))
            shown = predictions(problem, solution, told, stated, moments)
            found.append([GONE if gone else own for gone, own in zip(lost, shown, strict=True)])
        return found[0], found[1]

    gain, offset = design.laws
    with_lag, without = predicted(design, (gain[None], offset[None]))
    least = narrowest(stated, with_lag)
    if worth_of(without, least)[0] <= worth_of(with_lag, least)[0] + CLIFF:
        return design
    weights = tried()
    models = [assumed(share, doubt) for share, doubt in MILDER]
    designs = [replace(design, weights=weights), *(Design(model, kalman_filter(model), weights) for model in models)]
    found = [predicted(one, one.laws) for one in designs]
    least = narrowest(stated, [one for with_lag, _ in found for one in with_lag])
    worth = np.array([np.add(worth_of(one, least), ABSENT * np.array(worth_of(other, least))) for one, other in found])
    worth[np.array([[each.width > WIDER * least for each in with_lag] for with_lag, _ in found])] = np.inf
    i, j = np.unravel_index(int(np.argmin(worth)), worth.shape)
    return replace(designs[i], weights=weights.pick(int(j)))


def _moments(loop: LinearLoop) -> tuple[StateMoments, npt.NDArray[np.bool_]]:
    """Moments of the true system under C laws, and which of them are not finite, (C,): zeros instead."""
    n = loop.model.n
    with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
        found = loop.moments()
        lost = np.asarray(~np.isfinite(found.covariance).all(axis=(1, 2, 3)))
        parts = found.mean[..., :n], found.covariance[..., :n, :n], found.across, found.saturation.mean(axis=(1, 2))
    for part in parts:
        part[lost] = 0.0
    return StateMoments(*parts), lost

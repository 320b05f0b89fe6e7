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

from lqrsim.control.filter_law import Design
from lqrsim.control.kalman import kalman_filter
from lqrsim.control.linear_loop import LinearLoop
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking import Predictions, narrowest, predictions, worth_of
from lqrsim.control.tracking_laws import Weights
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
GONE = (1.0, 1e30, 1.0)  # the predictions for a loop whose moments are not finite


def with_margin(
    problem: Problem, solution: Solution, stated: PlanModel, design: Design, tried: Callable[[], Weights],
    assumed: Callable[[float, float], PlanModel],
) -> Design:  # fmt: skip
    """The design, or a milder one if it is much worse without the lag.

    Args:
      stated: model of the true system, with a lag.
      tried: makes the weights of C laws that may be chosen.
      assumed: model for a filter that is told of this share of the lag, with this much doubt.
    """
    told, space = stated.uncertainty.as_steady, solution.policy.control_coordinates
    limits = np.array(space.low), np.array(space.high)
    # Without losses of commands, a model without a lag has no actuators' states. One with the shortest lag has them.
    none = 0.0 if told.command_loss else np.finfo(np.float64).tiny
    truths = [stated.under(replace(told, lag=lag)) for lag in (told.lag, none)]

    def predicted(one: Design) -> Predictions:
        """The predictions for C laws, with the lag and without it: (2, C)."""
        loops = LinearLoop(truths[0], *one.laws, one.filter.gain, *limits, one.model).in_systems(truths)
        with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
            found = loops.moments(stated.n)
            lost = np.asarray(~np.isfinite(found.covariance).all(axis=(-3, -2, -1)))
        for part in found:
            part[lost] = 0.0
        shown = predictions(problem, solution, told, stated, found)
        return Predictions(*(np.where(lost, gone, own) for gone, own in zip(GONE, shown, strict=True)))

    found = predicted(design)
    worth = worth_of(found, narrowest(stated, found.width[0]))
    if worth[1, 0] <= worth[0, 0] + CLIFF:
        return design
    weights = tried()
    models = [assumed(share, doubt) for share, doubt in MILDER]
    designs = [
        Design.of(design.model, design.filter, weights),
        *(Design.of(model, kalman_filter(model), weights) for model in models),
    ]
    found = [predicted(one) for one in designs]
    widths = np.array([one.width[0] for one in found])
    least = narrowest(stated, widths)
    worth = np.array([worth_of(one, least) for one in found])
    worth = np.where(widths > WIDER * least, np.inf, worth[:, 0] + ABSENT * worth[:, 1])
    i, j = np.unravel_index(int(np.argmin(worth)), worth.shape)
    return designs[i].pick(int(j))

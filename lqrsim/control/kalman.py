"""The Kalman filter about a plan, in square-root form, with gains that are computed in advance.

The gains can be computed in advance because they do not depend on the measurements. The filter propagates square roots
of its covariances by orthogonal transformations, and never subtracts covariances. The covariances stay positive
semidefinite, and each standard deviation keeps its own relative precision. This holds even if sensors are exact, if two
sensors measure the same quantity, or if two unknowns are nearly identical.
"""

from typing import NamedTuple

import numpy as np

from lqrsim.codegen.compiled_module import module_of
from lqrsim.codegen.sources import source_of
from lqrsim.control.plan_model import PlanModel
from lqrsim.errors import Array, InputError
from lqrsim.kernels import square_root_filter
from lqrsim.kernels.records import FilterModel, FilterRoots, FilterSizes, zeros_of

# The least noise of a measured number, relative to the standard deviation of its prediction. It makes the covariance of
# exact or redundant sensors invertible. A decision on the rank would also be discontinuous.
RESOLUTION = 1e-6
NOTHING = 1e-150  # the least noise if the prediction is certain: its square is still a positive number
# The largest correction of an unknown by one measurement, in standard deviations of that correction. If all is as
# stated, one correction in 5e8 is larger. In a run, such corrections have other causes: a command or the first
# measurement was lost, or there was a push that nobody stated. Attributed to a mass, the error of a state can make the
# mass negative. The limit doubles with each measurement that exceeds it. A gate, which rejects measurements, could lock
# out for good what differs far from its statement.
PLAUSIBLE = 6.0


class KalmanFilter(NamedTuple):
    """A filter's gains and covariances."""

    gain: Array  # K, (T+1, Z, Y)
    predicted: Array  # (T+1, Z, Z), covariance of the error of z before the measurement of each knot
    corrected: Array  # (T+1, Z, Z), the same after it
    corrected_root: Array  # lower triangular square roots of `corrected`, with nonnegative diagonals
    innovation: Array  # (T+1, Y, Y), covariance of the measurement minus its prediction
    limit: Array  # (T+1, D), largest correction of each state of the unknowns by one measurement; see `PLAUSIBLE`


def kalman_filter(model: PlanModel, known: Array | None = None) -> KalmanFilter:
    """The filter of a plan's model.

    Args:
      known: square root (Z, Z) of the covariance after the measurement of the first knot, if that measurement has been
        used already; the gain there is then zero. By default the filter begins before that measurement, with the
        model's start.
    """
    size, measured, n, disturbing = model.size, model.sensor.size, model.n, model.disturbing
    sizes = FilterSizes(
        model.plan.steps + 1, size, measured, n, disturbing.shape[2], known is not None, RESOLUTION, NOTHING
    )
    work = np.empty(max((measured + size) * (n + measured + size), size * (size + disturbing.shape[2])))
    arrays = {"root": np.array(model.start_root if known is None else known, order="C"), "work": work}
    roots = zeros_of(FilterRoots, arrays, T=model.plan.steps, Z=size, Y=measured)
    system = FilterModel(*map(np.ravel, (model.F, model.H, model.measurement_root, disturbing)))
    filter_along = module_of(source_of(square_root_filter), "Kalman filters").filter_along
    filter_along(sizes, system, FilterRoots(*map(np.ravel, roots)))
    _, before, after, innovation_root, learned, _ = roots
    limit = PLAUSIBLE * np.sqrt((learned[:, n + model.lagging :] ** 2).sum(axis=2))
    predicted, corrected, innovation = (root @ root.transpose(0, 2, 1) for root in (before, after, innovation_root))
    return KalmanFilter(_gains(learned, innovation_root), predicted, corrected, after, innovation, limit)


def _gains(learned: Array, root: Array) -> Array:
    """K of K S = learned (T+1, Z, Y), for lower triangular S (T+1, Y, Y), of all knots at once.

    OpenBLAS solves even such small systems with all its threads, which then wait for each other.
    """
    gain = np.empty_like(learned)
    for j in range(root.shape[1] - 1, -1, -1):
        solved = (gain[:, :, j + 1 :] @ root[:, j + 1 :, j, None])[:, :, 0]
        gain[:, :, j] = (learned[:, :, j] - solved) / root[:, j, j, None]
    return gain


def check_observable(model: PlanModel) -> None:
    """Raise InputError, with the name, for an unknown that moves the robot but changes no measurement."""
    first = model.n + model.lagging
    effect, groups = np.eye(model.size)[:, first:], [list(indices) for indices in model.own_states]
    moved, seen = np.zeros(model.size - first), np.zeros(model.size - first)
    for t in range(model.plan.steps + 1):
        moved = np.maximum(moved, np.abs(effect[: model.n]).max(axis=0, initial=0.0))
        seen = np.maximum(seen, np.abs(model.H[t] @ effect[: model.n]).max(axis=0, initial=0.0))
        if all(seen[group].any() for group in groups):
            return
        if t < model.plan.steps:
            effect = model.F[t] @ effect
    for unknown, group in zip(model.remembered, groups, strict=True):
        if (unknown.std or unknown.drift) and moved[group].max() > 0 and not seen[group].max() > 0:
            measured = ", ".join(model.sensor.names)
            raise InputError(
                f"OffsetFree: unknowns: got {unknown.name}, which no measurement sees ({measured}),"
                " want sensors that see its effect"
            )

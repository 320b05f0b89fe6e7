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
from lqrsim.kernels import recursions
from lqrsim.kernels.records import FilterModel, FilterRoots, FilterSizes, zeros_of

# The least standard deviation of a measured number's noise, relative to that of its prediction. It makes the innovation
# covariance of exact or redundant sensors invertible. To decide on its rank instead would be discontinuous.
RESOLUTION = 1e-6
LEAST_STD = 1e-150  # the same, absolute, if the prediction is certain: its square is still a positive number
# The largest correction of an unknown by one measurement, in standard deviations of it. If the model is right,
# one correction in 5e8 is larger. In a run, such corrections have other causes: a lost command or first measurement or
# a push that the uncertainty lacks. Attributed to a mass, the error of a state can make the mass negative. The limit
# doubles with each measurement that exceeds it. A validation gate, which rejects such measurements, could reject a
# parameter that is far from its stated value for ever.
PLAUSIBLE = 6.0


class KalmanFilter(NamedTuple):
    """A filter's gains and covariances."""

    gain: Array  # K, (T+1, Z, Y)
    predicted: Array  # (T+1, Z, Z), covariance of the error of z before the measurement of each knot
    corrected: Array  # (T+1, Z, Z), the same after it
    corrected_root: Array  # (T+1, Z, Z), lower triangular square roots of `corrected`, with nonnegative diagonals
    innovation: Array  # (T+1, Y, Y), covariance of the measurement minus its prediction
    limit: Array  # (T+1, D), largest correction of each state of the unknowns by one measurement; see `PLAUSIBLE`


def kalman_filter(model: PlanModel, known: Array | None = None) -> KalmanFilter:
    """The filter for a plan's model.

    Args:
      known: a square root (Z, Z) of the covariance after the measurement of the first knot, if the filter about an
        earlier plan has used that measurement; the gain there is then zero. By default the filter begins before that
        measurement, with the model's `start_root`.
    """
    size, measured, n, disturbing = model.size, model.sensor.size, model.n, model.disturbing
    sizes = FilterSizes(
        model.plan.steps + 1, size, measured, n, disturbing.shape[2], known is not None, RESOLUTION, LEAST_STD
    )
    work = np.empty(max((measured + size) * (n + measured + size), size * (size + disturbing.shape[2])))
    arrays = {"root": np.array(model.start_root if known is None else known, order="C"), "work": work}
    roots = zeros_of(FilterRoots, arrays, T=model.plan.steps, Z=size, Y=measured)
    system = FilterModel(*map(np.ravel, (model.F, model.H, model.measurement_root, disturbing)))
    filter_along = module_of(source_of(recursions), "Kalman filters").filter_along
    filter_along(sizes, system, FilterRoots(*map(np.ravel, roots)))
    _, before, after, innovation_root, correction_root, _ = roots
    limit = PLAUSIBLE * np.sqrt((correction_root[:, n + model.lagging :] ** 2).sum(axis=2))
    predicted, corrected, innovation = (root @ root.transpose(0, 2, 1) for root in (before, after, innovation_root))
    return KalmanFilter(_gains(correction_root, innovation_root), predicted, corrected, after, innovation, limit)


def _gains(correction_root: Array, root: Array) -> Array:
    """The K of K S = `correction_root` (T+1, Z, Y), for lower triangular S = `root` (T+1, Y, Y), at all knots at once.

    By substitution: OpenBLAS solves even such small systems with all its threads, which then wait for each other.
    """
    gain = np.empty_like(correction_root)
    for j in range(root.shape[1] - 1, -1, -1):
        solved = (gain[:, :, j + 1 :] @ root[:, j + 1 :, j, None])[:, :, 0]
        gain[:, :, j] = (correction_root[:, :, j] - solved) / root[:, j, j, None]
    return gain


def check_observable(model: PlanModel) -> None:
    """Raise InputError that names an unknown, if it moves the robot but changes no measurement of the plan's model."""
    first = model.n + model.lagging
    effect, groups = np.eye(model.size)[:, first:], [list(indices) for indices in model.unknown_states]
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
            raise InputError(f"OffsetFree: unknowns: got {unknown.name}, want one that a measurement sees: {measured}")

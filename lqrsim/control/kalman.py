"""The Kalman filters about a plan: of measured states, and of the sensors of an MJCF.

`kalman_filter` computes its gains in advance, because they do not depend on the measurements. It propagates square
roots of its covariances by orthogonal transformations, and never subtracts covariances. The covariances stay positive
semidefinite, and each standard deviation keeps its own relative precision. This holds even if sensors are exact, if two
sensors measure the same quantity, or if two unknowns are nearly identical.

Sensors of an MJCF have rates, delays and losses of their own. `SensorFilter` estimates (z, b): z as in `plan_model.py`,
and b, the biases of the readings that have one. States are predicted by the nonlinear dynamics and readings by MuJoCo,
both with the estimates. Covariances are propagated in the run, because they depend on what got lost; their derivatives
are those along the plan.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.control.plan_model import STEP, PlanModel, recursions
from lqrsim.control.uncertainty import per_entry, triangular_root
from lqrsim.errors import Array, InputError
from lqrsim.kernels.records import FilterModel, FilterRoots, FilterSizes, zeros_of
from lqrsim.robots.sensors import RobotSensors

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
    system = FilterModel(*map(np.ravel, (model.step.F, model.H, model.measurement_root, disturbing)))
    recursions().filter_along(sizes, system, FilterRoots(*map(np.ravel, roots)))
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
            effect = model.step.F[t] @ effect
    for unknown, group in zip(model.remembered, groups, strict=True):
        if (unknown.std or unknown.drift) and moved[group].max() > 0 and not seen[group].max() > 0:
            measured = ", ".join(model.sensor.names)
            raise InputError(f"OffsetFree: unknowns: got {unknown.name}, want one that a measurement sees: {measured}")


# A reading does not depend on the state if its derivatives are below this: differences of MuJoCo's are good to 1e-9.
_SILENT = 1e-8
_WRENCH = tuple(f"{what}_{axis}" for what in ("force", "torque") for axis in "xyz")
_WIND = "wind_x", "wind_y", "wind_z"


class Estimate(NamedTuple):
    """The estimates of K trials at a knot."""

    z: Array  # (K, Z)
    bias: Array  # (K, B)
    covariance: Array  # of the errors of both, (K, Z+B, Z+B)

    def copy(self) -> "Estimate":
        return Estimate(*(array.copy() for array in self))


@dataclass(frozen=True, eq=False)
class SensorFilter:
    """The filter about a plan."""

    model: PlanModel  # the linear model that the filter assumes
    sensors: RobotSensors

    @cached_property
    def biased(self) -> npt.NDArray[np.intp]:
        """The numbers of the readings that have a bias, (B,)."""
        return np.flatnonzero(self.sensors.per_reading("bias") + self.sensors.per_reading("bias_walk"))

    @cached_property
    def late(self) -> list[int]:
        """For each sensor, the number of periods after which its reading arrives."""
        return self.sensors.delay_periods(self.model.plan.dt)

    @cached_property
    def _wrench(self) -> Array:
        """From the values of the unknown parameters to the force and torque on the robot, (6, P)."""
        names, wrench = self.model.parameters, np.zeros((6, len(self.model.parameters)))
        for j, name in enumerate(names):
            if name in _WRENCH:
                wrench[_WRENCH.index(name), j] = 1.0
            elif name in _WIND:
                wrench[_WIND.index(name), j] = self.sensors.drag
        return wrench

    def acting(self, z: Array, controls: Array) -> tuple[Array, Array]:
        """The controls (K, m) and the force and torque (K, 6) under which readings are taken, for estimates (K, Z).

        The command of the period before was `controls` (K, m).
        """
        model, first = self.model, self.model.n + self.model.lagging
        unknown = np.vecdot(model.output, z[:, None, first:])
        parameters, gains, offsets = np.split(unknown, [len(model.parameters), len(model.parameters) + model.m], axis=1)
        reached = z[:, model.n : first] if model.lagging else controls
        return reached * (1 + gains) + offsets, np.vecdot(self._wrench, parameters[:, None])

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array]:
        """Central differences of the readings along the plan: for states, controls, and force and torque."""
        plan, model = self.model.plan, self.model
        before = np.maximum(np.arange(plan.steps + 1) - 1, 0)
        at = np.concatenate([plan.states, plan.controls[before], np.zeros((plan.steps + 1, 6))], axis=1)
        read, slopes = self.sensors.reader(), np.empty((plan.steps + 1, len(self.sensors.names), at.shape[1]))
        for j in range(at.shape[1]):
            step = STEP * np.maximum(np.abs(at[:, j]), 1.0)
            sides = []
            for sign in (1.0, -1.0):
                moved = at.copy()
                moved[:, j] += sign * step
                sides.append(read(*np.split(moved, [model.n, model.n + model.m], axis=1)))
            slopes[:, :, j] = (self.aligned(sides[0], sides[1]) - sides[1]) / (2 * step[:, None])
        slopes[np.isnan(slopes)] = 0.0  # where a rangefinder meets nothing
        states, controls, wrench = np.split(slopes, [model.n, model.n + model.m], axis=2)
        return states, controls, wrench

    @cached_property
    def H(self) -> Array:
        """Output matrices of (z, b), (T+1, Y, Z+B)."""
        model, (states, controls, wrench) = self.model, self._slopes
        knots, count, first = len(states), len(self.sensors.names), model.n + model.lagging
        H = np.zeros((knots, count, model.size + len(self.biased)))
        H[:, :, : model.n] = states
        H[:, :, model.n : first] = controls[:, :, : model.lagging]
        planned = model.plan.controls[np.maximum(np.arange(knots) - 1, 0)]
        effects = np.concatenate([wrench @ self._wrench, controls * planned[:, None], controls], axis=2)
        H[:, :, first : model.size] = effects @ model.output
        for sensor, at in zip(self.sensors.sensors, self.sensors.columns, strict=True):
            if np.abs(H[:, at, : model.size]).max(initial=0.0) < _SILENT:
                got = f"{sensor.name!r}, whose reading is the same in all states near the plan"
                raise InputError(f"OffsetFree: sensors: got {got}, want sensors that see the robot")
        H[:, self.biased, model.size + np.arange(len(self.biased))] = 1.0
        return H

    @cached_property
    def noise(self) -> Array:
        """Variances of the readings' noise, (T+1, Y): the sensors' own, and that of white forces and controls.

        Those of one knot count as independent of each other and of the noise on the state.
        """
        model, (_, controls, wrench) = self.model, self._slopes
        uncertainty, space = model.uncertainty, model.dynamics.control_coordinates
        shaken = controls * (per_entry("Uncertainty: control", uncertainty.control, space) * (not model.lagging))
        variance = self.sensors.per_reading("noise") ** 2 + np.vecdot(shaken, shaken)
        for unknown in uncertainty.unknowns:
            values = np.array([unknown.shares.get(name, 0.0) for name in model.parameters])
            if unknown.white and values.any():
                variance = variance + (unknown.std * wrench @ (self._wrench @ values)) ** 2
        return variance

    def start(self, trials: int, z: Array) -> Estimate:
        """The estimate before the first reading, with the same z (Z,) for all trials."""
        size, biased = self.model.size, len(self.biased)
        covariance = np.zeros((trials, size + biased, size + biased))
        covariance[:, :size, :size] = self.model.start_root @ self.model.start_root.T
        biases = size + np.arange(biased)
        covariance[:, biases, biases] = self.sensors.per_reading("bias")[self.biased] ** 2
        return Estimate(np.tile(z, (trials, 1)), np.zeros((trials, biased)), covariance)

    def predict(self, covariance: Array, knot: int) -> None:
        """Propagate covariances (K, Z+B, Z+B) in place over the period that ends at a knot."""
        model, t = self.model, min(knot, self.model.plan.steps) - 1
        size, F = model.size, model.step.F[t]
        covariance[:, :size] = F @ covariance[:, :size]
        covariance[:, :, :size] = covariance[:, :, :size] @ F.T
        covariance[:, :size, :size] += model.process_noise[t]
        biases = size + np.arange(len(self.biased))
        covariance[:, biases, biases] += self.sensors.per_reading("bias_walk")[self.biased] ** 2 * model.plan.dt

    def correct(self, covariance: Array, knot: int, arrived: npt.NDArray[np.bool_], innovation: Array) -> Array:
        """Correct covariances in place by the readings that have `arrived` (K, Y), one number after the other.

        By readings minus their predictions, `innovation` (K, Y), it returns the corrections of (z, b), (K, Z+B).
        """
        t = min(knot, self.model.plan.steps)
        correction = np.zeros(covariance.shape[:2])
        for i in np.flatnonzero(arrived.any(axis=0)):
            row = self.H[t, i]
            seen = np.vecdot(covariance, row)
            variance = np.vecdot(seen, row)
            variance += np.maximum(self.noise[t, i], RESOLUTION**2 * variance) + LEAST_STD**2
            gain = np.where(arrived[:, i, None], seen / variance[:, None], 0.0)
            correction += gain * np.where(arrived[:, i], innovation[:, i] - np.vecdot(correction, row), 0.0)[:, None]
            covariance -= gain[:, :, None] * seen[:, None, :]
        return correction

    def due(self, knot: int) -> npt.NDArray[np.bool_]:
        """Which numbers of the readings (Y,) are taken at a knot."""
        return np.repeat(self.sensors.due(knot, self.model.plan.dt), self._sizes)

    @cached_property
    def along(self) -> KalmanFilter:
        """Its covariances about the plan if no reading gets lost.

        The gain and the innovation are those of a filter that measures what the estimate learns from one knot to the
        next; laws are designed by no more.
        """
        model, size, knots = self.model, self.model.size, self.model.plan.steps + 1
        slowest, corrected = max(self.late), np.empty((knots, size, size))
        fully_corrected, late = self.start(1, np.zeros(size)).covariance, np.repeat(self.late, self._sizes)
        for t in range(knots):
            covariance = fully_corrected
            for k in range(max(t - slowest, 0), t + 1):
                covariance = covariance.copy()
                if k:
                    self.predict(covariance, k)
                arrived = self.due(k) & (k + late <= t)
                self.correct(covariance, k, arrived[None], np.zeros((1, len(arrived))))
                if k == t - slowest:
                    fully_corrected = covariance
            corrected[t] = covariance[0, :size, :size]
        before = model.start_root @ model.start_root.T
        predicted = np.concatenate([before[None], model.step.F @ corrected[:-1] @ model.step.F.transpose(0, 2, 1)])
        predicted[1:] += model.process_noise
        learned, root = _root(predicted - corrected), triangular_root(_root(corrected))
        identity = np.broadcast_to(np.eye(size), learned.shape)
        return KalmanFilter(learned, predicted, corrected, root, identity, np.zeros((knots, len(model.transition))))

    @property
    def _sizes(self) -> list[int]:
        return [at.stop - at.start for at in self.sensors.columns]

    def aligned(self, readings: Array, reference: Array) -> Array:
        """The readings (K, Y), with each quaternion or its negative, whichever is nearer to that of the reference."""
        aligned = readings.copy()
        for at, turns in zip(self.sensors.columns, self.sensors.quaternions, strict=True):
            if turns:
                aligned[:, at] *= np.where(np.vecdot(readings[:, at], reference[:, at]) < 0, -1.0, 1.0)[:, None]
        return aligned


def _root(covariance: Array) -> Array:
    """A square root of each covariance, (T+1, Z, Z); rounding may have made one slightly indefinite."""
    variances, axes = np.linalg.eigh(covariance)
    return axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]

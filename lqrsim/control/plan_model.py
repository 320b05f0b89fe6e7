"""The linear model about a plan, on which tracking laws and tubes are based, and its Kalman filter.

A deviation from the plan is z = (e, a, d): the deviation of the state (n), the deviation of the actuators' states (m if
they lag, else none), and the states of the unknowns (D). With u the deviation of the command,

    z_{t+1} = F_t z_t + G_t u_t + c_t + w_t,   y_t = H_t e_t + v_t.

c is the effect of actuator lag on a plan that was made without lag. The nominal states of the actuators are those to
which the planned controls drive them.
If commands get lost, F, G and c are means over two cases: a command that arrives, and a lost command, after which the
actuators stay as they are.

`kalman_filter` computes its gains in advance, because they do not depend on the measurements. It propagates square
roots of its covariances by orthogonal transformations, and never subtracts covariances. The covariances stay positive
semidefinite, and each standard deviation keeps its own relative precision. This holds even if sensors are exact, if two
sensors measure the same quantity, or if two unknowns are nearly identical.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
from lqrsim.codegen.sources import Source, source_of, text_source
from lqrsim.codegen.user_functions import check_signature, name_of
from lqrsim.control.uncertainty import GAIN, OFFSET, Uncertainty, Unknown, per_entry, shaping_filter
from lqrsim.errors import Array, InputError, check_array, check_items, check_name, excerpt
from lqrsim.kernels import feedback
from lqrsim.kernels import recursions as recursion_kernels
from lqrsim.kernels.records import (
    DynamicsModel,
    FilterModel,
    FilterRoots,
    FilterSizes,
    Predictor,
    SensorModel,
    zeros_of,
)
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers.compiled import dynamics_model

# None for all states, names of states, a matrix (Y, n), or a function h(x, u, p) of SymPy symbols.
Sensors = None | Sequence[str] | npt.ArrayLike | Callable[[Any, Any, Any], Any]


class Sensor(NamedTuple):
    """A function of the state that is measured."""

    source: Source  # `measure(x, data, out)` and `measure_slope(x, data, out)`; see `kernels/declarations.py`
    data: Array  # their parameters
    size: int  # Y, the number of measured values
    names: tuple[str, ...]  # of the values, in messages


def sensor_of(sensors: Sensors, space: Coordinates) -> Sensor:
    """Return the sensor for a user's `sensors`."""
    if sensors is None:
        sensors = space.names
    if callable(sensors):
        return _symbolic(sensors, space.names)
    if isinstance(sensors, str):
        raise InputError(f"sensors: got {excerpt(sensors)}, want a tuple of names: ({excerpt(sensors)},)")
    listed: Any = sensors
    if isinstance(listed, (list, tuple)) and all(isinstance(entry, str) for entry in listed):
        names = check_items("sensors", listed, str, f"a tuple of names of states, of {', '.join(space.names)}")
        if not names or len(set(names)) < len(names):
            raise InputError(f"sensors: got {excerpt(listed)}, want at least one state, each at most once")
        chosen = [space.names.index(check_name("sensors", name, space.names)) for name in names]
        source = "def measure(x, data, out):\n" + "".join(f"    out[{i}] = x[{j}]\n" for i, j in enumerate(chosen))
        source += "def measure_slope(x, data, out):\n"
        source += "".join(f"    out[{i}, {j}] = 1.0\n" for i, j in enumerate(chosen))
        return Sensor(text_source(source, "sensors"), np.zeros(1), len(names), names)
    matrix = check_array("sensors", listed, (None, len(space)))
    if not len(matrix):
        raise InputError("sensors: got no rows, want a matrix with one for each number that is measured")
    rows = len(matrix)
    source = f"def measure(x, data, out):\n    for i in range({rows}):\n        out[i] = 0.0\n"
    source += "        for j in range(N):\n            out[i] += data[N * i + j] * x[j]\n"
    source += f"def measure_slope(x, data, out):\n    for i in range({rows}):\n        for j in range(N):\n"
    source += "            out[i, j] = data[N * i + j]\n"
    return Sensor(
        text_source(source, "sensors"), matrix.ravel().copy(), rows, tuple(f"row {i} of sensors" for i in range(rows))
    )


def _symbolic(function: Callable[[Any, Any, Any], Any], states: Sequence[str]) -> Sensor:
    check_signature(function, ("x", "u", "p"))
    of = name_of(function)

    def make() -> dict[str, Any]:
        values, x, _ = symbolic.trace(function, states, (), [])
        if not values:
            raise InputError(f"sensors: got {of}, which returns nothing, want at least one number that is measured")
        slopes = {(i, j): value.diff(xj) for i, value in enumerate(values) for j, xj in enumerate(x)}
        slopes = {f"out[{i}, {j}]": slope for (i, j), slope in slopes.items() if slope != 0}
        assigned = {f"out[{i}]": value for i, value in enumerate(values)}
        source = symbolic.write_function("measure", "x, data, out", "data", assigned, of=of)
        source += symbolic.write_function("measure_slope", "x, data, out", "data", slopes, of=of)
        return {"source": source, "size": len(values)}

    written = symbolic.kept(function, ("sensor", states), make, source=str, size=int)
    size = int(written["size"])
    return Sensor(text_source(str(written["source"]), of), np.zeros(1), size, tuple(f"{of}[{i}]" for i in range(size)))


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
# The step of differences by a parameter p is STEP max(1, |p|), but at most OF_SMALL |p|, for a moment of inertia may be
# 1e-5 kg m^2. This cap is at least LEAST_STEP, below which rounding dominates.
STEP, OF_SMALL, LEAST_STEP = 1e-5, 1e-3, 1e-10


@dataclass(frozen=True)
class Lag:
    """A first-order lag of the actuators over a control period."""

    left: float  # the remaining fraction of the distance to the command at the end of the period
    mean: float  # its average over the period

    @classmethod
    def of(cls, time_constant: float, dt: float) -> "Lag":
        if time_constant == 0:
            return cls(0.0, 0.0)
        step = dt / time_constant
        return cls(float(np.exp(-step)), float(-np.expm1(-step) / step))


class PlanDerivatives:
    """A system linearised along a plan, whatever the uncertainty: its steps, and what the sensors measure.

    Attributes:
      dynamics: the system, with disturbances as parameters. n, m: numbers of states and of controls.
    """

    def __init__(self, dynamics: Dynamics, plan: Trajectory, sensor: Sensor | None = None) -> None:
        self.dynamics, self.plan = dynamics.disturbed, plan
        self.sensor = sensor or sensor_of(None, dynamics.state_coordinates)
        self.n, self.m = plan.states.shape[1], plan.controls.shape[1]
        self._slopes = dict[str, Array]()  # of the steps in each parameter that was asked for

    @cached_property
    def compiled(self) -> CompiledModule:
        """`kernels/feedback.py`, for the functions of the plan's knots alone."""
        source = source_of(feedback, Y=self.sensor.size, NUMBERS=len(self.model.parameters))
        return module_of(source, f"a plan of {self.n} states and {self.m} controls", N=self.n, M=self.m)

    @cached_property
    def model(self) -> DynamicsModel:
        """The dynamics, for compiled code."""
        return dynamics_model(self.dynamics)

    @cached_property
    def compiled_sensor(self) -> SensorModel:
        module = module_of(self.sensor.source, "sensors", N=self.n, M=self.m)
        measure, slope = module.addresses("measure", "measure_slope")
        return SensorModel(measure, slope, self.sensor.data)

    @cached_property
    def jacobian(self) -> Array:
        """[A B] of each step, (T, n, n + m)."""
        plan = self.plan
        following, jacobian = np.empty((plan.steps, self.n)), np.empty((plan.steps, self.n, self.n + self.m))
        states, controls = in_c_order(plan.states), in_c_order(plan.controls)
        with self.dynamics.quiet():
            self.compiled.slopes_along(plan.steps, states, controls, self.model, plan.dt, following, jacobian)
        return jacobian

    def effect(self, parameter: str) -> Array:
        """The derivative of the next state in a parameter at each step, (T, n, 1)."""
        if parameter not in self._slopes:
            plan, slopes = self.plan, np.empty((self.plan.steps, self.n, 1))
            size, index = abs(self.dynamics.parameters[parameter]), self.dynamics.places[parameter]
            most = max(OF_SMALL * size, LEAST_STEP) if size > 0 else np.inf
            indices, changes = np.array([float(index)]), np.array([min(STEP * max(size, 1.0), most)])
            states, controls = in_c_order(plan.states), in_c_order(plan.controls)
            with self.dynamics.quiet():
                self.compiled.parameter_slopes(
                    plan.steps, states, controls, self.model, plan.dt, indices, changes, slopes
                )
            self._slopes[parameter] = slopes
        return self._slopes[parameter]

    @cached_property
    def H(self) -> Array:
        """Output matrices H_t, (T+1, Y, n)."""
        H = np.empty((self.plan.steps + 1, self.sensor.size, self.n))
        self.compiled.sensor_slopes(len(H), in_c_order(self.plan.states), self.compiled_sensor, H)
        return H

    def reach(self, effort: Array, periods: Sequence[int]) -> Array:
        """The motion of each state by random controls of an effort (m,), in each number of periods, (periods, n).

        It is the rms over the plan, and over all states of the same unit.
        """
        n, steps, units = self.n, self.plan.steps, self.dynamics.state_coordinates.units
        A, B = self.jacobian[:, :, :n], self.jacobian[:, :, n:]
        moved, squares = B * effort, np.zeros((max(periods), n))
        for k in range(min(len(squares), steps)):
            squares[k] = np.vecdot(moved, moved).mean(axis=0)
            moved = A[k + 1 :] @ moved[:-1]
        reach = np.sqrt(np.maximum(squares.cumsum(axis=0), 1e-24))[np.array(periods) - 1]
        same = np.array([[unit == other for other in units] for unit in units], dtype=np.float64)
        return np.sqrt(reach**2 @ same / same.sum(axis=0))


class LinearSteps(NamedTuple):
    """The linear model of all steps."""

    F: Array  # (T, Z, Z)
    G: Array  # (T, Z, m)
    c: Array  # (T, Z)


class PlanModel:
    """A plan linearised, with an uncertainty.

    Attributes:
      dynamics, plan, sensor, n, m: those of the derivatives.
      lagging: number of entries of z for the actuators. size: of z.
      arrived: the lag for a command that arrives. lag: as a mean over commands that arrive and commands that get lost.
      parameters: the parameters of the dynamics that are unknown.
      remembered: the unknowns that have states. unknown_states: for each of these, the indices of its states.
      transition: transition matrix of the unknowns' states, (D, D).
      output: from these to values of the parameters, and the gain and the offset of each control, (P + 2 m, D).
      measurement_std: standard deviation of the noise on each measured state, (n,).
    """

    def __init__(self, derivatives: PlanDerivatives, uncertainty: Uncertainty) -> None:
        self.derivatives, self.uncertainty = derivatives, uncertainty
        self.dynamics, self.plan, self.sensor = derivatives.dynamics, derivatives.plan, derivatives.sensor
        uncertainty.check(self.dynamics)
        self.n, self.m, dt = derivatives.n, derivatives.m, self.plan.dt
        lost, self.arrived = uncertainty.command_loss, Lag.of(uncertainty.lag, dt)
        self.lagging = self.m if uncertainty.lag > 0 or lost > 0 else 0
        self.lag = Lag(lost + (1 - lost) * self.arrived.left, lost + (1 - lost) * self.arrived.mean)
        named = dict.fromkeys(name for unknown in uncertainty.unknowns for name in unknown.shares)
        self.parameters = tuple(name for name in named if name in self.dynamics.parameters)
        self.remembered = tuple(unknown for unknown in uncertainty.unknowns if not unknown.white)
        self._filters = [shaping_filter(unknown, dt) for unknown in self.remembered]
        ends = np.cumsum([0, *(len(shaping.output) for shaping in self._filters)])
        self.unknown_states = [range(first, end) for first, end in pairwise(ends.tolist())]
        self.transition = _diagonal([shaping.transition for shaping in self._filters])
        columns = [
            self._weights(unknown)[:, None] * shaping.output
            for unknown, shaping in zip(self.remembered, self._filters, strict=True)
        ]
        self.output = np.concatenate([np.zeros((len(self.parameters) + 2 * self.m, 0)), *columns], axis=1)
        self.size = self.n + self.lagging + len(self.transition)
        states = self.dynamics.state_coordinates
        self._steps = dict[Lag, LinearSteps]()
        self.measurement_std = per_entry("Uncertainty: measurement", uncertainty.measurement, states)

    def _weights(self, unknown: Unknown) -> Array:
        """The weights of an unknown in the parameters, and the gain and the offset of each control, (P + 2 m,)."""
        controls, count = self.dynamics.control_coordinates.names, len(self.parameters)
        weights = np.zeros(count + 2 * self.m)
        for name, weight in unknown.shares.items():
            if name.startswith(GAIN):
                weights[count + controls.index(name.removeprefix(GAIN))] = weight
            elif name.startswith(OFFSET):
                weights[count + self.m + controls.index(name.removeprefix(OFFSET))] = weight
            else:
                weights[self.parameters.index(name)] = weight
        return weights

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of z for messages, (Z,)."""
        names = [*self.dynamics.state_coordinates.names]
        names += [f"what {control} has reached" for control in self.dynamics.control_coordinates.names[: self.lagging]]
        for unknown, states in zip(self.remembered, self.unknown_states, strict=True):
            names += [unknown.name] * len(states)
        return tuple(names)

    # For compiled code.

    @cached_property
    def compiled(self) -> CompiledModule:
        """`kernels/feedback.py`, for these sizes."""
        unknown = len(self.parameters)
        source = source_of(
            feedback, LAG=self.lagging, D=len(self.transition), Y=self.sensor.size, P=unknown, Z=self.size,
            V=unknown + 2 * self.m, NUMBERS=len(self.derivatives.model.parameters),
            PADDED_D=max(len(self.transition), 1),
        )  # fmt: skip
        label = f"a filter of {self.size} numbers ({self.n} states, {self.m} controls)"
        return module_of(source, label, N=self.n, M=self.m)

    @cached_property
    def predictor(self) -> Predictor:
        places = self.dynamics.places
        unknown = np.array([places[name] for name in self.parameters], dtype=np.float64)
        lag = np.array([self.lag.left, self.lag.mean])
        return Predictor(self.derivatives.model, self.plan.dt, unknown, lag, self.transition, self.output)

    # Along the plan.

    @cached_property
    def effects(self) -> Array:
        """Effect of the parameters, gains and offsets on the next state, (T, n, P + 2 m)."""
        B, slopes = self.derivatives.jacobian[:, :, self.n :], map(self.derivatives.effect, self.parameters)
        return np.concatenate([*slopes, B * self.plan.controls[:, None, :], B], axis=2)

    @property
    def step(self) -> LinearSteps:
        """The model, as a mean over commands that arrive and commands that get lost."""
        return self.step_with(self.lag)

    def step_with(self, lag: Lag) -> LinearSteps:
        """The model for a lag: with `arrived`, a lost command is as if it had been the actuators' states."""
        if lag in self._steps:
            return self._steps[lag]
        n, a, steps, jacobian = self.n, self.lagging, self.plan.steps, self.derivatives.jacobian
        F, G = np.zeros((steps, self.size, self.size)), np.zeros((steps, self.size, self.m))
        F[:, :n, :n] = jacobian[:, :, :n]
        F[:, :n, n : n + a] = lag.mean * jacobian[:, :, n : n + a]
        F[:, :n, n + a :] = self.effects @ self.output
        F[:, n : n + a, n : n + a] = lag.left * np.eye(a)
        F[:, n + a :, n + a :] = self.transition
        G[:, :n] = (1 - lag.mean) * jacobian[:, :, n:]
        G[:, n : n + a] = (1 - lag.left) * np.eye(self.m)[:a]
        c = np.zeros((steps, self.size))
        if a:
            behind = self.reached[:-1] - self.plan.controls
            c[:, :n] = np.einsum("tij,tj->ti", jacobian[:, :, n:], lag.mean * behind)
            c[:, n : n + a] = (lag.left - self.lag.left) * behind
        self._steps[lag] = LinearSteps(F, G, c)
        return self._steps[lag]

    @cached_property
    def reached(self) -> Array:
        """The actuators' states at each knot under the planned controls, (T+1, m or none)."""
        plan, a = self.plan, self.lagging
        reached = np.zeros((plan.steps + 1, a))
        reached[0] = last = plan.controls[0, :a]
        for t, control in enumerate(plan.controls if a else ()):
            reached[t + 1] = last = control + self.lag.left * (last - control)
        return reached

    # Noise, as square roots: a root times its transpose is the covariance.

    @cached_property
    def start_root(self) -> Array:
        """Square root of the covariance of z at the start, (Z, Z)."""
        std = per_entry("Uncertainty: start", self.uncertainty.start, self.dynamics.state_coordinates)
        at_rest = np.zeros((self.lagging, self.lagging))
        return _diagonal([np.diag(std), at_rest, *(shaping.start for shaping in self._filters)])

    @cached_property
    def disturbing(self) -> Array:
        """Effects on z of independent standard normal numbers that add up to w: another square root, (T, Z, any).

        The last columns, of the model's error and of the unknowns, are the same at all steps.
        """
        n, m, first, uncertainty = self.n, self.m, self.n + self.lagging, self.uncertainty
        states, controls = self.dynamics.state_coordinates, self.dynamics.control_coordinates
        white = [unknown.std * self._weights(unknown) for unknown in uncertainty.unknowns if unknown.white]
        constant = m + len(white)
        root = np.zeros((self.plan.steps, self.size, constant + n + self.size - first))
        commanded = self.step_with(self.arrived).G
        root[:, :, :m] = commanded * per_entry("Uncertainty: control", uncertainty.control, controls)
        if uncertainty.lag == 0:
            root[:, n:first, :m] = 0.0  # the command that stays in force after a loss has new noise
        if white:
            root[:, :n, m:constant] = self.effects @ np.array(white).T
        error = per_entry("Uncertainty: model_error", uncertainty.model_error, states)
        root[:, range(n), range(constant, constant + n)] = error
        root[:, first:, constant + n :] = _diagonal([shaping.noise for shaping in self._filters])
        return root

    @cached_property
    def process_noise(self) -> Array:
        """Covariance of w, (T, Z, Z)."""
        varying, constant = np.split(self.disturbing, [self.lagging - self.size], axis=2)
        return varying @ varying.transpose(0, 2, 1) + constant[0] @ constant[0].T


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
    size, n, H, disturbing = model.size, model.n, model.derivatives.H, model.disturbing
    measured = model.sensor.size
    sizes = FilterSizes(
        model.plan.steps + 1, size, measured, n, disturbing.shape[2], known is not None, RESOLUTION, LEAST_STD
    )
    work = np.empty(max((measured + size) * (n + measured + size), size * (size + disturbing.shape[2])))
    arrays = {"root": np.array(model.start_root if known is None else known, order="C"), "work": work}
    roots = zeros_of(FilterRoots, arrays, T=model.plan.steps, Z=size, Y=measured)
    system = FilterModel(*map(np.ravel, (model.step.F, H, H * model.measurement_std, disturbing)))
    recursions().filter_along(sizes, system, FilterRoots(*map(np.ravel, roots)))
    _, before, after, innovation_root, correction_root, _ = roots
    limit = PLAUSIBLE * np.sqrt((correction_root[:, n + model.lagging :] ** 2).sum(axis=2))
    predicted, corrected, innovation = (root @ root.transpose(0, 2, 1) for root in (before, after, innovation_root))
    # The K of K innovation_root = correction_root at all knots, by substitution, for the roots are lower triangular.
    # OpenBLAS solves even such small systems with all its threads, which then wait for each other.
    gain = np.empty_like(correction_root)
    for j in range(measured - 1, -1, -1):
        solved = (gain[:, :, j + 1 :] @ innovation_root[:, j + 1 :, j, None])[:, :, 0]
        gain[:, :, j] = (correction_root[:, :, j] - solved) / innovation_root[:, j, j, None]
    return KalmanFilter(gain, predicted, corrected, after, innovation, limit)


def recursions() -> CompiledModule:
    """`kernels/recursions.py`, compiled once for the filters, laws and moments of all sizes."""
    return module_of(source_of(recursion_kernels), "filters, laws and moments along a plan")


def _diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    matrix, at = np.zeros((size, size)), 0
    for block in blocks:
        matrix[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return matrix

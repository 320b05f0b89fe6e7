"""Offset-free output feedback: no steady error under constant disturbances and wrong parameters.

A Kalman filter estimates the state, the actuators' outputs and the unknowns. A tracking law acts on all the estimates.
Both are designed with the linear model about the plan. A run predicts with the nonlinear dynamics; the export, an
`OutputFeedbackPolicy`, is linear about the plan.

Sensors of an MJCF have rates, delays and losses of their own. `SensorFilter` estimates (z, b): z as in `plan_model.py`,
and b, the biases of the readings that have one. States are predicted by the nonlinear dynamics and readings by MuJoCo,
both with the estimates. Covariances are propagated in the run, because they depend on what got lost; their derivatives
are those along the plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.controllers import Controller, ControllerRun, check_plan, turn_to_nearest, turning_of
from lqrsim.control.plan_model import (
    LEAST_STD,
    RESOLUTION,
    STEP,
    KalmanFilter,
    Lag,
    PlanDerivatives,
    PlanModel,
    Sensors,
    kalman_filter,
    sensor_of,
)
from lqrsim.control.prediction import LinearLoop
from lqrsim.control.replanner import ReplanLog, ReplanRule, SolveRequest
from lqrsim.control.tracking import (
    AT_END,
    DeviationLaw,
    Judge,
    Predictions,
    Weights,
    choose_tolerances,
    effort_of,
    tolerances_to_try,
    tracking_law,
)
from lqrsim.control.uncertainty import OFFSET, Uncertainty, Unknown, check_seconds, per_entry, triangular_root
from lqrsim.errors import Array, InputError, check_kind
from lqrsim.kernels.feedback import FAR
from lqrsim.kernels.records import Limits, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, PerEntry, Spaces, spaces_of
from lqrsim.results.policy import OutputFeedbackPolicy
from lqrsim.results.solution import Plan, Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import RobotSensors
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.compiled import policy_about
from lqrsim.solvers.settings import InitialGuess

# The least errors that a filter assumes, relative to the tolerated effort: in each control, and in each state's
# prediction, as if this effort had moved the state. A model is never exact: disturbances do not act evenly over a
# control period, integration has errors, and the gains are computed about the plan. With exact sensors, a filter
# without this assumption would infer unknowns from the last digits of its prediction errors.
INEXACT = 0.02
# The assumed difference between the command in force and the lost command, relative to the tolerated effort. This value
# is our choice: up to a loss of one half, nothing between 0.3 and 1 does better.
STALE = 0.3
# A reading does not depend on the state if its derivatives are below this: differences of MuJoCo's are good to 1e-9.
_SILENT = 1e-8
_WRENCH = tuple(f"{what}_{axis}" for what in ("force", "torque") for axis in "xyz")
_WIND = "wind_x", "wind_y", "wind_z"
MEMORY = 5.0  # s, the default of `OffsetFree`
# Choice of a design that tolerates the absence of the stated lag; see `robust_to_lag`. Weight of the score without the
# lag, relative to the score with it. The value is our choice: with a larger one, designs lose performance with the lag.
WITHOUT_LAG = 0.3
# How much higher the score without the lag must be for milder designs to compete: as much as a chance of failure of
# 0.1, or as a tube of six times the width.
MUCH_WORSE = 0.1
# What the filters of milder designs assume: a fraction of the stated lag; and noise on the controls that bypasses the
# actuators; see `assumed_model`.
MILDER = ((1.0, 0.05), (1.0, 0.2), (0.75, 0.2), (0.5, 0.2))
WIDEST = 1.25  # the largest width of the chosen tube with the lag, relative to the narrowest of all designs


def assumed_model(
    derivatives: PlanDerivatives, stated: Uncertainty, memory: float, effort: Array, bypass: float = 0.0
) -> PlanModel:
    """The model that a filter assumes, with a memory in s: see `Uncertainty.steady`. Nothing is exact.

    `bypass` is noise on controls that bypasses the actuators, relative to effort times `Lag.mean`: `robust_to_lag`.
    """
    space, controls = derivatives.dynamics.state_coordinates, derivatives.dynamics.control_coordinates
    steady, moved, lost = stated.steady(memory), derivatives.reach(effort, [2])[0], stated.command_loss
    control = per_entry("Uncertainty: control", stated.control, controls)
    control = np.hypot(control, np.sqrt(lost * (1 - lost)) * STALE * effort)  # the filter expects the mean
    error = per_entry("Uncertainty: model_error", stated.model_error, space)
    behind = zip(controls.names, bypass * Lag.of(stated.lag, derivatives.plan.dt).mean * effort, strict=True)
    directly = [Unknown(OFFSET + name, float(std), time_constant=0.0) for name, std in behind if std]
    assumed = replace(
        steady, unknowns=(*steady.unknowns, *directly),
        control=tuple(np.maximum(control, INEXACT * effort).tolist()),
        model_error=tuple(np.maximum(error, INEXACT * moved).tolist()),
    )  # fmt: skip
    return PlanModel(derivatives, assumed)


def check_observable(model: PlanModel) -> None:
    """Raise InputError that names an unknown, if it moves the robot but changes no measurement of the plan's model."""
    first = model.n + model.lagging
    effect, groups = np.eye(model.size)[:, first:], [list(indices) for indices in model.unknown_states]
    moved, seen = np.zeros(model.size - first), np.zeros(model.size - first)
    for t in range(model.plan.steps + 1):
        moved = np.maximum(moved, np.abs(effect[: model.n]).max(axis=0, initial=0.0))
        seen = np.maximum(seen, np.abs(model.derivatives.H[t] @ effect[: model.n]).max(axis=0, initial=0.0))
        if all(seen[group].any() for group in groups):
            return
        if t < model.plan.steps:
            effect = model.step.F[t] @ effect
    for unknown, group in zip(model.remembered, groups, strict=True):
        if (unknown.std or unknown.drift) and moved[group].max() > 0 and not seen[group].max() > 0:
            measured = ", ".join(model.sensor.names)
            raise InputError(f"OffsetFree: unknowns: got {unknown.name}, want one that a measurement sees: {measured}")


@dataclass(frozen=True, eq=False)
class FilterLaw:
    """A filter with the law that acts on its estimates, about one plan."""

    solution: Plan  # whose trajectory is the model's plan
    model: PlanModel
    filter: KalmanFilter
    tracking: DeviationLaw
    planned_unknowns: Array | float = 0.0  # their states (D,) with which the plan was made
    begins_at: int = 0  # step of a run at which its plan begins

    @cached_property
    def absolute(self) -> Policy:
        """The law of the estimates z themselves, u = gain z + offset: (T, m, Z) and (T, m)."""
        gain, offset = policy_about(self.nominal, self.model.plan.controls + self.tracking.offset, self.tracking.gain)
        return Policy(in_c_order(gain), offset)

    @cached_property
    def nominal(self) -> Array:
        """z in an undisturbed run, (T+1, Z)."""
        states, reached = self.model.plan.states, self.model.reached
        unknowns = np.zeros((len(states), len(self.model.transition))) + self.planned_unknowns
        return np.concatenate([states, reached, unknowns], axis=1)


class FilterRun(ControllerRun):
    """A run of `OffsetFree` with K trials: their estimates z (K, Z) at the knot of the newest measurement.

    If measurements are late by k periods, the filter runs k periods behind. Its estimate is predicted forward with the
    commands since, to the time at which the next command acts.
    """

    def __init__(self, law: FilterLaw, trials: int, record: bool) -> None:
        self.law = law
        self.model = law.model  # for predictions, independent of a later plan's assumptions about the unknowns
        self._trials = trials
        self.z = np.tile(law.nominal[0], (trials, 1))
        self._diverged: dict[int, str] = {}
        self._innovation = np.empty((trials, law.model.sensor.size))
        self._limit_factors = np.ones(trials)  # factors on the limits of corrections; see `kernels/feedback.py`
        shape, sizes = (law.model.plan.steps + 1, trials), (law.model.size, law.model.sensor.size)
        self.estimates, self.innovations = (np.full((*shape, size), np.nan) if record else None for size in sizes)
        self._limits = Limits(*law.solution.policy.control_coordinates.limits)
        self._turning = turning_of(law.model.dynamics.state_coordinates)
        self._latency, self._delay = law.model.uncertainty.latency, law.model.uncertainty.delay
        # Commands since the knot of z, the oldest first. Until the first ones arrive, the plan's are applied.
        controls = law.model.plan.controls
        self._commands = [np.tile(controls[min(i, len(controls) - 1)], (trials, 1)) for i in range(self._delay)]

    def control(self, step: int, measured: Array) -> Array:
        self.update(step, measured)
        return self.command(step)

    def estimator_diverged(self) -> Mapping[int, str]:
        return self._diverged

    def update(self, step: int, measured: Array) -> None:
        """Predict the estimate to the knot of a step's measurement, and correct it."""
        if step < self._latency:  # no measurement has arrived
            return
        law, model = self.law, self.model
        if step > self._latency:
            self._predict(self.z, self._commands.pop(0))
        # After the horizon the last gain stays in force.
        knot = min(step - law.begins_at - self._latency, law.model.plan.steps)
        lost = np.isnan(measured).all(axis=1).astype(np.float64)
        model.compiled.correct(
            self._trials, in_c_order(measured), lost, in_c_order(law.model.plan.states[knot]),
            law.filter.gain[knot], law.filter.limit[knot], self._limit_factors, model.derivatives.compiled_sensor,
            self._turning, self.z, self._innovation,
        )  # fmt: skip
        at = step - self._latency
        if self.estimates is not None and self.innovations is not None and at < len(self.estimates):
            self.estimates[at], self.innovations[at] = self.z, self._innovation

    def command(self, step: int) -> Array:
        """The controls of a step, after its measurement was used."""
        law, model = self.law, self.model
        predicted = self.z
        if self._commands:
            predicted = predicted.copy()
            for command in self._commands:
                self._predict(predicted, command)
        t = min(step - law.begins_at + self._delay, law.model.plan.steps - 1)
        out = np.empty((self._trials, self.model.m))
        nominal = in_c_order(law.model.plan.states[t])
        at_step = Policy(law.absolute.gain[t], law.absolute.offset[t])
        model.compiled.command(self._trials, predicted, nominal, at_step, self._limits, self._turning, out)
        self._commands.append(out.copy())
        first_implausible = np.empty(self._trials)
        model.compiled.diverged(self._trials, predicted, first_implausible)
        for k in np.flatnonzero(first_implausible < model.size):
            i = int(first_implausible[k])
            fault = f"is beyond {FAR:g}" if np.isfinite(predicted[k, i]) else "is not finite"
            self._diverged.setdefault(int(k), f"the estimate of {model.names[i]} {fault}")
        return out

    def _predict(self, estimates: Array, commands: Array) -> None:
        with self.model.dynamics.quiet():
            self.model.compiled.predict(self._trials, in_c_order(commands), self.model.predictor, estimates)


class OffsetFree(Controller):
    """Tracks a plan, with estimates of the state, the actuators' outputs and the unknowns.

    Gains are computed in advance, about the plan. Predictions use the nonlinear dynamics with the estimated
    unknowns. A measurement that got lost is predicted; a run is shown it as NaN. One that is late by
    `uncertainty.latency` is used at the time to which it belongs. The filter uses commands after saturation, so there
    is no windup. The filter never assumes an exact model: controls are off by at least 2 % of the tolerated effort, and
    predicted states by at least 2 % of what that effort moves them in two periods. A single measurement changes an
    unknown by at most six standard deviations of such a correction; see `PLAUSIBLE`. If a design for the stated lag
    would do much worse without the lag, a milder one is chosen, whose tube with the lag is at most a quarter wider:
    see `robust_to_lag`. `model.uncertainty` is the uncertainty that the filter assumes.

    The other arguments are as in `track`.

    Args:
      uncertainty: as stated, such as by `uncertainty_of`. The filter assumes that unknowns that vary may have a mean,
        and that constants may change by about their standard deviation in `memory` seconds: see `Uncertainty.steady`.
      sensors: names of the states that are measured, by default all; or a matrix (Y, n); or a function h(x, u, p) of
        SymPy symbols, as in `Dynamics`, that does not depend on u; or sensors of the MJCF, `plant.sensors(...)`, each
        with its own noise, bias, rate, delay and loss: see `SensorFilter`. With these the uncertainty says nothing
        of measurements, a stated lag makes nothing milder, and only `simulate` runs the law.
      memory: seconds; by default 5, or the plan's horizon if that is shorter. np.inf takes the uncertainty as stated,
        and a steady disturbance then leaves an error.
      record: whether runs keep estimates and innovations, to compare them with `filter`; see below.
      replan_every: seconds between two checks, rounded to control periods; by default there are none. A check simulates
        the model from the estimated state, with the estimated constants. If the law no longer leads to the goal without
        a collision, the rest of the horizon is solved from that state; if that fails, the law stays in force. Costs
        that depend on the step's number, but for a reference, are not supported then.
      replan_always: whether to solve at each of these times without a check.

    Its run, a rollout's `controller_run`, has with `record` the `estimates` (T+1, K, Z) of the K trials, each with the
    measurement of its knot, and the `innovations` (T+1, K, Y), measurements minus predictions. Both are NaN where no
    measurement was used: at the last knot, and one more for each period of latency; innovations where one got lost.
    `filter.corrected` and `filter.innovation` are their covariances, up to a run's first solve. With `replan_every` it
    has the new `plans` of each trial, by the step at which they begin, and a `log`, as a `Replanner`.

    Attributes:
      options: the keyword arguments as given, `memory` in seconds.
      model: the linear model about the plan, with z = (state, actuator outputs, unknowns).
      filter: the filter's gains and covariances.
      weights: the law's weights of deviations from the plan; `weights.emphasis` is None with given tolerances.
      gain, offset: of the law, (T, m, Z) and (T, m). nominal: z in an undisturbed run, (T+1, Z).
    """

    sees_losses = True

    @checked
    def __init__(
        self,
        problem: Problem,
        solution: Solution,
        uncertainty: Uncertainty,
        *,
        tolerate: PerEntry | None = None,
        effort: PerEntry | None = None,
        at_end: float = AT_END,
        sensors: Sensors | RobotSensors = None,
        memory: float | None = None,
        record: bool = False,
        replan_every: float | None = None,
        replan_always: bool = False,
    ) -> None:
        check_plan("OffsetFree", problem, solution)
        if replan_always and replan_every is None:
            raise InputError("OffsetFree: replan_always: got True without replan_every, want seconds between solves")
        plan = solution.trajectory
        memory = min(plan.horizon, MEMORY) if memory is None else memory
        memory = check_seconds("OffsetFree: memory", memory, above=0.0)
        self.problem, self.solution, self.uncertainty = problem, solution, uncertainty
        self.options: dict[str, Any] = {
            "tolerate": tolerate, "effort": effort, "at_end": at_end, "sensors": sensors, "memory": memory,
            "record": record, "replan_every": replan_every, "replan_always": replan_always,
        }  # fmt: skip
        self.record = record
        self.replan_always = replan_always
        of_mjcf, of_states = (sensors, None) if isinstance(sensors, RobotSensors) else (None, sensors)
        sensor = sensor_of(of_states, problem.dynamics.state_coordinates)
        efforts = effort_of(effort, problem.dynamics)
        derivatives = PlanDerivatives(problem.dynamics, plan, sensor)
        model = assumed_model(derivatives, uncertainty, memory, efforts)
        check_observable(model)
        self._rule = None if replan_every is None else self._replan_rule(model, replan_every)
        self._sensing = None if of_mjcf is None else self._sensor_filter(model, of_mjcf, replan_every)
        kalman = kalman_filter(model) if self._sensing is None else self._sensing.along
        judge = Judge(problem, solution, model, kalman)
        if tolerate is None:
            tracking = choose_tolerances(judge, model, efforts, at_end, call="OffsetFree(...)")
        else:
            tracking = tracking_law(model, Weights.of(tolerate, efforts, problem.dynamics, at_end=at_end))
        law = FilterLaw(solution, model, kalman, tracking)
        if uncertainty.lag > 0 and memory < np.inf and self._sensing is None:
            law = robust_to_lag(judge, uncertainty, law, memory, efforts, at_end if tolerate is None else None)
        self._law, self.model, self.filter, self.weights = law, law.model, law.filter, law.tracking.weights
        (self.gain, self.offset), self.nominal = law.absolute, law.nominal

    def __repr__(self) -> str:
        plan, unknowns = self.solution.trajectory, len(self.uncertainty.unknowns)
        return f"OffsetFree({plan.steps} steps of {plan.dt:g} s, {self.model.n} states and {unknowns} unknowns)"

    def _sensor_filter(self, model: PlanModel, sensors: RobotSensors, replan_every: float | None) -> "SensorFilter":
        sensors.check_robot(self.problem.dynamics)
        for name in ("measurement", "latency", "loss"):
            value = getattr(self.uncertainty, name)
            if np.any(list(value.values()) if isinstance(value, Mapping) else value):
                got = f"a {name} of {value} with sensors of the MJCF"
                raise InputError(f"OffsetFree: uncertainty: got {got}, want none: each sensor has its own")
        if replan_every is not None:
            raise InputError(f"OffsetFree: replan_every: got {replan_every:g} with sensors of the MJCF, want None")
        return SensorFilter(model, sensors)

    def _replan_rule(self, model: PlanModel, every: float) -> ReplanRule:
        late = self.uncertainty.latency, self.uncertainty.delay
        if any(late):
            got = f"{every:g} with a latency of {late[0]} and a delay of {late[1]} periods"
            raise InputError(f"OffsetFree: replan_every: got {got}, want None, or an uncertainty with neither")
        problem = replace(self.problem, dynamics=model.dynamics)
        return ReplanRule("OffsetFree", problem, self.solution, every, 0.0, name="replan_every")

    def start(self, trials: int) -> "FilterRun | ReplannedRun":
        if self._sensing is not None:
            return SensorRun(self._sensing, self._law, trials, self.record)
        if self._rule is None:
            return FilterRun(self._law, trials, self.record)
        return ReplannedRun(self._rule, self._law, trials, self.record, always=self.replan_always)

    @property
    def plan(self) -> Plan:
        return self.solution

    @property
    def sensors(self) -> RobotSensors | None:
        """The sensors of the MJCF; None for measured states, of which `options` says which."""
        return None if self._sensing is None else self._sensing.sensors

    def _check_in_advance(self, what: str) -> None:
        """Raise InputError if the loop's matrices depend on the run: on later plans, or on lost readings."""
        if self._sensing is not None:
            raise InputError(f"OffsetFree: {what}: got a law that reads sensors of the MJCF, want measured states")
        if self._rule is not None:
            raise InputError(f"OffsetFree: {what}: got a law with replan_every={self._rule.every:g}, want one without")

    def loop(self, uncertainty: Uncertainty | None = None) -> LinearLoop:
        """Return the closed loop about the plan as matrices, by default under the uncertainty of the design.

        Raises:
          InputError: with `replan_every`, which leads to other plans; with sensors of the MJCF, as gains depend on what
            gets lost; or the uncertainty does not fit the system.
        """
        self._check_in_advance("loop")
        stated = self.uncertainty if uncertainty is None else uncertainty
        check_kind("uncertainty", stated, Uncertainty, "an Uncertainty, such as uncertainty_of(...), or None")
        truth = PlanModel(self.model.derivatives, stated.as_stated())
        offset = self.offset - self.solution.trajectory.controls
        offset = offset + np.einsum("tij,tj->ti", self.gain, self.nominal[:-1])
        return LinearLoop(truth, self.gain, offset, self.filter.gain, self.coordinates[1].limits, self.model)

    @property
    def policy(self) -> OutputFeedbackPolicy:
        """Filter and law for a robot, in NumPy alone, with predictions that are linear about the plan; `save` takes it.

        Raises:
          InputError: with `replan_every`, which needs a solver; or with sensors of the MJCF, which need MuJoCo.
        """
        self._check_in_advance("policy")
        return linear_policy(self._law)

    @property
    def digest(self) -> str:
        model, limits = self.model, np.array(self.coordinates[1].limits)
        parts = (self.gain, self.offset, self.nominal, self.filter.gain, model.output, model.transition, limits)
        uncertainty = self.uncertainty
        numbers = np.array(
            [model.plan.dt, model.uncertainty.lag, uncertainty.latency, uncertainty.delay, uncertainty.command_loss]
        )
        moved = model.dynamics.model_digest or np.array(list(model.dynamics.parameters.values()), dtype=np.float64)
        sources = model.dynamics.step_source.digest, moved, model.sensor.source.digest, model.sensor.data
        further: list[str | Array] = []
        if self._rule is not None:
            further += [f"{self.problem.digest} {self._rule.periods} {self.replan_always}", self.filter.corrected]
        if self._sensing is not None:
            further.append(self._sensing.sensors.digest)
        rules = (space.rules for space in self.coordinates)
        return sha256(*parts, numbers, *sources, *further, *rules)[:16]

    @property
    def coordinates(self) -> Spaces:
        return spaces_of(self.solution.policy)


def robust_to_lag(
    judge: Judge, stated: Uncertainty, design: FilterLaw, memory: float, effort: Array, at_end: float | None
) -> FilterLaw:
    """The design, or a milder one if the design is much worse without the lag.

    A filter and a law that assume a lag compensate for it: the law commands more, and the filter explains unexpected
    motion by actuators that run ahead of their commands. Without the lag, both overcompensate. Such a loop may be
    unstable with any tolerances, and the robot then leaves its plan even undisturbed.

    The design is therefore also scored without the lag. If that score is much worse, milder designs compete with it:
    their filters assume noise on the controls that bypasses the actuators, which is the effect of an unknown lag, and
    some only a part of the lag. Of the designs whose tube with the lag is not much wider than the narrowest, the one
    with the best weighted sum of the scores with and without the lag is chosen. A lag of several control periods leaves
    little choice: without it the robot stays near its plan, but may miss its goal.

    Args:
      stated: the true uncertainty, with the stated lag. memory, effort: as in `assumed_model`.
      at_end: as in `tolerances_to_try`, whose tolerances compete; None to keep those of the design.
    """
    solution, derivatives, uncertainty = judge.solution, design.model.derivatives, stated.as_stated()
    # Without losses of commands, a model without a lag has no actuators' states. One with the shortest lag has them.
    no_lag = 0.0 if uncertainty.command_loss else np.finfo(np.float64).tiny
    systems = [PlanModel(derivatives, replace(uncertainty, lag=lag)) for lag in (uncertainty.lag, no_lag)]

    outcome = _outcome(judge, systems, design)
    scores = outcome.scores(judge.narrowest(outcome.width[0]))
    if scores[1, 0] <= scores[0, 0] + MUCH_WORSE:
        return design
    kept = at_end is None
    weights = design.tracking.weights if kept else tolerances_to_try(design.model, effort, at_end, solution)
    designs = [replace(design, tracking=tracking_law(design.model, weights))]
    for fraction, bypass in MILDER:
        model = assumed_model(derivatives, replace(stated, lag=fraction * stated.lag), memory, effort, bypass)
        designs.append(FilterLaw(solution, model, kalman_filter(model), tracking_law(model, weights)))
    outcomes = [_outcome(judge, systems, candidate) for candidate in designs]
    widths = np.array([outcome.width[0] for outcome in outcomes])
    least = judge.narrowest(widths)
    scores = np.array([outcome.scores(least) for outcome in outcomes])
    scores = np.where(widths > WIDEST * least, np.inf, scores[:, 0] + WITHOUT_LAG * scores[:, 1])
    i, j = np.unravel_index(int(np.argmin(scores)), scores.shape)
    best = designs[i]
    return best if kept else replace(best, tracking=best.tracking.pick(int(j)))


def _outcome(judge: Judge, systems: list[PlanModel], design: FilterLaw) -> Predictions:
    """The predictions for a design in L true systems, (L, 1); or for one with C laws to choose from, (L, C)."""
    law = design.tracking
    loop = LinearLoop(systems[0], law.gain, law.offset, design.filter.gain, judge.limits, design.model)
    with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
        return judge.predictions(loop.in_systems(systems, design.model.n))


def linear_policy(law: FilterLaw) -> OutputFeedbackPolicy:
    """The law as an `OutputFeedbackPolicy`, linear about the plan.

    Commands under way are part of the state, and advance by one place in each period. If measurements are late by k
    periods, z is k periods behind, and the law acts on the prediction of z with the commands since, which is linear.
    """
    model, along, plan = law.model, law.model.derivatives, law.model.plan
    steps, m, latency, delay = plan.steps, model.m, model.uncertainty.latency, model.uncertainty.delay
    size, width = model.size, model.size + (latency + delay) * m
    (F, G, c), nominal, (gain, offset) = model.step, law.nominal, law.absolute
    f = nominal[1:] + c - np.einsum("tij,tj->ti", F, nominal[:-1]) - np.einsum("tij,tj->ti", G, plan.controls)
    measured = np.empty((steps + 1, model.sensor.size))  # h of y = H x + h
    along.compiled.measurements(len(measured), in_c_order(plan.states), along.compiled_sensor, measured)
    measured -= np.einsum("tij,tj->ti", along.H, plan.states)
    knots = np.maximum(np.arange(steps) - latency, 0)  # of z
    sent = np.clip(np.arange(steps)[:, None] + delay - np.arange(latency + delay, 0, -1), 0, steps - 1)
    arrays = {
        "gain": np.empty((steps, m, width)), "offset": np.empty((steps, m)),
        "correction": np.zeros((steps, width, model.sensor.size)),
        "sensor": along.H[knots], "sensor_offset": measured[knots],
        "transition": np.zeros((steps, width, width)), "input": np.zeros((steps, width, m)),
        "drift": np.zeros((steps, width)),
        "nominal": np.concatenate([nominal[knots], plan.controls[sent].reshape(steps, -1)], axis=1),
    }  # fmt: skip
    for t, knot in enumerate(knots):
        under_way = min(t, latency) + delay  # commands, the newest last
        first = width - under_way * m
        # The prediction with the commands under way: z ahead = onto (z, commands) + constant.
        onto, constant = np.eye(size, width), np.zeros(size)
        for i in range(under_way):
            j = min(knot + i, steps - 1)
            onto, constant = F[j] @ onto, F[j] @ constant + f[j]
            onto[:, first + i * m : first + (i + 1) * m] += G[j]
        at = min(t + delay, steps - 1)
        arrays["gain"][t], arrays["offset"][t] = gain[at] @ onto, gain[at] @ constant + offset[at]
        transition, by_command, commands = arrays["transition"][t], arrays["input"][t], width - size
        transition[:size, :size] = F[knot] if t >= latency else np.eye(size)  # z waits for the first measurement
        if t >= latency:
            arrays["correction"][t, :size], arrays["drift"][t, :size] = law.filter.gain[knot], f[knot]
            acting = transition[:size, size : size + m] if commands else by_command[:size]  # the oldest command
            acting[:] = G[knot]
        if commands:  # all move up, and the new one is the last
            transition[size:-m, size + m :] = np.eye(commands - m)
            by_command[-m:] = np.eye(m)
    return OutputFeedbackPolicy(
        **arrays, dt=plan.dt, state_coordinates=law.solution.policy.state_coordinates,
        control_coordinates=law.solution.policy.control_coordinates,
        measured_coordinates=_measured_coordinates(law),
    )  # fmt: skip


def _measured_coordinates(law: FilterLaw) -> Coordinates:
    """Coordinates of the measured numbers: the coordinates of the states, if states are measured."""
    space, names = law.solution.policy.state_coordinates, law.model.sensor.names
    if not set(names) <= set(space.names):
        return Coordinates(names=names, units=("",) * len(names))
    chosen = [space.names.index(name) for name in names]
    rotations = [
        place
        for place, i in enumerate(chosen)
        if i in space.rotation_vectors and chosen[place : place + 3] == [i, i + 1, i + 2]
    ]
    return Coordinates(
        names=names, units=tuple(space.units[i] for i in chosen), rotation_vectors=tuple(rotations),
        angles=tuple(place for place, i in enumerate(chosen) if i in space.angles),
    )  # fmt: skip


class ReplannedRun(ControllerRun):
    """A run of `OffsetFree(..., replan_every=...)`: each trial has its own law, about a new plan if that is needed.

    At each check of the rule, the law is simulated with the model, from the estimated state and with the unknown
    constants at their estimated values. If that run collides or misses the goal, or `always`, the rest of the horizon
    is solved from that state, and law and filter are recomputed about the new plan. A law that still leads to the goal
    stays: a new plan would cost less, but go as close to obstacles as its constraints permit. The estimates continue
    unchanged, and the law acts on their difference from the values that the new plan assumes. Some disturbances are
    left to the law: gusts, because they pass and plans do not model them; and gains and offsets of the controls and the
    lag of the actuators, which are no parameters of the model. A solve takes no time in the simulation.

    Attributes:
      plans: the new plans of each trial, by the step at which they begin.
    """

    def __init__(self, rule: ReplanRule, law: FilterLaw, trials: int, record: bool, *, always: bool) -> None:
        self._rule, self._always = rule, always
        self._runs = [FilterRun(law, 1, record) for _ in range(trials)]
        self.plans: list[dict[int, Trajectory]] = [{} for _ in range(trials)]
        self.log, self._sent = ReplanLog(), list[Array | None]([None] * trials)
        whole = FilterRun(law, trials, record)
        self.estimates, self.innovations = whole.estimates, whole.innovations
        if self.estimates is not None and self.innovations is not None:
            for k, run in enumerate(self._runs):  # each writes its own part
                run.estimates, run.innovations = self.estimates[:, k : k + 1], self.innovations[:, k : k + 1]

    def control(self, step: int, measured: Array) -> Array:
        commands: list[Array] = []
        for k, run in enumerate(self._runs):
            run.update(step, measured[k : k + 1])
            if self._rule.due(step, max(step - 1, 0)) and not run.estimator_diverged():
                self._replan(run, k, step)
            commands.append(run.command(step))
            self._sent[k] = commands[-1][0]
        return np.concatenate(commands)

    def estimator_diverged(self) -> Mapping[int, str]:
        return {k: why for k, run in enumerate(self._runs) for why in run.estimator_diverged().values()}

    def summary(self) -> str:
        return self.log.summary()

    def _leads_to_goal(self, problem: Problem, gain: Array, offset: Array, state: Array) -> bool:
        """Whether a law leads from a state (n,) to the goal, clear of obstacles, by the model."""
        states, _ = compiled.rollout(problem, gain, offset, state)
        if not np.isfinite(states).all():
            return False
        clearance, solution = clearance_of(problem, states), self._rule.solution
        radius = solution.target.radius_of_plan(solution.goal_radius)
        reached = radius is None or bool(solution.target.distance(states[-1]) <= radius)
        return reached and (clearance is None or bool(clearance.min() >= 0))

    def _replan(self, run: FilterRun, trial: int, step: int) -> None:
        """Replace the law of a trial by a law about a new plan, if a new plan is needed and found."""
        law, model, z = run.law, run.model, run.z[0]
        n, done = model.n, step - law.begins_at
        # The unknowns' states that are constant to the end of the horizon and change only parameters.
        on_controls = (model.output[len(model.parameters) :] != 0).any(axis=0)
        modelled = (model.output != 0).any(axis=0) & ~on_controls
        for unknown, states in zip(model.remembered, model.unknown_states, strict=True):
            modelled[list(states)] &= unknown.constant
        planned = np.where(modelled, z[n + model.lagging :], 0.0)
        changes = model.output[: len(model.parameters)] @ planned
        values = {
            name: float(model.dynamics.parameters[name] + change)
            for name, change in zip(model.parameters, changes, strict=True)
        }
        try:
            dynamics = model.dynamics.with_parameters(**values)
            problem = replace(self._rule.problem, dynamics=dynamics)
        except InputError as error:  # an estimate is not finite
            self.log.kept[str(error)] += 1
            return
        # In that model the actuators have no lag, gains or offsets.
        gain, reached = law.absolute.gain[done:], law.nominal[done:-1, n : n + model.lagging]
        without_state = np.concatenate([reached, np.tile(planned, (len(gain), 1))], axis=1)
        offset = law.absolute.offset[done:] + np.einsum("tij,tj->ti", gain[:, :, n:], without_state)
        here = dynamics.state_coordinates.nearest(z[:n], law.nominal[done, :n])
        gain = in_c_order(gain[:, :, :n])
        if not self._always and self._leads_to_goal(problem, gain, offset, here):
            return
        cost_to_go = law.solution.shifted(done, horizon="shrinking").cost_to_go
        start = InitialGuess(gain, in_c_order(offset), cost_to_go=cost_to_go)
        sent = self._sent[trial] if problem.control_rate is not None else None
        solution = self._rule.solve(SolveRequest(step, step, here, start, problem, sent))
        if not self.log.record(step, trial, solution):
            return
        self.plans[trial][step] = solution.trajectory
        about = PlanModel(PlanDerivatives(dynamics, solution.trajectory, model.sensor), model.uncertainty)
        # The filter begins with a measurement that has been used already.
        kalman = kalman_filter(about, law.filter.corrected_root[done])
        weights = replace(law.tracking.weights, emphasis=None)  # that of another plan
        run.law = FilterLaw(solution, about, kalman, tracking_law(about, weights), planned, step)


class Estimate(NamedTuple):
    """The estimates of K trials at a knot."""

    z: Array  # (K, Z)
    bias: Array  # (K, B)
    covariance: Array  # of the errors of both, (K, Z+B, Z+B)

    def copy(self) -> "Estimate":
        return Estimate(*(array.copy() for array in self))


@dataclass(frozen=True, eq=False)
class SensorFilter:
    """The filter about a plan: what its design and its runs, `SensorRun`, share. It keeps no estimates."""

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


class SensorRun(FilterRun):
    """K trials of a run, with the estimates of a `SensorFilter`, now with the readings that have arrived.

    A reading that arrives late belongs to an earlier knot. The run therefore keeps its estimate of the last knot whose
    readings have all had the time to arrive, and from there runs the filter again in each period, with the readings
    that are known by now. The result is that of a filter that had each reading in its place.
    """

    def __init__(self, filter_: SensorFilter, law: FilterLaw, trials: int, record: bool) -> None:
        super().__init__(law, trials, record)
        self._filter, self._read = filter_, filter_.sensors.reader()
        self.innovations = None  # readings of one knot arrive at several
        self.estimate = self._kept = filter_.start(trials, law.nominal[0])
        self._first = 0  # the first knot after that of `_kept`, whose readings have all arrived
        self._readings, self._acting = dict[int, Array](), dict[int, Array]()

    def update(self, step: int, measured: Array) -> None:
        """Run the filter again, with the readings (K, Y) that arrive at a step."""
        shape, sensors = (self._trials, len(self._filter.sensors.names)), self._filter.sensors
        if measured.shape != shape:
            raise InputError(f"OffsetFree: got measurements of shape {measured.shape}, want {shape} of {sensors}")
        self._acting[step] = np.tile(self.model.plan.controls[0], (self._trials, 1))  # before the first period
        if step:
            self._acting[step] = self._commands.pop(0)
        self._readings[step] = np.full(shape, np.nan)
        for at, late in zip(sensors.columns, self._filter.late, strict=True):
            if step >= late:
                self._readings[step - late][:, at] = measured[:, at]
        now, slowest = self._kept, max(self._filter.late)
        for knot in range(self._first, step + 1):
            now = self._advance(now.copy(), knot)
            if knot == step - slowest:
                self._kept, self._first = now, knot + 1
                del self._readings[knot], self._acting[knot]
        self.estimate, self.z = now, now.z
        if self.estimates is not None and step < len(self.estimates):
            self.estimates[step] = self.z

    def _advance(self, estimate: Estimate, knot: int) -> Estimate:
        """Predict an estimate to a knot, except the first, and correct it by the knot's readings, all in place."""
        filter_, (z, bias, covariance), model = self._filter, estimate, self.model
        if knot:
            self._predict(z, self._acting[knot])
            filter_.predict(covariance, knot)
        planned = in_c_order(model.plan.states[[min(knot, model.plan.steps)]])
        states = in_c_order(z[None, :, : model.n])
        turn_to_nearest(model.dynamics.state_coordinates, states, planned)
        z[:, : model.n] = states[0]
        known = ~np.isnan(self._readings[knot])
        if known.any():
            expected = self._read(states[0], *filter_.acting(z, self._acting[knot]))
            expected[:, filter_.biased] += bias
            off = filter_.aligned(self._readings[knot], expected) - expected
            moved = filter_.correct(covariance, knot, known & np.isfinite(off), off)
            z += moved[:, : model.size]
            bias += moved[:, model.size :]
        return estimate

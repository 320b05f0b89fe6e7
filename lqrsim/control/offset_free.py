"""Offset-free output feedback: no steady error under constant disturbances and wrong parameters.

A Kalman filter estimates the state, the actuators' outputs and the unknowns. A tracking law acts on all the estimates.
Both are designed with the linear model about the plan. A run predicts with the nonlinear dynamics; the export, an
`OutputFeedbackPolicy`, is linear about the plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from lqrsim.annotations import checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.controllers import Controller, ControllerRun, check_plan, turn_to_nearest, turning_of
from lqrsim.control.kalman import Estimate, KalmanFilter, SensorFilter, check_observable, kalman_filter
from lqrsim.control.plan_model import PlanModel, Sensors, sensor_of
from lqrsim.control.prediction import LinearLoop, moments_of
from lqrsim.control.replanner import ReplanLog, ReplanRule, SolveRequest
from lqrsim.control.tracking import (
    AT_END,
    Judge,
    Laws,
    Predictions,
    Weights,
    choose_tolerances,
    effort_of,
    tolerances_to_try,
    tracking_laws,
)
from lqrsim.control.uncertainty import Uncertainty, check_seconds
from lqrsim.errors import Array, InputError, check_kind
from lqrsim.kernels.feedback import FAR
from lqrsim.kernels.records import Limits, LoopArrays, LoopMoments, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, PerEntry, Spaces, spaces_of
from lqrsim.results.policy import OutputFeedbackPolicy
from lqrsim.results.solution import Plan, Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.sensors import RobotSensors
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.settings import InitialGuess

MEMORY = 5.0  # s, the default of `OffsetFree`
# Choice of a design that tolerates the absence of the stated lag; see `robust_to_lag`. Weight of the score without the
# lag, relative to the score with it. The value is our choice: with a larger one, designs lose performance with the lag.
WITHOUT_LAG = 0.3
# How much higher the score without the lag must be for milder designs to compete: as much as a chance of failure of
# 0.1, or as a tube of six times the width.
MUCH_WORSE = 0.1
# What the filters of milder designs assume: a fraction of the stated lag; and noise on the controls that bypasses the
# actuators, as in `PlanModel.assumed`.
MILDER = ((1.0, 0.05), (1.0, 0.2), (0.75, 0.2), (0.5, 0.2))
WIDEST = 1.25  # the largest width of the chosen tube with the lag, relative to the narrowest of all designs
WORST = (1.0, 1e30, 1.0)  # the `Predictions` for a loop whose moments are not finite


@dataclass(frozen=True, eq=False)
class FilterLaw:
    """A filter with the law that acts on its estimates, or with C laws to choose from, about one plan."""

    plan: Plan
    model: PlanModel
    filter: KalmanFilter
    weights: Weights
    laws: Laws  # of deviations from the plan
    in_plan: Array | float = 0.0  # the unknowns' states (D,) with which the plan was made

    def pick(self, i: int) -> "FilterLaw":
        """One of the C laws."""
        return replace(self, weights=self.weights.pick(i), laws=self.laws.pick(i))

    # The law of the estimates z themselves, u = gain z + offset.

    @cached_property
    def gain(self) -> Array:
        """(T, m, Z)."""
        return in_c_order(self.laws.gain)

    @cached_property
    def offset(self) -> Array:
        """(T, m)."""
        return self.model.plan.controls + self.laws.offset - np.einsum("tij,tj->ti", self.laws.gain, self.nominal[:-1])

    @cached_property
    def nominal(self) -> Array:
        """z in an undisturbed run, (T+1, Z)."""
        states, reached = self.model.plan.states, self.model.reached
        unknowns = np.zeros((len(states), len(self.model.transition))) + self.in_plan
        return np.concatenate([states, reached, unknowns], axis=1)


class FilterRun(ControllerRun):
    """A run of `OffsetFree` with K trials: their estimates z (K, Z) at the knot of the newest measurement.

    If measurements are late by k periods, the filter runs k periods behind. Its estimate is predicted forward with the
    commands since, to the time at which the next command acts. The law's plan begins at the step `first`.
    """

    def __init__(self, law: FilterLaw, trials: int, record: bool) -> None:
        self.law, self.first = law, 0
        self.model = law.model  # for predictions, independent of a later plan's assumptions about the unknowns
        self._trials = trials
        self.z = np.tile(law.nominal[0], (trials, 1))
        # If the first measurement is lost, it counts as the plan's first state.
        self._last_measured = np.tile(law.model.plan.states[0], (trials, 1))
        self._diverged: dict[int, str] = {}
        self._innovation = np.empty((trials, law.model.sensor.size))
        self._limit_factors = np.ones(trials)  # factors on the limits of corrections; see `kernels/feedback.py`
        shape, sizes = (law.model.plan.steps + 1, trials), (law.model.size, law.model.sensor.size)
        self.estimates, self.innovations = (np.full((*shape, size), np.nan) if record else None for size in sizes)
        self._limits = Limits(*law.plan.policy.control_coordinates.limits)
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
        knot = min(step - self.first - self._latency, law.model.plan.steps)
        lost = (measured == self._last_measured).all(axis=1).astype(np.float64)
        self._last_measured[:] = measured
        model.compiled.correct(
            self._trials, in_c_order(measured), lost, in_c_order(law.model.plan.states[knot]),
            law.filter.gain[knot], law.filter.limit[knot], self._limit_factors, model.compiled_sensor, self._turning,
            self.z, self._innovation,
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
        t = min(step - self.first + self._delay, law.model.plan.steps - 1)
        out = np.empty((self._trials, self.model.m))
        nominal = in_c_order(law.model.plan.states[t])
        gains = Policy(law.gain[t], law.offset[t])
        model.compiled.command(self._trials, predicted, nominal, gains, self._limits, self._turning, out)
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
        n, done = model.n, step - run.first
        # The unknowns' states that are constant to the end of the horizon and change only parameters.
        on_controls = (model.output[len(model.parameters) :] != 0).any(axis=0)
        modelled = (model.output != 0).any(axis=0) & ~on_controls
        for unknown, states in zip(model.remembered, model.unknown_states, strict=True):
            modelled[list(states)] &= unknown.constant
        in_plan = np.where(modelled, z[n + model.lagging :], 0.0)
        changes = model.output[: len(model.parameters)] @ in_plan
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
        gain, reached = law.gain[done:], law.nominal[done:-1, n : n + model.lagging]
        fixed = np.concatenate([reached, np.tile(in_plan, (len(gain), 1))], axis=1)
        offset = law.offset[done:] + np.einsum("tij,tj->ti", gain[:, :, n:], fixed)
        here = dynamics.state_coordinates.nearest(z[:n], law.nominal[done, :n])
        gain = in_c_order(gain[:, :, :n])
        if not self._always and self._leads_to_goal(problem, gain, offset, here):
            return
        plan = law.plan
        start = InitialGuess(gain, in_c_order(offset), cost_to_go=plan.shifted(done, horizon="shrinking").cost_to_go)
        sent = self._sent[trial] if problem.control_rate is not None else None
        solution = self._rule.solve(SolveRequest(step, step, here, start, problem, sent))
        if not self.log.enter(step, trial, solution):
            return
        self.plans[trial][step] = solution.trajectory
        about = PlanModel(dynamics, solution.trajectory, model.uncertainty, model.sensor)
        # The filter begins with a measurement that has been used already.
        kalman = kalman_filter(about, law.filter.corrected_root[done])
        weights = replace(law.weights, emphasis=None)  # that of another plan
        run.law, run.first = FilterLaw(solution, about, kalman, weights, tracking_laws(about, weights), in_plan), step


class OffsetFree(Controller):
    """Tracks a plan, with estimates of the state, the actuators' outputs and the unknowns.

    Gains are computed in advance, about the plan. Predictions use the nonlinear dynamics with the estimated
    unknowns. A measurement that is bit-identical to the last one counts as lost, and is predicted; one that is late by
    `uncertainty.latency` is used at the time to which it belongs. The filter uses commands after saturation, so there
    is no windup. The filter never assumes an exact model: controls are off by at least 2 % of the tolerated effort, and
    predicted states by at least 2 % of what that effort moves them in two periods. A single measurement changes an
    unknown by at most six standard deviations of such a correction; see `kalman.py`. If a design for the stated lag
    would do much worse without the lag, a milder one is chosen, whose tube with the lag is at most a quarter wider:
    see `robust_to_lag`. `model.uncertainty` is the uncertainty that the filter assumes.

    The other arguments are as in `track`.

    Args:
      uncertainty: as stated, such as by `uncertainty_of`. The filter assumes that unknowns that vary may have a mean,
        and that constants may change by about their standard deviation in `memory` seconds: see `Uncertainty.steady`.
      sensors: names of the states that are measured, by default all; or a matrix (Y, n); or a function h(x, u, p) of
        SymPy symbols, as in `Dynamics`, that does not depend on u; or sensors of the MJCF, `plant.sensors(...)`, each
        with its own noise, bias, rate, delay and loss: see `kalman.py`. With these the uncertainty says nothing
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
        stated = PlanModel(problem.dynamics, plan, uncertainty, sensor)
        self.model = stated.assumed(memory, efforts)
        check_observable(self.model)
        self._rule = None if replan_every is None else self._replan_rule(replan_every)
        self._sensing = None if of_mjcf is None else self._sensor_filter(of_mjcf, replan_every)
        self.filter = kalman_filter(self.model) if self._sensing is None else self._sensing.along
        judge = Judge(problem, solution, uncertainty.obstacles)
        if tolerate is None:
            moments = partial(with_filter, self.model, self.filter, solution.policy.control_coordinates.limits)
            weights, laws = choose_tolerances(judge, self.model, efforts, at_end, moments, call="OffsetFree(...)")
        else:
            weights = Weights.of(tolerate, efforts, problem.dynamics, at_end=at_end)
            laws = tracking_laws(self.model, weights)
        law = FilterLaw(solution, self.model, self.filter, weights, laws)
        if uncertainty.lag > 0 and memory < np.inf and self._sensing is None:
            law = robust_to_lag(judge, stated, law, memory, efforts, at_end if tolerate is None else None)
        self._law, self.model, self.filter, self.weights = law, law.model, law.filter, law.weights
        self.gain, self.offset, self.nominal = law.gain, law.offset, law.nominal

    def __repr__(self) -> str:
        plan, unknowns = self.solution.trajectory, len(self.uncertainty.unknowns)
        return f"OffsetFree({plan.steps} steps of {plan.dt:g} s, {self.model.n} states and {unknowns} unknowns)"

    def _sensor_filter(self, sensors: RobotSensors, replan_every: float | None) -> SensorFilter:
        sensors.check_robot(self.problem.dynamics)
        for name in ("measurement", "latency", "loss"):
            value = getattr(self.uncertainty, name)
            if np.any(list(value.values()) if isinstance(value, Mapping) else value):
                got = f"a {name} of {value} with sensors of the MJCF"
                raise InputError(f"OffsetFree: uncertainty: got {got}, want none: each sensor has its own")
        if replan_every is not None:
            raise InputError(f"OffsetFree: replan_every: got {replan_every:g} with sensors of the MJCF, want None")
        return SensorFilter(self.model, sensors)

    def _replan_rule(self, every: float) -> ReplanRule:
        late = self.uncertainty.latency, self.uncertainty.delay
        if any(late):
            got = f"{every:g} with a latency of {late[0]} and a delay of {late[1]} periods"
            raise InputError(f"OffsetFree: replan_every: got {got}, want None, or an uncertainty with neither")
        problem = replace(self.problem, dynamics=self.model.dynamics)
        return ReplanRule("OffsetFree", problem, self.solution, every, 0.0, name="replan_every")

    def start(self, trials: int) -> FilterRun | ReplannedRun:
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
        stated.check(self.problem.dynamics)
        truth = self.model.under(stated.steady(np.inf))
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
        return policy_of(self._law)

    @property
    def digest(self) -> str:
        model, limits = self.model, np.array(self.coordinates[1].limits)
        parts = (self.gain, self.offset, self.nominal, self.filter.gain, model.output, model.transition, limits)
        uncertainty = self.uncertainty
        numbers = np.array(
            [model.plan.dt, model.uncertainty.lag, uncertainty.latency, uncertainty.delay, uncertainty.command_loss]
        )
        moved = model.dynamics.fixed or np.array(list(model.dynamics.parameters.values()), dtype=np.float64)
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


def with_filter(model: PlanModel, kalman: KalmanFilter, limits: tuple[Array, Array], laws: Laws) -> LoopMoments:
    """Moments of the states under C laws that follow a filter's estimates.

    The filter is assumed to be right about the noise. Its error is then independent of its estimate, and what it learns
    from a measurement is noise that moves the estimate. The unknowns' estimates are moved by no law.
    """
    n, size = model.n, model.n + model.lagging
    learned = kalman.gain @ kalman.innovation @ kalman.gain.transpose(0, 2, 1)
    F, G, c, noise = (array[:, None, :size] for array in (*model.step, learned))
    gain, offset = (part.swapaxes(0, 1) for part in laws)
    planned = model.plan.controls
    arrays = LoopArrays(
        F, G.swapaxes(-1, -2), c, noise, learned[:, size:, size:], model.transition, gain, planned[:, None] + offset,
        planned, np.zeros((*offset.shape, model.m)), np.zeros(0), model.reached, *limits,
    )  # fmt: skip
    moments = LoopMoments(*(moment[0] for moment in moments_of(arrays, size, n)))
    return moments._replace(
        covariance=moments.covariance + kalman.corrected[:, :n, :n],
        across=moments.across + model.step.F[:, :n] @ kalman.corrected[:-1, :, :n],
    )


def robust_to_lag(
    judge: Judge, stated: PlanModel, design: FilterLaw, memory: float, effort: Array, at_end: float | None
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
      stated: model of the true system, with the stated lag. memory, effort: as in `PlanModel.assumed`.
      at_end: as in `tolerances_to_try`, whose tolerances compete; None to keep those of the design.
    """
    solution, uncertainty = judge.solution, stated.uncertainty.steady(np.inf)
    # Without losses of commands, a model without a lag has no actuators' states. One with the shortest lag has them.
    no_lag = 0.0 if uncertainty.command_loss else np.finfo(np.float64).tiny
    systems = [stated.under(replace(uncertainty, lag=lag)) for lag in (uncertainty.lag, no_lag)]

    def predicted(design: FilterLaw) -> Predictions:
        """The predictions for C laws, (2, C): with the lag, and without it."""
        limits = solution.policy.control_coordinates.limits
        loop = LinearLoop(systems[0], *design.laws, design.filter.gain, limits, design.model)
        with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
            moments = loop.in_systems(systems, stated.n)
            lost = np.asarray(~np.isfinite(moments.covariance).all(axis=(-3, -2, -1)))
        for moment in moments:
            moment[lost] = 0.0
        finite = judge.predictions(moments)
        return Predictions(*(np.where(lost, worst, value) for worst, value in zip(WORST, finite, strict=True)))

    outcomes = predicted(design)
    scores = outcomes.scores(judge.narrowest(outcomes.width[0]))
    if scores[1, 0] <= scores[0, 0] + MUCH_WORSE:
        return design
    kept = at_end is None
    weights = design.weights.pick(None) if kept else tolerances_to_try(design.model, effort, at_end, solution)
    designs = [replace(design, weights=weights, laws=tracking_laws(design.model, weights))]
    for fraction, bypass in MILDER:
        partly = stated.under(replace(stated.uncertainty, lag=fraction * stated.uncertainty.lag))
        model = partly.assumed(memory, effort, bypass)
        designs.append(FilterLaw(solution, model, kalman_filter(model), weights, tracking_laws(model, weights)))
    outcomes = [predicted(candidate) for candidate in designs]
    widths = np.array([outcome.width[0] for outcome in outcomes])
    least = judge.narrowest(widths)
    scores = np.array([outcome.scores(least) for outcome in outcomes])
    scores = np.where(widths > WIDEST * least, np.inf, scores[:, 0] + WITHOUT_LAG * scores[:, 1])
    i, j = np.unravel_index(int(np.argmin(scores)), scores.shape)
    return designs[i].pick(int(j))


def policy_of(law: FilterLaw) -> OutputFeedbackPolicy:
    """The law as an `OutputFeedbackPolicy`, linear about the plan.

    Commands under way are part of the state, and advance by one place in each period. If measurements are late by k
    periods, z is k periods behind, and the law acts on the prediction of z with the commands since, which is linear.
    """
    model, plan = law.model, law.model.plan
    steps, m, latency, delay = plan.steps, model.m, model.uncertainty.latency, model.uncertainty.delay
    size, width = model.size, model.size + (latency + delay) * m
    (F, G, c), nominal = model.step, law.nominal
    f = nominal[1:] + c - np.einsum("tij,tj->ti", F, nominal[:-1]) - np.einsum("tij,tj->ti", G, plan.controls)
    measured = np.empty((steps + 1, model.sensor.size))  # h of y = H x + h
    model.compiled.measurements(len(measured), in_c_order(plan.states), model.compiled_sensor, measured)
    measured -= np.einsum("tij,tj->ti", model.H, plan.states)
    knots = np.maximum(np.arange(steps) - latency, 0)  # of z
    sent = np.clip(np.arange(steps)[:, None] + delay - np.arange(latency + delay, 0, -1), 0, steps - 1)
    arrays = {
        "gain": np.empty((steps, m, width)), "offset": np.empty((steps, m)),
        "correction": np.zeros((steps, width, model.sensor.size)),
        "sensor": model.H[knots], "sensor_offset": measured[knots],
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
        arrays["gain"][t], arrays["offset"][t] = law.gain[at] @ onto, law.gain[at] @ constant + law.offset[at]
        transition, given, commands = arrays["transition"][t], arrays["input"][t], width - size
        transition[:size, :size] = F[knot] if t >= latency else np.eye(size)  # z waits for the first measurement
        if t >= latency:
            arrays["correction"][t, :size], arrays["drift"][t, :size] = law.filter.gain[knot], f[knot]
            acting = transition[:size, size : size + m] if commands else given[:size]  # the oldest command
            acting[:] = G[knot]
        if commands:  # all move up, and the new one is the last
            transition[size:-m, size + m :] = np.eye(commands - m)
            given[-m:] = np.eye(m)
    return OutputFeedbackPolicy(
        **arrays, dt=plan.dt, state_coordinates=law.plan.policy.state_coordinates,
        control_coordinates=law.plan.policy.control_coordinates,
        measured_coordinates=_measured_coordinates(law),
    )  # fmt: skip


def _measured_coordinates(law: FilterLaw) -> Coordinates:
    """Coordinates of the measured numbers: the coordinates of the states, if states are measured."""
    space, names = law.plan.policy.state_coordinates, law.model.sensor.names
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

"""Offset-free output feedback: no steady error under constant disturbances and wrong parameters.

A Kalman filter estimates the state, the actuators' outputs and the unknowns. A tracking law acts on all the estimates.
Both are designed with the linear model about the plan.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lqrsim.annotations import checked
from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.controllers import Controller
from lqrsim.control.filter_law import Design, FilterLaw, FilterRun, ReplannedRun, policy_of
from lqrsim.control.kalman import check_observable, kalman_filter
from lqrsim.control.linear_loop import LinearLoop
from lqrsim.control.plan_model import PlanModel, Sensors, sensor_of
from lqrsim.control.replanner import ReplanRule
from lqrsim.control.sampled_loop import DeviationNorm
from lqrsim.control.sensor_filter import SensorFilter, SensorRun
from lqrsim.control.tracking import Predictions, choose_tolerances, narrowest, tolerances_to_try, with_filter
from lqrsim.control.tracking_laws import AT_END, Weights, check_plan, effort_of
from lqrsim.control.uncertainty import Uncertainty, check_seconds
from lqrsim.errors import Array, InputError, check_kind
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import PerEntry, Spaces, spaces_of
from lqrsim.results.policy import OutputFeedbackPolicy
from lqrsim.results.solution import Plan, Solution
from lqrsim.robots.sensors import RobotSensors

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
        with its own noise, bias, rate, delay and loss: see `sensor_filter.py`. With these the uncertainty says nothing
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
        stated = PlanModel.of(problem.dynamics, plan, uncertainty, sensor)
        self.model = stated.assumed(memory, efforts)
        check_observable(self.model)
        self._rule = None if replan_every is None else self._replan_rule(replan_every)
        self._sensing = None if of_mjcf is None else self._sensor_filter(of_mjcf, replan_every)
        self.filter = kalman_filter(self.model) if self._sensing is None else self._sensing.along
        if tolerate is None:
            moments = partial(with_filter, self.model, self.filter, solution.policy.control_coordinates.limits)
            arguments = problem, solution, uncertainty, self.model, efforts, at_end, moments
            design = Design(self.model, self.filter, *choose_tolerances(*arguments, call="OffsetFree(...)"))
        else:
            weights = Weights.of(tolerate, efforts, problem.dynamics, at_end=at_end)
            design = Design.of(self.model, self.filter, weights)
        if uncertainty.lag > 0 and memory < np.inf and self._sensing is None:
            ends = at_end if tolerate is None else None
            design = robust_to_lag(problem, solution, stated, design, memory, efforts, ends)
        self.model, self.filter, self.weights = design.model, design.filter, design.weights
        self._law = FilterLaw.of(solution, design)
        self.gain, self.offset, self.nominal = self._law.gain, self._law.offset, self._law.nominal

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


def robust_to_lag(
    problem: Problem, solution: Solution, stated: PlanModel, design: Design, memory: float, effort: Array,
    at_end: float | None,
) -> Design:  # fmt: skip
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
    uncertainty = stated.uncertainty.steady(np.inf)
    surroundings = Surroundings.of(problem, uncertainty.obstacles)
    norm = DeviationNorm.of(solution, problem.dynamics.state_coordinates.position)
    # Without losses of commands, a model without a lag has no actuators' states. One with the shortest lag has them.
    no_lag = 0.0 if uncertainty.command_loss else np.finfo(np.float64).tiny
    systems = [stated.under(replace(uncertainty, lag=lag)) for lag in (uncertainty.lag, no_lag)]

    def predicted(design: Design) -> Predictions:
        """The predictions for C laws, (2, C): with the lag, and without it."""
        limits = solution.policy.control_coordinates.limits
        loop = LinearLoop(systems[0], *design.laws, design.filter.gain, limits, design.model)
        with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
            moments = loop.in_systems(systems, stated.n)
            lost = np.asarray(~np.isfinite(moments.covariance).all(axis=(-3, -2, -1)))
        for moment in moments:
            moment[lost] = 0.0
        finite = Predictions.of(solution, surroundings, norm, moments)
        return Predictions(*(np.where(lost, worst, value) for worst, value in zip(WORST, finite, strict=True)))

    outcomes = predicted(design)
    scores = outcomes.scores(narrowest(norm, stated.plan, outcomes.width[0]))
    if scores[1, 0] <= scores[0, 0] + MUCH_WORSE:
        return design
    if at_end is None:
        weights = design.weights.pick(None)
    else:
        weights = tolerances_to_try(design.model, effort, at_end, solution.target)
    designs = [Design.of(design.model, design.filter, weights)]
    for fraction, bypass in MILDER:
        partly = stated.under(replace(stated.uncertainty, lag=fraction * stated.uncertainty.lag))
        model = partly.assumed(memory, effort, bypass)
        designs.append(Design.of(model, kalman_filter(model), weights))
    outcomes = [predicted(candidate) for candidate in designs]
    widths = np.array([outcome.width[0] for outcome in outcomes])
    least = narrowest(norm, stated.plan, widths)
    scores = np.array([outcome.scores(least) for outcome in outcomes])
    scores = np.where(widths > WIDEST * least, np.inf, scores[:, 0] + WITHOUT_LAG * scores[:, 1])
    i, j = np.unravel_index(int(np.argmin(scores)), scores.shape)
    return designs[i].pick(int(j))

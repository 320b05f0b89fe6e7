"""Output feedback that, by the linear model, leaves no steady error.

A Kalman filter estimates the state, what the actuators have reached, and what disturbs the robot; a tracking law
follows all of it.
"""

from dataclasses import replace

import numpy as np

from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.controllers import Controller
from lqrsim.control.filter_law import FilterLaw, FilterRun, empty_records, policy_of
from lqrsim.control.kalman import check_observable, kalman_filter
from lqrsim.control.linear_loop import LinearLoop
from lqrsim.control.plan_model import PlanModel, Sensors, sensor_of
from lqrsim.control.replan_rule import ReplanRule
from lqrsim.control.replanned import ReplannedRun
from lqrsim.control.tracking import Prediction, choose_tolerances, reach_of, unit_means, with_filter
from lqrsim.control.tracking_laws import AT_END, Weights, check_plan, effort_of
from lqrsim.control.uncertainty import PerEntry, Uncertainty, per_entry
from lqrsim.errors import Array, InputError, check_flag, check_kind, check_number
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.output_feedback import OutputFeedbackPolicy
from lqrsim.results.plan import Plan
from lqrsim.results.solution import Solution

MEMORY = 5.0  # s
# The least errors that a filter assumes, relative to the tolerated effort: of each control; and of each state's
# prediction, as if so much effort had moved it. A model is never exact: what acts does not act evenly over a control
# period, integration has errors, and the gains are those about the plan. With exact sensors a filter that does not
# know this reads unknowns from the last digits of its prediction errors.
INEXACT = 0.02


class OffsetFree(Controller):
    """Estimates the state, the actuators and what disturbs the robot, and keeps to the plan by all of it.

    The filter's gains are made ahead of time, about the plan; it predicts with the model itself, with the unknowns as
    they are estimated. A measurement that is the last one to the last bit got lost, and is predicted. One that is late
    by `uncertainty.latency` is taken in where it belongs. Commands count as they are after saturation, so that nothing
    winds up.

    Args:
      problem: that was solved.
      solution: its solution, or any with a plan of the same system.
      uncertainty: what the run meets, as `uncertainty_of` makes it. What varies may have a mean, too, and what is
        constant may change, in `memory` seconds by about its standard deviation: see `Uncertainty.steady`.
      tolerate: as in `track`.
      effort: as in `track`.
      at_end: as in `track`.
      sensors: names of the states that are measured, by default all; or a matrix (Y, n); or a function h(x, u, p) of
        SymPy symbols, as in `Dynamics`, that does not depend on u.
      memory: in s, by default 5 s, or the plan's horizon where that is shorter.
      record: whether runs keep what the filter makes of them, for holding it against `filter`; see below.
      replan_every: seconds, rounded to control periods, after which it is looked at, again and again, whether the law
        still leads to the goal and clear of obstacles: by the model, from the estimated state and with the estimated
        constants. Where it does not, what is left of the horizon is solved from there; by default never. Where a solve
        does not succeed, the law before goes on. Costs that depend on the step's number are not supported then.
      replan_always: whether to solve at each of these times, wherever the law leads.

    A run of it, which is a rollout's `controller_run`, has these attributes:

    - `estimates`: with `record`, the estimates (T+1, K, Z) of the K trials, each with the measurement of its knot: NaN
      where none was taken in, which is so of the last knot, and of as many more as measurements are late. Their errors
      have the covariances `filter.corrected`. Else None.
    - `innovations`: likewise what measurements differed by from what was expected, (T+1, K, Y), of the covariances
      `filter.innovation`; NaN where a measurement got lost, too. Both covariances are of the first plan: with
      `replan_every` they are those of a run up to its first solve.
    - with `replan_every`, `plans`: the new plans of each trial, by the step that they begin at; and `log`, how the
      solves went, as of a `Replanner`.

    Attributes:
      model: the linear model about the plan, with z = (state, what the actuators have reached, unknowns).
      filter: the filter's gains and covariances.
      weights: what deviations from the plan cost the law.
      gain: of the law, (T, m, Z).
      offset: of the law, (T, m).
      nominal: what z is in an undisturbed run, (T+1, Z).

    Raises:
      InputError: something does not fit the system; an unknown changes nothing of what is measured; or `replan_every`
        is shorter than a control period, or comes with latency, a delay or a plan of another horizon than the problem.
    """

    def __init__(
        self,
        problem: Problem,
        solution: Solution,
        uncertainty: Uncertainty,
        *,
        tolerate: PerEntry | None = None,
        effort: PerEntry | None = None,
        at_end: float = AT_END,
        sensors: Sensors = None,
        memory: float | None = None,
        record: bool = False,
        replan_every: float | None = None,
        replan_always: bool = False,
    ) -> None:
        check_plan("OffsetFree", problem, solution)
        check_kind("OffsetFree: uncertainty", uncertainty, Uncertainty, "an Uncertainty, such as uncertainty_of(...)")
        plan = solution.trajectory
        memory = min(plan.horizon, MEMORY) if memory is None else memory
        memory = check_number("OffsetFree: memory", memory, above=0.0)
        self.problem, self.solution, self.uncertainty = problem, solution, uncertainty
        self.record = check_flag("OffsetFree: record", record)
        self.replan_always = check_flag("OffsetFree: replan_always", replan_always)
        sensor = sensor_of(sensors, problem.dynamics.state_coordinates)
        efforts = effort_of(effort, problem.dynamics)
        self.model = for_filter(PlanModel.of(problem.dynamics, plan, uncertainty, sensor), memory, efforts)
        check_observable("OffsetFree", self.model)
        self._rule = None if replan_every is None else self._replan_rule(replan_every)
        self.filter = kalman_filter(self.model)
        self.weights = self._weights(tolerate, efforts, at_end)
        self._law = FilterLaw.of(solution, self.model, self.filter, self.weights)
        self.gain, self.offset, self.nominal = self._law.gain, self._law.offset, self._law.nominal

    def _replan_rule(self, every: float) -> ReplanRule:
        late = self.uncertainty.latency, self.uncertainty.delay
        if any(late):
            got = f"{every:g} with a latency of {late[0]} and a delay of {late[1]} periods"
            raise InputError(f"OffsetFree: replan_every: got {got}, want None, or an uncertainty without both")
        problem = replace(self.problem, dynamics=self.model.dynamics)
        return ReplanRule("OffsetFree", problem, self.solution, every, name="replan_every", deadline=0.0)

    def _weights(self, tolerate: PerEntry | None, effort: Array, at_end: float) -> Weights:
        """Of the tolerances, or of those that are chosen."""
        if tolerate is not None:
            return Weights.of(tolerate, effort, self.problem.dynamics, at_end=at_end)
        controls = self.solution.policy.control_coordinates
        low, high = np.array(controls.low), np.array(controls.high)
        surroundings = Surroundings.of(self.problem, self.uncertainty.obstacles)

        def predicted(tried: Weights) -> list[Prediction]:
            radius = self.solution.goal_radius
            return with_filter(self.model, self.filter, tried, (low, high), surroundings, radius)

        return choose_tolerances(self.model, predicted, effort, at_end).weights

    def start(self, trials: int) -> "FilterRun | ReplannedRun":
        records = empty_records(self._law, trials) if self.record else None
        if self._rule is None:
            return FilterRun(self._law, trials, records)
        return ReplannedRun(self._rule, self._law, trials, records, always=self.replan_always)

    @property
    def plan(self) -> Plan:
        return self.solution

    def _check_one_plan(self, what: str) -> None:
        """Raise InputError if there will be others: no matrices are known of these ahead of time."""
        if self._rule is not None:
            raise InputError(f"OffsetFree: {what}: got a law with replan_every={self._rule.every:g}, want one without")

    def loop(self) -> LinearLoop:
        """The closed loop about the plan, as matrices, with the uncertainty as it was stated.

        Raises:
          InputError: with `replan_every`, for then there are other plans.
        """
        self._check_one_plan("loop")
        truth = replace(self.model, uncertainty=self.uncertainty.as_steady)
        offset = self.offset - self.solution.trajectory.controls
        offset = offset + np.einsum("tij,tj->ti", self.gain, self._law.nominal[:-1])
        return LinearLoop(truth, self.gain, offset, self.filter.gain, *self._law.limits)

    @property
    def policy(self) -> OutputFeedbackPolicy:
        """The same for a robot, with NumPy alone: predictions are linear about the plan. `save` writes it to a file.

        Raises:
          InputError: with `replan_every`: NumPy alone solves nothing.
        """
        self._check_one_plan("policy")
        return policy_of(self._law)

    @property
    def digest(self) -> str:
        model, limits = self.model, np.array(self._law.limits)
        parts = (self.gain, self.offset, self._law.nominal, self.filter.gain, model.output, model.transition, limits)
        numbers = np.array([model.plan.dt, self.uncertainty.lag, self.uncertainty.latency, self.uncertainty.delay])
        moved = model.dynamics.fixed or np.array(list(model.dynamics.parameters.values()), dtype=np.float64)
        sources = model.dynamics.step_source.digest, moved, model.sensor.source.digest, model.sensor.data
        again = (
            ()
            if self._rule is None
            else (f"{self.problem.digest} {self._rule.periods} {self.replan_always}", self.filter.corrected)
        )
        return sha256(*parts, numbers, *sources, *again)[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self._law.coordinates


def for_filter(model: PlanModel, memory: float, effort: Array) -> PlanModel:
    """The model that a filter assumes: see `Uncertainty.steady`; with the least errors that it never goes below.

    Args:
      model: with the uncertainty as stated.
      memory: seconds.
      effort: of the controls, (m,).
    """
    stated, space = model.uncertainty, model.dynamics.state_coordinates
    moved = unit_means(space.units, reach_of(model, effort, 2)[2])
    control = per_entry("Uncertainty: control", stated.control, model.dynamics.control_coordinates)
    error = per_entry("Uncertainty: model_error", stated.model_error, space)
    assumed = replace(
        stated.steady(memory), control=tuple(np.maximum(control, INEXACT * effort).tolist()),
        model_error=tuple(np.maximum(error, INEXACT * moved).tolist()),
    )  # fmt: skip
    return replace(model, uncertainty=assumed)

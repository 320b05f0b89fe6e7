"""Output feedback that, by the linear model, leaves no steady error.

A Kalman filter estimates the state, what the actuators have reached, and what disturbs the robot; a tracking law
follows all of it.
"""

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.controllers import Control, Controller
from lqrsim.control.kalman import check_observable, kalman_filter
from lqrsim.control.loop_moments import Loop
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.policy_of_filter import policy_of
from lqrsim.control.replanned import Replanned
from lqrsim.control.replanner import Replanner
from lqrsim.control.sensors import Sensors, sensor_of
from lqrsim.control.tolerances import Prediction, choose_tolerances, with_filter
from lqrsim.control.tracking_laws import AT_END, Weights, check_plan, effort_of, tracking_laws
from lqrsim.control.uncertainty import PerEntry, Uncertainty, per_entry
from lqrsim.errors import Array, InputError, check_flag, check_kind, check_number
from lqrsim.kernels.estimation import FAR
from lqrsim.kernels.records import Limits, Measured, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.output_feedback import OutputFeedbackPolicy
from lqrsim.results.replan import Replan
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory

MEMORY = 5.0  # s
INEXACT = 0.02  # how far a control is off from its command, at least, relative to the tolerated effort


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
      record: whether to keep what the filter makes of the last run, for holding it against `filter`: see there.
      replan_every: seconds, rounded to control periods, after which it is looked at, again and again, whether the law
        still leads to the goal and clear of obstacles: by the model, from the estimated state and with the estimated
        constants. Where it does not, what is left of the horizon is solved from there; by default never. Where a solve
        does not succeed, the law before goes on. Costs that depend on the step's number are not supported then.
      replan_always: whether to solve at each of these times, wherever the law leads.

    Attributes:
      model: the linear model about the plan, with z = (state, what the actuators have reached, unknowns).
      filter: the filter's gains and covariances.
      gain: of the law, (T, m, Z).
      offset: of the law, (T, m).
      estimates: with `record`, the estimates (T+1, K, Z) of the K trials of the last run, each with the measurement of
        its knot: NaN where none was taken in, which is so of the last knot, and of as many more as measurements are
        late. Their errors have the covariances `filter.corrected`. Else None.
      innovations: likewise what measurements differed by from what was expected, (T+1, K, Y), of the covariances
        `filter.innovation`; NaN where a measurement got lost, too. Both covariances are of the first plan: with
        `replan_every` they are those of a run up to its first solve.
      plans: with `record` and `replan_every`, the new plans of each trial of the last run, by the step that they begin
        at. Else empty.
      solved, kept: as of `Replanning`, of the last run.

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
        self.estimates: Array | None = None
        self.innovations: Array | None = None
        self.plans: list[dict[int, Trajectory]] = []
        self._lost: Mapping[int, str] = {}
        sensor = sensor_of(sensors, problem.dynamics.state_coordinates)
        efforts = effort_of(effort, problem.dynamics)
        self.model = PlanModel.of(problem.dynamics, plan, for_filter(uncertainty, memory, efforts, problem), sensor)
        check_observable("OffsetFree", self.model)
        self._again = None if replan_every is None else self._replanner(replan_every)
        self.filter = kalman_filter(self.model)
        self.weights = self._weights(tolerate, efforts, at_end)
        self._make_law(np.zeros(len(self.model.transition)))

    def _make_law(self, granted: Array) -> None:
        """About the model's plan, which takes states (D,) of the unknowns for granted."""
        plan = self.model.plan
        self.gain, offset = tracking_laws(self.model, self.weights)
        # In what the filter estimates, and not in deviations from the plan.
        self.nominal = np.concatenate([plan.states, self.model.reached, np.tile(granted, (plan.steps + 1, 1))], axis=1)
        self.offset = plan.controls + offset - np.einsum("tij,tj->ti", self.gain, self.nominal[:-1])

    def _about(self, solution: Replan, model: PlanModel, corrected: Array, granted: Array) -> "OffsetFree":
        """The same about another plan, which begins with a measurement that is taken in already.

        Args:
          model: of its plan, with the dynamics that it is of. corrected: covariance of the estimate's error there,
            (Z, Z). granted: states of the unknowns that it takes for granted, (D,).
        """
        law = copy.copy(self)
        law.solution, law.model, law.filter = solution, model, kalman_filter(model, corrected)
        law._make_law(granted)
        return law

    def _replanner(self, every: float) -> Replanner:
        late = self.uncertainty.latency, self.uncertainty.delay
        if any(late):
            got = f"{every:g} with a latency of {late[0]} and a delay of {late[1]} periods"
            raise InputError(f"OffsetFree: replan_every: got {got}, want None, or an uncertainty without both")
        problem = replace(self.problem, dynamics=self.model.dynamics)
        return Replanner("OffsetFree", problem, self.solution, every, name="replan_every", deadline=0.0)

    def _weights(self, tolerate: PerEntry | None, effort: Array, at_end: float) -> Weights:
        """Of the tolerances, or of those that are chosen."""
        if tolerate is not None:
            return Weights.of(tolerate, effort, self.problem.dynamics, at_end=at_end)
        low, high = _limits(self)
        surroundings = Surroundings.of(self.problem, self.uncertainty.obstacles)

        def predicted(tried: Weights) -> Prediction:
            radius = self.solution.goal_radius
            return with_filter(self.model, self.filter, tried, (low, high), surroundings, radius)

        return choose_tolerances(self.model, predicted, effort, at_end).weights

    def start(self, trials: int) -> Control:
        self.estimates = self.innovations = None
        run = _Run(self, trials)
        if self.record:
            self.estimates, self.innovations = run.estimated, run.surprises
        if self._again is not None:
            run = Replanned(self._again, [run.of_trial(k) for k in range(trials)])
        self.plans = run.plans if self.record and isinstance(run, Replanned) else []
        self._lost = run.lost
        return run.control

    def lost(self) -> Mapping[int, str]:
        return self._lost

    @property
    def solved(self) -> int:
        return 0 if self._again is None else self._again.account.solved

    @property
    def kept(self) -> Counter[str]:
        return Counter() if self._again is None else self._again.account.kept

    def summary(self) -> str:
        return "" if self._again is None else self._again.account.summary()

    def _check_one_plan(self, what: str) -> None:
        """Raise InputError if there will be others: no matrices are known of these ahead of time."""
        if self._again is not None:
            raise InputError(f"OffsetFree: {what}: got a law with replan_every={self._again.every:g}, want one without")

    def loop(self) -> Loop:
        """The closed loop about the plan, as matrices, with the uncertainty as it was stated.

        Raises:
          InputError: with `replan_every`, for then there are other plans.
        """
        self._check_one_plan("loop")
        truth = replace(self.model, uncertainty=self.uncertainty.as_steady)
        offset = self.offset - self.solution.trajectory.controls
        offset = offset + np.einsum("tij,tj->ti", self.gain, self.nominal[:-1])
        return Loop(truth, self.gain, offset, self.filter.gain, *_limits(self))

    @property
    def policy(self) -> OutputFeedbackPolicy:
        """The same for a robot, with NumPy alone: predictions are linear about the plan. `save` writes it to a file.

        Raises:
          InputError: with `replan_every`: NumPy alone solves nothing.
        """
        self._check_one_plan("policy")
        return policy_of(self)

    @property
    def digest(self) -> str:
        model, limits = self.model, np.array(_limits(self))
        parts = (self.gain, self.offset, self.nominal, self.filter.gain, model.output, model.transition, limits)
        numbers = np.array([model.plan.dt, self.uncertainty.lag, self.uncertainty.latency, self.uncertainty.delay])
        moved = model.dynamics.fixed or np.array(list(model.dynamics.parameters.values()), dtype=np.float64)
        sources = model.dynamics.step_source.digest, moved, model.sensor.source.digest, model.sensor.data
        again = (
            ()
            if self._again is None
            else (f"{self.problem.digest} {self._again.periods} {self.replan_always}", self.filter.corrected)
        )
        return sha256(*parts, numbers, *sources, *again)[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.solution.policy.state_coordinates, self.solution.policy.control_coordinates


class _Run:
    """K trials of a run, with their estimates.

    With measurements that are late by k periods the filter lives k periods ago, and what it estimates is predicted on,
    by the commands since, to when the next command acts.
    """

    def __init__(self, law: OffsetFree, trials: int) -> None:
        self.law, self.first = law, 0  # the law in force, and the step that its plan begins at
        self.trials, self.model = trials, law.model  # which predicts, whatever the law's plan takes for granted
        self.estimates = np.tile(law.nominal[0], (trials, 1))  # of the knot that the newest measurement is of
        # What is shown until the first measurement comes, if that gets lost, is where the plan begins.
        self.last = np.tile(law.solution.trajectory.states[0], (trials, 1))
        self.lost: dict[int, str] = {}
        self.differences = np.empty((trials, law.model.sensor.size))
        knots = law.model.plan.steps + 1 if law.record else 0
        self.estimated = np.full((knots, trials, law.model.size), np.nan)
        self.surprises = np.full((knots, trials, law.model.sensor.size), np.nan)
        self.commands: list[Array] = []  # since that knot, the oldest first
        self.limits = Limits(*_limits(law))
        self.latency, self.delay = law.uncertainty.latency, law.uncertainty.delay
        # Until the first commands come, the plan's are applied.
        self.commands = [
            np.tile(law.solution.trajectory.controls[min(i, law.model.plan.steps - 1)], (trials, 1))
            for i in range(self.delay)
        ]

    def of_trial(self, k: int) -> "_Run":
        """One of its trials alone, which has not begun yet; what is recorded of it is a view of this one's."""
        one = _Run(self.law, 1)
        one.estimated, one.surprises = self.estimated[:, k : k + 1], self.surprises[:, k : k + 1]
        return one

    def control(self, step: int, shown: Array) -> Array:
        self.take_in(step, shown)
        return self.command(step)

    def take_in(self, step: int, shown: Array) -> None:
        """What is shown at a step, after the period before."""
        if step < self.latency:  # there is nothing new
            return
        law, model = self.law, self.model
        if step > self.latency:
            self._predict(self.estimates, self.commands.pop(0))
        # After the horizon the last gain stays in force.
        knot = min(step - self.first - self.latency, law.model.plan.steps)
        lost = (shown == self.last).all(axis=1).astype(np.float64)
        self.last[:] = shown
        model.compiled.correct(
            self.trials, Measured(in_c_order(shown), lost), in_c_order(model.plan.states[knot]), law.filter.gain[knot],
            model.compiled_sensor, model.turning, self.estimates, self.differences,
        )  # fmt: skip
        at = step - self.latency
        if at < len(self.estimated):  # which is empty if nothing is recorded
            self.estimated[at], self.surprises[at] = self.estimates, self.differences

    def command(self, step: int) -> Array:
        law, model = self.law, self.model
        ahead = self.estimates
        if self.commands:
            ahead = ahead.copy()
            for command in self.commands:
                self._predict(ahead, command)
        t = min(step - self.first + self.delay, law.model.plan.steps - 1)
        out = np.empty((self.trials, self.model.m))
        near = in_c_order(law.model.plan.states[t])
        gains = Policy(law.gain[t], law.offset[t])
        model.compiled.command(self.trials, ahead, near, gains, self.limits, model.turning, out)
        self.commands.append(out.copy())
        self._look_for_lost(ahead)
        return out

    def _look_for_lost(self, estimates: Array) -> None:
        """Notes whose estimates are not finite, or beyond all that a robot can be."""
        places = np.empty(self.trials)
        self.model.compiled.diverged(self.trials, estimates, places)
        for k in np.flatnonzero(places < self.model.size):
            i = int(places[k])
            what = f"is beyond {FAR:g}" if np.isfinite(estimates[k, i]) else "is not finite"
            self.lost.setdefault(int(k), f"the estimate of {self.model.names[i]} {what}")

    def _predict(self, estimates: Array, commands: Array) -> None:
        """A control period on."""
        self.model.compiled.predict(self.trials, in_c_order(commands), self.model.predictor, estimates)


def for_filter(uncertainty: Uncertainty, memory: float, effort: Array, problem: Problem) -> Uncertainty:
    """What a filter is to believe: see `Uncertainty.steady`; and that no command is carried out exactly.

    Without that, a filter that is told of no noise would listen to no measurement.
    """
    stated = per_entry("Uncertainty: control", uncertainty.control, problem.dynamics.control_coordinates)
    wrong = np.hypot(stated, INEXACT * effort)
    return replace(uncertainty.steady(memory), control=tuple(wrong.tolist()))


def _limits(law: OffsetFree) -> tuple[Array, Array]:
    """Lowest and highest controls."""
    space = law.solution.policy.control_coordinates
    return np.array(space.low), np.array(space.high)

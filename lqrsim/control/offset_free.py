"""Output feedback that leaves no steady error.

A Kalman filter estimates the state, what the actuators have reached, and what disturbs the robot; a tracking law
follows all of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lqrsim.codegen.jit import in_c_order
from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.controllers import Control, Controller
from lqrsim.control.kalman import check_observable, kalman_filter
from lqrsim.control.loop_moments import Loop
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.policy_of_filter import policy_of
from lqrsim.control.sensors import Sensors, sensor_of
from lqrsim.control.tolerances import Prediction, choose_tolerances, with_filter
from lqrsim.control.tracking_laws import AT_END, Weights, check_plan, effort_of, tracking_laws
from lqrsim.control.uncertainty import PerEntry, Uncertainty, per_entry
from lqrsim.errors import Array, check_flag, check_kind, check_number
from lqrsim.kernels.estimation import FAR
from lqrsim.kernels.records import Limits, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.output_feedback import OutputFeedbackPolicy
from lqrsim.results.solution import Solution

MEMORY = 5.0  # s
INEXACT = 0.02  # how far a control is off from its command, at least, relative to the tolerated effort


class OffsetFree(Controller):
    """Estimates the state, the actuators and what disturbs the robot, and keeps to the plan by all of it.

    The filter's gains are made ahead of time, about the plan; it predicts with the model itself, with the unknowns as
    they are estimated. A measurement that is the last one to the last bit got lost, and is predicted. One that is late
    by `uncertainty.latency` is taken in where it belongs. Commands count as they are after saturation, so that nothing
    winds up.

    Args:
      problem: that was solved. solution: its solution, or any with a plan of the same system.
      uncertainty: what the run meets, as `uncertainty_of` makes it. What varies may have a mean, too, and what is
        constant may change, in `memory` seconds by about its standard deviation: see `Uncertainty.steady`.
      tolerate, effort, at_end: as in `track`.
      sensors: names of the states that are measured, by default all; or a matrix (Y, n); or a function h(x, u, p) of
        SymPy symbols, as in `Dynamics`, that does not depend on u.
      memory: in s, by default 5 s, or the plan's horizon where that is shorter.
      record: whether to keep what the filter makes of the last run, for holding it against `filter`: see there.

    Attributes:
      model, filter: the linear model about the plan, with z = (state, what the actuators have reached, unknowns), and
        the filter's gains and covariances. gain, offset: of the law, (T, m, Z) and (T, m).
      estimates: with `record`, the estimates (T+1, K, Z) of the K trials of the last run, each with the measurement of
        its knot: NaN where none was taken in, which is so of the last knot, and of as many more as measurements are
        late. Their errors have the covariances `filter.corrected`. Else None.
      innovations: likewise what measurements differed by from what was expected, (T+1, K, Y), of the covariances
        `filter.innovation`; NaN where a measurement got lost, too.

    Raises:
      InputError: something does not fit the system; or an unknown changes nothing of what is measured.
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
    ) -> None:
        check_plan("OffsetFree", problem, solution)
        check_kind("OffsetFree: uncertainty", uncertainty, Uncertainty, "an Uncertainty, such as uncertainty_of(...)")
        plan = solution.trajectory
        memory = min(plan.horizon, MEMORY) if memory is None else memory
        memory = check_number("OffsetFree: memory", memory, above=0.0)
        self.problem, self.solution, self.uncertainty = problem, solution, uncertainty
        self.record = check_flag("OffsetFree: record", record)
        self.estimates: Array | None = None
        self.innovations: Array | None = None
        self._lost: Mapping[int, str] = {}
        sensor = sensor_of(sensors, problem.dynamics.state_coordinates)
        efforts = effort_of(effort, problem.dynamics)
        self.model = PlanModel.of(problem.dynamics, plan, for_filter(uncertainty, memory, efforts, problem), sensor)
        check_observable("OffsetFree", self.model)
        self.filter = kalman_filter(self.model)
        self.weights = self._weights(tolerate, efforts, at_end)
        self.gain, offset = tracking_laws(self.model, self.weights)
        # In what the filter estimates, and not in deviations from the plan.
        self.nominal = self._nominal()
        self.offset = plan.controls + offset - np.einsum("tij,tj->ti", self.gain, self.nominal[:-1])

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

    def _nominal(self) -> Array:
        """What an undisturbed run has of what is estimated, (T+1, Z)."""
        model, plan = self.model, self.solution.trajectory
        unknowns = np.zeros((plan.steps + 1, len(model.transition)))
        return np.concatenate([plan.states, model.reached, unknowns], axis=1)

    def start(self, trials: int) -> Control:
        self.estimates = self.innovations = None
        run = _Run(self, trials)
        if self.record:
            self.estimates, self.innovations = run.estimated, run.surprises
        self._lost = run.lost
        return run.control

    def lost(self) -> Mapping[int, str]:
        return self._lost

    def loop(self) -> Loop:
        """The closed loop about the plan, as matrices, with the uncertainty as it was stated."""
        truth = replace(self.model, uncertainty=self.uncertainty.as_steady)
        offset = self.offset - self.solution.trajectory.controls
        offset = offset + np.einsum("tij,tj->ti", self.gain, self.nominal[:-1])
        return Loop(truth, self.gain, offset, self.filter.gain, *_limits(self))

    @property
    def policy(self) -> OutputFeedbackPolicy:
        """The same for a robot, with NumPy alone: predictions are linear about the plan. `save` writes it to a file."""
        return policy_of(self)

    @property
    def digest(self) -> str:
        model, limits = self.model, np.array(_limits(self))
        parts = (self.gain, self.offset, self.nominal, self.filter.gain, model.output, model.transition, limits)
        numbers = np.array([model.plan.dt, self.uncertainty.lag, self.uncertainty.latency, self.uncertainty.delay])
        sources = model.dynamics.source, model.dynamics.data, model.sensor.source, model.sensor.data
        return sha256(*parts, numbers, *sources)[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.solution.policy.state_coordinates, self.solution.policy.control_coordinates


class _Run:
    """K trials of a run, with their estimates.

    With measurements that are late by k periods the filter lives k periods ago, and what it estimates is predicted on,
    by the commands since, to when the next command acts.
    """

    def __init__(self, law: OffsetFree, trials: int) -> None:
        self.law, self.trials, self.model = law, trials, law.model
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

    def control(self, step: int, shown: Array) -> Array:
        law, core, steps = self.law, self.model.core, self.model.plan.steps
        if step >= self.latency:  # before, there is nothing new
            if step > self.latency:
                self._predict(self.estimates, self.commands.pop(0))
            knot = min(step - self.latency, steps)  # after the horizon the last gain stays in force
            lost = (shown == self.last).all(axis=1).astype(np.float64)
            self.last[:] = shown
            core.correct(
                self.trials, in_c_order(shown), lost, in_c_order(self.model.plan.states[knot]), law.filter.gain[knot],
                self.model.sensor.data, self.estimates, self.differences,
            )  # fmt: skip
            if law.record and step - self.latency <= steps:
                self.estimated[knot], self.surprises[knot] = self.estimates, self.differences
        ahead = self.estimates
        if self.commands:
            ahead = ahead.copy()
            for command in self.commands:
                self._predict(ahead, command)
        t = min(step + self.delay, steps - 1)
        out = np.empty((self.trials, self.model.m))
        near = in_c_order(self.model.plan.states[t])
        core.command(self.trials, ahead, near, Policy(law.gain[t], law.offset[t]), self.limits, out)
        self.commands.append(out.copy())
        self._look_for_lost(ahead)
        return out

    def _look_for_lost(self, estimates: Array) -> None:
        """Notes whose estimates are not finite, or beyond all that a robot can be."""
        places = np.empty(self.trials)
        self.model.core.diverged(self.trials, estimates, places)
        for k in np.flatnonzero(places < self.model.size):
            i = int(places[k])
            what = f"is beyond {FAR:g}" if np.isfinite(estimates[k, i]) else "is not finite"
            self.lost.setdefault(int(k), f"the estimate of {self.model.names[i]} {what}")

    def _predict(self, estimates: Array, commands: Array) -> None:
        """A control period on."""
        self.model.core.predict(self.trials, in_c_order(commands), self.model.predictor, estimates)


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

"""Running a filter and its law: the estimates of K trials."""

from collections.abc import Mapping

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.controllers import ControllerRun
from lqrsim.control.filter_law import FilterLaw
from lqrsim.errors import Array
from lqrsim.kernels.estimation import FAR
from lqrsim.kernels.records import Limits, Measurements, Policy


class FilterRun(ControllerRun):
    """K trials of a run, with their estimates.

    With measurements that are late by k periods the filter lives k periods ago, and what it estimates is predicted on,
    by the commands since, to when the next command acts.

    Args:
      law: to begin with.
      trials: K.
      records: arrays for `estimates` and `innovations`, to be filled; None to record nothing.

    Attributes:
      law: in force.
      first: the step that its plan begins at.
      z: the estimates now, (K, Z), of the knot that the newest measurement is of.
      estimates: what was recorded of them, (T+1, K, Z), or None; see `OffsetFree`.
      innovations: likewise, (T+1, K, Y).
    """

    def __init__(self, law: FilterLaw, trials: int, records: tuple[Array, Array] | None) -> None:
        self.law, self.first = law, 0
        self.model = law.model  # which predicts, whatever the law's plan takes for granted
        self._trials = trials
        self.z = np.tile(law.nominal[0], (trials, 1))
        # What is shown until the first measurement comes, if that gets lost, is where the plan begins.
        self._last = np.tile(law.model.plan.states[0], (trials, 1))
        self._diverged: dict[int, str] = {}
        self._differences = np.empty((trials, law.model.sensor.size))
        self.estimates, self.innovations = records or (None, None)
        self._limits = Limits(*law.limits)
        self._latency, self._delay = law.model.uncertainty.latency, law.model.uncertainty.delay
        # Commands since the knot that z is of, the oldest first. Until the first commands come, the plan's are applied.
        controls = law.model.plan.controls
        self._commands = [np.tile(controls[min(i, len(controls) - 1)], (trials, 1)) for i in range(self._delay)]

    def control(self, step: int, measured: Array) -> Array:
        self.take_in(step, measured)
        return self.command(step)

    def estimator_diverged(self) -> Mapping[int, str]:
        return self._diverged

    def take_in(self, step: int, measured: Array) -> None:
        """What is measured at a step, after the period before."""
        if step < self._latency:  # there is nothing new
            return
        law, model = self.law, self.model
        if step > self._latency:
            self._predict(self.z, self._commands.pop(0))
        # After the horizon the last gain stays in force.
        knot = min(step - self.first - self._latency, law.model.plan.steps)
        lost = (measured == self._last).all(axis=1).astype(np.float64)
        self._last[:] = measured
        model.compiled.correct(
            self._trials, Measurements(in_c_order(measured), lost), in_c_order(law.model.plan.states[knot]),
            law.filter.gain[knot], model.compiled_sensor, model.turning, self.z, self._differences,
        )  # fmt: skip
        at = step - self._latency
        if self.estimates is not None and self.innovations is not None and at < len(self.estimates):
            self.estimates[at], self.innovations[at] = self.z, self._differences

    def command(self, step: int) -> Array:
        """The law of the estimates, at a step whose measurement was taken in."""
        law, model = self.law, self.model
        ahead = self.z
        if self._commands:
            ahead = ahead.copy()
            for command in self._commands:
                self._predict(ahead, command)
        t = min(step - self.first + self._delay, law.model.plan.steps - 1)
        out = np.empty((self._trials, self.model.m))
        near = in_c_order(law.model.plan.states[t])
        gains = Policy(law.gain[t], law.offset[t])
        model.compiled.command(self._trials, ahead, near, gains, self._limits, model.turning, out)
        self._commands.append(out.copy())
        self._look_for_diverged(ahead)
        return out

    def _look_for_diverged(self, estimates: Array) -> None:
        """Note whose estimates are not finite, or beyond all that a robot can be."""
        places = np.empty(self._trials)
        self.model.compiled.diverged(self._trials, estimates, places)
        for k in np.flatnonzero(places < self.model.size):
            i = int(places[k])
            what = f"is beyond {FAR:g}" if np.isfinite(estimates[k, i]) else "is not finite"
            self._diverged.setdefault(int(k), f"the estimate of {self.model.names[i]} {what}")

    def _predict(self, estimates: Array, commands: Array) -> None:
        """A control period on."""
        self.model.compiled.predict(self._trials, in_c_order(commands), self.model.predictor, estimates)


def empty_records(law: FilterLaw, trials: int) -> tuple[Array, Array]:
    """Where `FilterRun` records estimates and innovations of K trials: NaN where nothing is taken in."""
    knots, model = law.model.plan.steps + 1, law.model
    return np.full((knots, trials, model.size), np.nan), np.full((knots, trials, model.sensor.size), np.nan)

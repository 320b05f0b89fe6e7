"""The records of a run, from which its `Rollout` is made."""

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from lqrsim.control.controllers import turn_to_nearest
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import Trajectory

Mask = npt.NDArray[np.bool_]


class Recorder:
    """The records of K trials of a plan with T steps.

    Attributes:
      states, measured: (K, T+1, n). clearance: (K, T+1). commanded, applied: (K, T, m). wrench: (K, T, 6).
      contacts: (K,) number of control periods in contact.
      lost_since: (K,) knot from which on the records are invalid; T+1 if all are valid.
      failed_since: (K,) knot at which the controller failed; T+1 if it never failed.
      reasons: the reason why each trial's controller failed or its filter diverged; empty for other trials.
      frames: arrays of MuJoCo's qpos, (K, nq) each.
    """

    def __init__(self, plan: Trajectory, trials: int) -> None:
        self.plan, self._steps = plan, plan.steps
        steps, n, m = plan.steps, plan.states.shape[1], plan.controls.shape[1]
        self.states, self.measured = _records(trials, steps + 1, n), _records(trials, steps + 1, n)
        self.clearance = _records(trials, steps + 1, 1)[..., 0]
        self.commanded, self.applied = _records(trials, steps, m), _records(trials, steps, m)
        self.wrench = _records(trials, steps, 6)
        self.contacts = np.zeros(trials, dtype=np.int64)
        self.lost_since = np.full(trials, steps + 1)
        self.failed_since, self.reasons = np.full(trials, steps + 1), [""] * trials
        self.frames: list[Array] = []

    def knot(self, step: int, states: Array, measured: Array, clearance: Array, lost: Mask) -> None:
        """Record states (K, n), true and measured, and clearance (K,) at a knot, and which are invalid from here."""
        self.states[:, step], self.measured[:, step], self.clearance[:, step] = states, measured, clearance
        if lost.any():
            self.lost_since[lost] = np.minimum(self.lost_since[lost], step)

    def estimator_diverged(self, step: int, reasons: Mapping[int, str]) -> None:
        """Record that the filters of these trials, row -> reason, diverged at this knot, unless a trial has ended."""
        over = self.over(step)
        for row, reason in reasons.items():
            if not over[row]:
                self.lost_since[row] = step
                self.reasons[row] = f"filter at {step * self.plan.dt:.4g} s: {reason}"

    def fail(self, step: int, rows: Mask, reasons: Iterable[str]) -> None:
        """Record that the controllers of these trials (K,) failed at this knot, unless a trial has ended."""
        over = self.over(step)
        for row, reason in zip(np.flatnonzero(rows), reasons, strict=True):
            if not over[row]:
                self.failed_since[row] = step
                self.reasons[row] = f"controller at {step * self.plan.dt:.4g} s: {reason}"

    def over(self, step: int) -> Mask:
        """Whether each trial's controller has failed, or its records are invalid, at this knot or before, (K,)."""
        return np.minimum(self.lost_since, self.failed_since) <= step

    def time_of(self, knots: npt.NDArray[np.int64]) -> Array:
        """The times of knots (K,) in s; infinite beyond the last one."""
        return np.where(knots <= self._steps, self.plan.dt * knots, np.inf)

    def turn_to_plan(self, space: Coordinates) -> None:
        """Replace the angles of all states by their representatives nearest the plan."""
        for array in (self.states, self.measured):
            turn_to_nearest(space, array.transpose(1, 0, 2), self.plan.states)

    def stacked_frames(self, each: int, *, all_of_them: bool) -> Array:
        """The frames (K, F, nq), `each` in a period, or only the first; NaN for those that were not reached."""
        missing = (self._steps * each + 1 - len(self.frames)) if all_of_them else 0
        return np.stack(self.frames + [np.full_like(self.frames[0], np.nan)] * missing, axis=1)

    def erase(self, frames: Array, each: int) -> None:
        """Set records and `frames` (K, F, nq) to NaN after a trial was lost or its controller failed."""
        if not self.over(self._steps).any():
            return
        known_until = np.minimum(self.lost_since, self.failed_since + 1)  # where a controller fails, the state is known
        driven_until = np.minimum(self.lost_since, self.failed_since)
        knots = np.arange(self._steps + 1)
        # A frame belongs to the knot at the end of its period: the trial was lost somewhere before that.
        knot_of_frame = -(np.arange(frames.shape[1]) // -each)
        for array, knot, until in (
            *((array, knots, known_until) for array in (self.states, self.measured, self.clearance)),
            *((array, knots[:-1], driven_until) for array in (self.commanded, self.applied, self.wrench)),
            (frames, knot_of_frame, known_until),
        ):
            array[knot >= until[:, None]] = np.nan


def _records(trials: int, steps: int, size: int) -> Array:
    """Zeros (K, steps, size). In memory, all trials of a step are adjacent, as they are written."""
    return np.zeros((steps, trials, size)).transpose(1, 0, 2)

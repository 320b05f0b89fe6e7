"""What is recorded of a run, and the `Rollout` that is made of it."""

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from lqrsim.control.controllers import turn_to_nearest
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import Trajectory

Mask = npt.NDArray[np.bool_]


class Recorder:
    """Records of K trials of a plan with T steps, as they come.

    Attributes:
      states, measured: (K, T+1, n). clearance: (K, T+1). commanded, applied: (K, T, m). wrench: (K, T, 6).
      contacts: (K,) control periods in contact.
      lost_since: (K,) the knot from which on a trial's records mean nothing; T+1 for those that were never lost.
      failed_since: (K,) the knot at which its controller failed; T+1 where it did not.
      reasons: (K) why it failed, or was lost, where there is more to say than that.
      frames: MuJoCo's qpos (K, nq), one after the other.
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

    def knot(self, step: int, states: Array, measured: Array, clearance: Array) -> None:
        """The true states (K, n) at a knot, what the controller is shown, and the clearance (K,)."""
        self.states[:, step], self.measured[:, step], self.clearance[:, step] = states, measured, clearance

    def lose(self, step: int, rows: Mask) -> None:
        """The states of these trials (K,) mean nothing from this knot on."""
        if rows.any():
            self.lost_since[rows] = np.minimum(self.lost_since[rows], step)

    def estimator_diverged(self, step: int, reasons: Mapping[int, str]) -> None:
        """The estimates of these trials are useless from this knot on. Trials that are over cannot diverge."""
        over = self.over(step)
        for row, reason in reasons.items():
            if not over[row]:
                self.lost_since[row] = step
                self.reasons[row] = f"filter at {step * self.plan.dt:.4g} s: {reason}"

    def fail(self, step: int, rows: Mask, reasons: Iterable[str]) -> None:
        """The controllers of these trials (K,) failed at this knot; a reason for each. Who is over cannot fail."""
        over = self.over(step)
        for row, reason in zip(np.flatnonzero(rows), reasons, strict=True):
            if not over[row]:
                self.failed_since[row] = step
                self.reasons[row] = f"controller at {step * self.plan.dt:.4g} s: {reason}"

    def over(self, step: int) -> Mask:
        """Whose controller has failed, or who is lost, at this knot or before, (K,)."""
        return np.minimum(self.lost_since, self.failed_since) <= step

    def time_of(self, knots: npt.NDArray[np.int64]) -> Array:
        """Seconds to these knots (K,); infinite where they are beyond the last."""
        return np.where(knots <= self._steps, self.plan.dt * knots, np.inf)

    def turn_to_plan(self, space: Coordinates) -> None:
        """Take the angles of all states to the representative nearest the plan."""
        for array in (self.states, self.measured):
            turn_to_nearest(space, array.transpose(1, 0, 2), self.plan.states)

    def stacked_frames(self, each: int, *, all_of_them: bool) -> Array:
        """The frames (K, F, nq); NaN for those that were not reached.

        Args:
          each: how many a control period has. all_of_them: whether they were recorded, or the first alone.
        """
        missing = (self._steps * each + 1 - len(self.frames)) if all_of_them else 0
        return np.stack(self.frames + [np.full_like(self.frames[0], np.nan)] * missing, axis=1)

    def erase(self, frames: Array, each: int) -> None:
        """Put NaN wherever a trial was lost, or its controller had failed; in its `frames` (K, F, nq) too."""
        if not self.over(self._steps).any():
            return
        known_until = np.minimum(
            self.lost_since, self.failed_since + 1
        )  # the knot at which a controller fails is known
        driven_until = np.minimum(self.lost_since, self.failed_since)
        knots = np.arange(self._steps + 1)
        # A frame belongs to the knot that ends its period: the trial was lost somewhere before that.
        knot_of_frame = -(np.arange(frames.shape[1]) // -each)
        for array, knot, until in (
            *((array, knots, known_until) for array in (self.states, self.measured, self.clearance)),
            *((array, knots[:-1], driven_until) for array in (self.commanded, self.applied, self.wrench)),
            (frames, knot_of_frame, known_until),
        ):
            array[knot >= until[:, None]] = np.nan


def _records(trials: int, steps: int, size: int) -> Array:
    """Zeros (K, steps, size) that lie in memory as they are written: all trials of a step together."""
    return np.zeros((steps, trials, size)).transpose(1, 0, 2)

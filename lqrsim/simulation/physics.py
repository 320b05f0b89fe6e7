"""MuJoCo's side of the loop: all trials' states, and how to advance them by a control period."""

from collections.abc import Callable

import mujoco
import numpy as np
from mujoco import batch

from lqrsim.errors import Array
from lqrsim.machine import processors
from lqrsim.simulation.plant import Indices, Plant

FRAME_PERIOD = 1 / 30  # s; positions for drawing are recorded at least this often, if the physics step is not longer

_WARNINGS = mujoco.mjtWarning
# What MuJoCo does not go on with: it resets the state, or the controls, and only warns.
UNSTABLE = [
    int(warning)
    for warning in (
        _WARNINGS.mjWARN_BADQPOS, _WARNINGS.mjWARN_BADQVEL, _WARNINGS.mjWARN_BADQACC, _WARNINGS.mjWARN_BADCTRL
    )
]  # fmt: skip


class Physics:
    """K simulations of a plant.

    Args:
      substeps: physics steps of a control period.
      frames: whether to record positions for drawing, within the control periods too.
      contacts: whether the robot collides with obstacles; through them, a quarter of the time is saved.
      threads: by default as many as there are processors.
      watch: called with each frame as it comes: its time, what `frame` returns, and `unstable`.

    Attributes:
      simulations: MuJoCo's. parts: frames of a control period.
      unstable: (K,) who blew up.
    """

    def __init__(
        self,
        plant: Plant,
        trials: int,
        substeps: int,
        *,
        frames: bool,
        contacts: bool,
        threads: int | None,
        watch: Callable[[float, Array, np.ndarray], object] | None = None,
    ) -> None:
        self.plant, self._watch, self._watched = plant, watch, 0
        model = plant.model if contacts else plant.without_contacts
        self.simulations = batch.Batch(model, trials, min(trials, threads or processors()))
        self._sensors = self.simulations.bind("sensordata") if contacts else None
        # The longest equal parts of the period that are short enough to draw.
        parts = [part for part in range(1, substeps + 1) if substeps % part == 0]
        drawn = max([part for part in parts if part * plant.timestep <= FRAME_PERIOD + 1e-9], default=1)
        self._part = drawn if frames else substeps
        self.parts = substeps // self._part if frames else 0
        self._steps = substeps // self._part
        self._qpos, self._qvel = self.simulations.bind("qpos"), self.simulations.bind("qvel")
        self._ctrl, self._wrench = self.simulations.bind("ctrl"), self.simulations.bind("xfrc_applied")
        self._in_qpos, self._in_qvel, self._in_ctrl = (_span(one) for one in (plant.qpos, plant.qvel, plant.ctrl))
        self.unstable = np.zeros(trials, dtype=bool)

    def place(self, states: Array) -> None:
        """Put the robots where analytic states (K, n) say."""
        qpos, qvel = self.plant.robot.configuration(states)
        self._qpos[:, self._in_qpos], self._qvel[:, self._in_qvel] = qpos, qvel

    def frame(self) -> Array:
        """MuJoCo's qpos now, (K, nq)."""
        return self._qpos.copy()

    def state(self) -> Array:
        """The analytic states (K, n), angles in any representative."""
        return self.plant.robot.state(self._qpos[:, self._in_qpos], self._qvel[:, self._in_qvel])

    def advance(self, controls: Array, wrench: Array) -> tuple[np.ndarray, list[Array]]:
        """One control period under controls (K, m), forces and torques (K, 6).

        Returns:
          who touched an obstacle, (K,), and the frames.
        """
        touched, frames = np.zeros(len(controls), dtype=bool), []
        self._ctrl[:, self._in_ctrl] = self.plant.robot.actuation(controls)
        self._wrench[:, self.plant.body] = wrench
        for _ in range(self._steps):
            try:
                self.simulations.step(nstep=self._part)
            except batch.SimulationError as error:
                self.unstable[error.ids] = True
            if self._sensors is not None:
                touched |= (self._sensors[:, self.plant.contact] > 0).any(axis=1)
            if self.parts:
                frames.append(self.frame())
                if self._watch is not None:
                    self._watched += 1
                    self._watch(self._watched * self._part * self.plant.timestep, frames[-1], self.unstable)
        # MuJoCo resets an unstable simulation and goes on; only its warnings tell.
        warned = self.simulations.warning[..., 1]
        if warned.any():
            self.unstable |= (warned[:, UNSTABLE] > 0).any(axis=1)
        return touched, frames


def _span(indices: Indices) -> slice | Indices:
    """The same place in an array; as a slice, which copies nothing, where they follow each other."""
    first, last = int(indices.min(initial=0)), int(indices.max(initial=-1))
    return slice(first, last + 1) if np.array_equal(indices, np.arange(first, last + 1)) else indices

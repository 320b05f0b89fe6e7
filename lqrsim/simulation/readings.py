"""What a controller reads of the sensors of an MJCF in a run: MuJoCo's readings with errors, rates and delays."""

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.robots.sensors import RobotSensors
from lqrsim.simulation.effects import Effects
from lqrsim.simulation.mujoco_physics import AnyPhysics, MujocoPhysics


class Readings:
    """The readings of K trials. A number is NaN where no reading of its sensor arrives, or it got lost.

    Args:
      dt: control period in s.
    """

    def __init__(self, sensors: RobotSensors, effects: Effects, physics: AnyPhysics, dt: float) -> None:
        if not isinstance(physics, MujocoPhysics):
            raise InputError("controller: got one that reads sensors of the MJCF, want a plant moved by MuJoCo")
        self._sensors, self._effects, self._physics, self._dt = sensors, effects, physics, dt
        self._late, self._taken = sensors.late(dt), dict[int, Array]()

    def follow(self, step: int, states: Array, controls: Array) -> Array:
        """The exact readings that arrive at a knot of the plan, before the run begins; as `arriving`."""
        taken = self._sensors.reader()(states[:1], controls[:1], np.zeros((1, 6)))
        return self._arriving(step, np.repeat(taken, len(states), axis=0))

    def arriving(self, step: int, held: Array | None = None) -> Array:
        """The readings that arrive at a knot, (K, Y).

        Args:
          held: the controls (K, m) that are in force there; by default those that act already.
        """
        exact = self._sensors.readings(self._physics.sense(held))
        named = {one.name: exact[:, at] for one, at in self._columns()}
        named = self._effects.read(step, named)
        return self._arriving(step, np.concatenate([named[one.name] for one, _ in self._columns()], axis=1))

    def _columns(self) -> zip:
        return zip(self._sensors.sensors, self._sensors.columns, strict=True)

    def _arriving(self, step: int, taken: Array) -> Array:
        self._taken[step] = taken
        self._taken.pop(step - max(self._late) - 1, None)
        out = np.full(taken.shape, np.nan)
        for i, (at, late) in enumerate(zip(self._sensors.columns, self._late, strict=True)):
            if step - late in self._taken and self._sensors.due(step - late, self._dt)[i]:
                out[:, at] = self._taken[step - late][:, at]
        return out

"""The sensors of an MJCF: what its `<sensor>` elements say, and their readings by MuJoCo."""

import copy
from typing import NamedTuple

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError, check_name

_TYPES = mujoco.mjtSensor
# What these read jumps, has no number in the state, or is of another program: no filter can be linearised about it.
_REFUSED = {
    getattr(_TYPES, f"mjSENS_{name}")
    for name in ("TOUCH", "CONTACT", "TACTILE", "INSIDESITE", "CLOCK", "USER", "PLUGIN", "GEOMNORMAL", "GEOMFROMTO")
}
NO_HIT = -1.0  # what a rangefinder reads if its ray meets nothing
QUATERNIONS = "framequat", "ballquat"  # a reading of these and its negative mean the same


class FileSensor(NamedTuple):
    """A `<sensor>` element.

    Attributes:
      columns: where its reading is in MuJoCo's `sensordata`.
      kind: its tag, such as "gyro".
      noise: standard deviation of the file, which MuJoCo itself does not apply. interval: seconds between two readings,
        0 for each physics step. delay: seconds.
    """

    columns: slice
    kind: str
    noise: float
    interval: float
    delay: float


def file_sensor(model: mujoco.MjModel, name: str, what: str) -> FileSensor:
    """The sensor of a name."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    if not any(names):
        raise InputError(f"{what}: got {name!r}, want a named element of <sensor>, of which the MJCF has none")
    number = names.index(check_name(what, name, [one for one in names if one]))
    kind = _TYPES(model.sensor_type[number])
    tag = kind.name.removeprefix("mjSENS_").lower()
    if kind in _REFUSED:
        raise InputError(f"{what}: got {name!r} of the kind {tag}, which has no smooth reading, want another sensor")
    first = int(model.sensor_adr[number])
    return FileSensor(
        slice(first, first + int(model.sensor_dim[number])), tag, float(model.sensor_noise[number]),
        float(model.sensor_interval[number, 0]), float(model.sensor_delay[number]),
    )  # fmt: skip


def at_once(model: mujoco.MjModel) -> None:
    """Let MuJoCo's `sensordata` be the readings of the present: delays and intervals are the closed loop's."""
    model.sensor_delay[:], model.sensor_interval[:] = 0.0, 0.0


class SensorReader:
    """Computes readings in given states. One is used by one thread."""

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self._model = copy.copy(model)
        at_once(self._model)
        self._data, self._body = mujoco.MjData(self._model), body

    def read(self, qpos: Array, qvel: Array, act: Array, ctrl: Array, wrench: Array) -> Array:
        """MuJoCo's `sensordata` (K, any), for rows of its arrays and of a force and torque in the world's axes (K, 6).

        Each row is computed from nothing but its own numbers.
        """
        model, data = self._model, self._data
        found = np.empty((len(qpos), model.nsensordata))
        for k in range(len(qpos)):
            data.qpos, data.qvel, data.act, data.ctrl = qpos[k], qvel[k], act[k], ctrl[k]
            data.xfrc_applied[self._body] = wrench[k]
            data.qacc_warmstart = 0.0
            mujoco.mj_forward(model, data)
            found[k] = data.sensordata
        return found

"""Sensors of a robot's MJCF, with their errors and their timing."""

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, NonNegative, Positive, Want, checked
from lqrsim.errors import Array, InputError, check_items, check_name
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.archive import sha256
from lqrsim.robots.base import Robot, indices_in
from lqrsim.scenes.scene import Scene

_TYPES = mujoco.mjtSensor
# Kinds whose readings jump, depend on the time, or are computed by a user's code: a filter cannot linearise these.
_REFUSED = {
    getattr(_TYPES, f"mjSENS_{name}")
    for name in ("TOUCH", "CONTACT", "TACTILE", "INSIDESITE", "CLOCK", "USER", "PLUGIN", "GEOMNORMAL", "GEOMFROMTO")
}
# What a rangefinder reads if its ray meets nothing, in MuJoCo's order: the distance, direction, origin, point, normal
# and depth. The origin does not tell, and stays.
_NO_HIT = [-1.0], [0.0] * 3, [np.nan] * 3, [0.0] * 3, [0.0] * 3, [-1.0]
_QUATERNIONS = _TYPES.mjSENS_FRAMEQUAT, _TYPES.mjSENS_BALLQUAT  # a reading of these and its negative mean the same
_ROUNDING = 1e-9  # fraction of a control period within which a time counts as that of a knot

# (states (K, n), controls (K, m), force and torque in the world's axes (K, 6)) -> readings (K, Y)
Reader = Callable[[Array, Array, Array], Array]


@checked
@dataclass(frozen=True)
class Sensor:
    """An element of an MJCF's `<sensor>`, with errors and timing. Units are those of MuJoCo's reading.

    A policy reads sensors at the knots. A sensor is read at the first knot at or after each multiple of its interval,
    and what it reads is the state of that knot; one that is faster than the control rate gives its newest reading. The
    reading arrives at the first knot after its delay.

    Args:
      name: name of the element. Not supported are kinds without a smooth reading, such as touch and contact.
      noise: standard deviation of white noise; by default the file's `noise`.
      bias: standard deviation of a bias of each trial, which is constant from the start.
      bias_walk: standard deviation that the bias gains in one second, as a random walk.
      rate: readings in a second; by default by the file's `interval`, and without that at each knot.
      delay: seconds from a reading to its arrival; by default the file's `delay`.
      loss: chance that a reading is lost.
    """

    name: Annotated[str, Want("the name of an element of <sensor>")]
    noise: NonNegative | None = None
    bias: NonNegative = 0.0
    bias_walk: NonNegative = 0.0
    rate: Positive | None = None
    delay: NonNegative | None = None
    loss: Annotated[float, Bounds(at_least=0.0, below=1.0)] = 0.0


class RobotSensors:
    """Sensors of a robot's MJCF, made by `plant.sensors(...)`. Their readings (K, Y) are those of all sensors in turn.

    `columns` are those of each sensor in the readings, and `names` those of the columns, (Y,). `quaternions` says which
    sensors read a quaternion, which means the same as its negative. By `drag`, the robot's, a wind is a force.
    """

    _prefix = ""

    @checked
    def __init__(self, robot: Robot, scene: Scene, sensors: Sequence[Sensor]) -> None:
        stated = check_items("sensors", sensors, Sensor, "a list of Sensor")
        if not stated or len({sensor.name for sensor in stated}) < len(stated):
            raise InputError(f"sensors: got {[sensor.name for sensor in stated]}, want at least one, each at most once")
        self._robot, self._scene, self.drag, model = robot, scene, robot.drag, scene.model
        numbers = [_number_of(model, sensor.name) for sensor in stated]
        kinds = [_TYPES(model.sensor_type[number]) for number in numbers]
        self.quaternions = tuple(kind in _QUATERNIONS for kind in kinds)
        self._sizes = model.sensor_dim[numbers].tolist()
        ends = itertools.pairwise(np.cumsum([0, *self._sizes]).tolist())
        self.columns = tuple(slice(first, end) for first, end in ends)
        places = zip(model.sensor_adr[numbers].tolist(), self._sizes, strict=True)
        self._places = np.concatenate([first + np.arange(size) for first, size in places])
        self._rays = [
            (columns, _no_hit_of(model, number))
            for columns, number, kind in zip(self.columns, numbers, kinds, strict=True)
            if kind == _TYPES.mjSENS_RANGEFINDER
        ]
        pairs = zip(stated, self._sizes, strict=True)
        self.names = tuple(
            f"{sensor.name}[{i}]" if size > 1 else sensor.name for sensor, size in pairs for i in range(size)
        )
        self.sensors = tuple(_completed(sensor, model, k) for sensor, k in zip(stated, numbers, strict=True))

    def __repr__(self) -> str:
        return f"RobotSensors({', '.join(sensor.name for sensor in self.sensors)})"

    @property
    def digest(self) -> str:
        """Hash of all that readings, errors and timing depend on."""
        return sha256(self._scene.mjcf.xml, repr(self.sensors))

    def check_robot(self, dynamics: Dynamics) -> None:
        """Raise InputError unless these are sensors of the robot with these dynamics."""
        coordinates, others = self._robot.dynamics.state_coordinates, dynamics.state_coordinates
        if coordinates.names != others.names:
            raise InputError(f"sensors: got those of robot {self._robot.name}, want those of the problem's robot")

    def per_reading(self, field: str) -> Array:
        """The values of a field of `Sensor` for each column of the readings, (Y,)."""
        return np.repeat([float(getattr(sensor, field)) for sensor in self.sensors], self._sizes)

    def due(self, knot: int, dt: float) -> npt.NDArray[np.bool_]:
        """Whether each sensor is read at a knot, for a control period of dt seconds."""
        rates = np.array([np.inf if sensor.rate is None else sensor.rate for sensor in self.sensors])
        per_period = np.minimum(rates, 1 / dt) * dt  # multiples of the interval in a period
        return np.floor(knot * per_period + _ROUNDING) > np.floor((knot - 1) * per_period + _ROUNDING)

    def delay_periods(self, dt: float) -> list[int]:
        """The number of control periods of dt seconds after which the reading of each sensor arrives."""
        return [int(np.ceil((sensor.delay or 0.0) / dt - _ROUNDING)) for sensor in self.sensors]

    def readings(self, sensordata: Array) -> Array:
        """The readings (K, Y) from MuJoCo's `sensordata` (K, any); NaN where a rangefinder's ray meets nothing."""
        readings = sensordata[:, self._places]
        for columns, no_hit in self._rays:
            rays, tells = readings[:, columns].reshape(len(readings), -1, len(no_hit)), ~np.isnan(no_hit)
            missed = (rays == no_hit)[..., tells].all(axis=2, keepdims=True)
            readings[:, columns] = np.where(missed & tells, np.nan, rays).reshape(len(readings), -1)
        return readings

    def reader(self) -> Reader:
        """A function that computes readings without errors by MuJoCo, for one thread; see `Reader`.

        A row's readings do not depend on the other rows: MuJoCo's solver is not warm-started.
        """
        robot, model = self._robot, copy.copy(self._scene.model)
        ignore_timing(model)
        data, body = mujoco.MjData(model), int(model.body(robot.body).id)
        in_qpos, in_qvel, in_ctrl = indices_in(robot, model)

        def read(states: Array, controls: Array, wrench: Array) -> Array:
            qpos, qvel, ctrl = *robot.configuration(states), robot.actuation(controls)
            sensordata = np.empty((len(states), model.nsensordata))
            for k, state in enumerate(states):
                data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = model.qpos0, 0.0, 0.0, 0.0
                data.qpos[in_qpos], data.qvel[in_qvel], data.ctrl[in_ctrl] = qpos[k], qvel[k], ctrl[k]
                if robot.activations:
                    data.act[:] = state[len(state) - robot.activations :]
                data.xfrc_applied[body] = wrench[k]
                mujoco.mj_forward(model, data)
                sensordata[k] = data.sensordata
            return self.readings(sensordata)

        return read


def _no_hit_of(model: mujoco.MjModel, number: int) -> Array:
    """What each ray of a rangefinder reads if it meets nothing."""
    fields = int(model.sensor_intprm[number, 0])
    return np.concatenate([reading for bit, reading in enumerate(_NO_HIT) if fields >> bit & 1])


def _completed(sensor: Sensor, model: mujoco.MjModel, number: int) -> Sensor:
    """The sensor with the file's noise, rate and delay where none are given."""
    interval = float(model.sensor_interval[number, 0])  # 0 for each physics step
    return replace(
        sensor,
        noise=float(model.sensor_noise[number]) if sensor.noise is None else sensor.noise,
        rate=1 / interval if sensor.rate is None and interval else sensor.rate,
        delay=float(model.sensor_delay[number]) if sensor.delay is None else sensor.delay,
    )


def _number_of(model: mujoco.MjModel, name: str) -> int:
    """The id of a sensor. Raises InputError if there is none of this name, or its kind has no smooth reading."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    if not any(names):
        raise InputError(f"sensors: got {name!r}, want a named element of <sensor>, of which the MJCF has none")
    number = names.index(check_name("sensors", name, [sensor_name for sensor_name in names if sensor_name]))
    if (kind := _TYPES(model.sensor_type[number])) in _REFUSED:
        tag = kind.name.removeprefix("mjSENS_").lower()
        raise InputError(f"sensors: got {name!r} of the kind {tag}, which has no smooth reading, want another sensor")
    return number


def ignore_timing(model: mujoco.MjModel) -> None:
    """Let MuJoCo read all sensors at each step, without delay: the closed loop applies their rates and delays."""
    model.sensor_delay[:], model.sensor_interval[:] = 0.0, 0.0

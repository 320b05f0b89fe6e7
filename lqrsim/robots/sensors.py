"""Sensors of a robot's MJCF, with their errors and their timing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, NonNegative, Positive, Want, checked
from lqrsim.errors import Array, InputError, check_items
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.archive import sha256
from lqrsim.robots.base import Robot, indices_in
from lqrsim.scenes.mjcf_sensors import NO_HIT, QUATERNIONS, SensorReader, file_sensor
from lqrsim.scenes.scene import Scene

# Of a period: a time that is a knot, up to rounding, is that knot.
_ROUNDING = 1e-9

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
    """Sensors of the MJCF that a robot is in; `plant.sensors(...)` makes it.

    Attributes:
      sensors: the sensors, with the file's numbers where none were given.
      columns: where each one's numbers are in the readings.
      drag: the robot's, through which wind acts as a force.
      quaternions: for each sensor, whether a reading and its negative mean the same.
    """

    _prefix = ""

    @checked
    def __init__(self, robot: Robot, scene: Scene, sensors: Sequence[Sensor]) -> None:
        given = check_items("sensors", sensors, Sensor, "a list of Sensor")
        if not given or len({one.name for one in given}) < len(given):
            raise InputError(f"sensors: got {[one.name for one in given]}, want at least one, each at most once")
        self._robot, self._scene = robot, scene
        self.drag = robot.drag
        found = [file_sensor(scene.model, one.name, "sensors") for one in given]
        self.sensors = tuple(
            replace(
                one, noise=said.noise if one.noise is None else one.noise,
                rate=1 / said.interval if one.rate is None and said.interval else one.rate,
                delay=said.delay if one.delay is None else one.delay,
            )
            for one, said in zip(given, found, strict=True)
        )  # fmt: skip
        sizes = [said.columns.stop - said.columns.start for said in found]
        ends = np.cumsum([0, *sizes]).tolist()
        self.columns = tuple(slice(first, end) for first, end in pairwise(ends))
        self.names = tuple(
            f"{one.name}[{i}]" if size > 1 else one.name
            for one, size in zip(given, sizes, strict=True)
            for i in range(size)
        )
        self.quaternions = tuple(said.kind in QUATERNIONS for said in found)
        self._places = np.concatenate([np.arange(said.columns.start, said.columns.stop) for said in found])
        far = [np.full(size, said.kind == "rangefinder") for size, said in zip(sizes, found, strict=True)]
        self._far = np.concatenate(far)

    def __repr__(self) -> str:
        return f"RobotSensors({', '.join(one.name for one in self.sensors)})"

    @property
    def digest(self) -> str:
        """Hash of all that readings, errors and timing depend on."""
        return sha256(self._scene.mjcf.xml, repr(self.sensors))

    def check_robot(self, dynamics: Dynamics) -> None:
        """Raise InputError unless these are sensors of the robot with these dynamics."""
        own, others = self._robot.dynamics.state_coordinates, dynamics.state_coordinates
        if own.names != others.names:
            raise InputError(f"sensors: got those of robot {self._robot.name}, want those of the problem's robot")

    def each(self, field: str) -> Array:
        """A field of the sensors, for each number of the readings, (Y,)."""
        sizes = [one.stop - one.start for one in self.columns]
        return np.repeat([float(getattr(one, field)) for one in self.sensors], sizes)

    def due(self, knot: int, dt: float) -> npt.NDArray[np.bool_]:
        """Whether each sensor is read at a knot, for a control period of dt seconds."""
        rates = np.array([np.inf if one.rate is None else one.rate for one in self.sensors])
        each = np.minimum(rates, 1 / dt) * dt  # multiples of the interval in a period
        return np.floor(knot * each + _ROUNDING) > np.floor((knot - 1) * each + _ROUNDING)

    def late(self, dt: float) -> list[int]:
        """The number of control periods of dt seconds after which the reading of each sensor arrives."""
        return [int(np.ceil((one.delay or 0.0) / dt - _ROUNDING)) for one in self.sensors]

    def readings(self, sensordata: Array) -> Array:
        """The readings (K, Y) in MuJoCo's `sensordata` (K, any); NaN where a rangefinder meets nothing."""
        found = sensordata[:, self._places]
        found[(found == NO_HIT) & self._far] = np.nan
        return found

    def reader(self) -> Reader:
        """A function that computes exact readings by MuJoCo, for one thread; see `Reader`."""
        robot, model = self._robot, self._scene.model
        in_qpos, in_qvel, in_ctrl = indices_in(robot, model)
        reader = SensorReader(model, int(model.body(robot.body).id))

        def read(states: Array, controls: Array, wrench: Array) -> Array:
            count, first = len(states), states.shape[1] - robot.activations
            qpos, qvel = np.tile(model.qpos0, (count, 1)), np.zeros((count, model.nv))
            ctrl, act = np.zeros((count, model.nu)), np.zeros((count, model.na))
            qpos[:, in_qpos], qvel[:, in_qvel] = robot.configuration(states)
            ctrl[:, in_ctrl] = robot.actuation(controls)
            if robot.activations:
                act[:] = states[:, first:]
            return self.readings(reader.read(qpos, qvel, act, ctrl, wrench))

        return read

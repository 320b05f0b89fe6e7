"""A filter and the law that follows its estimates, as recursions that run on a robot. NumPy only.

`OffsetFree` predicts with the dynamics themselves, compiled; here they are linear about the plan, so that nothing but
products of small matrices is left. `tests/test_policy_files.py` holds one against the other.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_kind, check_number, excerpt, shaped, vectors_of
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256

# Shapes in letters: T steps, n states, m controls, Y measured numbers, Z numbers in the state of the filter.
SHAPES = {
    "gain": "T m Z", "offset": "T m", "correction": "T Z Y", "sensor": "T Y n", "sensor_offset": "T Y",
    "transition": "T Z Z", "input": "T Z m", "drift": "T Z", "nominal": "T Z",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class OutputFeedbackPolicy:
    """Output feedback about a plan: what is measured goes in, controls come out, and what it knows is one vector z.

    In each control period t, with x the first n numbers of z and y what is measured,

        z = z + correction_t (y - sensor_t x - sensor_offset_t)
        u = clip(gain_t z + offset_t)
        z = transition_t z + input_t u + drift_t

    Angles of x are taken nearest to the nominal before, those of y nearest to what is expected. z begins as nominal_0.

    Attributes:
      gain: (T, m, Z); u = clip(gain z + offset).
      offset: (T, m).
      correction: the filter's gain, (T, Z, Y).
      sensor: (T, Y, n), of the state: the measurement is sensor x + sensor_offset.
      sensor_offset: (T, Y).
      transition: (T, Z, Z), to the next control period: z = transition z + input u + drift.
      input: (T, Z, m).
      drift: (T, Z).
      nominal: (T, Z), what z is in an undisturbed run: the state, what the actuators have reached if they lag, the
        states of what disturbs the robot; and, where commands or measurements are late, the commands under way.
      dt: seconds of a control period.
      state_coordinates: names and units of the states, and which of them wrap.
      control_coordinates: names and units of the controls, and the limits that the actuators keep.
      measured_coordinates: names and units of the measured numbers, and which of them wrap.

    Raises:
      InputError: arrays that do not fit together, or numbers that are not finite.
    """

    gain: Array
    offset: Array
    correction: Array
    sensor: Array
    sensor_offset: Array
    transition: Array
    input: Array
    drift: Array
    nominal: Array
    dt: float
    state_coordinates: Coordinates
    control_coordinates: Coordinates
    measured_coordinates: Coordinates

    def __post_init__(self) -> None:
        who = "OutputFeedbackPolicy"
        for name in ("state_coordinates", "control_coordinates", "measured_coordinates"):
            check_kind(f"{who}: {name}", getattr(self, name), Coordinates, "Coordinates")
        nominal = shaped(f"{who}: nominal", self.nominal, (None, None))
        n, m = len(self.state_coordinates), len(self.control_coordinates)
        sizes = {"T": len(nominal), "n": n, "m": m, "Y": len(self.measured_coordinates), "Z": nominal.shape[1]}
        if sizes["T"] < 1 or sizes["Z"] < n:
            raise InputError(f"{who}: nominal: got shape {nominal.shape}, want at least one row, of {n} states or more")
        for name, letters in SHAPES.items():
            array = shaped(f"{who}: {name}", getattr(self, name), tuple(sizes[letter] for letter in letters.split()))
            if not np.isfinite(array).all():
                raise InputError(f"{who}: {name}: got numbers that are not finite, want finite numbers")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "dt", check_number(f"{who}: dt", self.dt, above=0.0))

    @property
    def steps(self) -> int:
        """T, the number of control periods."""
        return len(self.gain)

    @property
    def digest(self) -> str:
        """Hash of the recursions and their times, 16 hexadecimal digits."""
        return sha256(*(getattr(self, name) for name in SHAPES), np.float64(self.dt))[:16]

    def start(self) -> Array:
        """The state of the filter before the first measurement, (Z,)."""
        return self.nominal[0].copy()

    def step(self, z: npt.ArrayLike, measurement: npt.ArrayLike | None, t: float) -> tuple[Array, Array]:
        """The control (..., m) of a control period, and z (..., Z) for the next; call it once in each.

        After the horizon the last recursions stay in force.

        Args:
          z: (..., Z), from `start` or the call before; it is not changed.
          measurement: (..., Y), angles in any representative; None where it got lost: then it is predicted.
          t: seconds since the start.

        Returns:
          Controls (..., m), and z (..., Z) for the next period.

        Raises:
          InputError: `t` is negative or not finite, or the others are not finite or of another length.
        """
        z, t = vectors_of("z", z, self.nominal.shape[1]), check_number("t", t, at_least=0.0)
        k, n = int(min(t / self.dt + 1e-9, self.steps - 1)), len(self.state_coordinates)
        if not np.isfinite(z).all():
            raise InputError(f"z: got {excerpt(z)}, want finite numbers")
        z = np.concatenate([self.state_coordinates.nearest(z[..., :n], self.nominal[k, :n]), z[..., n:]], axis=-1)
        if measurement is not None:
            y = vectors_of("measurement", measurement, len(self.measured_coordinates))
            if not np.isfinite(y).all():
                raise InputError(f"measurement: got {excerpt(y)}, want finite numbers, or None where it got lost")
            expected = z[..., :n] @ self.sensor[k].T + self.sensor_offset[k]
            z = z + self.measured_coordinates.difference(y, expected) @ self.correction[k].T
        control = self.control_coordinates.clip(z @ self.gain[k].T + self.offset[k])
        return control, z @ self.transition[k].T + control @ self.input[k].T + self.drift[k]

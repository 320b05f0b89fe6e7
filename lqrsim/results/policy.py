"""Feedback laws in the form that a robot runs, with and without a filter. NumPy only.

`kernels/feedback.py` implements `AffinePolicy` in compiled code, for simulations of many trials. There a trial
gets the same bits whatever other trials run with it, which NumPy's matrix products do not guarantee.
`tests/test_policy.py` compares the two.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, NonNegative, Positive, checked, repr_of
from lqrsim.errors import Array, InputError, check_count, excerpt, vectors_of
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import Horizon, left_after


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class AffinePolicy:
    """The feedback law `u_t = gain_t x + offset_t`, with everything that a robot needs to run it.

    Calling it needs NumPy alone. Paper: Eq. (13); Eq. (19) for the inverse policy, which takes the state of *arrival*.

    Attributes:
      gain: (T, m, n); L.
      offset: (T, m); bold l.
      nominal: (T, n), the state about which each law was computed. Angles of a measured state are taken nearest to it.
      dt: seconds between two laws.
    """

    gain: Annotated[Array, "T m n"]
    offset: Annotated[Array, "T m"]
    nominal: Annotated[Array, "T n"]
    dt: Positive
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not self.steps:
            raise InputError("AffinePolicy: got no law, want one for each step, at least one")

    @property
    def steps(self) -> int:
        """T, the number of laws."""
        return len(self.gain)

    @property
    def digest(self) -> str:
        """Hash of everything that the controls depend on, 16 hexadecimal digits; `policy_digest` of its rollouts."""
        rules = self.state_coordinates.rules, self.control_coordinates.rules
        return sha256(self.gain, self.offset, self.nominal, np.float64(self.dt), *rules)[:16]

    @checked
    def shifted(self, steps: int, *, horizon: Horizon = "moving") -> "AffinePolicy":
        """The rest of the policy after `steps` steps; see `Solution.shifted`."""
        steps = check_count("steps", steps, at_least=0, at_most=self.steps - 1)
        filled = horizon == "moving"
        parts = {name: left_after(steps, getattr(self, name), filled=filled) for name in ("gain", "offset", "nominal")}
        return replace(self, **parts)

    def control(self, state: npt.ArrayLike, step: int) -> Array:
        """Controls (..., m) of one step before saturation, at states (..., n), angles nearest to the nominal ones."""
        step = check_count("step", step, at_least=0, at_most=self.steps - 1)
        return vectors_of("state", state, self.gain.shape[-1]) @ self.gain[step].T + self.offset[step]

    @checked
    def __call__(self, state: npt.ArrayLike, t: NonNegative, *, interpolate: bool = False) -> Array:
        """The control (..., m), within its limits, for a measured state (..., n), `t` seconds after the start.

        Angles and rotation vectors may be in any representative. The result is clipped to the control limits. Between
        two knots the earlier law holds, as in the plan; `interpolate=True` blends the two, for controllers that run
        faster than the plan. After the horizon the last law holds.
        """
        state = vectors_of("state", state, self.gain.shape[-1])
        if not np.isfinite(state).all():
            raise InputError(f"state: got {excerpt(state)}, want finite numbers")
        # Rounding must not put a time at a knot before it.
        knot = t / self.dt + 1e-9
        step = int(min(knot, self.steps - 1))
        gain, offset, nominal = self.gain[step], self.offset[step], self.nominal[step]
        if interpolate and step + 1 < self.steps:
            weight = max(knot - 1e-9 - step, 0.0)
            gain = (1 - weight) * gain + weight * self.gain[step + 1]
            offset = (1 - weight) * offset + weight * self.offset[step + 1]
            nominal = (1 - weight) * nominal + weight * self.nominal[step + 1]
        control = self.state_coordinates.nearest(state, nominal) @ gain.T + offset
        return self.control_coordinates.clip(control)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class OutputFeedbackPolicy:
    """Output feedback about a plan, from measurements to controls. Its entire state is one vector z.

    `OffsetFree` predicts with the compiled nonlinear dynamics. Here the dynamics are linear about the plan, so that
    products of small matrices suffice. `tests/test_policy_files.py` compares the two.

    In each control period t, with x the first n numbers of z and y the measurement,

        z = z + correction_t (y - sensor_t x - sensor_offset_t)
        u = clip(gain_t z + offset_t)
        z = transition_t z + input_t u + drift_t

    Before that, angles of x are replaced by the representatives nearest to the nominal angles, and angles of y by those
    nearest to the expected angles. z begins as nominal_0.

    Attributes:
      gain: (T, m, Z); u = clip(gain z + offset).
      correction: the filter's gain, (T, Z, Y).
      sensor: (T, Y, n); the measurement of a state x is sensor x + sensor_offset.
      transition: (T, Z, Z), to the next control period: z = transition z + input u + drift.
      nominal: (T, Z), z in an undisturbed run: the state, the actuator outputs if they lag, the states of the
        disturbances, and the pending commands if commands or measurements are late.
      measured_coordinates: names and units of the measured numbers, and which of them wrap.
    """

    gain: Annotated[Array, "T m Z", Bounds()]
    offset: Annotated[Array, "T m", Bounds()]
    correction: Annotated[Array, "T Z Y", Bounds()]
    sensor: Annotated[Array, "T Y n", Bounds()]
    sensor_offset: Annotated[Array, "T Y", Bounds()]
    transition: Annotated[Array, "T Z Z", Bounds()]
    input: Annotated[Array, "T Z m", Bounds()]
    drift: Annotated[Array, "T Z", Bounds()]
    nominal: Annotated[Array, "T Z", Bounds()]
    dt: Positive
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]
    measured_coordinates: Annotated[Coordinates, "Y"]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        states = len(self.state_coordinates)
        if not self.steps or self.nominal.shape[1] < states:
            want = f"at least one row, of {states} states or more"
            raise InputError(f"OutputFeedbackPolicy: nominal: got shape {self.nominal.shape}, want {want}")

    @property
    def steps(self) -> int:
        """T, the number of control periods."""
        return len(self.gain)

    @property
    def digest(self) -> str:
        """Hash of everything that the controls depend on, 16 hexadecimal digits."""
        recursions = (value for value in vars(self).values() if isinstance(value, np.ndarray))
        spaces = self.state_coordinates, self.control_coordinates, self.measured_coordinates
        # The names say which states are measured.
        rules = (f"{space.names} {space.rules}" for space in spaces)
        return sha256(*recursions, np.float64(self.dt), *rules)[:16]

    def start(self) -> Array:
        """The state of the filter before the first measurement, (Z,)."""
        return self.nominal[0].copy()

    @checked
    def step(self, z: npt.ArrayLike, measurement: npt.ArrayLike | None, t: NonNegative) -> tuple[Array, Array]:
        """The controls (..., m) of this control period, and z (..., Z) for the next. Call it once in each period.

        After the horizon the last recursion holds.

        Args:
          z: (..., Z), from `start` or the previous call; it is not changed.
          measurement: (..., Y), angles in any representative; None if it was lost: z is then only predicted.
        """
        z = vectors_of("z", z, self.nominal.shape[1])
        k, n = int(min(t / self.dt + 1e-9, self.steps - 1)), len(self.state_coordinates)
        if not np.isfinite(z).all():
            raise InputError(f"z: got {excerpt(z)}, want finite numbers")
        z = np.concatenate([self.state_coordinates.nearest(z[..., :n], self.nominal[k, :n]), z[..., n:]], axis=-1)
        if measurement is not None:
            y = vectors_of("measurement", measurement, len(self.measured_coordinates))
            if not np.isfinite(y).all():
                raise InputError(f"measurement: got {excerpt(y)}, want finite numbers, or None if it was lost")
            expected = z[..., :n] @ self.sensor[k].T + self.sensor_offset[k]
            z = z + self.measured_coordinates.difference(y, expected) @ self.correction[k].T
        control = self.control_coordinates.clip(z @ self.gain[k].T + self.offset[k])
        return control, z @ self.transition[k].T + control @ self.input[k].T + self.drift[k]

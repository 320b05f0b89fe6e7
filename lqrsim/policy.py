"""The feedback law, and how it is run on a robot. NumPy only."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError


@dataclass(frozen=True, kw_only=True)
class AffinePolicy:
    """The feedback law `u_t = gain_t x + offset_t`, with what is needed to run it on a robot.

    Calling it needs NumPy alone. Paper: Eq. (13); for the inverse policy, which takes the state of *arrival*, Eq. (19).

    Attributes:
      gain: (T, m, n); L.
      offset: (T, m); bold l.
      nominal: (T, n), the state that each law was made about. Angles of a measured state are taken nearest to it.
      dt: seconds between two laws.
      state_coordinates, control_coordinates: names and units; which states wrap; the limits that the actuators keep.
    """

    gain: Array
    offset: Array
    nominal: Array
    dt: float
    state_coordinates: Coordinates
    control_coordinates: Coordinates

    @property
    def steps(self) -> int:
        """T, the number of laws."""
        return len(self.gain)

    def control(self, state: npt.ArrayLike, step: int) -> Array:
        """The law of one step before saturation, (..., m), at states (..., n) given in the nominal's representative."""
        return np.asarray(state, dtype=np.float64) @ self.gain[step].T + self.offset[step]

    def __call__(self, state: npt.ArrayLike, t: float, *, interpolate: bool = False) -> Array:
        """The control (..., m) to apply in a measured state (..., n), `t` seconds after the start.

        Angles and rotation vectors may be given in any representative. The result is held within the control
        limits. Between two knots the earlier law is held, as it is in the plan; `interpolate=True` blends the two
        instead, for controllers that run faster than the plan. After the horizon the last law stays in force.

        Raises:
          InputError: `t` is negative or not finite, or the state is not finite or not of length n.
        """
        state = np.asarray(state, dtype=np.float64)
        if state.shape[-1:] != self.gain.shape[-1:]:
            raise InputError(f"state: got shape {state.shape}, want ({self.gain.shape[-1]},) in its last dimension")
        if not np.isfinite(state).all():
            raise InputError(f"state: got {state}, want finite numbers")
        if not (np.isfinite(t) and t >= 0):
            raise InputError(f"t: got {t}, want seconds since the start, >= 0")
        # A time that is a knot up to rounding belongs to the law that begins there.
        knot = t / self.dt + 1e-9
        step = min(int(knot), self.steps - 1)
        gain, offset, nominal = self.gain[step], self.offset[step], self.nominal[step]
        if interpolate and step + 1 < self.steps:
            weight = max(knot - 1e-9 - step, 0.0)
            gain = (1 - weight) * gain + weight * self.gain[step + 1]
            offset = (1 - weight) * offset + weight * self.offset[step + 1]
            nominal = (1 - weight) * nominal + weight * self.nominal[step + 1]
        control = self.state_coordinates.nearest(state, nominal) @ gain.T + offset
        return self.control_coordinates.clip(control)

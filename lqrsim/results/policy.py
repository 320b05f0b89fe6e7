"""The feedback law in the form that a robot runs. NumPy only.

`kernels/policy_evaluation.py` implements the same law in compiled code, for simulations of many trials. There a trial
gets the same bits whatever other trials run with it, which NumPy's matrix products do not guarantee.
`tests/test_policy.py` compares the two.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import NonNegative, Positive, checked, repr_of
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
        """Controls (..., m) of one step before saturation, at states (..., n) in the nominal's representative."""
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

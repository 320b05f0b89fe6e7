"""Code shared by the quadrotor simulators: their vehicle as a `Quadrotor`, and conversions between the states of both.

Both simulators place the rotors between the axes of the body, in an X configuration. `Quadrotor` places them on its
axes, in a plus configuration. Its body axes are therefore turned about the vertical relative to theirs. Rotors are
numbered from its x axis, counterclockwise seen from above.
"""

import contextlib
import importlib
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lqrsim.errors import Array, InputError
from lqrsim.machine import outdated

TWIST = 1e-6  # m, the largest distance of rotors from the corners of a square


@dataclass(frozen=True, eq=False)
class Frame:
    """The body axes of `Quadrotor` relative to the simulator's body axes."""

    turn: float  # angle from their x axis to ours, in rad
    order: npt.NDArray[np.intp]  # (4,) their number of each of our rotors
    arm: float  # length in m

    @classmethod
    def of(cls, name: str, places: Array, turning: Array) -> "Frame":
        """Make it from the rotors' positions (4, 2 or 3) in m, and the signs (4,) of their drag torques on the body."""
        angles = np.arctan2(places[:, 1], places[:, 0])
        first = int(np.argmax(turning > 0))
        order = np.argsort(np.mod(angles - angles[first] + 1e-9, 2 * np.pi))  # counterclockwise
        arm = float(np.linalg.norm(places[first, :2]))
        corners = angles[first] + np.pi / 2 * np.arange(4)
        square = arm * np.stack([np.cos(corners), np.sin(corners)], axis=1)
        if np.abs(places[order, :2] - square).max() > TWIST or not np.array_equal(turning[order], [1, -1, 1, -1]):
            raise InputError(f"{name}: got rotors at {places.tolist()}, want a square with alternating spin")
        return cls(float(angles[first]), order, arm)

    def theirs(self, states: Array) -> tuple[Array, Array, Array, Array]:
        """Position, velocity, quaternion with the scalar last, and angular velocity, for states (K, 12)."""
        turned = Rotation.from_rotvec(states[:, 6:9]) * Rotation.from_euler("z", -self.turn)
        return states[:, :3], states[:, 3:6], turned.as_quat(), about_z(states[:, 9:], self.turn)

    def ours(self, position: Array, velocity: Array, attitude: Array, rates: Array) -> Array:
        """The states (K, 12); NaN in rows that are not finite."""
        parts = np.concatenate([position, velocity, attitude, rates], axis=1)
        known, states = np.isfinite(parts).all(axis=1), np.full((len(parts), 12), np.nan)
        if known.any():
            turned = Rotation.from_quat(attitude[known]) * Rotation.from_euler("z", self.turn)
            parts = position[known], velocity[known], turned.as_rotvec(), about_z(rates[known], -self.turn)
            states[known] = np.concatenate(parts, axis=1)
        return states


def about_z(vectors: Array, angle: float) -> Array:
    """Vectors (K, 3), turned about the z axis. SciPy's product has bits that depend on K."""
    (x, y, z), cosine, sine = vectors.T, np.cos(angle), np.sin(angle)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def package(module: str, extra: str) -> Any:
    """A module of a package that an extra installs. Raises InputError if it is not there, or a part is too old."""
    name = module.partition(".")[0]
    if line := outdated(extra):
        raise InputError(f"{extra}: {line}")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints which optional packages it lacks
            return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{name}: got no such package, want it installed: pip install 'lqrsim[{extra}]'") from None
    except RuntimeError as error:
        if "SCIPY_ARRAY_API" not in str(error):
            raise
        wanted = "SCIPY_ARRAY_API=1 in the environment from the start"
        raise InputError(f"{name}: got SciPy imported without SCIPY_ARRAY_API, want {wanted}") from None

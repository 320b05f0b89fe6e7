"""Calibrated cameras: fixed, so that pixels measure positions.

They are orthographic, as an engineering drawing is: a metre has the same number of pixels everywhere. The centre of a
ball's pixels is therefore exactly its own centre, at any distance and anywhere in the picture, and the place of a
camera along its line of sight does not matter.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_array, check_number, excerpt
from lqrsim.results.rollout import Rollout

if TYPE_CHECKING:
    import mujoco

Vector = tuple[float, float, float]

NEAR, FAR = 0.01, 1000.0  # m; the depth buffer is linear in an orthographic view, so that a wide range is no loss


@dataclass(frozen=True)
class Camera:
    """An orthographic view of the world. Pixels are (column, row) from the upper left corner, centres at halves.

    Attributes:
      position: in metres; the line from here along `forward` meets the middle of the picture.
      forward, up: orthogonal unit vectors.
      height: height of the picture, in metres of the world.
    """

    name: str
    position: Vector
    forward: Vector
    up: Vector
    height: float

    @property
    def axes(self) -> Array:
        """(2, 3), unit vectors to the right and up in the picture: the directions that it measures."""
        return np.array([np.cross(self.forward, self.up), self.up])

    def place(self, scene: "mujoco.MjvScene", aspect: float) -> None:
        """Set the cameras of a scene, after its update, to this view in a picture of aspect ratio width / height."""
        for camera in scene.camera:
            camera.pos, camera.forward, camera.up = self.position, self.forward, self.up
            camera.orthographic = 1
            camera.frustum_near, camera.frustum_far, camera.frustum_center = NEAR, FAR, 0
            camera.frustum_bottom, camera.frustum_top = -0.5 * self.height, 0.5 * self.height
            camera.frustum_width = 0.5 * self.height * aspect

    def project(self, points: npt.ArrayLike, size: tuple[int, int]) -> Array:
        """Pixels (..., 2) of points (..., 3) in a picture of `size` width and height."""
        seen = (np.asarray(points, dtype=np.float64) - self.position) @ self.axes.T
        return 0.5 * np.array(size) + seen * (size[1] / self.height) * [1, -1]

    def measure(self, pixels: npt.ArrayLike, size: tuple[int, int]) -> Array:
        """Coordinates (..., 2) along `axes`, in metres from the world's origin, of pixels (..., 2)."""
        off = (np.asarray(pixels, dtype=np.float64) - 0.5 * np.array(size)) * [1, -1]
        return self.axes @ self.position + off * (self.height / size[1])

    def as_json(self) -> dict[str, Any]:
        """The camera as JSON, for `from_json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, parts: Mapping[str, Any]) -> "Camera":
        """The camera of `as_json`. Raises InputError for anything else."""
        try:
            name, height = str(parts["name"]), parts["height"]
            vectors = {key: check_array(f"camera.{key}", parts[key], (3,)) for key in ("position", "forward", "up")}
        except (KeyError, TypeError) as error:
            raise InputError(f"camera: got {excerpt(parts)}, want the parts of a camera ({error})") from None
        directions = np.array([vectors["forward"], vectors["up"]])
        if not np.allclose(directions @ directions.T, np.eye(2), rtol=0, atol=1e-6):
            raise InputError(f"camera: got forward and up {directions.tolist()}, want orthogonal unit vectors")
        position, forward, up = (tuple(vector.tolist()) for vector in vectors.values())
        return cls(name, position, forward, up, check_number("camera.height", height, above=0))


def top(rollout: Rollout, aspect: float = 4 / 3) -> Camera:
    """A camera above that shows the plan and all trials with a margin, in a picture of this aspect ratio."""
    low, high = _bounds(rollout)
    right = _right(high - low, aspect)
    return _camera("top", low, high, right, np.cross([0.0, 0.0, 1.0], right), aspect)


def side(rollout: Rollout, aspect: float = 4 / 3) -> Camera:
    """A level camera at the side that shows the same, the longer horizontal side across."""
    low, high = _bounds(rollout)
    plane = rollout.plane
    level = plane.replace("z", "")
    # A vertical plane is seen at a right angle.
    right = np.eye(3)["xyz".index(level)] if len(level) == 1 else _right(high - low, 1.0)
    return _camera("side", low, high, right, np.array([0.0, 0.0, 1.0]), aspect)


def measuring(plane: str) -> tuple[str, ...]:
    """The cameras, of `top` and `side`, that together measure positions along these axes of the world."""
    return ("top", "side") if len(plane) == 3 else ("side",) if "z" in plane else ("top",)


def _camera(name: str, low: Array, high: Array, right: Array, up: Array, aspect: float) -> Camera:
    span, forward = high - low, np.cross(up, right)
    height = max(float(abs(up) @ span), float(abs(right) @ span) / aspect)
    # Far enough to have all of the surroundings in front.
    position = 0.5 * (low + high) - (10 + 5 * float(span.max())) * forward
    vectors = (tuple(vector.tolist()) for vector in (position, forward, up))
    return Camera(name, *vectors, height=height)


def _bounds(rollout: Rollout) -> tuple[Array, Array]:
    """The lowest and highest corner (3,) of the run with a margin; robots seen from above are at height zero.

    A robot without a position counts with all of its balls.
    """
    places = np.vstack([rollout.planned_places, *(rollout.places(trial) for trial in range(rollout.trials))])
    if rollout.balls is not None and not rollout.state_coordinates.position:
        places = np.vstack([rollout.balls.planned.reshape(-1, 3), rollout.balls.driven.reshape(-1, 3)])
    low, high = (rollout.in_world(extreme(places, axis=0)) for extreme in (np.nanmin, np.nanmax))
    margin = rollout.radius + 0.05 * float((high - low).max())
    return low - margin, high + margin


def _right(span: Array, aspect: float) -> Array:
    """The direction to the right in the picture: x or y, so that the longer sides coincide."""
    return np.array([1.0, 0.0, 0.0] if (span[0] >= span[1]) == (aspect >= 1) else [0.0, 1.0, 0.0])

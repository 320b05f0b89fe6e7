"""Geoms that are drawn beside the model's own, in pictures and in viewers; and the mark that pixels are measured by."""

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.results.rollout import Rollout
from lqrsim.view.cameras import Camera

# The mark by which a robot's position is read from a video: a green ball at the origin of its body, in front of a black
# one. Nothing else is pure green. All of its light is its own, so that it looks the same in the sun and in the shade.
MARK_RGB = (0.0, 1.0, 0.0)
RIM = (
    # Radius of the black ball, in radii of the green one: a video then blurs the same colour into the mark all around.
    1.8
)
PLAN_RGB = (0.78, 0.08, 0.42)  # of the plan; neither the error map nor a robot has it


def decorate(
    geom: mujoco.MjvGeom,
    kind: mujoco.mjtGeom,
    size: npt.ArrayLike,
    position: npt.ArrayLike,
    rgba: npt.ArrayLike,
    rotation: Array | None = None,
) -> mujoco.MjvGeom:
    """Give a geom this kind, size (3,), place (3,) and colour (4,), without a shadow; returns the geom."""
    mujoco.mjv_initGeom(
        geom,
        kind,
        np.asarray(size, dtype=np.float64),
        np.asarray(position, dtype=np.float64),
        (np.eye(3) if rotation is None else rotation).ravel(),
        np.asarray(rgba, dtype=np.float32),
    )
    geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
    return geom


def mark_radius(rollout: Rollout) -> float:
    """Radius of the mark of a robot, in metres."""
    return 0.25 * rollout.radius


def draw_mark(scene: mujoco.MjvScene, camera: Camera, centre: Array, radius: float) -> None:
    """Add the mark of a robot whose body is at `centre` (3,) to a scene that is seen through the camera.

    It is drawn close to the camera, where nothing hides it. In an orthographic picture its place is the same.
    """
    forward = np.array(camera.forward)
    centre = centre - (forward @ (centre - camera.position)) * forward
    for distance, size, colour in ((1, radius, MARK_RGB), (2, RIM * radius, (0.0, 0.0, 0.0))):
        place = centre + (distance + size) * forward
        ball = decorate(scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE, [size] * 3, place, (*colour, 1.0))
        ball.specular, ball.emission = 0, 1
        scene.ngeom += 1

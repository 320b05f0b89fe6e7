"""The mark on a robot by which its position is read from a video: a green ball at the origin of its body."""

import mujoco
import numpy as np

from lqrsim.errors import Array
from lqrsim.results.rollout import Rollout
from lqrsim.view.cameras import Camera
from lqrsim.view.decorative_geoms import decorate

# Pure green: the error map, the plan, forces, robots and scenes do not use it. All of its light is its own and its
# channels are at their ends, so that it looks the same in the sun and in the shade.
COLOUR = (0.0, 1.0, 0.0)
RIM = 1.8  # radius of the black ball behind it, in radii: what a video blurs into the mark is the same all around


def radius(rollout: Rollout) -> float:
    """Of the mark that a robot wears, in metres."""
    return 0.25 * rollout.radius


def draw(scene: mujoco.MjvScene, camera: Camera, centre: Array, radius: float) -> None:
    """Adds the mark of a robot whose body is at `centre` (3,) to a scene that is seen through the camera.

    It is drawn close to the camera, where nothing hides it. In an orthographic picture it is in the same place there.
    """
    forward = np.array(camera.forward)
    centre = centre - (forward @ (centre - camera.position)) * forward
    for distance, size, colour in ((1, radius, COLOUR), (2, RIM * radius, (0.0, 0.0, 0.0))):
        place = centre + (distance + size) * forward
        ball = decorate(scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE, [size] * 3, place, (*colour, 1.0))
        ball.specular, ball.emission = 0, 1
        scene.ngeom += 1

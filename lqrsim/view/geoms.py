"""Drawables as MuJoCo's geoms, in addition to the model's; and the mark by which a robot is found in a video."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtGeom as Geom

from lqrsim.errors import Array
from lqrsim.view.cameras import Camera
from lqrsim.view.overlays import Arrow, Dots, Drawable, DrawnTube, Line, MovingBody
from lqrsim.view.recorded_trial import RecordedTrial

NewGeom = Callable[[], mujoco.MjvGeom]

# The mark by which a robot's position is read from a video: a green ball at the origin of its body, in front of a black
# ball. Nothing else is pure green. The mark emits all of its light, so it looks the same in the sun and in the shade.
MARK_RGB = (0.0, 1.0, 0.0)
RIM = 1.8  # radius of the black ball, in radii of the green one: a video then blurs one colour into the whole edge
GLOW = 0.3  # emission of what hangs in space; what lies on a floor is lit as the floor is
UPRIGHT = np.eye(3)
END_ON = 0.9  # cosine of the angle to the line of sight above which an arrow is not drawn


def appending_to(scene: mujoco.MjvScene) -> NewGeom:
    """A function that appends a geom to a scene and returns it."""

    def new() -> mujoco.MjvGeom:
        scene.ngeom += 1
        return scene.geoms[scene.ngeom - 1]

    return new


def draw(drawable: Drawable, time: float, new: NewGeom, *, emission: float) -> None:
    """Draw anything but an arrow at a time, with geoms that `new` returns."""
    match drawable:
        case Line():
            _draw_line(drawable, time, new, emission)
        case Dots():
            for point in drawable.at(time):
                set_geom(new(), Geom.mjGEOM_BOX, drawable.half_sizes, point, drawable.rgba, emission=emission)
        case DrawnTube():
            for centre, sizes, rotation in zip(drawable.centres, drawable.half_axes, drawable.rotations, strict=True):
                set_geom(new(), Geom.mjGEOM_ELLIPSOID, sizes, centre, drawable.rgba, rotation, emission=emission)
        case MovingBody():
            kind, size = getattr(Geom, f"mjGEOM_{drawable.kind.upper()}"), drawable.size
            size = np.full(3, size[0]) if drawable.kind == "sphere" else size
            set_geom(new(), kind, size, drawable.at(time), drawable.rgba, drawable.rotation, emission=emission)


def _draw_line(line: Line, time: float, new: NewGeom, emission: float) -> None:
    """A box for each segment; boxes are cheaper than capsules."""
    points, colours = line.until(time)
    along = np.diff(points, axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    z = along / np.where(length > 0, length, 1)
    side = np.cross(np.where(np.abs(z[:, 2:]) < 0.99, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), z)
    x = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    rotations, centres = np.stack([x, np.cross(z, x), z], axis=-1), points[:-1] + 0.5 * along
    for i in np.flatnonzero(length > 1e-6):
        size = [*line.profile, 0.5 * length[i, 0]]
        set_geom(new(), Geom.mjGEOM_BOX, size, centres[i], colours[i], rotations[i], emission=emission)


def draw_arrow(arrow: Arrow, force: Array, place: Array, scene: mujoco.MjvScene, *, emission: float) -> None:
    """Append the arrow of a force (3,) on a robot at `place` (3,), for the camera that is set in the scene.

    An arrow along the line of sight is left out: it would show nothing and hide the robot.
    """
    forward, strength = np.array(scene.camera[0].forward, dtype=np.float64), float(np.linalg.norm(force))
    length = arrow.metres_per_newton * strength
    if length < 2 * arrow.width or abs(force @ forward) > END_ON * strength:
        return
    start = place + arrow.gap * force / strength
    geom = set_geom(appending_to(scene)(), Geom.mjGEOM_ARROW, [1, 1, 1], start, arrow.rgba, emission=emission)
    mujoco.mjv_connector(geom, Geom.mjGEOM_ARROW, arrow.width, start, start + length * force / strength)


def mark_radius(recorded: RecordedTrial) -> float:
    """Radius of the mark of a robot, in metres."""
    return 0.25 * recorded.size


def draw_mark(scene: mujoco.MjvScene, camera: Camera, centre: Array, radius: float) -> None:
    """Add the mark of a robot whose body is at `centre` (3,) to a scene that is seen through the camera.

    It is drawn close to the camera, where nothing hides it: in an orthographic picture its place is the same.
    """
    forward, new = np.array(camera.forward), appending_to(scene)
    centre = centre - (forward @ (centre - camera.position)) * forward
    for distance, size, colour in ((1, radius, MARK_RGB), (2, RIM * radius, (0.0, 0.0, 0.0))):
        place = centre + (distance + size) * forward
        set_geom(new(), Geom.mjGEOM_SPHERE, [size] * 3, place, (*colour, 1.0), emission=1)


def set_geom(
    geom: mujoco.MjvGeom, kind: Geom, size: Any, place: Any, rgba: Any, rotation: Array = UPRIGHT, *, emission: float
) -> mujoco.MjvGeom:
    """Give a geom this kind, size (3,), place (3,) and colour (4,), without shadow and gloss; returns the geom."""
    mujoco.mjv_initGeom(geom, kind, size, place, rotation.ravel(), rgba)
    geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
    geom.specular, geom.emission = 0, emission
    return geom

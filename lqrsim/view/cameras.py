"""Cameras of panes: calibrated ones, in which a robot has a mark, an overview, a chase view, and the model's own.

Calibrated cameras are fixed, so that pixels measure positions. They are orthographic, like an engineering drawing: a
metre has the same number of pixels everywhere. The centre of a ball's pixels is therefore exactly the centre of the
ball, at any distance and anywhere in the picture. The position of a camera along its line of sight does not matter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, Line, Positive, checked
from lqrsim.errors import Array, InputError, check_name
from lqrsim.results.rollout import Rollout
from lqrsim.view.overlays import Shape
from lqrsim.view.recorded_trial import SHOWN_GROUPS, RecordedTrial, interpolated, tracked_balls

Vector = tuple[Finite, Finite, Finite]
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)

# Depths in m that are drawn. The depth buffer is linear in an orthographic view, so a wide range loses no precision.
CLIPPING = 0.01, 1000.0

# The mark by which a robot's position is read from a video: a green ball at the origin of its body, in front of a black
# ball. Nothing else is pure green. The mark emits all of its light, so it looks the same in the sun and in the shade.
MARK_RGB = (0.0, 1.0, 0.0)
RIM = 1.8  # radius of the black ball, in radii of the green one: a video then blurs one colour into the whole edge


@checked
@dataclass(frozen=True)
class Camera:
    """An orthographic view of the world. Pixels are (column, row) from the upper left corner, centres at halves."""

    name: Line
    position: Vector  # in metres; the line from here along `forward` meets the middle of the picture
    forward: Vector  # a unit vector, as `up`, to which it is orthogonal
    up: Vector
    height: Positive  # of the picture, in metres of the world

    def __post_init__(self) -> None:
        directions = np.array([self.forward, self.up])
        if not np.allclose(directions @ directions.T, np.eye(2), rtol=0, atol=1e-6):
            raise InputError(f"camera: got forward and up {directions.tolist()}, want orthogonal unit vectors")

    @property
    def axes(self) -> Array:
        """Unit vectors (2, 3) to the right and up in the picture: the directions that it measures."""
        return np.array([np.cross(self.forward, self.up), self.up])

    def place(self, scene: mujoco.MjvScene, aspect: float) -> None:
        """Set the cameras of a scene, after its update, to this view in a picture of aspect ratio width / height."""
        for camera in scene.camera:
            camera.pos, camera.forward, camera.up = self.position, self.forward, self.up
            camera.orthographic = 1
            camera.frustum_near, camera.frustum_far, camera.frustum_center = *CLIPPING, 0
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


def calibrated(name: str, rollout: Rollout, aspect: float = 4 / 3, *, around: Array | None = None) -> Camera:
    """The camera `top` or `side`, which shows the plan and all trials with a margin, and points (k, 3) `around` them.

    `side` is level, and has the longer horizontal side across the picture.
    """
    low, high = _bounds(rollout, around)
    span, vertical = high - low, np.array([0.0, 0.0, 1.0])
    level = rollout.plane.replace("z", "")
    if name == "top":
        right = _right(span, aspect)
        up = np.cross(vertical, right)
    else:  # a vertical plane is seen at a right angle
        right, up = np.eye(3)["xyz".index(level)] if len(level) == 1 else _right(span, 1.0), vertical
    forward = np.cross(up, right)
    height = max(float(abs(up) @ span), float(abs(right) @ span) / aspect)
    # Far enough back that all surroundings are in front of it.
    position = 0.5 * (low + high) - (10 + 5 * float(span.max())) * forward
    vectors = (tuple(vector.tolist()) for vector in (position, forward, up))
    return Camera(name, *vectors, height=height)


def measuring(plane: str) -> tuple[str, ...]:
    """Those of the cameras `top` and `side` that together measure positions along these axes of the world."""
    return ("top", "side") if len(plane) == 3 else ("side",) if "z" in plane else ("top",)


def mark_radius(recorded: RecordedTrial) -> float:
    """Radius of the mark of a robot, in metres."""
    return 0.25 * recorded.size


def draw_mark(scene: mujoco.MjvScene, camera: Camera, centre: Array, radius: float) -> None:
    """Add the mark of a robot whose body is at `centre` (3,) to a scene that is seen through the camera.

    It is drawn close to the camera, where nothing hides it: in an orthographic picture its place is the same.
    """
    forward, sphere = np.array(camera.forward), mujoco.mjtGeom.mjGEOM_SPHERE
    centre = centre - (forward @ (centre - camera.position)) * forward
    for distance, size, colour in ((1, radius, MARK_RGB), (2, RIM * radius, (0.0, 0.0, 0.0))):
        place = centre + (distance + size) * forward
        Shape(sphere, [size] * 3, place, (*colour, 1.0)).append(scene, emission=1)


def _bounds(rollout: Rollout, around: Array | None = None) -> tuple[Array, Array]:
    """The lowest and highest corner (3,) of the run with a margin; robots seen from above are at height zero.

    A robot of several balls counts with all of them. The points `around` (k, 3) need no margin.
    """
    places = np.vstack([rollout.planned_places, *(rollout.places(trial) for trial in range(rollout.trials))])
    if (balls := tracked_balls(rollout)) is not None:
        places = np.vstack([balls.planned.reshape(-1, 3), balls.driven.reshape(-1, 3)])
    low, high = (rollout.in_world(extreme(places, axis=0)) for extreme in (np.nanmin, np.nanmax))
    padding = 0.05 * float((high - low).max())
    margin = rollout.radius + padding
    corners = np.vstack([low - margin, high + margin, *([] if around is None else [around])])
    if rollout.balls is not None:  # they may reach farther than the radius
        centres = np.vstack([rollout.balls.planned[None], rollout.balls.driven])
        radii = padding + rollout.balls.radii[:, None]
        corners = np.vstack([corners, (centres - radii).reshape(-1, 3), (centres + radii).reshape(-1, 3)])
    return np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)


def _right(span: Array, aspect: float) -> Array:
    """The direction to the right in the picture: x or y, so that the longer sides coincide."""
    return np.array([1.0, 0.0, 0.0] if (span[0] >= span[1]) == (aspect >= 1) else [0.0, 1.0, 0.0])


# The overview cameras of models are made for 16:9; in a narrower picture they would cut off both sides.
OVERVIEW_ASPECT = 1.7
OBLIQUE = np.array([0.30, 0.75, -0.60])  # direction of an overview in a scene without an overview camera
POSES = 9  # number of poses of an arm that an overview contains
FIELD_OF_VIEW = 40.0  # degrees, field of view of cameras that are not the model's
DISTANCE, HEIGHT = 11.0, 4.5  # distance and height of the chase camera, in radii of the robot
TURN_SECONDS = 0.8  # s, time over which the chase camera averages its direction


class CameraView(NamedTuple):
    """A view of one trial: sets the cameras of a scene, after its update, for a time; and its calibrated camera."""

    place: Callable[[mujoco.MjvScene, mujoco.MjData, float], None]
    camera: Camera | None = None


def camera_view(
    name: str, recorded: RecordedTrial, aspect: float, *, beside: Sequence[RecordedTrial] = ()
) -> CameraView:
    """The view of that name in a pane of this aspect ratio: one of VIEWS, or another camera of the model.

    Trials of the same model `beside` it in a picture are seen from the same place, at the same zoom.
    """
    model = recorded.model
    of_model = [model.camera(number).name for number in range(model.ncam) if model.camera(number).name]
    check_name("camera", name, [*VIEWS, *(other for other in of_model if other not in VIEWS)])
    same_model = [trial for trial in beside if trial.rollout.model == recorded.rollout.model] or [recorded]
    if name in CALIBRATED:
        runs = {id(trial.rollout): trial for trial in same_model}.values()
        # The bounds of a run have the robot's radius, if it has one.
        sizes = [0.0 if trial.rollout.radius else trial.size for trial in runs]
        bounds = zip((_bounds(trial.rollout) for trial in runs), sizes, strict=True)
        corners = np.vstack([corner for (low, high), size in bounds for corner in (low - size, high + size)])
        camera = calibrated(name, recorded.rollout, aspect, around=corners)
        return CameraView(lambda scene, data, time: camera.place(scene, aspect), camera)
    if name == "chase":
        return _chase(recorded)
    if name == "overview" and (aspect < OVERVIEW_ASPECT or name not in of_model):
        return _overview(recorded, model.camera(name).id if name in of_model else None, aspect, same_model)
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED.value, model.camera(name).id
    return CameraView(lambda scene, data, time: mujoco.mjv_updateCamera(model, data, view, scene))


def _overview(recorded: RecordedTrial, like: int | None, aspect: float, trials: Sequence[RecordedTrial]) -> CameraView:
    """A view that contains these runs and their surroundings, in the direction of a camera of the model."""
    model, data = recorded.model, mujoco.MjData(recorded.model)
    recorded.pose(data, 0.0)
    forward, field_of_view = OBLIQUE / np.linalg.norm(OBLIQUE), FIELD_OF_VIEW
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if like is not None and model.cam_projection[like] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE.value:
        axes, field_of_view = data.cam_xmat[like].reshape(3, 3), float(model.cam_fovy[like])
        right, forward = axes[:, 0], -axes[:, 2]
    right = right / np.linalg.norm(right)
    up, points = np.cross(right, forward), np.vstack([_extent_points(trial) for trial in trials])
    # Far enough back to have every point within both angles of view.
    rise = np.tan(np.radians(field_of_view) / 2) * 0.96
    middle = points.mean(axis=0)
    back = 0.0
    for _ in range(20):  # each iteration centres the previous view
        local = points - middle
        x, y, z = local @ right, local @ up, local @ forward
        back = float(np.max(np.maximum(np.abs(x) / (rise * aspect), np.abs(y) / rise) - z))
        x, y = x / (z + back), y / (z + back)
        shift = 0.5 * back * np.array([x.max() + x.min(), y.max() + y.min()])
        middle = middle + shift[0] * right + shift[1] * up
    eye = middle - back * forward
    return CameraView(lambda scene, data, time: _set_perspective(scene, model, eye, forward, up, field_of_view))


def _extent_points(recorded: RecordedTrial) -> Array:
    """Points (k, 3) of the run, and corners of fixed geoms that are near it."""
    model, data = recorded.model, mujoco.MjData(recorded.model)
    run = np.vstack([recorded.driven(recorded.times), recorded.planned(recorded.rollout.times)])
    fixed, shown = model.body_weldid[model.geom_bodyid] == 0, model.geom_group < SHOWN_GROUPS
    surroundings, links = (np.flatnonzero(which & shown).tolist() for which in (fixed, ~fixed))
    body = recorded.rollout.radius
    if recorded.rollout.balls is not None:  # the links of an arm reach farther than the tracked point
        body, run = 0.0, np.vstack([run, recorded.rollout.balls.planned.reshape(-1, 3)])
        for time in np.linspace(recorded.end, 0, POSES):
            recorded.pose(data, float(time))
            run = np.vstack([run, *(_corners(recorded, data, geom) for geom in links)])
    recorded.pose(data, 0.0)
    low, high = run.min(axis=0), run.max(axis=0)
    margin = 0.4 * float(np.linalg.norm(high - low)) + 2 * body
    corners = [_corners(recorded, data, geom, infinite=margin) for geom in surroundings]
    return np.vstack([run, *(np.clip(points, low - margin, high + margin) for points in corners)])


def _corners(recorded: RecordedTrial, data: mujoco.MjData, geom: int, *, infinite: float = 0.0) -> Array:
    """The corners (8, 3) of the box about a geom; a plane without an end has this half size."""
    model = recorded.model
    middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE.value:  # a plane has no box
        middle, half = np.zeros(3), np.where(model.geom_size[geom] > 0, model.geom_size[geom], infinite) * [1, 1, 0]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return data.geom_xpos[geom] + (middle + signs * half) @ data.geom_xmat[geom].reshape(3, 3).T


def _chase(recorded: RecordedTrial) -> CameraView:
    """A view from behind and above that turns smoothly with the direction of the plan."""
    times = np.linspace(0, recorded.end, max(int(20 * recorded.end), 2))
    planned, driven = recorded.planned(times), recorded.driven(times)
    motion = np.gradient(planned, times, axis=0)[:, :2]
    # At rest, or straight up, the direction is from the start of the plan to its end.
    motion += 1e-3 * (planned[-1] - planned[0])[:2] + [1e-9, 0.0]
    direction = _smooth(motion, times, TURN_SECONDS)
    azimuth = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    middle = _smooth(driven, times, 0.25 * TURN_SECONDS)
    radius = recorded.rollout.radius or recorded.size

    def place(scene: mujoco.MjvScene, data: mujoco.MjData, time: float) -> None:
        angle = np.interp(time, times, azimuth)
        at = interpolated(middle, times, time)
        behind = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = at - DISTANCE * radius * behind + [0, 0, HEIGHT * radius]
        forward = at + 2 * radius * behind - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        up = np.cross(right / np.linalg.norm(right), forward)
        _set_perspective(scene, recorded.model, eye, forward, up, FIELD_OF_VIEW)

    return CameraView(place)


def _smooth(values: Array, times: Array, width: float) -> Array:
    """Values (k, n) at even times, smoothed by a Gaussian of this standard deviation in seconds."""
    weights = np.exp(-0.5 * ((times[:, None] - times) / width) ** 2)
    return weights @ values / weights.sum(axis=1, keepdims=True)


def _set_perspective(
    scene: mujoco.MjvScene, model: mujoco.MjModel, eye: Array, forward: Array, up: Array, field_of_view: float
) -> None:
    """Set the cameras of a scene to a perspective from `eye`; the vertical field of view is in degrees."""
    near = model.vis.map.znear * model.stat.extent
    for camera in scene.camera:
        camera.pos, camera.forward, camera.up, camera.orthographic = eye, forward, up, 0
        camera.frustum_near, camera.frustum_far = near, model.vis.map.zfar * model.stat.extent
        camera.frustum_top = near * np.tan(np.radians(field_of_view) / 2)
        camera.frustum_bottom, camera.frustum_center = -camera.frustum_top, 0
        camera.frustum_width = 0  # follows from the pane

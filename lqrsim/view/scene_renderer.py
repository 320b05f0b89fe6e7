"""One trial, drawn by MuJoCo at any time: panes, overlays, and occluders that fade."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.rendering.classic import gl_context

from lqrsim.errors import Array
from lqrsim.view.camera_views import CameraView
from lqrsim.view.decorative_geoms import draw_mark, mark_radius
from lqrsim.view.layout import Box
from lqrsim.view.overlays import Overlays
from lqrsim.view.recorded_trial import RecordedTrial
from lqrsim.view.text_tiles import Pixels

FADED_OPACITY = 0.10  # of a geom that hides the robot
MOST_ROBOTS = 50  # in one picture; more cannot be told apart
DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # the geom groups that MuJoCo shows by default


@contextlib.contextmanager
def open_renderer(
    recorded: RecordedTrial, overlays: Overlays, views: Sequence[tuple[Box, CameraView]], size: tuple[int, int]
) -> Iterator["SceneRenderer"]:
    """Open a renderer of a trial for a picture of `size` with these panes; OpenGL must be bound."""
    model = recorded.model
    # A larger buffer costs as much as a larger picture, and a smaller one is refused.
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    window = gl_context.GLContext(*size)
    try:
        window.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        try:
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
            yield SceneRenderer(recorded, overlays, views, size, window, context)
        finally:
            window.make_current()
            context.free()
    finally:
        window.free()


class SceneRenderer:
    """Draws a trial into an OpenGL context of its own; made by `open_renderer`.

    MuJoCo's `Renderer` does the same for one view, with one more copy of the picture.
    """

    def __init__(
        self,
        recorded: RecordedTrial,
        overlays: Overlays,
        views: Sequence[tuple[Box, CameraView]],
        size: tuple[int, int],
        window: Any,
        context: mujoco.MjrContext,
    ) -> None:
        self.recorded, self.overlays, self.views = recorded, overlays, views
        self.window, self.context, self.model = window, context, recorded.model
        self.data, self.ghost = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self.scene = mujoco.MjvScene(self.model, maxgeom=1000 + (MOST_ROBOTS + 1) * self.model.ngeom)
        self.visual_options = mujoco.MjvOption(), mujoco.MjvPerturb()
        self.pixels = np.empty((size[1], size[0], 3), dtype=np.uint8)
        # A plane is transparent from behind anyway, and hides nothing from the front.
        solid = self.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value
        self.can_occlude = solid & (self.model.body_weldid[self.model.geom_bodyid] == 0)
        self.faded = np.zeros((len(views), self.model.ngeom))

    def draw(self, time: float, *, fade: float = 1.0, earlier: Iterable[float] = ()) -> Pixels:
        """The picture (height, width, 3) at `time`, with the robot also at earlier times; the next call overwrites it.

        Args:
          fade: largest change of an opacity since the picture before.
        """
        model, data, scene = self.model, self.data, self.scene
        self.recorded.pose(data, time)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self.visual_options[0], None, mujoco.MjvCamera(), everything, scene)
        own = scene.ngeom
        for moment in earlier:
            self.recorded.pose(self.ghost, moment)
            mujoco.mjv_addGeoms(model, self.ghost, *self.visual_options, mujoco.mjtCatBit.mjCAT_DYNAMIC.value, scene)
        self.overlays.draw(scene, data, time)
        self.window.make_current()
        for (box, view), faded in zip(self.views, self.faded, strict=True):
            view.place(scene, data, time)
            self._move_headlight()
            faded += np.clip(self._occluders() - faded, -fade, fade)
            with self._fade(faded, own):
                height = self.pixels.shape[0]
                where = mujoco.MjrRect(box.left, height - box.top - box.height, box.width, box.height)
                common = scene.ngeom
                self.overlays.draw_force(scene, data, time)
                if view.camera is not None:
                    radius = mark_radius(self.recorded.rollout)
                    draw_mark(scene, view.camera, self.recorded.place_in(data), radius)
                mujoco.mjr_render(where, scene, self.context)
                scene.ngeom = common
        whole = mujoco.MjrRect(0, 0, self.pixels.shape[1], self.pixels.shape[0])
        mujoco.mjr_readPixels(self.pixels, None, whole, self.context)
        return self.pixels[::-1]

    def _move_headlight(self) -> None:
        """Move the headlight to the camera."""
        for light in self.scene.lights[: self.scene.nlight]:
            if light.headlight:
                light.pos, light.dir = self.scene.camera[0].pos, self.scene.camera[0].forward

    def _occluders(self) -> npt.NDArray[np.bool_]:
        """Which geoms (ngeom,) are between the camera and the robot's centre or outline."""
        view = self.scene.camera[0]
        up, forward = np.array(view.up, dtype=np.float64), np.array(view.forward, dtype=np.float64)
        right = np.cross(forward, up)
        centre, radius = self.recorded.place_in(self.data), 0.8 * self.recorded.rollout.radius
        found, geom = np.zeros(self.model.ngeom, dtype=bool), np.zeros(1, np.int32)
        eye = np.array(view.pos, dtype=np.float64)
        for offset in (0 * up, up, -up, right, -right):
            target = centre + radius * offset
            # The rays of an orthographic camera are parallel.
            start = target + forward * (forward @ (eye - target)) if view.orthographic else eye
            for _ in range(100):  # surfaces at most
                ray = target - start
                hit = mujoco.mj_ray(self.model, self.data, start, ray, DRAWN_GROUPS, True, -1, geom)
                if not 0 <= hit < 1:
                    break
                found[geom[0]] = self.can_occlude[geom[0]]
                start = start + (hit + 1e-4) * ray
        return found

    @contextlib.contextmanager
    def _fade(self, faded: Array, own: int) -> Iterator[None]:
        """A block in which geoms of the scene are faded by these shares (ngeom,)."""
        before: list[tuple[int, float, int]] = []
        for number in range(own if faded.any() else 0):
            geom = self.scene.geoms[number]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and faded[geom.objid] > 0:
                share, alpha = faded[geom.objid], float(geom.rgba[3])
                before.append((number, alpha, geom.transparent))
                geom.rgba[3], geom.transparent = (1 - share) * alpha + share * min(alpha, FADED_OPACITY), 1
        yield
        for number, alpha, transparent in before:
            geom = self.scene.geoms[number]
            geom.rgba[3], geom.transparent = alpha, transparent

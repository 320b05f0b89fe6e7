"""The whole picture: runs side by side, drawn by MuJoCo, with captions, in a chosen quality."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.rendering.classic import gl_context

from lqrsim.annotations import Bounds, Want, checked
from lqrsim.errors import Array, InputError, check_items
from lqrsim.results.certified import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.view import geoms, gl
from lqrsim.view.cameras import CameraView, camera_view
from lqrsim.view.captions import Caption, Legend, Pixels
from lqrsim.view.options import OVERLAYS, Box, Quality, side_by_side, split_into_panes
from lqrsim.view.overlays import Arrow, Overlays, Shown, check_drawn, common_scale
from lqrsim.view.recorded_trial import RecordedTrial, place_of, rows_of, tracked_balls
from lqrsim.view.video_metadata import Pane

FADED_OPACITY = 0.10  # opacity of a geom that hides the robot
MOST_ROBOTS = 50  # largest number of robots in a picture; more cannot be told apart
DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # the geom groups that MuJoCo shows by default


class SceneRenderer:
    """Draws views of a trial, in panes of its part of a picture, with an OpenGL context that the stack closes.

    MuJoCo's `Renderer` does the same for one view, with one more copy of the picture.
    """

    def __init__(
        self, overlays: Overlays, views: Sequence[tuple[Box, CameraView]], box: Box, caption: Caption | None,
        stack: contextlib.ExitStack,
    ) -> None:  # fmt: skip
        self.overlays, self.views, self.box, self.caption = overlays, views, box, caption
        self.recorded, self.model = overlays.recorded, overlays.recorded.model
        self.data, self.ghost = mujoco.MjData(self.model), mujoco.MjData(self.model)
        most = 1000 + (MOST_ROBOTS + 1) * self.model.ngeom + len(overlays.drawables)
        self.scene = mujoco.MjvScene(self.model, maxgeom=most)
        self.emission = 0.0 if self.recorded.planar else geoms.GLOW
        self.visual_options = mujoco.MjvOption(), mujoco.MjvPerturb()
        self.pixels = np.empty((box.height, box.width, 3), dtype=np.uint8)
        # A plane is transparent from behind anyway, and hides nothing from the front.
        solid = self.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value
        self.can_occlude = solid & (self.model.body_weldid[self.model.geom_bodyid] == 0)
        self.faded = np.zeros((len(views), self.model.ngeom))
        # A larger buffer costs as much as a larger picture, and a smaller one is refused.
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = box.width, box.height
        self.window = gl_context.GLContext(box.width, box.height)
        stack.callback(self.window.free)
        self.window.make_current()
        self.context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        stack.callback(self.context.free)
        stack.callback(self.window.make_current)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)

    def draw(self, time: float, *, fade: float = 1.0, earlier: Iterable[float] = ()) -> Pixels:
        """The picture (height, width, 3) at `time`, with the robot also at earlier times; the next call overwrites it.

        No opacity changes by more than `fade` from the previous picture.
        """
        model, data, scene = self.model, self.data, self.scene
        self.recorded.pose(data, time)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self.visual_options[0], None, mujoco.MjvCamera(), everything, scene)
        of_model, new = scene.ngeom, geoms.appending_to(scene)
        for moment in earlier:
            self.recorded.pose(self.ghost, moment)
            mujoco.mjv_addGeoms(model, self.ghost, *self.visual_options, mujoco.mjtCatBit.mjCAT_DYNAMIC.value, scene)
        for drawable in self.overlays.drawables:
            geoms.draw(drawable, time, new, emission=self.emission)
        of_all_views, place = scene.ngeom, place_of(data, self.recorded.robot, tracked_balls(self.recorded.rollout))
        self.window.make_current()
        for (box, view), faded in zip(self.views, self.faded, strict=True):
            view.place(scene, data, time)
            for light in scene.lights[: scene.nlight]:  # a headlight moves with the camera
                if light.headlight:
                    light.pos, light.dir = scene.camera[0].pos, scene.camera[0].forward
            faded += np.clip(self._occluders(place) - faded, -fade, fade)
            with self._fade(faded, of_model):
                for arrow in self.overlays.drawables:
                    if isinstance(arrow, Arrow):
                        geoms.draw_arrow(arrow, self.recorded.force_at(time), place, scene, emission=self.emission)
                if view.camera is not None:
                    geoms.draw_mark(scene, view.camera, place, geoms.mark_radius(self.recorded))
                bottom = self.pixels.shape[0] - box.top - box.height
                mujoco.mjr_render(mujoco.MjrRect(box.left, bottom, box.width, box.height), scene, self.context)
                scene.ngeom = of_all_views
        viewport = mujoco.MjrRect(0, 0, self.pixels.shape[1], self.pixels.shape[0])
        mujoco.mjr_readPixels(self.pixels, None, viewport, self.context)
        return self.pixels[::-1]

    def _occluders(self, centre: Array) -> npt.NDArray[np.bool_]:
        """Flags (ngeom,) of the geoms between the camera and the robot's centre (3,) or outline."""
        view = self.scene.camera[0]
        up, forward = np.array(view.up, dtype=np.float64), np.array(view.forward, dtype=np.float64)
        right = np.cross(forward, up)
        radius = 0.8 * self.recorded.rollout.radius
        hidden, geom = np.zeros(self.model.ngeom, dtype=bool), np.zeros(1, np.int32)
        eye = np.array(view.pos, dtype=np.float64)
        for offset in (0 * up, up, -up, right, -right):
            target = centre + radius * offset
            # The rays of an orthographic camera are parallel.
            start = target + forward * (forward @ (eye - target)) if view.orthographic else eye
            for _ in range(100):  # largest number of surfaces behind each other
                ray = target - start
                hit = mujoco.mj_ray(self.model, self.data, start, ray, DRAWN_GROUPS, True, -1, geom)
                if not 0 <= hit < 1:
                    break
                hidden[geom[0]] = self.can_occlude[geom[0]]
                start = start + (hit + 1e-4) * ray
        return hidden

    @contextlib.contextmanager
    def _fade(self, faded: Array, count: int) -> Iterator[None]:
        """A block in which the model's geoms, the first of the scene, are faded by these fractions (ngeom,)."""
        before: list[tuple[int, float, int]] = []
        for number in range(count if faded.any() else 0):
            geom = self.scene.geoms[number]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and faded[geom.objid] > 0:
                fade, alpha = faded[geom.objid], float(geom.rgba[3])
                before.append((number, alpha, geom.transparent))
                geom.rgba[3], geom.transparent = (1 - fade) * alpha + fade * min(alpha, FADED_OPACITY), 1
        yield
        for number, alpha, transparent in before:
            geom = self.scene.geoms[number]
            geom.rgba[3], geom.transparent = alpha, transparent


LARGEST = 8192  # pixels, a side length that every OpenGL can draw
MOST_RUNS = 6  # largest number of runs side by side; more are too small
MOST_INSETS = 3
LEAST_HEIGHT = 16  # pixels of height that a caption must leave
LINE, BLANK = (120, 128, 140), (255, 255, 255)  # colours between panes, and behind captions

Pixel = Annotated[int, Bounds(at_least=64, at_most=LARGEST)]
Size = Annotated[tuple[Pixel, Pixel], Want("a tuple")]
CameraName = Annotated[str, Want("the name of a camera")]
Title = Annotated[str, 100]


class QualitySettings(NamedTuple):
    """Settings of a quality: size, samples for smooth edges, resolution of shadows (0: none), and settings of x264."""

    size: tuple[int, int]
    samples: int
    shadows: int
    crf: int
    preset: str


QUALITIES: dict[Quality, QualitySettings] = {
    "draft": QualitySettings((640, 360), 0, 0, 26, "ultrafast"),
    "standard": QualitySettings((1280, 720), 4, 2048, 18, "veryfast"),
    "publication": QualitySettings((1920, 1080), 8, 4096, 15, "medium"),
}


@contextlib.contextmanager
@checked
def open_picture(
    runs: Rollout | Sequence[Rollout],
    *,
    trial: int | Sequence[int] = 0,
    camera: CameraName = "overview",
    insets: Annotated[Sequence[str], Want(f"a tuple of the names of cameras, {MOST_INSETS} at most")] = (),
    titles: Annotated[Sequence[Title], Want("a tuple of texts, one for each run")] = (),
    overlays: Shown = OVERLAYS,
    solution: Solution | Sequence[Solution | None] | None = None,
    funnel: Funnel | Sequence[Funnel | None] | None = None,
    quality: Quality = "standard",
    size: Size | None = None,
    speed: float = 1.0,
) -> Iterator["Picture"]:
    """Open a picture of runs, to be used with `with`, because it holds OpenGL contexts; arguments as in `render`."""
    check_drawn(overlays, solution=solution, funnel=funnel, titles=titles)
    settings = QUALITIES[quality]
    width, height = settings.size if size is None else even(size)
    if len(insets) > MOST_INSETS:
        raise InputError(f"insets: got {len(insets)}, want {MOST_INSETS} at most")
    distinct, shown = _runs_and_trials(runs, trial)
    recordings = [RecordedTrial(distinct[number], row) for number, row in shown]
    scale = common_scale(recordings)
    solutions = _one_each("solution", solution, recordings)
    funnels = _one_each("funnel", funnel, recordings)
    all_overlays = [
        Overlays(recorded, overlays, scale, solution=of_run, funnel=about_run)
        for recorded, of_run, about_run in zip(recordings, solutions, funnels, strict=True)
    ]
    titles = _one_each("titles", titles or None, recordings)
    gl.bind()
    legend = Legend(all_overlays, (width, height)) if "caption" in overlays else None
    boxes = side_by_side(len(recordings), (width, height - (0 if legend is None else legend.height)))
    captions = [None] * len(recordings)
    if legend is not None:
        captions = [Caption(*run, speed) for run in zip(all_overlays, boxes, titles, strict=True)]
    strip = max(0 if caption is None else caption.height for caption in captions)
    if min(box.height for box in boxes) - strip < LEAST_HEIGHT:
        raise InputError(f"size: got {width} x {height}, which captions would fill, want it larger, or no caption")
    with contextlib.ExitStack() as stack:
        parts: list[SceneRenderer] = []
        panes: list[Pane] = []
        for drawn, box, caption, (run, row) in zip(all_overlays, boxes, captions, shown, strict=True):
            recorded, visual = drawn.recorded, drawn.recorded.model.vis.quality
            visual.shadowsize, visual.offsamples = settings.shadows, settings.samples
            # Lines are boxes under a distant sun, for which one quadrilateral per side suffices; the default is 16.
            visual.numquads = 1
            areas = split_into_panes(Box(0, strip, box.width, box.height - strip), len(insets))
            named = zip((camera, *insets), areas, strict=True)
            views = [(area, camera_view(name, recorded, area.aspect, beside=recordings)) for name, area in named]
            parts.append(SceneRenderer(drawn, views, box, caption, stack))
            for area, view in views:
                left, top = box.left + area.left, box.top + area.top
                panes.append(Pane(left, top, area.width, area.height, run, row, view.camera))
        yield Picture(distinct, parts, tuple(panes), (width, height), legend)


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture of all runs at any time."""

    runs: Sequence[Rollout]
    parts: Sequence[SceneRenderer]
    panes: tuple[Pane, ...]
    size: tuple[int, int]
    legend: Legend | None

    @property
    def end(self) -> float:
        return max(part.recorded.end for part in self.parts)

    @property
    def markers(self) -> tuple[float, ...]:
        """Radii in metres of the robots' marks in calibrated panes."""
        sizes = {id(part.recorded.rollout): geoms.mark_radius(part.recorded) for part in self.parts}
        return tuple(sizes[id(run)] for run in self.runs)

    def draw(self, time: float, *, fade: float = 1.0, earlier: Iterable[float] = ()) -> Pixels:
        """The picture (height, width, 3) at `time`, with the robot also at earlier times."""
        earlier = list(earlier)
        image = np.empty((self.size[1], self.size[0], 3), dtype=np.uint8)
        for part in self.parts:
            box, now = part.box, min(time, part.recorded.end)
            area = image[box.top : box.top + box.height, box.left : box.left + box.width]
            area[:] = part.draw(now, fade=fade, earlier=earlier)
            area[: part.views[0][0].top] = BLANK
            for pane, _ in part.views[1:]:
                _draw_edge(area, pane)
            if part.caption is not None:
                part.caption.draw(area, now)
            _draw_edge(image, box)
        if self.legend is not None:
            self.legend.draw(image)
        return image


class LivePicture:
    """Draws one running trial, with its plan: opened at the first frame, and redrawn for each.

    The camera may be any of `render` but "chase", which needs the whole run.
    """

    _prefix = ""

    @checked
    def __init__(self, camera: CameraName, size: Size) -> None:
        if camera == "chase":
            raise InputError("camera: got 'chase', want one that does not look ahead, such as 'overview' or 'top'")
        self._open = partial(open_picture, camera=camera, overlays=("plan",), quality="draft", size=even(size))
        self._stack = contextlib.ExitStack()
        self._picture: Picture | None = None

    def draw(self, so_far: Callable[[], Rollout], frame: Array, time: float) -> Pixels:
        """The picture (height, width, 3) of MuJoCo's qpos `frame` (nq,), opened with the run so far."""
        if self._picture is None:
            self._picture = self._stack.enter_context(self._open(so_far()))
        for part in self._picture.parts:
            part.recorded.frame_times, part.recorded.frames = np.array([time]), frame[None]
        return self._picture.draw(time)

    def close(self) -> None:
        self._picture = None
        self._stack.close()


def even(size: tuple[int, int]) -> tuple[int, int]:
    """The width and height, which h264 needs even."""
    if size[0] % 2 or size[1] % 2:
        raise InputError(f"size: got {size[0]} x {size[1]}, want even numbers, which h264 needs")
    return size


def _runs_and_trials(
    runs: Rollout | Sequence[Rollout], trial: int | Sequence[int]
) -> tuple[list[Rollout], list[tuple[int, int]]]:
    """The rollouts, each once, and the run and trial of each part of the picture."""
    if isinstance(runs, Rollout):
        return [runs], [(0, row) for row in rows_of(trial, MOST_RUNS)]
    distinct = list(check_items("runs", runs, Rollout, f"a Rollout, or 1 to {MOST_RUNS} of them", at_most=MOST_RUNS))
    if not distinct:
        raise InputError(f"runs: got 0 to show, want 1 to {MOST_RUNS}")
    return distinct, list(enumerate(_one_each("trial", trial, distinct)))


def _one_each(field: str, values: Any, of: Sequence[object]) -> list[Any]:
    """One value for each run, given once for all or once for each."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        return [values] * len(of)
    if len(values) != len(of):
        raise InputError(f"{field}: got {len(values)}, want one for each of {len(of)} runs")
    return list(values)


def _draw_edge(image: Pixels, box: Box) -> None:
    """Draw the left and the upper edge of a box, except edges of the picture."""
    if box.left:
        image[box.top : box.top + box.height, box.left] = LINE
    if box.top:
        image[box.top, box.left : box.left + box.width] = LINE

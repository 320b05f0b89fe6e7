"""The whole picture: runs side by side, drawn by MuJoCo, with captions, in a chosen quality.

Each run has a caption with title, disturbances and readings, and all runs have one legend. Tiles of text are drawn with
Pillow and blended into images (height, width, 3).
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import matplotlib
import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.rendering.classic import gl_context
from PIL import Image, ImageDraw, ImageFont

from lqrsim.annotations import Bounds, Want, checked
from lqrsim.errors import Array, InputError, check_items
from lqrsim.results.certified import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.view import gl
from lqrsim.view.cameras import Camera, CameraView, camera_view, draw_mark, mark_radius
from lqrsim.view.options import OVERLAYS, Colour, Quality
from lqrsim.view.overlays import Arrow, Overlays, Shown, check_drawn, common_scale, error_colours, legend_entries
from lqrsim.view.recorded_trial import RecordedTrial, place_of, rows_of, tracked_balls

Pixels = npt.NDArray[np.uint8]

FADED_OPACITY = 0.10  # opacity of a geom that hides the robot
MOST_ROBOTS = 50  # largest number of robots in a picture; more cannot be told apart
DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # the geom groups that MuJoCo shows by default
GLOW = 0.3  # emission of what hangs in space; what lies on a floor is lit as the floor is
INSETS_FRACTION = 0.4  # fraction of a run's part for its insets
INK, PAPER = (28, 32, 38, 255), (255, 255, 255, 200)
HEADER_FRACTION = 0.4  # largest fraction of a picture's height for the header
LETTERS_PER_HEIGHT, LETTERS_PER_WIDTH = 44, 54  # a picture's size in letter heights; the smaller letter is used


@dataclass(frozen=True)
class Box:
    """A rectangle of the picture, in pixels from the upper left corner."""

    left: int
    top: int
    width: int
    height: int

    @property
    def aspect(self) -> float:
        return self.width / self.height


def side_by_side(count: int, size: tuple[int, int]) -> list[Box]:
    """Equal parts of a picture of `size` width and height, up to three in a row, with even edges."""
    columns = count if count <= 3 else -(-count // 2)
    rows = -(-count // columns)
    x = [2 * round(size[0] * column / columns / 2) for column in range(columns + 1)]
    y = [2 * round(size[1] * row / rows / 2) for row in range(rows + 1)]
    places = [(number % columns, number // columns) for number in range(count)]
    return [Box(x[i], y[j], x[i + 1] - x[i], y[j + 1] - y[j]) for i, j in places]


def split_into_panes(box: Box, insets: int) -> list[Box]:
    """The first pane and the insets, in a column on its right, or in a row below it if the box is higher than wide."""
    wide = box.width >= box.height
    length, across = (box.width, box.height) if wide else (box.height, box.width)
    edge = 2 * round(length * (1 - INSETS_FRACTION) / 2) if insets else length
    cuts = [2 * round(across * number / max(insets, 1) / 2) for number in range(insets + 1)]
    parts = [(0, 0, edge, across), *((edge, i, length - edge, j - i) for i, j in pairwise(cuts))]
    if not wide:
        parts = [(y, x, height, width) for x, y, width, height in parts]
    return [Box(box.left + x, box.top + y, width, height) for x, y, width, height in parts]


@checked
@dataclass(frozen=True)
class Pane(Box):
    """A part of the picture that shows a trial of a run, by their indices, with the camera if it is calibrated."""

    run: int = 0
    trial: int = 0
    camera: Camera | None = None


class Caption:
    """The caption of one run, a strip of constant height above its part of the picture, where it covers nothing."""

    def __init__(self, overlays: Overlays, box: Box, title: str | None, speed: float) -> None:
        recorded, run = overlays.recorded, overlays.recorded.rollout
        self.overlays, self.speed, self.width = overlays, speed, box.width
        self.letter_height = _letter_height(box.width, box.height)
        title = title or recorded.name + (f", trial {run.first_trial + recorded.trial}" if run.trials > 1 else "")
        self.header = self._header_tile(title, list(run.disturbances), box)
        # Readings keep their place: next to the title in a strip that is wide enough, otherwise in separate lines.
        longest = self._readings_width(1)
        bare_title = text_tile((title,), self.letter_height, width=0)
        beside = bare_title.shape[1] + longest < self.width
        most = len(overlays.readings(recorded.end, speed))
        self.lines = next((count for count in range(1, most) if self._readings_width(count) <= self.width), most)
        self.place = (self.width - longest, 0) if beside else (0, self.header.shape[0])
        self.height = self.header.shape[0] + (0 if beside else self._readings_tile(recorded.end).shape[0])

    def _header_tile(self, title: str, disturbances: list[str], box: Box) -> Pixels:
        """The title, as many disturbances as leave most of the picture free, and the number of the remaining ones."""
        tile = np.empty((0, 0, 4), dtype=np.uint8)
        for count in range(len(disturbances), -1, -1):
            left = len(disturbances) - count
            rest = [f"{left}{' more' if count else ''} disturbance{'s' if left > 1 else ''}"] if left else []
            words = [*disturbances[:count], *rest] or ["undisturbed"]
            lines = [title, *wrap("; ".join(words), self.letter_height, self.width - round(1.4 * self.letter_height))]
            tile = text_tile(tuple(lines), self.letter_height, width=self.width)
            if tile.shape[0] <= HEADER_FRACTION * box.height:
                break
        return tile

    def draw(self, area: Pixels, time: float) -> None:
        blend(area, self.header, left=0, top=0)
        readings = self._readings_tile(time)
        if self.place[0]:
            readings = readings[: round(1.85 * self.letter_height)]  # up to the next line
        blend(area, readings, left=self.place[0], top=self.place[1])

    def _readings_tile(self, time: float, lines: int | None = None) -> Pixels:
        """The readings, in at most this number of lines."""
        readings = self.overlays.readings(time, self.speed)
        count = min(lines or self.lines, len(readings))
        cuts = [len(readings) * number // count for number in range(count + 1)]
        texts = tuple("   ".join(readings[first:last]) for first, last in pairwise(cuts))
        return text_tile(texts, self.letter_height, width=0, bold=False)

    def _readings_width(self, lines: int) -> int:
        """The width in pixels of the readings in this number of lines, with room for longer numbers."""
        run, times = self.overlays.recorded.rollout, [0.0, self.overlays.recorded.end]
        if (membership := self.overlays.membership) is not None:
            times.append(float(run.times[membership.index(max(membership, key=len))]))
        return max(self._readings_tile(time, lines).shape[1] for time in times) + 3 * self.letter_height


class Legend:
    """The legend of all runs, a strip below them, in rows; its height in pixels is 0 if it is empty.

    The colour None is the map of the tracking error.
    """

    def __init__(self, overlays: Sequence[Overlays], size: tuple[int, int]) -> None:
        height, rows = max(round(0.8 * _letter_height(*size)), 8), list[list[tuple[float, str, Colour | None]]]()
        font, swatch, space = _font(height), round(2.5 * height), 0.6 * height
        x = widest = space
        for name, colour in legend_entries(overlays).items():
            needed = font.getlength(name) + swatch + 3 * space
            if not rows or x + needed > size[0]:
                rows.append([])
                x = space
            rows[-1].append((x, name, colour))
            x += needed
            widest = max(widest, x)
        tile = Image.new("RGBA", (round(widest), round((1.6 * len(rows) + 0.6) * height)), PAPER)
        draw = ImageDraw.Draw(tile)
        for number, row in enumerate(rows):
            top = (1.6 * number + 0.45) * height
            for left, name, colour in row:
                for column in range(swatch):
                    shade = error_colours(np.array([column / swatch]))[0, :3] if colour is None else colour
                    place = (left + column, top + 0.45 * height, left + column, top + 0.95 * height)
                    draw.line(place, fill=tuple(round(255 * part) for part in shade))
                draw.text((left + swatch + space, top), name, font=font, fill=INK)
        self.tile = np.asarray(tile)
        self.height = self.tile.shape[0] + self.tile.shape[0] % 2 if rows else 0

    def draw(self, image: Pixels) -> None:
        if self.height:
            image[-self.height :] = 255
            blend(image[-self.tile.shape[0] :], self.tile, left=0, top=0)


def _letter_height(width: int, height: int) -> int:
    return max(round(min(height / LETTERS_PER_HEIGHT, width / LETTERS_PER_WIDTH)), 9)


@lru_cache(maxsize=16)
def text_tile(lines: tuple[str, ...], height: int, *, width: int, bold: bool = True) -> Pixels:
    """Lines of text on translucent paper, (h, w, 4), at least `width` pixels wide.

    The letters are `height` pixels high; with `bold` the first line is bold.
    """
    fonts = [_font(height, bold=bold and number == 0) for number in range(len(lines))]
    needed = max(font.getlength(line) for font, line in zip(fonts, lines, strict=True))
    size = round(max(needed + 1.4 * height, width)), round((1.5 * len(lines) + 0.7) * height)
    tile = Image.new("RGBA", size, PAPER)
    draw = ImageDraw.Draw(tile)
    for number, (font, line) in enumerate(zip(fonts, lines, strict=True)):
        draw.text((0.7 * height, (0.4 + 1.5 * number) * height), line, font=font, fill=INK)
    return np.asarray(tile)


def wrap(words: str, height: int, width: int) -> list[str]:
    """The words in lines of at most `width` pixels, unless a word is longer, in letters `height` pixels high."""
    font, lines = _font(height), [""]
    for word in words.split():
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if lines[-1] and font.getlength(longer) > width:
            lines.append(f"  {word}")
        else:
            lines[-1] = longer
    return lines


def blend(image: Pixels, tile: Pixels, *, left: int, top: int) -> None:
    """Blend a tile into the image, in place, at these distances in pixels from the left and the top."""
    area = image[top : top + tile.shape[0], left : left + tile.shape[1]]
    tile = tile[: area.shape[0], : area.shape[1]]
    alpha = tile[..., 3:].astype(np.uint16)
    area[...] = ((255 - alpha) * area + alpha * tile[..., :3] + 127) // 255


@lru_cache(maxsize=8)
def _font(height: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(folder / f"DejaVuSans{'-Bold' if bold else ''}.ttf", height)


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
        self.emission = 0.0 if self.recorded.planar else GLOW
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
        of_model = scene.ngeom
        for moment in earlier:
            self.recorded.pose(self.ghost, moment)
            mujoco.mjv_addGeoms(model, self.ghost, *self.visual_options, mujoco.mjtCatBit.mjCAT_DYNAMIC.value, scene)
        for drawable in self.overlays.drawables:
            for shape in drawable.shapes(time):
                shape.append(scene, emission=self.emission)
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
                        arrow.draw_for(scene, self.recorded.force_at(time), place, emission=self.emission)
                if view.camera is not None:
                    draw_mark(scene, view.camera, place, mark_radius(self.recorded))
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
    width, height = settings.size if size is None else check_even(size)
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
        sizes = {id(part.recorded.rollout): mark_radius(part.recorded) for part in self.parts}
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
        self._open = partial(open_picture, camera=camera, overlays=("plan",), quality="draft", size=check_even(size))
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


def check_even(size: tuple[int, int]) -> tuple[int, int]:
    """The width and height. Raises InputError if one is odd, which h264 cannot encode."""
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

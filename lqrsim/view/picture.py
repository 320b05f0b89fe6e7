"""The whole picture: a stage for each run, side by side, with captions; and how well it is drawn."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lqrsim.errors import InputError, check_count, check_items, check_kind, check_name, check_text, excerpt
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.view import gl, marker
from lqrsim.view.camera_views import Shot, leaves_room, shot
from lqrsim.view.captions import Caption, Legend
from lqrsim.view.options import OVERLAYS, Overlay, Quality
from lqrsim.view.overlays import Overlays, scale
from lqrsim.view.scene_renderer import Box, Stage, stage
from lqrsim.view.text_tiles import Pixels
from lqrsim.view.track import Track
from lqrsim.view.video_metadata import Pane

LARGEST = 8192  # pixels of a side: what OpenGL can surely draw
RUNS = 6  # more can not be told apart side by side
INSETS = 3
READABLE = 300  # height of a picture in pixels from which on captions take a small part of it
LEAST = 16  # height of what is shown below a caption, in pixels
SHARE = 0.4  # of a run's part of the picture, for its insets
LINE, BLANK = (120, 128, 140), (255, 255, 255)  # between panes, and behind captions


@dataclass(frozen=True)
class Look:
    """Of a quality: its size, samples for smooth edges, resolution of shadows (0: none), and x264's settings."""

    size: tuple[int, int]
    samples: int
    shadows: int
    crf: int
    preset: str


QUALITIES: dict[Quality, Look] = {
    "draft": Look((640, 360), 0, 0, 26, "ultrafast"),
    "standard": Look((1280, 720), 4, 2048, 18, "veryfast"),
    "publication": Look((1920, 1080), 8, 4096, 15, "medium"),
}


@dataclass(frozen=True)
class Part:
    """A run's part of the picture: its own caption, and below it panes, whose boxes are in the part's."""

    track: Track
    box: Box
    views: list[tuple[Box, Shot]]
    overlays: Overlays
    stage: Stage
    told: Caption | None


@contextlib.contextmanager
def picture(
    runs: Rollout | Sequence[Rollout],
    trial: int | Sequence[int] = 0,
    camera: str = "overview",
    insets: Sequence[str] = (),
    titles: Sequence[str] = (),
    overlays: Sequence[Overlay] = OVERLAYS,
    solution: Solution | Sequence[Solution | None] | None = None,
    quality: Quality = "standard",
    size: tuple[int, int] | None = None,
    speed: float = 1.0,
) -> Iterator["Picture"]:
    """What `render` and `still` draw from; arguments and what is raised are theirs."""
    check_name("quality", quality, QUALITIES)
    look = QUALITIES[quality]
    size = _checked_size(look.size if size is None else size)
    check_text("camera", camera, "the name of a camera")
    insets = check_items("insets", insets, str, f"a tuple of the names of cameras, {INSETS} at most", at_most=100)
    overlays = check_items("overlays", overlays, object, f"a tuple of: {', '.join(OVERLAYS)}", at_most=100)
    for overlay in overlays:
        check_name("overlays", overlay, OVERLAYS)
    titles = check_items("titles", titles, str, "a tuple of texts, one a run", at_most=RUNS)
    for title in titles:
        check_text("titles", title, "a title", at_most=100, empty=True)
    if len(insets) > INSETS:
        raise InputError(f"insets: got {len(insets)}, want {INSETS} at most")
    distinct, shown = _shown(runs, trial)
    tracks = [Track(distinct[number], row) for number, row in shown]
    common = scale(tracks)
    solutions = _one_each("solution", solution, tracks)
    for one in solutions:
        check_kind("solution", one, (Solution, type(None)), "the Solution of the run, or None")
    drawn = [Overlays(*each, overlays, common) for each in zip(tracks, solutions, strict=True)]
    names = _one_each("titles", list(titles), tracks) if titles else [None] * len(tracks)
    gl.bind()
    over = len(tracks) == 1 and not insets and size[1] >= READABLE and leaves_room(camera, tracks[0], size[0] / size[1])
    legend = Legend(drawn, common, size, over=over) if "caption" in overlays else None
    room = size[0], size[1] - (0 if legend is None or over else legend.height)
    boxes = _side_by_side(len(tracks), room)
    captions = [None] * len(tracks)
    if legend is not None:
        captions = [Caption(*each, speed, over=over) for each in zip(tracks, drawn, boxes, names, strict=True)]
    strip = max(0 if one is None or over else one.height for one in captions)
    if min(box.height for box in boxes) - strip < LEAST:
        raise InputError(f"size: got {size[0]} x {size[1]}, which captions fill, want more, or overlays without them")
    with contextlib.ExitStack() as stack:
        parts: list[Part] = []
        for track, box, overlay, told in zip(tracks, boxes, drawn, captions, strict=True):
            track.model.vis.quality.shadowsize, track.model.vis.quality.offsamples = look.shadows, look.samples
            # Lines are boxes, whose sides one quadrilateral does for, with the sun far away; MuJoCo takes 16.
            track.model.vis.quality.numquads = 1
            panes = _panes(Box(0, strip, box.width, box.height - strip), len(insets))
            views = [
                (pane, shot(name, track, pane.aspect)) for name, pane in zip((camera, *insets), panes, strict=True)
            ]
            staged = stack.enter_context(stage(track, overlay, views, (box.width, box.height)))
            parts.append(Part(track, box, views, overlay, staged, told))
        places = tuple(
            Pane(part.box.left + box.left, part.box.top + box.top, box.width, box.height, *which, view.camera)
            for part, which in zip(parts, shown, strict=True)
            for box, view in part.views
        )
        yield Picture(distinct, parts, places, size, legend)


class Picture:
    """All runs at any moment.

    Attributes:
      runs: the rollouts that are shown, each once. panes: what is where. size: width and height in pixels.
      end: seconds until the last of them ends.
    """

    def __init__(
        self,
        runs: Sequence[Rollout],
        parts: Sequence[Part],
        panes: tuple[Pane, ...],
        size: tuple[int, int],
        legend: Legend | None,
    ) -> None:
        self.runs, self.parts, self.panes, self.size, self.legend = runs, parts, panes, size, legend
        self.end = max(part.track.end for part in parts)

    @property
    def markers(self) -> tuple[float, ...]:
        """Radii in metres of the marks that the runs' robots wear in calibrated panes."""
        return tuple(marker.radius(run) for run in self.runs)

    def draw(self, time: float, *, fade: float = 1.0, earlier: Iterable[float] = ()) -> Pixels:
        """The picture (height, width, 3) at `time`, with the robot also where it was earlier.

        Args:
          fade: the most by which opacities may change since the picture before.
        """
        earlier = list(earlier)
        image = np.empty((self.size[1], self.size[0], 3), dtype=np.uint8)
        for part in self.parts:
            box, now = part.box, min(time, part.track.end)
            area = image[box.top : box.top + box.height, box.left : box.left + box.width]
            area[:] = part.stage.draw(now, fade=fade, earlier=earlier)
            area[: part.views[0][0].top] = BLANK
            for pane, _ in part.views[1:]:
                _edge(area, pane)
            if part.told is not None:
                part.told.draw(area, now)
            _edge(image, box)
        if self.legend is not None:
            self.legend.draw(image)
        return image


def _checked_size(size: Any) -> tuple[int, int]:
    pixels = check_items("size", size, object, "a width and a height in pixels", at_most=2)
    if len(pixels) != 2:
        raise InputError(f"size: got {excerpt(size)}, want a width and a height in pixels")
    width, height = (check_count("size", one, at_least=64, at_most=LARGEST) for one in pixels)
    if width % 2 or height % 2:
        raise InputError(f"size: got {width} x {height}, want even numbers, which h264 needs")
    return width, height


def _shown(
    runs: Rollout | Sequence[Rollout], trial: int | Sequence[int]
) -> tuple[list[Rollout], list[tuple[int, int]]]:
    """The rollouts, each once, and which run and trial each part of the picture shows."""
    if isinstance(runs, Rollout):
        rows: tuple[Any, ...] = (trial,)
        if isinstance(trial, Sequence) and not isinstance(trial, str):
            rows = check_items("trial", trial, object, f"1 to {RUNS} of them", at_most=RUNS)
        distinct, shown = [runs], [(0, row) for row in rows]
    else:
        distinct = list(check_items("runs", runs, Rollout, f"a Rollout, or 1 to {RUNS} of them", at_most=RUNS))
        shown = list(enumerate(_one_each("trial", trial, distinct)))
    if not 1 <= len(shown) <= RUNS:
        raise InputError(f"runs: got {len(shown)} to show, want 1 to {RUNS}")
    return distinct, shown


def _one_each(field: str, given: Any, of: Sequence[object]) -> list[Any]:
    """What is given once for all, or once for each of them."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        return [given] * len(of)
    if len(given) != len(of):
        raise InputError(f"{field}: got {len(given)}, want one for each of {len(of)} runs")
    return list(given)


def _side_by_side(count: int, size: tuple[int, int]) -> list[Box]:
    """Equal parts of the picture, in rows of three at most."""
    columns = count if count <= 3 else -(-count // 2)
    rows = -(-count // columns)
    x = [2 * round(size[0] * column / columns / 2) for column in range(columns + 1)]
    y = [2 * round(size[1] * row / rows / 2) for row in range(rows + 1)]
    places = [(number % columns, number // columns) for number in range(count)]
    return [Box(x[i], y[j], x[i + 1] - x[i], y[j + 1] - y[j]) for i, j in places]


def _panes(box: Box, insets: int) -> list[Box]:
    """The first pane and those of insets: in a column on its right, or in a row below it if that is longer."""
    wide = box.width >= box.height
    length, across = (box.width, box.height) if wide else (box.height, box.width)
    edge = 2 * round(length * (1 - SHARE) / 2) if insets else length
    cuts = [2 * round(across * number / max(insets, 1) / 2) for number in range(insets + 1)]
    if wide:
        first = Box(box.left, box.top, edge, box.height)
        return [first, *(Box(edge, box.top + i, length - edge, j - i) for i, j in pairwise(cuts))]
    first = Box(box.left, box.top, box.width, edge)
    return [first, *(Box(i, box.top + edge, j - i, length - edge) for i, j in pairwise(cuts))]


def _edge(image: Pixels, box: Box) -> None:
    """A line along the left and the upper side of a box, but for those of the picture."""
    if box.left:
        image[box.top : box.top + box.height, box.left] = LINE
    if box.top:
        image[box.top, box.left : box.left + box.width] = LINE

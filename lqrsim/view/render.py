"""Videos and stills of executed runs, drawn offscreen by MuJoCo from a `Rollout` alone.

A video is h264 in an mp4 that browsers can stream, or a looping GIF. The comment of an mp4 has its metadata: the runs
that it shows, the times, and the cameras.
"""

import collections
import contextlib
import json
import os
import re
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from html import escape
from pathlib import Path
from typing import Annotated

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import Colorspace
from PIL import Image

from lqrsim.annotations import Bounds, Count, Line, Positive, Progress, checked
from lqrsim.errors import Array, InputError, check_number, check_path, excerpt
from lqrsim.results.archive import excerpt_of, parse, replacing, sha256
from lqrsim.results.certified import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.results.save_load import record_from, tree_of
from lqrsim.results.solution import Solution
from lqrsim.view.options import OVERLAYS, Overlay, Quality
from lqrsim.view.picture import MOST_ROBOTS, QUALITIES, Pane, Pixels, open_picture

FORMAT, VERSION = "lqrsim footage", 1
QUEUE_LENGTH = 3  # largest number of frames that wait to be encoded
COLOURS = 192  # number of colours of a GIF


@checked
@dataclass(frozen=True)
class VideoMetadata:
    """The content of a video. Frame k shows a run `k / rate * speed` seconds after its start."""

    runs: tuple[Line, ...]  # digests of the rollouts
    markers: tuple[Positive, ...]  # radius in metres of each robot's mark in panes with a camera; see `draw_mark`
    rate: Fraction  # frames per second
    speed: Positive
    frames: Count
    panes: tuple[Pane, ...]

    def __post_init__(self) -> None:
        fits = self.rate > 0 and len(self.markers) == len(self.runs)
        if not (fits and all(pane.run < len(self.runs) for pane in self.panes)):
            raise InputError(f"VideoMetadata: got {excerpt(vars(self))}, whose parts do not fit together")

    def as_json(self) -> str:
        """The metadata as JSON, for `from_json`."""
        return json.dumps({"format": FORMAT, "version": VERSION, **tree_of(self, "", {}), "rate": str(self.rate)})

    @classmethod
    def from_json(cls, text: str) -> "VideoMetadata":
        """The metadata of `as_json`. Raises InputError for anything else, and for another version."""
        try:
            parts = parse(text)
        except ValueError:
            parts = None
        if not isinstance(parts, dict) or parts.get("format") != FORMAT:
            raise InputError("video metadata: got none, want a video of `lqrsim render`")
        if parts.get("version") != VERSION:
            got = parts.get("version")
            raise InputError(f"video metadata: got version {got}, want version {VERSION}: render the video again")
        rate = re.fullmatch(r"([0-9]{1,9})(?:/([1-9][0-9]{0,8}))?", str(parts.get("rate")))  # as `Fraction` prints it
        if rate is None:
            raise InputError(
                f"video metadata: got {excerpt(parts.get('rate'))} as its rate, which is damaged, want 30/1"
            )
        tree = {name: part for name, part in parts.items() if name not in ("format", "version")}
        return record_from(cls, tree | {"rate": Fraction(int(rate[1]), int(rate[2] or 1))}, "metadata", {})

    def times(self) -> np.ndarray:
        """Times of the frames in seconds after the start of a run, (frames,)."""
        return np.arange(self.frames) * (self.speed / float(self.rate))


def read_metadata(path: str | os.PathLike[str]) -> VideoMetadata:
    """The metadata of a video. Raises InputError if lqrsim did not write it."""
    path = check_path("video", path)
    if not os.path.isfile(path):  # not the method of Path, which raises if a folder cannot be read
        raise InputError(f"video: got {excerpt_of(path)}, want a file that exists")
    try:
        with av.open(str(path)) as container:
            text = container.metadata.get("comment", "")
    except UnicodeDecodeError:  # PyAV before 19 reads no comments of other encodings
        text = ""
    except (FFmpegError, OSError) as error:
        raise InputError(f"video: got {path}, want one that can be read ({error})") from None
    return VideoMetadata.from_json(text)


@checked
def digest(rollout: Rollout) -> str:
    """Hash of a rollout, from its plan, states, controls, seed and first trial."""
    parts: list[str | Array] = [f"{rollout.robot} {rollout.scene} {rollout.seed} {rollout.first_trial}"]
    for array in (rollout.plan.states, rollout.plan.controls, rollout.states, rollout.applied):
        parts += [f"{array.shape}", np.asarray(array, dtype=np.float64)]
    return sha256(*parts)[:16]


@contextlib.contextmanager
def encoder(
    path: Path, size: tuple[int, int], rate: Fraction, *, crf: int, preset: str, metadata: VideoMetadata | None = None
) -> Iterator[Callable[[Pixels], None]]:
    """A function that appends a frame (height, width, 3), which must not change afterwards."""
    path.write_bytes(bytes(4096))  # FFmpeg crashes on a disk that is so full that it cannot even write its header
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        if metadata is not None:
            container.metadata["comment"] = metadata.as_json()  # before the first frame
        stream = container.add_stream("libx264", rate=rate, options={"preset": preset, "crf": str(crf)})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        # If the file states no colour matrix, players guess one, and not all guess the same.
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = 1

        def encode(pixels: Pixels) -> None:
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)))

        with _on_another_thread(encode) as put:
            yield put
        container.mux(stream.encode())


@contextlib.contextmanager
def gif(path: Path, rate: Fraction, samples: Sequence[Pixels]) -> Iterator[Callable[[Pixels], None]]:
    """Like `encoder`, for a GIF, with one palette from the samples, so that colours do not flicker."""
    # Maximum coverage keeps rare colours, such as the colours of lines.
    palette = Image.fromarray(np.vstack(samples)).quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=2)
    frames: list[Image.Image] = []

    def encode(pixels: Pixels) -> None:
        frames.append(Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE))

    with _on_another_thread(encode) as put:
        yield put
    # A GIF counts in hundredths of a second: durations are rounded so that the sum keeps time.
    ends = [round(100 * (number + 1) / rate) for number in range(len(frames))]
    durations = (10 * np.diff([0, *ends])).tolist()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False)


@contextlib.contextmanager
def _on_another_thread(work: Callable[[Pixels], None]) -> Iterator[Callable[[Pixels], None]]:
    """A function that hands frames to `work` on another thread, in order, while the caller draws the next."""
    waiting: collections.deque[Future[None]] = collections.deque()

    def put(pixels: Pixels) -> None:
        if len(waiting) == QUEUE_LENGTH:
            waiting.popleft().result()  # raises the exception of `work`, if any
        waiting.append(executor.submit(work, pixels))

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="encoder") as executor:
        yield put
        for encoded in waiting:
            encoded.result()


FADE_SECONDS = 0.25
MOST_FRAMES = 1_000_000  # largest number of frames of a video
FASTEST_GIF = 50  # frames per second; shorter frames than two hundredths of a second are shown for a tenth
SMALLEST_GIF = 480, 270  # pixels, smallest default size, so that captions can be read
PALETTE_SAMPLES = 12  # number of frames from which the palette of a GIF is made
LARGEST_SHOWN = 30_000_000  # bytes of a file that is embedded in a notebook; larger files make it slow
MEDIA_TYPES = {".mp4": "video/mp4", ".gif": "image/gif", ".png": "image/png"}


class PictureFile(type(Path())):  # a Path of this system: before Python 3.12 a subclass of Path itself does not work
    """A Path that shows the file's content in a notebook."""

    def _repr_html_(self) -> str | None:
        kind = MEDIA_TYPES.get(self.suffix.lower())
        if kind is None or not self.is_file():
            return None
        if (size := self.stat().st_size) > LARGEST_SHOWN:
            return f"<div>{escape(str(self))}: {size / 1e6:.0f} MB, too large to show here</div>"
        data = f"data:{kind};base64,{b64encode(self.read_bytes()).decode()}"
        if kind.startswith("video"):
            return f'<video controls="" loop="" style="max-width:100%" src="{data}"></video>'
        return f'<img alt="{escape(self.name)}" style="max-width:100%" src="{data}"/>'


@checked
def render(
    runs: Rollout | Sequence[Rollout],
    path: str | os.PathLike[str],
    *,
    trial: int | Sequence[int] = 0,
    camera: str = "overview",
    insets: Sequence[str] = (),
    titles: Sequence[str] = (),
    overlays: Sequence[Overlay] = OVERLAYS,
    solution: Solution | Sequence[Solution | None] | None = None,
    funnel: Funnel | Sequence[Funnel | None] | None = None,
    quality: Quality = "standard",
    size: tuple[int, int] | None = None,
    fps: Annotated[float, Bounds(at_least=0.1, at_most=240)] | None = None,
    speed: Annotated[float, Bounds(at_least=1e-3, at_most=1000)] = 1.0,
    time: float | None = None,
    every: float | None = None,
    progress: Progress | None = None,
) -> PictureFile:
    """Write a video of a run, or of several runs side by side, mp4 (h264) or GIF; or a still of them, png.

    Obstacles between a camera and the robot fade. A trial that diverged stands still from then on. The file is complete
    or absent, even after an error or Ctrl-C. The same runs give bit-identical frames. By the metadata of an mp4
    `verify_video` can measure it.

    Args:
      trial: row of the rollout; several rows are shown side by side. With several rollouts, one row for all or one for
        each.
      camera: `overview`, `chase`, or the calibrated `top` and `side`, in any scene; or another camera of the model.
      insets: more cameras, in panes next to the first. In panes of `top` and `side` robots have a green mark.
      overlays: what is drawn over the scene, of `view.OVERLAY_KINDS`.
      solution: the solution that was run, for `cost_tube`; one for all runs, or one for each.
      funnel: a funnel about the plan of the run, in the same way.
      quality: of size, edges, shadows, and compression of the video.
      size: width and height in pixels, both even; by default the quality's, or half for a GIF (at least 480 x 270).
      fps: frames per second, independent of the rate of `rollout.frame_times`; 30 by default, and 15 for a GIF, which
        has at most 50.
      speed: seconds of the run per second of the video.
      time: of a still, seconds after the start; by default the end.
      every: of a still, seconds; the robot is also drawn at each multiple of it, as in the paper's figures.

    Returns:
      The path. A notebook shows the video or the still if the call is a cell's last expression.
    """
    path = check_path("path", path, suffixes=MEDIA_TYPES)
    kind = path.suffix.lower()
    still, animated = kind == ".png", kind == ".gif"
    if not still and (time is not None or every is not None):
        raise InputError(f"time, every: got {excerpt(path.name)}, want FILE.png: they belong to stills")
    if still and (fps is not None or speed != 1.0):
        raise InputError(f"fps, speed: got {excerpt(path.name)}, want FILE.mp4 or FILE.gif: they belong to videos")
    rate = Fraction((15 if animated else 30) if fps is None else fps).limit_denominator(1001)
    if animated and rate > FASTEST_GIF:
        raise InputError(f"fps: got {float(rate):g}, want at most {FASTEST_GIF} for a GIF, which plays slowly beyond")
    if animated and size is None:
        width, height = (side // 2 for side in QUALITIES[quality].size)
        size = max(width, SMALLEST_GIF[0]), max(height, SMALLEST_GIF[1])
    opened = open_picture(
        runs, trial=trial, camera=camera, insets=insets, titles=titles, overlays=overlays, solution=solution,
        funnel=funnel, quality=quality, size=size, speed=1.0 if still else speed,
    )  # fmt: skip
    with replacing(path) as unfinished, opened as drawn:
        if still:
            time = drawn.end if time is None else check_number("time", time, at_least=0, at_most=drawn.end)
            earlier = list[float]()
            if every is not None:  # no more robots than can be told apart
                earlier = np.arange(0, time, check_number("every", every, at_least=drawn.end / MOST_ROBOTS)).tolist()
            Image.fromarray(drawn.draw(time, earlier=earlier)).save(unfinished)
            return PictureFile(path)
        count = int(drawn.end / speed * rate + 1e-9) + 1
        if count > MOST_FRAMES:
            frames = f"{count} frames, want at most {MOST_FRAMES}"
            raise InputError(f"speed, fps: got {speed:g} and {float(rate):g}, which are {frames}")
        if animated:
            samples = [drawn.draw(time) for time in np.linspace(0, drawn.end, min(PALETTE_SAMPLES, count))]
            writer = gif(unfinished, rate, samples)
        else:
            settings = QUALITIES[quality]
            digests = tuple(digest(run) for run in drawn.runs)
            metadata = VideoMetadata(digests, drawn.markers, rate, speed, count, drawn.panes)
            writer = encoder(unfinished, drawn.size, rate, crf=settings.crf, preset=settings.preset, metadata=metadata)
        with writer as encode:
            for number in range(count):
                fade = 1.0 if number == 0 else float(1 / (FADE_SECONDS * rate))
                encode(drawn.draw(float(number / rate) * speed, fade=fade))
                if progress:
                    progress(number + 1, count)
    return PictureFile(path)

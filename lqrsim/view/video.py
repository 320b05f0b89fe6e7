"""Video files from frames: h264 in an mp4 that browsers can stream, or a looping GIF."""

import collections
import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import Colorspace
from PIL import Image

from lqrsim.view.text_tiles import Pixels
from lqrsim.view.video_metadata import VideoMetadata

QUEUE_LENGTH = 3  # frames that wait to be encoded, at most
COLOURS = 192  # of a GIF


@contextlib.contextmanager
def encoder(
    path: Path, size: tuple[int, int], rate: Fraction, *, crf: int, preset: str, metadata: VideoMetadata | None = None
) -> Iterator[Callable[[Pixels], None]]:
    """A function that appends a frame (height, width, 3), which must not change afterwards.

    Args:
      size: width and height.
      rate: frames a second.
      crf, preset: x264's settings of quality and compression.
      metadata: embedded in the file.
    """
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        if metadata is not None:
            metadata.embed(container)
        stream = container.add_stream("libx264", rate=rate, options={"preset": preset, "crf": str(crf)})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        # Without a stated colour matrix players guess differently.
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = 1

        def encode(pixels: Pixels) -> None:
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)))

        with _on_another_thread(encode) as put:
            yield put
        container.mux(stream.encode())


@contextlib.contextmanager
def gif(path: Path, rate: Fraction, samples: Sequence[Pixels]) -> Iterator[Callable[[Pixels], None]]:
    """As `encoder`, for a GIF, with one palette from the samples, so that colours do not flicker."""
    # Maximum coverage keeps rare colours, such as those of lines.
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
            waiting.popleft().result()  # raises what `work` did
        waiting.append(executor.submit(work, pixels))

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="encoder") as executor:
        yield put
        for one in waiting:
            one.result()

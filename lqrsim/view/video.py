"""Frames to h264 in an mp4 that browsers play while they load it."""

import contextlib
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
from av.video.reformatter import Colorspace

from lqrsim.view.caption import Pixels


@contextlib.contextmanager
def encoder(path: Path, size: tuple[int, int], rate: Fraction) -> Iterator[Callable[[Pixels], None]]:
    """A function that appends a frame (height, width, 3); `size` is width and height, `rate` frames a second."""
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"preset": "veryfast", "crf": "20"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        # Say which matrix makes RGB of the pixels; players guess differently when it is left open.
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = 1

        def encode(pixels: Pixels) -> None:
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)))

        yield encode
        container.mux(stream.encode())

"""Faults of a video, for whoever verifies it to find: made in its frames, or in what its file says of itself.

Each reads one file and writes another; frames are decoded, changed and encoded again, one by one.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from lqrsim.view import video_metadata
from lqrsim.view.cameras import Camera
from lqrsim.view.video import encoder
from lqrsim.view.video_metadata import Pane, VideoMetadata

Pixels = npt.NDArray[np.uint8]
Fault = Callable[[Path, Path], None]

OFF = 0.02  # metres, of a camera


def decoded(path: Path) -> Iterator[Pixels]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)


def write(
    path: Path,
    frames: Iterable[Pixels],
    metadata: VideoMetadata,
    *,
    rate: Fraction | None = None,
    preset: str = "veryfast",
) -> None:
    """Encodes frames as `render` does; `metadata` is what the file says of itself, whether or not it is true."""
    frames = iter(frames)
    first = next(frames)
    height, width, _ = first.shape
    with encoder(path, (width, height), rate or metadata.rate, crf=18, preset=preset, metadata=metadata) as encode:
        for frame in chain([first], frames):
            encode(frame)


def with_metadata(source: Path, path: Path, metadata: VideoMetadata) -> None:
    """The same frames, to the last bit, in a file that says something else of itself."""
    with av.open(str(source)) as given, av.open(str(path), "w", format="mp4") as container:
        metadata.embed(container)
        stream = container.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:  # the last one only says that there are no more
                packet.stream = stream
                container.mux(packet)


# -- In the frames


def late(source: Path, path: Path) -> None:
    """Each frame comes one later; the first stays."""

    def frames() -> Iterator[Pixels]:
        before = None
        for frame in decoded(source):
            yield frame if before is None else before
            before = frame

    write(path, frames(), video_metadata.read(source))


def dropped(source: Path, path: Path) -> None:
    """The middle one is missing, and the file gives the number of those that are left."""
    metadata = video_metadata.read(source)
    frames = (frame for number, frame in enumerate(decoded(source)) if number != metadata.frames // 2)
    write(path, frames, dataclasses.replace(metadata, frames=metadata.frames - 1))


def swapped(source: Path, path: Path) -> None:
    """The middle one comes after the next."""
    metadata = video_metadata.read(source)

    def frames() -> Iterator[Pixels]:
        held = []
        for number, frame in enumerate(decoded(source)):
            if number == metadata.frames // 2:
                held = [frame]
            else:
                yield frame
                yield from held
                held = []

    write(path, frames(), metadata)


def mirrored(source: Path, path: Path) -> None:
    """The first calibrated pane, from left to right."""
    metadata = video_metadata.read(source)
    pane, _ = calibrated(metadata)[0]
    rows, columns = slice(pane.top, pane.top + pane.height), slice(pane.left, pane.left + pane.width)

    def frames() -> Iterator[Pixels]:
        for frame in decoded(source):
            frame[rows, columns] = frame[rows, columns][:, ::-1].copy()
            yield frame

    write(path, frames(), metadata)


# -- In what the file says of itself


def off(view: str, axis: int) -> Fault:
    """The camera of that name is 2 cm from where the file says that it is."""

    def moved(pane: Pane) -> Pane:
        if pane.camera is None or pane.camera.name != view:
            return pane
        position = np.array(pane.camera.position) + OFF * np.eye(3)[axis]
        return dataclasses.replace(pane, camera=dataclasses.replace(pane.camera, position=tuple(position.tolist())))

    def fault(source: Path, path: Path) -> None:
        metadata = video_metadata.read(source)
        with_metadata(source, path, dataclasses.replace(metadata, panes=tuple(moved(pane) for pane in metadata.panes)))

    return fault


def forged(digest: str) -> Fault:
    """The file says that it shows the run of that digest."""

    def fault(source: Path, path: Path) -> None:
        with_metadata(source, path, dataclasses.replace(video_metadata.read(source), runs=(digest,)))

    return fault


def calibrated(metadata: VideoMetadata) -> list[tuple[Pane, Camera]]:
    """The panes that can be measured, and what they are seen through."""
    return [(pane, pane.camera) for pane in metadata.panes if pane.camera is not None]

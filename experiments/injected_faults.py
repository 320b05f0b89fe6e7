"""Faults of a video that verification should find: in its frames, or in its metadata.

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

from lqrsim.view.cameras import Camera
from lqrsim.view.picture import Pane
from lqrsim.view.render import VideoMetadata, encoder, read_metadata

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
    """Encode frames as `render` does, with this metadata, true or not."""
    frames = iter(frames)
    first = next(frames)
    height, width, _ = first.shape
    with encoder(path, (width, height), rate or metadata.rate, crf=18, preset=preset, metadata=metadata) as encode:
        for frame in chain([first], frames):
            encode(frame)


def with_metadata(source: Path, path: Path, metadata: VideoMetadata) -> None:
    """Copy the frames, to the last bit, into a file with other metadata."""
    with av.open(str(source)) as given, av.open(str(path), "w", format="mp4") as container:
        container.metadata["comment"] = metadata.as_json()
        stream = container.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:  # the last one only says that there are no more
                packet.stream = stream
                container.mux(packet)


# -- In the frames


def late(source: Path, path: Path) -> None:
    """Delay all frames by one; the first is repeated."""

    def frames() -> Iterator[Pixels]:
        before = None
        for frame in decoded(source):
            yield frame if before is None else before
            before = frame

    write(path, frames(), read_metadata(source))


def dropped(source: Path, path: Path) -> None:
    """Drop the middle frame; the metadata counts the frames that are left."""
    metadata = read_metadata(source)
    frames = (frame for number, frame in enumerate(decoded(source)) if number != metadata.frames // 2)
    write(path, frames, dataclasses.replace(metadata, frames=metadata.frames - 1))


def swapped(source: Path, path: Path) -> None:
    """Swap the middle frame with the next."""
    metadata = read_metadata(source)

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
    """Mirror the first calibrated pane."""
    metadata = read_metadata(source)
    pane, _ = calibrated(metadata)[0]
    rows, columns = slice(pane.top, pane.top + pane.height), slice(pane.left, pane.left + pane.width)

    def frames() -> Iterator[Pixels]:
        for frame in decoded(source):
            frame[rows, columns] = frame[rows, columns][:, ::-1].copy()
            yield frame

    write(path, frames(), metadata)


# -- In the metadata


def off(view: str, axis: int) -> Fault:
    """Shift a camera in the metadata by 2 cm along an axis."""

    def moved(pane: Pane) -> Pane:
        if pane.camera is None or pane.camera.name != view:
            return pane
        position = np.array(pane.camera.position) + OFF * np.eye(3)[axis]
        return dataclasses.replace(pane, camera=dataclasses.replace(pane.camera, position=tuple(position.tolist())))

    def fault(source: Path, path: Path) -> None:
        metadata = read_metadata(source)
        with_metadata(source, path, dataclasses.replace(metadata, panes=tuple(moved(pane) for pane in metadata.panes)))

    return fault


def forged(digest: str) -> Fault:
    """Claim in the metadata that the file shows the run of this digest."""

    def fault(source: Path, path: Path) -> None:
        with_metadata(source, path, dataclasses.replace(read_metadata(source), runs=(digest,)))

    return fault


def calibrated(metadata: VideoMetadata) -> list[tuple[Pane, Camera]]:
    """Panes with a calibrated camera, and these cameras."""
    return [(pane, pane.camera) for pane in metadata.panes if pane.camera is not None]

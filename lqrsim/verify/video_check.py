"""Verification of a run from its video."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from av.error import FFmpegError

from lqrsim.errors import Array, InputError, check_count, check_kind
from lqrsim.results import save_load
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.verify import ground_truth, pixels
from lqrsim.verify.ground_truth import Progress
from lqrsim.verify.verdict import Criterion, Positions, Verification, compare
from lqrsim.view import video_metadata
from lqrsim.view.cameras import Camera
from lqrsim.view.video_metadata import Pane, VideoMetadata

POSITION_BOUND = 1 / 35  # largest error, in radii of the robot: 8.6 and 4.9 mm for the packaged ones
RECORD_BOUND = 1 / 350  # largest distance between frames and states, in radii of the robot


def run_beside(path: str | os.PathLike[str]) -> Path:
    """The file, in the folder of a video, of the rollout that it shows. Raises InputError if there is none."""
    metadata, folder = video_metadata.read(path), Path(path).parent
    for found in sorted(folder.glob("*.npz")):
        with contextlib.suppress(InputError):  # a solution, or what is damaged
            if video_metadata.digest(save_load.load(found, Rollout)) in metadata.runs:
                return found
    raise InputError(f"run: got none, and none in {folder} is what the video says it shows, want the run's file")


def verify_video(
    path: str | os.PathLike[str],
    rollout: Rollout,
    *,
    trial: int | None = None,
    solution: Solution | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Reads positions from a video's pixels, by the mark in its calibrated panes, and compares them with a rollout.

    Args:
      path: what `lqrsim render` wrote with the camera `top`, for robots in a vertical plane `side`, and for those that
        move in space both, whatever else is in the picture.
      rollout: the run that the video shows.
      trial: row of the rollout; by default the first that the video shows.
      solution: as for `verify_run`.
      progress: as for `verify_run`.

    Raises:
      InputError: the file is not lqrsim's, or has not the panes that it takes.
    """
    ground_truth.check_arguments(solution, progress)
    check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
    trial = None if trial is None else check_count("trial", trial, at_least=0)
    metadata, plane = video_metadata.read(path), rollout.plane
    digest = video_metadata.digest(rollout)
    run = metadata.runs.index(digest) if digest in metadata.runs else 0
    panes = [pane for pane in metadata.panes if pane.run == run and pane.camera is not None]
    trial = (panes[0].trial if panes and panes[0].trial < rollout.trials else 0) if trial is None else trial
    panes = [pane for pane in panes if pane.trial == trial] if digest in metadata.runs else panes
    views = [pane.camera for pane in panes if pane.camera is not None]
    pixels.triangulate(views, np.zeros((0, len(views), 2)), plane)  # says what is missing before it takes any time
    model, radius = ground_truth.drawable_model(rollout, trial), metadata.markers[run]
    measured: list[list[Array]] = []
    off = 0.0  # seconds between when a frame is shown and when it should be, at most
    for time, image in _decoded(path):
        off = max(off, abs(time - len(measured) / float(metadata.rate)))
        measured.append([_measure_marker(image, pane, view, radius) for pane, view in zip(panes, views, strict=True)])
        if progress:
            progress(len(measured), metadata.frames)
    count = min(len(measured), metadata.frames)
    times = metadata.times()[:count]
    seen, apart = pixels.triangulate(views, measured[:count], plane)
    positions = Positions(
        times,
        seen=seen,
        actual=ground_truth.frame_positions(rollout, trial, model, times),
        planned=ground_truth.planned_positions(rollout, times),
        apart=apart,
    )
    areas = [np.pi * (radius * pane.height / view.height) ** 2 for pane, view in zip(panes, views, strict=True)]
    others = (
        *_check_file(metadata, digest, len(measured), off, min(areas)),
        ground_truth.check_record(rollout, trial, model, RECORD_BOUND * rollout.radius),
        ground_truth.check_plan(rollout, solution),
    )
    named = " and ".join(f"{view.name} ({pane.width} x {pane.height})" for pane, view in zip(panes, views, strict=True))
    return compare(
        f"{Path(path).name}, {ground_truth.describe(rollout, trial)}",
        f"the green mark in its panes {named}",
        positions,
        bound=POSITION_BOUND * rollout.radius,
        interval=metadata.speed * (1 / float(metadata.rate)),
        others=others,
    )


def _check_file(metadata: VideoMetadata, digest: str, frames: int, off: float, area: float) -> tuple[Criterion, ...]:
    """Whether the video shows the run of that digest, with frames at their times and marks large enough.

    Args:
      frames: number of frames that were decoded.
      off: largest error of the time of a frame, in seconds.
      area: area of the smallest mark, in pixels.
    """
    return (
        Criterion(
            "run",
            digest in metadata.runs,
            f"the video shows {', '.join(metadata.runs)}, this run is {digest}",
        ),
        Criterion(
            "frames",
            frames == metadata.frames and off < 1 / float(metadata.rate) / 4,
            f"got {frames}, want the {metadata.frames} that were written; at most {1e3 * off:.1f} ms from their times",
        ),
        Criterion(
            "mark",
            area >= pixels.FEWEST_PIXELS,
            f"{area:.0f} pixels in the pane where it is smallest, want {pixels.FEWEST_PIXELS} or more",
        ),
    )


def _decoded(path: str | os.PathLike[str]) -> Iterator[tuple[float, npt.NDArray[np.uint8]]]:
    """Each frame (height, width, 3), and the time at which a player shows it, in seconds."""
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield frame.time or 0.0, np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
    except (FFmpegError, OSError, IndexError) as error:
        raise InputError(f"video: got {path}, want one that can be read ({error})") from None


def _measure_marker(image: npt.NDArray[np.uint8], pane: Pane, view: Camera, radius: float) -> Array:
    """The measurement (2,) of the mark of this radius in metres, in one view."""
    part = image[pane.top : pane.top + pane.height, pane.left : pane.left + pane.width]
    if part.shape[:2] != (pane.height, pane.width):
        raise InputError(f"video: got frames of {image.shape[1]} x {image.shape[0]}, want the size that lqrsim wrote")
    return view.measure(pixels.marker_centre(part, radius * pane.height / view.height), (pane.width, pane.height))

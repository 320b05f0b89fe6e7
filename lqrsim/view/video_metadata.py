"""Metadata of a video, in the comment of its file: the runs it shows, the times, and the cameras."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.error import FFmpegError

from lqrsim.errors import Array, InputError, check_count, check_kind, check_number, check_path, excerpt
from lqrsim.results.archive import sha256
from lqrsim.results.rollout import Rollout
from lqrsim.view.cameras import Camera

if TYPE_CHECKING:
    from av.container import OutputContainer

FORMAT, VERSION = "lqrsim footage", 1


@dataclass(frozen=True)
class Pane:
    """A part of the picture that shows one trial, in pixels from the upper left corner.

    Attributes:
      run: number of the rollout among the rollouts of the metadata.
      trial: row of the rollout.
      camera: the calibrated camera; None for other cameras.
    """

    left: int
    top: int
    width: int
    height: int
    run: int = 0
    trial: int = 0
    camera: Camera | None = None


@dataclass(frozen=True)
class VideoMetadata:
    """The content of a video. Frame k shows a run `k / rate * speed` seconds after its start.

    Attributes:
      runs: digests of the rollouts.
      markers: radius in metres of each robot's mark in panes with a camera; see `overlays.py`.
      rate: frames per second.
      speed: seconds of the run per second of the video.
      frames: number of frames.
    """

    runs: tuple[str, ...]
    markers: tuple[float, ...]
    rate: Fraction
    speed: float
    frames: int
    panes: tuple[Pane, ...]

    def as_json(self) -> str:
        """The metadata as JSON, for `from_json`."""
        panes = [vars(pane) | {"camera": pane.camera and pane.camera.as_json()} for pane in self.panes]
        parts = {"format": FORMAT, "version": VERSION, "runs": self.runs, "rate": str(self.rate), "speed": self.speed}
        parts |= {"frames": self.frames, "markers": self.markers, "panes": panes}
        return json.dumps(parts)

    @classmethod
    def from_json(cls, text: str) -> "VideoMetadata":
        """The metadata of `as_json`. Raises InputError for anything else, and for another version."""
        try:
            parts = json.loads(text)
        except ValueError:
            parts = None
        if not isinstance(parts, dict) or parts.get("format") != FORMAT:
            raise InputError("video metadata: got none, want a video of `lqrsim render`")
        if parts.get("version") != VERSION:
            got = parts.get("version")
            raise InputError(f"video metadata: got version {got}, want version {VERSION}: render the video again")
        try:
            metadata = cls(
                runs=tuple(str(run) for run in parts["runs"]),
                markers=tuple(check_number("metadata.markers", one, above=0) for one in parts["markers"]),
                rate=Fraction(parts["rate"]),
                speed=check_number("metadata.speed", parts["speed"], above=0),
                frames=check_count("metadata.frames", parts["frames"]),
                panes=tuple(_pane(one) for one in parts["panes"]),
            )
            good = metadata.rate > 0 and len(metadata.markers) == len(metadata.runs)
            good = good and all(pane.run < len(metadata.runs) for pane in metadata.panes)
        except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
            raise InputError(f"video metadata: got {excerpt(text)}, which is damaged ({error})") from None
        if not good:
            raise InputError(f"video metadata: got {excerpt(text)}, whose parts do not fit together")
        return metadata

    def times(self) -> np.ndarray:
        """Times of the frames in seconds after the start of a run, (frames,)."""
        return np.arange(self.frames) * (self.speed / float(self.rate))

    def embed(self, container: "OutputContainer") -> None:
        """Write the metadata into a video, before its first frame."""
        container.metadata["comment"] = self.as_json()


def read(path: str | os.PathLike[str]) -> VideoMetadata:
    """The metadata of a video. Raises InputError if lqrsim did not write it."""
    path = check_path("video", path)
    if not os.path.isfile(path):  # not the method of Path, which raises if a folder cannot be read
        raise InputError(f"video: got {path}, want a file that exists")
    try:
        with av.open(str(path)) as container:
            text = container.metadata.get("comment", "")
    except (FFmpegError, OSError) as error:
        raise InputError(f"video: got {path}, want one that can be read ({error})") from None
    return VideoMetadata.from_json(text)


def digest(rollout: Rollout) -> str:
    """Hash of a rollout, from its plan, states, controls, seed and first trial."""
    check_kind("rollout", rollout, Rollout, "a Rollout, such as simulate(...) returns")
    parts: list[str | Array] = [f"{rollout.robot} {rollout.scene} {rollout.seed} {rollout.first_trial}"]
    for array in (rollout.plan.states, rollout.plan.controls, rollout.states, rollout.applied):
        parts += [f"{array.shape}", np.asarray(array, dtype=np.float64)]
    return sha256(*parts)[:16]


def _pane(parts: Mapping[str, Any]) -> Pane:
    places = {key: check_count(f"pane.{key}", parts[key], at_least=0) for key in ("left", "top", "run", "trial")}
    sizes = {key: check_count(f"pane.{key}", parts[key]) for key in ("width", "height")}
    camera = parts["camera"]
    return Pane(**places, **sizes, camera=None if camera is None else Camera.from_json(camera))

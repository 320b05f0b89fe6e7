"""What a video says of itself, in the comment of its file: whose runs it shows, when, and through which cameras."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.error import FFmpegError

from lqrsim.errors import Array, InputError, check_count, check_kind, check_number, check_path
from lqrsim.results.hashing import sha256
from lqrsim.results.rollout import Rollout
from lqrsim.view.cameras import Camera

if TYPE_CHECKING:
    from av.container import OutputContainer

FORMAT, VERSION = "lqrsim footage", 1


@dataclass(frozen=True)
class Pane:
    """A part of the picture, in pixels from the upper left corner, that shows one trial.

    Attributes:
      run: number of the rollout among those of the metadata. trial: row of it.
      camera: which calibrated one it is seen through; None if it moves, or is of the scene.
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
    """What identifies a video: frame `number` shows the moment `number / rate * speed` seconds after a run's start.

    Attributes:
      runs: digests of the rollouts. markers: radius in metres of the ball that each one's robot wears in panes with a
        camera; see `decorative_geoms.py`.
      rate: frames a second. speed: seconds of the run in a second of the video. frames: how many there are.
    """

    runs: tuple[str, ...]
    markers: tuple[float, ...]
    rate: Fraction
    speed: float
    frames: int
    panes: tuple[Pane, ...]

    def as_json(self) -> str:
        """What `from_json` makes the same metadata of."""
        panes = [vars(pane) | {"camera": pane.camera and pane.camera.as_json()} for pane in self.panes]
        parts = {"format": FORMAT, "version": VERSION, "runs": self.runs, "rate": str(self.rate), "speed": self.speed}
        parts |= {"frames": self.frames, "markers": self.markers, "panes": panes}
        return json.dumps(parts)

    @classmethod
    def from_json(cls, text: str) -> "VideoMetadata":
        """Raises InputError unless it is what `as_json` gives, of this version."""
        try:
            parts = json.loads(text)
        except ValueError:
            parts = None
        if not isinstance(parts, dict) or parts.get("format") != FORMAT:
            raise InputError("video metadata: got none, want a video that `lqrsim render` wrote, with its metadata")
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
            raise InputError(f"video metadata: got {text[:40]}..., which is damaged ({error})") from None
        if not good:
            raise InputError(f"video metadata: got {text[:40]}..., which contradicts itself")
        return metadata

    def times(self) -> np.ndarray:
        """Seconds after the run's start that the frames show, (frames,)."""
        return np.arange(self.frames) * (self.speed / float(self.rate))

    def embed(self, container: "OutputContainer") -> None:
        """Writes it into a video that is being written; before its first frame."""
        container.metadata["comment"] = self.as_json()


def read(path: str | os.PathLike[str]) -> VideoMetadata:
    """What the video says of itself. Raises InputError if it is none that lqrsim wrote."""
    path = check_path("video", path)
    if not os.path.isfile(path):  # not the method, which raises where a folder cannot be read
        raise InputError(f"video: got {path}, want a file that exists")
    try:
        with av.open(str(path)) as container:
            text = container.metadata.get("comment", "")
    except (FFmpegError, OSError) as error:
        raise InputError(f"video: got {path}, want one that can be read ({error})") from None
    return VideoMetadata.from_json(text)


def digest(rollout: Rollout) -> str:
    """What tells a rollout from any other: a hash of its plan, states, controls, and where its draws came from."""
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

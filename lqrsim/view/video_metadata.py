"""Metadata of a video, in the comment of its file: the runs it shows, the times, and the cameras."""

import json
import os
import re
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from av.error import FFmpegError

from lqrsim.annotations import Count, Line, Positive, checked
from lqrsim.errors import Array, InputError, check_path, excerpt
from lqrsim.results.archive import excerpt_of, parse, sha256
from lqrsim.results.rollout import Rollout
from lqrsim.results.save_load import record_from, tree_of
from lqrsim.view.cameras import Camera
from lqrsim.view.options import Box

FORMAT, VERSION = "lqrsim footage", 1


@checked
@dataclass(frozen=True)
class Pane(Box):
    """A part of the picture that shows a row of one of the metadata's rollouts, with a camera if it is calibrated."""

    run: int = 0
    trial: int = 0
    camera: Camera | None = None


@checked
@dataclass(frozen=True)
class VideoMetadata:
    """The content of a video. Frame k shows a run `k / rate * speed` seconds after its start."""

    runs: tuple[Line, ...]  # digests of the rollouts
    markers: tuple[Positive, ...]  # radius in metres of each robot's mark in panes with a camera; see `geoms.py`
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


def read(path: str | os.PathLike[str]) -> VideoMetadata:
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

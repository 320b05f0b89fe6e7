"""Commands that show what was executed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lqrsim.commands.options import optional


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a run as an mp4 (h264, real time): obstacles, the plan, the trace actually driven, the robot."""

    rollout: Annotated[Positional[Path], arg(metavar="ROLLOUT")]
    """What `lqrsim simulate` wrote."""
    out: Annotated[Path | None, optional("FILE.mp4")] = None
    """The video. By default the rollout's path with .mp4 at its end."""
    trial: int = 0
    """Which row of the rollout, from 0."""
    camera: Annotated[str | None, optional("NAME")] = None
    """A camera of the scene. By default the one that shows the whole run."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (1280, 720)
    """In pixels."""
    fps: int = 30
    """Frames per second."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console, files
        from lqrsim.errors import InputError
        from lqrsim.view.render import render

        video = self.out or self.rollout.with_suffix(".mp4")
        if video.suffix != ".mp4":
            raise InputError(f"--out: got {video}, want a name that ends in .mp4")
        console.check_output("--out", video.parent)
        rollout = files.load_rollout(self.rollout)
        with console.progress("rendering", "frame") as progress:
            options = {"trial": self.trial, "camera": self.camera, "size": self.size, "fps": self.fps}
            render(rollout, video, progress=progress, **options)
        console.say(f"wrote {video}")
        return 0

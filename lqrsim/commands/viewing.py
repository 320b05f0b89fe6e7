"""Commands that show what was executed."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from lqrsim.commands.options import optional

if TYPE_CHECKING:
    from lqrsim.view.screen import Screen


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


@dataclass(frozen=True, kw_only=True)
class View:
    """Show a run, or a policy at work, in MuJoCo's own viewer: in a window, or without a display in a browser.

    lqrsim view RUN.npz plays what `lqrsim simulate` wrote. lqrsim view SCENARIO solves the scenario and runs its policy
    live, again and again, and you interfere: the arrow keys and Page Up and Down push the robot, seen from the camera;
    Ctrl and the right mouse button drag it. Space pauses, Backspace starts again.

    The browser's server can be reached from this machine only. Ctrl-C ends it.
    """

    what: Annotated[Positional[str], arg(metavar="RUN.npz|SCENARIO")]
    """What `lqrsim simulate` wrote, or a scenario as in `lqrsim solve`."""
    viewer: Literal["auto", "window", "browser"] = "auto"
    """auto: a window where there is a display."""
    port: int = 0
    """Of the browser's server. By default the first free one from 8080 on."""
    speed: float = 1.0
    """Of the time that is shown; 0.5 is half as fast as the real one."""
    seconds: Annotated[float | None, optional("SECONDS")] = None
    """Close after so long."""
    trial: int = 0
    """Which row of the run, from 0."""
    loop: bool = True
    """--no-loop stops at the end of the run."""
    disturbances: Annotated[float, arg(metavar="FACTOR")] = 0.0
    """What else goes wrong in a live run: the scenario's disturbances, so many times as strong."""
    seed: int = 0
    """Of their random draws."""
    push: Annotated[float, arg(metavar="M/S")] = 0.3
    """By how much a key changes the robot's velocity."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console, files
        from lqrsim.errors import check_count, check_number
        from lqrsim.references import resolve
        from lqrsim.view import viewer

        check_number("--speed", self.speed, at_least=0.01, at_most=100)
        check_number("--push", self.push, at_least=0)
        check_number("--disturbances", self.disturbances, at_least=0)
        check_count("--seed", self.seed, at_least=0)
        if self.seconds is not None:
            check_number("--seconds", self.seconds, above=0)
        kind = self.viewer if self.viewer != "auto" else "window" if viewer.has_display() else "browser"
        options = {"push": self.push, "speed": self.speed, "seconds": self.seconds}
        if self.what.endswith(".npz"):
            rollout = files.load_rollout(self.what)
            shown = viewer.of_rollout(rollout, self.trial)

            def go(screen: "Screen") -> None:
                viewer.play(rollout, screen, trial=self.trial, loop=self.loop)
        else:
            scenario = resolve(self.what)
            plant = scenario.plant()
            solution = console.solve(scenario.problem, "smooth")
            shown = viewer.of_plant(plant, solution)
            wrong = [one.scaled(self.disturbances) for one in scenario.disturbances if self.disturbances]

            def go(screen: "Screen") -> None:
                console.say(viewer.KEYS)
                viewer.live(plant, solution, screen, disturbances=wrong, seed=self.seed, ended=console.say)

        with viewer.open_viewer(kind, self.port, title=f"lqrsim {self.what}", **shown, **options) as screen:
            console.say(screen.where)
            with contextlib.suppress(KeyboardInterrupt):
                go(screen)
        return 0

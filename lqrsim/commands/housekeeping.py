"""Commands that run everything, and that look after what is kept."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Solve, execute and film: the main job, for both robots.

    Each is solved from a cold start with smooth(); its policy is run undisturbed and then disturbed; the solution, both
    rollouts, figures of the policy and of the runs, and a video are written.

    Exits with 1 if a plan did not converge or an undisturbed run leaves its plan by more than the scenario's bound.
    """

    robots: Annotated[tuple[str, ...], arg(metavar="SCENARIO ...")] = ("differential_drive", "quadrotor")
    """Scenarios, by the names that `lqrsim list` prints; settings follow after commas: quadrotor,query=3."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("videos")
    """Each scenario gets a folder in it."""
    seed: int = 0
    """Of the disturbances."""
    video: bool = True
    """--no-video leaves the videos out."""
    quick: bool = False
    """Smaller videos with fewer frames, for a first look."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim.commands.demo import demo

        return demo(self.robots, out=self.out, seed=self.seed, video=self.video, quick=self.quick)


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Run the paper's experiments, and say which of its statements hold.

    Writes results.md, which sums them up, results.json, which has every number, and the figures as png and pdf. Takes
    under an hour, most of it for robust_policies. Other people's solvers and controllers are compared with
    where the bench extra is installed.

    Exits with 1 if an experiment failed; whether the paper's statements hold does not count.
    """

    results: Annotated[Positional[tuple[str, ...]], arg(metavar="RESULT ...", help_behavior_hint="")] = ()
    """Which: figure_2, figure_3, table_1, convergence, state_dimension, state_of_the_art, feedback, stress_test,
    robust_policies, noise_aware. By default all."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper")
    """Where to write."""
    quick: bool = False
    """A small part of each, for a first look."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim.commands.reproduce import reproduce

        return reproduce(self.results, out=self.out, quick=self.quick)


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Show what is kept of compiled solvers, or remove it.

    That is code and derived formulas. Without it everything works the same, and each kind of problem is compiled again,
    some 10 seconds.

    What is kept is programs, which are loaded and run: do not share the folder with people you do not trust.
    """

    clear: bool = False
    """Remove all of it."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim.codegen import disk_cache
        from lqrsim.commands import console
        from lqrsim.errors import InputError

        if self.clear:
            try:
                console.say(f"removed {disk_cache.clear()} items from {disk_cache.folder()}")
            except OSError as error:
                raise InputError(
                    f"--clear: got {disk_cache.folder()}, want files that can be removed ({error})"
                ) from None
            return 0
        items = disk_cache.items()
        for item in items:
            used = time.strftime("%Y-%m-%d %H:%M", time.localtime(item.used))
            console.say(f"{item.size / 1e6:8.2f} MB  last used {used}  {item.what}")
        total = sum(item.size for item in items) / 1e6
        console.say(
            f"{len(items)} items, {total:.1f} of at most {disk_cache.LIMIT / 1e6:.0f} MB, in {disk_cache.folder()}"
        )
        return 0

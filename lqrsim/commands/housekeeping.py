"""Commands that run the demo and the paper's experiments, and that manage the cache."""

import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import Json


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Solve, simulate and render both robots.

    Each is solved with smooth(), and its policy is run undisturbed and then disturbed. Writes the solution, both
    rollouts, figures of the policy and of the runs, and a video.

    Exits with 1 if a plan did not converge or an undisturbed run leaves its plan by more than the scenario's bound.
    """

    robots: Annotated[tuple[str, ...], arg(metavar="SCENARIO ...")] = ("differential_drive", "quadrotor")
    """Scenarios, by their names in `lqrsim list`; settings follow after commas: quadrotor,query=3."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("videos")
    """Output folder, with a folder for each scenario."""
    seed: int = 0
    """Seed of the disturbances."""
    video: bool = True
    """--no-video skips the videos."""
    quick: bool = False
    """Smaller videos with fewer frames, for a first look."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.commands.demo import demo

        return demo(self.robots, out=self.out, seed=self.seed, video=self.video, quick=self.quick)


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Reproduce the paper's results and check its statements.

    Writes results.md with a summary, results.json with every number, and the figures as png and pdf. Takes some hours,
    the longest being robust_policies and solver_league. Includes other solvers and controllers with the extra
    bench, other simulators with rotorpy and crazyflow, and an emulated board with arm-none-eabi-gcc and
    qemu-system-arm. Programs that are not installed are skipped, and named.

    Exits with 1 if an experiment failed, whether or not the paper's statements hold.
    """

    results: Annotated[Positional[tuple[str, ...]], arg(metavar="RESULT ...", help_behavior_hint="")] = ()
    """Results: figure_2, figure_3, table_1, convergence, state_dimension, state_of_the_art, feedback, stress_test,
    robust_policies, noise_aware, funnels, solver_league, race, other_simulators, adaptive_quad_bench, export_c. By
    default all."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper")
    """Output folder."""
    quick: bool = False
    """Run a small part of each, for a first look."""
    keep: bool = False
    """Keep the other results of an earlier run in the folder, and write the page with all of them."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.commands.reproduce import reproduce

        return reproduce(self.results, out=self.out, quick=self.quick, keep=self.keep)


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Show or clear the cache of compiled solvers.

    The cache holds compiled code and derived formulas. Without it, the solver is compiled again for each number of
    states and controls, in two to five seconds.

    It holds programs, which are loaded and run: do not share the folder with people you do not trust.
    """

    clear: bool = False
    """Remove everything in it."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.codegen import disk_cache

        if self.clear:
            try:
                removed = disk_cache.clear()
                console.say(f"removed {removed} items from {disk_cache.folder()}")
                console.result(removed=removed, folder=disk_cache.folder())
            except OSError as error:
                raise ls.InputError(
                    f"--clear: got {disk_cache.folder()}, want files that can be removed ({error})"
                ) from None
            return 0
        items = disk_cache.items()
        together = itertools.groupby(sorted(items, key=lambda item: item.what), key=lambda item: item.what)
        for what, alike in sorted(((what, list(some)) for what, some in together), key=lambda one: -one[1][0].used):
            used = time.strftime("%Y-%m-%d %H:%M", time.localtime(alike[0].used))
            count = f" ({len(alike)} items)" if len(alike) > 1 else ""
            console.say(f"{sum(item.size for item in alike) / 1e6:8.2f} MB  last used {used}  {what}{count}")
        total = sum(item.size for item in items) / 1e6
        console.say(
            f"{len(items)} items, {total:.1f} of at most {disk_cache.LIMIT / 1e6:.0f} MB, in {disk_cache.folder()}"
        )
        listed = [{"what": item.what, "size": item.size, "used": item.used} for item in items]
        console.result(items=listed, limit=disk_cache.LIMIT, folder=disk_cache.folder())
        return 0

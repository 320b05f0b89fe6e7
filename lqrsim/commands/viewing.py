"""Commands for what was solved and run: to render and view it, to verify it from pixels, and to export it."""

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import (
    ControllerName,
    DesignSet,
    Json,
    SolutionFile,
    arguments_for,
    optional,
    options_of,
    refuse,
)
from lqrsim.view.options import DRAWN_BY, OVERLAY_KINDS, OVERLAYS, Overlay, Quality

if TYPE_CHECKING:
    from lqrsim.view.viewer import MovableGoal, Viewer


OVERLAY_HELP = "Drawn over the scene. " + " ".join(f"{name}: {kind.words}." for name, kind in OVERLAY_KINDS.items())
LIVE_OPTIONS = "controller", "design_disturbances", "solution", "replan", "disturbances", "seed", "push"
RECORDED_OPTIONS = "trial", "loop"


@dataclass(frozen=True, kw_only=True)
@options_of(
    "view/render.py", "render", camera="NAME", size="WIDTH HEIGHT", fps="RATE", speed="FLOAT", time="SECONDS",
    every="SECONDS",
)  # fmt: skip
class Render:
    """Render a run as a video or a still.

    Shows the obstacles, the plan, the path driven, the disturbing forces, and the robot. Several runs, or several
    trials of one run, are shown side by side and in step.

      lqrsim render runs/quadrotor/rollout.npz --camera chase
      lqrsim render RUN.npz --inset top side          # panes that `lqrsim verify` can measure
      lqrsim render CALM.npz SEVERE.npz --title calm severe --out both.mp4
      lqrsim render RUN.npz --out RUN.gif --speed 2
      lqrsim render RUN.npz --out RUN.png --every 0.5 --quality publication
      lqrsim render RUN.npz --out RUN.html            # one page with all trials, to send and to open in any browser
      lqrsim render RUN.npz --out RUN.rrd             # a recording for Rerun's viewer; needs lqrsim[rerun]
    """

    rollouts: Annotated[Positional[tuple[Path, ...]], arg(metavar="ROLLOUT ...", help_behavior_hint="")]
    """Files from `lqrsim simulate`."""
    out: Annotated[Path | None, optional("FILE")] = None
    """Output: FILE.mp4 (h264), FILE.gif, FILE.png for a still, FILE.html for a browser, or FILE.rrd for Rerun. By
    default the rollout's path with .mp4."""
    trial: Annotated[tuple[int, ...] | None, optional("N ...")] = None
    """Row of the rollout, from 0; several rows of one rollout, or one for each of several rollouts. By default 0, and
    all rows for FILE.html."""
    inset: Annotated[tuple[str, ...], optional("NAME ...")] = ()
    """More cameras, in panes beside the first. top and side are calibrated, and show a mark on the robot."""
    title: Annotated[tuple[str, ...], optional("TEXT ...")] = ()
    """Title of each run. By default the robot and the scene."""
    overlays: Annotated[tuple[Overlay, ...], arg(metavar="NAME ...", help=OVERLAY_HELP)] = OVERLAYS
    solution: Annotated[tuple[Path, ...], optional("SOLUTION ...")] = ()
    """Solution of the runs, one for all or one each, for cost_tube."""
    funnel: Annotated[tuple[Path, ...], optional("FUNNEL ...")] = ()
    """Funnel about the plan of the runs, one for all or one each, from `lqrsim funnel`."""
    quality: Quality = "standard"
    """Size, antialiasing, shadows and video compression: 640 x 360, 1280 x 720 or 1920 x 1080."""

    def run(self) -> int:
        from lqrsim.results.certified import Funnel
        from lqrsim.view import exports

        if not self.rollouts:
            raise ls.InputError("ROLLOUT: got none, want at least one that `lqrsim simulate` wrote")
        if not self.rollouts[0].name:  # "." and "/" are no files, and have none beside them
            raise ls.InputError(f"ROLLOUT: got {self.rollouts[0]}, a folder, want a file that `lqrsim simulate` wrote")
        out = self.out or self.rollouts[0].with_suffix(".mp4")
        self._check_options(out)
        console.check_output("--out", out, "file")
        runs = [ls.load(path, ls.Rollout) for path in self.rollouts]
        if self.overlays != OVERLAYS and "tube" in self.overlays:
            for path in (path for path, run in zip(self.rollouts, runs, strict=True) if run.tube is None):
                console.say(f"no tube in {path}: none was predicted for it")
        solution = _one_or_all([ls.load(path, ls.Solution) for path in self.solution])
        funnel = _one_or_all([ls.load(path, Funnel) for path in self.funnel])
        drawn, rows = _one_or_all(runs), 0 if self.trial is None else _one_or_all(self.trial)
        content = {"overlays": self.overlays, "solution": solution, "funnel": funnel}
        match out.suffix.lower():
            case ".html":
                exports.render_html(drawn, out, trial=self.trial, **content)
            case ".rrd":
                exports.write_rerun(drawn, out, trial=rows, funnel=funnel)
            case _:
                with console.Progress("rendering", "frame") as progress:
                    options = {**content, "trial": rows, "insets": self.inset, "titles": self.title}
                    ls.render(drawn, out, **arguments_for(ls.render, self, **options, progress=progress))
        console.wrote(out)
        return 0

    def _check_options(self, out: Path) -> None:
        """Raise InputError for another kind of file, or for options that do not belong to its kind."""
        kind = out.suffix.lower()
        for name, overlay in DRAWN_BY.items() if kind != ".rrd" else ():
            if overlay not in self.overlays:
                option = "title" if name == "titles" else name
                refuse(self, (option,), f"without {overlay} in --overlays, want it with that")
        if kind in (".mp4", ".gif", ".png"):
            return
        if kind not in (".html", ".rrd"):
            raise ls.InputError(f"--out: got {out}, want a name that ends in .mp4, .gif, .png, .html or .rrd")
        # Whoever opens such a file chooses the camera and the time.
        accepted = ["rollouts", "out", "trial", "funnel", *(["overlays", "solution"] if kind == ".html" else [])]
        refuse(self, vars(self).keys() - accepted, f"with {out.name}, want it with a video or a still")
        single = {"ROLLOUT": self.rollouts, "--funnel": self.funnel or None}
        single |= {"--solution": self.solution or None} if kind == ".html" else {"--trial": self.trial}
        for option, given in single.items():
            if given is not None and len(given) != 1:
                raise ls.InputError(f"{option}: got {len(given)} with {out.name}, want one")


def _one_or_all(items: Sequence[Any]) -> Any:
    """A single item itself; None for no items."""
    return items[0] if len(items) == 1 else items or None


@dataclass(frozen=True, kw_only=True)
class View:
    """Watch a run, or a live policy, in a window or a browser.

    lqrsim view RUN.npz plays what `lqrsim simulate` wrote. lqrsim view SCENARIO solves the scenario and runs its policy
    live in a loop, and you can interfere. The arrow keys and Page Up and Down push the robot, as seen from the camera;
    Ctrl and the right mouse button drag it. Space pauses, Backspace starts again. With --replan 30 it re-plans 30 times
    a second; after Enter the same keys and mouse move the goal.

    Only this machine can reach the browser's server. Ctrl-C ends it.
    """

    what: Annotated[Positional[str], arg(metavar="RUN.npz|SCENARIO")]
    """A file from `lqrsim simulate`, or a scenario as in `lqrsim solve`."""
    viewer: Literal["auto", "window", "browser"] = "auto"
    """auto: a window where there is a display."""
    port: int = 0
    """Port of the browser's server. By default the first free one from 8080 on."""
    speed: float = 1.0
    """Speed relative to real time; 0.5 is half as fast."""
    seconds: Annotated[float | None, optional("SECONDS")] = None
    """Close after this time."""
    trial: int = 0
    """Row of the run, from 0."""
    loop: bool = True
    """--no-loop stops at the end of the run."""
    disturbances: Annotated[float, arg(metavar="FACTOR")] = 0.0
    """Adds the scenario's disturbances to a live run, scaled by this factor."""
    seed: int = 0
    """Seed of their random numbers."""
    solution: SolutionFile = None
    controller: ControllerName = "feedback"
    """Controller of a live run, as in `lqrsim simulate`."""
    design_disturbances: DesignSet = None
    replan: Annotated[float | None, optional("HZ")] = None
    """Re-plan this many times a second, rounded to control periods; the run then continues after the plan's horizon. A
    solve that takes longer than a control period of real time is not used."""
    push: Annotated[float, arg(metavar="M/S")] = 0.3
    """Change of the robot's velocity per key press."""

    def run(self) -> int:
        from lqrsim.errors import check_count, check_number, check_seed
        from lqrsim.scenarios.references import resolve
        from lqrsim.stress.study import check_designed, make_controller
        from lqrsim.view import viewer

        check_number("--speed", self.speed, at_least=0.01, at_most=100)
        check_number("--push", self.push, at_least=0)
        check_number("--disturbances", self.disturbances, at_least=0)
        check_seed("--seed", self.seed)
        check_count("--port", self.port, at_least=0, at_most=65535)
        if self.seconds is not None:
            check_number("--seconds", self.seconds, above=0)
        options = {"push": self.push, "speed": self.speed, "seconds": self.seconds}
        if Path(self.what).suffix.lower() == ".npz":
            refuse(self, LIVE_OPTIONS, f"with {self.what}, want it with a SCENARIO")
            rollout = ls.load(self.what, ls.Rollout)
            arguments = viewer.arguments_for_rollout(rollout, self.trial)

            def go(screen: "Viewer") -> None:
                viewer.play(rollout, screen, trial=self.trial, loop=self.loop)
        else:
            refuse(self, RECORDED_OPTIONS, f"with {self.what}, want it with a RUN.npz")
            scenario = resolve(self.what)
            self._check_replanning(scenario.problem)
            given = self.solution
            solution = console.solve_and_print(scenario) if given is None else self._load_solution(scenario, given)
            scenario = scenario.with_duration_of(solution)
            self._check_replanning(scenario.problem)
            plant = scenario.plant()
            planner, goal = (None, None) if self.replan is None else self._planning(scenario.problem, solution)
            arguments = viewer.arguments_for_plant(plant, solution, goal)
            check_designed(self.design_disturbances, (self.controller,))
            controller = make_controller(self.controller, scenario, solution, design=self.design_disturbances)
            disturbances = [kind.scaled(self.disturbances) for kind in scenario.disturbances if self.disturbances]

            def go(screen: "Viewer") -> None:
                console.say(viewer.KEYS if goal is None else f"{viewer.KEYS}\n{viewer.GOAL_KEYS}")
                options = {"controller": controller, "disturbances": disturbances, "seed": self.seed}
                viewer.live(plant, solution, screen, report=console.say, planner=planner, goal=goal, **options)

        with viewer.open_viewer(self.viewer, self.port, title=f"lqrsim {self.what}", **arguments, **options) as screen:
            console.say(screen.instructions)
            with contextlib.suppress(KeyboardInterrupt):
                go(screen)
        return 0

    @staticmethod
    def _load_solution(scenario: "ls.Scenario", path: Path) -> "ls.Solution":
        """Load the solution of a file. Raises InputError if it cannot run in the scenario."""
        from lqrsim.scenarios.solutions import check_solution, remarks

        solution = check_solution(scenario, path)
        console.say(console.summary_of(solution))
        for remark in remarks(scenario, solution):
            console.say(f"{path} {remark}")
        return solution

    def _check_replanning(self, problem: "ls.Problem") -> None:
        """Raise InputError for a rate that does not fit the problem, or options that exclude re-planning."""
        from lqrsim.errors import check_number

        if self.replan is None:
            return
        if problem.duration is None:  # a free one is known after the solve
            # At least one plan per horizon, at most one per control period, with a tolerance for rounded rates.
            slowest, fastest = 0.999 / (problem.steps * problem.dt), 1.001 / problem.dt
            check_number("--replan", self.replan, at_least=slowest, at_most=fastest)
        if self.controller != "feedback":
            raise ls.InputError(f"--controller: got {self.controller} with --replan, want one of the two")
        if self.speed > 1:
            raise ls.InputError(f"--speed: got {self.speed:g} with --replan, want at most 1: solves run in real time")

    def _planning(
        self, problem: "ls.Problem", solution: "ls.Solution"
    ) -> tuple["Callable[[], ls.types.LiveReplanner]", "MovableGoal | None"]:
        """A function that starts the re-planner, and the goal if it can be moved."""
        from lqrsim.view.viewer import MovableGoal

        assert self.replan is not None
        every = max(round(1 / (self.replan * problem.dt)), 1) * problem.dt
        console.say(f"plans again every {every:.4g} s, {1 / every:.4g} times a second")
        # Compiles, and reports errors, before a window opens.
        replanner = ls.Replanner(problem, solution, every=every, horizon="moving")
        try:
            return replanner.live, MovableGoal(problem)
        except ls.InputError as error:
            console.say(f"the goal cannot be moved: {error}")
            return replanner.live, None


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Check a run against its rendered frames.

    A run is rendered in calibrated fixed views. A video is decoded, and the robot's mark is located in its panes `top`
    and `side`. Positions from pixels are compared with the simulator's and with the plan. See docs/verifying.md. Exits
    with 1 if a test failed.

      lqrsim verify runs/quadrotor/rollout.npz
      lqrsim verify videos/quadrotor/video.mp4
    """

    file: Annotated[Positional[Path], arg(metavar="RUN.npz|VIDEO.mp4")]
    """A file from `lqrsim simulate`, or its video from `lqrsim render` with the cameras or insets top and side."""
    run_file: Annotated[Path | None, optional("RUN.npz"), arg(name="run")] = None
    """The run that the video shows. By default the run in its folder that the video names."""
    trial: Annotated[int | None, optional("N")] = None
    """Row of the rollout, from 0. By default 0, or the first that the video shows."""
    solution: Annotated[Path | None, optional("SOLUTION.npz")] = None
    """Solution of the run, to check the recorded plan. By default solution.npz beside the run."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.verify import ran_policy_of, run_beside

        is_run = self.file.suffix.lower() == ".npz"
        if is_run and self.run_file is not None:
            raise ls.InputError(f"--run: got {self.run_file} with {self.file}, want it with a VIDEO.mp4")
        path = self.file if is_run else self.run_file or run_beside(self.file)
        rollout, beside = ls.load(path, ls.Rollout), path.with_name("solution.npz")
        solution = None
        if self.solution or os.path.isfile(beside):
            solution = ls.load(self.solution or beside, ls.Solution)
            # The solution file next to a run may belong to another run; a given solution is used in any case.
            solution = solution if self.solution or ran_policy_of(solution, rollout) else None
        with console.Progress("verifying", "frame") as progress:
            options: dict[str, Any] = {"solution": solution, "progress": progress}
            if is_run:
                verification = ls.verify_run(rollout, self.trial or 0, **options)
            else:
                verification = ls.verify_video(self.file, rollout, trial=self.trial, **options)
        console.say(verification.summary())
        console.result(verification={**vars(verification), "passed": verification.passed})
        return 0 if verification.passed else 1


C_OPTIONS, MINARI_OPTIONS = ("number", "gains", "interpolate", "name"), ("actions", "cell", "solution", "scenario")


@dataclass(frozen=True, kw_only=True)
@options_of("results/export_c.py", "export_c", number=None, gains=None, interpolate=None, name="NAME")
class Export:
    """Write a policy as C99, or runs as a data set of Minari.

    With --c, for a microcontroller, the folder gets a header and a source file that need math.h alone and allocate
    nothing, an example that compares commands with Python's, and a CMake file for this machine and for an STM32F405,
    which QEMU emulates. docs/microcontrollers.md says how to put it on a Crazyflie or into PX4.

    With --minari, to learn from, each trial becomes an episode; see docs/gymnasium.md. The data set is written to the
    folder of Minari, which MINARI_DATASETS_PATH names.

      lqrsim export runs/quadrotor/solution.npz --c firmware/policy
      cmake -S firmware/policy -B build && cmake --build build && ctest --test-dir build
      lqrsim export runs/quadrotor/rollout.npz --minari quadrotor/light-v0
      lqrsim export runs/stress/quadrotor --minari quadrotor/stressed-v0 --cell smooth,light,1
    """

    source: Annotated[Positional[Path], arg(metavar="FILE.npz|FOLDER")]
    """For --c a file from `lqrsim solve`, or a policy from `ls.save`: of ls.track, or of ls.OffsetFree with its filter.
    For --minari a file from `lqrsim simulate`, or a folder from `lqrsim stress`, whose trials are run again."""
    c: Annotated[Path | None, optional("FOLDER")] = None
    """Folder for the C files. Files of their names are replaced."""
    minari: Annotated[str | None, optional("NAMESPACE/NAME-vVERSION")] = None
    """Name of the data set, which must be new."""
    actions: Literal["normalized", "controls"] = "normalized"
    """Of the data set: from -1 to 1 between the limits of each control, or in the controls' own units."""
    cell: Annotated[tuple[str, ...], optional("CELL ...")] = ()
    """Cells of a stress test, as in `lqrsim replay`, all with one plan. By default all cells."""
    solution: Annotated[Path | None, optional("SOLUTION.npz")] = None
    """Solution of the run. By default solution.npz beside it, or that of the cells."""
    scenario: Annotated[str | None, optional("SCENARIO")] = None
    """Scenario of the run, for the rewards, as in `lqrsim simulate` or `lqrsim replay`."""
    json: Json = False

    def run(self) -> int:
        if (self.c is None) == (self.minari is None):
            raise ls.InputError(f"--c, --minari: got {'none' if self.c is None else 'both'}, want one of the two")
        unused, target = (C_OPTIONS, "--c") if self.c is None else (MINARI_OPTIONS, "--minari")
        refuse(self, unused, f"without {target}, want it with that")
        if self.c is not None:
            self._to_c(self.c)
        if self.minari is not None:
            self._to_minari(self.minari)
        return 0

    def _to_c(self, folder: Path) -> None:
        console.check_output("--c", folder)
        policy: Any = ls.load(self.source)  # `export_c` refuses anything that cannot be exported
        exported = ls.export_c(policy, folder, **arguments_for(ls.export_c, self))
        for path in exported.files:
            console.wrote(path)
        console.say(exported.summary())
        console.result(sha256=exported.sha256, table_bytes=exported.table_bytes, rounding=exported.rounding)

    def _to_minari(self, name: str) -> None:
        try:
            from lqrsim.gym import make_env, write_minari
        except ImportError as error:
            raise ls.InputError(f"--minari: {error}, and 'lqrsim[minari]'") from None
        if self.source.is_dir():
            results = ls.stress.Results(self.source, scenario=self.scenario)
            cells = [ls.stress.Cell.named(cell_name, results.cells) for cell_name in self.cell] or results.cells
            solvers = dict.fromkeys(results.solution(cell.policy).solver for cell in cells)  # each has its own plan
            if len(solvers) > 1:
                raise ls.InputError(f"--cell: got cells with plans of {' and '.join(solvers)}, want those of one plan")
            shards = ((cell, shard) for cell in cells for shard in results.shards(cell))
            runs = (ls.stress.replay(results, cell, one.first, trials=one.count, frames=False) for cell, one in shards)
            solution = self.solution or results.folder / "policies" / f"{cells[0].policy}.npz"
            named = results.campaign.scenario  # an InputError if it is code and --scenario does not name it
        else:
            if self.cell:
                raise ls.InputError(f"--cell: got {self.cell[0]} with {self.source}, want the folder of a stress test")
            runs = ls.load(self.source, ls.Rollout)
            solution = self.solution or self.source.with_name("solution.npz")
            named = self.scenario or console.load_with_scenario(solution, None)[0].scenario
        # A path as text, from which `recover_environment` can make it.
        env = make_env(named, solution=str(solution.absolute()), actions=self.actions)
        dataset = write_minari(name, env, runs)
        console.wrote(dataset.spec.data_path)
        console.say(f"{dataset.total_episodes} episodes of {dataset.total_steps} control periods")
        console.result(episodes=dataset.total_episodes, steps=dataset.total_steps)

"""The command line. Each command reads what the one before wrote; `lqrsim COMMAND --help` documents each."""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from lqrsim.simulation.disturbances import Disturbance

# Heavy modules are imported inside the commands, so that `--help` answers at once.

DESCRIPTION = """Feedback policies by iterated LQR smoothing, executed in MuJoCo under disturbances and shown on video.

The whole chain, for both robots, is `lqrsim demo`. Step by step, each command reading what the one before wrote:
  lqrsim solve quadrotor --out runs/quadrotor
  lqrsim simulate runs/quadrotor/solution.npz --force-noise 0.1 --seed 1
  lqrsim render runs/quadrotor/rollout.npz
How often policies fail, under what, and how sure that is: `lqrsim stress quadrotor`.
The paper's results, beside what came out here: `lqrsim reproduce`.

Exit codes: 0 done, 1 not converged or out of bounds, 2 bad input. The version is printed by `lqrsim --version`."""


def _optional(metavar: str) -> object:
    """An option whose default its own help text tells."""
    return arg(metavar=metavar, help_behavior_hint="")


Folder = Annotated[Path | None, _optional("FOLDER")]


@dataclass(frozen=True, kw_only=True)
class List:
    """Print the scenarios: name, robot, scene, states and controls with their units."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import scenarios
        from lqrsim.references import resolve

        for name in scenarios.names():
            scenario = resolve(name)
            problem = scenario.problem
            print(f"{name}: {scenario.summary}")
            print(f"  robot:    {scenario.robot.name} in scene {scenario.scene.name}")
            print(f"  horizon:  {problem.steps} steps of {problem.dt:.4g} s")
            print(f"  states:   {', '.join(problem.dynamics.state_coordinates.labels)}")
            print(f"  controls: {', '.join(problem.dynamics.control_coordinates.labels)}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Solve:
    """Compute a feedback policy for a scenario and write it to solution.npz.

    Prints each iteration as it ends, then the status and, if it failed, the remedy. The solution is written in any
    case; the exit code is 1 if the solver did not converge.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """A name that `lqrsim list` prints, or a function of yours that returns a Scenario: file.py:name or module:name.
    Settings follow after commas, as in quadrotor,query=3."""
    out: Folder = None
    """Folder for solution.npz. By default runs/ and the name of the scenario."""
    solver: Literal["smooth", "ilqr"] = "smooth"
    """smooth: iterated LQR smoothing. ilqr: the baseline with line search, from the scenario's exact start."""
    stop: Literal["optimal", "cost"] = "optimal"
    """cost: the cost has settled, which is the paper's test. optimal: so have the gap and first-order optimality."""
    tolerance: float = 1e-4
    """Relative change of the cost below which it has settled, and the measure of the other tests."""
    max_iterations: Annotated[int | None, _optional("INT")] = None
    """Give up after so many. By default the solver's own limit."""
    starts: Annotated[int | None, _optional("INT")] = None
    """How many ways to the goal smooth tries for a few iterations, to go on with the best. By default 7."""
    paper_start: bool = False
    """Begin as the paper does in place of that: from the nominal control, with the scenario's prior."""
    clearance: Annotated[float | None, _optional("METRES")] = None
    """Keep at least this much between the robot and all obstacles, at the steps. By default they only cost."""
    control_limits: Annotated[tuple[float, float] | None, _optional("LOWEST HIGHEST")] = None
    """Plan with these limits of every control, in its unit. By default those of the actuators."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console, files
        from lqrsim.constraints import Clearance
        from lqrsim.errors import InputError
        from lqrsim.references import resolve, short_name

        folder = self.out or Path("runs") / short_name(self.scenario)
        console.check_output("--out", folder)
        scenario = resolve(self.scenario)
        problem = scenario.problem
        if self.clearance is not None:
            kept = Clearance(scenario.scene.world, radius=scenario.robot.radius, margin=self.clearance)
            problem = replace(problem, constraints=[*problem.constraints, kept])
        if self.control_limits is not None:
            problem = replace(problem, control_limits=self.control_limits)
        options: dict[str, object] = {"stop": self.stop, "tolerance": self.tolerance}
        if self.max_iterations is not None:
            options["max_iterations"] = self.max_iterations
        if self.starts is not None or self.paper_start:
            if self.solver != "smooth":
                raise InputError(f"--starts, --paper-start: got one for {self.solver}, want them with --solver smooth")
            options["starts"] = self.starts
        if self.paper_start:
            if scenario.paper_start is None:
                raise InputError(f"--paper-start: got it for {scenario.name}, want a scenario that the paper has")
            options["start"] = scenario.paper_start
        solution = replace(console.solve(problem, self.solver, **options), scenario=self.scenario)
        console.say(f"wrote {files.save(solution, folder / 'solution.npz')}")
        return 0 if solution.success else 1


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Execute a policy closed-loop in MuJoCo and write the runs to rollout.npz.

    Prints a line for each trial. Without a disturbance it is the plain closed loop. The same seed gives the same bits.
    """

    solution: Annotated[Positional[Path], arg(metavar="SOLUTION")]
    """What `lqrsim solve` wrote."""
    scenario: Annotated[str | None, _optional("SCENARIO")] = None
    """Whose robot and scene to use, as in `lqrsim solve`. By default the one that was solved, if `lqrsim list` has it.
    A file is data and never chooses code to run: name a function of yours here."""
    out: Folder = None
    """Folder for rollout.npz. By default that of the solution."""
    control_noise: Annotated[float, arg(metavar="STD")] = 0.0
    """Standard deviation of white noise on each control, in the control's unit (m/s wheel speed, N rotor force)."""
    force_noise: Annotated[float, arg(metavar="STD")] = 0.0
    """Standard deviation of a random force at the centre of mass, redrawn each control period, in N along each axis."""
    measurement_noise: Annotated[tuple[float, ...], _optional("STD ...")] = ()
    """Standard deviation of white noise on each measured state, in its unit: one number a state, or one for all."""
    push: Annotated[tuple[float, float, float, float] | None, _optional("X Y Z AT")] = None
    """One push: its impulse in N s along the world's axes, and when it comes, in s."""
    seed: int = 0
    """Of all random draws."""
    trials: int = 1
    """How many runs."""
    first_trial: int = 0
    """Number of the first: trial 7 alone is --first-trial 7, and the same to the last bit as among others."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console, files
        from lqrsim.errors import InputError
        from lqrsim.references import resolve
        from lqrsim.simulation.closed_loop import simulate

        folder = self.out or self.solution.parent
        console.check_output("--out", folder)
        solution = files.load_solution(self.solution)
        if not self.scenario and not solution.scenario:
            raise InputError(
                "--scenario: got none, and the solution names none, want the one whose robot and scene to use"
            )
        scenario = resolve(self.scenario or solution.scenario, registered_only=not self.scenario)
        with console.progress("simulating", "step") as progress:
            rollout = simulate(
                scenario.plant(),
                solution,
                disturbances=self._disturbances(),
                seed=self.seed,
                trials=self.trials,
                first_trial=self.first_trial,
                progress=progress,
            )
        console.say(rollout.summary())
        console.say(f"wrote {files.save(rollout, folder / 'rollout.npz')}")
        return 0

    def _disturbances(self) -> "list[Disturbance]":
        from lqrsim.simulation.disturbances import ControlNoise, ForceNoise, MeasurementNoise, Push

        found: list[Disturbance] = []
        if self.control_noise:
            found.append(ControlNoise(self.control_noise))
        if self.force_noise:
            found.append(ForceNoise(self.force_noise))
        if self.measurement_noise:
            std = self.measurement_noise
            found.append(MeasurementNoise(std[0] if len(std) == 1 else std))
        if self.push:
            *impulse, at = self.push
            found.append(Push(impulse, at=at))
        return found


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a run as an mp4 (h264, real time): obstacles, the plan, the trace actually driven, the robot."""

    rollout: Annotated[Positional[Path], arg(metavar="ROLLOUT")]
    """What `lqrsim simulate` wrote."""
    out: Annotated[Path | None, _optional("FILE.mp4")] = None
    """The video. By default the rollout's path with .mp4 at its end."""
    trial: int = 0
    """Which row of the rollout, from 0."""
    camera: Annotated[str | None, _optional("NAME")] = None
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
class Report:
    """Write the report of a stress test: one HTML page with tables, curves and videos of the worst trials.

    The page needs no network and no other file. It can be written of a stress test that has not ended, and says so.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """What `lqrsim stress` wrote."""
    out: Annotated[Path | None, _optional("FILE.html")] = None
    """The page. By default report.html in that folder."""
    videos: int = 4
    """How many of the worst trials to run again and film."""
    scenario: Annotated[str | None, _optional("SCENARIO")] = None
    """That of the campaign, where it is a function of yours: a file is data and never chooses code to run."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console
        from lqrsim.errors import InputError
        from lqrsim.stress.results import Results
        from lqrsim.view.report import report

        page = self.out or self.folder / "report.html"
        if page.suffix != ".html":
            raise InputError(f"--out: got {page}, want a name that ends in .html")
        console.check_output("--out", page.parent)
        results = Results(self.folder, scenario=self.scenario)
        with console.progress("reporting", "part") as progress:
            report(results, page, videos=self.videos, progress=progress)
        console.say(f"wrote {page}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Solve, execute and film: the main job, for both robots.

    Each is solved from a cold start with smooth(); its policy is run undisturbed and then disturbed; the solution, both
    rollouts, a figure and a video are written.

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
        from lqrsim.demo import demo

        return demo(self.robots, out=self.out, seed=self.seed, video=self.video, quick=self.quick)


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Run many trials of several policies under disturbances of growing strength, and count how they end.

    What is stopped, however it is stopped, goes on with the same command; the tables are the same to the bit whatever
    the workers, the batches and the interruptions. Prints the share of each that reached its goal with the exact
    interval. `docs/file_format.md` says what is in the folder.

    Exits with 1 if trials came to nothing for an error.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    sweep: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("scenario",)
    """Disturbances: scenario for those of the scenario's demo, or a preset; NAME:KIND for one kind of them alone."""
    strengths: Annotated[tuple[float, ...], arg(metavar="FACTOR ...")] = (0.0, 0.5, 1.0, 1.5, 2.0)
    """What the disturbances are multiplied by."""
    policies: tuple[Literal["smooth", "ilqr", "open_loop", "replan"], ...] = ("smooth", "ilqr", "open_loop", "replan")
    """open_loop: the plan of smooth without feedback. replan: solves again as it goes. All meet the same numbers."""
    trials: int = 200
    """Of each sweep, strength and policy."""
    seed: int = 0
    """Of all random draws."""
    replan_every: Annotated[float | None, _optional("SECONDS")] = None
    """Between two solves of replan. By default a tenth of the horizon."""
    shard: int = 500
    """Trials of a file, which is what an interruption costs at most for each worker."""
    time_limit: Annotated[float, arg(metavar="SECONDS")] = 300.0
    """What a shard may take before it counts as hung, and its trials as errors."""
    out: Folder = None
    """Folder of the campaign. By default runs/stress/ and the name of the scenario."""
    resume: bool = False
    """Go on with the campaign in the folder, with what it was begun with in place of the options above."""
    workers: Annotated[int | None, _optional("INT")] = None
    """Processes on this machine. By default one a processor."""
    batch: int = 256
    """Trials that a worker simulates together; changes nothing but time and memory."""
    scheduler: Annotated[str | None, _optional("ADDRESS")] = None
    """Of a dask cluster that does the work in place of this machine, such as tcp://10.0.0.1:8786."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console
        from lqrsim.references import resolve, short_name
        from lqrsim.stress.campaign import Campaign, run
        from lqrsim.stress.results import Results
        from lqrsim.stress.sweeps import sweep

        folder = self.out or Path("runs/stress") / short_name(self.scenario)
        if self.resume:
            campaign = Results(folder, scenario=self.scenario).campaign
        else:
            scenario = resolve(self.scenario)
            campaign = Campaign(
                scenario=self.scenario,
                sweeps={name: sweep(name, scenario) for name in self.sweep},
                strengths=self.strengths,
                policies=self.policies,
                trials=self.trials,
                seed=self.seed,
                replan_every=self.replan_every,
                shard=self.shard,
                time_limit=self.time_limit,
            )
        options = {"workers": self.workers, "batch": self.batch, "scheduler": self.scheduler}
        with console.long_progress("stressing", "trial") as progress:
            results = run(campaign, folder, progress=progress, **options)
        console.say(results.summary())
        console.say(f"wrote {folder}")
        return 1 if any(results.tally(cell)["error"] for cell in results.cells) else 0


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Run one trial of a campaign again, to the bit, and write it to rollout.npz, to be looked at with `lqrsim render`.

    Says whether it gave its row in the campaign's table again; exits with 1 if not.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """What `lqrsim stress` wrote."""
    cell: Annotated[str, arg(metavar="CELL")]
    """Which: policy,sweep,strength, such as smooth,scenario,1.5; or its number, with which its files' names begin."""
    trial: int
    """Number of the trial, from 0."""
    scenario: Annotated[str | None, _optional("SCENARIO")] = None
    """That of the campaign, where it is a function of yours: a file is data and never chooses code to run."""
    out: Annotated[Path, arg(metavar="FILE.npz")] = Path("rollout.npz")
    """What to write."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import console, files
        from lqrsim.stress.asked import Cell
        from lqrsim.stress.results import Results, agrees, replay

        console.check_output("--out", self.out.parent)
        results = Results(self.folder, scenario=self.scenario)
        cell = Cell.named(self.cell, results.cells)
        same = agrees(results, cell, self.trial)
        rollout = replay(results, cell, self.trial)
        console.say(rollout.summary())
        console.say(f"{'the same' if same else 'NOT the same'} to the bit as in the table, until the first collision")
        console.say(f"wrote {files.save(rollout, self.out)}")
        return 0 if same else 1


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Run the experiments of the paper again and say which of its statements hold, each with its figure.

    Writes results.md, which sums them up, results.json, which has every number, and the figures as png and pdf. Takes
    some minutes. Other people's solvers are compared with where the bench extra is installed.

    Exits with 1 if an experiment failed; whether the paper's statements hold does not count.
    """

    results: Annotated[Positional[tuple[str, ...]], arg(metavar="RESULT ...")] = ()
    """Which: figure_2, figure_3, table_1, convergence, state_dimension, state_of_the_art, feedback. By default all."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper")
    """Where to write."""
    quick: bool = False
    """A small part of each, for a first look."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim.reproduce import reproduce

        return reproduce(self.results, out=self.out, quick=self.quick)


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Show what is kept of compiled solvers and derived formulas, or remove it.

    Without it everything works the same, and each kind of problem is compiled again, some 10 seconds.
    """

    clear: bool = False
    """Remove all of it."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim import cache
        from lqrsim.errors import InputError

        if self.clear:
            try:
                print(f"removed {cache.clear()} items from {cache.folder()}")
            except OSError as error:
                raise InputError(f"--clear: got {cache.folder()}, want files that can be removed ({error})") from None
            return 0
        items = cache.items()
        for item in items:
            used = time.strftime("%Y-%m-%d %H:%M", time.localtime(item.used))
            print(f"{item.size / 1e6:8.2f} MB  last used {used}  {item.what}")
        total = sum(item.size for item in items) / 1e6
        print(f"{len(items)} items, {total:.1f} of at most {cache.LIMIT / 1e6:.0f} MB, in {cache.folder()}")
        return 0


Command = List | Solve | Simulate | Render | Demo | Stress | Replay | Report | Reproduce | Cache


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
      arguments: what follows `lqrsim` on the command line; those of this process by default.

    Returns:
      The exit code: 0 done; 1 not converged or out of bounds; 2 bad input; 130 stopped with Ctrl-C.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        from importlib.metadata import version

        print(f"lqrsim {version('lqrsim')}")
        return 0
    command = tyro.cli(Command, prog="lqrsim", description=DESCRIPTION, args=arguments)

    from lqrsim.errors import InputError

    notices = logging.StreamHandler()  # on stderr: what takes its time, such as compiling for a new kind of problem
    logger = logging.getLogger("lqrsim")
    logger.addHandler(notices)
    logger.setLevel(logging.INFO)
    try:
        return command.run()
    except InputError as error:
        print(f"lqrsim: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lqrsim: stopped", file=sys.stderr)
        return 130
    finally:
        logger.removeHandler(notices)


if __name__ == "__main__":
    sys.exit(main())

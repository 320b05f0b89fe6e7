"""Commands of the stress test."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lqrsim.commands.options import Folder, Json, Policy, SolutionFile, optional


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Measure failure rates of policies against disturbance strength.

    All policies meet the same trials. After any interruption, rerunning the command resumes with identical results. On
    equal processors the tables are bit-identical for any number of workers, any batch size and any interruption. Prints
    success rates with exact intervals. `docs/file_format.md` describes the folder.

    Exits with 1 if trials ended with an error.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    sweep: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("light",)
    """Disturbances: a preset (calm, light, moderate, strong, severe), or scenario for those of the scenario's demo;
    NAME:KIND for one kind alone."""
    strengths: Annotated[tuple[float, ...], arg(metavar="FACTOR ...")] = (0.0, 0.5, 1.0, 1.5, 2.0)
    """Factors by which the disturbances are scaled; 0.5 and 2 turn light into calm and moderate."""
    policies: Annotated[tuple[Policy, ...] | None, arg(help_behavior_hint="")] = None
    """open_loop: the plan of smooth without feedback. replan: solves again as it goes. track: keeps to the plan of
    smooth. offset_free: the same, and estimates the state and what disturbs it. All meet the same numbers. By default
    the first four; ilqr is left out where the scenario has constraints, which it cannot keep."""
    stated: Annotated[str | None, optional("NAME")] = None
    """Disturbances for which track and offset_free are designed, named as above, at all strengths. By default
    moderate."""
    solution: SolutionFile = None
    trials: int = 200
    """Number of trials for each sweep, strength and policy."""
    seed: int = 0
    """Seed of all random numbers."""
    replan_every: Annotated[float | None, optional("SECONDS")] = None
    """Time between two solves of replan. By default a tenth of the horizon."""
    goal_radius: Annotated[float | None, optional("METRES")] = None
    """Distance from the goal within which it counts as reached. By default the robot's radius."""
    goal_tolerance: Annotated[float | None, optional("SHARE")] = None
    """The same for goals without a position, relative to each state's range along the plan. By default 0.1."""
    shard: int = 500
    """Trials per file; an interruption loses at most this many per worker."""
    time_limit: Annotated[float, arg(metavar="SECONDS")] = 300.0
    """Time after which a shard counts as hung and its trials as errors."""
    out: Folder = None
    """Folder of the campaign. By default runs/stress/ and the name of the scenario."""
    resume: bool = False
    """Resume the campaign in the folder with its own settings instead of the options above."""
    workers: Annotated[int | None, optional("INT")] = None
    """Processes on this machine. By default one per processor."""
    batch: int = 256
    """Trials that a worker simulates together; affects only time and memory."""
    scheduler: Annotated[str | None, optional("ADDRESS")] = None
    """Address of a dask cluster that does the work instead of this machine, such as tcp://10.0.0.1:8786."""
    json: Json = False
    """Print the result as one JSON object, and everything else to stderr; see docs/json.md."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import as_json, console
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.scenarios.solutions import given
        from lqrsim.stress.campaign import USUAL, Campaign, run_campaign
        from lqrsim.stress.results import Results
        from lqrsim.stress.sweeps import sweep
        from lqrsim.stress.trials import impossible_policies

        scenario = resolve(self.scenario)
        folder = self.out or Path("runs/stress") / folder_name(scenario)
        solution = None if self.solution is None else given(scenario, self.solution)
        if self.resume:
            begun = Results(folder, scenario=self.scenario)
            campaign, solution = begun.campaign, solution or begun.given
        else:
            impossible = impossible_policies(scenario, solution)
            campaign = Campaign(
                scenario=self.scenario,
                sweeps={name: sweep(name, scenario) for name in self.sweep},
                strengths=self.strengths,
                policies=tuple(policy for policy in USUAL if policy not in impossible)
                if self.policies is None
                else self.policies,
                stated=None if self.stated is None else sweep(self.stated, scenario),
                trials=self.trials,
                seed=self.seed,
                replan_every=self.replan_every,
                goal_radius=self.goal_radius,
                goal_tolerance=self.goal_tolerance,
                shard=self.shard,
                time_limit=self.time_limit,
            )
        options = {"workers": self.workers, "batch": self.batch, "scheduler": self.scheduler, "solution": solution}
        with console.long_progress("stressing", "trial") as progress:
            results = run_campaign(campaign, folder, progress=progress, **options)
        console.say(results.summary())
        console.wrote(folder)
        own = ["--scenario", self.scenario] if ":" in self.scenario else []  # files never choose code to run
        console.say(f"\nnext:\n  {shlex.join(['lqrsim', 'report', str(folder), *own])}")
        if console.wants_result():
            console.result(campaign=as_json.of_campaign(results))
        return 1 if any(results.tally(cell)["error"] for cell in results.cells) else 0


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Repeat one trial of a stress test exactly.

    Writes it to rollout.npz for `lqrsim render`. Obstacles stop the robot here, unlike in the campaign; nothing after a
    collision counts. Compares the result with the trial's row in the campaign's table and reports differences; exits
    with 1 if there are any. On another kind of processor, or with other versions, results can differ; it then says so.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A folder from `lqrsim stress`."""
    cell: Annotated[str, arg(metavar="CELL")]
    """policy,sweep,strength, such as smooth,light,1.5; or the number with which the names of its files begin."""
    trial: int
    """Number of the trial, from 0."""
    scenario: Annotated[str | None, optional("SCENARIO")] = None
    """The campaign's scenario if it is your own function: files never choose code to run."""
    out: Annotated[Path, arg(metavar="FILE.npz")] = Path("rollout.npz")
    """File to write."""
    json: Json = False
    """Print the result as one JSON object, and everything else to stderr; see docs/json.md."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import as_json, console
        from lqrsim.results import save_load
        from lqrsim.stress.results import Results, differences, replay
        from lqrsim.stress.specification import Cell
        from lqrsim.versions import changed

        console.check_output("--out", self.out.parent, self.out.name)
        results = Results(self.folder, scenario=self.scenario)
        cell = Cell.named(self.cell, results.cells)
        if others := changed(results.manifest["versions"]):
            console.say(f"bits can differ from the table's: got {others}")
        rollout = replay(results, cell, self.trial)
        console.say(rollout.summary())
        if summary := rollout.controller_run.summary():
            console.say(summary)
        different = differences(results, cell, self.trial, rollout)
        for one in different:
            console.say(f"NOT as in the table: {one}")
        if not different:
            console.say("identical to the table")
        console.wrote(save_load.save(rollout, self.out))
        if console.wants_result():
            run = as_json.of_rollout(rollout, results.trials.scenario.problem)
            console.result(cell=cell, run=run, differences=different)
        return 1 if different else 0


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write the report of a stress test as one HTML page.

    The page has tables, curves and videos of the worst trials, and needs no network and no other file. It can be
    written before the stress test has ended, and then says so.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A folder from `lqrsim stress`."""
    out: Annotated[Path | None, optional("FILE.html")] = None
    """The page. By default report.html in that folder."""
    videos: int = 4
    """Number of the worst trials to repeat and render."""
    scenario: Annotated[str | None, optional("SCENARIO")] = None
    """The campaign's scenario if it is your own function: files never choose code to run."""
    json: Json = False
    """Print the result as one JSON object, and everything else to stderr; see docs/json.md."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import as_json, console
        from lqrsim.errors import InputError
        from lqrsim.reports.page import report
        from lqrsim.stress.results import Results

        page = self.out or self.folder / "report.html"
        if page.suffix != ".html":
            raise InputError(f"--out: got {page}, want a name that ends in .html")
        console.check_output("--out", page.parent, page.name)
        results = Results(self.folder, scenario=self.scenario)
        with console.progress("reporting", "part") as progress:
            report(results, page, videos=self.videos, progress=progress)
        console.wrote(page)
        if console.wants_result():
            console.result(campaign=as_json.of_campaign(results))
        return 0

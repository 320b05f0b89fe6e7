"""Commands of the stress test."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lqrsim as ls
from lqrsim.commands import as_json, console
from lqrsim.commands.options import (
    CampaignPolicyName,
    Folder,
    Json,
    OwnScenario,
    SetupOptions,
    changed,
    optional,
    options_of,
    refuse,
    stated,
)


@dataclass(frozen=True, kw_only=True)
@options_of("stress/campaign.py", "run_campaign", workers="INT", batch="INT", scheduler="ADDRESS")
@options_of(
    "stress/study.py", "Campaign", trials="INT", replan_every="SECONDS", shard="INT", time_limit="SECONDS",
    strengths="FACTOR ...",
)  # fmt: skip
class Stress(SetupOptions):
    """Measure failure rates of policies against disturbance strength.

    All policies meet the same trials. After any interruption, rerunning the command resumes with identical results. On
    equal processors the tables are bit-identical for any number of workers, any batch size and any interruption. Prints
    success rates with exact intervals. `docs/file_format.md` describes the folder.

    Exits with 1 if trials ended with an error.
    """

    sweep: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("light",)
    """Disturbances: a preset (calm, light, moderate, strong, severe), or scenario for its demo's disturbances;
    NAME:KIND for one kind alone."""
    policies: Annotated[tuple[CampaignPolicyName, ...], optional("POLICY ...")] = ()
    """smooth, ilqr: the policies of these solvers. open_loop: the plan of smooth without feedback. replan: re-plans
    during the run. track: follows the plan of smooth. offset_free: the same, and estimates the state and the
    disturbances. track_per_cell, offset_free_per_cell: these two, designed anew for the disturbances of each
    combination. By default the first four that the scenario allows: ilqr cannot keep constraints."""
    out: Folder = None
    """Folder of the campaign. By default runs/stress/ and the name of the scenario."""
    resume: bool = False
    """Resume the campaign in the folder with its own settings, without the options that state others."""

    def run(self) -> int:
        from lqrsim.scenarios.references import folder_name, names_code

        if self.resume:
            accepted = {"scenario", "solution", "out", "resume", "json", "workers", "batch", "scheduler"}
            refuse(
                self, changed(self).keys() - accepted, "with --resume, which has the campaign's own, want it without"
            )
        setup = ls.stress.Setup(**stated(self, ls.stress.Setup))
        folder = self.out or Path("runs/stress") / folder_name(setup.resolved)
        console.check_output("--out", folder)
        if self.resume:
            campaign = ls.stress.Results(folder, scenario=self.scenario).campaign
            campaign = campaign if self.solution is None else replace(campaign, solution=self.solution)
        else:
            options = stated(self, ls.stress.Campaign)
            options = {name: value for name, value in options.items() if not hasattr(setup, name)}
            campaign = ls.stress.Campaign.of_sets(setup, self.sweep, **options)
        with console.progress("stressing", "trial") as progress:
            results = ls.stress.run_campaign(
                campaign, folder, **stated(self, ls.stress.run_campaign, progress=progress)
            )
        console.say(results.summary())
        console.wrote(folder)
        options = ["--scenario", self.scenario] if names_code(self.scenario) else []  # files never choose code to run
        console.say(f"\nnext:\n  {shlex.join(['lqrsim', 'report', str(folder), *options])}")
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
    scenario: OwnScenario = None
    out: Annotated[Path, arg(metavar="FILE.npz")] = Path("rollout.npz")
    """File to write."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.stress.results import differences
        from lqrsim.versions import changed

        console.check_output("--out", self.out.parent, self.out.name)
        results = ls.stress.Results(self.folder, scenario=self.scenario)
        cell = ls.stress.Cell.named(self.cell, results.cells)
        if others := changed(results.manifest["versions"]):
            console.say(f"values may differ from the table in the last bits: got {others}")
        rollout = ls.stress.replay(results, cell, self.trial)
        console.say(rollout.summary())
        if summary := rollout.controller_run.summary():
            console.say(summary)
        different = differences(results, cell, self.trial, rollout)
        for difference in different:
            console.say(f"NOT as in the table: {difference}")
        if not different:
            console.say("identical to the table")
        console.save(rollout, self.out)
        if console.wants_result():
            run = as_json.of_rollout(rollout, results.trials.scenario.problem)
            console.result(cell=cell, run=run, differences=different)
        return 1 if different else 0


@dataclass(frozen=True, kw_only=True)
@options_of("reports/page.py", "report", videos="INT")
class Report:
    """Write the report of a stress test: a page, or a table for a paper.

    The page is one HTML file with tables, curves and videos of the worst trials, which needs no network. The table has
    the success rates with their intervals, as CSV, LaTeX (booktabs) or Markdown. Both can be written before the stress
    test has ended, and then say so.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A folder from `lqrsim stress`."""
    out: Annotated[Path | None, optional("FILE")] = None
    """The page, .html, or the table: .csv, .tex or .md. By default report.html in that folder."""
    scenario: OwnScenario = None
    json: Json = False

    def run(self) -> int:
        from lqrsim.errors import check_path
        from lqrsim.stress.data_table import ENDINGS

        path = self.out or self.folder / "report.html"
        check_path("--out", path, suffixes=(".html", *ENDINGS))
        is_table = path.suffix.lower() in ENDINGS
        if is_table:
            refuse(self, ("videos",), f"with {path}, want it with a page, .html")
        console.check_output("--out", path.parent, path.name)
        results = ls.stress.Results(self.folder, scenario=self.scenario)
        if is_table:
            results.rates().save(path)
        else:
            with console.progress("reporting", "part") as progress:
                ls.report(results, **stated(self, ls.report, out=path, progress=progress))
        console.wrote(path)
        if console.wants_result():
            console.result(campaign=as_json.of_campaign(results))
        return 0


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare two stress tests, or two policies of one, cell by cell.

    Stress tests of the same seed are compared trial by trial. Prints the rates, their difference with its interval, and
    the p-value, adjusted for the number of cells.

      lqrsim compare runs/stress/quadrotor --policies smooth track
      lqrsim compare runs/first --with runs/second --out difference.tex
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A folder from `lqrsim stress`."""
    other: Annotated[Path | None, optional("FOLDER"), arg(name="with")] = None
    """Folder of the stress test to compare it with. By default the same."""
    policies: Annotated[tuple[str, str] | None, optional("POLICY POLICY")] = None
    """The policy of each. By default each policy with the one of the same name."""
    out: Annotated[Path | None, optional("FILE")] = None
    """File to write the table to: .csv, .tex or .md."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.errors import check_path
        from lqrsim.stress.data_table import ENDINGS

        if self.out is not None:
            check_path("--out", self.out, suffixes=ENDINGS)
            console.check_output("--out", self.out.parent, self.out.name)
        table = ls.stress.compare(self.folder, self.other, policies=self.policies)
        console.say(str(table))
        if self.out is not None:
            console.wrote(table.save(self.out))
        console.result(cells=as_json.rows_of(table.columns), notes=table.notes)
        return 0

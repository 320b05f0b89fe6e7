"""Commands that measure how policies fail: stress tests, rare failures, the smallest failure, and funnels."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, Suppress, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import DesignSet, Folder, Json, SolutionFile, arguments_for, optional, options_of, refuse

PolicyName = Literal["smooth", "ilqr", "open_loop", "replan", "track", "offset_free"]
CampaignPolicyName = Literal[PolicyName, "track_per_cell", "offset_free_per_cell"]


@dataclass(frozen=True, kw_only=True)
@options_of("stress/study.py", "Setup", goal_radius="METRES", goal_tolerance="SHARE", seed="INT")
class SetupOptions:
    """The options that state a `Setup`, for commands that run a scenario under disturbances."""

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    design_disturbances: DesignSet = None
    solution: SolutionFile = None
    json: Json = False


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
        from lqrsim.scenarios.references import folder_name, resolve

        def folder_of(scenario: ls.Scenario) -> Path:
            folder = self.out or Path("runs/stress") / folder_name(scenario)
            console.check_output("--out", folder)
            return folder

        if self.resume:
            accepted = {"scenario", "solution", "out", "resume", "json", "workers", "batch", "scheduler"}
            refuse(self, vars(self).keys() - accepted, "with --resume, which has the campaign's own, want it without")
            folder = folder_of(resolve(self.scenario))
            campaign = ls.stress.Results(folder, scenario=self.scenario).campaign
            campaign = campaign if self.solution is None else replace(campaign, solution=self.solution)
        else:
            campaign = ls.stress.Campaign.of_sets(sets=self.sweep, **arguments_for(ls.stress.Campaign, self))
            folder = folder_of(campaign.resolved)
        with console.Progress("stressing", "trial") as progress:
            options = arguments_for(ls.stress.run_campaign, self, progress=progress)
            results = ls.stress.run_campaign(campaign, folder, **options)
        console.say(results.summary())
        console.wrote(folder)
        console.say(f"\nnext:\n  {results.command_of('report')}")
        if console.wants_result():
            console.result(campaign=console.of_campaign(results))
        return 1 if any(so_far.tally["error"] for so_far in results.cell_summaries().values()) else 0


OwnScenario = Annotated[
    str | None, optional("SCENARIO", "The scenario, if it is your own function: files never choose code to run.")
]
CampaignFolder = Annotated[Positional[Path], arg(metavar="FOLDER", help="A folder from `lqrsim stress`.")]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Repeat one trial of a stress test exactly.

    Writes it to rollout.npz for `lqrsim render`. Obstacles stop the robot here, unlike in the campaign; nothing after a
    collision counts. Compares the result with the trial's row in the campaign's table and reports differences; exits
    with 1 if there are any. On another kind of processor, or with other versions, results can differ; it then says so.
    """

    folder: CampaignFolder
    cell: Annotated[str, arg(metavar="CELL")]
    """policy,sweep,strength, such as smooth,light,1.5; or the number with which the names of its files begin."""
    trial: int
    """Number of the trial, from 0."""
    scenario: OwnScenario = None
    out: Annotated[Path, arg(metavar="FILE.npz")] = Path("rollout.npz")
    """File to write."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.machine import changed
        from lqrsim.stress.results import differences

        console.check_output("--out", self.out, "file")
        results = ls.stress.Results(self.folder, scenario=self.scenario)
        cell = ls.stress.Cell.named(self.cell, results.cells)
        if others := changed(results.manifest.versions):
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
            run = console.of_rollout(rollout, results.runner.scenario.problem)
            console.result(cell=cell, run=run, differences=different)
        return 1 if different else 0


@dataclass(frozen=True, kw_only=True)
@options_of("reports.py", "report", videos="INT")
class Report:
    """Write the report of a stress test: a page, or a table for a paper.

    The page is one HTML file with tables, curves and videos of the worst trials, which needs no network. The table has
    the success rates with their intervals, as CSV, LaTeX (booktabs) or Markdown. Both can be written before the stress
    test has ended, and then say so.
    """

    folder: CampaignFolder
    out: Annotated[Path | None, optional("FILE")] = None
    """The page, .html, or the table: .csv, .tex or .md. By default report.html in that folder."""
    scenario: OwnScenario = None
    json: Json = False

    def run(self) -> int:
        from lqrsim.results.display import ENDINGS

        path = self.out or self.folder / "report.html"
        console.check_output("--out", path, "file", suffixes=(".html", *ENDINGS))
        is_table = path.suffix.lower() in ENDINGS
        if is_table:
            refuse(self, ("videos",), f"with {path}, want it with a page, .html")
        results = ls.stress.Results(self.folder, scenario=self.scenario)
        if is_table:
            results.rates().save(path)
        else:
            with console.Progress("reporting", "part") as progress:
                ls.report(results, **arguments_for(ls.report, self, out=path, progress=progress))
        console.wrote(path)
        if console.wants_result():
            console.result(campaign=console.of_campaign(results))
        return 0


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare two stress tests, or two policies of one, cell by cell.

    Stress tests of the same seed are compared trial by trial. Prints the rates, their difference with its interval, and
    the p-value, adjusted for the number of cells.

      lqrsim compare runs/stress/quadrotor --policies smooth track
      lqrsim compare runs/first --with runs/second --out difference.tex
    """

    folder: CampaignFolder
    other: Annotated[Path | None, optional("FOLDER"), arg(name="with")] = None
    """Folder of the stress test to compare it with. By default the same."""
    policies: Annotated[tuple[str, str] | None, optional("POLICY POLICY")] = None
    """The policy of each. By default each policy with the one of the same name."""
    out: Annotated[Path | None, optional("FILE")] = None
    """File to write the table to: .csv, .tex or .md."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.results.display import ENDINGS

        if self.out is not None:
            console.check_output("--out", self.out, "file", suffixes=ENDINGS)
        table = ls.stress.compare(self.folder, self.other, policies=self.policies)
        console.say(str(table))
        if self.out is not None:
            console.wrote(table.save(self.out))
        console.result(cells=console.rows_of(table.columns), notes=table.notes)
        return 0


@dataclass(frozen=True, kw_only=True)
@options_of("stress/study.py", "Study", strength="FACTOR")
class StudyOptions(SetupOptions):
    """The options that state a `Study`, for commands that examine one policy."""

    strength: float = 1.0
    policy: PolicyName = "smooth"
    """As in `lqrsim stress`."""


@dataclass(frozen=True, kw_only=True)
@options_of("stress/failure_search.py", "ReliabilityProblem", failure=None)
@options_of("stress/study.py", "Study", sweep="NAME")
class FailureOptions(StudyOptions):
    """Options of `rare`, `break` and `harden`."""

    out: Folder = None
    """Output folder. By default runs/, the name of the command, and the name of the scenario."""

    def run(self) -> int:
        from lqrsim.errors import check_count
        from lqrsim.scenarios.references import folder_name

        problem = ls.stress.ReliabilityProblem(**arguments_for(ls.stress.ReliabilityProblem, self))
        folder = self.out or Path("runs") / type(self).__name__.lower() / folder_name(problem.resolved)
        check_count("shown", getattr(self, "shown", 1))
        console.check_output("--out", folder)

        def write(result: Any) -> int:
            console.say(self._words(result))
            runs = result.save(folder, **arguments_for(result.save, self))
            if runs is not None:
                console.say(runs.summary())
            for name in self.FILES if runs is not None else self.FILES[:2]:
                console.wrote(folder / name)
            command = type(self).__name__.lower()
            console.result(**json.loads((folder / f"{command}.json").read_text(encoding="utf-8")))
            return 0 if getattr(result, "success", True) else 1

        try:
            with console.keeping(write), console.Progress(*self.SEARCH) as progress:
                search = self._search(problem)
                result = search(**arguments_for(search, self, report=console.say, progress=progress))
        except ls.stress.NoFailure as none:
            return _say_none(none)
        return write(result)

    SEARCH: ClassVar[tuple[str, str]]  # what the command does, and in which units, for its progress
    FILES: ClassVar[tuple[str, ...]]  # what it writes; without failures the first two

    def _search(self, problem: "ls.stress.ReliabilityProblem") -> Callable[..., Any]:
        """The function that searches, of the command's options and of callbacks."""
        raise NotImplementedError

    def _words(self, result: Any) -> str:
        return result.summary()


@dataclass(frozen=True, kw_only=True)
@options_of("stress/failure_search.py", "ReliabilityProblem.rare_failures", particles="INT", repetitions="INT")
class Rare(FailureOptions):
    """Estimate the probability of a rare failure.

    Multilevel splitting needs far fewer trials than plain sampling: it multiplies the probabilities of levels that come
    nearer and nearer to a failure. Prints the levels as a pilot run finds them, then the probability with its interval,
    from independent, unbiased repetitions. Writes rollout.npz, with the worst failure and typical ones, for `lqrsim
    render`, rare.json, with settings and results, and certificate.npz, for `lqrsim certify`. Ctrl-C keeps the
    repetitions that are done, from the second on.

    Exits with 1 if no failure was found.
    """

    shown: int = 8
    """Number of failures to write."""

    SEARCH = "splitting", "repetition"
    FILES = "rollout.npz", "rare.json", "certificate.npz"

    def _search(self, problem: "ls.stress.ReliabilityProblem") -> Callable[..., Any]:
        return problem.rare_failures

    def _words(self, result: Any) -> str:
        failures = len(result.splitting.failures)
        others = min(failures, self.shown) - 1
        return f"{result.summary()}\nthe worst of {failures:,} failures, as trial 0, and {others} others:"


@dataclass(frozen=True, kw_only=True)
@options_of("stress/failure_search.py", "ReliabilityProblem.smallest_failure", rounds="INT", particles="INT")
class Break(FailureOptions):
    """Find the smallest disturbance that causes a failure.

    It is the failure nearest to the undisturbed trial, measured over all random numbers of a trial in standard
    deviations. Prints that distance, the first-order estimate of the failure probability, the contribution of each
    disturbance, and the largest values in physical units. Writes rollout.npz, with that trial, for `lqrsim render`, and
    break.json, with settings, results and the random numbers. Ctrl-C keeps the result of the rounds that are done.

    The result does fail; that nothing nearer fails is not proven. Exits with 1 if no failure was found.
    """

    SEARCH = "searching", "round"
    FILES = "rollout.npz", "break.json"

    def _search(self, problem: "ls.stress.ReliabilityProblem") -> Callable[..., Any]:
        return problem.smallest_failure


@dataclass(frozen=True, kw_only=True)
@options_of("stress/safer_plans.py", "harden", chance="FLOAT", rounds="INT", particles="INT", repetitions="INT")
class Harden(FailureOptions):
    """Find a plan whose measured probability of failure is low enough.

    The first plan has the wanted chance of collision by prediction, or is the given solution. Each plan's failures are
    measured with all disturbances, as by `lqrsim rare`; the next plan has more room where runs fail, and less where it
    has too much. The first that is safe enough is measured again, with fresh random numbers. Writes solution.npz, for
    `--solution` of other commands, harden.json, with settings and plans, and the files of `lqrsim rare`; `lqrsim
    certify` checks certificate.npz. Ctrl-C keeps the plans that are measured.

      lqrsim harden quadrotor --sweep moderate --chance 0.01

    Exits with 1 if the wanted probability is not reached; the output says why.
    """

    policy: Literal["smooth", "track", "offset_free"] = "offset_free"
    """As in `lqrsim stress`."""
    failure: Suppress[Literal["collision"]] = "collision"
    shown: int = 8
    """Number of failures to write."""

    SEARCH = "hardening", "repetition"
    FILES = "solution.npz", "harden.json", "rollout.npz", "rare.json", "certificate.npz"

    def _search(self, problem: "ls.stress.ReliabilityProblem") -> Callable[..., Any]:
        return partial(ls.stress.harden, problem)

    def _words(self, result: Any) -> str:
        return result.verdict()


@dataclass(frozen=True, kw_only=True)
@options_of("stress/failure_search.py", "certify", repetitions="INT", seed="INT")
class Certify:
    """Check a certificate by measuring it again.

    Repeats the splitting of `lqrsim rare` with the plan, policy, disturbances and seed of the certificate, in whole or
    in part. With the same versions and processor it must give the same bits; with others the intervals must overlap.

      lqrsim certify runs/rare/quadrotor/certificate.npz --repetitions 2

    Exits with 1 if something is not as certified.
    """

    file: Annotated[Positional[Path], arg(metavar="FILE.npz")]
    """certificate.npz from `lqrsim rare` or `harden`."""
    scenario: OwnScenario = None
    json: Json = False

    def run(self) -> int:
        certificate = ls.load(self.file, ls.stress.FailureCertificate)
        console.say(certificate.summary())
        try:
            with console.Progress("splitting", "repetition") as progress:
                recheck = ls.stress.certify(certificate, **arguments_for(ls.stress.certify, self, progress=progress))
        except ls.stress.NoFailure as none:
            return _say_none(none)
        console.say(recheck.summary())
        estimate = recheck.measured.probability
        console.result(
            probability=certificate.probability, low=certificate.low, high=certificate.high,
            measured={"probability": estimate.value, "low": estimate.low, "high": estimate.high},
            repetitions=len(recheck.measured.splitting.repetitions), differences=recheck.differences,
            changed=recheck.changed or None,
        )  # fmt: skip
        return 1 if recheck.differences else 0


def _say_none(none: Exception) -> int:
    console.say(f"no failure was found ({none})")
    console.result(found=None, reason=str(none))
    return 1


@dataclass(frozen=True, kw_only=True)
@options_of("stress/funnels.py", "funnel", rate="FLOAT", failures="INT", knots="N ...", states="NAME ...")
class FunnelCommand(StudyOptions):
    """Find from how far off its plan a policy still works.

    Prints, for some knots of the plan, the largest ellipsoid about it from which runs under disturbances reach the goal
    with the wanted success rate, and the fresh trials that certify it. Writes funnel.npz, and funnel.png if the robot
    has a position. Solves the scenario first, unless a solution is given. Ctrl-C keeps the knots that are done.

      lqrsim funnel quadrotor --disturbances light --rate 0.9
      lqrsim funnel differential_drive --states x y --knots 0 50 100

    Exits with 1 if there is no level at any knot.
    """

    disturbances: Annotated[tuple[str, ...], optional("NAME ...")] = ("scenario",)
    """Sets by name, as in `lqrsim simulate`. By default the disturbances of the scenario's demo."""
    confidence: float = 0.95
    """Probability that all levels are right."""
    out: Folder = None
    """Output folder. By default runs/funnel/ and the name of the scenario."""

    def run(self) -> int:
        from lqrsim.scenarios.references import disturbance_set, folder_name
        from lqrsim.stress.funnels import level_test

        study = ls.stress.Study(**arguments_for(ls.stress.Study, self))
        scenario = study.resolved
        folder = self.out or Path("runs/funnel") / folder_name(scenario)
        console.check_output("--out", folder)
        space, steps = scenario.problem.dynamics.state_coordinates, scenario.problem.steps
        level_test(space, steps, **arguments_for(level_test, self))  # checked before the solve
        disturbances = []
        for name in self.disturbances:
            for disturbance in disturbance_set(name, scenario):
                if isinstance(disturbance, ls.disturbances.InitialStateError):
                    console.say("without the InitialStateError of the set: runs begin in states of the funnel")
                    disturbance = disturbance.scaled(0.0)  # keeps the other disturbances' random numbers
                disturbances.append(disturbance.scaled(self.strength))
        options = arguments_for(ls.funnel, self, **study.closed_loop, disturbances=disturbances)

        def write(result: "ls.types.Funnel") -> int:
            console.say(result.summary())
            console.result(funnel=console.of_funnel(result))
            console.save(result, folder / "funnel.npz")
            if space.position and set(space.position) <= set(result.chosen):
                world, radius = scenario.scene.world, scenario.robot.shape.get("radius", 0.0)
                console.wrote(ls.view.plot_funnel(result, folder / "funnel.png", world=world, radius=radius))
            return 0 if result.levels.any() else 1

        with console.keeping(write), console.Progress("looking", "knot") as progress:
            funnel = ls.funnel(**options, progress=progress)
        return write(funnel)

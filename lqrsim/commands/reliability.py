"""Commands that examine how reliable a policy is: rare failures, the smallest failure, and funnels."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, Suppress, arg

from lqrsim.commands.options import Folder, Json, OwnScenario, StudyOptions, optional, stated

if TYPE_CHECKING:
    from lqrsim.results.funnel import Funnel
    from lqrsim.stress.failure_search import RareFailures, ReliabilityProblem, SmallestFailure
    from lqrsim.stress.hardening import HardenedPlan


@dataclass(frozen=True, kw_only=True)
class FailureOptions(StudyOptions):
    """Options of `rare`, `break` and `harden`."""

    sweep: Annotated[str, arg(metavar="NAME")] = "scenario"
    """Disturbances, as in `lqrsim stress`. By default the disturbances of the scenario's demo."""
    failure: Literal["collision", "miss"] = "collision"
    """collision: the robot hits an obstacle, or its simulation diverges. miss: it does not reach its goal, which is
    what `lqrsim stress` calls a failure."""

    out: Folder = None
    """Output folder. By default runs/, the name of the command, and the name of the scenario."""

    def _begin(self, command: str) -> "tuple[ReliabilityProblem, Path]":
        """The problem, and the folder for the results. Raises InputError for a folder that cannot be written."""
        from lqrsim.commands import console
        from lqrsim.scenarios.references import folder_name
        from lqrsim.stress.failure_search import ReliabilityProblem

        problem = ReliabilityProblem(**stated(self, ReliabilityProblem))
        folder = self.out or Path("runs") / command / folder_name(problem.resolved)
        console.check_output("--out", folder)
        return problem, folder


@dataclass(frozen=True, kw_only=True)
class Rare(FailureOptions):
    """Estimate the probability of a rare failure.

    Multilevel splitting needs far fewer trials than plain sampling: it multiplies the probabilities of levels that come
    nearer and nearer to a failure. Prints the levels as a pilot run finds them, then the probability with its interval,
    from independent, unbiased repetitions. Writes rollout.npz, with the worst failure and typical ones, for `lqrsim
    render`, rare.json, with settings and results, and certificate.npz, for `lqrsim certify`. Ctrl-C keeps the
    repetitions that are done, from the second on.

    Exits with 1 if no failure was found.
    """

    particles: int = 250
    """Number of trials at each level. More of them give a shorter interval."""
    repetitions: int = 10
    """Number of independent repetitions; their spread gives the interval."""
    shown: int = 8
    """Number of failures to write."""

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.errors import check_count
        from lqrsim.stress.multilevel_splitting import NoFailure

        check_count("shown", self.shown)
        problem, folder = self._begin("rare")
        options = {"particles": self.particles, "repetitions": self.repetitions}

        def write(rare: "RareFailures") -> int:
            console.say(rare.summary())
            failures = len(rare.splitting.failures)
            written = min(failures, self.shown)
            console.say(f"the worst of {failures:,} failures, as trial 0, and {written - 1} others:")
            code = _write(rare, folder, "rare.json", shown=self.shown)
            console.wrote(folder / "certificate.npz")
            return code

        try:
            with console.keeping(write), console.progress("splitting", "repetition") as progress:
                rare = problem.rare_failures(report=console.say, progress=progress, **options)
        except NoFailure as none:
            return _say_none(none)
        return write(rare)


@dataclass(frozen=True, kw_only=True)
class Break(FailureOptions):
    """Find the smallest disturbance that causes a failure.

    It is the failure nearest to the undisturbed trial, measured over all random numbers of a trial in standard
    deviations. Prints that distance, the first-order estimate of the failure probability, the contribution of each
    disturbance, and the largest values in physical units. Writes rollout.npz, with that trial, for `lqrsim render`, and
    break.json, with settings, results and the random numbers. Ctrl-C keeps the result of the rounds that are done.

    The result does fail; that nothing nearer fails is not proven. Exits with 1 if no failure was found.
    """

    rounds: int = 40
    """Largest number of rounds; the search ends earlier if less than 1 % is left to gain."""
    particles: int = 200
    """Number of trials at each level of the splitting that finds first failures."""

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.stress.multilevel_splitting import NoFailure

        problem, folder = self._begin("break")

        def write(smallest: "SmallestFailure") -> int:
            console.say(smallest.summary())
            return _write(smallest, folder, "break.json")

        try:
            with console.keeping(write), console.progress("searching", "round") as progress:
                smallest = problem.smallest_failure(
                    rounds=self.rounds, particles=self.particles, report=console.say, progress=progress
                )
        except NoFailure as none:
            return _say_none(none)
        return write(smallest)


@dataclass(frozen=True, kw_only=True)
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
    chance: float = 1e-3
    """Wanted probability that the robot collides. The whole interval of the measured probability must be below it."""
    rounds: int = 4
    """Largest number of plans."""
    particles: Annotated[int | None, optional("INT")] = None
    """As in `lqrsim rare`. By default 250; for a chance from 0.005 on 10 / chance, so that failures are counted."""
    repetitions: int = 10
    """As in `lqrsim rare`."""
    shown: int = 8
    """Number of failures to write."""

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.errors import check_count
        from lqrsim.stress.hardening import harden

        check_count("shown", self.shown)
        problem, folder = self._begin("harden")

        def write(found: "HardenedPlan") -> int:
            console.say(found.verdict())
            shown = found.save(folder, shown=self.shown)
            written = ["solution.npz", "harden.json"]
            if shown is not None:
                console.say(shown.summary())
                written += ["rollout.npz", "rare.json", "certificate.npz"]
            for name in written:
                console.wrote(folder / name)
            console.result(**json.loads((folder / "harden.json").read_text(encoding="utf-8")))
            return 0 if found.success else 1

        with console.keeping(write), console.progress("hardening", "repetition") as progress:
            found = harden(
                problem,
                chance=self.chance,
                rounds=self.rounds,
                particles=self.particles,
                repetitions=self.repetitions,
                report=console.say,
                progress=progress,
            )
        return write(found)


@dataclass(frozen=True, kw_only=True)
class Certify:
    """Check a certificate by measuring it again.

    Repeats the splitting of `lqrsim rare` with the plan, policy, disturbances and seed of the certificate, in whole or
    in part. With the same versions and processor it must give the same bits; with others the intervals must overlap.

      lqrsim certify runs/rare/quadrotor/certificate.npz --repetitions 2

    Exits with 1 if something is not as certified.
    """

    file: Annotated[Positional[Path], arg(metavar="FILE.npz")]
    """certificate.npz from `lqrsim rare`."""
    repetitions: Annotated[int | None, optional("INT")] = None
    """Number of its repetitions to run, at least 2. By default all."""
    seed: Annotated[int | None, optional("INT")] = None
    """Another seed, for fresh random numbers: then the intervals are compared. By default the certificate's seed."""
    scenario: OwnScenario = None
    json: Json = False

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.results import save_load
        from lqrsim.results.certificate import FailureCertificate
        from lqrsim.stress.multilevel_splitting import NoFailure
        from lqrsim.stress.recheck import certify

        certificate = save_load.load(self.file, FailureCertificate)
        console.say(certificate.summary())
        try:
            with console.progress("splitting", "repetition") as progress:
                found = certify(
                    certificate, repetitions=self.repetitions, seed=self.seed, scenario=self.scenario, progress=progress
                )
        except NoFailure as none:
            return _say_none(none)
        console.say(found.summary())
        one = found.measured.probability
        console.result(
            probability=certificate.probability, low=certificate.low, high=certificate.high,
            measured={"probability": one.value, "low": one.low, "high": one.high},
            repetitions=len(found.measured.splitting.repetitions), differences=found.differences,
            changed=found.changed or None,
        )  # fmt: skip
        return 1 if found.differences else 0


def _say_none(none: Exception) -> int:
    from lqrsim.commands import console

    console.say(f"no failure was found ({none})")
    console.result(found=None, reason=str(none))
    return 1


def _write(found: "RareFailures | SmallestFailure", folder: Path, name: str, **options: int) -> int:
    """Write the failures, and print where they are. The result for `--json` is the content of the file."""
    from lqrsim.commands import console

    console.say(found.save(folder, **options).summary())
    console.wrote(folder / "rollout.npz")
    console.wrote(folder / name)
    console.result(**json.loads((folder / name).read_text(encoding="utf-8")))
    return 0


@dataclass(frozen=True, kw_only=True)
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
    rate: float = 0.99
    """Wanted fraction of runs that reach the goal."""
    confidence: float = 0.95
    """Probability that all levels are right."""
    knots: Annotated[tuple[int, ...], optional("N ...")] = ()
    """Numbers of the knots at which runs begin. By default five, from the first on."""
    states: Annotated[tuple[str, ...], optional("NAME ...")] = ()
    """States that may be off the plan. By default all."""
    failures: int = 3
    """Failures allowed in a test. With more, there are more trials, and levels come out larger."""
    out: Folder = None
    """Output folder. By default runs/funnel/ and the name of the scenario."""

    def run(self) -> int:
        from lqrsim.commands import as_json, console
        from lqrsim.results import save_load
        from lqrsim.scenarios.references import disturbance_set, folder_name
        from lqrsim.simulation.disturbances import InitialStateError
        from lqrsim.stress.funnels import FunnelOptions, funnel
        from lqrsim.stress.study import Study
        from lqrsim.view.plots import plot_funnel

        study = Study(**stated(self, Study))
        scenario = study.resolved
        folder = self.out or Path("runs/funnel") / folder_name(scenario)
        console.check_output("--out", folder)
        space, steps = scenario.problem.dynamics.state_coordinates, scenario.problem.steps
        knots, states = self.knots or None, self.states or None
        options = self.rate, self.confidence, knots, states, self.failures, None, self.seed
        FunnelOptions.of(space, steps, *options)  # checked before the solve
        disturbances = []
        for one in (one for name in self.disturbances for one in disturbance_set(name, scenario)):
            if isinstance(one, InitialStateError):
                console.say("without the InitialStateError of the set: runs begin in states of the funnel")
                one = one.scaled(0.0)  # keeps the other disturbances' random numbers
            disturbances.append(one.scaled(self.strength))
        closed_loop = study.closed_loop

        def write(found: "Funnel") -> int:
            console.say(found.summary())
            console.result(funnel=as_json.of_funnel(found))
            console.wrote(save_load.save(found, folder / "funnel.npz"))
            if space.position and set(space.position) <= set(found.chosen):
                world, radius = scenario.scene.world, scenario.robot.radius
                console.wrote(plot_funnel(found, folder / "funnel.png", world=world, radius=radius))
            return 0 if found.levels.any() else 1

        with console.keeping(write), console.progress("looking", "knot") as progress:
            found = funnel(
                **closed_loop,
                disturbances=disturbances,
                rate=self.rate,
                confidence=self.confidence,
                knots=knots,
                states=states,
                failures=self.failures,
                seed=self.seed,
                progress=progress,
            )
        return write(found)

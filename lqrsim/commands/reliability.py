"""Commands that examine how reliable a policy is: rare failures, the smallest failure, and funnels."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, Suppress, arg

import lqrsim as ls
from lqrsim.commands import as_json, console
from lqrsim.commands.options import Folder, Json, OwnScenario, StudyOptions, optional, options_of, stated

if TYPE_CHECKING:
    from lqrsim.results.funnel import Funnel
    from lqrsim.stress.failure_search import RareFailures, SmallestFailure
    from lqrsim.stress.hardening import HardenedPlan


@dataclass(frozen=True, kw_only=True)
class FailureOptions(StudyOptions):
    """Options of `rare`, `break` and `harden`."""

    sweep: Annotated[str, arg(metavar="NAME")] = "scenario"
    """Disturbances, as in `lqrsim stress`. By default the disturbances of the scenario's demo."""
    failure: Literal["collision", "miss"] = "collision"
    """collision: the robot hits an obstacle, its trial diverges, or its controller fails. miss: it does not reach its
    goal, which is what `lqrsim stress` calls a failure."""

    out: Folder = None
    """Output folder. By default runs/, the name of the command, and the name of the scenario."""

    def run(self) -> int:
        from lqrsim.errors import check_count
        from lqrsim.scenarios.references import folder_name

        problem = ls.stress.ReliabilityProblem(**stated(self, ls.stress.ReliabilityProblem))
        folder = self.out or Path("runs") / type(self).__name__.lower() / folder_name(problem.resolved)
        check_count("shown", getattr(self, "shown", 1))
        console.check_output("--out", folder)

        def write(result: Any) -> int:
            return self._write(result, folder)

        try:
            with console.keeping(write), console.progress(*self.SEARCH) as progress:
                result = self._search(problem, report=console.say, progress=progress)
        except ls.stress.NoFailure as none:
            return _say_none(none)
        return write(result)

    SEARCH: ClassVar[tuple[str, str]]  # what the command does, and in which units, for its progress

    def _search(self, problem: "ls.stress.ReliabilityProblem", **callbacks: Any) -> Any:
        """The result of the search, with these callbacks."""
        raise NotImplementedError

    def _write(self, result: Any, folder: Path) -> int:
        """Write a result, and print it. Returns the exit code."""
        raise NotImplementedError


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

    def _search(self, problem: "ls.stress.ReliabilityProblem", **callbacks: Any) -> "RareFailures":
        return problem.rare_failures(**stated(self, problem.rare_failures, **callbacks))

    def _write(self, result: "RareFailures", folder: Path) -> int:
        console.say(result.summary())
        failures = len(result.splitting.failures)
        others = min(failures, self.shown) - 1
        console.say(f"the worst of {failures:,} failures, as trial 0, and {others} others:")
        console.say(result.save(folder, shown=self.shown).summary())
        _wrote(folder, "rare.json", ("rollout.npz", "rare.json", "certificate.npz"))
        return 0


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

    def _search(self, problem: "ls.stress.ReliabilityProblem", **callbacks: Any) -> "SmallestFailure":
        return problem.smallest_failure(**stated(self, problem.smallest_failure, **callbacks))

    def _write(self, result: "SmallestFailure", folder: Path) -> int:
        console.say(result.summary())
        console.say(result.save(folder).summary())
        _wrote(folder, "break.json", ("rollout.npz", "break.json"))
        return 0


@dataclass(frozen=True, kw_only=True)
@options_of("stress/hardening.py", "harden", chance="FLOAT", rounds="INT", particles="INT", repetitions="INT")
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

    def _search(self, problem: "ls.stress.ReliabilityProblem", **callbacks: Any) -> "HardenedPlan":
        return ls.stress.harden(problem, **stated(self, ls.stress.harden, **callbacks))

    def _write(self, result: "HardenedPlan", folder: Path) -> int:
        console.say(result.verdict())
        shown, files = result.save(folder, shown=self.shown), ["solution.npz", "harden.json"]
        if shown is not None:
            console.say(shown.summary())
            files += ["rollout.npz", "rare.json", "certificate.npz"]
        _wrote(folder, "harden.json", files)
        return 0 if result.success else 1


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
            with console.progress("splitting", "repetition") as progress:
                recheck = ls.stress.certify(certificate, **stated(self, ls.stress.certify, progress=progress))
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


def _wrote(folder: Path, result: str, files: Sequence[str]) -> None:
    """Say which files were written. The result for `--json` is the content of one of them."""
    for name in files:
        console.wrote(folder / name)
    console.result(**json.loads((folder / result).read_text(encoding="utf-8")))


@dataclass(frozen=True, kw_only=True)
@options_of("stress/funnels.py", "funnel", rate="FLOAT", failures="INT")
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
    knots: Annotated[tuple[int, ...] | None, optional("N ...")] = None
    """Numbers of the knots at which runs begin. By default five, from the first on."""
    states: Annotated[tuple[str, ...] | None, optional("NAME ...")] = None
    """States that may be off the plan. By default all."""
    out: Folder = None
    """Output folder. By default runs/funnel/ and the name of the scenario."""

    def run(self) -> int:
        from lqrsim.scenarios.references import disturbance_set, folder_name
        from lqrsim.stress.funnels import level_test

        study = ls.stress.Study(**stated(self, ls.stress.Study))
        scenario = study.resolved
        folder = self.out or Path("runs/funnel") / folder_name(scenario)
        console.check_output("--out", folder)
        space, steps = scenario.problem.dynamics.state_coordinates, scenario.problem.steps
        level_test(space, steps, **stated(self, level_test))  # checked before the solve
        disturbances = []
        for name in self.disturbances:
            for disturbance in disturbance_set(name, scenario):
                if isinstance(disturbance, ls.disturbances.InitialStateError):
                    console.say("without the InitialStateError of the set: runs begin in states of the funnel")
                    disturbance = disturbance.scaled(0.0)  # keeps the other disturbances' random numbers
                disturbances.append(disturbance.scaled(self.strength))
        options = stated(self, ls.funnel, **study.closed_loop, disturbances=disturbances)

        def write(result: "Funnel") -> int:
            console.say(result.summary())
            console.result(funnel=as_json.of_funnel(result))
            console.save(result, folder / "funnel.npz")
            if space.position and set(space.position) <= set(result.chosen):
                world, radius = scenario.scene.world, scenario.robot.shape.get("radius", 0.0)
                console.wrote(ls.view.plot_funnel(result, folder / "funnel.png", world=world, radius=radius))
            return 0 if result.levels.any() else 1

        with console.keeping(write), console.progress("looking", "knot") as progress:
            funnel = ls.funnel(**options, progress=progress)
        return write(funnel)

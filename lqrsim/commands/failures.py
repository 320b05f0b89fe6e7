"""Commands that look for failures that random trials would seldom show."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from lqrsim.commands.options import Folder, Json, Policy, SolutionFile, optional

if TYPE_CHECKING:
    from lqrsim.results.rollout import Rollout
    from lqrsim.stress.failure_search import ReliabilityProblem


@dataclass(frozen=True, kw_only=True)
class Search:
    """Options of both commands."""

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    sweep: Annotated[str, arg(metavar="NAME")] = "scenario"
    """Disturbances, as in `lqrsim stress`. By default those of the scenario's demo."""
    strength: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """Factor by which the disturbances are scaled."""
    policy: Policy = "smooth"
    """As in `lqrsim stress`."""
    stated: Annotated[str | None, optional("NAME")] = None
    """Disturbances for which track or offset_free is designed, as in `lqrsim stress`. By default moderate."""
    solution: SolutionFile = None
    failure: Literal["collision", "miss"] = "collision"
    """collision: with an obstacle, or the robot is lost. miss: any trial that does not reach its goal."""
    goal_radius: Annotated[float | None, optional("METRES")] = None
    """Distance from the goal within which it counts as reached. By default the robot's radius."""
    goal_tolerance: Annotated[float | None, optional("SHARE")] = None
    """The same for goals without a position, relative to each state's range along the plan. By default 0.1."""
    seed: int = 0
    """Seed of all random numbers. The same seed gives the same output."""
    json: Json = False
    """Print the result as one JSON object, and everything else to stderr; see docs/json.md."""

    def _problem(self) -> "ReliabilityProblem":
        from lqrsim.stress.failure_search import ReliabilityProblem

        return ReliabilityProblem(
            self.scenario,
            sweep=self.sweep,
            strength=self.strength,
            policy=self.policy,
            stated=self.stated,
            solution=self.solution,
            failure=self.failure,
            goal_radius=self.goal_radius,
            goal_tolerance=self.goal_tolerance,
        )


@dataclass(frozen=True, kw_only=True)
class Rare(Search):
    """Estimate the probability of a rare failure.

    Multilevel splitting needs far fewer trials than plain sampling. Trials are split through levels of how near they
    come to a failure, each not rare given the one before. Prints the levels as a pilot run finds them, then the
    probability with its interval, from independent, unbiased repetitions. Writes rollout.npz, with the worst failure
    and typical ones, for `lqrsim render`, and rare.json, with settings and results.

    Exits with 1 if no failure was found.
    """

    particles: int = 250
    """Trials kept at each level. More make the interval shorter."""
    repetitions: int = 10
    """Independent repetitions; their spread gives the interval."""
    shown: int = 8
    """Number of failures to write."""
    out: Folder = None
    """Output folder. By default runs/rare/ and the name of the scenario."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import console
        from lqrsim.errors import check_count
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.stress.multilevel_splitting import NoFailure

        folder = self.out or Path("runs/rare") / folder_name(resolve(self.scenario))
        console.check_output("--out", folder)
        problem = self._problem()
        check_count("shown", self.shown)
        options = {"particles": self.particles, "repetitions": self.repetitions, "seed": self.seed}
        try:
            with console.long_progress("splitting", "repetition") as progress:
                rare = problem.rare_failures(report=console.say, progress=progress, **options)
        except NoFailure as none:
            console.say(f"no failure was found ({none})")
            console.result(found=None, reason=str(none))
            return 1
        console.say(rare.summary())
        rollout = rare.save(folder, shown=self.shown)
        failures = len(rare.splitting.failures)
        console.say(f"of {failures:,} failures the worst, as trial 0, and {rollout.trials - 1} others:")
        _say_written(rollout, folder, "rare.json")
        return 0


@dataclass(frozen=True, kw_only=True)
class Break(Search):
    """Find the smallest disturbance that causes a failure.

    It is the failure nearest to the undisturbed trial, measured over all random numbers of a trial in standard
    deviations. Prints that distance, the first-order estimate of the failure probability, the share of each
    disturbance, and the largest values in physical units. Writes rollout.npz, with that trial, for `lqrsim render`, and
    break.json, with settings, results and the random numbers.

    The result does fail; that nothing nearer fails is not proven. Exits with 1 if no failure was found.
    """

    rounds: int = 40
    """Largest number of rounds; the search ends earlier if less than 1 % is left to gain."""
    out: Folder = None
    """Output folder. By default runs/break/ and the name of the scenario."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import console
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.stress.multilevel_splitting import NoFailure

        folder = self.out or Path("runs/break") / folder_name(resolve(self.scenario))
        console.check_output("--out", folder)
        problem = self._problem()
        try:
            with console.long_progress("searching", "round") as progress:
                smallest = problem.smallest_failure(
                    rounds=self.rounds, seed=self.seed, report=console.say, progress=progress
                )
        except NoFailure as none:
            console.say(f"no failure was found ({none})")
            console.result(found=None, reason=str(none))
            return 1
        console.say(smallest.summary())
        _say_written(smallest.save(folder), folder, "break.json")
        return 0


def _say_written(rollout: "Rollout", folder: Path, name: str) -> None:
    """The trials that were written, and where they are; the result is that of the file."""
    from lqrsim.commands import console

    console.say(rollout.summary())
    console.wrote(folder / "rollout.npz")
    console.wrote(folder / name)
    console.result(**json.loads((folder / name).read_text(encoding="utf-8")))

"""Commands that look for failures that random trials would seldom show."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from lqrsim.commands.options import Folder, Policy, optional

if TYPE_CHECKING:
    from lqrsim.results.rollout import Rollout
    from lqrsim.stress.failure_search import ReliabilityProblem


@dataclass(frozen=True, kw_only=True)
class Search:
    """What both commands ask."""

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    sweep: Annotated[str, arg(metavar="NAME")] = "scenario"
    """Disturbances, as in `lqrsim stress`; by default those of the scenario's demo, which its policy should survive."""
    strength: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """What the disturbances are multiplied by."""
    policy: Policy = "smooth"
    """As in `lqrsim stress`."""
    stated: Annotated[str | None, optional("NAME")] = None
    """Disturbances that track or offset_free is made for, as in `lqrsim stress`. By default moderate."""
    failure: Literal["collision", "miss"] = "collision"
    """collision: with an obstacle, or lost. miss: any trial that does not reach its goal."""
    goal_radius: Annotated[float | None, optional("METRES")] = None
    """How near the goal counts as having reached it. By default the robot's radius."""
    goal_tolerance: Annotated[float | None, optional("SHARE")] = None
    """The same for goals without a position, relative to the plan's range of each state. By default 0.1."""
    seed: int = 0
    """Of all random draws. The same seed gives the same output."""

    def _problem(self) -> "ReliabilityProblem":
        from lqrsim.stress.failure_search import ReliabilityProblem

        return ReliabilityProblem(
            self.scenario,
            sweep=self.sweep,
            strength=self.strength,
            policy=self.policy,
            stated=self.stated,
            failure=self.failure,
            goal_radius=self.goal_radius,
            goal_tolerance=self.goal_tolerance,
        )


@dataclass(frozen=True, kw_only=True)
class Rare(Search):
    """Measure how likely a failure is that is seldom seen.

    It takes far fewer trials than would have to be run to see it by chance. Trials are split through levels of how near
    they come to failing, each not so rare given the one before. Prints the levels as a pilot run finds them, and then
    the probability with its interval, from repetitions that are independent and without bias. Writes rollout.npz, with
    the worst failure and others as they are typical, to be looked at with `lqrsim render`, and rare.json, with what was
    asked and found.

    Exits with 1 if no failure was found.
    """

    particles: int = 250
    """Trials that are kept at each level. More make the interval shorter."""
    repetitions: int = 10
    """Independent ones, of which the interval is made."""
    shown: int = 8
    """How many failures to write."""
    out: Folder = None
    """Folder for what is written. By default runs/rare/ and the name of the scenario."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
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
            return 1
        console.say(rare.summary())
        rollout = rare.save(folder, shown=self.shown)
        failures = len(rare.splitting.failures)
        console.say(f"of {failures:,} failures the worst, as trial 0, and {rollout.trials - 1} others:")
        _say_written(rollout, folder, "rare.json")
        return 0


@dataclass(frozen=True, kw_only=True)
class Break(Search):
    """Find the smallest disturbance that breaks the policy.

    Of all failures it is the one that is nearest to no disturbance. That is measured over all random numbers that a
    trial draws, in standard deviations. Prints it, what probability of failure that would be if nothing else failed
    than what lies beyond, how much of it falls to each disturbance, and what it does at its largest in physical units.
    Writes rollout.npz, with that trial, to be looked at with `lqrsim render`, and break.json, with what was asked and
    found, the numbers too.

    What it finds fails; that nothing nearer does is not proven. Exits with 1 if no failure was found.
    """

    rounds: int = 40
    """In which it comes nearer, at most; it ends where less than 1 % is left to be gained."""
    out: Folder = None
    """Folder for what is written. By default runs/break/ and the name of the scenario."""

    def run(self) -> int:
        """Carry the command out; its exit code."""
        from lqrsim.commands import console
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.stress.multilevel_splitting import NoFailure

        folder = self.out or Path("runs/break") / folder_name(resolve(self.scenario))
        console.check_output("--out", folder)
        problem = self._problem()
        try:
            with console.long_progress("coming nearer", "round") as progress:
                smallest = problem.smallest_failure(
                    rounds=self.rounds, seed=self.seed, report=console.say, progress=progress
                )
        except NoFailure as none:
            console.say(f"no failure was found ({none})")
            return 1
        console.say(smallest.summary())
        _say_written(smallest.save(folder), folder, "break.json")
        return 0


def _say_written(rollout: "Rollout", folder: Path, name: str) -> None:
    """The trials that were written, and where they are."""
    from lqrsim.commands import console

    console.say(rollout.summary())
    console.say(f"wrote {folder / 'rollout.npz'}")
    console.say(f"wrote {folder / name}")

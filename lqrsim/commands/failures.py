"""Commands that look for failures that random trials would seldom show."""

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from lqrsim.commands.options import Folder, optional

if TYPE_CHECKING:
    from collections.abc import Callable

    from lqrsim.errors import Array
    from lqrsim.stress.trial_score import TrialScore


@dataclass(frozen=True, kw_only=True)
class Search:
    """What both commands ask."""

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    sweep: Annotated[str, arg(metavar="NAME")] = "scenario"
    """Disturbances, as in `lqrsim stress`; by default those of the scenario's demo, which its policy should survive."""
    strength: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """What the disturbances are multiplied by."""
    policy: Literal["smooth", "ilqr", "open_loop", "replan"] = "smooth"
    """As in `lqrsim stress`."""
    failure: Literal["collision", "miss"] = "collision"
    """collision: with an obstacle, or lost. miss: any trial that does not reach its goal."""
    goal_radius: Annotated[float | None, optional("METRES")] = None
    """How near the goal counts as having reached it. By default the robot's radius."""
    goal_tolerance: Annotated[float | None, optional("SHARE")] = None
    """The same for goals without a position, relative to the plan's range of each state. By default 0.1."""
    seed: int = 0
    """Of all random draws. The same seed gives the same output."""

    def _trials(self) -> "tuple[TrialScore, dict[str, Any]]":
        """The trials as a function of the numbers that they draw, and what there is to say of them in a file."""
        from lqrsim.commands import console
        from lqrsim.errors import InputError, check_count, check_number
        from lqrsim.machine import description
        from lqrsim.scenarios.references import resolve
        from lqrsim.stress import trial_score
        from lqrsim.stress.manifest import digest_of, digest_of_solution
        from lqrsim.stress.specification import described
        from lqrsim.stress.sweeps import sweep
        from lqrsim.stress.trials import controller, solve
        from lqrsim.versions import versions

        check_number("strength", self.strength, above=0.0)
        check_count("seed", self.seed, at_least=0)
        scenario = resolve(self.scenario)
        disturbances = [one.scaled(self.strength) for one in sweep(self.sweep, scenario)]
        solution = solve((self.policy,), scenario)[self.policy]
        trials = trial_score.TrialScore(
            scenario.plant(),
            solution,
            disturbances,
            controller=controller(self.policy, scenario, solution),
            **scenario.near_enough(self.goal_radius, self.goal_tolerance),
            failure={"collision": trial_score.collision, "miss": trial_score.miss}[self.failure],
        )
        if self.failure == "collision" and not len(trials.plant.world):
            raise InputError(
                f"failure: got 'collision' for {self.scenario}, where nothing measures how near it is, want 'miss'"
            )
        if trials.size == 0:
            raise InputError(f"sweep: got {self.sweep!r}, in which nothing is random, want one that draws numbers")
        words = [one.describe(trials.plant) for one in disturbances]
        console.say(f"{self.policy} on {self.scenario}, {self.sweep} at strength {self.strength:g}: {'; '.join(words)}")
        console.say(f"a trial draws {trials.size:,} numbers; failure: {self.failure}")
        reach = scenario.target_radius(self.goal_radius, self.goal_tolerance)
        for line in solution.target.of_plan(reach):
            console.say(line)
        asked = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "out"}
        return trials, {
            "asked": asked,
            "disturbances": [described(one) for one in disturbances],
            "model": digest_of(scenario.scene.xml.encode()),
            "problem": scenario.problem.digest,
            "policy": digest_of_solution(solution),
            "versions": versions(),
            "machine": description(),
        }


def write(folder: Path, name: str, about: dict[str, Any], trials: "TrialScore", numbers: "Array") -> None:
    """The trials with these numbers as rollout.npz, and what was asked and found."""
    from dataclasses import replace

    from lqrsim.commands import console
    from lqrsim.results import files

    # As they look: stopped by what they run into, up to which they are the same to the bit.
    rollout = replace(trials, contacts=True).rollout(numbers)
    console.say(rollout.summary())
    console.say(f"wrote {files.save(rollout, folder / 'rollout.npz')}")
    path = folder / f"{name}.json"
    text = json.dumps({"format": f"lqrsim {name}", "version": 1, **about}, indent=1, allow_nan=False)
    with files.replacing(path) as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")
    console.say(f"wrote {path}")


@dataclass(frozen=True, kw_only=True)
class Rare(Search):
    """Measure how likely a failure is that is seldom seen.

    It takes far fewer trials than would have to be run to see it by chance. Trials are split through levels of how near
    they come to failing, each not so rare given the one before. Prints the levels as a first run finds them, and then
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
        import numpy as np

        from lqrsim.commands import console
        from lqrsim.errors import check_count
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.stress.multilevel_splitting import NoFailure, split

        folder = self.out or Path("runs/rare") / folder_name(resolve(self.scenario))
        console.check_output("--out", folder)
        check_count("particles", self.particles, at_least=20)
        check_count("repetitions", self.repetitions, at_least=2)
        check_count("shown", self.shown)
        trials, about = self._trials()
        try:
            with console.long_progress("splitting", "repetition") as progress:
                rare = split(
                    trials,
                    trials.size,
                    particles=self.particles,
                    repetitions=self.repetitions,
                    seed=self.seed,
                    level=_teller(trials),
                    progress=progress,
                )
        except NoFailure as none:
            console.say(f"no failure was found ({none})")
            return 1
        one, plain = rare.probability, rare.plain if np.isfinite(rare.plain) else None
        sure = f"{100 * one.confidence:g} % interval, {self.repetitions} repetitions"
        console.say(f"probability of failure: {one:.2g} ({sure})")
        alike = "unknown, for all repetitions agree" if plain is None else f"about {_rounded(plain)}"
        console.say(f"simulated: {rare.simulations:,} trials; plain ones for the same certainty: {alike}")
        # The worst, and others from all repetitions: they are distributed as failures are.
        worst = int(rare.scores.argmax())
        others = np.delete(np.arange(len(rare.scores)), worst)
        spread = np.linspace(0, len(others), self.shown - 1, endpoint=False).astype(int)
        rows = [worst, *others[np.unique(spread)[: len(others)]]]
        console.say(f"of {len(rare.scores):,} failures the worst, as trial 0, and {len(rows) - 1} others:")
        found = {
            "probability": one.value, "low": one.low, "high": one.high, "confidence": one.confidence,
            "standard_error": rare.standard_error, "repetitions": rare.repetitions.tolist(),
            "levels": rare.levels.tolist(), "moves": rare.sizes.tolist(), "simulations": rare.simulations,
            "plain_trials": plain, "failures": len(rare.scores),
        }  # fmt: skip
        write(folder, "rare", about | {"found": found}, trials, rare.failures[rows])
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
        import numpy as np

        from lqrsim.commands import console
        from lqrsim.errors import InputError, check_count
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.stress.design_point import in_words, smallest_failure
        from lqrsim.stress.multilevel_splitting import NoFailure, split

        folder = self.out or Path("runs/break") / folder_name(resolve(self.scenario))
        console.check_output("--out", folder)
        check_count("rounds", self.rounds, at_least=0)
        trials, about = self._trials()
        if trials(np.zeros((1, trials.size)))[0] > 0:
            raise InputError(f"scenario: got {self.scenario}, where {self.policy} fails with nothing random, want else")
        try:
            begun = split(
                trials, trials.size, particles=200, keep=0.2, repetitions=2, seed=self.seed, level=_teller(trials)
            )
        except NoFailure as none:
            console.say(f"no failure was found ({none})")
            return 1
        with console.long_progress("coming nearer", "round") as progress:
            nearest = smallest_failure(
                trials,
                trials.size,
                failures=begun.failures,
                rounds=self.rounds,
                seed=self.seed,
                progress=progress,
            )
        console.say(
            f"smallest failure: {nearest.distance:.3g} standard deviations from none, found with"
            f" {trials.simulations:,} trials"
        )
        if not nearest.converged:
            left = "an unknown share" if np.isnan(nearest.left) else f"some {100 * nearest.left:.1f} %"
            console.say(
                f"the rounds ended first: by the noise of what it knows, {left} may be left to gain; more --rounds"
            )
        console.say(
            f"if all failures lay beyond it, one trial in {_rounded(1 / max(nearest.form, 1e-300))} would fail"
            f" (reliability {1 - nearest.form:.6g}); `lqrsim rare` measures how many do"
        )
        rollout = trials.rollout(nearest.numbers[None], frames=False)
        ends = np.cumsum(trials.sizes)[:-1]
        shares = [float(part @ part) / nearest.distance**2 for part in np.split(nearest.numbers, ends)]
        for share, count, words in zip(shares, trials.sizes, rollout.disturbances, strict=True):
            if count:
                console.say(f"{100 * share:6.1f} % of its square: {words} ({count:,} of the numbers)")
        largest = in_words(rollout)
        for one in largest:
            console.say(f"largest {one.what}: {one.size:.3g} {one.unit}".rstrip() + f" at {one.time:.2f} s")
        found = {
            "distance": nearest.distance, "first_order_probability": nearest.form, "history": nearest.history.tolist(),
            "left": None if np.isnan(nearest.left) else nearest.left, "converged": nearest.converged,
            "simulations": trials.simulations, "shares": shares, "sizes": trials.sizes,
            "largest": [vars(one) for one in largest], "numbers": nearest.numbers.tolist(),
        }  # fmt: skip
        write(folder, "break", about | {"found": found}, trials, nearest.numbers[None])
        return 0


def _teller(trials: "TrialScore") -> "Callable[[float], None]":
    """Says a level of the score, with its unit."""
    from lqrsim.commands import console

    unit = "m" if len(trials.plant.world) else trials.solution.target.unit

    def say(level: float) -> None:
        console.say(f"level: {-level:.3g} {unit} from failing" if level < 0 else "level: failing")

    return say


def _rounded(number: float) -> str:
    """Two digits of it, as a whole number where that is short."""
    return f"{float(f'{number:.2g}'):,.0f}" if number < 1e9 else f"{number:.2g}"

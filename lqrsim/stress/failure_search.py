"""How a policy fails where random trials seldom show it: how likely that is, and how little it takes.

problem = ReliabilityProblem("quadrotor", strength=2.0)
print(problem.rare_failures())  # by multilevel splitting, as `lqrsim rare`
print(problem.smallest_failure())  # the design point, as `lqrsim break`
"""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_function,
    check_kind,
    check_name,
    check_number,
    check_path,
    check_seed,
    check_text,
)
from lqrsim.machine import description
from lqrsim.results import save_load
from lqrsim.results.hashing import sha256
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios import solutions as solving
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.stress.design_point import DesignPoint, LargestEffect, largest_effects, smallest_failure
from lqrsim.stress.manifest import digest_of_solution
from lqrsim.stress.multilevel_splitting import MOST, SplittingResult, split
from lqrsim.stress.specification import POLICIES, check_told, disturbance_as_json
from lqrsim.stress.statistics import Estimate
from lqrsim.stress.sweeps import sweep
from lqrsim.stress.trial_score import TrialScore, collision, miss
from lqrsim.stress.trials import controller_of, solve
from lqrsim.versions import versions

FAILURES = {"collision": collision, "miss": miss}
Report = Callable[[str], object]
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class ReliabilityProblem:
    """A policy of a scenario under disturbances, and what counts as its failure. It is solved when it is first needed.

    Attributes:
      scenario: what is run, as `lqrsim solve` takes it.
      sweep: disturbances, as `lqrsim stress` names them; by default those of the scenario's demo.
      strength: what they are multiplied by.
      policy: as in `Campaign`.
      stated: disturbances that "track" or "offset_free" is made for, by name like `sweep`; by default as in `Campaign`.
      failure: "collision", with an obstacle, or lost; "miss", any trial that does not reach its goal.
      goal_radius: in metres, within which the goal counts as reached, as in `simulate`; by default the scenario's.
      goal_tolerance: the same as a scaled error, for robots without a position; by default the scenario's.
      solution: a Solution, or the path of one, that runs in place of what its solver would find, as in `run_campaign`.

    Raises:
      InputError: something is not as described.
    """

    scenario: str
    _: KW_ONLY
    sweep: str = "scenario"
    strength: float = 1.0
    policy: str = "smooth"
    failure: str = "collision"
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    stated: str | None = None
    solution: Solution | str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        check_text("scenario", self.scenario, "a reference, such as 'quadrotor'", at_most=4000)
        check_text("sweep", self.sweep, "a name, such as 'light'")
        object.__setattr__(self, "strength", check_number("strength", self.strength, above=0.0))
        check_name("policy", self.policy, POLICIES)
        if self.stated is not None:
            check_told("stated", (self.policy,))
            check_text("stated", self.stated, "a name, such as 'light'")
        check_name("failure", self.failure, FAILURES)
        kinds = (Solution, str, os.PathLike, type(None))
        check_kind("solution", self.solution, kinds, "a Solution, the path of one, or None")
        for field in ("goal_radius", "goal_tolerance"):
            if (value := getattr(self, field)) is not None:
                object.__setattr__(self, field, check_number(field, value, above=0.0))

    @cached_property
    def score(self) -> TrialScore:
        """The trials as a function of the numbers that they draw. Raises InputError where no such failure can be."""
        scenario, disturbances = self.resolved, self.disturbances
        plant = scenario.plant()
        if self.failure == "collision" and not len(plant.world):
            raise InputError(
                f"failure: got 'collision' for {self.scenario}, where nothing measures how near it is, want 'miss'"
            )
        stated = None if self.stated is None else sweep(self.stated, scenario)
        solution = solve((self.policy,), scenario, stated, self.given)[self.policy]
        score = TrialScore(
            plant,
            solution,
            disturbances,
            controller=controller_of(self.policy, scenario, solution, stated=stated),
            **scenario.near_enough(self.goal_radius, self.goal_tolerance),
            failure=FAILURES[self.failure],
        )
        if score.size == 0:
            raise InputError(f"sweep: got {self.sweep!r}, in which nothing is random, want one that draws numbers")
        return score

    @cached_property
    def resolved(self) -> Scenario:
        """The scenario that the reference names. Raises InputError if there is none."""
        return resolve(self.scenario)

    @cached_property
    def given(self) -> Solution | None:
        """The solution that runs in place of a solve, if there is one. Raises InputError where it does not fit."""
        return None if self.solution is None else solving.given(self.resolved, self.solution)

    @cached_property
    def disturbances(self) -> list[Disturbance]:
        """Those of the sweep at that strength. Raises InputError for an unknown one."""
        return [one.scaled(self.strength) for one in sweep(self.sweep, self.resolved)]

    def summary(self) -> str:
        """What is run, what fails, and where the plan ends, in some lines. Raises InputError as `score` does."""
        score = self.score
        words = "; ".join(one.describe(score.plant) for one in self.disturbances)
        lines = [
            f"{self.policy} on {self.scenario}, {self.sweep} at strength {self.strength:g}: {words}",
            f"a trial draws {score.size:,} numbers; failure: {self.failure}",
        ]
        radius = self.resolved.target_radius(self.goal_radius, self.goal_tolerance)
        return "\n".join(lines + score.solution.target.of_plan(radius))

    def rare_failures(
        self,
        *,
        particles: int = 250,
        repetitions: int = 10,
        seed: int = 0,
        report: Report | None = None,
        progress: Progress | None = None,
    ) -> "RareFailures":
        """How likely a failure is that is seldom seen, by multilevel splitting: see `split`.

        Args:
          particles: trials that are kept at each level.
          repetitions: independent ones, of which the interval is made.
          seed: of all random numbers.
          report: called with the summary, and with a line for each level as the pilot run finds it.
          progress: called with the repetitions that are done, and all of them.

        Returns:
          The probability with its interval, and the failures that were seen.

        Raises:
          InputError: an option is out of range, or as `score` does.
          NoFailure: none was found.
        """
        options: dict[str, Any] = {
            "seed": check_seed("seed", seed),
            "particles": check_count("particles", particles, at_least=20),
            "repetitions": check_count("repetitions", repetitions, at_least=2, at_most=MOST),
        }
        self._check_callbacks(report, progress)
        score = self._reported(report)
        splitting = split(score, score.size, level=self._level(report), progress=progress, **options)
        return RareFailures(self, splitting, options)

    def smallest_failure(
        self,
        *,
        rounds: int = 40,
        seed: int = 0,
        report: Report | None = None,
        progress: Progress | None = None,
    ) -> "SmallestFailure":
        """The smallest disturbance that breaks the policy: the failure nearest to none at all, see `smallest_failure`.

        Args:
          rounds: in which it comes nearer, at most.
          seed: of all random numbers.
          report: called with the summary, and with a line for each level of the splitting that finds first failures.
          progress: called with the rounds that are done, and all of them.

        Returns:
          The failure, its distance and its parts.

        Raises:
          InputError: an option is out of range, the policy fails with nothing random, or as `score` does.
          NoFailure: none was found.
        """
        seed, rounds = check_seed("seed", seed), check_count("rounds", rounds, at_least=0, at_most=MOST)
        self._check_callbacks(report, progress)
        score = self._reported(report)
        before = score.simulations
        if score(np.zeros((1, score.size)))[0] > 0:
            raise InputError(f"scenario: got {self.scenario}, where {self.policy} fails with nothing random, want else")
        first = split(score, score.size, particles=200, keep=0.2, repetitions=2, level=self._level(report), seed=seed)
        point = smallest_failure(
            score, score.size, failures=first.failures, rounds=rounds, progress=progress, seed=seed
        )
        simulations = score.simulations - before
        rollout = score.rollout(point.numbers[None], frames=False)
        ends = np.cumsum(score.sizes)[:-1]
        return SmallestFailure(
            problem=self,
            point=point,
            simulations=simulations,
            disturbances=tuple(rollout.disturbances),
            shares=tuple(float(part @ part) / point.distance**2 for part in np.split(point.numbers, ends)),
            largest=tuple(largest_effects(rollout)),
            options={"seed": seed, "rounds": rounds},
        )

    def _reported(self, report: Report | None) -> TrialScore:
        if report is not None:
            report(self.summary())
        return self.score

    def _level(self, report: Report | None) -> Callable[[float], object] | None:
        """Reports a level of the score, with its unit."""
        if report is None:
            return None
        unit = "m" if len(self.score.plant.world) else self.score.solution.target.unit

        def report_level(level: float) -> None:
            report(f"level: {-level:.3g} {unit} from failing" if level < 0 else "level: failing")

        return report_level

    @staticmethod
    def _check_callbacks(report: Report | None, progress: Progress | None) -> None:
        check_function("report", report, "a function of a line of text", arguments=1)
        check_function("progress", progress, "a function of how much is done, of how much", arguments=2)


@dataclass(frozen=True)
class RareFailures:
    """How likely a policy fails, and failures as they are typical.

    Attributes:
      problem: whose failures. options: `seed`, `particles` and `repetitions`.
      splitting: the levels, the estimate of each repetition, and all failures that were found.
    """

    problem: ReliabilityProblem
    splitting: SplittingResult
    options: Mapping[str, int]

    @property
    def probability(self) -> Estimate:
        """Of failure, with its interval."""
        return self.splitting.probability

    @property
    def plain_trials(self) -> float | None:
        """How many plain trials have the same standard error, in the mean; None where all repetitions agree."""
        plain = self.splitting.plain_trials
        return plain if np.isfinite(plain) else None

    def summary(self) -> str:
        """The probability with its interval, and what it took, in two lines."""
        one, plain = self.probability, self.plain_trials
        interval = f"{100 * one.confidence:g} % interval, {self.options['repetitions']} repetitions"
        alike = "unknown, for all repetitions agree" if plain is None else f"about {_rounded(plain)}"
        return (
            f"probability of failure: {one:.2g} ({interval})\n"
            f"simulated: {self.splitting.simulations:,} trials; plain ones for the same certainty: {alike}"
        )

    __str__ = summary

    def typical(self, count: int = 8) -> Array:
        """The numbers of so many failures at most, (k, d): the worst first, then others, distributed as failures are.

        Raises:
          InputError: it is no number of failures.
        """
        check_count("count", count)
        scores = self.splitting.scores
        worst = int(scores.argmax())
        others = np.delete(np.arange(len(scores)), worst)  # of all repetitions, in their order
        chosen = np.linspace(0, len(others), count - 1, endpoint=False).astype(int)
        return self.splitting.failures[[worst, *others[np.unique(chosen)[: len(others)]]]]

    def save(self, folder: str | os.PathLike[str], *, shown: int = 8) -> Rollout:
        """Write rare.json, and so many typical failures as rollout.npz; returns these. Raises InputError."""
        folder, result, one = check_path("folder", folder, "the path of a folder"), self.splitting, self.probability
        numbers = self.typical(check_count("shown", shown))
        found = {
            "probability": one.value, "low": one.low, "high": one.high, "confidence": one.confidence,
            "standard_error": result.standard_error, "repetitions": result.repetitions.tolist(),
            "levels": result.levels.tolist(), "moves": result.step_sizes.tolist(), "simulations": result.simulations,
            "plain_trials": self.plain_trials, "failures": len(result.scores),
        }  # fmt: skip
        return _write(self.problem, folder, "rare", {**self.options, "shown": shown}, found, numbers)


@dataclass(frozen=True)
class SmallestFailure:
    """The failure nearest to no disturbance, and what it is made of.

    Attributes:
      problem: whose failure. options: `seed` and `rounds`.
      point: its numbers, how far that is in standard deviations, and how sure it is.
      simulations: trials that were run, those of the splitting before the search included.
      disturbances: in words. shares: of each in the square of the distance.
      largest: what they do at their largest, in physical units.
    """

    problem: ReliabilityProblem
    point: DesignPoint
    simulations: int
    disturbances: tuple[str, ...]
    shares: tuple[float, ...]
    largest: tuple[LargestEffect, ...]
    options: Mapping[str, int]

    def summary(self) -> str:
        """The distance, FORM's estimate, each disturbance's share, and what each is at its largest, a line each."""
        point = self.point
        lines = [
            f"smallest failure: {point.distance:.3g} standard deviations from the undisturbed trial, found with"
            f" {self.simulations:,} trials"
        ]
        if not point.converged:
            left = "an unknown share" if np.isnan(point.remaining) else f"some {100 * point.remaining:.1f} %"
            lines.append(
                f"the rounds ended first: by the noise of what it knows, {left} may be left to gain; more --rounds"
            )
        likely = point.first_order_probability
        lines.append(
            f"if all failures lay beyond it, one trial in {_rounded(1 / max(likely, 1e-300))} would fail"
            f" (reliability {1 - likely:.6g}); `lqrsim rare` measures how many do"
        )
        parts = zip(self.shares, self.problem.score.sizes, self.disturbances, strict=True)
        lines += [f"{100 * share:6.1f} % of its square: {words} ({count:,} of the numbers)"
                  for share, count, words in parts if count]  # fmt: skip
        lines += [
            f"largest {one.what}: {one.size:.3g} {one.unit}".rstrip() + f" at {one.time:.2f} s" for one in self.largest
        ]
        return "\n".join(lines)

    __str__ = summary

    def save(self, folder: str | os.PathLike[str]) -> Rollout:
        """Write break.json, and that trial as rollout.npz; returns the trial. Raises InputError."""
        folder, point = check_path("folder", folder, "the path of a folder"), self.point
        found = {
            "distance": point.distance, "first_order_probability": point.first_order_probability,
            "history": point.history.tolist(), "left": None if np.isnan(point.remaining) else point.remaining,
            "converged": point.converged, "simulations": self.simulations, "shares": self.shares,
            "sizes": self.problem.score.sizes, "largest": [vars(one) for one in self.largest],
            "numbers": point.numbers.tolist(),
        }  # fmt: skip
        return _write(self.problem, folder, "break", self.options, found, point.numbers[None])


def _write(
    problem: ReliabilityProblem,
    folder: Path,
    name: str,
    options: Mapping[str, Any],
    found: Mapping[str, Any],
    numbers: Array,
) -> Rollout:
    """Write trials with these numbers as rollout.npz, and what was asked and found as NAME.json; returns the trials."""
    # As they look: stopped by what they run into, up to which they are the same to the bit.
    rollout = replace(problem.score, contacts=True).rollout(numbers)
    asked = {field.name: getattr(problem, field.name) for field in fields(problem)} | dict(options)
    asked["solution"] = None if problem.given is None else digest_of_solution(problem.given)
    contents = {
        "format": f"lqrsim {name}",
        "version": 1,
        "asked": asked,
        "disturbances": [disturbance_as_json(one) for one in problem.disturbances],
        "model": sha256(problem.resolved.scene.xml),
        "problem": problem.resolved.problem.digest,
        "policy": digest_of_solution(problem.score.solution),
        "versions": versions(),
        "machine": description(),
        "found": found,
    }
    save_load.save(rollout, folder / "rollout.npz")
    with save_load.replacing(folder / f"{name}.json") as unfinished:
        unfinished.write_text(json.dumps(contents, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return rollout


def _rounded(number: float) -> str:
    """Two digits of it, as a whole number where that is short."""
    return f"{float(f'{number:.2g}'):,.0f}" if number < 1e9 else f"{number:.2g}"

"""Failures that random trials seldom show: their probability, and the smallest disturbance that causes one.

problem = ReliabilityProblem("quadrotor", strength=2.0)
print(problem.rare_failures())  # by multilevel splitting, as `lqrsim rare`
print(problem.smallest_failure())  # the design point, as `lqrsim break`
"""

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from lqrsim.annotations import Bounds, Count, Index, Seed, TextProgress, Want, checked
from lqrsim.control.controllers import ControllerLike, as_controller
from lqrsim.errors import Array, InputError, check_array, check_path, excerpt, shaped
from lqrsim.machine import changed, description, versions
from lqrsim.process import keeping
from lqrsim.results import save_load
from lqrsim.results.archive import plain, sha256, write_text
from lqrsim.results.certified import FailureCertificate
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.references import disturbance_set, names_code
from lqrsim.scenarios.solutions import digest_of_solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.plant import Plant
from lqrsim.stress import reliability
from lqrsim.stress.statistics import Estimate, rounded
from lqrsim.stress.study import Study, disturbances_as_json

Size = int | Sequence[int] | None
LEAST_DEPTH = 1e-9  # m; the score of a collision between two knots
ZEROS = np.broadcast_to(0.0, 10**12)  # more than any trial draws, in the memory of one number
PROBES = 32  # trials that show how much the disturbances change the clearance while the robot leaves an obstacle
STEADY = 20.0  # standard deviations; a larger mean clearance does not show which trials are near a collision


class PrescribedDraws:
    """The methods of NumPy's generators that disturbances use, with numbers made from given standard normal numbers.

    Each draw uses the next given number. Uniform draws are its normal distribution function.
    """

    def __init__(self, numbers: Array) -> None:
        self.numbers, self.used = numbers, 0

    def standard_normal(self, size: Size = None, dtype: npt.DTypeLike = np.float64) -> Any:
        count = 1 if size is None else int(np.prod(size))
        numbers = self._draw(count)
        return float(np.dtype(dtype).type(numbers[0])) if size is None else numbers.reshape(size).astype(dtype)

    def _draw(self, count: int) -> Array:
        if self.used + count > len(self.numbers):
            raise InputError(f"numbers: got {len(self.numbers)}, want more: a trial draws at least one more")
        self.used += count
        return self.numbers[self.used - count : self.used]

    def random(self, size: Size = None, dtype: npt.DTypeLike = np.float64) -> Any:
        kind = np.dtype(dtype).type
        return np.minimum(ndtr(self.standard_normal(size)).astype(kind), np.nextafter(kind(1), kind(0)))[()]

    def normal(self, loc: npt.ArrayLike = 0.0, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        return np.asarray(loc) + np.asarray(scale) * self.standard_normal(_shape(size, loc, scale))

    def uniform(self, low: npt.ArrayLike = 0.0, high: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        drawn = self.random(_shape(size, low, high))
        return np.asarray(low) + (np.asarray(high) - np.asarray(low)) * drawn

    def exponential(self, scale: npt.ArrayLike = 1.0, size: Size = None) -> Any:
        return -np.asarray(scale) * np.log1p(-self.random(_shape(size, scale)))

    def integers(
        self, low: npt.ArrayLike, high: npt.ArrayLike | None = None, size: Size = None,
        dtype: npt.DTypeLike = np.int64, endpoint: bool = False,
    ) -> Any:  # fmt: skip
        least, most = (0, low) if high is None else (low, high)
        least, most = np.asarray(least, dtype=np.int64), np.asarray(most, dtype=np.int64)
        drawn = np.floor(self.random(_shape(size, least, most)) * (most - least + endpoint)).astype(np.int64) + least
        return int(drawn) if not drawn.ndim and np.dtype(dtype) == np.int64 else drawn.astype(dtype)[()]

    def choice(
        self, a: int | npt.ArrayLike, size: Size = None, replace: bool = True, p: npt.ArrayLike | None = None,
        axis: int = 0, shuffle: bool = True,
    ) -> Any:  # fmt: skip
        options = np.arange(a) if isinstance(a, (int, np.integer)) else np.asarray(a)
        count = options.shape[axis]
        if not replace:
            if p is not None:
                raise InputError("choice: got p and replace=False, want one of the two")
            order = np.argsort(self.random(count))
            which = order[: 1 if size is None else int(np.prod(size))].reshape(() if size is None else size)
            return np.take(options, which, axis)[()]
        probabilities = np.full(count, 1 / count) if p is None else np.asarray(p, dtype=np.float64)
        which = np.searchsorted(np.cumsum(probabilities), self.random(size), side="right")
        return np.take(options, np.minimum(which, count - 1), axis)[()]

    def __getattr__(self, name: str) -> Any:
        known = "standard_normal, normal, random, uniform, exponential, integers or choice"
        raise InputError(f"disturbance: got draws by {name}, want {known}, which are made from standard normal numbers")


def _shape(size: Size, *arguments: npt.ArrayLike) -> Size:
    """The shape of the numbers that NumPy's generators draw with these arguments."""
    return size if size is not None else (np.broadcast_shapes(*(np.shape(argument) for argument in arguments)) or None)


@checked
def collision_score(rollout: Rollout, *, first: Index = 0) -> Array:
    """The depth in metres to which each trial enters obstacles, (K,); minus the least clearance without a collision.

    The score is positive exactly for trials that collide, diverge or have a failing controller; infinite for the latter
    two. The depth needs a rollout without contacts, in which the robot moves through the obstacles.

    Args:
      first: the first knot whose clearance counts in trials without a collision. See `TrialScore`.
    """
    if first > rollout.plan.steps:
        raise InputError(f"first: got {first}, want a whole number from 0 to {rollout.plan.steps}")
    depth = -np.where(np.isnan(rollout.clearance), np.inf, rollout.clearance).min(axis=1)
    outcome = np.array(rollout.outcome)
    clearance = np.where(rollout.counts, rollout.clearance, np.inf)[:, first:].min(axis=1)
    score = np.where(outcome == "collided", np.maximum(depth, LEAST_DEPTH), -clearance)
    return np.where(np.isin(outcome, ("diverged", "error")), np.inf, score)


@checked
def miss_score(rollout: Rollout, *, first: Index = 0) -> Array:
    """The distance by which each trial misses its goal, or a larger `collision_score`, (K,); positive if it fails.

    The unit is metres. For a goal without a position, the distance is the scaled error by which the trial is judged,
    and the score is the larger of this number and a depth in metres.
    """
    outside = np.nan_to_num(rollout.goal_distance - rollout.goal_radius, nan=-np.inf)
    return np.maximum(collision_score(rollout, first=first), outside)


@checked
@dataclass(eq=False)
class TrialScore:
    """The score of trials as a function of their random numbers: call it with numbers (K, size) for scores (K,).

    A trial fails if its score is positive. Standard normal numbers give trials with the distribution of `simulate`.

    If the robot starts close beside an obstacle and leaves it, its least clearance is the same in nearly all trials and
    does not tell which of them are near a failure. `collision_score` and `miss_score` then leave out the knots until it
    has left, as far as the clearance there is more than 20 of its standard deviations.

    The other arguments are as in `simulate`.

    Args:
      failure: returns the scores (K,) of a rollout.
      batch: number of trials that are run at once.

    Attributes:
      sizes: number of random numbers that each disturbance draws.
      first: the first knot whose clearance counts in trials without a collision.
    """

    _prefix = ""

    plant: Plant
    solution: Solution
    disturbances: Annotated[Sequence[Disturbance], Want("disturbances, such as ControlNoise(0.05)")]
    controller: ControllerLike | None = None
    failure: Annotated[Callable[[Rollout], Array], Want("a function of a Rollout")] = collision_score
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    contacts: bool = False
    batch: Count = 256
    threads: int | None = None

    def __post_init__(self) -> None:
        draws = [PrescribedDraws(ZEROS) for _ in self.disturbances]  # counts how many each draws
        usual = self._simulate(1, lambda trial, stream: draws[stream], frames=False)
        self.sizes = tuple(stream.used for stream in draws)
        self.first, clearance = 0, usual.clearance[0]
        # The number of knots until the clearance first falls by a tenth; it must be least before.
        departure = int((clearance < 0.9 * np.maximum.accumulate(clearance)).argmax())
        if not (departure and clearance[:departure].min() <= clearance[departure:].min()):
            return
        if self.size and self.failure in (collision_score, miss_score):
            numbers = np.random.default_rng(0).standard_normal((PROBES, self.size))
            probed = self.rollout(numbers, frames=False).clearance[:, :departure]
            steady = probed.mean(axis=0) > STEADY * probed.std(axis=0)
            self.first = departure if steady.all() else int(steady.argmin())

    @property
    def size(self) -> int:
        """Number of random numbers of a trial."""
        return sum(self.sizes)

    def __call__(self, numbers: npt.ArrayLike) -> Array:
        """The scores (K,) of trials with the given random numbers (K, size)."""
        vectors = check_array("numbers", numbers, (None, self.size))
        parts = (vectors[first : first + self.batch] for first in range(0, len(vectors), self.batch))
        options = {"first": self.first} if self.first else {}  # only lqrsim's own scores leave knots out
        scores: list[Array] = [np.zeros(0)]
        for part in parts:
            returned = self.failure(self.rollout(part, frames=False), **options)
            scores.append(shaped("failure: returned", returned, (len(part),)))
            if np.isnan(scores[-1]).any():
                raise InputError(f"failure: returned {excerpt(scores[-1].tolist())}, want numbers: positive is failure")
        return np.concatenate(scores)

    def rollout(self, numbers: npt.ArrayLike, *, frames: bool = True) -> Rollout:
        """The trials with the given random numbers (K, size); their `seed` means nothing."""
        vectors = check_array("numbers", numbers, (None, self.size))
        parts = np.split(vectors, np.cumsum(self.sizes)[:-1], axis=1)  # of each disturbance
        return self._simulate(len(vectors), lambda trial, stream: PrescribedDraws(parts[stream][trial]), frames=frames)

    def _simulate(self, trials: int, generators: Callable[[int, int], PrescribedDraws], *, frames: bool) -> Rollout:
        named = ("disturbances", "controller", "goal_radius", "goal_tolerance", "contacts", "threads")
        options = {name: getattr(self, name) for name in named} | {"trials": trials, "frames": frames}
        drawn = cast(Callable[[int, int], np.random.Generator], generators)
        return simulate(self.plant, self.solution, generators=drawn, **options)


FAILURES = {"collision": collision_score, "miss": miss_score}
TIE_REPORT_EVERY = 5.0  # s between reports while the pilot run draws more at a tie
Report = Annotated[Callable[[str], object], Want("a function of a line of text")]


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class ReliabilityProblem(Study):
    """A study, and a definition of its failure.

    Attributes:
      failure: with collision the robot collides, its trial diverges, or its controller fails; with miss it does not
        reach its goal, which is what a campaign calls a failure.
    """

    failure: Literal["collision", "miss"] = "collision"

    @cached_property
    def score(self) -> TrialScore:
        """The score of trials as a function of their random numbers. Raises InputError if no such failure can occur."""
        disturbances = self.disturbances  # checked before the scenario is solved
        if self.failure == "collision" and not len(self.resolved.plant().world):
            raise InputError(f"failure: got 'collision' for {self.scenario}, which has no obstacles, want 'miss'")
        score = TrialScore(**self.closed_loop, disturbances=disturbances, failure=FAILURES[self.failure])
        if score.size == 0:
            raise InputError(f"sweep: got {self.sweep!r}, in which nothing is random, want a random disturbance")
        return score

    @property
    def facts(self) -> dict[str, Any]:
        """The present meaning of the names: disturbances, model and policy. Raises InputError as `score`."""
        score = self.score
        law, _ = as_controller(score.controller, score.solution, score.plant.robot.dynamics)
        described = tuple(disturbance.describe(score.plant) for disturbance in self.disturbances)
        return {"disturbances": described, "model": sha256(self.resolved.scene.xml), "policy_digest": law.digest}

    def summary(self) -> str:
        """Lines that describe the run, the failure, and the plan's end. Raises InputError as `score`."""
        score = self.score
        words = "; ".join(disturbance.describe(score.plant) for disturbance in self.disturbances)
        lines = [
            f"{self.policy} on {self.scenario}, {self.sweep} at strength {self.strength:g}: {words}",
            f"a trial draws {score.size:,} numbers; failure: {self.failure}",
        ]
        target = score.solution.target
        radius = self.resolved.target_radius(self.goal_radius, self.goal_tolerance, target=target)
        return "\n".join(lines + target.of_plan(radius))

    @checked
    def rare_failures(
        self,
        *,
        particles: Annotated[int, Bounds(at_least=20)] = 250,
        repetitions: Annotated[int, Bounds(at_least=2, at_most=reliability.MOST_REPEATS)] = 10,
        keep: reliability.Keep = 0.1,
        seed: Seed | None = None,
        report: Report | None = None,
        progress: TextProgress | None = None,
    ) -> "RareFailures":
        """The probability of a rare failure, estimated by multilevel splitting: see `failure_probability`.

        Args:
          particles: number of trials at each level. More of them give a shorter interval.
          repetitions: number of independent estimates, whose spread gives the interval.
          keep: fraction of the trials that exceeds the next level, at least 2 / `particles`. With 0 there are no
            levels, and failures are counted.
          seed: seed of all random numbers; by default that of the study.
          report: called with the summary, and with a line for each level that the pilot run finds.

        Raises:
          KeyboardInterrupt: Ctrl-C; its `found` is the RareFailures of the repetitions that are done, or None.
        """
        reliability.check_keep(keep, particles)
        seed = self.seed if seed is None else seed
        options: dict[str, Any] = {"seed": seed, "particles": particles, "repetitions": repetitions, "keep": keep}
        score, level = self.score, self._begin(report)
        with keeping(lambda done: None if done is None else RareFailures(self, done, options)):
            splitting = reliability.failure_probability(score, score.size, level=level, progress=progress, **options)
        return RareFailures(self, splitting, options)

    @checked
    def smallest_failure(
        self,
        *,
        rounds: Annotated[int, Bounds(at_least=1, at_most=reliability.MOST_REPEATS)] = 40,
        particles: Annotated[int, Bounds(at_least=20)] = 200,
        seed: Seed | None = None,
        report: Report | None = None,
        progress: TextProgress | None = None,
    ) -> "SmallestFailure":
        """The smallest disturbance that makes the policy fail, as found by `lqrsim.stress.smallest_failure`.

        Args:
          rounds: largest number of rounds; the search ends earlier if less than 1 % is left to gain.
          particles: number of trials at each level of the splitting that finds first failures.
          seed: seed of all random numbers; by default that of the study.
          report: called with the summary, and with a line for each level of the splitting that finds first failures.

        Raises:
          KeyboardInterrupt: Ctrl-C; its `found` is the SmallestFailure after the rounds that are done, or None.
        """
        seed = self.seed if seed is None else seed
        options: dict[str, Any] = {"seed": seed, "rounds": rounds, "particles": particles}
        score, level = self.score, self._begin(report)
        if score(np.zeros((1, score.size)))[0] > 0:
            got = f"{self.policy}, which fails with all random numbers at zero"
            raise InputError(f"policy: got {got}, want one that succeeds when undisturbed")
        with keeping(lambda done: None if done is None else SmallestFailure(self, done, options)):
            point = reliability.smallest_failure(score, score.size, level=level, progress=progress, **options)
        return SmallestFailure(self, point, options)

    def _begin(self, report: Report | None) -> Callable[[float], object] | None:
        """Report the summary. Returns a function that reports a level of the score with its unit."""
        if report is None:
            return None
        report(self.summary())
        units = {self.score.solution.target.unit if self.failure == "miss" else "m"}
        units |= {"m"} if len(self.score.plant.world) else set()
        unit = f" {units.pop()}" if len(units) == 1 else ""  # else the level may be in either; see `miss_score`
        level_before, reported = math.nan, 0.0

        def report_level(level: float) -> None:
            nonlocal level_before, reported
            now = time.monotonic()
            tie = ", where scores tie: drawing more" if level == level_before else ""
            if not tie or now - reported > TIE_REPORT_EVERY:
                report(f"level: {-level:.3g}{unit} from failing{tie}" if level < 0 else "level: failing")
                reported = now
            level_before = level

        return report_level


@dataclass(frozen=True, eq=False)
class RareFailures:
    """The probability that a policy fails, and typical failures."""

    problem: ReliabilityProblem
    splitting: reliability.SplittingResult  # with the levels, each repetition's estimate, and all failures
    options: Mapping[str, Any]  # `seed`, `particles`, `repetitions` and `keep`

    @property
    def probability(self) -> Estimate:
        return self.splitting.probability

    @property
    def stopped(self) -> str:
        """The progress if it was stopped, such as "after 3 of 10 repetitions"; else empty."""
        done, requested = len(self.splitting.repetitions), self.options["repetitions"]
        return f"after {done} of {requested} repetitions" if done < requested else ""

    def summary(self) -> str:
        """The probability with its interval; the number of simulated trials; what splitting may miss; if stopped."""
        score, lines = self.problem.score, [f"stopped {self.stopped}"] if self.stopped else []
        lines.append(self.splitting.summary())
        drawn = zip(self.problem.disturbances, score.sizes, strict=True)
        few = [disturbance.describe(score.plant) for disturbance, size in drawn if disturbance.discrete and size]
        if few and len(self.splitting.levels) > 1:
            draws = f"draws with few values, as of {'; '.join(few)}"
            lines.append(f"splitting may miss failures by {draws}; rare_failures(keep=0) counts failures")
        return "\n".join(lines)

    __str__ = summary

    @checked
    def typical(self, count: Count = 8) -> Array:
        """The random numbers of at most `count` failures, (k, d): first the worst, then a sample of the others."""
        scores = self.splitting.scores
        worst = int(scores.argmax())
        others = np.delete(np.arange(len(scores)), worst)  # in the order of the repetitions
        chosen = np.linspace(0, len(others), count - 1, endpoint=False).astype(int)
        return self.splitting.failures[[worst, *others[np.unique(chosen)[: len(others)]]]]

    def certificate(self) -> FailureCertificate:
        """The probability with everything needed to measure it again; `save` writes it, and `certify` checks it."""
        problem, estimate = self.problem, self.probability
        stated = {field.name: getattr(problem, field.name) for field in fields(problem)}
        stated |= {name: self.options[name] for name in ("seed", "particles", "keep")}
        return FailureCertificate(
            **{**stated, **problem.facts, "solution": problem.score.solution}, probability=estimate.value,
            low=estimate.low, high=estimate.high, confidence=estimate.confidence,
            repetitions=self.splitting.repetitions, versions=versions(),
        )  # fmt: skip

    @checked
    def save(self, folder: str | os.PathLike[str], *, shown: Count = 8) -> Rollout:
        """Write rare.json, certificate.npz, and `shown` typical failures as rollout.npz. Returns these."""
        folder = check_path("folder", folder, "the path of a folder")
        result, estimate, numbers = self.splitting, self.probability, self.typical(shown)
        findings = {
            "probability": estimate.value, "low": estimate.low, "high": estimate.high,
            "confidence": estimate.confidence, "standard_error": result.standard_error,
            "repetitions": result.repetitions, "levels": result.levels, "moves": result.step_sizes,
            "simulations": result.simulations, "plain_trials": result.plain_trials, "failures": len(result.scores),
        }  # fmt: skip
        settings, score = {**self.options, "shown": shown}, self.problem.score
        write_json(self.problem, score.solution, folder / "rare.json", settings, findings, self.stopped)
        save_load.save(self.certificate(), folder / "certificate.npz")
        return _save_rollout(score, numbers, folder)


@dataclass(frozen=True, eq=False)
class Recheck:
    """The repeated measurement of a certificate."""

    certificate: FailureCertificate
    measured: RareFailures
    differences: tuple[str, ...]  # a line for each difference of the two
    changed: str  # why the bits may differ, so that intervals were compared: another seed, changed versions; else empty

    def summary(self) -> str:
        """Lines that describe the repeated measurement and the comparison."""
        done, certified = len(self.measured.splitting.repetitions), len(self.certificate.repetitions)
        lines = [f"measured again: {done} of {certified} repetitions, {self.measured.splitting.simulations:,} trials"]
        if self.changed:
            lines.append(f"{self.measured.probability:.2g}; only intervals are compared, because of {self.changed}")
        lines += [f"NOT as certified: {difference}" for difference in self.differences]
        if not self.differences:
            lines.append("as certified: the intervals overlap" if self.changed else "as certified, to the last bit")
        return "\n".join(lines)

    __str__ = summary


@checked
def certify(
    certificate: FailureCertificate,
    *,
    repetitions: Annotated[int, Bounds(at_least=2, at_most=reliability.MOST_REPEATS)] | None = None,
    seed: Seed | None = None,
    scenario: str | None = None,
    report: Report | None = None,
    progress: TextProgress | None = None,
) -> Recheck:
    """Repeat the measurement of a certificate, in whole or in part.

    Args:
      repetitions: number of its repetitions to run, at least 2; by default all.
      seed: another seed, for fresh random numbers: then intervals are compared. By default the certificate's.
      scenario: reference to the scenario if it is your own function: files never choose code to run.
    """
    certified = len(certificate.repetitions)
    count = certified if repetitions is None else repetitions
    if count > certified:
        raise InputError(f"repetitions: got {count}, want at most the certificate's {certified}")
    if scenario is None and names_code(certificate.scenario):
        raise InputError(f"scenario: got none, want the certificate's scenario, {certificate.scenario}, which is code")
    stated: dict[str, Any] = {field.name: getattr(certificate, field.name) for field in fields(ReliabilityProblem)}
    stated["scenario"] = certificate.scenario if scenario is None else scenario
    problem = ReliabilityProblem(**stated)
    facts = problem.facts
    was = {name: getattr(certificate, name) for name in facts}
    differences = [f"{name}: got {facts[name]}, want {was[name]}" for name in facts if facts[name] != was[name]]
    measured = problem.rare_failures(
        particles=certificate.particles, repetitions=count, keep=certificate.keep, seed=seed, report=report,
        progress=progress,
    )  # fmt: skip
    reseeded = f"seed {seed} (was {certificate.seed})" if seed not in (None, certificate.seed) else ""
    changes, estimate = reseeded or changed(certificate.versions), measured.probability
    if changes:
        if estimate.low > certificate.high or certificate.low > estimate.high:
            differences.append(f"probability: got {estimate:.2g}, want an interval that overlaps")
    else:
        pairs = zip(measured.splitting.repetitions.tolist(), certificate.repetitions.tolist(), strict=False)
        differences += [f"repetition {i}: got {a!r}, want {b!r}" for i, (a, b) in enumerate(pairs) if a != b]
        got = estimate.value, estimate.low, estimate.high
        want = certificate.probability, certificate.low, certificate.high
        if count == certified and got != want:
            differences.append(f"probability with its interval: got {got}, want {want}")
    return Recheck(certificate, measured, tuple(differences), changes)


@dataclass(frozen=True)
class LargestEffect:
    """The largest value of a disturbance in a trial. The size of a vector is its length."""

    what: str
    size: float
    unit: str
    time: float


def largest_effects(rollout: Rollout) -> list[LargestEffect]:
    """The largest disturbances of the first trial until its end, in physical units, except those that are always zero.

    The error of an applied control includes the error that the actuators' limits cause.
    """
    last = int(rollout.counts[0].sum()) - 1
    states, controls = rollout.state_coordinates, rollout.control_coordinates
    measured = states.difference(rollout.measured[0], rollout.states[0])
    disturbed = rollout.applied[0] - rollout.commanded[0]
    sizes_over_time: list[tuple[str, Array, str]] = [
        ("force", np.linalg.norm(rollout.forces[0], axis=1), "N"),
        ("torque", np.linalg.norm(rollout.torques[0], axis=1), "N m"),
        *(
            (f"error of {name}{kind}", np.abs(errors[:, i]), unit)
            for kind, space, errors in ((" as applied", controls, disturbed), (" as measured", states, measured))
            for i, (name, unit) in enumerate(zip(space.names, space.units, strict=True))
        ),
    ]
    effects = []
    for what, sizes, unit in sizes_over_time:
        until = np.nan_to_num(sizes[: last + 1])
        step = int(until.argmax())
        effects.append(LargestEffect(what, float(until[step]), unit, float(rollout.times[step])))
    return [effect for effect in effects if effect.size > 0]


@dataclass(frozen=True, eq=False)
class SmallestFailure:
    """The failure nearest to the undisturbed trial, and the contribution of each disturbance."""

    problem: ReliabilityProblem
    point: reliability.DesignPoint
    options: Mapping[str, int]  # `seed`, `rounds` and `particles`

    @property
    def simulations(self) -> int:
        """Number of trials, with the splitting before the search and the undisturbed trial before both."""
        return self.point.simulations + 1

    @property
    def shares(self) -> tuple[float, ...]:
        """The fraction of each disturbance in the squared distance."""
        ends = np.cumsum(self.problem.score.sizes)[:-1]
        parts = np.split(self.point.numbers, ends)
        return tuple(float(part @ part) / self.point.distance**2 for part in parts)

    @cached_property
    def largest(self) -> list[LargestEffect]:
        """The largest disturbances of the trial in physical units."""
        return largest_effects(self.problem.score.rollout(self.point.numbers[None], frames=False))

    @property
    def stopped(self) -> str:
        """The progress if it was stopped, such as "after 3 of 40 rounds"; else empty."""
        done, requested = len(self.point.history) - 1, self.options["rounds"]
        return f"after {done} of {requested} rounds" if done < requested and not self.point.converged else ""

    def summary(self) -> str:
        """Lines with the distance, FORM's estimate, the fraction of each disturbance, and the largest disturbances."""
        point = self.point
        found = f"found with {self.simulations:,} trials"
        lines = [f"smallest failure: {point.distance:.3g} standard deviations from the undisturbed trial, {found}"]
        if not point.converged:
            left = "an unknown share" if np.isnan(point.remaining) else f"about {100 * point.remaining:.1f} %"
            why, then = (f"stopped {self.stopped}", "") if self.stopped else ("not converged", "; use more --rounds")
            lines.append(f"{why}: {left} of the distance may be left to gain{then}")
        probability = point.first_order_probability
        fails = f"one trial in {rounded(1 / max(probability, 1e-300))} fails (reliability {1 - probability:.6g})"
        lines.append(f"first-order estimate: {fails}; `lqrsim rare` measures the probability")
        score = self.problem.score
        parts = zip(self.shares, score.sizes, score.disturbances, strict=True)
        lines += [f"{100 * share:6.1f} % of the squared distance: {kind.describe(score.plant)} ({count:,} numbers)"
                  for share, count, kind in parts if count]  # fmt: skip
        for effect in self.largest:
            size = f"{effect.size:.3g} {effect.unit}".rstrip()
            lines.append(f"largest {effect.what}: {size} at {effect.time:.2f} s")
        return "\n".join(lines)

    __str__ = summary

    def save(self, folder: str | os.PathLike[str]) -> Rollout:
        """Write break.json, and the trial as rollout.npz. Returns the trial; raises InputError."""
        folder, point = check_path("folder", folder, "the path of a folder"), self.point
        findings = {
            "distance": point.distance, "first_order_probability": point.first_order_probability,
            "history": point.history, "left": point.remaining, "converged": point.converged,
            "simulations": self.simulations, "shares": self.shares, "sizes": self.problem.score.sizes,
            "largest": self.largest, "numbers": point.numbers,
        }  # fmt: skip
        score = self.problem.score
        write_json(self.problem, score.solution, folder / "break.json", self.options, findings, self.stopped)
        return _save_rollout(score, point.numbers[None], folder)


def _save_rollout(score: TrialScore, numbers: Array, folder: Path) -> Rollout:
    """Run the trials with these numbers, write them as rollout.npz, and return them."""
    # With contacts, for pictures; bit-identical until the collision.
    rollout = replace(score, contacts=True).rollout(numbers)
    save_load.save(rollout, folder / "rollout.npz")
    return rollout


def write_json(
    problem: ReliabilityProblem, solution: Solution, path: Path, options: Mapping[str, Any], found: object, stopped: str
) -> None:
    """Write the settings of a search, and what it found."""
    scenario, settings = problem.resolved, {field.name: getattr(problem, field.name) for field in fields(problem)}
    settings |= options
    settings["solution"] = None if problem.given is None else digest_of_solution(problem.given)
    contents = {
        "format": f"lqrsim {path.stem}",
        "version": 3,
        "asked": settings,
        "disturbances": disturbances_as_json(disturbance_set(problem.sweep, scenario), scenario, problem.strength),
        "model": sha256(scenario.scene.xml),
        "problem": scenario.problem.digest,
        "policy": digest_of_solution(solution),
        "versions": versions(),
        "machine": description(),
        "stopped": stopped or None,
        "found": found,
    }
    write_text(path, json.dumps(plain(contents), indent=1, allow_nan=False) + "\n")

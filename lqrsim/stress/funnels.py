"""Funnels: the region around a plan from which a policy reaches the goal, at the largest level that trials certify.

A pilot search finds a candidate by steps and bisection, with the same random numbers at each level. Fresh trials then
test fixed fractions of that level, from the smallest up, each with the whole confidence, until a test fails; the last
level that passed is the result. The order is fixed before the fresh trials run, and a level is tested only if all
smaller levels passed. A result is therefore wrong only if the first level with too low a rate passes its test, which is
as improbable as that test allows. The confidence need not be divided among the levels (the fixed-sequence procedure;
Maurer, Hothorn & Lehmacher, 1995). The tests may share their trials. They are exact: a level passes if the one-sided
bound of Clopper and Pearson is at least the rate.
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Chance, Index, NonNegative, Positive, Seed, TextProgress, Want, checked
from lqrsim.control.controllers import ControllerLike, as_controller
from lqrsim.control.tubes import Tube
from lqrsim.errors import Array, InputError, check_array, check_name, check_symmetric, excerpt, keep, numbers_of
from lqrsim.machine import versions
from lqrsim.problem.noise import Noise
from lqrsim.process import keeping
from lqrsim.results.certified import Funnel, flat, inverse_of
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.goal import Target
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate_from
from lqrsim.simulation.disturbances import Disturbance, InitialStateError, as_disturbances
from lqrsim.simulation.disturbances.base import seeded
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.budget import check_threads
from lqrsim.stress.statistics import CONFIDENCE, Estimate
from lqrsim.stress.statistics import rate as rate_of

KNOTS = 5  # default number of knots
LEVEL_RANGE = 2.0**20  # largest level, relative to the first level that is tried
START_STREAM = 2**31  # number of the random stream for a trial's start; disturbances use the first streams
TESTED_FRACTIONS = (0.7, 0.9, 1.0)  # of the pilot's level, in the order in which they are tested
PILOT_ACCURACY = 1.04  # ratio of a level with too many failures to the pilot's level
MOST_STEPS_DOWN = 40  # after which the pilot gives up
COARSE_TRIALS = 64  # trials of the pilot's coarse search
BATCH = 512  # trials that are simulated together
MOST_TRIALS = 1_000_000

Confidence = Annotated[float, Bounds(at_least=0.5, below=1.0)]
Knots = Annotated[Sequence[int], Want("numbers of knots")]
States = Annotated[Sequence[str], Want("names of states")]
Runs = Callable[[float, npt.NDArray[np.intp]], npt.NDArray[np.bool_]]


@dataclass(frozen=True)
class LevelTest:
    """The test that a level has to pass."""

    trials: int
    failures: int  # allowed failures

    @property
    def pilot_failures(self) -> int:
        """Allowed failures in the pilot: fewer, for a level that just passes it fails half of its tests."""
        return (2 * self.failures) // 3


@checked
def smallest_test(
    rate: Chance, confidence: Confidence, failures: Annotated[int, Bounds(at_least=0, at_most=10_000)]
) -> LevelTest:
    """The test with the fewest trials that proves the rate with the given confidence if `failures` trials fail."""

    def proves(trials: int) -> bool:
        return lowest_rate(trials - failures, trials, confidence) >= rate

    trials = bisect_left(range(MOST_TRIALS + 1), True, lo=failures + 1, key=proves)
    if trials > MOST_TRIALS:
        got = f"{rate:g} with confidence {confidence:g} and failures {failures}, which needs more than"
        raise InputError(f"rate: got {got} {MOST_TRIALS:,} trials, want a smaller one of the three")
    return LevelTest(trials, failures)


def lowest_rate(successes: int, trials: int, confidence: float) -> float:
    """The exact one-sided lower bound of a success rate, from a confidence of 0.5 on: that of a two-sided interval."""
    return rate_of(successes, trials, confidence=max(2 * confidence - 1, 1e-12)).low


class FoundLevel(NamedTuple):
    """A certified level, 0 if no level passed."""

    level: float
    trials: int  # of its test
    successes: int
    reason: str  # why the level is 0, or why no larger level was tried; else empty
    pilot: float  # the pilot's level
    simulated: int  # number of all trials


def find_level(runs: Runs, test: LevelTest, *, guess: float, largest: float, rate: float) -> FoundLevel:
    """Find the largest level that passes the test, within the accuracy of the pilot.

    Args:
      runs: (level, numbers of the trials (K,)) -> whether each succeeds. Trials with different numbers are independent;
        a trial has the same random numbers at all levels.
      guess: level at which the pilot begins. largest: largest level that is tried. rate: tested rate, for the text of
        the reason.
    """
    pilot = _Pilot(runs, test)
    pilot_level = pilot.level(min(guess, largest), largest)
    if pilot_level == 0:
        reason = "too many trials fail at all levels that were tried, down to the smallest"
        if (failed := pilot.failures(0.0, test.trials)) > test.pilot_failures:
            allowed = f"to prove a rate of {rate:g}, at most {test.pilot_failures} may fail"
            reason = f"even when they begin on the plan, {failed} of {test.trials} trials fail; {allowed}"
        return FoundLevel(0.0, 0, 0, reason, 0.0, pilot.simulated)
    passed, reason, simulated = (0.0, 0, 0), "", pilot.simulated
    for level in dict.fromkeys(min(fraction * pilot_level, largest) for fraction in TESTED_FRACTIONS):
        failed, trials = run_test(runs, level, test)
        simulated += trials
        if failed > test.failures:
            allowed = f"at most {test.failures} of {test.trials} may fail"
            reason = f"{failed} of {trials} fresh trials fail at level {level:.4g}; {allowed}"
            break
        passed = level, test.trials, test.trials - failed
    if passed[0]:
        reason = f"levels beyond {largest:.4g} were not tried" if passed[0] == largest else ""
    return FoundLevel(*passed, reason, pilot_level, simulated)


def run_test(runs: Runs, level: float, test: LevelTest) -> tuple[int, int]:
    """Run the test's own trials, which the pilot has not used, until too many have failed. Returns failures, trials."""
    failed, done = 0, 0
    while done < test.trials and failed <= test.failures:
        count = min(BATCH, test.trials - done)
        succeeded = runs(level, np.arange(test.trials + done, test.trials + done + count))
        failed, done = failed + count - int(np.sum(succeeded)), done + count
    return failed, done


class _Pilot:
    """The search for a level. It saves trials by assuming that a trial that succeeds also succeeds at all lower levels.

    If this is wrong, the level is less accurate. The test's own trials do not rely on the assumption.
    """

    def __init__(self, runs: Runs, test: LevelTest) -> None:
        self.runs, self.test, self.simulated = runs, test, 0
        self._succeeded = np.full(test.trials, -np.inf)  # the largest level at which each trial has succeeded
        self._failed = np.full(test.trials, np.inf)  # the smallest level at which each trial has failed

    def failures(self, level: float, trials: int) -> int:
        """Number of failures at a level among the first `trials` trials."""
        unknown = np.flatnonzero((self._succeeded[:trials] < level) & (self._failed[:trials] > level))
        for first in range(0, len(unknown), BATCH):
            numbers = unknown[first : first + BATCH]
            succeeded = self.runs(level, numbers)
            self._succeeded[numbers[succeeded]], self._failed[numbers[~succeeded]] = level, level
        self.simulated += len(unknown)
        return int(np.sum(self._failed[:trials] <= level))

    def level(self, guess: float, largest: float) -> float:
        """The largest level that seems to pass; 0 if there is none.

        A few trials find the rough level, then all run there. At lower levels only the trials that failed run again.
        """
        all_trials, allowed = self.test.trials, self.test.pilot_failures
        few = min(COARSE_TRIALS, all_trials)
        of_few = max(int(np.ceil(2 * allowed * few / all_trials)), 2 if few < all_trials else allowed)
        rough = self._largest_with(of_few, few, guess, largest, factor=2.0)
        return 0.0 if rough == 0 else self._largest_with(allowed, all_trials, rough, largest, factor=1.2)

    def _largest_with(self, allowed: int, trials: int, guess: float, largest: float, *, factor: float) -> float:
        """The largest level with at most the allowed failures, by steps of the factor and bisection; 0 if none."""

        def passes(level: float) -> bool:
            return self.failures(level, trials) <= allowed

        low = high = guess
        if passes(guess):
            while low < largest:
                high = min(factor * low, largest)
                if not passes(high):
                    break
                low = high
            else:
                return largest
        else:
            for _ in range(MOST_STEPS_DOWN):
                low = high / factor
                if passes(low):
                    break
                high = low
            else:
                return 0.0
        while high > PILOT_ACCURACY * low:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if passes(middle) else (low, middle)
        return low


@checked
def funnel(
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance | Noise] = (),
    controller: ControllerLike | None = None,
    rate: Chance = 0.99,
    confidence: Confidence = CONFIDENCE,
    knots: Knots | None = None,
    states: States | None = None,
    shape: Tube | npt.ArrayLike | None = None,
    largest: Positive | None = None,
    failures: int = 3,
    seed: Seed = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
    progress: TextProgress | None = None,
) -> Funnel:
    """Find the largest ellipsoids about a plan from which runs reach the goal with a given success rate.

    The trials are simulated, so limits, obstacles and everything else that ends a trial are taken into account. The
    rate is over states drawn uniformly in the ellipsoid, and over the disturbances; see `Funnel`. With the given
    confidence all levels hold simultaneously: the error probability is divided among the knots. A level of 0, with its
    reason, means that no level was certified.

    A run that begins at a later knot is assumed to have followed the plan until then; see `simulate_from`. Arguments
    that are not listed here are those of `simulate`.

    Args:
      disturbances: as in `simulate`, without those that change the start of a run, such as `InitialStateError`.
      controller: as in `simulate`; by default the solution's policy.
      rate: wanted fraction of runs that reach the goal, above 0 and below 1.
      confidence: confidence that all levels are right, at least 0.5 and below 1.
      knots: numbers of the knots at which runs begin; by default 5, from the first on.
      states: names of the states that may be off the plan; by default all.
      shape: family of the ellipsoids: by default from the solution's cost-to-go; or a `Tube`, for its covariance; or
        a covariance (n, n), or one per knot, (T+1, n, n). The certificate holds for any shape, but levels depend on it.
      largest: largest level that is tried; by default the level at which an angle is off by half a turn.
      failures: number of trials of a test that may fail. With more, tests take more trials, and levels are larger.

    Raises:
      KeyboardInterrupt: Ctrl-C; its `found` is the Funnel with the levels of the knots that are done, if any.
    """
    runner = _Runner(plant, solution, disturbances, controller, (goal_radius, goal_tolerance), threads, seed)
    plan, policy, tell = solution.trajectory, solution.policy, progress or (lambda done, total, text: None)
    space = policy.state_coordinates
    starts, names, test = level_test(
        space, plan.steps, rate=rate, confidence=confidence, knots=knots, states=states, failures=failures
    )
    chosen = [space.names.index(name) for name in names]
    shapes = _shapes(solution, shape, chosen)
    for knot in starts:
        if flat(shapes[knot]):
            raise InputError(f"shape: got an ellipsoid that is flat at knot {knot}, want other knots, states or shape")
    # Errors of the start must be zero here; others are refused.
    acting = (disturbance for disturbance in runner.disturbances if not isinstance(disturbance, InitialStateError))
    none = np.zeros(len(starts), dtype=np.int64)
    family = "cost_to_go" if shape is None else "tube" if isinstance(shape, Tube) else "given"
    blank = Funnel(
        plan=plan, state_coordinates=space, control_coordinates=policy.control_coordinates, states=names, shape=shapes,
        family=family, knots=np.array(starts), levels=none * 1.0, trials=none, successes=none,
        reasons=("",) * len(starts), simulated=0, policy_digest=runner.law.digest, goal_radius=runner.radius,
        disturbances=tuple(disturbance.describe(plant) for disturbance in acting), versions=versions(), rate=rate,
        confidence=confidence, seed=seed, options={"failures": failures, "largest": largest},
    )  # fmt: skip
    levels: list[FoundLevel] = []

    def so_far() -> Funnel:
        missing = FoundLevel(0.0, 0, 0, "stopped before this knot was done", 0.0, 0)
        every = *levels, *[missing] * (len(starts) - len(levels))
        found, trials, successes, reasons, _, simulated = zip(*every, strict=True)
        arrays = {"levels": np.array(found), "trials": np.array(trials), "successes": np.array(successes)}
        return replace(blank, **arrays, reasons=reasons, simulated=sum(simulated))

    run = 0

    def runs(knot: int, level: float, numbers: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        nonlocal run
        last = f", level {levels[-1].level:.3g} at the one before" if levels else ""
        tell(len(levels), len(starts), f"trying level {level:.3g} at knot {knot}{last}; {run:,} trials")
        run += len(numbers)
        return runner.reached(blank, knot, level, numbers)

    with keeping(lambda _: so_far() if levels else None):
        for knot in starts:
            guess = _radius_level(plant, space.position, chosen, shapes[knot])
            highest = guess * LEVEL_RANGE if largest is None else largest
            highest = min(_half_turn_level(solution, chosen, shapes[knot]), highest)
            levels.append(find_level(partial(runs, knot), test, guess=guess, largest=highest, rate=rate))
        tell(len(starts), len(starts), f"level {levels[-1].level:.3g} at knot {starts[-1]}; {run:,} trials")
    return so_far()


@checked
def level_test(
    space: Coordinates, steps: int, *, rate: Chance = 0.99, confidence: Confidence = CONFIDENCE,
    knots: Knots | None = None, states: States | None = None, failures: int = 3,
) -> tuple[list[int], tuple[str, ...], LevelTest]:  # fmt: skip
    """The knots of a funnel in order, its states, and the test of a level at each knot; arguments as in `funnel`.

    The states are of `space`, and the knots of a plan with this number of steps.
    """
    even = np.linspace(0, steps, min(KNOTS, steps) + 1)[:-1].astype(int)
    chosen = sorted({*even.tolist()} if knots is None else {*knots})
    names = space.names if states is None else tuple(states)
    if not chosen or chosen[0] < 0 or chosen[-1] >= steps:
        raise InputError(f"knots: got {excerpt(knots)}, want some of 0 to {steps - 1}, before the plan's end")
    for name in names:
        check_name("states", name, space.names)
    if not names or len(set(names)) < len(names):
        raise InputError(f"states: got {excerpt(names)}, want different names, at least one")
    return chosen, names, smallest_test(rate, 1 - (1 - confidence) / len(chosen), failures)


@checked
@dataclass(frozen=True, eq=False)
class FunnelCheck:
    """New trials at a knot of a funnel; `reached` is their success rate with its exact interval."""

    knot: Index
    level: NonNegative
    reached: Estimate
    successes: npt.NDArray[np.bool_] = field(repr=False)

    def __post_init__(self) -> None:
        keep(self, successes=check_array("FunnelCheck: successes", self.successes, (None,)) != 0)

    def __str__(self) -> str:
        trials, sure = len(self.successes), f"{self.reached.confidence:g}"
        rate = f"{self.successes.sum()} of {trials} new trials succeed, {self.reached:.3g} at confidence {sure}"
        return f"knot {self.knot}, level {self.level:.3g}: {rate}"


@checked
def check_funnel(
    funnel: Funnel,
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance | Noise] = (),
    controller: ControllerLike | None = None,
    trials: Annotated[int, Bounds(at_least=1, at_most=MOST_TRIALS)] = 1000,
    between: tuple[NonNegative, NonNegative] = (0.0, 1.0),
    seed: Seed = 1,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
) -> tuple[FunnelCheck, ...]:
    """The results of new trials from states drawn uniformly in a funnel, for each knot with a level; else as `funnel`.

    Args:
      between: range of levels relative to the funnel's: (0, 1) is inside, (1, 1.5) a shell outside.
      seed: seed of all random numbers; it must differ from the funnel's, because the trials must be new.
    """
    runner = _Runner(plant, solution, disturbances, controller, (goal_radius, goal_tolerance), threads, seed)
    if not np.array_equal(solution.trajectory.states, funnel.plan.states):
        raise InputError("solution: got a plan other than the funnel's, want the funnel's own solution")
    if not between[0] < between[1]:
        raise InputError(f"between: got {excerpt(between)}, want two shares of the level, in order, from 0 on")
    if seed == funnel.seed:
        raise InputError(f"seed: got {seed}, the funnel's own, want another one, for new trials")
    checks = []
    for knot, level in zip(funnel.knots.tolist(), funnel.levels.tolist(), strict=True):
        if level == 0:
            continue
        batches = (np.arange(first, min(first + BATCH, trials)) for first in range(0, trials, BATCH))
        reached = np.concatenate([runner.reached(funnel, knot, level, numbers, between) for numbers in batches])
        checks.append(FunnelCheck(knot, level, rate_of(int(reached.sum()), trials), reached))
    return tuple(checks)


def points_of(numbers: npt.NDArray[np.intp], seed: int, size: int, between: tuple[float, float] = (0.0, 1.0)) -> Array:
    """A point for each trial from its own random stream, uniform by volume between two balls about 0, (K, size)."""
    points = np.empty((len(numbers), size))
    low, high = (radius**size for radius in between)
    for row, trial in enumerate(numbers.tolist()):
        rng = seeded(seed)(trial, START_STREAM)
        direction = rng.standard_normal(size)
        points[row] = direction / np.linalg.norm(direction) * (low + (high - low) * rng.random()) ** (1 / size)
    return points


class _Runner:
    """Runs trials of a seed from states in the ellipsoids of a funnel; see `simulate_from`."""

    def __init__(
        self, plant: Plant, solution: Solution, disturbances: Sequence[Disturbance | Noise],
        controller: ControllerLike | None, goal: tuple[float | None, float | None], threads: int | None, seed: int,
    ) -> None:  # fmt: skip
        self.plant, self.solution, self.seed = plant, solution, seed
        self.law, _ = as_controller(controller, solution, plant.robot.dynamics)
        self.disturbances = as_disturbances(disturbances)
        # The tolerance of a goal without a position is relative to the range of the whole plan, not of its rest.
        self.target = Target(solution.policy.state_coordinates, solution.goal, solution.trajectory.states)
        self.radius = self.target.radius(plant.robot.radius, *goal)
        self.options: Mapping[str, Any] = {"goal_radius": goal[0], "goal_tolerance": goal[1], "frames": False,
                                           "contacts": False, "threads": check_threads(threads)}  # fmt: skip

    def reached(
        self, funnel: Funnel, knot: int, level: float, numbers: npt.NDArray[np.intp],
        between: tuple[float, float] = (0.0, 1.0),
    ) -> npt.NDArray[np.bool_]:  # fmt: skip
        """Whether the trials with these numbers (K,) reach the goal, (K,); they begin at a knot of the funnel.

        Their states are uniform by volume between two multiples of the level.
        """
        states = funnel.states_at(knot, points_of(numbers, self.seed, len(funnel.states), between), level)
        streams = seeded(self.seed)
        run = simulate_from(
            self.plant, self.solution, states, knot=knot, disturbances=self.disturbances, controller=self.law,
            generators=lambda trial, stream: streams(int(numbers[trial]), stream), **self.options,
        )  # fmt: skip
        ran = np.isin(run.outcome, ("reached", "timed out"))
        return ran & (self.target.distance(run.states[:, -1]) <= self.radius)


def _shapes(solution: Solution, shape: Tube | npt.ArrayLike | None, chosen: list[int]) -> Array:
    """Covariances (T+1, d, d) of the chosen states; zero at knots without one."""
    plan = solution.trajectory
    knots, n = plan.states.shape
    if shape is None:
        if solution.cost_to_go is None:
            raise InputError(f"shape: got none and no cost-to-go ({solution.status.name}), want shape=")
        hessians = solution.cost_to_go.hessian[:, chosen][:, :, chosen]
        inverses = [np.zeros_like(hessian) if flat(hessian) else inverse_of(hessian) for hessian in hessians]
        return np.array([0.5 * (inverse + inverse.T) for inverse in inverses])
    if isinstance(shape, Tube):
        if not np.array_equal(shape.plan.states, plan.states):
            raise InputError("shape: got a tube of another plan, want a tube of the solution")
        shape = shape.covariance
    covariance = numbers_of("shape", shape, "a Tube, or a covariance (n, n) or (T+1, n, n)")
    covariance = check_array("shape", covariance, (n, n) if covariance.ndim == 2 else (knots, n, n))
    return np.broadcast_to(check_symmetric("shape", covariance), (knots, n, n))[:, chosen][:, :, chosen]


def _radius_level(plant: Plant, position: tuple[int, ...], chosen: list[int], shape: Array) -> float:
    """The level at which the position deviates by the robot's radius; 1 without a position or a radius."""
    rows = [chosen.index(i) for i in position if i in chosen]
    widest = float(np.sqrt(max((shape[i, i] for i in rows), default=0.0)))
    return plant.robot.radius / widest if widest > 0 and plant.robot.radius > 0 else 1.0


def _half_turn_level(solution: Solution, chosen: list[int], shape: Array) -> float:
    """The level at which an angle deviates by half a turn; a larger ellipsoid contains some states twice."""
    space = solution.policy.state_coordinates
    turning = [[i, i + 1, i + 2] for i in space.rotation_vectors]
    groups = [[i] for i in space.angles] + [[i for i in rotation if i not in space.angles] for rotation in turning]
    levels = [np.inf]
    for group in groups:
        rows = [chosen.index(i) for i in group if i in chosen]
        if rows:
            levels.append(np.pi / float(np.sqrt(np.linalg.eigvalsh(shape[np.ix_(rows, rows)])[-1])))
    return min(levels)

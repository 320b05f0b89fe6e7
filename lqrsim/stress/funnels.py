"""`funnel`: from where a policy works. `levels.py` says how a level is found, and what its confidence rests on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.control.controllers import ControllerLike, as_controller
from lqrsim.control.tubes import Tube
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_count,
    check_function,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_seed,
    excerpt,
    numbers_of,
)
from lqrsim.problem.noise import Noise
from lqrsim.results.funnel import Funnel, flat
from lqrsim.results.goal import Target, endings
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.simulation.begun_later import simulate_from
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.disturbances.state_noise import as_disturbances
from lqrsim.simulation.effects import seeded
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.parallel import check_threads
from lqrsim.stress.levels import BATCH, MOST_TRIALS, FoundLevel, Test, find_level, smallest_test
from lqrsim.stress.statistics import CONFIDENCE, Estimate
from lqrsim.stress.statistics import rate as rate_of
from lqrsim.versions import versions

KNOTS = 5  # by default
FAR = 2.0**20  # times the level that the search begins with, beyond which it does not look
DRAWN = 2**31  # the stream of a trial that its point is drawn from; disturbances have the first ones
FAILURES = 3


def funnel(
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance | Noise] = (),
    controller: ControllerLike | None = None,
    rate: float = 0.99,
    confidence: float = CONFIDENCE,
    knots: Sequence[int] | None = None,
    states: Sequence[str] | None = None,
    shape: Tube | npt.ArrayLike | None = None,
    largest: float | None = None,
    failures: int = FAILURES,
    seed: int = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Funnel:
    """The largest ellipsoids about a plan from which runs reach the goal as often as is asked.

    Limits, obstacles and whatever else ends a trial count, for the trials are simulated. The rate is the share of
    states drawn uniformly in the ellipsoid, and of the disturbances; see `Funnel`. The confidence is that all levels
    are right at once: each knot has its part of what is missing to 1. A level that would claim too much is 0, with the
    reason.

    A run that begins at a later knot is taken to have been as planned until then: see `simulate_from`.

    Args:
      plant: as in `simulate`.
      solution: as in `simulate`.
      disturbances: as in `simulate`. What an `InitialStateError` draws does not count.
      controller: as in `simulate`; by default the solution's policy.
      rate: wished success rate, above 0 and below 1.
      confidence: that all levels are right, at least 0.5 and below 1.
      knots: numbers of those at which runs begin; by default 5, from the first on.
      states: names of those that may be off the plan, the others being on it; by default all.
      shape: the ellipsoids' family: by default that of the solution's cost-to-go; or a `Tube`, whose covariance it is;
        or a covariance (n, n), or one a knot, (T+1, n, n). What is certified does not depend on it, but how much does.
      largest: level beyond which none is tried; by default where an angle could be off by half a turn.
      failures: how many trials of a test may fail. With more, there are more trials, and levels come out larger.
      seed: of all draws.
      goal_radius: as in `simulate`.
      goal_tolerance: as in `simulate`.
      threads: as in `simulate`.
      progress: called with the number of knots that are done, and of all.

    Returns:
      A Funnel.

    Raises:
      InputError: as `simulate`; an option is out of range; there is no cost-to-go and no shape; or an ellipsoid is
        flat.
    """
    trials = _Trials(plant, solution, disturbances, controller, (goal_radius, goal_tolerance), threads)
    check_function("progress", progress, "a function of how many knots are done, of how many", arguments=2)
    if largest is not None:
        largest = check_number("largest", largest, above=0.0)
    options = {"failures": failures, "largest": largest}
    asked = {"rate": rate, "confidence": confidence, "seed": check_seed("seed", seed), "options": options}
    blank = _blank(trials, asked, knots, states, shape)
    test = smallest_test(blank.rate, 1 - (1 - blank.confidence) / len(blank.knots), failures)
    found = _search(blank, trials, test, largest, progress)
    return replace(
        blank,
        levels=np.array([one.level for one in found]),
        trials=np.array([one.trials for one in found]),
        successes=np.array([one.successes for one in found]),
        reasons=tuple(one.reason for one in found),
        simulated=sum(one.simulated for one in found),
    )


def _blank(
    trials: "_Trials", asked: dict[str, Any], knots: Sequence[int] | None, states: Sequence[str] | None,
    shape: Tube | npt.ArrayLike | None,
) -> Funnel:  # fmt: skip
    """A funnel without levels. Raises InputError for what cannot be one."""
    solution = trials.solution
    plan, law = solution.trajectory, solution.policy
    asked["confidence"] = check_number("confidence", asked["confidence"], at_least=0.5, below=1.0)
    begun, names = _knots(knots, plan.steps), _states(states, solution)
    shapes = _shapes(solution, shape, [law.state_coordinates.names.index(name) for name in names])
    for knot in begun:
        if flat(shapes[knot]):
            raise InputError(
                f"shape: got an ellipsoid that is flat at knot {knot}, want other knots or states, or another shape"
            )
    none = np.zeros(len(begun), dtype=np.int64)
    return Funnel(
        plan=plan, state_coordinates=law.state_coordinates, control_coordinates=law.control_coordinates, states=names,
        shape=shapes, family=_family(shape), knots=np.array(begun), levels=none * 1.0, trials=none, successes=none,
        reasons=("",) * len(begun), simulated=0, policy_digest=trials.law.digest, goal_radius=trials.radius,
        disturbances=tuple(one.describe(trials.plant) for one in trials.disturbances), versions=versions(), **asked,
    )  # fmt: skip


def _search(
    whole: Funnel, trials: "_Trials", test: Test, largest: float | None,
    progress: Callable[[int, int], object] | None,
) -> list[FoundLevel]:  # fmt: skip
    """The level at each knot of a funnel that has none yet."""
    found: list[FoundLevel] = []
    size, chosen = len(whole.knots), whole.chosen
    for done, knot in enumerate(whole.knots.tolist()):
        if progress is not None:
            progress(done, size)
        shape = whole.shape[knot]
        guess = _reach(trials.plant, whole.state_coordinates.position, chosen, shape)
        end = min(_half_turn(trials.solution, chosen, shape), guess * FAR if largest is None else largest)

        def runs(level: float, numbers: npt.NDArray[np.intp], knot: int = knot) -> npt.NDArray[np.bool_]:
            points = points_of(numbers, whole.seed, len(chosen))
            return trials.reached(whole.states_at(knot, points, level), knot, whole.seed, numbers)

        found.append(find_level(runs, test, guess=guess, largest=end, rate=whole.rate))
    if progress is not None:
        progress(size, size)
    return found


class FunnelCheck(NamedTuple):
    """How new trials went.

    Attributes:
      knot: at which they began.
      level: of the funnel there.
      reached: the share that succeeded, with its exact interval.
      successes: which of them did, (K,).
    """

    knot: int
    level: float
    reached: Estimate
    successes: npt.NDArray[np.bool_]


def check_funnel(
    funnel: Funnel,
    plant: Plant,
    solution: Solution,
    *,
    disturbances: Sequence[Disturbance | Noise] = (),
    controller: ControllerLike | None = None,
    trials: int = 1000,
    between: tuple[float, float] = (0.0, 1.0),
    seed: int = 1,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
) -> tuple[FunnelCheck, ...]:
    """New trials from states drawn uniformly in a funnel, or just outside, at each knot that has a level.

    Args:
      funnel: that is checked.
      plant: as for `funnel`.
      solution: as for `funnel`.
      disturbances: as for `funnel`.
      controller: as for `funnel`.
      trials: at each knot.
      between: shares of the level: (0, 1) is inside, (1, 1.5) a shell outside.
      seed: of all draws; another than the funnel's, or the trials are not new.
      goal_radius: as for `funnel`.
      goal_tolerance: as for `funnel`.
      threads: as for `funnel`.

    Returns:
      A FunnelCheck of each such knot.

    Raises:
      InputError: as `funnel`; the seed is the funnel's; or the solution has another plan.
    """
    check_kind("funnel", funnel, Funnel, "a Funnel, such as funnel(...) returns")
    runner = _Trials(plant, solution, disturbances, controller, (goal_radius, goal_tolerance), threads)
    if not np.array_equal(solution.trajectory.states, funnel.plan.states):
        raise InputError("solution: got one with another plan than the funnel's, want that of the funnel")
    check_count("trials", trials, at_most=MOST_TRIALS)
    shares = check_array("between", between, (2,))
    if not 0 <= shares[0] < shares[1]:
        raise InputError(f"between: got {excerpt(between)}, want two shares of the level, in order, from 0 on")
    if check_seed("seed", seed) == funnel.seed:
        raise InputError(f"seed: got {seed}, the funnel's own, want another: the trials would not be new")
    found, size = [], len(funnel.states)
    for knot, level in zip(funnel.knots.tolist(), funnel.levels.tolist(), strict=True):
        if level == 0:
            continue
        parts = []
        for first in range(0, trials, BATCH):
            numbers = np.arange(first, min(first + BATCH, trials))
            begun = funnel.states_at(knot, points_of(numbers, seed, size, (shares[0], shares[1])), level)
            parts.append(runner.reached(begun, knot, seed, numbers))
        reached = np.concatenate(parts)
        found.append(FunnelCheck(knot, level, rate_of(int(reached.sum()), trials), reached))
    return tuple(found)


def points_of(numbers: npt.NDArray[np.intp], seed: int, size: int, between: tuple[float, float] = (0.0, 1.0)) -> Array:
    """A point (K, size) for each trial, uniform by volume between two balls about 0, of its own stream."""
    points = np.empty((len(numbers), size))
    low, high = (share**size for share in between)
    for row, trial in enumerate(numbers.tolist()):
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(trial, DRAWN))))
        direction = rng.standard_normal(size)
        points[row] = direction / np.linalg.norm(direction) * (low + (high - low) * rng.random()) ** (1 / size)
    return points


class _Trials:
    """Runs trials from states at a knot; see `simulate_from`."""

    def __init__(
        self, plant: Plant, solution: Solution, disturbances: Sequence[Disturbance | Noise],
        controller: ControllerLike | None, near: tuple[float | None, float | None], threads: int | None,
    ) -> None:  # fmt: skip
        self.plant = check_kind("plant", plant, Plant, "a Plant, such as scenario.plant()")
        self.solution = check_kind("solution", solution, Solution, "a Solution, such as smooth(problem)")
        self.law, _ = as_controller(controller, solution, plant.robot.dynamics)
        self.disturbances = as_disturbances(disturbances, "disturbances, such as ControlNoise(0.05)")
        # A rest of the plan has another range, which goals without a position are measured by.
        self.target = Target(solution.policy.state_coordinates, solution.goal, solution.trajectory.states)
        self.radius = self.target.radius(plant.robot.radius, *near)
        self.options: Mapping[str, Any] = {"goal_radius": near[0], "goal_tolerance": near[1], "frames": False,
                                           "contacts": False, "threads": check_threads(threads)}  # fmt: skip

    def reached(self, states: Array, knot: int, seed: int, numbers: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Which trials of these numbers (K,), that begin in the states (K, n), reach the goal, (K,)."""
        streams = seeded(seed)
        run = simulate_from(
            self.plant, self.solution, states, knot=knot, disturbances=self.disturbances, controller=self.law,
            generators=lambda trial, stream: streams(int(numbers[trial]), stream), **self.options,
        )  # fmt: skip
        return self.outcome(run) == "reached"

    def outcome(self, run: Rollout) -> npt.NDArray[np.str_]:
        """How the trials ended."""
        return endings(
            collided_at=run.collided_at, diverged_at=run.diverged_at, failed_at=run.failed_at,
            distance=self.target.distance(run.states[:, -1]), radius=self.radius, horizon=run.plan.horizon,
        )[0]  # fmt: skip


def _knots(knots: Sequence[int] | None, steps: int) -> list[int]:
    """Those that are asked for, in order. Raises InputError for others than the plan has."""
    if knots is None:
        return sorted({int(knot) for knot in np.linspace(0, steps, min(KNOTS, steps) + 1)[:-1]})
    given = check_items("knots", knots, (int, np.integer), "numbers of knots", at_most=10_000)
    found = sorted({check_count("knots", knot, at_least=0) for knot in given})
    if not found or found[-1] >= steps:
        raise InputError(f"knots: got {excerpt(given)}, want some of 0 to {steps - 1}, before the plan's end")
    return found


def _states(states: Sequence[str] | None, solution: Solution) -> tuple[str, ...]:
    """Names of those that may be off the plan. Raises InputError for others than there are."""
    known = solution.policy.state_coordinates.names
    if states is None:
        return known
    given = check_items("states", states, str, "names of states")
    if not given or len(set(given)) < len(given):
        raise InputError(f"states: got {excerpt(given)}, want different names, at least one")
    return tuple(check_name("states", name, known) for name in given)


def _family(shape: object) -> str:
    return "cost_to_go" if shape is None else "tube" if isinstance(shape, Tube) else "given"


def _shapes(solution: Solution, shape: Tube | npt.ArrayLike | None, chosen: list[int]) -> Array:
    """Covariances (T+1, d, d) of the chosen states; zero where there is none."""
    plan = solution.trajectory
    knots, n = plan.states.shape
    if shape is None:
        if solution.cost_to_go is None:
            raise InputError(f"shape: got none, and a solution without a cost-to-go ({solution.status.name}), want one")
        curve = solution.cost_to_go.hessian[:, chosen][:, :, chosen]
        return np.array([_inverse(one) for one in curve])
    if isinstance(shape, Tube):
        if not np.array_equal(shape.plan.states, plan.states):
            raise InputError("shape: got a tube of another plan, want that of the solution")
        given = shape.covariance
    else:
        given = numbers_of("shape", shape, "a Tube, or a covariance (n, n) or (T+1, n, n)")
        given = check_array("shape", given, (n, n) if given.ndim == 2 else (knots, n, n))
    whole = np.broadcast_to(given, (knots, n, n))
    if not np.allclose(whole, whole.transpose(0, 2, 1), rtol=1e-9, atol=0.0):
        raise InputError("shape: got a matrix that is not symmetric, want covariances")
    return 0.5 * (whole + whole.transpose(0, 2, 1))[:, chosen][:, :, chosen]


def _inverse(curve: Array) -> Array:
    """Of a Hessian (d, d); zero where it has none, or it is no ellipsoid's."""
    if flat(curve):
        return np.zeros_like(curve)
    size = np.sqrt(np.diagonal(curve))
    inverse = np.linalg.inv(curve / np.outer(size, size)) / np.outer(size, size)
    return 0.5 * (inverse + inverse.T)


def _reach(plant: Plant, position: tuple[int, ...], chosen: list[int], shape: Array) -> float:
    """The level at which the position may be off by the robot's radius; 1 without a position or a radius."""
    rows = [chosen.index(i) for i in position if i in chosen]
    widest = float(np.sqrt(max((shape[i, i] for i in rows), default=0.0)))
    return plant.robot.radius / widest if widest > 0 and plant.robot.radius > 0 else 1.0


def _half_turn(solution: Solution, chosen: list[int], shape: Array) -> float:
    """The level at which an angle may be off by half a turn, where states would be in the ellipsoid twice."""
    space = solution.policy.state_coordinates
    groups = [[i] for i in space.angles] + [[i, i + 1, i + 2] for i in space.rotation_vectors]
    end = np.inf
    for group in groups:
        rows = [chosen.index(i) for i in group if i in chosen]
        if rows:
            end = min(end, np.pi / float(np.sqrt(np.linalg.eigvalsh(shape[np.ix_(rows, rows)])[-1])))
    return end

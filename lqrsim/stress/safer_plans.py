"""Plans that fail less: plans that are hardened, and, at the end, the safest of the candidates of a solve.

A plan is hardened by its failing runs in MuJoCo, which say where the next plan needs more room, and where less. The
first plan has the requested chance of collision by prediction. Its failures are then measured, with all disturbances,
also those that no prediction includes. From the planned clearance of an obstacle, in predicted standard deviations, and
the measured probability of hitting it follows how many of these deviations correspond to one quantile of the normal
distribution. The next plan keeps as many of them as correspond to an equal part of the requested probability. Obstacles
that are never hit get the largest of the others' corrections, but no more room than before. The law is designed again
for each plan.

Room does not help a robot that leaves its plan for good. Such failures are counted separately.

A splitting that finds no failure says nothing about the probability: it may have missed a way to fail. Independent
trials are then run, and the exact upper bound of their count decides.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, log, log1p
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lqrsim.annotations import Bounds, Chance, Count, Line, Seed, TextProgress, Want, checked
from lqrsim.control.chance_constrained import smooth_chance_constrained
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.prediction import Surroundings
from lqrsim.control.tubes import STRAY, predict_tube
from lqrsim.errors import Array, InputError, check_array, check_name, check_path, keep
from lqrsim.problem.noise import Noise
from lqrsim.problem.problem import Problem
from lqrsim.process import keeping
from lqrsim.results import save_load
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, uncertainty_of
from lqrsim.simulation.plant import Plant
from lqrsim.solvers.compiled import costs_of
from lqrsim.solvers.smoother import smooth
from lqrsim.stress.failure_search import RareFailures, ReliabilityProblem, Report, write_json
from lqrsim.stress.funnels import MOST_TRIALS
from lqrsim.stress.reliability import NoFailure
from lqrsim.stress.statistics import CONFIDENCE, Estimate, rate
from lqrsim.stress.study import DESIGNED, design_uncertainty, make_controller

POLICIES = ("smooth", *DESIGNED)  # whose law can be designed for any plan, and predicted
AIMED_FRACTION = 0.5  # of the requested probability, so that the measured one's whole interval is likely to be below it
LEAST_FACTOR, LARGEST_FACTOR = 0.8, 2.0  # on a number of standard deviations, from one plan to the next
COUNTED_CHANCE = 5e-3  # requests from which failures are counted by default; for smaller ones splitting is cheaper
FAILING_TRIALS = 10  # trials of each repetition that fail at the requested probability, if failures are counted
MOST_COUNTED = 100_000  # trials that are run where splitting found no failure: about as many as two splittings
REPLAYED_FAILURES = 300  # failing runs that are run again, to see where they fail
MOST_ROUNDS = 20
SAME_PLAN = 0.02  # fraction of a state's range along the plan; plans that differ by no more count as the same


@dataclass(frozen=True, kw_only=True, eq=False)
class HardeningRound:
    """A plan, and how its runs fail."""

    solution: Solution
    cost: float
    rare: RareFailures | None  # None if no failure was found
    hit: dict[str, float]  # fraction of the failing runs that hit an obstacle and return to the plan, by its name
    # Fraction of the failing runs that leave the plan for good: their simulation diverges, or they end farther from it
    # than six standard deviations of the position, where these are largest.
    strays: float
    unfailing: int = 0  # independent trials that were run if no failure was found; none of them failed

    @property
    def probability(self) -> Estimate:
        """The measured probability of failure; without failures, 0 with the exact upper bound, 1 without trials."""
        if self.rare is not None:
            return self.rare.probability
        return rate(0, self.unfailing) if self.unfailing else Estimate(0.0, 0.0, 1.0, CONFIDENCE)

    def __str__(self) -> str:
        if self.rare is None:
            bound = f"none of {self.unfailing:,} trials failed, so at most {self.probability.high:.2g} of them do"
            return f"cost {self.cost:.6g}, no failure found{f': {bound}' if self.unfailing else ''}"
        ranked = sorted(self.hit.items(), key=lambda hit: -hit[1])
        parts = [f"{100 * fraction:.0f} % hit {name}" for name, fraction in ranked if fraction >= 0.005]
        parts += [f"{100 * self.strays:.0f} % leave the plan for good"] if self.strays >= 0.005 else []
        return f"cost {self.cost:.6g}, probability of failure {self.rare.probability:.2g}: {', '.join(parts)}"


@dataclass(frozen=True, kw_only=True, eq=False)
class HardenedPlan:
    """A plan with its measured probability of failure, and the plans before it."""

    problem: ReliabilityProblem
    chance: float  # the requested probability
    options: dict[str, int]  # `seed`, `particles`, `repetitions` and `rounds`
    rounds: tuple[HardeningRound, ...]  # one for each plan
    # The number of the plan that is the result. If it is safe enough, its failures were measured again with fresh
    # random numbers.
    chosen: int
    reason: str  # why there is no success, and what may help; empty if there is

    @property
    def solution(self) -> Solution:
        return self.rounds[self.chosen].solution

    @property
    def rare(self) -> RareFailures | None:
        """The plan's failures; `rare.save` writes them with their certificate. None if none was found.

        A splitting may miss failures, so `success` without them rests on trials that were counted.
        """
        return self.rounds[self.chosen].rare

    @property
    def success(self) -> bool:
        """Whether the whole interval of two measurements is at most the requested probability."""
        return not self.reason

    @property
    def stopped(self) -> str:
        """The progress if it was stopped, such as "stopped after 1 of 4 plans"; else empty."""
        return self.reason if self.reason.startswith("stopped") else ""

    def verdict(self) -> str:
        """A line that says whether the plan is as requested."""
        chosen = f"requested: at most {self.chance:g}; plan {self.chosen + 1}"
        if self.reason:
            return f"{chosen} is the safest, NOT as requested: {self.reason}"
        return f"{chosen} is as requested, with the whole interval"

    def summary(self) -> str:
        """A line for each plan, and whether the result is as requested."""
        return "\n".join([*(f"plan {number}: {plan}" for number, plan in enumerate(self.rounds, 1)), self.verdict()])

    __str__ = summary

    @checked
    def save(self, folder: str | os.PathLike[str], *, shown: Count = 8) -> Rollout | None:
        """Write solution.npz and harden.json, and the files of `rare` if there are failures; returns those it wrote."""
        folder = check_path("folder", folder, "the path of a folder")
        rounds = [
            {"cost": plan.cost, "hit": plan.hit, "strays": plan.strays, "probability": plan.probability}
            for plan in self.rounds
        ]
        findings = {"success": self.success, "reason": self.reason, "chosen": self.chosen, "rounds": rounds}
        save_load.save(self.solution, folder / "solution.npz")
        settings = {"chance": self.chance, **self.options}
        write_json(self.problem, self.solution, folder / "harden.json", settings, findings, self.stopped)
        return None if self.rare is None else self.rare.save(folder, shown=shown)


@checked
def harden(
    problem: ReliabilityProblem,
    *,
    chance: Chance = 1e-3,
    rounds: Annotated[int, Bounds(at_least=1, at_most=MOST_ROUNDS)] = 4,
    particles: Annotated[int, Bounds(at_least=20)] | None = None,
    repetitions: Annotated[int, Bounds(at_least=2)] = 10,
    seed: Seed | None = None,
    report: Report | None = None,
    progress: TextProgress | None = None,
) -> HardenedPlan:
    """Find a plan with a measured probability of failure of at most the requested one, at little additional cost.

    Args:
      problem: scenario, disturbances, policy and failure. The policy is "smooth", "track" or "offset_free"; the failure
        is a collision. Predictions know its `design_disturbances`; by default all that it has. A `solution` is the
        first plan; by default that is the result of `smooth_chance_constrained`.
      chance: wanted probability that the robot collides. The whole interval of the measured probability must be below.
      rounds: largest number of plans.
      particles: number of trials at each level. By default 250; for a chance from 0.005 on 10 / chance, so that
        failures are counted.
      repetitions: number of independent estimates, whose spread gives the interval.
      seed: seed of the first measurement, by default that of the problem; the others have the seeds after it.
      report: called with a description of the run, and with a line for each plan.

    Returns:
      The HardenedPlan: the first plan that is safe enough in two measurements, the second with fresh random numbers; or
        else the safest one, with `success` False and a `reason`.

    Raises:
      KeyboardInterrupt: Ctrl-C; its `found` is the HardenedPlan after the rounds that are done, or None.
    """
    if particles is None:
        particles = 250 if chance < COUNTED_CHANCE else max(20, ceil(FAILING_TRIALS / chance))
    seed = problem.seed if seed is None else seed
    options = {"rounds": rounds, "seed": seed, "particles": particles, "repetitions": repetitions}
    search, say = _Search(problem, chance, options, progress), report or (lambda line: None)

    def so_far(_: object) -> HardenedPlan | None:
        return search.result(f"stopped after {len(search.rounds)} of {rounds} plans") if search.rounds else None

    with keeping(so_far):
        while len(search.rounds) < rounds and (solution := search.next()) is not None:
            label = f"plan {len(search.rounds) + 1}"
            if not search.rounds:
                say(replace(problem, solution=solution).summary())
            search.rounds.append(search.measure(solution, label))
            say(f"{label}: {search.rounds[-1]}")
            if search.enough():
                search.rounds[-1] = search.measure(solution, f"{label} again")
                say(f"{label} again, with fresh random numbers: {search.rounds[-1]}")
                if search.enough():
                    break
    return search.result(search.shortfall())


class _Search:
    def __init__(
        self, problem: ReliabilityProblem, chance: float, options: dict[str, int], progress: TextProgress | None = None
    ) -> None:
        check_name("problem: policy", problem.policy, POLICIES)
        if problem.failure != "collision":
            raise InputError(f"problem: failure: got {problem.failure!r}, want 'collision', which more room prevents")
        scenario = problem.resolved
        if scenario.problem.duration is not None:
            raise InputError(f"problem: got {problem.scenario}, whose duration is free, want a fixed one")
        self.problem, self.chance, self.options, self.progress = problem, chance, options, progress
        self.scenario, design = scenario, problem.design_disturbances
        uncertainty = uncertainty_of(scenario.plant(), problem.disturbances)  # also refuses sets that there are not
        self.uncertainty = uncertainty if design is None else design_uncertainty(scenario, design)
        self.surroundings = Surroundings.of(scenario.problem, self.uncertainty.obstacles)
        self.names = [obstacle.name for shape in self.surroundings.shapes for obstacle in shape.world.obstacles]
        self.rounds: list[HardeningRound] = []
        self.measurements = 0
        self.ended = ""  # why there is no next plan

    def controller(self, problem: Problem, solution: Solution) -> OffsetFree | AffinePolicy:
        name = self.problem.policy if self.problem.policy in DESIGNED else "feedback"
        law = make_controller(name, self.scenario, solution, design=self.problem.design_disturbances)
        assert isinstance(law, OffsetFree | AffinePolicy)
        return law

    def next(self) -> Solution | None:
        stated = self.scenario.problem
        if not self.rounds:
            if self.problem.given is not None:
                return self.problem.given
            plan = smooth_chance_constrained(stated, self.uncertainty, chance=self.chance, controller=self.controller)
            if not plan.solution.success:
                got = f"{self.problem.scenario} ({plan.solution.status.name})"
                raise InputError(f"problem: got no plan for {got}, want one that can be solved")
            return plan.solution
        last = self.rounds[-1]
        if last.rare is None:  # nothing tells where the plan needs more room
            return None
        if not any(name in last.hit for name in self.names):
            self.ended = f"all failing runs leave the plan for good, which more room does not prevent; {self.remedy}"
            return None
        more = self.wanted(last) - self.deviations
        for fraction in (1.0, 0.5, 0.25):  # as much of it as there is room for
            deviations = np.maximum(self.deviations + fraction * more, 0.0)
            clearances = self.surroundings.keep_away(deviations * self.std)
            problem = replace(stated, constraints=(*stated.constraints, *clearances))
            solution = smooth(problem, start=last.solution.trajectory)
            if solution.success:
                return solution
        self.ended = "there is no plan with more room; allow a higher chance, or another route"
        return None

    def wanted(self, last: HardeningRound) -> Array:
        """The numbers of standard deviations (O,) that the next plan keeps from each obstacle."""
        assert last.rare is not None
        hit, kept = np.array([last.hit.get(name, 0.0) for name in self.names]), np.maximum(self.deviations, 1.0)
        critical, chance = hit > 0, last.rare.probability.value
        # The runs that leave the plan for good take their part of the request.
        left = max(self.chance - chance * last.strays, 0.1 * self.chance)
        quantile = -ndtri(AIMED_FRACTION * left / critical.sum())
        measured = -ndtri(np.clip(chance * hit[critical], 1e-300, 0.4))
        wanted = np.minimum(kept, quantile * (kept[critical] / measured).max())
        wanted[critical] = kept[critical] * np.clip(quantile / measured, LEAST_FACTOR, LARGEST_FACTOR)
        return wanted

    def measure(self, solution: Solution, label: str) -> HardeningRound:
        """A plan with its failures. The next plan begins with its clearances."""
        measured = self._failures(solution, label)
        rare, unfailing = (None, measured.trials) if isinstance(measured, NoFailure) else (measured, 0)
        problem, plan = self.scenario.problem, solution.trajectory
        place = list(problem.dynamics.state_coordinates.position)
        # Trials of the model, which take long, are needed for moments with a latency or a delay alone.
        samples = None if self.uncertainty.latency or self.uncertainty.delay else 0
        law = self.controller(problem, solution)
        tube = predict_tube(problem, solution, self.uncertainty, law, samples=samples)
        spread = self.surroundings.spread(plan.states + tube.mean, tube.covariance, tube.across)
        # Least planned clearance of each obstacle in predicted standard deviations, (O,), and these, (T+1, O).
        self.deviations, self.std = (spread.mean / spread.std).min(axis=0), spread.std
        cost = float(costs_of(problem, plan.states[None], plan.controls[None])[0])
        hit, strays = dict[str, float](), 0.0
        if rare is not None:
            run = rare.problem.score.rollout(rare.typical(REPLAYED_FAILURES), frames=False)
            distances = np.linalg.norm((run.states[:, -1] - plan.states[-1])[:, place], axis=1)
            widest = np.sqrt(np.linalg.eigvalsh(tube.position_covariance).max()) if place else np.inf
            hits = np.array(run.obstacles)[(distances <= STRAY * widest) & (np.array(run.outcome) == "collided")]
            hit = {str(name): float(np.sum(hits == name)) / run.trials for name in np.unique(hits)}
            strays = 1 - len(hits) / run.trials
        return HardeningRound(solution=solution, cost=cost, rare=rare, hit=hit, strays=strays, unfailing=unfailing)

    def _failures(self, solution: Solution, label: str) -> RareFailures | NoFailure:
        """The failures of a plan; the NoFailure if none is found, also by enough trials, unless these are too many."""
        repetitions, particles = self.options["repetitions"], self.options["particles"]
        seed, begun = self.options["seed"] + self.measurements, self.measurements * repetitions
        self.measurements += 1
        problem = replace(self.problem, solution=solution)

        def tell(done: int, _: int, text: str) -> None:
            if self.progress is not None:
                self.progress(begun + done, 2 * self.options["rounds"] * repetitions, f"{label}: {text}")

        options: dict[str, Any] = {"repetitions": repetitions, "seed": seed, "progress": tell}
        keep = 0.0 if self.chance * particles >= FAILING_TRIALS else 0.1
        try:
            return problem.rare_failures(**options, particles=particles, keep=keep)
        except NoFailure as none:
            # Without a failure among so many trials, the exact upper bound is at most the chance.
            needed = ceil(log((1 - CONFIDENCE) / 2) / log1p(-self.chance))
            if none.trials >= needed or needed > MOST_COUNTED:
                return none
        try:
            return problem.rare_failures(**options, particles=max(20, ceil(needed / repetitions)), keep=0.0)
        except NoFailure as none:
            return none

    def enough(self) -> bool:
        """Whether the last plan's failures are surely as rare as requested."""
        return self.rounds[-1].probability.high <= self.chance

    def shortfall(self) -> str:
        """Why the last plan is not safe enough, and what may help; empty if it is."""
        if self.enough() or self.ended:
            return self.ended
        last = self.rounds[-1]
        if last.rare is None:
            found = f"splitting found no failure of plan {len(self.rounds)} but may have missed some"
            proved = f"{last.unfailing:,} trials without one prove at most {last.probability.high:.2g}"
            counted = f"from {ceil(FAILING_TRIALS / self.chance):,} on failures are counted"
            return f"{found}, and {proved}; allow more particles: {counted}"
        after, strays = f"not after {len(self.rounds)} plans", last.strays
        safest = self.safest()
        found = self.rounds[safest].probability
        if found.value <= self.chance:
            measured = f"the probability of plan {safest + 1} is measured as {found.low:.2g} to {found.high:.2g}"
            return f"{measured}, too wide an interval; allow more particles or repetitions, or a higher chance"
        if strays < 0.5:
            return f"{after}; allow more rounds, or a higher chance"
        return f"{after}, because {100 * strays:.0f} % of the failing runs leave the last one for good; {self.remedy}"

    @property
    def remedy(self) -> str:
        """What helps against runs that leave their plan for good."""
        designed = self.problem.policy in DESIGNED and self.problem.design_disturbances is not None
        design = ", design the law for what is run (without design_disturbances)" if designed else ""
        return f"give the controls more range{design}, or allow a higher chance"

    def safest(self) -> int:
        """The number of the safest plan so far; one without failures is as safe as its trials prove."""
        measured = [(plan.probability.high if plan.rare is None else plan.probability.value) for plan in self.rounds]
        return int(np.argmin(measured))

    def result(self, reason: str) -> HardenedPlan:
        """The last plan if there is no reason against it, else the safest of the plans so far."""
        chosen = self.safest() if reason else len(self.rounds) - 1
        return HardenedPlan(
            problem=self.problem, chance=self.chance, options=self.options, rounds=tuple(self.rounds), chosen=chosen,
            reason=reason,
        )  # fmt: skip


@checked
@dataclass(frozen=True, eq=False)
class ComparedPlan:
    """A plan that was compared.

    Attributes:
      start: the start of its search.
      successes: whether each of the common trials reached the goal, (K,).
    """

    start: Line
    solution: Solution
    successes: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        keep(self, successes=check_array("ComparedPlan: successes", self.successes, (None,)) != 0)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class SafestPlan:
    """The plan with which most of the common trials reached the goal.

    Attributes:
      compared: all plans that were compared, the best first.
      reached: its success rate in fresh trials: in those by which it was selected the rate is biased.
    """

    solution: Solution
    compared: Annotated[tuple[ComparedPlan, ...], Want("a tuple of ComparedPlan")]
    reached: Estimate

    def summary(self) -> str:
        """The success rate, and a line for each plan with its cost and successes."""
        lines = [f"{100 * self.reached.value:.1f} % of fresh trials reach the goal with the first of these plans:"]
        for plan in self.compared:
            count = f"{int(plan.successes.sum())} of {len(plan.successes)} trials"
            lines.append(f"  {plan.start}: cost {plan.solution.cost:.6g}, {count}")
        return "\n".join(lines)

    __str__ = summary


@checked
def smooth_safest(
    problem: Problem,
    plant: Plant,
    disturbances: Sequence[Disturbance | Noise],
    *,
    trials: Annotated[int, Bounds(at_least=1, at_most=MOST_TRIALS)] = 200,
    starts: int | None = None,
    seed: Seed = 0,
    goal_radius: float | None = None,
    goal_tolerance: float | None = None,
    threads: int | None = None,
) -> SafestPlan:
    """Choose among the candidates of `smooth` by success rate instead of cost.

    Each candidate is solved to convergence; duplicates are dropped. All plans run in the same trials. Of plans with as
    many successes, the cheapest is chosen. What is not named here is as for `smooth` and `simulate`.

    Args:
      trials: number of trials of each plan, and of fresh trials of the chosen plan.
    """
    first = smooth(problem, starts=starts, threads=threads)
    plans: list[tuple[str, Solution]] = []
    for candidate in first.candidates:
        if not candidate.trajectory.finite:
            continue
        is_first = candidate.status is not None and candidate.cost == first.cost
        solution = first if is_first else smooth(problem, start=candidate.trajectory)
        if solution.success and not any(_same(solution, other) for _, other in plans):
            plans.append((candidate.start, replace(solution, candidates=first.candidates)))
    if not plans and first.success:
        plans.append(("the search's own", first))
    if not plans:
        raise InputError(f"problem: got no converged plan ({first.status.name}), want a problem that can be solved")

    def reached(solution: Solution, begin: int) -> npt.NDArray[np.bool_]:
        run = simulate(
            plant, solution, disturbances=disturbances, seed=seed, trials=trials, first_trial=begin, threads=threads,
            goal_radius=goal_radius, goal_tolerance=goal_tolerance, frames=False, contacts=False,
        )  # fmt: skip
        return run.reached

    compared = [ComparedPlan(start, solution, reached(solution, 0)) for start, solution in plans]
    compared.sort(key=lambda plan: (-int(plan.successes.sum()), plan.solution.cost))
    best = compared[0].solution
    successes = int(reached(best, trials).sum())
    return SafestPlan(solution=best, compared=tuple(compared), reached=rate(successes, trials))


def _same(first: Solution, second: Solution) -> bool:
    """Whether two plans are the same within SAME_PLAN."""
    deviation = first.policy.state_coordinates.difference(first.trajectory.states, second.trajectory.states)
    scale = np.maximum(np.ptp(second.trajectory.states, axis=0), 1e-9)
    return bool((np.abs(deviation) <= SAME_PLAN * scale).all())

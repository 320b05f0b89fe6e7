"""Plans whose chance of collision is bounded, by a clearance from obstacles at each step.

The clearance at a step is a multiple of the standard deviation of the robot's predicted position. The multiple is the
same for all steps. It is chosen so that the chance of any collision, as `prediction.py` computes it, equals the
requested one. Each plan has its own tube, so the multiple is found by solving again a few times.

If no clearance is safe enough, or there is no room for it, the weights of the obstacles are raised instead. Such plans
use all the room that there is. A constraint would only report that there is too little.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from scipy.special import ndtri

from lqrsim.annotations import Chance, Count, Finite, Positive, TextProgress, Want, checked
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.prediction import LARGEST_MARGIN, Spread, Surroundings
from lqrsim.control.tubes import Tube, predict_tube
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import InputError
from lqrsim.problem.parts import weighing_obstacles
from lqrsim.problem.problem import Problem
from lqrsim.process import keeping
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.solvers.compiled import costs_of
from lqrsim.solvers.smoother import smooth

# A plan whose chance is below the requested one by no more than this factor is not made cheaper.
ENOUGH = 0.5
# m; a clearance that exceeds its margin by at most this, and by one standard deviation, is determined by the margin.
HELD = 1e-3
AIM = 0.8  # target for the next plan, relative to the requested chance
WIDEN = 2.0  # largest factor on the margin, in standard deviations, from one plan to the next
PATIENCE = 2  # stop widening margins, or raising weights, after this many plans in a row without a safer one
HEAVIER = (10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)  # factors of the weight of the obstacles' cost
MakeController = Annotated[
    Callable[[Problem, Solution], OffsetFree | AffinePolicy], Want("a function of problem and solution, or None")
]


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class SafePlan:
    """A plan with its predicted chance of collision.

    Attributes:
      problem: the problem, with the clearances that were found as constraints; or with heavier obstacles.
      tube: the prediction of its runs; `tube.collision_chance` is the chance.
      rounds: for each plan that was solved for: smallest and largest margin in m, cost, and predicted chance.
      weight: factor of the weight of the problem's obstacles, usually 1. `solution.cost` has it, `cost` does not.
      instead: if the plan is not safe enough, the predicted chances on the same plan with actuators without lag, with
        twice their range, with exact sensors, and with all of these. They show what limits the safety.
    """

    problem: Problem
    solution: Solution
    controller: OffsetFree | AffinePolicy
    tube: Tube
    asked: Chance
    rounds: tuple[tuple[Finite, Finite, Finite, Finite], ...]
    weight: Positive = 1.0
    instead: Annotated[Mapping[str, float], Want("a dictionary of chances")] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether the plan is a solution, and its predicted chance of collision is at most the requested one."""
        return self.solution.success and self.tube.collision_chance <= self.asked

    @property
    def cost(self) -> float:
        """Cost of the plan with the obstacles as heavy as in the given problem, so that plans can be compared."""
        if self.weight == 1:
            return self.solution.cost
        original, plan = _reweighted(self.problem, 1 / self.weight), self.solution.trajectory
        lighter, heavier = (
            costs_of(problem, plan.states[None], plan.controls[None])[0] for problem in (original, self.problem)
        )
        return float(self.solution.cost - (heavier - lighter))

    def __str__(self) -> str:
        lines = [f"{self.solution.summary()}", "  margin (m)       cost        chance of collision"]
        lines += [f"  {low:5.3f} to {high:5.3f}  {cost:10.6g}  {chance:.3g}" for low, high, cost, chance in self.rounds]
        verdict = "as asked" if self.success else "MORE than asked" if self.solution.success else "no solution"
        lines.append(f"  asked: {self.asked:g}, predicted: {self.tube.collision_chance:.3g} ({verdict})")
        if (strays := 100 * (self.tube.strays or 0.0)) > 100 * self.asked:
            lines.append(f"  {strays:.3g} % of the trials leave the plan by over six standard deviations")
        if self.weight != 1:
            lines.append(f"  with {self.weight:g} times the weight of obstacles; without, it costs {self.cost:.6g}")
        if self.instead:
            chances = ", ".join(f"{chance:.3g} with {change}" for change, chance in self.instead.items())
            lines.append(f"  on this plan {chances}")
        return "\n".join(lines)


@checked
def smooth_chance_constrained(
    problem: Problem,
    uncertainty: Uncertainty,
    *,
    chance: Chance = 1e-3,
    controller: MakeController | None = None,
    rounds: Count = 8,
    progress: TextProgress | None = None,
) -> SafePlan:
    """A plan whose predicted chance of collision is at most the requested one, at little additional cost.

    The search ends when the predicted chance is between half the requested chance and the requested chance, or when the
    plan without any clearance is safe enough. If no clearance is safe enough, the weights of the problem's obstacles
    are multiplied by 10 to 3000. If that fails too, the safest plan found is returned, with `success` False.
    `print(plan)` then shows how close it came. Allow a higher chance, improve the estimation, or permit another route.

    Args:
      controller: (problem, solution) -> the controller that runs the plan, an OffsetFree or an AffinePolicy. By default
        an OffsetFree for the uncertainty, with tolerances chosen for each plan.
      progress: called with the number of plans that are done, the largest possible number of plans, and a text about
        the last one. The largest number counts plans with margins and plans with heavier obstacles.

    Raises:
      KeyboardInterrupt: Ctrl-C; its `found` is the SafePlan of the rounds that are done, None if there are none.
    """
    surroundings = Surroundings.of(problem, uncertainty.obstacles)
    if not surroundings.kept:
        raise InputError("problem: got a problem without obstacles, want an ObstacleCost or a Clearance in it")
    search = _Search(problem, uncertainty, chance, controller, surroundings)
    most = rounds + (len(HEAVIER) if problem.obstacle_costs else 0)

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, most, search.last() if search.plans else "")

    with keeping(lambda _: search.result() if search.plans else None):
        tell(0)
        search.solve(None)
        for done in range(rounds):
            tell(done)
            deviations = search.next_deviations()
            if deviations is None:
                break
            search.solve(deviations)
        for done, _ in enumerate(search.heavier()):
            tell(rounds + done)
        tell(most)
    return search.result()


def _reweighted(problem: Problem, factor: float) -> Problem:
    return problem.with_costs(stage_cost=weighing_obstacles(problem.stage_cost, factor))


def chances_instead(plan: SafePlan, uncertainty: Uncertainty) -> dict[str, float]:
    """Predicted chances of collision on a plan, with one improvement at a time, and with all of them.

    In the place of an OffsetFree each prediction uses one that is designed for it, with the same sensors, tolerances
    and memory; a policy stays the same.
    """
    policy = plan.solution.policy
    space = policy.control_coordinates
    half = 0.5 * np.subtract(space.high, space.low)
    wider = replace(space, low=tuple(np.subtract(space.low, half)), high=tuple(np.add(space.high, half)))
    no_lag, no_noise = {"lag": 0.0}, {"measurement": 0.0, "loss": 0.0}
    cases: dict[str, tuple[bool, dict[str, float]]] = {
        "no lag": (False, no_lag), "twice the range of controls": (True, {}), "exact sensors": (False, no_noise),
        "all of these": (True, no_lag | no_noise),
    }  # fmt: skip
    chances = {}
    for improvement, (strong, changes) in cases.items():
        solution, improved = plan.solution, replace(uncertainty, **changes)
        if strong:
            solution = replace(solution, policy=replace(policy, control_coordinates=wider))
        law = plan.controller
        if isinstance(law, OffsetFree):
            law = OffsetFree(law.problem, solution, replace(law.uncertainty, **changes), **law.options)
        elif strong:
            law = replace(law, control_coordinates=wider)
        chances[improvement] = predict_tube(plan.problem, solution, improved, law).collision_chance
    return chances


class _Search:
    """The plans so far, and the number of standard deviations of clearance in each."""

    def __init__(
        self, problem: Problem, uncertainty: Uncertainty, asked: float, make: MakeController | None,
        surroundings: Surroundings,
    ) -> None:  # fmt: skip
        self.problem, self.uncertainty, self.asked = problem, uncertainty, asked
        self.make = make or (lambda problem, solution: OffsetFree(problem, solution, uncertainty))
        self.surroundings = surroundings
        self.plans: list[SafePlan] = []
        self.margin, self.deviations = np.zeros((1, 1)), 0.0  # margin of the last plan, (T+1, O), and its multiple
        self.lines: list[tuple[float, float, float, float]] = []
        # Numbers of standard deviations: the largest that is too small, the smallest that is enough, and the smallest
        # for which no plan was found.
        self.too_few, self.enough, self.impossible = 0.0, np.inf, np.inf
        self.log_of_too_few = self.log_of_enough = 0.0  # logarithms of the chances at these numbers

    def solve(self, deviations: float | None) -> None:
        """Plan with a margin of that many standard deviations, and predict the outcome."""
        problem, start, margin = self.problem, None, self.margin
        # The second plan has the same margin at all steps, because the position of the first plan matters little.
        second = len(self.plans) == 1
        if deviations is not None:
            base = self.plans[-1]
            margin = deviations * self._spread(base).std
            if second:
                margin = np.full_like(margin, np.sqrt((margin**2).mean()))
            problem = replace(problem, constraints=(*problem.constraints, *self.surroundings.keep_away(margin)))
            # The first plan may cut through obstacles: a solve from it would choose the route by chance.
            start = None if second else base.solution.trajectory
        solution = smooth(problem, start=start)
        if not solution.success and start is not None:
            solution = smooth(problem)
        if not solution.success and self.plans:
            self.impossible = min(self.impossible, deviations or 0.0)
            return
        self.margin, self.deviations = margin, deviations or 0.0
        tube = self._keep(problem, solution, 1.0)
        if deviations is None:
            return
        if tube.collision_chance > self.asked:
            if deviations > self.too_few:
                self.too_few, self.log_of_too_few = deviations, np.log(tube.collision_chance)
        elif not second and deviations < self.enough:  # the second plan has other margins, perhaps too large
            self.enough, self.log_of_enough = deviations, np.log(max(tube.collision_chance, 1e-300))

    def _keep(self, problem: Problem, solution: Solution, weight: float) -> Tube:
        controller, margin = self.make(problem, solution), self.margin
        tube = predict_tube(problem, solution, self.uncertainty, controller)
        plan = SafePlan(
            problem=problem, solution=solution, controller=controller, tube=tube, asked=self.asked, rounds=(),
            weight=weight,
        )  # fmt: skip
        self.lines.append((float(margin.min()), float(margin.max()), plan.cost, tube.collision_chance))
        self.plans.append(plan)
        return tube

    def heavier(self) -> Iterator[float]:
        """Plan with heavier obstacles, as long as no plan is safe enough and that helps; yields before each plan."""
        first = len(self.plans)
        for factor in HEAVIER if self.problem.obstacle_costs else ():
            if self._best().success or self._gave_up(first):
                return
            yield factor
            problem = _reweighted(self.problem, factor)
            solution, self.margin = smooth(problem), np.zeros((1, 1))
            if solution.success:
                self._keep(problem, solution, factor)

    def _gave_up(self, first: int) -> bool:
        """Whether the last plans, counted from the given one on, were no safer than the safest of them."""
        chances = [plan.tube.collision_chance for plan in self.plans[first:]]
        return len(chances) > PATIENCE and min(chances[-PATIENCE:]) >= min(chances[:-PATIENCE])

    def _spread(self, plan: SafePlan) -> Spread:
        tube = plan.tube
        return self.surroundings.spread(plan.solution.trajectory.states + tube.mean, tube.covariance, tube.across)

    def next_deviations(self) -> float | None:
        """The number of standard deviations to try next; None if more would not help."""
        plan = self.plans[-1]
        chance = plan.tube.collision_chance
        first = len(self.plans) == 1 and self.impossible == np.inf
        if first and (chance <= self.asked or not plan.solution.success):
            return None
        best = self._best()
        if not first and best.success and best.tube.collision_chance >= ENOUGH * self.asked:
            return None
        if self._gave_up(0):
            return None
        if np.isfinite(self.impossible):  # between a margin with a plan and a margin without
            if np.isfinite(self.enough) or self.impossible - self.too_few < 0.05 * self.impossible:
                return None
            return (self.too_few + self.impossible) / 2
        wanted = max(float(-ndtri(self.asked)), 0.5) if first else self._needed(plan)
        if not np.isfinite(self.enough):
            return max(wanted, 1.01 * self.too_few)
        if self.enough - self.too_few < 0.003 * self.enough:
            return None
        if self.too_few == 0 and self.too_few < wanted < self.enough:
            return wanted
        # Between the two, the logarithm of the chance is assumed to be linear.
        fraction = (self.log_of_too_few - np.log(AIM * self.asked)) / (self.log_of_too_few - self.log_of_enough)
        return self.too_few + float(np.clip(fraction, 0.1, 0.9)) * (self.enough - self.too_few)

    def _needed(self, plan: SafePlan) -> float:
        """The number of standard deviations at which the plan would be as safe as requested; at most twice its own.

        Assumes that all smaller clearances grow to it, and that clearances that only just keep a larger margin shrink
        to it. Where trials collide although the moments hardly know of a collision, with a chance of 1e-50 or 0, that
        number says nothing, and only the limit holds.
        """
        spread = self._spread(plan)
        held = spread.mean <= self.margin + np.minimum(HELD, spread.std)
        clearance = np.where(held, -np.inf, spread.mean)
        # The moments are assumed to misjudge the next plan's chance by the same factor as this plan's.
        wanted, tube = AIM * self.asked, plan.tube
        if tube.collision_chance > 0:
            wanted *= tube.linear_chance / tube.collision_chance
        low, high = 0.0, LARGEST_MARGIN
        for _ in range(40):
            middle = (low + high) / 2
            safe = spread._replace(mean=np.maximum(clearance, middle * spread.std)).chance()[1] <= wanted
            low, high = (low, middle) if safe else (middle, high)
        return min(high, WIDEN * self.deviations)

    def _best(self) -> SafePlan:
        """The cheapest plan that is safe enough, or else the safest."""
        safe = [plan for plan in self.plans if plan.success]
        if safe:
            return min(safe, key=lambda plan: plan.cost)
        return min(self.plans, key=lambda plan: (not plan.solution.success, plan.tube.collision_chance))

    def last(self) -> str:
        """A text on the last plan, for `progress`."""
        low, high, cost, chance = self.lines[-1]
        weight = self.plans[-1].weight
        how = f"margins of {low:.3g} to {high:.3g} m" if weight == 1 else f"{weight:g} times the weight of obstacles"
        return f"chance {chance:.2g} with {how}, cost {cost:.5g}"

    def result(self) -> SafePlan:
        best = replace(self._best(), rounds=tuple(self.lines))
        if best.success or not best.solution.success:
            return best
        return replace(best, instead=chances_instead(best, self.uncertainty))

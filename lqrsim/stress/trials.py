"""Running a campaign's trials: the same in this process, in one on this machine, and on another machine."""

import logging
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.replanner import Replanner
from lqrsim.control.tracking import track
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import InputError, check_name, told
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios import solutions as solving
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, preset
from lqrsim.simulation.uncertainty_of import uncertainty_of
from lqrsim.stress.outcome_table import Outcomes, outcomes
from lqrsim.stress.specification import KINDS, Campaign, Cell, Shard, check_told
from lqrsim.stress.sweeps import sweep
from lqrsim.stress.trial_tables import Table, pack

_log = logging.getLogger("lqrsim")

CONTROLLERS = ("feedback", "track", "offset_free", "replan")
_STATED = "moderate"  # the preset that is stated by default


@dataclass(frozen=True)
class Job:
    """What a worker is told.

    Attributes:
      campaign: in JSON. digest: of it. solutions: behind its policies.
      batch: how many trials to simulate together.
      run: tells this run from all others, also of the same campaign.
    """

    campaign: Mapping[str, Any]
    digest: str
    solutions: Mapping[str, Solution]
    batch: int
    run: str = field(default_factory=lambda: f"lqrsim-{uuid.uuid4().hex}")


def without_diagnostics(solution: Solution) -> Solution:
    """What running it and solving it again take, without what only tells how it was found."""
    return replace(solution, inverse_policy=None, cost_to_come=None, iterations=(), candidates=())


def solve(
    policies: Sequence[str],
    scenario: Scenario,
    stated: Sequence[Disturbance] | None = None,
    given: Solution | None = None,
) -> dict[str, Solution]:
    """The solution behind each policy, those made for what is stated included.

    That of "track" has its law; that of "offset_free" is the plan that it keeps to, with the policy of "smooth".

    Args:
      given: from `solutions.given`, in place of what its solver would find.

    Raises:
      InputError: a policy cannot be run, or none is about the given solution.
    """
    plans = {} if given is None else {solver_of(given): given}
    check_has_use(given, policies)
    solutions: dict[str, Solution] = {}
    for policy in policies:
        solver = KINDS[policy].solver
        if solver not in plans:
            plans[solver] = solving.solve(scenario, solver)
        solutions[policy] = plans[solver].open_loop() if policy == "open_loop" else plans[solver]
    for solver, plan in plans.items():
        if not np.isfinite(plan.trajectory.states).all():
            raise InputError(f"policies: got those of {solver}, whose plan is not finite ({plan.status.name})")
        for remark in solving.remarks(scenario, plan):
            _log.warning("the solution of %s %s", solver, remark)
    if "track" in policies:
        law = track(scenario.problem, solutions["track"], uncertainty=stated_uncertainty(scenario, stated))
        solutions["track"] = replace(solutions["track"], policy=law)
    return solutions


def solver_of(solution: Solution) -> str:
    """Whose place a given solution takes."""
    return "ilqr" if solution.solver == "ilqr" else "smooth"


def check_has_use(given: Solution | None, policies: Sequence[str]) -> None:
    """Raise InputError unless one of the policies is about the plan of a given solution."""
    if given is None:
        return
    own = [policy for policy, kind in KINDS.items() if kind.solver == solver_of(given)]
    if not {*own} & {*policies}:
        raise InputError(
            f"solution: got one of {given.solver} with {', '.join(policies)}, want it with one of {', '.join(own)}"
        )


def stated_disturbances(scenario: Scenario, stated: Sequence[Disturbance] | None = None) -> Sequence[Disturbance]:
    """Those, or by default a preset's."""
    return preset(_STATED, scenario.plant()) if stated is None else stated


def stated_uncertainty(scenario: Scenario, stated: Sequence[Disturbance] | None = None) -> Uncertainty:
    """What "track" and "offset_free" are made for. Raises InputError where the scenario's robot cannot have it."""
    try:
        return uncertainty_of(scenario.plant(), stated_disturbances(scenario, stated))
    except InputError as error:
        raise InputError(f"stated: {error}") from None


def impossible_policies(scenario: Scenario, given: Solution | None = None) -> dict[str, str]:
    """The policies that the scenario cannot have, with the given solution if there is one, and why."""
    found: dict[str, str] = {}
    if scenario.problem.constraints:
        found["ilqr"] = "which cannot keep the scenario's constraints"
    replanned = given if given is not None and solver_of(given) == KINDS["replan"].solver else None
    if replanned is not None and replanned.problem_digest != scenario.problem.digest:
        found["replan"] = "which solves the scenario's problem again, of which the solution is not"
    return found


def left_out(policies: Sequence[str], impossible: Mapping[str, str]) -> str:
    """Which policies are not among these for what they cannot do, in a line; empty if there is none."""
    missing = [f"{policy}, {why}" for policy, why in impossible.items() if policy not in policies]
    return f"left out: {'; '.join(missing)}" if missing else ""


def controller(
    name: str,
    scenario: Scenario,
    solution: Solution,
    *,
    stated: Sequence[Disturbance] | None = None,
    replan_every: float | None = None,
) -> Controller | AffinePolicy:
    """One of CONTROLLERS, about a solution of the scenario.

    Args:
      name: "feedback", the solution's policy; "track" and "offset_free", `lqrsim.track` and `lqrsim.OffsetFree` about
        its plan; "replan", which solves again as it goes.
      stated: disturbances that "track" and "offset_free" are made for, as in `Campaign`.
      replan_every: seconds between two solves of "replan"; by default a tenth of the horizon.

    Raises:
      InputError: there is none of that name, or it does not fit the scenario and the solution.
    """
    problem = scenario.problem
    match check_name("controller", name, CONTROLLERS):
        case "track":
            return track(problem, solution, uncertainty=stated_uncertainty(scenario, stated))
        case "offset_free":
            return OffsetFree(problem, solution, stated_uncertainty(scenario, stated))
        case "replan":
            if solution.problem_digest != problem.digest:
                raise InputError(
                    f"controller: got replan for a solution of another problem than that of {scenario.name}, want one"
                    f" that was solved as the scenario has it, or another of {', '.join(CONTROLLERS)}"
                )
            every = max(problem.dt, problem.steps * problem.dt / 10) if replan_every is None else replan_every
            return Replanner(problem, solution, every=every, deadline=0.0)
    return solution.policy


def controller_by_name(
    name: str, scenario: Scenario, solution: Solution, stated: str | None = None
) -> Controller | AffinePolicy:
    """The same, but that what is stated is named, as `sweep` names it.

    Raises:
      InputError: as `controller`; or there is no such name, or a controller that has no use for it.
    """
    if stated is None:
        return controller(name, scenario, solution)
    check_told("stated", (name,))
    return controller(name, scenario, solution, stated=sweep(stated, scenario))


def controller_of(
    policy: str,
    scenario: Scenario,
    solution: Solution,
    *,
    stated: Sequence[Disturbance] | None = None,
    replan_every: float | None = None,
) -> Controller | AffinePolicy:
    """What runs one of POLICIES, given what `solve` has for it."""
    return controller(KINDS[policy].controller, scenario, solution, stated=stated, replan_every=replan_every)


class Trials:
    """Runs trials of a campaign's cells."""

    def __init__(self, campaign: Campaign, scenario: Scenario, solutions: Mapping[str, Solution]) -> None:
        self.campaign, self.scenario, self.solutions = campaign, scenario, solutions
        self.plant = scenario.plant()
        self._made: dict[str, Controller | AffinePolicy] = {}

    def run(self, cell: Cell, first: int, count: int = 1, *, frames: bool, contacts: bool) -> Rollout:
        """So many trials of a cell, from the first on."""
        return simulate(
            self.plant,
            self.solutions[cell.policy],
            controller=self._controller(cell.policy),
            disturbances=self.campaign.disturbances(cell),
            **self.scenario.near_enough(self.campaign.goal_radius, self.campaign.goal_tolerance),
            seed=self.campaign.seed,
            trials=count,
            first_trial=first,
            frames=frames,
            contacts=contacts,
            threads=1,
        )

    def warm_up(self) -> None:
        """Have everything compiled, by undisturbed trials."""
        solution = next(iter(self.solutions.values()))
        self.outcomes(simulate(self.plant, solution, frames=False, contacts=False, threads=1))
        if (solution := self.solutions.get("offset_free")) is not None:  # whose filter is compiled, too
            law = self._controller("offset_free")
            simulate(self.plant, solution, controller=law, frames=False, contacts=False, threads=1)

    def outcomes(self, rollout: Rollout) -> Outcomes:
        """How the trials of a rollout ended."""
        return outcomes(rollout, self.scenario.problem)

    def table(self, shard: Shard, batch: int) -> Table:
        """The rows of a shard. Where an exception or a controller ends a batch, its trials are run one by one."""
        cell = self.campaign.cells[shard.cell]
        last = shard.first + shard.count
        parts: list[Table] = []
        for first in range(shard.first, last, batch):
            count = min(batch, last - first)
            try:
                rows = self._rows(cell, first, count)
                alone = count > 1 and bool((rows["outcome"] == "error").any())
            except Exception:  # of a disturbance or a scenario, whatever it is: the trial failed
                rows, alone = {}, True
            parts += [self._row(cell, trial) for trial in range(first, first + count)] if alone else [rows]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _rows(self, cell: Cell, first: int, count: int) -> Table:
        rollout = self.run(cell, first, count, frames=False, contacts=False)
        reasons = np.array(rollout.reasons, dtype=np.str_)
        table = self.outcomes(rollout).columns()
        return table | {"reason": np.where(np.isin(table["outcome"], ("diverged", "error")), reasons, "")}

    def _row(self, cell: Cell, trial: int) -> Table:
        try:
            return self._rows(cell, trial, 1)
        except Exception as error:
            return failed(trial, 1, told(error))

    def _controller(self, policy: str) -> Controller | AffinePolicy:
        """Made once, for its gains take a while; a run begins it anew."""
        if policy not in self._made:
            options = {"stated": self.campaign.stated, "replan_every": self.campaign.replan_every}
            self._made[policy] = controller_of(policy, self.scenario, self.solutions[policy], **options)
        return self._made[policy]


def failed(first: int, count: int, reason: str) -> Table:
    """Rows of trials that came to nothing."""
    columns: Table = {column.name: np.full(count, np.nan) for column in fields(Outcomes)}
    columns |= {"trial": np.arange(first, first + count), "outcome": np.full(count, "error")}
    return columns | {"obstacle": np.full(count, ""), "reason": np.full(count, reason)}


def work(job: Job, shard: Shard, trials: Trials | None = None) -> bytes:
    """The file of a shard, made in this process, by the trials that are there already if there are some."""
    return pack((trials or prepare(job)).table(shard, job.batch), shard, job.digest)


def failed_work(job: Job, shard: Shard, reason: str) -> bytes:
    """The file of a shard that came to nothing."""
    return pack(failed(shard.first, shard.count, reason), shard, job.digest)


def prepare(job: Job) -> Trials:
    """What runs a job's trials, kept for the rest of them."""
    if job.run not in _prepared:
        _prepared.clear()
        scenario = resolve(job.campaign["scenario"])  # first, for it may bring disturbances of its own
        trials = Trials(Campaign.from_json(job.campaign), scenario, job.solutions)
        trials.warm_up()
        _prepared[job.run] = trials
    return _prepared[job.run]


_prepared: dict[str, Trials] = {}  # of the last run that this process worked for

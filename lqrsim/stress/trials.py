"""Running a campaign's trials: the same in this process, in one on this machine, and on another machine."""

import logging
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller, Feedback, Replanning
from lqrsim.errors import InputError, told
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.outcome_table import Outcomes, outcomes
from lqrsim.solvers.ilqr import ilqr
from lqrsim.solvers.smoother import smooth
from lqrsim.stress.specification import POLICIES, Campaign, Cell, Shard
from lqrsim.stress.trial_tables import Table, pack

_log = logging.getLogger("lqrsim")


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
    """What running it takes, without what only tells how it was found: a fifth of the size."""
    return replace(
        solution, inverse_policy=None, cost_to_go=None, cost_to_come=None, iterations=(), candidates=(), multipliers=()
    )


def solve(policies: tuple[str, ...], scenario: Scenario) -> dict[str, Solution]:
    """The solution behind each policy. Raises InputError if one can not be run at all."""
    solutions: dict[str, Solution] = {}
    if {*policies} - {"ilqr"}:
        smoothed = smooth(scenario.problem)
        solutions |= {"smooth": smoothed, "open_loop": smoothed.open_loop(), "replan": smoothed}
    if "ilqr" in policies:
        solutions["ilqr"] = ilqr(scenario.problem)
    for policy in policies:
        if not np.isfinite(solutions[policy].trajectory.states).all():
            raise InputError(f"policies: got {policy}, whose plan is not finite ({solutions[policy].status.name})")
        solutions[policy] = replace(solutions[policy], goal_radius=scenario.target_radius())
        if not solutions[policy].success:
            _log.warning("%s did not converge (%s); its plan is run as it is", policy, solutions[policy].status.name)
    return {policy: solutions[policy] for policy in policies}


def possible_policies(scenario: Scenario) -> tuple[str, ...]:
    """The policies that the scenario can have: all of POLICIES, but for those that cannot keep its constraints."""
    return tuple(policy for policy in POLICIES if not (policy == "ilqr" and scenario.problem.constraints))


def left_out(policies: Sequence[str], scenario: Scenario) -> str:
    """Which policies are not among these for what they cannot do, in a line; empty if there is none."""
    missing = [policy for policy in POLICIES if policy not in {*policies, *possible_policies(scenario)}]
    return f"left out: {', '.join(missing)}, which cannot keep the scenario's constraints" if missing else ""


def controller(policy: str, scenario: Scenario, solution: Solution, replan_every: float | None = None) -> Controller:
    """What runs a policy; by default it plans again each tenth of the horizon."""
    problem = scenario.problem
    if policy != "replan":
        return Feedback(solution.policy)
    every = max(problem.dt, problem.steps * problem.dt / 10) if replan_every is None else replan_every
    return Replanning(problem, solution, every=every)


class Trials:
    """Runs trials of a campaign's cells.

    Attributes:
      controller: of the last run; None before.
    """

    def __init__(self, campaign: Campaign, scenario: Scenario, solutions: Mapping[str, Solution]) -> None:
        self.campaign, self.scenario, self.solutions = campaign, scenario, solutions
        self.plant = scenario.plant()
        self.controller: Controller | None = None

    def run(self, cell: Cell, first: int, count: int = 1, *, frames: bool, contacts: bool) -> Rollout:
        """So many trials of a cell, from the first on."""
        self.controller = self._controller(cell.policy)
        return simulate(
            self.plant,
            self.solutions[cell.policy],
            controller=self.controller,
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
        """Have everything compiled, by an undisturbed trial."""
        solution = next(iter(self.solutions.values()))
        self.outcomes(simulate(self.plant, solution, frames=False, contacts=False, threads=1))

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

    def _controller(self, policy: str) -> Controller:
        return controller(policy, self.scenario, self.solutions[policy], self.campaign.replan_every)


def failed(first: int, count: int, reason: str) -> Table:
    """Rows of trials that came to nothing."""
    columns: Table = {column.name: np.full(count, np.nan) for column in fields(Outcomes)}
    columns |= {"trial": np.arange(first, first + count), "outcome": np.full(count, "error")}
    return columns | {"obstacle": np.full(count, ""), "reason": np.full(count, reason)}


def work(job: Job, shard: Shard) -> bytes:
    """The file of a shard, made in this process."""
    return pack(prepare(job).table(shard, job.batch), shard, job.digest)


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

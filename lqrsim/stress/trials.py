"""Running a campaign's trials: in this process, in another one, or on another machine, with the same results."""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller
from lqrsim.errors import format_error
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.stress.campaign_files import Table, pack
from lqrsim.stress.outcome_table import COLUMNS, outcomes
from lqrsim.stress.policies import POLICY_KINDS, make_controller
from lqrsim.stress.study import Campaign, Cell, Shard


class Trials:
    """Runs the trials of a campaign's cells, each policy with its solution."""

    def __init__(self, campaign: Campaign, solutions: Mapping[str, Solution]) -> None:
        self.campaign, self.solutions = campaign, solutions
        plan = next(iter(solutions.values()))  # all plans have the same duration
        self.scenario = campaign.resolved.with_duration_of(plan)
        self.plant = self.scenario.plant()
        self._controllers: dict[str | tuple[str, str, float], Controller | AffinePolicy] = {}

    def run(self, cell: Cell, first: int, count: int = 1, *, frames: bool, contacts: bool) -> Rollout:
        return simulate(
            self.plant,
            self.solutions[cell.policy],
            controller=self._controller(cell),
            disturbances=self.campaign.disturbances(cell),
            **self.campaign.goal_options,
            seed=self.campaign.seed,
            trials=count,
            first_trial=first,
            frames=frames,
            contacts=contacts,
            threads=1,
        )

    def warm_up(self) -> None:
        """Compile everything, by running undisturbed trials."""
        options: dict[str, Any] = {"frames": False, "contacts": False, "threads": 1}
        first = next(iter(self.solutions.values()))
        law = make_controller("feedback", self.scenario, first)
        outcomes(simulate(self.plant, first, controller=law, **options), self.scenario.problem)
        filters = [cell for cell in self.campaign.cells if POLICY_KINDS[cell.policy].controller == "offset_free"]
        for cell in filters[:1]:  # its filter is also compiled
            simulate(self.plant, self.solutions[cell.policy], controller=self._controller(cell), **options)

    def table(self, shard: Shard, batch: int) -> Table:
        """The rows of a shard, simulated in batches. If a batch fails, its trials are run again one by one."""
        cell = self.campaign.cells[shard.cell]
        last = shard.first + shard.count
        parts: list[Table] = []
        for first in range(shard.first, last, batch):
            count = min(batch, last - first)
            rows = self._rows(cell, first, count)
            alone = count > 1 and bool((rows["outcome"] == "error").any())
            parts += [self._rows(cell, trial, 1) for trial in range(first, first + count)] if alone else [rows]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _rows(self, cell: Cell, first: int, count: int) -> Table:
        try:
            rollout = self.run(cell, first, count, frames=False, contacts=False)
            table = outcomes(rollout, self.scenario.problem).columns()
        except Exception as error:  # a disturbance or a scenario may raise anything; it counts as failed trials
            return _failed_rows(first, count, format_error(error))
        reasons = np.array(rollout.reasons, dtype=np.str_)
        return table | {"reason": np.where(np.isin(table["outcome"], ("diverged", "error")), reasons, "")}

    def _controller(self, cell: Cell) -> Controller | AffinePolicy:
        """The controller of a cell, made once for its policy or for the cell, because its gains take time."""
        kind, design = POLICY_KINDS[cell.policy], self.campaign.design_disturbances
        key = (cell.policy, cell.sweep, cell.strength) if kind.per_cell else cell.policy
        if key not in self._controllers:
            self._controllers[key] = make_controller(
                kind.controller,
                self.scenario,
                self.solutions[cell.policy],
                design=self.campaign.disturbances(cell) if kind.per_cell else design,
                replan_every=self.campaign.replan_every,
            )
        return self._controllers[key]


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that a worker needs for a campaign."""

    campaign: Mapping[str, Any]  # as in its manifest
    digest: str  # of the manifest
    solutions: Mapping[str, Solution]  # by policy
    batch: int
    # An identifier that differs in every run, even of the same campaign.
    run: str = field(default_factory=lambda: f"lqrsim-{uuid.uuid4().hex}")

    @classmethod
    def of(cls, trials: Trials, manifest: Mapping[str, Any], batch: int) -> "Job":
        """The job of running these trials elsewhere. Its solutions lack the logs of their solves."""
        unused: dict[str, Any] = {"inverse_policy": None, "cost_to_come": None, "iterations": (), "candidates": ()}
        solutions = {policy: replace(solution, **unused) for policy, solution in trials.solutions.items()}
        return cls(manifest["campaign"], manifest["digest"], solutions, batch)

    def prepare(self) -> Trials:
        """The trials of this job, kept in this process until there is another job."""
        if self.run not in _prepared:
            _prepared.clear()
            campaign = Campaign.from_json(self.campaign, resolve(self.campaign["scenario"]))
            trials = Trials(campaign, self.solutions)
            trials.warm_up()
            _prepared[self.run] = trials
        return _prepared[self.run]

    def work(self, shard: Shard, trials: Trials | None = None) -> bytes:
        """Run a shard in this process, with these trials if given. Returns its file."""
        return pack((trials or self.prepare()).table(shard, self.batch), shard, self.digest)

    def failed(self, shard: Shard, reason: str) -> bytes:
        """The file of a shard that could not be run: each of its trials is an error with this reason."""
        return pack(_failed_rows(shard.first, shard.count, reason), shard, self.digest)


_prepared: dict[str, Trials] = {}  # trials of the last job that this process worked for


def _failed_rows(first: int, count: int, reason: str) -> Table:
    columns: Table = dict.fromkeys(COLUMNS, np.full(count, np.nan))
    columns |= {"trial": np.arange(first, first + count), "outcome": np.full(count, "error")}
    return columns | {"obstacle": np.full(count, ""), "reason": np.full(count, reason)}

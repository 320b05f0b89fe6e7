"""Running the trials of a campaign's cells."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller
from lqrsim.errors import format_error
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.simulation.closed_loop import simulate
from lqrsim.stress.analysis import COLUMNS, outcomes
from lqrsim.stress.campaign_files import Columns
from lqrsim.stress.policies import POLICY_KINDS, make_controller
from lqrsim.stress.study import Campaign, Cell, Shard


class Trials:
    """Runs the trials of a campaign's cells, each policy with its solution."""

    def __init__(self, campaign: Campaign, solutions: Mapping[str, Solution]) -> None:
        self.campaign, self.solutions = campaign, solutions
        plan = next(iter(solutions.values()))  # all plans have the same duration
        self.scenario = campaign.resolved.with_duration_of(plan)
        self.plant = self.scenario.plant()
        self._controllers: dict[Cell | str, Controller | AffinePolicy] = {}

    def run(self, cell: Cell, first: int, count: int = 1, *, frames: bool, contacts: bool) -> Rollout:
        campaign = self.campaign
        return simulate(
            self.plant, self.solutions[cell.policy], controller=self._controller(cell), threads=1,
            disturbances=campaign.disturbances(cell), **campaign.goal_options, seed=campaign.seed, trials=count,
            first_trial=first, frames=frames, contacts=contacts,
        )  # fmt: skip

    def warm_up(self) -> None:
        """Compile everything, by running undisturbed trials."""
        options: dict[str, Any] = {"frames": False, "contacts": False, "threads": 1}
        first = next(iter(self.solutions.values()))
        law = make_controller("feedback", self.scenario, first)
        outcomes(simulate(self.plant, first, controller=law, **options), self.scenario.problem)
        filters = [cell for cell in self.campaign.cells if POLICY_KINDS[cell.policy].controller == "offset_free"]
        for cell in filters[:1]:  # its filter is also compiled
            simulate(self.plant, self.solutions[cell.policy], controller=self._controller(cell), **options)

    def table(self, shard: Shard, batch: int) -> Columns:
        """The rows of a shard, simulated in batches. If a batch fails, its trials are run again one by one."""
        cell = self.campaign.cells[shard.cell_number]
        last = shard.first + shard.count
        parts: list[Columns] = []
        for first in range(shard.first, last, batch):
            count = min(batch, last - first)
            rows = self._rows(cell, first, count)
            alone = count > 1 and bool((rows["outcome"] == "error").any())
            parts += [self._rows(cell, trial, 1) for trial in range(first, first + count)] if alone else [rows]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _rows(self, cell: Cell, first: int, count: int) -> Columns:
        try:
            rollout = self.run(cell, first, count, frames=False, contacts=False)
            table = outcomes(rollout, self.scenario.problem).columns()
        except Exception as error:  # a disturbance or a scenario may raise anything; it counts as failed trials
            return failed_rows(first, count, format_error(error))
        reasons = np.array(rollout.reasons, dtype=np.str_)
        return table | {"reason": np.where(np.isin(table["outcome"], ("diverged", "error")), reasons, "")}

    def _controller(self, cell: Cell) -> Controller | AffinePolicy:
        """The controller of a cell, made once for its policy or for the cell, because its gains take time."""
        kind, campaign, solution = POLICY_KINDS[cell.policy], self.campaign, self.solutions[cell.policy]
        key = cell if kind.per_cell else cell.policy
        if key not in self._controllers:
            design = campaign.disturbances(cell) if kind.per_cell else campaign.design_disturbances
            self._controllers[key] = make_controller(
                kind.controller, self.scenario, solution, design=design, replan_every=campaign.replan_every
            )
        return self._controllers[key]


def failed_rows(first: int, count: int, reason: str) -> Columns:
    """The rows of trials that could not be run: errors with this reason."""
    columns: Columns = dict.fromkeys(COLUMNS, np.full(count, np.nan))
    columns |= {"trial": np.arange(first, first + count), "outcome": np.full(count, "error")}
    return columns | {"obstacle": np.full(count, ""), "reason": np.full(count, reason)}

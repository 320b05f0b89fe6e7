"""The tables of a report: breaking strengths, comparisons, failures, measures, and the worst trials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from lqrsim.results.coordinates import Coordinates
from lqrsim.results.goal import Target, tracking_unit
from lqrsim.scenarios.packaged import Scenario
from lqrsim.stress import analysis
from lqrsim.stress.outcome_table import OUTCOMES
from lqrsim.stress.specification import Cell
from lqrsim.stress.statistics import Estimate

BROKEN_BELOW = 0.95  # success rate below which a policy counts as broken
WORST_EACH = 3  # trials that are listed for each policy and sweep


@dataclass(frozen=True)
class PageTable:
    """A table of the page."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def state_coordinates(scenario: Scenario) -> Coordinates:
    """The coordinates of the planned states."""
    return scenario.problem.dynamics.state_coordinates


def policies(table: analysis.Table) -> list[str]:
    """The names of the policies, in the order of the campaign."""
    return list(dict.fromkeys(cell.policy for cell in table))


def breaks_table(table: analysis.Table) -> PageTable:
    """The strength at which each policy breaks in each sweep."""
    rows = [
        [
            one.policy, one.sweep, "not at any" if one.strength is None else f"{one.strength:g}",
            "" if one.success is None else _percent(one.success),
        ]
        for one in analysis.breaks(table, below=BROKEN_BELOW)
    ]  # fmt: skip
    return PageTable("Where policies break", ("policy", "sweep", "at strength", "success there"), rows)


def _percent(one: Estimate, scale: float = 100.0, unit: str = " %") -> str:
    """A share with its interval, if that has a width."""
    if one.low == one.high:
        return f"{scale * one.value:.1f}{unit}"
    return f"{scale * one.value:.1f} ({scale * one.low:.1f} to {scale * one.high:.1f}){unit}"


def comparison_tables(table: analysis.Table, unit: str) -> list[PageTable]:
    """Pairs of policies on the same trials, a table for each pair and sweep; `unit` is that of tracking errors."""
    found = analysis.comparisons(table)
    factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
    head = (
        "strength", "only the first", "only the second", "p", "difference in success (%)", "both reached",
        f"difference in rms ({unit})",
    )  # fmt: skip
    groups = dict.fromkeys((one.first.sweep, one.first.policy, one.second.policy) for one in found)
    return [
        PageTable(
            f"{sweep}: {first} against {second}",
            head,
            [
                [
                    f"{one.first.strength:g}", str(one.pairs.only_first), str(one.pairs.only_second),
                    f"{one.adjusted:.2g}", _percent(one.success, unit=""), str(one.both),
                    "" if one.rms is None else _between(one.rms.value, one.rms.low, one.rms.high, factor),
                ]
                for one in found
                if (one.first.sweep, one.first.policy, one.second.policy) == (sweep, first, second)
            ],
        )
        for sweep, first, second in groups
    ]  # fmt: skip


def _between(value: float, low: float, high: float, scale: float = 1.0) -> str:
    if not np.isfinite(value):
        return "none" if np.isnan(value) else "infinite"
    return f"{scale * value:.3g}" if low == high else f"{scale * value:.3g} ({scale * low:.3g} to {scale * high:.3g})"


def failure_table(table: analysis.Table) -> PageTable:
    """The numbers of failures of each kind in each cell, and the obstacles that were hit."""
    kinds = [outcome for outcome in OUTCOMES if outcome != "reached"]
    rows = []
    for cell, outcomes in table.items():
        modes = analysis.modes(outcomes)
        counts = [sum(n for (outcome, _), n in modes.items() if outcome == kind) for kind in kinds]
        hit = [f"{obstacle} {count}" for (_, obstacle), count in modes.items() if obstacle]
        more = f", and {len(hit) - 4} more" if len(hit) > 4 else ""
        if modes:
            rows.append([*_cell_names(cell), str(len(outcomes)), *map(str, counts), ", ".join(hit[:4]) + more])
    head = ("policy", "sweep", "strength", "trials", *kinds, "collided with")
    return PageTable("Failures by how they ended, and the obstacles that were hit most", head, rows)


def _cell_names(cell: Cell) -> list[str]:
    return [cell.policy, cell.sweep, f"{cell.strength:g}"]


def measure_tables(table: analysis.Table, scenario: Scenario) -> list[PageTable]:
    """Quantiles of all measures, a table for each sweep."""
    units = dict(analysis.MEASURES)
    of_controls = set(scenario.robot.dynamics.control_coordinates.units)
    if len(of_controls) == 1:
        unit = of_controls.pop()
        units["effort"] = f"{unit}² s" if unit.isalpha() else f"({unit})² s"
    units["saturated"] = "share of periods"
    space = state_coordinates(scenario)
    units |= dict.fromkeys(("worst", "rms", "final"), tracking_unit(space))
    units["goal"] = Target(space, scenario.problem.weighed_goal, np.zeros((1, len(space)))).unit
    head = ["policy", "strength", *(f"{name} ({unit})" if unit else name for name, unit in units.items())]
    tables = []
    for sweep in dict.fromkeys(cell.sweep for cell in table):
        rows = []
        for cell, outcomes in table.items():
            if cell.sweep == sweep:
                quantiles = [analysis.quantiles(outcomes, name) for name in units]
                values = [_between(middle, low, high) for low, middle, high in quantiles]
                rows.append([cell.policy, f"{cell.strength:g}", *values])
        tables.append(PageTable(sweep, head, rows))
    return tables


def policies_and_sweeps(table: analysis.Table) -> list[tuple[str, str]]:
    """Policies and sweeps by breaking strength, alternating between policies."""
    order = [(one.policy, one.sweep) for one in analysis.breaks(table, below=BROKEN_BELOW)]
    turns = zip_longest(*([group for group in order if group[0] == policy] for policy in policies(table)))
    return [group for turn in turns for group in turn if group is not None]


def worst_trials(table: analysis.Table, group: tuple[str, str]) -> list[analysis.Trial]:
    """The worst trials of a policy and a sweep, the worst first."""
    return analysis.worst({cell: one for cell, one in table.items() if (cell.policy, cell.sweep) == group}, WORST_EACH)


def worst_table(table: analysis.Table, unit: str) -> PageTable:
    """The worst trials of each policy and sweep; `unit` is that of tracking errors."""
    rows = [
        [
            *_cell_names(one.cell), str(one.trial), one.outcome, one.obstacle, f"{one.ended:.2f}",
            f"{one.clearance:.3f}", f"{one.worst:.3f}",
        ]
        for group in policies_and_sweeps(table)
        for one in worst_trials(table, group)
    ]  # fmt: skip
    head = (
        "policy", "sweep", "strength", "trial", "outcome", "collided with", "ended (s)", "least clearance (m)",
        f"largest error ({unit})",
    )  # fmt: skip
    return PageTable("Worst trials", head, rows)


def success_table(sweep: str, curves: Mapping[str, Sequence[analysis.Success]]) -> PageTable:
    """The numbers of trials of each policy that reached the goal, a row for each strength."""
    points = [point for of_policy in curves.values() for point in of_policy]
    strengths = sorted({point.cell.strength for point in points})
    of_cell = {(point.cell.policy, point.cell.strength): point for point in points}
    rows = [[f"{s:g}", *(_share(of_cell.get((policy, s))) for policy in curves)] for s in strengths]
    return PageTable(f"{sweep}: trials that reached their goal", ("strength", *curves), rows)


def _share(point: analysis.Success | None) -> str:
    if point is None:
        return "not run"
    count = f"{point.reached}/{point.trials}"
    return f"{count}, deterministic: 1 run" if point.alike else f"{count}, {_percent(point.exact)}"

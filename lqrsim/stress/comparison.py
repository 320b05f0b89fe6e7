"""Comparison of two campaigns, or of two policies, cell by cell."""

import os
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from lqrsim.annotations import Want, checked
from lqrsim.errors import InputError, check_name, excerpt, printable
from lqrsim.stress.analysis import Comparison, compared
from lqrsim.stress.data_table import DataTable, Entry, fraction_format
from lqrsim.stress.results import Results
from lqrsim.stress.statistics import CONFIDENCE
from lqrsim.stress.study import Cell

# What may differ between two campaigns that are compared: settings, and other fields of the manifest.
_SETTINGS = ("scenario", "replan_every", "design_disturbances")
_FIELDS = ("model", "problem", "start", "solution", "code", "versions")
# The methods, by whether trials are compared one by one.
_METHOD = {
    True: "Tango's score interval for paired proportions; p: McNemar's exact test",
    False: "Newcombe's hybrid score interval for independent proportions; p: Fisher's exact test",
}


@checked
def compare(
    first: Results | str | os.PathLike[str],
    second: Results | str | os.PathLike[str] | None = None,
    *,
    policies: Annotated[Sequence[str], Want("two policies")] | None = None,
) -> DataTable:
    """Compare the success rates of two campaigns, or of two policies, in each cell that both have.

    Two campaigns with the same seed have the same random numbers, and are compared trial by trial, over the trials that
    both have: the difference has Tango's score interval for paired proportions, p is of McNemar's exact test. With
    different seeds the difference has Newcombe's hybrid score interval for independent proportions, and p is of
    Fisher's exact test. Where nothing is drawn each cell is one run: the difference has no interval and no p.

    Args:
      first: a campaign, or its folder.
      second: another campaign, whose sweeps of the same names have the same disturbances, and whose goals have the same
        options; by default the first.
      policies: the policy of the first and the policy of the second; by default each policy with that of the same name.

    Returns:
      A table with a row for each cell: sweep, strength and policy; trials; first success and second success, the rates;
      only first and only second, the trials in which only this one reached the goal; difference, first minus second,
      with low and high; p, adjusted for the number of rows (Holm, 1979). With different seeds, first trials and second
      trials take the place of trials, only first and only second. Failure rates differ by as much, the other way round.
    """
    one = first if isinstance(first, Results) else Results(first)
    other = one if second is None else second if isinstance(second, Results) else Results(second)
    chosen = policies or ()
    if len(chosen) != 2 and (second is None or policies is not None):
        raise InputError(f"policies: got {excerpt(policies)}, want two policies, or another campaign to compare with")
    for policy, results in zip(chosen, (one, other), strict=False):
        check_name("policies", policy, results.manifest["campaign"]["policies"])
    matches = (
        (cell, Cell(chosen[1] if chosen else cell.policy, cell.sweep, cell.strength))
        for cell in one.cells
        if not chosen or cell.policy == chosen[0]
    )
    pairs = [pair for pair in matches if pair[1] in other.cells]
    if not pairs:
        raise InputError(f"second: got cells from {other.cells[0]} to {other.cells[-1]}, want some of the first's")
    campaigns = one.manifest["campaign"], other.manifest["campaign"]
    for sweep in dict.fromkeys(cell.sweep for cell, _ in pairs):
        if campaigns[0]["sweeps"][sweep] != campaigns[1]["sweeps"][sweep]:
            raise InputError(f"second: got other disturbances in the sweep {excerpt(sweep)}, want those of the first")
    for name in ("goal_radius", "goal_tolerance"):
        if campaigns[0][name] != campaigns[1][name]:
            raise InputError(f"second: {name}: got {campaigns[1][name]}, want {campaigns[0][name]}, as the first has")
    paired = campaigns[0]["seed"] == campaigns[1]["seed"]
    trials = [campaign["trials"] for campaign in campaigns]
    counts = [min(trials)] * 2 if paired else trials
    firsts, seconds = (
        {pair[side]: results.outcomes(pair[side]).first(counts[side]) for pair in pairs}
        for side, results in enumerate((one, other))
    )
    comparisons = compared(pairs, firsts, seconds, paired=paired)
    method = f"difference: first minus second; low, high: {100 * CONFIDENCE:g} % by {_METHOD[paired]}, adjusted (Holm)"
    notes, fractions = [*_notes(one, other, chosen), method], fraction_format(max(counts))
    return _table(comparisons, notes, paired=paired, fractions=fractions)


def _notes(first: Results, second: Results, policies: Sequence[str]) -> list[str]:
    """Lines that say what is compared, and in what else the two differ."""
    of = [f"{policy} of " for policy in policies] or ["", ""]
    notes = [f"first: {of[0]}{first.folder}; second: {of[1]}{second.folder}"]
    one, other = first.manifest, second.manifest
    differ = [name for name in _SETTINGS if one["campaign"][name] != other["campaign"][name]]
    differ += [name for name in _FIELDS if one[name] != other[name]]
    return [printable(note) for note in [*notes, *([f"they differ in {', '.join(differ)}"] if differ else [])]]


def _table(pairs: Sequence[Comparison], notes: Sequence[str], *, paired: bool, fractions: str) -> DataTable:
    """The table of `compare`, with the format of its fractions."""
    rows = list[dict[str, Entry]]()
    for pair in pairs:
        first, second = pair.rates
        tested = not np.isnan(pair.p_value)
        trials: dict[str, Entry] = {"first trials": first.trials, "second trials": second.trials}
        apart: dict[str, Entry] = {}
        if paired:
            trials, apart = {"trials": first.trials}, {"only first": pair.only_first, "only second": pair.only_second}
        rows.append({
            "sweep": pair.first.sweep, "strength": pair.first.strength,
            "policy": " against ".join(dict.fromkeys((pair.first.policy, pair.second.policy))), **trials,
            "first success": first.exact.value, "second success": second.exact.value, **apart,
            "difference": pair.success.value, "low": pair.success.low if tested else None,
            "high": pair.success.high if tested else None, "p": pair.adjusted if tested else None,
        })  # fmt: skip
    formats = dict.fromkeys(("first success", "second success", "difference", "low", "high"), fractions)
    return DataTable({name: [row[name] for row in rows] for name in rows[0]}, formats | {"p": ".2g"}, notes)

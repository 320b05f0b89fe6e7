"""The folder of a campaign, finished or not: its manifest, the tables of its trials, trials run again, and comparisons.

A table is a parquet file with the columns of `Outcomes`, and `reason`, the cause of an error. It is written whole or
not at all. Its metadata names the campaign, the cell and the trials, and contains a hash of these and of the columns.

`manifest.json` contains specification, versions and hashes. `sha256` covers the whole file, so that an edited file is
refused. `digest` covers everything that the rows depend on. It is also in each shard, so that a manifest with new
settings and a renewed hash does not fit the shards.
"""

import io
import json
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from lqrsim.annotations import LINE, Count, Index, Line, Want, checked
from lqrsim.errors import LONGEST, InputError, check_name, check_path, excerpt, printable
from lqrsim.results import save_load
from lqrsim.results.archive import Other, blamed, canonical, parse, replacing, sha256
from lqrsim.results.display import DataTable, Entry, fraction_format
from lqrsim.results.goal import OUTCOMES
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.references import from_anywhere, names_code, resolve
from lqrsim.scenarios.solutions import digest_of_solution
from lqrsim.simulation.disturbances import PRESETS
from lqrsim.stress import analysis
from lqrsim.stress.analysis import COLUMNS, Outcomes, outcomes
from lqrsim.stress.statistics import CONFIDENCE
from lqrsim.stress.study import CAMPAIGN_FIELDS, DEFAULT_DESIGN, POLICY_KINDS, Campaign, Cell, Shard, TrialRunner

Columns = dict[str, npt.NDArray[np.generic]]  # of the table of a shard, by name
_KEY = b"lqrsim shard"
_TEXTS = "outcome", "obstacle", "reason"
_TYPES = dict.fromkeys((*COLUMNS, "reason"), pa.float64()) | {"trial": pa.int64()} | dict.fromkeys(_TEXTS, pa.string())
_MAGIC = b"PAR1"  # of parquet; its footer has values of these kinds
_DEEPEST = 21  # values within each other; a footer has fewer
_BOOLEANS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _LISTS, _MAP, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, (9, 10), 11, 12
FORMAT, VERSION, MANIFEST = "lqrsim campaign", 8, "manifest.json"
SOLUTION_FILE = "solution.npz"  # the solution that was given instead of solving; the manifest has its hash
_LARGEST, _LARGEST_TABLE = 1 << 26, 1 << 29  # bytes, largest manifest and table
MOST_REASONS = 5  # largest number of reasons in a summary
# What may differ between two campaigns that are compared: settings, and other fields of the manifest.
_SETTINGS = ("scenario", "replan_every", "design_disturbances")
_FIELDS = ("model", "problem", "start", "solution", "code", "versions")
# The methods, by whether trials are compared one by one.
_METHOD = {
    True: "Tango's score interval for paired proportions; p: McNemar's exact test",
    False: "Newcombe's hybrid score interval for independent proportions; p: Fisher's exact test",
}


@dataclass(frozen=True)
class CellSummary:
    """What the shards on disk say of a cell's trials: small, unlike their rows, so that it is kept in memory."""

    shards: list[Shard]
    tally: Counter[str]  # the number of trials of each outcome
    reasons: Counter[str]  # the number of trials that each reason stopped
    success: analysis.Success | None  # None if no trial has been run


class Results:
    """The folder of a campaign, finished or not.

    Args:
      scenario: the campaign's reference, needed if the scenario is your own function: files never choose code to run.
    """

    _prefix = ""

    @checked
    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        scenario: Annotated[str, Want("the campaign's reference"), 10 * LINE] | None = None,
    ) -> None:
        self.folder = check_path("folder", folder, "the path of a campaign's folder")
        self.manifest = read_manifest(self.folder)
        self.cells = self.manifest.settings.cells
        self._scenario = scenario
        self._summaries, self._solutions = dict[Cell, CellSummary](), dict[str, Solution]()
        reference = self.manifest.settings.scenario
        if scenario is not None:
            named, known = (os.path.normpath(from_anywhere(text)) for text in (scenario, reference))
            if named != known:
                raise InputError(f"scenario: got {excerpt(scenario)}, want {reference}, which {self.folder} was run on")

    @cached_property
    def campaign(self) -> Campaign:
        """The campaign. Raises InputError if its scenario is your own function, and no scenario was given."""
        scenario = resolve(self.manifest.settings.scenario, registered_only=self._scenario is None)
        given = None if self.manifest.solution is None else self.folder / SOLUTION_FILE
        return Campaign.from_json(self.manifest.campaign, scenario, given)

    @cached_property
    def runner(self) -> TrialRunner:
        """Runs the campaign's trials. Raises InputError as `campaign` does, or if a policy is damaged."""
        return TrialRunner(self.campaign, {policy: self.solution(policy) for policy in self.campaign.policies})

    @property
    def complete(self) -> bool:
        return not self.missing

    @property
    def missing(self) -> list[tuple[Cell, int, int]]:
        """The trials that have not been run: cell, first trial, count."""
        on_disk = self.shards_on_disk()
        missing = (shard for shard in self.shards() if shard not in on_disk)
        return [(self.cells[shard.cell_number], shard.first, shard.count) for shard in missing]

    @checked
    def outcomes(self, cell: Cell, *, partial: bool = False) -> Outcomes:
        """The outcomes of a cell's trials, in order; with `partial` also if the cell is not finished."""
        if not (shards := self._to_read(cell, partial)):
            raise InputError(f"cell: got {cell}, of which no trial has been run, want one that was begun")
        found, self._summaries[cell] = self._read(cell, shards)
        return found

    def _read(self, cell: Cell, shards: list[Shard]) -> tuple[Outcomes, CellSummary]:
        """The outcomes in these shards of a cell, and their summary."""
        tables = [self.table(shard) for shard in shards]
        columns: dict[str, Any] = {name: np.concatenate([table[name] for table in tables]) for name in COLUMNS}
        deterministic = not cell.strength or [cell.sweep, cell.strength] in self.manifest.deterministic
        found = Outcomes(**columns, deterministic=deterministic)
        reasons = Counter(reason for table in tables for reason in table["reason"].tolist() if reason)
        return found, CellSummary(shards, Counter(found.outcome.tolist()), reasons, found.success)

    def cell_summaries(self) -> dict[Cell, CellSummary]:
        """The summary of each cell. Shards never change, so they are read again only if there are others."""
        for cell in self.cells:
            if not (shards := self._to_read(cell, partial=True)):
                self._summaries[cell] = CellSummary([], Counter(), Counter(), None)
            elif cell not in self._summaries or self._summaries[cell].shards != shards:
                self._summaries[cell] = self._read(cell, shards)[1]
        return {cell: self._summaries[cell] for cell in self.cells}

    def summary(self) -> str:
        """A line per cell with success rate, interval and outcomes; then where the plans end, and errors."""
        sweep_width = max(len(name) for name in ["sweep", *self.manifest.settings.sweeps])
        policy_width = max(10, *(len(policy) for policy in self.manifest.policies))
        others = [name for name in OUTCOMES if name != "reached"]
        interval = f"reached, {100 * CONFIDENCE:g} % interval"
        head = f"{'sweep':<{sweep_width}} {'strength':>8} {'policy':<{policy_width}} {interval:>33}"
        lines = [head + "".join(f" {name:>9}" for name in others)]
        for cell, so_far in self.cell_summaries().items():
            if (success := so_far.success) is None:
                continue
            exact, reached = success.exact, f"{success.reached}/{success.trials}"
            rate = f"{100 * exact.value:5.1f} [{100 * exact.low:5.1f}, {100 * exact.high:5.1f}]"
            rate = f"{reached:>13} {'deterministic: 1 run' if success.alike else rate}"
            line = f"{cell.sweep:<{sweep_width}} {cell.strength:>8g} {cell.policy:<{policy_width}} {rate:>33}"
            lines.append(line + "".join(f" {so_far.tally[name]:>9}" for name in others))
        lines += [self.manifest.left_out] if self.manifest.left_out else []
        designs = (f"{policy}: {text}" for policy, text in self.designs().items())
        lines += [*self.manifest.remarks, *designs, *self.plans(), *self.stop_reasons(), *self.hints()]
        return "\n".join(lines)

    def rates(self) -> DataTable:
        """The success rate of each cell so far as a table: for CSV, LaTeX or Markdown.

        It has the columns sweep, strength, policy, trials, a count of each outcome, and success, low and high: the
        fraction of trials that reached their goal, with its exact interval. A cell without trials has no rate, and
        one in which nothing is drawn has no interval, because all of its trials are one run.
        """
        head = ("sweep", "strength", "policy", "trials", *OUTCOMES, "success", "low", "high")
        rows: list[tuple[Any, ...]] = []
        for cell, so_far in self.cell_summaries().items():
            rate = (None, None, None)
            if (success := so_far.success) is not None:
                interval = (None, None) if success.alike else (success.exact.low, success.exact.high)
                rate = (success.exact.value, *interval)
            counts = (so_far.tally.total(), *(so_far.tally[name] for name in OUTCOMES))
            rows.append((cell.sweep, cell.strength, cell.policy, *counts, *rate))
        settings = self.manifest.settings
        notes = [
            f"{settings.scenario}, seed {settings.seed}; success: the fraction of trials that reached the goal",
            f"low, high: exact (Clopper-Pearson) interval of {100 * CONFIDENCE:g} %; none if all trials are one run",
            *(f"{policy}: {text}" for policy, text in self.designs().items()),
        ]
        if missing := sum(count for _, _, count in self.missing):
            notes.append(f"not finished: {missing} of {settings.trials * len(self.cells)} trials are missing")
        formats: dict[str, str] = dict.fromkeys(("success", "low", "high"), fraction_format(settings.trials))
        return DataTable(dict(zip(head, zip(*rows, strict=True), strict=True)), formats, notes)

    def _repr_html_(self) -> str:
        return self.rates()._repr_html_()

    def designs(self) -> dict[str, str]:
        """The disturbances for which each policy was designed, in words. Policies designed for none are left out."""
        stated, designs = self.manifest.campaign["design_disturbances"], dict[str, str]()
        disturbances = f"the preset {DEFAULT_DESIGN}"
        if stated is not None:  # as it is written in Python
            settings = (", ".join(f"{name}={value}" for name, value in item["settings"].items()) for item in stated)
            disturbances = ", ".join(f"{item['kind']}({text})" for item, text in zip(stated, settings, strict=True))
        for policy in self.manifest.policies:
            kind = POLICY_KINDS[policy]
            if kind.designed:
                designs[policy] = f"designed for {disturbances}, whatever the disturbances of a cell"
            elif kind.per_cell:
                designs[policy] = "designed anew for the disturbances of each cell, at their strength"
        return designs

    def stop_reasons(self) -> list[str]:
        """A line for each of the most frequent reasons of trials that ended with an error or diverged."""
        reasons: Counter[str] = Counter()
        for so_far in self.cell_summaries().values():
            reasons.update(so_far.reasons)
        return [f"{count} trials were stopped: {reason}" for reason, count in reasons.most_common(MOST_REASONS)]

    def hints(self) -> list[str]:
        """A line for each preset under which no trial reached the goal: a way to find the responsible disturbance.

        Trials that ended with an error do not count.
        """
        reached: Counter[str] = Counter()
        for cell, so_far in self.cell_summaries().items():
            if cell.strength > 0 and so_far.tally["error"] < so_far.tally.total():
                reached[cell.sweep] += so_far.tally["reached"]
        sweeps = self.manifest.campaign["sweeps"]
        kinds = {name: [f"{name}:{item['kind']}" for item in sweeps[name]] for name in reached if name in PRESETS}
        return [
            f"{name}: no trial reached the goal; each kind of disturbance alone: --sweep {' '.join(kinds[name])}"
            for name in kinds
            if not reached[name]
        ]

    def plans(self) -> list[str]:
        """Lines that say where the plan of each policy ends, and whether it misses the goal."""
        return [
            f"{policy}: {line}"
            for policy in self.manifest.policies
            for line in self.solution(policy).target.of_plan(self.goal_radius(policy))
        ]

    def goal_radius(self, policy: str) -> float | None:
        """The distance within which the goal of a policy's plan counts as reached, in `Target.unit`."""
        settings, solution = self.manifest.settings, self.solution(policy)
        goal = settings.goal_radius, settings.goal_tolerance
        return solution.goal_radius if goal == (None, None) else solution.target.radius(None, *goal)

    def reasons(self, cell: Cell) -> dict[int, str]:
        """The reasons of a cell's trials that ended with an error or diverged, by number of the trial."""
        return {
            int(trial): str(reason)
            for table in map(self.table, self._to_read(cell, partial=True))
            for trial, reason in zip(table["trial"], table["reason"], strict=True)
            if reason
        }

    def solution(self, policy: str) -> Solution:
        """The solution that a policy runs, read once."""
        if check_name("policy", policy, self.manifest.policies) in self._solutions:
            return self._solutions[policy]
        path = self.folder / "policies" / f"{policy}.npz"
        hashes, solution = self.manifest.policies[policy], save_load.load(path, Solution)
        if sha256(path.read_bytes()) != hashes["sha256"] or digest_of_solution(solution) != hashes["digest"]:
            raise InputError(f"policy: got {path}, which is damaged, want another folder for the campaign")
        return self._solutions.setdefault(policy, solution)

    def shards(self, cell: Cell | None = None) -> Iterator[Shard]:
        """The shards of a cell; by default of all cells."""
        trials, size = self.manifest.settings.trials, self.manifest.settings.shard
        for number in range(len(self.cells)) if cell is None else [self.number(cell)]:
            for first in range(0, trials, size):
                yield Shard(number, first, min(size, trials - first))

    def shards_on_disk(self) -> set[Shard]:
        folder = self.folder / "shards"
        names = set(os.listdir(folder)) if os.path.isdir(folder) else set()
        return {shard for shard in self.shards() if shard.file in names}

    @checked
    def number(self, cell: Cell) -> int:
        """The index of a cell among `cells`."""
        if cell not in self.cells:
            first, last = self.cells[0], self.cells[-1]
            raise InputError(f"cell: got {cell}, want one of the {len(self.cells)}, from {first} to {last}")
        return self.cells.index(cell)

    @checked
    def path(self, shard: Shard) -> Path:
        """The path of a shard's file."""
        if shard.cell_number > (last := len(self.cells) - 1):
            raise InputError(f"shard: cell: got {shard.cell_number}, want a whole number from 0 to {last}")
        return self.folder / "shards" / shard.file

    def _to_read(self, cell: Cell, partial: bool) -> list[Shard]:
        return [shard for shard in self.shards(cell) if not partial or self.path(shard).is_file()]

    def table(self, shard: Shard) -> Columns:
        """The rows of a shard."""
        path = self.path(shard)
        if not path.is_file():
            trials = f"{shard.first} to {shard.first + shard.count - 1}"
            raise InputError(f"cell: got {self.cells[shard.cell_number]} without trials {trials}, run: {self.command}")
        try:
            return read_table(path, shard, self.manifest.digest)
        except Damaged as error:
            raise InputError(f"shard: got {path}, which is damaged ({error}), run: {self.command}") from None

    @property
    def command(self) -> str:
        """The command line that resumes the campaign and repairs damaged files. It runs in any working directory."""
        reference = self.manifest.settings.scenario
        return shlex.join(["lqrsim", "stress", reference, "--resume", "--out", str(self.folder.absolute())])

    @checked
    def command_of(self, command: Literal["report", "replay"], *options: str) -> str:
        """The command line of `lqrsim report` or `lqrsim replay` for this campaign, in any working directory."""
        reference = self.manifest.settings.scenario
        code = ["--scenario", reference] if names_code(reference) else []
        return shlex.join(["lqrsim", command, str(self.folder.absolute()), *options, *code])


@checked
def replay(
    results: Results | str | os.PathLike[str],
    cell: Cell,
    trial: Index,
    *,
    trials: Count = 1,
    frames: bool = True,
    contacts: bool = True,
) -> Rollout:
    """Run trials of a campaign again: bit-identical until they end.

    It needs the kind of processor and the versions in `results.manifest.versions`.

    Args:
      frames: whether to record what pictures need.
      contacts: whether obstacles stop the robot. Without, as in the campaign, it is identical until the plan ends.
    """
    results = results if isinstance(results, Results) else Results(results)
    results.number(cell)  # raises InputError unless the campaign has it
    last = results.manifest.settings.trials - 1
    if trial + trials - 1 > last:
        raise InputError(f"trial: got {trial} to {trial + trials - 1}, want numbers up to {last}")
    return results.runner.run(cell, trial, trials, frames=frames, contacts=contacts)


def differences(results: Results, cell: Cell, trial: int, again: Rollout) -> list[str]:
    """A line for each value of a replayed trial that differs from its row in the table.

    A row describes the time until the trial ended, so it does not matter whether obstacles then stopped the robot.
    """
    shard = next(shard for shard in results.shards(cell) if trial < shard.first + shard.count)
    was = {name: column[trial - shard.first] for name, column in results.table(shard).items()}
    now = outcomes(again, results.runner.scenario.problem).columns()
    return [
        f"{name}: {value[0]} (in the table: {was[name]})"
        for name, value in now.items()
        if value[0].tobytes() != was[name].tobytes()
    ]


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
      second: another campaign, whose sweeps of the same names have the same disturbances, and whose goals have the same
        options; by default the first.
      policies: the policy of the first and the policy of the second; by default each policy with that of the same name.

    Returns:
      A table with a row for each cell: sweep, strength and policy; trials; first success and second success, the rates;
      only first and only second, the trials in which only this one reached the goal; difference, first minus second,
      with low and high; p, adjusted for the number of rows (Holm, 1979). With different seeds, first trials and second
      trials take the place of trials, only first and only second. Failure rates differ by as much, the other way round.
    """
    campaigns = [first] if second is None else [first, second]
    opened = [campaign if isinstance(campaign, Results) else Results(campaign) for campaign in campaigns]
    results, chosen = (opened[0], opened[-1]), policies or ()
    manifests = [campaign.manifest for campaign in results]
    settings = [manifest.settings for manifest in manifests]
    if len(chosen) != 2 and (second is None or policies is not None):
        raise InputError(f"policies: got {excerpt(policies)}, want two policies, or another campaign to compare with")
    for policy, campaign in zip(chosen, settings, strict=False):
        check_name("policies", policy, campaign.policies)
    matches = (
        (cell, Cell(chosen[1] if chosen else cell.policy, cell.sweep, cell.strength))
        for cell in results[0].cells
        if not chosen or cell.policy == chosen[0]
    )
    pairs = [pair for pair in matches if pair[1] in results[1].cells]
    if not pairs:
        cells = results[1].cells
        raise InputError(f"second: got cells from {cells[0]} to {cells[-1]}, want some of the first's")
    for sweep in dict.fromkeys(cell.sweep for cell, _ in pairs):
        if manifests[0].campaign["sweeps"][sweep] != manifests[1].campaign["sweeps"][sweep]:
            raise InputError(f"second: got other disturbances in the sweep {excerpt(sweep)}, want those of the first")
    for name in ("goal_radius", "goal_tolerance"):
        want, got = (getattr(campaign, name) for campaign in settings)
        if got != want:
            raise InputError(f"second: {name}: got {got}, want {want}, as the first has")
    paired = settings[0].seed == settings[1].seed
    trials = [campaign.trials for campaign in settings]
    counts = [min(trials)] * 2 if paired else trials
    firsts = {cell: results[0].outcomes(cell).first(counts[0]) for cell, _ in pairs}
    seconds = {cell: results[1].outcomes(cell).first(counts[1]) for _, cell in pairs}
    comparisons = analysis.compare_cells(pairs, firsts, seconds, paired=paired)
    prefixes = [f"{policy} of " for policy in chosen] or ["", ""]
    notes = [f"first: {prefixes[0]}{results[0].folder}; second: {prefixes[1]}{results[1].folder}"]
    differ = [name for name in _SETTINGS if manifests[0].campaign[name] != manifests[1].campaign[name]]
    differ += [name for name in _FIELDS if getattr(manifests[0], name) != getattr(manifests[1], name)]
    notes += [f"they differ in {', '.join(differ)}"] if differ else []
    method = f"difference: first minus second; low, high: {100 * CONFIDENCE:g} % by {_METHOD[paired]}, adjusted (Holm)"
    notes = [*map(printable, notes), method]
    return _table(comparisons, notes, paired=paired, fractions=fraction_format(max(counts)))


def _table(pairs: Sequence[analysis.Comparison], notes: Sequence[str], *, paired: bool, fractions: str) -> DataTable:
    """The table of `compare`, with the format of its fractions."""
    rows = list[dict[str, Entry]]()
    for pair in pairs:
        first, second = pair.rates
        tested = not np.isnan(pair.p_value)
        trials = {"trials": first.trials} if paired else {"first trials": first.trials, "second trials": second.trials}
        disagreements = {"only first": pair.only_first, "only second": pair.only_second} if paired else {}
        rows.append({
            "sweep": pair.first.sweep, "strength": pair.first.strength,
            "policy": " against ".join(dict.fromkeys((pair.first.policy, pair.second.policy))), **trials,
            "first success": first.exact.value, "second success": second.exact.value, **disagreements,
            "difference": pair.success.value, "low": pair.success.low if tested else None,
            "high": pair.success.high if tested else None, "p": pair.adjusted if tested else None,
        })  # fmt: skip
    formats = dict.fromkeys(("first success", "second success", "difference", "low", "high"), fractions)
    return DataTable({name: [row[name] for row in rows] for name in rows[0]}, formats | {"p": ".2g"}, notes)


@checked
@dataclass(frozen=True)
class Manifest:
    """What the manifest says."""

    format: Line
    version: int
    campaign: Mapping[str, Any]  # from `Campaign.as_json`
    model: Line
    problem: Line
    start: Line | None
    solution: Line | None
    code: Mapping[str, Line | None]
    policies: Mapping[str, Mapping[str, Line]]
    cells: Any
    deterministic: Any
    versions: Mapping[str, Line]
    digest: Line
    machine: Line
    left_out: Line
    remarks: tuple[Line, ...]
    sha256: Line

    @cached_property
    def settings(self) -> Campaign:
        """The campaign without disturbances: they may be a user's, and the user's file is not loaded here."""
        sweeps = dict.fromkeys(self.campaign["sweeps"], ())
        return Campaign(**{**self.campaign, "sweeps": sweeps, "design_disturbances": None})

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> "Manifest":
        """The manifest of a JSON object. Raises InputError unless all fields are valid and the hashes fit."""
        _check_names("manifest", said, [field.name for field in fields(cls)])
        manifest = cls(**said)
        if manifest.sha256 != sha256(canonical({name: value for name, value in said.items() if name != "sha256"})):
            raise InputError("sha256: got a hash that does not fit the content, want an unchanged file")
        _check_names("campaign", manifest.campaign, CAMPAIGN_FIELDS)
        cells = [[cell.policy, cell.sweep, cell.strength] for cell in manifest.settings.cells]
        if canonical(manifest.cells) != canonical(cells):
            raise InputError("cells: got cells of another campaign, want each sweep, strength and policy")
        pairs, alike = [[sweep, strength] for _, sweep, strength in cells], manifest.deterministic
        if not isinstance(alike, list) or any(pair not in pairs for pair in alike):
            raise InputError(f"deterministic: got {excerpt(alike)}, want a list of pairs of a sweep and a strength")
        policies = manifest.settings.policies
        if set(manifest.policies) != set(policies):
            raise InputError(f"policies: got {', '.join(manifest.policies)}, want {', '.join(policies)}")
        for policy, hashes in manifest.policies.items():
            if hashes.keys() != {"digest", "sha256"}:
                raise InputError(f"policies: {policy}: got {excerpt(dict(hashes))}, want digest and sha256")
        if manifest.digest != digest_of_rows(said):
            raise InputError("digest: got a hash that does not fit the campaign, want an unchanged file")
        return manifest


def write_manifest(folder: Path, contents: dict[str, Any]) -> None:
    """Write the manifest: `contents`, with format and hashes added. Raises InputError."""
    manifest = {"format": FORMAT, "version": VERSION, **contents}
    manifest["digest"] = digest_of_rows(manifest)
    manifest["sha256"] = sha256(canonical(manifest))
    Manifest.of(parse(json.dumps(manifest)))  # without sorting: the sweeps define the order of the cells
    write(json.dumps(manifest, indent=1).encode(), folder / MANIFEST)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a folder. Raises InputError if it is missing, damaged, edited, or of another version."""
    path = folder / MANIFEST
    if not os.path.isfile(path):
        raise InputError(f"folder: got {excerpt(str(folder))}, want one that `lqrsim stress` wrote, with a {MANIFEST}")
    with blamed(path, "folder"):
        if path.stat().st_size > _LARGEST:
            raise InputError(f"size: got {path.stat().st_size:,} bytes, want at most {_LARGEST:,}")
        said = parse(path.read_text(encoding="utf-8"))
        if not isinstance(said, dict):
            raise InputError(f"manifest: got {excerpt(said)}, want an object")
        if (said.get("format"), said.get("version")) != (FORMAT, VERSION):
            was = f"a {excerpt(said.get('format'))} {excerpt(said.get('version'))}"
            raise Other(f"folder: got {path}, {was}, want a {FORMAT!r} {VERSION}")
        return Manifest.of(said)


def _check_names(field: str, part: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise InputError unless a JSON object has exactly these fields."""
    if wrong := sorted(part.keys() ^ set(names)):
        got = f"{'' if wrong[0] in part else 'none of '}{excerpt(wrong[0])}"
        raise InputError(f"{field}: got {got}, want exactly {', '.join(names)}")


def digest_of_rows(manifest: Mapping[str, Any]) -> str:
    """Hash of everything that the rows and their intervals depend on. A campaign that is begun again has the same."""
    fields = ("cells", "deterministic", "model", "problem", "start", "solution", "code", "versions")
    hashed = {name: manifest[name] for name in fields} | {
        "campaign": {name: value for name, value in manifest["campaign"].items() if name != "time_limit"},
        "policies": {policy: hashes["digest"] for policy, hashes in manifest["policies"].items()},
    }
    return sha256(canonical(hashed))


class Damaged(Exception):
    """The exception for a file that differs from what was written."""


def pack(table: Columns, shard: Shard, digest: str) -> bytes:
    """Encode a table as a file; `digest` is that of its campaign."""
    about = _about(shard, digest)
    meta = json.dumps(about | {"sha256": _digest(table, about)}).encode()
    arrow = pa.table({name: pa.array(column) for name, column in table.items()}).replace_schema_metadata({_KEY: meta})
    file = io.BytesIO()
    pq.write_table(arrow, file, write_page_checksum=True)
    return file.getvalue()


def unpack(contents: bytes, shard: Shard, digest: str) -> Columns:
    """Decode a table. Raises Damaged unless it is, to the bit, what `pack` was given for this shard."""
    about = _about(shard, digest)
    try:
        groups = _chunks(contents)
        rows = [[count for _, count in group] for group in groups]
        if any(codec not in (0, 1) for group in groups for codec, _ in group):
            raise ValueError("another compression than Snappy's")  # a few bytes of it may be gigabytes
        file = pq.ParquetFile(io.BytesIO(contents))
        if not file.metadata.num_rows == shard.count == sum(group[0] for group in rows):
            raise ValueError(f"{file.metadata.num_rows} rows")
        if file.schema_arrow.names != [*_TYPES] or file.schema_arrow.types != [*_TYPES.values()]:
            raise ValueError("other columns than those of outcomes")
        if any(len(group) != len(_TYPES) or len({*group}) > 1 for group in rows):
            raise ValueError("columns of different lengths")
        meta = json.loads((file.schema_arrow.metadata or {})[_KEY])
        file = pq.ParquetFile(io.BytesIO(contents), read_dictionary=[*_TEXTS], page_checksum_verification=True)
        read = file.read(use_threads=False)
        table: Columns = {name: _texts(read[name]) if name in _TEXTS else read[name].to_numpy() for name in _TYPES}
        good = meta == about | {"sha256": _digest(table, about)}
    except Exception as error:  # a parser may raise anything for damaged bytes
        raise Damaged(" ".join(f"{type(error).__name__}: {error}".split())[:200]) from None
    if not good or any(len(column) != shard.count for column in table.values()):
        raise Damaged("its contents have changed")
    return table


def write(contents: bytes, path: Path) -> None:
    """Write a file to the disk, all or nothing. Raises InputError if this fails, as on a full disk."""
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        file.write(contents)
        file.flush()
        os.fsync(file.fileno())


def read_table(path: Path, shard: Shard, digest: str) -> Columns:
    """Read the table of a file. Raises Damaged if it has changed or cannot be read."""
    if not os.path.isfile(path):
        raise Damaged("it is no regular file")
    try:
        if (size := path.stat().st_size) > _LARGEST_TABLE:
            raise Damaged(f"it has {size:,} bytes, want at most {_LARGEST_TABLE:,}")
        contents = path.read_bytes()
    except OSError as error:
        raise Damaged(f"it cannot be read ({error.strerror or error})") from None
    return unpack(contents, shard, digest)


def _about(shard: Shard, digest: str) -> dict[str, Any]:
    return {"campaign": digest, "cell": shard.cell_number, "first": shard.first, "count": shard.count}


def _texts(column: pa.ChunkedArray) -> npt.NDArray[np.str_]:
    """The texts of a column that is read as a dictionary: a text that rows have in common is unpacked once."""
    parts = list[npt.NDArray[np.str_]]()
    for part in column.chunks:
        texts = part.dictionary.to_pylist()
        if (longest := max(map(len, texts), default=0)) > LONGEST:
            raise ValueError(f"a text of {longest} characters")
        parts.append(np.array(texts, dtype=np.str_)[part.indices.to_numpy()])
    return np.concatenate(parts)


def _digest(table: Columns, about: Mapping[str, Any]) -> str:
    parts: list[str | bytes] = [json.dumps(about)]
    for name, column in table.items():
        text = column.dtype.kind == "U"
        kind = "text" if text else column.dtype.str
        data = json.dumps(column.tolist()).encode() if text else np.ascontiguousarray(column).tobytes()
        parts += [f"{name} {kind} {len(data)}:", data]
    return sha256(*parts)


def _chunks(contents: bytes) -> list[list[tuple[int, int]]]:
    """Codec (0 none, 1 Snappy) and number of values of each column of each row group, by the footer.

    Raises an exception of any kind where the footer is damaged.

    PyArrow's own footer objects crash the process if the footer is damaged, so it is read here, as far as it bounds the
    memory that a file takes. The format is Thrift's compact protocol: https://github.com/apache/parquet-format and
    https://github.com/apache/thrift/blob/master/doc/specs.
    """
    length = int.from_bytes(contents[-8:-4], "little")
    if contents[-4:] != _MAGIC or not 0 < length <= len(contents) - 12:
        raise ValueError("no footer of parquet")
    footer = _value(io.BytesIO(contents[-8 - length : -8]), _STRUCT, _DEEPEST)
    columns = [[chunk[3] for chunk in group[1]] for group in footer[4]]
    return [[(chunk[4], chunk[5]) for chunk in group] for group in columns]


def _value(data: io.BytesIO, kind: int, depth: int) -> Any:
    """A value of Thrift; of a structure its fields by their numbers."""
    if depth == 0:
        raise ValueError("structures too deep within each other")
    if kind in (*_BOOLEANS, _BYTE):
        return data.read(1)[0]
    if kind in _INTEGERS:
        return _integer(data)
    if kind in (_DOUBLE, _TEXT):
        length = 8 if kind == _DOUBLE else _unsigned(data)
        if len(read := data.read(length)) < length:
            raise ValueError("the end is missing")
        return read
    if kind in _LISTS:
        head = data.read(1)[0]
        count = head >> 4 if head >> 4 < 15 else _unsigned(data)
        return [_value(data, head & 15, depth - 1) for _ in range(count)]
    if kind == _MAP:
        kinds = data.read(1)[0] if (count := _unsigned(data)) else 0
        return [(_value(data, kinds >> 4, depth - 1), _value(data, kinds & 15, depth - 1)) for _ in range(count)]
    if kind == _STRUCT:
        values, number = dict[int, Any](), 0
        while head := data.read(1)[0]:
            number = number + (head >> 4) if head >> 4 else _integer(data)
            kind = head & 15
            values[number] = kind == _BOOLEANS[0] if kind in _BOOLEANS else _value(data, kind, depth - 1)
        return values
    raise ValueError(f"a field of kind {kind}")


def _integer(data: io.BytesIO) -> int:
    number = _unsigned(data)
    return (number >> 1) ^ -(number & 1)


def _unsigned(data: io.BytesIO) -> int:
    number = shift = 0
    while (byte := data.read(1)[0]) & 128:
        number, shift = number | (byte & 127) << shift, shift + 7
        if shift > 63:
            raise ValueError("a number of more than 64 bits")
    return number | byte << shift

"""What every script shares: its options, how it is run, what its result begins with, its sections and its tables.

A script has a frozen `Config` (a `Settings`), `main(config)`, which measures, and `report(result)`, which prints it as
Markdown. A result is JSON. `run` makes a program of these.
"""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import tyro
from peers.common import Unavailable
from tqdm import tqdm

import lqrsim as ls
from lqrsim.commands.console import text_of
from lqrsim.machine import description, versions
from lqrsim.results.archive import replacing
from lqrsim.stress.statistics import Estimate

Result = dict[str, Any]
Item = TypeVar("Item")

FIGURES = "figures"  # folder of the figures, in that of the output


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of every script."""

    quick: bool = False
    """As little of everything as still shows how it works."""
    json: bool = False
    """Print everything as JSON instead of the report."""


AnySettings = TypeVar("AnySettings", bound=Settings)


@dataclass(frozen=True, kw_only=True)
class FolderSettings(Settings):
    """Options of scripts that write files."""

    out: Path = Path("runs/paper")
    """Folder for the figures, in a folder of that name."""


@dataclass(frozen=True, kw_only=True)
class Statement:
    """A statement of the paper, and what was found here.

    Attributes:
      where: in the paper. paper: what it says. test: when that counts as holding here, a choice of ours.
      ours: what was found. holds: whether it does; None where that could not be tested, and `ours` says why.
      figure: which shows it, its name without the suffix.
    """

    where: str
    paper: str
    test: str
    ours: str
    holds: bool | None
    figure: str


def run(
    config_type: type[Settings],
    main: Callable[[Any], Result],
    report: Callable[[Result], str],
    description: str | None,
    *,
    statements: Callable[[Result], list[Statement]] = lambda result: [],
    failures: Callable[[Result], Sequence[Any]] = lambda result: (),
) -> None:
    """Run a script with the options of its command line, and print its result.

    Args:
      config_type: options. description: help text above them, the script's docstring.
      main, report: of the script.
      statements: what the paper says of it.
      failures: what must not be; with any, the program ends with exit code 1.
    """
    config = tyro.cli(config_type, description=description)
    try:
        result = main(config)
    except (ls.InputError, Unavailable) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    verdicts, failed = statements(result), list(failures(result))
    if config.json:
        printed = {"result": result, "report": report(result), "statements": [asdict(verdict) for verdict in verdicts]}
        print(text_of(printed))
    else:
        print(report(result))
        for verdict in verdicts:
            holds = {True: "holds", False: "DOES NOT HOLD", None: "not tested"}[verdict.holds]
            print(f"{holds}: {verdict.paper} ({verdict.where}): {verdict.ours} [{verdict.test}]")
        if isinstance(config, FolderSettings):
            for name in result["figures"]:
                print(f"wrote {config.out / FIGURES / name}")
    if failed:
        raise SystemExit(1)


def at_most(config: AnySettings, **counts: float) -> AnySettings:
    """The settings; with `--quick`, each of these fields no larger than its count."""
    few: Any = {name: min(getattr(config, name), count) for name, count in counts.items()}
    return replace(config, **few) if config.quick else config


def opening(config: Settings) -> Result:
    """What each result begins with: settings, versions, the machine, and the figures, none so far."""
    options = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    return {"config": options, "versions": versions(), "machine": description(), "figures": []}


def kept(folder: Path, name: str, settings: Mapping[str, Any], measure: Callable[[], Result]) -> Result:
    """The row of that name that an earlier run kept in a folder, if it is of these settings; or a new one, kept."""
    file = folder / f"{name.replace(' ', '_')}.json"
    row = json.loads(file.read_text("utf-8")) if file.is_file() else None
    if row is None or row["settings"] != settings:
        row = measure() | {"settings": settings}
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(file) as unfinished:
            unfinished.write_text(json.dumps(row) + "\n", encoding="utf-8")
    return row


@dataclass(frozen=True)
class Section:
    """A part of a script that can be run alone.

    Attributes:
      module: has `measure(config)`, which returns JSON, and `report(found)`, which returns paragraphs of Markdown.
      title: heading above them, if any.
    """

    module: ModuleType
    title: str = ""


Sections = Mapping[str, Section]


def measure(config: Any, sections: Sections, result: Result, *, keep_as: str | None = None) -> Result:
    """The result with what the sections that `config.sections` names have found.

    Args:
      keep_as: unless `--quick` was given, each section is saved in the folder `config.out` as soon as it is done, as
        `{keep_as}_{section}.json`, so that an error in a later one does not lose it.
    """
    for name in config.sections:
        try:
            result[name] = sections[name].module.measure(config)
        except Unavailable as error:
            result[name] = {"skipped": str(error)}
        if keep_as and not config.quick:
            config.out.mkdir(parents=True, exist_ok=True)
            with replacing(config.out / f"{keep_as}_{name}.json") as unfinished:
                unfinished.write_text(text_of(result[name]) + "\n", encoding="utf-8")
    return result


class Kept:
    """What is done of a long measurement, in a file if there is one: the same command goes on where it was stopped.

    Args:
      file: JSON; None keeps nothing. asked: what the rows depend on.

    Raises:
      InputError: the file has rows for something else.
    """

    def __init__(self, file: Path | None, asked: Result) -> None:
        self.file, self.asked, self.rows = file, asked, dict[str, Any]()
        if file is not None and file.is_file():
            kept = json.loads(file.read_text("utf-8"))
            if kept["asked"] != asked:
                raise ls.InputError(f"--keep: got rows for {kept['asked']}, want those for {asked}")
            self.rows = kept["rows"]

    def row(self, key: str, make: Callable[[], Item]) -> Item:
        """The row of that key, made if it is not there."""
        if key not in self.rows:
            self.rows[key] = make()
            if self.file is not None:
                with replacing(self.file) as unfinished:
                    kept = {"asked": self.asked, "rows": self.rows}
                    unfinished.write_text(json.dumps(kept) + "\n", encoding="utf-8")
        return self.rows[key]


def report_of(sections: Sections, result: Result) -> list[str]:
    """Paragraphs of the sections that were measured."""
    parts = []
    for name, section in sections.items():
        if name in result:
            found = result[name]
            parts += [f"### {section.title}"] if section.title else []
            skipped = isinstance(found, dict) and "skipped" in found and isinstance(found["skipped"], str)
            parts += [f"{name}: skipped: {found['skipped']}"] if skipped else section.module.report(found)
    return parts


def progress(items: Iterable[Item], name: str, **options: Any) -> Iterable[Item]:
    """The same items, with a bar if they take long."""
    return tqdm(items, desc=name, **{"leave": False, "delay": 2.0, "disable": None} | options)


@contextmanager
def counting(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for what reports how many are done of how many, if it takes long."""
    with tqdm(desc=name, leave=False, delay=2.0, disable=None) as bar:

        def update(done: int, of: int) -> None:
            bar.total = of
            bar.update(done - bar.n)

        yield update


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown: the first column to the left, the others, numbers, to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines)


def judge(met: bool, want: str) -> str:
    """Whether a target was met, in words."""
    return f"{'met' if met else 'MISSED'}: want {want}"


def interval(estimate: Estimate) -> list[float]:
    """An estimate as JSON has it: value, lower and upper end."""
    return [estimate.value, estimate.low, estimate.high]


def improbable(chance: float, spec: str = ".1g") -> str:
    """A p-value in words; one that is 0 was too small for a number."""
    return f"{chance:{spec}}" if chance else "< 1e-300"


def between(estimate: Sequence[float], spec: str = ".2f") -> str:
    """Such a list in words."""
    value, low, high = estimate
    return f"{value:{spec}} ({low:{spec}} to {high:{spec}})"

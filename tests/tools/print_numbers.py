"""Prints the numbers of the pages again: runs the commands that the pages name, and looks for the numbers beside them.

    python3 run.py numbers                    # every command but those of docs/long_runs.md
    python3 run.py numbers --long             # those, too: some hours on an idle machine
    python3 run.py numbers --only league      # commands that contain this text
    python3 run.py numbers --list             # the commands, with the number of rows that each is to print
    python3 run.py numbers --folder models    # also those that want FOLDER, of the models of other packages

A command in a table is that of its row. Rows without one, and text, belong to the command that the paragraph above
them names first. A number counts as printed if the command's output has it, rounded as on the page; the row of a
table that stands as it was printed needs all of its numbers in one line. Whether it is the same quantity is for the
reader to judge: build/numbers/ has each output, with the machine, the last commit that changed code, and the time that
it took. A rerun continues if code is committed and has not changed.

docs/results.md is not read: `lqrsim reproduce` writes it.

Commands that name a file of one's own, as FILE.xml, are left out, and named at the end.

Exits with 1 if a command failed or a table has a number that was not printed.
"""

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from lqrsim.machine import description

ROOT = Path(__file__).parents[2]
OUT = ROOT / "build" / "numbers"
CODE = ("lqrsim", "models", "experiments", "tests/tools", "pyproject.toml")
NAMED = re.compile(r"`((?:python (?:experiments|tests/tools)/|lqrsim (?:demo|(?:reproduce|solve|simulate) \S+))[^`]*)`")
PLACEHOLDER = re.compile(r"[A-Z]+(\.\w+)?")  # a word of a command that stands for a file of one's own
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")


@dataclass(frozen=True)
class Claim:
    """A row of a table, or a paragraph, with the command that prints its numbers."""

    page: str
    line: int
    command: str
    text: str
    numbers: tuple[str, ...]
    in_table: bool
    as_printed: bool


@dataclass(frozen=True)
class Config:
    """Which commands to run."""

    only: Annotated[str, tyro.conf.arg(metavar="TEXT")] = ""
    """Only commands that contain this text."""
    list: bool = False
    """Print the commands without running them."""
    long: bool = False
    """Also the commands of docs/long_runs.md."""
    again: bool = False
    """Run a command also if its output, by the same code, is there."""
    folder: Path | None = None
    """What FOLDER stands for in a command; without it, commands that want one are left out."""


def claims(page: Path) -> Iterator[Claim]:
    """What a page says that a command prints."""
    command, head, fenced, paragraph, first = "", None, False, [], 0

    def flush() -> Iterator[Claim]:
        text = " ".join(paragraph)
        paragraph.clear()
        if command and (numbers := NUMBER.findall(NAMED.sub("", text))):
            yield Claim(page.name, first, command, text, tuple(numbers), in_table=False, as_printed=False)

    for count, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if line.startswith("```"):
            fenced = not fenced
        if fenced or line.startswith("```"):
            continue
        if not line.strip() or line.startswith(("#", "|", "- ", "![")):
            yield from flush()
        if line.startswith("#"):
            command = ""
        elif line.startswith("|"):
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            if head is None:
                head = cells
            elif not set(line) <= set("|-: "):
                own = NAMED.search(cells[-1]) if head[-1] == "command" else None
                shown = [cells[head.index("value")]] if own and "value" in head else cells[1:]
                if (own or command) and (numbers := NUMBER.findall(" ".join(shown))):
                    printer = own[1] if own else command
                    yield Claim(page.name, count, printer, cells[0], tuple(numbers), in_table=True, as_printed=not own)
            continue
        elif line.strip():
            first = first if paragraph else count
            paragraph.append(line.strip())
            if found := NAMED.findall(" ".join(paragraph)):
                command = found[0]
        head = None
    yield from flush()


def value(number: str) -> float:
    return float(number.replace(",", ""))


def decimals(number: str) -> float:
    """Half of the last digit that a number is written with."""
    mantissa, _, exponent = number.partition("e")
    return 0.5 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def is_printed(number: str, printed: list[float]) -> bool:
    """Whether one of the printed numbers, rounded as this one, is this one. Below 1e-12 is rounding."""
    within = max(decimals(number) * 1.0001, 1e-12)
    return any(abs(value(number) - other) <= within for other in printed)


def farthest(claim: Claim, output: str) -> float:
    """How far what was printed is from a claim, relative to it: 0 if all of it is printed."""
    lines = [[value(number) for number in NUMBER.findall(line)] for line in output.splitlines()]
    anywhere = [number for line in lines for number in line]
    if claim.as_printed and not any(all(is_printed(n, line) for n in claim.numbers) for line in lines):
        label = re.sub(r"\W+", " ", claim.text).strip()
        same = [
            numbers
            for line, numbers in zip(output.splitlines(), lines, strict=True)
            if label and label in re.sub(r"\W+", " ", line)
        ]
        anywhere = max(same, key=len, default=[])
    missing = [number for number in claim.numbers if not is_printed(number, anywhere)]

    def off(number: str) -> float:
        gaps = [abs(value(number) - other) / max(abs(value(number)), decimals(number)) for other in anywhere]
        return min(gaps, default=float("inf"))

    return max(map(off, missing), default=0.0)


def run(command: str, words: list[str], commit: str, *, again: bool) -> tuple[int, str]:
    """The exit code and the output of a command, from an earlier run of this code if there is one."""
    kept = OUT / (re.sub(r"[^\w]+", "_", command).strip("_") + ".txt")
    if kept.is_file() and not again and not commit.endswith("-dirty"):  # there are many of that name
        header, _, output = kept.read_text(encoding="utf-8").partition("\n\n")
        if f"commit: {commit}\n" in header and "exit code: 0\n" in header:
            return 0, output
    program = [sys.executable, *words[1:]] if words[0] == "python" else [sys.executable, "-m", "lqrsim.cli", *words[1:]]
    begun = time.monotonic()
    done = subprocess.run(program, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    header = (
        f"command: {command}\ncommit: {commit}\nmachine: {description()}\n"
        f"seconds: {time.monotonic() - begun:.0f}\nexit code: {done.returncode}\n"
    )
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(f"{header}\n\n{done.stdout}", encoding="utf-8")
    return done.returncode, done.stdout


def last_commit() -> str:
    """The last commit that changed code, with "-dirty" if some has changed since then."""

    def git(*words: str) -> str:
        command = ["git", *words, "--", *CODE]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    return git("log", "-1", "--format=%h") + ("-dirty" if git("status", "--porcelain") else "")


def all_claims(*, long: bool = False) -> dict[str, list[Claim]]:
    """The claims of all pages, by command."""
    found: dict[str, list[Claim]] = {}
    left_out = {"results.md"} if long else {"results.md", "long_runs.md"}
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if page.name not in left_out:
            for claim in claims(page):
                found.setdefault(claim.command, []).append(claim)
    return found


def main(config: Config) -> int:
    chosen = {command: rows for command, rows in all_claims(long=config.long).items() if config.only in command}
    if config.list or not chosen:
        for command, rows in chosen.items():
            rows_of_tables = sum(row.in_table for row in rows)
            print(f"{rows_of_tables:4} rows, {len(rows) - rows_of_tables:3} texts: {command}")
        return 0 if chosen else 2
    commit = last_commit()
    failed, left_out = 0, list[str]()
    for command, rows in tqdm(chosen.items(), desc="numbers", disable=None):
        words = [str(config.folder or word) if word == "FOLDER" else word for word in shlex.split(command)]
        if any(map(PLACEHOLDER.fullmatch, words)):
            left_out.append(command)
            continue
        code, output = run(command, words, commit, again=config.again)
        tqdm.write(f"\n{command}" + (f": FAILED with exit code {code}" if code else ""))
        failed += bool(code)
        printed = 0
        for row in rows:
            far = farthest(row, output)
            printed += not far
            if far:
                failed += row.in_table
                how = (
                    "none like it is printed"
                    if far == float("inf")
                    else f"the closest that is printed is {far:.1%} off"
                )
                tqdm.write(f"  {row.page}:{row.line}: {', '.join(row.numbers)} ({row.text[:60]}): {how}")
        tqdm.write(f"  {printed} of {len(rows)} printed again")
    for command in left_out:
        print(f"left out, for it wants files of your own: {command}")
    print(f"\n{description()}, commit {commit}; the outputs are in {OUT.relative_to(ROOT)}/")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Config, description=__doc__)))
    except KeyboardInterrupt:
        sys.exit(130)

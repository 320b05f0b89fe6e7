"""Results as tables and drawings: for papers as CSV, LaTeX and Markdown, for notebooks as HTML and SVG.

All text is escaped, because names come from files that anyone may have written.
"""

import csv
import io
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Annotated

import numpy as np

from lqrsim.annotations import Want, checked
from lqrsim.errors import (
    Array,
    InputError,
    check_count,
    check_items,
    check_name,
    check_number,
    check_path,
    check_text,
    excerpt,
    keep,
)
from lqrsim.results.archive import write_text
from lqrsim.results.coordinates import Coordinates

Entry = str | int | float | None
_LONGEST = 10_000  # characters of an entry or a note; a reference to a scenario may have as many

_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "[": "{[}", "*": "{*}",  # a row that begins with one of the last two would be an option of \\
})  # fmt: skip
# An underscore within a word is only that. Not all renderers know a backslash before the others.
_MARKDOWN = re.compile(r"[\\`*\[\]|]|(?<![^\W_])_|_(?![^\W_])")
# What would begin a heading, a list or a rule in place of a paragraph.
_BLOCK = re.compile(r"^(\d+(?=[.)](?: |$))|(?=[#+-]))(.)")
_ENTITIES = str.maketrans({letter: f"&#{ord(letter)};" for letter in "&<>~$"})

WIDTH, HEIGHT, MARGIN = 360, 240, 12  # size of a drawing in pixels
POINTS = 300  # largest number of points of a line
SHOWN = 10  # largest number of trials in a table or a summary, and of lines in a drawing
COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#17becf", "#bcbd22", "#7f7f7f")


@checked
@dataclass(frozen=True, eq=False)
class DataTable:
    """A table with one name or number in each entry. `str(table)` is its Markdown.

    Attributes:
      columns: heading -> entries, all of one length: text, finite numbers, or None for nothing.
      formats: heading -> format of numbers in LaTeX and Markdown, such as ".3f"; by default "g". A CSV has all digits.
      notes: lines that say what the numbers are: comments in LaTeX, lines below the table in Markdown, not in a CSV.
    """

    columns: Annotated[Mapping[str, Sequence[Entry]], Want("heading -> entries")]
    formats: Annotated[Mapping[str, str], Want("heading -> format")] = field(default_factory=dict)
    notes: Annotated[Sequence[str], Want("a list of lines")] = ()

    def __post_init__(self) -> None:
        who, want = "DataTable: columns", "heading -> entries, each text, a finite number or None"
        columns = {
            check_text(f"{who}: heading", name): tuple(
                _entry(f"{who}: {excerpt(name)}", entry) for entry in check_items(who, column, object, want)
            )
            for name, column in self.columns.items()
        }
        if len({len(column) for column in columns.values()}) != 1:
            got = ", ".join(f"{len(column)} in {excerpt(name)}" for name, column in columns.items()) or "none"
            raise InputError(f"{who}: got {got}, want at least one column, all of one length")
        for name, spec in self.formats.items():
            check_name("DataTable: formats", name, columns)
            if not re.fullmatch(r"(\.\d\d?)?[efg]", spec):
                raise InputError(f"DataTable: formats: {excerpt(name)}: got {excerpt(spec)}, want such as '.3f' or 'g'")
        notes = tuple(check_text("DataTable: notes", note, "a line", at_most=_LONGEST) for note in self.notes)
        keep(self, columns=columns, notes=notes)

    @checked
    def select(self, headings: Annotated[Sequence[str], Want("a list of headings")]) -> "DataTable":
        """The table with these columns alone, in this order."""
        chosen = {name: self.columns[check_name("headings", name, self.columns)] for name in headings}
        formats = {name: spec for name, spec in self.formats.items() if name in chosen}
        return DataTable(chosen, formats, self.notes)

    def csv(self) -> str:
        """The table as CSV (RFC 4180, lines end with a line feed): headings, then rows. None is an empty entry."""
        text = io.StringIO()
        rows = zip(*self.columns.values(), strict=True)
        csv.writer(text, lineterminator="\n").writerows([tuple(self.columns), *rows])
        return text.getvalue()

    def latex(self) -> str:
        r"""The table as a `tabular` of LaTeX with the rules of the package booktabs, for `\input` in a `table`."""
        entries = self._rows(lambda text: text.translate(_LATEX), _latex_number)
        head, *rows = (" & ".join(row) + r" \\" for row in entries)
        return _lines(
            r"% needs \usepackage{booktabs}", *(f"% {note}" for note in self.notes),
            rf"\begin{{tabular}}{{{''.join('l' if text else 'r' for text in self._texts)}}}",
            r"\toprule", head, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}",
        )  # fmt: skip

    def markdown(self) -> str:
        """The table as Markdown with pipes, in columns of equal width; below it the notes."""
        rows, texts = list(self._rows(_markdown_text, str)), self._texts
        widths = [max(3, *(len(entry) for entry in column)) for column in zip(*rows, strict=True)]
        rule = ["-" * width if text else "-" * (width - 1) + ":" for width, text in zip(widths, texts, strict=True)]
        sides = ["<" if text else ">" for text in texts]
        head, *body = (
            f"| {' | '.join(f'{entry:{side}{width}}' for entry, side, width in zip(row, sides, widths, strict=True))} |"
            for row in (rows[0], rule, *rows[1:])
        )
        notes = (_BLOCK.sub(r"\1\\\2", _markdown_text(note.strip())) for note in self.notes)
        return _lines(head, *body, *(line for note in notes for line in ("", note)))

    __str__ = markdown

    def _repr_html_(self) -> str:
        heading, *remarks = self.notes or ("",)
        return of_table(heading, remarks, list(self._rows(str, str)))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the table in the format that the name ends with, .csv, .tex or .md; returns its path."""
        path = check_path("path", path, suffixes=ENDINGS)
        write_text(path, _WRITERS[path.suffix.lower()](self))
        return path

    @property
    def _texts(self) -> list[bool]:
        return [any(isinstance(entry, str) for entry in column) for column in self.columns.values()]

    def _rows(self, text: Callable[[str], str], number: Callable[[str], str]) -> Iterator[list[str]]:
        """The headings, then the rows, as `text` and `number` write them."""
        specs = [self.formats.get(name, "g") for name in self.columns]

        def written(entry: Entry, spec: str) -> str:
            if isinstance(entry, str):
                return text(entry)
            return "" if entry is None else number(str(entry) if isinstance(entry, int) else format(entry, spec))

        yield [text(name) for name in self.columns]
        for row in zip(*self.columns.values(), strict=True):
            yield [written(entry, spec) for entry, spec in zip(row, specs, strict=True)]


_WRITERS = {".csv": DataTable.csv, ".tex": DataTable.latex, ".md": DataTable.markdown}
ENDINGS = tuple(_WRITERS)


def fraction_format(trials: int) -> str:
    """The format of a fraction of so many trials: a trial more changes it, and it has three digits at least."""
    return f".{max(3, len(str(trials - 1)))}f"


def _entry(field: str, value: object) -> Entry:
    if value is None:
        return None
    if isinstance(value, str):
        return check_text(field, value, at_most=_LONGEST, empty=True)
    if isinstance(value, (int, np.integer)):
        return check_count(field, value, at_least=-(2**63), at_most=2**63 - 1)  # what readers of a CSV hold
    return check_number(field, value)


def _lines(*lines: str) -> str:
    return "".join(f"{line}\n" for line in lines)


def _latex_number(text: str) -> str:
    """In math mode, where a minus sign is no hyphen; 1e-05 as a power of ten."""
    digits, _, exponent = text.partition("e")
    return f"${digits} \\times 10^{{{int(exponent)}}}$" if exponent else f"${digits}$"


def _markdown_text(text: str) -> str:
    return _MARKDOWN.sub(r"\\\g<0>", text).translate(_ENTITIES)


def number_text(value: float) -> str:
    """A number with four digits; a dash if it is not finite."""
    return f"{value:.4g}" if np.isfinite(value) else "-"


def of_table(
    heading: str, remarks: Iterable[str], rows: Sequence[Sequence[str]], picture: str = "", *, head: bool = True
) -> str:
    """A heading, remarks, and a table next to a picture; `head`: whether the first row names the columns."""
    lines = "".join(f"<div>{escape(remark)}</div>" for remark in remarks)
    table = ""
    for i, row in enumerate(rows):
        tags = ["td" if (i if head else j) else "th" for j in range(len(row))]
        cells = (f'<{tag} style="text-align:left">{escape(text)}</{tag}>' for tag, text in zip(tags, row, strict=True))
        table += f"<tr>{''.join(cells)}</tr>"
    beside = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"
    above = f'<div class="lqrsim"><div><strong>{escape(heading)}</strong></div>{lines}'
    return f'{above}<div style="{beside}"><table>{table}</table>{picture}</div></div>'


def drawing(space: Coordinates, times: Array, plan: Array, runs: Array) -> str:
    """The plan (T+1, n) and runs (K, T+1, n) as SVG: paths of SHOWN runs along the first two axes of the position.

    Without a position, it shows the states of the plan and of the first run over time, each to its own scale.
    """
    dashes = "4 3" if len(runs) else ""
    if space.position:
        place = list(space.position[:2])
        lines = [(plan[:, place], "currentColor", "plan", dashes)]
        lines += [(run[:, place], COLOURS[k], f"run {k}", "") for k, run in enumerate(runs[:SHOWN])]
        names = [space.labels[i] for i in place]
        return _svg(lines, f"{names[0]} to the right, {names[1]} up", equal=True)
    low, high = _range(plan)
    lines = []
    for states, name, dashed in [(plan, "plan", dashes), *((run, "run 0", "") for run in runs[:1])]:
        scaled = (states - low) / (high - low)
        for i, label in enumerate(space.labels):
            line = np.stack([times, scaled[:, i]], axis=1)
            lines.append((line, COLOURS[i % len(COLOURS)], f"{label}, {name}", dashed))
    return _svg(lines, f"{', '.join(space.labels)} over time, each to its own scale", equal=False)


def _range(values: Array) -> tuple[Array, Array]:
    """The smallest and the largest finite value of each column, kept slightly apart."""
    finite = np.where(np.isfinite(values), values, np.nan)
    known = np.isfinite(finite).any(axis=0)
    finite = np.where(known, finite, 0.0)
    low, high = np.nanmin(finite, axis=0), np.nanmax(finite, axis=0)
    wide = np.maximum(high - low, 1e-9 * np.maximum(np.abs(low), 1.0))
    return low, low + wide


def _svg(lines: list[tuple[Array, str, str, str]], title: str, *, equal: bool) -> str:
    """Lines (N, 2) with colour, title and dashes, to one scale if `equal`; points that are not finite are left out."""
    low, high = _range(np.concatenate([line for line, *_ in lines]))
    scale = (np.array([WIDTH, HEIGHT]) - 2 * MARGIN) / (high - low)
    if equal:
        scale = np.full(2, scale.min())
    middle = (low + high) / 2

    def places(line: Array) -> Array:
        chosen = line[np.unique(np.linspace(0, len(line) - 1, POINTS).round().astype(int))]
        chosen = chosen[np.isfinite(chosen).all(axis=1)]
        return np.array([WIDTH, HEIGHT]) / 2 + (chosen - middle) * scale * np.array([1, -1])

    drawn = []
    for line, colour, name, dashes in lines:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places(line))
        style = f' stroke-dasharray="{dashes}"' if dashes else ""
        shape = f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"{style}>'
        drawn.append(f"{shape}<title>{escape(name)}</title></polyline>")
    plan = places(lines[0][0])
    for place, name, fill in ((plan[:1], "start", "none"), (plan[-1:], "the plan's end", "currentColor")):
        for x, y in place if equal else ():
            circle = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" stroke="currentColor" fill="{fill}">'
            drawn.append(f"{circle}<title>{escape(name)}</title></circle>")
    size = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"><title>{escape(title)}</title>'
    return f"{head}{''.join(drawn)}</svg>"

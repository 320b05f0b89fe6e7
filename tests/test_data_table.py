"""Tables for papers: read back by pyarrow, by a Markdown renderer and by a small reader of LaTeX."""

import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import markdown
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from pyarrow import csv
from scipy import stats

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.results.display import fraction_format

NASTY = r"a&b % $x$ #1_y {z} ~^ \ <b> | [q] * `c` _d_ &amp; 50% -- ü²"
PLAIN = st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=12).map(str.strip)
names = PLAIN.filter(bool)
numbers = st.floats(allow_nan=False, allow_infinity=False)


class Cells(HTMLParser):
    """The text of each entry of an HTML table, row by row."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.inside = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ("table", "thead", "tbody", "tr", "th", "td", "p")  # nothing else that an entry could become
        if tag == "tr":
            self.rows.append([])
        self.inside = tag in ("th", "td")
        if self.inside:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.rows[-1][-1] += data


def squeezed(text: str) -> str:
    """Neither renderer keeps spaces that follow each other."""
    return " ".join(text.split())


TOKEN = re.compile(r"\\text(\w+)\{\}|\{([\[*])\}|\\([&%$#_{}])|([^\\{}&%$#_~^<>|\[*])")
NAMED = {
    "backslash": "\\", "asciitilde": "~", "asciicircum": "^", "less": "<", "greater": ">", "bar": "|",
}  # fmt: skip


def read_latex(text: str) -> str:
    """The text that LaTeX sets; fails on a character that LaTeX would take for something else."""
    found, at = "", 0
    while at < len(text):
        match = TOKEN.match(text, at)
        assert match is not None, text[at:]
        named, braced, escaped, plain = match.groups()
        found, at = found + (NAMED[named] if named else braced or escaped or plain), match.end()
    return found


def body(table: ls.types.DataTable) -> list[list[str]]:
    """The entries of a tabular, the headings first."""
    lines = [line for line in table.latex().splitlines() if line.endswith(r" \\")]
    return [re.split(r"(?<!\\) ?& ?", line.removesuffix(r" \\")) for line in lines]


@given(st.lists(st.tuples(names, numbers, st.none() | st.integers(-(2**53), 2**53)), min_size=1, max_size=4), names)
def test_every_form_holds_the_table(rows: list[tuple[str, float, int | None]], heading: str) -> None:
    """Text to the letter. Numbers to the last bit in the CSV, and to two digits elsewhere."""
    columns: dict[str, Any] = {f"{heading} text": [row[0] for row in rows], "x": [row[1] for row in rows]}
    columns["count"] = [row[2] for row in rows]
    table = ls.types.DataTable(columns, {"x": ".1e"})
    kinds = {f"{heading} text": pa.string(), "x": pa.float64(), "count": pa.int64()}
    read = csv.read_csv(
        pa.BufferReader(table.csv().encode()),
        convert_options=csv.ConvertOptions(column_types=kinds, strings_can_be_null=False),
    )
    assert read.to_pydict() == columns
    wanted = [[*columns], *[[a, f"{x:.1e}", "" if n is None else str(n)] for a, x, n in rows]]
    text = table.markdown()
    for html in (
        markdown.markdown(text, extensions=["tables"]),
        MarkdownIt("gfm-like", {"linkify": False}).render(text),
    ):
        assert [[squeezed(entry) for entry in row] for row in Cells(html).rows] == [
            [squeezed(entry) for entry in row] for row in wanted
        ]
    latex = body(table)
    assert [read_latex(entry) for entry in latex[0]] == [*columns]
    for (text, number, count), (name, x, n) in zip(latex[1:], rows, strict=True):
        assert read_latex(text) == name
        match = re.fullmatch(r"\$(.*) \\times 10\^\{(-?\d+)\}\$", number)
        assert match is not None
        digits, power = match.groups()
        assert float(f"{digits}e{power}") == float(f"{x:.1e}")
        assert count == ("" if n is None else f"${n}$")


BEGINNINGS = ("", "#", "# ", "- ", "---", "+ ", "1. ", "12) ", "    ", "-5 ", "2.5 ", "* ", "> ", "=== ")


@given(st.lists(st.tuples(st.sampled_from(BEGINNINGS), names), min_size=1, max_size=3))
def test_a_note_is_a_paragraph_however_it_begins(notes: list[tuple[str, str]]) -> None:
    said = [f"{beginning}{name}" for beginning, name in notes]
    text = ls.types.DataTable({"x": [1.0]}, notes=said).markdown()
    for html in (
        markdown.markdown(text, extensions=["tables"]),
        MarkdownIt("gfm-like", {"linkify": False}).render(text),
    ):
        _, _, below = html.partition("</table>")
        paragraphs = re.findall(r"<p>(.*)</p>", below)
        assert re.sub(r"<p>.*</p>", "", below).strip() == ""
        assert [squeezed(unescape(paragraph)) for paragraph in paragraphs] == [squeezed(note) for note in said]


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no LaTeX here")
def test_latex_compiles(tmp_path: Path) -> None:
    table = ls.types.DataTable({NASTY: [NASTY, "[", "*"], "p": [1e-9, -2.5, None]}, notes=[NASTY])
    head = r"\documentclass{article}\usepackage[T1]{fontenc}\usepackage{booktabs}\begin{document}"
    (tmp_path / "a.tex").write_text(head + "\n\\input{t}\n\\end{document}\n", encoding="utf-8")
    table.save(tmp_path / "t.tex")
    run = subprocess.run(["pdflatex", "-halt-on-error", "a.tex"], cwd=tmp_path, capture_output=True, check=False)
    assert run.returncode == 0, run.stdout


def test_a_file_is_what_its_name_says(tmp_path: Path) -> None:
    columns: dict[str, Any] = {"name": [NASTY], "x": [np.float64(0.1)], "n": [np.int32(3)]}
    table = ls.types.DataTable(columns, notes=["a note"])
    for ending, text in ((".csv", table.csv()), (".tex", table.latex()), (".md", str(table)), (".CSV", table.csv())):
        path = table.save(tmp_path / f"a{ending}")
        assert path.read_bytes() == text.encode()
    assert table.select(["x"]).columns == {"x": (0.1,)}
    assert table.select(["x"]).notes == ("a note",)
    assert "a note" not in table.csv()
    assert "% a note\n" in table.latex()


@pytest.mark.parametrize("trials", [2, 7, 200, 1000, 10_000, 123_456])
def test_a_trial_more_is_seen_in_a_fraction(trials: int) -> None:
    spec = fraction_format(trials)
    assert format(1 / trials, spec) != format(0.0, spec)
    assert format(1 - 1 / trials, spec) != format(1.0, spec)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> ls.stress.Results:
    campaign = ls.stress.Campaign(
        scenario="differential_drive", sweeps={NASTY.replace(",", ""): (ls.disturbances.ControlNoise(0.3),)},
        strengths=(0.0, 1.0), policies=("smooth", "open_loop"), trials=9, shard=6,
    )  # fmt: skip
    return ls.stress.run_campaign(campaign, tmp_path_factory.mktemp("campaigns") / "a", workers=0)


def test_rates_are_those_of_the_trials(results: ls.stress.Results) -> None:
    """Counts from the outcomes; intervals by SciPy, to its last bit."""
    table = results.rates().columns
    assert [f"{p},{s},{x:g}" for p, s, x in zip(table["policy"], table["sweep"], table["strength"], strict=True)] == [
        str(cell) for cell in results.cells
    ]
    for row, cell in enumerate(results.cells):
        outcome = results.outcomes(cell).outcome
        counts = {
            name: int((outcome == name).sum()) for name in ("reached", "timed out", "collided", "diverged", "error")
        }
        assert {end: table[end][row] for end in counts} == counts
        assert table["trials"][row] == 9
        assert table["success"][row] == counts["reached"] / 9
        sure = stats.binomtest(counts["reached"], 9).proportion_ci(0.95, "exact")
        wanted = (None, None) if cell.strength == 0 else (sure.low, sure.high)
        assert (table["low"][row], table["high"][row]) == wanted


def test_each_table_is_read_once(results: ls.stress.Results, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a summary and for rates, but where trials were stopped: their reasons are read for these alone."""
    read, table = list[str](), ls.stress.Results.table
    monkeypatch.setattr(ls.stress.Results, "table", lambda self, shard: read.append(shard.file) or table(self, shard))
    shards = sorted(shard.file for shard in results.shards())
    for first, second in (("summary", "rates"), ("rates", "summary")):
        read.clear()
        anew = ls.stress.Results(results.folder)
        getattr(anew, first)()
        assert sorted(read) == shards
        getattr(anew, second)()
        assert sorted(read) == shards


def test_the_command_writes_them(
    results: ls.stress.Results, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    csv, latex = results.rates().csv(), results.rates().latex()
    for ending, text in ((".csv", csv), (".tex", latex), (".CSV", csv), (".Tex", latex)):
        path = tmp_path / f"rates{ending}"
        assert main(["report", str(results.folder), "--out", str(path)]) == 0
        assert capsys.readouterr().out == f"wrote {path}\n"
        assert path.read_text(encoding="utf-8") == text


def test_rates_of_what_has_not_ended(results: ls.stress.Results, tmp_path: Path) -> None:
    """Of the last cell nothing has been run, of the one before it 6 of 9."""
    folder = shutil.copytree(results.folder, tmp_path / "a")
    for shard in list(results.shards())[-3:]:
        (folder / "shards" / shard.file).unlink()
    table = ls.stress.Results(folder).rates()
    assert table.columns["trials"] == (9, 9, 6, 0)
    assert [table.columns[name][-1] for name in ("success", "low", "high")] == [None] * 3
    assert table.notes[-1] == "not finished: 12 of 36 trials are missing"
    assert results.rates().notes[-1] != table.notes[-1]

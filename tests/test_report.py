"""The page of a stress test: that it is whole, holds against what was measured, and needs nothing else."""

import base64
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import lqrsim as ls
from lqrsim.simulation.outcomes import Outcomes, outcomes
from lqrsim.stress.cells import Cell
from lqrsim.view import gl
from lqrsim.view.report import report

NASTY = '<script>alert("&")</script>'
SWEEPS = {
    NASTY: (ls.ControlNoise(0.2), ls.ForceNoise(5.0)),
    "measurements": (ls.MeasurementNoise((0.05, 0.05, 0.1)),),
}
STRENGTHS = (0.0, 1.0, 4.0)
TRIALS = 12


@dataclass(frozen=True)
class Campaign:
    scenario: str = "differential_drive"
    sweeps: Mapping[str, tuple[ls.Disturbance, ...]] = field(default_factory=lambda: SWEEPS)
    trials: int = TRIALS
    seed: int = 3


@dataclass(frozen=True)
class Results:
    table: dict[Cell, Outcomes]
    solutions: dict[str, ls.Solution]
    folder: Path = Path("runs/a test")
    campaign: Campaign = Campaign()
    complete: bool = True
    manifest: Mapping[str, Any] = field(
        default_factory=lambda: {"versions": {"lqrsim": "7"}, "machine": "an abacus", "campaign": {"name": NASTY}}
    )

    @property
    def cells(self) -> list[Cell]:
        return list(self.table)

    def outcomes(self, cell: Cell, *, partial: bool = False) -> Outcomes:
        assert partial or self.complete
        return self.table[cell]


def run(solutions: dict[str, ls.Solution], cell: Cell, first: int, trials: int, *, frames: bool) -> ls.Rollout:
    disturbances: list[ls.Disturbance] = []
    for one in SWEEPS[cell.sweep]:
        assert isinstance(one, ls.ControlNoise | ls.ForceNoise | ls.MeasurementNoise)
        disturbances.append(replace(one, std=(cell.strength * np.array(one.std)).tolist()))
    plant = ls.scenarios.get("differential_drive").plant()
    options = {"seed": 3, "first_trial": first, "trials": trials, "frames": frames, "contacts": frames}
    return ls.simulate(plant, solutions[cell.policy], disturbances=disturbances, **options)


def again(results: Results, cell: Cell, trial: int) -> ls.Rollout:
    return run(results.solutions, cell, trial, 1, frames=True)


@pytest.fixture(scope="module")
def results(drive_solution: ls.Solution, differential_drive: ls.Scenario) -> Results:
    solutions = {"smooth": drive_solution, "open_loop": drive_solution.open_loop()}
    plant, problem = differential_drive.plant(), differential_drive.problem
    cells = [Cell(policy, sweep, strength) for policy in solutions for sweep in SWEEPS for strength in STRENGTHS]
    table = {cell: outcomes(run(solutions, cell, 0, TRIALS, frames=False), plant, problem) for cell in cells}
    return Results(table, solutions)


class Page(HTMLParser):
    """Fails on what is not well formed, and gathers the rest."""

    EMPTY = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs)
        self.tags.append((tag, dict(attrs)))
        if tag not in self.EMPTY:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style",):
            self.words.append(data)
        if self.open and self.open[-1] in ("th", "td"):
            self.rows[-1][-1] += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def page(results: Results, tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert report(results, path, videos=0) == path
    return Page(path.read_text(encoding="utf-8"))


def test_page_is_well_formed_and_accessible(page: Page) -> None:
    assert page.of("html") == [{"lang": "en"}]
    assert len(page.of("title")) == len(page.of("h1")) == len(page.of("main")) == 1
    assert page.of("table")
    assert len(page.of("caption")) == len(page.of("table"))
    assert all(attributes["scope"] in ("row", "col") for attributes in page.of("th"))
    assert len(page.of("img")) == 2 * len(SWEEPS)
    assert all(len(attributes["alt"] or "") > 30 for attributes in page.of("img"))
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    assert {attributes["href"] for attributes in page.of("a")} == {f"#{one}" for one in ids}
    lengths = {len(row) for row in page.rows}
    assert min(lengths) > 1


def test_page_needs_nothing_else_and_runs_nothing(page: Page) -> None:
    """No script, no address but those within the page and of data; what others named is text."""
    assert not page.of("script")
    assert not page.of("link")
    for _, attributes in page.tags:
        for name in ("src", "href"):
            assert re.match(r"#|data:(image/png|video/mp4);base64,", attributes.get(name) or "#")
    assert any(NASTY in words for words in page.words)
    assert "default-src 'none'" in (page.of("meta")[2]["content"] or "")


def test_page_says_what_was_asked(page: Page) -> None:
    text = " ".join(page.words)
    for said in (
        "differential_drive: the iRobot Create", "control noise, std 0.2 m/s; force noise, std 5 N", "of seed 3",
        f"{TRIALS} of each combination, {TRIALS * 12} in all", "lqrsim 7", "an abacus", "lqrsim report 'runs/a test'",
    ):  # fmt: skip
        assert said in text
    assert "Not finished" not in text


def test_tables_hold_what_was_measured(page: Page, results: Results) -> None:
    one = results.table[Cell("open_loop", "measurements", 4.0)]
    assert (one.outcome == "reached").all()  # nothing is measured in open loop
    assert [
        "4",
        f"{int((results.table[Cell('smooth', 'measurements', 4.0)].outcome == 'reached').sum())}/{TRIALS}",
    ] in [[row[0], row[1].partition(",")[0]] for row in page.rows]
    assert f"{TRIALS}/{TRIALS}, all alike" in [value for row in page.rows for value in row]
    broken = results.table[Cell("open_loop", NASTY, 1.0)]
    assert ["open_loop", NASTY, "1"] in [row[:3] for row in page.rows]
    rms = np.quantile(broken.rms, 0.5, method="inverted_cdf")
    row = next(row for row in page.rows if row[:2] == ["open_loop", "1"])
    assert row[3].startswith(f"{rms:.3g} (")


def test_worst_trials_are_run_again_and_filmed(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not gl.available():
        pytest.skip("no OpenGL here")
    monkeypatch.setattr("lqrsim.view.report.FPS", 1)  # as fast as it gets
    told: list[tuple[int, int]] = []
    path = report(
        results, tmp_path / "a.html", videos=2, replay=again, progress=lambda done, total: told.append((done, total))
    )
    page = Page(path.read_text(encoding="utf-8"))
    films = page.of("video")
    assert len(films) == 2
    assert len({film["aria-label"] for film in films}) == 2
    for film in films:
        assert "controls" in film
        data = base64.b64decode((film["src"] or "").partition(",")[2])
        assert len(data) < 1_500_000
        (tmp_path / "film.mp4").write_bytes(data)
        with av.open(str(tmp_path / "film.mp4")) as video:
            stream = video.streams.video[0]
            assert (stream.width, stream.height, stream.average_rate) == (640, 360, 1)
    words = " ".join(page.words)
    assert re.search(r"lqrsim replay 'runs/a test' --cell open_loop '<script>.*' 4 --trial \d+", words)
    assert told == [(done, 4) for done in (0, 1, 2, 3, 4, 4)]


def test_page_says_why_there_are_no_videos(results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> None:
        raise ls.InputError("OpenGL: got none, want one")

    monkeypatch.setattr(gl, "bind", none)
    page = Page(report(results, tmp_path / "a.html", videos=1, replay=again).read_text(encoding="utf-8"))
    assert not page.of("video")
    assert "no pictures can be drawn here: OpenGL: got none" in " ".join(page.words)
    assert "lqrsim replay" in " ".join(page.words)


def test_page_of_what_has_not_ended(results: Results, tmp_path: Path) -> None:
    first, *_, last = results.table
    table = {first: results.table[first], last: replace(results.table[last])}
    table[last] = Outcomes(**{name: values[:5] for name, values in table[last].columns().items()})  # pyright: ignore[reportArgumentType]
    path = report(replace(results, table=table, complete=False), tmp_path / "a.html", videos=0)
    assert f"Not finished: {TRIALS + 5} of {2 * TRIALS} trials" in " ".join(Page(path.read_text()).words)


def test_trials_that_did_not_run_through_are_told(results: Results, tmp_path: Path) -> None:
    cell = Cell("smooth", NASTY, 1.0)
    outcome = results.table[cell].outcome.astype("<U9")
    outcome[:2] = "error"
    table = results.table | {cell: replace(results.table[cell], outcome=outcome)}
    page = Page(report(replace(results, table=table), tmp_path / "a.html", videos=0).read_text(encoding="utf-8"))
    assert "2 trials did not run through; they count as failures." in page.words


def test_bad_input_is_named(results: Results, tmp_path: Path) -> None:
    with pytest.raises(ls.InputError, match="no trial has ended yet"):
        report(replace(results, table={}), tmp_path / "a.html")
    with pytest.raises(ls.InputError, match="videos: got -1"):
        report(results, tmp_path / "a.html", videos=-1)
    with pytest.raises(ls.InputError, match=r"want --scenario mine\.py:make"):
        report(replace(results, campaign=Campaign(scenario="mine.py:make")), tmp_path / "a.html")
    assert list(tmp_path.iterdir()) == []

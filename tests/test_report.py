"""The page of a stress test: that it is whole, holds against what was measured, and needs nothing else."""

import base64
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import av
import numpy as np
import pytest

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.disturbances import ControlNoise, ForceNoise, MeasurementNoise
from lqrsim.reports import report
from lqrsim.stress.analysis import Outcomes
from lqrsim.stress.campaign import run_campaign
from lqrsim.stress.results import Results
from lqrsim.stress.study import Campaign, Cell
from lqrsim.view import gl

NASTY = '<script>alert("&")</script>'
SWEEPS = {
    NASTY: (ControlNoise(0.02), ForceNoise(0.2)),
    "measurements": (MeasurementNoise(0.03),),
}
STRENGTHS = (0.0, 1.0, 4.0)
TRIALS = 6


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    campaign = Campaign(
        scenario="quadrotor", sweeps=SWEEPS, strengths=STRENGTHS, policies=("smooth", "open_loop"),
        trials=TRIALS, seed=3, shard=5,
    )  # fmt: skip
    return run_campaign(campaign, tmp_path_factory.mktemp("campaigns") / "a test", workers=0)


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
def path(results: Results, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert report(results, path, videos=0) == path
    return path


@pytest.fixture(scope="module")
def page(path: Path) -> Page:
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
        "quadrotor: the quadrotor through a cage", "control noise, std 0.02 N; force noise, std 0.2 N", "of seed 3",
        f"{TRIALS} of each combination, {TRIALS * 12} in all", "numpy 2.", "lqrsim report '", "--resume",
    ):  # fmt: skip
        assert said in text
    assert "Not finished" not in text


def test_tables_hold_what_was_measured(page: Page, results: Results) -> None:
    one = results.outcomes(Cell("open_loop", "measurements", 4.0))
    assert (one.outcome == "reached").all()  # nothing is measured in open loop
    assert [
        "4",
        f"{int((results.outcomes(Cell('smooth', 'measurements', 4.0)).outcome == 'reached').sum())}/{TRIALS}",
    ] in [[row[0], row[1].partition(",")[0]] for row in page.rows]
    assert f"{TRIALS}/{TRIALS}, deterministic: 1 run" in [value for row in page.rows for value in row]
    broken = results.outcomes(Cell("open_loop", NASTY, 1.0))
    assert ["open_loop", NASTY, "1"] in [row[:3] for row in page.rows]
    rms = np.quantile(broken.rms, 0.5, method="inverted_cdf")
    row = next(row for row in page.rows if row[:2] == ["open_loop", "1"])
    assert row[3].startswith(f"{rms:.3g} (")


@pytest.mark.long
def test_worst_trials_are_run_again_and_filmed(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    monkeypatch.setattr("lqrsim.reports.FPS", 1)  # as fast as it gets
    told: list[tuple[int, int]] = []
    path = report(results, tmp_path / "a.html", videos=2, progress=lambda done, total: told.append((done, total)))
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
    assert re.search(r"lqrsim replay '.*/a test' --cell 'open_loop,<script>.*,4' --trial \d+", words)
    assert told == [(done, 4) for done in (0, 1, 2, 3, 4, 4)]


def test_page_says_why_there_are_no_videos(results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl, "missing", lambda: "OpenGL: got none, want one")
    page = Page(report(results, tmp_path / "a.html", videos=1).read_text(encoding="utf-8"))
    assert not page.of("video")
    assert "this machine cannot draw pictures: OpenGL: got none" in " ".join(page.words)
    assert "lqrsim replay" in " ".join(page.words)


def test_page_of_what_has_not_ended(results: Results, tmp_path: Path) -> None:
    folder = tmp_path / "part"
    shutil.copytree(results.folder, folder)
    gone = sorted((folder / "shards").iterdir())[1:]
    for shard in gone:
        shard.unlink()
    path = report(Results(folder), tmp_path / "a.html", videos=0)
    assert f"Not finished: 5 of {12 * TRIALS} trials" in " ".join(Page(path.read_text(encoding="utf-8")).words)
    (next((folder / "shards").iterdir())).unlink()
    with pytest.raises(ls.InputError, match="no trial has ended yet"):
        report(Results(folder), tmp_path / "b.html", videos=0)
    assert not (tmp_path / "b.html").exists()


def test_trials_that_did_not_run_through_are_told(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, given = Cell("smooth", NASTY, 1.0), results.outcomes

    def erred(one: Cell, *, partial: bool = False) -> Outcomes:
        found = given(one, partial=partial)
        return replace(found, outcome=np.array(["error", "error", *found.outcome[2:]])) if one == cell else found

    monkeypatch.setattr(results, "outcomes", erred)
    page = Page(report(results, tmp_path / "a.html", videos=0).read_text(encoding="utf-8"))
    assert "2 trials ended with an error; they count as failures." in page.words


def test_command_writes_the_page(
    results: Results, path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for page in (tmp_path / "page.html", tmp_path / "OTHER.HTML"):
        assert main(["report", str(results.folder), "--out", str(page), "--videos", "0"]) == 0
        assert str(page) in capsys.readouterr().out
        assert page.read_bytes() == path.read_bytes()
    for words in (["--out", "page.txt"], ["--videos", "-1"]):
        assert main(["report", str(results.folder), *words]) == 2
    assert main(["report", str(tmp_path)]) == 2

"""What results show of themselves in a notebook: well-formed, their numbers, and no text of a file as HTML."""

import base64
import pickle
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from linear_plans import double_integrator
from scipy.stats import binomtest

import lqrsim as ls
from lqrsim.results.solution_parts import Trajectory

SVG = "{http://www.w3.org/2000/svg}"


def parsed(html: str) -> ElementTree.Element:
    """As XML, which is stricter than any browser."""
    return ElementTree.fromstring(html)


def texts(page: ElementTree.Element) -> list[list[str]]:
    """The table, row by row."""
    return [["".join(cell.itertext()) for cell in row] for row in page.iter("tr")]


def points(line: ElementTree.Element) -> np.ndarray:
    return np.array([[float(number) for number in pair.split(",")] for pair in line.attrib["points"].split()])


@pytest.fixture(scope="module")
def solution() -> ls.Solution:
    return ls.smooth(ls.scenarios.differential_drive().problem)


@pytest.fixture(scope="module")
def rollout(solution: ls.Solution) -> ls.Rollout:
    plant = ls.scenarios.differential_drive().plant()
    return ls.simulate(
        plant, solution, disturbances=[ls.disturbances.ControlNoise(0.05)], seed=3, trials=12, first_trial=5
    )


def test_a_solution_shows_status_numbers_and_its_plan(solution: ls.Solution) -> None:
    page = parsed(solution._repr_html_())
    assert next(page.iter("strong")).text == "CONVERGED, smooth"
    table = dict(texts(page))
    assert table["cost"] == f"{solution.cost:.4g}"
    assert table["iterations"] == str(len(solution.iterations))
    assert solution.clearance is not None
    assert table["clearance"] == f"{solution.clearance.min():.4g} m"
    (line,) = page.iter(f"{SVG}polyline")
    drawn, places = points(line), solution.trajectory.states[:, :2]
    assert len(drawn) == len(places)
    # One scale for both axes, y up: lengths are those of the plan in one proportion.
    scale = np.max(np.ptp(drawn, axis=0) / np.ptp(places, axis=0))
    np.testing.assert_allclose(
        drawn - drawn[0], (places - places[0]) * [scale, -scale], atol=0.3
    )  # in tenths of pixels
    assert np.any(np.abs(np.ptp(drawn, axis=0) - [336, 216]) < 0.2)
    assert drawn.min() >= 0
    assert (drawn <= [360, 240]).all()
    ends = [(float(one.attrib["cx"]), float(one.attrib["cy"])) for one in page.iter(f"{SVG}circle")]
    np.testing.assert_array_equal(ends, drawn[[0, -1]])


def test_a_solution_that_failed_shows_its_remedy(solution: ls.Solution) -> None:
    failed = ls.smooth(ls.scenarios.differential_drive().problem, max_iterations=2)
    assert not failed.success
    html = failed._repr_html_()
    assert failed.status.name in html
    assert failed.remedy in "".join(parsed(html).itertext())
    nowhere = np.full_like(solution.trajectory.states, np.nan)
    plan = Trajectory(nowhere, solution.trajectory.controls, solution.trajectory.dt)
    broken = replace(solution, status=ls.Status.NOT_FINITE, trajectory=plan)
    assert "nan" not in broken._repr_html_().lower().replace(ls.Status.NOT_FINITE.meaning.lower(), "")
    parsed(broken._repr_html_())


def test_a_rollout_shows_its_trials_and_their_paths(rollout: ls.Rollout) -> None:
    page = parsed(rollout._repr_html_())
    head, *rows = texts(page)
    assert head[:3] == ["trial", "outcome", "ended"]
    assert [row[0] for row in rows] == [str(number) for number in range(5, 15)]
    assert [row[1] for row in rows] == list(rollout.outcome[:10])
    assert rows[2][4] == f"{rollout.goal_distance[2]:.4g} m"
    assert float(rows[4][3]) == pytest.approx(rollout.tracking_error[4, rollout.counts[4]].max(), rel=1e-3)
    assert len(list(page.iter(f"{SVG}polyline"))) == 1 + 10
    said = "".join(page.itertext())
    assert rollout.tally() in said
    assert "the first 10 of 12 trials are shown" in said


def test_states_are_drawn_over_time_without_a_position() -> None:
    still = double_integrator().solution
    plan = still.trajectory
    states = np.stack([np.cos(plan.times), 1e3 * np.sin(3 * plan.times)], axis=1)
    solution = replace(still, trajectory=Trajectory(states, plan.controls, plan.dt))
    page = parsed(solution._repr_html_())
    lines = list(page.iter(f"{SVG}polyline"))
    assert len(lines) == solution.trajectory.states.shape[1]
    for line, values in zip(lines, solution.trajectory.states.T, strict=True):
        heights = points(line)[:, 1]
        assert heights.argmin() == values.argmax()  # up is more
        np.testing.assert_allclose([heights.min(), heights.max()], [12, 228], atol=0.1)
    assert not list(page.iter(f"{SVG}circle"))


def test_results_show_a_row_for_each_cell(tmp_path: Path) -> None:
    campaign = ls.stress.Campaign(
        scenario="differential_drive", sweeps={"own": (ls.disturbances.ControlNoise(0.1),)}, strengths=(0, 2),
        policies=("smooth",), trials=4,
    )  # fmt: skip
    results = ls.stress.run_campaign(campaign, tmp_path / "there", workers=0)
    page = parsed(results._repr_html_())
    head, *rows = texts(page)
    assert len(rows) == len(results.cells)
    for row, cell in zip(rows, results.cells, strict=True):
        shown, ends = dict(zip(head, row, strict=True)), results.outcomes(cell)
        assert (shown["sweep"], float(shown["strength"]), shown["policy"]) == (cell.sweep, cell.strength, cell.policy)
        assert shown["trials"] == "4"
        assert float(shown["success"]) == pytest.approx(np.mean(ends.outcome == "reached"), abs=5e-4)
        low, high = binomtest(int(np.sum(ends.outcome == "reached")), 4).proportion_ci(0.95)
        assert (shown["low"], shown["high"]) == ((f"{low:.3f}", f"{high:.3f}") if cell.strength else ("", ""))
        assert int(shown["collided"]) == np.sum(ends.outcome == "collided")
    next((tmp_path / "there" / "shards").iterdir()).unlink()
    unfinished = parsed(ls.stress.Results(tmp_path / "there")._repr_html_())
    assert "not finished: 4 of 8 trials are missing" in "".join(unfinished.itertext())


def test_a_video_and_a_picture_show_themselves(rollout: ls.Rollout, tmp_path: Path) -> None:
    options = {"size": (480, 270), "quality": "draft"}
    for path, tag, kind in (
        (ls.render(rollout, tmp_path / "run.mp4", fps=1, **options), "video", "video/mp4"),
        (ls.render(rollout, tmp_path / "run.png", **options), "img", "image/png"),
    ):
        shown = parsed(path._repr_html_() or "")
        assert shown.tag == tag
        start, data = shown.attrib["src"].split(",")
        assert start == f"data:{kind};base64"
        assert base64.b64decode(data) == path.read_bytes()
        # It is a path like any other.
        assert path == Path(path)
        assert pickle.loads(pickle.dumps(path)) == path
        assert (path.parent / path.name).is_file()
        path.unlink()
        assert path._repr_html_() is None


def test_text_of_files_is_escaped(solution: ls.Solution, rollout: ls.Rollout) -> None:
    bad = "<script>alert(1)</script>&\"'"
    assert "<script" not in replace(solution, detail=bad, solver=bad)._repr_html_()
    assert "<script" not in replace(rollout, robot=bad, scene=bad, disturbances=(bad,))._repr_html_()
    space = replace(solution.policy.state_coordinates, names=(bad, "y", "heading"), plane="xy")
    named = replace(solution, policy=replace(solution.policy, state_coordinates=space))
    page = parsed(named._repr_html_())
    assert any(bad in (title.text or "") for title in page.iter(f"{SVG}title"))

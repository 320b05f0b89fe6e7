"""Comparisons of campaigns, against what their trials are, with SciPy's tests."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.stress.statistics import independent_difference, paired_difference

fisher: Any = stats.fisher_exact  # whose stubs do not know its result
Folders = dict[str, ls.stress.Results]
NOISE = (ls.disturbances.ForceNoise(0.15),)  # without feedback, some flights fail


@pytest.fixture(scope="module")
def campaigns(
    tmp_path_factory: pytest.TempPathFactory, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> Folders:
    """Two policies; the same with more trials of one of them; with another seed; with another plan."""
    folder = tmp_path_factory.mktemp("campaigns")
    first = ls.stress.Campaign(
        scenario="quadrotor", sweeps={"noise": NOISE, "late": (ls.disturbances.MeasurementLatency(1),)},
        strengths=(1.0, 2.0), policies=("smooth", "open_loop"), trials=12, solution=quadrotor_solution,
    )  # fmt: skip
    plan = ls.smooth(dataclasses.replace(quadrotor.problem, initial=ls.FixedState(quadrotor.problem.start)))
    made = {
        "first": first,
        "longer": dataclasses.replace(first, policies=("open_loop",), trials=15),
        "seed": dataclasses.replace(first, seed=1, policies=("smooth",), trials=14),
        "plan": dataclasses.replace(first, solution=plan),
    }
    return {name: ls.stress.run_campaign(asked, folder / name, workers=0) for name, asked in made.items()}


def stated(results: ls.stress.Results, **changed: Any) -> ls.stress.Results:
    """The same as if its manifest said something else: what cannot be compared is refused before trials are read."""
    other = ls.stress.Results(results.folder)
    other.manifest = dataclasses.replace(other.manifest, campaign={**other.manifest.campaign, **changed})
    return other


def columns_of(table: ls.types.DataTable) -> dict[str, Any]:
    return dict(table.columns)


def reached(results: ls.stress.Results, policy: str, sweep: str, strength: float) -> Any:
    return results.outcomes(ls.stress.Cell(policy, sweep, strength)).outcome == "reached"


def adjusted(p_values: list[float]) -> list[float]:
    """Holm's, by its definition: each is raised by the number of those that are not smaller."""
    return [
        max(min(sum(q >= other for q in p_values) * other, 1.0) for other in p_values if other <= p) for p in p_values
    ]


@pytest.mark.parametrize(
    ("first", "second", "policies"),
    [("first", None, ("smooth", "open_loop")), ("first", "longer", None), ("first", "plan", None)],
)
def test_trials_of_the_same_seed_are_paired(
    campaigns: Folders, first: str, second: str | None, policies: tuple[str, str] | None
) -> None:
    """Rates and pairs are counted here, over the first 12 trials; p is SciPy's, of those that differ."""
    one, other = campaigns[first], campaigns[second or first]
    table = ls.stress.compare(one, None if second is None else other, policies=policies)
    columns, tests = columns_of(table), []
    shared = ("open_loop",) if second == "longer" else ("smooth", "open_loop")
    pairs = [policies] if policies else [(policy, policy) for policy in shared]
    wanted = [(s, x, pair) for s in ("noise", "late") for x in (1.0, 2.0) for pair in pairs]
    assert list(zip(columns["sweep"], columns["strength"], strict=True)) == [(s, x) for s, x, _ in wanted]
    assert columns["policy"] == tuple("smooth against open_loop" if a != b else a for _, _, (a, b) in wanted)
    for row, (sweep, strength, (a, b)) in enumerate(wanted):
        won, also = reached(one, a, sweep, strength), reached(other, b, sweep, strength)[:12]
        assert columns["trials"][row] == len(won) == 12
        assert (columns["first success"][row], columns["second success"][row]) == (won.mean(), also.mean())
        apart = int((won & ~also).sum()), int((also & ~won).sum())
        assert (columns["only first"][row], columns["only second"][row]) == apart
        assert columns["difference"][row] == pytest.approx(won.mean() - also.mean(), abs=1e-15)
        sure = paired_difference(*apart, 12)
        interval = (None, None) if sweep == "late" else (sure.low, sure.high)  # nothing is drawn: one run
        assert (columns["low"][row], columns["high"][row]) == interval
        if sweep != "late":
            tests.append(float(stats.binomtest(apart[0], sum(apart)).pvalue) if sum(apart) else 1.0)
    np.testing.assert_allclose([p for p in columns["p"] if p is not None], adjusted(tests), rtol=1e-12)
    assert len(tests) == len(wanted) / 2
    assert "paired" in table.notes[-1]
    assert any("differ in solution" in note or "solution" in note for note in table.notes) == (second == "plan")


def test_trials_of_different_seeds_are_not_paired(campaigns: Folders) -> None:
    one, other = campaigns["first"], campaigns["seed"]
    table = ls.stress.compare(one.folder, other.folder)
    columns, tests = columns_of(table), []
    assert "only first" not in columns
    assert set(columns["first trials"]) == {12}
    assert set(columns["second trials"]) == {14}
    cells = zip(*(columns[name] for name in ("policy", "sweep", "strength")), strict=True)
    for row, (policy, sweep, strength) in enumerate(cells):
        if sweep == "noise":
            won, also = (reached(results, policy, sweep, strength) for results in (one, other))
            counts = (int(won.sum()), 12), (int(also.sum()), 14)
            sure, _ = independent_difference(*counts)
            assert (columns["low"][row], columns["high"][row]) == (sure.low, sure.high)
            tests.append(float(fisher([[k, n - k] for k, n in counts]).pvalue))
    np.testing.assert_allclose([p for p in columns["p"] if p is not None], adjusted(tests), rtol=1e-12)
    assert "independent" in table.notes[-1]


def test_a_comparison_with_itself_finds_nothing(campaigns: Folders) -> None:
    columns = columns_of(ls.stress.compare(campaigns["first"], campaigns["first"]))
    assert sorted(columns["policy"]) == ["open_loop"] * 4 + ["smooth"] * 4
    assert set(columns["difference"]) == {0.0}
    assert set(columns["p"]) == {1.0, None}
    assert all(low is None or low < 0 for low in columns["low"])


def test_the_order_turns_the_signs_around(campaigns: Folders) -> None:
    orders = ("smooth", "open_loop"), ("open_loop", "smooth")
    there, back = (columns_of(ls.stress.compare(campaigns["first"], policies=order)) for order in orders)
    for one, other in (("low", "high"), ("high", "low"), ("difference", "difference")):
        assert [None if x is None else -x for x in there[one]] == [
            None if x is None else pytest.approx(x, abs=1e-15) for x in back[other]
        ]
    assert there["p"] == back["p"]


def test_the_command_prints_and_writes_it(
    campaigns: Folders, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, plan = (str(campaigns[name].folder) for name in ("first", "plan"))
    table, path = ls.stress.compare(first, plan), tmp_path / "difference.csv"
    assert main(["compare", first, "--with", plan, "--out", str(path)]) == 0
    assert capsys.readouterr().out == f"{table}\nwrote {path}\n"
    assert path.read_text(encoding="utf-8") == table.csv()
    assert main(["compare", first, "--policies", "smooth", "open_loop", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    columns = ls.stress.compare(first, policies=("smooth", "open_loop")).columns
    assert found["cells"] == [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    assert main(["compare", first, "--with", plan, "--out", "a.xlsx"]) == 2
    assert "--out: got 'a.xlsx', want a name that ends in .csv, .tex, .md" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda made: ls.stress.compare(made["first"]), "policies: got None, want two policies, or another campaign"),
        (lambda made: ls.stress.compare(made["first"], policies=("smooth",)), r"policies: got \('smooth',\), want two"),
        (
            lambda made: ls.stress.compare(made["first"], policies=("smooth", "track")),
            "policies: got 'track', want one of: smooth, open_loop",
        ),
        (
            lambda made: ls.stress.compare(made["seed"], stated(made["first"], sweeps={"noise": [], "late": []})),
            "second: got other disturbances in the sweep 'noise', want those of the first",
        ),
        (
            lambda made: ls.stress.compare(made["first"], stated(made["first"], goal_radius=0.05)),
            "second: goal_radius: got 0.05, want None",
        ),
        (
            lambda made: ls.stress.compare(made["seed"], made["longer"]),
            "second: got cells from open_loop,noise,1 to open_loop,late,2, want",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(
    campaigns: Folders, call: Callable[[Folders], object], message: str
) -> None:
    with pytest.raises(ls.InputError, match=message):
        call(campaigns)

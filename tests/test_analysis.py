"""The answers of a stress test, on tables small enough to be worked out by hand, and on tables with known rates."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

import lqrsim as ls
from lqrsim.stress import statistics
from lqrsim.stress.analysis import Outcomes, breaks, comparisons, modes, quantiles, worst
from lqrsim.stress.study import Cell


@dataclass(frozen=True)
class Unmoved(ls.disturbances.Disturbance):
    """A user's: whether it draws during a run is not known."""

    def scaled(self, strength: float) -> "Unmoved":
        return self

    def start(self, plant: Any, plan: Any, generators: Any) -> ls.disturbances.Effect:
        return ls.disturbances.Effect()


def table_of(outcome: Sequence[str], *, first: int = 0, **columns: ArrayLike) -> Outcomes:
    count = len(outcome)
    over = np.isin(outcome, ("collided", "diverged", "error"))
    given: dict[str, ArrayLike] = {
        "obstacle": ["post" if one == "collided" else "" for one in outcome],
        "ended": np.where(over, 1.0, 5.0), "worst": 0.1 + 0.001 * np.arange(count), "rms": 0.05,
        "final": np.where(over, np.nan, 0.02), "clearance": np.where(over, -0.01, 0.3), "effort": 1.0,
        "goal": np.where(over, np.nan, 0.02), "saturated": 0.0, "cost": np.where(over, np.nan, 2.0),
    }  # fmt: skip
    deterministic = bool(columns.pop("deterministic", False))
    filled = {name: np.broadcast_to(values, count).copy() for name, values in (given | columns).items()}
    return Outcomes(
        deterministic=deterministic, trial=np.arange(first, first + count), outcome=np.array(outcome), **filled
    )  # pyright: ignore[reportArgumentType]


def mixed(reached: int, trials: int) -> Outcomes:
    return table_of(["reached"] * reached + ["collided"] * (trials - reached))


def test_rates_have_exact_intervals() -> None:
    none, some = mixed(0, 300).success, mixed(285, 300).success
    assert (none.reached, some.reached) == (0, 285)
    assert none.exact.high == pytest.approx(1 - 0.025 ** (1 / 300), rel=1e-9)
    # Wilson's interval lies within that of Clopper and Pearson here.
    assert some.exact.low < some.band.low < 0.95 < some.band.high < some.exact.high


def test_trials_that_are_all_alike_are_no_sample() -> None:
    """Without a disturbance 200 trials are one, as is a single trial; an interval would be of nothing."""
    cells = Cell("smooth", "calm", 0.0), Cell("open_loop", "calm", 0.0)
    for trials in (1, 2, 200):
        same = [table_of([end] * trials, worst=0.1, deterministic=True) for end in ("reached", "collided")]
        found = same[0].success
        assert found.alike
        assert (found.exact.low, found.exact.high) == (1.0, 1.0)
        assert comparisons(dict(zip(cells, same, strict=True))) == []
    for trials in (1, 3):
        assert not table_of(["error"] * trials, worst=0.1, ended=np.nan, deterministic=True).success.alike


@pytest.mark.parametrize("seed", range(8))
def test_equal_outcomes_of_random_trials_are_a_sample(seed: int) -> None:
    """Exact intervals: of n successes 0.025^(1/n) to 1, and of n failures 0 to 1 - 0.025^(1/n)."""
    rng = np.random.default_rng(seed)
    trials, strength, won = int(rng.integers(1, 300)), rng.uniform(0.1, 3), bool(seed % 2)
    cells = Cell("smooth", "losses", strength), Cell("open_loop", "losses", strength)
    drawn = table_of(["reached" if won else "timed out"] * trials, worst=0.1)
    found = drawn.success
    low, high = found.exact.low, found.exact.high
    edge = 0.025 ** (1 / trials)
    assert (low, high) == pytest.approx((edge, 1.0) if won else (0.0, 1 - edge), rel=1e-9)
    assert not found.alike
    assert len(comparisons(dict.fromkeys(cells, drawn))) == 1
    if not won:  # broken only if that is sure
        assert (breaks({cells[0]: drawn}, below=0.5)[0][2] is None) == (1 - edge >= 0.5)
    fixed = replace(drawn, deterministic=True)
    assert fixed.success.alike
    assert comparisons(dict.fromkeys(cells, fixed)) == []
    assert not table_of(["reached"] * trials, deterministic=True).success.alike  # they differ
    with pytest.raises(ls.InputError, match="deterministic: got 'yes'"):
        replace(drawn, deterministic="yes")


def test_a_campaign_knows_which_cells_are_random(tmp_path: Path) -> None:
    """Two trials of each; no command is lost in them."""
    kinds = ls.disturbances
    campaign = ls.stress.Campaign(
        scenario="differential_drive",
        sweeps={
            "losses": (kinds.CommandDropouts(1e-5),), "late": (kinds.MeasurementLatency(1),),
            "both": (kinds.MeasurementLatency(1), kinds.CommandDropouts(1e-5)), "still": (Unmoved(),),
        },
        strengths=(0.0, 1.0), policies=("smooth",), trials=2,
    )  # fmt: skip
    results = ls.stress.run_campaign(campaign, tmp_path, workers=0)
    summaries = results.cell_summaries().items()
    found = {(cell.sweep, cell.strength): one.success for cell, one in summaries if one.success is not None}
    assert {key: one.alike for key, one in found.items() if key[1]} == {
        ("losses", 1.0): False, ("late", 1.0): True, ("both", 1.0): False, ("still", 1.0): False,
    }  # fmt: skip
    assert all(one.alike for key, one in found.items() if not key[1])
    assert found["losses", 1.0].exact.low == pytest.approx(0.025**0.5)
    again = ls.stress.Results(tmp_path)
    assert [again.outcomes(cell).deterministic for cell in again.cells] == [one.alike for one in found.values()]


def test_what_breaks_first_is_sure_to_be_below_the_rate() -> None:
    """Of 200, 190 are 95 %, and 185 could still be (interval up to 96 %); 180 could not (up to 93.8 %)."""
    rates = {"strong": (200, 200, 190), "weak": (200, 185, 180), "weaker": (200, 180, 20)}
    table = {
        Cell(policy, "wind", strength): mixed(reached, 200)
        for policy, of_strength in rates.items()
        for strength, reached in zip((0.0, 1.0, 2.0), of_strength, strict=True)
    }
    found = breaks(table)
    strengths = [(policy, cell and cell.strength) for policy, _, cell in found]
    assert strengths == [("weaker", 1.0), ("weak", 2.0), ("strong", None)]
    assert found[0][2] is not None
    assert table[found[0][2]].success.exact.high < 0.95
    assert [cell and cell.strength for *_, cell in breaks(table, below=1.0)] == [1.0, 1.0, 2.0]


def test_policies_are_compared_on_the_same_trials() -> None:
    """Of ten trials three are won by the first alone, one by the second; rms differs by 0.02 m where both reached."""
    won = ["reached"] * 9 + ["collided"]
    lost = ["reached"] * 6 + ["timed out"] * 3 + ["reached"]
    first, second = Cell("smooth", "wind", 1.0), Cell("open_loop", "wind", 1.0)
    one = comparisons({first: table_of(won, rms=0.03), second: table_of(lost, rms=0.05)})[0]
    assert (one.only_first, one.only_second, one.both) == (3, 1, 6)
    assert one.success.value == pytest.approx(0.2)
    assert one.success.low < 0 < one.success.high
    assert one.rms is not None
    np.testing.assert_allclose((one.rms.value, one.rms.low, one.rms.high), -0.02, rtol=1e-12)
    with pytest.raises(ls.InputError, match="want the same trials in the same order"):
        comparisons({first: table_of(won), second: table_of(lost, first=10)})


def test_a_difference_has_an_interval_also_where_no_trial_tells_two_policies_apart() -> None:
    """Of 20 trials that both reach, a difference of 1 % is seen one time in five: it must not be ruled out."""
    cells = Cell("a", "s", 1.0), Cell("b", "s", 1.0)
    for one, other in ((20, 20), (20, 0)):
        found = comparisons(dict(zip(cells, (mixed(one, 20), mixed(other, 20)), strict=True)))[0].success
        assert found.value == (one - other) / 20
        assert found.high - found.low > 0.1


def test_several_comparisons_raise_the_p_values() -> None:
    table = {Cell("a", "s", strength): mixed(20, 20) for strength in (1.0, 2.0)}
    table |= {Cell("b", "s", 1.0): mixed(10, 20), Cell("b", "s", 2.0): mixed(14, 20)}
    first, second = comparisons(table)
    assert first.adjusted == pytest.approx(2 * first.p_value)
    assert second.adjusted == pytest.approx(second.p_value)


def test_failure_modes_are_counted_by_outcome_and_obstacle() -> None:
    outcome = ["reached", "collided", "collided", "diverged", "collided", "error"]
    found = modes(table_of(outcome, obstacle=["", "b", "a", "", "b", ""]))
    assert list(found.items()) == [
        (("collided", "b"), 2), (("collided", "a"), 1), (("diverged", ""), 1), (("error", ""), 1)
    ]  # fmt: skip


def test_quantiles_are_of_those_that_have_the_measure() -> None:
    outcomes = table_of(["reached"] * 3 + ["collided"], final=[1.0, 2.0, 3.0, np.nan], clearance=np.inf)
    np.testing.assert_array_equal(quantiles(outcomes, "final"), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(quantiles(outcomes, "clearance"), np.inf)
    assert np.isnan(quantiles(table_of(["error"], final=np.nan), "final")).all()


def test_worst_trials_are_ranked_as_it_says() -> None:
    weak = table_of(
        ["reached", "collided", "timed out", "collided", "reached"],
        ended=[5, 2.0, 5, 1.0, 5], clearance=[0.1, -0.1, 0.2, -0.01, 0.1], worst=[0.3, 0.1, 0.1, 0.1, 0.4],
    )  # fmt: skip
    strong = table_of(["diverged", "error"], first=7, ended=[1.5, np.nan], clearance=np.nan)
    cells = Cell("p", "s", 1.0), Cell("p", "s", 2.0)
    found = worst(dict(zip(cells, (weak, strong), strict=True)))
    assert [(one.cell.strength, one.trial) for one in found] == [
        (2.0, 8), (1.0, 3), (2.0, 7), (1.0, 1), (1.0, 4), (1.0, 0), (1.0, 2)
    ]  # fmt: skip
    assert (found[1].outcome, found[1].obstacle, found[1].ended) == ("collided", "post", 1.0)
    assert len(worst({cells[0]: weak}, 2)) == 2


def test_bad_input_is_named() -> None:
    table = {Cell("smooth", "wind", 1.0): mixed(1, 2)}
    with pytest.raises(ls.InputError, match="measure: got 'speed'"):
        quantiles(table[Cell("smooth", "wind", 1.0)], "speed")
    with pytest.raises(ls.InputError, match="below: got 2"):
        breaks(table, below=2)


WRONG = [None, "x", 3, -1, 1.5, np.nan, [], {}, {"a": 1}, ["a"], [[1], [2, 3]], np.zeros((2, 2)), object(), 10**400, 1j]


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (breaks, {"table": {Cell("a", "s", 1.0): mixed(3, 5)}, "below": 0.9}),
        (comparisons, {"table": {Cell("a", "s", 1.0): mixed(3, 5)}}),
        (modes, {"outcomes": mixed(3, 5)}),
        (quantiles, {"outcomes": mixed(3, 5), "measure": "rms", "levels": (0.1, 0.5)}),
        (worst, {"table": {Cell("a", "s", 1.0): mixed(3, 5)}, "count": 2}),
        (statistics.rate, {"successes": 3, "trials": 5, "confidence": 0.9}),
        (statistics.compare, {"first": [True, False], "second": [True, True]}),
        (statistics.paired_difference, {"only_first": 1, "only_second": 2, "trials": 5, "confidence": 0.9}),
        (statistics.mean, {"sample": [1.0, 2.0]}),
        (statistics.holm, {"p_values": [0.1, 0.2]}),
    ],
)  # fmt: skip
def test_arguments_of_the_wrong_kind_raise_no_other_exception(function: Any, arguments: dict[str, Any]) -> None:
    function(**arguments)
    for name in arguments:
        for wrong in WRONG:
            with contextlib.suppress(ls.InputError):  # some of them are right for some arguments
                function(**{**arguments, name: wrong})

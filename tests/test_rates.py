"""Factor and order of sequences of which both are known."""

import json
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lqrsim as ls

rates = import_module("paper.rates")


def costs(first: float, factor: float, order: float = 1.0) -> np.ndarray:
    """Of a run whose errors are `e[k+1] = factor e[k]^order`, until rounding stops it; the optimum costs 3."""
    errors = [first]
    while errors[-1] > 1e-17:
        errors.append(factor * errors[-1] ** order)
    return 3 * (1 + np.array([*errors, 0.0, 0.0]))


@pytest.mark.parametrize("factor", [0.05, 0.5, 0.9])
def test_a_constant_factor(factor: float) -> None:
    """1e-4, for next to 1e-13 costs have three digits left."""
    found = rates.rate(costs(0.5, factor))
    assert found.order == pytest.approx(1, abs=1e-4)
    assert found.factor == pytest.approx(factor, rel=1e-4)


@pytest.mark.parametrize("order", [1.2, 1.5])
def test_an_order_over_one(order: float) -> None:
    assert rates.rate(costs(0.3, 1.0, order)).order == pytest.approx(order, abs=1e-3)


def test_second_order_is_either_seen_or_too_fast_to_have_an_order() -> None:
    """It squares what is left: of ten decades it leaves two errors, or three if it begins just inside."""
    assert rates.rate(costs(9e-4, 1.0, 2.0)).order == pytest.approx(2, abs=1e-2)
    for first in (0.1, 0.3, 0.5):
        assert len(rates.tail(costs(first, 1.0, 2.0))) < rates.FEWEST
        assert np.isnan(rates.rate(costs(first, 1.0, 2.0)).order)


def test_the_tail_begins_where_errors_stay_small_and_ends_where_the_last_change_counts() -> None:
    errors = np.array([1.0, 1e-4, 0.1, 5e-4, 1e-5, 2e-7, 1e-9, 0.0])
    np.testing.assert_allclose(rates.tail(1 + errors), [5e-4, 1e-5, 2e-7], rtol=1e-6)


def test_second_order_would_be_noticed() -> None:
    """The statements on the order, of runs that were too fast to have one and of runs of which it is known."""
    script = import_module("convergence")
    published = Path(__file__).parent.parent / "docs" / "results.json"
    result = json.loads(published.read_text(encoding="utf-8"))["results"]["convergence"]["result"]
    settling = import_module("paper.settling")
    for run, seen in ((costs(0.3, 1.0, 2.0), True), (costs(9e-4, 1.0, 2.0), True), (costs(0.3, 0.5), False)):
        log = [SimpleNamespace(cost=cost) for cost in run]
        solvers = script.SMOOTHING, script.ILQR, script.FINISHED
        cases = {case: dict.fromkeys(solvers, log) for case in (script.WITH, script.WITHOUT)}
        queries = 3 * [SimpleNamespace(logs=cases)]
        result["rates"] = {
            case: {who: script.rates(queries, case, who) for who in logs} for case, logs in cases.items()
        }
        left = np.array([1e-2, 1e-4, 1e-8]) if seen else np.array([1e-2, 1e-3, 1e-4])
        result["settling"] = {"one": settling.order(left)}
        said = {one.paper: one.holds for one in script.statements(result)}
        assert said["second order was not observed, for neither iLQR nor smoothing"] != seen
        assert said["the rate of the iterations, Gauss-Newton updates, approaches second order"] == seen
        finished = "second order was not observed; Newton's method at the end has it"
        assert said[finished] == seen
        interior = "second order was not observed; the interior point has it where constraints act"
        assert said[interior] == seen


def test_the_interior_point_settles_by_newtons_steps() -> None:
    """A pendulum with a torque at its limits: each error is about the square of the one before, which Gauss-Newton's
    would not be."""
    settling = import_module("paper.settling")
    (found,) = (
        settling.errors(problem, ls.smooth(problem, start=start), np.random.default_rng(1))
        for name, problem, start in settling.problems(0)
        if name == "pendulum"
    )
    assert settling.order(found) > 1.4
    assert found[0] > 1e-3
    assert found[4] < 1e-12

"""The problems of `experiments/optimal_control_problems.py`, and how their plans are recomputed."""

from dataclasses import replace

import numpy as np
import optimal_control_problems as experiment
import pytest

import lqrsim as ls


def test_catalysts_are_mixed_as_well_as_published() -> None:
    """The published cost is that of collocation in 100 intervals; on half of them 1e-6 of it is left."""
    case = experiment.CASES["catmix"]
    problem = case.problem(50)
    found = experiment.worth(case, problem, ls.smooth(problem, threads=1).trajectory)
    assert found["cost"] == pytest.approx(case.published, abs=1e-5)
    assert found["exact_cost"] == pytest.approx(found["cost"], abs=1e-6)  # of RK4 with a step of 0.02
    assert found["missed"] == 0.0


def test_costs_and_violations_are_recomputed() -> None:
    """A beam bent by no force, from a plan written by hand: a line, off its bounds and its goal."""
    case = replace(experiment.CASES["beam"], steps=10)
    problem = case.problem(10)
    states = np.column_stack([np.linspace(0, 1, 11), np.ones(11)])
    found = experiment.worth(case, problem, ls.Trajectory(states, np.full((10, 1), 2.0), problem.dt))
    assert found["cost"] == pytest.approx(4.0)  # the integral of 2^2
    assert found["missed"] == pytest.approx(2.0)  # a slope of 1 where -1 is wanted
    assert found["exact_missed"] == pytest.approx(4.0)  # whose force leads to 3


def test_costs_are_those_of_the_problem() -> None:
    """A mean over the time and the price of a free duration, by the problem and by the experiment."""
    case = experiment.CASES["ducted_fan"]
    plan = ls.Trajectory(np.zeros((11, 6)), np.tile([1.0, 3.0], (10, 1)), 0.2)
    assert experiment.worth(case, case.problem(10), plan)["cost"] == pytest.approx(2 + 9 + 2 * 1000)

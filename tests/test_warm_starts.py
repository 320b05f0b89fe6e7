"""Starts that come from an earlier solution: of the same problem, or of one whose horizon has moved along."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from comparing import fixed, same

import lqrsim as ls
from lqrsim.results.solution_parts import Status


@pytest.mark.parametrize("kind", [fixed, replace], ids=["fixed", "soft"])
def test_from_its_own_solution_it_is_there(differential_drive, kind: Any) -> None:
    problem = kind(differential_drive.problem)
    solution = ls.smooth(problem)
    again = ls.smooth(problem, start=solution)
    assert again.status is Status.CONVERGED
    assert len(again.iterations) <= 2
    np.testing.assert_allclose(again.trajectory.states, solution.trajectory.states, rtol=0, atol=2e-3)
    assert again.cost == pytest.approx(solution.cost, rel=1e-5)


def test_from_a_re_plan(differential_drive) -> None:
    problem = fixed(differential_drive.problem)
    solution = ls.smooth(problem)
    replan = ls.prepare(problem).solve(np.array(problem.start), solution)
    again = ls.smooth(problem, start=replan)
    assert again.success
    assert len(again.iterations) <= 2
    assert again.cost == pytest.approx(solution.cost, rel=1e-6)
    np.testing.assert_array_equal(replan.goal, solution.goal)
    assert replan.goal_radius == solution.goal_radius


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_a_horizon_that_moves_along_to_another_goal(differential_drive, steps: int) -> None:
    before = ls.smooth(fixed(differential_drive.problem))
    goal = ls.QuadraticCost((5000.0, 5000.0, 50.0), about=(0.1, 2.6, np.pi))
    here = ls.FixedState(before.trajectory.states[steps])
    problem = replace(differential_drive.problem, initial=here, final_cost=goal)
    warm, cold = ls.smooth(problem, start=before.shifted(steps)), ls.smooth(problem)
    assert warm.status is Status.CONVERGED
    assert len(warm.iterations) < len(cold.iterations)
    further = ls.ilqr(problem, start=warm.trajectory, tolerance=1e-9)
    assert warm.cost == pytest.approx(further.cost, rel=1e-3)


def test_what_is_left_of_it(drive_solution) -> None:
    """The same laws, later; at the end the last ones stay."""
    later, total = drive_solution.shifted(4), drive_solution.trajectory.steps
    for one, other in (
        (later.policy.gain, drive_solution.policy.gain),
        (later.policy.offset, drive_solution.policy.offset),
        (later.trajectory.controls, drive_solution.trajectory.controls),
        (later.trajectory.states, drive_solution.trajectory.states),
        (later.cost_to_go.hessian, drive_solution.cost_to_go.hessian),  # pyright: ignore[reportOptionalMemberAccess]
    ):
        assert one.shape == other.shape
        np.testing.assert_array_equal(one[:-4], other[4:])
        np.testing.assert_array_equal(one[-4:], np.broadcast_to(other[-1], one[-4:].shape))
    state = drive_solution.trajectory.states[30]
    dt = drive_solution.trajectory.dt
    np.testing.assert_array_equal(later.policy(state, 26 * dt), drive_solution.policy(state, 30 * dt))
    assert same(drive_solution.shifted(0), drive_solution)
    for steps in (-1, total, 1.5, True, None):
        with pytest.raises(ls.InputError, match=r"steps: got .*, want"):
            drive_solution.shifted(steps)  # pyright: ignore[reportArgumentType]

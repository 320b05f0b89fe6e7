"""When a run's tube is predicted, and why not where it is not."""

import dataclasses

import numpy as np
import pytest

import lqrsim as ls
from lqrsim.commands.solving import tube_under
from lqrsim.disturbances import ControlDelay, ControlNoise, MeasurementLatency, MeasurementNoise, Push

NOISE = ControlNoise(0.05)


def test_what_the_linear_model_does_not_have_is_said_in_one_line(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    problem, plant = differential_drive.problem, differential_drive.plant()
    elsewhere = ls.FixedState(drive_solution.trajectory.states[0] + 0.1)
    another = ls.smooth(dataclasses.replace(problem, initial=elsewhere))
    plan = drive_solution.trajectory
    moved = dataclasses.replace(drive_solution, trajectory=dataclasses.replace(plan, controls=plan.controls + 0.01))
    told = ls.uncertainty_of(plant, [NOISE])
    cases = {
        "an OffsetFree or an AffinePolicy": (
            [NOISE],
            ls.Replanner(problem, drive_solution, every=1.0),
        ),
        "an OffsetFree of another plan": ([NOISE], ls.OffsetFree(problem, another, told)),
        "want one of the solution": ([NOISE], ls.OffsetFree(problem, moved, told)),
    }
    for word, (disturbances, controller) in cases.items():
        tube, line = tube_under(problem, drive_solution, plant, disturbances, controller)
        assert tube is None
        assert line.startswith("no predicted tube: ")
        assert word in line
        assert "\n" not in line
    assert tube_under(problem, drive_solution, plant, []) == (None, "")


def test_latency_and_delay_are_in_the_sampled_trials(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """A late law follows worse: each tube is wider than the punctual one, by over four standard errors of the ratio."""
    problem, plant = differential_drive.problem, differential_drive.plant()
    now, _ = tube_under(problem, drive_solution, plant, [NOISE])
    assert now is not None
    for late in (MeasurementLatency(4), ControlDelay(4)):
        tube, _ = tube_under(problem, drive_solution, plant, [NOISE, late])
        assert tube is not None
        assert tube.samples > 0
        wider = tube.position_covariance[:, 0, 0].max() / now.position_covariance[:, 0, 0].max()
        assert wider > 1 + 4 * np.sqrt(4 / tube.samples)  # a variance's relative error is the root of 2 / samples


def test_what_is_left_out_is_named_and_the_rest_is_predicted(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    problem, plant = differential_drive.problem, differential_drive.plant()
    tube, line = tube_under(problem, drive_solution, plant, [NOISE])
    assert tube is not None
    assert line == ""
    pushed, line = tube_under(problem, drive_solution, plant, [NOISE, Push((1, 0, 0), at=2.0)])
    assert pushed is not None
    assert line.startswith("the predicted tube leaves out push of (1, 0, 0) N s at 2 s")
    np.testing.assert_array_equal(tube.covariance, pushed.covariance)
    told = ls.OffsetFree(problem, drive_solution, ls.uncertainty_of(plant, [NOISE]))
    filtered, line = tube_under(problem, drive_solution, plant, [NOISE], told)
    assert filtered is not None
    assert line == ""
    assert filtered.estimate_covariance is not None


def test_a_tube_is_added_to_runs_of_its_plan_alone(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    problem, plant = differential_drive.problem, differential_drive.plant()
    tube, _ = tube_under(problem, drive_solution, plant, [NOISE])
    assert tube is not None
    run = ls.simulate(plant, drive_solution, disturbances=[NOISE], frames=False)
    assert run.tube is run.collision_chance is None
    with_tube = tube.added_to(run)
    assert with_tube.tube is not None
    np.testing.assert_array_equal(with_tube.tube, tube.covariance[:, :2, :2])
    np.testing.assert_array_equal(with_tube.collision_chance, tube.step_chance)
    moved = dataclasses.replace(run, plan=dataclasses.replace(run.plan, states=run.plan.states + 1))
    with pytest.raises(ls.InputError, match="rollout: got a run of another plan"):
        tube.added_to(moved)
    with pytest.raises(ls.InputError, match="rollout: got 3, want a Rollout"):
        tube.added_to(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.InputError, match=r"Rollout: tube: got shape \(2, 2\), want \(T\+1, p, p\) = \(151, p, p\)"):
        dataclasses.replace(run, tube=np.eye(2))


@pytest.mark.long
def test_four_hundred_runs_are_within_their_tube(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    """2 sigma: 95.4 % along each direction. 400 runs at a knot have a standard error of 1 %."""
    problem, plant = differential_drive.problem, differential_drive.plant()
    noise = [NOISE, MeasurementNoise(0.005)]
    tube, _ = tube_under(problem, drive_solution, plant, noise)
    assert tube is not None
    run = ls.simulate(plant, drive_solution, disturbances=noise, trials=400, frames=False, contacts=False)
    away = run.states[:, :, :2] - ls.simulate(plant, drive_solution, frames=False).states[:, :, :2]
    for knot in (30, 75, 120):
        variances, directions = np.linalg.eigh(tube.position_covariance[knot])
        inside = np.abs(away[:, knot] @ directions) < 2 * np.sqrt(variances)
        assert inside.mean(axis=0) == pytest.approx(0.954, abs=0.04)

"""What controls: policies, functions and controllers of one's own, with a solution and without; runs side by side."""

import copy
import dataclasses
import re
import threading
from typing import Any

import numpy as np
import pytest
from refusing import refusal
from sampling import rarely

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, MeasurementDropouts, MeasurementNoise
from lqrsim.errors import Array

NOISE = [ControlNoise(0.05), MeasurementNoise(0.01)]
STATED = ls.disturbances.Uncertainty(measurement=0.01, start=0.01, control=0.05)
TOLERATE = {"m": 0.05, "rad": 0.1}


@pytest.fixture(scope="module")
def plant(differential_drive: ls.Scenario) -> ls.Plant:
    return differential_drive.plant()


# Functions of state and time.


def test_a_function_is_run_as_the_policy_that_it_is(plant: ls.Plant, drive_solution: ls.Solution) -> None:
    """Feedback in NumPy against the compiled law; what they sum up in another order is all that differs: 1e-9."""
    policy = drive_solution.policy
    run = ls.simulate(plant, drive_solution, controller=policy, disturbances=NOISE, trials=3, frames=False)
    mine = ls.simulate(
        plant, drive_solution, controller=lambda state, t: policy(state, t), disturbances=NOISE, trials=3, frames=False
    )
    np.testing.assert_allclose(mine.states, run.states, rtol=0, atol=1e-9)
    assert mine.policy_digest != run.policy_digest


def test_where_nothing_is_summed_up_it_is_the_same_to_the_bit(plant: ls.Plant, drive_solution: ls.Solution) -> None:
    """The plan's controls at each time, without feedback; and the policy given beside the solution, or in it."""
    plan, no_feedback = drive_solution.trajectory, drive_solution.open_loop()

    def planned(state: Array, t: float) -> Array:
        state[:] = np.nan  # its own copy, so that this does no harm
        return plan.controls[round(t / plan.dt)]

    options: dict[str, Any] = {"disturbances": NOISE, "trials": 2, "frames": False}
    inside = ls.simulate(plant, no_feedback, **options)
    for controller in (planned, no_feedback.policy):
        run = ls.simulate(plant, drive_solution, controller=controller, **options)
        assert run.states.tobytes() == inside.states.tobytes()
        assert run.commanded.tobytes() == inside.commanded.tobytes()
        assert run.measured.tobytes() == inside.measured.tobytes()


def test_what_a_function_returns_is_held_within_the_limits(plant: ls.Plant, drive_solution: ls.Solution) -> None:
    run = ls.simulate(plant, drive_solution, controller=lambda state, t: [9.0, -9.0], frames=False)
    assert (run.commanded == [0.5, -0.5]).all()
    assert run.saturated.all()


def test_a_function_that_fails_ends_its_trials(plant: ls.Plant, drive_solution: ls.Solution) -> None:
    def failing(state: Array, t: float) -> Any:
        return [0.1] if t > 1 else [0.1, 0.1]

    run = ls.simulate(plant, drive_solution, controller=failing, frames=False)
    assert run.outcome == ("error",)
    assert run.reasons[0].startswith("controller at 1.167 s: InputError: commands: got shape (1,), want (2,)")


# Plans: given, or the controller's own.


def test_a_controller_with_a_plan_needs_no_solution(
    plant: ls.Plant, differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """The same run to the bit, with the solution and without."""
    problem = differential_drive.problem
    for law in (
        ls.OffsetFree(problem, drive_solution, STATED, tolerate=TOLERATE),
        ls.Replanner(problem, drive_solution, every=5.0),
    ):
        alone = ls.simulate(plant, controller=law, disturbances=NOISE, frames=False)
        beside = ls.simulate(plant, drive_solution, controller=law, disturbances=NOISE, frames=False)
        assert alone.states.tobytes() == beside.states.tobytes()
        np.testing.assert_array_equal(alone.plan.states, drive_solution.trajectory.states)
        np.testing.assert_array_equal(alone.goal, drive_solution.goal)
        assert alone.goal_radius == beside.goal_radius


def test_a_re_plan_is_run_as_a_solution_is(
    plant: ls.Plant, differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """From another start to the same goal; it says itself how near that is."""
    problem = differential_drive.problem
    start = drive_solution.trajectory.states[0] + [0.1, 0.0, 0.0]
    replan = ls.prepare(problem).solve(start, drive_solution)
    run = ls.simulate(plant, replan, frames=False)
    np.testing.assert_array_equal(run.states[0, 0], start)
    np.testing.assert_array_equal(run.goal, drive_solution.goal)
    assert run.outcome == ("reached",)
    np.testing.assert_array_equal(ls.simulate(plant, replan.shifted(3)).plan.states[0], replan.trajectory.states[3])


def test_what_is_refused(plant: ls.Plant, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    unchecked: Any = ls.simulate
    law = ls.Replanner(differential_drive.problem, drive_solution, every=5.0)
    no_plan = "plan: got none, want one, such as smooth(problem)"
    for controller in (None, drive_solution.policy, lambda state, t: [0.1, 0.1]):
        assert refusal(lambda c=controller: unchecked(plant, controller=c)).startswith(no_plan)
    assert refusal(lambda: unchecked(plant, law)).startswith("plan: got")
    assert refusal(lambda: unchecked(plant, drive_solution.policy)).startswith("plan: got")
    for wrong in (3, "policy", drive_solution, lambda state: state):
        line = refusal(lambda w=wrong: unchecked(plant, drive_solution, controller=w))
        assert line.startswith("controller: got")
        assert "want a policy, a Controller or a function of state (n,) and time" in line


# Policies with a filter.


def test_a_policy_with_a_filter_is_run_on_what_it_measures(
    plant: ls.Plant, differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """Its recursion by hand on the recorded measurements gives each command to the bit; those drawn to be lost are."""
    noise = [*NOISE, MeasurementDropouts(0.3)]
    for sensors, chosen in ((None, [0, 1, 2]), (("heading", "x", "y"), [2, 0, 1])):
        law = ls.OffsetFree(differential_drive.problem, drive_solution, STATED, tolerate=TOLERATE, sensors=sensors)
        policy = law.policy
        run = ls.simulate(plant, drive_solution, controller=policy, disturbances=noise, trials=2, frames=False)
        for k in range(2):
            z, last, lost = policy.start(), drive_solution.trajectory.states[0], 0
            for step, measured in enumerate(run.measured[k, :-1]):  # noise makes those that arrive differ
                gone = bool((measured == last).all())
                control, z = policy.step(z, None if gone else measured[chosen], step * policy.dt)
                np.testing.assert_array_equal(run.commanded[k, step], control)
                last, lost = measured, lost + gone
            assert lost > 10
        assert run.policy_digest == policy.digest
        assert set(run.outcome) == {"reached"}
    ranging = ls.OffsetFree(
        differential_drive.problem, drive_solution, STATED, tolerate=TOLERATE, sensors=np.array([[1.0, 1.0, 0.0]])
    ).policy
    line = refusal(lambda: ls.simulate(plant, drive_solution, controller=ranging))
    assert line.startswith("controller: got an OutputFeedbackPolicy that measures ")


# Runs side by side.


def made(scenario: ls.Scenario, solution: ls.Solution) -> dict[str, ls.Controller]:
    problem = scenario.problem
    return {
        "estimating": ls.OffsetFree(problem, solution, STATED, tolerate=TOLERATE, record=True),
        "estimating, planning again": ls.OffsetFree(
            problem, solution, STATED, tolerate=TOLERATE, record=True, replan_every=12.0, replan_always=True
        ),
        "planning again": ls.Replanner(problem, solution, every=2.0, computing=lambda rng: rng.uniform(0.0, 0.3)),
    }


@pytest.mark.parametrize(
    "name",
    ["estimating", *rarely("estimating, planning again", "planning again")],
)
def test_one_controller_serves_two_runs_at_once(
    plant: ls.Plant, differential_drive: ls.Scenario, drive_solution: ls.Solution, name: str
) -> None:
    """In two threads that meet in each control period: what a run does and records has the bits that it has alone."""
    law = made(differential_drive, drive_solution)[name]
    digest, before = law.digest, set(vars(law))

    def run(seed: int, **options: Any) -> ls.Rollout:
        return ls.simulate(plant, controller=law, disturbances=NOISE, trials=2, seed=seed, frames=False, **options)

    wanted = [run(seed) for seed in (0, 1)]
    meeting, found = threading.Barrier(2, timeout=600), dict[int, ls.Rollout]()

    def beside(seed: int) -> None:
        found[seed] = run(seed, progress=lambda done, of: meeting.wait())

    threads = [threading.Thread(target=beside, args=(seed,)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for seed in (0, 1):
        one, other = found[seed], wanted[seed]
        assert one.states.tobytes() == other.states.tobytes()
        assert one.commanded.tobytes() == other.commanded.tobytes()
        mine, theirs = one.controller_run, other.controller_run
        for recorded in ("estimates", "innovations"):
            if hasattr(theirs, recorded):
                assert getattr(mine, recorded).tobytes() == getattr(theirs, recorded).tobytes()
        if hasattr(theirs, "log"):
            assert len(theirs.log.records) > 0
            for a, b in zip(mine.log.records, theirs.log.records, strict=True):
                assert dataclasses.replace(a, seconds=0.0) == dataclasses.replace(b, seconds=0.0)
    assert not np.array_equal(wanted[0].states, wanted[1].states)
    assert (law.digest, set(vars(law))) == (digest, before)


def test_the_run_of_the_controller_stays_in_memory(plant: ls.Plant, drive_solution: ls.Solution, tmp_path: Any) -> None:
    run = ls.simulate(plant, drive_solution, frames=False)
    assert isinstance(run.controller_run, ls.types.ControllerRun)
    assert dataclasses.replace(run, seed=1).controller_run is run.controller_run
    assert copy.deepcopy(run).controller_run is None
    loaded = ls.load(ls.save(run, tmp_path / "run.npz"))
    assert isinstance(loaded, ls.Rollout)
    assert loaded.controller_run is None
    assert loaded.states.tobytes() == run.states.tobytes()


def test_what_is_printed_has_shapes_and_no_addresses(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """Policies, laws and tubes have tens of thousands of numbers."""
    problem, plan, policy = differential_drive.problem, drive_solution.trajectory, drive_solution.policy
    law = ls.OffsetFree(problem, drive_solution, STATED, tolerate=TOLERATE)
    tube = ls.predict_tube(problem, drive_solution, STATED, law, samples=0)
    records = [
        policy, plan, law.policy, tube, drive_solution.cost_to_go, drive_solution.total_cost, law,
        ls.Replanner(problem, drive_solution, every=1.0), ls.prepare(problem), differential_drive,
        differential_drive.scene, differential_drive.plant(),
    ]  # fmt: skip
    for one in records:
        assert re.fullmatch(rf"{type(one).__name__}\(.{{1,2000}}\)", str(one))
        assert " at 0x" not in str(one)
    assert f"gain=array {policy.gain.shape}" in str(policy)
    assert f"states=array {plan.states.shape}" in str(plan)
